"""The live view of a module's telemetry, for the terminal."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import TracebackType
from typing import Protocol

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from selfcal.laws import NAMED, PLAIN
from selfcal.units import typeset
from selfcal.wire import OFF_GRID, AxisReport, Decoder, signal_unit, status_text

SHORT = {
    "constant": "constant",
    "random_walk": "random walk",
    "gauss_markov": "Gauss-Markov",
    "flicker": "flicker",
    "moving_average": "walk + MA",
    "walk_and_markov": "walk + G-M",
}
#: Of the status, what is told elsewhere or to programs alone.
UNTOLD = ("time_ms", "wire_version", "model_id", "bank_interval", "bank_block", "state", "report", "frames_sent")
#: What the user has to do something about.
TROUBLE = {"sensor_state": "failed", "clock": "internal", "state_found": "refused"}
HEALTH = ("not_finite", "saturated", "stuck", "gaps", "blocks_lost")
#: Cells of a probability bar and of the bias's sparkline, at least and at most.
BAR, SPARK = (12, 30), (8, 40)
#: Of an axis's lines after the first.
INDENT = 2
#: Lines of the status, at most.
STATUS_LINES = 2
#: s without a byte after which contact is lost, and how often the longest interval that was seen has to pass.
SILENT_S, INTERVALS = 3.0, 3.0
#: s that a module may be silent before its second status has shown how often it speaks: it sends one every 10 s
#: (STATUS_MS in port/app/app.c), and a save takes up to 2 s.
FIRST_S = 12.0
BLOCKS = "▁▂▃▄▅▆▇█"


class Source(Protocol):
    """Where frames come from."""

    malformed: int
    closed: bool


class Contact:
    """When the module was heard last, by the host's clock (`clock`, s).

    Contact is lost after SILENT_S, or after three times the longest interval that lay between two frames in a row,
    whichever is longer. Intervals in which frames were lost tell nothing of how often the module speaks. Before its
    second status nothing tells: contact is then lost after FIRST_S.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since = clock()
        self._longest = 0.0
        self.ever = False
        self._paced = False

    def heard(self, *, in_a_row: bool, paced: bool) -> None:
        """Something came. `in_a_row`: a frame, and no other was lost before it. `paced`: a second status has come,
        more than SILENT_S of module time after the first."""
        self._paced = paced
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
        return self.silent_s > max(FIRST_S if self.waiting else SILENT_S, INTERVALS * self._longest)

    @property
    def waiting(self) -> bool:
        """Silent, and it is not known yet how often the module speaks."""
        return self.ever and not self._paced and self.silent_s > SILENT_S


class View:
    """The last report of each axis, the module's status and the frame counts, fitted to the terminal.

    A progress bar if `total_s` is known. What did not arrive of a report is shown as `?`, never as an older value, and
    what the module has no number for as `-`. A module that has started anew has reported nothing yet. With `contact`
    silence counts: reports age, and a module that is not heard is not shown as running. `axes`: those to show; default
    all.
    """

    def __init__(
        self,
        decoder: Decoder,
        source: Source,
        title: str,
        total_s: float | None = None,
        contact: Contact | None = None,
        axes: Sequence[str] = (),
    ) -> None:
        self._decoder = decoder
        self._source = source
        self._title = title
        self._total_s = total_s
        self._contact = contact
        self._axes = axes
        self._last: dict[str, tuple[AxisReport, deque[float]]] = {}  # with the last biases
        self._time_s = 0.0  # of the module, when it was looked at last
        self._console = Console(stderr=True)
        self._live = Live(get_renderable=self.renderable, console=self._console, refresh_per_second=4, transient=True)

    def show(self, reports: Sequence[AxisReport]) -> None:
        """Take new reports."""
        self._now()
        for report in reports:
            if not self._axes or report.axis in self._axes:
                _, trend = self._last.get(report.axis, (report, deque(maxlen=SPARK[1])))
                trend.append(report.value("bias_mean"))
                self._last[report.axis] = report, trend

    def __enter__(self) -> View:
        try:
            self._live.start()
        except BaseException:
            self._live.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def print_last(self) -> None:
        """Print what there is to see at the end, all axes whatever the window's height."""
        self._console.print(self.renderable(whole=True))

    def renderable(self, *, whole: bool = False) -> RenderableType:
        """What is to be seen now; unless `whole`, no higher than the terminal."""
        time_s = self._now()
        width = self._console.width
        title = Text.assemble((f"{self._title}   module time {time_s:.1f} s   ", "bold"), self._state())
        parts: list[RenderableType] = [_line(title)]
        if self._total_s is not None and not whole:
            done = round(min(1.0, time_s / self._total_s) * (width // 2))
            parts.append(Text.assemble(("━" * done, "green"), ("━" * (width // 2 - done), "dim")))
        parts += self._status(width)
        parts.append(_line(Text(frame_counts(self._decoder, self._source), "dim")))
        last = dict(self._last)  # Live asks from a thread of its own
        if last:
            laws = [
                law for law in NAMED if law in PLAIN or any(f"{law}_probability" in r.values for r, _ in last.values())
            ]
            parts.append(_line(_heading(laws, _bar_cells(laws, width))))
            blocks = self._blocks(last, laws, width)
            parts += _fitted(blocks, None if whole else self._console.height - len(parts))
        return Group(*parts)

    def _state(self) -> Text:
        """What the module is doing, as far as it is heard."""
        contact = self._contact
        said = {1.0: "running", 2.0: "finished"}.get(self._decoder.status.get("state", 0.0), "waiting for the module")
        if contact is not None and self._source.closed:
            return Text(f"port gone for {contact.silent_s:.0f} s, waiting for it", "bold red")
        if contact is not None and contact.lost and not self._decoder.finished:
            word = "lost contact: no word" if contact.ever else "no word"
            return Text(f"{word} for {contact.silent_s:.0f} s", "bold red")
        if contact is not None and contact.waiting and not self._decoder.finished:
            return Text(f"waiting: no word for {contact.silent_s:.0f} s, a status comes every 10 s", "yellow")
        end = contact is None and self._total_s is None and self._source.closed
        return Text(f"{said}, end of the log" if end else said, "bold")

    def _now(self) -> float:
        """Module time, s. If it goes back, the module has started anew and its reports of before are none any more."""
        time_s = self._decoder.time_ms / 1000.0
        if time_s < self._time_s:
            self._last.clear()
        self._time_s = time_s
        return time_s

    def _status(self, width: int) -> list[Text]:
        """What the status says that is not 0, by its signals' names (GUIDE.md, What the status says); trouble first."""
        said: list[Text] = []
        for name, value in self._decoder.status.items():
            if name not in UNTOLD and value != 0.0:
                text = status_text(name, value)
                trouble = TROUBLE.get(name) == text or name in ("sensor_fault", "axes_retired", "state_refused")
                said.insert(0 if trouble else len(said), Text(f"{name} {text}", "red" if trouble else "dim"))
        return _flow(said, width, 3)[:STATUS_LINES]

    def _blocks(
        self, last: Mapping[str, tuple[AxisReport, Sequence[float]]], laws: Sequence[str], width: int
    ) -> list[list[Text]]:
        """An axis's lines: the probabilities; bias, its course and N; what else there is."""
        cells = _bar_cells(laws, width)
        bias = {axis: _bias(report) for axis, (report, _) in last.items()}
        parameters = {axis: _parameters(report) for axis, (report, _) in last.items()}
        bias_width = max(map(len, bias.values()))
        spark = min(SPARK[1], width - INDENT - bias_width - 2 - max(len(texts[0]) for texts in parameters.values()))
        blocks = []
        for axis, (report, trend) in last.items():
            age_s = max(0.0, self._time_s - report.time_s)
            age_s += self._contact.silent_s if self._contact is not None else 0.0
            best = most_probable(report)
            head = Text(f"{axis:<5}{_number(report, 'count', '%.0f'):>8}")
            for law in laws:
                head.append("  ").append(_bar(report, law, cells), "bold green" if law == best else "")
            head.append(f"{age_s:.0f} s".rjust(7), "dim")
            course = Text(_spark(trend, report.value("bias_sd"), spark), "cyan") if spark >= SPARK[0] else ""
            chunks = [Text.assemble(bias[axis].ljust(bias_width), " ", course, " ", parameters[axis][0])]
            chunks += [Text(text) for text in parameters[axis][1:]]
            chunks += [Text(name, "red") for name in HEALTH if report.values.get(name)]
            blocks.append([_line(head), *_flow(chunks, width, 2, indent=INDENT)])
        return blocks


def frame_counts(decoder: Decoder, source: Source) -> str:
    """One line that says what became of the frames."""
    s = decoder.statistics
    return (
        f"frames: {s.received} received, {s.lost} lost; "
        f"{s.damaged} bad checksum, {s.refused} refused, {source.malformed} malformed"
    )


def most_probable(report: AxisReport) -> str | None:
    """The law with the greatest probability; None if one that did not arrive, or is no number, could be greater."""
    known = {law: report.values[f"{law}_probability"] for law in NAMED if f"{law}_probability" in report.values}
    if not known or not (report.complete or known.keys() >= set(PLAIN)):
        return None
    if len({math.isnan(probability) for probability in known.values()}) > 1:
        return None  # all of them NaN is a report outside the priors: the view says that
    return max(known, key=lambda law: known[law])


def _bar_cells(laws: Sequence[str], width: int) -> int:
    return min(BAR[1], max(BAR[0], (width - 20) // len(laws) - 8))


def _heading(laws: Sequence[str], cells: int) -> Text:
    named = "  ".join(f"{'P ' + SHORT[law]:<{6 + cells}}" for law in laws)
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


def _bias(report: AxisReport) -> str:
    mean, sd = _number(report, "bias_mean", "%.5g"), _number(report, "bias_sd", "%.2g")
    return f"bias {mean} ± {sd} {typeset(signal_unit(report.axis, 'bias_mean'))}"


def _bar(report: AxisReport, law: str, cells: int) -> str:
    probability = report.value(f"{law}_probability")
    if math.isnan(probability):
        return _number(report, f"{law}_probability", "").ljust(6 + cells)
    filled = round(min(1.0, max(0.0, probability)) * cells)
    return f"{probability:.3f} {'█' * filled}{'·' * (cells - filled)}"


def _spark(trend: Sequence[float], sd: float, cells: int) -> str:
    """The last biases, the newest at the right. The height spans what they span, two of their sd at least."""
    shown = list(trend)[-cells:]
    known = [value for value in shown if math.isfinite(value)]
    if not known:
        return " " * cells
    low, high = min(known), max(known)
    least = 2.0 * sd if math.isfinite(sd) else 0.0
    middle, span = (low + high) / 2.0, max(high - low, least) or 1.0
    heights = (
        " " if not math.isfinite(value) else BLOCKS[min(7, max(0, int(8.0 * ((value - middle) / span + 0.5))))]
        for value in shown
    )
    return "".join(heights).ljust(cells)


def _parameters(report: AxisReport) -> list[str]:
    """The most probable law's parameters, medians with their intervals; first N, or why there is none."""
    law = most_probable(report)
    if law is None:
        return ["most probable law: ? (not all probabilities came)"]
    if math.isnan(report.values[f"{law}_probability"]):
        return ["outside the priors"]
    said = []
    for parameter in NAMED[law].parameters:
        name, inverse = f"{law}_{parameter}", parameter == "alpha"  # as a time, like the table
        keys = ("median", "q95", "q05") if inverse else ("median", "q05", "q95")
        middle, low, high = (_number(report, f"{name}_{key}", "%.3g", inverse=inverse) for key in keys)
        label = "1/alpha" if inverse else parameter
        unit = "s" if inverse else typeset(signal_unit(report.axis, f"{name}_median"))
        said.append(f"{label} {middle} [{low}, {high}] {unit}")
    if any(int(report.values.get(f"{law}_{parameter}_flags", 0)) & OFF_GRID for parameter in NAMED[law].parameters):
        said.append("not borne by the grid of nodes")
    return said
