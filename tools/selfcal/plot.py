"""The picture of a run: hypothesis probabilities and parameters against time (the form of the paper's Figs 5 and 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.errors import UserError, printable
from selfcal.model import LAWS
from selfcal.output import whole
from selfcal.wire import AxisReport, signal_unit

COLORS = {
    "constant": "tab:green",
    "random_walk": "tab:blue",
    "gauss_markov": "tab:red",
    "flicker": "tab:purple",
    "moving_average": "tab:orange",
    "walk_and_markov": "tab:olive",
}
#: Columns after the probabilities: parameter, and the laws whose estimates of it are drawn.
PANELS = {
    "N": ("random_walk", "gauss_markov"),
    "K": ("random_walk",),
    "sigma_m": ("gauss_markov",),
    "alpha": ("gauss_markov",),
}


def plot_run(
    history: Mapping[str, Sequence[AxisReport]], path: Path | str, title: str, truth: Mapping[str, Any] | None = None
) -> None:
    """Save the picture of complete reports by axis; the suffix of `path` chooses the format.

    Lines are posterior medians, bands the 5 to 95 % intervals, on logarithmic scales in the units of the telemetry.
    `truth`, of a simulated recording: per axis its `hypothesis` and parameters, drawn dashed. Raises UserError if it
    cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    axes = list(history)
    figure, grid = pyplot.subplots(
        len(axes),
        1 + len(PANELS),
        figsize=(19, 2.3 * len(axes) + 1.0),
        squeeze=False,
        sharex=True,
        layout="constrained",
    )
    figure.suptitle(printable(title), parse_math=False)
    for row, axis in zip(grid, axes, strict=True):
        reports = history[axis]
        time = np.array([report.time_s for report in reports])
        known = (truth or {}).get(axis, {})
        laws = [law for law in LAWS if f"{law}_probability" in reports[-1].values]
        for law in laws:
            row[0].plot(time, [r.value(f"{law}_probability") for r in reports], color=COLORS[law], label=law)
        row[0].set_ylim(-0.03, 1.03)
        row[0].set_ylabel(axis, rotation=0, fontweight="bold", labelpad=15)
        if "hypothesis" in known:
            row[0].text(0.98, 0.5, f"truth: {known['hypothesis']}", ha="right", va="center", transform=row[0].transAxes)
        for panel, (parameter, candidates) in zip(row[1:], PANELS.items(), strict=True):
            for law in (law for law in candidates if law in laws):
                name = f"{law}_{parameter}"
                low, middle, high = (
                    np.array([r.value(f"{name}_{key}") for r in reports]) for key in ("q05", "median", "q95")
                )
                panel.fill_between(time, low, high, color=COLORS[law], alpha=0.25, linewidth=0)
                panel.plot(time, middle, color=COLORS[law], label=law)
                panel.set_ylabel(signal_unit(axis, f"{name}_median"), fontsize="small")
            value = known.get("N_with_lattice", known.get("N")) if parameter == "N" else known.get(parameter)
            if value is not None:
                panel.axhline(value, color="black", linestyle="--", linewidth=1.0, label="truth")
            panel.set_yscale("log")
            panel.grid(True, alpha=0.3)
        row[0].grid(True, alpha=0.3)
    for panel, heading in zip(grid[0], ("P(hypothesis)", *PANELS), strict=True):
        panel.set_title(heading)
    grid[0][0].legend(fontsize="x-small", loc="best")
    grid[0][1].legend(fontsize="x-small", loc="best")
    for panel in grid[-1]:
        panel.set_xlabel("time, s")
    try:
        with whole(path) as temporary:
            figure.savefig(temporary, dpi=100)
    except ValueError as error:
        raise UserError(f"{path}: cannot save the plot: {error}") from error
    finally:
        pyplot.close(figure)
