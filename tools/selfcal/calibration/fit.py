"""Gauss-Newton with correlated noise and a normal prior, and what the information identifies."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.stats import chi2

from selfcal.base.errors import UserError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
#: Residuals [m], their derivatives [m, n] and their covariance [m, m] at parameters [n].
Problem = Callable[[Array], tuple[Array, Array, Array]]

#: Iterations at most, and the last step, in posterior sd.
ITERATIONS, SETTLED = 50, 1e-5
#: A parameter is identified if the data leave this share of its prior variance at most.
IDENTIFIED = 0.1
#: Probability, a calibration, that residuals of a right model are called too large, and that a cause is named.
FALSE_ALARM = 0.005
#: Shares of a drift's mean square under a wide prior that are weighed: three decades of its deviation.
SHARES = 10.0 ** -np.arange(0.0, 6.5, 0.75)
#: Residuals beyond the parameters that a check takes at least.
FREE_LEAST = 0.5


@dataclass(frozen=True)
class Fit:
    """Parameters `theta` [n] with their covariance [n, n], and the `prior` covariance [n, n] that they are held by.
    `white` [m] are the residuals and `columns` [m, n] their derivatives, both in units of their noise; `root` [m, m]
    makes them so: it is the factor of their covariance. `pulled`: the prior's part of the sum of squares."""

    theta: Array
    covariance: Array
    prior: Array
    white: Array
    columns: Array
    root: Array
    pulled: float

    @property
    def evidence(self) -> float:
        """ln of the likelihood under the prior, but for a constant (Laplace)."""
        factor = np.linalg.cholesky(self.prior)
        seen = self.columns @ factor
        size = float(np.linalg.slogdet(np.eye(factor.shape[0]) + seen.T @ seen)[1])
        noise = 2.0 * float(np.log(np.diag(self.root)).sum())
        return -0.5 * (float(self.white @ self.white) + self.pulled + noise + size)

    @property
    def left(self) -> Array:
        """Share of each prior variance that the data leave [n]."""
        left: Array = np.diag(self.covariance) / np.maximum(np.diag(self.prior), 1e-300)
        return left

    @property
    def identified(self) -> Mask:
        """[n]."""
        found: Mask = self.left <= IDENTIFIED
        return found

    @property
    def free(self) -> float:
        """Residuals less the parameters that they settle."""
        return self.white.size - float(np.trace(self.columns @ self.covariance @ self.columns.T))

    @property
    def excess(self) -> float:
        """Probability that residuals are as large as these by chance; NaN where too few are left to say."""
        return float(chi2.sf(self.white @ self.white, self.free)) if self.free > FREE_LEAST else math.nan

    @property
    def ratio(self) -> float:
        """rms of the residuals in their own sd; NaN where too few are left to say."""
        return math.sqrt(float(self.white @ self.white) / self.free) if self.free > FREE_LEAST else math.nan

    def gain(self, columns: Array) -> tuple[float, Array]:
        """Probability by chance of what further columns [m, k] of the residuals explain, and their coefficients [k]."""
        more = solve_triangular(self.root, columns, lower=True)
        apart = more - self.columns @ (self.covariance @ (self.columns.T @ more))
        normal = more.T @ apart
        values, vectors = np.linalg.eigh(normal)
        kept = values > 1e-9 * max(float(values.max(initial=0.0)), float(np.trace(more.T @ more)))
        inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
        c: Array = inverse @ (apart.T @ self.white)
        return float(chi2.sf(c @ normal @ c, max(int(kept.sum()), 1))), -c


def fit(problem: Problem, start: Array, mean: Array, prior: Array, held: Mask | None = None) -> Fit:
    """The likeliest parameters [n] under a normal prior of `mean` [n] and covariance `prior` [n, n]. Those `held` [n]
    stay at their mean, as if their prior variance were 0. Raises UserError where no step settles."""
    free = np.ones(start.size, bool) if held is None else ~held
    theta = np.where(free, start, mean)
    block = np.ix_(free, free)
    unit = np.sqrt(np.diag(prior))[free]
    inverse = np.linalg.inv(prior[block] / np.outer(unit, unit))
    for _ in range(ITERATIONS):
        r, J, R = problem(theta)
        if not (np.isfinite(r).all() and np.isfinite(J).all() and np.isfinite(R).all()):
            break
        root = np.linalg.cholesky(R)
        white, columns = (solve_triangular(root, one, lower=True) for one in (r, J))
        own = columns[:, free] * unit
        covariance = np.linalg.inv(own.T @ own + inverse)
        step = -covariance @ (own.T @ white + inverse @ ((theta - mean)[free] / unit))
        theta = theta.copy()
        theta[free] += step * unit
        if float(np.max(np.abs(step) / np.sqrt(np.diag(covariance)))) < SETTLED:
            r, J, R = problem(theta)
            root = np.linalg.cholesky(R)
            white, columns = (solve_triangular(root, one, lower=True) for one in (r, J))
            whole = np.zeros(prior.shape)
            whole[block] = covariance * np.outer(unit, unit)
            apart = (theta - mean)[free] / unit
            return Fit(theta, whole, prior, white, columns * free, np.asarray(root), float(apart @ inverse @ apart))
    raise UserError("the fit does not settle: are the logs of one part, and its axes in the units of their headings?")


def drift_share(fit_at: Callable[[float], Fit]) -> float:
    """Posterior mean of the share of a drift's prior variance that residuals support, log-uniform before. `fit_at`: the
    fit at a share."""
    evidence = np.array([fit_at(float(one)).evidence for one in SHARES])
    weight = np.exp(evidence - evidence.max())
    return float(weight @ SHARES / weight.sum())
