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

from selfcal.base.grid import Array, Mask, equal_runs, noise_of
from selfcal.readings.budget import nats_of
from selfcal.readings.lattice import COARSEST, lattice_of, step_of

#: Readings that are one value: how many at least, and the share up to which they are left out.
#: Of a value with more, either the value or the others may be the noise. Then most averages have too few readings too,
#: and a bias that walks is lost between the others.
LEAST, MOST = 5, 0.5
#: Share of the readings from which on the commonest value has no part in the steps that show the noise. Distinct values
#: of the others from which on a value beside their lattice shows.
COMMON, CODES = 0.2, 8
#: Readings of a value whose neighbours are looked at, at most; these on either side, and how far off they may be, in
#: the noise.
SAMPLED, AROUND, NEAR = 50_000, 8, 3.0
#: On a coarse lattice ln of the count over the expected one, over the largest of any other value, at least.
OVER_OTHERS = 2.5
#: Counts of three codes from which on they alone show the next one's.
MANY = 30.0
#: The others come close to a limit of the part: within this many of their standard deviations, or at the next value,
#: are this share of its own readings, or of the others. At the largest of some hundred normal readings are fewer.
CLOSE, CLOSE_OWN, CLOSE_OTHERS = 0.5, 0.5, 0.05
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
    commonest, most, sigma = noise_beside(y)
    found = _too_often(y, sigma, rate_hz) if sigma > 0.0 else None
    if found is None or (2 * most > y.size and found[0] != commonest):
        return None
    value, nats, excess = found
    share = excess * float(np.count_nonzero(values == value)) / y.size
    mask = np.zeros(values.size, bool)
    if share <= MOST:
        mask[known] = _lost(y, value, excess, rate_hz)
    return Recurring(value, share, mask, min(1e6, nats))


def noise_beside(y: Array) -> tuple[float, int, float]:
    """The commonest of readings [n], how often it comes, and the noise, of the others alone where it is common."""
    unique, counts = np.unique(y, return_counts=True)
    commonest, most = float(unique[np.argmax(counts)]), int(counts.max())
    return commonest, most, noise_of(y[y != commonest] if most > COMMON * y.size else y)


def _rests(y: Array, own: Mask, sigma: float) -> bool:
    """Whether most of the own ones among readings [n] lie among others that rest, as many on either side."""
    others, at = np.flatnonzero(~own), np.flatnonzero(own)
    at = at[:: -(-at.size // SAMPLED)]
    first = np.clip(np.searchsorted(others, at) - AROUND, 0, others.size - 2 * AROUND)
    around = y[others[first[:, None] + np.arange(2 * AROUND)]]
    off = np.abs(around - np.median(around, axis=1, keepdims=True))
    return bool(np.mean(np.quantile(off, 0.75, axis=1) < NEAR * sigma) >= 0.5)


def _too_often(y: Array, sigma: float, rate_hz: float) -> tuple[float, float, float] | None:
    """The value to which readings [n] come too often, its evidence, and the share of its readings that are too many.
    `sigma`: their noise.

    ln of the counts is smooth over the values: neighbours show the expected count. A limit takes all beyond it. In
    motion a part comes to its limits. On a lattice coarser than the noise a word shows that has no neighbours.
    """
    value, counts = np.unique(y[_no_stuck(y)], return_counts=True)
    if counts.max(initial=0) < LEAST or value.size < 5:
        return None
    step = step_of(value)[0]
    # Of codes that never come four show as many between two that do.
    apart = np.minimum(np.rint(np.diff(value) / step), 4.0) if step > 0.0 else np.ones(value.size - 1)
    place = np.concatenate([[0], np.cumsum(apart)]).astype(np.int64)
    count = np.bincount(place, counts).astype(np.float64)
    expected, sd = _beside_codes(count)
    excess, most = np.log((count + 0.5) / expected), expected * np.exp(2.0 * sd)
    with np.errstate(divide="ignore", invalid="ignore"):
        worth = np.where((count > most) & (count >= LEAST), count * np.log(count / most) - count + most, 0.0)
    least = nats_of("outliers") + math.log(value.size)
    alone = np.where(expected < 1.0, worth, 0.0)
    top = int(np.argmax(alone if alone.max() > least else worth))
    word = float(value[np.searchsorted(place, top)])
    own = y == word
    others = y[~own]
    if worth[top] < least or others.size < 8 * AROUND:
        return None
    lattice = lattice_of(others, rate_hz)
    if lattice is not None and lattice.coarseness > COARSEST and expected[top] >= 1.0:
        return None
    smooth = 0.0 if _is_beside(others, word) else float(expected[top])
    if 4.0 * step > COARSEST * sigma and smooth > 0.0:  # counts are not smooth: the others show how much
        expected, sd = _beside_codes(np.where(np.arange(count.size) == top, smooth, count))
        chance = math.sqrt(2.0 * math.log(2.0 * count.size)) * np.sqrt(sd**2 + 1.0 / (count + 0.5))
        at_others = np.delete(np.abs(np.log((count + 0.5) / expected)) - chance, top)
        if excess[top] < OVER_OTHERS * max(0.0, float(at_others.max(initial=0.0))):
            return None
    spacing = step or float(np.median(np.diff(value)))
    if is_limit(others, word, int(own.sum()), spacing) or not _rests(y, own, sigma):
        return None
    return word, float(worth[top]) - math.log(value.size), 1.0 - smooth / (float(count[top]) + 0.5)


def _is_beside(others: Array, value: float) -> bool:
    """Whether a value lies beside the lattice of the others [n]."""
    step, distinct = step_of(others)
    off = (value - float(others[0])) / step if step > 0.0 and distinct > CODES else 0.0
    return abs(off - round(off)) > 0.1


def is_limit(others: Array, value: float, count: int, step: float) -> bool:
    """Whether a value at the edge of all readings has the `count` that a limit of the part makes of their noise: the
    `others` [n] come close to it."""
    if float(others.min()) < value < float(others.max()):
        return False
    distance = np.abs(others - value)
    close = int(np.count_nonzero(distance < max(CLOSE * float(others.std()), 1.5 * step)))
    return close > min(CLOSE_OWN * count, CLOSE_OTHERS * others.size)


def _no_stuck(y: Array) -> Mask:
    """Readings [n] less the repeats of runs that are no chance, if the commonest reading is a chance one."""
    starts, lengths = equal_runs(y)
    commonest = float(np.unique(y, return_counts=True)[1].max()) / y.size
    stuck = lengths > 2 + math.log(1e-3 / y.size) / math.log(min(commonest, 0.99))
    kept = np.repeat(~stuck, lengths)
    kept[starts] = True
    return kept


def _explained(value: float, level: Array, sigma: float, step: float) -> Array:
    """The chance of a value of a lattice at these levels [m], in noise `sigma`."""
    chance: Array = ndtr((value + 0.5 * step - level) / sigma) - ndtr((value - 0.5 * step - level) / sigma)
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


def _lost(y: Array, value: float, share: float, rate_hz: float) -> Mask:
    """Which readings [n] of a value are lost words, a `share` of them: those that the noise about the level of their
    neighbours explains least. Where both are possible chance decides, so that as many are left as the noise makes."""
    from scipy.optimize import brentq  # a quarter of a second to import: for who has lost words alone

    own: Mask = y == value
    if share == 1.0:
        return own
    at, others = np.flatnonzero(own), y[~own]
    lattice = lattice_of(others, rate_hz)
    step = 0.0 if lattice is None else lattice.step
    sigma = noise_of(others) if lattice is None else step / lattice.coarseness
    level = uniform_filter1d(others, LEVEL, mode="nearest")
    level = level[np.clip(np.searchsorted(np.flatnonzero(~own), at), 0, others.size - 1)]
    explained = _explained(value, level, sigma, step)
    lost = share * at.size / y.size

    def left(ln_scale: float) -> float:
        return float(np.mean(lost / (lost + math.exp(ln_scale) * explained))) - share

    if left(LN_SCALE) < 0.0 < left(-LN_SCALE):
        explained *= math.exp(brentq(left, -LN_SCALE, LN_SCALE))
    found = np.zeros(y.size, bool)
    found[at] = np.random.default_rng(1).random(at.size) * (lost + explained) < lost
    return found
