"""Readings are clipped at a limit. readings.py finds the limit."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause, Grouping, Scored, Simulated, positive, shown

CAUSE = Cause(
    "saturation",
    "Readings are clipped at a limit.",
    "Choose a wider range.",
    source="read-out",
    pictures=shown("limit"),
    grouping=Grouping(alike=lambda a, b: True),
    score=Scored(no_gain="readings at the limit are scored by no density"),
    simulated=Simulated(keys={"limit": positive(lambda s: abs(s.bias) + s.sd, "range")}, of_estimate=lambda look: None),
)
