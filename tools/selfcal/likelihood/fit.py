"""Maximum likelihood of a noise model with regressors, by a Kalman filter over the record and every column."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, product
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from selfcal import _likelihood
from selfcal.base.grid import SLOPE_STEP, Array, Mask
from selfcal.likelihood import work
from selfcal.likelihood.statemodel import LN_SIZE, PARAMETERS, Terms, matrices

#: Most columns of a pass of the compiled filter, without the record.
COLUMNS_MOST = _likelihood.COLUMNS_MAX - 1
#: Largest product of matrices that numpy computes in one thread, multiplications.
ONE_THREAD = 200_000
#: Share of a column's sum of squares below which it depends on the other columns: half of a double's digits are left.
DEPENDENT_SHARE = math.sqrt(np.finfo(float).eps)
#: Change of ln likelihood in a step below which a fit has settled: a hundredth of the smallest evidence reported.
FTOL = 0.01
#: The same change for a quick look, which only ranks causes: their evidence differs by more.
ROUGH_FTOL = 0.3
#: Standard deviations of a model's parameters at which posteriors of coefficients are summed.
NODE_SDS = (-2.0, -1.0, 0.0, 1.0, 2.0)
#: Standard deviation of a direction above which it is walked instead, the step, and the fall of ln likelihood that ends
#: the walk. Change of ln likelihood a step below which the parameter's term has vanished. Longest walk.
HARDLY, NODE_STEP, WALKED_NATS, PLATEAU, NODES_FARTHEST = 0.7, 0.6, 4.0, 0.02, 18.0
#: Most samples of a record whose parameters are varied: longer records know them well enough.
SUMMED_SAMPLES_MOST = 100_000
#: Most steps of a fit, longest step in any parameter, and the factor that shortens a step that went too far.
STEPS_MOST, STRIDE_MOST, SHORTER = 40, 3.0, 0.25
#: Least gain that a step must promise, as a share of `ftol`.
PROMISE_LEAST = 0.2
#: Information of a ln size below which the size may be nothing: its standard deviation is a factor of two.
WEAK = 2.0
#: Parameters of a drift, the ln size below which the drift is nothing, and the values at which it is then sought.
LARGER = (
    (("ln_rho",), -7.0, ((-7.0,), (-5.5,))),
    (("ln_markov", "ln_alpha"), -5.0, ((-5.0, -7.0), (-5.0, -5.0), (-5.0, -3.0), (-5.0, -1.7))),
)
#: ln of a drift over the white noise above which no white noise is left.
DROWNED = LN_SIZE[1] - 0.01


@dataclass(frozen=True)
class Series:
    """One axis on an even grid: `y` float64[n] (NaN: missing), `dt` s, `r` float64[n] variance of the white noise
    over its nominal variance. `columns` [p, n] of known disturbances; the first is the bias, 1 throughout. A fit has
    settled when a step changes ln likelihood by less than `ftol`. `y` are means of `block` readings; `r` is above 1
    where readings are lost."""

    y: Array
    dt: float
    r: Array
    columns: Array
    ftol: float = FTOL
    block: int = 1

    @property
    def n(self) -> int:
        return int(np.isfinite(self.y).sum())

    @property
    def duration_s(self) -> float:
        return self.y.size * self.dt

    def beside(self, more: Array) -> Series:
        """The series with further columns [k, n]."""
        return replace(self, columns=np.ascontiguousarray(np.vstack([self.columns, np.atleast_2d(more)])))


@dataclass(frozen=True)
class Sums:
    """Results of a pass of the filter: Gram matrix [1 + p, 1 + p] of the whitened record and columns, sum of ln s,
    samples used."""

    G: Array
    D: float
    n: float
    x: Array  # [1 + p, states]: predicted state of the next sample, of the record and of each column

    def of(self, places: Sequence[int]) -> Sums:
        """The record, 0 of `places`, and some columns."""
        return replace(self, G=self.G[np.ix_(places, places)], x=self.x[places])

    def less(self, known: int) -> Sums:
        """The record and the columns after the first `known`, less what the first `known` columns explain. A column
        that depends on the first `known` becomes 0."""
        inverse = replace(self, G=self.G[: 1 + known, : 1 + known]).coefficients()[1]
        rest = [0, *range(1 + known, len(self.G))]
        cross = self.G[1 : 1 + known][:, rest]
        G = self.G[np.ix_(rest, rest)] - cross.T @ inverse @ cross
        spent = np.diag(G) < DEPENDENT_SHARE * np.diag(self.G)[rest]
        spent[0] = False
        G[spent], G[:, spent] = 0.0, 0.0
        return replace(self, G=G, x=self.x[rest])

    def coefficients(self) -> tuple[Array, Array, float]:
        """Least squares: coefficients [p], their covariance over sigma^2 [p, p], residual sum of squares. The last is
        infinite where the filter overflowed. Solved once."""
        return self._solved

    @cached_property
    def _solved(self) -> tuple[Array, Array, float]:
        A, B = self.G[1:, 1:], self.G[1:, 0]
        if not np.isfinite(self.G).all():
            return np.zeros(B.size), np.zeros(A.shape), math.inf
        if B.size == 1:
            inverse = np.divide(1.0, A, out=np.zeros_like(A), where=A > 1e-300)
            return inverse[0] * B, inverse, max(float(self.G[0, 0] - inverse[0, 0] * B[0] ** 2), 1e-300)
        # A column of zeros, a step later than these samples, has no coefficient.
        size = np.sqrt(np.maximum(np.diag(A), 0.0))
        scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 1e-150)
        both = np.outer(scale, scale)
        # The pseudo-inverse; numpy's own takes five times as long over so few columns.
        values, vectors = np.linalg.eigh(A * both)
        held = np.abs(values) > 1e-10 * np.abs(values).max()
        inverse = (vectors * np.divide(1.0, values, out=np.zeros_like(values), where=held)) @ vectors.T * both
        c = inverse @ B
        return c, inverse, max(float(self.G[0, 0] - B @ c), 1e-300)


@dataclass(frozen=True)
class Fit:
    """A fitted model: `terms` at `theta`, white noise `sigma` of a sample, coefficients `c` of the columns with their
    standard deviations `sd`, and `ln_likelihood` at its maximum. `information` [k, k], of a fit: that of `theta`."""

    terms: Terms
    theta: Array
    sigma: float
    c: Array
    sd: Array
    ln_likelihood: float
    n: float
    dt: float
    duration_s: float
    information: Array = field(default_factory=lambda: np.empty((0, 0)))

    @cached_property
    def spread(self) -> Array:
        """A root of the covariance of theta [k, k]."""
        return _spread(self.information)

    def value(self, name: str) -> float:
        """A parameter of the vector."""
        return float(self.theta[self.terms.names.index(name)])

    def shrunk(self, by: float) -> Fit:
        """The fit with a drift smaller by exp(-by), within its limits. Only its parameters are of that drift."""
        low = np.array(self.terms.limits(self.dt)).reshape(-1, 2)[:, 0]
        return replace(self, theta=np.maximum(self.theta - by * self.terms.sizes, low))

    def of_means(self, block: int, less: float) -> Array:
        """Parameters for means of `block` samples, relative to their white noise. Sizes of the drift are multiplied by
        e^`less`."""
        terms = self.terms
        theta = self.theta + math.log(block) * terms.growth + less * terms.sizes
        return np.asarray(np.where(terms.growth > 0.0, np.maximum(theta, LN_SIZE[0]), theta))

    @property
    def N(self) -> float:
        """White noise density, unit/sqrt(Hz)."""
        return self.sigma * math.sqrt(self.dt)

    @property
    def drowned(self) -> bool:
        """Whether a drift leaves no white noise: a climb from there may not begin."""
        return bool(np.any(self.theta[self.terms.sizes] > DROWNED))

    @property
    def quantized(self) -> bool:
        """Whether its noise is white and quantization noise: a moving average of neighbours that pull apart."""
        return self.terms.color == "ma" and self.value("color") < 0.0

    @property
    def increment(self) -> float:
        """Increment of the counter whose remainders are the quantization noise: sqrt(12) Q, unit times s."""
        m = math.tanh(self.value("color"))
        return self.sigma * self.dt * math.sqrt(-12.0 * m / (1.0 + m * m))

    @property
    def N_of_color(self) -> float:
        """White noise density at low frequency."""
        m = math.tanh(self.value("color")) if self.terms.color else 0.0
        of_all = (1.0 + m) ** 2 / (1.0 + m * m) if self.terms.color == "ma" else (1.0 + m) / (1.0 - m)
        return self.N * math.sqrt(of_all)

    @property
    def K(self) -> float:
        """Coefficient of the random walk, unit/s/sqrt(Hz); 0 without a walk."""
        return self.sigma * math.exp(self.value("ln_rho")) / math.sqrt(self.dt) if self.terms.walk else 0.0

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the Gauss-Markov drift at its samples, unit."""
        return self.sigma * math.exp(self.value("ln_markov"))

    @property
    def alpha(self) -> float:
        """Bandwidth of the Gauss-Markov drift, 1/s."""
        return math.exp(self.value("ln_alpha"))


def run(
    series: Series, terms: Terms, theta: Array, marks: Sequence[int] = (), innovations: bool = False
) -> tuple[list[Sums], Array, Array]:
    """A pass, counted as work: sums up to each of `marks` (default: the end), whitened innovations [n, 1 + p], their
    variances [n]."""
    G, D, n, x, white, s = passed(series, terms, theta, marks, innovations)
    return [Sums(G[k], float(D[k]), float(n[k]), x[k]) for k in range(len(G))], white, s


def passed(
    series: Series, terms: Terms, theta: Array, marks: Sequence[int] = (), innovations: bool = False
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """A pass as `run`, its sums as arrays: G, D, n and x of each mark, innovations, and their variances. The filter
    whitens each column by itself: where they are too many for one pass, G is of the whitened columns."""
    m = matrices(terms, theta, series.dt, series.duration_s, series.block)
    at = list(marks) or [series.y.size]
    parts = _parts(series.columns)

    def of(columns: Array) -> tuple[Array, ...]:
        work.count(series.y.size, len(columns))
        whitened = innovations or len(parts) > 1
        found: tuple[Array, ...] = _likelihood.run(
            series.y, columns, series.r, m.F, m.Q, m.h, m.P0, m.R, m.lost, m.driver, at, whitened
        )
        return found

    (G, D, n, x, white, s), *more = [of(part) for part in parts]
    if more:
        x = np.concatenate([x, *(part[3][:, 1:] for part in more)], axis=1)
        white = np.concatenate([white, *(part[4][:, 1:] for part in more)], axis=1)
        pieces = np.split(np.nan_to_num(white), at)[: len(at)]
        G = np.cumsum([_products(piece) for piece in pieces], axis=0)
    return G, D, n, x, white, s


def left(series: Series, fit: Fit, more: Array) -> Array:
    """The record and further columns [n, 1 + k] behind the filter of a fit, less what the series' own columns explain.
    A column that depends on the series' columns is 0, and so are missing samples."""
    white = np.nan_to_num(run(series.beside(more), fit.terms, fit.theta, innovations=True)[1])
    k = 1 + len(series.columns)
    q, rest = np.linalg.qr(white[:, 1:k])[0], np.delete(white, range(1, k), axis=1)
    size = 1e-6 * (rest**2).sum(axis=0)
    rest -= q @ (q.T @ rest)
    rest[:, 1:] *= (rest[:, 1:] ** 2).sum(axis=0) > size[1:]
    return rest


def _products(rows: Array) -> Array:
    """Sums of the products of columns [n, p], [p, p], in parts too small for threads, which wait for each other."""
    parts = np.array_split(rows, 1 + rows.size * rows.shape[1] // ONE_THREAD)
    return np.asarray(sum(part.T @ part for part in parts))


def _parts(columns: Array) -> list[Array]:
    """Columns [p, n] as the filter takes them."""
    count = math.ceil(len(columns) / COLUMNS_MOST)
    return [columns] if count == 1 else [np.ascontiguousarray(part) for part in np.array_split(columns, count)]


@dataclass(frozen=True)
class Shifts:
    """Shifts of the level that begin at each sample and stay, before the columns are taken out, relative to the white
    noise. `sums`: of the record. `A` [n]: information of each. `B` [n, 1 + p]: its products with the whitened record
    and columns. `impulse` [n]: information of a single shifted sample, 0 where it is missing."""

    sums: Sums
    A: Array
    B: Array
    impulse: Array


def shifts(series: Series, terms: Terms, theta: Array) -> Shifts:
    """`Shifts` by a pass of the filter and a pass back over its gains: exact at gaps, and where the noise changes."""
    m = matrices(terms, theta, series.dt, series.duration_s, series.block)

    parts = _parts(series.columns)
    each = [_likelihood.shifts(series.y, part, series.r, m.F, m.Q, m.h, m.P0, m.R, m.lost, m.driver) for part in parts]
    G, D, A, B, impulse = each[0]
    if len(parts) > 1:
        G = run(series, terms, theta)[0][0].G
        B = np.concatenate([B, *(part[3][:, 1:] for part in each[1:])], axis=1)
    return Shifts(Sums(G, float(D), float(series.n), np.empty((len(G), 0))), A, B, impulse)


def ln_det(covariance: NDArray[np.floating[Any]]) -> float:
    """ln of the determinant of a covariance [p, p] of coefficients, over those that the record knows."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    known = sd > 0.0
    sd = sd[known]
    values = np.linalg.eigvalsh(covariance[np.ix_(known, known)] / np.outer(sd, sd))
    return 2.0 * float(np.log(sd).sum()) + float(np.log(values[values > 1e-10]).sum())


def ln_likelihood(sums: Sums) -> float:
    """At the best sigma and coefficients."""
    rss = sums.coefficients()[2]
    return -0.5 * (sums.n * (math.log(2.0 * math.pi * rss / sums.n) + 1.0) + sums.D)


def slopes(series: Series, at: Fit) -> tuple[Array, Array]:
    """Slope [k] of ln likelihood by the parameters of a fit, and their information [k, k].

    A pass filters the record less its columns at their best coefficients, by which ln likelihood has no slope. sigma is
    free in the information. If a pass cannot take all parameters, every two pairs of parameters have a pass."""
    work.count(series.y.size, at.theta.size)
    terms, theta = at.terms, at.theta
    m = matrices(terms, theta, series.dt, series.duration_s, series.block)
    near = [
        [matrices(terms, theta + sign * move, series.dt, series.duration_s, series.block) for sign in (1.0, -1.0)]
        for move in SLOPE_STEP * np.eye(theta.size)
    ]
    by = [
        np.array([(getattr(ahead, name) - getattr(back, name)) / (2.0 * SLOPE_STEP) for ahead, back in near])
        for name in ("F", "Q", "h", "P0", "R", "lost")
    ]
    whole, k = series.y - at.c @ series.columns, theta.size
    pairs = [[j, j + 1][: k - j] for j in range(0, k, 2)]
    rss, n, rss_by, D_by, innovations, spread = 0.0, 0.0, *np.empty((2, k)), *np.empty((2, k, k))
    for part in [[*range(k)]] if k <= _likelihood.SLOPES_MAX else [a + b for a, b in combinations(pairs, 2)]:
        F, Q, h, P0, R, lost = (each[part] for each in by)
        rss, _, n, rss_by[part], D_by[part], innovations[np.ix_(part, part)], spread[np.ix_(part, part)] = (
            _likelihood.slopes(whole, series.r, m.F, m.Q, m.h, m.P0, m.R, m.lost, F, Q, h, P0, R, lost, m.driver)
        )
    rss = max(rss, 1e-300)
    information = n / rss * innovations + 0.5 * (spread - np.outer(D_by, D_by) / n)
    return -0.5 * (n * rss_by / rss + D_by), information


def refit(series: Series, known: Fit) -> Fit:
    """The model refitted to a similar record, from its own parameters."""
    return _climbed(series, fit_at(series, known.terms, known.theta))


def fit(series: Series, terms: Terms, start: Array | None = None) -> Fit:
    """Best `theta` from `start`, or from the best of a few starts.

    A drift that has gone to nothing is tried once more at larger sizes. The likelihood may have a second top there, or
    a Gauss-Markov drift may have gone to nothing with the wrong rate."""
    low, high = np.array(terms.limits(series.dt)).reshape(-1, 2).T
    starts = [start] if start is not None else _starts(terms, np.array([low, high]).T)
    found = _climbed(series, best([fit_at(series, terms, np.clip(start, low, high)) for start in starts]))
    promised: list[tuple[float, Fit]] = []
    for place in _larger(terms, found.theta):
        at = fit_at(series, terms, place)
        slope, information = slopes(series, at)
        k = int(np.flatnonzero(place != found.theta)[0])
        if slope[k] > 0.0:
            promised.append((at.ln_likelihood + 0.5 * float(slope[k] ** 2 / information[k, k]), at))
    if not promised:
        return found
    return best([found, _climbed(series, max(promised, key=lambda promise: promise[0])[1])])


def _larger(terms: Terms, theta: Array) -> list[Array]:
    """Places with more of each drift that is nothing at `theta`."""
    places = []
    for names, below, values in LARGER:
        if names[0] in terms.names and theta[terms.names.index(names[0])] < below:
            for value in values:
                place = theta.copy()
                for name, number in zip(names, value, strict=True):
                    place[terms.names.index(name)] = number
                places.append(place)
    return places


def _climbed(series: Series, here: Fit) -> Fit:
    """The top of the likelihood from a fit on, by Fisher's scoring.

    A size that has gone to nothing has little slope and less information. Their ratio still shows whether it should
    grow, so that no step ends on the flat. A size that the record hardly knows is also tried at nothing."""
    terms = here.terms
    if not terms.names:
        return here
    low, high = np.array(terms.limits(series.dt)).reshape(-1, 2).T
    size = terms.growth > 0.0
    reach = STRIDE_MOST
    for _ in range(STEPS_MOST):
        slope, information = slopes(series, here)
        here = replace(here, information=information)
        if not (np.isfinite(slope).all() and np.isfinite(information).all()):
            return here
        weak = size & (np.diag(information) < WEAK)
        falling = weak & (slope < -2.0 * PROMISE_LEAST * series.ftol) & (here.theta > low)
        while True:
            move, gain = _move(size, slope, information, low - here.theta, high - here.theta, reach)
            if gain >= PROMISE_LEAST * series.ftol:
                there = fit_at(series, terms, here.theta + move)
            elif falling.any():
                move, gain = np.where(falling, low - here.theta, 0.0), 0.0
                falling[:] = False
                there = fit_at(series, terms, here.theta + move)
            else:
                return here
            more = there.ln_likelihood - here.ln_likelihood
            if more > 0.0:
                break
            reach *= SHORTER
        here = replace(there, information=here.information)
        # Stop after a small gain that came as promised, by a step that was not shortened.
        whole = float(np.abs(move).max()) < 0.4 * reach and not (weak & (slope < 0.0)).any()
        if whole and gain < 3.0 * series.ftol and abs(more - gain) < 0.2 * gain:
            break
        reach = min(STRIDE_MOST, reach / SHORTER)
    return here


def _move(size: Mask, slope: Array, information: Array, low: Array, high: Array, reach: float) -> tuple[Array, float]:
    """A step [k] of theta between `low` and `high`, no parameter by more than `reach`, and the gain that it promises.

    A size that falls steps as a variance: ln likelihood is nearly a parabola of the variance down to 0. A size that
    grows does so beyond a step of 1: from nothing its logarithm has to go far."""
    down, up = np.where(size, 0.5 * reach, reach), np.where(size, 4.0 * reach, reach)
    bounds = np.array([np.maximum(low, -down), np.minimum(high, up)])
    bend = size & (np.array([[True], [False]]) | (bounds > 1.0))
    beyond = np.array([[0.0], [1.0]])
    bounds = np.where(bend, beyond + 0.5 * np.expm1(2.0 * (bounds - beyond)), bounds)
    step, gain = _highest(slope, information, bounds)
    start = np.where(step > 0.0, 1.0, 0.0)
    bend = size & ((step < 0.0) | (step > 1.0))
    move = np.where(bend, start + 0.5 * np.log1p(2.0 * np.where(bend, step - start, 0.0)), step)
    return np.clip(move, low, high), gain


def _highest(slope: Array, information: Array, bounds: Array) -> tuple[Array, float]:
    """Where slope x - x information x / 2 is highest between `bounds` [2, k], which hold 0, and how high. The first
    number on the way that comes to a bound is held there, and the others go on."""
    x, held = np.zeros(slope.size), np.zeros(slope.size, bool)
    curvature = information + 1e-12 * np.diag(np.diag(information)) + 1e-300 * np.eye(slope.size)
    while not held.all():
        free = ~held
        way = np.zeros(slope.size)
        left = slope[free] - curvature[free] @ x
        way[free] = np.linalg.lstsq(curvature[np.ix_(free, free)], left, rcond=1e-14)[0]
        room = np.where(way > 0.0, bounds[1], bounds[0]) - x
        share = np.where(way != 0.0, room / np.where(way != 0.0, way, 1.0), np.inf)
        first = int(np.argmin(share))
        x = x + min(1.0, max(0.0, float(share[first]))) * way
        if share[first] >= 1.0:
            break
        held[first] = True
    return x, float(slope @ x - 0.5 * x @ curvature @ x)


def _spread(information: Array) -> Array:
    """A root of the covariance of theta; 4 at most for what the record hardly knows."""
    if not np.isfinite(information).all():
        return 4.0 * np.eye(len(information))
    values, vectors = np.linalg.eigh(information)
    spread: Array = vectors / np.sqrt(np.maximum(values, 1.0 / 16.0))
    return spread


def nodes(series: Series, found: Fit) -> list[tuple[Array, float]]:
    """Nodes of the drift's parameters about a fit, within their limits, and ln of the prior share of each node.

    Within a drift, the prior of its size is Jeffreys' for a weak walk: the information of ln rho is n rho / 2. A flat
    prior counts sizes that no record distinguishes from nothing: intervals with a weak walk are then too short."""
    if not found.terms.names or series.n > SUMMED_SAMPLES_MOST or series.ftol > FTOL:
        return [(found.theta, 0.0)]
    spread = found.spread
    limits = np.array(found.terms.limits(found.dt)).reshape(-1, 2)
    k = found.theta.size
    length = np.linalg.norm(spread, axis=0)
    # Of three parameters and more only the two least known are varied.
    wide = np.argsort(-length)[:2]
    steps = [np.array(NODE_SDS) if j in wide else np.zeros(1) for j in range(k)]
    for j in wide[length[wide] > HARDLY]:
        steps[j] = _possible(series, found, spread[:, j] / length[j], limits) / length[j]
    apart = [float(np.diff(ladder).mean()) if ladder.size > 1 else 1.0 for ladder in steps]
    volume = float(np.log(length * apart).sum() - np.log(limits[:, 1] - limits[:, 0]).sum())
    places = [found.theta + spread @ np.array(z) for z in product(*steps)]
    inside = [theta for theta in places if np.all((theta >= limits[:, 0]) & (theta <= limits[:, 1]))]
    inside = inside or [found.theta]
    ln_prior = 0.5 * np.array([theta[found.terms.sizes].sum() for theta in inside])
    ln_prior -= logsumexp(ln_prior) - math.log(len(inside))
    return list(zip(inside, (volume + ln_prior).tolist(), strict=True))


def _possible(series: Series, found: Fit, direction: Array, limits: Array) -> Array:
    """Moves of theta along a `direction` that the record leaves possible, evenly spaced.

    A parameter that the record hardly knows has no normal posterior: on one side its term vanishes, and nothing changes
    any more. A single node of that plateau is kept: a term of that size acts on no coefficient."""

    def value(move: float) -> float:
        theta = found.theta + move * direction
        if np.any((theta < limits[:, 0]) | (theta > limits[:, 1])):
            return -math.inf
        return ln_likelihood(run(series, found.terms, theta)[0][0])

    found_at = {0.0: value(0.0)}
    for side in (-NODE_STEP, NODE_STEP):
        move = side
        while abs(move) < NODES_FARTHEST and (now := value(move)) >= found_at[0.0] - WALKED_NATS:
            found_at[move] = now
            move += side
    moves = np.array(sorted(found_at))
    bent = np.flatnonzero(np.abs(np.diff([found_at[float(move)] for move in moves])) >= PLATEAU)
    return moves[bent[0] : bent[-1] + 2] if bent.size else np.zeros(1)


def fit_at(series: Series, terms: Terms, theta: Array) -> Fit:
    """The fit at given parameters."""
    sums = run(series, terms, theta)[0][0]
    c, inverse, rss = sums.coefficients()
    sigma = math.sqrt(rss / sums.n)
    sd = sigma * np.sqrt(np.maximum(np.diag(inverse), 0.0))
    return Fit(terms, theta, sigma, c, sd, ln_likelihood(sums), sums.n, series.dt, series.duration_s)


def _starts(terms: Terms, limits: Array) -> list[Array]:
    """All combinations of a few guesses a parameter; a parameter without guesses is at the middle of its limits."""
    grids = [
        PARAMETERS[name].starts or (0.5 * (low + high),) for name, (low, high) in zip(terms.names, limits, strict=True)
    ]
    if len(grids) > 3:
        grids = [guess[: 2 if k < 2 else 1] for k, guess in enumerate(grids)]
    mesh = np.meshgrid(*grids, indexing="ij")
    return [np.array(point) for point in zip(*(axis.ravel() for axis in mesh), strict=True)]


def best(fits: Sequence[Fit]) -> Fit:
    """The likeliest."""
    return max(fits, key=lambda fitted: fitted.ln_likelihood)


def moved(fit_: Fit, terms: Terms, own: Mapping[str, float] = MappingProxyType({})) -> Array:
    """A start for `terms` from another model's fit: shared parameters are kept, the new begin small, or as `own`."""
    known = {**dict(zip(fit_.terms.names, fit_.theta, strict=True)), **own}
    return np.array([known.get(name, PARAMETERS[name].fresh) for name in terms.names])
