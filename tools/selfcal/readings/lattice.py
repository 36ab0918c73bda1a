"""The lattice of quantized readings: its step, and how coarse it is against the noise of a reading."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Steps in the noise of a reading (its standard deviation, rounding included) from which on the noise is below the
#: lattice. A reading that toggles between two values has at least 2, however little noise there was before rounding.
#: At 1.9 that noise is 0.44 steps and N a fifth too large; below, rounding is white noise of step^2 / 12.
COARSE_FROM = 1.9
#: Fewest sums, over 1 s each, that show carried rounding errors, and fewest readings in a sum. Such sums scatter by
#: less than this share of sums of independent readings. That takes a lattice coarser than COARSEST.
CARRIED_SUMS, CARRIED_READINGS, CARRIED_SHARE = 120, 8, 0.5
#: Difference of two remainders of sums that follow each other, each uniform in a step: its share in the scatter.
REMAINDERS = 0.25
#: Least variance in `carried` of a counter, steps^2 in a second: 120 seconds show it to 0.04 only.
CARRIED_LEAST = 1e-3
#: Variance, in steps^2, that noise gains in an interval from which on the remainders of its ends are white: they
#: correlate by exp(-2 pi^2 of it), 0.14.
WHITE_REMAINDERS = 0.1
#: Values nearer than this share of the largest are equal: differences of a counter are rounded so. Values of a float32
#: are six times as far apart.
SAME_VALUE_SHARE = 1e-8
#: Steps in the noise of a reading from which on the lattice is coarser than it. Codes are compared below alone: beyond,
#: heavy tails look like a dead band, and ln of the counts is not smooth.
COARSEST = 1.0
#: Below this many steps in the noise the lattice is that of the number's digits, and shows in nothing.
FINE = 0.01
#: Largest distance of a value from its lattice, in steps; largest relative difference of two equal steps.
OFF = 0.02
#: Last digits of printed values in a step at least, for it to show.
PRINTED = 3.0
#: Differences between neighbouring values from which on the values of a decade, or of an octave, show their step.
STEP_DIFFERENCES_LEAST = 20


@dataclass(frozen=True)
class Lattice:
    """`step` in the unit of the readings; `coarseness`: steps in the noise of a reading; `distinct` readings.

    `carried`: of a counter whose increments are read, the variance that its noise gains in a second, in steps^2; 0
    where each reading is rounded by itself."""

    step: float
    coarseness: float
    distinct: int
    carried: float = 0.0

    @property
    def most(self) -> float:
        """Coarseness beyond which the noise is below the lattice. A counter's is: else no remainder would show."""
        return COARSEST if self.carried else COARSE_FROM

    @property
    def too_coarse(self) -> bool:
        """Rounding is no white noise: the noise cannot be separated from the lattice."""
        return self.coarseness > self.most

    @property
    def white_hz(self) -> float:
        """Rate of means of a counter whose remainders are white, Hz, to one digit."""
        rate = self.carried / WHITE_REMAINDERS
        digit = 10.0 ** math.floor(math.log10(rate))
        return math.floor(rate / digit) * digit

    def too_coarse_over(self, interval_s: float) -> bool:
        """Whether means are too coarse. Long means of a counter have white remainders (quantization noise)."""
        return self.too_coarse and self.carried * interval_s < WHITE_REMAINDERS


def lattice_of(values: NDArray[np.floating[Any]], rate_hz: float) -> Lattice | None:
    """The lattice of readings [n] at `rate_hz`, None if they lie on none or are all the same, or if it is FINE.

    Their noise is the scatter about means of 1 s, or of CARRIED_READINGS where a second holds fewer, unless that of
    differences is less: a drift has no part in it. Remainders that are carried on have the larger part in differences.
    """
    carried = 0.0
    step, distinct = step_of(values)
    if step <= 0.0:
        return None
    size = max(round(rate_hz), CARRIED_READINGS)
    count = values.size // size
    within = values[: count * size].reshape(count, size)
    noise = math.sqrt(float(within.var(axis=1).mean()) * size / (size - 1.0)) if count else math.inf
    if size > rate_hz:
        noise = min(noise, float(np.diff(values).std()) / math.sqrt(2.0))
    coarseness = step / noise if noise > 0.0 else math.inf
    if count >= CARRIED_SUMS and COARSEST < coarseness < math.inf:
        sums = within.sum(axis=1) / step
        scatter = 0.5 * float((np.diff(sums) ** 2).mean())
        if scatter < CARRIED_SHARE * size / coarseness**2:
            carried = max(CARRIED_LEAST, (scatter - REMAINDERS) * rate_hz / size)
    return Lattice(step, coarseness, distinct, carried) if coarseness >= FINE else None


def step_of(values: NDArray[np.floating[Any]]) -> tuple[float, int]:
    """The step of the lattice of readings [n], however fine, 0 if they lie on none; distinct readings."""
    unique = np.unique(values)
    step = _step(unique)
    return step if step > 0.0 and _throughout(unique, step) else 0.0, unique.size


def _throughout(unique: NDArray[np.floating[Any]], step: float) -> bool:
    """Whether values of every size have this step. A printed number with a fixed count of digits has a coarser step
    from each power of ten on, a binary number from each power of two on."""
    size = np.abs(unique)
    for base in (2.0, 10.0):
        with np.errstate(divide="ignore"):
            kind = np.floor(np.log(size) / math.log(base))
        for decade in np.unique(kind[np.isfinite(kind)]):
            for part in (unique[(kind == decade) & (unique > 0.0)], unique[(kind == decade) & (unique < 0.0)]):
                some = part.size > STEP_DIFFERENCES_LEAST and np.ptp(part) > 0.5 * step  # else a single value, rounded
                if some and not abs(_step(part) / step - 1.0) < OFF:
                    return False
    return True


def _step(unique: NDArray[np.floating[Any]]) -> float:
    """The spacing of the lattice that all values lie on, else 0. It is about the smallest difference between values.
    Every difference is a whole multiple of it, to the last digit of values printed with few."""
    gaps = np.diff(unique)
    gaps = gaps[gaps > SAME_VALUE_SHARE * np.abs(unique).max(initial=0.0)]
    if not gaps.size:
        return 0.0
    q, digit = float(gaps.min()), 0.0
    if unique.size > STEP_DIFFERENCES_LEAST:
        digit = 10.0 ** math.floor(math.log10(q / PRINTED))
        if float(np.abs(unique / digit - np.rint(unique / digit)).max()) > OFF:
            digit = 0.0
        else:
            q = float(np.mean(gaps[gaps < q + 2.5 * digit]))
    steps = np.rint(gaps / q)
    q = float(gaps.sum() / steps.sum())
    return q if float(np.abs(gaps - steps * q).max()) < max(OFF * q, 1.1 * digit) else 0.0
