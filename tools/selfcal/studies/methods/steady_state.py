"""The Kalman filter's likelihood with the steady-state gain from the first sample on (Ye, Bar-Shalom et al., IEEE
Sensors J. 24(24), 2024; own derivation). A recursion for each parameter value, the scale in closed form."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from scipy import signal

from selfcal.base.grid import Array
from selfcal.studies.methods.problem import Answer, Problem


def steady_state(problem: Problem) -> Answer:
    """Estimates with intervals from the curvature. The method gives no weights of laws."""
    return Answer.of(problem.peaks(partial(ln_likelihood, problem)))


def ln_likelihood(problem: Problem, law: str, ln_theta: Array) -> float:
    """ln likelihood of all samples but the first, or about the best constant where the law has a mean."""
    y = problem.y
    r = math.exp(2.0 * ln_theta[0]) / problem.dt_s
    phi, q = map(float, problem.step(law, ln_theta) if law != "constant" else (0.0, 0.0))
    if law == "random_walk":
        p = 0.5 * (q + math.sqrt(q * q + 4.0 * q * r))
        g = p / (p + r)
        e = signal.lfilter([1.0], [1.0, -(1.0 - g)], np.diff(y))
        return float(-0.5 * e.size * math.log(p + r) - 0.5 * (e @ e) / (p + r))
    b = (1.0 - phi * phi) * r - q
    p = 0.5 * (-b + math.sqrt(b * b + 4.0 * q * r))
    g = p / (p + r)
    whitened = signal.lfilter([1.0, -phi], [1.0, -phi * (1.0 - g)], np.stack([y - y.mean(), np.ones(y.size)]), axis=1)
    e, u = whitened
    square = float(e @ e - (e @ u) ** 2 / (u @ u))
    return float(-0.5 * y.size * math.log(p + r) - 0.5 * square / (p + r))
