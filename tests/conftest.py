"""What the tests share: where the real recordings are, a loud skip where they are not; how far two reports differ."""

from __future__ import annotations

import ast
import io
import os
import select
import shlex
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Generator, Iterator
from contextlib import redirect_stderr
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

import selfcal
from selfcal import cli
from selfcal.bank.axis_result import AxisResult
from selfcal.logs import recording as recording_module
from selfcal.logs.loaders import Format, child
from selfcal.logs.loaders.table import Hints
from selfcal.logs.recording import Recording, load, save
from selfcal.logs.written import laid_out
from selfcal.model.file import SENSORS

# A shell's background job ignores an interrupt, and so would every program that a test starts and interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)
# So does one under nohup a hang-up.
signal.signal(signal.SIGHUP, signal.SIG_DFL)

ROOT = Path(__file__).resolve().parents[1]
#: Folders whose modules the tests of every room import by name.
ROOMS = ("common", "agree", "bench", "cases", "hidden", "port", "tools", "lib", "../host_sim")
sys.path[:0] = [str((ROOT / "tests" / room).resolve()) for room in ROOMS]
#: The recordings' licence keeps them out of this repository.
SHARED_DATA = Path(os.environ.get("SELFCAL_DATA", ROOT.parent / "shared" / "data"))
#: Small logs of the kinds that people report, each written by a script of its own.
SHARED_CASES = Path(os.environ.get("SELFCAL_CASES_DIR", ROOT.parent / "shared" / "cases"))
#: Records of each kind in `test_cases_*.py`. 0: `make test`, a few. 1: `make cases`, as many as each test wants.
CASE_RECORDS = int(os.environ.get("SELFCAL_CASES", "0"))
COMMAND = [str(Path(sys.executable).with_name("selfcal"))]
#: The command in a printed line, which runs when it is pasted.
CALLED = "selfcal" if shutil.which("selfcal") == COMMAND[0] else shlex.quote(COMMAND[0])


#: SELFCAL_CAMPAIGN=N (`make campaigns`): fault campaigns with N times as many trials.
CAMPAIGN = int(os.environ.get("SELFCAL_CAMPAIGN", "1"))
#: Tests that `make test` leaves to these two, a line each.
LONG_TESTS = ROOT / "tests" / "long_tests.txt"
#: Names of all tests that were found, the long ones too.
COLLECTED = pytest.StashKey[set[str]]()

#: Where the CPU seconds of each test go, a line each: set by tests/run.py.
SECONDS = os.environ.get("SELFCAL_SECONDS")


def long_tests() -> tuple[set[str], set[str]]:
    """Of LONG_TESTS: names that are left out, and of these the ones with parameters that are kept."""
    left: set[str] = set()
    kept: set[str] = set()
    last = ""
    for line in LONG_TESTS.read_text(encoding="utf-8").splitlines():
        if line.startswith("    keeps "):
            kept.add(last + line.removeprefix("    keeps "))
        elif line and not line.startswith("#"):
            left.add(last := line)
    return left, kept


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests of LONG_TESTS, but in a long run, and where one is asked for by its name."""
    config.stash[COLLECTED] = {item.nodeid for item in items}
    if CAMPAIGN > 1 or CASE_RECORDS or any("::" in argument for argument in config.args):
        return
    left, kept = long_tests()
    long = {i for i in items if i.nodeid not in kept and left & {i.nodeid, i.nodeid.partition("[")[0]}}
    config.hook.pytest_deselected(items=list(long))
    items[:] = [item for item in items if item not in long]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """The CPU seconds of a test, those of its programs included."""
    before = sum(os.times()[:4])
    result = yield
    if SECONDS:
        with Path(SECONDS).open("a", encoding="utf-8") as file:
            file.write(f"{sum(os.times()[:4]) - before:.2f} {item.nodeid}\n")
    return result


#: s that a command of run() may take.
TIMEOUT_S = 120


@cache
def _loaded(verb: str) -> None:
    """Import once for all forks what a verb imports when it runs."""
    for node in ast.walk(ast.parse(selfcal.VERBS[verb].read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            import_module(node.module)


def run(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The command as a user starts it, in a fork of this process: a new Python, which takes longer than most commands,
    is not started for each. test_cli.py starts the program itself as well."""
    if arguments and arguments[0] in selfcal.VERBS:
        _loaded(str(arguments[0]))
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        number = os.fork()
        if number == 0:
            _command([str(argument) for argument in arguments], cwd, out.fileno(), err.fileno())
        code = _ended(number)
        said = []
        for stream in (out, err):
            stream.seek(0)
            said.append(stream.read().decode())
    return subprocess.CompletedProcess([*COMMAND, *map(str, arguments)], code, *said)


def _command(arguments: list[str], cwd: Path | None, out: int, err: int) -> NoReturn:
    """In the fork: the command, and the end of the process."""
    code = 70
    try:
        for stream, number in ((os.open(os.devnull, os.O_RDONLY), 0), (out, 1), (err, 2)):
            os.dup2(stream, number)
        os.chdir(cwd or ".")
        sys.argv = [*COMMAND, *arguments]
        warnings.resetwarnings()
        utf_8 = {"closefd": False, "encoding": "utf-8"}
        with open(1, "w", **utf_8) as sys.stdout, open(2, "w", **utf_8) as sys.stderr:
            try:
                cli.main()
            except SystemExit as error:
                code = error.code if isinstance(error.code, int) else int(error.code is not None)
            except BaseException:
                traceback.print_exc()
                code = 1
    finally:
        os._exit(code)


def _ended(number: int) -> int:
    """Exit code of a child process, which is ended if it does not end by itself."""
    child = os.pidfd_open(number)
    try:
        if not select.select([child], [], [], TIMEOUT_S)[0]:
            os.kill(number, signal.SIGKILL)
            raise TimeoutError(f"a command did not end within {TIMEOUT_S} s")
    finally:
        os.close(child)
        status = os.waitpid(number, 0)[1]
    return os.waitstatus_to_exitcode(status)


def _multicast() -> bool:
    """Whether this machine's network takes a multicast group: a machine without any route does not."""
    group = socket.inet_aton("239.74.163.2") + struct.pack("@I", socket.INADDR_ANY)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as attempt:
        try:
            attempt.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        except OSError:
            return False
    return True


needs_multicast = pytest.mark.skipif(not _multicast(), reason="NO MULTICAST: ip route add 239.74.163.2 dev lo")


def _forked(one: Format, path: Path, hints: Hints, answer: int, _folder: str) -> int:
    """As the product's child, without the start of a new Python and of the reader's library for each file."""
    for module in (f"selfcal.logs.loaders.{one.module}", one.library):
        if module:
            import_module(module)
    number = os.fork()
    if number == 0:
        code = 70
        try:
            for stream in (1, 2):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
            child.answer(one.module, path, hints, answer)
            code = 0
        finally:
            os._exit(code)
    return number


@pytest.fixture
def forked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Binary files are read in a fork of this process."""
    monkeypatch.setattr(child, "_spawned", _forked)


def assert_alike(one: Recording, other: Recording) -> None:
    """Both hold the same, to the bit: columns, units, readings, clocks."""
    assert list(one.columns) == list(other.columns)
    assert one.started_s == other.started_s
    for name, column in one.columns.items():
        again = other.columns[name]
        assert again.unit == column.unit
        assert np.array_equal(again.values, column.values, equal_nan=True), name
        assert (again.clock is None) == (column.clock is None)
        clock, found = one.clock_of(name), other.clock_of(name)
        assert (found.rate_hz, found.start_s) == (clock.rate_hz, clock.start_s)
        assert np.array_equal(found.missing_before, clock.missing_before)
        assert (found.off_grid_s is None) == (clock.off_grid_s is None)
        assert clock.off_grid_s is None or np.array_equal(found.off_grid_s, clock.off_grid_s)


#: Readings of a recording up to which a test of `reads_back` writes it as a text as well, and at all.
FEW, MANY = 3000, 200_000


@pytest.fixture
def reads_back(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Every recording that the test loads is written as `convert` does, and reads back as the same."""
    notes_of = recording_module._rates

    def checked(loaded: Recording) -> list[str]:
        held = sum(one.values.size for one in loaded.columns.values())
        # A model file may name axes of its own; `convert` reads the usual ones.
        if loaded.meta.get("read back") is None and held <= MANY and set(loaded.columns) & set(SENSORS):
            folder = tmp_path_factory.mktemp("again")
            laid = laid_out(loaded)
            for name in ("again.npz", "again.csv")[: 2 if held <= FEW else 1]:
                with redirect_stderr(io.StringIO()):
                    save(folder / name, laid.columns, loaded.rate_hz, {**laid.meta, "read back": 1}, laid.t, exact=True)
                    assert_alike(loaded, load(folder / name))
            shutil.rmtree(folder)
        return notes_of(loaded)

    monkeypatch.setattr(recording_module, "_rates", checked)


def shared_recording(name: str) -> Recording:
    """A real ADIS16405 recording, or a skip that says what is missing."""
    path = SHARED_DATA / name
    if not path.exists():
        pytest.skip(f"REAL DATA ABSENT: {path} (see README, 'Real recordings')")
    return load(path)


def shared_case(name: str, folder: Path, *arguments: str) -> Path:
    """The log of a case, written into `folder` where the case is a script, or a skip that says what is missing."""
    path = SHARED_CASES / name
    if not path.exists():
        pytest.skip(f"CASES ABSENT: {path} (see tests/README.md)")
    if path.suffix != ".py":
        return path
    before = set(folder.iterdir())
    subprocess.run([sys.executable, path, *arguments], cwd=folder, check=True, timeout=120)
    (log,) = set(folder.iterdir()) - before
    return log


def case_records(few: int, many: int) -> int:
    """Records of a kind: `few` in `make test`; in `make cases` `many`, or RECORDS where that is given."""
    return few if not CASE_RECORDS else many if CASE_RECORDS == 1 else CASE_RECORDS


def worst_difference(report: AxisResult, exact: AxisResult) -> tuple[float, float, float, float]:
    """Largest |d ln evidence|, |dP|, |d mean|/sd and |sd ratio - 1| over the laws that are not ruled out (P > 1 %), dP
    over all; NaN where one is."""
    evidence, mean, sd = [0.0], [0.0], [0.0]
    for law in (law for law, p in exact.probability.items() if not p < 0.01):
        evidence.append(abs(report.log_evidence[law] - exact.log_evidence[law]))
        for name, value in exact.parameters[law].items():
            found = report.parameters[law][name]
            mean.append(abs(found.mean - value.mean) / value.sd)
            sd.append(abs(found.sd / value.sd - 1.0))
    probability = [abs(p - report.probability[law]) for law, p in exact.probability.items()]
    return float(np.max(evidence)), float(np.max(probability)), float(np.max(mean)), float(np.max(sd))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Debian's chromium, headless."""
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("NO BROWSER: the page is not looked at in one (apt-get install chromium)")
    api = pytest.importorskip("playwright.sync_api", reason="NO BROWSER: playwright is missing (make setup-dev)")
    with api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=program)
        yield chromium
        chromium.close()
