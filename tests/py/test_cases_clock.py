"""Stamps without a grid, and grids that lose samples: the rate is the true one, and no sample is invented or lost.

Truth: the stamps' own generator. A mean rate of n independent steps of the relative sd s is known to s/sqrt(n); four of
those are allowed. With jitter of 0.09 and more a step of two now and then looks like one of one or three: 1 % of the
lost samples and 0.2 % of all.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
from numpy.typing import NDArray

from selfcal.errors import UserError
from selfcal.recording import load
from selfcal.sampling import Ambiguous, sampling
from selfcal.timebase import clock_of

from conftest import case_records

Floats = NDArray[np.float64]
Random = np.random.Generator
RATE_HZ, ROWS = 53.0, 7000


def found(time: Floats) -> tuple[float, int]:
    """Rate, Hz, and samples missing in all."""
    dt, missing = sampling(time - time[0], 1e-9, None)
    return 1.0 / dt, int(missing.sum())


@pytest.mark.parametrize(
    ("draw", "spread"),
    [
        (lambda r: r.uniform(0.2, 1.8, ROWS), 0.46),
        (lambda r: r.uniform(0.28, 1.72, ROWS), 0.42),
        (lambda r: r.uniform(0.45, 1.55, ROWS), 0.32),
        (lambda r: r.choice([0.72, 1.28], ROWS), 0.28),
        (lambda r: r.exponential(1.0, ROWS), 1.0),
        (lambda r: r.gamma(3.0, 1.0 / 3.0, ROWS), 0.58),
    ],
    ids=["least 0.2", "least 0.28", "least 0.45", "two steps", "Poisson", "Gamma"],
)
def test_random_steps_have_their_mean_rate(draw: Callable[[Random], Floats], spread: float) -> None:
    for seed in range(case_records(4, 100)):
        steps = draw(np.random.default_rng(seed)) / RATE_HZ
        rate, missing = found(np.concatenate([[0.0], np.cumsum(steps)]))
        # Steps beyond 20 mean ones are gaps: of Poisson's one in 5e8.
        assert missing == 0
        assert rate == pytest.approx(RATE_HZ, rel=4.0 * spread / np.sqrt(ROWS))


@pytest.mark.parametrize(("least", "noted"), [(0.3, True), (0.75, False)])
def test_stamps_on_no_grid_are_noted(least: float, noted: bool, tmp_path: Path) -> None:
    """Steps from `least` to 2 - `least` intervals: samples lost among random ones do not show, those of a grid do."""
    random = np.random.default_rng(4)
    time = np.concatenate([[0.0], np.cumsum(random.uniform(least, 2.0 - least, ROWS) / RATE_HZ)])
    rows = (f"{t:.6f},{value:.5f}" for t, value in zip(time, random.standard_normal(time.size), strict=True))
    (tmp_path / "log.csv").write_text("t[s],gx[deg/s]\n" + "\n".join(rows) + "\n", encoding="utf-8")
    assert any("on no grid" in note for note in load(tmp_path / "log.csv").notes) == noted


@pytest.mark.parametrize("jitter", [0.0, 0.03, 0.09, 0.14])
@pytest.mark.parametrize("lost", [0.004, 0.06, 0.22])
def test_a_grid_keeps_its_rate_with_jitter_and_losses(jitter: float, lost: float) -> None:
    for seed in range(case_records(2, 50)):
        random = np.random.default_rng(seed)
        time = np.sort((np.arange(ROWS) + jitter * random.standard_normal(ROWS)) / RATE_HZ)
        kept = random.random(ROWS) >= lost
        rate, missing = found(time[kept])
        truth = int(np.flatnonzero(kept)[-1] - np.flatnonzero(kept)[0]) + 1 - int(kept.sum())
        assert rate == pytest.approx(RATE_HZ, rel=1e-6 if jitter == 0.0 else 2e-3)
        assert abs(missing - truth) <= (0 if jitter < 0.05 else 0.01 * truth + 0.002 * ROWS)


@pytest.mark.parametrize("lost", [0.3, 0.45, 0.55])
def test_an_exact_grid_may_lose_half_of_its_samples(lost: float) -> None:
    for seed in range(case_records(3, 50)):
        random = np.random.default_rng(seed)
        kept = random.random(ROWS) >= lost
        rate, missing = found(np.flatnonzero(kept) / RATE_HZ)
        assert rate == pytest.approx(RATE_HZ, rel=1e-9)
        assert missing == int(np.ptp(np.flatnonzero(kept))) + 1 - int(kept.sum())


@pytest.mark.parametrize("rate_hz", [880.0, 771.3, 655.0])
@pytest.mark.parametrize("lost", [0.12, 0.35])
def test_the_lattice_of_the_stamps_is_not_taken_for_the_grid(rate_hz: float, lost: float) -> None:
    """Stamps of 1 ms of another rate, samples lost: the true rate or a refusal."""
    for seed in range(case_records(2, 30)):
        kept = np.random.default_rng(seed).random(ROWS) >= lost
        try:
            rate, _ = found(np.floor(np.flatnonzero(kept) * 1000.0 / rate_hz) / 1000.0)
        except Ambiguous:
            continue
        assert rate == pytest.approx(rate_hz, rel=1e-3)


@pytest.mark.parametrize("jitter", [0.0, 0.05, 0.14])
@pytest.mark.parametrize("lost", [0.6, 0.8])
def test_a_stated_rate_is_taken_however_many_samples_are_lost(jitter: float, lost: float) -> None:
    """The rate right or 0.02 % off: each sample has its place. Twice, half and 4/3 of the rate are refused."""

    def fail(row: int, why: str) -> NoReturn:
        raise UserError(f"row {row}: {why}")

    for seed in range(case_records(2, 30)):
        random = np.random.default_rng(seed)
        kept = np.flatnonzero(random.random(ROWS) >= lost)
        time = np.sort(kept + jitter * random.standard_normal(kept.size)) / RATE_HZ
        time = np.round(time - time[0], 6)
        for stated in (RATE_HZ, 1.0002 * RATE_HZ):
            clock = clock_of("log.csv", time, 1e-6, stated, fail)
            assert clock.rate_hz == stated
            assert abs(int(clock.missing_before.sum()) - int(np.ptp(kept)) - 1 + kept.size) <= 0.0003 * ROWS + 1
        for wrong in (2.0, 0.5, 1.333):
            with pytest.raises(UserError, match="does not agree with --rate"):
                clock_of("log.csv", time, 1e-6, wrong * RATE_HZ, fail)
