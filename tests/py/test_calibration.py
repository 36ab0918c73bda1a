"""Simulation-based calibration of the bank (Talts et al. 2018): parameters come from the prior, so the truth's rank
in the posterior is uniform, whatever the law and the length.

A report has the 5, 50 and 95 % points, which cut the ranks into four bins of 5, 45, 45 and 5 %. Each count must lie
within its binomial band, which a right bank leaves once in 10 000 runs of all bins together. The bias has a mean and an
sd alone. Its ranks under a normal distribution are printed in twenty bins and not judged: its posterior is a mixture.

`SELFCAL_CALIBRATION=1000` sets the records of each law and length (`make calibration`). The laws that are sums get a
quarter, because a record of them takes ten times as long.
"""

from __future__ import annotations

import os
from functools import partial

import numpy as np
import pytest
from scipy import special, stats

from selfcal.laws import NAMED, PLAIN, SUMS
from selfcal.model import Model
from selfcal.spread import Row, spread
from selfcal.verbs.montecarlo import rows_of

from conftest import ROOT

RECORDS = int(os.environ.get("SELFCAL_CALIBRATION", "0"))
LONG = RECORDS > 0
LENGTHS = (60, 600, 3600) if LONG else (60, 600)
#: Probability of the four bins between the reported points.
BINS = np.array([0.05, 0.45, 0.45, 0.05])
BIAS_BINS = 20
#: A right bank fails one of all tests so often.
FALSE_ALARM = 1e-4
#: Bins of all laws, lengths and parameters, at most: what FALSE_ALARM is shared among.
TESTS = 6 * 3 * 3 * 4
SEED = 7
SUMS_MODEL = ROOT / "tools" / "selfcal" / "models" / "sums.yaml"


def ranks(rows: list[Row], name: str) -> np.ndarray:
    """Counts [4] of the truth below the 5 % point, to the median, to the 95 % point, and above."""
    truth, *points = (np.array([row[f"{key}.{name}"] for row in rows]) for key in ("truth", "q05", "median", "q95"))
    return np.bincount(sum((truth > point).astype(int) for point in points), minlength=4)


def band(count: int, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Limits of a binomial count."""
    tail = FALSE_ALARM / TESTS / 2.0
    return stats.binom.ppf(tail, count, share), stats.binom.isf(tail, count, share)


@pytest.mark.parametrize("samples", LENGTHS)
@pytest.mark.parametrize("law", PLAIN + (SUMS if LONG else ()))
def test_ranks_of_the_truth_are_uniform(law: str, samples: int) -> None:
    records = (RECORDS // 4 if law in SUMS else RECORDS) or 60
    model = Model.load(SUMS_MODEL if law in SUMS else None)
    jobs = [(law, SEED + 1_000_003 * k) for k in range(records)]
    rows = spread(partial(rows_of, model, "gx", samples / model.bank_rate_hz), jobs, settings={})
    said = []
    wrong = []
    for name in NAMED[law].parameters:
        counts = ranks(rows, name)
        low, high = band(records, BINS)
        said.append(f"{name} {counts.tolist()}")
        if not ((low <= counts) & (counts <= high)).all():
            wrong.append(f"{name}: {counts.tolist()} of {records}, band {low.tolist()} to {high.tolist()}")
    place = special.ndtr(-np.array([row["bias_error_sd"] for row in rows]))
    counts = np.histogram(place, BIAS_BINS, (0.0, 1.0))[0]
    chi = float(((counts - records / BIAS_BINS) ** 2).sum() / (records / BIAS_BINS))
    p = float(stats.chi2.sf(chi, BIAS_BINS - 1))
    print(f"{law}, {samples} samples, {records} records: {'; '.join(said)}; bias {counts.tolist()}, p {p:.3g}")
    assert not wrong, wrong
