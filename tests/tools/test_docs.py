"""What the documents say that is made from a source elsewhere.

`.venv/bin/python tests/tools/test_docs.py [PAGE ...]` writes the outputs of PRINTED anew, or those of some pages. Every
command of a document is run by a test, or UNTRIED says why not; all are parsed.
"""

from __future__ import annotations

import json
import math
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import textwrap
import tomllib
from pathlib import Path

import pytest
import typer

from selfcal.cli import app
from selfcal.diagnosis.extend import HEAD
from selfcal.verbs.codegen import codegen
from selfcal.verbs.identify import identify
from selfcal.verbs.simulate import simulate

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))  # where this is run as a program

from conftest import CASE_RECORDS, SHARED_DATA  # noqa: E402
from conftest import COMMAND as PROGRAM  # noqa: E402

PAGES = ROOT / "tools" / "pages"
DOCUMENTS = (
    *("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "host_sim/README.md", "port/README.md", "tests/README.md"),
    *("tests/ACCURACY.md", "tests/COST.md", "SECURITY.md", "tools/README.md"),
    *("lib/README.md", "lib/DESIGN.md", "lib/WIRE.md", "lib/EVALUATION.md"),
    *sorted(str(page.relative_to(ROOT)) for page in PAGES.glob("*.md")),
)
#: Pages whose examples run from top to bottom, each in a folder of its own.
PRINTED = (
    *("README.md", "tools/README.md"),
    *(
        f"tools/pages/{name}.md"
        for name in (
            *("better_model", "causes", "chamber", "compare", "diagnose", "identify"),
            *("metres", "production", "real_part", "response"),
        )
    ),
)
#: Lines of a page, to be read in one go.
LONGEST = 250
#: Beginnings of commands that no test runs as printed, and why.
UNTRIED = {
    "identify path/to/log.csv": "a place of the reader's own",
    "diagnose path/to/log.csv": "a place of the reader's own",
    "identify adis_16405_imu1.rda": "a file of the R package imudata; test_recording.py reads its form",
    "monitor ": "a module on a port, or its log; test_monitor.py",
    "demo": "runs until it is stopped; test_monitor_hostile.py and test_replay_can.py start it",
    "command ": "a module with a key; test_firmware_commands.py",
    "replay leak.npz": "QEMU; test_firmware.py",
    "replay next.csv": "QEMU; test_warm.py",
    "replay log.csv": "QEMU; test_firmware.py",
    "replay tests/data": "QEMU; test_firmware.py",
    "fleet ": "recordings of the reader's own; test_batch_priors.py, test_fleet.py",
    "plan part.yaml": "a model of the reader's own; test_plan.py",
    "plan icm42688p": "minutes; test_plan.py",
    "tumble ": "a log that is drawn; test_tumble.py compares the output",
    "rivals ": "minutes; test_rivals.py",
    "worth": "minutes; test_worth.py",
    "navigate": "minutes; test_navigate.py",
}
#: Those that take minutes, or the real recordings: in `make cases` alone.
SLOW = ("montecarlo", "identify ../shared/data", "diagnose ../shared/data")
#: Columns of a document.
WIDTH = 120
COMMAND = "    .venv/bin/selfcal "
COMMANDS = (COMMAND, "    cp ", "    cut ", "    .venv/bin/python ")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def checkout(folder: Path) -> Path:
    """`folder` as a checkout with its package installed, for the commands of a document."""
    (folder / ".venv" / "bin").mkdir(parents=True, exist_ok=True)
    (folder / ".venv" / "bin" / "selfcal").symlink_to(PROGRAM[0])
    python = folder / ".venv" / "bin" / "python"
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n', encoding="utf-8")
    python.chmod(0o755)
    for name in ("lib", "tools", "tests"):
        (folder / name).symlink_to(ROOT / name)
    shared = folder.parent / "shared"
    if SHARED_DATA.exists() and not shared.exists():
        shared.mkdir()
        (shared / "data").symlink_to(SHARED_DATA)
    return folder


def excused(command: str) -> bool:
    """Whether a command, without the program's name, is not run here."""
    slow = command.startswith(SLOW) and not (CASE_RECORDS and SHARED_DATA.exists())
    emulated = "--target cortex" in command and shutil.which("qemu-system-arm") is None
    return slow or emulated or command.startswith(tuple(UNTRIED))


def executed(text: str, folder: Path) -> str:
    """A document whose indented commands are run in `folder`, one after the other, each with its output below it, long
    lines wrapped. A command that has no output in the document gets none. `cp`, `cut` and Python are run as well. A
    file of the document, a block whose first line is `# NAME.py` or `# NAME.yaml`, is there from the start."""
    checkout(folder)
    for name, content in re.findall(r"^```\w+\n# (\w+\.(?:py|yaml))\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        (folder / name).write_text(content, encoding="utf-8")
    lines, found, at = text.splitlines(), list[str](), 0
    while at < len(lines):
        found.append(lines[at])
        at += 1
        if not found[-1].startswith(COMMANDS):
            continue
        command = found[-1]
        while command.endswith("\\"):
            command = command[:-1] + lines[at]
            found.append(lines[at])
            at += 1
        end = at
        while end < len(lines) and not lines[end].startswith((*COMMANDS, "    make ")):
            if lines[end] and lines[end][:4] != "    ":
                break
            end += 1
        if excused(command.removeprefix(COMMAND)):
            continue
        done = subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (command, done.stderr)
        if any(lines[at:end]):
            printed = [part for line in done.stdout.rstrip().splitlines() for part in wrapped(f"    {line}".rstrip())]
            found += ["", *printed, ""]
            at = end
    return "\n".join(found) + "\n"


def commands_of(text: str, before: str = " *") -> list[str]:
    """Every command of a text that stands after `before`, without the program's name, its lines joined."""
    joined = re.sub(r"\\\n\s*", "", text)
    found = re.findall(rf"^{before}\.venv/bin/selfcal ([a-z].*)$", joined, re.MULTILINE)
    return [re.split(r"\s+(?:#|\||>|&&)\s?|; ", one)[0].strip() for one in found]


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


@pytest.mark.parametrize("name", PRINTED)
def test_a_page_is_as_printed(name: str, tmp_path: Path) -> None:
    """Its recordings, its commands and their outputs; two pages have more to hold."""
    folder = tmp_path / "checkout"
    folder.mkdir()
    text = (ROOT / name).read_text(encoding="utf-8")
    assert_alike(text, executed(text, folder))
    if name == "README.md":
        assert (folder / "report.html").exists() and (folder / "my_tables" / "selfcal_model.c").exists()
        found = json.loads((folder / "my.json").read_text(encoding="utf-8"))["axes"]
        assert all("error" not in axis for axis in found.values())
    gained = re.search(r"has gained ([0-9.]+) nats", text)
    assert (gained is not None) == (name == "tools/pages/better_model.md")
    if gained is not None:
        best = [
            max(json.loads((folder / file).read_text(encoding="utf-8"))["axes"]["gx"]["log_evidence"].values())
            for file in ("before.json", "after.json")
        ]
        assert math.isclose(float(gained[1]), best[1] - best[0], rel_tol=0.01)


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout with a reader's files: a model of its own, an extended one, a recording of ten minutes."""
    folder = checkout(tmp_path_factory.mktemp("desk") / "checkout")
    model = (ROOT / "tests" / "data" / "simulated_adis16405.yaml").read_text(encoding="utf-8")
    short_one = model.replace("duration_s: 3600.0", "duration_s: 600.0")
    assert short_one != model
    (folder / "my.yaml").write_text(short_one, encoding="utf-8")
    (folder / "extended.yaml").write_text(f"{HEAD} from log.npz\n{short_one}", encoding="utf-8")
    shell(".venv/bin/selfcal simulate my.yaml -o log.csv --seed 2; cp log.csv part.csv", folder)
    return folder


@pytest.mark.parametrize("name", DOCUMENTS)
def test_every_command_of_the_documents_runs(name: str, request: pytest.FixtureRequest) -> None:
    """Where its output is compared, or here in `make cases`, or UNTRIED says why not; all are parsed."""
    text = (ROOT / name).read_text(encoding="utf-8")
    ran = commands_of(text, "    ") if name in PRINTED else []
    if name == "lib/README.md":
        ran = commands_of("".join(blocks(ROOT / name, "sh")[:3]))
    parser = typer.main.get_command(app)
    for command in commands_of(text):
        words = shlex.split(command)
        verb = parser.get_command(None, words[0])  # type: ignore[attr-defined]
        verb.make_context(words[0], words[1:])
        if CASE_RECORDS and command not in ran and not excused(command):
            shell(f".venv/bin/selfcal {command}", request.getfixturevalue("desk"))


def test_every_extra_of_the_documents_exists() -> None:
    """`selfcal[ros,px4]`, and in place of the name a wheel's."""
    known = tomllib.loads((ROOT / "tools" / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [
        re.findall(r"selfcal(?:-\S+\.whl)?\[([a-z0-9,]+)\]", (ROOT / name).read_text(encoding="utf-8"))
        for name in DOCUMENTS
    ]
    extras = {extra for texts in named for text in texts for extra in text.split(",")}
    assert extras and extras <= known["optional-dependencies"].keys() | {"name"}


def test_the_sizes_of_the_images_are_those_of_the_bench() -> None:
    """port/README.md against the table of tests/COST.md, in KB."""
    table = (ROOT / "tests" / "COST.md").read_text(encoding="utf-8").partition("**whole image**, bytes")[2]
    sizes = [[int(cell.replace(",", "")) for cell in re.findall(r"\d+,\d+", line)] for line in table.splitlines()[1:4]]
    told = re.search(r"need ([\d.]+) KB of flash and ([\d.]+) KB of RAM beside ([\d.]+) KB of stack on the "
                     r"`stm32f405`,\s+([\d.]+) KB and ([\d.]+) KB beside ([\d.]+) KB on the `cortex-m0`",
                     (ROOT / "port" / "README.md").read_text(encoding="utf-8"))  # fmt: skip
    assert told is not None
    for place, said in enumerate(told.groups()):
        assert float(said) == round(sizes[place % 3][place // 3] / 1000.0, 1)


def test_the_python_example_runs(tmp_path: Path) -> None:
    """As printed, with the number that stands behind its `print`."""
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    shutil.copy(ROOT / "tools" / "selfcal" / "model" / "models" / "default.yaml", tmp_path / "my.yaml")
    example = blocks(PAGES / "python.md", "python")[0]
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, check=True)
    told = re.search(r"^print.*# ([0-9.]+)$", example, re.MULTILINE)
    assert told is not None and math.isclose(float(done.stdout), float(told[1]), rel_tol=0.02)
    assert (tmp_path / "my.csv").exists() and (tmp_path / "tables" / "selfcal_model.c").exists()


@pytest.mark.parametrize(("option", "page"), [("--table", "tests/COST.md"), ("--product", "lib/README.md")])
def test_the_cost_tables_are_those_of_the_bench(option: str, page: str) -> None:
    bench = [sys.executable, str(ROOT / "tests" / "bench" / "bench.py"), option]
    table = subprocess.run(bench, capture_output=True, text=True, check=True).stdout.strip()
    assert table in (ROOT / page).read_text(encoding="utf-8")


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
    """lib/README.md as printed: its program as C99, as C++17 and by CMake, each with the output that stands there, and
    for a Cortex-M4F. The program itself has no warning."""
    for name in ("lib", "tools"):
        (tmp_path / name).symlink_to(ROOT / name)
    document = ROOT / "lib" / "README.md"
    (tmp_path / "product.c").write_text(blocks(document, "c")[0], encoding="utf-8")
    (tmp_path / "CMakeLists.txt").write_text(blocks(document, "cmake")[0], encoding="utf-8")
    as_c, as_cpp, by_cmake, _ = blocks(document, "sh")
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
    shell(f"arm-none-eabi-gcc -mcpu=cortex-m4 -mthumb -std=c99 {strict}", tmp_path)


def test_the_product_computes_what_identify_computes(tmp_path: Path) -> None:
    """lib/README.md's product on the axes of its log that are not retired, against `identify --gate`. Both interpolate
    between nodes. selfcal.h bounds that at SELFCAL_OFF_GRID, of each: 0.05 nat of a law, so 0.2 nat of the odds of two
    and 0.05 of a probability; 0.05 sd of the mean; 3 % of the sd."""
    axes = ("gx", "gy", "gz", "ax")
    simulate(None, tmp_path / "all.csv", seed=1)
    rows = [line.split(",")[: 1 + len(axes)] for line in (tmp_path / "all.csv").read_text().splitlines()]
    # The gate leaves 8.5 s out: so the log ends with a whole average, and both have the bias of one instant.
    rows = rows[:-5]
    log = tmp_path / "log.csv"
    log.write_text("".join(",".join(row) + "\n" for row in rows), encoding="utf-8")
    codegen(None, tmp_path, rate=10.0, axes=axes)
    program = tmp_path / "product.c"
    program.write_text(blocks(ROOT / "lib" / "README.md", "c")[0], encoding="utf-8")
    sources = [program, tmp_path / "selfcal_model.c", *sorted((ROOT / "lib").glob("*.c"))]
    flags = ["-std=c99", "-O2", "-ffp-contract=off", f"-I{ROOT / 'lib'}", f"-I{tmp_path}"]
    subprocess.run(["cc", *flags, *map(str, sources), "-lm", "-o", str(tmp_path / "product")], check=True)
    fed = "".join(" ".join(row[1:]) + "\n" for row in rows[1:])
    said = subprocess.run([tmp_path / "product"], input=fed, check=True, capture_output=True, text=True).stdout
    found = identify(log, gate=True)["axes"]
    row = re.compile(r"(\w+): reason 0, bias (\S+) \+- (\S+), P (\S+) (\S+) (\S+)")
    told = [match.groups() for line in said.splitlines() if (match := row.fullmatch(line))]
    assert [axis for axis, *_ in told] == list(axes)
    for axis, *numbers in told:
        mean, sd, *chances = map(float, numbers)
        bias = found[axis]["bias_now"]
        assert mean == pytest.approx(bias["mean"], abs=2 * 0.05 * sd + 1e-5)
        assert sd == pytest.approx(bias["sd"], rel=2 * 0.03, abs=1e-5)
        assert chances == pytest.approx(list(found[axis]["hypotheses"].values()), abs=0.05)


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
    models = [str(path.relative_to(ROOT)) for path in (ROOT / "tools" / "selfcal" / "model" / "models").glob("*.yaml")]
    for name in (*DOCUMENTS, *models):
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), 1):
            assert len(line) <= WIDTH, f"{name}:{number}: {len(line)} columns"


def test_pages_are_short_and_found() -> None:
    """Each is to be read in one go, and the table of tools/README.md has it."""
    door = (ROOT / "tools" / "README.md").read_text(encoding="utf-8")
    for page in PAGES.glob("*.md"):
        assert page.read_text(encoding="utf-8").count("\n") <= LONGEST, page.name
        assert f"](pages/{page.name}" in door, page.name


if __name__ == "__main__":
    for page in sys.argv[1:] or PRINTED:
        with tempfile.TemporaryDirectory() as name:
            folder, document = Path(name) / "checkout", ROOT / page
            folder.mkdir()
            document.write_text(executed(document.read_text(encoding="utf-8"), folder), encoding="utf-8")
