"""Recordings that are numpy's .npz. Sizes are read before the arrays are, and there is no pickle."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError, short
from selfcal.base.limits import MOST_COLUMNS, MOST_META_BYTES, reading
from selfcal.logs.loaders.table import Hints, Member, Table, check_numbers, parse_meta


def read(path: Path, _: Hints) -> list[Table]:
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
        check_numbers(path, sum(info.file_size for info in listed) // 8)
        for info in listed:
            name = info.filename.removesuffix(".npy")
            if name in members or (name == "meta" and meta):
                raise UserError(f"{path}: column '{short(name)}' appears twice")
            if name == "meta":
                meta = _npz_meta(path, archive, info)
            elif name != info.filename:
                members[name] = _npz_member(path, archive, info, name)
    return [Table("", members, parse_meta(path, meta) if meta else {})]


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
        raise ValueError("its shape is invalid")
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
