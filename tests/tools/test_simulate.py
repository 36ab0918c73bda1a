"""The recording simulator against closed forms of what it claims to make.

Where a figure is random its tolerance is a multiple of its own standard error, taken from the scatter over an ensemble
or from the normal theory; 4.5 of them leave a wrong alarm 7e-6, and the seeds are fixed.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from selfcal import _reference
from selfcal.base.errors import UserError
from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.simulate import show
from selfcal.logs import recording
from selfcal.model.file import DEFAULT, Model
from selfcal.model.laws import NAMED
from selfcal.verbs.simulate import simulate

from conftest import run

DATA = Path(__file__).parents[1] / "data"
SIGMAS = 4.5


def axis(law: str = "constant", **fields: float) -> _reference.Axis:
    made = _reference.Axis()
    made.law = NAMED[law].as_tuple
    for name, value in fields.items():
        setattr(made, {"K": "drift", "sigma_m": "drift", "B": "drift", "alpha": "second"}.get(name, name), value)
    return made


def scene(samples: int, rate_hz: float = 1.0, seed: int = 1, **fields: int) -> _reference.Scene:
    made = _reference.Scene()
    made.samples, made.rate_hz, made.seed = samples, rate_hz, seed
    for name, value in fields.items():
        setattr(made, name, value)
    return made


def record(one: _reference.Axis, a_scene: _reference.Scene) -> np.ndarray:
    return _reference.simulate(a_scene, [one])[0][0]


def allan_variance(y: np.ndarray, m: int) -> float:
    """Non-overlapping, clusters of m samples (IEEE Std 952 annex C)."""
    means = y[: len(y) // m * m].reshape(-1, m).mean(axis=1)
    return float(0.5 * np.mean(np.diff(means) ** 2))


def ensemble(one: _reference.Axis, samples: int, rate_hz: float, m: int, records: int = 60, **fields: int) -> tuple:
    """Mean Allan variance over `records` records and its standard error."""
    values = [allan_variance(record(one, scene(samples, rate_hz, seed, **fields)), m) for seed in range(records)]
    return np.mean(values), np.std(values, ddof=1) / np.sqrt(records)


def test_generator_gives_the_published_numbers() -> None:
    """SplitMix64 in Python integers, from its published constants: the C++ generator is that, bit for bit."""
    mask, golden = 2**64 - 1, 0x9E3779B97F4A7C15

    def mix(z: int) -> int:
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
        return z ^ (z >> 31)

    state = mix((5 + golden) & mask) ^ mix((mix((9 + golden) & mask) + golden) & mask)
    random = _reference.Random(5, 9)
    for _ in range(10):
        state = (state + golden) & mask
        assert random.uniform() == ((mix(state) >> 11) + 0.5) * 2.0**-53


def test_generator_is_uniform_and_normal() -> None:
    random = _reference.Random(1, 0)
    assert stats.kstest([random.uniform() for _ in range(20_000)], "uniform").pvalue > 1e-4
    assert stats.kstest([random.normal() for _ in range(20_000)], "norm").pvalue > 1e-4


def test_white_noise_has_density_n_at_every_rate() -> None:
    for rate_hz in (1.0, 10.0, 100.0):
        n = 20_000
        variance = record(axis(N=0.3, bias=2.0), scene(n, rate_hz)).var(ddof=1)
        low, high = stats.chi2(n - 1).ppf([1e-4, 1 - 1e-4]) / (n - 1)
        assert low < variance / (0.3**2 * rate_hz) < high


@pytest.mark.parametrize(("taps", "block"), [(2, 1), (4, 1), (4, 8)])
def test_bartlett_filter_correlates_neighbours_as_two_boxcars_do(taps: int, block: int) -> None:
    """Autocovariance of white noise through three boxcars in a row (two of the filter, the block mean)."""
    n, rate_hz = 400_000, 10.0
    y = record(axis(N=0.3), scene(n, rate_hz, filter_taps=taps, block=block))
    response = np.convolve(np.convolve(np.ones(taps) / taps, np.ones(taps) / taps), np.ones(block) / block)
    white = 0.3**2 * rate_hz * block
    full = white * np.correlate(response, response, "full")[len(response) - 1 :]
    theory = np.zeros(12)
    theory[: len(full[::block])] = full[::block]
    for lag in range(6):
        products = y[: n - lag] * y[lag:]
        # Bartlett's formula for the variance of a sample autocovariance of a normal sequence.
        k = np.arange(-11, 12)
        gamma = lambda j: np.where(np.abs(j) < 12, theory[np.minimum(np.abs(j), 11)], 0.0)  # noqa: E731
        error = np.sqrt((gamma(k) ** 2 + gamma(k + lag) * gamma(k - lag)).sum() / n)
        assert products.mean() == pytest.approx(theory[lag], abs=SIGMAS * error)


def test_bartlett_filter_leaves_the_density_at_low_frequency() -> None:
    """Unity gain at zero frequency: Allan variance N^2 / tau at tau = 100 s, less 0.1 % for the edges of the
    clusters."""
    mean, error = ensemble(axis(N=0.3), 20_000, 10.0, 1000, filter_taps=2, block=3)
    assert mean == pytest.approx(0.3**2 / 100.0, abs=SIGMAS * error + 2e-3 * 0.3**2 / 100.0)


@pytest.mark.parametrize("rate_hz", [2.0, 20.0])
def test_random_walk_allan_variance_is_k2_tau_over_3(rate_hz: float) -> None:
    """Closed form in continuous time; sampled every dt its relative excess is (dt / tau)^2 / 2: at most 6.4e-4 here."""
    tau = 14.0
    mean, error = ensemble(axis("random_walk", K=0.02), int(2000 * rate_hz), rate_hz, int(tau * rate_hz))
    theory = 0.02**2 * tau / 3.0
    assert error < 0.05 * theory
    assert mean == pytest.approx(theory, abs=SIGMAS * error + 6.4e-4 * theory)


def test_random_walk_starts_from_zero() -> None:
    """x_0 = 0, one step before the first sample: its variance there is K^2 dt, a hundred samples on 101 times that."""
    y = np.array([record(axis("random_walk", K=0.5), scene(101, 4.0, seed)) for seed in range(2000)])
    low, high = stats.chi2(2000).ppf([1e-4, 1 - 1e-4]) / 2000
    assert low < (y[:, 0] ** 2).mean() / (0.25 / 4.0) < high
    assert low < (y[:, -1] ** 2).mean() / (101 * 0.25 / 4.0) < high


@pytest.mark.parametrize("rate_hz", [2.0, 20.0])
def test_gauss_markov_allan_variance(rate_hz: float) -> None:
    """IEEE Std 952 annex C: (2 sigma_m^2 T/tau) (1 - T/(2 tau) (3 - 4 e^(-tau/T) + e^(-2 tau/T))), T = 1/alpha."""
    tau, sigma_m, alpha = 14.0, 0.3, 0.1
    mean, error = ensemble(
        axis("gauss_markov", sigma_m=sigma_m, alpha=alpha), int(2000 * rate_hz), rate_hz, int(tau * rate_hz)
    )
    x = 1.0 / (alpha * tau)
    theory = 2 * sigma_m**2 * x * (1 - x / 2 * (3 - 4 * np.exp(-1 / x) + np.exp(-2 / x)))
    assert error < 0.05 * theory
    # Sampling every dt against averaging in continuous time: below 2 (dt / tau)^2, as for the random walk.
    assert mean == pytest.approx(theory, abs=SIGMAS * error + 2 / (tau * rate_hz) ** 2 * theory)


def test_gauss_markov_is_stationary_from_the_first_sample() -> None:
    sigma_m, alpha, records = 0.7, 0.2, 2000
    one = axis("gauss_markov", sigma_m=sigma_m, alpha=alpha)
    y = np.array([record(one, scene(60, 2.0, seed)) for seed in range(records)])
    low, high = stats.chi2(records).ppf([1e-4, 1 - 1e-4]) / records
    for i in (0, 1, 59):
        assert low < (y[:, i] ** 2).mean() / sigma_m**2 < high
    # Correlation over 10 samples, 5 s: e^(-alpha tau), within Fisher's standard error.
    got = np.corrcoef(y[:, 0], y[:, 10])[0, 1]
    assert np.arctanh(got) == pytest.approx(np.arctanh(np.exp(-1.0)), abs=SIGMAS / np.sqrt(records - 3))


def test_bias_now_is_bias_plus_drift_at_the_last_sample() -> None:
    one = axis("random_walk", bias=1.5, K=0.3)
    values, _, _, _, bias_now = _reference.simulate(scene(100), [one])
    assert bias_now[0] == values[0, -1]


def test_readings_are_on_the_lattice_and_within_range() -> None:
    y = record(axis(N=1.0, bias=0.2, lsb=0.05, range=1.5), scene(5000))
    counts = y / 0.05
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
    assert y.max() == pytest.approx(1.5, abs=1e-12) and y.min() == pytest.approx(-1.5, abs=1e-12)
    assert 0.05 < np.mean(y > 1.49) < 0.2  # P(N(0.2, 1) > 1.475) = 0.10


def difference(a_scene: _reference.Scene, **fields: float) -> tuple[np.ndarray, np.ndarray]:
    """What an effect adds to a recording, and its time."""
    plain = {"N": 0.1, "K": 0.01, "bias": 0.3}
    return record(axis("random_walk", **plain, **fields), a_scene) - record(
        axis("random_walk", **plain), a_scene
    ), np.arange(a_scene.samples) / a_scene.rate_hz


def test_added_effects_are_what_they_say_and_leave_the_rest_as_it_was() -> None:
    """To rounding: everything else of the recording is the same to the last bit."""
    a_scene = scene(1000, 5.0)
    got, t = difference(a_scene, ramp_slope=0.02)
    np.testing.assert_allclose(got, 0.02 * t, atol=1e-12)
    got, t = difference(a_scene, step_time_s=77.0, step_amplitude=-0.4)
    np.testing.assert_allclose(got, np.where(t >= 77.0, -0.4, 0.0), atol=1e-12)
    got, t = difference(a_scene, periodic_frequency_hz=0.31, periodic_amplitude=0.2)
    np.testing.assert_allclose(got, 0.2 * np.sin(2 * np.pi * 0.31 * t), atol=1e-12)


def test_temperature_and_supply_enter_by_their_coefficients() -> None:
    """The channels are read on their lattices, the effect follows the true curves: half an LSB on each reading."""
    a_scene = scene(3000, 1.0)
    _, temperature, supply, _, _ = _reference.simulate(a_scene, [axis()])
    got, _ = difference(a_scene, temperature_coefficient=2.0)
    assert np.ptp(temperature) > 4.0
    assert np.abs(got - 2.0 * (temperature - temperature[0])).max() <= 2.0 * _reference.TEMPERATURE_LSB * (1 + 1e-9)
    got, _ = difference(a_scene, supply_coefficient=3.0)
    assert np.ptp(supply) > 0.01
    assert np.abs(got - 3.0 * (supply - 5.0)).max() <= 3.0 * _reference.SUPPLY_LSB / 2 * (1 + 1e-9)


def test_cross_axis_adds_the_other_axis() -> None:
    other = axis("random_walk", N=0.2, K=0.1, bias=5.0)
    plain = _reference.simulate(scene(500), [axis(N=0.1), other])[0]
    mixed = _reference.simulate(scene(500), [axis(N=0.1, cross_axis=1, cross_coefficient=0.25), other])[0]
    np.testing.assert_allclose(mixed[0] - plain[0], 0.25 * (plain[1] - 5.0), atol=1e-12)
    np.testing.assert_array_equal(mixed[1], plain[1])


def test_noise_effects() -> None:
    n = 40_000
    plain, coloured = record(axis(N=1.0), scene(n)), record(axis(N=1.0, noise_lag1=0.6), scene(n))
    # First-order autoregression: correlation 0.6^lag within the standard error of white-noise theory at n, 1/sqrt(n);
    # level at low frequency unchanged.
    for lag in (1, 2, 3):
        got = np.corrcoef(coloured[:-lag], coloured[lag:])[0, 1]
        assert got == pytest.approx(0.6**lag, abs=SIGMAS * 2 / np.sqrt(n))
    blocks = coloured.reshape(-1, 200).mean(axis=1), plain.reshape(-1, 200).mean(axis=1)
    assert np.std(blocks[0] - blocks[1]) < 0.15 * np.std(blocks[1])  # only the 1.5 samples at each block's ends differ

    changed = record(axis(N=1.0, variance_time_s=n / 2, noise_ratio=3.0), scene(n))
    np.testing.assert_array_equal(changed[: n // 2], plain[: n // 2])
    np.testing.assert_allclose(changed[n // 2 :], 3.0 * plain[n // 2 :], rtol=1e-12)
    until = record(axis(N=1.0, variance_time_s=n / 2, variance_duration_s=n / 8, noise_ratio=3.0), scene(n))
    np.testing.assert_array_equal(until, np.where(np.arange(n) < 5 * n // 8, changed, plain))

    hit = record(axis(N=1.0, outlier_fraction=0.01), scene(n)) - plain
    count = np.count_nonzero(hit)
    assert stats.binom(n, 0.01).ppf(1e-5) < count < stats.binom(n, 0.01).ppf(1 - 1e-5)
    assert np.abs(hit[hit != 0.0]).min() > 10.0 and np.abs(hit).max() < 20.0


def test_flicker_has_its_allan_plateau() -> None:
    """Allan deviation sqrt(2 ln 2 / pi) B = 0.664 B (IEEE Std 952) over a decade; the sum of terms ripples by 2 %."""
    for m in (10, 30, 100):
        mean, error = ensemble(axis(flicker_B=0.2), 4000, 2.0, m, records=40)
        theory = 2 * np.log(2) / np.pi * 0.2**2
        assert error < 0.1 * theory
        assert mean == pytest.approx(theory, abs=SIGMAS * error + 0.02 * theory)


def test_motion_is_common_to_all_axes() -> None:
    a_scene = scene(20_000, 10.0, motion_intervals=4)
    values = _reference.simulate(a_scene, [axis(motion_amplitude=1.0), axis(motion_amplitude=1.0)])[0]
    moving = values != 0.0
    np.testing.assert_array_equal(moving[0], moving[1])
    assert 4 * 20 <= np.count_nonzero(moving[0]) <= 4 * 101  # 2 to 10 s each


def test_missing_samples_are_dropped_inside_the_record() -> None:
    present = _reference.simulate(scene(1000, missing=150), [axis()])[3]
    assert np.count_nonzero(~present) == 150
    assert present[0] and present[-1]


# -------------------------------------------------------------------------------------------------------------- verb


def write_model(folder: Path, simulate_entry: str) -> Path:
    """The shipped model with another `simulate` entry."""
    text = (DATA / "simulated_adis16405.yaml").read_text(encoding="utf-8")
    path = folder / "model.yaml"
    path.write_text(text[: text.index("simulate:\n")] + simulate_entry, encoding="utf-8")
    return path


def test_shipped_recording_is_what_its_model_makes(tmp_path: Path) -> None:
    """Same bytes in every array: the seed in its metadata and the model file beside it are all there is to it."""
    shipped = np.load(DATA / "simulated_adis16405.npz")
    meta = json.loads(shipped["meta"].item())
    assert meta["simulated"] is True
    simulate(DATA / "simulated_adis16405.yaml", tmp_path / "again.npz", seed=meta["seed"])
    again = np.load(tmp_path / "again.npz")
    assert sorted(shipped.files) == sorted(again.files)
    for key in shipped.files:
        assert shipped[key].dtype == again[key].dtype
        assert shipped[key].tobytes() == again[key].tobytes(), key


def test_shipped_recording_holds_the_sensor_lattice_and_the_truth() -> None:
    model = Model.load(DATA / "simulated_adis16405.yaml")
    shipped = recording.load(DATA / "simulated_adis16405.npz")
    assert (shipped.rate_hz, shipped.samples) == (10.0, 36_000)
    assert set(shipped.columns) == {*model.axes, "temp", "supply"}
    for name in model.axes:
        stated, truth = model.simulate["axes"][name], shipped.meta["truth"][name]
        for key, value in stated.items():
            assert truth[key] == (value if key == "hypothesis" else float(value))
        counts = shipped.in_unit(name, model.group_of(name).unit) / model.group_of(name).lsb
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)


def test_what_is_left_open_is_drawn_from_the_priors(tmp_path: Path) -> None:
    """400 draws of six axes: laws within the binomial law, parameters by Kolmogorov-Smirnov against the prior."""
    path = write_model(tmp_path, "simulate: {rate_hz: 1, duration_s: 2}\n")
    model = Model.load(path)
    truths = [simulate(path, tmp_path / "log.npz", seed=seed)["truth"] for seed in range(400)]
    laws = [truth[name]["hypothesis"] for truth in truths for name in model.axes]
    for law, share in model.hypotheses.items():
        low, high = stats.binom(len(laws), share).ppf([1e-5, 1 - 1e-5])
        assert low < laws.count(law) < high
    priors = model.group_of("gx").priors
    bias = [truth["gx"]["bias"] / priors["bias"].sd for truth in truths]
    assert stats.kstest(bias, "norm").pvalue > 1e-4
    for parameter in ("N", "K", "sigma_m", "alpha"):
        prior = priors[parameter]
        drawn = [truth[name][parameter] for truth in truths for name in ("gx", "gy", "gz") if parameter in truth[name]]
        shares = np.log(np.array(drawn) / prior.min) / np.log(prior.max / prior.min)
        assert stats.kstest(shares, "uniform").pvalue > 1e-4


def test_stating_one_value_leaves_the_others_as_drawn(tmp_path: Path) -> None:
    open_path = write_model(tmp_path, "simulate: {rate_hz: 1, duration_s: 20}\n")
    before = simulate(open_path, tmp_path / "a.npz", seed=3)["truth"]
    stated_path = write_model(tmp_path, "simulate: {rate_hz: 1, duration_s: 20, axes: {gy: {bias: 0.125}}}\n")
    after = simulate(stated_path, tmp_path / "b.npz", seed=3)["truth"]
    assert after["gy"]["bias"] == 0.125
    for name in before:
        for key in ("hypothesis", "N", "K", "sigma_m", "alpha"):
            assert before[name].get(key) == after[name].get(key)


def test_seed_decides(tmp_path: Path) -> None:
    path = DATA / "simulated_adis16405.yaml"
    logs = [tmp_path / name for name in ("a.npz", "b.npz", "c.npz")]
    for log, seed in zip(logs, (1, 1, 2), strict=True):
        simulate(path, log, seed=seed)
    first, same, other = (np.load(log)["gx"] for log in logs)
    assert np.array_equal(first, same) and not np.array_equal(first, other)


def test_csv_and_npz_hold_the_same_recording(tmp_path: Path) -> None:
    """CSV carries nine digits."""
    path = write_model(tmp_path, "simulate: {rate_hz: 10, duration_s: 60}\n")
    effects = ["missing_samples:missing=30", "temperature:coefficient=0.01,axis=gx"]
    logs = [tmp_path / name for name in ("log.npz", "log.csv.gz", "log.csv")]
    loaded = []
    for log in logs:
        meta = simulate(path, log, seed=5, effects=effects)
        loaded.append(recording.load(log))
    for one in loaded:
        assert one.samples == 570 and one.missing_before.sum() == 30 and one.rate_hz == pytest.approx(10.0)
        assert one.meta["truth"] == meta["truth"] and one.meta["seed"] == 5
        assert one.meta["effects"] == [
            {"id": "missing_samples", "axes": {name: {"missing": 30} for name in meta["truth"]}},
            {"id": "temperature", "axes": {"gx": {"coefficient": 0.01}}},
        ]
        for name, column in loaded[0].columns.items():
            np.testing.assert_allclose(one.columns[name].values, column.values, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    "effect",
    ["temperature", "supply", "cross_axis", "ramp", "step", "pulse", "two_level", "turn_on", "periodic", "flicker",
     "oscillation",
     "colored_noise", "quantization_noise", "quantization", "outliers", "variance_change", "saturation", "motion",
     "missing_samples", "stuck", "held_samples", "rate_change"],
)  # fmt: skip
def test_every_effect_changes_the_recording_with_its_defaults(effect: str, tmp_path: Path) -> None:
    path = DATA / "simulated_adis16405.yaml"
    meta = simulate(path, tmp_path / "with.npz", seed=16405, effects=[effect])
    changed, plain = np.load(tmp_path / "with.npz"), np.load(DATA / "simulated_adis16405.npz")
    assert meta["effects"][0]["id"] == effect
    for name in meta["truth"]:
        assert not np.array_equal(changed[name], plain[name]), name


def test_the_list_of_effects_has_every_key(tmp_path: Path) -> None:
    """Truth: the keys that the complaint about an unknown one names."""
    rows = dict(line.split(maxsplit=1) for line in run("simulate", "--list-effects").stdout.splitlines()[1:])
    assert list(rows) == [cause.id for cause in CAUSES.values() if cause.simulated.keys]
    for effect, keys in rows.items():
        with pytest.raises(UserError, match=r"unknown key 'nonsense' \(known: (.*)\)") as caught:
            simulate(DATA / "simulated_adis16405.yaml", tmp_path / "log.npz", effects=[f"{effect}:nonsense=1"])
        known = str(caught.value).partition("known: ")[2].rstrip(")")
        assert re.sub(r" \([^)]*\)", "", keys) == known


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        ("wobble", "temperature, supply"),
        ("step:when=3", "time_s, amplitude"),
        ("step:amplitude=big", "amplitude must be a number"),
        ("step:amplitude=nan", "amplitude must be a number"),
        ("step:amplitude", "amplitude=VALUE"),
        ("step:amplitude=1,amplitude=2", "once"),
        ("step:axis=qx", "no axis 'qx'"),
        ("outliers:fraction=2", "from 0 to 1"),
        ("colored_noise:lag1=1", "between -1 and 1"),
        ("missing_samples:missing=1000000", "cannot be missing"),
        ("missing_samples:missing=1.5", "whole number"),
        ("cross_axis:axis=gx,other=gx", "its own other"),
    ],
)
def test_bad_effects_are_one_clear_line(effect: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        simulate(DATA / "simulated_adis16405.yaml", tmp_path / "log.npz", effects=[effect])
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("simulate: {rate_hz: 0}\n", "simulate.rate_hz"),
        ("simulate: {rate_hz: 5000}\n", "819.2 Hz at most"),
        ("simulate: {rate_hz: 1, duration_s: 1}\n", "fewer than two samples"),
        ("simulate: {rate_hz: 1, duration_s: 1e15}\n", "more than 100,000,000 readings: take 1.67e+07 s or"),
        ("simulate: {axes: [gx]}\n", "simulate.axes"),
        ("simulate: {axes: {qx: {bias: 1}}}\n", "no axis 'qx'"),
        ("simulate: {axes: {gx: {bais: 1}}}\n", "unknown entry 'bais'"),
        ("simulate: {axes: {gx: {N: -1}}}\n", "simulate.axes.gx.N"),
        ("simulate: {axes: {gx: {hypothesis: brownian}}}\n", "unknown 'brownian'"),
    ],
)
def test_bad_simulate_entries_are_one_clear_line(entry: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        simulate(write_model(tmp_path, entry), tmp_path / "log.npz")
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_bad_seed_and_bad_suffix_are_errors(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--seed"):
        simulate(DATA / "simulated_adis16405.yaml", tmp_path / "log.npz", seed=-1)
    with pytest.raises(UserError, match="ends in"):
        simulate(DATA / "simulated_adis16405.yaml", tmp_path / "log.txt")


def test_what_was_written_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The recording and the file that the truth is in."""
    places = (("log.csv", f"{tmp_path}/log.csv.meta.json: the truth:"), ("log.npz", "the truth, in its member"))
    entry = "simulate: {rate_hz: 2, duration_s: 30, axes: {gx: {hypothesis: constant, N: 0.1}}}\n"
    for name, place in places:
        path = write_model(tmp_path, entry)
        show(simulate(path, tmp_path / name, seed=7), tmp_path / name)
        said = capsys.readouterr().out
        assert said.startswith(f"{tmp_path / name}: 60 samples at 2 Hz, seed 7\n{place}")
        assert "N 0.1 deg/s/sqrt(Hz)\n  gy: " in said


WRONG_NUMBERS = [
    ("duration_s: 3600.0", "duration_s: -1", "simulate.duration_s"),
    ("  rate_hz: 10.0", "  rate_hz: nan", "simulate.rate_hz"),
    ("  axes: {}", "  axes: {gx: {N: -1}}", "simulate.axes.gx.N"),
    ("  axes: {}", "  axes: {gx: {bias: no}}", "simulate.axes.gx.bias"),
    ("  axes: {}", "  axes: {gx: {hypothesis: walk}}", "simulate.axes.gx.hypothesis"),
    ("  axes: {}", "  axes: {hx: {N: 1}}", "simulate.axes"),
    ("  axes: {}", "  effects: [1]", "simulate.effects"),
]


@pytest.mark.parametrize(("good", "wrong", "where"), WRONG_NUMBERS)
def test_every_verb_checks_what_the_model_simulates(tmp_path: Path, good: str, wrong: str, where: str) -> None:
    """`codegen` and `identify` read the model as `simulate` does: a wrong number is no surprise for later."""
    text = DEFAULT.read_text(encoding="utf-8")
    assert good in text
    path = tmp_path / "model.yaml"
    path.write_text(text.replace(good, wrong), encoding="utf-8")
    with pytest.raises(UserError, match=re.escape(f"{path}: {where}: ")):
        Model.load(path)
