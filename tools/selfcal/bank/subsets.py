"""Posterior over all subsets of a model's regressors, by their evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from selfcal import _library32
from selfcal.bank.axis_result import HALF_90, AxisResult, of_mixture
from selfcal.base.grid import Array
from selfcal.model.regressors import Choice, coefficient_unit, ln_prior

#: Least probability of a law that may be true. The widest of these laws of a subset states the coefficient. If a record
#: does not separate a walk from a Gauss-Markov drift, a ramp is 2 to 4 times as uncertain under it. An average over
#: the laws would cover 77 to 85 % of truths with a walk (tests/noise_coverage.py).
LIKELY: float = _library32.LIKELY


@dataclass(frozen=True)
class Coefficient:
    """Posterior of a column's coefficient if it is in use, over all subsets with it; of each subset under the law
    that leaves it most open (LIKELY)."""

    column: str
    unit: str
    mean: float
    sd: float
    q05: float
    median: float
    q95: float


@dataclass(frozen=True)
class Inclusion:
    """Probability that a regressor is in use, and its coefficients."""

    probability: float
    coefficients: tuple[Coefficient, ...]


@dataclass(frozen=True)
class ScoredSubsets:
    """All subsets of the regressors weighed together.

    `result`: probabilities, evidence and bias over all subsets; parameters of each law are those of its most probable
    subset. `probability` [subsets] of each choice; `best` is the most probable.
    """

    result: AxisResult
    inclusion: Mapping[str, Inclusion]
    choices: tuple[Choice, ...]
    probability: tuple[float, ...]
    best: int


def combine(
    choices: Sequence[Choice], results: Sequence[AxisResult], hypotheses: Mapping[str, float], unit: str
) -> ScoredSubsets:
    """Weigh the subsets by their evidence; `unit` is that of the axis. At least one subset must have evidence."""
    from scipy.special import logsumexp

    ln_before = np.array([ln_prior(choices[-1], choice) for choice in choices])
    ln_law = np.log([hypotheses[law] for law in hypotheses])
    evidence = np.array([[result.log_evidence[law] for law in hypotheses] for result in results])
    joint = ln_before[:, None] + ln_law[None, :] + evidence
    weight = np.exp(joint - logsumexp(joint))  # [subsets, laws]
    of_law, of_choice = weight.sum(axis=0), weight.sum(axis=1)
    mean = np.array([result.bias_mean if math.isfinite(result.bias_mean) else 0.0 for result in results])
    sd = np.array([result.bias_sd if math.isfinite(result.bias_sd) else 0.0 for result in results])
    bias = float(of_choice @ mean)
    combined = AxisResult(
        results[0].n,
        {law: float(logsumexp(ln_before + evidence[:, k])) for k, law in enumerate(hypotheses)},
        {law: float(of_law[k]) for k, law in enumerate(hypotheses)},
        {law: results[int(np.argmax(joint[:, k]))].parameters[law] for k, law in enumerate(hypotheses)},
        bias,
        math.sqrt(float(of_choice @ (sd**2 + (mean - bias) ** 2))),
    )
    inclusion = {}
    for regressor in choices[-1]:
        having = [i for i, choice in enumerate(choices) if regressor in choice]
        coefficients = []
        for k, column in enumerate(regressor.columns):
            parts = []
            for i in having:
                index = k + sum(len(other.columns) for other in choices[i][: choices[i].index(regressor)])
                likely = [law for k, law in enumerate(hypotheses) if weight[i, k] >= LIKELY * of_choice[i] > 0.0]
                if likely:
                    widest = max(
                        (results[i].coefficients[law][index] for law in likely), key=lambda mean_sd: mean_sd[1]
                    )
                    parts.append((of_choice[i], *widest))
            coefficients.append(_coefficient(column, coefficient_unit(unit, regressor.unit), np.array(parts)))
        inclusion[regressor.name] = Inclusion(float(of_choice[having].sum()), tuple(coefficients))
    return ScoredSubsets(combined, inclusion, tuple(choices), tuple(of_choice.tolist()), int(np.argmax(of_choice)))


def normal_coefficient(column: str, unit: str, mean: float, sd: float) -> Coefficient:
    """A coefficient whose posterior is normal."""
    return Coefficient(column, unit, mean, sd, mean - HALF_90 * sd, mean, mean + HALF_90 * sd)


def _coefficient(column: str, unit: str, parts: Array) -> Coefficient:
    """A mixture of normals, `parts` [m, 3]: weight, mean, sd of each. Not a number without any weight."""
    mixture = of_mixture(*parts.T) if parts.size else (math.nan,) * 5
    return Coefficient(column, unit, *mixture)
