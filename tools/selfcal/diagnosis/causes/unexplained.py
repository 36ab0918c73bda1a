"""The readings differ from every model tried, and no known cause explains it. The statistics of the verdict show it."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause

CAUSE = Cause(
    "unexplained",
    "The readings differ from every model tried, and no known cause explains it.",
    "Record again: if the statistic stands out a second time, it is the sensor's own.",
    most=1,
    no_gain="no model was extended",
)
