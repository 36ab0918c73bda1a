"""MPU-6050 behind its I2C: registers, FIFO, self-test, and what can go wrong with it.

Register map RM-MPU-6000A, revision 4.2: addresses, 4.1 to 4.5 self-test, 4.29 and 4.31 FIFO. A first byte that is
written is the register's number, which counts up with each byte, but for FIFO_R_W. A packet has what FIFO_EN names, in
the order of the registers. A full FIFO loses its oldest bytes, packet or not."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from .icm42688 import Clock, G, Sample

SELF_TEST_X, SMPLRT_DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG, FIFO_EN = 0x0D, 0x19, 0x1A, 0x1B, 0x1C, 0x23
INT_STATUS, ACCEL_XOUT_H, USER_CTRL, PWR_MGMT_1, FIFO_COUNTH, FIFO_R_W, ID = 0x3A, 0x3B, 0x6A, 0x6B, 0x72, 0x74, 0x75
FIFO_BYTES, RESET_US, GYRO_ON_US = 1024, 50_000.0, 30_000.0


class Mpu6050:
    """`source(k)`: the true readings of the k-th sample since power-on."""

    address = 0x68

    def __init__(self, machine: Clock, source: Callable[[int], Sample]) -> None:
        self.machine = machine
        self.source = source
        self.on_ready: Callable[[bool], None] = lambda level: None  # INT, which no driver here uses
        self.clock_error = 0.0  # of its own sample clock, relative
        self.temperature = 25.0
        #: Codes of the factory: gyro 5 bits each, accelerometer 5 bits each; 0: none. Its response over the one that
        #: they mean.
        self.codes = [14, 15, 13, 16, 17, 15]
        self.response = [1.0] * 6
        #: Every sample that went into the FIFO: index, time in us, the six integers.
        self.taken: list[tuple[int, float, tuple[int, ...]]] = []
        # what can be wrong
        self.connected = True
        self.dead = False
        self.refuse = 0  # bytes that it does not acknowledge, to come
        self.silent = False  # no sample more
        self.frozen = False  # the same readings for ever
        self.writes_fail: set[int] = set()
        self.identity = 0x68
        self.resets = 0
        self.index = self.shown = 0
        self.power_on()

    # --------------------------------------------------------------------------------------------------------- life

    def power_on(self) -> None:
        """Registers as delivered: asleep."""
        gyro, accel = self.codes[:3], self.codes[3:]
        trims = [(a >> 2) << 5 | g for g, a in zip(gyro, accel, strict=True)]
        trims.append((accel[0] & 3) << 4 | (accel[1] & 3) << 2 | accel[2] & 3)
        self.registers = dict.fromkeys((*range(25, 37), *range(55, 58), 104, USER_CTRL, 108), 0)
        self.registers |= {PWR_MGMT_1: 0x40} | {SELF_TEST_X + i: trim for i, trim in enumerate(trims)}
        self.fifo: deque[int] = deque()
        self.status = 0
        self.data = bytes(14)
        self.at: int | None = None
        self.wrote = False
        self.resets += 1
        self.booted_at = self.machine.time_us + RESET_US
        self.next_at = self.on_since = float("inf")

    def reset_line(self, level: bool) -> None:
        """It has none."""

    def select(self, low: bool) -> None:
        """It has none."""

    def exchange(self, out: int, mode: int, sck_hz: float, end_us: float, /) -> int:
        """It has no SPI."""
        raise AssertionError("an MPU-6050 has no SPI")

    def plug(self, connected: bool) -> None:
        """Unplugging takes the supply too."""
        if connected and not self.connected:
            self.power_on()
        self.connected = connected

    @property
    def period_us(self) -> float:
        """Of the samples; of a gyro of 1 kHz, which needs a band."""
        if self.registers[CONFIG] & 7 in (0, 7):
            self.machine.violations.append("MPU-6050: sampled at 8 kHz over I2C")
        return 1000.0 * (self.registers[SMPLRT_DIV] + 1) * (1.0 + self.clock_error)

    def advance(self) -> None:
        """Make the samples that are due."""
        if self.registers[PWR_MGMT_1] >> 6 & 1 or not self.connected or self.dead:
            self.next_at = float("inf")
            return
        if self.next_at == float("inf"):
            self.next_at = self.machine.time_us + self.period_us
        while self.next_at <= self.machine.time_us:
            self._sample(self.next_at)
            self.next_at += self.period_us

    def _tested(self, axis: int) -> float:
        """Response to the self-test, deg/s and m/s^2, where it is on."""
        gyro = axis < 3
        if not self.registers[GYRO_CONFIG if gyro else ACCEL_CONFIG] >> 7 - axis % 3 & 1:
            return 0.0
        code = self.codes[axis] or 10
        if gyro:
            return (-1.0 if axis == 1 else 1.0) * 25.0 * 1.046 ** (code - 1) * self.response[axis]
        trim: float = 0.34 * (0.92 / 0.34) ** ((code - 1) / 30.0)
        return trim * G * self.response[axis]

    def _sample(self, at_us: float) -> None:
        index = self.index
        self.index += 1
        if self.silent:
            return
        if not self.frozen:
            self.shown = index
        true = [value + self._tested(axis) for axis, value in enumerate(self.source(self.shown))]
        if at_us < self.on_since + GYRO_ON_US:
            true[:3] = [value + 200.0 for value in true[:3]]  # it has not spun up
        gyro_lsb = 131.0 / (1 << (self.registers[GYRO_CONFIG] >> 3 & 3))
        accel_lsb = 16384.0 / (1 << (self.registers[ACCEL_CONFIG] >> 3 & 3)) / G
        words = [_word(value * gyro_lsb) for value in true[:3]]
        accel = [_word(value * accel_lsb) for value in true[3:]]
        temperature = _word((self.temperature - 36.53) * 340.0)
        self.data = b"".join((word & 0xFFFF).to_bytes(2, "big") for word in (*accel, temperature, *words))
        self.status |= 0x01
        if not self.registers[USER_CTRL] >> 6 & 1 or self.registers[FIFO_EN] != 0xF8:
            return
        self.taken.append((index, at_us, (*words, *accel)))
        self.fifo.extend(self.data)
        while len(self.fifo) > FIFO_BYTES:
            self.fifo.popleft()
            self.status |= 0x10

    # ----------------------------------------------------------------------------------------------------------- I2C

    def begin(self, reading: bool) -> bool:
        """Its address."""
        if not self.connected or self.dead or self.machine.time_us < self.booted_at or self._refuses():
            return False
        self.wrote = False
        self.advance()
        return True

    def _refuses(self) -> bool:
        self.refuse = max(self.refuse - 1, 0) if (refused := self.refuse > 0) else 0
        return refused

    def put(self, byte: int) -> bool:
        """The register's number, then its content."""
        if self._refuses():
            return False
        if not self.wrote:
            self.at, self.wrote = byte, True
            return True
        self._write(self.at or 0, byte)
        self._count()
        return True

    def get(self) -> int:
        """The next register."""
        byte = self._read(self.at or 0)
        self._count()
        return byte

    def end(self) -> None:
        """A stop."""

    def _count(self) -> None:
        if self.at is not None and self.at != FIFO_R_W:
            self.at = (self.at + 1) & 0x7F

    def _read(self, place: int) -> int:
        if place == ID:
            return self.identity
        if place == INT_STATUS:
            status, self.status = self.status, 0
            return status
        if ACCEL_XOUT_H <= place < ACCEL_XOUT_H + 14:
            return self.data[place - ACCEL_XOUT_H]
        if place == FIFO_COUNTH:
            self.counted = len(self.fifo)
            return self.counted >> 8
        if place == FIFO_COUNTH + 1:
            return self.counted & 0xFF
        if place == FIFO_R_W:
            return self.fifo.popleft() if self.fifo else 0
        return self.registers.get(place, 0)

    def _write(self, place: int, byte: int) -> None:
        if place == PWR_MGMT_1 and byte >> 7:
            self.power_on()
        elif place == USER_CTRL and byte >> 2 & 1:
            self.fifo.clear()
            self.registers[USER_CTRL] = byte & ~0x04
        elif place in self.registers and place not in self.writes_fail and not SELF_TEST_X <= place < SELF_TEST_X + 4:
            if place == PWR_MGMT_1 and self.registers[place] >> 6 & 1 and not byte >> 6 & 1:
                self.on_since = self.machine.time_us
            if place in (SMPLRT_DIV, CONFIG):
                self.next_at = float("inf")
            self.registers[place] = byte


def _word(value: float) -> int:
    return max(-(1 << 15), min((1 << 15) - 1, round(value)))
