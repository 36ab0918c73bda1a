"""The board: processor, sensor, bus, wired as GUIDE.md says under "The module"."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import can
from unicorn import arm_const as arm

from .adis16405 import Adis16405, Sample
from .bxcan import Bxcan, Frame
from .flash import Flash
from .machine import SRAM, SRAM_BYTES, Machine, SystemControl
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


class Board:
    """`frames`: what was heard on the CAN bus, with the time in us; also sent to the python-can channel if one is
    given. `text`: what the USART said. `retained`: content of the flash's two last sectors to start with.
    `clock_broken`: "crystal" or "pll"."""

    def __init__(
        self,
        elf: Path,
        source: Callable[[int], Sample] | None = None,
        *,
        seed: int = 0,
        channel: str | None = None,
        retained: bytes | None = None,
        clock_broken: str = "",
    ) -> None:
        self.elf = elf
        self.machine = machine = Machine(elf, seed)
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
        self.sensor = Adis16405(machine, source or resting(seed))
        machine.on_reset = self.rcc.note_reset

        self.sensor.on_ready = lambda level: self.exti.edge(1, 0, level)
        self.spi.device = self._spi_frame
        self.port_a.on_output = self._port_a
        self.port_b.on_output = self._port_b
        self.frames: list[tuple[float, Frame]] = []
        self.text = bytearray()
        self.usart.on_byte = self.text.append
        self.can.on_frame = self._can_frame
        self.bus = can.Bus(interface="virtual", channel=channel) if channel else None
        if retained is not None:
            machine.uc.mem_write(0x080C0000, retained)
        machine.start()

    def _spi_frame(self, word: int, mode: int, sck_hz: float, end_us: float) -> int:
        if any(self.port_a.function(pin) != 5 for pin in (5, 6, 7)):
            self.machine.violations.append("SPI1's pins are not its own")
        return self.sensor.frame(word, mode, sck_hz, end_us)

    def _port_a(self, pin: int, level: bool) -> None:
        if pin == 4:
            self.sensor.select(not level)

    def _port_b(self, pin: int, level: bool) -> None:
        if pin == 1:
            self.sensor.reset_line(level)

    def _can_frame(self, us: float, frame: Frame) -> None:
        self.frames.append((us, frame))
        if self.bus is not None:
            self.bus.send(can.Message(timestamp=us / 1e6, arbitration_id=frame[0], data=frame[1], is_extended_id=False))

    def run(self, seconds: float) -> None:
        """Let time go by."""
        self.machine.run(self.machine.now_us + seconds * 1e6)

    def power_cycle(self, retained: bytes | None = None) -> None:
        """Off and on again; what memory holds then is chance, but for the flash, which may be given."""
        machine = self.machine
        machine.uc.mem_write(SRAM, machine.random.randbytes(SRAM_BYTES))
        if retained is not None:
            machine.uc.mem_write(0x080C0000, retained)
        self.flash.cut_at = -1
        self.rcc.csr = self.rcc.FLAG["power"]
        machine.power_cycle()
        self.sensor.power_on()

    def retained(self) -> bytes:
        """Content of the flash's two last sectors."""
        self.flash.settle()
        return bytes(self.machine.uc.mem_read(0x080C0000, 0x40000))

    def value(self, name: str) -> int:
        """A scalar variable of the firmware: `sensor.counters.stale`."""
        address, size = place(self.elf, name)
        return int.from_bytes(self.machine.uc.mem_read(address, size), "little")

    def close(self) -> None:
        """Leave the python-can channel."""
        if self.bus is not None:
            self.bus.shutdown()


__all__ = ["Adis16405", "Board", "arm", "place", "resting"]
