"""Live view of modules' telemetry; exit code 1 if one was out of reach at the end, or two send as one node."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from selfcal.base.errors import UserError
from selfcal.base.options import option
from selfcal.verbs._shared import Axes, From, Json, RunPlot

if TYPE_CHECKING:
    from selfcal.logs.framelog import FrameLog
    from selfcal.wire.frames import Link
    from selfcal.wire.monitor import MonitorOutcome


def monitor(
    *,
    interface: Annotated[str, option("python-can interface", metavar="NAME")] = "slcan",
    channel: Annotated[str | None, option("Channel: a serial port for slcan", metavar="NAME")] = None,
    read: Annotated[Path | str | None, option("Read a log of frames instead of a channel", metavar="FILE")] = None,
    speed: Annotated[float | None, option("Of --read, 1 as it came; default: at once", metavar="X")] = None,
    axes: Axes = (),
    node: Annotated[int | None, option("Show this module alone, 0 to 11", metavar="N")] = None,
    model: Annotated[
        Path | str | None, option("Model of a module, for names; default: the default one", metavar="MODEL.yaml")
    ] = None,
    start: From = None,
    log: Annotated[
        Path | str | None,
        option("Keep the raw frames (.asc .blf .csv .log .trc), with the reports (.mcap)", metavar="FILE"),
    ] = None,
    stream: Annotated[
        Sequence[str],
        option("Reports for other programs: udp-json, jsonl, foxglove, ros:HZ (repeat)", metavar="KIND[:HOST:PORT]"),
    ] = (),
    duration: Annotated[float | None, option("Stop after this long; default: Ctrl-C", metavar="S")] = None,
    bitrate: Annotated[int | None, option("Of the CAN bus, if it needs one", metavar="BIT/S")] = None,
    once: Annotated[bool, option("End when the port vanishes instead of waiting for it", "--once")] = False,
    json: Json = None,
    plot: RunPlot = None,
) -> MonitorOutcome:
    """Show what arrives by `channel`, or what the log `read` holds, until Ctrl-C, its end, or until `duration` (s) is
    over.

    Several modules of a bus are shown one below the other. An older `log` is not written over. `stream`: `udp-json` or
    `foxglove` with `:HOST:PORT` or without, or `jsonl` or `ros:HZ` on stdout. `json`: the last complete reports as a
    document `selfcal.identify/1` in telemetry's units, without checks, with the `node`; of several modules a document
    `selfcal.modules/1` that holds one for each. `plot`: of several modules one each, whose name ends in the node.
    Raises UserError for what the user can put right.
    """
    from rich.console import Console

    from selfcal.base.ending import hold_signals
    from selfcal.base.output import check_picture, check_writable, print_line, write_json
    from selfcal.logs.framelog import FrameLog, check_suffix
    from selfcal.show.run_plot import plot_run
    from selfcal.wire.dbc_file import check_node
    from selfcal.wire.frame_writer import FrameWriter
    from selfcal.wire.frames import Streams, axis_unit, open_bus, serial_ports
    from selfcal.wire.known_models import KnownModels
    from selfcal.wire.live import Contact, View, patient
    from selfcal.wire.monitor import MonitorOutcome, Run
    from selfcal.wire.streams import LINES, check_stream, open_streams

    if (channel is None) == (read is None):
        raise UserError(
            f"which module? --channel names its port ({serial_ports()}), or --read a log of its frames: one of the two"
        )
    for axis in axes:
        axis_unit(axis)
    if node is not None:
        check_node(node)
    if speed is not None and (read is None or not 0.0 < speed < math.inf):
        raise UserError("--speed is above 0, and goes with --read")
    if log is not None:
        check_suffix(log)
    if duration is not None and not duration > 0.0:
        raise UserError(f"--duration must be above 0 s, not {duration:g}")
    check_picture(plot)
    for kind in stream:
        check_stream(kind)
    on_stdout = [kind for kind in (wanted.split(":")[0] for wanted in stream) if kind in LINES]
    if len(on_stdout) + (str(json) == "-") > 1:
        raise UserError(f"--stream {on_stdout[0]} and another one, or --json -, are both for stdout: give one alone")
    check_writable(json, plot)
    name = str(read if channel is None else channel)
    models = KnownModels(model, start)
    streams = Streams(node=node)
    say = partial(print_line, Console(stderr=True))
    with hold_signals() as ending, patient(), ExitStack() as stack:
        source: Link | FrameLog
        if channel is None:
            source, contact, title = stack.enter_context(FrameLog(name, speed)), None, name
        else:
            options = {} if bitrate is None else {"bitrate": bitrate}
            source = stack.enter_context(open_bus(interface, channel, **options))
            contact, title = Contact(), f"{interface} {channel}"
        end_s = math.inf if duration is None else time.monotonic() + duration
        writer = None if log is None else stack.enter_context(FrameWriter(log))
        run = Run(source, name, axes, models, streams, open_streams(stream, stack), writer, contact)
        view = View(streams, source, title, None, contact, axes, run.contacts, models.names, models.advice)
        try:
            with view:
                run.listen(view, ending, end_s, once)
            wanted = ending.asked
        except KeyboardInterrupt:
            wanted = True
        left_over = streams.flush()
        view.show(left_over)
        run.pass_on(left_over)
        view.print_last()
        outcome = MonitorOutcome(**vars(streams.statistics))
        for line in run.farewell():
            outcome.contact_lost = not wanted
            say(line)
        for decoder in streams.known.values():
            if decoder.twins:
                outcome.twins = True
                say(f"{name}: {decoder.twins}")
    reported = run.reported(needed=json is not None or plot is not None)
    write_json(run.document(reported), json)
    if plot is not None:
        for number, history in reported.items():
            several = len(reported) > 1
            file = Path(plot).with_stem(f"{Path(plot).stem}-node{number}") if several else Path(plot)
            title = f"{Path(name).name}: the module's telemetry{f' of node {number}' if several or number else ''}"
            plot_run(history, file, title, names=run.names(number))
            say(f"plot: {file}")
    return outcome


def show(outcome: MonitorOutcome, given: Mapping[str, Any]) -> int:
    """Exit code 1 if a module was out of reach when the time was up, or two send as one node."""
    return 1 if outcome.contact_lost or outcome.twins else 0
