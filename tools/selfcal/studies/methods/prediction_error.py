"""The equivalent ARMA form, its prediction error minimised by statsmodels."""

from __future__ import annotations

import warnings

import numpy as np
from statsmodels.tsa.arima.model import ARIMA

from selfcal.studies.methods.problem import Answer, Problem, of_coefficients

_ORDER = {"random_walk": (0, 1, 1), "gauss_markov": (1, 0, 1)}


def arma(problem: Problem) -> Answer:
    """Estimates without an interval: the coefficients' own is not for N, K, sigma_m or alpha."""
    y, dt = problem.y - problem.y.mean(), problem.dt_s
    scale = float(y.std()) or 1.0
    by_law = {}
    for law in problem.drifts:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a search that has not converged: the figures show it
            model = ARIMA(y / scale, order=_ORDER[law], trend="c" if law == "gauss_markov" else "n")
            p = dict(zip(model.param_names, np.asarray(model.fit().params, dtype=float).tolist(), strict=True))
        by_law[law] = of_coefficients(law, p.get("ar.L1", 1.0), p["ma.L1"], p["sigma2"] * scale**2, dt)
    return Answer(by_law)
