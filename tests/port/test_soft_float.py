"""The Cortex-M0's floats in software (port/cortex-m0/soft_float.c) against this machine's, bit for bit.

Truth: numpy's float32, which is the processor's IEEE 754 arithmetic. A NaN counts as any other NaN.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from firmware import ROOT
from unicorn import UC_ARCH_ARM, UC_MODE_MCLASS, UC_MODE_THUMB, Uc
from unicorn.arm_const import (
    UC_ARM_REG_LR,
    UC_ARM_REG_R0,
    UC_ARM_REG_R1,
    UC_ARM_REG_R2,
    UC_ARM_REG_R3,
    UC_ARM_REG_SP,
    UC_CPU_ARM_CORTEX_M0,
)

Bits = npt.NDArray[np.uint32]
Floats = npt.NDArray[np.float32]

CODE, DATA, CHUNK = 0x0, 0x20000000, 1 << 18
END = 0xFFF0
#: Pairs of each operation and kind.
PAIRS = 2_000_000 if os.environ.get("SELFCAL_CAMPAIGN") else CHUNK
SOURCES = ["tests/port/soft_float.c", "port/cortex-m0/soft_float.c"]
FLAGS = ["-mcpu=cortex-m0", "-mthumb", "-Os", "-std=c99", "-nostdlib", "-Wl,-Ttext=0,-e,run"]
OPERATIONS: dict[str, Callable[[Floats, Floats], Floats]] = {
    "mul": np.multiply,
    "add": np.add,
    "sub": np.subtract,
    "div": np.divide,
    "less": lambda a, b: (a < b).astype(np.float32),
    "greater": lambda a, b: (a > b).astype(np.float32),
    "not greater": lambda a, b: (a <= b).astype(np.float32),
    "not less": lambda a, b: (a >= b).astype(np.float32),
    "equal": lambda a, b: (a == b).astype(np.float32),
}


class Core:
    """A Cortex-M0 that runs one of OPERATIONS over arrays."""

    def __init__(self, folder: Path) -> None:
        elf, image = folder / "soft_float.elf", folder / "soft_float.bin"
        subprocess.run(["arm-none-eabi-gcc", *FLAGS, *SOURCES, "-lgcc", "-o", str(elf)], cwd=ROOT, check=True)
        subprocess.run(["arm-none-eabi-objcopy", "-O", "binary", str(elf), str(image)], check=True)
        symbols = subprocess.run(["arm-none-eabi-nm", str(elf)], capture_output=True, text=True, check=True).stdout
        self.run = next(int(line.split()[0], 16) for line in symbols.splitlines() if line.endswith(" T run"))
        self.uc = Uc(UC_ARCH_ARM, UC_MODE_THUMB | UC_MODE_MCLASS)
        self.uc.ctl_set_cpu_model(UC_CPU_ARM_CORTEX_M0)
        self.uc.mem_map(CODE, 0x10000)
        self.uc.mem_map(DATA, 4 * 4 * CHUNK)
        self.uc.mem_write(CODE, image.read_bytes())

    def __call__(self, operation: str, a: Bits, b: Bits) -> Bits:
        """The operation's results, at most CHUNK of them."""
        places = [DATA + 4 * CHUNK * i for i in range(3)]
        stack = DATA + 4 * 4 * CHUNK - 16
        self.uc.mem_write(places[0], a.tobytes())
        self.uc.mem_write(places[1], b.tobytes())
        self.uc.mem_write(stack, len(a).to_bytes(4, "little"))  # the fifth argument, on the stack
        registers = (UC_ARM_REG_R0, UC_ARM_REG_R1, UC_ARM_REG_R2, UC_ARM_REG_R3)
        for register, value in zip(registers, (list(OPERATIONS).index(operation), *places), strict=True):
            self.uc.reg_write(register, value)
        self.uc.reg_write(UC_ARM_REG_SP, stack)
        self.uc.reg_write(UC_ARM_REG_LR, END | 1)
        self.uc.emu_start(self.run | 1, END)
        return np.frombuffer(self.uc.mem_read(places[2], 4 * len(a)), dtype=np.uint32)


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Core:
    """The core with the program."""
    return Core(tmp_path_factory.mktemp("soft_float"))


def differ(core: Core, operation: str, a: Bits, b: Bits) -> list[tuple[str, str, str, str]]:
    """Pairs whose result is not this machine's: both numbers, the core's result, the truth; the first few."""
    with np.errstate(all="ignore"):
        truth = OPERATIONS[operation](a.view(np.float32), b.view(np.float32))
    found = core(operation, a, b)
    wrong = (found != truth.view(np.uint32)) & ~(np.isnan(truth) & np.isnan(found.view(np.float32)))
    columns = [bits[wrong][:5] for bits in (a, b, found, truth.view(np.uint32))]
    return [(f"{x:08x}", f"{y:08x}", f"{z:08x}", f"{t:08x}") for x, y, z, t in zip(*columns, strict=True)]


def pairs(kind: str, rng: np.random.Generator, count: int) -> tuple[Bits, Bits]:
    """Bits of pairs of floats: `any` bits at all; `near` exponents, where sums cancel; `coarse`, of few bits, so that
    results lie half-way; `small`, whose results are subnormal or none."""
    a, b = rng.integers(0, 1 << 32, (2, count), dtype=np.uint32)
    if kind == "any":
        return a, b
    exponent = rng.integers(40, 215, count, dtype=np.uint32)
    other = exponent + rng.integers(0, 28, count, dtype=np.uint32)
    if kind == "small":
        exponent, other = (rng.integers(0, top, count, dtype=np.uint32) for top in (4, 160))
    if kind == "coarse":
        a, b = (x & ~((np.uint32(1) << rng.integers(8, 23, count, dtype=np.uint32)) - np.uint32(1)) for x in (a, b))
    keep = np.uint32(0x807FFFFF)
    return a & keep | exponent << np.uint32(23), b & keep | other << np.uint32(23)


@pytest.mark.parametrize("operation", OPERATIONS)
@pytest.mark.parametrize("kind", ["any", "near", "coarse", "small"])
def test_random_pairs(core: Core, operation: str, kind: str) -> None:
    """Every result has the bits of this machine's."""
    rng = np.random.default_rng([list(OPERATIONS).index(operation), len(kind)])
    for _ in range(0, PAIRS, CHUNK):
        a, b = pairs(kind, rng, CHUNK)
        assert differ(core, operation, a, b) == []
        assert differ(core, operation, b, a) == []


@pytest.mark.parametrize("operation", OPERATIONS)
def test_corners(core: Core, operation: str) -> None:
    """Zeros, infinities, NaNs, the ends of the subnormal and of the normal numbers and what lies beside them, each with
    each, of either sign."""
    ends = [0, 1, 0x7FFFFF, 0x800000, 0x1000000, 0x33800000, 0x34000000, 0x3F000000, 0x3F800000, 0x40000000, 0x4B800000]
    ends += [0x7E800000, 0x7F000000, 0x7F7FFFFF, 0x7F800000, 0x7FC00000]
    beside = sorted({bits + step for bits in ends for step in (-2, -1, 0, 1, 2) if bits + step >= 0})
    one = np.array([bits | sign for bits in beside for sign in (0, 1 << 31)], dtype=np.uint32)
    a, b = (x.ravel() for x in np.meshgrid(one, one))
    assert differ(core, operation, np.ascontiguousarray(a), np.ascontiguousarray(b)) == []
