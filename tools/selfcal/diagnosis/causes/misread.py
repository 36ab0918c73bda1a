"""Readings that a map of the firmware or the logger has changed: readings/changed_words.py finds which."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause, Grouping, Scored, Simulated, shown

CAUSE = Cause(
    "misread",
    "The readings are not as the part made them: the firmware or the logger changes them.",
    "Log the raw words beside the values.",
    source="read-out",
    pictures=shown("histogram"),
    grouping=Grouping(alike=lambda a, b: bool(a.estimate["kind"] == b.estimate["kind"])),
    score=Scored(no_gain="readings that were changed are scored by no density", once="it is a fault of this log"),
    simulated=Simulated(of_estimate=lambda look: None),
)
