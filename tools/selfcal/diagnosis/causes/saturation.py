"""Readings are clipped at a limit. readings.py finds the limit."""

from __future__ import annotations

import numpy as np

from selfcal.diagnosis.cause import Cause, Extension, positive, shown
from selfcal.diagnosis.model_tree import digits
from selfcal.diagnosis.record import Record
from selfcal.readings.readings import ROUNDED


def _within(record: Record, axis: str, limit: float) -> bool:
    """Whether all readings of an axis are within the limit; one that was not recorded is."""
    state = record.axes.get(axis)
    return state is None or bool(np.nanmax(np.abs(state.y + state.level)) < limit)


def _extend(at: Extension) -> None:
    """A model file states one range for a group, the same on both sides of zero: not one that keeps the axis itself
    out, nor another one that was looked at."""
    limit = abs(at.finding.look.estimate["limit"]["median"])
    if abs(at.record.axes[at.axis].level) > limit * (1.0 + ROUNDED):
        return
    others = (other for other in at.group["axes"] if other != at.axis and other in at.found)
    if all(_within(at.record, other, limit) for other in others):
        at.group["range"] = digits(limit)


CAUSE = Cause(
    "saturation",
    "Readings are clipped at a limit.",
    "Choose a wider range.",
    source="read-out",
    alike=lambda a, b: True,
    pictures=shown("limit"),
    no_gain="readings at the limit are scored by no density",
    extend=_extend,
    of_estimate=lambda look: None,  # the range is in the group
    keys={"limit": positive(lambda s: abs(s.bias) + s.sd, "range")},
)
