"""Readings that the firmware or the logger changed as no likelihood of counts on a lattice shows it.

Maps that add whole spans (a count read as unsigned, an overflow, joined bytes of two readings) are undone. A bit that
never changes and a change of the range show in the codes themselves. codes.py has the maps of neighbouring codes.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from scipy.ndimage import uniform_filter1d

from selfcal.base.grid import MEDIAN_SD, Array, noise_of
from selfcal.readings.budget import nats_of
from selfcal.readings.codes import CHANGED_LEAST, LEVEL_PIECES, PIECE_ROWS, Misread, codes_of
from selfcal.readings.lattice import Lattice, step_of

#: Largest share of the changed readings that may be a single value; least share of the codes with a bit that occur.
SPAN_SHARE_MOST = 0.9
#: Least deviation of a reading that is not noise, in noises. Largest excess of torn readings on either side, in
#: standard deviations.
FAR_NOISES, EITHER_SIDE = 6.0, 4.0
#: Quantiles of the codes of which most have the bit that is there.
INNER = (0.01, 0.99)
#: Bits at least of a count that goes round.
BITS_LEAST = 5
#: Least span of a count that shows each reading's turns, in noises of a reading. Half of it shows torn readings.
CIRCLE_NOISES = 8.0
#: What may have happened, by kind.
MISREAD = MappingProxyType(
    {
        "sign_lost": "the sign of values between -1 and 0 is lost in printing",
        "truncated": "a cast truncates towards zero, round before it",
        "digits_lost": "zeros behind the point are lost in printing",
        "unsigned": "a signed count is read as unsigned",
        "overflow": "the count runs over",
        "torn": "bytes of two readings are joined, read them at once",
        "low_bits": "the upper bits of the count are lost",
        "bit_set": "a bit of the count is 1 in every reading",
        "bit_clear": "a bit of the count is 0 in every reading",
        "range_change": "the range of the part changes, the readings are right",
    }
)


def spans_of(values: Array) -> Misread | None:
    """Readings [n] to which whole spans were added; NaN: missing. O(n) for each span that is tried.

    A count that goes round loses its turns: readings lie near a level on the circle of its codes. A torn reading is off
    by the least step of its upper part, to either side as often. On a lattice spans are its powers of two."""
    known = np.flatnonzero(np.isfinite(values))
    y = values[known]
    if y.size < PIECE_ROWS or not np.ptp(y) > 0.0:
        return None
    step, size = step_of(y)[0], float(np.ptp(y))
    jump = float(np.partition(np.abs(np.diff(y)), -CHANGED_LEAST)[-CHANGED_LEAST])
    spans, ends = [], size + float(np.diff(np.unique(y)).min())
    if step > 0.0:
        whole = step * 2.0 ** math.ceil(math.log2(size / step + 0.5))
        least = max(step * 2.0**BITS_LEAST, 0.5 * CIRCLE_NOISES * noise_of(y))
        spans = [whole, *(span for span in whole * 0.5 ** np.arange(1, 64) if span > least)]
    spans = [span for span in (*spans, ends) if 2.0 * jump > span >= step * 2.0**BITS_LEAST]
    if not spans:
        return None
    line = _ln_of_noise(y - uniform_filter1d(y, PIECE_ROWS, mode="nearest"), size)
    tried = [_of_span(y, span, line, span < size, k < len(spans) - 1) for k, span in enumerate(spans)]
    best = max(filter(None, tried), key=lambda misread: misread.nats, default=None)
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

    core = np.abs(off) < FAR_NOISES * float(np.median(np.abs(off))) / MEDIAN_SD
    share = 1.0 - float(core.mean())
    if not 0.0 < share < 1.0:
        return normal(off)
    mixed = off.size * ((1.0 - share) * math.log1p(-share) + share * math.log(share / size))
    return max(normal(off), normal(off[core]) + mixed)


def _of_span(y: Array, span: float, line: float, torn: bool, lattice: bool) -> Misread | None:
    """The evidence that readings [n] are off by `span`, once if `torn`, else any number of times. `line`: ln likelihood
    about a level that follows them as they are. A span that no `lattice` states is known of little noise alone."""
    turn = 2.0 * math.pi / span
    level = np.unwrap(np.angle(uniform_filter1d(np.exp(1j * turn * y), PIECE_ROWS, mode="nearest"))) / turn
    turns = np.rint((level - y) / span)
    own = float(np.median(turns))
    turns -= own
    straight = y - level + own * span
    if torn:
        turns = np.clip(turns, -1.0, 1.0)
    changed, off = turns != 0.0, straight + span * turns
    count, size, sd = int(np.count_nonzero(changed)), float(np.ptp(y)), float(off.std())
    if count < CHANGED_LEAST or np.unique(y[changed], return_counts=True)[1].max() > SPAN_SHARE_MOST * count:
        return None  # a single value is a lost word
    share = count / y.size
    nats = _ln_of_noise(off, size) - max(line, _ln_of_noise(straight, size))
    if torn:
        if abs(float(turns.sum())) > EITHER_SIDE * math.sqrt(count):
            return None
        nats += count * math.log(0.5 * share) + (y.size - count) * math.log1p(-share)
        return Misread("torn", share, nats, y + span * turns if sd * CIRCLE_NOISES < span else None)
    if span < 2.0 * CIRCLE_NOISES * sd and not lattice:
        return None
    steps = np.diff(y)  # two levels that lie far apart are no neighbours on the circle either
    nats = min(nats, _ln_of_noise(steps - span * np.rint(steps / span), size) - _ln_of_noise(steps, size))
    kind = "overflow" if float(y.min()) < 0.0 else "low_bits"
    middle = float(np.median(y + span * turns))
    # The true readings are about zero; in a wide count, within more of their noises.
    if kind == "low_bits" and min(middle, span - middle) < max(sd, span / CIRCLE_NOISES**2):
        kind, turns = "unsigned", turns - float(np.rint(middle / span))
    return Misread(kind, float(np.mean(turns != 0.0)), nats, y + span * turns if sd * CIRCLE_NOISES < span else None)


def _of_bits(values: Array, lattice: Lattice | None) -> list[Misread]:
    """Readings [n] (NaN: missing) whose codes lack a bit: every other 2^k codes never come. Or whose codes lack the
    lowest bits until a time, or from a time on: the range of the part changed, and the readings are right.

    Each time that the bits above it change, the bit itself is 0 or 1 by chance."""
    y = values[np.isfinite(values)]
    if lattice is None or y.size < LEVEL_PIECES:
        return []
    code = np.rint(y / lattice.step).astype(np.int64)
    low, high = (int(edge) for edge in np.quantile(code, INNER))
    maps = []
    for k in range(max(2, int(math.log2(high - low + 1)) + 1)):
        bit = (code >> k) & 1
        for part in (code, code[::-1]) if k < 2 else ():
            size = int(np.argmax((part - part[0]) % 2 ** (k + 1) != 0))
            nats = (k + 1) * math.log(2.0) * np.count_nonzero(np.diff(part[:size])) - 2.0 * math.log(y.size)
            maps.append(Misread("range_change", size / y.size, nats))
        inner = np.arange(low, high + 1)
        inner = inner[((inner >> k) & 1) == bit[0]]
        if k and bit.min() == bit.max() and np.isin(inner, code).mean() > SPAN_SHARE_MOST:
            nats = math.log(2.0) * np.count_nonzero(np.diff(code >> (k + 1))) - math.log(64.0)
            maps.append(Misread(f"bit_{'set' if bit[0] else 'clear'}", 0.5, nats))
    return [misread for misread in maps if misread.nats > nats_of("misread")]


def misread_of(values: Array, lattice: Lattice | None) -> Misread | None:
    """The likeliest way in which readings [n] (NaN: missing) were misread, None where they were not."""
    of_bits = _of_bits(values, lattice)
    stuck = [misread for misread in of_bits if misread.kind != "range_change"]
    codes = None if stuck else codes_of(values, lattice)
    return max(stuck[:1] or [*of_bits, *([codes] if codes else [])], key=lambda misread: misread.nats, default=None)
