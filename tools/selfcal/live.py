"""The live view of a module's telemetry, for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import TracebackType

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from selfcal.model import LAWS, SUMS
from selfcal.wire import OFF_GRID, AxisReport, Decoder, Link, signal_unit, status_text

SHORT = {
    "constant": "const",
    "random_walk": "r.walk",
    "gauss_markov": "G-M",
    "flicker": "flicker",
    "moving_average": "r.w.+MA",
    "walk_and_markov": "r.w.+G-M",
}
#: Of the status, what is told elsewhere or to programs alone.
UNTOLD = ("time_ms", "wire_version", "model_id", "bank_interval", "bank_block", "state", "report", "frames_sent")
#: What the user has to do something about.
TROUBLE = {"sensor_state": "failed", "clock": "internal", "state_found": "refused"}
HEALTH = ("not_finite", "saturated", "stuck", "gaps", "blocks_lost")
BAR = 6  # characters of a probability bar
WIDE = 110  # columns of a terminal with room for the bars
NEW_LINE = "\n"


class View:
    """The last report of each axis, with its bank samples under its name, the module's status and the frame counts.

    A progress bar if `total_s` is known. What did not arrive of a report is shown as `?`, never as an older value, and
    what the module has no number for as `-`. A module that has started anew has reported nothing yet.
    """

    def __init__(self, decoder: Decoder, link: Link, title: str, total_s: float | None = None) -> None:
        self._decoder = decoder
        self._link = link
        self._title = title
        self._total_s = total_s
        self._last: dict[str, AxisReport] = {}
        self._time_s = 0.0  # of the module, when it was looked at last
        self._console = Console(stderr=True)
        self._live = Live(get_renderable=self.renderable, console=self._console, refresh_per_second=4, transient=True)

    def show(self, reports: Sequence[AxisReport]) -> None:
        """Take new reports."""
        self._now()
        for report in reports:
            self._last[report.axis] = report

    def __enter__(self) -> View:
        self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def renderable(self) -> RenderableType:
        """What is to be seen now."""
        time_s = self._now()
        state = {1.0: "running", 2.0: "finished"}.get(self._decoder.status.get("state", 0.0), "waiting for the module")
        parts: list[RenderableType] = [Text(f"{self._title}   module time {time_s:.1f} s   {state}", "bold")]
        if self._total_s is not None:
            parts.append(ProgressBar(self._total_s, min(time_s, self._total_s), width=WIDE // 2))
            parts.append(Text())
        parts += [self._status(), self._table(), Text(frame_counts(self._decoder, self._link), "dim")]
        return Group(*parts)

    def _now(self) -> float:
        """Module time, s. If it goes back, the module has started anew and its reports of before are none any more."""
        time_s = self._decoder.time_ms / 1000.0
        if time_s < self._time_s:
            self._last.clear()
        self._time_s = time_s
        return time_s

    def _status(self) -> Text:
        """What the status says that is not 0, by its signals' names (GUIDE.md, What the status says)."""
        said = Text()
        for name, value in self._decoder.status.items():
            if name not in UNTOLD and value != 0.0:
                text = status_text(name, value)
                trouble = TROUBLE.get(name) == text or name in ("sensor_fault", "axes_retired", "state_refused")
                said.append(f"{name} {text}   ", "red" if trouble else "dim")
        return said

    def _table(self) -> Table:
        wide = self._console.width >= WIDE
        table = Table(box=None, pad_edge=False, padding=(0, 2 if wide else 1, 0, 0))
        table.add_column("axis", no_wrap=True)
        seen = {name for report in self._last.values() for name in report.values}
        laws = [law for law in LAWS if law not in SUMS or f"{law}_probability" in seen]
        for law in laws:
            table.add_column(f"P {SHORT[law]}" if wide else SHORT[law], no_wrap=True)
        table.add_column("most probable law: median [5 %, 95 %]", no_wrap=True)
        table.add_column("bias now")
        for axis, report in self._last.items():
            health = " ".join(name for name in HEALTH if report.values.get(name))
            mean, sd = _number(report, "bias_mean", "%.5g"), _number(report, "bias_sd", "%.2g")
            age = f"{NEW_LINE}{max(0.0, self._time_s - report.time_s):.0f} s ago "
            bias = f"{mean}{' ' if wide else NEW_LINE}± {sd} {signal_unit(axis, 'bias_mean')}"
            table.add_row(
                f"{axis}{NEW_LINE}{_number(report, 'count', '%.0f')}",
                *(_bar(report, f"{law}_probability", wide) for law in laws),
                _parameters(report),
                Text.assemble(bias, (age, "dim"), (health, "red")),
            )
        return table


def frame_counts(decoder: Decoder, link: Link) -> str:
    """One line that says what became of the frames."""
    s = decoder.statistics
    return (
        f"frames: {s.received} received, {s.lost} lost; arrived damaged: {s.damaged} bad checksum, "
        f"{s.refused} refused, {link.malformed} malformed lines"
    )


def most_probable(report: AxisReport) -> str | None:
    """The law with the greatest probability, if all of the model's arrived."""
    known = {law: report.values[f"{law}_probability"] for law in LAWS if f"{law}_probability" in report.values}
    return max(known, key=lambda law: known[law]) if known else None


def _number(report: AxisReport, signal: str, form: str) -> str:
    value = report.values.get(signal)
    return "?" if value is None else "-" if math.isnan(value) else form % value


def _bar(report: AxisReport, signal: str, wide: bool) -> Text:
    probability = report.value(signal)
    if math.isnan(probability):
        return Text(_number(report, signal, ""))
    filled = round(probability * BAR)
    bar = f" {'█' * filled}{'·' * (BAR - filled)}" if wide else ""
    return Text(f"{probability:.3f}{bar}", "bold" if probability >= 0.5 else "")


def _parameters(report: AxisReport) -> str:
    law = most_probable(report)
    if law is None:
        return "?"
    if math.isnan(report.values[f"{law}_probability"]):
        return "outside the priors"
    rows = []
    for parameter in LAWS[law]:
        name = f"{law}_{parameter}"
        middle, low, high = (_number(report, f"{name}_{key}", "%.3g") for key in ("median", "q05", "q95"))
        unit = signal_unit(report.axis, f"{name}_median").replace("sqrt(Hz)", "√Hz")
        rows.append(f"{parameter} {middle} \\[{low}, {high}] {unit}")
    if any(int(report.values.get(f"{law}_{parameter}_flags", 0)) & OFF_GRID for parameter in LAWS[law]):
        rows.append("not borne by the grid of nodes")
    return "\n".join(rows)
