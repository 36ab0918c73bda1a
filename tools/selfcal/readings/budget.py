"""How often chance alone may say that something is wrong: two budgets and their shares, stated here alone.

Every threshold is what chance exceeds in its share at most: the evidence net of a search, in nats, or a deviation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

#: Of axes at rest whose readings are sound, by test (a check of `identify`, a cause of `diagnose`). The sum keeps 2 in
#: 1000. Tests whose evidence is certain as soon as there is any take less.
SHARES: Mapping[str, float] = MappingProxyType(
    {
        "motion": 1e-3,
        "saturation": 5e-4,
        "quantization": 5e-5,
        "held_samples": 6e-6,
        "outliers": 1e-7,
        "stuck": 1e-9,
        "misread": 1e-11,
    }
)

#: Of modules of AXES axes at rest with noise and a drift alone, by what says that something is wrong: the checks of
#: `identify` (4 standard deviations each), the statistics of the innovations and their coherence with the channels, the
#: look at all axes together, and the causes of one axis. The sum keeps 1 in 100.
OF_MODULES: Mapping[str, float] = MappingProxyType(
    {"checks": 3e-3, "statistics": 8e-4, "coherence": 2e-4, "together": 2e-3, "causes": 4e-3}
)
#: Axes of a module; checks of an axis that chance may fail; and looks at an axis for a cause that are independent, in
#: effect: of 300 clean axes (1200 s at 1 Hz; `make false-alarms` has their records) 18 % gain 3 nats net, 7 % gain 4.
AXES, CHECKS, LOOKS = 6, 8, 3


def nats_of(test: str) -> float:
    """Evidence from which on a test names its cause."""
    return -math.log(SHARES[test])
