"""Recordings that are text: columns separated by commas, semicolons or tabs, under one header line.

Lines before the header that are empty or begin with # are skipped. Where all are and numbers follow, the last of them
is the header, as `numpy.savetxt` writes it. Between semicolons or tabs a comma is a decimal sign. The text is read in
blocks: no more of it than one is in memory.
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, cast

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import wrap_file

from selfcal.errors import UserError, note, short
from selfcal.limits import (
    BLOCK_BYTES,
    LONGEST_HEADING,
    MOST_COLUMNS,
    MOST_GROWTH,
    MOST_LEADING_LINES,
    MOST_NUMBERS,
    reading,
)

#: Bytes of a file from which on reading it shows its progress.
_SLOW_BYTES = 1 << 26

_SEPARATORS = {",": "','", ";": "';'", "\t": "tabs"}
#: Nothing but numbers and what separates them.
_ROW = re.compile(r"[-+.,;\t \"eE\d]*\d[-+.,;\t \"eE\d]*", re.ASCII)
_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*", re.ASCII)
_NOT_FINITE = re.compile(r"[-+]?(nan|inf(inity)?)", re.ASCII | re.IGNORECASE)


class TextTable:
    """A table being read: `keys` are its headings, `where` the line they are on, for messages."""

    def __init__(self, path: Path, files: ExitStack) -> None:
        """Read as far as the header. `files` closes what is opened. Raises UserError."""
        self.path = path
        self._lines = _Lines(path, _opened(path, files))
        header, number, self._row = self._header()
        self._batch = self._lines.rest or self._lines.more()
        if not self._batch:
            raise UserError(f"{path}: line {number}: there is a header but no rows")
        self._separator = self._separated(header, number)
        self._decimal: str | None = None
        self.where = f"line {number}: "
        self.keys = [self._heading(cell, number, place) for place, cell in enumerate(header.split(self._separator))]

    def fail(self, row: int, column: str | None, what: str) -> NoReturn:
        """Raise UserError for a row (from 0), and a column of it, of the file."""
        column = "" if column is None else f"column '{column}': "
        raise UserError(f"{self.path}: line {self._row + row}: {column}{what}")

    def columns(self, names: Sequence[tuple[str, str]]) -> list[NDArray[np.float64]]:
        """The columns [n] of pairs (heading, name in messages), n at least 2. Raises UserError for the first fault."""
        index = [self.keys.index(key) for key, _ in names]
        called = [name for _, name in names]
        parts: list[list[NDArray[np.float64]]] = [[] for _ in index]
        rows, blank, batch = 0, False, self._batch
        while batch:
            filled = len(batch)
            while filled and not batch[filled - 1].strip():
                filled -= 1
            if blank and filled:
                self.fail(rows, None, "an empty line")
            blank = blank or filled < len(batch)
            batch = batch[:filled]
            if (rows + filled) * len(index) > MOST_NUMBERS:
                raise UserError(
                    f"{self.path}: more than {MOST_NUMBERS:,} numbers: cut it in parts, or read fewer columns, those "
                    "that --column names"
                )
            for part, column in zip(parts, self._parse(batch, rows, index, called).T, strict=True):
                part.append(np.ascontiguousarray(column))
            rows += filled
            batch = self._lines.more()
        if self._lines.unfinished and not blank:
            # A line that was cut within its last number would be taken for another value.
            rows -= 1
            for part in parts:
                part[-1] = part[-1][:-1]
            note(f"{self.path}: line {self._row + rows} has no line end and may be cut off: left out")
        if rows < 2:
            what = "one row only, a recording needs two or more" if rows else "there is a header but no rows"
            raise UserError(f"{self.path}: line {self._row + rows - 1}: {what}")
        return [np.concatenate(parts.pop(0)) for _ in index]

    def _header(self) -> tuple[str, int, int]:
        """The header line, its number, and the first row's; the lines after it are the rest."""
        comment, comment_number, seen = "", 0, 0
        while batch := self._lines.more():
            for place, line in enumerate(batch):
                number = self._lines.number + place + 1
                if not line.strip() or line.lstrip().startswith("#"):
                    seen += 1
                    if line.strip():
                        comment, comment_number = line.strip(), number
                    if seen > MOST_LEADING_LINES:
                        raise UserError(f"{self.path}: line {number}: no header in the first {MOST_LEADING_LINES}")
                    continue
                if comment and _ROW.fullmatch(line):
                    self._lines.rest = batch[place:]
                    return comment.lstrip("# \t"), comment_number, number
                self._lines.rest = batch[place + 1 :]
                return line, number, number + 1
        raise UserError(f"{self.path}: line 1: the file holds {'comments' if comment else 'empty lines'} only")

    def _separated(self, header: str, number: int) -> str:
        """What separates columns: the one sign of the header that splits the first row in as many cells."""
        found = [sign for sign in _SEPARATORS if sign in header]
        if len(found) > 1:
            row = self._batch[0]
            fitting = [sign for sign in found if row.count(sign) == header.count(sign)]
            if len(fitting) != 1:
                signs = " or ".join(_SEPARATORS[sign] for sign in found)
                raise UserError(f"{self.path}: line {number}: {signs} could separate the columns: keep one of them")
            found = fitting
        return found[0] if found else ","

    def _heading(self, cell: str, number: int, place: int) -> str:
        where = f"{self.path}: line {number}: column {place + 1}: "
        if place >= MOST_COLUMNS:
            raise UserError(f"{where}more than {MOST_COLUMNS} columns")
        heading = _unquoted(cell)
        if heading is None:
            raise UserError(f"{where}an unclosed quote: '{short(cell.strip())}'")
        if len(heading) > LONGEST_HEADING:
            raise UserError(f"{where}a heading of more than {LONGEST_HEADING} characters")
        return heading.strip()

    def _parse(self, lines: list[str], row: int, index: Sequence[int], names: Sequence[str]) -> NDArray[np.float64]:
        """float64[lines, index] of lines from `row` on."""
        if not lines:
            return np.empty((0, len(index)))
        plain: list[str] | None = lines
        if self._separator != ",":
            text = "\n".join(lines)
            point, comma = "." in text, "," in text
            if (point or self._decimal == ".") and (comma or self._decimal == ","):
                plain = None  # which cells have which is for the slow way
            elif comma:
                self._decimal, plain = ",", text.replace(",", ".").split("\n")
            elif point:
                self._decimal = "."
        width = len(self.keys)
        if plain is not None and all(line.count(self._separator) == width - 1 for line in plain):
            try:
                table = np.loadtxt(plain, delimiter=self._separator, comments=None, usecols=index, ndmin=2)
            except ValueError:
                pass
            else:
                if len(table) == len(lines):
                    return table
        return self._scan(lines, row, index, names)

    def _scan(self, lines: list[str], row: int, index: Sequence[int], names: Sequence[str]) -> NDArray[np.float64]:
        """The slow exact way, or the first fault. Columns that are not read may hold anything."""
        table = np.empty((len(lines), len(index)))
        for number, line in enumerate(lines):
            cells = line.split(self._separator)
            if len(cells) != len(self.keys):
                what = f"{len(cells)} cells where the header has {len(self.keys)}" if line.strip() else "an empty line"
                self.fail(row + number, None, what)
            for place, (column, name) in enumerate(zip(index, names, strict=True)):
                cell = _unquoted(cells[column])
                if cell is None:
                    self.fail(row + number, name, f"an unclosed quote: '{short(cells[column].strip())}'")
                table[number, place] = self._number(cell, row + number, name)
        return table

    def _number(self, cell: str, row: int, name: str) -> float:
        for sign in ",.":
            if self._separator != "," and sign in cell:
                if self._decimal not in (None, sign) or (sign == "," and "." in cell):
                    self.fail(row, name, f"'{short(cell)}': both ',' and '.' are used as decimal sign")
                self._decimal = sign
                cell = cell.replace(",", ".")
                break
        if not _NUMBER.fullmatch(cell) and not _NOT_FINITE.fullmatch(cell):
            self.fail(row, name, f"'{short(cell)}' is not a number" if cell else "an empty cell")
        return float(cell)


def _unquoted(cell: str) -> str | None:
    """A cell without the spaces and the pair of quotes around it; None if one quote has no partner."""
    text = cell.strip()
    inner = text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text
    return None if '"' in inner else inner


def _opened(path: Path, files: ExitStack) -> BinaryIO:
    """The text's bytes, unpacked; a large file shows how far it is read."""
    raw: Any = files.enter_context(path.open("rb"))
    if not raw.peek(1):
        raise UserError(f"{path}: the file is empty")
    size = path.stat().st_size
    console = Console(stderr=True)
    if size > _SLOW_BYTES and console.is_terminal:
        progress = wrap_file(raw, size, description="reading", console=console, transient=True)
        raw = files.enter_context(progress)
    return cast(BinaryIO, files.enter_context(gzip.open(raw)) if path.suffix.lower() == ".gz" else raw)


class _Lines:
    """The lines of a text, a block at a time. `number`: lines before the last block; `rest`: not used yet, of it."""

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.path, self.stream = path, stream
        self.number, self.rest, self.unfinished = 0, list[str](), False
        self._carry, self._next, self._start = b"", 0, True
        self._packed, self._unpacked = path.stat().st_size if path.suffix.lower() == ".gz" else 0, 0

    def more(self) -> list[str]:
        """The lines of the next block; none at the end. Raises UserError for what is no text."""
        while not self.unfinished:
            with reading(self.path, "not a whole gzip file"):
                block = self.stream.read(BLOCK_BYTES)
            data = self._carry + block
            end = data.rfind(b"\n") + 1 if block else len(data)
            self.unfinished = not block and bool(data)
            self._carry = data[end:]
            if len(self._carry) > BLOCK_BYTES:
                if b"\0" in self._carry:
                    self._text(self._carry)  # says so
                raise UserError(f"{self.path}: line {self._next + 1}: longer than {BLOCK_BYTES:,} bytes")
            self._unpacked += len(block)
            if self._packed and self._unpacked > MOST_GROWTH * self._packed + BLOCK_BYTES:
                more = f"unpacks to more than {MOST_GROWTH} times its size"
                raise UserError(f"{self.path}: {more}: no sensor's readings do")
            if end:
                lines = self._text(data[:end]).replace("\r\n", "\n").removesuffix("\n").split("\n")
                self.number, self._next = self._next, self._next + len(lines)
                return lines
            if not block:
                break
        return []

    def _text(self, data: bytes) -> str:
        skip = 3 if self._start and data.startswith(b"\xef\xbb\xbf") else 0
        bad = data.find(b"\0")
        try:
            text = data[skip:].decode("utf-8")
        except UnicodeDecodeError as error:
            bad = min(bad, error.start + skip) if bad >= 0 else error.start + skip
        if bad >= 0:
            line = self._next + data.count(10, 0, bad) + 1
            raise UserError(f"{self.path}: line {line}: not text (byte 0x{data[bad]:02x}); it must be UTF-8")
        self._start = False
        return text
