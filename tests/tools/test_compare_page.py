"""The page of `compare --report`. Truth: two recordings of one part that differ by a step and by their noise."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_page import HOSTILE, Page

from selfcal.base.errors import UserError
from selfcal.batch.compare import show
from selfcal.logs.recording import save
from selfcal.show.comparison_page import page
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
    assert re.search(r"step.*found", seen.text)
    quantities = document["quantities"][document["recordings"][0]]["ax"]
    assert f"{quantities['N']['median']:.3g}" in seen.text
    assert [one["id"] for one in seen.named("h2")] == ["changes", "verdicts", "axis-ax", "axis-gx", "read"]
    assert len(seen.named("figure")) == 2 and len([one for one in seen.named("svg") if "aria-label" in one]) == 4


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
    assert "Nothing changed beyond what the recordings leave open" in page(quiet, {})
    missing = {**document, "axes": {"gx": {"error": "b.npz does not have it", "changes": []}}}
    assert "gx not compared: b.npz does not have it" in Page(page(missing, {})).text


def test_the_terminal_tells_what_each_recording_shows(
    made: tuple[dict[str, Any], str], capsys: pytest.CaptureFixture[str]
) -> None:
    """The step is in the second alone."""
    show(made[0])
    first, second = (line for line in capsys.readouterr().out.splitlines() if ".npz: " in line)
    assert first == "monday.npz: no finding that matters"
    assert second.endswith(".npz: step on gx")


def test_it_is_not_written_over_a_recording(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is read"):
        compare([tmp_path / "a.npz", tmp_path / "b.npz"], report=tmp_path / "a.npz")
