"""Holes: what once ended a command by a traceback, hung it, or lost a file. Many of each kind in `make cases`."""

from __future__ import annotations

import importlib.util
import lzma
import os
import random
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from scipy.io import savemat

from selfcal.base.errors import UserError
from selfcal.batch.spread import Row, spread
from selfcal.logs.recording import load
from selfcal.model.file import Model
from selfcal.studies.methods.problem import Problem
from selfcal.studies.rivals import measured
from selfcal.verbs.montecarlo import montecarlo
from selfcal.verbs.navigate import navigate
from selfcal.verbs.paper import paper
from selfcal.verbs.rivals import rivals
from selfcal.verbs.worth import worth

from conftest import COMMAND, case_records

# ------------------------------------------------------------------------------------------- finished work is read back


def uneven(job: int) -> list[Row]:
    """Rows of unequal keys and orders, with every kind of value that a row may have."""
    rows: list[Row] = [{"law": "a", "seed": job, "mean.N": 0.1 * job, "none": None}]
    rows += [{"law": "b", "mean.K": -1.0 / (job + 1), "mean.N": float("nan"), "seed": job, "wrong": job % 2 == 0}]
    return rows if job % 3 else [*rows[::-1], {}]


def test_rows_of_unequal_keys_are_read_back_as_they_were(tmp_path: Path) -> None:
    """Keys, their order and the kinds of their values, of a run that computes nothing."""
    jobs = range(case_records(25, 500))
    first = spread(uneven, jobs, results=tmp_path)
    again = spread(uneven, jobs, results=tmp_path)
    assert repr(again) == repr(first) == repr([row for job in jobs for row in uneven(job)])


#: A verb with --results at its smallest, by name.
STUDIES: dict[str, Callable[[Path, Path], object]] = {
    "montecarlo": lambda file, kept: montecarlo(records=3, duration_s=60.0, json=file, results=kept),
    "rivals": lambda file, kept: rivals(records=2, samples=(60,), only=("ml", "whittle"), json=file, results=kept),
    "worth": lambda file, kept: worth(records=2, json=file, results=kept),
    "navigate": lambda file, kept: navigate(records=2, json=file, results=kept),
    "paper": lambda file, kept: paper(file, records=2, results=kept),
}


@pytest.mark.parametrize("name", STUDIES)
def test_every_verb_goes_on_from_its_results(tmp_path: Path, name: str) -> None:
    """From whole results, and with a part lost: the output has equal bytes, and whole parts are not written anew."""
    if name in ("rivals", "navigate", "paper") and not case_records(0, 1):
        pytest.skip("SLOW: make cases")
    kept = tmp_path / "kept"
    outputs: list[bytes] = []
    parts: list[Path] = []
    for turn in range(3):
        if turn == 2:
            parts.pop().unlink()
        before = {path: path.stat().st_mtime_ns for path in parts}
        STUDIES[name](tmp_path / f"out{turn}", kept)
        outputs.append((tmp_path / f"out{turn}").read_bytes())
        assert {path: path.stat().st_mtime_ns for path in before} == before
        parts = sorted(kept.glob("*.json"))
        assert parts
    assert outputs[1] == outputs[0]
    if name != "rivals":  # a part made anew has other seconds
        assert outputs[2] == outputs[0]


# --------------------------------------------------------------------------------------------------- a killed worker


def deadly(job: int) -> list[Row]:
    """Row of a job; one worker kills itself."""
    if job == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return [{"job": job}]


def test_a_killed_worker_ends_the_command_in_one_line() -> None:
    """The out-of-memory killer ends a worker like this."""
    start = time.monotonic()
    with pytest.raises(UserError, match=r"^a worker process was killed.*--results DIR keeps finished records$"):
        spread(deadly, range(12))
    assert time.monotonic() - start < 60.0


def slow(folder: Path, job: int) -> list[Row]:
    """Says who works, then works for long."""
    (folder / f"{os.getpid()}").touch()
    time.sleep(300.0)
    return []


def ended(number: int) -> bool:
    """Whether a process is no more, or a zombie that nobody waits for."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


PROGRAM = """
import sys
from functools import partial
from pathlib import Path
sys.path[:] = {path!r}
from selfcal.base import ending
from selfcal.batch.spread import spread
from test_cases_holes import slow
ending.install_signals()
spread(partial(slow, Path(sys.argv[1])), range(4))
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM] if case_records(0, 1) else [signal.SIGKILL])
def test_workers_end_with_their_command(tmp_path: Path, number: signal.Signals) -> None:
    """However it ends: none is left to work for nobody."""
    program = PROGRAM.format(path=sys.path)
    command = subprocess.Popen([sys.executable, "-c", program, tmp_path], stderr=subprocess.DEVNULL)
    within(60.0, lambda: any(tmp_path.iterdir()))
    command.send_signal(number)
    assert command.wait(60.0) != 0
    workers = [int(path.name) for path in tmp_path.iterdir()]
    within(60.0, lambda: all(map(ended, workers)))


def within(seconds: float, true: Callable[[], bool]) -> None:
    """Wait until something is true; fails after `seconds`."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


class Deadly:
    """A method of `rivals` that does not come back."""

    title, missing = "deadly", ""

    def load(self) -> object:
        return os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_rival_is_no_answer() -> None:
    """The others go on."""
    group = Model.load().group_of("gx")
    problem = Problem(np.zeros(50), 1.0, group, ("constant",))
    assert measured(cast(Any, Deadly()), problem, "deg/s") == {"title": "deadly", "error": "it ended without an answer"}


@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="DASK ABSENT: make setup-cluster")
@pytest.mark.parametrize("address", ["tls://127.0.0.1:9", "ucx://127.0.0.1:9", "inproc://1", "nowhere", "x://y", "\n"])
def test_a_scheduler_that_cannot_be_is_one_line(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each kind of address fails in its own way."""
    monkeypatch.setattr("selfcal.batch.spread.PATIENCE_S", 0.5)
    with pytest.raises(UserError, match=r"^--scheduler .*: no Dask scheduler answers \(.*\): start one with") as caught:
        spread(uneven, range(2), scheduler=address)
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------------------ files that lie


def mutations(data: bytes, chance: random.Random) -> bytes:
    """`data` with a few bytes, words of four bytes, or pieces changed, so that much of it stays sound."""
    made = bytearray(data)
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        if not made:
            break
        at = chance.randrange(len(made))
        match chance.randrange(4):
            case 0:
                made[at] = chance.randrange(256)
            case 1:
                at -= at % 4
                made[at : at + 4] = struct.pack("<I", chance.choice((0, 1, 2, 8, 255, 2**16, 2**31 - 1, 2**32 - 1)))
            case 2:
                at -= at % 4
                made[at : at + 1] = bytes([chance.randrange(32)])
            case 3:
                del made[at : at + chance.choice((1, 4, 8, 100))]
    return bytes(made)


def refused_in_one_line(read: Callable[[], Any], path: Path) -> str:
    """The line of what is refused; empty if it is not. Anything else fails."""
    try:
        read()
    except UserError as error:
        said = str(error)
        assert said.startswith(str(path)) and "\n" not in said and len(said) < 1000, said
        return said
    return ""


STATED: dict[str, Any] = {"units": {"gx": "deg/s", "gy": "deg/s"}, "rate": 100.0}


@pytest.mark.usefixtures("forked")
def test_changed_matlab_files(tmp_path: Path) -> None:
    """Versions 4 and 5, and packed. A crash of the reader is no answer."""
    arrays = {"gx": np.random.default_rng(2).normal(size=8), "gy": np.arange(8, dtype="i2"), "meta": '{"rate_hz": 100}'}
    chance = random.Random("mat")
    for form, packed in (("5", False), ("5", True), ("4", False)):
        log = tmp_path / "log.mat"
        savemat(log, arrays, format=form, do_compression=packed)
        assert load(log, **STATED).samples == 8
        whole = log.read_bytes()
        for _ in range(case_records(40, 2000)):
            log.write_bytes((packed_again if packed else mutations)(whole, chance))
            assert "(signal" not in refused_in_one_line(lambda: load(log, **STATED), log)  # noqa: B023


def packed_again(data: bytes, chance: random.Random) -> bytes:
    """A MATLAB file whose packed variables are changed inside."""
    made, at = data[:128], 128
    while at + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, at)
        inside = mutations(zlib.decompress(data[at + 8 : at + 8 + size]), chance)
        packed = zlib.compress(inside)
        made += struct.pack("<II", kind, len(packed)) + packed
        at += 8 + size
    return made


@pytest.mark.usefixtures("forked")
def test_a_type_number_that_there_is_not(tmp_path: Path) -> None:
    """264 bytes: the kind of the element with the numbers is none. scipy took it for the place of a type: SIGSEGV."""
    path = tmp_path / "log.mat"
    savemat(path, {"gx": np.arange(8.0)})
    data = path.read_bytes()
    at = len(data) - 8 * 8 - 8
    for kind in (0, 8, 10, 11, 14, 15, 19, 77, 255, 0x7FFF, 0xFFFF):
        path.write_bytes(data[:at] + struct.pack("<I", kind) + data[at + 4 :])
        assert "numbers of a kind" in refused_in_one_line(lambda: load(path, **STATED), path)


def r_word(*numbers: int) -> bytes:
    return struct.pack(f">{len(numbers)}i", *numbers)


def r_symbol(text: str) -> bytes:
    return r_word(1, 0x40009, len(text)) + text.encode()


def r_sequence(name: str, length: float) -> bytes:
    """An object of the compact form 1:length (R Internals, ALTREP): some 100 bytes of a file, however long."""
    info = r_word(2) + r_symbol("compact_intseq") + r_word(2) + r_symbol("base") + r_word(2, 13, 1, 13, 254)
    state = r_word(14, 3) + struct.pack(">3d", length, 1.0, 1.0)
    return r_word(0x402) + r_symbol(name) + r_word(238) + info + state + r_word(254)


def r_file(objects: bytes) -> bytes:
    return b"RDX3\nX\n" + r_word(3, 0x40000, 0x30500, 5) + b"UTF-8" + objects + r_word(254)


def peak_of(command: Sequence[str | Path]) -> tuple[int, str]:
    """Largest memory in use, bytes, and the messages of a command."""
    program = (
        "import resource, subprocess, sys; "
        "print(subprocess.run(sys.argv[1:], capture_output=True, text=True).stderr.strip()); "
        "print(1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    done = subprocess.run([sys.executable, "-c", program, *command], capture_output=True, text=True, check=True)
    said, _, peak = done.stdout.strip().rpartition("\n")
    return int(peak), said


@pytest.mark.parametrize("kind", ["sequences", "xz"] if case_records(0, 1) else ["sequences"])
def test_a_small_r_file_takes_little_memory(tmp_path: Path, kind: str) -> None:
    """Ten compact sequences, each below the bound of one; zeros that pack to a thousandth. Both asked for GBs. Truth:
    64 MiB is what a small file may unpack to, each number is held three times, and the tools take 200 MB."""
    if kind == "sequences":
        name, data = "log.rda", r_file(b"".join(r_sequence(f"x{k}", 6e6) for k in range(10)))
    else:
        zeros = r_file(r_word(0x402) + r_symbol("gx") + r_word(13, 2**24 + 1) + bytes(2**26 + 4))
        name, data = "log.rda", lzma.compress(zeros, preset=0)
    path = tmp_path / name
    path.write_bytes(data)
    assert len(data) < 50_000
    peak, said = peak_of([*COMMAND, "identify", path, "--rate", "100"])
    assert ("a sequence of 6e+06 numbers" if kind == "sequences" else "it unpacks to more than 64 MiB") in said
    assert "\n" not in said
    assert peak < 450e6


@pytest.mark.usefixtures("forked")
def test_changed_r_files(tmp_path: Path) -> None:
    """Numbers, integers and compact sequences in one file, plain and packed: no exception but the one line."""
    numbers = r_word(0x402) + r_symbol("gx") + r_word(14, 8) + struct.pack(">8d", *range(8))
    integers = r_word(0x402) + r_symbol("gy") + r_word(13, 8, *range(8))
    sound = r_file(numbers + integers + r_sequence("t", 8.0))
    stated = {"units": {"gx": "deg/s", "gy": "deg/s", "t": "s"}}
    path = tmp_path / "log.rda"
    path.write_bytes(sound)
    assert load(path, **stated).samples == 8
    chance = random.Random("r")
    refused = 0
    trials = case_records(60, 2000)
    for k in range(trials):
        made = mutations(sound, chance)
        path.write_bytes(lzma.compress(made, preset=0) if k % 3 == 2 else made)
        refused += refused_in_one_line(lambda: load(path, **stated), path) != ""
    assert refused > trials / 4
