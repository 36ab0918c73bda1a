"""The JSON of `identify` and `replay`: `selfcal.identify/1`, and how every verb writes its JSON."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from selfcal import units
from selfcal.errors import UserError
from selfcal.recording import Recording
from selfcal.regressors import Scored
from selfcal.result import AxisResult

SCHEMA = "selfcal.identify/1"


@dataclass(frozen=True)
class Identified:
    """One axis: the engine's `result` in `unit`, `checks` of its adequacy, the samples `kept_out`, and what is known of
    the regressors, if the model has any for it (coefficients in `unit` too)."""

    unit: str
    result: AxisResult
    checks: Mapping[str, Mapping[str, Any]]
    kept_out: Mapping[str, int]
    scored: Scored | None = None

    @property
    def adequate(self) -> bool:
        """All checks passed: nothing in the record speaks against the best model."""
        return all(bool(check["passed"]) for check in self.checks.values())


def to_document(recording: Recording, found: Mapping[str, Identified]) -> dict[str, Any]:
    """The JSON of the contract."""
    return {
        "schema": SCHEMA,
        "recording": {
            "path": str(recording.path),
            "rate_hz": recording.rate_hz,
            "samples": recording.samples,
            "duration_s": recording.duration_s,
        },
        "axes": {
            name: {
                "hypotheses": dict(axis.result.probability),
                "log_evidence": dict(axis.result.log_evidence),
                "parameters": {
                    law: {
                        parameter: {
                            "mean": e.mean,
                            "median": e.median,
                            "sd": e.sd,
                            "q05": e.q05,
                            "q95": e.q95,
                            "unit": units.parameter_unit(parameter, axis.unit),
                            "identified": e.identified,
                            "off_grid": e.off_grid,
                        }
                        for parameter, e in estimates.items()
                    }
                    for law, estimates in axis.result.parameters.items()
                },
                "bias_now": {"mean": axis.result.bias_mean, "sd": axis.result.bias_sd, "unit": axis.unit},
                "samples_kept_out": dict(axis.kept_out),
                "adequate": axis.adequate,
                "checks": {key: dict(check) for key, check in axis.checks.items()},
                **_regressors(axis.scored),
            }
            for name, axis in found.items()
        },
    }


def _regressors(scored: Scored | None) -> dict[str, Any]:
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
        "regressors_in_use": [one.name for one in scored.choices[scored.best]],
        "subsets": [
            {"regressors": [one.name for one in choice], "probability": probability}
            for choice, probability in zip(scored.choices, scored.probability, strict=True)
        ],
    }


def write_json(document: Mapping[str, Any], path: Path | str) -> None:
    """Write a document to a file, or to stdout for '-'. What JSON cannot say (infinity, not a number) becomes null."""
    text = json.dumps(_finite(document), indent=2, allow_nan=False) + "\n"
    if str(path) == "-":
        sys.stdout.write(text)
        return
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot write: {error.strerror}") from error


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
