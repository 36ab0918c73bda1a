"""The wire: telemetry frames in, reports out. `lib/selfcal.dbc` describes identifiers, items and units.

A frame is believed only if its form, checksum and counter are right. What is lost is counted. A report with frames
missing stays incomplete: it is never filled up with older values. Reports are by place; a model gives the names.
"""

from __future__ import annotations

import errno
import logging
import math
import os
import re
import shlex
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from selfcal import _firmware, _library32
from selfcal.bank.axis_result import AxisResult, Estimate
from selfcal.base.errors import UserError, called, few, install_line
from selfcal.base.units import SENSOR_UNITS, SENSORS
from selfcal.logs.framelog import LONGEST_FRAME, LONGEST_LINE
from selfcal.model.file import MOST_HYPOTHESES, Model
from selfcal.wire.dbc_file import BASE, BY_PLACE, COMMON, NODE_IDS, NODES, PLACE_NAMES, Names

if TYPE_CHECKING:
    import can
    from cantools.database.can import Database, Message

#: Axis messages are named after the axis, in capitals.
AXES = SENSORS
STATUS, CORRECTED, COMMAND, ANSWER, TUMBLE = "STATUS", "CORRECTED", "COMMAND", "ANSWER", "TUMBLE"
STATISTICS = ("mean", "median", "sd", "q05", "q95")
#: Moduli of the counter and of the time, s. Beyond half of them forward and backward are alike.
COUNTER, SECONDS = (1 << COMMON[name][1] for name in ("counter", "time"))
#: Whole statuses in a row with another version, of a module that stated this version before.
FOREIGN_STATUSES = 2
#: Frames in a row, counted up, that restart the counter; a stream is no stranger's from then. Statuses of two modules.
RESYNC = 3


#: The part of the source tree that an installed wheel has, and the root of the tree itself where it is used in place.
TREE = Path(__file__).resolve().parents[1] / "tree"
ROOT = TREE if TREE.is_dir() else TREE.parents[2]
#: The recording that ships.
SHIPPED = ROOT / "tests" / "data" / "simulated_adis16405.npz"


@lru_cache(maxsize=1)
def load_dbc() -> Database:
    """The frame format, lib/selfcal.dbc."""
    import cantools
    from cantools.database.can import Database

    database = cantools.database.load_file(ROOT / "lib" / "selfcal.dbc")
    assert isinstance(database, Database)
    return database


def version() -> int:
    """Version of the wire that this module reads."""
    return int(load_dbc().version or 0)


def axis_unit(axis: str) -> str:
    """Unit of an axis's readings on the wire. Raises UserError for an axis that has no message."""
    if axis not in AXES:
        raise UserError(f"axis '{axis}' has no telemetry message (there are {', '.join(AXES)})")
    return SENSOR_UNITS[axis]


def wire_names(model: Model) -> Names:
    """The model's names of hypotheses, of their parameters by place, and of regressor columns.

    Place 0 is N, place 1 the drift parameter, place 2 the bandwidth or ratio."""
    columns = tuple((column, regressor.unit) for regressor in model.regressors for column in regressor.columns)
    return Names(tuple(model.hypotheses), tuple(model.laws[name].parameters for name in model.hypotheses), columns)


def carries(axis: str, unit: str) -> bool:
    """Whether telemetry has a message for the axis, in this unit."""
    return axis in AXES and axis_unit(axis) == unit


def choices(message: str, signal: str) -> dict[int, str]:
    """The words that the DBC has for the values of a signal; none if it has no words."""
    named: Mapping[int, Any] = load_dbc().get_message_by_name(message).get_signal_by_name(signal).choices or {}
    return {number: str(name) for number, name in named.items()}


#: Meaning and remedy of each word of a reason (selfcal_reason_t), without those of a judgement alone.
REASONS = {
    "no_report": "no report yet: leave it at rest for three bank samples; none come: see the sensor's state",
    "moving": "moving: a report needs rest",
    "retired": "retired: exchange the sensor, then reset forget",
    "outside_priors": "outside the priors: widen them in the model file",
    "inadequate": "not adequate: record, and run selfcal diagnose",
    "not_identified": "not yet identified: leave it at rest for longer",
    "bad_sample": "bad sample, not finite or saturated on some axis: look at the sensor",
    "stuck": "stuck at one reading: exchange the sensor",
    "overtaken": "no report yet, samples overtook each: call selfcal_imu_work() more often, or codegen --hold",
}


def reasons(*messages: Mapping[str, float]) -> dict[str, str]:
    """Why each axis has no calibration to rely on, in the DBC's words; axes without a reason are left out. `messages`:
    status and corrected sample, as far as they came; of two the later counts."""
    known: dict[str, str] = {}
    latest = -math.inf
    for values in messages:
        said = {axis: values[f"reason_{axis}"] for axis in AXES if f"reason_{axis}" in values}
        if said and values.get("time_ms", -math.inf) >= latest:
            latest = values.get("time_ms", -math.inf)
            words = {axis: choices(STATUS, f"reason_{axis}").get(int(code), f"{code:g}") for axis, code in said.items()}
            known = {axis: word for axis, word in words.items() if word != "none"}
    return known


def tumble_text(values: Mapping[str, float]) -> str:
    """What to do in a calibration by rests in several positions, or why it came to nothing; "" if neither applies."""
    names = ("phase", "result", "next")
    phase, result, side = (choices(TUMBLE, name).get(int(values.get(name, 0)), "?").replace("_", " ") for name in names)
    if phase == "off":
        return "" if result == "none" else f"no calibration, {result}: send tumble start"
    sides = re.sub("(minus )?([xyz]) ", lambda match: f"{'-' if match[1] else '+'}{match[2]} ", side)
    todo = "hold still" if phase == "hold" else "send tumble stop" if sides == "none" else f"now {sides}"
    return f"{values.get('rests', 0):.0f} of {values.get('wanted', 0):.0f}: {todo}"


def status_text(signal: str, value: float) -> str:
    """A value of the status as the DBC names it, else the number with its unit; axes for a mask of them."""
    entry = load_dbc().get_message_by_name("STATUS").get_signal_by_name(signal)
    if entry.choices:
        return choices("STATUS", signal).get(int(value), f"{value:g}")
    if signal == "axes_retired":
        return ",".join(axis for index, axis in enumerate(AXES) if int(value) >> index & 1)
    return f"{int(value)}" if value == int(value) and not entry.unit else f"{value:g} {entry.unit or ''}".strip()


def frame_crc(frame_id: int, data: bytes) -> int:
    """Checksum of a frame with this id and these 8 bytes: its bits 52 to 63."""
    return int(
        _firmware.crc12(bytes((frame_id >> 8, frame_id & 0xFF, len(data))) + data[:6] + bytes((data[6] & 0x0F,)))
    )


@dataclass
class Statistics:
    """Frames of a stream.

    `lost` were sent but not accepted, by the counters; those that arrived `damaged` (checksum) are among
    them. `refused` had a wrong form (id, length, item), a value that cannot be, or a counter that repeats or goes back.
    `foreign` stated another version of the wire.
    """

    received: int = 0
    lost: int = 0
    damaged: int = 0
    refused: int = 0
    foreign: int = 0


@dataclass(frozen=True)
class AxisReport:
    """What arrived of an axis's report.

    `values` by signal name, units as in the DBC; those of hypothesis k begin with `hk_`. `time_s`: module time when it
    was begun, to the second below if the opening frame is missing.
    """

    axis: str
    time_s: float
    complete: bool
    values: dict[str, float]
    node: int = 0

    def value(self, signal: str) -> float:
        """A value, NaN if it did not arrive."""
        return self.values.get(signal, math.nan)

    @property
    def hypotheses(self) -> int | None:
        """How many the module's model has; None if that did not arrive."""
        return int(self.values["hypotheses"]) if "hypotheses" in self.values else None

    def result(self, names: Names = BY_PLACE) -> AxisResult:
        """The report as the engines give it. For complete reports only (KeyError otherwise), whose hypotheses `names`
        has."""
        v = self.values
        best = v["ln_evidence"]
        named = list(enumerate(names.hypotheses[: self.hypotheses]))

        def estimate(k: int, place: str) -> Estimate:
            numbers = {statistic: v[f"h{k}_{place}_{statistic}"] for statistic in STATISTICS}
            flags = int(v[f"h{k}_{place}_flags"])
            return Estimate(
                **numbers, identified=bool(flags & _library32.IDENTIFIED), off_grid=bool(flags & _library32.OFF_GRID)
            )

        def evidence(k: int) -> float:
            difference = v[f"h{k}_ln_evidence_diff"]
            return best + (difference if difference > _no_evidence() else -math.inf)

        def parameters(k: int) -> dict[str, Estimate]:
            there = [place for place in PLACE_NAMES if f"h{k}_{place}_mean" in v]
            return {name: estimate(k, place) for name, place in zip(names.parameters[k], there, strict=False)}

        return AxisResult(
            n=int(v["count"]),
            log_evidence={name: evidence(k) for k, name in named},
            probability={name: v[f"h{k}_probability"] for k, name in named},
            parameters={name: parameters(k) for k, name in named},
            bias_mean=v["bias_mean"],
            bias_sd=v["bias_sd"],
        )

    @property
    def adequacy(self) -> Adequacy | None:
        """What the module says of its model on this axis; None if it does not judge, or not all of it arrived."""
        needed = {"adequacy", "reason", "suspicion", "suspicion_score", "judged", "temperature_span"}
        if not needed <= self.values.keys():
            return None

        def word(signal: str) -> str:
            number = self.values[signal]
            return choices(f"{AXES[0].upper()}_ADEQUACY", signal).get(int(number), f"{number:g}")

        score, samples = self.values["suspicion_score"], int(self.values["judged"])
        change = None
        if {"change_count", "change", "change_size", "change_ago"} <= self.values.keys():
            count, size, ago_s = (self.values[f"change_{name}"] for name in ("count", "size", "ago"))
            change = ModuleChange(word("change"), size, ago_s, int(count))
        span = self.values["temperature_span"]
        moved = span if math.isfinite(span) else None
        return Adequacy(word("adequacy"), word("reason"), word("suspicion"), score, samples, moved, change)

    @staticmethod
    def in_use(probability: float) -> bool:
        """Whether a regressor is the likelier with this probability of use; NaN: it is not."""
        return probability > 0.5

    def coefficients(self, names: Names = BY_PLACE) -> dict[str, tuple[float, float, float]]:
        """Mean, sd and probability of use of each regressor column that came."""
        return {
            name: (self.value(f"c{c}_mean"), self.value(f"c{c}_sd"), self.value(f"c{c}_probability"))
            for c, (name, _) in enumerate(names.columns)
            if f"c{c}_mean" in self.values
        }


@dataclass(frozen=True)
class ModuleChange:
    """The last change that a module found and handled on an axis (lib/changes.c), and how many there were.

    `size`: of a step or a motion in the axis's unit, of a variance_change the noise over that before.
    """

    cause: str
    size: float
    ago_s: float
    count: int

    def __str__(self) -> str:
        size = f"noise x{self.size:.2f}" if self.cause == "variance_change" else f"{self.cause} of {self.size:+.3g}"
        return f"{size} {self.ago_s:.0f} s ago, handled"


@dataclass(frozen=True)
class Adequacy:
    """What a module says of its model on an axis (lib/adequacy.c): words as in the DBC.

    `state` is adequate, inadequate or not_judged, the last with a `reason`. `suspicion` is the strongest, `score` in
    standard deviations of its null law, over `samples` bank samples. `temperature_moved` is in degC, None if unknown.
    """

    state: str
    reason: str
    suspicion: str
    score: float
    samples: int
    temperature_moved: float | None = None
    change: ModuleChange | None = None

    def __str__(self) -> str:
        changed = f"; {self.change}" if self.change is not None else ""
        if self.state == "inadequate":
            return f"not adequate: {self.suspicion} ({self.score:+.1f} sd){changed}"
        judged = "adequate" if self.state == "adequate" else f"not judged: {self.reason.replace('_', ' ')}"
        return f"{judged}{changed}"


@dataclass
class _Open:
    """A report under way. `order`: of its last frame."""

    axis: str
    second: int
    time_s: float
    order: int
    frames: int = 0
    values: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Kind:
    """A message of the DBC: its axis (or ""), what the names of its values begin with, and its place in a report."""

    message: Message
    axis: str
    prefix: str
    part: int


#: Parts of a report in their order, by what follows the axis in a message's name. The end follows them.
_PARTS = ("", *(f"h{k}" for k in range(MOST_HYPOTHESES)), "coefficients", "adequacy")


@lru_cache(maxsize=1)
def _kinds() -> dict[int, _Kind]:
    """Messages that modules send, by their offset within a node's identifiers."""
    kinds = {}
    for message in load_dbc().messages:
        axis, _, rest = message.name.lower().partition("_")
        if message.name in (STATUS, CORRECTED, ANSWER, TUMBLE):
            kinds[message.frame_id - BASE] = _Kind(message, "", "", 0)
        elif axis in AXES and rest in _PARTS:
            prefix = f"{rest}_" if rest.startswith("h") else ""
            kinds[message.frame_id - BASE] = _Kind(message, axis, prefix, _PARTS.index(rest))
    return kinds


def node_of(identifier: int) -> int | None:
    """Node that a frame with this identifier comes from; None: no module sends it."""
    node, offset = divmod(identifier - BASE, NODE_IDS)
    return node if 0 <= node < NODES and offset in _kinds() else None


class Decoder:
    """Turns the frames of a node into reports and keeps the count of what went wrong.

    `from_start`: the stream is watched from the module's first frame, so frames lost before the first accepted frame
    count too.
    """

    def __init__(self, *, node: int = 0, from_start: bool = False) -> None:
        self.node = node
        self.statistics = Statistics()
        #: Last value of each status signal.
        self.status: dict[str, float] = {}
        #: Signals of the last corrected sample, as far as they have come without a loss.
        self.corrected: dict[str, float] = {}
        self._corrects = False  # what comes belongs to that sample
        #: Last value of each signal of the answers to commands.
        self.answer: dict[str, float] = {}
        #: Last value of each signal of the calibration by rests in several positions.
        self.tumble: dict[str, float] = {}
        #: Latest module time of a frame, unwrapped, ms. It goes back only if the module starts anew.
        self.time_ms = 0
        #: The module has said that no sample will follow, and this was its last status.
        self.finished = False
        #: Module time of the first status, ms, and of the last.
        self.status_ms: tuple[int, int] | None = None
        self._good = 0  # frames of a right form and checksum since the last status
        self._last_sent: int | None = None  # its frames_sent, and the count from which a status went back
        self._left_sent: int | None = None
        self._twins = 0  # statuses that a single module cannot have sent
        self._counter: int | None = COUNTER - 1 if from_start else None
        self._origin: int | None = 0 if from_start else None  # frames_sent of the first frame watched
        self._sent = 0  # frames sent since then, as far as known
        self._run: list[int] = []  # counters of good frames refused in a row
        self._open: _Open | None = None
        self._other: float | None = None  # version that the status under way states, if it is another
        self._others = 0  # whole statuses in a row that state it
        self._ours = False  # a status has stated this tool's version

    @property
    def foreign(self) -> str:
        """What is wrong if the module speaks another version of the wire; empty if it does not.

        A module that has spoken this version has to state another in FOREIGN_STATUSES whole statuses in a row.
        """
        if self._other is None or self._ours:
            return ""
        own = version()
        step = "load the firmware of this release into it" if self._other < own else "take the tools of its release"
        return f"the module speaks wire version {self._other:.0f}, this tool reads version {own}: {step}"

    @property
    def twins(self) -> str:
        """What is wrong if two modules send as this node; empty if they do not. Their reports are of neither."""
        # A restart within a status looks like a twin.
        return f"two modules send as node {self.node}: build one with another NODE" if self._twins >= RESYNC else ""

    @property
    def surely_foreign(self) -> bool:
        """Whole statuses in a row have stated so, no lone frame."""
        return bool(self.foreign) and self._others >= FOREIGN_STATUSES

    def feed(self, message: can.Message) -> list[AxisReport]:
        """Take a frame; return the reports that it closes (0 to 2)."""
        kind = _kinds().get(message.arbitration_id - BASE - NODE_IDS * self.node)
        special = message.is_extended_id or message.is_remote_frame or message.is_error_frame or message.is_fd
        if kind is None or special or not message.dlc == LONGEST_FRAME == len(message.data):
            return self._refused()
        data = bytes(message.data)
        bits = int.from_bytes(data, "little")
        item, counter, second, crc = (bits >> start & (1 << size) - 1 for start, size in COMMON.values())
        if crc != frame_crc(message.arbitration_id, data):
            self.statistics.damaged += 1
            return []
        values = _values(kind, data)
        if (
            values is None
            or int(values.get("time_ms", 1000.0 * second)) // 1000 % SECONDS != second
            or int(values.get("frames_sent", counter)) % COUNTER != counter
        ):
            return self._refused()
        name = kind.message.name
        self._good += 1
        if "frames_sent" in values:
            self._look_for_twin(int(values["frames_sent"]))
        jump = self._accept(counter)
        if jump == 0:
            return self._refused()
        self._corrects = self._corrects and jump == 1  # the frame that opens the next sample may be among the lost
        self.statistics.received += 1
        self.statistics.lost = self._sent - self.statistics.received
        if "time_ms" in values:
            # A report may have been begun, and a corrected sample read, 5 min before what was sent before it.
            begun_ms = self._advance(int(values["time_ms"]), 0 if name == STATUS else 300_000)
        else:
            begun_ms = self._begun(second)
        if name == STATUS:
            self._take_status(values)
            return self.flush()
        if self.foreign:
            return []
        if not kind.axis:
            if name == CORRECTED and "time_ms" in values:
                self.corrected = {}  # an axis that is no longer sent has no part in it
                self._corrects = True
            if name == CORRECTED and self._corrects:
                self.corrected.update(values)
            elif name == TUMBLE:
                self.tumble = values if "time_ms" in values else self.tumble | values
            elif name == ANSWER:
                self.answer.update(values)
            return self.flush()
        order = _starts()[-1] if "end_items" in values else _starts()[kind.part] + item
        named = {f"{kind.prefix}{signal}": value for signal, value in values.items()}
        return self._assemble(kind.axis, order, jump, second, begun_ms / 1000.0, named)

    def _refused(self) -> list[AxisReport]:
        self.statistics.refused += 1
        return []

    def _take_status(self, values: Mapping[str, float]) -> None:
        """Take an item of the status. Of another version nothing is believed but the version."""
        stated = values.get("wire_version")
        if stated == version():
            self._other, self._others, self._ours = None, 0, True
        elif stated is not None:
            self.statistics.foreign += 1
            self._others = self._others if stated == self._other else 0
            self._other = stated
        if "frames_sent" in values:
            self._exact(int(values["frames_sent"]))
            self._others += self._other is not None
            self._ours = self._ours and self._others < FOREIGN_STATUSES
        if self.foreign:
            self.status = {"wire_version": cast(float, self._other)}
            self._open = None
        elif stated in (None, version()):
            self.status.update(values)
        if "frames_sent" in values:
            # frames_sent ends each status
            self.finished = status_text("state", self.status.get("state", 0.0)) == "finished"
            self.status_ms = (self.time_ms if self.status_ms is None else self.status_ms[0], self.time_ms)

    def _look_for_twin(self, sent: int) -> None:
        """Count a status that no single module can have sent, by the frames that have come since the last status.

        More have come than were sent. Or the count goes on from where it was before it went back, and too few have come
        for that: after a restart the count begins anew."""
        last, good = self._last_sent, self._good
        self._last_sent, self._good = sent, 0
        if last is None:
            return
        ahead = sent - last
        if ahead < 0:
            self._left_sent = last
            return
        returned = self._left_sent is not None and sent >= self._left_sent and ahead > 2 * good + COUNTER
        self._twins += returned or (ahead > 0 and good > 1.5 * ahead + COUNTER // 2)

    def flush(self) -> list[AxisReport]:
        """Close the report under way, incomplete, for the end of a stream."""
        report, self._open = self._open, None
        return [] if report is None else [self._report(report, complete=False)]

    def _report(self, report: _Open, *, complete: bool) -> AxisReport:
        return AxisReport(report.axis, report.time_s, complete, report.values, self.node)

    def _accept(self, counter: int) -> int:
        """How far the counter went ahead; 0 if the frame is to be refused."""
        jump = COUNTER if self._counter is None else (counter - self._counter) % COUNTER
        if self._counter is None:
            self._sent = 1
        elif 1 <= jump <= COUNTER // 2:
            self._sent += jump
        else:
            if not self._run or counter != (self._run[-1] + 1) % COUNTER:
                self._run = []
            self._run.append(counter)
            if len(self._run) < RESYNC:
                return 0
            self._sent += jump or COUNTER
            jump = COUNTER  # continues no report
        self._run = []
        self._counter = counter
        return jump

    def _exact(self, frames_sent: int) -> None:
        """Make the loss exact: `frames_sent` went before the frame just accepted."""
        if self._origin is not None:
            unseen = _ahead(frames_sent + 1, self._origin + self._sent, 2**32)
            if unseen >= 0 and unseen % COUNTER == 0:
                self._sent += unseen
                self.statistics.lost = self._sent - self.statistics.received
                return
        self._origin = frames_sent + 1 - self._sent  # first of this stream, or the module has started anew

    def _advance(self, time_ms: int, back_ms: int) -> int:
        """Unwrapped module time of a frame, which may lie `back_ms` before others, else the module starts anew."""
        ahead = _ahead(time_ms, self.time_ms, 2**32)
        if ahead < -min(back_ms, self.time_ms):
            self.time_ms = time_ms
            return time_ms
        self.time_ms += max(0, ahead)
        return self.time_ms + min(0, ahead)

    def _assemble(
        self, axis: str, order: int, jump: int, second: int, begun_s: float, values: dict[str, float]
    ) -> list[AxisReport]:
        """Add a frame to its report. Frames of a report follow each other in ascending order, so a jump of the counter
        must not exceed that of the order."""
        closed: list[AxisReport] = []
        report = self._open
        if report is not None:
            goes_on = axis == report.axis and second == report.second and jump <= order - report.order
            if not goes_on:
                closed = self.flush()
                report = None
        if report is None:
            report = self._open = _Open(axis, second, begun_s, order)
        report.order = order
        report.frames += 1
        report.values.update(values)
        if "end_items" in values:
            self._open = None
            opened = report.values.get("time_ms")
            if opened is None or int(opened) % 2**24 == int(values["end_time_ms"]):
                complete = opened is not None and report.frames == int(values["end_items"]) and _whole(report.values)
                closed.append(self._report(report, complete=complete))
        return closed

    def _begun(self, second: int) -> int:
        """Module time of a frame that has its second alone, modulo SECONDS: the nearest to what is known."""
        wrapped = self.time_ms % 2**32
        ahead = _ahead(second, wrapped // 1000, SECONDS)
        return max(0, self.time_ms - wrapped % 1000 + 1000 * ahead)


def _ahead(second: int, known: int, modulus: int) -> int:
    """How far `second`, modulo `modulus`, lies before or behind what is known, by the shorter way."""
    return (second - known + modulus // 2) % modulus - modulus // 2


@lru_cache(maxsize=1)
def _no_evidence() -> float:
    """The least difference of evidence that its item holds, nats: it says that there is no evidence at all."""
    signal = load_dbc().get_message_by_name(f"{AXES[0].upper()}_H0").get_signal_by_name("ln_evidence_diff")
    return -(1 << signal.length - 1) * float(signal.scale)


@lru_cache(maxsize=1)
def _starts() -> tuple[int, ...]:
    """Place of the first frame of each part of a report among all frames that it may have, and of the last frame."""
    items = dict.fromkeys(range(len(_PARTS) + 1), 1)
    for kind in _kinds().values():
        if kind.axis == AXES[0]:
            inner = [signal for signal in kind.message.signals if not signal.name.startswith("end_")]
            items[kind.part] = 1 + max(signal.multiplexer_ids[0] for signal in inner if signal.multiplexer_ids)
    return tuple(sum(items[before] for before in range(part)) for part in items)


def _values(kind: _Kind, data: bytes) -> dict[str, float] | None:
    """Signals of a frame; None where the DBC has no such item, or a value cannot be."""
    try:
        decoded: dict[str, Any] = dict(kind.message.decode(data, decode_choices=False))  # type: ignore[arg-type]
    except Exception:  # cantools has a class of its own for an item that the DBC does not have
        return None
    values = {name: float(value) for name, value in decoded.items() if name not in COMMON}
    return values if all(_possible(kind, signal, value) for signal, value in values.items()) else None


def _possible(kind: _Kind, signal: str, value: float) -> bool:
    """Whether a module can mean this value.

    In an axis's messages a value that is not a number says that the module has none. A law without any evidence has
    minus infinity; a hair beyond 1 is the rounding of a sum in float32.
    """
    if math.isnan(value):
        return kind.axis != ""
    if signal.endswith("probability"):
        return 0.0 <= value <= 1.0 + MOST_HYPOTHESES * float(np.finfo(np.float32).eps)
    if signal == "hypotheses":
        return 1.0 <= value <= MOST_HYPOTHESES
    return math.isfinite(value) or (signal == "ln_evidence" and value < 0.0)


def _whole(values: Mapping[str, float]) -> bool:
    """Whether all hypotheses that the module has are there, and no other, with a place N each."""
    there = {k for k in range(MOST_HYPOTHESES) if f"h{k}_probability" in values}
    wanted = ("h{}_ln_evidence_diff", "h{}_N_flags", "h{}_N_mean")
    all_there = there == set(range(int(values["hypotheses"])))
    return all_there and all(name.format(k) in values for k in there for name in wanted)


class Streams:
    """The decoders of all nodes that are heard, by node.

    A node is heard from its first good frame on: its form and its checksum are right. `node`: look at this node alone.
    """

    def __init__(self, *, node: int | None = None) -> None:
        self.decoders: dict[int, Decoder] = {}
        self.strangers = Statistics()  # what belongs to no node
        self._node = node

    @staticmethod
    def of(decoder: Decoder) -> Streams:
        """Streams of a decoder that is there already."""
        streams = Streams(node=decoder.node)
        streams.decoders[decoder.node] = decoder
        return streams

    def feed(self, message: can.Message) -> list[AxisReport]:
        """Take a frame of any node; return the reports that it closes."""
        node = node_of(message.arbitration_id)
        if node is None:
            self.strangers.refused += 1
            return []
        if self._node is not None and node != self._node:
            return []
        decoder = self.decoders.get(node)
        if decoder is not None:
            return decoder.feed(message)
        decoder = Decoder(node=node)
        reports = decoder.feed(message)
        if decoder.statistics.received > 0:
            self.decoders[node] = decoder
        else:
            self.strangers.damaged += decoder.statistics.damaged
            self.strangers.refused += decoder.statistics.refused
        return reports

    def flush(self) -> list[AxisReport]:
        """Close the reports under way, incomplete, for the end of the streams."""
        return [report for decoder in self.decoders.values() for report in decoder.flush()]

    @property
    def known(self) -> dict[int, Decoder]:
        """The nodes that are no passing stranger, by number. Until then: all nodes that are heard."""
        heard = dict(sorted(self.decoders.items()))  # the view asks from a thread of its own
        sure = {
            node: decoder
            for node, decoder in heard.items()
            if decoder.statistics.received >= RESYNC or self._node == node
        }
        return sure or heard

    @property
    def statistics(self) -> Statistics:
        """Counts of all nodes together. Frames of a passing stranger count as refused."""
        known = self.known
        total = Counter(vars(self.strangers))
        for node, decoder in list(self.decoders.items()):
            counted = Counter(vars(decoder.statistics))
            if node not in known:
                counted["refused"] += counted.pop("received")
                del counted["lost"]
            total.update(counted)
        return Statistics(**total)


class Link:
    """A python-can bus whose `recv` survives what a damaged line does to it.

    `malformed` counts what came and was no frame; `closed` is set once the other side has gone. `again` opens the bus
    anew.
    """

    def __init__(self, bus: can.BusABC, again: Callable[[], can.BusABC] | None = None) -> None:
        self.bus = bus
        self.malformed = 0
        self.closed = False
        self._again = again

    def recv(self, timeout: float) -> can.Message | None:
        """The next frame, or None after `timeout` seconds or once closed."""
        import can

        end = time.monotonic() + timeout
        while not self.closed:
            try:
                return self.bus.recv(max(0.0, end - time.monotonic()))
            except (IndexError, ValueError):  # python-can slcan: a line cut short, an invalid digit
                self.malformed += 1
            except can.CanOperationError as error:
                if error.__cause__ is None or isinstance(error.__cause__, OSError):
                    self.closed = True
                    break
                self.malformed += 1
                # python-can 4.6 keeps the line it cannot decode, so every later line would fail with it. Its flush()
                # would throw away good frames that wait behind.
                self._shorten(0)
            except (OSError, can.CanError):
                self.closed = True
            finally:
                self._shorten(LONGEST_LINE)
            if time.monotonic() >= end:
                break
        return None

    def _shorten(self, longest: int) -> None:
        """Drop what a serial line has sent since its last end of line if that is longer than `longest` bytes."""
        buffer = getattr(self.bus, "_buffer", None)
        if isinstance(buffer, bytearray) and len(buffer) > longest:
            self.malformed += 1 if longest else 0
            buffer.clear()

    def reconnect(self) -> bool:
        """Open the bus anew; False if the other side is not back yet."""
        if self._again is None:
            return False
        self.close()
        try:
            self.bus = self._again()
        except UserError:
            return False
        self.closed = False
        return True

    def order(self, name: Literal["open", "close"]) -> None:
        """Open the channel of a serial line once more, or close it, not the line; on other buses nothing happens."""
        import can
        from can.interfaces.slcan import slcanBus

        try:
            if isinstance(self.bus, slcanBus):
                getattr(self.bus, name)()
        except (OSError, can.CanError):
            self.closed = True

    def close(self) -> None:
        """Close channel and line; no error if they are closed."""
        import can

        try:
            self.bus.shutdown()
        except (OSError, can.CanError):
            self.closed = True

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_bus(interface: str, channel: str, **options: Any) -> Link:
    """Open a python-can interface, a serial line for this process alone: of two readers each would lose what the other
    takes. Raises UserError when that fails."""
    import can

    logging.getLogger("can").setLevel(logging.CRITICAL)  # its drivers' errors say what they lack
    if interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise UserError(f"--interface {interface}: python-can has no such interface (there are {known})")
    return Link(_bus(interface, channel, options), lambda: _bus(interface, channel, options))


def _bus(interface: str, channel: str, options: Mapping[str, Any]) -> can.BusABC:
    import can
    from can.interfaces.slcan import slcanBus
    from can.interfaces.udp_multicast import UdpMulticastBus

    if interface in ("slcan", "serial"):
        _check_port(interface, channel)
    if interface == "udp_multicast" and find_spec("msgpack") is None:
        raise UserError(f"{interface}: msgpack is not installed: {install_line('selfcal[multicast]')}")
    try:
        bus = can.Bus(interface=interface, channel=channel, **options)
    except Exception as error:  # python-can's drivers raise what the libraries below them raise
        raise UserError(f"{interface} {channel}: {_reason(interface, channel, error)}") from error
    if isinstance(bus, slcanBus):
        _leave_out_line_feeds(bus.serialPortOrig)
        # A write to a pseudo-terminal that nobody reads would never end.
        bus.serialPortOrig.write_timeout = 1.0
        try:
            bus.serialPortOrig.exclusive = True
        except OSError as error:
            bus.serialPortOrig.close()  # first: the order to close the channel would reach the other's module
            Link(bus).close()
            raise UserError(f"{interface} {channel}: another program has it open") from error
    elif isinstance(bus, UdpMulticastBus):
        import socket

        with socket.socket(fileno=os.dup(bus.fileno())) as same:
            # Frames wait here while the host is busy: a report of six axes is 322 datagrams of 768 bytes.
            same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, (4 << 20))
    return bus


def _leave_out_line_feeds(port: Any) -> None:
    """Lines end in CR. Some adapters send CR LF, and python-can takes the LF for the next line's first letter."""
    read = port.read

    def without(size: int = 1) -> bytes:
        data: bytes = read(size)
        return b"" if data == b"\n" else data

    port.read = without


def _check_port(interface: str, channel: str) -> None:
    """Raises UserError if a channel can be no serial port, `PATH` or `PATH@BAUD`; a URL of pyserial's may be a port."""
    if "://" in channel:
        return
    name, _, baud = channel.partition("@")
    path = Path(name)
    if baud and not baud.isdecimal():
        raise UserError(f"{interface} {channel}: after the @ stands the line's rate, bit/s: {name}@115200")
    if not name or not path.exists():
        raise UserError(f"{interface} {channel}: there is no such port ({serial_ports()})")
    if not path.is_char_device():
        kind = "a folder" if path.is_dir() else "a file"
        more = f"; `{called()} monitor --read {shlex.quote(name)}` reads a log of frames" if path.is_file() else ""
        raise UserError(f"{interface} {channel}: this is {kind}, no serial port ({serial_ports()}){more}")


def serial_ports() -> str:
    """The machine's serial ports, in words."""
    from serial.tools.list_ports import comports

    ports = sorted(port.device for port in comports())
    if not ports:
        return "this machine has none: is the module plugged in?"
    return f"there are {few(ports)}"


def _can_devices() -> str:
    """The machine's CAN devices, in words. ARPHRD_CAN of linux/if_arp.h is 280."""
    names = []
    for device in sorted(Path("/sys/class/net").glob("*")):
        try:
            names += [device.name] if (device / "type").read_text().strip() == "280" else []
        except OSError:
            continue
    return f"there are {', '.join(names)}" if names else "this machine has none"


def _reason(interface: str, channel: str, error: BaseException) -> str:
    """Why a bus cannot be opened, and what to do about it."""
    import can

    below: BaseException | None = error
    while below is not None and not (isinstance(below, OSError) and below.errno):
        below = below.__cause__ or below.__context__
    number = below.errno if isinstance(below, OSError) else None
    said = " ".join(str(error).split()) or type(error).__name__
    if interface == "socketcan":
        if number in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT) or isinstance(error, AttributeError):
            return "this system has no SocketCAN: load it (`modprobe can-raw`), or take another --interface"
        if number == errno.ENODEV:
            return f"there is no such CAN device ({_can_devices()})"
        if number == errno.ENETDOWN:
            return f"the device is down: `ip link set {channel} up type can bitrate 500000`"
    if interface == "udp_multicast":
        if number in (errno.ENODEV, errno.ENETUNREACH):
            return f"no network takes this group: `ip route add {channel} dev lo` keeps it on this machine"
        return "this is no multicast group: take 239.74.163.2, python-can's own"
    if "://" in channel and number is None:
        return "pyserial opens no such address: socket://HOST:PORT and rfc2217://HOST:PORT are some that it does"
    if number in (errno.EACCES, errno.EPERM):
        return "no permission to open it: `sudo usermod -aG dialout $USER`, then log in anew"
    if "Could not configure port" in said:
        return f"this is no serial port ({serial_ports()})"
    if number == errno.EBUSY:
        return "another program has it open"
    if number is not None:
        return f"cannot open: {os.strerror(number)}"
    missing = (NameError, ImportError, can.CanInterfaceNotImplementedError)
    if isinstance(error, missing) or type(error) is OSError:  # PEAK's library is an OSError without a number
        return "its driver is not installed on this machine, or is none for this system"
    if isinstance(error, TypeError):
        return "this interface wants more than a channel: put the rest in python-can's configuration file"
    return "cannot open: is the device plugged in, and the channel right?"
