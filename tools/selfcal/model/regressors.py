"""Regressors: their values along a recording, as the firmware's application gives them to `selfcal_push_with()`, and
what follows from the evidence of every subset of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.logs.recording import Recording, as_float, bridged
from selfcal.model.file import Model, Regressor
from selfcal.model.forms import KIND, Source, curved, delayed, made, played, source_of, variance_of

#: Columns of a kind of regressor without a channel: names in C, and the entries with their numbers.
_SHAPES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "time": (("TIME",), ()),
    "step": (("STEP",), ("time_s",)),
    "turn_on": (("TURN_ON",), ("tau_s",)),
    "pulse": (("PULSE",), ("start_s", "end_s")),
    "periodic": (("SINE", "COSINE"), ("frequency_hz",)),
}
#: A subset of the regressors.
Choice = tuple[Regressor, ...]


def columns_of(regressors: Sequence[Regressor], recording: Recording) -> Array:
    """[n, p]: every column of `regressors`, in the unit of each, at every row of the recording, as float32 holds it.

    The library forms them (`selfcal_form()`), as it does on a module. A play, a delay and a curve, which it lacks, are
    made of its means. Time counts from the first row, s; a step and a pulse have the clock of the recording that the
    rows were cut from, a turn-on counts from power-on. A column with a `window_s` is the mean over that time up to each
    row. A step is 1 from its time on, a pulse 1 from its start until its end. A rate (the kind) is the channel's gain
    over the last `window_s`, in the first window its gain since the first row, over `window_s`. Raises UserError for a
    column that is absent or of another kind.
    """
    if not regressors:
        return np.empty((recording.samples, 0))
    check_channels(regressors, recording)
    channels = channels_of(regressors)
    regressors = from_time(regressors, recording.start_s)
    missing = np.ascontiguousarray(recording.missing_before, np.uint64)
    values = [
        bridged(variance_of(recording.in_unit(name, unit), missing))
        if by == "variance"
        else recording.in_unit(name, unit)
        for name, unit, by in channels
    ]
    rows = np.column_stack([as_float(row) for row in values]) if values else np.empty((recording.samples, 0))
    sources = [source for regressor in regressors for source in column_sources(regressor, channels)]
    columns = made(sources, 1.0 / recording.rate_hz, rows, missing, recording.powered)
    first = 0
    for regressor in regressors:
        if regressor.form == "play":
            columns[:, first] = as_float(played(columns[:, first], regressor.width))
        elif regressor.form == "delay":
            samples = regressor.delay_s * recording.rate_hz
            columns[:, first] = as_float(delayed(columns[:, first], samples, missing))
        elif regressor.form == "free":
            columns[:, first] = as_float(curved(columns[:, first], regressor.knots))
        first += len(regressor.columns)
    return columns


def from_time(regressors: Sequence[Regressor], start_s: float) -> tuple[Regressor, ...]:
    """The regressors for a clock that begins at `start_s` of the clock of their times."""

    def moved(regressor: Regressor) -> Regressor:
        if regressor.kind == "step":
            return replace(regressor, time_s=max(0.0, regressor.time_s - start_s))
        if regressor.kind == "pulse":
            begin_s, end_s = max(0.0, regressor.start_s - start_s), max(1e-6, regressor.end_s - start_s)
            return replace(regressor, start_s=begin_s, end_s=end_s)
        return regressor

    return tuple(moved(regressor) for regressor in regressors)


def check_channels(regressors: Sequence[Regressor], recording: Recording) -> None:
    """Raise UserError for a channel of the regressors that the recording has not."""
    for name, *_ in channels_of(regressors):
        if name not in recording.columns:
            needs = next(regressor.name for regressor in regressors if regressor.column == name)
            raise UserError(
                f"{recording.path}: there is no column '{name}', which the model's regressor '{needs}' needs "
                f"(there are {', '.join(recording.columns)})"
            )


def channels_of(regressors: Sequence[Regressor]) -> list[tuple[str, str, str]]:
    """Name, unit and input of every recorded channel that the regressors take, each once."""
    recorded = [regressor for kind in ("column", "rate") for regressor in regressors if regressor.kind == kind]
    return list(dict.fromkeys(map(_channel, recorded)))


def _channel(regressor: Regressor) -> tuple[str, str, str]:
    return regressor.column, regressor.channel_unit, regressor.input


def column_sources(regressor: Regressor, channels: Sequence[tuple[str, str, str]]) -> list[Source]:
    """`selfcal_source_t` of each column of a regressor."""
    if regressor.kind in _SHAPES:
        names, keys = _SHAPES[regressor.kind]
        number, second = (*(getattr(regressor, key) for key in keys), 0.0, 0.0)[:2]
        return [(KIND[name], 0, number, second) for name in names]
    channel = channels.index(_channel(regressor))
    if regressor.kind == "rate":
        return [(KIND["RATE"], channel, regressor.window_s, 0.0)]
    return [source_of(regressor.form, channel, regressor.number, regressor.reference, regressor.mean_s)]


def trailing_mean(values: Array, window: int) -> Array:
    """float64[n]: mean of the last `window` values at each, of fewer at the beginning, as a module forms it."""
    if window <= 1:
        return values
    return made([(KIND["CHANNEL"], 0, float(window), 0.0)], 1.0, values[:, None])[:, 0]


def offered(model: Model, axis: str) -> Choice:
    """The regressors that an axis has: those with a prior for its group. An axis is no regressor of itself."""
    others = (regressor for regressor in model.regressors if regressor.column != axis)
    return tuple(regressor for regressor in others if model.group_of(axis).name in regressor.sd)


def choices_of(regressors: Choice) -> list[Choice]:
    """Every subset, the empty subset first."""
    return [choice for count in range(len(regressors) + 1) for choice in itertools.combinations(regressors, count)]


def mask_of(regressors: Choice, choice: Choice) -> int:
    """A bit for every column in use, in the order of `regressors`."""
    names = [column for regressor in regressors for column in regressor.columns]
    return sum(1 << names.index(column) for regressor in choice for column in regressor.columns)


def coefficient_unit(unit: str, regressor: str) -> str:
    """Unit of a coefficient: `unit` of the axis per unit of the `regressor`; deg/s per degC/s is deg/s/degC*s."""
    swap = str.maketrans("*/", "/*")
    if unit == regressor:  # another axis of the same kind
        return "1"
    return unit if regressor == "1" else f"{unit}/{regressor.translate(swap)}"


def ln_prior(regressors: Choice, choice: Choice) -> float:
    """ln of the prior probability that of `regressors` those of the `choice` are in use, and no other."""
    used = ((regressor.probability, regressor in choice) for regressor in regressors)
    return sum(math.log(p if is_used else 1.0 - p) for p, is_used in used)
