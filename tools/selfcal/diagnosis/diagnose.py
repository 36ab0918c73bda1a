"""`selfcal diagnose`: what the simulation gets wrong in a recording, why, and what mending it gains."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

from rich.console import Console

from selfcal.adequacy.document import parameters_entry, recording_entry, regressors_entry, since
from selfcal.adequacy.identify import identify_axis
from selfcal.base.ending import Held, Stopped, abandon
from selfcal.base.errors import UserError, note, printable
from selfcal.base.progress import Doing
from selfcal.diagnosis import hidden, words
from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.document import to_document
from selfcal.diagnosis.finding import ROUNDS, Diagnosed, Finding
from selfcal.diagnosis.loop import INTERRUPTED, diagnose_record
from selfcal.diagnosis.record import Record, carried, why_left_out
from selfcal.diagnosis.verdict import of_checks
from selfcal.likelihood import work
from selfcal.logs.recording import Recording
from selfcal.model.file import Model

#: Why an axis has no result.
BELOW_LATTICE = "its noise is below the lattice of its readings: record with a finer range"
OF_COUNTER = "its readings are increments of a counter, coarse against their noise: give a lower --decimate HZ"
#: The first look is at means at this rate, Hz. A recording of fewer samples, or slower than LEAST_HZ, needs none.
FIRST_HZ, FIRST_FROM, LEAST_HZ = 1.0, 20_000, 4.0
#: How long the work of an axis may go on after a signal, s: it ends at its next pass of the filter.
PATIENCE_S = 0.3


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
        for entry, one in [*pairs, *([(axis, together)] if each else [])]:
            entry["gain_on"] = one.gain
            if one.gain is None:
                entry["gain_on_reason"] = one.reason


def looked_at(record: Record, names: Sequence[str], ending: Held, doing: Doing) -> dict[str, Diagnosed]:
    """The loop in a thread, so that a signal is answered while the compiled filter runs. What a signal left undone is
    `unfinished`, and the threads are then left behind."""
    found: dict[str, Diagnosed] = {}
    stopped = Event()
    judged = [name for name in names if name in record.axes]

    def loop() -> None:
        with work.within(work.Work(lambda: stopped.is_set() or ending.asked)):
            diagnose_record(record, judged, doing.now, found)

    pool = ThreadPoolExecutor(1)
    future = pool.submit(loop)
    try:
        while not future.done() and not ending.asked:
            wait([future], timeout=0.1)
            doing.tick()
        wait([future], timeout=PATIENCE_S if ending.asked else None)
        if future.done():
            with suppress(Stopped):
                future.result()
        else:
            abandon()
    finally:
        stopped.set()
        pool.shutdown(wait=False)
    return {name: replace(one, findings=list(one.findings)) for name, one in list(found.items())}


def shared_by(found: Mapping[str, Diagnosed], model: Model) -> hidden.Hidden | None:
    """What moves several axes and nobody recorded; None: nothing does, or the model file states it."""
    if model.hidden_input is not None:
        return None
    states = {name: one.state for name, one in found.items() if not one.unfinished}
    grids = Counter((state.y.size, state.dt) for state in states.values())
    most = max(grids, key=lambda grid: grids[grid], default=None)
    return hidden.together({name: state for name, state in states.items() if (state.y.size, state.dt) == most})


def entry_of(shared: hidden.Hidden, found: Mapping[str, Diagnosed], recording: Recording) -> dict[str, Any]:
    """The finding of all axes for the document."""
    units = {name: recording.columns[name].unit for name in shared.names}
    record = found[shared.names[0]].record
    return hidden.entry(shared, {name: found[name].state for name in shared.names}, units, record.start_s)


def less_stated(one: Diagnosed, model: Model) -> Diagnosed:
    """The axis without findings that the model file states already: they are `stated`."""
    stated = [finding for finding in one.findings if CAUSES[finding.look.cause].stated(finding, model)]
    findings = [finding for finding in one.findings if not any(finding is each for each in stated)]
    return replace(one, findings=findings, stated=stated, before=one.before if findings else one.after)


def by_identify(found: Mapping[str, Diagnosed], recording: Recording, model: Model) -> None:
    """Axes without a cause must pass the checks of `identify`, whose bank has the whole model."""
    for name, one in found.items():
        if one.findings or one.state.below_lattice or model.beyond:
            continue
        with suppress(UserError):  # no report, no checks
            look = of_checks(one, identify_axis(recording, name, model, "library", None).judged.checks)
            if look is not None:
                one.findings.append(Finding(look, ROUNDS + 1, one.state, one.state))


def show_first(recording: Recording, first: Mapping[str, Diagnosed], names: Sequence[str], ending: Held) -> None:
    """The findings of the first look on stderr, as soon as they are there, and the axes `names` that it did not end."""
    with work.within(work.Work(lambda: True)):  # in words: nothing is measured for them
        axes = to_document(recording, first, {}, {})["axes"]
    told = [f"{name}: {finding['cause']}: {finding['words']}" for name in axes for finding in axes[name]["findings"]]
    reasons = {name: first[name].unfinished if name in first else INTERRUPTED * ending.asked for name in names}
    told += [f"{name}: not finished: {reason}" for name, reason in reasons.items() if reason]
    note(f"means of {1.0 / FIRST_HZ:g} s, before every sample is looked at: {'' if told else 'nothing found'}")
    for line in told:
        note(line)


def why_not(recording: Recording, model: Model, record: Record, name: str) -> str:
    """Why an axis has no result."""
    if name not in record.axes:
        return why_left_out(recording, model, name)
    if not below_lattice(record, name):
        return INTERRUPTED
    return OF_COUNTER if carried(record, name) else BELOW_LATTICE


def below_lattice(record: Record, name: str) -> bool:
    """Whether an axis cannot be judged because its noise is below the lattice of its readings."""
    return name in record.axes and record.axes[name].below_lattice


def add_posteriors(document: dict[str, Any], recording: Recording, model: Model, ending: Held) -> None:
    """What the extended model knows of each axis at rest, as `identify` tells it; null where the record bears no
    report, and after a signal."""
    axes = {name: axis for name, axis in document["axes"].items() if "error" not in axis}
    findings = [finding for axis in axes.values() for finding in axis["findings"]]
    moved = [one for finding in findings if finding["cause"] == "motion" for one in finding["estimate"]["intervals"]]
    rest = recording.without(moved)
    for name, axis in axes.items():
        axis["posterior"] = None if ending.asked else _posterior(rest, name, model)


def _posterior(recording: Recording, name: str, model: Model) -> dict[str, Any] | None:
    try:
        known = identify_axis(recording, name, model, "library", None)
    except UserError:
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


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """What a person reads: per axis the verdict, each finding in words with its evidence and gain, what to do next."""
    recording = document["recording"]
    console = Console(stderr=to_stderr)
    console.print(
        f"{printable(recording['path'])}: {recording['samples']} samples, {recording['rate_hz']:g} Hz, "
        f"{recording['duration_s']:g} s{since(recording)}\n",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    for shared in document.get("findings", []):
        colour = "bold red" if shared["confirmed"] else "yellow"
        console.print(
            f"{', '.join(shared['axes'])}: {shared['cause']}",
            style=colour,
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
        held = "" if shared["confirmed"] else "; not confirmed on held-out time"
        for line in (
            shared["words"],
            f"evidence {shared['evidence_nats']:.1f} nats{held}",
            f"next: {shared['record_next']}",
        ):
            console.print(f"  {line}", highlight=False, markup=False, soft_wrap=True)
    for name, axis in document["axes"].items():
        if "error" in axis:
            console.print(f"{name}: no result: {axis['error']}", highlight=False, markup=False, soft_wrap=True)
            continue
        reason = f": {axis['unfinished']}" if axis.get("unfinished") else ""
        colour = "bold red" if axis["verdict"] != "adequate" else "yellow" if reason else "green"
        heading = f"{name} [{axis['unit']}]: {words.verdict(axis)}{reason}"
        heading += f"; the model states {', '.join(axis['stated'])}" if axis.get("stated") else ""
        console.print(heading, style=colour, highlight=False, markup=False, soft_wrap=True)
        for finding in axis["findings"]:
            for line in _lines(finding):
                console.print(f"  {line}", highlight=False, markup=False, soft_wrap=True)
        if len(axis["findings"]) > 1:
            for line in words.carried(axis):
                console.print(f"  all causes together: {line}", highlight=False, markup=False, soft_wrap=True)


def _lines(finding: Mapping[str, Any]) -> list[str]:
    """One finding in a few lines."""
    gain = finding["gain"]
    lines = [f"{finding['cause']}: {finding['words']}"]
    evidence = f"  evidence {words.evidence(finding)}"
    if finding["when"]:
        evidence += f"; at {finding['when'][0]:.6g} s"
        evidence += "" if finding["when"][0] == finding["when"][1] else f" to {finding['when'][1]:.6g} s"
    lines.append(evidence)
    if gain is not None:
        score = gain["log_score_per_sample"]
        errors = ", ".join(
            f"{horizon} s {row['before']:.3g} -> {row['after']:.3g}"
            for horizon, row in gain["bias_rmse"]["horizon_s"].items()
        )
        lines.append(f"  held-out gain {score['after'] - score['before']:+.4f} ± {score['sd']:.2g} nats a sample")
        lines[-1] += f"; bias error ahead, {gain['bias_rmse']['unit']}: {errors}" if errors else ""
    elif finding.get("gain_reason"):
        lines.append(f"  no held-out gain: {finding['gain_reason']}")
    lines += [f"  {line}" for line in words.carried(finding)]
    if finding["inflation_words"]:
        lines.append(f"  {finding['inflation_words']}")
    if finding["shared_with"]:
        lines.append(f"  also on {', '.join(finding['shared_with'])}")
    if finding["also_possible"]:
        lines.append(f"  this record cannot tell it from: {', '.join(finding['also_possible'])}")
    lines.append(f"  next: {finding['record_next']}")
    return lines
