"""The MISRA rules that lib/EVALUATION.md names, against cppcheck."""

import re
import shutil
import subprocess

import pytest

from conftest import ROOT


@pytest.mark.skipif(shutil.which("cppcheck") is None, reason="CPPCHECK ABSENT: apt-get install cppcheck")
def test_the_rules_that_are_broken_are_those_of_the_page() -> None:
    """Every rule that cppcheck reports has a row. Another release of cppcheck may report fewer."""
    files = sorted(str(path) for path in (ROOT / "lib").glob("*.c"))
    options = ["--addon=misra", "--std=c99", "--max-configs=1", "--quiet", f"-I{ROOT}/lib", f"-I{ROOT}/lib/default"]
    told = subprocess.run(["cppcheck", *options, *files], capture_output=True, text=True, check=True).stderr
    broken = set(re.findall(r"\[misra-c2012-([0-9.]+)\]", told))
    page = (ROOT / "lib" / "EVALUATION.md").read_text(encoding="utf-8").partition("## MISRA")[2]
    named = {rule for row in re.findall(r"^\| ([0-9., ]+) \|", page, re.MULTILINE) for rule in row.split(", ")}
    assert broken and broken <= named
