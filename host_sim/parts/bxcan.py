"""bxCAN: initialisation, three mailboxes, reception into FIFO 0 by filter bank 0, the error counters and bus-off, on a
bus that python-can can listen to."""

from __future__ import annotations

from collections.abc import Callable

from .machine import EXC_IRQ0, Event, Machine, Part
from .system import Rcc

Frame = tuple[int, bytes]


def frame_bits(identifier: int, data: bytes) -> int:
    """Length of a data frame with a standard identifier, stuff bits and the interframe space included (ISO 11898-1)."""
    bits = [0]  # start of frame
    bits += [identifier >> i & 1 for i in range(10, -1, -1)] + [0, 0, 0]
    bits += [len(data) >> i & 1 for i in range(3, -1, -1)]
    for byte in data:
        bits += [byte >> i & 1 for i in range(7, -1, -1)]
    crc = 0
    for bit in bits:
        crc = crc << 1 & 0x7FFF ^ (0x4599 if bit ^ crc >> 14 else 0)
    bits += [crc >> i & 1 for i in range(14, -1, -1)]
    stuffed, run, last = 0, 0, -1
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuffed += 1
            last, run = 1 - bit, 1
    return len(bits) + stuffed + 3 + 7 + 3  # delimiters and ACK, end of frame, interframe space


class Bxcan(Part):
    """RM0090 32.9. `bus_bit_s`: bit rate of the others on the bus, 0 when there are none, so that nobody acknowledges.
    `fault(frame)`: whether a bit error hits this attempt. `on_frame(frame)`: a frame that was sent and acknowledged."""

    base = 0x40006400
    event: Event | None = None  # end of the frame on the bus
    sync: Event | None = None  # end of initialisation or of bus-off

    def __init__(self, machine: Machine, rcc: Rcc, pins_connected: Callable[[], bool]) -> None:
        super().__init__(machine)
        self.rcc = rcc
        self.pins_connected = pins_connected
        self.bus_bit_s = 500_000.0
        self.stuck_dominant = False
        self.fault: Callable[[Frame], bool] = lambda frame: False
        self.on_frame: Callable[[float, Frame], None] = lambda us, frame: None
        self.bus_offs = 0
        self.attempts = 0
        self.aborted = 0
        self.heard = self.overruns = 0  # frames of others that the filter took, and that found no room

    def reset(self) -> None:
        """Asleep, 32.9.2."""
        self.mcr, self.msr, self.ier, self.btr = 0x00010002, 0x00000C02, 0, 0x01230000
        self.boff = False
        self.tec = 0
        self.lec = 0
        self.tsr = 0x1C000000
        self.box = [[0, 0, 0, 0] for _ in range(3)]
        self.requests: list[int] = []  # mailboxes in order of request
        self.abort: set[int] = set()
        self.fifo: list[tuple[int, int, int, int]] = []  # RIR, RDTR, RDLR, RDHR of each message
        self.full = self.overrun = False
        self.fmr = 0x2A1C0E01
        self.filters = dict.fromkeys((0x204, 0x20C, 0x214, 0x21C, 0x240, 0x244), 0)  # FM1R FS1R FFA1R FA1R F0R1 F0R2
        self.sending: int | None = None
        for event in (self.event, self.sync):
            if event is not None:
                event.cancel()
        self.event = self.sync = None

    @property
    def bit_us(self) -> float:
        """32.7.7."""
        quanta = 3 + (self.btr >> 16 & 15) + (self.btr >> 20 & 7)
        return 1e6 * ((self.btr & 0x3FF) + 1) * quanta / self.rcc.pclk1_hz

    # ---------------------------------------------------------------------------------------------------------
    # registers

    def read(self, offset: int) -> int:
        """Control, status, mailboxes."""
        if 0x180 <= offset < 0x1B0:
            return self.box[(offset - 0x180) // 16][(offset & 15) // 4]
        if 0x1B0 <= offset < 0x1C0:
            return self.fifo[0][(offset & 15) // 4] if self.fifo else 0
        if offset == 0x0C:
            return len(self.fifo) | self.full << 3 | self.overrun << 4
        if offset == 0x200:
            return self.fmr
        if offset in self.filters:
            return self.filters[offset]
        esr = self.tec << 16 & 0xFF0000 | self.lec << 4 | self.boff << 2 | (self.tec > 127) << 1 | (self.tec > 95) << 0
        return {0x00: self.mcr, 0x04: self.msr, 0x08: self._tsr(), 0x14: self.ier, 0x18: esr, 0x1C: self.btr}[offset]

    def _tsr(self) -> int:
        code = next((i for i in range(3) if i not in self.requests), 0)
        empty = sum((i not in self.requests) << 26 + i for i in range(3))
        return self.tsr & 0x00FFFFFF | code << 24 | empty

    def write(self, offset: int, value: int) -> None:
        """Control, status, mailboxes."""
        if not self.rcc.clock_on(0x40, 25):
            self.machine.violations.append("CAN1 used without its clock")
        if 0x180 <= offset < 0x1B0:
            self._mailbox((offset - 0x180) // 16, (offset & 15) // 4, value)
        elif offset == 0x00:
            self._control(value)
        elif offset == 0x04:
            self.msr &= ~(value & 0x1C)
        elif offset == 0x08:
            for i in range(3):
                if value >> 8 * i & 1:  # RQCP clears TXOK, ALST and TERR as well
                    self.tsr &= ~(0xF << 8 * i)
                if value >> 8 * i + 7 & 1 and i in self.requests:
                    self._abort(i)
        elif offset == 0x0C:
            self.full = self.full and not value >> 3 & 1
            self.overrun = self.overrun and not value >> 4 & 1
            if value >> 5 & 1 and self.fifo:
                self.fifo.pop(0)
                self.full = False
        elif offset == 0x200:
            self.fmr = self.fmr & ~1 | value & 1
        elif offset in self.filters:
            if not self.fmr & 1 and not (offset >= 0x240 and not self.filters[0x21C] & 1) and offset != 0x21C:
                self.machine.violations.append("a CAN filter changed while it is in use")
            self.filters[offset] = value
        elif offset == 0x14:
            self.ier = value
        elif offset == 0x1C:
            if not self.msr & 1:
                self.machine.violations.append("CAN_BTR written outside initialisation, RM0090 32.9.2")
            self.btr = value
        else:
            raise KeyError(offset)

    def _control(self, value: int) -> None:
        if value >> 15 & 1:
            self.reset()
            return
        self.mcr = value
        if self.sync is not None:
            self.sync.cancel()
            self.sync = None
        if value & 2:
            self.msr |= 2
        else:
            self.msr &= ~2
        if value & 1:
            self.msr |= 1
            if self.event is not None:
                self.event.cancel()
            self.event = self.sending = None
        elif self.msr & 1:
            self._synchronise()

    def _synchronise(self) -> None:
        """Leaving initialisation takes 11 recessive bits, 32.4.2."""

        def synchronised() -> None:
            if self.stuck_dominant:
                self._synchronise()
                return
            self.msr &= ~1
            self._next()

        self.sync = self.machine.at(11 * self.bit_us, synchronised)

    def _mailbox(self, i: int, register: int, value: int) -> None:
        if i in self.requests:
            self.machine.violations.append("a mailbox written that is not empty, RM0090 32.9.3")
            return
        self.box[i][register] = value
        if register == 0 and value & 1:
            self.tsr &= ~(0xF << 8 * i)
            self.requests.append(i)
            self._next()

    def _abort(self, i: int) -> None:
        """32.7.1: at once, unless it is on the bus: then at the end of the attempt."""
        if i == self.sending:
            self.abort.add(i)
        else:
            self._complete(i, 0)

    # ---------------------------------------------------------------------------------------------------------------
    # bus

    def say(
        self, identifier: int, data: bytes, *, extended: bool = False, remote: bool = False, length: int = -1
    ) -> None:
        """A frame of somebody else on the bus. `length`: its DLC, if not that of the data."""
        if self.msr & 3 or self.boff or self.fmr & 1 or self.bus_bit_s == 0 or not self.filters[0x21C] & 1:
            return
        rir = identifier << (3 if extended else 21) | extended << 2 | remote << 1
        # one 32-bit filter of identifier and mask: FBM 0, FSC 1; others have no model
        if self.filters[0x204] & 1 or not self.filters[0x20C] & 1 or self.filters[0x214] & 1:
            self.machine.violations.append("a CAN filter in a mode that has no model")
        if (rir ^ self.filters[0x240]) & self.filters[0x244] & ~1:
            return
        self.heard += 1
        whole = data.ljust(8, b"\0")
        message = (
            rir,
            (len(data) if length < 0 else length) & 15,
            int.from_bytes(whole[:4], "little"),
            int.from_bytes(whole[4:8], "little"),
        )
        if len(self.fifo) == 3:
            self.overrun = True
            self.overruns += 1
            self.fifo[2] = message  # RFLM 0: the last one is overwritten
        else:
            self.fifo.append(message)
            self.full = len(self.fifo) == 3

    def _complete(self, i: int, flags: int) -> None:
        self.requests.remove(i)
        self.abort.discard(i)
        self.aborted += not flags & 2
        self.box[i][0] &= ~1
        self.tsr = self.tsr & ~(0xF << 8 * i) | (1 | flags) << 8 * i
        if self.ier & 1:
            self.machine.pend(EXC_IRQ0 + 19)

    def _next(self) -> None:
        """Start the next attempt: the oldest request (TXFP), or the lowest identifier (32.7.1)."""
        if self.sending is not None or not self.requests or self.boff or self.msr & 3:
            return
        first, lowest = self.requests[0], min(self.requests, key=lambda box: (self.box[box][0] >> 21, box))
        i = first if self.mcr >> 2 & 1 else lowest
        self.sending = i
        tir, tdtr, low, high = self.box[i]
        frame = (tir >> 21, (low | high << 32).to_bytes(8, "little")[: tdtr & 15])
        passive_us = 8 * self.bit_us if self.tec > 127 else 0.0  # suspend transmission
        self.event = self.machine.at(frame_bits(*frame) * self.bit_us + passive_us, lambda: self._end(frame))

    def _end(self, frame: Frame) -> None:
        self.event = None
        self.attempts += 1
        i = self.sending
        self.sending = None
        if i is None:
            return
        # The others' bit clocks must agree within what they can resynchronise, 0.5 % here.
        heard = self.bus_bit_s > 0 and abs(1e6 / self.bit_us / self.bus_bit_s - 1.0) < 5e-3 and self.pins_connected()
        if self.stuck_dominant or self.fault(frame) or (self.bus_bit_s > 0 and not heard):
            self._error(5)
        elif not heard:
            self.lec = 3
            if self.tec <= 127:  # an error-passive node that finds no acknowledgement counts no further, ISO 11898-1
                self._error(3)
        else:
            self.tec = max(0, self.tec - 1)
            self.lec = 0
            self._complete(i, 2)
            self.on_frame(self.machine.now_us, frame)
        if i in self.requests and (i in self.abort or self.mcr >> 4 & 1):
            self._complete(i, 8)
        self._next()

    def _error(self, code: int) -> None:
        self.lec = code
        self.tec += 8
        if self.tec > 255:
            self.tec = 255
            self.boff = True
            self.bus_offs += 1
            if self.ier >> 15 & 1 and self.ier >> 10 & 1:
                self.msr |= 4
                self.machine.pend(EXC_IRQ0 + 22)
            if self.mcr >> 6 & 1:
                self._recover()

    def _recover(self) -> None:
        """128 times 11 recessive bits, 32.7.6."""

        def recovered() -> None:
            if self.stuck_dominant:
                self._recover()
                return
            self.boff = False
            self.tec = 0
            self._next()

        self.sync = self.machine.at(128 * 11 * self.bit_us, recovered)
