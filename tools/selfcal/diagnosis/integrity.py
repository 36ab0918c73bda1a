"""Findings that need little or no fit: missing samples, an unstated lattice, readings at a limit, motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.special import ndtr
from scipy.stats import chi2, poisson, truncnorm

from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import NET_LEAST, Look, State, interval
from selfcal.diagnosis.statemodel import Array, Mask

#: Missing samples are told of from this share on.
MISSING_LEAST = 1e-3
#: An unstated lattice is told of from this many white noise sd on.
LATTICE_LEAST = 0.5
#: Lengths of motion looked for, s, and the price of the search, ln of looks a window.
MOTION_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
#: A burst counts from this worth on, net of the search; several that each could be chance are none together.
BURST_LEAST = 2.5
#: All bursts together, nats net: more than for another cause, since lattices and drifts of several axes join in.
MOTION_LEAST = 11.0
#: What the axes beside the strongest must show, nats: an event of one axis meets chance on the others.
REST_PRICE = 4.0


def missing(record: Record) -> tuple[Look, Mask] | None:
    """Gaps in the stamps, and rows that repeat the one before: the logger held the last reading. The mask is those."""
    held = _held(record)
    gone = record.missing + int(held.sum())
    span = max(record.present.size, record.missing)
    where = np.flatnonzero(~record.present | held) / record.rate_hz
    if gone <= MISSING_LEAST * span or not where.size:
        return None
    look = Look(
        "missing_samples",
        float(gone),
        float(gone),
        {"missing": interval(float(gone), 0.0, "samples")},
        {},
        when=(float(where[0]), float(where[-1])),
    )
    return look, held


def _held(record: Record) -> Mask:
    """Rows all of whose axes repeat, where their lattices make fewer such rows by chance."""
    none = np.zeros(record.present.size, bool)
    repeats = []
    for state in record.axes.values():
        same = np.zeros(record.present.size, bool)
        same[1:] = np.diff(state.y) == 0.0
        repeats.append(same)
    if not repeats:
        return none
    held = np.all(repeats, axis=0)
    shares = [(float(same.sum()) - float(held.sum())) / same.size for same in repeats]
    expected = held.size * float(np.prod(np.maximum(shares, 1.0 / held.size)))
    # Chance repeats of coarse axes are not quite independent: three times the expectation.
    return held if poisson.logsf(int(held.sum()) - 1, 3.0 * expected + 0.05) < -NET_LEAST else none


def quantization(state: State) -> Look | None:
    """A lattice that the model file does not state and that is coarse against the white noise."""
    q = state.lsb
    stated = state.stated_lsb
    if q <= 0.0 or (stated > 0.0 and abs(q / stated - 1.0) < 0.02):
        return None
    sigma = state.best.sigma
    white = math.sqrt(max(sigma**2 - q * q / 12.0, 1e-12 * sigma**2))
    if q / white < LATTICE_LEAST:
        return None
    n = state.best.n
    # Continuous readings would fall within 1/1000 of a lattice by chance: ln 1000 nats each.
    gain = n * math.log(max(q / white, 1.0) * 10.0)
    return Look(
        "quantization",
        gain,
        gain,
        {"lsb": interval(q, q * 1e-3, state.unit)},
        {"stated_lsb": q},
    )


def saturation(state: State) -> tuple[Look, State] | None:
    """Readings pile up at the largest or the smallest value: the model expects some beyond it and none is.

    The expected number beyond is the evidence, in nats (Poisson). Clipped readings are then drawn anew from what the
    filter predicts beyond the limit, so that the rest is judged as if it had not been clipped."""
    y = state.y
    finite = np.isfinite(y)
    found = state
    sides: list[tuple[float, int]] = []
    gain = 0.0
    for sign in (1, -1):
        edge = float(np.nanmax(sign * y))
        at_edge = finite & (sign * y >= edge - 1e-9 * max(1.0, abs(edge)))
        if at_edge.sum() < 3:
            continue
        half = 0.5 * state.lsb
        predicted = sign * (y - state.whitened * np.sqrt(state.variance))
        beyond = ndtr((predicted - edge - half) / np.sqrt(state.variance))
        expected = float(np.nansum(beyond))
        # Unclipped, the expectation beyond the largest reading is itself distributed as exp(-x): either side is a look.
        if expected < NET_LEAST + math.log(2.0) or at_edge.sum() < 0.5 * expected:
            continue
        sides.append((sign * edge, int(at_edge.sum())))
        gain += expected
        found = _unclipped(found, at_edge, edge, sign)
    if not sides:
        return None
    limit = max(sides, key=lambda side: side[1])[0]
    count = sum(side[1] for side in sides)
    look = Look(
        "saturation",
        gain,
        gain,
        {
            "limit": interval(limit + state.level, state.lsb / 4.0 or 1e-6 * abs(limit + state.level), state.unit),
            "clipped": count,
        },
        {},
    )
    return look, found


def _unclipped(state: State, at_edge: Mask, edge: float, sign: int) -> State:
    random = np.random.default_rng(1)
    for _ in range(4):
        s = np.sqrt(state.variance[at_edge])
        predicted = sign * state.y[at_edge] - sign * state.whitened[at_edge] * s
        low = (edge - 0.5 * state.lsb - predicted) / s
        drawn = predicted + s * truncnorm.rvs(low, np.inf, random_state=random)
        y = state.y.copy()
        y[at_edge] = sign * drawn
        state = state.refit(y=y, redrawn=True)
    return state


def motion(record: Record) -> dict[str, tuple[Look, Mask]]:
    """Bursts of energy on two axes or more at once, 0.5 to 16 s long, against each axis' own level about it."""
    # On a lattice coarser than the noise a rare change of code looks like a burst.
    names = [name for name, state in record.axes.items() if state.lsb < 1.5 * state.best.sigma]
    if len(names) < 2:
        return {}
    n = record.present.size
    rate = record.rate_hz
    squares = []
    for name in names:
        w2 = np.where(np.isfinite(record.axes[name].whitened), record.axes[name].whitened ** 2, np.nan)
        filled = np.where(np.isfinite(w2), w2, 1.0)
        around = max(3, min(n // 3, round(120.0 * rate)))
        block = max(1, round(rate))
        level = _robust_level(filled, block, around)
        squares.append(np.minimum(filled / level, 25.0))
    power = np.array(squares)
    count = len(names)
    worth, half = np.zeros(n), np.zeros(n, np.int64)
    for length in MOTION_S:
        window = round(length * rate)
        if window < 1 or window > n // 4:
            continue
        mean = uniform_filter1d(power, window, axis=1, mode="reflect") if window > 1 else power
        gain = 0.5 * window * _excess(mean)
        # One axis alone is an outlier or a change of its own noise: the others together must show the burst too.
        strongest = gain.argmax(axis=0)
        rest = gain.sum(axis=0) - gain.max(axis=0)
        others = (mean.sum(axis=0) - np.take_along_axis(mean, strongest[None], axis=0)[0]) / (count - 1)
        # Windows a quarter of a length apart, of every length.
        ln_looks = math.log(4.0 * n / window) + math.log(len(MOTION_S))
        each = -chi2.logsf(2.0 * gain.sum(axis=0), count)  # a size of its own on every axis
        common = -chi2.logsf(window * count * _excess(mean.mean(axis=0)), 1)  # one size on all
        beside = np.maximum(-chi2.logsf(2.0 * rest, count - 1), -chi2.logsf(window * (count - 1) * _excess(others), 1))
        told = np.minimum(np.maximum(each, common) - math.log(2.0) - ln_looks, beside - REST_PRICE)
        better = told > worth
        worth[better], half[better] = told[better], (window + 1) // 2
    bursts: list[tuple[int, int]] = []
    total, left = 0.0, worth.copy()
    while left.max() > BURST_LEAST and len(bursts) < 1000:
        at = int(np.argmax(left))
        a, b = max(0, at - int(half[at])), min(n, at + int(half[at]) + 1)
        bursts.append((a, b))
        total += float(left[at])
        margin = max(1, round(2.0 * rate))
        left[max(0, a - margin) : b + margin] = 0.0
    if total < MOTION_LEAST or sum(b - a for a, b in bursts) > 0.25 * n:
        return {}
    joined = _joined_bursts(bursts, round(2.0 * rate))
    pad = max(1, round(0.5 * rate))
    mask = np.zeros(n, bool)
    for a, b in joined:
        mask[max(0, a - pad) : b + pad] = True
    found: dict[str, tuple[Look, Mask]] = {}
    for k, name in enumerate(names):
        worth_here = sum(_burst(power[k, a:b]) for a, b in joined)
        shown = [(a, b) for a, b in joined if _burst(power[k, a:b]) > 2.0]
        if not shown:
            continue
        look = Look(
            "motion",
            worth_here,
            total,
            {"intervals": interval(float(len(shown)), 0.0, "1")},
            {},
            when=(shown[0][0] / rate, shown[-1][1] / rate),
        )
        found[name] = (look, mask)
    return found if len(found) >= 2 else {}


def _joined_bursts(bursts: list[tuple[int, int]], apart: int) -> list[tuple[int, int]]:
    """In order of time; those closer than `apart` are one."""
    ordered = sorted(bursts)
    found = [ordered[0]]
    for a, b in ordered[1:]:
        if a - found[-1][1] < apart:
            found[-1] = (found[-1][0], max(b, found[-1][1]))
        else:
            found.append((a, b))
    return found


def _excess(mean: Array) -> Array:
    """Twice the gain, a sample, of a variance `mean` above the stated one."""
    return np.where(mean > 1.0, mean - 1.0 - np.log(np.maximum(mean, 1e-12)), 0.0)


def _burst(power: Array) -> float:
    return 0.5 * power.size * float(_excess(power.mean()))


def _robust_level(square: Array, block: int, around: int) -> Array:
    """Local level of squared innovations: the running median of block means, over its own median's ratio."""
    count = square.size // block
    if count < 8:
        return np.full(square.size, max(1e-9, float(np.median(square)) / 0.4549))
    means = square[: count * block].reshape(count, block).mean(axis=1)
    size = max(3, min(count, around // block) | 1)
    middle = median_filter(means, size, mode="reflect")
    # The median of a mean of `block` squares of normals, against its mean of 1 (Wilson and Hilferty).
    ratio = (1.0 - 2.0 / (9.0 * block)) ** 3
    level: Array = np.interp(np.arange(square.size), (np.arange(count) + 0.5) * block, middle / ratio)
    return np.maximum(level, 1e-9)


def masked(state: State, mask: Mask) -> State:
    """The state without the samples of `mask`."""
    y = state.y.copy()
    y[mask] = np.nan
    return replace(state, y=y)
