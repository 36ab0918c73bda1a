"""The logger asks oftener than the sensor measures: each reading repeats. readings.py finds the rate.

In `intervals` alone the logger, or the sensor, fell to a part of its rate.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from selfcal._reference import Random
from selfcal.base.grid import Array
from selfcal.diagnosis.cause import Cause, Grouping, Scored, Simulated, count_key, medians, positive
from selfcal.likelihood.state import Look


def _spoil(row: Array, keys: Mapping[str, Any], rate_hz: float, lsb: float, random: Random) -> None:
    """Hold the mean of each reading's time, on the lattice, until the next reading. With `intervals`, hold single
    readings instead, in a tenth of each piece of the record."""
    if "intervals" in keys:
        ratio, piece = max(2, round(rate_hz / keys["rate_hz"])), row.size // keys["intervals"]
        for k in range(keys["intervals"]):
            start = k * piece + int(random.uniform() * 0.8 * piece)
            held = row[start : start + max(ratio, piece // 10)]
            held[:] = held[np.arange(held.size) // ratio * ratio]
        return
    cell = np.floor(np.arange(row.size) * min(keys["rate_hz"] / rate_hz, 1.0)).astype(np.int64)
    mean = np.bincount(cell, row) / np.bincount(cell)
    row[:] = (np.rint(mean / lsb) * lsb if lsb > 0.0 else mean)[cell]


def _of_estimate(look: Look) -> dict[str, Any] | None:
    """Held readings in stretches. Those of a whole record are no part of it: the model is of the part's own rate."""
    if "intervals" not in look.estimate:
        return None
    return {**medians(look, "rate_hz"), "intervals": len(look.estimate["intervals"])}


CAUSE = Cause(
    "held_samples",
    "The logger asks oftener than the sensor measures: readings repeat.",
    "Log at the sensor's own rate, on its data-ready line.",
    source="read-out",
    grouping=Grouping(alike=lambda a, b: True),
    score=Scored(no_gain="repeats are left out before and after"),
    simulated=Simulated(
        keys={"rate_hz": positive(lambda s: 0.2 * s.samples / s.duration_s), "intervals": count_key(None)},
        of_estimate=_of_estimate,
        spoil=_spoil,
    ),
)
