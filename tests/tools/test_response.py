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
from selfcal.verbs.response import response

from conftest import case_records, run

Array = NDArray[np.float64]

#: White noise, deg/s/sqrt(Hz), and random walk, deg/s^2/sqrt(Hz), of a gyro.
N, K = 0.05, 2.5e-4


def late(values: Array, lag_s: float, dt: float) -> Array:
    """Behind a first-order lag, from the first value on."""
    a = math.exp(-dt / lag_s)
    return np.asarray(lfilter([1.0 - a], [1.0, -a], values, zi=[a * values[0]])[0])


def wander(random: np.random.Generator, n: int, dt: float, sd: float, time_s: float) -> Array:
    """A Gauss-Markov process from its stationary state on."""
    a = math.exp(-dt / time_s)
    steps = sd * math.sqrt(1.0 - a * a) * random.standard_normal(n)
    steps[0] = sd * random.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -a], steps))


class Drawn:
    """A record of two gyros and a temperature. Before it begins, the temperature has moved for 2000 s."""

    def __init__(self, seed: int, n: int = 3000, dt: float = 1.0) -> None:
        self.random = random = np.random.default_rng([45, seed])
        self.n, self.dt, before = n, dt, round(2000.0 / dt)
        t = np.arange(n + before) * dt
        self.whole = 30.0 + late(wander(random, t.size, dt, 4.0, 600.0), 60.0, dt)
        self.whole += 2.0 * np.sin(2.0 * math.pi * t / random.uniform(900.0, 1500.0))
        self.temperature = self.whole[before:]
        self.gx, self.gy = (
            N / math.sqrt(dt) * random.standard_normal(n) + K * math.sqrt(dt) * random.standard_normal(n).cumsum()
            for _ in range(2)
        )

    def write(self, path: Path) -> Path:
        """As a part reads it: the temperature with a noise of its own, on a lattice of 0.14 degC."""
        read = 0.14 * np.rint((self.temperature + 0.05 * self.random.standard_normal(self.n)) / 0.14)
        columns = {"t[s]": np.arange(self.n) * self.dt, "gx[deg/s]": self.gx, "gy[deg/s]": self.gy, "temp[degC]": read}
        np.savez(path, **columns)
        return path


def other_axis(d: Drawn) -> dict[str, float]:
    d.gy += wander(d.random, d.n, d.dt, 0.2, 60.0)
    d.gx += 0.3 * late(d.gy, 8.0, d.dt)
    return {"gain": 0.3, "lag_s": 8.0}


def thermal(d: Drawn) -> dict[str, float]:
    d.gx += 0.05 * late(d.whole, 250.0, d.dt)[-d.n :]
    return {"gain": 0.05, "lag_s": 250.0}


def change(d: Drawn) -> dict[str, float]:
    d.gx += 4.0 * np.gradient(d.whole, d.dt)[-d.n :]
    return {"rate": 4.0}


def at_least(share: float, count: int) -> int:
    """Records that must show what each shows with probability `share`, but for one set in 100."""
    return int(binom.ppf(0.01, count, share))


@pytest.mark.parametrize(
    ("draw", "input_", "structure", "source"),
    [
        (other_axis, "gy", "lag", "input first"),
        (thermal, "temp", "lag", "input first"),
        (change, "temp", "rate", "cannot tell"),
    ],
    ids=["another axis", "thermal", "rate"],
)
def test_intervals_cover_the_truth(
    draw: Callable[[Drawn], dict[str, float]], input_: str, structure: str, source: str, tmp_path: Path
) -> None:
    count = case_records(5, 100)
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
    count = case_records(4, 100)
    found = [response(Drawn(seed).write(tmp_path / "log.npz"), input=input_, output="gx") for seed in range(count)]
    assert sum(one["influence"] for one in found) <= 1
    # 5 % of the bands of unrelated columns are above the level by chance; bands of one record are nearly independent.
    above = np.concatenate(
        [np.greater(one["empirical"]["coherence"], one["empirical"]["coherence_by_chance"]) for one in found]
    )
    assert above.mean() < 0.05 + 3.0 * math.sqrt(0.05 * 0.95 / above.size)


def common(d: Drawn) -> None:
    source = wander(d.random, d.n, d.dt, 0.2, 60.0)
    d.gx += 0.5 * source
    d.gy += source


def common_late(d: Drawn) -> None:
    source = wander(d.random, d.n, d.dt, 0.3, 60.0)
    d.gx += 0.5 * late(source, 8.0, d.dt)
    d.gy += late(source, 30.0, d.dt)


def feedback(d: Drawn) -> None:
    d.gx += wander(d.random, d.n, d.dt, 0.2, 60.0)
    d.gy += 0.5 * late(d.gx, 8.0, d.dt)


@pytest.mark.parametrize("draw", [common, common_late, feedback])
def test_the_source_is_not_told_where_the_input_is_not_first(draw: Callable[[Drawn], None], tmp_path: Path) -> None:
    count = case_records(4, 100)
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
