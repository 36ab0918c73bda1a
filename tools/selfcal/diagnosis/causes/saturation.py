"""Readings are clipped at a limit. readings.py finds the limit."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause, positive, shown

CAUSE = Cause(
    "saturation",
    "Readings are clipped at a limit.",
    "Choose a wider range.",
    source="read-out",
    alike=lambda a, b: True,
    pictures=shown("limit"),
    no_gain="readings at the limit are scored by no density",
    of_estimate=lambda look: None,  # the range is in the group
    keys={"limit": positive(lambda s: abs(s.bias) + s.sd, "range")},
)
