"""`selfcal monitor`: live view of a module's telemetry on any python-can interface."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console

from selfcal.errors import UserError
from selfcal.live import View, frame_counts
from selfcal.wire import Decoder, Statistics, open_bus

LOGS = (".asc", ".blf", ".csv", ".trc")
#: s without a frame after which a serial line is opened again: a module that saves hears nothing for 1 to 2 s, and one
#: that has restarted says nothing until then.
REOPEN_S = 3.0


def monitor(
    *,
    interface: str = "slcan",
    channel: str,
    log: Path | str | None = None,
    duration: float | None = None,
    bitrate: int | None = None,
) -> Statistics:
    """Show what arrives until Ctrl-C, until `duration` (s) is over, or until the other side has gone.

    `log`: file for the raw frames as they arrive, damaged ones too; its suffix chooses python-can's format. `bitrate`
    of the CAN bus, bit/s, where the interface needs one. Raises UserError for an interface that cannot be opened or
    another suffix.
    """
    import can

    if log is not None and Path(log).suffix.lower() not in LOGS:
        raise UserError(f"{log}: the name of a frame log ends in {', '.join(LOGS)}")
    if duration is not None and not duration > 0.0:
        raise UserError(f"--duration must be above 0 s, not {duration:g}")
    decoder = Decoder()
    with ExitStack() as stack:
        link = stack.enter_context(open_bus(interface, channel, **({} if bitrate is None else {"bitrate": bitrate})))
        end = None if duration is None else time.monotonic() + duration
        logger = None
        if log is not None:
            try:
                logger = stack.enter_context(can.Logger(str(log)))
            except OSError as error:
                raise UserError(f"{log}: cannot write: {error.strerror}") from error
        heard = time.monotonic()
        view = stack.enter_context(View(decoder, link, f"{interface} {channel}"))
        try:
            while not link.closed and (end is None or time.monotonic() < end):
                frame = link.recv(0.25 if end is None else min(0.25, max(0.0, end - time.monotonic())))
                if frame is None:
                    if time.monotonic() - heard > REOPEN_S:
                        link.open_again()  # a module that has restarted waits for that
                        heard = time.monotonic()
                    continue
                heard = time.monotonic()
                if logger is not None:
                    logger(frame)
                view.show(decoder.feed(frame))
        except KeyboardInterrupt:
            pass
    console = Console(stderr=True)
    if link.closed:
        console.print(f"{channel}: the other side has gone", highlight=False, soft_wrap=True)
    console.print(frame_counts(decoder, link), highlight=False, soft_wrap=True)
    return decoder.statistics
