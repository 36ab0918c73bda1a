"""The page of `selfcal diagnose --report`: its pictures show the cause, its text is safe, a browser has no complaint.

The pictures' truth is the effect that each record here is made with: the curve leaves the simulated band before the
cause is in the model and lies in it afterwards. The browser is Debian's chromium, the judge of accessibility axe-core.
"""

from __future__ import annotations

import html
import json
import math
import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.base.output import write_text
from selfcal.diagnosis import integrity
from selfcal.diagnosis.causes import colored_noise, periodic, ramp, step, variance_change
from selfcal.diagnosis.causes import outliers as outliers_cause
from selfcal.diagnosis.channel_looks import side_looks
from selfcal.diagnosis.diagnose_document import diagnose_document
from selfcal.diagnosis.events import add_findings
from selfcal.diagnosis.finding import Diagnosed, Finding
from selfcal.diagnosis.loop import diagnose_record
from selfcal.diagnosis.record import Missing, Record, record_from
from selfcal.diagnosis.words import named
from selfcal.likelihood.state import Look, State
from selfcal.logs.recording import load
from selfcal.model.file import Model
from selfcal.show import chart, pictures
from selfcal.show.chart import Band, Curve, Figure, Panel, outside_of
from selfcal.show.diagnosis_page import diagnosis_html

from conftest import run

HOSTILE = '<script>alert("x")</script><img src=x onerror=alert(1)>\'"&'
#: Points on a curve, at most.
MOST_POINTS = 400
N, RATE = 2000, 1.0


# ------------------------------------------------------------------------------------------------ pictures of a cause


def state_of(y: Array, lsb: float = 0.0) -> State:
    """An axis with white noise of about 1 deg/s a sample."""
    return State("gx", "deg/s", y, 1.0 / RATE, 0.0, np.ones(y.size), lsb=lsb).refit()


def record_of(*axes: Array, temperature: Array | None = None) -> Record:
    states = {f"g{name}": replace(state_of(y), axis=f"g{name}") for name, y in zip("xyz", axes, strict=False)}
    channels = {} if temperature is None else {"temperature": temperature}
    names = {} if temperature is None else {"temperature": "temp"}
    present = np.isfinite(next(iter(states.values())).y)
    return Record(RATE, states, channels, names, present)


def found(record: Record, look: Look) -> Finding:
    """What the loop makes of a look."""
    before = record.axes["gx"]
    return Finding(look, 1, before, before.refit(**look.changes))


def only(looks: list[Look], cause: str) -> Look:
    return next(look for look in looks if look.cause == cause)


def a_ramp(y: Array) -> Finding:
    record = record_of(y + 4.0 * np.linspace(-1.0, 1.0, N))
    return found(record, only(ramp.looks(record.axes["gx"], record), "ramp"))


def a_temperature(y: Array) -> Finding:
    temperature = 3.0 * np.sin(np.linspace(0.0, 14.0, N))
    record = record_of(y + 0.5 * temperature, temperature=25.0 + temperature)
    return found(record, only(side_looks(record.axes["gx"], record, "temperature"), "temperature"))


def a_step(y: Array) -> Finding:
    record = record_of(y + 3.0 * (np.arange(N) >= 1200))
    return found(record, step.looks(record.axes["gx"], record)[0])


def a_line(y: Array) -> Finding:
    record = record_of(y + 0.7 * np.sin(2.0 * math.pi * 0.123 * np.arange(N)))
    return found(record, periodic.looks(record.axes["gx"], record)[0])


def a_color(y: Array) -> Finding:
    record = record_of(y + 0.7 * np.append(0.0, y[:-1]))
    return found(record, colored_noise.looks(record.axes["gx"], record)[0])


def a_change(y: Array) -> Finding:
    record = record_of(y * np.where(np.arange(N) < 900, 1.0, 1.6))
    return found(record, variance_change.looks(record.axes["gx"], record)[0])


def outliers(y: Array) -> Finding:
    y = y.copy()
    y[100:1900:150] += 12.0
    record = record_of(y)
    return found(record, outliers_cause.looks(record.axes["gx"], record)[0])


def a_lattice(y: Array) -> Finding:
    state = state_of(np.rint(y / 2.0) * 2.0, lsb=2.0)
    told = integrity.quantization(replace(record_of(y), axes={"gx": state}), "gx")
    assert told is not None
    return Finding(told[0], 0, state, told[1])


#: Cause: how a finding is made, which of its figures shows it, by how many points outside the band at least.
SHOWN: dict[str, tuple[Callable[[Array], Finding], str, int]] = {
    "ramp": (a_ramp, "Evidence along the record", 50),
    "temperature": (a_temperature, "Evidence along the record", 100),
    "step": (a_step, "Evidence along the record", 60),
    "periodic": (a_line, "Spectrum about the line", 1),
    "colored_noise": (a_color, "Correlation of the residual innovations", 1),
    "variance_change": (a_change, "Noise level of the residual innovations", 30),
    "outliers": (outliers, "Largest residual innovations", 10),
    "quantization": (a_lattice, "Histogram of the readings", 10),
}


def drawn(finding: Finding, record: Record) -> list[Figure]:
    one = Diagnosed(finding.before, finding.after, record, [finding])
    return pictures.figures(one, record, 1.0, "deg/s")[1][0]


@pytest.mark.parametrize("cause", SHOWN)
def test_the_picture_shows_the_cause_before_and_not_after(cause: str) -> None:
    """The band is the range of 20 records, so that one point in ten of a true model lies outside; neighbours of a sum
    (the evidence) do so together, and a band of few points has few: a quarter is allowed after."""
    make, name, least = SHOWN[cause]
    finding = make(np.random.default_rng(7).standard_normal(N))
    assert finding.look.cause == cause
    record = Record(RATE, {"gx": finding.before}, {}, {}, np.ones(N, bool))
    figure = next(one for one in drawn(finding, record) if one.name == name)
    before, after = (outside_of(panel.curves[0], panel.bands[0]) for panel in figure.panels)
    assert before[0] >= least
    assert after[0] < before[0] and after[0] <= max(1, after[1] / 4)


def test_the_fitted_step_is_drawn_where_it_is() -> None:
    finding = a_step(np.random.default_rng(8).standard_normal(N))
    figure = drawn(finding, record_of(finding.before.y))[0]
    fitted = figure.panels[0].curves[1]
    jump = float(fitted.x[np.argmax(np.diff(fitted.y))])
    # The true one is 3 deg/s at 1200 s; a piece is 10 s, and the size is known to 0.1 (white noise over 800 s, walk).
    assert abs(jump - 1200.0) < 15.0
    assert abs(np.ptp(fitted.y) - 3.0) < 0.5


def test_missing_samples_are_counted_where_they_are() -> None:
    y = np.random.default_rng(3).standard_normal(N)
    y[500:600] = np.nan
    record = replace(record_of(y), missing={"gx": Missing(100, N, (500.0, 600.0))})
    looks, held = integrity.missing(record)
    assert looks["gx"].when == (500.0, 600.0) and not held.any()
    finding = Finding(looks["gx"], 0, record.axes["gx"], record.axes["gx"])
    (figure,) = drawn(finding, record)
    curve = figure.panels[0].curves[0]
    inside = (curve.x > 500.0) & (curve.x < 600.0)
    assert np.all(curve.y[inside] == 100.0) and np.all(curve.y[~inside] == 0.0)
    assert "100 samples in 1 gaps" in figure.caption


def test_allan_deviation_of_white_noise_with_gaps() -> None:
    """White noise of sd s has s / sqrt(m). m = 64 rests on 400 independent means: 5 % once, 20 % four times."""
    y = 2.0 * np.random.default_rng(5).standard_normal(50_000)
    y[10_000:13_000] = np.nan
    sizes = np.array([1, 4, 16, 64])
    assert pictures.allan_deviation(y, sizes) == pytest.approx(2.0 / np.sqrt(sizes), rel=0.2)
    alternating = np.tile([1.0, -1.0], 500)
    assert pictures.allan_deviation(alternating, np.array([1, 2])) == pytest.approx([math.sqrt(2.0), 0.0])


def test_envelope_keeps_every_extreme() -> None:
    y = np.random.default_rng(1).standard_normal(123_457)
    y[77_777], y[5] = 40.0, np.nan
    x, mean, low, high = chart.envelope(np.arange(y.size, dtype=float), y, MOST_POINTS)
    assert x.size + x.size <= MOST_POINTS
    assert high.max() == 40.0 and low.min() == np.nanmin(y)
    assert np.all((low <= mean) & (mean <= high))


def test_curves_of_a_long_recording_are_short() -> None:
    """Ten hours at 100 Hz."""
    n = 3_600_000
    state = State("gx", "deg/s", np.zeros(n), 0.01, 0.0, np.ones(n))
    record = Record(100.0, {"gx": state}, {}, {}, np.ones(n, bool))
    finding = Finding(Look("motion", 1.0, 1.0, {}, {}), 0, state, state)
    compared = [
        pictures._allan(state, state, 1.0, "deg/s"),
        pictures._spectrum(state, state, 1.0, "deg/s"),
        pictures._largest(finding, record),
        pictures._level(finding, record),
        pictures._correlation(state, state),
    ]
    for one in compared:
        assert 10 <= one.x.size <= MOST_POINTS / 2  # the outline of a band has two points for each


# ------------------------------------------------------------------------------------------------ the page as a text


class Page(HTMLParser):
    """Tags with their attributes, in order, and the text outside style sheets."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag in self.open:
            while self.open.pop() != tag:
                pass

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.text += data

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@dataclass
class Case:
    """A diagnosed recording: document, record, what the loop found, and the page."""

    document: dict[str, Any]
    record: Record
    found: dict[str, Diagnosed]
    text: str


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Half an hour at 2 Hz: gx follows the temperature and jumps, gy is clean."""
    random = np.random.default_rng(11)
    n, rate = 3600, 2.0
    temperature = 25.0 + 4.0 * np.sin(np.arange(n) / 300.0)
    gx = 0.05 * random.standard_normal(n) + 0.05 * (temperature - 25.0) + 0.2 * (np.arange(n) > 2500)
    gy = 0.05 * random.standard_normal(n)
    path = tmp_path_factory.mktemp("page") / "made here.csv"
    rows = np.column_stack([np.arange(n) / rate, gx, gy, temperature])
    np.savetxt(path, rows, delimiter=",", fmt="%.9g", header="t[s],gx[deg/s],gy[deg/s],temp[degC]", comments="")
    recording = load(path)
    record = record_from(recording, Model.load(None))
    found = diagnose_record(record, ("gx", "gy"))
    document = diagnose_document(recording, found, {}, {"name": "extended"})
    add_findings(document, recording, found, {}, None)
    return Case(document, record, found, diagnosis_html(document, record, found))


def test_the_findings_stand_at_the_top(case: Case) -> None:
    """What is said first: the verdict on each axis, and a row an event or source, linked to its box. Evidence stands in
    the boxes alone."""
    assert {one["cause"] for one in case.document["findings"] if one["material"]} == {"temperature", "step"}
    parsed = Page(case.text)
    top = parsed.text[: parsed.text.index("Whole record")]
    top = top[: top.index("GainNot found") if "GainNot found" in top else len(top)]
    assert "Not adequate: gx." in top and "Adequate: gy." in top
    first = top[: top.index("Readings of each axis")]
    assert "nats" not in first and "in round" not in first
    heads, *rows = cells_of(case.text, "What matters")
    assert heads == ["row", "from", "what", "size", "without it", "do"] and [row[0] for row in rows] == ["1", "2"]
    for row, finding in zip(rows, case.document["findings"], strict=False):
        assert row[2].startswith(f"{finding['cause']} on gx") and row[5]
    pictures_of = [one["aria-label"] or "" for one in parsed.named("svg") if one.get("role") == "img"]
    assert any(label.startswith("Before: standard deviations") and "outside" in label for label in pictures_of)
    step = next(place for place, one in enumerate(case.document["findings"], 1) if one["cause"] == "step")
    strip = next(label for label in pictures_of if label.startswith("Readings and events: gx, gy; marks at"))
    assert re.search(rf"125\d s \({step}\)", strip)  # the step is at sample 2500 of 2 Hz
    assert f"Without a mark, as no time is known or they act all along: {3 - step}." in parsed.text


def cells_of(text: str, name: str) -> list[list[str]]:
    """The rows of the table of this name, as texts."""
    table = re.search(rf'aria-label="{name}"><table>(.*?)</table>', text, re.DOTALL)
    assert table is not None, name
    rows = re.findall(r"<tr>(.*?)</tr>", table[1], re.DOTALL)
    return [[re.sub("<[^>]*>", "", one) for one in re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row)] for row in rows]


def an_estimate(median: float, unit: str) -> dict[str, Any]:
    return {"median": median, "q05": 0.9 * median, "q95": 1.1 * median, "unit": unit, "identified": True}


def test_causes_by_axis_and_the_noise_stand_at_the_top(case: Case) -> None:
    """The matrix has the document's causes, the table its posterior; without one, the fit that the record is made of:
    white noise of 0.05 deg/s at 2 Hz."""
    known = {
        "hypotheses": {"constant": 0.2, "random_walk": 0.8},
        "parameters": {
            "random_walk": {"N": an_estimate(0.035, "deg/s/sqrt(Hz)"), "K": an_estimate(0.002, "deg/s^2/sqrt(Hz)")},
            "constant": {"N": an_estimate(9.0, "deg/s/sqrt(Hz)")},
        },
    }
    axes = case.document["axes"]
    text = diagnosis_html(
        {**case.document, "axes": {**axes, "gx": {**axes["gx"], "posterior": known}}}, case.record, case.found
    )
    heads, *rows = cells_of(text, "Causes by axis")
    assert heads == ["cause", "gx", "gy"]
    shown = {row[0].replace(" ", "_"): row[1:] for row in rows}
    assert shown.keys() == {one["cause"] for one in axes["gx"]["findings"]}
    for cause, (sign, other) in shown.items():
        assert sign == ("●" if cause in axes["gx"]["material"] else "○") and other == "–"
    gx, gy = cells_of(text, "N, K and B before and after")[1:]
    before, after = (axes["gx"]["numbers"]["N"][key] for key in ("before", "after"))
    assert gx[1].startswith(f"{before:.3g} → {after['median']:.3g} °/s/√Hz") and gy[0] == "gy"
    gx, gy = cells_of(text, "Noise of each axis")[1:]
    assert gx[:3] == ["gx", "random walk", "0.8"] and gx[3].startswith("0.035 (0.0315 to 0.0385) °/s/√Hz")
    assert gx[4].startswith("0.002 (0.0018 to 0.0022)") and gx[5] == "–" and gx[6].endswith("points outside")
    assert gy[2] == "fit" and float(gy[3].split()[0]) == pytest.approx(0.05 / math.sqrt(2.0), rel=0.05)


def test_small_findings_are_folded_whatever_their_evidence(case: Case) -> None:
    """In the list and in the axis' section; what matters is not, however little evidence it has beside another."""
    entry, (event, *_) = case.document["axes"]["gx"], case.document["findings"]
    nats = {"strong": 5000.0, "near": 51.0, "weak": 9.0}
    findings, events = [], []
    for name, gain in nats.items():
        own = {"cause": name, "record_next": f"Mend the {name} one.", "evidence_nats": gain}
        sizes = {"axes": {"gx": {"estimate": {}, "probability": 1.0}}, "estimate": {}}
        events.append({**event, **own, **sizes, "id": name, "material": name != "strong"})
        box = {"of": name, "words": f"A {name} one.", "evidence_gain_nats": gain, "net_nats": gain}
        findings.append({**entry["findings"][0], **own, **box})
    axis = {**entry, "findings": findings, "material": ["near", "weak"]}
    text = diagnosis_html({**case.document, "findings": events, "axes": {"gx": axis}}, case.record, case.found)
    folded = "".join(re.findall(r"<details.*?</details>", text[: text.index("Whole record")], re.DOTALL))
    for name in nats:
        assert (f"A {name} one." in folded) == (f"Mend the {name} one.</td>" in folded) == (name == "strong")
        assert f"Mend the {name} one.</td>" in text
    assert [row[2].split()[0] for row in cells_of(text, "What matters")[1:]] == ["near", "weak"]


def test_an_allan_curve_that_still_leaves_its_band_is_told(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "The Allan curve still leaves its band" not in case.text
    assert "leaves its band" not in "".join(cell for row in cells_of(case.text, "Noise of each axis") for cell in row)
    made = pictures.figures

    def lifted(*arguments: Any) -> Any:
        overview, own = made(*arguments)
        shifted = []
        for figure in overview:
            panel = figure.panels[-1]
            higher = replace(panel, curves=[replace(panel.curves[0], y=3.0 * panel.curves[0].y), *panel.curves[1:]])
            is_it = figure.name == "Allan deviation"
            shifted.append(replace(figure, panels=[*figure.panels[:-1], higher]) if is_it else figure)
        return shifted, own

    monkeypatch.setattr(pictures, "figures", lifted)
    text = diagnosis_html(case.document, case.record, case.found)
    assert text.count("The Allan curve still leaves its band") == 2
    assert [row[6].startswith("✗ leaves its band: ") for row in cells_of(text, "Noise of each axis")[1:]] == [True] * 2


def test_every_part_of_the_page_is_there(case: Case) -> None:
    text = Page(case.text).text
    for heading in (
        "What naming the causes gains",
        "Looked for and not found",
        "Reproduce it",
        "How to read this page",
    ):
        assert heading in text
    assert "selfcal diagnose '" in text and "made here.csv' --report report.html" in text
    for row in case.document["axes"]["gy"]["not_found"]:
        assert named(row["cause"]) in text


def test_the_commands_on_the_page_reproduce_it(tmp_path: Path) -> None:
    """As they stand there, options and all: a foreign header, counts, no time stamps. The first repeats the result."""
    random = np.random.default_rng(4)
    counts = np.rint(
        2.0 * random.standard_normal((30_000, 2)) + 3.0 * (np.arange(30_000) > 17_000)[:, None] * [1.0, 0.0]
    )
    np.savetxt(tmp_path / "raw.csv", counts, delimiter=",", fmt="%d", header="rate x[LSB],ry[LSB]", comments="")
    read = ["--column", "gx=rate x", "--column", "gy=ry", "--scale", "0.05[deg/s]", "--rate", "100"]
    given = ["raw.csv", "--axis", "gx", *read, "--decimate", "10"]
    done = run("diagnose", *given, "--report", "page.html", "--json", "first.json", cwd=tmp_path)
    assert done.returncode == 0, done
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    found = re.search(r'<pre [^>]*aria-label="Commands"[^>]*><code>(.*?)</code>', text, re.DOTALL)
    assert found is not None
    commands = [shlex.split(line) for line in html.unescape(found[1]).splitlines()]
    assert [command[:2] for command in commands] == [
        ["selfcal", verb] for verb in ("diagnose", "simulate", "diagnose", "identify")
    ]
    for command in commands:
        done = run(*command[1:], cwd=tmp_path)
        assert done.returncode == 0, done
    assert json.loads((tmp_path / "report.json").read_text()) == json.loads((tmp_path / "first.json").read_text())


def test_the_same_diagnosis_makes_the_same_page(case: Case) -> None:
    assert diagnosis_html(case.document, case.record, case.found) == case.text


def test_the_page_is_well_built(case: Case) -> None:
    """Headings step down one at a time; ids are unique and links lead to one; tables and pictures are named."""
    parsed = Page(case.text)
    levels = [int(tag[1]) for tag, _ in parsed.tags if tag in ("h1", "h2", "h3", "h4")]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after - before <= 1 for before, after in pairwise(levels))
    ids = [attributes["id"] for _, attributes in parsed.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert all((link["href"] or "")[1:] in ids for link in parsed.named("a"))
    assert all(cell.get("scope") in ("col", "row", "colgroup") for cell in parsed.named("th"))
    assert all(one.get("aria-label") or one.get("aria-hidden") == "true" for one in parsed.named("svg"))
    # A table behind every figure.
    assert len(parsed.named("figure")) > 5
    assert len(parsed.named("details")) >= len(parsed.named("figure"))


def test_the_page_loads_nothing(case: Case) -> None:
    parsed = Page(case.text)
    names = {tag for tag, _ in parsed.tags}
    assert not names & {"script", "img", "link", "iframe", "object", "embed", "image", "use", "base"}
    for _, attributes in parsed.tags:
        assert "src" not in attributes and not any(name.startswith("on") for name in attributes)
    assert "url(" not in case.text and "@import" not in case.text


def test_text_from_files_runs_nothing(case: Case) -> None:
    """A path, axis, unit, cause or sentence that holds HTML is shown as it is written."""
    document: dict[str, Any] = {**case.document, "recording": {**case.document["recording"], "path": HOSTILE}}
    entry = {**case.document["axes"]["gx"], "unit": "deg/s", "verdict": HOSTILE}
    first = {**entry["findings"][0], "cause": HOSTILE, "words": HOSTILE, "record_next": HOSTILE, "gain": None}
    first |= {"gain_reason": HOSTILE, "also_possible": [HOSTILE], "shared_with": [HOSTILE], "inflation_words": HOSTILE}
    first |= {"estimate": {HOSTILE: HOSTILE}, "inflation": {HOSTILE: 2.0}}
    entry["findings"] = [first, *entry["findings"][1:]]
    entry["not_found"] = [{"cause": HOSTILE, "would_have_been_found": {HOSTILE: {"value": 1.0, "unit": HOSTILE}}}]
    document |= {"axes": {HOSTILE: entry}, "model": {HOSTILE: HOSTILE}}
    parsed = Page(diagnosis_html(document, case.record, {HOSTILE: case.found["gx"]}))
    assert not parsed.named("script") and not parsed.named("img")
    assert not any(name.startswith("on") for _, attributes in parsed.tags for name in attributes)
    assert parsed.text.count(HOSTILE) > 8
    ids = [attributes["id"] or "" for _, attributes in parsed.tags if "id" in attributes]
    assert not any(set(one) & set("<>&\"' ") for one in ids)


def test_keys_that_the_document_lacks_are_left_out(case: Case) -> None:
    entry = case.document["axes"]["gx"]
    few = ("cause", "evidence_gain_nats", "estimate", "also_possible")
    lean = {"unit": entry["unit"], "verdict": entry["verdict"], "discrepancies": []}
    lean["findings"] = [{key: one[key] for key in few} for one in entry["findings"]]
    document = {key: value for key, value in case.document.items() if key != "model"} | {"axes": {"gx": lean}}
    text = Page(diagnosis_html(document, case.record, case.found)).text
    assert "temperature" in text and "None" not in text and "nan" not in text.lower().split()


def test_an_axis_without_a_result_is_told(case: Case) -> None:
    document = {**case.document, "axes": {**case.document["axes"], "gz": {"error": "every reading is the same"}}}
    text = Page(diagnosis_html(document, case.record, case.found)).text
    assert "Not diagnosed: gz. every reading is the same" in text and "Not adequate: gx." in text


def test_a_page_with_many_findings_stays_small(case: Case) -> None:
    """Ten findings on each of six axes: pictures of the weakest are left out, their words stay."""
    one = case.found["gx"]
    entry = case.document["axes"]["gx"]
    step_found = next(finding for finding in one.findings if finding.look.cause == "step")
    step_told = next(finding for finding in entry["findings"] if finding["cause"] == "step")
    many = Diagnosed(one.first, one.state, one.record, [step_found] * 10, one.before, one.after)
    findings = [{**step_told, "shared_with": [], "words": f"Finding {k}."} for k in range(10)]
    names = ("gx", "gy", "gz", "ax", "ay", "az")
    document = {**case.document, "axes": {name: {**entry, "findings": findings} for name in names}}
    text = diagnosis_html(document, case.record, dict.fromkeys(names, many))
    assert 900_000 < len(text.encode()) <= 1_000_000
    assert "left out to keep the page small" in text
    assert all(text.count(f"<p>Finding {k}.</p>") == 6 for k in range(10))


def test_the_page_is_written_whole_or_not_at_all(case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "report.html"
    write_text(path, diagnosis_html(case.document, case.record, case.found))
    assert path.read_text(encoding="utf-8") == case.text
    with pytest.raises(UserError, match="cannot be written"):
        write_text(tmp_path / "none" / "report.html", diagnosis_html(case.document, case.record, case.found))

    def full(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(UserError, match="No space left"):
        write_text(path, diagnosis_html(case.document, case.record, case.found))
    assert [one.name for one in tmp_path.iterdir()] == ["report.html"]
    assert path.read_text(encoding="utf-8") == case.text


def test_a_figure_of_nothing_but_gaps_draws() -> None:
    nothing = np.full(5, np.nan)
    panel = Panel("t", "x", "y", [Curve("c", np.arange(5.0), nothing)], [Band("b", np.arange(5.0), nothing, nothing)])
    for log in (False, True):
        assert "<figure>" in chart.draw(Figure("f", "c", [replace(panel, log_x=log, log_y=log)]))


# ------------------------------------------------------------------------------------------------------ in a browser


@pytest.fixture(scope="module")
def address(case: Case, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("browser") / "report.html"
    path.write_text(case.text, encoding="utf-8")
    return path.as_uri()


@pytest.mark.parametrize("width", [390, 1280])
def test_a_browser_shows_it(browser: Any, address: str, width: int) -> None:
    """No message, no request beside the file itself, no sideways scrolling, text of 9 px or more in the pictures."""
    view = browser.new_page(viewport={"width": width, "height": 900})
    told: list[str] = []
    asked: list[str] = []
    view.on("console", lambda message: told.append(message.text))
    view.on("pageerror", lambda error: told.append(str(error)))
    view.on("request", lambda request: asked.append(request.url))
    view.goto(address)
    view.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert told == [] and asked == [address]
    assert view.evaluate("document.documentElement.scrollWidth") <= width
    size = (
        "[...document.querySelectorAll('figure svg[role=img]')]"
        ".map(s => 12.5 * s.getBoundingClientRect().width / s.viewBox.baseVal.width)"
    )
    assert min(view.evaluate(size)) >= 9.0
    assert view.locator(".events tbody tr").count() >= 2
    view.close()


@pytest.mark.parametrize(("width", "height"), [(1400, 900), (390, 844)])
def test_the_answer_is_on_the_first_screen(browser: Any, case: Case, tmp_path: Path, width: int, height: int) -> None:
    """Six axes with three events: verdict and list; on a desk N, K and B of all axes as well."""
    names = ("gx", "gy", "gz", "ax", "ay", "az")
    event = case.document["findings"][0]
    events = [{**event, "id": kind, "axes": dict.fromkeys(names, event["axes"]["gx"])} for kind in ("a", "b", "c")]
    document = {**case.document, "findings": events, "axes": dict.fromkeys(names, case.document["axes"]["gx"])}
    text = diagnosis_html(document, case.record, dict.fromkeys(names, case.found["gx"]))
    (tmp_path / "report.html").write_text(text, encoding="utf-8")
    view = browser.new_page(viewport={"width": width, "height": height})
    view.goto((tmp_path / "report.html").as_uri())
    for place in (".bad", ".events", *([".numbers"] if width > 1000 else [])):
        box = view.locator(place).first.bounding_box()
        assert box["y"] + box["height"] <= height, (place, box)
    assert view.evaluate("document.documentElement.scrollWidth") <= width
    view.close()


def test_the_keyboard_reaches_everything(browser: Any, address: str) -> None:
    view = browser.new_page(viewport={"width": 1280, "height": 900})
    view.goto(address)
    reached: list[str] = []
    for _ in range(400):
        view.keyboard.press("Tab")
        here = view.evaluate("document.activeElement.tagName + ' ' + document.activeElement.textContent.slice(0, 60)")
        if here.startswith("BODY"):
            break
        reached.append(here)
    assert reached[0] == "A Skip to the findings"
    summaries = view.locator("summary").count()
    assert sum(here.startswith("SUMMARY") for here in reached) == summaries > 5
    view.locator("summary").first.focus()
    assert not view.locator("details").first.evaluate("d => d.open")
    view.keyboard.press("Enter")
    assert view.locator("details").first.evaluate("d => d.open")
    view.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_fault(browser: Any, address: str, scheme: str) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="NO AXE-CORE (make setup-dev)")
    # The page's own policy lets no script in, axe-core's neither.
    view = browser.new_page(viewport={"width": 390, "height": 900}, color_scheme=scheme, bypass_csp=True)
    view.goto(address)
    view.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    result = axe.Axe().run(view)
    assert len(result.response["passes"]) > 10
    assert [(fault["id"], fault["nodes"][0]["html"]) for fault in result.response["violations"]] == []
    view.close()


@pytest.mark.parametrize("log_x", [True, False])
def test_a_limit_far_from_the_data_is_drawn_at_its_value(log_x: bool) -> None:
    """A histogram over a factor of 45 or a range, its limit three times beyond. Truth: places between the ticks."""
    x = np.geomspace(0.02, 0.9, 9) if log_x else np.linspace(-1.0, 1.0, 9)
    limit = 2.7 if log_x else 5.3
    panel = Panel("K", "deg/s", "units", [Curve("units", x, np.arange(9.0))], log_x=log_x, marks=[limit], stairs=True)
    drawn = chart.draw(Figure("K", "nine units", [panel]))
    (mark,) = (float(at) for at in re.findall(rf"class=mark d='M([\d.]+) {chart.TOP}V", drawn))
    ticks = [
        (float(at), float(text.replace("−", "-").replace(",", "")))
        for at, text in re.findall(r"class=tick x=([\d.]+) y=\d+ text-anchor=(?:middle|end)>([^<]*)<", drawn)
        if re.fullmatch(r"[−\d.e]+", text)
    ]
    places, values = np.array(ticks).T
    slope, start = np.polyfit(np.log(values) if log_x else values, places, 1)
    assert abs(slope * (np.log(limit) if log_x else limit) + start - mark) < 0.5  # printed to a tenth
