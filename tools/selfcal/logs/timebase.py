"""The clock of a recording's columns: from time stamps, or from the places of their samples, to an even grid with gaps.

Stamps may be coarse or fine (`sampling.py`), come in bursts, or be those of a 32-bit counter that wraps.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError
from selfcal.base.limits import LEAST_RATE_HZ, LONGEST, LONGEST_S, MOST_RATE_HZ
from selfcal.logs.sampling import Ambiguous, on_other_grid, sampling, thinned_grid

#: Rows, and repeats a row, from which on stamps may repeat for being coarser than the sampling interval.
_REPEATS_FROM, _REPEATS_LEAST = 100, 0.005
#: Counts of a counter that wraps, and the least count, and another that is not in the column's own unit, s. (One of ns
#: would wrap every 4 s: such a step back is a restart.)
_WRAPS_AT, _TICKS = 2.0**32, (1e-6, 1e-3)
#: Median steps that a wrap may lie in a gap of.
_WRAP_GAP = 1000.0
#: A column has a clock of its own where so large a share of the steps between its samples, in rows, lies so near their
#: median of two rows or more.
_OWN_SHARE, _OWN_NEAR = 0.6, 0.3
#: Damaged stamps: rows a stamp at least, in a row at most, and rows to either side that show which of them it is.
_DAMAGED_APART, _DAMAGED_MOST, _DAMAGED_WITHIN = 20, 3, 16

#: Raises UserError for a row and what is wrong there.
Fail = Callable[[int, str], NoReturn]


@dataclass(frozen=True)
class Clock:
    """When n samples were taken: an even grid of `rate_hz` that begins `start_s` after the recording does.

    `missing_before` int64[n]: samples missing just before each. `off_grid_s` float64[n]: stamp minus grid, s; None
    without stamps. `moving_before` int64[n]: how many of the missing ones were measured, and left out for motion; None:
    none. `moving` counts all that were left out for it, those beyond either end too.
    """

    rate_hz: float
    missing_before: NDArray[np.int64]
    off_grid_s: NDArray[np.float64] | None = None
    start_s: float = 0.0
    moving_before: NDArray[np.int64] | None = None
    moving: int = 0

    @property
    def lost_before(self) -> NDArray[np.int64]:
        """int64[n]: samples just before each that were never measured."""
        return self.missing_before if self.moving_before is None else self.missing_before - self.moving_before

    @property
    def place(self) -> NDArray[np.int64]:
        """int64[n]: place on the grid of each sample, the missing ones counted."""
        place = np.cumsum(self.missing_before)
        place += np.arange(place.size)
        return place

    @property
    def time_s(self) -> NDArray[np.float64]:
        """float64[n]: time of each sample on the grid since the recording's first, s."""
        time = self.place / self.rate_hz
        time += self.start_s
        return time

    def of_rows(self, rows: NDArray[np.int64], begin_s: float, *, moving: bool = False) -> Clock:
        """The clock of these samples of it, in a recording that begins `begin_s` later. `moving`: the others are left
        out for motion."""
        place = self.place[rows]
        missing = np.diff(place, prepend=place[0] - 1 if place.size else 0) - 1
        off_grid = None if self.off_grid_s is None else self.off_grid_s[rows]
        start = float(self.time_s[rows[0]]) - begin_s if rows.size else self.start_s
        moved, count = self.moving_before, self.moving
        if moving:
            count += self.missing_before.size - rows.size
            lost = np.cumsum(self.lost_before)[rows]
            moved = missing - np.diff(lost, prepend=lost[:1])
        elif moved is not None:
            total = np.cumsum(moved)[rows]
            moved = np.diff(total, prepend=total[:1])
        return Clock(self.rate_hz, missing, off_grid, start, moved, count)

    def alike(self, other: Clock) -> bool:
        """Whether both are one clock."""
        return (
            abs(self.rate_hz / other.rate_hz - 1.0) < 1e-6
            and abs(self.start_s - other.start_s) * self.rate_hz < 0.01
            and np.array_equal(self.missing_before, other.missing_before)
        )


def unwrapped(time: NDArray[np.float64], tick_s: float) -> tuple[NDArray[np.float64], int]:
    """Stamps [n], s from the first, with the wraps of a 32-bit counter undone, and their number. `tick_s`: a count of
    their column, s."""
    back = np.flatnonzero(np.diff(time) < 0.0)
    if not back.size or time.size < 3:
        return time, 0
    steps = np.diff(time)
    most = _WRAP_GAP * float(np.median(np.abs(steps)))
    for span in (_WRAPS_AT * tick for tick in (max(tick_s, _TICKS[0]), *_TICKS)):
        on = steps[back] + span
        if np.ptp(time) < span and ((on > 0.0) & (on <= min(most, 0.5 * span))).all():
            turns = np.zeros(time.size)
            turns[back + 1] = span
            return time + np.cumsum(turns), int(back.size)
    return time, 0


def few(rows: int, of: int) -> bool:
    """Whether so many rows may be damaged ones."""
    return rows * _DAMAGED_APART <= of


def damaged_stamps(time: NDArray[np.float64]) -> NDArray[np.int64]:
    """int64[k]: the fewest rows without which the stamps [n] rise; where they repeat often, do not fall.

    A digit that is wrong makes single stamps too early or too late. None where it takes many rows, or many in a row."""
    steps = np.diff(time)
    repeats = steps == 0.0
    strict = not _repeats_often(repeats)
    wrong = (steps <= 0.0) if strict else (steps < 0.0)
    none = np.empty(0, np.int64)
    if not wrong.any() or not few(int(np.count_nonzero(wrong)), 2 * time.size):
        return none
    near = np.zeros(time.size + 1, bool)
    for row in np.flatnonzero(wrong):
        near[max(0, row + 1 - _DAMAGED_WITHIN) : row + 1 + _DAMAGED_WITHIN] = True
    near[-1] = False
    edges = np.flatnonzero(np.diff(near, prepend=False))
    found = []
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        rows = np.delete(np.arange(first, last), _rising(time[first:last].tolist(), strict))
        if (rows[_DAMAGED_MOST:] - rows[:-_DAMAGED_MOST] == _DAMAGED_MOST).any():
            return none
        found.append(rows)
    damaged = np.concatenate(found)
    left = np.diff(np.delete(time, damaged))
    sound = left.size > 0 and bool((left > 0.0).all() if strict else (left >= 0.0).all())
    return damaged if sound and few(damaged.size, time.size) else none


def _rising(values: list[float], strict: bool) -> list[int]:
    """Places of the longest subsequence that rises, or does not fall."""
    ends: list[float] = []
    at: list[int] = []
    before: list[int] = []
    for place, value in enumerate(values):
        k = bisect_left(ends, value) if strict else bisect_right(ends, value)
        before.append(at[k - 1] if k else -1)
        ends[k : k + 1], at[k : k + 1] = [value], [place]
    found = at[-1:]
    while before[found[-1]] >= 0:
        found.append(before[found[-1]])
    return found[::-1]


def _repeats_often(repeats: NDArray[np.bool_]) -> bool:
    """Whether stamps are coarser than the sampling interval: repeats bool[n - 1] are no fault then."""
    rows = repeats.size + 1
    return rows >= _REPEATS_FROM and int(np.count_nonzero(repeats)) >= _REPEATS_LEAST * rows


def has_own_clock(rows: NDArray[np.int64]) -> bool:
    """Whether the samples in these rows of a table are a slower channel's, or another sensor's between them."""
    if rows.size < 3:
        return False
    steps = np.diff(rows)
    middle = float(np.median(steps))
    near = np.abs(steps - middle) <= _OWN_NEAR * middle
    return middle >= 2.0 and float(near.mean()) >= _OWN_SHARE


def clock_of_rows(rows: NDArray[np.int64], rate: float) -> Clock:
    """The clock of samples in these rows of a table without stamps, whose rows come at `rate`, Hz."""
    every = max(1, round(float(np.median(np.diff(rows))))) if has_own_clock(rows) else 1
    place = np.rint((rows - rows[0]) / every).astype(np.int64)
    return Clock(rate / every, np.maximum(np.diff(place, prepend=-1) - 1, 0), None, float(rows[0]) / rate)


def clock_of(
    path: object, time: NDArray[np.float64], noise_s: float, rate: float | None, fail: Fail
) -> Clock:
    """The clock of stamps [n], s from the first row of the recording. `noise_s`: their rounding. `rate`: as the user
    states it. Raises UserError, by `fail` for a row."""
    start = float(time[0])
    if not time[-1] <= LONGEST_S:
        _too_long(time, fail)
    time = time - start if start else time
    found, missing = _sampling(path, time, noise_s, rate, fail)
    lossy = 2 * np.count_nonzero(missing) > missing.size
    if rate is not None and (not 0.9 < found / rate < 1.1 or (lossy and not thinned_grid(time, 1.0 / rate))):
        raise _disagrees(path, rate)
    rate = found if rate is None else rate
    if not LEAST_RATE_HZ <= rate <= MOST_RATE_HZ:
        what = f"not {LEAST_RATE_HZ:g} to {MOST_RATE_HZ:g}: is the unit of t right?"
        raise UserError(f"{path}: column 't': a sampling rate of {rate:g} Hz, {what}")
    if time[-1] * rate >= LONGEST:
        _too_long(time, fail)
    grid = Clock(rate, missing, start_s=-missing[0] / rate).time_s
    off_grid = np.subtract(time, grid, out=grid)
    return Clock(rate, missing, off_grid, start)


def _sampling(
    path: object, time: NDArray[np.float64], noise_s: float, rate: float | None, fail: Fail
) -> tuple[float, NDArray[np.int64]]:
    """Rate in Hz and missing_before[n] of stamps [n], s from 0."""
    steps = np.diff(time)
    if steps.min() < 0.0:
        row = int(next(iter(damaged_stamps(time)), np.argmax(steps < 0.0) + 1))
        early = row > 0 and time[row] <= time[row - 1]
        fail(row, "time runs backwards" if early else "the time stamp is later than the next one")
    repeats = steps == 0.0
    if repeats.any() and (not _repeats_often(repeats) or repeats.all()):
        fail(int(np.argmax(repeats)) + 1, "the time stamp repeats")
    try:
        dt, missing = sampling(time, noise_s, rate)
    except Ambiguous as error:
        raise UserError(f"{path}: column 't': {error}: give --rate HZ") from error
    if repeats.any() and dt > 0.999 * float(steps[~repeats].min()):  # not for being coarse
        fail(int(np.argmax(repeats)) + 1, "the time stamp repeats")
    if not 0.0 < dt < math.inf:
        raise UserError(f"{path}: column 't' makes no even grid: is it the time?")
    if rate is not None and on_other_grid(time, 1.0 / rate, missing):
        raise _disagrees(path, rate)
    return float(f"{1.0 / dt:.10g}"), missing


def _too_long(time: NDArray[np.float64], fail: Fail) -> NoReturn:
    steps = np.diff(time, prepend=0.0)
    row = int(np.argmax(steps))
    what = f"a recording spans at most {LONGEST_S:g} s, and {LONGEST:.2g} samples: leave the row out"
    fail(row, f"the time stamp is {steps[row]:.3g} s after the one before: {what}")


def _disagrees(path: object, rate: float) -> UserError:
    return UserError(f"{path}: column 't' does not agree with --rate {rate:g}: leave it out with --no-time")
