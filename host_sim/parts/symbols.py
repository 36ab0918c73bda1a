"""Variables of the firmware by name, by way of the image's debugging information: `sensor.counters.stale`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

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
                if die.tag != "DW_TAG_variable" or location is None or "DW_AT_name" not in die.attributes:
                    continue
                if isinstance(location.value, list) and location.value[:1] == [3]:  # DW_OP_addr
                    name = die.attributes["DW_AT_name"].value.decode()
                    address = int.from_bytes(bytes(location.value[1:5]), "little")
                    found[name] = (address, _layout(_strip(die.get_DIE_from_attribute("DW_AT_type"))))
    return found


def _layout(die: Any) -> Any:
    """Size in bytes of a scalar, or members by name with their offsets."""
    if die.tag == "DW_TAG_structure_type":
        members = {}
        for child in die.iter_children():
            if child.tag == "DW_TAG_member" and "DW_AT_name" in child.attributes:
                offset = child.attributes["DW_AT_data_member_location"].value
                layout = _layout(_strip(child.get_DIE_from_attribute("DW_AT_type")))
                members[child.attributes["DW_AT_name"].value.decode()] = (offset, layout)
        return members
    size = die.attributes.get("DW_AT_byte_size")
    return size.value if size is not None else 0


@cache
def place(path: Path, name: str) -> tuple[int, int]:
    """Address and size in bytes of `variable.member.member`. Raises KeyError."""
    first, *rest = name.split(".")
    address, layout = _variables(path)[first]
    for member in rest:
        offset, layout = layout[member]
        address += offset
    return address, layout
