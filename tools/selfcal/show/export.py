"""Noise parameters in the form other programs read, one function a format.

Each takes the worst axis of a kind (largest median) and says which in a comment. K is that of the random-walk law;
under a Gauss-Markov drift that is what the drift does over times short against 1/alpha. Beside each number stands the
other estimate: of the medians the overbound (overbound.py), of the overbound the median.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.adequacy.overbound import overbound, upper_limit
from selfcal.base import units
from selfcal.base.errors import UserError, remark
from selfcal.base.output import write_text

#: Probability of the overbound where none is asked for.
OVERBOUND = 0.95
#: Step of PX4's filter by default (EKF2_PREDICT_US), s.
PREDICT_S = 0.01
#: Correlation time that makes a Gauss-Markov drift a walk, s.
ENDLESS = 1e9


@dataclass(frozen=True)
class Kind:
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

    def beside(self, name: str, factor: float = 1.0) -> str:
        """What stands beside it."""
        if self.bounded:
            return f"median {factor * self.median[name]:.6e}"
        value = factor * self.bound[name]
        return (
            f"overbound {self.level:g}: {f'{value:.6e}' if math.isfinite(value) else 'none, the record is too short'}"
        )

    def line(self, name: str, unit: str, factor: float = 1.0) -> str:
        """The number, and in a comment its unit and what stands beside it."""
        return f"{self.number(name, factor)}  # {unit}; {self.beside(name, factor)}\n"

    @property
    def step(self) -> float:
        """Density of the drift of a Gauss-Markov form over short times."""
        if self.bounded:
            return self.bound["K"]
        return self.median["sigma_m"] * math.sqrt(2.0 * self.median["alpha"])

    @property
    def correlation_s(self) -> float:
        """Correlation time of that form: an overbound is a walk."""
        return ENDLESS if self.bounded else 1.0 / self.median["alpha"]


def write_export(
    document: Mapping[str, Any], form: str, path: Path | str, overbound_level: float | None = None
) -> None:
    """Write the answer of `identify` in one of FORMS: medians, or with an `overbound_level` the overbound at it. Raises
    UserError where axes or laws are missing."""
    gyro, accel = (_kind(document, unit, overbound_level) for unit in ("rad/s", "m/s^2"))
    text = FORMS[form](gyro, accel, document["recording"])
    write_text(path, text)


def _kind(document: Mapping[str, Any], unit: str, level: float | None) -> Kind:
    found = {
        name: axis
        for name, axis in document["axes"].items()
        if "error" not in axis and units.same_kind(axis["bias_now"]["unit"], unit)
    }
    what = "gyro" if unit == "rad/s" else "accelerometer"
    if not found:
        raise UserError(f"--export needs at least one {what} axis in the answer")

    def median(name: str, law: str, parameter: str) -> float:
        entry = found[name]["parameters"][law][parameter]
        return units.convert(float(entry["median"]), entry["unit"], units.parameter_unit(parameter, unit))

    def worst(law: str, parameter: str) -> str:
        return str(max(found, key=lambda name: median(name, law, parameter)))

    for law in ("random_walk", "gauss_markov"):
        if any(law not in axis["parameters"] for axis in found.values()):
            raise UserError(f"--export needs the hypothesis {law} in the model")
    at = {"N": worst("random_walk", "N"), "K": worst("random_walk", "K"), "sigma_m": worst("gauss_markov", "sigma_m")}
    medians = {
        "N": median(at["N"], "random_walk", "N"),
        "K": median(at["K"], "random_walk", "K"),
        "sigma_m": median(at["sigma_m"], "gauss_markov", "sigma_m"),
        "alpha": median(at["sigma_m"], "gauss_markov", "alpha"),
    }
    curves = [axis["allan"] for axis in found.values() if axis["allan"] and axis["allan"]["tau_s"]]
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
    probability = found[at["K"]]["hypotheses"]
    law = max(probability, key=lambda name: probability[name])
    unexplained = [name for name, axis in found.items() if not axis["adequate"]]
    verdict = f"NOT ADEQUATE: no law explains {', '.join(unexplained)}" if unexplained else "adequate"
    notes = [
        f"{what}: axes {', '.join(found)}; medians of the worst: N {at['N']}, K {at['K']}, "
        f"Gauss-Markov {at['sigma_m']}; most probable law on {at['K']}: {law}",
        f"{what}: {verdict}",
    ]
    if tau:
        notes.append(
            f"{what}: the overbound lies above the Allan deviation of each axis, at its upper {level or OVERBOUND:g} "
            f"limit, from {min(t[0] for t in tau):g} to {max(t[-1] for t in tau):g} s"
        )
    return Kind(medians, {"N": n, "K": k}, level or OVERBOUND, level is not None, tuple(notes))


def _head(comment: str, gyro: Kind, accel: Kind, recording: Mapping[str, Any]) -> str:
    written = f"overbound {gyro.level:g}" if gyro.bounded else "medians"
    lines = [
        f"Made by `selfcal identify --export` from {remark(Path(recording['path']).name)}: "
        f"{recording['rate_hz']:g} Hz, {recording['duration_s']:g} s.",
        f"Written: {written}. Continuous time, two-sided densities.",
        *map(remark, (*gyro.notes, *accel.notes)),
    ]
    return "".join(f"{comment} {line}".strip() + "\n" for line in lines)


def _kalibr(gyro: Kind, accel: Kind, recording: Mapping[str, Any]) -> str:
    return (
        _head("#", gyro, accel, recording)
        + f"rostopic: /imu0\nupdate_rate: {recording['rate_hz']:g}  # Hz\n"
        + f"accelerometer_noise_density: {accel.line('N', 'm/s^2/sqrt(Hz)')}"
        + f"accelerometer_random_walk: {accel.line('K', 'm/s^3/sqrt(Hz)')}"
        + f"gyroscope_noise_density: {gyro.line('N', 'rad/s/sqrt(Hz)')}"
        + f"gyroscope_random_walk: {gyro.line('K', 'rad/s^2/sqrt(Hz)')}"
    )


def _allan_variance_ros(gyro: Kind, accel: Kind, recording: Mapping[str, Any]) -> str:
    """`imu.yaml` of that package's analysis.py: its keys, in its order."""

    def lines(title: str, prefix: str, kind: Kind, unit: str) -> str:
        return (
            f"#{title}\n"
            f"{prefix}_noise_density: {kind.number('N')} # {unit}/sqrt(Hz); {kind.beside('N')}\n"
            f"{prefix}_random_walk: {kind.number('K')} # {units.per_second(unit)}/sqrt(Hz); {kind.beside('K')}\n\n"
        )

    return (
        _head("#", gyro, accel, recording)
        + lines("Accelerometer", "accelerometer", accel, "m/s^2")
        + lines("Gyroscope", "gyroscope", gyro, "rad/s")
        + "rostopic: '/sensors/imu' #Make sure this is correct\n"
        + f"update_rate: {float(recording['rate_hz']):.10g} # Hz\n"
    )


def _openvins(gyro: Kind, accel: Kind, recording: Mapping[str, Any]) -> str:
    """`kalibr_imu_chain.yaml`: the keys that its parser wants of imu0, intrinsics those of a perfect IMU."""

    def matrix(name: str, size: int, diagonal: float) -> str:
        rows = [[diagonal if row == column else 0.0 for column in range(size)] for row in range(size)]
        return f"  {name}:\n" + "".join(f"    - {row}\n" for row in rows)

    return (
        "%YAML:1.0\n"
        + _head("#", gyro, accel, recording)
        + "# A floor set by the sensor alone: OpenVINS' own files inflate such numbers for what its model leaves out.\n"
        + "\nimu0:\n"
        + matrix("T_i_b", 4, 1.0)
        + f"  accelerometer_noise_density: {accel.line('N', 'm/s^2/sqrt(Hz)')}"
        + f"  accelerometer_random_walk: {accel.line('K', 'm/s^3/sqrt(Hz)')}"
        + f"  gyroscope_noise_density: {gyro.line('N', 'rad/s/sqrt(Hz)')}"
        + f"  gyroscope_random_walk: {gyro.line('K', 'rad/s^2/sqrt(Hz)')}"
        + f"  rostopic: /imu0\n  time_offset: 0.0  # s\n  update_rate: {float(recording['rate_hz']):.10g}  # Hz\n"
        + '  model: "kalibr"\n'
        + matrix("Tw", 3, 1.0)
        + matrix("R_IMUtoGYRO", 3, 1.0)
        + matrix("Ta", 3, 1.0)
        + matrix("R_IMUtoACC", 3, 1.0)
        + matrix("Tg", 3, 0.0)
    )


def _rotors(gyro: Kind, accel: Kind, recording: Mapping[str, Any]) -> str:
    def lines(prefix: str, kind: Kind, unit: str) -> str:
        return (
            f"<!-- {unit}; N: {kind.beside('N')}; K: {kind.beside('K')} -->\n"
            f"<{prefix}NoiseDensity>{kind.number('N')}</{prefix}NoiseDensity>\n"
            f"<{prefix}RandomWalk>{kind.step:.6e}</{prefix}RandomWalk>\n"
            f"<{prefix}BiasCorrelationTime>{kind.correlation_s:.6e}</{prefix}BiasCorrelationTime> <!-- s -->\n"
        )

    comment = _head("", gyro, accel, recording).strip().replace("--export", "export")  # no double hyphen in a comment
    return (
        f"<!-- {comment}\nTurn-on bias is not identified by one recording. -->\n"
        + lines("gyroscope", gyro, "rad/s")
        + lines("accelerometer", accel, "m/s^2")
    )


def _px4(gyro: Kind, accel: Kind, recording: Mapping[str, Any]) -> str:
    """The filter steps by PREDICT_S, whatever the sensor's rate: it adds (noise dt)^2 to an angle and a velocity, and
    (bias noise dt)^2 to a bias (predictCovariance() of EKF/covariance.cpp in src/modules/ekf2)."""
    root, us = PREDICT_S**-0.5, round(1e6 * PREDICT_S)
    return (
        _head("#", gyro, accel, recording)
        + f"# discrete, for the filter's own step, EKF2_PREDICT_US {us}, its default: noise N/sqrt(step), bias noise\n"
        + f"# K/sqrt(step). With another step multiply each by sqrt({us}/EKF2_PREDICT_US). A floor set by the sensor\n"
        + "# alone, not a tuning: vibration and everything else the filter must absorb come on top.\n"
        + f"param set EKF2_GYR_NOISE {gyro.line('N', 'rad/s', root)}"
        + f"param set EKF2_ACC_NOISE {accel.line('N', 'm/s^2', root)}"
        + f"param set EKF2_GYR_B_NOISE {gyro.line('K', 'rad/s^2', root)}"
        + f"param set EKF2_ACC_B_NOISE {accel.line('K', 'm/s^3', root)}"
    )


def _orbslam3(gyro: Kind, accel: Kind, recording: Mapping[str, Any]) -> str:
    return (
        "%YAML:1.0\n"
        + _head("#", gyro, accel, recording)
        + f"IMU.NoiseGyro: {gyro.line('N', 'rad/s/sqrt(Hz)')}"
        + f"IMU.NoiseAcc: {accel.line('N', 'm/s^2/sqrt(Hz)')}"
        + f"IMU.GyroWalk: {gyro.line('K', 'rad/s^2/sqrt(Hz)')}"
        + f"IMU.AccWalk: {accel.line('K', 'm/s^3/sqrt(Hz)')}"
        + f"IMU.Frequency: {recording['rate_hz']:g}  # Hz\n"
    )


def _vins(gyro: Kind, accel: Kind, recording: Mapping[str, Any]) -> str:
    """The means of two readings are a step. Each has a noise of its own there, so a step of dt adds (n dt)^2 / 2 to an
    angle, and (w dt)^2 to a bias (midPointIntegration() of factor/integration_base.h)."""
    rate_hz = float(recording["rate_hz"])
    of_n, of_w = 2.0**0.5 * rate_hz**0.5, rate_hz**0.5
    return (
        "%YAML:1.0\n"
        + _head("#", gyro, accel, recording)
        + f"# per sample, of an IMU at {rate_hz:g} Hz: n = N sqrt(2 rate), w = K sqrt(rate). At another rate multiply\n"
        + f"# each by sqrt(rate/{rate_hz:g} Hz).\n"
        + f"acc_n: {accel.line('N', 'm/s^2', of_n)}"
        + f"gyr_n: {gyro.line('N', 'rad/s', of_n)}"
        + f"acc_w: {accel.line('K', 'm/s^3', of_w)}"
        + f"gyr_w: {gyro.line('K', 'rad/s^2', of_w)}"
    )


#: Name on the command line to writer.
FORMS: dict[str, Callable[[Kind, Kind, Mapping[str, Any]], str]] = {
    "kalibr": _kalibr,
    "rotors": _rotors,
    "px4": _px4,
    "orbslam3": _orbslam3,
    "vins": _vins,
    "allan_variance_ros": _allan_variance_ros,
    "openvins": _openvins,
}
