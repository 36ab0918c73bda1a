"""What the readings of a recording show by themselves: changes of rate, motion, and held, stuck and clipped readings.

Nothing here needs a fit. `identify` and `diagnose` look once, at the recording's own rate, whatever they average.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.special import kl_div, log_ndtr, ndtr, ndtri_exp

from selfcal.base.grid import Array, Mask, Rows, block_means, equal_runs, noise_of, runs
from selfcal.logs.recording import Recording
from selfcal.logs.sampling import RateChange, rate_changes
from selfcal.model.file import Group
from selfcal.readings.budget import nats_of
from selfcal.readings.changed_words import misread_of, spans_of
from selfcal.readings.codes import CHANGED_LEAST, ELSEWHERE, LEVEL_PIECES, PIECE_ROWS, UNEVEN, Cells, Misread
from selfcal.readings.held import Held, Slower, held_of, repeats_of, slower_stretches
from selfcal.readings.lattice import Lattice, lattice_of, step_of
from selfcal.readings.lost_words import WRONG_SHARE_MOST, Recurring, is_limit, recurring_of
from selfcal.readings.moves import Moved, moves_of
from selfcal.readings.rest import PIECES_LEAST

#: Rows of a recording whose readings are kept once they were looked at, at most.
KEPT_MOST = 1 << 22
#: Longest common interval of two rates, s, and how far off it may be.
COMMON_S, COMMON_OFF = 1.0, 3e-3
#: ln of the probability, a record, of a run of equal readings that is no chance.
LN_STUCK = -nats_of("stuck")
#: Largest nats at which runs are counted; ratio of their number to chance's from which on they are held. Steps in the
#: noise beyond which chance is not well known.
HELD_NATS, HELD_TIMES, HELD_COARSEST = 64, 1.5, 0.8
#: Share of an unclipped reading's information below which a clipped reading is ignored.
CLIPPED_SHARE_LEAST = 0.05
#: Share of the variance of an axis' steps that its copy of another leaves at most: that of a float's digits; and that
#: of rounding to a lattice, over the variance of as many even steps.
FLOAT_COPY, LATTICE_COPY, LIKE = 1e-7, 1.4, 0.1
#: Steps of EM at most, and the change of the noise at which it has settled.
EM_STEPS_MOST, EM_SETTLED = 200, 1e-6


@dataclass(frozen=True)
class Clipped:
    """Readings at limits: by limit [unit] the mask [n] of its readings, and the evidence in nats."""

    limits: Mapping[float, Mask]
    nats: float

    @property
    def mask(self) -> Mask:
        """Every clipped reading, [n]."""
        return np.asarray(np.logical_or.reduce(list(self.limits.values())))

    @property
    def limit(self) -> float:
        """The limit with the most readings."""
        return max(self.limits, key=lambda limit: int(self.limits[limit].sum()))


#: Share of the range by which readings at its limit may lie beyond it: a model file has six digits.
RANGE_ROUNDED = 1e-5
#: Share of readings beyond the range from which on they count as clipped, and noises to the range at most: the noise of
#: the others is too small.
BEYOND_MOST, BEYOND_SD = 0.01, 8.0


@dataclass(frozen=True)
class Readings:
    """The readings of one axis: `values` [n] in the group's unit as read, NaN where they are `stuck` or `recurring`.
    `working` [n] are those to average: NaN where the sensor is `moving` [n], and clipped readings give their
    information to others (see `_unclipped`). In `drawn` [n] a clipped reading is drawn by chance beyond its limit.
    `kept_out` counts the stuck, recurring and clipped readings; repeats in stretches that are `slower` are stuck.

    `recording`: of the part's own readings, [n] rows, where the logger `held` each.
    """

    recording: Recording
    values: Array
    working: Array
    drawn: Array
    lattice: Lattice | None
    stuck: Mask
    moving: Mask
    stuck_nats: float = 0.0
    clipped: Clipped | None = None
    recurring: Recurring | None = None
    misread: Misread | None = None
    uneven: Misread | None = None
    moved: Moved | None = None
    kept_out: Mapping[str, int] = field(default_factory=dict)
    held: Held | None = None
    changes: tuple[RateChange, ...] = ()
    slower: tuple[Slower, ...] = ()

    def counted(self, kept_out: Mapping[str, int]) -> dict[str, int]:
        """Samples that an engine does not use, by reason, with the readings in `kept_out`."""
        counts = {**self.kept_out, **{key: count + self.kept_out.get(key, 0) for key, count in kept_out.items()}}
        return {**counts, "not_finite": counts["not_finite"] - int((~np.isfinite(self.working)).sum())}

    @property
    def coarse(self) -> float:
        """Spacing of float32 at the largest reading, in noises of a reading."""
        values = self.working[np.isfinite(self.working)]
        with np.errstate(over="ignore"):
            largest = np.float32(np.abs(values).max(initial=0.0))
        noise = float(np.diff(values).std()) / math.sqrt(2.0) if values.size > 1 else 0.0
        return float(np.spacing(largest)) / noise if noise > 0.0 and np.isfinite(largest) else 0.0

    def matters(self, block: int) -> bool:
        """Whether the readings that moved change the noise of means of `block` readings by more than its scatter."""
        square = np.diff(block_means(np.where(self.stuck, np.nan, self.values), block)) ** 2
        moved = block_means(self.moving.astype(np.float64), block) > 0.0
        rest = square[np.isfinite(square) & ~(moved[1:] | moved[:-1])]
        # A squared difference of normal noise scatters by 1.7 times its mean: the two neighbours share a reading.
        most = (1.0 + math.sqrt(3.0 / max(rest.size, 1))) * float(np.mean(rest)) if rest.size else 0.0
        return float(np.nanmean(square)) > most

    @property
    def intervals(self) -> list[list[float]]:
        """Start and end of every stuck stretch, s."""
        time, step = self.recording.time_s, 1.0 / self.recording.rate_hz
        return [[float(time[a]), float(time[b - 1]) + step] for a, b in runs(self.stuck)]

    @property
    def slower_intervals(self) -> list[list[float]]:
        """Start and end of every stretch of a slower rate, s."""
        time, step = self.recording.time_s, 1.0 / self.recording.rate_hz
        ends = (stretch.rows[[0, -1]] for stretch in self.slower)
        return sorted([float(time[first - 1]), float(time[last]) + step] for first, last in ends)


def look(recording: Recording, axis: str, group: Group) -> Readings:
    """The readings of an axis at the part's own rate. O(n log n)."""
    even, changes = evened(recording)
    own, of_part = thinned(even, (axis,))
    return replace(readings_of(own, axis, group), held=of_part, changes=changes)


def within(values: NDArray[np.floating[Any]], group: Group) -> Mask:
    """Which readings [n] are no farther than the range of the part."""
    return np.asarray(np.abs(values) <= (group.range * (1.0 + RANGE_ROUNDED) if group.range > 0.0 else math.inf))


def mostly_beyond(values: NDArray[np.floating[Any]], group: Group) -> str:
    """A line if most readings [n] lie beyond the range: then the others are no readings either. Else empty."""
    there = _known(values)
    share = 1.0 - float(within(there, group).mean()) if there.size else 0.0
    if share <= WRONG_SHARE_MOST:
        return ""
    said = f"{100.0 * share:.0f} % of the readings are beyond the range of {group.range:g} {group.unit}: is the unit "
    return f"{said}right, or are words of the log swapped or lost?"


def readings_of(recording: Recording, axis: str, group: Group) -> Readings:
    """The readings of an axis of an evened and thinned recording. Looked at once, unless that takes much memory: ranges
    that hold all of them, or none, change nothing."""
    if recording.samples > KEPT_MOST:
        return _readings_of(recording, axis, group)
    looks: list[tuple[float, Readings]]
    looks = recording.seen.setdefault((axis, group.unit, group.stuck_limit), [])
    for known, readings in looks:
        values = (recording.in_unit(axis, group.unit), readings.values)
        most = max(float(np.max(np.abs(_known(each)), initial=0.0)) for each in values)
        if known == group.range or all(most <= limit or not limit > 0.0 for limit in (known, group.range)):
            return readings
    looks.append((group.range, _readings_of(recording, axis, group)))
    return looks[-1][1]


def _readings_of(recording: Recording, axis: str, group: Group) -> Readings:
    values = recording.in_unit(axis, group.unit)
    none = np.zeros(values.size, bool)
    misread = spans_of(values)
    if misread is not None and misread.undone is not None:
        values = misread.undone
    # Readings beyond the part's range are no readings: the engines leave them out. Many of them count as clipped,
    # where the median is near the range.
    inside = within(values, group)
    if not (inside.any() and np.ptp(values[inside]) > 0.0):
        return Readings(recording, values, values, values, None, none, none, misread=misread)
    beyond = float(np.mean(~inside & np.isfinite(values)))
    sound = values if inside.all() else np.where(inside, values, np.nan)
    near = group.range - abs(float(np.median(_known(sound)))) < BEYOND_SD * noise_of(values)
    if beyond > BEYOND_MOST and near:
        values = sound = np.clip(values, -group.range, group.range)
    lattice = lattice_of(_known(sound), recording.rate_hz)
    stuck, nats, stretches = _repeated(sound, lattice, group.stuck_limit)
    new = np.where(stuck, np.nan, sound) if stuck.any() else sound  # held readings have more of the held codes
    uneven = explained = None
    if misread is None and (lattice is None or not lattice.carried):
        explained = misread_of(new, lattice)
        if explained is not None and explained.kind in UNEVEN:
            uneven = explained
        elif explained is not None and explained.kind not in ELSEWHERE:
            misread = explained
    # The codes of a counter recur; a dead band takes its counts from its neighbours.
    counter = lattice is not None and lattice.carried > 0.0
    recurring = None if misread or uneven or counter else recurring_of(new, explained)
    lost = none if recurring is None else recurring.mask
    if lost.any():
        sound = np.where(lost, np.nan, sound)
        lattice = lattice_of(_known(sound), recording.rate_hz)
        stuck, nats, stretches = _repeated(sound, lattice, group.stuck_limit)
    if stuck.any():
        sound = np.where(stuck, np.nan, sound)
    repeats = repeats_of(stretches, values.size)
    left_out = lost | stuck | repeats
    values = np.where(left_out, np.nan, values) if left_out.any() else values
    moved, moving, time = moves_of(recording).get(axis), none.copy(), recording.time_s
    for begin_s, end_s in moved.intervals if moved is not None else ():
        moving |= (time >= begin_s) & (time < end_s)
    if stretches or moving.any():
        sound = np.where(repeats | moving, np.nan, sound)
    folded = misread is not None and misread.undone is None and misread.kind != "range_change"  # ends at zero
    clipped = None if folded else _clipped(sound, lattice)
    working = drawn = values
    if clipped is not None:
        working, drawn = _unclipped(sound, clipped, lattice)
    if moving.any():
        working, drawn = np.where(moving, np.nan, working), np.where(moving, values, drawn)
    stuck, moving = (mask if mask.any() else none for mask in (stuck, moving))  # they share an array
    saturated = 0 if clipped is None else int((clipped.mask | ~inside).sum())
    counts = {"saturated": saturated, "stuck": int((stuck | repeats).sum())}
    if recurring is not None:
        counts["outliers"] = int(lost.sum())
    return Readings(
        recording,
        values,
        working,
        drawn,
        lattice,
        stuck,
        moving,
        stuck_nats=nats,
        clipped=clipped,
        recurring=recurring,
        misread=misread,
        uneven=uneven,
        moved=moved,
        kept_out=counts,
        slower=stretches,
    )


def _known(values: NDArray[Any]) -> NDArray[Any]:
    """The finite values; no copy where all are finite."""
    finite = np.isfinite(values)
    return values if finite.all() else values[finite]


# ------------------------------------------------------------------------------------------------------ change of rate


def evened(recording: Recording) -> tuple[Recording, tuple[RateChange, ...]]:
    """The recording on an even grid, where its rate changes: means over an interval that all rates share."""
    off = recording.off_grid_s
    if off is None:
        return recording, ()
    time = recording.time_s
    time += off
    changes = tuple(rate_changes(time))
    if not changes:
        return recording, ()
    intervals = [1.0 / rate_hz for rate_hz in (changes[0].before_hz, *(change.after_hz for change in changes))]
    return _regridded(recording, time, [change.row for change in changes], intervals), changes


def _regridded(recording: Recording, time: Array, rows: Sequence[int], intervals: Sequence[float]) -> Recording:
    """Means of whole blocks over an interval that all parts share; a block with a gap in it is missing. `rows`: where
    each part but the first begins; `intervals` of every part, s."""
    blocks = _common(intervals)
    cell_s = float(np.dot(blocks, intervals)) / len(blocks)
    sizes = []
    first, last_s = 0, -math.inf
    index = np.empty(time.size, np.int64)
    for (begin, end), step, block in zip(pairwise([0, *rows, time.size]), intervals, blocks, strict=True):
        here = time[begin:end]
        if last_s > -math.inf and here[0] - last_s > cell_s + step:  # a gap at the change itself
            sizes.append(np.zeros(round((here[0] - last_s) / cell_s), np.int64))
            first += sizes[-1].size
        gaps = np.rint(np.maximum(0.0, np.diff(here, prepend=here[0]) - 0.5 * step) / step).astype(np.int64)
        gaps = np.where(gaps > 1, gaps - 1, 0)  # a late stamp is no gap
        cell = (np.arange(here.size) + np.cumsum(gaps)) // block
        index[begin:end] = first + cell
        sizes.append(np.full(int(cell[-1]) + 1, block))
        first, last_s = first + sizes[-1].size, float(here[-1])
    size = np.concatenate(sizes)
    used = np.bincount(index, minlength=first)
    whole = np.flatnonzero(used == size)
    missing = np.diff(whole, prepend=-1) - 1
    missing[0] = 0

    def means(values: Array) -> Array:
        return np.asarray(np.bincount(index, values, minlength=first)[whole] / used[whole])

    rate_hz = float(f"{1.0 / cell_s:.10g}")
    return _fewer(recording, rate_hz, means, np.searchsorted(index, whole), missing, time.size / first)


def _fewer(
    recording: Recording, rate_hz: float, made: Callable[[Array], Array], rows: Rows, missing: Rows, ratio: float
) -> Recording:
    """The recording of fewer rows, each `made` of `ratio` of its own from these `rows` [m] on, `missing` [m] before
    each."""
    columns = {
        name: column if column.clock is not None else replace(column, values=made(column.values))
        for name, column in recording.columns.items()
    }
    moved = recording.moving_before
    if moved is not None:
        total = np.cumsum(moved)[rows]
        moved = np.minimum(np.rint(np.diff(total, prepend=total[:1]) / ratio).astype(np.int64), missing)
    fewer = replace(recording, rate_hz=rate_hz, columns=columns, missing_before=missing, off_grid_s=None)
    return replace(fewer, moving_before=moved, moving=round(recording.moving / ratio))


def _common(intervals: Sequence[float]) -> tuple[int, ...]:
    """Samples of each interval (s) that take the same time: the fewest, else those that fit best within COMMON_S."""
    longest = max(intervals)
    times = np.arange(1, max(1, int(COMMON_S / longest)) + 1)[:, None] * longest
    counts = np.maximum(1, np.rint(times / intervals)).astype(np.int64)
    off = np.abs(counts * np.array(intervals) / times - 1.0).max(axis=1)
    return tuple(counts[np.argmax(off < COMMON_OFF) if off.min() < COMMON_OFF else np.argmin(off)].tolist())


# -------------------------------------------------------------------------------------------------------- held readings


def thinned(recording: Recording, axes: tuple[str, ...]) -> tuple[Recording, Held | None]:
    """The recording with each reading of the part once, where all of `axes` hold every reading for as long. Else the
    recording as it is, and None."""
    each = [_held(recording, (name,)) for name in axes]
    if not axes or any(own_held is None for own_held in each):
        return recording, None
    ratios = [own_held.ratio for own_held in each if own_held is not None]
    together = each[0] if len(axes) == 1 else _held(recording, axes)
    if together is None or max(ratios) > 1.01 * min(ratios):
        return recording, None
    rows, ratio = together.rows, together.ratio
    own = _fewer(recording, recording.rate_hz / ratio, lambda values: values[rows], rows, together.missing, ratio)
    return own, together


def own_rows(recording: Recording, axis: str) -> Rows | None:
    """The rows that hold a new reading of an axis, where it holds each for several rows; else None."""
    of_part = _held(recording, (axis,))
    return None if of_part is None else of_part.rows


def _held(recording: Recording, axes: tuple[str, ...]) -> Held | None:
    off = recording.off_grid_s
    places = recording.clock.place
    values = [recording.columns[name].values for name in axes]
    return held_of(values, places, None if off is None else off * recording.rate_hz)


# ------------------------------------------------------------------------------------------------------- stuck readings


def _repeated(values: Array, lattice: Lattice | None, stated: int) -> tuple[Mask, float, tuple[Slower, ...]]:
    """Stuck readings [n], their nats, and the stretches of a lower rate. Repeats belong to the likelier of the two."""
    stuck, nats = _stuck(values, lattice, stated)
    stretches = slower_stretches(values)
    if sum(stretch.nats for stretch in stretches) > nats:
        stuck, nats = _stuck(np.where(repeats_of(stretches, values.size), np.nan, values), lattice, stated)
    elif stuck.any():
        stretches = slower_stretches(np.where(stuck, np.nan, values))
    return stuck, nats, tuple(stretches)


def _many_runs(values: Array, starts: Rows, lengths: Rows) -> tuple[Mask, float]:
    """Repeats [n] in runs of equal readings of which there are more than the lattice makes, and the evidence in nats.

    By chance a code of the share p of its piece of the record makes n (1 - p) p^k runs longer than k: a run is worth
    -k ln p. A dependence of neighbours raises every p alike: as much as runs of two and of three readings say."""
    n, none = values.size, np.zeros(values.size, bool)
    size = max(PIECE_ROWS, -(-n // LEVEL_PIECES))
    long = lengths > 2
    if not long.any() or n < 2 * size:
        return none, 0.0
    piece = np.minimum(np.arange(n) // size, n // size - 1)
    _, code = np.unique(values, return_inverse=True)  # NaN share a code, and are in no run
    _, cell, counts = np.unique(piece * np.int64(n) + code, return_inverse=True, return_counts=True)
    of_run = counts[cell[starts[long]]]
    del piece, code, cell  # as long as the record
    many, cells = np.unique(counts, return_counts=True)
    readings, row = many * cells, np.searchsorted(many, of_run)
    # Chance of the first repeat, and of each later repeat; runs of two and of three show both.
    p = many / size
    pairs, (twos, threes) = float((p * readings).sum()), np.bincount(lengths, minlength=4)[2:4].tolist()
    alike = max(1.0, twos / max(pairs * (1.0 - pairs / n) ** 2, 1.0))
    first = np.minimum(p * alike, 1.0 - 1.0 / n)
    alone = threes / max(float((readings * first * p * (1.0 - first) ** 2).sum()), 1.0)
    later = np.minimum(p * max(alike, alone), 1.0 - 1.0 / n)
    each, once = -np.log(later), -np.log(first)
    worth = np.zeros(lengths.size)
    worth[long] = (lengths[long] - 2) * each[row] + once[row]
    best, least = 0.0, math.inf
    for nats in range(HELD_NATS, 0, -1):
        more = np.maximum(1.0, np.ceil((nats - once) / each))
        expected = float((readings * (1.0 - first) * first * later**more).sum()) + 1.0
        seen = float(np.count_nonzero(worth >= nats))
        if seen > HELD_TIMES * expected:
            best, least = max(best, float(kl_div(seen, expected))), nats
    if best < -LN_STUCK:
        return none, 0.0
    held = np.repeat(worth >= least, lengths)
    held[starts] = False
    return held, best


def _stuck(values: Array, lattice: Lattice | None, stated: int) -> tuple[Mask, float]:
    """Whole runs of equal readings [n] that are no chance, and the evidence in nats. `stated`: a length from which on a
    run is stuck whatever the chance; 0: none.

    The chance that a reading repeats is the largest of three: the noise stays within a cell of the lattice, the level
    in its middle; the share of repeats; their share among readings after a repeat, since a dead band has more.
    """
    n = values.size
    change, lengths = equal_runs(values)
    none = np.zeros(n, bool)
    if not (lengths > 1).any():
        return none, 0.0
    inside = 0.0
    if lattice is not None and math.isfinite(lattice.coarseness):
        # A coarse lattice shows its noise only roughly: 0.7 of it is the least.
        noise = math.sqrt(max(1.0 / lattice.coarseness**2 - 1.0 / 12.0, 0.01)) * (0.7 if lattice.too_coarse else 1.0)
        inside = 2.0 * float(ndtr(0.5 / noise)) - 1.0
    limit = n
    chance = max(inside, 0.01)
    for _ in range(4):
        wanted = 1 + math.ceil((LN_STUCK - math.log(n)) / math.log(min(chance, 1.0 - 1e-12)))
        if wanted == limit:
            break
        limit = wanted
        short = lengths[lengths < limit]
        repeats, twice = int((short - 1).sum()), int(np.maximum(short - 2, 0).sum())
        chance = max(inside, (repeats + 0.5) / n, (twice + 0.5) / (repeats + 50.0), 0.01)
    least = min(limit, stated) if stated > 0 else limit
    stuck = lengths >= least
    frozen = values[change[stuck]]
    if 2 * int(lengths[stuck].sum()) > n and int((frozen == frozen[np.argmax(lengths[stuck])]).sum()) > 1:
        return none, 0.0  # a single reading most of the time: the noise at rest is below the lattice
    long = np.repeat(stuck, lengths)
    rest = np.where(long, np.nan, values) if long.any() else values
    steps = np.diff(rest)
    steps = steps[np.isfinite(steps)]
    noise = float(steps.std()) / math.sqrt(2.0) if steps.size else 0.0
    near = lattice is not None and (lattice.too_coarse or lattice.step > HELD_COARSEST * noise)
    many, nats = (none, 0.0) if near else _many_runs(rest, *equal_runs(rest))
    if not long.any():
        return many, nats
    nats += float((lengths[stuck] - 1).sum()) * -math.log(min(chance, 1.0 - 1e-12)) - math.log(n)
    return long | many, min(1e6, max(nats, -LN_STUCK))


# ----------------------------------------------------------------------------------------------------- clipped readings


def _clipped(values: Array, lattice: Lattice | None) -> Clipped | None:
    """Readings [n] that pile up at their largest or smallest value, as the likelihood of their codes has it: noise
    would go on beyond it, and none does.

    Increments of a counter pile up on the codes about their mean, and none of them is lost.
    """
    if lattice is not None and lattice.carried:
        return None
    y, step = _known(values), 0.0 if lattice is None else lattice.step
    sides = []
    for side, edge in ((1, float(y.max())), (-1, float(y.min()))) if y.size >= 2 * PIECE_ROWS else ():
        at_edge = np.abs(values - edge) <= max(1e-9 * max(1.0, abs(edge)), 0.25 * step)
        others, count = values[np.isfinite(values) & ~at_edge], int(at_edge.sum())
        if count < CHANGED_LEAST or not (others.size and np.ptp(others) > 0.0):
            continue
        # An edge that the others do not come near is a word that the logger writes for lost readings.
        if (lattice is not None and lattice.too_coarse) or is_limit(others, edge, count, step):
            sides.append((side, edge, at_edge))
    if not sides:
        return None
    cells = Cells(y, step)
    plain = cells.fit(cells.own)
    gains = [(cells.fit(cells.limit(side)).over(plain), edge, at_edge) for side, edge, at_edge in sides]
    sure = [(nats, edge, at_edge) for nats, edge, at_edge in gains if nats >= nats_of("saturation")]
    return Clipped({edge: at_edge for _, edge, at_edge in sure}, sum(nats for nats, _, _ in sure)) if sure else None


def _unclipped(values: Array, clipped: Clipped, lattice: Lattice | None) -> tuple[Array, Array]:
    """Readings [n] to average in place of clipped readings, NaN where left out. Their means have the level and the
    spread of unclipped readings. Their number is the information of the clipped record. And the readings [n] with each
    clipped reading drawn anew.

    A clipped reading shows that the true reading lies beyond the limit (Tobit's model). To first order in the level the
    scores of the readings hold all that the record shows of it. EM finds the level and the noise to take them at. With
    the noise as the unit a score has the variance I, the information of a reading. So the scores of 1 / I readings have
    a sum of variance 1, as the deviation of an unclipped reading has.
    """
    rows = np.flatnonzero(np.isfinite(values))
    y = values[rows]
    half = 0.5 * lattice.step if lattice is not None else 0.0
    # A limit at or below the middle of the readings is a lower limit.
    middle = 0.5 * (float(y.max()) + float(y.min()))
    at_upper, at_lower, high, low = *np.zeros((2, y.size), bool), math.inf, -math.inf
    for limit, mask in clipped.limits.items():
        if limit > middle:
            at_upper, high = mask[rows], limit - half
        else:
            at_lower, low = mask[rows], limit + half
    window = _quiet_window(y)
    level = _smooth(y, window)
    sigma = float((y - level).std())
    score, information = y, y
    for _ in range(EM_STEPS_MOST):
        # Without a limit, a value beyond all normal readings adds nothing to the sums.
        up = np.clip((high - level) / sigma, -4.0, 37.0)
        down = np.clip((low - level) / sigma, -37.0, 4.0)
        # About the level, in the noise: the score of the level, the expected square and the expected information.
        u, p, q = ((y - level) / sigma, *(np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi) for z in (up, down)))
        above, below = p / ndtr(-up), q / ndtr(down)
        score = np.where(at_upper, above, np.where(at_lower, -below, u))
        second = np.where(at_upper, 1.0 + up * above, np.where(at_lower, 1.0 - down * below, u * u))
        information = ndtr(up) - ndtr(down) - up * p + down * q + p * above + q * below
        known = np.maximum(_smooth(information, window), CLIPPED_SHARE_LEAST)
        level = _smooth(information * level + sigma * score, window) / known
        level = np.clip(level, low - 4.0 * sigma, high + 4.0 * sigma)
        before, sigma = sigma, sigma * math.sqrt(float(second.mean()))
        if abs(sigma / before - 1.0) < EM_SETTLED:
            break
    score = np.where(information < CLIPPED_SHARE_LEAST, 0.0, score)
    total = np.cumsum(np.where(information < CLIPPED_SHARE_LEAST, 0.0, information))
    last = np.flatnonzero(np.floor(total) > np.floor(np.concatenate([[0.0], total[:-1]])))
    sums = np.diff(np.concatenate([[0.0], np.cumsum(score)[last]]))
    working = np.full(values.size, np.nan)
    working[rows[last]] = level[last] + sigma * sums
    drawn = values.copy()
    random = np.random.default_rng(1)
    for mask, sign, edge in ((at_upper, 1.0, high), (at_lower, -1.0, low)):
        # The tail of the normal beyond the limit, by its inverse.
        least = sign * (edge - level[mask]) / sigma
        ln_p = log_ndtr(-least) + np.log(1.0 - random.random(int(mask.sum())))
        drawn[rows[mask]] = level[mask] - sign * sigma * ndtri_exp(ln_p)
    return working, drawn


def _smooth(values: Array, window: int) -> Array:
    if window >= values.size:
        return np.full(values.size, float(values.mean()))
    return np.asarray(uniform_filter1d(values, window, mode="nearest"))


def _quiet_window(y: Array) -> int:
    """Readings over which the mean of a record [n] is quietest: the averaging length of the least Allan variance. It is
    all of them where the longest that the record shows is the best."""
    best, least, length = PIECE_ROWS, math.inf, PIECE_ROWS
    means = block_means(y, length)
    while means.size >= PIECES_LEAST:
        variance = 0.5 * float((np.diff(means) ** 2).mean())
        if variance < least:
            best, least = length, variance
        means = block_means(means, 2)
        length *= 2
    return y.size if 2 * best >= length else best


# ------------------------------------------------------------------------------------------------------ copied columns


def copied(recording: Recording, name: str, others: Sequence[str]) -> str:
    """A line for a column that copies a column of `others`, without noise of its own; else empty."""
    own = np.diff(recording.columns[name].values)
    for other in others:
        theirs = np.diff(recording.columns[other].values)
        if own.size != theirs.size:
            continue
        both = np.isfinite(own) & np.isfinite(theirs)
        a, b = own[both], theirs[both]
        if both.sum() < LEVEL_PIECES or not (a.any() and b.any()):
            continue
        factor = float(np.dot(a, b)) / float(np.dot(b, b))
        left, size = float(np.mean((a - factor * b) ** 2)), float(np.mean(a**2))
        if left < LIKE * size:
            steps = (step_of(recording.columns[column].values)[0] for column in (name, other))
            left -= LATTICE_COPY / 6.0 * float(np.dot(np.square([*steps]), (1.0, factor**2)))
        if left <= FLOAT_COPY * size:
            return f"its readings are those of {other}, but for a factor and an offset: which column is {name}?"
    return ""
