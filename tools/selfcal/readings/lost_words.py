"""Readings that have a value more often than their noise and lattice explain: words that a bus has lost.

A value far from the rest needs no statistic of the noise. Within the noise the likelihood of the codes finds it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import kl_div

from selfcal.base.grid import Array, Mask
from selfcal.readings.budget import nats_of
from selfcal.readings.codes import CHANGED_LEAST, Misread, noise_beside
from selfcal.readings.lattice import step_of

#: Share of wrong readings up to which they are left out.
#: Of more, either they or the others may be the noise. Then most averages have too few readings too, and a bias that
#: walks is lost between the others.
WRONG_SHARE_MOST = 0.5
#: Readings of a value whose neighbours are looked at, at most; these on either side, and how far off they may be, in
#: the noise.
SAMPLED, AROUND, NEAR_NOISES = 50_000, 8, 3.0
#: The others come close to a limit of the part: within this many of their standard deviations, or at the next value,
#: are this share of its own readings, or of the others. At the largest of some hundred normal readings are fewer.
CLOSE, CLOSE_OWN, CLOSE_OTHERS = 0.5, 0.5, 0.05


@dataclass(frozen=True)
class Recurring:
    """Readings that have a `value` too often: their `share`, the `mask` [n] of readings to leave out, and the evidence
    in nats. Beyond a share of WRONG_SHARE_MOST the mask is empty."""

    value: float
    share: float
    mask: Mask
    nats: float


def recurring_of(values: Array, explained: Misread | None) -> Recurring | None:
    """The value that recurs most surely in readings [n] (NaN: missing). It is a value with hardly another reading near
    it, or the word that the likelihood of the codes `explained`."""
    known = np.isfinite(values)
    y = values if known.all() else values[known]
    if y.size < 8 * AROUND:
        return None
    commonest, most, sigma = noise_beside(y)
    if not sigma > 0.0:
        return None
    spacing = step_of(y)[0] or float(np.median(np.diff(np.unique(y))))
    value, nats = _alone(y, sigma, spacing)
    own = y == value
    lost = own
    if nats < nats_of("outliers") and explained is not None and explained.kind == "word":
        assert explained.value is not None and explained.undone is not None
        if not _stands_out(y, explained.value, spacing):
            return None
        value, nats, own = explained.value, explained.nats, y == explained.value
        lost = own & np.isnan(explained.undone[known])
    others = y[~own]
    if nats < nats_of("outliers") or (2 * most > y.size and value != commonest) or others.size < 8 * AROUND:
        return None
    if is_limit(others, value, int(own.sum()), spacing) or not _rests(y, own, sigma):
        return None
    share, mask = float(lost.mean()), np.zeros(values.size, bool)
    if share <= WRONG_SHARE_MOST:
        mask[known] = lost
    return Recurring(value, share, mask, min(1e6, nats))


def _alone(y: Array, sigma: float, spacing: float) -> tuple[float, float]:
    """The most frequent value of readings [n] whose neighbours within the noise `sigma` occur about once each, and its
    evidence in nats. `spacing` of the values."""
    value, counts = np.unique(y, return_counts=True)
    total, reach = np.concatenate([[0], np.cumsum(counts)]), max(sigma, 2.5 * spacing)
    first, last = np.searchsorted(value, value - reach), np.searchsorted(value, value + reach, "right")
    expected = 0.5 + (total[last] - total[first] - counts) / np.maximum(1, last - first - 1)
    worth = np.where((counts >= CHANGED_LEAST) & (expected < 2.0), kl_div(counts, expected), 0.0)
    top = int(np.argmax(worth))
    return float(value[top]), float(worth[top]) - math.log(value.size)


def _stands_out(y: Array, value: float, spacing: float) -> bool:
    """Whether more readings [n] have a value than the cubic through ln of the neighbouring counts predicts."""
    code = np.rint((y - value) / spacing)
    count = np.array([np.count_nonzero(code == k) + 0.5 for k in (-2, -1, 1, 2)])
    weight = np.array([-1.0, 4.0, 4.0, -1.0]) / 6.0
    expected = math.exp(float(weight @ np.log(count)))
    sd = math.sqrt(expected + expected**2 * float(weight**2 @ (1.0 / count)))
    return float(np.count_nonzero(y == value)) > expected + math.sqrt(2.0 * nats_of("outliers")) * sd


def _rests(y: Array, own: Mask, sigma: float) -> bool:
    """Whether most of the `own` readings among [n] lie among others that rest, as many on either side."""
    others, rows = np.flatnonzero(~own), np.flatnonzero(own)
    rows = rows[:: -(-rows.size // SAMPLED)]
    first = np.clip(np.searchsorted(others, rows) - AROUND, 0, others.size - 2 * AROUND)
    around = y[others[first[:, None] + np.arange(2 * AROUND)]]
    off = np.abs(around - np.median(around, axis=1, keepdims=True))
    return bool(np.mean(np.quantile(off, 0.75, axis=1) < NEAR_NOISES * sigma) >= WRONG_SHARE_MOST)


def is_limit(others: Array, value: float, count: int, step: float) -> bool:
    """Whether a value at the edge of all readings has the `count` that a limit of the part makes of their noise: the
    `others` [n] come close to it."""
    if float(others.min()) < value < float(others.max()):
        return False
    distance = np.abs(others - value)
    close = int(np.count_nonzero(distance < max(CLOSE * float(others.std()), 1.5 * step)))
    return close > min(CLOSE_OWN * count, CLOSE_OTHERS * others.size)
