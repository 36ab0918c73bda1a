"""Estimates beside gaps: a step, a change of the noise and a line hold the truth as often as their intervals state.

A unit that is picked up leaves a gap with the step in it. Truth: the numbers that each record was drawn with.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

from selfcal.diagnosis.causes import step
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import Look, State
from selfcal.diagnosis.statemodel import Array

from conftest import case_records

#: Rates, Hz, and gaps, s, of the records of each kind, and their samples beside the gap.
GRID = [(rate, gap) for rate in (1.0, 10.0, 100.0) for gap in (1.0, 10.0, 100.0)]
SAMPLES = {1.0: 2000, 10.0: 5000, 100.0: 20000}


def drawn(random: np.random.Generator, rate: float, gap_s: float) -> tuple[Array, Array, int, int, float]:
    """White noise of 1 unit a sample beside a walk, its time, the first sample of a gap in its middle and the first
    behind it, and the size of a step that no such record hides."""
    gap = round(gap_s * rate)
    n = SAMPLES[rate] + gap
    walk = math.exp(random.uniform(-4.5, -2.5))
    y = random.standard_normal(n) + walk * random.standard_normal(n).cumsum()
    begin = round(random.uniform(0.3, 0.7) * SAMPLES[rate])
    size = math.exp(random.uniform(0.0, 3.0)) * 8.0 * (math.sqrt(walk) + walk * math.sqrt(gap))
    return (
        np.arange(n) / rate,
        y,
        begin,
        begin + gap,
        float(random.choice([-1.0, 1.0])) * size,
    )


def looked(y: Array, rate: float, cause: Any) -> Look | None:
    state = State("gx", "deg/s", y, 1.0 / rate, 0.0, np.ones(y.size)).refit()
    record = Record(rate, {"gx": state}, {}, {}, np.isfinite(y), recorded_hz=rate)
    return next(iter(cause(state, record)), None)


def holds(estimate: dict[str, float], truth: float) -> bool:
    return estimate["q05"] <= truth <= estimate["q95"]


def judge(name: str, held: list[bool]) -> None:
    """90 % as the interval states: neither tail of the binomial below 1 in 1000."""
    found, of = sum(held), len(held)
    print(f"{name}: {found} of {of} in the 90 % interval")
    assert binom.cdf(found, of, 0.9) > 1e-3, name
    assert binom.sf(found - 1, of, 0.9) > 1e-3, name


@pytest.mark.parametrize("place", ["in the gap", "before", "after"])
def test_a_step_beside_a_gap(place: str) -> None:
    random = np.random.default_rng(391 + len(place))
    times: list[bool] = []
    sizes: list[bool] = []
    for k in range(case_records(9, 180)):
        rate, gap = GRID[k % len(GRID)]
        t, y, begin, end, size = drawn(random, rate, gap)
        away = float(random.uniform(0.0, 60.0))
        time = {
            "in the gap": random.uniform(t[begin - 1], t[end]),
            "before": t[begin] - away / rate,
            "after": t[end] + away / rate,
        }[place]
        y[t >= time] += size
        y[begin:end] = np.nan
        look = looked(y, rate, step.looks)
        assert look is not None
        times.append(holds(look.estimate["time_s"], time))
        sizes.append(holds(look.estimate["amplitude"], size))
    judge(f"amplitude of a step {place}", sizes)
    print(f"time of a step {place}: {sum(times)} of {len(times)}")
    # A step far above the noise lies between two readings: its interval is a normal's and holds 95 % of these.
    assert binom.cdf(sum(times), len(times), 0.9) > 1e-3
