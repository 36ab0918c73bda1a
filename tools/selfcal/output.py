"""Output files are whole or absent: each is written under another name beside its place, then renamed."""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from selfcal.errors import UserError

#: Names of streams that are open already, be it on a regular file.
_STREAMS = ("/dev/stdout", "/dev/stderr", "/dev/fd/", "/proc/")


def check_place(path: Path | str) -> None:
    """Raise UserError if no file can be made at `path`. For use before long work, whose answer would be lost."""
    path = Path(path)
    if path.is_dir():
        raise UserError(f"{path}: cannot be written: it is a folder; give a file name")
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
    path = Path(path)
    try:
        check_place(path)
        place = path.resolve()  # a link's target is replaced, not the link
        mode = place.stat().st_mode if place.exists() else None
        if str(path).startswith(_STREAMS) or (mode is not None and not stat.S_ISREG(mode)):
            yield path
            return
        # The suffix stays: writers choose the form by it.
        temporary = place.with_name(f".selfcal-{secrets.token_hex(4)}{place.suffix}")
        try:
            os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            yield temporary
            if mode is not None:
                temporary.chmod(stat.S_IMODE(mode))
            with temporary.open("rb") as written:
                os.fsync(written.fileno())
            temporary.replace(place)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_text(path: Path | str, text: str) -> None:
    """Write `text` in UTF-8, as `whole` does."""
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
