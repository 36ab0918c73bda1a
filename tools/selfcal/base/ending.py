"""How a command ends before its time: Ctrl-C, SIGTERM and SIGHUP alike, each once, at a point where nothing is lost."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Ended(KeyboardInterrupt):
    """A signal asked for the end; `number` of the signal."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


class Stopped(Exception):
    """Raised at a point where long work may end early, for its caller to keep what is done."""


#: Time until a signal is looked at again that came in an import, s.
_AGAIN_S = 0.02


class HeldSignals:
    """The signal that came while signals are held: whether it has asked for the end. Shared by the process."""

    holding = False
    came: int | None = None
    came_at = 0.0
    raised: int | None = None
    abandoned = False

    @property
    def asked(self) -> bool:
        """A signal came."""
        return HeldSignals.came is not None

    @property
    def overdue(self) -> bool:
        """A signal came 0.6 s ago: results have to be written."""
        return HeldSignals.came is not None and time.monotonic() > HeldSignals.came_at + 0.6

    def check(self) -> None:
        """Raise Ended if a signal came."""
        if HeldSignals.came is not None:
            number, HeldSignals.came = HeldSignals.came, None
            _end(number)


def _on_signal(number: int, frame: FrameType | None) -> None:
    if HeldSignals.holding and HeldSignals.came is None:
        HeldSignals.came, HeldSignals.came_at = number, time.monotonic()  # a second signal ends at once
        return
    if _imports(frame):
        signal.signal(signal.SIGALRM, lambda _, later: _on_signal(number, later))
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        return
    for other in SIGNALS[1:]:
        signal.signal(other, signal.SIG_IGN)  # the end is under way: it is not to be cut short
    _end(number)


def _imports(frame: FrameType | None) -> bool:
    """Whether a module is being imported: libraries try their parts by a bare `except`, which would swallow the end."""
    while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
        frame = frame.f_back
    return frame is not None


def _end(number: int) -> NoReturn:
    HeldSignals.raised = number
    raise Ended(number)


def last_signal() -> int:
    """Exit code for the signal that was raised, 128 + its number; 0: none was."""
    return 0 if HeldSignals.raised is None else 128 + HeldSignals.raised


def abandon() -> None:
    """Threads are left at their work: the process ends without them."""
    HeldSignals.abandoned = True


def leave(code: int) -> NoReturn:
    """End the process, whatever threads are still at work."""
    if HeldSignals.abandoned:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)
    sys.exit(code)


def install_signals() -> None:
    """Have the signals raise Ended. An ignored signal stays so: `nohup`, a shell's background job."""
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _on_signal)


@contextmanager
def hold_signals() -> Iterator[HeldSignals]:
    """Within, a signal is noted instead of raised, if `install_signals()` has been called; the caller asks `asked`.

    What came stays noted after the end of the block until `check()` raises it.
    """
    before, HeldSignals.holding = HeldSignals.holding, True
    if not before:
        HeldSignals.came = None
    try:
        yield HeldSignals()
    finally:
        HeldSignals.holding = before
