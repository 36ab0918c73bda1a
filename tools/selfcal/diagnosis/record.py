"""From a recording to the axes and side channels on one even grid."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from selfcal.diagnosis.state import State
from selfcal.diagnosis.statemodel import Array
from selfcal.model import Model
from selfcal.recording import Recording

#: Columns that are no axis but may explain one, by cause.
CHANNELS = {"temperature": ("degC",), "supply": ("V",)}


@dataclass(frozen=True)
class Record:
    """All axes of a recording on its grid of n instants. `channels`: temperature and supply where they were recorded,
    [n] in degC and V, bridged where samples are missing; `channel_names` their columns."""

    rate_hz: float
    axes: Mapping[str, State]
    channels: Mapping[str, Array]
    channel_names: Mapping[str, str]
    present: Array

    @property
    def time_s(self) -> Array:
        return np.arange(self.present.size) / self.rate_hz

    def other_axes(self, axis: str) -> dict[str, Array]:
        """The other axes about their level, bridged where missing."""
        return {name: bridged(one.y) - float(np.nanmedian(one.y)) for name, one in self.axes.items() if name != axis}


def of_recording(recording: Recording, model: Model, axes: Sequence[str]) -> Record:
    """`axes` and every other sensor column that the model knows, in the unit of each axis' group."""
    at = np.arange(recording.samples) + np.cumsum(recording.missing_before)
    at -= at[0]
    n = int(at[-1]) + 1
    present = np.zeros(n, bool)
    present[at] = True
    states: dict[str, State] = {}
    for name in model.axes:
        if name not in recording.columns:
            continue
        group = model.group_of(name)
        values = recording.in_unit(name, group.unit)
        y = np.full(n, np.nan)
        y[at] = values
        y[~np.isfinite(y)] = np.nan
        level = float(np.nanmedian(y))
        states[name] = State(
            axis=name,
            unit=group.unit,
            y=y - level,
            dt=1.0 / recording.rate_hz,
            level=level,
            r=np.ones(n),
            lsb=lattice(values),
            stated_lsb=group.lsb,
            limits=(-group.range - level, group.range - level) if group.range > 0.0 else (-math.inf, math.inf),
        )
    channels: dict[str, Array] = {}
    names: dict[str, str] = {}
    for cause, column in (("temperature", "temp"), ("supply", "supply")):
        if column in recording.columns:
            values = recording.in_unit(column, CHANNELS[cause][0])
            if np.ptp(values) > 0.0:
                whole = np.full(n, np.nan)
                whole[at] = values
                channels[cause] = bridged(whole)
                names[cause] = column
    return Record(recording.rate_hz, states, channels, names, present)


def bridged(values: Array) -> Array:
    """Missing values by straight lines."""
    good = np.isfinite(values)
    if good.all():
        return values
    where = np.arange(values.size)
    return np.interp(where, where[good], values[good])


def lattice(values: Array) -> float:
    """The spacing of the lattice that all values lie on, 0 if there is none: the smallest difference between values,
    where every difference is a whole multiple of it."""
    unique = np.unique(values)
    if unique.size < 3 or unique.size > max(50, values.size // 4):
        return 0.0
    gaps = np.diff(unique)
    gaps = gaps[gaps > 1e-9 * max(np.ptp(unique), np.abs(unique).max())]
    if not gaps.size:
        return 0.0
    least = float(gaps.min())
    steps = np.rint(gaps / least)
    q = float(gaps.sum() / steps.sum())
    return q if np.all(np.abs(gaps - steps * q) < 0.02 * q) else 0.0


def smoothed(values: Array, window: int) -> Array:
    """Centred mean over `window` samples."""
    return values if window <= 1 else uniform_filter1d(values, window, mode="nearest")
