"""The page of `selfcal diagnose --report`: a file that loads nothing, with pictures and the tables behind them."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from markupsafe import Markup

from selfcal.base import units
from selfcal.base.ending import Stopped
from selfcal.diagnosis import words
from selfcal.diagnosis.events import parted, times_of
from selfcal.diagnosis.extend import fitted_law
from selfcal.diagnosis.finding import UNEXPLAINED, Diagnosed, Finding
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.response import RECORDS
from selfcal.diagnosis.statistics import Statistic
from selfcal.show import chart, pictures
from selfcal.show.chart import Band, Curve, Figure, Panel, draw, envelope, outside_of, strips
from selfcal.show.diagnosis_lines import before_after, notes
from selfcal.show.page_template import number, render

#: The line in place of a picture.
LEFT_OUT = Markup(
    "<p>This picture is left out to keep the page small: ask for this axis alone with <code>--axis</code>.</p>"
)
#: Name of the Allan figure, and the share of its points outside the band from which on the curve leaves it. Each point
#: of a fitting record is outside the range of 20 with a probability of 2/21, neighbours together: 1 of 400 fitting
#: records had more than this share outside, 9 more than a quarter.
ALLAN, ALLAN_OUTSIDE = "Allan deviation", 0.35

#: Options of the command line and their values, each as often as it was given.
Options = Sequence[tuple[str, str]]
Entry = Mapping[str, Any]


def diagnosis_html(document: Entry, record: Record, diagnosed: Mapping[str, Diagnosed], options: Options = ()) -> str:
    """The page. Numbers and words are the document's (selfcal.diagnose/1); pictures are made from `record` and
    `diagnosed`.
    `options`: how the recording was read and looked at, for the commands that reproduce it.

    The same arguments give the same page: the simulated records of the bands have a fixed seed."""
    recording = document["recording"]
    results = {name: entry for name, entry in document["axes"].items() if "error" not in entry}
    axes = [_axis(name, entry, diagnosed[name]) for name, entry in results.items()]
    findings = document.get("findings") or []
    shown, small = parted(findings)
    gains = [(axis.name, finding) for axis in axes for finding in axis.entry["findings"]]
    horizons = sorted({str(h): None for _, finding in gains for h in _horizons(finding)}, key=float)
    inflated = list({key: None for _, finding in gains for key in finding.get("inflation") or ()})
    values = {
        "document": document,
        "recording": recording,
        "name": Path(str(recording["path"])).name,
        "means_hz": record.rate_hz if record.rate_hz < 0.999 * float(recording["rate_hz"]) else None,
        "axes": axes,
        "names": list(results),
        "failed": {name: entry["error"] for name, entry in document["axes"].items() if "error" in entry},
        "sides": _sides(results),
        "shown": shown,
        "small": small,
        "alone": [
            finding for finding in findings if not any(axis.first_of(finding["cause"]) is not None for axis in axes)
        ],
        "boxes_of": lambda finding: [
            (axis.name, k) for axis in axes if (k := axis.first_of(finding["id"], "of")) is not None
        ],
        "notes": notes(results),
        "readings": _readings(shown, axes) if axes else "",
        "causes": list({str(finding["cause"]): None for _, finding in gains}),
        "gains": gains,
        "horizons": horizons,
        "gain_heads": [f"bias error {horizon} s ahead, before → after" for horizon in horizons],
        "inflated": inflated,
        "inflated_heads": [f"{key} without / with" for key in inflated],
        "not_found": _not_found(results),
        "log": shlex.join(recording.get("paths", [recording["path"]])),
        "given": partial(_given, options),
        "model": _model(document),
        "records": RECORDS,
        "id": lambda axis, k: f"f-{''.join(c if c.isalnum() else '-' for c in axis)}-{k + 1}",
        "whole": _whole,
        "gained": _gained,
        "factor": _factor,
        "outside": _outside,
        "LEFT_OUT": LEFT_OUT,
    }
    text = render("diagnosis.html", **values)
    # A page has 995 000 bytes at most.
    if _leave_out([picture for axis in axes for picture in axis.pictures], len(_bytes(text)) - 995_000):
        text = render("diagnosis.html", **values)
    return str(text)


@dataclass
class _Picture:
    """A figure as HTML. `nats`: the evidence of the finding that it shows; infinite for what the page must have."""

    name: str
    html: Markup
    nats: float = math.inf
    left_out: bool = False


@dataclass(frozen=True)
class _Box:
    """A finding of an axis with its pictures, folded if it is small."""

    finding: Entry
    pictures: Sequence[_Picture]
    folded: bool


@dataclass(frozen=True)
class _Axis:
    """An axis of the document: its `entry`, what the loop found, and its pictures. `outside` of `points` of its Allan
    curve lie outside the band of the model as it ends."""

    name: str
    entry: Entry
    diagnosed: Diagnosed
    overview: Sequence[_Picture]
    boxes: Sequence[_Box]
    outside: int
    points: int

    @property
    def pictures(self) -> list[_Picture]:
        return [*self.overview, *(picture for box in self.boxes for picture in box.pictures)]

    @property
    def leaves(self) -> bool:
        """Whether the Allan curve leaves its band."""
        return self.outside > ALLAN_OUTSIDE * self.points

    @property
    def numbers(self) -> list[str]:
        """N, K and B without the findings and with them."""
        numbers = [self.entry["numbers"][name] for name in ("N", "K", "B")]
        return [f"{before_after(entry).replace('->', '→')} {units.typeset(str(entry['unit']))}" for entry in numbers]

    @property
    def law(self) -> tuple[str, str, Mapping[str, Entry]]:
        """The likeliest law, its probability and its parameters; those of the fit where no report was made."""
        posterior = self.entry.get("posterior")
        if not posterior or not posterior.get("hypotheses"):
            return _fitted(self.diagnosed, str(self.entry["unit"]))
        law, share = max(posterior["hypotheses"].items(), key=lambda item: item[1] or 0.0)
        return law, number(float(share), 3), posterior["parameters"].get(law, {})

    @property
    def statistics(self) -> list[tuple[Statistic, Statistic | None]]:
        """Every statistic before and after, those outside their band first."""
        after = {statistic.name: statistic for statistic in self.diagnosed.after}
        ordered = sorted(self.diagnosed.before, key=lambda statistic: (not _outside(statistic), statistic.p))
        return [(statistic, after.get(statistic.name)) for statistic in ordered]

    @property
    def counts(self) -> list[int]:
        """Statistics outside their band and all, before and after."""
        sides = (self.diagnosed.before, self.diagnosed.after)
        return [count for side in sides for count in (sum(map(_outside, side)), len(side))]

    def matters(self, cause: str) -> bool:
        """Whether a cause changes a number by as much as matters, or has no name."""
        return cause in (*self.entry.get("material", ()), UNEXPLAINED)

    def first_of(self, value: str, key: str = "cause") -> int | None:
        """Place of the first box of a cause; with the key `of`, of a finding of all axes."""
        return next((k for k, finding in enumerate(self.entry["findings"]) if finding.get(key) == value), None)


def _axis(name: str, entry: Entry, diagnosed: Diagnosed) -> _Axis:
    unit = str(entry["unit"])
    overview: Sequence[Figure] = ()
    own: Sequence[Sequence[Figure]] = [()] * len(diagnosed.findings)
    with suppress(Stopped):
        overview, own = pictures.figures(diagnosed, diagnosed.record, units.factor(diagnosed.state.unit, unit), unit)
    panel = next((figure.panels[-1] for figure in overview if figure.name == ALLAN), None)
    outside, points = (0, 0) if panel is None else outside_of(panel.curves[0], panel.bands[0])
    boxes: list[_Box] = []
    axis = _Axis(
        name, entry, diagnosed, [_Picture(figure.name, draw(figure)) for figure in overview], boxes, outside, points
    )
    for finding in entry["findings"]:
        match = _match(finding, diagnosed.findings)
        figures = own[match] if match is not None else ()
        drawn = [_Picture(figure.name, draw(figure), min(_nats(finding), 1e300)) for figure in figures]
        boxes.append(_Box(finding, drawn, folded=not axis.matters(finding["cause"])))
    return axis


def _bytes(text: str) -> bytes:
    return text.encode(errors="backslashreplace")


def _leave_out(drawn: Sequence[_Picture], excess: int) -> bool:
    """Leave out pictures of the weakest findings that have `excess` bytes together; whether there are any."""
    for picture in sorted(drawn, key=lambda picture: picture.nats):
        if excess <= 0 or math.isinf(picture.nats):
            break
        picture.left_out = True
        excess -= len(_bytes(picture.html)) - len(LEFT_OUT)
    return any(picture.left_out for picture in drawn)


def _sides(results: Mapping[str, Entry]) -> tuple[list[str], list[str], list[str]]:
    """The axes that are not adequate, those that are, and those that are not finished."""
    bad = [name for name, entry in results.items() if entry["verdict"] != "adequate"]
    begun = [name for name in results if name not in bad and results[name].get("unfinished")]
    return bad, [name for name in results if name not in (*bad, *begun)], begun


def _readings(findings: Sequence[Entry], axes: Sequence[_Axis]) -> Markup:
    """The readings of all axes over a common time, the events marked by their numbers in the list."""
    marks = [(*times, str(row)) for row, finding in enumerate(findings, 1) for times in times_of(finding)]
    panels = []
    for axis in axes:
        unit, record, state = str(axis.entry["unit"]), axis.diagnosed.record, axis.diagnosed.first
        factor = units.factor(axis.diagnosed.state.unit, unit)
        x, mean, low, high = envelope(record.time_s + record.start_s, state.y, chart.POINTS_MOST)
        bands = [Band("lowest to highest reading", x, factor * low, factor * high, "spread")]
        bands += _moving(record, axis.name, factor, state.level)
        curve = Curve("mean", x, factor * mean)
        panels.append(
            Panel(axis.name, "time, s", units.typeset(unit), [curve], bands, marks=[time for time, *_ in marks])
        )
    caption = "Readings of each axis about its level, each on its own scale that rest fills: a shake is cut off at its "
    caption += "edges. Numbers: the rows of the list."
    unmarked = [str(row) for row, finding in enumerate(findings, 1) if not times_of(finding)]
    if unmarked:
        caption += f" Without a mark, as no time is known or they act all along: {', '.join(unmarked)}."
    return strips(Figure("Readings and events", caption, panels), marks)


def _moving(record: Record, name: str, factor: float, level: float) -> list[Band]:
    """The readings of an axis that were left out because the sensor moved; none where it rested."""
    read = record.readings.get(name)
    if read is None or not read.moving.any():
        return []
    values = np.where(read.moving, read.values - level, np.nan)
    x, _, low, high = envelope(read.recording.time_s + read.recording.start_s, values, chart.POINTS_MOST)
    return [Band("moving, left out", x, factor * low, factor * high, "moving")]


def _fitted(diagnosed: Diagnosed, unit: str) -> tuple[str, str, dict[str, Entry]]:
    """The law of the diagnosis' own fit and its parameters in `unit`, without intervals."""
    law = fitted_law(diagnosed)
    factor = units.factor(diagnosed.state.unit, unit)
    estimates: dict[str, Entry] = {
        name: {"median": law[name] * (1.0 if name == "alpha" else factor), "unit": units.parameter_unit(name, unit)}
        for name in ("N", "K", "sigma_m", "alpha")
        if name in law
    }
    return str(law["hypothesis"]), "fit", estimates


def _nats(finding: Entry) -> float:
    value = finding["evidence_gain_nats"]
    return float(value) if value is not None else math.inf


def _whole(nats: float) -> str:
    return f"{nats:.0f}" if 100.0 <= nats < 1e7 else number(nats, 3)


def _match(finding: Entry, candidates: Sequence[Finding]) -> int | None:
    """Which finding of the loop the document's is: same cause, nearest evidence."""
    same = [k for k, candidate in enumerate(candidates) if candidate.look.cause == finding["cause"]]
    return min(same, key=lambda k: abs(candidates[k].look.gain - _nats(finding)), default=None)


def _gained(gain: Entry) -> str:
    score = gain["log_score_per_sample"]
    more = score["after"] - score["before"]
    return f"{'+' if more >= 0.0 else ''}{number(more, 3)} ± {number(score['sd'], 2)}"


def _outside(statistic: Statistic) -> bool:
    return not statistic.q005 <= statistic.measured <= statistic.q995


def _horizons(finding: Entry) -> Mapping[str, Any]:
    """Error of the predicted bias by how far ahead it is, s; empty if it was not measured."""
    return ((finding.get("gain") or {}).get("bias_rmse") or {}).get("horizon_s") or {}


def _factor(value: Any) -> str:
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "any factor"
    return f"{number(float(value), 3)} ×"


def _not_found(results: Mapping[str, Entry]) -> dict[str, dict[str, str]]:
    """The size that would have been found, by cause and axis."""
    sizes: dict[str, dict[str, str]] = {}
    for name, entry in results.items():
        for row in entry.get("not_found") or ():
            least = (row.get("would_have_been_found") or {}).items()
            sizes.setdefault(str(row["cause"]), {})[name] = ", ".join(_least(key, value) for key, value in least)
    return sizes


def _least(key: str, value: Any) -> str:
    estimate = value if isinstance(value, Mapping) else {"value": value}
    unit = "" if estimate.get("unit") in (None, "1") else f" {estimate['unit']}"
    size = estimate.get("value", estimate.get("median"))
    text = number(float(size), 3) if isinstance(size, int | float) else str(size)
    return f"{words.named(key.removesuffix('_hz').removesuffix('_s'))} {text}{unit}"


def _given(options: Options, leave: Sequence[str] = ()) -> str:
    """Options as they are typed, but those to `leave`."""
    wanted = [(name, value) for name, value in options if name not in leave]
    return "".join(f" {name} {shlex.quote(value)}" if value else f" {name}" for name, value in wanted)


def _model(document: Entry) -> str:
    """The extended model file; else ""."""
    if not document.get("model"):
        return ""
    plain = json.loads(json.dumps(document["model"], default=float))  # numpy's numbers too
    return yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, width=100)
