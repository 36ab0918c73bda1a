"""`selfcal response` against the numbers that each record was drawn with, by tests/common/influences.py alone.

Of intervals that hold 90 % each, 82 of 100 or more cover the truth in 99.2 % of all such counts (binomial).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from influences import (
    FINE,
    Drawn,
    change,
    common,
    common_late,
    common_later,
    cube,
    feedback,
    late,
    late_square,
    other_axis,
    square,
    thermal,
    wander,
)
from response_cells import INSIDE, OUTSIDE, Record
from scipy.stats import binom

from selfcal.base.errors import UserError
from selfcal.logs.recording import save
from selfcal.readings.held import updates
from selfcal.verbs.response import response

from conftest import case_records, run


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


@pytest.mark.parametrize("name", ["delay", "resonance", "hysteresis"])
@pytest.mark.parametrize("kind", ["prbs", "wandering"])
def test_gain_and_dynamics_cover_the_truth(name: str, kind: str, tmp_path: Path) -> None:
    """Each number in its 90 % where it is stated; it is stated in 9 of 10 records at least."""
    count = case_records(0 if kind == "wandering" else 2, 100)
    if not count:
        pytest.skip("SLOW: make cases")
    covered: dict[str, int] = {}
    stated = 0
    for seed in range(count):
        record = Record(kind, 7000 + seed)
        acts, truth = INSIDE[name](record)
        found = response(record.write(tmp_path / "log.npz", acts), input="temp", output="gx")
        if "estimate" not in found:
            assert found["source"]["verdict"] == "no structure"
            continue
        stated += 1
        for key, value in truth.items():
            one = found["estimate"].get(key)
            covered[key] = covered.get(key, 0) + (one is not None and one["q05"] <= value <= one["q95"])
    assert stated >= at_least(0.9, count)
    assert min(covered.values()) >= at_least(0.9, stated), covered


@pytest.mark.parametrize("name", OUTSIDE)
def test_what_no_structure_has_gets_no_interval(name: str, tmp_path: Path) -> None:
    """No interval of the gain, the range of other methods in its place, and a record to make. What is stated all the
    same holds the truth, but for one record in ten."""
    count = case_records(1, 50)
    wrong = 0
    for seed in range(count):
        record = Record("prbs", 7200 + seed)
        acts, truth = OUTSIDE[name](record)
        found = response(record.write(tmp_path / "log.npz", acts), input="temp", output="gx")
        if "estimate" in found:
            gain = found["estimate"].get("gain")
            wrong += gain is not None and not gain["q05"] <= truth["gain"] <= gain["q95"]
            continue
        assert found["source"]["verdict"] == "no structure" and found["source"]["reason"]
        assert "frequency_response" not in found
        assert "switch the input between two levels" in found["record_next"]
        if "range" in found:
            low, high = found["range"]["gain"]
            assert low <= min(one["gain"] for one in found["methods"].values()) and low <= high
    assert wrong <= 0.1 * count, wrong


def test_two_inputs_that_go_together_are_told_apart(tmp_path: Path) -> None:
    """A supply that falls as a temperature rises, correlated by 0.9 and more: the temperature acts behind 150 s, the
    supply at once. Of one truth, 90 % of the intervals hold it."""
    count = case_records(1, 40)
    held = {"temp": 0, "supply": 0}
    for seed in range(count):
        drawn = Drawn(900 + seed)
        whole = drawn.now(drawn.whole)
        supply = 5.0 - 0.02 * (whole - 30.0) + wander(drawn.random, whole.size, drawn.step, 0.02, 300.0)
        drawn.gx += drawn.now(0.05 * late(drawn.whole, 150.0, drawn.step)) + 1.5 * (supply - 5.0)
        read = supply[FINE // 2 :: FINE] + 0.002 * drawn.random.standard_normal(drawn.n)
        columns = {
            "gx": ("deg/s", drawn.gx.reshape(drawn.n, FINE).mean(axis=1)),
            "temp": ("degC", drawn.temperature()),
            "supply": ("V", read),
        }
        save(tmp_path / "log.npz", columns, 1.0)
        found = response(tmp_path / "log.npz", input=["temp", "supply"], output="gx")
        for part, value in zip(found["inputs"], (0.05, 1.5), strict=True):
            gain = part.get("estimate", {}).get("gain", {"q05": -math.inf, "q95": math.inf})
            held[part["input"]["column"]] += gain["q05"] <= value <= gain["q95"]
    assert min(held.values()) >= at_least(0.9, count), held
    with pytest.raises(UserError, match="--plot is of one input"):
        response(tmp_path / "log.npz", input=["temp", "supply"], output="gx", plot=tmp_path / "r.png")


def _steps(path: Path, seed: int, supply_lsb: float, wild: dict[int, float] | None = None) -> Path:
    """45 min at 1 Hz: a temperature in steps of some 10 min, a supply that follows it, and a gyro that the supply moves
    by 1.4 deg/s/V. `wild`: readings of the thermometer that are none."""
    random = np.random.default_rng([seed, 61])
    temp = 31.0 + np.repeat(random.normal(0.0, 1.5, 5), 540)
    supply = 5.1 - 0.03 * (temp - 31.0)
    gyro = 1.4 * supply + 0.025 * random.standard_normal(2700) + 1e-4 * random.standard_normal(2700).cumsum()
    if supply_lsb:
        supply = supply_lsb * np.rint((supply + 0.002 * random.standard_normal(2700)) / supply_lsb)
    for row, value in (wild or {}).items():
        temp[row] = value
    columns = {"t[s]": np.arange(2700.0), "gx[deg/s]": gyro, "temp[degC]": temp, "supply[V]": supply}
    np.savez(path, **columns)
    return path


@pytest.mark.parametrize("names", [("temp", "supply"), ("supply", "temp")])
@pytest.mark.parametrize("lsb", [0.0, 0.004])
def test_of_two_inputs_of_one_course_neither_is_sure(names: tuple[str, str], lsb: float, tmp_path: Path) -> None:
    """Nobody can tell which acts: no gain has an interval, in either order, and of a supply with a noise of its own."""
    for one in response(_steps(tmp_path / "log.npz", 3, lsb), input=names, output="gx")["inputs"]:
        assert one["source"]["verdict"] == "no structure"
        assert "goes together with" in one["source"]["reason"]
        assert "estimate" not in one


def test_a_thermometers_error_value_is_no_reading(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """85 and -127 degC among 31 +- 3: the gain is -1.4 x 0.03 deg/s/degC as without them."""
    clean, hurt = (
        response(_steps(tmp_path / "log.npz", 4, 0.0, wild), input="temp", output="gx")["estimate"]["gain"]
        for wild in ({}, {700: 85.0, 1900: -127.0})
    )
    assert "temp: 2 of 2700 readings are far from all others, the first 85" in capfd.readouterr().err
    assert abs(hurt["median"] - clean["median"]) < 0.2 * clean["sd"]  # two of 2700 readings are bridged
    assert abs(hurt["median"] + 0.042) < 4.0 * hurt["sd"]


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


@pytest.mark.parametrize("draw", [common, common_late, common_later, feedback])
def test_the_source_is_not_told_where_the_input_is_not_first(draw: Callable[[Drawn], None], tmp_path: Path) -> None:
    count = case_records(2, 100)
    verdicts = []
    for seed in range(count):
        drawn = Drawn(seed)
        draw(drawn)
        verdicts.append(response(drawn.write(tmp_path / "log.npz"), input="gy", output="gx")["source"]["verdict"])
    assert verdicts.count("cannot tell") >= at_least(0.95, count), verdicts


def test_no_axis_acts_on_a_temperature(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both at once: of two axes either may act, of a temperature and an axis the first alone. In a pipe of 40 columns
    no number is cut."""
    random = np.random.default_rng(12)
    slow = np.cumsum(0.04 * random.standard_normal(400))
    gx = 0.3 * slow + 0.01 * random.standard_normal(400)
    monkeypatch.setenv("COLUMNS", "40")
    for name, unit, said in (
        ("temp", "degC", "the input may act, or a common cause on both"),
        ("gy", "deg/s", "either may act on the other, or a common cause on both"),
    ):
        save(tmp_path / "log.npz", {"gx": ("deg/s", gx), name: (unit, slow)}, 1.0)
        done = run("response", "log.npz", "--input", name, "--output", "gx", "--json", "r.json", cwd=tmp_path)
        found = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
        assert found["source"] == {"verdict": "cannot tell", "reason": f"both move at once: {said}"}
        gain = found["estimate"]["gain"]
        assert "…" not in done.stdout and f"{gain['q95']:.4g} " in done.stdout and f" {gain['unit']} " in done.stdout


def test_the_ratio_of_spectra_follows_a_known_lag(tmp_path: Path) -> None:
    """Each band is 90 % by itself, and some 20 bands of a record are nearly independent."""
    inside = []
    for seed in range(case_records(2, 40)):
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
