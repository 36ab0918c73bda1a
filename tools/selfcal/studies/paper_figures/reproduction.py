"""A figure of the page, with what the paper says of it and what was seen here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from selfcal.show.chart import Figure


@dataclass(frozen=True)
class Reproduction:
    """`verdict`: agrees, differs, or skipped; `why` a difference, or what makes the figure worth looking at."""

    name: str
    figures: Figure | Sequence[Figure]
    paper: str
    here: str
    verdict: str
    why: str = ""
