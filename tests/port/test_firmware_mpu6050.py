"""The images with an MPU-6050 on the emulated boards, at the two lines of its I2C (host_sim/parts/i2c.py).

Truth: the readings that the model's source has given, one for each sample's number (test_mpu6050.py), and the times at
which it made them. `make campaigns` has more trials.
"""

from __future__ import annotations

import random
import shutil
from itertools import pairwise
from pathlib import Path

import pytest
from firmware import Board, NrfBoard, Tap, image, messages, often, parts, reports, status, tell
from parts.i2c import I2cBus
from parts.mpu6050 import Mpu6050
from test_mpu6050 import number_of, numbered

from conftest import ROOT

RUNNING = 2
SILENT = 4
#: Reports every 500 ms of a bank that takes no sample, and no gate: for driver, wire and flash.
QUIET = "-DBOARD_REPORT_MS=500 -DBOARD_GATE=0"
RATE_HZ = 50.0


def board_of(target: str, seed: int, flags: str = QUIET, sensor: str = "mpu6050") -> parts.Board | parts.NrfBoard:
    """A board with the sensor."""
    elf = image(f"mpu-{target}-{len(flags)}", flags, quiet=True, target=target, rate_hz=RATE_HZ, sensor=sensor)
    make = Board if target == "stm32f405" else NrfBoard
    return make(elf, seed=seed, sensor=lambda machine: Mpu6050(machine, numbered))


def i2c_of(board: parts.Board | parts.NrfBoard) -> I2cBus:
    assert board.i2c is not None
    return board.i2c


def assert_placed(board: parts.Board | parts.NrfBoard, tap: Tap, slack: float = 1.0) -> None:
    """Each sample that the library got is one that the sensor made, and two lie as many periods apart as it counts:
    by the processor's clock to `slack` after a break."""
    assert not board.machine.violations and not board.machine.faults
    at_us = {index: us for index, us, _ in board.sensor.taken}
    placed = []
    for place, sample in tap.pushed:
        assert sample == pytest.approx(numbered(number_of(sample)), rel=1e-6, abs=1e-6), "no sample of the sensor"
        placed.append((place, at_us[number_of(sample)]))
    for (place, us), (next_place, next_us) in pairwise(placed):
        passed = (next_us - us) * RATE_HZ / 1e6
        assert abs(next_place - place - passed) <= slack + 0.02 * passed, (place, passed)


@pytest.mark.parametrize("target", ["stm32f405", "cortex-m0"])
def test_every_sample_arrives(target: str) -> None:
    """With a clock that the sensor stretches by 30 us after each byte, and within UM10204's 400 kHz."""
    board = board_of(target, 4)
    i2c_of(board).stretch_us = 30.0
    tap = Tap(board)
    board.run(1.5)
    assert_placed(board, tap, slack=0.0)
    assert len(tap.pushed) > 30 and sum(tap.skips) == 0
    assert i2c_of(board).shortest_us >= 0.6  # of a high clock; a low one is two halves
    assert board.value("sensor.common.condition") == RUNNING


def test_refusals_and_a_stuck_line() -> None:
    """Bytes that are not acknowledged; a line that the sensor holds for seven clocks; and one that it holds for good,
    and lets go."""
    board = board_of("stm32f405", 6)
    tap = Tap(board)
    board.run(0.9)
    for trial in range(6):
        board.sensor.refuse = 1 + trial % 3
        board.run(0.05)
        i2c_of(board).held_clocks = 7
        board.run(0.05)
    board.run(0.3)
    assert board.value("sensor.common.counters.faults") == 0
    before = len(tap.pushed)
    assert before > 20
    i2c_of(board).held_clocks = 10**9
    seen = set()
    for _ in range(12):  # a start with the fault ends in another one
        board.run(0.05)
        seen.add(board.value("sensor.common.fault"))
    assert SILENT in seen and len(tap.pushed) - before <= 1
    i2c_of(board).held_clocks = 0
    board.run(2.4)
    assert status(board)["sensor_state"] == RUNNING
    assert_placed(board, tap, slack=2.0)
    board.close()


def test_power_cuts_and_resets() -> None:
    """At any instant. A cut takes the sensor's supply too; a reset of the processor alone may leave it in the middle of
    a byte, with the line low."""
    trials, survived = often(3), 0
    for trial in range(trials):
        rng = random.Random(trial)
        board = board_of("stm32f405", trial, QUIET + " -DBOARD_SAVE_PERIOD_S=2U")
        board.run(rng.uniform(0.05, 1.5))
        if trial % 2:
            board.power_cycle(board.retained())
        else:
            board.machine.reset("pin")
        begun = len(board.frames)
        tap = Tap(board)
        board.run(1.5)
        decoder, _ = reports(messages(board, begun))
        survived += decoder.status["sensor_state"] == RUNNING and len(tap.pushed) > 20
        assert_placed(board, tap)
        board.close()
    tell("MPU-6050: power cuts and resets", trials, survived)
    assert survived == trials


def test_wrong_bits() -> None:
    """One bit in 2000 on the data line, then none: the module goes on, and what comes afterwards is the sensor's."""
    board = board_of("stm32f405", 9)
    board.run(0.9)
    i2c_of(board).flip = 1.0 / 2000.0
    board.run(1.5)
    i2c_of(board).flip = 0.0
    assert i2c_of(board).flipped > 20
    board.run(11.0)  # a setting that a wrong bit has changed shows within 10 s; a start follows
    tap = Tap(board)
    board.run(0.6)
    assert board.value("sensor.common.condition") == RUNNING and len(tap.pushed) > 20
    assert_placed(board, tap)
    board.close()


def test_a_driver_elsewhere(tmp_path: Path) -> None:
    """A driver outside the tree, by its path, with a model file beside it: the same samples come."""
    for ending in ("c", "h"):
        text = (ROOT / "port" / "sensors" / f"mpu6050.{ending}").read_text(encoding="utf-8")
        text = text.replace('"mpu6050.h"', '"mine.h"').replace("mpu6050", "mine")
        (tmp_path / f"mine.{ending}").write_text(text, encoding="utf-8")
    shutil.copy(ROOT / "tools" / "selfcal" / "model" / "models" / "parts" / "mpu6050.yaml", tmp_path / "mine.yaml")
    board = board_of("stm32f405", 1, QUIET + " -DMINE=1", sensor=str(tmp_path / "mine.c"))
    tap = Tap(board)
    board.run(1.2)
    assert len(tap.pushed) > 20
    assert_placed(board, tap, slack=0.0)
    board.close()
