"""Recordings that are arrays: numpy's .npz, MATLAB's .mat, and R's .rda, .rdata and .rds.

Sizes are read before the arrays are, and no code of a file runs: there is no pickle, and R's functions stay unread.
"""

from __future__ import annotations

import bz2
import json
import lzma
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from selfcal.errors import UserError, short
from selfcal.limits import (
    BLOCK_BYTES,
    MOST_COLUMNS,
    MOST_GROWTH,
    MOST_META_BYTES,
    MOST_R_OBJECTS,
    MOST_UNPACKED_BYTES,
    MOST_UNPACKED_SMALL,
    reading,
)


@dataclass(frozen=True)
class Member:
    """An array of a file: its shape and type, and what reads it."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    read: Callable[[], NDArray[Any]]


#: The arrays of a file by name, and its metadata.
Members = tuple[dict[str, Member], Mapping[str, Any]]


def parse_meta(path: Path, text: str) -> Mapping[str, Any]:
    """A JSON mapping. Raises UserError."""
    with reading(path, "meta: not a JSON text"):
        meta = json.loads(text)
    if not isinstance(meta, dict):
        raise UserError(f"{path}: meta: not a JSON mapping")
    return meta


# --------------------------------------------------------------------------------------------------------------- npz


def npz(path: Path) -> Members:
    """The members of an .npz. An array is read when it is asked for; others, whatever they hold, never are."""
    with path.open("rb") as stream:
        if stream.read(4) not in (b"PK\x03\x04", b"PK\x05\x06"):  # of a zip, with members and without
            raise UserError(f"{path}: not an npz file")
    members: dict[str, Member] = {}
    meta = ""
    with reading(path, "not a whole npz file"), zipfile.ZipFile(path) as archive:
        listed = archive.infolist()
        if len(listed) > MOST_COLUMNS:
            raise UserError(f"{path}: more than {MOST_COLUMNS} columns")
        for info in listed:
            name = info.filename.removesuffix(".npy")
            if name in members or (name == "meta" and meta):
                raise UserError(f"{path}: column '{short(name)}' appears twice")
            if name == "meta":
                meta = _npz_meta(path, archive, info)
            elif name != info.filename:
                members[name] = _npz_member(path, archive, info, name)
    return members, parse_meta(path, meta) if meta else {}


def _npz_header(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype[Any], int]:
    """Shape, type and place of the data of a member. Raises ValueError."""
    if info.flag_bits & 1:
        raise ValueError("it is encrypted")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError("it is packed in another way than numpy does")
    with archive.open(info) as stream:
        version = np.lib.format.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError("its format is unknown")
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
        start = stream.tell()
    if not all(type(extent) is int and extent >= 0 for extent in shape):
        raise ValueError("its shape is none")
    if dtype.kind != "O" and start + math.prod(shape) * dtype.itemsize != info.file_size:
        raise ValueError("its length and its shape differ")
    return shape, dtype, start


def _npz_member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str) -> Member:
    what = f"column '{short(name)}': cannot be read"
    with reading(path, what):
        shape, dtype, start = _npz_header(archive, info)

    def read() -> NDArray[Any]:
        with reading(path, what), zipfile.ZipFile(path) as archive, archive.open(info) as stream:
            stream.read(start)
            data = stream.read()
            if len(data) != math.prod(shape) * dtype.itemsize:
                raise ValueError("it is cut off")
            return np.frombuffer(data, dtype)

    return Member(shape, dtype, read)


def _npz_meta(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> str:
    if info.file_size > 4 * MOST_META_BYTES:
        raise UserError(f"{path}: meta: larger than {MOST_META_BYTES} characters")
    with reading(path, "meta: cannot be read"):
        shape, dtype, start = _npz_header(archive, info)
        if math.prod(shape) != 1 or dtype.kind not in "US":
            raise ValueError("it is no text")
        with archive.open(info) as stream:
            stream.read(start)
            return str(np.frombuffer(stream.read(), dtype)[0])


# ------------------------------------------------------------------------------------------------------------ MATLAB


#: Of a file of version 5 to 7: its header, the kinds of its elements, and the flags of an array.
_MAT_HEADER, _MAT_ARRAY, _MAT_PACKED, _MAT_COMPLEX, _MAT_LOGICAL, _MAT_CHAR = 128, 14, 15, 0x800, 0x200, 4
#: Types of numbers by their class, by the kind of the element that holds them, and by the digit of version 4.
_MAT_CLASSES = dict(enumerate(("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"), start=6))
_MAT_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MAT_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16-{}", 16: "utf-8", 17: "utf-16-{}", 18: "utf-32-{}"}
_MAT4_TYPES = ("f8", "f4", "i4", "i2", "u2", "u1")

#: Variables of a MATLAB file: arrays of numbers, and the text `meta`. Others are left out.
_Variables = Iterator[tuple[str, "str | NDArray[Any]"]]


def mat(path: Path) -> Members:
    """The vectors of a MATLAB file of version 4 to 7, and the columns of its matrices; a text `meta` is JSON."""
    data = _content(path)
    if data.startswith(b"MATLAB 7.3") or data[512:516] == b"\x89HDF":
        raise UserError(f"{path}: MATLAB's format 7.3 is not read: save it with  save FILE -v7")
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
    return _members(path, arrays), parse_meta(path, meta) if meta else {}


def _mat4(data: bytes) -> _Variables:
    """Of a file of version 4. Raises ValueError, and EOFError where it is cut off."""
    at = 0
    while at < len(data):
        order = "<" if 0 <= struct.unpack_from("<i", data, at)[0] < 5000 else ">"
        kind, rows, columns, imaginary, length = struct.unpack_from(f"{order}5i", data, at)
        place = kind // 10 % 10
        if not 0 <= kind < 5000 or min(rows, columns, length) < 0 or place >= len(_MAT4_TYPES):
            raise ValueError("a variable's header is none")
        name = bytes(_piece(data, at + 20, length)).rstrip(b"\0").decode("latin-1")
        dtype = np.dtype(order + _MAT4_TYPES[place])
        size = rows * columns * dtype.itemsize
        values = np.frombuffer(_piece(data, at + 20 + length, size), dtype).reshape((rows, columns), order="F")
        at += 20 + length + size * (2 if imaginary else 1)
        if kind % 10 == 0:
            yield name, values.astype(np.complex128 if imaginary else dtype.newbyteorder("="), copy=False)
        elif kind % 10 == 1 and name == "meta":
            yield name, "".join(map(chr, values.astype("u2").ravel()))


def _mat5(data: memoryview, order: str) -> _Variables:
    """Of a file of version 5 to 7, unpacked. Raises ValueError, and EOFError where it is cut off."""
    at = _MAT_HEADER
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        body = _piece(data, at + 8, size)
        at += 8 + size
        if kind == _MAT_ARRAY and size:
            yield from _array(body, order)


def _array(body: memoryview, order: str) -> _Variables:
    """The variable of an array's element, if it is one of numbers, or `meta`."""
    flags, at = _element(body, 0, order)[1:]
    flag = struct.unpack_from(f"{order}I", flags)[0]
    of = flag & 0xFF
    if flag & _MAT_LOGICAL or (of != _MAT_CHAR and of not in _MAT_CLASSES):  # other classes have other parts
        return
    extents, at = _element(body, at, order)[1:]
    letters, at = _element(body, at, order)[1:]
    kind, content, _ = _element(body, at, order)
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
    whole = np.complex128 if flag & _MAT_COMPLEX else np.dtype(_MAT_CLASSES[of])
    yield name, values.astype(whole, copy=False).reshape(shape, order="F")


def _element(data: memoryview, at: int, order: str) -> tuple[int, memoryview, int]:
    """Kind and content of the element at a place, and the place behind it. Small ones have both in eight bytes."""
    kind = struct.unpack_from(f"{order}I", data, at)[0]
    if kind >> 16:
        return kind & 0xFFFF, _piece(data, at + 4, kind >> 16), at + 8
    size = struct.unpack_from(f"{order}I", data, at + 4)[0]
    return kind, _piece(data, at + 8, size), at + 8 + size + -size % 8


def _piece(data: memoryview | bytes, at: int, size: int) -> memoryview:
    if not 0 <= size <= len(data) - at:
        raise EOFError("it is cut off")
    return memoryview(data)[at : at + size]


def _unpacked(path: Path, data: bytes, order: str) -> memoryview:
    """A MATLAB file with its packed variables unpacked, so that its size is known before it is read."""
    parts, size, at, most = [data[:_MAT_HEADER]], _MAT_HEADER, _MAT_HEADER, _room(data)
    while at + 8 <= len(data):
        kind, length = struct.unpack_from(f"{order}II", data, at)
        part = data[at : at + 8 + length]
        if kind == _MAT_PACKED:
            part = _inflated(path, zlib.decompressobj(), part[8:], most, size)
        parts.append(part)
        size, at = size + len(part), at + 8 + length
    return memoryview(_bounded(path, b"".join(parts), most))


def _content(path: Path) -> bytes:
    """All of a file, in blocks: memory is taken for what is there."""
    blocks, size = [], 0
    with path.open("rb") as stream:
        while (block := stream.read(BLOCK_BYTES)) and size <= MOST_UNPACKED_BYTES:
            blocks.append(block)
            size += len(block)
    return _bounded(path, b"".join(blocks), MOST_UNPACKED_BYTES)


def _room(data: bytes) -> int:
    """Bytes that a whole file may unpack to."""
    return min(MOST_UNPACKED_BYTES, max(MOST_UNPACKED_SMALL, MOST_GROWTH * len(data)))


def _inflated(path: Path, inflater: Any, data: bytes, most: int, before: int = 0) -> bytes:
    """`data` unpacked; with the bytes `before` it makes at most `most`. Raises UserError, EOFError and what `inflater`
    raises."""
    unpacked: bytes = inflater.decompress(data, max(most - before, 0) + 1)
    if before + len(unpacked) <= most and not inflater.eof:
        raise EOFError("it is cut off")
    return _bounded(path, unpacked, most, before)


def _bounded(path: Path, data: bytes, most: int, before: int = 0) -> bytes:
    if before + len(data) > most:
        raise UserError(f"{path}: it unpacks to more than {most >> 20} MiB: write it as .csv or .npz")
    return data


def _members(path: Path, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Member]:
    """Vectors as they are, a matrix NAME as NAME:1, NAME:2, ..."""
    members: dict[str, Member] = {}
    for name, array in arrays.items():
        if array.ndim != 2 or 1 in array.shape:
            _add(path, members, name, array.ravel() if array.ndim == 2 else array)
            continue
        for column in range(min(array.shape[1], MOST_COLUMNS + 1)):
            _add(path, members, f"{name}:{column + 1}", array[:, column])
    return members


def _add(path: Path, members: dict[str, Member], name: str, array: NDArray[Any]) -> None:
    if name in members:
        raise UserError(f"{path}: column '{short(name)}' appears twice")
    if len(members) >= MOST_COLUMNS:
        raise UserError(f"{path}: more than {MOST_COLUMNS} columns")
    members[name] = Member(array.shape, array.dtype, lambda: array)


# ----------------------------------------------------------------------------------------------------------------- R


#: Column of an object of R's class `imu` (packages gmwm, simts, imudata), as `Gyro. X`.
_IMU_COLUMN = re.compile(r"(?P<kind>Gyro|Accel)\. (?P<axis>[XYZ])")


def r_data(path: Path) -> Members:
    """The numeric vectors, matrices and data frames of an R file. The rate of an `imu` object is its metadata.

    Columns are called by their names, NAME:1, NAME:2, ... where a matrix has none; `Gyro. X` of an `imu` is gx.
    """
    with reading(path, "not a whole R file"):
        packed = _content(path)
        data = _r_unpacked(path, packed)
        for magic in (b"RDX2\n", b"RDX3\n"):
            data = data.removeprefix(magic)
        if not data.startswith(b"X\n"):
            raise UserError(f"{path}: not an R file in R's binary form: write it with save() or saveRDS(), ascii=FALSE")
        root = _r_parse(path, memoryview(data)[2:], _room(packed) // 8)
        members: dict[str, Member] = {}
        meta: dict[str, Any] = {}
        objects = list(_r_pairs(root)) if root.info.type.name == "LIST" else [("x", root)]
        for name, value in objects:
            _r_add(path, members, meta, name, value)
    return members, meta


def _r_unpacked(path: Path, data: bytes) -> bytes:
    for magic, inflater in (
        (b"\x1f\x8b", lambda: zlib.decompressobj(wbits=31)),
        (b"BZh", bz2.BZ2Decompressor),
        (b"\xfd7zXZ", lambda: lzma.LZMADecompressor(memlimit=MOST_UNPACKED_BYTES)),
    ):
        if data.startswith(magic):
            return _inflated(path, inflater(), data, _room(data))
    return data


def _r_parse(path: Path, data: memoryview, room: int) -> Any:
    """The tree of an R file, of no more objects than MOST_R_OBJECTS. `room`: numbers of all its sequences together,
    which take no bytes of the file."""
    from rdata.parser import DEFAULT_ALTREP_MAP
    from rdata.parser._xdr import ParserXDR

    count = 0

    class Parser(ParserXDR):
        def parse_R_object(self, *arguments: Any, **options: Any) -> Any:
            nonlocal count
            count += 1
            if count > MOST_R_OBJECTS:
                raise UserError(f"{path}: more than {MOST_R_OBJECTS:,} values that are no numbers: leave texts out")
            return super().parse_R_object(*arguments, **options)

        def _parse_array_values(self, dtype: Any, length: int) -> NDArray[Any]:
            if not 0 <= length <= (len(data) - self.file.tell()) // np.dtype(dtype).itemsize:
                raise EOFError("it is cut off")
            return super()._parse_array_values(dtype, length)

        def _parse_bytecode(self, *_: Any, **__: Any) -> NoReturn:
            raise UserError(f"{path}: it holds R functions: save the data alone")

    def sequence(state: Any) -> Any:
        nonlocal room
        if not 0 <= state.value[0] <= room:
            raise UserError(f"{path}: a sequence of {state.value[0]:g} numbers: save the numbers themselves")
        room -= int(state.value[0])
        return DEFAULT_ALTREP_MAP[b"compact_realseq"](state)

    known = {name: made for name, made in DEFAULT_ALTREP_MAP.items() if name != b"deferred_string"}
    known |= {b"compact_intseq": sequence, b"compact_realseq": sequence}
    return Parser(data, expand_altrep=True, altrep_constructor_dict=known).parse_all().object


def _r_pairs(node: Any) -> Iterator[tuple[str, Any]]:
    """Names and values of a pair list."""
    while node is not None and node.info.type.name == "LIST":
        value, node_after = node.value
        yield _r_text(node.tag), value
        node = node_after


def _r_text(node: Any) -> str:
    """A symbol's or a string's text; empty where there is none."""
    while node is not None and node.info.type.name in ("REF", "SYM"):
        node = node.referenced_object if node.info.type.name == "REF" else node.value
    return node.value.decode("utf-8", "replace") if node is not None and isinstance(node.value, bytes) else ""


def _r_texts(node: Any) -> list[str]:
    return [_r_text(one) for one in node.value] if node is not None and node.info.type.name == "STR" else []


def _r_add(path: Path, members: dict[str, Member], meta: dict[str, Any], name: str, node: Any) -> None:
    """The columns of one object of the file."""
    attributes = dict(_r_pairs(node.attributes))
    if node.info.type.name == "VEC":  # a list, or a data frame
        for called, value in zip(_r_texts(attributes.get("names")), node.value, strict=False):
            if value.info.type.name in ("INT", "REAL"):
                _add(path, members, called, _r_array(value))
        return
    if node.info.type.name not in ("INT", "REAL"):
        return
    array = _r_array(node)
    shape = attributes["dim"].value.tolist() if "dim" in attributes else [array.size]
    if len(shape) != 2:
        _add(path, members, name, array.reshape(shape, order="F"))
        return
    headings = _r_texts(attributes["dimnames"].value[1]) if "dimnames" in attributes else []
    is_imu = "imu" in _r_texts(attributes.get("class"))
    for column, values in enumerate(array.reshape(shape, order="F").T[: MOST_COLUMNS + 1]):
        heading = headings[column] if column < len(headings) else f"{name}:{column + 1}"
        match = _IMU_COLUMN.fullmatch(heading) if is_imu else None
        _add(path, members, match["kind"][0].lower() + match["axis"].lower() if match else heading, values)
    if is_imu and "freq" in attributes:
        meta["rate_hz"] = float(attributes["freq"].value[0])


def _r_array(node: Any) -> NDArray[Any]:
    """Numbers [n]; a missing value of an integer is NaN."""
    if isinstance(node.value, np.ma.MaskedArray):
        return np.asarray(np.ma.filled(node.value.astype(np.float64), np.nan))
    return np.asarray(node.value)
