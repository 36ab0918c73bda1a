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

from selfcal.base.errors import UserError
from selfcal.logs.recording import load
from selfcal.logs.sampling import Ambiguous, rate_changes, sampling
from selfcal.logs.timebase import clock_of
from selfcal.verbs.identify import identify

from conftest import case_records

#: Every log that a test here opens, `convert` writes without loss.
pytestmark = pytest.mark.usefixtures("reads_back")

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


@pytest.mark.parametrize(
    "delay",
    [
        lambda r: 0.2 * r.standard_normal(ROWS),
        lambda r: 0.28 * r.standard_normal(ROWS),
        lambda r: r.exponential(0.5, ROWS),
    ],
    ids=["0.2", "0.28", "late by 0.5"],
)
@pytest.mark.parametrize("lost", [0.03, 0.27, 0.63])
def test_a_grid_shows_behind_jitter_that_hides_it_from_single_steps(
    delay: Callable[[Random], Floats], lost: float
) -> None:
    """A third of the steps is far from whole intervals. The rate is that of the grid: the mean one is 3 to 63 % low."""
    for seed in range(case_records(2, 50)):
        random = np.random.default_rng(seed)
        time = np.arange(ROWS) + delay(random)
        kept = random.random(ROWS) >= lost
        rate, missing = found(np.sort(time[kept]) / RATE_HZ)
        truth = int(np.flatnonzero(kept)[-1] - np.flatnonzero(kept)[0]) + 1 - int(kept.sum())
        assert rate == pytest.approx(RATE_HZ, rel=2e-3)
        assert abs(missing - truth) <= 0.01 * truth + 0.002 * ROWS


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


@pytest.mark.parametrize("lost", [0.1, 0.35, 0.5, 0.72])
@pytest.mark.parametrize("jitter", [0.0, 0.06, 0.13])
def test_another_rate_than_that_of_the_grid_is_refused(lost: float, jitter: float) -> None:
    """Of 41 Hz, at which lost samples hide best: 4/3, 3/4, 2/3 and half of it, and two rates of no simple ratio. The
    mean rate between longer steps agrees with some of them. A clock that is 2 % off is accepted."""

    def fail(row: int, why: str) -> NoReturn:
        raise UserError(f"row {row}: {why}")

    for seed in range(case_records(1, 10)):
        random = np.random.default_rng([seed, 5])
        kept = np.flatnonzero(random.random(3000) >= lost)
        time = np.round(np.sort(kept + jitter * random.standard_normal(kept.size)) / 41.0, 6)
        for share in (1.333, 0.75, 0.667, 0.5, 0.79, 0.6):
            with pytest.raises(UserError, match="does not agree with --rate"):
                clock_of("log.csv", time, 1e-6, 41.0 * share, fail)
        if lost < 0.5:
            assert clock_of("log.csv", time, 1e-6, 41.0 * 1.02, fail).rate_hz == 41.0 * 1.02


def in_bursts(random: Random, rows: int, lost: float, run: float) -> NDArray[np.bool_]:
    """Which of `rows` samples arrive, bool[rows]: runs of `run` on average, and losses between them."""
    lengths = np.column_stack([random.geometric(1.0 / run, rows), random.geometric((1.0 - lost) / (run * lost), rows)])
    return np.repeat(np.tile([True, False], rows), lengths.ravel())[:rows]


@pytest.mark.parametrize("lost", [0.35, 0.6, 0.88])
@pytest.mark.parametrize("run", [0.0, 8.0, 25.0])
def test_an_exact_grid_is_known_whatever_it_loses(lost: float, run: float) -> None:
    """Samples lost one by one (`run` 0) or in bursts. The stamps are exact multiples of the interval, to 1 us."""
    for seed in range(case_records(2, 30)):
        random = np.random.default_rng(seed)
        kept = in_bursts(random, 24000, lost, run) if run else random.random(24000) >= lost
        place = np.flatnonzero(kept)
        rate, missing = found(np.round(place / 30.0, 6))
        assert rate == pytest.approx(30.0, rel=1e-7)
        assert missing == int(np.ptp(place)) + 1 - place.size


@pytest.mark.parametrize("tick_s", [0.001, 0.01, 1.0 / 64.0])
def test_ticks_of_a_clock_make_no_grid_of_random_times(tick_s: float) -> None:
    """Steps of 0.3 to 1.7 intervals, of 6.2 ticks, written in whole ticks: their mean rate."""
    for seed in range(case_records(2, 30)):
        steps = np.random.default_rng(seed).uniform(0.3, 1.7, ROWS) * 6.2 * tick_s
        rate, missing = found(np.floor(np.cumsum(steps) / tick_s) * tick_s)
        assert missing == 0
        # The steps spread by 0.4.
        assert rate == pytest.approx(1.0 / (6.2 * tick_s), rel=4.0 * 0.4 / np.sqrt(ROWS))


@pytest.mark.parametrize("jitter", [0.0, 0.08])
@pytest.mark.parametrize(
    "parts",
    [
        [(150, 12.0), (3, 50.0), (200, 12.0)],
        [(60, 20.0), (9, 8.0), (200, 20.0), (12, 8.0), (150, 20.0)],
        [(150, 3.0), (150, 4.0), (120, 6.0), (150, 5.0)],
    ],
    ids=["burst", "slow stretches", "steps"],
)
def test_each_change_of_rate_is_found(parts: list[tuple[float, float]], jitter: float) -> None:
    for seed in range(case_records(2, 30)):
        random = np.random.default_rng(seed)
        steps = np.concatenate([np.full(round(s * hz), 1.0 / hz) for s, hz in parts])
        time = np.concatenate([[0.0], np.cumsum(steps)])[:-1] + jitter * steps * random.uniform(-0.5, 0.5, steps.size)
        changes = rate_changes(time)
        # A change lies within one interval of its first sample, where the jitter hides it two.
        assert [one.row for one in changes] == pytest.approx(np.cumsum([s * hz for s, hz in parts])[:-1], abs=2)
        assert [1.0 / one.after_s for one in changes] == pytest.approx([hz for _, hz in parts[1:]], rel=0.01)


@pytest.mark.parametrize("stalled", [45, 80])
def test_a_burst_after_a_stall_is_no_change_of_rate(stalled: int) -> None:
    """The samples of a stall come at once after it, 1 ms apart."""
    time = np.arange(6000) / 15.0
    late = slice(3000, 3000 + stalled)
    time[late] = time[late.stop] - 0.001 * np.arange(stalled, 0, -1)
    assert rate_changes(time) == []


@pytest.mark.parametrize(("lost", "whole"), [(0.5, True), (0.74, True), (0.88, False)])
def test_lossy_records_are_right_or_refused(lost: float, whole: bool, tmp_path: Path) -> None:
    """15 Hz, 40 minutes: the intervals of N and K hold the truth to four of their standard deviations, at the model's
    bank rate where averages are whole, and reading by reading."""
    n_true, k_true, rate_hz = 0.02, 0.002, 15.0
    for seed in range(case_records(3, 40)):
        random = np.random.default_rng(seed)
        rows = round(2400 * rate_hz)
        drift = np.cumsum(k_true / np.sqrt(rate_hz) * random.standard_normal(rows))
        values = drift + n_true * np.sqrt(rate_hz) * random.standard_normal(rows)
        kept = np.flatnonzero(random.random(rows) >= lost)
        log = tmp_path / "log.csv"
        text = "\n".join(f"{row / rate_hz:.6f},{values[row]:.7g}" for row in kept)
        log.write_text(f"t[s],gx[deg/s]\n{text}\n", encoding="utf-8")
        if not whole:
            with pytest.raises(UserError, match="--decimate 15 takes each reading alone"):
                identify(log, suspicion=False)
        for decimate in (None, rate_hz) if whole else (rate_hz,):
            axis = identify(log, decimate=decimate, suspicion=False)["axes"]["gx"]
            parameters = axis["parameters"]["random_walk"]
            for name, truth in (("N", n_true), ("K", k_true)):
                sd = np.log(parameters[name]["q95"] / parameters[name]["q05"]) / 3.29
                assert abs(np.log(parameters[name]["median"] / truth)) < 4.0 * sd
