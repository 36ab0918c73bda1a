"""`identify` tells a drift that is something else: a channel, a settling, a jump. Its numbers are right at hands' ends.

Truth: the numbers that each record was drawn with. The drift of each is so small that K of the record is the effect's.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify

from conftest import case_records

Array = NDArray[np.float64]

SAMPLES, N, K = 2700, 0.02, 4e-5
#: The check that must fail, by effect.
CHECKS = {
    "rate": ("channel", {"column": "temp", "form": "rate"}),
    "square": ("channel", {"column": "supply", "form": "square"}),
    "leak": ("channel", {"column": "ay", "form": "lag"}),
    "settling": ("turn_on", {}),
    "jump": ("jump", {}),
}


def lagged(values: Array, tau: float) -> Array:
    keep = math.exp(-1.0 / tau)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], values))


def log_of(path: Path, seed: int, effect: str = "") -> Path:
    """45 min at 1 Hz with a weak walk or a Gauss-Markov drift. An effect moves the bias by about N."""
    random = np.random.default_rng([seed, 71])
    t = np.arange(float(SAMPLES))
    temp = 24.0 + 60.0 * lagged(lagged(random.standard_normal(SAMPLES), 300.0), 200.0)
    supply = 5.0 + 2.0 * lagged(random.standard_normal(SAMPLES), 150.0)
    ay = 3.0 * lagged(random.standard_normal(SAMPLES), 60.0)
    about = supply - supply.mean()
    shape = {
        "": np.zeros(SAMPLES),
        "rate": np.gradient(temp),
        "square": about**2,
        "leak": lagged(ay, 8.0),
        "settling": np.exp(-t / 90.0),
        "jump": 1.0 * (t > 1100.0),
    }[effect]
    size = {"": 0.0, "settling": 6.0, "jump": 2.0, "leak": 0.6}.get(effect, 2.0) * N / max(float(shape.std()), 1e-9)
    size *= {"settling": 0.2, "jump": 0.5}.get(effect, 1.0)
    if random.integers(2):
        drift = np.cumsum(random.normal(0.0, K, SAMPLES))
    else:
        drift = 400.0 * lagged(random.normal(0.0, K, SAMPLES), 400.0)
    columns = {
        "t[s]": t,
        "gx[deg/s]": 0.3 + drift + size * shape + random.normal(0.0, N, SAMPLES),
        "ay[m/s^2]": 0.1 + ay + random.normal(0.0, 0.02, SAMPLES),
        "temp[degC]": temp + random.normal(0.0, 0.01, SAMPLES),
        "supply[V]": supply + random.normal(0.0, 0.002, SAMPLES),
    }
    np.savez(path, allow_pickle=False, **columns)
    return path


def identified(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = identify(path, axes=["gx"], suspicion=False)["axes"]["gx"]
    return found


@pytest.mark.parametrize("effect", CHECKS)
def test_what_is_no_drift_is_told(effect: str, tmp_path: Path) -> None:
    """K is that of the effect, 5 times the truth and more, so `identify` must not call the axis adequate.
    One of 20 may be missed: a rate of another window leaves some drift beside it."""
    check, told = CHECKS[effect]
    records, missed = case_records(1, 20), 0
    for seed in range(records):
        axis = identified(log_of(tmp_path / "log.npz", seed, effect))
        found = axis["checks"][check]
        assert axis["parameters"]["random_walk"]["K"]["q05"] > 5.0 * K
        if found["passed"]:
            missed += 1
            continue
        assert axis["adequate"] is False
        assert {key: found[key] for key in told} == told
        if effect == "jump":
            assert abs(found["time_s"] - 1100.0) < 20.0  # 2 s of 1-sigma, by the slope of the likelihood
    assert missed <= records // 20


def test_a_drift_is_told_nothing() -> None:
    """Clean twins: at most 1 of 200 fails a check of the drift."""
    records, failed = case_records(6, 200), []
    for seed in range(records):
        with tempfile.TemporaryDirectory() as folder:
            checks = identified(log_of(Path(folder) / "log.npz", 1000 + seed))["checks"]
        failed += [(seed, name) for name in ("channel", "turn_on", "jump") if not checks[name]["passed"]]
    assert len(failed) <= records / 200.0, failed


def shaken(path: Path, seed: int, axes: tuple[str, ...]) -> tuple[Path, dict[str, float]]:
    """An hour of six axes at 1 Hz that hands shake at both ends, each axis by another factor; noise of each axis."""
    random = np.random.default_rng([seed, 72])
    n, ends = 3600, random.integers(6, 30, 2)
    noise = {name: float(np.exp(random.uniform(-5.0, -3.5))) for name in ("gx", "gy", "gz", "ax", "ay", "az")}
    columns: dict[str, Array] = {"t[s]": np.arange(float(n))}
    for name, sd in noise.items():
        y = random.normal(0.0, sd, n)
        if name in axes:
            factor = np.exp(random.uniform(2.0, 5.0))
            y[: ends[0]] *= factor
            y[n - ends[1] :] *= factor
        columns[f"{name}[{'deg/s' if name[0] == 'g' else 'm/s^2'}]"] = y
    np.savez(path, allow_pickle=False, **columns)
    return path, noise


def test_hands_that_one_axis_hardly_shows_leave_its_noise_right(tmp_path: Path) -> None:
    """An axis is left out where two others moved and it is louder. N's sd is 1.2 %: 5 % is four of them."""
    for seed in range(case_records(1, 20)):
        log, noise = shaken(tmp_path / "log.npz", seed, ("gx", "gy", "gz", "ax", "ay", "az"))
        found = identify(log, suspicion=False)["axes"]
        for name, sd in noise.items():
            assert found[name]["parameters"]["constant"]["N"]["median"] == pytest.approx(sd, rel=0.05), (seed, name)
            assert found[name]["adequate"] is False
            assert found[name]["checks"]["motion"]["intervals"][0][0] == 0.0
    N_told = diagnose(log, axes=["gx"])["axes"]["gx"]["posterior"]["parameters"]["constant"]["N"]["median"]
    assert N_told == pytest.approx(noise["gx"], rel=0.05)


def test_an_axis_that_rests_is_left_as_it_is(tmp_path: Path) -> None:
    """Clean twin: two axes are shaken, the other four rest and lose nothing."""
    log, noise = shaken(tmp_path / "log.npz", 3, ("gx", "ay"))
    found = identify(log, suspicion=False)["axes"]
    for name in set(noise) - {"gx", "ay"}:
        assert "moving" not in found[name]["samples_kept_out"]
        assert "motion" not in found[name]["checks"]
