"""The JSON of `identify` and `replay`: `selfcal.identify/1`, and how every verb writes its JSON."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from selfcal.adequacy.allan import Sampled
from selfcal.adequacy.checks import Judged, against, allan_limit
from selfcal.adequacy.summary import SheetNumber
from selfcal.bank.axis_result import AxisResult, Estimate
from selfcal.bank.subsets import ScoredSubsets
from selfcal.base import units
from selfcal.base.errors import UserError, printable, short
from selfcal.base.output import write_json
from selfcal.logs.recording import Recording

SCHEMA = "selfcal.identify/1"
#: Keys of metadata with the device's serial number and the date.
SERIALS, DATES = ("serial", "serial_number"), ("recorded_at", "date")
#: Stamps between 2001 and 2100 count from 1970, s; no device is powered for so long.
EPOCH_S = (1e9, 4.1e9)


@dataclass(frozen=True)
class Identified:
    """An axis: the engine's `result` in `unit`, what was `judged` of its adequacy, the samples `kept_out`, and the
    regressors that are `scored`, if any (coefficients in `unit` too). `sampled`: the Allan deviation of its samples, if
    it was asked for; as the curve of `judged` it is in the `group_unit`, and so are the numbers of the `summary`.
    `halved_after`: see summary.py. `more_laws`: probabilities of the laws where the drift is 1/f noise."""

    unit: str
    group_unit: str
    result: AxisResult
    judged: Judged
    kept_out: Mapping[str, int]
    scored: ScoredSubsets | None = None
    sampled: Sampled | None = None
    summary: Mapping[str, SheetNumber] = field(default_factory=dict)
    halved_after: Mapping[str, float | None] = field(default_factory=dict)
    more_laws: Mapping[str, float] = field(default_factory=dict)

    @property
    def adequate(self) -> bool:
        """All checks passed: nothing in the record speaks against the best model."""
        return not against(self.judged.checks)


def recording_entry(recording: Recording) -> dict[str, Any]:
    """The entry of a recording in a document."""
    return {
        "path": str(recording.path),
        "rate_hz": recording.rate_hz,
        "samples": recording.samples,
        "duration_s": recording.duration_s,
        "start_s": recording.start_s,
        "since_power_on_s": recording.since_power_on_s,
        **({"paths": [str(path) for path in recording.paths]} if recording.paths else {}),
        **({"options": [list(option) for option in recording.options]} if recording.options else {}),
        **({"notes": list(recording.notes)} if recording.notes else {}),
        **_of_file(recording),
    }


def _of_file(recording: Recording) -> dict[str, Any]:
    """Damage of the file; the device's serial number and the date, where the metadata have them. The date also by
    stamps since 1970."""
    damaged = recording.damaged
    entry: dict[str, Any] = {}
    if damaged:
        entry["damaged"] = {"bytes": damaged.bytes, "messages": damaged.messages, "words": damaged.words}
    for key, names in (("serial", SERIALS), ("recorded_at", DATES)):
        stated = [recording.meta[name] for name in names if isinstance(recording.meta.get(name), str | int)]
        if stated and str(stated[0]).strip():
            entry[key] = short(str(stated[0]).strip())
    began = recording.started_s
    if "recorded_at" not in entry and began is not None and EPOCH_S[0] < began < EPOCH_S[1]:
        entry["recorded_at"] = datetime.fromtimestamp(math.floor(began), UTC).isoformat().replace("+00:00", "Z")
    return entry


def as_typed(recording: Mapping[str, Any]) -> str:
    """The files of a document's `recording`, and the options that read them, as a shell takes them."""
    options = [word for name, value in recording.get("options", ()) for word in (name, value) if word]
    return printable(shlex.join([*recording.get("paths", [recording["path"]]), *options]))


def identify_document(
    recording: Recording | Mapping[str, Any],
    axes: Mapping[str, Identified | UserError],
    *,
    all_failed: Path | str | None = None,
) -> dict[str, Any]:
    """The JSON of the contract, of a recording, or of its entry where a module alone has seen the samples.

    An axis without a result has its reason in its place: {"error": ...}. Raises UserError if no axis has a result; the
    reasons are then written to `all_failed`."""
    entry = recording_entry(recording) if isinstance(recording, Recording) else dict(recording)
    reasons = {
        name: str(axis).removeprefix(f"{entry['path']}: ") for name, axis in axes.items() if isinstance(axis, UserError)
    }
    if len(reasons) == len(axes):
        failed: dict[str, list[str]] = {}
        for name, reason in reasons.items():
            failed.setdefault(reason, []).append(name)
        said = "; ".join(
            f"column{'s' if len(names) > 1 else ''} {', '.join(names)}: {reason}" for reason, names in failed.items()
        )
        if all_failed is not None:
            write_json(of_errors(SCHEMA, entry, reasons), all_failed)
        raise UserError(f"{entry['path']}: {said or 'no axis has a result'}")
    columns = recording.columns if isinstance(recording, Recording) else {}
    own_hz = {name: column.clock.rate_hz for name, column in columns.items() if column.clock is not None}
    return {
        "schema": SCHEMA,
        "recording": entry,
        "axes": {
            name: {"error": reasons[name]}
            if isinstance(axis, UserError)
            else {
                "summary": _summary(axis),
                "priors": None,  # a verb that knows the model states where they are from
                "hypotheses": dict(axis.result.probability),
                "log_evidence": dict(axis.result.log_evidence),
                "parameters": parameters_entry(axis),
                "bias_now": {"mean": axis.result.bias_mean, "sd": axis.result.bias_sd, "unit": axis.unit},
                "samples_kept_out": dict(axis.kept_out),
                "adequate": axis.adequate,
                **({"rate_hz": own_hz[name]} if name in own_hz else {}),
                "checks": {key: dict(check) for key, check in axis.judged.checks.items()},
                "allan": _allan(axis),
                **regressors_entry(axis.scored),
                **({"halved_after_s": dict(axis.halved_after)} if axis.halved_after else {}),
                **({"more_laws": dict(axis.more_laws)} if axis.more_laws else {}),
            }
            for name, axis in axes.items()
        },
    }


def of_errors(schema: str, entry: Mapping[str, Any], reasons: Mapping[str, str]) -> dict[str, Any]:
    """The document of a recording no axis of which has a result."""
    return {"schema": schema, "recording": entry, "axes": {name: {"error": why} for name, why in reasons.items()}}


def parameters_entry(axis: Identified) -> dict[str, Any]:
    """Posterior of every parameter, by law."""
    return {
        law: {
            parameter: {
                **_spread(e),
                "unit": units.parameter_unit(parameter, axis.unit),
                "identified": e.identified,
                "off_grid": e.off_grid,
            }
            for parameter, e in estimates.items()
        }
        for law, estimates in axis.result.parameters.items()
    }


def _summary(axis: Identified) -> dict[str, Any] | None:
    """The numbers of a data sheet, in the recording's units and in data sheets' own; None where they are not known."""
    entries: dict[str, Any] = {}
    for key, number in axis.summary.items():
        unit, sheet = units.parameter_unit(key, axis.unit), units.datasheet_unit(key, axis.unit)
        own = number.estimate.scaled(units.factor(axis.group_unit, axis.unit))
        entries[key] = {**_spread(own), "unit": unit, "identified": own.identified, "reason": number.reason or None}
        entries[key]["datasheet"] = {**_spread(own.scaled(units.factor(unit, sheet))), "unit": sheet}
    return entries or None


def _spread(e: Estimate) -> dict[str, float]:
    return {"mean": e.mean, "median": e.median, "sd": e.sd, "q05": e.q05, "q95": e.q95}


def _allan(axis: Identified) -> dict[str, Any] | None:
    """The Allan deviation of the record's bank samples and of the most probable law, and of its own samples if that was
    asked for; None where it is not known."""
    curve, sampled = axis.judged.curve, axis.sampled
    if curve is None:
        return None
    factor, limit = units.factor(axis.group_unit, axis.unit), allan_limit(curve)
    entry: dict[str, Any] = {
        "unit": axis.unit,
        "tau_s": curve.tau_s.tolist(),
        "recording": (curve.recording * factor).tolist(),
        "degrees_of_freedom": curve.freedom.tolist(),
        "model": (curve.model * factor).tolist(),
        "model_q05": (curve.model_q05 * factor).tolist(),
        "model_q95": (curve.model_q95 * factor).tolist(),
        "adequate_from": (curve.within(-limit) * factor).tolist(),
        "adequate_to": (curve.within(limit) * factor).tolist(),
    }
    if sampled is not None:
        scaled = {key: (getattr(sampled, key) * factor).tolist() for key in ("deviation", "q05", "q95")}
        entry["samples"] = {"tau_s": sampled.tau_s.tolist(), **scaled}
    return entry


def regressors_entry(scored: ScoredSubsets | None) -> dict[str, Any]:
    """The keys an axis has beyond the contract's if its model has regressors."""
    if scored is None:
        return {}
    return {
        "regressors": {
            name: {
                "probability": inclusion.probability,
                "coefficients": {
                    c.column: {key: getattr(c, key) for key in ("mean", "median", "sd", "q05", "q95", "unit")}
                    for c in inclusion.coefficients
                },
            }
            for name, inclusion in scored.inclusion.items()
        },
        "regressors_in_use": [regressor.name for regressor in scored.choices[scored.best]],
        "subsets": [
            {"regressors": [regressor.name for regressor in choice], "probability": probability}
            for choice, probability in zip(scored.choices, scored.probability, strict=True)
        ],
    }
