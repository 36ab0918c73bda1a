"""Simulation-based calibration of the bank (Talts et al. 2018): parameters come from the prior, so the truth's rank
in the posterior is uniform, whatever the law and the length.

A report has the 5, 50 and 95 % points, which cut the ranks into four bins of 5, 45, 45 and 5 %. Each count must lie
within its binomial band, which a right bank leaves once in 10 000 runs of all bins together.

The bias has a mean and an sd alone, so its ranks in twenty bins are those of a normal distribution. With the constant
law as the only hypothesis its posterior is one, but for the doubt of N: Student's with n - 1 degrees of freedom, which
at n = 60 moves 0.5 % of the records between bins. Those ranks are judged. The others are printed: a mixture is no
normal distribution.

`SELFCAL_CALIBRATION=1000` sets the records of each law and length (`make calibration`). The laws that are sums get a
quarter, and a sixteenth at 36 000 samples, where one record takes three seconds.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import special, stats

from selfcal.batch.spread import Row, spread
from selfcal.model.file import Model
from selfcal.model.laws import NAMED, PLAIN, SUMS
from selfcal.studies.montecarlo import rows_of

from conftest import ROOT

RECORDS = int(os.environ.get("SELFCAL_CALIBRATION", "0"))
LONG = RECORDS > 0
LENGTHS = (60, 600, 3600, 36000) if LONG else (60, 600)
#: Probability of the four bins between the reported points.
BINS = np.array([0.05, 0.45, 0.45, 0.05])
BIAS_BINS = 20
#: A right bank fails one of all tests so often.
FALSE_ALARM = 1e-4
#: Bins of all laws, lengths and parameters, at most: what FALSE_ALARM is shared among.
TESTS = 6 * 4 * 3 * 4
SEED = 7
SUMS_MODEL = ROOT / "tools" / "selfcal" / "model" / "models" / "sums.yaml"


def ranks(rows: list[Row], name: str) -> np.ndarray:
    """Counts [4] of the truth below the 5 % point, to the median, to the 95 % point, and above."""
    truth, *points = (np.array([row[f"{key}.{name}"] for row in rows]) for key in ("truth", "q05", "median", "q95"))
    return np.bincount(sum((truth > point).astype(int) for point in points), minlength=4)


def band(count: int, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Limits of a binomial count."""
    tail = FALSE_ALARM / TESTS / 2.0
    return stats.binom.ppf(tail, count, share), stats.binom.isf(tail, count, share)


def p_value(counts: np.ndarray, share: np.ndarray) -> float:
    """Pearson's test of counts against the shares that they should have."""
    return float(stats.chisquare(counts, counts.sum() * share).pvalue)


def ranks_of_bias(rows: list[Row]) -> np.ndarray:
    """Counts [BIAS_BINS] of the truth's place under a normal distribution of the reported mean and sd."""
    place = special.ndtr(-np.array([row["bias_error_sd"] for row in rows]))
    return np.histogram(place, BIAS_BINS, (0.0, 1.0))[0]


def records_of(law: str, samples: int) -> int:
    """How many records of a law and length."""
    if law not in SUMS:
        return RECORDS or 60
    return RECORDS // (16 if samples > 3600 else 4) or 60


def simulated(model: Model, law: str, samples: int) -> list[Row]:
    """Reports of records whose parameters are drawn from the prior."""
    jobs = [(law, SEED + 1_000_003 * k) for k in range(records_of(law, samples))]
    return spread(partial(rows_of, model, "gx", samples / model.bank_rate_hz), jobs)


@pytest.mark.parametrize("samples", LENGTHS)
@pytest.mark.parametrize("law", PLAIN + (SUMS if LONG else ()))
def test_ranks_of_the_truth_are_uniform(law: str, samples: int) -> None:
    rows = simulated(Model.load(SUMS_MODEL if law in SUMS else None), law, samples)
    said = []
    wrong = []
    for name in NAMED[law].parameters:
        counts = ranks(rows, name)
        low, high = band(len(rows), BINS)
        said.append(f"{name} {counts.tolist()}, p {p_value(counts, BINS):.2g}")
        if not ((low <= counts) & (counts <= high)).all():
            wrong.append(f"{name}: {counts.tolist()} of {len(rows)}, band {low.tolist()} to {high.tolist()}")
    counts = ranks_of_bias(rows)
    p = p_value(counts, np.full(BIAS_BINS, 1.0 / BIAS_BINS))
    print(f"{law}, {samples} samples, {len(rows)} records: {'; '.join(said)}; bias {counts.tolist()}, p {p:.2g}")
    assert not wrong, wrong


@pytest.mark.parametrize("samples", LENGTHS)
def test_ranks_of_a_constant_bias_are_uniform(samples: int) -> None:
    alone = replace(Model.load(), hypotheses={"constant": 1.0})
    counts = ranks_of_bias(simulated(alone, "constant", samples))
    p = p_value(counts, np.full(BIAS_BINS, 1.0 / BIAS_BINS))
    print(f"constant alone, {samples} samples, {counts.sum()} records: bias {counts.tolist()}, p {p:.2g}")
    assert p > FALSE_ALARM / len(LENGTHS), counts.tolist()
