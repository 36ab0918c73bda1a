"""The only error type users see, and how text of unknown origin is shown."""

from __future__ import annotations

import re
import reprlib
import shlex
import shutil
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path

#: Most devices, or sources, that a line or a list names.
MOST_NAMED = 20
_SHOWN = reprlib.Repr()
_SHOWN.maxlevel, _SHOWN.maxstring, _SHOWN.maxother = 2, 40, 40
_SHOWN.maxlist = _SHOWN.maxtuple = _SHOWN.maxset = _SHOWN.maxdict = 3


class UserError(Exception):
    """Something the user can put right. Its text is one line; the command prints it and ends with exit code 2."""


class OutsidePriors(UserError):
    """No law of the model has any evidence on an axis. `rest.py` gives the reason, a line for all these axes."""

    def __init__(self) -> None:
        super().__init__("the record lies outside the model's priors")


def printable(text: str) -> str:
    """`text` with every character that a terminal would obey, or cannot show, as its escape: `\\x1b`, `\\ud800`."""
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii") for letter in text
    )


def remark(text: str) -> str:
    """`text` from outside, for a comment in an output: one line that ends no comment and no text of any form.

    The forms are `#` to the line's end, `/* */`, `<!-- -->` and a DBC file's `"..."`.
    """
    apart = re.sub(r"\*(?=/)|/(?=\*)|-(?=-)", r"\g<0> ", printable(text))
    apart = apart.replace('"', "'")
    return f"{apart} " if apart.endswith("\\") else apart


#: Place where a spreadsheet begins a formula: the first sign of a cell, or the first after a semicolon. Some programs
#: skip blanks, and take the wide forms of the signs.
_FORMULA = re.compile(r"(^\s*|;)(?=[=+\-@\uff1d\uff0b\uff0d\uff20])")


def cell(text: str) -> str:
    """`text` from outside, for a cell of a CSV: one line that no spreadsheet takes for a formula."""
    return _FORMULA.sub(r"\1'", printable(text))


def short(text: str, most: int = 60) -> str:
    """At most `most` printable characters of something found in a file."""
    clean = "".join(letter if letter.isprintable() else "?" for letter in text[: most + 1])
    return clean if len(clean) <= most else clean[: most - 3] + "..."


def few(names: Sequence[str], most: int = 5, more: str = "more") -> str:
    """The first of the names, and how many more there are."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} {more}" if rest > 0 else "")


def short_value(value: object) -> str:
    """A short form of any value that a file holds: never long, never an exception."""
    try:
        return printable(_SHOWN.repr(value))
    except ValueError:  # an integer of thousands of digits
        return f"a {type(value).__name__}"


def install_line(what: str) -> str:
    """The line to type for a package that is not installed with this package: its name, or `selfcal[extra]`."""
    return f"{shlex.quote(sys.executable)} -m pip install {shlex.quote(what)}"


def called() -> str:
    """The command as the user called it, so that a printed line runs when it is pasted."""
    name = sys.argv[0]
    module = {"cli.py": "selfcal.cli", "__main__.py": "selfcal"}.get(Path(name).name)
    if module is not None:
        return f"{shlex.quote(sys.executable)} -m {module}"
    if Path(name).name != "selfcal" or shutil.which("selfcal") == name:
        return "selfcal"
    return printable(shlex.quote(name))


#: Keywords of options, by what they take: pairs, a list, a number; others take nothing.
_KEYWORDS = {
    **{"unit": ("units", "pairs"), "column": ("columns", "pairs"), "scale": ("scale", "pairs")},
    **{"source": ("sources", "list"), "axis": ("axes", "list")},
    **{"rate": ("rate_hz", "number"), "start": ("start_s", "number"), "end": ("end_s", "number")},
    **{name: (name.replace("-", "_"), "number") for name in ("decimate", "dbc", "model", "json")},
    **{name: (name.replace("-", "_"), "") for name in ("no-time", "skip-bad", "gate", "full-rate")},
}
_VALUE = r"'[^']*'|[A-Z\d][^ ,;]*|[^ ,;'-][^ ,;]*=[^ ,;]+"
_TYPED = re.compile(rf"--(?P<name>[a-z-]+)(?P<more>(?: (?:{_VALUE})(?: --(?P=name)(?= ))?)*)")


def in_python(text: str) -> str:
    """`text` with the keyword of a function in place of each option: `--unit gx=rad/s` is `units={'gx': 'rad/s'}`."""

    def keyword(match: re.Match[str]) -> str:
        name, kind = _KEYWORDS.get(match["name"], ("", ""))
        if not name:
            return match[0]
        given = [word.strip("'") for word in re.findall(_VALUE, match["more"])]
        if kind == "pairs":
            pairs = dict(word.partition("=")[::2] for word in given)
            shown_as = "({0[0]}, {1!r})" if name == "scale" else "{2!r}"  # a size and its unit
            entries = (
                f"{key!r}: " + shown_as.format(value.split("["), value.partition("[")[2].rstrip("]"), value)
                for key, value in pairs.items()
            )
            return f"{name}={{{', '.join(entries) or '...'}}}"
        if kind == "list":
            return f"{name}={given or '[...]'}"
        return f"{name}={(given or ['...'])[0]}" if kind else f"{name}=True{match['more']}"

    return _TYPED.sub(keyword, text)


def first_line(error: BaseException) -> str:
    """The first line of an exception's text, its kind where it has none."""
    return short(str(error).split("\n")[0]) or type(error).__name__


def note(text: str) -> None:
    """Print a note for the user on stderr."""
    print(f"selfcal: {printable(text)}", file=sys.stderr)


@cache
def say_once(text: str) -> None:
    """Print a note once a process."""
    if text:
        note(text)
