"""Which columns of a table to read, and in which units: what its headings say, and what the user states."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.base import units
from selfcal.base.errors import UserError, short
from selfcal.base.limits import LONGEST_HEADING, MOST_HEADINGS
from selfcal.base.options import Scale
from selfcal.base.units import SENSOR_UNITS
from selfcal.logs import written
from selfcal.logs.loaders.damage import SOUND
from selfcal.logs.loaders.headings import PART, Meaning, Sensor, sensors_of, split
from selfcal.logs.loaders.table import Field
from selfcal.logs.loaders.text_table import is_clock, is_date, is_row
from selfcal.logs.loaders.texts import Text
from selfcal.logs.recorded import SIDE_UNITS

#: What to type where no heading is a sensor's.
NAME_YOURS = "name yours with --column gx=NAME, and --unit gx=UNIT where its heading has none"
#: Columns without a unit that begin with a whole number, from which on they may be counts.
_COUNTS_FROM = 3


@dataclass(frozen=True)
class Asked:
    """How the user wants a log to be read: the arguments of `load()`, `units` and `scale` by name."""

    rate: float | None
    columns: Mapping[str, str]
    units: Mapping[str, str]
    scale: Mapping[str, Scale]
    sensors: Collection[str]
    no_time: bool
    skip_bad: bool
    sources: Sequence[str]
    dbc: Path | str | None

    @property
    def options(self) -> tuple[tuple[str, str], ...]:
        """The options as the command line has them."""
        given = [] if self.rate is None else [("--rate", f"{self.rate:.15g}")]
        for option, pairs in (("--column", self.columns), ("--unit", self.units)):
            given += [(option, f"{name}={value}") for name, value in pairs.items()]
        for name, (size, unit) in self.scale.items():
            text = f"{size:.15g}" + ("" if unit is None else f"[{unit}]")
            given.append(("--scale", f"{name}={text}" if name else text))
        given += [("--source", name) for name in self.sources]
        given += [] if self.dbc is None else [("--dbc", str(self.dbc))]
        switches = (("--no-time", self.no_time), ("--skip-bad", self.skip_bad))
        return (*given, *((option, "") for option, wanted in switches if wanted))


class Header:
    """Works out from the keys of a table which columns to read, and in which unit."""

    def __init__(self, path: Path, asked: Asked, several: bool) -> None:
        self.path, self.asked, self.columns, self.sensors = path, asked, asked.columns, asked.sensors
        self.stated, self.scale, self.rate, self.no_time = asked.units, asked.scale, asked.rate, asked.no_time
        #: `meta` states the clocks of the table.
        self.written = False
        #: The table is not alone: a column may be in another.
        self.several = several
        self.notes: list[str] = []
        self.damaged = SOUND
        #: Heading of a column of dates that is not taken for the time.
        self.dated = ""
        #: Columns whose unit the user states, or scales.
        self.decided = {*self.stated, *(self.scale if "" not in self.scale else self.sensors)}
        #: Names that the user gives of columns, here or in the file, and that are there.
        self.found: set[str] = set()
        #: The headings of all tables of the file.
        self.seen: set[str] = set()
        #: Columns of a table that lack a unit, or the size of a count: heading, name here, and the usual unit.
        self.without_unit: list[tuple[str, str, str]] = []
        self.without_size: list[tuple[str, str, str]] = []
        #: Headings of columns without a unit that begin with a whole number.
        self.whole: set[str] = set()

    def of_part(self, several: bool) -> Header:
        """The header for a part of the file."""
        part = copy(self)
        part.several, part.notes, part.without_unit, part.without_size = several, [], [], []
        part.damaged = SOUND
        part.whole = set()
        return part

    def knows_in(self, text: Text) -> Callable[[Sequence[str]], bool]:
        """Whether any heading of a line in a text is a sensor's. At most MOST_HEADINGS headings are looked at."""
        left = MOST_HEADINGS

        def knows(keys: Sequence[str]) -> bool:
            nonlocal left
            left -= len(keys)
            named = any(key in self.columns.values() for key in keys)
            return named or (left > 0 and bool(self.sensors_of(keys, text.name)))

        return knows

    def sensors_of(self, keys: Sequence[str], file: str = "", before: Sequence[str] | None = None) -> list[Sensor]:
        """The sensors of a table with these headings, after the lines `before` of a text."""
        sensors = []
        for sensor in sensors_of(file or self.path.name, keys, self.sensors, self.mapped(keys), before):
            meant = {
                key: own
                for key, own in sensor.meant.items()
                if not own.optional or any(self._of(given, key, own.name) for given in (self.stated, self.scale))
            }
            if any(own.name in self.sensors for own in meant.values()) or len(meant) == len(sensor.meant):
                sensors.append(replace(sensor, meant=meant))
        return sensors

    def mapped(self, keys: Sequence[str]) -> dict[str, str]:
        """The names here, by heading, that the user gives."""
        return {key: name for name, wanted in self.columns.items() for key in _called(keys, wanted)}

    def fields(
        self, keys: Sequence[str], where: str, described: Any, cells: Mapping[str, str], meant: Mapping[str, Meaning]
    ) -> list[Field]:
        """A field for each column to read, in file order. `where` is put after the path in messages; `described` is
        what a meta text says of columns that are named plainly; `cells`: those of the first row of a text, by heading;
        `meant`: what `sensors_of` found of the sensor."""
        if not isinstance(described, dict) or not all(isinstance(entry, dict) for entry in described.values()):
            raise UserError(f"{self.path}: meta: 'columns' must be a mapping of column names to unit and lsb")
        for key in keys:
            if len(key) > LONGEST_HEADING or not key.isprintable():
                what = f"more than {LONGEST_HEADING} characters, or some that cannot be shown"
                raise UserError(f"{self.path}: {where}a heading of {what}: '{short(key)}'")
        renamed = self._renamed(keys, where)
        read: list[Field] = []
        for key in keys:
            name, unit = split(key)
            if unit is not None and unit.isdecimal():
                unit = None  # a place in an array
            size = 1.0
            if key in renamed:
                name = renamed[key]
            elif key in meant:
                name, unit, size = meant[key].name, meant[key].unit, meant[key].size
            entry = described.get(split(key)[0], {}) if unit is None else {}
            cell = cells.get(key, "")
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
            if not (name in ("t", PART) and self.no_time):
                lsb = entry.get("lsb", None if size == 1.0 else size)
                read += self._field(key, name, entry.get("unit", unit), lsb, where, mapped=key in renamed, dates=dates)
        if self.without_unit or self.without_size:
            raise UserError(f"{self.path}: {where}{self._what_to_state()}")
        names = [field.name for field in read]
        fields = [field for field in read if not field.optional or names.count(field.name) == 1]
        names = [field.name for field in fields]
        for name in names:
            if names.count(name) > 1:
                raise UserError(f"{self.path}: {where}column '{name}' appears twice")
        if not self.several:
            self.check_options(names, where)
        if not any(name in self.sensors for name in names):
            none = f"{self.path}: {where}no sensor column ({', '.join(self.sensors)}) among '{short(','.join(keys))}'; "
            if is_row(",".join(keys)):
                headings = ",".join(["t[s]", *(f"{name}[{unit}]" for name, unit in SENSOR_UNITS.items())])
                raise UserError(f"{none}put a line of headings before it, such as {headings}, in the columns' order")
            raise UserError(f"{none}{NAME_YOURS}")
        return fields

    def marks(self, keys: Sequence[str], meta: Mapping[str, Any], fields: Sequence[Field]) -> list[Field]:
        """The columns that state the clocks of a table that `convert` wrote. The user's rate, or no time, decides."""
        self.written = written.stated(meta) and self.rate is None and any(field.name == "t" for field in fields)
        marks = written.marks_of(meta) if self.written else ()
        return [Field(key, f"{key} ", "1", 1.0) for key in keys if key in marks]

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
            matches = _called(keys, wanted)
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

    def _own_names(self, key: str) -> list[str]:
        """A heading, without its unit, and the matrix that it is a column of; none that means a column here."""
        name = split(key)[0]
        matrix, _, number = name.rpartition(":")
        here = {"t", *self.sensors, *SIDE_UNITS}
        return [own for own in (key, name, *([matrix] if number.isdigit() else [])) if own not in here]

    def _what_to_state(self) -> str:
        """The options to type for the columns without a unit or a size, by the file's own names."""
        if len(self.without_unit) == 1 and self.without_unit[0][0] == self.without_unit[0][1]:
            name, _, unit = self.without_unit[0]
            return (
                f"column '{name}' has no unit: write {name}[{unit}] in the header or give --unit {name}={unit}, or the "
                "unit that it is in"
            )
        counts = [column for column in self.without_unit if column[0] in self.whole]
        if len({name for _, name, _ in counts}) < _COUNTS_FROM:  # a single column may hold whole numbers by chance
            counts = []
        stated = [column for column in self.without_unit if column not in counts]
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
        """For each option to type the name, quoted, and the unit. Columns of a matrix and kind share an option."""
        typed: dict[str, str] = {}
        for key, name, unit in columns:
            own = [heading for heading in self._own_names(key) if "=" not in heading]
            typed[shlex.quote(own[-1] if own and split(key)[0] != name else name)] = unit
        return list(typed.items())

    def _field(self, key: str, name: str, unit: Any, lsb: Any, where: str, *, mapped: bool, dates: bool) -> list[Field]:
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
        optional = not asked and name not in ("t", PART) and name not in self.sensors
        dates = dates and name == "t" and stated is None
        unit = "s" if dates else unit
        known = isinstance(unit, str) and units.known(unit)
        example = {"t": "s", **SIDE_UNITS, **SENSOR_UNITS}.get(name, "UNIT")
        to_scale = (
            f"give --scale {shlex.quote(f'{name}=SIZE[{example}]')}, SIZE the {example} of one '{short(str(unit))}'"
        )
        if not known and unit is not None and scaled is not None:
            unit, known = units.LSB, True
        broken = ("[" in name or "]" in name) and not mapped
        if broken and any(name.startswith(sensor) for sensor in ("t", *self.sensors)):
            raise UserError(f"{column}: the brackets of its unit do not match: write name[unit]")
        if optional and (not name or broken or not known or (unit == units.LSB and "" not in self.scale)):
            if name in SIDE_UNITS:
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
                self.without_size.append((key, name, SENSOR_UNITS.get(name, "UNIT")))
                return []
            size, unit = given[0], units.plain(given[1]) if given[1] else SENSOR_UNITS.get(name)
            if unit is None or not units.known(unit) or unit == units.LSB:
                raise UserError(f"{column} is in LSB: --scale needs a unit, --scale {name}={size:g}[unit]")
        elif scaled is not None:
            raise UserError(f"{column} is in {unit}: --scale is for columns in LSB")
        elif lsb is not None:
            size = number_in(lsb)
        if not (np.isfinite(size) and size > 0.0):
            raise UserError(f"{column}: the size of one LSB must be a number above 0")
        if name == "t" and not units.same_kind(unit, "s"):
            raise UserError(f"{column} is in {unit}, which is not a time (h, min, s, ms, us, ns)")
        return [Field(key, name, unit, size, optional and name not in SIDE_UNITS, dates)]


def _called(keys: Sequence[str], wanted: str) -> list[str]:
    """The headings that the user calls `wanted`: those that are it, else those of this name and any unit."""
    return [key for key in keys if key == wanted] or [key for key in keys if split(key)[0] == wanted]


def number_in(value: Any) -> float:
    """A JSON value as a number; NaN for any other value."""
    try:
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    except OverflowError:
        return math.inf
