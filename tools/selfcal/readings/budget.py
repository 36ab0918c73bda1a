"""How often chance alone may say that something is wrong: two budgets and their shares, stated here alone.

Every threshold is what chance exceeds in its share at most: the evidence net of a search, in nats, or a deviation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import NormalDist
from types import MappingProxyType

from selfcal.base.units import SENSORS

#: Share of axes at rest with sound readings that a test names (a check of `identify`, a cause of `diagnose`). The sum
#: keeps 2 in 1000. Tests whose evidence is certain as soon as there is any take less.
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

#: Share of modules of six axes at rest with noise and a drift alone that are called unsound. By a look at an axis (a
#: check of `identify`, a cause of `diagnose`), all axes together, the statistics of the innovations of an axis, and
#: their coherence with the channels. The sum keeps 2 in 100. With a fifth of its share all axes together miss 2 of 24
#: causes of 30 nats (`make hidden-several`, seeds 470 and 471).
OF_MODULES: Mapping[str, float] = MappingProxyType(
    {"looks": 7e-3, "together": 1e-2, "statistics": 8e-4, "coherence": 2e-4}
)
#: Share of sound batches, units, calibrations and comparisons that a test calls unsound.
FALSE_ALARM = 1e-3
#: Axes of a module, by which its shares are split.
AXES_COUNT = len(SENSORS)
#: Independent looks at an axis, in effect: the eight checks, and eleven of `diagnose`. Of 348 axes of clean modules
#: (seeds 1000 to 1028 of `make false-alarms`, 1 and 10 Hz) 17 gain 5.4 nats for some cause, as 11 e^-5.4 of them do.
LOOKS_IN_EFFECT = 19
#: Probability that a look at an axis exceeds 4 standard deviations, or 9.7 nats, by chance.
P_LOOK = OF_MODULES["looks"] / (AXES_COUNT * LOOKS_IN_EFFECT)
#: Largest deviation of a look's statistic that passes, sd: 4.
CHECK_LIMIT = -NormalDist().inv_cdf(0.5 * P_LOOK)
#: Nats by which an explanation is clearly better than another: by chance at most once in 20 (Markov's bound).
CLEARLY = math.log(20.0)


def nats_of(test: str) -> float:
    """Evidence from which on a test names its cause."""
    return -math.log(SHARES[test])
