"""Readings that are one value more often than their noise and lattice explain: words that a bus has lost.

Far from the rest such a value needs no statistic of the noise. Within the noise its count stands out beside the counts
of its neighbours on the lattice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.special import ndtr

from selfcal.base.grid import MEDIAN_SD, Array, Mask, equal_runs
from selfcal.readings.budget import nats_of
from selfcal.readings.lattice import COARSEST, Lattice, lattice_of

#: Readings that are one value: how many at least, and the share up to which they are left out.
#: Of a value with more, either the value or the others may be the noise. Then most averages have too few readings too,
#: and a bias that walks is lost between the others.
LEAST, MOST = 5, 0.5
#: Share of the readings from which on the commonest value has no part in the steps that show the noise, and ln of its
#: count over the expected one then, at least: on a lattice near the noise unequal codes have less.
COMMON, COMMON_EXCESS = 0.2, 0.7
#: Share from which on a value beside the lattice of the others shows, and distinct values of theirs, at least.
SHOWS, CODES = 0.02, 8
#: Readings of a value whose neighbours are looked at, at most, and steps that their noise is taken of, about.
SAMPLED = 50_000
#: Far ones: candidates that are looked at, neighbours on either side that make their level, how far off they are in the
#: noise and how far their neighbours may be, and readings of a candidate that are looked at first, at most.
LOOKED, AROUND, FAR, NEAR, SHOWN = 6, 8, 5.0, 3.0, 500
#: Within the noise: steps of the lattice in the noise from which on single codes are compared; else distinct values so
#: near, in the noise; ln of the count over the expected one, and over the largest of any other value, at least.
COARSE, BESIDE, EXCESS, OVER_OTHERS = 0.1, 0.25, 0.15, 2.5
#: Of the readings that are too many, the share that the levels about them must not explain, at least.
LOCAL = 0.25
#: Counts of three codes from which on they alone show the next one's.
MANY = 30.0
#: The others come close to a limit of the part: within this many of their standard deviations, or at the next value,
#: are this share of its own readings, or of the others. At the largest of some hundred normal readings are fewer.
CLOSE, CLOSE_OWN, CLOSE_OTHERS = 0.5, 0.5, 0.05
#: Share of the count beside a value, over that farther off, below which a dead band is about the value, and readings
#: that it has taken from the gaps on either side.
BAND, GAP = 0.5, 10.0
#: Readings that begin beyond a dead band at least, within half its width and half the noise. A tail has fewer.
GAP_FULL = 20
#: Neighbours whose mean is the level of a lost word among the readings. Of few the mean would follow their noise, and
#: the words left would follow them.
LEVEL = 1001
#: ln of the factor at most by which a word's chance may differ from the noise's.
LN_SCALE = 5.0


@dataclass(frozen=True)
class Recurring:
    """Readings that are one `value` too often: their `share`, the `mask` [n] of those to leave out, and the evidence in
    nats. Beyond a share of MOST none is left out."""

    value: float
    share: float
    mask: Mask
    nats: float


def recurring_of(values: Array, rate_hz: float) -> Recurring | None:
    """The value that recurs most surely in readings [n], NaN where there is none."""
    known = np.isfinite(values)
    y = values if known.all() else values[known]
    if y.size < 8 * AROUND:
        return None
    unique, counts = np.unique(y, return_counts=True)
    commonest, most = float(unique[np.argmax(counts)]), int(counts.max())
    del unique, counts  # as long as the record
    rest = y[y != commonest] if most > SHOWS * y.size else y
    if rest.size < 8 * AROUND:
        return None
    steps = np.abs(np.diff(rest if most > COMMON * y.size else y))
    # On a lattice coarser than the noise most steps are none.
    some = steps[:: max(1, steps.size // SAMPLED)]
    sigma = max(float(np.median(some)) / MEDIAN_SD, float(np.quantile(some, 0.6)) / 0.8416) / math.sqrt(2.0)
    del steps, some
    if not sigma > 0.0:
        return None
    far = _far(y, sigma, rate_hz)
    lattice = lattice_of(y, rate_hz) if far is None else None
    found: tuple[float, float, float] | None
    if far is not None:
        found = (*far, 1.0)
    elif most > SHOWS * y.size and _is_off(rest, commonest, most, sigma, lattice, lattice_of(rest, rate_hz)):
        found = (commonest, 1e6, 1.0)
    else:
        found = _within(y, sigma, lattice)
    if found is None or (2 * most > y.size and found[0] != commonest):
        return None
    del rest
    value, nats, excess = found
    own = values == value
    share = excess * float(np.count_nonzero(own)) / y.size
    mask = np.zeros(values.size, bool)
    if share <= MOST:
        mask[known] = _lost(y, value, excess, rate_hz)
    return Recurring(value, share, mask, min(1e6, nats))


def _far(y: Array, sigma: float, rate_hz: float) -> tuple[float, float] | None:
    """The value and its evidence, where readings [n] of it are far from the level of their neighbours, and the lattice
    of these has no reason to come to this value so often. `sigma`: their noise.

    A value counts where its neighbours rest: in motion a part comes to its limits. The evidence is that of its count
    over the count of a cell about it (Poisson).
    """
    jump = np.abs(np.diff(y)) > (FAR - 1.0) * sigma
    if np.count_nonzero(jump) < LEAST:
        return None
    jumps = np.unique(np.concatenate([np.flatnonzero(jump), np.flatnonzero(jump) + 1]))
    unique, counts = np.unique(y[jumps], return_counts=True)
    best: tuple[float, float] | None = None
    for place in np.argsort(-counts, kind="stable")[:LOOKED]:
        value = float(unique[place])
        if counts[place] < LEAST:
            break
        own = y == value
        size = np.count_nonzero(own)
        if y.size - size < 8 * AROUND:
            continue
        level, _ = _about(y, own, sigma, SHOWN)
        if not np.median(np.abs(value - level)) > FAR * sigma:
            continue  # of the noise, as most are
        level, rests = _about(y, own, sigma, SAMPLED)
        count = int(float(np.mean(rests & (np.abs(value - level) > FAR * sigma))) * size)
        if count < LEAST or 2 * count < size:
            continue
        others = y[~own]
        lattice = lattice_of(others, rate_hz)
        if _has_gaps(others, value, sigma, _spacing(others, lattice)):
            continue
        width = max(2.0 * sigma, 4.0 * lattice.step if lattice is not None else 0.0)
        cells = 2.0 * width / lattice.step if lattice is not None else 20.0
        expected = (np.count_nonzero(np.abs(others - value) < width) + 1.0) / cells
        nats = count * math.log(count / expected) - count + expected - math.log(unique.size)
        if count > expected and nats > nats_of("outliers") and (best is None or nats > best[1]):
            best = value, float(nats)
    return best


def _about(y: Array, own: Mask, sigma: float, most: int) -> tuple[Array, Mask]:
    """The level of the other readings about the own ones among readings [n], and whether these rest there. The same
    number of others on either side. Every so many of the own ones, `most` in all."""
    others, at = np.flatnonzero(~own), np.flatnonzero(own)
    at = at[:: -(-at.size // most)]
    first = np.clip(np.searchsorted(others, at) - AROUND, 0, others.size - 2 * AROUND)
    around = y[others[first[:, None] + np.arange(2 * AROUND)]]
    level = np.median(around, axis=1)
    return level, np.quantile(np.abs(around - level[:, None]), 0.75, axis=1) < NEAR * sigma


def _is_off(
    others: Array, value: float, count: int, sigma: float, lattice: Lattice | None, own: Lattice | None
) -> bool:
    """Whether a value of this `count` lies beside the `own` lattice of the `others` [n], and is no limit of the part
    and no dead band. `lattice`: of all."""
    if own is None or own.coarseness > COARSEST or (lattice is not None and lattice.step > 0.75 * own.step):
        return False
    cells = round(float(np.ptp(others)) / own.step) + 1
    if own.distinct < max(CODES, cells // 2):
        return False
    return not _has_gaps(others, value, sigma, own.step) and not _is_limit(others, value, count)


def _within(y: Array, sigma: float, lattice: Lattice | None) -> tuple[float, float, float] | None:
    """The value, its evidence and the share of its readings that are too many, where it is one of the noise's own
    values, and readings [n] come to it too often.

    ln of the counts is smooth over the values: neighbours show the expected
    count. Codes of unequal width show as much excess at other values too. A dead band takes its counts from its
    neighbours, and a limit takes all beyond it.
    """
    if lattice is not None and lattice.coarseness > COARSEST:
        return None
    unique, counts = np.unique(y[_no_stuck(y)], return_counts=True)
    if counts.max(initial=0) < LEAST or unique.size < 5:
        return None
    value, count = unique, counts.astype(np.float64)
    codes = lattice is not None and lattice.step > COARSE * sigma
    if codes:
        assert lattice is not None
        place = np.rint((unique - unique[0]) / lattice.step).astype(np.int64)
        count = np.bincount(place, counts).astype(np.float64)
        value = unique[0] + lattice.step * np.arange(count.size)
        value[place] = unique
    spacing = _spacing(unique, lattice)
    expected, sd = _beside_codes(count) if codes else _beside_values(value, count, BESIDE * sigma)
    excess = np.log((count + 0.5) / expected)
    most = expected * np.exp(2.0 * sd)
    with np.errstate(divide="ignore", invalid="ignore"):
        worth = np.where(count > most, count * np.log(count / most) - count + most, 0.0)
    top = int(np.argmax(np.where((count >= LEAST) & (excess > EXCESS), worth, 0.0)))
    nats = float(worth[top]) - math.log(unique.size)
    own = y == value[top]
    size = int(np.count_nonzero(own))
    if (
        nats < nats_of("outliers")
        or y.size - size < 8 * AROUND
        or (size > COMMON * y.size and excess[top] < COMMON_EXCESS)
    ):
        return None
    smooth = float(expected[top])
    if codes:
        n1, n2 = (np.array([_at(count, top - k), _at(count, top + k)]) for k in (1, 2))
        smooth = min(smooth, math.exp(float(4.0 * np.log(n1 + 0.5).sum() - np.log(n2 + 0.5).sum()) / 6.0))
    without = np.where(np.arange(count.size) == top, smooth, count)
    expected, sd = _beside_codes(without) if codes else _beside_values(value, without, BESIDE * sigma)
    if not codes:
        offset = np.abs(value - value[top]) / sigma
        n1, n2 = (
            np.array([count[inside & (value < value[top])].sum(), count[inside & (value > value[top])].sum()])
            for inside in ((offset < BESIDE) & (offset > 0.0), (offset >= BESIDE) & (offset < 2.0 * BESIDE))
        )
    sd = np.sqrt(sd**2 + 1.0 / (count + 0.5))
    chance = math.sqrt(2.0 * math.log(2.0 * count.size)) * sd  # the largest of as many
    others = np.delete(np.abs(np.log((count + 0.5) / expected)) - chance, top)
    if excess[top] - chance[top] < OVER_OTHERS * max(0.0, float(others.max(initial=0.0))):
        return None
    if not codes and 0 < top < value.size - 1:
        gap = min(value[top] - value[top - 1], value[top + 1] - value[top]) - spacing
        if gap * n2.min() > GAP * BESIDE * sigma:
            return None
    if (n1 + 3.0 * np.sqrt(n2) + 3.0 < BAND * n2).all():
        return None
    if _has_gaps(y[~own], float(value[top]), sigma, spacing):
        return None
    if _is_limit(y[~own], float(value[top]), size):
        return None
    level, rests = _about(y, own, sigma, SAMPLED)
    share = 1.0 - smooth / (float(count[top]) + 0.5)
    noise = lattice.step / lattice.coarseness if lattice is not None else sigma
    here = _explained(float(value[top]), level, noise, lattice)
    lost = share * size
    for _ in range(20):  # of the same count where the level about each reading is known: EM
        lost = float((lost / (lost + here * y.size)).mean()) * size
    if 2 * np.count_nonzero(rests) < level.size or lost < LOCAL * share * size:
        return None
    return float(value[top]), nats, share


def _spacing(values: Array, lattice: Lattice | None) -> float:
    """The step of a lattice, or else the usual distance of values [n]: that of a lattice too fine to be one."""
    return lattice.step if lattice is not None else float(np.median(np.diff(np.unique(values))))


def _has_gaps(others: Array, value: float, sigma: float, step: float) -> bool:
    """Whether the `others` [n], a `step` apart, leave a gap on either side of a value and begin at once beyond it: a
    dead band."""
    offset = others - value
    above, below = offset[offset > 0.0], -offset[offset < 0.0]
    if not (above.size and below.size):
        return False
    gap = min(float(above.min()), float(below.min()))
    edge = gap + 0.5 * min(gap - step, sigma)
    most = max(np.count_nonzero(above < edge), np.count_nonzero(below < edge))
    return gap > 1.5 * step and int(most) > GAP_FULL


def _is_limit(others: Array, value: float, count: int) -> bool:
    """Whether a value at the edge of all readings has the `count` that a limit of the part makes of their noise: the
    `others` [n] come close to it."""
    if float(others.min()) < value < float(others.max()):
        return False
    distance = np.abs(others - value)
    close = int(np.count_nonzero(distance < max(CLOSE * float(others.std()), 1.01 * float(distance.min()))))
    return close > min(CLOSE_OWN * count, CLOSE_OTHERS * others.size)


def _no_stuck(y: Array) -> Mask:
    """Readings [n] less the repeats of runs that are no chance, if the commonest reading is a chance one."""
    starts, lengths = equal_runs(y)
    commonest = float(np.unique(y, return_counts=True)[1].max()) / y.size
    stuck = lengths > 2 + math.log(1e-3 / y.size) / math.log(min(commonest, 0.99))
    kept = np.repeat(~stuck, lengths)
    kept[starts] = True
    return kept


def _at(count: Array, place: int) -> float:
    """The count at a place, 0 beyond the ends."""
    return float(count[place]) if 0 <= place < count.size else 0.0


def _explained(value: float, level: Array, sigma: float, lattice: Lattice | None) -> Array:
    """The chance of a value on a lattice at these levels [m], in noise `sigma`."""
    half = 0.5 * lattice.step if lattice is not None else 0.0
    chance: Array = ndtr((value + half - level) / sigma) - ndtr((value - half - level) / sigma)
    return chance


def _beside_codes(count: Array) -> tuple[Array, Array]:
    """The count of each code [m] by its neighbours, and the deviation of its ln: by the cubic through ln of the four
    next ones, or by the square through three on the side that counts more, whichever is more."""
    there = np.pad(count, 3) + 0.5
    m = count.size
    ln, variance = ({k: one[3 + k : m + 3 + k] for k in range(-3, 4)} for one in (np.log(there), 1.0 / there))
    best = (4.0 * (ln[1] + ln[-1]) - ln[2] - ln[-2]) / 6.0
    spread = (16.0 * (variance[1] + variance[-1]) + variance[2] + variance[-2]) / 36.0
    for side in (-1, 1):
        one, two, three = side, 2 * side, 3 * side
        square = 3.0 * ln[one] - 3.0 * ln[two] + ln[three]
        more = (square > best) & (ln[one] > ln[-one]) & (variance[one] + variance[two] + variance[three] < 1.0 / MANY)
        spread = np.where(more, 9.0 * (variance[one] + variance[two]) + variance[three], spread)
        best = np.where(more, square, best)
    return np.exp(best), np.sqrt(spread)


def _beside_values(value: Array, count: Array, width: float) -> tuple[Array, Array]:
    """The mean count of the values within `width` of each [m], on the side where these count more, and the deviation of
    its ln."""
    total = np.concatenate([[0.0], np.cumsum(count)])
    here = np.arange(value.size)
    low, high = np.searchsorted(value, value - width), np.searchsorted(value, value + width, side="right")
    expected, known = np.full(value.size, 1.0), np.full(value.size, 1.0)
    for begin, end in ((low, here), (here + 1, high)):
        of_side = total[end] - total[begin]
        mean = of_side / np.maximum(end - begin, 1)
        more = mean > expected
        expected, known = np.where(more, mean, expected), np.where(more, of_side, known)
    return expected, 1.0 / np.sqrt(known)


def _lost(y: Array, value: float, share: float, rate_hz: float) -> Mask:
    """Which readings [n] of a value are lost words, a `share` of them: those that the noise about the level of their
    neighbours explains least. Where both are possible chance decides, so that as many are left as the noise makes."""
    from scipy.optimize import brentq  # a quarter of a second to import: for who has lost words alone

    own: Mask = y == value
    if share == 1.0:
        return own
    at, others = np.flatnonzero(own), y[~own]
    sigma = float(np.median(np.abs(np.diff(others)))) / MEDIAN_SD / math.sqrt(2.0)
    lattice = lattice_of(others, rate_hz)
    if lattice is not None:
        sigma = max(sigma, lattice.step / lattice.coarseness)
    level = uniform_filter1d(others, LEVEL, mode="nearest")
    level = level[np.clip(np.searchsorted(np.flatnonzero(~own), at), 0, others.size - 1)]
    explained = _explained(value, level, sigma, lattice)
    lost = share * at.size / y.size

    def left(ln_scale: float) -> float:
        return float(np.mean(lost / (lost + math.exp(ln_scale) * explained))) - share

    if left(LN_SCALE) < 0.0 < left(-LN_SCALE):
        explained *= math.exp(brentq(left, -LN_SCALE, LN_SCALE))
    found = np.zeros(y.size, bool)
    found[at] = np.random.default_rng(1).random(at.size) * (lost + explained) < lost
    return found
