"""The table of `identify` and `replay`: what a person reads of the document `selfcal.identify/1`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from selfcal.model import LAWS, RATIOS, SUMS

#: The table never folds its numbers: a narrower terminal wraps its lines.
TABLE_WIDTH = 140
#: Laws of smaller probability are not spoken of where the grid does not bear them.
TOLD_OF = 0.01


def show(document: Mapping[str, Any]) -> None:
    """The table a person reads: per axis the laws, their probabilities and parameters, and the bias."""
    recording = document["recording"]
    table = Table(
        box=box.SIMPLE_HEAD,
        title=f"{recording['path']}: {recording['samples']} samples, {recording['rate_hz']:g} Hz, "
        f"{recording['duration_s']:g} s",
        title_justify="left",
        caption="medians [5 %, 95 %] in the units of the recording; ~: this record does not identify it",
        caption_justify="left",
    )
    laws = {law for axis in document["axes"].values() for law in axis["hypotheses"]}
    drift = "K or sigma_m" if "flicker" not in laws else "K, sigma_m or B"
    second = "1/alpha, s" + (", or ratio" if laws & {law for law in SUMS if LAWS[law][2] in RATIOS} else "")
    for heading in ("law", "P", "N", drift, second):
        table.add_column(heading, no_wrap=True)
    failed: list[str] = []
    kept: list[str] = []
    for name, axis in document["axes"].items():
        best = max(axis["hypotheses"], key=lambda law: axis["hypotheses"][law])
        bias = axis["bias_now"]
        level = f"bias {bias['mean']:.6g} ± {bias['sd']:.2g}"
        table.add_row(f"{name} \\[{bias['unit']}]", "", level, "", "", style="cyan")
        for law, probability in axis["hypotheses"].items():
            parameters = axis["parameters"][law]
            table.add_row(
                law,
                f"{probability:.4f}",
                _interval(parameters["N"]),
                _interval(_first(parameters, ("K", "sigma_m", "B"))),
                _interval(parameters.get("alpha"), inverse=True) or _interval(_first(parameters, RATIOS)),
                style="bold" if law == best else None,
                end_section=law == list(axis["hypotheses"])[-1],
            )
        coarse = [
            law
            for law, parameters in axis["parameters"].items()
            if axis["hypotheses"][law] >= TOLD_OF and any(e["off_grid"] for e in parameters.values())
        ]
        if coarse:
            failed.append(f"not borne by the grid of nodes: {name}: {', '.join(coarse)}")
        counts = [f"{count} {what}" for what, count in axis.get("samples_kept_out", {}).items() if count]
        if counts:
            kept.append(f"kept out: {name}: {', '.join(counts)}")
        for check, outcome in axis["checks"].items():
            if not outcome["passed"]:
                failed.append(f"not adequate: {name}: {check} {outcome['value']:+.3f}, beyond ±{outcome['limit']:.3f}")
    console = Console()
    console.width = max(console.width, TABLE_WIDTH)
    console.print(table)
    if any("regressors" in axis for axis in document["axes"].values()):
        console.print(_regressor_table(document))
    for line in (*kept, *failed):
        console.print(line, highlight=False)


def _regressor_table(document: Mapping[str, Any]) -> Table:
    table = Table(
        box=box.SIMPLE_HEAD,
        caption="coefficients if in use: medians [5 %, 95 %]; the laws' parameters are those of each law's best subset",
        caption_justify="left",
    )
    for heading in ("axis", "regressor", "P(in use)", "coefficient", "unit"):
        table.add_column(heading, no_wrap=True)
    for name, axis in document["axes"].items():
        entries = list(axis.get("regressors", {}).items())
        for regressor, entry in entries:
            for column, c in entry["coefficients"].items():
                table.add_row(
                    name,
                    column,
                    f"{entry['probability']:.4f}",
                    "-" if not math.isfinite(c["median"]) else f"{c['median']:.4g} \\[{c['q05']:.4g}, {c['q95']:.4g}]",
                    c["unit"],
                    style="bold" if regressor in axis["regressors_in_use"] else None,
                    end_section=(regressor, entry) == entries[-1],
                )
    return table


def _first(parameters: Mapping[str, Any], names: Sequence[str]) -> Mapping[str, Any] | None:
    return next((parameters[name] for name in names if name in parameters), None)


def _interval(estimate: Mapping[str, Any] | None, *, inverse: bool = False) -> str:
    if estimate is None:
        return ""
    low, middle, high = estimate["q05"], estimate["median"], estimate["q95"]
    if not math.isfinite(middle):
        return "-"
    if inverse:
        low, middle, high = 1.0 / high, 1.0 / middle, 1.0 / low
    mark = "" if estimate["identified"] else "~"
    return f"{mark}{middle:.3g} \\[{low:.3g}, {high:.3g}]"
