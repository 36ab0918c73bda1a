"""Priors of a part outside the model's: laid about its own recording (`priors.py`), the same on every target.

Truth: N and K of the records, made here by numpy alone as rows of noise and a sum of steps.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom

from selfcal.model import Model
from selfcal.verbs.codegen import codegen
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify
from selfcal.verbs.replay import replay

from conftest import case_records

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


def at_rest(seed: int, N: float, K: float, rate_hz: float, duration_s: float, level: float = 0.0) -> NDArray[np.float64]:
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
