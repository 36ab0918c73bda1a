"""The bias follows the temperature, in any of its forms."""

from __future__ import annotations

from selfcal.diagnosis import curve, forms
from selfcal.diagnosis.cause import Cause, Key, shown

CAUSE = Cause(
    "temperature",
    "The bias follows the temperature.",
    "Cycle the temperature up and down, so that it does not only rise with time.",
    source="surroundings",
    looks=lambda state, record: forms.side_looks(state, record, "temperature"),
    at=lambda state, record, theta: forms.side_at(state, record, "temperature", theta),
    trained=curve.trained,
    of_means=True,
    alike=lambda a, b: True,
    pictures=shown("means", "evidence"),
    least=lambda state, record: forms.least(state, record, "temperature"),
    smoothed=True,
    from_zero=True,
    of_column=forms.of_column,
    of_estimate=forms.of_look,
    keys={"coefficient": Key(lambda s: 0.3 * s.n, "temperature_coefficient"), **forms.EFFECT_KEYS},
    add=lambda keys, channels: forms.added(keys, channels, channels.temperature),
)
