"""Readings that a map of the firmware or the logger has changed: which map, by the likelihood of what it leaves.

Maps that add whole spans (a count read as unsigned, an overflow, bytes of two readings in one) leave jumps of one size,
far above the noise. They can be undone. Maps about zero (a sign that printing loses, a cast that truncates, zeros of a
fraction that are not printed) leave holes and heaps in the counts. Noise is normal about a level that each piece of the
record has for itself; cells of the true value are read as one value.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.special import ndtr

from selfcal.base.grid import MEDIAN_SD, Array, counts_of_pieces, noise_of
from selfcal.readings.budget import nats_of
from selfcal.readings.codes import INNER, ODD, PIECE, ln_of
from selfcal.readings.lattice import Lattice, step_of

#: Readings that a span has changed at least, and the share of them that are one value, at most.
CHANGED_LEAST, ALIKE = 5, 0.9
#: Deviations, in noises, from which on a reading is none of the noise. Of the torn ones, how many more lie on one side,
#: in standard deviations.
FAR, EITHER_SIDE = 6.0, 4.0
#: Bits at least of a count that goes round.
BITS_LEAST = 5
#: Noises of a reading in the circle of a count from which on each reading has its turn. Half of it, and a torn one shows.
WHOLE = 8.0
#: Pieces of a record that have a level each, at most.
PIECES = 100
#: Values that are told apart at most. Points of a cell of half a value.
VALUES_MOST, POINTS = 200, 16
#: Steps of the lattice in the noise of a reading at most: beyond, skewed noise looks like a map.
COARSEST = 1.2
#: Factors of the noise of a reading that are tried, and steps of a level, in noises.
FACTORS, LEVEL_STEP = np.geomspace(0.1, 3.0, 36), 0.1
#: Shares of the readings that are one value, which is tried in place of a map.
SHARES_OF_ONE = np.geomspace(0.005, 0.4, 10)
#: What may have happened, by kind.
MISREAD = MappingProxyType(
    {
        "sign_lost": "the sign of values between -1 and 0 is lost in printing",
        "truncated": "a cast truncates towards zero, round before it",
        "digits_lost": "zeros behind the point are lost in printing",
        "unsigned": "a signed count is read as unsigned; undone here",
        "overflow": "the count runs over; undone here",
        "torn": "bytes of two readings are joined, read them at once; undone here",
        "low_bits": "the upper bits of the count are lost; undone here",
        "bit_set": "a bit of the count is 1 in every reading",
        "bit_clear": "a bit of the count is 0 in every reading",
        "range_change": "the range of the part changes, the readings are right",
    }
)


#: Kinds that a limit of the part at zero looks like.
ABOUT_ZERO = ("sign_lost", "truncated", "digits_lost")


@dataclass(frozen=True)
class Misread:
    """The `kind` of a map, the `share` of the readings that it has changed (of a change of the range: until it, or from
    it on), and its `nats`. `undone` [n]: the readings before it, None where that is lost."""

    kind: str
    share: float
    nats: float
    undone: Array | None = None


def spans_of(values: Array) -> Misread | None:
    """Readings [n] to which whole spans were added; NaN are none of them. O(n) a span that is tried.

    A count that goes round loses its turns: readings lie near a level on the circle of its codes. A torn one is off by
    the least step of its upper part, to either side as often. On a lattice spans are its powers of two."""
    known = np.flatnonzero(np.isfinite(values))
    y = values[known]
    if y.size < PIECE or not np.ptp(y) > 0.0:
        return None
    step, size = step_of(y)[0], float(np.ptp(y))
    jump = float(np.partition(np.abs(np.diff(y)), -CHANGED_LEAST)[-CHANGED_LEAST])
    whole = step * 2.0 ** math.ceil(math.log2(size / step + 0.5)) if step > 0.0 else size + np.diff(np.unique(y)).min()
    spans = [whole]
    if step > 0.0:
        least = max(step * 2.0**BITS_LEAST, 0.5 * WHOLE * noise_of(y))
        spans += [span for span in whole * 0.5 ** np.arange(1, 64) if span > least]
    spans = [span for span in spans if span < 2.0 * jump and span >= step * 2.0**BITS_LEAST]
    if not spans:
        return None
    line = _ln_of_noise(y - uniform_filter1d(y, PIECE, mode="nearest"), size)
    found = [one for one in (_of_span(y, span, line, span < whole, step > 0.0) for span in spans) if one is not None]
    best = max(found, key=lambda one: one.nats, default=None)
    if best is None or best.nats < nats_of("misread") + math.log(len(spans)):
        return None
    if best.undone is None:
        return best
    undone = values.copy()
    undone[known] = best.undone
    return replace(best, undone=undone)


def _ln_of_noise(off: Array, size: float) -> float:
    """ln likelihood of deviations [n] that are normal, all or but for a share that is even over a `size`."""

    def normal(some: Array) -> float:
        variance = max(float(np.mean(some**2)), 1e-12 * size**2)
        return -0.5 * some.size * math.log(2.0 * math.pi * math.e * variance)

    core = np.abs(off) < FAR * float(np.median(np.abs(off))) / MEDIAN_SD
    share = 1.0 - float(core.mean())
    if not 0.0 < share < 1.0:
        return normal(off)
    mixed = off.size * ((1.0 - share) * math.log1p(-share) + share * math.log(share / size))
    return max(normal(off), normal(off[core]) + mixed)


def _of_span(y: Array, span: float, line: float, torn: bool, lattice: bool) -> Misread | None:
    """The evidence that readings [n] are off by `span`, once if `torn`, else any number of times. `line`: ln likelihood
    about a level that follows them as they are."""
    turn = 2.0 * math.pi / span
    level = np.unwrap(np.angle(uniform_filter1d(np.exp(1j * turn * y), PIECE, mode="nearest"))) / turn
    turns = np.rint((level - y) / span)
    own = float(np.median(turns))
    turns -= own
    straight = y - level + own * span
    if torn:
        turns = np.clip(turns, -1.0, 1.0)
    changed, off = turns != 0.0, straight + span * turns
    count, size, sd = int(np.count_nonzero(changed)), float(np.ptp(y)), float(off.std())
    if count < CHANGED_LEAST or np.unique(y[changed], return_counts=True)[1].max() > ALIKE * count:
        return None  # one value is a lost word
    share = count / y.size
    nats = _ln_of_noise(off, size) - max(line, _ln_of_noise(straight, size))
    if torn:
        if abs(float(turns.sum())) > EITHER_SIDE * math.sqrt(count):
            return None
        nats += count * math.log(0.5 * share) + (y.size - count) * math.log1p(-share)
        return Misread("torn", share, nats, y + span * turns if sd * WHOLE < span else None)
    if span < 2.0 * WHOLE * sd and not lattice:
        return None
    kind = "overflow" if float(y.min()) < 0.0 else "low_bits"
    middle = float(np.median(y + span * turns))
    # The true ones are about zero, of a wide count by more of their noises.
    if kind == "low_bits" and min(middle, span - middle) < max(sd, span / WHOLE**2):
        kind, turns = "unsigned", turns - float(np.rint(middle / span))
    return Misread(kind, float(np.mean(turns != 0.0)), nats, y + span * turns if sd * WHOLE < span else None)


def stuck_bit_of(values: Array, lattice: Lattice | None) -> Misread | None:
    """Readings [n], NaN where there are none, whose codes lack one bit: every other 2^k of them never comes.

    Each time that the bits above it change, the bit itself is one or the other by chance."""
    y = values[np.isfinite(values)]
    if lattice is None or y.size < PIECE:
        return None
    code = np.rint(y / lattice.step).astype(np.int64)
    low, high = (int(one) for one in np.quantile(code, INNER))
    for k in range(1, max(2, int(math.log2(high - low + 1)) + 1)):
        bit = (code >> k) & 1
        if bit.min() < bit.max():
            continue
        inner = np.arange(low, high + 1)
        inner = inner[((inner >> k) & 1) == bit[0]]
        nats = math.log(2.0) * np.count_nonzero(np.diff(code >> (k + 1))) - math.log(64.0)
        if np.isin(inner, code).mean() > ALIKE and nats > nats_of("misread"):
            return Misread(f"bit_{'set' if bit[0] else 'clear'}", 0.5, nats)
    return None


def range_change_of(values: Array, lattice: Lattice | None) -> Misread | None:
    """Readings [n], NaN where there are none, that from one time on, or until then, lie on every second code alone, or
    on every fourth: the range of the part was changed. They are right."""
    y = values[np.isfinite(values)]
    if lattice is None or y.size < PIECES:
        return None
    code = np.rint((y - y[0]) / lattice.step).astype(np.int64)
    best = Misread("range_change", 0.0, 0.0)
    for factor in (4, 2):
        for part in (code, code[::-1]):
            off = np.flatnonzero((part - part[0]) % factor)
            size = int(off[0]) if off.size else 0
            nats = size * math.log(factor) - 2.0 * math.log(y.size)
            if nats > best.nats and off.size > size * ODD and np.unique(part[:size]).size > factor:
                best = Misread("range_change", size / y.size, nats)
    return best if best.nats > nats_of("misread") else None


def _no_zeros(x: Array) -> Array:
    """Zeros behind the point are lost: 0.05 is read as 0.5."""
    size = np.abs(x)
    whole = np.floor(size)
    zeros = np.floor(-np.log10(np.maximum(size - whole, 1e-9)))
    return np.asarray(np.sign(x) * (whole + (size - whole) * 10.0**zeros))


def _maps(y: Array, noise: float, step: float) -> list[tuple[str, Callable[[Array], Array]]]:
    """What may have been read in place of a value, about zero: kinds and maps. `step` of a lattice, 0 without one."""
    below = y[y < 0.0]
    gap = -float(below.max()) if below.size else math.inf

    def unsigned(x: Array) -> Array:
        return np.where((x < 0.0) & (x > -gap), -x, x)

    def printed(x: Array) -> Array:
        return _no_zeros(step * np.rint(x / step) if step > 0.0 else x)

    found: list[tuple[str, Callable[[Array], Array]]] = [("digits_lost", printed)]
    if gap > noise:
        found += [("sign_lost", unsigned), ("digits_lost", lambda x: printed(unsigned(x)))]
    if step > 0.0:
        found.append(("truncated", lambda x: step * np.trunc(x / step)))
    return found


def about_zero(values: Array, lattice: Lattice | None) -> Misread | None:
    """The likeliest map about zero of readings [n], NaN where there are none; None where none is likelier than that all
    are read as they are."""
    y = values[np.isfinite(values)]
    noise = noise_of(y)
    if (
        y.size < PIECES
        or (lattice is not None and lattice.coarseness > COARSEST)
        or not noise > 0.0
        or not (y.min() < noise and y.max() > -noise)
    ):
        return None
    step = lattice.step if lattice is not None and lattice.step > noise / 4.0 else 0.0
    width = step or max(noise / 4.0, float(np.ptp(y)) / VALUES_MOST)
    if lattice is not None and not step:  # the same number of codes in each value
        width = lattice.step * (2.0 * math.ceil(0.5 * width / lattice.step) + 1.0)
    shift = 0.0 if lattice is None else 0.5  # a value of a lattice is the middle of what is rounded to it
    place = np.floor(y / width + shift).astype(np.int64)
    first, many = int(place.min()), int(np.ptp(place)) + 1
    if many > 2 * VALUES_MOST or (step and float(np.abs(y / step - np.rint(y / step)).max()) > 0.02):
        return None
    _, count = counts_of_pieces(place - first, many, PIECE, PIECES)
    most = max(abs(first), abs(first + many)) + 2
    edges = np.arange(-2 * most, 2 * most + 1) * 0.5 * width
    points = edges[:-1, None] + 0.5 * width * (np.arange(POINTS) + 0.5) / POINTS

    def cells(read: Callable[[Array], Array]) -> tuple[Array, Array]:
        """Chance [values, cells] that a reading of a cell is shown as a value, and that it is changed [cells]."""
        shown = read(points)
        to = np.zeros((many, len(points)))
        cell = np.floor(shown / width + shift).astype(np.int64) - first
        inside = (cell >= 0) & (cell < many)
        np.add.at(to, (cell[inside], np.nonzero(inside)[0]), 1.0 / POINTS)
        return to, np.mean(np.floor(points / width + shift) != np.floor(shown / width + shift), axis=1)

    def fitted(to: Array, changed: Array) -> tuple[float, float, float]:
        """ln likelihood with one noise, with a noise of each piece, and the share of readings that change."""
        level = np.arange(edges[0], edges[-1], max(LEVEL_STEP * noise, 0.25 * width))
        best, each, share = -math.inf, np.full(len(count), -math.inf), 0.0
        for sigma in noise * FACTORS:
            true = np.diff(ndtr((edges[:, None] - level) / sigma), axis=0)
            ln = ln_of(count, to @ true)
            own = ln.max(axis=1)
            each = np.maximum(each, own)
            if own.sum() > best:
                best = float(own.sum())
                share = float(count.sum(axis=1) @ (changed @ true)[ln.argmax(axis=1)]) / y.size
        return best, float(each.sum()), share

    as_it_is = cells(lambda x: x)
    plain = fitted(*as_it_is)
    maps = _maps(y, noise, step)
    tried = [(kind, fitted(*cells(read))) for kind, read in maps]
    kind, best = max(tried, key=lambda one: one[1][0])
    nats = min(best[0] - plain[0], best[1] - plain[1]) - math.log(len(tried))
    if nats < nats_of("misread"):
        return None
    # Values that hold more than their own: lost words, and limits.
    total = count.sum(axis=0)
    for one in {-first, 0, many - 1, int(np.argmax(total))} & set(range(many)):
        for share in SHARES_OF_ONE:
            to = (1.0 - share) * as_it_is[0]
            to[one] += share
            if fitted(to, as_it_is[1])[0] > best[0] + nats_of("outliers"):
                return None
    return Misread(kind, best[2], nats)


def misread_of(values: Array, lattice: Lattice | None) -> Misread | None:
    """How readings [n], NaN where there are none, were misread; None where they were not."""
    return range_change_of(values, lattice) or stuck_bit_of(values, lattice) or about_zero(values, lattice)
