"""The answer of an engine on an axis; every number in the units of the axis, continuous time (units.py)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from statistics import NormalDist
from typing import Any

from selfcal.base import units
from selfcal.base.grid import Array, bisected
from selfcal.model.laws import RATIOS

#: Standard deviations from the middle of a normal to either end of its 90 % interval.
HALF_90 = NormalDist().inv_cdf(0.95)
#: Least probability of a law that a table, a picture or a prior takes into account.
LAW_LEAST = 0.01


def likeliest(probability: Mapping[str, float]) -> str:
    """The most probable law."""
    return max(probability, key=lambda law: probability[law])


def bias_of(axis: Mapping[str, Any]) -> dict[str, Any]:
    """The bias at the end of the record, as a document has the other quantities: median, q05, q95 and unit."""
    bias = axis["bias_now"]
    half = HALF_90 * bias["sd"]
    return {"median": bias["mean"], "q05": bias["mean"] - half, "q95": bias["mean"] + half, "unit": bias["unit"]}


def sd_of(estimate: Mapping[str, Any]) -> float:
    """sd of a normal quantity of a document, by its 90 % interval."""
    return float((estimate["q95"] - estimate["q05"]) / (2.0 * HALF_90))


def of_mixture(weight: Array, mean: Array, sd: Array) -> tuple[float, float, float, float, float]:
    """Mean, sd, and quantiles 0.05, 0.5 and 0.95 of a sum of normals [m], `weight` of each not normalized."""
    from scipy.special import ndtr  # a tenth of a second to import, for a mixture only

    held = weight > 1e-6 * weight.max()
    weight, mean, sd = weight[held] / weight[held].sum(), mean[held], sd[held]
    middle = float(weight @ mean)
    spread = math.sqrt(float(weight @ (sd**2 + (mean - middle) ** 2)))

    def quantile(p: float) -> float:
        ends = float((mean - 9.0 * sd).min()), float((mean + 9.0 * sd).max())
        return 0.5 * sum(bisected(lambda x: float(weight @ ndtr((x - mean) / sd)) >= p, *ends))

    return middle, spread, quantile(0.05), quantile(0.5), quantile(0.95)


@dataclass(frozen=True)
class Estimate:
    """Posterior of a parameter under a hypothesis. `off_grid`: the grid of nodes is too coarse (selfcal.h)."""

    mean: float
    median: float
    sd: float
    q05: float
    q95: float
    identified: bool
    off_grid: bool = False

    @property
    def ln_sd(self) -> float:
        """sd of the logarithm, by the 90 % interval; of a positive parameter."""
        return math.log(self.q95 / self.q05) / (2.0 * HALF_90)

    def scaled(self, factor: float) -> Estimate:
        """The estimate in a unit that differs by `factor`."""
        numbers = {name: factor * getattr(self, name) for name in ("mean", "median", "sd", "q05", "q95")}
        return replace(self, **numbers)


@dataclass(frozen=True)
class AxisResult:
    """Posterior of an axis. Keys are hypothesis names, then parameter names (N, K, sigma_m, alpha).

    `n` bank samples; `log_evidence` in nats; `bias` is x0 + drift at the last bank sample, with regressors in use x0 +
    drift + c z there. `coefficients`: mean and sd by hypothesis, in the order of the columns in use.
    """

    n: int
    log_evidence: dict[str, float]
    probability: dict[str, float]
    parameters: dict[str, dict[str, Estimate]]
    bias_mean: float
    bias_sd: float
    coefficients: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)

    @property
    def best(self) -> str:
        """The most probable law."""
        return likeliest(self.probability)


def in_unit(result: AxisResult, unit: str, to: str) -> AxisResult:
    """The result in `to` instead of `unit`: every number but alpha and the ratios, and the evidence, as a density per
    unit."""
    factor = units.factor(unit, to)
    return AxisResult(
        result.n,
        {name: value - result.n * math.log(factor) for name, value in result.log_evidence.items()},
        result.probability,
        {
            law: {name: e if name in ("alpha", *RATIOS) else e.scaled(factor) for name, e in estimates.items()}
            for law, estimates in result.parameters.items()
        },
        result.bias_mean * factor,
        result.bias_sd * factor,
        {law: tuple((mean * factor, sd * factor) for mean, sd in pairs) for law, pairs in result.coefficients.items()},
    )
