"""Noise models as small state models: which terms a model has, and the matrices that its parameters make.

Everything is relative to the white noise of one sample (standard deviation 1), at the recording's own rate. Parameters
are a vector of unbounded numbers: logarithms of sizes and rates, atanh of correlations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from selfcal.base.grid import Array
from selfcal.model.file import ABOUT_N
from selfcal.model.laws import DAMPING_LIMITS, lost_of, swing

#: A Gauss-Markov drift keeps within the default model's correlation rates, 1/s: faster ones are coloured noise.
ALPHA_LIMITS = ABOUT_N["alpha"][:2]
#: Sizes relative to the white noise of one sample.
SIZE_LIMITS = (1e-5, 1e2)
#: A drift that oscillates keeps within these periods, s: faster ones are a band.
PERIOD_LIMITS = (20.0, 3000.0)
#: Parameters that size a term of the drift.
DRIFT_SIZES = ("ln_rho", "ln_markov", "ln_flicker")


@dataclass(frozen=True)
class Terms:
    """The terms of a noise model beside white noise: the drift's, 1/f noise, a damped oscillator that white noise
    drives, and the colour of the white noise.

    `bands`: further oscillators, each with its period in s, damping and ln of its size, all fixed: refitting them with
    every later cause would cost much and change little."""

    walk: bool = False
    markov: bool = False
    flicker: bool = False
    oscillation: bool = False
    color: Literal["", "ma", "ar"] = ""
    bands: tuple[tuple[float, float, float], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the vector's order."""
        names: list[str] = []
        names += ["ln_rho"] if self.walk else []
        names += ["ln_markov", "ln_alpha"] if self.markov else []
        names += ["ln_flicker"] if self.flicker else []
        names += ["ln_swing", "ln_period", "ln_damping"] if self.oscillation else []
        names += ["color"] if self.color else []
        return tuple(names)

    def limits(self, dt: float) -> list[tuple[float, float]]:
        """Low and high of each parameter; dt: sampling interval, s."""
        size = (math.log(SIZE_LIMITS[0]), math.log(SIZE_LIMITS[1]))
        found: list[tuple[float, float]] = []
        for name in self.names:
            if name == "ln_alpha":
                found.append((math.log(ALPHA_LIMITS[0]), math.log(ALPHA_LIMITS[1])))
            elif name == "ln_period":
                found.append((math.log(2.1 * dt), math.log(max(PERIOD_LIMITS[1], 20.0 * dt))))
            elif name == "ln_damping":
                found.append((math.log(1e-5), math.log(DAMPING_LIMITS[1])))
            elif name == "color":
                found.append((-2.6, 2.6))
            else:
                found.append(size)
        return found


@dataclass(frozen=True)
class Matrices:
    """Transition F, process noise Q, observation h, first covariance P0, and the variance R of the white noise.

    `driver`: the state that white noise with memory enters by, -1 without. `lost`: white noise that a mean of half of
    its readings has beyond twice R."""

    F: Array
    Q: Array
    h: Array
    P0: Array
    R: float
    driver: int = -1
    lost: float = 0.0


@lru_cache(maxsize=64)
def flicker_rates(duration_s: float, dt: float) -> tuple[float, ...]:
    """Correlation rates, 1/s, of the Gauss-Markov terms that together make 1/f noise over a record: a decade apart or a
    little less, from a third of a turn in the record to a sixth of the sampling rate. White noise makes up what lacks
    above; a faster term would only alias, and a sensor that averages has no such power."""
    low, high = math.log10(2.0 / duration_s), math.log10(1.0 / dt)
    count = max(2, min(8, 1 + math.ceil(high - low)))
    return tuple(float(rate) for rate in np.logspace(low, high, count))


def matrices(terms: Terms, theta: Array, dt: float, duration_s: float, block: int = 1) -> Matrices:
    """The state model of `terms` at the parameters `theta`, for means of `block` readings.

    Flicker noise of coefficient B has the two-sided spectrum B^2 / (2 pi f), as in `simulate` and in IEEE 952. Terms of
    variance v whose rates are a factor g apart make v / (2 ln g f), so v = B^2 ln g / pi.
    """
    value = dict(zip(terms.names, map(float, theta), strict=True))
    swings = list(terms.bands)
    if terms.oscillation:
        swings.append((math.exp(value["ln_period"]), math.exp(value["ln_damping"]), value["ln_swing"]))
    rates = flicker_rates(duration_s, dt) if terms.flicker else ()
    pairs = len(swings) + (terms.color == "ma")
    single = terms.walk + terms.markov + len(rates) + (terms.color == "ar")
    size = max(1, single + 2 * pairs)
    F, Q, P0, h = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
    R, driver, k, lost = 1.0, -1, 0, 0.0

    def markov(variance: float, rate: float) -> None:
        nonlocal k, lost
        F[k, k] = math.exp(-rate * dt)
        Q[k, k] = -variance * math.expm1(-2.0 * rate * dt)
        P0[k, k] = variance
        h[k] = 1.0
        lost += variance * lost_of(rate * dt, block)
        k += 1

    if terms.walk:
        F[k, k] = h[k] = 1.0
        Q[k, k] = math.exp(2.0 * value["ln_rho"])
        lost += Q[k, k] * lost_of(0.0, block)
        k += 1
    if terms.markov:
        markov(math.exp(2.0 * value["ln_markov"]), math.exp(value["ln_alpha"]))
    if terms.flicker:
        apart = math.log(rates[1] / rates[0])
        for rate in rates:
            markov(math.exp(2.0 * value["ln_flicker"]) * apart / math.pi, rate)
    if terms.color == "ar":  # the white noise itself is a first-order process
        f = math.tanh(value["color"])
        F[k, k], Q[k, k], P0[k, k], h[k] = f, 1.0 - f * f, 1.0, 1.0
        R, driver, k = 1e-9, k, k + 1
    if terms.color == "ma":  # e_i + theta e_(i-1)
        m = math.tanh(value["color"])
        unit = 1.0 / (1.0 + m * m)
        F[k + 1, k] = 1.0
        Q[k, k] = P0[k, k] = P0[k + 1, k + 1] = unit
        h[k], h[k + 1] = 1.0, m
        R, driver, k = 1e-9, k, k + 2
    for period, damping, ln_size in swings:
        turn_of, variance = swing(period, damping, dt), math.exp(2.0 * ln_size)
        F[k : k + 2, k : k + 2] = turn_of
        Q[k : k + 2, k : k + 2] = variance * (np.eye(2) - turn_of @ turn_of.T)
        P0[k, k] = P0[k + 1, k + 1] = variance
        h[k] = 1.0
        k += 2
    return Matrices(F, Q, h, P0, R, driver, lost)
