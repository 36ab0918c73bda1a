"""Forgetting: sums in which a sample counts for 2^-(age / half-life), a batch at a time.

Truth: the weighted recursions in double, the double build, and records whose parameter changes at a known time.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from selfcal import _library32
from selfcal.adequacy.drawn import draw_parameters, simulate_bank_samples
from selfcal.bank.library import Bank
from selfcal.base.errors import UserError
from selfcal.model.file import Model, Regressor
from selfcal.model.tables import Tables, make_tables
from selfcal.verbs.identify import identify

from agreement import MODEL, Filter, faded, fading
from conftest import ROOT, worst_difference

RECORDING = ROOT / "tests" / "data" / "simulated_adis16405.npz"
TIME = Regressor("time", "time", "s", {"gyro": 1e-4}, 0.5)


def tables(half_life_s: float, model: Model = MODEL) -> Tables:
    return make_tables(replace(model, half_life_s=half_life_s), 1.0, ("gx",))


@pytest.mark.parametrize("with_time", [False, True], ids=["plain", "regressor"])
def test_the_likelihood_is_that_of_the_weighted_record(with_time: bool) -> None:
    """Truth: the recursions as printed, on every kind of node, in double. Tolerance: that of equal nodes (1e-3 nat)."""
    rng = np.random.default_rng(5)
    n, half_life = 700, 100.0
    missing = np.where(rng.random(n) < 0.02, rng.integers(1, 40, n), 0)
    missing[0] = 0
    t = np.cumsum(missing + 1.0)
    y = 0.3 + 1e-4 * t * with_time + 0.05 * rng.standard_normal(n) + np.cumsum(2e-3 * rng.standard_normal(n))
    made = tables(half_life, replace(MODEL, regressors=(TIME,) if with_time else ()))
    bank = Bank(made, build="_library64")
    bank.push(y[:, None], missing.astype(np.uint64), t[:, None] if with_time else None)
    y = y.astype(np.float32).astype(float)
    sd = np.array([made.axes[0].bias_sd, TIME.sd["gyro"]])[: 1 + with_time]
    columns = np.column_stack([np.ones(n), t])[:, : 1 + with_time]
    sigma, worst = 0.06, 0.0
    for index in range(0, made.nodes, 7):
        view = bank.raw.node(0, index)
        node = Filter.of(made.hypotheses[view["hypothesis"]].name, math.exp(view["ln_rho"]), math.exp(view["ln_alpha"]))
        truth = faded(node, y, columns, missing, half_life, sd, sigma)
        found = bank.raw.log_likelihood_subset(0, index, int(with_time), sigma)
        worst = max(worst, abs(found - truth))
    print(f"\nworst |d ln p| {worst:.1e}")
    assert worst < 1e-3
    assert bank.raw.weight == pytest.approx(fading(missing, half_life).sum(), rel=1e-12)


@pytest.mark.parametrize("fixed", [False, True])
def test_float_and_integers_forget_as_double_does(fixed: bool) -> None:
    """5000 half-lives: what rounding leaves must fade as well. Tolerances of the design: 1e-3 and 0.02 sd in float,
    5e-3 and 0.05 sd in integers."""
    truth = draw_parameters(MODEL.group_of("gx"), "gauss_markov", np.random.default_rng(3))
    y = simulate_bank_samples("gauss_markov", truth, 1.0, 300_000, 3)[0][:, None]
    made = tables(60.0)
    bank, exact = Bank(made, build="_fixed" if fixed else "_library32"), Bank(made, build="_library64")
    for one in (bank, exact):
        one.push(y)
    _, probability, mean, _ = worst_difference(bank.report(0), exact.report(0))
    print(f"\n{'fixed' if fixed else 'float'}: dP {probability:.1e}, mean {mean:.1e} sd")
    assert probability < (5e-3 if fixed else 1e-3) and mean < (0.05 if fixed else 0.02)


def test_a_parameter_that_changes_is_followed() -> None:
    """White noise alone whose density triples, 10 half-lives before the end: what is left of the past is 2^-10. Without
    forgetting N is between the two."""
    rng = np.random.default_rng(7)
    y = (np.r_[np.full(30_000, 0.02), np.full(10_000, 0.06)] * rng.standard_normal(40_000))[:, None]
    found = {}
    for half_life in (1000.0, 0.0):
        bank = Bank(tables(half_life))
        bank.push(y)
        found[half_life] = bank.report(0).parameters["constant"]["N"]
    n = found[1000.0]
    assert n.q05 < 0.06 < n.q95
    # 1000 / ln 2 samples: the sd of sigma_v is sigma / sqrt(2 n); the intervals are not narrower than that
    assert n.sd == pytest.approx(0.06 / math.sqrt(2 * 1000 / math.log(2)), rel=0.05)
    assert 0.03 < found[0.0].mean < 0.04


def test_white_noise_is_no_random_walk() -> None:
    """Without a drift the constant law must not lose to one that has one, though its filter remembers x0 and the random
    walk's does not. Ten records of 20 half-lives: seen 0.57 to 0.83, where the bias prior's cost alone is 6 nat."""
    found = []
    for seed in range(10):
        bank = Bank(tables(1000.0))
        bank.push(0.3 + 0.02 * np.random.default_rng(seed).standard_normal((20_000, 1)))
        found.append(bank.report(0).probability)
    print("\n", [round(p["constant"], 2) for p in found])
    assert np.median([p["constant"] for p in found]) > 0.4
    assert max(p["random_walk"] for p in found) < 0.9


def test_nothing_is_forgotten_within_a_short_record() -> None:
    """A half-life of 10^6 records: the same as without, to what a 10^-6 th part of n ln V can do."""
    truth = draw_parameters(MODEL.group_of("gx"), "random_walk", np.random.default_rng(2))
    y = simulate_bank_samples("random_walk", truth, 1.0, 1000, 2)[0][:, None]
    banks = Bank(tables(1e9), build="_library64"), Bank(tables(0.0), build="_library64")
    for bank in banks:
        bank.push(y)
    assert max(worst_difference(*(bank.report(0) for bank in banks))) < 1e-2


def test_after_a_long_gap_nothing_is_left_and_the_bank_starts_again() -> None:
    y = 0.05 * np.random.default_rng(1).standard_normal((300 * _library32.BATCH, 1))
    bank = Bank(tables(100.0))
    bank.push(y)
    bank.push(y[:1], np.array([10**7], np.uint64))
    with pytest.raises(UserError, match="all is forgotten"):
        bank.report(0)
    assert bank.raw.sound
    bank.push(y)
    fresh = Bank(tables(100.0))
    fresh.push(y)
    assert bank.report(0).parameters["constant"]["N"].mean == pytest.approx(
        fresh.report(0).parameters["constant"]["N"].mean, rel=0.02
    )


def test_a_snapshot_in_between_changes_nothing() -> None:
    y = 0.05 * np.random.default_rng(1).standard_normal((900, 1))
    whole = Bank(tables(100.0))
    whole.push(y)
    for cut in (0, 7, 100, 501):
        bank = Bank(tables(100.0))
        bank.push(y[:cut])
        restored = Bank(tables(100.0))
        restored.raw.restore(bank.raw.save())
        restored.push(y[cut:])
        assert restored.raw.save() == whole.raw.save()


def test_bad_half_lives_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="less than 16 bank intervals"):
        tables(15.0)
    assert tables(16.0).id != tables(17.0).id != tables(0.0).id
    text = MODEL.path.read_text()
    for value, message in (
        ("-1", "half_life_s: must be"),
        ("soon", "half_life_s: must be"),
        ("600", "forgets nothing"),
    ):
        file = tmp_path / "model.yaml"
        file.write_text(f"{text}\nhalf_life_s: {value}\n")
        with pytest.raises(UserError, match=message):
            identify(RECORDING, model=file, engine="reference", axes=["gx"])
