"""Priors of a part outside the model's: laid about its own recording (`priors.py`), the same on every target.

Truth: N and K of the records, made here by numpy alone as rows of noise and a sum of steps.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from beyond_priors import drawn
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import binom

from selfcal.bank.priors import for_record
from selfcal.logs.recording import load
from selfcal.model.file import Model
from selfcal.verbs.codegen import codegen
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify
from selfcal.verbs.replay import replay

from conftest import case_records, shared_case

#: deg/s per deg/sqrt(h), and per deg/h: units of data sheets.
ARW, PER_HOUR = 1.0 / 60.0, 1.0 / 3600.0
HOUR_S = 3600.0

#: By part: the axis and its unit in the file, the level there, N and K over N, the rate in Hz, and whose priors. The
#: N of the ADIS16470 and of the consumer part lie inside the default limits.
PARTS = {
    "fibre optic gyro, 0.001 deg/sqrt(h)": ("gx", "deg/s", 2e-3, 0.001 * ARW, 0.03, 100.0, "from this record"),
    "tactical gyro, 0.012 deg/sqrt(h)": ("gy", "deg/h", -3.0, 0.012 * ARW / PER_HOUR, 0.02, 20.0, "from this record"),
    "tactical gyro in rad/s, 0.02 deg/sqrt(h)": (
        "gz", "rad/s", 7e-5, 0.02 * ARW * math.pi / 180.0, 0.05, 10.0, "from this record",
    ),
    "industrial gyro, 0.34 deg/sqrt(h)": ("gx", "deg/s", 0.1, 0.34 * ARW, 0.03, 10.0, "model"),
    "consumer gyro, 5 mdeg/s/sqrt(Hz)": ("gx", "mdps", 800.0, 5.0, 0.03, 10.0, "model"),
    "analogue gyro, 1.4 deg/s/sqrt(Hz)": ("gy", "deg/s", -4.0, 1.4, 0.04, 25.0, "from this record"),
    "servo accelerometer, 4 ug/sqrt(Hz)": ("az", "g", -1.0003, 4e-6, 0.03, 10.0, "from this record"),
    "seismic accelerometer, 0.2 ug/sqrt(Hz)": ("az", "m/s^2", 9.812, 2e-6, 0.05, 10.0, "from this record"),
    "shock accelerometer, 9 mg/sqrt(Hz)": ("ax", "mg", 350.0, 9.0, 0.03, 50.0, "from this record"),
    "consumer accelerometer, 180 ug/sqrt(Hz)": ("ay", "g", 0.02, 180e-6, 0.03, 10.0, "model"),
}  # fmt: skip


def at_rest(
    seed: int, N: float, K: float, rate_hz: float, duration_s: float, level: float = 0.0
) -> NDArray[np.float64]:
    """Readings of white noise and a random walk about a level."""
    random, n = np.random.default_rng(seed), round(rate_hz * duration_s)
    walk = np.cumsum(random.normal(size=n)) * K / math.sqrt(rate_hz)
    return level + walk + N * math.sqrt(rate_hz) * random.normal(size=n)


def write(path: Path, rate_hz: float, **columns: tuple[str, NDArray[np.float64]]) -> Path:
    named = {f"{name}[{unit}]": values for name, (unit, values) in columns.items()}
    np.savez(path, **{"t[s]": np.arange(len(next(iter(named.values())))) / rate_hz, **named})  # type: ignore[arg-type]
    return path


def deviation(estimate: dict[str, Any], truth: float) -> float:
    """Of the logarithm, in sd of its 90 % interval."""
    spread = math.log(estimate["q95"] / estimate["q05"]) / (2.0 * 1.6449)
    return math.log(estimate["median"] / truth) / spread


@pytest.mark.parametrize("part", PARTS)
def test_a_part_is_identified_by_its_file_alone(part: str, tmp_path: Path) -> None:
    """N and K of an hour lie in their 90 % intervals as often as stated (1e-4 of the binomial), and within 4.5 sd.
    Nothing is flagged, but what one record in 50 has by chance."""
    axis, unit, level, N, ratio, rate_hz, source = PARTS[part]
    count = case_records(1, 40)
    far: dict[str, list[float]] = {"N": [], "K": []}
    doubtful = 0
    for seed in range(count):
        values = at_rest(1000 * list(PARTS).index(part) + seed, N, ratio * N, rate_hz, HOUR_S, level)
        log = write(tmp_path / "log.npz", rate_hz, **{axis: (unit, values)})
        (found,) = identify(log, suspicion=False)["axes"].values()
        assert found["priors"] == source
        assert abs(found["bias_now"]["mean"] - level) < abs(values[-1] - level) + 30.0 * N
        for law, parameters in found["parameters"].items():
            assert found["hypotheses"][law] < 0.01 or not any(one["off_grid"] for one in parameters.values()), law
        far["N"].append(deviation(found["parameters"]["random_walk"]["N"], N))
        far["K"].append(deviation(found["parameters"]["random_walk"]["K"], ratio * N))
        assert found["parameters"]["random_walk"]["K"]["identified"]
        doubtful += not found["adequate"]
    inside = {name: sum(abs(one) < 1.6449 for one in values) for name, values in far.items()}
    print(f"{part}: {inside} of {count}, {doubtful} not adequate")
    assert max(abs(one) for values in far.values() for one in values) < 4.5
    assert min(inside.values()) >= binom.ppf(1e-4, count, 0.9)
    assert doubtful <= max(1.0, 0.1 * count)


def test_a_tactical_gyro_has_an_answer(tmp_path: Path) -> None:
    """P94: 0.012 deg/sqrt(h) is N = 2e-4 deg/s/sqrt(Hz), without a model file; K 0.3 deg/h/sqrt(h). 4 sd."""
    (axis,) = identify(shared_case("P94_tactical.py", tmp_path), json=tmp_path / "out.json")["axes"].values()
    walk = axis["parameters"]["random_walk"]
    assert axis["priors"] == "from this record" and axis["adequate"]
    assert abs(deviation(walk["N"], 2e-4)) < 4.0 and abs(deviation(walk["K"], 0.3 * ARW * PER_HOUR)) < 4.0
    assert not any(one["off_grid"] for law in axis["parameters"].values() for one in law.values())


# ------------------------------------------------------------------------------- inside, at the limits, and far outside


def test_a_record_inside_keeps_the_model_to_the_bit(tmp_path: Path) -> None:
    """The model itself, for N up to its limits, beside a ramp, a step, motion at an end, and a coarse lattice."""
    model = Model.load()
    ramp = np.linspace(0.0, 2.0, 18_000)
    step = np.where(np.arange(18_000) > 7000, 3.0, 0.0)
    hands = np.where(np.arange(18_000) < 300, 40.0 * np.random.default_rng(2).normal(size=18_000), 0.0)
    kinds = {
        "least": at_rest(1, 1.02e-3, 2e-5, 10.0, 1800.0),
        "most": at_rest(2, 0.49, 1e-3, 10.0, 1800.0),
        "ramp": at_rest(3, 0.01, 1e-4, 10.0, 1800.0) + ramp,
        "step": at_rest(4, 0.01, 1e-4, 10.0, 1800.0) + step,
        "hands": at_rest(5, 0.01, 1e-4, 10.0, 1800.0) + hands,
        "lattice": np.round(at_rest(6, 0.01, 1e-4, 10.0, 1800.0) / 0.05) * 0.05,
        "level": at_rest(7, 0.01, 1e-4, 10.0, 1800.0) + 35.0,
    }
    for kind, values in kinds.items():
        log = load(write(tmp_path / "log.npz", 10.0, gx=("deg/s", values)))
        assert for_record(model, log, ("gx",)) is model, kind


def test_rest_inside_the_priors_is_never_sent_outside(tmp_path: Path) -> None:
    """Clean twin: N and K drawn from the default priors' inner 95 %, at most 1 of 200 with other priors than these."""
    count, fired, random = case_records(20, 200), 0, np.random.default_rng(11)
    model = Model.load()
    for seed in range(count):
        N = math.exp(random.uniform(math.log(1.2e-3), math.log(0.42)))
        K = min(N, math.exp(random.uniform(math.log(2e-5), math.log(2e-2))))
        rate_hz = (1.0, 10.0, 50.0)[seed % 3]
        values = at_rest(5000 + seed, N, K, rate_hz, 900.0, 8.0 * random.normal())
        log = load(write(tmp_path / "log.npz", rate_hz, gx=("deg/s", values)))
        fired += for_record(model, log, ("gx",)) is not model
    assert fired <= max(1, count // 200)


@pytest.mark.parametrize(
    ("N", "K", "level"), [(0.3, 0.3, 0.0), (0.02, 1e-3, 90.0), (3e-6, 1e-7, 60.0), (0.2, 0.1, -100.0)]
)
def test_a_drift_or_a_level_outside_has_an_answer(N: float, K: float, level: float, tmp_path: Path) -> None:
    """A drift beyond K and sigma_m, a level beyond the bias' prior. Tolerance: 4 sd."""
    log = write(tmp_path / "log.npz", 10.0, gx=("deg/s", at_rest(21, N, K, 10.0, HOUR_S, level)))
    (axis,) = identify(log, suspicion=False)["axes"].values()
    assert axis["priors"] == "from this record"
    walk = axis["parameters"]["random_walk"]
    assert axis["hypotheses"]["random_walk"] > 0.01 and abs(deviation(walk["K"], K)) < 4.0
    assert abs(deviation(walk["N"], N)) < 4.0
    assert not walk["K"]["off_grid"]


def test_a_part_that_was_held_at_its_ends_has_its_own_noise(tmp_path: Path) -> None:
    """A tactical gyro of which 25 s at the start are motion: N by the rest, within 4 sd."""
    values = at_rest(31, 1e-4, 2e-6, 20.0, 1800.0)
    values[:500] += np.random.default_rng(3).normal(size=500)
    (axis,) = identify(write(tmp_path / "log.npz", 20.0, gx=("deg/s", values)), suspicion=False)["axes"].values()
    assert axis["priors"] == "from this record"
    assert "motion" in axis["checks"]
    assert abs(deviation(axis["parameters"]["random_walk"]["N"], 1e-4)) < 4.0


def test_every_target_has_the_same_limits(tmp_path: Path) -> None:
    """`diagnose` writes the limits that `identify` has; `codegen` takes the file; `replay` agrees within the contract's
    tolerance for axes that share their nodes (P to 1e-3, N to 0.1 of its sd). An axis inside keeps the model's."""
    log = write(
        tmp_path / "log.npz",
        10.0,
        gx=("deg/s", at_rest(41, 3e-4, 1e-5, 10.0, 900.0)),
        gy=("deg/s", at_rest(42, 0.02, 2e-4, 10.0, 900.0)),
    )
    found = identify(log, suspicion=False)["axes"]
    assert [axis["priors"] for axis in found.values()] == ["from this record", "model"]
    written = tmp_path / "model.yaml"
    diagnosed = diagnose(log, decimate=1.0, write_model=written, json=tmp_path / "diagnosis.json")["axes"]
    assert [axis["priors"] for axis in diagnosed.values()] == ["from this record", "model"]
    again = identify(log, model=written, suspicion=False)["axes"]
    for name, axis in found.items():
        assert again[name]["priors"] == "model"
        assert again[name]["parameters"] == axis["parameters"]
    tables = codegen(written, tmp_path / "tables", rate=10.0, start=tmp_path / "diagnosis.json")
    assert tables.axes[0].ln_max[0] < math.log(0.1) < tables.axes[2].ln_max[0]
    for name, axis in replay(log)["axes"].items():
        assert axis["priors"] == found[name]["priors"]
        for law, probability in axis["hypotheses"].items():
            assert abs(probability - found[name]["hypotheses"][law]) < 1e-3
        one, other = (tree["parameters"]["random_walk"]["N"] for tree in (axis, found[name]))
        assert abs(one["median"] - other["median"]) < 0.1 * other["sd"]


# ------------------------------------------------------------------------------- posteriors that lean on an end


def test_a_walk_below_the_least_K_is_a_walk(tmp_path: Path) -> None:
    """K 4e-6 of priors from 2e-5 on, 30 crossings of white noise and walk long. 4 sd; of many records nine of ten
    intervals hold N and K (1e-4 of the binomial). Its law is the walk, or a Gauss-Markov drift of the record's time."""
    N, K, dt_s, n = 0.012, 4e-6, 13.0, 12_000
    count, held = case_records(2, 40), {"N": 0, "K": 0}
    for seed in range(count):
        y = drawn(np.random.default_rng([81, seed]), N, K, n, dt_s)
        (axis,) = identify(write(tmp_path / "log.npz", 1.0 / dt_s, gx=("deg/s", y)), suspicion=False)["axes"].values()
        assert axis["priors"] == "from this record" and "K" in axis["own_priors"]
        assert axis["hypotheses"]["random_walk"] > 0.01 and axis["summary"]["rrw"]["reason"] != "the drift is 1/f noise"
        walk = axis["parameters"]["random_walk"]
        assert abs(deviation(walk["N"], N)) < 4.0 and abs(deviation(walk["K"], K)) < 4.0
        for name, truth in (("N", N), ("K", K)):
            held[name] += walk[name]["q05"] <= truth <= walk[name]["q95"]
    assert min(held.values()) >= binom.ppf(1e-4, count, 0.9)


@pytest.mark.parametrize(("N", "sigma_m", "time_s", "dt_s"), [(2e-3, 1.2e-4, 3000.0, 20.0), (0.02, 0.02, 9e3, 32.0)])
def test_a_markov_drift_beyond_its_ends_has_limits_of_its_own(
    N: float, sigma_m: float, time_s: float, dt_s: float, tmp_path: Path
) -> None:
    """A sigma_m below the least of 5e-4, a time beyond the longest of 5000 s that a walk does not describe. 4 sd."""
    random, n, phi = np.random.default_rng(round(time_s)), 25_000, math.exp(-dt_s / time_s)
    kick = sigma_m * math.sqrt(1.0 - phi * phi) * random.normal(size=n)
    kick[0] = sigma_m * random.normal()
    y = lfilter([1.0], [1.0, -phi], kick) + N / math.sqrt(dt_s) * random.normal(size=n)
    (axis,) = identify(write(tmp_path / "log.npz", 1.0 / dt_s, gx=("deg/s", y)), suspicion=False)["axes"].values()
    assert axis["priors"] == "from this record"
    markov = axis["parameters"]["gauss_markov"]
    assert axis["hypotheses"]["gauss_markov"] > 0.5
    for name, truth in (("N", N), ("sigma_m", sigma_m), ("alpha", 1.0 / time_s)):
        assert abs(deviation(markov[name], truth)) < 4.0


def test_an_invisible_walk_has_an_upper_limit(tmp_path: Path) -> None:
    """K 1e-7 beside N 0.02 crosses it after four days; the record is one day. No law is excluded, no limit is 0."""
    y = drawn(np.random.default_rng(83), 0.02, 1e-7, 8640, 10.0)
    (axis,) = identify(write(tmp_path / "log.npz", 0.1, gx=("deg/s", y)), suspicion=False)["axes"].values()
    rrw = axis["summary"]["rrw"]
    assert not rrw["identified"] and rrw["reason"] == "the law is not decided"
    assert rrw["q95"] > 1e-7 and min(axis["hypotheses"].values()) > 0.01


@pytest.mark.parametrize("seconds", [900, 3600, 14_400])
def test_limits_that_hold_the_truth_stay(seconds: int, tmp_path: Path) -> None:
    """Walks of the default priors, as drawn by them: limits move in at most 1 of 20 of those that lean, and 1 of 10
    leans. So at most 1 of 200 moves."""
    random, count, moved, model = np.random.default_rng(seconds), case_records(20, 200), 0, Model.load()
    for _ in range(count):
        N = math.exp(random.uniform(math.log(1.2e-3), math.log(0.42)))
        K = min(N, math.exp(random.uniform(math.log(2e-5), math.log(2e-2))))
        log = load(write(tmp_path / "log.npz", 1.0, gx=("deg/s", drawn(random, N, K, seconds, 1.0))))
        moved += for_record(model, log, ("gx",)) is not model
    assert binom.sf(moved - 1, count, 1.0 / 200.0) > 1e-3
