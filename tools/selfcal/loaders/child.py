"""A binary file is read in a child process, within bounds of time and memory.

The parent gets arrays and one line of JSON, or one line that says why there are none. The reader may end by a signal,
or never: the parent goes on.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.errors import UserError
from selfcal.limits import MOST_COLUMNS, MOST_NUMBERS, reading
from selfcal.loaders import Format
from selfcal.loaders.damage import Damaged, bytes_of
from selfcal.loaders.table import Hints, Table, of_arrays

#: Seconds of a reading: for any file, and a byte. The slowest library reads a megabyte in a second.
_LEAST_S, _S_PER_BYTE = 60.0, 4e-6
#: Bytes of memory of a reading: for any file, as libraries are large; a byte; and at most.
_LEAST_BYTES, _PER_BYTE, _MOST_BYTES = 3 << 30, 40, 16 << 30

#: What reads: (format, path, hints, folder for the answer) -> exit code, negative for a signal, None for no end.
Start = Callable[[Format, Path, Hints, Path], int | None]


def tables_of(path: Path, one: Format, hints: Hints, start: Start | None = None) -> list[Table]:
    """The tables of a file, by a child process. `start` runs it. Raises UserError."""
    with tempfile.TemporaryDirectory(prefix="selfcal-") as folder:
        place = Path(folder)
        code = (start or _spawned)(one, path, hints, place)
        answer = place / "answer.json"
        if code == 0 and answer.exists():
            found = json.loads(answer.read_text(encoding="utf-8"))
            if "error" in found:
                raise UserError(found["error"])
            return [_table(place, number, entry) for number, entry in enumerate(found["tables"])]
    if code is None or code == -24:  # SIGXCPU
        raise UserError(f"{path}: reading it takes more than {_seconds(path):.0f} s: it is damaged, or too long")
    if code in (0, 1):
        raise UserError(
            f"{path}: not {'a' if one.name[1] != 'n' else 'an'}{one.name[one.name.index(' ') :]} that reads"
        )
    what = one.name.split(" ", 1)[1]
    raise UserError(f"{path}: not a sound {what}: {one.library or 'its reader'} fails at it (signal {-code})")


def _table(place: Path, number: int, entry: dict[str, Any]) -> Table:
    """A table that the child wrote."""
    arrays = {
        name: np.load(place / f"{number}.{column}.npy", allow_pickle=False)
        for column, name in enumerate(entry["names"])
    }
    return of_arrays(entry["source"], arrays, entry["meta"], tuple(entry["notes"]), Damaged(**entry["damaged"]))


def _seconds(path: Path) -> float:
    return _LEAST_S + _S_PER_BYTE * bytes_of(path)


def _spawned(one: Format, path: Path, hints: Hints, place: Path) -> int | None:
    command = [
        sys.executable,
        "-m",
        "selfcal.loaders.child",
        one.module,
        str(path),
        str(place),
        json.dumps(dict(hints)),
    ]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    child = subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        return child.wait(_seconds(path))
    except subprocess.TimeoutExpired:
        return None
    finally:
        child.kill()
        child.wait()


def answer(module: str, path: Path, place: Path, hints: Hints) -> None:
    """In the child: read, within the bounds, and write the answer into the folder `place`."""
    seconds = int(_seconds(path)) + 1
    most = min(_MOST_BYTES, _LEAST_BYTES + _PER_BYTE * bytes_of(path))
    _bound(resource.RLIMIT_AS, most, most)
    _bound(resource.RLIMIT_CPU, seconds, seconds + 5)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        with reading(path, "cannot be read"):
            found: dict[str, Any] = {"tables": [_written(path, place, *one) for one in _read(module, path, hints)]}
    except UserError as error:
        found = {"error": str(error)}
    (place / "answer.json").write_text(json.dumps(found), encoding="utf-8")


def _bound(kind: int, soft: int, hard: int) -> None:
    """Set a limit of this process, or keep a lower one that it has."""
    given = resource.getrlimit(kind)[1]
    most = hard if given == resource.RLIM_INFINITY else min(hard, given)
    resource.setrlimit(kind, (min(soft, most), most))


def _read(module: str, path: Path, hints: Hints) -> list[tuple[int, Table]]:
    return list(enumerate(import_module(f"selfcal.loaders.{module}").read(path, hints)))


def _written(path: Path, place: Path, number: int, table: Table) -> dict[str, Any]:
    if len(table.members) > MOST_COLUMNS:
        raise UserError(f"{path}: {table.source}: more than {MOST_COLUMNS} columns")
    for column, member in enumerate(table.members.values()):
        array = member.read()
        if array.size > MOST_NUMBERS:
            raise UserError(f"{path}: {table.source}: more than {MOST_NUMBERS:,} numbers: cut it in parts")
        np.save(place / f"{number}.{column}.npy", array, allow_pickle=False)
    return {
        "source": table.source,
        "names": list(table.members),
        "meta": dict(table.meta),
        "notes": list(table.notes),
        "damaged": asdict(table.damaged),
    }


def main() -> None:
    """`python -m selfcal.loaders.child MODULE PATH FOLDER HINTS`."""
    module, path, place, hints = sys.argv[1:]
    answer(module, Path(path), Path(place), json.loads(hints))


if __name__ == "__main__":
    main()
