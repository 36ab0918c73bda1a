"""A wheel in an environment of its own: the source archive builds it, and every verb runs from an empty folder.

`make test` looks at the source archive and at the code that is compiled here. `make cases` builds the wheel, unless
SELFCAL_WHEEL names one. Truth: a verb writes what this tree's own writes, to the last bit. Where a program is missing,
one line says how to get it.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import zipfile
from email.parser import HeaderParser
from pathlib import Path

import pytest

import selfcal
from selfcal.logs.loaders import FORMATS
from selfcal.wire import package_codegen
from selfcal.wire.frames import SHIPPED

from conftest import CASE_RECORDS, ROOT

#: Verbs that the test below calls. Those of helpers that need a module or hours answer `--help`.
HELP_ALONE = {"command", "montecarlo", "rivals", "worth", "navigate", "paper"}
BUILD_SDIST = "import sys, scikit_build_core.build as build; build.build_sdist(sys.argv[1])"
#: Instructions that not every x86-64 has: AVX, FMA, BMI.
NEWER = re.compile(r"\t(v(?!err|erw)\w+|andn|mulx|pdep|pext|sarx|shlx|shrx|rorx)\s")


#: With what builds the package, which lies beside the environment.
BUILDING = {**os.environ, "PYTHONPATH": str(ROOT / ".venv" / "backend")}


def archive(folder: Path) -> Path:
    """The source archive."""
    command = [sys.executable, "-c", BUILD_SDIST, folder]
    done = subprocess.run(command, cwd=ROOT / "tools", env=BUILDING, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (made,) = folder.glob("*.tar.gz")
    return made


def test_a_source_archive_is_whole(tmp_path: Path) -> None:
    """Every source that git has of lib/, port/ and host_sim/, the demo's recording, the licence; nothing else of the
    tree. Its metadata name page, licence and extras."""
    made = archive(tmp_path)
    with tarfile.open(made) as file:
        top = made.name.removesuffix(".tar.gz")
        names = {name.removeprefix(f"{top}/") for name in file.getnames()}
        told = file.extractfile(f"{top}/PKG-INFO")
        assert told is not None
        metadata = HeaderParser().parsestr(told.read().decode())
    listed = subprocess.run(
        ["git", "ls-files", "lib", "port", "host_sim"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    tree = {name.removeprefix("selfcal/tree/") for name in names if name.startswith("selfcal/tree/")}
    assert set(listed.stdout.split()) <= tree
    assert SHIPPED.relative_to(ROOT).as_posix() in tree
    assert {"selfcal/py.typed", "LICENSE", "README.md", "CMakeLists.txt"} <= names
    assert metadata["Version"] == package_codegen.version(ROOT / "lib")
    assert metadata["License-Expression"] == "MIT"
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert {one.extra for one in FORMATS if one.extra} <= set(metadata.get_all("Provides-Extra") or ())


@pytest.mark.skipif(os.uname().machine != "x86_64" or shutil.which("objdump") is None, reason="reads x86-64 code")
def test_compiled_code_runs_on_every_processor() -> None:
    """But for the builds for newer ones, which are loaded where the processor is one."""
    from selfcal import _fixed

    modules = sorted(Path(_fixed.__file__).parent.glob("_*.so"))
    assert len(modules) >= 8
    for module in modules:
        code = subprocess.run(
            ["objdump", "-d", "--no-show-raw-insn", module], capture_output=True, text=True, check=True
        ).stdout
        newer = len(NEWER.findall(code))
        assert (newer > 0) == module.stem.split(".")[0].endswith(("_fma", "_avx2")), (module.name, newer)


@pytest.mark.skipif("_library32_fma" not in selfcal._library32.__name__, reason="no fused multiply-add here")
@pytest.mark.skipif("_likelihood_avx2" not in selfcal._likelihood.__name__, reason="no vectors of four doubles here")
def test_both_builds_give_the_same_numbers() -> None:
    """Bit by bit: a record, its report, and the whole state; sums, shifts and slopes of models of 1 to 24 states,
    and of six axes together."""
    script = """
import hashlib, sys
import numpy as np
import selfcal
if sys.argv[1] == "plain":
    selfcal._newer = lambda name: ""
from selfcal import _joint, _library32, _likelihood
from selfcal.bank.library import Bank
from selfcal.model.file import DEFAULT, Model
from selfcal.model.tables import make_tables
for name in ("default", "sums"):
    bank = Bank(make_tables(Model.load(DEFAULT.with_name(f"{name}.yaml")), 10.0, ("gx", "ay"), bank_rate_hz=10.0))
    noise = np.random.default_rng(3).normal(size=(2, 4000, 2))
    bank.push(0.02 * noise[0] + 1e-3 * np.cumsum(noise[1], axis=0))
    print(_library32.__name__, hashlib.sha256(bank.raw.save()).hexdigest(), bank.report(0), bank.report(1))
from selfcal.likelihood.fit import Series, fit_at, passed, shifts, slopes
from selfcal.likelihood.statemodel import Terms
noise = np.random.default_rng(4).normal(size=(3, 1500))
y = noise[0] + 0.1 * np.cumsum(noise[1])
y[200:207] = np.nan
r = np.where(np.arange(1500) < 900, 1.0, 2.0)
series = Series(y, 0.5, r, np.array([np.ones(1500), noise[2], np.arange(1500.0)]))
some = [Terms(walk=True), Terms(walk=True, color="ma"), Terms(markov=True, flicker=True, oscillation=True)]
some += [Terms(flicker=True, oscillation=True, color="ar", bands=((5.0, 0.05, 0.1), (3.0, 0.07, -1.0)) * 3)]
for terms in some:
    theta = np.array(terms.limits(0.5)).mean(axis=1) + 0.1
    numbers = [*passed(series, terms, theta, [700, 1500], True)]
    found = shifts(series, terms, theta)
    numbers += [found.A, found.B, found.impulse, *slopes(series, fit_at(series, terms, theta))]
    print(_likelihood.__name__, hashlib.sha256(b"".join(one.tobytes() for one in numbers)).hexdigest())
from selfcal.likelihood.joint import Joint, course, information
own = np.tile([0.1, -4.0, -1.5, -4.0], (6, 1)) + 0.1 * np.arange(6.0)[:, None]
model = Joint(own, 0.6 * np.eye(6) + 0.4, np.linspace(0.2, 0.9, 6), 0.02)
y = np.random.default_rng(5).normal(size=(6, 1500))
y[2:4, 500:503] = np.nan
found = course(model, y, smooth=True)
numbers = [found.innovations, found.f, found.weights, found.of_f, found.known, information(model, y, y[:2])]
print(_joint.__name__, found.ln_likelihood, hashlib.sha256(b"".join(map(bytes, numbers))).hexdigest())
"""
    said = {
        build: subprocess.run([sys.executable, "-c", script, build], capture_output=True, text=True, check=True).stdout
        for build in ("newer", "plain")
    }
    assert said["newer"].replace("_fma", "").replace("_avx2", "") == said["plain"]
    assert [said["newer"].count(one) for one in ("_library32_fma", "_likelihood_avx2", "_joint_avx2")] == [2, 4, 1]


class Installed:
    """The wheel in an environment that has the packages of this one, in a folder from which no tree can be seen."""

    def __init__(self, folder: Path) -> None:
        if "SELFCAL_WHEEL" in os.environ:
            self.wheel = Path(os.environ["SELFCAL_WHEEL"])
        else:
            source = archive(folder)
            self._pip("wheel", "--no-build-isolation", "--no-deps", "--wheel-dir", folder, source)
            (self.wheel,) = folder.glob("*.whl")
        self.environment = folder / "environment"
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", self.environment], check=True)
        self._pip("--python", self.environment / "bin" / "python", "install", "--no-deps", self.wheel)
        (site,) = self.environment.glob("lib/python*/site-packages")
        # Found last, and without what the .pth files in there lead to: the tree.
        (site / "packages.pth").write_text(str(Path(pytest.__file__).parents[1]))
        self.folder = folder / "empty"
        self.folder.mkdir()
        self.cache = folder / "cache"

    @staticmethod
    def _pip(*arguments: str | Path) -> None:
        command = [sys.executable, "-m", "pip", *arguments]
        done = subprocess.run(command, env=BUILDING, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr

    def start(self, *arguments: str | Path, path: str | None = None) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [self.environment / "bin" / "selfcal", *arguments],
            cwd=self.folder,
            env={"PATH": path or os.environ["PATH"], "HOME": str(self.folder), "XDG_CACHE_HOME": str(self.cache)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, *arguments: str | Path, path: str | None = None) -> subprocess.CompletedProcess[str]:
        with self.start(*arguments, path=path) as process:
            out, err = process.communicate(timeout=900)
        assert "Traceback" not in err, err
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)

    def check(self, *arguments: str | Path) -> str:
        done = self.run(*arguments)
        assert done.returncode == 0, (arguments, done.stdout[-2000:], done.stderr[-2000:])
        return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    if not CASE_RECORDS:
        pytest.skip("a wheel takes minutes to build: make cases")
    return Installed(tmp_path_factory.mktemp("wheel"))


def test_what_the_wheel_has(installed: Installed) -> None:
    """Its package is the one that runs, and holds no second copy of what only builds it."""
    names = zipfile.ZipFile(installed.wheel).namelist()
    assert {"selfcal/py.typed", "selfcal/tree/lib/selfcal.h", "selfcal/tree/port/qemu/qemu.mk"} <= set(names)
    assert not [name for name in names if "host_sim" in name]
    script = "import selfcal.wire.frames as wire; print(wire.ROOT)"
    python = installed.environment / "bin" / "python"
    root = subprocess.run([python, "-c", script], cwd=installed.folder, capture_output=True, text=True, check=True)
    assert Path(root.stdout.strip()).is_relative_to(installed.environment)


def test_every_verb_runs(installed: Installed) -> None:
    """In an empty folder, one after the other over what they write themselves."""
    log, model = installed.folder / "log.csv", installed.folder / "my.yaml"
    shutil.copy(ROOT / "tools" / "selfcal" / "model" / "models" / "default.yaml", model)
    for name in ("shipped.npz", "again.npz"):
        shutil.copy(SHIPPED, installed.folder / name)
    calls: dict[str, list[str | Path]] = {
        "simulate": [model, "-o", log, "--seed", "5"],
        "identify": [log, "--json", "identify.json"],
        "diagnose": ["shipped.npz", "--end", "900", "--axis", "gx", "--report", "page.html"],
        "compare": ["shipped.npz", "again.npz", "--end", "900", "--axis", "gx"],
        "convert": [log, "-o", "log.npz"],
        "codegen": [model, "-o", "tables", "--rate", "100"],
        "replay": ["log.npz", "--json", "replay.json"],
        "dbc": [model, "-o", "my.dbc"],
        "monitor": ["--help"],
        **{verb: ["--help"] for verb in HELP_ALONE},
    }
    for verb, arguments in calls.items():
        installed.check(verb, *arguments)
    for verb in set(selfcal.VERBS) - set(calls) - {"demo"}:
        installed.check(verb, "--help")
    # Text has not every digit of a reading, so that both read the text.
    for name, own in (("identify", selfcal.identify(log)), ("replay", selfcal.replay(log.with_suffix(".npz")))):
        found = json.loads((installed.folder / f"{name}.json").read_text())
        assert found["axes"] == json.loads(json.dumps(own))["axes"]


def test_without_a_compiler(installed: Installed, tmp_path: Path) -> None:
    """Plain `replay` needs none. Whatever does says so in a line."""
    shutil.copy(SHIPPED, installed.folder / "shipped.npz")
    bare = str(tmp_path)
    done = installed.run("replay", "shipped.npz", "--axis", "gx", path=bare)
    assert done.returncode == 0, done.stderr
    for arguments, programs in (
        (["demo"], "no make and no cc here: on Debian `apt install make gcc libc6-dev`"),
        (["replay", "shipped.npz", "--transport", "slcan"], "no make and no cc here"),
        (["replay", "shipped.npz", "--target", "cortex-m0"], "gcc-arm-none-eabi"),
    ):
        done = installed.run(*arguments, path=bare)
        errors = [line for line in done.stderr.splitlines() if "selfcal: error: " in line]
        assert done.returncode == 2 and len(errors) == 1 and programs in errors[0], done.stderr


def test_with_one(installed: Installed) -> None:
    """Firmware for this machine and for a core, made of the wheel's own sources."""
    shutil.copy(SHIPPED, installed.folder / "shipped.npz")
    for options in (["--transport", "slcan"], ["--target", "cortex-m4f", "--axis", "gx"]):
        installed.check("replay", "shipped.npz", "--json", "module.json", *options)
    with installed.start("demo", "--speed", "100") as demo:
        assert demo.stdout is not None
        said = [demo.stdout.readline() for _ in range(2)]
        assert "watch it by:" in said[1], said
        watch = said[1].partition(" monitor ")[2].split()
        installed.check("monitor", *watch, "--duration", "10", "--json", "monitor.json")
        demo.send_signal(signal.SIGINT)
        assert demo.wait(30) == 0
