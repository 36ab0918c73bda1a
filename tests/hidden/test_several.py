"""The third generator of hidden effects (tests/hidden/several.py): its expected nats, its records and its verdicts.

Nothing of the detector runs here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import several
import several_suite
from evidence import Array, dense_log_likelihood
from physics import AXES, UNITS, Axis
from several import ALL, COLUMNS, EACH, KINDS, TOGETHER, draw
from several_suite import Event, events, verdict

#: Kinds whose effect is a column on single axes.
SINGLE = [*COLUMNS, "tilt"]
#: s: a dense covariance is small.
SHORT = 420


def covariance(axis: Axis, n: int) -> Array:
    """[n, n] of drift and white noise, every second; a walk begins at nothing. Written out, not taken from several."""
    t = np.arange(n, dtype=float)
    if axis.law == "random_walk":
        drift = axis.size**2 * np.minimum.outer(t, t)
    else:
        drift = axis.size**2 * np.exp(-np.abs(np.subtract.outer(t, t)) / axis.tau)
    return np.asarray(drift + axis.n**2 * np.eye(n))


@pytest.mark.parametrize("kind", SINGLE)
def test_expected_nats_are_those_of_a_dense_likelihood(kind: str) -> None:
    """b² x'Px / 2 by another way: rounding alone, 1e-5 of it."""
    record = draw(kind, 11, SHORT)
    (piece,) = record.pieces
    assert set(piece.nats) <= set(record.added)
    for name, nats in piece.nats.items():
        x, whole = record.added[name], covariance(record.axes[name], SHORT)
        ones = np.ones(SHORT)
        solved = np.linalg.solve(whole, np.column_stack([x, ones]))
        there = x @ solved[:, 0] - (x @ solved[:, 1]) ** 2 / (ones @ solved[:, 1])
        assert 0.5 * there == pytest.approx(nats, rel=1e-5, abs=1e-9)


def test_realised_nats_are_the_expected_ones_in_the_mean() -> None:
    """Truth: ln likelihood of the records themselves with and without their effects, by dense covariances.

    Each has a variance of twice its mean, and axes are independent. Limit: 3.3 sd of the sum, once in 1000 runs.
    """
    surplus, power = 0.0, 0.0
    for kind in SINGLE:
        for seed in range(20, 22):
            record = draw(kind, seed, SHORT)
            for name, nats in record.pieces[0].nats.items():
                y = record.columns[f"{name}[{UNITS[name[0]]}]"] - record.axes[name].offset
                whole, ones = covariance(record.axes[name], SHORT), np.ones((SHORT, 1))
                without = dense_log_likelihood(y, whole, ones)
                surplus += dense_log_likelihood(y - record.added[name], whole, ones) - without - nats
                power += 2.0 * nats
    assert abs(surplus) < 3.3 * np.sqrt(power)


def module(seed: int, count: int) -> tuple[list[Axis], Array]:
    """Axes with their own walks, and their loadings on f."""
    random = np.random.default_rng(seed)
    n = np.exp(random.uniform(-1.0, 1.0, count))
    kicks, shares = n * np.exp(random.uniform(np.log(0.03), np.log(0.1), count)), random.uniform(0.3, 0.7, count)
    own = [
        Axis(float(a), "random_walk", float(k), 1.0, 0.0) for a, k in zip(n, kicks * np.sqrt(1 - shares), strict=True)
    ]
    return own, kicks * np.sqrt(shares)


def increments(own: list[Axis], loadings: Array, n: int) -> tuple[list[Array], Array]:
    """Covariances [n - 1, n - 1] of each axis' increments, and the joint one of all."""
    m = n - 1
    second = 2.0 * np.eye(m) - np.eye(m, k=1) - np.eye(m, k=-1)
    each = [
        axis.n**2 * second + (axis.size**2 + loading**2) * np.eye(m)
        for axis, loading in zip(own, loadings, strict=True)
    ]
    joint = np.kron(np.outer(loadings, loadings), np.eye(m))
    for k, one in enumerate(each):
        joint[k * m : (k + 1) * m, k * m : (k + 1) * m] = one
    return each, joint


def dense_gain(own: list[Axis], loadings: Array, n: int) -> float:
    each, joint = increments(own, loadings, n)
    return 0.5 * float(sum(np.linalg.slogdet(one)[1] for one in each) - np.linalg.slogdet(joint)[1])


@pytest.mark.parametrize("count", [3, 5])
def test_gain_of_a_hidden_quantity_by_a_dense_covariance(count: int) -> None:
    """Between 200 and 400 s, where the ends of the record drop out: 1 % is left. The ends are worth a nat."""
    own, loadings = module(count, count)
    dense = [dense_gain(own, loadings, n) for n in (200, 400)]
    spectral = [several.hidden_gain(own, loadings, n) for n in (200, 400)]
    assert spectral[1] - spectral[0] == pytest.approx(dense[1] - dense[0], rel=0.01)
    assert spectral[1] == pytest.approx(dense[1], abs=1.0)


def test_realised_gain_of_a_hidden_quantity() -> None:
    """Truth: 200 draws of walks and f, ln likelihood of their increments. Tolerance: 3.3 sd of the mean, and a nat."""
    own, loadings = module(8, 3)
    n, random = 200, np.random.default_rng(4)
    each, joint = increments(own, loadings, n)
    inverse, alone = np.linalg.inv(joint), [np.linalg.inv(one) for one in each]
    constant = dense_gain(own, loadings, n)
    gains = []
    for _ in range(200):
        f = np.cumsum(random.normal(size=n))
        y = [
            axis.n * random.normal(size=n) + np.cumsum(axis.size * random.normal(size=n)) + loading * f
            for axis, loading in zip(own, loadings, strict=True)
        ]
        d = [np.diff(values) for values in y]
        whole = np.concatenate(d)
        single = sum(float(one @ inner @ one) for one, inner in zip(d, alone, strict=True))
        gains.append(constant + 0.5 * (single - float(whole @ inverse @ whole)))
    error = float(np.std(gains)) / np.sqrt(len(gains))
    assert abs(np.mean(gains) - several.hidden_gain(own, loadings, n)) < 3.3 * error + 1.0


@pytest.mark.parametrize("count", [3, 6])
def test_nats_of_a_jump_by_a_dense_covariance(count: int) -> None:
    """A jump in the middle of 400 s. Its reach is N/K, some 30 s: of the ends 1 % is left."""
    own, loadings = module(count + 20, count)
    n = 400
    _, joint = increments(own, loadings, n)
    kick = np.zeros((count, n - 1))
    kick[:, n // 2] = loadings
    there = float(kick.ravel() @ np.linalg.solve(joint, kick.ravel()))
    assert several.jump_information(own, loadings, n) == pytest.approx(there, rel=0.01)


def test_sizes_are_as_wanted() -> None:
    for seed in range(200):
        random = np.random.default_rng(seed)
        count = 2 + seed % 5
        nats = several.wanted(random, count)
        assert EACH[0] - 1e-9 <= nats.min() and nats.max() <= EACH[1] + 1e-9
        assert TOGETHER[0] - 1e-9 <= nats.sum() <= TOGETHER[1] + 1e-9


def test_twelve_kinds_and_their_records() -> None:
    """Every kind at full length. f has its least gain and its share; the same seed is the same record."""
    assert len(KINDS) == 12
    for kind in ALL:
        record = draw(kind, 5)
        assert [len(values) for values in record.columns.values()] == [several.SECONDS] * 8
        for piece in record.pieces:
            assert piece.optional or piece.together >= several.LEAST - 1e-9
            if piece.names == ("hidden_input",):
                assert len(piece.nats) >= 3
                for name, share in piece.more["shares"].items():
                    own, loading = record.axes[name].size, piece.more["loadings"][name]
                    assert share == pytest.approx(loading**2 / (own**2 + loading**2))
                    assert several.SHARE[0] <= share <= several.SHARE[1]
    same, other = draw("two", 5), draw("two", 6)
    assert all(np.array_equal(values, draw("two", 5).columns[name]) for name, values in same.columns.items())
    assert not np.array_equal(same.columns["gx[deg/s]"], other.columns["gx[deg/s]"])


@pytest.mark.parametrize("seed", range(6))
def test_a_tilt_is_a_turn(seed: int) -> None:
    """Gravity of 9.8 m/s² turned by the gyros' integrated rate is the accelerometers' change.

    The change is taken between 30 s before and after; the turn ends within 10 time constants. Second order: 1e-3 of it.
    """
    record = draw("tilt", seed)
    gravity = np.array([record.axes[name].offset for name in ("ax", "ay", "az")])
    assert np.linalg.norm(gravity) == pytest.approx(9.8)
    angle = np.radians([record.added[name].sum() for name in ("gx", "gy", "gz")])
    at = int(record.pieces[0].theta["time_s"])
    change = np.array([record.added[name][at + 30] - record.added[name][at - 30] for name in ("ax", "ay", "az")])
    assert np.cross(gravity, angle) == pytest.approx(change, abs=1e-3 * float(np.linalg.norm(change)))


# ---------------------------------------------------------------------------------------------------------- the judge


def finding(cause: str, shared: str = "", **estimate: Any) -> dict[str, Any]:
    return {"cause": cause, "estimate": estimate, "shared_with": shared.split(), "evidence_gain_nats": 9.0}


def document(top: list[dict[str, Any]] | None = None, **axes: list[dict[str, Any]]) -> dict[str, Any]:
    return {"findings": top or [], "axes": {name: {"findings": axes.get(name, [])} for name in AXES}}


def at(time: float) -> dict[str, float]:
    return {"median": time, "q05": time - 1.0, "q95": time + 1.0}


STEP = {
    "names": ["step"],
    "nats": {"gx": 9.0, "gy": 8.0, "gz": 7.0, "ax": 5.0},
    "theta": {"time_s": 500.0},
    "optional": False,
}


def judged(found: dict[str, Any], *pieces: dict[str, Any]) -> tuple[str, int]:
    result = verdict(pieces or (STEP,), events(found, 10_800.0), 10_800.0)
    return result["outcome"], result["longer"]


def test_findings_of_one_shape_are_one_event() -> None:
    joined = document(
        gx=[finding("step", "gy gz", time_s=at(498.0))],
        gy=[finding("step", "gx gz", time_s=at(504.0))],
        gz=[finding("step", "gx gy", time_s=at(900.0))],
        ax=[finding("step", "", time_s=at(498.0))],
    )
    found = [sorted(event.axes) for event in events(joined, 10_800.0)]
    assert sorted(found) == [["ax"], ["gx", "gy"], ["gz"]]


def test_noise_that_a_pair_shares_is_one_event() -> None:
    """Both axes show it. Another pair is another event, and a leak has a direction."""
    pairs = {"gx": "gy", "gy": "gx", "az": "gx"}
    for cause, count in (("shared", 2), ("cross_axis", 3)):
        found = document(**{name: [finding(cause, "", other=other)] for name, other in pairs.items()})
        assert len(events(found, 10_800.0)) == count


def test_finding_of_the_module_is_one_event() -> None:
    """Axes by their probability; a finding of an axis that belongs to it is no further event."""
    axes = {
        "gx": {"probability": 0.9},
        "gy": {"probability": 0.6},
        "gz": {"probability": 0.8},
        "az": {"probability": 0.2},
    }
    top = [{"id": "s1", "cause": "step", "estimate": {"time_s": 507.0}, "axes": axes, "evidence_nats": 24.0}]
    found = document(top, gx=[{**finding("step", "gy", time_s=at(507.0)), "of": "s1"}])
    (event,) = events(found, 10_800.0)
    assert event.axes == {"gx", "gy", "gz"}
    assert judged(found) == ("named", 0)


def test_verdicts() -> None:
    """Weak axes count neither way; each way to be wrong has its name."""

    def three(time: float, axes: str, cause: str = "step") -> dict[str, Any]:
        return document(**{name: [finding(cause, axes, time_s=at(time))] for name in axes.split()})

    assert judged(three(509.0, "gx gy gz")) == ("named", 0)
    assert judged(three(509.0, "gx gy gz ax")) == ("named", 0)
    assert judged(three(509.0, "gx gy gz az")) == ("named", 0)  # 3 of 4
    assert judged(three(509.0, "gx gy")) == ("wrong axes", 0)  # 2 of 3
    assert judged(three(511.0, "gx gy gz")) == ("wrong shape", 0)
    assert judged(three(509.0, "gx gy gz", "pulse")) == ("wrong cause", 0)
    assert judged(three(509.0, "az", "pulse")) == ("missed", 0)
    assert judged(document()) == ("missed", -1)
    alone = document(**{name: [finding("step", "", time_s=at(500.0))] for name in ("gx", "gy", "gz")})
    assert judged(alone) == ("wrong axes", 2)


def test_shapes_that_agree() -> None:
    close = several_suite.close
    assert close("frequency_hz", 0.2, 0.2 + 0.9 / 10_800.0, 10_800.0)
    assert not close("frequency_hz", 0.2, 0.2 + 1.1 / 10_800.0, 10_800.0)
    for key in ("lag_s", "tau_s", "duration_s"):
        assert close(key, 100.0, 195.0, 10_800.0) and close(key, 100.0, 51.0, 10_800.0)
        assert not close(key, 100.0, 205.0, 10_800.0) and not close(key, 100.0, 49.0, 10_800.0)


def test_jumps_of_f_may_be_events_of_their_own() -> None:
    nats = dict.fromkeys(("gx", "gy", "ax", "ay"), 20.0)
    f = {"names": ["hidden_input"], "nats": nats, "theta": {"jumps": [500.0, 4000.0]}, "optional": False}
    jumps = [{"names": ["step"], "nats": nats, "theta": {"time_s": time}, "optional": True} for time in (500.0, 4000.0)]

    def answer(*listed: float) -> list[dict[str, Any]]:
        axes = {name: {"estimate": {"loading": 1.0}} for name in nats}
        told = [{"time_s": time, "size": 3.0} for time in listed]
        return [{"cause": "hidden_input", "estimate": {"jumps": told}, "axes": axes, "evidence_nats": 90.0}]

    step = {name: [finding("step", "gx gy ax", time_s=at(4003.0))] for name in ("gx", "gy", "ax")}
    assert judged(document(answer(505.0, 3998.0)), f, *jumps) == ("named", 0)
    assert judged(document(answer(505.0), **step), f, *jumps) == ("named", 0)
    assert judged(document(answer(505.0)), f, *jumps) == ("wrong shape", 0)
    alone = {"gx": [finding("step", "", time_s=at(4003.0))]}
    assert judged(document(answer(505.0, 3998.0), **alone), f, *jumps) == ("named", 1)


def test_event_is_counted_once() -> None:
    """Two causes of one word need two events."""
    other = {**STEP, "theta": {"time_s": 900.0}}
    axes = ("gx", "gy", "gz")
    one = document(**{name: [finding("step", " ".join(axes), time_s=at(500.0))] for name in axes})
    assert judged(one, STEP, other) == ("missed", -1)
    assert str(Event("step", {"time_s": 500.0}, {"gx"}, 9.0)) == "step[gx] time_s=500 (9)"
