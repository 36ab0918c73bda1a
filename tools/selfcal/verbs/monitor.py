"""Live view of modules' telemetry; exit code 1 if one was out of reach at the end, or two send as one node."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from selfcal.base.errors import UserError
from selfcal.base.options import option
from selfcal.verbs._shared import Axes, From, Json

if TYPE_CHECKING:
    from selfcal.wire.monitor import Outcome


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
    plot: Annotated[Path | str | None, option("Save the plot of the run", metavar="FILE")] = None,
) -> Outcome:
    """Show what arrives by `channel`, or what the log `read` holds, until Ctrl-C, its end, or until `duration` (s) is
    over.

    Several modules of a bus are shown one below the other; `node`: that one alone. `model`: file of a model beside
    the default one, for the names of what a module sends; `start`: the diagnosis that its priors are from. A port
    that vanishes is waited for, unless `once`. `speed`: how many times as fast as it came a log is played; default:
    as fast as it is read. `log`: file for the raw frames as they arrive, damaged ones too; its suffix chooses
    python-can's format, or MCAP, which takes the reports too; an older one is not written over. `stream`: where each
    report goes as it comes, `udp-json` or `foxglove` with `:HOST:PORT` or without, or `jsonl` or `ros:HZ` on stdout.
    `bitrate` of the CAN bus, bit/s, where the interface needs one. `json`: the last complete reports as a document
    `selfcal.identify/1` in telemetry's units, without checks, with the `node`; of several modules a document
    `selfcal.modules/1` that holds one for each. `plot`: the picture of the run; of several modules one each, whose name
    ends in the node. Raises UserError for what the user can put right.
    """
    from rich.console import Console

    from selfcal.base.ending import held
    from selfcal.base.output import check_picture, check_writable, write_json
    from selfcal.logs.framelog import FrameLog, check_suffix
    from selfcal.show.plot import plot_run
    from selfcal.wire.dbc_file import NODES
    from selfcal.wire.frame_writer import FrameWriter
    from selfcal.wire.frames import AXES, REASONS, AxisReport, Link, Streams, axis_unit, open_bus, reasons, serial_ports
    from selfcal.wire.known_models import KnownModels
    from selfcal.wire.live import Contact, View, patient
    from selfcal.wire.monitor import LOOK_S, MODULES, REOPEN_S, Outcome, document, farewell, feed, keep
    from selfcal.wire.streams import LINES, content, open_streams
    from selfcal.wire.streams import check as check_stream

    if (channel is None) == (read is None):
        raise UserError(
            f"which module? --channel names its port ({serial_ports()}), or --read a log of its frames: one of the two"
        )
    for name in axes:
        axis_unit(name)
    if node is not None and not 0 <= node < NODES:
        raise UserError(f"--node {node}: a bus has nodes 0 to {NODES - 1}")
    if speed is not None and (read is None or not 0.0 < speed < math.inf):
        raise UserError("--speed is above 0, and goes with --read")
    if log is not None:
        check_suffix(log)
    if duration is not None and not duration > 0.0:
        raise UserError(f"--duration must be above 0 s, not {duration:g}")
    if plot is not None:
        check_picture(plot)
    for one in stream:
        check_stream(one)
    on_stdout = [kind for kind in (one.split(":")[0] for one in stream) if kind in LINES]
    if len([*on_stdout, *([json] if str(json) == "-" else [])]) > 1:
        raise UserError(f"--stream {on_stdout[0]} and another one, or --json -, are both for stdout: give one alone")
    check_writable(json, plot)
    name = str(read if channel is None else channel)
    models = KnownModels(model, start)
    streams = Streams(node=node)
    contacts: dict[int, Contact] = {}
    histories: dict[int, dict[str, list[AxisReport]]] = {}
    with held() as ending, patient(), ExitStack() as stack:
        source: Link | FrameLog
        if channel is None:
            source = stack.enter_context(FrameLog(name, speed))
            contact, title = None, name
        else:
            options = {} if bitrate is None else {"bitrate": bitrate}
            source = stack.enter_context(open_bus(interface, channel, **options))
            contact, title = Contact(), f"{interface} {channel}"
        end = math.inf if duration is None else time.monotonic() + duration
        writer = None if log is None else stack.enter_context(FrameWriter(log))
        sinks = open_streams(stream, stack)

        def pass_on(reports: Sequence[AxisReport], at_s: float) -> None:
            for report in (one for one in reports if one.axis in (axes or AXES)):
                told = content(report, models.names(streams.decoders[report.node].status))
                for sink in sinks:
                    sink.send(told, at_s)
                if writer is not None:
                    writer.report(told, at_s)

        opened, came_s = time.monotonic(), time.time()
        view = View(
            streams,
            source,
            title,
            contact=contact,
            contacts=contacts,
            axes=axes,
            names=models.names,
            advice=models.advice,
        )
        try:
            with view:
                while not ending.asked and (left := end - time.monotonic()) > 0.0:
                    if writer is not None:
                        writer.keep()
                    if source.closed:
                        if once or not isinstance(source, Link):
                            break
                        if not source.reconnect():
                            time.sleep(min(LOOK_S, left))
                        opened = time.monotonic()
                        continue
                    malformed = source.malformed
                    frame = source.recv(min(0.25, left))
                    reports = [] if frame is None else feed(streams, frame, contacts if contact is not None else None)
                    if contact is not None and (frame is not None or source.malformed > malformed):
                        contact.heard(in_a_row=False, paced=any(one.paced for one in contacts.values()))
                    if frame is None:
                        if contact is not None and min(contact.silent_s, time.monotonic() - opened) > REOPEN_S:
                            cast(Link, source).open_again()  # a module that has restarted waits for that
                            opened = time.monotonic()
                        continue
                    if writer is not None:
                        writer.write(frame)
                    if streams.known and all(one.surely_foreign for one in streams.known.values()):
                        break
                    view.show(reports)
                    came_s = time.time() if contact is not None else frame.timestamp
                    pass_on(reports, came_s)
                    for report in reports:
                        if report.axis in (axes or AXES):
                            keep(histories.setdefault(report.node, {}), [report])
            wanted = ending.asked
        except KeyboardInterrupt:
            wanted = True
        left_over = streams.flush()
        view.show(left_over)
        pass_on(left_over, came_s)
        view.print_last()
        outcome = Outcome(**vars(streams.statistics))
        console = Console(stderr=True)
        for line in farewell(source, contact, contacts, streams, name):
            outcome.contact_lost = not wanted
            console.print(line, highlight=False, markup=False, soft_wrap=True)
        for decoder in streams.known.values():
            if decoder.twins:
                outcome.twins = True
                console.print(f"{name}: {decoder.twins}", highlight=False, markup=False, soft_wrap=True)
    known = streams.known
    foreign = {number: decoder.foreign for number, decoder in known.items() if decoder.foreign}
    if foreign and len(foreign) == len(known):
        raise UserError(f"{name}: {next(iter(foreign.values()))}")
    reported = {
        number: {axis: histories[number][axis] for axis in AXES if axis in histories[number]}
        for number in sorted(histories)
        if number in known and histories[number]
    }
    if (json is not None or plot is not None) and not reported:
        why = {axis: word for one in known.values() for axis, word in reasons(one.status, one.corrected).items()}
        said = "".join(f"; {axis}: {REASONS.get(word, word)}" for axis, word in why.items())
        raise UserError(f"{name}: no complete report came, so there is nothing to write{said}")
    names = {number: models.names(known[number].status) for number in reported}
    if json is not None:
        documents = {
            number: document(history, known[number], name, names[number], number)
            for number, history in reported.items()
        }
        several = {"schema": MODULES, "modules": {str(number): one for number, one in documents.items()}}
        write_json(next(iter(documents.values())) if len(documents) == 1 else several, json)
    if plot is not None:
        for number, history in reported.items():
            file = Path(plot) if len(reported) == 1 else Path(plot).with_stem(f"{Path(plot).stem}-node{number}")
            which = f" of node {number}" if len(reported) > 1 or number else ""
            plot_run(history, file, f"{Path(name).name}: the module's telemetry{which}", names=names[number])
            console.print(f"plot: {file}", highlight=False, markup=False, soft_wrap=True)
    return outcome


def show(outcome: Outcome, given: Mapping[str, Any]) -> int:
    """Exit code 1 if a module was out of reach when the time was up, or two send as one node."""
    return 1 if outcome.contact_lost or outcome.twins else 0
