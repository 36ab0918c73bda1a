"""The line of the recorded readings that makes a line of means, below half of the means' rate."""

from __future__ import annotations

import math

import numpy as np
from scipy.fft import rfft

from selfcal.bank.blocks import MOST_DENSE
from selfcal.base.grid import Array
from selfcal.logs.recording import Recording, bridged

#: Least bins of the spectrum on each side that hold a line, and the next bins, which give the noise below it.
HALF, BINS_BESIDE = 4, 40
#: Share of its frequency by which a line wanders along a record: its power is looked for within that.
WANDERS = 0.02
#: Power of a line over the scatter of the noise below it, at least.
LINE_POWER_LEAST = 10.0


def alias_of(
    recording: Recording, axis: str, frequency_hz: float, half_width_hz: float, rate_hz: float
) -> tuple[float, float] | None:
    """Frequency, Hz, and amplitude, in the recording's unit, of the line of an axis that makes a line of `frequency_hz`
    in means at `rate_hz`. None if no line is clear, or most of a long grid is missing.

    Every line at k rate ± frequency does. The line that leaves most power in the means is taken."""
    own = recording.along(axis)
    read, recorded_hz = bridged(own.columns[axis].values), own.rate_hz
    place_of = own.clock.place
    on_grid = place_of - place_of[0]
    if on_grid[-1] >= max(MOST_DENSE, 2 * read.size):
        return None
    y = np.zeros(int(on_grid[-1]) + 1)  # about its mean: what is missing has no power
    y[on_grid] = read - read.mean()
    power = np.abs(np.asarray(rfft(y))) ** 2
    bin_hz = recorded_hz / y.size
    best, place = 0.0, 0.0
    for k in range(math.ceil(0.5 * recorded_hz / rate_hz) + 1):
        for hz in {k * rate_hz + frequency_hz, abs(k * rate_hz - frequency_hz)}:
            more, noise, centre = _line(power, hz / bin_hz, max(HALF, math.ceil(half_width_hz / bin_hz)))
            left = math.sin(math.pi * hz / rate_hz) * rate_hz / (recorded_hz * math.sin(math.pi * hz / recorded_hz))
            if more > LINE_POWER_LEAST * noise and more * left**2 > best:
                best, place = more * left**2, centre
    if best == 0.0:
        return None
    more, _, _ = _line(power, place, max(HALF, math.ceil(WANDERS * place)))
    return place * bin_hz, 2.0 * math.sqrt(max(more, 0.0)) / read.size


def _line(power: Array, place: float, half: int) -> tuple[float, float, float]:
    """Power of a line about a place of the spectrum beyond the noise there, the scatter of that noise, and the line's
    middle. Nothing where the spectrum ends."""
    low, high = round(place) - half, round(place) + half + 1
    if low < 1 or high >= power.size:
        return 0.0, 0.0, place
    beside = np.concatenate([power[max(1, low - BINS_BESIDE) : low], power[high : high + BINS_BESIDE]])
    noise = float(np.median(beside)) / math.log(2.0)
    return (
        float((power[low:high] - noise).sum()),
        noise * math.sqrt(high - low),
        float(np.average(np.arange(low, high), weights=power[low:high])),
    )
