"""A sensor that moves, in the raw readings and before any fit: its energy against that of the time about it.

Energy is that of second differences of the readings and of short means, about a running median: ramps and jumps have
none. A window is compared with its louder side, at its own length. So noise that grows, breathes or stays loud is no
motion. At rest the mean of n squares exceeds r times its expectation with a probability below
exp(-n (r - 1 - ln r) / 2) (Chernoff). Axes are independent at rest: the sensor moves where those but the loudest are
louder together, or where one is so loud that no other window of its record is. A hand that turns slowly, or pushes,
shows in the level (`away`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter
from scipy.special import bdtrc, fdtrc, gammaincinv

from selfcal.base.grid import MEDIAN_SD, Array, Mask, Rows, block_means, runs
from selfcal.logs.recording import SIDE_CHANNELS, Recording, bridged
from selfcal.readings.budget import SHARES

Interval = tuple[int, int]
Time = TypeVar("Time", int, float)

#: Length of a piece, s, and pieces at most.
PIECE_S, PIECES_MOST = 0.1, 40_000
#: Lengths of the means whose differences are taken beside the readings', and of the blocks that hands are looked for
#: in, s: a knock is short, and a hand that turns slowly shows in long ones alone. Readings in one at least: with fewer
#: each sample is a block, as no median leaves one out.
BANDS_S, BAND_LEAST = (0.1, 0.5), 5
#: Standard deviations of the median about a wild reading at most, and of itself at least.
WILD = (3.0, 8.0)
#: Readings whose median is the level of the middle one: ramps, jumps and slow waves have no part in what is apart from
#: it. Squares of white noise about it in one degree of freedom.
LEVEL, SQUARES = 9, 1.29
#: Longest window, s. Its sides are so many times as long each, s at least, and squares at least.
WINDOW_S, SIDE, SIDE_S, SIDE_SQUARES = 32.0, 8, 10.0, 30
#: Probability, a record, that axes at rest move together, and that one moves alone.
SHARE = SHARES["motion"]
#: Share of its windows by which an axis' own loudness counts: of an axis alone at most the rest may be loud.
OWN = 0.9
#: Quantiles of the means of windows that show their spread without the loud ones: the median, and one sd below it.
QUIETER = (0.1587, 0.5)
#: Nats by which the search over windows costs all axes together less than as many windows apart: of 250 clean records
#: of 300 to 3600 s at 1 to 100 Hz the largest of one is 2.1 to 2.9 less in the median, and 2.4 to 3.7 in a tenth.
FEWER = 3.0
#: Part of the evidence that each of several stretches of all axes shows at least.
PART = 0.5
#: Nats from which on an axis is in a stretch of others: ln 20.
TOGETHER = 3.0
#: Least probability whose logarithm is taken.
TINY = 1e-300
#: Correlation of axes at rest from which on they share a source, beyond chance.
SHARED = 0.05
#: Standard deviations of a correlation by chance from which on axes depend on each other, and that of a copy.
CORRELATED, COPY = 5.0, 0.999

#: The minutes about a block that its level and its noise are compared with, s. What lasts longer than half is no motion
#: but the record's own. At either end of the record they lie on one side.
AROUND_S = 240.0
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
#: Deviations beyond this count no more: the evidence of a stretch is certain long before. No bias has such two levels.
DEVIATION_MOST = 100.0


@dataclass(frozen=True)
class Moved:
    """Motion of one axis: begin and end of its stretches in order, s, their `nats` over rest, and those `net` of the
    search."""

    intervals: tuple[tuple[float, float], ...]
    nats: float
    net: float


@dataclass(frozen=True)
class Energy:
    """Squares of axes over their variance, summed in pieces of `piece_s`: `sums` and `counts` [axes, bands, pieces], of
    single readings and of means of BANDS_S. `apart`: the readings of each axis about their level, over their noise [n],
    and the piece that each is in [n]."""

    piece_s: float
    sums: Array
    counts: Array
    apart: tuple[tuple[Array, Rows], ...]

    @cached_property
    def before(self) -> tuple[Array, Array]:
        """Sums and counts of all pieces before each one, and of all, [axes, bands, pieces + 1] each."""
        sums, counts = (np.pad(np.cumsum(one, axis=2), ((0, 0), (0, 0), (1, 0))) for one in (self.sums, self.counts))
        return sums, counts


@dataclass(frozen=True)
class Stretch:
    """Pieces from `begin` on and before `end` in which `axes` [axes] move; the `nats` of each [axes], and those `net`
    of the search."""

    begin: int
    end: int
    axes: Mask
    nats: Array
    net: float


def moves_of(recording: Recording) -> dict[str, Moved]:
    """By axis when the sensor moved, s from the first row. Looked at once."""
    seen: dict[str, Moved] = recording.seen.setdefault("motion", {})
    if not seen:
        channels = {column for column, _ in SIDE_CHANNELS.values()}
        names = [name for name in recording.columns if name not in channels]
        energy = energy_of(recording, names)
        found: dict[str, list[Stretch]] = {name: [] for name in names}
        for one in stretches(energy):
            for k in np.flatnonzero(one.axes).tolist():
                found[names[k]].append(one)
        for k, name in enumerate(names):
            times = joined([_times(energy, one, recording) for one in found[name]])
            nats = sum(float(one.nats[k]) for one in found[name])
            seen[name] = Moved(tuple(times), nats, sum(one.net for one in found[name]))
    return {name: one for name, one in seen.items() if one.intervals}


def _times(energy: Energy, one: Stretch, recording: Recording) -> tuple[float, float]:
    """Begin and end of a stretch, s, a margin more on either side."""
    begin, end, length_s = one.begin * energy.piece_s, one.end * energy.piece_s, recording.duration_s
    return begin - MARGIN_S if begin > EDGE_S else 0.0, end + MARGIN_S if end < length_s - EDGE_S else length_s


def energy_of(recording: Recording, names: Sequence[str]) -> Energy:
    """The energy of columns. O(n)."""
    clocks = [recording.clock_of(name) for name in names]
    length_s = max(float(clock.time_s[-1]) + 1.0 / clock.rate_hz for clock in clocks)
    piece_s = max(PIECE_S, 1.0 / max(clock.rate_hz for clock in clocks), length_s / PIECES_MOST)
    count = math.ceil(length_s / piece_s - 1e-6)
    sums, counts = np.zeros((2, len(names), 1 + len(BANDS_S), count))
    there = [np.isfinite(recording.columns[name].values) for name in names]
    tame = [_tame(recording.columns[name].values[each]) for name, each in zip(names, there, strict=True)]
    scaled_rows = [_scaled(own) for own, _ in tame]
    rows = _apart_from_each_other([own for own, _ in tame], scaled_rows)
    readings = []
    for k, (clock, own) in enumerate(zip(clocks, rows, strict=True)):
        time = clock.time_s[there[k]]
        for band, size in enumerate([1, *(round(band_s * clock.rate_hz) for band_s in BANDS_S)]):
            if band and not BAND_LEAST <= size <= own.size // SIDE_SQUARES:
                continue
            means, at = block_means(own, size), block_means(time, size)
            scaled = _scaled(means)
            piece = np.minimum((at[: scaled.size] / piece_s + 1e-6).astype(np.int64), count - 1)
            sums[k, band] = np.bincount(piece, np.minimum(scaled**2, tame[k][1]), minlength=count)
            counts[k, band] = np.bincount(piece, minlength=count)
            if not band:
                readings.append((scaled_rows[k], piece))
    return Energy(piece_s, sums, counts, tuple(readings))


def _scaled(y: Array) -> Array:
    """Values [n] about their level over their noise; empty where most are alike: below the lattice, or bridged."""
    apart = y - _level(y)
    noise = float(np.median(np.abs(apart))) / MEDIAN_SD if apart.size else 0.0
    return apart / noise if noise > 0.0 else np.zeros(0)


def _apart_from_each_other(rows: Sequence[Array], scaled: Sequence[Array]) -> list[Array]:
    """Readings of axes, [n] each, that are independent at rest: those of one clock that correlate in the nearest units
    that do not. Of a copy nothing is left. `scaled`: about their level over their noise."""
    found = list(rows)
    for size in {one.size for one in scaled} - {0}:
        own = [k for k, one in enumerate(scaled) if one.size == size]
        together = np.atleast_2d(np.corrcoef(np.clip([scaled[k] for k in own], -WILD[0], WILD[0])))
        copies = (np.abs(np.tril(together, -1)) > COPY).any(axis=1)
        for k in np.flatnonzero(copies).tolist():
            found[own[k]] = np.zeros(size)
        own = [k for k, copy in zip(own, copies, strict=True) if not copy]
        together = together[np.ix_(~copies, ~copies)]
        if np.abs(together - np.eye(len(own))).max(initial=0.0) > CORRELATED / math.sqrt(size):
            values, vectors = np.linalg.eigh(together)
            noise = [float(np.median(np.abs(rows[k] - _level(rows[k])))) for k in own]
            mixed = (
                vectors
                / np.sqrt(np.maximum(values, 1.0 - COPY))
                @ vectors.T
                @ [rows[k] / n for k, n in zip(own, noise, strict=True)]
            )
            for k, row in zip(own, mixed, strict=True):
                found[k] = row
    return found


def _level(y: Array) -> Array:
    """Running median of readings [n]."""
    found: Array = median_filter(y, LEVEL, mode="nearest")
    return found


def _tame(y: Array) -> tuple[Array, float]:
    """Readings [n] with those at their level that are wild by themselves; and the square that is as rare as a wild one,
    in variances."""
    level = _level(y)
    apart = y - level
    noise = float(np.median(np.abs(apart))) / MEDIAN_SD
    middle = median_filter(apart, BAND_LEAST, mode="nearest")
    wild = (np.abs(apart) > WILD[1] * noise) & (np.abs(middle) < WILD[0] * noise)
    return np.where(wild, level, y), 2.0 * math.log(y.size / (1.0 + float(wild.sum())))


def stretches(energy: Energy) -> list[Stretch]:
    """The stretches in which the sensor moves. Those that are found no longer hide others beside them."""
    found: list[Stretch] = []
    while more := _loud_windows(energy, found):
        sums, counts = energy.sums.copy(), energy.counts.copy()
        margin = math.ceil(MARGIN_S / energy.piece_s)
        for one in more:
            gone = slice(max(0, one.begin - margin), one.end + margin)
            sums[..., gone] = counts[..., gone] = 0.0
        found += more
        energy = replace(energy, sums=sums, counts=counts)
    together = [one for one in found if one.axes.sum() > 1]
    return [one for one in found if one.axes.sum() == 1] if together and _of_one_source(energy, together) else found


def _loud_windows(energy: Energy, known: Sequence[Stretch] = ()) -> list[Stretch]:
    """Stretches apart from each other that are loud beyond chance, the surest first. Those of several axes count
    together, those that are `known` too."""
    axes, bands, pieces = energy.sums.shape
    lengths = [1]
    while lengths[-1] * energy.piece_s <= WINDOW_S and 8 * lengths[-1] <= pieces:
        last = lengths[-1]
        lengths.append(last + max(1, last & -last if last & (last - 1) else last // 2))
    found: list[tuple[float, int, int, Mask]] = []
    wide, used = np.ones((axes, bands)), np.flatnonzero(energy.counts.any(axis=(0, 2)))
    lengths = lengths if used.size else []
    for length in lengths:
        begin = np.arange(0, pieces - length + 1, max(1, length // 4))
        nats, inside, wide = _nats(energy, begin, length, wide)
        own = np.quantile(nats, OWN, axis=2, keepdims=True) / math.log(0.5 / (1.0 - OWN))
        nats = nats / np.maximum(1.0, own)
        nats, as_one = nats[:-1], nats[-1]
        loudest = nats.max(axis=1)
        alone = np.where(inside, loudest, 0.0)
        together = np.max([_together(nats[:, band], as_one[band]) for band in used], axis=0)
        looks = math.log(used.size * pieces / length)
        singly = alone.max(axis=0) - looks - math.log(axes * len(lengths))
        for net, several in ((together - looks + FEWER, True), (singly, False)):
            for at in np.flatnonzero(net > (-PART if several else -1.0) * math.log(SHARE)):
                which = loudest[:, at] > TOGETHER if several else np.arange(axes) == np.argmax(alone[:, at])
                if several == (which.sum() > 1):
                    found.append((float(net[at]), int(begin[at]), length, which))
    taken = np.zeros(pieces, bool)
    apart: list[Stretch] = []
    for net, first, length, which in sorted(found, key=lambda one: -one[0]):
        if not taken[first : first + length].any():
            a, b = _ends(energy, *_ends(energy, first, first + length, which), which)
            nats = _nats(energy, np.array([a]), b - a, np.ones((axes, bands)))[0][:-1, :, 0].max(axis=1)
            of_others = np.count_nonzero(which) == 1
            more = _sharing(energy, a, b, which) & (nats > (-math.log(SHARE) if of_others else TOGETHER))
            which = which | more if of_others else more  # noqa: PLW2901
            apart.append(Stretch(a, b, which, nats, net))
            taken[a:b] = True
    sure = -math.log(SHARE)  # a stretch that is sure by itself says nothing of others
    together = sum(one.net for one in [*known, *apart] if one.axes.sum() > 1 and one.net <= sure)
    return [one for one in apart if max(one.net, together * (one.axes.sum() > 1)) > sure]


def _together(nats: Array, as_one: Array) -> Array:
    """ln of one over the chance of the nats [axes, windows] of all axes but the loudest: those of the next ones, as
    many as make it least, or what all `as_one` [windows] have beyond it. Each is exponential at rest, and so many have
    the gamma distribution."""
    axes, windows = nats.shape
    total = np.zeros(windows)
    least: Array = np.maximum(as_one - nats.max(axis=0), 0.0) * float(axes > 1)
    for k, more in enumerate(np.sort(nats, axis=0)[-2::-1]):
        total += more
        tail = np.log(np.sum([total**j / math.factorial(j) for j in range(k + 1)], axis=0))
        least = np.maximum(least, total - tail - math.log(math.comb(axes - 1, k + 1)))
    return least


def _nats(energy: Energy, begin: Rows, length: int, wide: Array) -> tuple[Array, Mask, Array]:
    """Nats of windows of a length over their louder side [axes and all as one, bands, windows]. Whether an axis has
    both sides [axes, windows]. How much wider than of white noise the means lie, `wide` at least [axes, bands]."""
    sums, counts = energy.before
    pieces = energy.sums.shape[2]
    each = counts[..., -1:] / pieces

    def means(first: Rows, last: Rows) -> tuple[Array, Array]:
        first, last = np.clip(first, 0, pieces), np.clip(last, 0, pieces)
        n = counts[..., last] - counts[..., first]
        return (sums[..., last] - sums[..., first]) / np.maximum(n, 1.0), n

    side = max(SIDE * length, round(SIDE_S / energy.piece_s), math.ceil(SIDE_SQUARES / max(1e-9, float(each.max()))))
    own, n = means(begin, begin + length)
    left, n_left = means(begin - 1 - side, begin - 1)
    right, n_right = means(begin + length + 1, begin + length + 1 + side)
    there = [(one >= side * each / SIDE) & (one > 0.0) for one in (n_left, n_right)]
    level = np.maximum(np.where(there[0], left, 0.0), np.where(there[1], right, 0.0))
    beside = np.maximum(np.where(there[0], n_left, 0.0), np.where(there[1], n_right, 0.0))
    known = (level > 0.0) & (n > 0.0)
    ratio = np.where(known, own / np.maximum(level, STILL**2), 1.0)
    wide = np.maximum(
        wide, [[_spread(*row) for row in zip(*rows, strict=True)] for rows in zip(own, n, known, strict=True)]
    )
    own_free, side_free = (np.maximum(one * known / (SQUARES * wide[..., None]), 0.5) for one in (n, beside))
    ratio = np.concatenate([ratio, [(ratio * own_free).sum(axis=0) / own_free.sum(axis=0)]])
    own_free, side_free = (np.concatenate([one, [one.sum(axis=0)]]) for one in (own_free, side_free))
    ratio = np.maximum(ratio, 1.0)
    nats = 0.5 * own_free * (ratio - 1.0 - np.log(ratio))
    near = nats > 1.0
    nats[near] = -np.log(np.maximum(fdtrc(own_free[near], side_free[near], ratio[near]), TINY))
    return nats, (there[0] & there[1]).any(axis=1), wide


def _spread(means: Array, counts: Array, known: Mask) -> float:
    """Times that the means of counts of squares [windows] lie wider than of white noise, by the quieter ones."""
    if np.count_nonzero(known) < SIDE_SQUARES:
        return 1.0
    low, middle = np.quantile(means[known], QUIETER)
    white = gammaincinv(0.5 * float(np.median(counts[known])) / SQUARES, QUIETER)
    return float((1.0 - low / middle) / (1.0 - white[0] / white[1])) ** 2 if middle > 0.0 else 1.0


def _ratio(energy: Energy, begin: int, end: int) -> tuple[Array, Array]:
    """How much louder a stretch is than the rest, 1 at least, and the level of the rest [axes, bands]."""
    inside, n = energy.sums[..., begin:end].sum(axis=2), energy.counts[..., begin:end].sum(axis=2)
    level = (energy.sums.sum(axis=2) - inside) / np.maximum(energy.counts.sum(axis=2) - n, 1.0)
    level = np.maximum(level, STILL**2)
    return np.maximum(inside / np.maximum(n, 1.0) / level, 1.0), level


def _sharing(energy: Energy, begin: int, end: int, axes: Mask) -> Mask:
    """Which axes [axes] are rather as loud as `axes` are in a stretch than at rest."""
    ratio, _ = _ratio(energy, begin, end)
    n = energy.counts[..., begin:end].sum(axis=2)
    r = np.maximum((ratio[axes] * n[axes]).sum(axis=0) / np.maximum(n[axes].sum(axis=0), 1.0), 1.0)
    return np.asarray((n * (ratio * (1.0 - 1.0 / r) - np.log(r))).max(axis=1) > 0.0)


def _ends(energy: Energy, begin: int, end: int, axes: Mask) -> tuple[int, int]:
    """The likeliest ends of a loud window: no part beyond them is worth its quiet beside it."""
    ratio, level = _ratio(energy, begin, end)
    r = ratio[axes][..., None]
    own = energy.sums[axes] / level[axes][..., None] * (1.0 - 1.0 / r) - energy.counts[axes] * np.log(r)
    gain = 0.5 / SQUARES * own.sum(axis=(0, 1))
    middle = begin + int(np.argmax(gain[begin:end]))
    reach = []
    for part in (gain[middle:], gain[middle::-1]):
        sums = np.cumsum(part)
        over = np.flatnonzero(sums < np.maximum.accumulate(sums) + math.log(SHARE))
        reach.append(int(np.argmax(sums[: over[0] if over.size else sums.size])))
    return middle - reach[1], middle + reach[0] + 1


def _of_one_source(energy: Energy, moved: Sequence[Stretch]) -> bool:
    """Whether the axes that moved share a source at rest, and it alone is loud where they moved. It is the direction in
    which they are loudest, in units of the axes' joint noise at rest."""
    parts = [energy.apart[k] for k in np.flatnonzero(np.any([one.axes for one in moved], axis=0))]
    if len({piece.size for _, piece in parts}) > 1:
        return False
    values, piece = np.array([part for part, _ in parts]), parts[0][1]
    inside = np.any([(piece >= one.begin) & (piece < one.end) for one in moved], axis=0)
    together = np.corrcoef(np.clip(values[:, ~inside], -WILD[0], WILD[0]))
    if np.abs(together - np.eye(len(parts))).max() < SHARED + CORRELATED / math.sqrt(values.shape[1]):
        return False
    size, vectors = np.linalg.eigh(together)
    loud_ones = vectors / np.sqrt(np.maximum(size, TINY)) @ vectors.T @ values[:, inside]
    mean = np.maximum(np.linalg.eigvalsh(loud_ones @ loud_ones.T) / np.count_nonzero(inside), 1.0)
    nats = 0.5 * np.count_nonzero(inside) / SQUARES * (mean - 1.0 - np.log(mean))
    return float(nats[:-1].sum()) < -math.log(SHARE)


def loud(y: Array, rate_hz: float, lsb: float = 0.0) -> Moved | None:
    """The stretches in which readings [n] on an even grid, NaN where missing, are far louder than in the minutes about
    them. `lsb`: their lattice. O(n)."""
    block = round(BANDS_S[0] * rate_hz)
    block = block if block >= BAND_LEAST else 1
    level, noise = _blocks(y, block)
    found = _loud_blocks(y, rate_hz, lsb, block, level, noise)
    share = round(BANDS_S[1] * rate_hz / block)
    if share >= BAND_LEAST:
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
    parts = runs(far, apart - 1)
    if not parts:
        return []
    wild = away > LOUD if block == 1 else _wild(y, level, sizes[1], around, block, lsb) if knocks else far
    begins = np.diff(wild, prepend=False) & wild
    margin = max(1, round(MARGIN_S * rate_hz))
    found: list[tuple[Interval, float]] = []
    moving = np.zeros(level.size, bool)
    for a, b in parts:
        knock = (b - a) * block <= SHORT_S * rate_hz
        if knock:
            own = slice(a * block, b * block)
            others = max(1, int(begins.sum()) - int(begins[own].sum()))
            rare = knocks and _rare(int(wild[own].sum()), (b - a) * block, others, y.size)
        else:
            rare = _rare(int(far[a:b].sum()), b - a, len(parts), level.size)
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
    two_levels = len(found) >= ALIKE_LEAST and _alike(sizes[0][moving])
    return [] if two_levels and float(np.median(away[moving])) < DEVIATION_MOST else found


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
    """Running median over `around` values; at the ends that of the first and the last so many."""
    half = around // 2
    middle: Array = median_filter(values, 2 * half + 1, mode="nearest")
    middle[:half], middle[values.size - half :] = middle[half], middle[values.size - half - 1]
    return middle


def _over(values: Array, around: int, lsb: float) -> Array:
    """Deviations over the usual ones about them, as of a normal's."""
    usual = _middle(values, around) / MEDIAN_SD
    own = float(np.median(values[values > 0.0])) / MEDIAN_SD if (values > 0.0).any() else 0.0
    return values / np.maximum(np.maximum(usual, STILL * own), max(lsb, 1e-300))


def joined(intervals: Sequence[tuple[Time, Time]]) -> list[tuple[Time, Time]]:
    """In order of time, those that touch made one."""
    found: list[tuple[Time, Time]] = []
    for a, b in sorted(intervals):
        if found and a <= found[-1][1]:
            found[-1] = (found[-1][0], max(b, found[-1][1]))
        else:
            found.append((a, b))
    return found
