"""What the documents say that is made from a source elsewhere.

`.venv/bin/python tests/py/test_docs.py` writes the outputs in tools/README.md anew.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

from selfcal.verbs.codegen import codegen

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = (
    *("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "host_sim/README.md", "port/README.md", "tests/README.md"),
    *("lib/README.md", "lib/DESIGN.md", "lib/WIRE.md", "tools/README.md", "tools/MODEL.md"),
)
WALKTHROUGH = ROOT / "tools" / "README.md"
#: Columns of a document.
WIDTH = 120
COMMAND = "    .venv/bin/selfcal "
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def executed(text: str, folder: Path) -> str:
    """A document whose indented commands are run in `folder`, one after the other, each with its output below it, long
    lines wrapped. A command that has no output in the document gets none."""
    lines, found, at = text.splitlines(), list[str](), 0
    while at < len(lines):
        found.append(lines[at])
        at += 1
        if not found[-1].startswith(COMMAND):
            continue
        command = found[-1]
        while command.endswith("\\"):
            command = command[:-1] + lines[at]
            found.append(lines[at])
            at += 1
        end = at
        while end < len(lines) and not lines[end].startswith(COMMAND) and (not lines[end] or lines[end][:4] == "    "):
            end += 1
        command = command.replace(COMMAND, f"{sys.executable} -m selfcal.cli ").replace("tools/", f"{ROOT}/tools/")
        done = subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (command, done.stderr)
        if any(lines[at:end]):
            printed = [part for line in done.stdout.rstrip().splitlines() for part in wrapped(f"    {line}".rstrip())]
            found += ["", *printed, ""]
            at = end
    return "\n".join(found) + "\n"


def wrapped(line: str) -> list[str]:
    """A line of an output as a document has it."""
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    return (
        [line]
        if len(line) <= WIDTH
        else textwrap.wrap(line, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    )


def words(text: str) -> list[str]:
    """A text without its numbers and without the places of its line ends. Lines of tables have the width that their
    numbers give them."""
    return re.sub(r"─+", "─", NUMBER.sub("#", text)).split()


def assert_alike(said: str, printed: str) -> None:
    """Words exactly, numbers to 2 %: other compilers round otherwise."""
    assert words(said) == words(printed)
    for a, b in zip(NUMBER.findall(said), NUMBER.findall(printed), strict=True):
        assert math.isclose(float(a), float(b), rel_tol=0.02, abs_tol=2e-4), (a, b)


def test_the_walkthrough_is_as_printed(tmp_path: Path) -> None:
    """The text's own figure of the JSON, too."""
    text = WALKTHROUGH.read_text(encoding="utf-8")
    assert_alike(text, executed(text, tmp_path))
    best = [
        max(json.loads((tmp_path / name).read_text(encoding="utf-8"))["axes"]["gx"]["log_evidence"].values())
        for name in ("before.json", "after.json")
    ]
    told = re.search(r"has gained ([0-9.]+) nats", text)
    assert told is not None and math.isclose(float(told[1]), best[1] - best[0], rel_tol=0.01)


def test_the_python_example_runs(tmp_path: Path) -> None:
    """As printed, with the number that stands behind its `print`."""
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    shutil.copy(ROOT / "tools" / "selfcal" / "models" / "default.yaml", tmp_path / "my.yaml")
    example = blocks(ROOT / "tools" / "README.md", "python")[0]
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, check=True)
    told = re.search(r"^print.*# ([0-9.]+)$", example, re.MULTILINE)
    assert told is not None and math.isclose(float(done.stdout), float(told[1]), rel_tol=0.02)
    assert (tmp_path / "my.csv").exists() and (tmp_path / "tables" / "selfcal_model.c").exists()


def test_the_cost_table_is_the_one_of_the_bench() -> None:
    bench = [sys.executable, str(ROOT / "tests" / "bench" / "bench.py"), "--table"]
    table = subprocess.run(bench, capture_output=True, text=True, check=True).stdout.strip()
    assert table in (ROOT / "tests" / "README.md").read_text(encoding="utf-8")


def blocks(document: Path, language: str) -> list[str]:
    """The blocks of a document that are fenced as in `language`."""
    text = document.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def shell(command: str, folder: Path) -> str:
    """The output of a command of a document, which stands in a checkout with its package installed."""
    command = command.replace(".venv/bin/selfcal ", f"{sys.executable} -m selfcal.cli ")
    done = subprocess.run(["bash", "-ec", command], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, (command, done.stdout, done.stderr)
    return done.stdout


def test_the_product_is_built_and_prints_as_printed(tmp_path: Path) -> None:
    """lib/README.md as printed: its program as C99, as C++17 and by CMake, each with the output that stands there. The
    program itself has no warning."""
    for name in ("lib", "tools"):
        (tmp_path / name).symlink_to(ROOT / name)
    document = ROOT / "lib" / "README.md"
    (tmp_path / "product.c").write_text(blocks(document, "c")[0], encoding="utf-8")
    (tmp_path / "CMakeLists.txt").write_text(blocks(document, "cmake")[0], encoding="utf-8")
    as_c, as_cpp, by_cmake = blocks(document, "sh")
    said = blocks(document, "text")[0]
    feed = as_c.splitlines()[-1]
    shell(as_c, tmp_path)
    assert_alike(said, shell(feed, tmp_path))
    shell(as_cpp, tmp_path)
    assert_alike(said, shell(feed, tmp_path))
    shell(by_cmake, tmp_path)
    assert_alike(said, shell(feed.replace("./product", "build/product"), tmp_path))
    strict = "-Wall -Wextra -Wpedantic -Wconversion -Wshadow -Werror -fsyntax-only -Ilib -Itables product.c"
    shell(f"cc -std=c99 {strict}; c++ -std=c++17 -x c++ {strict}", tmp_path)


def test_the_product_refuses_tables_of_another_rate(tmp_path: Path) -> None:
    program = tmp_path / "product.c"
    program.write_text(blocks(ROOT / "lib" / "README.md", "c")[0], encoding="utf-8")
    codegen(None, tmp_path)
    command = ["cc", "-std=c99", "-fsyntax-only", f"-I{ROOT / 'lib'}", f"-I{tmp_path}", str(program)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode != 0
    assert "the tables are for another sampling rate" in done.stderr


def anchors(document: Path) -> set[str]:
    """What a link into a document may name: its headings, as forges write them."""
    headings = re.findall(r"^#+ (.+)$", document.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_links_of_the_documents_lead_somewhere() -> None:
    for name in DOCUMENTS:
        document = ROOT / name
        for link in re.findall(r"\]\(([^)]+)", document.read_text(encoding="utf-8")):
            path, _, anchor = link.partition("#")
            target = document.parent / path if path else document
            assert target.exists(), f"{name}: {link}"
            assert not anchor or anchor in anchors(target), f"{name}: {link}"


def test_verbs_of_the_documents_exist() -> None:
    """Every verb that the documents call is one of the command's."""
    listed = subprocess.run([sys.executable, "-m", "selfcal.cli", "--help"], capture_output=True, text=True, check=True)
    for name in DOCUMENTS:
        text = (ROOT / name).read_text(encoding="utf-8")
        for verb in re.findall(r"(?:^|`|/)selfcal ([a-z]+)", text, re.MULTILINE):
            assert re.search(rf"\b{verb}\b", listed.stdout), f"{name}: selfcal {verb}"


def test_lines_of_the_documents_fit() -> None:
    models = [str(path.relative_to(ROOT)) for path in (ROOT / "tools" / "selfcal" / "models").glob("*.yaml")]
    for name in (*DOCUMENTS, *models):
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), 1):
            assert len(line) <= WIDTH, f"{name}:{number}: {len(line)} columns"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        WALKTHROUGH.write_text(executed(WALKTHROUGH.read_text(encoding="utf-8"), Path(name)), encoding="utf-8")
