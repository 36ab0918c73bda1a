"""From a recording to the axes and side channels on one even grid."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from selfcal.diagnosis.state import State
from selfcal.diagnosis.statemodel import Array, Mask
from selfcal.errors import UserError
from selfcal.model import Model
from selfcal.recording import Recording

#: Columns that are no axis but may explain one, by cause: name and unit.
CHANNELS = {"temperature": ("temp", "degC"), "supply": ("supply", "V")}
#: LSB over the noise of a reading from which on an axis counts as below its lattice: rounding alone has a standard
#: deviation of lsb / sqrt(12), so the white noise itself is then below a third of an LSB.
BELOW_LATTICE = 2.2
#: Samples that a diagnosis needs at least.
LEAST = 200


@dataclass(frozen=True)
class Record:
    """All axes of a recording on its grid of n instants. `channels`: temperature and supply where they were recorded,
    [n] in degC and V, bridged where samples are missing; `channel_names` their columns. `missing` samples of the
    recording, at its own rate."""

    rate_hz: float
    axes: Mapping[str, State]
    channels: Mapping[str, Array]
    channel_names: Mapping[str, str]
    present: Mask
    missing: int = 0

    @property
    def time_s(self) -> Array:
        return np.arange(self.present.size) / self.rate_hz

    def other_axes(self, axis: str) -> dict[str, Array]:
        """The other axes about their level, bridged where missing."""
        return {name: bridged(one.y) - float(np.nanmedian(one.y)) for name, one in self.axes.items() if name != axis}


def of_recording(recording: Recording, model: Model, decimate: float | None = None) -> Record:
    """Every sensor column that the model knows, in the unit of each axis' group, and the side channels.

    `decimate`, Hz: means of whole blocks at the rate nearest to it; a block of which half is missing is missing.
    """
    if decimate is not None and not (math.isfinite(decimate) and 0.0 < decimate <= recording.rate_hz):
        raise UserError(f"--decimate must be a rate above 0 Hz, at most the recording's {recording.rate_hz:g} Hz")
    at = np.arange(recording.samples) + np.cumsum(recording.missing_before)
    at -= at[0]
    block = 1 if decimate is None else max(1, round(recording.rate_hz / decimate))
    n = (int(at[-1]) + 1) // block
    if n < LEAST:
        raise UserError(f"{recording.path}: too short: {n} samples at this rate, a diagnosis needs {LEAST} or more")
    index = at // block
    kept = index < n
    used = np.bincount(index[kept], minlength=n)
    present = 2 * used >= block

    def on_grid(values: Array) -> Array:
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.bincount(index[kept], values[kept], minlength=n) / used
        return np.where(present, mean, np.nan)

    states: dict[str, State] = {}
    for name in model.axes:
        if name not in recording.columns:
            continue
        group = model.group_of(name)
        values = recording.in_unit(name, group.unit)
        if not np.ptp(values) > 0.0:
            continue
        y = on_grid(values)
        q = lattice(values)
        level = float(np.nanmedian(y))
        states[name] = State(
            axis=name,
            unit=group.unit,
            y=y - level,
            dt=block / recording.rate_hz,
            level=level,
            r=np.where(present, block / np.maximum(used, 1), 1.0),
            lsb=q if block == 1 else 0.0,
            stated_lsb=group.lsb,
            redrawn=block > 1,
            below_lattice=q > BELOW_LATTICE * float(np.diff(values).std()) / math.sqrt(2.0),
        )
    channels: dict[str, Array] = {}
    names: dict[str, str] = {}
    for cause, (column, unit) in CHANNELS.items():
        if column in recording.columns:
            values = recording.in_unit(column, unit)
            if np.ptp(values) > 0.0:
                channels[cause] = bridged(on_grid(values))
                names[cause] = column
    return Record(recording.rate_hz / block, states, channels, names, present, int(recording.missing_before.sum()))


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
    if unique.size < 2:
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
    """Centred mean over `window` samples. It has no lag: the size that it shows is the cause's own."""
    return values if window <= 1 else np.asarray(uniform_filter1d(values, window, mode="nearest"))
