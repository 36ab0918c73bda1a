"""A Rao-Blackwellised particle filter: the parameters are the particles, each with a Kalman filter of its own for level
and drift. All else is as in `particles.py`.

The library `particles` cannot be installed with this package: its version 0.4 refuses numpy 2, 0.3 has no wheel.
"""

from __future__ import annotations

import math

import numpy as np

from selfcal.base.grid import Array
from selfcal.studies.methods.particles import PARTICLES, particle_answer
from selfcal.studies.methods.problem import Answer, Problem


def rao_blackwell(problem: Problem) -> Answer:
    """Weighted medians and quantiles of the last particles, laws by their evidence."""
    return particle_answer(problem, begin, step)


def begin(problem: Problem, law: str, ln_theta: Array, _rng: np.random.Generator) -> Array:
    """Level, drift, and their variances and covariance [5, particles] after the first reading, which gives the sum of
    level and drift."""
    noise = np.exp(2.0 * ln_theta[0]) / problem.dt_s
    drift = np.exp(2.0 * ln_theta[1]) if law == "gauss_markov" else np.zeros(PARTICLES)
    return np.stack([np.full(PARTICLES, problem.y[0]), np.zeros(PARTICLES), noise + drift, drift, -drift])


def step(
    problem: Problem, law: str, ln_theta: Array, state: Array, value: float, _rng: np.random.Generator
) -> tuple[Array, Array]:
    """ln likelihood of a reading [particles], and the state after it. Nothing is drawn."""
    level, drift, level_variance, drift_variance, both = state
    phi, added = problem.step(law, ln_theta)
    drift, drift_variance, both = phi * drift, phi**2 * drift_variance + added, phi * both
    level_gain, drift_gain = level_variance + both, both + drift_variance
    variance = level_gain + drift_gain + np.exp(2.0 * ln_theta[0]) / problem.dt_s
    e = value - level - drift
    moved = [
        level + level_gain / variance * e,
        drift + drift_gain / variance * e,
        level_variance - level_gain**2 / variance,
        drift_variance - drift_gain**2 / variance,
        both - level_gain * drift_gain / variance,
    ]
    return -0.5 * (e**2 / variance + np.log(2.0 * math.pi * variance)), np.stack(moved)
