"""A bias that oscillates: named, its numbers held, written into a model that carries over, and no clean record has one.

Truth: the numbers that each record was drawn with (swings.py). The bank's law is judged by the textbook bank, whose
states are others (position and velocity) and whose transition is a power series.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from drifts import LAWS, noise, recorded
from scipy import stats
from scipy.stats import binom
from swings import Swing, plain_ones

from selfcal import _reference
from selfcal.adequacy.allan import allan_terms
from selfcal.bank.library import Bank
from selfcal.base.errors import UserError
from selfcal.diagnosis import carried
from selfcal.diagnosis.causes import oscillation
from selfcal.diagnosis.extend import extended
from selfcal.diagnosis.loop import diagnose_record
from selfcal.logs.recording import Column, Recording
from selfcal.model.file import Model
from selfcal.model.laws import Law, Term
from selfcal.model.tables import Tables, make_tables

from agreement import Nodes, assert_prediction_is_that_of_a_gap, compare, hold
from conftest import case_records

SECONDS = 3600.0


@pytest.mark.parametrize("law", LAWS)
def test_a_line_of_constant_phase_stays_periodic(law: str) -> None:
    """9 of 10, of lines slower than a minute and faster than a sixth of the record."""
    random = np.random.default_rng([464, LAWS.index(law)])
    t, right, total = np.arange(SECONDS), 0, 0
    for _ in range(case_records(2, 30)):
        period, phase = math.exp(random.uniform(math.log(40.0), math.log(600.0))), random.uniform(0.0, 2.0 * math.pi)
        y = noise(random, law, t.size, 1.0) + 0.02 * np.sin(2.0 * math.pi * t / period + phase)
        one = diagnose_record(recorded(y, 1.0)[1], ["gx"])["gx"]
        total += 1
        right += [finding.look.cause for finding in one.findings][:1] == ["periodic"]
    print(f"line, {law}: {right} of {total}")
    assert binom.cdf(right, total, 0.9) > 1e-3


def test_swings_of_two_axes_are_no_line_of_both() -> None:
    """Two gyros, each with a swing of its own of one period. Without a common source no axis has a line: 9 of 10."""
    random, right, total = np.random.default_rng(466), 0, 0
    for _ in range(case_records(3, 30)):
        period, damping = math.exp(random.uniform(math.log(50.0), math.log(160.0))), random.uniform(0.05, 0.14)
        drawn = {
            name: recorded(noise(random, law, 1500, 1.0) + Swing(period, damping, 0.07).drawn(random, 1500, 1.0), 1.0)
            for name, law in zip(("gx", "gy"), LAWS, strict=True)
        }
        axes = {name: replace(state, axis=name) for name, (state, _) in drawn.items()}
        found = diagnose_record(replace(drawn["gx"][1], axes=axes), list(axes))
        total += 1
        right += all("periodic" not in [f.look.cause for f in axis.findings] for axis in found.values())
    print(f"two swings: {right} of {total}")
    assert binom.cdf(right, total, 0.9) > 1e-3


def test_the_effect_has_the_covariance_of_its_keys() -> None:
    """By the solution of the equation: r(t) = sd^2 exp(-d w t) (cos v t + d/s sin v t), v = s w, s = sqrt(1 - d^2).
    400 independent records: each mean of products within 4.5 of its standard deviations."""
    keys = {"period_s": 37.0, "damping": 0.12, "sd": 0.3}
    channels = oscillation.Channels(np.arange(60.0) / 2.0, *[np.zeros(60)] * 2, {}, np.random.default_rng(465))
    drawn = np.array([oscillation.CAUSE.simulated.add(keys, channels) for _ in range(400)])  # type: ignore[misc]
    w, d = 2.0 * math.pi / keys["period_s"], keys["damping"]
    s = math.sqrt(1.0 - d * d)
    for lag in (0, 7, 20, 40):
        t = lag / 2.0
        truth = keys["sd"] ** 2 * math.exp(-d * w * t) * (math.cos(s * w * t) + d / s * math.sin(s * w * t))
        products = drawn[:, 5] * drawn[:, 5 + lag]
        assert abs(products.mean() - truth) < 4.5 * products.std() / math.sqrt(400)


# ------------------------------------------------------------------------------------------------------ the bank's law


def model_with(period_s: float, damping: float, others: tuple[str, ...] = ("walk",)) -> Model:
    """The default model with one law more."""
    tree = yaml.safe_load(Model.load().path.read_text())
    term = {"kind": "oscillation", "period_s": period_s, "damping": damping, "deviation": "ratio"}
    tree["hypotheses"]["swings"] = {"probability": 1, "terms": [*others, term]}
    for group in tree["groups"].values():
        group["priors"]["markov_ratio"] = {"law": "log_uniform", "min": 0.3, "max": 30.0}
    for nodes in tree["nodes"].values():
        nodes["swings"] = [24, 20]
    tree["simulate"]["axes"] = {}
    tree["simulate"]["effects"] = []
    return Model.of_tree(tree, Model.load().path)


def tables(model: Model, rate_hz: float = 1.0) -> Tables:
    """Of one axis, without a range, and the law alone."""
    made = make_tables(replace(model, regressors=()), rate_hz, ("gx",), "host")
    laws = tuple(replace(h, ln_probability=0.0) for h in made.hypotheses if h.name == "swings")
    return replace(made, axes=(replace(made.axes[0], range=0.0),), hypotheses=laws)


@pytest.mark.parametrize("gaps", [False, True], ids=["whole", "gaps"])
@pytest.mark.parametrize(("period_s", "damping"), [(150.0, 0.1), (12.0, 0.6), (900.0, 0.004)])
def test_parity_with_the_textbook_bank(period_s: float, damping: float, gaps: bool) -> None:
    """Tolerances of the design, in every build."""
    random = np.random.default_rng([466, round(period_s), gaps])
    y = noise(random, "walk", 1500, 1.0) + Swing(period_s, damping, 0.03).drawn(random, 1500, 1.0)
    if gaps:
        y[200:203] = y[700:1100] = np.nan
    y = y.astype(np.float32).astype(np.float64)
    made = tables(model_with(period_s, damping))
    found = compare(y, made, None, builds=("double", "float", "fixed"), sigmas=5, every=29)
    hold(f"period {period_s:g} s, damping {damping:g}, gaps {gaps}", [found])


def test_allan_variance_of_the_law() -> None:
    """Against sums over the covariance of the readings, of the difference of two means: 1e-9 of it."""
    law = Law((Term("walk"), Term("oscillation", 1.0, 2.0 * math.pi / 45.0, True, True, 0.2)))
    for m in (3, 40, 200):
        found = float(
            allan_terms(law, {"N": 1e-6, "K": 1e-9, "markov_ratio": 1e6}, 0.5).allan_variance(np.array([m]))[0]
        )
        w, d = 2.0 * math.pi / 45.0, 0.2
        s = math.sqrt(1.0 - d * d)
        t = 0.5 * np.abs(np.subtract.outer(np.arange(2 * m), np.arange(2 * m)))
        r = (1e-3) ** 2 / w * np.exp(-d * w * t) * (np.cos(s * w * t) + d / s * np.sin(s * w * t))
        weight = np.repeat([-1.0, 1.0], m) / m
        white = 1e-12 / 0.5 / m
        assert found == pytest.approx(0.5 * float(weight @ r @ weight) + white, rel=1e-6)


def test_prediction_is_that_of_a_gap() -> None:
    """As in test_laws.py: the closed form of the swing against the filters through a gap. Half a period ahead the
    bias lies on the other side."""
    made = tables(model_with(200.0, 0.02))
    random = np.random.default_rng(467)
    y = noise(random, "walk", 1500, 1.0) + Swing(200.0, 0.02, 0.1).drawn(random, 1500, 1.0)
    assert_prediction_is_that_of_a_gap(made, y, None, [1, 50, 100, 200, 3000])


def test_the_textbook_has_the_covariance_of_the_equation() -> None:
    """ln p of 40 samples against the normal density by r(t) of the test above: 1e-8, double rounding."""
    w, d, K, ratio, white = 2.0 * math.pi / 25.0, 0.3, 2e-3, 4.0, 0.05
    law = Law((Term("walk"), Term("oscillation", 1.0, w, True, True, d)))
    s, i = math.sqrt(1.0 - d * d), np.arange(1.0, 41.0)
    t = np.abs(np.subtract.outer(i, i))
    r = (ratio * K) ** 2 / w * np.exp(-d * w * t) * (np.cos(s * w * t) + d / s * np.sin(s * w * t))
    total = r + K**2 * np.minimum.outer(i, i) + white**2 * np.eye(40) + 1.0
    y = np.random.default_rng(468).multivariate_normal(np.zeros(40), total - 1.0)
    node = (np.array([K]), np.array([ratio]), np.array([white]))
    ln_p, _, _ = _reference.run_filters(y, 1.0, 0.0, 1.0, [law.as_tuple], np.zeros(1, np.int32), *node)
    assert ln_p[0] == pytest.approx(stats.multivariate_normal(np.zeros(40), total).logpdf(y), abs=1e-8)


def test_means_of_blocks_read_the_swing() -> None:
    """ln p of 1 s means of ten samples, against the textbook's, which has the mean as a state: differences between
    nodes within 0.05 nat. The library has the mean's size but for the fourth power of a turn within it."""
    made = tables(model_with(30.0, 0.1), 10.0)
    random = np.random.default_rng(469)
    samples = noise(random, "walk", 10_000, 10.0) + Swing(30.0, 0.1, 0.05).drawn(random, 10_000, 10.0)
    y = samples.reshape(-1, 10).mean(axis=1).astype(np.float32).astype(np.float64)
    bank = Bank(made, build="_library64")
    bank.push(np.repeat(y, 10)[:, None], np.zeros(10 * y.size, np.uint32), None)
    nodes, sigma = Nodes.of(bank, 3), 0.04
    rho, ratio = nodes.rho, nodes.alpha
    ours = np.array([bank.raw.log_likelihood(0, int(j), sigma) for j in nodes.index])
    white = sigma * np.sqrt(1.0 + (1.0 - 0.01) / 6.0 * rho**2)  # a walk's means lack so much of it
    theirs, _, _ = _reference.run_filters(
        y,
        1.0,
        0.0,
        made.axes[0].bias_sd,
        [made.hypotheses[0].law.as_tuple],
        np.zeros(rho.size, np.int32),
        rho * sigma,
        ratio,
        white,
        block=10,
    )
    likely = ours > ours.max() - 20.0
    assert likely.sum() >= 3
    assert np.abs((ours - theirs)[likely]).max() < 0.05


@pytest.mark.parametrize(
    ("term", "message"),
    [
        ({"kind": "oscillation", "period_s": 5.0, "damping": 0.1}, "period_s: must be from 8"),
        ({"kind": "oscillation", "period_s": 50.0, "damping": 0.9}, "damping: must be 0.001 to 0.7"),
        ({"kind": "oscillation", "period_s": 50.0}, "damping"),
        ({"kind": "oscillation", "damping": 0.1}, "period_s"),
        ({"kind": "walk", "damping": 0.1}, "damping"),
    ],
)
def test_a_wrong_oscillation_is_refused_in_one_line(term: dict[str, object], message: str) -> None:
    tree = yaml.safe_load(Model.load().path.read_text())
    tree["hypotheses"]["swings"] = {"terms": ["walk", term]}
    for nodes in tree["nodes"].values():
        nodes["swings"] = 8
    with pytest.raises(UserError) as refusal:
        make_tables(Model.of_tree(tree, Model.load().path), 1.0, ("gx",), "host")
    assert message in str(refusal.value) and "\n" not in str(refusal.value)


def test_an_oscillation_counts_as_two_terms() -> None:
    with pytest.raises(UserError, match="3 are the most, an oscillation counts as two"):
        model_with(50.0, 0.1, ("walk", {"kind": "markov", "correlation_time_s": 20.0}))


# ------------------------------------------------------------------------------------------------------- carried over


@pytest.mark.parametrize("law", LAWS)
def test_half_of_the_evidence_carries_over(law: str) -> None:
    """7 of 10 second records of the same truth: the model that was written has half of what its truth gains there."""
    random = np.random.default_rng([470, LAWS.index(law)])
    model, half, total = Model.load(), 0, 0
    for swing, _, _, record in plain_ones(random, law, 1.0, SECONDS, case_records(1, 20)):
        second = noise(random, law, round(SECONDS), 1.0) + swing.drawn(random, round(SECONDS), 1.0)
        there = swing.evidence(recorded(second, 1.0)[0])
        found = diagnose_record(record, ["gx"])
        tree, _ = extended(model, record, found)
        names = [finding.look.cause for finding in found["gx"].by_gain]
        log = Recording(Path("second"), 1.0, {"gx": Column("gx", "deg/s", second)}, np.zeros(second.size, np.int64), {})
        gains = dict(zip(names, carried.gains(model, tree, record, found, log)["gx"][0], strict=True))
        gain = gains["oscillation"].gain if "oscillation" in gains else None
        score = {} if gain is None else gain["log_score_per_sample"]
        won = 0.0 if gain is None else (score["after"] - score["before"]) * score["samples"]
        print(f"{law}, {swing}: {won:.1f} of {there:.1f} nats")
        half, total = half + (won >= 0.5 * there), total + 1
    print(f"half carries over, {law}: {half} of {total}")
    assert binom.cdf(half, total, 0.7) > 1e-3
