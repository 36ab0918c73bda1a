"""Texts out of Jinja2 templates of C, whose values are not escaped."""

from __future__ import annotations

from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined


def of_code(folder: Path) -> Environment:
    """Templates of C in a folder. A value is `<< value >>`: braces are C's."""
    return Environment(
        loader=FileSystemLoader(folder),
        variable_start_string="<<",
        variable_end_string=">>",
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
