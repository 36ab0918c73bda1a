"""A lamp that is switched on and off: one pulse, named as one, and no clean record shows one.

Truth: the numbers that each record was drawn with (drifts.py).
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from drifts import LAWS, assert_held, clean_ones_named, noise, recorded
from scipy.stats import binom

from selfcal.diagnosis.causes import pulse
from selfcal.diagnosis.loop import diagnose_record
from selfcal.likelihood.statemodel import Array

from conftest import case_records

SECONDS = 2400.0


def drawn(random: np.random.Generator, rate: float) -> tuple[Array, float, float, float]:
    """A pulse [n] of some 40 to 100 nats net of its search, its start, length and amplitude."""
    t = np.arange(round(SECONDS * rate)) / rate
    length = math.exp(random.uniform(math.log(40.0), math.log(400.0)))
    start = random.uniform(150.0, SECONDS - length - 150.0)
    amplitude = float(random.choice([-1.0, 1.0])) * 0.12 * (100.0 / length) ** 0.3 * random.uniform(1.0, 1.4)
    return np.where((t >= start) & (t < start + length), amplitude, 0.0), start, length, amplitude


@pytest.mark.parametrize(
    ("law", "rate"), [("walk", 1.0), ("markov", 1.0), ("walk", 10.0), ("markov", 10.0)][: case_records(2, 4)]
)
def test_a_plain_pulse_is_named_first_and_alone(law: str, rate: float) -> None:
    """9 of 10; no step is left of it."""
    random = np.random.default_rng([431, round(rate), LAWS.index(law)])
    right = total = 0
    for _ in range(case_records(1, 40)):
        shape, *_ = drawn(random, rate)
        _, record = recorded(noise(random, law, shape.size, rate) + shape, rate)
        one = diagnose_record(record, ["gx"])["gx"]
        total += 1
        right += [finding.look.cause for finding in one.findings] == ["pulse"]
    print(f"pulse, {law}, {rate:g} Hz: {right} of {total}")
    assert binom.cdf(right, total, 0.9) > 1e-3


@pytest.mark.parametrize("law", LAWS)
def test_times_and_amplitude_lie_in_their_intervals(law: str) -> None:
    """90 %, the lower tail of the binomial not below 1 in 1000. A time between two readings has the normal's interval
    of a uniform, which holds 95 %."""
    random = np.random.default_rng([432, LAWS.index(law)])
    held: dict[str, list[bool]] = {"time_s": [], "duration_s": [], "amplitude": []}
    for _ in range(case_records(6, 200)):
        shape, *truth = drawn(random, 1.0)
        state, record = recorded(noise(random, law, shape.size, 1.0) + shape, 1.0)
        found = [look.measured(state) for look in pulse.looks(state, record)]
        for (key, each), value in zip(held.items(), truth, strict=True):
            each.append(bool(found) and found[0].estimate[key]["q05"] <= value <= found[0].estimate[key]["q95"])
    assert_held(held, law)
    assert binom.sf(sum(held["amplitude"]) - 1, len(held["amplitude"]), 0.9) > 1e-3


def test_two_steps_of_unlike_sizes_are_no_pulse() -> None:
    random = np.random.default_rng(433)
    t = np.arange(SECONDS)
    for _ in range(case_records(1, 40)):
        y = noise(random, "walk", t.size, 1.0) + 0.3 * (t >= 800.0) - 0.12 * (t >= 1500.0)
        one = diagnose_record(recorded(y, 1.0)[1], ["gx"])["gx"]
        assert "pulse" not in [finding.look.cause for finding in one.findings]
        assert [finding.look.cause for finding in one.findings][:1] == ["step"]


def test_a_pulse_that_no_drift_can_judge_has_the_fit_as_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each drift forgets too fast to know either place: the estimate is the fit's."""
    random = np.random.default_rng(435)
    shape, start, length, _ = drawn(random, 1.0)
    state, record = recorded(noise(random, "walk", shape.size, 1.0) + shape, 1.0)
    begin, end = math.ceil(start), math.ceil(start + length)
    _, fit = state.with_columns((np.arange(shape.size) >= begin) * 1.0 - (np.arange(shape.size) >= end))
    none = pulse.Pulses(np.zeros(shape.size), np.zeros(shape.size), 0.0)
    monkeypatch.setattr(pulse, "_other", lambda *_, **__: none)
    found = pulse.posterior(record.time_s, begin, end, state)
    assert found["amplitude"]["mean"] == pytest.approx(fit.c[-1])
    assert found["duration_s"]["mean"] == pytest.approx(end - begin)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(("rate", "seconds"), [(1.0, 3600.0), (1.0, 1200.0), (10.0, 1200.0)])
def test_a_clean_record_shows_none(law: str, rate: float, seconds: float) -> None:
    """1 of 200 at most; of so many more than 4 have a chance of 1 in 300."""
    named, count = clean_ones_named(pulse.looks, 434, law, rate, seconds)
    assert named <= (4 if count >= 200 else 1)
