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

from selfcal.base.grid import Array, counts_of_pieces, noise_of
from selfcal.readings.budget import nats_of
from selfcal.readings.codes import INNER, ODD, PIECE, ln_of
from selfcal.readings.lattice import Lattice, lattice_of, step_of

#: Noises of a jump at least, jumps at least, the share of them that have one size, and how far off they are, in noises.
JUMP, JUMPS_LEAST, ALIKE, OFF = 12.0, 5, 0.9, 6.0
#: Noise of the readings that are a span off, over that of all, at least.
LIKE_NOISE = 0.3
#: Share of the readings that bytes of two readings are at most.
TORN_MOST = 0.25
#: Bits at least of a count that goes round.
BITS_LEAST = 5
#: Noises of a reading in the circle of a count from which on each reading has its turn.
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


def spans_of(values: Array, rate_hz: float) -> Misread | None:
    """Readings [n] at `rate_hz` to which whole spans were added; NaN are none of them. O(n)."""
    known = np.flatnonzero(np.isfinite(values))
    y = values[known]
    if y.size < PIECE:
        return None
    found = _spans(y, lattice_of(y, rate_hz)) or _low_bits(y)
    if found is None or found.undone is None:
        return found
    undone = values.copy()
    undone[known] = found.undone
    return replace(found, undone=undone)


def _spans(y: Array, lattice: Lattice | None) -> Misread | None:
    """The same of readings [n] that are all there, by jumps of one size."""
    steps = np.diff(y)
    size = np.abs(steps)
    # A quarter of the differences of normal noise is below 0.45 of its sd.
    noise = float(np.quantile(size, 0.25)) / 0.45
    far = size[size > JUMP * noise]
    if far.size < JUMPS_LEAST or not noise > 0.0:
        return None
    span = float(np.median(far))
    alike = far[np.abs(far / span - 1.0) < OFF * noise / span]
    if not alike.size:  # the median lies between two that differ
        return None
    span = float(alike.mean())
    if lattice is not None:
        span = lattice.step * round(span / lattice.step)
        noise = max(noise, LIKE_NOISE * lattice.step)
    off = np.abs(far / span - np.rint(far / span)) * span
    if span < 2.0 * JUMP * noise or np.mean(off < OFF * noise) < ALIKE:
        return None
    turns = np.concatenate([[0], np.cumsum(np.rint(steps / span))])
    found, often = np.unique(turns, return_counts=True)
    own = float(found[np.argmax(often)])
    if float(np.ptp(y)) < span + 2.0 * noise:  # two levels have the whole of their noise on either side
        span = float(np.ptp(y)) + float(np.diff(np.unique(y)).min())  # both ends are met
        kind = "unsigned" if float(y.min()) > -noise else "overflow"
        if kind == "unsigned":  # the true ones are about zero
            own = -float(np.rint(np.median(y - span * turns) / span)) or 0.0
    else:
        # Bytes of two readings, where the upper one changes: whole upper bytes off, on both sides.
        upper = lattice.step * 2.0 ** round(math.log2(span / lattice.step)) if lattice is not None else math.inf
        sides = [float(np.mean(turns == own + side)) for side in (-1.0, 1.0)]
        if abs(upper - span) > OFF * noise or sum(sides) > TORN_MOST or min(sides) < ODD + 0.1 * max(sides):
            return None
        kind, span = "torn", upper
    if float(y[turns != own].std()) < LIKE_NOISE * noise:
        return None  # a word that the logger shows for lost ones has no noise
    undone = y - span * (turns - own)
    nats = far.size * math.log(span / (2.0 * OFF * noise))
    return Misread(kind, float(np.mean(turns != own)), nats, undone)


def _low_bits(y: Array) -> Misread | None:
    """Readings [n] that are the low bits of a count alone: they fill 2^k codes from end to end, and lie nearer to a
    level on the circle of these codes than on the line. Of noise that fills the circle no reading is known."""
    step = step_of(y)[0]
    bits = math.log2(float(np.ptp(y)) / step + 1.0) if step > 0.0 else 0.0
    if bits < BITS_LEAST or abs(bits - round(bits)) * 2.0**bits > 0.5:
        return None
    span = step * 2.0 ** round(bits)
    if min(int(np.count_nonzero(np.abs(y - end) < 0.5 * step)) for end in (y.min(), y.max())) < JUMPS_LEAST:
        return None
    turn = 2.0 * math.pi / span
    level = np.unwrap(np.angle(uniform_filter1d(np.exp(1j * turn * y), PIECE, mode="nearest"))) / turn
    off = y - level
    off -= span * np.rint(off / span)
    on_line = float((y - uniform_filter1d(y, PIECE, mode="nearest")).std())
    nats = y.size * math.log(on_line / max(float(off.std()), LIKE_NOISE * step))
    if nats < nats_of("misread"):
        return None
    turns = np.rint((level + off - y) / span)
    turns -= float(np.median(turns))
    kind = "overflow" if float(y.min()) < 0.0 else "low_bits"
    middle = float(np.median(y + span * turns))
    if kind == "low_bits" and min(middle, span - middle) < float(off.std()):  # the true ones are about zero
        kind, turns = "unsigned", turns - float(np.rint(middle / span))
    undone = y + span * turns if float(off.std()) * WHOLE < span else None
    return Misread(kind, float(np.mean(turns != 0.0)), nats, undone)


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
