"""The picture of `identify --plot`: each axis's Allan deviation with the model's, and where they differ."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.adequacy.overbound import upper_limit
from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.show.plots import log_log, name_of, plotter, save_picture

#: Colours of the model and of points outside it.
MODEL, OUTSIDE = "tab:blue", "tab:red"


def plot_allan(document: Mapping[str, Any], path: Path | str, *, datasheet: bool = False) -> None:
    """Save the picture of an answer of `identify`; the suffix of `path` chooses the format. Raises UserError if the
    file cannot be written."""
    save_picture(figure_of(document, datasheet=datasheet), path, dpi=110)


def figure_of(document: Mapping[str, Any], *, datasheet: bool = False) -> Any:
    """The figure of an answer of `identify`.

    Black: the overlapping Allan deviation of the recording's samples with its 90 % interval, of its bank's means where
    the answer was not made for a picture. In blue: the most
    probable law at its medians, the band of its posterior (5 to 95 %), and, pale, where the recording may lie.
    Averaging times outside are red. Raises UserError for an answer without an Allan deviation.
    """
    pyplot = plotter()
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    axes = {name: axis for name, axis in document["axes"].items() if axis.get("allan") and axis["allan"]["tau_s"]}
    if not axes:
        raise UserError(f"{document['recording']['path']}: too short for an Allan deviation: nothing to plot")
    columns = min(3, len(axes))
    rows = math.ceil(len(axes) / columns)
    figure, grid = pyplot.subplots(
        rows, columns, figsize=(max(5.6 * columns, 8.0), 4.3 * rows + 1.1), squeeze=False, layout="constrained"
    )
    outside = [name for name, axis in axes.items() if not axis["adequate"]]
    recording = document["recording"]
    verdict = f"not adequate: {', '.join(outside)}" if outside else "every axis is adequate"
    figure.suptitle(
        f"{name_of(recording)}, {recording['rate_hz']:g} Hz, {recording['duration_s']:g} s: {verdict}",
        fontweight="bold",
        color=OUTSIDE if outside else "black",
        parse_math=False,
    )
    for panel in grid.flat[len(axes) :]:
        panel.set_visible(False)
    for panel, (name, axis) in zip(grid.flat, axes.items(), strict=False):
        _panel(panel, name, axis, datasheet)
    _share_scales(list(grid.flat[: len(axes)]))
    handles = [
        Line2D([], [], color="black", marker="o", markersize=4, label="recording, 90 % interval"),
        Line2D([], [], color=MODEL, linewidth=5, alpha=0.6, label="most probable law, its posterior 5 to 95 %"),
        Patch(color=MODEL, alpha=0.15, label="where the recording may lie"),
        Line2D([], [], color=OUTSIDE, marker="o", markersize=9, fillstyle="none", linestyle="", label="outside"),
    ]
    # Four in a row are wider than the picture of an axis.
    figure.legend(handles=handles, loc="outside lower center", ncols=4 if columns > 1 else 2, frameon=False)
    return figure


def _panel(panel: Any, name: str, axis: Mapping[str, Any], datasheet: bool) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    allan = axis["allan"]
    samples = allan.get("samples") or _of_means(allan)
    unit = units.datasheet_unit("bias", allan["unit"]) if datasheet else allan["unit"]
    factor = units.factor(allan["unit"], unit)

    def scaled(of: Mapping[str, Any], key: str) -> Any:
        return factor * np.array(of[key], float)

    tau = np.array(allan["tau_s"])
    panel.fill_between(
        tau, scaled(allan, "adequate_from"), scaled(allan, "adequate_to"), color=MODEL, alpha=0.15, linewidth=0
    )
    panel.fill_between(tau, scaled(allan, "model_q05"), scaled(allan, "model_q95"), color=MODEL, alpha=0.4, linewidth=0)
    panel.plot(tau, scaled(allan, "model"), color=MODEL, linewidth=2)
    curve = scaled(samples, "deviation")
    error = [curve - scaled(samples, "q05"), scaled(samples, "q95") - curve]
    panel.errorbar(
        samples["tau_s"], curve, error, color="black", marker="o", markersize=3.5, linewidth=1, elinewidth=1, capsize=2
    )
    log_log(panel)
    heights = np.concatenate([curve, scaled(allan, "model")])
    panel.set_ylim(0.4 * heights.min(), 1.5 * heights.max())
    if samples["tau_s"][0] < 0.99 * tau[0]:
        left = samples["tau_s"][0] / 1.5
        panel.axvspan(left, tau[0] / 2**0.5, color="0.92", zorder=0)
        panel.set_xlim(left=left)
        panel.text(
            math.sqrt(left * tau[0] / 2**0.5), 0.03, "not modelled", color="0.4", fontsize="small", ha="center",
            transform=panel.get_xaxis_transform(),
        )  # fmt: skip
    failed = {
        float(check.removeprefix("allan_").removesuffix("s")): outcome
        for check, outcome in axis["checks"].items()
        if check.startswith("allan_") and not outcome["passed"]
    }
    nearest = [int(np.argmin(np.abs(np.log(tau / tau_s)))) for tau_s in failed]
    recorded = scaled(allan, "recording")
    panel.plot(
        tau[nearest], recorded[nearest], color=OUTSIDE, marker="o", markersize=10, fillstyle="none", linestyle=""
    )
    panel.set_title(f"{name}: {'adequate' if axis['adequate'] else 'NOT ADEQUATE'}", loc="left", fontweight="bold",
                    color="black" if axis["adequate"] else OUTSIDE)  # fmt: skip
    likely = sorted(axis["hypotheses"].items(), key=lambda entry: -entry[1])
    lines = [(f"{law}  P {probability:.3f}", MODEL if rank == 0 else "0.4") for rank, (law, probability) in
             enumerate(likely[:4])]  # fmt: skip
    if failed:
        lines.append(("model over recording:", OUTSIDE))
        named = [f"{tau_s:g} s {100.0 * outcome['value']:+.0f} %" for tau_s, outcome in failed.items()]
        lines += [(",  ".join(named[k : k + 3]), OUTSIDE) for k in range(0, len(named), 3)]
    others = [check for check, outcome in axis["checks"].items() if not outcome["passed"] and "allan" not in check]
    lines += [(check, OUTSIDE) for check in others]
    for row, (text, color) in enumerate(lines):
        panel.text(0.97, 0.97 - 0.055 * row, text, color=color, ha="right", va="top", fontsize="x-small",
                   fontweight="bold" if row == 0 else "normal", transform=panel.transAxes)  # fmt: skip
    panel.set_xlabel("averaging time τ, s")
    panel.set_ylabel(f"Allan deviation, {units.typeset(unit)}")
    panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.yaxis.set_minor_formatter(NullFormatter())


def _of_means(allan: Mapping[str, Any]) -> dict[str, Any]:
    """The Allan deviation of the bank's means, with its 90 % interval by chi-squared."""
    freedom, curve = np.array(allan["degrees_of_freedom"]), np.array(allan["recording"])
    q05, q95 = (upper_limit(curve, freedom, level) for level in (0.05, 0.95))
    return {"tau_s": allan["tau_s"], "deviation": curve, "q05": q05, "q95": q95}


def _share_scales(panels: list[Any]) -> None:
    """A common scale for all panels of a unit, with room for the text above the curves."""
    for label in {panel.get_ylabel() for panel in panels}:
        same = [panel for panel in panels if panel.get_ylabel() == label]
        low, high = (choose(panel.get_ylim()[end] for panel in same) for end, choose in ((0, min), (1, max)))
        for panel in same:
            panel.set_ylim(low, high * (high / low) ** 0.2)
