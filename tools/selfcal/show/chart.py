"""Line charts as inline SVG, and the table behind each. Colours and fonts are the page's style sheet's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from selfcal.likelihood.statemodel import Array

#: Size of a panel and of its margins, in units of the picture: text of 12 units stays legible on a telephone.
WIDTH, HEIGHT = 340, 220
LEFT, RIGHT, TOP, BOTTOM = 54, 12, 26, 42
#: Size of a picture of strips, room for their names, and the height of each.
STRIP_WIDTH, STRIP_LEFT, STRIP = 900, 96, 52
#: Share of the points of a strip that may lie beyond its lower edge, and beyond its upper one.
USUAL = 0.02
#: Rows of a table behind a picture at most.
ROWS = 25
#: Ticks on an axis, about.
TICKS = 5

Kind = Literal["measured", "fitted", "dots"]


@dataclass(frozen=True)
class Curve:
    """A line or dots: `x`, `y` [n] (NaN: a gap). `kind` sets its look: `measured` solid, `fitted` dashed, `dots`."""

    label: str
    x: Array
    y: Array
    kind: Kind = "measured"


@dataclass(frozen=True)
class Band:
    """The area from `low` to `high` [n] over `x` [n]. `kind` sets its look: `simulated` with dashed edges, `spread`."""

    label: str
    x: Array
    low: Array
    high: Array
    kind: Literal["simulated", "spread"] = "simulated"


@dataclass(frozen=True)
class Panel:
    """One chart. `marks`: instants or frequencies that a vertical line points out; `marked`: what they
    are. `stairs`: a histogram's look."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve] = ()
    bands: Sequence[Band] = ()
    log_x: bool = False
    log_y: bool = False
    marks: Sequence[float] = ()
    stairs: bool = False
    marked: str = "where it was found"

    @property
    def drawn(self) -> list[Curve | Band]:
        return [*self.curves, *self.bands]


@dataclass(frozen=True)
class Figure:
    """Panels on one scale, what they show (`caption`: the reader's sentence), and a name for the tables."""

    name: str
    caption: str
    panels: Sequence[Panel]


def number(value: float, digits: int = 4) -> str:
    """Short and without a needless zero."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    text = f"{value:.{digits}g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}e{int(exponent)}"
    return text.replace("-", "−")


def envelope(x: Array, y: Array, points: int) -> tuple[Array, Array, Array, Array]:
    """Centre, mean, least and largest of y [n] in at most points / 2 pieces of equal length."""
    pieces = max(1, min(y.size, points // 2))
    edges = np.linspace(0, y.size, pieces + 1).astype(int)
    good = np.isfinite(y)
    count = np.add.reduceat(good.astype(float), edges[:-1])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.add.reduceat(np.where(good, y, 0.0), edges[:-1]) / count
    low = np.minimum.reduceat(np.where(good, y, np.inf), edges[:-1])
    high = np.maximum.reduceat(np.where(good, y, -np.inf), edges[:-1])
    empty = count == 0
    mean[empty] = low[empty] = high[empty] = np.nan
    return 0.5 * (x[edges[:-1]] + x[edges[1:] - 1]), mean, low, high


@dataclass(frozen=True)
class _Scale:
    low: float
    high: float
    log: bool
    start: float
    length: float

    def at(self, value: Array) -> Array:
        with np.errstate(invalid="ignore", divide="ignore"):
            v = np.log10(value) if self.log else value
        a, b = (math.log10(self.low), math.log10(self.high)) if self.log else (self.low, self.high)
        part = np.clip((v - a) / (b - a), 0.0, 1.0)
        return self.start + part * self.length

    def ticks(self) -> list[float]:
        if self.log:
            return _log_ticks(self.low, self.high)
        raw = (self.high - self.low) / TICKS
        power = 10.0 ** math.floor(math.log10(raw))
        step = next(power * k for k in (1, 2, 5, 10) if power * k >= raw * 0.999)
        first = math.ceil(self.low / step - 1e-9)
        last = math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    a, b = math.log10(low), math.log10(high)
    factors = (1.0,) if b - a > 2.0 else (1.0, 2.0, 5.0)
    every = max(1, math.ceil((b - a) / (TICKS + 1)))
    found = [
        factor * 10.0**k
        for k in range(math.floor(a), math.ceil(b) + 1)
        if k % every == 0
        for factor in factors
        if low * 0.999 <= factor * 10.0**k <= high * 1.001
    ]
    return found if len(found) > 1 else [low, high]


def _limits(values: Sequence[Array], log: bool, pad: float) -> tuple[float, float]:
    joined = np.concatenate([np.ravel(value) for value in values] or [np.array([0.0, 1.0])])
    good = joined[np.isfinite(joined) & ((joined > 0.0) | (not log))]
    if not good.size:
        return (0.1, 1.0) if log else (0.0, 1.0)
    low, high = float(good.min()), float(good.max())
    if log:
        grow = (high / low) ** pad if high > low * 1.001 else 2.0
        return low / grow, high * grow
    grow = pad * (high - low) if high > low else max(abs(high), 1.0) * 0.5
    return low - grow, high + grow


def _x_limits(figure: Figure) -> tuple[float, float]:
    first = figure.panels[0]
    xs = [one.x for panel in figure.panels for one in panel.drawn]
    if first.stairs:  # to the outer edges of the bins, and to the marks beyond them
        low, high = _limits(xs, first.log_x, 0.5 / max(1, xs[0].size - 1))
        marks = [mark for panel in figure.panels for mark in panel.marks]
        return min([low, *marks]), max([high, *marks])
    low, high = _limits(xs, first.log_x, 0.0)
    # Pieces' middles begin half a piece after 0.
    return (0.0 if not first.log_x and 0.0 < low < 0.05 * high else low), high


def _y_limits(figure: Figure) -> tuple[float, float]:
    values = [one.y for panel in figure.panels for one in panel.curves]
    values += [edge for panel in figure.panels for one in panel.bands for edge in (one.low, one.high)]
    return _limits(values, figure.panels[0].log_y, 0.06)


def draw(figure: Figure) -> str:
    """The figure in HTML: its panels on one scale, caption, key, and a table behind them."""
    first = figure.panels[0]
    x = _Scale(*_x_limits(figure), first.log_x, LEFT, WIDTH - LEFT - RIGHT)
    y = _Scale(*_y_limits(figure), first.log_y, HEIGHT - BOTTOM, -(HEIGHT - TOP - BOTTOM))
    pictures = "".join(_panel(panel, x, y) for panel in figure.panels)
    return (
        f"<figure><div class=panels>{pictures}</div>"
        f"<figcaption>{escape(figure.caption)} {_key(figure)}</figcaption>{_tables(figure)}</figure>"
    )


def strips(figure: Figure, marks: Sequence[tuple[float, str]]) -> str:
    """The figure in HTML with its panels one below the other over one x, each on its own scale; `marks`: places with
    the text that stands above them."""
    x = _Scale(*_x_limits(figure), False, STRIP_LEFT, STRIP_WIDTH - STRIP_LEFT - RIGHT)
    right, bottom = STRIP_WIDTH - RIGHT, TOP + STRIP * len(figure.panels)
    told = f"{figure.name}: {', '.join(panel.title for panel in figure.panels)}; marks at " + (
        ", ".join(f"{number(at)} s ({text})" for at, text in marks) or "no time"
    )
    out = [f'<svg viewBox="0 0 {STRIP_WIDTH} {bottom + 34}" role=img aria-label="{escape(told)}">']
    for row, given in enumerate(figure.panels):
        top = TOP + STRIP * row
        y = _Scale(*_usual(given), False, top + STRIP - 4, -(STRIP - 8))
        panel = replace(
            given,
            curves=[replace(one, y=np.clip(one.y, y.low, y.high)) for one in given.curves],
            bands=[
                replace(one, low=np.clip(one.low, y.low, y.high), high=np.clip(one.high, y.low, y.high))
                for one in given.bands
            ],
        )
        out.append(f"<path class=grid d='M{STRIP_LEFT} {top + STRIP}H{right}'/>")
        out.append(f"<text class=name x=4 y={top + STRIP // 2}>{escape(panel.title)}</text>")
        span = number(y.high - y.low, 2)
        out.append(f"<text class=tick x=4 y={top + STRIP // 2 + 15}>{span} {escape(panel.y_label)}</text>")
        out += [_band(band, x, y, False) for band in panel.bands]
        out += [_curve(curve, x, y, False) for curve in panel.curves]
    above: dict[float, list[str]] = {}
    for at, text in sorted(marks):
        place = float(x.at(np.array([at]))[0])
        out.append(f"<path class=mark d='M{place:.1f} {TOP}V{bottom}'/>")
        near = next((one for one in above if place - one < 14.0), place)
        above.setdefault(near, []).append(text)
    for place, texts in above.items():
        text = escape(" ".join(dict.fromkeys(texts)))
        out.append(f"<text class=name x={place:.1f} y={TOP - 6} text-anchor=middle>{text}</text>")
    for value in x.ticks():
        at = float(x.at(np.array([value]))[0])
        out.append(f"<text class=tick x={at:.1f} y={bottom + 15} text-anchor=middle>{number(value)}</text>")
    out.append(f"<text class=tick x={right} y={bottom + 30} text-anchor=end>{escape(figure.panels[0].x_label)}</text>")
    return (
        f"<figure><div class='scroll strips' tabindex=0 role=group aria-label='{escape(figure.name)}'>{''.join(out)}"
        f"</svg></div><figcaption>{escape(figure.caption)} {_key(figure)}</figcaption>{_tables(figure)}</figure>"
    )


def _usual(panel: Panel) -> tuple[float, float]:
    """Limits that all but a few points of a panel keep: a shock must not hide a step."""
    values = [one.y for one in panel.curves] + [edge for one in panel.bands for edge in (one.low, one.high)]
    usual = [np.nanquantile(one, (USUAL, 1.0 - USUAL)) for one in values if np.isfinite(one).any()]
    return _limits(usual, False, 0.06)


def _panel(panel: Panel, x: _Scale, y: _Scale) -> str:
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    out = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role=img aria-label="{escape(_alternative(panel))}">',
        f"<text class=name x={LEFT} y=14>{escape(panel.title)}</text>",
    ]
    for value in y.ticks():
        at = float(y.at(np.array([value]))[0])
        out.append(f"<path class=grid d='M{LEFT} {at:.1f}H{right}'/>")
        out.append(f"<text class=tick x={LEFT - 5} y={at + 4:.1f} text-anchor=end>{number(value)}</text>")
    for value in x.ticks():
        at = float(x.at(np.array([value]))[0])
        anchor = "end" if at > right - 12 else "middle"
        out.append(f"<path class=grid d='M{at:.1f} {TOP}V{bottom}'/>")
        out.append(f"<text class=tick x={at:.1f} y={bottom + 15} text-anchor={anchor}>{number(value)}</text>")
    out += [_band(band, x, y, panel.stairs) for band in panel.bands]
    for mark in panel.marks:
        at = float(x.at(np.array([mark]))[0])
        out.append(f"<path class=mark d='M{at:.1f} {TOP}V{bottom}'/>")
    out += [_curve(curve, x, y, panel.stairs) for curve in panel.curves]
    out.append(f"<text class=tick x={right} y={HEIGHT - 8} text-anchor=end>{escape(panel.x_label)}</text>")
    out.append(f"<text class=tick x={right} y=14 text-anchor=end>{escape(panel.y_label)}</text></svg>")
    return "".join(out)


def _alternative(panel: Panel) -> str:
    """The picture in a sentence: what, over what, and how much of the measured curve the simulated band holds."""
    text = f"{panel.title}: {panel.y_label} over {panel.x_label}."
    for curve in panel.curves:
        good = curve.y[np.isfinite(curve.y)]
        if good.size:
            text += f" {curve.label} from {number(float(good.min()), 3)} to {number(float(good.max()), 3)}."
    for band in panel.bands:
        same = next((one for one in panel.curves if one.kind != "fitted" and one.x.size == band.x.size), None)
        if same is not None and band.kind == "simulated":
            outside, total = outside_of(same, band)
            text += f" {outside} of {total} points lie outside the simulated band."
    return text


def outside_of(curve: Curve, band: Band) -> tuple[int, int]:
    """Points of the curve outside the band on the same x, and points in all."""
    good = np.isfinite(curve.y) & np.isfinite(band.low) & np.isfinite(band.high)
    out = (curve.y < band.low) | (curve.y > band.high)
    return int((out & good).sum()), int(good.sum())


def _band(band: Band, x: _Scale, y: _Scale, stairs: bool) -> str:
    low, high = y.at(band.low), y.at(band.high)
    px = x.at(band.x)
    out = ""
    for piece in _pieces(np.isfinite(band.low) & np.isfinite(band.high)):
        upper, lower = (_stairs(px[piece], edge[piece], stairs) for edge in (high, low))
        out += _path(np.concatenate([upper[0], lower[0][::-1]]), np.concatenate([upper[1], lower[1][::-1]])) + "z"
    return f"<path class={band.kind} d='{out}'/>" if out else ""


def _curve(curve: Curve, x: _Scale, y: _Scale, stairs: bool) -> str:
    px, py = x.at(curve.x), y.at(curve.y)
    good = np.isfinite(py) & np.isfinite(px)
    if curve.kind == "dots":
        dots = "".join(f"M{px[k] - 3:.1f} {py[k]:.1f}l3-3 3 3-3 3z" for k in np.flatnonzero(good))
        return f"<path class=dots d='{dots}'/>" if dots else ""
    lines = "".join(_path(*_stairs(px[piece], py[piece], stairs)) for piece in _pieces(good))
    return f"<path class={curve.kind} d='{lines}'/>" if lines else ""


def _stairs(px: Array, py: Array, stairs: bool) -> tuple[Array, Array]:
    """The corners of a histogram's outline, bins about px of equal width; else the points as they are."""
    if not stairs or px.size < 2:
        return px, py
    half = 0.5 * (px[1] - px[0])
    return np.ravel(np.column_stack([px - half, px + half])), np.repeat(py, 2)


def _path(px: Array, py: Array) -> str:
    """Path data in steps of a tenth, relative: a third shorter than absolute ones."""
    at = np.rint(10.0 * np.column_stack([px, py])).astype(int)
    steps = np.diff(at, axis=0)
    text = "".join(_tenth(int(dx), "") + _tenth(int(dy), " ") + " " for dx, dy in steps if dx or dy)
    return f"M{_tenth(int(at[0, 0]), '')}{_tenth(int(at[0, 1]), ' ')}" + (f"l{text.rstrip()}" if text else "h0")


def _tenth(value: int, before: str) -> str:
    sign = "-" if value < 0 else before
    whole, tenth = divmod(abs(value), 10)
    return f"{sign}{whole}.{tenth}" if tenth and whole else (f"{sign}.{tenth}" if tenth else f"{sign}{whole}")


def _pieces(good: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Runs of indices that are good."""
    where = np.flatnonzero(good)
    return [run for run in np.split(where, np.flatnonzero(np.diff(where) > 1) + 1) if run.size]


_SWATCH = {
    "measured": "<path class=measured d='M1 8H27'/>",
    "fitted": "<path class=fitted d='M1 8H27'/>",
    "dots": "<path class=dots d='M10 8l4 -4 4 4 -4 4z'/>",
    "simulated": "<path class=simulated d='M1 2H27V14H1Z'/>",
    "spread": "<path class=spread d='M1 2H27V14H1Z'/>",
    "mark": "<path class=mark d='M14 1V15'/>",
}


def _key(figure: Figure) -> str:
    entries: dict[str, str] = {}
    for panel in figure.panels:
        for one in panel.drawn:
            entries.setdefault(one.label, one.kind)
        if panel.marks:
            entries.setdefault(panel.marked, "mark")
    return "".join(
        f"<span class=key><svg viewBox='0 0 28 16' aria-hidden=true>{_SWATCH[kind]}</svg>{escape(label)}</span> "
        for label, kind in entries.items()
    )


def _tables(figure: Figure) -> str:
    tables = "".join(_table(panel, figure.name) for panel in figure.panels)
    return f"<details><summary>Table: {escape(figure.name)}</summary>{tables}</details>"


def _table(panel: Panel, name: str) -> str:
    """One table for all curves and bands on the same x, thinned evenly."""
    groups: list[tuple[Array, list[tuple[str, Array]]]] = []
    for one in panel.drawn:
        columns = (
            [(one.label, one.y)]
            if isinstance(one, Curve)
            else [(f"{one.label}, lowest", one.low), (f"{one.label}, highest", one.high)]
        )
        same = next((group for group in groups if np.array_equal(group[0], one.x)), None)
        if same is None:
            groups.append((one.x, columns))
        else:
            same[1].extend(columns)
    return "".join(_rows(panel, name, x, columns) for x, columns in groups)


def _rows(panel: Panel, name: str, x: Array, columns: list[tuple[str, Array]]) -> str:
    every = max(1, math.ceil(x.size / ROWS))
    thinned = "" if every == 1 else f" One point in {every} of {x.size}."
    head = "".join(f"<th scope=col>{escape(label)}</th>" for label, _ in columns)
    body = "".join(
        f"<tr><th scope=row>{number(float(x[k]), 5)}</th>"
        + "".join(f"<td>{number(float(values[k]))}</td>" for _, values in columns)
        + "</tr>"
        for k in range(0, x.size, every)
    )
    caption = f"{panel.title}: {panel.y_label} over {panel.x_label}.{thinned}"
    table = f"<thead><tr><th scope=col>{escape(panel.x_label)}</th>{head}</tr></thead><tbody>{body}</tbody>"
    return scrolled(f"{name}, {panel.title}", caption, table)


def scrolled(name: str, caption: str, rows: str, look: str = "") -> str:
    """A table that scrolls by itself on a narrow screen, with the keyboard too. `rows`: its head and body, HTML;
    `look`: more classes of its style."""
    return (
        f'<div class="{f"scroll {look}".strip()}" tabindex=0 role=group aria-label="{escape(name)}">'
        f"<table><caption><span>{escape(caption)}</span></caption>{rows}</table></div>"
    )
