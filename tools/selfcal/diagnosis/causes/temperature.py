"""The bias follows the temperature, in any of its forms."""

from selfcal.diagnosis.cause import Key
from selfcal.diagnosis.channel_looks import side_cause

CAUSE = side_cause(
    "temperature",
    "temperature",
    "Cycle the temperature up and down, so that it does not only rise with time.",
    Key(lambda s: 0.3 * s.n, "temperature_coefficient"),
    from_zero=True,
)
