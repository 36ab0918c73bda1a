"""How often sound readings may be called wrong: a share of each test, of all axes, stated here alone.

Every threshold is the evidence net of its search, in nats, that chance exceeds in that share of the axes at most.
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


def nats_of(test: str) -> float:
    """Evidence from which on a test names its cause."""
    return -math.log(SHARES[test])
