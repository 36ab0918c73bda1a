"""The traditional fit of the correlation function: what the paper calls the classical way."""

from __future__ import annotations

import math

import numpy as np
from scipy import fft, optimize

from selfcal.base.grid import Array
from selfcal.studies.methods.problem import Answer, Problem, Value, root

#: Lags of the fit, as a part of the record: beyond it the estimate is noise.
LAGS_SHARE = 0.1


def covariances(y: Array, u: Array, lags: int) -> Array:
    """Covariances of y[k] and u[k - lag], biased estimates [lags] about the means, from lag 0 on."""
    size = fft.next_fast_len(2 * y.size, real=True)
    product = fft.rfft(y - y.mean(), size) * np.conj(fft.rfft(u - u.mean(), size))
    return np.asarray(fft.irfft(product, size)[:lags] / y.size)


def autocorrelation(problem: Problem) -> Answer:
    """Random walk: from the first two covariances of the differences. Gauss-Markov: an exponential through the
    covariances by least squares. The method states no interval and chooses no law."""
    dt = problem.dt_s
    by_law: dict[str, dict[str, Value]] = {}
    if "random_walk" in problem.laws:
        difference = np.diff(problem.y)
        step = covariances(difference, difference, 2)
        white, walk = -step[1], step[0] + 2.0 * step[1]
        by_law["random_walk"] = {"N": root(white * dt), "K": root(walk / dt)}
    if "gauss_markov" in problem.laws:
        c = covariances(problem.y, problem.y, max(4, round(LAGS_SHARE * problem.y.size)))
        lag = np.arange(1, c.size) * dt

        def distance(theta: Array) -> Array:
            return np.asarray(theta[0] * np.exp(-math.exp(theta[1]) * lag) - c[1:])

        start = [max(float(c[1]), 1e-3 * float(c[0])), -math.log(float(lag[-1]) / 3.0)]
        bounds = ([0.0, math.log(1e-3 / lag[-1])], [np.inf, math.log(10.0 / dt)])
        variance, ln_alpha = optimize.least_squares(distance, start, bounds=bounds, x_scale=[c[0], 1.0]).x
        by_law["gauss_markov"] = {
            "N": root((c[0] - variance) * dt),
            "sigma_m": root(variance),
            "alpha": Value(math.exp(float(ln_alpha))),
        }
    return Answer(by_law)
