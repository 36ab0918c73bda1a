"""Clocks, reset flags, power, the microsecond timer, the watchdog, pins and their interrupt lines."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from .machine import EXC_IRQ0, Event, Machine, Part

HSI_HZ = 16_000_000


class Rcc(Part):
    """RM0090 7.3. HSE starts within 2 ms and the PLL locks within 0.2 ms, or never (`crystal`, `pll_works`)."""

    base = 0x40023800
    FLAG: ClassVar = {"power": 0x0E000000, "pin": 0x04000000, "software": 0x14000000, "watchdog": 0x24000000}

    def __init__(self, machine: Machine) -> None:
        super().__init__(machine)
        self.crystal = True
        self.hse_hz = 8e6
        self.pll_works = True
        self.csr = self.FLAG["power"]

    def note_reset(self, cause: str) -> None:
        """Reset flags add up until RMVF, 7.3.21."""
        self.csr |= self.FLAG[cause]

    def reset(self) -> None:
        """Reset values, 7.3.1 to 7.3.3; the flags of CSR stay."""
        self.cr, self.pllcfgr, self.cfgr = 0x83, 0x24003010, 0
        self.enabled = dict.fromkeys((0x30, 0x34, 0x40, 0x44), 0)
        self.hse_at = self.pll_at = float("inf")
        self._apply()

    def _pll_hz(self) -> float:
        source = self.hse_hz if self.pllcfgr >> 22 & 1 else HSI_HZ
        m, n = self.pllcfgr & 0x3F, self.pllcfgr >> 6 & 0x1FF
        p = 2 * ((self.pllcfgr >> 16 & 3) + 1)
        if not 0.95e6 <= source / m <= 2.1e6 or not 100e6 <= source / m * n <= 432e6:
            self.machine.violations.append("PLL input or VCO out of range, RM0090 7.3.2")
        return source / m * n / p

    @property
    def pll48_hz(self) -> float:
        """7.3.2, PLLQ; 0 without the PLL."""
        if self.machine.time_us < self.pll_at:
            return 0.0
        return self._pll_hz() * 2 * ((self.pllcfgr >> 16 & 3) + 1) / (self.pllcfgr >> 24 & 15)

    def _apply(self) -> None:
        pll = self.cfgr & 3 == 2
        self.sysclk_hz = self._pll_hz() if pll else float(HSI_HZ)
        if self.sysclk_hz > 168.1e6:
            self.machine.violations.append("SYSCLK above 168 MHz")
        self.machine.hclk_mhz = self.sysclk_hz / 1e6
        divider = [1, 1, 1, 1, 2, 4, 8, 16]
        self.pclk1_hz = self.sysclk_hz / divider[self.cfgr >> 10 & 7]
        self.pclk2_hz = self.sysclk_hz / divider[self.cfgr >> 13 & 7]
        self.tim_hz = self.pclk1_hz * (1 if self.cfgr >> 12 & 1 == 0 else 2)
        if self.pclk1_hz > 42.1e6 or self.pclk2_hz > 84.1e6:
            self.machine.violations.append("PCLK1 above 42 MHz or PCLK2 above 84 MHz")

    def read(self, offset: int) -> int:
        """CR, PLLCFGR, CFGR, xENR, CSR."""
        now = self.machine.time_us
        if offset == 0x00:
            return self.cr & 0x0D0D0003 | (now >= self.hse_at) << 17 | (now >= self.pll_at) << 25
        if offset == 0x04:
            return self.pllcfgr
        if offset == 0x08:
            return self.cfgr & ~0xC | (self.cfgr & 3) << 2
        if offset == 0x74:
            return self.csr
        return self.enabled[offset]

    def write(self, offset: int, value: int) -> None:
        """CR, PLLCFGR, CFGR, xENR, CSR."""
        now = self.machine.time_us
        if offset == 0x00:
            if value >> 16 & 1 and not self.cr >> 16 & 1 and self.crystal:
                self.hse_at = now + 2000.0
            if value >> 24 & 1 and not self.cr >> 24 & 1 and self.pll_works:
                self.pll_at = now + 200.0
            self.cr = value
        elif offset == 0x04:
            if self.cr >> 24 & 1:
                self.machine.violations.append("PLLCFGR written with the PLL on, RM0090 7.3.2")
            self.pllcfgr = value
        elif offset == 0x08:
            if value & 3 == 2 and now < self.pll_at:
                self.machine.violations.append("switched to a PLL that is not ready")
                value &= ~3
            self.cfgr = value
            self._apply()
        elif offset == 0x74:
            if value >> 24 & 1:
                self.csr = 0
        else:
            if offset not in self.enabled:
                raise KeyError(offset)
            self.enabled[offset] = value

    def clock_on(self, register: int, bit: int) -> bool:
        """Whether a peripheral has its clock."""
        return bool(self.enabled[register] >> bit & 1)


class Rng(Part):
    """RM0090 24.4: a number each 40 periods of the PLL's 48 MHz; without that clock none, and CECS."""

    base = 0x50060800

    def __init__(self, machine: Machine, rcc: Rcc) -> None:
        super().__init__(machine)
        self.rcc = rcc
        self.stuck = False  # the same number for ever

    def reset(self) -> None:
        """Off."""
        self.cr = 0
        self.ready_at = float("inf")

    def _next(self) -> None:
        hz = self.rcc.pll48_hz
        on = self.cr >> 2 & 1 and hz > 0.0 and self.rcc.clock_on(0x34, 6)
        self.ready_at = self.machine.time_us + 40e6 / hz if on else float("inf")

    def read(self, offset: int) -> int:
        """CR, SR, DR."""
        if offset == 0x04:
            return (self.machine.time_us >= self.ready_at) | (self.rcc.pll48_hz < 1e6) << 1
        if offset == 0x08:
            if self.machine.time_us < self.ready_at:
                self.machine.violations.append("RNG_DR read without DRDY")
                return 0
            self._next()
            return 0x12345678 if self.stuck else self.machine.random.getrandbits(32)
        return {0x00: self.cr}[offset]

    def write(self, offset: int, value: int) -> None:
        """CR."""
        if offset != 0x00:
            raise KeyError(offset)
        self.cr = value
        self._next()


class Pwr(Part):
    """RM0090 5.4: taken, without effect."""

    base = 0x40007000

    def reset(self) -> None:
        """VOS is 1."""
        self.cr = 0x4000

    def read(self, offset: int) -> int:
        """CR alone."""
        return {0: self.cr}[offset]

    def write(self, offset: int, value: int) -> None:
        """CR alone."""
        if offset != 0:
            raise KeyError(offset)
        self.cr = value


class Tim2(Part):
    """RM0090 18.4: counts up, 32 bits, free-running."""

    base = 0x40000000

    def __init__(self, machine: Machine, rcc: Rcc) -> None:
        super().__init__(machine)
        self.rcc = rcc

    def reset(self) -> None:
        """Off."""
        self.psc = self.active_psc = 0
        self.arr = 0xFFFFFFFF
        self.on = False
        self.start_us = 0.0

    def read(self, offset: int) -> int:
        """CNT."""
        if offset == 0x24:
            hz = self.rcc.tim_hz / (self.active_psc + 1)
            return int((self.machine.time_us - self.start_us) * hz / 1e6) & 0xFFFFFFFF if self.on else 0
        raise KeyError(offset)

    def write(self, offset: int, value: int) -> None:
        """CR1, EGR, PSC, ARR. The prescaler takes effect at an update event (18.4.11)."""
        if offset == 0x00:
            self.on = bool(value & 1)
            self.start_us = self.machine.time_us
        elif offset == 0x14:
            self.active_psc = self.psc
            self.start_us = self.machine.time_us
        elif offset == 0x28:
            self.psc = value & 0xFFFF
        elif offset == 0x2C:
            self.arr = value
        else:
            raise KeyError(offset)


class Iwdg(Part):
    """RM0090 21.4. `lsi_hz` may be 17 to 47 kHz (data sheet)."""

    base = 0x40003000
    end: Event | None = None

    def __init__(self, machine: Machine) -> None:
        super().__init__(machine)
        self.lsi_hz = 32_000.0

    def reset(self) -> None:
        """Off, as after any reset."""
        self.pr, self.rlr = 0, 0xFFF
        self.unlocked = False
        self.busy_until = 0.0
        if self.end is not None:
            self.end.cancel()
        self.end = None

    def _reload(self) -> None:
        if self.end is not None:
            self.end.cancel()
        period = (self.rlr + 1) * 4 * 2**self.pr / self.lsi_hz * 1e6
        self.end = self.machine.at(period, lambda: self.machine.reset("watchdog"))

    def read(self, offset: int) -> int:
        """PR, RLR, SR."""
        if offset == 0x0C:
            return 3 if self.machine.time_us < self.busy_until else 0
        return {0x04: self.pr, 0x08: self.rlr}[offset]

    def write(self, offset: int, value: int) -> None:
        """KR, PR, RLR; the latter two take five LSI cycles and need the key."""
        if offset == 0x00:
            self.unlocked = value == 0x5555
            if value == 0xCCCC or (value == 0xAAAA and self.end is not None):
                self._reload()
        elif offset in (0x04, 0x08):
            if not self.unlocked:
                self.machine.violations.append("IWDG register written without the key")
                return
            self.busy_until = self.machine.time_us + 5e6 / self.lsi_hz
            if offset == 0x04:
                self.pr = value & 7
            else:
                self.rlr = value & 0xFFF
        else:
            raise KeyError(offset)


class Gpio(Part):
    """RM0090 8.4, a port. `on_output(pin, level)` is called when an output changes."""

    size = 0x400

    def __init__(self, machine: Machine, base: int) -> None:
        self.base = base
        super().__init__(machine)
        self.on_output: Callable[[int, bool], None] = lambda pin, level: None
        self.inputs: Callable[[], int] = lambda: 0xFFFF
        self.odr = self._outputs = 0  # a bit a pin

    def reset(self) -> None:
        """Inputs. Outputs let go: the lines are pulled up outside."""
        self.registers = {0x00: 0, 0x04: 0, 0x08: 0, 0x0C: 0, 0x20: 0, 0x24: 0}
        self.odr = self._outputs = 0

    def mode(self, pin: int) -> int:
        """0 input, 1 output, 2 alternate function, 3 analogue."""
        return self.registers[0x00] >> 2 * pin & 3

    def function(self, pin: int) -> int:
        """Alternate function, -1 when the pin has another mode."""
        return self.registers[0x20 + 4 * (pin // 8)] >> 4 * (pin % 8) & 0xF if self.mode(pin) == 2 else -1

    def level(self, pin: int) -> bool:
        """Of an output; lines that nobody drives are pulled up."""
        return bool(self._levels >> pin & 1)

    @property
    def _levels(self) -> int:
        return self.odr | ~self._outputs

    def read(self, offset: int) -> int:
        """Configuration, IDR and ODR."""
        if offset == 0x10:
            return self.inputs() & 0xFFFF
        return self.odr if offset == 0x14 else self.registers[offset]

    def write(self, offset: int, value: int) -> None:
        """Configuration, ODR, BSRR."""
        before = self._levels
        if offset == 0x18:
            self.odr = self.odr & ~(value >> 16) | value & 0xFFFF
        elif offset == 0x14:
            self.odr = value & 0xFFFF
        elif offset in self.registers:
            self.registers[offset] = value
            self._outputs = sum((self.mode(pin) == 1) << pin for pin in range(16))
        else:
            raise KeyError(offset)
        changed = (before ^ self._levels) & 0xFFFF
        for pin in range(16):
            if changed >> pin & 1:
                self.on_output(pin, self.level(pin))


class Exti(Part):
    """SYSCFG_EXTICR1 (RM0090 9.2.3) and EXTI (12.3), lines 0 to 3, whose interrupts are 6 to 9."""

    base, size = 0x40013800, 0x800

    def reset(self) -> None:
        """All masked."""
        self.exticr1 = self.imr = self.rtsr = self.ftsr = self.pr = 0

    def edge(self, port: int, pin: int, rising: bool) -> None:
        """An edge on a pin; port 0 is A."""
        if self.exticr1 >> 4 * pin & 0xF != port or not (self.rtsr if rising else self.ftsr) >> pin & 1:
            return
        self.pr |= 1 << pin
        if self.imr >> pin & 1:
            self.machine.pend(EXC_IRQ0 + 6 + pin)

    def read(self, offset: int) -> int:
        """EXTICR1, IMR, RTSR, FTSR, PR."""
        return {0x08: self.exticr1, 0x400: self.imr, 0x408: self.rtsr, 0x40C: self.ftsr, 0x414: self.pr}[offset]

    def write(self, offset: int, value: int) -> None:
        """The same; PR is cleared by writing 1."""
        if offset == 0x08:
            self.exticr1 = value
        elif offset == 0x400:
            self.imr = value
        elif offset == 0x408:
            self.rtsr = value
        elif offset == 0x40C:
            self.ftsr = value
        elif offset == 0x414:
            self.pr &= ~value
            for pin in range(4):
                if value >> pin & 1:
                    self.machine.unpend(EXC_IRQ0 + 6 + pin)
        else:
            raise KeyError(offset)
