"""Logs of frames, read as if the module sent them now."""

from __future__ import annotations

import base64
import json
import logging
import math
import re
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from selfcal.base.errors import UserError, install_line
from selfcal.base.limits import BLOCK_BYTES
from selfcal.logs.loaders.damage import SOUND, Damaged

if TYPE_CHECKING:
    import can

#: Suffixes that `monitor --log` writes and --read reads.
WRITTEN = (".asc", ".blf", ".csv", ".log", ".mcap", ".trc")
#: Suffixes of binary logs.
BINARY = (".blf", ".mcap")

#: Vector's BLF: sizes of the file's header and of the file, then an object's signature, size and kind; a container's
#: own header.
BLF_HEADER, BLF_OBJECT = struct.Struct("<4sL8xQ"), struct.Struct("<4s4xLL")
BLF_CONTAINER, BLF_CONTAINER_HEAD, BLF_ZLIB = 10, 16, b"\x02\x00"

#: A line of `candump` without -l, and the first line of the CSV files of GVRET and SavvyCAN.
CANDUMP = re.compile(
    r"\s*(?:\((?P<time>[^)]*)\)\s+)?\w+\s+(?:[RT]X\s+\S\s+\S\s+)?(?P<id>[0-9A-F]{3}|[0-9A-F]{8})\s+"
    r"\[(?P<length>\d+)\](?P<data>\s+remote request|(?:\s+[0-9A-F]{2})*)\s*(?:'.*'?)?\s*"
)
GVRET = "Time Stamp,ID,Extended,"
#: Characters of a line, and bytes of an MCAP record and of a serial line without an end, at most: the rest of a longer
#: line counts as another line.
LONGEST_LINE = 1 << 16
#: First lines of a text log that show its form, unless all of them are damaged.
LINES_OF_FORM = 100
#: Sound lines without a frame, by suffix.
PASSED = {
    ".asc": re.compile(
        r"//|(begin|end)\s+triggerblock|date\s|base\s|(no\s+)?internal\s+events|"
        r"\d+\.\d+\s+(can\s+)?(\d+\s+)?(?![0-9a-f]+x?\s)[a-z][a-z0-9_:-]+",
        re.ASCII | re.IGNORECASE,
    ),
    ".csv": re.compile(rf"timestamp,arbitration_id,|{GVRET}"),
    ".trc": re.compile(r";|\d+\)?\s+[\d.]+\s+(\d\s+)?(Warng|Error|ST|EC|ER|EV)\s", re.ASCII),
}
#: Topic of raw frames in an MCAP file.
FRAMES = "/selfcal/frames"
#: Bytes of a frame at most, but for CAN FD.
LONGEST_FRAME = 8


class _NoFrame(ValueError):
    """A place of a log that is no frame, in words."""


class FrameLog:
    """The frames of a log, `speed` times as fast as they came; None: as fast as they are read.

    `closed` at its end; `damage` says why that came early, if it did. `malformed` counts the damaged lines of a text:
    they are left out. A binary log ends at its first damage.
    """

    def __init__(self, path: Path | str, speed: float | None = None) -> None:
        import can

        logging.getLogger("can").setLevel(logging.CRITICAL)  # its readers report the lines that they skip
        self.path = Path(path)
        self.closed = False
        self.damage = ""
        self._speed = speed
        self._waiting: can.Message | None = None
        self._due: float | None = None
        self._last_s = math.nan  # time stamp of the frame before
        self._read = 0
        check_suffix(path)
        if not self.path.is_file():
            missing = "there is no such file" if not self.path.exists() else "this is no file"
            raise UserError(f"{path}: cannot read the frame log: {missing}")
        self._unread = _check_blf(self.path) if self.path.suffix.lower() == ".blf" else SOUND
        try:
            suffix = self.path.suffix.lower()
            self._lines = None if suffix in BINARY else _Lines(self.path)
            self._reader: Any = (
                _reader_of(self._lines)
                if self._lines is not None
                else McapFrames(self.path)
                if suffix == ".mcap"
                else can.BLFReader(self.path)
            )
            self._frames: Iterator[can.Message] = iter(self._reader)
            self._waiting = self._next()
        except Exception as error:  # python-can's readers raise what they stumble over
            raise UserError(f"{path}: no frame log as python-can writes it: {self._said(error)}") from error
        if self._waiting is None:
            self.close()
            if self.malformed:
                lines = f"{self.malformed} line{'s' if self.malformed > 1 else ''}"
                raise UserError(f"{path}: no frame log as python-can writes it: there is no frame in its {lines}")
            raise UserError(f"{path}: there is no frame in this log")

    @property
    def damaged(self) -> Damaged:
        """What could not be read so far: lines of a text; at the end of a binary log what is after its first damage."""
        if self._lines is not None:
            return Damaged(self._lines.malformed_bytes, max(self.malformed, int(bool(self.damage))))
        if self._unread or not self.damage:
            return self._unread
        return Damaged(self.path.stat().st_size - self._reader.file.tell(), 1)

    @property
    def malformed(self) -> int:
        """Damaged lines of a text so far."""
        return 0 if self._lines is None else self._lines.malformed

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
        if wait > 0.0:
            time.sleep(wait)  # of 0 s it takes 0.2 ms
        self._due = None
        self._last_s = frame.timestamp
        try:
            self._waiting = self._next()
        except Exception as error:
            self._waiting, self.damage = None, self._said(error)
        self.closed = self._waiting is None
        if self.closed and not self.damage and (self._unread or _is_cut(self.path)):
            self.damage = self._unread.words if self._unread else "its last line is cut off"
        return frame

    def _next(self) -> can.Message | None:
        """The next frame of the file; None at its end. Raises _NoFrame, and whatever python-can's readers do: of a text
        only where a reader does not get on."""
        while True:
            try:
                frame = next(self._frames, None)
                if frame is not None:
                    _check_frame(frame, self._read + 1)
            except Exception:
                if self._lines is None or not self._lines.restart():
                    raise
                self._frames = iter(self._reader)
                continue
            if frame is not None:
                self._read += 1
                if self._lines is not None:
                    self._lines.taken()
            return frame

    def _said(self, error: Exception) -> str:
        return str(error) if isinstance(error, _NoFrame) else f"frame {self._read + 1} cannot be read"

    def _wait(self, stamp_s: float) -> float:
        """Seconds until the frame with this time stamp is due; a stamp that goes back does not wait."""
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


def _is_cut(path: Path) -> bool:
    """Whether a log of lines ends within a line: python-can may take half a frame for a frame, or skip it."""
    with path.open("rb") as file:
        if path.suffix.lower() in BINARY or not file.seek(0, 2):
            return False
        file.seek(-1, 2)
        return file.read(1) not in b"\r\n"


def _check_frame(frame: can.Message, number: int) -> None:
    """Raise _NoFrame for a frame that python-can's readers make of a damaged place."""
    if not math.isfinite(frame.timestamp):
        raise _NoFrame(f"frame {number} has the time stamp {frame.timestamp:g}")
    plain = not (frame.is_fd or frame.is_remote_frame or frame.is_error_frame)
    if plain and (len(frame.data) != frame.dlc or frame.dlc > LONGEST_FRAME):
        raise _NoFrame(f"frame {number} has {len(frame.data)} bytes and the length {frame.dlc}")


class _Lines:
    """The lines of a text log, as python-can's readers take a file. `malformed` counts lines that give no frame.

    A reader that fails at a line restarts with the next line: an empty line takes the place of its header.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.malformed = self.malformed_bytes = 0
        self._suffix = path.suffix.lower()
        self._passed = PASSED.get(self._suffix)
        self._file: TextIO = path.open(encoding="utf-8", errors="replace")
        self._line = self._held = ""  # handed out last, until a frame comes of it; to be handed out next
        self._read, self._restarted = 0, -1
        self._empty = self._suffix == ".csv"  # its reader passes by the first line unseen
        self._header = self._suffix == ".asc"  # its reader passes by the first line that is no header

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        if self._empty:
            self._empty = False
            return "\n"
        self._judge()
        line, self._held = self._held or self._file.readline(LONGEST_LINE), ""
        if self._header and line[:1].isdigit():
            self._header, self._held = False, line
            return "\n"
        if not line:
            raise StopIteration
        self._read += 1
        self._line = line
        return line

    def taken(self) -> None:
        """A frame has come of the last line."""
        self._line = ""

    def restart(self) -> bool:
        """Be ready for a reader that begins anew. False if none would get on."""
        self._judge()
        if self._restarted == self._read:
            return False
        self._restarted, self._empty = self._read, True
        return True

    def _judge(self) -> None:
        """Count the last line if it is damaged."""
        size, line, self._line = len(self._line), self._line.strip(), ""
        if line and not (self._passed is not None and self._passed.match(line)):
            self.malformed += 1
            self.malformed_bytes += size

    def close(self) -> None:
        self._file.close()


class _Foreign:
    """A reader of a frame for each line, for forms that python-can has no reader of."""

    def __init__(self, lines: _Lines, frame: Callable[[str], can.Message]) -> None:
        self._lines, self._frame = lines, frame

    def __iter__(self) -> Iterator[can.Message]:
        return (self._frame(line) for line in self._lines if line.strip())

    def stop(self) -> None:
        self._lines.close()


def _reader_of(lines: _Lines) -> Any:
    """The reader of a text log: python-can's, or our own."""
    import can

    suffix = lines.path.suffix.lower()
    with lines.path.open("rb") as file:  # lines of it may be damaged
        first = [file.readline(LONGEST_LINE).decode("ascii", "replace").rstrip("\r\n") for _ in range(LINES_OF_FORM)]
    if suffix == ".csv" and "".join(first[:1]).startswith(GVRET):
        return _Foreign(lines, _of_gvret)
    if suffix == ".log" and any(CANDUMP.fullmatch(line) for line in first):
        return _Foreign(lines, _of_candump)
    readers: dict[str, Callable[..., Any]] = {
        ".asc": can.ASCReader,
        ".csv": can.CSVReader,
        ".log": can.CanutilsLogReader,
        ".trc": can.TRCReader,
    }
    return readers[suffix](lines)


def _of_candump(line: str) -> can.Message:
    """A frame of a line such as ` (1700000000.000000)  can0  200   [8]  C0 27 09 00 00 80 B5 88`."""
    match = CANDUMP.fullmatch(line)
    if match is None:
        raise ValueError
    return _message(match["time"] or "", match["id"], len(match["id"]) > 3, int(match["length"]), match["data"].split())


def _of_gvret(line: str) -> can.Message:
    """A frame of a line such as `1000,00000200,false,Rx,0,8,04,00,00,00,41,80,B5,0E,`; its time is in us."""
    time_us, identifier, extended, _, _, length, *data = line.strip().split(",")
    frame = _message(time_us, identifier, extended == "true", int(length), data[: int(length)])
    frame.timestamp *= 1e-6
    return frame


def _message(stamp: str, identifier: str, extended: bool, length: int, data: list[str]) -> can.Message:
    import can

    try:
        time_s = float(stamp)
    except ValueError:  # candump -tA writes a date
        time_s = 0.0
    remote = data == ["remote", "request"]
    if not remote and len(data) != length:
        raise ValueError
    return can.Message(
        timestamp=time_s,
        arbitration_id=int(identifier, 16),
        is_extended_id=extended,
        is_remote_frame=remote,
        dlc=length,
        data=None if remote else bytes(int(byte, 16) for byte in data),
        check=True,
    )


def _check_blf(path: Path) -> Damaged:
    """Damage that python-can's reader passes over: it reads a truncated or damaged container up to the fault, and does
    not look for the end that the header states. Raises UserError for a BLF file on which the reader would take all
    memory, or never end.

    A file is a header and objects; an object's header has its size, and a container holds objects, packed by zlib.
    """
    damaged = SOUND
    with path.open("rb") as file:
        left = path.stat().st_size
        start = file.read(BLF_HEADER.size)
        _, header, whole = BLF_HEADER.unpack(start) if len(start) == BLF_HEADER.size else (b"", 0, 0)
        if header > left:
            raise UserError(f"{path}: no frame log: its header is cut off")
        file.seek(max(header, len(start)))
        tail = b""
        while len(head := file.read(BLF_OBJECT.size)) == BLF_OBJECT.size:
            signature, size, kind = BLF_OBJECT.unpack(head)
            if signature != b"LOBJ" or size < BLF_OBJECT.size:
                break  # python-can stops there, and says so
            body = file.read(min(size, left) - BLF_OBJECT.size)
            file.seek(size % 4, 1)
            if kind == BLF_CONTAINER:
                data, sound = _unpacked(path, body)
                tail = _check_objects(path, tail + data)
                if not sound or len(body) < size - BLF_OBJECT.size:
                    damaged += Damaged(len(head) + len(body), 1, left - damaged.whole)
    return Damaged(whole - left, 1, whole) if whole > left else damaged


def _unpacked(path: Path, body: bytes) -> tuple[bytes, bool]:
    """What a container holds, as far as it can be unpacked, and whether that is all."""
    data, sound = body[BLF_CONTAINER_HEAD:], True
    if body[:2] == BLF_ZLIB:
        packed = zlib.decompressobj()
        try:
            data = packed.decompress(data, BLOCK_BYTES + 1)
            sound = packed.eof
        except zlib.error:
            data, sound = b"", False
    if len(data) > BLOCK_BYTES:
        raise UserError(f"{path}: a part of this frame log unpacks to more than {BLOCK_BYTES >> 20} MB")
    return data, sound


def _check_objects(path: Path, data: bytes) -> bytes:
    """Walk through the objects of a container as python-can does; return the unfinished last object, else empty."""
    begin = 0
    while (begin := data.find(b"LOBJ", begin, begin + 8)) >= 0 and len(data) - begin >= BLF_OBJECT.size:
        _, size, _ = BLF_OBJECT.unpack_from(data, begin)
        if not BLF_OBJECT.size <= size <= BLOCK_BYTES:
            raise UserError(f"{path}: damaged frame log: an object of {size} bytes")
        if begin + size > len(data):
            return data[begin:]
        begin += size
    return b""


class McapFrames:
    """The frames of a file that McapLog wrote, as python-can's readers give them. A record of more than
    LONGEST_LINE bytes ends it. So does the end of the last record: a writer that was killed leaves no summary."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")

    def __iter__(self) -> Iterator[can.Message]:
        import can
        from mcap.exceptions import EndOfFile
        from mcap.records import Channel, Message
        from mcap.stream_reader import StreamReader

        frames: set[int] = set()
        end, records = 0, StreamReader(self._file, emit_chunks=True, record_size_limit=LONGEST_LINE).records
        while True:
            try:
                record = next(records, None)
            except EndOfFile:
                if not end or self._file.tell() > end:  # amid a record
                    raise
                record = None
            if record is None:
                return
            end = self._file.tell()
            if isinstance(record, Channel) and record.topic == FRAMES:
                frames.add(record.id)
            elif isinstance(record, Message) and record.channel_id in frames:
                told = json.loads(record.data)
                data = base64.b64decode(told["data"], validate=True)
                yield can.Message(
                    timestamp=record.log_time * 1e-9,
                    arbitration_id=int(told["id"]),
                    is_extended_id=bool(told["extended"]),
                    dlc=len(data),
                    data=data,
                    check=True,
                )

    def stop(self) -> None:
        """Close the file."""
        self._file.close()


def check_suffix(path: Path | str) -> None:
    """Raise UserError for a name that chooses no format, or a format whose library is not installed."""
    if Path(path).suffix.lower() not in WRITTEN:
        raise UserError(f"{path}: the name of a frame log ends in {', '.join(WRITTEN)}")
    if str(path).lower().endswith(".mcap") and find_spec("mcap") is None:
        raise UserError(f"{path}: mcap is not installed: {install_line('selfcal[mcap]')}")
