"""The readings stop at a value for a while. readings.py finds the stretches."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from selfcal._reference import Random
from selfcal.base.grid import Array
from selfcal.diagnosis.cause import Cause, Grouping, Scored, Simulated, count_key


def _spoil(row: Array, keys: Mapping[str, Any], rate_hz: float, lsb: float, random: Random) -> None:
    """Hold a reading in each interval, a tenth of its piece of the record."""
    piece = row.size // keys["intervals"]
    for k in range(keys["intervals"]):
        start = k * piece + int(random.uniform() * 0.8 * piece)
        row[start : start + max(1, piece // 10)] = row[start]


CAUSE = Cause(
    "stuck",
    "The readings stop at one value for a while.",
    "Check the bus and the sensor's data-ready line at that time.",
    source="read-out",
    grouping=Grouping(alike=lambda a, b: bool(a.estimate["intervals"][0][0] == b.estimate["intervals"][0][0])),
    score=Scored(no_gain="readings that stick are no readings: none is scored"),
    simulated=Simulated(
        keys={"intervals": count_key(lambda s: 2)},
        of_estimate=lambda look: {"intervals": len(look.estimate["intervals"])},
        spoil=_spoil,
    ),
)
