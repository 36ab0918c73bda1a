"""Estimates beside gaps: a step, a change of the noise and a line hold the truth as often as their intervals state.

A unit that is picked up leaves a gap with the step in it. Truth: the numbers that each record was drawn with.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

from selfcal.base.grid import Array
from selfcal.diagnosis.causes import periodic, step, variance_change
from selfcal.diagnosis.record import Record
from selfcal.likelihood import edges
from selfcal.likelihood.fit import Series, fit_at, run
from selfcal.likelihood.state import Look, State
from selfcal.likelihood.statemodel import Terms
from selfcal.verbs.diagnose import diagnose

from conftest import case_records, shared_case

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
    return next((look.measured(state) for look in cause(state, record)), None)


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


@pytest.mark.parametrize(("samples", "gap"), [(2400, 0), (1200, 40), (1800, 90)])
def test_the_size_of_a_step_beside_a_weak_walk(samples: int, gap: int) -> None:
    """A walk of about 0.01 of the noise a sample, which the record hardly tells from none. Truth: the step's size."""
    random = np.random.default_rng([398, gap])
    sizes: list[bool] = []
    n = samples + gap
    for _ in range(case_records(12, 150)):
        walk = 0.01 * math.exp(random.uniform(-0.4, 0.4))
        y = random.standard_normal(n) + walk * random.standard_normal(n).cumsum()
        begin = round(random.uniform(0.3, 0.7) * samples)
        spread = math.sqrt(walk * (2.0 + walk * gap))
        size = float(random.choice([-4.0, 4.0])) * math.exp(random.uniform(0.0, 1.0)) * spread
        y[begin + gap :] += size
        y[begin : begin + gap] = np.nan
        look = looked(y, 1.0, step.looks)
        if look is not None:  # the smallest do not stand out
            sizes.append(holds(look.estimate["amplitude"], size))
    judge(f"amplitude beside a weak walk, gap {gap}", sizes)


@pytest.mark.parametrize("place", ["in the gap", "before", "after"])
def test_a_change_of_the_noise_beside_a_gap(place: str) -> None:
    random = np.random.default_rng(396 + len(place))
    times: list[bool] = []
    ratios: list[bool] = []
    for k in range(case_records(9, 180)):
        rate, gap = GRID[k % len(GRID)]
        t, y, begin, end, _ = drawn(random, rate, gap)
        between = float(random.random())  # two readings: at one of them the truth would be the end of an interval
        time = {
            "in the gap": random.uniform(t[begin - 1], t[end]),
            "before": t[begin] - (50.0 + between) / rate,
            "after": t[end] + (50.0 - between) / rate,
        }[place]
        ratio = float(random.choice([0.6, 0.75, 1.3, 1.7]))
        white = random.standard_normal(t.size) * np.where(t >= time, ratio, 1.0)
        y = white + math.exp(random.uniform(-4.5, -2.5)) * random.standard_normal(t.size).cumsum()
        y[begin:end] = np.nan
        look = looked(y, rate, variance_change.looks)
        assert look is not None
        times.append(holds(look.estimate["time_s"], time))
        ratios.append(holds(look.estimate["ratio"], ratio))
    judge(f"ratio of a change {place}", ratios)
    print(f"time of a change {place}: {sum(times)} of {len(times)}")
    assert binom.cdf(sum(times), len(times), 0.9) > 1e-3


def test_a_line_across_a_gap() -> None:
    """25 to 150 nats; the gap turns the phase by many turns."""
    random = np.random.default_rng(397)
    sizes: list[bool] = []
    frequencies: list[bool] = []
    for k in range(case_records(9, 180)):
        rate, gap = GRID[k % len(GRID)]
        t, y, begin, end, _ = drawn(random, rate, gap)
        frequency = float(random.uniform(0.02, 0.45)) * rate
        size = math.sqrt(4.0 * random.uniform(25.0, 150.0) / SAMPLES[rate])
        y += size * np.sin(2.0 * math.pi * frequency * t + random.uniform(0.0, 6.28))
        y[begin:end] = np.nan
        look = looked(y, rate, periodic.looks)
        assert look is not None
        sizes.append(holds(look.estimate["amplitude"], size))
        frequencies.append(holds(look.estimate["frequency_hz"], frequency))
    judge("amplitude of a line across a gap", sizes)
    judge("frequency of a line across a gap", frequencies)


def test_the_scan_is_the_fit_at_every_place() -> None:
    """Score and information of a step by the backward pass against a fit with its column: at the ends of a gap and in
    it, where the noise changes, at the start. Both are sums of the same products: 1e-9."""
    random = np.random.default_rng(3)
    n = 500
    r = np.where(np.arange(n) < 280, 1.0, 2.5)
    for terms, theta in (
        (Terms(walk=True), [-3.0]),
        (Terms(markov=True, color="ma"), [-1.0, -3.0, 0.3]),
        (Terms(walk=True, flicker=True, color="ar", bands=((10.0, 0.1, -0.5),)), [-3.0, -2.0, 0.4]),
    ):
        y = random.standard_normal(n) + 0.05 * random.standard_normal(n).cumsum()
        y[100:130] = y[400] = np.nan
        series = Series(y, 1.0, r, np.vstack([np.ones(n), np.linspace(-1.0, 1.0, n)]))
        fit = fit_at(series, terms, np.array(theta))
        scan = edges.scan(series, fit)
        for place in (20, 99, 100, 115, 130, 279, 280, 399, 400, 401, 450):
            column = (np.arange(n) >= place).astype(np.float64)
            c, inverse, _ = run(series.beside(column), terms, fit.theta)[0][0].coefficients()
            assert scan.B[place] / scan.A[place] == pytest.approx(c[-1], rel=1e-9)
            assert scan.A[place] * fit.sigma**2 * inverse[-1, -1] == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("gap", ["9", "70"])
def test_the_case_of_a_unit_that_was_picked_up(gap: str, tmp_path: Path) -> None:
    """Truth: 0.513, put in at the gap's beginning."""
    found = diagnose(shared_case("S01_step_across_gap.py", tmp_path, gap), axes=["ax"], decimate=1.0)["axes"]["ax"][
        "findings"
    ]
    (finding,) = (each for each in found if each["cause"] == "step")
    size, time = finding["estimate"]["amplitude"], finding["estimate"]["time_s"]
    assert abs(size["median"] - 0.513) < 3.0 * size["sd"]
    assert 1199.0 < time["q05"] < time["q95"] < 1201.0 + float(gap)
    assert {each["cause"] for each in found} == {"step", "missing_samples"}
