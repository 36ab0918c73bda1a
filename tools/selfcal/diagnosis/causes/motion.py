"""A sensor in the hand: stretches far louder than the rest of the record, on any axis, found before any fit.

A fit to a record with such a stretch is no model of the rest. The look takes medians of short blocks against the
minutes about them, so single wild samples, jumps that stay, slow warm-ups and changes of the noise that last are none.
`integrity.motion` finds the quieter ones afterwards, by energy that several axes share.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter
from scipy.stats import binom

from selfcal.diagnosis.cause import A_COUNT, Cause, Key, is_count, shown
from selfcal.diagnosis.state import NET_LEAST, Look, State
from selfcal.diagnosis.statemodel import Array, Mask
from selfcal.recording import bridged

#: Length of a block, s; with fewer samples than `BLOCK_LEAST` in it each sample is a block: no median leaves one out.
BLOCK_S, BLOCK_LEAST = 0.25, 5
#: The minutes about a block that its level and its noise are compared with, s. What lasts longer than half is no motion
#: but the record's own. At either end of the record they lie on one side.
AROUND_S = 240.0
#: A block is loud from so many times the usual deviation of level or spread on: of 10^6 normal blocks none is.
LOUD = 8.0
#: The usual deviation is at least this share of the record's own, so that a still stretch makes no other one loud.
STILL = 0.5
#: Loud blocks closer than this are one stretch, s; it begins and ends so much beyond them, s.
APART_S, MARGIN_S = 2.0, 0.5
#: A stretch holds so many loud samples at least, and in this share of its blocks the level leaps or the spread is loud:
#: two jumps of the bias are still between. In a stretch this short, s, two such blocks are enough: in, and out.
SAMPLES_LEAST, ROUGH_LEAST, SHORT_S = 3, 0.2, 5.0
#: More than this share of a record is no exception.
SHARE_MOST = 0.25
#: Deviations beyond this count no more: the evidence of a stretch is certain long before.
DEVIATION_MOST = 100.0

Interval = tuple[int, int]


@dataclass(frozen=True)
class Moved:
    """Motion of one axis: its stretches of samples [first, end) in order, their `nats` over rest, and those `net` of
    the search."""

    intervals: tuple[Interval, ...]
    nats: float
    net: float


def handled(axes: Mapping[str, State], rate_hz: float) -> tuple[dict[str, Moved], Mask]:
    """The axes that show loud stretches, and the samples [n] in which any does."""
    found = {name: one for name, state in axes.items() if (one := loud(state, rate_hz)) is not None}
    mask = np.zeros(max((state.y.size for state in axes.values()), default=0), bool)
    for one in found.values():
        for a, b in one.intervals:
            mask[a:b] = True
    return found, mask


def look_of(parts: Sequence[Moved], rate_hz: float) -> Look:
    """The finding of one axis."""
    intervals = [[a / rate_hz, b / rate_hz] for a, b in joined([each for one in parts for each in one.intervals])]
    nats, worth = sum(one.nats for one in parts), sum(one.net for one in parts)
    return Look("motion", nats, worth, {"intervals": intervals}, {}, when=(intervals[0][0], intervals[-1][1]))


def loud(state: State, rate_hz: float) -> Moved | None:
    """The stretches in which the readings of one axis are far louder than in the minutes about them. O(n)."""
    level, spread, block = _blocks(state.y, rate_hz)
    known = np.isfinite(level)
    around = min(max(9, round(AROUND_S * rate_hz / block)), level.size // 3) | 1
    if known.sum() < 3 * around // 2:
        return None
    level = bridged(level)
    leap = np.abs(np.diff(level, prepend=level[0]))
    sizes = [np.abs(level - _middle(level, around))]
    rough = _over(leap, around, state.lsb)
    if block > 1:
        sizes.append(bridged(spread))
        rough = np.maximum(rough, _over(sizes[1], around, state.lsb))
    away = np.max([_over(size, around, state.lsb) for size in sizes], axis=0)
    apart = max(2, round(APART_S * rate_hz / block))
    # Still blocks on another level, before a jump or behind it, are no part of a stretch.
    far = known & (away > LOUD) & maximum_filter1d(rough > LOUD, 2 * apart + 1)
    runs = _runs(far, apart)
    chance = max(1, len(runs)) / level.size
    margin = max(1, round(MARGIN_S * rate_hz))
    found: list[Interval] = []
    nats = 0.0
    for a, b in runs:
        count, leaps = int(far[a:b].sum()), int((rough[a : b + 1] > LOUD).sum())
        rare = float(binom.logsf(count - 1, b - a, chance)) + math.log(level.size) < -NET_LEAST
        shaken = leaps >= (2 if (b - a) * block <= SHORT_S * rate_hz else ROUGH_LEAST * (b - a))
        if rare and count * block >= SAMPLES_LEAST and shaken and _louder(sizes, far, a, b, around // 2):
            square = np.minimum(away[a:b][far[a:b]], DEVIATION_MOST) ** 2
            nats += 0.5 * float((square - 1.0 - np.log(square)).sum())
            found.append((max(0, a * block - margin), min(state.y.size, b * block + margin)))
    intervals = joined(found)
    if not found or sum(b - a for a, b in intervals) > SHARE_MOST * state.y.size:
        return None
    return Moved(tuple(intervals), nats, nats - len(found) * math.log(level.size))


def _louder(sizes: list[Array], far: Mask, a: int, b: int, around: int) -> bool:
    """Whether the blocks from `a` to `b` are loud against the time before and the time after them, by one measure."""
    sides = [slice(max(0, a - around), a), slice(b, b + around)]
    return any(
        all(
            float(np.median(size[a:b][far[a:b]])) > LOUD * float(np.median(size[side])) / 0.6745
            for side in sides
            if size[side].size > around // 24
        )
        for size in sizes
    )


def _blocks(y: Array, rate_hz: float) -> tuple[Array, Array, int]:
    """Median and median deviation of each block, NaN where half of it is missing, and the samples of a block."""
    block = round(BLOCK_S * rate_hz)
    if block < BLOCK_LEAST:
        return y, np.zeros(0), 1
    rows = y[: y.size // block * block].reshape(-1, block)
    missing = ~np.isfinite(rows)
    bare = 2 * missing.sum(axis=1) > block
    # Missing samples of a block that counts lie to either side in turn: they move no median.
    filled = np.where(missing, np.where(np.cumsum(missing, axis=1) % 2 == 0, np.inf, -np.inf), rows)
    level = np.where(bare, np.nan, np.median(np.where(bare[:, None], 0.0, filled), axis=1))
    off = np.where(missing, np.nan, np.abs(rows - level[:, None]))
    spread = np.where(bare, np.nan, np.nanmedian(np.where(bare[:, None], 0.0, off), axis=1))
    return level, spread, block


def _middle(values: Array, around: int) -> Array:
    """Running median over `around` values; at the ends that of the first and the last so many."""
    half = around // 2
    middle: Array = median_filter(values, around, mode="nearest")
    middle[:half], middle[values.size - half :] = middle[half], middle[values.size - half - 1]
    return middle


def _over(values: Array, around: int, lsb: float) -> Array:
    """Deviations over the usual ones about them, as of a normal's."""
    usual = _middle(values, around) / 0.6745
    own = float(np.median(values[values > 0.0])) / 0.6745 if (values > 0.0).any() else 0.0
    return values / np.maximum(np.maximum(usual, STILL * own), max(lsb, 1e-300))


def _runs(far: Mask, apart: int) -> list[Interval]:
    """Runs of true values, those closer than `apart` joined."""
    at = np.flatnonzero(far)
    if not at.size:
        return []
    cut = np.flatnonzero(np.diff(at) > apart)
    first, last = np.append(at[0], at[cut + 1]), np.append(at[cut], at[-1])
    return [(int(a), int(b) + 1) for a, b in zip(first, last, strict=True)]


def joined(intervals: list[Interval]) -> list[Interval]:
    """In order of time, those that touch made one."""
    found: list[Interval] = []
    for a, b in sorted(intervals):
        if found and a <= found[-1][1]:
            found[-1] = (found[-1][0], max(b, found[-1][1]))
        else:
            found.append((a, b))
    return found


def _seconds(value: float) -> str:
    return f"{value:.4f}".rstrip("0").rstrip(".")


def _of_estimate(look: Look) -> dict[str, Any]:
    return {"intervals": "+".join(f"{_seconds(a)}-{_seconds(b)}" for a, b in look.estimate["intervals"])}


CAUSE = Cause(
    "motion",
    "The sensor was moved or shaken while it should have rested.",
    "Record on a heavy table, away from traffic.",
    alike=lambda a, b: True,
    once="motion is an event of its recording",
    pictures=shown("largest", "fine_level"),
    of_estimate=_of_estimate,
    keys={
        "intervals": Key(lambda s: 5, "motion_intervals", is_count, A_COUNT),
        "amplitude": Key(lambda s: 20.0 * s.sd, "motion_amplitude"),
    },
)
