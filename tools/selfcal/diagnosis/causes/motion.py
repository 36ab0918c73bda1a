"""The sensor was moved or shaken. `readings.motion` finds the stretches in the raw readings, before any fit."""

from __future__ import annotations

from typing import Any

from selfcal.diagnosis.cause import Cause, Grouping, Key, Scored, Simulated, count_key, shown
from selfcal.likelihood.state import Look
from selfcal.readings.moves import Moved, motion_events


def look_of(moved: Moved) -> Look:
    """The finding of an axis."""
    intervals = [list(each) for each in moved.intervals]
    size = {"ratio": {"median": moved.ratio, "unit": "1"}} if moved.ratio > 0.0 else {}
    when = (intervals[0][0], intervals[-1][1])
    return Look("motion", moved.nats, moved.net, {"intervals": intervals, **size}, {}, when=when)


def _meet(a: Look, b: Look) -> bool:
    """Whether two axes moved at the same time."""
    return len(motion_events({"a": a.estimate["intervals"], "b": b.estimate["intervals"]})) == 1


def _seconds(value: float) -> str:
    return f"{value:.4f}".rstrip("0").rstrip(".")


def _of_estimate(look: Look) -> dict[str, Any]:
    return {"intervals": "+".join(f"{_seconds(a)}-{_seconds(b)}" for a, b in look.estimate["intervals"])}


CAUSE = Cause(
    "motion",
    "The sensor was moved or shaken while it should have rested.",
    "Record on a heavy table, away from traffic.",
    source="handling",
    pictures=shown("largest", "fine_level"),
    grouping=Grouping(alike=_meet),
    score=Scored(once="motion is an event of its recording"),
    simulated=Simulated(
        keys={
            "intervals": count_key(lambda s: 5, "motion_intervals"),
            "amplitude": Key(lambda s: 20.0 * s.sd, "motion_amplitude"),
        },
        of_estimate=_of_estimate,
    ),
)
