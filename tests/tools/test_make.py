"""What `make` itself does: names of files are data, in the Makefile and in what the firmware is built by."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import threading
import tomllib
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import yaml

import selfcal
from selfcal.logs import recording
from selfcal.model.file import Model
from selfcal.wire import replay as verb
from selfcal.wire.command import build_flag
from selfcal.wire.replay import build

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


def test_help_names_what_the_documents_call() -> None:
    """`make help` has every goal that the documents tell the reader to type."""
    said = make("help").stdout
    listed = set(re.findall(r"^make ([a-z]+)", said, re.MULTILINE))
    documents = "".join(path.read_text() for path in (*ROOT.glob("*.md"), *ROOT.glob("*/*.md")))
    called = set(re.findall(r"(?:`|^ {4})make ([a-z]+)\b(?!/)", documents, re.MULTILINE))
    assert called <= listed
    assert {"run", "test", "firmware", "lock"} <= listed
    assert "Settings: PYTHON" in said


# ------------------------------------------------------------------------------------------------------------- set-up

FAKE_PYTHON = """#!/bin/sh
case "$*" in
"-m venv --clear .venv") mkdir -p .venv/bin; cp "$0" .venv/bin/python; said=venv ;;
"-m pip uninstall "*) exit ;;
"-m pip "*"--target "*) mkdir -p .venv/backend; said=pip ;;
"-m pip "*) said=pip ;;
*) exec {python} "$@" ;;
esac
echo $said begins >>log; sleep 0.3; echo $said ends >>log
"""


def test_set_ups_at_once_are_one(tmp_path: Path) -> None:
    """Three are begun together, of which one uses the package at once; each step of the set-up is done once."""
    for part in (
        "Makefile",
        "port/boards.txt",
        *(part.relative_to(ROOT) for room in ("port", "tests") for part in (ROOT / room).rglob("*.mk")),
        "tools/requirements.txt",
        "tools/requirements-build.txt",
        "tools/pyproject.toml",
        "tools/CMakeLists.txt",
    ):
        (tmp_path / part).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / part, tmp_path / part)
    for folder in ("tools/setup", "port/sensors"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    fake = tmp_path / "python"
    fake.write_text(FAKE_PYTHON.format(python=sys.executable))
    fake.chmod(0o755)
    command = ["make", "-j2", f"PYTHON={fake}"]
    makes = [subprocess.Popen([*command, goal], cwd=tmp_path) for goal in ("setup", "python", "setup")]
    assert [one.wait() for one in makes] == [0, 0, 0]
    steps = [f"{step} {end}" for step in ("venv", "pip", "pip", "pip") for end in ("begins", "ends")]
    assert sorted((tmp_path / "log").read_text().splitlines()) == sorted(steps)
    assert make("setup", f"PYTHON={fake}", cwd=tmp_path).returncode == 0
    assert len((tmp_path / "log").read_text().splitlines()) == len(steps)


def test_every_package_is_locked() -> None:
    """Each name in tools/pyproject.toml is in a lock, and each version has a hash: `make lock` was run. A package has
    one version, or one for each of several Pythons."""
    project = tomllib.loads((ROOT / "tools" / "pyproject.toml").read_text())
    extras = [name for extra in project["project"]["optional-dependencies"].values() for name in extra]
    groups = project["dependency-groups"]
    for file, named in (
        ("requirements.txt", [*project["project"]["dependencies"], *groups["run"]]),
        ("requirements-build.txt", [*project["build-system"]["requires"], *groups["build"]]),
        ("requirements-dev.txt", groups["dev"]),
        ("requirements-all.txt", [*project["project"]["dependencies"], *extras]),
    ):
        text = (ROOT / "tools" / file).read_text()
        pin = r"^([a-z0-9-]+)==(\S+)( ;.*)? \\\n    --hash=sha256:[0-9a-f]{64}\b"
        locked = re.findall(pin, text, re.MULTILINE)
        assert len(locked) == len(re.findall(r"^\S+==", text, re.MULTILINE))
        assert len(locked) == len({(name, marker) for name, _, marker in locked})
        versions = {name: version for name, version, _ in locked}
        assert {re.sub(r"[-_.]+", "-", name).lower() for name in named} <= set(versions)
        if file == "requirements.txt":
            assert len(versions) == len(locked)
            for name in ("pip", "numpy"):
                assert metadata.version(name) == versions[name]


def test_a_unity_of_another_content_is_refused(tmp_path: Path) -> None:
    """As a package whose files were tampered with would be; what was there stays."""
    inside = tmp_path / "ntpsec-9" / "tests" / "unity"
    inside.mkdir(parents=True)
    for file in (ROOT / "build" / "unity").iterdir():
        shutil.copy(file, inside)
    unpack = "import sys; sys.path.insert(0, sys.argv[1]); import unity, pathlib; "
    unpack += "unity.unpack(pathlib.Path(sys.argv[2]), pathlib.Path(sys.argv[3]))"
    command = [sys.executable, "-c", unpack, ROOT / "tools" / "setup", tmp_path / "ntpsec.tar", tmp_path / "unity"]
    shutil.make_archive(str(tmp_path / "ntpsec"), "tar", tmp_path, "ntpsec-9")
    assert subprocess.run(command, check=False).returncode == 0
    assert {file.name for file in (tmp_path / "unity").iterdir()} == {"unity.c", "unity.h", "unity_internals.h"}
    (inside / "unity.c").write_text((inside / "unity.c").read_text() + "\n")
    shutil.make_archive(str(tmp_path / "ntpsec"), "tar", tmp_path, "ntpsec-9")
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 1
    assert "ntpsec.tar holds no Unity of a stated SHA-256" in done.stderr
    assert (tmp_path / "unity" / "unity.c").is_file()


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


# -------------------------------------------------------------------------------------------------------- the images


def test_a_key_stays_with_its_owner(checkout: Path) -> None:
    """No log has it, and what holds it is the owner's alone; other flags are other images all the same."""
    bin_ = checkout / "bin"
    bin_.mkdir()
    tool = """#!/bin/sh
while [ $# -gt 1 ]; do [ "$1" = -o ] && : >"$2" && : >"${2%.o}.su"; shift; done
: >>"$1"
"""
    for name in ("gcc", "objcopy"):
        (bin_ / f"arm-none-eabi-{name}").write_text(tool)
        (bin_ / f"arm-none-eabi-{name}").chmod(0o755)
    (checkout / "model").mkdir()
    for name in ("selfcal_model.c", "selfcal_model.h", "selfcal_config.h"):
        (checkout / "model" / name).touch()
    command = ["-f", "port/stm32f405/stm32f405.mk", "stm32f405", "MODEL_DIR=model", "OUT=out"]
    path = f"{bin_}:{os.environ['PATH']}"
    flags = checkout / "out" / "flags"
    assert make(*command, "CFLAGS=-DBOARD_GATE=0", cwd=checkout, PATH=path).returncode == 0
    assert flags.read_text().split() == ["-DSENSOR=adis16405", "-DBOARD_GATE=0"]
    flags.chmod(0o644)  # as older ones are
    done = make(*command, f"CFLAGS={build_flag(bytes(range(16)))}", cwd=checkout, PATH=path)
    assert done.returncode == 0, done.stderr
    assert "@out/flags" in done.stdout
    assert "0706050403020100" not in done.stdout + done.stderr
    assert "0706050403020100" in flags.read_text()
    assert flags.stat().st_mode & 0o777 == 0o600
    assert flags.parent.stat().st_mode & 0o077 == 0
    assert "gcc" not in make(*command, f"CFLAGS={build_flag(bytes(range(16)))}", cwd=checkout, PATH=path).stdout


def test_compiler_commands_hold_no_path_of_the_checkout() -> None:
    """A checkout's path may have spaces, and make cannot quote them: sources are named from where they are compiled."""
    targets = ("build/c/plain/test_slots", "build/bench/host/O2/bench")
    said = make("--dry-run", "--always-make", *targets).stdout
    compiled = [line for line in said.splitlines() if " -c " in line and ("/objects && " in line or "host/" in line)]
    assert compiled
    assert not [line for line in compiled if str(ROOT) in line]


def test_the_files_for_the_host_name_what_there_is() -> None:
    """Each `make` target, folder and extra of the CI file, of pre-commit, of the container and of the forms."""
    rules = "".join(path.read_text(encoding="utf-8") for path in [ROOT / "Makefile", *ROOT.glob("*/**/*.mk")])
    files = [
        *(ROOT / ".github").rglob("*.yml"),
        *(ROOT / name for name in (".pre-commit-config.yaml", ".devcontainer/devcontainer.json", "CITATION.cff")),
    ]
    named = set()
    for path in files:
        text = path.read_text(encoding="utf-8")
        assert isinstance(yaml.safe_load(text), dict), path  # JSON is YAML
        named |= set(re.findall(r"make ([a-z][a-z-]*)(?=\n|\"|$)", text, re.MULTILINE))
        for place in re.findall(r"tools/setup/\S+\.sh", text):
            assert (ROOT / place).exists()
    assert {"check", "test", "docs", "setup-dev", "check-format"} <= named
    for target in named:  # `setup-dev` of a list of groups
        group = re.search(r"^OPTIONAL := (.*)$", rules, re.MULTILINE)
        assert group is not None
        groups = [f"setup-{one}" for one in group[1].split()]
        assert target in groups or re.search(rf"(^|[ :]){target}\b", rules, re.MULTILINE), target
    verbs = re.findall(r"selfcal (\w+) ", (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    assert verbs and set(verbs) <= set(selfcal.VERBS)
