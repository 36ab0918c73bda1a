"""How the text reads: `python tests/count_words.py [FILE ...]` counts generic verbs and nouns "what" in 1000 words.

Text is the prose of pages (without code and tables), comments of C, and docstrings and comments of Python. A generic
verb hides what happens: tell, say, stand, take, hold, go, rest, bear. "what" counts as a noun where no question or verb
of asking comes before it. The counts compare one state of the tree with another; a single hit can be right.
"""

from __future__ import annotations

import io
import re
import sys
import tokenize
from collections.abc import Iterable
from pathlib import Path

from count_house import ROOT, tracked

GENERIC = re.compile(
    r"\b(tell|tells|told|telling|say|says|said|saying|stand|stands|stood|standing|take|takes|took|taken|taking"
    r"|hold|holds|held|holding|go|goes|went|gone|going|rest|rests|rested|bear|bears|bore|borne)\b",
    re.IGNORECASE,
)
#: The rest of a module is a noun of this field: "at rest", "a rest", "the rest".
REST = re.compile(r"\b(at|a|an|the|each|every|of|after|during|to) rest\b", re.IGNORECASE)
WHAT = re.compile(r"(?<!\bask )(?<!\bsee )(?<!\bknow )\bwhat\b(?! (?:is|to) \w+\?)", re.IGNORECASE)
_C_COMMENT = re.compile(r"/\*(.*?)\*/|//([^\n]*)", re.DOTALL)


def prose_of_page(text: str) -> str:
    """Without fenced and indented blocks, tables and inline code."""
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    lines = [line for line in text.splitlines() if not line.startswith(("    ", "|", "<"))]
    return re.sub(r"`[^`]*`", "x", "\n".join(lines))


def prose_of_python(text: str) -> str:
    """Comments and docstrings."""
    found = []
    before = tokenize.NEWLINE
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        docstring = token.type == tokenize.STRING and before in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
        if token.type == tokenize.COMMENT or docstring:
            found.append(token.string.strip("#\"' "))
        if token.type not in (tokenize.COMMENT, tokenize.NL):
            before = token.type
    return "\n".join(found)


def prose(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return prose_of_page(text)
    if path.suffix == ".py":
        return prose_of_python(text)
    return "\n".join(a or b for a, b in _C_COMMENT.findall(text))


def count(texts: Iterable[str]) -> tuple[int, int, int]:
    """Words, generic verbs, and "what" as a noun."""
    words = verbs = nouns = 0
    for text in texts:
        words += len(re.findall(r"[A-Za-z][A-Za-z'-]*", text))
        verbs += len(GENERIC.findall(REST.sub("", text)))
        nouns += len(WHAT.findall(text))
    return words, verbs, nouns


def main() -> None:
    files = [Path(name) for name in sys.argv[1:]] or tracked([".md", ".c", ".h", ".cpp", ".hpp", ".py"])
    rooms: dict[str, list[Path]] = {}
    for path in files:
        absolute = path.resolve()
        inside = absolute.relative_to(ROOT) if absolute.is_relative_to(ROOT) else path
        room = str(inside) if len(sys.argv) > 1 or len(inside.parts) == 1 else inside.parts[0] + f"/*{path.suffix}"
        rooms.setdefault(room, []).append(path)
    print(f"{'':28}{'words':>8}{'generic verbs':>16}{'what':>8}   per 1000 words")
    for room, paths in [*sorted(rooms.items()), ("all", files)]:
        words, verbs, nouns = count(prose(path) for path in paths)
        per = 1000.0 / max(words, 1)
        print(f"{room:28}{words:8}{verbs * per:16.1f}{nouns * per:8.1f}")


if __name__ == "__main__":
    main()
