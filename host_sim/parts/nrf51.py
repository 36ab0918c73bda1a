"""The nRF51822's peripherals, as far as the firmware uses them: nRF51 Series Reference Manual 3.0, by the chapter of
each; times of the flash from the nRF51822 product specification."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from unicorn.unicorn_const import UC_HOOK_MEM_WRITE

from .flash import half_erased, half_programmed
from .machine import EXC_IRQ0, NRF51822, Event, Machine, Part, Uc

PAGE = 1024
ERASE_US, WRITE_US = 22_300.0, 46.3  # product specification, at most
WRITES_MOST = 2  # of a word between erases


class Peripheral(Part):
    """Events with their interrupt (RM, "Peripheral interface"): the line is high while an enabled event is set.

    `EVENTS`: offset to bit in INTEN. Other registers hold what is written to them, from `REGISTERS` on.
    """

    irq = 0
    EVENTS: ClassVar[dict[int, int]] = {}
    REGISTERS: ClassVar[tuple[int, ...]] = ()

    def reset(self) -> None:
        """Off, no event set."""
        self.event = dict.fromkeys(self.EVENTS, 0)
        self.inten = 0
        self.registers = dict.fromkeys(self.REGISTERS, 0)

    def happen(self, offset: int) -> None:
        """An event comes."""
        self.event[offset] = 1
        self.line()

    def line(self) -> None:
        """The interrupt's line follows the events."""
        if any(self.event[offset] and self.inten >> bit & 1 for offset, bit in self.EVENTS.items()):
            self.machine.pend(EXC_IRQ0 + self.irq)
        else:
            self.machine.unpend(EXC_IRQ0 + self.irq)

    def read(self, offset: int) -> int:
        """Events and registers."""
        if offset in self.event:
            return self.event[offset]
        return self.registers[offset]

    def write(self, offset: int, value: int) -> None:
        """Events, INTENSET, INTENCLR, registers, and what changed() makes of them; tasks are started by a 1."""
        if offset in self.event:
            self.event[offset] = value
        elif offset == 0x304:
            self.inten |= value
        elif offset == 0x308:
            self.inten &= ~value
        elif offset in self.registers:
            self.registers[offset] = value
            self.changed(offset, value)
        elif value == 1:
            self.task(offset)
        else:
            raise KeyError(offset)
        self.line()

    def changed(self, offset: int, value: int) -> None:
        """A register was written."""

    def task(self, offset: int) -> None:
        """A task was started."""
        raise KeyError(offset)


class PowerClock(Peripheral):
    """POWER and CLOCK, which share a base. HFCLK's crystal starts within 1 ms, or never (`crystal`). RESETREAS adds up
    until it is cleared by ones; it and GPREGRET outlive a reset."""

    base, size = 0x40000000, 0x1000
    EVENTS: ClassVar = {0x100: 0}
    REGISTERS = (0x518, 0x554)
    REASON: ClassVar = {"pin": 1, "watchdog": 2, "software": 4}

    def __init__(self, machine: Machine) -> None:
        super().__init__(machine)
        self.crystal = True
        self.power_on()

    def power_on(self) -> None:
        """RESETREAS is 0."""
        self.reason = self.kept = 0

    def note_reset(self, cause: str) -> None:
        """A reset came."""
        self.reason |= self.REASON[cause]

    def reset(self) -> None:
        """The internal oscillators."""
        super().reset()
        self.running = False

    def task(self, offset: int) -> None:
        """HFCLKSTART, LFCLKSTART."""
        if offset == 0x000 and self.crystal:
            self.machine.at(800.0, self._started)
        elif offset not in (0x000, 0x008):
            raise KeyError(offset)

    def _started(self) -> None:
        self.running = True
        self.happen(0x100)

    def read(self, offset: int) -> int:
        """RESETREAS, HFCLKSTAT, GPREGRET."""
        if offset == 0x40C:
            return self.running | 1 << 16
        if offset == 0x400:
            return self.reason
        return self.kept if offset == 0x51C else super().read(offset)

    def write(self, offset: int, value: int) -> None:
        """RESETREAS, GPREGRET."""
        if offset == 0x400:
            self.reason &= ~value
        elif offset == 0x51C:
            self.kept = value & 0xFF
        else:
            super().write(offset, value)


class Gpio(Peripheral):
    """GPIO. `on_output(pin, level)` is called when an output changes; lines that nobody drives are pulled up."""

    base, size = 0x50000000, 0x1000
    REGISTERS = tuple(0x700 + 4 * pin for pin in range(32))

    def __init__(self, machine: Machine) -> None:
        super().__init__(machine)
        self.on_output: Callable[[int, bool], None] = lambda pin, level: None
        self.inputs: Callable[[], int] = lambda: 0xFFFFFFFF

    def reset(self) -> None:
        """Inputs, their buffers off (PIN_CNF 2)."""
        super().reset()
        self.registers = dict.fromkeys(self.REGISTERS, 2)
        self.out = 0

    def level(self, pin: int) -> bool:
        """Of a line."""
        return bool(self.out >> pin & 1) if self.registers[0x700 + 4 * pin] & 1 else True

    def read(self, offset: int) -> int:
        """IN, PIN_CNF."""
        return self.inputs() if offset == 0x510 else super().read(offset)

    def write(self, offset: int, value: int) -> None:
        """OUTSET, OUTCLR, PIN_CNF."""
        before = [self.level(pin) for pin in range(32)]
        if offset == 0x508:
            self.out |= value
        elif offset == 0x50C:
            self.out &= ~value
        else:
            super().write(offset, value)
        for pin in range(32):
            if self.level(pin) != before[pin]:
                self.on_output(pin, self.level(pin))


class Gpiote(Peripheral):
    """GPIOTE, channel 0 as an event."""

    base, irq = 0x40006000, 6
    EVENTS: ClassVar = {0x100: 0}
    REGISTERS = (0x510,)
    size = 0x1000

    def edge(self, pin: int, rising: bool) -> None:
        """An edge on a pin."""
        config = self.registers[0x510]
        if config & 3 == 1 and config >> 8 & 31 == pin and config >> 16 & 3 in ((1, 3) if rising else (2, 3)):
            self.happen(0x100)


class Timer0(Peripheral):
    """TIMER 0: 16 MHz / 2^PRESCALER; CAPTURE0 into CC0, COMPARE1."""

    base, irq, size = 0x40008000, 8, 0x1000
    EVENTS: ClassVar = {0x144: 17}
    REGISTERS = (0x508, 0x510, 0x540, 0x544)

    def reset(self) -> None:
        """Stopped, at 0."""
        super().reset()
        self.started: float | None = None
        self.match: Event | None = None

    def _count(self) -> int:
        if self.started is None:
            return 0
        return int((self.machine.time_us - self.started) * 16.0 / (1 << self.registers[0x510])) & 0xFFFFFFFF

    def task(self, offset: int) -> None:
        """START, CAPTURE0."""
        if offset == 0x000:
            if self.registers[0x508] != 3:
                self.machine.violations.append("TIMER0 started with less than 32 bits")
            self.started = self.machine.time_us
            self._schedule()
        elif offset == 0x040:
            self.registers[0x540] = self._count()
        else:
            raise KeyError(offset)

    def changed(self, offset: int, value: int) -> None:
        """CC1."""
        if offset == 0x544 and self.started is not None:
            self._schedule()

    def _schedule(self) -> None:
        """The next match: at once is too late, and then it is 2^32 counts away."""
        if self.match is not None:
            self.match.cancel()
        tick_us = (1 << self.registers[0x510]) / 16.0
        passed = (self.machine.time_us - (self.started or 0.0)) / tick_us
        left = (self.registers[0x544] - passed) % 2**32
        self.match = self.machine.at(left * tick_us, lambda: self.happen(0x144))


class Wdt(Peripheral):
    """WDT, by the 32 768 Hz clock; RR0 alone reloads it."""

    base, size = 0x40010000, 0x1000
    REGISTERS = (0x504, 0x50C)
    bite: Event | None = None

    def reset(self) -> None:
        """Stopped."""
        super().reset()
        if self.bite is not None:
            self.bite.cancel()
        self.bite = None

    def _reload(self) -> None:
        if self.bite is not None:
            self.bite.cancel()
        seconds = (self.registers[0x504] + 1) / 32768.0
        self.bite = self.machine.at(seconds * 1e6, lambda: self.machine.reset("watchdog"))

    def task(self, offset: int) -> None:
        """START."""
        if offset != 0x000:
            raise KeyError(offset)
        self._reload()

    def write(self, offset: int, value: int) -> None:
        """RR0; the rest."""
        if offset == 0x600:
            if value == 0x6E524635 and self.bite is not None:
                self._reload()
        elif offset in self.registers and self.bite is not None:
            self.machine.violations.append("WDT set up while it runs")
        else:
            super().write(offset, value)


class Rng(Peripheral):
    """RNG: a byte each 677 us with bias correction, none when `dead`."""

    base, size = 0x4000D000, 0x1000
    EVENTS: ClassVar = {0x100: 0}
    REGISTERS = (0x504,)

    def __init__(self, machine: Machine) -> None:
        super().__init__(machine)
        self.dead = False

    def reset(self) -> None:
        """Stopped."""
        super().reset()
        self.on = False
        self.value = 0

    def task(self, offset: int) -> None:
        """START, STOP."""
        if offset not in (0x000, 0x004):
            raise KeyError(offset)
        self.on = offset == 0x000
        if self.on:
            self.machine.at(677.0, self._next)

    def _next(self) -> None:
        if self.on and not self.dead:
            self.value = self.machine.random.getrandbits(8)
            self.happen(0x100)
            self.machine.at(677.0, self._next)

    def read(self, offset: int) -> int:
        """VALUE."""
        return self.value if offset == 0x508 else super().read(offset)


class Spi0(Peripheral):
    """SPI master: RXD and TXD double buffered. READY comes when a byte is in RXD; the next waits until that is read.

    `device(byte, mode, sck_hz, end_us)` answers a byte that ends then; `flip` is the chance that a bit is turned over
    on either wire.
    """

    base, irq, size = 0x40003000, 3, 0x1000
    EVENTS: ClassVar = {0x108: 2}
    REGISTERS = (0x500, 0x508, 0x50C, 0x510, 0x524, 0x554)

    def __init__(self, machine: Machine) -> None:
        super().__init__(machine)
        self.device: Callable[[int, int, float, float], int] = lambda byte, mode, hz, end: 0xFF
        self.flip = 0.0
        self.flipped = 0
        self.hang = 0  # bytes that never end, to come

    def reset(self) -> None:
        """Off."""
        super().reset()
        self._drop()

    def _drop(self) -> None:
        self.waiting: int | None = None
        self.received: list[int] = []
        self.shift: Event | None = None

    def changed(self, offset: int, value: int) -> None:
        """ENABLE: off forgets what is under way."""
        if offset == 0x500 and value != 1:
            if self.shift is not None:
                self.shift.cancel()
            self._drop()

    def read(self, offset: int) -> int:
        """RXD."""
        if offset != 0x518:
            return super().read(offset)
        byte = self.received.pop(0) if self.received else 0
        if self.received:
            self.happen(0x108)
        self._go()
        return byte

    def write(self, offset: int, value: int) -> None:
        """TXD."""
        if offset != 0x51C:
            super().write(offset, value)
            return
        if self.registers[0x500] != 1:
            self.machine.violations.append("SPI0: TXD written while it is off")
        elif self.waiting is not None:
            self.machine.violations.append("SPI0: TXD written while a byte waits in it")
        self.waiting = value & 0xFF
        self._go()

    def _noisy(self, byte: int) -> int:
        if self.flip > 0.0:
            for bit in range(8):
                if self.machine.random.random() < self.flip:
                    byte ^= 1 << bit
                    self.flipped += 1
        return byte

    def _go(self) -> None:
        if self.shift is not None or self.waiting is None or len(self.received) >= 2:
            return
        byte, self.waiting = self._noisy(self.waiting), None
        hz = self.registers[0x524] / 0x10000000 * 1e6
        if self.hang > 0:
            self.hang -= 1
            self.shift = self.machine.at(1e12, lambda: None)
            return

        def shifted() -> None:
            self.shift = None
            config = self.registers[0x554]
            if config & 1:
                self.machine.violations.append("SPI0: least significant bit first")
            mode = (config >> 2 & 1) << 1 | config >> 1 & 1
            got = self.device(byte, mode, hz, self.machine.time_us)
            self.received.append(self._noisy(got))
            if len(self.received) == 1:
                self.happen(0x108)
            self._go()

        self.shift = self.machine.at(8e6 / hz, shifted)


class Uart0(Peripheral):
    """UART 0, at the baud rate that BAUDRATE makes; six bytes of what comes are kept. `say(bytes)` is the host's side;
    what the firmware sends goes to `on_byte`."""

    base, irq, size = 0x40002000, 2, 0x1000
    EVENTS: ClassVar = {0x108: 2, 0x11C: 7, 0x124: 9}
    REGISTERS = (0x500, 0x50C, 0x514, 0x524)

    def __init__(self, machine: Machine) -> None:
        super().__init__(machine)
        self.on_byte: Callable[[int], None] = lambda byte: None
        self.incoming = bytearray()
        self.overruns = 0

    def reset(self) -> None:
        """Off."""
        super().reset()
        self.fifo: list[int] = []
        self.errors = 0
        self.sending: int | None = None
        self.transmits = self.receives = False

    @property
    def _byte_us(self) -> float:
        return 10e6 / (self.registers[0x524] * 16e6 / 2**32)

    def task(self, offset: int) -> None:
        """STARTRX, STARTTX."""
        self.receives = self.receives or offset == 0x000
        self.transmits = self.transmits or offset == 0x008
        if offset not in (0x000, 0x008):
            raise KeyError(offset)

    def say(self, data: bytes) -> None:
        """Bytes from the host, back to back at 115200 baud."""
        idle = not self.incoming
        self.incoming += data
        if idle:
            self.machine.at(10e6 / 115200.0, self._arrive)

    def _arrive(self) -> None:
        byte = self.incoming.pop(0)
        if self.receives and self.registers[0x500] == 4:
            if abs(self._byte_us / (10e6 / 115200.0) - 1.0) > 0.03:
                byte = self.machine.random.getrandbits(8)
            if len(self.fifo) == 6:
                self.overruns += 1
                self.errors |= 1
                self.happen(0x124)
            else:
                self.fifo.append(byte)
                if len(self.fifo) == 1:
                    self.happen(0x108)
        if self.incoming:
            self.machine.at(10e6 / 115200.0, self._arrive)

    def read(self, offset: int) -> int:
        """RXD, ERRORSRC."""
        if offset == 0x480:
            return self.errors
        if offset != 0x518:
            return super().read(offset)
        byte = self.fifo.pop(0) if self.fifo else 0
        if self.fifo:
            self.happen(0x108)
        return byte

    def write(self, offset: int, value: int) -> None:
        """TXD, ERRORSRC."""
        if offset == 0x480:
            self.errors &= ~value
        elif offset == 0x51C:
            if self.sending is not None or not self.transmits:
                self.machine.violations.append("UART0: TXD written before TXDRDY")
            self.sending = value & 0xFF
            self.machine.at(self._byte_us, self._sent)
        else:
            super().write(offset, value)

    def _sent(self) -> None:
        byte, self.sending = self.sending, None
        if byte is not None:
            self.on_byte(byte)
        self.happen(0x11C)


class Nvmc(Peripheral):
    """NVMC: a page is erased by its address in ERASEPAGE with CONFIG at Een, a whole word written with CONFIG at Wen,
    twice at most between erases; both hold the processor up. `operations` counts both; `cut_at` cuts the power within
    that one, whose cells are then left in between; `fail_at` is one that does nothing."""

    base, size = 0x4001E000, 0x1000
    REGISTERS = (0x504,)

    def __init__(self, machine: Machine) -> None:
        super().__init__(machine)
        self.operations = 0
        self.erases: dict[int, int] = {}
        self.cut_at = self.fail_at = -1
        self.history: list[tuple[int, bytes, bytes]] = []  # address, content before and after, if `keep_history`
        self.keep_history = False
        self._writes: dict[int, int] = {}
        machine.uc.hook_add(UC_HOOK_MEM_WRITE, self._store, None, NRF51822.flash, NRF51822.flash_bytes - 1)

    def reset(self) -> None:
        """Read only."""
        super().reset()
        self._put: tuple[int, bytes] | None = None

    def settle(self) -> None:
        """The cells as the last operation left them."""
        if self._put is not None:
            self.machine.uc.mem_write(*self._put)
            self._put = None

    def _done(self, address: int, old: bytes, new: bytes, us: float) -> None:
        if self.keep_history:
            self.history.append((address, old, new))
        self.operations += 1
        self.machine.stall(us)

    def _store(self, uc: Uc, access: int, address: int, size: int, value: int, data: object) -> None:
        """A store to the flash. Unicorn carries it out after this; what it leaves is put right in settle()."""
        self.settle()
        old = bytes(uc.mem_read(address, size))
        self._put = (address, old)
        if self.registers[0x504] != 1 or size != 4 or address % 4:
            self.machine.violations.append(f"store of {size} bytes to flash {address:#x} that it refuses")
            return
        self._writes[address] = self._writes.get(address, 0) + 1
        if self._writes[address] > WRITES_MOST:
            self.machine.violations.append(f"flash {address:#x} written more than {WRITES_MOST} times between erases")
        new = bytes(a & b for a, b in zip(old, value.to_bytes(4, "little"), strict=True))
        if self.operations == self.fail_at:
            new = old
        if self.operations == self.cut_at:
            new = half_programmed(old, new, self.machine.random)
            self.machine.stop("power cut")
        self._put = (address, new)
        self._done(address, old, new, WRITE_US)

    def read(self, offset: int) -> int:
        """READY: the processor stood still while it was not."""
        self.settle()
        return 1 if offset == 0x400 else super().read(offset)

    def write(self, offset: int, value: int) -> None:
        """CONFIG, ERASEPAGE."""
        self.settle()
        if offset != 0x508:
            super().write(offset, value)
            return
        uc = self.machine.uc
        if self.registers[0x504] != 2 or value % PAGE:
            self.machine.violations.append(f"erase of {value:#x} that the NVMC refuses")
            return
        if value < self.machine.symbols["link_data_load"]:
            self.machine.violations.append("a page of the code erased")
        old = bytes(uc.mem_read(value, PAGE))
        new = b"\xff" * PAGE if self.operations != self.fail_at else old
        if self.operations == self.cut_at:
            new = half_erased(old, self.machine.random)
            self.machine.stop("power cut")
        uc.mem_write(value, new)
        self.erases[value] = self.erases.get(value, 0) + 1
        for address in range(value, value + PAGE, 4):
            self._writes.pop(address, None)
        self._done(value, old, new, ERASE_US)
