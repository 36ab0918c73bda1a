"""`selfcal response` against the numbers that each record was drawn with, by code of this file alone.

Of intervals that hold 90 % each, 82 of 100 or more cover the truth in 99.2 % of all such counts (binomial).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import binom

from selfcal.errors import UserError
from selfcal.held import updates
from selfcal.verbs.response import response

from conftest import case_records, run

Array = NDArray[np.float64]

#: White noise, deg/s/sqrt(Hz), and random walk, deg/s^2/sqrt(Hz), of a gyro.
N, K = 0.05, 2.5e-4


#: Steps of what happens in a sample: a discretization that a record and its answer share would hide an error.
FINE = 10


def late(values: Array, lag_s: float, step_s: float) -> Array:
    """Behind a first-order lag, from the first value on."""
    a = math.exp(-step_s / lag_s)
    return np.asarray(lfilter([1.0 - a], [1.0, -a], values, zi=[a * values[0]])[0])


def wander(random: np.random.Generator, n: int, step_s: float, sd: float, time_s: float) -> Array:
    """A Gauss-Markov process from its stationary state on."""
    a = math.exp(-step_s / time_s)
    steps = sd * math.sqrt(1.0 - a * a) * random.standard_normal(n)
    steps[0] = sd * random.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -a], steps))


class Drawn:
    """Two gyros and a temperature, `FINE` steps a sample. Before the record, the temperature has moved for 2000 s."""

    def __init__(self, seed: int, n: int = 3000, dt: float = 1.0) -> None:
        self.random = random = np.random.default_rng([45, seed])
        self.n, self.dt, self.step = n, dt, dt / FINE
        self.steps, before = n * FINE, round(2000.0 / self.step)
        t = np.arange(self.steps + before) * self.step
        self.source = wander(random, t.size, self.step, 4.0, 600.0)
        self.source += 2.0 * np.sin(2.0 * math.pi * t / random.uniform(900.0, 1500.0))
        self.whole = 30.0 + late(self.source, 60.0, self.step)
        self.gx, self.gy = (
            N / math.sqrt(self.step) * random.standard_normal(self.steps)
            + K * math.sqrt(self.step) * random.standard_normal(self.steps).cumsum()
            for _ in range(2)
        )

    def now(self, whole: Array) -> Array:
        """The part of values that is in the record."""
        return whole[-self.steps :]

    def wandering(self, sd: float, time_s: float) -> Array:
        return wander(self.random, self.steps, self.step, sd, time_s)

    def temperature(self) -> Array:
        """As a part reads it in the middle of each interval: with a noise of its own, on a lattice of 0.14 degC."""
        there = self.now(self.whole)[FINE // 2 :: FINE]
        return np.asarray(0.14 * np.rint((there + 0.05 * self.random.standard_normal(self.n)) / 0.14))

    def write(self, path: Path, temperature: Array | None = None) -> Path:
        """A gyro reads means over each interval."""
        gx, gy = (one.reshape(self.n, FINE).mean(axis=1) for one in (self.gx, self.gy))
        read = self.temperature() if temperature is None else temperature
        np.savez(path, **{"t[s]": np.arange(self.n) * self.dt, "gx[deg/s]": gx, "gy[deg/s]": gy, "temp[degC]": read})
        return path


def other_axis(d: Drawn) -> dict[str, float]:
    d.gy += d.wandering(0.2, 60.0)
    d.gx += 0.3 * late(d.gy, 8.0, d.step)
    return {"gain": 0.3, "lag_s": 8.0}


def thermal(d: Drawn) -> dict[str, float]:
    d.gx += d.now(0.05 * late(d.whole, 250.0, d.step))
    return {"gain": 0.05, "lag_s": 250.0}


def change(d: Drawn) -> dict[str, float]:
    d.gx += d.now(4.0 * np.gradient(d.whole, d.step))
    return {"rate": 4.0}


def square(d: Drawn) -> dict[str, float]:
    d.gx += d.now(0.006 * (d.whole - 27.0) ** 2)
    return {"square": 0.006}


def cube(d: Drawn) -> dict[str, float]:
    d.gx += d.now(0.0007 * (d.whole - 29.0) ** 3)
    return {"cube": 0.0007}


def late_square(d: Drawn) -> dict[str, float]:
    d.gx += d.now(0.008 * (late(d.whole, 150.0, d.step) - 28.0) ** 2)
    return {"square": 0.008, "lag_s": 150.0}


def at_least(share: float, count: int) -> int:
    """Records that must show what each shows with probability `share`, but for one set in 100."""
    return int(binom.ppf(0.01, count, share))


@pytest.mark.parametrize(
    ("draw", "input_", "structure", "source"),
    [
        (other_axis, "gy", "lag", "input first"),
        (thermal, "temp", "lag", "input first"),
        (change, "temp", "rate", "cannot tell"),
        (square, "temp", "square", "cannot tell"),
        (cube, "temp", "cube", "cannot tell"),
        (late_square, "temp", "lag and square", "input first"),
    ],
    ids=["another axis", "thermal", "rate", "square", "cube", "late square"],
)
def test_intervals_cover_the_truth(
    draw: Callable[[Drawn], dict[str, float]], input_: str, structure: str, source: str, tmp_path: Path
) -> None:
    count = case_records(3, 100)
    covered: dict[str, int] = {}
    named = told = 0
    for seed in range(count):
        drawn = Drawn(seed)
        truth = draw(drawn)
        found = response(drawn.write(tmp_path / "log.npz"), input=input_, output="gx")
        assert found["influence"]
        named += found["structure"] == structure
        told += found["source"]["verdict"] == source
        for key, value in truth.items():
            one = found["estimate"].get(key)
            covered[key] = covered.get(key, 0) + (one is not None and one["q05"] <= value <= one["q95"])
    least = 82 if count == 100 else at_least(0.9, count)
    assert min(covered.values()) >= least, covered
    assert named >= at_least(0.9, count), named
    assert told >= at_least(0.95, count), told


@pytest.mark.parametrize("input_", ["temp", "gy"])
def test_unrelated_columns_show_no_influence(input_: str, tmp_path: Path) -> None:
    """A look has 5e-4 net of its search: one of 100 records at most."""
    count = case_records(3, 100)
    found = [response(Drawn(seed).write(tmp_path / "log.npz"), input=input_, output="gx") for seed in range(count)]
    assert sum(one["influence"] for one in found) <= 1
    # 5 % of the bands of unrelated columns are above the level by chance; bands of one record are nearly independent.
    above = np.concatenate(
        [np.greater(one["empirical"]["coherence"], one["empirical"]["coherence_by_chance"]) for one in found]
    )
    assert above.mean() < 0.05 + 3.0 * math.sqrt(0.05 * 0.95 / above.size)


@pytest.mark.parametrize("held_s", [7, 33])
@pytest.mark.parametrize("acts", ["what is read", "the reading"])
def test_a_held_input_is_taken_as_it_acts(acts: str, held_s: int, tmp_path: Path) -> None:
    """A temperature that is read every 7 or 33 s and held: behind a lag, and as a part's own compensation takes it."""
    count = case_records(2, 50)
    named = taken = first = 0
    covered: dict[str, int] = {}
    for seed in range(count):
        drawn = Drawn(seed)
        truth = thermal(drawn) if acts == "what is read" else {"gain": 0.05}
        phase = int(drawn.random.integers(held_s))
        rows = np.maximum(0, (np.arange(drawn.n) - phase) // held_s * held_s + phase)
        read = drawn.temperature()[rows]
        if acts == "the reading":
            drawn.gx += 0.05 * np.repeat(read, FINE)
        found = response(drawn.write(tmp_path / "log.npz", read), input="temp", output="gx")
        given = found["input"]
        assert given["held_s"] == pytest.approx(held_s, rel=1e-3)
        taken += given["taken"] == ("held readings" if acts == "the reading" else "straight lines between readings")
        named += found["structure"] == ("static" if acts == "the reading" else "lag")
        first += found["source"]["verdict"] == "input first"
        for key, value in truth.items():
            one = found["estimate"].get(key)
            covered[key] = covered.get(key, 0) + (one is not None and one["q05"] <= value <= one["q95"])
    assert min(named, taken) >= at_least(0.95, count), (named, taken)
    assert min(covered.values()) >= at_least(0.9, count), covered
    assert acts == "the reading" or first >= at_least(0.95, count)


@pytest.mark.parametrize("period", [4, 12.5, 40])
def test_the_period_of_a_held_channel_shows(period: float) -> None:
    """The rows are those at which the channel was read, one beside it where a reading equals the last one."""
    random = np.random.default_rng(3)
    at = np.delete(np.arange(6000), np.arange(1700, 1790))
    due = np.unique(np.ceil(np.arange(6000 / period) * period)).astype(int)
    read = np.rint(0.1 * random.standard_normal(due.size).cumsum() * math.sqrt(period))
    stairs = read[np.searchsorted(due, at, side="right") - 1]
    for values, places in ((stairs, at), (np.interp(np.arange(6000), due, read + 0.3 * np.sin(due)), np.arange(6000))):
        found = updates(values, places)
        assert found is not None
        there = due[np.isin(due, places)]
        for one, other in ((there, places[found]), (places[found], there)):
            near = np.abs(one[:, None] - other).min(axis=1)
            assert np.mean(near <= 1) > 0.99


def test_a_slow_channel_that_is_not_held_has_no_period() -> None:
    """A temperature on a coarse lattice, with noise and without, changes when it will."""
    for seed in range(case_records(20, 200)):
        random = np.random.default_rng([46, seed])
        smooth = wander(random, 4000, 1.0, 3.0, 500.0)
        slow = late(smooth, 60.0, 1.0) + random.choice([0.0, 0.01, 0.1]) * random.standard_normal(4000)
        for values in (slow, 0.14 * np.rint(slow / 0.14), 0.5 * np.rint(slow / 0.5)):
            assert updates(values, np.arange(4000)) is None


def common(d: Drawn) -> None:
    source = d.wandering(0.2, 60.0)
    d.gx += 0.5 * source
    d.gy += source


def common_late(d: Drawn) -> None:
    source = d.wandering(0.3, 60.0)
    d.gx += 0.5 * late(source, 8.0, d.step)
    d.gy += late(source, 30.0, d.step)


def common_later(d: Drawn) -> None:
    source = d.wandering(0.3, 60.0)
    d.gx += 0.5 * late(source, 40.0, d.step)
    d.gy += late(source, 10.0, d.step)


def feedback(d: Drawn) -> None:
    d.gx += d.wandering(0.2, 60.0)
    d.gy += 0.5 * late(d.gx, 8.0, d.step)


@pytest.mark.parametrize("draw", [common, common_late, common_later, feedback])
def test_the_source_is_not_told_where_the_input_is_not_first(draw: Callable[[Drawn], None], tmp_path: Path) -> None:
    count = case_records(2, 100)
    verdicts = []
    for seed in range(count):
        drawn = Drawn(seed)
        draw(drawn)
        verdicts.append(response(drawn.write(tmp_path / "log.npz"), input="gy", output="gx")["source"]["verdict"])
    assert verdicts.count("cannot tell") >= at_least(0.95, count), verdicts


def test_the_ratio_of_spectra_follows_a_known_lag(tmp_path: Path) -> None:
    """Each band is 90 % by itself, and some 20 bands of a record are nearly independent."""
    inside = []
    for seed in range(case_records(4, 40)):
        drawn = Drawn(seed, n=4000, dt=0.5)
        other_axis(drawn)
        found = response(drawn.write(tmp_path / "log.npz"), input="gy", output="gx")["empirical"]
        a = math.exp(-0.5 / 8.0)
        gain = np.abs(0.3 * (1.0 - a) / (1.0 - a * np.exp(-2j * math.pi * np.array(found["frequency_hz"]) * 0.5)))
        inside.append((np.array(found["gain_q05"]) <= gain) & (gain <= np.array(found["gain_q95"])))
    share, size = np.mean(inside), np.size(inside)
    assert share >= 0.9 - 3.0 * math.sqrt(0.9 * 0.1 / size)


def test_the_command_writes_its_files_and_names_a_missing_column(tmp_path: Path) -> None:
    drawn = Drawn(1)
    thermal(drawn)
    drawn.write(tmp_path / "log.npz")
    asked = ("response", "log.npz", "--input", "temp", "--output", "gx")
    done = run(*asked, "--plot", "r.png", "--json", "-", "--start", "100", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert '"schema": "selfcal.response/1"' in done.stdout
    assert "source: input first" in done.stderr
    assert (tmp_path / "r.png").stat().st_size > 10_000
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"input": "gz", "output": "gx"}, "there is no column 'gz'"),
        ({"input": "gx", "output": "gx"}, "give two columns"),
        ({"input": "gx", "output": "temp"}, "temp"),
    ]
    for given, said in wrong:
        with pytest.raises(UserError, match=said):
            response(tmp_path / "log.npz", **given)
