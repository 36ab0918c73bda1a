"""The bias follows the supply voltage, in any of its forms."""

from selfcal.diagnosis.cause import Key
from selfcal.diagnosis.channel_looks import side_cause

CAUSE = side_cause(
    "supply",
    "supply voltage",
    "Change the supply by 0.1 V and back, twice, at a constant temperature.",
    Key(lambda s: 50.0 * s.n, "supply_coefficient"),
    from_zero=False,
)
