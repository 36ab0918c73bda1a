"""`selfcal monitor`: live view of the telemetry of one module or several on any python-can interface, or of a log."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from selfcal.adequacy.checks import Judged
from selfcal.adequacy.document import Identified, Telemetry, to_document
from selfcal.logs.framelog import FrameLog
from selfcal.wire.dbc_file import Names
from selfcal.wire.frames import (
    AxisReport,
    Decoder,
    Link,
    Statistics,
    Streams,
    axis_unit,
    node_of,
    reasons,
)
from selfcal.wire.live import SILENT_S, Contact

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

    An end that the user asked for is none of these. `twins`: two modules send as one node.
    """

    contact_lost: bool = False
    twins: bool = False


def feed(streams: Streams, frame: can.Message, contacts: dict[int, Contact] | None) -> list[AxisReport]:
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


def keep(history: dict[str, list[AxisReport]], reports: Sequence[AxisReport]) -> None:
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


def farewell(
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


def document(
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
        report = history[axis][-1]
        says = report.adequacy
        entry["adequate"] = None
        entry["adequacy"] = asdict(says) if says is not None else None
        entry["time_s"], entry["averages"] = report.time_s, int(report.value("count"))
        entry["module_reason"] = why.get(axis)
        told = report.coefficients(names)
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
