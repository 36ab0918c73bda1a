"""The library's bank against the textbook bank of host_sim, node for node, to the design's tolerances (agreement.py).

`make tolerances` prints the same for more records and lengths.
"""

from __future__ import annotations

import numpy as np
import pytest

from selfcal.model.laws import PLAIN

from agreement import LIMITS, MODEL, a_record, compare, hold, tables_of
from conftest import shared_recording

#: Records a law, by length; `make tolerances` takes longer ones too. Nodes: the M4F's, 16 + 16 x 12 + 1.
RECORDS = {10: 20, 100: 20, 1000: 10, 10_000: 3}
TARGET = "cortex-m4f"


@pytest.mark.parametrize("gaps", [False, True], ids=["whole", "gaps"])
@pytest.mark.parametrize("n", RECORDS)
@pytest.mark.parametrize("law", PLAIN)
def test_parity_with_the_textbook_bank(law: str, n: int, gaps: bool) -> None:
    tables = tables_of(MODEL, TARGET)
    records = (a_record(law, n, seed, gaps=gaps)[0] for seed in range(RECORDS[n]))
    hold(f"{law} n={n} gaps={gaps}", [compare(y, tables) for y in records])


@pytest.mark.parametrize("law", PLAIN)
def test_parity_at_a_hundred_thousand(law: str) -> None:
    """Records longer than a model is fitted to as a rule, with gaps."""
    y, _ = a_record(law, 100_000, 0, gaps=True)
    hold(f"{law} n=1e5", [compare(y, tables_of(MODEL, TARGET), sigmas=5, every=2)])


@pytest.mark.parametrize("rho", [1e-3, 1e-2, 1e-1, 1.0, 10.0])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_parity_over_rho_and_offsets(rho: float, offset: float) -> None:
    """A random walk of rho = K / N; a bias of a million times the noise, which float32 carries to 0.06 of it."""
    y, _ = a_record("random_walk", 10_000, 7, rho=rho, offset=offset)
    tables = tables_of(MODEL, TARGET, bias_sd=max(10.0, abs(float(y[0]))))
    hold(f"rho {rho:g} offset {offset:g}", [compare(y, tables)])


@pytest.mark.parametrize("axis", ["gx", "gy", "gz", "ax", "ay", "az"])
def test_parity_on_a_real_recording(axis: str) -> None:
    """adis16405_run1, 1 Hz means, 10 000 s."""
    recording = shared_recording("adis16405_run1.npz")
    y = recording.in_unit(axis, MODEL.group_of(axis).unit).reshape(-1, 100).mean(axis=1)
    tables = tables_of(MODEL, TARGET, axis=axis)
    hold(f"run1 {axis}", [compare(y.astype(np.float32).astype(np.float64), tables)])


def test_a_build_that_is_off_is_seen() -> None:
    """Each tolerance is broken by what is just beyond it, and by NaN."""
    for limit in LIMITS.values():
        for name in ("ln_p", "probability", "mean"):
            value = getattr(limit, name)
            wrong = float("nan") if value == float("inf") else 1.001 * value
            assert limit.within(limit)
            assert not type(limit)(**{**vars(limit), name: wrong}).within(limit)
