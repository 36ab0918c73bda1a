"""A channel acts by a curve of its own: a correction table, a dip, a bend at a temperature.

A spline with a few knots shows that there is a curve. Its hinges and jumps are then chosen in turn, as long as each
pays for its search: forward selection (Friedman 1991, Annals of Statistics 19, 1). A few right terms leave the drift
what is its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from selfcal.base.grid import Array
from selfcal.diagnosis.model_tree import digits
from selfcal.diagnosis.record import Record, smoothed
from selfcal.likelihood import columns
from selfcal.likelihood.columns import SMALLER, Shape, Tried
from selfcal.likelihood.fit import Fit
from selfcal.likelihood.fit import left as left_of
from selfcal.likelihood.state import ABREAST, NET_LEAST, FittedColumn, Look, State, net

#: Knots of the splines, even over the channel's range.
KNOTS = (6, 12, 36)
#: Places of a hinge or a jump, even over the range; numbers of all their columns at most; terms of a curve at most.
HINGE_PLACES, NUMBERS_MOST, TERMS_MOST = 300, 20_000_000, 40
#: Half the width of a jump, of the distance between places.
JUMP = 0.05
#: The form's name in the model file.
FREE = "free"


def spline(values: Array, places: Sequence[float] | Array) -> Array:
    """[k - 1, n]: what a height of 1 at each place but the first adds to a curve."""
    return np.array([np.interp(values, places, row) for row in np.eye(len(places))[1:]])


def counts(samples: int) -> list[int]:
    """Numbers of knots that `samples` can resolve, and whose columns memory holds."""
    return [count for count in KNOTS if 10 * count < samples and 2 * count * samples * len(KNOTS) < NUMBERS_MOST]


def knots_of(values: Array, count: int) -> list[float]:
    """`count` knots, even over the range, less those that no value is near."""
    places = np.linspace(values.min(), values.max(), count)
    near = 0.5 * (places[1] - places[0])
    return [float(place) for place in places if np.any(np.abs(values - place) < near)]


def best(state: State, found: Tried, means: Array) -> Tried:
    """The curve of `means` [n] of the channel as a column of mean 0 and deviation 1: hinges and jumps, or the spline
    that was found if these are not evident by themselves."""
    (column,) = found.shape.regressors
    heights = [0.0, *found.fit.c[-len(found.shape.columns) :]]
    whole = _as_one(state, found, column, means, column.entry["knots"], heights)
    chosen = _chosen(state, found, means)
    return whole if chosen is None or chosen.net < NET_LEAST else chosen


def _chosen(state: State, found: Tried, means: Array) -> Tried | None:
    """The curve of hinges and jumps."""
    count = min(HINGE_PLACES, NUMBERS_MOST // (2 * means.size))
    if count < KNOTS[0]:
        return None
    places = np.linspace(means.min(), means.max(), count + 1)[:-1]
    apart = places[1] - places[0]
    hinges = np.maximum(means - places[:, None], 0.0) / apart
    jumps = np.clip((means - places[1:, None]) / (2.0 * JUMP * apart) + 0.5, 0.0, 1.0)
    terms = np.vstack([hinges, jumps])
    gain, fit, picked = 0.0, found.fit, list[int]()
    for drift in (found.fit, *(found.fit.shrunk(by) for by in SMALLER)):
        now = _picked(state, drift, terms)
        more, beside = state.with_columns(terms[now]) if now else (0.0, drift)
        if more > gain:
            gain, fit, picked = more, beside, now
    if not picked:
        return None
    at = places[[k if k < count else k - count + 1 for k in picked]]
    steps = [x + way * JUMP * apart for x, k in zip(at, picked, strict=True) if k >= count for way in (-1.0, 1.0)]
    bends = [float(x) for x, k in zip(at, picked, strict=True) if k < count]
    knots = np.unique([means.min(), *bends, *steps, means.max()])
    heights = np.interp(knots, *_sorted(means, fit.c[-len(picked) :] @ terms[picked]))
    shape = replace(found.shape, free=len(picked), price=len(picked) * math.log(len(terms)))
    return _as_one(state, Tried(shape, gain, fit), found.shape.regressors[0], means, knots, heights)


def _sorted(places: Array, heights: Array) -> tuple[Array, Array]:
    order = np.argsort(places)
    return places[order], heights[order]


def _picked(state: State, fit: Fit, terms: Array) -> list[int]:
    """Terms [k, n] in turn: the term that gains most over those before it, while it pays its search."""
    parts = np.array_split(terms, math.ceil(len(terms) / ABREAST))
    each = [left_of(state.series, fit, part) for part in parts]
    u, left = np.concatenate([part[:, 1:] for part in each], axis=1), each[0][:, 0] / fit.sigma
    size = (u**2).sum(axis=0)
    picked: list[int] = []
    while len(picked) < TERMS_MOST:
        own = (u**2).sum(axis=0)
        gain = np.where(own > 1e-6 * size, 0.5 * (left @ u) ** 2 / np.maximum(own, 1e-300), 0.0)
        k = int(np.argmax(gain))
        if net(float(gain[k]), 1, math.log(len(terms))) < 1.0:
            break
        picked.append(k)
        v = u[:, k] / math.sqrt(own[k])
        left = left - v * (v @ left)
        u -= np.outer(v, v @ u)
    return picked


def _as_one(
    state: State,
    found: Tried,
    column: FittedColumn,
    means: Array,
    places: Sequence[float] | Array,
    heights: Sequence[float] | Array,
) -> Tried:
    """The curve as a column of the model file."""
    values = np.interp(means, places, heights)
    scale, middle = max(float(values.std()), 1e-300), float(values.mean())
    knots = [[digits(float(x), 8), digits(float(y - middle) / scale)] for x, y in zip(places, heights, strict=True)]
    own = replace(column, values=(values - middle) / scale, entry={**column.entry, "knots": knots})
    shape = replace(found.shape, columns=own.values[None], regressors=(own,), keys=found.shape.keys[:1])
    shape = replace(shape, stated={**shape.stated, "knots": knots})
    return replace(found, shape=shape, fit=columns.fitted(state, shape).fit)


def trained(look: Look, before: State, after: State, record: Record, split: int) -> State:
    """The state with the heights of a curve as coefficients: those of later values are not known before."""
    known = {regressor.name for regressor in before.regressors}
    own = next(
        (
            regressor
            for regressor in after.regressors
            if regressor.name not in known and regressor.entry.get("form") == FREE
        ),
        None,
    )
    if own is None:
        return after
    means = smoothed(record.channels[look.cause], max(1, round(float(own.entry.get("window_s", 0.0)) * record.rate_hz)))
    rows = spline(means, [place for place, _ in own.entry["knots"]])
    heights = tuple(replace(own, name=f"{own.name}_{k}", values=row) for k, row in enumerate(rows))
    return after.refit(regressors=(*(regressor for regressor in after.regressors if regressor is not own), *heights))


def shape(column: FittedColumn, means: Array, price: float, unit: str, stated: dict[str, object]) -> Shape:
    """The spline through the knots of a column with its heights free."""
    rows = spline(means, column.entry["knots"])
    return Shape(FREE, rows, (column,), tuple(("coefficient", unit) for _ in rows), price, len(rows), stated=stated)
