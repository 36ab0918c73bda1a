"""Values on an even grid: runs of a mask and of equal values, counts of pieces, block means, noise of differences; and
the place where a condition begins to hold."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise, starmap
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

#: Median absolute deviation of a normal with the standard deviation 1.
MEDIAN_SD = NormalDist().inv_cdf(0.75)
#: Step of a central difference by a number of about 1: rounding and curvature err alike.
SLOPE_STEP = float(np.cbrt(np.finfo(float).eps))


def bisected(holds: Callable[[float], bool], low: float, high: float) -> tuple[float, float]:
    """The ends of a span, halved 40 times, from where something does not hold to where it does."""
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return low, high


def slices(sizes: Sequence[int]) -> list[slice]:
    """Slices of `sizes` entries each, back to back."""
    return list(starmap(slice, pairwise(accumulate(sizes, initial=0))))


def weighted_quantiles(values: Array, weight: NDArray[Any], p: Sequence[float]) -> Array:
    """Quantiles `p` of `values` [n] in ascending order, each of which stands for the middle of its `weight` [n]."""
    total = np.cumsum(weight)
    return np.interp(p, (total - 0.5 * weight) / total[-1], values)


def runs(mask: Mask) -> list[tuple[int, int]]:
    """First row and the row after the last of every run of true values of a mask [n]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def equal_runs(values: NDArray[np.floating[Any]]) -> tuple[Rows, Rows]:
    """First row [k] and length [k] of every run of equal values [n]; NaN is like no other."""
    first = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    return first, np.diff(first, append=values.size)


def counts_of_pieces(code: Rows, many: int, least: int, most: int) -> tuple[Rows, Rows]:
    """The piece [n] that each code is in, and how often a piece has each of `many` codes [pieces, many]. There are
    `most` pieces at most, of `least` codes each at least; the last piece has the rest too. n is `least` or more."""
    size = max(least, -(-code.size // most))
    piece = np.minimum(np.arange(code.size) // size, code.size // size - 1)
    return piece, np.bincount(piece * many + code, minlength=(int(piece[-1]) + 1) * many).reshape(-1, many)


def block_means(rows: Array, size: int) -> Array:
    """Means [..., n // size] of whole blocks of rows [..., n]; NaN where a value is NaN."""
    n = rows.shape[-1] // size
    return np.ascontiguousarray(rows[..., : n * size].reshape(*rows.shape[:-1], n, size).mean(axis=-1))


def half_means(values: Array, size: int) -> tuple[Array, Rows]:
    """Means of whole blocks of `size` values [n], [n // size], of those that are there; NaN where half are missing. And
    how many are there, [n // size]."""
    cells = values[: values.size // size * size].reshape(-1, size)
    there = np.isfinite(cells)
    used: Rows = there.sum(axis=1)
    return np.where(2 * used >= size, np.where(there, cells, 0.0).sum(axis=1) / np.maximum(used, 1), np.nan), used


def regridded(values: Array, dt: float, n: int, to_dt: float) -> Array:
    """Means of `dt` s [k] on a grid of n samples `to_dt` s apart that begins where they do, by straight lines."""
    return np.asarray(np.interp((np.arange(n) + 0.5) * to_dt, (np.arange(values.size) + 0.5) * dt, values))


def noise_of(values: Array) -> float:
    """White noise of values [n] by the median of their differences. On a lattice coarser than it most of them are
    0: then by the 60 % quantile. A walk that is slower than the noise has no part in it, nor have rare jumps."""
    steps = np.abs(np.diff(values))
    steps = steps[np.isfinite(steps)]
    if not steps.size:
        return 0.0
    middle, upper = np.quantile(steps, [0.5, 0.6])
    return max(float(middle) / MEDIAN_SD, float(upper) / NormalDist().inv_cdf(0.8)) / math.sqrt(2.0)
