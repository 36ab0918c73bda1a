"""What real streams do to the bank: changes of rate and lost axes, against the model's dense covariance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from selfcal.bank.library import Bank
from selfcal.base.errors import UserError
from selfcal.model.file import Model
from selfcal.model.tables import make_tables

#: nat; what the double build is held to against the textbook bank.
LN_P_DOUBLE = 1e-3
MODEL = Model.load()


def dense_log_likelihood(
    y: NDArray[np.float64],
    at: NDArray[np.int64],
    r: NDArray[np.float64],
    node: dict[str, float],
    sigma_v: float,
    p0: float,
    block: int,
) -> float:
    """ln N(y; 0, C) of bank samples at intervals `at` [n] with white-noise variances r times a whole block's, at dt of
    1 s: the laws' covariances written out (random walk from 0: sigma_w^2 min(i, j) with i, j from 1; Gauss-Markov:
    stationary). Of the readings' white noise a block's drift hides a part, which r does not multiply: it is summed over
    the readings, as is how the mean of some of them scatters. A tenth of the noise remains (lib/averages.h)."""
    i = at - at[0]
    law = list(MODEL.hypotheses)[int(node["hypothesis"])]
    rho_sq, lost = math.exp(2.0 * node["ln_rho"]) if law != "constant" else 0.0, 0.0
    apart = np.abs(np.subtract.outer(np.arange(block), np.arange(block)))
    if law == "random_walk":
        lost = rho_sq * (1.0 + 1.0 / block) / 6.0
    elif law == "gauss_markov":
        x = math.exp(node["ln_alpha"])
        own = float(np.exp(-x / block * apart).mean())
        point = math.exp(x) * float(np.exp(-x / block * (block + np.subtract.outer(*[np.arange(block)] * 2))).mean())
        lost = rho_sq / point * (point - own + (1.0 - own) / (block - 1.0))
    cov = np.full((y.size, y.size), p0) + np.diag(np.maximum(r + (r - 1.0) * lost, 0.1 * r)) * sigma_v**2
    if law == "random_walk":
        cov += (math.exp(node["ln_rho"]) * sigma_v) ** 2 * (np.minimum.outer(i, i) + 1.0)
    elif law == "gauss_markov":
        sigma_m = math.exp(node["ln_rho"]) * sigma_v
        cov += sigma_m**2 * np.exp(-math.exp(node["ln_alpha"]) * np.abs(np.subtract.outer(i, i)))
    _, ln_det = np.linalg.slogdet(2.0 * math.pi * cov)
    return float(-0.5 * (ln_det + y @ np.linalg.solve(cov, y)))


def test_a_change_of_rate_is_exact() -> None:
    """8 samples a second, then 4 as noisy as before (r = 2), then 16 of a quarter of the model's block variance, with
    three missing in one block and a gap: every node's ln p is that of the dense covariance."""
    tables = make_tables(MODEL, 8.0, ("gx",), bank_rate_hz=1.0)
    assert tables.block == 8
    bank = Bank(tables, build="_library64")
    rng = np.random.default_rng(5)
    y: list[float] = []
    at: list[int] = []
    r: list[float] = []
    now = 0

    def block(count: int, used: int, ratio: float) -> None:
        nonlocal now
        samples = (0.3 + 0.01 * now + rng.normal(0.0, 0.1, used)).astype(np.float32)
        bank.push(samples[:, None])
        bank.raw.skip(count - used)
        y.append(float(samples.astype(np.float64).mean()))
        at.append(now)
        r.append(ratio * count / used)
        now += 1

    for _ in range(21):
        block(8, 8, 1.0)
    bank.push(np.full((3, 1), 5.0))  # of a block that the change cuts off
    bank.raw.rate(4, 2.0)  # 3 of 8 have passed: 1 of 4
    bank.push(np.full((3, 1), 5.0))
    now += 1
    for _ in range(18):
        block(4, 4, 2.0)
    bank.raw.rate(16, 0.25)
    for k in range(25):
        block(16, 13 if k == 7 else 16, 0.25)
    bank.raw.skip(5 * 16)
    now += 5
    for _ in range(10):
        block(16, 16, 0.25)
    assert bank.raw.count == len(y)
    sd = MODEL.group_of("gx").priors["bias"].sd
    worst = {False: 0.0, True: 0.0}  # by whether the library has a fit of what the drift hides
    for j in range(bank.raw.nodes):
        node = bank.raw.node(0, j)
        theirs = dense_log_likelihood(np.array(y), np.array(at), np.array(r), node, 0.04, sd**2, 8)
        off = abs(bank.raw.log_likelihood(0, j, 0.04) - theirs)
        fitted = math.isfinite(node["ln_alpha"])
        # nodes far from the data: relative to what they say
        worst[fitted] = max(worst[fitted], off / max(1.0, abs(theirs) / 1e3))
    print(f"\nlargest |d ln p| over {bank.raw.nodes} nodes: {worst[False]:.2g}, Gauss-Markov {worst[True]:.2g}")
    assert worst[False] < LN_P_DOUBLE
    assert worst[True] < 0.02


@pytest.mark.parametrize("double", [False, True], ids=["float", "double"])
def test_the_density_may_stay_at_a_change_of_rate(double: bool) -> None:
    """A sensor that averages more before it hands out a sample: the same block means come in fewer samples, so that a
    ratio of 1 leaves every sum as it was, bit for bit."""
    tables = make_tables(MODEL, 8.0, ("gx",), bank_rate_hz=1.0)
    banks = [Bank(tables, build="_library64" if double else "_library32") for _ in range(2)]
    levels = np.random.default_rng(6).normal(0.3, 0.05, 200).astype(np.float32)
    for bank in banks:
        bank.push(np.repeat(levels[:100], 8)[:, None])
    banks[1].raw.rate(2, 1.0)
    banks[0].push(np.repeat(levels[100:], 8)[:, None])
    banks[1].push(np.repeat(levels[100:], 2)[:, None])
    for j in range(banks[0].raw.nodes):
        views = [bank.raw.node(0, j) for bank in banks]
        assert repr(views[0]) == repr(views[1])


def test_a_retired_axis_is_a_clear_complaint() -> None:
    tables = make_tables(MODEL, 1.0, ("gx", "gy"))
    bank = Bank(tables)
    samples = np.random.default_rng(7).normal(0.0, 0.05, (200, 2))
    samples[20:, 1] = np.nan
    bank.push(samples)
    assert [bank.raw.retired(axis) for axis in (0, 1)] == [False, True]
    assert bank.report(0).n == 20 + 120  # 60 bank intervals until it is given up
    with pytest.raises(UserError, match=r"^gy was out of range or stuck for too long and is left out"):
        bank.report(1)
