"""PX4's ULog by pyulog: a table a topic and instance.

Stamps are those of the samples (`timestamp_sample`), where a topic has them. `sensor_gyro.0` and `sensor_accel.0` are
the source `sensor.0`; a FIFO topic holds several samples a message. The autopilot's number `sys_uuid` is the serial.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.logs.loaders.damage import Bytes, mapped, sifted
from selfcal.logs.loaders.table import Hints, Table, of_arrays

Columns = dict[str, NDArray[Any]]
#: Kinds of messages, and bytes of the types of fields.
_KINDS = b"BFIMPQARDLCSO"
_TYPES = {b"float": 4, b"double": 8, b"bool": 1, b"char": 1} | {
    f"{sign}int{bits}_t".encode(): bits // 8 for sign in ("", "u") for bits in (8, 16, 32, 64)
}
#: Topics that are read, and the source that each belongs to.
_SOURCES = {
    "sensor_gyro_fifo": "sensor_fifo",
    "sensor_accel_fifo": "sensor_fifo",
    "sensor_gyro": "sensor",
    "sensor_accel": "sensor",
    "vehicle_imu": "vehicle_imu",
    "sensor_combined": "sensor_combined",
}


def read(path: Path, _: Hints) -> list[Table]:
    """The tables of a ULog file. Raises UserError and what pyulog raises."""
    from pyulog import ULog

    with mapped(path) as data:
        # A header of 16 bytes goes before the first message.
        damaged, sound = sifted(data, 16, _ends(data))
    with path.open("rb") if sound is None else BytesIO(sound) as stream:
        log = ULog(stream, [*_SOURCES, "sensor_selection"])
    topics_of: dict[tuple[str, int], dict[str, Mapping[str, NDArray[Any]]]] = {}
    order = list(_SOURCES)
    known = [topic for topic in log.data_list if topic.name in _SOURCES]
    for topic in sorted(known, key=lambda topic: order.index(topic.name)):
        topics_of.setdefault((_SOURCES[topic.name], topic.multi_id), {})[topic.name] = topic.data
    if not topics_of:
        raise UserError(f"{path}: no topic {', '.join(_SOURCES)}")
    lost = [dropout.duration for dropout in log.dropouts]
    notes = (f"the logger dropped out {len(lost)} times, {sum(lost) / 1000:.3g} s together",) if lost else ()
    serial = log.msg_info_dict.get("sys_uuid", "")
    meta = {"serial": serial} if isinstance(serial, str) and serial else {}
    tables = []
    for (source, instance), topics in topics_of.items():
        name = source if source == "sensor_combined" else f"{source}.{instance}"
        tables += [of_arrays(name, _columns(topic, data), meta, notes, damaged) for topic, data in topics.items()]
    return tables


def _ends(data: Bytes) -> Callable[[int], int]:
    """Where the message at a place ends. pyulog takes a message of any kind and length, and skips the data after it.

    A message is its length, its kind, and that many bytes. A message of a topic (D) begins with the number of a
    subscription (A), and has the fields of a format (F). Source: PX4's description of ULog."""
    formats: dict[bytes, bytes] = {}
    lengths: dict[bytes, tuple[int, int]] = {}

    def end_of(begin: int) -> int:
        length, kind, end = int.from_bytes(data[begin : begin + 2], "little"), data[begin + 2 : begin + 3], 0
        if kind and kind in _KINDS and 0 < length <= len(data) - begin - 3:
            end = begin + 3 + length
        if end and kind == b"D":
            return end if length in lengths.get(data[begin + 3 : begin + 5], ()) else 0
        if end and kind == b"F":
            name, _, fields = data[begin + 3 : end].partition(b":")
            formats[name] = fields
        elif end and kind == b"A":
            lengths[data[begin + 4 : begin + 6]] = _lengths(data[begin + 6 : end], formats, {})
        return end

    return end_of


def _lengths(name: bytes, formats: Mapping[bytes, bytes], known: dict[bytes, tuple[int, int]]) -> tuple[int, int]:
    """Bytes of a topic's message with its number: without the padding at its end, and with it."""
    if name in known:
        return known[name]
    known[name] = 0, 0  # a format that has itself
    bare = whole = 2
    for part in formats.get(name, b"").rstrip(b";").split(b";"):
        kind, _, label = part.strip().partition(b" ")
        kind, _, count = kind.partition(b"[")
        size = _TYPES[kind] if kind in _TYPES else _lengths(kind, formats, known)[1] - 2
        whole += size * (int(count[:-1]) if count[:-1].isdigit() else 1)
        bare = bare if label.startswith(b"_padding") else whole
    known[name] = bare, whole
    return known[name]


def _columns(topic: str, data: Mapping[str, NDArray[Any]]) -> Columns:
    """Columns of a topic."""
    stamps = data["timestamp_sample"] if np.any(data.get("timestamp_sample", 0)) else data["timestamp"]
    if topic.endswith("_fifo"):
        return _fifo(topic, data, stamps)
    columns: Columns = {"t[us]": stamps}
    match topic:
        case "sensor_gyro":
            columns |= _triad("g", [data[axis] for axis in "xyz"])
        case "sensor_accel":
            columns |= _triad("a", [data[axis] for axis in "xyz"])
        case "sensor_combined":
            columns |= _triad("g", [data[f"gyro_rad[{k}]"] for k in range(3)])
            columns |= _triad("a", [data[f"accelerometer_m_s2[{k}]"] for k in range(3)])
        case _:
            columns |= _triad("g", [_rate(data, "delta_angle", k) for k in range(3)])
            columns |= _triad("a", [_rate(data, "delta_velocity", k) for k in range(3)])
    if "temperature" in data and np.isfinite(data["temperature"]).any():
        columns["temp[degC]"] = data["temperature"]
    return columns


def _triad(letter: str, values: Sequence[NDArray[Any]]) -> Columns:
    unit = {"g": "rad/s", "a": "m/s^2"}[letter]
    return {f"{letter}{axis}[{unit}]": column for axis, column in zip("xyz", values, strict=True)}


def _rate(data: Mapping[str, NDArray[Any]], name: str, k: int) -> Array:
    """An increment over the interval that it was summed over, us; NaN for an interval of 0."""
    interval = np.asarray(data[f"{name}_dt"], np.float64) * 1e-6
    increment = np.asarray(data[f"{name}[{k}]"], np.float64)
    return np.asarray(np.where(interval > 0.0, increment / np.where(interval > 0.0, interval, 1.0), np.nan))


def _fifo(topic: str, data: Mapping[str, NDArray[Any]], stamps: NDArray[Any]) -> Columns:
    """The samples of a FIFO's messages: each message has `samples` of them, the last at its stamp, `dt` us apart."""
    depth = 1 + max(int(key[2:-1]) for key in data if key.startswith("x["))
    turn = np.arange(depth)
    count = np.asarray(data["samples"], np.int64)[:, None]
    used = turn < count
    time = stamps[:, None].astype(np.float64) - (count - 1 - turn) * np.asarray(data["dt"], np.float64)[:, None]
    columns: Columns = {"t[us]": time[used]}
    scale = np.asarray(data["scale"], np.float64)[:, None]
    counts = [np.stack([data[f"{axis}[{k}]"] for k in range(depth)], axis=1) for axis in "xyz"]
    return columns | _triad("g" if "gyro" in topic else "a", [(column * scale)[used] for column in counts])
