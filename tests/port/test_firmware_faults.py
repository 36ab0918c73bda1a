"""Fault campaigns on the unmodified STM32F405 image, some on the nRF51822's too (SPI, sensor away, saved state):
trials, and how many were survived. Each prints a line with both.

A trial is survived when the image does not reset, hang or fault, breaks no rule of a part, gives the library no sample
that the sensor did not make (wrong = 0) and puts every sample where it belongs in time (misplaced = 0).
`make test` runs a quarter of the trials and some parameters; SELFCAL_CAMPAIGN=N (`make campaigns`) N times all."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from firmware import (
    MANY,
    QUIET_RATE_HZ,
    SLOW_RATE_HZ,
    Board,
    NrfBoard,
    Tap,
    image,
    messages,
    often,
    parts,
    readings,
    reports,
    set_up,
    some,
    status,
    tell,
)
from parts.flash import half_erased, half_programmed
from parts.machine import EXC_IRQ0
from scipy.stats import poisson
from unicorn import UC_HOOK_CODE, Uc
from unicorn import arm_const as arm

#: Reports every 500 ms, no bank sample (firmware.py), no gate: for the driver, the wire and the flash.
QUIET = ("quiet", "-DBOARD_REPORT_MS=500 -DBOARD_GATE=0", True)
SERIAL = ("serial", "-DBOARD_REPORT_MS=500 -DBOARD_GATE=0 -DBOARD_CAN_KBITPS=0 -DBOARD_USART_BAUD=1000000", True)
TARGETS = ("stm32f405", "cortex-m0")
#: codes of `sensor_fault` in selfcal.dbc
ABSENT, SET_UP, SELF_TEST, SILENT, NO_DATA, STUCK, STATUS = range(1, 8)
STARTING, RUNNING, FAILED = 1, 2, 3


def sound(board: parts.Board, tap: Tap | None, slack: int) -> bool:
    """Whether the trial was survived."""
    machine = board.machine
    well = not (machine.violations or machine.faults or machine.resets)
    if not well:
        print(machine.violations[:3], machine.faults[:3], machine.resets[:3])
    if tap is not None:
        wrong, misplaced = tap.wrong(), tap.misplaced(slack)
        if wrong or misplaced or not tap.pushed:
            print(f"wrong {wrong}, misplaced {misplaced} of {len(tap.pushed)}")
            return False
    return well


def quiet(target: str, seed: int) -> parts.Board | parts.NrfBoard:
    """A board of either target, its channel open."""
    if target == "stm32f405":
        return Board(image(*QUIET), seed=seed)
    board = NrfBoard(image("m0-quiet", *QUIET[1:], target=target), seed=seed)
    board.run(0.1)
    board.usart.say(b"O\r")
    return board


@pytest.mark.parametrize("target", some(TARGETS, "stm32f405"))
def test_sensor_unplugged_and_back(target: str) -> None:
    """The time away is counted by the module's clock: within a sample a gap."""
    trials, survived = often(4 if target == "stm32f405" else 1), 0
    for trial in range(trials):
        rng = random.Random(trial)
        board = quiet(target, seed=trial)
        tap = Tap(board)
        board.sensor.floating_high = bool(trial & 1)
        board.sensor.clock_error = rng.uniform(-0.002, 0.002)
        board.run(1.5 + rng.random())
        before = len(tap.pushed)
        board.sensor.plug(False)
        board.run(0.9 + rng.random())
        told = status(board)
        assert told["sensor_state"] in (STARTING, FAILED)
        assert told["sensor_fault"] in (SILENT, ABSENT)
        while_away = len(tap.pushed)
        board.sensor.plug(True)
        board.run(4.0)
        assert while_away - before <= 1, "samples came from a sensor that is not there"
        assert len(tap.pushed) > while_away + 100, "it did not come back"
        assert status(board)["sensor_state"] == RUNNING
        survived += sound(board, None, 0) and tap.wrong() == 0 and tap.mistimed() == 0
        if isinstance(board, Board):
            board.close()
    tell(f"sensor unplugged and back, {target}", trials, survived)
    assert survived == trials


FAULTS: dict[str, tuple[int, Callable[[parts.Adis16405, bool], None]]] = {
    "silent": (SILENT, lambda sensor, on: setattr(sensor, "silent", on)),
    "dead": (ABSENT, lambda sensor, on: setattr(sensor, "dead", on)),
    "stuck": (STUCK, lambda sensor, on: setattr(sensor, "frozen", on)),
    "no new data": (
        NO_DATA,
        lambda sensor, on: setattr(sensor, "stale", (lambda k: True) if on else (lambda k: False)),
    ),
    "supply low": (STATUS, lambda sensor, on: setattr(sensor, "trouble", 1 if on else 0)),
    "flash checksum": (STATUS, lambda sensor, on: setattr(sensor, "trouble", 0x40 if on else 0)),
}


@pytest.mark.parametrize("name", some(tuple(FAULTS), "silent", "stuck", "supply low"))
def test_sensor_fails_and_heals(name: str) -> None:
    """Each fault is told by its code, gives no sample, and ends when it ends; the gap has the right length."""
    code, inflict = FAULTS[name]
    board = Board(image(*QUIET), seed=11)
    tap = Tap(board)
    board.run(1.5)
    first = len(tap.pushed)
    assert first > 50
    inflict(board.sensor, True)
    seen: set[int] = set()
    for _ in range(4):
        board.run(1.0)
        seen.add(int(status(board)["sensor_fault"]))
    assert code in seen, f"{name}: told {seen}"
    assert status(board)["sensor_fault_count"] >= 1
    during = len(tap.pushed)
    assert during - first <= 3
    inflict(board.sensor, False)
    board.run(5.0)
    assert len(tap.pushed) > during + 50
    assert status(board)["sensor_state"] == RUNNING
    assert sound(board, None, 0)
    assert tap.wrong() == 0
    assert tap.mistimed() == 0
    tell(f"sensor {name}", 1, 1)


@pytest.mark.parametrize("when_us", some((2e3, 8e3, 15e3), 8e3))
def test_a_reset_during_the_self_test(when_us: float) -> None:
    """A spike resets the sensor while it tests itself at the start: its defaults look like the end of the test, but its
    rate and filter are not what was set."""
    board = Board(image(*QUIET), seed=1)
    tap = Tap(board)
    while not board.sensor.registers[0x34] & 0x0400:
        board.run(1e-3)
    board.run(when_us / 1e6)
    board.sensor.reset()
    board.run(3.0)
    assert status(board)["sensor_fault"] == SET_UP
    assert status(board)["sensor_state"] == RUNNING
    assert set_up(board) == {0x34: 0x0006, 0x36: 9, 0x38: 0x0401}
    assert len(tap.pushed) > 100
    assert sound(board, None, 0)
    assert tap.wrong() == tap.mistimed() == tap.foreign() == 0


def test_a_reset_while_the_flash_is_at_work() -> None:
    """Nobody sees the sensor's silence then: what follows the pause is taken only once the settings have been read."""
    board = saver("stm32f405")
    tap = Tap(board)
    board.run(1.0)
    before, erase = set_up(board), board.flash._erase

    def spoil(number: int) -> None:
        if board.flash._erase == spoil:
            board.flash._erase = erase
            board.machine.at(5e3, board.sensor.reset)
        erase(number)

    board.flash._erase = spoil
    while board.value("app.told.state_saves") < 1:
        board.run(0.1)
    taken = len(tap.pushed)
    board.run(3.0)
    assert board.sensor.resets >= 3  # power, start, spike
    assert set_up(board) == before
    assert board.value("sensor.common.condition") == RUNNING
    assert len(tap.pushed) > taken + 50
    assert not board.machine.violations
    assert tap.wrong() == tap.mistimed() == tap.foreign() == 0


def test_a_reset_while_samples_wait() -> None:
    """A main loop that takes none for a while, as with a bank that has no room: what waits, and what the sensor made
    between the reset and its next set-up, is dropped. (In slow mode the readings of a sensor that has fallen back to
    819.2 Hz overlap, and none passes.)"""
    board = Board(image(*QUIET), seed=3)
    tap = Tap(board)
    away = False

    def none(uc: Uc, address: int, size: int, data: object) -> None:
        if away:
            uc.reg_write(arm.UC_ARM_REG_R0, 0)
            uc.reg_write(arm.UC_ARM_REG_PC, uc.reg_read(arm.UC_ARM_REG_LR))

    sample = board.machine.symbols["sensor_read"] & ~1
    board.machine.uc.hook_add(UC_HOOK_CODE, none, None, sample, sample)
    board.run(2.0)
    away = True
    board.run(1.2)
    board.sensor.reset()
    board.run(0.5)
    assert board.value("sensor.head") - board.value("sensor.tail") > 100
    board.run(12.0)
    assert board.value("sensor.common.counters.faults") == 1
    assert board.value("sensor.common.condition") == RUNNING
    away = False
    before = len(tap.pushed)
    board.run(1.0)
    assert len(tap.pushed) > before + 90
    assert sound(board, None, 0)
    assert tap.wrong() == tap.mistimed() == tap.foreign() == 0


@pytest.mark.parametrize("target", TARGETS)
def test_the_sensor_is_ready_before_its_driver(target: str) -> None:
    """After a reset of the processor alone the sensor goes on: a sample may be ready while the driver is set up."""
    board = quiet(target, 8)
    board.run(2.0)
    early = 0

    def ready(uc: Uc, address: int, size: int, data: object) -> None:
        nonlocal early
        early += 1
        board.machine.pend(EXC_IRQ0 + 6)  # EXTI0 and GPIOTE

    place = board.machine.symbols["sensor_open"] & ~1
    board.machine.uc.hook_add(UC_HOOK_CODE, ready, None, place, place)
    board.machine.reset("software")
    board.run(3.0)
    assert early == 1
    assert [cause for _, cause in board.machine.resets] == ["software"]
    assert not board.machine.faults
    assert board.value("sensor.common.condition") == RUNNING


def test_altered_settings_are_found() -> None:
    """A read that a bit error made a write, here of the range: seen within 10 s by the readings of the settings, which
    cost no sample."""
    board = Board(image(*QUIET), seed=6)
    tap = Tap(board)
    board.run(11.0)
    assert sum(tap.skips) == 0
    assert board.sensor.reads[0x38] >= 2 + 1 + 1  # written, at the end of the start, after 10 s
    board.sensor.registers[0x38] = 0x0101
    board.run(10.1)
    assert (board.value("sensor.common.condition"), board.value("sensor.common.fault")) != (RUNNING, 0)
    board.run(2.0)
    assert status(board)["sensor_fault"] == SET_UP
    assert status(board)["sensor_state"] == RUNNING
    assert board.sensor.registers[0x38] == 0x0401
    assert sound(board, None, 0)
    assert tap.mistimed() == 0


@pytest.mark.parametrize(
    ("name", "code"),
    some(
        (("wrong product", ABSENT), ("self-test fails", SELF_TEST), ("absent", ABSENT)), ("self-test fails", SELF_TEST)
    ),
)
def test_sensor_bad_from_the_start(name: str, code: int) -> None:
    """A fault is told before the first sample, there is none, and tries come at growing intervals."""
    board = Board(image(*QUIET), seed=5)
    tap = Tap(board)
    if name == "wrong product":
        board.sensor.product = 16400
        board.sensor.power_on()
    elif name == "self-test fails":
        board.sensor.fail_self_test = 0x0400
    else:
        board.sensor.plug(False)
    board.run(4.0)
    told = status(board)
    assert told["sensor_fault"] == code
    assert 3 <= told["sensor_fault_count"] <= 8  # 0.33 s a start, then 0.1, 0.2, 0.4, 0.8 s
    assert told["samples"] == 0
    assert tap.pushed == []
    assert sound(board, None, 0)


@pytest.mark.parametrize(
    ("target", "chance"),
    some(
        (("stm32f405", 1e-5), ("stm32f405", 1e-4), ("stm32f405", 1e-3), ("cortex-m0", 1e-3)),
        *(("stm32f405", 1e-3), ("cortex-m0", 1e-3)),
    ),
)
def test_spi_bit_flips(target: str, chance: float) -> None:
    """Bits turned over on either wire: two bursts carry 96 bits of the six channels each, so that at 1e-3 every sixth
    sample is lost. The sensor has no checksum: a wrong sample is taken where both bursts have the same bit turned."""
    seconds = often(8 if target == "stm32f405" else 3)
    board = quiet(target, seed=int(1 / chance))
    tap = Tap(board)
    board.run(1.0)
    board.spi.flip = chance
    board.run(seconds)
    board.spi.flip = 0.0
    board.run(2.0)
    told = status(board)
    lost = told["sensor_damaged_count"] + told["sensor_stale_count"] + told["sensor_alarm_count"]
    wrong = tap.wrong()
    tell(
        f"SPI bit flips at {chance:g}, {target}",
        board.spi.flipped,
        board.spi.flipped - wrong,
        f"{len(tap.pushed)} samples taken, {lost:.0f} refused, {wrong} wrong",
    )
    assert board.spi.flipped > 0
    assert wrong <= poisson.isf(1e-3, 96 * chance**2 * len(tap.pushed))
    # a MOSI bit may make the burst a write or another register: rates and ranges are set anew at the next start
    assert not board.machine.faults
    assert not board.machine.resets
    assert told["sensor_state"] == RUNNING


def test_lost_sign_bit() -> None:
    """The known anomaly at one sample in ten with a negative x rate: none is taken."""
    board = Board(image(*QUIET), seed=2)
    tap = Tap(board)
    board.sensor.lose_sign = lambda k: k % 10 == 0
    board.run(6.0)
    struck = sum(
        index % 10 == 0 and sample[0] < 0 for index, _, sample in board.sensor.taken if index in board.sensor.read_twice
    )
    told = status(board)
    tell("lost sign bit", struck, struck - tap.wrong(), f"{told['sensor_anomaly_count']:.0f} counted")
    assert struck > 20
    assert abs(told["sensor_anomaly_count"] - struck) <= 5  # those since the last status
    assert sound(board, tap, 0)


def test_lost_sign_bit_after_pauses() -> None:
    """At -340 deg/s, beyond the nominal range, a reading less its sign is +70, and nothing before it tells."""
    board = Board(image(*QUIET), seed=14)
    rest = board.sensor.source
    board.sensor.source = lambda k: (rest(k)[0] - 6800.0, *rest(k)[1:])
    board.sensor.lose_sign = lambda k: k % 10 == 0
    tap = Tap(board)
    for _ in range(12):
        board.run(0.8)
        board.sensor.silent = True
        board.run(0.12)
        board.sensor.silent = False
    assert len(tap.pushed) > 500
    assert tap.wrong() == 0


def test_missed_and_stale_samples_become_gaps_in_place() -> None:
    """Data-ready without new data, and samples whose data-ready is missed, at random: every sample stays in its
    place."""
    rng = random.Random(4)
    board = Board(image(*QUIET), seed=4)
    tap = Tap(board)
    stale = {k for k in range(5000) if rng.random() < 0.05}
    board.sensor.stale = lambda k: k in stale
    board.dma2.hang = 3
    board.run(8.0)
    told = status(board)
    assert told["sensor_stale_count"] > 20
    assert told["missing"] > 20
    assert sound(board, tap, 0)
    assert sum(tap.skips) == tap.place + 1 - len(tap.pushed)


def test_bursts_that_never_end() -> None:
    """DMA that stops in mid-burst, with chip select low: for a moment, and for long enough to be a fault. The sensor is
    reached again, and whatever was under way is no sample."""
    board = Board(image(*QUIET), seed=15)
    tap = Tap(board)
    board.run(1.5)
    board.dma2.hang = 1
    board.run(0.5)
    assert status(board)["sensor_fault_count"] == 0
    board.dma2.hang = 12  # four of them end a run in 150 ms of silence
    board.run(5.0)
    told = status(board)
    assert board.dma2.hang == 0
    assert told["sensor_fault"] == NO_DATA
    assert told["sensor_state"] == RUNNING
    assert sound(board, None, 0)
    assert tap.wrong() == 0


def test_gap_of_a_minute_and_clock_error() -> None:
    """20 s (SELFCAL_CAMPAIGN: 60 s) without data-ready, from a sensor whose clock is 2 % fast: the gap is counted in
    its samples, whose period the driver has tracked, to one part in a thousand."""
    board = Board(image(*QUIET), seed=6)
    tap = Tap(board)
    board.sensor.clock_error = -0.02
    board.run(4.0)
    board.sensor.silent = True
    seconds = 60.0 if MANY > 1 else 20.0
    board.run(seconds)
    board.sensor.silent = False
    board.run(12.0)
    gap = max(tap.skips)
    assert gap > seconds * QUIET_RATE_HZ / 0.98
    assert sound(board, None, 0)
    off = tap.mistimed()
    tell(f"{seconds:.0f} s gap", 1, int(off == 0), f"{gap} samples counted, the wait for the next try included")
    assert off == 0


def test_saturation() -> None:
    """Beyond the range readings are kept out by the library, counted, and time goes on."""
    board = Board(image(*QUIET), seed=8)
    rest = board.sensor.source
    board.sensor.source = lambda k: (rest(k)[0], 6100, *rest(k)[2:]) if 250 <= k < 300 else rest(k)
    tap = Tap(board)
    board.run(6.0)
    told = status(board)
    assert told["saturated_count"] == 50
    assert sound(board, tap, 0)


def test_over_range_is_no_fault() -> None:
    """The sensor says over-range for a second (DIAG_STAT 4, EA in every word): a gap, not a fault nor a restart."""
    board = Board(image(*QUIET), seed=10)
    tap = Tap(board)
    board.run(3.0)
    resets = board.sensor.resets
    board.sensor.trouble = 0x10
    board.run(1.0)
    board.sensor.trouble = 0
    board.run(2.0)
    told = status(board)
    assert board.sensor.resets == resets
    assert told["sensor_fault_count"] == 0
    assert int(told["sensor_diagnosis"]) & 0x10
    # up to the reading of DIAG_STAT that clears it, 100 ms
    assert max(tap.skips) == pytest.approx(QUIET_RATE_HZ, abs=0.15 * QUIET_RATE_HZ)
    assert sound(board, tap, 0)
    board.sensor.trouble = 0x10  # after ten seconds it is a fault, and so is an alarm of its own at once
    board.run(9.0)
    assert status(board)["sensor_fault_count"] == 0
    board.run(3.0)
    assert status(board)["sensor_fault"] == NO_DATA
    board.sensor.trouble = 0
    board.run(3.0)
    faults = status(board)["sensor_fault_count"]
    board.sensor.trouble = 0x100
    board.run(1.0)
    assert status(board)["sensor_fault_count"] > faults


def test_fast_rotation_about_x_after_a_pause() -> None:
    """120 deg/s, which one reading cannot be told from a negative one less its sign: three are refused, no more."""
    board = Board(image(*QUIET), seed=11)
    rest = board.sensor.source
    board.sensor.source = lambda k: (rest(k)[0] + 2400.0, *rest(k)[1:]) if k >= 200 else rest(k)
    tap = Tap(board)
    board.run(3.0)
    board.sensor.silent = True
    board.run(0.105)  # more than ten samples, and with three more less than a fault's 150 ms
    board.sensor.silent = False
    board.run(2.0)
    told = status(board)
    assert (told["sensor_anomaly_count"], told["sensor_fault_count"]) == (3, 0)
    assert len(tap.pushed) > 400
    assert sound(board, tap, 0)


def test_offset_registers_as_autonull_leaves_them() -> None:
    """A negative XGYRO_OFF in the sensor's own flash would lose the sign of every negative x: it is taken out, and what
    comes is what the sensor measures."""
    board = Board(image(*QUIET), seed=12)
    board.sensor.factory[0x1A] = -20 & 0x1FFF
    board.sensor.factory[0x1C] = -30 & 0x1FFF
    board.sensor.power_on()
    tap = Tap(board)
    board.run(8.0)
    x = np.array([sample[0] for _, sample in tap.pushed])
    assert board.sensor.registers[0x1A] == 0
    assert board.sensor.registers[0x1C] == -30 & 0x1FFF
    assert status(board)["sensor_anomaly_count"] == 0
    # the source's -9 LSB, 18 rms; the mean of 780 samples within 4 sd
    assert x.size > 750
    assert abs(x.mean() + 9 * 0.05) < 4.0 * 18 * 0.05 / math.sqrt(x.size)
    assert sound(board, tap, 0)


#: The gate: bank intervals of 80 samples, windows of 40; no report within a test.
GATED: dict[str, Any] = {
    "name": "gated",
    "flags": "-DBOARD_REPORT_MS=3000000",
    "quiet": True,
    "bank_hz": 1.28,
    "rate_hz": SLOW_RATE_HZ,
}
BLOCK = 80


def test_shocks_are_kept_out() -> None:
    """Shocks as in run 4 of the real recordings (17 deg/s on x for 85 samples; some tenths of g on an accelerometer for
    46), at random places and down to a third of that, once the gate has measured the noise: no bank sample rests on
    what the gate could tell of one, however late in its interval it begins; each ends rest once, and the rest after it
    counts again."""
    trials, survived, struck, unseen, leaked = MANY, 0, 0, 0, 0
    for trial in range(trials):
        rng = random.Random(100 + trial)
        board = Board(image(**GATED), seed=trial)
        tap = Tap(board)
        shocks: list[Shock] = []
        for begin in (2400, 3900, 5400):
            start, gyro = begin + rng.randrange(300), rng.random() < 0.5
            size = rng.uniform(1 / 3, 1) * rng.choice((-1, 1))
            shocks.append(Shock(start, start + (85 if gyro else 46), gyro, size))
        board.sensor.source = shaken(board.sensor.source, shocks)
        board.run(0.4 + 2400 / SLOW_RATE_HZ)
        assert board.value("app.imu.gate->gate.measured") >= 30
        board.run(4500 / SLOW_RATE_HZ)
        number = {tuple(readings([sample])[0].tolist()): index for index, _, sample in board.sensor.taken}
        first = number[tap.pushed[0][1]] - tap.pushed[0][0]
        ends = [first + last for last in tap.intervals]
        windows = [range(end - back - WINDOW + 1, end - back + 1) for end in ends for back in range(0, BLOCK, WINDOW)]
        felt = [sum(shock.felt(window) for shock in shocks) for window in windows]
        struck += len(shocks)
        unseen += sum(0.0 < energy < CERTAIN for energy in felt)
        bad = sum(energy >= CERTAIN for energy in felt)
        leaked += bad
        # of 86 intervals, two windows each, a shock takes the windows it touches, one more and hold = 16: 11 at most;
        # the start takes 9
        survived += (
            sound(board, tap, 0)
            and bad == 0
            and board.value("app.imu.gate->gate.counters.alarms") == len(shocks)
            and len(tap.intervals) >= 86 - 9 - 11 * len(shocks)
        )
        board.close()
    tell("shocks", trials, survived, f"{struck} shocks, {leaked} in a bank sample, {unseen} too little of them to tell")
    assert survived == trials


def test_the_bank_begins_with_a_window() -> None:
    """12 samples are missing as the gate first says rest: the bank's intervals hold whole windows for all that.

    So it is with an axis at its rail from the start on, which is given up in the middle of a window."""
    board = Board(image(**GATED), seed=1)
    tap = Tap(board)
    board.run(1.0)
    while board.value("app.imu.gate->gate.state") == 0:
        board.run(0.5 / SLOW_RATE_HZ)
    begin = board.sensor.index
    board.sensor.stale = lambda k: begin <= k < begin + 12
    board.run(6.0 * BLOCK / SLOW_RATE_HZ)
    assert len(tap.intervals) >= 3
    assert board.value("app.imu.bank.position") % WINDOW == board.value("app.imu.gate->gate.position")
    board.close()


#: Samples of a window of the gate; noise of the board's sensor, deg/s and g (parts/board.py).
WINDOW = BLOCK // 2
SIGMA = (0.9, 9e-3)
#: Energy of a motion in a window, over sigma^2, that the gate misses once in a thousand: T1 of six axes at rest is
#: chi-square of 234 degrees, 325 at most but for half of 1e-4; with an energy E of mean 234 + E and variance 468 + 4 E.
CERTAIN = 200.0


@dataclass(frozen=True)
class Shock:
    """First sample, the one after the last, on the gyro or not, strength over run 4's."""

    begin: int
    end: int
    gyro: bool
    size: float

    def swing(self, k: int) -> float:
        """At a sample, deg/s or g."""
        inside = self.begin <= k < self.end
        return inside * self.size * (17.0 if self.gyro else 0.4) * math.sin((k - self.begin) * 2.0 * math.pi / 17.0)

    def felt(self, window: range) -> float:
        """Energy in a window over the noise's variance."""
        return sum((self.swing(k) / SIGMA[not self.gyro]) ** 2 for k in window)


def shaken(rest: Callable[[int], tuple[float, ...]], shocks: list[Shock]) -> Callable[[int], tuple[float, ...]]:
    """A sensor at rest but for shocks."""

    def sample(k: int) -> tuple[float, ...]:
        reading = list(rest(k))
        for shock in shocks:
            reading[0 if shock.gyro else 4] += shock.swing(k) / (0.05 if shock.gyro else 3.33e-3)
        return tuple(reading)

    return sample


def test_clock_jitter() -> None:
    """Each period of the sensor's clock off by 5 % rms, as much as an interrupt that comes late makes of it: every
    sample is in its place, none is missing."""
    trials, survived = MANY, 0
    for trial in range(trials):
        board = Board(image(*QUIET), seed=200 + trial)
        tap = Tap(board)
        board.sensor.jitter = 0.05
        board.sensor.clock_error = random.Random(trial).uniform(-0.01, 0.01)
        board.run(10.0)
        survived += sound(board, tap, 0) and sum(tap.skips) == 0
    tell("clock jitter of 5 %", trials, survived)
    assert survived == trials


@pytest.mark.parametrize(
    ("target", "factor"),
    some(
        (("stm32f405", 2.0), ("stm32f405", 1.3), ("stm32f405", 0.8), ("cortex-m0", 1.3)),
        *(("stm32f405", 0.8), ("cortex-m0", 1.3)),
    ),
)
def test_another_rate_than_the_one_set(target: str, factor: float) -> None:
    """The sensor's registers stand and its clock is another: that is a fault and not a stream of samples at wrong
    times. Three are taken before it is seen, and once the clock is right again the module goes on."""
    board = quiet(target, seed=7)
    tap = Tap(board)
    board.run(1.45)  # a status is under way at 1.5 s, and a second sample waits
    right = board.sensor.period_us
    taken = len(tap.pushed)
    board.sensor.period_us = lambda: right() / factor
    board.run(1.5)
    told = status(board)
    assert told["sensor_fault"] == NO_DATA
    assert told["sensor_fault_count"] > 0
    assert len(tap.pushed) - taken <= 4  # one may have been on its way
    board.sensor.period_us = right
    board.run(3.0)
    assert status(board)["sensor_state"] == RUNNING
    assert board.machine.violations == []


def test_bus_off_and_back() -> None:
    """A bus with errors on every frame: bus-off, recovery by itself, frames again, samples never touched."""
    trials, survived = often(3), 0
    for trial in range(trials):
        board = Board(image(*QUIET), seed=trial)
        tap = Tap(board)
        board.run(1.6)
        board.can.fault = lambda frame: True
        board.run(0.5 + 0.3 * random.Random(trial).random())
        offs = board.can.bus_offs
        board.can.fault = lambda frame: False
        heard = len(board.frames)
        board.run(2.0)
        told = status(board)
        assert offs > 0
        assert len(board.frames) > heard + 60
        assert told["bus_off_count"] == board.can.bus_offs
        assert told["frames_dropped"] == board.can.aborted
        decoder, _ = reports(messages(board))
        assert decoder.statistics.damaged == decoder.statistics.refused == 0
        survived += sound(board, tap, 0) and told["missing"] == 0
    tell("bus-off", trials, survived)
    assert survived == trials


def test_nobody_on_the_bus() -> None:
    """Without acknowledgement the frames are dropped and counted, nothing waits; when somebody comes they arrive."""
    board = Board(image(*QUIET), seed=9)
    board.can.bus_bit_s = 0.0
    tap = Tap(board)
    board.run(4.0)
    assert board.frames == []
    board.can.bus_bit_s = 500_000.0
    board.run(3.0)
    told = status(board)
    assert told["frames_dropped"] == board.can.aborted > 30
    assert told["missing"] == 0
    assert sound(board, tap, 0)
    decoder, _ = reports(messages(board))
    assert decoder.statistics.damaged == 0


#: A set of corrected samples takes longer on a bus without listeners than its period.
STARVED = (
    "starved",
    "-DBOARD_REPORT_MS=2000 -DBOARD_GATE=0 -DAPP_CORRECTED_MS=100 -DBOARD_SAVE_PERIOD_S=5U",
    True,
    5.12,
    ("constant",),
)


def test_corrected_samples_starve_nothing() -> None:
    """Nobody on the bus, a corrected sample always due: reports and saves go on, and the module stays up."""
    board = Board(image(*STARVED), seed=13)
    board.run(6.0)
    board.can.bus_bit_s = 0.0
    board.run(1.0)
    saves, number = board.value("app.told.state_saves"), board.value("app.report_number")
    board.run(20.0)
    assert board.value("app.told.state_saves") > saves
    assert board.value("app.report_number") > number + 1
    assert sound(board, None, 0)


def test_random_serial_lines() -> None:
    """Random, truncated and overlong SLCAN lines: each is answered or ignored, the channel still opens, frames are
    whole."""
    lines = 100_000 if MANY > 1 else 500
    rng = random.Random(12)
    board = Board(image(*SERIAL), seed=12)
    board.usart.host_baud = 1e6
    tap = Tap(board)
    sent = 0
    while sent < lines:
        junk = bytearray()
        for _ in range(100):
            kind = rng.randrange(4)
            if kind == 0:
                junk += rng.randbytes(rng.randrange(12)) + b"\r"
            elif kind == 1:
                junk += bytes(rng.choice(b"CLOSVNvtTrRmMWF0123456789abcdef") for _ in range(rng.randrange(40))) + b"\r"
            elif kind == 2:
                junk += b"t2018" + bytes(rng.choice(b"0123456789ABCDEF") for _ in range(rng.randrange(16)))  # cut short
            else:
                junk += rng.choice((b"\r", b"C\r", b"S6\r", b"O\r", b"V\r", b"t1230\r", b"T000001230\r"))
            sent += 1
        board.usart.say(bytes(junk))
        board.run(len(junk) * 1e-5 + 0.01)
    board.usart.say(b"\rC\rS6\r\rO\r")
    board.run(0.3)
    board.text.clear()
    board.run(1.2)
    frames = [line for line in bytes(board.text).split(b"\r") if line.startswith(b"t200")]
    assert len(frames) >= 34
    assert all(len(line) == 21 for line in frames[1:-1])
    survived = sound(board, tap, 0)
    tell("random serial lines", sent, sent if survived else 0)
    assert survived


def test_a_slow_report_is_healthy() -> None:
    """An axis's report may take five minutes, which is ten times what the Cortex-M0 takes, and so may a frame. The
    answer is that of the image's own app_healthy(), called."""
    board = Board(image(*QUIET), seed=16)
    board.run(1.0)

    def healthy(what: str, since: str, age_s: float) -> bool:
        uc = board.machine.uc
        context = uc.context_save()
        poke = {what: 1, since: int(board.machine.now_us / 1e3 - 1e3 * age_s) % 2**32, "app.stage": 3}
        before = {name: bytes(uc.mem_read(*parts.place(board.elf, name))) for name in poke}
        for name, value in poke.items():
            address, size = parts.place(board.elf, name)
            uc.mem_write(address, value.to_bytes(size, "little"))
        back = board.machine.symbols["module_run"] & ~1
        uc.reg_write(parts.arm.UC_ARM_REG_R0, parts.place(board.elf, "app.port")[0])
        uc.reg_write(parts.arm.UC_ARM_REG_LR, back | 1)
        uc.emu_start(board.machine.symbols["app_healthy"] | 1, back)
        answer = bool(uc.reg_read(parts.arm.UC_ARM_REG_R0))
        for name, value in before.items():
            uc.mem_write(parts.place(board.elf, name)[0], value)
        uc.context_restore(context)
        return answer

    for stalled in (("app.imu.computing", "app.begun_ms"), ("app.refused", "app.refused_ms")):
        assert healthy(*stalled, 295.0)
        assert not healthy(*stalled, 305.0)
    assert healthy("app.stage", "app.begun_ms", 3000.0)
    board.run(1.0)
    assert sound(board, None, 0)


def test_watchdog_and_faults_are_told() -> None:
    """A main loop that is not healthy is reset by the watchdog within 9 s; a jump into nothing by the fault handler,
    with its address; either is told as the reset cause."""
    board = Board(image(*QUIET), seed=13)
    board.run(1.0)
    address, _ = parts.place(board.elf, "app.corrupt")
    board.machine.uc.mem_write(address, b"\x01")
    board.run(9.5)
    assert [cause for _, cause in board.machine.resets] == ["watchdog"]
    assert status(board)["reset_cause"] == 4
    board.run(0.2)
    board.machine.uc.reg_write(parts.arm.UC_ARM_REG_PC, 0x60000001)
    board.machine._asleep = False
    board.run(1.5)
    told = status(board)
    assert [cause for _, cause in board.machine.resets] == ["watchdog", "software"]
    assert told["reset_cause"] == 5
    assert told["fault_address"] == 0x60000000
    assert told["samples"] > 0
    tell("watchdog, fault", 2, 2)


@pytest.mark.parametrize("broken", ["crystal", "pll"])
def test_clock_falls_back(broken: str) -> None:
    """Without the crystal the internal oscillator serves, without the PLL at 16 MHz; telemetry still has the right bit
    rate."""
    board = Board(image(*QUIET), seed=14, clock_broken=broken)
    tap = Tap(board)
    board.run(2.5)
    assert status(board)["clock"] == 2
    assert board.machine.hclk_mhz == (168.0 if broken == "crystal" else 16.0)
    assert sound(board, tap, 0)


# ---------------------------------------------------------------------------------------------------------- saved state

SAVING = ("saving", "-DBOARD_REPORT_MS=500 -DBOARD_GATE=0 -DBOARD_SAVE_PERIOD_S=2U", True)
NEWEST, OLDER, REFUSED = 1, 2, 3


def saver(
    target: str, name: str = "saving", bank_hz: float = 0.01, retained: bytes | None = None
) -> parts.Board | parts.NrfBoard:
    """A board of a target that saves each 2 s."""
    elf = image(f"{name}-{target}", SAVING[1], True, bank_hz, target=target)
    return (Board if target == "stm32f405" else NrfBoard)(elf, seed=21, retained=retained)


def found(board: parts.Board | parts.NrfBoard) -> tuple[int, int, int]:
    """After a start: what was found, why one was refused, samples in the bank: before the sensor's first one, but the
    Cortex-M0 takes 0.2 s for three CRC of 20 KB."""
    board.run(0.05 if isinstance(board, Board) else 0.28)
    return (
        board.value("app.told.state_found"),
        board.value("app.told.state_refused"),
        board.value("app.imu.bank.counters.samples"),
    )


def two_saves(target: str) -> tuple[parts.Board | parts.NrfBoard, bytes, int, int, int]:
    """A board after two saves; what the flash held after the first, with the samples of either, and the first operation
    of the second."""
    board = saver(target)
    board.run(2.5)
    while board.value("app.told.state_saves") < 1:
        board.run(0.1)
    first = board.retained()
    samples = [board.value("app.imu.bank.counters.samples")]
    operations = board.flash.operations
    board.flash.keep_history = True
    while board.value("app.told.state_saves") < 2:
        before = board.value("app.imu.bank.counters.samples")
        board.run(0.005)
    samples.append(before)
    return board, first, samples[0], samples[1], operations


@pytest.mark.parametrize("target", TARGETS)
def test_power_cut_at_every_flash_operation_of_a_save(target: str) -> None:
    """A start after a cut anywhere in a save finds the state before it whole, or, once the header is complete, the new
    one. Short run: erases, the header, both ends of the payload and some between; SELFCAL_CAMPAIGN=2 or more: every
    operation."""
    board, flash, _, _, _ = two_saves(target)
    history = board.flash.history
    total = len(history)
    assert total > 5000
    after = flash
    truth: list[tuple[int, int, int]] = []
    for content in (flash, board.retained()):
        board.power_cycle(content)
        truth.append(found(board))
        assert truth[-1][:2] == (NEWEST, 0)
    assert truth[0][2] < truth[1][2]
    rng = random.Random(7)
    erases = sum(len(new) > 4 for _, _, new in history)
    between = rng.sample(range(erases, total), 10 if target == "stm32f405" else 3)
    some = {0, 1, erases - 1, erases, erases + 1, *range(total - 12, total), *between}
    chosen = range(total) if MANY > 1 else sorted(some)
    content = bytearray(after)
    done = trials = survived = 0
    for k in chosen:
        for address, _, new in history[done:k]:
            content[address - board.SLOTS : address - board.SLOTS + len(new)] = new
        done = k
        address, old, new = history[k]
        cut = half_erased(old, rng) if len(new) > 4 else half_programmed(old, new, rng)
        broken = bytearray(content)
        broken[address - board.SLOTS : address - board.SLOTS + len(new)] = cut
        board.power_cycle(bytes(broken))
        got = found(board)
        trials += 1
        survived += got == truth[0] or (got == truth[1] and k == total - 1 and cut == new)
    tell(f"power cut in a save, {target}", trials, survived, f"{total} operations a save, {erases} of them erases")
    assert survived == trials


@pytest.mark.parametrize("target", TARGETS)
def test_power_cut_while_running(target: str) -> None:
    """The same on the running machine: the cut ends the run, the next start goes on from the older state and saves
    again."""
    for k in some((0, 30, 500), 500 if target == "stm32f405" else 30):
        board, _, _, _, _ = two_saves(target)
        board.flash.cut_at = board.flash.operations + k
        board.run(4.0)
        assert board.machine.stopped == "power cut"
        board.power_cycle()
        outcome, refused, samples = found(board)
        assert (outcome, refused) == (NEWEST, 0)
        assert samples > 0
        board.run(4.5)
        assert board.value("app.told.state_saves") >= 1
        assert board.machine.violations == board.machine.faults == []


@pytest.mark.parametrize("target", TARGETS)
def test_damaged_and_foreign_states_are_refused_and_told(target: str) -> None:
    """A flipped bit in the newest: the older one is taken, and the next save overwrites the damaged one. In both: none
    is taken. Of another model: refused as foreign."""
    board, first, _, _, _ = two_saves(target)
    flash = bytearray(board.retained())
    newest = 1 if first[board.STRIDE] == 0xFF else 0
    flash[newest * board.STRIDE + 5000] ^= 4
    board.power_cycle(bytes(flash))
    outcome, refused, _ = found(board)
    assert (outcome, refused) == (OLDER, 7)
    erased = board.erases(newest)
    board.run(4.0)
    assert board.erases(newest) == erased + 1
    flash[(1 - newest) * board.STRIDE + 5000] ^= 4
    board.power_cycle(bytes(flash))
    assert found(board) == (REFUSED, 7, 0)
    if target == "stm32f405":
        board.run(1.0)
        assert status(board)["state_found"] == REFUSED
    other = saver(target, "other", 0.02, retained=first)
    assert found(other) == (REFUSED, 8, 0)


def test_a_power_cut_after_another_model_s_save() -> None:
    """Two saves, one of an image of another model over the first, the first image again, a cut in its next save: the
    state that it went on from is still there. The other model's was whole and the newest."""
    board, _, _, _, _ = two_saves("stm32f405")
    other = saver("stm32f405", "other", 0.02, retained=board.retained())
    assert found(other) == (REFUSED, 8, 0)
    while other.value("app.told.state_saves") < 1:
        other.run(0.1)
    board.power_cycle(other.retained())
    outcome, refused, samples = found(board)
    assert (outcome, refused) == (OLDER, 8)
    board.flash.cut_at = board.flash.operations + 500
    board.run(4.0)
    assert board.machine.stopped == "power cut"
    board.power_cycle()
    assert found(board) == (NEWEST, 0, samples)


@pytest.mark.parametrize("target", TARGETS)
def test_flash_that_refuses_is_told_and_loses_nothing(target: str) -> None:
    """An operation that the flash refuses voids the save: counted, the sensor goes on, and what was saved before
    stands. Of the first five operations of the header one that is not written spoils it."""
    for k in some((100, 5), 100 if target == "stm32f405" else 5):
        board, _, _, _, start = two_saves(target)
        board.flash.fail_at = board.flash.operations + (k if k == 100 else board.flash.operations - start - k)
        board.run(5.0)
        assert board.value("app.told.state_save_failures") == 1
        assert board.value("sensor.common.condition") == RUNNING
        before = board.value("sensor.common.counters.samples")
        board.run(1.5)  # a save may fall into it
        assert board.value("sensor.common.counters.samples") > before
        assert not board.machine.resets
        kept = board.retained()
        board.power_cycle(kept)
        assert found(board)[:2] == (NEWEST, 0)
