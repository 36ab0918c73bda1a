"""`selfcal monitor`: live view of the telemetry of one module or several on any python-can interface, or of a log."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from rich.console import Console

from selfcal.adequacy.checks import Judged
from selfcal.adequacy.document import Identified, Telemetry, check_writable, to_document, write_json
from selfcal.base.ending import held
from selfcal.base.errors import UserError
from selfcal.show.plot import check_picture, plot_run
from selfcal.wire.dbc_file import NODES, Names
from selfcal.wire.framelog import FrameLog, FrameWriter, check_suffix
from selfcal.wire.frames import (
    AXES,
    REASONS,
    AxisReport,
    Decoder,
    Link,
    Statistics,
    Streams,
    axis_unit,
    node_of,
    open_bus,
    reasons,
    serial_ports,
)
from selfcal.wire.known_models import KnownModels
from selfcal.wire.live import SILENT_S, Contact, View, patient
from selfcal.wire.streams import check as check_stream
from selfcal.wire.streams import content, open_streams

if TYPE_CHECKING:
    import can

#: s without a frame after which a serial line is opened again: a module that saves hears nothing for 1 to 2 s, and one
#: that has restarted says nothing until then.
REOPEN_S = 3.0
#: s between looks for a port that has gone.
LOOK_S = 0.5
#: Schema of the document of several modules.
MODULES = "selfcal.modules/1"
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
    node: int | None = None,
    model: Path | str | None = None,
    start: Path | str | None = None,
    log: Path | str | None = None,
    stream: Sequence[str] = (),
    duration: float | None = None,
    bitrate: int | None = None,
    once: bool = False,
    json: Path | str | None = None,
    plot: Path | str | None = None,
) -> Outcome:
    """Show what arrives by `channel`, or what the log `read` holds, until Ctrl-C, its end, or until `duration` (s) is
    over.

    Several modules of a bus are shown one below the other; `node`: that one alone. `model`: file of a model beside
    the default one, for the names of what a module sends; `start`: the diagnosis that its priors are from. A port
    that vanishes is waited for, unless `once`. `speed`: how many times as fast as it came a log is played; default:
    as fast as it is read. `log`: file for the raw frames as they arrive, damaged ones too; its suffix chooses
    python-can's format, or MCAP, which takes the reports too; an older one is not written over. `stream`: where each
    report goes as it comes, `udp-json` or `foxglove` with `:HOST:PORT` or without, or `jsonl` on stdout. `bitrate` of
    the CAN bus, bit/s, where the interface needs one. `json`: the last complete reports as a document
    `selfcal.identify/1` in telemetry's units, without checks, with the `node`; of several modules a document
    `selfcal.modules/1` that holds one for each. `plot`: the
    picture of the run; of several modules one each, whose name ends in the node. Raises UserError for what the user
    can put right.
    """
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
    if "jsonl" in stream and str(json) == "-":
        raise UserError("--stream jsonl and --json - are both for stdout: give --json a file")
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
                    reports = [] if frame is None else _feed(streams, frame, contacts if contact is not None else None)
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
                            _keep(histories.setdefault(report.node, {}), [report])
            wanted = ending.asked
        except KeyboardInterrupt:
            wanted = True
        left_over = streams.flush()
        view.show(left_over)
        pass_on(left_over, came_s)
        view.print_last()
        outcome = Outcome(**vars(streams.statistics))
        console = Console(stderr=True)
        for line in _farewell(source, contact, contacts, streams, name):
            outcome.contact_lost = not wanted
            console.print(line, highlight=False, markup=False, soft_wrap=True)
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
            number: _document(history, known[number], name, names[number], number)
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


def _feed(streams: Streams, frame: can.Message, contacts: dict[int, Contact] | None) -> list[AxisReport]:
    """Take a frame, and note by the host's clock that its module was heard."""
    node = node_of(frame.arbitration_id)
    before = streams.decoders.get(node) if node is not None else None
    received, lost = (before.statistics.received, before.statistics.lost) if before is not None else (0, 0)
    reports = streams.feed(frame)
    decoder = streams.decoders.get(node) if node is not None else None
    if contacts is not None and decoder is not None and decoder.statistics.received > received:
        in_a_row = (decoder.statistics.received, decoder.statistics.lost) == (received + 1, lost)
        first, last = decoder.status_ms or (0, 0)
        contacts.setdefault(decoder.node, Contact()).heard(
            in_a_row=in_a_row, paced=abs(last - first) > 1000.0 * SILENT_S
        )
    return reports


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


def _farewell(
    source: Link | FrameLog, contact: Contact | None, contacts: Mapping[int, Contact], streams: Streams, name: str
) -> list[str]:
    """What went wrong at the end, if anything did."""
    if isinstance(source, FrameLog):
        return [f"{name}: the log is damaged and ends early: {source.damage}"] if source.damage else []
    assert contact is not None
    known = streams.known
    if known and all(decoder.finished for decoder in known.values()):
        return []
    if source.closed:
        return [f"{name}: the other side has gone"]
    if not contact.ever:
        return [f"{name}: no word from a module"]
    lost = {node: contacts[node] for node, one in known.items() if not one.finished and contacts[node].lost}
    said = [
        f"{name}: {f'node {node}: ' if set(known) != {0} else ''}contact lost, no word for {one.silent_s:.0f} s"
        for node, one in lost.items()
    ]
    if not known and contact.lost:
        said.append(f"{name}: contact lost, no word for {contact.silent_s:.0f} s")
    return said


def _document(
    history: Mapping[str, Sequence[AxisReport]], decoder: Decoder, name: str, names: Names, node: int
) -> dict[str, Any]:
    """The last complete reports as `identify` gives its results. Checks need the samples, which are not here."""
    status, why = decoder.status, reasons(decoder.status, decoder.corrected)
    interval, block = status.get("bank_interval", math.nan), status.get("bank_block", math.nan)
    run = Telemetry(
        path=name,
        rate_hz=block / interval if interval > 0.0 else math.nan,
        samples=int(status["samples"]) if "samples" in status else None,
        duration_s=max(reports[-1].time_s for reports in history.values()),
    )
    found = {
        axis: Identified(axis_unit(axis), axis_unit(axis), reports[-1].result(names), Judged({}, None), {})
        for axis, reports in history.items()
    }
    document = to_document(run, found)
    document["node"] = node
    for axis, entry in document["axes"].items():
        entry["adequate"] = None
        entry["module_reason"] = why.get(axis)
        told = history[axis][-1].coefficients(names)
        if told:
            units = dict(names.columns)
            entry["coefficients"] = {
                column: {
                    "mean": mean,
                    "sd": sd,
                    "probability": probability,
                    "unit": f"{axis_unit(axis)}/{units[column]}" if units[column] else None,
                }
                for column, (mean, sd, probability) in told.items()
            }
    return document
