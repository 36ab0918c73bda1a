"""A sensor in the hand, or knocked: stretches of one axis far louder than the rest of its record, found before any fit.

A fit to a record with such a stretch is no model of the rest. The look takes medians of short blocks against the
minutes about them, so single wild samples, jumps that stay, slow warm-ups and changes of the noise that last are none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, median_filter
from scipy.special import bdtrc

from selfcal.logs.recording import bridged

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

#: Lengths of a block, s: a knock is short, and a hand that turns slowly shows in long ones alone. With fewer samples
#: than `BLOCK_LEAST` in it each sample is a block: no median leaves one out.
BLOCKS_S, BLOCK_LEAST = (0.1, 0.5), 5
#: The minutes about a block that its level and its noise are compared with, s. What lasts longer than half is no motion
#: but the record's own. At either end of the record they lie on one side.
AROUND_S = 240.0
#: Pieces of these minutes at least, where there are as many blocks: a running median needs no more.
PIECES = 240
#: A block is loud from so many times the usual deviation of its level on: of 10^6 normal blocks none is. Or from so
#: many times the usual noise within it on, in a longer stretch of more: noise changes by itself.
LOUD, LOUD_WITHIN, LOUD_LASTING = 8.0, 7.0, 12.0
#: The usual deviation is at least this share of the record's own, so that a still stretch makes no other one loud.
STILL = 0.5
#: Loud blocks closer than this are one stretch, s; it begins and ends so much beyond them, s.
APART_S, MARGIN_S = 2.0, 0.5
#: A stretch this close to an end of the record reaches it, s: hands began before it, or ended after.
EDGE_S = 5.0
#: A stretch holds so many loud samples at least, and in this share of its blocks the level leaps or the spread is loud:
#: two jumps of the bias are still between. In a stretch this short, s, two such blocks are enough: in, and out.
SAMPLES_LEAST, ROUGH_LEAST, ROUGH_COUNT, SHORT_S = 3, 0.2, 4, 5.0
#: Of the leaps of a stretch so much goes back at least: a jump and a transient go one way.
BACK_LEAST = 0.1
#: So many stretches on one level, alike to this share of it, or a long one, are a bias with two levels.
ALIKE_LEAST, ALIKE = 2, 0.2
#: Probability, a record, that samples which are loud by chance make a stretch.
CHANCE = 1e-5
#: More than this share of a record is no exception.
SHARE_MOST = 0.25
#: Deviations beyond this count no more: the evidence of a stretch is certain long before.
DEVIATION_MOST = 100.0
#: Median absolute deviation of a normal with the standard deviation 1.
MEDIAN_SD = 0.6745

Interval = tuple[int, int]
Time = TypeVar("Time", int, float)


@dataclass(frozen=True)
class Moved:
    """Motion of one axis: begin and end of its stretches in order, s, their `nats` over rest, and those `net` of the
    search."""

    intervals: tuple[tuple[float, float], ...]
    nats: float
    net: float


def loud(y: Array, rate_hz: float, lsb: float = 0.0) -> Moved | None:
    """The stretches in which readings [n] on an even grid, NaN where missing, are far louder than in the minutes about
    them. `lsb`: their lattice. O(n)."""
    block = round(BLOCKS_S[0] * rate_hz)
    block = block if block >= BLOCK_LEAST else 1
    level, noise = _blocks(y, block)
    found = _loud_blocks(y, rate_hz, lsb, block, level, noise)
    share = round(BLOCKS_S[1] * rate_hz / block)
    if share >= BLOCK_LEAST:
        found += _loud_blocks(y, rate_hz, lsb, block * share, *_blocks(level, share), knocks=False)
    intervals = joined([interval for interval, _ in found])
    if not found or sum(b - a for a, b in intervals) > SHARE_MOST * y.size:
        return None
    most = max(1, round(EDGE_S * rate_hz))
    intervals = [(a if a > most else 0, b if b < y.size - most else y.size) for a, b in intervals]
    # Blocks of several lengths show the same stretch: it counts once.
    nats = sum(max(nats for (a, b), nats in found if first <= a and b <= end) for first, end in intervals)
    times = tuple((a / rate_hz, b / rate_hz) for a, b in intervals)
    return Moved(times, nats, nats - len(intervals) * math.log(y.size))


def _loud_blocks(
    y: Array, rate_hz: float, lsb: float, block: int, level: Array, noise: Array, *, knocks: bool = True
) -> list[tuple[Interval, float]]:
    """Stretches and their nats by blocks of one length, which have a level and a noise. `knocks`: short ones too."""
    known = np.isfinite(level)
    around = min(max(9, round(AROUND_S * rate_hz / block)), level.size // 3) | 1
    if known.sum() < 3 * around // 2:
        return []
    level = bridged(level)
    leap = np.diff(level, prepend=level[0])
    sizes = [np.abs(level - _middle(level, around))]
    leaps = _over(np.abs(leap), around, lsb) > LOUD * math.sqrt(0.5)
    away = _over(sizes[0], around, lsb)
    rough = leaps
    if block > 1:
        sizes.append(bridged(noise))
        noise = _over(sizes[1], around, lsb) / MEDIAN_SD
        rough, away = leaps | (noise > LOUD_WITHIN), np.maximum(away, LOUD / LOUD_WITHIN * noise)
    apart = max(2, round(APART_S * rate_hz / block))
    # Still blocks on another level, before a jump or behind it, are no part of a stretch.
    far = known & (away > LOUD) & maximum_filter1d(rough, 2 * apart + 1)
    runs = _runs(far, apart)
    if not runs:
        return []
    wild = away > LOUD if block == 1 else _wild(y, level, sizes[1], around, block, lsb) if knocks else far
    begins = np.diff(wild, prepend=False) & wild
    margin = max(1, round(MARGIN_S * rate_hz))
    found: list[tuple[Interval, float]] = []
    moving = np.zeros(level.size, bool)
    for a, b in runs:
        knock = (b - a) * block <= SHORT_S * rate_hz
        if knock:
            own = slice(a * block, b * block)
            others = max(1, int(begins.sum()) - int(begins[own].sum()))
            rare = knocks and _rare(int(wild[own].sum()), (b - a) * block, others, y.size)
        else:
            rare = _rare(int(far[a:b].sum()), b - a, len(runs), level.size)
            rare = rare and not _alike(sizes[0][a:b][far[a:b]])
        within, least = (LOUD_WITHIN, 2.0) if knock else (LOUD_LASTING, max(ROUGH_COUNT, ROUGH_LEAST * (b - a)))
        inside = np.arange(a, b)[far[a:b]] if knock else np.arange(a, b)
        moved = leap[a : b + 1][leaps[a : b + 1]]
        back = min(moved.clip(min=0.0).sum(), -moved.clip(max=0.0).sum()) > BACK_LEAST * np.abs(moved).sum()
        shaken = (back or (noise[a:b] > within).sum() >= 2) and rough[a : b + 1].sum() >= least
        against = (LOUD / MEDIAN_SD if knock else LOUD_LASTING, within)
        if rare and shaken and far[a:b].sum() >= 2 and _louder(sizes, against, inside, around // 2):
            moving[a:b] = far[a:b]
            square = np.minimum(away[a:b][far[a:b]], DEVIATION_MOST) ** 2
            nats = 0.5 * float((square - 1.0 - np.log(square)).sum())
            found.append(((max(0, a * block - margin), min(y.size, b * block + margin)), nats))
    return [] if len(found) >= ALIKE_LEAST and _alike(sizes[0][moving]) else found


def _alike(levels: Array) -> bool:
    """Whether all the loud levels are as far away: a bias with two levels makes such stretches."""
    middle = float(np.median(levels))
    return float(np.median(np.abs(levels - middle))) < ALIKE * middle


def _rare(count: int, of: int, stretches: int, n: int) -> bool:
    """Whether `count` loud ones of `of` are no chance where `stretches` of them lie scattered among n."""
    return count >= SAMPLES_LEAST and n * float(bdtrc(count - 1, of, stretches / n)) < CHANCE


def _wild(y: Array, level: Array, spread: Array, around: int, block: int, lsb: float) -> Mask:
    """Samples [n] that are loud each by itself, against the level and the noise of the blocks about them."""
    usual = np.maximum(_middle(bridged(spread), around) / MEDIAN_SD, lsb)
    rows = y[: level.size * block].reshape(-1, block)
    wild = np.abs(rows - _middle(level, around)[:, None]) > LOUD_WITHIN * usual[:, None]
    return np.append(wild.ravel(), np.zeros(y.size - wild.size, bool))


def _louder(sizes: list[Array], leasts: tuple[float, float], inside: Rows, around: int) -> bool:
    """Whether the blocks `inside` are loud against the time before and the time after them, by one measure."""
    a, b = int(inside[0]), int(inside[-1]) + 1
    sides = [slice(max(0, a - around), a), slice(b, b + around)]
    return any(
        all(
            float(np.median(size[inside])) > least * float(np.median(size[side]))
            for side in sides
            if size[side].size > around // 24
        )
        for size, least in zip(sizes, leasts, strict=False)
    )


def _blocks(values: Array, share: int) -> tuple[Array, Array]:
    """Median of each block of `share` values, and their noise: the median of their steps over sqrt(2). A jump or a
    slope within a block is no noise. NaN where half of a block is missing; no noise of single values."""
    if share == 1:
        return values, np.full(values.size, np.nan)
    n = values.size // share * share
    steps = np.abs(np.diff(values[:n], prepend=values[0]))
    level, noise = _medians(values[:n], share), math.sqrt(0.5) * _medians(steps, share)
    return np.where(np.isfinite(noise), level, np.nan), np.where(np.isfinite(level), noise, np.nan)


def _medians(values: Array, share: int) -> Array:
    """Middle of each `share` values, the upper one of two; NaN where half of them are."""
    rows = values.reshape(-1, share)
    missing = np.isnan(rows)
    if not missing.any():
        return np.ascontiguousarray(np.partition(rows, share // 2, axis=1)[:, share // 2])
    # Missing ones lie to either side in turn: they move no median.
    beyond = np.where(np.cumsum(missing, axis=1) % 2 == 0, np.inf, -np.inf)
    middle = np.partition(np.where(missing, beyond, rows), share // 2, axis=1)[:, share // 2]
    return np.where(2 * missing.sum(axis=1) >= share, np.nan, middle)


def _middle(values: Array, around: int) -> Array:
    """Running median over `around` values, of many that of the medians of pieces; at the ends that of the first and
    the last so many."""
    piece = max(1, around // PIECES)
    coarse = _medians(values[: values.size // piece * piece], piece) if piece > 1 else values
    size = around // piece | 1
    half = size // 2
    middle: Array = median_filter(coarse, size, mode="nearest")
    middle[:half], middle[coarse.size - half :] = middle[half], middle[coarse.size - half - 1]
    if piece == 1:
        return middle
    middle = np.repeat(middle, piece)
    return np.append(middle, np.full(values.size - middle.size, middle[-1]))


def _over(values: Array, around: int, lsb: float) -> Array:
    """Deviations over the usual ones about them, as of a normal's."""
    usual = _middle(values, around) / MEDIAN_SD
    own = float(np.median(values[values > 0.0])) / MEDIAN_SD if (values > 0.0).any() else 0.0
    return values / np.maximum(np.maximum(usual, STILL * own), max(lsb, 1e-300))


def _runs(far: Mask, apart: int) -> list[Interval]:
    """Runs of true values, those closer than `apart` joined."""
    at = np.flatnonzero(far)
    if not at.size:
        return []
    cut = np.flatnonzero(np.diff(at) > apart)
    first, last = np.append(at[0], at[cut + 1]), np.append(at[cut], at[-1])
    return [(int(a), int(b) + 1) for a, b in zip(first, last, strict=True)]


def joined(intervals: Sequence[tuple[Time, Time]]) -> list[tuple[Time, Time]]:
    """In order of time, those that touch made one."""
    found: list[tuple[Time, Time]] = []
    for a, b in sorted(intervals):
        if found and a <= found[-1][1]:
            found[-1] = (found[-1][0], max(b, found[-1][1]))
        else:
            found.append((a, b))
    return found
