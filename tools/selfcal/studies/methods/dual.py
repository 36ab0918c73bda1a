"""Dual estimation (Wan & Nelson 2001): an extended Kalman filter for level and drift, another for the parameters.

The filter of the parameters has two measurements. The first is the reading: its prediction depends on the parameters
through the state and the gain, whose derivatives the sensitivity recursion carries (Ljung 1979). So the ratio of the
noises and alpha are seen, unlike in the joint filter. No prediction depends on the scale that the noises share. The
second measurement sees the scale: the logarithm of the squared innovation, whose mean is that of the innovation
variance less 1.27, and whose variance is pi^2 / 2.
"""

from __future__ import annotations

import math

import numpy as np

from selfcal.base.grid import Array
from selfcal.model.laws import NAMED
from selfcal.studies.methods.problem import FIRST_LEVEL_SD, Answer, Problem, Value, ln_moments, logarithmic
from selfcal.studies.methods.recursive import FORGET, KEEP

#: The parameters stay within this many sd of the prior's mean: a poor first step leads no further.
MEAN_REACH = 3.0
ROW = np.ones(2)


def dual_ekf(problem: Problem) -> Answer:
    """Mean and covariance of the parameters after the last reading. The method gives no weights of laws."""
    return Answer({law: _run(problem, law) for law in problem.drifts})


def _run(problem: Problem, law: str) -> dict[str, Value]:
    y, dt = problem.y - problem.y[0], problem.dt_s
    names = NAMED[law].parameters
    middle, sd = np.array([ln_moments(problem.group.priors[name]) for name in names]).T
    ln, covariance = middle.copy(), np.diag(sd**2)
    d = ln.size
    x, P = np.zeros(2), np.diag([(FIRST_LEVEL_SD * float(y.std())) ** 2, 0.0])
    dx, dP = np.zeros((d, 2)), np.zeros((d, 2, 2))
    if law == "gauss_markov":
        P[1, 1] = math.exp(2.0 * ln[1])
        dP[1, 1, 1] = 2.0 * P[1, 1]
    forget = FORGET
    for value in y.tolist():
        covariance = covariance / (1.0 - forget)
        forget *= KEEP
        F, dF, Q, dQ, R, dR = transition(law, ln, dt)
        x, dx = F @ x, dx @ F + dF @ x
        moved = dF @ P @ F
        P, dP = F @ P @ F + Q, F @ dP @ F + moved + moved.transpose(0, 2, 1) + dQ
        PH, dPH = P @ ROW, dP @ ROW
        S, dS = float(PH @ ROW) + R, dPH @ ROW + dR
        e, de = value - float(x @ ROW), -dx @ ROW
        seen = np.array([-de, dS / S])
        # Less the mean of ln chi^2 of one degree of freedom.
        surprise = np.array([e, math.log(e * e / S + np.finfo(float).eps) + 1.270363])
        # With the variance of that ln chi^2.
        total = seen @ covariance @ seen.T + np.diag([S, (0.5 * math.pi**2)])
        gain = np.linalg.solve(total, seen @ covariance).T
        ln = np.clip(ln + gain @ surprise, middle - MEAN_REACH * sd, middle + MEAN_REACH * sd)
        covariance = covariance - gain @ total @ gain.T
        K = PH / S
        dK = dPH / S - np.outer(dS, PH) / S**2
        x, dx = x + K * e, dx + dK * e + np.outer(de, K)
        P, dP = P - np.outer(K, PH), dP - dK[:, :, None] * PH - K[:, None] * dPH[:, None, :]
    return logarithmic(names, ln, covariance)


def transition(law: str, ln: Array, dt: float) -> tuple[Array, Array, Array, Array, float, Array]:
    """F (diagonal, so its own transpose), Q and R of level and drift, each followed by its derivatives in ln theta."""
    d = ln.size
    F, dF, Q, dQ, dR = np.eye(2), np.zeros((d, 2, 2)), np.zeros((2, 2)), np.zeros((d, 2, 2)), np.zeros(d)
    R = math.exp(2.0 * ln[0]) / dt
    dR[0] = 2.0 * R
    if law == "random_walk":
        Q[1, 1] = math.exp(2.0 * ln[1]) * dt
        dQ[1, 1, 1] = 2.0 * Q[1, 1]
        return F, dF, Q, dQ, R, dR
    rate = math.exp(ln[2]) * dt
    variance, phi = math.exp(2.0 * ln[1]), math.exp(-rate)
    F[1, 1], dF[2, 1, 1] = phi, -rate * phi
    Q[1, 1] = variance * -math.expm1(-2.0 * rate)
    dQ[1, 1, 1], dQ[2, 1, 1] = 2.0 * Q[1, 1], 2.0 * rate * variance * phi**2
    return F, dF, Q, dQ, R, dR
