"""A bootstrap particle filter with the parameters among its states (Gordon et al. 1993), particles kept apart by the
kernel of Liu & West (2001)."""

from __future__ import annotations

import math

import numpy as np

from selfcal.laws import NAMED
from selfcal.methods.problem import Answer, Floats, Problem, Value
from selfcal.model import Prior

#: Particles a law; the seed of the draws.
PARTICLES, SEED = 2000, 1
#: Liu & West's discount: the kernel keeps the parameters' mean and variance.
DISCOUNT = 0.99


def particles(problem: Problem) -> Answer:
    """Weighted medians and quantiles of the last particles, laws by their evidence."""
    estimates: dict[str, dict[str, Value]] = {}
    ln_evidence: dict[str, float] = {}
    for law in problem.laws:
        ln_theta, weight, ln_evidence[law] = filtered(problem, law, np.random.default_rng(SEED))
        estimates[law] = {}
        for name, column in zip(NAMED[law].parameters, ln_theta, strict=True):
            order = np.argsort(column)
            at = np.interp([0.5, 0.05, 0.95], np.cumsum(weight[order]), column[order])
            estimates[law][name] = Value(*np.exp(at).tolist())
    top = max(ln_evidence.values())
    raw = {law: math.exp(value - top) for law, value in ln_evidence.items()}
    return Answer(estimates, {"Bayes": {law: value / sum(raw.values()) for law, value in raw.items()}})


def filtered(problem: Problem, law: str, rng: np.random.Generator) -> tuple[Floats, Floats, float]:
    """ln parameters [d, particles], their weights, and the ln evidence of all samples but the first, which gives the
    level."""
    y, dt = problem.y, problem.dt_s
    ln_theta = np.array([_draw(problem.group.priors[name], rng) for name in NAMED[law].parameters])
    level = y[0] + np.exp(ln_theta[0]) / math.sqrt(dt) * rng.standard_normal(PARTICLES)
    drift = np.zeros(PARTICLES)
    if law == "gauss_markov":
        drift = np.exp(ln_theta[1]) * rng.standard_normal(PARTICLES)
        level -= drift
    ln_weight = np.zeros(PARTICLES)
    evidence = 0.0
    shrink = (3.0 * DISCOUNT - 1.0) / (2.0 * DISCOUNT)
    for value in y[1:].tolist():
        theta = np.exp(ln_theta)
        if law == "random_walk":
            drift += theta[1] * math.sqrt(dt) * rng.standard_normal(PARTICLES)
        elif law == "gauss_markov":
            phi = np.exp(-theta[2] * dt)
            drift = phi * drift + theta[1] * np.sqrt(1.0 - phi**2) * rng.standard_normal(PARTICLES)
        variance = theta[0] ** 2 / dt
        ln_weight += -0.5 * ((value - level - drift) ** 2 / variance + np.log(2.0 * math.pi * variance))
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
            jitter = math.sqrt(1.0 - shrink**2) * spread[:, None] * rng.standard_normal(ln_theta.shape)
            ln_theta = shrink * ln_theta[:, chosen] + (1.0 - shrink) * mean[:, None] + jitter
            level, drift, ln_weight = level[chosen], drift[chosen], np.zeros(PARTICLES)
    top = float(ln_weight.max())
    weight = np.exp(ln_weight - top)
    evidence += top + math.log(float(weight.sum()) / PARTICLES)
    return ln_theta, weight / weight.sum(), evidence


def _draw(prior: Prior, rng: np.random.Generator) -> Floats:
    if prior.law == "uniform":
        return np.asarray(np.log(rng.uniform(prior.min, prior.max, PARTICLES)))
    return np.asarray(rng.uniform(math.log(prior.min), math.log(prior.max), PARTICLES))
