"""The stationary gate: thresholds, false alarms and detections on simulated noise, against closed forms; on real rest.

Rates are held to 4 standard deviations of the count: one test in 16 000 fails by chance, and seeds are fixed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from gated import learning_gate
from numpy.typing import NDArray
from scipy import stats

from selfcal import _library32, _library64
from selfcal.bank.library import Bank
from selfcal.model.file import Model
from selfcal.model.tables import make_tables

from conftest import shared_recording

Samples = NDArray[np.float32]


def make(window: int, false_alarm: float, axes: int, **options: object) -> _library32.Gate:
    """A gate over `axes` axes of sigma 1, all accelerometers unless `rates` says how many come first as gyros."""
    o = {"hold": 2, "settle": 0, "memory": 20, "rates": 0, "sigma": 1.0, **options}
    kinds = [axis < o["rates"] for axis in range(axes)]
    return _library32.Gate(window, false_alarm, o["hold"], o["settle"], o["memory"], [o["sigma"]] * axes, kinds)


def noise(windows: int, window: int, axes: int, seed: int) -> Samples:
    return np.random.default_rng(seed).standard_normal((windows * window, axes)).astype(np.float32)


def decisions(gate: _library32.Gate, samples: Samples, window: int) -> NDArray[np.bool_]:
    """bool[windows]: at rest, as said with each window's last sample."""
    states = np.frombuffer(gate.push(np.ascontiguousarray(samples, dtype=np.float32)), np.uint8)
    return states.reshape(-1, window)[:, -1] == 1


def alarm_rate(rest: NDArray[np.bool_]) -> tuple[float, int]:
    """Share of the windows entered at rest that ended it, and how many those windows were."""
    entered = rest[:-1]
    return float((entered & ~rest[1:]).sum() / entered.sum()), int(entered.sum())


# ------------------------------------------------------------------------------------------------------ known truths


@pytest.mark.parametrize("library", [_library32, _library64])
@pytest.mark.parametrize("axes", [1, 3, 6])
@pytest.mark.parametrize("window", [2, 10, 100, 2000])
@pytest.mark.parametrize("false_alarm", [0.1, 1e-2, 1e-4, 1e-8])
def test_thresholds_are_chi_square(library: object, axes: int, window: int, false_alarm: float) -> None:
    """Against scipy's quantiles; they are handed out as float32."""
    gate = library.Gate(window, false_alarm, 1, 0, 1, [1.0] * axes, [False] * axes)  # type: ignore[attr-defined]
    gate.push(np.zeros((window, axes), np.float32))
    last = gate.last()
    p = float(np.float32(false_alarm)) / 2.0
    assert last["shaken_above"] == pytest.approx(stats.chi2.isf(p, axes * (window - 1)), rel=2e-7)
    assert last["moved_above"] == pytest.approx(stats.chi2.isf(p, axes), rel=2e-7)


@pytest.mark.parametrize(
    ("axes", "window", "false_alarm", "memory"),
    [(6, 50, 0.01, 20), (1, 20, 0.02, 100), (3, 10, 0.1, 1), (6, 100, 0.002, 50), (2, 2, 0.05, 5)],
)
def test_false_alarms_come_at_the_stated_rate(axes: int, window: int, false_alarm: float, memory: int) -> None:
    """On white noise of known sigma: p - p^2/4 a window, by either test alike."""
    gate = make(window, false_alarm, axes, memory=memory)
    rate, windows = alarm_rate(decisions(gate, noise(40_000, window, axes, seed=axes), window))
    expected = false_alarm - false_alarm**2 / 4.0
    sd = math.sqrt(expected / windows)
    last = gate.last()
    print(f"\n{axes} axes, {window} samples: {rate:.5f}, stated {expected:.5f} +- {sd:.5f}")
    assert rate == pytest.approx(expected, abs=4.0 * sd)
    half = false_alarm / 2.0
    assert last["shaken"] / 40_000 == pytest.approx(half, abs=4.0 * math.sqrt(half / 40_000))
    assert last["moved"] / windows == pytest.approx(half, abs=4.0 * math.sqrt(half / windows) + 2.0 * false_alarm**2)


def test_the_rate_holds_for_windows_with_missing_samples() -> None:
    """30 of 50 samples in each window: fewer degrees of freedom, the same rate."""
    gate = make(50, 0.02, 2)
    x = noise(10_000, 30, 2, seed=3).reshape(-1, 30, 2)
    rest = []
    for window in x:
        gate.push(window)
        rest.append(gate.skip(20) == 1)
    rate, windows = alarm_rate(np.array(rest))
    assert gate.last()["shaken_above"] == pytest.approx(stats.chi2.isf(0.01, 2 * 29), rel=1e-6)
    assert rate == pytest.approx(0.0199, abs=4.0 * math.sqrt(0.02 / windows))


@pytest.mark.parametrize("colour", ["bartlett", "line"])
def test_a_coloured_sensor_keeps_the_rate_by_measured_factors(colour: str) -> None:
    """White noise through a Bartlett filter of 4 + 4 taps, and with a line of half the noise's rms beside it. The
    factors are measured on other noise of the kind. Satterthwaite's distribution is not exact in the tail: 10 % is left
    for that beside the counting error. Without factors T1 is off its half of the rate by more than a factor of 3."""
    window, axes, p = 50, 3, 0.01

    def rest_noise(windows: int, seed: int) -> Samples:
        rng = np.random.default_rng(seed)
        white = rng.standard_normal((windows * window + 8, axes))
        taps = np.convolve(np.ones(4), np.ones(4)) / 16.0 if colour == "bartlett" else np.ones(1)
        x = np.stack([np.convolve(white[:, a], taps, "valid")[: windows * window] for a in range(axes)], axis=1)
        if colour == "line":
            phase = np.cumsum(0.2 + 0.02 * rng.standard_normal((windows * window, axes)), axis=0) * 2.0 * np.pi
            x += 0.5 * math.sqrt(2.0) * np.sin(phase)
        return x.astype(np.float32)

    measuring = make(window, 0.0, axes)
    assert decisions(measuring, rest_noise(20_000, 1), window)[5:].all()
    plain, mended = make(window, p, axes), make(window, p, axes)
    for axis in range(axes):
        mended.noise(axis, *measuring.measured(axis))
    x = rest_noise(40_000, 2)
    rate, windows = alarm_rate(decisions(mended, x, window))
    plain.push(x)
    unmended = plain.last()["shaken"] / 40_000
    print(f"\n{colour}: factors {measuring.measured(0)}, rate {rate:.5f}, stated {p:.5f}; T1 unmended {unmended:.3f}")
    assert rate == pytest.approx(p, abs=4.0 * math.sqrt(p / windows) + 0.1 * p)
    assert not p / 6.0 < unmended < p * 1.5


def test_measured_factors_of_white_noise_are_one() -> None:
    gate = make(40, 0.0, 2, sigma=0.5)
    gate.push(noise(20_000, 40, 2, seed=4) * np.float32(0.6))
    for axis in range(2):
        sigma, within, spread, level = gate.measured(axis)
        assert sigma == 0.5
        # standard errors: sqrt(2/(39 * 20000)), sqrt(2/20000) twice (the third moment of chi-square adds little at 39)
        assert within == pytest.approx(1.44, rel=4 * 0.0016)
        assert spread == pytest.approx(1.0, abs=4 * 0.011)
        assert level == pytest.approx(1.44, rel=4 * 0.010)


# --------------------------------------------------------------------------------------------------------- detection


@pytest.mark.parametrize("rate", [0.3, 0.6, 1.0])
def test_power_against_a_slow_rotation(rate: float) -> None:
    """A gyro of sigma 1 begins to turn at `rate` sigma: one window of 50 samples off a level known from 24 is found
    with the probability that non-central chi-square says (noise in T1 adds p/2 to it)."""
    window, p, trials = 50, 0.01, 3000
    gamma = 1.0 / (window * 24)
    shift = rate**2 / (1.0 / window + gamma)
    threshold = stats.chi2.isf(p / 2, 3)
    power = 1.0 - (1.0 - float(stats.ncx2.sf(threshold, 3, shift))) * (1.0 - p / 2)
    found = judged = 0
    x = noise(trials * 25, window, 3, seed=5).reshape(trials, 25 * window, 3)
    for record in x:
        gate = make(window, p, 3, memory=100, rates=3)
        record[24 * window :, 0] += np.float32(rate)
        rest = decisions(gate, record, window)
        if rest[3:24].all():  # the level is that of all 24
            judged += 1
            found += not rest[24]
    sd = math.sqrt(power * (1.0 - power) / judged)
    print(f"\nrotation of {rate} sigma: found {found / judged:.4f}, expected {power:.4f} +- {sd:.4f}, {judged} trials")
    assert judged > trials / 2
    assert found / judged == pytest.approx(power, abs=4.0 * sd + 1e-9)


def test_a_steady_rotation_is_motion_until_it_ends() -> None:
    """Constant 1 sigma on a gyro for 100 windows: its own scatter says rest, its level says motion all along."""
    window = 50
    x = noise(300, window, 3, seed=6)
    x[100 * window : 200 * window, 2] += 1.0
    rest = decisions(make(window, 1e-6, 3, rates=3), x, window)
    assert rest[3:100].all()
    assert not rest[100:200].any()
    assert rest[204:].all()  # the window after, the first quiet one, hold = 2


def test_a_gyro_s_new_level_is_believed_in_the_end() -> None:
    """settle = 30 windows at one new level: a bias that moved while the sensor did. settle = 0: never."""
    window = 50
    x = noise(200, window, 3, seed=7)
    x[100 * window :, 0] += 1.0
    rest = decisions(make(window, 1e-6, 3, rates=3, settle=30), x, window)
    assert not rest[100:131].any()
    assert rest[131:].all()  # 100 raised the alarm, 101 is the first quiet one, 30 more
    assert not decisions(make(window, 1e-6, 3, rates=3), x, window)[100:].any()


def test_a_tilt_is_motion_and_then_a_new_rest() -> None:
    """An accelerometer tilts in one window and stays so."""
    window = 50
    x = noise(200, window, 3, seed=8)
    x[:, 2] += 9.8 / 0.01  # in units of the noise: gravity at 0.01 m/s^2
    x[100 * window :, 0] += 2.0
    x[100 * window :, 2] -= 2.0
    rest = decisions(make(window, 1e-6, 3), x, window)
    assert rest[3:100].all()
    assert not rest[100:103].any()
    assert rest[103:].all()


def test_a_slow_tilt_is_found_by_its_distance() -> None:
    """0.04 sigma of tilt a window of 50 samples, 0.3 of a window mean's noise and so no step to be seen: the level at
    rest lags behind by up to 20 windows, 0.8 sigma or 5.7 of that noise, which few windows in a row survive."""
    window = 50
    x = noise(400, window, 3, seed=9)
    x[100 * window :, 1] += np.arange(300 * window) * np.float32(0.04 / window)
    rest = decisions(make(window, 1e-3, 3, memory=20), x, window)
    assert rest[3:100].mean() > 0.97
    assert rest[150:].mean() < 0.9


def quiet_sensor(t: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Six axes of an ADIS16405 at rest, deg/s and m/s^2, at the times t [n]."""
    sigma = np.sqrt(102.4) * np.repeat([0.04, 0.006], 3)
    return np.random.default_rng(seed).standard_normal((len(t), 6)) * sigma + [0.0, 0.0, 0.0, 0.0, 0.0, 9.8]


def at_rest(readings: NDArray[np.float64], lost: Callable[[int], bool] = lambda window: False) -> NDArray[np.bool_]:
    """By the default model's gate, which learns its noise: of each window of 0.5 s, of six axes at 102.4 Hz; `lost`:
    which of them are missing."""
    model = Model.load()
    gate = learning_gate(model, make_tables(model, 102.4, tuple(model.axes)))
    windows = len(readings) // gate.window
    samples = readings[: windows * gate.window].astype(np.float32).reshape(windows, gate.window, -1)
    return np.array(
        [
            bool(gate.gate.skip(gate.window)) if lost(index) else gate.push(np.ascontiguousarray(window))[-1]
            for index, window in enumerate(samples)
        ]
    )


@pytest.mark.parametrize("rate", [0.05, 0.1, 0.2])
def test_a_slow_tilt_is_motion_to_its_end(rate: float) -> None:
    """Of a minute at so many deg/s about x 8 s at most are taken for rest, until it is noticed: at 0.05 deg/s ay is off
    by 0.07 m/s^2 by then, 8 sd of a window. On the way gravity does not stay where it was for `hold` windows."""
    t = np.arange(0.0, 300.0, 1.0 / 102.4)
    readings = quiet_sensor(t, 8)
    readings[:, 0] += np.where((t > 120.0) & (t < 180.0), rate, 0.0)
    angle = np.radians(np.clip(t - 120.0, 0.0, 60.0) * rate)
    readings[:, 4] += 9.8 * np.sin(angle)
    readings[:, 5] += 9.8 * (np.cos(angle) - 1.0)
    rest = at_rest(readings)
    assert rest[240:360].sum() <= 16
    assert rest[420:].all()


def test_noise_that_grows_is_believed_in_the_end() -> None:
    """A third more than was learnt, within 10 minutes, and still half of what the model says there may be: not motion
    for ever."""
    t = np.arange(0.0, 2400.0, 1.0 / 102.4)
    readings = quiet_sensor(t, 9)
    readings = (readings - readings.mean(axis=0)) * (1.0 + np.clip((t - 120.0) / 600.0, 0.0, 1.0) / 3.0)[:, None]
    rest = at_rest(readings)
    assert rest[30:240].mean() > 0.95
    assert rest[2880:].mean() > 0.95


@pytest.mark.parametrize(("half_width", "most"), [(0.5, 0.0), (0.25, 0.1)])
def test_a_slow_swing_is_no_level(half_width: float, most: float) -> None:
    """Half an hour of yaw to and fro, deg/s, in 20 s, after 5 minutes of rest. A window's mean has a noise of 0.057
    deg/s: six axes are off by 5.4 times that once in 20 000, so what swings by 0.25 is told by many windows, after it
    got in."""
    t = np.arange(0.0, 2400.0, 1.0 / 102.4)
    readings = quiet_sensor(t, 10)
    readings[:, 2] += np.where((t > 300.0) & (t < 2100.0), half_width * np.sin(2.0 * np.pi * t / 20.0), 0.0)
    rest = at_rest(readings)
    assert rest[30:600].mean() > 0.97
    print(f"\n{half_width} deg/s: {100 * rest[630:4200].mean():.0f} % taken for rest")
    assert rest[630:4200].mean() <= most
    assert rest[4460:].all()


@pytest.mark.parametrize("change", ["level", "noise"])
def test_what_has_changed_is_believed_over_gaps(change: str) -> None:
    """A window of each minute lacks its samples, as around a save: the 240 windows are counted on."""
    t = np.arange(0.0, 1200.0, 1.0 / 102.4)
    readings = quiet_sensor(t, 12)
    later = t > 400.0
    if change == "level":
        readings[later, 2] += 1.0
    else:
        readings[later] = readings.mean(axis=0) + 1.8 * (readings - readings.mean(axis=0))[later]
    rest = at_rest(readings, lost=lambda window: window % 120 == 60)
    seen = np.arange(len(rest)) % 120 != 60
    change_at = round(400.0 * 102.4 / 51)
    assert rest[30:change_at][seen[30:change_at]].mean() > 0.97
    assert not rest[change_at + 2 : change_at + 240].any()
    assert rest[change_at + 245 :][seen[change_at + 245 :]].all()  # with its end, so is the window after a blind one


def test_a_shock_within_a_window() -> None:
    """One period of 10 samples and 5 sigma, mean 0: seen by the scatter alone."""
    window = 50
    x = noise(200, window, 6, seed=10)
    x[5020:5030, 3] += (5.0 * np.sin(np.arange(10) * 2 * np.pi / 10)).astype(np.float32)
    gate = make(window, 1e-4, 6, rates=3)
    rest = decisions(gate, x, window)
    assert rest[3:100].all()
    assert not rest[100]
    assert gate.last()["shaken"] >= 1


def test_the_bank_gets_no_sample_of_a_window_with_motion() -> None:
    """Gate and bank in step, a sample at a time, as selfcal_push_moving() says: every sum is that of a bank told
    that the intervals with a moving window are missing. Shocks lie at all places of the windows and intervals."""
    window, block = 10, 50
    tables = make_tables(Model.load(), float(block), ("gx",), bank_rate_hz=1.0)
    sigma = 0.1
    x = noise(400, window, 1, seed=14) * np.float32(sigma)
    for start in (701, 1249, 1500, 2308, 2999, 3344):
        x[start] += 30.0 * sigma
    gate, bank, told = make(window, 1e-6, 1, sigma=sigma), Bank(tables), Bank(tables)
    before, rest = 0, []
    for sample in x:
        now = gate.push(sample[None, :])[0]
        if before and now:
            bank.push(sample[None, :])
        else:
            bank.raw.push_moving(sample[None, :])
        rest.append(bool(before and now))
        before = now
    first = rest.index(True)
    assert first % window == 0
    assert gate.last()["alarms"] == 6
    for start in range(first, x.shape[0], block):
        interval = slice(start, start + block)
        if all(rest[interval]):
            told.push(x[interval])
        else:
            told.raw.skip(len(x[interval]))
    assert bank.raw.count == told.raw.count > 50
    assert repr([bank.raw.node(0, j) for j in range(bank.raw.nodes)]) == repr(
        [told.raw.node(0, j) for j in range(told.raw.nodes)]
    )


# --------------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3e38])
def test_what_is_no_number_is_motion_at_once(bad: float) -> None:
    window = 50
    x = noise(100, window, 2, seed=11)
    x[50 * window + 10, 1] = bad
    states = np.frombuffer((gate := make(window, 1e-6, 2)).push(x), np.uint8)
    assert states[50 * window + 9] == 1
    assert not states[50 * window + 10 : 52 * window - 1].any()  # that window; the next is one of the rest of before
    assert states[52 * window - 1 :].all()
    assert gate.last()["blind"] == 1


def test_windows_keep_their_grid_over_gaps() -> None:
    window = 50
    gate = make(window, 1e-6, 1)
    x = noise(40, window, 1, seed=12)
    assert decisions(gate, x[: 10 * window], window)[-1]
    assert gate.skip(20) == 1  # less than half of the window
    assert np.frombuffer(gate.push(x[:30]), np.uint8).all()
    assert gate.skip(26) == 1
    assert not np.frombuffer(gate.push(x[:24]), np.uint8)[-1]  # 24 of 50 are too few to see rest
    assert gate.last()["blind"] == 1
    assert gate.skip(10**12 * window) == 0
    assert gate.last()["blind"] == 1 + 10**12
    assert decisions(gate, x[: 3 * window], window).tolist() == [True, True, True]  # the rest of before
    assert gate.skip(window) == 0
    assert decisions(gate, x[: 4 * window] + 2.0, window).tolist() == [False, False, False, True]  # another, hold = 2
    assert gate.last()["alarms"] == 1


def test_an_axis_can_be_left_out() -> None:
    """Infinite sigma: a dead axis may read what it likes; thresholds are those of the others. None left: no rest."""
    window = 50
    gate = make(window, 0.01, 3)
    gate.noise(1, np.inf, 1.0, 1.0, 1.0)
    x = noise(2000, window, 3, seed=13)
    x[:, 1] = np.nan
    rate, windows = alarm_rate(decisions(gate, x, window))
    assert gate.last()["moved_above"] == pytest.approx(stats.chi2.isf(0.005, 2), rel=1e-6)
    assert rate == pytest.approx(0.01, abs=4.0 * math.sqrt(0.01 / windows))
    for axis in (0, 2):
        gate.noise(axis, np.inf, 1.0, 1.0, 1.0)
    assert not decisions(gate, x, window)[1:].any()


@pytest.mark.parametrize(
    "arguments",
    [
        (1, 0.01, 1, 0, 1, [1.0], [True]),
        (50, -0.01, 1, 0, 1, [1.0], [True]),
        (50, 0.2, 1, 0, 1, [1.0], [True]),
        (50, math.nan, 1, 0, 1, [1.0], [True]),
        (50, 0.01, 0, 0, 1, [1.0], [True]),
        (50, 0.01, 1, 0, 0, [1.0], [True]),
        (50, 0.01, 1, 0, 1, [0.0], [True]),
        (50, 0.01, 1, 0, 1, [math.nan], [True]),
        (50, 0.01, 1, 0, 1, [], []),
    ],
)
def test_bad_configurations_are_refused(arguments: tuple[object, ...]) -> None:
    with pytest.raises(ValueError, match="argument out of range"):
        _library32.Gate(*arguments)


def test_bad_noise_is_refused() -> None:
    gate = make(50, 0.01, 2)
    for bad in ((2, 1, 1, 1, 1), (0, 0, 1, 1, 1), (0, 1, -1, 1, 1), (0, 1, 1, math.inf, 1), (0, 1, 1, 1, math.nan)):
        with pytest.raises(ValueError, match="argument out of range"):
            gate.noise(*bad)
    with pytest.raises(ValueError, match="too few windows"):
        gate.measured(0)


# --------------------------------------------------------------------------------------------------------- real rest

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
WINDOW = 50
#: Shocks of run 4 (samples), known from looking at it.
SHOCKS = ((404_537, 404_621), (514_615, 514_660))


def real(name: str) -> Samples:
    recording = shared_recording(name)
    units = {"g": "deg/s", "a": "m/s^2"}
    return np.column_stack([recording.in_unit(axis, units[axis[0]]) for axis in AXES]).astype(np.float32)


def calibrated(x: Samples, axes: range, false_alarm: float) -> _library32.Gate:
    """A gate for `axes` with sigma from neighbouring differences and factors measured on `x`."""
    sigma = [float(np.std(np.diff(x[:, axis]))) / math.sqrt(2.0) for axis in axes]
    kinds = [axis < 3 for axis in axes]
    measuring = _library32.Gate(WINDOW, 0.0, 2, 0, 20, sigma, kinds)
    measuring.push(np.ascontiguousarray(x[:, axes]))
    gate = _library32.Gate(WINDOW, false_alarm, 2, 240, 20, sigma, kinds)
    for k in range(len(axes)):
        gate.noise(k, *measuring.measured(k))
    return gate


@pytest.mark.parametrize("name", ["adis16405_run1.npz", "adis16405_run2.npz"])
def test_rest_of_a_real_sensor(name: str) -> None:
    """Two hours and three quarters at rest, the factors measured on 50 minutes of them. Gyros: the stated rate, within
    half of it beside the counting error. Accelerometers feel the building besides: at most twenty times the rate."""
    x = real(name)
    quiet = x[400_000:700_000]
    for axes, p, most in ((range(3), 1e-2, 1.5), (range(3), 1e-3, 1.5), (range(6), 1e-3, 20.0)):
        gate = calibrated(quiet, axes, p)
        rest = decisions(gate, x[:, axes], WINDOW)
        rate, windows = alarm_rate(rest)
        print(f"\n{name}, {len(axes)} axes: rate {rate:.5f}, stated {p:g}; {1 - rest.mean():.4f} of windows flagged")
        assert rate < most * p + 4.0 * math.sqrt(p / windows)
        assert axes == range(6) or rate > p / 1.5 - 4.0 * math.sqrt(p / windows)


@pytest.mark.parametrize("axes", [range(3), range(3, 6), range(6)], ids=["gyros", "accelerometers", "both"])
def test_the_shocks_of_run_4_are_found(axes: range) -> None:
    """Every window of both by the accelerometers; the gyros' range in the second's first window is that of rest."""
    x = real("adis16405_run4.npz")
    gate = calibrated(x[100_000:400_000], axes, 1e-4)
    rest = decisions(gate, x[:, axes], WINDOW)
    print(f"\nrun 4: {1 - rest.mean():.4f} of all windows flagged, {gate.last()['alarms']} alarms")
    for start, end in SHOCKS:
        assert not rest[end // WINDOW]
        assert axes == range(3) or not rest[start // WINDOW : end // WINDOW + 1].any()
        assert rest[start // WINDOW - 40 : start // WINDOW].mean() > 0.8
        assert rest[end // WINDOW + 1 : end // WINDOW + 41].mean() > 0.8
    assert 1.0 - rest.mean() < 0.01
