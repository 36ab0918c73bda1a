"""A damped oscillator that white noise drives, of any period: x'' + 2 damping w x' + w^2 x = white noise, w = 2 pi / P.

A slow swing is the drift's (causes/oscillation.py), a fast swing a band (causes/periodic.py). The drift swallows slow
swings: the innovations are looked at behind smaller drifts as well. A smoothed periodogram of these shows the period
and the damping from which all is fitted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import rfft
from scipy.ndimage import uniform_filter1d

from selfcal.likelihood.columns import FIT_ADDS, NEARLY
from selfcal.likelihood.fit import Fit, best, fit_at, left, moved
from selfcal.likelihood.state import State, net
from selfcal.likelihood.statemodel import PERIOD_LIMITS
from selfcal.model.laws import DAMPING_LIMITS, SWING_LEAST

#: Least turns in a record.
SWING_TURNS_LEAST = 3.0
#: Drifts behind which slow swings are looked for: smaller by exp(-these).
SWING_DRIFTS = (0.0, 1.5, 4.0)
#: Widths of a mean of the periodogram, bins. Half the width of a band is this share of the mean that shows it.
MEAN_BINS, HALF_WIDTH_SHARE = tuple(2**k for k in range(1, 10)), 0.3
#: Damping above which a fast band is coloured or flicker noise.
DAMPING_MOST = 0.25
#: Most swings that a model may have besides a slow swing.
SWINGS_MOST = 5
#: ln of the bins of the spectrum less this is the price of a search: by 800 clean records at 1 and 10 Hz, of swings
#: that forget their phase.
LN_FEWER = 4.4


@dataclass(frozen=True)
class Swing:
    """A swing with its fits for every near drift: its gain, and that `net` of the search."""

    fits: tuple[Fit, ...]
    gain: float
    net: float

    @property
    def fit(self) -> Fit:
        return best(self.fits)

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Period, s, damping, and ln of its size over the white noise of a sample."""
        period, damping, size = (self.fit.value(name) for name in ("ln_period", "ln_damping", "ln_swing"))
        return math.exp(period), math.exp(damping), size

    @property
    def keeps_phase(self) -> bool:
        """Whether the record is too short to show that its phase is forgotten: it may be a line."""
        period, damping, _ = self.numbers
        return 2.0 * math.pi * damping * self.fit.duration_s < period


def found(state: State, *, slow: bool) -> Swing | None:
    """The swing that promises most, the drift fitted with it, if it is worth 1 nat. None where it cannot be named: a
    fit adds no more than a drift of two terms alone gains, and FIT_ADDS."""
    n, span = state.y.size, state.y.size * state.dt
    border = span / max(PERIOD_LIMITS[0], SWING_LEAST * state.dt)
    low, high = (max(SWING_TURNS_LEAST, span / PERIOD_LIMITS[1]), border) if slow else (border, 0.5 * n)
    start = _search(state, low, high, SWING_DRIFTS if slow else SWING_DRIFTS[:1], 1.0 if slow else DAMPING_MOST)
    price = max(0.0, math.log(max(high - low, 1.0)) - LN_FEWER)
    if start is None or net(start[2] + FIT_ADDS, 3, price) < NEARLY:
        return None
    gain, fits = state.with_terms(start[0], start[1], oscillation=True, bands=held(state))
    if slow and not state.extras.all_scales:  # a poor drift model makes some nats of any slow term
        gain -= max(0.0, state.rich.ln_likelihood - state.best.ln_likelihood)
    swing = Swing(fits, gain, net(gain, 3, price))
    period, damping, _ = swing.numbers
    inside = low < span / period < high and (slow or damping < DAMPING_MOST)
    return swing if swing.net >= 1.0 and inside else None


def held(state: State) -> tuple[tuple[float, float, float], ...]:
    """The swings of a model, each with the numbers that it has."""
    return (*state.extras.bands, *([Swing((state.best,), 0.0, 0.0).numbers] if state.extras.oscillation else []))


def _search(
    state: State, low: float, high: float, sizes: Sequence[float], most: float
) -> tuple[dict[str, float], float, float] | None:
    """ln of period, damping and size of the likeliest swing of `low` to `high` turns and a damping of `most`, by how
    much the drift with it is smaller, and its gain before a fit. Each mean of the periodogram has its best place; of
    these the filter finds the likeliest."""
    n, fit = state.y.size, state.best
    place = np.arange(n // 2 + 1)
    terms = replace(fit.terms, oscillation=True, bands=held(state))
    tried: list[tuple[dict[str, float], float, float]] = []
    for less in sizes:
        drift = fit.shrunk(less)
        white = left(state.series, drift, np.empty((0, n)))[:, 0]
        power = np.abs(rfft(white)) ** 2 / (fit.sigma**2 * fit.n)
        for width in MEAN_BINS:
            mean = np.maximum(uniform_filter1d(power, width, mode="reflect"), 1.0)
            gain = width * (mean - 1.0 - np.log(mean)) - np.log(np.maximum(place / width, 1.0))
            inside = (mean > 1.0) & (place >= low) & (place < high) & (HALF_WIDTH_SHARE * width < most * place)
            if not inside.any():
                continue
            at = int(np.argmax(np.where(inside, gain, -math.inf)))
            size = 0.5 * math.log(2.0 * width * (float(mean[at]) - 1.0) / n)
            damping = math.log(min(HALF_WIDTH_SHARE * width / at, DAMPING_LIMITS[1]))
            own = {"ln_period": math.log(n * state.dt / at), "ln_damping": damping, "ln_swing": size}
            value = fit_at(state.series, terms, moved(drift, terms, own)).ln_likelihood - fit.ln_likelihood
            tried.append((own, less, value))
    return max(tried, key=lambda each: each[2], default=None)
