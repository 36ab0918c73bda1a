"""A gain on held-out time: what it is, and how it is measured everywhere."""

from __future__ import annotations

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
        if self.gain is None:
            return False
        score = self.gain["log_score_per_sample"]
        return bool(score["after"] - score["before"] < -HARM_SD * score["sd"])
