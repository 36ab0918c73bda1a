"""Noise models as small state models: which terms a model has, and the matrices that its parameters make.

Everything is relative to the white noise of a sample (standard deviation 1), at the recording's own rate. Parameters
are a vector of unbounded numbers: logarithms of sizes and rates, atanh of correlations.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np

from selfcal.base.grid import Array, Mask
from selfcal.model.file import ABOUT_N
from selfcal.model.laws import DAMPING_LIMITS, lost_of, swing

#: Limits of a Gauss-Markov drift's correlation rate, 1/s, from the default model: faster noise is coloured noise.
ALPHA_LIMITS = ABOUT_N["alpha"][:2]
#: Limits of the period of a drift that oscillates, s: a faster oscillation is a band.
PERIOD_LIMITS = (20.0, 3000.0)
#: Limits of ln of a size relative to the white noise of a sample.
LN_SIZE = (math.log(1e-5), math.log(1e2))


@dataclass(frozen=True)
class Parameter:
    """A number of a term: the field of `Terms` that it belongs to, its limits, where a fit starts (without: at the
    middle), and where a fit starts that takes over another model's numbers.

    `grows`: a size over the white noise of a mean goes as this power of its samples; 0 for another number. `drift`: a
    size of the drift, so that a smaller drift has less of it."""

    term: str
    limits: tuple[float, float]
    starts: tuple[float, ...] = ()
    fresh: float = 0.0
    grows: float = 0.0
    drift: bool = False


#: In the vector's order.
PARAMETERS = {
    "ln_rho": Parameter("walk", LN_SIZE, (-4.0, -8.0), -6.0, grows=1.0, drift=True),
    "ln_markov": Parameter("markov", LN_SIZE, (-1.5,), -2.5, grows=0.5, drift=True),
    "ln_alpha": Parameter("markov", (math.log(ALPHA_LIMITS[0]), math.log(ALPHA_LIMITS[1])), (-6.0, -4.0, -2.0), -4.0),
    "ln_flicker": Parameter("flicker", LN_SIZE, (-2.0, -6.0), -3.0, grows=0.5, drift=True),
    "ln_swing": Parameter("oscillation", LN_SIZE, grows=0.5),
    "ln_period": Parameter("oscillation", (-math.inf, math.log(PERIOD_LIMITS[1]))),  # see `limits`
    "ln_damping": Parameter("oscillation", (math.log(1e-5), math.log(DAMPING_LIMITS[1]))),
    "color": Parameter("color", (-2.6, 2.6), (0.2, -0.2), 0.2),
}


@dataclass(frozen=True)
class Terms:
    """The terms of a noise model besides white noise: the drift's, 1/f noise, a damped oscillator that white noise
    drives, and the colour of the white noise.

    `bands`: further oscillators, each with its period in s, damping and ln of its size, all fixed: refitting them with
    every later cause would cost much and change little."""

    walk: bool = False
    markov: bool = False
    flicker: bool = False
    oscillation: bool = False
    color: Literal["", "ma", "ar"] = ""
    bands: tuple[tuple[float, float, float], ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the vector's order."""
        return tuple(name for name, parameter in PARAMETERS.items() if getattr(self, parameter.term))

    @cached_property
    def sizes(self) -> Mask:
        """Mask of the parameters that are ln of sizes of the drift."""
        return np.array([PARAMETERS[name].drift for name in self.names], bool)

    @cached_property
    def growth(self) -> Array:
        """Powers by which the parameters' sizes grow in means, see `Parameter`."""
        return np.array([PARAMETERS[name].grows for name in self.names])

    @property
    def all_scales(self) -> bool:
        """Whether a term has all time scales: a drift of two terms then adds nothing."""
        return self.flicker

    @property
    def slow(self) -> dict[str, Any]:
        """The fields of terms that means show as well: those with a size that grows in them."""
        return {each.term: getattr(self, each.term) for each in PARAMETERS.values() if each.grows}

    def limits(self, dt: float) -> list[tuple[float, float]]:
        """Low and high of each parameter; dt: sampling interval, s."""
        period = (math.log(2.1 * dt), max(PARAMETERS["ln_period"].limits[1], math.log(20.0 * dt)))
        return [period if name == "ln_period" else PARAMETERS[name].limits for name in self.names]


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


class _Part(NamedTuple):
    """States of a term [m], as in `Matrices`; a number is the matrix of a single state."""

    states: int
    F: Array | float
    Q: Array | float
    P0: Array | float
    h: Array | float = 1.0
    lost: float = 0.0
    driver: bool = False


def _parts(terms: Terms, value: Mapping[str, float], dt: float, duration_s: float, block: int) -> Iterator[_Part]:
    """The terms' states, term by term. A kind of noise is a branch here and its rows of PARAMETERS."""

    def markov(variance: float, rate: float) -> _Part:
        lost = variance * lost_of(rate * dt, block)
        return _Part(1, math.exp(-rate * dt), -variance * math.expm1(-2.0 * rate * dt), variance, lost=lost)

    if terms.walk:
        step = math.exp(2.0 * value["ln_rho"])
        yield _Part(1, 1.0, step, 0.0, lost=step * lost_of(0.0, block))
    if terms.markov:
        yield markov(math.exp(2.0 * value["ln_markov"]), math.exp(value["ln_alpha"]))
    if terms.flicker:
        rates = flicker_rates(duration_s, dt)
        apart = math.log(rates[1] / rates[0])
        for rate in rates:
            yield markov(math.exp(2.0 * value["ln_flicker"]) * apart / math.pi, rate)
    if terms.color == "ar":  # the white noise itself is a first-order process
        f = math.tanh(value["color"])
        yield _Part(1, f, 1.0 - f * f, 1.0, driver=True)
    if terms.color == "ma":  # e_i + theta e_(i-1)
        m = math.tanh(value["color"])
        unit = 1.0 / (1.0 + m * m)
        yield _Part(2, np.eye(2, k=-1), np.diag([unit, 0.0]), unit * np.eye(2), np.array([1.0, m]), driver=True)
    swings = list(terms.bands)
    if terms.oscillation:
        swings.append((math.exp(value["ln_period"]), math.exp(value["ln_damping"]), value["ln_swing"]))
    for period, damping, ln_size in swings:
        turn_of, variance = swing(period, damping, dt), math.exp(2.0 * ln_size)
        first = variance * np.eye(2)
        yield _Part(2, turn_of, variance * (np.eye(2) - turn_of @ turn_of.T), first, np.array([1.0, 0.0]))


def matrices(terms: Terms, theta: Array, dt: float, duration_s: float, block: int = 1) -> Matrices:
    """The state model of `terms` at the parameters `theta`, for means of `block` readings.

    Flicker noise of coefficient B has the two-sided spectrum B^2 / (2 pi f), as in `simulate` and in IEEE 952. Terms of
    variance v whose rates are a factor g apart make v / (2 ln g f), so v = B^2 ln g / pi.
    """
    parts = list(_parts(terms, dict(zip(terms.names, map(float, theta), strict=True)), dt, duration_s, block))
    size = max(1, sum(part.states for part in parts))
    F, Q, P0, h = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
    R, driver, lost, end = 1.0, -1, 0.0, 0
    for part in parts:
        start, end = end, end + part.states
        own = slice(start, end)
        F[own, own], Q[own, own], P0[own, own], h[own] = part.F, part.Q, part.P0, part.h
        lost += part.lost
        if part.driver:
            R, driver = 1e-9, start
    return Matrices(F, Q, h, P0, R, driver, lost)
