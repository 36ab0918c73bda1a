"""Gauss-Newton with correlated noise and a normal prior, and what the information identifies."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.stats import chi2

from selfcal import _library32
from selfcal.base.errors import UserError
from selfcal.base.grid import Array, Mask
from selfcal.readings.budget import FALSE_ALARM

#: Residuals [m], their derivatives [m, n] and their covariance [m, m] at parameters [n].
Problem = Callable[[Array], tuple[Array, Array, Array]]

#: Most iterations, and most halvings of a step. A step below 0.3 posterior sd is taken as it is. The last step is below
#: 1e-4 posterior sd.
ITERATIONS_MOST, HALVINGS = 50, 8
UNSETTLED = "the fit does not settle: are the logs of one part, and its axes in the units of their headings?"
NO_NOISE = "the readings at rest have no noise, not even a lattice: they are not of a sensor"
#: Largest share of its prior variance that the data leave an identified parameter, and the factor by which priors are
#: wider then.
VARIANCE_LEFT_MOST: float = _library32.TUMBLE_LEFT
WIDER: float = _library32.TUMBLE_WIDER


@dataclass(frozen=True)
class TumbleFit:
    """Parameters `theta` [n] with their covariance [n, n], and the `prior` covariance [n, n] that they are held by.
    `white` [m] are the residuals and `columns` [m, n] their derivatives, both in units of their noise; `root` [m, m]
    scales them: it is the factor of their covariance. `pulled`: the prior's part of the sum of squares. `step`
    [n]: to the least sum of squares by these derivatives, which takes `gain` off it. `outside`: places of parameters of
    the surroundings, whose prior is no part's."""

    theta: Array
    covariance: Array
    prior: Array
    white: Array
    columns: Array
    root: Array
    pulled: float
    step: Array
    gain: float
    outside: tuple[int, ...] = ()

    @property
    def squares(self) -> float:
        """Sum of squares of the residuals and the prior."""
        return float(self.white @ self.white) + self.pulled

    def _informed(self, least: float) -> tuple[Array, Array]:
        """The prior's factor [n, n], and the information in its units, with `least` of the prior's own of the part."""
        factor = np.asarray(np.linalg.cholesky(self.prior), float)
        scaled = self.columns @ factor
        share = np.full(len(factor), least)
        share[list(self.outside)] = 1.0
        return factor, scaled.T @ scaled + np.diag(share)

    @property
    def evidence(self) -> float:
        """ln of the likelihood under the prior, but for a constant (Laplace), at the end of the step."""
        size = float(np.linalg.slogdet(self._informed(1.0)[1])[1])
        return -0.5 * (self.squares - self.gain + 2.0 * float(np.log(np.diag(self.root)).sum()) + size)

    def widened(self) -> Array:
        """The covariance [n, n] were every prior WIDER times as wide: no parameter is known by another's prior."""
        factor, information = self._informed(WIDER**-2)
        return np.asarray(factor @ np.linalg.inv(information) @ factor.T)

    @property
    def identified(self) -> Mask:
        """Whether the data alone leave a small share of each prior variance [n]."""
        return np.asarray(np.diag(self.widened()) <= VARIANCE_LEFT_MOST * np.diag(self.prior))

    @property
    def free(self) -> float:
        """Residuals less the parameters that they settle."""
        return self.white.size - float(np.trace(self.columns @ self.covariance @ self.columns.T))

    @property
    def excess(self) -> float:
        """Probability that residuals are as large as these by chance; NaN where none is left over."""
        return float(chi2.sf(self.white @ self.white, self.free)) if self.free >= 1.0 else math.nan

    @property
    def ratio(self) -> float:
        """rms of the residuals in their own sd; NaN where too few are left to say."""
        return math.sqrt(float(self.white @ self.white) / self.free) if self.free >= 1.0 else math.nan

    def surest(self, tried: Sequence[tuple[str, Array]]) -> list[tuple[str, float]]:
        """Causes that explain more than chance, each in words and by its columns [m, k] of the residuals, the surest
        first; with their probability by chance, corrected for the number of causes."""
        if not math.isfinite(self.excess):
            return []
        more = solve_triangular(self.root, np.hstack([columns for _, columns in tried]), lower=True)
        apart = more - self.columns @ (self.covariance @ (self.columns.T @ more))
        ranked, first = [], 0
        for said, columns in tried:
            own = slice(first, first + columns.shape[1])
            first = own.stop
            normal, pull = more[:, own].T @ apart[:, own], apart[:, own].T @ self.white
            explained = float(pull @ np.linalg.pinv(normal, 1e-9, hermitian=True) @ pull)
            count = max(int(np.linalg.matrix_rank(normal, hermitian=True)), 1)
            ranked.append((float(chi2.sf(explained, count)) * len(tried), -explained, said))
        return [(said, min(1.0, p)) for p, _, said in sorted(ranked) if p < FALSE_ALARM]


def linearized(problem: Problem, theta: Array, mean: Array, prior: Array, held: Mask | None = None) -> TumbleFit:
    """The problem at parameters, as `fit_tumble` has it. Raises UserError."""
    free = np.ones(theta.size, bool) if held is None else ~held
    block = np.ix_(free, free)
    unit = np.sqrt(np.diag(prior))[free]
    r, J, R = problem(theta)
    if not all(np.isfinite(part).all() for part in (r, J, R)):
        raise UserError(UNSETTLED)
    apart = (theta - mean)[free] / unit
    try:
        inverse = np.linalg.inv(prior[block] / np.outer(unit, unit))
        root = np.asarray(np.linalg.cholesky(R))
        white, columns = (solve_triangular(root, part, lower=True) for part in (r, J * free))
        own = columns[:, free] * unit
        covariance = np.linalg.inv(own.T @ own + inverse)
    except np.linalg.LinAlgError:
        raise UserError(NO_NOISE) from None
    whole, step = np.zeros(prior.shape), np.zeros(theta.size)
    whole[block] = covariance * np.outer(unit, unit)
    pull = own.T @ white + inverse @ apart
    moved = -covariance @ pull
    step[free] = moved * unit
    return TumbleFit(
        theta, whole, prior, white, columns, root, float(apart @ inverse @ apart), step, float(-moved @ pull)
    )


def fit_tumble(problem: Problem, start: Array, mean: Array, prior: Array, held: Mask | None = None) -> TumbleFit:
    """The likeliest parameters [n] under a normal prior of `mean` [n] and covariance `prior` [n, n]. Those `held` [n]
    stay at their mean, as if their prior variance were 0. A step that makes the sum of squares larger is halved.
    Raises UserError where none settles."""
    current = linearized(problem, start if held is None else np.where(held, mean, start), mean, prior, held)
    for _ in range(ITERATIONS_MOST):
        step, sd = current.step, np.sqrt(np.diag(current.covariance))
        far = float(np.max(np.abs(step[sd > 0.0]) / sd[sd > 0.0]))
        following = linearized(problem, current.theta + step, mean, prior, held)
        for _ in range(HALVINGS if far > 0.3 else 0):
            if following.squares < current.squares:
                break
            step = 0.5 * step
            following = linearized(problem, current.theta + step, mean, prior, held)
        current = following
        if far < 1e-4:
            return current
    raise UserError(UNSETTLED)
