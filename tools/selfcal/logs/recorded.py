"""A recording: columns on clocks, as a value for all later steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.base.grid import Array, Mask, Rows
from selfcal.base.limits import FEWEST_ROWS, LONGEST_S
from selfcal.logs.loaders.damage import SOUND, Damaged
from selfcal.logs.timebase import Clock

#: Columns that are no axis but may explain an axis, by cause: name and unit.
SIDE_CHANNELS = MappingProxyType({"temperature": ("temp", "degC"), "supply": ("supply", "V")})
#: Their units, by name.
SIDE_UNITS = MappingProxyType(dict(SIDE_CHANNELS.values()))


@dataclass(frozen=True)
class Column:
    """A column: `values` float64[n] in `unit`, n the samples of its `clock`, by default the recording's.

    An axis is NaN where it has no sample and another axis has; all other values are finite.
    """

    name: str
    unit: str
    values: Array
    clock: Clock | None = None


@dataclass(frozen=True, repr=False)
class Recording:
    """A checked recording of n rows. `missing_before` int64[n]: samples missing just before each row.

    `off_grid_s` float64[n]: time stamp minus the even grid's, s; None without stamps. `start_s`: where in the file's
    recording the first row is, s. `since_power_on_s`: from power-on to the file's first row, s. `moving_before`,
    `moving`: samples left out for motion (`Clock`). `started_s`: the first stamp, s. `notes`: what a reader of the
    results must know of the file, a line each.
    """

    path: Path
    rate_hz: float
    columns: Mapping[str, Column]
    missing_before: Rows
    meta: Mapping[str, Any]
    off_grid_s: Array | None = None
    start_s: float = 0.0
    moving_before: Rows | None = None
    moving: int = 0
    started_s: float | None = None
    since_power_on_s: float = 0.0
    notes: tuple[str, ...] = ()
    #: Damage: parts of the files that could not be read.
    damaged: Damaged = SOUND
    #: The files, where there are several: `path` has them all for messages.
    paths: tuple[Path, ...] = ()
    #: Options of the command line that it was read with, and their values, empty for a switch.
    options: tuple[tuple[str, str], ...] = ()
    #: The recording of readings in memory: recording.py.
    from_arrays: ClassVar[Callable[..., Recording]]

    def __repr__(self) -> str:
        columns = ", ".join(f"{column.name}[{column.unit}]" for column in self.columns.values())
        return f"<Recording {self.path}: {self.samples} rows at {self.rate_hz:g} Hz, {self.duration_s:g} s: {columns}>"

    @property
    def samples(self) -> int:
        """Rows present."""
        return int(self.missing_before.size)

    @property
    def duration_s(self) -> float:
        """Length with the missing samples, s."""
        return (self.samples + int(self.missing_before.sum())) / self.rate_hz

    @property
    def powered(self) -> int:
        """Samples from power-on to the first row."""
        return round((self.since_power_on_s + self.start_s) * self.rate_hz)

    @cached_property
    def seen(self) -> dict[Any, Any]:
        """What is known of its readings, once they were looked at (readings/)."""
        return {}

    @property
    def lost(self) -> int:
        """Samples that were never measured."""
        return int(self.clock.lost_before.sum())

    @property
    def clock(self) -> Clock:
        """The clock of all columns that have none of their own."""
        return Clock(
            self.rate_hz, self.missing_before, self.off_grid_s, moving_before=self.moving_before, moving=self.moving
        )

    @property
    def time_s(self) -> Array:
        """float64[n]: time since the first row on the even grid of the sampling rate, s."""
        return self.clock.time_s

    def clock_of(self, name: str) -> Clock:
        """The clock of a column."""
        return self.columns[name].clock or self.clock

    def with_rows(self, kept: Mask, *, moving: bool = False) -> Recording:
        """The recording of the rows `kept` [n] alone, two or more. The others count as missing, and as `moving` where
        that is why they are left out. Rows before the first and after the last that is kept are cut off."""
        on_grid = self.clock.place
        where = np.flatnonzero(kept)
        begin_s = float(on_grid[where[0]] - on_grid[0]) / self.rate_hz
        clock = self.clock.of_rows(where, begin_s, moving=moving)

        def left(column: Column) -> Column:
            """An axis with a clock of its own keeps the samples that the row before them keeps."""
            if column.clock is None:
                return replace(column, values=column.values[kept])
            time = column.clock.time_s
            rows = np.clip(np.searchsorted(self.time_s, time, side="right") - 1, 0, self.samples - 1)
            own = np.flatnonzero(kept[rows] & (rows >= where[0]) & (time < self.time_s[where[-1]] + 1.0 / self.rate_hz))
            return replace(column, values=column.values[own], clock=column.clock.of_rows(own, begin_s, moving=moving))

        return replace(
            self,
            columns={name: left(column) for name, column in self.columns.items()},
            missing_before=clock.missing_before,
            off_grid_s=clock.off_grid_s,
            start_s=self.start_s + begin_s,
            moving_before=clock.moving_before,
            moving=clock.moving,
        )

    def later(self, since_power_on_s: float) -> Recording:
        """The recording with its distance from power-on, s. Raises UserError for an invalid time."""
        if not 0.0 <= since_power_on_s <= LONGEST_S:
            raise UserError(
                f"--since-power-on {since_power_on_s:g}: takes the seconds from power-on to the recording's beginning, "
                f"0 to {LONGEST_S:g}"
            )
        return replace(self, since_power_on_s=since_power_on_s)

    def between(self, start_s: float | None, end_s: float | None) -> Recording:
        """The stretch from `start_s` on and before `end_s`, seconds of the recording. Raises UserError for an empty
        stretch, and for a stretch outside."""
        if start_s is None and end_s is None:
            return self
        for option, value in (("--start", start_s), ("--end", end_s)):
            if value is not None and not value >= 0.0:  # or not a number
                raise UserError(
                    f"{option} {value:g}: takes seconds from the beginning of the recording, 0 or more; {self.path} "
                    f"lasts {self.duration_s:.6g} s"
                )
        first, last = 0.0 if start_s is None else start_s, math.inf if end_s is None else end_s
        if not first < last:
            raise UserError(f"--start {first:g} --end {last:g}: the start must lie before the end")
        kept = (self.time_s >= first) & (self.time_s < last)
        if np.count_nonzero(kept) < FEWEST_ROWS:
            raise UserError(
                f"{self.path}: --start {first:g} --end {last:g}: fewer than two samples there; the recording lasts "
                f"{self.duration_s:.6g} s"
            )
        return self.with_rows(kept)

    def without(self, moved: Sequence[Sequence[float]]) -> Recording:
        """The recording without stretches of motion, each from and before a time, seconds of the recording."""
        if not moved:
            return self
        time, half = self.start_s + self.time_s, 0.5 / self.rate_hz
        kept = np.ones(self.samples, bool)
        for begin_s, end_s in moved:
            kept &= (time < begin_s - half) | (time > end_s - half)
        return self.with_rows(kept, moving=True)

    def in_unit(self, name: str, unit: str) -> Array:
        """float64[n]: a column in `unit`. Raises UserError if it is absent or of another kind."""
        if name not in self.columns:
            raise UserError(f"{self.path}: there is no column '{name}' (there are {', '.join(self.columns)})")
        column = self.columns[name]
        if not units.same_kind(column.unit, unit):
            raise UserError(f"{self.path}: column '{name}' is in {column.unit}, which cannot be converted to {unit}")
        return units.converted(column.values, column.unit, unit)

    def along(self, *names: str) -> Recording:
        """The recording by the clock of these axes: its rows are those in which any of them has a sample.

        A row without a sample is missing. All other columns are bridged by straight lines where they have no sample.
        Raises UserError for axes of several clocks.
        """
        own = {id(self.columns[name].clock) for name in names}
        if len(own) > 1:
            rates = ", ".join(f"{name} {self.clock_of(name).rate_hz:g} Hz" for name in names)
            raise UserError(f"{self.path}: axes of several sampling rates ({rates}): choose those of one with --axis")
        clock = self.clock_of(names[0])
        used = np.logical_or.reduce([np.isfinite(self.columns[name].values) for name in names])
        own_clock = self.columns[names[0]].clock
        others = [column for name, column in self.columns.items() if name not in names]
        if used.all() and all(column.clock is own_clock and np.isfinite(column.values).all() for column in others):
            columns = self.columns
        else:
            time = clock.time_s[used]
            columns = {
                name: replace(column, values=column.values[used])
                if name in names or (column.clock is own_clock and np.isfinite(column.values).all())
                else replace(column, values=bridged_at(self.clock_of(name), column.values, time), clock=own_clock)
                for name, column in self.columns.items()
            }
        if own_clock is None and used.all():
            return self if columns is self.columns else replace(self, columns=columns)
        own_rows = clock.of_rows(np.flatnonzero(used), 0.0)
        missing = own_rows.missing_before
        missing[0] = int(clock.place[np.argmax(used)])
        return replace(
            self,
            rate_hz=clock.rate_hz,
            columns={name: replace(column, clock=None) for name, column in columns.items()},
            missing_before=missing,
            off_grid_s=own_rows.off_grid_s,
            moving_before=own_rows.moving_before,
            moving=own_rows.moving,
        )


def bridged_at(clock: Clock, values: Array, time: Array) -> Array:
    """float64[n]: values of a clock at the times [n], s, by straight lines."""
    known = np.isfinite(values)
    return np.interp(time, clock.time_s[known], values[known])


def bridged(values: Array, time: Array | None = None) -> Array:
    """Missing values by straight lines over `time`, by default over the samples; as they are where all are missing."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return values
    time = np.arange(float(values.size)) if time is None else time
    return np.interp(time, time[known], values[known])


def as_float(values: Array) -> NDArray[np.float32]:
    """As the firmware gets them: what float32 cannot hold becomes infinite and is kept out."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
