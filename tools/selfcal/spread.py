"""Many records over many processors: this machine's, or a Dask cluster's; finished work is kept in a folder.

A job's numbers depend on the job alone, so any number of workers gives the same rows. Jobs go out in pieces. With a
folder each finished piece becomes a Parquet file there, and a later run reads it instead of computing it again.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from selfcal.errors import UserError, first_line, printable
from selfcal.output import whole

#: Whatever a function makes a record of; it is pickled.
Job = Any
Row = dict[str, Any]
#: s until a scheduler has answered.
PATIENCE_S = 10.0


def record_seeds(records: int, seed: int) -> list[int]:
    """A seed for each record of an ensemble. Raises UserError for fewer than two, which have no scatter."""
    if records < 2:
        raise UserError("--records must be at least 2")
    return [seed + 1_000_003 * k for k in range(records)]


def spread(
    function: Callable[[Job], list[Row]],
    jobs: Sequence[Job],
    *,
    settings: Mapping[str, Any],
    piece: int = 8,
    scheduler: str | None = None,
    results: Path | str | None = None,
) -> list[Row]:
    """The rows of `function` for all `jobs`, in their order.

    `settings`: everything that decides the rows beside the jobs; a folder of other settings is refused. `piece`: jobs
    that go out, and are kept, together. `scheduler`: address of a Dask scheduler, whose workers have this package.
    `results`: the folder. Raises UserError for a package that is absent and a scheduler that does not answer.
    """
    store = None if results is None else Store(Path(results), settings)
    pieces = [list(jobs[at : at + piece]) for at in range(0, len(jobs), piece)]
    found: dict[int, list[Row]] = {}
    if store is not None:
        found = {k: rows for k, work in enumerate(pieces) if (rows := store.read(k, len(work))) is not None}
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("records", total=len(jobs), completed=sum(len(pieces[k]) for k in found))
        waiting = [(k, work) for k, work in enumerate(pieces) if k not in found]
        for k, rows in _cluster(function, waiting, scheduler) if scheduler else _here(function, waiting):
            found[k] = rows
            if store is not None:
                store.write(k, len(pieces[k]), rows)
            progress.advance(task, len(pieces[k]))
    return [row for k in range(len(pieces)) for row in found[k]]


def _piece(function: Callable[[Job], list[Row]], work: tuple[int, list[Job]]) -> tuple[int, list[Row]]:
    k, jobs = work
    return k, [row for job in jobs for row in function(job)]


def _obedient() -> None:
    """A worker ends with its command, however that ends. Ctrl-C is the command's own."""
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
    """Processes that work for this one; `count`: one for each processor by default.

    A worker that is killed ends the work that waits for it with BrokenProcessPool. Leaving the block by an exception
    ends the workers at once.
    """
    others = multiprocessing.active_children()
    pool = ProcessPoolExecutor(count, initializer=_obedient)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in multiprocessing.active_children():
            if worker not in others:
                worker.terminate()
        raise
    finally:
        pool.shutdown()


def _here(
    function: Callable[[Job], list[Row]], waiting: Sequence[tuple[int, list[Job]]]
) -> Iterator[tuple[int, list[Row]]]:
    if not waiting:
        return
    try:
        with workers() as pool:
            for future in as_completed([pool.submit(_piece, function, work) for work in waiting]):
                yield future.result()
    except BrokenProcessPool as error:
        raise UserError(
            "a worker process was killed, maybe for want of memory: start again; --results DIR keeps finished records"
        ) from error


def _cluster(
    function: Callable[[Job], list[Row]], waiting: Sequence[tuple[int, list[Job]]], scheduler: str
) -> Iterator[tuple[int, list[Row]]]:
    if importlib.util.find_spec("distributed") is None:
        raise UserError("--scheduler needs dask.distributed: make setup-cluster")
    import distributed

    try:
        client: Any = distributed.Client(scheduler, timeout=PATIENCE_S)
    except Exception as error:  # each kind of address has errors of its own
        said = f"--scheduler {printable(scheduler)}: no Dask scheduler answers ({first_line(error)})"
        raise UserError(f"{said}: start one with `dask scheduler`") from error
    with client:
        futures = client.map(partial(_piece, function), waiting, pure=False)
        for _, answer in distributed.as_completed(futures, with_results=True):
            yield answer


class Store:
    """A folder of finished pieces, each a Parquet file that is whole or absent.

    A table gives every row every column. `selfcal.keys` of its metadata has the keys of each row, in their order.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        if importlib.util.find_spec("pyarrow") is None:
            raise UserError("--results needs pyarrow: make setup-cluster")
        self.folder = folder
        self.key = hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise UserError(f"{folder}: cannot be made a folder: {error.strerror}") from error

    def place(self, k: int) -> Path:
        return self.folder / f"part-{k:06}.parquet"

    def read(self, k: int, jobs: int) -> list[Row] | None:
        """The rows of piece `k`, None if it is absent or was of fewer jobs. Raises UserError for other settings."""
        from pyarrow import ArrowException, parquet

        place = self.place(k)
        if not place.exists():
            return None
        try:
            table = parquet.read_table(place)
        except (ArrowException, OSError) as error:
            raise UserError(f"{place}: cannot be read ({first_line(error)}): delete it to have it made anew") from error
        made = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
        if made.get("selfcal.settings") != self.key:
            raise UserError(f"{place}: is of other settings: give --results another folder")
        if made.get("selfcal.jobs") != str(jobs) or "selfcal.keys" not in made:
            return None
        keys = json.loads(made["selfcal.keys"])
        rows = zip(table.to_pylist(), keys["rows"], strict=True)
        return [{name: row[name] for name in keys["kinds"][kind]} for row, kind in rows]

    def write(self, k: int, jobs: int, rows: Sequence[Row]) -> None:
        """Keep the rows of piece `k`."""
        import pyarrow
        from pyarrow import parquet

        names = dict.fromkeys(name for row in rows for name in row)
        kinds = list(dict.fromkeys(tuple(row) for row in rows))
        keys = {"kinds": kinds, "rows": [kinds.index(tuple(row)) for row in rows]}
        table = pyarrow.table({name: [row.get(name) for row in rows] for name in names})
        table = table.replace_schema_metadata(
            {"selfcal.settings": self.key, "selfcal.jobs": str(jobs), "selfcal.keys": json.dumps(keys)}
        )
        with whole(self.place(k)) as temporary:
            parquet.write_table(table, temporary)
