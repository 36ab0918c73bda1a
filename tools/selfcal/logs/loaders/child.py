"""A binary file is read in a child process, within bounds of time and memory.

The parent gets JSON and the bytes of arrays by a pipe, or a line that says why not. The reader may end by a signal, or
never: the parent goes on.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import resource
import select
import signal
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError, printable
from selfcal.base.limits import MOST_COLUMNS, MOST_GROWTH, MOST_UNPACKED_SMALL, reading
from selfcal.base.output import temporary_folder
from selfcal.logs.loaders import Format
from selfcal.logs.loaders.damage import Damaged, parts_of
from selfcal.logs.loaders.table import Hints, Table, bound_numbers, of_arrays

#: Seconds of a reading: for any file, and a byte. The slowest library reads a megabyte in a second.
_LEAST_S, _S_PER_BYTE = 60.0, 4e-6
#: Head of the answer: the size of the JSON.
_SIZE = struct.Struct("=Q")

#: Starts a reader: (format, path, hints, descriptor for the answer, folder for what it unpacks) -> number of its
#: process. The folder goes after it, however it ended; "" is no folder.
Start = Callable[[Format, Path, Hints, int, str], int]


def tables_of(path: Path, form: Format, hints: Hints, start: Start | None = None) -> list[Table]:
    """The tables of a file, by a child process. `start` starts it. Raises UserError."""
    ends = time.monotonic() + _seconds(path)
    pipe, its_end = os.pipe()
    number, code = 0, 0
    with temporary_folder() as folder:
        try:
            try:
                number = (start or _spawned)(form, path, hints, its_end, folder)
            finally:
                os.close(its_end)
            return _answered(pipe, ends)
        except EOFError:
            code = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
            number = 0
        except TimeoutError:
            code = -signal.SIGXCPU
        finally:
            os.close(pipe)
            if number:
                os.kill(number, signal.SIGKILL)
                os.waitpid(number, 0)
    if code == -signal.SIGXCPU:
        raise UserError(f"{path}: reading it takes more than {_seconds(path):.0f} s: it is damaged, or too long")
    if code >= 0:
        raise UserError(
            f"{path}: not {'a' if form.name[1] != 'n' else 'an'}{form.name[form.name.index(' ') :]} that reads"
        )
    what = form.name.split(" ", 1)[1]
    raise UserError(f"{path}: not a sound {what}: {form.library or 'its reader'} fails at it (signal {-code})")


def _answered(pipe: int, ends: float) -> list[Table]:
    """The tables that a child sends. Raises UserError; EOFError where it ended, TimeoutError at the time `ends`."""
    message = json.loads(_received(pipe, _SIZE.unpack(_received(pipe, _SIZE.size, ends))[0], ends))
    if "error" in message:
        raise UserError(message["error"])
    tables = []
    for table in message["tables"]:
        arrays = {}
        for name, kind, shape in table["columns"]:
            dtype = np.dtype(kind)
            data = _received(pipe, math.prod(shape) * dtype.itemsize, ends)
            arrays[name] = np.frombuffer(data, dtype).reshape(shape)
        tables.append(
            of_arrays(table["source"], arrays, table["meta"], tuple(table["notes"]), Damaged(**table["damaged"]))
        )
    return tables


def _received(pipe: int, size: int, ends: float) -> bytearray:
    """The next bytes of a pipe. Raises EOFError and TimeoutError."""
    data = bytearray(size)
    left = memoryview(data)
    ready = select.poll()
    ready.register(pipe, select.POLLIN)
    while left:
        if not ready.poll(max(0.0, 1e3 * (ends - time.monotonic()))):
            raise TimeoutError
        count = os.readv(pipe, [left])
        if not count:
            raise EOFError
        left = left[count:]
    return data


def _bytes(path: Path) -> int:
    """Bytes of a file, or of a folder's files. A hole has none; a disk that packs files does so to a sixteenth."""
    files = [part.stat() for part in parts_of(path)]
    return sum(min(status.st_size, 16 * 512 * status.st_blocks) for status in files)


def _seconds(path: Path) -> float:
    return _LEAST_S + _S_PER_BYTE * _bytes(path)


def _spawned(form: Format, path: Path, hints: Hints, answer: int, folder: str) -> int:
    # -P: no module is imported from the folder that the user is in, where files of strangers may lie.
    what = [form.module, str(path), json.dumps(dict(hints)), str(os.getpid())]
    command = [sys.executable, "-P", "-m", "selfcal.logs.loaders.child", *what]
    streams = [
        (os.POSIX_SPAWN_DUP2, answer, 1),
        (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
        (os.POSIX_SPAWN_OPEN, 2, os.devnull, os.O_WRONLY, 0),
    ]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    if folder:
        environment["TMPDIR"] = folder
    return os.posix_spawn(sys.executable, command, environment, file_actions=streams)


def answer(module: str, path: Path, hints: Hints, to: int) -> None:
    """In the child: read, within the bounds, and write the answer to the descriptor `to`."""
    seconds = int(_seconds(path)) + 1
    # Libraries are large: 3 GB for any file, 16 GB at most.
    most = min(16 << 30, (3 << 30) + 40 * _bytes(path))
    _bound(resource.RLIMIT_AS, most, most)
    _bound(resource.RLIMIT_CPU, seconds, seconds + 5)
    # Files that it unpacks: a file for each part of a folder, but for its index.
    most = max(MOST_UNPACKED_SMALL, MOST_GROWTH * _bytes(path)) // max(1, len(parts_of(path)) - path.is_dir())
    _bound(resource.RLIMIT_FSIZE, most, most)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    arrays: list[NDArray[np.uint8]] = []
    try:
        with reading(path, "cannot be read"):
            read = import_module(f"selfcal.logs.loaders.{module}").read
            content: dict[str, Any] = {"tables": [_entry(path, table, arrays) for table in read(path, hints)]}
    except UserError as error:
        content, arrays = {"error": str(error)}, []
    head = json.dumps(content).encode()
    with open(to, "wb") as pipe:
        pipe.write(_SIZE.pack(len(head)) + head)
        for array in arrays:
            pipe.write(array.data)


def _bound(kind: int, soft: int, hard: int) -> None:
    """Set a limit of this process, or keep a lower limit that it has."""
    given = resource.getrlimit(kind)[1]
    most = hard if given == resource.RLIM_INFINITY else min(hard, given)
    resource.setrlimit(kind, (min(soft, most), most))


def _entry(path: Path, table: Table, arrays: list[NDArray[np.uint8]]) -> dict[str, Any]:
    """The JSON of a table; the bytes of its columns join `arrays`."""
    if len(table.members) > MOST_COLUMNS:
        raise UserError(f"{path}: {table.source}: more than {MOST_COLUMNS} columns")
    columns = []
    for name, member in table.members.items():
        array = member.read()
        bound_numbers(path, array.size)
        if array.dtype.kind not in "biufcMm":
            raise ValueError(f"column '{name}' holds no numbers")
        arrays.append(np.ascontiguousarray(array).reshape(-1).view(np.uint8))
        columns.append((name, array.dtype.str, array.shape))
    return {
        "source": printable(table.source),
        "columns": columns,
        "meta": dict(table.meta),
        "notes": list(table.notes),
        "damaged": asdict(table.damaged),
    }


def main() -> None:
    """`python -m selfcal.logs.loaders.child MODULE PATH HINTS PARENT`: answers on stdout, and ends with its parent."""
    module, path, hints, parent = sys.argv[1:]
    # PR_SET_PDEATHSIG of prctl(2): the signal that a process gets when its parent ends.
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)
    if os.getppid() != int(parent):  # it has ended before
        return
    to = os.dup(1)
    os.dup2(2, 1)  # what a library prints is no answer
    answer(module, Path(path), json.loads(hints), to)


if __name__ == "__main__":
    main()
