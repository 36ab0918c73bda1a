"""Variables of the firmware by name, by way of the image's debugging information: `sensor.counters.stale`."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from elftools.elf.elffile import ELFFile


def _strip(die: Any) -> Any:
    while die.tag in ("DW_TAG_typedef", "DW_TAG_volatile_type", "DW_TAG_const_type"):
        die = die.get_DIE_from_attribute("DW_AT_type")
    return die


@cache
def _variables(path: Path) -> dict[str, tuple[int, Any]]:
    found: dict[str, tuple[int, Any]] = {}
    with path.open("rb") as file:
        for unit in ELFFile(file).get_dwarf_info(relocate_dwarf_sections=False).iter_CUs():
            for die in unit.get_top_DIE().iter_children():
                location = die.attributes.get("DW_AT_location")
                header = "DW_AT_specification" in die.attributes  # declared there before
                declared = die.get_DIE_from_attribute("DW_AT_specification") if header else die
                if declared.tag != "DW_TAG_variable" or location is None or "DW_AT_name" not in declared.attributes:
                    continue
                if isinstance(location.value, list) and location.value[:1] == [3]:  # DW_OP_addr
                    name = declared.attributes["DW_AT_name"].value.decode()
                    address = int.from_bytes(bytes(location.value[1:5]), "little")
                    found[name] = (address, _layout(_strip(declared.get_DIE_from_attribute("DW_AT_type"))))
    return found


class _Pointer(NamedTuple):
    size: int
    to: Any  # layout of what it points to


def _layout(die: Any, follow: bool = True) -> Any:
    """Size in bytes of a scalar, members by name with their offsets, or a pointer. `follow`: what it points to as well,
    if that is a struct, but not beyond."""
    if die.tag == "DW_TAG_structure_type":
        members = {}
        for child in die.iter_children():
            if child.tag == "DW_TAG_member" and "DW_AT_name" in child.attributes:
                offset = child.attributes["DW_AT_data_member_location"].value
                layout = _layout(_strip(child.get_DIE_from_attribute("DW_AT_type")), follow)
                members[child.attributes["DW_AT_name"].value.decode()] = (offset, layout)
        return members
    size = die.attributes.get("DW_AT_byte_size")
    if follow and die.tag == "DW_TAG_pointer_type" and "DW_AT_type" in die.attributes:
        to = _strip(die.get_DIE_from_attribute("DW_AT_type"))
        if to.tag == "DW_TAG_structure_type":
            return _Pointer(size.value, _layout(to, follow=False))
    return size.value if size is not None else 0


def place(path: Path, name: str, read: Callable[[int, int], bytes] | None = None) -> tuple[int, int]:
    """Address and size in bytes of `variable.member.member`; with `read` (address and size to bytes) of
    `variable.pointer->member`, too. Raises KeyError."""
    first, *rest = re.split(r"(?=\.|->)", name)
    address, layout = _variables(path)[first]
    for member in rest:
        if member.startswith("->") and read is not None:
            address, layout = int.from_bytes(read(address, layout.size), "little"), layout.to
        offset, layout = layout[member.lstrip(".->")]
        address += offset
    return address, layout.size if isinstance(layout, _Pointer) else layout
