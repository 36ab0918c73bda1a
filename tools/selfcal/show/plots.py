"""Pictures by matplotlib: what every one takes, and those of `response`, `plan` and `tumble`."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.bank.axis_result import HALF_90
from selfcal.base import units
from selfcal.base.errors import UserError, printable
from selfcal.base.output import whole
from selfcal.base.units import STANDARD_GRAVITY
from selfcal.calibration.tumble_document import side_up
from selfcal.model.regressors import coefficient_unit

#: Colours of laws, in the model's order.
COLORS = ("tab:green", "tab:blue", "tab:red", "tab:purple", "tab:orange", "tab:olive", "tab:brown", "tab:cyan")


def plotter() -> Any:
    """matplotlib's pyplot, without a screen. Its settings are the user's own: those of the folder that the user is in,
    where files of strangers may lie, would be taken first."""
    with contextlib.chdir("/"):
        import matplotlib
    if "matplotlib.pyplot" not in sys.modules and not os.environ.get("MPLBACKEND", "").startswith("module:"):
        matplotlib.use("Agg")  # a notebook has its own
    from matplotlib import pyplot

    return pyplot


def png_of(figure: Any, dpi: int) -> bytes:
    """A figure as PNG; it is closed."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi)
    plotter().close(figure)
    return stream.getvalue()


def save_picture(figure: Any, path: Path | str, dpi: int) -> None:
    """Write a figure whole or not at all, and close it. Raises UserError where it cannot be saved."""
    try:
        with whole(path) as temporary:
            figure.savefig(temporary, dpi=dpi)
    except ValueError as error:
        raise UserError(f"{path}: cannot save the plot: {error}") from error
    finally:
        plotter().close(figure)


def name_of(recording: Mapping[str, Any]) -> str:
    """The file name of a document's recording."""
    return printable(Path(recording["path"]).name)


def log_log(panel: Any) -> None:
    """Logarithmic scales, with a grid."""
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.grid(True, which="major", alpha=0.3)


def plot_response(document: Mapping[str, Any], path: Path | str) -> None:
    """Save gain, phase and coherence over frequency. Raises UserError if the file cannot be written."""
    figure, (gain, phase, coherence) = plotter().subplots(
        3, 1, figsize=(8.0, 8.6), sharex=True, layout="constrained", height_ratios=(3, 3, 2)
    )
    column, axis = document["input"], document["output"]
    found = document["structure"] if "estimate" in document else "no structure"
    found = found if document["influence"] else "no influence"
    figure.suptitle(
        f"{name_of(document['recording'])}: {column['column']} -> {axis['axis']}, {found}\n"
        f"source: {document['source']['verdict']}",
        parse_math=False,
    )
    seen = {key: np.array(values) for key, values in document["empirical"].items()}
    clear = seen["coherence"] > seen["coherence_by_chance"]
    for panel, key in ((gain, "gain"), (phase, "phase_deg")):
        for which, color, label in ((clear, "black", "ratio of spectra, 90 %"), (~clear, "0.75", "... by chance")):
            error = [seen[key] - seen[f"{key}_q05"], seen[f"{key}_q95"] - seen[key]]
            shown = [np.where(which, values, np.nan) for values in (seen[key], *error)]
            panel.errorbar(
                seen["frequency_hz"], shown[0], shown[1:], color=color, marker="o", markersize=3.5, linestyle="",
                elinewidth=1, label=label,
            )  # fmt: skip
        if band := document.get("frequency_response"):
            at = band["frequency_hz"]
            panel.fill_between(at, band[f"{key}_q05"], band[f"{key}_q95"], color="tab:blue", alpha=0.3, linewidth=0)
            panel.plot(at, band[key], color="tab:blue", label=f"{document['structure']}, 90 %")
        panel.grid(True, alpha=0.3)
    gain.set_xscale("log")
    gain.set_yscale("log")
    if clear.any():
        gain.set_ylim(bottom=0.2 * float(seen["gain"][clear].min()))
    gain.set_ylabel(f"gain, {units.typeset(coefficient_unit(axis['unit'], column['unit']))}")
    gain.legend(fontsize="small", frameon=False)
    phase.set_ylabel("phase, degrees")
    coherence.plot(seen["frequency_hz"], seen["coherence"], color="black", marker="o", markersize=3.5)
    coherence.plot(seen["frequency_hz"], seen["coherence_by_chance"], color="0.6", linestyle="--", label="by chance")
    coherence.set_ylim(0.0, 1.02)
    coherence.set_ylabel("coherence")
    coherence.set_xlabel("frequency, Hz")
    coherence.legend(fontsize="small", frameon=False)
    coherence.grid(True, alpha=0.3)
    save_picture(figure, path, dpi=110)


def plot_plan(document: Mapping[str, Any], path: Path | str) -> None:
    """Draw the metrics over the length: median and middle four fifths of the records, and the wish."""
    wishes = [wish for wish in document["wishes"] if wish["curve"]]
    size = (7.0, 2.9 * len(wishes))
    figure, panels = plotter().subplots(len(wishes), 1, figsize=size, squeeze=False, sharex=True)
    for panel, wish, color in zip(panels[:, 0], wishes, COLORS * len(wishes), strict=False):
        hours = np.array([point["duration_s"] for point in wish["curve"]]) / 3600.0
        q10, q50, q90 = (np.maximum([point[key] for point in wish["curve"]], 1e-6) for key in ("q10", "q50", "q90"))
        panel.fill_between(hours, q10, q90, color=color, alpha=0.25, linewidth=0.0, label="four records of five")
        panel.plot(hours, q50, color=color, label="median")
        panel.axhline(wish["most"], color="black", linewidth=1.0, linestyle="--", label="wanted")
        if wish["duration_s"] is not None:
            panel.axvline(wish["duration_s"] / 3600.0, color="black", linewidth=1.0, linestyle=":", label="planned")
        log_log(panel)
        law = wish["wish"].startswith("law")
        panel.set_ylabel("1 - P of the true law" if law else "half the 90 % interval")
        panel.set_title(wish["wish"], loc="left", fontweight="bold")
        panel.legend(fontsize="x-small")
    panels[-1, 0].set_xlabel("length of the recording, h")
    figure.tight_layout()
    save_picture(figure, path, dpi=110)


def plot_tumble(document: Mapping[str, Any], path: Path | str) -> None:
    """Save the residuals of |f| by rest, with the sd of each."""
    figure, axes = plotter().subplots(figsize=(8.0, 4.2), layout="constrained")
    rests = document["rests"]
    micro = 1e6 / STANDARD_GRAVITY
    places = np.arange(len(rests))
    residual, sd = (micro * np.array([rest[key] for rest in rests]) for key in ("residual", "sd"))
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.errorbar(places, residual, HALF_90 * sd, fmt="o", markersize=4, capsize=3, linewidth=1)
    axes.set_xticks(places, [side_up(np.array(rest["up"])) for rest in rests], rotation=60, fontsize=8)
    axes.set_xlabel("side that is up, rest by rest")
    axes.set_ylabel("|f| - g, ug")
    axes.set_title(
        f"{name_of(document['recordings'][0])}: residuals, bars hold 90 % of the noise", fontsize=10, parse_math=False
    )
    save_picture(figure, path, 150)
