"""The written model is of the recording's own sensor: what it simulates reads as the recording does.

Truth: the rate, lattice, range, law and numbers that each of ten sensors is drawn with, by numpy. Tolerance: four
standard deviations of the estimate (1 in 16 000) about each number that the record identifies.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from test_cases_priors import at_rest, deviation, write

from selfcal.base import units
from selfcal.logs.recording import load
from selfcal.model.file import Model
from selfcal.readings.lattice import step_of
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify
from selfcal.verbs.part import part
from selfcal.verbs.simulate import simulate


@dataclass(frozen=True)
class Sensor:
    """An axis in `unit` at `rate_hz` for `duration_s`: noise N and walk K, about `bias`, on a lattice of `lsb`."""

    axis: str
    unit: str
    rate_hz: float
    duration_s: float
    lsb: float
    N: float
    K: float
    bias: float
    limit: float = np.inf
    more: dict[str, Any] = field(default_factory=dict)


SENSORS = {
    "MEMS gyro": Sensor("gx", "deg/s", 12.5, 1800.0, 1.0 / 131.0, 0.0071, 3.1e-4, -1.3),
    "fine steps": Sensor("gx", "deg/s", 25.0, 1500.0, 2e-5, 0.0034, 2.2e-4, 0.21),
    "tactical gyro": Sensor("gz", "deg/h", 20.0, 2400.0, 0.004, 4.2, 0.11, 7.7),
    "gyro in rad/s": Sensor("gy", "rad/s", 50.0, 900.0, 1.0652644e-3 / 16.4, 6.1e-5, 3.3e-6, 0.004),
    "coarse steps": Sensor("gx", "deg/s", 15.0, 2400.0, 0.061, 0.0125, 6.0e-4, 0.517),
    "fast": Sensor("gy", "deg/s", 400.0, 150.0, 2.0**-9, 0.011, 2.6e-3, 2.2),
    "no steps": Sensor("gz", "deg/s", 8.0, 1800.0, 0.0, 0.0052, 2.8e-4, 0.0),
    "accelerometer in g": Sensor("az", "g", 16.0, 1600.0, 1.0 / 8192.0, 1.9e-4, 7.0e-6, 0.998),
    "clips": Sensor("az", "m/s^2", 20.0, 1500.0, 0.0098, 0.0061, 9.0e-5, 19.59, 19.6),
    "seismometer": Sensor("ax", "um/s^2", 2.0, 6000.0, 0.02, 0.31, 0.009, 44.0),
}


def _log(of: Sensor, path: Path) -> Path:
    """A record of the sensor."""
    values = at_rest(len(of.unit), of.N, of.K, of.rate_hz, of.duration_s, of.bias)
    if of.lsb:
        values = np.round(values / of.lsb) * of.lsb
    return write(path, of.rate_hz, **{of.axis: (of.unit, np.minimum(values, of.limit))})


@pytest.mark.parametrize("verb", ["part", "diagnose"])
@pytest.mark.parametrize("name", SENSORS)
def test_what_the_written_model_simulates_is_the_sensor(
    name: str, verb: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Rate, lattice, range and length are the recording's. N and K of the simulated record agree with those that were
    simulated, and these with the recording's. It has as many distinct readings, to a third: a walk ends elsewhere."""
    of = SENSORS[name]
    log, written, again = _log(of, tmp_path / "my.npz"), tmp_path / "own.yaml", tmp_path / "again.npz"
    if verb == "part":
        part([log], written)
    else:
        diagnose(log, write_model=written)
        assert capfd.readouterr().err.count(f"{written}: read-out: {of.rate_hz:g} Hz") == 1
    model = Model.load(written)
    assert model.sensor_name == "my" and model.sensor_rate_hz == pytest.approx(of.rate_hz, rel=1e-4)
    group = model.group_of(of.axis)
    factor = units.factor(of.unit, group.unit)
    assert group.range == (pytest.approx(of.limit * factor, rel=1e-5) if of.limit < np.inf else 0.0)
    truth = simulate(written, again, seed=6)["truth"][of.axis]
    made, first = load(again), load(log)
    assert (made.rate_hz, made.samples) == (pytest.approx(first.rate_hz), first.samples)
    values = [one.in_unit(of.axis, group.unit) for one in (first, made)]
    steps = [step_of(one)[0] for one in values]
    assert steps[1] == pytest.approx(steps[0], rel=1e-4)
    if of.lsb:
        assert group.lsb == pytest.approx(of.lsb * factor, rel=1e-3)
        counts = [np.unique(np.round(one / group.lsb)).size for one in values]
        assert 0.66 < counts[1] / counts[0] < 1.5
    stated = yaml.safe_load(written.read_text(encoding="utf-8"))["simulate"]["axes"][of.axis]
    assert stated["hypothesis"] == "random_walk"
    for path, numbers in ((log, {"N": of.N * factor, "K": of.K * factor}), (again, truth)):
        found = identify(path, axes=[of.axis], suspicion=False)["axes"][of.axis]
        for key in ("N", "K"):
            one = found["parameters"]["random_walk"][key]
            true = numbers[key]
            if key == "N":  # rounding makes white noise
                true = float(np.hypot(true, steps[0] / np.sqrt(12.0 * of.rate_hz)))
            scale = units.factor(first.columns[of.axis].unit if path == log else group.unit, group.unit)
            assert abs(deviation(one, true / scale)) < 4.0, (path.name, key, one, true)
