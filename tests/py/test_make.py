"""What `make` itself does: names of files are data, in the Makefile and in what the firmware is built by."""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest

from selfcal import recording
from selfcal.model import Model
from selfcal.verbs import replay as verb
from selfcal.verbs.replay import build

from conftest import ROOT

#: Every character that a shell or make gives a meaning to.
HOSTILE = "$(shell touch made1) `touch made2` $(touch made3);touch made4;'\"& | <in >out #%:=\\ (1)* {a,b} ~ !"


def make(*arguments: str, cwd: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["make", *arguments], cwd=cwd, capture_output=True, text=True, check=False, env={**os.environ, **environment}
    )


def record(path: Path) -> None:
    """Three minutes of one gyro at 10 Hz."""
    recording.save(path, {"gx": ("deg/s", 0.1 * np.random.default_rng(1).normal(size=1800))}, 10.0, {})


@pytest.mark.parametrize("by", ["command line", "environment"])
def test_a_file_name_is_no_command(by: str, tmp_path: Path) -> None:
    """`make run` plays the very file of a hostile name, and nothing that the name says is run."""
    file = tmp_path / f"{HOSTILE}.npz"
    record(file)
    before = set(ROOT.iterdir())
    named = ("run", f"RECORDING={file}") if by == "command line" else ("run",)
    done = make(*named, **({} if by == "command line" else {"RECORDING": str(file)}))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "gx [deg/s]" in done.stdout + done.stderr
    assert set(ROOT.iterdir()) == before
    assert list(tmp_path.iterdir()) == [file]


def test_a_name_like_an_option_is_a_file() -> None:
    done = make("run", "RECORDING=--help.npz")
    assert done.returncode == 2
    assert "--help.npz" in done.stderr and "Traceback" not in done.stderr


# ------------------------------------------------------------------------------------------- the firmware of `replay`


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What a firmware is built from, in a folder of its own whose path has a space and a parenthesis."""
    folder = tmp_path / "a checkout (2)"
    for part in ("lib", "port"):
        shutil.copytree(ROOT / part, folder / part)
    monkeypatch.setattr(verb, "ROOT", folder)
    return folder


@pytest.mark.parametrize("target", ["host", "cortex-m4f"])
def test_a_checkout_in_a_path_with_a_space(target: str, checkout: Path) -> None:
    program = build(Model.load(), 10.0, ("gx",), target)
    assert program.is_relative_to(checkout)
    assert program.stat().st_size > 10_000


@pytest.fixture
def compiler(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A compiler that writes `program` and a line into the log that is returned; on a full disk, if there is a file
    `full` beside the log, it fails amid that."""
    log = checkout / "bin" / "log"
    log.parent.mkdir()
    (log.parent / "cc").write_text(
        f"""#!/bin/sh
echo compiled >>'{log}'
while [ "$1" != -o ]; do shift; done
printf pro >"$2"
sleep 0.3
if [ -e '{log.parent}/full' ]; then echo "fatal error: No space left on device" >&2; exit 1; fi
printf program >"$2"
"""
    )
    (log.parent / "cc").chmod(0o755)
    monkeypatch.setenv("PATH", f"{log.parent}:{os.environ['PATH']}")
    return log


def compiled(log: Path) -> int:
    """Times that the compiler was called."""
    return len(log.read_text().splitlines())


def folders(program: Path) -> list[Path]:
    """Folders of the cache that a program is in."""
    return [path for path in program.parents[1].iterdir() if path.is_dir()]


def test_a_firmware_is_built_once(checkout: Path, compiler: Path) -> None:
    """And anew for other content, whatever the time stamps say."""
    program = build(Model.load(), 10.0, ("gx",))
    assert program.read_text() == "program"
    os.utime(checkout / "lib" / "bank.c")
    assert build(Model.load(), 10.0, ("gx",)) == program
    assert compiled(compiler) == 1
    source = checkout / "lib" / "bank.c"
    source.write_text(source.read_text() + "/* other */\n")
    os.utime(source, (0, 0))
    assert build(Model.load(), 10.0, ("gx",)) != program
    assert compiled(compiler) == 2


def test_a_build_that_fails_leaves_nothing(compiler: Path) -> None:
    """Not the half of a program; the next build is whole."""
    full = compiler.parent / "full"
    full.touch()
    with pytest.raises(verb.UserError, match=r"cannot build the firmware: .*No space left"):
        build(Model.load(), 10.0, ("gx",))
    full.unlink()
    program = build(Model.load(), 10.0, ("gx",))
    assert program.read_text() == "program"
    assert folders(program) == [program.parent]


def test_a_build_that_was_killed_is_begun_anew(compiler: Path) -> None:
    """A half-made folder is where kill -9 leaves one."""
    program = build(Model.load(), 10.0, ("gx",))
    part = program.parent.with_suffix(".part")
    program.parent.rename(part)
    (part / program.name).write_text("pro")
    assert build(Model.load(), 10.0, ("gx",)) == program
    assert program.read_text() == "program"
    assert folders(program) == [program.parent]
    assert compiled(compiler) == 2


def test_two_at_once_build_one(compiler: Path) -> None:
    """The second waits for the first and takes what it made."""
    found: list[Path] = []
    threads = [threading.Thread(target=lambda: found.append(build(Model.load(), 10.0, ("gx",)))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found[0] == found[1]
    assert found[0].read_text() == "program"
    assert compiled(compiler) == 1
