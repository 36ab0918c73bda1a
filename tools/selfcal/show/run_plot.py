"""The picture of a run: hypothesis probabilities and parameters against time (the form of the paper's Figs 5 and 6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.bank.axis_result import LAW_LEAST
from selfcal.base.errors import printable
from selfcal.base.grid import Array
from selfcal.base.units import factor, known, parameter_unit, same_kind, typeset
from selfcal.model.file import LARGEST
from selfcal.show.plots import COLORS, plotter, save_picture
from selfcal.wire.dbc_file import BY_PLACE, PLACE_NAMES, Names
from selfcal.wire.frames import AxisReport, axis_unit

#: Share of first reports that set no scale: their intervals are the prior's.
UNSCALED_SHARE = 0.2


def plot_run(
    history: Mapping[str, Sequence[AxisReport]],
    path: Path | str,
    title: str,
    truth: Mapping[str, Any] | None = None,
    units: Mapping[str, str] | None = None,
    names: Names = BY_PLACE,
    sent_in: Mapping[str, str] | None = None,
) -> None:
    """Save the picture of complete reports by axis; the suffix of `path` chooses the format. `names`: of hypotheses and
    parameters; each parameter has a panel.

    Lines are posterior medians, bands the 5 to 95 % intervals, on logarithmic scales, alike for axes of a unit; alpha
    as 1/alpha in s. Above each panel stands the last report's verdict, or the median and interval of its likeliest law.
    `units` of the axes' readings; default: telemetry's. `sent_in`: what the reports of axes of other names are in.
    `truth`, of a simulated recording: per axis its `hypothesis` and parameters, drawn dashed. Raises UserError if it
    cannot be written.
    """
    pyplot = plotter()
    from matplotlib.lines import Line2D

    axes = list(history)
    count = max((reports[-1].hypotheses or 0 for reports in history.values()), default=0)
    names = names if count <= len(names.hypotheses) else BY_PLACE
    hypotheses = names.hypotheses[:count]
    panels = _panels(history, names, count)
    own = {axis: (sent_in or {}).get(axis) or axis_unit(axis) for axis in axes}
    unit = {axis: (units or {}).get(axis, own[axis]) for axis in axes}
    rows = {name: [axis for axis in axes if unit[axis] == name] for name in unit.values()}
    spans: dict[tuple[str, str], list[float]] = {}  # what a panel's scale has to hold
    figure, grid = pyplot.subplots(
        len(axes),
        1 + len(panels),
        figsize=(3.8 * (1 + len(panels)), 2.3 * len(axes) + 1.4),
        squeeze=False,
        sharex=True,
        layout="constrained",
    )
    figure.suptitle(printable(title), parse_math=False)
    for row, axis in zip(grid, axes, strict=True):
        reports = history[axis]
        time = np.array([report.time_s for report in reports])
        axis_truth = (truth or {}).get(axis)
        newest = reports[-1].values
        last = {k: newest[f"h{k}_probability"] for k in range(count) if f"h{k}_probability" in newest}
        for k in last:
            row[0].plot(time, _values(reports, f"h{k}_probability"), color=COLORS[k], alpha=_opacity(last[k]))
        row[0].set_ylim(-0.03, 1.03)
        row[0].set_ylabel(axis, rotation=0, fontweight="bold", labelpad=15)
        _write(row[0], *_verdict(last, axis_truth, hypotheses))
        for panel, (parameter, candidates) in zip(row[1:], panels.items(), strict=True):
            scale = factor(own[axis], unit[axis]) if _scales(parameter) else 1.0
            spans[axis, parameter] = _draw(panel, time, reports, parameter, candidates, last, scale)
            value = _true(axis_truth, parameter, unit[axis])
            if value is not None:
                spans[axis, parameter].append(value)
                panel.axhline(value, color="black", linestyle="--", linewidth=1.0)
            panel.set_yscale("log")
            own_unit = "s" if parameter == "alpha" else parameter_unit(parameter, unit[axis])
            panel.set_ylabel("" if own_unit == "1" else typeset(own_unit))
            panel.grid(True, alpha=0.3)
        row[0].grid(True, alpha=0.3)
    for column, parameter in enumerate(panels, start=1):
        for group in rows.values():
            span = [value for axis in group for value in spans[axis, parameter] if math.isfinite(value) and value > 0.0]
            for axis in group if span else ():
                grid[axes.index(axis)][column].set_ylim(min(span) / 1.2, max(span) * 1.2)
    headings = ("P", *("1/alpha" if parameter == "alpha" else parameter for parameter in panels))
    for panel, heading in zip(grid[0], headings, strict=True):
        panel.set_title(heading, loc="left", fontweight="bold")
    handles = [Line2D([], [], color=COLORS[k], label=name.replace("_", " ")) for k, name in enumerate(hypotheses)]
    handles += [Line2D([], [], color="black", linestyle="--", label="truth")] if truth else []
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    for panel in grid[-1]:
        panel.set_xlabel("time, s")
    save_picture(figure, path, dpi=100)


def _opacity(probability: float) -> float:
    return 1.0 if probability >= LAW_LEAST else 0.2


def _draw(
    panel: Any,
    time: Array,
    reports: Sequence[AxisReport],
    parameter: str,
    candidates: Mapping[int, str],
    last: Mapping[int, float],
    scale: float,
) -> list[float]:
    """Draw a parameter's median and interval for each law that came; what the panel's scale has to hold. `last`: the
    probabilities at the end."""
    span: list[float] = []
    late, best = int(UNSCALED_SHARE * len(time)), -1
    for k, place in ((k, place) for k, place in candidates.items() if k in last):
        signals = (f"h{k}_{place}_{key}" for key in ("q05", "median", "q95"))
        low, middle, high = (_values(reports, signal) * scale for signal in signals)
        if parameter == "alpha":
            low, middle, high = 1.0 / high, 1.0 / middle, 1.0 / low
        opacity = _opacity(last[k])
        panel.fill_between(time, low, high, color=COLORS[k], alpha=0.25 * opacity, linewidth=0)
        panel.plot(time, middle, color=COLORS[k], alpha=opacity)
        if last[k] >= LAW_LEAST and math.isfinite(middle[-1]):
            span += [*low[late:], *high[late:]]
            if last[k] > last.get(best, 0.0):
                best = k
                _write(panel, f"{middle[-1]:.3g} [{low[-1]:.3g}, {high[-1]:.3g}]", COLORS[k])
        elif len(candidates) == 1:  # nothing else in this panel
            span += middle[late:].tolist()
    return span


def _panels(history: Mapping[str, Sequence[AxisReport]], names: Names, count: int) -> dict[str, dict[int, str]]:
    """The parameters, in the order in which the hypotheses have them; of each the hypotheses, with its place there."""
    panels: dict[str, dict[int, str]] = {}
    for k, parameters in enumerate(names.parameters[:count]):
        for place, parameter in zip(PLACE_NAMES, parameters, strict=False):
            if any(f"h{k}_{place}_median" in reports[-1].values for reports in history.values()):
                panels.setdefault(parameter, {})[k] = place
    return panels


def _scales(parameter: str) -> bool:
    """Whether a parameter is in the reading's unit, so that another unit changes its number."""
    return parameter_unit(parameter, "deg/s") not in ("1", "1/s", "")


def _values(reports: Sequence[AxisReport], signal: str) -> Array:
    return np.array([report.value(signal) for report in reports])


def _verdict(last: Mapping[int, float], truth: Any, hypotheses: Sequence[str]) -> tuple[str, str]:
    """The most probable hypothesis with its probability, the true hypothesis if known; and its colour."""
    finite = {k: probability for k, probability in last.items() if math.isfinite(probability)}
    if not finite:
        return "outside the priors", "black"
    best = max(finite, key=lambda k: finite[k])
    said = f"{hypotheses[best].replace('_', ' ')} {finite[best]:.3f}"
    if isinstance(truth, Mapping) and truth.get("hypothesis") in tuple(hypotheses):
        said += f" (truth: {truth['hypothesis'].replace('_', ' ')})"
    return said, COLORS[best]


def _true(truth: Any, parameter: str, unit: str) -> float | None:
    """A parameter's true value in the picture's unit; None if the recording states none that can be drawn."""
    if not isinstance(truth, Mapping):
        return None
    value = truth.get("N_with_lattice", truth.get("N")) if parameter == "N" else truth.get(parameter)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < LARGEST:
        return None
    if parameter == "alpha":
        return 1.0 / value
    stated = truth.get("unit", unit)
    if not _scales(parameter):
        return float(value)
    if not isinstance(stated, str) or not known(stated) or not same_kind(stated, unit):
        return None
    return float(value) * factor(stated, unit)


def _write(panel: Any, text: str, color: str) -> None:
    panel.set_title(text, loc="right", color=color, fontsize="small")
