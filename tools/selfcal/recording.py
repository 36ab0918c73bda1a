"""Recordings of a resting sensor: read, check, and write. `text_table.py` and `array_files.py` read the files.

Text has one header row of `name[unit]`. An npz has one 1-D array a column, named like the header, or named plainly
with unit and LSB in a JSON text `meta`: {"rate_hz": 100.0, "columns": {"gx": {"unit": "deg/s", "lsb": 0.05}}}. A text
file may have such a text beside it, LOG.meta.json. Every fault raises UserError with file, line and column in one line.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from selfcal import units
from selfcal.array_files import Members, mat, npz, parse_meta, r_data
from selfcal.errors import UserError, short, shown
from selfcal.limits import (
    LEAST_RATE_HZ,
    LONGEST,
    LONGEST_HEADING,
    MOST_META_BYTES,
    MOST_NUMBERS,
    MOST_RATE_HZ,
    read_text,
    reading,
)
from selfcal.output import together, whole
from selfcal.sampling import Ambiguous, sampling
from selfcal.suffixes import ARRAYS, READ, TEXT, WRITTEN
from selfcal.text_table import TextTable

#: Sensor columns unless a model names others; a recording needs at least one.
SENSORS = ("gx", "gy", "gz", "ax", "ay", "az")
#: Columns that are no axis but may explain one, by cause: name and unit.
SIDE_CHANNELS = MappingProxyType({"temperature": ("temp", "degC"), "supply": ("supply", "V")})
#: Unit of a scaled LSB column where the scale states none, by the column's first letter.
_LSB_UNITS = {"g": "deg/s", "a": "m/s^2"}
#: Rows, and repeats a row, from which on stamps may repeat for being coarser than the sampling interval.
_REPEATS_FROM, _REPEATS_LEAST = 100, 0.005

#: What reads a file of arrays, by its suffix.
_ARRAYS: Mapping[str, Callable[[Path], Members]] = dict(zip(ARRAYS, (npz, mat, r_data, r_data, r_data), strict=True))

_NOTHING: Mapping[str, str] = MappingProxyType({})

#: Size of one LSB, with its unit unless the column's usual one is meant.
Scale = tuple[float, str | None]
#: Raises UserError for a row (from 0), a field (by its place; None: the whole row) and what is wrong there.
_Fail = Callable[[int, int | None, str], NoReturn]


@dataclass(frozen=True)
class Column:
    """One column: `values` float64[n] in `unit`, all finite."""

    name: str
    unit: str
    values: NDArray[np.float64]


@dataclass(frozen=True)
class Recording:
    """A checked recording of n rows. `missing_before` int64[n]: samples missing just before each row.

    `off_grid_s` float64[n]: time stamp minus the even grid's, s; None without stamps. `start_s`: where in the file's
    recording the first row is, s. `moving`: how many of the missing samples are there, but were measured in motion.
    """

    path: Path
    rate_hz: float
    columns: Mapping[str, Column]
    missing_before: NDArray[np.int64]
    meta: Mapping[str, Any]
    off_grid_s: NDArray[np.float64] | None = None
    start_s: float = 0.0
    moving: int = 0

    @property
    def samples(self) -> int:
        """Rows present."""
        return int(self.missing_before.size)

    @property
    def duration_s(self) -> float:
        """Length with the missing samples, s."""
        return (self.samples + int(self.missing_before.sum())) / self.rate_hz

    @property
    def lost(self) -> int:
        """Samples that are not there at all."""
        return int(self.missing_before.sum()) - self.moving

    @property
    def time_s(self) -> NDArray[np.float64]:
        """float64[n]: time since the first row on the even grid of the sampling rate, s."""
        return (np.arange(self.samples) + np.cumsum(self.missing_before)) / self.rate_hz

    def with_rows(self, kept: NDArray[np.bool_], *, moving: bool = False) -> Recording:
        """The recording of the rows `kept` [n] alone, two or more. The others count as missing, and as `moving` where
        that is why they are left out. Rows before the first and after the last that is kept are cut off."""
        at = np.arange(self.samples) + np.cumsum(self.missing_before)
        where = np.flatnonzero(kept)
        missing = np.diff(at[where], prepend=at[where[0]] - 1) - 1
        inner = where[-1] - where[0] + 1 - where.size if moving else 0
        return replace(
            self,
            columns={name: replace(one, values=one.values[kept]) for name, one in self.columns.items()},
            missing_before=missing,
            off_grid_s=None if self.off_grid_s is None else self.off_grid_s[kept],
            start_s=self.start_s + float(at[where[0]] - at[0]) / self.rate_hz,
            moving=self.moving + int(inner),
        )

    def between(self, start_s: float | None, end_s: float | None) -> Recording:
        """The stretch from `start_s` on and before `end_s`, seconds of the recording. Raises UserError for an empty
        one, and for one that lies outside."""
        if start_s is None and end_s is None:
            return self
        first, last = 0.0 if start_s is None else start_s, math.inf if end_s is None else end_s
        if not 0.0 <= first < last:  # or not a number
            raise UserError(
                f"--start {first:g} --end {last:g}: takes two times in seconds, the first one before the other"
            )
        kept = (self.time_s >= first) & (self.time_s < last)
        if np.count_nonzero(kept) < 2:
            raise UserError(
                f"{self.path}: --start {first:g} --end {last:g}: fewer than two samples there; the recording lasts "
                f"{self.duration_s:.6g} s"
            )
        return self.with_rows(kept)

    def in_unit(self, name: str, unit: str) -> NDArray[np.float64]:
        """float64[n]: a column in `unit`. Raises UserError if it is absent or of another kind."""
        if name not in self.columns:
            raise UserError(f"{self.path}: there is no column '{name}' (there are {', '.join(self.columns)})")
        column = self.columns[name]
        if not units.same_kind(column.unit, unit):
            raise UserError(f"{self.path}: column '{name}' is in {column.unit}, which cannot be converted to {unit}")
        return units.convert(column.values, column.unit, unit)


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


def load(
    path: Path | str,
    rate: float | None = None,
    columns: Mapping[str, str] = _NOTHING,
    units: Mapping[str, str] = _NOTHING,
    scale: Mapping[str, Scale] | float | None = None,
    sensors: Collection[str] = SENSORS,
) -> Recording:
    """Read a recording.

    `rate`, Hz: needed without a `t` column; with one it must agree with it to 10 % and is taken as the true rate.
    `columns`: name here -> header in the file; with it, other columns that state no unit are left out.
    `units`: name here -> unit, for headers that state none or one that is not known.
    `scale`: size of one LSB, for all LSB columns or by name, with its unit (default deg/s for g*, m/s^2 for a*).
    `sensors`: columns of which at least one must be there.
    Raises UserError for any file that is not a sound recording, or is larger than `limits.py` says. O(n); about 2 s
    for 10^6 CSV rows of 7 columns.
    """
    path = Path(path)
    by_name: Mapping[str, Scale] = {"": (float(scale), None)} if isinstance(scale, int | float) else scale or {}
    if rate is not None and not LEAST_RATE_HZ <= rate <= MOST_RATE_HZ:
        raise UserError(f"the rate must be above 0 Hz ({LEAST_RATE_HZ:g} to {MOST_RATE_HZ:g} Hz), not {rate:g}")
    header = _Header(path, columns, units, by_name, sensors)
    if path.is_dir():
        raise UserError(f"{path}: is a folder: name a recording in it ({READ})")
    suffix = path.suffix.lower()
    with reading(path, "not a sound recording"):
        if suffix in _ARRAYS:
            with path.open("rb") as stream:
                if not stream.read(1):
                    raise UserError(f"{path}: the file is empty")
            return _load_arrays(path, rate, header, _ARRAYS[suffix](path))
        if path.name.lower().removesuffix(".gz").endswith(TEXT):
            return _load_text(path, rate, header)
        path.open("rb").close()
    raise UserError(f"{path}: not a recording: its name ends in none of {READ}")


def save(
    path: Path | str,
    columns: Mapping[str, tuple[str, NDArray[np.float64]]],
    rate_hz: float,
    meta: Mapping[str, Any] | None = None,
    t: NDArray[np.float64] | None = None,
    lsb: Mapping[str, float] | None = None,
) -> None:
    """Write a recording that `load` reads back; the suffix (.csv, .csv.gz, .npz) chooses the form.

    `columns`: name -> (unit, float[n]). `t` float[n], s: time stamps; None is an even grid from 0. `meta`: JSON values,
    kept in the npz or beside the CSV file as LOG.meta.json. `lsb`: name -> size of one LSB in the column's unit: npz
    stores such a column as whole numbers of it. CSV values carry 9 digits. Raises UserError for an unwritable file.
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
    names = ",".join(["t[s]", *(f"{name}[{unit}]" for name, (unit, _) in columns.items())])
    with together(path, meta_place(path)) as (table, beside):
        np.savetxt(table, values, fmt=["%.12g"] + ["%.9g"] * len(columns), delimiter=",", header=names, comments="")
        if meta is None:
            beside.unlink()
        else:
            beside.write_text(json.dumps({**described, "rows": len(values)}, indent=1) + "\n", encoding="utf-8")


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
            arrays[f"{name}[{unit}]"] = np.asarray(values, np.float64)
    with whole(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, meta=np.array(json.dumps(described)), **arrays)


def parse_pairs(option: str, pairs: Sequence[str]) -> dict[str, str]:
    """`NAME=VALUE` texts of a repeated command line option as a dict. Raises UserError naming the option."""
    found: dict[str, str] = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not (name and equals and value):
            raise UserError(f"{option} takes NAME=VALUE, not '{pair}'")
        if name in found:
            raise UserError(f"{option}: '{name}' is given twice")
        found[name] = value
    return found


def parse_scales(texts: Sequence[str]) -> dict[str, Scale]:
    """`--scale` texts, `0.05`, `gx=0.05` or `gx=0.05[deg/s]`, as `load` takes them; the empty name is every column."""
    scales: dict[str, Scale] = {}
    for name, text in parse_pairs("--scale", [item if "=" in item else f"*={item}" for item in texts]).items():
        number, unit = _split(text)
        try:
            scales["" if name == "*" else name] = (float(number), unit)
        except ValueError:
            wanted = "[NAME=]SIZE, a unit in brackets after it (gx=0.05[deg/s])"
            raise UserError(f"--scale takes {wanted}, not '{text}'") from None
    return scales


def _split(text: str) -> tuple[str, str | None]:
    """`name[unit]` or `name(unit)` in its parts; unit None without brackets."""
    text = text.strip()
    match = re.fullmatch(r"([^[]*)\[(.*)\]", text) or re.fullmatch(r"(.*?)\(((?:[^()]|\([^()]*\))*)\)", text)
    return (match[1].strip(), match[2].strip()) if match else (text, None)


def meta_place(path: Path) -> Path:
    """Where the metadata of a text recording stand: beside it. An npz holds its own."""
    return path.with_name(path.name + ".meta.json")


class _Header:
    """Works out from the keys of a file which columns to read, and in which unit."""

    def __init__(
        self,
        path: Path,
        columns: Mapping[str, str],
        stated: Mapping[str, str],
        scale: Mapping[str, Scale],
        sensors: Collection[str],
    ) -> None:
        self.path, self.columns, self.stated, self.scale, self.sensors = path, columns, stated, scale, sensors

    def fields(self, keys: Sequence[str], where: str, described: Any) -> list[_Field]:
        """One field for each column to read, in file order. `where` is put after the path in messages; `described` is
        what a meta text says of columns that are named plainly."""
        if not isinstance(described, dict) or not all(isinstance(entry, dict) for entry in described.values()):
            raise UserError(f"{self.path}: meta: 'columns' must be a mapping of column names to unit and lsb")
        for key in keys:
            if len(key) > LONGEST_HEADING or not key.isprintable():
                what = f"more than {LONGEST_HEADING} characters, or some that cannot be shown"
                raise UserError(f"{self.path}: {where}a heading of {what}: '{short(key)}'")
        renamed = self._renamed(keys, where)
        fields: list[_Field] = []
        for key in keys:
            plain, unit = _split(key)
            entry = described.get(plain, {}) if unit is None else {}
            unit = entry.get("unit", unit)
            fields += self._field(key, renamed.get(key, plain), unit, entry.get("lsb"), where, mapped=key in renamed)
        names = [field.name for field in fields]
        for name in names:
            if names.count(name) > 1:
                raise UserError(f"{self.path}: {where}column '{name}' appears twice")
        for option, wanted in (("--unit", self.stated), ("--scale", self.scale)):
            for name in wanted:
                if name and name not in names:
                    raise UserError(f"{self.path}: {where}there is no column '{name}' for {option}")
        if not any(name in self.sensors for name in names):
            raise UserError(
                f"{self.path}: {where}no sensor column ({', '.join(self.sensors)}) among '{short(','.join(keys))}';"
                " name yours with --column gx=NAME --unit gx=deg/s"
            )
        return fields

    def _renamed(self, keys: Sequence[str], where: str) -> dict[str, str]:
        renamed: dict[str, str] = {}
        for name, wanted in self.columns.items():
            matches = [key for key in keys if key == wanted] or [key for key in keys if _split(key)[0] == wanted]
            if not matches:
                raise UserError(f"{self.path}: {where}there is no column '{wanted}' for --column {name}={wanted}")
            if len(matches) > 1:
                raise UserError(f"{self.path}: {where}column '{wanted}' appears twice")
            if matches[0] in renamed:
                raise UserError(f"{self.path}: {where}column '{wanted}' is mapped to two names")
            renamed[matches[0]] = name
        return renamed

    def _field(self, key: str, name: str, unit: Any, lsb: Any, where: str, mapped: bool) -> list[_Field]:
        column = f"{self.path}: {where}column '{name}'"
        if not name:
            raise UserError(f"{self.path}: {where}a column has no name")
        stated = self.stated.get(name)
        if isinstance(unit, str):
            unit = units.plain(unit)
        if stated is not None:
            stated = units.plain(stated)
            if unit is not None and unit != stated and units.known(str(unit)):
                raise UserError(f"{column} is in {unit} by its header, --unit says {stated}")
            unit = stated
        left_out = self.columns and not mapped and name != "t" and name not in self.sensors
        if ("[" in name or "]" in name) and not (unit is None and left_out):
            raise UserError(f"{column}: the brackets of its unit do not match: write name[unit]")
        if unit is None:
            if left_out:
                return []
            known = {"t": "s", **dict(SIDE_CHANNELS.values()), **{key: _LSB_UNITS[key[0]] for key in SENSORS}}
            example = known.get(name, _LSB_UNITS.get(name[0]) if name in self.sensors else None)
            hint = f"write {name}[{example or 'UNIT'}] in the header or give --unit {name}={example or 'UNIT'}"
            leave = "" if example else ", or leave it out by naming what to read with --column NAME=HEADER"
            raise UserError(f"{column} has no unit: {hint}{leave}")
        if not isinstance(unit, str) or not units.known(unit):
            known_units = f"(known: {', '.join(units.RECORDING_UNITS)})"
            raise UserError(f"{column} has the unknown unit '{short(str(unit))}' {known_units}")
        size = 1.0
        if unit == units.LSB:
            given = self.scale.get(name, self.scale.get(""))
            if given is None:
                raise UserError(f"{column} is in LSB: give the size of one with --scale {name}=SIZE[unit]")
            size, unit = given[0], units.plain(given[1]) if given[1] else _LSB_UNITS.get(name[0])
            if unit is None or not units.known(unit) or unit == units.LSB:
                raise UserError(f"{column} is in LSB: --scale needs a unit, --scale {name}={size:g}[unit]")
        elif name in self.scale:
            raise UserError(f"{column} is in {unit}: --scale is for columns in LSB")
        elif lsb is not None:
            size = _number(lsb)
        if not (np.isfinite(size) and size > 0.0):
            raise UserError(f"{column}: the size of one LSB must be a number above 0")
        if name == "t" and not units.same_kind(unit, "s"):
            raise UserError(f"{column} is in {unit}, which is not a time (s, ms, us, ns)")
        return [_Field(key, name, unit, size)]


def _number(value: Any) -> float:
    """A JSON value as a number; NaN if it is none."""
    try:
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    except OverflowError:
        return math.inf


# ----------------------------------------------------------------------------------------------------------- loaders


def _load_text(path: Path, rate: float | None, header: _Header) -> Recording:
    with ExitStack() as files:
        table = TextTable(path, files)
        meta = _meta_beside(path)
        fields = header.fields(table.keys, table.where, {})
        columns = table.columns([(field.key, field.name) for field in fields])
    if meta.get("rows", columns[0].size) != columns[0].size:
        what = f"{columns[0].size} rows where {meta_place(path).name} says {shown(meta['rows'])}"
        raise UserError(f"{path}: {what}: it was cut or changed; without that file it is read as it is")

    def fail(row: int, field: int | None, what: str) -> NoReturn:
        table.fail(row, None if field is None else fields[field].name, what)

    return _checked(path, rate, meta, fields, columns, fail)


def _meta_beside(path: Path) -> Mapping[str, Any]:
    beside = meta_place(path)
    try:
        return parse_meta(beside, read_text(beside, MOST_META_BYTES, "not a JSON text"))
    except FileNotFoundError:
        return {}


def _load_arrays(path: Path, rate: float | None, header: _Header, members: Members) -> Recording:
    arrays, meta = members
    if not arrays:
        raise UserError(f"{path}: there are no columns")
    fields = header.fields(list(arrays), "", meta.get("columns", {}))
    rows = math.prod(arrays[fields[0].key].shape)
    for field in fields:
        member, column = arrays[field.key], f"{path}: column '{field.name}'"
        if len(member.shape) != 1:
            raise UserError(f"{column} has {len(member.shape)} dimensions, not one")
        if member.dtype.kind not in "iuf":
            raise UserError(f"{column} holds no numbers (its type is {short(str(member.dtype))})")
        if member.shape[0] != rows:
            raise UserError(f"{column} has {member.shape[0]} rows, '{fields[0].name}' has {rows}")
    if rows < 2:
        raise UserError(f"{path}: {'one row only' if rows else 'no rows'}, a recording needs two or more")
    if rows * len(fields) > MOST_NUMBERS:
        raise UserError(f"{path}: more than {MOST_NUMBERS:,} numbers: cut it in parts, or read fewer columns")

    def fail(row: int, field: int | None, what: str) -> NoReturn:
        column = "" if field is None else f"column '{fields[field].name}': "
        raise UserError(f"{path}: row {row + 1}: {column}{what}")

    def as_read(number: int) -> NDArray[np.float64]:
        array = arrays[fields[number].key].read()
        if fields[number].name == "t" and array.dtype.kind in "iu":
            # Time since an epoch in ns does not fit a float64; a difference of two int64 fits a uint64.
            back = array[1:] < array[:-1]
            if back.any():
                fail(int(np.argmax(back)) + 1, number, "time runs backwards")
            bits = array.astype(np.uint64 if array.dtype.kind == "u" else np.int64).view(np.uint64)
            array = bits - bits[0]
        return array.astype(np.float64)

    return _checked(path, rate, meta, fields, [as_read(number) for number in range(len(fields))], fail)


# ------------------------------------------------------------------------------------------------------ common checks


def _checked(
    path: Path,
    rate: float | None,
    meta: Mapping[str, Any],
    fields: Sequence[_Field],
    table: Sequence[NDArray[np.float64]],
    fail: _Fail,
) -> Recording:
    """The recording of raw columns `table`, float64[n] each. `fail(row, field, what)` raises for a row of the file."""
    columns: dict[str, Column] = {}
    for number, (field, raw) in enumerate(zip(fields, table, strict=True)):
        finite = np.isfinite(raw)
        if not finite.all():
            row = int(np.argmin(finite))
            fail(row, number, "not a number (NaN)" if np.isnan(raw[row]) else "infinite")
        values = raw * field.lsb if field.lsb != 1.0 else raw
        if not np.isfinite(values).all():
            fail(int(np.argmin(np.isfinite(values))), number, f"infinite at {field.lsb:g} {field.unit} an LSB")
        columns[field.name] = Column(field.name, field.unit, values)
    _check_truth(path, meta)
    rows = table[0].size
    stamps = columns.pop("t", None)
    off_grid = None
    if stamps is None:
        rate = rate if rate is not None else _meta_rate(path, meta)
        if rate is None:
            raise UserError(f"{path}: there is no time column: add t[s] or give --rate HZ")
        missing = np.zeros(rows, np.int64)
    else:
        time = units.convert(stamps.values - stamps.values[0], stamps.unit, "s")
        if not np.isfinite(time[-1]):
            raise UserError(f"{path}: column 't' spans more than a number can hold")
        number = [field.name for field in fields].index("t")
        found, missing = _sampling(path, time, stamps, rate, lambda row, what: fail(row, number, what))
        if rate is not None and (not 0.9 < found / rate < 1.1 or 2 * np.count_nonzero(missing) > missing.size):
            raise UserError(f"{path}: column 't' does not agree with --rate {rate:g}")
        rate = found if rate is None else rate
        if not LEAST_RATE_HZ <= rate <= MOST_RATE_HZ:
            what = f"not {LEAST_RATE_HZ:g} to {MOST_RATE_HZ:g}: is the unit of t right?"
            raise UserError(f"{path}: column 't': a sampling rate of {rate:g} Hz, {what}")
        off_grid = time - (np.arange(rows) + np.cumsum(missing) - missing[0]) / rate
    return Recording(path, rate, columns, missing, meta, off_grid)


def _sampling(
    path: Path, time: NDArray[np.float64], stamps: Column, rate: float | None, fail: Callable[[int, str], NoReturn]
) -> tuple[float, NDArray[np.int64]]:
    """Rate in Hz and missing_before[n] from time stamps float64[n] (s, from 0); `stamps` are those of the file."""
    steps = np.diff(time)
    if (steps < 0.0).any():
        fail(int(np.argmax(steps < 0.0)) + 1, "time runs backwards")
    repeats = steps == 0.0
    few = time.size < _REPEATS_FROM or np.count_nonzero(repeats) < _REPEATS_LEAST * time.size
    if repeats.any() and (few or repeats.all()):
        fail(int(np.argmax(repeats)) + 1, "the time stamp repeats")
    noise = float(np.abs(units.convert(np.spacing(np.abs(stamps.values).max(keepdims=True)), stamps.unit, "s"))[0])
    try:
        dt, missing = sampling(time, noise, rate)
    except Ambiguous as error:
        raise UserError(f"{path}: column 't': {error}: give --rate HZ") from error
    if repeats.any() and dt > 0.999 * float(steps[~repeats].min()):  # not for being coarse
        fail(int(np.argmax(repeats)) + 1, "the time stamp repeats")
    if not 0.0 < dt < math.inf or not time[-1] / dt < LONGEST:
        raise UserError(f"{path}: column 't' makes no even grid: is it the time?")
    return float(f"{1.0 / dt:.10g}"), missing


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
