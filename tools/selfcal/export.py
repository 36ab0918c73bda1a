"""Noise parameters in the form other programs read, one function a format.

Each takes the worst axis of a kind (largest median) and says which in a comment. K is that of the random-walk law;
under a Gauss-Markov drift that is what the drift does over times short against 1/alpha.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from selfcal import units
from selfcal.errors import UserError
from selfcal.output import write_text


@dataclass(frozen=True)
class Kind:
    """Worst axis of the gyros (rad/s) or the accelerometers (m/s^2): medians of N, K, and the Gauss-Markov pair."""

    axes: Mapping[str, str]
    N: float
    K: float
    sigma_m: float
    alpha: float
    law: str

    @property
    def note(self) -> str:
        """Which axes the numbers are from."""
        return f"worst axes: N {self.axes['N']}, K {self.axes['K']}; most probable law on {self.axes['K']}: {self.law}"


def write_export(document: Mapping[str, Any], form: str, path: Path | str) -> None:
    """Write the answer of `identify` in one of FORMS. Raises UserError where axes or laws are missing."""
    gyro, accel = _kind(document, "rad/s"), _kind(document, "m/s^2")
    text = FORMS[form](gyro, accel, float(document["recording"]["rate_hz"]))
    write_text(path, text)


def _kind(document: Mapping[str, Any], unit: str) -> Kind:
    found = {
        name: axis
        for name, axis in document["axes"].items()
        if units.same_kind(axis["bias_now"]["unit"], unit)
    }
    if not found:
        what = "gyro" if unit == "rad/s" else "accelerometer"
        raise UserError(f"--export needs at least one {what} axis in the answer")

    def median(name: str, law: str, parameter: str) -> float:
        entry = found[name]["parameters"][law][parameter]
        return units.convert(float(entry["median"]), entry["unit"], units.parameter_unit(parameter, unit))

    def worst(law: str, parameter: str) -> str:
        return str(max(found, key=lambda name: median(name, law, parameter)))

    for law in ("random_walk", "gauss_markov"):
        if any(law not in axis["parameters"] for axis in found.values()):
            raise UserError(f"--export needs the hypothesis {law} in the model")
    axes = {"N": worst("random_walk", "N"), "K": worst("random_walk", "K"), "sigma_m": worst("gauss_markov", "sigma_m")}
    probability = found[axes["K"]]["hypotheses"]
    return Kind(
        axes,
        median(axes["N"], "random_walk", "N"),
        median(axes["K"], "random_walk", "K"),
        median(axes["sigma_m"], "gauss_markov", "sigma_m"),
        median(axes["sigma_m"], "gauss_markov", "alpha"),
        max(probability, key=lambda law: probability[law]),
    )


def _head(comment: str, gyro: Kind, accel: Kind) -> str:
    return (
        f"{comment} Made by `selfcal identify --export`. Continuous time, two-sided densities.\n"
        f"{comment} gyro: {gyro.note}\n{comment} accelerometer: {accel.note}\n"
    )


def _kalibr(gyro: Kind, accel: Kind, rate_hz: float) -> str:
    return (
        _head("#", gyro, accel)
        + f"rostopic: /imu0\nupdate_rate: {rate_hz:g}  # Hz\n"
        + f"accelerometer_noise_density: {accel.N:.6e}  # m/s^2/sqrt(Hz)\n"
        + f"accelerometer_random_walk: {accel.K:.6e}  # m/s^3/sqrt(Hz)\n"
        + f"gyroscope_noise_density: {gyro.N:.6e}  # rad/s/sqrt(Hz)\n"
        + f"gyroscope_random_walk: {gyro.K:.6e}  # rad/s^2/sqrt(Hz)\n"
    )


def _rotors(gyro: Kind, accel: Kind, rate_hz: float) -> str:
    def lines(prefix: str, kind: Kind, unit: str) -> str:
        step = kind.sigma_m * (2.0 * kind.alpha) ** 0.5  # short-horizon random walk of a Gauss-Markov drift
        return (
            f"<!-- {unit} -->\n"
            f"<{prefix}NoiseDensity>{kind.N:.6e}</{prefix}NoiseDensity>\n"
            f"<{prefix}RandomWalk>{step:.6e}</{prefix}RandomWalk>\n"
            f"<{prefix}BiasCorrelationTime>{1.0 / kind.alpha:.6e}</{prefix}BiasCorrelationTime> <!-- s -->\n"
        )

    comment = _head("", gyro, accel).strip()
    return (
        f"<!-- {comment}\nupdate rate {rate_hz:g} Hz; turn-on bias is not identified by one recording -->\n"
        + lines("gyroscope", gyro, "rad/s")
        + lines("accelerometer", accel, "m/s^2")
    )


def _px4(gyro: Kind, accel: Kind, rate_hz: float) -> str:
    root = rate_hz**0.5
    return (
        _head("#", gyro, accel)
        + f"# discrete, at {rate_hz:g} Hz: noise = N sqrt(rate), bias noise = K sqrt(rate). A floor set by the sensor\n"
        + "# alone, not a tuning: vibration and everything else the filter must absorb come on top.\n"
        + f"param set EKF2_GYR_NOISE {gyro.N * root:.6e}  # rad/s\n"
        + f"param set EKF2_ACC_NOISE {accel.N * root:.6e}  # m/s^2\n"
        + f"param set EKF2_GYR_B_NOISE {gyro.K * root:.6e}  # rad/s^2\n"
        + f"param set EKF2_ACC_B_NOISE {accel.K * root:.6e}  # m/s^3\n"
    )


def _orbslam3(gyro: Kind, accel: Kind, rate_hz: float) -> str:
    return (
        "%YAML:1.0\n"
        + _head("#", gyro, accel)
        + f"IMU.NoiseGyro: {gyro.N:.6e}  # rad/s/sqrt(Hz)\n"
        + f"IMU.NoiseAcc: {accel.N:.6e}  # m/s^2/sqrt(Hz)\n"
        + f"IMU.GyroWalk: {gyro.K:.6e}  # rad/s^2/sqrt(Hz)\n"
        + f"IMU.AccWalk: {accel.K:.6e}  # m/s^3/sqrt(Hz)\n"
        + f"IMU.Frequency: {rate_hz:g}  # Hz\n"
    )


def _vins(gyro: Kind, accel: Kind, rate_hz: float) -> str:
    root = rate_hz**0.5
    values = (
        ("acc_n", accel.N, accel.N * root, "m/s^2"),
        ("gyr_n", gyro.N, gyro.N * root, "rad/s"),
        ("acc_w", accel.K, accel.K / root, "m/s^2"),
        ("gyr_w", gyro.K, gyro.K / root, "rad/s"),
    )
    body = "".join(
        f"{name}: {continuous:.6e}  # continuous; per sample at {rate_hz:g} Hz: {discrete:.6e} {unit}\n"
        for name, continuous, discrete, unit in values
    )
    return "%YAML:1.0\n" + _head("#", gyro, accel) + body


#: Name on the command line to writer.
FORMS: dict[str, Callable[[Kind, Kind, float], str]] = {
    "kalibr": _kalibr,
    "rotors": _rotors,
    "px4": _px4,
    "orbslam3": _orbslam3,
    "vins": _vins,
}

