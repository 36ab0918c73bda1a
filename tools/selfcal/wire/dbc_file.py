"""DBC files of modules, written from the pattern `frames.dbc`.

The pattern holds a message of each kind, for axis gx and hypothesis 0. Here it becomes a file with a message for every
axis and hypothesis: `lib/selfcal.dbc`, with names of places, or the file of a module, with a model's names.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

from selfcal.base.code_template import of_code
from selfcal.base.errors import UserError, remark
from selfcal.base.units import SENSOR_UNITS, parameter_unit
from selfcal.model.file import MOST_BANK_COLUMNS, MOST_HYPOTHESES

if TYPE_CHECKING:
    from cantools.database.can import Database
    from cantools.database.can.signal import Signal

PATTERN = Path(__file__).parent / "frames.dbc"

#: Identifier of node 0's first message, identifiers of a node, and nodes of a bus.
BASE, NODE_IDS, NODES = 0x200, 128, 12
#: Signals every frame carries, first bit and number of bits, and the bits before them: those of the value, whose
#: meaning is the item's.
COMMON = {"item": (32, 6), "counter": (38, 6), "time": (44, 8), "crc": (52, 12)}
VALUE_BITS = COMMON["item"][0]
#: Names of the places of a hypothesis' parameters where no model gives better names.
PLACE_NAMES = ("N", "p1", "p2")
#: Signal of an axis's judgement whose words are those of every `reason_gx` to `reason_az`, too.
REASON = "reason"
#: Most letters of a name in a DBC file.
LETTERS_MOST = 32


class DbcMessage(NamedTuple):
    """A message of the file, made from a message of the pattern."""

    id: int
    name: str
    sender: str
    signals: Sequence[Signal]
    comment: str


@dataclass(frozen=True)
class Names:
    """What a model calls what its module sends by place.

    `hypotheses` in the order of the model. `parameters` of each, by place. `columns` of the regressors, with their
    units.
    """

    hypotheses: tuple[str, ...]
    parameters: tuple[tuple[str, ...], ...]
    columns: tuple[tuple[str, str], ...] = ()

    @property
    def known(self) -> bool:
        """A model gave these names; else they are the places'."""
        return self != BY_PLACE


#: The names of the places.
BY_PLACE = Names(
    tuple(f"h{k}" for k in range(MOST_HYPOTHESES)),
    (PLACE_NAMES,) * MOST_HYPOTHESES,
    tuple((f"c{column}", "") for column in range(MOST_BANK_COLUMNS)),
)


def check_node(node: int) -> None:
    """Raise UserError for a node that no bus has."""
    if not 0 <= node < NODES:
        raise UserError(f"--node {node}: a bus has nodes 0 to {NODES - 1}")


def identifier(node: int, offset: int) -> int:
    """Identifier of a message of a node."""
    return BASE + NODE_IDS * node + offset


def _changed(signal: Signal, **changes: object) -> Signal:
    """A copy of a signal with other attributes."""
    other = copy(signal)
    for name, value in changes.items():
        setattr(other, name, value)
    return other


def _in_unit(unit: str) -> Callable[[Signal], Signal]:
    """Readings of the axis gx become those of an axis that reads in `unit`."""
    units = {"deg/s": unit, parameter_unit("N", "deg/s"): parameter_unit("N", unit)}
    return lambda signal: _changed(signal, unit=units.get(signal.unit or "", signal.unit))


def _hypothesis(names: Names, k: int, reading: str) -> Callable[[Signal], Signal | None]:
    """Signals of a hypothesis, without the places that it lacks."""

    def change(signal: Signal) -> Signal | None:
        place, _, statistic = signal.name.partition("_")
        if place not in PLACE_NAMES:
            return signal
        index = PLACE_NAMES.index(place)
        if index >= len(names.parameters[k]):
            return None
        parameter = names.parameters[k][index]
        unit = "" if statistic == "flags" else parameter_unit(parameter, reading)
        comment = str(signal.comment)
        if names.known:
            words = ("the drift parameter, at place 1", "the bandwidth or ratio, at place 2")
            for word in words:
                comment = comment.replace(word, parameter).replace(word[0].upper() + word[1:], parameter)
        unit = "" if unit == "1" else unit
        return _changed(signal, name=f"{symbol(parameter)}_{statistic}", unit=unit, comment=comment)

    return change


def _coefficients(names: Names, reading: str) -> Callable[[Signal], Signal | None]:
    """Signals of the columns that there are."""
    symbols = _different(name for name, _ in names.columns)

    def change(signal: Signal) -> Signal | None:
        match = re.fullmatch(r"c(\d)_(\w+)", signal.name)
        if match is None:
            return signal
        if int(match[1]) >= len(names.columns):
            return None
        name, of = names.columns[int(match[1])]
        unit = f"{reading}/{remark(of)}" if of and match[2] != "probability" else ""
        comment = str(signal.comment).replace(f"column {match[1]}", f"column {remark(name)}")
        return _changed(signal, name=f"{symbols[int(match[1])]}_{match[2]}", unit=unit, comment=comment)

    return change


def symbol(name: str) -> str:
    """A name as a DBC file may have it: letters, digits and underscores, none too long, a letter first."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII)
    return (plain if plain[:1].isalpha() else f"_{plain}")[: LETTERS_MOST - len("_probability")]


def _different(names: Iterable[str]) -> list[str]:
    """The symbols of names, made different where two are alike."""
    symbols: list[str] = []
    for name in names:
        free, number = symbol(name), 2
        while free in symbols:
            free, number = f"{symbol(name)[:16]}_{number}", number + 1
        symbols.append(free)
    return symbols


def dbc_text(node: int = 0, names: Names = BY_PLACE, axes: Sequence[str] = tuple(SENSOR_UNITS)) -> str:
    """The DBC file of a node, whose model has these names and axes. Messages of node 0 have no prefix; those of node 3
    begin with `M3_`, so that files of several nodes go together."""
    from cantools.database import load_file

    pattern = cast("Database", load_file(PATTERN, sort_signals=None))
    reasons = pattern.get_message_by_name("GX_ADEQUACY").get_signal_by_name(REASON).choices
    prefix = f"M{node}_" if node else ""
    messages: list[DbcMessage] = []

    def same(signal: Signal) -> Signal:
        return _changed(signal, choices=reasons) if signal.name.startswith(f"{REASON}_") else signal

    def add(
        of: str, name: str = "", change: Callable[[Signal], Signal | None] = same, more: int = 0, **words: str
    ) -> None:
        """A message like `of` of the pattern, `more` identifiers behind it, with other words in its comment."""
        like = pattern.get_message_by_name(of)
        comment = like.comment or ""
        for theirs, ours in words.items():
            comment = comment.replace(theirs.replace("_", " "), ours)
        signals = [signal for signal in map(change, like.signals) if signal is not None]
        id_ = identifier(node, like.frame_id - BASE + more)
        messages.append(DbcMessage(id_, prefix + (name or of), like.senders[0], signals, comment))

    add("STATUS")
    for axis in axes:
        add("GX", axis.upper(), _in_unit(SENSOR_UNITS[axis]), list(SENSOR_UNITS).index(axis), gx=axis)
    for name in ("CORRECTED", "COMMAND", "ANSWER", "TUMBLE"):
        add(name)
    small = [name.lower() for name in _different(names.hypotheses)]
    for axis in axes:
        index, unit, big = list(SENSOR_UNITS).index(axis), SENSOR_UNITS[axis], axis.upper()
        if names.columns:
            add("GX_COEFFICIENTS", f"{big}_COEFFICIENTS", _coefficients(names, unit), index, gx=axis)
        add("GX_ADEQUACY", f"{big}_ADEQUACY", same, index, gx=axis)
        for k, hypothesis in enumerate(names.hypotheses):
            known_as = f"hypothesis {k}{f', {remark(hypothesis)}' if names.known else ''}"
            change = _hypothesis(names, k, unit)
            place = MOST_HYPOTHESES * index + k
            add("GX_H0", f"{big}_{small[k].upper()}", change, place, gx=axis, hypothesis_0=known_as)
    commented: set[tuple[str, str | None]] = set()

    def first_with(signal: Signal) -> bool:
        """Whether this is the first signal of its name with its comment."""
        before = len(commented)
        commented.update([(signal.name, str(signal.comment))] if signal.comment else [])
        return len(commented) > before

    values = {"pattern": pattern, "messages": messages, "first_with": first_with}
    values["sender"] = f"MODULE{node}" if node else "MODULE"
    return of_code(Path(__file__).parent / "templates").get_template("module.dbc.jinja").render(values)
