"""The bias follows the supply voltage: its channel as a column."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause, Key, shown
from selfcal.diagnosis.causes import regressors

CAUSE = Cause(
    "supply",
    "The bias follows the supply voltage.",
    "Change the supply by 0.1 V and back, twice, at a constant temperature.",
    looks=regressors.looks,
    alike=lambda a, b: True,
    pictures=shown("means", "evidence"),
    least=lambda state, record: regressors.least(state, record, "supply"),
    of_column=lambda column, c: {"coefficient": c[0]},
    keys={"coefficient": Key(lambda s: 50.0 * s.n, "supply_coefficient")},
)
