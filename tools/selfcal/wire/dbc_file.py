"""DBC files of modules, written from the pattern `frames.dbc`.

The pattern holds one message of each kind, for axis gx and hypothesis 0. Here it becomes a file with a message for
every axis and hypothesis: `lib/selfcal.dbc`, with names of places, or the file of a module, with a model's names.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from selfcal.base.errors import UserError, remark
from selfcal.base.templates import of_code
from selfcal.base.units import parameter_unit
from selfcal.model.file import MOST_COLUMNS, MOST_HYPOTHESES

PATTERN = Path(__file__).parent / "frames.dbc"

#: Axes, in the order of their messages, with the units that telemetry carries their readings in.
AXIS_UNITS = {"gx": "deg/s", "gy": "deg/s", "gz": "deg/s", "ax": "m/s^2", "ay": "m/s^2", "az": "m/s^2"}
#: Identifier of node 0's first message, identifiers of a node, and nodes of a bus.
BASE, NODE_IDS, NODES = 0x200, 128, 12
#: Hypotheses and regressor columns that telemetry has room for: as many as a model.
HYPOTHESES, COLUMNS = MOST_HYPOTHESES, MOST_COLUMNS
#: Names of the places of a hypothesis' parameters where no model gives better ones.
PLACE_NAMES = ("N", "p1", "p2")
#: Signal of an axis's judgement whose words are those of every `reason_gx` to `reason_az`, too.
REASON = "reason"
#: Most letters of a name in a DBC file.
LONGEST = 32


@dataclass(frozen=True)
class Signal:
    """One signal of a message: `before` and `after` its unit as the DBC writes them."""

    name: str
    before: str
    unit: str
    after: str
    comment: str = ""
    choices: str = ""
    is_float: bool = False


@dataclass
class Pattern:
    """One message of the pattern."""

    id: int
    name: str
    sender: str
    signals: list[Signal] = field(default_factory=list)
    comment: str = ""


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
    tuple(f"h{k}" for k in range(HYPOTHESES)),
    (PLACE_NAMES,) * HYPOTHESES,
    tuple((f"c{column}", "") for column in range(COLUMNS)),
)


def check_node(node: int) -> None:
    """Raise UserError for a node that no bus has."""
    if not 0 <= node < NODES:
        raise UserError(f"--node {node}: a bus has nodes 0 to {NODES - 1}")


def identifier(node: int, offset: int) -> int:
    """Identifier of a message of a node."""
    return BASE + NODE_IDS * node + offset


def _patterns(text: str) -> tuple[list[str], dict[str, Pattern], str]:
    """The lines before the first message, the messages by name, and the comment of the whole file."""
    head: list[str] = []
    messages: dict[int, Pattern] = {}
    of: Pattern | None = None
    whole = ""

    def change(id_: str, name: str, **changes: object) -> None:
        signals = messages[int(id_)].signals
        index = next(index for index, signal in enumerate(signals) if signal.name == name)
        signals[index] = replace(signals[index], **changes)  # type: ignore[arg-type]

    for line in text.splitlines():
        if match := re.match(r"BO_ (\d+) (\w+): 8 (\w+)", line):
            of = messages[int(match[1])] = Pattern(int(match[1]), match[2], match[3])
        elif of is None:
            head.append(line)
        elif match := re.match(r' SG_ (\w+)( .*)"(.*)"( .*)', line):
            of.signals.append(Signal(match[1], match[2], match[3], match[4]))
        elif match := re.match(r'CM_ BO_ (\d+) "(.*)";', line):
            messages[int(match[1])].comment = match[2]
        elif match := re.match(r'CM_ SG_ (\d+) (\w+) "(.*)";', line):
            change(match[1], match[2], comment=match[3])
        elif match := re.match(r"VAL_ (\d+) (\w+) (.*) ;", line):
            change(match[1], match[2], choices=match[3])
        elif match := re.match(r"SIG_VALTYPE_ (\d+) (\w+) : 1;", line):
            change(match[1], match[2], is_float=True)
        elif line.startswith("CM_"):
            whole = line
    words = next(signal.choices for message in messages.values() for signal in message.signals if signal.name == REASON)
    for message in messages.values():
        message.signals = [
            replace(signal, choices=words) if signal.name.startswith(f"{REASON}_") else signal
            for signal in message.signals
        ]
    return head, {message.name: message for message in messages.values()}, whole


def _renamed(pattern: Pattern, id_: int, name: str, change: Callable[[Signal], Signal | None], comment: str) -> Pattern:
    changed = (change(signal) for signal in pattern.signals)
    return Pattern(id_, name, pattern.sender, [signal for signal in changed if signal is not None], comment)


def _in_unit(unit: str) -> Callable[[Signal], Signal]:
    """Readings of the axis gx become those of an axis that reads in `unit`."""
    units = {"deg/s": unit, parameter_unit("N", "deg/s"): parameter_unit("N", unit)}
    return lambda signal: replace(signal, unit=units.get(signal.unit, signal.unit))


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
        comment = signal.comment
        if names.known:
            words = ("the drift parameter, at place 1", "the bandwidth or ratio, at place 2")
            for word in words:
                comment = comment.replace(word, parameter).replace(word[0].upper() + word[1:], parameter)
        unit = "" if unit == "1" else unit
        return replace(signal, name=f"{symbol(parameter)}_{statistic}", unit=unit, comment=comment)

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
        comment = signal.comment.replace(f"column {match[1]}", f"column {remark(name)}")
        return replace(signal, name=f"{symbols[int(match[1])]}_{match[2]}", unit=unit, comment=comment)

    return change


def symbol(name: str) -> str:
    """A name as a DBC file may have it: letters, digits and underscores, none too long, a letter first."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII)
    return (plain if plain[:1].isalpha() else f"_{plain}")[: LONGEST - len("_probability")]


def _different(names: Iterable[str]) -> list[str]:
    """The symbols of names, made different where two are alike."""
    symbols: list[str] = []
    for name in names:
        free, number = symbol(name), 2
        while free in symbols:
            free, number = f"{symbol(name)[:16]}_{number}", number + 1
        symbols.append(free)
    return symbols


def dbc(node: int = 0, names: Names = BY_PLACE, axes: Sequence[str] = tuple(AXIS_UNITS)) -> str:
    """The DBC file of a node, whose model has these names and axes. Messages of node 0 have no prefix; those of node 3
    begin with `M3_`, so that files of several nodes go together."""
    head, patterns, whole = _patterns(PATTERN.read_text(encoding="utf-8"))
    prefix = f"M{node}_" if node else ""
    sender = f"MODULE{node}" if node else "MODULE"
    messages: list[Pattern] = []

    def add(pattern: str, offset: int, name: str, change: Callable[[Signal], Signal | None], comment: str) -> None:
        messages.append(_renamed(patterns[pattern], identifier(node, offset), prefix + name, change, comment))

    def same(signal: Signal) -> Signal:
        return signal

    def offset(pattern: str) -> int:
        return patterns[pattern].id - BASE

    add("STATUS", offset("STATUS"), "STATUS", same, patterns["STATUS"].comment)
    for axis in axes:
        index, unit, big = list(AXIS_UNITS).index(axis), AXIS_UNITS[axis], axis.upper()
        add("GX", offset("GX") + index, big, _in_unit(unit), patterns["GX"].comment.replace("gx", axis))
    for name in ("CORRECTED", "COMMAND", "ANSWER", "TUMBLE"):
        add(name, offset(name), name, same, patterns[name].comment)
    small = [name.lower() for name in _different(names.hypotheses)]
    for axis in axes:
        index, unit, big = list(AXIS_UNITS).index(axis), AXIS_UNITS[axis], axis.upper()
        if names.columns:
            comment = patterns["GX_COEFFICIENTS"].comment.replace("gx", axis)
            change = _coefficients(names, unit)
            add("GX_COEFFICIENTS", offset("GX_COEFFICIENTS") + index, f"{big}_COEFFICIENTS", change, comment)
        comment = patterns["GX_ADEQUACY"].comment.replace("gx", axis)
        add("GX_ADEQUACY", offset("GX_ADEQUACY") + index, f"{big}_ADEQUACY", same, comment)
        for k, hypothesis in enumerate(names.hypotheses):
            comment = patterns["GX_H0"].comment.replace("gx", axis)
            comment = comment.replace(
                "hypothesis 0", f"hypothesis {k}{f', {remark(hypothesis)}' if names.known else ''}"
            )
            where = offset("GX_H0") + HYPOTHESES * index + k
            add("GX_H0", where, f"{big}_{small[k].upper()}", _hypothesis(names, k, unit), comment)
    said: set[tuple[str, str]] = set()

    def first_with(signal: Signal) -> bool:
        """Whether this is the first signal of its name with its comment."""
        before = len(said)
        said.update([(signal.name, signal.comment)] if signal.comment else [])
        return len(said) > before

    values = {"head": head, "messages": messages, "whole": whole, "sender": sender, "first_with": first_with}
    return of_code(Path(__file__).parent / "templates").get_template("module.dbc.jinja").render(values)
