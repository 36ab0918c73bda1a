"""Progress of a long verb: a bar in a terminal, otherwise a line on stderr now and then."""

from __future__ import annotations

import time
from typing import Self

from rich.console import Console
from rich.progress import Progress, ProgressColumn

from selfcal.base.errors import note


def bar() -> Progress:
    """A bar on stderr, in a terminal alone."""
    console = Console(stderr=True)
    return Progress(console=console, transient=True, disable=not console.is_terminal)


class Doing:
    """`with Doing("diagnose") as doing:`, then `doing.now("gx: round 2")` whenever the work changes, from any thread,
    and `doing.tick()` from the main thread."""

    def __init__(self, verb: str, *columns: ProgressColumn, total: float | None = None) -> None:
        """`columns` of the bar, whose `said` is a field, and the `total` of the work. Of a `verb` "" no line is
        written."""
        console = Console(stderr=True)
        self.verb, self.text, self.terminal = verb, "", console.is_terminal
        self.progress = Progress(*columns, console=console, transient=True, disable=not self.terminal)
        self.task = self.progress.add_task(verb or "records", total=total, said="")
        self.began = self.noted = time.monotonic()

    def now(self, text: str) -> None:
        """The work is this from now on."""
        self.text = text
        self.progress.update(self.task, description=text)

    def tick(self) -> None:
        """Write a line if due."""
        self.tell(f"{self.text} ({time.monotonic() - self.began:.0f} s)")

    def tell(self, text: str) -> None:
        """Write this line if the last was 10 s ago."""
        now = time.monotonic()
        if self.verb and not self.terminal and now - self.noted >= 10.0:
            self.noted = now
            note(f"{self.verb}: {text}")

    def __enter__(self) -> Self:
        self.progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.progress.stop()
