"""The logger asks oftener than the sensor measures: each reading repeats. readings.py finds the rate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from selfcal._reference import Random
from selfcal.diagnosis.cause import Cause, positive
from selfcal.diagnosis.statemodel import Array


def _spoil(row: Array, keys: Mapping[str, Any], rate_hz: float, lsb: float, random: Random) -> None:
    """The mean of each reading's time, on the lattice, until the next one."""
    cell = np.floor(np.arange(row.size) * min(keys["rate_hz"] / rate_hz, 1.0)).astype(np.int64)
    mean = np.bincount(cell, row) / np.bincount(cell)
    row[:] = (np.rint(mean / lsb) * lsb if lsb > 0.0 else mean)[cell]


CAUSE = Cause(
    "held_samples",
    "The logger asks oftener than the sensor measures: each reading repeats.",
    "Log at the sensor's own rate, on its data-ready line.",
    alike=lambda a, b: True,
    no_gain="repeats are left out before and after",
    keys={"rate_hz": positive(lambda s: 0.2 * s.samples / s.duration_s)},
    spoil=_spoil,
)
