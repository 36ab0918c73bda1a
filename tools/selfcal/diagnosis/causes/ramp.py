"""The bias drifts at a constant rate: time as a column."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from selfcal.diagnosis.cause import Cause, Key, shown
from selfcal.diagnosis.forms import LN_SLOW
from selfcal.diagnosis.record import Record
from selfcal.likelihood.fit import Fit
from selfcal.likelihood.state import SCREEN, Look, Regressor, State, interval, net, sizes
from selfcal.model.regressors import coefficient_unit


def looks(state: State, record: Record) -> list[Look]:
    """One look while the model has no ramp."""
    if any(one.name == "time" for one in state.regressors):
        return []
    column = _column(record)
    if state.scores([column.values])[0] < SCREEN:
        return []
    gain, fit = state.with_columns(column.values)
    gain = min(gain, state.rich_gain(column.values))
    worth = net(gain, 1, LN_SLOW)
    return [_look(state, column, gain, worth, fit)] if worth >= 1.0 else []


def at(state: State, record: Record, theta: Sequence[float]) -> Look:
    """The look at a ramp that is known to be there."""
    column = _column(record)
    gain, fit = state.with_columns(column.values)
    return _look(state, column, gain, net(gain), fit)


def _column(record: Record) -> Regressor:
    t = record.time_s
    middle = float(0.5 * t[-1])
    return Regressor("time", "ramp", t - middle, "s", {"kind": "time", "reference": middle})


def _look(state: State, column: Regressor, gain: float, worth: float, fit: Fit) -> Look:
    unit = coefficient_unit(state.unit, column.unit)
    slope = interval(float(fit.c[-1]), float(fit.sd[-1]), unit)

    measure = partial(sizes, column.values, "slope", unit)
    changes = {"regressors": (*state.regressors, column)}
    return Look("ramp", gain, worth, {"slope": slope}, changes, measure=measure)


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    t = record.time_s
    return {"slope": (state.least(t - 0.5 * t[-1]), f"{state.unit}/s")}


CAUSE = Cause(
    "ramp",
    "The bias drifts at a constant rate.",
    "Record three times as long, with the temperature beside it.",
    source="sensor",
    of_means=True,
    alike=lambda a, b: True,
    looks=looks,
    at=at,
    slow=True,
    pictures=shown("means", "evidence"),
    least=_least,
    from_zero=True,
    of_column=lambda column, c: {"slope": c[0]},
    keys={"slope": Key(lambda s: 5.0 * s.n / s.duration_s, "ramp_slope")},
)
