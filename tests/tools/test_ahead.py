"""The error of the corrected output some time after a report, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from selfcal.logs.recording import Column, Recording
from selfcal.model.file import Model, Regressor
from selfcal.wire.ahead import AHEAD_S, KnownBias, error_ahead, of_report
from selfcal.wire.frames import AxisReport

RATE_HZ, SLOPE = 2.0, 1.0e-3
MODEL = Model.load()
TIME = Regressor("time", "time", "s", {"gyro": 1.0})


def recorded(minutes: int) -> Recording:
    """A ramp, with 1 minute missing, in rad/s."""
    place = np.delete(np.arange(120 * minutes), np.arange(240, 360))
    missing = np.diff(place, prepend=-1) - 1
    readings = np.radians(0.5 + SLOPE * place / RATE_HZ)
    return Recording(Path("a"), RATE_HZ, {"gx": Column("gx", "rad/s", readings)}, missing, {})


def reports(times: tuple[float, ...], model: Model = MODEL, **more: float) -> list[KnownBias]:
    """Each knows the bias of its time."""
    told = (AxisReport("gx", time, True, {"bias_mean": 0.5 + SLOPE * time, **more}) for time in times)
    return [of_report(one, model) for one in told]


def test_a_bias_that_moves_on_is_off_by_its_way() -> None:
    """Without a column by the slope over 300 s, in the recording's unit; with one in use by what its coefficient
    lacks. A probability below one half is a column that is not in use."""
    model = replace(MODEL, regressors=(TIME,))
    times = (30.0, 210.0, 400.0, 500.0)
    for more, left in (
        ({}, 1.0),
        ({"c0_mean": SLOPE, "c0_sd": 0.0, "c0_probability": 0.9}, 0.0),
        ({"c0_mean": 0.5 * SLOPE, "c0_sd": 0.0, "c0_probability": 1.0}, 0.5),
        ({"c0_mean": SLOPE, "c0_sd": 0.0, "c0_probability": 0.3}, 1.0),
    ):
        found = error_ahead(recorded(15), model, "gx", reports(times, model, **more))
        assert found is not None and found["unit"] == "rad/s" and found["reports"] == len(times)
        assert found["rmse"] == pytest.approx(np.radians(left * SLOPE * AHEAD_S), rel=2e-2, abs=1e-5)


def test_too_few_reports_have_no_figure() -> None:
    """So late in a recording, or before a gap, a report has no readings to be held against."""
    assert error_ahead(recorded(15), MODEL, "gx", reports((210.0, 400.0, 880.0))) is None
    assert error_ahead(recorded(5), MODEL, "gx", reports((10.0, 20.0, 30.0))) is None
    assert error_ahead(recorded(15), MODEL, "gx", []) is None
