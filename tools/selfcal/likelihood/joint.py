"""Model of all axes together: y_i(t) = c_i + l_i f(t) + d_i(t) + e_i(t).

f is a quantity that nobody recorded: a Gauss-Markov process of variance 1. d_i is the drift of axis i, a random walk
and a Gauss-Markov process. e is white, with a correlation between the axes. Everything is relative to the white noise
of a sample of its axis.

The parameters are fitted by Whittle's likelihood of the first differences, which have a spectrum although a walk has
none. Neighbouring frequencies are taken together where the spectra are flat. The likelihood of the record itself, the
course of f, and shocks of any state come from the Kalman filter of the model and its smoother.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import softmax

from selfcal import _joint
from selfcal.base.grid import Array, Mask
from selfcal.likelihood import work
from selfcal.likelihood.statemodel import ALPHA_LIMITS, LN_SIZE
from selfcal.logs.recording import bridged

#: Least axes with a common quantity: two axes that go together share noise.
LEAST_AXES = 3
#: Sine tapers (Riedel & Sidorenko, IEEE Trans. Signal Process. 43, 1995): together they weigh the whole record alike.
TAPERS = 8
#: Frequencies that are not grouped, and groups an octave above them.
SINGLE, AN_OCTAVE = 64, 24
#: Power of a bin with a line, over the mean of its neighbours; bins on each side that the line spoils; neighbours.
LINE, LINE_BESIDE, NEIGHBOURS = 14.0, 2, 200
#: Power of a line that its axis shows by itself beyond doubt, over the mean of its neighbours.
CLEAR_LINE = 40.0
#: Correlation times of f that a fit begins at, s.
STARTS_S = (30.0, 300.0)
#: Shortest correlation time of f, s: a faster process is noise that the axes share.
FASTEST_S = 10.0
#: Prior standard deviations of ln sizes and ln rates about the middle of their limits: they keep what the record does
#: not know from running away, and change ln likelihood by a few tenths elsewhere.
PRIOR_SD = 3.0
#: Standard deviations of a drift's ln size or ln rate, and of a loading over the white noise, about: units of a search.
OF_DRIFT, OF_LOADING = 0.5, 0.1
#: Widths of the size of a column, in its own standard deviations.
SIZE_WIDTHS = (1.0, 2.0, 4.0, 8.0, 16.0, 30.0)
#: ln of the odds that an axis has another axis' column, before its own readings: 1 in 100 axes without the column are
#: then taken to have it, 1 in 20 at even odds.
LN_ODDS = math.log(0.25)
#: Numbers of an axis' own drift: ln of white noise, walk a step, Gauss-Markov deviation, rate a sample.
OWN = 4


@dataclass(frozen=True)
class Bins:
    """Real parts [k, m, m] of the periodogram matrices of tapered first differences, at angles `turn` [k], each the
    mean of `count` [k] frequencies."""

    power: Array
    turn: Array
    count: Array

    @cached_property
    def white(self) -> Array:
        """Spectrum [k] of the difference of white noise of variance 1."""
        return 2.0 - 2.0 * np.cos(self.turn)

    def markov(self, rate: Array) -> tuple[Array, Array]:
        """Spectra [k, rates] of differences of Gauss-Markov processes of variance 1, and slopes over ln of the rates a
        sample."""
        a, cosine = np.exp(-rate), 1.0 - 0.5 * self.white[:, None]
        power, below = -np.expm1(-2.0 * rate), 1.0 - 2.0 * a * cosine + a * a
        value = power / below * self.white[:, None]
        return value, value * rate * (2.0 * a * a / power - 2.0 * a * (cosine - a) / below)


def _lines(power: Array, least: float = LINE) -> Mask:
    """Bins [n] of a spectrum that hold a line, or lie next to a line."""
    half = min(NEIGHBOURS, max(8, power.size // 8)) // 2
    level = median_filter(power, 2 * half + 1, mode="reflect") / math.log(2.0)
    found = np.zeros(power.size, bool)
    for at in np.flatnonzero(power > least * level):
        if at >= SINGLE // 4:
            found[max(0, at - LINE_BESIDE) : at + LINE_BESIDE + 1] = True
    return found


def bridged_rows(y: Array) -> Array:
    """Records [m, n] with their gaps bridged."""
    return np.array([bridged(row) for row in y])


def without_lines(y: Array, least: float = CLEAR_LINE) -> tuple[Array, Mask]:
    """Records [m, n] (NaN: missing) less their lines of `least` times the level, and where [n // 2 + 1] of the spectrum
    that was done.

    A line is shifted to 0 Hz and its slow amplitude subtracted. The amplitude is mirrored at the ends, so that a line
    with a wandering frequency does not ring there."""
    n, present, y = y.shape[1], np.isfinite(y), bridged_rows(y)
    where = np.any([_lines(np.abs(row) ** 2, least) for row in np.fft.rfft(np.diff(y, axis=1), axis=1)], axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(int)))
    found, pad = y - y.mean(axis=1)[:, None], n // 8
    for first, end in edges.reshape(-1, 2):
        turn = np.exp(2j * math.pi * 0.5 * (first + end - 1) / (n - 1) * np.arange(n))
        slow = np.fft.fft(np.pad(found * turn.conj(), ((0, 0), (pad, pad)), "reflect"), axis=1)
        slow[:, np.abs(np.fft.fftfreq(slow.shape[1])) > 0.5 * (end - first) / (n - 1)] = 0.0
        found = found - 2.0 * (np.fft.ifft(slow, axis=1)[:, pad : pad + n] * turn).real
    place = np.minimum(np.rint(np.arange(n // 2 + 1) * (where.size - 1) / (n // 2)), where.size - 1)
    return np.where(present, found, np.nan), where[place.astype(int)]


def bins_of(y: Array) -> Bins:
    """Bins of records y [m, n] in units of their white noise, gaps bridged. Bins with a line on an axis are dropped."""
    difference = np.diff(bridged_rows(y), axis=1)
    n = difference.shape[1]
    where = math.pi * (np.arange(n) + 0.5) / n
    z = np.stack([np.fft.rfft(difference * np.sin(k * where), axis=1) for k in range(1, TAPERS + 1)])
    z = (z * math.sqrt(2.0 / n))[:, :, 2:-1]
    turn = 2.0 * math.pi * np.arange(2, 2 + z.shape[2]) / n
    power = (np.abs(z) ** 2).mean(axis=0)
    kept = ~np.any([_lines(row) for row in power], axis=0)
    z, turn = z[:, :, kept], turn[kept]
    place = np.arange(turn.size)
    octave = np.log2(np.maximum(place, SINGLE) / SINGLE)
    group = np.where(place < SINGLE, place, SINGLE + (octave * AN_OCTAVE).astype(int))
    start = np.flatnonzero(np.diff(group, prepend=-1))
    count = np.diff(np.append(start, turn.size)).astype(np.float64)
    outer = np.einsum("tif,tjf->fij", z, z.conj()).real / TAPERS
    return Bins(np.add.reduceat(outer, start) / count[:, None, None], np.add.reduceat(turn, start) / count, count)


@dataclass(frozen=True)
class Joint:
    """Parameters of the model: `own` [m, OWN], `correlation` [m, m] of the white noise, `loading` [m] of f in units of
    each axis' record, `rate` of f a sample. `value`: ln likelihood by Whittle, with the priors."""

    own: Array
    correlation: Array
    loading: Array
    rate: float
    value: float = -math.inf

    @property
    def white(self) -> Array:
        """Standard deviations [m] of the white noise."""
        return np.exp(self.own[:, 0])

    @property
    def has_f(self) -> bool:
        """Whether f moves any axis."""
        return bool(self.loading.any())

    def precision(self, turn: Array) -> Array:
        """Inverse spectrum [k, m, m] of the first differences at angles `turn` [k] above 0."""
        bins = Bins(np.empty(0), turn, np.empty(0))
        S = bins.white[:, None, None] * (self.correlation * np.outer(self.white, self.white))
        place = np.arange(self.white.size)
        scale = np.exp(2.0 * self.own[:, 0])
        drift, f = np.split(bins.markov(np.append(np.exp(self.own[:, 3]), self.rate))[0], [self.white.size], axis=1)
        S[:, place, place] += (np.exp(2.0 * self.own[:, 2]) * drift + np.exp(2.0 * self.own[:, 1])) * scale
        S += f[:, :, None] * np.outer(self.loading, self.loading)
        return np.asarray(np.linalg.inv(S))

    def of(self, axes: Sequence[int]) -> Joint:
        """The model of some of the axes."""
        at = list(axes)
        return replace(self, own=self.own[at], correlation=self.correlation[np.ix_(at, at)], loading=self.loading[at])

    def share(self, lag: float) -> Array:
        """Share [m] of f in the variance that the drift of each axis gains over `lag` samples."""
        common = 2.0 * self.loading**2 * -math.expm1(-self.rate * lag)
        scale = np.exp(2.0 * self.own[:, 0])
        own = scale * (
            np.exp(2.0 * self.own[:, 1]) * lag
            - 2.0 * np.exp(2.0 * self.own[:, 2]) * np.expm1(-np.exp(self.own[:, 3]) * lag)
        )
        found: Array = common / np.maximum(common + own, 1e-300)
        return found


def _lower(m: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    found: tuple[NDArray[np.intp], NDArray[np.intp]] = np.tril_indices(m, -1)
    return found


class _Cost:
    """-ln likelihood and its slope over a vector of parameters: own drifts, the rows of a root of the correlation, and
    the loadings and ln rate of f if the model has f."""

    def __init__(self, bins: Bins, f: bool) -> None:
        self.bins, self.f, self.m = bins, f, bins.power.shape[1]
        self.centre = np.array([0.0, -4.0, -2.0, -4.0])
        self.weight = np.array([0.0, 1.0, 1.0, 1.0]) / PRIOR_SD**2

    def parts(self, x: Array) -> tuple[Array, Array, Array, Array, float]:
        """Own drifts, root and correlation, loadings relative to the white noise, ln rate."""
        m = self.m
        own, at = x[: OWN * m].reshape(m, OWN), OWN * m
        root = np.eye(m)
        lower = _lower(m)
        root[lower] = x[at : at + lower[0].size]
        at += lower[0].size
        lengths = np.linalg.norm(root, axis=1)
        root /= lengths[:, None]
        loading, ln_rate = (x[at : at + m], float(x[at + m])) if self.f else (np.zeros(m), 0.0)
        return own, root, lengths, loading, ln_rate

    def spectra(self, own: Array, root: Array, loading: Array, ln_rate: float) -> tuple[Array, Array, Array]:
        """[k, m, m], and those of each drift and of f with their slopes over ln of the rate, [k, m + 1]."""
        m, white = self.m, np.exp(own[:, 0])
        values, bends = self.bins.markov(np.exp(np.append(own[:, 3], ln_rate)))
        noises = np.array([root @ root.T, np.outer(loading, loading)]) * np.outer(white, white)
        S = (np.column_stack([self.bins.white, values[:, m]]) @ noises.reshape(2, -1)).reshape(-1, m, m)
        own_drift = np.exp(2.0 * own[:, 1]) + values[:, :m] * np.exp(2.0 * own[:, 2])
        S[:, np.arange(m), np.arange(m)] += own_drift * white**2
        return S, values, bends

    @property
    def units(self) -> Array:
        """About how well a record knows each parameter."""
        m, sharp = self.m, float(self.bins.count.sum()) ** -0.5
        own = np.tile([sharp, *(OWN - 1) * [OF_DRIFT]], m)
        return np.concatenate(
            [own, np.full(m * (m - 1) // 2, sharp), *([m * [OF_LOADING], [OF_DRIFT]] if self.f else [])]
        )

    def __call__(self, x: Array) -> tuple[float, Array]:
        bins, m = self.bins, self.m
        work.count(bins.turn.size, m)
        own, root, lengths, loading, ln_rate = self.parts(x)
        S, values, bends = self.spectra(own, root, loading, ln_rate)
        white, correlation, diagonal = np.exp(own[:, 0]), root @ root.T, np.arange(m)
        walk, size = np.exp(2.0 * (own[:, 0] + own[:, 1])), np.exp(2.0 * (own[:, 0] + own[:, 2]))
        u = loading * white
        inverse = np.linalg.inv(S)
        sign, ln_det = np.linalg.slogdet(S)
        if not (sign > 0.0).all():
            return 1e30, np.zeros_like(x)
        M = inverse @ bins.power
        value = float(bins.count @ (ln_det + np.trace(M, axis1=1, axis2=2)))
        A = bins.count[:, None, None] * (inverse - M @ inverse)
        slope = np.zeros_like(x)
        of_own = np.zeros((m, OWN))
        weights = np.stack([bins.white, values[:, m], bends[:, m]])
        G, of_f, of_rate = (weights @ A.reshape(-1, m * m)).reshape(3, m, m)
        of_own[:, 0] = 2.0 * (G * correlation * np.outer(white, white)).sum(axis=1)
        D = A[:, diagonal, diagonal]
        of_walk = 2.0 * walk * D.sum(axis=0)
        of_size = 2.0 * size * (D * values[:, :m]).sum(axis=0)
        of_own[:, 0] += of_walk + of_size
        of_own[:, 1], of_own[:, 2] = of_walk, of_size
        of_own[:, 3] = size * (D * bends[:, :m]).sum(axis=0)
        at = OWN * m
        of_root = 2.0 * (G * np.outer(white, white)) @ root
        of_root -= (of_root * root).sum(axis=1)[:, None] * root
        lower = _lower(m)
        slope[at : at + lower[0].size] = (of_root / lengths[:, None])[lower]
        at += lower[0].size
        if self.f:
            of_u = 2.0 * of_f @ u
            slope[at : at + m] = of_u * white
            of_own[:, 0] += of_u * u
            far = (ln_rate - self.centre[3]) / PRIOR_SD**2
            slope[at + m] = float(u @ of_rate @ u) + far
            value += 0.5 * far * (ln_rate - self.centre[3])
        away = own - self.centre
        value += 0.5 * float((self.weight * away**2).sum())
        slope[: OWN * m] = (of_own + self.weight * away).ravel()
        return value, slope


def fit_joint(bins: Bins, dt: float, f: bool, start: Joint | None = None, *, held: bool = False) -> Joint:
    """The model of most likelihood, with f or without. `start`: a model near it, to which f is added if absent. If f is
    `held`, it stays as in `start`."""
    cost, m = _Cost(bins, f), bins.power.shape[1]
    rate = np.log(np.array(ALPHA_LIMITS) * dt)
    rate[1] = min(rate[1], math.log(2.0))
    bounds = [(-4.0, 4.0), LN_SIZE, LN_SIZE, tuple(rate)] * m + [(-9.0, 9.0)] * (m * (m - 1) // 2)
    common = (rate[0], min(rate[1], math.log(dt / FASTEST_S)))
    bounds += [(-50.0, 50.0)] * m + [common] if f else []
    own = np.tile([0.0, -4.0, -1.5, math.log(0.01 * dt)], (m, 1)) if start is None else start.own
    root = np.linalg.cholesky(np.eye(m) if start is None else start.correlation)
    root = root / np.diag(root)[:, None]
    own = np.clip(own, *np.array(bounds[:OWN]).T)
    head = np.concatenate([own.ravel(), root[_lower(m)]])
    tries = [head]
    if f and start is not None and start.has_f:
        of_f = np.append(start.loading / start.white, math.log(start.rate))
        bounds[head.size :] = [(value, value) for value in of_f] if held else bounds[head.size :]
        tries = [np.concatenate([head, of_f])]
    elif f:
        vector = _together(bins, own)
        tries = [np.concatenate([head, vector, [np.clip(math.log(dt / tau), *bounds[-1])]]) for tau in STARTS_S]
    value, x = min((_least(cost, start, np.array(bounds)) for start in tries), key=lambda end: end[0])
    own, root, _, loading, ln_rate = cost.parts(x)
    loading = loading * math.copysign(1.0, float(loading.sum()))
    return Joint(own, root @ root.T, loading * np.exp(own[:, 0]), math.exp(ln_rate), -value)


def _least(cost: _Cost, start: Array, bounds: Array) -> tuple[float, Array]:
    """The least cost within bounds [parameters, 2], and where it is. It is sought in units of how well each parameter
    is known: else it takes four times as many steps."""
    from scipy.optimize import minimize  # a quarter of a second to import: for records of several axes alone

    unit = cost.units

    def scaled(z: Array) -> tuple[float, Array]:
        value, slope = cost(z * unit)
        return value, slope * unit

    within = bounds / unit[:, None]
    end = minimize(scaled, start / unit, jac=True, method="L-BFGS-B", bounds=within, options={"maxiter": 400})
    return float(end.fun), end.x * unit


def refitted(model: Joint, y: Array, dt: float) -> Joint:
    """The model fitted to records [m, n] from a model near it, with f if that model has it."""
    return fit_joint(bins_of(y), dt, model.has_f, model)


def without_each(bins: Bins, model: Joint) -> Array:
    """Loss of ln likelihood [m] if f does not move an axis."""
    every = range(model.loading.size)
    none = [replace(model, loading=np.where(np.arange(len(every)) == k, 0.0, model.loading)) for k in every]
    return _value(bins, model) - np.array([_value(bins, model_without) for model_without in none])


def without_pairs(bins: Bins, model: Joint, source: int, others: Sequence[int]) -> float:
    """Loss of ln likelihood if the white noise of an axis is not correlated with the `others`; infinite if the
    remaining correlations need it."""
    correlation = model.correlation.copy()
    correlation[source, others] = correlation[others, source] = 0.0
    if float(np.linalg.eigvalsh(correlation)[0]) < 1e-6:
        return math.inf
    return _value(bins, model) - _value(bins, replace(model, correlation=correlation))


def _value(bins: Bins, model: Joint) -> float:
    """ln likelihood by Whittle, with the priors."""
    cost = _Cost(bins, True)
    root = np.linalg.cholesky(model.correlation)
    root = (root / np.diag(root)[:, None])[_lower(cost.m)]
    return -cost(np.concatenate([model.own.ravel(), root, model.loading / model.white, [math.log(model.rate)]]))[0]


def _together(bins: Bins, own: Array) -> Array:
    """Loadings [m] to begin with: what the slow parts of the axes share, relative to the white noise of each."""
    slow = max(8, int(np.searchsorted(np.cumsum(bins.count), 0.1 * bins.count.sum())))
    power = np.einsum("k,kij->ij", bins.count[:slow], bins.power[:slow])
    deviation = np.sqrt(np.diag(power))
    values, vectors = np.linalg.eigh(power / np.outer(deviation, deviation))
    relative = deviation / math.sqrt(float(bins.count[:slow] @ bins.white[:slow])) / np.exp(own[:, 0])
    found: Array = vectors[:, -1] * math.sqrt(max(float(values[-1]) - 1.0, 0.1)) * np.minimum(relative, 5.0)
    return found


@dataclass(frozen=True)
class Course:
    """What filter and smoother make of a record. `ln_likelihood`; `innovations` [n, m] of each axis (NaN: missing) and
    their variances `spread` [n, m], also of missing readings; `predicted` [n, s]: the states before each sample. Of the
    smoother: `f` [n]; `weights` [n, m]: the record times its inverse covariance, so that the score of any column is its
    product with them; `of_f` [n, 2]: score of a jump of f just before each sample, and its information; `shock` [n, m]
    and `known` [n, m, m]: the same of the levels."""

    ln_likelihood: float
    innovations: Array
    spread: Array
    predicted: Array
    f: Array
    weights: Array
    of_f: Array
    known: Array

    @cached_property
    def shock(self) -> Array:
        """Score [n, m] of a jump of each level just before each sample."""
        return np.asarray(np.cumsum(self.weights[::-1], axis=0)[::-1])

    def scores(self) -> Array:
        """ln likelihood [n, m] of each reading given the past of all axes; NaN where it is missing."""
        found: Array = -0.5 * (np.log(2.0 * math.pi * self.spread) + self.innovations**2 / self.spread)
        return found


def last(model: Joint, y: Array) -> tuple[Array, Array]:
    """Prediction of each axis of records y [m, n] without its white noise, a sample after the last: mean and standard
    deviation [m]."""
    found = course(model, np.column_stack([y, np.full(len(y), np.nan)]))
    return ahead(model, found, 1)[-1], np.sqrt(found.spread[-1] - model.white**2)


def ahead(model: Joint, found: Course, steps: int) -> Array:
    """Prediction [n, m] of each axis `steps` samples after its last known sample, which is just before each place."""
    m = model.loading.size
    x = found.predicted * _matrices(model)[0] ** (steps - 1)
    predicted: Array = x[:, :1] * model.loading + x[:, 1 : 1 + m] + x[:, 1 + m :]
    return predicted


def _matrices(model: Joint) -> tuple[Array, Array, Array, Array, Array]:
    """Decay of the states a sample, their noise, how the axes read f, the covariance of the white noise, and variances
    of the first states. States: f, then walk and Gauss-Markov drift of each axis. The levels are unknown: the walks
    begin with a wide prior."""
    m = model.loading.size
    own, scale = model.own, np.exp(2.0 * model.own[:, 0])
    markov = scale * np.exp(2.0 * own[:, 2])
    decay = np.concatenate([[math.exp(-model.rate)], np.ones(m), np.exp(-np.exp(own[:, 3]))])
    noise = np.concatenate([[1.0], scale * np.exp(2.0 * own[:, 1]), markov])
    noise *= np.concatenate([[-math.expm1(-2.0 * model.rate)], np.ones(m), -np.expm1(-2.0 * np.exp(own[:, 3]))])
    wide = np.full(m, 1e6 * max(1.0, float(scale.max())))
    R = model.correlation * np.outer(model.white, model.white)
    return decay, noise, model.loading, R, np.concatenate([[1.0], wide, markov])


def course(model: Joint, y: Array, smooth: bool = False) -> Course:
    """Filter records y [m, n] (NaN: missing), and smooth them."""
    work.count(y.shape[1], 1 + 2 * len(y))
    return Course(*_joint.course(np.ascontiguousarray(y), *_matrices(model), smooth))


def information(model: Joint, y: Array, columns: Array) -> Array:
    """Information [k, m, m] of each column [k, n] on every axis of records y [m, n], the levels unknown."""
    work.count(y.shape[1], len(columns) * len(y))
    return _joint.information(np.ascontiguousarray(y), np.ascontiguousarray(columns), *_matrices(model))


@dataclass(frozen=True)
class Act:
    """Worth of a column of unknown size on unknown axes: `evidence`, nats over no column, its search not paid;
    `probability` [m] that each axis has it; sizes [p, m] of its p parts, 0 where the probability is below a half; `sd`
    [m], the standard deviation of the first part, infinite there."""

    evidence: float
    probability: Array
    size: Array
    sd: Array

    @property
    def axes(self) -> list[int]:
        return [int(k) for k in np.flatnonzero(np.isfinite(self.sd))]


def act(score: Array, known: Array) -> Act:
    """`Act` of a column by the scores [p, m] of its p parts. `known`: information [p, m, m] of each, or [m, m] of all.

    Sizes are normal about 0 with the same width for all axes of a set, in standard deviations of each axis' own."""
    p, m = score.shape
    known = np.broadcast_to(known, (p, m, m))
    own = np.diagonal(known, axis1=1, axis2=2)
    shown = own > 1e-12 * np.maximum(own.max(), 1e-300)  # of an axis without a reading where the column is, nothing
    scale = shown / np.sqrt(np.where(shown, own, 1.0))
    z, R = score * scale, known * scale[:, :, None] * scale[:, None, :]
    widths = np.array(SIZE_WIDTHS)

    def ln_bf(sets: NDArray[np.intp]) -> Array:
        values, ways = np.linalg.eigh(R[:, sets[:, :, None], sets[:, None, :]])
        firm = values + widths[:, None, None, None] ** -2.0
        explained = 0.5 * (np.einsum("psj,psjk->psk", z[:, sets], ways) ** 2 / firm).sum(axis=(1, 3))
        volume = np.log(firm).sum(axis=(1, 3)) + 2.0 * values.size / len(sets) * np.log(widths)[:, None]
        return np.asarray(explained - 0.5 * volume)

    total, probability = _over_sets(m, ln_bf)
    held = np.flatnonzero((probability >= 0.5) & shown.all(axis=0))
    size, sd = np.zeros((p, m)), np.full(m, math.inf)
    if held.size:
        inverse = np.linalg.inv(known[:, held[:, None], held])
        size[:, held] = np.einsum("pj,pjk->pk", score[:, held], inverse)
        sd[held] = np.sqrt(np.diag(inverse[0]))
    return Act(total, probability, size, sd)


def act_apart(ln_bf: Array, size: Array, sd: Array) -> Act:
    """`Act` of a column on axes whose drifts have nothing in common. `ln_bf` [m, widths]: ln Bayes factors of each axis
    alone; its `size` [m], with standard deviation `sd` [m]."""
    total, probability = _over_sets(size.size, lambda sets: ln_bf[sets].sum(axis=1).T)
    held = probability >= 0.5
    return Act(total, probability, np.where(held, size, 0.0)[None], np.where(held, sd, math.inf))


def _over_sets(m: int, ln_bf: Callable[[NDArray[np.intp]], Array]) -> tuple[float, Array]:
    """Evidence of a column on some of m axes, and the probability [m] of each, by ln Bayes factors [widths, s] of sets
    of axes [s, count].

    The evidence is a sum over the sets of axes. Every number of axes is as likely before the record. The probability of
    an axis is what its own readings say, whatever the others do."""
    sets, ln_prior, member = _sets(m)
    worth = np.logaddexp.reduce(np.hstack([ln_bf(each) for each in sets]), axis=0) - math.log(len(SIZE_WIDTHS))
    total = float(np.logaddexp.reduce(worth + ln_prior))
    return total, np.asarray(softmax(worth + LN_ODDS * member.sum(axis=1)) @ member)


@lru_cache(maxsize=8)
def _sets(m: int) -> tuple[list[NDArray[np.intp]], Array, Array]:
    """Sets of m axes [s, count] by their number, ln of the prior of each set, and whether it has each axis [s, m]."""
    sets = [np.array(list(combinations(range(m), count))) for count in range(1, m + 1)]
    ln_prior = np.concatenate([np.full(len(each), -math.log(len(each) * m)) for each in sets])
    return sets, ln_prior, np.array([np.isin(range(m), held) for each in sets for held in each], np.float64)
