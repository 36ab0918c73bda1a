"""The Allan deviation of a record and of the laws: closed forms, and how far apart the two may be.

Every law is a sum of terms: white noise, a random walk, Gauss-Markov drifts. With X the sum of the readings of a term,
an even function G suffices here. For weights that remove a line, the covariance of two weighted sums of X is the sum of
the weights times G at the distance between them. At m readings apart

    u_k = (X_(k+2m) - 2 X_(k+m) + X_k) / m,     Allan variance = E[u^2] / 2,     and Cov(u_k, u_(k+j)) follow from G.

Readings are the bank's: means over blocks of samples, at whose instants the drift is a point. A random walk's Allan
variance is K^2 tau / 3 (1 + 1 / (2 m^2)) of single readings, and K^2 tau / 3 of means over many samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft
from scipy.special import gammaincinv, ndtri

from selfcal.bank.axis_result import HALF_90, AxisResult, Estimate
from selfcal.bank.blocks import Blocks
from selfcal.base.grid import SLOPE_STEP, Array, Mask, Rows, bisected
from selfcal.model.file import Group
from selfcal.model.laws import FORGOTTEN, KINDS, Law, named_law
from selfcal.model.tables import Tables

#: Least length of a record over its longest averaging time: fewer windows say little.
AVERAGES_LEAST = 5
#: Least share of a variance S that S - V keeps: nearly equal numbers have a small difference.
LEFT_LEAST = 0.2
#: Number of draws of a posterior.
CURVE_DRAWS = 256
#: Averaging times of a curve in an octave.
PER_OCTAVE = 4


@dataclass(frozen=True)
class AllanTerms:
    """A law at given parameters, per reading: the white noise's `variance` and its correlation `lag1` with the reading
    before, the variance of the walk's `step`. `markov`: each Gauss-Markov drift's variance, and its bandwidth times the
    interval between readings. An oscillation is the real part of a drift with complex numbers. `lacking`: variance of
    white noise that the drift's averages lack (laws.averaged)."""

    variance: float
    lag1: float = 0.0
    step: float = 0.0
    markov: tuple[tuple[complex, complex], ...] = ()
    lacking: float = 0.0

    def sums(self, j: Array) -> Array:
        """G at the distances `j`, whole or not."""
        j = np.abs(j)
        total = -0.5 * (self.variance - self.lacking) * j + self.step / 12.0 * (j**3 - j)
        if self.lag1:
            total = total - self.variance * self.lag1 * np.maximum(j, 1.0)
        for variance, alpha in self.markov:
            phi, left = np.exp(-alpha), -np.expm1(-alpha)
            total = total - (variance / left * (phi / left * np.expm1(-alpha * j) + 0.5 * (1.0 + phi) * j)).real
        return np.asarray(total)

    def allan_variance(self, m: Array) -> Array:
        """Allan variance at `m` readings."""
        return np.asarray((3.0 * self.sums(0.0 * m) - 4.0 * self.sums(m) + self.sums(2.0 * m)) / m**2)

    def covariance(self, m: int, lags: int) -> Array:
        """Cov(u_k, u_(k+j)) for j = 0 to `lags` - 1."""
        near = np.arange(min(lags, 2 * m + 2), dtype=float)
        weights = {0: 6.0, m: -4.0, -m: -4.0, 2 * m: 1.0, -2 * m: 1.0}
        nearby = sum(weight * self.sums(near + shift) for shift, weight in weights.items()) / m**2
        far = np.zeros(lags - near.size)
        for variance, alpha in self.markov:  # farther than 2 m the other terms have no covariance
            j = np.arange(near.size, lags, dtype=float)
            scale = variance * np.exp(-alpha) / np.expm1(-alpha) ** 2 * np.expm1(-alpha * m) ** 4 / m**2
            far -= (scale * np.exp(-alpha * (j - 2 * m))).real
        return np.concatenate([nearby, far])

    def spectrum(self, omega: Array) -> Array:
        """Power of the readings at `omega` rad a reading; white noise of variance 1 has 1."""
        step = 4.0 * np.sin(0.5 * omega) ** 2  # |1 - e^(i omega)|^2
        power = self.variance * (1.0 + self.lag1 * (2.0 - step)) - self.lacking + self.step / step
        for variance, alpha in self.markov:
            power = power - (variance * np.expm1(-2.0 * alpha) / (np.expm1(-alpha) ** 2 + np.exp(-alpha) * step)).real
        return np.asarray(power)


def allan_terms(law: Law, parameters: Mapping[str, float], dt_s: float, block: int = 1) -> AllanTerms:
    """A law at `parameters` (continuous time, units.py), for readings every `dt_s`, means of `block` samples."""
    drift, second = law.node(parameters)
    variance, lag1 = law.noise(parameters["N"] ** 2 / dt_s, second)
    terms = [KINDS[term.kind].averages(term, dt_s, block) for term in law.sized(drift, second)]
    return AllanTerms(
        variance,
        lag1,
        sum(step for step, _, _ in terms),
        tuple(pole for _, poles, _ in terms for pole in poles),
        sum(lacking for _, _, lacking in terms),
    )


def overlapping_variance(y: Array, m: int) -> tuple[float, Mask]:
    """Allan variance of readings `y` at `m` of them, over all windows without a missing (NaN) reading; and which
    windows these are [n - 2 m + 1]. NaN without a window."""
    missing = np.isnan(y)
    total = np.concatenate([[0.0], np.cumsum(np.where(missing, 0.0, y))])
    absent = np.concatenate([[0], np.cumsum(missing)])
    whole = absent[2 * m :] == absent[: -2 * m]
    u = (total[2 * m :] - 2.0 * total[m:-m] + total[: -2 * m])[whole] / m
    return (0.5 * float((u**2).mean()) if u.size else math.nan), whole


def relative_variance(terms: AllanTerms, m: int, whole: Mask) -> float:
    """Variance of the overlapping Allan variance over windows `whole`, over its mean squared, under `terms`: normal
    readings have Var = 2 / M^2 sum of Cov(u_k, u_l)^2 / 4."""
    count = int(whole.sum())
    memory = max((FORGOTTEN / alpha.real for _, alpha in terms.markov), default=0.0)
    lags = min(whole.size, 2 * m + 2 + math.ceil(memory))
    if whole.all():
        pairs = count - np.arange(lags, dtype=float)
    else:
        size = fft.next_fast_len(whole.size + lags, real=True)
        power = np.abs(fft.rfft(whole.astype(np.float32), size)) ** 2
        pairs = fft.irfft(power, size)[:lags].astype(float)
    square = terms.covariance(m, lags) ** 2
    return float((2.0 * (pairs @ square) - pairs[0] * square[0]) * 2.0 / (count**2 * square[0]))


@dataclass(frozen=True)
class AllanFit:
    """The curve of a law whose parameters were estimated from a record, at `m` [t] readings: `allan_variance` [t] at
    the estimate, the `variance` [t] of its logarithm, and the `covariance` [d, d] of the logarithms of the parameters.
    `terms_at`: the terms at other logarithms of the parameters."""

    terms_at: Callable[[Array], AllanTerms]
    terms: AllanTerms
    allan_variance: Array
    variance: Array
    covariance: Array

    def drawn(self, draws: Mapping[str, Array]) -> Iterable[AllanTerms]:
        """The terms at each draw [k] of the parameters."""
        return map(self.terms_at, np.log(np.column_stack([*draws.values()])))


def _terms_at(of: Law, dt_s: float, white: float, block: int) -> Callable[[Array], AllanTerms]:
    """The terms of a law at given ln parameters. `white` multiplies the white noise's variance."""

    def terms_at(ln_theta: Array) -> AllanTerms:
        theta = dict(zip(of.parameters, np.exp(ln_theta).tolist(), strict=True))
        terms = allan_terms(of, theta, dt_s, block)
        return replace(terms, variance=terms.variance * white)

    return terms_at


def _slopes(terms_at: Callable[[Array], AllanTerms], ln_theta: Array, of: Callable[[AllanTerms], Array]) -> Array:
    """Derivatives [d, t] of the logarithm of a curve `of` terms [t] in each ln parameter."""
    steps = np.eye(ln_theta.size) * SLOPE_STEP
    sides = [(of(terms_at(ln_theta + step)), of(terms_at(ln_theta - step))) for step in steps]
    return np.array([np.log(up / down) for up, down in sides]) / (2.0 * SLOPE_STEP)


def information_of(
    of: Law, parameters: Mapping[str, float], dt_s: float, n: float, white: float = 1.0, block: int = 1
) -> Array:
    """Information [d, d] of `n` readings every `dt_s` on ln of each parameter.

    Whittle's: half of a sum over all frequencies of the squared derivatives of the log spectrum."""
    k = np.unique(np.rint(np.geomspace(1.0, n / 2.0, 1000)))
    omega = 2.0 * math.pi * k / n
    ln_estimate = np.log([parameters[name] for name in of.parameters])
    slopes = _slopes(_terms_at(of, dt_s, white, block), ln_estimate, lambda terms: terms.spectrum(omega))
    return np.asarray((slopes * np.gradient(k)) @ slopes.T, np.float64)


def fit_of(
    law: str,
    parameters: Mapping[str, float],
    group: Group,
    dt_s: float,
    n: float,
    m: Array,
    white: float = 1.0,
    *,
    block: int,
) -> AllanFit:
    """The curve at `parameters` that `n` readings have determined, with the group's priors. `white` multiplies the
    white noise's variance. A reading is the mean of `block` samples."""
    of = group.laws[law]
    ln_estimate = np.log([parameters[name] for name in of.parameters])
    prior = [group.priors[name].ln_sd ** -2 for name in of.parameters]
    covariance = np.linalg.inv(information_of(of, parameters, dt_s, n, white, block) + np.diag(prior))
    terms_at = _terms_at(of, dt_s, white, block)
    jacobian = _slopes(terms_at, ln_estimate, lambda terms: terms.allan_variance(m))
    variance = np.asarray(np.einsum("dt,de,et->t", jacobian, covariance, jacobian))
    terms = terms_at(ln_estimate)
    return AllanFit(terms_at, terms, terms.allan_variance(m), variance, np.asarray(covariance, np.float64))


def lengths(n: int, per_octave: int = 1) -> Rows:
    """2 readings, twice as many and so on to a fifth of `n`, and with `per_octave` some between."""
    octaves = math.log2(n / (2 * AVERAGES_LEAST)) if n > 2 * AVERAGES_LEAST else -1.0
    return np.unique(
        np.rint(2.0 ** (1.0 + np.arange(math.floor(octaves * per_octave) + 1) / per_octave)).astype(np.int64)
    )


def deviations(ratio: float, variance: float) -> float:
    """How many standard deviations an Allan variance is above its mean, being `ratio` times it with that relative
    `variance`: it has the distribution of chi-square over its degrees of freedom, whose cube root is normal (Wilson &
    Hilferty 1931)."""
    ninth = variance / 9.0  # 2 / (9 degrees of freedom)
    return (math.cbrt(ratio) - (1.0 - ninth)) / math.sqrt(ninth)


def ratio_at(deviations: float, variance: float) -> float:
    """Ratio at `deviations` standard deviations from 1, at least 0."""
    ninth = variance / 9.0
    return max(0.0, 1.0 - ninth + deviations * math.sqrt(ninth)) ** 3


@dataclass(frozen=True)
class AllanCurve:
    """Allan deviation of a record of bank readings, and of a law that was identified from it, at `tau_s` [t], s.

    `recording` [t] with its `freedom`, the equivalent degrees of freedom of its square under the law; `model` [t] at
    the posterior medians with the limits `model_q05` and `model_q95` [t]; `octave` [t] says which are octaves of two
    readings. `deviations` [t]: by how many standard deviations the record's variance is above the model's, `left` [t]
    being the variance of the logarithm of their ratio.
    """

    tau_s: Array
    recording: Array
    freedom: Array
    model: Array
    model_q05: Array
    model_q95: Array
    octave: Mask
    deviations: Array
    left: Array

    def within(self, deviations: float) -> Array:
        """The record's Allan deviation [t] if it were `deviations` standard deviations above the model's."""
        return self.model * np.sqrt([ratio_at(deviations, variance) for variance in self.left.tolist()])


def curve_of(blocks: Blocks, tables: Tables, group: Group, result: AxisResult) -> AllanCurve | None:
    """The means of `blocks` (NaN: missing), compared with the most probable law at its posterior medians.

    None if there are too few readings.

    The record has also determined the parameters, so the two are nearer to each other than a record is to a curve known
    beforehand. With a the logarithm of the record's Allan variance, S its variance about the true curve, and V the
    posterior variance of the model's curve: how far the true curve is from the posterior's mean is independent of the
    record, so S = Var(a - mean curve) + V, and the difference has the variance S - V.
    """
    # With forgetting the posterior rests on the last readings. Its sums, weighted by e^(-age / w), have the variance of
    # 2 w readings and 1 - e^-2 of their weight on the last 2 w: Var = S + V - 2 (1 - e^-2) V.
    y, dt_s = blocks.mean, tables.dt_s
    white = float(blocks.r[np.isfinite(y)].mean())
    memory, shared = math.ceil(2.0 * tables.half_life_s / math.log(2.0) / dt_s), 1.0
    if 0 < memory < y.size:
        y, shared = y[-memory:], 1.0 - 2.0 * math.exp(-2.0)
    n = int(np.isfinite(y).sum())
    if n < 2 * AVERAGES_LEAST:
        return None
    y = y - float(np.nanmean(y))
    rows = [(int(m), *overlapping_variance(y, int(m))) for m in lengths(n, PER_OCTAVE)]
    rows = [entry for entry in rows if int(entry[2].sum()) >= entry[0]]  # gaps leave too few windows
    m = np.array([entry[0] for entry in rows], float)
    recorded = np.array([entry[1] for entry in rows])
    estimates = result.parameters[result.best]
    medians = {name: estimate.median for name, estimate in estimates.items()}
    fit = fit_of(result.best, medians, group, dt_s, n, m, white, block=tables.block)
    own = np.array([relative_variance(fit.terms, length, windows) for length, _, windows in rows])
    left = np.maximum(own - shared * fit.variance, LEFT_LEAST * own)
    ratio = recorded / fit.allan_variance
    curves = [terms.allan_variance(m) for terms in fit.drawn(posterior_draws(estimates, fit.covariance))]
    low, high = np.sqrt(np.quantile(curves, [0.05, 0.95], axis=0)) if m.size else (m, m)
    return AllanCurve(
        m * dt_s,
        np.sqrt(recorded),
        2.0 / own,
        np.sqrt(fit.allan_variance),
        low,
        high,
        np.isin(m, lengths(n)),
        np.array([deviations(*pair) for pair in zip(ratio.tolist(), left.tolist(), strict=True)]),
        left,
    )


def posterior_draws(estimates: Mapping[str, Estimate], covariance: Array) -> dict[str, Array]:
    """Values [CURVE_DRAWS] of each parameter of a law: its own median and quantiles, and between parameters the
    correlation of `covariance` [d, d], of their logarithms. The draws are evenly spread, not random (an additive
    recurrence: Roberts 2018), so that quantiles of functions of them are smooth."""
    chosen = list(estimates.values())
    sd = np.sqrt(np.diag(covariance))
    d = len(chosen)
    root, _ = bisected(lambda x: x ** (d + 1) >= x + 1.0, 1.0, 2.0)
    even = (0.5 + np.outer(np.arange(1, CURVE_DRAWS + 1), root ** -np.arange(1.0, d + 1))) % 1.0
    z = ndtri(even) @ np.linalg.cholesky(covariance / np.outer(sd, sd)).T
    middle = np.log([e.median for e in chosen])
    up = (np.log([e.q95 for e in chosen]) - middle) / HALF_90
    down = (middle - np.log([e.q05 for e in chosen])) / HALF_90
    draws = np.exp(middle + z * np.where(z > 0.0, up, down))
    return dict(zip(estimates, draws.T, strict=True))


@dataclass(frozen=True)
class Sampled:
    """Overlapping Allan deviation of a recording's own samples at `tau_s` [t], s, with its 90 % interval."""

    tau_s: Array
    deviation: Array
    q05: Array
    q95: Array


def sample_lengths(n: int, block: int) -> Rows:
    """1 of `n` samples, 2, 4 ... to two bank intervals of `block` samples, and from there in octaves of these."""
    short = 2 ** np.arange(math.ceil(math.log2(2 * block)), dtype=np.int64)
    return np.concatenate([short, block * lengths(n // block)])


def sampled(values: Array, missing_before: Rows, rate_hz: float, m: Rows) -> Sampled:
    """At `m` samples. `values` [n], NaN where a sample is not used, after `missing_before` [n] missing samples each.

    No window has a gap in it. The interval is that of chi-square with the degrees of freedom of the power law that has
    the curve's slope.
    """
    values = values.astype(np.float64)  # its sums of 10^6 and more readings in float32 are off by 1e-4 and more
    n = int(np.isfinite(values).sum())
    parted = np.insert(values - np.nanmean(values), np.flatnonzero(missing_before), np.nan)
    each = (overlapping_variance(parted, length) for length in m.tolist())  # a mask of all samples each: in turn
    variance, count = np.array([(value, whole.sum()) for value, whole in each]).T
    kept = (variance > 0.0) & (count >= m)
    m, deviation = m[kept], np.sqrt(variance[kept])
    slope = np.gradient(np.log(deviation), np.log(m)) if m.size > 1 else np.full(m.size, -0.5)
    powers = np.clip(np.rint(2.0 * slope), -1.0, 1.0)
    half = np.array([0.5 * freedom_of(power, length, n) for power, length in zip(powers, m.tolist(), strict=True)])
    q05, q95 = (deviation * np.sqrt(half / gammaincinv(half, p)) for p in (0.95, 0.05))
    return Sampled(m / rate_hz, deviation, q05, q95)


def freedom_of(power: float, m: int, n: int) -> float:
    """Equivalent degrees of freedom of the overlapping Allan variance at `m` of `n` readings, as Greenhall & Riley
    (2003) define them, of noise whose variance goes as tau^`power`: -1 white, 0 flicker, 1 a walk."""
    flicker = named_law("flicker")
    terms = {
        -1.0: AllanTerms(1.0),
        0.0: allan_terms(flicker, {"N": 0.0, "B": 1.0, "alpha": 1.0 / m}, 1.0),
        1.0: AllanTerms(0.0, step=1.0),
    }
    return 2.0 / relative_variance(terms[power], m, np.ones(n - 2 * m + 1, np.bool_))
