"""The table of the tests of readings. `identify`, `diagnose`, `fleet`, `compare`, `replay` and `convert` name their
findings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from selfcal.base.grid import Mask
from selfcal.readings.codes import Misread
from selfcal.readings.held import repeats_of
from selfcal.readings.lost_words import Recurring
from selfcal.readings.readings import Clipped, Readings


@dataclass(frozen=True)
class Test:
    """`name`: of a check and of a cause. `statistic`: the evidence of readings in nats, 0 where they are sound. `mask`:
    which share of them it is about, or which rows [n]."""

    name: str
    statistic: Callable[[Readings], float]
    mask: Callable[[Readings], Mask | float]


def _repeats(readings: Readings) -> Mask | float:
    """Rows of stretches of a lower rate, else the share that repeats throughout."""
    if readings.held is not None:
        return 1.0 - 1.0 / readings.held.ratio
    return repeats_of(readings.slower, readings.values.size)


def _nats(finding: Misread | Recurring | Clipped | None) -> float:
    return 0.0 if finding is None else finding.nats


def _share(finding: Misread | Recurring | None) -> float:
    return 0.0 if finding is None else finding.share


def _held(readings: Readings) -> float:
    always = 0.0 if readings.held is None or readings.held.even else readings.held.nats
    return always + sum(stretch.nats for stretch in readings.slower)


#: Every test, the causes that spoil the others first. Their shares of chance: budget.py.
TESTS = (
    Test("misread", lambda r: _nats(r.misread), lambda r: _share(r.misread)),
    Test("quantization", lambda r: _nats(r.uneven), lambda r: _share(r.uneven)),
    Test("saturation", lambda r: _nats(r.clipped), lambda r: 0.0 if r.clipped is None else r.clipped.mask),
    Test("outliers", lambda r: _nats(r.recurring), lambda r: _share(r.recurring)),
    Test("stuck", lambda r: r.stuck_nats, lambda r: r.stuck),
    Test("held_samples", _held, _repeats),
    Test("motion", lambda r: 0.0 if r.moved is None else r.moved.net, lambda r: r.moving),
)
