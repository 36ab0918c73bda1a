"""A bootstrap particle filter with the parameters among its states (Gordon et al. 1993), particles kept apart by the
kernel of Liu & West (2001)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from selfcal.base.grid import Array
from selfcal.model.laws import NAMED
from selfcal.studies.methods.problem import Answer, Problem, Value, probabilities, weighted

#: The state [s, particles] after the first reading, from a record, a law and ln parameters [d, particles].
Begin = Callable[[Problem, str, Array, np.random.Generator], Array]
#: ln likelihood [particles] of a reading and the state after it, from the same, the state and the reading.
Step = Callable[[Problem, str, Array, Array, float, np.random.Generator], tuple[Array, Array]]

#: Particles a law.
PARTICLES = 2000
#: Liu & West's discount of 0.99: the kernel keeps the parameters' mean and variance.
SHRINK = (3.0 * 0.99 - 1.0) / (2.0 * 0.99)


def particles(problem: Problem) -> Answer:
    """Weighted medians and quantiles of the last particles, laws by their evidence."""
    return particle_answer(problem, begin, step)


def particle_answer(problem: Problem, begin: Begin, step: Step) -> Answer:
    """What the particles find for each law, each with the same seed."""
    estimates: dict[str, dict[str, Value]] = {}
    ln_evidence: dict[str, float] = {}
    for law in problem.laws:
        ln_theta, weight, ln_evidence[law] = filtered(problem, law, begin, step)
        estimates[law] = weighted(NAMED[law].parameters, ln_theta, weight)
    return Answer(estimates, probabilities(ln_evidence))


def filtered(problem: Problem, law: str, begin: Begin, step: Step) -> tuple[Array, Array, float]:
    """ln parameters [d, particles], their weights, and the ln evidence of all samples but the first, which gives the
    level."""
    rng = np.random.default_rng(1)
    priors = [problem.group.priors[name] for name in NAMED[law].parameters]
    ln_theta = np.log([[prior.at(u) for u in rng.random(PARTICLES).tolist()] for prior in priors])
    state = begin(problem, law, ln_theta, rng)
    ln_weight = np.zeros(PARTICLES)
    evidence = 0.0
    for value in problem.y[1:].tolist():
        ln_likelihood, state = step(problem, law, ln_theta, state, value, rng)
        ln_weight += ln_likelihood
        top = float(ln_weight.max())
        weight = np.exp(ln_weight - top)
        total = float(weight.sum())
        weight /= total
        if 1.0 / float((weight**2).sum()) < 0.5 * PARTICLES:
            evidence += top + math.log(total / PARTICLES)
            mean = ln_theta @ weight
            spread = np.sqrt(np.maximum(((ln_theta - mean[:, None]) ** 2) @ weight, 0.0))
            chosen = np.searchsorted(np.cumsum(weight), (np.arange(PARTICLES) + rng.random()) / PARTICLES)
            chosen = np.minimum(chosen, PARTICLES - 1)
            jitter = math.sqrt(1.0 - SHRINK**2) * spread[:, None] * rng.standard_normal(ln_theta.shape)
            ln_theta = SHRINK * ln_theta[:, chosen] + (1.0 - SHRINK) * mean[:, None] + jitter
            state, ln_weight = state[:, chosen], np.zeros(PARTICLES)
    top = float(ln_weight.max())
    weight = np.exp(ln_weight - top)
    evidence += top + math.log(float(weight.sum()) / PARTICLES)
    return ln_theta, weight / weight.sum(), evidence


def begin(problem: Problem, law: str, ln_theta: Array, rng: np.random.Generator) -> Array:
    """Level and drift [2, particles] after the first reading."""
    level = problem.y[0] + np.exp(ln_theta[0]) / math.sqrt(problem.dt_s) * rng.standard_normal(PARTICLES)
    drift = np.zeros(PARTICLES)
    if law == "gauss_markov":
        drift = np.exp(ln_theta[1]) * rng.standard_normal(PARTICLES)
    return np.stack([level - drift, drift])


def step(
    problem: Problem, law: str, ln_theta: Array, state: Array, value: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """ln likelihood of a reading [particles], and the state, whose drift is drawn."""
    level, drift = state
    phi, variance = problem.step(law, ln_theta)
    drift = phi * drift + np.sqrt(variance) * rng.standard_normal(PARTICLES)
    noise = np.exp(2.0 * ln_theta[0]) / problem.dt_s
    return -0.5 * ((value - level - drift) ** 2 / noise + np.log(2.0 * math.pi * noise)), np.stack([level, drift])
