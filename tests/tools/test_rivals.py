"""The rivals: each is held to a truth of its own, so that the table compares methods and not mistakes."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import fft, signal
from scipy.stats import multivariate_normal

from selfcal.adequacy.allan import relative_variance
from selfcal.adequacy.drawn import simulate_bank_samples
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.logs.recording import save
from selfcal.model.file import Model
from selfcal.model.laws import NAMED
from selfcal.studies import methods as registry
from selfcal.studies.methods import RIVALS, particles, rao_blackwell
from selfcal.studies.methods.autocorrelation import covariances
from selfcal.studies.methods.dual import transition
from selfcal.studies.methods.ensemble import ensemble_summary
from selfcal.studies.methods.problem import Problem, weights
from selfcal.studies.methods.recursive import update
from selfcal.studies.methods.steady_state import ln_likelihood
from selfcal.studies.methods.wavelets import covariance
from selfcal.studies.rivals import longest_stretch, problem_of, show
from selfcal.verbs.rivals import rivals

from conftest import COMMAND, ROOT, run, shared_recording

ENSEMBLE = ROOT / "tools" / "selfcal" / "model" / "models" / "ensemble.yaml"
SHIPPED = ROOT / "tests" / "data" / "simulated_adis16405.npz"
#: The truths of the issue: sigma_v 0.5, drift 0.05 a step or sigma_m 0.3, alpha 0.03, at 1 s.
TRUTH = {
    "random_walk": {"N": 0.5, "K": 0.05, "bias": 1.0},
    "gauss_markov": {"N": 0.5, "sigma_m": 0.3, "alpha": 0.03, "bias": 1.0},
}
#: The middles of the priors are off by this factor: a method that stays where it began is seen.
OFF = 6.0
#: Joint filters do not see a noise variance (joint_filters.py), slopes are no Gauss-Markov fit.
BLIND = {"ekf", "ukf"}


def problem(law: str, n: int, seed: int = 1, off: float = 1.0) -> Problem:
    y, _ = simulate_bank_samples(law, TRUTH[law], 1.0, n, seed)
    group = Model.load(ENSEMBLE).group_of("gx")
    moved = {
        name: prior if name == "bias" else replace(prior, min=off * prior.min, max=off * prior.max)
        for name, prior in group.priors.items()
    }
    group = replace(group, priors=moved)
    return Problem(y, 1.0, group, ("constant", "random_walk", "gauss_markov"))


@pytest.mark.parametrize("law", list(TRUTH))
def test_every_rival_finds_the_truth_of_a_long_record(law: str) -> None:
    """3000 samples, priors off by six. The Cramer-Rao bound of ln K is 0.09 here, of ln sigma_m 0.1 and of ln alpha
    0.25. A factor of 2.2 is three of the largest; moments of differences are much rougher and get 5."""
    posed = problem(law, 3000, off=OFF)
    for name, rival in RIVALS.items():
        if rival.missing or name in BLIND:
            continue
        answer = rival.load()(posed)
        if law not in answer.estimates:
            assert name == "allan_slopes"
            continue
        for parameter, value in answer.estimates[law].items():
            limit = 5.0 if name in ("autocorrelation", "allan_slopes") else 2.2
            if math.isnan(value.value):
                assert name in ("autocorrelation", "allan_slopes"), (name, parameter)
                continue
            assert 1.0 / limit < value.value / TRUTH[law][parameter] < limit, (name, parameter, value)
            if not math.isnan(value.q05):
                assert value.q05 < value.value < value.q95
        for given in answer.weights.values():
            assert math.isclose(sum(given.values()), 1.0, rel_tol=1e-6)  # the library's are floats
            assert max(given, key=lambda one: given[one]) == law, name


def test_joint_filters_do_not_see_a_noise_variance() -> None:
    """The known result: the estimate of N stays at its prior's middle."""
    if RIVALS["ekf"].missing:
        pytest.skip("FILTERPY ABSENT: make setup-rivals")
    posed = problem("random_walk", 200)
    prior = posed.group.priors["N"]
    for name in BLIND:
        value = RIVALS[name].load()(posed).estimates["random_walk"]["N"].value
        # 1 %: the unscented transform has its rounding
        assert math.isclose(value, math.sqrt(prior.min * prior.max), rel_tol=0.01)


def test_derivatives_of_the_dual_filter() -> None:
    """What its sensitivity recursion begins with: the derivatives of each step, against central differences of it."""
    for law, names in (("random_walk", 2), ("gauss_markov", 3)):
        at = np.log([0.5, 0.3, 0.03][:names])
        found = transition(law, at, 2.0)
        for j, h in enumerate(1e-5 * np.eye(names)):
            above, below = transition(law, at + h, 2.0), transition(law, at - h, 2.0)
            for value in (0, 2, 4):  # the error of a central difference is below 1e-9 here
                np.testing.assert_allclose(found[value + 1][j], (above[value] - below[value]) / 2e-5, atol=1e-8)


@pytest.mark.parametrize("law", list(TRUTH))
def test_a_kalman_filter_in_each_particle(law: str) -> None:
    """One particle's likelihood of the readings after the first, against the normal density of their distances from the
    first. The level is not in the distances, and their covariance matrix needs no filter."""
    posed = problem(law, 300)
    n, ln = 300, np.log([TRUTH[law][name] for name in NAMED[law].parameters])
    ln_theta = np.repeat(ln[:, None], particles.PARTICLES, axis=1)
    rng = np.random.default_rng(1)
    state = rao_blackwell.begin(posed, law, ln_theta, rng)
    total = 0.0
    for value in posed.y[1:].tolist():
        given, state = rao_blackwell.step(posed, law, ln_theta, state, value, rng)
        total += float(given[0])
    at = np.arange(n)
    if law == "random_walk":
        drift = TRUTH[law]["K"] ** 2 * np.minimum.outer(at, at)
    else:
        drift = TRUTH[law]["sigma_m"] ** 2 * np.exp(-TRUTH[law]["alpha"] * np.abs(np.subtract.outer(at, at)))
    c = drift + TRUTH[law]["N"] ** 2 * np.eye(n)
    distances = c[1:, 1:] + c[0, 0] - c[1:, :1] - c[:1, 1:]
    exact = multivariate_normal(cov=distances).logpdf(posed.y[1:] - posed.y[0])
    assert math.isclose(total, exact, abs_tol=1e-6)  # rounding of 300 steps


def test_whittle_is_the_exact_likelihood_of_a_random_walk() -> None:
    """Against statsmodels' exact diffuse filter: differences between parameter values, which have no constant."""
    from statsmodels.tsa.statespace.structural import UnobservedComponents

    posed = problem("random_walk", 300)
    model = UnobservedComponents(posed.y, level="llevel")
    power = fft.dct(posed.y - posed.y.mean(), norm="ortho")[1:] ** 2
    omega = math.pi * np.arange(1, 300) / 300

    def ours(ln: Array) -> float:
        spectrum = posed.terms("random_walk", ln).spectrum(omega)
        return -0.5 * float((np.log(spectrum) + power / spectrum).sum())

    a, b = np.log([0.5, 0.05]), np.log([0.4, 0.2])
    theirs = model.loglike(np.exp(2.0 * a)) - model.loglike(np.exp(2.0 * b))
    # their diffuse start is a variance of 1e6 over ours without a limit: 1e-6 of a nat
    assert math.isclose(ours(a) - ours(b), theirs, abs_tol=1e-3)


def test_the_steady_state_likelihood_is_the_exact_one_but_for_the_start() -> None:
    """Against the cosine spectrum, which is exact for the random walk. The gain settles within 1 / gain = 10 samples of
    3000; what is lost there is below 2 nats of the 300 between these parameter values."""
    posed = problem("random_walk", 3000)
    power = fft.dct(posed.y - posed.y.mean(), norm="ortho")[1:] ** 2
    omega = math.pi * np.arange(1, 3000) / 3000
    a, b = np.log([0.5, 0.05]), np.log([0.4, 0.2])
    exact = [posed.terms("random_walk", ln).spectrum(omega) for ln in (a, b)]
    difference = -0.5 * float((np.log(exact[0] / exact[1]) + power / exact[0] - power / exact[1]).sum())
    ours = ln_likelihood(posed, "random_walk", a) - ln_likelihood(posed, "random_walk", b)
    assert math.isclose(ours, difference, abs_tol=2.0)


@pytest.mark.parametrize("law", list(TRUTH))
def test_covariance_of_wavelet_moments(law: str) -> None:
    """Its diagonal against the Allan variance's own formula in allan.py, which was derived apart."""
    posed = problem(law, 500)
    m = np.array([1.0, 4.0, 32.0])
    terms = posed.terms(law, np.log([TRUTH[law][name] for name in NAMED[law].parameters]))
    found = np.diag(covariance(terms, m, 500)) / terms.allan_variance(m) ** 2
    apart = [relative_variance(terms, int(k), np.ones(500 - 2 * int(k) + 1, bool)) for k in m]
    # theirs leaves out lags beyond which a Gauss-Markov drift is forgotten, 1e-6
    np.testing.assert_allclose(found, apart, rtol=1e-5)


def arx(y: Array, u: Array, *, output_error: bool) -> tuple[Array, Array]:
    """a, b0, b1 of y[k] = -a y[k-1] + b0 u[k] + b1 u[k-1] and their covariance over the noise variance, by the rivals'
    recursive least squares. With `output_error` the model's own output stands in the place of the last reading, and the
    gradient is filtered by 1 + a z^-1."""
    x, P, last, gradient = np.zeros(3), 1e6 * np.eye(3), 0.0, np.zeros(3)
    for k in range(1, y.size):
        row = np.array([-last, u[k], u[k - 1]])
        gradient = row - float(np.clip(x[0], -0.99, 0.99)) * gradient if output_error else row
        x, P = update(x, P, gradient, float(y[k] - row @ x))
        last = float(row @ x) if output_error else float(y[k])
    return x, P


def test_recursive_least_squares_on_a_known_system() -> None:
    """The estimation course's example, (1 - 0.4 z^-1) / (1 + 0.8 z^-1), driven by a known binary input.

    The clean output has the variance 1 + 1.2^2 / 0.36 = 5, and 1 is its covariance with the input. White noise of sd 1
    in the equation adds v = 1 / 0.36. The least squares then have the sd 1 / sqrt(n) over the roots of 4 + v (a), 1
    (b0) and (4 + v) / (5 + v) (b1). White noise on the output instead makes them wrong by -0.8 / (4 + 1) in a, and
    their noise is at most 1.8 times as large. The output error model is right there, with the sd of its covariance."""
    n, truth = 4000, np.array([0.8, 1.0, -0.4])
    rng = np.random.default_rng(1)
    u, noise = rng.choice([-1.0, 1.0], n), rng.standard_normal(n)
    clean = signal.lfilter([1.0, -0.4], [1.0, 0.8], u)
    v = 1.0 / 0.36
    tolerance = 4.0 / np.sqrt(n * np.array([4.0 + v, 1.0, (4.0 + v) / (5.0 + v)]))
    found, _ = arx(clean + signal.lfilter([1.0], [1.0, 0.8], noise), u, output_error=False)
    assert (np.abs(found - truth) < tolerance).all()
    wrong, _ = arx(clean + noise, u, output_error=False)
    assert abs(wrong[0] - (0.8 - 0.8 / 5.0)) < 1.8 * 4.0 / math.sqrt(5.0 * n)
    right, P = arx(clean + noise, u, output_error=True)
    assert (np.abs(right - truth) < 4.0 * np.sqrt(np.diag(P))).all()


def test_correlation_and_spectrum_of_a_known_system() -> None:
    """The course's other example, (z^-1 + 0.5 z^-2) / (1 - 1.5 z^-1 + 0.7 z^-2), driven by a PRBS of 2^16 - 1.

    Wiener-Hopf: the correlation of output and input over the variance of the input, 1, is the impulse response. Its
    error is the noise of the output over sqrt(n). The transform of the correlations at up to m lags to both sides, over
    the same of the input, is the frequency response. Its error is the noise's spectrum times sqrt(2 m / n)."""
    u = 2.0 * signal.max_len_seq(16)[0] - 1.0
    b, a, sd, n, m = [0.0, 1.0, 0.5], [1.0, -1.5, 0.7], 0.5, u.size, 64
    y = signal.lfilter(b, a, u) + signal.lfilter([1.0], a, sd * np.random.default_rng(1).standard_normal(n))
    impulse = np.concatenate([[1.0], np.zeros(m)])
    forward, backward, own = covariances(y, u, m + 1), covariances(u, y, m + 1), covariances(u, u, m + 1)
    noise = sd * np.linalg.norm(signal.lfilter([1.0], a, impulse))
    # of 65 lags, 4.5 sd are exceeded once in 2000 times
    np.testing.assert_allclose(forward, signal.lfilter(b, a, impulse), atol=4.5 * noise / math.sqrt(n))
    omega = np.linspace(0.0, math.pi, 33)
    transform = np.exp(-1j * np.outer(omega, np.arange(-m, m + 1)))
    both, alone = (transform @ np.concatenate([c[:0:-1], d]) for c, d in ((backward, forward), (own, own)))
    error = np.abs(both / alone - signal.freqz(b, a, omega)[1])
    assert (error < 4.5 * math.sqrt(2.0 * m / n) * sd * np.abs(signal.freqz([1.0], a, omega)[1])).all()


def test_weights() -> None:
    assert weights({"a": 2.0, "b": 2.0 + 2.0 * math.log(3.0)}) == pytest.approx({"a": 0.75, "b": 0.25})
    assert weights({"a": math.inf, "b": 5.0}) == {"a": 0.0, "b": 1.0}


def test_the_longest_stretch() -> None:
    y = np.array([1.0, np.nan, 2.0, 3.0, 4.0, np.nan, 5.0, 6.0])
    assert longest_stretch(y).tolist() == [2.0, 3.0, 4.0]


def test_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The document and the table of the shipped recording. gy is Gauss-Markov by its truth."""
    out = tmp_path / "out.json"
    monkeypatch.setattr(registry.importlib.util, "find_spec", lambda name: None if name == "filterpy" else name)
    document = rivals(SHIPPED, axes=["gy"], only=["library", "allan_fit", "ml", "ekf"], json=out)
    assert json.loads(out.read_text()) == document
    assert document["schema"] == "selfcal.rivals/1"
    entries = document["axes"]["gy"]["rivals"]
    assert list(entries) == ["library", "allan_fit", "ml", "ekf"]
    assert entries["ekf"]["error"] == f"filterpy is not installed: {sys.executable} -m pip install filterpy"
    assert entries["library"]["weights"]["Bayes"]["gauss_markov"] > 0.99
    sigma_m = entries["ml"]["parameters"]["gauss_markov"]["sigma_m"]
    assert sigma_m["unit"] == "deg/s"
    # The truth is 0.02. The factor is twice the half width of the 90 % interval.
    assert 1 / 1.35 < sigma_m["value"] / 0.02 < 1.35
    for entry in entries.values():
        assert "error" in entry or (entry["seconds"] > 0.0 and entry["peak_memory_bytes"] >= 0)
    show(document)
    said = capsys.readouterr().out
    assert f"no answer: joint EKF, filterpy: {entries['ekf']['error']}" in said
    assert "maximum likelihood, statsmodels" in said


def test_the_library_answers_as_identify_does() -> None:
    from selfcal.verbs.identify import identify

    ours = rivals(SHIPPED, axes=["gx"], only=["library"])["axes"]["gx"]["rivals"]["library"]
    theirs = identify(SHIPPED, axes=["gx"])["axes"]["gx"]
    # Block means reach the bank as floats here, sums of floats there.
    assert ours["weights"]["Bayes"] == pytest.approx(theirs["hypotheses"], abs=1e-3)
    for law, estimates in theirs["parameters"].items():
        for name, value in estimates.items():
            assert ours["parameters"][law][name]["value"] == pytest.approx(value["median"], rel=2e-3)


def test_what_it_refuses(tmp_path: Path) -> None:
    done = run("rivals", SHIPPED, "--only", "oracle")
    assert done.returncode == 2
    assert done.stderr.startswith("selfcal: error: --only: there is no rival 'oracle' (library, grid, allan_slopes, ")
    log = tmp_path / "log.csv"
    log.write_text("t[s],gx[deg/s]\n" + "".join(f"{k},{0.1 * (k * 7 % 5)}\n" for k in range(30)))
    with pytest.raises(UserError, match=r"gx: 30 averages of 1 s without a gap are too few, 50 are needed: record lon"):
        rivals(log)


@pytest.mark.parametrize("law", list(TRUTH))
def test_the_dense_grid_is_the_library(law: str) -> None:
    """Two codes, one posterior: probabilities to 2e-4, twice the library's tolerance against its textbook reference.
    Its quantiles are read between nodes that are up to a third of a posterior sd apart, so they agree to a tenth."""
    posed = problem(law, 600)
    ours, grid = (RIVALS[name].load()(posed) for name in ("library", "grid"))
    assert ours.weights["Bayes"] == pytest.approx(grid.weights["Bayes"], abs=2e-4)
    for name, value in grid.estimates[law].items():
        found = ours.estimates[law][name]
        width = math.log(value.q95 / value.q05)
        assert abs(math.log(found.q05 / value.q05)) < 0.1 * width
        assert abs(math.log(found.q95 / value.q95)) < 0.1 * width


def test_errors_of_an_ensemble() -> None:
    """By hand: errors of 0.1 and -0.3 over 0.2 and 0.2; one interval of two holds the truth; one hit of two."""
    group = Model.load(ENSEMBLE).group_of("gx")
    rows = []
    for seed, (ours, theirs) in enumerate(((0.1, 0.2), (-0.3, 0.2))):
        for name, error in (("library", ours), ("ml", theirs)):
            value = 0.05 * math.exp(error)
            row = {"law": "random_walk", "samples": 100, "seed": seed, "rival": name, "seconds": 1.0}
            for parameter, truth in (("N", 0.5), ("K", 0.05)):
                row |= {f"truth.{parameter}": truth, f"value.{parameter}": value * truth / 0.05}
                row |= {f"q05.{parameter}": row[f"value.{parameter}"] * math.exp(-0.2)}
                row |= {f"q95.{parameter}": row[f"value.{parameter}"] * math.exp(0.2)}
            weight = 0.8 if seed else 0.3
            row |= {"weight.Bayes.random_walk": weight, "weight.Bayes.gauss_markov": 1.0 - weight}
            rows.append(row)
    entry = next(one for one in ensemble_summary(rows, group) if one["rival"] == "library")
    assert entry["parameters"]["K"]["rmse_ln"] == pytest.approx(math.sqrt(0.05))
    assert entry["parameters"]["K"]["ratio"] == pytest.approx(math.sqrt(0.05) / 0.2)
    assert entry["parameters"]["K"]["coverage_90"] == 0.5
    assert entry["choice"]["Bayes"]["hit_rate"] == 0.5
    assert entry["choice"]["Bayes"]["log_score"] == pytest.approx(0.5 * (math.log(0.8) + math.log(0.3)))


def test_the_ensemble_as_a_command(tmp_path: Path) -> None:
    """12 records a law of 150 samples, truths drawn from the prior. 90 % of the library's intervals hold the truth: of
    12, at least 8 do but once in 200 (binomial)."""
    out = tmp_path / "out.json"
    only = [word for name in ("library", "grid", "ml") for word in ("--only", name)]
    done = run("rivals", "--records", "12", "--samples", "150", "--truth", "prior", *only, "--json", out)
    assert done.returncode == 0, done.stderr
    assert "choice of the law, mean over the laws" in done.stdout
    document = json.loads(out.read_text())
    assert document["schema"] == "selfcal.rivals_ensemble/1"
    for entry in document["cells"]:
        if entry["rival"] == "library":
            assert all(p["coverage_90"] >= 8 / 12 for p in entry["parameters"].values())
    by = {(one["rival"], one["criterion"]): one["log_score"] for one in document["choice"]}
    # the library's probabilities are the grid's to 2e-4
    assert by["library", "Bayes"] == pytest.approx(by["grid", "Bayes"], abs=2e-3)


def test_a_recording_or_records() -> None:
    for arguments in (["rivals"], ["rivals", SHIPPED, "--records", "3"]):
        done = run(*arguments)
        assert done.returncode == 2
        assert "rivals takes a recording, or --records N for simulated ones" in done.stderr
    assert "--truth is middle or prior, not 'best'" in run("rivals", "--records", "3", "--truth", "best").stderr


def test_wavelet_moments_beside_simts() -> None:
    """simts 0.2.3 on the same run (its model: coloured white noise and one Gauss-Markov). Its N is that of 100 Hz
    samples, ours that of 1 s means: 2 % is three sd of ours. Its sigma_m and T agree within the factors 1.5 and 5 that
    its fits of the three runs scatter by. Neither law describes these records, so the weights of the scales decide."""
    simts = {"gx": (0.0410, 168.0, 0.0117), "gy": (0.0434, 1780.0, 0.0283), "gz": (0.0417, 2390.0, 0.0354)}
    recording = shared_recording("adis16405_run1.npz")
    for axis, (N, T, sigma_m) in simts.items():
        posed, _ = problem_of(recording, axis, Model.load(), None)
        found = RIVALS["gmwm"].load()(posed).estimates["gauss_markov"]
        if axis != "gz":  # a line near 20 Hz is in its N of gz
            assert found["N"].value == pytest.approx(N, rel=0.02)
        assert 1 / 1.5 < found["sigma_m"].value / sigma_m < 1.5
        assert 1 / 5.0 < 1.0 / found["alpha"].value / T < 5.0


def test_another_packages_method_joins(tmp_path: Path) -> None:
    """By its entry point, as pip lays it down: its numbers in the recording's unit, its faults in its place."""
    info = tmp_path / "own-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own\nVersion: 1.0\n")
    names = ("mean", "none", "odd", "library")
    (info / "entry_points.txt").write_text("[selfcal.rivals]\n" + "".join(f"{name} = own:{name}\n" for name in names))
    (tmp_path / "own.py").write_text(
        "from selfcal.studies.methods import Answer, Value\n"
        "def mean(problem): return Answer({'constant': {'N': Value(problem.dt_s * problem.y.size)}})\n"
        "def none(problem): return None\n"
        "def odd(problem): return Answer({'constant': {'wind': Value(1.0)}})\n"
    )
    save(tmp_path / "log.npz", {"gx": ("rad/s", 0.01 * np.random.default_rng(3).standard_normal(300))}, 1.0)
    found = subprocess.run(
        [*COMMAND, "rivals", "log.npz", *(f"--only={name}" for name in names), "--json", "-"],
        cwd=tmp_path, capture_output=True, text=True, check=True, env=os.environ | {"PYTHONPATH": str(tmp_path)},
    )  # fmt: skip
    rows = json.loads(found.stdout)["axes"]["gx"]["rivals"]
    value = rows["mean"]["parameters"]["constant"]["N"]
    assert value["value"] == pytest.approx(300.0 * math.pi / 180.0) and value["unit"] == "rad/s/sqrt(Hz)"
    assert rows["none"]["error"] == "it returned NoneType: a rival returns a selfcal.studies.methods.Answer"
    assert "wind" in rows["odd"]["error"] and rows["library"]["title"] == "selfcal, the library"
