"""The BMI088's driver, compiled for this machine, with the model of its two chips (host_sim/parts).

Truth: the readings that the model's source has given, one for each sample's number of either chip. So a reading tells
which two samples it is of, and how far apart in time they were.
"""

from __future__ import annotations

import ctypes
import math
from itertools import pairwise
from typing import Any

import pytest
from drivers import ABSENT, SELF_TEST, SET_UP, SILENT, STUCK, Product, compile_driver
from parts.bmi088 import ACC_CONF, GYRO_BANDWIDTH, Bmi088
from parts.icm42688 import G, Sample

GYRO_LSB, ACCEL_LSB = 2000.0 / 32767.0, 24.0 * G / 32768.0
MODULUS = 2**14  # sample numbers that gz and ax can tell apart


def numbered(k: int) -> Sample:
    """gz tells the number of a rate, ax that of an acceleration."""
    wave = [round(40.0 * math.sin(0.37 * k + axis)) for axis in range(4)]
    number = k % MODULUS - MODULUS // 2
    return (
        wave[0] * GYRO_LSB, wave[1] * GYRO_LSB, number * GYRO_LSB,
        number * ACCEL_LSB, wave[2] * ACCEL_LSB, (1365 + wave[3]) * ACCEL_LSB,
    )  # fmt: skip


def numbers_of(sample: tuple[float, ...]) -> tuple[int, int]:
    """Of the rate and of the acceleration."""
    return tuple(
        (round(value / lsb) + MODULUS // 2) % MODULUS for value, lsb in ((sample[2], GYRO_LSB), (sample[3], ACCEL_LSB))
    )  # type: ignore[return-value]


def assert_paired(part: Bmi088, taken: list[tuple[tuple[float, ...], int]], slack: float) -> tuple[int, int]:
    """Every sample is one of both chips, the acceleration up to three and a half periods older. Two lie as many periods
    apart as the driver counts, to `slack` after a break. Returns accelerations left out and taken twice."""
    assert part.machine.violations == []
    rates, accels = ({index % MODULUS: us for index, us, _ in chip.taken} for chip in (part.gyro, part.accel))
    period = part.gyro.period_us
    apart, left_out, twice = [], 0, 0
    for sample, _ in taken:
        rate, accel = numbers_of(sample)
        expected = (*numbered(rate)[:3], *numbered(accel)[3:])
        assert sample == pytest.approx(expected, rel=1e-6, abs=1e-6)
        apart.append((accels[accel] - rates[rate]) / max(period, part.accel.period_us))
    assert min(apart) >= -3.5 and max(apart) <= 1.0
    for (one, _), (other, missing) in pairwise(taken):
        passed = (rates[numbers_of(other)[0]] - rates[numbers_of(one)[0]]) / period
        assert abs(passed - 1 - missing) <= (slack + 0.02 * passed if passed > 1.5 else 0.01), (missing, passed)
        step = numbers_of(other)[1] - numbers_of(one)[1]
        if passed < 1.5:
            left_out += step > math.ceil(period / part.accel.period_us - 0.1)
            twice += step == 0
    return left_out, twice


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return compile_driver(tmp_path_factory.mktemp("driver"), "bmi088")


class Module(Product):
    """By 8 MHz."""

    def __init__(self, library: ctypes.CDLL, rate_hz: float, loop_us: float = 3000.0) -> None:
        self.chip = 0
        super().__init__(library, lambda clock: Bmi088(clock, numbered), rate_hz, loop_us)

    def choose(self, chip: int) -> None:
        self.chip = chip

    def exchange(self, out: Any, into: Any, count: int) -> bool:
        if self.broken:
            return False
        self.part.choose(self.chip, True)
        for i in range(count):
            self.clock.time_us += 1.0
            into[i] = self.part.exchange(out[i], 3, 8e6)
        self.part.choose(self.chip, False)
        self.clock.time_us += 2.0
        return True


@pytest.mark.parametrize("rate_hz", [100.0, 400.0, 1000.0])
@pytest.mark.parametrize("errors", [(0.0, 0.0), (0.01, -0.006), (-0.008, 0.009)])
def test_every_sample_comes(library: ctypes.CDLL, rate_hz: float, errors: tuple[float, float]) -> None:
    """Two clocks: an acceleration is left out or taken twice as often as they drift, and no oftener."""
    module = Module(library, rate_hz)
    module.part.gyro.clock_error, module.part.accel.clock_error = errors
    module.part.accel.temperature = 31.5
    module.until("running", 1.0)
    module.run(4.0)
    left_out, twice = assert_paired(module.part, module.taken, slack=0.0)
    assert sum(missing for _, missing in module.taken) == 0
    assert len(module.taken) == pytest.approx(4.0 * rate_hz / (1.0 + errors[0]), rel=5e-3, abs=4)
    if rate_hz < 1000.0:
        drift = 4.0 * rate_hz * (errors[0] - errors[1])
        assert left_out == pytest.approx(max(drift, 0.0), abs=3) and twice == pytest.approx(max(-drift, 0.0), abs=3)
    assert module.library.shim_side(0) == pytest.approx(31.5, abs=0.07)


def test_it_has_no_other_rate(library: ctypes.CDLL) -> None:
    assert not Module(library, 500.0).known and not Module(library, 163.84).known


@pytest.mark.parametrize("rate_hz", [400.0, 1000.0])
def test_a_late_loop(library: ctypes.CDLL, rate_hz: float) -> None:
    """100 rates fit: a pause of 90 ms loses none at 1 kHz, one of 0.5 s is missing in time."""
    module = Module(library, rate_hz)
    module.until("running", 1.0)
    module.run(0.2)
    module.clock.time_us += 90_000.0
    module.run(0.3)
    assert sum(missing for _, missing in module.taken) == 0
    module.clock.time_us += 500_000.0
    module.run(0.3)
    assert_paired(module.part, module.taken, slack=1.0)
    assert module.counters.overruns == 1 and sum(missing for _, missing in module.taken) > 150


@pytest.mark.parametrize(
    ("chip", "fault", "value", "told"),
    [
        ("accel", "identity", 0x1A, ABSENT), ("gyro", "identity", 0x0E, ABSENT), ("gyro", "dead", True, ABSENT),
        ("accel", "dead", True, ABSENT), ("accel", "writes_fail", {ACC_CONF}, SET_UP),
        ("gyro", "writes_fail", {GYRO_BANDWIDTH}, SET_UP), ("gyro", "test_fails", True, SELF_TEST),
        ("accel", "response", (1.3, 0.8, 0.7), SELF_TEST),
    ],
)  # fmt: skip
def test_a_start_that_fails(library: ctypes.CDLL, chip: str, fault: str, value: Any, told: int) -> None:
    module = Module(library, 400.0)
    of = getattr(module.part, chip)
    good = getattr(of, fault)
    setattr(of, fault, value)
    module.until("failed", 1.0)
    assert module.fault == told and not module.taken
    setattr(of, fault, good)
    module.until("running", 3.0)


@pytest.mark.parametrize(
    ("chips", "fault", "told"),
    [
        ("gyro", "silent", SILENT), ("accel", "silent", SILENT), ("gyro", "dead", SILENT), ("accel", "dead", SILENT),
        ("accel gyro", "frozen", STUCK),
    ],
)  # fmt: skip
def test_a_run_that_fails(library: ctypes.CDLL, chips: str, fault: str, told: int) -> None:
    """Either chip alone: no sample is made of an old reading of the one and new ones of the other."""
    module = Module(library, 400.0)
    module.until("running", 1.0)
    module.run(0.5)
    before = len(module.taken)
    for chip in chips.split():
        setattr(getattr(module.part, chip), fault, True)
    module.until("failed", 0.7)
    assert module.fault == told and len(module.taken) - before <= 12
    for chip in chips.split():
        setattr(getattr(module.part, chip), fault, False)
    module.until("running", 12.0)
    module.run(0.5)
    if fault != "frozen":  # its repeats have one number
        assert_paired(module.part, module.taken[before + 12 :], slack=1.5)


@pytest.mark.parametrize("chip", ["accel", "gyro"])
def test_one_chip_has_reset_itself(library: ctypes.CDLL, chip: str) -> None:
    """Its supply failed for an instant: the accelerometer sleeps, the gyroscope has another rate and no FIFO."""
    module = Module(library, 400.0)
    module.until("running", 1.0)
    module.run(0.5)
    getattr(module.part, chip).power_on()
    module.until("failed", 0.5)
    module.until("running", 2.0)
    before = len(module.taken)
    module.run(0.5)
    assert_paired(module.part, module.taken[before:], slack=1.0)


def test_wrong_bits(library: ctypes.CDLL) -> None:
    """One byte in 1500. No frame has a checksum, so some readings are wrong; the time stays right."""
    module = Module(library, 400.0)
    module.until("running", 1.0)
    module.run(0.2)
    module.part.flip = 1.0 / 1500.0
    module.run(5.0)
    module.part.flip = 0.0
    assert module.part.flipped > 20
    module.run(11.0)
    assert module.state == "running"
    before = len(module.taken)
    module.run(0.5)
    assert_paired(module.part, module.taken[before:], slack=0.0)
    counted = sum(missing for _, missing in module.taken[1:]) + len(module.taken) - 1
    passed = numbers_of(module.taken[-1][0])[0] - numbers_of(module.taken[0][0])[0]
    assert counted == pytest.approx(passed, abs=2 + 2 * module.counters.faults)
