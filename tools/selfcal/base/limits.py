"""Files from strangers: the largest sizes that are read, and a line for whatever a library raises over them."""

from __future__ import annotations

import errno
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from selfcal.base.errors import UserError, first_line

#: Numbers of a recording, rows times columns read: 3.2 GB.
MOST_NUMBERS = 400_000_000
#: Fewest rows of a recording: a rate takes two.
FEWEST_ROWS = 2
#: Columns of a recording, and characters of a heading.
MOST_COLUMNS, LONGEST_HEADING = 1000, 256
#: Bytes of a block of a text recording, and of its longest line.
BLOCK_BYTES = 1 << 22
#: Largest growth of a packed recording when unpacked, in times its size: readings pack to a twentieth at best. Text
#: grows less: a number of eight bytes has two characters there.
MOST_GROWTH, MOST_TEXT_GROWTH = 200, 25
#: Lines before the header of a text recording.
MOST_LEADING_LINES = 1000
#: Cells of these lines that are searched for a known heading.
MOST_HEADINGS = 30_000
#: Bytes that a MATLAB or R file may unpack to, and the bytes allowed to the smallest file. Memory holds each number
#: three times.
MOST_UNPACKED_BYTES, MOST_UNPACKED_SMALL = 1 << 30, 1 << 26
#: Objects in an R file, each value of a text column included.
MOST_R_OBJECTS = 200_000
#: Names of streams that are open already, be it on a regular file.
STREAMS = ("/dev/stdin", "/dev/stdout", "/dev/stderr", "/dev/fd/", "/proc/")
#: Metadata of a recording, and a model file.
MOST_META_BYTES, MOST_MODEL_BYTES = 1 << 20, 1 << 18
#: Values in a model file, each alias counted as if it were written out.
MOST_MODEL_VALUES = 10_000
#: Lowest and highest sampling rate, Hz.
LEAST_RATE_HZ, MOST_RATE_HZ = 1e-6, 1e6
#: Sampling rates in a recording.
MOST_CLOCKS = 8
#: Longest span of a recording: seconds, and samples, missing ones included. A law takes 20 000 intervals, each of at
#: most 10^6 s and 2^32 samples (lib/bank.c).
LONGEST_S, LONGEST_SAMPLES = 1e10, 2**46


@contextmanager
def reading(path: Path | str, otherwise: str) -> Iterator[None]:
    """Around a library that reads `path`: all that it raises becomes a UserError, its warnings are left out.

    `otherwise` says what the file is not, where the library's error is of no known kind.
    """
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    except UserError:
        raise
    except OSError as error:
        # A library's own OSError has no number.
        what = f"cannot be read: {error.strerror}" if error.strerror else f"{otherwise}: {first_line(error)}"
        if error.errno == errno.ENOSPC:
            what = f"no space left in {tempfile.gettempdir()} to unpack it: TMPDIR names another folder"
        if error.errno == errno.EFBIG:  # by the bound of child.py
            what = f"unpacks to more than {MOST_GROWTH} times its size, as no sensor's readings do"
        raise UserError(f"{path}: {what}") from error
    except MemoryError as error:
        raise UserError(f"{path}: too large for this machine's memory") from error
    except RecursionError as error:
        raise UserError(f"{path}: {otherwise}: nested too deep") from error
    except Exception as error:
        raise UserError(f"{path}: {otherwise}: {first_line(error)}") from error


def named_pipe(path: Path) -> bool:
    """Whether a path is a pipe of the file system, which may hold its reader or writer for ever. Raises OSError."""
    return path.is_fifo() and not any(str(name).startswith(STREAMS) for name in (path, path.resolve()))


def read_text(path: Path, most: int, otherwise: str) -> str:
    """The text of a file of at most `most` bytes, UTF-8. Raises UserError; FileNotFoundError without a file."""
    if named_pipe(path):
        raise UserError(f"{path}: is a named pipe: write it into a file first")
    with path.open("rb") as stream, reading(path, otherwise):
        data = stream.read(most + 1)
        if len(data) > most:
            raise UserError(f"{path}: larger than {most} bytes")
        if b"\0" in data:
            raise ValueError("a byte 0x00 is in it")
        return data.decode("utf-8")
