"""Quantization noise that the lattice of the readings makes possible: N of a data sheet is marginal over its size.

Increments of a counter have remainders that are carried on: Q is the increment over sqrt(12) then, where they are white
(lattice.py). Readings of any other lattice may be increments: then Q is that at most. White noise with quantization
noise is the law `moving_average` (diagnosis/causes/quantization_noise.py).
"""

from __future__ import annotations

import math

from selfcal.adequacy.one_over_f import AddedLaw, Rerun, weigh_law
from selfcal.bank.axis_result import AxisResult
from selfcal.model.file import Prior
from selfcal.model.laws import RATIO_LIMITS
from selfcal.readings.lattice import Lattice

COUNTED = "moving_average"
#: Largest Q over the lattice's own: remainders that are nearly white have a little more.
Q_MOST = 1.25
#: Prior odds of the law over an average law where increments are carried on; elsewhere 1.
SURE_ODDS = 100.0
#: Least change of N by such noise that is weighed, sd of N.
N_CHANGE_LEAST = 0.5


def weigh_counted(lattice: Lattice | None, result: AxisResult, rerun: Rerun) -> AddedLaw | None:
    """White noise with quantization noise, where the lattice of the readings makes that possible and N would change.
    None elsewhere, and where the remainders are not white."""
    tables = rerun.tables
    if lattice is None or lattice.too_coarse_over(tables.dt_s):
        return None
    N, most = result.parameters[result.best]["N"].median, Q_MOST * lattice.step / (tables.rate_hz * math.sqrt(12.0))
    share = (most / N) ** 2 / tables.dt_s  # Q^2 / (N^2 dt): the share of N that it may be
    if not share > N_CHANGE_LEAST / math.sqrt(2.0 * result.n):
        return None
    # This N holds both: N^2 = n^2 + 2 Q^2 / dt, and n may be much less.
    least = max(RATIO_LIMITS[0], 1.0 / math.sqrt(1.0 + 4.0 * share / max(1.0 - 2.0 * share / Q_MOST**2, 0.01)))
    prior = {"spectral_ratio": Prior("log_uniform", least, 1.0)}
    odds = SURE_ODDS * len(tables.hypotheses) if lattice.carried else 1.0
    return weigh_law(COUNTED, prior, odds, rerun)
