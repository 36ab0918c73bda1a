"""The bank on a dense grid, written apart from the library and from its textbook reference: an oracle for the ensemble.

A filter for each node of (ln ratio, ln alpha), all nodes at once; the ratio is the drift's parameter over the white
noise's. The bias and the white noise are integrated out at each node, the first in closed form.
"""

from __future__ import annotations

import math

import numpy as np

from selfcal.base.grid import Array, weighted_quantiles
from selfcal.model.file import Prior
from selfcal.model.laws import NAMED
from selfcal.studies.methods.problem import Answer, Problem, Value, probabilities

#: Nodes of the ratio and of alpha, and of the white noise within its likelihood's width.
MARKOV, NOISE = (110, 40), 41
#: Width of the grid of white noise, in standard deviations of ln sigma_v.
WHITE_REACH = 7.0


def grid(problem: Problem) -> Answer:
    """The posterior mean of each logarithm as the estimate, 5 % and 95 % points, and the probability of each law."""
    ln_evidence: dict[str, float] = {}
    estimates: dict[str, dict[str, Value]] = {}
    for law in problem.laws:
        nodes_at, ln_weight = nodes(problem, law)
        top = float(ln_weight.max())
        weight = np.exp(ln_weight - top)
        ln_evidence[law] = top + math.log(float(weight.sum()))
        weight /= weight.sum()
        estimates[law] = {}
        for name, ln_value in zip(NAMED[law].parameters, nodes_at, strict=True):
            values, index = np.unique(ln_value, return_inverse=True)
            low, high = weighted_quantiles(values, np.bincount(index, weight), (0.05, 0.95))
            estimates[law][name] = Value(math.exp(float(weight @ ln_value)), math.exp(low), math.exp(high))
    return Answer(estimates, probabilities(ln_evidence))


def nodes(problem: Problem, law: str) -> tuple[Array, Array]:
    """ln parameters [d, m] and ln of likelihood times prior mass [m]."""
    dt, priors = problem.dt_s, problem.group.priors
    noise = ln_limits(priors["N"])
    ln_alpha, alpha_mass = np.zeros(1), np.zeros(1)
    ln_ratio = np.full(1, -math.inf)
    if law != "constant":
        drift = priors[NAMED[law].parameters[1]]
        low, high = ln_limits(drift)
        ln_ratio = np.linspace(low - noise[1], high - noise[0], 160 if law == "random_walk" else MARKOV[0])
    if law == "gauss_markov":
        ln_alpha = np.linspace(*ln_limits(priors["alpha"]), MARKOV[1])
        ends = np.where((np.arange(MARKOV[1]) % (MARKOV[1] - 1)) == 0, 0.5, 1.0)
        alpha_mass = np.log(ends * (ln_alpha[1] - ln_alpha[0])) + ln_density(priors["alpha"], ln_alpha)
    ratio, alpha = (part.ravel() for part in np.meshgrid(np.exp(ln_ratio), np.exp(ln_alpha), indexing="ij"))
    phi = np.exp(-alpha * dt) if law == "gauss_markov" else np.ones_like(ratio)
    # In units of the white noise of a reading, N / sqrt(dt): a walk's step is K sqrt(dt).
    start = ratio**2 * dt if law == "gauss_markov" else np.zeros_like(ratio)
    step = start * (1.0 - phi**2) if law == "gauss_markov" else (ratio * dt) ** 2
    A, B, C, D = _sums(problem.y - problem.y[0], phi, step, start)
    n, origin = problem.y.size, float(problem.y[0])
    mode = 0.5 * np.log((C - B**2 / A) / n)
    ln_sigma = mode[:, None] + np.linspace(-WHITE_REACH, WHITE_REACH, NOISE) / math.sqrt(2.0 * n)
    variance, P0 = np.exp(2.0 * ln_sigma), priors["bias"].sd ** 2
    a = A[:, None] / variance + 1.0 / P0
    b = B[:, None] / variance - origin / P0  # the prior's mean is 0, that is -origin in these readings
    value = -n * ln_sigma - 0.5 * D[:, None] - 0.5 * (C[:, None] / variance + origin**2 / P0 - b**2 / a)
    value -= 0.5 * np.log(a * P0)
    ln_N = ln_sigma + 0.5 * math.log(dt)
    value += ln_density(priors["N"], ln_N) + math.log(2.0 * WHITE_REACH / math.sqrt(2.0 * n) / (NOISE - 1))
    rows = [ln_N]
    if law != "constant":
        ln_drift = ln_N + np.repeat(ln_ratio, ln_alpha.size)[:, None]
        value += ln_density(drift, ln_drift) + math.log(ln_ratio[1] - ln_ratio[0])
        rows.append(ln_drift)
    if law == "gauss_markov":
        value += np.tile(alpha_mass, ln_ratio.size)[:, None]
        rows.append(np.broadcast_to(np.tile(ln_alpha, ln_ratio.size)[:, None], ln_N.shape))
    keep = np.isfinite(value)
    return np.array([row[keep] for row in rows]), value[keep]


def _sums(y: Array, phi: Array, step: Array, start: Array) -> tuple[Array, Array, Array, Array]:
    """Sums of u^2 / s, u v / s, v^2 / s and ln s [m] over the innovations v of the readings and u of a constant 1, by a
    Kalman filter for each node with white noise of variance 1."""
    p, x, w = start.copy(), np.zeros_like(phi), np.zeros_like(phi)
    A, B, C, D = (np.zeros_like(phi) for _ in range(4))
    for value in y.tolist():
        s = p + 1.0
        v, u = value - x, 1.0 - w
        over = u / s
        A += u * over
        B += v * over
        C += v * v / s
        D += np.log(s)
        g = p / s
        x = phi * (x + g * v)
        w = phi * (w + g * u)
        p = phi * phi * g + step
    return A, B, C, D


def ln_limits(prior: Prior) -> tuple[float, float]:
    """Limits of a parameter's logarithm."""
    return math.log(prior.min), math.log(prior.max)


def ln_density(prior: Prior, ln_value: Array) -> Array:
    """ln of the prior density in the parameter's logarithm, -inf outside."""
    low, high = ln_limits(prior)
    inside = (ln_value >= low - 1e-9) & (ln_value <= high + 1e-9)
    return np.where(inside, prior.ln_density(ln_value), -np.inf)
