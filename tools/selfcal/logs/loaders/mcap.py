"""MCAP by the libraries mcap and mcap-protobuf-support: a table a topic.

Messages of ROS are read as in a bag (`ros.py`). Those in JSON or protobuf become columns by the paths of their fields,
`angular_velocity/x`; their units are those of the channel's metadata or of the schema, else ROS's by convention.
"""

from __future__ import annotations

import json
import struct
import zlib
from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.base.errors import UserError
from selfcal.base.limits import MOST_COLUMNS
from selfcal.logs.loaders.damage import Bytes, Damaged, bytes_of, mapped
from selfcal.logs.loaders.headings import TIMES
from selfcal.logs.loaders.ros import LAYOUTS, Topic, no_topic
from selfcal.logs.loaders.table import Hints, Table, of_arrays

#: Fields whose message is a stamp: seconds and nanoseconds by these names.
_STAMPS = ("header/stamp", "timestamp", "stamp", "time")
_SECONDS, _NANOSECONDS = ("sec", "secs", "seconds"), ("nsec", "nanosec", "nsecs", "nanos")
#: The first and the last bytes of a file; a record's kind and length; the kind of a chunk.
_MAGIC, _HEAD = b"\x89MCAP0\r\n", struct.Struct("<BQ")
_CHUNK = b"\x06"
#: Beginnings of a message's fields that are a sensor's by convention.
_BY_CONVENTION = ("angular_velocity/", "linear_acceleration/")


class _Fields:
    """Messages of a topic as columns. All have the fields of the first."""

    def __init__(self, units: Mapping[str, str]) -> None:
        self.units, self.names, self.values = units, list[str](), array("d")
        self.stamps, self.published, self.stamped = array("q"), array("q"), True

    def take(self, message: Mapping[str, Any], published: int) -> None:
        """Take a message, and when it was published, ns."""
        fields = dict(_flat(message))
        stamp = _stamp(fields)
        if not self.names:
            inner = tuple(f"{name}/" for name in _STAMPS)
            self.names = [name for name in fields if not name.startswith(inner)][:MOST_COLUMNS]
        self.values.extend(fields.get(name, np.nan) for name in self.names)
        self.stamped = self.stamped and stamp is not None
        self.stamps.append(stamp or 0)
        self.published.append(published)

    def table(self, topic: str) -> Table:
        """The table of a topic of this name."""
        values = np.array(self.values).reshape(-1, len(self.names))
        notes = []
        units = {name: self.units.get(name, self.units.get(name.rpartition("/")[2])) for name in self.names}
        counted = not self.stamped and any(
            units[name] is not None and name.lower() in ("t", *TIMES) for name in self.names
        )
        if not (self.stamped or counted):
            notes.append(f"{topic}: its messages have no stamps: the times at which they were published are taken")
        if any(name.startswith(_BY_CONVENTION) and name not in self.units for name in self.names):
            notes.append(f"{topic}: units by the convention of ROS, rad/s and m/s^2")
        columns: dict[str, Any] = {}
        if not counted:
            columns["t[ns]"] = np.array(self.stamps if self.stamped else self.published)
        for column, (name, unit) in enumerate(units.items()):
            if counted or name.lower() not in ("t", *TIMES):
                columns[name if unit is None else f"{name}[{unit}]"] = values[:, column]
        return of_arrays(topic, columns, notes=tuple(notes))


def _flat(value: Any, path: str = "") -> Iterator[tuple[str, float | int]]:
    """Numbers of a message by their paths."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        yield path, value
    elif isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _flat(inner, f"{path}/{name}" if path else str(name))


def _stamp(fields: Mapping[str, float | int]) -> int | None:
    """The stamp of a message, ns."""
    for name in _STAMPS:
        for second in _SECONDS:
            if f"{name}/{second}" in fields:
                rest = next((fields[f"{name}/{part}"] for part in _NANOSECONDS if f"{name}/{part}" in fields), 0)
                return int(fields[f"{name}/{second}"]) * 1_000_000_000 + int(rest)
    return None


def read(path: Path, _: Hints) -> list[Table]:
    """The tables of an MCAP file. Raises UserError and what mcap raises."""
    topics: dict[str, Topic | _Fields] = {}
    kinds: set[str] = set()
    decoders: dict[int, Callable[[bytes], Mapping[str, Any]]] = {}
    lost = list[Damaged]()
    with mapped(path) as data:
        for schema, channel, message in _messages_in(path, data, lost):
            kind = schema.name if schema is not None else channel.message_encoding
            kinds.add(kind)
            topic = channel.topic
            if channel.message_encoding in ("cdr", "ros1"):
                kind = kind if "/msg/" in kind else kind.replace("/", "/msg/", 1)
                if kind in LAYOUTS:
                    table = topics.setdefault(topic, Topic(kind))
                    if isinstance(table, Topic) and table.kind == kind:
                        table.take(message.data, cdr=channel.message_encoding == "cdr")
                continue
            if channel.message_encoding not in ("json", "protobuf"):
                continue
            if channel.id not in decoders:
                decoders[channel.id] = _decoder(schema, channel)
            if topic not in topics:
                topics[topic] = _Fields({**_units_of(schema), **channel.metadata})
            fields = topics[topic]
            if isinstance(fields, _Fields):
                fields.take(decoders[channel.id](message.data), message.publish_time)
    damaged = sum(lost, Damaged())
    if damaged and not topics:
        raise UserError(f"{path}: damaged: {replace(damaged, whole=bytes_of(path)).words}, and no other is a sensor's")
    if not topics:
        raise no_topic(path, kinds)
    return [replace(table.table(topic), damaged=damaged) for topic, table in topics.items()]


def _messages_in(path: Path, data: Bytes, lost: list[Damaged]) -> Iterator[tuple[Any, Any, Any]]:
    """Schema, channel and content of each sound message. A chunk that its checksum says is damaged is left out, and
    what is no record: both join `lost`. Raises UserError where messages have the checksum of the whole alone, and it
    does not fit. mcap's own readers end at the first damage, or pass by the checksums. Source: mcap.dev/spec.
    """
    from mcap import records as of
    from mcap.exceptions import UnsupportedCompressionError

    summary = _summary(data)
    schemas = {record.id: record for record in summary if isinstance(record, of.Schema)}
    channels = {record.id: record for record in summary if isinstance(record, of.Channel)}
    count, at, unchecked = 0, len(_MAGIC), False
    while data[at : at + len(_MAGIC)] != _MAGIC and at < len(data):
        begin = at
        try:
            at, records, checked = _records(data, begin)
        except UnsupportedCompressionError:
            raise
        except Exception:  # whatever mcap stumbles over
            at = _next(data, begin)
            lost.append(Damaged(at - begin, 1))
            continue
        for record in records:
            if isinstance(record, of.Schema):
                schemas[record.id] = record
            elif isinstance(record, of.Channel):
                channels[record.id] = record
            elif isinstance(record, of.Message) and record.channel_id in channels:
                count, unchecked = count + 1, unchecked or not checked
                yield schemas.get(channels[record.channel_id].schema_id), channels[record.channel_id], record
            elif (
                isinstance(record, of.DataEnd)
                and unchecked
                and record.data_section_crc not in (0, zlib.crc32(data[:begin]))
            ):
                raise UserError(f"{path}: the checksum of its data does not fit: a message in it is damaged")
    stated = sum(record.message_count for record in summary if isinstance(record, of.Statistics))
    if stated > count + sum(record.messages for record in lost):
        lost.append(Damaged(0, stated - count - sum(record.messages for record in lost)))


def _records(data: Bytes, begin: int) -> tuple[int, list[Any], bool]:
    """The end of the record at a place, the record, or those of a chunk, and whether it has a checksum, which fits.
    Raises what mcap raises."""
    from mcap import records as of
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.stream_reader import breakup_chunk

    kinds: dict[int, Any] = {
        Opcode.SCHEMA: of.Schema,
        Opcode.CHANNEL: of.Channel,
        Opcode.CHUNK: of.Chunk,
        Opcode.STATISTICS: of.Statistics,
        Opcode.DATA_END: of.DataEnd,
        Opcode.FOOTER: of.Footer,
    }
    if not (end := _end(data, begin)):
        raise ValueError("no record")
    stream, kind = ReadDataStream(BytesIO(data[begin + _HEAD.size : end])), data[begin]
    if kind == Opcode.MESSAGE:
        return end, [of.Message.read(stream, end - begin - _HEAD.size)], False
    record = kinds[kind].read(stream) if kind in kinds else None
    if isinstance(record, of.Chunk):
        return end, breakup_chunk(record, validate_crc=True), record.uncompressed_crc != 0
    return end, [record], False


def _end(data: Bytes, begin: int) -> int:
    """The end that a record at a place states; 0 without a record."""
    from mcap.opcode import Opcode

    if begin + _HEAD.size > len(data):
        return 0
    kind, length = _HEAD.unpack_from(data, begin)
    end = begin + _HEAD.size + length
    known = kind in {*Opcode} or kind & 0x80  # of others
    return end if known and end <= len(data) else 0


def _next(data: Bytes, begin: int) -> int:
    """Where to go on after a damaged record: at its end where a record or the file's end is there, else at the next
    sound chunk."""
    end = _end(data, begin)
    if end and (_end(data, end) or data[end:] == _MAGIC):
        return end
    while (begin := data.find(_CHUNK, begin + 1)) >= 0:
        with suppress(Exception):
            if _records(data, begin)[2]:
                return begin
    return len(data)


def _summary(data: Bytes) -> list[Any]:
    """The records of the summary, none where it is absent or damaged."""
    records: list[Any] = []
    at = len(data) - (_HEAD.size + 20) - len(_MAGIC)  # of the footer
    with suppress(Exception):
        end, (footer,), _ = _records(data, at)
        start = footer.summary_start
        if not footer.summary_crc or zlib.crc32(data[start : end - 4]) == footer.summary_crc:
            while 0 < start < at:
                start, more, _ = _records(data, start)
                records += more
    return records


def _decoder(schema: Any, channel: Any) -> Callable[[bytes], Mapping[str, Any]]:
    """The function that makes a mapping of a message in JSON or protobuf."""
    if channel.message_encoding == "json":
        return lambda data: value if isinstance(value := json.loads(data), dict) else {}
    from mcap_protobuf.decoder import DecoderFactory

    decode = DecoderFactory().decoder_for("protobuf", schema)
    assert decode is not None
    return lambda data: _messages(decode(data))


def _messages(message: Any) -> dict[str, Any]:
    """The fields of a protobuf message, inner messages as mappings; repeated fields are left out."""
    fields: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if hasattr(value, "DESCRIPTOR"):
            fields[field.name] = _messages(value)
        elif isinstance(value, int | float):
            fields[field.name] = value
    return fields


def _units_of(schema: Any) -> dict[str, str]:
    """Units that a JSON schema states, by the paths of the fields."""
    if schema is None or schema.encoding != "jsonschema" or not schema.data:
        return {}
    units: dict[str, str] = {}

    def look(node: Any, path: str) -> None:
        if not isinstance(node, dict):
            return
        unit = node.get("unit", node.get("units"))
        if isinstance(unit, str) and path:
            units[path] = unit
        properties = node.get("properties")
        for name, inner in properties.items() if isinstance(properties, dict) else ():
            look(inner, f"{path}/{name}" if path else name)

    look(json.loads(schema.data), "")
    return units
