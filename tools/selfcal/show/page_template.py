"""Pages out of the templates in `templates/`: every text is escaped, numbers and units are set alike."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

import selfcal
from selfcal.base.errors import printable
from selfcal.base.units import typeset
from selfcal.diagnosis import words
from selfcal.model.file import LONGEST_TEXT


def number(value: float, digits: int = 4) -> str:
    """Short and without a needless zero."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    text = f"{value:.{digits}g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}e{int(exponent)}"
    return text.replace("-", "−")


def interval(estimate: Mapping[str, Any] | None) -> str:
    """A parameter with its 90 % interval, if known."""
    if not estimate or estimate.get("median") is None:
        return "–"
    q05, q95 = estimate.get("q05"), estimate.get("q95")
    limits = f" ({number(q05, 3)} to {number(q95, 3)})" if q05 is not None and q95 is not None else ""
    sign = "" if estimate.get("identified", True) else "~"
    return f"{sign}{number(estimate['median'], 3)}{limits} {typeset(str(estimate['unit']))}"


def shortened(text: str) -> str:
    """A name or a reason from a file, on one line of at most LONGEST_TEXT letters."""
    shown = printable(text)
    return shown if len(shown) <= LONGEST_TEXT else f"{shown[:LONGEST_TEXT]}..."


@cache
def _environment() -> Environment:
    folder = FileSystemLoader(Path(__file__).parent / "templates")
    made = Environment(loader=folder, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    made.filters |= {function.__name__: function for function in (number, interval, shortened, typeset, words.named)}
    made.filters["tenth"] = "{:.1f}".format
    made.globals |= {"words": words, "version": selfcal.__version__}
    return made


def render(template: str, **values: Any) -> Markup:
    """The template of this name with `values`; HTML among them is Markup."""
    return Markup(_environment().get_template(template).render(values))
