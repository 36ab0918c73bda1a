"""The images with an ICM-42688-P, on the emulated boards, with its model (host_sim/parts) at their SPI pins.

Truth: the readings that the model's source has given, one for each sample's number (test_icm42688.py), and the times at
which it made them. `make campaigns` has more trials.
"""

from __future__ import annotations

import random
from itertools import pairwise

import numpy as np
import pytest
from firmware import Board, NrfBoard, Tap, image, messages, often, parts, reports, status, tell
from parts.icm42688 import Icm42688, Sample
from test_icm42688 import GYRO_LSB, MODULUS, NO_DATA, SILENT, STUCK, numbered

STARTING, RUNNING, FAILED = 1, 2, 3
#: Reports every 500 ms of a bank that takes no sample, and no gate: for driver, wire and flash.
QUIET = "-DBOARD_REPORT_MS=500 -DBOARD_GATE=0"
RATE_HZ = 100.0


def board_of(target: str, seed: int, flags: str = QUIET, rate_hz: float = RATE_HZ) -> parts.Board | parts.NrfBoard:
    """A board with the sensor, its channel open."""
    name = f"icm-{target}-{rate_hz:g}-{len(flags)}"
    elf = image(name, flags, quiet=True, target=target, rate_hz=rate_hz, sensor="icm42688")
    make = Board if target == "stm32f405" else NrfBoard
    board = make(elf, seed=seed, sensor=lambda machine: Icm42688(machine, numbered))
    if target == "cortex-m0":
        board.run(0.1)
        board.usart.say(b"O\r")
    return board


def assert_placed(board: parts.Board | parts.NrfBoard, tap: Tap, slack: float = 1.0) -> None:
    """Each sample that the library got is one that the sensor made, and two lie as many periods apart as it counts.

    `slack`, in samples: the processor's clock places a sample after a restart of the sensor, and it was read up to a
    turn of the main loop late.
    """
    assert not board.machine.violations and not board.machine.faults and not board.machine.resets
    at_us = {number % MODULUS: us for number, us, _ in board.sensor.taken}
    placed = []
    for place, sample in tap.pushed:
        number = (round(sample[2] / GYRO_LSB) + MODULUS // 2) % MODULUS
        assert sample == pytest.approx(numbered(number), rel=1e-6, abs=1e-6), "no sample of the sensor"
        placed.append((place, at_us[number]))
    period_us = 1e6 / RATE_HZ * (1.0 + board.sensor.clock_error)
    for (place, us), (next_place, next_us) in pairwise(placed):
        passed = (next_us - us) / period_us
        assert abs(next_place - place - passed) <= (1e-3 if passed < 1.5 else slack + 2e-3 * passed), (place, passed)


def test_its_reports() -> None:
    """Telemetry of the image as `make firmware` makes it, but with fewer laws, at a lower rate: the sensor runs, and
    each bias is the source's. Rest begins after 17 windows of 0.5 s. sd of a bias: noise / sqrt(samples); within five.
    """
    noise, bias = (0.04,) * 3 + (9e-3,) * 3, (0.31, -0.12, 0.07, 0.11, -0.05, 9.83)

    def resting(k: int) -> Sample:
        rng = random.Random(77_000 + k)
        gx, gy, gz, ax, ay, az = (rng.gauss(mean, sd) for mean, sd in zip(bias, noise, strict=True))
        return gx, gy, gz, ax, ay, az

    elf = image(
        "icm-reports", "-DBOARD_REPORT_MS=13500", quiet=True, bank_hz=1.0, laws=("constant", "random_walk"),
        rate_hz=RATE_HZ, sensor="icm42688",
    )  # fmt: skip
    board = Board(elf, seed=2, sensor=lambda machine: Icm42688(machine, resting))
    board.sensor.temperature = 31.0
    board.run(15.0)
    decoder, found = reports(messages(board))
    assert (decoder.status["sensor_state"], decoder.status["sensor_fault_count"]) == (RUNNING, 0)
    assert decoder.status["sensor_damaged_count"] == decoder.status["sensor_overrun_count"] == 0
    last = {report.axis: report for report in found}
    assert decoder.status["motion"] == 2  # rest
    assert set(last) == {"gx", "gy", "gz", "ax", "ay", "az"}
    for axis, true, sd in zip(("gx", "gy", "gz", "ax", "ay", "az"), bias, noise, strict=True):
        assert last[axis].value("bias_mean") == pytest.approx(true, abs=5.0 * sd / np.sqrt(RATE_HZ * 3.0)), axis
    assert not board.machine.violations and not board.machine.faults and not board.machine.resets
    board.close()


@pytest.mark.parametrize("target", ["stm32f405", "cortex-m0"])
def test_every_sample_arrives(target: str) -> None:
    board = board_of(target, 4)
    board.sensor.clock_error = 0.013
    tap = Tap(board)
    board.run(2.0)
    assert_placed(board, tap, slack=0.0)
    assert len(tap.pushed) > 100 and sum(tap.skips) == 0
    assert status(board)["sensor_state"] == RUNNING or target == "cortex-m0"


def test_power_cuts() -> None:
    """At any instant of start, run and save. The module comes back, and takes what was saved."""
    trials, survived = often(4), 0
    for trial in range(trials):
        rng = random.Random(trial)
        board = board_of("stm32f405", trial, QUIET + " -DBOARD_SAVE_PERIOD_S=2U")
        for _ in range(2):
            board.run(rng.uniform(0.05, 3.5))
            board.power_cycle(board.retained())
        begun = len(board.frames)
        tap = Tap(board)
        board.run(1.9)
        decoder, _ = reports(messages(board, begun))
        survived += decoder.status["sensor_state"] == RUNNING and len(tap.pushed) > 50
        board.machine.resets.clear()  # the cuts
        assert_placed(board, tap)
        board.close()
    tell("ICM-42688-P: power cuts", trials, survived)
    assert survived == trials


FAULTS = {
    "silent": SILENT,
    "dead": SILENT,
    "stale": NO_DATA,
    "frozen": STUCK,
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_the_sensor(name: str) -> None:
    """A FIFO that stays empty, a part that is gone, old packets, the same readings: told, and no sample of it comes."""
    board = board_of("stm32f405", 5)
    tap = Tap(board)
    board.run(1.5)
    first = len(tap.pushed)
    assert first > 50
    setattr(board.sensor, name, True)
    seen: set[int] = set()
    for _ in range(30):  # a start with the fault ends in another one: sooner than the next status
        board.run(0.05)
        seen.add(board.value("sensor.common.fault"))
    assert FAULTS[name] in seen
    assert status(board)["sensor_fault_count"] >= 1 and status(board)["sensor_fault"] in seen
    during = len(tap.pushed)
    assert during - first <= 4  # what waited, and two repeats
    setattr(board.sensor, name, False)
    board.run(4.0)
    assert status(board)["sensor_state"] == RUNNING
    assert len(tap.pushed) > during + 50
    if name != "frozen":  # its repeats have one number
        assert_placed(board, tap)
    board.close()


def test_bus_faults() -> None:
    """Wrong bits on either wire, one in 3000, then none. No packet has a checksum, so readings may be wrong; but the
    module goes on, the time stays right, and what comes afterwards is the sensor's."""
    trials, survived = often(2), 0
    for trial in range(trials):
        board = board_of("stm32f405", 30 + trial)
        board.run(1.2)
        board.spi.flip = 1.0 / 3000.0
        board.run(4.0)
        board.spi.flip = 0.0
        assert board.spi.flipped > 20
        told = status(board)
        assert told["sensor_damaged_count"] + told["sensor_fault_count"] > 0
        # a setting that a wrong bit has changed shows within 10 s; a start follows
        board.run(13.0)
        tap = Tap(board)
        board.run(1.0)
        assert_placed(board, tap)
        survived += status(board)["sensor_state"] == RUNNING and len(tap.pushed) > 80
        board.close()
    tell("ICM-42688-P: wrong bits", trials, survived)
    assert survived == trials


def test_unplugged_and_back() -> None:
    board = board_of("stm32f405", 8)
    board.sensor.clock_error = -0.0015
    tap = Tap(board)
    board.run(1.7)
    board.sensor.plug(False)
    board.run(1.1)
    away = len(tap.pushed)
    board.sensor.plug(True)
    board.run(3.0)
    assert len(tap.pushed) > away + 50
    assert status(board)["sensor_state"] == RUNNING
    assert_placed(board, tap, slack=2.0)
    board.close()


def test_a_save_overruns_the_fifo() -> None:
    """An erase stops the processor for 1 s, and the FIFO holds 0.2 s at 500 Hz: the rest is missing in time, and no
    packet of before the pause is taken for one after it."""
    board = board_of("stm32f405", 9, QUIET + " -DBOARD_SAVE_PERIOD_S=1U", rate_hz=500.0)
    tap = Tap(board)
    board.run(3.6)
    assert board.value("app.told.state_saves") >= 1
    skipped = sum(tap.skips)
    assert skipped > 200
    at_us = {number % MODULUS: us for number, us, _ in board.sensor.taken}
    numbers = [(round(sample[2] / GYRO_LSB) + MODULUS // 2) % MODULUS for _, sample in tap.pushed]
    places = [place for place, _ in tap.pushed]
    for (before, after), (one, other) in zip(pairwise(numbers), pairwise(places), strict=True):
        assert other - one == pytest.approx((at_us[after] - at_us[before]) / 2000.0, abs=1.01)
    assert board.value("sensor.common.counters.faults") == 0
    board.close()
