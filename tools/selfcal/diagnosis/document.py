"""The JSON of `diagnose` (schema selfcal.diagnose/1)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from selfcal import units as unit_module
from selfcal.diagnosis.loop import Diagnosed, Finding
from selfcal.diagnosis.record import Record
from selfcal.recording import Recording

SCHEMA = "selfcal.diagnose/1"


def to_document(recording: Recording, record: Record, found: Mapping[str, Diagnosed]) -> dict[str, Any]:
    """The document, in the units of the recording's columns."""
    return {
        "schema": SCHEMA,
        "recording": {
            "path": str(recording.path),
            "rate_hz": recording.rate_hz,
            "samples": recording.samples,
            "duration_s": recording.duration_s,
        },
        "axes": {
            name: _axis(one, unit_module.factor(one.state.unit, recording.columns[name].unit),
                        recording.columns[name].unit)
            for name, one in found.items()
        },
    }


def _axis(one: Diagnosed, factor: float, unit: str) -> dict[str, Any]:
    findings = sorted(one.findings, key=lambda finding: finding.look.gain, reverse=True)
    after = {row.name: row for row in one.after}
    return {
        "unit": unit,
        "verdict": "adequate" if one.adequate else "inadequate",
        "findings": [_finding(finding, one.state.unit, factor, unit) for finding in findings],
        "discrepancies": [
            {
                "statistic": row.name,
                "measured": row.measured,
                "simulated_q005": row.q005,
                "simulated_q995": row.q995,
                "p": row.p,
                "after": None
                if row.name not in after
                else {
                    "measured": after[row.name].measured,
                    "simulated_q005": after[row.name].q005,
                    "simulated_q995": after[row.name].q995,
                    "p": after[row.name].p,
                },
            }
            for row in one.before
            if not row.q005 <= row.measured <= row.q995
        ],
    }


def _finding(finding: Finding, inner: str, factor: float, unit: str) -> dict[str, Any]:
    look = finding.look
    return {
        "cause": look.cause,
        "evidence_gain_nats": look.gain,
        "net_nats": look.net,
        "estimate": {key: _in_unit(value, inner, factor, unit) for key, value in look.estimate.items()},
        "when": list(look.when) if look.when else None,
        "found_in_round": finding.round,
        "also_possible": list(finding.also_possible),
        "shared_with": list(finding.shared_with),
    }


def _in_unit(value: Any, inner: str, factor: float, unit: str) -> Any:
    """An interval in the recording's unit where its own begins with the axis' one."""
    if not isinstance(value, Mapping):
        return value
    own = str(value["unit"])
    if own != inner and not own.startswith(f"{inner}/"):
        return dict(value)
    scaled = {key: entry * factor for key, entry in value.items() if key != "unit"}
    return {**scaled, "unit": unit + own[len(inner) :]}
