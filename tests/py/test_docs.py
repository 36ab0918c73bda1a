"""What the documents say that is made from a source elsewhere.

`.venv/bin/python tests/py/test_docs.py` writes the outputs in tools/README.md anew.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from selfcal.verbs.codegen import codegen

ROOT = Path(__file__).resolve().parents[2]


WALKTHROUGH = ROOT / "tools" / "README.md"
COMMAND = "    .venv/bin/selfcal "
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def executed(text: str, folder: Path) -> str:
    """A document whose indented commands are run in `folder`, one after the other, each with its output below it. A
    command that has no output in the document gets none."""
    lines, found, at = text.splitlines(), list[str](), 0
    while at < len(lines):
        found.append(lines[at])
        at += 1
        if not found[-1].startswith(COMMAND):
            continue
        end = at
        while end < len(lines) and not lines[end].startswith(COMMAND) and (not lines[end] or lines[end][:4] == "    "):
            end += 1
        command = found[-1].replace(COMMAND, f"{sys.executable} -m selfcal.cli ").replace("tools/", f"{ROOT}/tools/")
        done = subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (command, done.stderr)
        if any(lines[at:end]):
            printed = [f"    {line}".rstrip() for line in done.stdout.rstrip().splitlines()]
            found += ["", *printed, ""]
            at = end
    return "\n".join(found) + "\n"


def worded(line: str) -> str:
    """A line without its numbers, and without the width that they have given it."""
    return re.sub(r"─+", "─", " ".join(NUMBER.sub("#", line).split()))


def test_the_walkthrough_is_as_printed(tmp_path: Path) -> None:
    """Words exactly, numbers to 2 %: other compilers round otherwise. The text's own figure of the JSON, too."""
    text = WALKTHROUGH.read_text(encoding="utf-8")
    now = executed(text, tmp_path)
    for said, printed in zip(text.splitlines(), now.splitlines(), strict=True):
        assert worded(said) == worded(printed)
        for a, b in zip(NUMBER.findall(said), NUMBER.findall(printed), strict=True):
            assert math.isclose(float(a), float(b), rel_tol=0.02, abs_tol=2e-4), (said, printed)
    best = [
        max(json.loads((tmp_path / name).read_text(encoding="utf-8"))["axes"]["gx"]["log_evidence"].values())
        for name in ("before.json", "after.json")
    ]
    told = re.search(r"has gained ([0-9.]+) nats", text)
    assert told is not None and math.isclose(float(told[1]), best[1] - best[0], rel_tol=0.01)


def test_the_guide_has_the_telemetry_table_of_the_dbc() -> None:
    table = subprocess.run(
        [sys.executable, "-m", "selfcal.frames_codegen", "--table"], capture_output=True, text=True, check=True
    ).stdout.strip()
    assert table in (ROOT / "GUIDE.md").read_text(encoding="utf-8")


def test_the_guide_has_the_cost_table_of_the_bench() -> None:
    bench = [sys.executable, str(ROOT / "tests" / "bench" / "bench.py"), "--table"]
    table = subprocess.run(bench, capture_output=True, text=True, check=True).stdout.strip()
    assert table in (ROOT / "GUIDE.md").read_text(encoding="utf-8")


def test_the_guide_s_program_compiles(tmp_path: Path) -> None:
    """As a function's body, with warnings as errors, against the header of its rate; against that of another it does
    not."""
    guide = (ROOT / "GUIDE.md").read_text(encoding="utf-8")
    programs = re.findall(r"^```c\n(.*?)^```$", guide, re.MULTILINE | re.DOTALL)
    program = next(text for text in programs if "selfcal_model.h" in text)
    lines = program.splitlines()
    includes = [line for line in lines if line.startswith("#include")]
    body = [line for line in lines if not line.startswith("#include")]
    declared = ["void fault(void);", "void read_sensor(float sample[]);", "int run(uint8_t axis);"]
    source = tmp_path / "program.c"
    source.write_text("\n".join([*includes, *declared, "int run(uint8_t axis) {", *body, "return 0;", "}"]))
    flags = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror", "-fsyntax-only"]
    command = ["cc", *flags, f"-I{ROOT / 'lib'}", f"-I{tmp_path}", str(source)]
    codegen(None, tmp_path, rate=100.0)
    subprocess.run(command, check=True)
    codegen(None, tmp_path)
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode != 0
    assert "the tables are for another sampling rate" in done.stderr


def test_links_of_the_documents_lead_somewhere() -> None:
    for document in ("README.md", "GUIDE.md", "CONTRIBUTING.md", "tools/README.md", "tests/README.md"):
        text = (ROOT / document).read_text(encoding="utf-8")
        for link in re.findall(r"\]\(([^)#]+)", text):
            assert (ROOT / document).parent.joinpath(link).exists(), f"{document}: {link}"


def test_commands_of_the_readme_exist() -> None:
    """Every verb that the documents call is one of the command's."""
    listed = subprocess.run([sys.executable, "-m", "selfcal.cli", "--help"], capture_output=True, text=True, check=True)
    for document in ("README.md", "GUIDE.md", "tools/README.md"):
        text = (ROOT / document).read_text(encoding="utf-8")
        for verb in re.findall(r"(?:^|`|/)selfcal ([a-z]+)", text, re.MULTILINE):
            assert re.search(rf"\b{verb}\b", listed.stdout), f"{document}: selfcal {verb}"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        WALKTHROUGH.write_text(executed(WALKTHROUGH.read_text(encoding="utf-8"), Path(name)), encoding="utf-8")
