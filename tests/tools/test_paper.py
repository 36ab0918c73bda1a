"""The page of the paper's figures: whole without the real recordings, self-contained, and its numbers are runs.

Truth: the library over the same records in one piece, and the stretches that README names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from selfcal.adequacy.allan import overlapping_variance
from selfcal.adequacy.drawn import simulate_bank_samples
from selfcal.bank.axis_result import Estimate
from selfcal.base.errors import UserError
from selfcal.logs.recording import save
from selfcal.model.file import Model
from selfcal.show.chart import Figure, Panel
from selfcal.studies.paper import show
from selfcal.studies.paper_figures import section3, section4, survey
from selfcal.studies.paper_figures.reproduction import Reproduction
from selfcal.verbs.identify import identify
from selfcal.verbs.paper import paper
from selfcal.verbs.part import part

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
    monkeypatch.setattr(section4, "MARKS", (100, 1000, 3000))
    monkeypatch.setattr(section4, "ALLAN_MARKS", (200, 1000))
    monkeypatch.setattr(section4, "AREA_RECORDS", 5)
    monkeypatch.setattr(section3, "CHOICES", 2)
    monkeypatch.setattr(survey, "TRACKS", {"area 1": 3, "area 4": 5})
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
    assert all(one.why for one in told if one.verdict == "differs" and one.name not in ("Fig. 1", "Fig. 2"))


def test_the_laws_of_figs_3_and_4_share_no_noise() -> None:
    """Steps of 600 independent readings: a correlation within 4 sd of 1 / sqrt(599) of 0. One seed makes 0.9."""
    steps = [
        np.diff(simulate_bank_samples(law, truth, 1.0, 600, section3.own_seed(law, 1))[0])
        for law, truth in section3.ALIKE.items()
    ]
    assert abs(np.corrcoef(steps)[0, 1]) < 4.0 / math.sqrt(599)


def panels_of(told: Reproduction) -> Sequence[Panel]:
    """The panels of a figure of one picture."""
    assert isinstance(told.figures, Figure)
    return told.figures.panels


@pytest.mark.parametrize("law", section3.ALIKE)
def test_the_true_curves(law: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean Allan variance and mean spectrum of 100 records lie within 4.5 standard errors of the true curves. Welch's
    window leaks a walk's power into its first bins, which the comparison leaves out."""
    monkeypatch.setattr(section3, "CHOICES", 1)
    told = {one.name: panels_of(one) for one in section3.figures_3_and_4(1)}
    place = list(section3.SHOWN).index(law)
    records = [
        simulate_bank_samples(law, section3.ALIKE[law], 1.0, section3.ALIKE_SAMPLES, 5000 + k)[0] for k in range(100)
    ]
    power = np.array([signal.welch(y, nperseg=section3.PIECE, detrend="constant")[1][5:-1] for y in records])
    m = told["Fig. 4"][place].curves[1].x
    variance = np.array([[overlapping_variance(y, int(one))[0] for one in m] for y in records])
    for found, true in (
        (power, told["Fig. 3"][place].curves[1].y[4:]),
        (variance, told["Fig. 4"][place].curves[1].y ** 2),
    ):
        assert np.abs((found.mean(axis=0) - true) / (found.std(axis=0) / 10.0)).max() < 4.5


def test_the_first_figure_begins_at_the_prior_and_has_the_papers_instants() -> None:
    """At 0 half of the choices are wrong, and the rms of a uniform prior is its width / sqrt(12)."""
    model = Model.load(section3.PAPER)
    rows = [row for law in model.hypotheses for row in section3.rows_of(model, (law, 3))]
    curve = panels_of(section3.figure_1(rows))[0].curves[0]
    assert {0, 100, 200, 300, 400, 500, 600, 1000} <= set(curve.x.tolist())
    assert curve.y[0] == 0.5
    start = next(row for row in rows if row["t"] == 0 and row["law"] == "gauss_markov")
    assert (start["sd.sigma_m"], start["sd.alpha"]) == pytest.approx((1.5 / math.sqrt(12.0), 0.09 / math.sqrt(12.0)))


def test_a_track_left_out_is_an_interpolation_of_the_others() -> None:
    """The closed form, against the interpolation itself: mean of the left-out track given all others."""
    rng = np.random.default_rng(4)
    root = rng.standard_normal((12, 12))
    covariance, measured = root @ root.T + np.eye(12), rng.standard_normal(12)
    found = survey.differences(covariance, measured, 3)
    for k in range(3):
        own, others = np.arange(4 * k, 4 * k + 4), np.delete(np.arange(12), slice(4 * k, 4 * k + 4))
        mapped = covariance[np.ix_(own, others)] @ np.linalg.solve(covariance[np.ix_(others, others)], measured[others])
        assert found[k] == pytest.approx(measured[own] - mapped)


def test_a_track_is_a_recording_of_gravity(tmp_path: Path) -> None:
    """`part` and `identify` read a track in mGal, a row every 600 s. Their priors are wider than the page's, which
    holds N low: sigma_m is within 30 % of the page's, two of its sd after 100 samples."""
    errors = survey.left_out(11, np.random.default_rng(2))
    log, model = tmp_path / "track.csv", tmp_path / "survey.yaml"
    save(log, {"gravity": ("mGal", errors[1])}, 1.0 / section4.AREA_STEP_S)
    part([log], model, axes=["gravity"])
    answer = identify(log, model=model)["axes"]["gravity"]
    _, (rms, _, _) = section4.of_map_error(section4.map_tables(Model.load(section3.PAPER)), 1e-5 * errors[1])
    sigma = answer["parameters"]["gauss_markov"]["sigma_m"]
    assert (sigma["median"], sigma["unit"]) == (pytest.approx(rms, rel=0.3), "mGal")


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
    found = section4.real(SHARED_DATA)
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


def test_a_median_far_from_the_others_is_named() -> None:
    """Four records of K, one nine times the others: the text has its factor and its interval. Alike, it has none."""

    def of(median: float) -> Estimate:
        return Estimate(mean=median, median=median, sd=median, q05=0.1 * median, q95=4.0 * median, identified=True)

    ones = [of(one) for one in (2e-4, 1.9e-4, 1.8e-3, 2.1e-4)]
    said = section4._far_off(("first", "second", "third", "fourth"), {"K": ones})
    assert said.startswith("K of third is 8.8 times the middle one: its interval, 1.8e-04 to 7.2e-03")
    assert section4._far_off(("first", "second"), {"K": ones[:2]}) == ""
