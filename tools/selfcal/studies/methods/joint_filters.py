"""Joint estimation of state and parameters by the extended and the unscented Kalman filter of filterpy.

The state is the level, the drift and the logarithms of the parameters. A noise variance moves no prediction of the
reading, so its correlation with the innovation is zero and its estimate stays where it began. Only alpha, which is in
the transition, can move. The table shows this.
"""

from __future__ import annotations

import math

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from selfcal.base.grid import Array
from selfcal.model.laws import NAMED
from selfcal.studies.methods.problem import FIRST_LEVEL_SD, Answer, Problem, Value, ln_moments, logarithmic


def ekf(problem: Problem) -> Answer:
    """Mean and covariance of the last state."""
    return Answer({law: _run(problem, law, unscented=False) for law in problem.drifts})


def ukf(problem: Problem) -> Answer:
    """Mean and covariance of the last state."""
    return Answer({law: _run(problem, law, unscented=True) for law in problem.drifts})


def _run(problem: Problem, law: str, *, unscented: bool) -> dict[str, Value]:
    y, dt = problem.y - problem.y[0], problem.dt_s
    prior = [ln_moments(problem.group.priors[name]) for name in NAMED[law].parameters]
    mean = np.array([0.0, 0.0, *(m for m, _ in prior)])
    start = {"random_walk": 0.0, "gauss_markov": math.exp(prior[1][0])}[law]
    sd = np.array([FIRST_LEVEL_SD * float(y.std()), start, *(s for _, s in prior)])
    d = mean.size

    def phi(x: Array) -> float:
        return math.exp(-min(math.exp(min(x[4], 50.0)) * dt, 700.0)) if law == "gauss_markov" else 1.0

    def step_variance(x: Array) -> float:
        size = math.exp(2.0 * min(x[3], 50.0))
        return size * (1.0 - phi(x) ** 2) if law == "gauss_markov" else size * dt

    def move(x: Array, _dt: float) -> Array:
        moved = x.copy()
        moved[1] *= phi(x)
        return moved

    if unscented:
        points = MerweScaledSigmaPoints(d, alpha=0.5, beta=2.0, kappa=0.0)
        joint = UnscentedKalmanFilter(d, 1, dt, lambda x: np.array([x[0] + x[1]]), move, points)
        joint.x = mean.copy()
    else:
        joint = ExtendedKalmanFilter(d, 1)
        joint.x = mean[:, None].copy()
    joint.P = np.diag(sd**2 + 1e-18)
    row = np.zeros((1, d))
    row[0, :2] = 1.0
    for value in y.tolist():
        state = np.asarray(joint.x).ravel()
        joint.Q = np.zeros((d, d))
        joint.Q[1, 1] = step_variance(state)
        joint.R = np.array([[math.exp(2.0 * min(state[2], 50.0)) / dt]])
        if unscented:
            joint.predict()
            joint.P = 0.5 * (joint.P + joint.P.T) + 1e-18 * np.eye(d)
            joint.update(np.array([value]))
        else:
            joint.F = np.eye(d)
            joint.F[1, 1] = phi(state)
            if law == "gauss_markov":
                joint.F[1, 4] = -math.exp(state[4]) * dt * phi(state) * state[1]
            moved = move(state, dt)
            joint.P = joint.F @ joint.P @ joint.F.T + joint.Q
            joint.x = moved[:, None]
            joint.update(np.array([[value]]), lambda _: row, lambda x: row @ x)
    return logarithmic(NAMED[law].parameters, np.asarray(joint.x).ravel()[2:], np.asarray(joint.P)[2:, 2:])
