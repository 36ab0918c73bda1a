"""The page of the paper's figures: whole without the real recordings, self-contained, and its numbers are runs.

Truth: the library over the same records in one piece, and the stretches that README names.
"""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from selfcal.errors import UserError
from selfcal.model import Model
from selfcal.paper_figures import section3, section4
from selfcal.studies.paper import paper, show

from conftest import SHARED_DATA, run


class Reader(HTMLParser):
    """Tags that are open, and everything that a page could load."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []
        self.pictures = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.pictures += tag == "svg"
        self.loads += [
            str(value) for name, value in attrs if name in ("src", "data") or (name, tag) == ("href", "link")
        ]
        if tag not in ("meta", "path"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert tag == "path" or self.open.pop() == tag


def test_the_page_without_real_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Few records, so that it is fast. Each figure has its words, and the absent ones say so on the page and aloud."""
    monkeypatch.setattr(section4, "SCATTER", 3)
    monkeypatch.setattr(section4, "AREA_RECORDS", 5)
    out = tmp_path / "paper.html"
    told = paper(out, data=tmp_path, records=4)
    show(told, out)
    text = out.read_text(encoding="utf-8")
    for number in range(1, 9):
        assert re.search(rf"<h2>Fig\. {number}\b", text), number
    assert "Not made: the real recordings are absent" in text
    assert "REAL DATA ABSENT: adis16405_run1.npz" in capfd.readouterr().err
    reader = Reader()
    reader.feed(text)
    assert not reader.open
    assert not reader.loads
    assert reader.pictures > 30
    assert {one.verdict for one in told} <= {"agrees", "differs", "skipped"}


def test_reports_over_time_are_those_of_the_whole_record() -> None:
    """The bank's last report after pieces is its report of the record at once, but for the order of float sums."""
    model = Model.load(section3.PAPER)
    y = np.random.default_rng(1).standard_normal(200)
    pieces = section3.over_time(model, "gx", 1.0, y, (10, 55, 200))[-1]
    whole = section3.over_time(model, "gx", 1.0, y, (200,))[0]
    assert pieces.probability == pytest.approx(whole.probability, abs=1e-4)


def test_the_stretches_of_the_real_recordings() -> None:
    if not (SHARED_DATA / "adis16405_run1.npz").exists():
        pytest.skip(f"REAL DATA ABSENT: {SHARED_DATA} (see README, 'Real recordings')")
    found = section4.real(SHARED_DATA, Model.load())
    assert all(y.size == section4.DURATION and np.isfinite(y).all() for y in found.values())
    places = section4.STRETCHES
    assert len(set(places)) == len(places) >= 4
    assert not any(a != b and a[0] == b[0] and abs(a[1] - b[1]) < section4.DURATION for a in places for b in places)


def test_what_it_refuses(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"--data .*absent: there is no such folder"):
        paper(tmp_path / "a.html", data=tmp_path / "absent")
    done = run("paper", "-o", tmp_path / "no" / "a.html")
    assert done.returncode == 2
    assert "make it first" in done.stderr
