"""The page of `selfcal fleet --report`: one file that loads nothing, at most 1 MB however many units there are."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from selfcal.base import units as unit_module
from selfcal.base.errors import printable
from selfcal.base.output import write_text
from selfcal.batch.population import Array, Population
from selfcal.batch.summary import Batch, group_lines, plain, seen_from_words, unidentified_lines
from selfcal.show.chart import Band, Curve, Figure, Panel, draw, number, scrolled
from selfcal.show.page import frame

#: At most: lines of a list, and those not folded; units of the matrix; distributions; points of a control chart.
MOST_LINES, OPEN_LINES, MOST_ROWS, MOST_PICTURES, MOST_POINTS = 150, 15, 100, 48, 400
#: Letters of a name or a reason that are shown.
LONGEST = 200
#: Of a chart of individuals and of one of moving ranges (n = 2): limits over the mean moving range.
INDIVIDUALS, RANGES = 2.66, 3.267


def write_page(
    path: Path | str, document: Mapping[str, Any], batch: Batch, pages: Mapping[str, str] | None = None
) -> None:
    """Write page() to `path`, whole or not at all."""
    write_text(path, page(document, batch, pages or {}))


def page(document: Mapping[str, Any], batch: Batch, pages: Mapping[str, str]) -> str:
    """The page of the document `selfcal.fleet/1` and the batch that it is made of. `pages`: where the own page of a
    device is, from this page's folder on."""
    head = f"<header><h1>{document['recordings']} recordings of {document['devices']} devices</h1>"
    body = [
        *_todo(document, batch, pages),
        *_population(batch),
        *_distributions(document, batch),
        *_control(batch),
        *_matrix(batch),
    ]
    head = f"{head}{''.join(_glance(document))}</header>"
    return frame("Fleet", "todo", "Skip to the units that need a look", head, body)


def _text(text: str) -> str:
    shown = printable(text)
    return escape(shown if len(shown) <= LONGEST else f"{shown[:LONGEST]}...")


def _glance(document: Mapping[str, Any]) -> Iterator[str]:
    counted = {
        "beyond a limit, or with the cause asked for": len(document["failed"]),
        "not judged": len(document["not_judged"]),
        "unlike the batch": len(document["unlike"]),
        "drifting": len(document["drifting"]),
    }
    for what, count in counted.items():
        yield f"<p class={'bad' if count else 'good'}>{count} devices {what}</p>"


def _todo(document: Mapping[str, Any], batch: Batch, pages: Mapping[str, str]) -> Iterator[str]:
    yield "<section aria-labelledby=todo><h2 id=todo>What to do</h2>"
    kinds = (
        ("failed", "Beyond a limit: set these aside"),
        ("unlike", "Unlike the batch: look at these first"),
        ("drifting", "Drifting from recording to recording: measure these again, calibrate them more often"),
        ("not_judged", "Not judged: record these again, or longer"),
    )
    for key, heading in kinds:
        devices: Mapping[str, Sequence[str]] = document[key]
        if not devices:
            continue
        lines = []
        for name, reasons in list(devices.items())[:MOST_LINES]:
            shown = "; ".join(_text(one) for one in reasons[:6]) + ("; ..." if len(reasons) > 6 else "")
            more = _own_page(batch, name, pages) if key != "not_judged" else ""
            lines.append(f"<li><b>{_text(name)}</b>: {shown}{more}</li>")
        yield f"<h3>{heading}</h3><ul class=findings>{''.join(lines[:OPEN_LINES])}</ul>"
        if len(devices) > OPEN_LINES:
            yield f"<details><summary>{len(devices) - OPEN_LINES} more</summary>"
            yield f"<ul class=findings>{''.join(lines[OPEN_LINES:])}</ul>"
            yield "" if len(devices) <= MOST_LINES else "<p>The JSON names the others.</p>"
            yield "</details>"
    groups = list(group_lines(batch))
    if groups:
        yield "<h3>Shared by a station, a day, a lot or a part of the units</h3><ul class=findings>"
        yield from (f"<li>{_text(one)}</li>" for one in groups[:MOST_LINES])
        yield "</ul>"
    if not groups and not any(document[key] for key, _ in kinds):
        yield "<p>Nothing: every device was judged and is like the others.</p>"
    yield "</section>"


def _own_page(batch: Batch, name: str, pages: Mapping[str, str]) -> str:
    """The link to a device's own page, or the command that makes it."""
    if name in pages:
        return f"<br><a href='{escape(quote(pages[name]))}'>page of its last recording</a>"
    if name not in batch.devices:
        return ""
    path = batch.devices[name][-1].source.path
    return f"<br><code>{_text(f'selfcal diagnose {shlex.quote(path)} --report page.html')}</code>"


def _population(batch: Batch) -> Iterator[str]:
    yield "<section aria-labelledby=population><h2 id=population>The population</h2>"
    head = "".join(
        f"<th scope=col>{one}</th>"
        for one in ("quantity", "units", "middle", "unit", "spread", "unlike from", "left out")
    )
    rows = []
    for one in batch.populations:
        measured, middle, spread = one.measured, plain(one.measured, one.fit.middle), one.fit.spread
        cells = (
            str(measured.y.size),
            f"{number(middle.median)} [{number(middle.q05)}, {number(middle.q95)}]",
            unit_module.typeset(measured.unit),
            f"{number(spread.median, 2)} [{number(spread.q05, 2)}, {number(spread.q95, 2)}]"
            + (" of ln" if measured.logarithm else ""),
            seen_from_words(one),
            str(int((~one.kept).sum())),
        )
        rows.append(f"<tr><th scope=row>{measured.name}</th>{''.join(f'<td>{escape(c)}</td>' for c in cells)}</tr>")
    if rows:
        caption = (
            "Medians and 90 % intervals of the population's middle and spread, without the units that are unlike it. "
            "A unit that is off by less than 'unlike from' does not show in a batch of so many units."
        )
        yield scrolled("Population", caption, f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>")
    else:
        yield "<p>Fewer than five units have a result: there is no population.</p>"
    yield from (f"<p>{_text(line)}</p>" for line in list(unidentified_lines(batch))[:MOST_LINES])
    yield "</section>"


def _distributions(document: Mapping[str, Any], batch: Batch) -> Iterator[str]:
    """A histogram of each quantity over the units, the data sheet's limits in it."""
    limits: dict[str, dict[tuple[float, str], None]] = {}
    for one in document["limits"]:
        limits.setdefault(f"{one['axis']}.{one['parameter']}", {})[one["value"], one["unit"]] = None
    if batch.populations:
        yield "<section aria-labelledby=spread><h2 id=spread>Distributions</h2>"
        for one in batch.populations[:MOST_PICTURES]:
            yield draw(_histogram(one, list(limits.get(one.measured.name, {}))))
        yield "</section>"


def _histogram(population: Population, limits: Sequence[tuple[float, str]]) -> Figure:
    measured = population.measured
    marks = [value * unit_module.factor(unit, measured.unit) for value, unit in limits if unit != "1"]
    y = measured.y
    reach = float(np.ptp(y)) or 1.0
    bins = int(np.clip(2.0 * y.size ** (1.0 / 3.0), 8, 60))
    edges = np.linspace(float(y.min()) - 0.02 * reach, float(y.max()) + 0.02 * reach, bins + 1)
    counts = np.histogram(y, edges)[0].astype(np.float64)
    at, middle, spread = 0.5 * (edges[1:] + edges[:-1]), population.fit.middle.median, population.fit.spread.median
    sd = np.sqrt(spread**2 + float(np.median(measured.s)) ** 2)
    expected = (
        y.size * (edges[1] - edges[0]) / (sd * math.sqrt(2.0 * math.pi)) * np.exp(-0.5 * ((at - middle) / sd) ** 2)
    )
    x = np.exp(at) if measured.logarithm else at
    panel = Panel(
        measured.name,
        unit_module.typeset(measured.unit),
        "units",
        [Curve("units", x, counts), Curve("population with the records' errors", x, expected, "fitted")],
        log_x=measured.logarithm,
        marks=[one for one in marks if one > 0.0 or not measured.logarithm],
        stairs=True,
        marked="data sheet's limit",
    )
    return Figure(measured.name, f"{y.size} units, {len(population.unlike)} of them unlike the others.", [panel])


def _control(batch: Batch) -> Iterator[str]:
    """Control charts of N and of the bias in the order of the dates: individuals and moving ranges."""
    when = [units[-1].recorded_at for units in batch.devices.values()]
    charts = [one for one in batch.populations if one.measured.name.endswith((".N", ".bias"))]
    if len({one[:10] for one in when if one}) < 2 or not charts:
        return
    yield "<section aria-labelledby=time><h2 id=time>In the order of the dates</h2>"
    for one in charts[:MOST_PICTURES]:
        measured = one.measured
        order = sorted(
            (k for k, at in enumerate(measured.at.tolist()) if when[at]), key=lambda k: when[int(measured.at[k])]
        )
        if len(order) >= 3:
            y = np.asarray(np.exp(measured.y[order]) if measured.logarithm else measured.y[order], np.float64)
            yield from map(draw, _individuals(measured.name, unit_module.typeset(measured.unit), y))
    yield "</section>"


def _individuals(name: str, unit: str, y: Array) -> list[Figure]:
    """Charts of individuals and of moving ranges, each on its own scale."""
    ranges: Array = np.concatenate([np.full(1, np.nan), np.abs(np.diff(y))])
    mean, mean_range = float(y.mean()), float(np.nanmean(ranges))
    beyond = int((np.abs(y - mean) > INDIVIDUALS * mean_range).sum()), int((ranges > RANGES * mean_range).sum())
    every = max(1, math.ceil(y.size / MOST_POINTS))
    shown = np.arange(0, y.size, every)
    out = (np.abs(y - mean) > INDIVIDUALS * mean_range) | (ranges > RANGES * mean_range)
    shown = np.union1d(shown, np.flatnonzero(out)[:MOST_POINTS])
    x = np.asarray(shown + 1.0, np.float64)
    whole: Array = np.ones(shown.size)
    low, high = mean - INDIVIDUALS * mean_range, mean + INDIVIDUALS * mean_range
    individuals = Panel(
        f"{name}, individuals",
        "unit in the order of the dates",
        unit,
        [Curve("units", x, y[shown], "dots")],
        [Band("limits by the moving range", x, low * whole, high * whole, "spread")],
    )
    moving = Panel(
        f"{name}, moving range",
        "unit in the order of the dates",
        unit,
        [Curve("units", x, ranges[shown], "dots")],
        [Band("limits by the moving range", x, 0.0 * whole, RANGES * mean_range * whole, "spread")],
    )
    thinned = f" One in {every} is shown, and each beyond the limits." if every > 1 else ""
    return [
        Figure(f"{name} by date", f"{beyond[0]} of {y.size} units lie beyond the limits.{thinned}", [individuals]),
        Figure(f"{name}, moving range", f"{beyond[1]} ranges lie beyond the limits.{thinned}", [moving]),
    ]


def _matrix(batch: Batch) -> Iterator[str]:
    """Causes and marks by device."""
    found: dict[str, dict[str, list[str]]] = {}
    for name, units in batch.devices.items():
        for unit in units:
            for axis, entry in unit.axes.items():
                for cause in dict.fromkeys([*unit.causes(axis), *entry.get("marks", [])]):
                    axes = found.setdefault(name, {}).setdefault(cause, [])
                    told = f"({axis})" if cause in unit.small(axis) else axis
                    axes += [] if told in axes else [told]
    causes = sorted({cause for row in found.values() for cause in row})
    if not causes:
        return
    yield "<section aria-labelledby=causes><h2 id=causes>Causes and units</h2>"
    head = "".join(f"<th scope=col>{escape(cause.replace('_', ' '))}</th>" for cause in causes)
    rows = "".join(
        f"<tr><th scope=row>{_text(name)}</th>"
        + "".join(f"<td>{escape(' '.join(row.get(cause, [])))}</td>" for cause in causes)
        + "</tr>"
        for name, row in list(found.items())[:MOST_ROWS]
    )
    caption = f"{len(found)} of {len(batch.devices)} devices show a cause; the axes that do."
    caption += " In brackets: it changes no number by as much as matters."
    caption += f" The first {MOST_ROWS} are here, the table has all." if len(found) > MOST_ROWS else ""
    yield scrolled("Causes", caption, f"<thead><tr><th scope=col>device</th>{head}</tr></thead><tbody>{rows}</tbody>")
    yield "</section>"
