"""The readings differ from every model tried, and no known cause explains it. The statistics of the verdict show it."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause, Grouping, Scored

CAUSE = Cause(
    "unexplained",
    "The readings differ from every model tried, and no known cause explains it.",
    "Record again: if the statistic stands out a second time, it is the sensor's own.",
    grouping=Grouping(alike=lambda a, b: bool(a.estimate["statistic"] == b.estimate["statistic"]), most=1),
    score=Scored(no_gain="no model was extended"),
)
