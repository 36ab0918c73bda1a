"""The axes and side channels of a recording on a common even grid."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from selfcal import _library32
from selfcal.bank.blocks import MOST_DENSE
from selfcal.base.errors import UserError
from selfcal.base.grid import Array, Mask, Rows
from selfcal.likelihood.state import FittedColumn, State
from selfcal.logs.recording import SIDE_CHANNELS, Recording, bridged
from selfcal.logs.sampling import RateChange
from selfcal.logs.timebase import Clock
from selfcal.model.file import REGRESSORS, Group, Model
from selfcal.model.file import Regressor as Stated
from selfcal.model.forms import variance_of
from selfcal.model.regressors import columns_of, offered
from selfcal.readings.held import Held
from selfcal.readings.readings import Readings, copied, evened, look, mostly_beyond, own_rows, readings_of, thinned

#: Samples that a diagnosis needs at least.
FEWEST = 200
#: Largest reading over the sensor's range: beyond, the unit is wrong, or the file.
BEYOND = 100.0
#: Samples in a cell of the grid, on average, without which an axis is too slow for it.
SLOWEST = 0.99
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
    `redrawn` [n]: readings of an axis with those drawn anew that are clipped, or of uneven codes. `left_out`: why an
    axis of the model is not here. `roughness` [n] of each axis: variance of its noise by differences of the samples as
    recorded. `moving` [n]: the raw readings of an axis show that the sensor moved. `since_power_on_s`: of the
    recording. `apart` [n] of an axis: when its noise and that of others have another level than most of
    the time."""

    rate_hz: float
    axes: Mapping[str, State]
    channels: Mapping[str, Array]
    channel_names: Mapping[str, str]
    present: Mask
    missing: Mapping[str, Missing] = field(default_factory=dict)
    recorded_hz: float = 1.0
    readings: Mapping[str, Readings] = field(default_factory=dict)
    changes: tuple[RateChange, ...] = ()
    redrawn: Mapping[str, Array] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    start_s: float = 0.0
    roughness: Mapping[str, Array] = field(default_factory=dict)
    moving: Mask = field(default_factory=lambda: np.zeros(0, bool))
    since_power_on_s: float = 0.0
    apart: Mapping[str, Mask] = field(default_factory=dict)

    @property
    def time_s(self) -> Array:
        return np.arange(self.present.size) / self.rate_hz

    def other_axes(self, axis: str) -> dict[str, Array]:
        """The other axes about their level, bridged where missing or `apart`, less what the model lets this axis leak
        into them."""
        each = {name: self.calm(name, state.less_of(axis)) for name, state in self.axes.items() if name != axis}
        return {name: bridged(y) - float(np.nanmedian(y)) for name, y in each.items()}

    def calm(self, name: str, values: Array) -> Array:
        """Values [n] of an axis; NaN where it is `apart`."""
        return np.where(self.apart[name], np.nan, values) if name in self.apart else values

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


@dataclass(frozen=True)
class _Grid:
    """`n` cells of `dt` s, `block` samples of the clock `base` each, from its first sample on."""

    base: Clock
    block: int
    n: int

    @property
    def dt(self) -> float:
        return self.block / self.base.rate_hz

    def cell_of(self, clock: Clock) -> Rows:
        """The cell that each sample of a clock falls in."""
        base = self.base
        shift = (clock.start_s - base.start_s) * clock.rate_hz - float(base.place[0]) * clock.rate_hz / base.rate_hz
        # A clock of another rate or phase falls where it falls; the grid's own falls on whole numbers.
        cells: Rows = np.floor((clock.place + shift + 1e-6) / (clock.rate_hz * self.dt)).astype(np.int64)
        return cells

    def means(self, clock: Clock, values: Array) -> tuple[Array, Array]:
        """Means [n] of the values of a clock, NaN where half of a cell's samples are missing; samples of a cell over
        those that are there [n]."""
        expected, index = clock.rate_hz * self.dt, self.cell_of(clock)
        kept = (index >= 0) & (index < self.n) & np.isfinite(values)
        used = np.bincount(index[kept], minlength=self.n)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.bincount(index[kept], values[kept], minlength=self.n) / used
        present = 2 * used >= round(expected)
        return np.where(present, mean, np.nan), np.where(present, round(expected) / np.maximum(used, 1), 1.0)

    def missing(self, clock: Clock) -> Missing | None:
        """The samples that a clock lacks."""
        gaps = np.flatnonzero(clock.lost_before)
        if not gaps.size:
            return None
        ends = clock.time_s[gaps] - self.base.time_s[0]
        lost = int(clock.lost_before.sum())
        first = float(ends[0] - clock.missing_before[gaps[0]] / clock.rate_hz)
        return Missing(lost, clock.missing_before.size + lost, (max(0.0, first), float(ends[-1])))

    def motion(self) -> Mask:
        """The cells [n] with some samples in a gap of the base clock that motion alone makes."""
        base = self.base
        place = base.place - base.place[0]
        moved = np.zeros(self.n, bool)
        for row in np.flatnonzero((base.missing_before > 0) & (base.lost_before == 0)):
            moved[(place[row] - base.missing_before[row]) // self.block : (place[row] - 1) // self.block + 1] = True
        return moved


def _grid_of(recording: Recording, decimate: float | None, axes: Sequence[str]) -> _Grid:
    """The grid of a record. Raises UserError for a length that no diagnosis takes."""
    clocks = [recording.clock_of(name) for name in axes] if decimate is None else []
    base = min(clocks, key=lambda clock: clock.rate_hz, default=recording.clock)
    block = 1 if decimate is None else max(1, round(base.rate_hz / decimate))
    n = int(base.place[-1] - float(base.place[0]) + 1) // block
    if n < FEWEST:
        raise UserError(f"{recording.path}: too short: {n} samples at this rate, a diagnosis needs {FEWEST} or more")
    if n > MOST_DENSE:
        raise UserError(
            f"{recording.path}: {n:,} samples at this rate with the gaps, more than {MOST_DENSE:,}: "
            "cut it at its gaps, or take a lower --decimate"
        )
    return _Grid(base, block, n)


def record_from(recording: Recording, model: Model, decimate: float | None = None, axes: Sequence[str] = ()) -> Record:
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
    grid = _grid_of(recording, decimate, axes)
    kept: dict[str, _Axis] = {}
    left_out = {name: "every reading is the same" for name in model.axes if name not in known}
    for name in known:
        axis = _axis_of(recording, model, name, grid, held, tuple(kept))
        if isinstance(axis, str):
            left_out[name] = axis
        else:
            kept[name] = axis
    present = np.isfinite(grid.means(grid.base, np.zeros(grid.base.missing_before.size))[0])
    channels: dict[str, Array] = {}
    names: dict[str, str] = {}
    for cause, (column, unit) in SIDE_CHANNELS.items():
        if column in recording.columns:
            values = recording.in_unit(column, unit)
            if np.ptp(values) > 0.0 and not copied(recording, column, tuple(kept)):
                channels[cause] = bridged(grid.means(recording.clock, values)[0])
                names[cause] = column
    return Record(
        rate_hz=1.0 / grid.dt,
        axes={name: axis.state for name, axis in kept.items()},
        channels=channels,
        channel_names=names,
        present=present | grid.motion(),
        missing={name: lost for name in kept if (lost := grid.missing(recording.clock_of(name))) is not None},
        recorded_hz=grid.base.rate_hz,
        readings={name: axis.readings for name, axis in kept.items()},
        changes=changes,
        redrawn={name: axis.redrawn for name, axis in kept.items() if axis.redrawn is not None},
        left_out=left_out,
        start_s=recording.start_s,
        roughness={name: axis.roughness for name, axis in kept.items()},
        moving=np.any([np.zeros(grid.n, bool), *(axis.moving for axis in kept.values())], axis=0),
        since_power_on_s=recording.since_power_on_s,
    )


@dataclass(frozen=True)
class _Axis:
    """What a record has of an axis, as Record explains it."""

    state: State
    readings: Readings
    roughness: Array
    moving: Mask
    redrawn: Array | None


def _axis_of(
    recording: Recording, model: Model, name: str, grid: _Grid, held: Held | None, before: tuple[str, ...]
) -> _Axis | str:
    """An axis on the grid, or why it is not there. `before`: axes of which it may be a copy."""
    clock, group = recording.clock_of(name), model.group_of(name)
    each = round(clock.rate_hz * grid.dt)
    values = recording.in_unit(name, group.unit)
    slow = clock.rate_hz * grid.dt < SLOWEST
    own = f"{clock.rate_hz:g}"
    late = f"its samples come at {own} Hz: give --decimate {own} or less, or --axis {name} alone" if slow else ""
    if why := _beyond(values, group) or late or copied(recording, name, before):
        return why
    recorded = clock
    whole = recording.columns[name].clock is None and bool(np.isfinite(values).all())
    rows = own_rows(recording, name) if whole and held is None else None
    if rows is not None:
        readings = look(recording, name, group)
    else:
        readings = readings_of(recording if whole else recording.along(name), name, group)
        if not whole:
            clock = replace(readings.recording.clock, start_s=clock.start_s)
    if held is not None and recording.columns[name].clock is None:
        readings = replace(readings, held=held)

    def spread(values: Array) -> Array:
        if rows is None:
            return values
        found = np.full(recording.samples, np.nan)
        found[rows] = values
        if each == 1:
            return found
        there = np.flatnonzero(np.isfinite(found))  # each value until the next that is there
        return found[there[np.maximum(0, np.searchsorted(there, np.arange(found.size), side="right") - 1)]]

    y, r = grid.means(clock, spread(readings.values if each == 1 else readings.drawn))
    if (usable := int(np.isfinite(y).sum())) < FEWEST:
        return f"{usable} of its readings neither stick nor are clipped, a diagnosis needs {FEWEST} or more"
    moving = np.zeros(grid.n, bool)
    if readings.moving.any():
        # A mean of which a sample moved is left out: the next samples may ring on below what is loud.
        cells = grid.cell_of(clock)[spread(readings.moving.astype(np.float64)) > 0.0]
        moving[cells[(cells >= 0) & (cells < grid.n)]] = True
    lattice = readings.lattice
    level = float(np.nanmedian(y))
    alone = recording.along(name)
    rough = variance_of(alone.in_unit(name, group.unit), alone.missing_before)
    anew = None if readings.uneven is None else readings.uneven.undone
    anew = anew if readings.clipped is None else readings.drawn
    state = State(
        axis=name,
        unit=group.unit,
        y=y - level,
        dt=grid.dt,
        level=level,
        r=r,
        regressors=_stated(recording, model, name, grid),
        lsb=lattice.step if lattice is not None and each == 1 else 0.0,
        stated_lsb=group.lsb,
        redrawn=each > 1,
        block=each,
        below_lattice=lattice is not None and lattice.too_coarse_over(grid.dt),
    )
    return _Axis(
        state=state,
        readings=readings,
        roughness=grid.means(replace(alone.clock, start_s=recorded.start_s), rough)[0],
        moving=moving,
        redrawn=None if anew is None or each > 1 else grid.means(clock, spread(anew))[0] - level,
    )


def _stated(recording: Recording, model: Model, name: str, grid: _Grid) -> tuple[FittedColumn, ...]:
    """The model file's regressors of an axis."""
    stated: list[FittedColumn] = []
    own = recording.along(name) if offered(model, name) else recording
    for regressor in offered(model, name):
        values = columns_of((regressor,), own)
        # The loop's own columns have a unit beside these: those alone may give way to a better form.
        keys = ("kind", *REGRESSORS[regressor.kind])
        entry = {key: getattr(regressor, key) for key in keys if key != "unit"}
        entry |= {key: entry[key] - recording.start_s for key in TIMES if key in entry}
        for column, row in zip(regressor.columns, values.T, strict=True):
            # At half the rate a line's sine is rounding of the frequency.
            if regressor.kind == "periodic" and np.abs(row).max() < 0.01:
                continue
            about = bridged(grid.means(own.clock, np.ascontiguousarray(row))[0]) - regressor.offset
            stated.append(FittedColumn(column, _cause(regressor, model), about, regressor.unit, entry))
    return tuple(stated)


def is_counter(record: Record, name: str) -> bool:
    """Whether the readings are increments of a counter."""
    readings = record.readings.get(name)
    return readings is not None and readings.lattice is not None and readings.lattice.carried > 0.0


def _varies(values: Array) -> bool:
    """Whether the values that are there differ."""
    there = values[np.isfinite(values)]
    return bool(there.size and np.ptp(there) > 0.0)


def _beyond(values: Array, group: Group) -> str:
    """Complaint about readings [n] that lie so far beyond the range that no reading counts. Empty elsewhere."""
    most = BEYOND * group.range if group.range > 0.0 else math.inf
    if np.max(np.abs(values[np.isfinite(values)])) >= min(most, _library32.SAMPLE_MAX):
        return f"readings beyond {BEYOND:g} times the range of {group.range:g} {group.unit}: is the unit right?"
    return mostly_beyond(values, group)


def _cause(regressor: Stated, model: Model) -> str:
    """The cause that a regressor of the model file stands for."""
    if regressor.kind not in ("column", "rate"):
        return {"time": "ramp"}.get(regressor.kind, regressor.kind)
    if regressor.column in model.axes:
        return "vibration" if regressor.input == "variance" else "cross_axis"
    return next((cause for cause, (name, _) in SIDE_CHANNELS.items() if name == regressor.column), "")


def smoothed(values: Array, window: int) -> Array:
    """Centred mean over `window` samples. It has no lag: the size that it shows is the cause's own."""
    return values if window <= 1 else np.asarray(uniform_filter1d(values, window, mode="nearest"))
