"""The bias follows the supply voltage, in any of its forms."""

from __future__ import annotations

from selfcal.diagnosis import curve, forms
from selfcal.diagnosis.cause import Cause, Grouping, Key, Scored, Simulated, Written, shown

CAUSE = Cause(
    "supply",
    "The bias follows the supply voltage.",
    "Change the supply by 0.1 V and back, twice, at a constant temperature.",
    source="surroundings",
    looks=lambda state, record: forms.side_looks(state, record, "supply"),
    at=lambda state, record, theta: forms.side_at(state, record, "supply", theta),
    of_means=True,
    pictures=shown("means", "evidence"),
    least=lambda state, record: forms.least(state, record, "supply"),
    grouping=Grouping(alike=lambda a, b: True),
    score=Scored(trained=curve.trained),
    written=Written(smoothed=True, of_column=forms.of_column),
    simulated=Simulated(
        keys={"coefficient": Key(lambda s: 50.0 * s.n, "supply_coefficient"), **forms.EFFECT_KEYS},
        of_estimate=forms.of_look,
        add=lambda keys, channels: forms.added(keys, channels, channels.supply),
    ),
)
