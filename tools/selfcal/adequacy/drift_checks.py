"""Checks of the drift: does the law take another axis, a side channel, a jump, or settling after power-on for drift?

A walk follows nearly anything slow, so its innovations hide the cause. Each candidate is a column beside the bias. The
record's likelihood is taken with it and without, at the laws' posterior medians and at smaller drifts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from selfcal.bank.blocks import Blocks
from selfcal.bank.result import AxisResult
from selfcal.base.grid import block_means, half_means
from selfcal.likelihood.fit import Series, run, shifts
from selfcal.likelihood.state import net
from selfcal.likelihood.statemodel import ALPHA_LIMITS, SIZE_LIMITS, Array, Terms
from selfcal.logs.recording import SIDE_CHANNELS, Recording, bridged
from selfcal.model.forms import formed, slope, variance_of
from selfcal.model.laws import Law
from selfcal.model.tables import Tables

#: A check fails from this worth on, nats: as seldom as one at four standard deviations (checks.py), searches counted.
LEAST = 9.67
#: Drifts at which the likelihoods are taken: the medians' size over e to these.
SIZES = (0.0, 0.7, 1.5, 3.0, 4.5)
#: A drift that is known from few of its own turns leaves slow columns a longer tail (diagnosis/forms.py).
LN_SLOW = 1.8
#: A jump is looked for where the record has this share of the information about the best known one.
KNOWN = 0.05
#: Nats by which a smaller drift must be the likelier one beside a column.
CLEARLY = 3.0
#: Intervals that are looked at; longer records are averaged further. Fewer show no drift.
MOST, FEWEST = 4000, 60
#: Smoothing and lags of a side channel and of another axis, s: a channel's own noise hides its slow change.
SMOOTH_S, SIDE_LAGS_S, AXIS_LAGS_S, RATE_S = (10.0, 30.0), (20.0, 120.0, 600.0), (5.0, 30.0), 60.0
#: Time constants of a settling, shares of the record.
SETTLING = (0.005, 0.015, 0.05, 0.15)


@dataclass(frozen=True)
class Candidate:
    """A column [m] that may explain a drift, by the channel's name and its form."""

    column: str
    form: str
    values: Array


def drift_checks(
    blocks: Blocks, tables: Tables, result: AxisResult, recording: Recording, others: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """`channel`: which of the columns `others` explains most of the record, its `form`, and the evidence net of the
    search, nats. `turn_on`: the same of a bias that settles, by `tau_s`. `jump`: of one that jumps, at `time_s` of the
    recording. Nothing where the record is too short, and where the likeliest law is no simple one: then the simple ones
    leave a drift that any column may take."""
    series, cells = _series(blocks, tables)
    drifts = list(_drifts(result, tables, series.dt))
    likeliest = max(result.probability, key=lambda law: result.probability[law])
    if (
        series.n < FEWEST
        or not drifts
        or not any(_simple(one.law) and one.name == likeliest for one in tables.hypotheses)
    ):
        return {}
    channels = list(_candidates(series, blocks.begin, tables.block * cells, recording, others))
    settling = [share * series.y.size for share in SETTLING]
    columns = [one.values for one in channels] + [np.exp(-np.arange(series.y.size) / tau) for tau in settling]
    more = series.beside(np.array(columns))
    none, beside, jumps = (
        np.array(each) for each in zip(*(_at(more, terms, theta) for terms, theta, _ in drifts), strict=True)
    )
    less = np.array([by for *_, by in drifts])
    drifting = bool(none[np.isfinite(less)].max(initial=-math.inf) > none[~np.isfinite(less)].max(initial=-math.inf))

    def strongest(places: slice) -> tuple[int, float]:
        """Of some columns the one that gains most, and how much if the drift beside it is clearly smaller, else 0."""
        full, smaller = (beside[where, places].max(axis=0, initial=-math.inf) for where in (less == 0.0, less > 0.0))
        at = int(np.maximum(full, smaller).argmax())
        return at, float(smaller[at] - none.max()) if drifting and smaller[at] > full[at] + CLEARLY else 0.0

    checks = {}
    if channels:
        at, gain = strongest(slice(len(channels)))
        told = {"column": channels[at].column, "form": channels[at].form}
        checks["channel"] = {**_outcome(gain, len(channels)), **told}
    at, gain = strongest(slice(len(channels), None))
    checks["turn_on"] = {**_outcome(gain, len(settling)), "tau_s": settling[at] * series.dt}
    gains = jumps.max(axis=0) - none.max()
    begin_s = recording.start_s + blocks.begin / recording.rate_hz
    checks["jump"] = {**_outcome(float(gains.max()), series.n), "time_s": begin_s + int(gains.argmax()) * series.dt}
    return checks


def _outcome(gain: float, looks: int) -> dict[str, Any]:
    """A gain net of the search among so many, and of the longer tail that an uncertain drift leaves slow columns."""
    worth = net(gain, 1, math.log(looks) + LN_SLOW)
    return {"value": worth, "limit": LEAST, "passed": worth <= LEAST, "deviations": math.sqrt(2.0 * worth)}


def _at(series: Series, terms: Terms, theta: Array) -> tuple[float, Array, Array]:
    """ln likelihood of the record at one drift, with each column beside the first one [p - 1], and with a jump at each
    sample [n]. -inf where the record does not show the column."""
    (sums,), _, _ = run(series, terms, theta)
    G = sums.G / sums.G[0, 0]
    about = G - np.outer(G[:, 1], G[1]) / G[1, 1]  # beside the bias
    size, left = np.diag(about)[2:], about[0, 0]
    explained = about[2:, 0] ** 2 / np.where(size > 1e-9 * np.diag(G)[2:], size, math.inf)
    found = shifts(replace(series, columns=series.columns[:1]), terms, theta)
    A, B = found.A - found.B[:, 1] ** 2 / sums.G[1, 1], found.B[:, 0] - found.B[:, 1] * sums.G[0, 1] / sums.G[1, 1]
    known = np.where(found.A.max() * KNOWN < A, A, math.inf)
    jumps = B**2 / known / sums.G[0, 0]

    def value(explained: Array) -> Array:
        rss = np.maximum(left - explained, 1e-12 * left) * sums.G[0, 0]
        return np.asarray(-0.5 * (sums.n * (np.log(2.0 * math.pi * rss / sums.n) + 1.0) + sums.D))

    return float(value(np.zeros(1))[0]), value(explained), value(jumps)


def _series(blocks: Blocks, tables: Tables) -> tuple[Series, int]:
    """The record about its mean, averaged over so many bank intervals that it is short enough."""
    y, m = blocks.mean - np.nanmean(blocks.mean), blocks.mean.size
    cells = max(1, math.ceil(m / MOST))
    count = m // cells
    mean, used = half_means(y, cells)
    r = block_means(blocks.r, cells) * cells / np.maximum(used, 1)
    return Series(mean, tables.dt_s * cells, r, np.ones((1, count)), block=tables.block * cells), cells


def _simple(law: Law) -> bool:
    """Whether a law is white noise and one open term at most, no oscillation."""
    terms = law.terms
    return (
        not law.coloured_noise and len(terms) < 2 and not any(one.kind == "oscillation" or one.stated for one in terms)
    )


def _drifts(result: AxisResult, tables: Tables, dt: float) -> Iterator[tuple[Terms, Array, float]]:
    """Each law of one open term or none, at its posterior medians and smaller by exp() of the last; inf: no drift."""
    for one in tables.hypotheses:
        terms = one.law.terms
        if not _simple(one.law):
            continue
        at = {name: estimate.median for name, estimate in result.parameters[one.name].items()}
        if not all(math.isfinite(value) and value > 0.0 for value in at.values()):
            continue
        white = at["N"] / math.sqrt(dt)
        least = math.log(SIZE_LIMITS[0])
        if not terms:
            yield Terms(walk=True), np.array([least]), math.inf
            continue
        size = math.log(terms[0].deviation)
        if terms[0].kind == "walk":
            size += math.log(at["K"] * math.sqrt(dt) / white)
            rest = []
        else:
            size += math.log(at["sigma_m"] / white)
            rest = [math.log(float(np.clip(at["alpha"] * terms[0].bandwidth, *ALPHA_LIMITS)))]
        for less in SIZES:
            yield Terms(walk=not rest, markov=bool(rest)), np.array([max(size - less, least), *rest]), less


def _candidates(
    series: Series, begin: int, block: int, recording: Recording, others: Sequence[str]
) -> Iterator[Candidate]:
    """Each recorded channel in its forms."""
    dt = series.dt
    sides = {column for column, _ in SIDE_CHANNELS.values()}
    for column in others:
        means = _means(recording.columns[column].values, recording, begin, block, series.y.size)
        values = bridged(np.where(np.isfinite(series.y), means, np.nan))
        spread = float(values.std())
        if not (math.isfinite(spread) and spread > 0.0):
            continue
        values = (values - values.mean()) / spread
        side = column in sides
        plain = _smoothed(values, SMOOTH_S[0] / dt) if side else values
        yield Candidate(column, "static", plain)
        for lag in SIDE_LAGS_S if side else AXIS_LAGS_S:
            yield Candidate(column, "lag", formed(values, "lag", lag, 0.0, dt))
        if side:
            yield Candidate(column, "rate", slope(values, max(RATE_S, dt), dt) * RATE_S)
            yield Candidate(column, "square", plain**2)
        else:
            yield Candidate(column, "static", _smoothed(values, SMOOTH_S[1] / dt))
            yield Candidate(column, "variance", _smoothed(np.nan_to_num(variance_of(values)), SMOOTH_S[1] / dt))


def _means(values: Array, recording: Recording, begin: int, block: int, count: int) -> Array:
    """Means [count] of a column over whole blocks of the even grid from the place `begin` on, NaN where it has none."""
    if not recording.missing_before.any():
        return block_means(values[begin : begin + count * block], block)
    place = np.arange(values.size) + np.cumsum(recording.missing_before) - recording.missing_before[0] - begin
    index = np.floor_divide(place, block)
    kept = (index >= 0) & (index < count)
    used = np.bincount(index[kept], minlength=count)
    total = np.bincount(index[kept], values[kept], minlength=count)
    return np.where(used > 0, total / np.maximum(used, 1), np.nan)


def _smoothed(values: Array, window: float) -> Array:
    """Centred mean over `window` samples, of fewer near the ends."""
    half = round(0.5 * window)
    total, at = np.append(0.0, np.cumsum(values)), np.arange(values.size)
    low, high = np.maximum(at - half, 0), np.minimum(at + half + 1, values.size)
    return np.asarray((total[high] - total[low]) / (high - low))
