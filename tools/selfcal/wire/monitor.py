"""`selfcal monitor`: live view of the telemetry of a module or several on any python-can interface, or of a log."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, cast

from selfcal.adequacy.checks import Judged
from selfcal.adequacy.identify_document import Identified, identify_document
from selfcal.base.ending import HeldSignals
from selfcal.base.errors import UserError
from selfcal.logs.framelog import FrameLog
from selfcal.wire.dbc_file import Names
from selfcal.wire.frame_writer import FrameWriter
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
    reasons,
)
from selfcal.wire.known_models import KnownModels
from selfcal.wire.live import SILENT_S, Contact, View
from selfcal.wire.streams import Stream, report_content

if TYPE_CHECKING:
    import can

#: Schema of the document of several modules.
MODULES = "selfcal.modules/1"


@dataclass
class MonitorOutcome(Statistics):
    """The frames, and whether the module was out of reach when the time was up or its port went.

    An end that the user asked for does not count. `twins`: two modules send as one node.
    """

    contact_lost: bool = False
    twins: bool = False


@dataclass
class Run:
    """A run of `monitor`: what the source gives is decoded, passed on and kept. `name` of the source; `axes` to pass
    on, all if empty; `contact` with a channel, None for a log."""

    source: Link | FrameLog
    name: str
    axes: Sequence[str]
    models: KnownModels
    streams: Streams
    sinks: Sequence[Stream]
    writer: FrameWriter | None
    contact: Contact | None
    contacts: dict[int, Contact] = field(default_factory=dict)
    histories: dict[int, dict[str, list[AxisReport]]] = field(default_factory=dict)
    #: When the source was opened, s of time.monotonic(), and when the last frame came, s since 1970.
    opened_s: float = field(default_factory=time.monotonic)
    came_s: float = field(default_factory=time.time)

    def listen(self, view: View, ending: HeldSignals, end_s: float, once: bool) -> None:
        """Take frames until a signal, `end_s` of time.monotonic(), the source's end, or until all nodes are foreign. A
        port that vanishes is waited for, unless `once`."""
        while not ending.asked and (left_s := end_s - time.monotonic()) > 0.0:
            if self.writer is not None:
                self.writer.keep()
            if self.source.closed:
                if once or not isinstance(self.source, Link):
                    return
                if not self.source.reconnect():
                    time.sleep(min(0.5, left_s))
                self.opened_s = time.monotonic()
            elif (heard := self._heard(left_s)) is not None:
                frame, reports = heard
                if self.writer is not None:
                    self.writer.write(frame)
                if self.streams.known and all(decoder.surely_foreign for decoder in self.streams.known.values()):
                    return
                view.show(reports)
                self.came_s = time.time() if self.contact is not None else frame.timestamp
                self.pass_on(reports)
                for report in self._chosen(reports):
                    keep(self.histories.setdefault(report.node, {}), report)

    def _heard(self, left_s: float) -> tuple[can.Message, list[AxisReport]] | None:
        """The next frame and the reports that it closes. A line that stays silent is opened again."""
        malformed = self.source.malformed
        frame = self.source.recv(min(0.25, left_s))
        reports = [] if frame is None else self._feed(frame)
        if self.contact is not None and (frame is not None or self.source.malformed > malformed):
            self.contact.heard(in_a_row=False, paced=any(contact.paced for contact in self.contacts.values()))
        if frame is not None:
            return frame, reports
        # A module that saves is deaf for 1 to 2 s; a restarted module waits for the channel to be opened.
        if self.contact is not None and min(self.contact.silent_s, time.monotonic() - self.opened_s) > SILENT_S:
            cast(Link, self.source).order("open")  # a module that has restarted waits for that
            self.opened_s = time.monotonic()
        return None

    def _feed(self, frame: can.Message) -> list[AxisReport]:
        """Take a frame, and note by the host's clock that its module was heard."""
        node = node_of(frame.arbitration_id)
        before = self.streams.decoders.get(node) if node is not None else None
        received, lost = (before.statistics.received, before.statistics.lost) if before is not None else (0, 0)
        reports = self.streams.feed(frame)
        decoder = self.streams.decoders.get(node) if node is not None else None
        if self.contact is not None and decoder is not None and decoder.statistics.received > received:
            in_a_row = (decoder.statistics.received, decoder.statistics.lost) == (received + 1, lost)
            first, last = decoder.status_ms or (0, 0)
            contact = self.contacts.setdefault(decoder.node, Contact())
            contact.heard(in_a_row=in_a_row, paced=abs(last - first) > 1000.0 * SILENT_S)
        return reports

    def _chosen(self, reports: Iterable[AxisReport]) -> list[AxisReport]:
        return [report for report in reports if report.axis in (self.axes or AXES)]

    def pass_on(self, reports: Sequence[AxisReport]) -> None:
        """Give reports to the programs that listen, and to the log."""
        for report in self._chosen(reports):
            entry = report_content(report, self.models.names(self.streams.decoders[report.node].status))
            for sink in self.sinks:
                sink.send(entry, self.came_s)
            if self.writer is not None:
                self.writer.report(entry, self.came_s)

    def reported(self, needed: bool) -> dict[int, dict[str, list[AxisReport]]]:
        """The complete reports by node and axis, both in order. Raises UserError if every node is foreign, or if a
        report is `needed` and none came."""
        known = self.streams.known
        foreign = [decoder.foreign for decoder in known.values() if decoder.foreign]
        if foreign and len(foreign) == len(known):
            raise UserError(f"{self.name}: {foreign[0]}")
        reported = {
            node: {axis: history[axis] for axis in AXES if axis in history}
            for node, history in sorted(self.histories.items())
            if node in known and history
        }
        if needed and not reported:
            why = {
                a: word for decoder in known.values() for a, word in reasons(decoder.status, decoder.corrected).items()
            }
            said = "".join(f"; {axis}: {REASONS.get(word, word)}" for axis, word in why.items())
            raise UserError(f"{self.name}: no complete report came, so there is nothing to write{said}")
        return reported

    def names(self, node: int) -> Names:
        """Names of the model that a node runs."""
        return self.models.names(self.streams.known[node].status)

    def document(self, reported: Mapping[int, Mapping[str, Sequence[AxisReport]]]) -> dict[str, Any]:
        """The document of the node that reported, or of several."""
        known = self.streams.known
        documents = {
            node: document(history, known[node], self.name, self.names(node), node)
            for node, history in reported.items()
        }
        if len(documents) == 1:
            return next(iter(documents.values()))
        return {"schema": MODULES, "modules": {str(node): entry for node, entry in documents.items()}}

    def farewell(self) -> list[str]:
        """Faults at the end, a line each."""
        if isinstance(self.source, FrameLog):
            damage = self.source.damage
            return [f"{self.name}: the log is damaged and ends early: {damage}"] if damage else []
        assert self.contact is not None
        known = self.streams.known
        if known and all(decoder.finished for decoder in known.values()):
            return []
        if self.source.closed:
            return [f"{self.name}: the other side has gone"]
        if not self.contact.ever:
            return [f"{self.name}: no word from a module"]
        silent_s = {
            f"node {node}: " if set(known) != {0} else "": self.contacts[node].silent_s
            for node, decoder in known.items()
            if not decoder.finished and self.contacts[node].lost
        }
        if not known and self.contact.lost:
            silent_s[""] = self.contact.silent_s
        return [f"{self.name}: {node}contact lost, no word for {s:.0f} s" for node, s in silent_s.items()]


def keep(history: dict[str, list[AxisReport]], report: AxisReport) -> None:
    """Add a complete report. A report from before the last of its axis comes from a module that has started anew."""
    if not report.complete:
        return
    if report.axis in history and report.time_s < history[report.axis][-1].time_s:
        history.clear()
    kept = history.setdefault(report.axis, [])
    kept.append(report)
    if len(kept) > 2000:
        del kept[1:-1:2]


def document(
    history: Mapping[str, Sequence[AxisReport]], decoder: Decoder, name: str, names: Names, node: int
) -> dict[str, Any]:
    """The last complete reports as `identify` gives its results. Checks need the samples, which are not here."""
    status, why = decoder.status, reasons(decoder.status, decoder.corrected)
    interval, block = status.get("bank_interval", math.nan), status.get("bank_block", math.nan)
    run = {
        "path": name,
        "rate_hz": block / interval if interval > 0.0 else math.nan,
        "samples": int(status["samples"]) if "samples" in status else None,
        "duration_s": max(reports[-1].time_s for reports in history.values()),
        "start_s": 0.0,
        "since_power_on_s": None,
    }
    identified = {
        axis: Identified(axis_unit(axis), axis_unit(axis), reports[-1].result(names), Judged({}, None), {})
        for axis, reports in history.items()
    }
    document = identify_document(run, identified)
    document["node"] = node
    for axis, entry in document["axes"].items():
        report = history[axis][-1]
        says = report.adequacy
        entry["adequate"] = None
        entry["adequacy"] = asdict(says) if says is not None else None
        entry["time_s"], entry["averages"] = report.time_s, int(report.value("count"))
        entry["module_reason"] = why.get(axis)
        coefficients = report.coefficients(names)
        if coefficients:
            units = dict(names.columns)
            entry["coefficients"] = {
                column: {
                    "mean": mean,
                    "sd": sd,
                    "probability": probability,
                    "unit": f"{axis_unit(axis)}/{units[column]}" if units[column] else None,
                }
                for column, (mean, sd, probability) in coefficients.items()
            }
    return document
