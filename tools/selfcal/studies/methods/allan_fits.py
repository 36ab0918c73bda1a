"""The Allan deviation as users read it: by slopes (kalibr_allan, allan_variance_ros), and by a weighted fit."""

from __future__ import annotations

import math

import numpy as np

from selfcal.base.grid import Array
from selfcal.model.laws import NAMED
from selfcal.studies.methods.problem import Answer, Problem, Value, weights


def curve(problem: Problem) -> tuple[Array, Array, Array]:
    """Averaging times in readings, overlapping Allan deviations, and equivalent degrees of freedom (white noise,
    Riley's approximation N (1/m) 4m^2/(4m^2+5) of NIST SP 1065)."""
    n = problem.y.size
    m, variance = problem.octaves()
    freedom = (1.5 * (n - 1) / m - 2.0 * (n - 2) / n) * 4.0 * m**2 / (4.0 * m**2 + 5.0)
    return m, np.sqrt(variance), np.maximum(freedom, 1.0)


def slopes(problem: Problem) -> Answer:
    """N from a line of slope -1/2 read at 1 s, K from a line of slope +1/2 read at 3 s. Each line goes through the
    points whose own slope is near its slope. No interval and no choice of a law: the method has neither."""
    m, deviation, _ = curve(problem)
    ln_tau, ln_deviation = np.log(m * problem.dt_s), np.log(deviation)
    slope = np.gradient(ln_deviation, ln_tau) if m.size > 1 else np.array([-0.5])
    # A slope within 1/4 of +-1/2 is half-way to the flat part.
    falling, rising = (np.abs(slope - own) <= 0.25 for own in (-0.5, 0.5))
    falling &= np.cumsum(~falling) == 0  # the first stretch alone: later points may fall by chance
    if not falling.any():
        falling[0] = True
    N = Value(math.exp(float((ln_deviation + 0.5 * ln_tau)[falling].mean())))
    K = Value(math.nan)
    if rising.any():
        K = Value(math.exp(float((ln_deviation - 0.5 * ln_tau)[rising].mean()) + 0.5 * math.log(3.0)))
    return Answer({"random_walk": {"N": N, "K": K}} if "random_walk" in problem.laws else {"constant": {"N": N}})


def fit_weighted(problem: Problem) -> Answer:
    """Weighted least squares in the logarithm of the Allan variance, each point with its own degrees of freedom. The
    points count as independent, as is the practice. Laws are weighed by AIC of this fit."""
    m, deviation, freedom = curve(problem)
    ln_variance = 2.0 * np.log(deviation)

    def objective(law: str, ln_theta: Array) -> float:
        model = np.log(problem.terms(law, ln_theta).allan_variance(m))
        return -0.25 * float((freedom * (ln_variance - model) ** 2).sum())

    peaks = problem.peaks(objective, m.size)
    criterion = {law: 2.0 * len(NAMED[law].parameters) - 2.0 * peak.value for law, peak in peaks.items()}
    return Answer.of(peaks, {"AIC": weights(criterion)})
