"""Work over many processors: the same rows whoever computes them, and nothing finished is lost.

Truth: squares, and the same work in this process, bit by bit.
"""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from selfcal.base.errors import UserError
from selfcal.batch import spread as module
from selfcal.batch.spread import Kept, Row, record_seeds, spread
from selfcal.verbs.montecarlo import montecarlo

CLUSTER = importlib.util.find_spec("distributed") is not None
needs_cluster = pytest.mark.skipif(not CLUSTER, reason="DASK ABSENT: make setup-cluster")


def squares(log: Path | None, job: int) -> list[Row]:
    """A row a job, and a line in `log` for each that is computed."""
    if log is not None:
        with log.open("a") as file:
            file.write(f"{job}\n")
    return [{"job": job, "square": job**2, "text": "a" if job % 2 else None}]


EXPECTED = [{"job": job, "square": job**2, "text": "a" if job % 2 else None} for job in range(20)]


def test_rows_come_in_the_order_of_the_jobs() -> None:
    assert spread(partial(squares, None), range(20)) == EXPECTED


def test_finished_work_is_kept(tmp_path: Path) -> None:
    """A run that lost a job computes that job alone. More jobs add to what is there."""
    log, folder = tmp_path / "log", tmp_path / "kept"
    work = partial(squares, log)
    assert spread(work, range(18), settings={"a": 1}, results=folder) == EXPECTED[:18]
    Kept(folder, {"a": 1}).place(8).unlink()
    log.write_text("")
    assert spread(work, range(18), settings={"a": 1}, results=folder) == EXPECTED[:18]
    assert log.read_text().split() == ["8"]
    log.write_text("")
    assert spread(work, range(20), settings={"a": 1}, results=folder) == EXPECTED
    assert sorted(map(int, log.read_text().split())) == [18, 19]


def test_other_settings_are_another_work_and_a_broken_job_is_made_anew(tmp_path: Path) -> None:
    """In one folder. A job with an error is done again each time."""
    log, folder = tmp_path / "log", tmp_path / "kept"
    work = partial(squares, log)
    spread(work, range(4), settings={"a": 1}, results=folder)
    assert spread(work, range(4), settings={"a": 2}, results=folder) == EXPECTED[:4]
    assert len(log.read_text().split()) == 8 and len(list(folder.iterdir())) == 8
    for job, text in ((0, '[{"job": 0'), (1, '{"job": 0}')):
        Kept(folder, {"a": 2}).place(job).write_text(text)
    assert spread(work, range(4), settings={"a": 2}, results=folder) == EXPECTED[:4]
    assert len(log.read_text().split()) == 10
    for _ in range(2):
        assert spread(failing, range(2), results=folder) == [{"error": "0"}, {"error": "1"}]
    assert len(list(folder.iterdir())) == 8


def failing(job: int) -> list[Row]:
    return [{"error": str(job)}]


def test_an_absent_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"--scheduler needs dask\.distributed: .* -m pip install distributed"):
        spread(partial(squares, None), range(2), scheduler="tcp://127.0.0.1:1")


@contextmanager
def cluster() -> Iterator[tuple[str, list[subprocess.Popen[str]]]]:
    """A Dask scheduler with a worker, as a user starts them, on ports of their own: the address and
    the processes, the scheduler first."""
    python = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    started = subprocess.Popen([*python, "--host", "127.0.0.1"], stderr=subprocess.PIPE, text=True)
    assert started.stderr is not None
    address = None
    for line in started.stderr:
        match = re.search(r"Scheduler at:\s+(tcp://\S+)", line)
        if match is not None:
            address = match[1]
            break
    assert address is not None
    options = ["--nthreads", "1", "--no-dashboard", "--no-nanny", "--host", "127.0.0.1"]
    command = [sys.executable, "-m", "distributed.cli.dask_worker", address, *options]
    worker = subprocess.Popen(command, stderr=subprocess.DEVNULL, text=True)
    yield address, [started, worker]
    for process in (worker, started):
        process.terminate()
        process.wait(20)


@pytest.fixture
def scheduler() -> Iterator[str]:
    """Its address."""
    with cluster() as (address, _):
        yield address


@needs_cluster
def test_a_cluster_gives_the_same_numbers(scheduler: str) -> None:
    """Bit by bit: a record's numbers depend on its seed alone."""
    here = montecarlo(records=4, duration_s=100.0)
    assert montecarlo(records=4, duration_s=100.0, scheduler=scheduler) == here


@needs_cluster
def test_no_scheduler_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PATIENCE_S", 0.5)
    with pytest.raises(UserError, match=r"--scheduler tcp://127\.0\.0\.1:9: no Dask scheduler answers") as caught:
        spread(partial(squares, None), range(2), scheduler="tcp://127.0.0.1:9")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", [-3, 2**64, 2**70 + 11])
def test_a_seed_that_the_simulator_does_not_take(seed: int) -> None:
    """The simulator takes 64 bits. Seeds that run over go on from 0."""
    with pytest.raises(UserError, match=r"^--seed must be a whole number from 0 to 2\^64 - 1"):
        record_seeds(5, seed)
    assert record_seeds(3, 2**64 - 1) == [2**64 - 1, 1_000_002, 2_000_005]
