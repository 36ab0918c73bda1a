"""Many records over many processors: this machine's, or a Dask cluster's; finished work is kept in a folder.

A job's numbers depend on the job alone, so any number of workers gives the same rows. With a folder each finished job
becomes a file there, and a later run reads it instead of computing it again. A worker that is killed costs the job that
it works at; another worker does it again.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import logging
import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent import futures
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import BarColumn, TextColumn

from selfcal.base.errors import UserError, first_line, install_line, printable, short_value
from selfcal.base.output import temporary_folder, whole
from selfcal.base.progress import Doing
from selfcal.base.units import duration_words

#: Argument of the function for a record; it is pickled.
Job = Any
Row = dict[str, Any]
#: Timeout of a scheduler, s.
PATIENCE_S = 10.0
#: Number of seeds that the simulator takes: whole numbers of 64 bits.
SEEDS = int(np.iinfo(np.uint64).max) + 1
#: Number of dead workers of a job after which the job is the reason.
DEATHS = 4
_KILLED = "a worker process was killed, maybe for want of memory: start again; --results DIR keeps finished records"


class Kept:
    """A folder of finished jobs, a JSON file each, named by the hash of the job and of the settings.

    `settings`: everything that decides the rows apart from the jobs; `key`: what of a job decides them. A job with an
    `error` is not kept: it is done again each time."""

    def __init__(
        self, folder: Path | str, settings: Mapping[str, Any], key: Callable[[Job], Any] = lambda job: job
    ) -> None:
        self.folder, self.settings, self.key = Path(folder), settings, key
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise UserError(f"{printable(str(folder))}: cannot be made a folder: {error.strerror}") from error

    def place(self, job: Job) -> Path:
        """The file of a job."""
        named = json.dumps([self.settings, [self.key(job)]], sort_keys=True, default=repr)
        return self.folder / f"{hashlib.sha256(named.encode()).hexdigest()}.json"

    def read(self, job: Job) -> list[Row] | None:
        """The rows of a job, None if it is to be made: it is not there, or damaged."""
        try:
            rows = json.loads(self.place(job).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return rows if isinstance(rows, list) and all(isinstance(row, dict) for row in rows) else None

    def write(self, job: Job, rows: Sequence[Row]) -> None:
        """Keep the rows of a job."""
        if not any("error" in row for row in rows):
            with whole(self.place(job)) as temporary:
                temporary.write_text(json.dumps(rows, default=lambda number: number.item()), encoding="utf-8")


def record_seeds(records: int, seed: int) -> list[int]:
    """A seed for each record of an ensemble. Raises UserError for fewer than two, which have no scatter."""
    if records < 2:
        raise UserError("--records must be at least 2")
    return [(checked_seed(seed) + 1_000_003 * k) % SEEDS for k in range(records)]


def checked_seed(seed: int) -> int:
    """The seed. Raises UserError for a seed that the simulator does not take."""
    if not 0 <= seed < SEEDS:
        raise UserError(f"--seed must be a whole number from 0 to 2^64 - 1, not {short_value(seed)}")
    return seed


def spread(
    function: Callable[[Job], list[Row]],
    jobs: Sequence[Job],
    *,
    settings: Mapping[str, Any] | None = None,
    scheduler: str | None = None,
    results: Path | str | Kept | None = None,
    count: int | None = None,
    lost: Callable[[Job], list[Row]] | None = None,
    weights: Sequence[float] | None = None,
    verb: str = "",
) -> list[Row]:
    """The rows of `function` for all `jobs`, in their order.

    `scheduler`: address of a Dask scheduler, whose workers have this package. `results`: the folder that keeps finished
    jobs; `settings`: as `Kept` has them. `count`: workers here, by default as many as processors. `lost`: the rows of a
    job whose workers die; without it such a job ends the work. `weights` [jobs]: the work of each, for the remaining
    time. `verb`: who writes the progress on stderr without a terminal; "": nobody. Raises UserError for a package that
    is absent and a scheduler that does not answer.
    """
    if count is not None and count < 1:
        raise UserError("--workers must be at least 1")
    kept = Kept(results, settings or {}) if isinstance(results, Path | str) else results
    finished: dict[int, list[Row]] = {}
    if kept is not None:
        finished = {k: rows for k, job in enumerate(jobs) if (rows := kept.read(job)) is not None}
    waiting = {k: job for k, job in enumerate(jobs) if k not in finished}
    with _Remaining(verb, [1.0] * len(jobs) if weights is None else weights) as remaining:
        remaining.done(finished)
        done = _cluster(function, waiting, scheduler, lost) if scheduler else _here(function, waiting, count, lost)
        for k, rows in done:
            finished[k] = rows
            if kept is not None:
                kept.write(jobs[k], rows)
            remaining.advance(k)
    return [row for k in range(len(jobs)) for row in finished[k]]


class _Remaining(Doing):
    """How much is done and how long the rest takes: a bar in a terminal, else a line of `verb` now and then.

    The rest takes as long for its weight as the work of this run did."""

    def __init__(self, verb: str, weights: Sequence[float]) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[said]}"))
        super().__init__(verb, *columns, total=sum(weights))
        self.weights, self.left, self.worked, self.jobs = weights, sum(weights), 0.0, 0

    def done(self, jobs: Iterable[int]) -> None:
        """Count jobs that an earlier run did."""
        for k in jobs:
            self.left -= self.weights[k]
            self.jobs += 1
            self.progress.advance(self.task, self.weights[k])

    def advance(self, k: int) -> None:
        """A job is done now."""
        self.worked += self.weights[k]
        self.left -= self.weights[k]
        self.jobs += 1
        rest_s = (time.monotonic() - self.began) * self.left / self.worked if self.worked else 0.0
        said = f"{self.jobs} of {len(self.weights)}, {duration_words(rest_s)} more"
        self.progress.update(self.task, advance=self.weights[k], said=said)
        self.tell(said)


def _obedient(folder: str) -> None:
    """A worker ends with its command, however that ends. Ctrl-C is the command's own. `folder`: for temporary files."""
    tempfile.tempdir = folder or None
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    command = multiprocessing.parent_process()
    if command is not None:
        threading.Thread(target=lambda: wait([command.sentinel]) and os._exit(1), daemon=True).start()


@contextmanager
def workers(count: int | None = None) -> Iterator[ProcessPoolExecutor]:
    """Processes that work for this process; `count`: as many as processors by default.

    A worker that is killed ends the work that waits for it with BrokenProcessPool. Leaving the block by an exception
    ends the workers at once.
    """
    others = multiprocessing.active_children()
    with temporary_folder() as folder:
        pool = ProcessPoolExecutor(count, initializer=_obedient, initargs=(folder,))
        try:
            yield pool
        except BaseException:
            for worker in multiprocessing.active_children():
                if worker not in others:
                    worker.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)  # and wait: a manager thread left to the interpreter's end races with it


def _here(
    function: Callable[[Job], list[Row]],
    waiting: Mapping[int, Job],
    count: int | None,
    lost: Callable[[Job], list[Row]] | None,
) -> Iterator[tuple[int, list[Row]]]:
    """Each worker is a pool of its own: a dead worker leaves the others at their work, and its own job is known."""
    queue, deaths = deque(waiting), dict.fromkeys(waiting, 0)
    with ExitStack() as stack:
        slots: dict[int, ProcessPoolExecutor] = {}
        running: dict[Future[list[Row]], tuple[int, int]] = {}

        def start(slot: int) -> None:
            if not queue:
                return
            k = queue.popleft()
            try:
                running[slots[slot].submit(function, waiting[k])] = slot, k
            except (KeyError, BrokenProcessPool):  # a new slot; a worker that was killed while it had nothing to do
                slots[slot] = stack.enter_context(workers(1))
                running[slots[slot].submit(function, waiting[k])] = slot, k

        for slot in range(min(count or os.cpu_count() or 1, len(waiting))):
            start(slot)
        while running:
            for future in futures.wait(running, return_when=futures.FIRST_COMPLETED).done:
                slot, k = running.pop(future)
                rows: list[Row] | None = None
                try:
                    rows = future.result()
                except BrokenProcessPool as error:
                    del slots[slot]
                    deaths[k] += 1
                    if deaths[k] < DEATHS:
                        queue.appendleft(k)
                    elif lost is None:
                        raise UserError(_KILLED) from error
                    else:
                        rows = lost(waiting[k])
                start(slot)
                if rows is not None:
                    yield k, rows


def _cluster(
    function: Callable[[Job], list[Row]],
    waiting: Mapping[int, Job],
    scheduler: str,
    lost: Callable[[Job], list[Row]] | None,
) -> Iterator[tuple[int, list[Row]]]:
    if importlib.util.find_spec("distributed") is None:
        raise UserError(f"--scheduler needs dask.distributed: {install_line('distributed')}")
    import distributed

    try:
        client: Any = distributed.Client(scheduler, timeout=PATIENCE_S)
    except Exception as error:  # each kind of address has errors of its own
        said = f"--scheduler {printable(scheduler)}: no Dask scheduler answers ({first_line(error)})"
        raise UserError(f"{said}: start one with `dask scheduler`") from error
    with _silent(), client:
        sent = client.map(function, list(waiting.values()), pure=False)
        place_of = dict(zip((future.key for future in sent), waiting, strict=True))
        try:
            for future in distributed.as_completed(sent):
                k = place_of[future.key]
                try:
                    yield k, future.result()
                except distributed.KilledWorker as error:
                    if lost is None:
                        raise UserError(_KILLED) from error
                    yield k, lost(waiting[k])
        except (futures.CancelledError, OSError) as error:
            said = f"--scheduler {printable(scheduler)}: the Dask scheduler has gone"
            raise UserError(f"{said}: start it and this command again; --results DIR keeps finished records") from error


@contextmanager
def _silent() -> Iterator[None]:
    """A library's log is not for the user: its failure is a line."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)
