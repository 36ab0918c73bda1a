"""ADIS16405 at its pins: SPI frames, registers, data-ready, self-test, and what can go wrong with it.

Data sheet of the ADIS16400/ADIS16405: serial interface, tables 8 to 22. Reads are pipelined: the answer to a frame
comes in the next one. A burst is the frame 0x3E00 and then 12 words with chip select low throughout. ND is set in an
output register when a sample is written to it and cleared when it is read; EA is set in all while DIAG_STAT has a bit
set. XGYRO_OFF to ZACCL_OFF are added to the readings. With a negative XGYRO_OFF bursts lose the sign bit of negative x
rates, a known anomaly of the part."""

from __future__ import annotations

from collections.abc import Callable

from .machine import Event, Machine

PRODUCT = 16405
OUTPUTS = range(0x02, 0x1A, 2)  # supply, 3 gyro, 3 accel, 3 magn, temperature, aux
XGYRO_OUT = 0x04
BOOT_US, RESET_US, SELF_TEST_US = 220_000.0, 170_000.0, 20_000.0
BASE_HZ = (1638.4, 1e3 / 18.92)
#: True readings of one sample: gx gy gz ax ay az, LSB of 0.05 deg/s and 3.33 mg; rounded as they are read out.
Sample = tuple[float, float, float, float, float, float]
#: Offset registers: their bits, and their LSB in those of the output (0.0125 deg/s, 3.33 mg).
OFFSETS = {0x1A + 2 * channel: (13, 0.25) if channel < 3 else (12, 1.0) for channel in range(6)}


class Adis16405:
    """`source(k)`: the true readings of the k-th sample since power-on. `on_ready(level)`: its data-ready line."""

    def __init__(self, machine: Machine, source: Callable[[int], Sample]) -> None:
        self.machine = machine
        self.source = source
        self.on_ready: Callable[[bool], None] = lambda level: None
        self.clock_error = 0.0  # of its own sample clock, relative
        self.jitter = 0.0  # rms of each of its periods, relative
        self.supply = 2068  # LSB of 2.418 mV: 5.0 V
        #: Every sample it made: index, time in us, readings as read out.
        self.taken: list[tuple[int, float, tuple[int, ...]]] = []
        self.factory = dict.fromkeys(OFFSETS, 0)  # offset registers as its flash has them
        self.writes_fail = False  # offset registers keep what they hold
        self.read_twice: list[int] = []  # indices of the samples that two whole bursts have read
        # what can be wrong
        self.connected = True
        self.floating_high = True  # its output's line, when it is not there
        self.frozen = False  # the same readings for ever
        self.silent = False  # no data-ready
        self.dead = False  # nothing at all
        self.fail_self_test = 0  # bits of DIAG_STAT that a self-test sets
        self.trouble = 0  # bits of DIAG_STAT that set themselves at each sample
        self.deaf = 0  # reset commands that it will miss
        self.reset_open = False  # its reset line is not wired
        self.lose_sign: Callable[[int], bool] = lambda k: False  # the known anomaly, for sample k
        self.stale: Callable[[int], bool] = lambda k: False  # data-ready without new data
        self.product = PRODUCT
        self._read_once = -1
        # statistics
        self.frames = self.bursts = self.resets = 0
        self.reads: dict[int, int] = {}  # of registers, by address
        self.made_with: list[tuple[int, int]] = []  # SMPL_PRD and SENS_AVG of each of `taken`
        self.index = 0
        self._event: Event | None = None
        self.power_on()

    # --------------------------------------------------------------------------------------------------------------
    # life

    def power_on(self) -> None:
        """Registers as delivered; ready after 220 ms."""
        self._boot(BOOT_US)

    def reset(self) -> None:
        """By its line, by command, or by a spike: ready after 170 ms."""
        self._boot(RESET_US)

    def plug(self, connected: bool) -> None:
        """Unplugging takes the supply too."""
        if connected and not self.connected:
            self.connected = True
            self.power_on()
        elif not connected:
            self.connected = False
            self._stop()

    def reset_line(self, level: bool) -> None:
        """Low holds it in reset."""
        if self.reset_open:
            return
        if not level:
            self._stop()
            self.booted_at = float("inf")
        elif self.booted_at == float("inf"):
            self.reset()

    def _stop(self) -> None:
        if self._event is not None:
            self._event.cancel()
            self._event = None

    def _boot(self, delay_us: float) -> None:
        self._stop()
        self.registers = {0x34: 0x0006, 0x36: 0x0001, 0x38: 0x0402, 0x3C: 0, 0x40: 0, 0x48: 0, 0x56: self.product}
        self.registers |= self.factory
        self.half: int | None = None  # the first byte of a frame
        self.out = dict.fromkeys(OUTPUTS, 0)
        self.new = dict.fromkeys(OUTPUTS, False)
        self.answer = 0
        self.burst_at: int | None = None
        self.selected = False
        self.frame_end = -1e9
        self.resets += 1
        self.booted_at = self.machine.time_us + delay_us
        self._event = self.machine.at(delay_us + self.period_us(), self._sample)

    def _offset(self, address: int) -> float:
        """What a register adds, in LSB of the output."""
        bits, lsb = OFFSETS[address]
        value = self.registers[address] & (1 << bits) - 1
        return (value - (value >> bits - 1 << bits)) * lsb

    def period_us(self) -> float:
        """SMPL_PRD, table 17."""
        period = self.registers[0x36]
        return 1e6 * ((period & 0x7F) + 1) / BASE_HZ[period >> 7 & 1] * (1.0 + self.clock_error)

    def _sample(self) -> None:
        jitter = 1.0 + max(-0.9, self.jitter * self.machine.random.gauss(0.0, 1.0)) if self.jitter else 1.0
        self._event = self.machine.at(self.period_us() * jitter, self._sample)
        index = self.index
        self.index += 1
        if self.dead or self.registers[0x34] >> 10 & 1:
            return
        if not self.stale(index):
            if not self.frozen:
                sample = tuple(
                    round(value + self._offset(address))
                    for value, address in zip(self.source(index), OFFSETS, strict=True)
                )
                self.taken.append((index, self.machine.time_us, sample))
                self.made_with.append((self.registers[0x36], self.registers[0x38]))
                words = [self.supply, *sample, 0, 0, 0, 0, 0]
                for address, word in zip(OUTPUTS, words, strict=True):
                    self.out[address] = word & 0x3FFF
                if self.lose_sign(index) or self._offset(0x1A) < 0:
                    self.out[XGYRO_OUT] &= 0x1FFF
            self.new = dict.fromkeys(OUTPUTS, True)
        self.registers[0x3C] |= self.trouble
        # Data-ready: MSC_CTRL 2 on, 1 polarity, 0 line (only DIO1 is wired); a pulse of some 200 us.
        if self.registers[0x34] & 5 == 4 and not self.silent and self.connected:
            active = bool(self.registers[0x34] >> 1 & 1)
            self.on_ready(active)
            self.machine.at(200.0, lambda: self.on_ready(not active))

    # ---------------------------------------------------------------------------------------------------------------
    # SPI

    def select(self, low: bool) -> None:
        """Chip select. Its rise ends a burst."""
        stall_us = 75.0 if self.slow else 9.0
        if low and not self.selected and self.machine.time_us - self.frame_end < stall_us and self.listening:
            self.machine.violations.append(f"ADIS16405: less than {stall_us:g} us between frames")
        self.selected = low
        self.burst_at = None
        self.half = None

    @property
    def slow(self) -> bool:
        """Timing specifications: other limits of SPI with SMPL_PRD of 0x0A and more."""
        return self.registers[0x36] & 0xFF >= 0x0A

    @property
    def listening(self) -> bool:
        """Whether it answers."""
        return self.connected and not self.dead and self.machine.time_us >= self.booted_at

    def exchange(self, byte: int, mode: int, sck_hz: float, end_us: float) -> int:
        """A byte each way, the last bit at `end_us`; two make a frame."""
        if self.half is None:
            self.half, self.low = byte, self._shifting_out()
            return self.low >> 8
        self._frame(self.half << 8 | byte, mode, sck_hz, end_us)
        self.half = None
        return self.low & 0xFF

    def _frame(self, out: int, mode: int, sck_hz: float, end_us: float) -> None:
        """16 bits each way, the last at `end_us`; `mode` is the SPI mode of the master."""
        self.frames += 1
        self.frame_end = end_us
        if not self.listening or not self.selected:
            return
        if mode != 3:
            self.machine.violations.append(f"ADIS16405: SPI mode {mode}")
            return
        if sck_hz > (3e5 if self.slow else 2e6):
            self.machine.violations.append(f"ADIS16405: SCK {sck_hz:g} Hz")
        address = out >> 8 & 0x7F
        if self.burst_at is not None:
            self._burst_word(sck_hz)
        elif out >> 15:
            self._write(address, out & 0xFF)
        elif out == 0x3E00:
            self.burst_at = 0
            self.bursts += 1
        else:
            self.answer = self._read(address & ~1)

    def _shifting_out(self) -> int:
        """What it will answer the next frame with."""
        if not self.listening or not self.selected:
            return 0xFFFF if self.floating_high else 0x0000
        if self.burst_at is None or self.burst_at >= len(OUTPUTS):
            return self.answer
        return self._word(OUTPUTS[self.burst_at])

    def _word(self, address: int) -> int:
        """An output register as it is read."""
        return self.out[address] | self.new[address] << 15 | (self.registers[0x3C] != 0) << 14

    def _burst_word(self, sck_hz: float) -> None:
        if sck_hz > 1e6:
            self.machine.violations.append(f"ADIS16405: SCK {sck_hz:g} Hz in a burst")
        position = self.burst_at or 0
        self.burst_at = position + 1
        if position == len(OUTPUTS) - 1 and self.taken:
            if self._read_once == self.taken[-1][0]:
                self.read_twice.append(self._read_once)
            self._read_once = self.taken[-1][0]
        if position >= len(OUTPUTS):
            self.machine.violations.append("ADIS16405: a burst of more than 12 words")
        else:
            self._read(OUTPUTS[position])

    def _read(self, address: int) -> int:
        if address in self.out:
            word = self._word(address)
            self.new[address] = False
            return word
        value = self.registers.get(address, 0)
        if address == 0x3C:
            self.registers[0x3C] = 0
        self.reads[address] = self.reads.get(address, 0) + 1
        return value

    def _write(self, address: int, byte: int) -> None:
        base, shift = address & ~1, 8 * (address & 1)
        if base == 0x3E:
            if shift == 0 and byte >> 7:
                if self.deaf > 0:
                    self.deaf -= 1
                else:
                    self.reset()
        elif base in OFFSETS and self.writes_fail:
            pass
        elif base in (0x34, 0x36, 0x38, 0x40, 0x48) or base in OFFSETS:
            self.registers[base] = self.registers[base] & ~(0xFF << shift) | byte << shift
            if base == 0x34 and shift and byte >> 2 & 1:
                self.machine.at(SELF_TEST_US, self._self_tested)

    def _self_tested(self) -> None:
        self.registers[0x34] &= ~0x400
        self.registers[0x3C] |= self.fail_self_test
