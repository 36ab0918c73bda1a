"""Logs of frames, as python-can's loggers write them: read back as if the module sent them now."""

from __future__ import annotations

import math
import struct
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from selfcal.errors import UserError

if TYPE_CHECKING:
    import can

#: What `monitor --log` writes, and what --read reads.
WRITTEN = (".asc", ".blf", ".csv", ".log", ".trc")

#: Of Vector's BLF: size of the file's header, then an object's signature, size and kind; a container's own header.
BLF_HEADER, BLF_OBJECT = struct.Struct("<4sL"), struct.Struct("<4s4xLL")
BLF_CONTAINER, BLF_CONTAINER_HEAD, BLF_ZLIB = 10, 16, b"\x02\x00"
#: Bytes that a container may unpack to; python-can and Vector write 128 KB.
BLF_CONTAINER_MAX = 16 << 20


class FrameLog:
    """The frames of a log, `speed` times as fast as they came; None: as fast as they are read.

    `closed` at its end; `damage` says why that came early, if it did. `malformed` stays 0, as `Link` has it.
    """

    def __init__(self, path: Path | str, speed: float | None = None) -> None:
        import can

        self.path = Path(path)
        self.malformed = 0
        self.closed = False
        self.damage = ""
        self._speed = speed
        self._waiting: can.Message | None = None
        self._due: float | None = None
        self._last_s = math.nan  # time stamp of the frame before
        if self.path.suffix.lower() not in WRITTEN:
            raise UserError(f"{path}: the name of a frame log ends in {', '.join(WRITTEN)}")
        if not self.path.is_file():
            missing = "there is no such file" if not self.path.exists() else "this is no file"
            raise UserError(f"{path}: cannot read the frame log: {missing}")
        if self.path.suffix.lower() == ".blf":
            _check_blf(self.path)
        try:
            self._reader = can.LogReader(self.path)
            self._frames: Iterator[can.Message] = iter(self._reader)
            self._waiting = next(self._frames, None)
        except Exception as error:  # python-can's readers raise what they stumble over
            raise UserError(f"{path}: no frame log as python-can writes it: {_said(error)}") from error
        if self._waiting is None:
            self.close()
            raise UserError(f"{path}: there is no frame in this log")

    def recv(self, timeout: float) -> can.Message | None:
        """The next frame when it is due, or None after `timeout` seconds or at the end."""
        frame = self._waiting
        if frame is None:
            self.closed = True
            return None
        wait = self._wait(frame.timestamp)
        if wait > timeout:
            time.sleep(timeout)
            return None
        time.sleep(wait)
        self._due = None
        self._last_s = frame.timestamp
        try:
            self._waiting = next(self._frames, None)
        except Exception as error:
            self._waiting, self.damage = None, _said(error)
        self.closed = self._waiting is None
        return frame

    def _wait(self, stamp_s: float) -> float:
        """Seconds until the frame with this time stamp is due; a stamp that goes back or is no number does not wait."""
        if self._speed is None:
            return 0.0
        now = time.monotonic()
        if self._due is None:
            gap = (stamp_s - self._last_s) / self._speed
            self._due = now + (gap if 0.0 < gap < math.inf else 0.0)
        return max(0.0, self._due - now)

    def close(self) -> None:
        """Close the file."""
        self._reader.stop()

    def __enter__(self) -> FrameLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _check_blf(path: Path) -> None:
    """Raises UserError for a BLF file on which python-can's reader would take all memory, or go round for ever.

    A file is a header and objects; an object's header tells its size, and a container holds objects, packed by zlib.
    """
    with path.open("rb") as file:
        left = path.stat().st_size
        start = file.read(BLF_HEADER.size)
        header = BLF_HEADER.unpack(start)[1] if len(start) == BLF_HEADER.size else 0
        if header > left:
            raise UserError(f"{path}: no frame log: its header is cut off")
        file.seek(max(header, len(start)))
        tail = b""
        while len(head := file.read(BLF_OBJECT.size)) == BLF_OBJECT.size:
            signature, size, kind = BLF_OBJECT.unpack(head)
            if signature != b"LOBJ" or not BLF_OBJECT.size <= size <= left:
                return  # python-can stops there
            body = file.read(size - BLF_OBJECT.size)
            file.seek(size % 4, 1)
            if kind == BLF_CONTAINER:
                tail = _check_objects(path, tail + _unpacked(path, body))


def _unpacked(path: Path, body: bytes) -> bytes:
    """What a container holds, as far as it can be unpacked."""
    data = body[BLF_CONTAINER_HEAD:]
    if body[:2] == BLF_ZLIB:
        packed = zlib.decompressobj()
        try:
            data = packed.decompress(data, BLF_CONTAINER_MAX + 1)
        except zlib.error:
            data = b""
    if len(data) > BLF_CONTAINER_MAX:
        raise UserError(f"{path}: a part of this frame log unpacks to more than {BLF_CONTAINER_MAX >> 20} MB")
    return data


def _check_objects(path: Path, data: bytes) -> bytes:
    """Walk through the objects of a container as python-can does; returns the beginning of one that goes on."""
    at = 0
    while (at := data.find(b"LOBJ", at, at + 8)) >= 0 and len(data) - at >= BLF_OBJECT.size:
        _, size, _ = BLF_OBJECT.unpack_from(data, at)
        if not BLF_OBJECT.size <= size <= BLF_CONTAINER_MAX:
            raise UserError(f"{path}: damaged frame log: an object of {size} bytes")
        if at + size > len(data):
            return data[at:]
        at += size
    return b""


def _said(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
