"""Rows of a converter that are not alike: some of their readings are read as a neighbour.

Two kinds are looked for. A dead band shows readings near a value as that value. Of unequal codes every other one is
narrow and loses a share to both neighbours. Noise is normal about a level that each piece of the record has for itself.
Rows are judged by the likelihood of their counts in each piece. Readings on no lattice have a dead band alone: the
codes are then cells about their commonest value.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from selfcal.base.grid import Array, Rows, counts_of_pieces
from selfcal.readings.budget import nats_of
from selfcal.readings.lattice import COARSEST, Lattice

#: Rows between the smallest and the largest reading, and readings, at least and at most.
CODES, READINGS_LEAST = (5, 160), 300
#: Pieces of a record that have a level each, at most, and readings in one at least.
PIECES, PIECE = 200, 64
#: Steps of the levels, in codes or in noises if these are more, and factors of the noise that are tried about its best.
LEVELS, FACTORS = 0.05, (0.88, 0.94, 1.0, 1.06, 1.13, 1.25)
#: ... then nearer,
NEAR = (0.97, 0.98, 0.99, 1.01, 1.02, 1.03)
#: and where each piece has a noise of its own.
WIDE = tuple(float(2.0**k) for k in np.linspace(-2.0, 1.6, 13))
#: Shares that are read as a neighbour, and further codes of a dead band on either side.
SHARES, WIDTHS = np.concatenate([np.geomspace(0.01, 0.3, 24), np.linspace(0.33, 1.0, 23)]), 12
#: Cells in the noise of readings on no lattice, and readings of one value, and their share, at least.
CELLS, PILE, PILE_SHARE = 4.0, 20, 0.01
#: Times that it is commoner than the next one, at least.
STANDS_OUT = 3.0
#: Quantiles of the readings that all codes and dead bands lie between.
INNER = (0.01, 0.99)
#: Times that the shares and the levels are found in turn.
TURNS = 3
#: Chance of a reading that the noise and the codes, or a map, do not make.
ODD = 1e-6


@dataclass(frozen=True)
class Uneven:
    """A `share` (and its `sd`) of the readings is read as another code. A dead band reads them as `value`, up to
    `width` from it; None: every other code is narrow. `drawn` [n]: each reading as one of the codes that it may come
    from. `nats`: evidence net of the search."""

    share: float
    sd: float
    nats: float
    drawn: Array
    value: float | None = None
    width: float | None = None


@dataclass(frozen=True)
class _Read:
    """How codes are read: `to` [codes, codes] is the chance that a reading of the second is read as the first.
    `place`, `inner` and `share`: the centre of a dead band, its whole codes on either side, and the share of the next
    ones. Of unequal codes `place` is 0 or 1, the narrow ones, and `inner` is -1."""

    to: Array
    place: int
    inner: int
    share: float


def _band(many: int, place: int, inner: int, share: float) -> _Read:
    """A dead band about a code."""
    to = np.eye(many)
    for k in range(max(0, place - inner - 1), min(many, place + inner + 2)):
        if k != place:
            lost = 1.0 if abs(k - place) <= inner else share
            to[place, k], to[k, k] = lost, 1.0 - lost
    return _Read(to, place, inner, share)


def _every_other(many: int, place: int, share: float) -> _Read:
    """Narrow codes from `place` on."""
    to = np.eye(many)
    for k in range(place, many, 2):
        sides = [side for side in (k - 1, k + 1) if 0 <= side < many]
        to[k, k] = 1.0 - share
        to[sides, k] = share / len(sides)
    return _Read(to, place, -1, share)


@dataclass(frozen=True)
class _Fit:
    """`value`: ln likelihood; `chance` [codes, pieces] of each true code at the level of each piece."""

    value: float
    sigma: float
    chance: Array


def ln_of(count: Array | Rows, chance: Array) -> Array:
    """ln likelihood [pieces, levels] of counts [pieces, codes] of what is read with a chance [codes, levels]."""
    return np.asarray(count @ np.log((1.0 - ODD) * chance + ODD / len(chance)))


def _of_pieces(count: Array, to: Array, sigma: float) -> float:
    """ln likelihood of counts [pieces, codes] where each piece has the noise and the level that suit it best."""
    return float(np.max([_values(count, to, factor * sigma)[0].max(axis=1) for factor in WIDE], axis=0).sum())


def _values(count: Array | Rows, to: Array, sigma: float) -> tuple[Array, Array]:
    """ln likelihood [pieces, levels], and the chance [codes, levels] of each true code."""
    many = count.shape[1]
    ends = np.arange(many + 1)[:, None] - 0.5 - np.arange(-1.0, many, LEVELS * max(1.0, sigma))
    below = ndtr(ends / sigma)
    below[0], below[-1] = 0.0, 1.0
    true = np.diff(below, axis=0)
    return ln_of(count, to @ true), true


def fit_of(count: Array | Rows, to: Array, sigma: float) -> _Fit:
    """The likeliest level of each piece and the likeliest noise near `sigma`, in codes, for counts [pieces, codes]."""
    best = _Fit(-math.inf, sigma, np.empty((0, 0)))
    for factors in (FACTORS, NEAR):
        for own in [factor * best.sigma for factor in factors]:
            value, true = _values(count, to, own)
            at = np.argmax(value, axis=1)
            total = float(value[np.arange(len(count)), at].sum())
            if total > best.value:
                best = _Fit(total, own, true[:, at])
    return best


def uneven_of(values: Array, lattice: Lattice | None) -> Uneven | None:
    """The likeliest way in which codes of readings [n] are unequal, NaN where there is none; None where all are alike,
    or one value has readings of all others alike."""
    known = np.flatnonzero(np.isfinite(values))
    if known.size < READINGS_LEAST or (lattice is not None and lattice.coarseness > COARSEST):
        return None
    y = values[known]
    pile = _pile(y) if lattice is None else (float(y.min()), lattice.step, lattice.coarseness)
    if pile is None:
        return None
    origin, step, coarseness = pile
    place = np.rint((y - origin) / step)
    if not np.ptp(place) < CODES[1]:
        return None
    code = (place - place.min()).astype(np.int64)
    many = int(code.max()) + 1
    if not CODES[0] <= many <= CODES[1]:
        return None
    piece, whole = counts_of_pieces(code, many, PIECE, PIECES)
    count = whole.astype(np.float64)
    sigma = math.sqrt(max(1.0 / coarseness**2 - 1.0 / 12.0, 0.04))
    alike = fit_of(count, np.eye(many), sigma)
    read = max(_candidates(count, alike), key=lambda one: _gain(count, alike, one.to))
    fit = alike
    for _ in range(TURNS):
        fit = fit_of(count, read.to, fit.sigma)
        read = max(_near(read), key=lambda one: _gain(count, fit, one.to))
    fit = fit_of(count, read.to, fit.sigma)
    nats = fit.value - alike.value - math.log(many * (SHARES.size + WIDTHS))
    if nats < nats_of("quantization"):
        return None
    total, expected = count.sum(axis=0), fit.chance @ count.sum(axis=1)
    if _of_all(count, alike, total, read) > fit.value - nats_of("quantization"):
        return None
    # Noise that comes and goes piles up as well: where each piece has its own, it must not.
    nats = _of_pieces(count, read.to, fit.sigma) - _of_pieces(count, np.eye(many), fit.sigma)
    nats -= math.log(many * (SHARES.size + WIDTHS))
    if nats < nats_of("quantization"):
        return None
    moved = float(expected @ (1.0 - np.diag(read.to))) / y.size
    drawn = values.copy()
    away = _true(code, piece, read.to, fit.chance) - code
    drawn[known] += step * away
    sd = math.sqrt(2.0 * moved / y.size)
    if read.inner < 0:
        return Uneven(moved, sd, nats, drawn) if lattice is not None else None
    own = code == read.place
    if lattice is None:
        if not own[np.argmax(y == origin)]:
            return None
        # The band swallows the readings of the cell about its value too.
        moved += float(expected[read.place]) / y.size
        drawn[known] += np.where(own, step * (np.random.default_rng(2).random(y.size) - 0.5), 0.0)
        sd = math.sqrt(2.0 * moved / y.size)
    width = step * (read.inner + read.share + 0.5)
    return Uneven(moved, sd, nats, drawn, float(y[np.argmax(own)]) if lattice is not None else origin, width)


def _pile(y: Array) -> tuple[float, float, float] | None:
    """The commonest value of readings [n] on no lattice, a cell about it, and cells in their noise; None where no value
    is common."""
    unique, counts = np.unique(y, return_counts=True)
    largest = np.sort(counts)[::-1]
    if largest[0] < max(PILE, PILE_SHARE * y.size, STANDS_OUT * float(largest[1:2].sum())):
        return None
    value, step = float(unique[np.argmax(counts)]), float(np.diff(y).std()) / math.sqrt(2.0) / CELLS
    low, high = np.quantile(y[y != value], INNER)
    return (value, step, 1.0 / CELLS) if step > 0.0 and low < value < high else None  # beyond, it is a lost word


def _candidates(count: Array, fit: _Fit) -> Iterator[_Read]:
    """Dead bands about every code that is read too often, and unequal codes."""
    many = count.shape[1]
    total, expected = count.sum(axis=0), fit.chance @ count.sum(axis=1)
    for place in np.argsort((expected - total) / np.sqrt(expected + 1.0))[:3]:
        for inner in range(WIDTHS):
            for share in SHARES[:: 6 if inner else 2]:
                yield _band(many, int(place), inner, float(share))
    for place in (0, 1):
        for share in SHARES[::2]:
            yield _every_other(many, place, float(share))


def _near(read: _Read) -> Iterator[_Read]:
    """The same with other shares, and with a code more or less."""
    many = len(read.to)
    for share in SHARES:
        if read.inner < 0:
            yield _every_other(many, read.place, float(share))
            continue
        for inner in range(max(0, read.inner - 1), read.inner + 2):
            yield _band(many, read.place, inner, float(share))


def _gain(count: Array, fit: _Fit, to: Array) -> float:
    """Of ln likelihood of the counts of all pieces together, at the levels and the noise of a fit."""
    total, expected = count.sum(axis=0), fit.chance @ count.sum(axis=1)
    floor = ODD * float(total.sum()) / total.size
    return float(total @ np.log((to @ expected + floor) / (expected + floor)))


def _of_all(count: Array, alike: _Fit, total: Array, read: _Read) -> float:
    """ln likelihood of a word that is shown in place of a share of all readings: the likeliest, or that of the band."""
    expected = alike.chance @ count.sum(axis=1)
    n = float(total.sum())
    share = np.clip((total - expected) / np.maximum(n - expected, 1.0), 0.0, 0.9)
    with np.errstate(divide="ignore"):
        gains = total * np.log((expected + share * (n - expected) + ODD * n) / (expected + ODD * n))
        gains += (n - total) * np.log1p(-share)
    found = []
    for place in {int(np.argmax(gains)), read.place}:
        own, sigma = float(share[place]), alike.sigma
        for _ in range(TURNS):
            to = (1.0 - own) * np.eye(total.size)
            to[place] += own
            fit = fit_of(count, to, sigma)
            found.append(fit.value)
            usual = float((fit.chance @ count.sum(axis=1))[place])
            own, sigma = min(max((float(total[place]) - usual) / (n - usual), 0.0), 0.9), fit.sigma
    return max(found)


def _true(code: Rows, piece: Rows, to: Array, chance: Array) -> Rows:
    """Each code [n] as one that it may come from, drawn by chance."""
    random = np.random.default_rng(1)
    found = code.copy()
    for read in np.flatnonzero((to - np.diag(np.diag(to))).sum(axis=1) > 0.0):
        rows = np.flatnonzero(code == read)
        possible = np.cumsum(to[read][:, None] * chance, axis=0)
        if rows.size and float(possible[-1].min()) > 0.0:
            below = possible[:, piece[rows]] < random.random(rows.size) * possible[-1, piece[rows]]
            found[rows] = below.sum(axis=0)
    return found
