"""Logs in the forms of other programs, of one drawn record, for `test_cases_logs.py`.

A writer is `write_*(drawn, folder)`; it gives the path of its log. Where a format's library writes, it writes here.
"""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Numbers of a gyro, rad/s, and of an accelerometer, m/s^2: N, K, and the effect of a degree.
N, K, PER_DEG = 2e-4, 1e-5, 2e-4
N_A, K_A = 2e-3, 1e-4


@dataclass
class Drawn:
    """A record at rest of six axes and a temperature: `gyro` [n, 3] rad/s, `accel` [n, 3] m/s^2, `t` s from 0.

    White noise N and a random walk K; the temperature, by a cycle of 10 degrees, acts on gx by PER_DEG.
    """

    rate: float = 100.0
    seconds: float = 1200.0
    seed: int = 1
    gyro: Array = field(init=False)
    accel: Array = field(init=False)
    temp: Array = field(init=False)
    t: Array = field(init=False)

    def __post_init__(self) -> None:
        random = np.random.default_rng([44, self.seed])
        n = round(self.rate * self.seconds)
        self.t = np.arange(n) / self.rate
        self.temp = 30.0 + 5.0 * np.sin(2.0 * np.pi * self.t / 300.0)

        def drawn(white: float, walk: float) -> Array:
            steps = walk / np.sqrt(self.rate) * random.standard_normal((n, 3))
            return white * np.sqrt(self.rate) * random.standard_normal((n, 3)) + steps.cumsum(axis=0)

        self.gyro = drawn(N, K) + np.array([0.01, -0.004, 0.002])
        self.accel = drawn(N_A, K_A) + np.array([0.1, -0.2, 9.81])
        self.gyro[:, 0] += PER_DEG * (self.temp - 30.0)

    @property
    def ns(self) -> NDArray[np.int64]:
        """Stamps of the samples since 1970, ns."""
        return 1_700_000_000_000_000_000 + np.rint(self.t * 1e9).astype(np.int64)

    @property
    def us(self) -> NDArray[np.int64]:
        """Stamps since the part was switched on, us."""
        return 5_000_000 + np.rint(self.t * 1e6).astype(np.int64)

    def received(self) -> NDArray[np.int64]:
        """When the messages reached a logger, ns: late, by a varying time, and by a clock of its own rate."""
        late = np.random.default_rng(9).exponential(3e6, self.t.size)
        return self.ns[0] + 40_000_000 + np.sort((1.003 * (self.ns - self.ns[0]) + late).astype(np.int64))


# ----------------------------------------------------------------------------------------------------------------- text


def _csv(path: Path, header: str, rows: list[list[str]], separator: str = ",") -> Path:
    text = "\n".join(separator.join(row) for row in zip(*rows, strict=True))
    path.write_text(f"{header}\n{text}\n", encoding="utf-8")
    return path


def _cells(values: Array, digits: int = 9) -> list[list[str]]:
    return [[f"{value:.{digits}g}" for value in column] for column in values.T]


def _ints(values: NDArray[np.int64]) -> list[str]:
    return list(map(str, values.tolist()))


def write_euroc(d: Drawn, folder: Path) -> Path:
    header = "#timestamp [ns]," + ",".join(
        [f"w_RS_S_{a} [rad s^-1]" for a in "xyz"] + [f"a_RS_S_{a} [m s^-2]" for a in "xyz"]
    )
    return _csv(folder / "data.csv", header, [_ints(d.ns), *_cells(d.gyro), *_cells(d.accel)])


def write_ulog2csv(d: Drawn, folder: Path) -> Path:
    header = "timestamp," + ",".join([f"gyro_rad[{k}]" for k in range(3)]) + ",gyro_integral_dt,"
    header += ",".join([f"accelerometer_m_s2[{k}]" for k in range(3)])
    rows = [_ints(d.us), *_cells(d.gyro), ["5000"] * d.t.size, *_cells(d.accel)]
    return _csv(folder / "log_sensor_combined_0.csv", header, rows)


def write_ulog2csv_gyro(d: Drawn, folder: Path) -> Path:
    """Stamps of the message are late."""
    header = "timestamp,timestamp_sample,device_id,x,y,z,temperature,error_count"
    late = d.us + np.random.default_rng(3).integers(100, 4000, d.t.size)
    rows = [_ints(late), _ints(d.us), ["2818058"] * d.t.size, *_cells(d.gyro), *_cells(d.temp[:, None], 6)]
    return _csv(folder / "log_sensor_gyro_0.csv", header, [*rows, ["0"] * d.t.size])


def write_rostopic(d: Drawn, folder: Path) -> Path:
    names = ["orientation.x", "orientation.y", "orientation.z", "orientation.w"]
    names += [f"orientation_covariance{k}" for k in range(9)]
    fields = ["header.seq", "header.stamp", "header.frame_id", *names]
    fields += [f"angular_velocity.{a}" for a in "xyz"] + [f"angular_velocity_covariance{k}" for k in range(9)]
    fields += [f"linear_acceleration.{a}" for a in "xyz"] + [f"linear_acceleration_covariance{k}" for k in range(9)]
    header = "%time," + ",".join(f"field.{one}" for one in fields)
    n = d.t.size
    rows = [_ints(d.received()), _ints(np.arange(n)), _ints(d.ns), ["imu_link"] * n, *([["0.0"] * n] * 13)]
    rows += [*_cells(d.gyro), *([["0.0"] * n] * 9), *_cells(d.accel), *([["0.0"] * n] * 9)]
    return _csv(folder / "imu.csv", header, rows)


def write_plotjuggler(d: Drawn, folder: Path) -> Path:
    """Joined by the time of receipt; a slower topic leaves its cells empty."""
    names = [f"/imu/data/angular_velocity/{a}" for a in "xyz"]
    names += ["/imu/data/header/stamp"] + [f"/imu/data/linear_acceleration/{a}" for a in "xyz"]
    names += ["/imu/temperature/temperature"]
    stamp = [f"{one // 10**9}.{one % 10**9:09d}" for one in d.ns.tolist()]
    temp = [f"{value:.6g}" if k % 10 == 0 else "" for k, value in enumerate(d.temp)]
    time = [f"{one / 1e9:.6f}" for one in d.received().tolist()]
    rows = [time, *_cells(d.gyro), stamp, *_cells(d.accel), temp]
    return _csv(folder / "plot.csv", ",".join(["__time", *names]), rows)


def write_xsens(d: Drawn, folder: Path, first: int = 123456) -> Path:
    """The clock counts 100 us, modulo 2^32, from `first` on."""
    names = [
        "PacketCounter",
        "SampleTimeFine",
        *(f"Acc_{a}" for a in "XYZ"),
        *(f"Gyr_{a}" for a in "XYZ"),
        "Temperature",
    ]
    ticks = (first + np.rint(d.t * 1e4).astype(np.int64)) % 2**32
    rows = [
        _ints(np.arange(d.t.size) % 65536),
        _ints(ticks),
        *_cells(d.accel),
        *_cells(d.gyro),
        *_cells(d.temp[:, None]),
    ]
    comments = "// General information:\n//  MT Manager version: 2022.0\n// Update Rate: 100.0Hz\n"
    return _csv(folder / "MT_0380-000.txt", comments + "\t".join(names), rows, "\t")


def write_blackbox_csv(d: Drawn, folder: Path) -> Path:
    """`blackbox_decode --unit-rotation deg/s`, which pads headings with a blank."""
    names = ["loopIteration", "time (us)", *(f"gyroADC[{k}] (deg/s)" for k in range(3)), "motor[0]"]
    rows = [_ints(np.arange(d.t.size) * 8), _ints(d.us), *_cells(np.degrees(d.gyro)), ["1000"] * d.t.size]
    return _csv(folder / "LOG00001.01.csv", ", ".join(names), rows)


def write_phyphox(d: Drawn, folder: Path) -> Path:
    """Two sheets, the accelerometer slower, and what the app says of itself."""
    path = folder / "phyphox.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, label, unit, values, step in (
            ("Gyroscope", "Gyroscope {}", "rad/s", d.gyro, 1),
            ("Accelerometer", "Acceleration {}", "m/s^2", d.accel, 2),
        ):
            header = ",".join([f'"{one}"' for one in ["Time (s)", *(f"{label.format(a)} ({unit})" for a in "xyz")]])
            _csv(folder / "sheet.csv", header, [[f"{t:.9E}" for t in d.t[::step]], *_cells(values[::step])])
            archive.write(folder / "sheet.csv", f"{name}.csv")
        archive.writestr("meta/device.csv", '"property","value"\n"deviceModel","A phone"\n')
        archive.writestr("meta/time.csv", '"event","experiment time"\n"START",0.0\n')
    (folder / "sheet.csv").unlink()
    return path


def write_sensor_logger(d: Drawn, folder: Path) -> Path:
    path = folder / "2024-01-01.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in (("Gyroscope", d.gyro), ("TotalAcceleration", d.accel), ("Accelerometer", 0.01 * d.accel)):
            rows = [_ints(d.ns), _cells(d.t[:, None])[0], *_cells(values[:, ::-1])]
            _csv(folder / "sheet.csv", "time,seconds_elapsed,z,y,x", rows)
            archive.write(folder / "sheet.csv", f"{name}.csv")
        archive.writestr("Metadata.csv", "version,device name\n3,a phone\n")
        archive.writestr("Annotation.csv", "time,seconds_elapsed,text\n")
    (folder / "sheet.csv").unlink()
    return path


# ------------------------------------------------------------------------------------------------------------------ ROS


def _imu_messages(store: Any, d: Drawn, gyro: Array, accel: Array) -> Iterator[Any]:
    types = store.types
    Imu, Header, Time = (
        types[name] for name in ("sensor_msgs/msg/Imu", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    Vector, Quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    cov = np.zeros(9)
    first = {"seq": 0} if "seq" in Header.__dataclass_fields__ else {}
    for ns, g, a in zip(d.ns.tolist(), gyro.tolist(), accel.tolist(), strict=True):
        header = Header(**first, stamp=Time(sec=ns // 10**9, nanosec=ns % 10**9), frame_id="imu_link")
        yield Imu(header, Quaternion(0.0, 0.0, 0.0, 1.0), cov, Vector(*g), cov, Vector(*a), cov)


def _temperatures(store: Any, d: Drawn, every: int) -> Iterator[tuple[int, Any]]:
    types = store.types
    Temperature, Header, Time = (
        types[name] for name in ("sensor_msgs/msg/Temperature", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    first = {"seq": 0} if "seq" in Header.__dataclass_fields__ else {}
    stamps = d.ns.tolist()
    for k in range(0, d.t.size, every):
        ns = stamps[k]
        header = Header(**first, stamp=Time(sec=ns // 10**9, nanosec=ns % 10**9), frame_id="imu_link")
        yield k, Temperature(header, float(d.temp[k]), 0.0)


def _bag(
    bag: Any, store: Any, serialize: Callable[[Any, str], Any], d: Drawn, topics: dict[str, tuple[Array, Array]]
) -> None:
    """Topics of Imu, gyro and accelerometer each, and the temperature at a tenth of the rate."""
    received = d.received().tolist()
    kind = "sensor_msgs/msg/Imu"
    opened = {name: bag.add_connection(name, kind, typestore=store) for name in topics}
    temperature = bag.add_connection("/imu/temperature", "sensor_msgs/msg/Temperature", typestore=store)
    streams = {name: _imu_messages(store, d, *values) for name, values in topics.items()}
    late = dict(_temperatures(store, d, 10))
    for k, when in enumerate(received):
        for name, stream in streams.items():
            bag.write(opened[name], when, serialize(next(stream), kind))
        if k in late:
            bag.write(temperature, when, serialize(late[k], "sensor_msgs/msg/Temperature"))


def write_ros1(d: Drawn, folder: Path, topics: dict[str, tuple[Array, Array]] | None = None) -> Path:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    path = folder / "imu.bag"
    bag = Writer(path)
    bag.set_compression(Writer.CompressionFormat.LZ4)
    with bag:
        _bag(bag, store, store.serialize_ros1, d, topics or {"/imu/data": (d.gyro, d.accel)})
    return path


def write_ros2(
    d: Drawn, folder: Path, topics: dict[str, tuple[Array, Array]] | None = None, mcap: bool = False
) -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    path = folder / ("ros2_mcap" if mcap else "ros2")
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as bag:
        _bag(bag, store, store.serialize_cdr, d, topics or {"/imu/data": (d.gyro, d.accel)})
    return path


def write_db3(d: Drawn, folder: Path) -> Path:
    (found,) = write_ros2(d, folder).glob("*.db3")
    return found


def write_realsense(d: Drawn, folder: Path) -> Path:
    """Gyro and accelerometer apart, the other's values 0."""
    none = np.zeros_like(d.gyro)
    return write_ros1(d, folder, {"/camera/gyro/sample": (d.gyro, none), "/camera/accel/sample": (none, d.accel)})


# ----------------------------------------------------------------------------------------------------------------- ULog


def ulog_of(
    path: Path, topics: list[tuple[str, int, str, list[tuple[int, tuple[Any, ...]]]]], dropouts: int = 0
) -> Path:
    """A ULog file by PX4's description of the format: topics as (name, instance, fields, [(stamp, values)])."""
    codes = {"uint64_t": "Q", "uint32_t": "I", "float": "f", "uint8_t": "B", "int16_t": "h"}

    def message(kind: str, data: bytes) -> bytes:
        return struct.pack("<HB", len(data), ord(kind)) + data

    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message("B", bytes(40))]
    for name, fields in {name: fields for name, _, fields, _ in topics}.items():
        out.append(message("F", f"{name}:{fields}".encode()))
    layouts = []
    for number, (name, instance, fields, _) in enumerate(topics):
        out.append(message("A", struct.pack("<BH", instance, number) + name.encode()))
        layout = ""
        for part in fields.strip(";").split(";"):
            kind = part.split(" ")[0]
            count = int(kind[kind.index("[") + 1 : -1]) if "[" in kind else 1
            layout += f"{count}{codes[kind.split('[')[0]]}"
        layouts.append(struct.Struct(f"<H{layout}"))
    items = [
        (stamp, message("D", layouts[number].pack(number, stamp, *values)))
        for number, topic in enumerate(topics)
        for stamp, values in topic[3]
    ]
    items.sort(key=lambda one: one[0])
    for _, data in items:
        out.append(data)
    out += [message("O", struct.pack("<H", 40))] * dropouts
    path.write_bytes(b"".join(out))
    return path


GYRO = "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;float temperature;"
ACCEL = GYRO
COMBINED = (
    "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;float[3] accelerometer_m_s2;"
    "uint32_t accelerometer_integral_dt;"
)
VEHICLE_IMU = (
    "uint64_t timestamp;uint64_t timestamp_sample;float[3] delta_angle;float[3] delta_velocity;uint32_t delta_angle_dt;"
    "uint32_t delta_velocity_dt;"
)


def of_sensor(d: Drawn, values: Array, every: int = 1, device: int = 7) -> list[tuple[int, tuple[Any, ...]]]:
    """Messages of sensor_gyro or sensor_accel: written late."""
    us = d.us
    late = us + np.random.default_rng(5).integers(200, 3000, d.t.size).cumsum() % 3000 + 200
    return [
        (int(late[k]), (int(us[k]), device, *values[k].tolist(), float(d.temp[k]))) for k in range(0, d.t.size, every)
    ]


def write_ulog(d: Drawn, folder: Path) -> Path:
    """`sensor_gyro` and `sensor_accel` of one instance."""
    topics = [("sensor_gyro", 0, GYRO, of_sensor(d, d.gyro)), ("sensor_accel", 0, ACCEL, of_sensor(d, d.accel))]
    return ulog_of(folder / "log.ulg", topics)


def write_ulog_default(d: Drawn, folder: Path) -> Path:
    """PX4's default set: `sensor_combined` in full, each sensor at a low rate, and drop-outs."""
    combined = [
        (int(us), (*g, 5000, *a, 5000)) for us, g, a in zip(d.us, d.gyro.tolist(), d.accel.tolist(), strict=True)
    ]
    topics = [("sensor_combined", 0, COMBINED, combined), ("sensor_gyro", 0, GYRO, of_sensor(d, d.gyro, 100))]
    topics.append(("sensor_accel", 0, ACCEL, of_sensor(d, d.accel, 100)))
    return ulog_of(folder / "flight.ulg", topics, dropouts=3)


def write_vehicle_imu(d: Drawn, folder: Path) -> Path:
    dt = 1.0 / d.rate
    messages = [
        (int(us) + 300, (int(us), *(dt * g).tolist(), *(dt * a).tolist(), round(dt * 1e6), round(dt * 1e6)))
        for us, g, a in zip(d.us, d.gyro, d.accel, strict=True)
    ]
    return ulog_of(folder / "vehicle.ulg", [("vehicle_imu", 0, VEHICLE_IMU, messages)])


def write_ulog_rewritten(d: Drawn, folder: Path) -> Path:
    """As pyulog writes it."""
    from pyulog import ULog

    path = folder / "again.ulg"
    ULog(str(write_ulog(d, folder))).write_ulog(str(path))
    return path


# ------------------------------------------------------------------------------------------------------------ ArduPilot


def dataflash_of(path: Path, imus: dict[str, list[tuple[int, int, Any, Any, float]]], with_units: bool = True) -> Path:
    """A DataFlash log by ArduPilot's description of it: rows (stamp, instance, gyro, accel, temperature) by message."""

    def fmt(kind: int, name: str, length: int, codes: str, names: str) -> bytes:
        return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, length, name.encode(), codes.encode(), names.encode())

    names = "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T"
    out = [fmt(128, "FMT", 89, "BBnNZ", "Type,Length,Name,Format,Columns")]
    if with_units:
        out.append(fmt(129, "UNIT", 3 + 73, "QbZ", "TimeUS,Id,Label"))
        out.append(fmt(130, "FMTU", 3 + 41, "QBNN", "TimeUS,FmtType,UnitIds,MultIds"))
        for key, label in (("s", "s"), ("#", "instance"), ("E", "rad/s"), ("o", "m/s/s"), ("O", "degC")):
            out.append(b"\xa3\x95\x81" + struct.pack("<Qb64s", 0, ord(key), label.encode()))
    messages = []
    for number, (name, rows) in enumerate(imus.items()):
        kind = 140 + number
        out.append(fmt(kind, name, 3 + 37, "QBfffffff", names))
        if with_units:
            out.append(b"\xa3\x95\x82" + struct.pack("<QB16s16s", 0, kind, b"s#EEEoooO", b"F-0000000"))
        layout = struct.Struct("<QB7f")
        messages += [
            (us, b"\xa3\x95" + bytes([kind]) + layout.pack(us, instance, *g, *a, temp))
            for us, instance, g, a, temp in rows
        ]
    messages.sort(key=lambda one: one[0])
    path.write_bytes(b"".join([*out, *(data for _, data in messages)]))
    return path


def imu_rows(d: Drawn, instance: int, sign: float = 1.0) -> list[tuple[int, int, Any, Any, float]]:
    rows = zip(d.us.tolist(), (sign * d.gyro).tolist(), (sign * d.accel).tolist(), d.temp.tolist(), strict=True)
    return [(us, instance, g, a, temp) for us, g, a, temp in rows]


def write_dataflash(d: Drawn, folder: Path) -> Path:
    return dataflash_of(folder / "00000042.BIN", {"IMU": imu_rows(d, 0)})


def write_tlog(d: Drawn, folder: Path) -> Path:
    """HIGHRES_IMU, written by pymavlink; a ground station's stamps before each message."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    path = folder / "flight.tlog"
    received = (d.received() // 1000).tolist()
    with path.open("wb") as file:
        for k, (us, g, a) in enumerate(zip(d.us.tolist(), d.gyro.tolist(), d.accel.tolist(), strict=True)):
            message = dialect.MAVLink_highres_imu_message(us, *a, *g, 0, 0, 0, 1013, 0, 0, float(d.temp[k]), 0xFFFF)
            file.write(struct.pack(">Q", received[k]) + message.pack(link))
    return path


# ----------------------------------------------------------------------------------------------------------- Betaflight


def _unsigned(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _signed(value: int) -> bytes:
    return _unsigned((value << 1 ^ value >> 31) & 0xFFFFFFFF)


def _three(values: tuple[int, ...], wide: tuple[tuple[int, ...], ...]) -> bytes:
    """The smallest form of three numbers; `wide`: bits of the forms 0 to 2."""
    for form, bits in enumerate(wide):
        if all(-(1 << b - 1) <= v < 1 << b - 1 for v, b in zip(values, bits, strict=True)):
            if bits == (6, 6, 6):
                return bytes([form << 6 | values[0] & 0x3F, values[1] & 0x3F, values[2] & 0x3F])
            total = -(-(2 + sum(bits)) // 8)
            packed = form
            packed <<= 8 * total - 2 - sum(bits)
            for value, b in zip(values, bits, strict=True):
                packed = packed << b | value & (1 << b) - 1
            return packed.to_bytes(total, "big")
    sizes = [next(n for n in (1, 2, 3, 4) if -(1 << 8 * n - 1) <= v < 1 << 8 * n - 1) for v in values]
    tag = 0xC0 | sum(n - 1 << 2 * k for k, n in enumerate(sizes))
    return bytes([tag]) + b"".join(v.to_bytes(n, "little", signed=True) for v, n in zip(values, sizes, strict=True))


def _four(values: list[int]) -> bytes:
    tag, halves = 0, list[int]()
    for k, value in enumerate(values):
        form = 0 if value == 0 else 1 if -8 <= value < 8 else 2 if -128 <= value < 128 else 3
        tag |= form << 2 * k
        count = (0, 1, 2, 4)[form]
        halves += [value >> 4 * (count - 1 - j) & 0xF for j in range(count)]
    halves += [0] * (len(halves) % 2)
    return bytes([tag]) + bytes(a << 4 | b for a, b in zip(halves[::2], halves[1::2], strict=True))


def blackbox_of(d: Drawn, fine: bool = True, every: int = 32) -> tuple[bytes, NDArray[np.int64], NDArray[np.int64]]:
    """A log by Betaflight's description of the format, with every encoding that it has; counts of both sensors.

    Each 32nd frame stands for itself, others are differences; between them are slow frames and events.
    """
    gyro = np.rint(np.degrees(d.gyro) * (10.0 if fine else 1.0)).astype(np.int64)
    accel = np.rint(d.accel / 9.80665 * 2048).astype(np.int64)
    random = np.random.default_rng(8)
    n = d.t.size
    size = (10.0 ** random.uniform(0.0, 6.0, (n, 1))).astype(np.int64)
    p_terms, f_terms = (random.integers(-size, size + 1, (n, 3)) for _ in range(2))
    command = random.integers(-300, 300, (n, 4)) * random.integers(0, 2, (n, 4))
    volts = random.integers(0, 4000, (n, 3)) * random.integers(0, 2, (n, 3))
    names = ["loopIteration", "time", *(f"axisP[{k}]" for k in range(3)), *(f"axisF[{k}]" for k in range(3))]
    names += [f"rcCommand[{k}]" for k in range(4)] + ["vbatLatest", "amperageLatest", "rssi"]
    names += [f"gyroADC[{k}]" for k in range(3)] + [f"accSmooth[{k}]" for k in range(3)]
    rows = np.column_stack([np.arange(n), d.us, p_terms, f_terms, command, volts, gyro, accel]).tolist()
    i_enc, i_pred = [1, 1, *[0] * 6, *[0] * 4, 3, 0, 1, *[0] * 6], [0] * 21
    i_pred[12] = 9  # the battery, less than its reference
    p_enc = [9, 0, 7, 7, 7, 10, 10, 10, 8, 8, 8, 8, 6, 6, 6, *[0] * 6]
    p_pred = [6, 2, *[1] * 6, *[1] * 4, *[1] * 3, *[3] * 6]
    head = {
        "Product": "Blackbox flight data recorder by Nicholas Sherlock", "Data version": "2", "I interval": str(every),
        "P interval": "1", "Field I name": ",".join(names), "Field I signed": ",".join(["1"] * len(names)),
        "Field I predictor": ",".join(map(str, i_pred)), "Field I encoding": ",".join(map(str, i_enc)),
        "Field P predictor": ",".join(map(str, p_pred)), "Field P encoding": ",".join(map(str, p_enc)),
        "Field S name": "flightModeFlags,stateFlags", "Field S signed": "0,0", "Field S predictor": "0,0",
        "Field S encoding": "1,1", "Firmware type": "Betaflight", "gyro_scale": "0x3f800000", "acc_1G": "2048",
        "vbatref": "4095", "blackbox_high_resolution": str(int(fine)),
    }  # fmt: skip
    out = [f"H {name}:{value}\n".encode() for name, value in head.items()]
    before: list[list[int]] = []
    for k, row in enumerate(rows):
        if k % every == 0:
            frame = [_unsigned(row[0]), _unsigned(row[1]), *map(_signed, row[2:12])]
            frame += [_unsigned(4095 - row[12] & 0x3FFF), _signed(row[13]), _unsigned(row[14]), *map(_signed, row[15:])]
            if k % (4 * every) == 0:
                out.append(b"S" + _unsigned(3) + _unsigned(70))
                out.append(b"E\x00" + _unsigned(row[1]))
            before = [row, row]
            out.append(b"I" + b"".join(frame))
            continue
        last, older = before
        left = [v - w for v, w in zip(row, last, strict=True)]
        near = [v - int((w + x) / 2) for v, w, x in zip(row, last, older, strict=True)]
        volt = left[12:15]
        out.append(
            b"P" + _signed(row[1] - 2 * last[1] + older[1])
            + _three(tuple(left[2:5]), ((2, 2, 2), (4, 4, 4), (6, 6, 6)))
            + _three(tuple(left[5:8]), ((2, 2, 2), (5, 5, 4), (8, 7, 7))) + _four(left[8:12])
            + bytes([sum((v != 0) << k for k, v in enumerate(volt))]) + b"".join(_signed(v) for v in volt if v)
            + b"".join(map(_signed, near[15:]))
        )  # fmt: skip
        before = [row, last]
    out.append(b"E\xffEnd of log\0")
    return b"".join(out), gyro, accel


def write_blackbox(d: Drawn, folder: Path) -> Path:
    path = folder / "btfl_001.bbl"
    path.write_bytes(blackbox_of(d)[0])
    return path


# ----------------------------------------------------------------------------------------------------------------- MCAP


def write_mcap_json(d: Drawn, folder: Path) -> Path:
    """ROS's fields in JSON; the file's own times are those of receipt."""
    from mcap.writer import Writer

    path = folder / "log.mcap"
    received = d.received().tolist()
    stamps = d.ns
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("imu", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/imu", "json", schema)
        for k in range(d.t.size):
            ns = int(stamps[k])
            message = {
                "header": {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}},
                "angular_velocity": dict(zip("xyz", d.gyro[k].tolist(), strict=True)),
                "linear_acceleration": dict(zip("xyz", d.accel[k].tolist(), strict=True)),
            }
            writer.add_message(channel, received[k], json.dumps(message).encode(), received[k])
        writer.finish()
    return path


def write_mcap_units(d: Drawn, folder: Path) -> Path:
    """Plain names in JSON, deg/s and g by the schema, times of publication."""
    from mcap.writer import Writer

    path = folder / "plain.mcap"
    kinds = {**{f"gyro_{a}": "deg/s" for a in "xyz"}, **{f"accel_{a}": "g" for a in "xyz"}, "temperature": "degC"}
    schema_text = {"type": "object", "properties": {name: {"type": "number", "unit": u} for name, u in kinds.items()}}
    rows = np.column_stack([np.degrees(d.gyro), d.accel / 9.80665, d.temp]).tolist()
    stamps = d.ns.tolist()
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("imu", "jsonschema", json.dumps(schema_text).encode())
        channel = writer.register_channel("imu", "json", schema)
        for ns, row in zip(stamps, rows, strict=True):
            writer.add_message(channel, ns, json.dumps(dict(zip(kinds, row, strict=True))).encode(), ns)
        writer.finish()
    return path


def write_mcap_protobuf(d: Drawn, folder: Path) -> Path:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    from mcap_protobuf.writer import Writer

    file = descriptor_pb2.FileDescriptorProto(name="imu.proto", package="imu", syntax="proto3")
    for name, fields in (
        ("Stamp", (("sec", 3, ""), ("nsec", 3, ""))),
        ("Vector", tuple((a, 1, "") for a in "xyz")),
        (
            "Imu",
            (("timestamp", 11, "Stamp"), ("angular_velocity", 11, "Vector"), ("linear_acceleration", 11, "Vector")),
        ),
    ):
        message = file.message_type.add(name=name)
        for number, (label, kind, of) in enumerate(fields, 1):
            message.field.add(name=label, number=number, type=kind, label=1, type_name=f".imu.{of}" if of else None)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    Imu = message_factory.GetMessageClass(pool.FindMessageTypeByName("imu.Imu"))
    path = folder / "proto.mcap"
    received = d.received().tolist()
    stamps = d.ns.tolist()
    with path.open("wb") as stream, Writer(stream) as writer:
        for k, ns in enumerate(stamps):
            one = Imu()
            one.timestamp.sec, one.timestamp.nsec = ns // 10**9, ns % 10**9
            for vector, values in ((one.angular_velocity, d.gyro[k]), (one.linear_acceleration, d.accel[k])):
                vector.x, vector.y, vector.z = values.tolist()
            writer.write_message("/imu", one, received[k], received[k])
    return path


def write_ros2_mcap(d: Drawn, folder: Path) -> Path:
    (found,) = write_ros2(d, folder, mcap=True).glob("*.mcap")
    return found


# ------------------------------------------------------------------------------------------- laboratories and vehicles


def write_hdf5(d: Drawn, folder: Path) -> Path:
    """Matrices with units, compressed; the temperature in a group of its own rate."""
    import h5py

    path = folder / "log.h5"
    with h5py.File(path, "w") as file:
        imu = file.create_group("imu")
        imu.create_dataset("time", data=d.us).attrs["unit"] = "us"
        for name, values, unit in (("gyro", np.degrees(d.gyro), "deg/s"), ("accel", d.accel, "m/s^2")):
            imu.create_dataset(name, data=values, compression="gzip", chunks=True).attrs["unit"] = unit
        slow = file.create_group("env")
        slow.create_dataset("time", data=d.us[::10]).attrs["unit"] = "us"
        slow.create_dataset("temperature", data=d.temp[::10]).attrs["unit"] = "degC"
        file.create_dataset("comment", data="a bench")
    return path


def write_mat73(d: Drawn, folder: Path) -> Path:
    """As MATLAB lays it: a user block, matrices transposed, characters as numbers; units in `meta`."""
    import h5py

    path = folder / "log.mat"
    units = {**{f"g{a}": {"unit": "rad/s"} for a in "xyz"}, **{f"a{a}": {"unit": "m/s^2"} for a in "xyz"}}
    meta = json.dumps({"columns": {**units, "t": {"unit": "s"}, "temp": {"unit": "degC"}}})
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("t", d.t), ("temp", d.temp)):
            file.create_dataset(name, data=values[None, :])
        for letter, values in (("g", d.gyro), ("a", d.accel)):
            for place, axis in enumerate("xyz"):
                file.create_dataset(letter + axis, data=values[None, :, place])
        file.create_dataset("meta", data=np.array([[ord(one)] for one in meta], np.uint16))
    data = bytearray(path.read_bytes())
    data[:128] = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    path.write_bytes(bytes(data))
    return path


def write_parquet(d: Drawn, folder: Path) -> Path:
    import pyarrow as pa
    from pyarrow import parquet

    path = folder / "log.parquet"
    arrays, fields = [pa.array(d.ns, pa.timestamp("ns"))], [pa.field("time", pa.timestamp("ns"))]
    for name, values, unit in (("gyro", d.gyro, "rad/s"), ("accel", d.accel / 9.80665, "g")):
        for place, axis in enumerate("xyz"):
            arrays.append(pa.array(values[:, place]))
            fields.append(pa.field(f"{name}_{axis}", pa.float64(), metadata={"unit": unit}))
    arrays.append(pa.array(d.temp + 273.15))
    fields.append(pa.field("temp", pa.float64(), metadata={"unit": "K"}))
    parquet.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), path, compression="zstd")
    return path


def write_tdms(d: Drawn, folder: Path) -> Path:
    """Waveforms: groups of two rates, units in the channels, no channel of times."""
    from nptdms import ChannelObject, TdmsWriter

    path = folder / "log.tdms"
    with TdmsWriter(path) as writer:
        channels = []
        for name, values, unit in (("Gyro", np.degrees(d.gyro), "deg/s"), ("Acc", d.accel / 9.80665, "g")):
            for place, axis in enumerate("XYZ"):
                properties = {"unit_string": unit, "wf_increment": 1.0 / d.rate, "wf_start_offset": 0.0}
                channels.append(ChannelObject("IMU", f"{name} {axis}", values[:, place], properties))
        warm = {"unit_string": "degC", "wf_increment": 10.0 / d.rate, "wf_start_offset": 0.0}
        writer.write_segment([*channels, ChannelObject("Slow", "Temperature", d.temp[::10].copy(), warm)])
    return path


def write_mf4(d: Drawn, folder: Path) -> Path:
    from asammdf import MDF, Signal

    path = folder / "log.mf4"
    with MDF(version="4.10") as file:
        signals = []
        for name, values, unit in (("Gyro", np.degrees(d.gyro), "deg/s"), ("Acc", d.accel, "m/s^2")):
            signals += [Signal(values[:, k].copy(), d.t, unit=unit, name=f"{name}_{a}") for k, a in enumerate("XYZ")]
        file.append(signals, comment="imu")
        file.append([Signal(d.temp[::10].copy(), d.t[::10].copy(), unit="degC", name="Temperature")], comment="slow")
        file.save(path, overwrite=True, compression=2)
    return path


DBC = """VERSION ""
BU_: IMU
BO_ 256 Rates: 8 IMU
 SG_ Gyro_X : 0|20@1- (0.0001,0) [0|0] "rad/s" Vector__XXX
 SG_ Gyro_Y : 20|20@1- (0.0001,0) [0|0] "rad/s" Vector__XXX
 SG_ Gyro_Z : 40|20@1- (0.0001,0) [0|0] "rad/s" Vector__XXX
BO_ 257 Accelerations: 8 IMU
 SG_ Acc_X : 0|20@1- (0.001,0) [0|0] "m/s^2" Vector__XXX
 SG_ Acc_Y : 20|20@1- (0.001,0) [0|0] "m/s^2" Vector__XXX
 SG_ Acc_Z : 40|20@1- (0.001,0) [0|0] "m/s^2" Vector__XXX
BO_ 512 Status: 2 IMU
 SG_ Temperature : 0|16@1- (0.01,0) [0|0] "degC" Vector__XXX
"""


def write_frames(d: Drawn, folder: Path, suffix: str) -> tuple[Path, Path]:
    """A log of CAN frames by python-can, and its database. The database is written by hand."""
    import can
    import cantools

    dbc = folder / "imu.dbc"
    dbc.write_text(DBC, encoding="utf-8")
    database = cantools.database.load_file(dbc)
    path = folder / f"log{suffix}"
    with can.Logger(path) as log:
        for k, t in enumerate((1_700_000_000.0 + d.t).tolist()):
            parts = [("Rates", "Gyro", d.gyro[k]), ("Accelerations", "Acc", d.accel[k])]
            frames = [(name, {f"{of}_{a}": v for a, v in zip("XYZ", row, strict=True)}) for name, of, row in parts]
            if k % 10 == 0:
                frames.append(("Status", {"Temperature": d.temp[k]}))
            for name, values in frames:
                message = database.get_message_by_name(name)
                data = message.encode(values, strict=False)
                log.on_message_received(
                    can.Message(timestamp=t, arbitration_id=message.frame_id, data=data, is_extended_id=False)
                )
    return path, dbc


#: Writers by format, of logs that open without an option.
WRITERS: dict[str, Callable[[Drawn, Path], Path]] = {
    "euroc": write_euroc,
    "ulog2csv": write_ulog2csv,
    "ulog2csv_gyro": write_ulog2csv_gyro,
    "rostopic": write_rostopic,
    "plotjuggler": write_plotjuggler,
    "xsens": write_xsens,
    "blackbox_csv": write_blackbox_csv,
    "phyphox": write_phyphox,
    "sensor_logger": write_sensor_logger,
    "ros1": write_ros1,
    "ros2": write_ros2,
    "db3": write_db3,
    "realsense": write_realsense,
    "ulog": write_ulog,
    "ulog_default": write_ulog_default,
    "vehicle_imu": write_vehicle_imu,
    "ulog_rewritten": write_ulog_rewritten,
    "blackbox": write_blackbox,
    "dataflash": write_dataflash,
    "tlog": write_tlog,
    "mcap_json": write_mcap_json,
    "mcap_units": write_mcap_units,
    "mcap_protobuf": write_mcap_protobuf,
    "ros2_mcap": write_ros2_mcap,
    "hdf5": write_hdf5,
    "mat73": write_mat73,
    "parquet": write_parquet,
    "tdms": write_tdms,
    "mf4": write_mf4,
}
