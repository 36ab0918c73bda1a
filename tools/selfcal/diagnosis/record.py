"""From a recording to the axes and side channels on one even grid."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from selfcal import _library32
from selfcal.diagnosis.state import Regressor, State
from selfcal.diagnosis.statemodel import Array, Mask
from selfcal.errors import UserError
from selfcal.model import Group, Model
from selfcal.model import Regressor as Stated
from selfcal.readings import RateChange, Readings, Rows, evened, look, own_rows, readings_of, thinned
from selfcal.recording import SIDE_CHANNELS, Recording
from selfcal.regressors import columns_of, offered

#: Samples that a diagnosis needs at least, and takes at most, gaps included.
LEAST, MOST = 200, 10_000_000
#: Readings so many times beyond the sensor's range are no readings: the unit is wrong, or the file.
BEYOND = 100.0


@dataclass(frozen=True)
class Record:
    """All axes of a recording on its grid of n instants. `channels`: temperature and supply where they were recorded,
    [n] in degC and V, bridged where samples are missing; `channel_names` their columns. `missing` samples of the
    recording, at its own rate `recorded_hz`. `start_s`: where
    in the recording the grid begins, s; every time here counts from it."""

    rate_hz: float
    axes: Mapping[str, State]
    channels: Mapping[str, Array]
    channel_names: Mapping[str, str]
    present: Mask
    missing: int = 0
    recorded_hz: float = 1.0
    readings: Mapping[str, Readings] = field(default_factory=dict)
    change: RateChange | None = None
    unclipped: Mapping[str, Array] = field(default_factory=dict)
    start_s: float = 0.0

    @property
    def time_s(self) -> Array:
        return np.arange(self.present.size) / self.rate_hz

    def other_axes(self, axis: str) -> dict[str, Array]:
        """The other axes about their level, bridged where missing."""
        return {name: bridged(one.y) - float(np.nanmedian(one.y)) for name, one in self.axes.items() if name != axis}


def of_recording(recording: Recording, model: Model, decimate: float | None = None) -> Record:
    """Every sensor column that the model knows, in the unit of each axis' group, and the side channels. What the model
    file states is in the model of each axis from the start. Stuck readings are left out. Where every axis holds its
    readings the record has the part's own rate; where some do, the repeats of those are left out.

    `decimate`, Hz: means of whole blocks at the rate nearest to it; a block of which half is missing is missing.
    """
    if decimate is not None and not (math.isfinite(decimate) and 0.0 < decimate <= recording.rate_hz):
        raise UserError(f"--decimate must be a rate above 0 Hz, at most the recording's {recording.rate_hz:g} Hz")
    known = [name for name in model.axes if name in recording.columns and np.ptp(recording.columns[name].values) > 0.0]
    recording, change = evened(recording)
    recording, held_hz = thinned(recording, tuple(known))
    at = np.arange(recording.samples) + np.cumsum(recording.missing_before)
    at -= at[0]
    block = 1 if decimate is None else max(1, round(recording.rate_hz / decimate))
    n = (int(at[-1]) + 1) // block
    if n < LEAST:
        raise UserError(f"{recording.path}: too short: {n} samples at this rate, a diagnosis needs {LEAST} or more")
    if n > MOST:
        raise UserError(
            f"{recording.path}: {n:,} samples at this rate with the gaps, more than {MOST:,}: cut it at its gaps, or "
            "take a lower --decimate"
        )
    index = at // block
    kept = index < n
    used = np.bincount(index[kept], minlength=n)
    present = 2 * used >= block

    def averaged(values: Array) -> tuple[Array, Array]:
        """Means of the values that are there, NaN where fewer than half are, and samples a block over those used."""
        there = kept & np.isfinite(values)
        many = np.bincount(index[there], minlength=n)
        mean = np.bincount(index[there], values[there], minlength=n) / np.maximum(many, 1)
        enough = 2 * many >= block
        return np.where(enough, mean, np.nan), np.where(enough, block / np.maximum(many, 1), 1.0)

    def on_grid(values: Array) -> Array:
        return averaged(values)[0]

    def stated(name: str) -> tuple[Regressor, ...]:
        """The model file's regressors of an axis."""
        found: list[Regressor] = []
        for one in offered(model, name):
            values = columns_of((one,), recording)
            entry = {
                "column": one.column,
                "frequency_hz": one.frequency_hz,
                "time_s": one.time_s - recording.start_s,
            }
            for column, row in zip(one.columns, values.T, strict=True):
                about = bridged(on_grid(np.ascontiguousarray(row))) - one.reference
                found.append(Regressor(column, _cause(one, model), about, one.unit, entry))
        return tuple(found)

    states: dict[str, State] = {}
    read: dict[str, Readings] = {}
    unclipped: dict[str, Array] = {}
    for name in known:
        group = model.group_of(name)
        if _beyond(recording.in_unit(name, group.unit), group):
            continue
        rows = None if held_hz is not None else own_rows(recording, name)
        one = look(recording, name, group) if rows is not None else readings_of(recording, name, group)
        if held_hz is not None:
            one = replace(one, held_hz=held_hz)

        def spread(values: Array, rows: Rows | None = rows) -> Array:
            if rows is None:
                return values
            found = np.full(recording.samples, np.nan)
            found[rows] = values
            return found if block == 1 else _held_on(found)

        y, r = averaged(spread(one.values if block == 1 else one.drawn))
        if np.isfinite(y).sum() < LEAST:
            continue
        read[name] = one
        found = one.lattice
        level = float(np.nanmedian(y))
        if block == 1 and one.clipped is not None:
            unclipped[name] = averaged(spread(one.drawn))[0] - level
        states[name] = State(
            axis=name,
            unit=group.unit,
            y=y - level,
            dt=block / recording.rate_hz,
            level=level,
            r=r,
            regressors=stated(name),
            lsb=found.step if found is not None and block == 1 else 0.0,
            stated_lsb=group.lsb,
            redrawn=block > 1,
            below_lattice=found is not None and found.too_coarse,
        )
    channels: dict[str, Array] = {}
    names: dict[str, str] = {}
    for cause, (column, unit) in SIDE_CHANNELS.items():
        if column in recording.columns:
            values = recording.in_unit(column, unit)
            if np.ptp(values) > 0.0:
                channels[cause] = bridged(on_grid(values))
                names[cause] = column
    return Record(
        recording.rate_hz / block,
        states,
        channels,
        names,
        present,
        recording.lost,
        recording.rate_hz,
        read,
        change,
        unclipped,
        recording.start_s,
    )


def _held_on(values: Array) -> Array:
    """Each value until the next that is there."""
    there = np.flatnonzero(np.isfinite(values))
    return values[there[np.maximum(0, np.searchsorted(there, np.arange(values.size), side="right") - 1)]]


def why_left_out(recording: Recording, model: Model, name: str) -> str:
    """Why an axis that was asked for is not in the record."""
    group = model.group_of(name)
    if _beyond(recording.in_unit(name, group.unit), group):
        return f"readings beyond {BEYOND:g} times the range of {group.range:g} {group.unit}: is the unit right?"
    if np.ptp(recording.columns[name].values) > 0.0:
        return "too few of its readings are none that stick or are clipped"
    return "every reading is the same"


def _beyond(values: Array, group: Group) -> bool:
    most = BEYOND * group.range if group.range > 0.0 else math.inf
    return bool(np.max(np.abs(values)) >= min(most, _library32.SAMPLE_MAX))


def _cause(one: Stated, model: Model) -> str:
    """The cause that a regressor of the model file stands for."""
    if one.kind == "column" and one.column in model.axes:
        return "cross_axis"
    return {"time": "ramp", "column": _channel(one.column), "rate": "rate"}.get(one.kind, one.kind)


def _channel(column: str) -> str:
    return next((cause for cause, (name, _) in SIDE_CHANNELS.items() if name == column), "")


def bridged(values: Array) -> Array:
    """Missing values by straight lines."""
    good = np.isfinite(values)
    if good.all():
        return values
    where = np.arange(values.size)
    return np.interp(where, where[good], values[good])


def smoothed(values: Array, window: int) -> Array:
    """Centred mean over `window` samples. It has no lag: the size that it shows is the cause's own."""
    return values if window <= 1 else np.asarray(uniform_filter1d(values, window, mode="nearest"))
