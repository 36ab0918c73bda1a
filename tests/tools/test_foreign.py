"""Texts as other programs write them: names, units, times and lines around the table, on one record of known values."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.logs.recording import load

#: Every log that a test here opens, `convert` writes without loss.
pytestmark = pytest.mark.usefixtures("reads_back")

_RATE, _ROWS, _G = 80.0, 700, units.STANDARD_GRAVITY
_DEG = math.pi / 180.0


@dataclass(frozen=True)
class _Truth:
    """Times [n], s, rates [n, 3], rad/s, and accelerations [n, 3], m/s^2."""

    t: NDArray[np.float64]
    g: NDArray[np.float64]
    a: NDArray[np.float64]


def _truth(seed: int = 5) -> _Truth:
    random = np.random.default_rng(seed)
    a = random.normal((0.4, 9.78, -0.2), 0.03, (_ROWS, 3))
    return _Truth(np.arange(_ROWS) / _RATE, random.normal(0.01, 0.002, (_ROWS, 3)), a)


def _lines(*columns: Sequence[object] | NDArray[np.float64], sign: str = ",") -> str:
    """The rows of columns [n] or [n, 3]: numbers with 9 digits, texts as they are."""
    flat: list[list[object]] = []
    for column in columns:
        array = np.asarray(column) if isinstance(column, np.ndarray) else None
        flat += [list(column)] if array is None or array.ndim == 1 else [list(one) for one in array.T]
    cells = (
        [f"{cell:.9g}" if isinstance(cell, float) else str(cell) for cell in row] for row in zip(*flat, strict=True)
    )
    return "".join(f"{sign.join(row)}\n" for row in cells)


def _moments(t: NDArray[np.float64], form: str) -> list[str]:
    first = datetime(2025, 12, 31, 23, 59, 57, 400_000)
    return [(first + timedelta(seconds=round(float(one), 6))).strftime(form) for one in t]


_FORMS: dict[str, Callable[[_Truth], str]] = {
    "an axis before the sensor, a unit of the sensor's kind": lambda of: (
        "Timestamp [us],X Rate [mdps],Y Rate [mdps],Z Rate [mdps],X Accel [mg],Y Accel [mg],Z Accel [mg]\n"
        + _lines(np.round(of.t * 1e6) + 77, of.g / _DEG * 1e3, of.a / _G * 1e3)
    ),
    "letters": lambda of: (
        "elapsed (s);G_X [dps];G_Y [dps];G_Z [dps];A_X [mg];A_Y [mg];A_Z [mg]\n"
        + _lines(of.t, of.g / _DEG, of.a / _G * 1e3, sign=";").replace(".", ",")
    ),
    "the unit alone": lambda of: (
        "Zeit [s]\tDrehrate X [°/s]\tDrehrate Y [°/s]\tDrehrate Z [°/s]"
        "\tBeschl. x [m/s²]\tBeschl. y [m/s²]\tBeschl. z [m/s²]\n"
        + _lines(of.t + 3.0, of.g / _DEG, of.a, sign="\t")
    ),
    "a g that means g": lambda of: (
        "time_ms,Gx(G),Gy(G),Gz(G),Wx(deg/sec),Wy(deg/sec),Wz(deg/sec)\n" + _lines(of.t * 1e3, of.a / _G, of.g / _DEG)
    ),
    "units in a line of their own": lambda of: (
        "Time,GyroX,GyroY,GyroZ,AccelX,AccelY,AccelZ\n"
        "[sec],[rad/sec],[rad/sec],[rad/sec],[m/sec^2],[m/sec^2],[m/(s^2)]\n"
        + _lines(of.t, of.g, of.a)
    ),
    "units in the cells": lambda of: (
        "Time,Gyro_1 (deg/h),Gyro_2 (deg/h),Gyro_3 (deg/h),Acc_1 (g),Acc_2 (g),Acc_3 (g)\n"
        + _lines([f"{one:.9g} sec" for one in of.t], of.g / _DEG * 3600.0, of.a / _G)
    ),
    "midnight, by a time of day": lambda of: (
        "Date,Time,gyrX_dps,gyrY_dps,gyrZ_dps,accX_mps2,accY_mps2,accZ_mps2\n"
        + _lines(_moments(of.t, "%d.%m.%Y"), _moments(of.t, "%H:%M:%S.%f"), of.g / _DEG, of.a)
    ),
    "a zone after a blank": lambda of: (
        "loggingTime(txt),Stamp_sinceReboot(s),rotX(rad/s),rotY(rad/s),rotZ(rad/s),AccX(G),AccY(G),AccZ(G)\n"
        + _lines(_moments(of.t, "%Y-%m-%d %H:%M:%S +0200"), of.t + 512.25, of.g, of.a / _G)
    ),
    "time since 1970 without a unit": lambda of: (
        ",timestamp,gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s],acc_x [m/s2],acc_y [m/s2],acc_z [m/s2]\n"
        + _lines(range(_ROWS), [1767225600123456 + round(1e6 * one) for one in of.t.tolist()], of.g, of.a)
    ),
    "a serial monitor": lambda of: (
        "23:59:57.398 -> ready\n23:59:57.399 -> gx (dps);gy (dps);gz (dps);ax (g);ay (g);az (g)\n"
        + _lines([f"{one} -> " for one in _moments(of.t, "%H:%M:%S.%f")], of.g / _DEG, of.a / _G, sign=";")
    ).replace(" -> ;", " -> "),
    "the header again": lambda of: (
        (head := "micros,gx (dps),gy (dps),gz (dps),ax (g),ay (g),az (g)\n")
        + _lines(np.round(of.t[:300] * 1e6), of.g[:300] / _DEG, of.a[:300] / _G)
        + head
        + _lines(np.round(of.t[300:] * 1e6), of.g[300:] / _DEG, of.a[300:] / _G)
    ),
    "LabVIEW": lambda of: (
        "LabVIEW Measurement\t\nDecimal_Separator\t,\n***End_of_Header***\t\nX_Value\tgx[deg/s]\tgy[deg/s]\tgz[deg/s]"
        "\tax[g]\tay[g]\taz[g]\tComment\n" + _lines(of.t, of.g / _DEG, of.a / _G, sign="\t").replace(".", ",")
    ),
    "Movella DOT": lambda of: (
        "sep=,\nDeviceTag:,D422CD006C2B\nOutputRate:,80Hz\n\n"
        "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z\n"
        + _lines(range(_ROWS), [int(4294000000 + 12500 * k) % 2**32 for k in range(_ROWS)], of.a, of.g / _DEG)
    ),
    "Xsens MT Manager": lambda of: (
        "// Update Rate: 80.0Hz\nPacketCounter\tSampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z\tGyr_X\tGyr_Y\tGyr_Z\n"
        + _lines(range(_ROWS), [900 + 125 * k for k in range(_ROWS)], of.a, of.g, sign="\t")
    ),
    "MicroStrain, with its units": lambda of: (
        "DATA_START\nGPS TFlags,GPS Week,GPS TOW,"
        "X Accel [g],Y Accel [g],Z Accel [g],X Gyro [rad/s],Y Gyro [rad/s],Z Gyro [rad/s]\n"
        + _lines([7] * _ROWS, [1936] * _ROWS, of.t + 502880.55, of.a / _G, of.g)
    ),
    "Kalibr": lambda of: (
        "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z\n"
        + _lines([1385030208726607500 + round(1e9 * one) for one in of.t.tolist()], of.g, of.a)
    ),
    "Physics Toolbox": lambda of: "time,gFx,gFy,gFz,wx,wy,wz\n" + _lines(of.t, of.a / _G, of.g),
    "Shimmer": lambda of: (
        '"sep=\t"\nS_1_Timestamp_Unix_CAL\tS_1_Accel_LN_X_CAL\tS_1_Accel_LN_Y_CAL\tS_1_Accel_LN_Z_CAL\tS_1_Gyro_X_CAL'
        "\tS_1_Gyro_Y_CAL\tS_1_Gyro_Z_CAL\t\nms\tm/(s^2)\tm/(s^2)\tm/(s^2)\tdeg/s\tdeg/s\tdeg/s\t\n"
        + _lines(of.t * 1e3 + 4e3, of.a, of.g / _DEG, sign="\t").replace("\n", "\t\n")
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", _FORMS.values(), ids=_FORMS)
def test_foreign_texts(tmp_path: Path, form: Callable[[_Truth], str]) -> None:
    """Each text opens without an option: every axis has its values to the digits of the text, and the rate is right."""
    of = _truth()
    path = tmp_path / "log.txt"
    path.write_text(form(of), encoding="utf-8")
    read = load(path)
    assert read.rate_hz == pytest.approx(_RATE, rel=1e-4)
    assert read.samples == _ROWS and not read.missing_before.any()
    for place, letter in enumerate("xyz"):
        # nine digits of a reading, so half a unit of the ninth
        np.testing.assert_allclose(read.in_unit(f"g{letter}", "rad/s"), of.g[:, place], rtol=5e-9)
        np.testing.assert_allclose(read.in_unit(f"a{letter}", "m/s^2"), of.a[:, place], rtol=5e-9)


def test_signs_of_one_byte(tmp_path: Path) -> None:
    """The degree sign of Excel's alphabet is read in a heading; in a row it is damage."""
    of = _truth(6)
    text = "t [s];gx [°/s];gy [°/s];gz [°/s]\n" + _lines(of.t, of.g / _DEG, sign=";")
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode("cp1252"))
    np.testing.assert_allclose(load(path).in_unit("gy", "rad/s"), of.g[:, 1], rtol=5e-9)
    path.write_bytes(text.encode("cp1252").replace(b"\n0.5;", b"\n0.5\xb0;"))
    with pytest.raises(UserError, match="not text"):
        load(path)


def test_sensors_that_take_turns(tmp_path: Path) -> None:
    """Rows of two sensors in one table are never mixed: a line lists them, and each has its own values."""
    one, other = _truth(7), _truth(8)
    rows = [
        row
        for k, of in ((0, one), (1, other))
        for row in zip(
            of.t + 1e-4 * k, _lines(np.round(of.t * 1e6) + 90 * k, [k] * _ROWS, of.g, of.a).split(), strict=True
        )
    ]
    path = tmp_path / "log.csv"
    table = "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ\n" + "".join(f"{row}\n" for _, row in sorted(rows))
    path.write_text(table, encoding="utf-8")
    with pytest.raises(UserError, match=r"several sensors: give --source 'I:0' .* --source 'I:1'"):
        load(path)
    for name, of in (("I:0", one), ("I:1", other)):
        read = load(path, sources=[name])
        assert read.rate_hz == pytest.approx(_RATE, rel=1e-4)
        np.testing.assert_allclose(read.in_unit("gz", "rad/s"), of.g[:, 2], rtol=5e-9)


_LINES = {
    "counts": (
        "millis,ax,ay,az\n0,16000,-12,3\n10,16001,-12,4\n20,16002,-11,3\n",
        r"whole numbers, which may be counts: ax, ay, az; give --unit ax=LSB .* --scale ax=SIZE\[m/s\^2\]",
    ),
    "no headings": (
        "1.5 0.1 0.2 0.3\n1.6 0.1 0.2 0.4\n",
        r"put a line of headings before it, such as t\[s\],gx\[deg/s\]",
    ),
    "a restart": (
        "t[s],gx[deg/s]\n0,1\n0.1,2\n0.2,3\nt[s],gx[deg/s]\n0,1\n0.1,2\n",
        r"line 6: .*time runs backwards, where the header is repeated: .* head -n 4 log.csv > first.csv",
    ),
    "an unknown unit": ("t[s],X Gyro [x8005]\n0,1\n0.1,2\n", r"unknown unit 'x8005' .* --scale 'gx=SIZE\[deg/s\]'"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "expected"), _LINES.values(), ids=_LINES)
def test_next_step(tmp_path: Path, text: str, expected: str) -> None:
    """What cannot be read ends in a line that names the next step."""
    path = tmp_path / "log.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=expected):
        load(path)
