"""Limits of a data sheet: pass, fail, or how much longer a unit must rest; JUnit and exit codes of a line.

Truth: bounds that a test states, and parameters of simulated parts, some hours of which were not looked at.
"""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from selfcal.adequacy.drawn import simulate_bank_samples
from selfcal.bank.axis_result import AxisResult
from selfcal.bank.library import Bank
from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.base.units import duration_words
from selfcal.batch.verdicts import CHANCE, FAIL, OPEN, PASS, UNJUDGED, Limits, judge_limits
from selfcal.logs.recording import save
from selfcal.model.file import Model
from selfcal.model.tables import Tables, make_tables
from selfcal.verbs.fleet import fleet

from conftest import case_records, run

UNIT = "deg/s"


def entry(result: AxisResult) -> dict[str, Any]:
    """An axis of the document of `identify`, of a bank's report."""
    return {
        "hypotheses": result.probability,
        "log_evidence": result.log_evidence,
        "adequate": True,
        "bias_now": {"mean": result.bias_mean, "sd": result.bias_sd, "unit": UNIT},
        "parameters": {
            law: {name: {**vars(e), "unit": units.parameter_unit(name, UNIT)} for name, e in estimates.items()}
            for law, estimates in result.parameters.items()
        },
    }


def look(tables: Tables, y: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, Any]:
    """The report of bank samples."""
    bank = Bank(tables)
    bank.push(y[:, None])
    return entry(bank.report(0))


def limits(folder: Path, text: str) -> Limits:
    place = folder / "limits.yaml"
    place.write_text(text)
    return Limits.load(place, Model.load())


def axis_of(law: str = "random_walk", **parameters: tuple[float, float, float]) -> dict[str, Any]:
    """An axis of one law, each parameter by median, q05, q95."""
    known: Mapping[str, Any] = {
        name: {
            **dict(zip(("median", "q05", "q95"), values, strict=True)),
            "unit": units.parameter_unit(name, UNIT),
            "identified": True,
            "off_grid": False,
        }
        for name, values in parameters.items()
    }
    bias = {"mean": 0.1, "sd": 0.001, "unit": UNIT}
    return {"hypotheses": {law: 1.0}, "parameters": {law: known}, "bias_now": bias}


def test_a_bound_decides(tmp_path: Path) -> None:
    """The upper bound passes a maximum, the lower one fails it, in the limit's own unit; between them it is open."""
    axis = axis_of(N=(0.010, 0.009, 0.011), K=(1e-3, 8e-4, 1.3e-3))
    for text, expected in (
        ("gx.N: {max: 0.0111 deg/s/sqrt(Hz)}", PASS),
        ("gx.N: {max: 0.0105 deg/s/sqrt(Hz)}", OPEN),
        ("gx.N: {max: 0.0089 deg/s/sqrt(Hz)}", FAIL),
        ("gx.N: {max: 0.67 deg/sqrt(h)}", PASS),  # 0.011 deg/s/sqrt(Hz) is 0.66
        ("gx.N: {max: 0.65 deg/sqrt(h)}", OPEN),
        ("gx.N: {min: 0.0089 deg/s/sqrt(Hz)}", PASS),
        ("gx.N: {min: 0.012 deg/s/sqrt(Hz)}", FAIL),
        ("gx.bias: {max: 0.103 deg/s}", PASS),
        ("gx.bias: {max: 0.0980 deg/s}", FAIL),
        ("gx.bias: {min: 360 deg/h}", OPEN),
        ("gx.sigma_m: {max: 1 deg/s}", UNJUDGED),
        ("gy.N: {max: 1 deg/s/sqrt(Hz)}", UNJUDGED),
    ):
        (verdict,) = judge_limits(limits(tmp_path, text).of({"gx"}), {"gx": axis}, 600.0)
        assert verdict.verdict == expected, text


def test_what_the_drift_has(tmp_path: Path) -> None:
    """A constant drift bounds K by the walk's posterior; a Gauss-Markov drift has no K to judge."""
    walk = axis_of(N=(0.01, 0.009, 0.011), K=(1e-4, 2e-5, 3e-4))["parameters"]["random_walk"]
    walk["K"]["identified"] = False
    noise = {"N": walk["N"]}
    other = axis_of("gauss_markov", N=(0.01, 0.009, 0.011), sigma_m=(0.01, 0.008, 0.013), alpha=(0.01, 0.005, 0.02))
    for laws, expected in (
        ({"constant": (0.8, noise), "random_walk": (0.2, walk)}, (PASS, OPEN, OPEN)),
        ({"random_walk": (0.01, walk), "gauss_markov": (0.99, other["parameters"]["gauss_markov"])}, (UNJUDGED,) * 3),
        ({"random_walk": (0.3, walk), "gauss_markov": (0.7, other["parameters"]["gauss_markov"])}, (PASS, OPEN, OPEN)),
    ):
        axis = {
            "hypotheses": {law: one[0] for law, one in laws.items()},
            "parameters": {law: one[1] for law, one in laws.items()},
        }
        for value, verdict in zip((4e-4, 2e-4, 1e-5), expected, strict=True):
            text = f"gx.K: {{max: {value} deg/s^2/sqrt(Hz)}}"
            assert judge_limits(limits(tmp_path, text).of({"gx"}), {"gx": axis}, 600.0)[0].verdict == verdict, (
                laws,
                value,
            )


def test_the_rest_that_is_asked_for_suffices(tmp_path: Path) -> None:
    """After it CHANCE of the open units have their verdict: N and K near their limits, records of 20 min.

    Truth: records simulated four hours on. Units that need longer are left out, which favours nobody: their share is
    counted on neither side. Three sd of a binomial share.
    """
    records = case_records(30, 200)
    base_s, longest_s, N, K = 1200.0, 14400.0, 0.03, 2e-3
    model = Model.load()
    tables = make_tables(model, 1.0, ("gx",))
    random = np.random.default_rng(20261)
    asked = told = 0
    seed = 0
    while asked < records:
        seed += 1
        y, _ = simulate_bank_samples("random_walk", {"N": N, "K": K}, 1.0, int(longest_s), seed)
        first = look(tables, y[: int(base_s)])
        value = float(np.exp(random.uniform(-0.5, 0.5)))
        name = "K" if seed % 2 else "N"
        limit = K * value if name == "K" else N * value**0.15
        stated = limits(tmp_path, f"gx.{name}: {{max: {limit} {units.parameter_unit(name, UNIT)}}}").of({"gx"})
        verdict = judge_limits(stated, {"gx": first}, base_s)[0]
        if verdict.verdict != OPEN or verdict.more_s is None or base_s + verdict.more_s > longest_s:
            continue
        asked += 1
        second = look(tables, y[: int(base_s + verdict.more_s)])
        told += judge_limits(stated, {"gx": second}, base_s + verdict.more_s)[0].verdict in (PASS, FAIL)
    print(f"{told} of {asked} have a verdict after the rest")
    assert abs(told / asked - CHANCE) <= 3.0 * math.sqrt(CHANCE * (1.0 - CHANCE) / asked)


def test_files_that_are_no_limits(tmp_path: Path) -> None:
    for text, words in (
        ("gx.N: {max: 0.014}", "gx.N.max: takes a number and a unit as deg/s/sqrt(Hz), not 0.014"),
        ("gx.N: {max: 0.014 deg/s}", "takes a number and a unit as deg/s/sqrt(Hz)"),
        ("gx.N: {max: nan deg/s/sqrt(Hz)}", "takes a number"),
        ("gx.N: {most: 1 deg/s/sqrt(Hz)}", "takes {max: VALUE UNIT}"),
        ("gx.N: 3", "takes {max: VALUE UNIT}"),
        ("gq.N: {max: 1 deg/s}", "begins with no group or axis of the model"),
        ("gx.Q: {max: 1 deg/s}", "ends with none of bias, N"),
        ("{}", "no limit is in it"),
        ("schema: selfcal.model/1", "schema: must be selfcal.limits/1"),
        ("gx.N: {max: 1 deg/s/sqrt(Hz), max: 2 deg/s/sqrt(Hz)}", "appears twice"),
        ("- 1", "not a limits file"),
    ):
        with pytest.raises(UserError) as caught:
            limits(tmp_path, text)
        assert words in str(caught.value) and "\n" not in str(caught.value), text
    with pytest.raises(UserError, match="cannot read the limits file"):
        Limits.load(tmp_path / "absent.yaml", Model.load())


def test_a_group_and_an_axis_of_it(tmp_path: Path) -> None:
    found = limits(tmp_path, "gyro.N: {max: 1 deg/s/sqrt(Hz)}\ngy.N: {max: 2 deg/s/sqrt(Hz)}\n").of({"gx", "gy"})
    assert [(one.axis, one.value) for one in found] == [("gx", 1.0), ("gy", 2.0)]


def test_durations() -> None:
    assert [duration_words(s) for s in (40.2, 719.0, 7300.0, 200000.0)] == ["41 s", "12 minutes", "3 hours", "3 days"]


@pytest.fixture
def line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A quiet unit, a loud one, and a broken one: N 0.01 and 0.04 deg/s/sqrt(Hz)."""
    monkeypatch.chdir(tmp_path)
    random = np.random.default_rng(3)
    for name, N in (("quiet", 0.01), ("loud", 0.04)):
        save(f"{name}.npz", {"gx": ("deg/s", N * 2.0 * random.standard_normal(2400))}, 4.0)
    Path("broken.csv").write_text("gx[deg/s]\n<&\x01\n")
    Path("limits.yaml").write_text("gx.N: {max: 0.02 deg/s/sqrt(Hz)}\n")
    return tmp_path


def cases(path: Path) -> dict[str, str]:
    """Outcome by class name, of the XML; and its counts are those of the cases."""
    root = ElementTree.parse(path).getroot()
    found = {}
    for case in root.iter("testcase"):
        found[case.attrib["classname"]] = case[0].tag if len(case) else "passed"
    kinds = list(found.values())
    assert [root.attrib[key] for key in ("tests", "failures", "errors")] == [
        str(n) for n in (len(kinds), kinds.count("failure"), kinds.count("error"))
    ]
    return found


def test_a_production_line(line: Path) -> None:
    """A unit that could not be judged has not passed: it is an error in JUnit, and exit code 2."""
    result = fleet(["*.npz", "*.csv"], "t.csv", limits="limits.yaml", junit="j.xml", verdicts="v.csv")
    assert cases(line / "j.xml") == {"broken": "error", "loud": "failure", "quiet": "passed"}
    assert result["code"] == 1 and set(result["failed"]) == {"loud"} and set(result["not_judged"]) == {"broken"}
    assert len((line / "v.csv").read_text().splitlines()) == 4
    for log, code, outcome in (("quiet.npz", 0, "passed"), ("loud.npz", 1, "failure"), ("broken.csv", 2, "error")):
        found = run("identify", log, "--limits", "limits.yaml", "--junit", "one.xml", "--json", "one.json", cwd=line)
        assert found.returncode == code, found.stderr
        assert list(cases(line / "one.xml").values()) == [outcome]
    found = run("diagnose", "loud.npz", "--limits", "limits.yaml", "--json", "one.json", cwd=line)
    assert found.returncode == 1 and "gx.N <= 0.02 deg/s/sqrt(Hz): fail" in found.stderr
    assert json.loads((line / "one.json").read_text())["limits"][0]["verdict"] == FAIL
    found = run("compare", "quiet.npz", "loud.npz", "--limits", "limits.yaml", "--junit", "both.xml", cwd=line)
    assert found.returncode == 1 and cases(line / "both.xml") == {"quiet": "passed", "loud": "failure"}
    found = run("identify", "quiet.npz", "--junit", "one.xml", cwd=line)
    assert found.returncode == 2 and "give --limits LIMITS.yaml too" in found.stderr
    before = (line / "quiet.npz").read_bytes()  # an output on an input, and an error: the input stays
    found = run("identify", "quiet.npz", "--limits", "limits.yaml", "--junit", "quiet.npz", cwd=line)
    assert found.returncode == 2 and (line / "quiet.npz").read_bytes() == before
