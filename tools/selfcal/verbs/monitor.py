"""`selfcal monitor`: live view of a module's telemetry on any python-can interface, or of a log of its frames."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from rich.console import Console

from selfcal.checks import Judged
from selfcal.document import Identified, check_writable, to_document, write_json
from selfcal.ending import held
from selfcal.errors import UserError
from selfcal.framelog import WRITTEN, FrameLog
from selfcal.live import Contact, View
from selfcal.plot import check_picture, plot_run
from selfcal.wire import AXES, AxisReport, Decoder, Link, Statistics, axis_unit, open_bus, serial_ports

#: s without a frame after which a serial line is opened again: a module that saves hears nothing for 1 to 2 s, and one
#: that has restarted says nothing until then.
REOPEN_S = 3.0
#: s between looks for a port that has gone.
LOOK_S = 0.5
#: Reports of an axis that are kept for the plot: beyond it every other one goes.
KEPT = 2000


@dataclass
class Outcome(Statistics):
    """The frames, and whether the module was out of reach when the time was up or its port went.

    An end that the user asked for is none of these.
    """

    contact_lost: bool = False


def monitor(
    *,
    interface: str = "slcan",
    channel: str | None = None,
    read: Path | str | None = None,
    speed: float | None = None,
    axes: Sequence[str] = (),
    log: Path | str | None = None,
    duration: float | None = None,
    bitrate: int | None = None,
    once: bool = False,
    json: Path | str | None = None,
    plot: Path | str | None = None,
) -> Outcome:
    """Show what arrives by `channel`, or what the log `read` holds, until Ctrl-C, its end, or until `duration` (s) is
    over.

    A port that vanishes is waited for, unless `once`. `speed`: how many times as fast as it came a log is played;
    default: as fast as it is read. `log`: file for the raw frames as they arrive, damaged ones too; its suffix chooses
    python-can's format. `bitrate` of the CAN bus, bit/s, where the interface needs one. `json`: the last complete
    reports as a document `selfcal.identify/1` in telemetry's units, without checks. `plot`: the picture of the run.
    Raises UserError for what the user can put right.
    """
    import can

    if (channel is None) == (read is None):
        raise UserError(
            f"which module? --channel names its port ({serial_ports()}), or --read a log of its frames: one of the two"
        )
    for name in axes:
        axis_unit(name)
    if speed is not None and (read is None or not 0.0 < speed < math.inf):
        raise UserError("--speed is above 0, and goes with --read")
    if log is not None and Path(log).suffix.lower() not in WRITTEN:
        raise UserError(f"{log}: the name of a frame log ends in {', '.join(WRITTEN)}")
    if duration is not None and not duration > 0.0:
        raise UserError(f"--duration must be above 0 s, not {duration:g}")
    if plot is not None:
        check_picture(plot)
    check_writable(json, plot)
    name = str(read if channel is None else channel)
    decoder = Decoder()
    history: dict[str, list[AxisReport]] = {}
    with held() as ending, ExitStack() as stack:
        source: Link | FrameLog
        if channel is None:
            source = stack.enter_context(FrameLog(name, speed))
            contact, title = None, name
        else:
            options = {} if bitrate is None else {"bitrate": bitrate}
            source = stack.enter_context(open_bus(interface, channel, **options))
            contact, title = Contact(), f"{interface} {channel}"
        end = math.inf if duration is None else time.monotonic() + duration
        logger = None
        if log is not None:
            try:
                logger = stack.enter_context(can.Logger(str(log)))
            except OSError as error:
                raise UserError(f"{log}: cannot write: {error.strerror}") from error
        opened = time.monotonic()
        view = View(decoder, source, title, contact=contact, axes=axes)
        try:
            with view:
                while not ending.asked and (left := end - time.monotonic()) > 0.0:
                    if source.closed:
                        if once or not isinstance(source, Link):
                            break
                        if not source.reconnect():
                            time.sleep(min(LOOK_S, left))
                        opened = time.monotonic()
                        continue
                    received, lost, malformed = decoder.statistics.received, decoder.statistics.lost, source.malformed
                    frame = source.recv(min(0.25, left))
                    reports = [] if frame is None else decoder.feed(frame)
                    in_a_row = (decoder.statistics.received, decoder.statistics.lost) == (received + 1, lost)
                    if contact is not None and (frame is not None or source.malformed > malformed):
                        contact.heard(in_a_row=in_a_row)
                    if frame is None:
                        if contact is not None and min(contact.silent_s, time.monotonic() - opened) > REOPEN_S:
                            cast(Link, source).open_again()  # a module that has restarted waits for that
                            opened = time.monotonic()
                        continue
                    if logger is not None:
                        logger(frame)
                    view.show(reports)
                    _keep(history, [one for one in reports if not axes or one.axis in axes])
            wanted = ending.asked
        except KeyboardInterrupt:
            wanted = True
        view.show(decoder.flush())
        view.print_last()
        outcome = Outcome(**vars(decoder.statistics))
        console = Console(stderr=True)
        for line in _farewell(source, contact, decoder, name):
            outcome.contact_lost = not wanted
            console.print(line, highlight=False, markup=False, soft_wrap=True)
    reported = {axis: history[axis] for axis in AXES if axis in history}
    if (json is not None or plot is not None) and not reported:
        raise UserError(f"{name}: no complete report came, so there is nothing to write")
    if json is not None:
        write_json(_document(reported, decoder.status, name), json)
    if plot is not None:
        plot_run(reported, plot, f"{Path(name).name}: the module's telemetry")
        console.print(f"plot: {plot}", highlight=False, markup=False, soft_wrap=True)
    return outcome


def _keep(history: dict[str, list[AxisReport]], reports: Sequence[AxisReport]) -> None:
    """Add the complete reports. One from before the last of its axis comes from a module that has started anew."""
    for report in reports:
        if not report.complete:
            continue
        if report.axis in history and report.time_s < history[report.axis][-1].time_s:
            history.clear()
        kept = history.setdefault(report.axis, [])
        kept.append(report)
        if len(kept) > KEPT:
            del kept[1:-1:2]


def _farewell(source: Link | FrameLog, contact: Contact | None, decoder: Decoder, name: str) -> list[str]:
    """What went wrong at the end, if anything did."""
    if isinstance(source, FrameLog):
        return [f"{name}: the log is damaged and ends early: {source.damage}"] if source.damage else []
    assert contact is not None
    if decoder.finished:
        return []
    if source.closed:
        return [f"{name}: the other side has gone"]
    if not contact.ever:
        return [f"{name}: no word from a module"]
    return [f"{name}: contact lost, no word for {contact.silent_s:.0f} s"] if contact.lost else []


def _document(history: Mapping[str, Sequence[AxisReport]], status: Mapping[str, float], name: str) -> dict[str, Any]:
    """The last complete reports as `identify` gives its results. Checks need the samples, which are not here."""
    interval, block = status.get("bank_interval", math.nan), status.get("bank_block", math.nan)
    run = SimpleNamespace(
        path=name,
        rate_hz=block / interval if interval > 0.0 else math.nan,
        samples=int(status["samples"]) if "samples" in status else None,
        duration_s=max(reports[-1].time_s for reports in history.values()),
    )
    found = {
        axis: Identified(axis_unit(axis), axis_unit(axis), reports[-1].result(), Judged({}, None), {})
        for axis, reports in history.items()
    }
    document = to_document(cast(Any, run), found)
    for axis in document["axes"].values():
        axis["adequate"] = None
    return document
