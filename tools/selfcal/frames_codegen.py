"""The frame format for C and for the docs, from its one source, `lib/selfcal.dbc`.

python -m selfcal.frames_codegen            write lib/selfcal_frames.h
python -m selfcal.frames_codegen --table    print the telemetry table (Markdown)
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cantools.database.can import Database, Message
from cantools.database.can.signal import Signal

from selfcal.errors import UserError
from selfcal.laws import PARAMETERS
from selfcal.units import parameter_unit
from selfcal.wire import ANSWER, AXES, COMMAND, CORRECTED, ROOT, STATUS, load_dbc

#: Signals every frame carries, with their bits: the value, whose meaning is the item's, fills bits 0 to 31.
COMMON = {"item": (32, 6), "counter": (38, 6), "time": (44, 8), "crc": (52, 12)}
#: Unit of the sensor reading by the first letter of the axis message.
UNITS = {"G": "deg/s", "A": "m/s^2"}


@dataclass(frozen=True)
class Field:
    """One signal of one item: bits `start` to `start + length - 1` of the 32-bit value."""

    name: str
    item: int
    start: int
    length: int
    kind: str  # uint, int or float
    scale: float
    unit: str
    comment: str
    choices: str

    @property
    def macro(self) -> str:
        """Name in C, less the prefix."""
        return self.name.upper()


def _field(message: Message, signal: Signal) -> Field:
    where = f"{message.name}.{signal.name}"
    items = signal.multiplexer_ids
    if signal.multiplexer_signal != "item" or items is None or len(items) != 1:
        raise UserError(f"selfcal.dbc: {where}: must belong to one item")
    if signal.byte_order != "little_endian" or signal.start + signal.length > 32:
        raise UserError(f"selfcal.dbc: {where}: must be little-endian and within bits 0 to 31")
    if signal.is_float and (signal.start, signal.length) != (0, 32):
        raise UserError(f"selfcal.dbc: {where}: a float must fill bits 0 to 31")
    if signal.conversion.offset != 0:
        raise UserError(f"selfcal.dbc: {where}: an offset is not supported")
    return Field(
        name=signal.name,
        item=items[0],
        start=signal.start,
        length=signal.length,
        kind="float" if signal.is_float else "int" if signal.is_signed else "uint",
        scale=float(signal.conversion.scale),
        unit=signal.unit or "",
        comment=(signal.comment or "").rstrip("."),
        choices=", ".join(f"{number} {name}" for number, name in (signal.choices or {}).items()),
    )


def fields(message: Message) -> list[Field]:
    """The item fields of a message, by item and bit. Raises UserError where the DBC leaves the common layout."""
    if message.length != 8 or message.is_extended_frame or message.frame_id > 0x7FF:
        raise UserError(f"selfcal.dbc: {message.name}: must have 8 bytes and a standard id")
    for name, bits in COMMON.items():
        signal = message.get_signal_by_name(name)
        if (signal.start, signal.length) != bits or signal.is_signed or signal.byte_order != "little_endian":
            raise UserError(f"selfcal.dbc: {message.name}.{name}: must be bits {bits[0]} to {sum(bits) - 1}, unsigned")
    found = [_field(message, signal) for signal in message.signals if signal.name not in COMMON]
    return sorted(found, key=lambda field: (field.item, field.start))


def _bits(field: Field) -> str:
    """Where a field lies, if it does not fill the value."""
    if field.length == 32:
        return ""
    if field.length == 1:
        return f", bit {field.start}"
    return f", bits {field.start} to {field.start + field.length - 1}"


def _shape(field: Field) -> tuple[object, ...]:
    """What must be alike in all axis messages: everything but unit and comment."""
    return (field.name, field.item, field.start, field.length, field.kind, field.scale)


def check(database: Database) -> None:
    """Raise UserError unless the six axis messages are alike and carry the units of their group."""
    first = fields(database.get_message_by_name(AXES[0].upper()))
    for axis in AXES:
        message = database.get_message_by_name(axis.upper())
        mine = fields(message)
        if [_shape(field) for field in mine] != [_shape(field) for field in first]:
            raise UserError(f"selfcal.dbc: {message.name}: differs from {AXES[0].upper()}")
        for field in mine:
            parameter = next(
                (p for p in PARAMETERS if f"_{p}_" in field.name and not field.name.endswith("_flags")), None
            )
            if field.name.startswith("bias_"):
                parameter = "bias"
            unit = parameter_unit(parameter, UNITS[message.name[0]]) if parameter else None
            if unit is not None and field.unit != unit:
                raise UserError(f"selfcal.dbc: {message.name}.{field.name}: unit '{field.unit}', not '{unit}'")


def _items(prefix: str, members: Iterable[Field]) -> list[str]:
    lines: list[str] = []
    by_item: dict[int, list[Field]] = {}
    for field in members:
        by_item.setdefault(field.item, []).append(field)
    lines.append("enum {")
    for item, group in by_item.items():
        for field in group:
            kind = f"{field.kind}{field.length}" + (f" x {field.scale:g}" if field.scale != 1.0 else "")
            unit = f", {field.unit}" if field.unit else ""
            lines.append(f"    {prefix}_{field.macro} = {item}, /* {kind}{_bits(field)}{unit} */")
    lines += ["};", ""]
    for group in by_item.values():
        for field in group:
            if field.length != 32:
                lines.append(f"#define {prefix}_{field.macro}_SHIFT {field.start}U")
                lines.append(f"#define {prefix}_{field.macro}_MASK 0x{(1 << field.length) - 1:X}U")
            if field.scale != 1.0:
                lines.append(f"#define {prefix}_{field.macro}_PER_UNIT {1.0 / field.scale:.1f}")
    lines.append("")
    return lines


def header(database: Database) -> str:
    """The text of lib/selfcal_frames.h. Raises UserError for a DBC that the C code cannot pack."""
    check(database)
    axis = fields(database.get_message_by_name(AXES[0].upper()))
    lines = [
        "/* The telemetry frame format in numbers. Generated from selfcal.dbc, which describes every item:",
        " * python -m selfcal.frames_codegen. Do not edit. */",
        "#ifndef SELFCAL_FRAMES_H",
        "#define SELFCAL_FRAMES_H",
        "",
        f"#define SELFCAL_FRAMES_VERSION {int(database.version or 0)}U",
        "",
        "/* First bit and width of what every frame carries, in its 8 bytes read as one little-endian number; the",
        " * value of the item is in bits 0 to 31. */",
    ]
    for name, (start, length) in COMMON.items():
        lines.append(f"#define SELFCAL_FRAME_{name.upper()}_SHIFT {start}U")
        lines.append(f"#define SELFCAL_FRAME_{name.upper()}_MASK 0x{(1 << length) - 1:X}U")
    lines.append("")
    for name in (STATUS, CORRECTED, COMMAND, ANSWER):
        lines.append(f"#define SELFCAL_FRAME_{name}_ID 0x{database.get_message_by_name(name).frame_id:X}U")
    lines.append("")
    lines.append("/* Axis name and id of each axis message. */")
    lines.append(f"#define SELFCAL_FRAME_AXES {len(AXES)}U")
    pairs = [f'{{"{name}", 0x{database.get_message_by_name(name.upper()).frame_id:X}U}}' for name in AXES]
    lines += ["#define SELFCAL_FRAME_AXIS_TABLE \\", "    { \\"]
    lines += [f"        {pair}, \\" for pair in pairs]
    lines += ["    }", ""]
    lines.append("/* Items of an axis message; units of a gyro axis, those of an accelerometer are alike in m/s^2. */")
    lines += _items("SELFCAL_AXIS", axis)
    for name in (STATUS, CORRECTED, ANSWER):
        message = database.get_message_by_name(name)
        lines.append(f"/* Items of the {name.lower()} message. */")
        lines += _items(f"SELFCAL_{name}", fields(message))
        for signal in message.signals:
            for number, word in (signal.choices or {}).items():
                lines.append(f"#define SELFCAL_{name}_{signal.name.upper()}_{str(word).upper()} {number}U")
    lines += ["", "#endif", ""]
    return "\n".join(lines)


def table(database: Database) -> str:
    """The telemetry table for the docs, as Markdown."""
    check(database)
    accel = {field.name: field.unit for field in fields(database.get_message_by_name("AX"))}
    ids = ", ".join(f"`0x{database.get_message_by_name(a.upper()).frame_id:X}` {a.upper()}" for a in AXES)
    lines = ["| field of every frame | bits | meaning |", "|---|---|---|", "| `value` | 0 to 31 | by item, see below |"]
    status = database.get_message_by_name(STATUS)
    for name, (start, length) in COMMON.items():
        comment = (status.get_signal_by_name(name).comment or "").rstrip(".")
        lines.append(f"| `{name}` | {start} to {start + length - 1} | {comment} |")
    titles = {AXES[0].upper(): f"Axis messages: {ids}"}
    titles |= {
        name: f"`0x{database.get_message_by_name(name).frame_id:X}` {name}" for name in (STATUS, CORRECTED, ANSWER)
    }
    for name, title in titles.items():
        lines += ["", title, "", "| item | signal | type | unit | meaning |", "|---|---|---|---|---|"]
        for field in fields(database.get_message_by_name(name)):
            kind = f"{field.kind}{field.length}" + (f" × {field.scale:g}" if field.scale != 1.0 else "")
            kind += _bits(field)
            unit = field.unit
            if name.lower() in AXES and accel[field.name] != unit:
                unit += f"; {accel[field.name]}"
            meaning = field.comment + (f": {field.choices}" if field.choices else "")
            lines.append(f"| {field.item} | `{field.name}` | {kind} | {unit} | {meaning} |")
    command = database.get_message_by_name(COMMAND)
    lines += ["", f"`0x{command.frame_id:X}` COMMAND, from the host"]
    lines += ["", "| signal | bits | meaning |", "|---|---|---|"]
    for signal in command.signals:
        choices = ", ".join(f"{number} {word}" for number, word in (signal.choices or {}).items())
        meaning = (signal.comment or "").rstrip(".") + (f": {choices}" if choices else "")
        lines.append(f"| `{signal.name}` | {signal.start} to {signal.start + signal.length - 1} | {meaning} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the header, or print the table."""
    parser = argparse.ArgumentParser(prog="python -m selfcal.frames_codegen", description=__doc__)
    parser.add_argument("--table", action="store_true", help="print the telemetry table instead of writing the header")
    parser.add_argument(
        "-o", "--output", type=Path, default=None, help="where to write (default: lib/selfcal_frames.h)"
    )
    arguments = parser.parse_args()
    try:
        if arguments.table:
            print(table(load_dbc()), end="")
        else:
            output = arguments.output or ROOT / "lib" / "selfcal_frames.h"
            output.write_text(header(load_dbc()), encoding="utf-8")
    except UserError as error:
        parser.exit(2, f"selfcal: error: {error}\n")


if __name__ == "__main__":
    main()
