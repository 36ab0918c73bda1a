"""tests/long_run.py: what `make campaigns` and its like leave behind. Truth: the exit codes of `true` and `false`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import long_run
import pytest

from conftest import COLLECTED, ROOT, long_tests


@pytest.fixture(autouse=True)
def record(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(long_run, "RECORD", tmp_path / "long_runs.txt")
    monkeypatch.setattr(long_run, "commit", lambda: "HEAD~0")
    monkeypatch.setattr(long_run, "machine", lambda: "3 cores, m68k")
    return tmp_path / "long_runs.txt"


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["long_run.py", *arguments])
    return long_run.main()


def test_a_whole_run_is_written_down(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "make soak         no run is recorded" in long_run.say()
    assert run(monkeypatch, "soak", "false", "--part") == 1  # --part is the command's here
    assert "make soak         FAILED with exit code 1 after 0 min on 3 cores, m68k" in long_run.say()
    assert run(monkeypatch, "campaigns", "true") == 0
    assert run(monkeypatch, "cases-lib", sys.executable, "-c", "print('..')\nprint('== 3 passed in 2 s ==')") == 0
    assert long_run.read()["cases-lib"].outcome.endswith("m68k: 3 passed in 2 s")
    assert run(monkeypatch, "soak", "true") == 0
    written = [long_run.read()[name].outcome for name in ("campaigns", "soak")]
    assert written == ["passed after 0 min on 3 cores, m68k"] * 2
    if subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, check=False).returncode == 0:
        assert long_run.say().count("0 commits ago") == 3


def test_a_part_is_not(monkeypatch: pytest.MonkeyPatch, record: Path) -> None:
    assert run(monkeypatch, "--part", "tolerances", "false") == 1
    assert not record.exists()


def test_every_long_test_is_there(pytestconfig: pytest.Config) -> None:
    """Of the files that were collected: a line of tests/long_tests.txt names a test."""
    names = pytestconfig.stash[COLLECTED]
    known = names | {name.partition("[")[0] for name in names}
    files = {name.partition("::")[0] for name in names}
    left, kept = long_tests()
    assert [name for name in sorted(left | kept) if name not in known and name.partition("::")[0] in files] == []
