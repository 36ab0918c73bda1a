"""Checks of the drift: does the law take another axis, a side channel, a jump, or settling after power-on for drift?

A walk follows nearly anything slow, so its innovations hide the cause. Each candidate is a column next to the bias, and
the engine of the diagnosis (likelihood/columns.py) weighs it on a bounded grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from selfcal.bank.axis_result import AxisResult
from selfcal.bank.blocks import Blocks
from selfcal.base.errors import UserError
from selfcal.base.grid import Array, block_means, half_means
from selfcal.likelihood import columns, edges
from selfcal.likelihood.columns import LN_SLOW, SMALLER, Shape
from selfcal.likelihood.fit import ROUGH_FTOL, fit_at
from selfcal.likelihood.state import MEANS_MOST, NET_LEAST, SCREEN, State
from selfcal.logs.recording import SIDE_CHANNELS, Recording, bridged
from selfcal.model.forms import formed, slope, variance_of
from selfcal.model.tables import Tables
from selfcal.readings.budget import CLEARLY

#: Sizes of the drift that are tried with a column, as ln of a divisor. A smaller drift must be clearly better: noise
#: that axes share is no drift.
DRIFT_DIVISORS = (0.0, 0.7, *SMALLER)
#: Fewest means that are looked at: fewer show no drift.
MEANS_LEAST = 60
#: Smoothing, lags and the window of a rate, s: a channel's own noise hides its slow change.
SMOOTH_S, LAGS_S, RATE_S = 20.0, (5.0, 30.0, 120.0, 600.0), 60.0
#: Time constants of a settling, shares of the record.
SETTLING_SHARES = (0.005, 0.015, 0.05, 0.15)


def drift_checks(
    blocks: Blocks, tables: Tables, result: AxisResult, recording: Recording, others: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """`channel`: which of the columns `others` explains most of the record, its `form`, and the evidence net of the
    search, nats. `turn_on`: the same of a bias that settles, by `tau_s`. `jump`: of a bias that jumps, at `time_s` of
    the recording. Nothing where the record is too short, and where the likeliest law is a sum: then simple laws leave a
    drift that any column may take."""
    likeliest = max(result.probability, key=lambda law: result.probability[law])
    simple = any(not hypothesis.law.is_sum and hypothesis.name == likeliest for hypothesis in tables.hypotheses)
    state, cells = _state(blocks, tables)
    if np.isfinite(state.y).sum() < MEANS_LEAST or not simple:
        return {}
    try:
        state = state.refit(ftol=ROUGH_FTOL)
    except UserError:  # no drift has a likelihood
        return {}
    checks = {}
    channels = list(_channels(state, blocks.begin, tables.block * cells, recording, others))
    if channels:
        checks["channel"] = _check(state, channels, lambda best: dict(best.stated))
    settling = [share * state.y.size for share in SETTLING_SHARES]
    decays = {tau * state.dt: np.exp(-np.arange(state.y.size) / tau) for tau in settling}
    shapes = [_shape(f"{tau:g}", column, len(decays), tau_s=tau) for tau, column in decays.items()]
    checks["turn_on"] = _check(state, shapes, lambda best: dict(best.stated))
    steps = edges.scan(state.series, state.best)
    rows = steps.peaks(3, edges.EDGES_APART)
    begin_s = recording.start_s + blocks.begin / recording.rate_hz
    jumps = [replace(edges.shape(state, "step", (row,), steps), form=f"{row}") for row in rows]
    checks["jump"] = _check(state, jumps, lambda best: {"time_s": begin_s + (best.when or (0.0,))[0]}, drift=False)
    return checks


def _check(
    state: State, shapes: Sequence[Shape], stated: Callable[[Shape], dict[str, Any]], *, drift: bool = True
) -> dict[str, Any]:
    """The best of some shapes: its worth net of the search, and what is `stated` of it. It is worth nothing if it
    explains no `drift`: a drift must be clearly likelier than no drift, and with the shape a smaller drift."""
    trials = columns.tried(state, shapes, slow=True, least=SCREEN).values()
    best = max(trials, key=lambda trial: trial.net, default=None)
    shape, worth = (shapes[0], 0.0) if best is None else (best.shape, best.net)
    if worth > NET_LEAST and drift:
        full, *smaller = (
            max(float(state.scores([shape.columns], fit.shrunk(by))[0]) for fit in state.fits) for by in DRIFT_DIVISORS
        )
        none = fit_at(state.series, state.best.terms, state.best.shrunk(1e3).theta)  # within its limits
        drifts = state.best.ln_likelihood > none.ln_likelihood + CLEARLY
        worth = worth if drifts and max(smaller) > full + CLEARLY else 0.0
    passed = {"value": worth, "limit": NET_LEAST, "passed": worth <= NET_LEAST, "deviations": math.sqrt(2.0 * worth)}
    return {**passed, **stated(shape)}


def _shape(label: str, values: Array, looks: int, **stated: Any) -> Shape:
    """A column of a search among `looks` columns."""
    return Shape(label, values[None], (), (("coefficient", ""),), math.log(looks) + LN_SLOW, stated=stated)


def _state(blocks: Blocks, tables: Tables) -> tuple[State, int]:
    """The record about its mean, averaged to MEANS_MOST means at most, and the bank intervals in a mean."""
    cells = max(1, math.ceil(blocks.mean.size / MEANS_MOST))
    mean, used = half_means(blocks.mean - np.nanmean(blocks.mean), cells)
    r = block_means(blocks.r, cells) * cells / np.maximum(used, 1)
    return State("", "", mean, tables.dt_s * cells, 0.0, r, block=tables.block * cells), cells


def _channels(state: State, begin: int, block: int, recording: Recording, others: Sequence[str]) -> Iterator[Shape]:
    """Each recorded channel in its forms."""
    sides = {column for column, _ in SIDE_CHANNELS.values()}
    tried = [
        (column, form, values)
        for column in others
        for form, values in _forms(
            _means(recording.columns[column].values, recording, begin, block, state.y.size), state, column in sides
        )
    ]
    for k, (column, form, values) in enumerate(tried):
        yield _shape(f"{k}", values, len(tried), column=column, form=form)


def _forms(means: Array, state: State, side: bool) -> Iterator[tuple[str, Array]]:
    """The forms of a channel's `means` [n], a side channel's or another axis'; no form of a constant channel."""
    values, dt = bridged(np.where(np.isfinite(state.y), means, np.nan)), state.dt
    spread = float(values.std())
    if not (math.isfinite(spread) and spread > 0.0):
        return
    values = (values - values.mean()) / spread

    def smooth(values: Array) -> Array:
        return np.asarray(uniform_filter1d(values, max(1, round(SMOOTH_S / dt)), mode="nearest"))

    yield "static", smooth(values)
    for lag in LAGS_S:
        yield "lag", formed(values, "lag", lag, 0.0, dt)
    if side:
        yield "rate", slope(values, max(RATE_S, dt), dt) * RATE_S
        yield "square", smooth(values) ** 2
    else:
        yield "static", values
        yield "variance", smooth(np.nan_to_num(variance_of(values)))


def _means(values: Array, recording: Recording, begin: int, block: int, count: int) -> Array:
    """Means [count] of a column over whole blocks of the even grid from the place `begin` on, NaN where it has none."""
    place = recording.clock.place - recording.missing_before[0] - begin
    index = np.floor_divide(place, block)
    kept = (index >= 0) & (index < count)
    used = np.bincount(index[kept], minlength=count)
    total = np.bincount(index[kept], values[kept], minlength=count)
    return np.where(used > 0, total / np.maximum(used, 1), np.nan)
