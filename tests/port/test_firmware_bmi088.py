"""The images with a BMI088, on the emulated boards, with the model of its two chips at their SPI pins (host_sim/parts).

Truth: the readings that the model's source has given, one for each sample's number of either chip (test_bmi088.py), and
the times at which it made them. `make campaigns` has more trials.
"""

from __future__ import annotations

import random
from itertools import pairwise

import pytest
from firmware import Board, NrfBoard, Tap, image, messages, often, parts, reports, tell
from parts.bmi088 import Bmi088
from test_bmi088 import assert_paired, numbered

RUNNING, SILENT = 2, 4
QUIET = "-DBOARD_REPORT_MS=500 -DBOARD_GATE=0"
RATE_HZ = 100.0


def board_of(target: str, seed: int, flags: str = QUIET) -> parts.Board | parts.NrfBoard:
    """A board with the sensor."""
    name = f"bmi-{target}-{len(flags)}"
    elf = image(name, flags, quiet=True, target=target, rate_hz=RATE_HZ, sensor="bmi088")
    make = Board if target == "stm32f405" else NrfBoard
    return make(elf, seed=seed, sensor=lambda machine: Bmi088(machine, numbered))


def assert_placed(board: parts.Board | parts.NrfBoard, tap: Tap, slack: float) -> None:
    """What the library got, with the gaps that it was told."""
    assert not board.machine.faults
    places = [place for place, _ in tap.pushed]
    gaps = [0, *(after - before - 1 for before, after in pairwise(places))]
    assert_paired(board.sensor, [(tuple(s), gap) for (_, s), gap in zip(tap.pushed, gaps, strict=True)], slack)


@pytest.mark.parametrize("target", ["stm32f405", "cortex-m0"])
def test_every_sample_arrives(target: str) -> None:
    board = board_of(target, 4)
    board.sensor.gyro.clock_error, board.sensor.accel.clock_error = 0.007, -0.008
    tap = Tap(board)
    board.run(2.0)
    assert_placed(board, tap, slack=0.0)
    assert len(tap.pushed) > 100 and sum(tap.skips) == 0
    assert board.value("sensor.common.condition") == RUNNING


@pytest.mark.parametrize("chip", ["accel", "gyro"])
def test_one_chip_falls_silent(chip: str) -> None:
    """And comes back: no sample of one chip alone."""
    board = board_of("stm32f405", 5)
    tap = Tap(board)
    board.run(1.2)
    before = len(tap.pushed)
    assert before > 40
    getattr(board.sensor, chip).silent = True
    seen = set()
    for _ in range(16):
        board.run(0.05)
        seen.add(board.value("sensor.common.fault"))
    assert SILENT in seen and len(tap.pushed) - before <= 5
    getattr(board.sensor, chip).silent = False
    board.run(2.5)
    assert board.value("sensor.common.condition") == RUNNING and len(tap.pushed) > before + 40
    assert_placed(board, tap, slack=2.0)
    board.close()


def test_power_cuts() -> None:
    """At any instant of start, run and save. The module comes back, and takes what was saved."""
    trials, survived = often(3), 0
    for trial in range(trials):
        rng = random.Random(trial)
        board = board_of("stm32f405", trial, QUIET + " -DBOARD_SAVE_PERIOD_S=2U")
        board.run(rng.uniform(0.05, 2.5))
        board.power_cycle(board.retained())
        begun = len(board.frames)
        tap = Tap(board)
        board.run(1.3)
        decoder, _ = reports(messages(board, begun))
        survived += decoder.status["sensor_state"] == RUNNING and len(tap.pushed) > 40
        assert_placed(board, tap, slack=1.0)
        board.close()
    tell("BMI088: power cuts", trials, survived)
    assert survived == trials


def test_wrong_bits() -> None:
    """One bit in 3000 on either wire, then none: the module goes on, and what comes afterwards is the sensor's."""
    board = board_of("stm32f405", 9)
    board.run(1.2)
    board.spi.flip = 1.0 / 3000.0
    board.run(2.0)
    board.spi.flip = 0.0
    assert board.spi.flipped > 10
    board.machine.violations.clear()  # a wrong bit has set what it set
    board.run(11.5)  # a setting that a wrong bit has changed shows within 10 s; a start follows
    tap = Tap(board)
    board.run(0.6)
    assert board.value("sensor.common.condition") == RUNNING and len(tap.pushed) > 40
    assert_placed(board, tap, slack=1.0)
    board.close()
