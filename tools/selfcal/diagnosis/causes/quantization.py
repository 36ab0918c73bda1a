"""The lattice of the readings: coarse and not stated by the model file, or of codes that are not alike.

readings.py and codes.py find it, integrity.py judges it. Of unequal codes a share of the readings, `misread`, is read
as a neighbour. A dead band reads all that are nearer to `value` than `width` as `value`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from selfcal._reference import Random
from selfcal.base.grid import Array
from selfcal.diagnosis.cause import Cause, Grouping, Key, Scored, Simulated, medians, positive, shown


def _spoil(row: Array, keys: Mapping[str, Any], rate_hz: float, lsb: float, random: Random) -> None:
    """A dead band about `value`, or every other code narrow."""
    dice = np.array([random.uniform() for _ in range(row.size)])
    if "width" in keys:
        centre = keys.get("value", 0.0)
        # A code on the border of the band loses the share of it that lies inside.
        inside = keys["width"] - np.abs(row - centre)
        if lsb > 0.0:
            centre = round(centre / lsb) * lsb
            inside = keys["width"] / lsb + 0.5 - np.abs(np.rint((row - centre) / lsb))
        row[dice * (lsb > 0.0) < inside] = centre
    elif "misread" in keys:
        code = np.rint(row / lsb)
        lost = (code % 2 != 0) & (dice < 2.0 * keys["misread"])
        row[lost] += lsb * np.where(dice[lost] < keys["misread"], 1.0, -1.0)


CAUSE = Cause(
    "quantization",
    "The codes of the converter show in the readings: they are coarse and not stated, or they are not alike.",
    "State the lsb in the model file, or record with a finer range.",
    source="read-out",
    pictures=shown("lattice"),
    grouping=Grouping(alike=lambda a, b: True),
    score=Scored(no_gain="the lattice is in the reading and not in the prediction"),
    simulated=Simulated(
        keys={
            "lsb": positive(lambda s: 2.0 * s.sd, "lsb"),
            "misread": Key(None, fits=lambda v: 0.0 <= v <= 1.0, limits="from 0 to 1"),
            "value": Key(None),
            "width": positive(None),
        },
        of_estimate=lambda look: medians(look) if "misread" in look.estimate else None,
        spoil=_spoil,
    ),
)
