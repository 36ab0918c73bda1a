"""Simulated parts: inertial sensors whose drift law and bias are known, and what their data sheet says of them."""

from __future__ import annotations

import math

import numpy as np
from scipy import signal

from selfcal.base.grid import Array
from selfcal.base.units import SENSOR_UNITS, STANDARD_GRAVITY

#: Axes of a part, and the unit of each.
AXES = SENSOR_UNITS
#: The truths by unit and law: what `identify` finds on an ADIS16405 (README), rounded; s.
TRUTHS: dict[str, dict[str, dict[str, float]]] = {
    "deg/s": {
        "constant": {"N": 0.04},
        "random_walk": {"N": 0.04, "K": 1.4e-3},
        "gauss_markov": {"N": 0.04, "sigma_m": 0.02, "alpha": 1.0 / 200.0},
    },
    "m/s^2": {
        "constant": {"N": 5e-3},
        "random_walk": {"N": 5e-3, "K": 8e-4},
        "gauss_markov": {"N": 5e-3, "sigma_m": 0.01, "alpha": 1.0 / 300.0},
    },
}
LAWS = tuple(TRUTHS["deg/s"])
#: sd of the turn-on bias: the data sheet's initial bias errors, 3 deg/s and 50 mg.
TURN_ON = {"deg/s": 3.0, "m/s^2": 0.05 * STANDARD_GRAVITY}
#: The ADIS16405's data sheet: random walk 2 deg/sqrt(h) and 0.2 m/s/sqrt(h), in-run bias stability 0.007 deg/s and 0.2
#: mg.
SHEET_N = {"deg/s": 2.0 / 60.0, "m/s^2": 0.2 / 60.0}
SHEET_STABILITY = {"deg/s": 0.007, "m/s^2": 0.2e-3 * STANDARD_GRAVITY}
#: Time in which a filter designer lets the bias walk by its stability, s.
SHEET_TIME_S = 100.0


def generator(law: str, seed: int, stream: int) -> np.random.Generator:
    """Random numbers of a part: a stream for each of AXES, and those after them for what else is drawn."""
    return np.random.default_rng([seed, LAWS.index(law), stream])


def simulate_axis(law: str, samples: int, seed: int, *, axis: str = "gx", rate_hz: float = 1.0) -> tuple[Array, Array]:
    """Readings of an axis, means over 1 / `rate_hz`, and the bias in them, both [samples]; units of AXES.

    The bias is the turn-on bias and a drift that stands still for the time of a reading.
    """
    rng, unit = generator(law, seed, list(AXES).index(axis)), AXES[axis]
    truth = TRUTHS[unit][law]
    steps = rng.standard_normal(samples)
    drift = np.zeros(samples)
    if law == "random_walk":
        drift = truth["K"] / math.sqrt(rate_hz) * np.cumsum(steps)
    elif law == "gauss_markov":
        phi = math.exp(-truth["alpha"] / rate_hz)
        steps[1:] *= math.sqrt(1.0 - phi**2)
        drift = truth["sigma_m"] * signal.lfilter([1.0], [1.0, -phi], steps)
    bias = TURN_ON[unit] * rng.standard_normal() + drift
    return bias + truth["N"] * math.sqrt(rate_hz) * rng.standard_normal(samples), bias
