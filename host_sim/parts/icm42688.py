"""ICM-42688-P at its pins: SPI bytes, registers by bank, FIFO packets, self-test, and what can go wrong with it.

Data sheet DS-000347: FIFO, serial interface, register map. Limits and formula of the self-test, and the timestamp's
unit, which is the PLL's, come from the maker's own driver. A first byte with the top bit set begins a read. Its other
bits are the address, which counts up, but for FIFO_DATA. REG_BANK_SEL is in every bank.
A packet of 16 bytes has a header, six words of 16 bits (accelerometer first), a temperature of 8 bits and a timestamp;
one of 20 bytes has a temperature of 16 bits and three bytes of low bits at its end, ranges of 2000 deg/s and 16 g
whatever is set, 19 bits of a rate and 18 of an acceleration."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from typing import Protocol

WHO_AM_I = 0x47
G = 9.80665
FIFO_BYTES = 2048
DEVICE_CONFIG, FIFO_CONFIG, INT_STATUS, FIFO_COUNTH, FIFO_COUNTL, FIFO_DATA = 0x11, 0x16, 0x2D, 0x2E, 0x2F, 0x30
SIGNAL_PATH_RESET, INTF_CONFIG0, PWR_MGMT0, GYRO_CONFIG0, ACCEL_CONFIG0 = 0x4B, 0x4C, 0x4E, 0x4F, 0x50
TMST_CONFIG, FIFO_CONFIG1, FIFO_LOST, SELF_TEST_CONFIG, ID, BANK_SEL = 0x54, 0x5F, 0x6C, 0x70, 0x75, 0x76
#: Registers as delivered, by bank and address.
DELIVERED = {
    (0, DEVICE_CONFIG): 0, (0, 0x14): 0, (0, FIFO_CONFIG): 0, (0, SIGNAL_PATH_RESET): 0, (0, INTF_CONFIG0): 0x30,
    (0, 0x4D): 0x91, (0, PWR_MGMT0): 0, (0, GYRO_CONFIG0): 6, (0, ACCEL_CONFIG0): 6, (0, 0x51): 0x16, (0, 0x52): 0x11,
    (0, 0x53): 0x0D, (0, TMST_CONFIG): 0x23, (0, FIFO_CONFIG1): 0, (0, 0x60): 0, (0, 0x61): 0, (0, 0x63): 0,
    (0, 0x64): 0x10, (0, 0x65): 0x10, (0, SELF_TEST_CONFIG): 0, **{(4, address): 0 for address in range(0x77, 0x80)},
}  # fmt: skip
#: Addresses that a program reads and cannot write.
READ_ONLY = {(0, ID), (0, INT_STATUS), (0, FIFO_COUNTH), (0, FIFO_COUNTL), (0, FIFO_DATA), (0, FIFO_LOST), (0, 0x6D)}
#: ODR codes of GYRO_CONFIG0 and ACCEL_CONFIG0, Hz.
RATES = {3: 8e3, 4: 4e3, 5: 2e3, 6: 1e3, 7: 200.0, 8: 100.0, 9: 50.0, 10: 25.0, 11: 12.5, 15: 500.0}
RESET_US, GYRO_ON_US = 1000.0, 30_000.0
#: True readings of one sample: gx gy gz in deg/s, ax ay az in m/s^2.
Sample = tuple[float, float, float, float, float, float]


class Clock(Protocol):
    """What the part takes of a machine."""

    random: random.Random
    violations: list[str]

    @property
    def time_us(self) -> float:
        """Since start."""


class Icm42688:
    """`source(k)`: the true readings of the k-th sample since power-on."""

    def __init__(self, machine: Clock, source: Callable[[int], Sample]) -> None:
        self.machine = machine
        self.source = source
        self.on_ready: Callable[[bool], None] = lambda level: None  # INT1, which no driver here uses
        self.clock_error = 0.0  # of its own sample clock, relative
        self.tick_us = 32.0 / 30.0  # of its timestamps
        self.temperature = 25.0
        #: Response of a self-test, deg/s and m/s^2, and the codes of it in the factory's memory; 0: none.
        self.response: Sample = (90.0, 95.0, 100.0, 4.0, 4.5, 5.0)
        self.codes = [150, 152, 154, 96, 110, 122]
        #: Every sample that went into the FIFO in 20 bits: index, time in us, rates and accelerations as integers.
        self.taken: list[tuple[int, float, tuple[int, ...]]] = []
        # what can be wrong
        self.connected = True
        self.dead = False
        self.floating_high = True  # its output's line, when it is not there
        self.silent = False  # no packet more
        self.frozen = False  # the same readings for ever
        self.stale = False  # packets with an old timestamp, readings as before
        self.writes_fail: set[tuple[int, int]] = set()
        self.flip = 0.0  # chance of a wrong bit in each byte read
        self.flipped = 0
        self.identity = WHO_AM_I
        self.resets = self.lost = 0
        self.index = self.shown = 0
        self.power_on()

    # --------------------------------------------------------------------------------------------------------- life

    def power_on(self) -> None:
        """Registers as delivered."""
        self._boot()

    def reset_line(self, level: bool) -> None:
        """It has none."""

    def plug(self, connected: bool) -> None:
        """Unplugging takes the supply too."""
        if connected and not self.connected:
            self.power_on()
        self.connected = connected

    def _boot(self) -> None:
        self.registers = dict(DELIVERED)
        self.registers |= {(1, 0x5F + i): code for i, code in enumerate(self.codes[:3])}
        self.registers |= {(2, 0x3B + i): code for i, code in enumerate(self.codes[3:])}
        self.bank = 0
        self.status = 0x10  # reset done
        self.fifo: deque[bytes] = deque()
        self.read_of_packet = self.latched = 0
        self.newest = b""
        self.lost = 0
        self.selected = False
        self.address: int | None = None
        self.reading = False
        self.booted_at = self.machine.time_us + RESET_US
        self.resets += 1
        self.next_at = float("inf")
        self.on_since = float("inf")
        self.started_at = self.machine.time_us

    @property
    def listening(self) -> bool:
        """Whether it answers."""
        return self.connected and not self.dead and self.machine.time_us >= self.booted_at

    @property
    def rate_hz(self) -> float:
        """Of the gyro."""
        return RATES.get(self.registers[0, GYRO_CONFIG0] & 15, 1e3)

    @property
    def period_us(self) -> float:
        """Of the samples."""
        return 1e6 / self.rate_hz * (1.0 + self.clock_error)

    def advance(self) -> None:
        """Make the samples that are due."""
        if self.registers[0, PWR_MGMT0] & 15 != 15 or not self.connected or self.dead:
            self.next_at = float("inf")
            return
        if self.next_at == float("inf"):
            self.next_at = self.machine.time_us + self.period_us
        while self.next_at <= self.machine.time_us:
            self._sample(self.next_at)
            self.next_at += self.period_us

    # ---------------------------------------------------------------------------------------------------------- FIFO

    def _offset(self, axis: int) -> float:
        """What the offset registers of bank 4 add: 1/32 deg/s and 0.5 mg a step, 12 bits."""
        low, high, shift = (
            (0x77, 0x78, 0), (0x79, 0x78, 4), (0x7A, 0x7B, 0), (0x7C, 0x7B, 4), (0x7D, 0x7E, 0), (0x7F, 0x7E, 4),
        )[axis]  # fmt: skip
        value = self.registers[4, low] | (self.registers[4, high] >> shift & 15) << 8
        return (value - (value >> 11 << 12)) * (1.0 / 32.0 if axis < 3 else 0.5e-3 * G)

    def _sample(self, at_us: float) -> None:
        index = self.index
        self.index += 1
        self.status |= 0x08
        if self.silent or self.registers[0, FIFO_CONFIG] >> 6 == 0:
            return
        if (self.registers[0, GYRO_CONFIG0] ^ self.registers[0, ACCEL_CONFIG0]) & 15:
            self.machine.violations.append("ICM-42688-P: two rates in one FIFO")
        if not self.frozen:
            self.shown = index
        true = list(self.source(self.shown))
        for axis in range(6):
            tested = self.registers[0, SELF_TEST_CONFIG] >> axis & 1
            powered = axis < 3 or self.registers[0, SELF_TEST_CONFIG] >> 6 & 1
            if axis < 3 and at_us < self.on_since + GYRO_ON_US:
                true[axis] += 500.0  # it has not spun up
            true[axis] += self._offset(axis) + (self.response[axis] if tested and powered else 0.0)
        stamp = int((at_us - self.started_at) / self.tick_us) & 0xFFFF
        setting = self.registers[0, FIFO_CONFIG1]
        if setting & 0x1F == 0x1F:
            packet = self._packet_of_20(index, at_us, true, stamp)
        elif setting & 0x1F == 0x0F:
            packet = self._packet_of_16(true, stamp)
        else:
            return
        if self.stale and self.newest:
            packet = self.newest
        self.newest = packet
        if (len(self.fifo) + 1) * len(packet) > FIFO_BYTES:
            self.status |= 0x02
            self.lost = min(self.lost + 1, 0xFFFF)
            if self.registers[0, FIFO_CONFIG] >> 6 != 1:
                return  # stop on full
            self.fifo.popleft()
            self.read_of_packet = 0
        self.fifo.append(packet)

    def _packet_of_20(self, index: int, at_us: float, true: list[float], stamp: int) -> bytes:
        gyro = [2 * _rounded(value * 2**18 / 2000.0, 18) for value in true[:3]]
        accel = [4 * _rounded(value / G * 2**17 / 16.0, 17) for value in true[3:]]
        self.taken.append((index, at_us, (*gyro, *accel)))
        words = [value & 0xFFFFF for value in (*accel, *gyro)]
        temperature = _rounded((self.temperature - 25.0) * 132.48, 15) & 0xFFFF
        return bytes(
            [0x78, *(byte for word in words for byte in (word >> 12, word >> 4 & 0xFF)), temperature >> 8]
            + [temperature & 0xFF, stamp >> 8, stamp & 0xFF]
            + [(a & 15) << 4 | g & 15 for a, g in zip(words[:3], words[3:], strict=True)]
        )

    def _packet_of_16(self, true: list[float], stamp: int) -> bytes:
        gyro_range = 2000.0 / (1 << (self.registers[0, GYRO_CONFIG0] >> 5))
        accel_range = 16.0 / (1 << (self.registers[0, ACCEL_CONFIG0] >> 5))
        words = [
            *(_rounded(value / G * 2**15 / accel_range, 15) for value in true[3:]),
            *(_rounded(value * 2**15 / gyro_range, 15) for value in true[:3]),
        ]
        temperature = _rounded((self.temperature - 25.0) * 2.07, 7) & 0xFF
        bytes_of = [byte for word in words for byte in (word >> 8 & 0xFF, word & 0xFF)]
        return bytes([0x68, *bytes_of, temperature, stamp >> 8, stamp & 0xFF])

    def _fifo_byte(self) -> int:
        if not self.fifo:
            return 0xFF
        packet = self.fifo[0]
        value = packet[self.read_of_packet]
        self.read_of_packet += 1
        if self.read_of_packet == len(packet):
            self.fifo.popleft()
            self.read_of_packet = 0
        return value

    def fifo_count(self) -> int:
        """Bytes, or packets where INTF_CONFIG0 has FIFO_COUNT_REC."""
        if self.registers[0, INTF_CONFIG0] >> 6 & 1:
            return len(self.fifo)
        return sum(map(len, self.fifo)) - self.read_of_packet

    # ----------------------------------------------------------------------------------------------------------- SPI

    def select(self, low: bool) -> None:
        """Chip select. Its rise ends an access: a packet that was read in part begins anew."""
        self.selected = low
        self.address = None
        if not low and not self.registers[0, FIFO_CONFIG1] >> 6 & 1:
            self.read_of_packet = 0

    def exchange(self, out: int, mode: int = 0, sck_hz: float = 1e6, end_us: float = 0.0) -> int:
        """A byte each way; `mode` is the SPI mode of the master."""
        if not self.listening or not self.selected:
            return 0xFF if self.floating_high else 0x00
        if mode not in (0, 3):
            self.machine.violations.append(f"ICM-42688-P: SPI mode {mode}")
        if sck_hz > 24e6:
            self.machine.violations.append(f"ICM-42688-P: SCK {sck_hz:g} Hz")
        self.advance()
        if self.address is None:
            self.reading, self.address = bool(out >> 7), out & 0x7F
            return 0xFF if self.floating_high else 0x00
        address = self.address
        if address != FIFO_DATA:
            self.address = (address + 1) & 0x7F
        if not self.reading:
            self._write(address, out)
            return 0x00
        return self._noisy(self._read(address))

    def _noisy(self, byte: int) -> int:
        if self.flip > 0.0 and self.machine.random.random() < self.flip:
            byte ^= 1 << self.machine.random.randrange(8)
            self.flipped += 1
        return byte

    def _read(self, address: int) -> int:
        if address == BANK_SEL:
            return self.bank
        if self.bank == 0:
            if address == ID:
                return self.identity
            if address == INT_STATUS:
                status, self.status = self.status, 0
                return status
            if address in (FIFO_COUNTH, FIFO_COUNTL):
                if address == FIFO_COUNTH:
                    self.latched = self.fifo_count()
                return self.latched >> 8 if address == FIFO_COUNTH else self.latched & 0xFF
            if address == FIFO_DATA:
                return self._fifo_byte()
            if address in (FIFO_LOST, FIFO_LOST + 1):
                return self.lost >> 8 * (address - FIFO_LOST) & 0xFF
        return self.registers.get((self.bank, address), 0)

    def _write(self, address: int, byte: int) -> None:
        place = (self.bank, address)
        if address == BANK_SEL:
            self.bank = byte & 7
        elif place == (0, DEVICE_CONFIG) and byte & 1:
            self._boot()
        elif place == (0, SIGNAL_PATH_RESET):
            if byte & 2:
                self.fifo.clear()
                self.read_of_packet = 0
        elif place in self.registers and place not in READ_ONLY and place not in self.writes_fail:
            if self.bank in (1, 2) and place[1] >= 0x3B:
                return  # the factory's
            if place == (0, PWR_MGMT0) and byte & 12 == 12 and self.registers[place] & 12 != 12:
                self.on_since = self.machine.time_us
            if place in ((0, GYRO_CONFIG0), (0, ACCEL_CONFIG0)) and byte & 15 != self.registers[place] & 15:
                self.next_at = float("inf")  # its divider begins anew
            self.registers[place] = byte


def _rounded(value: float, bits: int) -> int:
    """Within `bits` and a sign."""
    return max(-(1 << bits) + 1, min((1 << bits) - 1, round(value)))
