"""Logs of frames, written by the loggers of python-can."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from selfcal.base.errors import UserError
from selfcal.base.output import check_place
from selfcal.logs.framelog import check_suffix
from selfcal.wire.streams import McapLog

if TYPE_CHECKING:
    import can

#: Longest wait of a frame on its way to the disk, s: a killed monitor loses that.
FLUSH_S = 1.0


class FrameWriter:
    """A new log of frames; its name's suffix chooses python-can's format, or MCAP, which takes the reports too. An
    older log is never written over.

    What a kill leaves is a log up to FLUSH_S before.
    """

    def __init__(self, path: Path | str) -> None:
        import can

        self.path = Path(path)
        check_suffix(path)
        try:
            if self.path.is_file() and self.path.stat().st_size:
                raise UserError(f"{path}: this log exists, and is not written over: delete it or give another name")
            check_place(self.path)
            mcap = self.path.suffix.lower() == ".mcap"
            self._writer = cast(Any, McapLog(self.path.open("wb")) if mcap else can.Logger(str(path)))
            self._writer.file.flush()
        except OSError as error:
            raise UserError(f"{path}: cannot be written: {error.strerror or error}") from error
        self._flushed = time.monotonic()
        self._due = False

    def write(self, frame: can.Message) -> None:
        """Add a frame. Raises UserError where the disk is full."""
        self._do(lambda: self._writer(frame))
        self._due = True

    def report(self, report: Mapping[str, Any], at_s: float) -> None:
        """Add what streams.content() made of a report that came at `at_s`, where the format has a place for it."""
        if isinstance(self._writer, McapLog):
            self._do(lambda: self._writer.send(report, at_s))
            self._due = True

    def keep(self) -> None:
        """Bring the frames to the file once FLUSH_S has passed. To be called from time to time."""
        if self._due and time.monotonic() - self._flushed >= FLUSH_S:
            self._flushed, self._due = time.monotonic(), False
            self._do(self._flush)

    def _flush(self) -> None:
        block = getattr(self._writer, "_flush", None)  # python-can gathers 128 KB of a .blf
        if block is not None:
            block()
        self._writer.file.flush()

    def _do(self, what: Callable[[], None]) -> None:
        try:
            what()
        except OSError as error:
            raise UserError(f"{self.path}: cannot be written: {error.strerror or error}") from error

    def __enter__(self) -> FrameWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._do(self._writer.stop)
