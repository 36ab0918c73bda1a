"""What a diagnosis would most likely name first: a round of looks, without the search for integrity and the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import yaml

from selfcal.adequacy.identify import identify_axis
from selfcal.adequacy.identify_document import identify_document
from selfcal.bank.blocks import BLOCKS_LEAST
from selfcal.bank.priors import MOST_INTERVALS, add_sources, for_record
from selfcal.base.errors import UserError
from selfcal.diagnosis.finding import UNEXPLAINED
from selfcal.diagnosis.loop import LOOKS
from selfcal.diagnosis.record import Record, record_from
from selfcal.likelihood.fit import ROUGH_FTOL
from selfcal.likelihood.state import NET_LEAST, SLOW_S, Look, State
from selfcal.logs.recording import Recording, as_float
from selfcal.model.file import DEFAULT, Model
from selfcal.model.tables import bank_block, make_tables


def suspicions(recording: Recording, model: Model, axes: Sequence[str]) -> dict[str, Look]:
    """The look of each axis that gains most on means of 1 s. Axes without a look, or too short, are left out.

    The fits are rough: they rank causes, and their sizes lay a prior at most."""
    try:
        record, states = rough(recording, model, axes)
    except UserError:
        return {}
    found: dict[str, Look] = {}
    for name, state in states.items():
        shown = [look for cause in LOOKS for look in cause(state, record) if look.net >= NET_LEAST]
        if shown:  # what has no name is the suspicion where nothing has
            found[name] = max(shown, key=lambda look: (look.cause != UNEXPLAINED, look.net))
    return found


def rough(recording: Recording, model: Model, axes: Sequence[str]) -> tuple[Record, dict[str, State]]:
    """Means of SLOW_S, or MOST_INTERVALS longer means, and a rough fit of each of the axes that can be judged, less the
    motion. Raises UserError for a record that is too short."""
    record = record_from(recording, model, min(1.0 / SLOW_S, recording.rate_hz, MOST_INTERVALS / recording.duration_s))
    states = {name: record.axes[name] for name in axes if name in record.axes and not record.axes[name].below_lattice}
    return record, {name: state.masked(record.moving).refit(ftol=ROUGH_FTOL) for name, state in states.items()}


#: Intervals at most that the laws of `models/sums.yaml` are weighed on: their filters cost twenty times the others'.
#: Half as many as runs 1 and 2 have at 1 Hz move no probability there by more than 0.08.
MORE_LAWS_MOST = 5000


def with_added_laws(
    document: dict[str, Any],
    recording: Recording,
    suspected: Mapping[str, Look],
    engine: str,
    decimate: float | None,
    *,
    draw: bool,
) -> list[str]:
    """Identify axes anew whose suspicion is noise of another kind than white: N of the default laws is wrong there.

    The law of that noise joins the default laws. Where it is the likeliest, its answer takes the place of the first
    answer, with `added_law` and the suspicion. Returns those axes."""
    from selfcal.diagnosis.causes import CAUSES

    again = []
    for name, shown in suspected.items():
        add_law = CAUSES[shown.cause].written.law
        if add_law is None or document["axes"][name]["suspicion"] != shown.cause:
            continue
        tree: dict[str, Any] = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
        before = set(tree["hypotheses"])
        add_law(tree, shown)
        with suppress(UserError):  # too long for the law's filters
            of_file = Model.of_tree(tree, DEFAULT)
            whole = _whole_means(recording.along(name), decimate or of_file.bank_rate_hz)
            model = for_record(of_file, whole, (name,))
            axis = identify_axis(whole, name, model, engine, decimate, draw=draw)
            if axis.result.best not in before:
                own = identify_document(recording, {name: axis})
                add_sources(own, of_file, model)
                document["axes"][name] = own["axes"][name] | {"suspicion": shown.cause, "added_law": axis.result.best}
                again.append(name)
    return again


def _whole_means(recording: Recording, bank_rate_hz: float) -> Recording:
    """The recording without the bank intervals that lost readings: what a counter gained there is in no other reading.
    Raises UserError where fewer than FEWEST are left."""
    if not recording.missing_before.any():
        return recording
    block = bank_block(recording.rate_hz, bank_rate_hz)
    place = recording.clock.place
    cell = (place - place[0]) // block
    whole = np.bincount(cell) == block
    if np.count_nonzero(whole) < BLOCKS_LEAST:
        raise UserError("too few bank intervals have all of their readings")
    return recording.with_rows(whole[cell])


def weigh_more_laws(document: dict[str, Any], recording: Recording, names: Sequence[str]) -> None:
    """Add the answer of the laws of `models/sums.yaml`, for the axes whose drift the default laws do not describe.

    At the model's own bank rate; at a lower rate for a longer record than MORE_LAWS_MOST such intervals."""
    from selfcal.bank.library import Bank
    from selfcal.diagnosis.causes import CAUSES

    more = Model.load(DEFAULT.parent / "sums.yaml")
    rate_hz = min(more.bank_rate_hz, MORE_LAWS_MOST / recording.duration_s)
    for name in names:
        axis = document["axes"][name]
        if "suspicion" not in axis or CAUSES[axis["suspicion"]].slow:
            with suppress(UserError):  # a record too long for these laws
                more = for_record(more, recording, (name,))
                tables = make_tables(more, recording.rate_hz, (name,), bank_rate_hz=rate_hz)
                bank = Bank(tables)
                samples = as_float(recording.in_unit(name, more.group_of(name).unit))
                bank.push(samples[:, None], recording.missing_before)
                axis["more_laws"] = bank.report(0).probability
