"""A table of a file: columns by their headings, of a clock; and the bounds that readers of arrays share."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError, few, short
from selfcal.base.grid import Array, Rows
from selfcal.base.limits import (
    BLOCK_BYTES,
    FEWEST_ROWS,
    MOST_COLUMNS,
    MOST_GROWTH,
    MOST_NUMBERS,
    MOST_UNPACKED_BYTES,
    MOST_UNPACKED_SMALL,
    reading,
)
from selfcal.logs.loaders.damage import SOUND, Damaged

#: Hints of the user about a file: `dbc`, the path of a CAN database.
Hints = Mapping[str, str]


@dataclass(frozen=True)
class Member:
    """An array of a file: its shape and type, and what reads it."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    read: Callable[[], NDArray[Any]]


@dataclass(frozen=True)
class Field:
    """A column to be read: key in the file, name and unit here, size of its LSB (1 if it is in the unit itself)."""

    key: str
    name: str
    unit: str
    lsb: float
    #: Nobody asked for it: a fault of it leaves it out.
    optional: bool = False
    #: Its cells are dates.
    dates: bool = False


@dataclass(frozen=True)
class TableRows:
    """What is read of a table: raw `columns` float64[n] of the `fields`, NaN where there is no sample.

    `fail(row, field, what)` raises UserError for a row of the file. `started`: what was taken off the stamps, in their
    unit. `places` int64[n]: of each row among the lines of a text, some of which were skipped.
    """

    path: Path
    fields: Sequence[Field]
    columns: list[Array]
    fail: Callable[[int, int | None, str], NoReturn]
    meta: Mapping[str, Any]
    started: float = 0.0
    places: Rows | None = None
    notes: tuple[str, ...] = ()
    damaged: Damaged = SOUND


@dataclass(frozen=True)
class Table:
    """Columns of one clock. `members` by heading: `name[unit]`, or a plain name whose unit `meta` has.

    `source`: the topic, message or group that it is, empty where a file has no parts. `notes`: what a reader of the
    results must know of it. `damaged`: what of the whole file could not be read.
    """

    source: str
    members: Mapping[str, Member]
    meta: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    damaged: Damaged = SOUND

    #: A text's name, headings, the lines before them, their line in messages, and the cells of the first row.
    name: str = ""
    headings: Sequence[str] = ()
    before: Sequence[str] | None = None
    line: str = ""
    first: Sequence[str] = ()

    @property
    def keys(self) -> Sequence[str]:
        """The headings."""
        return self.headings or list(self.members)

    @property
    def cells(self) -> Mapping[str, str]:
        """The cells of the first row of a text, by heading."""
        return dict(zip(self.keys, self.first, strict=False))

    @property
    def where(self) -> str:
        """The place that a message names after the path."""
        return self.line or (f"{self.source}: " if self.source else "")

    def rows(self, path: Path, fields: Sequence[Field]) -> TableRows:
        """The columns of the fields. Raises UserError."""
        count = math.prod(self.members[fields[0].key].shape)
        for wanted in fields:
            member, column = self.members[wanted.key], f"{path}: {self.where}column '{wanted.name}'"
            if len(member.shape) != 1:
                raise UserError(f"{column} has {len(member.shape)} dimensions, not one")
            if member.dtype.kind not in "iuf":
                raise UserError(f"{column} holds no numbers (its type is {short(str(member.dtype))})")
            if member.shape[0] != count:
                raise UserError(f"{column} has {member.shape[0]} rows, '{fields[0].name}' has {count}")
        check_rows(f"{path}: {self.where}", count)
        bound_numbers(path, count * len(fields))

        def fail(row: int, number: int | None, what: str) -> NoReturn:
            column = "" if number is None else f"column '{fields[number].name}': "
            raise UserError(f"{path}: {self.where}row {row + 1}: {column}{what}")

        started, columns = 0.0, list[Array]()
        for wanted in fields:
            array = self.members[wanted.key].read()
            if wanted.name == "t" and array.dtype.kind in "iu":
                # Time since an epoch in ns does not fit a float64; a difference of two int64 fits a uint64.
                bits = array.astype(np.uint64 if array.dtype.kind == "u" else np.int64).view(np.uint64)
                back, started = array[1:] < array[:-1], float(array[0])
                steps = np.where(back, -(bits[:-1] - bits[1:]).astype(float), (bits[1:] - bits[:-1]).astype(float))
                array = np.append(0.0, np.cumsum(steps)) if back.any() else bits - bits[0]
            columns.append(array.astype(np.float64))
        return TableRows(path, fields, columns, fail, self.meta, started)


def of_arrays(
    source: str,
    arrays: Mapping[str, NDArray[Any]],
    meta: Mapping[str, Any] | None = None,
    notes: tuple[str, ...] = (),
    damaged: Damaged = SOUND,
) -> Table:
    """The table of arrays [n] that are in memory."""
    return Table(source, {name: in_memory(array) for name, array in arrays.items()}, meta or {}, notes, damaged)


def of_groups(
    columns: Mapping[tuple[str, int], Mapping[str, NDArray[Any]]],
    meta: Mapping[str, Any] | None = None,
    notes: tuple[str, ...] = (),
    damaged: Damaged = SOUND,
) -> list[Table]:
    """A table for the columns of each group and length: the longest has the group's name, others also their length."""
    longest = {group: max(size for of, size in columns if of == group) for group, _ in columns}
    return [
        of_arrays(group if size == longest[group] else f"{group}:{size}", arrays, meta, notes, damaged)
        for (group, size), arrays in columns.items()
    ]


def left_out(names: Sequence[str], by: str) -> tuple[str, ...]:
    """The note on channels that are left out, if there are any. `by`: what their values take that is not done."""
    named = few(list(map(short, names)))
    return (f"left out: {named}: their values come by {by}: export them as physical values",) if names else ()


def heading(name: str, unit: str | None) -> str:
    """A heading `name[unit]`; the name alone without a unit."""
    return f"{name}[{unit}]" if unit else name


def in_memory(array: NDArray[Any]) -> Member:
    """An array as a member."""
    return Member(array.shape, array.dtype, lambda: array)


def parse_meta(path: Path, text: str) -> Mapping[str, Any]:
    """A JSON mapping. Raises UserError."""
    with reading(path, "meta: not a JSON text"):
        meta = json.loads(text)
    if not isinstance(meta, dict):
        raise UserError(f"{path}: meta: not a JSON mapping")
    return meta


def meta_place(path: Path) -> Path:
    """Place of the metadata of a text recording, next to it. An npz holds its own."""
    return path.with_name(path.name + ".meta.json")


def file_content(path: Path) -> bytes:
    """All of a file, in blocks: memory is taken for what is there."""
    blocks, size = [], 0
    with path.open("rb") as stream:
        while (block := stream.read(BLOCK_BYTES)) and size <= MOST_UNPACKED_BYTES:
            blocks.append(block)
            size += len(block)
    return bounded(path, b"".join(blocks), MOST_UNPACKED_BYTES)


def room(data: bytes) -> int:
    """Bytes that a whole file may unpack to."""
    return min(MOST_UNPACKED_BYTES, max(MOST_UNPACKED_SMALL, MOST_GROWTH * len(data)))


def check_rows(where: str, count: int) -> None:
    """Raise UserError for fewer rows than a recording needs. `where`: the file, and the place in it."""
    if count < FEWEST_ROWS:
        raise UserError(f"{where}{'one row only' if count else 'no rows'}, a recording needs two or more")


def bound_numbers(path: Path, numbers: int) -> None:
    """Raise UserError for more numbers than are read."""
    if numbers > MOST_NUMBERS:
        more = "cut it in parts, or read fewer columns, those that --column names"
        raise UserError(f"{path}: more than {MOST_NUMBERS:,} numbers: {more}")


def check_numbers(path: Path, numbers: int) -> None:
    """Raise UserError for more numbers than are read, or than a packed file of this size may hold."""
    bound_numbers(path, numbers)
    if 8 * numbers > max(MOST_UNPACKED_SMALL, MOST_GROWTH * path.stat().st_size):
        raise UserError(f"{path}: unpacks to more than {MOST_GROWTH} times its size, as no sensor's readings do")


def inflated(path: Path, inflater: Any, data: bytes, most: int, before: int = 0) -> bytes:
    """`data` unpacked; with the bytes `before` it makes at most `most`. Raises UserError, EOFError and what `inflater`
    raises."""
    unpacked: bytes = inflater.decompress(data, max(most - before, 0) + 1)
    if before + len(unpacked) <= most and not inflater.eof:
        raise EOFError("it is cut off")
    return bounded(path, unpacked, most, before)


def bounded(path: Path, data: bytes, most: int, before: int = 0) -> bytes:
    """`data`, which with the bytes `before` makes at most `most`. Raises UserError."""
    if before + len(data) > most:
        raise UserError(f"{path}: it unpacks to more than {most >> 20} MiB: write it as .csv or .npz")
    return data


def vectors(path: Path, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Member]:
    """Vectors as they are, a matrix NAME as NAME:1, NAME:2, ..."""
    members: dict[str, Member] = {}
    for name, array in arrays.items():
        columns = array.squeeze()
        if columns.ndim != 2:
            add(path, members, name, np.atleast_1d(columns))
            continue
        for k, column in enumerate(columns.T[: MOST_COLUMNS + 1], 1):
            add(path, members, f"{name}:{k}", column)
    return members


def add(path: Path, members: dict[str, Member], name: str, array: NDArray[Any]) -> None:
    """Put an array among the members. Raises UserError."""
    if name in members:
        raise UserError(f"{path}: column '{short(name)}' appears twice")
    if len(members) >= MOST_COLUMNS:
        raise UserError(f"{path}: more than {MOST_COLUMNS} columns")
    members[name] = in_memory(array)
