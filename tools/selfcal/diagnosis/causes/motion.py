"""The sensor was moved or shaken. `readings.motion` finds the stretches of one axis in the raw readings, before any
fit; `integrity.motion` the quieter ones afterwards, by energy that several axes share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from selfcal.diagnosis.cause import Cause, Key, counted, shown
from selfcal.likelihood.state import Look
from selfcal.readings.motion import Moved, joined


def look_of(parts: Sequence[Moved]) -> Look:
    """The finding of one axis."""
    intervals = [[a, b] for a, b in joined([each for one in parts for each in one.intervals])]
    nats, worth = sum(one.nats for one in parts), sum(one.net for one in parts)
    return Look("motion", nats, worth, {"intervals": intervals}, {}, when=(intervals[0][0], intervals[-1][1]))


def _seconds(value: float) -> str:
    return f"{value:.4f}".rstrip("0").rstrip(".")


def _of_estimate(look: Look) -> dict[str, Any]:
    return {"intervals": "+".join(f"{_seconds(a)}-{_seconds(b)}" for a, b in look.estimate["intervals"])}


CAUSE = Cause(
    "motion",
    "The sensor was moved or shaken while it should have rested.",
    "Record on a heavy table, away from traffic.",
    source="handling",
    alike=lambda a, b: True,
    once="motion is an event of its recording",
    pictures=shown("largest", "fine_level"),
    of_estimate=_of_estimate,
    keys={
        "intervals": counted(lambda s: 5, "motion_intervals"),
        "amplitude": Key(lambda s: 20.0 * s.sd, "motion_amplitude"),
    },
)
