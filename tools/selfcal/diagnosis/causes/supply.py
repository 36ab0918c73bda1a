"""The bias follows the supply voltage, in any of its forms."""

from __future__ import annotations

from selfcal.diagnosis import curve, forms
from selfcal.diagnosis.cause import Cause, Key, shown

CAUSE = Cause(
    "supply",
    "The bias follows the supply voltage.",
    "Change the supply by 0.1 V and back, twice, at a constant temperature.",
    source="surroundings",
    looks=lambda state, record: forms.side_looks(state, record, "supply"),
    at=lambda state, record, theta: forms.side_at(state, record, "supply", theta),
    trained=curve.trained,
    of_means=True,
    alike=lambda a, b: True,
    pictures=shown("means", "evidence"),
    least=lambda state, record: forms.least(state, record, "supply"),
    smoothed=True,
    of_column=forms.of_column,
    of_estimate=forms.of_look,
    keys={"coefficient": Key(lambda s: 50.0 * s.n, "supply_coefficient"), **forms.EFFECT_KEYS},
    add=lambda keys, channels: forms.added(keys, channels, channels.supply),
)
