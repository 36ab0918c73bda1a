"""How far the corrected output is off some time after a report: what a calibration is worth until the next.

The bias that a module reports, with its coefficients' part of what the columns do meanwhile, against the readings then.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from selfcal.base.grid import Array
from selfcal.base.units import factor
from selfcal.logs.recording import Recording
from selfcal.model.file import Model
from selfcal.model.regressors import columns_of, offered
from selfcal.wire.frames import AxisReport, wire_names

#: Time from a report to the middle of the readings that test it, and their length, s: white noise averages out.
AHEAD_S, MEAN_S = 300.0, 60.0
#: Fewest reports of a figure.
REPORTS_LEAST = 3


@dataclass(frozen=True)
class KnownBias:
    """The bias at a time, s of the recording, and the coefficients [p] of the model's columns; 0 if not in use."""

    time_s: float
    bias: float
    coefficients: Array


def error_ahead(recording: Recording, model: Model, name: str, reports: Sequence[KnownBias]) -> dict[str, Any] | None:
    """Rms error of the corrected output AHEAD_S after a report, means of MEAN_S, in the recording's unit; None where
    too few reports have readings so long after them.

    The bias is taken to stay: a Gauss-Markov drift returns to its mean meanwhile, which the module's own corrected
    samples know."""
    recording = recording.along(name)
    regressors, group, unit = offered(model, name), model.group_of(name), recording.columns[name].unit
    time, readings = recording.time_s, recording.in_unit(name, group.unit)
    columns = columns_of(regressors, recording)
    errors = []
    for report in reports:
        then = np.abs(time - report.time_s - AHEAD_S) <= 0.5 * MEAN_S
        now = np.flatnonzero(time <= report.time_s)
        if not now.size or 2 * int(then.sum()) < MEAN_S * recording.rate_hz or time[-1] < report.time_s + AHEAD_S:
            continue
        change = columns[then].mean(axis=0) - columns[now[-1]]
        errors.append(float(np.nanmean(readings[then])) - report.bias - float(report.coefficients @ change))
    if len(errors) < REPORTS_LEAST or not all(map(math.isfinite, errors)):
        return None
    rmse = math.sqrt(float(np.mean(np.square(errors)))) * factor(group.unit, unit)
    return {"horizon_s": AHEAD_S, "mean_s": MEAN_S, "rmse": rmse, "reports": len(errors), "unit": unit}


def of_report(report: AxisReport, model: Model) -> KnownBias:
    """The state of an axis by a module's report: a column is in use where that is the likelier."""
    stated = report.coefficients(wire_names(model))
    sent = [
        stated.get(column, (0.0, 0.0, 0.0)) for regressor in offered(model, report.axis) for column in regressor.columns
    ]
    coefficients = np.array([mean if report.in_use(probability) else 0.0 for mean, _, probability in sent], np.float64)
    return KnownBias(report.time_s, report.value("bias_mean"), coefficients)
