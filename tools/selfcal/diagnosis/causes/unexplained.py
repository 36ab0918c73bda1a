"""The readings differ from every model tried, and no known cause explains it. The statistics of the verdict show it."""

from __future__ import annotations

from collections.abc import Mapping

from selfcal.diagnosis.cause import Cause, Grouping, Scored
from selfcal.diagnosis.finding import Diagnosed
from selfcal.diagnosis.record import Record


def _settle(record: Record, found: Mapping[str, Diagnosed]) -> list[str]:
    """A dependence on another axis is explained where the two share noise. Returns the axes to be judged anew."""
    changed = []
    for name, one in found.items():
        shared = {str(each.look.estimate["other"]) for each in one.findings if each.look.cause == "shared"}
        left = [each for each in one.findings if each.look.cause != "unexplained" or each.look.shown_by not in shared]
        if len(left) < len(one.findings):
            one.findings = left
            changed.append(name)
    return changed


CAUSE = Cause(
    "unexplained",
    "The readings differ from every model tried, and no known cause explains it.",
    "Record again: if the statistic stands out a second time, it is the sensor's own.",
    grouping=Grouping(
        alike=lambda a, b: bool(a.estimate["statistic"] == b.estimate["statistic"]), settle=_settle, most=1
    ),
    score=Scored(no_gain="no model was extended"),
)
