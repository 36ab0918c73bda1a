"""BMI088 at its pins: two chips with a clock, registers and a FIFO each, and what can go wrong with them.

Data sheet BST-BMI088-DS001. Of each chip a first byte with the top bit set begins a read, whose address counts up but
for FIFO_DATA; the accelerometer sends a byte of no meaning first, and takes SPI after a rise of its chip select. A
frame that is read in part comes again. The gyroscope's chip select is on the board's reset line."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from .icm42688 import Clock, G, Sample

ACC_TEMPERATURE, ACC_FIFO_LENGTH, ACC_FIFO_DATA, ACC_CONF, ACC_RANGE = 0x22, 0x24, 0x26, 0x40, 0x41
ACC_SELF_TEST, ACC_PWR_CONF, ACC_PWR_CTRL, ACC_SOFTRESET = 0x6D, 0x7C, 0x7D, 0x7E
GYRO_FIFO_STATUS, GYRO_RANGE, GYRO_BANDWIDTH, GYRO_SELF_TEST, GYRO_FIFO_CONFIG_1 = 0x0E, 0x0F, 0x10, 0x3C, 0x3E
GYRO_FIFO_DATA = 0x3F
ACCEL_HZ = {0x8: 100.0, 0x9: 200.0, 0xA: 400.0, 0xB: 800.0, 0xC: 1600.0}
GYRO_HZ = {0: 2000.0, 1: 2000.0, 2: 1000.0, 3: 400.0, 4: 200.0, 5: 100.0, 6: 200.0, 7: 100.0}


class Chip:
    """What both have. A child gives power_on(), period_us, sample(), read_register(), write_register()."""

    name = ""
    #: Bytes of no meaning before those of a read.
    dummies = 0
    fifo_data = 0

    def __init__(self, machine: Clock, source: Callable[[int], Sample]) -> None:
        self.machine = machine
        self.source = source
        self.clock_error = 0.0  # relative
        #: Every reading that went into the FIFO: index, time in us, three integers.
        self.taken: list[tuple[int, float, tuple[int, ...]]] = []
        # what can be wrong
        self.dead = False
        self.silent = False  # no sample more
        self.frozen = False  # the same readings for ever
        self.writes_fail: set[int] = set()
        self.index = self.shown = 0
        self.power_on()

    def power_on(self) -> None:
        """Registers as delivered."""
        self.registers: dict[int, int] = {}
        self.fifo: deque[bytes] = deque()
        self.begun = 0  # bytes that were read of the first frame
        self.newest: tuple[int, ...] = (0, 0, 0)
        self.next_at = float("inf")
        self.ready_at = 0.0
        self.selected = False
        self.deselect()

    def deselect(self) -> None:
        """The end of an access."""
        self.begun = 0
        self.address: int | None = None
        self.reading = False
        self.skip = 0

    @property
    def on(self) -> bool:
        """Whether it measures."""
        return not self.dead

    @property
    def period_us(self) -> float:
        """Of its samples."""
        raise NotImplementedError

    def sample(self, at_us: float, index: int) -> None:
        """One is due."""
        raise NotImplementedError

    def read_register(self, place: int) -> int:
        """But for FIFO_DATA."""
        return self.registers.get(place, 0)

    def write_register(self, place: int, byte: int) -> None:
        """Any."""
        if place in self.registers and place not in self.writes_fail:
            self.registers[place] = byte

    def advance(self) -> None:
        """Make the samples that are due."""
        if not self.on:
            self.next_at = float("inf")
            return
        if self.next_at == float("inf"):
            self.next_at = self.machine.time_us + self.period_us
        while self.next_at <= self.machine.time_us:
            index = self.index
            self.index += 1
            if not self.frozen:
                self.shown = index
            if not self.silent:
                self.sample(self.next_at, index)
            self.next_at += self.period_us

    def exchange(self, out: int) -> int:
        """A byte each way."""
        if self.dead or self.machine.time_us < self.ready_at:
            return 0xFF
        self.advance()
        if self.address is None:
            self.reading, self.address, self.skip = bool(out >> 7), out & 0x7F, self.dummies
            return 0xFF
        if self.reading and self.skip > 0:
            self.skip -= 1
            return 0xFF
        place = self.address
        if place != self.fifo_data:
            self.address = (place + 1) & 0x7F
        if not self.reading:
            self.write_register(place, out)
            return 0xFF
        return self._fifo_byte() if place == self.fifo_data else self.read_register(place)

    def _fifo_byte(self) -> int:
        if not self.fifo:
            return 0x80
        byte = self.fifo[0][self.begun]
        self.begun += 1
        if self.begun == len(self.fifo[0]):
            self.fifo.popleft()
            self.begun = 0
        return byte


class Accelerometer(Chip):
    """It is asleep at first, and takes I2C until its select has risen once."""

    name, dummies, fifo_data = "accelerometer", 1, ACC_FIFO_DATA

    def __init__(self, machine: Clock, source: Callable[[int], Sample]) -> None:
        self.temperature = 25.0
        self.response = (1.3, 1.2, 0.7)  # difference of a self-test, g
        self.identity = 0x1E
        super().__init__(machine, source)

    def power_on(self) -> None:
        """Asleep."""
        super().power_on()
        self.registers = {
            ACC_CONF: 0xA8, ACC_RANGE: 1, 0x48: 2, 0x49: 0x10, ACC_SELF_TEST: 0, ACC_PWR_CONF: 3, ACC_PWR_CTRL: 0,
        }  # fmt: skip
        self.spi = False
        self.ready_at = self.machine.time_us + 1000.0

    def deselect(self) -> None:
        """The first one makes it take SPI."""
        super().deselect()
        self.spi = True

    def exchange(self, out: int) -> int:
        """A byte each way."""
        return super().exchange(out) if self.spi else 0xFF

    @property
    def on(self) -> bool:
        """Awake and switched on."""
        return not self.dead and self.registers[ACC_PWR_CONF] == 0 and self.registers[ACC_PWR_CTRL] == 4

    @property
    def period_us(self) -> float:
        """By ACC_CONF."""
        return 1e6 / ACCEL_HZ[self.registers[ACC_CONF] & 15] * (1.0 + self.clock_error)

    def sample(self, at_us: float, index: int) -> None:
        """Into the data registers and the FIFO, which loses the oldest frame if it is full."""
        test = {0x0D: 0.5, 0x09: -0.5}.get(self.registers[ACC_SELF_TEST], 0.0)
        lsb = 3.0 * (1 << self.registers[ACC_RANGE]) * G / 32768.0
        true = self.source(self.shown)[3:]
        self.newest = tuple(
            _word((value + test * extra * G) / lsb) for value, extra in zip(true, self.response, strict=True)
        )
        if self.registers[0x49] != 0x50:
            return
        self.taken.append((index, at_us, self.newest))
        self.fifo.append(b"\x84" + _bytes(self.newest))
        if 7 * len(self.fifo) > 1024:
            self.fifo.popleft()

    def read_register(self, place: int) -> int:
        """Data, temperature, FIFO_LENGTH; the rest."""
        if place == 0:
            return self.identity
        if 0x12 <= place < 0x18:
            return _bytes(self.newest)[place - 0x12]
        if place in (ACC_TEMPERATURE, ACC_TEMPERATURE + 1):
            value = round((self.temperature - 23.0) * 8.0) & 0x7FF
            return value >> 3 if place == ACC_TEMPERATURE else (value & 7) << 5
        if place in (ACC_FIFO_LENGTH, ACC_FIFO_LENGTH + 1):
            return sum(map(len, self.fifo)) >> 8 * (place - ACC_FIFO_LENGTH) & 0xFF
        return super().read_register(place)

    def write_register(self, place: int, byte: int) -> None:
        """A reset; the rest. A change of ACC_CONF leaves a frame that says so."""
        if place == ACC_SOFTRESET and byte == 0xB6:
            self.power_on()
            return
        if place == ACC_CONF and byte != self.registers[place]:
            self.next_at = float("inf")
            if self.registers[0x49] == 0x50:
                self.fifo.append(b"\x48\x02")
        super().write_register(place, byte)


class Gyroscope(Chip):
    """It measures from power-on."""

    name, fifo_data = "gyroscope", GYRO_FIFO_DATA

    def __init__(self, machine: Clock, source: Callable[[int], Sample]) -> None:
        self.test_fails = False
        self.identity = 0x0F
        super().__init__(machine, source)

    def power_on(self) -> None:
        """Registers as delivered."""
        super().power_on()
        self.registers = {GYRO_RANGE: 0, GYRO_BANDWIDTH: 0x80, 0x3D: 0, GYRO_FIFO_CONFIG_1: 0}
        self.overrun = False
        self.tested_at = float("inf")
        self.ready_at = self.machine.time_us + 30_000.0

    @property
    def period_us(self) -> float:
        """By GYRO_BANDWIDTH."""
        return 1e6 / GYRO_HZ[self.registers[GYRO_BANDWIDTH] & 7] * (1.0 + self.clock_error)

    def sample(self, at_us: float, index: int) -> None:
        """Into the FIFO, of 100 frames."""
        lsb = 2000.0 / (1 << self.registers[GYRO_RANGE]) / 32767.0
        self.newest = tuple(_word(value / lsb) for value in self.source(self.shown)[:3])
        if self.registers[GYRO_FIFO_CONFIG_1] != 0x80:
            return
        self.taken.append((index, at_us, self.newest))
        self.fifo.append(_bytes(self.newest))
        if len(self.fifo) > 100:
            self.fifo.popleft()
            self.overrun = True

    def read_register(self, place: int) -> int:
        """FIFO_STATUS, the self-test's outcome; the rest."""
        if place == 0:
            return self.identity
        if place == GYRO_FIFO_STATUS:
            return self.overrun << 7 | len(self.fifo)
        if place == GYRO_SELF_TEST:
            return (self.machine.time_us > self.tested_at) << 1 | self.test_fails << 2 | 1 << 4
        return super().read_register(place)

    def write_register(self, place: int, byte: int) -> None:
        """A reset, the self-test, FIFO_CONFIG_1, which empties the FIFO; the rest."""
        if place == 0x14 and byte == 0xB6:
            self.power_on()
        elif place == GYRO_SELF_TEST and byte & 1:
            self.tested_at = self.machine.time_us + 20_000.0
        else:
            if place == GYRO_FIFO_CONFIG_1:
                self.fifo.clear()
                self.overrun = False
            if place == GYRO_BANDWIDTH:
                byte |= 0x80
                self.next_at = float("inf")
            super().write_register(place, byte)

    def _fifo_byte(self) -> int:
        if not self.fifo:
            self.begun ^= 1
            return 0x00 if self.begun else 0x80
        return super()._fifo_byte()


class Bmi088:
    """`source(k)`: the true readings of the k-th sample of each chip, rates of the one and accelerations of the
    other."""

    def __init__(self, machine: Clock, source: Callable[[int], Sample]) -> None:
        self.machine = machine
        self.accel, self.gyro = Accelerometer(machine, source), Gyroscope(machine, source)
        self.on_ready: Callable[[bool], None] = lambda level: None  # INT1 and INT3, which no driver here uses
        self.connected = True
        self.flip = 0.0  # chance of a wrong bit in each byte read
        self.flipped = 0

    @property
    def chips(self) -> tuple[Chip, Chip]:
        """In the order of their selects."""
        return self.accel, self.gyro

    def power_on(self) -> None:
        """Of both."""
        for chip in self.chips:
            chip.power_on()

    def plug(self, connected: bool) -> None:
        """Unplugging takes the supply too."""
        if connected and not self.connected:
            self.power_on()
        self.connected = connected

    def choose(self, chip: int, low: bool) -> None:
        """A chip select."""
        of = self.chips[chip]
        if of.selected and not low:
            of.deselect()
        of.selected = low

    def select(self, low: bool) -> None:
        """The accelerometer's."""
        self.choose(0, low)

    def reset_line(self, level: bool) -> None:
        """The gyroscope's select."""
        self.choose(1, not level)

    def exchange(self, out: int, mode: int = 3, sck_hz: float = 1e6, end_us: float = 0.0, /) -> int:
        """A byte each way."""
        chosen = [chip for chip in self.chips if chip.selected]
        if len(chosen) > 1:
            self.machine.violations.append("BMI088: both chips selected")
        if not self.connected or len(chosen) != 1:
            return 0xFF
        if mode not in (0, 3) or sck_hz > 10e6:
            self.machine.violations.append(f"BMI088: SPI mode {mode}, SCK {sck_hz:g} Hz")
        byte = chosen[0].exchange(out)
        if self.flip > 0.0 and self.machine.random.random() < self.flip:
            byte ^= 1 << self.machine.random.randrange(8)
            self.flipped += 1
        return byte


def _word(value: float) -> int:
    return max(-(1 << 15) + 1, min((1 << 15) - 1, round(value)))


def _bytes(words: tuple[int, ...]) -> bytes:
    return b"".join((word & 0xFFFF).to_bytes(2, "little") for word in words)
