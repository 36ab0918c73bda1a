"""Values of regressors, formed by the library sample by sample (lib/columns.c), against their definitions in numpy.

Windows of up to SELFCAL_COLUMN_BINS samples (32) have a bin a sample and are exact but for float32. Longer ones are
held in bins: then a mean is off by what the channel moves within the oldest bin.
"""

import numpy as np
import pytest

from selfcal import _library32

TIME, CHANNEL, RATE, SINE, COSINE, STEP, TURN_ON, PULSE = range(8)


def form(
    source: tuple[float, ...],
    values: np.ndarray,
    missing: np.ndarray | None = None,
    dt: float = 0.1,
) -> np.ndarray:
    """[n] of one source over one channel [n]."""
    kind, number, until = (*source, 0.0)[:3]
    gaps = np.zeros(values.size, np.uint64) if missing is None else missing.astype(np.uint64)
    rows = np.ascontiguousarray(values[:, None], np.float32)
    return np.asarray(_library32.form([(kind, 0, number, until)], dt, rows, gaps)[:, 0], float)


def walk(n: int, seed: int) -> np.ndarray:
    return (25.0 + np.cumsum(0.01 * np.random.default_rng(seed).normal(size=n))).astype(np.float32).astype(float)


def mean_of_last(values: np.ndarray, window: int) -> np.ndarray:
    total = np.concatenate([[0.0], np.cumsum(values)])
    end = np.arange(1, values.size + 1)
    start = np.maximum(end - window, 0)
    return (total[end] - total[start]) / (end - start)


def a_gapped_record(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Missing counts [n] and times [n], s, at 0.1 s; one gap is longer than any window."""
    rng = np.random.default_rng(seed)
    missing = np.where(rng.random(n) < 0.05, rng.integers(1, 20, n), 0)
    missing[0], missing[n // 2] = 0, 50_000
    return missing, 0.1 * (np.arange(n) + np.cumsum(missing))


@pytest.mark.parametrize("window", [1, 2, 7, 32])
def test_a_short_mean_is_exact(window: int) -> None:
    """Rounding: float32 at 25 is 2e-6."""
    values = walk(500, window)
    assert np.abs(form((CHANNEL, 0.1 * window), values) - mean_of_last(values, window)).max() < 1e-5


@pytest.mark.parametrize("window", [33, 100, 600, 49_152])
def test_a_long_mean_is_that_of_the_window_but_for_its_oldest_bin(window: int) -> None:
    """A straight line has its mean half a window back: the oldest bin, taken in part, is off by at most an eighth of a
    bin times the share of a bin in the window. A step has left the mean after exactly one window."""
    n = 4 * window
    line = 0.01 * np.arange(n)
    bin_size = -(-window // 32)
    found, exact = form((CHANNEL, 0.1 * window), line), mean_of_last(line, window)
    most = 0.01 * bin_size * bin_size / 8.0 / window
    assert np.abs(found - exact)[window:].max() < most + 1e-6 * line.max()
    step = (np.arange(n) >= 2 * window).astype(float)
    after = form((CHANNEL, 0.1 * window), step)
    assert (after[: 2 * window] == 0.0).all()
    assert after[3 * window - 1 + bin_size :] == pytest.approx(1.0, abs=1e-6)
    assert (np.diff(after) >= -1e-6).all()


@pytest.mark.parametrize("window", [1, 5, 31])
@pytest.mark.parametrize("gaps", [False, True])
def test_a_rate_is_the_gain_over_its_window(window: int, gaps: bool) -> None:
    """Against np.interp at the window's beginning; float32 at 25 over the window."""
    n, seconds = 800, 0.1 * window
    missing, t = a_gapped_record(n, 3) if gaps else (np.zeros(n, np.int64), 0.1 * np.arange(n))
    values = walk(n, 5)
    expected = (values - np.interp(t - seconds, t, values)) / seconds
    assert np.abs(form((RATE, seconds), values, missing) - expected).max() < 2e-5 / seconds


@pytest.mark.parametrize("window", [64, 700])
def test_the_rate_of_a_line_is_its_slope_through_gaps(window: int) -> None:
    missing, t = a_gapped_record(4000, 4)
    found = form((RATE, 0.1 * window), 0.02 * t, missing)
    settled = t > 0.1 * window
    assert np.abs(found - 0.02)[settled].max() < 1e-6 * 0.02 * t.max() / (0.1 * window) + 1e-6


def test_time_lines_and_steps_count_the_missing_samples() -> None:
    """Times to float32's digits. A line is that of the interval and the frequency as the model holds them, in float32:
    its phase is kept in integers and does not drift."""
    missing, t = a_gapped_record(3000, 6)
    nothing = np.zeros(t.size)
    assert form((TIME, 0.0), nothing, missing) == pytest.approx(t, rel=2e-7)
    assert (form((STEP, 42.3), nothing, missing) == (t >= 42.3 - 1e-6)).all()
    assert (form((PULSE, 42.3, 77.0), nothing, missing) == ((t >= 42.3 - 1e-6) & (t < 77.0 - 1e-6))).all()
    for tau in (0.7, 42.3, 5000.0):
        assert np.abs(form((TURN_ON, tau), nothing, missing) - np.exp(-t / tau)).max() < 1e-6
    stretch = float(np.float32(0.1)) / 0.1
    turns = 2.0 * np.pi * np.mod(float(np.float32(0.5643)) * t * stretch, 1.0)
    assert np.abs(form((SINE, 0.5643), nothing, missing) - np.sin(turns)).max() < 2e-5
    assert np.abs(form((COSINE, 0.5643), nothing, missing) - np.cos(turns)).max() < 2e-5


def test_a_source_that_cannot_be_is_refused() -> None:
    values = np.zeros(3)
    for source in (
        (8, 1.0),
        (PULSE, 3.0),
        (RATE, 0.0),
        (SINE, -1.0),
        (TURN_ON, 0.0),
        (CHANNEL, float("nan")),
    ):
        with pytest.raises(ValueError, match="cannot be"):
            form(source, values)
