"""The second generator of hidden effects (tests/hidden/physics.py) itself: its evaluator, sizes, records and verdicts.

Nothing of the detector runs here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import evidence
import physics
import physics_suite
from physics import FINE, KINDS, pair

#: Causes of the contract that may be a right name.
CAUSES = {
    "temperature", "supply", "cross_axis", "ramp", "step", "periodic", "quantization", "variance_change", "outliers",
    "saturation", "missing_samples", "colored_noise", "flicker", "motion", "turn_on", "shared", "two_level", "pulse",
    "stuck", "held_samples", "rate_change", "oscillation", "vibration", "quantization_noise",
}  # fmt: skip


def test_table_of_names() -> None:
    assert len(KINDS) >= 30
    assert 2 * sum(kind.by_effect for kind in KINDS.values()) <= len(KINDS)
    for kind in KINDS.values():
        assert set(kind.names) <= CAUSES
        assert kind.form in (None, "static", "lag", "rate", "square", "cube", "play")
    assert FINE >= 10


@pytest.mark.parametrize("law", physics.LAWS)
@pytest.mark.parametrize("dt", [1.0, 0.1])
def test_likelihood_against_a_dense_covariance(law: str, dt: float) -> None:
    """300 samples, a column fitted or not. The same numbers in another way: only rounding differs, 1e-6 nat."""
    random, n = np.random.default_rng(3), 300
    t = np.arange(n) * dt
    y, column = np.cumsum(random.normal(size=n)) * 0.1 + random.normal(size=n), np.exp(-t / t[-1])
    vectors = np.column_stack([y, column])
    if law == "random_walk":
        node = evidence.walk_node(vectors, dt, 0.05)
        drift = 0.05**2 * dt * np.minimum.outer(t, t)
    else:
        node = evidence.markov_node(vectors, dt, 0.4, 30.0)
        drift = 0.4**2 * dt * np.exp(-np.abs(np.subtract.outer(t, t)) / 30.0)
    covariance, ones = drift + np.eye(n), np.ones((n, 1))
    for fitted in (ones, np.column_stack([ones, column])):
        solved = np.linalg.solve(covariance, np.column_stack([fitted, y]))
        beta = np.linalg.solve(fitted.T @ solved[:, :-1], fitted.T @ solved[:, -1])
        rest = y - fitted @ beta
        variance = float(rest @ np.linalg.solve(covariance, rest)) / (n - 1)
        expected = evidence.dense_log_likelihood(rest, variance * covariance, ones)
        found = node.log_likelihood(np.array([1.0, 0.0]), () if fitted.shape[1] == 1 else (1,))
        # The rest's own constant is nothing, so that the flat prior has the same measure.
        assert found == pytest.approx(expected, abs=1e-6)


def test_gain_of_a_column_grows_with_its_square() -> None:
    """White noise alone: A² S²/2 nats from the second power of the column, less what a walk takes of it."""
    n = 1200
    quiet = np.random.default_rng(1).normal(size=n)
    shape = np.sin(np.arange(n) * 1.7)
    gain = evidence.column_gain(quiet, shape, 1.0)
    # The variance without the column includes it: n/2 ln(1 + A²/2). 3 sd of the cross term: A·sqrt(n/2)·3.
    for amount in (0.2, 0.4):
        expected = 0.5 * n * np.log1p(0.5 * amount**2) - 0.5 * np.log(n)
        assert gain(amount) == pytest.approx(expected, abs=3.0 * amount * np.sqrt(0.5 * n))
    assert gain(0.4) > 2.5 * gain(0.2) > 0.0
    assert gain(0.0) < 2.0


def test_band_of_every_frequency_is_the_white_one() -> None:
    """White noise shared at every frequency against the dense covariance of two axes; 301 samples have no Nyquist."""
    random, n, share = np.random.default_rng(5), 301, 0.5
    common = random.normal(size=n)
    one, two = (random.normal(size=n) + share * side * common for side in (1.0, -1.0))
    own = np.full(n // 2, 1.0 + share**2)
    found = evidence.band_gain(one, two, (own, own), np.full(n // 2, share**2), -1.0)
    block, ones = np.eye(n), np.ones((n, 1))
    covariance = np.kron([[1.0 + share**2, -(share**2)], [-(share**2), 1.0 + share**2]], block)
    joint = evidence.dense_log_likelihood(np.concatenate([one, two]), covariance, np.kron(np.eye(2), ones))
    alone = sum(evidence.dense_log_likelihood(each, (1.0 + share**2) * block, ones) for each in (one, two))
    assert found == pytest.approx(joint - alone - 0.5 * np.log(n), abs=1e-8)


@pytest.mark.parametrize("rate", [1.0, 10.0])
def test_white_noise_of_the_readings_is_n(rate: float) -> None:
    """Half the mean square of differences: N² rate. Its relative sd is sqrt(3/n); 5 of them, and a drift below 1 %."""
    for seed in (1, 2, 3):
        first, _ = pair("clean", seed, rate=rate, seconds=1200.0, second=False)
        for name in physics.AXES:
            values = first.columns[f"{name}[{physics.UNITS[name[0]]}]"]
            n = first.truth["axes"][name]["n"]
            lsb = first.truth["lattice"][name] or 0.0
            ratio = 0.5 * np.mean(np.diff(values) ** 2) / (n**2 * rate * (1.0 + lsb**2 / 12.0))
            assert ratio == pytest.approx(1.0, abs=5.0 * np.sqrt(3.0 / len(values)) + 0.01)


#: The hours of its records are left to `make hidden-physics`.
QUICK = [kind for kind in KINDS if not KINDS[kind].least_seconds and not KINDS[kind].least_rate]


@pytest.mark.parametrize("kind", QUICK)
def test_size_and_the_second_record(kind: str) -> None:
    """The gain reaches what was drawn; both records share the truth and nothing else; a seed repeats itself."""
    size, seed = ("near", 7) if len(kind) % 2 else ("plain", 8)
    first, second = pair(kind, seed, size, 1.0, seconds=1200.0)
    assert second is not None
    low, high = physics.SIZES[size]
    assert low <= first.truth["wanted_nats"] <= high
    allowed = physics.TOLERANCE + 0.05 * first.truth["wanted_nats"]
    assert first.truth["nats"] == pytest.approx(first.truth["wanted_nats"], abs=allowed)
    shared = {key: value for key, value in first.truth.items() if key != "nats_here"}
    assert shared == {key: value for key, value in second.truth.items() if key != "nats_here"}
    assert set(first.columns) == set(second.columns)
    for name, values in first.columns.items():
        assert np.isfinite(values).all() and len(values) == 1200
        assert not np.array_equal(values, second.columns[name])
    # Without the effect: the same noise, other readings.
    truth = {key: value for key, value in first.truth.items() if key != "amount"}
    scene = physics._scene(truth, 1)
    plain = scene.values(first.axis)
    seen = first.columns[f"{first.axis}[{physics.UNITS[first.axis[0]]}]"]
    assert float(np.abs(seen - plain).max()) > 0.1 * float(np.std(np.diff(plain)))


@pytest.mark.parametrize("kind", ["temperature_square", "temperature_cube", "supply_square"])
def test_a_curve_is_the_same_in_both_records(kind: str) -> None:
    """A cubic through the first record's channel and effect gives the second one's, whose channel is another."""
    truth = pair(kind, 5, "plain", 1.0, seconds=1200.0, second=False)[0].truth
    curves = []
    for number in (1, 2):
        scene = physics._scene(truth, number)
        effect = KINDS[kind].make(scene, truth["parameters"]).add[scene.target]
        middle = physics.VOLTS if kind.startswith("supply") else physics.TEMPERATE
        curves.append(((scene.supply if kind.startswith("supply") else scene.temperature) - middle, effect))
    (channel, effect), (other, expected) = curves
    spread = channel.std()
    found = np.polyval(np.polyfit(channel / spread, effect, 3), other / spread)
    assert np.abs(other - channel).max() > spread
    # Rounding, where the second channel leaves the first one's range.
    assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max()


@pytest.mark.parametrize("kind", ["turn_on", "jump", "tide", "ramp"])
def test_gain_from_the_readings_alone(kind: str) -> None:
    """The readings on their lattice, with the shape by its formula, show the stated gain.

    3 nats and 6 %: a lattice of up to half a sd adds up to 2 % of variance, and rounds each reading.
    """
    first, _ = pair(kind, 11, "plain", 1.0, seconds=1500.0, second=False)
    p, t = first.truth["parameters"], first.t + 0.5 * first.truth["aperture"] / FINE
    if kind == "turn_on":
        columns, price = np.exp(-t / p["tau"]), 2.0
    elif kind == "jump":
        columns, price = (t > p["at"]).astype(float), float(np.log(1500.0))
    elif kind == "tide":
        turn = 2.0 * np.pi * t / (p["share"] * 1500.0)
        columns, price = np.column_stack([np.sin(turn), np.cos(turn)]), 3.0
    else:
        columns, price = t, 0.0
    columns = columns.reshape(len(t), -1)
    values = first.columns[f"{first.axis}[{physics.UNITS[first.axis[0]]}]"]
    gain = evidence.column_gain(values, columns[:, 0], 1.0, columns, price)(0.0)
    assert gain == pytest.approx(first.truth["nats"], abs=3.0 + 0.06 * first.truth["nats"])


def test_outcomes() -> None:
    """A name is judged with its place; a second name that is wrong is counted apart."""

    def entry(*causes: tuple[str, float, dict[str, Any]], verdict: str = "inadequate") -> dict[str, Any]:
        findings = [{"cause": cause, "evidence_gain_nats": nats, "estimate": more} for cause, nats, more in causes]
        return {"findings": findings, "verdict": verdict}

    truth = {"kind": "late_leak", "others": ["gy"], "axis": "gx", "lattice": {"gx": 0.4}}
    right = physics_suite.outcome(entry(("step", 9.0, {}), ("cross_axis", 20.0, {"other": "gy", "form": "lag"})), truth)
    assert (right["outcome"], right["form_right"], right["extra"]) == ("right", True, ["step"])
    assert physics_suite.outcome(entry(("cross_axis", 20.0, {"other": "gz"})), truth)["outcome"] == "wrong"
    assert physics_suite.outcome(entry(("cross_axis", 20.0, {"other": "gy"})), truth)["form_right"] is False
    assert physics_suite.outcome(entry(verdict="adequate"), truth)["outcome"] == "adequate"
    assert physics_suite.outcome(entry(), truth)["outcome"] == "unexplained"
    assert physics_suite.outcome(entry(("unexplained", 0.0, {})), truth)["outcome"] == "unexplained"
    assert physics_suite.outcome({"error": "no"}, truth)["outcome"] == "refused"
    # Its lattice is there: to name it is neither wrong nor the effect's name.
    assert physics_suite.outcome(entry(("quantization", 99.0, {})), truth)["outcome"] == "adequate"
    fine = truth | {"lattice": {"gx": None}}
    assert physics_suite.outcome(entry(("quantization", 99.0, {})), fine)["outcome"] == "wrong"
    accepted = physics_suite.outcome(entry(("step", 30.0, {})), fine | {"kind": "pulse", "others": []})
    assert accepted["outcome"] == "accepted"
