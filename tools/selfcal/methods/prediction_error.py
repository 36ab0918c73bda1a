"""The equivalent ARMA form, its prediction error minimised by statsmodels.

A random walk under white noise is ARIMA(0,1,1), Gauss-Markov under white noise ARMA(1,1). The parameters follow from
the coefficients; where the coefficients belong to no such sum there is no answer.
"""

from __future__ import annotations

import math
import warnings

import numpy as np
from statsmodels.tsa.arima.model import ARIMA

from selfcal.methods.problem import Answer, Problem, Value

_ORDER = {"random_walk": (0, 1, 1), "gauss_markov": (1, 0, 1)}


def arma(problem: Problem) -> Answer:
    """Estimates without an interval: the coefficients' own is not one of N, K, sigma_m or alpha."""
    y, dt = problem.y - problem.y.mean(), problem.dt_s
    scale = float(y.std()) or 1.0
    found: dict[str, dict[str, Value]] = {}
    for law in problem.drifts:
        if law not in _ORDER:
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a search that has not converged: the figures show it
            model = ARIMA(y / scale, order=_ORDER[law], trend="c" if law == "gauss_markov" else "n")
            p = dict(zip(model.param_names, np.asarray(model.fit().params, dtype=float).tolist(), strict=True))
        theta, variance = p["ma.L1"], p["sigma2"] * scale**2
        if law == "random_walk":
            found[law] = {"N": _root(-theta * variance * dt), "K": _root((1.0 + theta) ** 2 * variance / dt)}
            continue
        phi = p["ar.L1"]
        white = -theta * variance / phi if phi else math.nan
        step = (1.0 + theta**2) * variance - (1.0 + phi**2) * white
        found[law] = {
            "N": _root(white * dt),
            "sigma_m": _root(step / (1.0 - phi**2)),
            "alpha": Value(-math.log(phi) / dt if 0.0 < phi < 1.0 else math.nan),
        }
    return Answer(found)


def _root(square: float) -> Value:
    return Value(math.sqrt(square) if square > 0.0 else math.nan)
