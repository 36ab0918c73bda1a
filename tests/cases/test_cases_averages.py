"""Are the intervals honest where the intake averages? Records are drawn sample by sample and averaged, as a sensor and
the intake do; neither has the block means' closed forms in it. `make cases` takes 400 records a cell.

Truth: the parameters of each record. Tolerances: three standard deviations of a binomial count.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from selfcal.adequacy.checks import drift_check, judge_record
from selfcal.bank.blocks import Blocks
from selfcal.bank.library import Bank
from selfcal.bank.reference import reference_axis
from selfcal.logs.recording import save
from selfcal.model.file import Model, Prior
from selfcal.model.laws import lost_of
from selfcal.model.tables import make_tables
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify

from conftest import case_records

#: Samples a block, and blocks of 1 s a record.
BLOCK, BLOCKS = 50, 1000
MODEL = Model.load()
GROUP = MODEL.group_of("gx")
TABLES = make_tables(MODEL, float(BLOCK), ("gx",))
RECORDS = case_records(12, 400)
#: Step of the drift in a bank interval over the white noise of a bank sample: 0.05 to 1 of the walks, 0.3 to 1.1 of the
#: Gauss-Markov drifts.
COVERED = [
    ("random_walk", {"N": 0.02, "K": 0.001}),
    ("random_walk", {"N": 0.02, "K": 0.006}),
    ("random_walk", {"N": 0.02, "K": 0.012}),
    ("random_walk", {"N": 0.01, "K": 0.01}),
    ("gauss_markov", {"N": 0.02, "sigma_m": 0.03, "alpha": 0.02}),
    ("gauss_markov", {"N": 0.02, "sigma_m": 0.05, "alpha": 0.1}),
    ("gauss_markov", {"N": 0.02, "sigma_m": 0.02, "alpha": 0.15}),
]


#: Records of each further kind, and truths of them in their 90 % intervals, at least and at most: outside as rarely as
#: a normal beyond 3 sd.
TRUTHS = case_records(40, 400)
LEAST, MOST = (int(binom.ppf(p, TRUTHS, 0.9)) for p in (1.35e-3, 1.0 - 1.35e-3))
#: Drifts that move 0.3 and 1 times the white noise in a bank interval, and a Gauss-Markov one.
FAST = [COVERED[1], COVERED[3], COVERED[5]]
#: ... 1.4, 1.6 and 1.4 times: an averaged drift hides 0.3 to 0.4 of the white noise.
FASTER = [
    ("random_walk", {"N": 0.003, "K": 0.0042}),
    ("random_walk", {"N": 0.003, "K": 0.0048}),
    ("gauss_markov", {"N": 0.02, "sigma_m": 0.0467, "alpha": 0.18}),
]


def readings(
    law: str, truth: Mapping[str, float], rng: np.random.Generator, count: int = BLOCK * BLOCKS
) -> tuple[np.ndarray, np.ndarray]:
    """Samples [count], and bias and drift at each."""
    dt = 1.0 / BLOCK
    steps = rng.normal(size=count)
    if law == "random_walk":
        drift = np.cumsum(truth["K"] * math.sqrt(dt) * steps)
    else:
        phi = math.exp(-truth["alpha"] * dt)
        steps[1:] *= math.sqrt(1.0 - phi**2)
        drift = lfilter([truth["sigma_m"]], [1.0, -phi], steps)
    drift += float(rng.normal())
    return drift + truth["N"] / math.sqrt(dt) * rng.normal(size=count), drift


def record(law: str, truth: Mapping[str, float], rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Block means [BLOCKS], and bias and drift at the last sample."""
    samples, level = readings(law, truth, rng)
    return samples.reshape(BLOCKS, BLOCK).mean(axis=1), float(level[-1])


def ensemble(law: str, truth: Mapping[str, float], seed: int) -> dict[str, float]:
    """Shares of RECORDS: of each parameter and the bias how many truths are in the 90 % interval; `adequate`; `flagged`
    as off the grid."""
    found: dict[str, list[bool]] = {}
    for k in range(RECORDS):
        y, now = record(law, truth, np.random.default_rng([seed, k]))
        bank = Bank(TABLES)
        bank.push(np.repeat(y, BLOCK)[:, None])
        report = bank.report(0)
        estimates = report.parameters[law]
        judged = judge_record(Blocks(y, np.ones(BLOCKS), math.nan, {}, np.empty((BLOCKS, 0))), TABLES, GROUP, report)
        one = {name: estimates[name].q05 <= value <= estimates[name].q95 for name, value in truth.items()}
        one["bias"] = abs(report.bias_mean - now) < 1.6449 * report.bias_sd
        one["adequate"] = all(check["passed"] for check in judged.checks.values())
        one["flagged"] = estimates["N"].off_grid
        for name, value in one.items():
            found.setdefault(name, []).append(value)
    return {name: float(np.mean(values)) for name, values in found.items()}


def test_intervals_hold_the_truth_of_averaged_drifts() -> None:
    """Each share within 3 sd of 0.9, 0.855 to 0.945 of 400 records; their mean within 0.015 there. Nearly all records
    are adequate, none beyond what 2 % would leave is flagged."""
    shares = [ensemble(law, truth, seed) for seed, (law, truth) in enumerate(COVERED)]
    covered = [value for one in shares for name, value in one.items() if name not in ("adequate", "flagged")]
    for (law, truth), one in zip(COVERED, shares, strict=True):
        print(law, truth, one)
    cell, whole = 3.0 * math.sqrt(0.09 / RECORDS), 0.015 * math.sqrt(400.0 / RECORDS)
    assert 0.9 - cell <= min(covered) and max(covered) <= 0.9 + cell, shares
    assert abs(float(np.mean(covered)) - 0.9) <= whole
    # 0.5 % fail by design, and 2 % are allowed: of 400 records as many as 2 % leave once in 1000
    most = int(binom.isf(1e-3, RECORDS, 0.02))
    for one in shares:
        assert (1.0 - one["adequate"]) * RECORDS <= most, one
        assert one["flagged"] * RECORDS <= most, one


@pytest.mark.parametrize("over", [3.0, 6.0])
def test_a_drift_beyond_the_grid_is_flagged(over: float) -> None:
    """K dt / N above sqrt(6): all nodes have more white noise at high frequency than such a record."""
    found = ensemble("random_walk", {"N": 0.003, "K": 0.003 * over}, 100)
    assert found["flagged"] >= 0.98, found


def test_a_drift_within_the_grid_is_covered_up_to_its_edge() -> None:
    """K dt / N of 1.5: the white noise is a third of N^2 / dt less than the samples' own, and still the grid has it."""
    found = ensemble("random_walk", {"N": 0.003, "K": 0.0045}, 200)
    limit = 0.9 - 3.0 * math.sqrt(0.09 / RECORDS)
    assert min(found[name] for name in ("N", "K", "bias")) >= limit, found
    assert found["flagged"] <= max(0.02, 1.0 / RECORDS), found


@pytest.mark.parametrize(
    ("kinds", "extra", "lost"),
    [
        pytest.param(FAST, 45, 0.0, id="end"),
        pytest.param(FAST, 0, 0.05, id="few"),
        pytest.param(FASTER, 0, 0.3, id="many"),
    ],
)
def test_intervals_hold_the_truth_of_partial_blocks(
    kinds: list[tuple[str, dict[str, float]]], extra: int, lost: float
) -> None:
    """A record that ends within a block: the bias is that at the end of the last whole one. And one that lost samples
    anywhere: its means are of those that are left."""
    for seed, (law, truth) in enumerate(kinds):
        held: dict[str, int] = dict.fromkeys([*truth, "bias"], 0)
        flagged = 0
        for k in range(TRUTHS):
            rng = np.random.default_rng([300 + seed, k])
            samples, level = readings(law, truth, rng, BLOCK * BLOCKS + extra)
            at = np.flatnonzero(rng.random(samples.size) >= lost)
            bank = Bank(TABLES)
            bank.push(samples[at, None], np.diff(at, prepend=at[0] - 1) - 1)
            report = bank.report(0)
            estimates = report.parameters[law]
            for name, value in truth.items():
                held[name] += estimates[name].q05 <= value <= estimates[name].q95
            end = at[0] + (at[-1] - at[0] + 1) // BLOCK * BLOCK - 1
            held["bias"] += abs(report.bias_mean - level[end]) < 1.6449 * report.bias_sd
            flagged += estimates["N"].off_grid
        shares = {name: count / TRUTHS for name, count in held.items()}
        print(law, truth, extra, lost, shares, flagged / TRUTHS)
        assert all(LEAST <= count <= MOST for count in held.values()), (law, truth, shares)
        assert flagged <= int(binom.isf(1e-3, TRUTHS, 0.02))


def test_intervals_hold_the_truth_of_a_drift_that_forgets_within_a_block() -> None:
    """alpha dt of 2 to 3. A record hardly shows such a drift, so the truths are drawn from the priors: then 0.9 of the
    intervals hold them whatever the record shows."""
    limits = {"N": (0.1, 0.2), "sigma_m": (0.02, 0.07), "alpha": (2.0, 3.0)}
    priors = {**GROUP.priors, **{name: Prior("log_uniform", low, high) for name, (low, high) in limits.items()}}
    model = replace(
        MODEL,
        groups=tuple(replace(one, priors=priors) if one is GROUP else one for one in MODEL.groups),
        hypotheses={"gauss_markov": 1.0},
    )
    tables = make_tables(model, float(BLOCK), ("gx",))
    held: dict[str, int] = dict.fromkeys([*limits, "bias"], 0)
    flagged = 0
    for k in range(TRUTHS):
        rng = np.random.default_rng([400, k])
        truth = {name: math.exp(rng.uniform(math.log(low), math.log(high))) for name, (low, high) in limits.items()}
        samples, level = readings("gauss_markov", truth, rng)
        bank = Bank(tables)
        bank.push(samples[:, None])
        report = bank.report(0)
        estimates = report.parameters["gauss_markov"]
        for name, value in truth.items():
            held[name] += estimates[name].q05 <= value <= estimates[name].q95
        held["bias"] += abs(report.bias_mean - level[-1]) < 1.6449 * report.bias_sd
        flagged += estimates["N"].off_grid
    shares = {name: count / TRUTHS for name, count in held.items()}
    print(shares, flagged / TRUTHS)
    assert all(LEAST <= count <= MOST for count in held.values()), shares
    assert flagged <= int(binom.isf(1e-3, TRUTHS, 0.02))


def test_a_drift_beyond_the_grid_is_inadequate_by_either_verb(tmp_path: Path) -> None:
    """A walk that moves 3 or 5 N in a bank interval: N is wrong by a tenth and more. Every sample shows a walk."""
    for k in range(case_records(1, 20)):
        over = (3.0, 5.0)[k % 2]
        samples, _ = readings("random_walk", {"N": 0.003, "K": 0.003 * over}, np.random.default_rng([900, k]))
        save(tmp_path / "walk.npz", {"gx": ("deg/s", samples)}, float(BLOCK))
        known = identify(tmp_path / "walk.npz", suspicion=False)["axes"]["gx"]
        assert [name for name, one in known["checks"].items() if not one["passed"]] == ["drift_in_average"]
        found = diagnose(tmp_path / "walk.npz")["axes"]["gx"]
        assert found["verdict"] == "inadequate", over
        assert [one["estimate"]["statistic"] for one in found["findings"]] == ["drift_in_average"]
        shorter = identify(tmp_path / "walk.npz", suspicion=False, decimate=BLOCK / 2.0)["axes"]["gx"]
        assert shorter["adequate"], shorter["checks"]


def test_a_drift_within_the_grid_passes_the_check_of_averages() -> None:
    """K dt of 1.5 N: none of 200 (the clean twin)."""
    for k in range(case_records(12, 200)):
        y, _ = record("random_walk", {"N": 0.003, "K": 0.0045}, np.random.default_rng([910, k]))
        bank = Bank(TABLES)
        bank.push(np.repeat(y, BLOCK)[:, None])
        assert drift_check(TABLES, GROUP, bank.report(0))["drift_in_average"]["passed"], k


def test_the_bias_is_that_of_the_last_sample_of_a_recording(tmp_path: Path) -> None:
    """45 samples after the last whole average, beside a walk that moves N in an average: by `identify`, of a file. The
    interval of the last average would hold 0.75."""
    held, count = 0, case_records(40, 400)
    for k in range(count):
        samples, level = readings("random_walk", COVERED[3][1], np.random.default_rng([920, k]), BLOCK * 300 + 45)
        save(tmp_path / "tail.npz", {"gx": ("deg/s", samples)}, float(BLOCK))
        now = identify(tmp_path / "tail.npz", suspicion=False)["axes"]["gx"]["bias_now"]
        held += abs(now["mean"] - level[-1]) < 1.6449 * now["sd"]
    assert int(binom.ppf(1.35e-3, count, 0.9)) <= held <= int(binom.ppf(1.0 - 1.35e-3, count, 0.9)), held / count


@pytest.mark.parametrize("drift", [COVERED[3], COVERED[5]], ids=["random_walk", "gauss_markov"])
def test_both_engines_have_the_bias_of_the_last_sample(drift: tuple[str, dict[str, float]]) -> None:
    """40 of 50 samples after the last average: the mean to 0.05 sd, the sd to 3 %, as of all reports. The drift moves
    within them: the sd is larger than at the last average."""
    samples, _ = readings(*drift, np.random.default_rng(930), BLOCK * 300)
    bank = Bank(TABLES)
    bank.push(samples[:, None])
    y = samples.reshape(-1, BLOCK).mean(axis=1)
    before, ours = (bank.report(0, 0, ahead_s) for ahead_s in (0.0, 0.8))
    theirs = reference_axis(y, TABLES.dt_s, GROUP, MODEL.hypotheses, block=BLOCK, ahead_s=0.8)
    assert ours.bias_mean == pytest.approx(theirs.bias_mean, abs=0.05 * theirs.bias_sd)
    assert ours.bias_sd == pytest.approx(theirs.bias_sd, rel=0.03)
    assert ours.bias_sd > 1.1 * before.bias_sd


@pytest.mark.parametrize("block", [2, 7, 60, 3600])
def test_lost_readings_of_a_drift_faster_than_the_readings(block: int) -> None:
    """Readings 10 days apart beside drifts of seconds: the number goes over into its limit, 1, and stays there. Where
    exp(-x / block) is 1e-6 to 1e-9 the exact form has digits left to show the same, to 2 block exp(-FORGOTTEN)."""
    near = [lost_of(block * x, block) for x in (14.0, 18.0, 19.99, 20.01, 23.0)]
    assert near == pytest.approx([1.0] * 5, abs=2e-6 + 2.0 * block * math.exp(-20.0))
    for x in (750.0, 1e5, 1e12):
        assert lost_of(block * x, block) == 1.0
