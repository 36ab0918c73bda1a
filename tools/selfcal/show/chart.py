"""Line charts as inline SVG, and the table behind each. Colours and fonts are the page's style sheet's.

Templates lay the figures out; here are their numbers: scales, ticks, paths and rows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import starmap
from typing import Literal

import numpy as np
from markupsafe import Markup

from selfcal.base.grid import Array, Mask, Rows, runs
from selfcal.show.page_template import number, render

#: Size of a panel and of its margins, in units of the picture: text of 12 units stays legible on a telephone.
WIDTH, HEIGHT = 340, 220
LEFT, RIGHT, TOP, BOTTOM = 54, 12, 26, 42
#: Size of a picture of strips, room for their names, and the height of each.
STRIP_WIDTH, STRIP_LEFT, STRIP = 900, 96, 52
#: Most points of a curve.
POINTS_MOST = 400
#: Most rows of a table behind a picture.
TABLE_ROWS_MOST = 25
#: Approximate number of ticks of an axis.
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
    """The area from `low` to `high` [n] over `x` [n]. `kind` sets its look: `simulated` with dashed edges, `spread`,
    `moving`."""

    label: str
    x: Array
    low: Array
    high: Array
    kind: Literal["simulated", "spread", "moving"] = "simulated"


@dataclass(frozen=True)
class Panel:
    """A chart. `marks`: instants or frequencies that a vertical line points out; `marked`: what they are. `stairs`: a
    histogram's look."""

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
        """All curves and bands, as the key and the tables name them."""
        return [*self.curves, *self.bands]

    @property
    def heights(self) -> list[Array]:
        """All that lies on the vertical axis."""
        return [curve.y for curve in self.curves] + [edge for band in self.bands for edge in (band.low, band.high)]

    @property
    def alternative(self) -> str:
        """The picture in a sentence: what, over what, and how much of the measured curve the simulated band holds."""
        text = f"{self.title}: {self.y_label} over {self.x_label}."
        for curve in self.curves:
            good = curve.y[np.isfinite(curve.y)]
            if good.size:
                text += f" {curve.label} from {number(float(good.min()), 3)} to {number(float(good.max()), 3)}."
        for band in self.bands:
            same = next(
                (curve for curve in self.curves if curve.kind != "fitted" and curve.x.size == band.x.size), None
            )
            if same is not None and band.kind == "simulated":
                outside, total = outside_of(same, band)
                text += f" {outside} of {total} points lie outside the simulated band."
        return text

    @property
    def tables(self) -> Iterator[tuple[str, list[str], Iterator[list[str]]]]:
        """Caption, headings and rows of a table for all curves and bands on the same x, thinned evenly."""
        groups: list[tuple[Array, list[tuple[str, Array]]]] = []
        for item in self.drawn:
            if isinstance(item, Curve):
                columns = [(item.label, item.y)]
            else:
                columns = [(f"{item.label}, lowest", item.low), (f"{item.label}, highest", item.high)]
            same = next((group for group in groups if np.array_equal(group[0], item.x)), None)
            if same is None:
                groups.append((item.x, columns))
            else:
                same[1].extend(columns)
        for x, columns in groups:
            every = max(1, math.ceil(x.size / TABLE_ROWS_MOST))
            thinned = "" if every == 1 else f" One point in {every} of {x.size}."
            heads = [self.x_label, *(label for label, _ in columns)]
            rows = (
                [number(float(abscissa), 5), *(number(float(y)) for y in row)]
                for abscissa, *row in zip(x[::every], *(y[::every] for _, y in columns), strict=True)
            )
            yield f"{self.title}: {self.y_label} over {self.x_label}.{thinned}", heads, rows


@dataclass(frozen=True)
class Figure:
    """Panels on a common scale, what they show (`caption`: the reader's sentence), and a name for the tables."""

    name: str
    caption: str
    panels: Sequence[Panel]

    @property
    def key(self) -> dict[str, str]:
        """The look of each label."""
        looks: dict[str, str] = {}
        for panel in self.panels:
            for item in panel.drawn:
                looks.setdefault(item.label, item.kind)
            if panel.marks:
                looks.setdefault(panel.marked, "mark")
        return looks


def means_of(edges: Rows, values: Array | Mask) -> Array:
    """Mean of the finite values in each piece between `edges`; NaN without any."""
    good = np.isfinite(values)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = np.add.reduceat(np.where(good, values, 0.0), edges[:-1])
        return np.asarray(total / np.add.reduceat(good.astype(float), edges[:-1]))


def envelope(x: Array, y: Array, points: int) -> tuple[Array, Array, Array, Array]:
    """Centre, mean, least and largest of y [n] in at most points / 2 pieces of equal length."""
    pieces = max(1, min(y.size, points // 2))
    edges = np.linspace(0, y.size, pieces + 1).astype(int)
    good, mean = np.isfinite(y), means_of(edges, y)
    low = np.minimum.reduceat(np.where(good, y, np.inf), edges[:-1])
    high = np.maximum.reduceat(np.where(good, y, -np.inf), edges[:-1])
    low[np.isnan(mean)] = high[np.isnan(mean)] = np.nan
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

    def place(self, value: float) -> float:
        return float(self.at(np.array([value]))[0])

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
    ticks = [
        factor * 10.0**k
        for k in range(math.floor(a), math.ceil(b) + 1)
        if k % every == 0
        for factor in factors
        if low * 0.999 <= factor * 10.0**k <= high * 1.001
    ]
    return ticks if len(ticks) > 1 else [low, high]


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
    xs = [item.x for panel in figure.panels for item in panel.drawn]
    if first.stairs:  # to the outer edges of the bins, and to the marks beyond them
        low, high = _limits(xs, first.log_x, 0.5 / max(1, xs[0].size - 1))
        marks = [mark for panel in figure.panels for mark in panel.marks]
        return min([low, *marks]), max([high, *marks])
    low, high = _limits(xs, first.log_x, 0.0)
    # Pieces' middles begin half a piece after 0.
    return (0.0 if not first.log_x and 0.0 < low < 0.05 * high else low), high


def draw(figure: Figure) -> Markup:
    """The figure in HTML: its panels on a common scale, caption, key, and a table behind them."""
    first, heights = figure.panels[0], [each for panel in figure.panels for each in panel.heights]
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    return render(
        "panels.html",
        figure=figure,
        x=_Scale(*_x_limits(figure), first.log_x, LEFT, right - LEFT),
        y=_Scale(*_limits(heights, first.log_y, 0.06), first.log_y, bottom, TOP - bottom),
        paths=_paths,
        **{"width": WIDTH, "height": HEIGHT, "left": LEFT, "right": right, "top": TOP, "bottom": bottom},
    )


def strips(figure: Figure, marks: Sequence[tuple[float, float, str]]) -> Markup:
    """The figure in HTML with its panels below each other over a common x, each on its own scale. `marks`: begin and
    end of events with the text that stands above them."""
    right, bottom = STRIP_WIDTH - RIGHT, TOP + STRIP * len(figure.panels)
    x = _Scale(*_x_limits(figure), False, STRIP_LEFT, right - STRIP_LEFT)
    rows = []
    for row, panel in enumerate(figure.panels):
        y = _Scale(*_usual(panel), False, TOP + STRIP * (row + 1) - 4, 8 - STRIP)
        curves = [replace(curve, y=np.clip(curve.y, y.low, y.high)) for curve in panel.curves]
        bands = [
            replace(band, low=np.clip(band.low, y.low, y.high), high=np.clip(band.high, y.low, y.high))
            for band in panel.bands
        ]
        rows.append((replace(panel, curves=curves, bands=bands), y))
    above: dict[float, list[str]] = {}  # a text that has no room of its own goes to its left neighbour
    for value, _, text in sorted(marks):
        line = x.place(value)
        above.setdefault(next((other for other in above if line - other < 14.0), line), []).append(text)
    return render(
        "strips.html",
        figure=figure,
        marks=marks,
        rows=rows,
        above=above,
        x=x,
        paths=_paths,
        **{"width": STRIP_WIDTH, "strip": STRIP, "left": STRIP_LEFT, "right": right, "top": TOP, "bottom": bottom},
    )


def _usual(panel: Panel) -> tuple[float, float]:
    """Limits that all but a few points of a panel keep: a shock must not hide a step."""
    bands = [band for band in panel.bands if band.kind != "moving"]
    values = [curve.y for curve in panel.curves] + [edge for band in bands for edge in (band.low, band.high)]
    usual = [np.nanquantile(ys, (0.02, 0.98)) for ys in values if np.isfinite(ys).any()]
    return _limits(usual, False, 0.06)


def outside_of(curve: Curve, band: Band) -> tuple[int, int]:
    """Points of the curve outside the band on the same x, and points in all."""
    good = np.isfinite(curve.y) & np.isfinite(band.low) & np.isfinite(band.high)
    out = (curve.y < band.low) | (curve.y > band.high)
    return int((out & good).sum()), int(good.sum())


def _paths(drawn: Sequence[Curve | Band], x: _Scale, y: _Scale, stairs: bool) -> Markup:
    """An SVG path for each curve or band that has a finite point."""
    shapes = [
        (item.kind, _line(item, x, y, stairs) if isinstance(item, Curve) else _area(item, x, y, stairs))
        for item in drawn
    ]
    return Markup("\n").join(Markup("<path class={} d='{}'/>").format(kind, d) for kind, d in shapes if d)


def _area(band: Band, x: _Scale, y: _Scale, stairs: bool) -> str:
    low, high = y.at(band.low), y.at(band.high)
    px = x.at(band.x)
    out = ""
    for piece in starmap(slice, runs(np.isfinite(band.low) & np.isfinite(band.high))):
        upper, lower = (_stairs(px[piece], edge[piece], stairs) for edge in (high, low))
        out += _path(np.concatenate([upper[0], lower[0][::-1]]), np.concatenate([upper[1], lower[1][::-1]])) + "z"
    return out


def _line(curve: Curve, x: _Scale, y: _Scale, stairs: bool) -> str:
    px, py = x.at(curve.x), y.at(curve.y)
    good = np.isfinite(py) & np.isfinite(px)
    if curve.kind == "dots":
        return "".join(f"M{px[k] - 3:.1f} {py[k]:.1f}l3-3 3 3-3 3z" for k in np.flatnonzero(good))
    return "".join(_path(*_stairs(px[piece], py[piece], stairs)) for piece in starmap(slice, runs(good)))


def _stairs(px: Array, py: Array, stairs: bool) -> tuple[Array, Array]:
    """The corners of a histogram's outline, bins about px of equal width; else the points as they are."""
    if not stairs or px.size < 2:
        return px, py
    half = 0.5 * (px[1] - px[0])
    return np.ravel(np.column_stack([px - half, px + half])), np.repeat(py, 2)


def _path(px: Array, py: Array) -> str:
    """Path data in steps of a tenth, relative: a third shorter than absolute steps."""
    corners = np.rint(10.0 * np.column_stack([px, py])).astype(int)
    steps = np.diff(corners, axis=0)
    text = "".join(_tenth(int(dx), "") + _tenth(int(dy), " ") + " " for dx, dy in steps if dx or dy)
    return f"M{_tenth(int(corners[0, 0]), '')}{_tenth(int(corners[0, 1]), ' ')}" + (
        f"l{text.rstrip()}" if text else "h0"
    )


def _tenth(value: int, before: str) -> str:
    sign = "-" if value < 0 else before
    whole, tenth = divmod(abs(value), 10)
    return f"{sign}{whole}.{tenth}" if tenth and whole else (f"{sign}.{tenth}" if tenth else f"{sign}{whole}")
