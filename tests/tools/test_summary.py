"""The numbers of a data sheet, against closed forms and records of known truth.

Truths: N and K as put in; the Allan deviation's first minimum from the closed forms of the literature (IEEE Std 952,
annex C): sqrt(2 N K / sqrt(3)) at sqrt(3) N / K of a walk, and a fine search of the Gauss-Markov form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from selfcal.adequacy.drawn import simulate_bank_samples
from selfcal.adequacy.summary import SheetNumber, halved_after, summarize
from selfcal.bank.axis_result import AxisResult, Estimate
from selfcal.bank.library import Bank
from selfcal.logs.recording import save
from selfcal.model.file import Model
from selfcal.model.laws import PLAIN
from selfcal.model.tables import make_tables
from selfcal.show import identification
from selfcal.verbs.identify import identify

from conftest import case_records

MODEL = Model.load()
GROUP = MODEL.group_of("gx")
FLOOR = math.sqrt(2.0 * math.log(2.0) / math.pi)


def sharp(value: float) -> Estimate:
    return Estimate(value, value, 1e-6 * value, value * (1.0 - 1e-6), value * (1.0 + 1e-6), identified=True)


def known(law: str, truth: Mapping[str, float], n: int = 20_000) -> dict[str, SheetNumber]:
    """The numbers of a posterior that knows its law and parameters."""
    parameters = {name: {key: sharp(value) for key, value in truth.items()} if name == law else {} for name in PLAIN}
    probability = {name: float(name == law) for name in PLAIN}
    return summarize(AxisResult(n, probability, probability, parameters, 0.0, 1.0), GROUP, 1.0, n, 100)


def markov_floor(truth: Mapping[str, float], longest_s: float) -> float | None:
    """First minimum of white noise and a Gauss-Markov drift, over 0.664; None where there is none."""
    tau = np.geomspace(1.0, longest_s, 20_000)
    q = truth["alpha"] * tau
    drift = 4.0 * truth["sigma_m"] ** 2 / q * (1.0 - (3.0 - 4.0 * np.exp(-q) + np.exp(-2.0 * q)) / (2.0 * q)) / 2.0
    variance = truth["N"] ** 2 / tau + drift
    inside = np.flatnonzero((variance[1:-1] < variance[:-2]) & (variance[1:-1] <= variance[2:]))
    return math.sqrt(variance[inside[0] + 1]) / FLOOR if inside.size else None


@pytest.mark.parametrize(("n", "k"), [(0.04, 1e-3), (0.3, 2e-2), (0.007, 5e-5)])
def test_a_walk_has_the_closed_form(n: float, k: float) -> None:
    """The search meets the minimum to 1e-4; averages of 100 samples are the continuous form to 1e-4 (allan.py)."""
    found = known("random_walk", {"N": n, "K": k})
    assert found["arw"].estimate.median == pytest.approx(n, rel=1e-5)
    assert found["rrw"].estimate.median == pytest.approx(k, rel=1e-5)
    assert found["bias_instability"].estimate.median == pytest.approx(
        math.sqrt(2.0 * n * k / math.sqrt(3.0)) / FLOOR, rel=1e-3
    )
    assert all(number.estimate.identified and not number.reason for number in found.values())


def test_a_gauss_markov_drift_is_a_walk_over_short_times() -> None:
    truth = {"N": 0.01, "sigma_m": 0.03, "alpha": 0.004}
    found = known("gauss_markov", truth)
    assert found["rrw"].estimate.median == pytest.approx(0.03 * math.sqrt(0.008), rel=1e-5)
    floor = markov_floor(truth, 10_000.0)
    assert floor is not None
    assert found["bias_instability"].estimate.median == pytest.approx(floor, rel=1e-3)


@pytest.mark.parametrize(
    ("law", "truth", "n", "reason"),
    [
        ("constant", {"N": 0.04}, 20_000, "no minimum"),
        ("random_walk", {"N": 0.04, "K": 1e-5}, 5000, "no minimum"),  # it is at 6900 s
        ("gauss_markov", {"N": 0.04, "sigma_m": 1e-4, "alpha": 0.01}, 20_000, "no minimum"),  # white noise is above
        ("random_walk", {"N": 0.01, "K": 1.0}, 5000, "rises from the shortest"),
    ],
)
def test_a_minimum_outside_the_record_is_stated(law: str, truth: dict[str, float], n: int, reason: str) -> None:
    number = known(law, truth, n)["bias_instability"]
    assert not number.estimate.identified
    assert reason in number.reason


def test_a_law_counts_by_its_probability() -> None:
    """Two walks of one N: a tenth of the posterior has none, so no walk is sure, and its limit is the walk's K."""
    parameters = {"constant": {"N": sharp(0.04)}, "random_walk": {"N": sharp(0.04), "K": sharp(1e-3)}}
    for share, sure in ((0.1, False), (0.04, True)):
        probability = {"constant": share, "random_walk": 1.0 - share}
        found = summarize(AxisResult(9000, probability, probability, parameters, 0.0, 1.0), GROUP, 1.0, 9000, 10)
        assert found["rrw"].estimate.identified is sure
        assert found["bias_instability"].estimate.identified is sure
        assert found["rrw"].estimate.q95 == pytest.approx(1e-3, rel=1e-4)
        assert found["rrw"].estimate.mean == pytest.approx((1.0 - share) * 1e-3, rel=1e-4)


@pytest.mark.parametrize(("n", "k"), [(0.04, 1e-4), (0.2, 3e-4)])
def test_a_drift_of_unknown_size_makes_no_minimum(n: float, k: float) -> None:
    """A law that always has a walk has a minimum too: that of the prior's least K, where the record leaves K open."""
    for open_ in (False, True):
        parameters = {"random_walk": {"N": sharp(n), "K": replace(sharp(k), identified=not open_)}}
        found = summarize(AxisResult(20_000, {}, {"random_walk": 1.0}, parameters, 0.0, 1.0), GROUP, 1.0, 20_000, 10)
        assert [found[name].estimate.identified for name in ("rrw", "bias_instability")] == [not open_] * 2
        assert found["bias_instability"].estimate.q95 == pytest.approx(
            math.sqrt(2.0 * n * k / math.sqrt(3.0)) / FLOOR, rel=1e-3
        )


def test_the_limit_of_no_walk_is_above_zero() -> None:
    """Without a walk in any likely law: less than the least K of the prior."""
    found = known("constant", {"N": 0.03})["rrw"]
    assert not found.estimate.identified and found.estimate.q95 == GROUP.priors["K"].min


def test_the_limit_is_that_of_a_walk_which_counts_for_nothing() -> None:
    parameters = {"constant": {"N": sharp(0.03)}, "random_walk": {"N": sharp(0.03), "K": sharp(7e-5)}}
    probability = {"constant": 1.0, "random_walk": 0.0}
    found = summarize(AxisResult(9000, probability, probability, parameters, 0.0, 1.0), GROUP, 1.0, 9000, 10)["rrw"]
    assert not found.estimate.identified and found.estimate.q95 == pytest.approx(7e-5)


TRUTHS = {
    "random_walk": {"N": 0.04, "K": 2e-3},
    "gauss_markov": {"N": 0.02, "sigma_m": 0.03, "alpha": 0.005},
}


@pytest.mark.parametrize("law", TRUTHS)
def test_intervals_hold_as_often_as_stated(law: str) -> None:
    """Records of an hour at 1 Hz: the truth lies within 90 %, to 4 sd of so many records, and a limit above it."""
    records = case_records(30, 300)
    tables = make_tables(MODEL, 1.0, ("gx",))
    truth = TRUTHS[law]
    floor = (
        math.sqrt(2.0 * truth["N"] * truth["K"] / math.sqrt(3.0)) / FLOOR
        if law == "random_walk"
        else markov_floor(truth, 1800.0)
    )
    walk = truth.get("K") or truth["sigma_m"] * math.sqrt(2.0 * truth["alpha"])
    held = {"arw": 0, "rrw": 0, "bias_instability": 0}
    for seed in range(records):
        y, _ = simulate_bank_samples(law, {**truth, "bias": 0.1}, 1.0, 3600, 40_000 + seed)
        bank = Bank(tables)
        bank.push(y[:, None])
        for key, number in summarize(bank.report(0), GROUP, 1.0, y.size, 1).items():
            value = {"arw": truth["N"], "rrw": walk, "bias_instability": floor}[key]
            assert value is not None
            low = number.estimate.q05 if number.estimate.identified else 0.0
            held[key] += low <= value <= number.estimate.q95
    print(f"\n{law}: of {records} hold {held}")
    for key, count in held.items():
        assert count >= 0.9 * records - 4.0 * math.sqrt(0.09 * records), key


def test_both_systems_of_units(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """1 deg/s/sqrt(Hz) is 60 deg/sqrt(h); 1 g/sqrt(Hz) is 9.80665 * 60 m/s/sqrt(h); 1 deg/s is 3600 deg/h; 1 g 1000 mg;
    K is per second, and its root of Hz is 60 roots of h: 3600 * 60 of 1 deg/s^2/sqrt(Hz), 1000 * 60 of 1 g/s/sqrt(Hz).
    The numbers stand before the laws."""
    rng = np.random.default_rng(6)
    drift = 0.002 * np.cumsum(rng.standard_normal((2, 4000)), axis=1)
    noise = 0.04 * rng.standard_normal((2, 4000))
    log = tmp_path / "log.csv"
    save(log, {"gx": ("deg/s", drift[0] + noise[0]), "ax": ("g", 0.02 * (drift[1] + noise[1]))}, 1.0, {})
    document = identify(log)
    for axis, factors in (("gx", (60.0, 216_000.0, 3600.0)), ("ax", (588.399, 60_000.0, 1000.0))):
        for number, factor in zip(document["axes"][axis]["summary"].values(), factors, strict=True):
            assert number["identified"]
            assert number["datasheet"]["median"] == pytest.approx(factor * number["median"], rel=1e-9)
    identification.show(document)
    said = capsys.readouterr().out
    assert said.index("bias instability") < said.index("random_walk")
    for words in ("ARW", "VRW", "RRW", "°/√h", "m/s/√h", "°/h", "mg"):
        assert words in said
    arw = document["axes"]["gx"]["summary"]["arw"]["datasheet"]
    assert f"{arw['median']:.3g} [{arw['q05']:.3g}, {arw['q95']:.3g}] °/√h" in said


def test_a_table_that_lacks_a_number_states_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "log.csv"
    save(log, {"gx": ("deg/s", 0.04 * np.random.default_rng(8).standard_normal(3000))}, 1.0, {})
    numbers = identify(log)["axes"]["gx"]["summary"]
    assert numbers["arw"]["identified"] and not numbers["rrw"]["identified"]
    identification.show(identify(log))
    said = capsys.readouterr().out
    assert f"< {numbers['rrw']['q95']:.3g} °/s²/√Hz, not identified" in said
    assert "bias instability not identified: gx: the Allan deviation has no minimum up to half the record" in said


def test_a_narrow_terminal_loses_intervals_and_no_number(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    y = 0.002 * np.cumsum(np.random.default_rng(1).standard_normal(3000))
    save(log, {"gx": ("deg/s", y + 0.04 * np.random.default_rng(2).standard_normal(3000))}, 1.0, {})
    document = identify(log)
    for width, intervals in ((160, 2), (80, 1), (60, 0)):
        console = Console(width=width, force_terminal=True, record=True, color_system=None)
        identification.show(document, console=console)
        line = next(line for line in console.export_text().splitlines() if "ARW" in line)
        assert line.count("[") == intervals
        assert "°/s/√Hz" in line and line.rstrip().endswith("°/√h")


#: Records that leave a parameter open, and the parameter: what is short of 1/alpha, a walk below the white noise.
OPEN = [
    ("gauss_markov", {"N": 0.02, "sigma_m": 0.03, "alpha": 0.03}, 600, "alpha"),
    ("gauss_markov", {"N": 0.02, "sigma_m": 0.02, "alpha": 5e-3}, 1800, "alpha"),
    ("random_walk", {"N": 0.03, "K": 3e-3}, 120, "K"),
]


@pytest.mark.parametrize(("law", "truth", "n", "parameter"), OPEN)
def test_the_further_rest_about_halves_the_interval(law: str, truth: dict[str, float], n: int, parameter: str) -> None:
    """The same records go on for the rest that is stated: in the median the interval's logarithm is 0.15 to 0.75 times
    as wide. An open interval ends at a limit of the prior, which no information describes."""
    tables = make_tables(MODEL, 1.0, ("gx",))

    def report(samples: int, seed: int) -> AxisResult:
        y, _ = simulate_bank_samples(law, truth, 1.0, samples, seed)
        bank = Bank(tables)
        bank.push(y[:, None])
        return bank.report(0)

    ratios = []
    for seed in range(case_records(40, 120)):
        before = report(n, seed)
        rest_s = halved_after(before, GROUP, 1.0, n, 1).get(parameter)
        if max(before.probability, key=lambda one: before.probability[one]) != law or rest_s is None:
            continue
        assert not before.parameters[law][parameter].identified
        e, after = before.parameters[law][parameter], report(n + math.ceil(rest_s), seed).parameters[law][parameter]
        ratios.append(math.log(after.q95 / after.q05) / math.log(e.q95 / e.q05))
    assert len(ratios) >= 3 and 0.15 <= np.median(ratios) <= 0.75, np.median(ratios)


def test_a_record_that_identifies_all_asks_for_no_rest() -> None:
    y, _ = simulate_bank_samples("random_walk", {"N": 0.02, "K": 2e-3}, 1.0, 4000, 3)
    bank = Bank(make_tables(MODEL, 1.0, ("gx",)))
    bank.push(y[:, None])
    assert halved_after(bank.report(0), GROUP, 1.0, 4000, 1) == {}
