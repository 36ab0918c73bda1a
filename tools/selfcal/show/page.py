"""The page of `selfcal diagnose --report`: one file that loads nothing, with pictures and the tables behind them."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import yaml

import selfcal
from selfcal.base import units as unit_module
from selfcal.base.ending import Stopped
from selfcal.base.output import write_text
from selfcal.base.units import parameter_unit
from selfcal.diagnosis import words
from selfcal.diagnosis.events import UNEXPLAINED, parted, times_of
from selfcal.diagnosis.extend import fitted_law
from selfcal.diagnosis.finding import Diagnosed, Finding
from selfcal.diagnosis.record import Record
from selfcal.show import pictures
from selfcal.show.chart import Band, Curve, Figure, Panel, draw, envelope, number, outside_of, scrolled, strips
from selfcal.show.findings import before_after, noisier_of

#: Bytes of the page without its style, at most.
SIZE_MOST = 990_000
LEFT_OUT = "<p>This picture is left out to keep the page small: ask for this axis alone with <code>--axis</code>.</p>"
#: Name of the figure that decides whether the Allan curve leaves its band, and the share of its points from which on it
#: does. Each point of a fitting record lies outside the range of 20 with a probability of 2/21, and neighbours do so
#: together: of 400 fitting records one had more than this share outside, nine more than a quarter.
ALLAN, ALLAN_OUTSIDE = "Allan deviation", 0.35

STYLE = """
:root{color-scheme:light dark;--paper:#fff;--ink:#1b1f24;--soft:#555e68;--rule:#ccd2d9;--card:#f5f7f9;--blue:#0b4f9e;
--band:#e9b44c;--edge:#7a5200;--bad:#9b1c1c;--good:#1b6533;--fit:#9b1c6b}
@media(prefers-color-scheme:dark){:root{--paper:#14171a;--ink:#e8eaed;--soft:#aab3bd;--rule:#3d454e;--card:#1e2328;
--blue:#7db7ff;--band:#7a5b16;--edge:#e5bd62;--bad:#ff9d94;--good:#86d8a0;--fit:#ff9bdc}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,sans-serif}
header,main,footer{max-width:1180px;margin:0 auto;padding:0 16px}
h1{font-size:1.7rem;line-height:1.2;margin:1.2rem 0 .4rem;overflow-wrap:anywhere}
h2{font-size:1.35rem;margin:2.4rem 0 .6rem;padding-top:.5rem;border-top:2px solid var(--rule)}
h3{font-size:1.1rem;margin:1.6rem 0 .4rem}
h4{font-size:1rem;margin:1rem 0 .3rem}
p{margin:.4rem 0;max-width:75ch}
a{color:var(--blue)}
a:focus-visible,summary:focus-visible,.scroll:focus-visible,pre:focus-visible{outline:3px solid var(--blue);
outline-offset:2px}
.skip{position:absolute;left:-999px}.skip:focus{left:8px;top:8px;background:var(--paper);padding:8px}
.soft{color:var(--soft)}
.bad,.good{font-weight:700}.bad{color:var(--bad)}.good{color:var(--good)}
nav ul,.findings{padding-left:1.2rem}nav ul{display:flex;flex-wrap:wrap;gap:.2rem 1.5rem;list-style:none;padding:0}
.findings li{margin:.5rem 0;max-width:85ch}
.finding{background:var(--card);border:1px solid var(--rule);border-radius:8px;padding:.2rem 16px 12px;margin:1rem 0}
.finding h3{margin-top:.8rem}
dl{display:grid;grid-template-columns:minmax(8rem,max-content) 1fr;gap:.2rem 1rem;margin:.6rem 0}
dt{color:var(--soft)}dd{margin:0;overflow-wrap:anywhere}
figure{margin:.8rem 0;min-width:0}
.panels{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,290px),1fr));gap:.5rem 1rem;max-width:860px}
.strips svg{width:100%;min-width:680px;max-width:1000px;height:auto;display:block}
.events td:nth-child(n+3){min-width:11rem}
.panels svg{width:100%;max-width:420px;height:auto;display:block}
@media(min-width:1150px){figure{display:grid;grid-template-columns:minmax(0,3fr) minmax(0,1fr);gap:0 1.2rem}
figure details{grid-column:1/-1}.key{display:block;white-space:normal;margin:.4rem 0 0}figcaption{padding-top:1.6rem}}
svg text{fill:var(--ink);font-size:12.5px;font-family:inherit}
svg .name{font-weight:700;font-size:13.5px}
svg .tick{fill:var(--soft)}
path{fill:none;vector-effect:non-scaling-stroke}
.grid{stroke:var(--rule);stroke-width:1}
.measured{stroke:var(--blue);stroke-width:1.8}
.fitted{stroke:var(--fit);stroke-width:2.6;stroke-dasharray:7 4}
.dots{fill:var(--blue)}
.simulated{fill:var(--band);fill-opacity:.45;stroke:var(--edge);stroke-width:1;stroke-dasharray:3 2}
.spread{fill:var(--soft);fill-opacity:.3}
.mark{stroke:var(--ink);stroke-width:1.2;stroke-dasharray:1 3}
figcaption{font-size:.88rem;color:var(--soft)}
.key{white-space:nowrap;margin-left:.7rem;color:var(--ink)}
.key svg{width:28px;height:16px;vertical-align:-3px;margin-right:.3rem}
details{margin:.4rem 0}summary{cursor:pointer;padding:.25rem 0;font-size:.92rem}
.scroll{overflow-x:auto;max-width:100%;margin:.4rem 0}
table{border-collapse:collapse;font-size:.88rem;font-variant-numeric:tabular-nums}
caption{text-align:left;color:var(--soft);padding:.2rem 0}
caption span{display:inline-block;position:sticky;left:0;max-width:min(75ch,82vw)}
th,td{border-bottom:1px solid var(--rule);padding:.25rem .7rem .25rem 0;text-align:left;vertical-align:top}
thead th{border-bottom-width:2px}
@media(max-width:600px){main>section>.scroll td{min-width:7.5rem}}
.glance table{font-size:.85rem}.glance th,.glance td{padding:.12rem .8rem .12rem 0;white-space:nowrap}
main>section>.glance td{min-width:0}.matrix caption{white-space:nowrap}
.matrix td,.matrix thead th+th{text-align:right;min-width:2.6rem!important}
@media(max-width:600px){h1{font-size:1.3rem;margin:.6rem 0 .2rem}h2{margin:1rem 0 .3rem}.glance table{font-size:.8rem}
.glance th,.glance td{padding-right:.55rem}
.matrix th,.matrix td{padding-right:.3rem}.matrix td,.matrix thead th+th{min-width:2.1rem!important}}
@media(max-width:600px){.events thead{display:none}.events td,.events th,.events tr{display:block;border:0}
.events tr{border-bottom:1px solid var(--rule);padding:.3rem 0}.events td,.events th{padding:0}}
summary h3{display:inline}
pre{overflow-x:auto;background:var(--card);border:1px solid var(--rule);padding:10px;font-size:.85rem}
code{font-size:.92em;overflow-wrap:anywhere}
@media(max-width:600px){dl{grid-template-columns:1fr;gap:0}dd{margin-bottom:.4rem}.finding{padding:.2rem 10px 10px}}
@media print{details{display:none}}
"""


#: Options of the command line and their values, each as often as it was given.
Options = Sequence[tuple[str, str]]


def write_page(
    path: Path | str, document: Mapping[str, Any], record: Record, found: Mapping[str, Diagnosed], options: Options = ()
) -> None:
    """Write page() to `path`, whole or not at all. Raises UserError if it cannot be written."""
    write_text(path, page(document, record, found, options))


def page(document: Mapping[str, Any], record: Record, found: Mapping[str, Diagnosed], options: Options = ()) -> str:
    """The page. Numbers and words are the document's (selfcal.diagnose/1); pictures are made from `record` and `found`.
    `options`: how the recording was read and looked at, for the commands that reproduce it.

    The same arguments give the same page: the simulated records of the bands have a fixed seed."""
    name = Path(str(document["recording"]["path"])).name
    body = _body(document, record, found, options)
    head = "".join(_head(document, record, name))
    return frame(f"Diagnosis of {name}", "findings", "Skip to the findings", head, body)


def frame(title: str, first: str, skip: str, head: str, body: Sequence[str]) -> str:
    """A page around `head` and `body`, HTML. `skip`: the link to the part whose id is `first`."""
    parts = [
        "<!DOCTYPE html><html lang=en><head><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width,initial-scale=1'>",
        # No request is made whatever a file's text holds.
        "<meta http-equiv=Content-Security-Policy content=\"default-src 'none';style-src 'unsafe-inline'\">",
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>",
        f"<a class=skip href='#{first}'>{skip}</a>",
        head,
        "<main>",
        *body,
        "</main>",
        *_foot(),
        "</body></html>",
    ]
    return "".join(parts)


def _body(document: Mapping[str, Any], record: Record, found: Mapping[str, Diagnosed], options: Options) -> list[str]:
    axes = {axis: entry for axis, entry in document["axes"].items() if "error" not in entry}
    failed = {axis: str(entry["error"]) for axis, entry in document["axes"].items() if "error" in entry}
    sections: list[list[_Part]] = []
    allan: dict[str, tuple[int, int]] = {}
    for k, (axis, entry) in enumerate(axes.items()):
        unit = str(entry["unit"])
        one = found[axis]
        overview: Sequence[Figure]
        own: Sequence[Sequence[Figure]]
        try:
            overview, own = pictures.figures(one, one.record, unit_module.factor(one.state.unit, unit), unit)
        except Stopped:
            overview, own = [], [[] for _ in one.findings]
        allan[axis] = _allan_after(overview)
        sections.append(list(_axis(k, axis, entry, one, overview, own, allan[axis])))
    rest = [*_gains(axes), *_not_found(axes), *_reproduce(document, options), *_reading()]
    parts = [_Part(text) for text in (*_summary(document, axes, failed, found, allan), *_contents(axes))]
    parts += [part for section in sections for part in section]
    parts += [_Part(text) for text in rest]
    return _within(parts, SIZE_MOST)


@dataclass(frozen=True)
class _Part:
    """A piece of HTML. `nats`: the evidence of the finding that it pictures; infinite for what the page must have."""

    text: str
    nats: float = math.inf


def _within(parts: Sequence[_Part], most: int) -> list[str]:
    """The texts, without pictures of the weakest findings if they would go beyond `most` bytes."""
    size = sum(len(part.text.encode(errors="backslashreplace")) for part in parts)
    dropped: set[int] = set()
    for k in sorted(range(len(parts)), key=lambda k: parts[k].nats):
        if size <= most or math.isinf(parts[k].nats):
            break
        size -= len(parts[k].text.encode()) - len(LEFT_OUT)
        dropped.add(k)
    return [LEFT_OUT if k in dropped else part.text for k, part in enumerate(parts)]


def _head(document: Mapping[str, Any], record: Record, name: str) -> Iterator[str]:
    recording = document["recording"]
    means = f", looked at as means at {number(record.rate_hz)} Hz" if _decimated(document, record) else ""
    yield f"<header><h1>Diagnosis of {escape(name)}</h1>"
    yield (
        f"<p class=soft>{recording['samples']} samples at {number(recording['rate_hz'])} Hz, "
        f"{number(recording['duration_s'])} s{means}; axes {escape(', '.join(document['axes']))}</p></header>"
    )


def _decimated(document: Mapping[str, Any], record: Record) -> bool:
    return record.rate_hz < 0.999 * float(document["recording"]["rate_hz"])


def verdict_of(entry: Mapping[str, Any]) -> str:
    """With a sign beside the colour."""
    verdict = escape(words.verdict(entry))
    if entry["verdict"] != "adequate":
        return f"<span class=bad>✗ {verdict}</span>"
    return f"<strong>{verdict}</strong>" if entry.get("unfinished") else f"<span class=good>✓ {verdict}</span>"


def cause_name(cause: str) -> str:
    """As the page has it."""
    return escape(cause.replace("_", " "))


def _allan_after(figures: Sequence[Figure]) -> tuple[int, int]:
    """Points of the Allan curve outside the band of the model as it ends, and points in all."""
    for figure in figures:
        if figure.name == ALLAN:
            panel = figure.panels[-1]
            return outside_of(panel.curves[0], panel.bands[0])
    return 0, 0


def _leaves(allan: tuple[int, int]) -> bool:
    return allan[0] > ALLAN_OUTSIDE * allan[1]


def _summary(
    document: Mapping[str, Any],
    axes: Mapping[str, Mapping[str, Any]],
    failed: Mapping[str, str],
    found: Mapping[str, Diagnosed],
    allan: Mapping[str, tuple[int, int]],
) -> Iterator[str]:
    bad = [name for name, entry in axes.items() if entry["verdict"] != "adequate"]
    begun = [name for name in axes if name not in bad and axes[name].get("unfinished")]
    good = [name for name in axes if name not in (*bad, *begun)]
    yield "<section aria-labelledby=findings><h2 id=findings>What was found</h2>"
    if bad:
        yield (
            f"<p><span class=bad>✗ Not adequate: {escape(', '.join(bad))}.</span> "
            "What was found changes N, K, B or the bias, or has no name.</p>"
        )
    if good:
        yield (
            f"<p><span class=good>✓ Adequate: {escape(', '.join(good))}.</span> "
            "Nothing found there changes N, K, B or the bias by as much as matters.</p>"
        )
    if begun:
        yield f"<p><strong>Not finished: {escape(', '.join(begun))}.</strong> Nothing was found so far.</p>"
    for axis, error in failed.items():
        yield f"<p><strong>Not diagnosed: {escape(axis)}.</strong> {escape(error)}</p>"
    findings = document.get("findings") or []
    shown, less = parted(findings)
    if shown:
        yield _events("What matters", "One row an event or source, the largest change first.", shown, axes)
    if less:
        yield f"<details><summary>{escape(words.small(less))}</summary>"
        yield f"{_events('Small findings', 'One row an event or source.', less, axes)}</details>"
    if axes:
        yield _numbers(axes)
        yield "".join(f"<p>{escape(line)}.</p>" for line in noisier_of(axes))
        yield _readings(shown, axes, found)
        yield _matrix(axes)
        yield _noise(axes, found, allan)
    yield from (_box(one) for one in findings if _stands_alone(one, axes))
    yield "</section>"


def _stands_alone(finding: Mapping[str, Any], axes: Mapping[str, Mapping[str, Any]]) -> bool:
    """Whether no axis has a box of it."""
    return all(each["cause"] != finding["cause"] for axis in axes.values() for each in axis["findings"])


def _box(finding: Mapping[str, Any]) -> str:
    """A finding that has no box with an axis."""
    facts = "".join(
        f"<dt>{escape(axis)}</dt><dd>{escape(words.sizes(one['estimate']))}</dd>"
        for axis, one in finding["axes"].items()
    )
    nats = f"{_whole(finding['evidence_nats'])} nats, {_whole(finding['net_nats'])} net of the search"
    return (
        f"<div class=finding><h3 id='{_id(finding['id'], 0)}'>{cause_name(finding['cause'])}</h3>"
        f"<p>{escape(finding['words'])}</p><dl>{facts}<dt>Evidence</dt><dd>{nats}</dd></dl></div>"
    )


def _events(
    name: str, caption: str, findings: Sequence[Mapping[str, Any]], axes: Mapping[str, Mapping[str, Any]]
) -> str:
    """Findings of all axes: what, where from, the size, what it changes and what to do; linked to their boxes."""
    rows = ""
    for place, finding in enumerate(findings, 1):
        boxes: dict[str, int] = {}
        for axis, entry in axes.items():
            for k, each in enumerate(entry["findings"]):
                if each.get("of") == finding["id"]:
                    boxes.setdefault(axis, k)
        links = [f"<a href='#{_id(axis, k)}'>{escape(axis)}</a>" for axis, k in boxes.items()]
        links += [f"<a href='#{_id(finding['id'], 0)}'>all</a>"] if _stands_alone(finding, axes) else []
        cells = (
            escape(finding["source"]),
            f"{escape(unit_module.typeset(words.what(finding)))} <span class=soft>({' '.join(links)})</span>",
            escape(unit_module.typeset(words.how_much(finding))),
            escape(unit_module.typeset(words.effects(finding))),
            escape(words.action(finding)),
        )
        rows += f"<tr><th scope=row>{place}</th>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
    heads = "".join(f"<th scope=col>{head}</th>" for head in ("row", "from", "what", "size", "changes", "do"))
    return scrolled(name, caption, f"<thead><tr>{heads}</tr></thead><tbody>{rows}</tbody>", "events")


def _numbers(axes: Mapping[str, Mapping[str, Any]]) -> str:
    """N, K and B of each axis without its findings and with them."""
    rows = "".join(
        f"<tr><th scope=row>{escape(axis)}</th>"
        + "".join(f"<td>{escape(_with_unit(entry['numbers'][name]))}</td>" for name in ("N", "K", "B"))
        + "</tr>"
        for axis, entry in axes.items()
        if "numbers" in entry
    )
    heads = "".join(f"<th scope=col>{head}</th>" for head in ("axis", "N", "K", "B"))
    caption = "Without → with the findings: medians ± half of the 90 % interval. –: looked for, not identified."
    table = f"<thead><tr>{heads}</tr></thead><tbody>{rows}</tbody>"
    return scrolled("N, K and B before and after", caption, table.replace("-&gt;", "→"), "glance numbers")


def _with_unit(number: Mapping[str, Any]) -> str:
    return f"{before_after(number)} {unit_module.typeset(str(number['unit']))}"


def _readings(
    findings: Sequence[Mapping[str, Any]], axes: Mapping[str, Mapping[str, Any]], found: Mapping[str, Diagnosed]
) -> str:
    """The readings of all axes over one time, the events marked by their numbers in the list."""
    marks = [(time, str(place)) for place, one in enumerate(findings, 1) for time in times_of(one)]
    panels = []
    for axis, entry in axes.items():
        one = found[axis]
        factor = unit_module.factor(one.state.unit, str(entry["unit"]))
        x, mean, low, high = envelope(one.record.time_s + one.record.start_s, one.first.y, pictures.POINTS)
        band = Band("lowest to highest reading", x, factor * low, factor * high, "spread")
        unit = unit_module.typeset(str(entry["unit"]))
        panels.append(
            Panel(axis, "time, s", unit, [Curve("mean", x, factor * mean)], [band], marks=[m for m, _ in marks])
        )
    caption = "Readings of each axis about its level, each on its own scale. Numbers: the rows of the list."
    return strips(Figure("Readings and events", caption, panels), marks)


def _matrix(axes: Mapping[str, Mapping[str, Any]]) -> str:
    """Causes by axes: which matter, and which were looked for and not found; linked to the boxes."""
    places: dict[str, dict[str, int]] = {}
    for axis, entry in axes.items():
        for k, finding in enumerate(entry["findings"]):
            places.setdefault(str(finding["cause"]), {}).setdefault(axis, k)
    if not places:
        return ""

    def cell(cause: str, axis: str) -> str:
        if axis not in places[cause]:
            return "<td class=soft>–</td>"
        known = (*axes[axis].get("material", ()), UNEXPLAINED)
        sign = "●" if cause in known else "○"
        return f"<td><a href='#{_id(axis, places[cause][axis])}'>{sign}</a></td>"

    heads = "".join(f"<th scope=col>{escape(axis)}</th>" for axis in axes)
    body = "".join(
        f"<tr><th scope=row>{cause_name(cause)}</th>{''.join(cell(cause, axis) for axis in axes)}</tr>"
        for cause in places
    )
    table = f"<thead><tr><th scope=col>cause</th>{heads}</tr></thead><tbody>{body}</tbody>"
    caption = "●: it matters, or has no name. ○: small. –: looked for, not found."
    return scrolled("Causes by axis", caption, table, "glance matrix")


def _noise(
    axes: Mapping[str, Mapping[str, Any]], found: Mapping[str, Diagnosed], allan: Mapping[str, tuple[int, int]]
) -> str:
    """N, K and sigma_m of each axis under its likeliest law, beside the causes; the fit's where no report was made."""
    rows = []
    for axis, entry in axes.items():
        known = entry.get("posterior")
        if known and known.get("hypotheses"):
            law, share = max(known["hypotheses"].items(), key=lambda one: one[1] or 0.0)
            estimates = dict(known["parameters"].get(law, {}))
            probability = number(float(share), 3)
        else:
            law, estimates = _fitted(found[axis], str(entry["unit"]))
            probability = "fit"
        cells = f"<th scope=row>{escape(axis)}</th><td>{escape(law.replace('_', ' '))}</td><td>{probability}</td>"
        for name in ("N", "K", "sigma_m"):
            cells += f"<td>{interval(estimates.pop(name, None))}</td>"
        outside, total = allan[axis]
        sign = "<span class=bad>✗ leaves its band</span>: " if _leaves(allan[axis]) else ""
        cells += f"<td>{sign}{outside} of {total} points outside</td>" if total else "<td>–</td>"
        cells += f"<td>{'; '.join(f'{escape(name)} {interval(one)}' for name, one in estimates.items()) or '–'}</td>"
        rows.append(f"<tr>{cells}</tr>")
    heads = "".join(
        f"<th scope=col>{head}</th>"
        for head in ("axis", "law", "P", "N", "K", "sigma_m", "Allan curve, after", "other")
    )
    table = f"<thead><tr>{heads}</tr></thead><tbody>{''.join(rows)}</tbody>"
    caption = "Noise beside the causes, likeliest law: medians, 5 to 95 %."
    return scrolled("Noise of each axis", caption, table, "glance")


def _fitted(one: Diagnosed, unit: str) -> tuple[str, dict[str, dict[str, Any]]]:
    """The law of the diagnosis' own fit and its parameters in `unit`, without intervals."""
    law = fitted_law(one)
    factor = unit_module.factor(one.state.unit, unit)
    return str(law["hypothesis"]), {
        name: {"median": law[name] * (1.0 if name == "alpha" else factor), "unit": parameter_unit(name, unit)}
        for name in ("N", "K", "sigma_m", "alpha")
        if name in law
    }


def interval(one: Mapping[str, Any] | None) -> str:
    """A parameter with its 90 % interval, if it has one."""
    if not one or one.get("median") is None:
        return "–"
    limits = f" ({number(one['q05'], 3)} to {number(one['q95'], 3)})" if one.get("q05") is not None else ""
    sign = "" if one.get("identified", True) else "~"
    return f"{sign}{number(one['median'], 3)}{limits} {escape(unit_module.typeset(str(one['unit'])))}"


def _nats(finding: Mapping[str, Any]) -> float:
    value = finding["evidence_gain_nats"]
    return float(value) if value is not None else math.inf


def _whole(nats: float) -> str:
    return f"{nats:.0f}" if 100.0 <= nats < 1e7 else number(nats, 3)


def _id(axis: str, k: int) -> str:
    return f"f-{''.join(c if c.isalnum() else '-' for c in axis)}-{k + 1}"


def _quantity(key: str) -> str:
    """The name of an estimate without its unit, which stands with the number."""
    return key.removesuffix("_hz").removesuffix("_s").replace("_", " ")


def _contents(axes: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    yield "<nav aria-label='On this page'><ul>"
    for k, (axis, entry) in enumerate(axes.items()):
        yield f"<li><a href='#axis-{k}'>{escape(axis)}</a> {verdict_of(entry)}</li>"
    for key, title in (("gain", "Gain"), ("not-found", "Not found"), ("again", "Reproduce"), ("read", "How to read")):
        yield f"<li><a href='#{key}'>{title}</a></li>"
    yield "</ul></nav>"


def _axis(
    place: int,
    axis: str,
    entry: Mapping[str, Any],
    one: Diagnosed,
    overview: Sequence[Figure],
    own: Sequence[Sequence[Figure]],
    allan: tuple[int, int],
) -> Iterator[_Part]:
    yield _Part(f"<section aria-labelledby=axis-{place}><h2 id=axis-{place}>{escape(axis)}: {verdict_of(entry)}</h2>")
    if entry.get("unfinished"):
        rate = number(entry["judged_at_hz"])
        yield _Part(f"<p><strong>Not finished.</strong> Judged at {rate} Hz; {escape(str(entry['unfinished']))}.</p>")
    if not overview:
        yield _Part("<p>There was no time left to draw its pictures.</p>")
    if _leaves(allan):
        yield _Part(
            f"<p><strong>The Allan curve still leaves its band</strong> with the findings in the model: {allan[0]} of "
            f"{allan[1]} points lie outside. The model does not describe these averaging times.</p>"
        )
    matter = (*entry.get("material", ()), UNEXPLAINED)
    for k, finding in enumerate(entry["findings"]):
        match = _match(finding, one.findings)
        shown = own[match] if match is not None else []
        yield from _finding(_id(axis, k), finding, shown, folded=finding["cause"] not in matter)
    yield _Part("<h3>Whole record, measured against simulated</h3>")
    for figure in overview:
        yield _Part(f"<h4>{escape(figure.name)}</h4>{draw(figure)}")
    yield _Part("".join(_statistics(entry, one)) + "</section>")


def _match(finding: Mapping[str, Any], candidates: Sequence[Finding]) -> int | None:
    """Which finding of the loop the document's is: same cause, nearest evidence."""
    same = [k for k, one in enumerate(candidates) if one.look.cause == finding["cause"]]
    if not same:
        return None
    return min(same, key=lambda k: abs(candidates[k].look.gain - _nats(finding)))


def _finding(key: str, finding: Mapping[str, Any], shown: Sequence[Figure], *, folded: bool) -> Iterator[_Part]:
    words = f"<p>{escape(str(finding['words']))}</p>" if finding.get("words") else ""
    facts = "".join(f"<dt>{name}</dt><dd>{text}</dd>" for name, text in _facts(finding))
    heading = f"<h3 id={key}>{cause_name(finding['cause'])}</h3>"
    begin = f"<details class=finding><summary>{heading}</summary>" if folded else f"<div class=finding>{heading}"
    yield _Part(f"{begin}{words}<dl>{facts}</dl>")
    for figure in shown:
        yield _Part(f"<h4>{escape(figure.name)}</h4>{draw(figure)}", min(_nats(finding), 1e300))
    yield _Part("</details>" if folded else "</div>")


def _facts(finding: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Name and text (HTML) of what is known of a finding."""
    yield "Size (half of the 90 % interval)", escape(words.sizes(finding["estimate"]))
    when = finding.get("when")
    if when:
        yield "When", f"{number(when[0], 6)} s" + ("" if when[0] == when[1] else f" to {number(when[1], 6)} s")
    yield "Evidence when found", words.evidence(finding, _whole)
    if finding.get("shared_with"):
        yield "One with", escape(", ".join(finding["shared_with"]))
    if finding.get("also_possible"):
        yield "It may also be", ", ".join(cause_name(cause) for cause in finding["also_possible"])
    if finding.get("record_next"):
        yield "To make sure", escape(str(finding["record_next"]))
    gain = finding.get("gain")
    if gain:
        yield "Held-out gain", f"{_score(gain)} nats a sample"
    elif finding.get("gain_reason"):
        yield "Held-out gain", f"none: {escape(str(finding['gain_reason']))}"
    for line in words.carried(finding):
        yield "On the second recording", escape(line)
    if finding.get("inflation_words"):
        yield "Inflation", escape(str(finding["inflation_words"]))


def _score(gain: Mapping[str, Any]) -> str:
    score = gain["log_score_per_sample"]
    return f"{_signed(score['after'] - score['before'])} ± {number(score['sd'], 2)}"


def _signed(value: float) -> str:
    return ("+" if value >= 0.0 else "") + number(value, 3)


def _statistics(entry: Mapping[str, Any], one: Diagnosed) -> Iterator[str]:
    """Every statistic before and after, those outside their band first."""
    if not one.before:
        return
    after = {row.name: row for row in one.after}
    rows = []
    outside = [0, 0]
    for row in sorted(one.before, key=lambda row: (row.q005 <= row.measured <= row.q995, row.p)):
        later = after.get(row.name)
        cells = f"<th scope=row>{escape(row.name.replace('_', ' '))}</th>"
        for side, this in enumerate((row, later)):
            if this is None:
                cells += "<td>–</td><td>–</td><td>–</td>"
                continue
            out = not this.q005 <= this.measured <= this.q995
            outside[side] += out
            sign = "<span class=bad>✗ outside</span>" if out else "inside"
            cells += f"<td>{number(this.measured, 3)}</td><td>{number(this.q005, 3)} to {number(this.q995, 3)}</td>"
            cells += f"<td>{sign}</td>"
        rows.append(f"<tr>{cells}</tr>")
    name = "Statistics of the residual innovations"
    yield (
        f"<h3>{name}</h3><p>{outside[0]} of {len(one.before)} lie outside their simulated band of 99 % before, "
        f"{outside[1]} of {len(one.after)} after. By chance about one in a hundred does.</p>"
    )
    sides = "".join(f"<th scope=colgroup colspan=3>{side}</th>" for side in ("Before", "After"))
    heads = "<th scope=col>measured</th><th scope=col>simulated</th><th scope=col>verdict</th>" * 2
    table = (
        f"<colgroup></colgroup><colgroup span=3></colgroup><colgroup span=3></colgroup>"
        f"<thead><tr><th scope=col rowspan=2>statistic</th>{sides}</tr><tr>{heads}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody>"
    )
    caption = "Before and after the findings are in the model. Simulated: 0.5 to 99.5 %."
    yield f"<details><summary>Table: {name}</summary>{scrolled(name, caption, table)}</details>"


def _gains(axes: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    yield "<section aria-labelledby=gain><h2 id=gain>What naming the causes gains</h2>"
    rows = [(axis, finding) for axis, entry in axes.items() for finding in entry["findings"]]
    if not rows:
        yield "<p>There is no finding, so there is no gain.</p></section>"
        return
    horizons: dict[str, None] = {}
    for _, finding in rows:
        for horizon in ((finding.get("gain") or {}).get("bias_rmse") or {}).get("horizon_s") or {}:
            horizons.setdefault(str(horizon))
    ahead = sorted(horizons, key=float)
    yield (
        "<p>Parameters come from the first part of the record. The score is of the later part, each sample predicted "
        "from earlier ones only. A gain above 0 is a better model.</p>"
    )
    heads = "".join(f"<th scope=col>bias error {escape(h)} s ahead, before → after</th>" for h in ahead)
    body = []
    for axis, finding in rows:
        cells = f"<th scope=row>{escape(axis)}: {cause_name(finding['cause'])}</th>"
        gain = finding.get("gain")
        if not gain:
            reason = escape(str(finding.get("gain_reason") or "not measured"))
            body.append(f"<tr>{cells}<td colspan={3 + len(ahead)}>none: {reason}</td></tr>")
            continue
        score = gain["log_score_per_sample"]
        cells += f"<td>{number(score['before'])}</td><td>{number(score['after'])}</td><td>{_score(gain)}</td>"
        errors = gain.get("bias_rmse") or {}
        unit = escape(str(errors.get("unit") or ""))
        for horizon in ahead:
            row = (errors.get("horizon_s") or {}).get(horizon)
            cells += (
                f"<td>{number(row['before'], 3)} → {number(row['after'], 3)} {unit}{_spread(row)}</td>"
                if row
                else "<td>–</td>"
            )
        body.append(f"<tr>{cells}</tr>")
    table = (
        "<thead><tr><th scope=col>finding</th><th scope=col>score before</th><th scope=col>score after</th>"
        f"<th scope=col>gain</th>{heads}</tr></thead><tbody>{''.join(body)}</tbody>"
    )
    caption = (
        "Log predictive score in nats a sample, and error of the predicted bias (root mean square), "
        "on time that the fit did not see. ±: one standard deviation."
    )
    yield scrolled("Held-out gain", caption, table)
    yield from _inflation(rows)
    yield "</section>"


def _spread(row: Mapping[str, Any]) -> str:
    return f" (change ± {number(row['sd'], 2)})" if row.get("sd") is not None else ""


def _inflation(rows: Sequence[tuple[str, Mapping[str, Any]]]) -> Iterator[str]:
    """By how much plain noise numbers are off."""
    told = [(axis, finding, finding["inflation"]) for axis, finding in rows if finding.get("inflation")]
    if not told:
        return
    keys: dict[str, None] = {}
    for _, _, factors in told:
        keys.update(dict.fromkeys(factors))
    yield "<h3>How far plain white noise and random walk numbers are off without the cause</h3>"
    heads = "".join(f"<th scope=col>{escape(key)} without / with</th>" for key in keys)
    body = "".join(
        f"<tr><th scope=row>{escape(axis)}: {cause_name(finding['cause'])}</th>"
        + "".join(f"<td>{_factor(factors.get(key))}</td>" for key in keys)
        + "</tr>"
        for axis, finding, factors in told
    )
    table = f"<thead><tr><th scope=col>finding</th>{heads}</tr></thead><tbody>{body}</tbody>"
    yield scrolled("Inflation", "Fitted without the cause, over the same fitted with it.", table)


def _factor(value: Any) -> str:
    if value is None or not math.isfinite(value):
        return "any factor"
    return f"{number(float(value), 3)} ×"


def _not_found(axes: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    yield "<section aria-labelledby=not-found><h2 id=not-found>Looked for and not found</h2>"
    sizes: dict[str, dict[str, str]] = {}
    for axis, entry in axes.items():
        for row in entry.get("not_found") or ():
            sizes.setdefault(str(row["cause"]), {})[axis] = _least(row.get("would_have_been_found") or {})
    if not sizes:
        yield "<p>No list came with this diagnosis.</p></section>"
        return
    yield "<p>A cause of this size or more would have been found here in about half of such records.</p>"
    heads = "".join(f"<th scope=col>{escape(axis)}</th>" for axis in axes)
    body = "".join(
        f"<tr><th scope=row>{cause_name(cause)}</th>"
        + "".join(f"<td>{escape(found.get(axis, 'found: see above'))}</td>" for axis in axes)
        + "</tr>"
        for cause, found in sizes.items()
    )
    table = f"<thead><tr><th scope=col>cause</th>{heads}</tr></thead><tbody>{body}</tbody>"
    caption = "Size that would have been found, by cause and axis."
    yield f"{scrolled('Looked for and not found', caption, table)}</section>"


def _least(size: Mapping[str, Any]) -> str:
    told = []
    for key, value in size.items():
        inner = value if isinstance(value, Mapping) else {"value": value}
        unit = "" if inner.get("unit") in (None, "1") else f" {inner['unit']}"
        size_of = inner.get("value", inner.get("median"))
        text = number(float(size_of), 3) if isinstance(size_of, int | float) else str(size_of)
        told.append(f"{_quantity(key)} {text}{unit}")
    return ", ".join(told)


def _reproduce(document: Mapping[str, Any], options: Options) -> Iterator[str]:
    def given(*left_out: str) -> str:
        wanted = [(name, value) for name, value in options if name not in left_out]
        return "".join(f" {name} {shlex.quote(value)}" if value else f" {name}" for name, value in wanted)

    recording = document["recording"]
    log = shlex.join(recording.get("paths", [recording["path"]]))
    # A simulated recording states all that.
    how_read = ("--rate", "--column", "--unit", "--scale", "--no-time", "--skip-bad")
    lines = [
        f"selfcal diagnose {log}{given()} --report report.html --json report.json --write-model extended.yaml",
        "selfcal simulate extended.yaml -o simulated.npz --seed 1",
        f"selfcal diagnose simulated.npz{given(*how_read)}",
        f"selfcal identify {log}{given('--model')} --model extended.yaml",
    ]
    yield "<section aria-labelledby=again><h2 id=again>Reproduce it</h2>"
    yield f"<p>With selfcal {escape(selfcal.__version__)}:</p>"
    yield f"<pre tabindex=0 aria-label=Commands role=group><code>{escape(chr(10).join(lines))}</code></pre>"
    if document.get("model"):
        plain = json.loads(json.dumps(document["model"], default=float))  # numpy's numbers too
        text = yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, width=100)
        yield "<details><summary>The extended model file</summary>"
        yield f"<pre tabindex=0 aria-label='Extended model file' role=group><code>{escape(text)}</code></pre></details>"
    yield "</section>"


def _reading() -> Iterator[str]:
    yield "<section aria-labelledby=read><h2 id=read>How to read this page</h2>"
    yield (
        f"<p>Each band is the range of {pictures.RECORDS} records that were simulated from the fitted model. They have "
        "the recording's own length, rate, gaps, lattice and limits. A model that fits leaves about one point in ten "
        "of a curve outside such a range.</p><p>Before: the model without the cause. After: the model with it. "
        "Residual innovations are the errors of predicting each sample from the earlier ones.</p>"
        "<p>P is the probability of the law under the model with the findings in it. ~ before a number: the record "
        "does not identify it. Fit: the most likely values without an interval, where no report was made.</p>"
        "<p>Evidence is in nats: 10 nats are odds of 22 000 to 1. Net of the search: less what the best of all the "
        "places looked at gains by chance.</p>"
    )
    yield (
        "<p>Spectra are two-sided densities, so that white noise shows its N. "
        "A curve has at most 400 points; a table shows every few of them.</p></section>"
    )


def _foot() -> Iterator[str]:
    yield f"<footer><p class=soft>Made by selfcal {escape(selfcal.__version__)}. This file loads nothing.</p></footer>"
