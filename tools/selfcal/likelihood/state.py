"""State of an axis at a point of the loop: its record, the model so far, and the gain of a candidate."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc, logsumexp, ndtr, softmax

from selfcal.bank.axis_result import HALF_90, of_mixture
from selfcal.base.errors import UserError
from selfcal.base.grid import Array, Mask, block_means, half_means
from selfcal.likelihood.fit import FTOL, Fit, Series, Sums, best, fit, ln_likelihood, moved, nodes, refit, run
from selfcal.likelihood.statemodel import PARAMETERS, PERIOD_LIMITS, Terms
from selfcal.readings.budget import OF_MODULES, P_LOOK
from selfcal.readings.lattice import OFF

if TYPE_CHECKING:
    from selfcal.likelihood.columns import Shape

#: Least evidence of a look at one axis that is named, net of its search, nats.
NET_LEAST = -math.log(P_LOOK)
#: Least evidence of all axes together that is named, nats: ln of a Bayes factor. Chance reaches T nats with probability
#: e^-T at most (Markov's inequality).
EVIDENT = -math.log(OF_MODULES["together"])
#: ln likelihood below the best fit, nats, at which a drift is not tried with a candidate; with a finding it is again.
HOPELESS_NATS = 40.0
#: Difference of worth, nats, below which two causes cannot be distinguished.
ALIKE = 3.0
#: Least score gain worth a refit, nats: below, the refit gains about as much.
SCREEN = 2.0
#: Most columns of a pass of the filter, without the model's.
ABREAST = 8
#: Means of a record that are enough for a first search; the longest mean in which a slow column is whole, s.
MEANS_MOST, SLOW_S = 3000, 1.0


#: No term other than white noise and the drift.
NONE = Terms()
#: ln evidence [marks] of the samples before each mark; by horizon the bias that is predicted from each of its places.
Sequential = tuple[Array, Mapping[float, Array]]


@dataclass(frozen=True)
class FittedColumn:
    """A column that is in an axis' model. `entry` is the model file's (without prior), empty if the file cannot state
    the column; `unit` the column's."""

    name: str
    cause: str
    values: Array
    unit: str
    entry: Mapping[str, Any]


@dataclass(frozen=True)
class State:
    """An axis: the record `y` on its grid (NaN: missing or kept out), the regressors and extras of its model so far.

    `fits`: the fit of every base drift; `whitened` float64[n]: residual innovations of the best fit, `variance` [n]
    theirs. `redrawn`: not all values are as read: clipped values were drawn anew, or they are block means.
    `below_lattice`: the noise of a reading is so far below the lattice that rounding is no noise, and no linear model
    judges the axis. `lsb`: the lattice the values lie on (0: no lattice), `stated_lsb` the model file's. `ftol`: of its
    fits, `block`: readings of a mean, see Series.
    """

    axis: str
    unit: str
    y: Array
    dt: float
    level: float
    r: Array
    regressors: tuple[FittedColumn, ...] = ()
    extras: Terms = NONE
    lsb: float = 0.0
    stated_lsb: float = 0.0
    fits: tuple[Fit, ...] = ()
    whitened: Array = field(default_factory=lambda: np.empty(0))
    variance: Array = field(default_factory=lambda: np.empty(0))
    redrawn: bool = False
    below_lattice: bool = False
    ftol: float = FTOL
    block: int = 1

    @property
    def series(self) -> Series:
        columns = np.vstack([np.ones(self.y.size), *(regressor.values for regressor in self.regressors)])
        return Series(self.y, self.dt, self.r, np.ascontiguousarray(columns), self.ftol, self.block)

    def means(self, longest_s: float = math.inf) -> tuple[Series, int]:
        """Means of blocks of `longest_s` at most, NaN where half of a block is missing, and the samples of a block."""
        n = self.y.size
        block = max(1, int(min(n // MEANS_MOST, longest_s / self.dt)))
        mean, used = half_means(self.y, block)
        r, columns = block_means(self.r, block), block_means(self.series.columns, block)
        return Series(mean, self.dt * block, r * block / np.maximum(used, 1), columns), block

    @property
    def best(self) -> Fit:
        return best(self.fits)

    @property
    def lattice_is_stated(self) -> bool:
        """Whether the model file states the lattice that the values lie on."""
        return self.stated_lsb > 0.0 and abs(self.lsb / self.stated_lsb - 1.0) < OFF

    def masked(self, mask: Mask) -> State:
        """The state without the samples of `mask` [n]."""
        return replace(self, y=np.where(mask, np.nan, self.y)) if mask.any() else self

    @property
    def rest(self) -> Array:
        """The record [n] less its level and the columns of the fitted model."""
        return np.asarray(self.y - self.best.c @ self.series.columns)

    def less_of(self, channel: str) -> Array:
        """The record [n] less the columns that the model has of a channel, in a fit with them."""
        own = [k for k, regressor in enumerate(self.regressors, 1) if regressor.entry.get("column") == channel]
        return self.y - self.best.c[own] @ self.series.columns[own] if own and self.fits else self.y

    def bases(self) -> tuple[Terms, ...]:
        """The drifts that the model may have, with its extras: the paper's laws; walk includes the constant."""
        return (replace(self.extras, walk=True), replace(self.extras, markov=True))

    def near(self) -> tuple[Terms, ...]:
        """The drifts that a candidate may make the best."""
        least = self.best.ln_likelihood - HOPELESS_NATS
        far = {drift.terms for drift in self.fits if drift.ln_likelihood < least}
        return tuple(terms for terms in self.bases() if terms not in far)

    def refit(self, **changes: Any) -> State:
        """The state with `changes`, fitted. UserError where no model has a likelihood."""
        state = replace(self, **changes)
        series = state.series
        fits = tuple(_fit_from(series, terms, state.fits) for terms in state.bases())
        if not math.isfinite(best(fits).ln_likelihood):
            raise UserError(
                f"{self.axis}: no noise model fits these readings: leave out the time in which the sensor did not rest"
            )
        state = replace(state, fits=fits)
        chosen = state.best
        _, white, s = run(series, chosen.terms, chosen.theta, innovations=True)
        residual = (white[:, 0] - white[:, 1:] @ chosen.c) / chosen.sigma
        return replace(state, whitened=residual, variance=s * chosen.sigma**2)

    def without(self, names: Collection[str]) -> State:
        """The state without some columns. Its fits still have the columns: the next fit starts there."""
        return replace(
            self, regressors=tuple(regressor for regressor in self.regressors if regressor.name not in names)
        )

    def first(self, samples: int) -> State:
        """The state of the first samples alone, fitted by itself."""
        cut = tuple(replace(regressor, values=regressor.values[:samples]) for regressor in self.regressors)
        return replace(self, y=self.y[:samples], r=self.r[:samples], regressors=cut, fits=()).refit()

    def stiffer(self, by: float) -> list[Fit]:
        """The best fit with a drift smaller by exp(-by), if it has a drift."""
        return [self.best.shrunk(by)] if self.best.terms.sizes.any() else []

    def with_columns(self, more: Array) -> tuple[float, Fit]:
        """Gain of ln likelihood by further columns [k, n], the drift refitted with them, and that fit."""
        fits = [self.fitted_with(terms, more) for terms in self.near()]
        return best(fits).ln_likelihood - self.best.ln_likelihood, best(fits)

    def with_terms(self, own: Mapping[str, float], less: float = 0.0, **terms: Any) -> tuple[float, tuple[Fit, ...]]:
        """Gain of ln likelihood by further terms of the noise, and the fit of every near drift with them: from the
        parameters `own` on, and from a drift smaller by exp(-less)."""
        near, fits = self.near(), []
        for drift in (drift for drift in self.fits if drift.terms in near):
            more = replace(drift.terms, **terms)
            fits.append(fit(self.series, more, moved(drift.shrunk(less), more, own)))
        return best(fits).ln_likelihood - self.best.ln_likelihood, tuple(fits)

    def fitted_with(self, terms: Terms, more: Array) -> Fit:
        """The fit of a drift with further columns [k, n]."""
        return _fit_from(self.series.beside(more), terms, self.fits)

    @cached_property
    def sequential(self) -> dict[bytes, Sequential]:
        """Known scores on held-out time, by their marks."""
        return {}

    @property
    def none(self) -> Array:
        """No further column [0, n]."""
        return np.empty((0, self.y.size))

    def possible(self, more: Array, *, rich: bool) -> Iterator[tuple[Fit, Array, float]]:
        """The fit of every near drift with further columns [k, n]; if `rich`, of a drift of two terms as well. With
        each fit the parameters that the record leaves possible, and ln of their prior share."""
        series = self.series.beside(more)
        fits = [self.fitted_with(terms, more) for terms in self.near()]
        if rich and not self.extras.all_scales:
            fits.append(refit(series, self.rich))
        for drift in fits:
            for theta, ln_share in nodes(series, drift):
                yield drift, theta, ln_share

    def posterior(self, *alternatives: Array) -> tuple[Array, Array, Array]:
        """Coefficients of further columns [k, n] over every near drift, a drift of two terms, and their parameters, as
        a sum of normals: weights [a, m], means [a, m, k] and standard deviations [a, m, k]. Each of the `alternatives`,
        the likeliest first, is a set of columns; before the record they are equally likely."""
        blocks = [np.atleast_2d(block) for block in alternatives]
        found: list[tuple[Array, Array, Array]] = []
        for drift, theta, ln_share in self.possible(blocks[0], rich=True):
            ln_weight, means, sds = [], [], []
            for sums in self.beside(drift.terms, theta, blocks):
                c, inverse, rss = sums.coefficients()
                sd = math.sqrt(rss / sums.n) * np.sqrt(np.maximum(np.diag(inverse), 1e-300))
                ln_weight.append(ln_share + ln_likelihood(sums) + float(np.log(sd).sum()))
                means.append(c)
                sds.append(sd)
            found.append((np.array(ln_weight), np.array(means), np.array(sds)))
        value = np.array([each[0] for each in found]).T
        places = [np.swapaxes(np.array([each[i] for each in found]), 0, 1) for i in (1, 2)]
        return np.exp(value - value.max()), places[0], places[1]

    @cached_property
    def slow(self) -> tuple[State, int]:
        """The axis in means of up to `SLOW_S`, which keep a slow column whole, and the samples of a mean."""
        series, block = self.means(SLOW_S)
        if block == 1:
            return self, 1
        columns = [
            replace(regressor, values=mean) for regressor, mean in zip(self.regressors, series.columns[1:], strict=True)
        ]
        bands = [  # sizes are relative to the white noise; faster bands average out
            (period, damping, ln_size + PARAMETERS["ln_swing"].grows * math.log(block))
            for period, damping, ln_size in self.extras.bands
            if period >= PERIOD_LIMITS[0]
        ]
        means = replace(self, y=series.y, dt=series.dt, r=series.r, block=block * self.block, fits=())
        return means.refit(regressors=tuple(columns), extras=replace(self.extras, bands=tuple(bands))), block

    @cached_property
    def ln_marginal(self) -> float:
        """ln likelihood of the record over every near drift, a drift of two terms, and their parameters."""
        each = [
            ln_share + _ln_marginal(next(self.sums(drift.terms, theta, [self.none])))
            for drift, theta, ln_share in self.possible(self.none, rich=True)
        ]
        return float(logsumexp(each))

    def averaged(self, more: Array) -> tuple[Array, Array, Array]:
        """Gains [a] of ln likelihood by further columns [k, n] at every near drift, a drift of two terms, and their
        parameters; ln of the share that each has in the record's likelihood without the columns; and the last column's
        coefficients and variances there [a, 2]."""
        gains, shares, sizes = [], [], []
        for drift, theta, ln_share in self.possible(more, rich=True):
            less, sums = self.sums(drift.terms, theta, [self.none, more])
            c, inverse, rss = sums.coefficients()
            gains.append(max(0.0, ln_likelihood(sums) - ln_likelihood(less)))
            shares.append(ln_share + _ln_marginal(less))
            sizes.append((float(c[-1]), rss / sums.n * float(inverse[-1, -1])))
        return np.array(gains), np.array(shares) - self.ln_marginal, np.array(sizes)

    def average_gain(self, more: Array) -> float:
        """Gain by further slow columns [k, n] averaged over the drifts that the record leaves possible: a drift known
        from few of its own turns makes nats of any slow column."""
        gains, ln_share, _ = self.averaged(more)
        return float(logsumexp(gains + ln_share))

    def bayes(self, column: Array, widths: Array) -> tuple[Array, float, float]:
        """ln Bayes factors [w] of a column [n], its size normal about 0 with a width [w] in its standard deviations;
        and its size over all drifts with its deviation."""
        gains, ln_share, sizes = self.averaged(column[None])
        each = (ln_share + gains)[:, None] - gains[:, None] / (1.0 + widths**2) - 0.5 * np.log1p(widths**2)
        weight, (mean, variance) = softmax(each.max(axis=1)), sizes.T
        size = float(weight @ mean)
        return np.asarray(logsumexp(each, axis=0)), size, math.sqrt(float(weight @ (variance + (mean - size) ** 2)))

    def sums(self, terms: Terms, theta: Array, blocks: Sequence[Array]) -> Iterator[Sums]:
        """Sums of the model with each of the blocks [k, n] of further columns. A pass takes many blocks."""
        known = range(2 + len(self.regressors))
        for sums, places in self._passes(terms, theta, blocks):
            yield from (sums.of([*known, *place]) for place in places)

    def beside(self, terms: Terms, theta: Array, blocks: Sequence[Array]) -> Iterator[Sums]:
        """Sums of each of the blocks alone, less what the model's columns explain of it and of the record."""
        known = 1 + len(self.regressors)
        for sums, places in self._passes(terms, theta, blocks):
            less = sums.less(known)
            yield from (less.of([0, *(k - known for k in place)]) for place in places)

    def _passes(self, terms: Terms, theta: Array, blocks: Sequence[Array]) -> Iterator[tuple[Sums, list[range]]]:
        """Passes over the model's columns and some blocks [k, n] each, with the places of these."""
        known, at = 2 + len(self.regressors), 0
        while at < len(blocks):
            places = [range(known, known + len(blocks[at]))]
            for block in blocks[at + 1 :]:
                if places[-1].stop + len(block) > known + ABREAST:
                    break
                places.append(range(places[-1].stop, places[-1].stop + len(block)))
            series = self.series.beside(np.vstack(blocks[at : at + len(places)]))
            yield run(series, terms, theta)[0][0], places
            at += len(places)

    @cached_property
    def rich(self) -> Fit:
        """A drift of two terms."""
        terms = replace(self.extras, walk=True, markov=True)
        return fit(self.series, terms, moved(self.best, terms))

    def scores(self, blocks: Sequence[Array], at: Fit | None = None) -> Array:
        """Gain [b] of each block [k, n] of further columns with the drift of a fit, by default of the best: a bound
        from below for their gain with the drift refitted. A pass takes many blocks."""
        at = self.best if at is None else at
        each = self.beside(at.terms, at.theta, [np.atleast_2d(block) for block in blocks])
        found = [ln_likelihood(sums) for sums in each]
        return np.array(found) - self.best.ln_likelihood

    def least(self, column: Array) -> float:
        """The coefficient of a column that gains NET_LEAST at the fitted noise."""
        (sums,) = self.beside(self.best.terms, self.best.theta, [np.atleast_2d(column)])
        return self.best.sigma * math.sqrt(2.0 * NET_LEAST / sums.G[1, 1]) if sums.G[1, 1] > 0.0 else math.inf


def _ln_marginal(sums: Sums) -> float:
    """ln likelihood at the best sigma, over coefficients with a flat prior."""
    return ln_likelihood(sums) + 0.5 * float(np.linalg.slogdet(sums.coefficients()[1])[1])


def gain_for(worth: Callable[[float], float]) -> float:
    """The gain that is worth NET_LEAST after its search, over NET_LEAST: its price hardly changes with it."""
    gain, lacks = 0.0, NET_LEAST
    while abs(lacks) > 1e-6:
        gain += lacks
        lacks = NET_LEAST - worth(gain)
    return gain / NET_LEAST


def _fit_from(series: Series, terms: Terms, known: Sequence[Fit]) -> Fit:
    same = [drift for drift in known if drift.terms == terms]
    if same:
        again = refit(series, same[0])
        return best([again, fit(series, terms)]) if again.drowned else again
    near = [drift for drift in known if drift.terms.walk == terms.walk and drift.terms.markov == terms.markov]
    if near:
        return fit(series, terms, moved(near[0], terms))
    return fit(series, terms)


def net(gain: float, freedom: int = 1, ln_looks: float = 0.0) -> float:
    """-ln of the probability that noise alone gains as much in the best of exp(ln_looks) looks (capped at 0)."""
    if gain <= 0.0:
        return 0.0
    p = float(chdtrc(freedom, 2.0 * gain))  # as scipy.stats has it, at a hundredth of the time
    ln_p = math.log(p) if p > 0.0 else -gain
    return max(0.0, -(ln_p + ln_looks))


def ln_looks(bend: Array, gain: float) -> float:
    """ln of the number of independent looks among scores of neighbouring places: their largest gains `gain` of noise.

    `bend` [places]: 1 - correlation of each place's score with its neighbour's. A score that forgets exponentially
    crosses u = sqrt(2 gain) about bend u^2 times a place (Leadbetter, Lindgren & Rootzen 1983, theorem 12.2.9). Between
    samples it is not looked at: Siegmund's factor nu (Sequential Analysis, 1985, chapter X) counts that.
    """
    square = 2.0 * bend * max(gain, 0.0)
    half = 0.5 * np.sqrt(np.maximum(2.0 * square, 1e-12))
    nu = (ndtr(half) - 0.5) / (half * (half * ndtr(half) + np.exp(-0.5 * half**2) / math.sqrt(2.0 * math.pi)))
    return math.log1p(float((square * nu).sum()))


@dataclass(frozen=True)
class Look:
    """A candidate.

    gain      nats of ln likelihood; `net`: less the price of its search.
    estimate  intervals with their units; `measure` makes them by a model that lacks the look's columns alone.
    changes   the fields of the state that has it.
    when      begin and end, s.
    others    what else it might be.
    shape     of its columns; `rivals`: other forms that are as likely."""

    cause: str
    gain: float
    net: float
    estimate: Mapping[str, Any]
    changes: Mapping[str, Any]
    when: tuple[float, float] | None = None
    shown_by: str = ""
    others: tuple[str, ...] = ()
    measure: Callable[[State], Mapping[str, Any]] | None = None
    shape: Shape | None = None
    rivals: tuple[Shape, ...] = ()

    def repeats(self, other: Look) -> bool:
        """Whether both are the same cause of the same channel."""
        channels = [(look.cause, look.estimate.get("other"), look.estimate.get("channel")) for look in (self, other)]
        return channels[0] == channels[1]

    def measured(self, beside: State) -> Look:
        """The look with the sizes that `measure` finds by a model."""
        if self.measure is None:
            return self
        return replace(self, estimate={**self.estimate, **self.measure(beside)})


def normal_entry(value: float, sd: float, unit: str) -> dict[str, Any]:
    """A posterior that is normal, in the form of the contract."""
    return {
        "mean": value,
        "median": value,
        "sd": sd,
        "q05": value - HALF_90 * sd,
        "q95": value + HALF_90 * sd,
        "unit": unit,
    }


def of_parameter(fit: Fit, name: str, unit_size: float, unit: str) -> dict[str, Any]:
    """The posterior of a parameter of the noise whose logarithm the fit knows."""
    sd = float(np.linalg.norm(fit.spread[fit.terms.names.index(name)]))
    return log_normal(math.log(unit_size) + fit.value(name), sd, unit)


def log_normal(ln_median: float, sd: float, unit: str) -> dict[str, Any]:
    """A posterior whose logarithm is normal with this standard deviation. Mean and width count a deviation above 1 as
    1."""
    square = min(sd, 1.0) ** 2
    mean = math.exp(ln_median + 0.5 * square)
    q05, median, q95 = (math.exp(ln_median + k * HALF_90 * sd) for k in (-1.0, 0.0, 1.0))
    width = mean * math.sqrt(math.expm1(square))
    return {"mean": mean, "median": median, "sd": width, "q05": q05, "q95": q95, "unit": unit}


def mixture(weight: Array, mean: Array, sd: Array | float, unit: str) -> dict[str, Any]:
    """A posterior that is a sum of normals, `weight` of each not normalized, in the form of the contract."""
    found = of_mixture(weight, mean, np.broadcast_to(np.asarray(sd, np.float64), mean.shape))
    return {**dict(zip(("mean", "sd", "q05", "median", "q95"), found, strict=True)), "unit": unit}
