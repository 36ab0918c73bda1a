"""How a channel's value acts on a reading: as it is, late, by its powers, or through a play. Host tools, model file and
simulator form columns here, by the library where a module has the form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal import _library32
from selfcal.base.grid import Array

#: Forms, the simplest first.
FORMS = ("static", "lag", "rate", "square", "cube", "play", "delay", "free")
#: Forms that no module makes.
HOST_FORMS = ("play", "delay", "free")
#: Entry with a form's number.
NUMBER = {"lag": "lag_s", "rate": "window_s", "play": "width", "delay": "delay_s"}
#: A curve: values of the channel, rising, and heights. Between two the line through both holds, beyond the ends these.
Knots = tuple[tuple[float, float], ...]
#: Power of the channel's unit, by form.
POWER = {"square": 2, "cube": 3}
#: `selfcal_column_kind_t`: names in C, by number.
COLUMN_KINDS = (
    "TIME",
    "CHANNEL",
    "RATE",
    "SINE",
    "COSINE",
    "STEP",
    "TURN_ON",
    "PULSE",
    "LAG",
    "SLOPE",
    "SQUARE",
    "CUBE",
)
KIND = {name: number for number, name in enumerate(COLUMN_KINDS)}
#: Kind, channel, number and second number of a column: `selfcal_source_t`.
Source = tuple[int, int, float, float]
#: Inputs: the value of the channel, or the variance of its noise.
INPUTS = ("value", "variance")


def made(
    sources: Sequence[Source],
    interval_s: float,
    rows: NDArray[np.floating[Any]],
    missing: NDArray[np.integer[Any]] | None = None,
    powered: int = 0,
) -> Array:
    """[n, sources]: columns of the channels `rows` [n, c], as a module forms them, in float32.

    Sample i follows `missing[i]` absent samples, the first sample power-on by `powered`."""
    gaps = np.zeros(len(rows), np.uint64) if missing is None else np.ascontiguousarray(missing, np.uint64)
    columns = _library32.form(list(sources), interval_s, np.ascontiguousarray(rows, np.float32), gaps, powered)
    return np.ascontiguousarray(columns, np.float64)


def source_of(form: str, channel: int, number: float, about: float, mean_s: float) -> Source:
    """`selfcal_source_t` of a form. Those that the library has not have the channel's."""
    if form == "lag":
        return KIND["LAG"], channel, number, mean_s
    if form == "rate":
        return KIND["SLOPE"], channel, number, 0.0
    if form in POWER:
        return KIND[form.upper()], channel, about, mean_s
    return KIND["CHANNEL"], channel, mean_s, 0.0


def formed(values: Array, form: str, number: float = math.nan, about: float = 0.0, interval_s: float = 1.0) -> Array:
    """[n]: the column that `values` [n] of a channel make.

    `number`: the time constant of a lag, s; the window of a rate, s; the whole width of a play; a delay, s. A rate is
    the slope of the straight line that fits its window best. `about`: what powers are taken about. A lag, a rate, a
    play and a delay begin at rest, at the first value. Between two samples the channel moves on a straight line.
    """
    if form == "static" or values.size == 0:
        return values
    if form == "play":
        return played(values, number)
    if form == "delay":
        return delayed(values, number / interval_s)
    origin = about if form in POWER else float(values[0])  # float32 has seven digits
    column = made([source_of(form, 0, number, 0.0, 0.0)], interval_s, (values - origin)[:, None])[:, 0]
    return np.asarray(column + origin) if form == "lag" else column


def slope(values: Array, window_s: float, interval_s: float) -> Array:
    """[n]: the slope of the straight line that fits the window about each sample best, per second; near an end that of
    the nearest whole window. A module's rate trails, and so it is late by half of its window."""
    if window_s <= interval_s:
        return np.asarray(np.gradient(values, interval_s))
    last, whole = values.size - 1, round(window_s / interval_s)
    rows = np.clip(np.arange(values.size) + whole // 2, min(whole, last), last)
    return formed(values, "rate", window_s, 0.0, interval_s)[rows]


def played(values: Array, width: float) -> Array:
    """Follower of `values` at half of `width` at most, which moves only if it must."""
    out = np.empty(values.size)
    position, half = float(values[0]), 0.5 * width
    for i, value in enumerate(values.tolist()):
        position = min(max(position, value - half), value + half)
        out[i] = position
    return out


def delayed(values: Array, samples: float, missing: NDArray[np.integer[Any]] | None = None) -> Array:
    """[n]: `values` [n], `samples` samples later."""
    at = np.arange(values.size, dtype=np.float64)
    at += 0.0 if missing is None else np.cumsum(missing)
    return np.asarray(np.interp(at - samples, at, values))


def curved(values: Array, knots: Knots) -> Array:
    """[n]: the heights of a curve at `values` [n] of a channel."""
    places, heights = np.array(knots).T
    return np.asarray(np.interp(values, places, heights))


def variance_of(values: Array, missing: NDArray[np.integer[Any]] | None = None) -> Array:
    """[n]: half the square of each difference: its mean is the variance of the noise, and no slow change is in it.

    Not a number where there is no sample before."""
    half = np.full(values.size, np.nan)
    half[1:] = 0.5 * np.diff(values) ** 2
    if missing is not None:
        half[missing > 0] = np.nan
    return half
