"""Stochastic realization by canonical correlations of past and future (Larimore 1983), own and short.

nfoursid keeps a matrix of n by n, 10 GB for 36 000 samples. The state is the combination of the past readings with the
greatest correlation to the future. Its regressions give the pole, the gain and the innovation variance, that is, the
equivalent ARMA form. A random walk has its pole at 1.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg
from statsmodels.tsa.stattools import levinson_durbin

from selfcal.base.grid import Array
from selfcal.studies.methods.autocorrelation import LAGS_SHARE
from selfcal.studies.methods.problem import Answer, Problem, of_coefficients

#: Lags at most; of a short record LAGS_SHARE: as many parameters take ten samples each.
LAGS_MOST = 60


def subspace(problem: Problem) -> Answer:
    """Estimates without an interval. The method gives no weights of laws."""
    y = problem.y - problem.y.mean()
    phi, gain, variance = realization(y, lags(y))
    by_law = {}
    for law in problem.drifts:
        pole = 1.0 if law == "random_walk" else phi
        by_law[law] = of_coefficients(law, pole, gain - pole, variance, problem.dt_s)
    return Answer(by_law)


def lags(y: Array) -> int:
    """Twice the order of an autoregression by AIC (Bauer, Econometric Theory 21, 2005)."""
    most = max(2, min(LAGS_MOST, round(LAGS_SHARE * y.size)))
    partial = levinson_durbin(y, most)[2][1:]
    criterion = y.size * np.cumsum(np.log1p(-(partial**2))) + 2.0 * np.arange(1, most + 1)
    return min(2 * (int(np.argmin(criterion)) + 1), most)


def realization(y: Array, count: int) -> tuple[float, float, float]:
    """Pole, gain (as y sees it) and innovation variance of x[k+1] = pole x[k] + gain e[k], y[k] = x[k] + e[k]."""
    hankel = np.lib.stride_tricks.sliding_window_view(y, 2 * count).T
    past, future = hankel[:count], hankel[count:]
    roots = [linalg.cholesky(part @ part.T, lower=True) for part in (past, future)]
    half = linalg.solve_triangular(roots[0], past @ future.T, lower=True)
    left = np.linalg.svd(linalg.solve_triangular(roots[1], half.T, lower=True).T)[0][:, 0]
    state = linalg.solve_triangular(roots[0], left, lower=True, trans=1) @ past
    now = future[0]
    state *= float(state @ now) / float(state @ state)  # so that y[k] = x[k] + e[k]
    e = now - state
    pole, gain = np.linalg.lstsq(np.stack([state, e])[:, :-1].T, state[1:], rcond=None)[0].tolist()
    return pole, gain, float(e @ e) / e.size
