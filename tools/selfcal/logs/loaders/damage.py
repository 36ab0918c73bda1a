"""Damage of a file. Loaders count it, `recording.py` reports it.

A log is a row of messages. A loader says where a sound message ends; `walk` finds the stretches between sound messages.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

#: What is sliced and looked at by place.
Bytes = mmap.mmap | bytes


@dataclass(frozen=True)
class Damaged:
    """What could not be read of a file: bytes, and the messages, frames or lines that they were, at least. `whole`:
    bytes of the file, or those that it states it had before it was cut."""

    bytes: int = 0
    messages: int = 0
    whole: int = 0

    def __bool__(self) -> bool:
        return self.bytes > 0 or self.messages > 0

    def __add__(self, other: Damaged) -> Damaged:
        return Damaged(self.bytes + other.bytes, self.messages + other.messages, self.whole + other.whole)

    @property
    def words(self) -> str:
        """The damage in a line."""
        share = f"{100.0 * self.bytes / max(self.whole, 1):.2g} %"
        more = f"{self.messages:,} message{'s' if self.messages > 1 else ''} or more"
        return f"{share} of the file could not be read: {more}"


def parts_of(path: Path) -> list[Path]:
    """A file, or those in a folder."""
    return list(path.iterdir()) if path.is_dir() else [path]


def bytes_of(path: Path) -> int:
    """Bytes of a file, or of those in a folder."""
    return sum(part.stat().st_size for part in parts_of(path))


#: Nothing.
SOUND = Damaged()


@contextmanager
def mapped(path: Path) -> Iterator[Bytes]:
    """All of a file, in memory as far as it is looked at."""
    with path.open("rb") as stream:
        if not stream.seek(0, 2):
            yield b""
            return
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            yield data


def walk(
    data: Bytes, at: int, end_of: Callable[[int], int], *, checked: bool = False
) -> Iterator[tuple[int, int, bool]]:
    """Messages from a place on: begin, end, whether it is sound. Unsound: a stretch up to a sound message.

    `end_of`: the end of the message that begins at a place, 0 for none. `checked`: `end_of` looks at a checksum. Else a
    message that no message follows is damaged where others begin within it.
    """
    size = len(data)

    def begins(message: int) -> bool:
        # Without checksums three messages in a row make sure of a place.
        for _ in range(1 if checked else 3):
            message = end_of(message)
            if message in (0, size):
                break
        return message > 0

    held: tuple[int, int] | None = None  # sound, if the next message is
    while at < size:
        end = end_of(at)
        if end:
            if held is not None:
                yield *held, True
            held = at, end
            at = end
            continue
        begin = at
        if held is not None and not checked:
            at = held[0] + 1
        while at < size and not begins(at):
            at += 1
        if held is not None and (at >= begin or checked):
            yield *held, True
        elif held is not None:
            begin = held[0]
        held = None
        yield begin, at, False
    if held is not None:
        yield *held, True


def sifted(data: Bytes, at: int, end_of: Callable[[int], int]) -> tuple[Damaged, bytes | None]:
    """The damage of the messages from `at` on, and the file without it; None where all is sound."""
    damaged, kept, since = SOUND, list[bytes](), 0
    for begin, end, sound in walk(data, at, end_of):
        if not sound:
            damaged += Damaged(end - begin, 1)
            kept.append(data[since:begin])
            since = end
    return damaged, b"".join([*kept, data[since:]]) if damaged else None
