"""Why an axis has no calibration to rely on: each reason is provoked once in the host's firmware.

Truth: what was done to the readings. The reasons of a corrected sample alone (bad_sample, stuck) are provoked on the
board, in test_firmware_commands.py.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from selfcal.base.units import SENSOR_UNITS
from selfcal.logs import recording as recording_module
from selfcal.logs.recording import load
from selfcal.model.file import Model
from selfcal.verbs.replay import replay
from selfcal.wire.frames import AXES, REASONS, choices, reasons
from selfcal.wire.replay import build, run_firmware

RATE_HZ = 10.0
#: White noise of 0.04 deg/s/sqrt(Hz) and 1e-3 m/s^2/sqrt(Hz), within the default model's priors; sd of a reading.
SIGMA = {axis: (0.04 if axis[0] == "g" else 1e-3) * RATE_HZ**0.5 for axis in AXES}
Readings = dict[str, NDArray[np.float64]]


def at_rest(seconds: float, seed: int) -> Readings:
    rng = np.random.default_rng(seed)
    return {axis: SIGMA[axis] * rng.standard_normal(round(seconds * RATE_HZ)) for axis in AXES}


def told(tmp_path: Path, readings: Readings, *, every: float | None = None, gate: bool = False) -> dict[str, str]:
    """The reasons at the end of a recording."""
    columns = {axis: (SENSOR_UNITS[axis], values) for axis, values in readings.items()}
    recording_module.save(tmp_path / "log.npz", columns, RATE_HZ, {})
    recording, model, axes = load(tmp_path / "log.npz"), Model.load(), tuple(readings)
    return run_firmware(build(model, RATE_HZ, axes), recording, model, axes, every, gate=gate)[1]


def test_every_word_has_its_meaning_and_next_step() -> None:
    """But for those that a judgement alone has."""
    words = set(choices("GX_ADEQUACY", "reason").values())
    assert words - set(REASONS) == {"none", "first_epoch", "law_not_watched"}
    assert set(REASONS) <= words
    assert all(": " in said for said in REASONS.values())
    for message in ("STATUS", "CORRECTED"):
        assert all(choices(message, f"reason_{axis}") == choices("GX_ADEQUACY", "reason") for axis in AXES)


def test_the_later_of_two_counts() -> None:
    status, corrected = {"time_ms": 2000.0, "reason_gx": 8.0}, {"time_ms": 1000.0, "reason_gx": 9.0, "reason_gy": 0.0}
    assert reasons(status, corrected) == {"gx": "not_identified"}
    assert reasons(status, corrected | {"time_ms": 2100.0}) == {"gx": "bad_sample"}
    assert reasons({}, corrected) == {"gx": "bad_sample"}
    assert reasons({"reason_gx": 15.0}) == {"gx": "15"}, "a word that a later module may have"
    assert reasons({}, {}) == {}


def shaken(readings: Readings) -> Readings:
    """10 sd to and fro: no window is quiet."""
    return {
        axis: values + 10.0 * SIGMA[axis] * np.resize([1.0, -1.0], len(values)) for axis, values in readings.items()
    }


@pytest.mark.parametrize(
    ("reason", "seconds", "change", "gate"),
    [
        ("no_report", 2.5, dict, False),  # two bank samples, and a report needs three
        ("moving", 30.0, shaken, True),
        ("not_identified", 5.0, dict, False),  # five bank samples tell N but no drift
    ],
)
def test_a_reason_of_all_axes(
    reason: str, seconds: float, change: Callable[[Readings], Readings], gate: bool, tmp_path: Path
) -> None:
    assert told(tmp_path, change(at_rest(seconds, 1)), gate=gate) == dict.fromkeys(AXES, reason)


def test_each_axis_has_its_own_reason(tmp_path: Path) -> None:
    """1600 s, 1 Hz to the bank. gx at rest: none. gy: noise three times as large in the last 500 s. gz: readings at the
    range for 61 bank intervals. ax: 0.4 m/s^2 a bank sample, eight times the largest N of the prior."""
    readings = at_rest(1600.0, 2)
    readings["gy"][-5000:] *= 3.0
    readings["gz"][100:800] = 300.0
    readings["ax"] *= 400.0
    found = told(tmp_path, readings)
    assert found == {"gy": "inadequate", "gz": "retired", "ax": "outside_priors"}


def test_the_document_tells_the_reason(tmp_path: Path) -> None:
    columns = {axis: (SENSOR_UNITS[axis], values) for axis, values in at_rest(5.0, 3).items() if axis in ("gx", "ax")}
    recording_module.save(tmp_path / "log.npz", columns, RATE_HZ, {})
    replay(tmp_path / "log.npz", json=tmp_path / "out.json")
    axes = json.loads((tmp_path / "out.json").read_text())["axes"]
    assert {name: axis["module_reason"] for name, axis in axes.items()} == dict.fromkeys(axes, "not_identified")
