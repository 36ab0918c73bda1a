"""The page of `selfcal compare --report`: what changed, every quantity by recording, and the Allan deviations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from selfcal.base.errors import short
from selfcal.base.units import typeset
from selfcal.show.chart import Band, Curve, Figure, Panel, draw
from selfcal.show.page_template import render

#: Allan deviations by axis and recording: the key `allan` of `selfcal.identify/1`.
Curves = Mapping[str, Mapping[str, Mapping[str, Any]]]


def comparison_html(document: Mapping[str, Any], curves: Curves) -> str:
    """The page of a document `selfcal.compare/1`."""
    names = short_names(document)
    axes = [_axis(name, entry, document, curves.get(name, {}), names) for name, entry in document["axes"].items()]
    title = f"Comparison of {' and '.join(names.values())}"
    one_in = round(1.0 / math.erfc(document["limit_sd"] / math.sqrt(2.0)))
    values = {"document": document, "title": title, "names": names, "axes": axes, "changes": told_of(document)}
    return str(render("comparison.html", **values, one_in=one_in))


@dataclass(frozen=True)
class Told:
    """A line of the changes: a `change`, or a cause that appeared or is gone on several axes: all of it."""

    changes: list[tuple[str, Mapping[str, Any]]]

    @property
    def change(self) -> Mapping[str, Any]:
        return self.changes[0][1]

    @property
    def axes(self) -> str:
        return " ".join(name for name, _ in self.changes)

    @property
    def unit(self) -> str:
        """The unit of all axes; empty where they differ, or nothing has a unit."""
        units = {change.get("unit", "") for _, change in self.changes}
        return str(units.pop()) if len(units) == 1 else ""

    def side(self, side: str, absent: str) -> str:
        """The value `before` or `after`, of each axis: what it lies below where it is not identified; and without a
        number whether it was found."""
        if (below := self.change.get(f"{side}_below")) is not None:
            return f"< {below:.5g}"
        sizes = [change.get(side) for _, change in self.changes]
        if None in sizes:
            return "found" if (self.change["what"] == "appeared") == (side == "after") else absent
        digits = 5 if self.change["what"] == "changed" else 3
        units = ["" if self.unit else f" {change['unit']}" for _, change in self.changes]
        return ", ".join(f"{size:.{digits}g}{unit}" for size, unit in zip(sizes, units, strict=True))


def short_names(document: Mapping[str, Any]) -> dict[str, str]:
    """The recordings by their file names; by whole paths where two names are equal."""
    logs = document["recordings"]
    short = [Path(log).name for log in logs]
    return dict(zip(logs, short if len(set(short)) == len(short) else logs, strict=True))


def told_of(document: Mapping[str, Any]) -> dict[tuple[str, str], list[Told]]:
    """By pair of recordings the lines of all axes: causes that appeared or are gone, on all their axes; then numbers by
    their distance."""
    lines = {}
    for pair in pairwise(document["recordings"]):
        causes: dict[tuple[str, str], list[tuple[str, Mapping[str, Any]]]] = {}
        far: list[tuple[str, Mapping[str, Any]]] = []
        for name, entry in document["axes"].items():
            for change in entry["changes"] if isinstance(entry, Mapping) else entry:
                if (change["from"], change["to"]) == pair:
                    kind = change["quantity"], change["what"]
                    (far if kind[1] == "changed" else causes.setdefault(kind, [])).append((name, change))
        far.sort(key=lambda row: -abs(row[1]["distance_sd"]))
        lines[pair] = [*map(Told, causes.values()), *(Told([row]) for row in far)]
    return lines


@dataclass(frozen=True)
class _Axis:
    """An axis: its changes, or the error why it is not compared, its quantities in each recording, and the picture."""

    name: str
    error: str
    changes: Sequence[Mapping[str, Any]]
    by_recording: Sequence[Mapping[str, Any]]
    curves: Markup

    @property
    def quantities(self) -> list[str]:
        return list(dict.fromkeys(key for quantities in self.by_recording for key in quantities))

    @property
    def changed(self) -> set[str]:
        return {change["quantity"] for change in self.changes}


def _axis(
    name: str,
    entry: Any,
    document: Mapping[str, Any],
    curves: Mapping[str, Mapping[str, Any]],
    names: Mapping[str, str],
) -> _Axis:
    compared = not isinstance(entry, Mapping)
    quantities = [document["quantities"].get(log, {}).get(name, {}) for log in names]
    changes = entry if compared else entry["changes"]
    return _Axis(name, "" if compared else entry["error"], changes, quantities, _deviations(name, curves, names))


def _deviations(name: str, curves: Mapping[str, Mapping[str, Any]], names: Mapping[str, str]) -> Markup:
    """The Allan deviations of an axis on a common scale; nothing where their units differ."""
    panels = []
    for log, stated in curves.items():
        tau, measured, low, high = (np.array(stated[key]) for key in ("tau_s", "recording", "model_q05", "model_q95"))
        title = short(names[log], 22)
        curve, band = Curve("recording", tau, measured), Band("law, 5 to 95 %", tau, low, high)
        unit = f"deviation, {typeset(stated['unit'])}"
        if tau.size > 1:
            panels.append(Panel(title, "averaging time, s", unit, [curve], [band], log_x=True, log_y=True))
    if len({panel.y_label for panel in panels}) != 1:
        return Markup()
    caption = "Each recording's Allan deviation beside the band of its likeliest law, all on one scale."
    return draw(Figure(f"Allan deviation of {name}", caption, panels))
