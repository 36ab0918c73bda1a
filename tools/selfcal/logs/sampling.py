"""Sampling rate and missing samples from time stamps.

Stamps that are fine beside the sampling interval show it: it is the median step, and a missing sample a step of two.
Stamps of 1 ms at 819.2 Hz do not: steps of 1 and 2 ms alternate, and a missing sample looks much like its neighbours.
What such stamps do obey is that sample k was stamped within one lattice step of k dt. A sequential decoder follows the
times that are still possible under a supposed dt: where none is left a sample is missing. Of all dt the one that needs
the fewest missing samples is taken; where others need hardly more, the stamps cannot tell and that is said.
Stamps at random times, or in the bursts of a bus, lie on no grid. They have a mean rate, and gaps where these are long.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.special import betaln

#: Intervals of a record at most.
_LONGEST = 2.0**53
#: Steps in one window of the first estimate.
_WINDOW = 64
#: Lattice step over interval from which stamps are coarse; below it a step of one interval is never taken for two.
_COARSE = 0.25
#: Rows that decide on dt, the shares of missing samples and of a too long first estimate, the step of dt.
_HEAD, _LOST, _LONG, _STEP = 3000, 0.25, 0.05, 1e-4
#: Change of rate within a record that the decoder follows.
_WANDER = 3e-5
#: Lattice steps between a sample and its stamp: less than one where the interval is a multiple, or a simple fraction,
#: of the lattice; more where stamps come late.
_SLACKS = np.array([0.02, 1.0, 1.5]) * 1.0001
#: Missing samples a row that a slack must save: none up to a lattice step; beyond, a stamp could be any of 1.5 (0.4 nat
#: a row, where a missing sample costs some 3), and such a slack would swallow gaps.
_PRICE = np.array([0.0, 0.0, 0.15])
#: A stamp that fits nowhere weighs as many missing samples.
_ODD = 10
#: Steps of which one interval is taken, so that bursts of stamps and single gaps do not matter; pieces of a record.
_STEPS, _PIECES = 20, 500
#: A part of one rate must save so many squares of the scatter between neighbouring pieces.
_PRICE_OF_PART = 40.0
#: Share from which on the intervals show a change of rate: beside it `readings.py` looks for a bend.
_CHANGE = 0.015
#: Without a grid a step of so many mean ones is a gap.
_GAP = 20.0
#: Rows of a stretch, half turns in it that are tried to either side, stretches at most, and the least mean square
#: length: jitter of 0.2 dt. Independent steps that spread by 0.15 dt and more stay below it.
_STRETCH, _TRIED, _STRETCHES, _COHERENT = 4000, 32, 25, 0.2
#: Rows over which a grid's phase is followed.
_PIECE_OF_GRID = 100
#: Places in one interval whose spectrum is taken, and places of it at most.
_FINE, _OTHER_PLACES = 64, 1 << 22
#: A grid behind jitter: the slowest and the fastest line, turns in the mean step, but for grids with little jitter; and
#: the largest of random times over the power of their noise, e^-10 among a few thousand, which bins about it show.
_LINE_FIRST, _LINE_LAST, _LINE_CHANCE, _LINE_ABOUT = 0.9, 4.0, 25.0, 64
#: A grid that loses samples: rows that show it, lattice steps looked at, and the power of a line over that around it
#: beyond the largest of as many by chance. The slowest waves are the losses' own.
_ROWS_LEAST, _PLACES, _LINE, _SLOWEST = 500, 1 << 20, 20.0, 16
#: Steps of one lattice step that such a grid has at least, and their share over that of independent losses.
_ONES, _ONES_SHARE = 20, 0.7
#: Another dt with this many missing samples more or fewer is as good.
_AS_GOOD = 5

#: Steps between stretches of samples, in usual steps; samples of a stretch and gaps of a rhythm at least; the share of
#: the gaps that keep to a rhythm, and gaps in a period of losses at most.
_ASLEEP, _AWAKE, _RHYTHM, _OF_PATTERN = 20.0, 20, 0.9, 4
#: Stamps come in bursts where so many steps are shorter than this share of the mean one.
_SHORT_STEPS, _BURST = 0.3, 0.45
#: Mean steps, times the samples of a burst, by which stamps may stray from a steady count; bursts' distances beyond
#: which there is a gap.
_STRAY, _BURST_GAP = 5.0, 8.0

Found = tuple[float, NDArray[np.int64]]


class Ambiguous(ValueError):
    """The stamps do not tell the rate; the text says why."""


def sampling(time: NDArray[np.float64], noise_s: float, rate: float | None) -> Found:
    """Interval (s) and missing_before[n] of time stamps float64[n] (s, from 0, not decreasing but where
    batches of one length overlap).

    `noise_s`: their rounding noise. `rate`: the stated rate (Hz) if there is one. Raises Ambiguous. Coarse stamps of a
    record with gaps take about a second and 10^6 rows another; all others are fast.
    """
    steps = np.diff(time)
    asleep = _asleep(time, steps)
    if asleep.any():
        closed = np.where(asleep, _usual(steps), steps)
        dt, missing = sampling(np.concatenate(([0.0], np.cumsum(closed))), noise_s, rate)
        # No sleep moves the grid of all stretches from the stamps by more than half an interval.
        place = np.cumsum(missing) + np.arange(time.size)
        rows = np.flatnonzero(asleep) + 1
        slept = np.rint(time[rows] / dt).astype(np.int64) - place[rows]
        missing[rows] += np.diff(slept, prepend=0)
        return _slope(np.cumsum(missing) + np.arange(time.size), time), missing
    counted = _by_count(time, steps, rate)
    if (steps < 0.0).any() and counted is None:
        raise Ambiguous("the stamps fall, and their count is not steady")
    if counted is not None and (steps != 0.0).all():
        return counted
    return _on_even_grid(time, steps, noise_s, rate)


def _on_even_grid(time: NDArray[np.float64], steps: NDArray[np.float64], noise_s: float, rate: float | None) -> Found:
    """Interval and missing_before[n] of samples that were taken one by one. Raises Ambiguous."""
    changes = rate_changes(time) if rate is None else []
    if changes:
        dt = min(min(one.before_s, one.after_s) for one in changes)
        return dt, np.concatenate(([0], np.maximum(0, np.rint(steps / dt).astype(np.int64) - 1)))
    window = max(1, min(_WINDOW, steps.size // 4))
    typical = float(np.median(time[window:] - time[:-window], overwrite_input=True)) / window
    lattice = common_step(steps, max(4.0 * noise_s, 1e-9 * typical))
    if lattice > _COARSE * typical:
        try:
            return _coarse(time, lattice, typical, rate)
        except Ambiguous:
            if rate is None:
                raise
            return 1.0 / rate, _decode(time, 1.0 / rate, lattice)[0]
    if lattice > 0.0 and _lossy(np.rint(steps / lattice)):
        return _on_every_step(time, lattice)
    usual = _usual(steps)
    if _in_batches(steps, usual):
        return _slope(np.arange(time.size), time), np.zeros(time.size, np.int64)
    dt = _shortest(steps)
    if not _even(time, dt):
        dt = _line(time, typical, lattice)
    return _on_grid(time, dt) if dt > 0.0 else _mean_grid(steps)


def _asleep(time: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.bool_]:
    """bool[n - 1]: the steps between stretches of an even grid, whatever they last; none for other stamps."""
    usual = _usual(steps)
    # Samples that come at once after a step make up for it.
    long = (steps > _ASLEEP * usual) & (np.append(steps[1:], usual) > 0.5 * usual)
    count = int(np.count_nonzero(long))
    if not 0 < count * _AWAKE < steps.size:
        return np.zeros_like(long)
    closed = np.where(long, usual, steps)
    shows = np.mean(np.abs(closed - usual) < 1e-3 * usual) > _RHYTHM or _even(np.cumsum(closed), usual)
    return long if shows else np.zeros_like(long)


def _in_batches(steps: NDArray[np.float64], usual: float) -> bool:
    """Whether steps of another length come in a rhythm and are no whole intervals: a batch is stamped by another
    interval than its own."""
    gaps = np.abs(steps - usual) > 0.15 * usual
    if not in_rhythm(np.flatnonzero(gaps)):
        return False
    turns = steps[gaps] / float(steps[~gaps].mean())
    off = turns - np.rint(turns)
    return abs(float(off.mean())) > 5.0 * float(off.std()) / math.sqrt(off.size) + 1e-3


def in_rhythm(rows: NDArray[np.int64]) -> bool:
    """Whether rows, four or more apart, are as far apart from each other, but for one row."""
    runs = np.diff(rows)
    if runs.size < _AWAKE or np.median(runs) < 4:
        return False
    return bool(np.mean(np.abs(runs - np.median(runs)) <= 1) >= _RHYTHM)


def in_pattern(steps: NDArray[np.float64]) -> bool:
    """Whether the steps of more than one interval, of those steps [n - 1], come again in periods of a few."""
    rows = np.flatnonzero(steps > 1.5)
    each = np.stack([np.diff(rows), steps[rows[1:]]]) if rows.size > _AWAKE else np.zeros((2, 0))
    periods = range(1, 1 + min(_OF_PATTERN, each.shape[1] - 1))
    return any(np.mean((each[:, k:] == each[:, :-k]).all(axis=0)) >= _RHYTHM for k in periods)


def overlapping(time: NDArray[np.float64]) -> bool:
    """Whether stamps fall in a rhythm, and go on from there: batches overlap. Where rows are swapped they catch up."""
    steps = np.diff(time)
    rows = np.flatnonzero(steps < 0.0)
    around = time[np.minimum(rows + 4, time.size - 1)] - time[np.maximum(rows - 3, 0)]
    return in_rhythm(rows) and float(np.median(around)) < 6.0 * float(np.median(steps))


def _by_count(time: NDArray[np.float64], steps: NDArray[np.float64], rate: float | None) -> Found | None:
    """Interval and missing_before of samples that arrive in bursts and are stamped on arrival, or in batches whose
    stamps overlap; None for other stamps.

    Of such stamps only the count over time is steady: it must follow one line, but for gaps between bursts.
    """
    if time.size < 3 * _AWAKE:
        return None
    at = np.linspace(0, time.size - 1, _AWAKE + 1).astype(int)
    mean = float(np.median(np.diff(time[at]) / np.diff(at)))  # gaps are in few of the pieces
    overlap = steps < 0.0
    starts = np.flatnonzero(overlap if overlap.any() else steps > mean) + 1
    if (np.mean(steps < _BURST * mean) < _SHORT_STEPS and not overlap.any()) or starts.size < _AWAKE:
        return None
    size = time.size / (starts.size + 1)
    cuts = (np.flatnonzero(steps > _BURST_GAP * float(np.median(np.diff(time[starts])))) + 1).tolist()
    index = np.arange(time.size)
    dt = _slope(index, time, cuts) if rate is None else 1.0 / rate
    parts = np.split(time - index * dt, cuts)
    stray = [_STRAY * max(size, 2.0) * dt + (0.0 if rate is None else 0.01 * part.size * dt) for part in parts]
    if any(float(np.ptp(part)) > most for part, most in zip(parts, stray, strict=True)):
        return None
    # Arrival is late by a varying time, never early: the earliest of a few bursts are nearest to the clock.
    reach = max(1, round(10.0 * size))
    missing = np.zeros(time.size, np.int64)
    for cut, (before, after) in zip(cuts, pairwise(parts), strict=True):
        missing[cut] = max(0, round((after[:reach].min() - before[-reach:].min()) / dt))
    return dt, missing


def _slope(index: NDArray[np.int64], time: NDArray[np.float64], cuts: Sequence[int] = ()) -> float:
    """The slope of `time` against `index` by least squares, with a level of its own after each of the rows `cuts`."""
    part = np.repeat(np.arange(len(cuts) + 1), np.diff([0, *cuts, time.size]))
    count = np.bincount(part)
    x = index - (np.bincount(part, index) / count)[part]
    y = time - (np.bincount(part, time) / count)[part]
    return float(x @ y / (x @ x))


def _usual(steps: NDArray[np.float64]) -> float:
    """The median of the steps that are no repeats."""
    return float(np.median(steps[steps > 0.0], overwrite_input=True))


def _shortest(steps: NDArray[np.float64]) -> float:
    """The interval that makes whole numbers of all steps, of which a quarter or more is a single one."""
    dt = float(np.quantile(steps, 0.25))
    for _ in range(4):
        dt = float(steps.sum() / np.rint(steps / dt).sum())
    return dt


def _even(time: NDArray[np.float64], dt: float) -> bool:
    """Whether stamps lie on a grid of `dt`, jitter and lost samples or not.

    exp(2 pi i t / dt) of grid times with jitter of the sd s has the mean length exp(-2 (pi s / dt)^2) in any stretch.
    Of steps that are independent it decays along a stretch. A rate that is slightly off turns it, so a few are tried.
    """
    length = min(_STRETCH, time.size)
    rows = time[: time.size // length * length].reshape(-1, length)
    rows = rows[:: math.ceil(len(rows) / _STRETCHES)]
    turns = (rows - rows[:, :1]) / dt
    off = np.arange(-_TRIED, _TRIED + 1) / (2.0 * max(length, float(np.median(turns[:, -1]))))
    lengths = [np.abs(np.exp(2j * math.pi * turns * (1.0 + each)).mean(axis=1)) ** 2 for each in off]
    return bool(np.median(np.max(lengths, axis=0)) > _COHERENT)


def thinned_grid(time: NDArray[np.float64], dt: float) -> bool:
    """Whether stamps lie on a grid of `dt` and on none of two or three times that: it lost samples, however many."""
    return _even(time, dt) and not _even(time, 2.0 * dt) and not _even(time, 3.0 * dt)


def _line(time: NDArray[np.float64], typical: float, lattice: float) -> float:
    """Interval, s, of a grid that jitter and losses hide from single steps; 0 if the stamps have none.

    A grid is a line in the spectrum of the stamps, jitter of the sd s dt leaves exp(-(2 pi s)^2) of its power. The
    stamps' own `lattice` is one as well. Of `typical`, the mean step, the grid may keep so many samples."""
    head = time[:_STRETCH]
    head = head[head < _OTHER_PLACES / _FINE * typical]
    stamped = np.bincount(np.rint(head * (_FINE / typical)).astype(np.int64))
    power = np.abs(rfft(stamped, 2 * stamped.size)) ** 2 / head.size**2
    turns = np.arange(power.size) * (_FINE / (2.0 * stamped.size))
    shown = (turns > _LINE_FIRST) & ((turns < _LINE_LAST) | (power > _COHERENT))
    shown &= turns * lattice < 0.5 * typical
    if not shown.any():
        return 0.0
    at = int(np.argmax(np.where(shown, power, 0.0)))
    dt = typical / float(turns[at])
    noise = float(np.median(power[max(0, at - _LINE_ABOUT) : at + _LINE_ABOUT])) / math.log(2.0)
    return dt if float(power[at]) > _LINE_CHANCE * max(noise, 1.0 / head.size) else 0.0


def _mean_grid(steps: NDArray[np.float64]) -> Found:
    """The mean step without gaps, and the samples missing in those."""
    dt = float(steps.mean())
    for _ in range(8):
        dt = float(steps[steps < _GAP * dt].mean())
    return dt, np.concatenate(([0], np.where(steps < _GAP * dt, 0, np.rint(steps / dt).astype(np.int64) - 1)))


@dataclass(frozen=True)
class Change:
    """The first `row` at another rate, the intervals before and after it (s), and the evidence in nats."""

    row: int
    before_s: float
    after_s: float
    nats: float


def rate_changes(time: NDArray[np.float64]) -> list[Change]:
    """Every change of rate in stamps float64[n], s, in order of time.

    A rate must last two pieces of n / _PIECES rows, or of 3 * _STEPS; one that differs much, of _STEPS."""
    found = _parts(time, 3 * _STEPS) or _parts(time, _STEPS)
    steps = np.diff(time)
    # A burst after a stall makes up for it: samples of one rate, stamped late.
    late = (steps[max(0, one.row - 3) : one.row + 2].max() > _STEPS * max(one.before_s, one.after_s) for one in found)
    # Levels of coarse stamps may differ where their mean intervals do not.
    same = (abs(math.log(one.after_s / one.before_s)) < 0.5 * _CHANGE for one in found)
    return [] if any(late) or any(same) else found


def _parts(time: NDArray[np.float64], least: int) -> list[Change]:
    """The changes between parts of some pieces, which have `least` rows or more."""
    n = time.size
    size = max(least, n // _PIECES)
    if n < 6 * size:
        return []
    steps = (time[_STEPS:] - time[:-_STEPS]) / _STEPS
    count = steps.size // size
    pieces = steps[: count * size].reshape(count, size)
    middle = np.quantile(pieces, 0.25, axis=1, keepdims=True)  # a lost row makes windows longer, and few shorter
    if not middle.min() > 0.0:
        return []
    # Quantiles of coarse stamps jump by a step of their lattice, means move with gaps: a change of rate does both.
    near = (pieces > 0.5 * middle) & (pieces < 1.5 * middle)
    value = np.log(middle[:, 0])
    mean = np.log((pieces * near).sum(axis=1) / near.sum(axis=1))
    parts = _constant(value, mean)
    if len(parts) < 2:
        return []
    level = [math.exp(float(np.median(value[a:b]))) for a, b in parts]
    lattice = common_step(np.diff(time), 1e-6 * min(level)) if max(level) > 1.05 * min(level) else 0.0
    # The longest step without a loss: stamps are rounded up at most to the next place of their lattice.
    most = [max(1.5 * step, 1.001 * lattice * math.ceil(step / lattice - 1e-3) if lattice else 0.0) for step in level]
    pairs = zip(pairwise(parts), pairwise(level), pairwise(most), strict=True)
    ends = [0, *(_bend(time, *found, size) for found in pairs), n]
    spans = [slice(a, b) for a, b in pairwise(ends)]
    if any(b - a < 2 * _STEPS for a, b in pairwise(ends)) or _lossy_parts(time, spans, level, lattice):
        return []
    own = [np.diff(time[one.start : one.stop + 1]) for one in spans]
    kept = [each[(each > 0.5 * step) & (each < last)] for each, step, last in zip(own, level, most, strict=True)]
    exact = [float(each.mean()) for each in kept]
    scatter = max(1e-3, _scatter(value, parts))
    return [
        Change(row, *intervals, min(1e6, 0.5 * n * math.log(intervals[1] / intervals[0]) ** 2 / scatter**2))
        for row, intervals in zip(ends[1:-1], pairwise(exact), strict=True)
    ]


def _constant(value: NDArray[np.float64], mean: NDArray[np.float64]) -> list[tuple[int, int]]:
    """First piece and the piece after the last of every part of one rate. `value` and `mean` [pieces]: ln of the
    interval by the quantile and by the mean. A piece with a change in it belongs to no part.

    The sum of squares about the levels of the parts, and a price for each part, is the least (optimal partition).
    """
    count = value.size
    total, square = (np.concatenate([[0.0], np.cumsum(one)]) for one in (value - value[0], (value - value[0]) ** 2))
    noise = max(float(np.median(np.abs(np.diff(value)))), 0.05 * _CHANGE)
    best, start = np.zeros(count + 1), np.zeros(count + 1, np.int64)
    for end in range(1, count + 1):
        begin = np.arange(end)
        cost = square[end] - square[:end] - (total[end] - total[:end]) ** 2 / (end - begin)
        each = best[:end] + cost / noise**2 + _PRICE_OF_PART
        start[end] = int(each.argmin())
        best[end] = each[start[end]]
    ends = [count]
    while ends[-1] > 0:
        ends.append(int(start[ends[-1]]))
    parts = [(a, b) for a, b in pairwise(ends[::-1]) if b - a > 1]
    while len(parts) > 1:
        scatter = _scatter(value, parts)
        apart = [_apart(value, one, other) for one, other in pairwise(parts)]
        means = [_apart(mean, one, other) for one, other in pairwise(parts)]
        sound = [
            abs(step) >= max(_CHANGE, 6.0 * scatter) and abs(both - step) <= 0.3 * abs(step)
            for step, both in zip(apart, means, strict=True)
        ]
        if all(sound):
            break
        join = min((k for k in range(len(sound)) if not sound[k]), key=lambda k: abs(apart[k]))
        parts[join : join + 2] = [(parts[join][0], parts[join + 1][1])]
    return parts


def _apart(value: NDArray[np.float64], one: tuple[int, int], other: tuple[int, int]) -> float:
    """How far the level of a part is above the level of the part before."""
    return float(np.median(value[slice(*other)]) - np.median(value[slice(*one)]))


def _scatter(value: NDArray[np.float64], parts: list[tuple[int, int]]) -> float:
    """Distance from the level of its part that one piece in ten exceeds, the largest of all parts of ten pieces and of
    all together."""
    off = [np.abs(value[a:b] - np.median(value[a:b])) for a, b in parts]
    return max(float(np.quantile(one, 0.9)) for one in [np.concatenate(off), *(one for one in off if one.size >= 10)])


def _bend(
    time: NDArray[np.float64],
    parts: tuple[tuple[int, int], tuple[int, int]],
    level: tuple[float, float],
    most: tuple[float, float],
    size: int,
) -> int:
    """First row of the second of two parts [first piece, piece after], with intervals `level`, s, of `most`: the row
    farthest from the line of the mean interval, gaps left out."""
    (begin, a), (b, end) = parts
    first = max(0, (max(begin + 1, a - 1)) * size)
    last = min(time.size - 1, min(end, b + 2) * size + (_STEPS if end - b > 2 else 0))
    each = np.diff(time[first : last + 1])
    line = np.cumsum(np.where(each < max(most), each - 0.5 * sum(level), 0.0))
    return first + 1 + int(np.argmax(line) if level[0] > level[1] else np.argmin(line))


def _lossy_parts(time: NDArray[np.float64], spans: list[slice], level: list[float], lattice: float) -> bool:
    """Whether a part is no slower one: it lies on the grid of the fastest part, and on none of its own interval, nor
    are its stamps rounded to a coarse `lattice`."""
    fastest = min(level)
    heads = [(time[one][:_STRETCH], step) for one, step in zip(spans, level, strict=True) if step > 1.1 * fastest]
    coarse = [lattice > _COARSE * fastest and in_pattern(np.rint(np.diff(head) / lattice)) for head, _ in heads]
    return any(
        not _even(head, step) and _even(head, fastest)
        for (head, step), rounded in zip(heads, coarse, strict=True)
        if not rounded
    )


def common_step(steps: NDArray[np.float64], tolerance: float) -> float:
    """Step, s, of the lattice that all time stamps lie on: the steps are multiples of it. 0 where there is none."""
    ordered = steps[steps > tolerance]
    ordered.sort()
    if ordered.size == 0:
        return 0.0
    starts = np.concatenate([[0], np.flatnonzero(np.diff(ordered) > tolerance) + 1])
    if starts.size > 1000:
        return 0.0
    distinct = np.add.reduceat(ordered, starts) / np.diff(starts, append=ordered.size)
    lattice = 0.0
    for step in distinct.tolist():
        rest = step
        while rest > 10.0 * tolerance:  # Euclid's algorithm
            lattice, rest = rest, abs(lattice - rest * round(lattice / rest))
    times = np.rint(distinct / lattice)
    if (np.abs(distinct - times * lattice) > np.maximum(10.0 * tolerance, 0.01 * lattice)).any():
        return 0.0
    return float(distinct @ times / (times @ times))


# ------------------------------------------------------------------------------------------------------- fine stamps


def _on_grid(time: NDArray[np.float64], dt: float) -> Found:
    """The nearest places of a grid of about `dt` whose phase and rate are followed over pieces of the record.

    A sample may be late, and none after it is then; it is not early."""
    if not time[-1] < _LONGEST * dt:
        raise Ambiguous(f"a step of {float(np.diff(time).max()):.3g} s among others of {dt:.3g} s")
    turns, _ = followed_phase(np.ones(time.size), time, 1.0 / dt, _PIECE_OF_GRID)
    place = np.rint(turns).astype(np.int64) - np.arange(time.size)
    missing = np.diff(np.minimum.accumulate(place[::-1])[::-1], prepend=place.min())
    missing[0] = 0
    return float(time[-1]) / (time.size - 1 + int(missing.sum())), missing


def followed_phase(
    x: NDArray[np.float64], time: NDArray[np.float64], frequency: float, block: int
) -> tuple[NDArray[np.float64], float]:
    """Phase [n], turns, of the line near a frequency in x [n] at these times, followed over blocks of so many rows; and
    the size of the line. It is whole where x is largest."""
    edges = np.arange(0, max(1, x.size // block)) * block
    middle = np.add.reduceat(time, edges) / np.diff(edges, append=x.size)
    phase = frequency * time
    for _ in range(3):
        line = np.add.reduceat(x * np.exp(-2j * math.pi * phase), edges)
        turns = np.unwrap(np.angle(line)) / (2.0 * math.pi)
        if edges.size < 2:
            phase = phase + turns[0]
            continue
        slope = np.diff(turns) / np.diff(middle)
        phase = phase + np.interp(time, middle, turns)
        phase += slope[0] * np.minimum(time - middle[0], 0.0) + slope[-1] * np.maximum(time - middle[-1], 0.0)
    return phase, float(np.abs(np.add.reduceat(x * np.exp(-2j * math.pi * phase), edges)).sum())


# ----------------------------------------------------------------------------------------------------- coarse stamps


def _coarse(time: NDArray[np.float64], lattice: float, typical: float, rate: float | None) -> Found:
    steps = np.rint(np.diff(time) / lattice)
    whole = _unbroken(time, lattice)
    # A lattice that is no tick of a clock, but for this one, is the interval itself.
    own = rate is None and steps.min() == 1.0 and not _is_tick(lattice)
    if whole is not None and not (own or (steps.min() >= 1.0 and _rather_lossy(steps, lattice, whole, rate))):
        return _slope(np.arange(time.size), time), np.zeros(time.size, np.int64)
    if whole is not None or _lossy(steps):
        return _on_every_step(time, lattice)
    low, high = (typical * (1.0 - _LOST), typical * (1.0 + _LONG)) if rate is None else (0.99 / rate, 1.01 / rate)
    head = time[:_HEAD]
    grid, scores = _scan(head, lattice, low, high)
    try:
        found = _scanned(time, lattice, grid, scores)
    except Ambiguous:
        if not own or np.mean(steps > 1.0) > 0.1:
            raise
    else:
        if not own:
            return found
    return _on_every_step(time, lattice)


def _is_tick(lattice: float) -> bool:
    """Whether a lattice is a clock's tick, 10^-k or 2^-k s, and not the interval itself."""
    return min(abs(one - round(one)) for one in (math.log10(lattice), math.log2(lattice))) < 1e-6


def _rather_lossy(steps: NDArray[np.float64], lattice: float, whole: float, rate: float | None) -> bool:
    """Whether a grid of one lattice step that lost samples is likelier than the unbroken one of the interval `whole`.

    Bayes: at an unknown share of losses B(m, n) for m lost ones, and nearly pi^2/n^3 for one line of pixels. A stated
    rate decides."""
    if rate is not None:
        return abs(rate * lattice - 1.0) < abs(rate * whole - 1.0)
    lost, n = int(steps.sum()) - steps.size, steps.size
    pixels = 2.0 * math.log(math.pi) - 3.0 * math.log(n)
    return lost > 0 and float(betaln(lost, n)) - math.log(10.0) > pixels


def _lossy(steps: NDArray[np.float64]) -> bool:
    """Whether whole numbers of lattice steps are those of an even grid of one step that loses samples.

    Random times repeat a stamp half as often as they take neighbouring ones, or keep a distance; a grid does neither.
    Another rate on the lattice is a line in the spectrum of the steps that have a stamp, however many samples are lost.
    Losses, one by one or in bursts, make no line. Those in a pattern do; steps of another rate differ by one."""
    if steps.min() < 1.0:
        return False
    spread = max(np.ptp(np.quantile(one, [1.0 - _RHYTHM, _RHYTHM])) for one in (steps, steps[1:] + steps[:-1]))
    if spread >= 2.0 and steps.min() == 1.0 and in_pattern(steps):
        return True
    head = np.cumsum(steps)
    head = head[: int(np.searchsorted(head, _PLACES))].astype(np.int64)
    if head.size < _ROWS_LEAST or head[-1] <= head.size:
        return False
    ones = int(np.count_nonzero(steps[: head.size] == 1.0))
    if ones < max(_ONES, _ONES_SHARE * head.size**2 / int(head[-1])):
        return False
    taken = np.zeros(int(head[-1]) + 1)
    taken[head] = 1.0
    power = np.abs(rfft(taken - taken.mean())[1:]) ** 2
    band = power[_SLOWEST:]
    return bool(band.max() <= (math.log(power.size) + _LINE) * float(np.median(band)) / math.log(2.0))


def _on_every_step(time: NDArray[np.float64], lattice: float) -> Found:
    """The even grid of one lattice step."""
    steps = np.rint(np.diff(time) / lattice).astype(np.int64)
    return float(time[-1] - time[0]) / int(steps.sum()), np.concatenate(([0], steps - 1))


def _scanned(
    time: NDArray[np.float64], lattice: float, grid: NDArray[np.float64], scores: NDArray[np.float64]
) -> Found:
    """The dt of a scan's grid [m] with the best of its scores [m, slacks], if there is but one."""
    head = time[:_HEAD]
    each = scores.min(axis=1)
    repeats = bool((np.diff(head) < 0.5 * lattice).any())  # by an interval that is shorter than the lattice
    best = int(each.argmin()) if repeats else _on_lattice(grid, each, lattice)
    reach = 1e-3 + 4.0 * lattice / (head.size * grid[best])  # dt that far apart are the same to these rows
    same = np.abs(grid / grid[best] - 1.0) < reach
    rivals = grid[~same & (each < each[best] + _AS_GOOD)]
    exact = abs(grid[best] / lattice - np.rint(grid[best] / lattice)) < 1e-9
    if rivals.size and not exact:
        raise Ambiguous(
            f"stamps of {lattice:.3g} s are too coarse to tell {1.0 / grid[best]:.4g} from {1.0 / rivals[0]:.4g} Hz"
        )
    near = np.flatnonzero(same)
    for column, slack in enumerate(_SLACKS):
        fit = scores[near, column]
        if fit.min() > 1.1 * each[best] + _AS_GOOD:
            continue
        first = float(grid[near[int(fit.argmin())]])
        dt, missing, odd = _settle(time, first, float(slack) * lattice)
        if odd <= 1e-3 * time.size and abs(dt / first - 1.0) < reach:
            return dt, missing
    raise Ambiguous(f"stamps of {lattice:.3g} s make no even grid")


def _on_lattice(grid: NDArray[np.float64], each: NDArray[np.float64], lattice: float) -> int:
    """Index of the best dt; a multiple of the lattice is taken where it is as good: it is what short records hold. Of
    random losses some dt or other saves a few."""
    best = int(each.argmin())
    times = np.rint(grid / lattice)
    enough = each[best] + 0.5 * math.sqrt(each[best]) + _AS_GOOD
    exact = np.flatnonzero((times > 0) & (np.abs(grid - times * lattice) < 1e-9 * grid) & (each <= enough))
    return int(exact[0]) if exact.size else best


def _unbroken(time: NDArray[np.float64], lattice: float) -> float | None:
    """The mean step, if for some dt all stamps lie within a lattice step of an even grid without a gap; else None.

    The span of what is left is a convex function of dt. The mean step is within
    lattice/duration of the true dt, which the dt of the least span need not be.
    """
    index = np.arange(time.size)

    def span(dt: float) -> float:
        left = index * dt
        np.subtract(time, left, out=left)
        return float(left.max() - left.min())

    middle, reach = float(time[-1]) / (time.size - 1), 1.5 * lattice / (time.size - 1)
    if span(middle) < lattice:
        return middle
    low, high = middle - reach, middle + reach
    for _ in range(40):  # a ternary search
        third = (high - low) / 3.0
        low, high = (low, high - third) if span(low + third) < span(high - third) else (low + third, high)
    return middle if span(0.5 * (low + high)) < lattice * (1.0 + 1e-6) else None


def _scan(
    time: NDArray[np.float64], lattice: float, low: float, high: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """dt [m] from `low` to `high`, and scores [m, slacks]: gaps, and odd stamps _ODD times. The decoder
    of _decode() for all at once, O(rows * m)."""
    even = np.exp(np.arange(math.log(low), math.log(high), _STEP))
    simple = lattice * np.concatenate([np.arange(1.0, 5.0), 1.0 / np.arange(2.0, 9.0)])
    grid = np.concatenate([even, simple[(simple > low) & (simple < high)]])
    dt, slack = np.repeat(grid, _SLACKS.size), np.tile(_SLACKS * lattice, grid.size)
    down, up = dt * (1.0 - 0.5 * _STEP), dt * (1.0 + 0.5 * _STEP)
    lo = np.full(dt.size, time[0])
    hi = lo + slack
    score = np.zeros(dt.size)
    for stamp in time[1:].tolist():
        lo += down
        hi += up
        late = np.ceil(np.maximum(stamp - hi, 0.0) / dt)
        score += late > 0.0
        late *= dt
        lo += late
        hi += late
        end = stamp + slack
        odd = lo >= end
        score += _ODD * odd
        np.copyto(lo, np.where(odd, stamp, np.maximum(lo, stamp)))
        np.copyto(hi, np.where(odd, end, np.minimum(hi, end)))
    return grid, score.reshape(-1, _SLACKS.size) + time.size * _PRICE


def _decode(time: NDArray[np.float64], dt: float, slack: float) -> tuple[NDArray[np.int64], int]:
    """missing_before[n], and the number of stamps that fit nowhere. [lo, hi]: where the sample's true time can be."""
    missing = np.zeros(time.size, np.int64)
    stamps = time.tolist()
    lo, hi, odd = stamps[0], stamps[0] + slack, 0
    down, up = dt * (1.0 - _WANDER), dt * (1.0 + _WANDER)
    for row in range(1, len(stamps)):
        stamp = stamps[row]
        end = stamp + slack
        lo += down
        hi += up
        if stamp > hi:
            gap = math.ceil((stamp - hi) / dt)
            missing[row] = gap
            lo += gap * dt
            hi += gap * dt
        if lo >= end:
            odd += 1
            lo, hi = stamp, end
        lo = max(lo, stamp)
        hi = min(hi, end)
    return missing, odd


def _settle(time: NDArray[np.float64], dt: float, slack: float) -> tuple[float, NDArray[np.int64], int]:
    """dt, missing_before[n] and odd stamps once dt is that of the time against the index with the missing samples."""
    missing, odd = _decode(time, dt, slack)
    for _ in range(4):
        fitted = float(time[-1] - time[0]) / (time.size - 1 + int(missing.sum()))
        if abs(fitted - dt) < 1e-10 * dt:
            break
        dt = fitted
        missing, odd = _decode(time, dt, slack)
    return dt, missing, odd
