"""A gain on held-out time: what it is, and how it is measured everywhere."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from selfcal.base.grid import Array

#: How far ahead the bias is predicted, s.
HORIZONS_S = (1.0, 10.0, 60.0, 300.0)
#: Pieces of the held-out time whose scatter gives the uncertainty.
SCORE_PIECES = 24
#: Least change of a number that matters, over the number.
MATTERS = 0.05
#: Standard deviations below 0 of a gain from which a finding is dropped.
HARM_SD = 2.0


@dataclass(frozen=True)
class HeldOut:
    """The contract's `gain` of a finding, or None with the `reason`."""

    gain: dict[str, Any] | None
    reason: str | None = None

    @property
    def harms(self) -> bool:
        """Whether the finding predicts the rest of the record clearly worse."""
        return harmful([self])


def score_entry(before: float, after: float, sd: float, samples: float) -> dict[str, Any]:
    """The contract's entry of two log scores a sample and the deviation of their difference."""
    return {"log_score_per_sample": {"before": before, "after": after, "sd": sd, "samples": int(samples)}}


def sd_of_mean(steps: Array) -> float:
    """Standard deviation of the mean of pieces."""
    return float(np.std(steps, ddof=1)) / math.sqrt(len(steps))


def error_entry(before: Array, after: Array) -> dict[str, float] | None:
    """Root mean squares of two errors [n] at the same places, and the deviation of their difference, by pieces three
    times as long: they last longer. None: fewer are known than a score has pieces."""
    good = np.isfinite(before) & np.isfinite(after)
    if good.sum() < SCORE_PIECES:
        return None
    squares = [error[good] ** 2 for error in (before, after)]
    rms = [math.sqrt(float(each.mean())) for each in squares]
    first, second = (np.array([part.mean() for part in np.array_split(each, SCORE_PIECES // 3)]) for each in squares)
    return {"before": rms[0], "after": rms[1], "sd": sd_of_mean(second - first) / max(sum(rms), 1e-300)}


def harmful(parts: Sequence[HeldOut]) -> bool:
    """Whether the findings on some axes predict the rest of the record clearly worse, all axes together."""
    gains = [part.gain for part in parts if part.gain is not None]
    return bool(gains) and in_sd(gains) < -HARM_SD


def in_sd(gains: Sequence[Mapping[str, Any]]) -> float:
    """How much some axes gain together, standard deviations."""
    scores = [gain["log_score_per_sample"] for gain in gains]
    more = sum(score["samples"] * (score["after"] - score["before"]) for score in scores)
    return float(more) / max(math.hypot(*(score["samples"] * score["sd"] for score in scores)), 1e-300)
