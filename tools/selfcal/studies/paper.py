"""`selfcal paper`: the figures of Stepanov & Motorin (2017) made anew, on a page with the paper's words."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from selfcal.base.errors import few
from selfcal.base.output import console_of, print_line, table_of
from selfcal.show.chart import Figure, draw
from selfcal.show.page_template import render
from selfcal.studies.paper_figures import section4
from selfcal.studies.paper_figures.reproduction import Reproduction

#: Folder of the real recordings: next to the repository by default.
DATA = Path(os.environ.get("SELFCAL_DATA", Path(__file__).resolve().parents[4] / "shared" / "data"))
#: A look at the real records that explains a difference: this recording, by 1 s means.
EXPLAINED = "adis16405_run1.npz"


def with_reason(
    figures: Sequence[Reproduction], log: Path, diagnose: Callable[..., Mapping[str, Any]]
) -> list[Reproduction]:
    """The figures of the real records, Fig. 5 with the diagnosis of the record `log`."""
    entry = diagnose(log, axes=[section4.AXIS], decimate=1.0)["axes"][section4.AXIS]
    causes = [
        f"{finding['cause'].replace('_', ' ')} ({finding['evidence_gain_nats']:.0f} nats)"
        for finding in entry.get("findings", [])
    ]
    said = few(causes) or "nothing"
    why = f"The diagnosis of {log.name}, {section4.AXIS}, finds in 1 s means {said}, and neither law has these."
    return [
        replace(figure, why=why) if figure.verdict == "differs" and figure.name == "Fig. 5, real" else figure
        for figure in figures
    ]


def paper_html(figures: Sequence[Reproduction], records: int, seed: int) -> str:
    """A self-contained page: a table of all figures, then each with its pictures."""
    pictures = [[figure.figures] if isinstance(figure.figures, Figure) else figure.figures for figure in figures]
    drawn = [[draw(picture) for picture in own] for own in pictures]
    return str(render("paper.html", figures=list(zip(figures, drawn, strict=True)), records=records, seed=seed))


def show(figures: Sequence[Reproduction], output: Path | str) -> None:
    """A line a figure, and the place of the page."""
    console = console_of()
    table = table_of(("figure", "here", ""), wraps=True)
    for figure in figures:
        table.add_row(figure.name, figure.here, figure.verdict)
    console.width = max(console.width, 100)
    console.print(table)
    print_line(console, f"page: {output}")
