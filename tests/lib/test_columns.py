"""Values of regressors, formed by the library sample by sample (lib/columns.c), against their definitions in numpy.

Windows of up to SELFCAL_COLUMN_BINS samples (32) have a bin a sample and are exact but for float32. Longer ones are
held in bins: then a mean is off by what the channel moves within the oldest bin.
"""

import numpy as np
import pytest
from scipy.signal import oaconvolve

from selfcal import _library32

TIME, CHANNEL, RATE, SINE, COSINE, STEP, TURN_ON, PULSE, LAG, SLOPE, SQUARE, CUBE = range(12)


def form(
    source: tuple[float, ...],
    values: np.ndarray,
    missing: np.ndarray | None = None,
    dt: float = 0.1,
    powered: int = 0,
) -> np.ndarray:
    """[n] of one source over one channel [n]."""
    kind, number, second = (*source, 0.0)[:3]
    gaps = np.zeros(values.size, np.uint64) if missing is None else missing.astype(np.uint64)
    rows = np.ascontiguousarray(values[:, None], np.float32)
    return np.asarray(_library32.form([(int(kind), 0, number, second)], dt, rows, gaps, powered)[:, 0], float)


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


def low_pass(values: np.ndarray, missing: np.ndarray, tau: float, dt: float) -> np.ndarray:
    """[n] sample by sample on the full grid, in double: on a straight line between two rows."""
    out, x, last = np.empty(values.size), values[0], values[0]
    gain = -np.expm1(-dt / tau)
    for i, value in enumerate(values):
        steps = int(missing[i]) + 1
        for part in np.arange(1, steps + 1) / steps if i else []:
            x += gain * (last + part * (value - last) - x)
        out[i], last = x, value
    return out


@pytest.mark.parametrize(("tau", "dt"), [(0.02, 0.1), (3.0, 0.1), (900.0, 0.1), (5000.0, 0.01)])
@pytest.mark.parametrize("gaps", [False, True])
def test_a_lag_is_a_low_pass(tau: float, dt: float, gaps: bool) -> None:
    """float32 at 25 is 2e-6; the slowest low pass takes a share of 2e-6 of each step, on a staircase and on noise."""
    n = 3000
    missing = a_gapped_record(n, 8)[0] if gaps else np.zeros(n, np.int64)
    missing = np.minimum(missing, 5000)
    for drawn in (walk(n, 9), 25.0 + 0.14 * np.floor(np.arange(n) / 200.0), walk(n, 10) + 0.5 * (np.arange(n) % 2)):
        values = drawn.astype(np.float32).astype(float)
        assert np.abs(form((LAG, tau), values, missing, dt) - low_pass(values, missing, tau, dt)).max() < 1e-5


def test_a_slow_lag_does_not_stop() -> None:
    """An hour at 100 Hz, 5000 s: a step of 5 is followed by a share of 1e-6 of it a sample."""
    values = np.where(np.arange(360_000) < 10, 25.0, 30.0)
    t = 0.01 * np.maximum(np.arange(values.size) - 9.0, 0.0)
    assert np.abs(form((LAG, 5000.0), values, dt=0.01) - (30.0 - 5.0 * np.exp(-t / 5000.0))).max() < 1e-5


@pytest.mark.parametrize("window", [2, 7, 32])
@pytest.mark.parametrize("gaps", [False, True])
def test_a_short_slope_is_that_of_the_line_that_fits_best(window: int, gaps: bool) -> None:
    """Against np.polyfit() on the full grid, at rest before the first value and behind a gap as long as the window."""
    n, dt = 600, 0.1
    missing, t = a_gapped_record(n, 11) if gaps else (np.zeros(n, np.int64), dt * np.arange(n))
    values = walk(n, 12)
    begins = np.maximum.accumulate(np.where(missing >= window, np.arange(n), 0))
    found = form((SLOPE, dt * window), values, missing, dt)
    age = dt * np.arange(1 - window, 1)
    for i in range(n):
        rows = slice(begins[i], i + 1)
        assert found[i] == pytest.approx(np.polyfit(age, np.interp(t[i] + age, t[rows], values[rows]), 1)[0], abs=1e-3)
    assert np.abs(found).max() > 0.02


@pytest.mark.parametrize("window", [33, 100, 600, 5000])
def test_a_long_slope_is_that_of_its_bins(window: int) -> None:
    """A straight line's is exact. That of a parabola is the line's at half the window back: bins change it by their
    share, squared, of what it gains over the window. Noise: the bin at the edge of the window, at most half a bin out,
    is another one in 3/4 of a bin's share of the best slope's variance; the steps of the weights are the rest of 1."""
    n, dt = 20 * window, 0.1
    t = dt * np.arange(n)
    line = form((SLOPE, dt * window), 25.0 + 0.02 * t, dt=dt)[window:]
    assert np.abs(line - 0.02).max() < 1e-6 * 25.0 / (dt * window) + 2e-7
    bent = form((SLOPE, dt * window), t**2 / t[-1], dt=dt)[window:]
    middle = 2.0 * (t[window:] - 0.5 * dt * (window - 1)) / t[-1]
    assert np.abs(bent - middle).max() < (2.0 / 32.0) ** 2 * window / n + 1e-5
    noise = np.random.default_rng(13).normal(size=n)
    spread = form((SLOPE, dt * window), noise, dt=dt)[window:]
    age = dt * (np.arange(window) - 0.5 * (window - 1))
    best = oaconvolve(noise, age[::-1] / (age @ age), mode="valid")[1:]
    assert np.var(spread - best) < -(-window // 32) / window * np.var(best)


@pytest.mark.parametrize("mean", [1, 5])
def test_powers_are_of_the_mean_about_the_reference(mean: int) -> None:
    values = walk(300, 14)
    about = mean_of_last(values, mean) - 24.0
    second = 0.1 * mean if mean > 1 else 0.0
    assert form((SQUARE, 24.0, second), values) == pytest.approx(about**2, abs=1e-4)
    assert form((CUBE, 24.0, second), values) == pytest.approx(about**3, abs=1e-4)
    late = low_pass(mean_of_last(values, mean), np.zeros(300, int), 4.0, 0.1)
    assert form((LAG, 4.0, second), values) == pytest.approx(late, abs=1e-5)


@pytest.mark.parametrize("source", [(CHANNEL, 0.5), (RATE, 0.5), (LAG, 4.0), (SLOPE, 0.5), (SQUARE, 20.0, 0.5)])
def test_a_column_begins_at_the_first_value_that_is_one(source: tuple[float, ...]) -> None:
    values = np.concatenate([[np.nan, np.nan], walk(60, 15)])
    found = form(source, values)
    assert np.isnan(found[:2]).all()
    assert found[2:] == pytest.approx(form(source, values[2:]))


def test_time_lines_and_steps_count_the_missing_samples() -> None:
    """Times to float32's digits. A line is that of the interval and the frequency as the model holds them, in float32:
    its phase is kept in integers and does not drift."""
    missing, t = a_gapped_record(3000, 6)
    nothing = np.zeros(t.size)
    assert form((TIME, 0.0), nothing, missing) == pytest.approx(t, rel=2e-7)
    assert (form((STEP, 42.3), nothing, missing) == (t >= 42.3 - 1e-6)).all()
    assert (form((PULSE, 42.3, 77.0), nothing, missing) == ((t >= 42.3 - 1e-6) & (t < 77.0 - 1e-6))).all()
    for tau in (0.7, 42.3, 5000.0):
        for powered in (0, 37, 10**6):
            left = np.exp(-(t + 0.1 * powered) / tau)
            assert np.abs(form((TURN_ON, tau), nothing, missing, powered=powered) - left).max() < 1e-6
    stretch = float(np.float32(0.1)) / 0.1
    turns = 2.0 * np.pi * np.mod(float(np.float32(0.5643)) * t * stretch, 1.0)
    assert np.abs(form((SINE, 0.5643), nothing, missing) - np.sin(turns)).max() < 2e-5
    assert np.abs(form((COSINE, 0.5643), nothing, missing) - np.cos(turns)).max() < 2e-5


def test_a_source_that_cannot_be_is_refused() -> None:
    values = np.zeros(3)
    for source in (
        (12, 1.0),
        (LAG, 0.0),
        (LAG, 5.0, -1.0),
        (SLOPE, 0.0),
        (SQUARE, float("inf")),
        (CUBE, 0.0, float("nan")),
        (PULSE, 3.0),
        (RATE, 0.0),
        (SINE, -1.0),
        (TURN_ON, 0.0),
        (CHANNEL, float("nan")),
    ):
        with pytest.raises(ValueError, match="cannot be"):
            form(source, values)
