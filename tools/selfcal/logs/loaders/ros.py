"""ROS 1 bags and ROS 2 bags by rosbags: `sensor_msgs/Imu` and `sensor_msgs/Temperature`, a table a topic.

The stamps are those of the messages' headers, never the times at which the bag got them. Messages of these two types
have the same layout in every ROS. So the definitions in a bag, which rosbags would make code of, are not used.
"""

from __future__ import annotations

import shlex
import struct
from array import array
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from selfcal.base.errors import UserError
from selfcal.base.grid import Array, Rows
from selfcal.logs.loaders.damage import parts_of
from selfcal.logs.loaders.table import Hints, Table, of_arrays

IMU = "sensor_msgs/msg/Imu"
#: Doubles after the header, by type. Of an Imu's: an orientation, angular velocity and acceleration, each with nine
#: covariances after it.
LAYOUTS = {IMU: 37, "sensor_msgs/msg/Temperature": 2}
#: Place of the first axis, and its unit, by the first letter of the axes here.
_AXES = {"g": (13, "rad/s"), "a": (25, "m/s^2")}
_ROS_1 = b"#ROSBAG V2.0"


class Topic:
    """The messages of a topic: stamps, ns, and doubles."""

    def __init__(self, kind: str) -> None:
        """`kind`: a key of LAYOUTS."""
        self.kind, self.stamps, self.values = kind, array("q"), array("d")

    def take(self, data: bytes, *, cdr: bool) -> None:
        """Take a message, in CDR or in ROS 1's form. Raises struct.error and IndexError for a cut message."""
        order = ">" if cdr and not data[1] & 1 else "<"
        seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", data, 4)
        begin = 16 + length
        if cdr:
            begin += -(begin - 4) % 8
        self.values.extend(struct.unpack_from(f"{order}{LAYOUTS[self.kind]}d", data, begin))
        self.stamps.append(seconds * 1_000_000_000 + nanoseconds)

    def table(self, name: str) -> Table:
        """The table of a topic of this name."""
        values = np.array(self.values).reshape(-1, LAYOUTS[self.kind])
        stamps = np.array(self.stamps, np.int64)
        order = np.argsort(stamps, kind="stable")
        # Threads write messages a few places out of the order of their stamps.
        if np.abs(order - np.arange(order.size)).max(initial=0) <= 64:
            stamps, values = stamps[order], values[order]
        notes: tuple[str, ...] = ()
        columns: dict[str, Array | Rows] = {}
        if stamps.any():
            columns["t[ns]"] = stamps
        else:
            notes = (f"{name}: no message has a stamp in its header",)
        if self.kind == IMU:
            columns |= _axes(values)
        else:
            columns["temp[degC]"] = values[:, 0]
        return of_arrays(name, columns, notes=notes)


def _axes(values: Array) -> Mapping[str, Array]:
    """Columns of the axes that an Imu [n, 37] has. A sensor that it has not reads 0 throughout, or has a covariance of
    -1 (REP 145)."""
    triads = {}
    for letter, (first, _) in _AXES.items():
        triad = values[:, first : first + 3]
        if len(values) and triad.any() and values[0, first + 3] != -1.0:
            triads[letter] = triad
    if triads.keys() == _AXES.keys():
        none = (triads["a"] == 0.0).all(axis=1, keepdims=True)  # at rest gravity is among the axes: no reading is 0
        triads["a"] = np.where(none, np.nan, triads["a"])
        # A topic has the gyro and the accelerometer in turn.
        if none.mean() > 0.1:
            triads["g"] = np.where((triads["g"] == 0.0).all(axis=1, keepdims=True), np.nan, triads["g"])
    return {
        f"{letter}{axis}[{_AXES[letter][1]}]": triad[:, k]
        for letter, triad in triads.items()
        for k, axis in enumerate("xyz")
    }


def read(path: Path, _: Hints) -> list[Table]:
    """The tables of a .bag, a .db3, or a ROS 2 folder. Raises UserError and what rosbags raises."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    first = False
    if path.is_file():
        with path.open("rb") as stream:
            first = stream.read(len(_ROS_1)) == _ROS_1
    parts = parts_of(path)
    for part in parts:
        if _has_wal(part):
            step = f"sqlite3 {shlex.quote(str(part))} 'pragma wal_checkpoint(truncate)'"
            raise UserError(f"{path}: messages are in {part.name}-wal, which is not read: bring them in by {step}")
    names = "".join(map(str, parts))
    if not first and set("%?#") & set(names):  # of a URI: rosbags makes a URI of the plain name, and opens another file
        raise UserError(f"{path}: rename it: a ROS 2 bag with '%', '?' or '#' in a name cannot be opened")
    topics: dict[tuple[str, str], Topic] = {}
    with (Reader1 if first else Reader2)(path) as bag:
        kinds = {connection.id: connection.msgtype for connection in bag.connections}
        wanted = [connection for connection in bag.connections if connection.msgtype in LAYOUTS]
        for connection, _received, data in bag.messages(wanted) if wanted else ():
            topic = topics.setdefault((connection.topic, connection.msgtype), Topic(connection.msgtype))
            topic.take(data, cdr=not first)
    if not topics:
        raise no_topic(path, kinds.values())
    return [topic.table(name) for (name, _kind), topic in topics.items()]


def _has_wal(path: Path) -> bool:
    """Whether the newest content of a database is in its -wal. Source: sqlite.org/fileformat2.html, 1.3.3 and 4."""
    log = path.with_name(f"{path.name}-wal")
    # The content follows a head of 32 bytes.
    if not log.is_file() or log.stat().st_size <= 32:
        return False
    with path.open("rb") as stream:
        # Byte 19 of a database is the form that a reader has to know.
        return stream.read(20)[19:] == b"\2"


def no_topic(path: Path, kinds: object) -> UserError:
    """The error for a bag without a topic that is read."""
    there = ", ".join(sorted({str(kind) for kind in kinds})[:6]) or "none"  # type: ignore[attr-defined]
    return UserError(f"{path}: no message of sensor_msgs/Imu or sensor_msgs/Temperature (there are: {there})")
