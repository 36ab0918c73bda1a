"""The board: processor, sensor, bus, wired as port/README.md says under "Wiring"."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import can
from unicorn import arm_const as arm

from .adis16405 import Adis16405, Sample
from .bxcan import Bxcan, Frame
from .flash import Flash
from .i2c import Device, I2cBus
from .machine import NRF51822, STM32F405, Core, Machine, SystemControl
from .nrf51 import Gpio as NrfGpio
from .nrf51 import Gpiote, Nvmc, PowerClock, Spi0, Timer0, Uart0, Wdt
from .nrf51 import Rng as NrfRng
from .spi import Dma2, Spi
from .symbols import place
from .system import Exti, Gpio, Iwdg, Pwr, Rcc, Rng, Tim2
from .usart import Usart


def resting(seed: int) -> Callable[[int], Sample]:
    """Readings of a sensor at rest, LSB: noise of 0.9 deg/s and 0.09 m/s^2 (the data sheet's), gravity on z. The same
    sample for the same seed and index, in whatever order they are asked for."""

    def sample(index: int) -> Sample:
        rng = random.Random(seed * 1_000_003 + index)
        gx, gy, gz = (rng.gauss(mean, 18.0) for mean in (-9.0, 4.0, 13.0))
        ax, ay, az = (rng.gauss(mean, 2.7) for mean in (3.0, -2.0, 300.0))
        return gx, gy, gz, ax, ay, az

    return sample


class Sensor(Protocol):
    """A sensor at its pins. A part has other members of its own, which break it."""

    on_ready: Callable[[bool], None]

    def select(self, low: bool) -> None:
        """Chip select."""

    def exchange(self, byte: int, mode: int, sck_hz: float, end_us: float, /) -> int:
        """A byte each way, the last bit at `end_us`; `mode` is the SPI mode of the master."""

    def reset_line(self, level: bool) -> None:
        """Low holds it in reset."""

    def power_on(self) -> None:
        """The supply comes."""


class Bench:
    """What every board has. `frames`: the telemetry heard, with the time in us. `SLOTS`: where the flash keeps the
    saved state, two slots `STRIDE` apart. `sensor` makes the sensor; an ADIS16405 that measures `source` by default."""

    SLOTS = STRIDE = 0

    def __init__(
        self,
        elf: Path,
        seed: int,
        core: Core,
        source: Callable[[int], Sample] | None,
        sensor: Callable[[Machine], Sensor] | None,
    ) -> None:
        self.elf = elf
        self.machine = Machine(elf, seed, core)
        self.frames: list[tuple[float, Frame]] = []
        self.text = bytearray()
        self._make_sensor = sensor or (lambda machine: Adis16405(machine, source or resting(seed)))
        self.i2c: I2cBus | None = None

    def _wire(self, sensor: Sensor) -> None:
        if isinstance(sensor, Device):
            self.i2c = I2cBus(self.machine, sensor)

    def _lines(self, scl: int, sda: int) -> int:
        """Levels of the port's pins, a bit each: of those that are not I2C's 1."""
        low = 0 if self.i2c is None else (not self.i2c.scl) << scl | (not self.i2c.sda) << sda
        return ~low & 0xFFFFFFFF

    def _let_go(self) -> None:
        if self.i2c is not None:
            self.i2c.release()

    def run(self, seconds: float) -> None:
        """Let time go by."""
        self.machine.run(self.machine.now_us + seconds * 1e6)

    def value(self, name: str) -> int:
        """A scalar variable of the firmware: `sensor.counters.stale`, `app.imu.gate->gate.state`."""
        address, size = place(self.elf, name, self.machine.uc.mem_read)
        return int.from_bytes(self.machine.uc.mem_read(address, size), "little")


class Board(Bench):
    """An STM32F405's. What is heard on the CAN bus is sent to the python-can channel too if one is given.
    `text`: what the USART said. `retained`: content of the flash's two last sectors to start with.
    `clock_broken`: "crystal" or "pll"."""

    SLOTS, STRIDE = 0x080C0000, 0x20000
    SCL, SDA = 5, 7

    def __init__(
        self,
        elf: Path,
        source: Callable[[int], Sample] | None = None,
        *,
        seed: int = 0,
        channel: str | None = None,
        retained: bytes | None = None,
        clock_broken: str = "",
        sensor: Callable[[Machine], Sensor] | None = None,
    ) -> None:
        super().__init__(elf, seed, STM32F405, source, sensor)
        machine = self.machine
        self.rcc = Rcc(machine)
        self.rcc.crystal = clock_broken != "crystal"
        self.rcc.pll_works = clock_broken != "pll"
        self.system = SystemControl(machine)
        self.pwr = Pwr(machine)
        self.rng = Rng(machine, self.rcc)
        self.tim2 = Tim2(machine, self.rcc)
        self.iwdg = Iwdg(machine)
        self.port_a = Gpio(machine, 0x40020000)
        self.port_b = Gpio(machine, 0x40020400)
        self.exti = Exti(machine)
        self.spi = Spi(machine, self.rcc)
        self.dma2 = Dma2(machine, self.spi)
        self.can = Bxcan(machine, self.rcc, lambda: self.port_b.function(8) == 9 and self.port_b.function(9) == 9)
        self.usart = Usart(machine, self.rcc)
        self.flash = Flash(machine)
        self.sensor = self._make_sensor(machine)
        self._wire(self.sensor)
        self.port_a.inputs = lambda: self._lines(self.SCL, self.SDA)
        machine.on_reset = self._reset

        self.sensor.on_ready = lambda level: self.exti.edge(1, 0, level)
        self.spi.device = self._spi_byte
        self.port_a.on_output = self._port_a
        self.port_b.on_output = self._port_b
        self.usart.on_byte = self.text.append
        self.can.on_frame = self._can_frame
        self.bus = can.Bus(interface="virtual", channel=channel) if channel else None
        if retained is not None:
            machine.uc.mem_write(self.SLOTS, retained)
        machine.start()

    def _spi_byte(self, byte: int, mode: int, sck_hz: float, end_us: float) -> int:
        if any(self.port_a.function(pin) != 5 for pin in (5, 6, 7)):
            self.machine.violations.append("SPI1's pins are not its own")
        return self.sensor.exchange(byte, mode, sck_hz, end_us)

    def _reset(self, cause: str) -> None:
        self.rcc.note_reset(cause)
        self._let_go()

    def _port_a(self, pin: int, level: bool) -> None:
        if pin == 4:
            self.sensor.select(not level)
        elif self.i2c is not None and pin in (self.SCL, self.SDA):
            self.i2c.drive(int(pin == self.SDA), level)

    def _port_b(self, pin: int, level: bool) -> None:
        if pin == 1:
            self.sensor.reset_line(level)

    def _can_frame(self, us: float, frame: Frame) -> None:
        self.frames.append((us, frame))
        if self.bus is not None:
            self.bus.send(can.Message(timestamp=us / 1e6, arbitration_id=frame[0], data=frame[1], is_extended_id=False))

    def power_cycle(self, retained: bytes | None = None) -> None:
        """Off and on again; what memory holds then is chance, but for the flash, which may be given."""
        machine = self.machine
        machine.scramble()
        if retained is not None:
            machine.uc.mem_write(self.SLOTS, retained)
        self.flash.cut_at = -1
        self.rcc.csr = self.rcc.FLAG["power"]
        self._let_go()
        machine.power_cycle()
        self.sensor.power_on()
        if self.i2c is not None:
            self.i2c.power_on()

    def erases(self, slot: int) -> int:
        """Times that a slot's beginning was erased."""
        return self.flash.erases[10 + slot]

    def retained(self) -> bytes:
        """Content of the flash's two last sectors."""
        self.flash.settle()
        return bytes(self.machine.uc.mem_read(self.SLOTS, 2 * self.STRIDE))

    def close(self) -> None:
        """Leave the python-can channel."""
        if self.bus is not None:
            self.bus.shutdown()


class NrfBoard(Bench):
    """An nRF51822's: telemetry as SLCAN. `retained`: content of the flash's last 64 KB to start with."""

    SLOTS, STRIDE = 0x30000, 0x8000
    READY, RESET, CS, SCL, SDA = 20, 18, 16, 23, 21

    def __init__(
        self,
        elf: Path,
        source: Callable[[int], Sample] | None = None,
        *,
        seed: int = 0,
        retained: bytes | None = None,
        crystal: bool = True,
        sensor: Callable[[Machine], Sensor] | None = None,
    ) -> None:
        super().__init__(elf, seed, NRF51822, source, sensor)
        machine = self.machine
        self.system = SystemControl(machine)
        self.power = PowerClock(machine)
        self.power.crystal = crystal
        self.pins = NrfGpio(machine)
        self.gpiote = Gpiote(machine)
        self.timer = Timer0(machine)
        self.wdt = Wdt(machine)
        self.rng = NrfRng(machine)
        self.spi = Spi0(machine)
        self.usart = Uart0(machine)
        self.flash = Nvmc(machine)
        self.sensor = self._make_sensor(machine)
        self._wire(self.sensor)
        self.pins.inputs = lambda: self._lines(self.SCL, self.SDA)
        machine.on_reset = self._reset
        self.sensor.on_ready = lambda level: self.gpiote.edge(self.READY, level)
        self.spi.device = self.sensor.exchange
        self.pins.on_output = self._output
        self.usart.on_byte = self._byte
        self._line = bytearray()
        if retained is not None:
            machine.uc.mem_write(self.SLOTS, retained)
        machine.start()

    def _reset(self, cause: str) -> None:
        self.power.note_reset(cause)
        self._let_go()

    def _output(self, pin: int, level: bool) -> None:
        if self.i2c is not None and pin in (self.SCL, self.SDA):
            self.i2c.drive(int(pin == self.SDA), level)
        elif pin == self.CS:
            self.sensor.select(not level)
        elif pin == self.RESET:
            self.sensor.reset_line(level)

    def _byte(self, byte: int) -> None:
        self.text.append(byte)
        self._line.append(byte)
        if byte in b"\r\a":
            line, self._line = self._line, bytearray()
            if line[:1] == b"t" and len(line) == 22:
                data = bytes.fromhex(line[5:21].decode())
                self.frames.append((self.machine.time_us, (int(line[1:4], 16), data)))

    def power_cycle(self, retained: bytes | None = None) -> None:
        """Off and on again; what memory holds then is chance, but for the flash, which may be given."""
        machine = self.machine
        machine.scramble()
        if retained is not None:
            machine.uc.mem_write(self.SLOTS, retained)
        self.flash.cut_at = -1
        self.flash.settle()
        self.power.power_on()
        self._line.clear()
        self._let_go()
        machine.power_cycle()
        self.sensor.power_on()
        if self.i2c is not None:
            self.i2c.power_on()

    def erases(self, slot: int) -> int:
        """Times that a slot's beginning was erased."""
        return self.flash.erases.get(self.SLOTS + slot * self.STRIDE, 0)

    def retained(self) -> bytes:
        """Content of the flash's slots."""
        self.flash.settle()
        return bytes(self.machine.uc.mem_read(self.SLOTS, 2 * self.STRIDE))


__all__ = ["Adis16405", "Board", "NrfBoard", "arm", "place", "resting"]
