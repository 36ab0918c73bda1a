"""Maximum likelihood by statsmodels' unobserved components, the laws weighed by AIC and BIC."""

from __future__ import annotations

import math
import warnings

import numpy as np
from scipy import optimize
from statsmodels.tsa.statespace.structural import UnobservedComponents

from selfcal.base.grid import Array
from selfcal.model.laws import NAMED
from selfcal.studies.methods.problem import Answer, Problem, Value, information_criteria, logarithmic

#: Names of the laws in statsmodels. All have a free level, so their likelihoods are of the same samples.
_MODEL = {"constant": {"level": "dconstant"}, "random_walk": {"level": "llevel"}}
_MODEL["gauss_markov"] = {"level": "dconstant", "autoregressive": 1}  # type: ignore[dict-item]


def maximum_likelihood(problem: Problem) -> Answer:
    """Estimates with intervals from the observed information, as normal in the logarithm."""
    scale = float(problem.y.std()) or 1.0
    y = (problem.y - problem.y.mean()) / scale
    estimates: dict[str, dict[str, Value]] = {}
    ln_likelihood: dict[str, float] = {}
    for law in problem.laws:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a search that has not converged: the figures show it
            fitted = UnobservedComponents(y, **_MODEL[law]).fit(disp=False, maxiter=200)
        ln_likelihood[law] = float(fitted.llf) - y.size * math.log(scale)
        parameters = np.asarray(fitted.params, dtype=float)
        try:
            covariance = np.asarray(fitted.cov_params(), dtype=float)
        except (np.linalg.LinAlgError, ValueError):
            covariance = np.full((parameters.size, parameters.size), math.nan)
        estimates[law] = _continuous(law, parameters, covariance, scale, problem.dt_s)
    return Answer(estimates, information_criteria(ln_likelihood, y.size))


def _continuous(law: str, fitted: Array, covariance: Array, scale: float, dt_s: float) -> dict[str, Value]:
    """Parameters of continuous time; the interval by the derivatives of their logarithms."""

    def ln_of(p: Array) -> Array:
        N = 0.5 * _ln(p[0] * scale**2 * dt_s)
        if law == "constant":
            return np.array([N])
        if law == "random_walk":
            return np.array([N, 0.5 * _ln(p[1] * scale**2 / dt_s)])
        variance, phi = p[1], p[2]
        return np.array([N, 0.5 * _ln(variance * scale**2 / (1.0 - phi**2)), _ln(-_ln(phi) / dt_s)])

    slope = np.atleast_2d(optimize.approx_fprime(fitted, ln_of, 1e-5 * np.abs(fitted) + 1e-12))
    return {
        name: value if math.isfinite(value.value) and value.value > 0.0 else Value(math.nan)
        for name, value in logarithmic(NAMED[law].parameters, ln_of(fitted), slope @ covariance @ slope.T).items()
    }


def _ln(value: float) -> float:
    """NaN of what has no logarithm: the method has no answer then."""
    return math.log(value) if value > 0.0 else math.nan
