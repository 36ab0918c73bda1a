"""The sampling rate changes. sampling.py finds the time."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause, Grouping, Key, Scored, Simulated, positive

CAUSE = Cause(
    "rate_change",
    "The sampling rate changes.",
    "Look for what set the rate at that time; record at one rate.",
    source="read-out",
    grouping=Grouping(alike=lambda a, b: True),
    score=Scored(no_gain="the record has one rate before and after"),
    simulated=Simulated(
        keys={
            "time_s": Key(lambda s: s.duration_s / 2.0),
            "after_hz": positive(lambda s: 0.5 * s.samples / s.duration_s),
        },
        common=True,
        of_estimate=lambda look: None,
    ),
)
