"""`selfcal diagnose`: what the simulation gets wrong in a recording, why, and what mending it gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import MappingProxyType
from typing import Any

import numpy as np

from selfcal.adequacy.identify import identify_axis
from selfcal.adequacy.identify_document import Identified, parameters_entry, recording_entry, regressors_entry
from selfcal.base.ending import HeldSignals, Stopped, abandon
from selfcal.base.errors import UserError, note
from selfcal.base.grid import Array
from selfcal.base.progress import Doing
from selfcal.diagnosis import hidden, module
from selfcal.diagnosis.axis_verdict import of_checks
from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.diagnose_document import diagnose_document
from selfcal.diagnosis.finding import ROUNDS, Diagnosed, Finding
from selfcal.diagnosis.loop import INTERRUPTED, diagnose_record
from selfcal.diagnosis.record import Record, is_counter
from selfcal.likelihood import work
from selfcal.logs.recording import Recording
from selfcal.model.file import Model

#: Why an axis has no result.
BELOW_LATTICE = "its noise is below the lattice of its readings: record with a finer range"
OF_COUNTER = "its readings are increments of a counter, coarse against their noise: give a lower --decimate HZ"
#: The first look is at means at this rate, Hz. A recording of fewer samples, or slower than LEAST_HZ, needs none.
FIRST_HZ, FIRST_FROM, LEAST_HZ = 1.0, 20_000, 4.0
#: How long the work of an axis may go on after a signal, s: it ends at its next pass of the filter.
ENDS_WITHIN_S = 0.3


def add_carried(
    document: dict[str, Any],
    model: Model,
    tree: Mapping[str, Any],
    record: Record,
    found: Mapping[str, Diagnosed],
    second: Recording,
) -> None:
    """The gain of each finding on a second recording, and of all on an axis together."""
    from selfcal.diagnosis.carried import gains

    document["on"] = recording_entry(second)
    for name, (each, together) in gains(model, tree, record, found, second).items():
        axis = document["axes"][name]
        pairs = zip(axis["findings"], each, strict=True)
        for entry, held_out in [*pairs, *([(axis, together)] if each else [])]:
            entry["gain_on"] = held_out.gain
            if held_out.gain is None:
                entry["gain_on_reason"] = held_out.reason


def looked_at(
    record: Record,
    names: Sequence[str],
    ending: HeldSignals,
    doing: Doing,
    means: Mapping[str, Diagnosed] = MappingProxyType({}),
) -> dict[str, Diagnosed]:
    """The loop in a thread, so that a signal is answered while the compiled filter runs. What a signal left undone is
    `unfinished`, and the threads are then left behind."""
    found: dict[str, Diagnosed] = {}
    stopped = Event()
    judged = [name for name in names if name in record.axes]

    def loop() -> None:
        with work.within(work.Work(lambda: stopped.is_set() or ending.asked)):
            diagnose_record(record, judged, doing.now, found, means)

    pool = ThreadPoolExecutor(1)
    future = pool.submit(loop)
    try:
        while not future.done() and not ending.asked:
            wait([future], timeout=0.1)
            doing.tick()
        wait([future], timeout=ENDS_WITHIN_S if ending.asked else None)
        if future.done():
            with suppress(Stopped):
                future.result()
        else:
            abandon()
    finally:
        stopped.set()
        pool.shutdown(wait=False)
    return {name: replace(axis, findings=list(axis.findings)) for name, axis in list(found.items())}


def shared_by(found: Mapping[str, Diagnosed], model: Model) -> hidden.Hidden | None:
    """What moves several axes and nobody recorded; None: nothing does, or the model file states it and it does not
    jump."""
    common = next((axis.hidden for axis in found.values() if axis.hidden is not None), None)
    return None if common is None or (model.hidden_input is not None and not common.jumps) else common


def entry_of(
    shared: hidden.Hidden, found: Mapping[str, Diagnosed], recording: Recording, model: Model
) -> dict[str, Any]:
    """The finding of all axes for the document."""
    units = {name: recording.columns[name].unit for name in shared.names}
    record = next(axis.record for axis in found.values() if axis.hidden is shared)
    states = {**record.axes, **{name: axis.state for name, axis in found.items() if axis.hidden is shared}}
    return hidden.entry(shared, states, units, record.start_s, stated=model.hidden_input is not None)


def events_of(record: Record) -> dict[str, Array]:
    """Means [n] by axis that events of several axes add to a record, and that no model of another record has."""
    states = {name: state.refit() for name, state in record.axes.items()}
    seen = module.together(states, record.channels, record.since_power_on_s + record.start_s)
    return {} if seen is None else {name: seen.effect(name) for name in seen.names}


def less_stated(axis: Diagnosed, model: Model) -> Diagnosed:
    """The axis without findings that the model file states already: they are `stated`."""
    stated = [finding for finding in axis.findings if CAUSES[finding.look.cause].written.stated(finding, model)]
    findings = [finding for finding in axis.findings if not any(finding is each for each in stated)]
    return replace(axis, findings=findings, stated=stated, before=axis.before if findings else axis.after)


def by_identify(found: Mapping[str, Diagnosed], recording: Recording, model: Model) -> None:
    """Axes without a cause must pass the checks of `identify`, whose bank has the whole model."""
    for name, diagnosed in found.items():
        # With a hidden quantity, other axes explain an axis as the quantity does.
        if diagnosed.findings or diagnosed.hidden is not None or diagnosed.state.below_lattice or model.beyond:
            continue
        # An axis that follows this axis would explain it as well.
        follow = {
            axis for axis, other in found.items() for each in other.findings if each.look.estimate.get("other") == name
        }
        others = {axis: column for axis, column in recording.columns.items() if axis not in follow}
        beside = replace(recording, columns=others)
        with suppress(UserError):  # no report, no checks
            look = of_checks(identify_axis(beside, name, model, "library", None).judged.checks)
            if look is not None:
                diagnosed.findings.append(Finding(look, ROUNDS + 1, diagnosed.state, diagnosed.state))


def show_first(recording: Recording, first: Mapping[str, Diagnosed], names: Sequence[str], ending: HeldSignals) -> None:
    """The findings of the first look on stderr, as soon as they are there, and the axes `names` that it did not end."""
    with work.within(work.Work(lambda: True)):  # in words: nothing is measured for them
        axes = diagnose_document(recording, first, {}, {})["axes"]
    told = [f"{name}: {finding['cause']}: {finding['words']}" for name in axes for finding in axes[name]["findings"]]
    reasons = {name: first[name].unfinished if name in first else INTERRUPTED * ending.asked for name in names}
    told += [f"{name}: not finished: {reason}" for name, reason in reasons.items() if reason]
    note(f"means of {1.0 / FIRST_HZ:g} s, before every sample is looked at: {'' if told else 'nothing found'}")
    for line in told:
        note(line)


def why_not(record: Record, name: str) -> str:
    """Why an axis has no result."""
    if name in record.left_out:
        return record.left_out[name]
    if not below_lattice(record, name):
        return INTERRUPTED
    return OF_COUNTER if is_counter(record, name) else BELOW_LATTICE


def below_lattice(record: Record, name: str) -> bool:
    """Whether an axis cannot be judged because its noise is below the lattice of its readings."""
    return name in record.axes and record.axes[name].below_lattice


def add_posteriors(
    document: dict[str, Any], recording: Recording, found: Mapping[str, Diagnosed], model: Model, ending: HeldSignals
) -> dict[str, Identified | None]:
    """What the extended model knows of each axis at rest, as `identify` reports it; None if the record allows no
    report, and after a signal. The document has its posterior. Readings of a loud while are left out: a bank has a
    single level of noise."""
    axes = {name: axis for name, axis in document["axes"].items() if "error" not in axis}
    known: dict[str, Identified | None] = {}
    for name, axis in axes.items():
        known[name] = None
        with suppress(UserError, Stopped):
            known[name] = (
                None if ending.asked else identify_axis(_calm(recording, found[name]), name, model, "library", None)
            )
        axis["posterior"] = _posterior(known[name])
    return known


def _calm(recording: Recording, axis: Diagnosed) -> Recording:
    """The recording less the readings of an axis while its noise is loud."""
    if not axis.loud.any():
        return recording
    name = axis.state.axis
    cell = (recording.clock_of(name).time_s * axis.record.rate_hz + 1e-6).astype(np.int64)
    loud = axis.loud[np.clip(cell, 0, axis.loud.size - 1)]
    column = recording.columns[name]
    calm = replace(column, values=np.where(loud, np.nan, column.values))
    return replace(recording, columns={**recording.columns, name: calm})


def _posterior(known: Identified | None) -> dict[str, Any] | None:
    if known is None:
        return None
    return {
        "hypotheses": dict(known.result.probability),
        "parameters": parameters_entry(known),
        "regressors": regressors_entry(known.scored).get("regressors", {}),
    }


def options_given(
    axes: Sequence[str], model: Path | str | None, decimate: float | None, recording: Recording
) -> list[tuple[str, str]]:
    """The command line's options that decide what is found, as they were given."""
    given = [("--axis", name) for name in axes]
    given += [] if model is None else [("--model", str(model))]
    given += [] if decimate is None else [("--decimate", f"{decimate:.15g}")]
    given += [("--since-power-on", f"{recording.since_power_on_s:.15g}")] if recording.since_power_on_s else []
    return [*given, *recording.options]
