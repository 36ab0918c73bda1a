"""The textbook bank and its engine against the definition of the model.

Truth is always the multivariate normal density of the record with its covariance written out from the model,
integrated where needed by Gauss-Legendre or adaptive quadrature: nothing recursive, no filter.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate, interpolate, special, stats

from selfcal import _reference
from selfcal.bank import reference
from selfcal.bank.reference import reference_axis
from selfcal.base.errors import UserError
from selfcal.model.file import Group, Prior
from selfcal.model.laws import NAMED, PLAIN, named_law

DT = 0.7
BIAS_SD = 3.0
BIAS_MEAN = 0.4
#: The named laws; walk and Markov with a correlation time of 20 s.
LAWS = [named_law(name, 20.0).as_tuple for name in NAMED]
#: (law: an index into LAWS, drift, alpha or ratio, sigma_v)
NODES = [(0, 0.0, 1.0, 0.3), (1, 0.2, 1.0, 0.3), (2, 0.5, 0.08, 0.3), (2, 0.5, 4.0, 0.05), (1, 2.0, 1.0, 1e-3)]
#: Double precision through 30 samples; the worst node has P0 / sigma_v^2 = 1e7.
LN_P_TOLERANCE = 1e-8


def drift_covariance(law: int, drift: float, alpha: float, n: int, dt: float) -> np.ndarray:
    """Covariance [n, n] of x_1 ... x_n, by the definition of each law."""
    i = np.arange(1, n + 1)
    if law == 1:
        return drift**2 * dt * np.minimum.outer(i, i)
    if law == 2:
        return drift**2 * np.exp(-alpha * dt * np.abs(np.subtract.outer(i, i)))
    return np.zeros((n, n))


def record_covariance(node: tuple, n: int, dt: float, bias_sd: float, r: np.ndarray) -> np.ndarray:
    law, drift, alpha, sigma_v = node
    return drift_covariance(law, drift, alpha, n, dt) + bias_sd**2 + np.diag(r) * sigma_v**2


def arrays(nodes: list[tuple]) -> tuple:
    law, drift, alpha, sigma_v = zip(*nodes, strict=True)
    return LAWS, np.array(law, np.int32), np.array(drift), np.array(alpha), np.array(sigma_v)


def a_record(n: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Any record will do for an identity; this one has missing samples (first and last among them) and factors r."""
    rng = np.random.default_rng(seed)
    y = np.cumsum(rng.normal(0.0, 0.3, n)) + 1.0 + rng.normal(0.0, 0.3, n)
    r = rng.uniform(0.5, 3.0, n)
    y[[0, n // 3, n // 3 + 1, n // 3 + 2, n - 1]] = np.nan
    return y, r


@pytest.mark.parametrize("node", NODES)
@pytest.mark.parametrize("gaps", [False, True])
def test_log_likelihood_and_state_are_those_of_the_joint_normal_density(node: tuple, gaps: bool) -> None:
    n = 30
    y, r = a_record(n)
    if not gaps:
        y, r = np.where(np.isnan(y), 0.3, y), np.ones(n)
    have = np.isfinite(y)
    covariance = record_covariance(node, n, DT, BIAS_SD, r)[np.ix_(have, have)]
    ln_p, mean, state_covariance = _reference.run_filters(y, DT, BIAS_MEAN, BIAS_SD, *arrays([node]), r=r)
    expected = stats.multivariate_normal(np.full(have.sum(), BIAS_MEAN), covariance).logpdf(y[have])
    assert ln_p[0] == pytest.approx(expected, abs=LN_P_TOLERANCE)

    # State at the last sample given the record: normal conditioning on the joint covariance of ((x_n, x0), y).
    drift = drift_covariance(*node[:3], n, DT)
    cross = np.vstack([drift[-1, have], np.full(have.sum(), BIAS_SD**2)])
    gain = np.linalg.solve(covariance, cross.T).T
    prior = np.diag([drift[-1, -1], BIAS_SD**2])
    np.testing.assert_allclose(mean[0], [0.0, BIAS_MEAN] + gain @ (y[have] - BIAS_MEAN), atol=1e-8)
    np.testing.assert_allclose(state_covariance[0], prior - gain @ cross.T, atol=1e-8)


@pytest.mark.parametrize("node", NODES)
def test_innovations_are_the_cholesky_residuals(node: tuple) -> None:
    y, r = a_record(30)
    have = np.isfinite(y)
    covariance = record_covariance(node, 30, DT, BIAS_SD, r)[np.ix_(have, have)]
    expected = np.linalg.solve(np.linalg.cholesky(covariance), y[have] - BIAS_MEAN)
    got = _reference.innovations(y, DT, BIAS_MEAN, BIAS_SD, LAWS[node[0]], *node[1:], r=r)
    assert np.isnan(got[~have]).all()
    np.testing.assert_allclose(got[have], expected, atol=1e-6)  # the dense solve loses half the digits at P0/R = 1e7


def test_bank_over_time_follows_equations_11_to_14() -> None:
    y, r = a_record(40)
    after = [0, 1, 17, 40]
    prior = np.array([0.1, 0.3, 0.2, 0.15, 0.25])
    law = np.array([node[0] for node in NODES])
    value = np.array([node[1:] for node in NODES])
    weight, probability, mean, covariance, bias_mean, bias_var = _reference.run_bank(
        y, DT, BIAS_MEAN, BIAS_SD, *arrays(NODES), ln_prior=np.log(prior).tolist(), after=after, r=r
    )
    for t, n in enumerate(after):
        have = np.isfinite(y[:n])
        ln_p = np.zeros(len(NODES))
        if have.any():
            for j, node in enumerate(NODES):
                dense = record_covariance(node, n, DT, BIAS_SD, r[:n])[np.ix_(have, have)]
                ln_p[j] = stats.multivariate_normal(np.full(have.sum(), BIAS_MEAN), dense).logpdf(y[:n][have])
        expected = special.softmax(np.log(prior) + ln_p)
        np.testing.assert_allclose(weight[t], expected, atol=1e-8)
        for k in range(3):
            share = expected[law == k]
            assert probability[t, k] == pytest.approx(share.sum(), abs=1e-8)
            if share.sum() < 1e-200:
                continue
            np.testing.assert_allclose(mean[t, k], np.average(value[law == k], axis=0, weights=share), atol=1e-7)
            spread = np.cov(value[law == k].T, aweights=share, bias=True) if len(share) > 1 else np.zeros((3, 3))
            np.testing.assert_allclose(covariance[t, k], spread, atol=1e-7)
    # x0 + drift of the law with one node: that node's filter.
    _, state, state_covariance = _reference.run_filters(y, DT, BIAS_MEAN, BIAS_SD, *arrays(NODES[:1]), r=r)
    assert bias_mean[-1, 0] == pytest.approx(state[0].sum(), abs=1e-12)
    assert bias_var[-1, 0] == pytest.approx(state_covariance[0].sum(), abs=1e-12)


@pytest.mark.parametrize("node", NODES)
@pytest.mark.parametrize("p", [1, 3, 6])
def test_regressors_are_those_of_the_joint_normal_density(node: tuple, p: int) -> None:
    """y = x0 + drift + Z c + v with c ~ N(0, diag(sd^2)): covariance of the record, conditional mean and covariance of
    (x0 + drift + z c, c) at the last sample, and the bank's weights, from the dense matrices."""
    n = 30
    y, r = a_record(n)
    y[-1] = 0.7  # what is read now is asked for at the last sample
    have = np.isfinite(y)
    rng = np.random.default_rng(p)
    z = np.column_stack([np.arange(n) * 0.1, (np.arange(n) >= 12) * 1.0, np.sin(np.arange(n)), rng.normal(size=(n, 3))])
    z = np.ascontiguousarray(z[:, :p])
    z[~have] = np.nan
    sd = np.geomspace(0.1, 10.0, p)
    used = z[have]
    covariance = record_covariance(node, n, DT, BIAS_SD, r)[np.ix_(have, have)] + used * sd**2 @ used.T
    ln_p, mean, state_covariance = _reference.run_filters(
        y, DT, BIAS_MEAN, BIAS_SD, *arrays([node]), r=r, z=z, coefficient_sd=sd
    )
    expected = stats.multivariate_normal(np.full(have.sum(), BIAS_MEAN), covariance).logpdf(y[have])
    assert ln_p[0] == pytest.approx(expected, abs=LN_P_TOLERANCE)

    drift = drift_covariance(*node[:3], n, DT)
    cross = np.vstack([drift[-1, have], np.full(have.sum(), BIAS_SD**2), (used * sd**2).T])
    gain = np.linalg.solve(covariance, cross.T).T
    prior = np.diag([drift[-1, -1], BIAS_SD**2, *sd**2])
    expected_mean = np.concatenate([[0.0, BIAS_MEAN], np.zeros(p)]) + gain @ (y[have] - BIAS_MEAN)
    expected_covariance = prior - gain @ cross.T
    # The dense solve has P0 / sigma_v^2 = 1e8 in it at the worst node.
    np.testing.assert_allclose(mean[0], expected_mean, atol=1e-6)
    np.testing.assert_allclose(state_covariance[0], expected_covariance, atol=1e-6)
    now = np.concatenate([[1.0, 1.0], z[-1]])
    law = node[0]
    _, probability, _, _, bias_mean, bias_var = _reference.run_bank(
        y, DT, BIAS_MEAN, BIAS_SD, *arrays([node]), ln_prior=[0.0], after=[n], r=r, z=z, coefficient_sd=sd
    )
    assert probability[0, law] == 1.0
    assert bias_mean[0, law] == pytest.approx(now @ expected_mean, abs=1e-6)
    assert bias_var[0, law] == pytest.approx(now @ expected_covariance @ now, abs=1e-6)


def further_covariance(
    law: int, drift: float, second: float, sigma_v: float, r: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Covariances [n, n] of the drift and of the noise under laws 3 to 5, by their definitions. `r` [n]: factors on the
    white noise."""
    n = r.size
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    white = np.diag(r) * sigma_v**2
    if law == 3:
        terms = [np.exp(-second * ratio * DT * lag) for ratio in (0.0625, 1.0, 16.0)]
        return (0.96 * drift) ** 2 * sum(terms), white
    if law == 4:
        theta = (second - 1.0) / (second + 1.0)
        mixing = np.eye(n, n + 1, 1) + theta * np.eye(n, n + 1)  # of e_(-1), e_0, ..., e_(n-1)
        noise = mixing * np.concatenate([[1.0], r]) @ mixing.T * (sigma_v / (1.0 + theta)) ** 2
        return drift_covariance(1, drift, 1.0, n, DT), noise
    markov = drift_covariance(2, second * drift * np.sqrt(20.0), 0.05, n, DT)  # sigma_m = ratio K sqrt(time)
    return markov + drift_covariance(1, drift, 1.0, n, DT), white


@pytest.mark.parametrize(("law", "drift", "second"), [(3, 0.4, 0.05), (4, 0.2, 4.0), (4, 0.1, 0.3), (5, 0.1, 1.1)])
def test_further_laws_are_those_of_the_joint_normal_density(law: int, drift: float, second: float) -> None:
    """Flicker, moving average, and random walk with Gauss-Markov, with gaps, factors on the white noise and two
    regressors: density of the record, and mean and variance of x0 + drift + c z at the last sample."""
    n, sigma_v, sd = 30, 0.3, np.array([0.2, 1.0])
    y, r = a_record(n)
    y[-1] = 0.7
    have = np.isfinite(y)
    r = np.where(have, r, 1.0)
    z = np.column_stack([np.arange(n) * 0.1, np.sin(np.arange(n))])
    slow, noise = further_covariance(law, drift, second, sigma_v, r)
    signal = slow + BIAS_SD**2 + z * sd**2 @ z.T
    dense = (signal + noise)[np.ix_(have, have)]
    node = arrays([(law, drift, second, sigma_v)])
    beside = {"r": r, "z": z, "coefficient_sd": sd}
    ln_p, mean, covariance = _reference.run_filters(y, DT, BIAS_MEAN, BIAS_SD, *node, **beside)
    expected = stats.multivariate_normal(np.full(have.sum(), BIAS_MEAN), dense).logpdf(y[have])
    assert ln_p[0] == pytest.approx(expected, abs=LN_P_TOLERANCE)
    states = {3: 3, 4: 3, 5: 2}[law] + 3
    assert mean.shape == (1, states)
    assert covariance.shape == (1, states, states)

    gain = np.linalg.solve(dense, signal[have, -1])
    _, probability, _, _, now, var = _reference.run_bank(
        y, DT, BIAS_MEAN, BIAS_SD, *node, ln_prior=[0.0], after=[n], **beside
    )
    assert probability[0, law] == 1.0
    assert now[0, law] == pytest.approx(BIAS_MEAN + gain @ (y[have] - BIAS_MEAN), abs=1e-8)
    assert var[0, law] == pytest.approx(signal[-1, -1] - gain @ signal[have, -1], abs=1e-8)


def test_flicker_has_the_spectrum_it_states() -> None:
    """Two-sided spectrum of the three terms, each 2 s^2 a/(a^2 + w^2), against B^2/(2 pi f) = B^2/w: within 16 %
    between the outer bandwidths (the ripple of terms that far apart), and within 1 % in the mean over ln f."""
    w = np.geomspace(0.0625, 16.0, 301)
    ratio = sum(2.0 * 0.96**2 * a / (a**2 + w**2) for a in (0.0625, 1.0, 16.0)) * w
    assert abs(ratio - 1.0).max() < 0.16
    assert abs(np.log(ratio).mean()) < 0.01


def test_bad_arguments_are_refused() -> None:
    y = np.zeros(5)
    with pytest.raises(ValueError, match="sigma_v"):
        _reference.run_filters(y, 1.0, 0.0, 1.0, *arrays([(0, 0.0, 1.0, 0.0)]))
    with pytest.raises(ValueError, match="index into the laws"):
        _reference.run_filters(y, 1.0, 0.0, 1.0, *arrays([(6, 0.0, 1.0, 1.0)]))
    with pytest.raises(ValueError, match="alpha"):
        _reference.run_filters(y, 1.0, 0.0, 1.0, *arrays([(4, 0.5, 0.0, 1.0)]))
    with pytest.raises(ValueError, match="as many states"):
        _reference.run_filters(y, 1.0, 0.0, 1.0, *arrays([(1, 0.5, 1.0, 1.0), (3, 0.5, 1.0, 1.0)]))
    with pytest.raises(ValueError, match="length"):
        _reference.run_filters(y, 1.0, 0.0, 1.0, *arrays(NODES), r=np.ones(4))
    with pytest.raises(ValueError, match="come together"):
        _reference.run_filters(y, 1.0, 0.0, 1.0, *arrays(NODES), z=np.ones((5, 1)))
    for z in (np.ones((4, 1)), np.ones((5, 7))):
        with pytest.raises(ValueError, match="at most 6"):
            _reference.run_filters(y, 1.0, 0.0, 1.0, *arrays(NODES), z=z, coefficient_sd=np.ones(z.shape[1]))
    with pytest.raises(ValueError, match="finite where y is"):
        _reference.run_filters(y, 1.0, 0.0, 1.0, *arrays(NODES), z=np.full((5, 1), np.nan), coefficient_sd=np.ones(1))
    with pytest.raises(ValueError, match="at least 0"):
        _reference.run_filters(y, 1.0, 0.0, 1.0, *arrays(NODES), z=np.ones((5, 1)), coefficient_sd=np.array([-1.0]))
    with pytest.raises(ValueError, match="after"):
        _reference.run_bank(y, 1.0, 0.0, 1.0, *arrays(NODES), ln_prior=[0.0] * len(NODES), after=[6])


# ------------------------------------------------------------------------------------------------------------ engine


def group(law: str = "log_uniform") -> Group:
    """Priors that a dozen samples leave wide, so that a fixed quadrature over the whole box is accurate."""
    limits = {"N": (0.05, 1.0), "K": (0.02, 1.0), "sigma_m": (0.05, 2.0), "alpha": (0.02, 1.0)}
    priors = {"bias": Prior("normal", sd=BIAS_SD)}
    for name, (low, high) in limits.items():
        normal = Prior.log_normal(math.sqrt(low * high), math.log(high / low) / 8.0)
        priors[name] = normal if law == "log_normal" else Prior(law, low, high)
    return Group("test", ("gx",), "deg/s", 0.0, 0.0, 0, priors)


def prior_density(prior: Prior, x: np.ndarray | float) -> np.ndarray:
    """Density in x = ln(parameter)."""
    if prior.law == "log_uniform":
        return np.full(np.shape(x), 1.0 / np.log(prior.max / prior.min))
    if prior.law == "log_normal":
        middle, sd = 0.5 * np.log(prior.min * prior.max), np.log(prior.max / prior.min) / 8.0
        return stats.truncnorm(-4.0, 4.0, loc=middle, scale=sd).pdf(np.clip(x, np.log(prior.min), np.log(prior.max)))
    return np.exp(x) / (prior.max - prior.min)


def box_quadrature(y: np.ndarray, r: np.ndarray, name: str, a_group: Group, points: int) -> dict:
    """Everything an engine reports of one hypothesis, by Gauss-Legendre over the prior box with the dense density."""
    names = NAMED[name].parameters
    law = list(NAMED).index(name)
    x, w = np.polynomial.legendre.leggauss(points)
    axes, weights = [], []
    for parameter in names:
        prior = a_group.priors[parameter]
        low, high = np.log(prior.min), np.log(prior.max)
        axes.append(0.5 * (low + high) + 0.5 * (high - low) * x)
        weights.append(0.5 * (high - low) * w * prior_density(prior, axes[-1]))
    theta = np.exp(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(names)))
    weight = np.ones(1)
    for one in weights:
        weight = np.multiply.outer(weight, one).ravel()
    have = np.isfinite(y)
    ln_p, bias_mean, bias_var = np.empty(len(theta)), np.empty(len(theta)), np.empty(len(theta))
    for j, values in enumerate(theta):
        drift, alpha = (values[1] if law else 0.0), (values[2] if law == 2 else 1.0)
        node = (law, drift, alpha, values[0] / np.sqrt(DT))
        dense = record_covariance(node, len(y), DT, BIAS_SD, r)[np.ix_(have, have)]
        ln_p[j] = stats.multivariate_normal(np.zeros(have.sum()), dense).logpdf(y[have])
        signal = drift_covariance(law, drift, alpha, len(y), DT)
        cross = signal[-1, have] + BIAS_SD**2
        gain = np.linalg.solve(dense, cross)
        bias_mean[j], bias_var[j] = gain @ y[have], signal[-1, -1] + BIAS_SD**2 - gain @ cross
    mass = weight * np.exp(ln_p - ln_p.max())
    total = mass.sum()
    mass /= total
    mean = mass @ theta
    now = mass @ bias_mean

    def below(d: int, value: float) -> float:
        """Share of the posterior in which parameter d is below `value`: posterior over prior is the
        polynomial through its Legendre points."""
        others = tuple(other for other in range(len(names)) if other != d)
        ratio = interpolate.BarycentricInterpolator(
            axes[d], mass.reshape([points] * len(names)).sum(axis=others) / weights[d]
        )
        prior = a_group.priors[names[d]]
        return integrate.quad(lambda x: ratio(x) * prior_density(prior, x), np.log(prior.min), np.log(value))[0]

    return {
        "ln_evidence": np.log(total) + ln_p.max(),
        "mean": mean,
        "sd": np.sqrt(mass @ (theta - mean) ** 2),
        "below": below,
        "bias_mean": now,
        "bias_var": mass @ (bias_var + (bias_mean - now) ** 2),
    }


@pytest.mark.parametrize("prior", ["log_uniform", "uniform", "log_normal"])
def test_engine_equals_quadrature_over_the_prior_box(prior: str) -> None:
    """10 samples, with gaps and factors r. Quadrature with 16 and 20 points a dimension agrees to 1e-6 nat on this
    record.

    Tolerances: probability 2e-4 (the contract), ln evidence what the engine refines to, moments 2e-3 posterior sd,
    quantiles 2e-3 in the share of the posterior below them.
    """
    y, r = a_record(10, seed=4)
    a_group = group(prior)
    odds = {"constant": 0.5, "random_walk": 0.2, "gauss_markov": 0.3}
    result = reference_axis(y, DT, a_group, odds, r)
    assert result.n == np.isfinite(y).sum()
    truth = {name: box_quadrature(y, r, name, a_group, 16) for name in PLAIN}
    probability = special.softmax([np.log(odds[name]) + truth[name]["ln_evidence"] for name in PLAIN])
    for name, expected in zip(PLAIN, probability, strict=True):
        assert result.probability[name] == pytest.approx(expected, abs=2e-4)
        assert result.log_evidence[name] == pytest.approx(truth[name]["ln_evidence"], abs=4e-4)
        for d, parameter in enumerate(NAMED[name].parameters):
            got, sd = result.parameters[name][parameter], truth[name]["sd"][d]
            assert got.mean == pytest.approx(truth[name]["mean"][d], abs=2e-3 * sd)
            assert got.sd == pytest.approx(sd, rel=2e-3)
            for share, quantile in ((0.05, got.q05), (0.5, got.median), (0.95, got.q95)):
                assert truth[name]["below"](d, quantile) == pytest.approx(share, abs=2e-3)
    bias_mean = probability @ [truth[name]["bias_mean"] for name in PLAIN]
    spread = [truth[name]["bias_var"] + (truth[name]["bias_mean"] - bias_mean) ** 2 for name in PLAIN]
    assert result.bias_mean == pytest.approx(bias_mean, abs=1e-3 * np.sqrt(probability @ spread))
    assert result.bias_sd == pytest.approx(np.sqrt(probability @ spread), rel=1e-3)


def constant_law(y: np.ndarray, dt: float, bias_sd: float, prior: Prior):
    """The constant law in closed form: ln p(Y | sigma_v) with the bias integrated out, and the range of its peak."""
    n, mean, squares = len(y), y.mean(), ((y - y.mean()) ** 2).sum()

    def ln_p(ln_density: float) -> float:
        variance = np.exp(2 * ln_density) / dt
        of_mean = stats.norm(0.0, np.sqrt(bias_sd**2 + variance / n)).logpdf(mean)
        return -0.5 * (n - 1) * np.log(2 * np.pi * variance) - 0.5 * np.log(n) - 0.5 * squares / variance + of_mean

    centre = np.clip(0.5 * np.log(squares / (n - 1) * dt), np.log(prior.min), np.log(prior.max))
    peak = ln_p(centre)

    def integral(low: float, high: float) -> float:
        low, high = max(low, np.log(prior.min)), min(high, np.log(prior.max))
        return integrate.quad(lambda x: np.exp(ln_p(x) - peak), low, high, epsabs=0, epsrel=1e-10, limit=200)[0]

    return integral, peak, centre


@pytest.mark.parametrize(("n", "sd"), [(3, 0.3), (1000, 0.3), (100_000, 0.3), (1000, 1.5), (1000, 0.02)])
def test_constant_law_against_its_closed_form(n: int, sd: float) -> None:
    """Evidence and quantiles, short to long records, and with the true N beyond either limit of the prior (0.05 to
    1)."""
    y = np.random.default_rng(n).normal(0.2, sd / np.sqrt(DT), n)
    a_group = group()
    prior = a_group.priors["N"]
    integral, peak, centre = constant_law(y, DT, BIAS_SD, prior)
    width = 8.0 / np.sqrt(2 * n) if 0.05 < sd < 1.0 else 40.0 / n
    reach = (centre - width, centre + width) if n > 3 else (-9.0, 9.0)
    total = integral(*reach)
    result = reference_axis(y, DT, a_group, {"constant": 1.0})
    expected = np.log(total) + peak - np.log(np.log(prior.max / prior.min))
    assert result.log_evidence["constant"] == pytest.approx(expected, abs=4e-4)
    estimate = result.parameters["constant"]["N"]
    for share, quantile in ((0.05, estimate.q05), (0.5, estimate.median), (0.95, estimate.q95)):
        assert integral(reach[0], np.log(quantile)) / total == pytest.approx(share, abs=2e-3)
    assert estimate.identified == (n > 3 and 0.05 < sd < 1.0)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """Random walk, parameters drawn from the prior: 90 % of the 90 % intervals must hold them, whatever the prior.

    200 records of 300 samples; bounds are the central 99.8 % of the binomial law; one fixed set of seeds.
    """
    a_group = group()
    random = _reference.Random(7, 1)
    held = {"N": 0, "K": 0}
    for seed in range(200):
        axis = _reference.Axis()
        axis.law = NAMED["random_walk"].as_tuple
        axis.bias = BIAS_SD * random.normal()
        for parameter, name in (("N", "N"), ("K", "drift")):
            prior = a_group.priors[parameter]
            setattr(axis, name, prior.min * (prior.max / prior.min) ** random.uniform())
        scene = _reference.Scene()
        scene.seed, scene.rate_hz, scene.samples = seed, 1.0 / DT, 300
        y = _reference.simulate(scene, [axis])[0][0]
        estimates = reference_axis(y, DT, a_group, {"random_walk": 1.0}).parameters["random_walk"]
        for parameter, true in (("N", axis.N), ("K", axis.drift)):
            held[parameter] += estimates[parameter].q05 <= true <= estimates[parameter].q95
    low, high = stats.binom(200, 0.9).ppf([0.001, 0.999])
    for parameter, count in held.items():
        assert low <= count <= high, f"{parameter}: {count} of 200"


def test_a_large_offset_changes_nothing_but_the_bias() -> None:
    """10^4 units of offset under a flat bias prior: the same posterior, the bias moved by the offset."""
    flat = Group("test", ("gx",), "deg/s", 0.0, 0.0, 0, {**group().priors, "bias": Prior("normal", sd=1e6)})
    y, r = a_record(60)
    near, far = (reference_axis(y + offset, DT, flat, {"random_walk": 1.0}, r) for offset in (0.0, 1e4))
    assert far.bias_mean - near.bias_mean == pytest.approx(1e4, abs=1e-4)
    assert far.bias_sd == pytest.approx(near.bias_sd, rel=1e-4)
    for name, estimate in near.parameters["random_walk"].items():
        assert far.parameters["random_walk"][name].mean == pytest.approx(estimate.mean, rel=1e-4)


def test_a_grid_out_of_reach_is_an_error_not_a_hang(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reference, "_NODES_MOST", 100)
    with pytest.raises(UserError, match="more than 100 nodes"):
        reference_axis(a_record(30)[0], DT, group(), {"random_walk": 1.0})


def test_no_sample_is_an_error() -> None:
    with pytest.raises(UserError, match="no sample"):
        reference_axis(np.full(5, np.nan), 1.0, group(), {"constant": 1.0})
