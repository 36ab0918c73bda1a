"""The page of `selfcal compare --report`: what changed, every quantity by recording, and the Allan deviations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.base.output import write_text
from selfcal.base.units import typeset
from selfcal.show.chart import Band, Curve, Figure, Panel, draw, number, scrolled
from selfcal.show.page import cause_name, frame, interval, verdict_of

#: Characters that a picture's title has room for.
LONGEST_TITLE = 22
#: Allan deviations by axis and recording: the key `allan` of `selfcal.identify/1`.
Curves = Mapping[str, Mapping[str, Mapping[str, Any]]]


def write_page(path: Path | str, document: Mapping[str, Any], curves: Curves) -> None:
    """Write page() to `path`, whole or not at all. Raises UserError if it cannot be written."""
    write_text(path, page(document, curves))


def page(document: Mapping[str, Any], curves: Curves) -> str:
    """The page of a document `selfcal.compare/1`."""
    names = _short(document["recordings"])
    changes = {axis: entry["changes"] if isinstance(entry, Mapping) else entry for axis, entry in _axes(document)}
    title = f"Comparison of {' and '.join(names.values())}"
    head = (
        f"<header><h1>{escape(title)}</h1><p class=soft>{len(names)} recordings, each beside the one before it; "
        f"axes {escape(', '.join(changes))}</p></header>"
    )
    body = [*_changes(document, changes, names), *_verdicts(document, names)]
    for axis in changes:
        body += _axis(axis, document, changes[axis], curves.get(axis, {}), names)
    body += [*_reading(document)]
    return frame(title, "changes", "Skip to the changes", head, body)


def _axes(document: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return list(document["axes"].items())


def _short(recordings: Sequence[str]) -> dict[str, str]:
    """File names of the recordings; whole paths where two have one name."""
    short = [Path(one).name for one in recordings]
    return dict(zip(recordings, short if len(set(short)) == len(short) else recordings, strict=True))


def _changes(
    document: Mapping[str, Any], changes: Mapping[str, Sequence[Mapping[str, Any]]], names: Mapping[str, str]
) -> Iterator[str]:
    """What changed, the largest distance first; and the axes that could not be compared."""
    yield "<section aria-labelledby=changes><h2 id=changes>What changed</h2>"
    rows = [(axis, row) for axis, found in changes.items() for row in found]
    rows.sort(key=lambda one: -abs(one[1].get("distance_sd", np.inf)))
    if rows:
        cells = "".join(
            f"<tr><th scope=row>{escape(axis)}</th><td>{escape(_quantity(row['quantity']))}</td>"
            f"<td>{_value(row, 'before')}</td><td>{_value(row, 'after')}</td>"
            f"<td>{escape(typeset(row.get('unit', '')))}</td><td>{_distance(row)}</td>"
            f"<td>{escape(names[row['from']])} → {escape(names[row['to']])}</td></tr>"
            for axis, row in rows
        )
        heads = "".join(
            f"<th scope=col>{head}</th>"
            for head in ("axis", "quantity", "before", "after", "unit", "sd apart", "recordings")
        )
        table = f"<thead><tr>{heads}</tr></thead><tbody>{cells}</tbody>"
        yield scrolled("Changes", "Changes beyond what the recordings leave open.", table, "glance")
    else:
        yield "<p><span class=good>✓ Nothing changed beyond what the recordings leave open.</span></p>"
    for axis, entry in _axes(document):
        if isinstance(entry, Mapping):
            yield f"<p><span class=bad>✗ {escape(axis)} not compared:</span> {escape(entry['error'])}</p>"
    yield "</section>"


def _quantity(key: str) -> str:
    return key.replace("_", " ")


def _value(row: Mapping[str, Any], side: str) -> str:
    if row["what"] == "changed":
        return number(row[side], 5)
    return "found" if (row["what"] == "appeared") == (side == "after") else "–"


def _distance(row: Mapping[str, Any]) -> str:
    return f"{row['distance_sd']:+.1f}".replace("-", "−") if "distance_sd" in row else ""


def _verdicts(document: Mapping[str, Any], names: Mapping[str, str]) -> Iterator[str]:
    """Verdict and causes of each axis in each recording."""
    axes = [axis for axis, _ in _axes(document)]
    rows = ""
    for log, name in names.items():
        cells = ""
        for axis in axes:
            one = document["verdicts"].get(log, {}).get(axis)
            if one is None:
                cells += "<td>–</td>"
            elif "error" in one:
                cells += f"<td>{escape(str(one['error']))}</td>"
            else:
                told = [cause for cause in one["causes"] if cause in (*one["material"], "unexplained")]
                less = len(one["causes"]) - len(told)
                causes = ", ".join([*map(cause_name, told), *([f"{less} small"] if less else [])])
                cells += f"<td>{verdict_of(one)}{f': {causes}' if causes else ''}</td>"
        rows += f"<tr><th scope=row>{escape(name)}</th>{cells}</tr>"
    heads = "".join(f"<th scope=col>{escape(head)}</th>" for head in ("recording", *axes))
    table = f"<thead><tr>{heads}</tr></thead><tbody>{rows}</tbody>"
    yield "<section aria-labelledby=verdicts><h2 id=verdicts>Each recording by itself</h2>"
    yield scrolled("Verdicts", "Verdict of selfcal diagnose, and the causes that it found.", table)
    yield "</section>"


def _axis(
    axis: str,
    document: Mapping[str, Any],
    changes: Sequence[Mapping[str, Any]],
    curves: Mapping[str, Mapping[str, Any]],
    names: Mapping[str, str],
) -> Iterator[str]:
    """Every quantity of an axis by recording, and the Allan deviations on one scale."""
    found = {log: document["quantities"].get(log, {}).get(axis, {}) for log in names}
    keys = list(dict.fromkeys(key for one in found.values() for key in one))
    changed = {row["quantity"] for row in changes}
    yield f"<section aria-labelledby=axis-{escape(axis)}><h2 id=axis-{escape(axis)}>{escape(axis)}</h2>"
    rows = "".join(
        f"<tr><th scope=row>{'<span class=bad>✗</span> ' if key in changed else ''}{escape(_quantity(key))}</th>"
        + "".join(f"<td>{_cell(one.get(key))}</td>" for one in found.values())
        + "</tr>"
        for key in keys
    )
    heads = "".join(f"<th scope=col>{escape(head)}</th>" for head in ("quantity", *names.values()))
    caption = "Medians, 5 to 95 %, of the likeliest law and of each cause found. ✗: it changed."
    yield scrolled(f"Quantities of {axis}", caption, f"<thead><tr>{heads}</tr></thead><tbody>{rows}</tbody>", "glance")
    panels = [
        Panel(
            names[log] if len(names[log]) <= LONGEST_TITLE else f"{names[log][: LONGEST_TITLE - 1]}…",
            "averaging time, s",
            f"deviation, {typeset(one['unit'])}",
            curves=[Curve("recording", np.array(one["tau_s"]), np.array(one["recording"]))],
            bands=[
                Band("law, 5 to 95 %", np.array(one["tau_s"]), np.array(one["model_q05"]), np.array(one["model_q95"]))
            ],
            log_x=True,
            log_y=True,
        )
        for log, one in curves.items()
        if len(one["tau_s"]) > 1
    ]
    if panels and len({panel.y_label for panel in panels}) == 1:
        caption = "Each recording's Allan deviation beside the band of its likeliest law, all on one scale."
        yield draw(Figure(f"Allan deviation of {axis}", caption, panels))
    yield "</section>"


def _cell(one: Mapping[str, Any] | None) -> str:
    return "found" if one and "present" in one else interval(one)


def _reading(document: Mapping[str, Any]) -> Iterator[str]:
    yield "<section aria-labelledby=read><h2 id=read>How to read this page</h2>"
    yield (
        f"<p>A quantity changed when its two values lie {number(document['limit_sd'])} standard deviations apart or "
        "more: both intervals count. By chance one in 1600 does. A cause that only one of two recordings has is found "
        "there.</p></section>"
    )
