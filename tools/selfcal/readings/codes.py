"""Readings as codes: noise on a lattice seen through a map of misreadings, and the map that explains the counts best.

A map says as which code each true value is read: a dead band, every other code narrow, a word in place of any reading,
a limit, a sign or zeros that printing loses, a cast that truncates. Noise is normal about a level that each piece of
the record has for itself. The counts of the pieces have a likelihood under each map. Readings on no lattice have cells
for codes, and their commonest value has its own cell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.special import ndtr

from selfcal.base.grid import Array, counts_of_pieces, noise_of
from selfcal.readings.budget import CLEARLY, nats_of
from selfcal.readings.lattice import COARSEST, FINE, Lattice, step_of

#: Codes or cells at most, and readings at least.
CODES, READINGS_LEAST = 400, 300
#: Most pieces of a record that have a level each; fewest readings in a piece.
LEVEL_PIECES, PIECE_ROWS = 100, 64
#: Share of the readings from which on the commonest value has no part in the steps that show the noise.
COMMON_SHARE = 0.2
#: Cells in the noise of readings on no lattice; parts of true values in a cell, and points in a cell.
CELLS, CELL_PARTS, CELL_POINTS = 4.0, 8, 32
#: Noises that are tried first, in that of differences; steps of a level, in noises.
TRIED_NOISES, LEVEL_STEP = np.geomspace(0.1, 3.0, 12), 0.5
#: Shares that are read as another code, and further codes of a dead band on either side.
MISREAD_SHARES, DEAD_CODES_MOST = np.concatenate([np.geomspace(0.01, 0.3, 24), np.linspace(0.33, 1.0, 23)]), 12
#: Ratio of the counts of the two commonest values above which the first stands out, on no lattice.
STANDS_OUT = 3.0
#: Rounds in which a map is sought at the last map's levels and noises, or these are refined for a map.
TURNS = 3
#: Chance of a reading that the noise and the codes, or a map, do not make.
ODD = 1e-6
#: Fewest readings that a map changes, or that have a suspect value.
CHANGED_LEAST = 5
#: Kinds that are no cause of their own here: lost_words.py and readings.py have them.
ELSEWHERE = ("word", "limit")
#: Kinds of codes that are not alike.
UNEVEN = ("band", "uneven")


@dataclass(frozen=True)
class Misread:
    """The `kind` of a map, the `share` of the readings that it has changed (of a change of the range: until it, or from
    it on), and its `nats` net of the search. `undone` [n]: the readings before it, by chance where several are
    possible, None where they are lost. A dead band reads as `value` what is nearer than `width`. `also_possible`: kinds
    whose evidence is nearly as large."""

    kind: str
    share: float
    nats: float
    undone: Array | None = None
    value: float | None = None
    width: float | None = None
    also_possible: tuple[str, ...] = ()

    @property
    def entry(self) -> dict[str, Any]:
        """What a check states of it."""
        also = {"also_possible": list(self.also_possible)} if self.also_possible else {}
        return {"kind": self.kind, "undone": self.undone is not None, **also}

    @property
    def sd(self) -> float:
        """sd of the share of codes that are not alike."""
        return 0.0 if self.undone is None else math.sqrt(2.0 * self.share / self.undone.size)


@dataclass(frozen=True)
class _Map:
    """`to` [codes, parts]: the chance that a true value in a part of a code is read as a code. Or `lost` [codes], the
    share of each code that is read as the code `place`, of unequal codes as its neighbours. Of a dead band `inner` is
    the whole codes on either side, `share` the lost part of the next codes."""

    kind: str
    to: csr_matrix | None = None
    lost: Array | None = None
    place: int = 0
    inner: int = -1
    share: float = 1.0

    def read(self, expected: Array) -> Array:
        """Counts read [codes, ...] of `expected` true counts [codes, ...]."""
        assert self.lost is not None
        moved = (self.lost * expected.T).T
        read = np.asarray(expected - moved)
        if self.kind == "uneven":
            read[:-1] += 0.5 * moved[1:]
            read[1:] += 0.5 * moved[:-1]
        else:
            read[self.place] += moved.sum(axis=0)
        return read

    def within(self, cells: Cells) -> csr_matrix:
        """`to`, of codes as they are without the map."""
        return csr_matrix(self.read(cells.own.toarray())) if self.to is None else self.to


@dataclass(frozen=True)
class _Fit:
    """Level, noise and ln likelihood of each piece, [2, pieces]: with a noise for all pieces, and with a noise for each
    piece at a price."""

    level: Array
    sigma: Array
    ln: Array

    def over(self, other: _Fit) -> float:
        """Evidence over another, nats: noise that comes and goes does not make it."""
        return float(self.ln.sum(axis=1).max() - other.ln.sum(axis=1).max())

    def better(self, other: _Fit) -> _Fit:
        """The likelier of two: in all pieces together, and in each."""
        more = other.ln > self.ln
        more[0] = other.ln[0].sum() > self.ln[0].sum()
        return _Fit(*np.where(more, (other.level, other.sigma, other.ln), (self.level, self.sigma, self.ln)))


class Cells:
    """Readings [n] in codes of a `width` about an `origin`. `count` [pieces, codes]; the last code is the commonest
    value of readings on no lattice. `edges` of parts of codes of true values, and `own` [codes, parts]: as which each
    is read by itself."""

    def __init__(self, y: Array, step: float) -> None:
        commonest, most, self.noise = noise_beside(y)
        self.pile = None
        if not step > 0.0 and most >= CHANGED_LEAST:  # it may lie off the lattice of the others
            others = y[y != commonest]
            step = step_of(others)[0]
            beside = step > FINE * self.noise or most > STANDS_OUT * np.unique(others, return_counts=True)[1].max(
                initial=0
            )
            self.pile = commonest if beside else None
        self.step = step if step > FINE * self.noise else 0.0
        self.noise = max(self.noise, 0.5 * self.step)  # of a reading that toggles
        self.origin, self.width = self.pile or 0.0, self.noise / CELLS
        if self.step > 0.0:
            many = max(1.0, float(np.ptp(y)) / step / CODES, 0.5 * self.width / step)
            self.width = step * (2.0 * math.floor(0.5 * many) + 1.0)
            self.origin = step * float(np.median(y / step - np.rint(y / step)))
            self.origin *= abs(self.origin) > 0.1 * step
        # A code has an upper and a lower half: that is enough for a cast.
        self.parts = 2 if self.width < 1.5 * self.step else CELL_PARTS
        code = np.rint((y - self.origin) / self.width).astype(np.int64)
        middle = int(np.quantile(code, 0.5, method="lower"))  # a code that occurs: a mean of two may lie far from all
        self.kept = np.abs(code - middle) < CODES // self.parts
        code = code[self.kept]
        low, high = int(code.min()), int(code.max())
        self.about_zero = abs(self.origin) < 1e-9 * self.width or self.pile is not None
        reach = (high - low + 1) // 2
        self.first, last = low - reach, high + reach
        self.folds = self.about_zero and low <= CELLS and high >= -CELLS
        if self.folds:
            self.first, last = min(self.first, -high), max(last, -low)
        self.many = last - self.first + 2
        self.code = code - self.first
        if self.pile is not None:
            self.code[y[self.kept] == commonest] = self.many - 1
        self.piece, self.count = counts_of_pieces(self.code, self.many, PIECE_ROWS, LEVEL_PIECES)
        self.total = self.count.sum(axis=0).astype(np.float64)
        self.there = np.flatnonzero(self.total)
        self.edges = self.origin + self.width * (
            self.first - 0.5 + np.arange((self.many - 1) * self.parts + 1) / self.parts
        )
        self.own = self.read(lambda x: x)

    def read(self, map_of: Callable[[Array], Array]) -> csr_matrix:
        """Chance [codes, parts] that a true value is read as a code, by a map of values."""
        many = self.edges.size - 1
        each = CELL_POINTS // self.parts
        points = self.edges[:-1, None] + self.width * (np.arange(each) + 0.5) / CELL_POINTS
        code = np.rint((map_of(points) - self.origin) / self.width).astype(np.int64) - self.first
        inside = (code >= 0) & (code < self.many - 1)
        return csr_matrix(
            (np.full(int(inside.sum()), 1.0 / each), (code[inside], np.nonzero(inside)[0])), shape=(self.many, many)
        )

    @cached_property
    def true(self) -> list[tuple[Array, Array]]:
        """The levels for each noise, and the chance [parts, levels] of parts of codes."""
        chances = []
        # The mean of a piece is within two noises of its level, unless the readings are folded.
        mean = self.count @ (self.origin + self.width * np.append(np.arange(self.many - 1) + self.first, 0))
        mean = mean / self.count.sum(axis=1)
        low, high = mean.min() - 2.0 * self.noise, mean.max() + 2.0 * self.noise
        if self.folds:
            low, high = min(low, -high), max(high, -low)
        for sigma in self.noise * TRIED_NOISES:
            level = np.arange(low, high + LEVEL_STEP * sigma, LEVEL_STEP * sigma)
            chances.append((level, np.diff(ndtr((self.edges[:, None] - level) / sigma), axis=0)))
        return chances

    def fit(self, to: csr_matrix, near: _Fit | None = None) -> _Fit:
        """The likeliest levels and noises under a map: Fisher's scoring from those of a `near` map, or from the best of
        a grid."""
        count, to = self.count[:, self.there].T[:, None], to[self.there]
        price = np.outer([0.0, 0.5], np.log(self.count.sum(axis=1)))
        none = _Fit(np.zeros_like(price), np.zeros_like(price), np.full(price.shape, -np.inf))
        best = none if near is None else replace(near, ln=none.ln)
        for (levels, chance), tried in zip(self.true, self.noise * TRIED_NOISES, strict=True) if near is None else ():
            ln = count[:, 0].T @ np.log(self._likely(to @ chance))
            level_of = np.broadcast_to(levels[np.argmax(ln, axis=1)], price.shape)
            best = best.better(_Fit(level_of, np.full(level_of.shape, tried), ln.max(axis=1) - price))
        level, sigma = best.level, best.sigma
        for _ in range(TURNS):
            z = (self.edges[:, None, None] - level) / sigma
            density = np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
            cells = (np.diff(each, axis=0).reshape(len(z) - 1, -1) for each in (ndtr(z), -density, -z * density))
            chance, by_level, by_noise = ((to @ each).reshape(-1, *level.shape) for each in cells)
            likely = self._likely(chance)
            best = best.better(_Fit(level, sigma, (count * np.log(likely)).sum(axis=0) - price))
            score, of_noise = ((count * by / likely).sum(axis=0) for by in (by_level, by_noise))
            total = count.sum(axis=0) / likely
            known, both, noise = ((total * by).sum(axis=0) for by in (by_level**2, by_level * by_noise, by_noise**2))
            known += 1.0  # a reading: a piece of one code shows neither level nor noise
            of_noise, noise = of_noise - both / known * score, noise - both**2 / known + 1.0
            of_noise[0], noise[0] = of_noise[0].sum(), noise[0].sum()
            step = np.clip(of_noise / noise, -LEVEL_STEP, LEVEL_STEP)
            level = level + sigma * np.clip((score - both * step) / known, -LEVEL_STEP, LEVEL_STEP)
            sigma = np.clip(sigma * np.exp(step), *self.noise * TRIED_NOISES[[0, -1]])
        return best

    def _likely(self, chance: Array) -> Array:
        return np.asarray((1.0 - ODD) * chance + ODD / self.many)

    def of_pieces(self, fit: _Fit) -> Array:
        """Chance [parts, pieces] of parts of codes at the levels and noises of a fit, as they are likelier."""
        row = int(np.argmax(fit.ln.sum(axis=1)))
        return np.asarray(np.diff(ndtr((self.edges[:, None] - fit.level[row]) / fit.sigma[row]), axis=0))

    def expected(self, fit: _Fit) -> Array:
        """Readings [parts] that a fit has in each part."""
        return np.asarray(self.of_pieces(fit) @ self.count.sum(axis=1))

    def gain(self, rival: _Map, expected: Array) -> float:
        """Gain of a map in ln likelihood of the counts of all pieces, over the counts `expected` [codes] without it."""
        floor = ODD * float(self.total.sum()) / self.many
        return float(self.total @ np.log((rival.read(expected) + floor) / (expected + floor)))

    def lacking(self, expected: Array) -> float:
        """Nats that the counts of all pieces together have beyond those `expected` [codes]."""
        count = self.total[self.there]
        return float(count @ np.log(count / (expected[self.there] + ODD * float(self.total.sum()) / self.many)))

    def limit(self, side: int) -> csr_matrix:
        """All above the largest reading, or below the smallest, are read as it."""
        ends = self.there[self.there < self.many - 1]
        if not ends.size:  # the pile has all
            return self.own
        end = self.origin + self.width * (self.first + int(ends[-1] if side > 0 else ends[0]))
        clip = np.minimum if side > 0 else np.maximum
        if self.pile is None or side * (self.pile - end) < -self.width:
            return self.read(lambda x: clip(x, end))
        beyond = side * (self.edges[:-1] + 0.5 * self.width / self.parts - self.pile) > 0.0
        read = self.own.multiply(~beyond).tolil()
        read[self.many - 1, beyond] = 1.0
        return read.tocsr()


def noise_beside(y: Array) -> tuple[float, int, float]:
    """The commonest of readings [n], how often it comes, and the noise, of the others alone where it is common."""
    unique, counts = np.unique(y, return_counts=True)
    commonest, most = float(unique[np.argmax(counts)]), int(counts.max())
    return commonest, most, noise_of(y[y != commonest] if most > COMMON_SHARE * y.size else y)


def _about_zero(cells: Cells, y: Array) -> Iterator[_Map]:
    """What printing or a cast may have made of values about zero."""
    step = cells.step
    below = y[y < 0.0]
    gap = -float(below.max()) if below.size else math.inf

    def unsigned(x: Array) -> Array:
        return np.where((x < 0.0) & (x > -gap), -x, x)

    def printed(x: Array) -> Array:
        """Zeros behind the point are lost: 0.05 is read as 0.5."""
        part, whole = np.modf(np.abs(step * np.rint(x / step) if step > 0.0 else x))
        return np.asarray(np.sign(x) * (whole + part * 10.0 ** np.floor(-np.log10(np.maximum(part, 1e-9)))))

    yield _Map("digits_lost", cells.read(printed))
    if gap > max(cells.noise, 1.5 * step):
        yield _Map("sign_lost", cells.read(unsigned))
        yield _Map("digits_lost", cells.read(lambda x: printed(unsigned(x))))
    if step > 0.0:
        yield _Map("truncated", cells.read(lambda x: step * np.trunc(x / step)))


def _of_places(cells: Cells, over: Array, near: _Map | None = None) -> Iterator[_Map]:
    """Dead bands, words and unequal codes, about the codes that are read too often, or close to the map `near`. `over`:
    readings [codes] that are expected without them."""
    code, n = np.arange(cells.many), float(cells.total.sum())
    kinds = {"band", "word", "uneven"} if near is None else {near.kind}
    often = np.argsort((over - cells.total) / np.sqrt(over + 1.0))[:3] if near is None else [near.place]
    if cells.pile is not None:
        often = [cells.many - 1]
    for place in map(int, often) if "uneven" not in kinds or near is None else ():
        share = float((cells.total[place] - over[place]) / (n - over[place]))
        if share > 0.0 and "word" in kinds:
            yield _Map("word", None, np.full(code.size, share), place, share=share)
        if "band" not in kinds:
            continue
        centre = place if cells.pile is None else round((cells.pile - cells.origin) / cells.width) - cells.first
        off = np.abs(code - centre)
        off[-1] = code.size
        for inner in range(DEAD_CODES_MOST) if near is None else range(max(0, near.inner - 1), near.inner + 2):
            for share in MISREAD_SHARES[:: 6 if inner else 2] if near is None else MISREAD_SHARES:
                lost = np.where(off <= inner, 1.0, np.where(off == inner + 1, share, 0.0))
                yield _Map("band", None, lost, place, inner, float(share))
    if "uneven" in kinds and cells.pile is None and cells.width < 1.5 * cells.step:
        for place in (0, 1) if near is None else (near.place,):
            narrow = (code % 2 == place) & (code > 0) & (code < cells.many - 2)
            for share in MISREAD_SHARES[::2] if near is None else MISREAD_SHARES:
                yield _Map("uneven", None, share * narrow, place, share=float(share))


def codes_of(values: Array, lattice: Lattice | None) -> Misread | None:
    """The map of readings [n] (NaN: missing) that explains their codes best; None where all are read alike, or their
    counts show nothing: on a lattice that is coarse against the noise, or in too few readings."""
    known = np.flatnonzero(np.isfinite(values))
    y = values[known]
    if y.size < READINGS_LEAST or (not noise_beside(y)[2] > 0.0 if lattice is None else lattice.too_coarse):
        return None
    cells = Cells(y, 0.0 if lattice is None else lattice.step)
    plain = cells.fit(cells.own)
    over = cells.own @ cells.expected(plain)
    if cells.lacking(over) < cells.there.size + nats_of("quantization"):
        return None
    maps = list(_about_zero(cells, y)) if cells.folds else []
    maps += [_Map("limit", cells.limit(side)) for side in (1, -1)]
    tried = list(_of_places(cells, over)) if lattice is None or lattice.coarseness < COARSEST else []
    for kind in {rival.kind for rival in tried}:
        maps.append(max((rival for rival in tried if rival.kind == kind), key=lambda rival: cells.gain(rival, over)))
    fits = []
    for each in maps:
        fit, best = cells.fit(each.within(cells)), each
        for _ in range(TURNS if each.to is None else 0):
            over = cells.own @ cells.expected(fit)
            best = max(_of_places(cells, over, best), key=lambda rival: cells.gain(rival, over), default=best)
            fit = cells.fit(best.within(cells), fit)
        fits.append((fit.over(plain) - math.log(len(tried) if each.kind in UNEVEN else len(maps)), best, fit))
    nats, best, fit = max(fits, key=lambda tried_map: tried_map[0])
    possible = (rival.kind for more, rival, _ in fits if more > nats - CLEARLY)
    also = tuple(kind for kind in dict.fromkeys(possible) if kind != best.kind)
    now, to = cells.expected(fit), best.within(cells)
    if best.to is None:
        # Of a few codes noise that is not normal makes evidence as well: as it makes what the map leaves, beyond half a
        # nat a code. A map of all codes leaves what lies within its parts.
        nats /= max(1.0, 2.0 * cells.lacking(to @ now) / cells.there.size)
    if best.kind not in ELSEWHERE and nats < nats_of("quantization" if best.kind in UNEVEN else "misread"):
        return None
    share = 1.0 - float(now @ np.asarray(to.multiply(cells.own).sum(axis=0)).ravel()) / float(now.sum())
    undone = value = width = None
    if best.kind in UNEVEN:
        undone = values.copy()
        undone[known[cells.kept]] = _drawn(cells, y[cells.kept], to, fit)
    if best.kind == "word":  # the word is a single value of its code
        chance = np.asarray(cells.own[best.place] @ cells.of_pieces(fit)).ravel() * max(cells.step / cells.width, 0.01)
        random = np.random.default_rng(1).random(cells.code.size)
        lost = random * (best.share + (1.0 - best.share) * chance[cells.piece]) < best.share
        undone = values.copy()
        undone[known[cells.kept][lost & (cells.code == best.place)]] = np.nan
    if best.kind in ("word", "band"):
        unique, often = np.unique(y[cells.kept][cells.code == best.place], return_counts=True)
        value = float(unique[np.argmax(often)]) if cells.pile is None else cells.pile
    if best.kind == "band":
        width = cells.width * (best.inner + best.share + 0.5)
    return Misread(best.kind, share, nats, undone, value, width, also)


def _drawn(cells: Cells, y: Array, to: csr_matrix, fit: _Fit) -> Array:
    """Draw for each reading [n] a true reading that it may come from."""
    random, chance, drawn = np.random.default_rng(1), cells.of_pieces(fit), y.copy()
    other = to - to.multiply(cells.own > 0.0)
    own = cells.own.argmax(axis=0).A1 + cells.first
    for code in np.flatnonzero(np.asarray(other.sum(axis=1)).ravel() > 0.0):
        rows = np.flatnonzero(cells.code == code)
        parts = to[code].indices
        possible = np.cumsum(to[code].data[:, None] * chance[parts], axis=0)
        if not rows.size or not float(possible[-1].min()) > 0.0:
            continue
        piece = cells.piece[rows]
        below = possible[:, piece] < random.random(rows.size) * possible[-1, piece]
        part = parts[below.sum(axis=0)]
        if cells.step > 0.0:
            drawn[rows] = y[rows] + cells.width * (own[part] - (code + cells.first))
        else:
            drawn[rows] = cells.edges[part] + cells.width / cells.parts * random.random(rows.size)
    return drawn
