"""The page of `selfcal fleet --report`: a file that loads nothing, at most 1 MB however many units there are."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from selfcal.base import units as unit_module
from selfcal.base.grid import Array
from selfcal.batch.batch_summary import Batch, group_lines, plain_interval, seen_from_words, unidentified_lines
from selfcal.batch.population import Population
from selfcal.show.chart import POINTS_MOST, Band, Curve, Figure, Panel, draw
from selfcal.show.page_template import render

#: Most of what the page shows: lines of a list, those not folded, units of the matrix, pictures.
MOST_LINES, OPEN_LINES, MOST_ROWS, MOST_PICTURES = 150, 15, 100, 48
#: Keys of the document that name devices: what to do, and what they are in a line.
KINDS = {
    "failed": ("Beyond a limit: set these aside", "beyond a limit, or with the cause asked for"),
    "unlike": ("Unlike the batch: look at these first", "unlike the batch"),
    "drifting": ("Drifting from recording to recording: measure these again, calibrate them more often", "drifting"),
    "not_judged": ("Not judged: record these again, or longer", "not judged"),
}
#: Limits of a chart of individuals and of a chart of moving ranges (n = 2), over the mean moving range.
INDIVIDUALS, RANGES = 2.66, 3.267


def fleet_html(document: Mapping[str, Any], batch: Batch, pages: Mapping[str, str]) -> str:
    """The page of the document `selfcal.fleet/1` and the batch that it is made of. `pages`: where the own page of a
    device is, from this page's folder on."""
    marked = _marked(batch)
    histograms = batch.populations[:MOST_PICTURES]
    paths = {name: units[-1].source.path for name, units in batch.devices.items()}
    values = {
        "document": document,
        "kinds": KINDS,
        "pages": pages,
        "commands": {name: f"selfcal diagnose {shlex.quote(path)} --report page.html" for name, path in paths.items()},
        "groups": list(group_lines(batch)),
        "populations": batch.populations,
        "plain": plain_interval,
        "seen_from": seen_from_words,
        "unidentified": list(unidentified_lines(batch)),
        "distributions": _drawn(_histogram(population, document["limits"]) for population in histograms),
        "charts": _control(batch),
        "devices": len(batch.devices),
        "marked": marked,
        "causes": sorted({cause for axes in marked.values() for cause in axes}),
    }
    values |= {"MOST_LINES": MOST_LINES, "OPEN_LINES": OPEN_LINES, "MOST_ROWS": MOST_ROWS}
    return str(render("fleet.html", **values))


def _drawn(figures: Iterable[Figure]) -> Markup:
    return Markup().join(map(draw, figures))


def _histogram(population: Population, limits: Sequence[Mapping[str, Any]]) -> Figure:
    """The distribution of a quantity, with the data sheet's `limits` that are on it."""
    measured = population.measured
    own = [limit for limit in limits if limit["unit"] != "1" and measured.name == "{axis}.{parameter}".format(**limit)]
    marks = sorted({limit["value"] * unit_module.factor(limit["unit"], measured.unit) for limit in own})
    y = measured.y
    reach = float(np.ptp(y)) or 1.0
    bins = int(np.clip(2.0 * y.size ** (1.0 / 3.0), 8, 60))
    edges = np.linspace(float(y.min()) - 0.02 * reach, float(y.max()) + 0.02 * reach, bins + 1)
    counts = np.histogram(y, edges)[0].astype(np.float64)
    centre, middle, spread = 0.5 * (edges[1:] + edges[:-1]), population.fit.middle.median, population.fit.spread.median
    sd = np.sqrt(spread**2 + float(np.median(measured.s)) ** 2)
    expected = (
        y.size * (edges[1] - edges[0]) / (sd * math.sqrt(2.0 * math.pi)) * np.exp(-0.5 * ((centre - middle) / sd) ** 2)
    )
    x = np.exp(centre) if measured.logarithm else centre
    panel = Panel(
        measured.name,
        unit_module.typeset(measured.unit),
        "units",
        [Curve("units", x, counts), Curve("population with the records' errors", x, expected, "fitted")],
        log_x=measured.logarithm,
        marks=[mark for mark in marks if mark > 0.0 or not measured.logarithm],
        stairs=True,
        marked="data sheet's limit",
    )
    return Figure(measured.name, f"{y.size} units, {len(population.unlike)} of them unlike the others.", [panel])


def _control(batch: Batch) -> Markup | None:
    """Control charts of N and of the bias in the order of the dates: individuals and moving ranges. None: no dates."""
    when = [units[-1].recorded_at for units in batch.devices.values()]
    figures: list[Figure] = []
    charts = [chart.measured for chart in batch.populations if chart.measured.name.endswith((".N", ".bias"))]
    for measured in charts[:MOST_PICTURES]:
        dated = sorted((when[device], k) for k, device in enumerate(measured.at.tolist()) if when[device])
        if len({date[:10] for date, _ in dated}) > 1:
            order = [k for _, k in dated]
            y = np.asarray(np.exp(measured.y[order]) if measured.logarithm else measured.y[order], np.float64)
            figures += _individuals(measured.name, unit_module.typeset(measured.unit), y)
    return _drawn(figures) if figures else None


def _individuals(name: str, unit: str, y: Array) -> list[Figure]:
    """Charts of individuals and of moving ranges, each on its own scale."""
    ranges: Array = np.concatenate([np.full(1, np.nan), np.abs(np.diff(y))])
    mean, mean_range = float(y.mean()), float(np.nanmean(ranges))
    far, wide = np.abs(y - mean) > INDIVIDUALS * mean_range, ranges > RANGES * mean_range
    every = max(1, math.ceil(y.size / POINTS_MOST))
    shown = np.arange(0, y.size, every)
    shown = np.union1d(shown, np.flatnonzero(far | wide)[:POINTS_MOST])
    x = np.asarray(shown + 1.0, np.float64)
    whole: Array = np.ones(shown.size)
    low, high = mean - INDIVIDUALS * mean_range, mean + INDIVIDUALS * mean_range
    charts = {"individuals": (y, low, high), "moving range": (ranges, 0.0, RANGES * mean_range)}
    panels = [
        Panel(
            f"{name}, {chart}",
            "unit in the order of the dates",
            unit,
            [Curve("units", x, values[shown], "dots")],
            [Band("limits by the moving range", x, least * whole, most * whole, "spread")],
        )
        for chart, (values, least, most) in charts.items()
    ]
    thinned = f" One in {every} is shown, and each beyond the limits." if every > 1 else ""
    return [
        Figure(
            f"{name} by date", f"{np.count_nonzero(far)} of {y.size} units lie beyond the limits.{thinned}", panels[:1]
        ),
        Figure(f"{name}, moving range", f"{np.count_nonzero(wide)} ranges lie beyond the limits.{thinned}", panels[1:]),
    ]


def _marked(batch: Batch) -> dict[str, dict[str, list[str]]]:
    """Axes with a cause or a mark, by device and cause; in brackets those whose cause is small."""
    marked: dict[str, dict[str, list[str]]] = {}
    for name, units in batch.devices.items():
        for unit in units:
            for axis, entry in unit.axes.items():
                for cause in dict.fromkeys([*unit.causes(axis), *entry.get("marks", [])]):
                    axes = marked.setdefault(name, {}).setdefault(cause, [])
                    label = f"({axis})" if cause in unit.small(axis) else axis
                    axes += [] if label in axes else [label]
    return marked
