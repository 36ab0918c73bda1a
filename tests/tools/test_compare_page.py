"""The page of `compare --report`. Truth: two recordings of one part that differ by a step and by their noise."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_page import HOSTILE, Page

from selfcal.base.errors import UserError
from selfcal.batch.compare import changes, show
from selfcal.logs.recording import save
from selfcal.show.comparison_page import comparison_html, told_of
from selfcal.verbs.compare import compare


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], str]:
    """The document and the page of two records of half an hour: gx has a step in the second and twice the noise, ax is
    the same in both."""
    folder = tmp_path_factory.mktemp("compare")
    logs = [folder / "monday.npz", folder / f"{HOSTILE.replace('/', '')}.npz"]
    for k, log in enumerate(logs):
        rng = np.random.default_rng(20 + k)
        gx = 0.04 * (1 + k) * rng.standard_normal(1800) + 1.2 * k * (np.arange(1800) >= 700)
        save(log, {"gx": ("deg/s", gx), "ax": ("m/s^2", 0.01 * rng.standard_normal(1800))}, 1.0, {})
    compare(logs, report=folder / "page.html", json=folder / "out.json")
    return json.loads((folder / "out.json").read_text()), (folder / "page.html").read_text()


def test_it_has_what_the_document_has(made: tuple[dict[str, Any], str]) -> None:
    document, text = made
    rows = {row["quantity"]: row for row in document["axes"]["gx"]}
    assert rows["N"]["after"] == pytest.approx(2.0 * rows["N"]["before"], rel=0.2)  # 4 sd of 1800 readings are 0.13
    assert rows["step"]["what"] == "appeared"
    assert document["axes"]["ax"] == []
    seen = Page(text)
    assert f"{rows['N']['before']:.5g}" in seen.text and f"{rows['N']['distance_sd']:+.1f}" in seen.text
    assert rows["step"]["after"] == pytest.approx(1.2, abs=0.02)  # 5 sd of the means on both sides
    assert re.search(r"step.*1\.2", seen.text)
    quantities = document["quantities"][document["recordings"][0]]["ax"]
    assert f"{quantities['N']['median']:.3g}" in seen.text
    assert [one["id"] for one in seen.named("h2")] == ["changes", "verdicts", "axis-gx", "axis-ax", "read"]
    assert len(seen.named("figure")) == 2 and len([one for one in seen.named("svg") if "aria-label" in one]) == 4


@pytest.fixture(scope="module")
def tilted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The document of two records of 40 minutes. In the second the part turns by 0.7 and 0.5 deg about two axes after
    1500 s, and the walk of gz is five times as large. All else is the same."""
    folder = tmp_path_factory.mktemp("tilted")
    logs = [folder / name for name in ("before.npz", "after.npz")]
    t = np.arange(2400.0)
    for k, log in enumerate(logs):
        rng = np.random.default_rng(70 + k)
        rows = {"gz": (0.0, 0.04, 0.002 * (1 + 4 * k)), "ax": (0.0, 0.007, 0.0003), "ay": (0.0, 0.007, 0.0003)}
        rows["az"] = (9.81, 0.007, 0.0003)
        drifting = {
            name: mean + N * rng.standard_normal(t.size) + np.cumsum(K * rng.standard_normal(t.size))
            for name, (mean, N, K) in rows.items()
        }
        turned = k * (t >= 1500.0)
        log_of = {
            "gz": ("deg/s", drifting["gz"]),
            "ax": ("m/s^2", drifting["ax"] + 9.81 * np.deg2rad(0.7) * turned),
            "ay": ("m/s^2", drifting["ay"] - 9.81 * np.deg2rad(0.5) * turned),
            "az": ("m/s^2", drifting["az"]),
        }
        save(log, log_of, 1.0, {})
    return dict(compare(logs))


def test_a_tilt_is_no_change_of_the_drift(tilted: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    """K is compared with the findings in the model: a jump of the readings is not a drift that became faster."""
    rows = {(name, row["quantity"]): row for name, axis in tilted["axes"].items() for row in axis}
    assert not {("ax", "K"), ("ay", "K"), ("az", "K")} & rows.keys()
    assert rows["ax", "tilt"]["after"] == pytest.approx(9.81 * np.deg2rad(0.7), abs=0.01)  # 4 sd of the drift
    assert rows["ay", "tilt"]["after"] == pytest.approx(-9.81 * np.deg2rad(0.5), abs=0.01)
    K = rows["gz", "K"]
    assert 3.0 < K["after"] / max(K["before"], 1e-9) < 8.0  # five times, by two estimates of 15 % each
    show(tilted)
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [line[:3] for line in lines if line[2:3] == ["tilt"]] == [["ax", "ay", "tilt"]]
    assert any(line[1:6] == ["tilt", "on", "ax", "ay:", "at"] for line in lines)  # as `diagnose` has it


def test_a_drift_that_one_record_cannot_tell_is_below_its_limit() -> None:
    """From "less than 0.001" to 0.01 is a change; two numbers that nobody knows are none."""
    unknown = {"median": 1e-5, "q05": 1e-8, "q95": 1e-3, "unit": "deg/s^2/sqrt(Hz)", "identified": False}
    known = {**unknown, "median": 1e-2, "q05": 8e-3, "q95": 1.2e-2, "identified": True}
    (row,) = changes({"K": unknown}, {"K": known})
    assert (row["what"], row["before_below"]) == ("changed", 1e-3) and "after_below" not in row
    assert changes({"K": unknown}, {"K": {**unknown, "median": 5e-3, "q05": 4.9e-3, "q95": 5.1e-3}}) == []
    bare = {"median": 2.0, "unit": "1"}  # how much louder motion is: no interval
    assert changes({"motion.ratio": bare}, {"motion.ratio": {**bare, "median": 40.0}}) == []
    document = {"recordings": ["a", "b"], "axes": {"gx": [{"from": "a", "to": "b", **row}]}}
    ((line,),) = told_of(document).values()
    assert (line.side("before", "-"), line.side("after", "-")) == ("< 0.001", "0.01")


def test_nothing_in_it_runs_or_is_loaded(made: tuple[dict[str, Any], str]) -> None:
    _, text = made
    seen = Page(text)
    assert HOSTILE.replace("/", "") in seen.text  # the file's name, as text
    for tag, attributes in seen.tags:
        assert tag not in ("script", "img", "iframe", "object", "link", "form")
        assert not any(name.startswith("on") or name in ("src", "data") for name in attributes)
        assert attributes.get("href", "#").startswith("#")  # type: ignore[union-attr]
    targets = {attributes["id"] for _, attributes in seen.tags if "id" in attributes}
    for _, attributes in seen.tags:
        for reference in ("aria-labelledby",):
            assert attributes.get(reference) is None or attributes[reference] in targets


def test_without_a_change_it_states_so(made: tuple[dict[str, Any], str]) -> None:
    document, _ = made
    quiet = {**document, "axes": {"ax": []}}
    assert "nothing changed beyond what the recordings leave open" in comparison_html(quiet, {})
    missing = {**document, "axes": {"gx": {"error": "b.npz does not have it", "changes": []}}}
    assert "gx not compared: b.npz does not have it" in Page(comparison_html(missing, {})).text


def test_the_terminal_tells_what_each_recording_shows(
    made: tuple[dict[str, Any], str], capsys: pytest.CaptureFixture[str]
) -> None:
    """The step is in the second alone. Findings are as `diagnose` has them."""
    document = made[0]
    assert [(one["cause"], one["recording"]) for one in document["findings"] if one["material"]] == [
        ("step", document["recordings"][1])
    ]
    show(document)
    first, second = capsys.readouterr().out.splitlines()[-2:]
    assert first == "monday.npz: no finding that matters"
    assert re.search(r"\.npz: step on gx: at 699\.\d+ ± [\d.]+ s$", second)


def test_each_pair_of_three_has_its_own_list(capsys: pytest.CaptureFixture[str]) -> None:
    """From the first to the second a settling appears and N grows; it is gone in the third, and N is as it was."""
    logs, unit = ["u/one.csv", "u/two.csv", "u/three.csv"], {"unit": "deg/s/sqrt(Hz)"}
    changed = {"quantity": "N", "what": "changed", **unit}
    first, second = ({"from": one, "to": two} for one, two in pairwise(logs))
    rows = [
        {**first, "quantity": "turn_on 2", "what": "appeared", "after": 0.31, "unit": "deg/s"},
        {**first, **changed, "before": 0.02, "after": 0.05, "distance_sd": 9.0},
        {**second, "quantity": "turn_on 2", "what": "gone", "before": 0.31, "unit": "deg/s"},
    ]
    document = {"recordings": logs, "axes": {"gy": rows, "gz": []}, "findings": [], "verdicts": {}, "limit_sd": 3.4}
    told = told_of(document)
    assert [[line.change["quantity"] for line in lines] for lines in told.values()] == [
        ["turn_on 2", "N"],
        ["turn_on 2"],
    ]
    show(document)
    shown = capsys.readouterr().out
    between = shown.index("two.csv -> three.csv")
    assert shown.index("one.csv -> two.csv") < shown.index("turn-on transient 2") < shown.index("0.05") < between
    assert "turn-on transient 2" in shown[between:] and "turn_on" not in shown
    seen = Page(comparison_html({**document, "verdicts": {log: {} for log in logs}, "quantities": {}}, {})).text
    assert "one.csv → two.csv" in seen and "turn-on transient 2" in seen and "turn on" not in seen


def test_it_is_not_written_over_a_recording(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is read"):
        compare([tmp_path / "a.npz", tmp_path / "b.npz"], report=tmp_path / "a.npz")
