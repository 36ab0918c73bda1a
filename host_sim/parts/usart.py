"""USART1: a byte at a time, at the baud rate that BRR makes."""

from __future__ import annotations

from collections.abc import Callable

from .machine import EXC_IRQ0, Event, Machine, Part
from .system import Rcc


class Usart(Part):
    """RM0090 30.6. `say(bytes)` is the host's side; what the firmware sends goes to `on_byte`."""

    base = 0x40011000
    departure: Event | None = None

    def __init__(self, machine: Machine, rcc: Rcc) -> None:
        super().__init__(machine)
        self.rcc = rcc
        self.on_byte: Callable[[int], None] = lambda byte: None
        self.host_baud = 115200.0
        self.incoming = bytearray()
        self.arrival: Event | None = None
        self.overruns = 0

    def reset(self) -> None:
        """Off, 30.6.8."""
        self.cr1 = self.brr = 0
        self.tx_shift_until = 0.0
        self.tx_full = self.rx_full = self.overrun = self.misframed = False
        self.rdr = 0
        if self.departure is not None:
            self.departure.cancel()
        self.departure = None

    @property
    def baud(self) -> float:
        """30.3.4, oversampling by 16."""
        return self.rcc.pclk2_hz / self.brr if self.brr else 0.0

    def say(self, data: bytes) -> None:
        """Bytes from the host, back to back."""
        self.incoming += data
        if self.arrival is None:
            self.arrival = self.machine.at(10e6 / self.host_baud, self._arrive)

    def _arrive(self) -> None:
        self.arrival = None
        byte = self.incoming.pop(0)
        if self.cr1 & 0x2004 == 0x2004:
            if abs(self.baud / self.host_baud - 1.0) > 0.03:
                byte = self.machine.random.getrandbits(8)
                self.misframed = bool(self.machine.random.getrandbits(1))  # the stop bit is one by chance
            if self.rx_full:
                self.overrun = True
                self.overruns += 1
            else:
                self.rdr, self.rx_full = byte, True
            self._interrupt()
        if self.incoming:
            self.arrival = self.machine.at(10e6 / self.host_baud, self._arrive)

    def _interrupt(self) -> None:
        receive = self.cr1 >> 5 & 1 and (self.rx_full or self.overrun)
        send = self.cr1 >> 7 & 1 and not self.tx_full
        if receive or send:
            self.machine.pend(EXC_IRQ0 + 37)
        else:
            self.machine.unpend(EXC_IRQ0 + 37)

    def read(self, offset: int) -> int:
        """SR, DR, BRR, CR1."""
        if offset == 0x00:
            received = self.misframed << 1 | self.overrun << 3 | self.rx_full << 5
            return received | (self.departure is None) << 6 | (not self.tx_full) << 7
        if offset == 0x04:
            self.rx_full = self.overrun = self.misframed = False
            self._interrupt()
            return self.rdr
        return {0x08: self.brr, 0x0C: self.cr1}[offset]

    def write(self, offset: int, value: int) -> None:
        """DR, BRR, CR1."""
        if offset == 0x04:
            if self.tx_full:
                self.machine.violations.append("USART1: DR written with TXE clear")
            self.tdr, self.tx_full = value & 0xFF, True
            if self.departure is None:
                self._load()
        elif offset == 0x08:
            self.brr = value & 0xFFFF
        elif offset == 0x0C:
            self.cr1 = value
        elif offset != 0x00:
            raise KeyError(offset)
        self._interrupt()

    def _load(self) -> None:
        byte = self.tdr
        self.tx_full = False

        def gone() -> None:
            self.departure = None
            self.on_byte(byte)
            if self.tx_full:
                self._load()
            self._interrupt()

        self.departure = self.machine.at(10e6 / self.baud, gone)
        self._interrupt()
