"""Readings that a logger asks for oftener than the part measures: each repeats until the next one.

Asked twice as often and more, most rows repeat: the runs of equal rows show the part. Asked less often, a row repeats
only now and then: at the beat of the two rates. The phase of that beat separates the repeats from readings that are
equal by chance. Where the rows come at random the beat is lost. Repeats on a fine lattice are no chance even then.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len, rfft
from scipy.special import kl_div

from selfcal.base.grid import Array, Mask, Rows
from selfcal.logs.sampling import followed_phase, rhythm
from selfcal.readings.budget import nats_of

#: Share of the rows that repeat beyond chance, at least: fewer change no noise by half a percent.
SHARE_LEAST = 0.008
#: Rows that show its line, and the power of the line over the mean in the blocks that follow its phase.
LINE_ROWS, IN_BLOCK = 1 << 17, 60.0
#: Least share of rows that repeat, over the beat's frequency: a row a beat, and a row more for each late row.
ONE_EACH = 0.75
#: Least share of the rows at phases without repeats; largest share of the repeats at those phases.
SMEARED, REPEATS_LEFT_MOST = 0.25, 0.35
#: Share of readings that are equal by chance from which on a row may be; rows that repeat at no beat, at most.
EQUAL_SHARE, RUN_MOST = 0.01, 5
#: Most rows to a reading in a stretch; most stretches; chance of a missing repeat; pseudo-count of equal readings.
RATIO_MOST, STRETCHES_MOST, MISSED, SUPPOSED = 5, 8, 0.02, 2.0
#: Changes of a channel that is read anew each period, at least: a chamber may step a few times, as evenly.
CHANGES_LEAST = 8
#: Rows in a bin of the phase, and bins at most.
IN_BIN, PHASE_BINS_MOST = 50, 100


@dataclass(frozen=True)
class Held:
    """`rows` [m] at which a new reading of the part begins, `missing` [m]: how many it made unasked before each, and
    the `ratio` of rows to readings; `nats` that the repeats are no chance. `even`: the rows show when the readings were
    made; else their mean rate is known, but for those never asked for."""

    ratio: float
    rows: Rows
    missing: Rows
    nats: float
    even: bool = True


def held_of(columns: Sequence[Array], places: Rows, off: Array | None) -> Held | None:
    """The part's own readings among rows [n], where the values of all columns [n] are held; None where they are not.

    `places` [n]: places of the rows on the logger's grid; `off` [n]: the stamps' distance from it, in intervals.
    """

    def equal(lag: int) -> Mask:
        """Whether each row [n] repeats the row `lag` before."""
        of_part = np.zeros(places.size, bool)
        of_part[lag:] = np.logical_and.reduce([column[lag:] == column[:-lag] for column in columns])
        return of_part

    same, again = equal(1), equal(2)
    regular = _in_runs(same, places)
    of_part = regular or _at_a_beat(same, again, places, off) or _now_and_then(same, again, places)
    if of_part is None or of_part is regular:
        return of_part
    # Repeats that stretches of a lower rate explain are theirs.
    of_stretches = sum(stretch.rows.size for stretch in slower_stretches(columns[0]))
    return None if 2 * of_stretches > places.size - of_part.rows.size else of_part


@dataclass(frozen=True)
class Slower:
    """A stretch in which each reading is held for `ratio` rows: `rows` [k] are those that repeat; `nats` net."""

    ratio: int
    rows: Rows
    nats: float


def slower_stretches(values: Array) -> list[Slower]:
    """Stretches of readings [n] (NaN: missing) in which the part or the logger ran at a part of its rate.

    In a stretch every row but each `ratio`th repeats. A repeat counts by its chance. That is the share of readings
    equal to a reading two to four rows before, or of equal new readings in the stretch if larger.
    """
    n = values.size
    if n < 4 * RATIO_MOST:
        return []
    same = np.zeros(n, bool)
    same[1:] = values[1:] == values[:-1]
    chance = max(equal_by_chance(values), 1.0 / n)
    stretches: list[Slower] = []
    while len(stretches) < STRETCHES_MOST:
        tried = [_slower(same, ratio, chance) for ratio in range(2, RATIO_MOST + 1)]
        best = max(tried, key=lambda stretch: stretch.nats)
        if best.nats < nats_of("held_samples"):
            break
        stretches.append(best)
        same[best.rows] = False
    return stretches


def repeats_of(stretches: Sequence[Slower], n: int) -> Mask:
    """Which of n rows repeat in stretches of a lower rate."""
    repeats = np.zeros(n, bool)
    for stretch in stretches:
        repeats[stretch.rows] = True
    return repeats


def equal_by_chance(values: Array) -> float:
    """Share of readings [n] equal to a reading 2 to 4 rows before: by chance alone, on a lattice of several steps
    too."""
    return sum(float(np.count_nonzero(values[k:] == values[:-k])) for k in (2, 3, 4)) / (3.0 * values.size)


def _slower(same: Mask, ratio: int, chance: float) -> Slower:
    """The likeliest stretch of rows [n] that repeat the row before, but for every `ratio`th row."""
    n, best = same.size, Slower(ratio, np.zeros(0, np.int64), 0.0)
    more, less = math.log((1.0 - MISSED) / chance), math.log(MISSED / (1.0 - chance))
    paid = 2.0 * math.log(n) + math.log(RATIO_MOST**2)
    places = np.ascontiguousarray(same[: n - n % ratio].reshape(-1, ratio).T).view(np.int8)
    repeats = places.sum(axis=0, dtype=np.int8)
    of_group = less * (ratio - 1) + (more - less) * np.arange(ratio)
    # Whole groups of rows first: a stretch has at most two parts of groups more.
    price = paid - 2.0 * (ratio - 1) * more
    if _best_sum(of_group[np.minimum(repeats, ratio - 1)])[0] <= price:
        return best
    for phase in range(ratio):
        if _best_sum(of_group[repeats - places[phase]])[0] - price <= best.nats:
            continue
        holds = np.arange(n) % ratio != phase
        _, begin, end = _best_sum(np.where(holds, np.where(same, more, less), 0.0))
        rows = begin + np.flatnonzero((holds & same)[begin:end])
        # Readings that rest, or are narrower in this stretch, repeat at every place.
        new = same[begin:end][~holds[begin:end]]
        own = max(chance, (float(new.sum()) - SUPPOSED) / max(new.size, 1))
        held = int(np.count_nonzero(holds[begin:end]))
        nats = rows.size * math.log((1.0 - MISSED) / own) + (held - rows.size) * math.log(MISSED / (1.0 - own)) - paid
        if nats > best.nats:
            best = Slower(ratio, rows, nats)
    return best


def _best_sum(worth: Array) -> tuple[float, int, int]:
    """The largest sum of neighbours, the place of its first term, and the place after its last."""
    total = np.concatenate([[0.0], np.cumsum(worth)])
    gain = total - np.minimum.accumulate(total)
    end = int(np.argmax(gain))
    return float(gain[end]), int(np.argmin(total[: end + 1])), end


def updates(values: Array, places: Rows) -> Rows | None:
    """Rows at which a channel [n] is read anew, where its value is held in between or bridged by straight lines; None
    where no single period shows. `places` [n]: places of the rows on the logger's grid.

    A new value may equal the last value, so all changes lie whole periods apart. Chance would spread them evenly."""
    steps = np.diff(values)
    bends = np.abs(np.diff(steps)) > 1e-9 * float(np.ptp(values))
    held_rows = np.flatnonzero(steps) + 1
    rows = held_rows if 2 * held_rows.size < values.size else np.flatnonzero(bends) + 1
    if rows.size <= CHANGES_LEAST:
        return None
    gaps = np.diff(places[rows])
    nats, period = rhythm(gaps)
    if nats < nats_of("held_samples"):
        return None
    times = np.maximum(1, np.rint(gaps / period))
    count = np.concatenate([[0.0], np.cumsum(times)])
    first, last = places[rows[[0, -1]]]
    before, after = math.floor((first - places[0]) / period), math.floor((places[-1] - last) / period)
    count = np.concatenate([[-before], count, [count[-1] + after]])
    place_of = np.concatenate([[first - before * period], places[rows], [last + after * period]])
    every = np.interp(np.arange(count[0], count[-1] + 1.0), count, place_of)
    return np.unique(np.minimum(np.searchsorted(places, np.rint(every)), places.size - 1))


def _in_runs(same: Mask, places: Rows) -> Held | None:
    """Runs of readings that repeat by chance have any length, mostly 1. Runs of held readings are whole multiples of a
    length: a run of m lengths has m readings that are equal by chance."""
    starts = np.flatnonzero(~same)
    lengths = np.diff(starts, append=same.size)
    nats, ratio = rhythm(lengths[1:-1])
    if nats < nats_of("held_samples"):
        return None
    times = np.maximum(1, np.rint(lengths / ratio)).astype(np.int64)
    run = np.repeat(np.arange(starts.size), times)
    in_run = np.arange(run.size) - np.repeat(np.cumsum(times) - times, times)
    rows = starts[run] + in_run * lengths[run] // times[run]
    apart = np.rint(np.diff(places[rows], prepend=places[rows[0]] - ratio) / ratio).astype(np.int64)
    return Held(ratio, rows, np.maximum(0, apart - 1), nats)


def _at_a_beat(same: Mask, again: Mask, places: Rows, off: Array | None) -> Held | None:
    """Rows that repeat the row before at the beat of two rates. `again` [n]: a row equals the row two before, which a
    held reading does by chance alone."""
    n = same.size
    next_one = np.diff(places, prepend=places[0] - 2) == 1
    pairs = max(1, int(np.count_nonzero(next_one)))
    share, chance = (int(np.count_nonzero(each & next_one)) / pairs for each in (same, again))
    excess, sd = share - chance, math.sqrt((share + chance) / n)
    if excess < max(SHARE_LEAST, math.sqrt(2.0 * nats_of("held_samples")) * sd):
        return None
    x = np.where(next_one, same - share, 0.0)
    size = min(n, LINE_ROWS)
    head = places[:size] - places[0]
    if head[-1] > 4 * LINE_ROWS:
        return None
    grid = np.zeros(next_fast_len(4 * (int(head[-1]) + 1), real=True))
    grid[head] = x[:size]
    power = np.abs(rfft(grid)) ** 2
    mean = float(np.median(power)) / math.log(2.0)
    least = round(SHARE_LEAST * grid.size)
    most = round(min(0.5, (excess + 3.0 * sd) / (1.0 - chance) / ONE_EACH) * grid.size)
    top = least + int(np.argmax(power[least : most + 1]))
    nats = float(power[top]) / mean - math.log(size)
    if nats < nats_of("held_samples"):
        return None
    frequency = top / grid.size
    block = max(256, math.ceil(size * IN_BLOCK * mean / float(power[top])))
    even = (places - places[0]).astype(np.float64)
    phase, size_of_line = followed_phase(x, even, frequency, block)
    if off is not None:
        stamped = followed_phase(x, even + off, frequency, block)
        phase = stamped[0] if stamped[1] > size_of_line else phase
    # The share that repeats at each phase: where it is no more than chance the row is a new reading.
    bins = max(8, min(PHASE_BINS_MOST, n // IN_BIN))
    bin_of = np.floor((phase % 1.0) * bins).astype(np.int64) % bins
    count = np.bincount(bin_of[next_one], minlength=bins)
    there = np.bincount(bin_of[next_one & same], minlength=bins) / np.maximum(count, 1)
    held_there = (there - chance) > 0.5 * (1.0 - chance) * there
    # Elsewhere rows are equal by chance alone. A line, or two levels, in the readings changes that chance.
    elsewhere = next_one & ~held_there[bin_of]
    if not SMEARED * n < np.count_nonzero(elsewhere) < n - 1:
        return None
    left = float(same[elsewhere].mean()) - chance
    if not -0.05 * chance - 4.0 * sd < left < REPEATS_LEFT_MOST * excess + 3.0 * sd:
        return None
    rows = np.flatnonzero(~(same & next_one & held_there[bin_of]))
    # A row repeats where the phase passes a whole number: it is as many readings behind the rows.
    index = places[rows] - np.floor(phase[rows] + 0.5 * frequency).astype(np.int64)
    ratio = float(places[rows[-1]] - places[rows[0]]) / float(index[-1] - index[0])
    ahead = np.maximum.accumulate(index - np.arange(rows.size))
    missing = np.diff(ahead, prepend=ahead[0])
    if chance > EQUAL_SHARE:
        # The part made a reading more there, and a row was left out: it was equal by chance.
        equal = np.flatnonzero((missing > 0) & (np.diff(rows, prepend=0) > 1))
        missing[equal] -= 1
        rows, missing = np.insert(rows, equal, rows[equal] - 1), np.insert(missing, equal, 0)
    return Held(ratio, rows, missing, nats)


def _now_and_then(same: Mask, again: Mask, places: Rows) -> Held | None:
    """Rows that repeat the row before at no beat, where readings are hardly ever equal by chance. A run of more than
    RUN_MOST is stuck."""
    n = same.size
    starts = np.flatnonzero(~same)
    lengths = np.diff(starts, append=n)
    repeats = same & np.repeat(lengths <= RUN_MOST, lengths)
    share, chance = float(repeats.mean()), float((again & ~same).mean())
    if share < max(SHARE_LEAST, 10.0 * chance) or chance > EQUAL_SHARE:
        return None
    expected = max(chance, 1.0 / n)
    nats = n * float(kl_div(share, expected))
    if nats < nats_of("held_samples"):
        return None
    rows = np.flatnonzero(~repeats)
    ratio = n / rows.size
    unasked = np.diff(places[rows] - rows, prepend=places[rows[0]] - rows[0])
    return Held(ratio, rows, np.rint(unasked / ratio).astype(np.int64), nats, even=False)
