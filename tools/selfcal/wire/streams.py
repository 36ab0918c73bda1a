"""Reports of modules for other programs, as they come: JSON by UDP, by lines, by Foxglove's websocket, in MCAP files;
messages of ROS 2 by lines.

Each report is a JSON object. PlotJuggler takes the form of UDP and lines: its curves are node0/gx/bias/mean and so on,
and `timestamp` is the host's clock when the report came, s since 1970. Foxglove and MCAP have a topic an axis,
/selfcal/node0/gx, and the same numbers in it.
"""

from __future__ import annotations

import base64
import json
import os
import select
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any, BinaryIO, Protocol
from urllib.parse import urlsplit

from selfcal.base.ending import HeldSignals
from selfcal.base.errors import UserError, install_line
from selfcal.base.limits import MOST_RATE_HZ
from selfcal.base.output import finite
from selfcal.base.units import parameter_unit
from selfcal.logs.framelog import FRAMES
from selfcal.wire.dbc_file import PLACE_NAMES, Names
from selfcal.wire.frames import AXES, STATISTICS, AxisReport, axis_unit
from selfcal.wire.live import hypotheses_seen
from selfcal.wire.ros_messages import diagnostics, imu

if TYPE_CHECKING:
    import can

#: Default ports of the programs: PlotJuggler's UDP server, Foxglove's websocket.
PORTS = {"udp-json": 9870, "foxglove": 8765}
#: Kinds of streams on stdout; `ros` takes the rate of the readings, Hz.
LINES = ("jsonl", "ros")
KINDS = (*PORTS, *LINES)
HOST = "127.0.0.1"


class Stream(Protocol):
    """Where reports go."""

    def send(self, report: Mapping[str, Any], at_s: float) -> None:
        """Take what `report_content` made of a report, that came at `at_s`, s since 1970."""

    def close(self) -> None:
        """No more will come."""


def report_content(report: AxisReport, names: Names) -> dict[str, Any]:
    """A report as JSON has it, by the module's `names`; values that did not arrive are absent, NaN is null."""
    v, unit = report.values, axis_unit(report.axis)
    entry: dict[str, Any] = {
        "node": report.node,
        "axis": report.axis,
        "time_s": report.time_s,
        "complete": report.complete,
        "unit": unit,
        "bias": {key: v[f"bias_{key}"] for key in ("mean", "sd") if f"bias_{key}" in v},
    }
    if "count" in v:
        entry["averages"] = int(v["count"])
    laws: dict[str, Any] = {}
    for k in range(report.hypotheses or hypotheses_seen(report)):
        named = k < len(names.hypotheses)
        law: dict[str, Any] = {}
        if f"h{k}_probability" in v:
            law["probability"] = v[f"h{k}_probability"]
        for place, parameter in zip(PLACE_NAMES, names.parameters[k] if named else PLACE_NAMES, strict=False):
            statistics = {key: v[f"h{k}_{place}_{key}"] for key in STATISTICS if f"h{k}_{place}_{key}" in v}
            if statistics:
                law[parameter] = {**statistics, "unit": parameter_unit(parameter, unit)}
        laws[names.hypotheses[k] if named else f"h{k}"] = law
    entry["laws"] = laws
    if report.adequacy is not None:
        entry["adequacy"] = {"state": report.adequacy.state, "suspicion": report.adequacy.suspicion}
    coefficients = report.coefficients(names)
    if coefficients:
        entry["coefficients"] = {
            column: {"mean": mean, "sd": sd, "probability": p} for column, (mean, sd, p) in coefficients.items()
        }
    plain: dict[str, Any] = finite(entry)
    return plain


def topic(report: Mapping[str, Any]) -> str:
    """Topic of a report's content."""
    return f"/selfcal/node{report['node']}/{report['axis']}"


def line_of(report: Mapping[str, Any], at_s: float) -> str:
    """A report for PlotJuggler."""
    numbers = {key: value for key, value in report.items() if key not in ("node", "axis")}
    return json.dumps({"timestamp": at_s, f"node{report['node']}": {report["axis"]: numbers}}, allow_nan=False)


class _Udp:
    """A datagram each; nobody has to listen."""

    def __init__(self, host: str, port: int) -> None:
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise UserError(f"--stream udp-json: {host}: {error.strerror or error}") from error
        self._address, self._socket = address, socket.socket(family, kind)

    def send(self, report: Mapping[str, Any], at_s: float) -> None:
        try:
            self._socket.sendto(line_of(report, at_s).encode(), self._address)
        except ConnectionRefusedError:
            pass  # of an earlier datagram that nobody took
        except OSError as error:
            raise UserError(f"--stream udp-json: {error.strerror or error}") from error

    def close(self) -> None:
        self._socket.close()


class _Lines:
    """A line each on stdout, at once. It waits for a reader, but no longer than until a signal asks for the end."""

    def send(self, report: Mapping[str, Any], at_s: float) -> None:
        for line in self.lines(report, at_s):
            self._print(line)

    def lines(self, report: Mapping[str, Any], at_s: float) -> Iterator[str]:
        """Lines of a report."""
        yield line_of(report, at_s)

    def _print(self, line: str) -> None:
        try:
            stdout = sys.stdout.fileno()
        except OSError:  # a program's own stdout is no file
            print(line, flush=True)
            return
        sys.stdout.flush()
        data = f"{line}\n".encode()
        while data:
            if select.select([], [stdout], [], 0.25)[1]:
                data = data[os.write(stdout, data[: select.PIPE_BUF]) :]
            elif HeldSignals().asked:
                return

    def close(self) -> None:
        sys.stdout.flush()


class _Ros(_Lines):
    """Messages of ROS 2, a line each: its topic, its type and its fields."""

    def __init__(self, rate_hz: int) -> None:
        self._rate_hz = rate_hz
        self._known: dict[int, dict[str, Mapping[str, Any]]] = {}

    def lines(self, report: Mapping[str, Any], at_s: float) -> Iterator[str]:
        """The status of the axis, and the node's Imu."""
        of_node = self._known.setdefault(report["node"], {})
        of_node[report["axis"]] = report
        for topic_of, kind, message in (
            ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", diagnostics(report, at_s)),
            (f"/selfcal/node{report['node']}/imu", "sensor_msgs/msg/Imu", imu(of_node, self._rate_hz, at_s)),
        ):
            yield json.dumps({"topic": topic_of, "type": kind, "msg": message}, allow_nan=False)


class _Foxglove:
    """A channel an axis, by Foxglove's SDK."""

    def __init__(self, host: str, port: int) -> None:
        try:
            import foxglove
        except ImportError as error:
            typed = install_line("selfcal[foxglove]")
            raise UserError(f"--stream foxglove: foxglove-sdk is not installed: {typed}") from error
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        try:
            self._server = foxglove.start_server(name="selfcal", host=host, port=port, context=self._context)
        except (OSError, RuntimeError, ValueError) as error:
            raise UserError(f"--stream foxglove: {host}:{port}: {error}") from error

    def send(self, report: Mapping[str, Any], at_s: float) -> None:
        import foxglove

        name = topic(report)
        if name not in self._channels:  # all of a module, so that a viewer misses the first report at most
            names = [topic({**report, "axis": axis}) for axis in AXES]
            schema = {"type": "object"}
            self._channels |= {name: foxglove.Channel(name, schema=schema, context=self._context) for name in names}
        self._channels[name].log(dict(report), log_time=round(at_s * 1e9))

    def close(self) -> None:
        self._server.stop()


def check_stream(wanted: str) -> tuple[str, str, int]:
    """Kind, host and port of an option `KIND[:HOST:PORT]`; of `ros:HZ` the rate in place of a port. Raises
    UserError."""
    kind, _, where = wanted.partition(":")
    if kind not in KINDS:
        raise UserError(f"--stream {wanted}: there is no such stream ({', '.join(KINDS)})")
    if kind == "ros":
        if not where.isdecimal() or not 0 < int(where) <= MOST_RATE_HZ:
            raise UserError(f"--stream {wanted}: write ros:HZ, the rate of the readings that the covariances are of")
        return kind, "", int(where)
    if not where:
        return kind, HOST, PORTS.get(kind, 0)
    address = urlsplit(f"//{where}")
    with suppress(ValueError):  # a port that no number of 16 bits is
        if kind in PORTS and address.hostname and address.port:
            return kind, address.hostname, address.port
    raise UserError(f"--stream {wanted}: write {' or '.join(f'{kind}:HOST:PORT' for kind in PORTS)}, or jsonl")


def open_streams(wanted: Sequence[str], stack: ExitStack) -> list[Stream]:
    """The streams of `--stream`, closed with the `stack`. Raises UserError."""
    sinks: list[Stream] = []
    for stream in wanted:
        kind, host, port = check_stream(stream)
        if kind in LINES:
            sinks.append(_Lines() if kind == "jsonl" else _Ros(port))
        else:
            sinks.append(_Udp(host, port) if kind == "udp-json" else _Foxglove(host, port))
        stack.callback(sinks[-1].close)
    return sinks


class McapLog:
    """A new MCAP file: the raw frames, and the reports, a topic an axis. Not chunked: a kill leaves all but the last
    second, and the summary at its end."""

    def __init__(self, stream: BinaryIO) -> None:
        from mcap.writer import CompressionType, Writer

        self.file = stream
        self._writer = Writer(stream, compression=CompressionType.NONE, use_chunking=False)
        self._writer.start(profile="", library="selfcal")
        schema = json.dumps({"type": "object"}).encode()
        self._schemas = {
            name: self._writer.register_schema(name=f"selfcal.{name}", encoding="jsonschema", data=schema)
            for name in ("Frame", "Report")
        }
        self._channels: dict[str, int] = {}

    def __call__(self, frame: can.Message) -> None:
        """Add a frame, as python-can's loggers do."""
        entry = {
            "id": frame.arbitration_id,
            "extended": frame.is_extended_id,
            "data": base64.b64encode(bytes(frame.data)).decode(),
        }
        self._add(FRAMES, "Frame", entry, frame.timestamp or time.time())

    def send(self, report: Mapping[str, Any], at_s: float) -> None:
        """Add a report's content."""
        self._add(topic(report), "Report", report, at_s)

    def _add(self, name: str, schema: str, entry: Mapping[str, Any], at_s: float) -> None:
        if name not in self._channels:
            self._channels[name] = self._writer.register_channel(name, "json", self._schemas[schema])
        at_ns = max(0, round(at_s * 1e9))
        data = json.dumps(entry, allow_nan=False).encode()
        self._writer.add_message(self._channels[name], log_time=at_ns, publish_time=at_ns, data=data)

    def stop(self) -> None:
        """Write the summary and close."""
        finish: Callable[[], None] = self._writer.finish  # mcap does not type it
        finish()
        self.file.close()
