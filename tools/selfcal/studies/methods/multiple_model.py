"""Multiple-model adaptive estimation by filterpy: a Kalman filter a node of a coarse grid, over all laws at once.

A filter costs 0.1 ms a reading, so the grid leaves the white noise out. Each node has the white noise with which it
explains the variance of the differences.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from filterpy.kalman import KalmanFilter, MMAEFilterBank

from selfcal.base.grid import Array
from selfcal.model.laws import NAMED
from selfcal.studies.methods.dense_grid import ln_density, ln_limits
from selfcal.studies.methods.problem import FIRST_LEVEL_SD, Answer, Problem, Value

#: Nodes of the drift's parameter and of alpha, each in the middle of a cell of the prior's range.
NODES: dict[str, tuple[int, ...]] = {"constant": (), "random_walk": (12,), "gauss_markov": (6, 6)}
#: The least white noise of a node, as a part of the variance of the differences.
WHITE_SHARE_LEAST = 1e-4


def mmae(problem: Problem) -> Answer:
    """Weighted medians; intervals but for the white noise; laws by their probability."""
    grids = {law: nodes(problem, law) for law in problem.laws}
    filters = [kalman_filter(problem, law, theta) for law, (grid, _) in grids.items() for theta in grid.T]
    bank = MMAEFilterBank(filters, np.concatenate([mass for _, mass in grids.values()]) / len(grids), dim_x=2)
    for value in (problem.y - problem.y[0]).tolist():
        bank.predict()
        bank.update(value)
    ends = np.cumsum([mass.size for _, mass in grids.values()])[:-1]
    posterior = dict(zip(grids, np.split(np.asarray(bank.p), ends), strict=True))
    return Answer(
        {law: estimates(problem, law, grids[law][0], weight) for law, weight in posterior.items()},
        {"Bayes": {law: float(weight.sum()) for law, weight in posterior.items()}},
    )


def edges(problem: Problem, law: str) -> list[Array]:
    """Edges of the cells in ln, for each parameter but the white noise."""
    priors = [problem.group.priors[name] for name in NAMED[law].parameters[1:]]
    return [np.linspace(*ln_limits(prior), count + 1) for prior, count in zip(priors, NODES[law], strict=True)]


def nodes(problem: Problem, law: str) -> tuple[Array, Array]:
    """Parameters [d, m] and prior mass [m] of the nodes."""
    priors = [problem.group.priors[name] for name in NAMED[law].parameters[1:]]
    middles = [0.5 * (edge[:-1] + edge[1:]) for edge in edges(problem, law)]
    ln = np.array(list(itertools.product(*middles))).T
    m = ln.shape[1]
    mass = np.exp(sum((ln_density(prior, row) for prior, row in zip(priors, ln, strict=True)), np.zeros(m)))
    drift = np.zeros(m)  # of the variance of the differences
    if law == "random_walk":
        drift = np.exp(2.0 * ln[0]) * problem.dt_s
    elif law == "gauss_markov":
        drift = -2.0 * np.exp(2.0 * ln[0]) * np.expm1(-np.exp(ln[1]) * problem.dt_s)
    total = float((np.diff(problem.y) ** 2).mean())
    white = np.sqrt(0.5 * problem.dt_s * np.maximum(total - drift, WHITE_SHARE_LEAST * total))
    return np.concatenate([white[None], np.exp(ln)]), mass / mass.sum()


def kalman_filter(problem: Problem, law: str, theta: Array) -> KalmanFilter:
    """Level and drift at a node."""
    kalman = KalmanFilter(dim_x=2, dim_z=1)
    kalman.H = np.ones((1, 2))
    kalman.R = np.array([[theta[0] ** 2 / problem.dt_s]])
    kalman.P = np.diag([(FIRST_LEVEL_SD * float(problem.y.std())) ** 2, 0.0])
    phi, variance = problem.step(law, np.log(theta))
    kalman.F, kalman.Q = np.diag([1.0, float(phi)]), np.diag([0.0, float(variance)])
    if law == "gauss_markov":
        kalman.P[1, 1] = theta[1] ** 2
    return kalman


def estimates(problem: Problem, law: str, theta: Array, weight: Array) -> dict[str, Value]:
    """Median and interval of each parameter, its density flat in ln within a cell. NaN if all weights underflow to
    0."""
    if not weight.any():
        return {name: Value(math.nan) for name in NAMED[law].parameters}
    mass = weight / weight.sum()
    parameters = {"N": Value(float(mass @ theta[0]))}
    shape = NODES[law]
    for k, (name, edge) in enumerate(zip(NAMED[law].parameters[1:], edges(problem, law), strict=True)):
        along = mass.reshape(shape).sum(axis=tuple(j for j in range(len(shape)) if j != k))
        reached = np.concatenate([[0.0], np.cumsum(along)])
        parameters[name] = Value(*np.exp(np.interp([0.5, 0.05, 0.95], reached, edge)).tolist())
    return parameters
