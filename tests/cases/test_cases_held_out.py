"""The gain within one record is sequential: a right cause gains, a wrong one does not, and one that harms has no name.

Truth: the dense covariance of a short record, and the numbers that each record was drawn with, sample by sample.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from drifts import fitted, of_one
from scipy.special import logsumexp

from selfcal.diagnosis import loop, score
from selfcal.diagnosis.cause import Looks
from selfcal.diagnosis.causes import outliers
from selfcal.diagnosis.finding import Diagnosed, HeldOut
from selfcal.diagnosis.record import Record
from selfcal.likelihood import edges
from selfcal.likelihood.fit import passed
from selfcal.likelihood.state import NET_LEAST, FittedColumn, Look, State
from selfcal.likelihood.statemodel import Terms

from conftest import case_records

SAMPLES = 3000


def record_of(*states: State) -> Record:
    return Record(1.0, {one.axis: one for one in states}, {}, {}, np.ones(states[0].y.size, bool))


def nats(held_out: HeldOut) -> tuple[float, float]:
    """Gain and its sd, nats in all."""
    assert held_out.gain is not None
    found = held_out.gain["log_score_per_sample"]
    n = found["samples"]
    return n * (found["after"] - found["before"]), n * found["sd"]


def test_the_evidence_is_that_of_the_dense_covariance() -> None:
    """Of the samples between two marks, by the dense model summed over the white noise.

    Its prior of the bias is wide instead of flat, which leaves 1e-4; the filter's steady gain leaves as much."""
    random = np.random.default_rng(61)
    n, rho, size = 70, 0.3, 0.7
    y = of_one(random, n, 0.012, 300.0) + 3.0
    column = np.where(np.arange(n) < 40, 0.0, 1.0)
    state = State("gx", "deg/s", y, 1.0, 0.0, np.ones(n), (FittedColumn("c", "step", column, "1", {}),))
    marks = [30, 50, 70]
    G, D, used, _, _, _ = passed(state.series, Terms(walk=True), np.array([math.log(rho)]), marks)
    found = score._posterior(G, D, used, np.array([math.inf, size]))[0]
    t = np.arange(n)
    covariance = np.eye(n) + rho**2 * np.minimum(t[:, None], t[None, :]) + 1e4 + size**2 * np.outer(column, column)
    ln_sigma = np.linspace(-2.0, 2.0, 801)
    # The bias' prior is relative to the white noise: flat, it has one power of sigma less.
    dense = [
        logsumexp(
            -(m - 1) * ln_sigma
            - 0.5 * (y[:m] @ np.linalg.solve(covariance[:m, :m], y[:m])) * np.exp(-2.0 * ln_sigma)
            - 0.5 * np.linalg.slogdet(2.0 * math.pi * covariance[:m, :m])[1]
        )
        for m in marks
    ]
    assert np.diff(found) == pytest.approx(np.diff(dense), abs=1e-3)


@pytest.mark.parametrize("late", [False, True])
def test_a_right_step_gains_and_a_false_one_does_not(late: bool) -> None:
    """A step of some 60 nats gains wherever it lies, and so much the more where it is scored itself.

    The best place of a record without a step gains nothing on average: what the column fits by chance, its prior and
    the price of the place have paid."""
    random = np.random.default_rng([62, late])
    records, right, false = case_records(12, 100), [], []
    for _ in range(records):
        y = of_one(random, SAMPLES, 0.012, 300.0)
        place = round(SAMPLES * (random.uniform(0.6, 0.9) if late else random.uniform(0.1, 0.4)))
        for size, gains in ((2.5, right), (0.0, false)):
            state = fitted(y + size * edges.raised(SAMPLES, place))
            record = record_of(state)
            scan = edges.scan(state.series, state.best)
            inside = np.arange(SAMPLES) >= SAMPLES // 2
            at = int(np.argmax(np.where(inside == late, scan.gain, 0.0)))
            column = FittedColumn("step", "step", edges.raised(SAMPLES, at), "1", {"kind": "step", "time_s": float(at)})
            gain = state.with_columns(column.values)[0]
            look = Look("step", gain, scan.worth(gain), {}, {"regressors": (column,)}, when=(float(at), float(at)))
            gains.append(nats(score.gain(look, state, state.refit(**look.changes), record)))
    print(f"step, late {late}: {np.mean(right, axis=0)} right, {np.mean(false, axis=0)} false, of {records}")
    assert sum(gain > 0.0 for gain, _ in right) >= records - max(1, records // 20)
    assert np.mean([gain for gain, _ in right]) > (25.0 if late else 4.0)
    false_gains = np.array([gain for gain, _ in false])
    assert false_gains.mean() < 2.6 * false_gains.std() / math.sqrt(records)


def test_samples_that_one_model_leaves_out_are_scored_by_neither() -> None:
    """Wild samples are drawn so large that one of them alone would decide the score."""
    random = np.random.default_rng(63)
    y = of_one(random, SAMPLES, 0.012, 300.0)
    y[random.choice(SAMPLES, 12, replace=False)] += 300.0
    state = fitted(y)
    kept = np.where(np.abs(y) > 100.0, np.nan, y)
    look = Look("outliers", 1e3, 1e3, {}, {"y": kept})
    held_out = score.gain(look, state, state.refit(y=kept), record_of(state))
    assert held_out.gain is not None
    found = held_out.gain["log_score_per_sample"]
    assert found["samples"] == np.isfinite(kept[SAMPLES // 2 :]).sum()
    # Without them the rest is white noise of 1: -ln(2 pi e) / 2 and a little for the drift.
    assert found["after"] == pytest.approx(-0.5 * math.log(2.0 * math.pi * math.e), abs=0.06)
    assert found["before"] < found["after"] - 0.5


@pytest.mark.parametrize("constant", [True, False])
def test_what_harms_has_no_name(constant: bool) -> None:
    """gx follows another axis with 0.15 throughout; or with 0.4 at first and with -0.1 in the second half.

    The mean coefficient is the same, and with it the evidence, 34 nats. But 0.4 foretells the second half worse than
    nothing does, by 0.12 nats a sample until it is unlearnt."""
    random = np.random.default_rng([64, constant])
    records, named = case_records(2, 40), 0
    for _ in range(records):
        other = of_one(random, SAMPLES, 0.012, 300.0)
        size = np.where(np.arange(SAMPLES) < SAMPLES // 2, 0.4, -0.1)
        y = of_one(random, SAMPLES, 0.012, 300.0) + (0.15 if constant else size) * (other - other.mean())
        states = {
            name: State(name, "deg/s", values - values.mean(), 1.0, 0.0, np.ones(SAMPLES))
            for name, values in (("gx", y), ("gy", other))
        }
        found = loop.diagnose_record(record_of(*states.values()), ["gx"])["gx"]
        named += any(one.look.cause == "cross_axis" for one in found.findings)
        if not constant:
            assert not found.adequate
        for one in found.findings:
            assert one.held_out is None or not one.held_out.harms
    assert named == records if constant else named == 0


@pytest.mark.parametrize("kind", ["wild readings", "jumps of the drift", "nothing"])
def test_a_jump_of_the_drift_is_no_outlier(kind: str) -> None:
    """Eight innovations of 4 to 8 sd, in either kind. Behind a wild reading the record is as it was before, behind a
    jump it is not: left out, a jump spoils what follows by some nats each, and no outlier is named for it."""
    records, named = case_records(6, 100), 0
    for seed in range(records):
        random = np.random.default_rng([66, seed])
        y = of_one(random, SAMPLES, 0.05, 300.0)
        sizes = random.choice([-1.0, 1.0], 8) * random.uniform(5.0, 8.0, 8)
        places = random.choice(np.arange(20, SAMPLES - 20), 8, replace=False)
        if kind == "wild readings":
            y[places] += sizes
        elif kind == "jumps of the drift":
            y += (sizes[:, None] * (np.arange(SAMPLES) >= places[:, None])).sum(axis=0)
        state = fitted(y)
        named += any(look.net >= NET_LEAST for look in outliers.looks(state, record_of(state)))
    print(f"{kind}: {named} of {records} named")
    assert named == records if kind == "wild readings" else named <= records // 100


def test_after_a_look_that_harms_the_next_one_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """The state is as it was, so no cause is looked at again before a look is taken."""
    state = fitted(np.random.default_rng(65).normal(size=400))
    record = record_of(state)
    looked: list[str] = []

    def looks_of(cause: str, net: float) -> Looks:
        def looks(one: State, _: Record) -> list[Look]:
            looked.append(cause)
            return [Look(cause, net, net, {}, {"level": one.level})] if len(looked) <= 3 else []

        return looks

    known = {"step": True, "pulse": True, "ramp": False}
    causes = tuple(looks_of(cause, 50.0 - k) for k, cause in enumerate(known))
    monkeypatch.setattr(score, "gain", lambda look, *_: SimpleNamespace(harms=known[look.cause]))
    one = Diagnosed(state, state, record)
    monkeypatch.setattr(loop, "LOOKS", causes)
    loop._rounds(record, one, lambda _: None, loop.LOOKS)
    assert [finding.look.cause for finding in one.findings] == ["ramp"]
    assert [look.cause for look in one.harmful] == ["step", "pulse"]
    assert looked == [*known, *known]  # a round that takes one, and one that finds no more
