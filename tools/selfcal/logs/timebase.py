"""The clock of a recording's columns: from time stamps, or from the places of their samples, to an even grid with gaps.

Stamps may be coarse or fine (`sampling.py`), come in bursts, or be those of a 32-bit counter that wraps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import NoReturn

import numpy as np

from selfcal.base.errors import UserError
from selfcal.base.grid import Array, Rows
from selfcal.base.limits import LEAST_RATE_HZ, LONGEST_S, LONGEST_SAMPLES, MOST_RATE_HZ
from selfcal.logs.order import broken, mends
from selfcal.logs.sampling import (
    ONE_INSTANT,
    SAME_INTERVAL,
    Ambiguous,
    common_step,
    in_pattern,
    in_rhythm,
    rate_changes,
    rhythm,
    sampling,
)

#: Largest difference of the stamps' rate from a stated rate, as a share. A lattice of stamps that agrees so with the
#: interval may be the interval, of which samples are lost.
_AGREES = 0.1
#: Spread of the steps between stamps, in intervals, from which on they lie on no grid: jitter of 0.2 makes 0.28.
_NO_GRID = 0.3
#: Most samples in a period of losses, and most changes of the rate, that a line states.
_OF_LOSSES, _IN_WORDS = 100, 3
#: The way on for stamps of no use.
AS_THEY_COME = "--no-time --rate HZ takes the rows of one file as they come"

#: Raises UserError for a row and what is wrong there.
Fail = Callable[[int, str], NoReturn]


@dataclass(frozen=True)
class Clock:
    """When n samples were taken: an even grid of `rate_hz` that begins `start_s` after the recording does.

    `missing_before` int64[n]: samples missing just before each. `off_grid_s` float64[n]: stamp minus grid, s; None
    without stamps. `moving_before` int64[n]: how many of the missing samples were measured, and left out for motion;
    None: 0. `moving` counts all samples left out for motion, those beyond either end too.
    """

    rate_hz: float
    missing_before: Rows
    off_grid_s: Array | None = None
    start_s: float = 0.0
    moving_before: Rows | None = None
    moving: int = 0

    @property
    def lost_before(self) -> Rows:
        """int64[n]: samples just before each that were never measured."""
        return self.missing_before if self.moving_before is None else self.missing_before - self.moving_before

    @property
    def place(self) -> Rows:
        """int64[n]: place on the grid of each sample, the missing ones counted."""
        place = np.cumsum(self.missing_before)
        place += np.arange(place.size)
        return place

    @property
    def time_s(self) -> Array:
        """float64[n]: time of each sample on the grid since the recording's first, s."""
        time = self.place / self.rate_hz
        time += self.start_s
        return time

    def of_rows(self, rows: Rows, begin_s: float, *, moving: bool = False) -> Clock:
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
        """Whether both are the same clock."""
        return (
            abs(self.rate_hz / other.rate_hz - 1.0) < SAME_INTERVAL
            and abs(self.start_s - other.start_s) * self.rate_hz < ONE_INSTANT
            and np.array_equal(self.missing_before, other.missing_before)
        )


def has_own_clock(rows: Rows) -> bool:
    """Whether the samples in these rows of a table are a slower channel's, or another sensor's between them."""
    return rhythm(np.diff(rows))[0] > 0.0


def clock_of_rows(rows: Rows, rate: float) -> Clock:
    """The clock of samples in these rows of a table without stamps, whose rows come at `rate`, Hz."""
    nats, period = rhythm(np.diff(rows))
    period = period if nats > 0.0 else 1.0
    missing = np.maximum(np.rint(np.diff(rows, prepend=rows[0] - period) / period).astype(np.int64) - 1, 0)
    return Clock(rate / period, missing, None, float(rows[0]) / rate)


def clock_of(path: object, time: Array, noise_s: float, rate: float | None, fail: Fail) -> Clock:
    """The clock of stamps [n], s from the first row of the recording. `noise_s`: their rounding. `rate`: as the user
    states it. Raises UserError, by `fail` for a row."""
    start = float(time[0])
    if not time[-1] <= LONGEST_S:
        _too_long(time, fail)
    time = time - start if start else time
    sampled_hz, missing = _sampling(path, time, noise_s, rate, fail)
    if rate is not None and not abs(sampled_hz / rate - 1.0) < _AGREES:
        raise UserError(f"{path}: column 't' does not agree with --rate {rate:g}: leave it out with --no-time")
    rate = sampled_hz if rate is None else rate
    if not LEAST_RATE_HZ <= rate <= MOST_RATE_HZ:
        what = f"not {LEAST_RATE_HZ:g} to {MOST_RATE_HZ:g}: is the unit of t right?"
        raise UserError(f"{path}: column 't': a sampling rate of {rate:g} Hz, {what}")
    if time[-1] * rate >= LONGEST_SAMPLES:
        _too_long(time, fail)
    grid = Clock(rate, missing, start_s=-missing[0] / rate).time_s
    off_grid = np.subtract(time, grid, out=grid)
    return Clock(rate, missing, off_grid, start)


def _sampling(path: object, time: Array, noise_s: float, rate: float | None, fail: Fail) -> tuple[float, Rows]:
    """Rate in Hz and missing_before[n] of stamps [n], s from 0."""
    fault = broken(time)
    if fault is not None:
        fail(fault[0], f"{fault[1]}: {_ways(time)}")
    steps = np.diff(time)
    repeats = steps == 0.0
    try:
        dt, missing = sampling(time, noise_s, rate)
    except Ambiguous as error:
        way = f"{AS_THEY_COME}, where they are even" if (steps < 0.0).any() else "give --rate HZ"
        raise UserError(f"{path}: column 't': {error}: {way}") from error
    if repeats.any() and dt > 0.999 * float(steps[steps > 0.0].min()):  # not for being coarse
        fail(int(np.argmax(repeats)) + 1, f"the time stamp repeats: {_ways(time)}")
    if not 0.0 < dt < math.inf:
        raise UserError(f"{path}: column 't' makes no even grid: is it the time?")
    return float(f"{1.0 / dt:.10g}"), missing


def remarks(clock: Clock) -> list[str]:
    """A line on stamps that another clock explains as well, or that show no lost sample."""
    rate, missing, off_grid = clock.rate_hz, clock.missing_before, clock.off_grid_s
    if off_grid is None:
        return []
    time = clock.time_s + off_grid
    steps = np.diff(time)
    lattice = common_step(steps, 1e-9 / rate)
    gaps = np.flatnonzero(missing)
    regular = in_rhythm(gaps) or in_pattern(np.add(missing, 1.0))
    changes = rate_changes(time)
    if changes and not (regular and np.ptp(gaps) > (1.0 - _AGREES) * time.size):  # else of a part
        after = ", ".join(
            f"{change.after_hz:.5g} Hz from {time[change.row]:.6g} s on" for change in changes[:_IN_WORDS]
        )
        return [f"the sampling rate changes: {changes[0].before_hz:.5g} Hz, {after}"]
    if regular:
        lost, every, words = _losses(float(np.mean(missing[gaps[0] + 1 : gaps[-1] + 1])) + 1.0)
        other = float(f"{rate - rate * lost / every:.6g}")
        words = f"{words} {'are' if lost > 1 else 'is'} missing, at regular intervals"
        alike = lattice * rate > 1.0 - _AGREES and np.ptp(time - np.arange(time.size) / other) * other < 1.0
        return [words + (f": a slower sensor's stamps are alike: --rate {other:g} states that" if alike else "")]
    if gaps.size:
        return []
    if 0.0 < lattice * rate < 1.0 - SAME_INTERVAL and steps.min() > 0.5 * lattice:
        turns = np.rint(steps / lattice)
        if turns.min() == 1.0 and (lattice * rate > 1.0 - _AGREES or in_pattern(turns)):
            other = float(f"{1.0 / lattice:.6g}")
            words = f"stamps of {lattice:.4g} s: {other:g} Hz that loses {_losses(float(turns.mean()))[2]} has the same"
            return [f"{words}: --rate {other:g} states that"]
    if np.ptp(off_grid) * rate <= 1.0 or float(np.diff(off_grid).std()) * rate <= _NO_GRID:
        return []
    words = f"the stamps lie on no grid: their mean rate, {rate:.4g} Hz, is taken; no lost sample shows"
    return [f"{words}: --rate HZ states another"]


def _losses(step: float) -> tuple[int, int, str]:
    """Samples lost, of how many, and the words, where the mean step is `step` intervals."""
    share = Fraction(1.0 - 1.0 / step).limit_denominator(_OF_LOSSES)
    lost, every = share.numerator, share.denominator
    return lost, every, f"{lost} sample{'s' * (lost > 1)} in {every}"


def _ways(time: Array) -> str:
    """What to type for stamps that are out of order."""
    return f"--skip-bad mends such rows and counts them; {AS_THEY_COME}" if mends(time) else AS_THEY_COME


def _too_long(time: Array, fail: Fail) -> NoReturn:
    steps = np.diff(time, prepend=0.0)
    row = int(np.argmax(steps))
    what = f"a recording spans at most {LONGEST_S:g} s, and {LONGEST_SAMPLES:.2g} samples: leave the row out"
    fail(row, f"the time stamp is {steps[row]:.3g} s after the one before: {what}")
