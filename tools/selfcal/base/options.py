"""Options of the command line, each annotated on the parameter that it sets: `axes: Annotated[..., option(...)]`.

`cli.py` reads them. Nothing here imports the library that parses a command line: a verb is a plain function as well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from inspect import Parameter
from typing import Any

from selfcal.base.errors import UserError

#: Default of an option that must be typed, although the function has a default.
REQUIRED = Parameter.empty
#: Size of one LSB, with its unit unless the column's usual one is meant.
Scale = tuple[float, str | None]


@dataclass(frozen=True)
class Option:
    """An option, or an argument without a name.

    `names`: as they are typed; by default the parameter's own with `--`. `kind`: the type that is parsed, by default
    the parameter's own. `made` turns what was parsed into what the parameter takes. `more`: further settings of
    `typer.Option` or `typer.Argument`.
    """

    help: str = ""
    names: tuple[str, ...] = ()
    metavar: str | None = None
    kind: Any = None
    made: Callable[[Any], Any] | None = None
    argument: bool = False
    more: dict[str, Any] = field(default_factory=dict)


def option(
    help: str, *names: str, metavar: str | None = None, kind: Any = None, made: Any = None, **more: Any
) -> Option:
    """An option of the command line."""
    return Option(help, names, metavar, kind, made, False, more)


def argument(help: str, metavar: str, *, kind: Any = None, **more: Any) -> Option:
    """An argument of the command line."""
    return Option(help, (), metavar, kind, None, True, {"show_default": False, **more})


def parse_pairs(option: str, pairs: Sequence[str]) -> dict[str, str]:
    """`NAME=VALUE` texts of a repeated command line option as a dict. Raises UserError naming the option."""
    options: dict[str, str] = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not (name and equals and value):
            raise UserError(f"{option} takes NAME=VALUE, not '{pair}'")
        if name in options:
            raise UserError(f"{option}: '{name}' is given twice")
        options[name] = value
    return options
