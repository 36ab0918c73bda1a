"""Recordings of a resting sensor: read, check, and write. The formats are read by `loaders/`.

Text has a header row of `name[unit]`. An npz has a 1-D array for each column, named like the header, or named plainly
with unit and LSB in a JSON text `meta`: {"rate_hz": 100.0, "columns": {"gx": {"unit": "deg/s", "lsb": 0.05}}}. A text
file may have this text as LOG.meta.json. Every fault raises UserError with file, line and column in one line.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from selfcal.base import units
from selfcal.base.errors import UserError, note, short, short_value
from selfcal.base.limits import LEAST_RATE_HZ, MOST_RATE_HZ, reading
from selfcal.base.options import Scale
from selfcal.base.units import SENSORS
from selfcal.logs import arrays, written
from selfcal.logs.assembled import assembled
from selfcal.logs.chosen_columns import NAME_YOURS, Asked, Header
from selfcal.logs.loaders import check_library, format_of, texts
from selfcal.logs.loaders.child import tables_of
from selfcal.logs.loaders.damage import SOUND, bytes_of
from selfcal.logs.loaders.headings import Meaning, Sensor, sides_of, split
from selfcal.logs.loaders.sources import Share, chosen
from selfcal.logs.loaders.table import Field, Hints, Table, meta_place
from selfcal.logs.loaders.text_table import is_date
from selfcal.logs.recorded import SIDE_CHANNELS, SIDE_UNITS, Column, Recording, as_float, bridged, bridged_at
from selfcal.logs.timebase import Clock
from selfcal.logs.written import save

__all__ = ["SIDE_CHANNELS", "Column", "Recording", "as_float", "bridged", "list_of", "load", "meta_place", "save"]

#: Where a sensor's axes stand at rest, 1 g is so long in these units; the share that it may be off, the share of the
#: record that rests, and the seconds of a mean.
_GRAVITY = {"g": 1.0, "mg": 1000.0, "m/s^2": units.STANDARD_GRAVITY, "mm/s^2": 1000.0 * units.STANDARD_GRAVITY}
_GRAVITY_OFF, _AT_REST, _GRAVITY_S = 0.05, 0.9, 1.0


#: A file, several files that are joined, or readings in memory: a Recording, an array, a mapping of arrays, a frame.
Data: TypeAlias = "Path | str | Sequence[Path | str] | Recording | NDArray[Any] | Mapping[str, Any] | Any"


def load(
    path: Data,
    rate: float | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | str | None = None,
    scale: Mapping[str, Scale] | float | None = None,
    sensors: Collection[str] = SENSORS,
    *,
    no_time: bool = False,
    skip_bad: bool = False,
    sources: Sequence[str] = (),
    dbc: Path | str | None = None,
    rate_hz: float | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
) -> Recording:
    """Read a recording; of several files, or sensors of a log, one, joined by their time stamps. Readings in memory are
    taken as `Recording.from_arrays` has it, and a Recording as it is.

    `rate`, or `rate_hz`, Hz: needed without a `t` column; with one it must agree with it to 10 % and is taken as the
    true rate.
    `columns`: name here -> header in the file. `units`: name here -> unit; it takes the header's place.
    `scale`: size of one LSB, for all LSB columns or by name, with its unit (default deg/s for g*, m/s^2 for a*).
    `sensors`: columns of which at least one must be there. Any other column, except temperature and supply,
    is left out if it cannot be read.
    `no_time`: the time column is not read. `skip_bad`: lines of a text that are no row are left out and counted.
    `sources`: names of the sensors to read of a log that has several, or one name. `dbc`: what decodes CAN frames.
    `start_s`, `end_s`: the stretch that is kept (`Recording.between`).
    The recording's `notes` are printed on stderr.
    Raises UserError for any file that is not a sound recording, or is larger than `limits.py` says. O(n); about 2 s
    for 10^6 CSV rows of 7 columns.
    """
    if isinstance(path, Recording):
        return path.between(start_s, end_s)
    rate = _rate(rate if rate_hz is None else rate_hz)
    if not isinstance(units, str | Mapping | None):
        raise UserError(
            f"units={units!r}: one text for all axes, or by name, as units={{'gyro': 'deg/s', 'accel': 'g'}}"
        )
    columns, units, tables = columns or {}, units or {}, None
    paths = list_of(path)
    if not paths and not arrays.in_memory(path):
        raise UserError("there is no recording in an empty list")
    if arrays.in_memory(path):
        tables, units = arrays.tables_of(path, units, columns, rate, sensors)
        paths = [Path("arrays")]
    elif isinstance(units, str):
        raise UserError(f"units={units!r}: of a file by the names of its columns, as units={{'gx': {units!r}}}")
    sources = [sources] if isinstance(sources, str) else sources
    by_name: Mapping[str, Scale] = {"": (float(scale), None)} if isinstance(scale, int | float) else scale or {}
    if rate is not None and not LEAST_RATE_HZ <= rate <= MOST_RATE_HZ:
        raise UserError(f"the rate must be above 0 Hz ({LEAST_RATE_HZ:g} to {MOST_RATE_HZ:g} Hz), not {rate:g}")
    if len(paths) > 1 and (rate is not None or no_time):
        raise UserError("several files are joined by their time stamps: leave --rate and --no-time out")
    asked = Asked(rate, columns, units, by_name, sensors, no_time, skip_bad, sources, dbc)
    headers = [Header(file, asked, len(paths) > 1) for file in paths]
    recordings = [part for header in headers for part in _load(header, tables)]
    there = {text for header in headers for key in header.seen for text in (key, split(key)[0])}
    for name, wanted in columns.items():
        if wanted not in there:
            what = f"there is no column '{wanted}' for --column {name}={wanted}"
            raise UserError(f"{' '.join(map(str, paths))}: {what}")
    recording = recordings[0] if len(recordings) == 1 else _joined(paths, recordings, headers[0])
    _check_gravity(recording, headers[0])
    recording = replace(
        recording,
        notes=tuple(dict.fromkeys((*recording.notes, *_rates(recording)))),
        options=() if tables else asked.options,
    )
    for text in recording.notes:
        note(f"{recording.path}: {text}")
    return recording.between(start_s, end_s)


def _rate(rate: Any) -> float | None:
    """A stated rate, Hz. Raises UserError."""
    try:
        return None if rate is None else float(rate)
    except (TypeError, ValueError) as error:
        raise UserError(f"the rate must be a number of Hz, not {short_value(rate)}") from error


def from_arrays(
    data: Data,
    rate_hz: float | None = None,
    units: Mapping[str, str] | str | None = None,
    name: str = "arrays",
    **reading: Any,
) -> Recording:
    """The recording of readings that are in memory, which every verb takes in place of a file.

    `data`: an array [n], [n, 3] or [n, 6] of gx, gy, gz, ax, ay, az; a mapping of arrays by heading, `gyro` and
    `accel` [n, 3] among them; a data frame. `units`: of all axes, `"deg/s"`, or by name, `{"gyro": "rad/s"}`;
    a heading `gx[deg/s]` needs none. `rate_hz`: without a time column. `name`: of the recording in results.
    The other options are `load`'s. Raises UserError."""
    return replace(load(data, rate_hz=rate_hz, units=units, **reading), path=Path(name))


Recording.from_arrays = staticmethod(from_arrays)


def list_of(paths: Data) -> list[Path]:
    """The files of a recording."""
    if isinstance(paths, Recording) or arrays.in_memory(paths):
        return []
    return [Path(paths)] if isinstance(paths, Path | str) else [Path(path) for path in paths]


def check_column(recording: Recording, name: str, asked: str = "", needed: str = "") -> None:
    """Raise UserError for a column that the recording has not: `asked` by which option, `needed` for what."""
    if name not in recording.columns:
        there = ", ".join(recording.columns)
        raise UserError(f"{recording.path}: {asked}there is no column '{name}' (there are {there}){needed}")


def _load(header: Header, there: Sequence[Table] | None) -> list[Recording]:
    """The sensors of a file that are meant, or of the tables that are `there`, and their temperatures, each by its own
    clock."""
    path, wanted = header.path, header.asked.sources
    hints: Hints = {} if header.asked.dbc is None else {"dbc": str(header.asked.dbc)}
    with reading(path, "not a sound recording"):
        form = format_of(path, frames="dbc" in hints) if there is None else None
        if there is not None:
            tables = [*there]
        elif form is None:
            tables = texts.read(path, header.knows_in, header.asked.skip_bad)
        else:
            check_library(path, form)
            if form.here:
                tables = import_module(f"selfcal.logs.loaders.{form.module}").read(path, hints)
            else:
                tables = tables_of(path, form, hints)
        several = len(tables) > 1
        header.seen = {key for table in tables for key in table.keys}
        parts = [part for table in tables for part in _parts(header, table, several)]
        if not parts or (several and not any(part.axes for part in parts)):
            listed = ", ".join(f"{table.source}: {', '.join(table.keys)}" for table in tables)
            why = next((f"; {remark}" for table in tables for remark in table.notes), "")
            raise UserError(
                f"{path}: no sensor column ({', '.join(header.sensors)}) among '{short(listed)}'; {NAME_YOURS}{why}"
            )
        if wanted and not any(part.source for part in parts):
            raise UserError(f"{path}: it has one source alone: leave --source out")
        parts_meant, sides, notes = chosen(path, parts, wanted)
        recordings = [part.read(len(parts_meant) > 1, part in sides) for part in parts_meant]
    sound = [part for part in recordings if part is not None]
    damaged = sum((part.damaged for part in [*tables[:1], *sound]), SOUND)
    if damaged:
        damaged = replace(damaged, whole=damaged.whole or bytes_of(path))
        notes[:0] = [damaged.words] if form is not None else []  # a text's lines have lines of their own
    first = replace(sound[0], notes=(*notes, *sound[0].notes), damaged=damaged)
    return [first, *(replace(part, damaged=SOUND) for part in sound[1:])]


def _parts(header: Header, table: Table, several: bool) -> list[Share]:
    """The sensors of a table, or the temperature in a table without sensors."""
    keys = table.keys
    sensors = header.sensors_of(keys, table.name, table.before)
    sides = sides_of(keys) if several and not sensors else None
    if several and not sensors and sides is None:
        return []
    parts = []
    for sensor in sensors or [sides or Sensor("", {})]:
        others = {key for other in sensors if other is not sensor for key in other.meant} - sensor.meant.keys()
        kept = [key for key in keys if key not in others]
        own = _Sensor(header, table, sensor, kept, bool(sides))
        names = set(map(own.name, kept))
        source = "/".join(name for name in (table.source, sensor.source) if name)
        parts.append(Share(source, frozenset(names & set(header.sensors)), "temp" in names, own.span, own.read))
    return parts


@dataclass(frozen=True)
class _Sensor:
    """A sensor in a table: its headings `keys`. `side`: a temperature alone."""

    header: Header
    table: Table
    sensor: Sensor
    keys: Sequence[str]
    side: bool

    @cached_property
    def _mapped(self) -> dict[str, str]:
        return self.header.mapped(self.keys)

    def name(self, key: str) -> str:
        """A column's name here."""
        if key in self.sensor.meant:
            return self.sensor.meant[key].name
        return self._mapped.get(key, split(key)[0])

    def span(self) -> tuple[int, float]:
        """Number of readings, and the seconds of them."""
        for key in self.keys:
            if self.name(key) == "t":
                unit = self.sensor.meant.get(key, Meaning(*split(key))).unit
                field = Field(key, "t", "s", 1.0, dates=is_date(self.table.cells.get(key, "")))
                return _span(self.table.rows(self.header.path, [field]).columns[0], unit)
        wanted = [Field(key, self.name(key), "", 1.0) for key in self.sensor.meant or self.keys]
        return self.table.rows(self.header.path, wanted[:1]).columns[0].size, 0.0

    def read(self, several: bool, side: bool = False) -> Recording | None:
        """The recording of this sensor, or of its temperature only; None for a temperature that cannot be read."""
        header = self.header.of_part(several)
        if not (self.side or side):
            header.notes += self.table.notes
            return self._read(header, self.keys)
        header.sensors, header.columns, header.rate = list(SIDE_UNITS), {}, None
        try:
            return self._read(header, [key for key in self.keys if self.name(key) in ("t", *header.sensors)])
        except UserError as error:
            note(f"{error}; {self.table.source} is left out")
            return None

    def _read(self, header: Header, keys: Sequence[str]) -> Recording:
        if not keys:
            raise UserError(f"{header.path}: there are no columns")
        table = self.table
        fields = header.fields(keys, table.where, table.meta.get("columns", {}), table.cells, self.sensor.meant)
        fields += header.marks(keys, table.meta, fields)
        rows = table.rows(header.path, fields)
        header.damaged += rows.damaged
        header.notes += rows.notes
        return assembled(rows, header)


def _span(stamps: NDArray[Any], unit: str | None) -> tuple[int, float]:
    """Number of stamps, and the seconds that they span; of a foreign unit, 0."""
    stamps = stamps[np.isfinite(stamps)] if stamps.dtype.kind == "f" else stamps
    if not stamps.size:
        return 0, 0.0
    unit = units.plain(unit or "s")
    size = units.factor(unit, "s") if units.known(unit) and units.same_kind(unit, "s") else 0.0
    return stamps.size, float(int(stamps[-1]) - int(stamps[0]) if stamps.dtype.kind in "iu" else np.ptp(stamps)) * size


def _joined(files: Sequence[Path], recordings: Sequence[Recording], header: Header) -> Recording:
    """Join the parts of a recording: the columns of the fastest sensor keep its clock, others have their own."""
    sensors = [
        part for part in recordings if not header.sensors or any(name in header.sensors for name in part.columns)
    ]
    main = max(sensors, key=lambda part: part.rate_hz)
    paths = Path(" ".join(map(str, files)))
    header.check_options([name for part in recordings for name in part.columns])
    for part in recordings:
        if part.started_s is None or main.started_s is None:
            raise UserError(f"{part.path}: there is no time column: several files are joined by their time stamps")
        shift = part.started_s - main.started_s
        if shift > main.duration_s or -shift > part.duration_s:
            raise UserError(f"{paths}: the files do not overlap in time: are they of one recording?")
    columns: dict[str, Column] = dict(main.columns)
    notes = [*main.notes]
    for part in recordings:
        if part is main:
            continue
        assert part.started_s is not None and main.started_s is not None
        shift = part.started_s - main.started_s
        notes += part.notes
        clocks: dict[int, Clock] = {}
        for name, column in part.columns.items():
            if name in columns and name not in header.sensors and (len(files) == 1 or name not in SIDE_UNITS):
                continue  # each sensor's own temperature, or a column of no meaning here
            if name in columns:
                raise UserError(f"{paths}: column '{name}' is in more than one of them")
            own = part.clock_of(name)
            clock = clocks.setdefault(id(column.clock), replace(own, start_s=own.start_s + shift))
            if clock.alike(main.clock):
                columns[name] = replace(column, clock=None)
            elif name in header.sensors:
                columns[name] = replace(column, clock=clock)
            else:
                columns[name] = replace(column, values=bridged_at(clock, column.values, main.time_s), clock=None)
    return replace(
        main,
        path=paths,
        columns=columns,
        notes=tuple(dict.fromkeys(notes)),
        damaged=sum((part.damaged for part in recordings), SOUND),
        paths=tuple(files) if len(files) > 1 else (),
    )


def _rates(recording: Recording) -> list[str]:
    """A line on columns that are sampled at times of their own."""
    if all(column.clock is None for column in recording.columns.values()):
        return []
    alike: dict[tuple[int, float], list[str]] = {}
    for name, column in recording.columns.items():
        alike.setdefault((id(column.clock), recording.clock_of(name).rate_hz), []).append(name)
    groups = "; ".join(f"{', '.join(names)} at {rate:.6g} Hz" for (_, rate), names in alike.items())
    return [f"columns sampled at different times: {groups}"]


def _check_gravity(recording: Recording, header: Header) -> None:
    """Raise UserError for three accelerometers at rest that show 1 g of another unit than their headings'.

    Nothing is checked where the user states a unit, where `convert` wrote the table, or where gravity has the length
    of none."""
    if written.stated(recording.meta):
        return
    names = ("ax", "ay", "az")
    axes = [recording.columns[name] for name in names if name in recording.columns]
    if len(axes) < len(names) or any(axis.unit != axes[0].unit or axis.name in header.decided for axis in axes):
        return
    if not units.same_kind(axes[0].unit, "m/s^2") or axes[1].clock != axes[0].clock or axes[2].clock != axes[0].clock:
        return
    block = max(1, round(recording.clock_of("ax").rate_hz * _GRAVITY_S))
    count = axes[0].values.size // block
    means = np.array([axis.values[: count * block].reshape(count, block).mean(axis=1) for axis in axes])
    means = means[:, np.isfinite(means).all(axis=0)]
    if not means.size:
        return
    level = np.median(means, axis=1)
    norm = float(np.linalg.norm(level))
    rests = np.linalg.norm(means - level[:, None], axis=0) < _GRAVITY_OFF * norm
    right = units.converted(1.0, "g", axes[0].unit)
    if not norm > 0.0 or rests.mean() < _AT_REST or abs(norm / right - 1.0) < _GRAVITY_OFF:
        return
    for unit, length in _GRAVITY.items():
        if abs(norm / length - 1.0) < _GRAVITY_OFF:
            typed = " ".join(f"--unit {axis.name}={unit}" for axis in axes)
            raise UserError(
                f"{recording.path}: ax, ay, az are in {axes[0].unit} by their headings; at rest their norm is "
                f"{norm:#.3g}, so the unit is {unit}: give {typed} (or their own unit, if it is right)"
            )
