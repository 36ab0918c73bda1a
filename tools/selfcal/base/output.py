"""Output files are whole or absent: each is written under another name in its folder, then renamed."""

from __future__ import annotations

import contextlib
import json
import math
import os
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from selfcal.base.errors import UserError, printable
from selfcal.base.limits import STREAMS, named_pipe

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def check_place(path: Path | str) -> None:
    """Raise UserError if no file can be made at `path`. For use before long work, whose answer would be lost."""
    path = Path(path)
    if path.is_dir():
        raise UserError(f"{path}: cannot be written: it is a folder; give a file name")
    if named_pipe(path):
        raise UserError(f"{path}: cannot be written: it is a named pipe, which may have no reader; give a file name")
    if not path.parent.is_dir():
        raise UserError(f"{path}: cannot be written: there is no folder '{path.parent}'; make it first")


@contextmanager
def whole(path: Path | str) -> Iterator[Path]:
    """`with whole(path) as temporary:` the block writes the file `temporary`, which becomes `path` when the block ends.

    If the block fails, or the program is killed, an older `path` stays as it was. A symbolic link stays a link, and
    an older file's permissions stay. Pipes, devices and open streams cannot be renamed over: `temporary` is then `path`
    itself.
    Raises UserError for every OSError, those of the block included.
    """
    with together(path) as (temporary,):
        yield temporary


@contextmanager
def together(path: Path | str, *others: Path | str) -> Iterator[tuple[Path, ...]]:
    """Like `whole`, for files that belong together: all are on the disk before the first takes its place.

    Older files of `others` are removed first, so that none is left of another `path`. If the block removes a temporary
    file, its target is removed too.
    """
    target = Path(path)
    pending: list[_Pending] = []
    try:
        try:
            for target in map(Path, (path, *others)):
                pending.append(_Pending.of(target))
            target = Path(path)
            yield tuple(file.temporary for file in pending)
            written = [file for file in pending if file.temporary != file.place]
            written = [file for file in written if file is pending[0] or file.temporary.exists()]
            for file in written:
                file.settle()
            for file in pending[1:]:
                if file.temporary != file.place:
                    file.place.unlink(missing_ok=True)
            for file in written:
                file.temporary.replace(file.place)
        finally:
            for file in pending:
                if file.temporary != file.place:
                    file.temporary.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{target}: cannot be written: {error.strerror or error}") from error


@dataclass(frozen=True)
class _Pending:
    """A file on its way: written as `temporary`, to become `place`, with the permissions of an older file."""

    temporary: Path
    place: Path
    mode: int | None

    @staticmethod
    def of(path: Path) -> _Pending:
        """Make the temporary file. Raises UserError and OSError."""
        check_place(path)
        place = path.resolve()  # a link's target is replaced, not the link
        mode = place.stat().st_mode if place.exists() else None
        if str(path).startswith(STREAMS) or (mode is not None and not stat.S_ISREG(mode)):
            return _Pending(path, path, None)
        # The suffix stays: writers choose the form by it.
        temporary = place.with_name(f".selfcal-{secrets.token_hex(4)}{place.suffix}")
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        return _Pending(temporary, place, mode)

    def settle(self) -> None:
        """Bring what is written to the disk."""
        if self.mode is not None:
            self.temporary.chmod(stat.S_IMODE(self.mode))
        with self.temporary.open("rb") as written:
            os.fsync(written.fileno())


@contextmanager
def temporary_folder() -> Iterator[str]:
    """A folder for what others unpack, which goes at the end, however they ended; "" where none can be made."""
    folder = ""
    with contextlib.suppress(OSError):
        folder = tempfile.mkdtemp(prefix="selfcal-")
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def write_text(path: Path | str, text: str) -> None:
    """Write `text` in UTF-8, as `whole` does. A file's name may have bytes that are no text: they become `\\udc80`."""
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def check_writable(*files: Path | str | None, inputs: Sequence[Path | str | None] = ()) -> None:
    """Raise UserError now, before the work, for a file that could not be written after it, that is among the `inputs`,
    or that is there twice. None and '-' are skipped."""
    taken = {Path(path).resolve() for path in inputs if path is not None}
    for file in files:
        if file is not None and str(file) != "-":
            check_place(file)
            if Path(file).resolve() in taken:
                raise UserError(f"{file}: is read, or written as another output: give it a name of its own")
            taken.add(Path(file).resolve())


def write_json(document: Mapping[str, Any], path: Path | str | None) -> None:
    """Write a document to a file, to stdout for '-', for None nowhere. What JSON cannot say (infinity, not a number)
    becomes null."""
    if path is None:
        return
    text = json.dumps(finite(document), indent=2, allow_nan=False) + "\n"
    if str(path) == "-":
        sys.stdout.write(text)
        return
    write_text(path, text)


def finite(value: Any) -> Any:
    """`value` with None in place of every number that JSON does not have."""
    if isinstance(value, Mapping):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


#: Columns of a table at most, and of an output that is not a terminal.
TABLE_WIDTH = 140
#: Suffixes of pictures.
PICTURES = (".png", ".pdf", ".svg", ".jpg")


def check_picture(path: Path | str | None) -> None:
    """Raise UserError for a file name without the suffix of a picture. None is skipped."""
    if path is not None and Path(path).suffix not in PICTURES:
        raise UserError(f"{path}: a plot is one of {', '.join(PICTURES)}")


def console_of(*, to_stderr: bool = False, fits: bool = False) -> Console:
    """Where tables are printed. No number is cut: a pipe has no width, and a narrow terminal wraps the lines of a table
    that does not choose its columns by the width (`fits`)."""
    from rich.console import Console

    console = Console(stderr=to_stderr)
    if not console.is_terminal:
        console.width = 1000
    elif not fits:
        console.width = max(console.width, TABLE_WIDTH)
    return console


def print_line(console: Console, text: str, style: str | None = None) -> None:
    """Print a text from outside: whole, and no sign in it is obeyed."""
    console.print(printable(text), style=style, highlight=False, markup=False, soft_wrap=True)


def print_lines(lines: Iterable[str], *, to_stderr: bool) -> None:
    """Print texts from outside, a line each."""
    console = console_of(to_stderr=to_stderr)
    for line in lines:
        print_line(console, line)


def table_of(headings: Iterable[str], title: str | None = None, *, wraps: bool = False, **look: Any) -> Table:
    """A table for a terminal, with these headings; its cells wrap, or have a line each. `look`: more of Table's."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", caption_justify="left", **look)
    for heading in headings:
        table.add_column(heading, no_wrap=not wraps, overflow="fold" if wraps else "ellipsis")
    return table
