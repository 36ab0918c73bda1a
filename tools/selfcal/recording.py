"""Recordings of a resting sensor: read (CSV, gzipped CSV, npz), check, and write.

CSV has one header row of `name[unit]`. An npz has one 1-D array a column, named like the CSV header, or named plainly
with unit and LSB in a JSON text `meta`: {"rate_hz": 100.0, "columns": {"gx": {"unit": "deg/s", "lsb": 0.05}}}. A CSV
file may have such a text beside it, LOG.meta.json. Every fault raises UserError with file, line and column in one line.
"""

from __future__ import annotations

import gzip
import json
import re
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from selfcal import units
from selfcal.errors import UserError
from selfcal.sampling import Ambiguous, sampling

#: Sensor columns unless a model names others; a recording needs at least one.
SENSORS = ("gx", "gy", "gz", "ax", "ay", "az")
#: Unit of a scaled LSB column where the scale states none, by the column's first letter.
_LSB_UNITS = {"g": "deg/s", "a": "m/s^2"}
#: Rows, and repeats a row, from which on stamps may repeat for being coarser than the sampling interval.
_REPEATS_FROM, _REPEATS_LEAST = 100, 0.005

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
    """A checked recording of n rows. `missing_before` int64[n]: samples missing just before each row."""

    path: Path
    rate_hz: float
    columns: Mapping[str, Column]
    missing_before: NDArray[np.int64]
    meta: Mapping[str, Any]

    @property
    def samples(self) -> int:
        """Rows present."""
        return int(self.missing_before.size)

    @property
    def duration_s(self) -> float:
        """Length with the missing samples, s."""
        return (self.samples + int(self.missing_before.sum())) / self.rate_hz

    @property
    def time_s(self) -> NDArray[np.float64]:
        """float64[n]: time since the first row on the even grid of the sampling rate, s."""
        return (np.arange(self.samples) + np.cumsum(self.missing_before)) / self.rate_hz

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
    Raises UserError for any file that is not a sound recording. O(n); about 2 s for 10^6 CSV rows of 7 columns.
    """
    path = Path(path)
    by_name: Mapping[str, Scale] = {"": (float(scale), None)} if isinstance(scale, int | float) else scale or {}
    if rate is not None and not (np.isfinite(rate) and rate > 0.0):
        raise UserError(f"the rate must be above 0 Hz, not {rate:g}")
    header = _Header(path, columns, units, by_name, sensors)
    name = path.name.lower()
    if path.is_dir():
        raise UserError(f"{path}: is a folder: name a recording in it (.csv, .csv.gz or .npz)")
    try:
        with path.open("rb") as stream:
            if not stream.read(1):
                raise UserError(f"{path}: the file is empty")
        if name.endswith(".npz"):
            return _load_npz(path, rate, header)
        if name.endswith((".csv", ".csv.gz")):
            return _load_csv(path, rate, header)
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from error
    raise UserError(f"{path}: not a recording (.csv, .csv.gz or .npz)")


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
    lsb = lsb or {}
    described: dict[str, Any] = {**(meta or {}), "rate_hz": float(rate_hz)}
    try:
        if path.suffix.lower() == ".npz":
            arrays: dict[str, NDArray[Any]] = {} if t is None else {"t[s]": np.asarray(t, np.float64)}
            described["columns"] = {}
            for name, (unit, values) in columns.items():
                if name in lsb:
                    counts = np.rint(np.asarray(values, np.float64) / lsb[name])
                    arrays[name] = counts.astype(np.int16 if np.abs(counts).max(initial=0) <= 32767 else np.int32)
                    described["columns"][name] = {"unit": unit, "lsb": float(lsb[name])}
                else:
                    arrays[f"{name}[{unit}]"] = np.asarray(values, np.float64)
            with path.open("wb") as stream:
                np.savez_compressed(stream, allow_pickle=False, meta=np.array(json.dumps(described)), **arrays)
            return
        if not path.name.lower().endswith((".csv", ".csv.gz")):
            raise UserError(f"{path}: a recording's name ends in .csv, .csv.gz or .npz")
        n = len(next(iter(columns.values()))[1])
        stamps = np.arange(n) / rate_hz if t is None else t
        table = np.column_stack([stamps, *(values for _, values in columns.values())])
        names = ",".join(["t[s]", *(f"{name}[{unit}]" for name, (unit, _) in columns.items())])
        np.savetxt(path, table, fmt=["%.12g"] + ["%.9g"] * len(columns), delimiter=",", header=names, comments="")
        if meta is None:
            _sidecar(path).unlink(missing_ok=True)
        else:
            _sidecar(path).write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from error


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
    """`name[unit]` in its parts; unit None without brackets."""
    match = re.fullmatch(r"(.*?)\s*\[(.*)\]", text.strip())
    return (match[1].strip(), match[2].strip()) if match else (text.strip(), None)


def _sidecar(path: Path) -> Path:
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
                f"{self.path}: {where}no sensor column ({', '.join(self.sensors)}) among '{_short(','.join(keys))}';"
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
        if stated is not None:
            if unit is not None and unit != stated and units.known(str(unit)):
                raise UserError(f"{column} is in {unit} by its header, --unit says {stated}")
            unit = stated
        if unit is None:
            if self.columns and not mapped and name != "t" and name not in self.sensors:
                return []
            if "[" in name or "]" in name:
                raise UserError(f"{column}: the brackets of its unit do not match: write name[unit]")
            known = {"t": "s", "temp": "degC", "supply": "V", **{key: _LSB_UNITS[key[0]] for key in SENSORS}}
            example = known.get(name, _LSB_UNITS.get(name[0]) if name in self.sensors else None)
            hint = f"write {name}[{example or 'UNIT'}] in the header or give --unit {name}={example or 'UNIT'}"
            leave = "" if example else ", or leave it out by naming what to read with --column NAME=HEADER"
            raise UserError(f"{column} has no unit: {hint}{leave}")
        if not isinstance(unit, str) or not units.known(unit):
            raise UserError(f"{column} has the unknown unit '{unit}' (known: {', '.join(units.RECORDING_UNITS)})")
        size = 1.0
        if unit == units.LSB:
            given = self.scale.get(name, self.scale.get(""))
            if given is None:
                raise UserError(f"{column} is in LSB: give the size of one with --scale {name}=SIZE[unit]")
            size, unit = given[0], given[1] or _LSB_UNITS.get(name[0])
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
    return float(value) if isinstance(value, int | float) else np.nan


def _short(text: str) -> str:
    """At most 60 printable characters of something found in a file."""
    clean = "".join(letter if letter.isprintable() else "?" for letter in text)
    return clean if len(clean) <= 60 else clean[:57] + "..."


# --------------------------------------------------------------------------------------------------------------- CSV


def _load_csv(path: Path, rate: float | None, header: _Header) -> Recording:
    text = _csv_text(path)
    lines = text.split("\n")
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise UserError(f"{path}: line 1: the file holds empty lines only")
    if "," not in lines[0] and re.search(r"[;\t]", lines[0]):
        raise UserError(f"{path}: line 1: columns must be separated by commas")
    keys = []
    for number, key in enumerate(lines[0].split(",")):
        inner = _unquoted(key)
        if inner is None:
            raise UserError(f"{path}: line 1: column {number + 1}: an unclosed quote: '{_short(key.strip())}'")
        keys.append(inner.strip())
    meta = _csv_meta(path)
    fields = header.fields(keys, "line 1: ", {})
    index = [keys.index(field.key) for field in fields]
    if len(lines) == 1:
        raise UserError(f"{path}: line 1: there is a header but no rows")
    if len(lines) == 2:
        raise UserError(f"{path}: line 2: one row only, a recording needs two or more")

    def fail(row: int, field: int | None, what: str) -> NoReturn:
        column = "" if field is None else f"column '{fields[field].name}': "
        raise UserError(f"{path}: line {row + 2}: {column}{what}")

    rows = lines[1:]
    table: NDArray[np.float64] | None = None
    if all(row.count(",") == len(keys) - 1 for row in rows):
        try:
            table = np.loadtxt(rows, delimiter=",", comments=None, usecols=index, ndmin=2)
        except ValueError:
            table = None
    if table is None or len(table) != len(rows):
        table = _scan(rows, len(keys), index, fail)
    return _checked(path, rate, meta, fields, list(table.T), fail)


def _unquoted(cell: str) -> str | None:
    """A cell without the spaces and the pair of quotes around it; None if one quote has no partner."""
    text = cell.strip()
    inner = text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text
    return None if '"' in inner else inner


def _csv_text(path: Path) -> str:
    try:
        if path.suffix.lower() == ".gz":
            with gzip.open(path) as stream:
                data = stream.read()
        else:
            data = path.read_bytes()
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise UserError(f"{path}: not a whole gzip file: {error}") from error
    start = 3 if data.startswith(b"\xef\xbb\xbf") else 0
    bad = data.find(b"\0")
    try:
        text = data[start:].decode("utf-8")
    except UnicodeDecodeError as error:
        bad = min(bad, error.start + start) if bad >= 0 else error.start + start
    if bad >= 0:
        raise UserError(f"{path}: line {data.count(10, 0, bad) + 1}: not text (byte 0x{data[bad]:02x})")
    return text.replace("\r\n", "\n")


def _csv_meta(path: Path) -> Mapping[str, Any]:
    beside = _sidecar(path)
    try:
        meta = json.loads(beside.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except ValueError as error:
        raise UserError(f"{beside}: not a JSON text: {error}") from error
    if not isinstance(meta, dict):
        raise UserError(f"{beside}: not a JSON mapping")
    return meta


_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*\Z", re.ASCII)
_NOT_FINITE = re.compile(r"[-+]?(nan|inf(inity)?)\Z", re.ASCII | re.IGNORECASE)


def _scan(lines: Sequence[str], width: int, index: Sequence[int], fail: _Fail) -> NDArray[np.float64]:
    """The slow exact way: float64[rows, fields], or the first fault. Columns that are not read may hold anything."""
    table = np.empty((len(lines), len(index)))
    for row, line in enumerate(lines):
        cells = line.split(",")
        if len(cells) != width:
            fail(row, None, f"{len(cells)} cells where the header has {width}" if line.strip() else "an empty line")
        for field, column in enumerate(index):
            cell = _unquoted(cells[column])
            if cell is None:
                fail(row, field, f"an unclosed quote: '{_short(cells[column].strip())}'")
            if not _NUMBER.match(cell) and not _NOT_FINITE.match(cell):
                fail(row, field, f"'{_short(cell)}' is not a number" if cell else "an empty cell")
            table[row, field] = float(cell)
    return table


# --------------------------------------------------------------------------------------------------------------- npz


def _load_npz(path: Path, rate: float | None, header: _Header) -> Recording:
    damaged = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, NotImplementedError, SyntaxError)
    with path.open("rb") as stream:
        if stream.read(4) not in (b"PK\x03\x04", b"PK\x05\x06"):  # of a zip, with members and without
            raise UserError(f"{path}: not an npz file")
    arrays: dict[str, NDArray[Any]] = {}
    try:
        archive = np.load(path, allow_pickle=False)
    except damaged as error:
        raise UserError(f"{path}: not a whole npz file: {_first_line(error)}") from error
    with archive:
        for key in archive.files:
            try:
                arrays[key] = np.asarray(archive[key])  # numpy hands out what is no array as bytes
            except damaged as error:
                raise UserError(f"{path}: column '{_short(key)}': cannot be read: {_first_line(error)}") from error
    meta = _npz_meta(path, arrays.pop("meta", None))
    if not arrays:
        raise UserError(f"{path}: there are no columns")
    fields = header.fields(list(arrays), "", meta.get("columns", {}))
    for field in fields:
        values, column = arrays[field.key], f"{path}: column '{field.name}'"
        if values.ndim != 1:
            raise UserError(f"{column} has {values.ndim} dimensions, not one")
        if values.dtype.kind not in "iuf":
            raise UserError(f"{column} holds no numbers (its type is {values.dtype})")
        if values.size != arrays[fields[0].key].size:
            raise UserError(f"{column} has {values.size} rows, '{fields[0].name}' has {arrays[fields[0].key].size}")
    rows = arrays[fields[0].key].size
    if rows < 2:
        raise UserError(f"{path}: {'one row only' if rows else 'no rows'}, a recording needs two or more")

    def fail(row: int, field: int | None, what: str) -> NoReturn:
        column = "" if field is None else f"column '{fields[field].name}': "
        raise UserError(f"{path}: row {row + 1}: {column}{what}")

    def as_read(field: _Field) -> NDArray[np.float64]:
        array = arrays[field.key]
        if field.name == "t" and array.dtype.kind in "iu":
            array = array.astype(np.int64) - int(array[0])  # time since an epoch in ns does not fit a float64
        return array.astype(np.float64)

    return _checked(path, rate, meta, fields, [as_read(field) for field in fields], fail)


def _npz_meta(path: Path, text: NDArray[Any] | None) -> Mapping[str, Any]:
    if text is None:
        return {}
    try:
        meta = json.loads(str(text.item()))
    except ValueError as error:
        raise UserError(f"{path}: meta: not a JSON text") from error
    if not isinstance(meta, dict):
        raise UserError(f"{path}: meta: not a JSON mapping")
    return meta


def _first_line(error: BaseException) -> str:
    return _short(str(error).split("\n")[0]) or type(error).__name__


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
        columns[field.name] = Column(field.name, field.unit, raw * field.lsb if field.lsb != 1.0 else raw.copy())
    stamps = columns.pop("t", None)
    if stamps is None:
        rate = rate if rate is not None else _meta_rate(path, meta)
        if rate is None:
            raise UserError(f"{path}: there is no time column: add t[s] or give --rate HZ")
        missing = np.zeros(table[0].size, np.int64)
    else:
        time = units.convert(stamps.values - stamps.values[0], stamps.unit, "s")
        number = [field.name for field in fields].index("t")
        found, missing = _sampling(path, time, stamps, rate, lambda row, what: fail(row, number, what))
        if rate is not None and (not 0.9 < found / rate < 1.1 or 2 * np.count_nonzero(missing) > missing.size):
            raise UserError(f"{path}: column 't' does not agree with --rate {rate:g}")
        rate = found if rate is None else rate
    return Recording(path, rate, columns, missing, meta)


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
    return float(f"{1.0 / dt:.10g}"), missing


def _meta_rate(path: Path, meta: Mapping[str, Any]) -> float | None:
    if "rate_hz" not in meta:
        return None
    rate = _number(meta["rate_hz"])
    if not (np.isfinite(rate) and rate > 0.0):
        raise UserError(f"{path}: meta: 'rate_hz' must be a number above 0")
    return rate
