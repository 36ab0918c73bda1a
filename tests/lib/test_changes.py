"""What the module handles by itself: outliers (lib/intake.c), steps of the bias and changes of the noise
(lib/changes.c, lib/bank_reopen.c).

Truth: sums of the two parts of a record as the textbook filter has them, and records whose change is known. The rate of
false changes over 5000 h and the shares found are campaigns: tests/adequacy_rates.py, figures in tests/ACCURACY.md.
"""

from __future__ import annotations

import math
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from selfcal.adequacy.drawn import simulate_bank_samples
from selfcal.bank.library import Bank
from selfcal.base.errors import UserError
from selfcal.model.file import DEFAULT, Handling, Model
from selfcal.model.tables import Tables, make_tables
from selfcal.verbs.codegen import codegen
from selfcal.verbs.replay import replay
from selfcal.verbs.simulate import simulate
from selfcal.wire.frames import choices

from agreement import a_bank
from conftest import ROOT

Floats = NDArray[np.float64]
MODEL = replace(Model.load(None), handling=Handling(6.0, steps=True, variance_changes=True))
CAUSES = choices("GX_ADEQUACY", "change")
N = 0.04  # deg/s/sqrt(Hz)


def tables_of(*axes: str, model: Model = MODEL, rate_hz: float = 1.0) -> Tables:
    return make_tables(model, rate_hz, axes)


def record(law: str, n: int, seed: int) -> Floats:
    truth = {"N": N, "K": 2e-4, "sigma_m": 0.02, "alpha": 0.005, "bias": 0.1}
    return simulate_bank_samples(law, truth, 1.0, n, seed)[0]


def watch(y: Floats, tables: Tables) -> tuple[Bank, list[tuple[int, int, str, float, float]]]:
    """The bank at the end of y [n, axes], and axis, sample, cause, size and age in s of each change."""
    bank = Bank(tables)
    _, found = bank.raw.watch(np.ascontiguousarray(y, np.float32), np.zeros(len(y), np.uint64), None)
    return bank, [(axis, at, CAUSES[cause], size, ago_s) for axis, at, cause, size, ago_s in found]


def sums(y: Floats, hypothesis: int, ln_rho: float, ln_alpha: float, dt_s: float) -> tuple[float, float, float, float]:
    """A, B, C and D of bank.c at a node, relative to sigma_v."""
    variance = math.exp(2.0 * ln_rho) if hypothesis > 0 else 0.0
    phi = math.exp(-math.exp(ln_alpha) * dt_s) if hypothesis == 2 else 1.0
    q = variance * (1.0 - phi * phi) if hypothesis == 2 else variance
    a = b = c = d = x = one = 0.0
    p = variance
    for reading in y:
        s, nu, u = 1.0 + p, reading - x, 1.0 - one
        a, b, c, d = a + u * u / s, b + u * nu / s, c + nu * nu / s, d + math.log(s)
        x, one = phi * (x + p / s * nu), phi * (one + p / s * u)
        p = phi * phi * p / s + q
    return a, b, c, d


@pytest.mark.parametrize(("build", "tolerance"), [("double", 1e-5), ("float", 1e-3), ("fixed", 1e-3)])
def test_a_reopened_bank_has_the_likelihood_of_two_records(build: str, tolerance: float) -> None:
    """-2 ln p at each node is n ln C + D + ln A of the first part under a flat prior, with A and B of the second part
    alone. In double the drift's gain stops at 1e-6 of itself (CONVERGED in bank.c); float and integers add 1e-4 nats
    here. A bank that is saved after it and restored goes on alike."""
    y = record("random_walk", 1200, 3).astype(np.float32).astype(float)
    tables = tables_of("gx")
    bank = a_bank(tables, build)
    bank.push(y[:700, None])
    places = {j: bank.raw.node(0, j) for j in range(0, tables.nodes, 13)}
    bank.raw.reopen([(0, 0.0, 0.0, N, 0.0, 0.0)], 1.0)
    off = [y[i] - y[0] for i in range(y.size)]
    for j, node in places.items():
        place = (node["hypothesis"], node["ln_rho"], node["ln_alpha"], tables.dt_s)
        a, b, c, d = sums(np.array(off[:700]), *place)
        now = bank.raw.node(0, j)
        assert now["a"] == 0.0
        assert math.isclose(now["ln_s"], d, rel_tol=1e-6, abs_tol=tolerance)
        # the change of -2 ln p by the fold: n ln(1 + ln A / n), n ln(C - B^2/A) left as it is
        folded = 700 * math.log(now["c"] / (c - b * b / a))
        assert math.isclose(folded, 700 * math.log1p(math.log(a) / 700), abs_tol=tolerance)
    restored = a_bank(tables, build)
    restored.raw.restore(bank.raw.save())
    for one in (bank, restored):
        one.push(y[700:, None])
    assert restored.report(0) == bank.report(0)
    for j, node in places.items():
        place = (node["hypothesis"], node["ln_rho"], node["ln_alpha"], tables.dt_s)
        a, b, _, d = sums(np.array(off[700:]), *place)
        now = bank.raw.node(0, j)
        assert math.isclose(now["a"], a, rel_tol=1e-4) and math.isclose(now["b"], b, rel_tol=1e-3, abs_tol=1e-4)
        assert math.isclose(now["ln_s"] - places[j]["ln_s"], d, rel_tol=1e-4, abs_tol=1e-3)


@pytest.mark.parametrize("law", ["constant", "random_walk"])
def test_after_a_step_the_bias_is_as_if_it_were_a_new_part(law: str) -> None:
    """A step of 3 sigma_v in the middle of an hour. The bias after it rests on the second half alone. Its sd is that of
    the record without the step within 30 %, or within sqrt(2) for a constant bias, which half the samples tell. The
    axis beside keeps its own: the same sd as without a step, within 30 %."""
    n, size = 3600, 3.0 * N
    y = np.column_stack([record(law, n, 11), record(law, n, 12)])
    stepped = y.copy()
    stepped[n // 2 :, 0] += size
    tables = tables_of("gx", "gy")
    bank, found = watch(stepped, tables)
    assert [(axis, cause) for axis, _, cause, _, _ in found] == [(0, "step")]
    _, at, _, told, ago_s = found[0]
    assert at - n // 2 < 90, "24 s after the score is beyond its limit, which takes a few"
    # onsets are tried every 16 s: a step between two of them counts from the one before, and its size as less
    assert abs(ago_s - (at - n // 2)) <= 16 and 0.7 * size < told < 1.2 * size
    half = Bank(tables)
    half.push(stepped[n // 2 :])
    whole = Bank(tables)
    whole.push(y)
    after, alone, beside = bank.report(0), half.report(0), bank.report(1)
    assert after.bias_sd < (1.6 if law == "constant" else 1.3) * whole.report(0).bias_sd
    assert abs(after.bias_mean - alone.bias_mean) < 2.0 * after.bias_sd
    assert math.isclose(beside.bias_sd, whole.report(1).bias_sd, rel_tol=0.3)
    blind = Bank(make_tables(Model.load(None), 1.0, ("gx", "gy")))
    blind.push(stepped)
    assert blind.report(0).bias_sd > 3.0 * after.bias_sd, "without the detector the step is taken for drift"


def test_a_report_right_after_a_reopening_has_the_prior_s_bias() -> None:
    """No sample has come since: the bias is what the reopening was told, N what it was before."""
    bank = Bank(tables_of("gx"))
    bank.push(record("random_walk", 700, 3)[:, None])
    before = bank.report(0)
    bank.raw.reopen([(1, math.log(2e-4 / N), 0.0, N, 0.5, 0.02)], 1.0)
    after = bank.report(0)
    assert math.isclose(after.bias_mean, 0.5, rel_tol=1e-6)
    assert after.bias_sd >= 0.02
    noise = [one.parameters["random_walk"]["N"].median for one in (before, after)]
    assert math.isclose(noise[0], noise[1], rel_tol=0.01)


@pytest.mark.parametrize("size", [50.0, 400.0])
def test_a_large_step_is_learned_as_well(size: float) -> None:
    """In white-noise deviations: 2 and 16 deg/s. The bias afterwards is within 3 sd, and its sd is that of the record
    without the step, within 1.3: the step is not taken for drift."""
    y = record("random_walk", 3600, 41)
    clean = Bank(tables_of("gx"))
    clean.push(y[:, None])
    y[1800:] += size * N
    bank, found = watch(y[:, None], tables_of("gx"))
    assert [cause for _, _, cause, _, _ in found] == ["step"] and 0.7 < found[0][3] / (size * N) < 1.1
    now, usual = bank.report(0), clean.report(0)
    assert now.bias_sd < 1.3 * usual.bias_sd
    assert abs(now.bias_mean - size * N - usual.bias_mean) < 3.0 * now.bias_sd


def test_a_second_step_soon_after_is_found_too() -> None:
    """60 s apart. What was known of the noise before the first serves the second."""
    y = record("constant", 3600, 42)
    y[1800:] += 7.0 * N
    y[1860:] += 7.0 * N
    bank, found = watch(y[:, None], tables_of("gx"))
    assert [cause for _, _, cause, _, _ in found] == ["step", "step"]
    report = bank.report(0)
    assert report.bias_sd < 0.003, "some 1.5 times N over the root of 1740 samples, and a doubt about the drift"
    assert abs(report.bias_mean - 0.1 - 14.0 * N) < 3.0 * report.bias_sd


def test_an_outlier_and_a_burst_are_no_step() -> None:
    """One reading 20 sigma_v off, eight of 5; and what begins on two axes at once is motion."""
    n = 2400
    y = np.column_stack([record("constant", n, seed) for seed in (21, 22)])
    tables = tables_of("gx", "gy")
    for first, count, size in ((1200, 1, 20.0), (1200, 8, 5.0)):
        disturbed = y.copy()
        disturbed[first : first + count, 0] += size * N
        assert "step" not in [cause for _, _, cause, _, _ in watch(disturbed, tables)[1]]
    moved = y.copy()
    moved[1200:] += 5.0 * N
    assert [(axis, cause) for axis, _, cause, _, _ in watch(moved, tables)[1]] == [(0, "motion"), (1, "motion")]


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_changed_noise_is_learned_anew(ratio: float) -> None:
    """N changes in the middle. Half an hour later N is the new one within 6 %: three times the sqrt(1/(2 n)) of 1800
    samples, and 16 that still count from before. The bank without it is off: sqrt((1 + 4) / 2) is 21 % less than 2."""
    n = 3600
    y = record("constant", n, 31)
    y[n // 2 :] = 0.1 + ratio * (y[n // 2 :] - 0.1)
    bank, found = watch(y[:, None], tables_of("gx"))
    assert [cause for _, _, cause, _, _ in found] == ["variance_change"]
    assert found[0][1] - n // 2 <= 3 * 64, "two windows of 64 s, and a part of one before them"
    assert math.isclose(found[0][3], ratio, rel_tol=0.25)  # two windows: sqrt(1/256), and a part of one before
    assert math.isclose(bank.report(0).parameters["constant"]["N"].median, ratio * N, rel_tol=0.06)
    blind = Bank(make_tables(Model.load(None), 1.0, ("gx",)))
    blind.push(y[:, None])
    assert abs(blind.report(0).parameters["constant"]["N"].median / (ratio * N) - 1.0) > 0.15


def test_outliers_are_kept_out_and_counted() -> None:
    """100 Hz, one sample in 200 is 12 standard deviations off: the count is theirs, and N is that of the rest. 4 % are
    three sd of N from 600 bank samples, and 0.5 % of the samples are gone."""
    rate, n = 100, 60_000
    rng = np.random.default_rng(5)
    clean = 0.1 + N * math.sqrt(rate) * rng.standard_normal(n)
    where = np.arange(1000, n, 200)
    y = clean.copy()
    y[where] += 12.0 * N * math.sqrt(rate) * rng.choice([-1.0, 1.0], where.size)
    bank, blind = Bank(tables_of("gx", rate_hz=rate)), Bank(make_tables(Model.load(None), rate, ("gx",)))
    bank.push(y[:, None])
    blind.push(y[:, None])
    assert bank.raw.counters()["outliers"][0] == where.size
    assert math.isclose(bank.report(0).parameters["constant"]["N"].median, N, rel_tol=0.1)
    assert blind.report(0).parameters["constant"]["N"].median > 1.2 * N
    healthy = Bank(tables_of("gx", rate_hz=rate))
    healthy.push(clean[:, None])
    assert healthy.raw.counters()["outliers"][0] == 0, "2e-9 of normal samples"


def test_a_step_is_not_kept_out_for_ever() -> None:
    """Readings that stay 12 standard deviations off: four are kept out, the others count."""
    rate, n = 100, 20_000
    y = 0.1 + N * math.sqrt(rate) * np.random.default_rng(6).standard_normal(n)
    y[n // 2 :] += 12.0 * N * math.sqrt(rate)
    bank = Bank(tables_of("gx", rate_hz=rate))
    bank.push(y[:, None])
    counters = bank.raw.counters()
    assert counters["outliers"][0] <= 8 and counters["samples"] >= n - 8


@pytest.mark.parametrize("target", ["host", "cortex-m4f"])
def test_the_module_handles_a_step_and_tells_it(tmp_path: Path, target: str) -> None:
    """Through codegen, image, wire and replay: the step is told, and the bias is known three times better than by the
    module that does not look."""
    tree = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["simulate"] = {"rate_hz": 10.0, "duration_s": 2400.0}
    tree["simulate"]["axes"] = {"gx": {"hypothesis": "random_walk", "N": N, "K": 2e-4, "bias": 0.3}}
    told = {}
    for name, handle in (("plain", {}), ("handles", {"outlier_sd": 6.0, "steps": True, "variance_changes": True})):
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump({**tree, "handle": handle}, sort_keys=False), encoding="utf-8")
        log = tmp_path / "log.npz"
        if not log.exists():
            simulate(path, log, seed=1, effects=["step:axis=gx:time_s=1200:amplitude=0.2"])
        told[name] = replay(log, model=path, target=target, axes=["gx"])["axes"]["gx"]
    change = told["handles"]["module_says"]["change"]
    assert change["cause"] == "step" and change["count"] == 1 and 1150 < change["ago_s"] <= 1216
    assert 0.7 * 0.2 < change["size"] < 1.2 * 0.2
    assert told["plain"]["module_says"]["change"] is None
    assert told["plain"]["bias_now"]["sd"] > 3.0 * told["handles"]["bias_now"]["sd"]


def test_an_image_that_handles_changes_may_send_corrected_samples(tmp_path: Path) -> None:
    """It compiles without a warning and keeps within the part: the setting meets code that no other image has."""
    model = tmp_path / "model.yaml"
    model.write_text(DEFAULT.read_text(encoding="utf-8") + "\nhandle: {outlier_sd: 6, steps: true}\n", encoding="utf-8")
    codegen(model, tmp_path / "tables", target="cortex-m4f")
    command = ["make", "-s", "-f", "port/stm32f405/stm32f405.mk", "stm32f405", f"MODEL_DIR={tmp_path / 'tables'}"]
    subprocess.run([*command, f"OUT={tmp_path / 'image'}", "CFLAGS=-DAPP_CORRECTED_MS=100"], cwd=ROOT, check=True)
    assert (tmp_path / "image" / "selfcal.elf").exists()


@pytest.mark.parametrize(
    ("handle", "said"),
    [
        ("{outlier_sd: 1}", "handle.outlier_sd: must be 0 or at least 4, not 1"),
        ("{steps: 1}", "handle.steps: must be true or false, not 1"),
        ("{jumps: true}", "handle"),
    ],
)
def test_a_bad_handle_gets_one_line(tmp_path: Path, handle: str, said: str) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(DEFAULT.read_text(encoding="utf-8") + f"\nhandle: {handle}\n", encoding="utf-8")
    with pytest.raises(UserError, match=said):
        Model.load(path)
