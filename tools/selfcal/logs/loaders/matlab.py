"""Recordings that are MATLAB's .mat of version 4 to 7. Sizes are read before the arrays are."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError, short
from selfcal.base.limits import MOST_META_BYTES, reading
from selfcal.logs.loaders.table import Hints, Table, bounded, file_content, inflated, parse_meta, room, vectors

#: Bytes of the header of a file of version 5 to 7, and the class of a text.
_MAT_HEADER, _MAT_CHAR = 128, 4
#: Types of numbers by their class, by the kind of the element that holds them, and by the digit of version 4.
_MAT_CLASSES = dict(enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), start=6))
_MAT_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MAT_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16-{}", 16: "utf-8", 17: "utf-16-{}", 18: "utf-32-{}"}
_MAT4_TYPES = ("f8", "f4", "i4", "i2", "u2", "u1")

#: Variables of a MATLAB file: arrays of numbers, and the text `meta`. Others are left out.
_Variables = Iterator[tuple[str, "str | NDArray[Any]"]]


def read(path: Path, _: Hints) -> list[Table]:
    """The vectors of a MATLAB file of version 4 to 7, and the columns of its matrices; a text `meta` is JSON."""
    data = file_content(path)
    order = None if 0 in data[:4] else {b"IM": "<", b"MI": ">"}.get(data[126:128])
    arrays: dict[str, NDArray[Any]] = {}
    meta = ""
    with reading(path, "not a whole MATLAB file"):
        for name, value in _mat4(data) if order is None else _mat5(_unpacked(path, data, order), order):
            if name in arrays or (name == "meta" and meta):
                raise UserError(f"{path}: variable '{short(name)}' appears twice")
            if isinstance(value, str):
                meta = value
            else:
                arrays[name] = value
        if len(meta) > MOST_META_BYTES:
            raise UserError(f"{path}: meta: larger than {MOST_META_BYTES} characters")
    return [Table("", vectors(path, arrays), parse_meta(path, meta) if meta else {})]


def _mat4(data: bytes) -> _Variables:
    """Variables of a file of version 4. Raises ValueError, and EOFError where it is cut off."""
    begin = 0
    while begin < len(data):
        order = next((sign for sign in "<>" if 0 <= struct.unpack_from(f"{sign}i", data, begin)[0] < 5000), "")
        kind, rows, columns, imaginary, length = struct.unpack_from(f"{order}5i", data, begin)
        number = kind // 10 % 10
        if not order or min(rows, columns, length) < 0 or number >= len(_MAT4_TYPES):
            raise ValueError("a variable's header is invalid")
        name = bytes(_piece(data, begin + 20, length)).rstrip(b"\0").decode("latin-1")
        dtype = np.dtype(order + _MAT4_TYPES[number])
        size = rows * columns * dtype.itemsize
        values = np.frombuffer(_piece(data, begin + 20 + length, size), dtype).reshape((rows, columns), order="F")
        begin += 20 + length + size * (2 if imaginary else 1)
        if kind % 10 == 0:
            yield name, values.astype(np.complex128 if imaginary else dtype.newbyteorder("="), copy=False)
        elif kind % 10 == 1 and name == "meta":
            yield name, "".join(map(chr, values.astype("u2").ravel()))


def _mat5(data: memoryview, order: str) -> _Variables:
    """Variables of a file of version 5 to 7, unpacked. Raises ValueError, and EOFError where it is cut off."""
    begin = _MAT_HEADER
    while begin + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, begin)
        body = _piece(data, begin + 8, size)
        begin += 8 + size
        if kind == 14 and size:  # an array
            yield from _array(body, order)


def _array(body: memoryview, order: str) -> _Variables:
    """The variable of an array's element, if it holds numbers, or `meta`."""
    flags, behind = _element(body, 0, order)[1:]
    flag = struct.unpack_from(f"{order}I", flags)[0]
    of = flag & 0xFF
    if flag & 0x200 or (of != _MAT_CHAR and of not in _MAT_CLASSES):  # logical, or a class that has other parts
        return
    extents, behind = _element(body, behind, order)[1:]
    letters, behind = _element(body, behind, order)[1:]
    kind, content, _ = _element(body, behind, order)
    name = bytes(letters).decode("latin-1")
    if of == _MAT_CHAR:
        if name == "meta":
            yield name, bytes(content).decode(_MAT_TEXTS[kind].format({"<": "le", ">": "be"}[order]))
        return
    if kind not in _MAT_KINDS:
        raise ValueError(f"numbers of a kind {kind} that there is not")
    values = np.frombuffer(content, order + _MAT_KINDS[kind])
    shape = np.frombuffer(extents, f"{order}i4").tolist()
    if min(shape, default=0) < 0 or math.prod(shape) != values.size:
        raise ValueError("its length and its shape differ")
    whole = np.complex128 if flag & 0x800 else np.dtype(_MAT_CLASSES[of])
    yield name, values.astype(whole, copy=False).reshape(shape, order="F")


def _element(data: memoryview, begin: int, order: str) -> tuple[int, memoryview, int]:
    """Kind and content of the element at a place, and the place behind it. Small elements have both in eight bytes."""
    kind = struct.unpack_from(f"{order}I", data, begin)[0]
    if kind >> 16:
        return kind & 0xFFFF, _piece(data, begin + 4, kind >> 16), begin + 8
    size = struct.unpack_from(f"{order}I", data, begin + 4)[0]
    return kind, _piece(data, begin + 8, size), begin + 8 + size + -size % 8


def _piece(data: memoryview | bytes, begin: int, size: int) -> memoryview:
    if not 0 <= size <= len(data) - begin:
        raise EOFError("it is cut off")
    return memoryview(data)[begin : begin + size]


def _unpacked(path: Path, data: bytes, order: str) -> memoryview:
    """A MATLAB file with its packed variables unpacked, so that its size is known before it is read."""
    parts, size, begin, most = [data[:_MAT_HEADER]], _MAT_HEADER, _MAT_HEADER, room(data)
    while begin + 8 <= len(data):
        kind, length = struct.unpack_from(f"{order}II", data, begin)
        part = data[begin : begin + 8 + length]
        if kind == 15:  # packed
            part = inflated(path, zlib.decompressobj(), part[8:], most, size)
        parts.append(part)
        size, begin = size + len(part), begin + 8 + length
    return memoryview(bounded(path, b"".join(parts), most))
