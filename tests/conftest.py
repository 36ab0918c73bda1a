"""What the tests share: where the real recordings are, a loud skip where they are not; how far two reports differ."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest

from selfcal.loaders import Format, child
from selfcal.loaders.table import Hints
from selfcal.recording import Recording, load
from selfcal.result import AxisResult

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


#: Where the CPU seconds of each test go, a line each: set by tests/run.py.
SECONDS = os.environ.get("SELFCAL_SECONDS")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """The CPU seconds of a test, those of its programs included."""
    before = sum(os.times()[:4])
    result = yield
    if SECONDS:
        with Path(SECONDS).open("a", encoding="utf-8") as file:
            file.write(f"{sum(os.times()[:4]) - before:.2f} {item.nodeid}\n")
    return result


def run(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The command as a user starts it."""
    command = [*COMMAND, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, cwd=cwd)


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


def _forked(one: Format, path: Path, hints: Hints, place: Path) -> int:
    """As the product's child, without the start of a new Python for each file."""
    number = os.fork()
    if number == 0:
        code = 70
        try:
            for stream in (1, 2):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
            child.answer(one.module, path, place, hints)
            code = 0
        finally:
            os._exit(code)
    status = os.waitpid(number, 0)[1]
    return os.waitstatus_to_exitcode(status)


@pytest.fixture
def forked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Binary files are read in a fork of this process."""
    monkeypatch.setattr(child, "_spawned", _forked)


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
