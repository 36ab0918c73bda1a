"""The drift of a unit from recording to recording: the slope of each quantity over the dates, if it is significant.

A unit's quantity y (ln N, ln K, ... or the bias itself) at the day d, measured with the error s of its posterior:

    y = a + b d + e,    e ~ N(0, s^2 + r^2)

r is how far a quantity comes out differently at each new start. All units with three dates or more share an r:
the weighted squares of their residuals are as many as their degrees of freedom. So b over its standard
deviation is Student's t of as many. A unit that scatters more than the others has an r of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtrc, stdtr

from selfcal.base.grid import Array, bisected
from selfcal.readings.budget import FALSE_ALARM


@dataclass(frozen=True)
class DriftSeries:
    """A quantity of the device at place `at` over its recordings: `days` [n], `y` [n] (ln of it if `logarithm`) and its
    errors `s` [n]."""

    at: int
    quantity: str
    unit: str
    logarithm: bool
    days: Array
    y: Array
    s: Array

    @property
    def freedom(self) -> int:
        """Degrees of freedom left by a line."""
        return self.y.size - 2

    def line(self, square: float) -> tuple[float, float, float]:
        """Slope, its standard deviation, and the weighted squares of the residuals, at r^2."""
        w = 1.0 / (self.s**2 + square)
        days = self.days - w @ self.days / w.sum()
        y = self.y - w @ self.y / w.sum()
        information = float(w @ days**2)
        slope = float(w @ (days * y)) / information
        return slope, information**-0.5, float(w @ (y - slope * days) ** 2)


@dataclass(frozen=True)
class Drift:
    """The slope of a device's quantity, of its logarithm or of itself, a day; `log_p` of so steep a slope by chance."""

    of: DriftSeries
    per_day: float
    sd: float
    log_p: float
    significant: bool

    @property
    def days(self) -> float:
        """From the first recording to the last."""
        return float(np.ptp(self.of.days))

    def entry(self) -> dict[str, Any]:
        """As the JSON has it."""
        return {
            "of": "ln" if self.of.logarithm else "value",
            "per_day": self.per_day,
            "sd": self.sd,
            "log_p": self.log_p,
            "recordings": self.of.y.size,
            "days": self.days,
            "significant": self.significant,
        }


def drifts_of(series: Iterable[DriftSeries]) -> list[Drift]:
    """The slope of each. Its quantities share FALSE_ALARM, the probability of a drift of a unit without drift."""
    quantities: dict[str, list[DriftSeries]] = {}
    of_unit: dict[int, int] = {}
    for history in series:
        quantities.setdefault(history.quantity, []).append(history)
        of_unit[history.at] = of_unit.get(history.at, 0) + 1
    drifts = []
    for of in quantities.values():
        alike = _alike([history for history in of if history.freedom > 0])
        common, freedom = _square(alike), sum(history.freedom for history in alike)
        for history in of:
            own = history.freedom > 0 and not any(history is other for other in alike)
            square, degrees = (_square([history]), history.freedom) if own else (common, freedom)
            if degrees == 0:
                continue  # two dates alone: what a new start changes is unknown
            slope, sd, _ = history.line(square)
            log_p = math.log(2.0) + math.log(max(float(stdtr(degrees, -abs(slope) / sd)), 1e-300))
            significant = log_p <= math.log(FALSE_ALARM / of_unit[history.at])
            drifts.append(Drift(history, slope, sd, log_p, significant))
    return drifts


def _square(series: Sequence[DriftSeries]) -> float:
    """r^2 of them all: 0 where their errors are scatter enough."""
    freedom = sum(history.freedom for history in series)
    high = max((float(np.var(history.y)) * history.y.size for history in series), default=0.0)

    def enough(square: float) -> bool:
        return sum(history.line(square)[2] for history in series) <= freedom

    return 0.0 if not freedom or enough(0.0) else bisected(enough, 0.0, high)[1]


def _alike(series: Sequence[DriftSeries]) -> list[DriftSeries]:
    """Series that scatter alike: the others leave in rounds, each with the r of those that are left."""
    kept = list(series)
    while len(kept) > 1:
        square, limit = _square(kept), FALSE_ALARM / len(kept)
        alike = [history for history in kept if chdtrc(history.freedom, history.line(square)[2]) > limit]
        if len(alike) == len(kept) or not alike:
            break
        kept = alike
    return kept
