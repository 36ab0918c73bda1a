"""Block means of a drift against dense covariances that are summed sample by sample: lib/DESIGN.md, "Block means of
the drift".

The truth has no closed form of the library's: the covariance of two means is the sum over all pairs of their samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from selfcal import _reference
from selfcal.adequacy.allan import allan_terms
from selfcal.bank.library import Bank
from selfcal.model.file import DEFAULT, Model
from selfcal.model.laws import Law, averaged, lost_of
from selfcal.model.tables import Tables, make_tables

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SUMS = Model.load(DEFAULT.parent / "sums.yaml")
GROUP = SUMS.group_of("gx")
#: Second parameter of each law: alpha in 1/s, or the ratio.
SECOND = {
    "random_walk": 1.0,
    "gauss_markov": 0.15,
    "flicker": 0.05,
    "moving_average": 1.3,
    "walk_and_markov": 2.0,
}
#: Of the bias, in the model file's unit. A float sample has 1e-7 of it, so it is no larger than the test needs.
BIAS_SD = 10.0


def scattered(drift: Floats, left: int) -> float:
    """Variance that the mean of `left` samples drawn from a block has about the block's own mean, from the covariance
    [block, block] of its drift: over every draw where there are few, else by the identity for draws without return."""
    block = len(drift)
    if block > 10:
        apart = float(np.trace(drift) - drift.sum() / block) / (block - 1.0)
        return apart * (1.0 / left - 1.0 / block)
    draws = [np.isin(np.arange(block), draw) / left - 1.0 / block for draw in combinations(range(block), left)]
    return float(np.mean([weights @ drift @ weights for weights in draws]))


@dataclass(frozen=True)
class Dense:
    """`n` means of `block` samples every `dt` s under one value of a law's parameters: their covariance [n, n] with the
    bias; the covariance [n] of each with bias and drift at the last sample, and the variance of that. `left` [n]:
    samples that each mean is of, drawn from its block; None: all."""

    covariance: Floats
    with_now: Floats
    var_now: float

    @staticmethod
    def of(
        law: Law, N: float, drift: float, second: float, dt: float, block: int, n: int, left: Ints | None = None
    ) -> Dense:
        left = np.full(n, block) if left is None else left

        def scatter(drift: Floats) -> Floats:
            of = {k: scattered(drift, k) for k in set(left.tolist())}
            return np.diag([of[k] for k in left.tolist()])

        # the walk is 0 one interval before the middle of the first block
        t = (np.arange(1.0, n * block + 1.0) + 0.5 * (block - 1)) * dt / block
        means, now = np.zeros((n, n)), np.zeros(n)
        var = BIAS_SD**2
        for term in law.terms:
            if term.kind == "walk":
                density = (term.deviation * drift) ** 2
                # min(t, t') of two blocks is the earlier one's mean time; within one it is summed
                mean_t = t.reshape(n, block).mean(axis=1)
                own = np.minimum.outer(t[:block], t[:block]).mean() - mean_t[0]
                means += density * (np.minimum.outer(mean_t, mean_t) + own * np.eye(n))
                means += scatter(density * np.minimum.outer(t[:block], t[:block]))
                now += density * mean_t
                var += density * float(t[-1])
            else:
                alpha = term.bandwidth * (1.0 if term.stated else second)
                sigma = term.deviation * drift * (second if term.by_ratio else 1.0)
                variance = sigma**2 / (alpha if law.has_walk else 1.0)
                apart = np.arange(float(block))[:, None] - np.arange(float(block))
                k = np.arange(float(n))
                step = alpha * dt / block
                of_lag = np.array([np.exp(-step * np.abs(lag * block + apart)).mean() for lag in k])
                means += variance * of_lag[np.abs(k[:, None] - k).astype(int)]
                means += scatter(variance * np.exp(-step * np.abs(apart)))
                now += variance * np.exp(-step * (t[-1] - t) * block / dt).reshape(n, block).mean(axis=1)
                var += variance
        white = np.diag(block / left)
        if law.coloured_noise:
            theta = (second - 1.0) / (second + 1.0)
            of_noise = (np.eye(n, n + 1, k=1) + theta * np.eye(n, n + 1)) / (1.0 + theta)
            white = of_noise * np.append(1.0, block / left) @ of_noise.T
        return Dense(means + white * N**2 / dt + BIAS_SD**2, now + BIAS_SD**2, var)

    def ln_p(self, y: Floats) -> float:
        factor = cho_factor(self.covariance)
        ln_det = 2.0 * float(np.log(np.diag(factor[0])).sum())
        return -0.5 * (y.size * math.log(2.0 * math.pi) + ln_det + float(y @ cho_solve(factor, y)))

    def now(self, y: Floats) -> tuple[float, float]:
        """Mean and sd of bias and drift at the last sample."""
        weights = cho_solve(cho_factor(self.covariance), self.with_now)
        return float(weights @ y), math.sqrt(self.var_now - float(weights @ self.with_now))

    def draw(self, seed: int) -> Floats:
        """As float32 holds them, about 0 and not the bias's prior, which would cost their digits."""
        random = np.random.default_rng(seed).normal(size=len(self.covariance))
        drawn = np.linalg.cholesky(self.covariance - BIAS_SD**2 + 0.01) @ random
        return drawn.astype(np.float32).astype(np.float64)


def tables_of(law: str, dt: float, block: int) -> Tables:
    made = make_tables(SUMS, block / dt, ("gx",), bank_rate_hz=1.0 / dt)
    one = replace(made.axes[0], range=0.0, stuck_limit=0, bias_sd=BIAS_SD)
    hypotheses = tuple(replace(h, ln_probability=0.0) for h in made.hypotheses if h.name == law)
    return replace(made, axes=(one,), hypotheses=hypotheses)


def true_parameters(law: Law, node: dict[str, float], sigma: float, dt: float, block: int) -> tuple[float, float]:
    """N and the drift parameter of a node at sigma_v, by sums over samples: its points have the lag-1 covariance of the
    means, and the white noise makes up for their variance."""
    second = math.exp(node["ln_alpha"]) if math.isfinite(node["ln_alpha"]) else 1.0
    rho_sigma = math.exp(node["ln_rho"]) * sigma

    def lag(x: float, k: int) -> float:
        apart = np.arange(float(block))[:, None] - np.arange(float(block))
        return float(np.exp(-x / block * np.abs(k * block + apart)).mean())

    drift = rho_sigma / (math.sqrt(dt) if law.has_walk else 1.0)
    if not law.is_sum and not law.has_walk:
        x = second * dt
        drift /= math.sqrt(lag(x, 1) * math.exp(x))
    rest = 0.0
    for term in law.terms:
        if term.kind == "walk":
            samples = np.arange(1.0, block + 1.0)
            within = float(np.minimum.outer(samples, samples).mean()) / block
            between = 1.0 - (block - 1) / (2.0 * block)  # of a point at the first interval
            rest += (term.deviation * drift) ** 2 * dt * (between - within)
        else:
            x = term.bandwidth * (1.0 if term.stated else second) * dt
            sigma_m = term.deviation * drift * (second if term.by_ratio else 1.0)
            variance = sigma_m**2 / (x / dt if law.has_walk else 1.0)
            rest += variance * (lag(x, 1) * math.exp(x) - lag(x, 0))
    return math.sqrt((sigma**2 + rest) * dt), drift


@pytest.mark.parametrize("block", [2, 50])
@pytest.mark.parametrize("law", SECOND)
def test_nodes_have_the_likelihood_and_the_bias_of_averaged_samples(law: str, block: int) -> None:
    """500 means, in the double build: what is left is the float that a pushed sample is, 2e-4 nat."""
    dt, n, of = 2.0, 500 if block == 50 else 100, GROUP.laws[law]
    y = Dense.of(of, 0.05, 0.02, SECOND[law], dt, block, n).draw(block)
    bank = Bank(tables_of(law, dt, block), build="_library64")
    bank.push(np.repeat(y, block)[:, None])
    grid = bank.tables.hypotheses[0]
    nodes = grid.rho.nodes * (grid.alpha.nodes if grid.alpha else 1)
    offset, tried = math.nan, 0
    for j in range(0, nodes, max(1, nodes // 9)):
        node = bank.raw.node(0, j)
        sigma = 0.04
        N, drift = true_parameters(of, node, sigma, dt, block)
        second = math.exp(node["ln_alpha"]) if math.isfinite(node["ln_alpha"]) else 1.0
        if of.coloured_noise and second**2 * (1.0 - dt * sigma**2 / N**2) > 0.99:
            continue  # no moving average has so little noise at high frequency
        truth = Dense.of(of, N, drift, second, dt, block, n)
        assert bank.raw.log_likelihood(0, j, sigma) == pytest.approx(truth.ln_p(y), abs=2e-4)
        mean, sd = truth.now(y)
        precision = sigma**2 / BIAS_SD**2
        share = node["bias_left"] / (node["a"] + precision)
        assert sigma * math.sqrt(node["drift_var"] + share * node["bias_left"]) == pytest.approx(sd, rel=1e-6)
        # the sums are about an offset that all nodes share
        found = (mean - node["drift"] - share * node["b"]) / (1.0 - share * precision)
        offset = offset if math.isfinite(offset) else found
        assert found == pytest.approx(offset, abs=1e-5 * sd)
        tried += 1
    assert tried >= 5


#: How far ln p may be off, over what the noise that the library adds for lost readings is worth: nothing beside a walk,
#: where only rounding is left; else the fit is 0.6 % off (lib/averages.h), and 2 % covers errors of either sign.
LOST = [("random_walk", 2e-4), ("gauss_markov", 0.02), ("flicker", 0.02), ("walk_and_markov", 0.02)]


@pytest.mark.parametrize(("law", "most"), LOST)
@pytest.mark.parametrize("block", [2, 10, 50])
def test_nodes_have_the_likelihood_of_means_that_lack_readings(law: str, most: float, block: int) -> None:
    """Blocks with half to all of their samples: more of the white noise, no more of what the drift hides."""
    dt, n, of = 2.0, 100, GROUP.laws[law]
    if block == 2 and law != "random_walk":
        pytest.skip("the scatter is a fit for ten samples and more")
    left = np.random.default_rng(block).integers((block + 1) // 2, block + 1, n)
    left[np.arange(0, n, 3)] = left[-1] = block
    y = Dense.of(of, 0.02, 0.02, SECOND[law], dt, block, n, left).draw(block)
    bank = Bank(tables_of(law, dt, block), build="_library64")
    lost = np.zeros(int(left.sum()), np.int64)
    lost[np.cumsum(left)[:-1]] = block - left[:-1]
    bank.push(np.repeat(y, left)[:, None], lost)
    grid = bank.tables.hypotheses[0]
    nodes = [bank.raw.node(0, j) for j in range(grid.rho.nodes * (grid.alpha.nodes if grid.alpha else 1))]
    near = [j for j, node in enumerate(nodes) if abs(node["ln_rho"]) < 2.0]  # beyond, one of drift and noise hides
    worst, moved = 0.0, 0.0
    for j in near[:: max(1, len(near) // 20)]:
        sigma, node = 0.015, nodes[j]
        N, drift = true_parameters(of, node, sigma, dt, block)
        second = math.exp(node["ln_alpha"]) if math.isfinite(node["ln_alpha"]) else 1.0
        truth = Dense.of(of, N, drift, second, dt, block, n, left)
        as_white = replace(truth, covariance=truth.covariance + np.diag((block / left - 1.0) * (sigma**2 - N**2 / dt)))
        worst = max(worst, abs(bank.raw.log_likelihood(0, j, sigma) - truth.ln_p(y)))
        moved = max(moved, abs(as_white.ln_p(y) - truth.ln_p(y)))
    print(law, block, worst, moved)
    assert worst <= most * moved
    assert moved > 0.2, "lost readings as plain noise would pass"


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("law", SECOND)
def test_the_textbook_bank_averages_sample_by_sample(law: str, lost: bool) -> None:
    dt, block, n, of = 2.0, 7, 60, GROUP.laws[law]
    left = np.random.default_rng(5).integers(4, block + 1, n) if lost else np.full(n, block)
    truth = Dense.of(of, 0.05, 0.03, SECOND[law], dt, block, n, left)
    y = truth.draw(3)
    one = np.ones(1)
    arguments = [of.as_tuple], np.zeros(1, np.int32), 0.03 * one, SECOND[law] * one, 0.05 / math.sqrt(dt) * one
    ln_p, mean, covariance = _reference.run_filters(y, dt, 0.0, BIAS_SD, *arguments, block / left, block=block)
    assert ln_p[0] == pytest.approx(truth.ln_p(y), abs=1e-6)
    terms = len(of.terms)
    now = np.array([1.0] * terms + [0.0] * (terms + 2 * of.coloured_noise) + [1.0])
    assert mean[0] @ now == pytest.approx(truth.now(y)[0], abs=1e-9)
    assert math.sqrt(now @ covariance[0] @ now) == pytest.approx(truth.now(y)[1], rel=1e-6)


@pytest.mark.parametrize("law", SECOND)
def test_the_allan_variance_is_that_of_averaged_samples(law: str) -> None:
    dt, block, n, of = 1.0, 5, 40, GROUP.laws[law]
    truth = Dense.of(of, 0.05, 0.03, SECOND[law], dt, block, n).covariance
    terms = allan_terms(of, dict(zip(of.parameters, (0.05, 0.03, SECOND[law]), strict=False)), dt, block)
    for m in (1, 2, 7):
        weights = np.zeros(n)
        weights[n - 2 * m : n - m], weights[n - m :] = -1.0 / m, 1.0 / m
        # the bias's 100 drops out of the difference and leaves its rounding
        assert terms.allan_variance(np.array([float(m)]))[0] == pytest.approx(0.5 * weights @ truth @ weights, rel=1e-8)


@pytest.mark.parametrize("x", [1e-6, 9.9e-4, 1.1e-3, 0.3, 6.0, 30.0, 900.0])
@pytest.mark.parametrize("block", [1, 2, 64])
def test_averaged_keeps_its_digits_from_slow_to_fast_drifts(x: float, block: int) -> None:
    """Against sums over the samples: the variance of a mean, and up to 20 correlation times the lag-1 covariance."""
    gain, rest = averaged(x, block)
    apart = np.abs(np.arange(float(block))[:, None] - np.arange(float(block)))
    assert gain - rest == pytest.approx(float(np.exp(-x / block * apart).mean()), rel=1e-6)
    if x < 20.0 and block > 1:
        far = block + np.arange(float(block))[:, None] - np.arange(float(block))
        assert gain * math.exp(-x) == pytest.approx(float(np.exp(-x / block * far).mean()), rel=1e-12)
        deficit = -np.expm1(-x / block * apart).mean() - (1.0 - gain)
        assert rest == pytest.approx(float(deficit), rel=1e-5, abs=1e-15)
        # half of the readings lost: r - 1 is 1 where the block is even
        scatter = scattered(np.exp(-x / block * apart), block // 2)
        assert lost_of(x, block) == pytest.approx((rest + scatter) / gain, rel=1e-4)
