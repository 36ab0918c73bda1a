"""Sizes of a firmware image: flash, static RAM and worst-case stack, against the budget of its target.

    python tests/bench/image_sizes.py TARGET...

For each TARGET reads build/TARGET/selfcal.elf (`make firmware`), or with --sensor NAME that in build/TARGET-NAME, what
gcc says of each function's stack beside its objects (.su) and port/TARGET/budget.json: greatest `flash`, `ram` (without
stack) and `stack` in bytes, and under `calls` for each source file that calls through pointers the const tables of
functions it calls through, or for a function of it (`app_commands.c:app_command`) the functions. SENSOR stands for the
name of the image's sensor, and `SENSOR.start` for one member of its struct. Exit code 1 above a budget.

The worst stack is that of the deepest path through the call graph of the linked image, read from its disassembly, from
the reset vector, and upon it the deepest of the interrupt handlers with what the processor pushes (they share one
priority). Handlers that end in a reset do not count. A frame is what gcc states; of functions without a statement
(newlib, libgcc), what the instructions push. Recursion, frames of unknown size and pointer calls that `calls` does not
resolve are errors, so the bound is one.
"""

from __future__ import annotations

import argparse
import json
import re
import struct
import subprocess
import sys
from bisect import bisect_right
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict

from elftools.elf.elffile import ELFFile
from elftools.elf.sections import SymbolTableSection

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "host_sim"))

from parts.symbols import place  # noqa: E402  of host_sim

BUILD = ROOT / "build"
#: The boards of port/boards.txt by name: core, clock in Hz, seconds between reports.
BOARDS = {
    words[0]: (words[1], int(words[2]), int(words[3]))
    for line in (ROOT / "port" / "boards.txt").read_text(encoding="utf-8").splitlines()
    if (words := line.split()) and words[0][0] != "#"
}
TARGETS = tuple(BOARDS)
#: The sensor of an image that names none.
SENSOR = "adis16405"
#: What a processor pushes on an exception and may add to align: without and with an FPU (ARMv7-M ARM B1.5.7).
EXCEPTION = {False: 32 + 4, True: 104 + 4}
KINDS = ("flash", "ram", "stack")


class FirmwareError(Exception):
    """What is wrong, in one line."""


class Budget(TypedDict):
    """port/TARGET/budget.json."""

    flash: int
    ram: int
    stack: int
    giving_way: list[str]  # handlers of a lower priority than the rest
    calls: dict[str, list[str]]


@dataclass
class Function:
    """One function of the image: its frame in bytes, what it pushes by its instructions, the addresses it goes to."""

    name: str
    source: str = ""
    frame: int | None = 0
    pushed: int | None = 0
    goes_to: set[int] = field(default_factory=set)
    by_pointer: bool = False


_HEADING = re.compile(r"^([0-9a-f]+) <(.+)>:$")
_LINE = re.compile(r"^\s*([0-9a-f]+):\s+(\S+)\s*(.*)$")
_TARGET = re.compile(r"\b([0-9a-f]+) <")
_BRANCH = re.compile(r"b(eq|ne|cs|cc|mi|pl|vs|vc|hi|ls|ge|lt|gt|le|al)?(\.[nw])?$|cbn?z$")
_ENDS = re.compile(r"(b(\.[nw])?|bx|udf|bl|blx)$")


def _registers(operands: str, size: int) -> int:
    """Bytes of a register list, as `{r4-r7, lr}` or `{d8-d9}`."""
    count = 0
    for part in operands[operands.index("{") + 1 : operands.index("}")].split(","):
        ends = [int(number) if number else 0 for number in re.findall(r"[a-z]+(\d*)", part)]
        count += ends[1] - ends[0] + 1 if "-" in part else 1
    return count * size


def _pushed(mnemonic: str, operands: str) -> int | None:
    """Bytes by which one instruction lowers the stack pointer; None: by a register."""
    stem = mnemonic.partition(".")[0]
    if stem in ("push", "stmdb", "stmfd") and ("sp!" in operands or stem == "push"):
        return _registers(operands, 4)
    if stem == "vpush":
        return _registers(operands, 8 if "{d" in operands else 4)
    if stem in ("str", "strd") and (found := re.search(r"\[sp, #-(\d+)\]!", operands)):
        return int(found[1])
    if stem in ("sub", "subw") and operands.startswith("sp"):
        found = re.fullmatch(r"sp, (?:sp, )?#(\d+)(?:\s*[;@].*)?", operands)
        return int(found[1]) if found else None
    return None if stem == "add" and re.match(r"sp, r|sp, sp, r", operands) else 0


def disassembly(elf: Path) -> dict[int, Function]:
    """The functions by address, with what the instructions push and where they go."""
    command = ["arm-none-eabi-objdump", "-d", "--no-show-raw-insn", str(elf)]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    heads = [(int(head[1], 16), head[2]) for head in map(_HEADING.match, lines) if head]
    found = {address: Function(name) for address, name in heads}
    starts = sorted(found)
    here = Function("")
    last = ""
    for line in lines:
        if head := _HEADING.match(line):
            if last and not _ENDS.match(last):
                here.goes_to.add(int(head[1], 16))  # runs on into the next: hand-written code with several entries
            here, last = found[int(head[1], 16)], ""
            continue
        instruction = _LINE.match(line)
        if instruction is None or instruction[2].startswith(".") or instruction[2] == "...":
            continue
        mnemonic, operands = instruction[2], instruction[3]
        pushed = _pushed(mnemonic, operands)
        here.pushed = None if here.pushed is None or pushed is None else here.pushed + pushed
        target = _TARGET.search(operands)
        if mnemonic == "blx" or (mnemonic == "bx" and not operands.startswith("lr")):
            here.by_pointer = True
        elif target and (mnemonic == "bl" or _BRANCH.match(mnemonic)):
            to = int(target[1], 16)
            start = starts[bisect_right(starts, to) - 1]
            # A branch within the function may be a bl: a Cortex-M0 has no other that reaches far.
            if found[start] is not here or (mnemonic == "bl" and to == start):
                here.goes_to.add(start)
        if mnemonic not in ("nop", "nop.w") and (mnemonic, operands) != ("movs", "r0, r0"):  # zeros between sections
            last = "bx" if re.match(r"(pop|ldm).*", mnemonic) and "pc" in operands else mnemonic
            last = "bx" if mnemonic.startswith("ldr") and operands.startswith("pc") else last
    return found


def stated_frames(folder: Path) -> dict[tuple[str, str], int]:
    """(source file, function) to bytes, from gcc's .su files. Raises FirmwareError for one that gcc does not bound."""
    frames = {}
    for file in sorted(folder.glob("*.su")):
        for line in file.read_text(encoding="utf-8").splitlines():
            where, size, kind = line.split("\t")
            path, _, _, name = where.rsplit(":", 3)
            if kind not in ("static", "dynamic,bounded"):
                raise FirmwareError(f"{name} in {path}: the size of its frame is {kind}")
            frames[Path(path).name, name] = int(size)
    return frames


class Image:
    """A linked image and what gcc said when it compiled its objects into the folder `objects` beside it."""

    def __init__(self, elf: Path) -> None:
        self.elf = elf
        self.functions = disassembly(elf)
        frames = stated_frames(elf.parent / "objects")
        with elf.open("rb") as stream:
            file = ELFFile(stream)
            self.sections = {s.name: s["sh_size"] for s in file.iter_sections() if s["sh_flags"] & 2}
            tables = [section for section in file.iter_sections() if isinstance(section, SymbolTableSection)]
            symbols = [symbol for table in tables for symbol in table.iter_symbols()]
            self.symbols = {s.name: (s["st_value"], s["st_size"]) for s in symbols}
            self.objects = {s.name for s in symbols if s["st_info"]["type"] == "STT_OBJECT"}
            self._bytes = [(s["p_paddr"], s.data()) for s in file.iter_segments() if s["p_type"] == "PT_LOAD"]
            for unit in file.get_dwarf_info().iter_CUs():
                source = Path(unit.get_top_DIE().attributes["DW_AT_name"].value.decode()).name
                for entry in unit.iter_DIEs():
                    if entry.tag == "DW_TAG_subprogram" and "DW_AT_low_pc" in entry.attributes:
                        function = self.functions.get(entry.attributes["DW_AT_low_pc"].value)
                        if function is not None:
                            function.source = source
        for function in self.functions.values():
            function.frame = frames.get((function.source, function.name), function.pushed)

    def words(self, name: str) -> list[int]:
        """The words of a const object. Raises FirmwareError if there is none of that name."""
        if "." in name:
            address, size = place(self.elf, name)
        elif name in self.symbols:
            address, size = self.symbols[name]
        else:
            raise FirmwareError(f"no object '{name}'")
        for start, data in self._bytes:
            if start <= address and address + size <= start + len(data):
                return [word for (word,) in struct.iter_unpack("<I", data[address - start : address - start + size])]
        raise FirmwareError(f"'{name}' is not in flash")

    def functions_in(self, name: str) -> set[int]:
        """Addresses of the functions that a const object points to, or that of a function itself.

        A member of an object, `sensor.start`, may point to a function, or to a const object that does.
        A name that ends in `?` may be missing: then nothing linked it, so the pointer is null.
        """
        if name.endswith("?"):
            return self.functions_in(name[:-1]) if name[:-1] in self.symbols else set()
        if "." in name:
            (word,) = self.words(name)
            if word == 0:
                return set()
            tables = {table for table in self.objects if self.symbols[table][0] == word}
            return {word & ~1} & set(self.functions) | {f for table in tables for f in self.functions_in(table)}
        if name not in self.objects:
            return {address for address, function in self.functions.items() if function.name == name}
        return {word & ~1 for word in self.words(name) if word & 1 and word & ~1 in self.functions}

    def flash(self) -> int:
        """Bytes of flash: code, constants, first values of variables."""
        return sum(size for name, size in self.sections.items() if name in (".text", ".ARM.exidx", ".data"))

    def ram(self) -> int:
        """Bytes of RAM that variables take."""
        return sum(size for name, size in self.sections.items() if name in (".data", ".bss", ".ccm", ".kept"))

    def deepest(self, start: int, calls: Mapping[str, list[str]]) -> tuple[int, list[str]]:
        """Bytes of the deepest path from a function, and the names along it. Raises FirmwareError."""
        known: dict[int, tuple[int, list[str]]] = {}
        path: list[int] = []

        def depth(address: int) -> tuple[int, list[str]]:
            if address in known:
                return known[address]
            function = self.functions.get(address)
            if function is None:
                raise FirmwareError(f"{self.functions[path[-1]].name} calls 0x{address:08x}: there is no function")
            if address in path:
                names = [self.functions[a].name for a in path[path.index(address) :]]
                raise FirmwareError(f"recursion: {' -> '.join(names)}")
            targets = function.goes_to
            if function.by_pointer:
                through = calls.get(f"{function.source}:{function.name}", calls.get(function.source))
                if through is None:
                    raise FirmwareError(f"{function.name} in {function.source} calls by pointer: say what in `calls`")
                targets = targets.union(*map(self.functions_in, through))
            path.append(address)
            below = max((depth(target) for target in targets), default=(0, []))
            path.pop()
            if function.frame is None:
                raise FirmwareError(f"{function.name}: frame of unknown size")
            known[address] = function.frame + below[0], [f"{function.name} {function.frame}", *below[1]]
            return known[address]

        return depth(start)

    def stack(self, calls: Mapping[str, list[str]], giving_way: Collection[str] = ()) -> tuple[int, str]:
        """Bytes of the worst case, and the path that takes them. The others break into handlers `giving_way`."""
        vectors = self.words("vectors")
        size, path = self.deepest(vectors[1] & ~1, calls)
        handlers = {word & ~1 for word in vectors[15:] if word}
        unknown = set(giving_way) - {self.functions[handler].name for handler in handlers}
        if unknown:
            raise FirmwareError(f"giving_way: no vector leads to {', '.join(sorted(unknown))}")
        text = " > ".join(path)
        for level in (True, False):
            deepest = [
                self.deepest(handler, calls)
                for handler in handlers
                if not self.resets(handler) and (self.functions[handler].name in giving_way) == level
            ]
            if deepest:
                size += EXCEPTION[self.has_fpu()] + max(deepest)[0]
                text += f" + exception {EXCEPTION[self.has_fpu()]} + {' > '.join(max(deepest)[1])}"
        return size, text

    def has_fpu(self) -> bool:
        """Whether the processor pushes floating-point registers too."""
        return "__aeabi_fmul" not in self.symbols

    def resets(self, handler: int) -> bool:
        """Whether a handler does nothing but end the run."""
        return self.functions[handler].name in ("unexpected", "board_reset", "board_fault")


def measure(target: str, sensor: str = SENSOR) -> tuple[dict[str, int], str]:
    """Flash, RAM and stack of a target's image in bytes, and the deepest path. Raises FirmwareError."""
    elf = BUILD / (target if sensor == SENSOR else f"{target}-{sensor}") / "selfcal.elf"
    if not elf.is_file():
        raise FirmwareError(f"there is no {elf.relative_to(ROOT)}: make firmware")
    image = Image(elf)
    budget = read_budget(target, sensor)
    stack, path = image.stack(budget["calls"], budget["giving_way"])
    room = image.symbols["link_stack"][0] - image.symbols["link_stack_low"][0]
    if stack > room:
        raise FirmwareError(f"the stack may take {stack} bytes, port/{target}/link.ld keeps {room}")
    return {"flash": image.flash(), "ram": image.ram(), "stack": stack}, path


def stacks(target: str, names: Iterable[str]) -> dict[str, int]:
    """Bytes of stack of each function of a target's image that is in it, by `stack.NAME`. Raises FirmwareError."""
    image = Image(BUILD / target / "selfcal.elf")
    calls = read_budget(target, SENSOR)["calls"]
    found = ((name, address) for name in names for address in image.functions_in(name) if name in image.symbols)
    return {f"stack.{name}": image.deepest(address, calls)[0] for name, address in found}


def read_budget(target: str, sensor: str = SENSOR) -> Budget:
    """The budget file of a target, with the name of the image's sensor put in."""
    text = (ROOT / "port" / target / "budget.json").read_text(encoding="utf-8")
    budget: Budget = json.loads(text.replace("SENSOR", sensor))
    return budget


def main() -> int:
    """Measure, print, compare."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("target", nargs="+", choices=TARGETS)
    parser.add_argument("--path", action="store_true", help="print the deepest path of calls too")
    parser.add_argument("--sensor", default=SENSOR, help=f"of the images (default: {SENSOR})")
    arguments = parser.parse_args()
    failed = False
    print(f"{'bytes':10} " + "".join(f"{kind:>10}{'budget':>10}" for kind in KINDS))
    for target in arguments.target:
        try:
            sizes, path = measure(target, arguments.sensor)
        except FirmwareError as error:
            print(f"{target}: {error}", file=sys.stderr)
            failed = True
            continue
        budget = read_budget(target, arguments.sensor)
        limits = {"flash": budget["flash"], "ram": budget["ram"], "stack": budget["stack"]}
        print(f"{target:10} " + "".join(f"{sizes[kind]:10,}{limits[kind]:10,}" for kind in KINDS))
        if arguments.path:
            print(f"  {path}")
        for kind in KINDS:
            if sizes[kind] > limits[kind]:
                above = sizes[kind] - limits[kind]
                print(f"{target}: {kind} is {above} bytes above its budget (port/{target}/budget.json)")
                failed = True
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
