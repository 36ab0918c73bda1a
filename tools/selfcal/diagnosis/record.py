"""From a recording to the axes and side channels on one even grid."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from selfcal import _library32
from selfcal.base.errors import UserError
from selfcal.base.grid import Rows
from selfcal.likelihood.state import Regressor, State
from selfcal.likelihood.statemodel import Array, Mask
from selfcal.logs.recording import SIDE_CHANNELS, Recording, bridged
from selfcal.logs.timebase import Clock
from selfcal.model.file import REGRESSORS, Group, Model
from selfcal.model.file import Regressor as Stated
from selfcal.model.forms import variance_of
from selfcal.model.regressors import columns_of, offered
from selfcal.readings.readings import (
    RateChange,
    Readings,
    copied,
    evened,
    look,
    mostly_beyond,
    own_rows,
    readings_of,
    thinned,
)

#: Samples that a diagnosis needs at least, and takes at most, gaps included.
LEAST, MOST = 200, 10_000_000
#: Readings so many times beyond the sensor's range are no readings: the unit is wrong, or the file.
BEYOND = 100.0
#: Samples in a cell of the grid, on average, without which an axis is too slow for it.
SLOWEST = 0.99
#: A stated line whose sine stays below this is at half the rate, where the sine is rounding of the frequency.
ROUNDED_SINE = 0.01
#: Keys of a regressor that are times of the recording.
TIMES = ("time_s", "start_s", "end_s")


@dataclass(frozen=True)
class Missing:
    """Samples of an axis that were never measured: how many, `of` how many, and the first and last such time, s."""

    samples: int
    of: int
    when: tuple[float, float]


@dataclass(frozen=True)
class Record:
    """All axes of a recording on its grid of n instants. `channels`: temperature and supply where they were recorded,
    [n] in degC and V, bridged where samples are missing; `channel_names` their columns. `present` [n]: where the grid
    has samples, those left out for motion among them. `missing`: by axis, at its own rate. `recorded_hz`: the rate of
    the recording. `start_s`: where in the recording the grid begins, s; every time here counts from it.
    `roughness` [n] of each axis: variance of its noise by differences of the samples as recorded. `moving` [n]: the raw
    readings of an axis show that the sensor moved. `since_power_on_s`: of the recording."""

    rate_hz: float
    axes: Mapping[str, State]
    channels: Mapping[str, Array]
    channel_names: Mapping[str, str]
    present: Mask
    missing: Mapping[str, Missing] = field(default_factory=dict)
    recorded_hz: float = 1.0
    readings: Mapping[str, Readings] = field(default_factory=dict)
    changes: tuple[RateChange, ...] = ()
    unclipped: Mapping[str, Array] = field(default_factory=dict)
    alike: Mapping[str, Array] = field(default_factory=dict)
    start_s: float = 0.0
    roughness: Mapping[str, Array] = field(default_factory=dict)
    moving: Mask = field(default_factory=lambda: np.zeros(0, bool))
    since_power_on_s: float = 0.0

    @property
    def time_s(self) -> Array:
        return np.arange(self.present.size) / self.rate_hz

    def other_axes(self, axis: str) -> dict[str, Array]:
        """The other axes about their level, bridged where missing."""
        return {name: bridged(one.y) - float(np.nanmedian(one.y)) for name, one in self.axes.items() if name != axis}

    def variances(self, axis: str) -> dict[str, Array]:
        """Short-term variance of the other axes that have any, bridged where an axis is missing or left out."""
        known = {
            name: np.where(np.isfinite(self.axes[name].y), values, np.nan)
            for name, values in self.roughness.items()
            if name != axis and name in self.axes
        }
        return {
            name: bridged(values)
            for name, values in known.items()
            if np.isfinite(values).sum() > 1 and np.nansum(values) > 0.0
        }

    def channel_of(self, column: str, by: str = "value") -> Array:
        """The values of a side channel or another axis, or its variance."""
        if by == "variance":
            return self.variances("")[column]
        causes = {name: cause for cause, name in self.channel_names.items()}
        return self.channels[causes[column]] if column in causes else self.other_axes("")[column]


def of_recording(recording: Recording, model: Model, decimate: float | None = None, axes: Sequence[str] = ()) -> Record:
    """Every sensor column that the model knows, in the unit of each axis' group, and the side channels. What the model
    file states is in the model of each axis from the start. Stuck readings are left out. Where every axis holds its
    readings the record has the part's own rate; where some do, the repeats of those are left out.

    `decimate`, Hz: means of whole blocks at the rate nearest to it; a block of which half is missing is missing.
    Without it the grid is that of the slowest of `axes`; an axis slower than the grid is left out.
    """
    if decimate is not None and not (math.isfinite(decimate) and 0.0 < decimate <= recording.rate_hz):
        raise UserError(f"--decimate must be a rate above 0 Hz, at most the recording's {recording.rate_hz:g} Hz")
    model = replace(model, regressors=(*model.regressors, *model.beyond))
    known = [name for name in model.axes if name in recording.columns and _varies(recording.columns[name].values)]
    recording, changes = evened(recording)
    recording, held = thinned(recording, tuple(name for name in known if recording.columns[name].clock is None))
    clocks = [recording.clock_of(name) for name in axes] if decimate is None else []
    base = min(clocks, key=lambda clock: clock.rate_hz, default=recording.clock)
    block = 1 if decimate is None else max(1, round(base.rate_hz / decimate))
    dt = block / base.rate_hz
    begin = float(base.place[0])
    n = int(base.place[-1] - begin + 1) // block
    if n < LEAST:
        raise UserError(f"{recording.path}: too short: {n} samples at this rate, a diagnosis needs {LEAST} or more")
    if n > MOST:
        raise UserError(
            f"{recording.path}: {n:,} samples at this rate with the gaps, more than {MOST:,}: cut it at its gaps, or "
            "take a lower --decimate"
        )

    def cell_of(clock: Clock) -> Rows:
        """The cell of the grid that each sample of a clock falls in."""
        shift = (clock.start_s - base.start_s) * clock.rate_hz - begin * clock.rate_hz / base.rate_hz
        # A clock of another rate or phase falls where it falls; the grid's own falls on whole numbers.
        found: Rows = np.floor((clock.place + shift + 1e-6) / (clock.rate_hz * dt)).astype(np.int64)
        return found

    def on_grid(clock: Clock, values: Array) -> tuple[Array, Array]:
        """Means [n] of the values of a clock, NaN where half of a cell's samples are missing; samples of a cell over
        those that are there [n]."""
        expected, index = clock.rate_hz * dt, cell_of(clock)
        kept = (index >= 0) & (index < n) & np.isfinite(values)
        used = np.bincount(index[kept], minlength=n)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.bincount(index[kept], values[kept], minlength=n) / used
        present = 2 * used >= round(expected)
        return np.where(present, mean, np.nan), np.where(present, round(expected) / np.maximum(used, 1), 1.0)

    def stated(name: str) -> tuple[Regressor, ...]:
        """The model file's regressors of an axis."""
        found: list[Regressor] = []
        own = recording.along(name) if offered(model, name) else recording
        for one in offered(model, name):
            values = columns_of((one,), own)
            # The loop's own columns have a unit beside these: those alone may give way to a better form.
            entry = {key: getattr(one, key) for key in ("kind", *REGRESSORS[one.kind]) if key != "unit"}
            entry |= {key: entry[key] - recording.start_s for key in TIMES if key in entry}
            for column, row in zip(one.columns, values.T, strict=True):
                if one.kind == "periodic" and np.abs(row).max() < ROUNDED_SINE:
                    continue
                about = bridged(on_grid(own.clock, np.ascontiguousarray(row))[0]) - one.offset
                found.append(Regressor(column, _cause(one, model), about, one.unit, entry))
        return tuple(found)

    def missing(clock: Clock) -> Missing | None:
        """The samples that a clock lacks."""
        gaps = np.flatnonzero(clock.lost_before)
        if not gaps.size:
            return None
        ends = clock.time_s[gaps] - base.time_s[0]
        lost = int(clock.lost_before.sum())
        first = float(ends[0] - clock.missing_before[gaps[0]] / clock.rate_hz)
        return Missing(lost, clock.missing_before.size + lost, (max(0.0, first), float(ends[-1])))

    states: dict[str, State] = {}
    gone: dict[str, Missing] = {}
    read: dict[str, Readings] = {}
    unclipped: dict[str, Array] = {}
    alike: dict[str, Array] = {}
    roughness: dict[str, Array] = {}
    moving = np.zeros(n, bool)
    for name in known:
        clock, group = recording.clock_of(name), model.group_of(name)
        values = recording.in_unit(name, group.unit)
        if _beyond(values, group) or clock.rate_hz * dt < SLOWEST:
            continue
        if copied(recording, name, tuple(states)):
            continue
        whole = recording.columns[name].clock is None and bool(np.isfinite(values).all())
        rows = own_rows(recording, name) if whole and held is None else None
        if rows is not None:
            one = look(recording, name, group)
        else:
            one = readings_of(recording if whole else recording.along(name), name, group)
            if not whole:
                rows, clock = None, replace(one.recording.clock, start_s=clock.start_s)
        if held is not None and recording.columns[name].clock is None:
            one = replace(one, held=held)
        each = round(clock.rate_hz * dt)

        def spread(values: Array, rows: Rows | None = rows, each: int = each) -> Array:
            if rows is None:
                return values
            found = np.full(recording.samples, np.nan)
            found[rows] = values
            return found if each == 1 else _held_on(found)

        y, r = on_grid(clock, spread(one.values if each == 1 else one.drawn))
        if np.isfinite(y).sum() < LEAST:
            continue
        read[name] = one
        lost = missing(recording.clock_of(name))
        if lost is not None:
            gone[name] = lost
        if one.moving.any():
            # A mean of which one sample moved is left out: the next ones may ring on below what is loud.
            cells = cell_of(clock)[spread(one.moving.astype(np.float64)) > 0.0]
            moving[cells[(cells >= 0) & (cells < n)]] = True
        found = one.lattice
        level = float(np.nanmedian(y))
        alone = recording.along(name)
        rough = variance_of(alone.in_unit(name, group.unit), alone.missing_before)
        roughness[name] = on_grid(replace(alone.clock, start_s=recording.clock_of(name).start_s), rough)[0]
        if each == 1 and one.clipped is not None:
            unclipped[name] = on_grid(clock, spread(one.drawn))[0] - level
        elif each == 1 and one.uneven is not None:
            alike[name] = on_grid(clock, spread(one.uneven.drawn))[0] - level
        states[name] = State(
            axis=name,
            unit=group.unit,
            y=y - level,
            dt=dt,
            level=level,
            r=r,
            regressors=stated(name),
            lsb=found.step if found is not None and each == 1 else 0.0,
            stated_lsb=group.lsb,
            redrawn=each > 1,
            block=each,
            below_lattice=found is not None and found.too_coarse_over(dt),
        )
    present = np.isfinite(on_grid(base, np.zeros(base.missing_before.size))[0])
    channels: dict[str, Array] = {}
    names: dict[str, str] = {}
    for cause, (column, unit) in SIDE_CHANNELS.items():
        if column in recording.columns:
            values = recording.in_unit(column, unit)
            if np.ptp(values) > 0.0 and not copied(recording, column, tuple(states)):
                channels[cause] = bridged(on_grid(recording.clock, values)[0])
                names[cause] = column
    return Record(
        1.0 / dt,
        states,
        channels,
        names,
        present | _all_motion(base, n, block),
        gone,
        base.rate_hz,
        read,
        changes,
        unclipped,
        alike,
        recording.start_s,
        roughness,
        moving,
        recording.since_power_on_s,
    )


def _all_motion(clock: Clock, n: int, block: int) -> Mask:
    """The cells of `block` samples [n] with some in a gap of a clock that motion alone makes."""
    place = clock.place - clock.place[0]
    found = np.zeros(n, bool)
    for row in np.flatnonzero((clock.missing_before > 0) & (clock.lost_before == 0)):
        found[(place[row] - clock.missing_before[row]) // block : (place[row] - 1) // block + 1] = True
    return found


def _held_on(values: Array) -> Array:
    """Each value until the next that is there."""
    there = np.flatnonzero(np.isfinite(values))
    return values[there[np.maximum(0, np.searchsorted(there, np.arange(values.size), side="right") - 1)]]


def carried(record: Record, name: str) -> bool:
    """Whether the readings are increments of a counter."""
    readings = record.readings.get(name)
    return readings is not None and readings.lattice is not None and readings.lattice.carried > 0.0


def why_left_out(recording: Recording, model: Model, name: str) -> str:
    """Why an axis that was asked for is not in the record."""
    group = model.group_of(name)
    values = recording.in_unit(name, group.unit)
    if told := _beyond(values, group):
        return told
    own = recording.clock_of(name).rate_hz
    if own < SLOWEST * recording.rate_hz:
        return f"its samples come at {own:g} Hz: give --decimate {own:g} or less, or --axis {name} alone"
    if told := copied(recording, name, [one for one in model.axes if one in recording.columns and one != name]):
        return told
    if _varies(values):
        return "too few of its readings are none that stick or are clipped"
    return "every reading is the same"


def _varies(values: Array) -> bool:
    """Whether not all values that are there are one."""
    there = values[np.isfinite(values)]
    return bool(there.size and np.ptp(there) > 0.0)


def _beyond(values: Array, group: Group) -> str:
    """What to say where readings [n] lie so far beyond the range that none counts. Empty elsewhere."""
    most = BEYOND * group.range if group.range > 0.0 else math.inf
    if np.max(np.abs(values[np.isfinite(values)])) >= min(most, _library32.SAMPLE_MAX):
        return f"readings beyond {BEYOND:g} times the range of {group.range:g} {group.unit}: is the unit right?"
    return mostly_beyond(values, group)


def _cause(one: Stated, model: Model) -> str:
    """The cause that a regressor of the model file stands for."""
    if one.kind not in ("column", "rate"):
        return {"time": "ramp"}.get(one.kind, one.kind)
    if one.column in model.axes:
        return "vibration" if one.input == "variance" else "cross_axis"
    return _channel(one.column)


def _channel(column: str) -> str:
    return next((cause for cause, (name, _) in SIDE_CHANNELS.items() if name == column), "")


def smoothed(values: Array, window: int) -> Array:
    """Centred mean over `window` samples. It has no lag: the size that it shows is the cause's own."""
    return values if window <= 1 else np.asarray(uniform_filter1d(values, window, mode="nearest"))
