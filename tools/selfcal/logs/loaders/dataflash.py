"""ArduPilot's logs by pymavlink: DataFlash .bin, a table an IMU, and .tlog, a table a message, vehicle and instance.

Stamps are those of the sensor or the vehicle, never the times at which a ground station got a message.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np

from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.base.limits import BLOCK_BYTES
from selfcal.logs.loaders.damage import Bytes, Damaged, mapped, sifted, walk
from selfcal.logs.loaders.table import Hints, Table, of_arrays

#: Messages of a DataFlash log, and the source that each belongs to; the instance is in a field, or in the name.
_SOURCES = {"IMU": "IMU", "GYR": "raw", "ACC": "raw"}
_DATAFLASH = {f"{name}{number}": source for name, source in _SOURCES.items() for number in ("", "1", "2", "3")}
#: Names here and units by the name of a field.
_FIELDS = {
    **{f"Gyr{axis}": (f"g{axis.lower()}", "rad/s") for axis in "XYZ"},
    **{f"Acc{axis}": (f"a{axis.lower()}", "m/s^2") for axis in "XYZ"},
    "T": ("temp", "degC"),
}
#: MAVLink messages: stamp and its unit, names of the axes, and the units of gyro, accelerometer and temperature. A
#: RAW_IMU is in counts, but for ArduPilot's.
_AXES = {f"{letter}{axis}": f"{axis}{kind}" for letter, kind in (("g", "gyro"), ("a", "acc")) for axis in "xyz"}
_SCALED = ("time_boot_ms", "ms", "mrad/s", "mg")
_TLOG = {
    "RAW_IMU": ("time_usec", "us", "LSB", "LSB"),
    "SCALED_IMU": _SCALED,
    "SCALED_IMU2": _SCALED,
    "SCALED_IMU3": _SCALED,
    "HIGHRES_IMU": ("time_usec", "us", "rad/s", "m/s^2"),
}
#: How a message of a DataFlash log begins, and the kind that describes the others.
_HEAD, _FMT = b"\xa3\x95", 0x80


class _Rows:
    """Values of a source, a column for each heading."""

    def __init__(self, headings: list[str]) -> None:
        self.headings, self.values = headings, array("d")

    def table(self, source: str) -> Table:
        """The table. Drop a temperature that is 0 throughout."""
        values = np.array(self.values).reshape(-1, len(self.headings))
        columns = {name: values[:, column] for column, name in enumerate(self.headings)}
        return of_arrays(source, {name: part for name, part in columns.items() if name[:4] != "temp" or part.any()})


def read(path: Path, _: Hints) -> list[Table]:
    """The tables of a .bin or a .tlog. Raises UserError and what pymavlink raises."""
    sources: dict[str, dict[str, _Rows]] = {}
    with mapped(path) as data:
        binary = data[:2] == _HEAD
        damaged, sound = sifted(data, 0, _ends(data)) if binary else (Damaged(), None)
        lost = list[Damaged]()
        for source, kind, headings, values in _bin(path, sound) if binary else _tlog(data, lost):
            rows = sources.setdefault(source, {})
            if kind not in rows:
                rows[kind] = _Rows(headings)
            if rows[kind].headings == headings:
                rows[kind].values.extend(values)
    if not sources:
        raise UserError(f"{path}: no message {', '.join(_SOURCES if binary else _TLOG)}")
    order = list(_DATAFLASH if binary else _TLOG)
    tables = [rows[kind].table(source) for source, rows in sources.items() for kind in sorted(rows, key=order.index)]
    return [replace(part, damaged=sum(lost, damaged)) for part in tables]


def _ends(data: Bytes) -> Callable[[int], int]:
    """Where the message of a DataFlash log at a place ends. A page's rest that was never written counts as a message.

    A message is two bytes, its kind, and what the message FMT of its kind says. Source: ArduPilot's LogStructure.h.
    """
    size = written = len(data)
    while written and not (block := data[max(0, written - BLOCK_BYTES) : written].rstrip(b"\xff")):
        written = max(0, written - BLOCK_BYTES)
    written = max(0, written - BLOCK_BYTES) + len(block) if written else 0
    lengths = {_FMT: 89}

    def end_of(begin: int) -> int:
        if begin >= written:
            return size
        end = begin + lengths.get(data[begin + 2], 0) if data[begin : begin + 2] == _HEAD and begin + 2 < size else 0
        if not begin + 2 < end <= size:
            return 0
        if data[begin + 2] == _FMT:
            lengths[data[begin + 3]] = data[begin + 4]
        return end

    return end_of


def _bin(path: Path, sound: bytes | None) -> Iterator[tuple[str, str, list[str], list[float]]]:
    """Source, kind, headings and values of each message of an IMU. `sound`: the sound messages, where some are not."""
    from pymavlink.DFReader import DFReader_binary

    if sound is not None:  # the library opens a file by its name
        with NamedTemporaryFile(prefix="selfcal-", suffix=".bin") as file:
            file.write(sound)
            file.flush()
            yield from _bin(Path(file.name), None)
        return

    class Log(DFReader_binary):  # type: ignore[misc]
        """A log whose reading ends: the library takes a message of no bytes for ever."""

        def recv_msg(self) -> Any:
            begin = self.offset
            message = super().recv_msg()
            if message is not None and self.offset <= begin:
                raise UserError(f"{path}: damaged: a message of no bytes at byte {begin}")
            return message

    log = Log(str(path), zero_time_base=True)
    known: dict[tuple[Any, Any], tuple[list[int], list[float], list[str], int | None]] = {}
    while (message := log.recv_match(type=list(_DATAFLASH), strict=True)) is not None:
        layout = message.fmt
        key = (layout.name, tuple(layout.units or ()))
        if key not in known:
            known[key] = _layout(layout)
        places, sizes, headings, instance = known[key]
        elements = message._elements
        number = int(elements[instance]) if instance is not None else int(layout.name[3:] or 1) - 1
        values = [float(elements[place]) * size for place, size in zip(places, sizes, strict=True)]
        yield f"{_DATAFLASH[layout.name]}.{number}", layout.name, headings, values


def _layout(layout: Any) -> tuple[list[int], list[float], list[str], int | None]:
    """Places, sizes of a count and headings of a message's fields, and the place of the instance."""
    names = list(layout.columns)
    time = next(name for name in ("SampleUS", "TimeUS", "TimeMS") if name in names)
    fields = {time: ("t", "ms" if time == "TimeMS" else "us"), **{k: v for k, v in _FIELDS.items() if k in names}}
    headings = []
    for name, (here, unit) in fields.items():
        stated = units.plain(layout.get_unit(name) or "") if here != "t" else ""
        other = (
            stated and units.known(stated) and not (units.same_kind(stated, unit) and units.factor(stated, unit) == 1.0)
        )
        headings.append(f"{here}[{stated if other else unit}]")
    places = [names.index(name) for name in fields]
    sizes = [float(layout.msg_mults[k] or 1.0) for k in places]
    return places, sizes, headings, names.index("I") if "I" in names else None


def _fits(crc: int, stated: bytes) -> bool:
    """Whether a frame of a kind that the dialect does not know may be sound. Its checksum ends with a byte that is the
    kind's own: to a damaged frame one of the 256 fits in one case of 256. Source: MAVLink's CRC_EXTRA."""
    for own in range(256):
        mixed = own ^ crc & 0xFF
        mixed ^= mixed << 4 & 0xFF
        if int.from_bytes(stated, "little") == (crc >> 8) ^ (mixed << 8) ^ (mixed << 3) ^ (mixed >> 4):
            return True
    return False


def _tlog(data: Bytes, lost: list[Damaged]) -> Iterator[tuple[str, str, list[str], list[float]]]:
    """Like `_bin`, for a ground station's log. Damage joins `lost`.

    A message is a stamp of 8 bytes and a frame of MAVLink, which has a checksum.
    """
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    link = dialect.MAVLink(None)
    messages = dict[int, Any]()

    def end_of(at: int) -> int:
        head = data[at + 8 : at + 18]
        if len(head) < dialect.HEADER_LEN_V1 or head[0] not in (dialect.PROTOCOL_MARKER_V1, dialect.PROTOCOL_MARKER_V2):
            return 0
        second = head[0] == dialect.PROTOCOL_MARKER_V2
        number = int.from_bytes(head[7:10], "little") if second else head[5]
        header = dialect.HEADER_LEN_V2 if second else dialect.HEADER_LEN_V1
        checked = at + 8 + header + head[1] + 2
        end: int = checked + (dialect.MAVLINK_SIGNATURE_BLOCK_LEN if second and head[2] & 1 else 0)
        if end > len(data):
            return 0
        if number not in dialect.mavlink_map:
            return end if _fits(dialect.x25crc(data[at + 9 : checked - 2]).crc, data[checked - 2 : checked]) else 0
        try:
            messages[at] = link.decode(bytearray(data[at + 8 : end]))
        except dialect.MAVError:
            return 0
        return end

    ardupilot: set[int] = set()
    for begin, end, sound in walk(data, 0, end_of, checked=True):
        if not sound:
            lost.append(Damaged(end - begin, 1))
        message = messages.pop(begin, None) if sound else None
        if message is None or (kind := message.get_type()) not in ("HEARTBEAT", *_TLOG):
            continue
        vehicle = message.get_srcSystem()
        if kind == "HEARTBEAT":
            # Its RAW_IMU is in counts but for ArduPilot.
            if message.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA:
                ardupilot.add(vehicle)
            continue
        stamp, unit, gyro, accel = _TLOG[kind]
        if kind == "RAW_IMU" and vehicle in ardupilot:
            gyro, accel = "mrad/s", "mg"
        headings = [f"t[{unit}]", *(f"{name}[{gyro if name[0] == 'g' else accel}]" for name in _AXES), "temp[degC]"]
        values: Mapping[str, Any] = message.to_dict()
        size = 1.0 if kind == "HIGHRES_IMU" else 0.01
        row = [values[stamp], *(values[name] for name in _AXES.values()), size * values.get("temperature", 0.0)]
        instance = f".{values['id']}" if values.get("id") else ""
        yield f"{kind}{instance}@{vehicle}", kind, headings, row
