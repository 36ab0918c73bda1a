"""Maximum likelihood of a noise model with regressors, by one Kalman filter over the record and every column."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from scipy.optimize import minimize

from selfcal import _likelihood
from selfcal.diagnosis import work
from selfcal.diagnosis.statemodel import Array, Terms, matrices

#: A fit has settled when a step changes ln likelihood by less than this: a hundredth of the smallest evidence told.
FTOL = 0.01
#: ... of a quick look, which ranks causes and measures none: their evidence differs by more.
ROUGH_FTOL = 0.3
#: Standard deviations of a model's parameters at which posteriors of coefficients are summed.
NODES = (-2.0, -1.0, 0.0, 1.0, 2.0)
#: Longer records know their parameters well enough: the best ones stand for all.
NODES_MOST = 100_000
#: A slope is taken over this much of a parameter's standard deviation.
NEAR = 0.1


@dataclass(frozen=True)
class Series:
    """One axis on an even grid: `y` float64[n] (NaN: missing), `dt` s, `r` float64[n] variance of the white noise
    relative to the nominal one. `columns` [p, n] of known disturbances; the first is the bias, all ones. A fit has
    settled when a step changes ln likelihood by less than `ftol`."""

    y: Array
    dt: float
    r: Array
    columns: Array
    ftol: float = FTOL

    @property
    def n(self) -> int:
        return int(np.isfinite(self.y).sum())

    @property
    def duration_s(self) -> float:
        return self.y.size * self.dt

    def beside(self, more: Array) -> Series:
        """The same with further columns [k, n]."""
        return replace(self, columns=np.ascontiguousarray(np.vstack([self.columns, np.atleast_2d(more)])))


@dataclass(frozen=True)
class Sums:
    """What one pass of the filter leaves: Gram matrix [1 + p, 1 + p] of the whitened record and columns, sum of ln s,
    samples used."""

    G: Array
    D: float
    n: float
    x: Array  # [1 + p, states]: predicted state of the next sample, of the record and of each column

    def coefficients(self) -> tuple[Array, Array, float]:
        """Least squares: coefficients [p], their covariance over sigma^2 [p, p], residual sum of squares. The last is
        infinite where the filter overflowed."""
        A, B = self.G[1:, 1:], self.G[1:, 0]
        if not np.isfinite(self.G).all():
            return np.zeros(B.size), np.zeros(A.shape), math.inf
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
    """A fitted model: `terms` at `theta`, white noise `sigma` of one sample, coefficients `c` of the columns with their
    standard deviations `sd`, and `ln_likelihood` at its maximum. `spread` [k, k], where it was asked for: a root of the
    covariance of `theta`."""

    terms: Terms
    theta: Array
    sigma: float
    c: Array
    sd: Array
    ln_likelihood: float
    n: float
    dt: float
    duration_s: float
    spread: Array = field(default_factory=lambda: np.empty((0, 0)))

    def value(self, name: str) -> float:
        """One parameter of the vector."""
        return float(self.theta[self.terms.names.index(name)])


def run(
    series: Series, terms: Terms, theta: Array, marks: Sequence[int] = (), innovations: bool = False
) -> tuple[list[Sums], Array, Array]:
    """One pass, counted as work; sums up to each of `marks` (default: the end), whitened innovations [n, 1 + p], their
    variances [n]."""
    work.count(series.y.size, len(series.columns))
    m = matrices(terms, theta, series.dt, series.duration_s)
    at = list(marks) or [series.y.size]
    G, D, n, x, white, s = _likelihood.run(
        series.y, series.columns, series.r, m.F, m.Q, m.h, m.P0, m.R, m.driver, at, innovations
    )
    return [Sums(G[k], float(D[k]), float(n[k]), x[k]) for k in range(len(at))], white, s


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
    """One pass of the filter, and one backwards over its gains: exact beside gaps, and where the noise changes."""
    m = matrices(terms, theta, series.dt, series.duration_s)
    G, D, A, B, impulse = _likelihood.shifts(series.y, series.columns, series.r, m.F, m.Q, m.h, m.P0, m.R, m.driver)
    return Shifts(Sums(G, D, float(series.n), np.empty(0)), A, B, impulse)


def ln_likelihood(sums: Sums) -> float:
    """At the best sigma and coefficients."""
    rss = sums.coefficients()[2]
    return -0.5 * (sums.n * (math.log(2.0 * math.pi * rss / sums.n) + 1.0) + sums.D)


def _cost(series: Series, terms: Terms) -> tuple[Callable[[Array], float], Array]:
    """-ln likelihood as a function of theta, steep beyond the limits [k, 2]; and those."""
    limits = np.array(terms.limits(series.dt)).reshape(-1, 2)

    def cost(theta: Array) -> float:
        outside = np.maximum(limits[:, 0] - theta, 0.0) + np.maximum(theta - limits[:, 1], 0.0)
        inside = np.clip(theta, limits[:, 0], limits[:, 1])
        return -ln_likelihood(run(series, terms, inside)[0][0]) + float((outside**2).sum()) * 1e3

    return cost, limits


def refit(series: Series, known: Fit) -> Fit:
    """The same model on much the same record: Newton steps with the curvature of the fit that is known.

    Each step takes one pass a parameter and one more. Where they do not settle the simplex method takes over."""
    cost, limits = _cost(series, known.terms)
    theta, here = known.theta, cost(known.theta)
    for _ in range(8):
        slope = np.array([(cost(theta + NEAR * root) - here) / NEAR - 0.5 * NEAR for root in known.spread.T])
        length = float(np.linalg.norm(slope))
        if 0.5 * length**2 < series.ftol:
            return finish(series, known.terms, np.clip(theta, limits[:, 0], limits[:, 1]))
        ahead = np.clip(theta - known.spread @ slope * min(1.0, 3.0 / length), limits[:, 0], limits[:, 1])
        if np.allclose(ahead, theta, rtol=0.0, atol=1e-6):  # at a limit, and the slope points beyond it
            return finish(series, known.terms, theta)
        there = cost(ahead)
        if there >= here:
            break
        theta, here = ahead, there
    return fit(series, known.terms, theta, step=0.25)


def _spread(series: Series, found: Fit) -> Array:
    """A root of the covariance of theta, by second differences; 4 at most for what the record hardly knows.

    Its columns point inwards where theta is at a limit."""
    cost, limits = _cost(series, found.terms)
    k = found.theta.size
    h = 0.2 * np.where(limits[:, 1] - limits[:, 0] < 1.0, 0.05, 1.0)
    centre = np.clip(found.theta, limits[:, 0] + h, limits[:, 1] - h)
    middle = cost(centre)
    moves = np.diag(h)
    ahead = [cost(centre + move) for move in moves]
    back = [cost(centre - move) for move in moves]
    H = np.empty((k, k))
    for i in range(k):
        H[i, i] = (ahead[i] - 2.0 * middle + back[i]) / h[i] ** 2
        for j in range(i):
            both = cost(centre + moves[i] + moves[j])
            H[i, j] = H[j, i] = (both - ahead[i] - ahead[j] + middle) / (h[i] * h[j])
    if not np.isfinite(H).all():
        return 4.0 * np.eye(k)
    values, vectors = np.linalg.eigh(H)
    spread: Array = vectors / np.sqrt(np.maximum(values, 1.0 / 16.0))
    room = (centre - found.theta) @ spread
    spread *= np.where(room < 0.0, -1.0, 1.0)
    return spread


def fit(series: Series, terms: Terms, start: Array | None = None, step: float = 0.7) -> Fit:
    """Best `theta` by the simplex method from `start`, or from the best of a few starts."""
    cost, limits = _cost(series, terms)
    if not terms.names:
        return finish(series, terms, np.empty(0))
    starts = [start] if start is not None else _starts(terms, limits)
    theta = min(starts, key=cost) if len(starts) > 1 else starts[0]
    theta = np.clip(theta, limits[:, 0], limits[:, 1])
    simplex = np.vstack([theta, *(theta + _step(theta, limits, k, step) for k in range(theta.size))])
    found = minimize(
        cost,
        theta,
        method="Nelder-Mead",
        options={
            "initial_simplex": simplex,
            "fatol": series.ftol,
            "xatol": 0.5 * math.sqrt(series.ftol),
            "maxfev": 60 * theta.size + 40,
        },
    )
    return finish(series, terms, np.clip(found.x, limits[:, 0], limits[:, 1]))


def curved(series: Series, found: Fit) -> Fit:
    """The fit with its spread, for `refit`."""
    return replace(found, spread=_spread(series, found)) if found.terms.names else found


def nodes(series: Series, found: Fit) -> list[tuple[Array, float]]:
    """Parameters of the drift about a fit's, within their limits, and ln of the share of those that each stands for."""
    if not found.terms.names or series.n > NODES_MOST or series.ftol > FTOL:
        return [(found.theta, 0.0)]
    spread = curved(series, found).spread
    limits = np.array(found.terms.limits(found.dt)).reshape(-1, 2)
    k = found.theta.size
    volume = float(np.linalg.slogdet(spread)[1] - np.log(limits[:, 1] - limits[:, 0]).sum())
    # Of three parameters and more only the two least known are varied.
    wide = set(np.argsort(-np.linalg.norm(spread, axis=0))[:2])
    grid = product(*(NODES if j in wide else (0.0,) for j in range(k)))
    places = [found.theta + spread @ np.array(z) for z in grid]
    inside = [theta for theta in places if np.all((theta >= limits[:, 0]) & (theta <= limits[:, 1]))]
    return [(theta, volume) for theta in inside or [found.theta]]


def finish(series: Series, terms: Terms, theta: Array) -> Fit:
    """The fit at given parameters."""
    sums = run(series, terms, theta)[0][0]
    c, inverse, rss = sums.coefficients()
    sigma = math.sqrt(rss / sums.n)
    sd = sigma * np.sqrt(np.maximum(np.diag(inverse), 0.0))
    return Fit(terms, theta, sigma, c, sd, ln_likelihood(sums), sums.n, series.dt, series.duration_s)


def _step(theta: Array, limits: Array, k: int, step: float) -> Array:
    move = np.zeros(theta.size)
    size = step * (0.05 if limits[k, 1] - limits[k, 0] < 1.0 else 1.0)
    move[k] = size if theta[k] + size <= limits[k, 1] else -size
    return move


_GUESSES: dict[str, tuple[float, ...]] = {
    "ln_rho": (-6.0, -4.0, -2.0),
    "ln_markov": (-3.0, -1.5, 0.0),
    "ln_alpha": (-7.0, -5.0, -3.0),
    "ln_flicker": (-3.0, -1.5),
    "color": (0.3, -0.3),
}


def _starts(terms: Terms, limits: Array) -> list[Array]:
    """All combinations of a few guesses a parameter; further ones at the middle of their limits."""
    grids = [_GUESSES.get(name, (0.5 * (low + high),)) for name, (low, high) in zip(terms.names, limits, strict=True)]
    if len(grids) > 3:
        grids = [guess[: 2 if k < 2 else 1] for k, guess in enumerate(grids)]
    mesh = np.meshgrid(*grids, indexing="ij")
    return [np.array(point) for point in zip(*(axis.ravel() for axis in mesh), strict=True)]


def best(fits: Sequence[Fit]) -> Fit:
    """The likeliest."""
    return max(fits, key=lambda one: one.ln_likelihood)


def moved(fit_: Fit, terms: Terms) -> Array:
    """A start for `terms` from another model's fit: shared parameters are kept, new ones begin small."""
    known = dict(zip(fit_.terms.names, fit_.theta, strict=True))
    fresh = {"ln_rho": -6.0, "ln_markov": -2.5, "ln_alpha": -4.0, "ln_flicker": -3.0, "color": 0.2}
    return np.array([known.get(name, fresh.get(name, 0.0)) for name in terms.names])
