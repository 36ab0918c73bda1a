"""A bias that jumps between two levels: named, its amplitude and dwell times held, and no clean record shows it.

Truth: the numbers that each record was drawn with (drifts.py).
"""

from __future__ import annotations

import numpy as np
import pytest
from drifts import LAWS, assert_held, clean_ones_named, noise, recorded
from scipy.stats import binom

from selfcal.diagnosis.causes import two_level
from selfcal.diagnosis.causes.step import scan
from selfcal.diagnosis.loop import diagnose_record
from selfcal.likelihood.statemodel import Array

from conftest import case_records

#: Amplitude, and mean times at the lower and the upper level, s.
AMPLITUDE, LOW_S, HIGH_S = 0.12, 120.0, 240.0


def jumps(random: np.random.Generator, n: int, rate: float, low_s: float = LOW_S, high_s: float = HIGH_S) -> Array:
    """[n]: one of two levels, each for an exponential time."""
    level, upper, at = np.empty(n), bool(random.integers(2)), 0.0
    while at < n:
        level[int(at) :] = 0.5 * AMPLITUDE * (1.0 if upper else -1.0)
        at += rate * random.exponential(high_s if upper else low_s)
        upper = not upper
    return level


@pytest.mark.parametrize("law", LAWS)
def test_popcorn_noise_is_named_first(law: str) -> None:
    """9 of 10; some 100 to 200 nats."""
    random = np.random.default_rng([441, LAWS.index(law)])
    right = total = 0
    for _ in range(case_records(1, 40)):
        y = noise(random, law, 3600, 1.0) + jumps(random, 3600, 1.0)
        one = diagnose_record(recorded(y, 1.0)[1], ["gx"])["gx"]
        total += 1
        right += [finding.look.cause for finding in one.findings][:1] == ["two_level"]
    print(f"two_level, {law}: {right} of {total}")
    assert binom.cdf(right, total, 0.9) > 1e-3


def test_jumps_that_hide_in_a_correlation_are_looked_for() -> None:
    """Jumps every minute leave no single one to see: of these records a scan for a step shows less than a look needs.
    The likelihood of the levels is still above a Gauss-Markov drift's by 30 nats and more."""
    seen = 0
    for seed in range(4, 60):
        random = np.random.default_rng([446, seed])
        y = noise(random, "walk", 3600, 1.0) + 0.6 * jumps(random, 3600, 1.0, 50.0, 70.0)
        state, record = recorded(y, 1.0)
        if scan(state.series, state.best).gain.max() >= two_level.SCREEN + 2.0:
            continue
        seen += 1
        assert two_level.looks(state, record), seed
        if seen == case_records(1, 3):
            break
    assert seen


def test_amplitude_and_dwell_times_lie_in_their_intervals() -> None:
    """90 %, the lower tail of the binomial not below 1 in 1000."""
    random = np.random.default_rng(442)
    truth = {"amplitude": AMPLITUDE, "dwell_low_s": LOW_S, "dwell_high_s": HIGH_S}
    held: dict[str, list[bool]] = {key: [] for key in truth}
    for _ in range(case_records(2, 100)):
        y = noise(random, "walk", 3600, 1.0) + jumps(random, 3600, 1.0)
        state, record = recorded(y, 1.0)
        look = two_level.looks(state, record)[0]
        look = look.measured(state.refit(**look.changes))
        for key, value in truth.items():
            held[key].append(look.estimate[key]["q05"] <= value <= look.estimate[key]["q95"])
    assert_held(held, "walk")


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(("rate", "seconds"), [(1.0, 3600.0), (1.0, 1200.0), (10.0, 1200.0)])
def test_a_clean_record_shows_none(law: str, rate: float, seconds: float) -> None:
    """1 of 200 at most; of so many more than 4 have a chance of 1 in 300."""
    named, count = clean_ones_named(two_level.looks, 444, law, rate, seconds)
    assert named <= (4 if count >= 200 else 1)
