"""What the documents say that is made from a source elsewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

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
