"""Recordings that are text: columns separated by commas, semicolons, tabs or blanks, under a header line.

The header is the first line with a heading that the caller knows and no number; lines before it are skipped. Else it is
the first line that is no comment, or, where numbers follow comments, the last comment, as `numpy.savetxt` writes it.
Between semicolons, tabs or blanks a comma is a decimal sign. An empty cell is NaN. The text is read in blocks: at most
one block is in memory.
"""

from __future__ import annotations

import codecs
import gzip
import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, cast

import numpy as np
from rich.console import Console
from rich.progress import wrap_file

from selfcal.base import units
from selfcal.base.errors import UserError, note, short
from selfcal.base.grid import Array, Rows
from selfcal.base.limits import (
    BLOCK_BYTES,
    LONGEST_HEADING,
    MOST_COLUMNS,
    MOST_LEADING_LINES,
    MOST_TEXT_GROWTH,
    reading,
)
from selfcal.logs.loaders.damage import Damaged
from selfcal.logs.loaders.headings import RECEIVED, number_of
from selfcal.logs.loaders.table import bound_numbers, check_rows

_SEPARATORS = {",": "','", ";": "';'", "\t": "tabs"}
#: Beginning of a comment.
_COMMENT = re.compile(r"\s*(#|//|%)[#/% \t]*")
#: The last heading of LabVIEW's texts, in small letters.
_COMMENT_OF_ROWS = "comment"
#: Nothing but numbers and what separates them.
_ROW = re.compile(r"[-+.,;\t \"eE\d]*\d[-+.,;\t \"eE\d]*", re.ASCII)
_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*", re.ASCII)
#: A number and its unit, in a cell.
_WITH_UNIT = re.compile(r"\s*[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)? ([^\W\d_][\w/^]{0,20})\s*", re.ASCII)
_QUOTED = ' "'
#: A number whose thousands commas separate: without a point a single comma may be the decimal sign.
_THOUSANDS = re.compile(r"[-+]?\d{1,3}(?:(?:,\d{3})+\.\d*|(?:,\d{3}){2,})", re.ASCII)
_NOT_FINITE = re.compile(r"[-+]?(nan|inf(inity)?)", re.ASCII | re.IGNORECASE)
#: A cell that holds no sample.
_MISSING = re.compile(r"(nan?|#?n/a|#nv|null|none|-+|\?)?", re.ASCII | re.IGNORECASE)
#: A date with a time of day (ISO 8601), in quotes or not.
_ISO = re.compile(
    r"(?:\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d(?:[.,]\d+)?)?|\d{8}T\d{6}(?:[.,]\d+)?)(?:Z|[-+]\d\d:?\d\d)?", re.ASCII
)
#: A date or a time of day in any form.
_CLOCK = re.compile(r"(\d{1,4}[./-]\d{1,2}[./-]\d{1,4}|\d{1,2}:\d\d)\b.*", re.ASCII)
#: A time of day with parts of a second; a date of any form before it, and a zone after it, say nothing more.
_OF_DAY = re.compile(
    r"(?:\d{1,4}[./-]\d{1,2}[./-]\d{1,4}[T ,_]+)?(\d{1,2}):(\d\d):(\d\d(?:[.,:]\d{1,9})?)(?: ?([AaPp])[Mm])?"
    r"(?: ?(?:Z|UTC|[-+]\d\d:?\d\d))?",
    re.ASCII,
)
_DAY_S = units.factor("day", "s")
#: Stamp that a serial monitor puts before a line.
_MONITOR = re.compile(r"(\d\d:\d\d:\d\d\.\d{1,6}) -> ", re.ASCII)
#: Bytes that are no text, as they are decoded: a zero, and what is no UTF-8.
_NO_TEXT = re.compile("[\0\udc80-\udcff]")
#: The signs of units, and blanks, in the single-byte alphabets that Excel writes in Europe.
_SINGLE = {0xDC00 + code: chr(code) for code in b"\xa0\xb0\xb2\xb3\xb5\xb7\xb9\xba"}
#: Texts in UTF-16, by the mark that they begin with.
_WIDE = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}


#: A sampling rate in a comment, as Xsens writes it.
_RATE = re.compile(r"(?:sampl\w+|update|output|data)[ _]?rate\W{1,4}(\d+(?:\.\d+)?) ?Hz", re.ASCII | re.IGNORECASE)

#: Rows in which the sensors that take turns are looked for, and their names.
LOOKED_AT, _WORD = 1000, re.compile(r"\w[\w ./:-]{0,59}")
#: Turns of a sensor at least.
_TURNS = 5

#: Function that opens a text in an archive: its bytes, and its packed size.
Opened = Callable[[ExitStack], tuple[BinaryIO, int]]


class _Bad(Exception):
    """What is wrong with a row: the place of the column among those read (None: the whole row), and the text."""

    def __init__(self, place: int | None, what: str) -> None:
        self.place, self.what = place, what


class TextReader:
    """A table being read: `keys` are its headings, `first` the cells of its first row, `where` the header's line."""

    def __init__(
        self,
        path: Path,
        files: ExitStack,
        knows: Callable[[Sequence[str]], bool],
        *,
        skip_bad: bool = False,
        opened: Opened | None = None,
    ) -> None:
        """Read as far as the header. `files` closes the file. `knows`: whether a line of headings has a known heading.
        `skip_bad`: leave out lines that are no row, and count them as `skipped`. `opened` opens a text in an archive.
        Raises UserError."""
        self.path = path
        #: The lines before the header.
        self.before: list[str] = []
        self._heads: set[str] = set()
        #: Lines after the header, from 0, before which it is repeated.
        self.restarts: list[int] = []
        self._lines = _Lines(path, *(_opened(path, files) if opened is None else opened(files)), skip_bad)
        header, number, self._row = self._header(knows)
        self._batch = self._lines.rest or self._lines.more()
        if not self._batch:
            raise UserError(f"{path}: line {number}: there is a header but no rows")
        self._separator = self._separated(header, self._batch[0], number)
        self._decimal: str | None = None
        self._skip_bad, self._skipped = skip_bad, list[int]()
        #: Lines that were left out.
        self.damaged = Damaged()
        #: With `skip_bad`, after `columns`: int64[n], the place of each row among the lines after the header.
        self.places: Rows | None = None
        self._origin: datetime | None = None
        #: First and last time of day, and the days since, s.
        self._day = (math.nan, math.nan, 0.0)
        #: Units after the numbers of a cell, by column.
        self._ending: dict[int, str] = {}
        #: The column that numbers the sensors, and the cell of the sensor that is read.
        self._only: tuple[int, str] | None = None
        self.where = f"line {number}: "
        headings = self._stated(_words(header) if self._separator == " " else _split(header, self._separator))
        if len(headings) == len(self._cells(self._batch[0])) + 1 and headings[-1].strip().lower() == _COMMENT_OF_ROWS:
            del headings[-1]  # LabVIEW writes a cell for comments only in rows with a comment
        cells = self._cells(self._batch[0])
        if len(cells) == len(headings) + 1 and not cells[-1].strip():
            headings.append("")  # a separator ends each row
        self.keys = [self._heading(cell, number, place) for place, cell in enumerate(headings)]
        self.first = [cell.strip(_QUOTED) for cell in self._cells(self._batch[0])]

    @property
    def skipped(self) -> int:
        """Lines that were left out."""
        return len(self._skipped)

    def stated_rate(self) -> float | None:
        """The rate, Hz, that a line before the header states."""
        match = next(filter(None, (_RATE.search(line) for line in self.before)), None)
        return float(match[1]) if match else None

    @property
    def origin_s(self) -> float:
        """The first date, s since 1970; 0 without dates. A date without a zone counts as UTC."""
        if self._origin is None:
            return 0.0 if math.isnan(self._day[0]) else self._day[0]
        return (self._origin if self._origin.tzinfo else self._origin.replace(tzinfo=UTC)).timestamp()

    def in_turn(self) -> list[tuple[str, str]]:
        """The column by which the rows of several sensors take turns, and its cell for each of them; none of one."""
        rows = [cells for line in self._batch[:LOOKED_AT] if len(cells := self._cells(line)) == len(self.keys)]
        return in_turn(self.keys, [[row[column].strip(_QUOTED) for row in rows] for column in range(len(self.keys))])

    def only(self, key: str, cell: str) -> None:
        """Read only the rows that have this cell in a column."""
        self._only = self.keys.index(key), cell

    def line_of(self, row: int) -> int:
        """The line of a row (from 0) of the table that `columns` gave."""
        return self._row + (row if self.places is None else int(self.places[row]))

    def fail(self, row: int, column: str | None, what: str) -> NoReturn:
        """Raise UserError for a row (from 0), and a column of it, of the table that `columns` gave."""
        self._fail(self.line_of(row) - self._row, column, what)

    def _fail(self, line: int, column: str | None, what: str) -> NoReturn:
        column = "" if column is None else f"column '{column}': "
        raise UserError(f"{self.path}: line {self._row + line}: {column}{what}")

    def columns(
        self, names: Sequence[tuple[str, str]], optional: Sequence[bool] = (), time: int | None = None
    ) -> list[Array | None]:
        """The columns [n] of pairs (heading, name in messages), n at least 2; NaN where a cell is empty.

        `optional`: such a column is None if a cell of it is no number. `time`: the place of a column of dates, which
        becomes seconds since the first. Raises UserError for the first fault.
        """
        index = [self.keys.index(key) for key, _ in names]
        parts: list[list[Array] | None] = [[] for _ in index]
        lines, rows, blank, batch = 0, 0, False, self._batch
        places: list[Rows] = []
        while batch:
            batch = self._kept(batch, lines)
            if self._lines.unfinished and batch and batch[0].strip():
                # A line that was cut within its last number would be taken for another value.
                note(f"{self.path}: line {self._row + lines} has no line end and may be cut off: left out")
                self.damaged += Damaged(len(batch[0]), 1)
                break
            filled = len(batch)
            while filled and not batch[filled - 1].strip():
                filled -= 1
            if blank and filled and not self._skip_bad:
                self._fail(lines, None, "an empty line")
            blank = blank or filled < len(batch)
            wanted = [k for k, part in enumerate(parts) if part is not None]
            bound_numbers(self.path, (rows + filled) * len(wanted))
            skipped = len(self._skipped)
            dated = None if time is None else wanted.index(time)
            table = self._parse(batch[:filled], [index[k] for k in wanted], dated)
            if table is None:
                table = self._scan(batch[:filled], lines, index, names, optional, time, parts)
                wanted = [k for k in wanted if parts[k] is not None]
            for k, column in zip(wanted, table.T, strict=True):
                cast(list[Array], parts[k]).append(np.ascontiguousarray(column))
            if self._skip_bad:
                left_out = np.array(self._skipped[skipped:], np.int64) - lines
                places.append(np.delete(np.arange(lines, lines + filled), left_out))
            lines += len(batch) if self._skip_bad else filled
            rows += len(table)
            batch = self._lines.more()
        if not rows:
            raise UserError(f"{self.path}: line {self._row - 1}: there is a header but no rows")
        check_rows(f"{self.path}: line {self._row + rows - 1}: ", rows)
        self.places = np.concatenate(places) if self._skip_bad else None
        whole: list[Array | None] = []
        while parts:  # no column stays in both forms
            part = parts.pop(0)
            whole.append(None if part is None else np.concatenate(part))
        return whole

    def _kept(self, batch: list[str], before: int) -> list[str]:
        """The lines of a block without those that repeat the header, and of a single sensor. `before`: lines before it,
        for the count of lines."""
        if self._skip_bad:
            return batch
        again = {line for line in set(batch) if line.strip() in self._heads} if self._heads else set()
        if again:
            first = next(row for row, line in enumerate(batch) if line in again)
            note(f"{self.path}: line {self._row + before + first} repeats the header: the log goes on there")
            self.restarts.append(before + first)
            batch, count = [line for line in batch if line not in again], len(batch)
            self._row += count - len(batch)
        if self._only is not None:
            column, cell = self._only
            batch = [
                line
                for line in batch
                if len(cells := self._cells(line)) <= column or cells[column].strip(_QUOTED) == cell
            ]
        return batch

    def _header(self, knows: Callable[[Sequence[str]], bool]) -> tuple[str, int, int]:
        """The header line, its number, and the first row's; the lines after it are the rest."""
        batch = self._lines.more()
        comment, plain = -1, -1
        for row, line in enumerate(batch):
            if row >= MOST_LEADING_LINES + 1:
                break
            if not line.strip():
                continue
            bare = _bare(line)
            if plain < 0:
                if bare != line.strip(" "):
                    comment = row
                else:
                    plain = row
            if _is_header(bare, batch[row + 1 : row + 2], knows):
                return self._begins(batch, row, row + 1, bare)
            named = _with_units(bare, batch[row + 1 : row + 2])
            if named and _is_header(named, batch[row + 2 : row + 3], knows):
                return self._begins(batch, row, row + 2, named)
        if comment >= 0 and plain >= 0 and _ROW.fullmatch(batch[plain]):
            return self._begins(batch, comment, plain, _bare(batch[comment]))
        if 0 <= plain < MOST_LEADING_LINES:
            return self._begins(batch, plain, plain + 1, batch[plain])
        if len(batch) > MOST_LEADING_LINES:
            raise UserError(f"{self.path}: line {MOST_LEADING_LINES + 1}: no header in the first {MOST_LEADING_LINES}")
        raise UserError(f"{self.path}: line 1: the file holds {'comments' if comment >= 0 else 'empty lines'} only")

    def _begins(self, batch: list[str], header: int, row: int, text: str) -> tuple[str, int, int]:
        """The header `text` in line `header` of the first batch, the first row in line `row`, both from 0."""
        if no_text := _NO_TEXT.search(text):
            raise UserError(_of_no_text(self.path, header + 1, no_text[0]))
        self._lines.rest = batch[row:]
        self.before = batch[:header]
        self._heads = {line.strip() for line in batch[header:row]}
        return text, header + 1, row + 1

    def _separated(self, header: str, row: str, number: int) -> str:
        """The separator of columns: the only sign of the header that splits the first row in as many cells."""
        present = [sign for sign in _SEPARATORS if sign in header]
        if len(present) > 1:
            fitting = [sign for sign in present if row.count(sign) == header.count(sign)]
            if len(fitting) != 1:
                signs = " or ".join(_SEPARATORS[sign] for sign in present)
                raise UserError(f"{self.path}: line {number}: {signs} could separate the columns: keep one of them")
            present = fitting
        if not present and 1 < len(_words(header)) == len(row.split()):
            return " "
        return present[0] if present else ","

    def _cells(self, line: str) -> list[str]:
        return line.split() if self._separator == " " else _split(line, self._separator)

    def _stated(self, headings: list[str]) -> list[str]:
        """The headings with the units that the cells of the first row have after their numbers: `0.02 sec`."""
        cells = self._cells(self._batch[0])
        for column, (heading, cell) in enumerate(zip(headings, cells, strict=False)):
            match = _WITH_UNIT.fullmatch(cell)
            if match is not None and units.known(unit := units.plain(match[1])) and not set("[(") & set(heading):
                self._ending[column] = match[1]
                headings[column] = f"{heading.strip(_QUOTED)} [{unit}]"
        return headings

    def _heading(self, cell: str, number: int, column: int) -> str:
        where = f"{self.path}: line {number}: column {column + 1}: "
        if column >= MOST_COLUMNS:
            raise UserError(f"{where}more than {MOST_COLUMNS} columns")
        heading = _unquoted(cell)
        if heading is None:
            raise UserError(f"{where}an unclosed quote: '{short(cell.strip())}'")
        if len(heading) > LONGEST_HEADING:
            raise UserError(f"{where}a heading of more than {LONGEST_HEADING} characters")
        return heading.strip()

    def _parse(self, lines: list[str], index: Sequence[int], time: int | None) -> Array | None:
        """float64[lines, index] of lines, the fast way; None if it takes the slow way. `time`: a column of dates."""
        if self._lines.no_text:
            return None  # which lines have it is for the slow way
        if not lines or not index:
            return np.empty((len(lines), len(index)))
        text = "\n".join(" ".join(line.split()) for line in lines) if self._separator == " " else "\n".join(lines)
        if self._separator != ",":
            point, comma = "." in text, "," in text
            if (point or self._decimal == ".") and (comma or self._decimal == ","):
                return None  # which cells have which is for the slow way
            if comma:
                self._decimal, text = ",", text.replace(",", ".")
            elif point:
                self._decimal = "."
        for unit in set(self._ending.values()):
            for end in (self._separator, "\n"):
                text = f"{text}\n".replace(f" {unit}{end}", end).removesuffix("\n")
        plain = _with_nan(text, self._separator).split("\n")
        if not all(line.count(self._separator) == len(self.keys) - 1 for line in plain):
            return None
        dates: Mapping[int | str, Callable[[str], Any]] | None = None if time is None else {index[time]: self._date}
        day = self._day
        try:
            with np.errstate(all="ignore"):
                table = np.loadtxt(
                    plain, delimiter=self._separator, comments=None, usecols=index, ndmin=2, converters=dates
                )
        except (ValueError, TypeError):
            self._day = day
            return None
        return table if len(table) == len(lines) else None

    def _scan(
        self,
        lines: list[str],
        row: int,
        index: Sequence[int],
        names: Sequence[tuple[str, str]],
        optional: Sequence[bool],
        time: int | None,
        parts: list[list[Array] | None],
    ) -> Array:
        """The slow exact way, or the first fault. An optional column that fails leaves `parts`."""
        rows: list[list[float]] = []
        for number, line in enumerate(lines):
            try:
                cells = self._row_of(line)
                values = []
                for k, column in enumerate(index):
                    if parts[k] is None:
                        value = math.nan
                    elif k < len(optional) and optional[k]:
                        value = self._optional(cells[column], k, parts)
                    elif column in self._ending:
                        value = self._value(cells[column].strip().removesuffix(f" {self._ending[column]}"), k)
                    else:
                        value = self._value(cells[column], k, dated=k == time)
                    values.append(value)
                rows.append(values)
            except _Bad as bad:
                if not self._skip_bad:
                    self._fail(row + number, None if bad.place is None else names[bad.place][1], bad.what)
                self._skipped.append(row + number)
                self.damaged += Damaged(len(line) + 1, 1)
                # With more lines skipped a file is no recording.
                if len(self._skipped) > 1000 + 0.5 * (row + number):
                    raise UserError(
                        f"{self.path}: line {self._row + row + number}: {len(self._skipped)} lines so far are no rows "
                        f"of its columns; this one: {bad.what}"
                    ) from None
        table = np.array(rows, np.float64).reshape(len(rows), len(index))
        return table[:, [k for k in range(len(index)) if parts[k] is not None]]

    def _optional(self, cell: str, k: int, parts: list[list[Array] | None]) -> float:
        try:
            return self._value(cell, k)
        except _Bad:
            parts[k] = None
            return math.nan

    def _row_of(self, line: str) -> list[str]:
        if self._lines.no_text and _NO_TEXT.search(line):
            raise _Bad(None, "not text")
        cells = self._cells(line)
        if len(cells) != len(self.keys):
            what = f"{len(cells)} cells where the header has {len(self.keys)}" if line.strip() else "an empty line"
            raise _Bad(None, f"{what}: --skip-bad leaves such lines out")
        return cells

    def _value(self, text: str, k: int, dated: bool = False) -> float:
        cell = _unquoted(text)
        if cell is None:
            raise _Bad(k, f"an unclosed quote: '{short(text.strip())}'")
        if dated:
            try:
                return self._date(cell)
            except (ValueError, TypeError):
                raise _Bad(k, f"'{short(cell)}' is no date like the first") from None
        if _MISSING.fullmatch(cell):
            return math.nan
        if self._separator == "," and _THOUSANDS.fullmatch(cell):
            cell = cell.replace(",", "")
        for sign in ",.":
            if self._separator != "," and sign in cell:
                if self._decimal not in (None, sign) or (sign == "," and "." in cell):
                    raise _Bad(k, f"'{short(cell)}': both ',' and '.' are used as decimal sign")
                self._decimal = sign
                cell = cell.replace(",", ".")
                break
        if not _NUMBER.fullmatch(cell) and not _NOT_FINITE.fullmatch(cell):
            raise _Bad(k, f"'{short(cell)}' is not a number")
        return float(cell)

    def _date(self, cell: str) -> float:
        """Seconds since the first date. Raises ValueError, and TypeError where dates with and without a zone meet."""
        cell = cell.strip(_QUOTED)
        if not _ISO.fullmatch(cell):
            return self._since_first(cell)
        moment = datetime.fromisoformat(cell)
        if self._origin is None:
            self._origin = moment
        return (moment - self._origin).total_seconds()

    def _since_first(self, cell: str) -> float:
        """Seconds since the first time of day; at midnight a day goes on. Raises ValueError."""
        match = _OF_DAY.fullmatch(cell)
        if match is None or self._origin is not None:
            raise ValueError(cell)
        hour = int(match[1]) % 12 + 12 * (match[4] in "pP") if match[4] else int(match[1])
        second = 3600.0 * hour + 60.0 * int(match[2]) + float(match[3].replace(",", ".").replace(":", "."))
        first, last, days = self._day
        if second < last - 0.5 * _DAY_S:
            days += _DAY_S
        self._day = (second if math.isnan(first) else first, second, days)
        return second + days - self._day[0]


def in_turn(keys: Sequence[str], columns: Sequence[Sequence[str]]) -> list[tuple[str, str]]:
    """The column by which the rows of several sensors take turns, and its cell for each sensor; empty for a single
    sensor. `columns`: the cells of the first LOOKED_AT rows."""
    numbering = number_of(keys)
    for key, cells in zip(keys, columns, strict=True):
        words = list(dict.fromkeys(cells))
        if not 1 < len(words) <= 16 < len(cells) / 4 or not all(map(_WORD.fullmatch, words)):
            continue
        if key == numbering or not (any(map(_ROW.fullmatch, words)) or _keeps(cells)):
            return [(key, cell) for cell in words]
    return []


def _keeps(cells: Sequence[str]) -> bool:
    """Whether the words of a column last for many rows, come seldom, or come at random: they are no sensors."""
    runs = [len(list(run)) for _, run in groupby(cells)]
    rows_of = sorted(map(cells.count, set(cells)))
    # A sensor has five turns or more, of at most 64 rows each, and no other has eight times as many rows.
    if len(runs) < _TURNS or sorted(runs)[len(runs) // 2] > 64 or rows_of[0] * 8 < rows_of[-1]:
        return True
    for word in set(cells):
        rows = [row for row, cell in enumerate(cells) if cell == word]
        steps = [b - a for a, b in pairwise(rows)]
        if len(steps) < _TURNS or sum(step == sorted(steps)[len(steps) // 2] for step in steps) < len(steps) / 2:
            return True
    return False


def is_date(cell: str) -> bool:
    """Whether a cell is a date with a time of day, or a time of day to the second or finer."""
    return _ISO.fullmatch(cell) is not None or _OF_DAY.fullmatch(cell) is not None


def is_clock(cell: str) -> bool:
    """Whether a cell is a date, or a time of day, in any form."""
    return _CLOCK.fullmatch(cell) is not None


def _bare(line: str) -> str:
    """A line without the sign of a comment before it."""
    sign = _COMMENT.match(line)
    return line[sign.end() if sign else 0 :].strip(" ")


def _words(line: str) -> list[str]:
    """The headings between blanks: a unit in brackets may stand apart, and have blanks in it."""
    headings: list[list[str]] = []
    within = False
    for word in line.split(None, 8 * MOST_COLUMNS):  # the rest of a longer line is a word
        if headings and (within or word[0] in "[("):
            headings[-1].append(word)
        else:
            headings.append([word])
        opened, closed = max(word.rfind("["), word.rfind("(")), max(word.rfind("]"), word.rfind(")"))
        within = opened > closed or (within and closed < 0)
    return [" ".join(words) for words in headings]


def _split(line: str, sign: str) -> list[str]:
    """The cells of a line. A sign between quotes separates none, where each quote has a partner (RFC 4180)."""
    parts = line.split('"')
    if len(parts) % 2 == 0 or not any(sign in quoted for quoted in parts[1::2]):
        return line.split(sign)
    parts[1::2] = [quoted.replace(sign, "\0") for quoted in parts[1::2]]
    return [cell.replace("\0", sign) for cell in '"'.join(parts).split(sign)]


def _with_signs(text: str) -> str:
    """A text with the signs of units, in the lines before the first row, that some alphabets have as a single byte."""
    end = 0
    for line in text.split("\n", MOST_LEADING_LINES)[:MOST_LEADING_LINES]:
        if is_row(line):
            break
        end += len(line) + 1
    return text[:end].translate(_SINGLE) + text[end:]


def is_row(line: str) -> bool:
    """Whether most cells of a line are numbers."""
    for sign in (*_SEPARATORS, " "):
        cells = [cell.strip(_QUOTED) for cell in line.split(None if sign == " " else sign, MOST_COLUMNS)]
        if len(cells) > 1 and sum(_NUMBER.fullmatch(cell) is not None for cell in cells) > len(cells) / 2:
            return True
    return False


def _is_header(line: str, after: Sequence[str], knows: Callable[[Sequence[str]], bool]) -> bool:
    """Whether a line has a known heading and no number, and the line `after` it, if any, numbers in as many cells."""
    for sign in (*_SEPARATORS, " "):
        if sign != " " and line.count(sign) > MOST_COLUMNS:
            continue
        cells = [cell.strip(_QUOTED) for cell in (_words(line) if sign == " " else _split(line, sign))]
        if len(cells) > MOST_COLUMNS or max(map(len, cells), default=0) > LONGEST_HEADING:
            continue
        if any(_NUMBER.fullmatch(cell) for cell in cells) or not knows(cells):
            continue
        row = [cell for line in after for cell in (line.split() if sign == " " else _split(line, sign))]
        same = len(row) == len(cells) or (len(row) == len(cells) - 1 and cells[-1].lower() == _COMMENT_OF_ROWS)
        if not after or (same and any(_ROW.fullmatch(cell.strip(_QUOTED)) for cell in row)):
            return True
    return False


def _with_units(line: str, after: Sequence[str]) -> str:
    """A line of headings with the units of the line after it, where that is nothing but units; else empty."""
    for sign in (*_SEPARATORS, " "):
        names, stated = (
            [cell.strip(signs) for text in lines for cell in text.split(None if sign == " " else sign)]
            for lines, signs in (([line], _QUOTED), (after, ' "[]'))
        )
        if len(names) != len(stated) or not 1 < len(names) <= MOST_COLUMNS or max(map(len, stated)) > LONGEST_HEADING:
            continue
        plain = [units.plain(unit) for unit in stated]
        if any(_NUMBER.fullmatch(unit) for unit in stated) or sum(map(units.known, plain)) < len(names) / 2:
            continue
        return ("\t" if sign == " " else sign).join(
            f"{name} [{unit}]" if units.known(unit) and "[" not in name and "(" not in name else name
            for name, unit in zip(names, plain, strict=True)
        )
    return ""


def _with_nan(text: str, separator: str) -> str:
    """The lines of a text with `nan` in each empty cell."""
    if separator == " ":
        return text
    for empty in (f"{separator}{separator}", f"{separator} {separator}"):
        while empty in text:
            text = text.replace(empty, f"{separator}nan{separator}")
    for blank in (" ", "\r"):
        if f"{separator}{blank}\n" in text:
            text = text.replace(f"{separator}{blank}\n", f"{separator}\n")
    text = text.replace(f"{separator}\n", f"{separator}nan\n").replace(f"\n{separator}", f"\nnan{separator}")
    return ("nan" if text.startswith(separator) else "") + text + ("nan" if text.endswith(separator) else "")


def _unquoted(cell: str) -> str | None:
    """A cell without spaces and quotes around it; two quotes within become one. None if a quote has no partner."""
    text = cell.strip()
    if len(text) > 1 and text[0] == text[-1] == '"':
        return None if '"' in text[1:-1].replace('""', "") else text[1:-1].replace('""', '"')
    return None if '"' in text else text


def _opened(path: Path, files: ExitStack) -> tuple[BinaryIO, int]:
    """The text's bytes, unpacked, and its size if it is packed, else 0; a large file shows how far it is read."""
    raw: Any = files.enter_context(path.open("rb"))
    if not raw.peek(1):
        raise UserError(f"{path}: the file is empty")
    size = path.stat().st_size
    console = Console(stderr=True)
    if size > BLOCK_BYTES and console.is_terminal:
        progress = wrap_file(raw, size, description="reading", console=console, transient=True)
        raw = files.enter_context(progress)
    if path.suffix.lower() == ".gz":
        return cast(BinaryIO, files.enter_context(gzip.open(raw))), size
    return cast(BinaryIO, raw), 0


def _of_no_text(path: Path, line: int, sign: str) -> str:
    return f"{path}: line {line}: not text (byte 0x{ord(sign) & 0xFF:02x}); it must be UTF-8, or UTF-16 with its mark"


class _Lines:
    """The lines of a text, a block at a time. `number`: lines before the last block; `rest`: not used yet, of it.

    `no_text`: the last block has bytes that are no text; without `skip_bad` they are a UserError."""

    def __init__(self, path: Path, stream: BinaryIO, packed: int, skip_bad: bool) -> None:
        self.path = path
        self.stream: BinaryIO | codecs.StreamRecoder = stream
        self.number, self.rest, self.unfinished = 0, list[str](), False
        self._carry, self._next, self._start = b"", 0, True
        #: Lines end with CR alone, as on old Macs.
        self._returns = False
        self._packed, self._unpacked = packed, 0
        self._skip_bad, self.no_text = skip_bad, False
        #: The lines are a serial monitor's, and what separates their columns.
        self._monitor, self._between = False, ","

    def more(self) -> list[str]:
        """The lines of the next block; none at the end. Raises UserError for what is no text."""
        while not self.unfinished:
            with reading(self.path, f"not a whole {'gzip' if self.path.suffix.lower() == '.gz' else 'zip'} file"):
                block = self._block()
            if self._start and not self._carry:
                self._returns = b"\r" in block[:-1] and b"\n" not in block
            data = self._carry + (block.replace(b"\r", b"\n") if self._returns else block)
            end = data.rfind(b"\n") + 1 if block else len(data)
            self.unfinished = not block and bool(data)
            self._carry = data[end:]
            if len(self._carry) > BLOCK_BYTES:
                if b"\0" in self._carry:
                    self._text(self._carry)  # says so
                raise UserError(f"{self.path}: line {self._next + 1}: longer than {BLOCK_BYTES:,} bytes")
            self._unpacked += len(block)
            if self._packed and self._unpacked > MOST_TEXT_GROWTH * self._packed + BLOCK_BYTES:
                more = f"unpacks to more than {MOST_TEXT_GROWTH} times its size, as no sensor's readings do"
                raise UserError(f"{self.path}: {more}: unpack it if you know it")
            if end:
                lines = self._text(data[:end]).replace("\r\n", "\n").removesuffix("\n").split("\n")
                if self.number == 0 == self._next:
                    self._monitor = _MONITOR.match(lines[0]) is not None and _MONITOR.match(lines[-1]) is not None
                    self._between = next((sign for sign in _SEPARATORS if sign in lines[-1]), " ")
                if self._monitor:
                    lines = [self._received(line) for line in lines]
                self.number, self._next = self._next, self._next + len(lines)
                return lines
            if not block:
                break
        return []

    def _received(self, line: str) -> str:
        """A line of a serial monitor with the stamp, or its heading, as a column."""
        match = _MONITOR.match(line)
        if match is None:
            return line
        rest = line[match.end() :]
        return f"{match[1] if _ROW.fullmatch(rest) else RECEIVED}{self._between}{rest}"

    def _block(self) -> bytes:
        """The next bytes of the text, in UTF-8; none at the end."""
        if self._start and not self._carry:
            begin = self.stream.read(2)
            if begin not in _WIDE:
                return begin + self.stream.read(BLOCK_BYTES)
            self.stream = codecs.EncodedFile(self.stream, "utf-8", _WIDE[begin], "surrogatepass")
        return self.stream.read(BLOCK_BYTES)

    def _text(self, data: bytes) -> str:
        alphabet = "utf-8-sig" if self._start else "utf-8"
        try:
            text, self.no_text = data.decode(alphabet), b"\0" in data
        except UnicodeDecodeError:
            text = data.decode(alphabet, "surrogateescape")
            if self._start:
                text = _with_signs(text)
            self.no_text = _NO_TEXT.search(text) is not None
        if self.no_text and not self._skip_bad:
            fault = _NO_TEXT.search(text)
            assert fault is not None
            raise UserError(_of_no_text(self.path, self._next + text.count("\n", 0, fault.start()) + 1, fault[0]))
        self._start = False
        return text
