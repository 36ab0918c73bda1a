"""The processor: Unicorn's Cortex-M4F or -M0 with the NVIC, SysTick and system control block that it lacks, and time.

Time goes by one cycle an instruction while the processor runs, and jumps to the next event while it sleeps (WFI).
Interrupts are taken between any two instructions, where their event falls. A handler is broken into by one of a higher
priority (a lower number) alone.
"""

from __future__ import annotations

import ctypes
import heapq
import itertools
import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import unicorn.arm_const as arm
from elftools.elf.elffile import ELFFile
from elftools.elf.sections import SymbolTableSection
from unicorn import Uc, UcError  # type: ignore[attr-defined]  # the package re-exports them without saying so
from unicorn.unicorn_const import (
    UC_ARCH_ARM,
    UC_HOOK_BLOCK,
    UC_HOOK_CODE,
    UC_HOOK_INTR,
    UC_MODE_MCLASS,
    UC_MODE_THUMB,
)

if TYPE_CHECKING:
    from unicorn.unicorn_py3.unicorn import UcContext

SRAM = 0x20000000
CCM = 0x10000000  # core-coupled memory: the STM32F405's DMA does not reach it


@dataclass(frozen=True)
class Core:
    """A microcontroller: Unicorn's processor, its memories, the clock it starts with in MHz.

    `slice`, `long_slice`: instructions at a stretch, within one of which only accesses and known delays let time go by:
    short (9 us) while the firmware is busy with peripherals, longer while it computes. `fine`: the same in handlers, so
    that their delays are measured. `turn`: cycles that a turn of clock_spin_us() takes at least, beyond one for each of
    its two instructions (Cortex-M0 TRM 3.3: a branch that is taken, three).
    """

    cpu: int
    flash: int
    flash_bytes: int
    sram_bytes: int
    mhz: float
    slice: int
    long_slice: int
    fine: int
    turn: int
    ccm_bytes: int = 0


STM32F405 = Core(arm.UC_CPU_ARM_CORTEX_M4, 0x08000000, 0x100000, 0x20000, 16.0, 1500, 24_000, 100, 0, 0x10000)
NRF51822 = Core(arm.UC_CPU_ARM_CORTEX_M0, 0, 0x40000, 0x8000, 16.0, 150, 2400, 20, 2)
HANDLER_MOST = 400_000  # instructions a handler may take
ACCESS_US = 0.03  # a peripheral access, about 5 cycles
WFI = b"\x30\xbf"
SPIN_LOOP = bytes.fromhex("0138 fdd1")  # subs r0, #1; bne to it

EXC_HARD_FAULT, EXC_SYSTICK, EXC_IRQ0 = 3, 15, 16


class Part:
    """Registers at `base`, `size` bytes. `reset()` is called at every reset of the processor."""

    base = 0
    size = 0x400

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        machine.parts.append(self)

    def reset(self) -> None:
        """Registers to their reset values."""

    def read(self, offset: int) -> int:
        """A 32-bit register."""
        raise KeyError(offset)

    def write(self, offset: int, value: int) -> None:
        """A 32-bit register."""
        raise KeyError(offset)


class Event:
    """A call at a time; `cancel()` makes it void."""

    def __init__(self, at_us: float, call: Callable[[], None]) -> None:
        self.at_us = at_us
        self.call: Callable[[], None] | None = call

    def cancel(self) -> None:
        """Never happens."""
        self.call = None


class Machine:
    """Processor and time. `now_us`: since power came on."""

    def __init__(self, elf: Path, seed: int = 0, core: Core = STM32F405) -> None:
        self.core = core
        self.parts: list[Part] = []
        self.random = random.Random(seed)
        self.now_us = 0.0
        self.hclk_mhz = core.mhz
        self.violations: list[str] = []
        self.resets: list[tuple[float, str]] = []  # when and why
        self.stopped: str | None = None  # why the run ended before its time: power cut
        self.faults: list[tuple[int, str]] = []
        self._events: list[tuple[float, int, Event]] = []
        self._order = itertools.count()
        self._pending: set[int] = set()
        self._enabled: set[int] = set()
        self.priority: dict[int, int] = {}  # of exceptions that do not have 0, the highest
        self._asleep = False
        self._reset_wanted: str | None = None
        self._exception_return = False
        self._in_handler = False
        self._slice = core.slice
        self._spent = 0.0  # us of peripheral accesses within the slice
        self.on_reset: Callable[[str], None] = lambda cause: None
        self.uc = Uc(UC_ARCH_ARM, UC_MODE_THUMB | UC_MODE_MCLASS)
        self._contexts: list[UcContext] = []  # to be used again
        self._value = ctypes.c_uint64()
        self._pointer = ctypes.byref(self._value)
        self.uc.ctl_set_cpu_model(core.cpu)
        self.uc.mem_map(core.flash, core.flash_bytes)
        self.uc.mem_map(SRAM, core.sram_bytes)
        self.uc.mem_write(core.flash, b"\xff" * core.flash_bytes)
        if core.ccm_bytes:
            self.uc.mem_map(CCM, core.ccm_bytes)
        self.scramble()
        self.symbols: dict[str, int] = {}
        self._load(elf)
        self.uc.hook_add(UC_HOOK_INTR, self._interrupt_hook)
        spin = self.symbols["clock_spin_us"] & ~1
        loop = bytes(self.uc.mem_read(spin, 64)).find(SPIN_LOOP)
        self._spin = spin + loop if loop >= 0 else None  # another compiler's: in short stretches, as the rest
        self.uc.hook_add(UC_HOOK_CODE, self._spin_hook, None, spin, spin)
        if core.turn:
            self.uc.hook_add(UC_HOOK_BLOCK, self._turn_hook, None, spin, spin + 2)
        self._pages: dict[int, list[tuple[Part, int, int]]] = {}  # and from where to where

    def _load(self, path: Path) -> None:
        with path.open("rb") as file:
            elf = ELFFile(file)
            for segment in elf.iter_segments("PT_LOAD"):
                if segment["p_filesz"]:
                    self.uc.mem_write(segment["p_paddr"], segment.data())
            table = elf.get_section_by_name(".symtab")
            assert isinstance(table, SymbolTableSection), "the image is stripped"
            for symbol in table.iter_symbols():
                self.symbols[symbol.name] = symbol["st_value"]

    def start(self) -> None:
        """Power on: once, when every part is there."""
        for part in self.parts:
            for page in range(part.base & ~0xFFF, part.base + part.size, 0x1000):
                self._pages.setdefault(page, []).append((part, part.base, part.base + part.size))
        for page in self._pages:
            self.uc.mmio_map(page, 0x1000, self._mmio_read, page, self._mmio_write, page)
        self._restart()

    def scramble(self) -> None:
        """What power-on leaves in the memories: chance."""
        self.uc.mem_write(SRAM, self.random.randbytes(self.core.sram_bytes))
        if self.core.ccm_bytes:
            self.uc.mem_write(CCM, self.random.randbytes(self.core.ccm_bytes))

    def power_cycle(self) -> None:
        """Every event that was to come is void."""
        self._events.clear()
        self._spent = 0.0
        self.stopped = None
        self._restart()

    # ------------------------------------------------------------------------------------------------------ peripherals

    def _mmio_read(self, uc: Uc, offset: int, size: int, page: int) -> int:
        address = page + offset
        self._spent += ACCESS_US
        for part, base, end in self._pages[page]:
            if base <= address < end:
                try:
                    return part.read(address - base) & 0xFFFFFFFF
                except KeyError:
                    break
        self.violations.append(f"read of {address:#x}, which no model has")
        return 0

    def _mmio_write(self, uc: Uc, offset: int, size: int, value: int, page: int) -> None:
        address = page + offset
        self._spent += ACCESS_US
        for part, base, end in self._pages[page]:
            if base <= address < end:
                try:
                    part.write(address - base, value & 0xFFFFFFFF)
                    return
                except KeyError:
                    break
        self.violations.append(f"write of {value:#x} to {address:#x}, which no model has")

    @property
    def time_us(self) -> float:
        """Now, within a slice as far as it is known."""
        return self.now_us + self._spent

    def at(self, delay_us: float, call: Callable[[], None]) -> Event:
        """Call after a delay."""
        event = Event(self.time_us + delay_us, call)
        heapq.heappush(self._events, (event.at_us, next(self._order), event))
        return event

    def stall(self, us: float) -> None:
        """The processor stands still, as on a flash operation."""
        self._spent += us

    def wait(self, until_us: float) -> None:
        """Turns of a loop that asks a part until then, or until the next event, are left out."""
        self._spent = max(self._spent, min(until_us, self._next_us()) - self.now_us)

    def pend(self, exception: int) -> None:
        """Interrupt n is exception 16 + n."""
        self._pending.add(exception)

    def unpend(self, exception: int) -> None:
        """Withdraw."""
        self._pending.discard(exception)

    def enable(self, exception: int, on: bool = True) -> None:
        """NVIC_ISER, NVIC_ICER."""
        (self._enabled.add if on else self._enabled.discard)(exception)

    def reset(self, cause: str) -> None:
        """At the end of the instruction: "software", "watchdog", "pin"."""
        self._reset_wanted = cause
        self.uc.emu_stop()

    def stop(self, why: str) -> None:
        """End the run, as a power cut does."""
        self.stopped = why
        self.uc.emu_stop()

    # ---------------------------------------------------------------------------------------------------------
    # exceptions

    def _interrupt_hook(self, uc: Uc, number: int, data: object) -> None:
        if self._register(arm.UC_ARM_REG_PC) >= 0xFFFFFF00:
            self._exception_return = True
        uc.emu_stop()

    def _spin_hook(self, uc: Uc, address: int, size: int, data: object) -> None:
        """Outside handlers, time within a slice is not known: there the firmware's delay is taken at its word."""
        if not self._in_handler:
            self._spent += self._register(arm.UC_ARM_REG_R0)

    def _turn_hook(self, uc: Uc, address: int, size: int, data: object) -> None:
        """A turn of the delay."""
        if self._in_handler:
            self._spent += self.core.turn / self.hclk_mhz

    def _register(self, number: int) -> int:
        """Of the core. Uc.reg_read() without its search for the register's class, which takes most of its time."""
        self.uc._do_reg_read(number, self._pointer)  # type: ignore[attr-defined]  # not in its exported type
        return self._value.value

    def _vector(self, exception: int) -> int:
        return int.from_bytes(self.uc.mem_read(self.core.flash + 4 * exception, 4), "little")

    def _take(self, exception: int) -> None:
        """Run a handler to its end. Registers are put back whole; the frame's room on the stack is taken (PM0214
        2.3.7)."""
        uc = self.uc
        if not self._contexts:
            self._contexts.append(uc.context_save())
        context = self._contexts.pop()
        uc.context_update(context)
        outer, priority = self._in_handler, self.priority.get(exception, 0)
        uc.reg_write(arm.UC_ARM_REG_SP, (self._register(arm.UC_ARM_REG_SP) - 104) & ~7)
        uc.reg_write(arm.UC_ARM_REG_LR, 0xFFFFFFF9)
        self._exception_return = False
        self._in_handler = True
        address = self._vector(exception)
        left = HANDLER_MOST
        while left > 0:
            count = self._stretch(address, priority)
            self._run(address, count)
            if self._exception_return:
                break
            if self._reset_wanted or self.stopped:
                return
            self._spent += count / self.hclk_mhz
            left -= count
            if priority > 0 and (self._pending or self._next_us() <= self.time_us):
                self._preempt(priority)
                if self._reset_wanted or self.stopped:
                    return
            address = self._register(arm.UC_ARM_REG_PC)
        else:
            self.violations.append(
                f"handler of exception {exception} did not return within {HANDLER_MOST} instructions"
            )
        self._in_handler = outer
        uc.context_restore(context)
        self._contexts.append(context)
        self._exception_return = False
        self._spent += 0.3  # entry and exit

    def _stretch(self, address: int, priority: int) -> int:
        """Instructions of a handler to run in one go: in the delay's loop to its end, or to the next event if that may
        bring what breaks in; elsewhere a few."""
        within = -1 if self._spin is None else address - self._spin
        if within not in (0, 2):
            return self.core.fine
        turns = float(min(self._register(arm.UC_ARM_REG_R0), HANDLER_MOST))
        if priority > 0:
            turns = min(turns, 1 + (self._next_us() - self.time_us) * self.hclk_mhz / (2 + self.core.turn))
        return max(2, 2 * int(turns) + within // 2)

    def _preempt(self, priority: int) -> None:
        """Between two stretches of a handler: what is due, and the handlers that break into this one."""
        self.now_us += self._spent
        self._spent = 0.0
        self._events_due()
        while not self._reset_wanted and not self.stopped:
            higher = [exception for exception in self._ready() if self.priority.get(exception, 0) < priority]
            if not higher or self._register(arm.UC_ARM_REG_PRIMASK) & 1:
                break
            self._pending.discard(higher[0])
            self._take(higher[0])
            self.now_us += self._spent
            self._spent = 0.0
            self._events_due()

    def _fault(self, error: UcError) -> None:
        """HardFault, with the frame that its handler looks at."""
        uc = self.uc
        pc = self._register(arm.UC_ARM_REG_PC)
        self.faults.append((pc, str(error)))
        stack = (self._register(arm.UC_ARM_REG_SP) - 32) & ~7
        framed = (*range(arm.UC_ARM_REG_R0, arm.UC_ARM_REG_R0 + 4), arm.UC_ARM_REG_R12, arm.UC_ARM_REG_LR)
        values = [*(self._register(number) for number in framed), pc, 0x01000000]
        if stack - SRAM in range(self.core.sram_bytes - 32):
            uc.mem_write(stack, b"".join(value.to_bytes(4, "little") for value in values))
        uc.reg_write(arm.UC_ARM_REG_SP, stack)
        uc.reg_write(arm.UC_ARM_REG_LR, 0xFFFFFFF9)
        if len(self.faults) > 1000:
            raise RuntimeError(f"faults without end, the last at {pc:#x}: {error}")
        self._run(self._vector(EXC_HARD_FAULT), HANDLER_MOST)

    def _run(self, address: int, count: int) -> None:
        try:
            self.uc.emu_start(address | 1, 0xFFFFFFFE, count=count)
        except UcError as error:
            self._fault(error)

    def _restart(self) -> None:
        uc = self.uc
        for part in self.parts:
            part.reset()
        self._pending.clear()
        self._enabled.clear()
        self.priority.clear()
        self._asleep = self._in_handler = False
        self._reset_wanted = None
        for number in range(13):
            uc.reg_write(arm.UC_ARM_REG_R0 + number, 0)
        uc.reg_write(arm.UC_ARM_REG_PRIMASK, 0)
        uc.reg_write(arm.UC_ARM_REG_SP, self._vector(0))
        uc.reg_write(arm.UC_ARM_REG_LR, 0xFFFFFFFF)
        uc.reg_write(arm.UC_ARM_REG_PC, self._vector(1) | 1)

    # ---------------------------------------------------------------------------------------------------------------
    # time

    def _events_due(self) -> None:
        """Each at its own time, however late the processor lets it be seen: the world does not stand still with it."""
        now = self.now_us
        while self._events and self._events[0][0] <= now:
            self.now_us, _, event = heapq.heappop(self._events)
            if event.call is not None:
                event.call()
        self.now_us = now

    def _next_us(self) -> float:
        while self._events and self._events[0][2].call is None:
            heapq.heappop(self._events)
        return self._events[0][0] if self._events else math.inf

    def _ready(self) -> list[int]:
        """What may be taken, first things first (PM0214 2.3.5)."""
        ready = (e for e in self._pending if e < EXC_IRQ0 or e in self._enabled)
        return sorted(ready, key=lambda e: (self.priority.get(e, 0), e))

    def run(self, until_us: float) -> None:
        """Let time go by up to `until_us`, or until stop()."""
        uc = self.uc
        while self.now_us < until_us and self.stopped is None:
            self.now_us += self._spent
            self._spent = 0.0
            self._events_due()
            if self._reset_wanted:
                cause = self._reset_wanted
                self.resets.append((self.now_us, cause))
                self.on_reset(cause)
                self._restart()
                continue
            ready = self._ready() if self._pending else []
            if ready:
                self._asleep = False
                if not self._register(arm.UC_ARM_REG_PRIMASK) & 1:
                    self._pending.discard(ready[0])
                    self._take(ready[0])
                    continue
            if self._asleep:
                self.now_us = max(self.now_us, min(self._next_us(), until_us))
                continue
            span = min(self._next_us(), until_us) - self.now_us
            count = 20 if ready else max(1, min(self._slice, int(span * self.hclk_mhz)))
            self._run(self._register(arm.UC_ARM_REG_PC), count)
            pc = self._register(arm.UC_ARM_REG_PC)
            if self._reset_wanted or self.stopped:
                continue
            if bytes(uc.mem_read(pc - 2, 2)) == WFI:
                self._asleep = True
                self._spent += 1.0  # how far it got is not known
            else:
                self._slice = self.core.slice if self._spent > 0.0 else min(2 * self._slice, self.core.long_slice)
                self._spent = max(self._spent, count / self.hclk_mhz)
        self.now_us += self._spent
        self._spent = 0.0


class SystemControl(Part):
    """SysTick (PM0214 4.5), NVIC (4.3), SCB (4.4) and the FPU's access register (4.6.1)."""

    base, size = 0xE000E000, 0x1000
    tick: Event | None = None

    def reset(self) -> None:
        """Off."""
        self.csr = self.rvr = 0
        self.start_us = 0.0
        if self.tick is not None:
            self.tick.cancel()
        self.tick = None

    def _period_us(self) -> float:
        return (self.rvr + 1) / self.machine.hclk_mhz

    def _tick(self) -> None:
        self.machine.pend(EXC_SYSTICK)
        # on the grid of the start, whatever delayed this one
        now = self.machine.time_us
        period = self._period_us()
        passed = int((now - self.start_us) / period + 0.01) + 1
        self.tick = self.machine.at(self.start_us + passed * period - now, self._tick)

    def read(self, offset: int) -> int:
        """SYST_*, NVIC_IPR, CFSR, SHCSR, CPACR."""
        if offset == 0x10:
            return self.csr
        if offset == 0x14:
            return self.rvr
        if offset == 0x18:
            passed = (self.machine.time_us - self.start_us) * self.machine.hclk_mhz
            return int(self.rvr - passed % (self.rvr + 1))
        if 0x400 <= offset < 0x4F0:
            exceptions = range(EXC_IRQ0 + offset - 0x400, EXC_IRQ0 + offset - 0x3FC)
            return sum(self.machine.priority.get(e, 0) << 8 * k for k, e in enumerate(exceptions))
        if offset == 0xD88:
            return int(self.machine.uc.reg_read(arm.UC_ARM_REG_C1_C0_2))
        if offset in (0xD28, 0xD24, 0xD0C):
            return 0
        raise KeyError(offset)

    def write(self, offset: int, value: int) -> None:
        """SYST_*, NVIC_ISER, NVIC_ICER, NVIC_IPR, AIRCR, CPACR."""
        if offset == 0x10:
            self.csr = value
            if self.tick is not None:
                self.tick.cancel()
                self.tick = None
            if value & 3 == 3:
                self.start_us = self.machine.time_us
                self.tick = self.machine.at(self._period_us(), self._tick)
        elif offset == 0x14:
            self.rvr = value & 0xFFFFFF
        elif offset == 0x18:
            self.start_us = self.machine.time_us
        elif 0x100 <= offset < 0x10C or 0x180 <= offset < 0x18C:
            for bit in range(32):
                if value >> bit & 1:
                    self.machine.enable(EXC_IRQ0 + 8 * (offset & 0x7F) + bit, on=offset < 0x180)
        elif 0x400 <= offset < 0x4F0:
            for byte in range(4):  # the high bits alone are there: four of them, two on a Cortex-M0
                self.machine.priority[EXC_IRQ0 + offset - 0x400 + byte] = value >> 8 * byte & 0xF0
        elif offset == 0xD0C:
            if value == 0x05FA0004:
                self.machine.reset("software")
        elif offset == 0xD88:
            self.machine.uc.reg_write(arm.UC_ARM_REG_C1_C0_2, value)
            self.machine.uc.reg_write(arm.UC_ARM_REG_FPEXC, 0x40000000 if value >> 20 & 0xF == 0xF else 0)
        else:
            raise KeyError(offset)


__all__ = ["EXC_IRQ0", "NRF51822", "SRAM", "STM32F405", "Core", "Event", "Machine", "Part", "SystemControl", "Uc"]
