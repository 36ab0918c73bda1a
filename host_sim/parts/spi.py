"""SPI1 as a master of bytes and the DMA2 streams that serve it."""

from __future__ import annotations

from collections.abc import Callable

from .machine import EXC_IRQ0, Event, Machine, Part
from .system import Rcc


class Spi(Part):
    """RM0090 28.5. `device(byte, mode, sck_hz, end_us)` answers a byte that ends then; `flip` is the chance that a bit
    of one is turned over."""

    base = 0x40013000

    def __init__(self, machine: Machine, rcc: Rcc) -> None:
        super().__init__(machine)
        self.rcc = rcc
        self.device: Callable[[int, int, float, float], int] = lambda byte, mode, hz, end: 0xFF
        self.flip = 0.0
        self.flipped = 0
        self.on_dma: Callable[[], None] = lambda: None

    def reset(self) -> None:
        """Off."""
        self.cr1 = self.cr2 = 0
        self.dr = 0
        self.rxne = False
        self.done_at = 0.0

    @property
    def sck_hz(self) -> float:
        """28.5.1, BR."""
        return float(self.rcc.pclk2_hz / (2 << (self.cr1 >> 3 & 7)))

    def _noisy(self, byte: int) -> int:
        if self.flip > 0.0:
            for bit in range(8):
                if self.machine.random.random() < self.flip:
                    byte ^= 1 << bit
                    self.flipped += 1
        return byte

    def exchange(self, byte: int, end_us: float) -> int:
        """A byte each way on the wires."""
        if not self.rcc.clock_on(0x44, 12) or not self.cr1 >> 6 & 1 or not self.cr1 >> 2 & 1 or self.cr1 >> 11 & 1:
            self.machine.violations.append("SPI1 used without its clock, or not as a master of bytes")
            return 0xFF
        return self._noisy(self.device(self._noisy(byte), self.cr1 & 3, self.sck_hz, end_us))

    def read(self, offset: int) -> int:
        """CR1, CR2, SR, DR. While SR is busy, time goes on to the byte's end or the next event: the program would ask
        again and again.
        """
        if offset == 0x08:
            done = self.machine.time_us >= self.done_at
            if not done:
                self.machine.wait(self.done_at)
            return (self.rxne and done) << 0 | 1 << 1 | (not done) << 7
        if offset == 0x0C:
            self.rxne = False
            return self.dr
        return {0x00: self.cr1, 0x04: self.cr2}[offset]

    def write(self, offset: int, value: int) -> None:
        """CR1, CR2, DR."""
        if offset == 0x00:
            self.cr1 = value
        elif offset == 0x04:
            self.cr2 = value
            self.on_dma()
        elif offset == 0x0C:
            if self.machine.time_us < self.done_at:
                self.machine.violations.append("SPI1: a byte begun before the last one's end")
            self.done_at = self.machine.time_us + 8e6 / self.sck_hz
            self.dr = self.exchange(value & 0xFF, self.done_at)
            self.rxne = True
        else:
            raise KeyError(offset)


class Dma2(Part):
    """RM0090 10.5, as far as SPI1 needs it: stream 0 channel 3 receives, stream 3 channel 3 sends (table 44)."""

    base = 0x40026400
    end: Event | None = None
    RX, TX = 0, 3

    def __init__(self, machine: Machine, spi: Spi) -> None:
        super().__init__(machine)
        self.spi = spi
        spi.on_dma = self._go
        self.hang = 0  # transfers that never end, to come

    def reset(self) -> None:
        """Off."""
        self.lisr = 0
        self.streams = [dict.fromkeys((0x00, 0x04, 0x08, 0x0C, 0x10), 0) | {0x14: 0x21} for _ in range(8)]
        if self.end is not None:
            self.end.cancel()
        self.end = None

    def read(self, offset: int) -> int:
        """LISR, SxCR and so on."""
        if offset == 0x00:
            return self.lisr
        return self.streams[(offset - 0x10) // 0x18][(offset - 0x10) % 0x18]

    def write(self, offset: int, value: int) -> None:
        """LIFCR, SxCR and so on; a stream that is on takes no settings (10.5.5)."""
        if offset == 0x08:
            self.lisr &= ~value
            return
        stream, register = self.streams[(offset - 0x10) // 0x18], (offset - 0x10) % 0x18
        if register != 0 and stream[0x00] & 1:
            self.machine.violations.append("DMA2: a stream set up while it is on")
        if register == 0:
            if value & 1 and not stream[0x00] & 1 and self.lisr & 0x0F7D0F7D:
                self.machine.violations.append("DMA2: a stream started with flags set, RM0090 10.3.17")
            if not value & 1 and self.end is not None:
                self.end.cancel()
                self.end = None
        stream[register] = value
        self._go()

    def _go(self) -> None:
        rx, tx = self.streams[self.RX], self.streams[self.TX]
        if self.end is not None or not rx[0x00] & 1 or not tx[0x00] & 1 or self.spi.cr2 & 3 != 3:
            return
        for stream, direction in ((rx, 0), (tx, 1)):
            cr = stream[0x00]
            if (
                cr >> 25 & 7 != 3
                or cr >> 6 & 3 != direction
                or cr >> 11 & 3 != 0
                or cr >> 13 & 3 != 0
                or not cr >> 10 & 1
            ):
                self.machine.violations.append("DMA2: channel, direction, widths or increment wrong for SPI1")
        if self.hang > 0:
            self.hang -= 1
            self.end = self.machine.at(1e12, lambda: None)
            return
        self.count = min(rx[0x04], tx[0x04])
        self.end = self.machine.at(self.count * 8e6 / self.spi.sck_hz, self._finish)

    def _finish(self) -> None:
        rx, tx = self.streams[self.RX], self.streams[self.TX]
        self.end = None
        uc = self.machine.uc
        out = uc.mem_read(tx[0x0C], self.count)
        uc.mem_write(rx[0x0C], bytes(self.spi.exchange(byte, self.machine.time_us) for byte in out))
        for stream in (rx, tx):
            stream[0x04] -= self.count
            stream[0x00] &= ~1
        self.lisr |= 1 << 5 | 1 << 27
        if rx[0x00] >> 4 & 1:
            self.machine.pend(EXC_IRQ0 + 56)
