"""The bias follows the temperature, in any of its forms."""

from __future__ import annotations

from selfcal.diagnosis import curve, forms
from selfcal.diagnosis.cause import Cause, Grouping, Key, Scored, Simulated, Written, shown

CAUSE = Cause(
    "temperature",
    "The bias follows the temperature.",
    "Cycle the temperature up and down, so that it does not only rise with time.",
    source="surroundings",
    looks=lambda state, record: forms.side_looks(state, record, "temperature"),
    at=lambda state, record, theta: forms.side_at(state, record, "temperature", theta),
    of_means=True,
    pictures=shown("means", "evidence"),
    least=lambda state, record: forms.least(state, record, "temperature"),
    grouping=Grouping(alike=lambda a, b: True),
    score=Scored(trained=curve.trained),
    written=Written(smoothed=True, from_zero=True, of_column=forms.of_column),
    simulated=Simulated(
        keys={"coefficient": Key(lambda s: 0.3 * s.n, "temperature_coefficient"), **forms.EFFECT_KEYS},
        of_estimate=forms.of_look,
        add=lambda keys, channels: forms.added(keys, channels, channels.temperature),
    ),
)
