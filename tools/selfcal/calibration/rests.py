"""Rests and turns of recordings: means in m/s^2 and rad/s with their times, and the samples between two rests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError
from selfcal.base.grid import block_means, runs
from selfcal.base.units import factor
from selfcal.calibration.noise import LONG_S, Noise, measured, of_model, of_rest, rounding
from selfcal.logs.recording import Recording
from selfcal.model.file import Model
from selfcal.readings.lattice import step_of
from selfcal.readings.rest import PIECE_S, rest_of

Array = NDArray[np.float64]

ACCEL, GYRO = ("ax", "ay", "az"), ("gx", "gy", "gz")
UNITS = {**dict.fromkeys(ACCEL, "m/s^2"), **dict.fromkeys(GYRO, "rad/s")}
#: Seconds that are cut off a rest beside a motion: its first and last movement is below the noise of a piece.
SETTLE_S = PIECE_S
#: Shortest rest, s, and rests at most: the fit is dense.
LEAST_S, MOST = 2.0, 200
#: Readings at the extreme in a row that a turn clips at, and steps of the lattice to the readings beside them at least.
FLAT, STEEP = 3, 3.0
#: Assumed time between two logs without stamps of one clock, s.
BETWEEN_S = 60.0


@dataclass(frozen=True)
class Rest:
    """A rest: `log` and its time in it, s, its `begin_s` and `end_s` on the clock of all logs, `seconds` of readings
    in it; means `accel` [3], m/s^2, and `gyro` [3], rad/s, NaN without gyros; `temp`, degC, or NaN; `rounded` [6]:
    variance of the means by a lattice that the noise does not dither; `moved` [3]: difference of its halves, m/s^2."""

    log: int
    at_s: tuple[float, float]
    begin_s: float
    end_s: float
    seconds: float
    accel: Array
    gyro: Array
    temp: float
    rounded: Array
    moved: Array


@dataclass(frozen=True)
class Turn:
    """Samples between the rests `first` and the one behind it: `accel` [n, 3], m/s^2, and `gyro` [n, 3], rad/s, each
    `dt` s. `reason`: why the turn is left out, or ""."""

    first: int
    dt: float
    accel: Array
    gyro: Array
    temp: float
    reason: str = ""


@dataclass(frozen=True)
class Tumble:
    """All that the logs hold: `noise` by axis; `left_out`: rests that do not count, a line each."""

    rests: tuple[Rest, ...]
    turns: tuple[Turn, ...]
    noise: dict[str, Noise]
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def has_gyro(self) -> bool:
        """The logs have three gyros."""
        return GYRO[0] in self.noise

    def with_drift(self, names: Sequence[str], share: float) -> Tumble:
        """With this share of the wide drift of axes."""
        return replace(self, noise={**self.noise, **{name: self.noise[name].scaled(share) for name in names}})

    @property
    def begin_s(self) -> Array:
        """[n], s."""
        return np.array([one.begin_s for one in self.rests])

    @property
    def end_s(self) -> Array:
        """[n], s."""
        return np.array([one.end_s for one in self.rests])


@dataclass(frozen=True)
class _Log:
    """A log on the clock of its fastest axes: its columns in the units used here, the step of the lattice of each (0:
    none), its temperature, degC, NaN without one, and the rows of its rests."""

    recording: Recording
    begin_s: float
    own: dict[str, Array]
    steps: dict[str, float]
    temp: Array
    rests: tuple[slice, ...]

    def seconds(self, rows: slice) -> float:
        """Seconds of readings in rows."""
        return float(rows.stop - rows.start) / self.recording.rate_hz


def tumble_of(recordings: Sequence[Recording], model: Model, *, part_stated: bool) -> Tumble:
    """Rests and turns of logs in order of time. `part_stated`: the model is the part's own, and so is its range.
    Raises UserError where accelerometers are missing, or too many rests are there."""
    gyros = all(name in one.columns for one in recordings for name in GYRO)
    axes = ACCEL + GYRO if gyros else ACCEL
    begins, notes = _begins(recordings)
    logs = [_log(one, begin_s, axes) for one, begin_s in zip(recordings, begins, strict=True)]
    if sum(len(one.rests) for one in logs) > MOST:
        raise UserError(f"more than {MOST} rests: choose a stretch with --start and --end")
    ranges = {name: _range(model, name) if part_stated else math.inf for name in axes}
    typical = {
        name: _median([float(np.nanstd(log.own[name][rows])) for log in logs for rows in log.rests]) for name in axes
    }
    rests: list[Rest] = []
    turns: list[Turn] = []
    left_out: list[str] = []
    for k, log in enumerate(logs):
        end = -1  # the row behind the rest before, if that one counts
        for rows in log.rests:
            rest = _rest(k, log, rows)
            if reason := _clipped_at_rest(log, rows, ranges, typical):
                where = f"{recordings[k].path}, " if len(logs) > 1 else ""
                left_out.append(f"rest of {where}{rest.at_s[0]:.6g} to {rest.at_s[1]:.6g} s: {reason}")
                end = -1
                continue
            if gyros and end >= 0:
                turns.append(_turn(log, end, rows.start, len(rests) - 1, ranges))
            rests.append(rest)
            end = rows.stop
    long_rest = None if part_stated else _long_rest(logs)
    noise = {name: _noise(logs, name, model, long_rest) for name in axes}
    return Tumble(tuple(rests), tuple(turns), noise, tuple(left_out), tuple(notes))


def _log(whole: Recording, begin_s: float, axes: tuple[str, ...]) -> _Log:
    """A log and its rests."""
    for name in ACCEL:
        if name not in whole.columns:
            there = ", ".join(whole.columns)
            raise UserError(f"{whole.path}: there is no column '{name}' (there are {there}): tumble takes ax, ay, az")
    kinds = [names for names in (ACCEL, GYRO) if names[0] in axes]
    recording = whole.along(*max(kinds, key=lambda names: whole.clock_of(names[0]).rate_hz))
    own = {name: recording.in_unit(name, UNITS[name]) for name in axes}
    steps = {name: step_of(values[np.isfinite(values)])[0] for name, values in own.items()}
    has_temp = "temp" in recording.columns
    temp = recording.in_unit("temp", "degC") if has_temp else np.full(recording.samples, math.nan)
    found = rest_of(recording, axes)
    time = recording.time_s + recording.start_s
    still = found.still or ((float(time[0]), float(time[-1])),)
    rests = []
    for begin_rest, end_rest in still:
        begin = begin_rest + SETTLE_S * (begin_rest > time[0])
        end = end_rest - SETTLE_S * any(abs(a - end_rest) < 0.5 / recording.rate_hz for a, _ in found.moved)
        first, behind = (int(k) for k in np.searchsorted(time, [begin, end]))
        if end - begin >= LEAST_S and behind - first > 2:
            rests.append(slice(first, behind))
    return _Log(recording, begin_s, own, steps, temp, tuple(rests))


def _long_rest(logs: Sequence[_Log]) -> Recording | None:
    """The longest rest, if it identifies the law of the part."""
    long = [(log, rows) for log in logs for rows in log.rests if log.seconds(rows) >= LONG_S]
    if not long:
        return None
    log, rows = max(long, key=lambda one: one[0].seconds(one[1]))
    kept = np.zeros(log.recording.samples, bool)
    kept[rows] = True
    return log.recording.with_rows(kept)


def _noise(logs: Sequence[_Log], name: str, model: Model, long_rest: Recording | None) -> Noise:
    """White noise and drift of an axis: of a long rest, or of the model about the noise that the rests show. A model of
    the part itself needs no long rest."""
    if long_rest is not None and (found := of_rest(long_rest, name, model, UNITS[name])) is not None:
        return found
    pieces = []
    for log in logs:
        size = max(1, round(PIECE_S * log.recording.rate_hz))
        pieces += [block_means(log.own[name][rows], size) for rows in log.rests]
    white = measured(pieces, PIECE_S)
    return of_model(model, name, UNITS[name], None if white is None else math.sqrt(white))


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else 0.0


def _begins(recordings: Sequence[Recording]) -> tuple[list[float], list[str]]:
    """When each log begins on one clock, s, and what is assumed of it."""
    if len(recordings) == 1:
        return [0.0], []
    stamps = [one.started_s for one in recordings]
    if all(one is not None for one in stamps):
        known = [float(one) for one in stamps if one is not None]
        ends = [begin + one.duration_s for begin, one in zip(known, recordings, strict=True)]
        if all(end <= begin for end, begin in zip(ends, known[1:], strict=False)):
            return [one - known[0] for one in known], []
    lengths = [one.duration_s + BETWEEN_S for one in recordings]
    note = f"the logs have no stamps of one clock: taken in the order given, {BETWEEN_S:g} s apart"
    return [float(one) for one in np.cumsum([0.0, *lengths[:-1]])], [note]


def _range(model: Model, name: str) -> float:
    """Range of an axis, in the unit used here."""
    group = model.group_of(name)
    return group.range * factor(group.unit, UNITS[name]) if group.range > 0.0 else math.inf


def _rest(number: int, log: _Log, rows: slice) -> Rest:
    """The means of rows of a log."""
    recording, own = log.recording, log.own
    time = recording.time_s
    half = (rows.start + rows.stop) // 2

    def means(names: tuple[str, ...], part: slice) -> Array:
        return np.array([np.nanmean(own[name][part]) if name in own else math.nan for name in names])

    rounded = []
    for name in ACCEL + GYRO:
        step = log.steps.get(name, 0.0)
        scatter = float(np.nanvar(own[name][rows])) if name in own else 0.0
        rounded.append(rounding(step, math.sqrt(max(scatter - step**2 / 12.0, 0.0))))
    begin, end = float(time[rows.start]), float(time[rows.stop - 1]) + 1.0 / recording.rate_hz
    return Rest(
        number,
        (begin + recording.start_s, end + recording.start_s),
        log.begin_s + begin,
        log.begin_s + end,
        log.seconds(rows),
        means(ACCEL, rows),
        means(GYRO, rows),
        float(np.mean(log.temp[rows])),
        np.array(rounded),
        means(ACCEL, slice(half, rows.stop)) - means(ACCEL, slice(rows.start, half)),
    )


def _clipped_at_rest(log: _Log, rows: slice, ranges: dict[str, float], typical: dict[str, float]) -> str:
    """Why a rest does not count: an axis at its range, or without the scatter that it has in the other rests."""
    for name in ACCEL:
        part = log.own[name][rows]
        stuck = typical[name] > 0.5 * log.steps[name] and not np.nanstd(part) > 0.0
        if stuck or abs(float(np.nanmean(part))) >= ranges[name]:
            return f"{name} is clipped at {part[0]:.6g} m/s^2"
    return ""


def _turn(log: _Log, begin: int, end: int, rest: int, ranges: dict[str, float]) -> Turn:
    """Samples from the last one of a rest to the first one of the next."""
    recording, own = log.recording, log.own
    rows = slice(begin - 1, end + 1)
    reason = "samples are missing in it" if recording.missing_before[begin : end + 1].any() else ""
    for name in ACCEL + GYRO:
        part = own[name][rows]
        if not np.isfinite(part).all():
            reason = reason or f"samples of {name} are missing in it"
        elif np.abs(part).max() >= ranges[name] or _flat(part, own[name], log.steps[name]):
            reason = reason or f"{name} clips in it"
    accel, gyro = (np.column_stack([own[name][rows] for name in names]) for names in (ACCEL, GYRO))
    return Turn(rest, 1.0 / recording.rate_hz, accel, gyro, float(np.mean(log.temp[rows])), reason)


def _flat(part: Array, values: Array, step: float) -> bool:
    """Whether readings of a turn [n] stop at the record's extreme: equal there, and the readings beside far off."""
    for extreme in (float(np.nanmax(values)), float(np.nanmin(values))):
        for first, behind in runs(part == extreme):
            beside = part[[max(first - 1, 0), min(behind, part.size - 1)]]
            if behind - first >= FLAT and np.abs(beside - extreme).min() > STEEP * step:
                return True
    return False
