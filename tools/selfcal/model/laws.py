"""Laws as data: a law is the terms of its drift and the kind of its white noise.

In C it is `selfcal_law_t` (lib/selfcal_tables.h).
`NAMED` holds the laws that a model file may give by name alone. A model file states any other law as a list of terms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from selfcal import _library32
from selfcal.base.grid import Array

#: Most terms of a law, states of its drift and coloured noise together.
MOST_TERMS: int = _library32.TERMS_MAX
#: Limits of the factors of a deviation and a bandwidth.
FACTORS: tuple[float, float] = _library32.FACTORS
#: Parameters of every group's priors, in the order of `selfcal_parameter_t`.
PARAMETERS = ("N", "K", "sigma_m", "alpha")
#: Place of each parameter there. No law has two at a place.
PLACES = {"N": 0, "K": 1, "sigma_m": 2, "B": 2, "alpha": 3, "spectral_ratio": 3, "markov_ratio": 3}
#: Parameters without a unit, and their limits: beyond, 1 + theta or 1 - theta is no longer a float.
RATIOS = ("spectral_ratio", "markov_ratio")
RATIO_LIMITS: tuple[float, float] = _library32.RATIOS

#: Correlation times in an interval beyond which the means of a drift count as white: neighbours' correlate by 0.02.
FORGOTTEN = 20.0

#: Least bank intervals in a period of an oscillation, and limits of its damping ratio.
SWING_LEAST: float = _library32.PERIOD_MIN
DAMPING_LIMITS: tuple[float, float] = _library32.DAMPINGS
#: Limits of a correlation time, bank intervals.
TIMES: tuple[float, float] = _library32.TIMES
#: (kind, deviation, bandwidth, stated, by_ratio) of each term, and whether the noise is coloured: for the bindings.
LawTuple = tuple[list[tuple[int, float, float, bool, bool]], bool]


@dataclass(frozen=True)
class Term:
    """A term of a drift. `deviation` multiplies the law's drift parameter, with `by_ratio` the law's ratio does too.

    `bandwidth` of a Gauss-Markov term multiplies alpha; if `stated` it is the bandwidth itself, 1/s. Of an oscillation
    it is 2 pi / period, always stated, and `damping` the damping ratio.
    """

    kind: str  # a name of KINDS
    deviation: float = 1.0
    bandwidth: float = 1.0
    stated: bool = False
    by_ratio: bool = False
    damping: float = 0.0


class Sized(NamedTuple):
    """A term at values of its law's parameters, numbers or arrays: `variance` of a step in 1 s of a walk, at the `rate`
    0, else the stationary variance. Of an oscillation `rate` is 2 pi / period."""

    kind: str
    variance: Any
    rate: Any
    damping: float


#: A term in readings: the variance of a walk's step, variances and rates a reading of Gauss-Markov drifts, and the
#: white noise that the means lack. An oscillation is the real part of a drift of complex numbers.
Averages = tuple[float, tuple[tuple[complex, complex], ...], float]
#: Weight of each state now in a term some time on, and the variance that the term gains until then.
Later = tuple[tuple[Array, ...], Array]


@dataclass(frozen=True)
class TermKind:
    """A kind of term: all that tools/ knows of it.

    `later(term, time_s)` and `averages(term, dt_s, block)`: the term ahead, and in means of `block` readings. `keys`:
    entries of a term in a model file, apart from kind and deviation. `time`: the entry of its time, which is `turn`
    over the bandwidth and within `times` bank intervals; "" without a time. `needs_time`: an unknown time is refused.
    `read`: weight of each state in a reading. `counts`: remark on a law with too many terms.
    """

    later: Callable[[Sized, float], Later]
    averages: Callable[[Sized, float, int], Averages]
    keys: tuple[str, ...] = ()
    time: str = ""
    turn: float = 1.0
    times: tuple[float, float] = TIMES
    needs_time: bool = False
    read: tuple[float, ...] = (1.0,)
    counts: str = ""


def _walk_later(term: Sized, time_s: float) -> Later:
    return (np.ones(np.shape(term.variance)),), term.variance * time_s


def _walk_averages(term: Sized, dt_s: float, block: int) -> Averages:
    step = term.variance * dt_s
    return step, (), (1.0 - 1.0 / block**2) * step / 6.0


def _markov_later(term: Sized, time_s: float) -> Later:
    kept = np.exp(-term.rate * time_s) * np.ones(np.shape(term.variance))
    return (kept,), -term.variance * np.expm1(-2.0 * term.rate * time_s)


def _markov_averages(term: Sized, dt_s: float, block: int) -> Averages:
    gain, without = averaged(term.rate * dt_s, block)
    return 0.0, ((term.variance * gain, term.rate * dt_s),), term.variance * without


def _oscillation_later(term: Sized, time_s: float) -> Later:
    row = swing(2.0 * math.pi / term.rate, term.damping, time_s)[0]
    kept = tuple(np.full(np.shape(term.variance), share) for share in row)
    return kept, term.variance * (1.0 - float(row @ row))


def _oscillation_averages(term: Sized, dt_s: float, block: int) -> Averages:
    x, share = term.rate * dt_s, math.sqrt(1.0 - term.damping**2)
    variance = term.variance * (1.0 - x**2 * (1.0 - 1.0 / block**2) / 12.0)
    return 0.0, ((variance * complex(1.0, -term.damping / share), x * complex(term.damping, -share)),), 0.0


#: Kinds of terms, in the order of `selfcal_term_kind_t`.
KINDS: dict[str, TermKind] = {
    "walk": TermKind(_walk_later, _walk_averages),
    "markov": TermKind(_markov_later, _markov_averages, ("bandwidth", "correlation_time_s"), "correlation_time_s"),
    "oscillation": TermKind(
        _oscillation_later,
        _oscillation_averages,
        ("period_s", "damping"),
        "period_s",
        2.0 * math.pi,
        (SWING_LEAST, 2.0 * math.pi * TIMES[1]),
        needs_time=True,
        read=(1.0, 0.0),
        counts="an oscillation counts as two",
    ),
}
#: Names of `selfcal_term_kind_t`. An oscillation is followed by its damping.
KIND_CODES = (*KINDS, "damping")


@dataclass(frozen=True)
class Law:
    """A law by its terms. `drift_name` is the drift parameter's name where it is neither K nor sigma_m."""

    terms: tuple[Term, ...] = ()
    coloured_noise: bool = False
    drift_name: str = ""

    @property
    def has_walk(self) -> bool:
        """Its drift parameter is K."""
        return any(term.kind == "walk" for term in self.terms)

    @property
    def read(self) -> tuple[float, ...]:
        """Weight of each state of the drift in a reading: 0 of the second state of an oscillation."""
        return tuple(share for term in self.terms for share in KINDS[term.kind].read)

    @property
    def has_alpha(self) -> bool:
        """A bandwidth is unknown."""
        return any(KINDS[term.kind].time and not term.stated for term in self.terms)

    @property
    def second(self) -> str:
        """Name of the second parameter: alpha, a ratio, or "" if the law has neither."""
        if self.coloured_noise:
            return "spectral_ratio"
        if any(term.by_ratio for term in self.terms):
            return "markov_ratio"
        return "alpha" if self.has_alpha else ""

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """Names of its parameters: N, the drift parameter, the second parameter; those it has."""
        drift = self.drift_name or ("K" if self.has_walk else "sigma_m") if self.terms else ""
        return tuple(name for name in ("N", drift, self.second) if name)

    @cached_property
    def is_sum(self) -> bool:
        """Whether the law needs the filters for several states: `selfcal_law_is_sum()`."""
        plain = (Term("walk"), Term("markov"))
        return self.coloured_noise or len(self.terms) > 1 or any(term not in plain for term in self.terms)

    @cached_property
    def as_tuple(self) -> LawTuple:
        """For the bindings."""
        terms = []
        for t in self.terms:
            terms.append((KIND_CODES.index(t.kind), t.deviation, self.bandwidth(t), t.stated, t.by_ratio))
            if t.kind == "oscillation":
                terms.append((KIND_CODES.index("damping"), t.deviation, t.damping * t.bandwidth, t.stated, t.by_ratio))
        return terms, self.coloured_noise

    @staticmethod
    def bandwidth(term: Term) -> float:
        """Bandwidth of a term in lib/selfcal_tables.h: 0 of a walk."""
        return 0.0 if term.kind == "walk" else term.bandwidth

    def node(self, parameters: Mapping[str, float]) -> tuple[float, float]:
        """Drift and second parameter from values by name; 0 and 1 where the law has none."""
        drift, second = (*self.parameters[1:], "", "")[:2]
        return parameters[drift] if drift else 0.0, parameters[second] if second else 1.0

    def noise(self, variance: float, second: float) -> tuple[float, float]:
        """Variance of the white noise in readings (without colour `variance`), and its correlation at one reading."""
        if not self.coloured_noise:
            return variance, 0.0
        theta = (second - 1.0) / (second + 1.0)
        return variance * (1.0 + theta**2) / (1.0 + theta) ** 2, theta / (1.0 + theta**2)

    def sized(self, drift: Any, second: Any) -> Iterator[Sized]:
        """Each term at the drift parameter and the second one, as `node` has them. With a walk the drift parameter is
        K, and a term of rate w has the deviation K / sqrt(w)."""
        for term in self.terms:
            rate = self.bandwidth(term) * (1.0 if term.stated else second)
            deviation = term.deviation * drift * (second if term.by_ratio else 1.0)
            over = rate if self.has_walk and term.kind != "walk" else 1.0
            yield Sized(term.kind, deviation**2 / over, rate, term.damping)

    def with_time(self, correlation_time_s: float) -> Law:
        """The law with a correlation time for the term whose stated bandwidth is left open (NaN)."""
        bandwidth = 1.0 / correlation_time_s
        terms = (replace(t, bandwidth=bandwidth) if math.isnan(t.bandwidth) else t for t in self.terms)
        return replace(self, terms=tuple(terms))


def averaged(x: float, block: int) -> tuple[float, float]:
    """Means of a Gauss-Markov drift over `block` readings, `x` its bandwidth times the interval of a mean.

    They are a first-order process with white noise of a negative variance. Returns the process's variance and what
    the white noise lacks, both over the drift's own (lib/DESIGN.md, "Block means of the drift"). Of a walk of step
    variance q per interval the white noise lacks (1 - 1 / block^2) q / 6.
    """
    if block == 1:
        return 1.0, 0.0
    rate, phi = -block * math.expm1(-x / block), math.exp(-x / block)
    gain = phi * math.exp(min(x, FORGOTTEN)) * (math.expm1(-x) / rate) ** 2
    if x < 1e-3:  # right to x^2 / 20; the difference below would lose its digits
        return gain, (1.0 - 1.0 / block**2) * x / 3.0
    return gain, gain - (1.0 + phi + 2.0 * phi * math.expm1(-x) / rate) / rate


def swing(period_s: float, damping: float, time_s: float) -> Array:
    """[2, 2]: transition over `time_s` of x'' + 2 damping w x' + w^2 x = white noise, w = 2 pi / period_s.

    The states are x and x' / w: both have the stationary variance of x, and do not correlate."""
    w = 2.0 * math.pi / period_s
    share = math.sqrt(1.0 - damping * damping)
    decay, turn = math.exp(-damping * w * time_s), w * share * time_s
    c, s = decay * math.cos(turn), decay * math.sin(turn) / share
    return np.array([[c + damping * s, s], [-s, c - damping * s]])


def lost_of(x: float, block: int) -> float:
    """White noise that lost readings add to a mean of `block` readings, beyond its share, over r - 1.

    r is the block over the readings left, and `x` is as in averaged(). The number is relative to the variance of the
    first-order process; at x = 0, of a walk, to its step variance. No more of the drift's rest is missing, and the
    readings left, at random, scatter about the mean of all.
    """
    if block == 1:
        return 0.0
    if x == 0.0:
        return (1.0 + 1.0 / block) / 6.0
    if x > FORGOTTEN * block:
        return 1.0  # to exp(-x / block): readings that do not correlate, and a process that has hardly any variance
    gain, rest = averaged(x, block)
    return (rest + (1.0 - gain + rest) / (block - 1.0)) / gain


#: Laws that a model file may give by name. `walk_and_markov` takes its time from the model's correlation_time_s.
NAMED: dict[str, Law] = {
    "constant": Law(),
    "random_walk": Law((Term("walk"),)),
    "gauss_markov": Law((Term("markov"),)),
    # Its two-sided spectrum is B^2 / (2 pi f) within 16 % for 2 pi f between the outer bandwidths. In the mean over ln
    # f it is within 1 %. A factor of 10 comes nearer, but it covers less: on 1/f noise B came out 4 to 7 % too high.
    "flicker": Law(tuple(Term("markov", 0.96, ratio) for ratio in (0.0625, 1.0, 16.0)), drift_name="B"),
    "moving_average": Law((Term("walk"),), coloured_noise=True),
    "walk_and_markov": Law((Term("walk"), Term("markov", bandwidth=math.nan, stated=True, by_ratio=True))),
}
#: Laws of several terms, and laws of a single term, which are the paper's.
SUMS = tuple(name for name, law in NAMED.items() if law.is_sum)
PLAIN = tuple(name for name, law in NAMED.items() if not law.is_sum)


def named_law(name: str, correlation_time_s: float = math.nan) -> Law:
    """A named law; `correlation_time_s` is for walk_and_markov."""
    return NAMED[name].with_time(correlation_time_s)
