"""Noise parameters in the form other programs read, a template of `templates/export/` a format.

Each takes the worst axis of a kind (largest median) and says which in a comment. K is that of the random-walk law;
under a Gauss-Markov drift it is the drift over times short against 1/alpha. A comment has the
other estimate of each number: of the medians the overbound (overbound.py), of the overbound the median.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.adequacy.overbound import overbound, upper_limit
from selfcal.bank.axis_result import likeliest
from selfcal.base import units
from selfcal.base.code_template import of_code
from selfcal.base.errors import UserError, remark
from selfcal.base.output import write_text

#: Names of the formats on the command line, and their templates.
FORMS = {
    "kalibr": "kalibr.yaml",
    "rotors": "rotors.xml",
    "px4": "px4.params",
    "orbslam3": "orbslam3.yaml",
    "vins": "vins.yaml",
    "allan_variance_ros": "allan_variance_ros.yaml",
    "openvins": "openvins.yaml",
}
#: Probability of the overbound without an option.
OVERBOUND = 0.95
#: Step of PX4's filter by default (EKF2_PREDICT_US), s.
PREDICT_S = 0.01


@dataclass(frozen=True)
class SensorKind:
    """The gyros (rad/s) or the accelerometers (m/s^2): medians of the worst axes, and the overbound of all.

    `bounded`: the overbound is written and the medians are the comment; `notes`: what the file says of the kind.
    """

    median: Mapping[str, float]
    bound: Mapping[str, float]
    level: float
    bounded: bool
    notes: tuple[str, ...]

    def number(self, name: str, factor: float = 1.0) -> str:
        """N or K as it is written, times `factor`."""
        return f"{factor * (self.bound if self.bounded else self.median)[name]:.6e}"

    def other(self, name: str, factor: float = 1.0) -> str:
        """The other estimate of it, for the comment."""
        if self.bounded:
            return f"median {factor * self.median[name]:.6e}"
        value = factor * self.bound[name]
        return (
            f"overbound {self.level:g}: {f'{value:.6e}' if math.isfinite(value) else 'none, the record is too short'}"
        )

    def line(self, name: str, unit: str, factor: float = 1.0) -> str:
        """The number, and in a comment its unit and the other estimate."""
        return f"{self.number(name, factor)}  # {unit}; {self.other(name, factor)}"

    @property
    def step(self) -> float:
        """Density of the drift of a Gauss-Markov form over short times."""
        if self.bounded:
            return self.bound["K"]
        return self.median["sigma_m"] * math.sqrt(2.0 * self.median["alpha"])

    @property
    def correlation_s(self) -> float:
        """Correlation time of that form: an overbound is a walk."""
        return 1e9 if self.bounded else 1.0 / self.median["alpha"]


def write_export(
    document: Mapping[str, Any], form: str, path: Path | str, overbound_level: float | None = None
) -> None:
    """Write the answer of `identify` in a form of FORMS: medians, or with an `overbound_level` the overbound at it.
    Raises UserError where axes or laws are missing."""
    gyro, accel = (_kind(document, unit, overbound_level) for unit in ("rad/s", "m/s^2"))
    write_text(path, text_of(form, gyro, accel, document["recording"]))


def text_of(form: str, gyro: SensorKind, accel: SensorKind, recording: Mapping[str, Any]) -> str:
    """The file in a form of FORMS."""
    template = of_code(Path(__file__).parent / "templates" / "export").get_template(f"{FORMS[form]}.jinja")
    values = {"gyro": gyro, "accel": accel, "recording": recording, "PREDICT_S": PREDICT_S}
    return template.render(head=_head(gyro, accel, recording), **values)


def _kind(document: Mapping[str, Any], unit: str, level: float | None) -> SensorKind:
    axes = {
        name: axis
        for name, axis in document["axes"].items()
        if "error" not in axis and units.same_kind(axis["bias_now"]["unit"], unit)
    }
    what = "gyro" if unit == "rad/s" else "accelerometer"
    if not axes:
        raise UserError(f"--export needs at least one {what} axis in the answer")

    def median(name: str, law: str, parameter: str) -> float:
        entry = axes[name]["parameters"][law][parameter]
        return units.converted(float(entry["median"]), entry["unit"], units.parameter_unit(parameter, unit))

    def worst(law: str, parameter: str) -> str:
        return str(max(axes, key=lambda name: median(name, law, parameter)))

    for law in ("random_walk", "gauss_markov"):
        if any(law not in axis["parameters"] for axis in axes.values()):
            raise UserError(f"--export needs the hypothesis {law} in the model")
    law_of = {"N": "random_walk", "K": "random_walk", "sigma_m": "gauss_markov"}
    worst_axis = {parameter: worst(law, parameter) for parameter, law in law_of.items()}
    medians = {parameter: median(worst_axis[parameter], law, parameter) for parameter, law in law_of.items()}
    medians["alpha"] = median(worst_axis["sigma_m"], "gauss_markov", "alpha")
    curves = [axis["allan"] for axis in axes.values() if axis["allan"] and axis["allan"]["tau_s"]]
    tau = [np.array(curve["tau_s"]) for curve in curves]
    limits = [
        upper_limit(
            np.array(curve["recording"]) * units.factor(curve["unit"], unit),
            np.array(curve["degrees_of_freedom"]),
            level or OVERBOUND,
        )
        for curve in curves
    ]
    n, k = overbound(tau, limits)
    if level is not None and not math.isfinite(n):
        raise UserError("--overbound: the record is too short for an Allan deviation; leave the option out")
    law = likeliest(axes[worst_axis["K"]]["hypotheses"])
    unexplained = [name for name, axis in axes.items() if not axis["adequate"]]
    verdict = f"NOT ADEQUATE: no law explains {', '.join(unexplained)}" if unexplained else "adequate"
    notes = [
        f"{what}: axes {', '.join(axes)}; medians of the worst: N {worst_axis['N']}, K {worst_axis['K']}, "
        f"Gauss-Markov {worst_axis['sigma_m']}; most probable law on {worst_axis['K']}: {law}",
        f"{what}: {verdict}",
    ]
    if tau:
        notes.append(
            f"{what}: the overbound lies above the Allan deviation of each axis, at its upper {level or OVERBOUND:g} "
            f"limit, from {min(t[0] for t in tau):g} to {max(t[-1] for t in tau):g} s"
        )
    return SensorKind(medians, {"N": n, "K": k}, level or OVERBOUND, level is not None, tuple(notes))


def _head(gyro: SensorKind, accel: SensorKind, recording: Mapping[str, Any]) -> list[str]:
    """The lines of the comment that a file begins with."""
    return [
        f"Made by `selfcal identify --export` from {remark(Path(recording['path']).name)}: "
        f"{recording['rate_hz']:g} Hz, {recording['duration_s']:g} s.",
        f"Written: {f'overbound {gyro.level:g}' if gyro.bounded else 'medians'}. Continuous time, two-sided densities.",
        *map(remark, (*gyro.notes, *accel.notes)),
    ]
