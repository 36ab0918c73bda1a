"""A bias that jumps between two levels: named, its amplitude and dwell times held, and no clean record shows it.

Truth: the numbers that each record was drawn with (drifts.py).
"""

from __future__ import annotations

import numpy as np
from drifts import noise, recorded

from selfcal.base.grid import Array
from selfcal.diagnosis.causes import two_level
from selfcal.likelihood.edges import scan

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
