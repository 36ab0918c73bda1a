"""What every rival gets and gives, and the search that several of them share."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy import optimize

from selfcal.adequacy.allan import AVERAGES_LEAST, AllanTerms, allan_terms, overlapping_variance
from selfcal.bank.axis_result import HALF_90
from selfcal.base.grid import Array, weighted_quantiles
from selfcal.model.file import Group, Prior
from selfcal.model.laws import NAMED

#: The search leaves no start by more than this factor: beyond it the likelihood is flat or overflows.
START_REACH = 1e5
#: Step in the ln of a parameter for a curvature: a smaller step shows the rounding of an Allan variance.
STEP = 0.01
#: Sd of the first level of a Kalman filter, in sd of the record; the level begins at the first reading.
FIRST_LEVEL_SD = 10.0


@dataclass(frozen=True)
class Problem:
    """Bank samples `y` [n] every `dt_s`, without a gap, in the group's unit. The priors are those of `group`; a rival
    without priors does not look at them."""

    y: Array
    dt_s: float
    group: Group
    laws: tuple[str, ...]

    @property
    def drifts(self) -> tuple[str, ...]:
        """The laws with a drift."""
        return tuple(law for law in self.laws if law != "constant")

    def terms(self, law: str, ln_theta: Array) -> AllanTerms:
        """The law at the logarithms of its parameters."""
        theta = dict(zip(NAMED[law].parameters, np.exp(ln_theta).tolist(), strict=True))
        return allan_terms(NAMED[law], theta, self.dt_s)

    def step(self, law: str, ln_theta: Array) -> tuple[Array, Array]:
        """What remains of the drift after a sample, and the variance of what is added, at ln parameters [d, ...]."""
        ones = np.ones(ln_theta.shape[1:])
        if law == "random_walk":
            return ones, np.exp(2.0 * ln_theta[1]) * self.dt_s
        if law == "gauss_markov":
            rate = np.exp(ln_theta[2]) * self.dt_s
            return np.exp(-rate), np.exp(2.0 * ln_theta[1]) * -np.expm1(-2.0 * rate)
        return ones, 0.0 * ones

    def starts(self, law: str) -> list[Array]:
        """Where a search begins: moments of the record, and for Gauss-Markov three correlation times."""
        n, dt = self.y.size, self.dt_s
        white = max(float(np.diff(self.y).std()) / math.sqrt(2.0), 1e-12 * float(np.abs(self.y).max()), 1e-30)
        N = white * math.sqrt(dt)
        if law == "constant":
            return [np.log([N])]
        m = max(2, n // 10)
        long = math.sqrt(max(overlapping_variance(self.y, m)[0] - white**2 / m, 0.01 * white**2))
        if law == "random_walk":
            return [np.log([N, long * math.sqrt(3.0 / (m * dt))])]
        return [np.log([N, long, 1.0 / (part * n * dt)]) for part in (0.2, 0.03, 0.005)]

    def peaks(self, objective: Callable[[str, Array], float], points: float = math.inf) -> dict[str, Peak]:
        """The maximum of an objective of a law and ln parameters, by law; of laws that `points` readings determine."""
        return {law: maximum(partial(objective, law), self.starts(law)) for law in self.determined(points)}

    def determined(self, points: float) -> list[str]:
        """The laws that have no more parameters than points of a curve."""
        return [law for law in self.laws if points >= len(NAMED[law].parameters)]

    def octaves(self) -> tuple[Array, Array]:
        """Averaging times in readings, an octave apart, and overlapping Allan variances."""
        y = self.y - self.y.mean()
        m = np.exp2(np.arange(max(1, math.floor(math.log2(max(2, y.size // AVERAGES_LEAST))) + 1)))
        return m, np.array([overlapping_variance(y, int(length))[0] for length in m])


@dataclass(frozen=True)
class Value:
    """An estimate with the 90 % interval that the method states; NaN where it states none."""

    value: float
    q05: float = math.nan
    q95: float = math.nan


@dataclass(frozen=True)
class Answer:
    """Estimates by law and parameter. `weights`: by criterion, the probability or weight of each law."""

    estimates: Mapping[str, Mapping[str, Value]]
    weights: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @staticmethod
    def of(peaks: Mapping[str, Peak], weights: Mapping[str, Mapping[str, float]] | None = None) -> Answer:
        """Estimates with the interval of each maximum's curvature."""
        return Answer({law: peak.values(law) for law, peak in peaks.items()}, weights or {})


@dataclass(frozen=True)
class Peak:
    """A maximum of an objective: its place in ln parameters, the value, and the inverse of the curvature there."""

    at: Array
    value: float
    covariance: Array

    def values(self, law: str) -> dict[str, Value]:
        """Estimates with the interval of a normal distribution in the logarithm."""
        return logarithmic(NAMED[law].parameters, self.at, self.covariance)


def logarithmic(names: Sequence[str], ln_value: Array, covariance: Array) -> dict[str, Value]:
    """Estimates from logarithms and their covariance. A variance that is not positive gives no interval."""
    values = {}
    for k, name in enumerate(names):
        variance = float(covariance[k, k])
        half = HALF_90 * math.sqrt(variance) if variance > 0.0 else math.nan
        with np.errstate(over="ignore"):
            values[name] = Value(*np.exp(ln_value[k] + np.array([0.0, -half, half])).tolist())
    return values


def weighted(names: Sequence[str], ln_theta: Array, weight: Array) -> dict[str, Value]:
    """Weighted medians with 5 % and 95 % points of ln parameters [d, m]; `weight` [m] sums to 1."""
    parameters = {}
    for name, column in zip(names, ln_theta, strict=True):
        values, index = np.unique(column, return_inverse=True)
        quantiles = weighted_quantiles(values, np.bincount(index, weight), (0.5, 0.05, 0.95))
        parameters[name] = Value(*np.exp(quantiles).tolist())
    return parameters


def ln_moments(prior: Prior) -> tuple[float, float]:
    """Mean and sd of a parameter's logarithm between the limits of its prior."""
    return math.log(prior.median), prior.ln_sd


def root(square: float) -> Value:
    """NaN of a negative square: the method has no answer then."""
    return Value(math.sqrt(float(square)) if square > 0.0 else math.nan)


def maximum(objective: Callable[[Array], float], starts: Sequence[Array]) -> Peak:
    """The highest of the local maxima that the search finds from `starts`, by L-BFGS with numerical derivatives."""
    best: tuple[float, Array] | None = None
    reach = math.log(START_REACH)
    for start in starts:
        bounds = [(value - reach, value + reach) for value in start]
        with np.errstate(all="ignore"):
            optimum = optimize.minimize(
                lambda theta: -_finite(objective(theta)), start, method="L-BFGS-B", bounds=bounds
            )
        if best is None or -optimum.fun > best[0]:
            best = (-float(optimum.fun), np.asarray(optimum.x))
    assert best is not None
    with np.errstate(all="ignore"):
        curvature = -hessian(objective, best[1])
    return Peak(best[1], best[0], inverse(curvature))


def hessian(objective: Callable[[Array], float], theta: Array) -> Array:
    """Second derivatives by central differences."""
    d = theta.size
    step = np.eye(d) * STEP
    matrix = np.empty((d, d))
    for i in range(d):
        for j in range(i, d):
            values = [
                objective(theta + a * step[i] + b * step[j])
                for a, b in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
            ]
            matrix[i, j] = matrix[j, i] = (values[0] - values[1] - values[2] + values[3]) / (4.0 * STEP**2)
    return matrix


def inverse(information: Array) -> Array:
    """The inverse of a positive definite matrix, else NaN: the record does not determine the parameters."""
    try:
        np.linalg.cholesky(information)
    except np.linalg.LinAlgError:
        return np.full_like(information, math.nan)
    return np.asarray(np.linalg.inv(information))


def _finite(value: float) -> float:
    return value if math.isfinite(value) else -1e300


def weights(criterion: Mapping[str, float]) -> dict[str, float]:
    """Akaike weights: e^(-criterion/2), normalised. A law whose criterion is not finite has none."""
    finite = {law: value for law, value in criterion.items() if math.isfinite(value)}
    least = min(finite.values(), default=0.0)
    raw = {law: math.exp(-0.5 * (finite[law] - least)) if law in finite else 0.0 for law in criterion}
    total = sum(raw.values())
    return {law: value / total if total else math.nan for law, value in raw.items()}


def probabilities(ln_evidence: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """Equally likely laws weighed by Bayes' rule."""
    return {"Bayes": weights({law: -2.0 * value for law, value in ln_evidence.items()})}


def information_criteria(ln_likelihood: Mapping[str, float], n: int) -> dict[str, dict[str, float]]:
    """AIC and BIC weights of laws from their greatest ln likelihoods over the same `n` samples."""
    aic = {law: 2.0 * len(NAMED[law].parameters) - 2.0 * value for law, value in ln_likelihood.items()}
    bic = {law: math.log(n) * len(NAMED[law].parameters) - 2.0 * value for law, value in ln_likelihood.items()}
    return {"AIC": weights(aic), "BIC": weights(bic)}


def of_coefficients(law: str, phi: float, theta: float, variance: float, dt_s: float) -> dict[str, Value]:
    """The parameters by the equivalent ARMA form: a random walk under white noise is ARIMA(0,1,1), Gauss-Markov
    ARMA(1,1). Coefficients that belong to no such sum give no answer.

    Both sides of y[k] - phi y[k-1] = e[k] + theta e[k-1], e of `variance`, have equal covariances at lags 1 and 0. A
    random walk has phi = 1."""
    white = -theta * variance / phi if phi else math.nan
    step = (1.0 + theta**2) * variance - (1.0 + phi**2) * white
    parameters = {"N": root(white * dt_s)}
    if law == "random_walk":
        return parameters | {"K": root(step / dt_s)}
    stable = 0.0 < phi < 1.0
    parameters["sigma_m"] = root(step / (1.0 - phi**2)) if stable else Value(math.nan)
    return parameters | {"alpha": Value(-math.log(phi) / dt_s if stable else math.nan)}
