"""Recursive least squares on the equivalent ARMA form (Ljung & Soderstrom, Theory and Practice of Recursive
Identification, 1983).

The past errors are regressors, as in extended least squares. Filtered by the error polynomial, regressors are the
gradient of the prediction. Without this filter, or without forgetting the first errors, the estimates of these laws are
two to three times rougher.
"""

from __future__ import annotations

import numpy as np

from selfcal.base.grid import Array
from selfcal.studies.methods.problem import Answer, Problem, of_coefficients

#: Forgetting of the first sample, and the share that each further sample keeps of it: the early errors are poor.
FORGET, KEEP = 0.05, 0.99


def recursive_least_squares(problem: Problem) -> Answer:
    """Estimates without an interval, as for `arma`. The method gives no weights of laws."""
    by_law = {}
    for law in problem.drifts:
        y = np.diff(problem.y) if law == "random_walk" else problem.y - problem.y.mean()
        scale = float(y.std()) or 1.0
        phi, theta, variance = coefficients(y / scale, pole=law != "random_walk")
        by_law[law] = of_coefficients(law, phi, theta, variance * scale**2, problem.dt_s)
    return Answer(by_law)


def coefficients(y: Array, *, pole: bool) -> tuple[float, float, float]:
    """phi, theta and the variance of e in y[k] = phi y[k-1] + e[k] + theta e[k-1] + constant, in one pass. Without a
    `pole` phi is 1 for the sum of y and there is no constant."""
    d = 3 if pole else 1
    x, P, gradient = np.zeros(d), 1e3 * np.eye(d), np.zeros(d)
    last, e, square, forget = 0.0, 0.0, 0.0, FORGET
    for value in y.tolist():
        row = np.array([e, last, 1.0][:d])
        gradient = row - min(max(float(x[0]), -0.99), 0.99) * gradient
        error = value - float(row @ x)
        x, P = update(x, P, gradient, error, 1.0 - forget)
        last, e = value, value - float(row @ x)
        square += error * e
        forget *= KEEP
    return float(x[1]) if pole else 1.0, float(x[0]), square / y.size


def update(x: Array, P: Array, gradient: Array, error: float, kept: float = 1.0) -> tuple[Array, Array]:
    """A step of recursive least squares: coefficients and covariance after a prediction `error`. `kept`: the weight of
    all earlier samples."""
    gain = P @ gradient / (kept + float(gradient @ P @ gradient))
    return x + gain * error, (P - np.outer(gain, gradient @ P)) / kept
