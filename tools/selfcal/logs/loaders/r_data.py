"""Recordings that are R's .rda, .rdata and .rds. Sizes are read before the arrays are, and no R function is read."""

from __future__ import annotations

import bz2
import lzma
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError
from selfcal.base.limits import MOST_COLUMNS, MOST_R_OBJECTS, MOST_UNPACKED_BYTES, reading
from selfcal.logs.loaders.table import Hints, Member, Table, add, file_content, inflated, room

#: Column of an object of R's class `imu` (packages gmwm, simts, imudata), as `Gyro. X`.
_IMU_COLUMN = re.compile(r"(?P<kind>Gyro|Accel)\. (?P<axis>[XYZ])")


def read(path: Path, _: Hints) -> list[Table]:
    """The numeric vectors, matrices and data frames of an R file. The rate of an `imu` object is its metadata.

    Columns are called by their names, NAME:1, NAME:2, ... where a matrix has none; `Gyro. X` of an `imu` is gx.
    """
    with reading(path, "not a whole R file"):
        packed = file_content(path)
        data = _r_unpacked(path, packed)
        for magic in (b"RDX2\n", b"RDX3\n"):
            data = data.removeprefix(magic)
        if not data.startswith(b"X\n"):
            raise UserError(f"{path}: not an R file in R's binary form: write it with save() or saveRDS(), ascii=FALSE")
        root = _r_parse(path, memoryview(data)[2:], room(packed) // 8)
        members: dict[str, Member] = {}
        meta: dict[str, Any] = {}
        objects = list(_r_pairs(root)) if root.info.type.name == "LIST" else [("x", root)]
        for name, value in objects:
            _r_add(path, members, meta, name, value)
    return [Table("", members, meta)]


def _r_unpacked(path: Path, data: bytes) -> bytes:
    for magic, inflater in (
        (b"\x1f\x8b", lambda: zlib.decompressobj(wbits=31)),
        (b"BZh", bz2.BZ2Decompressor),
        (b"\xfd7zXZ", lambda: lzma.LZMADecompressor(memlimit=MOST_UNPACKED_BYTES)),
    ):
        if data.startswith(magic):
            return inflated(path, inflater(), data, room(data))
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
            values: NDArray[Any] = super()._parse_array_values(dtype, length)
            return values

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
    """A symbol's or a string's text; else empty."""
    while node is not None and node.info.type.name in ("REF", "SYM"):
        node = node.referenced_object if node.info.type.name == "REF" else node.value
    return node.value.decode("utf-8", "replace") if node is not None and isinstance(node.value, bytes) else ""


def _r_texts(node: Any) -> list[str]:
    return [_r_text(element) for element in node.value] if node is not None and node.info.type.name == "STR" else []


def _r_add(path: Path, members: dict[str, Member], meta: dict[str, Any], name: str, node: Any) -> None:
    """The columns of an object of the file."""
    attributes = dict(_r_pairs(node.attributes))
    if node.info.type.name == "VEC":  # a list, or a data frame
        for called, value in zip(_r_texts(attributes.get("names")), node.value, strict=False):
            if value.info.type.name in ("INT", "REAL"):
                add(path, members, called, _r_array(value))
        return
    if node.info.type.name not in ("INT", "REAL"):
        return
    array = _r_array(node)
    shape = attributes["dim"].value.tolist() if "dim" in attributes else [array.size]
    if len(shape) != 2:
        add(path, members, name, array.reshape(shape, order="F"))
        return
    headings = _r_texts(attributes["dimnames"].value[1]) if "dimnames" in attributes else []
    is_imu = "imu" in _r_texts(attributes.get("class"))
    for column, values in enumerate(array.reshape(shape, order="F").T[: MOST_COLUMNS + 1]):
        heading = headings[column] if column < len(headings) else f"{name}:{column + 1}"
        match = _IMU_COLUMN.fullmatch(heading) if is_imu else None
        add(path, members, match["kind"][0].lower() + match["axis"].lower() if match else heading, values)
    if is_imu and "freq" in attributes:
        meta["rate_hz"] = float(attributes["freq"].value[0])


def _r_array(node: Any) -> NDArray[Any]:
    """Numbers [n]; a missing value of an integer is NaN."""
    if isinstance(node.value, np.ma.MaskedArray):
        return np.asarray(np.ma.filled(node.value.astype(np.float64), np.nan))
    return np.asarray(node.value)
