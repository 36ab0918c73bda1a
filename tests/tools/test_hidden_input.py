"""One quantity that nobody recorded and that moves several axes (likelihood/joint.py, diagnosis/hidden.py).

Truth: records drawn here by numpy from the printed model, y_i = c_i + l_i f + d_i + e_i.
"""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from rich.console import Console
from scipy.signal import lfilter

from selfcal.diagnosis import hidden, module
from selfcal.likelihood.joint import bins_of, course, fit_joint, last
from selfcal.likelihood.state import NET_LEAST
from selfcal.logs.recording import load, save
from selfcal.model.file import DEFAULT, Model
from selfcal.show import identification
from selfcal.verbs.codegen import codegen
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify
from selfcal.verbs.simulate import simulate

from conftest import case_records

NAMES = ("gx", "gy", "gz", "ax", "ay", "az")
Array = NDArray[np.float64]


def markov(random: np.random.Generator, n: int, tau: float) -> Array:
    """A Gauss-Markov process of variance 1, `tau` samples long."""
    a = np.exp(-1.0 / tau)
    steps = random.normal(size=n) * np.sqrt(1.0 - a * a)
    steps[0] = random.normal()
    found: Array = lfilter([1.0], [1.0, -a], steps)
    return found


def own(random: np.random.Generator, n: int) -> Array:
    """The drift of one axis: a walk or a Gauss-Markov process."""
    size = np.exp(random.uniform(np.log(0.01), np.log(0.05)))
    found: Array = (
        np.cumsum(size * random.normal(size=n)) if random.random() < 0.5 else 10.0 * size * markov(random, n, 300.0)
    )
    return found


def drawn(random: np.random.Generator, m: int, n: int) -> Array:
    """White noise of variance 1 and a drift of its own on each axis: walks and Gauss-Markov processes alike."""
    y: Array = random.normal(size=(m, n)) + np.array([own(random, n) for _ in range(m)])
    return y


def states(y: Array) -> dict[str, Any]:
    """What `together` takes of an axis: its readings, and a model without columns."""
    found = {}
    for name, row in zip(NAMES, y, strict=False):
        found[name] = SimpleNamespace(y=row, dt=1.0, rest=row, regressors=(), below_lattice=False)
    return found


def test_loadings_and_share_are_those_drawn() -> None:
    """Loadings of 0.4 to 0.8 N on six axes, tau 60 s, one hour. The loadings' error is 0.1 of their size where the gain
    is some 200 nats (information of each: 2 nats a percent); 0.3 is three times that."""
    random = np.random.default_rng(31)
    truth = random.uniform(0.4, 0.8, 6) * random.choice([-1.0, 1.0], 6)
    y = drawn(random, 6, 3600) + np.outer(truth, markov(random, 3600, 60.0))
    seen = module.together(states(y), {})
    assert seen is not None
    found = seen.hidden
    assert found is not None
    assert found.worth(stated=False)[0] > 100.0
    loading = found.model.loading * found.scale * np.sign(found.model.loading @ truth)
    assert np.abs(loading / truth - 1.0).max() < 0.3
    assert 25.0 < 1.0 / found.model.rate < 150.0


@pytest.mark.parametrize("seed", [33, 34])
def test_jumps_are_no_steps_of_its_law(seed: int) -> None:
    """A walk with three jumps of 40 of its steps: their square would make its law 1.5 times too large in 3600 s. A
    loading is known to 0.15 of its size, the mean of six to 0.06, a jump to 0.1: three times that is allowed."""
    random = np.random.default_rng(seed)
    truth = random.uniform(0.04, 0.07, 6)
    f, places = np.cumsum(random.normal(size=3600)), (900, 1900, 2700)
    for place, size in zip(places, (40.0, -40.0, 40.0), strict=True):
        f[place:] += size
    seen = module.together(states(drawn(random, 6, 3600) + np.outer(truth, f)), {})
    assert seen is not None and seen.hidden is not None
    found = seen.hidden
    loading = np.array([found.loading(name) for name in NAMES])
    assert abs(float(np.mean(loading / truth)) - 1.0) < 0.18
    assert [jump["time_s"] for jump in found.jumps] == pytest.approx(places, abs=2.0)  # beside its own steps
    assert [jump["size"] for jump in found.jumps] == pytest.approx([40.0, -40.0, 40.0], rel=0.3)


def test_jumps_are_no_part_of_a_walk(tmp_path: Path) -> None:
    """Six walks of 0.03 N a second beside 0.05 N of a quantity with three jumps of 40 of its steps, of which K takes
    1.3 times the walk's. K is known to some 8 % of an axis, 3 % of all six: three times that is allowed. A model that
    states the quantity leaves its jumps to be found, for they are the record's."""
    random, n = np.random.default_rng(35), 3600
    f = np.cumsum(random.normal(size=n))
    for place, size in ((900, 40.0), (1900, -40.0), (2700, 40.0)):
        f[place:] += size
    y = random.normal(size=(6, n)) + np.cumsum(0.03 * random.normal(size=(6, n)), axis=1) + 0.05 * f
    save(
        tmp_path / "log.npz",
        {name: ("deg/s", row) for name, row in zip(NAMES[:3], y, strict=False)}
        | {name: ("m/s^2", row) for name, row in zip(NAMES[3:], y[3:], strict=True)},
        1.0,
        {},
    )
    document = diagnose(tmp_path / "log.npz", write_model=tmp_path / "model.yaml")
    (finding,) = document["findings"]
    assert len(finding["estimate"]["jumps"]) == 3
    K = [axis["numbers"]["K"] for axis in document["axes"].values()]
    assert np.mean([each["after"]["median"] for each in K]) == pytest.approx(np.hypot(0.03, 0.05), rel=0.09)
    assert all(each["after"]["q95"] < each["before"] for each in K)
    assert min(change["K"] for change in finding["changes"].values()) > 1.15
    (again,) = diagnose(tmp_path / "log.npz", model=tmp_path / "model.yaml")["findings"]
    assert [jump["time_s"] for jump in again["estimate"]["jumps"]] == pytest.approx([900.0, 1900.0, 2700.0], abs=2.0)
    assert again["words"].startswith("The hidden quantity of the model file jumps")


def test_axes_of_their_own_share_nothing() -> None:
    """A record in 2000 may show something (P_LOOK): none of these may, by more than a chance of 1 in 100."""
    for seed in range(case_records(8, 100)):
        random = np.random.default_rng([7, seed])
        y = drawn(random, int(random.integers(3, 7)), int(random.choice([1200, 2400])))
        if seed % 2:  # white noise may go together all the same
            y[1] = 0.6 * y[0] + 0.8 * y[1]
        bins = bins_of(y - y.mean(axis=1)[:, None])
        null = fit_joint(bins, 1.0, False)
        worth = fit_joint(bins, 1.0, True, null).value - null.value
        assert hidden.net(worth, len(y) + 1, hidden.LN_EITHER) < NET_LEAST or seed % 2, seed


def test_a_jump_of_five_axes_is_none() -> None:
    """One event at one time is no quantity that wanders: a step of five axes."""
    random = np.random.default_rng(5)
    y = drawn(random, 6, 3600)
    y[:5, 1800:] += np.array([1.4, -1.8, 2.0, 1.2, -2.2])[:, None]
    seen = module.together(states(y), {})
    assert seen is not None
    assert seen.hidden is None
    (event,) = seen.events
    assert event.cause == "step"
    assert event.act.axes == [0, 1, 2, 3, 4]


def test_the_filter_is_the_dense_likelihood() -> None:
    """ln likelihood of one model less another's, against the dense normal density of the record: the wide prior of the
    levels is the same in both, so it cancels but for 1e-6."""
    random = np.random.default_rng(11)
    y = drawn(random, 3, 60) + np.outer([0.5, 0.7, -0.6], markov(random, 60, 10.0))
    model = fit_joint(bins_of(drawn(random, 3, 600)), 1.0, True)
    other = replace(model, loading=np.zeros_like(model.loading))
    got = course(model, y).ln_likelihood - course(other, y).ln_likelihood

    def dense(of: Any) -> float:
        n = 60
        t = np.arange(n)
        S = np.kron(np.outer(of.loading, of.loading), np.exp(-of.rate * np.abs(t[:, None] - t)))
        S += np.kron(of.correlation * np.outer(of.white, of.white), np.eye(n))
        for k, (ln_n, ln_rho, ln_m, ln_a) in enumerate(of.own):
            own = np.exp(2.0 * (ln_n + ln_rho)) * np.minimum.outer(t, t)
            own = own + np.exp(2.0 * (ln_n + ln_m)) * np.exp(-np.exp(ln_a) * np.abs(t[:, None] - t)) + 1e6
            S[k * n : (k + 1) * n, k * n : (k + 1) * n] += own
        x = y.ravel()
        return float(-0.5 * (np.linalg.slogdet(S)[1] + x @ np.linalg.solve(S, x)))

    # The filter leaves out the first sample, which only sets the levels; in the density its part is the same in both.
    assert got == pytest.approx(dense(model) - dense(other), abs=1e-2)


def test_the_last_bias_is_the_dense_one() -> None:
    """Mean and variance of each axis after the last sample, given all readings, against the dense normal density: their
    levels have a prior of 1e3 there, of 1e3 times the noise or more in the filter, so 1e-4 of a deviation is left."""
    random = np.random.default_rng(12)
    n, m = 50, 3
    y = drawn(random, m, n) + np.outer([0.5, 0.7, -0.6], markov(random, n, 10.0))
    y[1, 20:24] = np.nan
    model = replace(fit_joint(bins_of(drawn(random, m, 600)), 1.0, True), loading=np.array([0.5, 0.7, -0.6]), rate=0.1)
    t = np.arange(n + 1)
    S = np.kron(np.outer(model.loading, model.loading), np.exp(-model.rate * np.abs(t[:, None] - t)))
    for k, (ln_n, ln_rho, ln_m, ln_a) in enumerate(model.own):
        own_drift = np.exp(2.0 * (ln_n + ln_rho)) * np.minimum.outer(t, t) + 1e6
        own_drift += np.exp(2.0 * (ln_n + ln_m)) * np.exp(-np.exp(ln_a) * np.abs(t[:, None] - t))
        S[k * (n + 1) : (k + 1) * (n + 1), k * (n + 1) : (k + 1) * (n + 1)] += own_drift
    read = S + np.kron(model.correlation * np.outer(model.white, model.white), np.eye(n + 1))
    x = np.column_stack([y, np.full(m, np.nan)]).ravel()
    there = np.flatnonzero(np.isfinite(x))
    wanted = np.arange(1, m + 1) * (n + 1) - 1
    gain = np.linalg.solve(read[np.ix_(there, there)], S[np.ix_(there, wanted)])
    mean, sd = last(model, y)
    assert mean == pytest.approx(gain.T @ x[there], abs=1e-3)
    variance = np.diag(S)[wanted] - np.sum(S[np.ix_(there, wanted)] * gain, axis=0)
    assert sd == pytest.approx(np.sqrt(variance), rel=1e-3)


def test_identify_tells_the_bias_by_all_axes(tmp_path: Path) -> None:
    """A quantity that makes the most of three axes' drifts, in another unit than the model's. The stated sd falls, by
    3^-1/4 = 0.76 if the axes had no drifts of their own, and the bias holds the truth within 4 of it. An axis alone has
    no such bias."""
    random = np.random.default_rng(19)
    n, step = 2400, np.sqrt(-2.0 * np.expm1(-1.0 / 80.0))
    f, alone = markov(random, n, 80.0), 57.29578
    biases = {name: 0.03 * (np.cumsum(0.003 * random.normal(size=n)) + 0.8 * f) for name in NAMES[:3]}
    rows = {name: ("rad/s", (row + 0.03 * random.normal(size=n)) / alone) for name, row in biases.items()}
    save(tmp_path / "log.npz", rows, 1.0, {})
    tree = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    law = [{"kind": "markov", "deviation": float(1.0 / step), "alpha": 1.0 / 80.0}]
    loadings = dict.fromkeys(biases, float(0.03 * 0.8 * step))
    tree["hidden_input"] = {"law": law, "loadings": loadings, "noise_correlation": {}}
    (tmp_path / "model.yaml").write_text(yaml.safe_dump(tree), encoding="utf-8")
    document = identify(tmp_path / "log.npz", model=tmp_path / "model.yaml")
    for name, axis in document["axes"].items():
        now = axis["bias_now"]
        assert now["together"]["sd"] < 0.95 * now["sd"]
        assert abs(now["together"]["mean"] - biases[name][-1] / alone) < 4.0 * now["together"]["sd"]
    identification.show(document, console=Console(file=(shown := StringIO()), width=200))
    assert f"gz {document['axes']['gz']['bias_now']['together']['mean']:.6g} ±" in shown.getvalue()
    one = identify(tmp_path / "log.npz", model=tmp_path / "model.yaml", axes=["gx"])
    assert "together" not in one["axes"]["gx"]["bias_now"]


def test_diagnose_names_it_and_every_verb_reads_its_model(tmp_path: Path) -> None:
    """Three gyros and three accelerometers that one quantity moves."""
    random = np.random.default_rng(17)
    n = 1500
    f = markov(random, n, 40.0)
    units = dict.fromkeys(NAMES[:3], ("deg/s", 0.03)) | dict.fromkeys(NAMES[3:], ("m/s^2", 0.004))
    y = random.normal(size=(6, n)) + 0.9 * f
    save(
        tmp_path / "log.npz",
        {name: (units[name][0], units[name][1] * row) for name, row in zip(NAMES, y, strict=True)},
        1.0,
        {},
    )
    model = tmp_path / "model.yaml"
    document = diagnose(tmp_path / "log.npz", write_model=model, on=tmp_path / "log.npz")
    (finding,) = document["findings"]
    score = finding["gain_on"]["log_score_per_sample"]
    assert (score["after"] - score["before"]) * score["samples"] > 0.9 * finding["evidence_nats"]  # the record itself
    assert finding["cause"] == "hidden_input"
    assert set(finding["axes"]) == set(NAMES)
    assert finding["confirmed"]
    step = np.sqrt(-2.0 * np.expm1(-1.0 / 40.0))  # its unit is its step in a second
    for name, one in finding["axes"].items():
        truth = 0.9 * units[name][1] * step
        assert abs(abs(one["estimate"]["loading"]["median"]) / truth - 1.0) < 0.4, name
    stated = Model.load(model).hidden_input
    assert stated is not None
    assert set(stated.loadings) == set(NAMES)
    assert diagnose(tmp_path / "log.npz", model=model, axes=["gx"])["findings"] == []
    assert identify(tmp_path / "log.npz", model=model, axes=["gx"])["axes"]["gx"]["adequate"] is not None
    codegen(model, tmp_path / "tables")
    simulate(model, tmp_path / "again.npz", seed=4)
    drawn_again = load(tmp_path / "again.npz")
    # Over 10 s the quantity has 0.9^2 N^2 and white noise 0.1 N^2: a correlation of 0.85 without drifts of their own.
    smooth = [np.convolve(drawn_again.columns[name].values, np.ones(10) / 10.0, "valid") for name in ("ax", "ay")]
    assert np.corrcoef(*smooth)[0, 1] > 0.5
