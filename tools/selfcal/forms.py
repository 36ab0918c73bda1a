"""How a channel's value acts on a reading: as it is, late, by its powers, or through a play. Host tools, model file and
simulator form columns by this one function."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Forms, the simplest first.
FORMS = ("static", "lag", "rate", "square", "cube", "play")
#: The entry that has a form's number.
NUMBER = {"lag": "lag_s", "rate": "window_s", "play": "width"}
#: The power of the channel's unit.
POWER = {"square": 2, "cube": 3}
#: What of the channel acts: its value, or the variance of its noise.
INPUTS = ("value", "variance")


def formed(
    values: Array,
    form: str,
    number: float = math.nan,
    about: float = 0.0,
    interval_s: float = 1.0,
    missing: NDArray[np.integer[Any]] | None = None,
) -> Array:
    """[n]: the column that `values` [n] of a channel make. Sample i follows `missing[i]` absent ones.

    `number`: the time constant of a lag, s; the window of a rate, s; the whole width of a play. A rate is the slope of
    the straight line that fits its window best. `about`: what powers are taken about. A lag, a rate and a play begin at
    rest, at the first value. Between two samples the channel moves on a straight line.
    """
    if form == "static" or values.size == 0:
        return values
    if form == "lag":
        return _lagging(values, -math.expm1(-interval_s / number), missing)
    if form == "rate":
        return _slopes(values, max(2, round(number / interval_s)), missing) / interval_s
    if form == "play":
        return _played(values, 0.5 * number)
    return np.asarray((values - about) ** POWER[form])


def variance_of(values: Array, missing: NDArray[np.integer[Any]] | None = None) -> Array:
    """[n]: half the square of each difference: its mean is the variance of the noise, and no slow change is in it.

    Not a number where there is no sample before."""
    half = np.full(values.size, np.nan)
    half[1:] = 0.5 * np.diff(values) ** 2
    if missing is not None:
        half[missing > 0] = np.nan
    return half


def _lagging(values: Array, gain: float, missing: NDArray[np.integer[Any]] | None) -> Array:
    """A first-order low pass: x += gain (value - x) at each sample."""
    from scipy.signal import lfilter  # its import takes longer than all else at the start

    out = np.empty(values.size)
    starts = [0] if missing is None else [0, *(np.flatnonzero(missing[1:] > 0) + 1).tolist()]
    state = float(values[0])
    for k, start in enumerate(starts):
        end = starts[k + 1] if k + 1 < len(starts) else values.size
        if k > 0 and missing is not None:
            # On a line of slope g the low pass ends up g (1 - gain) / gain behind; what it is off of that decays.
            steps = int(missing[start]) + 1
            slope = (values[start] - values[start - 1]) / steps
            behind = slope * (1.0 - gain) / gain
            state = values[start] - behind + (state - values[start - 1] + behind) * (1.0 - gain) ** steps
        else:
            state += gain * (values[start] - state)
        out[start] = state
        rest = values[start + 1 : end]
        if rest.size:
            out[start + 1 : end], _ = lfilter([gain], [1.0, gain - 1.0], rest, zi=[(1.0 - gain) * state])
            state = float(out[end - 1])
    return out


def _slopes(values: Array, window: int, missing: NDArray[np.integer[Any]] | None) -> Array:
    """The slope, per sample, of the straight line that fits the last `window` values best. A gap as long as the window
    begins it anew."""
    from scipy.signal import oaconvolve  # its import takes longer than all else at the start

    out = np.empty(values.size)
    far = [] if missing is None else (np.flatnonzero(missing[1:] >= window) + 1).tolist()
    # The newest value first: a convolution turns its kernel round.
    weight = 0.5 * (window - 1) - np.arange(window)
    weight /= float(weight @ weight)
    for start, end in zip([0, *far], [*far, values.size], strict=True):
        part = values[start:end]
        steps = np.ones(part.size, np.int64) if missing is None else missing[start:end].astype(np.int64) + 1
        place = np.cumsum(steps) - steps[0]
        whole = np.interp(np.arange(place[-1] + 1), place, part) if place[-1] + 1 > part.size else part
        about = np.concatenate([np.zeros(window - 1), whole - part[0]])
        out[start:end] = oaconvolve(about, weight, mode="valid")[place]
    return out


def _played(values: Array, half: float) -> Array:
    """What follows at a distance of `half` at most, and moves only if it must."""
    out = np.empty(values.size)
    at = float(values[0])
    for i, value in enumerate(values.tolist()):
        at = min(max(at, value - half), value + half)
        out[i] = at
    return out
