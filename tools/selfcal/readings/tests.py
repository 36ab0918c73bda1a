"""The tests of the readings, in one table: `identify`, `diagnose`, `fleet`, `compare`, `replay` and `convert` name what
these name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from selfcal.base.grid import Mask
from selfcal.readings.budget import SHARES
from selfcal.readings.codes import Misread
from selfcal.readings.lost_words import Recurring
from selfcal.readings.readings import Clipped, Readings


@dataclass(frozen=True)
class Test:
    """`name`: of a check and of a cause. `share`: of sound axes that it names. `statistic`: the evidence of readings in
    nats, 0 where they are sound. `mask`: which share of them it is about, or which rows [n]."""

    name: str
    share: float
    statistic: Callable[[Readings], float]
    mask: Callable[[Readings], Mask | float]


def _repeats(readings: Readings) -> Mask | float:
    """Rows of stretches of a lower rate, else the share that repeats throughout."""
    if readings.held is not None:
        return 1.0 - 1.0 / readings.held.ratio
    found = np.zeros(readings.values.size, bool)
    for one in readings.slower:
        found[one.rows] = True
    return found


def _nats(found: Misread | Recurring | Clipped | None) -> float:
    return 0.0 if found is None else found.nats


def _share(found: Misread | Recurring | None) -> float:
    return 0.0 if found is None else found.share


def _held(readings: Readings) -> float:
    always = 0.0 if readings.held is None or readings.held.even else readings.held.nats
    return always + sum(one.nats for one in readings.slower)


_OF_READINGS: Mapping[str, tuple[Callable[[Readings], float], Callable[[Readings], Mask | float]]] = {
    "misread": (lambda r: _nats(r.misread), lambda r: _share(r.misread)),
    "quantization": (lambda r: _nats(r.uneven), lambda r: _share(r.uneven)),
    "saturation": (lambda r: _nats(r.clipped), lambda r: 0.0 if r.clipped is None else r.clipped.mask),
    "outliers": (lambda r: _nats(r.recurring), lambda r: _share(r.recurring)),
    "stuck": (lambda r: r.stuck_nats, lambda r: r.stuck),
    "held_samples": (_held, _repeats),
    "motion": (lambda r: 0.0 if r.moved is None else r.moved.net, lambda r: r.moving),
}
#: Every test, the causes that spoil the others first.
TESTS = tuple(Test(name, SHARES[name], *of_readings) for name, of_readings in _OF_READINGS.items())
