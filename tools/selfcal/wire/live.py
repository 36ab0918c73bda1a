"""The live view of the telemetry of a module or several, for the terminal."""

from __future__ import annotations

import io
import math
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Protocol, TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from selfcal import _library32
from selfcal.base.units import STANDARD_GRAVITY, parameter_unit, typeset
from selfcal.wire.dbc_file import BY_PLACE, PLACE_NAMES, Names
from selfcal.wire.frames import (
    AXES,
    REASONS,
    AxisReport,
    Decoder,
    Statistics,
    Streams,
    axis_unit,
    reasons,
    status_text,
    tumble_text,
)

#: Status fields that this view omits.
OMITTED = {"time_ms", "wire_version", "model_id", "bank_interval", "bank_block", "state", "report", "frames_sent"}
OMITTED |= {f"reason_{axis}" for axis in AXES}
#: Least change of the temperature for a coefficient, degC: ArduPilot's rule (TCAL).
TEMPERATURE_NEEDED = 10.0
#: States that need the user.
TROUBLE = {"sensor_state": "failed", "clock": "internal", "state_found": "refused"}
#: Reasons that need the user, the most urgent first; the others pass by themselves.
URGENT = ("retired", "stuck", "bad_sample", "outside_priors", "inadequate", "moving")
HEALTH = ("not_finite", "saturated", "stuck", "gaps", "blocks_lost")
#: Cells of a probability bar and of the bias's sparkline, at least and at most. Many hypotheses leave no room for bars.
BAR, SPARK = (4, 30), (8, 40)
#: Indentation of an axis's further lines.
INDENT = 2
#: Silence after which contact is lost, s, or three times the longest interval so far.
SILENT_S = 3.0
#: Silence of a module before its second status, s: it sends a status every 10 s (STATUS_MS in port/app/app_frames.c),
#: and a save takes up to 2 s.
FIRST_S = 12.0
#: Most characters that wait for a terminal, which has 1 s to read them at the end.
MOST_WAITING = 1 << 16
BLOCKS = "▁▂▃▄▅▆▇█"
#: Colours of a module's judgement of its model.
ADEQUACY = {"inadequate": "red", "adequate": "green"}


class Patient(io.TextIOBase):
    """A terminal's stream that never holds its writer: a thread writes. What a terminal that has stopped reading leaves
    waiting is dropped from MOST_WAITING characters on."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self._stream = stream
        self._waiting: deque[str] = deque()
        self._ready = threading.Condition()
        self._busy = False
        threading.Thread(target=self._run, daemon=True).start()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """The stream's."""
        return self._stream.encoding

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()

    def write(self, text: str) -> int:
        """Take a text. Never waits."""
        with self._ready:
            if sum(map(len, self._waiting)) < MOST_WAITING:
                self._waiting.append(text)
                self._ready.notify_all()
        return len(text)

    def drain(self, seconds: float) -> bool:
        """Wait so long until all has gone out; whether it has."""
        with self._ready:
            return self._ready.wait_for(lambda: not (self._waiting or self._busy), seconds)

    def _run(self) -> None:
        while True:
            with self._ready:
                self._ready.wait_for(lambda: bool(self._waiting))
                data, self._busy = "".join(self._waiting).encode(self.encoding, "replace"), True
                self._waiting.clear()
            # Not by the stream: Python's end would wait for its lock.
            with suppress(OSError):
                while data:
                    data = data[os.write(self.fileno(), data) :]
            with self._ready:
                self._busy = False
                self._ready.notify_all()


@contextmanager
def patient() -> Iterator[None]:
    """Within, a terminal's stderr is a Patient: a view that nobody reads ends as any other. It stays a Patient if the
    terminal still does not read at the end."""
    if not sys.stderr.isatty():
        yield
        return
    before, sys.stderr = sys.stderr, (own := Patient(sys.stderr))
    try:
        yield
    finally:
        if own.drain(1.0):
            sys.stderr = before


class FrameSource(Protocol):
    """Where frames come from."""

    @property
    def malformed(self) -> int: ...
    @property
    def closed(self) -> bool: ...


class Contact:
    """When the module was heard last, by the host's clock (`clock`, s).

    Contact is lost after SILENT_S, or after three times the longest interval that lay between two frames in a row,
    whichever is longer. Intervals with lost frames do not count. Before the module's second status its
    interval is unknown: contact is then lost after FIRST_S.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since = clock()
        self._longest = 0.0
        self.ever = False
        self.paced = False

    def heard(self, *, in_a_row: bool, paced: bool) -> None:
        """Something came. `in_a_row`: a frame, and no other was lost before it. `paced`: a second status has come,
        more than SILENT_S of module time after the first."""
        self.paced = paced
        if in_a_row and self.ever:
            self._longest = max(self._longest, self.silent_s)
        self._since = self._clock()
        self.ever = True

    @property
    def silent_s(self) -> float:
        """Time since then, or since the start."""
        return max(0.0, self._clock() - self._since)

    @property
    def lost(self) -> bool:
        """The module is not heard any more, or never was."""
        return self.silent_s > max(FIRST_S if self.waiting else SILENT_S, 3.0 * self._longest)

    @property
    def waiting(self) -> bool:
        """Silent, and it is not known yet how often the module speaks."""
        return self.ever and not self.paced and self.silent_s > SILENT_S


@dataclass
class LiveModule:
    """A module that is heard: its last report of each axis with the last biases, and the module time then, s."""

    decoder: Decoder
    last: dict[str, tuple[AxisReport, deque[float]]] = field(default_factory=dict)
    time_s: float = 0.0

    @property
    def reasons(self) -> dict[str, str]:
        """Why axes have no calibration to rely on, by the last message."""
        return reasons(dict(self.decoder.status), dict(self.decoder.corrected))

    def now(self) -> float:
        """Module time, s. If it goes back, the module has started anew and its earlier reports are void."""
        time_s = self.decoder.time_ms / 1000.0
        if time_s < self.time_s:
            self.last.clear()
        self.time_s = time_s
        return time_s


@dataclass
class View:
    """The last report of each axis, the status and the frame counts of each module, fitted to the terminal.

    A progress bar if `total_s` is known. What did not arrive of a report is shown as `?`, never as an older value, and
    what the module has no number for as `-`. A module that has started anew has reported nothing yet. With `contact`
    silence counts: reports age, and a module that is not heard is not shown as running. `contacts`: that of each node.
    `axes`: those to show; default all. `names` gives the names of a module by its status, `advice` what to do without
    names.
    """

    heard: Streams | Decoder
    source: FrameSource
    title: str
    total_s: float | None = None
    contact: Contact | None = None
    axes: Sequence[str] = ()
    contacts: Mapping[int, Contact] = field(default_factory=dict)
    names: Callable[[Mapping[str, float]], Names] = lambda status: BY_PLACE
    advice: Callable[[Mapping[str, float]], str] = lambda status: ""

    def __post_init__(self) -> None:
        self.streams = Streams.of(self.heard) if isinstance(self.heard, Decoder) else self.heard
        self._modules: dict[int, LiveModule] = {}
        self._console = Console(stderr=True)
        self._live = Live(
            get_renderable=self.renderable,
            console=self._console,
            refresh_per_second=4,
            transient=True,
            redirect_stdout=False,  # it would put the lines of --stream jsonl into the view
        )

    def show(self, reports: Sequence[AxisReport]) -> None:
        """Take new reports."""
        for node in list(self.streams.decoders):
            self._module(node).now()
        for report in reports:
            if not self.axes or report.axis in self.axes:
                last = self._module(report.node).last
                _, trend = last.get(report.axis, (report, deque(maxlen=SPARK[1])))
                trend.append(report.value("bias_mean"))
                last[report.axis] = report, trend

    def _module(self, node: int) -> LiveModule:
        return self._modules.setdefault(node, LiveModule(self.streams.decoders[node]))

    def _contact_of(self, module: LiveModule | None) -> Contact | None:
        return self.contact if module is None else self.contacts.get(module.decoder.node, self.contact)

    def __enter__(self) -> View:
        try:
            self._live.start()
        except BaseException:
            self._live.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def print_last(self) -> None:
        """Print what there is to see at the end, all axes whatever the window's height."""
        self._console.print(self.renderable(whole=True))

    def renderable(self, *, whole: bool = False) -> RenderableType:
        """The view now; unless `whole`, no higher than the terminal."""
        width = self._console.width
        modules = {node: self._module(node) for node in self.streams.known}
        first = next(iter(modules.values()), None)
        numbered = not set(modules) <= {0}  # a bus with other nodes than node 0
        title = Text(self.title, "bold") if numbered else self._title_of(self.title, first)
        parts: list[RenderableType] = [_line(self._verdict(modules)), _line(title)]
        if self.total_s is not None and not whole:
            done = round(min(1.0, (first.now() if first else 0.0) / self.total_s) * (width // 2))
            parts.append(Text.assemble(("━" * done, "green"), ("━" * (width // 2 - done), "dim")))
        height = None if whole else self._console.height - len(parts) - (len(modules) > 1)
        for row, (node, module) in enumerate(modules.items()):
            share = None if height is None else height // (len(modules) - row)
            lines = [_line(self._title_of(f"node {node}", module))] if numbered else []
            lines += self._lines(module, width, None if share is None else share - len(lines))
            height = None if height is None else height - len(lines)
            parts += lines
        if len(modules) != 1:
            said = frame_counts(self.streams, self.source)
            parts.append(_line(Text(f"all {said}" if modules else said, "dim")))
        return Group(*parts)

    def _verdict(self, modules: Mapping[int, LiveModule]) -> Text:
        """How many axes are calibrated, the age of the oldest report, and the next thing to do."""
        axes, ready, oldest_s, step = 0, 0, 0.0, ""
        for node, module in modules.items():
            contact, why, last = self._contact_of(module), module.reasons, dict(module.last)
            shown = [axis for axis in AXES if (axis in last or axis in why) and axis in (self.axes or AXES)]
            axes += len(shown)
            ready += sum(axis in last and axis not in why and last[axis][0].complete for axis in shown)
            silent_s = contact.silent_s if contact is not None else 0.0
            ages = [max(0.0, module.time_s - last[axis][0].time_s) + silent_s for axis in shown if axis in last]
            oldest_s = max([oldest_s, *ages])
            todo = self._next_step(module, shown)
            if todo and not step:
                step = f"node {node}: {todo}" if len(modules) > 1 else todo
        contact = self.contact
        if contact is not None and self.source.closed:
            step = "plug the port in again"
        elif not modules:
            step = "no module heard: check channel, cable and power" if contact is not None else "no module heard"
        said = f"calibrated {ready} of {axes}" + (f", oldest report {oldest_s:.0f} s" if ready else "")
        done = axes > 0 and ready == axes and not step
        step = step or ("nothing to do" if done else "wait for reports")
        return Text(f"{said}, {step}", "green" if done else "yellow")

    def _next_step(self, module: LiveModule, shown: Sequence[str]) -> str:
        """The next step for a module; else ""."""
        contact, status = self._contact_of(module), module.decoder.status
        if wrong := module.decoder.foreign or module.decoder.twins:
            return wrong
        if contact is not None and contact.lost and not module.decoder.finished:
            return "contact lost: check cable and power"
        texts = {name: status_text(name, status[name]) for name in TROUBLE if name in status}
        trouble = next((f"{name} {text}" for name, text in TROUBLE.items() if texts.get(name) == text), "")
        if trouble:
            return f"{trouble}: see port/README.md"
        if said := tumble_text(module.decoder.tumble):
            return said
        why = {axis: word for axis, word in module.reasons.items() if axis in shown}
        word = next((word for word in URGENT if word in why.values()), next(iter(why.values()), ""))
        names = ", ".join(axis for axis, reason in why.items() if reason == word)
        return f"{names}: {REASONS.get(word, word)}" if word else ""

    def _lines(self, module: LiveModule, width: int, height: int | None) -> list[Text]:
        """The lines of a module below its title, `height` at most."""
        foreign = module.decoder.foreign
        if foreign:
            return [*_flow([Text(word, "bold red") for word in foreign.split()], width, 1), self._counts(module)]
        lines = self._status(module, width)
        lines.append(self._counts(module))
        if module.decoder.statistics.foreign:
            lines.append(_line(Text("items of the status that state another wire version are left out", "yellow")))
        advice = self.advice(module.decoder.status)
        if advice:
            lines += _flow([Text(word, "yellow") for word in advice.split()], width, 1)
        lines += _flow([Text(said, "cyan") for said in _calibration(dict(module.decoder.tumble))], width, 3)
        last = dict(module.last)  # Live asks from a thread of its own
        lines += self._unreported(module, last, width)
        lines += self._sufficiency(last)
        if last:
            names = self.names(module.decoder.status)
            count = max((report.hypotheses or hypotheses_seen(report) for report, _ in last.values()), default=0)
            named = (names.hypotheses if count <= len(names.hypotheses) else BY_PLACE.hypotheses)[:count]
            lines.append(_line(_heading(named, _bar_cells(len(named), width))))
            blocks = self._blocks(module, last, names, len(named), width)
            lines += _fitted(blocks, None if height is None else height - len(lines))
        return lines

    @staticmethod
    def _sufficiency(last: Mapping[str, tuple[AxisReport, deque[float]]]) -> list[Text]:
        """The law that the record is too short for."""
        judgements = [report.adequacy for report, _ in last.values()]
        moves = [judged.temperature_moved for judged in judgements if judged and judged.temperature_moved is not None]
        moved = max(moves, default=TEMPERATURE_NEEDED)
        if moved >= TEMPERATURE_NEEDED:
            return []
        said = f"temperature has moved {moved:.1f} of the {TEMPERATURE_NEEDED:g} degC that a temperature law needs"
        return [_line(Text(said, "dim"))]

    def _unreported(self, module: LiveModule, last: Mapping[str, object], width: int) -> list[Text]:
        """Why axes have no report, a line for each reason."""
        axes: dict[str, list[str]] = {}
        for axis, word in module.reasons.items():
            if axis not in last and (not self.axes or axis in self.axes):
                axes.setdefault(word, []).append(axis)
        return [
            line
            for word, names in axes.items()
            for line in _flow(
                [Text(said, "yellow") for said in f"{', '.join(names)}: {REASONS.get(word, word)}".split()], width, 1
            )
        ]

    def _counts(self, module: LiveModule) -> Text:
        """The frames of a module, and of strangers if it is alone."""
        whole = len(self.streams.known) == 1
        said = frame_counts(self.streams, self.source) if whole else counted(module.decoder.statistics)
        return _line(Text(said, "dim"))

    def _title_of(self, name: str, module: LiveModule | None) -> Text:
        time_s = module.now() if module is not None else 0.0
        return Text.assemble((f"{name}   module time {time_s:.1f} s   ", "bold"), self._state(module))

    def _state(self, module: LiveModule | None) -> Text:
        """State of the module, as far as it is heard."""
        contact = self._contact_of(module)
        status = module.decoder.status if module is not None else {}
        finished = module is not None and module.decoder.finished
        said = status_text("state", status["state"]) if status.get("state") else "waiting for the module"
        if contact is not None and self.source.closed:
            return Text(f"port gone for {contact.silent_s:.0f} s, waiting for it", "bold red")
        if contact is not None and contact.lost and not finished:
            word = "lost contact: no word" if contact.ever else "no word"
            return Text(f"{word} for {contact.silent_s:.0f} s", "bold red")
        if contact is not None and contact.waiting and not finished:
            return Text(f"waiting: no word for {contact.silent_s:.0f} s, a status comes every 10 s", "yellow")
        end = contact is None and self.total_s is None and self.source.closed
        return Text(f"{said}, end of the log" if end else said, "bold")

    def _status(self, module: LiveModule, width: int) -> list[Text]:
        """What the status says that is not 0, by its signals' names (port/README.md); trouble first."""
        said: list[Text] = []
        for name, value in list(module.decoder.status.items()):
            if name not in OMITTED and value != 0.0:
                text = status_text(name, value)
                trouble = TROUBLE.get(name) == text or name in ("sensor_fault", "axes_retired", "state_refused")
                said.insert(0 if trouble else len(said), Text(f"{name} {text}", "red" if trouble else "dim"))
        return _flow(said, width, 3)[:2]

    def _blocks(
        self,
        module: LiveModule,
        last: Mapping[str, tuple[AxisReport, Sequence[float]]],
        names: Names,
        hypotheses: int,
        width: int,
    ) -> list[list[Text]]:
        """An axis's lines: the probabilities; bias, its course and N; what else there is."""
        cells, contact = _bar_cells(hypotheses, width), self._contact_of(module)
        bias = {
            axis: f"bias {_number(report, 'bias_mean', '%.5g')} ± {_number(report, 'bias_sd', '%.2g')} "
            f"{typeset(axis_unit(axis))}"
            for axis, (report, _) in last.items()
        }
        parameters = {axis: _parameters(report, names, named=not cells) for axis, (report, _) in last.items()}
        bias_width = max(map(len, bias.values()))
        spark = min(SPARK[1], width - INDENT - bias_width - 2 - max(len(texts[0]) for texts in parameters.values()))
        blocks, why = [], module.reasons
        for axis, (report, trend) in last.items():
            age_s = max(0.0, module.time_s - report.time_s)
            age_s += contact.silent_s if contact is not None else 0.0
            best = most_probable(report, names)
            head = Text(f"{axis:<5}{_number(report, 'count', '%.0f'):>8}")
            for k in range(hypotheses):
                head.append("  ").append(_bar(report, k, cells), "bold green" if k == best else "")
            head.append(f"{age_s:.0f} s".rjust(7), "dim")
            course = Text(_spark(trend, report.value("bias_sd"), spark), "cyan") if spark >= SPARK[0] else ""
            chunks = [Text.assemble(bias[axis].ljust(bias_width), " ", course, " ", parameters[axis][0])]
            chunks += [Text(text) for text in parameters[axis][1:]]
            chunks += [Text(text) for text in _coefficients(report, names)]
            if report.adequacy is not None:
                chunks.append(Text(str(report.adequacy), ADEQUACY.get(report.adequacy.state, "dim")))
            if axis in why:
                chunks.append(Text(REASONS.get(why[axis], why[axis]), "yellow"))
            chunks += [Text(name, "red") for name in HEALTH if report.values.get(name)]
            blocks.append([_line(head), *_flow(chunks, width, 2, indent=INDENT)])
        return blocks


def _calibration(values: Mapping[str, float]) -> list[str]:
    """The result of a calibration by rests in several positions, in data sheet units."""
    units = {"bias": (1e6 / STANDARD_GRAVITY, "ug"), "scale": (1e6, "ppm"), "angle": (1e3, "mrad")}
    said = []
    for name, value in values.items():
        size, unit = units.get(name.partition("_")[0], (0.0, ""))
        if f"{name}_sd" in values:
            said.append(f"{name.replace('_', ' ')} {size * value:.6g} ± {size * values[f'{name}_sd']:.2g} {unit}")
        elif name.startswith("g_"):
            said.append(f"G {name[2:]} {value:.4f} deg/s/g")
    return said


def counted(s: Statistics) -> str:
    """Counts of a stream's frames, in words."""
    foreign = f", {s.foreign} foreign" if s.foreign else ""
    return f"frames: {s.received} received, {s.lost} lost; {s.damaged} bad checksum, {s.refused} refused{foreign}"


def frame_counts(streams: Streams | Decoder, source: FrameSource) -> str:
    """A line on the fate of all frames."""
    return f"{counted(streams.statistics)}, {source.malformed} malformed"


def hypotheses_seen(report: AxisReport) -> int:
    """Fewest hypotheses of a report, by its values."""
    return max((k + 1 for k in range(len(BY_PLACE.hypotheses)) if f"h{k}_probability" in report.values), default=0)


def most_probable(report: AxisReport, names: Names = BY_PLACE) -> int | None:
    """The hypothesis with the greatest probability; None if a missing probability, or NaN, could be
    greater. If the report lacks their number, a model's `names` have it."""
    count = report.hypotheses or (len(names.hypotheses) if names.known else None)
    signals = {k: f"h{k}_probability" for k in range(hypotheses_seen(report))}
    probabilities = {k: report.values[signal] for k, signal in signals.items() if signal in report.values}
    if not probabilities or len(probabilities) != count:
        return None
    if len({math.isnan(probability) for probability in probabilities.values()}) > 1:
        return None  # all of them NaN is a report outside the priors: the view says that
    return max(probabilities, key=lambda k: probabilities[k])


def _bar_cells(hypotheses: int, width: int) -> int:
    """Cells of a bar; 0 without room."""
    cells = min(BAR[1], (width - 20) // max(1, hypotheses) - 8)
    return cells if cells >= BAR[0] else 0


def _heading(names: Sequence[str], cells: int) -> Text:
    """Columns of a line. A name has the width of its number and bar."""
    width = 6 + cells if cells else 5
    said = ("P " if cells else "") + "{}"
    named = "  ".join(said.format(name.replace("_", " "))[:width].ljust(width) for name in names)
    return Text(f"axis {'averages':>8}  {named}{'age':>7}", "dim")


def _fitted(blocks: list[list[Text]], height: int | None) -> list[Text]:
    """The lines of all blocks. Where they are more than `height`, the last axes lose theirs but for the first line,
    then that; the first axis stays whole."""
    if height is not None:
        for block in reversed(blocks[1:]):
            if sum(map(len, blocks)) > height:
                del block[1:]
        left_out = 0
        while len(blocks) > 1 and sum(map(len, blocks)) + (left_out > 0) > height:
            blocks.pop()
            left_out += 1
        if left_out:
            blocks.append([_line(Text(f"{left_out} axes more: a taller window shows them, or --axis", "dim"))])
    return [line for block in blocks for line in block]


def _line(text: Text) -> Text:
    text.no_wrap, text.overflow = True, "ellipsis"
    return text


def _flow(chunks: Iterable[Text], width: int, gap: int, indent: int = 0) -> list[Text]:
    """Chunks in lines of `width` cells, none divided."""
    lines: list[Text] = []
    for chunk in chunks:
        if not lines or lines[-1].cell_len + gap + chunk.cell_len > width:
            lines.append(_line(Text(" " * indent)))
        else:
            lines[-1].append(" " * gap)
        lines[-1].append_text(chunk)
    return lines


def _number(report: AxisReport, signal: str, form: str, *, inverse: bool = False) -> str:
    value = report.values.get(signal)
    if value is None or math.isnan(value):
        return "?" if value is None else "-"
    return form % (value if not inverse else 1.0 / value if value else math.inf)


def _bar(report: AxisReport, k: int, cells: int) -> str:
    probability = report.value(f"h{k}_probability")
    if math.isnan(probability):
        return _number(report, f"h{k}_probability", "").ljust(6 + cells if cells else 5)
    if not cells:
        return f"{probability:.3f}"
    filled = round(min(1.0, max(0.0, probability)) * cells)
    return f"{probability:.3f} {'█' * filled}{'·' * (cells - filled)}"


def _spark(trend: Sequence[float], sd: float, cells: int) -> str:
    """The last biases, the newest at the right. The height spans what they span, two of their sd at least."""
    shown = list(trend)[-cells:]
    finite = [value for value in shown if math.isfinite(value)]
    if not finite:
        return " " * cells
    low, high = min(finite), max(finite)
    least = 2.0 * sd if math.isfinite(sd) else 0.0
    middle, span = (low + high) / 2.0, max(high - low, least) or 1.0
    heights = (
        " " if not math.isfinite(value) else BLOCKS[min(7, max(0, int(8.0 * ((value - middle) / span + 0.5))))]
        for value in shown
    )
    return "".join(heights).ljust(cells)


def _parameters(report: AxisReport, names: Names, *, named: bool = False) -> list[str]:
    """The parameters of the most probable hypothesis, medians with their intervals; first N, or why it is missing.
    `named`: its name before them, as without a model's names."""
    k = most_probable(report, names)
    if k is None:
        return ["most probable law: ? (not all probabilities came)"]
    if math.isnan(report.values[f"h{k}_probability"]):
        return ["outside the priors"]
    said = []
    given = names.parameters[k] if k < len(names.parameters) else BY_PLACE.parameters[k]
    for place, parameter in zip(PLACE_NAMES, given, strict=False):
        if not names.known and not any(key.startswith(f"h{k}_{place}_m") for key in report.values):
            continue  # a place that the law lacks
        signal, inverse = f"h{k}_{place}", parameter == "alpha"  # as a time, like the table
        keys = ("median", "q95", "q05") if inverse else ("median", "q05", "q95")
        middle, low, high = (_number(report, f"{signal}_{key}", "%.3g", inverse=inverse) for key in keys)
        label = "1/alpha" if inverse else parameter
        unit = "s" if inverse else typeset(parameter_unit(parameter, axis_unit(report.axis)))
        said.append(f"{label} {middle} [{low}, {high}] {unit if unit != '1' else ''}".rstrip())
    if any(
        int(report.values.get(f"h{k}_{place}_flags", 0)) & _library32.OFF_GRID for place in PLACE_NAMES[: len(given)]
    ):
        said.append("grid of nodes too coarse")
    if named or not names.known:
        name = names.hypotheses[k] if k < len(names.hypotheses) else BY_PLACE.hypotheses[k]
        said[:1] = [f"{name.replace('_', ' ')}: {said[0] if said else 'no number'}"]
    return said


def _coefficients(report: AxisReport, names: Names) -> list[str]:
    """Coefficients of the regressor columns that came, with the probability that each is in use."""
    reading, units = axis_unit(report.axis), dict(names.columns)
    said = []
    for name, (mean, sd, probability) in report.coefficients(names).items():
        unit = f" {typeset(f'{reading}/{units[name]}')}" if units[name] else ""
        said.append(f"{name} {mean:.3g} ± {sd:.2g}{unit} (P {probability:.2f})")
    return said
