"""The frame format for standard tools, for C and for the docs, from its only source, `frames.dbc`.

python -m selfcal.wire.frames_codegen    write lib/selfcal.dbc, lib/selfcal_frames.h and the lists of lib/WIRE.md
"""

from __future__ import annotations

import re
import textwrap
from functools import partial
from pathlib import Path

from cantools.database.can import Database, Message
from cantools.database.can.signal import Signal
from jinja2 import Template

from selfcal.base.code_template import of_code
from selfcal.base.errors import UserError
from selfcal.logs.framelog import LONGEST_FRAME
from selfcal.model.file import MOST_BANK_COLUMNS, MOST_HYPOTHESES
from selfcal.wire.dbc_file import COMMON, NODE_IDS, NODES, PLACE_NAMES, REASON, VALUE_BITS, dbc_text
from selfcal.wire.frames import ANSWER, AXES, COMMAND, CORRECTED, ROOT, STATISTICS, STATUS, TUMBLE, load_dbc

#: Messages of an axis, by what follows its name, and the name of their items in C; alike for all axes.
OF_AXIS = {"": "AXIS", "_H0": "HYPOTHESIS", "_COEFFICIENTS": "COEFFICIENTS", "_ADEQUACY": "ADEQUACY"}
#: Headings of lib/WIRE.md, by what follows an axis's name or by message.
HEADINGS = {
    "": "Axis",
    "_H0": "Hypothesis",
    "_COEFFICIENTS": "Coefficients of regressors",
    "_ADEQUACY": "Adequacy",
    STATUS: "Status",
    CORRECTED: "Corrected sample",
    ANSWER: "Answer to a command",
    TUMBLE: "Calibration by rests in several positions",
}
#: The line of lib/WIRE.md that the lists follow.
MARK = "<!-- The rest is generated: python -m selfcal.wire.frames_codegen -->\n"
#: Signals of columns after the first, which C reaches by the number of the column.
LATER = re.compile(r"c[1-9]_")


def _bits(signal: Signal) -> str:
    """Where a signal lies, if it does not fill the value."""
    if signal.length == VALUE_BITS:
        return ""
    last = signal.start + signal.length - 1
    return f", bit {last}" if signal.length == 1 else f", bits {signal.start} to {last}"


def _kind(signal: Signal) -> str:
    return f"{'float' if signal.is_float else 'int' if signal.is_signed else 'uint'}{signal.length}"


def _item(signal: Signal) -> int:
    return (signal.multiplexer_ids or [-1])[0]


def _as_elsewhere(signal: Signal) -> bool:
    """Whether its words are the judgement's reasons: selfcal_reason_t."""
    return signal.name.startswith(f"{REASON}_")


def _meaning(signal: Signal) -> str:
    """Comment and choices of a signal."""
    words = ", ".join(f"{number} {name}" for number, name in (signal.choices or {}).items())
    words = "" if _as_elsewhere(signal) else words
    return (signal.comment or "").rstrip(".") + (f": {words}" if words else "")


def fields(message: Message) -> list[Signal]:
    """The items' signals of a message, by item and bit. Raises UserError where the DBC leaves the common layout."""
    if message.length != LONGEST_FRAME or message.is_extended_frame:
        raise UserError(f"selfcal.dbc: {message.name}: must have {LONGEST_FRAME} bytes and a standard id")
    for name, bits in COMMON.items():
        signal = message.get_signal_by_name(name)
        if (signal.start, signal.length) != bits or signal.is_signed or signal.byte_order != "little_endian":
            raise UserError(f"selfcal.dbc: {message.name}.{name}: must be bits {bits[0]} to {sum(bits) - 1}, unsigned")
    members = [signal for signal in message.signals if signal.name not in COMMON]
    for signal in members:
        within = signal.byte_order == "little_endian" and signal.start + signal.length <= VALUE_BITS
        whole = not signal.is_float or (signal.start, signal.length) == (0, VALUE_BITS)
        if signal.multiplexer_signal != "item" or len(signal.multiplexer_ids or ()) != 1 or not (within and whole):
            wanted = "C packs what is of one item, little-endian within bits 0 to 31, which a float fills"
            raise UserError(f"selfcal.dbc: {message.name}.{signal.name}: {wanted}")
    return sorted(members, key=lambda signal: (_item(signal), signal.start))


def _first(database: Database, suffix: str) -> Message:
    return database.get_message_by_name(AXES[0].upper() + suffix)


def header(database: Database) -> str:
    """The text of lib/selfcal_frames.h. Raises UserError for a DBC that the C code cannot pack: messages of other axes
    and hypotheses are made from the first's (dbc_file.py)."""
    columns = [_item(signal) for signal in fields(_first(database, "_COEFFICIENTS"))]
    if columns != list(range(3 * MOST_BANK_COLUMNS)):
        raise UserError("selfcal.dbc: GX_COEFFICIENTS: each column must have three items, in order")
    status, corrected, command, answer, tumble = map(
        database.get_message_by_name, (STATUS, CORRECTED, COMMAND, ANSWER, TUMBLE)
    )
    values = {
        "version": int(database.version or 0),
        "of_axis": {name: _first(database, suffix) for suffix, name in OF_AXIS.items()},
        "of_node": [status, corrected],
        "command": command,
        "of_host": [answer, tumble],
        "members_of": lambda message: [signal for signal in fields(message) if not LATER.match(signal.name)],
        "later_of": lambda message: any(LATER.match(signal.name) for signal in fields(message)),
        "choices_of": _choices,
        "COMMON": COMMON,
        **{"NODES": NODES, "NODE_IDS": NODE_IDS, "AXES": AXES, "HYPOTHESES": MOST_HYPOTHESES},
        "PLACES": len(PLACE_NAMES),
        "STATISTICS": STATISTICS,
    }
    return _template("selfcal_frames.h.jinja").render(values)


def _choices(message: Message) -> list[tuple[str, int, str]]:
    """Signal, number and word of each choice."""
    signals = [signal for signal in message.signals if not _as_elsewhere(signal)]
    return [(signal.name, number, str(word)) for signal in signals for number, word in (signal.choices or {}).items()]


def table(database: Database) -> str:
    """Every signal of every message for lib/WIRE.md, as Markdown lists."""
    status, command = map(database.get_message_by_name, (STATUS, COMMAND))
    messages: list[tuple[str, str, list[Signal], dict[str, str | None]]] = []
    for suffix in OF_AXIS:
        first, *_, last = of_axes = [database.get_message_by_name(axis.upper() + suffix) for axis in AXES]
        ids = ", ".join(f"`0x{message.frame_id:X}` {message.name}" for message in of_axes)
        more = f"; `_H1` to `_H{MOST_HYPOTHESES - 1}` follow each" if suffix == "_H0" else ""
        units = {signal.name: signal.unit for signal in fields(last)}
        messages.append((HEADINGS[suffix], ids + more, fields(first), units))
    for message in map(database.get_message_by_name, (STATUS, CORRECTED, ANSWER, TUMBLE)):
        messages.append((HEADINGS[message.name], f"`0x{message.frame_id:X}` {message.name}", fields(message), {}))
    values = {
        "COMMON": COMMON,
        "comments": {name: (status.get_signal_by_name(name).comment or "").rstrip(".") for name in COMMON},
        "messages": messages,
        "command": command,
        "orders": [(s.start, s.start + s.length - 1, s.name, _meaning(s)) for s in command.signals],
    }
    return _template("WIRE.md.jinja").render(values)


def _template(name: str) -> Template:
    templates = of_code(Path(__file__).parent / "templates")
    wrap = partial(textwrap.fill, width=120, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    templates.filters |= {"bits": _bits, "kind": _kind, "item": _item, "meaning": _meaning}
    templates.filters |= {"entry": lambda text: wrap(f"- {text}"), "wrapped": partial(textwrap.fill, width=120)}
    return templates.get_template(name)


def page(text: str, database: Database) -> str:
    """lib/WIRE.md, its lists made anew. Raises UserError if it has no place for them."""
    head, mark, _ = text.partition(MARK)
    if not mark:
        raise UserError(f"lib/WIRE.md: no line '{MARK.strip()}'")
    return head + mark + "\n" + table(database)


if __name__ == "__main__":
    wire = ROOT / "lib" / "WIRE.md"
    (ROOT / "lib" / "selfcal.dbc").write_text(dbc_text(), encoding="utf-8")  # first: the others are made from it
    wire.write_text(page(wire.read_text(encoding="utf-8"), load_dbc()), encoding="utf-8")
    (ROOT / "lib" / "selfcal_frames.h").write_text(header(load_dbc()), encoding="utf-8")
