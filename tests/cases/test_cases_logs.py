"""Logs of other programs open as they are: `selfcal identify FILE`, without an option.

Truth: one record, drawn by `logs.py`, that every writer puts into its own form. Formats with a library that writes are
written by it.
"""

from __future__ import annotations

import re
import shlex
import struct
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Sequence
from importlib import import_module, metadata
from pathlib import Path

import logs
import numpy as np
import pytest
from scipy.stats import binom

from selfcal.base.errors import UserError
from selfcal.base.options import parse_pairs
from selfcal.logs.loaders import FORMATS, check_library, child, format_of
from selfcal.logs.loaders.headings import parse_scales
from selfcal.logs.loaders.table import Hints
from selfcal.logs.recording import Recording, load
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify
from selfcal.wire.frame_writer import FrameWriter
from selfcal.wire.frames import open_bus

from conftest import ROOT, case_records, run

#: Every log that a test here opens, `convert` writes without loss.
pytestmark = pytest.mark.usefixtures("reads_back")

#: Interval of the writers' least exact stamps against a clock: the rate is asked for to 1e-4.
RATE = 1e-4
#: Writers whose logs have no accelerometer, and no temperature.
NO_ACCEL = ("ulog2csv_gyro", "blackbox_csv")
COLD = (
    *("euroc", "ulog2csv", "rostopic", "blackbox_csv", "phyphox", "sensor_logger", "vehicle_imu"),
    *("mcap_json", "mcap_protobuf", "blackbox"),
)


#: Sizes of a count, rad/s and m/s^2, of forms that hold whole ones.
COUNTS = {"blackbox": {"g": np.radians(0.1), "a": 9.80665 / 2048}}


@pytest.fixture(scope="module")
def drawn() -> logs.Drawn:
    return logs.Drawn(seconds=8.0, seed=2)


@pytest.fixture(autouse=True)
def quick(forked: None) -> None:
    """No new Python for each file."""


def in_si(recording: Recording, name: str) -> np.ndarray:
    return recording.in_unit(name, "rad/s" if name[0] == "g" else "m/s^2")


@pytest.mark.parametrize("name", logs.WRITERS)
def test_a_log_opens_as_it_is(name: str, drawn: logs.Drawn, tmp_path: Path) -> None:
    """Every reading of every axis, to the digits of the form (float32 at the worst), on a clock of the true rate; the
    temperature to the steps that a slower channel is bridged by."""
    recording = load(logs.WRITERS[name](drawn, tmp_path))
    assert recording.rate_hz == pytest.approx(drawn.rate, rel=RATE)
    assert recording.samples == drawn.t.size
    assert recording.lost == 0
    for letter, truth in (("g", drawn.gyro), ("a", drawn.accel)):
        if letter == "a" and name in NO_ACCEL:
            assert "ax" not in recording.columns
            continue
        for place, axis in enumerate("xyz"):
            one = recording.columns[letter + axis]
            step = round(drawn.rate / recording.clock_of(letter + axis).rate_hz)
            expected = truth[::step, place]
            if name in COUNTS:
                assert np.abs(in_si(recording, letter + axis) - expected).max() <= 0.5001 * COUNTS[name][letter]
                continue
            # Steps of a float32 at 9.81 m/s^2, and nine digits.
            assert in_si(recording, letter + axis) == pytest.approx(expected, rel=3e-7, abs=1e-9), one.name
    assert ("temp" in recording.columns) == (name not in COLD)
    if name not in COLD:
        # A degree takes 9.5 s at its fastest; thinned out a hundred times, the last second is held.
        assert np.abs(recording.in_unit("temp", "degC") - drawn.temp).max() < 0.11


@pytest.mark.parametrize("name", logs.WRITERS)
def test_numbers_of_a_log(name: str, tmp_path: Path) -> None:
    """20 min: N and K of gy within 4.5 sd, a chance of 7e-6, and in as many of six 90 % intervals as a chance of 1e-3
    leaves; the temperature's coefficient of gx within 4 sd. In `make test` N and K of two logs."""
    records = case_records(0, 3)
    if not records and name not in ("ulog", "euroc"):
        pytest.skip("in make cases")
    # Rounding to a count is white noise.
    count = COUNTS.get(name, {"g": 0.0})["g"]
    white = np.sqrt(logs.N**2 + count**2 / 12.0 / 100.0)
    held = dict.fromkeys(("N", "K"), 0)
    for seed in range(max(1, records)):
        folder = tmp_path / str(seed)
        folder.mkdir()
        log = logs.WRITERS[name](logs.Drawn(seed=100 + seed), folder)
        axis = identify(log, axes=("gy",), suspicion=False)["axes"]["gy"]
        for key, truth in (("N", white), ("K", logs.K)):
            found = axis["parameters"]["random_walk"][key]
            size = np.radians(1.0) if found["unit"].startswith("deg") else 1.0
            assert abs(found["median"] * size - truth) < 4.5 * found["sd"] * size
            held[key] += found["q05"] * size <= truth <= found["q95"] * size
    if records:
        assert binom.cdf(sum(held.values()), 2 * records, 0.9) > 1e-3, held
    if records and name not in COLD:
        (finding,) = (
            one
            for one in diagnose(log, axes=("gx",), decimate=1.0)["axes"]["gx"]["findings"]
            if one["cause"] == "temperature"
        )
        found = finding["estimate"]["coefficient"]
        size = np.radians(1.0) if found["unit"].startswith("deg") else 1.0
        assert abs(found["median"] * size - logs.PER_DEG) < 4.0 * found["sd"] * size


@pytest.mark.parametrize("form", ["ros1", "ros2"])
def test_several_imus_are_listed(form: str, drawn: logs.Drawn, tmp_path: Path) -> None:
    """One line with rate and length, and what to type for each; what it says to type works."""
    write = {"ros1": logs.write_ros1, "ros2": logs.write_ros2}[form]
    log = write(drawn, tmp_path, {"/left/imu": (drawn.gyro, drawn.accel), "/right/imu": (-drawn.gyro, drawn.accel)})
    done = run("identify", log)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    for source in ("/left/imu", "/right/imu"):
        assert f"--source '{source}' (gx gy gz ax ay az; 100 Hz, 7.99 s)" in line
    recording = load(log, sources=["/right/imu"])
    assert in_si(recording, "gy") == pytest.approx(-drawn.gyro[:, 1])
    assert ("--source", "/right/imu") in recording.options
    with pytest.raises(UserError, match=r"there is no source '/up/imu'; give --source '/left/imu'"):
        load(log, sources=["/up/imu"])
    with pytest.raises(UserError, match="no axis is in '/imu/temperature'"):
        load(log, sources=["/imu/temperature"])
    with pytest.raises(UserError, match=r"axis '..' is in more than one of the sources"):
        load(log, sources=["/left/imu", "/right/imu"])


def test_instances_of_a_ulog_are_not_mixed(drawn: logs.Drawn, tmp_path: Path) -> None:
    topics = []
    for instance, sign in ((0, 1.0), (1, -1.0)):
        topics.append(("sensor_gyro", instance, logs.GYRO, logs.of_sensor(drawn, sign * drawn.gyro)))
        topics.append(("sensor_accel", instance, logs.ACCEL, logs.of_sensor(drawn, sign * drawn.accel)))
    log = logs.ulog_of(tmp_path / "two.ulg", topics)
    with pytest.raises(UserError, match=r"--source 'sensor.0'.*--source 'sensor.1'"):
        load(log)
    recording = load(log, sources=["sensor.1"])
    for name, truth in (("gx", -drawn.gyro[:, 0]), ("az", -drawn.accel[:, 2])):
        assert in_si(recording, name) == pytest.approx(truth, rel=3e-7)


@pytest.mark.parametrize("with_units", [False, True])
def test_imus_of_a_dataflash_log_are_not_mixed(with_units: bool, drawn: logs.Drawn, tmp_path: Path) -> None:
    """Two instances of one message, each with its own values, in turn; units by FMTU, or the message's own."""
    both = [row for pair in zip(logs.imu_rows(drawn, 0), logs.imu_rows(drawn, 1, -1.0), strict=True) for row in pair]
    log = logs.dataflash_of(tmp_path / "two.bin", {"IMU": both}, with_units)
    with pytest.raises(UserError, match=r"--source 'IMU.0' \(gx gy gz ax ay az; 100 Hz.*--source 'IMU.1'"):
        load(log)
    for name, sign in (("IMU.0", 1.0), ("IMU.1", -1.0)):
        recording = load(log, sources=[name])
        assert recording.samples == drawn.t.size
        for axis, truth in (("gx", drawn.gyro[:, 0]), ("az", drawn.accel[:, 2])):
            assert in_si(recording, axis) == pytest.approx(sign * truth, rel=3e-7)


def test_counts_of_a_tlog(drawn: logs.Drawn, tmp_path: Path) -> None:
    """RAW_IMU is in mrad/s and mg of ArduPilot, in counts of others; two vehicles are two sources."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    def log(vehicles: dict[int, int]) -> Path:
        path = tmp_path / "raw.tlog"
        with path.open("wb") as file:
            for vehicle, autopilot in vehicles.items():
                link = dialect.MAVLink(None, srcSystem=vehicle)
                beat = dialect.MAVLink_heartbeat_message(2, autopilot, 0, 0, 4, 3)
                file.write(bytes(8) + beat.pack(link))
            for k in range(500):
                for vehicle in vehicles:
                    link = dialect.MAVLink(None, srcSystem=vehicle)
                    one = dialect.MAVLink_raw_imu_message(
                        5_000_000 + 10_000 * k, 1, 2, 1000, vehicle + k % 3, 5, 6, 0, 0, 0
                    )
                    file.write(k.to_bytes(8, "big") + one.pack(link))
        return path

    recording = load(log({1: 3}))
    assert recording.columns["gx"].unit == "mrad/s"
    assert recording.columns["az"].values == pytest.approx(1000.0)
    assert recording.columns["az"].unit == "mg"
    with pytest.raises(UserError, match=r"gx.*; give --scale gx=SIZE\[deg/s\] --scale gy="):
        load(log({1: 12}))
    path = log({1: 3, 2: 3})
    with pytest.raises(UserError, match=r"--source 'RAW_IMU@1'.*--source 'RAW_IMU@2'"):
        load(path)
    assert load(path, sources=["RAW_IMU@2"]).columns["gx"].values[:3] == pytest.approx([2.0, 3.0, 4.0])


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".trc", ".log"])
def test_frames_by_a_database(suffix: str, drawn: logs.Drawn, tmp_path: Path) -> None:
    """Signals by their names and units, to half a count; the temperature in a slower message."""
    log, dbc = logs.write_frames(drawn, tmp_path, suffix)
    recording = load(log, dbc=dbc)
    assert recording.rate_hz == pytest.approx(drawn.rate, rel=RATE)
    assert recording.samples == drawn.t.size
    for name, truth, count in (("gy", drawn.gyro[:, 1], 1e-4), ("az", drawn.accel[:, 2], 1e-3)):
        assert np.abs(in_si(recording, name) - truth).max() <= 0.5001 * count
    assert np.abs(recording.columns["temp"].values - drawn.temp).max() < 0.02
    if suffix == ".blf":
        with pytest.raises(UserError, match=r"name the database of its signals with --dbc FILE\.dbc"):
            load(log)
    if suffix != ".blf":
        return
    other = tmp_path / "other.dbc"
    other.write_text(logs.DBC.replace("BO_ 2", "BO_ 3").replace("BO_ 5", "BO_ 6"), encoding="utf-8")
    with pytest.raises(UserError, match="no frame in it is a message of"):
        load(log, dbc=other)


VEHICLE = """VERSION ""
BU_: ECU
BO_ 291 Motion: 8 ECU
 SG_ Yaw_Rate : 0|16@1+ (0.01,-327.68) [0|0] "°/s" Vector__XXX
 SG_ Acc_Y : 16|16@1- (0.002,0) [0|0] "g" Vector__XXX
BO_ 801 Turns: 3 ECU
 SG_ Which M : 0|8@1+ (1,0) [0|0] "" Vector__XXX
 SG_ RollRate m0 : 8|16@1- (0.02,0) [0|0] "°/s" Vector__XXX
 SG_ PitchRate m1 : 8|16@1- (0.02,0) [0|0] "°/s" Vector__XXX
"""


@pytest.mark.usefixtures("forked")
def test_a_vehicle_s_rates_and_multiplexed_messages(tmp_path: Path) -> None:
    """Yaw, roll and pitch are z, x and y; a multiplexer's two signals take turns. Truth: the counts in the frames. A
    column that no message has is refused, and a message shorter than its database says is named."""
    random = np.random.default_rng(14)
    yaw, side, turn = (random.integers(-900, 900, 1000) for _ in range(3))
    dbc, log = tmp_path / "car.dbc", tmp_path / "car.log"
    dbc.write_bytes(VEHICLE.encode("latin-1"))
    lines = []
    for k in range(1000):
        motion = struct.pack("<Hh", int(yaw[k]) + 32768, int(side[k])) + bytes(4)
        lines.append(f"({1000 + k / 25:.6f}) can0 123#{motion.hex().upper()}")
        lines.append(f"({1000.001 + k / 25:.6f}) can0 321#{struct.pack('<Bh', k % 2, int(turn[k])).hex().upper()}")
    log.write_text("\n".join(lines) + "\n", encoding="utf-8")
    recording = load(log, dbc=dbc)
    wanted = {"gz": 0.01 * yaw, "ay": 0.002 * side, "gx": 0.02 * turn[::2], "gy": 0.02 * turn[1::2]}
    assert recording.columns.keys() >= wanted.keys()
    for name, truth in wanted.items():
        assert recording.columns[name].values == pytest.approx(truth, abs=1e-9)
        assert recording.clock_of(name).rate_hz == pytest.approx(truth.size / 40.0, rel=1e-4)
    with pytest.raises(UserError, match="there is no column 'Heave' for --column az=Heave"):
        load(log, dbc=dbc, columns={"az": "Heave"})
    log.write_text("\n".join([*lines, "(1041.000000) can0 321#0001"]) + "\n", encoding="utf-8")
    assert any("left out: frames of Turns" in note for note in load(log, dbc=dbc).notes)


@pytest.mark.parametrize("fine", [False, True])
def test_counts_of_a_blackbox(fine: bool, drawn: logs.Drawn, tmp_path: Path) -> None:
    """Every frame of every encoding, exactly; two armings are two sources. A frame that is damaged costs those up to
    the next that stands for itself, 32 of them."""
    data, gyro, accel = logs.blackbox_of(drawn, fine)
    log = tmp_path / "log.bbl"
    log.write_bytes(data)
    recording = load(log)
    assert recording.columns["gy"].values == pytest.approx(gyro[:, 1] * (0.1 if fine else 1.0), abs=1e-12)
    assert recording.columns["ax"].values == pytest.approx(accel[:, 0] / 2048, abs=1e-12)
    log.write_bytes(data + data)
    with pytest.raises(UserError, match=r"--source 'log 1' .*--source 'log 2'"):
        load(log)
    assert load(log, sources=["log 2"]).samples == drawn.t.size
    middle = len(data) // 2
    log.write_bytes(data[:middle] + b"\xff" * 6 + data[middle + 6 :])
    hurt = load(log)
    assert drawn.t.size - 66 <= hurt.samples < drawn.t.size
    assert hurt.lost == drawn.t.size - hurt.samples


def test_samples_of_a_fifo(drawn: logs.Drawn, tmp_path: Path) -> None:
    """Eight samples a message, the stamp that of the last; counts times `scale`."""
    fields = "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float dt;float scale;uint8_t samples;"
    fields += "".join(f"int16_t[32] {axis};" for axis in "xyz")
    scale, dt = 1e-4, 1e6 / drawn.rate
    counts = np.rint(drawn.gyro / scale).astype(int)
    messages = []
    for k in range(0, drawn.t.size - 7, 8):
        padded = np.zeros((32, 3), int)
        padded[:8] = counts[k : k + 8]
        last = int(drawn.us[k + 7])
        messages.append((last + 150, (last, 7, dt, scale, 8, *padded.T.ravel().tolist())))
    recording = load(logs.ulog_of(tmp_path / "fifo.ulg", [("sensor_gyro_fifo", 0, fields, messages)]))
    assert recording.rate_hz == pytest.approx(drawn.rate, rel=RATE)
    assert in_si(recording, "gz") == pytest.approx(scale * counts[:, 2], rel=1e-6)


def test_a_topic_without_stamps_is_refused(drawn: logs.Drawn, tmp_path: Path) -> None:
    """The bag's own times are when messages came: they are no stamps."""

    class Unstamped(logs.Drawn):
        @property
        def ns(self) -> np.ndarray:
            return np.zeros(self.t.size, np.int64)

    log = logs.write_ros1(Unstamped(seconds=3.0), tmp_path)
    with pytest.raises(UserError, match=r"there is no time column: .*give --rate HZ"):
        load(log)
    assert load(log, rate=100.0).samples == 300


def test_messages_out_of_order_and_a_restart(drawn: logs.Drawn, tmp_path: Path) -> None:
    """Threads write a few messages late: they are put in order. A clock that begins anew is refused in one line."""
    n = drawn.t.size
    late = np.arange(n).reshape(-1, 8)[:, ::-1].ravel()

    class Reordered(logs.Drawn):
        places = late

        @property
        def ns(self) -> np.ndarray:
            return super().ns[self.places]

    log = logs.write_ros1(Reordered(seconds=8.0, seed=2), tmp_path, {"/imu": (drawn.gyro[late], drawn.accel[late])})
    assert in_si(load(log), "gx") == pytest.approx(drawn.gyro[:, 0])
    log.unlink()
    Reordered.places = np.concatenate([np.arange(n // 2), np.arange(n // 2)])
    log = logs.write_ros1(Reordered(seconds=8.0, seed=2), tmp_path)
    with pytest.raises(UserError, match="time runs backwards"):
        load(log)


@pytest.mark.parametrize("form", ["h5", "mat", "csv"])
def test_a_log_without_units(form: str, drawn: logs.Drawn, tmp_path: Path) -> None:
    """One line names every option, by the file's own names. Typed as it is there, with the true units, it works."""
    import h5py
    from scipy.io import savemat

    log = tmp_path / f"plain.{form}"
    gyro, accel = np.degrees(drawn.gyro), drawn.accel
    if form == "h5":
        with h5py.File(log, "w") as file:
            file["time"], file["omega"], file["acc"] = drawn.t, gyro, accel
    elif form == "mat":
        savemat(log, {"time": drawn.t[:, None], "omega": gyro, "acc": accel})
    else:
        columns = np.column_stack([drawn.t, gyro, accel])
        header = ",".join(["time", *(f"{of} {axis}" for of in ("omega", "acc") for axis in "xyz")])
        np.savetxt(log, columns, fmt="%.9g", delimiter=",", header=header, comments="")
    with pytest.raises(UserError) as caught:
        load(log)
    options = shlex.split(str(caught.value).partition("; give ")[2].partition(", or ")[0])
    assert set(options[::2]) == {"--unit"}
    units = parse_pairs("--unit", options[1::2])
    assert set(units) == ({"time", "omega", "acc"} if form != "csv" else set(header.split(",")))
    recording = load(log, units=units)
    assert in_si(recording, "gz") == pytest.approx(drawn.gyro[:, 2], abs=1e-9)
    assert recording.columns["ay"].values == pytest.approx(accel[:, 1], abs=1e-7)


@pytest.mark.parametrize("names", [("gx", "gy", "gz"), ("gyro_x", "gyro_y", "gyro_z")])
def test_counts_without_a_size(names: Sequence[str], drawn: logs.Drawn, tmp_path: Path) -> None:
    """Likewise for counts."""
    counts = np.rint(drawn.gyro / 1e-4)
    log = tmp_path / "counts.csv"
    header = ",".join(["t[s]", *(f"{name}[LSB]" for name in names)])
    np.savetxt(log, np.column_stack([drawn.t, counts]), fmt="%.9g", delimiter=",", header=header, comments="")
    with pytest.raises(UserError) as caught:
        load(log)
    options = shlex.split(str(caught.value).partition("; give ")[2].partition(", or ")[0])
    assert options[::2] == ["--scale"] * 3
    scale = parse_scales([one.replace("SIZE[deg/s]", "1e-4[rad/s]") for one in options[1::2]])
    assert set(scale) == set(names)
    assert in_si(load(log, scale=scale), "gz") == pytest.approx(1e-4 * counts[:, 2])


def test_a_name_in_the_file_is_not_one_of_ours(drawn: logs.Drawn, tmp_path: Path) -> None:
    """`--unit gx` means gx here, not the heading that --column makes gy. A name that is nowhere is refused."""
    log = tmp_path / "log.csv"
    np.savetxt(log, np.column_stack([drawn.t, drawn.gyro]), delimiter=",", header="t[s],gx,p,q", comments="")
    with pytest.raises(UserError, match=r"columns with no unit: gx; give --unit gy="):
        load(log, columns={"gy": "gx"}, units={"gx": "rad/s"})
    with pytest.raises(UserError, match="there is no column 'gyr' for --unit"):
        load(log, units={"gx": "rad/s", "gyr": "rad/s"})


@pytest.mark.parametrize(("every", "late"), [(1, 0.003), (4, 0.0), (4, 0.003)])
def test_a_line_names_every_clock(every: int, late: float, drawn: logs.Drawn, tmp_path: Path) -> None:
    """Of sensors of one rate at other times too: each axis with its own rate, once."""
    log = tmp_path / "phone.zip"
    with zipfile.ZipFile(log, "w") as archive:
        for name, label, unit, values, step, shift in (
            ("Gyroscope", "Gyroscope", "rad/s", drawn.gyro, 1, 0.0),
            ("Accelerometer", "Acceleration", "m/s^2", drawn.accel, every, late),
        ):
            rows = np.column_stack([drawn.t[::step] + shift, values[::step]])
            header = ",".join(["Time (s)", *(f"{label} {axis} ({unit})" for axis in "xyz")])
            text = "".join(",".join(f"{value:.9g}" for value in row) + "\n" for row in rows)
            archive.writestr(f"{name}.csv", f"{header}\n{text}")
    assert load(log).notes == (
        f"columns sampled at different times: gx, gy, gz at {drawn.rate:g} Hz; ax, ay, az at {drawn.rate / every:g} Hz",
    )


def test_the_clock_of_an_xsens_wraps(drawn: logs.Drawn, tmp_path: Path) -> None:
    """It counts 100 us modulo 2^32."""
    log = logs.write_xsens(drawn, tmp_path, 2**32 - round(0.6e4 * drawn.seconds))
    recording = load(log)
    assert recording.rate_hz == pytest.approx(drawn.rate, rel=RATE)
    assert recording.samples == drawn.t.size and not recording.missing_before.any()
    assert recording.notes == ("column 't' wraps 1 time like a 32-bit counter: undone",)


@pytest.mark.parametrize("writer", [logs.write_xsens, logs.write_euroc, logs.write_plotjuggler])
@pytest.mark.parametrize("code", ["utf-16-le", "utf-16-be"])
def test_a_text_in_utf_16(
    writer: Callable[[logs.Drawn, Path], Path], code: str, drawn: logs.Drawn, tmp_path: Path
) -> None:
    """As Windows' shells write it, with its mark: the same recording. Cut within a sign it lacks that line."""
    plain = writer(drawn, tmp_path)
    text = plain.read_text(encoding="utf-8")
    expected = load(plain)
    plain.write_bytes(("\ufeff" + text.replace("\n", "\r\n")).encode(code))
    found = load(plain)
    assert found.rate_hz == expected.rate_hz
    for name, column in expected.columns.items():
        assert np.array_equal(found.columns[name].values, column.values, equal_nan=True)
    plain.write_bytes(plain.read_bytes()[:-7])
    assert load(plain).samples == expected.samples - 1
    plain.write_bytes(text.encode(code))
    with pytest.raises(UserError, match=r"not text \(byte 0x00\); it must be UTF-8, or UTF-16 with its mark"):
        load(plain)


def test_a_driver_that_takes_turns(drawn: logs.Drawn, tmp_path: Path) -> None:
    """One topic with the gyro and the accelerometer in turn, the other's values 0: zeros are no readings."""
    gyro, accel = drawn.gyro.copy(), drawn.accel.copy()
    gyro[1::2], accel[::2] = 0.0, 0.0
    recording = load(logs.write_ros1(drawn, tmp_path, {"/imu": (gyro, accel)}))
    for name, truth in (("gx", gyro[::2, 0]), ("az", accel[1::2, 2])):
        values = in_si(recording, name)
        assert values[np.isfinite(values)] == pytest.approx(truth)


def test_a_library_that_is_absent(drawn: logs.Drawn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line names an extra of this package, for every format whose library is none of its dependencies. Truth: the
    package's metadata."""
    declared = metadata.metadata("selfcal").get_all("Provides-Extra") or []
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    for one in FORMATS:
        if one.library and one.library != "can":
            assert one.extra in declared
            with pytest.raises(
                UserError, match=rf"{one.library} is not installed: .* install 'selfcal\[{one.extra}\]'$"
            ):
                check_library(tmp_path, one)
    with pytest.raises(UserError, match=r"is a ULog file, and pyulog is not installed: .* install 'selfcal\[px4\]'$"):
        load(logs.write_ulog(drawn, tmp_path))
    monkeypatch.setattr("selfcal.logs.framelog.find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"run.mcap: mcap is not installed: .* install 'selfcal\[mcap\]'$"):
        FrameWriter(tmp_path / "run.mcap")
    assert not (tmp_path / "run.mcap").exists()
    monkeypatch.setattr("selfcal.wire.frames.find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"msgpack is not installed: .* install 'selfcal\[multicast\]'$"):
        open_bus("udp_multicast", "239.74.163.2")


def test_the_page_your_log(tmp_path: Path) -> None:
    """Every line of the page runs as printed on such a log. In `make test` one of them runs; each has its log."""
    page = (ROOT / "tools" / "pages" / "logs.md").read_text(encoding="utf-8")
    printed = [shlex.split(one) for one in re.findall(r"`selfcal (identify [^`]*)`", page)]
    short = logs.Drawn(seconds=1200.0 if case_records(0, 1) else 30.0)
    written: dict[str, Path] = {}
    for name, write in logs.WRITERS.items():
        folder = tmp_path / name
        folder.mkdir()
        path = write(short if case_records(0, 1) else logs.Drawn(seconds=0.2), folder)
        written[path.name] = path
    (tmp_path / "can").mkdir()
    path, _ = logs.write_frames(short, tmp_path / "can", ".blf")
    written[path.name] = path
    assert {words[1] for words in printed} <= written.keys()
    for words in printed:
        if not case_records(0, 1) and words[1] not in ("log.blf",):
            continue
        done = run(*words, cwd=written[words[1]].parent)
        assert done.returncode == 0, (words, done.stderr)
        assert "gx" in done.stdout


# -------------------------------------------------------------------------------------------------------------- hostile


def mutated(random: np.random.Generator, whole: bytes) -> bytes:
    """A copy that is cut, has bytes changed, a piece twice or left out, or 0xff in a place."""
    data = bytearray(whole)
    at = int(random.integers(len(data)))
    length = int(random.integers(1, 200))
    match int(random.integers(6)):
        case 0:
            del data[at:]
        case 1:
            for where in random.integers(0, len(data), 1 + int(random.integers(20))):
                data[where] = int(random.integers(256))
        case 2:
            data[at:at] = data[at : at + length]
        case 3:
            del data[at : at + length]
        case 4:
            data[at : at + 8] = b"\xff" * 8
        case _:  # most of what a reader believes is at the begin
            for where in random.integers(0, min(len(data), 400), 3):
                data[where] = int(random.integers(256))
    return bytes(data)


#: Writers of binary logs, one a format and storage.
BINARY = (
    *("ros1", "db3", "ulog", "phyphox", "blackbox", "dataflash", "tlog", "mcap_json", "mcap_protobuf", "ros2_mcap"),
    *("hdf5", "mat73", "parquet", "tdms", "mf4"),
)
#: Logs of frames, by their suffixes.
FRAMES = (".blf", ".asc", ".trc")


@pytest.mark.parametrize("name", (*BINARY, *FRAMES))
def test_mutated_copies_end_in_one_line(name: str, tmp_path: Path) -> None:
    """A recording, or a line that the user can read; in seconds."""
    random = np.random.default_rng([7, len(name)])
    drawn = logs.Drawn(seconds=0.5, seed=3)
    log, dbc = (
        logs.write_frames(drawn, tmp_path, name) if name in FRAMES else (logs.WRITERS[name](drawn, tmp_path), None)
    )
    whole = log.read_bytes()
    one = format_of(log, frames=dbc is not None)
    if one is not None:  # so that each child has the library
        import_module(f"selfcal.logs.loaders.{one.module}").read(log, {} if dbc is None else {"dbc": str(dbc)})
    refused, copies = 0, case_records(10, 1000)
    for _ in range(copies):
        log.write_bytes(mutated(random, whole))
        begun = time.monotonic()
        try:
            load(log, dbc=dbc)
        except UserError as error:
            refused += 1
            assert "\n" not in str(error)
            assert str(log) in str(error)
        assert time.monotonic() - begun < 20.0
    assert refused > 0
    print(f"{name}: {refused} of {copies} refused")


@pytest.mark.parametrize("length", [0, 1, 2, 3, 255])
@pytest.mark.parametrize("place", ["begin", "end"])
def test_a_message_of_no_bytes_ends(length: int, place: str, drawn: logs.Drawn, tmp_path: Path) -> None:
    """A DataFlash message without fields, 3 bytes of head, that states another length: a recording of some of the
    samples or one line, in a small part of the time that a file may take."""
    log = logs.write_dataflash(drawn, tmp_path)
    whole = log.read_bytes()
    fmt = b"\xa3\x95\x80" + bytes([200, length]) + b"NONE".ljust(4 + 16 + 64, b"\0")
    at = whole.index(b"\xa3\x95\x80", 1) if place == "begin" else len(whole)
    log.write_bytes(whole[:at] + fmt + b"\xa3\x95\xc8" + whole[at:])
    begun = time.monotonic()
    try:
        assert 0 < load(log).samples <= drawn.t.size
    except UserError as error:
        assert "\n" not in str(error)
        assert str(log) in str(error)
        assert length != 3  # the one that fits
    assert time.monotonic() - begun < 20.0


@pytest.mark.parametrize(
    ("does", "line"),
    [
        ("while True: pass", "reading it takes more than"),
        ("bytearray(64 << 30)", "too large for this machine's memory"),
        ("import os; os.kill(os.getpid(), 9)", "not a sound ULog file: pyulog fails at it (signal 9)"),
        ("raise ValueError('of no kind')", "of no kind"),
    ],
)
def test_a_reader_is_bounded(does: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "_LEAST_S", 1.0)

    def read(path: Path, hints: Hints) -> list[object]:
        exec(does)
        return []

    monkeypatch.setattr("selfcal.logs.loaders.ulog.read", read)
    log = tmp_path / "log.ulg"
    log.write_bytes(b"ULog\x01\x12\x35")
    with pytest.raises(UserError) as found:
        load(log)
    assert line in str(found.value)


def test_the_child_is_a_process_of_its_own(drawn: logs.Drawn, tmp_path: Path) -> None:
    """The library of a format is not in this process: `identify` of a ULog imports no pyulog."""
    log = logs.write_ulog(drawn, tmp_path)
    code = f"import sys; from selfcal.logs.recording import load; load({str(log)!r}); print('pyulog' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "False"


def test_formats_are_rows() -> None:
    """Suffixes belong to one format, and each format's module reads."""
    suffixes = [suffix for one in FORMATS for suffix in one.suffixes]
    assert len(set(suffixes)) == len(suffixes)
    for one in FORMATS:
        assert callable(import_module(f"selfcal.logs.loaders.{one.module}").read)
        assert one.library or not one.extra
