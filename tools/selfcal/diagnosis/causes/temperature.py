"""The bias follows the temperature: its channel as a column."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause, Key, shown
from selfcal.diagnosis.causes import regressors

CAUSE = Cause(
    "temperature",
    "The bias follows the temperature.",
    "Cycle the temperature up and down, so that it does not only rise with time.",
    looks=regressors.looks,
    alike=lambda a, b: True,
    pictures=shown("means", "evidence"),
    least=lambda state, record: regressors.least(state, record, "temperature"),
    from_zero=True,
    of_column=lambda column, c: {"coefficient": c[0]},
    keys={"coefficient": Key(lambda s: 0.3 * s.n, "temperature_coefficient")},
)
