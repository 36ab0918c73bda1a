"""Laws that are sums (flicker; random walk beside moving-average white noise): model models/sums.yaml.

Judges: the textbook bank of host_sim, which shares no code with lib/ and has the terms as states of its filter, and the
same report on dense nodes. Tolerances are those of the design (test_bank.py, test_report.py).
"""

from __future__ import annotations

import math
import os
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from test_forgetting import weights

from selfcal import _reference
from selfcal.engines.library import Bank
from selfcal.engines.reference import identify_axis
from selfcal.errors import UserError
from selfcal.model import DEFAULT, LAWS, SUMS, Model
from selfcal.tables import RegressorTable, Tables, make_grid, make_tables
from selfcal.verbs.codegen import codegen
from selfcal.verbs.montecarlo import draw, simulate_bank_samples
from selfcal.verbs.replay import replay

from conftest import ROOT, worst_difference

LN_P_DOUBLE, PROBABILITY_DOUBLE = 1e-3, 1e-6
#: |dP| and |d mean| / sd of each build.
BUILDS = {"float": (1e-3, 0.02), "fixed16": (5e-3, 0.05)}
#: Nodes this far below the best carry e^-30 of the weight.
DEPTH = 30.0

MODEL = Model.load(DEFAULT.parent / "sums.yaml")
GROUP = MODEL.group_of("gx")
#: Records a law.
DRAWS = int(os.environ.get("SELFCAL_DRAWS", "1"))


def tables(
    target: str = "host", columns: int = 0, only: str | None = None, pair: tuple[int, int] | None = None
) -> Tables:
    """gx at 1 Hz, without a range, with regressors of standard deviation 10 a unit. `only` one law, on `pair` nodes."""
    made = make_tables(MODEL, 1.0, ("gx",), target)
    hypotheses = made.hypotheses
    if only is not None:
        hypotheses = tuple(replace(h, ln_probability=0.0) for h in hypotheses if h.name == only)
    if pair is not None:
        hypotheses = tuple(replace(h, rho=make_grid(pair[0]), alpha=make_grid(pair[1])) for h in hypotheses)
    return replace(
        made,
        axes=(replace(made.axes[0], range=0.0),),
        hypotheses=hypotheses,
        regressors=tuple(RegressorTable(f"z{k}", "1", 0.0, (10.0,)) for k in range(columns)),
    )


def a_record(law: str, n: int, seed: int, *, gaps: bool = False) -> NDArray[np.float64]:
    """float64[n] in float32's values, parameters from the priors; with `gaps`, three stretches are missing."""
    rng = np.random.default_rng([n, seed, list(LAWS).index(law)])
    y, _ = simulate_bank_samples(law, draw(GROUP, law, rng), 1.0, n, seed=seed)
    y = y.astype(np.float32).astype(np.float64)
    if gaps:
        for start, length in zip(rng.integers(1, n - 1, 3), (1, max(n // 20, 1), max(n // 5, 1)), strict=True):
            y[start : min(start + length, n - 1)] = np.nan
    return y


def a_bank(made: Tables, build: str) -> Bank:
    if build == "fixed16":
        return Bank(made, fixed=16)
    if build == "fixed32":
        return Bank(made, fixed=32)
    return Bank(made, double=build == "double")


def push(bank: Bank, y: NDArray[np.float64], z: NDArray[np.float64] | None = None) -> None:
    have = np.isfinite(y)
    missing = np.diff(np.flatnonzero(have), prepend=-1) - 1
    bank.push(y[have, None], missing, None if z is None else z[have])


# ------------------------------------------------------------------------------------------------- against the textbook


def textbook(
    y: NDArray[np.float64],
    nodes: list[dict[str, float]],
    sigma: NDArray[np.float64],
    z: NDArray[np.float64] | None,
) -> NDArray[np.float64]:
    """ln p [nodes, sigma] by the textbook, law by law."""
    offset = float(np.nanmean(y))
    found = np.empty((len(nodes), sigma.size))
    laws = np.array([node["law"] for node in nodes])
    for law in np.unique(laws):
        mine = [node for node in nodes if node["law"] == law]
        rho = np.exp(np.nan_to_num([node["ln_rho"] for node in mine]))
        alpha = np.exp(np.nan_to_num([node["ln_alpha"] for node in mine]))
        ln_p, _, _ = _reference.run_filters(
            y - offset,
            1.0,
            -offset,
            GROUP.priors["bias"].sd,
            np.full(rho.size * sigma.size, law, np.int32),
            np.outer(rho, sigma).ravel(),
            np.repeat(alpha, sigma.size),
            np.tile(sigma, rho.size),
            z=z,
            coefficient_sd=None if z is None else np.full(z.shape[1], 10.0),
        )
        found[laws == law] = ln_p.reshape(-1, sigma.size)
    return found


def differences(
    ours: NDArray[np.float64], theirs: NDArray[np.float64], nodes: list[dict[str, float]], sigma: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Largest |d ln p| near the best node, |dP| of a law, |d mean| / sd of a parameter, under flat weights."""
    near = theirs > theirs.max() - DEPTH
    weights = [np.exp(ln_p - ln_p.max()) for ln_p in (ours, theirs)]
    weights = [w / w.sum() for w in weights]
    laws = np.array([node["law"] for node in nodes])
    rho, alpha = (np.exp(np.nan_to_num([node[key] for node in nodes])) for key in ("ln_rho", "ln_alpha"))
    values = (np.broadcast_to(sigma, theirs.shape), np.outer(rho, sigma), np.repeat(alpha[:, None], sigma.size, 1))
    probability = mean = 0.0
    for law in range(len(LAWS)):
        a, b = (w[laws == law] for w in weights)
        probability = max(probability, abs(float(a.sum() - b.sum())))
        if b.sum() < 1e-3:
            continue
        for value in values:
            x = value[laws == law]
            exact = float((b * x).sum() / b.sum())
            sd = math.sqrt(max(float((b * (x - exact) ** 2).sum() / b.sum()), 0.0))
            if sd > 1e-9 * abs(exact):
                mean = max(mean, abs(float((a * x).sum() / a.sum()) - exact) / sd)
    return float(np.abs(ours - theirs)[near].max()), probability, mean


@pytest.mark.parametrize("columns", [0, 2])
@pytest.mark.parametrize("gaps", [False, True], ids=["whole", "gaps"])
@pytest.mark.parametrize("n", [10, 100, 1000, 10_000])
def test_parity_with_the_textbook_bank(n: int, gaps: bool, columns: int) -> None:
    """All five laws in one bank, on records of the sums and of a random walk; with regressors, all of them in use."""
    worst: dict[str, float] = {}
    made = tables("cortex-m0", columns)
    for law in (*SUMS, "random_walk") if n < 10_000 else SUMS:
        for seed in range(DRAWS):
            y = a_record(law, n, seed, gaps=gaps)
            t = np.arange(float(n))
            z = np.column_stack([t / n, np.sin(0.01 * t)])[:, :columns].astype(np.float32).astype(np.float64)
            y += z.sum(axis=1)
            y = y.astype(np.float32).astype(np.float64)
            used = np.ascontiguousarray(z) if columns else None
            banks = {build: a_bank(made, build) for build in ("double", *BUILDS)}
            for bank in banks.values():
                push(bank, y, used)
            nodes = [banks["double"].raw.node(0, j) for j in range(made.nodes)]
            residual = [(node["c"] - node["b"] ** 2 / node["a"]) / max(n - 1, 1) for node in nodes]
            level = math.sqrt(max(min(residual), 1e-30))
            if columns:  # the residual has the regressors in it
                level = float(np.nanstd(np.diff(y)) / math.sqrt(2.0))
            sigma = level * np.exp(np.linspace(-4.0, 4.0, 5) / math.sqrt(2.0 * n))
            theirs = textbook(y, nodes, sigma, used)
            for name, bank in banks.items():
                of_node = bank.raw.log_likelihood_subset
                ours = np.array([[of_node(0, j, 2**columns - 1, s) for s in sigma] for j in range(len(nodes))])
                ln_p, p, mean = differences(ours, theirs, nodes, sigma)
                for key, value in ((f"{name} d ln p", ln_p), (f"{name} dP", p), (f"{name} d mean/sd", mean)):
                    worst[key] = max(worst.get(key, 0.0), value)
    each = ", ".join(f"{key} {value:.2g}" for key, value in worst.items())
    print(f"\nn={n} gaps={gaps} regressors={columns}: {each}")
    assert worst["double d ln p"] <= LN_P_DOUBLE
    assert worst["double dP"] <= PROBABILITY_DOUBLE
    for name, (p_limit, mean_limit) in BUILDS.items():
        assert worst[f"{name} dP"] <= p_limit
        assert worst[f"{name} d mean/sd"] <= mean_limit


def test_the_sums_forget() -> None:
    """ln-likelihood of flicker nodes with a half-life of 100 s, by the printed recursion of a filter with three states,
    on y and on "1", each sample weighed as test_forgetting.py has it. 1e-3 nat in double; integers relative to that by
    2e-3, what float sums of 700 samples may be off."""
    half_life, n, sigma = 100.0, 700, 0.06
    y = a_record("flicker", n, 2)
    made = replace(tables("cortex-m0", only="flicker"), half_life_s=half_life)
    banks = {build: a_bank(made, build) for build in ("double", "float", "fixed16")}
    for bank in banks.values():
        push(bank, y)
    w, sd = weights(np.zeros(n, np.int64), half_life), GROUP.priors["bias"].sd
    for index in range(0, made.nodes, 5):
        node = banks["double"].raw.node(0, index)
        rates = np.exp(node["ln_alpha"]) * np.array([0.1, 1.0, 10.0])
        phi, variance = np.exp(-rates), math.exp(2.0 * node["ln_rho"]) * math.log(10.0) / math.pi
        p, q = np.eye(3) * variance, np.diag(-np.expm1(-2.0 * rates)) * variance
        series, x = np.column_stack([y, np.ones(n)]), np.zeros((3, 2))
        sums, ln_s = np.zeros((2, 2)), 0.0
        for i in range(n):
            nu, s = series[i] - x.sum(axis=0), 1.0 + p.sum()
            sums += w[i] * np.outer(nu, nu) / s
            ln_s += w[i] * math.log(s)
            gain = p.sum(axis=1) / s
            x = phi[:, None] * (x + np.outer(gain, nu))
            p = phi[:, None] * (p - s * np.outer(gain, gain)) * phi + q
        a, b, c = sums[1, 1] / sigma**2, sums[0, 1] / sigma**2, sums[0, 0] / sigma**2
        of_prior = b * b / a - b * b / (a + sd**-2) + math.log1p(a * sd**2)  # counts as the first sample does
        truth = -0.5 * (w.sum() * math.log(2.0 * math.pi * sigma**2) + ln_s + c - b * b / a + w[0] * of_prior)
        for build, bank in banks.items():
            limit = 1e-3 if build == "double" else 2e-3 + 1e-6 * abs(truth)
            assert bank.raw.log_likelihood(0, index, sigma) == pytest.approx(truth, abs=limit), build


# ------------------------------------------------------------------------------------------------------------ reports


@pytest.mark.parametrize("n", [10, 100, 1000])
@pytest.mark.parametrize(("law", "dense"), [("flicker", (40, 36)), ("moving_average", (40, 30))])
def test_report_against_dense_nodes(law: str, dense: tuple[int, int], n: int) -> None:
    """The nodes of the model file against so many that theirs no longer counts, over the whole prior: tolerances of the
    design for nine records in ten, as test_report.py says. No expectation is taken off before the splines."""
    found = []
    for truth in (law, "random_walk"):
        for seed in range(2 * DRAWS):
            y = a_record(truth, n, seed)
            banks = Bank(tables(only=law)), Bank(tables(only=law, pair=dense), dense=True)
            for bank in banks:
                push(bank, y)
            evidence, _, mean, sd = worst_difference(*(bank.report(0) for bank in banks))
            found.append([evidence, mean, sd])
    values = np.array(found)
    worst = values.max(axis=0)
    good = (values <= np.array([0.05, 0.05, 0.03])).all(axis=1).mean()
    print(f"\n{law} n={n}: worst d ln evidence {worst[0]:.3f}, mean {worst[1]:.3f} sd, sd {100 * worst[2]:.1f} %")
    assert good >= 0.75  # of four records one may lie where the drift hides the white noise


@pytest.mark.parametrize("columns", [0, 2])
@pytest.mark.parametrize("law", SUMS)
def test_prediction_is_that_of_a_gap(law: str, columns: int) -> None:
    """selfcal_predict() has closed forms for the terms' decay, a gap goes through the filters. Both are sums over the
    nodes, equal but for rounding, under flicker; a walk's growth is by the report's moments of K, which come from its
    cells, and within the design's 3 % of an sd."""
    made = tables("cortex-m4f", columns, only=law)
    y = a_record(law, 300, 5)
    z = np.column_stack([np.arange(300.0) / 300.0, np.zeros(300)])[:, :columns] if columns else None
    before = Bank(made)
    push(before, y, z)
    horizons = [1, 10, 100, 3000]
    for horizon, (mean, sd) in zip(horizons, before.raw.predict(0, [float(h) for h in horizons]), strict=True):
        bank = Bank(made)
        push(bank, y, z)
        bank.raw.skip(horizon)
        after = bank.report(0)
        assert mean == pytest.approx(after.bias_mean, abs=1e-3 * after.bias_sd)
        assert sd == pytest.approx(after.bias_sd, rel=1e-3 if law == "flicker" else 0.03)


@pytest.mark.parametrize("build", ["float", "double", "fixed16", "fixed32"])
def test_a_restored_bank_goes_on_bit_for_bit(build: str) -> None:
    """Saved in mid-batch after a gap, restored, and fed the rest: the bytes of a bank that was never stopped."""
    made = tables("cortex-m0")
    y = a_record("flicker", 250, 3, gaps=True)
    banks = [a_bank(made, build) for _ in range(2)]
    push(banks[0], y[:131])
    banks[1].restore(banks[0].save())
    for bank in banks:
        push(bank, y[131:])
        assert bank.raw.sound
    assert banks[0].save() == banks[1].save()
    assert banks[0].report(0) == banks[1].report(0)


@pytest.mark.parametrize(
    ("law", "truth"),
    [
        ("flicker", {"N": 0.02, "B": 0.02, "alpha": 0.01}),
        ("moving_average", {"N": 0.02, "K": 1e-3, "spectral_ratio": 3.0}),
        ("moving_average", {"N": 0.02, "K": 1e-3, "spectral_ratio": 0.4}),
    ],
)
def test_the_right_law_wins(law: str, truth: dict[str, float]) -> None:
    """Where a record of 10 000 s tells the laws apart, the right one has the greatest probability: at least 19 times in
    20, one error of 5 % being likelier than not."""
    made = tables("cortex-m4f")
    right = 0
    for seed in range(20):
        y, _ = simulate_bank_samples(law, truth, 1.0, 10_000, seed=1000 + seed)
        bank = Bank(made)
        push(bank, y)
        probability = bank.report(0).probability
        right += max(probability, key=lambda name: probability[name]) == law
    assert right >= 19


@pytest.mark.parametrize("law", SUMS)
def test_intervals_hold_what_they_say(law: str) -> None:
    """Parameters from the prior: each 90 % interval, and that of the bias, holds the truth in 90 % of the records,
    within 3.5 standard deviations of the binomial."""
    records = 100
    made = tables(only=law)
    inside: dict[str, int] = {}
    for seed in range(records):
        truth = draw(GROUP, law, np.random.default_rng([9, seed, len(law)]))
        y, bias = simulate_bank_samples(law, truth, 1.0, 500, seed=5000 + seed)
        bank = Bank(made)
        push(bank, y)
        result = bank.report(0)
        for name, estimate in result.parameters[law].items():
            inside[name] = inside.get(name, 0) + (estimate.q05 <= truth[name] <= estimate.q95)
        inside["bias"] = inside.get("bias", 0) + (abs(result.bias_mean - bias) < 1.6449 * result.bias_sd)
    print(f"\n{law}: of {records} inside {inside}")
    slack = 3.5 * math.sqrt(0.9 * 0.1 * records)
    assert all(abs(count - 0.9 * records) <= slack for count in inside.values())


@pytest.mark.parametrize("law", SUMS)
def test_the_reference_engine_answers_alike(law: str) -> None:
    """Textbook over a refined lattice of the continuous prior against the library's report, on 200 samples: the
    design's tolerances of a report."""
    y = a_record(law, 200, 11)
    bank = Bank(tables(only=law))
    push(bank, y)
    ours, theirs = bank.report(0), identify_axis(y, 1.0, GROUP, {law: 1.0})
    evidence, _, mean, sd = worst_difference(ours, theirs)
    print(f"\n{law}: d ln evidence {evidence:.3f}, d mean {mean:.3f} sd, sd {100 * sd:.1f} %")
    assert evidence <= 0.05
    assert mean <= 0.05
    assert sd <= 0.03
    assert ours.bias_mean == pytest.approx(theirs.bias_mean, abs=0.05 * theirs.bias_sd)
    assert ours.bias_sd == pytest.approx(theirs.bias_sd, rel=0.03)


# ----------------------------------------------------------------------------------------------------- model and tables


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("      B: {law: log_uniform, min: 5.0e-4, max: 0.5}\n", "", "groups.gyro.priors: 'B' is missing"),
        ("min: 0.2, max: 5.0", "min: 1.0e-4, max: 5.0", "spectral_ratio: must lie within 0.001 to 1000"),
        (", moving_average: [24, 20]", "", "nodes.host: 'moving_average' is missing"),
        ("flicker: [24, 20]", "flicker: 16", "nodes.host.flicker: must be [rho nodes, alpha nodes]"),
        ("moving_average: [24, 20]", "moving_average: [24, 4]", "must be a whole number from 6 to 24, not 4"),
    ],
)
def test_a_model_file_that_does_not_fit(tmp_path: Path, old: str, new: str, complaint: str) -> None:
    text = MODEL.path.read_text()
    assert old in text
    path = tmp_path / "model.yaml"
    path.write_text(text.replace(old, new))
    with pytest.raises(UserError) as error:
        Model.load(path)
    assert complaint in str(error.value)


def test_tables_for_the_firmware_compile_with_the_macro_alone(tmp_path: Path) -> None:
    """Warnings are errors, as `make check` has them; without SELFCAL_TERMS_MAX one clear #error."""
    codegen(MODEL.path, tmp_path)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror", "-DSELFCAL_HYPOTHESES_MAX=5"]
    files = ["-c", str(tmp_path / "selfcal_model.c"), "-o", str(tmp_path / "model.o")]
    command = ["cc", *flags, f"-I{ROOT / 'lib'}", *files]
    assert subprocess.run([*command, "-DSELFCAL_TERMS_MAX=3"], check=False).returncode == 0
    refused = subprocess.run(command, check=False, capture_output=True, text=True)
    assert refused.returncode != 0
    assert "set SELFCAL_TERMS_MAX to 3" in refused.stderr


def test_the_firmware_does_not_take_them() -> None:
    with pytest.raises(UserError, match="telemetry has no items for flicker and moving_average"):
        replay(ROOT / "tests" / "data" / "simulated_adis16405.npz", model=MODEL.path)
