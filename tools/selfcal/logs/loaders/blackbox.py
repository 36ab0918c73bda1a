"""Betaflight's blackbox (.bbl, .bfl): the frames of a log as a table, by the description of its own headers.

A file may hold several logs, a log for each arming: each is a source. Rates are in deg/s by the header `gyro_scale`,
ten times finer where `blackbox_high_resolution` is on; accelerations are counts of `acc_1G`. A damaged frame is left
out, and the frames built on it, until the next self-contained frame.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError
from selfcal.base.limits import MOST_COLUMNS
from selfcal.logs.loaders.damage import Damaged
from selfcal.logs.loaders.table import Hints, Table, of_arrays

BEGIN = b"H Product:Blackbox"
#: Columns that are read: letter of the axes here by the name in the headers.
_AXES = {"gyroADC": "g", "accSmooth": "a"}
#: Bytes of an event's data, by its number; a log's end is known by its text.
_EVENTS = {0: "v", 10: "vv", 11: "vv", 12: "vv", 13: "b4", 14: "vv", 15: "v", 30: "vv", 40: "v"}


class _Damaged(Exception):
    """The bytes are no frame."""


class _Bytes:
    """Numbers from a place in a log on. All raise IndexError at its end."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def byte(self) -> int:
        value = self.data[self.at]
        self.at += 1
        return value

    def unsigned(self) -> int:
        """Seven bits a byte, the lowest first."""
        value = 0
        for shift in range(0, 35, 7):
            byte = self.byte()
            value |= (byte & 0x7F) << shift
            if not byte & 0x80:
                return value & 0xFFFFFFFF
        raise _Damaged

    def signed(self) -> int:
        """The sign in the lowest bit."""
        value = self.unsigned()
        return (value >> 1) ^ -(value & 1)

    def little(self, size: int) -> int:
        """A signed whole number of `size` bytes."""
        value = int.from_bytes(self.data[self.at : self.at + size], "little", signed=True)
        self.at += size
        if self.at > len(self.data):
            raise IndexError
        return value


def _sign(value: int, bits: int) -> int:
    return value - (1 << bits) if value >> (bits - 1) else value


def _three(data: _Bytes, wide: Sequence[Sequence[int]]) -> list[int]:
    """Three numbers of a tag: of the bits `wide` by the tag's number 0 to 2, or of 1 to 4 bytes each."""
    tag = data.byte()
    kind = tag >> 6
    if kind == len(wide):
        return [data.little(1 + (tag >> 2 * k & 3)) for k in range(3)]
    bits = wide[kind]
    total = -(-(2 + sum(bits)) // 8) * 8
    value, left = tag & 0x3F, 6
    while left < total - 2:
        value, left = value << 8 | data.byte(), left + 8
    # The bits that no number takes stand before the first, and between bytes where numbers take six each.
    if bits == (6, 6, 6):
        return [_sign(value >> shift & 0x3F, 6) for shift in (16, 8, 0)]
    ends = [sum(bits[k + 1 :]) for k in range(3)]
    return [_sign(value >> end & (1 << count) - 1, count) for end, count in zip(ends, bits, strict=True)]


def _four(data: _Bytes) -> list[int]:
    """Four numbers of a tag, of 0, 4, 8 or 16 bits each, packed by half bytes."""
    tag = data.byte()
    held = -1
    numbers = []

    def half() -> int:
        nonlocal held
        if held >= 0:
            value, held = held, -1
            return value
        byte = data.byte()
        held = byte & 0xF
        return byte >> 4

    for k in range(4):
        count = (0, 1, 2, 4)[tag >> 2 * k & 3]
        value = 0
        for _ in range(count):
            value = value << 4 | half()
        numbers.append(_sign(value, 4 * count) if count else 0)
    return numbers


def _values(data: _Bytes, encodings: Sequence[int]) -> list[int]:
    """The numbers of a frame before their prediction. Raises _Damaged and IndexError."""
    numbers: list[int] = []
    while len(numbers) < len(encodings):
        column = len(numbers)
        match encodings[column]:
            case 0:
                numbers.append(data.signed())
            case 1:
                numbers.append(data.unsigned())
            case 3:  # 14 bits, negative
                numbers.append(-_sign(data.unsigned() & 0x3FFF, 14))
            case 6:  # up to eight numbers, a tag says which are not 0
                count = len([*takewhile(encodings[column].__eq__, encodings[column : column + 8])])
                tag = data.byte() if count > 1 else 1
                numbers += [data.signed() if tag >> k & 1 else 0 for k in range(count)]
            case 7:
                numbers += _three(data, ((2, 2, 2), (4, 4, 4), (6, 6, 6)))
            case 8:
                numbers += _four(data)
            case 9:
                numbers.append(0)
            case 10:
                numbers += _three(data, ((2, 2, 2), (5, 5, 4), (8, 7, 7)))
            case _:
                raise _Damaged
    if len(numbers) != len(encodings):
        raise _Damaged
    return numbers


class _Log:
    """A log of a file."""

    def __init__(self, data: bytes) -> None:
        """Read the headers. Raises ValueError where they describe no frames."""
        self.data = _Bytes(data)
        self.headers: dict[str, str] = {}
        while data[self.data.at : self.data.at + 2] == b"H ":
            end = data.find(b"\n", self.data.at)
            if end < 0:
                break
            name, _colon, value = data[self.data.at + 2 : end].decode("latin-1").partition(":")
            self.headers[name] = value
            self.data.at = end + 1
        self.names = self.headers.get("Field I name", "").split(",")
        if len(self.names) > MOST_COLUMNS or "time" not in self.names:
            raise ValueError("its headers describe no frames")
        #: Predictors and encodings of the fields, a number each, by the kind of frame.
        self.kinds: dict[int, tuple[list[int], list[int]]] = {}
        for kind in "IPSGH":
            predictors, encodings = (self._numbers(f"Field {kind} {part}") for part in ("predictor", "encoding"))
            if 0 < len(predictors) == len(encodings) <= MOST_COLUMNS:
                self.kinds[ord(kind)] = predictors, encodings
        self.time = self.names.index("time")
        self.motor = self.names.index("motor[0]") if "motor[0]" in self.names else 0
        least = self._number("minthrottle", 1150)
        #: What predicts a field alone, by the format's numbers of predictors.
        battery, motor = self._number("vbatref", 4095), self._number("motorOutput", least)
        self.constants = {0: 0, 4: least, 8: 1500, 9: battery, 11: motor}
        self.step = max(1, self._number("P interval", 1, "/"))
        #: What could not be read so far.
        self.damaged = Damaged()

    def _numbers(self, name: str) -> list[int]:
        return [int(part) for part in self.headers.get(name, "").split(",") if part.lstrip("-").isdigit()]

    def _number(self, name: str, otherwise: int, separator: str = ",") -> int:
        first = self.headers.get(name, "").split(separator)[-1 if separator == "/" else 0]
        return int(first) if first.lstrip("-").isdigit() else otherwise

    def frames(self) -> Iterator[list[int]]:
        """The values of the main frames, in order. Data from a damaged frame to the next self-contained frame counts as
        `damaged`."""
        data, history = self.data, list[list[int]]()
        lost, size = -1, len(data.data)
        while data.at < size:
            begin = data.at
            try:
                kind = data.byte()
                if kind in b"E":
                    size = data.at if self._event() else size
                    continue
                if kind not in self.kinds:
                    raise _Damaged
                predictors, encodings = self.kinds[kind]
                values = _values(data, encodings)
                if data.at < len(data.data) and data.data[data.at] not in b"IPSGHE":
                    raise _Damaged
                if kind not in b"IP" or (kind in b"P" and not history):
                    continue
                values = self._predicted(values, predictors, history if kind in b"P" else [])
                # Of frames 10 s apart, or back in time, one is damaged.
                if history and not 0 < values[self.time] - history[-1][self.time] < 10_000_000:
                    raise _Damaged
            except (_Damaged, IndexError):
                lost = begin if lost < 0 else lost
                history, data.at = [], begin + 1
                continue
            if lost >= 0:
                self.damaged += Damaged(begin - lost, 1)
                lost = -1
            history = [values, values] if kind in b"I" else [history[-1], values]
            yield values
        if lost >= 0:
            self.damaged += Damaged(size - lost, 1)

    def _predicted(self, values: list[int], predictors: Sequence[int], history: Sequence[list[int]]) -> list[int]:
        """The values with what they are predicted by. Raises _Damaged."""
        for column, predictor in enumerate(predictors):
            before, last = (frame[column] for frame in history) if history else (0, 0)
            match predictor:
                case 1 if history:
                    values[column] += last
                case 2 if history:
                    values[column] += 2 * last - before
                case 3 if history:
                    values[column] += int((last + before) / 2)
                case 5:
                    values[column] += values[self.motor]
                case 6:
                    values[column] += last + self.step if history else 0
                case _ if predictor in self.constants:
                    values[column] += self.constants[predictor]
                case _:
                    raise _Damaged
        return values

    def _event(self) -> bool:
        """Pass by an event; whether it is the log's end."""
        if self.data.data.startswith(b"\xffEnd of log\0", self.data.at):
            return True
        number = self.data.byte()
        if number not in _EVENTS:
            raise _Damaged
        for part in _EVENTS[number]:
            if part == "v":
                self.data.unsigned()
            elif part == "b":
                if self.data.byte() & 0x80:
                    self.data.little(4)
                else:
                    self.data.signed()
        return False


def read(path: Path, _: Hints) -> list[Table]:
    """The tables of a file's logs. Raises UserError."""
    data = path.read_bytes().rstrip(b"\xff")  # of a chip that was never written
    begins = [data.find(BEGIN)]
    while begins[-1] >= 0:
        begins.append(data.find(BEGIN, begins[-1] + 1))
    tables = list[Table]()
    damaged = Damaged()
    for number, (begin, end) in enumerate(zip(begins[:-1], [*begins[1:-1], len(data)], strict=True), 1):
        try:
            log = _Log(data[begin:end])
            table = _table(log, f"log {number}")
        except ValueError as error:
            raise UserError(f"{path}: log {number}: {error}") from error
        damaged += log.damaged
        tables += [table] if table is not None else []
    if not tables:
        raise UserError(f"{path}: no log in it has frames with gyroADC")
    tables = [replace(table, damaged=damaged) for table in tables]
    return [replace(tables[0], source="")] if len(tables) == 1 else tables


def _table(log: _Log, source: str) -> Table | None:
    """The table of a log; None without frames or gyro."""
    headings = {"time": "t[us]"}
    fine = 10.0 if log.headers.get("blackbox_high_resolution", "0").strip() == "1" else 1.0
    sizes = {"gyroADC": _gyro_size(log.headers.get("gyro_scale", "")) / fine}
    one_g = log.headers.get("acc_1G", "")
    if one_g.isdigit() and int(one_g) > 0:
        sizes["accSmooth"] = 1.0 / int(one_g)
    for name, size in sizes.items():
        for column, axis in enumerate("xyz"):
            if size > 0.0 and f"{name}[{column}]" in log.names:
                headings[f"{name}[{column}]"] = f"{_AXES[name]}{axis}[{'deg/s' if name == 'gyroADC' else 'g'}]"
    places = [log.names.index(name) for name in headings]
    values = array("q")
    for frame in log.frames():
        values.extend(frame[column] for column in places)
    if "gyroADC[0]" not in headings or not values:
        return None
    rows = np.array(values).reshape(-1, len(places))
    columns: dict[str, NDArray[Any]] = {"t[us]": rows[:, 0]}
    for column, (name, heading) in enumerate(headings.items()):
        if column:
            columns[heading] = rows[:, column] * sizes[name[:-3]]
    return of_arrays(source, columns)


def _gyro_size(text: str) -> float:
    """Degrees a second of a count, of the bits of a float32: in older logs radians a microsecond."""
    try:
        (size,) = struct.unpack(">f", bytes.fromhex(text.strip().removeprefix("0x").rjust(8, "0")))
    except (ValueError, struct.error):
        return 0.0
    return float(np.degrees(size) * 1e6) if 0.0 < size < 1e-4 else float(size) if np.isfinite(size) else 0.0
