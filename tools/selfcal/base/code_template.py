"""Texts out of Jinja2 templates of C, whose values are not escaped."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined


def of_code(folder: Path) -> Environment:
    """Templates of C in a folder. A value is `<< value >>`: braces are C's. Filter `f`: a float32."""
    made = Environment(
        loader=FileSystemLoader(folder),
        variable_start_string="<<",
        variable_end_string=">>",
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["f"] = _literal
    return made


def _literal(value: float) -> str:
    """A literal that reads back as the float32 nearest to `value`, which the package's builds take."""
    if math.isinf(value):
        return "INFINITY"
    text = f"{value:.9g}"
    if np.float32(text) != np.float32(value):  # rounded twice
        text = f"{np.float32(value):.9g}"
    return f"{text}{'' if any(c in text for c in '.en') else '.0'}F"
