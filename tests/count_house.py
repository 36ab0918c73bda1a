"""House rules that are counted: `python tests/count_house.py` prints what breaks them. Called by `make check`.

Lines of at most 120 columns; in `lib/`, without the generated files: few conditional lines of the preprocessor, no
circle among its files (`uses`), no function above 80 lines, no two static functions of one name. In `port/app` and
`port/sensors`: no circle, and few conditional lines. In `tools/selfcal` a folder imports those before it in `STAGES`
alone, files import each other in no circle, a verb's file loads nothing heavy, and no body of a function, without its
docstring, is above 80 lines.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
COLUMNS = 120
#: `#if`, `#ifdef`, `#ifndef` and `#elif` in `lib/`, include guards among them.
CONDITIONALS = 45
#: The same in `port/app`, without include guards.
APP_CONDITIONALS = 25
FUNCTION = 80
#: Folders of `tools/selfcal`, each after those that it may import.
STAGES = (
    "base",
    "logs",
    "model",
    "readings",
    "bank",
    "likelihood",
    "adequacy",
    "calibration",
    "diagnosis",
    "wire",
    "show",
    "batch",
    "studies",
    "verbs",
)
#: Files beside those folders.
TOP = {"__init__.py", "__main__.py", "cli.py"}
#: What the head of a verb's file may import, so that `selfcal VERB --help` answers at once.
LIGHT = ("selfcal.base", "selfcal.logs.loaders", "selfcal.verbs._shared")
#: Files whose lines a person writes.
WRITTEN = (".c", ".h", ".cpp", ".hpp", ".py", ".pyi", ".mk", ".ld", ".txt", ".sh", ".md", "Makefile")
#: Made by programs.
GENERATED = ("lib/selfcal_frames.h", "lib/default/", "tools/requirements", "tests/long_")

_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_HEAD = re.compile(
    r"^(static )?(?:inline )?(?:const )?[a-z_0-9]+ \*?([a-z_0-9]+)\((?:[^;{}()]|\([^()]*\))*\)\s*\{", re.MULTILINE
)


def tracked(suffixes: Iterable[str]) -> list[Path]:
    """Files of the repository with these endings, without what is generated."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [
        ROOT / name
        for name in listed.splitlines()
        if name.endswith(tuple(suffixes)) and not name.startswith(GENERATED) and (ROOT / name).is_file()
    ]


def long_lines(files: Iterable[Path]) -> list[str]:
    """`file:line: columns` of every line above COLUMNS."""
    return [
        f"{path.relative_to(ROOT)}:{number}: {len(line)} columns"
        for path in files
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if len(line) > COLUMNS
    ]


def functions(text: str) -> list[tuple[str, bool, int]]:
    """Name, whether it is static, and lines of each function of a C file, from its head to the brace that ends it."""
    found = []
    for head in _HEAD.finditer(text):
        end = text.index("\n}", head.start())
        found.append((head[2], head[1] is not None, text.count("\n", head.start(), end) + 2))
    return found


def circle(edges: Mapping[str, set[str]]) -> list[str]:
    """Nodes of a circle in a graph, in order; empty if there is none."""
    done: set[str] = set()

    def walk(node: str, path: list[str]) -> list[str]:
        if node in path:
            return [*path[path.index(node) :], node]
        if node in done:
            return []
        for other in sorted(edges.get(node, ())):
            found = walk(other, [*path, node])
            if found:
                return found
        done.add(node)
        return []

    for node in sorted(edges):
        found = walk(node, [])
        if found:
            return found
    return []


def includes(texts: Mapping[str, str]) -> dict[str, set[str]]:
    """Which file of `texts` includes which."""
    return {
        name: {other for other in re.findall(r'^#include "([^"]+)"', text, re.MULTILINE) if other in texts}
        for name, text in texts.items()
    }


def calls(texts: Mapping[str, str]) -> dict[str, set[str]]:
    """Which C file calls a function of which other; through a pointer that a model gives does not count. A file that is
    one of two for the same functions (integers or float) counts as both."""
    made_by: dict[str, set[str]] = {}
    for name, text in texts.items():
        for function, static, _ in functions(text):
            if not static and name.endswith(".c"):
                made_by.setdefault(function, set()).add(name)
    edges: dict[str, set[str]] = {}
    for name, text in texts.items():
        code = _COMMENT.sub("", text)
        for function in set(re.findall(r"\b([a-z_0-9]+)\(", code)) & made_by.keys():
            if name.endswith(".c") and name not in made_by[function]:
                edges.setdefault(name, set()).update(made_by[function])
    return edges


def uses(texts: Mapping[str, str]) -> dict[str, set[str]]:
    """Which file of a room includes or calls which other. `x.c` and `x.h` are one: what a file of others needs is then
    in no header of its name."""
    edges: dict[str, set[str]] = {}
    for found in (includes(texts), calls(texts)):
        for name, others in found.items():
            stem = Path(name).stem
            edges.setdefault(stem, set()).update(Path(other).stem for other in others if Path(other).stem != stem)
    return edges


def imports(package: Path) -> dict[str, dict[str, bool]]:
    """Which module of a Python package imports which, anywhere in its file but for types; whether at its head."""
    files = {
        ".".join(path.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__"): path
        for path in package.rglob("*.py")
    }
    found: dict[str, dict[str, bool]] = {}
    for name, path in files.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        head = {id(node) for node in tree.body}
        typed = {
            id(one)
            for node in ast.walk(tree)
            if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
            for one in node.body
        }
        edges = found.setdefault(name, {})
        for node in ast.walk(tree):
            modules: list[str] = []
            if isinstance(node, ast.Import):
                modules = [one.name for one in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = ".".join(name.split(".")[: -node.level]) if node.level else ""
                base = ".".join(filter(None, (base, node.module)))
                modules = [full if (full := f"{base}.{one.name}") in files else base for one in node.names]
            for module in modules:
                if module in files and module != name and id(node) not in typed:
                    edges[module] = edges.get(module, False) or id(node) in head
    return found


def stages(found: Mapping[str, Mapping[str, bool]]) -> list[str]:
    """What breaks the order of the folders of `tools/selfcal`, and files that import each other."""
    said = []
    for name, edges in found.items():
        own = name.split(".")[1] if "." in name else ""
        for other, at_head in edges.items():
            theirs = other.split(".")[1] if "." in other else ""
            if own in STAGES and theirs in STAGES and STAGES.index(theirs) > STAGES.index(own):
                said.append(f"tools: {name} imports {other}: {own} comes before {theirs}")
            if own == "verbs" and at_head and not name.endswith("_shared") and not other.startswith(LIGHT):
                said.append(f"tools: {name} imports {other} at its head: import it in the function")
    folders = {path.name for path in (ROOT / "tools" / "selfcal").iterdir() if any(path.glob("*.py"))}
    said += [f"tools/selfcal/{name}: a folder that is no stage" for name in sorted(folders - set(STAGES))]
    top = {path.name for path in (ROOT / "tools" / "selfcal").glob("*.py")}
    said += [f"tools/selfcal/{name}: belongs into a folder" for name in sorted(top - TOP)]
    way = circle({name: set(edges) for name, edges in found.items()})
    return [*said, *([f"tools: files import each other in a circle: {' > '.join(way)}"] if way else [])]


def long_bodies(package: Path) -> list[str]:
    """Functions of a Python package whose body, without the docstring, has more than FUNCTION lines."""
    said = []
    for path in sorted(package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                body = node.body[1:] if ast.get_docstring(node) is not None else node.body
                lines = (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0
                if lines > FUNCTION:
                    said.append(f"{path.relative_to(ROOT)}: {node.name}() has {lines} lines, {FUNCTION} are allowed")
    return said


def complaints() -> list[str]:
    """What breaks the rules, a line each."""
    files = [path for path in tracked([".c", ".h"]) if path.parent == ROOT / "lib"]
    library = {path.name: path.read_text(encoding="utf-8") for path in files}
    package = ROOT / "tools" / "selfcal"
    found = long_lines(tracked(WRITTEN)) + stages(imports(package)) + long_bodies(package)
    application, sensors = (
        {path.name: path.read_text(encoding="utf-8") for path in tracked([".c", ".h"]) if path.parent == room}
        for room in (ROOT / "port" / "app", ROOT / "port" / "sensors")
    )
    guards = sum(name.endswith(".h") for name in application)
    for folder, texts, most in (("lib", library, CONDITIONALS), ("port/app", application, APP_CONDITIONALS + guards)):
        conditionals = sum(len(re.findall(r"^\s*#\s*(?:if|elif)", text, re.MULTILINE)) for text in texts.values())
        if conditionals > most:
            found.append(f"{folder}: {conditionals} conditional lines, {most} are allowed")
    for folder, edges in (
        ("lib", uses(library)),
        ("port/sensors", uses(sensors)),
        ("port/app", includes(application)),
        ("port/app", calls(application)),
    ):
        way = circle(edges)
        if way:
            found.append(f"{folder}: files need each other in a circle: {' > '.join(way)}")
    statics: dict[str, set[str]] = {}
    for name, text in library.items():
        for function, static, lines in functions(text):
            if lines > FUNCTION:
                found.append(f"lib/{name}: {function}() has {lines} lines, {FUNCTION} are allowed")
            if static:
                statics.setdefault(function, set()).add(name)
    for function, names in statics.items():
        if len(names) > 1:
            found.append(f"lib: {function}() is static in {', '.join(sorted(names))}")
    return found


def main() -> int:
    """Exit code: 1 with complaints."""
    found = complaints()
    print("".join(f"{line}\n" for line in found), end="")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
