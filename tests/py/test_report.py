"""The report on the default grid (24 nodes of rho, 16 of alpha, 96 cells) against a dense one, over the whole prior.

The judge is the same code in double on 48 and 40 x 40 nodes with 192 cells, where neither counts any more: 64 and
56 x 56 nodes give the same to 1e-4. That its sums are right is test_bank.py's business, that its posterior is,
test_identify.py's. SELFCAL_DRAWS sets the records per law and length (default 4), SELFCAL_LENGTHS the lengths.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest

from selfcal.engines.library import Bank
from selfcal.model import Model
from selfcal.tables import Tables, make_grid, make_tables
from selfcal.verbs.montecarlo import draw, simulate_bank_samples

from conftest import worst_difference

MODEL = Model.load()
GROUP = MODEL.group_of("gx")
DRAWS = int(os.environ.get("SELFCAL_DRAWS", "4"))
LENGTHS = [int(float(n)) for n in os.environ.get("SELFCAL_LENGTHS", "10,100,1000,10000").split(",")]
#: The design's tolerances: |d ln evidence|, |d mean| / sd, |sd ratio - 1|.
TOLERANCE = np.array([0.05, 0.05, 0.03])
#: They hold for nearly all of the prior, not for all: where the drift hides the white noise (rho above 10) the
#: likelihood bends within a step of the nodes. Seen: 1 record in 24 beyond at n = 100, none at 10, 1000 and 10 000. At
#: 10^5 what is left to the splines grows as sqrt(n): 5 in 12 are beyond, by 0.3 nat and 0.07 sd at most.
SHARE = 0.9


def dense_tables() -> Tables:
    """The default model's, with 48 nodes of random walk and 40 x 40 of Gauss-Markov."""
    square = make_grid(40), make_grid(40)
    nodes = {"constant": (None, None), "random_walk": (make_grid(48), None), "gauss_markov": square}
    hypotheses = (replace(h, rho=nodes[h.name][0], alpha=nodes[h.name][1]) for h in DEFAULT.hypotheses)
    return replace(DEFAULT, hypotheses=tuple(hypotheses))


DEFAULT = make_tables(MODEL, 1.0, ("gx",))
DENSE = dense_tables()


@pytest.mark.parametrize("n", LENGTHS)
def test_report_over_the_whole_prior(n: int) -> None:
    found = []
    for law in MODEL.hypotheses:
        for index in range(DRAWS):
            truth = draw(GROUP, law, np.random.default_rng([n, index, 7]))
            y = simulate_bank_samples(law, truth, 1.0, n, seed=100 + index)[0].astype(np.float32)
            banks = Bank(DEFAULT), Bank(DENSE, dense=True)
            for bank in banks:
                bank.push(y[:, None])
            evidence, _, mean, sd = worst_difference(*(bank.report(0) for bank in banks))
            found.append([evidence, mean, sd])
    values = np.array(found)
    good = (values <= TOLERANCE).all(axis=1).mean()
    (e, m, s), (we, wm, ws) = np.quantile(values, 0.9, axis=0), values.max(axis=0)
    print(
        f"\nn={n}: 9 records in 10 within d ln evidence {e:.3f}, d mean {m:.3f} sd, sd {100 * s:.1f} %; "
        f"worst {we:.3f}, {wm:.3f} sd, {100 * ws:.1f} %; all tolerances kept in {100 * good:.0f} %"
    )
    assert good >= SHARE
