"""Records of one axis that the tests of a cause draw, sample by sample in numpy, and their counts.

N 0.04, a walk of K 3e-4 or a Gauss-Markov drift of 0.012 and 250 s.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.signal import lfilter
from scipy.stats import binom

from selfcal.base.grid import Array
from selfcal.diagnosis.record import Record
from selfcal.likelihood.state import State

N, K, SIGMA_M, TIME_S = 0.04, 3e-4, 0.012, 250.0
LAWS = ("walk", "markov")


def noise(random: np.random.Generator, law: str, n: int, rate: float) -> Array:
    """[n]: white noise beside the drift."""
    dt = 1.0 / rate
    white = N / math.sqrt(dt) * random.standard_normal(n)
    if law == "walk":
        return white + K * math.sqrt(dt) * random.standard_normal(n).cumsum()
    phi = math.exp(-dt / TIME_S)
    kick = SIGMA_M * math.sqrt(1.0 - phi * phi) * random.standard_normal(n)
    kick[0] = SIGMA_M * random.standard_normal()
    return np.asarray(white + lfilter([1.0], [1.0, -phi], kick))


def of_one(random: np.random.Generator, n: int, walk: float = 0.01, time_s: float = 250.0) -> Array:
    """[n] at 1 Hz: white noise of 1 beside a walk or a Gauss-Markov drift of 0.3."""
    white = random.standard_normal(n)
    if random.random() < 0.5:
        return white + walk * random.standard_normal(n).cumsum()
    keep, drift, x = math.exp(-1.0 / time_s), np.zeros(n), 0.3 * random.standard_normal()
    for k in range(n):
        drift[k] = x
        x = keep * x + 0.3 * math.sqrt(1.0 - keep**2) * random.standard_normal()
    return np.asarray(white + drift)


def fitted(y: Array) -> State:
    """The state of a gyro at 1 Hz."""
    return State("gx", "deg/s", y, 1.0, 0.0, np.ones(y.size)).refit()


def recorded(y: Array, rate: float) -> tuple[State, Record]:
    level = float(np.median(y))
    state = State("gx", "deg/s", y - level, 1.0 / rate, level, np.ones(y.size)).refit()
    return state, Record(rate, {"gx": state}, {}, {}, np.isfinite(y), recorded_hz=rate)


def assert_held(held: Mapping[str, Sequence[bool]], what: str) -> None:
    """Of each key 90 % hold the truth, the lower tail of the binomial not below 1 in 1000."""
    for key, each in held.items():
        print(f"{key}, {what}: {sum(each)} of {len(each)} in the 90 % interval")
        assert binom.cdf(sum(each), len(each), 0.9) > 1e-3, key
