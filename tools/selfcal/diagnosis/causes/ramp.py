"""The bias drifts at a constant rate: time as a column."""

from __future__ import annotations

from collections.abc import Sequence

from selfcal.diagnosis.cause import Cause, Grouping, Key, Simulated, Written, shown
from selfcal.diagnosis.record import Record
from selfcal.likelihood import columns
from selfcal.likelihood.columns import LN_SLOW, Shape
from selfcal.likelihood.state import FittedColumn, Look, State
from selfcal.model.regressors import coefficient_unit


def looks(state: State, record: Record) -> list[Look]:
    """A look while the model has no ramp."""
    known = any(regressor.name == "time" for regressor in state.regressors)
    return [] if known else columns.looks(state, "ramp", [_shape(state, record)])


def at(state: State, record: Record, theta: Sequence[float]) -> Look:
    """The look at a ramp that is known to be there."""
    return columns.located(state, "ramp", _shape(state, record))


def _shape(state: State, record: Record) -> Shape:
    t = record.time_s
    middle = float(0.5 * t[-1])
    column = FittedColumn("time", "ramp", t - middle, "s", {"kind": "time", "reference": middle})
    keys = (("slope", coefficient_unit(state.unit, column.unit)),)
    return Shape("ramp", column.values[None], (column,), keys, price=LN_SLOW)


CAUSE = Cause(
    "ramp",
    "The bias drifts at a constant rate.",
    "Record three times as long, with the temperature beside it.",
    source="sensor",
    of_means=True,
    looks=looks,
    at=at,
    slow=True,
    pictures=shown("means", "evidence"),
    least=lambda state, record: columns.least(state, _shape(state, record), "slope"),
    grouping=Grouping(alike=lambda a, b: True),
    written=Written(from_zero=True, of_column=lambda column, c: {"slope": c[0]}),
    simulated=Simulated(keys={"slope": Key(lambda s: 5.0 * s.n / s.duration_s, "ramp_slope")}),
)
