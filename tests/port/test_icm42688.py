"""The ICM-42688-P: its model at the pins, and the driver on it, compiled for this machine.

Truth: the data sheet's layout, decoded here by itself, and the readings that the model's source has given, one for each
sample's number. So a reading tells which sample it is of, and samples and gaps can be counted.
"""

from __future__ import annotations

import ctypes
import math
import random
import subprocess
from dataclasses import dataclass, field
from itertools import pairwise

import pytest
from parts import icm42688
from parts.icm42688 import FIFO_DATA, G, Icm42688, Sample

from conftest import ROOT

STATES = ("off", "starting", "running", "failed")
NONE, ABSENT, SET_UP, SELF_TEST, SILENT, NO_DATA, STUCK = range(7)
GYRO_LSB, ACCEL_LSB = 2000.0 / 2**18, 16.0 * G / 2**17  # of 19 and 18 bits, deg/s and m/s^2
MODULUS = 2**15  # sample numbers that gz can tell apart: 125 deg/s, which the self-test has room for

#: Access to the driver's structs.
SHIM = """
#include "icm42688.h"
const sensor_t *shim_sensor(void) { return &icm42688; }
int shim_state(void) { return (int)icm42688.state->condition; }
int shim_fault(void) { return (int)icm42688.state->fault; }
const sensor_counters_t *shim_counters(void) { return &icm42688.state->counters; }
float shim_side(unsigned channel) { return icm42688.side(icm42688.state, channel); }
"""


@dataclass
class Clock:
    time_us: float = 0.0
    random: random.Random = field(default_factory=lambda: random.Random(1))
    violations: list[str] = field(default_factory=list)


class Bus(ctypes.Structure):
    TIME = ctypes.CFUNCTYPE(ctypes.c_uint64)
    TIME_32 = ctypes.CFUNCTYPE(ctypes.c_uint32)
    OPEN = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
    EXCHANGE = ctypes.CFUNCTYPE(
        ctypes.c_bool, ctypes.POINTER(ctypes.c_uint8), ctypes.POINTER(ctypes.c_uint8), ctypes.c_size_t
    )
    RESET = ctypes.CFUNCTYPE(None, ctypes.c_bool)
    _fields_ = (
        ("time_us", TIME), ("time_us32", TIME_32), ("open", OPEN), ("exchange", EXCHANGE), ("begin", EXCHANGE),
        ("reset_line", RESET),
    )  # fmt: skip


class Counters(ctypes.Structure):
    NAMES = ("samples", "stale", "repeated", "alarms", "damaged", "anomalies", "overruns", "faults")
    _fields_ = tuple((name, ctypes.c_uint32) for name in NAMES)


Six = ctypes.c_float * 6


def numbered(k: int) -> Sample:
    """Readings on the part's lattice; gz tells the sample's number."""
    wave = [round(40.0 * math.sin(0.37 * k + axis)) for axis in range(5)]
    gz = k % MODULUS - MODULUS // 2
    return (
        wave[0] * GYRO_LSB, wave[1] * GYRO_LSB, gz * GYRO_LSB,
        wave[2] * ACCEL_LSB, wave[3] * ACCEL_LSB, (8192 + wave[4]) * ACCEL_LSB,
    )  # fmt: skip


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("driver")
    (folder / "shim.c").write_text(SHIM, encoding="utf-8")
    sensors = ROOT / "port" / "sensors"
    sources = (sensors / "sensor.c", sensors / "icm42688.c", folder / "shim.c")
    warnings = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Wdouble-promotion", "-Werror")
    checked = ("-g", "-fsanitize=undefined", "-fno-sanitize-recover=all")
    compiler = ("gcc", "-std=c99", "-O1", *warnings, *checked, "-shared", "-fPIC", f"-I{sensors}")
    subprocess.run([*compiler, *map(str, sources), "-lm", "-o", str(folder / "driver.so")], check=True)
    loaded = ctypes.CDLL(str(folder / "driver.so"))
    loaded.shim_counters.restype = ctypes.POINTER(Counters)
    loaded.shim_sensor.restype = ctypes.c_void_p
    loaded.shim_side.restype = ctypes.c_float
    for name in ("open", "offsets", "read"):
        getattr(loaded, f"sensor_{name}").restype = ctypes.c_bool
    loaded.sensor_open.argtypes = (ctypes.c_void_p, ctypes.POINTER(Bus), ctypes.c_float)
    return loaded


class Product:
    """A main loop around the driver: it comes by every `loop_us` and takes what waits."""

    def __init__(self, library: ctypes.CDLL, rate_hz: float, loop_us: float = 3000.0) -> None:
        self.clock = Clock()
        self.part = Icm42688(self.clock, numbered)
        self.library, self.loop_us = library, loop_us
        self.sensor = ctypes.c_void_p(library.shim_sensor())
        self.bus = Bus(
            Bus.TIME(lambda: int(self.clock.time_us)), Bus.TIME_32(lambda: int(self.clock.time_us) & 0xFFFFFFFF),
            Bus.OPEN(lambda wire: None), Bus.EXCHANGE(self._exchange), Bus.EXCHANGE(), Bus.RESET(),
        )  # fmt: skip
        self.broken = False
        #: Reading and missing samples before it, each.
        self.taken: list[tuple[tuple[float, ...], int]] = []
        self.known = library.sensor_open(self.sensor, ctypes.byref(self.bus), rate_hz)

    def _exchange(self, out: ctypes._Pointer, into: ctypes._Pointer, count: int) -> bool:
        if self.broken:
            return False
        self.part.select(True)
        for i in range(count):
            self.clock.time_us += 1.0  # 8 MHz
            into[i] = self.part.exchange(out[i], 0, 8e6)
        self.part.select(False)
        return True

    def run(self, seconds: float) -> None:
        end = self.clock.time_us + 1e6 * seconds
        reading, missing = Six(), ctypes.c_uint32()
        while self.clock.time_us < end:
            self.library.sensor_poll(self.sensor)
            while self.library.sensor_read(self.sensor, reading, ctypes.byref(missing)):
                self.taken.append((tuple(reading), missing.value))
            self.clock.time_us += self.loop_us

    def until(self, state: str, seconds: float) -> None:
        end = self.clock.time_us + 1e6 * seconds
        while self.state != state:
            assert self.clock.time_us < end, (self.state, self.fault)
            self.run(1e-6)

    @property
    def state(self) -> str:
        return STATES[self.library.shim_state()]

    @property
    def fault(self) -> int:
        return int(self.library.shim_fault())

    @property
    def counters(self) -> Counters:
        return self.library.shim_counters().contents  # type: ignore[no-any-return]

    def numbers(self, offset: float = 0.0) -> list[int]:
        """The number of each sample taken, as its gz has it."""
        return [round((reading[2] - offset) / GYRO_LSB) + MODULUS // 2 for reading, _ in self.taken]

    def assert_counted(self, slack: int = 0) -> None:
        """Between the times of two samples lie as many periods as missing samples, and one, each but for `slack`."""
        numbers = self.numbers()
        at_us = {number: us for number, us, _ in self.part.taken}
        assert len(numbers) > 10
        for before, number, (_, missing) in zip(numbers[:-1], numbers[1:], self.taken[1:], strict=True):
            passed = (at_us[number] - at_us[before]) / self.part.period_us
            assert abs(passed - 1 - missing) <= slack + 1e-3, (before, number, missing)


def registers(part: Icm42688, address: int, count: int = 1) -> list[int]:
    part.select(True)
    part.exchange(0x80 | address)
    found = [part.exchange(0) for _ in range(count)]
    part.select(False)
    return found


def write(part: Icm42688, address: int, *values: int) -> None:
    part.select(True)
    for byte in (address, *values):
        part.exchange(byte)
    part.select(False)


def running(clock: Clock, part: Icm42688, packets: int, mode: int = 0x40) -> None:
    """1 kHz, both on."""
    clock.time_us += 2000.0
    write(part, icm42688.FIFO_CONFIG1, packets)
    write(part, icm42688.FIFO_CONFIG, mode)
    write(part, icm42688.PWR_MGMT0, 0x0F)
    registers(part, icm42688.INT_STATUS)
    clock.time_us += 40_000.0
    registers(part, icm42688.INT_STATUS)
    write(part, icm42688.SIGNAL_PATH_RESET, 2)


# ------------------------------------------------------------------------------------------------------------ the model


def test_registers_lie_in_banks() -> None:
    clock = Clock()
    part = Icm42688(clock, numbered)
    part.select(True)
    assert part.exchange(0x80 | 0x75) == part.exchange(0) == 0xFF  # not yet booted
    clock.time_us += 1001.0
    assert registers(part, 0x75) == [0x47] and registers(part, 0x76) == [0]
    assert registers(part, 0x4F, 2) == [0x06, 0x06]
    write(part, 0x76, 1)
    assert registers(part, 0x5F, 3) == part.codes[:3]
    write(part, 0x5F, 1)
    assert registers(part, 0x5F) == part.codes[:1]  # the factory's
    write(part, 0x76, 0)
    assert registers(part, 0x5F) == [0]
    write(part, 0x4F, 0x65, 0x46)  # two at once
    assert registers(part, 0x4F, 2) == [0x65, 0x46]
    write(part, 0x11, 1)
    assert registers(part, 0x75) == [0xFF]
    clock.time_us += 1001.0
    assert registers(part, 0x4F, 2) == [0x06, 0x06] and registers(part, 0x2D) == [0x10] and registers(part, 0x2D) == [0]
    part.exchange(0, mode=1)
    assert clock.violations == []  # not selected
    part.select(True)
    part.exchange(0x80, mode=1)
    assert clock.violations == ["ICM-42688-P: SPI mode 1"]


@pytest.mark.parametrize(("setting", "size", "header"), [(0x0F, 16, 0x68), (0x1F, 20, 0x78)])
def test_a_packet(setting: int, size: int, header: int) -> None:
    """Each field where the data sheet has it."""
    clock = Clock()
    true: Sample = (123.0, -77.5, 0.25, -9.0, 4.5, 9.8)
    part = Icm42688(clock, lambda k: true)
    part.temperature = 31.5
    write_scale = (0x4F, 0x26, 0x46)  # 1000 deg/s, 4 g: of packets of 16 bytes alone
    clock.time_us += 1001.0
    write(part, *write_scale)
    running(clock, part, setting)
    clock.time_us += 2000.0
    count = registers(part, 0x2E, 2)
    assert count == [0, 2 * size]
    first, second = (registers(part, FIFO_DATA, size) for _ in range(2))
    assert registers(part, FIFO_DATA) == [0xFF] and registers(part, 0x2E, 2) == [0, 0]
    assert first[0] == header
    word = [int.from_bytes(first[at : at + 2], "big", signed=True) for at in range(1, 13, 2)]
    stamp = [int.from_bytes(packet[size - (2 if size == 16 else 5) :][:2], "big") for packet in (first, second)]
    assert 937 <= (stamp[1] - stamp[0]) % 65536 <= 938  # 1 ms in the PLL's unit of 32/30 us
    if size == 16:
        rates, accelerations = [w * 1000.0 / 2**15 for w in word[3:]], [w * 4.0 * G / 2**15 for w in word[:3]]
        assert int.from_bytes([first[13]], "big", signed=True) / 2.07 + 25.0 == pytest.approx(31.5, abs=0.25)
    else:
        low = first[17:20]
        rates = [(16 * w + (b & 15)) * 2000.0 / 2**19 for w, b in zip(word[3:], low, strict=True)]
        accelerations = [(16 * w + (b >> 4)) * 16.0 * G / 2**19 for w, b in zip(word[:3], low, strict=True)]
        temperature = int.from_bytes(first[13:15], "big", signed=True) / 132.48 + 25.0
        assert temperature == pytest.approx(31.5, abs=0.005)
        assert all(b & 0x31 == 0 for b in low)  # 19 and 18 bits
    lsb = (1000.0 / 2**15, 4.0 * G / 2**15) if size == 16 else (GYRO_LSB, ACCEL_LSB)
    assert rates == pytest.approx(true[:3], abs=0.51 * lsb[0])
    assert accelerations == pytest.approx(true[3:], abs=0.51 * lsb[1])


@pytest.mark.parametrize("mode", [0x40, 0x80])
def test_a_full_fifo(mode: int) -> None:
    """102 packets of 20 bytes; the newest stay in a stream, the oldest where it stops."""
    clock = Clock()
    part = Icm42688(clock, numbered)
    running(clock, part, 0x1F, mode)
    before = len(part.taken)
    clock.time_us += 150_000.0
    assert registers(part, 0x2E, 2) == [2040 >> 8, 2040 & 0xFF]
    assert registers(part, 0x2D)[0] & 2
    lost = registers(part, 0x6C, 2)
    made = [index for index, _, _ in part.taken[before:]]
    assert len(made) == 150
    assert lost[0] + 256 * lost[1] == part.lost
    kept = registers(part, FIFO_DATA, 20)
    gz = (kept[11] << 12 | kept[12] << 4 | kept[19] & 15) ^ 0x80000
    number = (gz - 0x80000) // 2 + MODULUS // 2
    assert number == (made[-102] if mode == 0x40 else made[0])


@pytest.mark.parametrize(("setting", "goes_on"), [(0x1F, False), (0x5F, True)])
def test_a_packet_that_is_read_in_parts(setting: int, goes_on: bool) -> None:
    """It begins anew, unless FIFO_RESUME_PARTIAL_RD lets it go on."""
    clock = Clock()
    part = Icm42688(clock, numbered)
    running(clock, part, setting)
    clock.time_us += 1000.0
    part.advance()
    (whole,) = (list(packet) for packet in part.fifo)
    assert registers(part, FIFO_DATA, 7) == whole[:7]
    assert registers(part, FIFO_DATA, 13) == (whole[7:] if goes_on else whole[:13])
    assert registers(part, 0x2E, 2) == [0, 0 if goes_on else 20]


# ----------------------------------------------------------------------------------------------------------- the driver


@pytest.mark.parametrize(
    ("rate", "tick", "error", "loop_us"),
    [
        (1000.0, 32 / 30, 0.0, 3000.0),
        (500.0, 1.0, 0.02, 30_000.0),
        (200.0, 32 / 30, -0.03, 900.0),
        (25.0, 1.0, 0.0, 1e4),
    ],
)
def test_every_sample_arrives(library: ctypes.CDLL, rate: float, tick: float, error: float, loop_us: float) -> None:
    product = Product(library, rate, loop_us)
    product.part.tick_us, product.part.clock_error = tick, error
    product.part.temperature = -12.25
    product.until("running", 1.0)
    product.run(max(1.0, 40.0 / rate))
    product.assert_counted()
    numbers = product.numbers()
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert all(missing == 0 for _, missing in product.taken)
    for number, (reading, _) in zip(numbers, product.taken, strict=True):
        assert reading == pytest.approx(numbered(number), rel=1e-6, abs=1e-9)  # floats of exact integers
    assert library.shim_side(0) == pytest.approx(-12.25, abs=0.5 / 132.48)
    assert product.counters.damaged == product.counters.stale == product.counters.overruns == 0
    assert product.clock.violations == []


def test_a_rate_that_it_has_not(library: ctypes.CDLL) -> None:
    assert not Product(library, 819.2).known


@pytest.mark.parametrize("pause_s", [0.09, 0.13, 0.35, 0.9])
@pytest.mark.parametrize("error", [0.0, 0.01, -0.01])
def test_a_pause_of_the_main_loop(library: ctypes.CDLL, pause_s: float, error: float) -> None:
    """Up to 0.1 s nothing is missing; then what is missing is counted, exactly."""
    product = Product(library, 1000.0)
    product.part.clock_error = error
    product.until("running", 1.0)
    product.run(0.1)  # long enough to learn the period
    product.clock.time_us += 1e6 * pause_s
    product.run(0.2)
    product.assert_counted()
    assert (sum(missing for _, missing in product.taken) > 0) == (pause_s > 0.1)
    assert product.counters.overruns == (pause_s > 0.1)


@pytest.mark.parametrize("pause_s", [2.5, 20.0])
def test_a_long_pause(library: ctypes.CDLL, pause_s: float) -> None:
    """By the processor's clock, so as exact as the sensor's agrees with it: 0.1 % and a sample here."""
    product = Product(library, 1000.0)
    product.part.clock_error = 0.001
    product.until("running", 1.0)
    product.run(0.1)
    product.clock.time_us += 1e6 * pause_s
    product.run(0.1)
    product.assert_counted(slack=math.ceil(0.001 * 1000.0 * pause_s) + 1)


@pytest.mark.parametrize(
    ("change", "fault", "recovers"),
    [
        ({"silent": True}, SILENT, {"silent": False}),
        ({"stale": True}, NO_DATA, {"stale": False}),
        ({"frozen": True}, STUCK, {"frozen": False}),
        ({"dead": True, "floating_high": True}, SILENT, {"dead": False}),
        ({"dead": True, "floating_high": False}, SILENT, {"dead": False}),
    ],
)
def test_a_fault(library: ctypes.CDLL, change: dict[str, bool], fault: int, recovers: dict[str, bool]) -> None:
    """Told within half a second, and none of its packets is delivered as new. After it samples come again, and the gap
    is counted."""
    product = Product(library, 200.0)
    product.until("running", 1.0)
    product.run(0.5)
    for name, value in change.items():
        setattr(product.part, name, value)
    before = len(product.taken)
    product.until("failed", 0.6)
    assert product.fault == fault
    assert len(product.taken) - before <= 32  # what waited, and two repeats
    for name, value in recovers.items():
        setattr(product.part, name, value)
    product.until("running", 25.0)
    product.run(0.5)
    assert product.counters.faults >= 1 and product.state == "running"
    if "frozen" not in change:
        product.assert_counted(slack=2)  # by the processor's clock, across a restart


def test_a_bus_that_fails(library: ctypes.CDLL) -> None:
    product = Product(library, 1000.0)
    product.until("running", 1.0)
    product.run(0.1)
    product.broken = True
    product.until("failed", 0.3)
    assert product.fault == SILENT
    product.run(3.0)
    assert product.state == "starting" or product.fault == ABSENT
    product.broken = False
    product.until("running", 12.0)
    product.run(0.1)
    product.assert_counted(slack=2)


def test_a_start_that_fails(library: ctypes.CDLL) -> None:
    """Another part, one that does not keep a setting, one whose axis does not move, one that moves too far."""
    for change, fault in (
        ({"identity": 0x44}, ABSENT),
        ({"connected": False}, ABSENT),
        ({"writes_fail": {(0, icm42688.TMST_CONFIG)}}, SET_UP),
        ({"writes_fail": {(4, 0x7B)}, "registers": None}, NONE),  # nothing is added: it holds what is written
        ({"response": (90.0, 95.0, 20.0, 4.0, 4.5, 5.0)}, SELF_TEST),
        ({"response": (90.0, 95.0, 100.0, 4.0, 4.5, 9.0)}, SELF_TEST),
        ({"silent": True}, SELF_TEST),
    ):
        product = Product(library, 1000.0)
        for name, value in change.items():
            if value is not None:
                setattr(product.part, name, value)
        product.run(0.95)
        assert product.fault == fault and (product.state == "running") == (fault == NONE), (change, product.fault)
        assert not product.taken or fault == NONE


def test_a_part_without_codes(library: ctypes.CDLL) -> None:
    """60 deg/s and 50 mg to 1200 mg pass."""
    for response, passes in (
        ((61.0, 61.0, 61.0, 0.6, 0.6, 0.6), True),
        ((61.0, 61.0, 55.0, 0.6, 0.6, 0.6), False),
        ((61.0, 61.0, 61.0, 0.6, 0.45, 0.6), False),
        ((61.0, 61.0, 61.0, 0.6, 0.6, 12.0), False),
    ):
        product = Product(library, 1000.0)
        product.part.codes = [0] * 6
        product.part.power_on()
        product.part.response = response
        product.run(0.9)
        assert (product.state == "running") == passes, response


def test_a_reset_that_nobody_asked_for(library: ctypes.CDLL) -> None:
    """Its FIFO is off then: the driver starts it again, with the offsets."""
    product = Product(library, 1000.0)
    product.until("running", 1.0)
    assert library.sensor_offsets(product.sensor, Six(0.5, 0, 0, 0, 0, 0), Six())
    product.run(0.2)
    product.part.power_on()
    product.until("failed", 0.5)
    product.until("running", 2.0)
    product.taken.clear()
    product.run(0.2)
    number, reading = product.numbers()[-1], product.taken[-1][0]
    assert reading[0] == pytest.approx(numbered(number)[0] + 0.5, abs=GYRO_LSB)


def test_offsets(library: ctypes.CDLL) -> None:
    """Each axis by itself, of either sign; the nearest step; none beyond the registers. The time goes on."""
    product = Product(library, 1000.0)
    product.until("running", 1.0)
    product.run(0.1)
    wanted = (1.0, -0.031, 63.96, -0.05, 0.1, -9.7)
    got = Six()
    assert library.sensor_offsets(product.sensor, Six(*wanted), got)
    steps = [1 / 32] * 3 + [0.5e-3 * G] * 3
    for value, want, step in zip(got, wanted, steps, strict=True):
        assert abs(value - want) <= 0.5001 * step and value / step == pytest.approx(round(value / step), abs=1e-3)
    at = len(product.taken)
    product.run(0.1)
    numbers = product.numbers()[:at] + product.numbers(got[2])[at:]
    assert [b - a - 1 for a, b in pairwise(numbers)] == [m for _, m in product.taken[1:]]
    lsbs = [GYRO_LSB] * 3 + [ACCEL_LSB] * 3
    for number, (reading, _) in list(zip(numbers, product.taken, strict=True))[at:]:
        for read, true, value, lsb in zip(reading, numbered(number), got, lsbs, strict=True):
            assert abs(read - true - value) <= 0.51 * lsb
    for axis, beyond in ((0, 64.1), (2, -64.1), (4, 1.03 * G), (1, math.nan)):
        refused = [0.0] * 6
        refused[axis] = beyond
        assert not library.sensor_offsets(product.sensor, Six(*refused), Six())
    product.part.writes_fail = {(4, 0x7A)}
    assert not library.sensor_offsets(product.sensor, Six(0, 0, 1.0, 0, 0, 0), Six())


@pytest.mark.parametrize("at", [(0, 0x80), (0, 0x20), (15, 0x04), (17, 0x10), (18, 0x20), (19, 0x01)])
def test_a_wrong_bit_that_shows(library: ctypes.CDLL, at: tuple[int, int]) -> None:
    """In the header, the timestamp or the unused low bits: this packet alone is missing, and the next ones count it."""
    product = Product(library, 1000.0)
    product.until("running", 1.0)
    product.run(0.1)
    before = len(product.taken)
    product.clock.time_us += 4000.0
    product.part.advance()
    packet = bytearray(product.part.fifo[1])
    packet[at[0]] ^= at[1]
    product.part.fifo[1] = bytes(packet)
    product.run(0.1)
    product.assert_counted()
    assert [missing for _, missing in product.taken[before:]].count(1) == product.counters.damaged == 1
    assert sum(missing for _, missing in product.taken) == 1


def test_a_packet_without_a_sample(library: ctypes.CDLL) -> None:
    """The part's mark for no valid sample, -2^19 on an axis: missing."""
    product = Product(library, 1000.0)
    product.until("running", 1.0)
    product.run(0.1)
    product.clock.time_us += 4000.0
    product.part.advance()
    packet = bytearray(product.part.fifo[2])
    packet[1:3], packet[17] = b"\x80\x00", packet[17] & 0x0F
    product.part.fifo[2] = bytes(packet)
    product.run(0.1)
    product.assert_counted()
    assert sum(missing for _, missing in product.taken) == 1


@pytest.mark.parametrize("seed", [3, 4])
def test_wrong_bits(library: ctypes.CDLL, seed: int) -> None:
    """One byte in 2000 has a wrong bit: 1 % of the packets. The time stays right. A wrong header, timestamp or unused
    bit costs its packet: 31 of 160 bits. There is no checksum, so the others show as a wrong reading."""
    product = Product(library, 500.0)
    product.clock.random.seed(seed)
    product.until("running", 1.0)
    product.run(0.1)
    product.part.flip = 1.0 / 2000.0
    product.run(20.0)
    product.part.flip = 0.0
    product.run(0.1)
    first, last = product.numbers()[0], product.numbers()[-1]
    counted = sum(missing for _, missing in product.taken[1:]) + len(product.taken) - 1
    assert counted == last - first
    # 31 bits' share of the 1 %, which is 19 packets, within five sd; nothing else is lost but two by the FIFO's count
    assert abs(product.counters.damaged - 0.01 * 31 / 160 * 10_000) < 5.0 * math.sqrt(19.0)
    assert len(product.taken) >= last - first - product.counters.damaged - product.counters.stale - 2
