"""The bias drifts at a constant rate: time as a column."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause, Key, shown
from selfcal.diagnosis.causes import regressors
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import State


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    t = record.time_s
    return {"slope": (state.least(t - 0.5 * t[-1]), f"{state.unit}/s")}


CAUSE = Cause(
    "ramp",
    "The bias drifts at a constant rate.",
    "Record three times as long, with the temperature beside it.",
    looks=regressors.looks,
    slow=True,
    pictures=shown("means", "evidence"),
    least=_least,
    from_zero=True,
    of_column=lambda column, c: {"slope": c[0]},
    keys={"slope": Key(lambda s: 5.0 * s.n / s.duration_s, "ramp_slope")},
)
