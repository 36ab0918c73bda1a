"""`selfcal paper`: the figures of Stepanov & Motorin (2017) made anew, on one page beside the paper's words."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from selfcal.base.errors import printable
from selfcal.base.output import console_of
from selfcal.show.chart import Figure, draw
from selfcal.show.page import STYLE
from selfcal.studies.paper_figures import section4
from selfcal.studies.paper_figures.told import Told

#: Where the real recordings are looked for, beside the repository.
DATA = Path(os.environ.get("SELFCAL_DATA", Path(__file__).resolve().parents[4] / "shared" / "data"))
#: Causes of one recording that the page names.
MOST_CAUSES = 5
#: A look at the real records that explains a difference: this recording, by 1 s means.
EXPLAINED = "adis16405_run1.npz"


def with_reason(told: Sequence[Told], log: Path, diagnose: Callable[..., Mapping[str, Any]]) -> list[Told]:
    """The figures of the real records, Fig. 5 with what the diagnosis finds in one of them."""
    entry = diagnose(log, axes=[section4.AXIS], decimate=1.0)["axes"][section4.AXIS]
    causes = [
        f"{finding['cause'].replace('_', ' ')} ({finding['evidence_gain_nats']:.0f} nats)"
        for finding in entry.get("findings", [])
    ]
    more = f" and {len(causes) - MOST_CAUSES} more" if len(causes) > MOST_CAUSES else ""
    why = (
        f"The diagnosis of {log.name}, {section4.AXIS}, finds in 1 s means "
        f"{', '.join(causes[:MOST_CAUSES]) or 'nothing'}{more}, and neither law has these."
    )
    return [replace(one, why=why) if one.verdict == "differs" and one.name == "Fig. 5, real" else one for one in told]


def page(told: Sequence[Told], records: int, seed: int) -> str:
    """One self-contained page: a table of all figures, then each with its pictures."""
    rows = "".join(
        f"<tr><th scope=row><a href='#f{k}'>{escape(one.name)}</a></th><td>{escape(one.paper)}</td>"
        f"<td>{escape(one.here)}</td><td class={'good' if one.verdict == 'agrees' else 'bad'}>{one.verdict}</td></tr>"
        for k, one in enumerate(told)
    )
    head = "".join(f"<th scope=col>{name}</th>" for name in ("figure", "the paper", "here", "verdict"))
    sections = "".join(
        f"<section id=f{k}><h2>{escape(one.name)}</h2><dl><dt>The paper</dt><dd>{escape(one.paper)}</dd>"
        f"<dt>Here</dt><dd>{escape(one.here)}</dd>"
        f"<dt>Verdict</dt><dd class={'good' if one.verdict == 'agrees' else 'bad'}>{one.verdict}</dd>"
        + (f"<dt>Why</dt><dd>{escape(one.why)}</dd>" if one.why else "")
        + "</dl>"
        + "".join(draw(figure) for figure in ([one.figures] if isinstance(one.figures, Figure) else one.figures))
        + "</section>"
        for k, one in enumerate(told)
    )
    return (
        "<!DOCTYPE html><html lang=en><head><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width,initial-scale=1'>"
        "<meta http-equiv=Content-Security-Policy content=\"default-src 'none';style-src 'unsafe-inline'\">"
        f"<title>The paper's figures</title><style>{STYLE}</style></head><body>"
        "<header><h1>Stepanov &amp; Motorin (2017), made anew</h1>"
        "<p>O. A. Stepanov, A. V. Motorin, <cite>Problem-oriented approach to identification of sensor error models "
        "and its application to navigation data processing</cite>, IFAC-PapersOnLine 50-1 (2017) 2830–2835.</p>"
        f"<p class=soft>selfcal paper --records {records} --seed {seed}. The seeds were fixed beforehand. Every figure "
        "is shown whether it agrees or not.</p></header><main>"
        "<div class=scroll tabindex=0 role=group aria-label='All figures'><table>"
        f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
        f"{sections}</main></body></html>"
    )


def show(told: Sequence[Told], output: Path | str) -> None:
    """A line a figure, and the place of the page."""
    console = console_of()
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("figure", "here", ""):
        table.add_column(heading)
    for one in told:
        table.add_row(one.name, one.here, one.verdict)
    console.width = max(console.width, 100)
    console.print(table)
    console.print(printable(f"page: {output}"), highlight=False, markup=False, soft_wrap=True)
