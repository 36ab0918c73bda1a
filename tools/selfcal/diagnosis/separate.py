"""The next record that distinguishes rivals: which channel to cycle, how far, and how long.

A rival is a shape of the same axis. The first record leaves it a posterior: of the drift's size, of its numbers, and of
its coefficients. Records of a planned length are drawn from the posterior of either rival, and both are scored by what
they predict from the first record. The drift is free in this: a larger drift swallows a part of what a rival lacks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from scipy.special import logsumexp

from selfcal.base.grid import Array
from selfcal.diagnosis.record import FEWEST, Record
from selfcal.diagnosis.statistics import states_of
from selfcal.likelihood.columns import Shape, possible
from selfcal.likelihood.fit import Fit, Series, ln_likelihood, run
from selfcal.likelihood.state import FittedColumn, Look, State
from selfcal.likelihood.statemodel import Terms, matrices
from selfcal.logs.recording import SIDE_CHANNELS
from selfcal.model.forms import NUMBER, curved, formed, slope

#: Evidence that the next record shall have for the rival that is true, nats, in which share of how many drawn records.
NATS, SHARE, DRAWN = 10.0, 0.9, 40
#: ln of the sizes of the drift over its fitted size without either rival.
RIVAL_DRIFTS = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0)
#: Samples in the time of the first record, and the length of the longest planned record over it.
RECORD_SAMPLES, PLANNED_RATIO_MOST = 128, 4
#: Places of a rival's numbers, about.
RIVAL_PLACES = 9


@dataclass(frozen=True)
class RivalShape:
    """A shape as the first record leaves it: its columns at each place of its numbers, and for each drift and place the
    mean [d, p, k] and the information [d, p, k, k] of their coefficients, and the probability [d, p]."""

    columns: tuple[tuple[FittedColumn, ...], ...]
    mean: Array
    information: Array
    probability: Array


def next_record(look: Look, rivals: Sequence[Look], beside: State, record: Record) -> dict[str, Any] | None:
    """The shortest record by which a look differs from the rival that takes longest; None where it has no rival with a
    shape. `beside`: the model less the columns of the look. `duration_s` is None where no record suffices."""
    own = look.shape
    if own is None or not _planned(own):
        return None
    forms = [(f"{look.cause} ({own.form})", f"{look.cause} ({rival.form})", rival) for rival in look.rivals]
    causes = [(look.cause, rival.cause, rival.shape) for rival in rivals if rival.shape is not None]
    kept = [[pair for pair in pairs if _planned(pair[2]) and not _nested(own, pair[2])] for pairs in (causes, forms)]
    pairs = kept[0] or kept[1]
    if not pairs:
        return None
    beside = beside.refit()
    found = _known(own, beside)
    plans = [
        {**_shortest(found, _known(shape, beside), beside, record), "between": [name, other]}
        for name, other, shape in pairs
    ]
    return max(plans, key=lambda plan: plan["duration_s"] or 0.0)


def _planned(shape: Shape) -> bool:
    """Whether the values of its columns in a planned record are known."""
    entries = [regressor.entry for regressor in shape.regressors]
    return all(entry.get("kind") in ("time", "turn_on", "column") and "input" not in entry for entry in entries)


def _nested(a: Shape, b: Shape) -> bool:
    """Whether either shape is a case of the other: no record is evidence against a coefficient that may be 0."""
    names = [{regressor.name for regressor in shape.regressors} for shape in (a, b)]
    return names[0] < names[1] or names[1] < names[0]


def _known(shape: Shape, state: State) -> RivalShape:
    """A shape by the first record."""
    points, _ = possible(state, shape)
    shapes = shape.near(np.exp(points[:: 1 + len(points) // RIVAL_PLACES])) if shape.numbers else [shape]
    blocks = [np.array([column.values for column in shape.regressors]) for shape in shapes]
    drifts = [state.best.shrunk(-size) for size in RIVAL_DRIFTS]
    sums = [list(state.beside(drift.terms, drift.theta, blocks)) for drift in drifts]
    mean = np.array([[sums_of.coefficients()[0] for sums_of in each] for each in sums])
    G = np.array([[sums_of.G[1:, 1:] * sums_of.n / sums_of.coefficients()[2] for sums_of in each] for each in sums])
    known = np.all(np.diagonal(G, axis1=2, axis2=3) > 0.0, axis=2)  # else the model has the column
    unit = np.eye(mean.shape[-1])
    information = np.where(np.expand_dims(known, (2, 3)), G * (1.0 + 1e-9 * unit), unit)
    ln_weight = np.array([[ln_likelihood(sums_of) for sums_of in each] for each in sums])
    ln_weight = np.where(known, ln_weight - 0.5 * np.linalg.slogdet(information)[1], -math.inf)
    return RivalShape(
        tuple(shape.regressors for shape in shapes), mean, information, np.exp(ln_weight - logsumexp(ln_weight))
    )


def _shortest(a: RivalShape, b: RivalShape, state: State, record: Record) -> dict[str, Any]:
    """The shortest record that distinguishes two rivals, with the smallest cycle that suffices in the time of the first
    record. A cycle takes a quarter of that time or more: of faster changes the first record says little."""
    causes = {name: cause for cause, name in record.channel_names.items()}
    taken = {
        str(regressor.entry["column"])
        for rival in (a, b)
        for regressor in rival.columns[0]
        if "column" in regressor.entry
    }
    drives = [name for name in causes if name in taken] if taken <= set(causes) else []
    span = record.present.size / record.rate_hz
    plan: dict[str, Any] = {"drive": None, "amplitude": None, "unit": None, "period_s": None, "duration_s": None}
    plan |= {"between": [], "expected_nats": 0.0}
    for wider in (0.5, 1.0, 2.0, 4.0) if drives else (0.0,):
        for drive, period_s in product(drives or [""], (span, span / 2.0, span / 4.0) if drives else (span,)):
            swing = float(f"{wider * float(np.ptp(record.channels[causes[drive]])):.1e}") if drive else 0.0
            white, ln_variance = _drawn(a, b, state, record, drive, swing, period_s)
            for share in (1, 2, 3, 4, 6, 8, 12, 16, 24, 32):
                duration_s = share * (period_s if drive else span / 8.0)
                if duration_s * record.rate_hz < FEWEST:
                    continue
                if duration_s > PLANNED_RATIO_MOST * span or duration_s >= (plan["duration_s"] or math.inf):
                    break
                samples = round(RECORD_SAMPLES * duration_s / span)
                nats = _differences(a, b, white[:, :samples], ln_variance[:, :samples])
                least = float(nats.mean(axis=1).min())
                if np.mean(nats >= NATS, axis=1).min() < SHARE:
                    plan["expected_nats"] = plan["expected_nats"] if plan["duration_s"] else least
                    continue
                plan |= {"duration_s": duration_s, "expected_nats": least}
                if drive:
                    unit = SIDE_CHANNELS[causes[drive]][1]
                    plan |= {"drive": causes[drive], "amplitude": swing, "unit": unit, "period_s": period_s}
                break
        if plan["duration_s"] and plan["duration_s"] <= span:
            break
    return plan


def _drawn(
    a: RivalShape, b: RivalShape, state: State, record: Record, drive: str, swing: float, period_s: float
) -> tuple[Array, Array]:
    """The longest record in which a channel is cycled and the others are held, [d, n, 1 + m + 2 DRAWN]: a level, the
    columns of both rivals, and readings drawn under each, behind the filter of every drift; ln of their variances [d,
    n]. The part stays switched on after the first record."""
    span = record.present.size / record.rate_hz
    dt = span / RECORD_SAMPLES
    n = PLANNED_RATIO_MOST * RECORD_SAMPLES
    passed = (np.arange(n) + 0.5) * dt
    random = np.random.default_rng(1)
    held = {name: record.channels[cause] for cause, name in record.channel_names.items()}
    values = {name: np.full(n, 0.5 * (values.min() + values.max())) for name, values in held.items()}
    if drive:
        values[drive] -= 0.5 * swing * np.cos(2.0 * math.pi * passed / period_s)
    for name, other in record.axes.items():  # an axis at rest is its own noise
        steps = random.standard_normal((2, n)) * [[other.best.N / math.sqrt(dt)], [other.best.K * math.sqrt(dt)]]
        values[name] = steps[0] + steps[1].cumsum()
    t = np.asarray(passed + (record.since_power_on_s + record.start_s + span), np.float64)
    rows = [
        np.array([[_column(regressor, values, t, dt) for regressor in each] for each in rival.columns])
        for rival in (a, b)
    ]
    drifts = [_drift(state.best.shrunk(-size), dt) for size in RIVAL_DRIFTS]
    readings = []
    for rival, columns in zip((a, b), rows, strict=True):
        p = rival.probability
        for chosen in random.choice(p.size, DRAWN, p=p.ravel()):
            d, place = divmod(int(chosen), p.shape[1])
            spread = np.linalg.inv(np.linalg.cholesky(rival.information[d, place])).T
            c = rival.mean[d, place] + spread @ random.standard_normal(len(spread))
            readings.append(c @ columns[place] + _noise(drifts[d], dt, n, random))
    series = Series(
        np.zeros(n), dt, np.ones(n), np.vstack([np.ones(n), *(block.reshape(-1, n) for block in rows), *readings])
    )
    passes = [(run(series, terms, theta, innovations=True), sigma) for terms, theta, sigma in drifts]
    white = np.array([white[:, 1:] / sigma for (_, white, _), sigma in passes])
    return white, np.array([np.log(s * sigma**2) for (_, _, s), sigma in passes])


def _noise(drift: tuple[Terms, Array, float], dt: float, n: int, random: np.random.Generator) -> Array:
    """[n]: white noise and a drift."""
    terms, theta, sigma = drift
    states = states_of(matrices(terms, theta, dt, n * dt), np.ones(n), random)
    return np.asarray(sigma * (random.standard_normal(n) + states))


def _column(column: FittedColumn, values: Mapping[str, Array], t: Array, dt: float) -> Array:
    """[n]: a column of the model file in a record with these channels, `t` s from power-on."""
    entry = column.entry
    if entry["kind"] == "turn_on":
        return np.exp(-t / float(entry["tau_s"]))
    if entry["kind"] == "time":
        return np.asarray(t - t.mean())
    channel, form = values[str(entry["column"])], str(entry.get("form", "static"))
    if form == "free":
        return curved(channel, entry["knots"])
    if form == "rate":
        return slope(channel, float(entry["window_s"]), dt)
    return formed(channel, form, float(entry.get(NUMBER.get(form, ""), math.nan)), float(entry["reference"]), dt)


def _drift(at: Fit, dt: float) -> tuple[Terms, Array, float]:
    """The drift of a fit at samples of `dt` s: its terms, their parameters, and the white noise of a sample."""
    terms = replace(at.terms, color="", bands=())
    theta = np.array([at.value(name) for name in terms.names]) + math.log(dt / at.dt) * terms.growth
    return terms, theta, (at.N_of_color if at.terms.color else at.N) / math.sqrt(dt)


def _differences(a: RivalShape, b: RivalShape, white: Array, ln_variance: Array) -> Array:
    """Evidence for the true rival over the other in the drawn records of `_drawn`, nats [2, DRAWN]."""
    G = white.transpose(0, 2, 1) @ white
    ln_det = ln_variance.sum(axis=1) + np.log(G[:, 0, 0])
    G = G - G[:, :, :1] * G[:, :1, :] / G[:, :1, :1]  # less the bias
    first = a.mean.shape[1] * a.mean.shape[2]
    squares = np.diagonal(G, axis1=1, axis2=2)[:, -2 * DRAWN :] + ln_det[:, None]
    scores = []
    for rival, begin in ((a, 1), (b, 1 + first)):
        _, count, k = rival.mean.shape
        at = begin + np.arange(count * k).reshape(count, k)
        both = rival.information + G[:, at[:, :, None], at[:, None, :]]
        v = (rival.information @ rival.mean[..., None]) + G[:, at, -2 * DRAWN :]
        gain = (v * np.linalg.solve(both, v)).sum(axis=2)
        gain -= (rival.mean * (rival.information @ rival.mean[..., None])[..., 0]).sum(axis=2)[..., None]
        gain += (np.linalg.slogdet(rival.information)[1] - np.linalg.slogdet(both)[1])[..., None]
        ln = 0.5 * (gain - squares[:, None])
        scores.append(logsumexp(ln, axis=(0, 1), b=rival.probability[..., None]).reshape(2, DRAWN))
    return np.array([scores[0][0] - scores[1][0], scores[1][1] - scores[0][1]])
