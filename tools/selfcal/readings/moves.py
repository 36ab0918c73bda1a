"""A sensor that moves, in the raw readings and before any fit: its energy against the energy before and after.

Energy is that of the readings and of short means about their running median: ramps and jumps have little. A window is
compared with its louder side, at its own length. So noise that grows, breathes or stays loud is no motion. At rest the
mean of n squares exceeds r times its expectation with a probability below exp(-n (r - 1 - ln r) / 2) (Chernoff). Axes
are independent at rest. The sensor moves where axes without the loudest are louder together, or where an axis is as
loud as in no other window of its record. A hand that pushes shows in the level: how far it is from a long running
median, beyond any noise. At an end of the record one side is missing and noise may have grown: an axis alone moves
there where most of its readings are pushed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import binom, fdtrc, gammainc, gammaincinv, kl_div

from selfcal.base.grid import MEDIAN_SD, Array, Mask, Rows, block_means
from selfcal.logs.recording import SIDE_CHANNELS, Recording
from selfcal.readings.budget import CLEARLY, SHARES

Time = TypeVar("Time", int, float)

#: Length of a piece, s, and pieces at most.
ENERGY_PIECE_S, PIECES_MOST = 0.1, 40_000
#: Lengths of the means whose energy is taken besides the readings', s: a knock is short, and a hand that turns slowly
#: shows in long means alone. Pushes are looked for in the shortest means. Fewest readings in a mean.
BANDS_S, BAND_LEAST = (0.1, 0.5), 5
#: Standard deviations of the median about a wild reading at most, and of itself at least.
WILD_SDS = (3.0, 8.0)
#: Readings whose median is the level of the middle reading: ramps, jumps and slow waves have no part in what is apart
#: from it. Squares of white noise about it in one degree of freedom.
LEVEL, SQUARES = 9, 1.29
#: Longest window, s. Length of each side, in windows (PUSH_S at least), and fewest squares in a side.
WINDOW_S, SIDE_WINDOWS, SIDE_SQUARES = 32.0, 8, 120
#: Probability, for a record at rest, that axes seem to move together, and that an axis seems to move alone.
P_MOVE = SHARES["motion"]
#: Share of an axis' windows with its usual loudness. At most the rest may be loud on an axis alone.
USUAL_SHARE = 0.9
#: Quantiles of the means of windows that show their spread without the loud windows: the median, and 1 sd below it.
QUIETER = (0.1587, 0.5)
#: Discount, nats, of the joint search over windows against independent windows: of 124 clean records of 600 and 1500 s
#: at 1 and 10 Hz the largest evidence is 1.5 to 1.9 less in the median, and 2.0 to 2.7 in a tenth.
FEWER = 2.0
#: Smallest probability that a float holds.
TINY = np.finfo(np.float64).tiny
#: Correlation of axes at rest from which on they share a source, beyond chance.
SHARED = 0.05
#: Standard deviations of a correlation by chance from which on axes depend on each other, and that of a copy.
CORRELATED, COPY = 5.0, 0.999
#: Usual deviations from which on a deviation from the level is a push, and seconds whose running median is that level.
PUSH, PUSH_S = 8.0, 10.0
#: Least noise around a window, as a share of the record's own: a still stretch makes no other stretch loud.
STILL = 0.5
#: Margin of a stretch beyond its pieces, s. Distance to an end of the record that a stretch bridges, s.
MARGIN_S, EDGE_S = 0.5, 5.0


@dataclass(frozen=True)
class Moved:
    """Motion of one axis: begin and end of its stretches in order, s, their `nats` over rest, and those `net` of the
    search. `ratio`: the readings in them about their level over the noise around them, root mean square; NaN where the
    noise is 0. `events`: the same of each event that the axis is in."""

    intervals: tuple[tuple[float, float], ...]
    nats: float
    net: float
    ratio: float
    events: tuple[Moved, ...] = ()


@dataclass(frozen=True)
class Energy:
    """Squares of axes over their variance, `most` [axes] at most, in pieces of `piece_s`: `sums` and `counts` [axes,
    bands, pieces], of single readings, of means of BANDS_S, and of pushes, whose own `squares` [axes, pieces] are
    summed too. `apart`: the readings of an axis about their level, over their noise [n], and the piece of each [n]."""

    piece_s: float
    sums: Array
    counts: Array
    squares: Array
    apart: Callable[[int], tuple[Array, Rows]]
    most: Array

    def before(self) -> tuple[Array, ...]:
        """Sums, counts and squares of all pieces before each piece, and of all pieces, [..., pieces + 1]."""
        every = (self.sums, self.counts, self.squares)
        return tuple(np.concatenate((0.0 * each[..., :1], np.cumsum(each, axis=-1)), axis=-1) for each in every)


@dataclass(frozen=True)
class Stretch:
    """Pieces from `begin` on and before `end` in which `axes` [axes] move; the `nats` of each [axes], and those `net`
    of the search."""

    begin: int
    end: int
    axes: Mask
    nats: Array
    net: float

    @property
    def several(self) -> bool:
        """Whether axes move together."""
        return int(self.axes.sum()) > 1


def moves_of(recording: Recording) -> dict[str, Moved]:
    """By axis when the sensor moved, s from the first row. Looked at once."""
    seen: dict[str, Moved] = recording.seen.setdefault("motion", {})
    if not seen:
        channels = {column for column, _ in SIDE_CHANNELS.values()}
        names = [name for name in recording.columns if name not in channels]
        energy = energy_of(recording, names)
        of_axis: dict[str, list[Stretch]] = {name: [] for name in names}
        for stretch in stretches(energy):
            for k in np.flatnonzero(stretch.axes).tolist():
                of_axis[names[k]].append(stretch)
        times = {
            name: joined_intervals([_times(energy, stretch, recording) for stretch in of_axis[name]]) for name in names
        }
        events = motion_events(times).values()

        def within(k: int, spans: Sequence[tuple[float, float]]) -> Moved:
            name = names[k]
            own = [stretch for stretch in of_axis[name] if _overlap(spans, *_times(energy, stretch, recording))]
            moved = tuple(each for each in times[name] if _overlap(spans, *each))
            nats, net = sum(float(stretch.nats[k]) for stretch in own), sum(stretch.net for stretch in own)
            return Moved(moved, nats, net, _loudness(recording, name, energy, own, times[name]))

        for k, name in enumerate(names):
            each = tuple(within(k, spans) for spans in events)
            seen[name] = replace(within(k, times[name]), events=tuple(event for event in each if event.intervals))
    return {name: moved for name, moved in seen.items() if moved.intervals}


def _times(energy: Energy, stretch: Stretch, recording: Recording) -> tuple[float, float]:
    """Begin and end of a stretch, s, a margin more on either side."""
    begin, end, length_s = stretch.begin * energy.piece_s, stretch.end * energy.piece_s, recording.duration_s
    margin_s = max(MARGIN_S, 2.0 * energy.piece_s)  # 99 of 100 ends of a loud stretch lie within two pieces
    return begin - margin_s if begin > EDGE_S else 0.0, end + margin_s if end < length_s - EDGE_S else length_s


def _loudness(
    recording: Recording, name: str, energy: Energy, moved: Sequence[Stretch], times: Sequence[tuple[float, float]]
) -> float:
    """The ratio of Moved, of the stretches in which an axis `moved` and the `times` left out for them."""
    y, time = recording.columns[name].values, recording.clock_of(name).time_s
    rest = np.isfinite(y)

    def rows(begin_s: float, end_s: float) -> slice:
        return slice(*np.searchsorted(time, (begin_s, end_s)))

    for a, b in times:
        rest[rows(a, b)] = False
    steps = np.abs(np.diff(y[rest]))
    noise = float(np.median(steps)) / (MEDIAN_SD * math.sqrt(2.0)) if steps.size else 0.0
    total, count = 0.0, 0
    for stretch in moved:
        a, b = stretch.begin * energy.piece_s, stretch.end * energy.piece_s
        sides = [rows(a - EDGE_S - PUSH_S, a), rows(b, b + EDGE_S + PUSH_S)]
        levels = [(np.median(time[at][rest[at]]), np.median(y[at][rest[at]])) for at in sides if rest[at].any()]
        if levels:
            apart = y[rows(a, b)] - np.interp(time[rows(a, b)], *np.array(levels).T)
            total, count = total + float(np.nansum(apart**2)), count + int(np.isfinite(apart).sum())
    return math.sqrt(total / count) / noise if count and noise > 0.0 else math.nan


def energy_of(recording: Recording, names: Sequence[str]) -> Energy:
    """The energy of columns. O(n)."""
    clocks = [recording.clock_of(name) for name in names]
    length_s = max(float(clock.time_s[-1]) + 1.0 / clock.rate_hz for clock in clocks)
    piece_s = max(ENERGY_PIECE_S, 1.0 / max(clock.rate_hz for clock in clocks), length_s / PIECES_MOST)
    count = math.ceil(length_s / piece_s - 1e-6)
    sums, counts = np.zeros((2, len(names), 2 + len(BANDS_S), count))
    squares = np.zeros((len(names), count))
    there = [np.isfinite(recording.columns[name].values) for name in names]
    tame = [_tame(recording.columns[name].values[each]) for name, each in zip(names, there, strict=True)]
    scaled_rows = [_scaled(own) for own, _ in tame]
    rows = _apart_from_each_other([own for own, _ in tame], scaled_rows)

    def pieces(time_s: Array) -> Rows:
        return np.minimum((time_s / piece_s + 1e-6).astype(np.int64), count - 1)

    def apart(k: int) -> tuple[Array, Rows]:
        scaled = _scaled(_tame(recording.columns[names[k]].values[there[k]])[0])
        return scaled, pieces(clocks[k].time_s[there[k]][: scaled.size])

    for k, (clock, own) in enumerate(zip(clocks, rows, strict=True)):
        time = clock.time_s[there[k]]
        sizes = [1, *(round(band_s * clock.rate_hz) for band_s in BANDS_S)]
        sizes.append(sizes[1] if sizes[1] >= BAND_LEAST else 1)
        for band, size in enumerate(sizes):
            pushes, more = band == len(sizes) - 1, size > 1
            if (band and not (pushes or more)) or (more and not BAND_LEAST <= size <= own.size // SIDE_SQUARES):
                continue
            means, middle_s = block_means(own, size), block_means(time, size)
            around = round(PUSH_S * clock.rate_hz / size) if pushes else LEVEL
            scaled = _scaled(_tame(means, around)[0] if pushes else means, around)
            if pushes:
                scaled = np.maximum(np.abs(scaled) - PUSH, 0.0)
            piece = pieces(middle_s[: scaled.size])
            square = np.minimum(scaled**2, tame[k][1])
            totals = counts[k, band], sums[k, band], *([squares[k]] if pushes else [])
            for power, total in enumerate(totals):
                total[:] = np.bincount(piece, square**power, minlength=count)
    return Energy(piece_s, sums, counts, squares, apart, np.array([most for _, most in tame]))


def _scaled(y: Array, size: int = LEVEL) -> Array:
    """Values [n] about their level over their noise; empty where most are alike: below the lattice, or bridged."""
    apart = y - _level(y, size)
    size_of = np.abs(apart)
    noise = float(np.median(size_of)) if apart.size else 0.0
    if size > LEVEL and noise > 0.0:
        noise = float(np.median(size_of[size_of > 0.0]))  # a long still stretch shows no noise
    return apart * (MEDIAN_SD / noise) if noise > 0.0 else np.zeros(0)


def _apart_from_each_other(rows: Sequence[Array], scaled: Sequence[Array]) -> list[Array]:
    """Readings of axes, [n] each, that are independent at rest: axes of a clock that correlate, in the nearest units
    without correlation. A copy becomes 0. `scaled`: about their level over their noise."""
    free = list(rows)
    for size in {axis.size for axis in scaled} - {0}:
        own = [k for k, axis in enumerate(scaled) if axis.size == size]
        together = _correlation([scaled[k] for k in own])
        copies: Mask = np.any(np.abs(np.tril(together, -1)) > COPY, axis=1)
        for k in np.flatnonzero(copies).tolist():
            free[own[k]] = np.zeros(size)
        own = [k for k, copy in zip(own, copies, strict=True) if not copy]
        together = together[np.ix_(~copies, ~copies)]
        if np.abs(together - np.eye(len(own))).max(initial=0.0) > CORRELATED / math.sqrt(size):
            values, vectors = np.linalg.eigh(together)
            noise = np.array([float(np.median(np.abs(rows[k] - _level(rows[k])))) for k in own])
            whiten = vectors / np.sqrt(np.maximum(values, 1.0 - COPY)) @ vectors.T / noise
            for k, row in zip(own, whiten @ [rows[k] for k in own], strict=True):
                free[k] = row
    return free


def _correlation(rows: Sequence[Array] | Array) -> Array:
    """Correlation of rows [k, n] about 0 and of deviation 1, without wild values [k, k]."""
    tame = np.array(rows, np.float32)  # half of the memory
    np.clip(tame, -WILD_SDS[0], WILD_SDS[0], out=tame)
    tame -= tame.mean(axis=1, keepdims=True)
    products = (tame @ tame.T).astype(np.float64)
    size = np.sqrt(np.diag(products))
    return np.asarray(products / np.outer(size, size))


def _level(y: Array, size: int = LEVEL) -> Array:
    """Running median of readings [n]."""
    return np.asarray(median_filter(y, max(LEVEL, min(size, y.size // 4)) | 1, mode="nearest"))


def _tame(y: Array, size: int = LEVEL) -> tuple[Array, float]:
    """Readings [n]; those that are wild by themselves no farther from their level than where readings are as rare. The
    square there, in variances."""
    level = _level(y, size)
    apart = y - level
    far = np.abs(apart)
    noise = float(np.median(far)) / MEDIAN_SD
    wild = (far > WILD_SDS[1] * noise) & (median_filter(far, BAND_LEAST, mode="nearest") < WILD_SDS[0] * noise)
    most = 2.0 * math.log(y.size / (1.0 + float(wild.sum())))
    return level + np.where(wild, np.sign(apart) * math.sqrt(most) * noise, apart), most


def stretches(energy: Energy) -> list[Stretch]:
    """The stretches in which the sensor moves. The energy of found stretches is taken out, so they hide no others near
    them."""
    known: list[Stretch] = []
    while more := _loud_windows(energy, known):
        margin = math.ceil(MARGIN_S / energy.piece_s)
        for stretch in more:
            gone = slice(max(0, stretch.begin - margin), stretch.end + margin)
            energy.sums[..., gone] = energy.counts[..., gone] = energy.squares[..., gone] = 0.0
        known += more
    together = [stretch for stretch in known if stretch.several]
    source = together and _of_one_source(energy, together)
    return [stretch for stretch in known if not (source and stretch.several)]


def _loud_windows(energy: Energy, known: Sequence[Stretch] = ()) -> list[Stretch]:
    """Stretches apart from each other that are loud beyond chance, the surest first. Those of several axes count
    together, those that are `known` too."""
    axes, bands, pieces = energy.sums.shape
    lengths = [1]
    while lengths[-1] * energy.piece_s <= WINDOW_S and 8 * lengths[-1] <= pieces:
        last = lengths[-1]
        lengths.append(last + max(1, last & -last if last & (last - 1) else last // 2))
    loud: list[tuple[float, int, int, Mask]] = []
    wide, used = np.ones((axes, bands)), np.flatnonzero(energy.counts.any(axis=(0, 2)))
    lengths, before = lengths if used.size else [], energy.before()
    for length in lengths:
        begin = np.arange(0, pieces - length + 1, max(1, length // 4))
        nats, inside, wide = _nats(energy, before, begin, length, wide)
        own = np.quantile(nats, USUAL_SHARE, axis=2, keepdims=True) / math.log(0.5 / (1.0 - USUAL_SHARE))
        nats /= np.maximum(1.0, own)
        nats, others = nats[:-1], nats[-1]
        loudest = nats.max(axis=1)
        alone = np.where(inside, loudest, 0.0)
        looks = math.log(used.size * pieces / length)
        singly = alone.max(axis=0) - looks - math.log(axes * len(lengths))
        for net, several in ((others.max(axis=0) - looks + FEWER, True), (singly, False)):
            for window in np.flatnonzero(net > CLEARLY):
                which = loudest[:, window] > CLEARLY if several else np.arange(axes) == np.argmax(alone[:, window])
                if several == (which.sum() > 1):
                    loud.append((float(net[window]), int(begin[window]), length, which))
    taken = np.zeros(pieces, bool)
    apart: list[Stretch] = []
    sure = -math.log(P_MOVE)  # a stretch that is sure by itself says nothing of others, and no other takes its place
    for net, first, length, which in sorted(loud, key=lambda entry: (entry[0] <= sure, entry[3].sum() == 1, -entry[0])):
        if not taken[first : first + length].any():
            a, b = _ends(energy, *_ends(energy, first, first + length, which), which)
            nats = _nats(energy, before, np.array([a]), b - a, np.ones((axes, bands)))[0][:-1, :, 0].max(axis=1)
            of_others = np.count_nonzero(which) == 1
            more = _sharing(energy, a, b, which) & (nats > (-math.log(P_MOVE) if of_others else CLEARLY))
            which = which | more if of_others else more  # noqa: PLW2901
            apart.append(Stretch(a, b, which, nats, net))
            taken[a:b] = True
    least = {}
    for several in (True, False):
        weak = (each.net for each in [*known, *apart] if each.several == several and each.net <= sure)
        nets = sorted(weak, reverse=True)
        # At rest exp(-net) stretches are beyond a net: the fewest that are together no chance. Stretches of an axis
        # depend on each other, as its noise is not normal: for these by Simes' bound.
        chances = (gammainc(k, math.exp(-net)) if several else math.exp(-net) / k for k, net in enumerate(nets, 1))
        least[several] = max((net for net, chance in zip(nets, chances, strict=True) if chance < P_MOVE), default=sure)
    return [each for each in apart if each.net >= least[each.several]]


def _nats(energy: Energy, before: Sequence[Array], begin: Rows, length: int, wide: Array) -> tuple[Array, Mask, Array]:
    """Nats of windows of a length over their louder side [axes, and all but the loudest together, bands, windows].
    Whether an axis has both sides, or is pushed most of the time [axes, windows]. How much wider than of white noise
    the means lie, `wide` at least [axes, bands]. `before`: of the energy."""
    axes, bands, pieces = energy.sums.shape
    most = max(1e-9, float(energy.counts.sum(axis=2).max()) / pieces)
    side = max(SIDE_WINDOWS * length, round(PUSH_S / energy.piece_s), math.ceil(SIDE_SQUARES / most))
    nats, wide = np.zeros((axes + 1, bands, begin.size)), wide.copy()
    inside = np.zeros((axes, begin.size), bool)
    for band in range(bands):  # a band at a time: a long record has many windows
        nats[:, band], both, wide[:, band] = _of_band(energy, before, band, begin, length, side, wide[:, band])
        inside |= both
    return nats, inside, wide


def _of_band(
    energy: Energy, before: Sequence[Array], band: int, begin: Rows, length: int, side: int, wide: Array
) -> tuple[Array, Mask, Array]:
    """`_nats` of a band, with sides of `side` pieces: [axes + 1, windows], [axes, windows], [axes]."""
    sums, counts = (every[:, band] for every in before[:2])
    pieces, pushes = energy.sums.shape[2], band == energy.sums.shape[1] - 1

    def inside(every: Array, first: Rows, last: Rows) -> Array:
        difference: Array = every[:, np.clip(last, 0, pieces)] - every[:, np.clip(first, 0, pieces)]
        return difference

    least = counts[:, -1:] / pieces * side / SIDE_WINDOWS
    level, beside = np.zeros((2, len(sums), begin.size))
    both = np.ones(level.shape, bool)
    for first in (begin - 1 - side, begin + length + 1):
        n = inside(counts, first, first + side)
        there = (n >= least) & (n > 0.0)
        mean = inside(sums, first, first + side) / np.maximum(n, 1.0)
        level, beside = np.maximum(level, np.where(there, mean, 0.0)), np.maximum(beside, np.where(there, n, 0.0))
        both &= there
    n = inside(counts, begin, begin + length)
    own = inside(sums, begin, begin + length) / np.maximum(n, 1.0)
    known = (beside > 0.0) & (n > 0.0)
    wide = np.maximum(wide, [_spread(*row) for row in zip(own, n, known, strict=True)])
    free = known / (SQUARES * wide[:, None])
    if pushes:
        # Pushes are rare and large, also in noise that has grown: their own spread around the window counts.
        second, fourth, many = (
            inside(every, begin - 1 - side, begin - 1) + inside(every, begin + length + 1, begin + length + 1 + side)
            for every in (sums, before[2], counts)
        )
        free /= np.maximum(0.5 * (fourth * many / np.maximum(second**2, 1.0) - 1.0), 1.0)
    own_free, side_free = np.maximum(n * free, 0.5), np.maximum(beside * free, 0.5)
    ratio = np.where(known, own / np.maximum(level, STILL**2), 1.0)
    louder = np.maximum(ratio, 1.0)
    order = np.argsort(-own_free * (louder - 1.0 - np.log(louder)), axis=0)[1:]
    # Without the loudest axis: the next one, two and so on, as many as show most. A choice costs its number of ways.
    of_others = [np.take_along_axis(each, order, 0).cumsum(axis=0) for each in (ratio * own_free, own_free, side_free)]
    ratio = np.maximum(np.concatenate([ratio, of_others[0] / np.maximum(of_others[1], 0.5)]), 1.0)
    own_free, side_free = (np.concatenate(pair) for pair in ((own_free, of_others[1]), (side_free, of_others[2])))
    nats = 0.5 * own_free * (ratio - 1.0 - np.log(ratio))
    near = nats > 1.0
    nats[near] = -np.log(np.maximum(fdtrc(own_free[near], side_free[near], ratio[near]), TINY))
    if pushes:
        # Some readings that are far by themselves come together: a number that is rare by their share of the record.
        most = energy.most[:, None]
        share = np.exp(-0.5 * most) + sums[:, -1:] / (most * np.maximum(counts[:, -1:], 1.0))
        far, usual = own * n / most, n * share
        rare = np.where(far > usual, kl_div(far, usual), 0.0)
        nats = np.minimum(nats, np.concatenate([rare, np.take_along_axis(rare, order, 0).cumsum(axis=0)]))
        both |= own > 0.5 * most
    axes, ways = len(sums), binom(len(order), 1.0 + np.arange(len(order)))
    others = np.max(nats[axes:] - np.log(ways)[:, None], axis=0, initial=0.0)
    return np.concatenate([nats[:axes], [others]]), both, wide


def _spread(means: Array, counts: Array, known: Mask) -> float:
    """Variance of the means of `counts` squares [windows] over white noise's, by the quieter windows."""
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
    """Which axes [axes] are as loud as the quieter half of `axes` is in a stretch, and not at rest. Where an axis as
    loud would show little itself, half of that suffices."""
    ratio, _ = _ratio(energy, begin, end)
    n = 0.5 / SQUARES * energy.counts[..., begin:end].sum(axis=2)
    r = np.quantile(ratio[axes], 0.5, axis=0, method="lower")
    nats, expected = n * (ratio * (1.0 - 1.0 / r) - np.log(r)), n * (r - 1.0 - np.log(r))
    return np.asarray(nats.max(axis=1) > np.minimum(CLEARLY, 0.5 * expected.max(axis=1)))


def _ends(energy: Energy, begin: int, end: int, axes: Mask) -> tuple[int, int]:
    """The likeliest ends of a loud window: no part beyond them is worth the quiet before it."""
    ratio, level = _ratio(energy, begin, end)
    r = ratio[axes][..., None]
    own = energy.sums[axes] / level[axes][..., None] * (1.0 - 1.0 / r) - energy.counts[axes] * np.log(r)
    gains = 0.5 / SQUARES * own.sum(axis=0)
    long = gains[-2]  # its blocks are longer than a piece
    fine = gains.sum(axis=0) - long
    gain = fine if fine[begin:end].sum() > long[begin:end].sum() else fine + long
    middle = begin + int(np.argmax(gain[begin:end]))
    reach = []
    for part in (gain[middle:], gain[middle::-1]):
        sums = np.cumsum(part)
        over = np.flatnonzero(sums < np.maximum.accumulate(sums) + math.log(P_MOVE))
        reach.append(int(np.argmax(sums[: over[0] if over.size else sums.size])))
    return middle - reach[1], middle + reach[0] + 1


def _of_one_source(energy: Energy, moved: Sequence[Stretch]) -> bool:
    """Whether each axis that moved shares a source with another at rest, and the source alone is loud where they moved.
    The source is the direction in which they are loudest, in units of their joint noise at rest."""
    axes = np.flatnonzero(np.any([stretch.axes for stretch in moved], axis=0))
    parts = [energy.apart(k) for k in axes.tolist()]
    if len({piece.size for _, piece in parts}) > 1:
        return False
    values, piece = np.array([part for part, _ in parts]), parts[0][1]
    inside = np.any([(piece >= stretch.begin) & (piece < stretch.end) for stretch in moved], axis=0)
    together = _correlation(values[:, ~inside])
    linked = np.abs(together) > SHARED + CORRELATED / math.sqrt(values.shape[1])
    linked = np.linalg.matrix_power(linked.astype(float), axes.size) > 0.0  # by others too
    loudest = np.max([stretch.nats[axes] for stretch in moved], axis=0)
    sure = loudest >= min(-math.log(P_MOVE), float(loudest.max()))
    if not linked[np.ix_(sure, sure)].all() or (linked.sum(axis=1)[sure] == 1).any():
        return False
    size, vectors = np.linalg.eigh(together)
    loud_ones = vectors / np.sqrt(np.maximum(size, TINY)) @ vectors.T @ values[:, inside]
    mean = np.maximum(np.linalg.eigvalsh(loud_ones @ loud_ones.T) / np.count_nonzero(inside), 1.0)
    nats = 0.5 * np.count_nonzero(inside) / SQUARES * (mean - 1.0 - np.log(mean))
    return float(nats[:-1].sum()) < -math.log(P_MOVE)


def motion_events(
    intervals: Mapping[str, Sequence[tuple[float, float]]],
) -> dict[tuple[str, ...], list[tuple[float, float]]]:
    """Events by their axes, of the intervals of each axis: intervals that meet make an event. Events of the same axes
    stand in a list."""
    events: dict[tuple[str, ...], list[tuple[float, float]]] = {}
    for each in joined_intervals([each for own in intervals.values() for each in own]):
        names = tuple(name for name, own in intervals.items() if _overlap(own, *each))
        events.setdefault(names, []).append(each)
    return events


def _overlap(intervals: Sequence[tuple[float, float]], begin: float, end: float) -> bool:
    return any(a <= end and begin <= b for a, b in intervals)


def joined_intervals(intervals: Sequence[tuple[Time, Time]]) -> list[tuple[Time, Time]]:
    """Intervals in order of time, merged where they touch."""
    spans: list[tuple[Time, Time]] = []
    for a, b in sorted(intervals):
        if spans and a <= spans[-1][1]:
            spans[-1] = (spans[-1][0], max(b, spans[-1][1]))
        else:
            spans.append((a, b))
    return spans
