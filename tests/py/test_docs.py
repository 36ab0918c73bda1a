"""What the documents say that is made from a source elsewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from selfcal.verbs.codegen import codegen

ROOT = Path(__file__).resolve().parents[2]


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
    for document in ("README.md", "GUIDE.md", "CONTRIBUTING.md"):
        text = (ROOT / document).read_text(encoding="utf-8")
        for link in re.findall(r"\]\(([^)#]+)\)", text):
            assert (ROOT / link).exists(), f"{document}: {link}"


def test_commands_of_the_readme_exist() -> None:
    """Every verb that the documents call is one of the command's."""
    listed = subprocess.run([sys.executable, "-m", "selfcal.cli", "--help"], capture_output=True, text=True, check=True)
    for document in ("README.md", "GUIDE.md"):
        text = (ROOT / document).read_text(encoding="utf-8")
        for verb in re.findall(r"(?:^|`|/)selfcal ([a-z]+)", text, re.MULTILINE):
            assert re.search(rf"\b{verb}\b", listed.stdout), f"{document}: selfcal {verb}"
