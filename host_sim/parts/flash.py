"""The flash's programming side: keys, erase, program, and power cuts in the middle of either."""

from __future__ import annotations

import random

from unicorn.unicorn_const import UC_HOOK_MEM_WRITE

from .machine import STM32F405, Machine, Part, Uc

FLASH, FLASH_BYTES = STM32F405.flash, STM32F405.flash_bytes
#: Start and size of every sector, RM0090 table 5.
SECTORS = [(FLASH + 0x4000 * i, 0x4000) for i in range(4)]
SECTORS += [(FLASH + 0x10000, 0x10000)]
SECTORS += [(FLASH + 0x20000 * i, 0x20000) for i in range(1, 8)]
ERASE_US, PROGRAM_US = 1_000_000.0, 16.0  # data sheet, typical at x32
LOCKED, BUSY = 1 << 31, 1 << 16
PGSERR, PGPERR, WRPERR = 1 << 7, 1 << 6, 1 << 4


def half_programmed(old: bytes, new: bytes, rng: random.Random) -> bytes:
    """Each bit that was to be cleared has been or not."""
    return bytes(n | o & rng.getrandbits(8) for o, n in zip(old, new, strict=True))


def half_erased(old: bytes, rng: random.Random) -> bytes:
    """Cells in between: some pages erased, some as they were, some of any content."""
    return b"".join(
        rng.choice((b"\xff" * 256, old[at : at + 256], rng.randbytes(256))) for at in range(0, len(old), 256)
    )


class Flash(Part):
    """RM0090 3.9. `operations` counts erases and words; `cut_at` cuts the power within that operation, whose cells are
    then left in between: each bit that was to change has done so or not."""

    base = 0x40023C00

    def __init__(self, machine: Machine) -> None:
        super().__init__(machine)
        self.operations = 0
        self.erases = [0] * len(SECTORS)
        self.cut_at = -1
        self.fail_at = -1  # the operation that the flash refuses
        self.history: list[tuple[int, bytes, bytes]] = []  # address, content before and after, if `keep_history`
        self.keep_history = False
        machine.uc.hook_add(UC_HOOK_MEM_WRITE, self._store, None, FLASH, FLASH + FLASH_BYTES - 1)

    def reset(self) -> None:
        """Locked."""
        self.cr, self.sr, self.acr = LOCKED, 0, 0
        self.keys = 0
        self.jammed = False
        self._put: tuple[int, bytes] | None = None

    def _store(self, uc: Uc, access: int, address: int, size: int, value: int, data: object) -> None:
        """A store to the flash. Unicorn carries it out after this; what it leaves is put right in _settle()."""
        old = bytes(uc.mem_read(address, size))
        new = (value & (1 << 8 * size) - 1).to_bytes(size, "little")
        allowed = self.cr & 1 and not self.cr & LOCKED and not self.sr & 0xF2
        if not allowed or size != 4 or self.cr >> 8 & 3 != 2 or address % 4 or self.operations == self.fail_at:
            self.sr |= PGSERR if not allowed else PGPERR
            if self.operations != self.fail_at:
                self.machine.violations.append(f"store of {size} bytes to flash {address:#x} that it refuses")
            self.operations += 1
            self._put = (address, old)
            return
        result = bytes(a & b for a, b in zip(old, new, strict=True))
        if self.operations == self.cut_at:
            result = half_programmed(old, result, self.machine.random)
            self._put = (address, result)
            self.machine.stop("power cut")
        self._put = (address, result)
        if self.keep_history:
            self.history.append((address, old, result))
        self.operations += 1
        self.machine.stall(PROGRAM_US)

    def settle(self) -> None:
        """The cells as the last operation left them."""
        if self._put is not None:
            self.machine.uc.mem_write(*self._put)
            self._put = None

    def read(self, offset: int) -> int:
        """ACR, SR, CR. Time stood still for the processor during an operation, so it is never seen busy."""
        self.settle()
        return {0x00: self.acr, 0x0C: self.sr, 0x10: self.cr}[offset]

    def write(self, offset: int, value: int) -> None:
        """ACR, KEYR, SR, CR."""
        self.settle()
        if offset == 0x00:
            self.acr = value
        elif offset == 0x04:
            expected = (0x45670123, 0xCDEF89AB)[self.keys]
            if value != expected or self.jammed:
                self.jammed = True  # locked until the next reset, 3.6.1
                self.machine.violations.append("FLASH_KEYR: wrong key")
            elif self.keys == 1:
                self.cr &= ~LOCKED
            self.keys = 1 - self.keys if not self.jammed else 0
        elif offset == 0x0C:
            self.sr &= ~(value & 0xF3)
        elif offset == 0x10:
            if self.cr & LOCKED:
                self.machine.violations.append("FLASH_CR written while locked")
            elif value & LOCKED:
                self.cr |= LOCKED
            else:
                self.cr = value & ~(1 << 16)
                if value >> 16 & 1 and value >> 1 & 1:
                    self._erase(value >> 3 & 0xF)
        else:
            raise KeyError(offset)

    def _erase(self, sector: int) -> None:
        start, size = SECTORS[sector]
        uc = self.machine.uc
        if self.operations == self.fail_at:
            self.operations += 1
            self.sr |= WRPERR
            return
        old = bytes(uc.mem_read(start, size))
        if self.keep_history:
            self.history.append((start, old, b"\xff" * size))
        self.erases[sector] += 1
        if start < self.machine.symbols["link_data_load"]:
            self.machine.violations.append("the code's own sector erased")
        if self.operations == self.cut_at:
            uc.mem_write(start, half_erased(old, self.machine.random))
            self.machine.stop("power cut")
            return
        self.operations += 1
        uc.mem_write(start, b"\xff" * size)
        self.machine.stall(ERASE_US)
