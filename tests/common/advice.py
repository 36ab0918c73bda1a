"""The options that a line of the command says to type."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping

#: Options without a value.
SWITCHES = ("--no-time", "--skip-bad", "--full-rate", "--gate", "--no-suspicion")
#: What ends an option or a value in a sentence.
_ENDS = ",;:.)"


def advised(text: str, known: Mapping[str, str] | None = None) -> list[str]:
    """Every option in a text and its value, in the text's order, as a shell would split them. `known`: what the reader
    of the text puts for a word in capitals, such as HZ or SIZE, by the word."""
    words = re.findall(r"(?:'[^']*'|[^\s'])+", text)
    typed: list[str] = []
    for word, after in zip(words, [*words[1:], ""], strict=True):
        name = word.strip("`(")
        if not name.startswith("--"):
            continue
        typed.append(name.rstrip(_ENDS))
        if typed[-1] not in SWITCHES:
            (value,) = shlex.split(after.rstrip(_ENDS))
            for capitals, meant in (known or {}).items():
                value = re.sub(rf"\b{capitals}\b", meant, value)
            typed.append(value)
    return typed
