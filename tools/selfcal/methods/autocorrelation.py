"""The traditional fit of the correlation function: what the paper calls the classical way."""

from __future__ import annotations

import math

import numpy as np
from scipy import fft, optimize

from selfcal.methods.problem import Answer, Floats, Problem, Value

#: Lags of the fit, as a part of the record: beyond it the estimate is noise.
PART = 0.1


def autocovariance(y: Floats, lags: int) -> Floats:
    """Biased estimate [lags] about the mean."""
    size = fft.next_fast_len(2 * y.size, real=True)
    power = np.abs(fft.rfft(y - y.mean(), size)) ** 2
    return np.asarray(fft.irfft(power, size)[:lags] / y.size)


def autocorrelation(problem: Problem) -> Answer:
    """Random walk: from the first two covariances of the differences. Gauss-Markov: an exponential through the
    covariances by least squares. The method states no interval and chooses no law."""
    dt = problem.dt_s
    found: dict[str, dict[str, Value]] = {}
    if "random_walk" in problem.laws:
        step = autocovariance(np.diff(problem.y), 2)
        white, walk = -step[1], step[0] + 2.0 * step[1]
        found["random_walk"] = {"N": _root(white * dt), "K": _root(walk / dt)}
    if "gauss_markov" in problem.laws:
        c = autocovariance(problem.y, max(4, round(PART * problem.y.size)))
        lag = np.arange(1, c.size) * dt

        def distance(at: Floats) -> Floats:
            return np.asarray(at[0] * np.exp(-math.exp(at[1]) * lag) - c[1:])

        start = [max(float(c[1]), 1e-3 * float(c[0])), -math.log(float(lag[-1]) / 3.0)]
        bounds = ([0.0, math.log(1e-3 / lag[-1])], [np.inf, math.log(10.0 / dt)])
        variance, ln_alpha = optimize.least_squares(distance, start, bounds=bounds, x_scale=[c[0], 1.0]).x
        found["gauss_markov"] = {
            "N": _root((c[0] - variance) * dt),
            "sigma_m": _root(variance),
            "alpha": Value(math.exp(float(ln_alpha))),
        }
    return Answer(found)


def _root(square: float) -> Value:
    """NaN of a negative variance: the method has no answer then."""
    return Value(math.sqrt(float(square)) if square > 0.0 else math.nan)
