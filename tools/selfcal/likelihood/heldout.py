"""A gain on held-out time: what it is, and how it is measured everywhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

#: How far ahead the bias is predicted, s.
HORIZONS_S = (1.0, 10.0, 60.0, 300.0)
#: Pieces of the held-out time whose scatter gives the uncertainty.
PIECES = 24
#: A finding whose gain lies so many standard deviations below 0 is none.
HARM_SD = 2.0


@dataclass(frozen=True)
class HeldOut:
    """The contract's `gain` of one finding, or None with the `reason`."""

    gain: dict[str, Any] | None
    reason: str | None = None

    @property
    def harms(self) -> bool:
        """Whether the finding predicts the rest of the record clearly worse."""
        return harmful([self])


def harmful(parts: Sequence[HeldOut]) -> bool:
    """Whether what was found on some axes predicts the rest of the record clearly worse, all axes together."""
    scores = [one.gain["log_score_per_sample"] for one in parts if one.gain is not None]
    more = sum(one["samples"] * (one["after"] - one["before"]) for one in scores)
    return bool(more < -HARM_SD * math.hypot(*(one["samples"] * one["sd"] for one in scores)))
