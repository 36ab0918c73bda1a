"""Recordings of a resting sensor: read, check, and write. The formats are read by `loaders/`.

Text has one header row of `name[unit]`. An npz has one 1-D array a column, named like the header, or named plainly
with unit and LSB in a JSON text `meta`: {"rate_hz": 100.0, "columns": {"gx": {"unit": "deg/s", "lsb": 0.05}}}. A text
file may have such a text beside it, LOG.meta.json. Every fault raises UserError with file, line and column in one line.
"""

from __future__ import annotations

import gzip
import json
import math
import re
import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from selfcal.base import units
from selfcal.base.errors import UserError, cell, note, short, shown
from selfcal.base.limits import (
    LEAST_RATE_HZ,
    LONGEST_HEADING,
    LONGEST_S,
    MOST_CLOCKS,
    MOST_HEADINGS,
    MOST_META_BYTES,
    MOST_NUMBERS,
    MOST_RATE_HZ,
    read_text,
    reading,
)
from selfcal.base.options import Scale
from selfcal.base.output import together, whole
from selfcal.base.units import SENSORS
from selfcal.logs import written
from selfcal.logs.loaders import WRITTEN, check_library, format_of
from selfcal.logs.loaders.child import tables_of
from selfcal.logs.loaders.damage import SOUND, Damaged, bytes_of
from selfcal.logs.loaders.headings import Meaning, Sensor, number_of, sensors_of, sides_of, split
from selfcal.logs.loaders.sources import Part, chosen
from selfcal.logs.loaders.table import Hints, Member, Table, parse_meta
from selfcal.logs.loaders.text_table import TextTable, is_clock, is_date, is_row
from selfcal.logs.loaders.texts import Text, texts_in
from selfcal.logs.timebase import Clock, clock_of, clock_of_rows, damaged_stamps, few, has_own_clock, unwrapped

#: Spread of the steps between stamps, in intervals, from which on they lie on no grid: jitter of 0.2 makes 0.28.
_NO_GRID = 0.3
#: s from power-on to a recording's beginning, at most: a year.
LONGEST_POWERED_S = 3.2e7
#: Columns that are no axis but may explain one, by cause: name and unit.
SIDE_CHANNELS = MappingProxyType({"temperature": ("temp", "degC"), "supply": ("supply", "V")})
#: Unit of a scaled LSB column where the scale states none.
_LSB_UNITS = {name: {"g": "deg/s", "a": "m/s^2"}[name[0]] for name in SENSORS}
#: Where a sensor's axes stand at rest, 1 g is so long in these units; the share that it may be off, the share of the
#: record that rests, and the seconds of a mean.
_GRAVITY = {"g": 1.0, "mg": 1000.0, "m/s^2": units.STANDARD_GRAVITY, "mm/s^2": 1000.0 * units.STANDARD_GRAVITY}
_GRAVITY_OFF, _AT_REST, _GRAVITY_S = 0.05, 0.9, 1.0
#: What to type where no heading is a sensor's.
_NAME_YOURS = "name yours with --column gx=NAME, and --unit gx=UNIT where its heading has none"
#: Columns without a unit that begin with a whole number, from which on they may be counts.
_COUNTS_FROM = 3

#: Lines that are written at once; signs that separate columns, and so are none of a heading.
_LINES, _SIGNS = 10_000, re.compile(r'[,;\t"]')

#: Raises UserError for a row (from 0), a field (by its place; None: the whole row) and what is wrong there.
_Fail = Callable[[int, int | None, str], NoReturn]


@dataclass(frozen=True)
class Column:
    """One column: `values` float64[n] in `unit`, n the samples of its `clock`, by default the recording's.

    An axis is NaN where it has no sample and another axis has; all other values are finite.
    """

    name: str
    unit: str
    values: NDArray[np.float64]
    clock: Clock | None = None


@dataclass(frozen=True)
class Recording:
    """A checked recording of n rows. `missing_before` int64[n]: samples missing just before each row.

    `off_grid_s` float64[n]: time stamp minus the even grid's, s; None without stamps. `start_s`: where in the file's
    recording the first row is, s. `since_power_on_s`: from power-on to the file's first row, s. `moving_before`,
    `moving`: samples left out for motion (`Clock`). `started_s`: the first stamp, s. `notes`: what a reader of the
    results must know of the file, one line each.
    """

    path: Path
    rate_hz: float
    columns: Mapping[str, Column]
    missing_before: NDArray[np.int64]
    meta: Mapping[str, Any]
    off_grid_s: NDArray[np.float64] | None = None
    start_s: float = 0.0
    moving_before: NDArray[np.int64] | None = None
    moving: int = 0
    started_s: float | None = None
    since_power_on_s: float = 0.0
    notes: tuple[str, ...] = ()
    #: What of the files could not be read.
    damaged: Damaged = SOUND
    #: The files, where there are several: `path` has them all for messages.
    paths: tuple[Path, ...] = ()
    #: Options of the command line that it was read with, and their values, empty for a switch.
    options: tuple[tuple[str, str], ...] = ()

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
    def motion_seen(self) -> dict[str, Any]:
        """By axis its motion, once it was looked at (readings/motion.py)."""
        return {}

    @property
    def lost(self) -> int:
        """Samples that were never measured."""
        return int(self.clock.lost_before.sum())

    @property
    def clock(self) -> Clock:
        """The clock of all columns that have none of their own."""
        return Clock(
            self.rate_hz,
            self.missing_before,
            self.off_grid_s,
            moving_before=self.moving_before,
            moving=self.moving,
        )

    @property
    def time_s(self) -> NDArray[np.float64]:
        """float64[n]: time since the first row on the even grid of the sampling rate, s."""
        return self.clock.time_s

    def clock_of(self, name: str) -> Clock:
        """The clock of a column."""
        return self.columns[name].clock or self.clock

    def with_rows(self, kept: NDArray[np.bool_], *, moving: bool = False) -> Recording:
        """The recording of the rows `kept` [n] alone, two or more. The others count as missing, and as `moving` where
        that is why they are left out. Rows before the first and after the last that is kept are cut off."""
        at = self.clock.place
        where = np.flatnonzero(kept)
        begin_s = float(at[where[0]] - at[0]) / self.rate_hz
        clock = self.clock.of_rows(where, begin_s, moving=moving)

        def left(one: Column) -> Column:
            """An axis with a clock of its own keeps the samples that the row before them keeps."""
            if one.clock is None:
                return replace(one, values=one.values[kept])
            time = one.clock.time_s
            rows = np.clip(np.searchsorted(self.time_s, time, side="right") - 1, 0, self.samples - 1)
            own = np.flatnonzero(kept[rows] & (rows >= where[0]) & (time < self.time_s[where[-1]] + 1.0 / self.rate_hz))
            return replace(one, values=one.values[own], clock=one.clock.of_rows(own, begin_s, moving=moving))

        return replace(
            self,
            columns={name: left(one) for name, one in self.columns.items()},
            missing_before=clock.missing_before,
            off_grid_s=clock.off_grid_s,
            start_s=self.start_s + begin_s,
            moving_before=clock.moving_before,
            moving=clock.moving,
        )

    def later(self, since_power_on_s: float) -> Recording:
        """The recording with its distance from power-on, s. Raises UserError for one that is none."""
        if not 0.0 <= since_power_on_s <= LONGEST_POWERED_S:
            raise UserError(
                f"--since-power-on {since_power_on_s:g}: takes the seconds from power-on to the recording's beginning, "
                f"0 to {LONGEST_POWERED_S:g}"
            )
        return replace(self, since_power_on_s=since_power_on_s)

    def between(self, start_s: float | None, end_s: float | None) -> Recording:
        """The stretch from `start_s` on and before `end_s`, seconds of the recording. Raises UserError for an empty
        one, and for one that lies outside."""
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
        if np.count_nonzero(kept) < 2:
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

    def in_unit(self, name: str, unit: str) -> NDArray[np.float64]:
        """float64[n]: a column in `unit`. Raises UserError if it is absent or of another kind."""
        if name not in self.columns:
            raise UserError(f"{self.path}: there is no column '{name}' (there are {', '.join(self.columns)})")
        column = self.columns[name]
        if not units.same_kind(column.unit, unit):
            raise UserError(f"{self.path}: column '{name}' is in {column.unit}, which cannot be converted to {unit}")
        return units.convert(column.values, column.unit, unit)

    def along(self, *names: str) -> Recording:
        """The recording by the clock of these axes: its rows are those in which one of them has a sample.

        A row without one is missing. All other columns are bridged by straight lines where they have no sample.
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
        if used.all() and all(one.clock is own_clock and np.isfinite(one.values).all() for one in others):
            columns = self.columns
        else:
            time = clock.time_s[used]
            columns = {
                name: replace(one, values=one.values[used])
                if name in names or (one.clock is own_clock and np.isfinite(one.values).all())
                else replace(one, values=_bridged(self.clock_of(name), one.values, time), clock=own_clock)
                for name, one in self.columns.items()
            }
        if own_clock is None and used.all():
            return self if columns is self.columns else replace(self, columns=columns)
        own_rows = clock.of_rows(np.flatnonzero(used), 0.0)
        missing = own_rows.missing_before
        missing[0] = int(clock.place[np.argmax(used)])
        return replace(
            self,
            rate_hz=clock.rate_hz,
            columns={name: replace(one, clock=None) for name, one in columns.items()},
            missing_before=missing,
            off_grid_s=own_rows.off_grid_s,
            moving_before=own_rows.moving_before,
            moving=own_rows.moving,
        )


def _bridged(clock: Clock, values: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float64]:
    """float64[n]: values of a clock at the times [n], s, by straight lines."""
    known = np.isfinite(values)
    return np.interp(time, clock.time_s[known], values[known])


def bridged(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Missing values by straight lines."""
    good = np.isfinite(values)
    if good.all():
        return values
    where = np.arange(values.size)
    return np.interp(where, where[good], values[good])


def as_float(values: NDArray[np.float64]) -> NDArray[np.float32]:
    """As the firmware gets them: what float32 cannot hold becomes infinite and is kept out."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


@dataclass(frozen=True)
class _Field:
    """A column to be read: key in the file, name and unit here, size of its LSB (1 if it is in the unit itself)."""

    key: str
    name: str
    unit: str
    lsb: float
    #: Nobody asked for it: a fault of it leaves it out.
    optional: bool = False
    #: Its cells are dates.
    dates: bool = False


def load(
    path: Path | str | Sequence[Path | str],
    rate: float | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    scale: Mapping[str, Scale] | float | None = None,
    sensors: Collection[str] = SENSORS,
    *,
    no_time: bool = False,
    skip_bad: bool = False,
    sources: Sequence[str] = (),
    dbc: Path | str | None = None,
) -> Recording:
    """Read a recording; of several files, or sensors of a log, one, joined by their time stamps.

    `rate`, Hz: needed without a `t` column; with one it must agree with it to 10 % and is taken as the true rate.
    `columns`: name here -> header in the file. `units`: name here -> unit; it takes the header's place.
    `scale`: size of one LSB, for all LSB columns or by name, with its unit (default deg/s for g*, m/s^2 for a*).
    `sensors`: columns of which at least one must be there. A column that is none of these, nor temperature or supply,
    is left out if it cannot be read.
    `no_time`: the time column is not read. `skip_bad`: lines of a text that are no row are left out and counted.
    `sources`: names of the sensors to read of a log that has several, or one name. `dbc`: what decodes CAN frames.
    The recording's `notes` are printed on stderr.
    Raises UserError for any file that is not a sound recording, or is larger than `limits.py` says. O(n); about 2 s
    for 10^6 CSV rows of 7 columns.
    """
    paths = list_of(path)
    columns, units = columns or {}, units or {}
    sources = [sources] if isinstance(sources, str) else sources
    by_name: Mapping[str, Scale] = {"": (float(scale), None)} if isinstance(scale, int | float) else scale or {}
    if rate is not None and not LEAST_RATE_HZ <= rate <= MOST_RATE_HZ:
        raise UserError(f"the rate must be above 0 Hz ({LEAST_RATE_HZ:g} to {MOST_RATE_HZ:g} Hz), not {rate:g}")
    if len(paths) > 1 and (rate is not None or no_time):
        raise UserError("several files are joined by their time stamps: leave --rate and --no-time out")
    hints = {} if dbc is None else {"dbc": str(dbc)}
    headers = [_Header(one, columns, units, by_name, sensors, no_time) for one in paths]
    for header in headers:
        header.several = len(paths) > 1
    found = [
        part
        for one, header in zip(paths, headers, strict=True)
        for part in _load(one, rate, header, skip_bad, sources, hints)
    ]
    recording = found[0] if len(found) == 1 else _joined(paths, found, headers[0])
    _check_gravity(recording, headers[0])
    recording = replace(
        recording,
        notes=tuple(dict.fromkeys((*recording.notes, *_rates(recording)))),
        options=_options(rate, columns, units, by_name, no_time, skip_bad, sources, dbc),
    )
    for text in recording.notes:
        note(f"{recording.path}: {text}")
    return recording


def _options(
    rate: float | None,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    scale: Mapping[str, Scale],
    no_time: bool,
    skip_bad: bool,
    sources: Sequence[str],
    dbc: Path | str | None,
) -> tuple[tuple[str, str], ...]:
    """How a recording is read, as the command line says it."""
    given = [] if rate is None else [("--rate", f"{rate:.15g}")]
    for option, pairs in (("--column", columns), ("--unit", units)):
        given += [(option, f"{name}={value}") for name, value in pairs.items()]
    for name, (size, unit) in scale.items():
        text = f"{size:.15g}" + ("" if unit is None else f"[{unit}]")
        given.append(("--scale", f"{name}={text}" if name else text))
    given += [("--source", name) for name in sources]
    given += [] if dbc is None else [("--dbc", str(dbc))]
    given += [(option, "") for option, wanted in (("--no-time", no_time), ("--skip-bad", skip_bad)) if wanted]
    return tuple(given)


def list_of(paths: Path | str | Sequence[Path | str]) -> list[Path]:
    """The files of a recording."""
    return [Path(paths)] if isinstance(paths, Path | str) else [Path(one) for one in paths]


def _load(
    path: Path, rate: float | None, header: _Header, skip_bad: bool, wanted: Sequence[str], hints: Hints
) -> list[Recording]:
    """The sensors of one file that are meant, and the temperatures beside them, each by its own clock."""
    with reading(path, "not a sound recording"):
        form = format_of(path, frames="dbc" in hints)
        tables: list[Table] = []
        if form is None:
            parts = _text_parts(path, rate, header, skip_bad)
        else:
            check_library(path, form)
            if form.here:
                tables = import_module(f"selfcal.logs.loaders.{form.module}").read(path, hints)
            else:
                tables = tables_of(path, form, hints)
            parts = [part for table in tables for part in _table_parts(path, rate, header, table, len(tables) > 1)]
        if not parts or (len(tables) > 1 and not any(part.axes for part in parts)):
            there = ", ".join(f"{one.source}: {', '.join(one.members)}" for one in tables)
            why = next((f"; {one}" for table in tables for one in table.notes), "")
            raise UserError(
                f"{path}: no sensor column ({', '.join(header.sensors)}) among '{short(there)}'; {_NAME_YOURS}{why}"
            )
        if wanted and not any(part.source for part in parts):
            raise UserError(f"{path}: it has one source alone: leave --source out")
        found, sides, notes = chosen(path, parts, wanted)
        several = len(found) > 1
        recordings = [part.read(several, part in sides) for part in found]
    sound = [one for one in recordings if one is not None]
    damaged = sum((one.damaged for one in [*tables[:1], *sound]), SOUND)
    if damaged:
        damaged = replace(damaged, whole=damaged.whole or bytes_of(path))
        notes[:0] = [damaged.words] if tables else []  # a text's lines have lines of their own
    first = replace(sound[0], notes=(*notes, *sound[0].notes), damaged=damaged)
    return [first, *(replace(one, damaged=SOUND) for one in sound[1:])]


def _named(*names: str) -> str:
    return "/".join(name for name in names if name)


def _span(stamps: NDArray[Any], unit: str | None) -> tuple[int, float]:
    """Number of stamps, and the seconds that they span; of a foreign unit, 0."""
    stamps = stamps[np.isfinite(stamps)] if stamps.dtype.kind == "f" else stamps
    if not stamps.size:
        return 0, 0.0
    unit = units.plain(unit or "s")
    size = units.factor(unit, "s") if units.known(unit) and units.same_kind(unit, "s") else 0.0
    return stamps.size, float(int(stamps[-1]) - int(stamps[0]) if stamps.dtype.kind in "iu" else np.ptp(stamps)) * size


def _joined(files: Sequence[Path], found: Sequence[Recording], header: _Header) -> Recording:
    """Parts of one recording as one: the columns of the fastest sensor keep its clock, others have their own."""
    sensors = [one for one in found if not header.sensors or any(name in header.sensors for name in one.columns)]
    main = max(sensors, key=lambda one: one.rate_hz)
    paths = Path(" ".join(map(str, files)))
    header.check_options([name for one in found for name in one.columns])
    for one in found:
        if one.started_s is None or main.started_s is None:
            raise UserError(f"{one.path}: there is no time column: several files are joined by their time stamps")
        shift = one.started_s - main.started_s
        if shift > main.duration_s or -shift > one.duration_s:
            raise UserError(f"{paths}: the files do not overlap in time: are they of one recording?")
    columns: dict[str, Column] = dict(main.columns)
    notes = [*main.notes]
    for one in found:
        if one is main:
            continue
        assert one.started_s is not None and main.started_s is not None
        shift = one.started_s - main.started_s
        notes += one.notes
        clocks: dict[int, Clock] = {}
        for name, column in one.columns.items():
            side = name in dict(SIDE_CHANNELS.values())
            if name in columns and name not in header.sensors and (len(files) == 1 or not side):
                continue  # each sensor's own temperature, or a column of no meaning here
            if name in columns:
                raise UserError(f"{paths}: column '{name}' is in more than one of them")
            own = one.clock_of(name)
            clock = clocks.setdefault(id(column.clock), replace(own, start_s=own.start_s + shift))
            if clock.alike(main.clock):
                columns[name] = replace(column, clock=None)
            elif name in header.sensors:
                columns[name] = replace(column, clock=clock)
            else:
                columns[name] = replace(column, values=_bridged(clock, column.values, main.time_s), clock=None)
    return replace(
        main,
        path=paths,
        columns=columns,
        notes=tuple(dict.fromkeys(notes)),
        damaged=sum((one.damaged for one in found), SOUND),
        paths=tuple(files) if len(files) > 1 else (),
    )


def _of_clock(clock: Clock) -> list[str]:
    """A note where the stamps lie on no grid: of samples that were lost at random such a clock shows nothing."""
    if clock.off_grid_s is None or clock.missing_before.any() or clock.off_grid_s.size < 3:
        return []
    spread = float(np.diff(clock.off_grid_s).std()) * clock.rate_hz
    told = f"the stamps lie on no grid: their mean rate, {clock.rate_hz:.4g} Hz, is taken; no lost sample shows"
    told += ": --rate HZ states another"
    return [told] if spread > _NO_GRID else []


def _rates(recording: Recording) -> list[str]:
    """A line on columns that are sampled at times of their own."""
    if all(one.clock is None for one in recording.columns.values()):
        return []
    alike: dict[tuple[int, float], list[str]] = {}
    for name, one in recording.columns.items():
        alike.setdefault((id(one.clock), recording.clock_of(name).rate_hz), []).append(name)
    told = "; ".join(f"{', '.join(names)} at {rate:.6g} Hz" for (_, rate), names in alike.items())
    return [f"columns sampled at different times: {told}"]


def _check_gravity(recording: Recording, header: _Header) -> None:
    """Raise UserError for three accelerometers at rest that show 1 g of another unit than their headings'.

    Nothing is checked where the user states a unit, where `convert` wrote the table, or where gravity has the length
    of none."""
    if written.stated(recording.meta):
        return
    axes = [recording.columns[name] for name in ("ax", "ay", "az") if name in recording.columns]
    if len(axes) < 3 or any(one.unit != axes[0].unit or one.name in header.decided for one in axes):
        return
    if not units.same_kind(axes[0].unit, "m/s^2") or axes[1].clock != axes[0].clock or axes[2].clock != axes[0].clock:
        return
    block = max(1, round(recording.clock_of("ax").rate_hz * _GRAVITY_S))
    count = axes[0].values.size // block
    means = np.array([one.values[: count * block].reshape(count, block).mean(axis=1) for one in axes])
    means = means[:, np.isfinite(means).all(axis=0)]
    if not means.size:
        return
    level = np.median(means, axis=1)
    norm = float(np.linalg.norm(level))
    rests = np.linalg.norm(means - level[:, None], axis=0) < _GRAVITY_OFF * norm
    right = units.convert(1.0, "g", axes[0].unit)
    if not norm > 0.0 or rests.mean() < _AT_REST or abs(norm / right - 1.0) < _GRAVITY_OFF:
        return
    for unit, length in _GRAVITY.items():
        if abs(norm / length - 1.0) < _GRAVITY_OFF:
            typed = " ".join(f"--unit {one.name}={unit}" for one in axes)
            raise UserError(
                f"{recording.path}: ax, ay, az are in {axes[0].unit} by their headings; at rest their norm is "
                f"{norm:#.3g}, so the unit is {unit}: give {typed} (or their own unit, if it is right)"
            )


def save(
    path: Path | str,
    columns: Mapping[str, tuple[str, NDArray[np.float64]]],
    rate_hz: float,
    meta: Mapping[str, Any] | None = None,
    t: NDArray[np.float64] | None = None,
    lsb: Mapping[str, float] | None = None,
    *,
    exact: bool = False,
) -> None:
    """Write a recording that `load` reads back; the suffix (.csv, .csv.gz, .npz) chooses the form.

    `columns`: name -> (unit, float[n]); a unit "" is none. `t` float[n], s: time stamps; None is an even grid from 0.
    `meta`: JSON values, kept in the npz or beside the CSV file as LOG.meta.json. `lsb`: name -> size of one LSB in the
    column's unit: npz stores such a column as whole numbers of it. CSV values carry 9 digits, with `exact` as many as a
    float64 takes; an empty cell is NaN then. Raises UserError for an unwritable file.
    """
    path = Path(path)
    described: dict[str, Any] = {**(meta or {}), "rate_hz": float(rate_hz)}
    if path.suffix.lower() == ".npz":
        _save_npz(path, columns, described, t, lsb or {})
        return
    if not path.name.lower().endswith((".csv", ".csv.gz")):
        raise UserError(f"{path}: a written recording's name ends in {WRITTEN}")
    n = len(next(iter(columns.values()))[1])
    stamps = np.arange(n) / rate_hz if t is None else t
    values = np.column_stack([stamps, *(values for _, values in columns.values())])
    names = ",".join(["t[s]", *(_SIGNS.sub("_", cell(_heading(name, unit))) for name, (unit, _) in columns.items())])
    with together(path, meta_place(path)) as (table, beside):
        if exact:
            _save_exact(table, names, values)
        else:
            np.savetxt(table, values, fmt=["%.12g"] + ["%.9g"] * len(columns), delimiter=",", header=names, comments="")
        if meta is None:
            beside.unlink()
        else:
            beside.write_text(json.dumps({**described, "rows": len(values)}, indent=1) + "\n", encoding="utf-8")


def _heading(name: str, unit: str) -> str:
    return f"{name}[{unit}]" if unit else name


def _save_exact(place: Path, header: str, values: NDArray[np.float64]) -> None:
    """Write values [rows, columns] as CSV by their shortest texts that are read back to the bit."""
    opened = gzip.open if place.suffix == ".gz" else open
    with opened(place, "wt", encoding="utf-8") as file:
        file.write(f"{header}\n")
        for begin in range(0, len(values), _LINES):
            lines = values[begin : begin + _LINES].tolist()
            file.writelines(
                ",".join("" if math.isnan(cell) else repr(cell).removesuffix(".0") for cell in line) + "\n"
                for line in lines
            )


def _save_npz(
    path: Path,
    columns: Mapping[str, tuple[str, NDArray[np.float64]]],
    described: dict[str, Any],
    t: NDArray[np.float64] | None,
    lsb: Mapping[str, float],
) -> None:
    """Write the columns, whole numbers of an LSB where `lsb` has its size, and `described` as the member `meta`."""
    arrays: dict[str, NDArray[Any]] = {} if t is None else {"t[s]": np.asarray(t, np.float64)}
    described["columns"] = {}
    for name, (unit, values) in columns.items():
        if name in lsb:
            counts = np.rint(np.asarray(values, np.float64) / lsb[name])
            arrays[name] = counts.astype(np.int16 if np.abs(counts).max(initial=0) <= 32767 else np.int32)
            described["columns"][name] = {"unit": unit, "lsb": float(lsb[name])}
        else:
            arrays[_heading(name, unit)] = np.asarray(values, np.float64)
    with whole(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, meta=np.array(json.dumps(described)), **arrays)


def meta_place(path: Path) -> Path:
    """Where the metadata of a text recording stand: beside it. An npz holds its own."""
    return path.with_name(path.name + ".meta.json")


class _Header:
    """Works out from the keys of a table which columns to read, and in which unit."""

    def __init__(
        self,
        path: Path,
        columns: Mapping[str, str],
        stated: Mapping[str, str],
        scale: Mapping[str, Scale],
        sensors: Collection[str],
        no_time: bool,
    ) -> None:
        self.path, self.columns, self.stated, self.scale, self.sensors = path, columns, stated, scale, sensors
        self.no_time = no_time
        #: `meta` states the clocks of the table.
        self.written = False
        #: The table is not alone: a column may be in another.
        self.several = False
        self.notes: list[str] = []
        self.damaged = SOUND
        #: Heading of a column of dates that is not taken for the time.
        self.dated = ""
        #: Columns whose unit the user states, or scales.
        self.decided = {*stated, *(scale if "" not in scale else sensors)}
        #: Names that the user gives of columns, here or in the file, and that are there.
        self.found: set[str] = set()
        #: Columns of a table that lack a unit, or the size of a count: heading, name here, and the usual unit.
        self.without_unit: list[tuple[str, str, str]] = []
        self.without_size: list[tuple[str, str, str]] = []
        #: Those without a unit that begin with a whole number.
        self.whole: set[str] = set()

    def of_part(self, several: bool) -> _Header:
        """The same for one of the file's parts."""
        one = copy(self)
        one.several, one.notes, one.without_unit, one.without_size = several, [], [], []
        one.damaged = SOUND
        one.whole = set()
        return one

    def knows_in(self, text: Text) -> Callable[[Sequence[str]], bool]:
        """Whether one of a line's headings is a sensor's, in a text. Only so many are looked at."""
        left = MOST_HEADINGS

        def knows(keys: Sequence[str]) -> bool:
            nonlocal left
            left -= len(keys)
            named = any(key in self.columns.values() for key in keys)
            return named or (left > 0 and bool(self.sensors_of(keys, text.name)))

        return knows

    def sensors_of(self, keys: Sequence[str], file: str = "", before: Sequence[str] | None = None) -> list[Sensor]:
        """The sensors of a table with these headings, after the lines `before` of a text."""
        taken = {}
        for name, wanted in self.columns.items():
            for key in [key for key in keys if key == wanted] or [key for key in keys if split(key)[0] == wanted]:
                taken[key] = name
        found = []
        for sensor in sensors_of(file or self.path.name, keys, self.sensors, taken, before):
            meant = {key: one for key, one in sensor.meant.items() if not one.optional or self._asks(key, one.name)}
            if any(one.name in self.sensors for one in meant.values()) or len(meant) == len(sensor.meant):
                found.append(replace(sensor, meant=meant))
        return found

    def fields(
        self,
        keys: Sequence[str],
        where: str,
        described: Any,
        first: Sequence[str] = (),
        meant: Mapping[str, Meaning] | None = None,
    ) -> list[_Field]:
        """One field for each column to read, in file order. `where` is put after the path in messages; `described` is
        what a meta text says of columns that are named plainly; `first`: the cells of the first row of a text;
        `meant`: what `sensors_of` found of the sensor."""
        if not isinstance(described, dict) or not all(isinstance(entry, dict) for entry in described.values()):
            raise UserError(f"{self.path}: meta: 'columns' must be a mapping of column names to unit and lsb")
        for key in keys:
            if len(key) > LONGEST_HEADING or not key.isprintable():
                what = f"more than {LONGEST_HEADING} characters, or some that cannot be shown"
                raise UserError(f"{self.path}: {where}a heading of {what}: '{short(key)}'")
        renamed = self._renamed(keys, where)
        self.without_unit, self.without_size = [], []
        found: list[_Field] = []
        for place, key in enumerate(keys):
            name, unit = split(key)
            if unit is not None and unit.isdecimal():
                unit = None  # a place in an array
            size = 1.0
            if key in renamed:
                name = renamed[key]
            elif meant is not None and key in meant:
                name, unit, size = meant[key].name, meant[key].unit, meant[key].size
            entry = described.get(split(key)[0], {}) if unit is None else {}
            cell = first[place] if place < len(first) else ""
            dates = is_date(cell)
            if name in self.sensors and cell.lstrip("-").isdecimal():
                self.whole.add(key)
            if name == "t" and unit is None and self._of(self.stated, key, name) is None:
                unit = self._since_1970(cell)
            if name == "t" and not self.no_time and not dates and is_clock(cell):
                raise UserError(
                    f"{self.path}: {where}column 't' begins with '{short(cell)}': write dates as "
                    "2024-12-31 10:00:00.250, or seconds; or leave the column out with --no-time --rate HZ"
                )
            if dates or is_clock(cell):
                self.dated = self.dated or key
            if not (name == "t" and self.no_time):
                lsb = entry.get("lsb", None if size == 1.0 else size)
                found += self._field(key, name, entry.get("unit", unit), lsb, where, mapped=key in renamed, dates=dates)
        if self.without_unit or self.without_size:
            raise UserError(f"{self.path}: {where}{self._what_to_state()}")
        names = [field.name for field in found]
        fields = [field for field in found if not field.optional or names.count(field.name) == 1]
        names = [field.name for field in fields]
        for name in names:
            if names.count(name) > 1:
                raise UserError(f"{self.path}: {where}column '{name}' appears twice")
        if not self.several:
            self.check_options(names, where)
        if not any(name in self.sensors for name in names):
            none = f"{self.path}: {where}no sensor column ({', '.join(self.sensors)}) among '{short(','.join(keys))}'; "
            if is_row(",".join(keys)):
                headings = ",".join(["t[s]", *(f"{name}[{unit}]" for name, unit in _LSB_UNITS.items())])
                raise UserError(f"{none}put a line of headings before it, such as {headings}, in the columns' order")
            raise UserError(f"{none}{_NAME_YOURS}")
        return fields

    def marks(
        self, keys: Sequence[str], meta: Mapping[str, Any], rate: float | None, fields: Sequence[_Field]
    ) -> list[_Field]:
        """The columns that state the clocks of a table that `convert` wrote. The user's rate, or no time, decides."""
        self.written = written.stated(meta) and rate is None and any(field.name == "t" for field in fields)
        marks = written.marks_of(meta) if self.written else ()
        return [_Field(key, f"{key} ", "1", 1.0) for key in keys if key in marks]

    def _since_1970(self, cell: str) -> str | None:
        """The unit of a time of our days, since 1970; None for another. In whole seconds a recording has no stamps."""
        for unit, digits in (("ns", 19), ("us", 16), ("ms", 13), ("s", 10)):
            whole, point, _ = cell.partition(".")
            if whole.isdecimal() and len(whole) == digits and whole < "21" and (unit != "s" or point):
                self.notes.append(f"column 't' has no unit: taken as {unit} since 1970")
                return unit
        return None

    def check_options(self, names: Sequence[str], where: str = "") -> None:
        """Raise UserError for an option about a column that is not there."""
        for option, wanted in (("--unit", self.stated), ("--scale", self.scale)):
            for name in wanted:
                if name and name not in names and name not in self.found and not (name == "t" and self.no_time):
                    raise UserError(f"{self.path}: {where}there is no column '{name}' for {option}")

    def _renamed(self, keys: Sequence[str], where: str) -> dict[str, str]:
        renamed: dict[str, str] = {}
        for name, wanted in self.columns.items():
            matches = [key for key in keys if key == wanted] or [key for key in keys if split(key)[0] == wanted]
            if not matches and self.several:
                continue
            if not matches:
                raise UserError(f"{self.path}: {where}there is no column '{wanted}' for --column {name}={wanted}")
            if len(matches) > 1:
                raise UserError(f"{self.path}: {where}column '{wanted}' appears twice")
            if matches[0] in renamed:
                raise UserError(f"{self.path}: {where}column '{wanted}' is mapped to two names")
            renamed[matches[0]] = name
        return renamed

    def _of(self, options: Mapping[str, Any], key: str, name: str) -> Any:
        """What an option says of a column, by its name here, or a name that the file alone has; None: nothing."""
        for given in (name, *self._own_names(key)):
            if given in options:
                self.found.add(given)
                self.decided.add(name)
                return options[given]
        return None

    def _asks(self, key: str, name: str) -> bool:
        """Whether the user states a unit or a size of a column."""
        return self._of(self.stated, key, name) is not None or self._of(self.scale, key, name) is not None

    def _own_names(self, key: str) -> list[str]:
        """A heading, without its unit, and the matrix that it is a column of; none that means a column here."""
        name = split(key)[0]
        matrix, _, number = name.rpartition(":")
        here = {"t", *self.sensors, *dict(SIDE_CHANNELS.values())}
        return [one for one in (key, name, *([matrix] if number.isdigit() else [])) if one not in here]

    def _what_to_state(self) -> str:
        """The options to type for the columns without a unit or a size, by the file's own names."""
        if len(self.without_unit) == 1 and self.without_unit[0][0] == self.without_unit[0][1]:
            name, _, unit = self.without_unit[0]
            return (
                f"column '{name}' has no unit: write {name}[{unit}] in the header or give --unit {name}={unit}, or the "
                "unit that it is in"
            )
        counts = [one for one in self.without_unit if one[0] in self.whole]
        if len({name for _, name, _ in counts}) < _COUNTS_FROM:  # one alone may be a whole number by chance
            counts = []
        stated = [one for one in self.without_unit if one not in counts]
        typed = [f"--unit {name}={unit}" for name, unit in self._by_own_names(stated)]
        typed += [f"--unit {name}={units.LSB}" for name, _ in self._by_own_names(counts)]
        typed += [f"--scale {name}=SIZE[{unit}]" for name, unit in self._by_own_names([*counts, *self.without_size])]
        of = [
            (stated, "no unit"),
            (counts, "no unit, and whole numbers, which may be counts"),
            (self.without_size, "counts of a size that the log does not state"),
        ]
        lacks = "; ".join(f"{what}: {', '.join(short(key) for key, _, _ in keys)}" for keys, what in of if keys)
        return f"columns with {lacks}; give {' '.join(typed)}, or the units that they are in"

    def _by_own_names(self, columns: Sequence[tuple[str, str, str]]) -> list[tuple[str, str]]:
        """For each option to type the name, quoted, and the unit. Columns of one matrix and kind share an option."""
        typed: dict[str, str] = {}
        for key, name, unit in columns:
            own = [one for one in self._own_names(key) if "=" not in one]
            typed[shlex.quote(own[-1] if own and split(key)[0] != name else name)] = unit
        return list(typed.items())

    def _field(
        self, key: str, name: str, unit: Any, lsb: Any, where: str, *, mapped: bool, dates: bool
    ) -> list[_Field]:
        column = f"{self.path}: {where}column '{name}'"
        stated, scaled = self._of(self.stated, key, name), self._of(self.scale, key, name)
        if isinstance(unit, str):
            unit = units.plain(unit)
        if stated is not None:
            stated = units.plain(stated)
            if unit is not None and unit != stated and units.known(str(unit)):
                self.notes.append(f"column '{name}' is in {unit} by its heading, taken as {stated} by --unit")
            unit = stated
        asked = mapped or stated is not None or scaled is not None
        optional = not asked and name != "t" and name not in self.sensors
        dates = dates and name == "t" and stated is None
        unit = "s" if dates else unit
        known = isinstance(unit, str) and units.known(unit)
        example = {"t": "s", **dict(SIDE_CHANNELS.values()), **_LSB_UNITS}.get(name, "UNIT")
        to_scale = (
            f"give --scale {shlex.quote(f'{name}=SIZE[{example}]')}, SIZE the {example} of one '{short(str(unit))}'"
        )
        if not known and unit is not None and scaled is not None:
            unit, known = units.LSB, True
        broken = ("[" in name or "]" in name) and not mapped
        if broken and any(name.startswith(sensor) for sensor in ("t", *self.sensors)):
            raise UserError(f"{column}: the brackets of its unit do not match: write name[unit]")
        if optional and (not name or broken or not known or (unit == units.LSB and "" not in self.scale)):
            if name in dict(SIDE_CHANNELS.values()):
                to_state = f"write {name}[{example}], or give --unit {name}={example}, or the unit that it is in"
                what = f"no unit and is left out: {to_state}"
                if unit is not None:
                    what = f"the unit '{short(str(unit))}' and is left out: {to_scale}"
                self.notes.append(f"column '{name}' has {what}")
            return []
        if unit is None:
            self.without_unit.append((key, name, example))
            return []
        if not known:
            known_units = f"(known: {', '.join(units.RECORDING_UNITS)})"
            raise UserError(f"{column} has the unknown unit '{short(str(unit))}' {known_units}: {to_scale}")
        size = 1.0
        if unit == units.LSB:
            given = self.scale.get("") if scaled is None else scaled
            if given is None:
                self.without_size.append((key, name, _LSB_UNITS.get(name, "UNIT")))
                return []
            size, unit = given[0], units.plain(given[1]) if given[1] else _LSB_UNITS.get(name)
            if unit is None or not units.known(unit) or unit == units.LSB:
                raise UserError(f"{column} is in LSB: --scale needs a unit, --scale {name}={size:g}[unit]")
        elif scaled is not None:
            raise UserError(f"{column} is in {unit}: --scale is for columns in LSB")
        elif lsb is not None:
            size = _number(lsb)
        if not (np.isfinite(size) and size > 0.0):
            raise UserError(f"{column}: the size of one LSB must be a number above 0")
        if name == "t" and not units.same_kind(unit, "s"):
            raise UserError(f"{column} is in {unit}, which is not a time (h, min, s, ms, us, ns)")
        side = name in dict(SIDE_CHANNELS.values())
        return [_Field(key, name, unit, size, optional and not side, dates)]


def _number(value: Any) -> float:
    """A JSON value as a number; NaN if it is none."""
    try:
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    except OverflowError:
        return math.inf


# ----------------------------------------------------------------------------------------------------------- loaders


def _text_parts(path: Path, rate: float | None, header: _Header, skip_bad: bool) -> list[Part]:
    """The sensors of a text, or of the texts in a zip."""
    found = []
    for text in texts_in(path):
        try:
            with ExitStack() as files:
                table = TextTable(text.path, files, header.knows_in(text), skip_bad=skip_bad, opened=text.open)
        except UserError:
            if text.optional:
                continue
            raise
        sensors = header.sensors_of(table.keys, text.name, table.before)
        if not sensors and text.optional:
            continue
        key = number_of(table.keys)
        numbered: list[tuple[str, str] | None] = [(key, cell) for cell in table.numbers_in(key)] if key else []
        for sensor, only in [(one, only) for one in sensors or [Sensor("", {})] for only in numbered or [None]]:
            others = {key for one in sensors if one is not sensor for key in one.meant} - sensor.meant.keys()
            one = _Text(text, rate, header, skip_bad, sensor, others, only)
            names = {meaning.name for meaning in sensor.meant.values()}
            names |= {split(key)[0] for key in table.keys if key not in sensor.meant}
            axes = frozenset(names & set(header.sensors))
            own = "" if only is None else ":".join(only)
            found.append(Part(_named(text.source, sensor.source, own), axes, False, one.span, one.read))
    return found


@dataclass(frozen=True)
class _Text:
    """A sensor in a text. `others`: headings of other sensors. `only`: a column, and the cell of this sensor's rows."""

    text: Text
    rate: float | None
    header: _Header
    skip_bad: bool
    sensor: Sensor
    others: Collection[str]
    only: tuple[str, str] | None = None

    def span(self) -> tuple[int, float]:
        """Number of readings, and the seconds of them."""
        one = self._read(True)
        return one.samples, (one.samples - 1 + int(one.missing_before.sum())) / one.rate_hz

    def read(self, several: bool, side: bool = False) -> Recording | None:
        """The recording of this sensor; of the temperature only, None."""
        return None if side else self._read(several)

    def _read(self, several: bool) -> Recording:
        header, path = self.header.of_part(several), self.text.path
        with ExitStack() as files:
            table = TextTable(path, files, header.knows_in(self.text), skip_bad=self.skip_bad, opened=self.text.open)
            if self.only is not None:
                table.only(*self.only)
            meta = dict(_meta_beside(path))
            keys = [key for key in table.keys if key not in self.others]
            first = [cell for key, cell in zip(table.keys, table.first, strict=False) if key not in self.others]
            fields = header.fields(keys, table.where, {}, first, self.sensor.meant)
            fields += header.marks(keys, meta, self.rate, fields)
            dated = next((place for place, field in enumerate(fields) if field.dates), None)
            read = table.columns(
                [(field.key, field.name) for field in fields], [field.optional for field in fields], dated
            )
        fields = [field for field, column in zip(fields, read, strict=True) if column is not None]
        columns = [column for column in read if column is not None]
        if meta.get("rows", columns[0].size + table.skipped) != columns[0].size + table.skipped:
            what = f"{columns[0].size} rows where {meta_place(path).name} says {shown(meta['rows'])}"
            raise UserError(f"{path}: {what}: it was cut or changed; without that file it is read as it is")
        header.damaged += table.damaged
        if table.skipped:
            one = table.skipped == 1
            header.notes.append(
                "1 line is no row and was skipped" if one else f"{table.skipped} lines are no rows and were skipped"
            )
        if "rate_hz" not in meta and (stated := table.stated_rate()) is not None:
            meta["rate_hz"] = stated

        def fail(row: int, field: int | None, what: str) -> NoReturn:
            if row in table.restarts:
                at = table.line_of(row)
                what += (
                    f", where the header is repeated: the logger began anew; cut the log there, "
                    f"head -n {at - 2} {shlex.quote(path.name)} > first.csv"
                )
            table.fail(row, None if field is None else fields[field].name, what)

        return _checked(path, self.rate, meta, fields, columns, fail, header, table.origin_s, table.places)


def _meta_beside(path: Path) -> Mapping[str, Any]:
    beside = meta_place(path)
    return parse_meta(beside, read_text(beside, MOST_META_BYTES, "not a JSON text")) if beside.is_file() else {}


def _table_parts(path: Path, rate: float | None, header: _Header, table: Table, several: bool) -> list[Part]:
    """The sensors of a table, and the temperature in one without any."""
    sensors = header.sensors_of(list(table.members))
    sides = sides_of(table.members) if several and not sensors else None
    if several and not sensors and sides is None:
        return []
    found = []
    for sensor in sensors or [sides or Sensor("", {})]:
        others = {key for one in sensors if one is not sensor for key in one.meant} - sensor.meant.keys()
        one = _Arrays(path, rate, header, replace(table, members=_without(table.members, others)), sensor, bool(sides))
        names = {one._name(key) for key in one.table.members}
        axes = frozenset(names & set(header.sensors))
        found.append(Part(_named(table.source, sensor.source), axes, "temp" in names, one.span, one.read))
    return found


def _without(members: Mapping[str, Member], others: Collection[str]) -> dict[str, Member]:
    return {key: member for key, member in members.items() if key not in others}


@dataclass(frozen=True)
class _Arrays:
    """A sensor in a table of arrays; `side`: a temperature alone."""

    path: Path
    rate: float | None
    header: _Header
    table: Table
    sensor: Sensor
    side: bool

    def _name(self, key: str) -> str:
        return self.sensor.meant[key].name if key in self.sensor.meant else split(key)[0]

    def span(self) -> tuple[int, float]:
        """Number of readings, and the seconds of them."""
        for key, member in self.table.members.items():
            if self._name(key) == "t":
                return _span(member.read(), self.sensor.meant.get(key, Meaning(*split(key))).unit)
        return next((math.prod(one.shape) for one in self.table.members.values()), 0), 0.0

    def read(self, several: bool, side: bool = False) -> Recording | None:
        """The recording of this sensor, or of its temperature only; None for a temperature that cannot be read."""
        header = self.header.of_part(several)
        if not (self.side or side):
            header.notes += self.table.notes
            return _load_arrays(self.path, self.rate, header, self.table, self.sensor)
        header.sensors, header.columns = [name for name, _ in SIDE_CHANNELS.values()], {}
        members = {key: one for key, one in self.table.members.items() if self._name(key) in ("t", *header.sensors)}
        try:
            return _load_arrays(self.path, None, header, replace(self.table, members=members), self.sensor)
        except UserError as error:
            note(f"{error}; {self.table.source} is left out")
            return None


def _load_arrays(path: Path, rate: float | None, header: _Header, table: Table, sensor: Sensor) -> Recording:
    arrays, meta = table.members, table.meta
    if not arrays:
        raise UserError(f"{path}: there are no columns")
    where = f"{table.source}: " if table.source else ""
    fields = header.fields(list(arrays), where, meta.get("columns", {}), (), sensor.meant)
    fields += header.marks(list(arrays), meta, rate, fields)
    rows = math.prod(arrays[fields[0].key].shape)
    for field in fields:
        member, column = arrays[field.key], f"{path}: {where}column '{field.name}'"
        if len(member.shape) != 1:
            raise UserError(f"{column} has {len(member.shape)} dimensions, not one")
        if member.dtype.kind not in "iuf":
            raise UserError(f"{column} holds no numbers (its type is {short(str(member.dtype))})")
        if member.shape[0] != rows:
            raise UserError(f"{column} has {member.shape[0]} rows, '{fields[0].name}' has {rows}")
    if rows < 2:
        raise UserError(f"{path}: {where}{'one row only' if rows else 'no rows'}, a recording needs two or more")
    if rows * len(fields) > MOST_NUMBERS:
        raise UserError(f"{path}: more than {MOST_NUMBERS:,} numbers: cut it in parts, or read fewer columns")

    def fail(row: int, field: int | None, what: str) -> NoReturn:
        column = "" if field is None else f"column '{fields[field].name}': "
        raise UserError(f"{path}: {where}row {row + 1}: {column}{what}")

    started = 0.0

    def as_read(number: int) -> NDArray[np.float64]:
        nonlocal started
        array = arrays[fields[number].key].read()
        if fields[number].name == "t" and array.dtype.kind in "iu":
            # Time since an epoch in ns does not fit a float64; a difference of two int64 fits a uint64.
            back = array[1:] < array[:-1]
            bits = array.astype(np.uint64 if array.dtype.kind == "u" else np.int64).view(np.uint64)
            started = float(array[0])
            since = bits - bits[0]
            if not back.any():
                return np.asarray(since, np.float64)
            # Only a counter that wraps goes back, and by less than 2^63.
            steps = np.diff(since).view(np.int64)
            if (steps[back] >= 0).any():
                fail(int(np.argmax(back)) + 1, number, "time runs backwards")
            return np.asarray(since.view(np.int64), np.float64)
        return array.astype(np.float64)

    columns = [as_read(number) for number in range(len(fields))]
    return _checked(path, rate, meta, fields, columns, fail, header, started)


# ------------------------------------------------------------------------------------------------------ common checks


def _checked(
    path: Path,
    rate: float | None,
    meta: Mapping[str, Any],
    fields: Sequence[_Field],
    table: list[NDArray[np.float64]],
    fail: _Fail,
    header: _Header,
    started: float,
    places: NDArray[np.int64] | None = None,
) -> Recording:
    """The recording of raw columns `table`, float64[n] each, NaN where there is no sample. It empties `table`: no
    second copy stays. `fail(row, field, what)` raises for a row of the file. `started`: what was taken off the stamps,
    in their unit. `places` int64[n]: of each row among the lines, some of which were skipped; rows with a damaged stamp
    are skipped then too."""
    if places is not None:
        kept = _with_stamps(fields, table)
        if kept.size < places.size:
            count, places = places.size - kept.size, places[kept]
            table[:] = [column[kept] for column in table]
            header.damaged += Damaged(0, count)
            were = "s were" if count > 1 else " was"
            header.notes.append(f"{count} line{were} skipped for a damaged time stamp")
            fail_whole = fail

            def fail(row: int, field: int | None, what: str) -> NoReturn:
                fail_whole(int(kept[row]), field, what)

    columns: dict[str, Column] = {}
    rows = table[0].size
    for number, field in enumerate(fields):
        raw = table.pop(0)
        if np.isinf(raw).any():
            fail(int(np.argmax(np.isinf(raw))), number, "infinite")
        with np.errstate(over="ignore"):
            values = raw * field.lsb if field.lsb != 1.0 else raw
        if np.isinf(values).any():
            fail(int(np.argmax(np.isinf(values))), number, f"infinite at {field.lsb:g} {field.unit} an LSB")
        columns[field.name] = Column(field.name, field.unit, values)
    _check_truth(path, meta)
    stamps = columns.pop("t", None)
    time = started_s = None
    noise_s = 0.0

    def fail_time(row: int, what: str) -> NoReturn:
        fail(row, [field.name for field in fields].index("t"), what)

    if stamps is None:
        rate = rate if rate is not None else _meta_rate(path, meta)
        if rate is None:
            mapped = f", map yours with --column t={shlex.quote(header.dated)}" if header.dated else ""
            raise UserError(f"{path}: there is no time column: add t[s]{mapped} or give --rate HZ")
    else:
        unknown = np.isnan(stamps.values)
        if unknown.any():
            fail_time(int(np.argmax(unknown)), "no time stamp (an empty cell or NaN)")
        if header.written:
            return _as_written(
                path, meta, fields, columns, units.convert(stamps.values, stamps.unit, "s"), header, places
            )
        since = units.convert(stamps.values - stamps.values[0], stamps.unit, "s")
        time, wraps = unwrapped(since, next(_tick_s(field) for field in fields if field.name == "t"))
        if wraps:
            header.notes.append(
                f"column 't' wraps {wraps} time{'s' if wraps > 1 else ''} like a 32-bit counter: undone"
            )
        started_s = float(units.convert(np.array([started + stamps.values[0]]), stamps.unit, "s")[0])
        noise_s = float(
            np.abs(units.convert(np.spacing(np.abs(stamps.values).max(keepdims=True)), stamps.unit, "s"))[0]
        )
        stamps = None
    return _on_clocks(path, rate, meta, columns, rows, time, noise_s, started_s, header, fail_time, places)


def _as_written(
    path: Path,
    meta: Mapping[str, Any],
    fields: Sequence[_Field],
    columns: Mapping[str, Column],
    t: NDArray[np.float64],
    header: _Header,
    places: NDArray[np.int64] | None,
) -> Recording:
    """The recording of columns with NaN, and stamps `t`, s, by the clocks that `meta` states."""
    marks = {field.key: columns[field.name].values for field in fields if field.name.endswith(" ")}
    named = {split(field.key)[0]: field.name for field in fields if field.name in columns and field.key not in marks}
    clocks = [
        (names, clock, rows)
        for names, clock, rows in written.clocks_of(path, meta, t, marks, places)
        if any(name in named for name in names)
    ]
    if not clocks:
        raise UserError(
            f"{path}: meta: its clocks are of no column of the table: convert the log again, or give --rate HZ"
        )
    _, main, main_rows = clocks[0]
    of: dict[str, tuple[Clock | None, NDArray[np.int64]]] = dict.fromkeys(named.values(), (None, main_rows))
    for names, clock, rows in clocks[1:]:
        other = replace(clock, start_s=clock.start_s - main.start_s)
        of.update({named[name]: (other, rows) for name in names if name in named})
    made: dict[str, Column] = {}
    for name in named.values():
        own, rows = of[name]
        values = _at(columns[name].values, rows)
        if not np.isfinite(values).any():
            header.notes.append(f"column '{name}' holds no number and is left out")
            continue
        if name not in header.sensors:
            values = bridged(values) if own is None else _bridged(own, values, main.time_s - main.start_s)
            own = None
        made[name] = replace(columns[name], values=values, clock=own)
    if not any(name in header.sensors for name in made):
        raise UserError(f"{path}: no sensor column holds a number")
    started, notes = _number(meta.get("started_s")), meta.get("notes")
    of_log = [one for one in notes if isinstance(one, str) and one.isprintable()] if isinstance(notes, list) else []
    return Recording(
        path,
        main.rate_hz,
        made,
        main.missing_before,
        meta,
        main.off_grid_s,
        started_s=started if math.isfinite(started) else None,
        notes=(*of_log, *header.notes, *_of_clock(main)),
    )


def _tick_s(field: _Field) -> float:
    """A count of a column of stamps, s."""
    return units.factor(field.unit, "s") * field.lsb


def _with_stamps(fields: Sequence[_Field], table: Sequence[NDArray[np.float64]]) -> NDArray[np.int64]:
    """The rows of raw columns whose stamps can be true; all of them where too many cannot."""
    every = np.arange(table[0].size)
    for field, raw in zip(fields, table, strict=True):
        if field.name == "t" and np.isfinite(raw).any() and not np.isinf(raw).any():
            known = np.flatnonzero(np.isfinite(raw))
            seconds = units.convert(raw[known] - raw[known[0]], field.unit, "s")
            sound = np.delete(known, damaged_stamps(unwrapped(seconds * field.lsb, _tick_s(field))[0]))
            return sound if few(every.size - sound.size, every.size) else every
    return every


def _on_clocks(
    path: Path,
    rate: float | None,
    meta: Mapping[str, Any],
    columns: Mapping[str, Column],
    rows: int,
    time: NDArray[np.float64] | None,
    noise_s: float,
    started_s: float | None,
    header: _Header,
    fail: Callable[[int, str], NoReturn],
    places: NDArray[np.int64] | None,
) -> Recording:
    """The recording of columns with NaN in `rows` rows at the stamps `time`, s, or at `rate` without any.

    Axes whose samples are spaced regularly, in two rows or more, get a clock of their own; the rows of the others are
    those in which one of them has a sample.
    """

    def clock_at(at: NDArray[np.int64], rate: float | None) -> Clock:
        lines = at if places is None else places[at]
        if time is not None:
            skipped = np.diff(lines, prepend=lines[0]) - np.diff(at, prepend=at[0]) if places is not None else None
            return clock_of(path, _at(time, at), noise_s, rate, lambda row, what: fail(int(at[row]), what), skipped)
        assert rate is not None
        if lines[-1] / rate > LONGEST_S:
            raise UserError(f"{path}: {lines[-1] + 1} rows at {rate:g} Hz: a recording spans at most {LONGEST_S:g} s")
        return clock_of_rows(lines, rate)

    axes: dict[str, NDArray[np.bool_]] = {}
    for name, column in columns.items():
        known = np.isfinite(column.values)
        if not known.any():
            header.notes.append(f"column '{name}' holds no number and is left out")
        elif name in header.sensors:
            axes[name] = known
    columns = {name: column for name, column in columns.items() if name in axes or np.isfinite(column.values).any()}
    if not axes:
        raise UserError(f"{path}: no sensor column holds a number")
    own: dict[bytes, list[str]] = {}
    for name, known in axes.items():
        if not known.all() and has_own_clock(np.flatnonzero(known)):
            own.setdefault(np.packbits(known).tobytes(), []).append(name)
    if len(own) > MOST_CLOCKS:
        raise UserError(f"{path}: more than {MOST_CLOCKS} patterns of empty cells: no recording has so many rates")
    clocked = {name: names for names in own.values() for name in names}
    common = [known for name, known in axes.items() if name not in clocked]
    if common:
        at = np.flatnonzero(np.logical_or.reduce(common))
    else:  # the fastest of them is the recording's
        fastest = max(own.values(), key=lambda names: int(axes[names[0]].sum()))
        at = np.flatnonzero(axes[fastest[0]])
        clocked = {name: names for name, names in clocked.items() if names is not fastest}
    if at.size < 2:
        raise UserError(
            f"{path}: {at.size} row{'s' if at.size > 1 else ''} with a sample, a recording needs two or more"
        )
    main = clock_at(at, rate)
    begins = main.start_s
    started_s = None if started_s is None else started_s + begins
    clocks = {
        id(names): clock_at(np.flatnonzero(axes[names[0]]), None if time is not None else rate)
        for names in {id(names): names for names in clocked.values()}.values()
    }
    made: dict[str, Column] = {}
    missing: dict[str, int] = {}
    for name, column in columns.items():
        known = np.isfinite(column.values)
        if name in clocked:
            clock = clocks[id(clocked[name])]
            made[name] = replace(
                column, values=column.values[known], clock=replace(clock, start_s=clock.start_s - begins)
            )
        elif name in axes:
            made[name] = replace(column, values=_at(column.values, at))
            missing[name] = rows - int(known.sum())
        else:
            place = np.arange(rows, dtype=np.float64) if time is None else time
            values = column.values if known.all() else np.interp(place, place[known], column.values[known])
            made[name] = replace(column, values=_at(values, at))
    told = ", ".join(f"{name} {count}" for name, count in missing.items() if count)
    if told:
        header.notes.append(f"of {rows} rows cells without a number, taken as missing samples: {told}")
    notes = (*header.notes, *_of_clock(main))
    return Recording(
        path,
        main.rate_hz,
        made,
        main.missing_before,
        meta,
        main.off_grid_s,
        started_s=started_s,
        notes=notes,
        damaged=header.damaged,
    )


def _at(values: NDArray[np.float64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Values in these rows, in order and each once; no copy where they are all."""
    return values if rows.size == values.size else values[rows]


def _meta_rate(path: Path, meta: Mapping[str, Any]) -> float | None:
    if "rate_hz" not in meta:
        return None
    rate = _number(meta["rate_hz"])
    if not (np.isfinite(rate) and rate > 0.0):
        raise UserError(f"{path}: meta: 'rate_hz' must be a number above 0")
    return rate


def _check_truth(path: Path, meta: Mapping[str, Any]) -> None:
    """What a simulated recording says of itself: by axis, texts and finite numbers."""
    truth = meta.get("truth", {})
    if not isinstance(truth, dict) or not all(isinstance(entry, dict) for entry in truth.values()):
        raise UserError(f"{path}: meta: 'truth' must be a mapping of axes")
    for axis, entry in truth.items():
        for key, value in entry.items():
            if key == "units" or (isinstance(value, str) and len(value) <= 60 and value.isprintable()):
                continue
            if not math.isfinite(_number(value)):
                raise UserError(f"{path}: meta: truth of '{short(axis)}': '{short(key)}' is {shown(value)}")
