"""Many records over many processors: this machine's, or a Dask cluster's; finished work is kept in a folder.

A job's numbers depend on the job alone, so any number of workers gives the same rows. Jobs go out in pieces. With a
folder each finished piece becomes a file there, and a later run reads it instead of computing it again. A worker that
is killed costs the piece that it works at; another worker does it again.
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
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Protocol

from rich.progress import BarColumn, TextColumn

from selfcal.base.errors import UserError, first_line, install, printable, shown
from selfcal.base.output import temporary_folder, whole
from selfcal.base.progress import Doing

#: Argument of the function for a record; it is pickled.
Job = Any
Row = dict[str, Any]
#: A piece: its place among the pieces, and its jobs.
Work = tuple[int, list[Job]]
#: Timeout of a scheduler, s.
PATIENCE_S = 10.0
#: Number of seeds that the simulator takes.
SEEDS = 2**64
#: Number of dead workers of a piece after which the piece is the reason.
DEATHS = 4
_KILLED = "a worker process was killed, maybe for want of memory: start again; --results DIR keeps finished records"


class Keeper(Protocol):
    """Where finished pieces are."""

    def read(self, k: int, jobs: Sequence[Job]) -> list[Row] | None:
        """The rows of piece `k`, None if it is to be made."""

    def write(self, k: int, jobs: Sequence[Job], rows: Sequence[Row]) -> None:
        """Keep the rows of piece `k`."""


def record_seeds(records: int, seed: int) -> list[int]:
    """A seed for each record of an ensemble. Raises UserError for fewer than two, which have no scatter."""
    if records < 2:
        raise UserError("--records must be at least 2")
    return [(checked_seed(seed) + 1_000_003 * k) % SEEDS for k in range(records)]


def checked_seed(seed: int) -> int:
    """The seed. Raises UserError for a seed that the simulator does not take."""
    if not 0 <= seed < SEEDS:
        raise UserError(f"--seed must be a whole number from 0 to 2^64 - 1, not {shown(seed)}")
    return seed


def spread(
    function: Callable[[Job], list[Row]],
    jobs: Sequence[Job],
    *,
    settings: Mapping[str, Any],
    piece: int = 8,
    scheduler: str | None = None,
    results: Path | str | Keeper | None = None,
    count: int | None = None,
    lost: Callable[[Job], list[Row]] | None = None,
    weights: Sequence[float] | None = None,
    verb: str = "",
) -> list[Row]:
    """The rows of `function` for all `jobs`, in their order.

    `settings`: everything that decides the rows apart from the jobs; a folder of other settings is refused. `piece`:
    jobs that go out, and are kept, together. `scheduler`: address of a Dask scheduler, whose workers have this package.
    `results`: the folder, or what keeps the pieces. `count`: workers here, by default as many as processors. `lost`:
    the rows of a job whose workers die; without it such a job ends the work. `weights` [jobs]: the work of each, for
    the remaining time. `verb`: who writes the progress on stderr where there is no terminal; "": nobody.
    Raises UserError for a package that is absent and a scheduler that does not answer.
    """
    if count is not None and count < 1:
        raise UserError("--workers must be at least 1")
    store: Keeper | None = Store(Path(results), settings) if isinstance(results, Path | str) else results
    pieces = [list(jobs[start : start + piece]) for start in range(0, len(jobs), piece)]
    each = [1.0] * len(jobs) if weights is None else list(weights)
    finished: dict[int, list[Row]] = {}
    if store is not None:
        finished = {k: rows for k, work in enumerate(pieces) if (rows := store.read(k, work)) is not None}
    waiting = [(k, work) for k, work in enumerate(pieces) if k not in finished]
    with _Remaining(verb, [sum(each[k * piece : (k + 1) * piece]) for k in range(len(pieces))], pieces) as remaining:
        remaining.done(finished)
        done = _cluster(function, waiting, scheduler, lost) if scheduler else _here(function, waiting, count, lost)
        for k, rows in done:
            finished[k] = rows
            if store is not None:
                store.write(k, pieces[k], rows)
            remaining.advance(k)
    return [row for k in range(len(pieces)) for row in finished[k]]


class _Remaining(Doing):
    """How much is done and how long the rest takes: a bar in a terminal, else a line of `verb` now and then.

    The rest takes as long for its weight as the work of this run did."""

    def __init__(self, verb: str, weights: Sequence[float], pieces: Sequence[Sequence[Job]]) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[said]}"))
        super().__init__(verb, *columns, total=sum(weights))
        self.weights, self.sizes = weights, [len(piece) for piece in pieces]
        self.left, self.worked, self.jobs = sum(weights), 0.0, 0

    def done(self, pieces: Iterable[int]) -> None:
        """These were done by an earlier run."""
        for k in pieces:
            self.left -= self.weights[k]
            self.jobs += self.sizes[k]
            self.progress.advance(self.task, self.weights[k])

    def advance(self, k: int) -> None:
        """A piece is done now."""
        self.worked += self.weights[k]
        self.left -= self.weights[k]
        self.jobs += self.sizes[k]
        rest_s = (time.monotonic() - self.began) * self.left / self.worked if self.worked else 0.0
        left = f"{rest_s:.0f} s" if rest_s < 120.0 else f"{rest_s / 60.0:.0f} min"
        said = f"{self.jobs} of {sum(self.sizes)}, {left} more"
        self.progress.update(self.task, advance=self.weights[k], said=said)
        self.tell(said)


def _piece(function: Callable[[Job], list[Row]], work: Work) -> tuple[int, list[Row]]:
    k, jobs = work
    return k, [row for job in jobs for row in function(job)]


def _obedient(folder: str) -> None:
    """A worker ends with its command, however that ends. Ctrl-C is the command's own. `folder`: for temporary files."""
    tempfile.tempdir = folder or None
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    threading.Thread(target=_end_with_the_command, daemon=True).start()


def _end_with_the_command() -> None:
    command = multiprocessing.parent_process()
    if command is not None:
        wait([command.sentinel])
        os._exit(1)


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
    waiting: Sequence[Work],
    count: int | None,
    lost: Callable[[Job], list[Row]] | None,
) -> Iterator[tuple[int, list[Row]]]:
    """Each worker is a pool of its own: a dead one leaves the others at their work, and its own piece is known."""
    todo, deaths = deque(waiting), dict.fromkeys((k for k, _ in waiting), 0)
    with ExitStack() as stack:
        slots: dict[int, ProcessPoolExecutor] = {}
        running: dict[Future[tuple[int, list[Row]]], tuple[int, Work]] = {}

        def start(slot: int) -> None:
            if not todo:
                return
            work = todo.popleft()
            try:
                running[slots[slot].submit(_piece, function, work)] = (slot, work)
            except (KeyError, BrokenProcessPool):  # a new slot; a worker that was killed while it had nothing to do
                slots[slot] = stack.enter_context(workers(1))
                running[slots[slot].submit(_piece, function, work)] = (slot, work)

        for slot in range(min(count or os.cpu_count() or 1, len(waiting))):
            start(slot)
        while running:
            for future in futures.wait(running, return_when=futures.FIRST_COMPLETED).done:
                slot, work = running.pop(future)
                answer: tuple[int, list[Row]] | None = None
                try:
                    answer = future.result()
                except BrokenProcessPool as error:
                    del slots[slot]
                    deaths[work[0]] += 1
                    if deaths[work[0]] < DEATHS:
                        todo.appendleft(work)
                    elif lost is None:
                        raise UserError(_KILLED) from error
                    else:
                        answer = work[0], [row for job in work[1] for row in lost(job)]
                start(slot)
                if answer is not None:
                    yield answer


def _cluster(
    function: Callable[[Job], list[Row]],
    waiting: Sequence[Work],
    scheduler: str,
    lost: Callable[[Job], list[Row]] | None,
) -> Iterator[tuple[int, list[Row]]]:
    if importlib.util.find_spec("distributed") is None:
        raise UserError(f"--scheduler needs dask.distributed: {install('distributed')}")
    import distributed

    try:
        client: Any = distributed.Client(scheduler, timeout=PATIENCE_S)
    except Exception as error:  # each kind of address has errors of its own
        said = f"--scheduler {printable(scheduler)}: no Dask scheduler answers ({first_line(error)})"
        raise UserError(f"{said}: start one with `dask scheduler`") from error
    with _silent(), client:
        sent = client.map(partial(_piece, function), waiting, pure=False)
        work_of = dict(zip((future.key for future in sent), waiting, strict=True))
        try:
            for future in distributed.as_completed(sent):
                k, jobs = work_of[future.key]
                try:
                    yield future.result()
                except distributed.KilledWorker as error:
                    if lost is None:
                        raise UserError(_KILLED) from error
                    yield k, [row for job in jobs for row in lost(job)]
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


def check_results(folder: Path | str | None) -> None:
    """Raises UserError where finished pieces cannot be kept."""
    if folder is not None and importlib.util.find_spec("pyarrow") is None:
        raise UserError(f"--results needs pyarrow: {install('pyarrow')}")


def make_folder(folder: Path) -> None:
    """Make a folder unless it is there. Raises UserError."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise UserError(f"{printable(str(folder))}: cannot be made a folder: {error.strerror}") from error


class Store:
    """A folder of finished pieces, each a Parquet file that is whole or absent.

    A table gives every row every column. `selfcal.keys` of its metadata has the keys of each row, in their order.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        check_results(folder)
        self.folder = folder
        self.key = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()
        make_folder(folder)

    def place(self, k: int) -> Path:
        return self.folder / f"part-{k:06}.parquet"

    def read(self, k: int, jobs: Sequence[Job]) -> list[Row] | None:
        """The rows of piece `k`, None if it is absent or was of fewer jobs. Raises UserError for other settings."""
        from pyarrow import ArrowException, parquet

        path = self.place(k)
        if not path.exists():
            return None
        try:
            table = parquet.read_table(path)
        except (ArrowException, OSError) as error:
            raise UserError(f"{path}: cannot be read ({first_line(error)}): delete it to have it made anew") from error
        made = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
        if made.get("selfcal.settings") != self.key:
            raise UserError(f"{path}: is of other settings: give --results another folder")
        if made.get("selfcal.jobs") != str(len(jobs)) or "selfcal.keys" not in made:
            return None
        keys = json.loads(made["selfcal.keys"])
        rows = zip(table.to_pylist(), keys["rows"], strict=True)
        return [{name: row[name] for name in keys["kinds"][kind]} for row, kind in rows]

    def write(self, k: int, jobs: Sequence[Job], rows: Sequence[Row]) -> None:
        """Keep the rows of piece `k`."""
        import pyarrow
        from pyarrow import parquet

        names = dict.fromkeys(name for row in rows for name in row)
        kinds = list(dict.fromkeys(tuple(row) for row in rows))
        keys = {"kinds": kinds, "rows": [kinds.index(tuple(row)) for row in rows]}
        table = pyarrow.table({name: [row.get(name) for row in rows] for name in names})
        table = table.replace_schema_metadata(
            {"selfcal.settings": self.key, "selfcal.jobs": str(len(jobs)), "selfcal.keys": json.dumps(keys)}
        )
        with whole(self.place(k)) as temporary:
            parquet.write_table(table, temporary)
