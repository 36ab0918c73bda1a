"""The MPU-6050's driver and the I2C master, compiled for this machine, with models of part and bus (host_sim/parts).

Truth: the readings that the model's source has given, one for each sample's number, so that samples and gaps can be
counted; the register map; and UM10204 for the bus.
"""

from __future__ import annotations

import ctypes
import math
from itertools import pairwise
from typing import Any

import pytest
from drivers import ABSENT, SELF_TEST, SET_UP, SILENT, STUCK, Bytes, Clock, Product, compile_c, compile_driver
from parts.i2c import I2cBus
from parts.icm42688 import G, Sample
from parts.mpu6050 import GYRO_CONFIG, PWR_MGMT_1, Mpu6050

from conftest import ROOT

GYRO_LSB, ACCEL_LSB = 1.0 / 131.0, G / 16384.0
MODULUS = 2**14  # sample numbers that gz can tell apart: 125 deg/s, which the self-test has room for


def numbered(k: int) -> Sample:
    """Readings on the part's lattice; gz tells the sample's number."""
    wave = [round(40.0 * math.sin(0.37 * k + axis)) for axis in range(5)]
    gz = k % MODULUS - MODULUS // 2
    return (
        wave[0] * GYRO_LSB, wave[1] * GYRO_LSB, gz * GYRO_LSB,
        wave[2] * ACCEL_LSB, wave[3] * ACCEL_LSB, (8192 + wave[4]) * ACCEL_LSB,
    )  # fmt: skip


def number_of(sample: tuple[float, ...]) -> int:
    return (round(sample[2] / GYRO_LSB) + MODULUS // 2) % MODULUS


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return compile_driver(tmp_path_factory.mktemp("driver"), "mpu6050")


class Module(Product):
    """Byte by byte: 400 kHz."""

    def __init__(self, library: ctypes.CDLL, rate_hz: float, loop_us: float = 3000.0) -> None:
        super().__init__(library, lambda clock: Mpu6050(clock, numbered), rate_hz, loop_us)

    def transfer(self, address: int, out: Any, written: int, into: Any, wanted: int) -> bool:
        self.clock.time_us += 22.5 * (2 + written + wanted)
        if address != 0x68 or self.broken or not self.part.begin(False):
            return False
        if not all(self.part.put(out[i]) for i in range(written)):
            return False
        if wanted and not self.part.begin(True):
            return False
        for i in range(wanted):
            into[i] = self.part.get()
        return True

    def assert_counted(self, slack: float = 0.0) -> None:
        """Every sample is one of the part's, and two lie as many periods apart as the driver counts."""
        assert self.clock.violations == []
        at_us = {index % MODULUS: us for index, us, _ in self.part.taken}
        for sample, _ in self.taken:
            assert sample == pytest.approx(numbered(number_of(sample)), rel=1e-6, abs=1e-6)
        for (before, _), (after, missing) in pairwise(self.taken):
            passed = (at_us[number_of(after)] - at_us[number_of(before)]) / self.part.period_us
            assert abs(passed - 1 - missing) <= slack + 0.02 * passed, (missing, passed)


@pytest.mark.parametrize("rate_hz", [25.0, 100.0, 200.0])
def test_every_sample_comes(library: ctypes.CDLL, rate_hz: float) -> None:
    module = Module(library, rate_hz)
    module.part.clock_error = 0.008
    module.part.temperature = 31.5
    module.until("running", 1.2)
    module.run(3.0)
    module.assert_counted()
    assert sum(missing for _, missing in module.taken) == 0
    assert len(module.taken) == pytest.approx(3.0 * rate_hz / 1.008, abs=2)
    assert module.library.shim_side(0) == pytest.approx(31.5, abs=1 / 340)
    assert math.isnan(module.library.shim_side(1))


def test_it_has_no_other_rate(library: ctypes.CDLL) -> None:
    assert not Module(library, 400.0).known and not Module(library, 163.84).known


def test_a_late_loop(library: ctypes.CDLL) -> None:
    """73 packets fit: a pause of 0.3 s loses none at 200 Hz, one of 0.9 s is missing in time."""
    module = Module(library, 200.0)
    module.until("running", 1.2)
    module.run(0.2)
    module.clock.time_us += 300_000.0
    module.run(0.3)
    assert sum(missing for _, missing in module.taken) == 0
    module.clock.time_us += 900_000.0
    module.run(0.3)
    module.assert_counted(slack=1.0)
    assert module.counters.overruns == 1 and sum(missing for _, missing in module.taken) > 150


@pytest.mark.parametrize(
    ("fault", "value", "told"),
    [
        ("identity", 0x70, ABSENT), ("dead", True, ABSENT), ("writes_fail", {GYRO_CONFIG}, SELF_TEST),
        ("writes_fail", {PWR_MGMT_1}, SET_UP), ("response", [1.0, 1.0, 0.8, 1.0, 1.0, 1.0], SELF_TEST),
        ("response", [1.0, 1.0, 1.0, 1.0, 0.0, 1.0], SELF_TEST),
    ],
)  # fmt: skip
def test_a_start_that_fails(library: ctypes.CDLL, fault: str, value: Any, told: int) -> None:
    module = Module(library, 100.0)
    good = getattr(module.part, fault)
    setattr(module.part, fault, value)
    module.until("failed", 1.5)
    assert module.fault == told and not module.taken
    setattr(module.part, fault, good)
    module.until("running", 3.0)


def test_a_part_without_codes(library: ctypes.CDLL) -> None:
    module = Module(library, 100.0)
    module.part.codes = [0] * 6
    module.part.power_on()
    module.until("running", 1.5)


@pytest.mark.parametrize(("fault", "told"), [("silent", SILENT), ("dead", SILENT), ("frozen", STUCK)])
def test_a_run_that_fails(library: ctypes.CDLL, fault: str, told: int) -> None:
    module = Module(library, 100.0)
    module.until("running", 1.2)
    module.run(0.5)
    before = len(module.taken)
    setattr(module.part, fault, True)
    module.until("failed", 0.5)
    assert module.fault == told and len(module.taken) - before <= 4
    setattr(module.part, fault, False)
    module.until("running", 12.0)
    module.run(0.5)
    if fault != "frozen":  # its repeats have one number
        module.assert_counted(slack=1.0)


def test_it_has_reset_itself(library: ctypes.CDLL) -> None:
    """Its supply failed for an instant: asleep, registers as delivered."""
    module = Module(library, 100.0)
    module.until("running", 1.2)
    module.run(0.5)
    module.part.power_on()
    module.until("failed", 0.5)
    module.until("running", 2.0)
    module.run(0.5)
    module.assert_counted(slack=1.0)


@pytest.mark.parametrize("refused", [1, 2, 5])
def test_bytes_that_are_refused(library: ctypes.CDLL, refused: int) -> None:
    """A NACK in the middle: the FIFO begins anew where a packet was read in part, and no reading is wrong."""
    module = Module(library, 200.0)
    module.until("running", 1.2)
    for _ in range(40):
        module.run(0.05)
        module.part.refuse = refused
    module.run(0.2)
    module.assert_counted(slack=1.0)
    assert module.counters.faults == 0 and len(module.taken) > 200


# ---------------------------------------------------------------------------------------------------------- the master


class Lines(ctypes.Structure):
    """i2c_lines_t."""

    SET = ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_bool)
    LEVEL = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_int)
    HALF = ctypes.CFUNCTYPE(None)
    TIME = ctypes.CFUNCTYPE(ctypes.c_uint32)
    _fields_ = (("set", SET), ("level", LEVEL), ("half", HALF), ("time_us32", TIME))


class Echo:
    """Eight registers, as most sensors have them."""

    address = 0x53

    def __init__(self) -> None:
        self.memory = list(range(0xA0, 0xA8))
        self.at: int | None = None
        self.refuse_data = False

    def begin(self, reading: bool) -> bool:
        self.at = self.at if reading else None
        return True

    def put(self, byte: int) -> bool:
        if self.at is None:
            self.at = byte
            return True
        self.memory[self.at % 8] = byte
        self.at += 1
        return not self.refuse_data

    def get(self) -> int:
        self.at = (self.at or 0) + 1
        return self.memory[(self.at - 1) % 8]

    def end(self) -> None:
        pass


class Master:
    """port/app/i2c_master.c on the model of the bus."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.clock, self.device = Clock(), Echo()
        self.bus = I2cBus(self.clock, self.device)
        self.lines = Lines(
            Lines.SET(self.bus.drive), Lines.LEVEL(lambda line: self.bus.sda if line else self.bus.scl),
            Lines.HALF(lambda: self.wait(1.3)), Lines.TIME(self.time),
        )  # fmt: skip
        self.call = library.i2c_transfer

    def wait(self, us: float) -> None:
        self.clock.time_us += us

    def time(self) -> int:
        self.wait(0.2)
        return int(self.clock.time_us)

    def transfer(self, address: int, out: bytes, wanted: int = 0) -> bytes | None:
        into = (ctypes.c_uint8 * max(wanted, 1))()
        given = (ctypes.c_uint8 * max(len(out), 1))(*out)
        done = self.call(
            ctypes.byref(self.lines), ctypes.c_uint8(address), ctypes.cast(given, Bytes),
            ctypes.c_size_t(len(out)), ctypes.cast(into, Bytes), ctypes.c_size_t(wanted),
        )  # fmt: skip
        assert self.bus.master == [True, True]
        return bytes(into[:wanted]) if done else None


@pytest.fixture(scope="module")
def master(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    app = ROOT / "port" / "app"
    loaded = compile_c(tmp_path_factory.mktemp("master"), [app / "i2c_master.c"], [app])
    loaded.i2c_transfer.restype = ctypes.c_bool
    return loaded


def test_a_transfer(master: ctypes.CDLL) -> None:
    """Registers are written and read; nothing but an address; not faster than 400 kHz (UM10204, table 10)."""
    on = Master(master)
    assert on.transfer(0x53, b"\x02\x5a\xa5") == b"" and on.device.memory[2:4] == [0x5A, 0xA5]
    assert on.transfer(0x53, b"\x01", 4) == b"\xa1\x5a\xa5\xa4"
    assert on.transfer(0x53, b"", 2) == b"\xa5\xa6"
    assert on.transfer(0x53, b"") == b""
    assert on.transfer(0x52, b"\x01", 4) is None
    assert on.bus.sda and on.bus.scl and on.bus.shortest_us >= 1.3


def test_a_byte_that_is_refused(master: ctypes.CDLL) -> None:
    on = Master(master)
    on.device.refuse_data = True
    assert on.transfer(0x53, b"\x02\x5a\xa5") is None
    assert on.device.memory[2:4] == [0x5A, 0xA3]  # none after the refusal
    on.device.refuse_data = False
    assert on.transfer(0x53, b"\x02", 1) == b"\x5a"


@pytest.mark.parametrize(("us", "whole"), [(50.0, True), (1500.0, True), (2500.0, False)])
def test_a_stretched_clock(master: ctypes.CDLL, us: float, whole: bool) -> None:
    on = Master(master)
    on.bus.stretch_us = us
    begun = on.clock.time_us
    assert (on.transfer(0x53, b"\x04", 2) == b"\xa4\xa5") is whole
    assert on.clock.time_us - begun < 20_000.0
    on.bus.stretch_us = 0.0
    on.wait(5000.0)
    assert on.transfer(0x53, b"\x04", 2) == b"\xa4\xa5"


@pytest.mark.parametrize("clocks", [1, 5, 9, 10, 200])
def test_a_stuck_line(master: ctypes.CDLL, clocks: int) -> None:
    """Up to nine clocks free it, within the call; a line that stays low fails, and does so again."""
    on = Master(master)
    on.bus.held_clocks = clocks
    assert (on.transfer(0x53, b"\x04", 2) == b"\xa4\xa5") is (clocks <= 9)
    assert on.bus.clocks <= 9 or clocks <= 9


def test_a_read_that_was_cut_off(master: ctypes.CDLL) -> None:
    """A reset of the processor in each bit of a byte that the device sends: zeros hold the line."""
    for cut in range(1, 9):
        on = Master(master)
        on.device.memory = [0] * 8
        assert on.transfer(0x53, b"\x00") == b""
        for released in (True, False):  # a start
            on.bus.drive(1, released)
        for bit in (*((0x53 << 1 | 1) >> 7 - i & 1 for i in range(8)), 1):
            on.bus.drive(0, False)
            on.bus.drive(1, bool(bit))
            on.bus.drive(0, True)
        for _ in range(cut):
            on.bus.drive(0, False)
            on.bus.drive(0, True)
        on.bus.release()
        assert not on.bus.sda
        assert on.transfer(0x53, b"\x06", 1) == b"\x00"
