"""Sizes of several causes on one record: those of the final model, all causes together, in print and in the file.

Truth: the numbers that each record was drawn with. A ramp and a step take a part of each other: alone, either has
another size.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from selfcal.verbs.codegen import codegen
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify

from conftest import case_records

Array = NDArray[np.float64]

N, K, SLOPE, JUMP, AT_S = 0.04, 1e-4, -2e-4, 0.45, 1300.0


def ramp_and_step(random: np.random.Generator) -> tuple[Array, Array]:
    t = np.arange(3600.0)
    walk = K * random.standard_normal(t.size).cumsum()
    return t, SLOPE * t + JUMP * (t >= AT_S) + walk + N * random.standard_normal(t.size)


def write(path: Path, t: Array, y: Array) -> Path:
    np.savetxt(path, np.column_stack([t, y]), delimiter=",", fmt="%.8g", header="t[s],gx[deg/s]", comments="")
    return path


def effects(path: Path) -> dict[str, dict[str, str]]:
    """Those of a model file: by cause its keys."""
    tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    parts = (text.split(":", 1) for text in tree["simulate"]["effects"])
    return {cause: dict(pair.split("=") for pair in keys.split(",")) for cause, keys in parts}


def test_sizes_are_those_of_all_causes_together(tmp_path: Path) -> None:
    """Each size lies within four posterior deviations of the truth (far out of 3 in 10 000), and the model file states
    the same to its eight digits."""
    for seed in range(case_records(1, 20)):
        log = write(tmp_path / "log.csv", *ramp_and_step(np.random.default_rng([6121, seed])))
        model = tmp_path / f"model{seed}.yaml"
        findings = diagnose(log, axes=["gx"], write_model=model)["axes"]["gx"]["findings"]
        by_cause: dict[str, dict[str, Any]] = {finding["cause"]: finding["estimate"] for finding in findings}
        assert set(by_cause) == {"ramp", "step"}
        written = effects(model)
        for cause, key, truth in (("ramp", "slope", SLOPE), ("step", "amplitude", JUMP)):
            size = by_cause[cause][key]
            assert abs(size["median"] - truth) < 4.0 * size["sd"]
            assert float(written[cause][key]) == pytest.approx(size["median"], rel=1e-7)


def test_findings_without_room_on_a_module_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Four lines have eight columns, and a bank has six: a module has none of the weakest line, and each verb says so.
    The file has all four, and `diagnose` takes them."""
    random = np.random.default_rng(6122)
    t = np.arange(3000.0)
    sizes = {0.031: 0.05, 0.083: 0.045, 0.127: 0.04, 0.211: 0.03}
    y = N * random.standard_normal(t.size) + K * random.standard_normal(t.size).cumsum()
    y += sum(size * np.sin(2.0 * np.pi * hz * t + hz) for hz, size in sizes.items())
    log, model = write(tmp_path / "log.csv", t, y), tmp_path / "model.yaml"
    findings = diagnose(log, axes=["gx"], write_model=model)["axes"]["gx"]["findings"]
    out = [one for one in findings if "left_out_of_model" in one]
    assert [one["estimate"]["frequency_hz"]["median"] for one in out] == pytest.approx([0.211], abs=1e-4)
    assert f"{model.name}: a module leaves out gx periodic" in capsys.readouterr().err
    tree = yaml.safe_load(model.read_text(encoding="utf-8"))
    assert [entry["frequency_hz"] for entry in tree["regressors"]] == pytest.approx(list(sizes), abs=1e-4)
    codegen(model, tmp_path / "tables")
    assert "#define SELFCAL_MODEL_REGRESSORS 6U" in (tmp_path / "tables" / "selfcal_model.h").read_text("utf-8")
    identify(log, model=model)
    said = capsys.readouterr().err
    assert said.count("a bank has 6 columns, and leaves out line_0.21") == 2
    again = diagnose(log, axes=["gx"], model=model)["axes"]["gx"]
    assert again["verdict"] == "adequate"
