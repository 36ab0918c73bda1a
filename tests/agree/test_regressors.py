"""Regressors: the library's sums against the textbook bank, where the coefficients are filter states with a row of H
each (agreement.py, as are the tolerances); reports, `identify` and the model file.
"""

from __future__ import annotations

import json
import math
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from selfcal.adequacy.drawn import draw_parameters, simulate_bank_samples
from selfcal.bank import reference
from selfcal.bank.library import Bank
from selfcal.base.errors import UserError
from selfcal.logs.recording import save
from selfcal.model.file import Model
from selfcal.model.laws import PLAIN
from selfcal.model.tables import make_tables
from selfcal.verbs.codegen import codegen
from selfcal.verbs.identify import identify

from agreement import (
    MODEL as PLAIN_MODEL,
)
from agreement import (
    REGRESSORS,
    a_record,
    columns_of,
    compare,
    hold,
    push,
    tables_of,
)

MODEL = replace(PLAIN_MODEL, regressors=REGRESSORS)
GROUP = MODEL.group_of("gx")


@pytest.mark.parametrize("gaps", [False, True], ids=["whole", "gaps"])
@pytest.mark.parametrize("n", [10, 100, 1500])
@pytest.mark.parametrize("count", [1, 3, 6])
def test_parity_with_the_textbook_bank(count: int, n: int, gaps: bool) -> None:
    """Every law; all regressors in use, none, and one subset, each with flat weights over the nodes and sigma_v."""
    tables = tables_of(PLAIN_MODEL, "cortex-m0", count)
    masks = {2**count - 1, 0, 0b101101 & (2**count - 1)}
    records = [a_record(law, n, 0, gaps=gaps, columns=count) for law in PLAIN]
    builds = ("double", "float", "fixed")
    hold(f"p={count} n={n} gaps={gaps}", [compare(y, tables, z, builds=builds, masks=masks) for y, z in records])


# ----------------------------------------------------------------------------------------------------------- reports


@pytest.mark.parametrize("law", PLAIN)
def test_report_of_a_subset_against_the_continuous_reference(law: str) -> None:
    """The float library's interpolated report with three columns in use, against the textbook bank refined until it
    settles. Tolerances as for a report without: 0.05 in ln evidence, 0.05 sd in means; sd to 5 %."""
    n, count = 300, 3
    tables = tables_of(PLAIN_MODEL, columns=count)
    y, z = a_record(law, n, 0, gaps=True, columns=count)
    assert z is not None
    present = np.isfinite(y)
    bank = Bank(tables)
    push(bank, y, z)
    last = int(np.flatnonzero(present)[-1]) + 1
    sd = [column.coefficient_sd[0] for column in tables.regressors]
    centred = z - np.array([column.reference for column in tables.regressors])
    dense = reference.reference_axis(y[:last], 1.0, GROUP, MODEL.hypotheses, None, centred[:last], sd)
    report = bank.report(0, 0b111)
    assert report.bias_mean == pytest.approx(dense.bias_mean, abs=0.05 * dense.bias_sd)
    assert report.bias_sd == pytest.approx(dense.bias_sd, rel=0.05)
    for hypothesis in PLAIN:
        if dense.probability[hypothesis] < 0.01:
            continue
        assert report.log_evidence[hypothesis] == pytest.approx(dense.log_evidence[hypothesis], abs=0.05)
        pairs = zip(report.coefficients[hypothesis], dense.coefficients[hypothesis], strict=True)
        for (mean, spread), (exact_mean, exact_sd) in pairs:
            assert mean == pytest.approx(exact_mean, abs=0.05 * exact_sd)
            assert spread == pytest.approx(exact_sd, rel=0.05)


def test_intervals_of_a_coefficient_hold_the_truth_as_often_as_they_say() -> None:
    """Random walk with a temperature, parameters and coefficient drawn from their priors: 200 records of 200 samples,
    one set of seeds; the bounds are the central 99.8 % of the binomial law of 200 and 0.9."""
    tables = tables_of(PLAIN_MODEL, columns=1)
    held = 0
    for seed in range(200):
        rng = np.random.default_rng([seed, 5])
        truth = draw_parameters(GROUP, "random_walk", rng)
        coefficient = tables.regressors[0].coefficient_sd[0] * rng.normal()
        z = columns_of(200, seed)[:, :1]
        y = simulate_bank_samples("random_walk", truth, 1.0, 200, seed=seed)[0] + coefficient * z[:, 0]
        bank = Bank(replace(tables, hypotheses=tables.hypotheses[1:2]))
        bank.push(y[:, None], None, z)
        mean, sd = bank.report(0, 1).coefficients["random_walk"][0]
        held += abs(coefficient - mean) <= 1.6449 * sd
    low, high = stats.binom(200, 0.9).ppf([0.001, 0.999])
    print(f"\n90 % intervals of a coefficient: {held} of 200 hold the truth ({low:g} to {high:g})")
    assert low <= held <= high


def test_a_model_without_regressors_pays_nothing() -> None:
    """The bytes of selfcal.h's formulas, without and with; and the empty subset gives the report of a bank without."""
    plain = make_tables(PLAIN_MODEL, 1.0, ("gx",))
    offered = make_tables(MODEL, 1.0, ("gx",))
    y, z = a_record("random_walk", 300, 0, columns=6)
    bank, beside = Bank(plain), Bank(offered)
    bank.push(y[:, None])
    beside.push(y[:, None], None, z)
    assert bank.raw.size == plain.nodes * (56 + 20)
    node, fixed = 4 * 7 * 10 + 8 * 6 + 4, 6 * 4 * (2 * 16 + 5) + 5 * 8 + 7  # of p = 6 and one axis; batch of 16
    assert beside.raw.size == bank.raw.size + plain.nodes * node + fixed
    one, other = bank.report(0), beside.report(0, 0)
    for law in PLAIN:
        # With regressors the sums carry more digits: equal to float's, not to the last bit.
        assert one.probability[law] == pytest.approx(other.probability[law], abs=1e-3)


def test_what_does_not_fit_is_refused() -> None:
    tables = make_tables(MODEL, 1.0, ("gx",))
    bank = Bank(tables)
    samples = np.zeros((20, 1), np.float32)
    with pytest.raises(ValueError, match="argument out of range"):
        bank.push(samples)  # no values
    with pytest.raises(ValueError, match=r"regressors must be \[n, regressors\]"):
        bank.push(samples, None, np.zeros((20, 5)))
    z = np.zeros((20, 6))
    z[3, 2] = np.nan
    z[7, 0] = 2.0**40  # SELFCAL_SAMPLE_MAX
    bank.push(np.random.default_rng(1).normal(size=(20, 1)), None, z)
    counters = bank.raw.counters()
    assert counters["regressor_not_finite"] == 2
    assert counters["samples"] == 18
    assert bank.raw.count == 18
    with pytest.raises(ValueError, match="argument out of range"):
        bank.raw.report(0, 0b1000000)
    none = replace(tables, regressors=tuple(replace(one, coefficient_sd=(0.0,)) for one in tables.regressors))
    without = Bank(none)
    without.push(np.random.default_rng(1).normal(size=(20, 1)), None, np.zeros((20, 6)))
    with pytest.raises(ValueError, match="argument out of range"):
        without.raw.report(0, 1)  # the axis does not have it
    bad = replace(tables, regressors=(replace(tables.regressors[0], coefficient_sd=(math.inf,)),))
    with pytest.raises(ValueError, match="contradict"):
        Bank(bad)


def test_columns_that_say_nothing_change_nothing() -> None:
    """A step after the record's end, and a column that repeats another: coefficients keep their prior or share what the
    two can tell; the evidence of the copy is that of one column with both priors in it (sqrt(2) of the sd)."""
    rng = np.random.default_rng(3)
    tables = make_tables(MODEL, 1.0, ("gx",))
    one = replace(tables.regressors[0], coefficient_sd=(0.05,), reference=0.0)
    y = 0.02 * rng.normal(size=400)
    ramp = np.linspace(0.0, 5.0, 400)
    y += 0.03 * ramp
    twice = Bank(replace(tables, regressors=(one, one, one)))
    twice.push(y[:, None], None, np.column_stack([ramp, ramp, np.zeros(400)]))
    wide = Bank(replace(tables, regressors=(replace(one, coefficient_sd=(0.05 * math.sqrt(2.0),)),)))
    wide.push(y[:, None], None, ramp[:, None])
    both, single, silent = twice.report(0, 0b011), wide.report(0, 1), twice.report(0, 0b101)
    plain = twice.report(0, 0b001)
    for law in PLAIN:
        assert both.log_evidence[law] == pytest.approx(single.log_evidence[law], abs=1e-3)
        (a, _), (b, _) = both.coefficients[law]
        assert a == pytest.approx(b, rel=1e-3)
        assert a + b == pytest.approx(single.coefficients[law][0][0], rel=1e-3)
        assert silent.log_evidence[law] == pytest.approx(plain.log_evidence[law], abs=1e-3)
        assert silent.coefficients[law][1] == pytest.approx((0.0, 0.05), abs=1e-6)


# ---------------------------------------------------------------------------------------- model file, identify, codegen

ENTRIES = """
regressors:
  - {name: temperature, kind: column, column: temp, unit: degC, reference: 25.0, sd: {gyro: 0.02, accel: 0.05}}
  - {name: warming, kind: rate, column: temp, unit: degC, window_s: 60.0, sd: {gyro: 1.0}}
  - {name: leak, kind: column, column: gy, unit: deg/s, sd: {gyro: 0.1}}
"""


def model_file(tmp_path: Path, entries: str) -> Path:
    path = tmp_path / "model.yaml"
    path.write_text(MODEL.path.read_text() + entries)
    return path


def test_identify_finds_what_is_in_the_record(tmp_path: Path) -> None:
    """White noise and a temperature coefficient of 0.01 deg/s/degC, in a recording in rad/s and K at 4 Hz: the
    temperature is in use, its rate and the other axis are not; the interval holds the truth; both engines agree."""
    rng = np.random.default_rng(8)
    n = 4 * 900
    t = np.arange(n) / 4.0
    temp = 40.0 - 8.0 * np.exp(-t / 300.0) + 0.02 * rng.normal(size=n)
    gx = 0.3 + 0.01 * (temp - 25.0) + 0.08 * rng.normal(size=n)
    gy = 0.1 + 0.08 * rng.normal(size=n)
    log, out = tmp_path / "log.csv", tmp_path / "out.json"
    rad = math.pi / 180.0
    save(log, {"gx": ("rad/s", gx * rad), "gy": ("rad/s", gy * rad), "temp": ("K", temp + 273.15)}, 4.0, {})
    path = model_file(tmp_path, ENTRIES)
    identify(log, axes=["gx"], model=path, json=out)
    axis = json.loads(out.read_text())["axes"]["gx"]
    assert axis["regressors_in_use"] == ["temperature"]
    assert axis["adequate"]
    assert set(axis["regressors"]) == {"temperature", "warming", "leak"}
    assert len(axis["subsets"]) == 8
    assert sum(entry["probability"] for entry in axis["subsets"]) == pytest.approx(1.0, abs=1e-9)
    found = axis["regressors"]["temperature"]
    assert found["probability"] > 0.99
    coefficient = found["coefficients"]["temperature"]
    assert coefficient["unit"] == "rad/s/degC"
    assert coefficient["q05"] < 0.01 * rad < coefficient["q95"]
    assert abs(coefficient["mean"] - 0.01 * rad) < 4.0 * coefficient["sd"]
    assert axis["regressors"]["warming"]["coefficients"]["warming"]["unit"] == "rad/s/degC*s"
    bias = axis["bias_now"]
    assert abs(bias["mean"] - (0.3 + 0.01 * (temp[-1] - 25.0)) * rad) < 4.0 * bias["sd"]
    assert identify(log, axes=["gy"], model=path)["axes"]["gy"]["regressors"].keys() == {"temperature", "warming"}

    only_constant = path.read_text().replace("random_walk: 1\n", "").replace("gauss_markov: 1\n", "")
    path.write_text(only_constant)
    library, dense = (
        identify(log, axes=["gx"], model=path, engine=engine)["axes"]["gx"] for engine in ("library", "reference")
    )
    for name, entry in dense["regressors"].items():
        assert library["regressors"][name]["probability"] == pytest.approx(entry["probability"], abs=2e-3)
        for column, exact in entry["coefficients"].items():
            ours = library["regressors"][name]["coefficients"][column]
            assert ours["mean"] == pytest.approx(exact["mean"], abs=0.05 * exact["sd"])
            assert ours["sd"] == pytest.approx(exact["sd"], rel=0.03)


def test_a_temperature_that_is_not_there_is_said(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    save(log, {"gx": ("deg/s", np.random.default_rng(1).normal(size=100))}, 1.0, {})
    with pytest.raises(UserError, match="no column 'temp', which the model's regressor 'temperature' needs"):
        identify(log, model=model_file(tmp_path, ENTRIES))


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("{name: a, kind: magic, sd: {gyro: 1}}", "unknown kind 'magic'"),
        ("{name: a, kind: step, sd: {gyro: 1}}", "'time_s' is missing"),
        ("{name: a, kind: time, unit: s, sd: {gyro: 1}}", "unknown entry 'unit'"),
        ("{name: a, kind: time, sd: {}}", "at least one group"),
        ("{name: a, kind: time, sd: {compass: 1}}", "unknown entry 'compass'"),
        ("{name: a, kind: time, sd: {gyro: 0}}", "must be a finite number above 0"),
        ("{name: a */ b, kind: time, sd: {gyro: 1}}", "without '*/'"),
        ("{name: a, kind: time, sd: {gyro: 1e300}}", "must be within +-1e+18"),
        ("{name: a, kind: time, sd: {gyro: 1e-300}}", "must be 0, or 1e-20 and more"),
        ("{name: a, kind: time, reference: .inf, sd: {gyro: 1}}", "must be a finite number, not inf"),
        ("{name: a, kind: time, reference: 1e300, sd: {gyro: 1}}", "must be within +-1e+18"),
        (f"{{name: a, kind: time, sd: {{gyro: 1{400 * '0'}}}}}", "must be a number, not 1000000"),
        ("{name: a, kind: time, sd: {gyro: 1}, probability: 1}", "must be below 1"),
        ("{name: a, kind: column, column: temp, unit: furlong, sd: {gyro: 1}}", "unknown unit 'furlong'"),
        ("{name: a, kind: time, sd: {gyro: 1}}\n  - {name: a, kind: time, sd: {gyro: 1}}", "'a' appears twice"),
        (
            "\n  - ".join(f"{{name: p{i}, kind: periodic, frequency_hz: 0.1, sd: {{gyro: 1}}}}" for i in range(19)),
            "38 columns are more than 36",
        ),
        ("3", "must be a mapping"),
    ],
)
def test_a_bad_entry_is_one_clear_line(entry: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        Model.load(model_file(tmp_path, f"regressors:\n  - {entry}\n"))
    assert said in str(caught.value)
    assert "regressors" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_codegen_writes_tables_that_compile(tmp_path: Path) -> None:
    """gcc with the library's warnings; the sizes in the header make the memory that selfcal_init() asks for."""
    folder = tmp_path / "model"
    codegen(model_file(tmp_path, ENTRIES), folder, target="cortex-m4f")
    (tmp_path / "main.c").write_text(
        "#include <stdlib.h>\n"
        '#include "selfcal_model.h"\n'
        "static selfcal_wide_t memory[(SELFCAL_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_AXES) +\n"
        "    SELFCAL_REGRESSORS_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_AXES, SELFCAL_MODEL_REGRESSORS)) / 8U + 1U];\n"
        "int main(void) {\n"
        "    selfcal_t bank;\n"
        "    const size_t plain = SELFCAL_SIZE(SELFCAL_MODEL_NODES, SELFCAL_MODEL_AXES);\n"
        "    if (selfcal_init(&bank, &selfcal_model, memory, plain) != SELFCAL_BAD_MEMORY) return 1;\n"
        "    if (selfcal_init(&bank, &selfcal_model, memory, sizeof memory) != SELFCAL_OK) return 2;\n"
        "    const float sample[SELFCAL_MODEL_AXES] = {0}, values[SELFCAL_MODEL_REGRESSORS] = {25.0F};\n"
        "    if (selfcal_push(&bank, sample) != SELFCAL_BAD_ARGUMENT) return 3;\n"
        "    return selfcal_push_with(&bank, sample, values) == SELFCAL_OK ? 0 : 4;\n"
        "}\n"
    )
    lib = Path(__file__).parents[2] / "lib"
    flags = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror"]
    flags += ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    sources = [tmp_path / "main.c", folder / "selfcal_model.c", *lib.glob("*.c")]
    subprocess.run(["gcc", *flags, f"-I{lib}", f"-I{folder}", *sources, "-lm", "-o", tmp_path / "main"], check=True)
    assert subprocess.run([tmp_path / "main"], check=False).returncode == 0


def test_a_value_that_no_sum_holds_is_named(tmp_path: Path) -> None:
    """The library would keep those samples out."""
    log = tmp_path / "log.csv"
    rng = np.random.default_rng(8)
    temp = np.where(np.arange(600) < 300, 1e30, 20.0)
    save(log, {name: ("deg/s", rng.normal(size=600)) for name in ("gx", "gy")} | {"temp": ("K", temp)}, 1.0, {})
    with pytest.raises(UserError, match=r"the regressor temperature is 1e\+30 at 300 samples"):
        identify(log, axes=["gx"], model=model_file(tmp_path, ENTRIES))
