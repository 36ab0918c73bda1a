"""`selfcal diagnose`: causes hidden in drawn recordings are named, clean ones pass, and the likelihood is exact.

The recordings come from tests/hidden/generator.py, which shares no code with the diagnosis. This is a thin part of
`make hidden`: one plain record a cause, where `make hidden` draws twenty and more.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import yaml
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.stats import binom

from selfcal.base.ending import HeldSignals
from selfcal.base.errors import UserError
from selfcal.batch.fail_on import outcome
from selfcal.diagnosis.cause import Looks
from selfcal.diagnosis.finding import Diagnosed
from selfcal.diagnosis.loop import _looked
from selfcal.diagnosis.record import Record as OfAxes
from selfcal.diagnosis.swing import SWINGS_MOST as BANDS_MOST
from selfcal.likelihood.fit import (
    COLUMNS_MOST,
    Fit,
    Series,
    fit,
    fit_at,
    ln_likelihood,
    shifts,
    slopes,
)
from selfcal.likelihood.fit import run as run_filter
from selfcal.likelihood.state import Look, State
from selfcal.likelihood.statemodel import Array, Terms, matrices
from selfcal.logs.recording import load, save
from selfcal.model.file import DEFAULT, Model
from selfcal.readings.moves import moves_of
from selfcal.verbs.compare import compare
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify
from selfcal.verbs.simulate import simulate

from conftest import CALLED, run
from generator import CAUSES, CLEAN, Record, draw

SEED = 4100
RATE_HZ = 2.0


def written(record: Record, path: Path) -> Path:
    save(path, record.columns, record.rate_hz, t=record.t)
    return path


@pytest.mark.parametrize("block", [1, 10])
@pytest.mark.parametrize(
    "terms",
    [
        Terms(),
        Terms(walk=True),
        Terms(markov=True, color="ma"),
        Terms(walk=True, markov=True, flicker=True),
        Terms(walk=True, oscillation=True, color="ar", bands=((10.0, 0.1, -0.5),)),
    ],
)
def test_the_likelihood_is_that_of_the_joint_normal(terms: Terms, block: int) -> None:
    """Against the dense covariance of the record, gaps and uneven noise included. Means of `block` readings have more
    noise where some are lost.

    The filter keeps its gain while s moves by less than 6e-6: over 500 samples 1e-4 nats, and coefficients to 1e-5."""
    random = np.random.default_rng(7)
    n, dt = 500, 1.0
    y = random.standard_normal(n).cumsum() * 0.2 + random.standard_normal(n)
    y[[11, 12, 40]] = np.nan
    r = np.where(np.arange(n) < 280, 1.0, 2.5)
    columns = np.vstack([np.ones(n), np.linspace(-1.0, 1.0, n)])
    guess = {"ln_rho": -1.5, "ln_markov": 0.2, "ln_alpha": -2.5, "ln_flicker": -1.05, "color": 0.3, "ln_swing": -0.4}
    guess |= {"ln_period": 1.6, "ln_damping": -2.0}
    theta = np.array([guess[name] for name in terms.names])
    series = Series(y, dt, r, columns, block=block)
    m = matrices(terms, theta, dt, series.duration_s, block)
    assert (m.lost > 0.0) == (block > 1 and (terms.walk or terms.markov or terms.flicker))
    # Covariance of h x_i and h x_j from the state model itself, by its definition.
    driven = np.zeros_like(m.Q)
    if m.driver >= 0:
        driven[m.driver, m.driver] = m.Q[m.driver, m.driver]
    P = [m.P0 + driven * (r[0] - 1.0)]
    for i in range(1, n):
        P.append(m.F @ P[-1] @ m.F.T + m.Q + driven * (r[i] - 1.0))
    cov = np.diag(m.R * r + m.lost * (r - 1.0))
    for i in range(n):
        ahead = P[i] @ m.h
        for j in range(i, n):
            cov[i, j] += m.h @ ahead
            if j > i:
                cov[j, i] = cov[i, j]
            ahead = m.F @ ahead
    good = np.isfinite(y)
    V, Z, z = cov[np.ix_(good, good)], columns[:, good].T, y[good]
    W = np.linalg.inv(V)
    c = np.linalg.solve(Z.T @ W @ Z, Z.T @ W @ z)
    rss = float((z - Z @ c) @ W @ (z - Z @ c))
    count = int(good.sum())
    expected = -0.5 * (count * (math.log(2.0 * math.pi * rss / count) + 1.0) + np.linalg.slogdet(V)[1])
    sums = run_filter(series, terms, theta)[0][0]
    assert ln_likelihood(sums) == pytest.approx(expected, abs=2e-4)
    assert sums.coefficients()[0] == pytest.approx(c, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("columns", [COLUMNS_MOST, COLUMNS_MOST + 1, 62, 97])
def test_more_columns_than_a_pass_takes(columns: int) -> None:
    """Any number of columns. Truth: a filter whitens each column by itself, and its sums are their products.
    Passes of other widths take the gain for settled at other samples: it is off by 1e-7 there, a sum of 300 by 3e-5."""
    random, n = np.random.default_rng(columns), 300
    y, z = random.standard_normal(n), np.vstack([np.ones(n), random.standard_normal((columns - 1, n))])
    y[40:55] = np.nan
    terms, theta = Terms(walk=True, color="ma"), np.array([-2.0, 0.3])
    series = Series(y, 0.1, np.ones(n), z)
    (half, whole), white, s = run_filter(series, terms, theta, (n // 2, n), innovations=True)
    for place in (0, 1, columns // 2, columns - 1):
        _, alone, s_alone = run_filter(Series(y, 0.1, np.ones(n), z[place : place + 1]), terms, theta, (), True)
        np.testing.assert_allclose(white[:, [0, 1 + place]], alone, atol=1e-6)
        np.testing.assert_allclose(s, s_alone, atol=1e-6)
    for sums, end in ((half, n // 2), (whole, n)):
        used = np.nan_to_num(white[:end])
        np.testing.assert_allclose(sums.G, used.T @ used, atol=1e-4)
    found = shifts(series, terms, theta)
    np.testing.assert_allclose(found.sums.G, whole.G, atol=1e-4)
    one = shifts(Series(y, 0.1, np.ones(n), z[-1:]), terms, theta)
    np.testing.assert_allclose(found.B[:, [0, -1]], one.B, atol=1e-4)


@pytest.mark.parametrize(
    "terms", [Terms(walk=True), Terms(markov=True), Terms(oscillation=True)], ids=("walk", "markov", "oscillation")
)
def test_a_slow_term_keeps_its_size_in_means(terms: Terms) -> None:
    """Truth: the variance of a slow drift a time apart in samples; over the white noise of a mean of 10 it is 10 times
    that. A mean of 10 loses less than 1 % of what changes over 1000."""
    guess = {"ln_rho": -3.0, "ln_markov": -1.0, "ln_alpha": -7.0}
    guess |= {"ln_swing": -1.0, "ln_period": math.log(2000.0), "ln_damping": -2.0}
    theta = np.array([guess[name] for name in terms.names])
    fit = Fit(terms, theta, 1.0, np.zeros(1), np.zeros(1), 0.0, 5000.0, 1.0, 5000.0)

    def apart(theta: Array, dt: float) -> float:
        """Variance of the difference of readings 100 s apart."""
        m = matrices(terms, theta, dt, 5000.0)
        P, turned = m.P0, np.linalg.matrix_power(m.F, round(100.0 / dt))
        gained = sum((step := np.linalg.matrix_power(m.F, k)) @ m.Q @ step.T for k in range(round(100.0 / dt)))
        move = turned - np.eye(len(P))
        return float(m.h @ (move @ P @ move.T + gained) @ m.h)

    assert apart(fit.of_means(10, 0.0), 10.0) == pytest.approx(10.0 * apart(theta, 1.0), rel=0.01)


def test_every_term_at_once_is_a_filter() -> None:
    """The largest model that the looks build: all its states fit. Truth: a likelihood that is a number."""
    bands = tuple((0.5 + 0.3 * k, 0.01, -2.0) for k in range(BANDS_MOST))
    terms = Terms(walk=True, markov=True, flicker=True, oscillation=True, color="ma", bands=bands)
    n = 1 << 16
    series = Series(np.random.default_rng(1).standard_normal(n), 1e-3, np.ones(n), np.ones((1, n)))
    theta = np.array([(low + high) / 2.0 for low, high in terms.limits(series.dt)])
    assert matrices(terms, theta, series.dt, 1e9).F.shape == (24, 24)
    assert math.isfinite(ln_likelihood(run_filter(series, terms, theta)[0][0]))


def test_a_model_of_six_columns_leaves_room_for_a_transient(tmp_path: Path) -> None:
    """Three periodic regressors and two exponentials after power-on: the suspicion is named. Truth: the record."""
    tree = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["regressors"] = [
        {"name": f"line{k}", "kind": "periodic", "frequency_hz": f, "sd": {"gyro": 0.1}}
        for k, f in enumerate((0.11, 0.171, 0.233))
    ]
    model = tmp_path / "six.yaml"
    model.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    t = np.arange(4800) / 4.0
    y = 0.2 + 0.05 * np.random.default_rng(4).standard_normal(t.size) + 0.8 * np.exp(-t / 12) + 0.5 * np.exp(-t / 240)
    save(tmp_path / "log.npz", {"gx": ("deg/s", y)}, 4.0)
    assert identify(tmp_path / "log.npz", model=model)["axes"]["gx"]["suspicion"] == "turn_on"


def test_marks_change_no_sum() -> None:
    """A gain stays over a mark: every sum up to one is that of a pass that ends there."""
    random = np.random.default_rng(2)
    y = random.normal(size=4000)
    y[1500:1520] = np.nan
    terms, theta = Terms(walk=True, flicker=True, bands=((20.0, 0.01, -0.5),)), np.array([-4.0, -2.0])
    series = Series(y, 0.1, np.ones(y.size), np.vstack([np.ones(y.size), np.sin(np.arange(y.size))]))
    marks = [1, 700, 1510, 1517, 2900, 2901, 4000]
    for mark, sums in zip(marks, run_filter(series, terms, theta, marks)[0], strict=True):
        part = Series(np.where(np.arange(y.size) < mark, y, np.nan), 0.1, series.r, series.columns)
        alone = run_filter(part, terms, theta)[0][0]
        assert sums.n == alone.n
        np.testing.assert_allclose(sums.G, alone.G, rtol=2e-5, atol=1e-3)
        assert pytest.approx(alone.D, abs=1e-3) == sums.D


def test_a_cause_waits_until_it_may_be_the_best() -> None:
    """A cause is looked at while it was worth as much as the best is now, and each where nothing is worth naming. What
    has no name waits for every cause that has one."""
    one, record = Diagnosed(*3 * [cast(Any, None)]), cast(Any, None)
    nets = {"step": [50.0, 20.0, 0.0, 0.0], "ramp": [31.0, 1.0, 1.0], "pulse": [15.0, 2.0], "unexplained": [700.0]}
    looked: list[str] = []

    def cause(name: str) -> Looks:
        def looks(state: State, record: OfAxes) -> list[Look]:
            looked.append(name)
            return [Look(name, 99.0, nets[name].pop(0), {}, {})]

        return looks

    worth = dict(zip(map(cause, nets), (60.0, 30.0, 27.0, -math.inf), strict=True))
    for due, named in (
        (["step"], ["step"]),
        (["step", "ramp"], ["ramp", "step"]),
        (["ramp", "pulse", "step"], ["pulse", "ramp", "step"]),
        (["pulse", "ramp", "step", "unexplained"], ["unexplained", "pulse", "ramp", "step"]),
    ):
        looked.clear()
        assert [look.cause for look in _looked(one, record, [*worth], worth, {})] == named
        assert sorted(looked) == sorted(due)


def test_a_column_of_zeros_has_no_coefficient() -> None:
    """A step that comes later than the samples. Truth: the same without the column."""
    random = np.random.default_rng(0)
    y, more = random.standard_normal(300).cumsum(), random.standard_normal((6, 300)).cumsum(axis=1)
    terms, theta = Terms(walk=True), np.array([-1.0])
    columns = [np.vstack([np.ones(300), more]), np.vstack([np.ones(300), more, np.zeros(300)])]
    without, beside = (
        run_filter(Series(y, 1.0, np.ones(300), each), terms, theta)[0][0].coefficients() for each in columns
    )
    assert beside[0] == pytest.approx([*without[0], 0.0], rel=1e-9)
    assert beside[2] == pytest.approx(without[2])


SLOPED = [
    (Terms(walk=True), [-4.0]),
    (Terms(markov=True), [-2.0, -3.0]),
    (Terms(walk=True, flicker=True, color="ma"), [-4.0, -2.0, 0.3]),
    (Terms(markov=True, color="ar"), [-1.0, -3.0, -0.2]),
    (Terms(walk=True, markov=True, oscillation=True, bands=((10.0, 0.1, -0.5),)), [-4.0, -2.0, -3.0, -1.0, 1.6, -1.4]),
]


def uneven(n: int, random: np.random.Generator) -> Series:
    """A record with a drift, a gap, louder noise from its middle on, and a second column."""
    y = random.standard_normal(n) + 0.03 * random.standard_normal(n).cumsum()
    y[n // 5 : n // 5 + 40] = np.nan
    r = np.where(np.arange(n) < n // 2, 1.0, 2.0)
    return Series(y, 0.5, r, np.vstack([np.ones(n), np.linspace(-1.0, 1.0, n)]))


@pytest.mark.parametrize(("terms", "at"), SLOPED)
def test_slopes_are_those_of_the_likelihood(terms: Terms, at: list[float]) -> None:
    """Truth: central differences of ln likelihood over 1e-3, which are off by a share of 1e-6 of its third derivative.

    ln likelihood has errors of 1e-6 where the filter keeps its gain: 1e-3 in these differences."""
    series, theta = uneven(3000, np.random.default_rng(5)), np.array(at)
    slope, information = slopes(series, fit_at(series, terms, theta))
    moves = 1e-3 * np.eye(theta.size)
    around = [[fit_at(series, terms, theta + sign * move).ln_likelihood for sign in (1.0, -1.0)] for move in moves]
    assert slope == pytest.approx([(ahead - back) / 2e-3 for ahead, back in around], rel=1e-4, abs=2e-2)
    assert (np.linalg.eigvalsh(information) > 0.0).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("terms", "at"), SLOPED[:4])
def test_no_likelier_parameters_than_the_fitted_ones(terms: Terms, at: list[float], seed: int) -> None:
    """Truth: the simplex method of scipy, from the fit and from elsewhere. A fit may be 0.05 nats below."""
    series = uneven(1500, np.random.default_rng(seed))
    found = fit(series, terms, np.array(at))
    limits = terms.limits(series.dt)

    def cost(theta: np.ndarray) -> float:
        return -fit_at(series, terms, np.clip(theta, *np.transpose(limits))).ln_likelihood

    best = min(minimize(cost, start, method="Nelder-Mead", bounds=limits).fun for start in (found.theta, np.array(at)))
    assert found.ln_likelihood > -best - 0.05


def test_a_fit_finds_the_parameters() -> None:
    """Truth: the numbers that the record was drawn with; four standard errors of N, and a factor of 1.5 of K."""
    random = np.random.default_rng(3)
    n, dt, N, K = 20_000, 0.1, 0.04, 0.002
    y = N / math.sqrt(dt) * random.standard_normal(n) + K * math.sqrt(dt) * random.standard_normal(n).cumsum()
    found = fit(Series(y, dt, np.ones(n), np.ones((1, n))), Terms(walk=True))
    assert found.sigma * math.sqrt(dt) == pytest.approx(N, rel=4.0 / math.sqrt(2.0 * n))
    assert math.exp(found.value("ln_rho")) * found.sigma / math.sqrt(dt) == pytest.approx(K, rel=0.5)


@pytest.mark.parametrize("cause", list(CAUSES))
def test_a_plain_cause_is_named_first(cause: str, tmp_path: Path) -> None:
    """40 nats and more of expected evidence. `make hidden` counts how often over many records: 98 % are asked for."""
    record = draw(cause, SEED, "plain", 10.0 if cause in ("flicker", "colored_noise") else 1.0, None, None)
    path = written(record, tmp_path / "log.npz")
    document = diagnose(path, axes=[record.axis])
    axis = document["axes"][record.axis]
    ids = {one["id"] for one in document["findings"]}
    assert cause in axis["causes"] and {one["of"] for one in axis["findings"]} == ids
    assert (axis["verdict"] == "inadequate") == bool(axis["material"] or cause == "unexplained")
    assert axis["findings"][0]["cause"] == cause
    json.dumps(document)
    for finding in axis["findings"]:
        assert finding["gain"] is not None or finding["gain_reason"]


@pytest.mark.parametrize("kind", CLEAN)
def test_a_clean_record_is_adequate(kind: str, tmp_path: Path) -> None:
    """With complications that influence nothing. `make hidden` counts false alarms over 800 records."""
    record = draw(f"clean:{kind}", SEED, "plain", 1.0, "random_walk", None)
    document = diagnose(written(record, tmp_path / "log.npz"), axes=[record.axis])
    assert document["axes"][record.axis]["findings"] == []
    assert outcome(document, "inadequate").code == 0


def effect(tmp_path: Path, text: str) -> tuple[Path, dict[str, Any]]:
    """Half an hour at RATE_HZ with one effect of the simulator, and its truth."""
    model = tmp_path / "model.yaml"
    default = DEFAULT.read_text(encoding="utf-8")
    shorter = default.replace("rate_hz: 10.0", f"rate_hz: {RATE_HZ}").replace("duration_s: 3600", "duration_s: 1800")
    assert shorter != default
    model.write_text(shorter, encoding="utf-8")
    log = tmp_path / "log.npz"
    return log, simulate(model, log, seed=2, effects=[text])


def test_the_whole_loop_for_temperature(tmp_path: Path) -> None:
    """From the recording to the extended model: the size is right, the model brings the evidence, and a record that is
    simulated from it has the effect again. Truth: the coefficient that was put in."""
    log, meta = effect(tmp_path, "temperature:axis=gx,coefficient=0.4")
    extended, page = tmp_path / "extended.yaml", tmp_path / "page.html"
    document = diagnose(log, axes=["gx", "gy"], write_model=extended, report=page)
    found = document["axes"]["gx"]["findings"][0]
    truth = meta["effects"][0]["axes"]["gx"]["coefficient"]
    assert found["cause"] == "temperature"
    c = found["estimate"]["coefficient"]
    # The recorded temperature has noise and a lattice of 0.14 degC: they cost up to 3 % of the size.
    assert abs(c["median"] - truth) < 3.0 * c["sd"] + 0.03 * truth
    assert document["axes"]["gy"]["verdict"] == "adequate"
    assert "temperature" in page.read_text(encoding="utf-8")
    # The library agrees that the column is in use, with the same coefficient.
    identified = identify(log, axes=["gx", "gy"], model=extended)
    inside = identified["axes"]["gx"]["regressors"]["temperature"]
    assert inside["probability"] > 0.999
    library = inside["coefficients"]["temperature"]
    assert abs(library["median"] - truth) < 4.0 * library["sd"]
    assert identified["axes"]["gy"]["regressors"]["temperature"]["probability"] < 0.9
    again = tmp_path / "again.npz"
    simulate(extended, again, seed=5)
    repeated = diagnose(again, axes=["gx"])["axes"]["gx"]["findings"][0]
    assert repeated["cause"] == "temperature"
    assert abs(repeated["estimate"]["coefficient"]["median"] - c["median"]) < 3.0 * c["sd"] + 0.03 * truth


def test_the_size_of_flicker_is_that_of_its_allan_floor(tmp_path: Path) -> None:
    """Truth: the coefficient that was put in, whose Allan deviation is 0.664 B. Three records, each known to 10 %."""
    found = []
    for seed in (1, 2, 4):
        model = tmp_path / "model.yaml"
        default = DEFAULT.read_text(encoding="utf-8")
        model.write_text(default.replace("rate_hz: 10.0", f"rate_hz: {RATE_HZ}"), encoding="utf-8")
        log = tmp_path / "log.npz"
        simulate(model, log, seed=seed, effects=["flicker:axis=gx,B=0.1"])
        (finding,) = (
            each for each in diagnose(log, axes=["gx"])["axes"]["gx"]["findings"] if each["cause"] == "flicker"
        )
        found.append(finding["estimate"]["B"]["median"])
    assert sum(found) / 3.0 == pytest.approx(0.1, rel=0.12)


def test_a_jump_of_two_axes_is_no_motion_and_stands_where_it_is(tmp_path: Path) -> None:
    """Both axes jump at once beside a fast drift. Truth: the time and the sizes that were put in."""
    random = np.random.default_rng(4)
    n, place = 3000, 1700
    drift = 0.05 * random.standard_normal((2, n)).cumsum(axis=1)
    values = 0.1 * random.standard_normal((6, n))
    values[:2] += drift
    values[:2, place:] += [[1.2], [1.8]]
    axes = dict(zip(("gx", "gy", "gz", "ax", "ay", "az"), values, strict=True))
    units = {name: "deg/s" if name[0] == "g" else "m/s^2" for name in axes}
    save(tmp_path / "log.npz", {name: (units[name], row) for name, row in axes.items()}, 1.0)
    document = diagnose(tmp_path / "log.npz", axes=["gx", "gy"])
    for name, size in (("gx", 1.2), ("gy", 1.8)):
        (finding,) = document["axes"][name]["findings"]
        assert finding["cause"] == "step"
        time, amplitude = finding["estimate"]["time_s"], finding["estimate"]["amplitude"]
        assert time["q05"] - 0.5 < place - 0.5 < time["q95"] + 0.5
        assert time["sd"] >= 0.28  # no better than between two readings
        assert abs(amplitude["median"] - size) < 3.0 * amplitude["sd"]


def test_repeats_of_a_coarse_lattice_are_not_held_readings(tmp_path: Path) -> None:
    """One axis, whose lattice is as wide as its noise: a quarter of the readings repeat by chance."""
    y = np.rint(np.random.default_rng(1).standard_normal(4000)) * 0.1
    save(tmp_path / "log.npz", {"gx": ("deg/s", y)}, 10.0)
    findings = diagnose(tmp_path / "log.npz", axes=["gx"])["axes"]["gx"]["findings"]
    assert [finding["cause"] for finding in findings] == ["quantization"]


def test_a_wide_band_is_no_harmonic(tmp_path: Path) -> None:
    """A square wave of 0.5 Hz, and a band at 9.55 Hz that is 0.2 Hz wide, about a multiple of it by chance."""
    random = np.random.default_rng(4)
    n, rate = 12000, 40.0
    turn = np.exp((2j * np.pi * 9.55 - 2.0 * np.pi * 0.2) / rate)
    band = lfilter([1.0], [1.0, -turn], random.standard_normal(n) + 1j * random.standard_normal(n)).real
    line = np.sign(np.sin(2.0 * np.pi * 0.5 * np.arange(n) / rate + 0.1))
    save(tmp_path / "log.npz", {"gx": ("deg/s", 0.1 * random.standard_normal(n) + 0.02 * band + 0.03 * line)}, rate)
    findings = diagnose(tmp_path / "log.npz", axes=["gx"])["axes"]["gx"]["findings"]
    found = [finding["estimate"] for finding in findings if finding["cause"] == "periodic"]
    assert any(each["frequency_hz"]["median"] == pytest.approx(9.55, abs=0.1) for each in found)
    (square,) = (each for each in found if each["frequency_hz"]["median"] == pytest.approx(0.5, abs=0.01))
    assert set(square["harmonics"]) <= {3, 5, 7, 9, 11}


@pytest.mark.parametrize(("n", "turns"), [(3000, 0.0), (3001, 0.0), (2600, 0.4), (2600, 1.2), (2600, 4.0)])
def test_a_line_at_half_the_rate_or_beside_it(n: int, turns: float, tmp_path: Path) -> None:
    """`turns` a record below half of 49 Hz: one line, and none is left beside the written model. Truth: as drawn."""
    random = np.random.default_rng([77, n])
    f, k = 24.5 - turns * 49.0 / n, np.arange(n)
    y = -0.3 + 0.06 * random.standard_normal(n) + 0.035 * np.cos(2.0 * np.pi * f * k / 49.0 + 0.7 * (turns > 0.0))
    save(tmp_path / "log.npz", {"gx": ("deg/s", y)}, 49.0)
    written = tmp_path / "extended.yaml"
    (finding,) = diagnose(tmp_path / "log.npz", axes=["gx"], write_model=written)["axes"]["gx"]["findings"]
    assert finding["cause"] == "periodic"
    for key, truth in (("frequency_hz", f), ("amplitude", 0.035)):
        found = finding["estimate"][key]
        assert abs(found["median"] - truth) < 4.0 * found["sd"]
    # 4 turns: sine and cosine are orthogonal but for 1 part in 25, so the amplitude is as well known as anywhere.
    if turns in (0.0, 4.0):
        assert found["sd"] < 1.1 * 0.06 * math.sqrt((1.0 if turns == 0.0 else 2.0) / n)
    again = diagnose(tmp_path / "log.npz", axes=["gx"], model=written)["axes"]["gx"]
    assert again["verdict"] == "adequate" and not again["findings"]


def test_a_harmonic_at_half_the_rate(tmp_path: Path) -> None:
    """One reading of 4 is higher: 4 Hz and its second harmonic, and none beside the written model."""
    random, k = np.random.default_rng(78), np.arange(1600)
    y = 0.2 + 0.05 * random.standard_normal(k.size) + 0.2 * (k % 4 == 3)
    save(tmp_path / "log.npz", {"gx": ("deg/s", y)}, 16.0)
    written = tmp_path / "extended.yaml"
    (finding,) = diagnose(tmp_path / "log.npz", axes=["gx"], write_model=written)["axes"]["gx"]["findings"]
    assert finding["estimate"]["frequency_hz"]["median"] == pytest.approx(4.0, abs=1e-3)
    assert finding["estimate"]["harmonics"] == [2]
    again = diagnose(tmp_path / "log.npz", axes=["gx"], model=written)["axes"]["gx"]
    assert again["verdict"] == "adequate" and not again["findings"]


def test_a_stated_step_after_the_record_hides_no_turn_on(tmp_path: Path) -> None:
    """Its column is 0 throughout. Truth: the decay as drawn."""
    tree: dict[str, Any] = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    later = {"name": "later", "kind": "step", "time_s": 9000.0, "sd": {"gyro": 1.0}, "probability": 0.5}
    (tmp_path / "model.yaml").write_text(yaml.safe_dump({**tree, "regressors": [later]}), encoding="utf-8")
    t = np.arange(1500.0)
    y = 0.1 * np.random.default_rng(79).standard_normal(t.size) + 0.6 * np.exp(-t / 90.0)
    save(tmp_path / "log.npz", {"gx": ("deg/s", y)}, 1.0)
    (finding,) = diagnose(tmp_path / "log.npz", axes=["gx"], model=tmp_path / "model.yaml")["axes"]["gx"]["findings"]
    assert finding["cause"] == "turn_on"
    assert abs(finding["estimate"]["tau_s"]["median"] - 90.0) < 4.0 * finding["estimate"]["tau_s"]["sd"]


@pytest.mark.parametrize("seed", [3, 20])
def test_two_jumps_are_told_apart(seed: int, tmp_path: Path) -> None:
    """Two jumps of much the same worth. Truth: their times; the interval of one holds nothing of the other."""
    random = np.random.default_rng(seed)
    y = 0.1 * random.standard_normal(3000) + 0.005 * random.standard_normal(3000).cumsum()
    y[900:] += 0.25
    y[2100:] += 0.25
    save(tmp_path / "log.npz", {"gx": ("deg/s", y)}, 1.0)
    findings = diagnose(tmp_path / "log.npz", axes=["gx"])["axes"]["gx"]["findings"]
    assert [finding["cause"] for finding in findings] == ["step", "step"]
    times = sorted((finding["estimate"]["time_s"] for finding in findings), key=lambda time: float(time["median"]))
    for time, place in zip(times, (900, 2100), strict=True):
        assert place - 20.0 < time["q05"] < time["q95"] < place + 20.0


@pytest.mark.parametrize("seed", [12, 37])
def test_outliers_of_one_axis_move_no_other(seed: int, tmp_path: Path) -> None:
    """Six axes of white noise, one in a hundred samples of the last 5 to 8 times as wide. The seeds are those of 40 in
    which the other axes are the loudest beside an outlier by chance."""
    random = np.random.default_rng(seed)
    n = 2500
    values = 0.1 * random.standard_normal((6, n))
    wild = random.random(n) < 0.01
    values[5, wild] *= random.uniform(5.0, 8.0, wild.sum())
    axes = dict(zip(("gx", "gy", "gz", "ax", "ay", "az"), values, strict=True))
    units = {name: "deg/s" if name[0] == "g" else "m/s^2" for name in axes}
    save(tmp_path / "log.npz", {name: (units[name], row) for name, row in axes.items()}, 1.0)
    document = diagnose(tmp_path / "log.npz", axes=["gx", "az"])
    assert document["axes"]["gx"]["findings"] == []
    assert [finding["cause"] for finding in document["axes"]["az"]["findings"]] == ["outliers"]


def test_shaken_accelerometers_move_no_gyroscope(tmp_path: Path) -> None:
    """Three bursts of 5 s on the accelerometers alone, at the edge of what is found. Truth: the axes that were shaken.
    A gyroscope is in an event by chance once in 20 at most (`TOGETHER`). More of them have a probability of 0.1 %."""
    axes, places = ("gx", "gy", "gz", "ax", "ay", "az"), (600, 1500, 2400)
    events, gyros = 0, 0
    for seed in range(24):
        random = np.random.default_rng(seed)
        values = 0.1 * random.standard_normal((6, 3000))
        for place in places:
            values[3:, place : place + 5] *= 3.0
        units = {name: "deg/s" if name[0] == "g" else "m/s^2" for name in axes}
        log = tmp_path / "log.npz"
        save(log, {name: (units[name], row) for name, row in zip(axes, values, strict=True)}, 1.0)
        moved = moves_of(load(log))
        found = {name: {round(sum(span) / 2e2) for span in moved[name].intervals} for name in moved}
        assert all(spans <= {round(place / 100) for place in places} for spans in found.values())
        events += len(set().union(*(found.get(name, set()) for name in axes[3:])))
        gyros += sum(len(found.get(name, ())) for name in axes[:3])
        if seed:
            continue
        shown = diagnose(log)["axes"]
        for name in axes:
            causes = {finding["cause"] for finding in shown[name]["findings"]}
            left = set() if name[0] == "g" else {"outliers", "unexplained"}  # of a burst that is not found
            assert causes - left == ({"motion"} if name in moved else set())
    print(f"{events} events, {gyros} of {3 * events} gyroscopes")
    assert events >= 12
    assert gyros <= binom.ppf(0.999, 3 * events, 0.05)


def test_what_no_cause_explains_is_told_with_its_statistic(tmp_path: Path) -> None:
    """White noise with an echo of itself 157 samples later, and with a line that sweeps; the third axis is clean."""
    random = np.random.default_rng(8)
    n = 3000
    values = 0.1 * random.standard_normal((3, n))
    values[0, 157:] += 0.35 * values[0, :-157]
    turns = np.cumsum(np.linspace(0.05, 0.4, n))
    values[1] += 0.05 * np.sin(2.0 * math.pi * turns)
    axes = dict(zip(("gx", "gy", "gz"), values, strict=True))
    save(tmp_path / "log.npz", {name: ("deg/s", row) for name, row in axes.items()}, 1.0)
    document = diagnose(tmp_path / "log.npz")
    for name, statistic in (("gx", "innovation_largest_correlation"), ("gy", "spectrogram_of_")):
        (finding,) = document["axes"][name]["findings"]
        assert finding["cause"] == "unexplained"
        assert finding["estimate"]["statistic"].startswith(statistic)
    assert document["axes"]["gz"]["verdict"] == "adequate"


def test_the_gain_is_on_time_that_was_not_fitted(tmp_path: Path) -> None:
    """A line of known size: its frequency is looked for in the first half alone, and the second half is scored.

    Truth: a sine of amplitude A that is predicted lowers the mean squared error by A^2/2 at most, so the log score by
    at most A^2 / (4 sigma^2) a sample: a drift that follows the line in part has gained some of it before."""
    log, meta = effect(tmp_path, "periodic:axis=gx,frequency_hz=0.05,amplitude=0.1")
    finding = diagnose(log, axes=["gx"])["axes"]["gx"]["findings"][0]
    score = finding["gain"]["log_score_per_sample"]
    most = 0.1**2 / (4.0 * meta["truth"]["gx"]["N_with_lattice"] ** 2 * RATE_HZ)
    assert 3.0 * score["sd"] < score["after"] - score["before"] < most + 3.0 * score["sd"]


def test_what_the_user_got_wrong_is_one_line(tmp_path: Path) -> None:
    log = tmp_path / "short.csv"
    log.write_text("t[s],gx[deg/s]\n" + "".join(f"{k},{0.1 * (k * 7 % 5)}\n" for k in range(60)))
    with pytest.raises(UserError, match="too short: 60 samples"):
        diagnose(log)
    with pytest.raises(UserError, match="there is no cause 'rust'"):
        diagnose(log, fail_on="rust")
    with pytest.raises(UserError, match="there is no folder"):
        diagnose(log, report=tmp_path / "absent" / "page.html")
    done = run("diagnose", "short.csv", cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1


def test_the_axis_that_is_followed_is_not_blamed(tmp_path: Path) -> None:
    """gx has half of gy in it. The two correlate, but gy is clean."""
    log, _ = effect(tmp_path, "cross_axis:axis=gx,other=gy,coefficient=0.5")
    axes = diagnose(log, axes=["gx", "gy"])["axes"]
    assert [finding["cause"] for finding in axes["gx"]["findings"]] == ["cross_axis"]
    assert axes["gx"]["findings"][0]["estimate"]["other"] == "gy"
    assert axes["gy"]["verdict"] == "adequate"


def test_an_axis_below_its_lattice_stops_no_other(tmp_path: Path) -> None:
    """gx alternates between two codes of the stated lattice, as a sensor whose noise is far below it does."""
    random = np.random.default_rng(1)
    n = 1500
    gx = np.where(random.random(n) < 0.02, 0.05, 0.0)
    log = tmp_path / "log.npz"
    save(log, {"gx": ("deg/s", gx), "gy": ("deg/s", 0.1 * random.standard_normal(n))}, 1.0)
    for decimate in (None, 0.5):
        document = diagnose(log, decimate=decimate)
        assert "below the lattice" in document["axes"]["gx"]["error"]
        assert document["axes"]["gy"]["verdict"] == "adequate"
    assert outcome(document, "inadequate").code == 2  # what cannot be judged has not passed
    for decimate in (0.0, -1.0, math.nan, math.inf, 2.0):
        with pytest.raises(UserError, match="--decimate must be a rate above 0 Hz, at most the recording's 1 Hz"):
            diagnose(log, decimate=decimate)


def test_fail_on_for_a_production_line(tmp_path: Path) -> None:
    effect(tmp_path, "step:axis=gx,time_s=900,amplitude=0.6")
    for wanted, code in (("step", 1), ("supply", 0)):
        done = run("diagnose", "log.npz", "--axis", "gx", "--fail-on", wanted, cwd=tmp_path)
        assert done.returncode == code, done
        assert "step on gx" in done.stdout


def test_identify_names_the_strongest_suspicion(tmp_path: Path) -> None:
    """Of an axis that is not adequate, and of no other: gx has a line."""
    effect(tmp_path, "periodic:axis=gx,frequency_hz=0.05,amplitude=0.1")
    done = run("identify", "log.npz", "--axis", "gx", "--axis", "gy", "--json", "found.json", cwd=tmp_path)
    lines = done.stdout.splitlines()
    at = lines.index("strongest suspicion: gx: periodic")
    assert lines[at + 1] == f"why, and what mends it: {CALLED} diagnose log.npz"
    axes = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))["axes"]
    assert not axes["gx"]["adequate"] and axes["gx"]["suspicion"] == "periodic"
    assert axes["gy"]["adequate"] and "suspicion" not in axes["gy"]
    assert "more_laws" not in axes["gx"]


def test_identify_weighs_more_laws_where_the_drift_does_not_fit(tmp_path: Path) -> None:
    """1/f noise, which no law of the default model is."""
    default = DEFAULT.read_text(encoding="utf-8")
    (tmp_path / "model.yaml").write_text(default.replace("rate_hz: 10.0", f"rate_hz: {RATE_HZ}"), encoding="utf-8")
    simulate(tmp_path / "model.yaml", tmp_path / "log.npz", seed=2, effects=["flicker:axis=gx,B=0.2"])
    done = run("identify", "log.npz", "--axis", "gx", "--json", "found.json", cwd=tmp_path)
    axis = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))["axes"]["gx"]
    assert not axis["adequate"]
    assert set(axis["hypotheses"]) == {"constant", "random_walk", "gauss_markov"}
    assert max(axis["more_laws"], key=axis["more_laws"].__getitem__) == "flicker"
    assert "\nwith the laws of sums.yaml: gx: flicker " in done.stdout


def test_compare_tells_what_changed_and_no_more(tmp_path: Path) -> None:
    """Two records of one law and parameters: the second has a step, and nothing else may be told as a change of N."""
    model = tmp_path / "model.yaml"
    default = DEFAULT.read_text(encoding="utf-8")
    axes = "{gx: {hypothesis: random_walk, bias: 0.1, N: 0.04, K: 1.0e-3}}"
    text = default.replace("rate_hz: 10.0", f"rate_hz: {RATE_HZ}").replace("duration_s: 3600", "duration_s: 1800")
    model.write_text(text.replace("axes: {}", f"axes: {axes}"), encoding="utf-8")
    simulate(model, tmp_path / "a.npz", seed=11)
    simulate(model, tmp_path / "b.npz", seed=12, effects=["step:axis=gx,time_s=900,amplitude=0.6"])
    document = compare([tmp_path / "a.npz", tmp_path / "b.npz"], axes=["gx"])
    rows = {row["quantity"]: row["what"] for row in document["axes"]["gx"]}
    assert rows["step"] == "appeared"
    assert "N" not in rows
    with pytest.raises(UserError, match="two recordings or more"):
        compare([tmp_path / "a.npz"])


def test_a_change_of_the_sampling_clock_is_told(tmp_path: Path) -> None:
    """Truth: from the 1500th of 3000 samples on an interval is 1.02 s instead of 1 s; without it nothing is found."""
    random = np.random.default_rng(5)
    n = 3000
    columns = {name: ("deg/s", 0.01 * random.standard_normal(n)) for name in ("gx", "gy", "gz")}
    for interval in (1.0, 1.02):
        t = np.concatenate([np.arange(1500.0), 1500.0 + interval * np.arange(n - 1500.0)])
        save(tmp_path / "log.npz", columns, 1.0, t=t)
        axis = diagnose(tmp_path / "log.npz", axes=["gx"])["axes"]["gx"]
        if interval == 1.0:
            assert axis["verdict"] == "adequate"
            continue
        (finding,) = axis["findings"]
        assert finding["cause"] == "rate_change"
        found = {key: value["median"] for key, value in finding["estimate"].items()}
        assert found == {
            "time_s": pytest.approx(1500.0, rel=0.02),
            "before_hz": pytest.approx(1.0, rel=1e-3),
            "after_hz": pytest.approx(1.0 / 1.02, rel=1e-3),
        }


INTERRUPTED = """
import os, signal, sys, time
from selfcal import cli
from selfcal.diagnosis import diagnose as verb

loop, last = verb.diagnose_record, time.monotonic()

def interrupted(record, axes, advance, found, *means):
    def noted(text):
        global last
        if text == "gz: round 1":
            while time.monotonic() - last < 2.0:  # until the other axes are done
                time.sleep(0.1)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.2)
        last = time.monotonic()
        advance(text)
    return loop(record, axes, noted, found, *means)

verb.diagnose_record = interrupted
cli.main()
"""


def test_a_model_file_by_hand_is_not_written_over(tmp_path: Path) -> None:
    """One line that names the way out, before any work, and not a byte of the file changes. An empty file, and one that
    diagnose wrote, are written over."""
    log, mine = tmp_path / "log.npz", tmp_path / "mine.yaml"
    save(log, {"gx": ("deg/s", 0.1 * np.random.default_rng(3).standard_normal(300))}, 1.0)
    for by_hand in (DEFAULT.read_bytes(), b"\xff\x00", b"# Written by"):
        mine.write_bytes(by_hand)
        with pytest.raises(UserError, match="give --write-model another name, or delete the file"):
            diagnose(log, write_model=mine)
        assert mine.read_bytes() == by_hand
    mine.write_bytes(b"")
    for _ in range(2):
        diagnose(log, write_model=mine)
        assert Model.load(mine).name.endswith(", extended")


def test_ctrl_c_leaves_what_was_found(tmp_path: Path) -> None:
    """Three axes, walked side by side; the signal comes in the first round of the last one. A step was found before."""
    random = np.random.default_rng(6)
    values = 0.1 * random.standard_normal((3, 1500))
    values[0, 800:] += 0.5
    axes = dict(zip(("gx", "gy", "gz"), values, strict=True))
    save(tmp_path / "log.npz", {name: ("deg/s", row) for name, row in axes.items()}, 1.0)
    files = ["--json", "found.json", "--report", "page.html", "--write-model", "extended.yaml"]
    command = [sys.executable, "-c", INTERRUPTED, "diagnose", "log.npz", *files, "--fail-on", "inadequate"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 130, done
    assert "step on gx: at" in done.stdout
    assert "gz: no result: interrupted before it was done" in done.stdout
    found = json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))["axes"]
    assert [finding["cause"] for finding in found["gx"]["findings"]] == ["step"]
    assert all("interrupted" in found[name]["error"] for name in ("gy", "gz"))
    assert "Not diagnosed: " in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert Model.load(tmp_path / "extended.yaml").regressors[0].kind == "step"


def test_an_end_while_results_are_written_loses_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From when results have to be written no fit goes on. The findings' effect on the bias took passes of its own, and
    all was lost."""
    values = 0.1 * np.random.default_rng(7).standard_normal((2, 1500))
    values[:, 700:] += [[0.5], [0.3]]
    save(tmp_path / "log.npz", {name: ("deg/s", row) for name, row in zip(("gx", "gy"), values, strict=True)}, 1.0)
    monkeypatch.setattr(HeldSignals, "overdue", property(lambda held: True))
    document = diagnose(tmp_path / "log.npz", write_model=tmp_path / "extended.yaml")
    assert [(entry["cause"], list(entry["axes"])) for entry in document["findings"]] == [("step", ["gx", "gy"])]
    assert Model.load(tmp_path / "extended.yaml").regressors[0].kind == "step"


def test_no_output_takes_the_place_of_an_input(tmp_path: Path) -> None:
    log, once = tmp_path / "log.csv", tmp_path / "once"
    log.write_text("t[s],gx[deg/s]\n0,1.0\n0.1,2.0\n")
    before = log.read_bytes()
    for outputs in ({"write_model": log}, {"json": log}, {"report": log}, {"report": once, "write_model": once}):
        with pytest.raises(UserError, match="give it a name of its own"):
            diagnose(log, **outputs)
    assert log.read_bytes() == before
    assert not once.exists()


def test_what_cannot_be_judged_is_told_in_one_line(tmp_path: Path) -> None:
    """A gap of three years at 10 Hz, which no memory holds; and readings in another unit than their heading's."""
    y = np.random.default_rng(1).normal(size=400)
    t = np.arange(400) / 10.0 + np.where(np.arange(400) > 200, 1e8, 0.0)
    far = tmp_path / "far.csv"
    far.write_text("t[s],gx[deg/s]\n" + "".join(f"{a!r},{b!r}\n" for a, b in zip(t.tolist(), y.tolist(), strict=True)))
    with pytest.raises(UserError, match="cut it at its gaps"):
        diagnose(far)
    huge = tmp_path / "huge.npz"
    save(huge, {"gx": ("deg/s", 1e6 * y), "gy": ("deg/s", y)}, 10.0)
    axes = diagnose(huge)["axes"]
    assert "is the unit right?" in axes["gx"]["error"]
    assert "error" not in axes["gy"]


def test_a_copied_column_is_named(tmp_path: Path) -> None:
    """Columns that are one but for a factor and an offset, which no diagnosis can part; the first is judged."""
    random = np.random.default_rng(77)
    own = 0.05 * random.standard_normal(1500)
    save(tmp_path / "log.npz", {"gx": ("deg/s", own), "gz": ("deg/s", 0.4 - 1.5 * own)}, 2.0)
    axes = diagnose(tmp_path / "log.npz", full_rate=True)["axes"]
    assert axes["gx"]["verdict"] == "adequate"
    assert "its readings are those of gx" in axes["gz"]["error"]
