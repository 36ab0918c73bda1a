"""The JSON of `diagnose` (schema selfcal.diagnose/1)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from types import MappingProxyType
from typing import Any

from selfcal.adequacy.identify_document import recording_entry
from selfcal.base import units as unit_module
from selfcal.base.ending import Stopped
from selfcal.base.errors import UserError
from selfcal.diagnosis import words
from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.extend import NO_ROOM
from selfcal.diagnosis.finding import Diagnosed, Finding
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.score import gain, inflation
from selfcal.diagnosis.separate import next_record
from selfcal.diagnosis.statistics import Statistic
from selfcal.likelihood.state import Look, State
from selfcal.logs.recording import SIDE_CHANNELS, Recording
from selfcal.model.regressors import coefficient_unit

SCHEMA = "selfcal.diagnose/1"
G_SENSITIVITY_UNIT = coefficient_unit("deg/s", "m/s^2")


def diagnose_document(
    recording: Recording,
    found: Mapping[str, Diagnosed],
    errors: Mapping[str, str],
    model: Mapping[str, Any],
    first: Mapping[str, Diagnosed] = MappingProxyType({}),
    out: Sequence[Finding] = (),
) -> dict[str, Any]:
    """The document, in the units of the recording's columns. `errors`: why an axis has no result. `model`: the extended
    model file's tree. `first`: findings of the look at means; causes that `found` lacks stay in `only_in_means`.
    `out`: findings that a bank has no room for."""
    axes = {name: _axis(axis, recording.columns[name].unit, first.get(name), out) for name, axis in found.items()}
    return {
        "schema": SCHEMA,
        "recording": recording_entry(recording),
        "axes": {**axes, **{name: {"error": reason} for name, reason in errors.items()}},
        "model": dict(model),
    }


def _axis(axis: Diagnosed, unit: str, first: Diagnosed | None, out: Sequence[Finding]) -> dict[str, Any]:
    record = axis.record
    causes = {finding.look.cause for finding in axis.findings}
    only = [] if first is None else [finding for finding in first.findings if finding.look.cause not in causes]
    factor = unit_module.factor(axis.state.unit, unit)
    after = {row.name: row for row in axis.after}
    return {
        "unit": unit,
        "judged_at_hz": record.rate_hz,
        "verdict": "adequate" if axis.adequate else "inadequate",
        **({"unfinished": axis.unfinished} if axis.unfinished else {}),
        **({"stated": [finding.look.cause for finding in axis.stated]} if axis.stated else {}),
        "findings": [
            _finding(finding, record, factor, unit, axis.state)
            | ({"left_out_of_model": NO_ROOM} if any(finding is each for each in out) else {})
            for finding in axis.by_gain
        ],
        **(
            {}
            if first is None
            else {"only_in_means": [_finding(finding, first.record, factor, unit, first.state) for finding in only]}
        ),
        "not_found": _not_found(axis, record, factor, unit),
        "not_judged": _not_judged(axis, record),
        "discrepancies": [
            {"statistic": row.name, **_band(row), "after": _band(after[row.name]) if row.name in after else None}
            for row in axis.before
            if not row.q005 <= row.measured <= row.q995
        ],
    }


def _band(row: Statistic) -> dict[str, float]:
    """A statistic with its simulated band."""
    return {"measured": row.measured, "simulated_q005": row.q005, "simulated_q995": row.q995, "p": row.p}


def _finding(finding: Finding, record: Record, factor: float, unit: str, final: State) -> dict[str, Any]:
    look, cause = finding.look, CAUSES[finding.look.cause]
    beside = (
        finding.before
        if finding.record is not None
        else final.without({regressor.name for regressor in finding.columns})
    )
    record = finding.record or record
    inner = finding.before.unit
    try:
        known = finding.held_out or gain(look, finding.before, finding.after, record, finding.partner)
        held_out, reason = deepcopy(known.gain), known.reason
    except Stopped:
        held_out, reason = None, "there was no time left to measure it"
    try:
        planned = next_record(look, finding.rivals, beside, record)
    except Stopped:
        planned = None
    if held_out is not None:
        held_out["bias_rmse"]["unit"] = unit
        for row in held_out["bias_rmse"]["horizon_s"].values():
            row.update({key: value * factor for key, value in row.items()})
        # A density per unit: its logarithm moves with the unit.
        for key in ("before", "after"):
            held_out["log_score_per_sample"][key] -= math.log(factor)
    factors = inflation(*finding.without_and_with)
    estimate = {key: _in_unit(value, inner, factor, unit) for key, value in look.estimate.items()}
    estimate |= {key: later(value, record.start_s) for key, value in estimate.items() if _is_time(key, value)}
    return {
        "cause": look.cause,
        "judged_at_hz": record.rate_hz,
        "words": " ".join(filter(None, [words.sentence(look.cause, estimate), _plausibility(look)])),
        "evidence_gain_nats": look.gain,
        "net_nats": min(look.net, look.gain),  # a search of less than one look costs nothing
        "estimate": estimate,
        "when": later(list(look.when), record.start_s) if look.when else None,
        "found_in_round": finding.round,
        "also_possible": list(dict.fromkeys((*finding.also_possible, *look.others))),
        "record_next": words.planned(planned, cause.advice(look, record)),
        "next_record": planned,
        "gain": held_out,
        **({} if reason is None else {"gain_reason": reason}),
        "inflation": dict(factors),
        "inflation_words": words.inflation_sentence(factors),
    }


def _is_time(key: str, value: Any) -> bool:
    return key == "time_s" or (key == "intervals" and isinstance(value, list | tuple))


def later(value: Any, start_s: float) -> Any:
    """A time of the record, s, or any form of several, as a time of the recording."""
    if isinstance(value, Mapping):
        return {key: later(entry, start_s) if key not in ("sd", "unit") else entry for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [later(entry, start_s) for entry in value]
    return value + start_s


def _plausibility(look: Look) -> str:
    """How a gyroscope that follows an accelerometer compares with parts."""
    coefficient = look.estimate.get("coefficient")
    if look.cause != "cross_axis" or coefficient is None:
        return ""
    try:
        size = unit_module.factor(str(coefficient["unit"]), G_SENSITIVITY_UNIT)
    except UserError:
        return ""
    return words.plausibility(size * float(coefficient["median"]))


def _not_found(axis: Diagnosed, record: Record, factor: float, unit: str) -> list[dict[str, Any]]:
    """For every cause that has a size: the size from which half of the records with it would have been named."""
    named = {finding.look.cause for finding in axis.findings}
    rows = []
    with suppress(Stopped):
        for cause in CAUSES.values():
            least = cause.least(axis.state, record) if cause.least is not None and cause.id not in named else None
            sizes = {key: {"value": value, "unit": of} for key, (value, of) in (least or {}).items()}
            sizes = {key: _in_unit(size, axis.state.unit, factor, unit) for key, size in sizes.items()}
            if sizes:
                rows.append({"cause": cause.id, "would_have_been_found": sizes})
    return rows


def _not_judged(axis: Diagnosed, record: Record) -> list[dict[str, str]]:
    """Causes that this recording cannot show, with the reason."""
    reasons = {
        cause: f"the recording has no {cause} that changes (column {column})"
        for cause, (column, _) in SIDE_CHANNELS.items()
        if cause not in record.channels
    }
    if set(record.axes) <= {axis.state.axis}:
        reasons["cross_axis"] = "the recording has no other axis"
    return [{"cause": cause, "reason": reason} for cause, reason in reasons.items()]


def _in_unit(value: Any, inner: str, factor: float, unit: str) -> Any:
    """An interval in the recording's unit where its own begins with the axis' unit, or is that times a second."""
    if not isinstance(value, Mapping):
        return value
    own = str(value["unit"])
    if own == unit_module.times_second(inner):
        inner, unit = own, unit_module.times_second(unit)
    if own != inner and not own.startswith(f"{inner}/"):
        return dict(value)
    scaled = {key: entry * factor for key, entry in value.items() if key != "unit"}
    return {**scaled, "unit": unit + own[len(inner) :]}
