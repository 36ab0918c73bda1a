"""The recordings of a batch: files by patterns, their hashes, and the unit that each is of."""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from glob import glob
from pathlib import Path
from typing import Any

from selfcal.base.errors import UserError, few, note, short
from selfcal.base.limits import read_text
from selfcal.logs.loaders.damage import bytes_of
from selfcal.logs.recording import meta_place

#: Columns of a table of units; the first two must be there.
TABLE_COLUMNS = ("file", "device", "station", "lot", "date")
#: Sources of a serial number.
FROM_NAME, FROM_FIELD = "name", "field"
#: A date of ISO 8601 in its extended form, with or without a time of day.
_DATE = re.compile(r"\d{4}-\d\d-\d\d(?:[T ]\d\d:\d\d.*)?", re.ASCII)
DATE_FORM = "2026-03-01 or 2026-03-01T14:30:00Z (ISO 8601)"


@dataclass(frozen=True)
class BatchSource:
    """A recording of the batch.

    `path` as the pattern has it. `sha256` of the file, `content` of the file and the metadata next to it. `device`: ""
    until the recording is read, if its metadata have the serial number. `copy_of`: the recording of another device with
    the same content.
    """

    path: str
    sha256: str = ""
    content: str = ""
    size: int = 0
    device: str = ""
    station: str = ""
    lot: str = ""
    recorded_at: str = ""
    copy_of: str = ""


def matching(patterns: Sequence[str], own: Sequence[Path]) -> list[str]:
    """The files that the patterns name, each once, in the order of their names. A folder is a recording of ROS 2.

    `own`: outputs of this command, files or folders, which a pattern may match as well. They are no recordings.
    A line names each link to nothing, pipe and device. It names a folder only where `patterns` names it, as a shell's
    pattern does.
    Raises UserError for a pattern that matches none.
    """
    outputs = {output.absolute() for output in own}
    recordings: dict[str, None] = {}
    skipped: dict[str, str] = {}
    for pattern in patterns:
        folder = Path(pattern)
        named = folder.exists() or folder.is_symlink()
        names = [pattern] if named else glob(pattern, recursive=True)  # noqa: PTH207
        others = [name for name in names if outputs.isdisjoint((whole := Path(name).absolute(), *whole.parents))]
        kept = [name for name in others if _is_recording(Path(name))]
        if not kept and not named:
            raise _unmatched(pattern)
        skipped |= {name: kind for name in others if (kind := _no_file(Path(name)))}
        if named and folder.is_dir() and others and not kept:
            skipped[pattern] = "a folder that is no recording of ROS 2"
        recordings.update(dict.fromkeys(kept))
    if not recordings:
        raise _unmatched(*patterns)
    for name, kind in skipped.items():
        note(f"{name}: is {kind}: skipped")
    return sorted(recordings)


def _unmatched(*patterns: str) -> UserError:
    more = f" and {len(patterns) - 1} more" if len(patterns) > 1 else ""
    return UserError(
        f"no recording matches '{short(patterns[0])}'{more}: give files, or a pattern in quotes as 'logs/**/*.csv'"
    )


def _no_file(path: Path) -> str:
    """Kind of a path that is neither file nor folder; empty for these."""
    if not path.exists():
        return "a link to nothing"
    return "" if path.is_file() or path.is_dir() else "a pipe or a device"


def _is_recording(path: Path) -> bool:
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.is_file() and not path.name.endswith(".meta.json")


def digest(path: Path) -> str:
    """sha256 of a file; of a folder that of its files' names and hashes. Raises OSError."""
    if path.is_dir():
        named = [f"{file.name} {digest(file)}\n" for file in sorted(path.iterdir()) if file.is_file()]
        return hashlib.sha256("".join(named).encode("utf-8", "surrogateescape")).hexdigest()
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hashed(path: str) -> BatchSource:
    """A recording with its hashes. An unreadable recording has no hashes; its reading says why."""
    log = Path(path)
    try:
        of_file = digest(log)
        beside = meta_place(log)
        content = of_file if not beside.is_file() else hashlib.sha256((of_file + digest(beside)).encode()).hexdigest()
        return BatchSource(path, of_file, content, bytes_of(log))
    except OSError:
        return BatchSource(path, content=f"unread {path}")


@dataclass(frozen=True)
class Named:
    """The sources, and the names that were left out because another name has the same content."""

    sources: list[BatchSource]
    copies: dict[str, str]


def batch_sources(
    patterns: Sequence[str], table: Path | str | None, serial_from: str | None, own: Sequence[Path] = ()
) -> Named:
    """The recordings of the patterns but the outputs `own`, with device, station, lot and date by the table of units.
    A file that the table does not name has its device by `serial_from`.

    A recording under two names of the same device is one source. Under the names of two devices the second is a source
    with `copy_of`: that device has no recording of its own.
    Raises UserError for a pattern without files, and for an invalid table or `serial_from`.
    """
    named = _serials(matching(patterns, own), serial_from)
    units = {} if table is None else _table(Path(table), list(named))
    sources: list[BatchSource] = []
    first: dict[str, BatchSource] = {}
    copies: dict[str, str] = {}
    for path, device in named.items():
        fields: dict[str, Any] = {"device": device, **units.get(path, {})}
        source = replace(hashed(path), **fields)
        other = first.setdefault(source.content, source)
        if other is source:
            sources.append(source)
        elif other.device == source.device or path not in units:
            copies[path] = other.path
        else:
            sources.append(replace(source, copy_of=f"{other.path} of device {other.device}"))
    return Named(sources, copies)


def moment(text: str) -> datetime | None:
    """The time of a date of ISO 8601, in UTC where it has no zone; None for any other text."""
    if not _DATE.fullmatch(text):
        return None
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        return None
    return date if date.tzinfo is not None else date.replace(tzinfo=UTC)


def stem(path: str) -> str:
    """A file's name without its suffixes of a recording: `a.12.csv.gz` is `a.12`."""
    name = Path(path).name.removesuffix(".gz")
    return name[: name.rindex(".")] if "." in name[1:] else name


def _serials(paths: Sequence[str], serial_from: str | None) -> dict[str, str]:
    """The device of each path. Nothing stated: the file's name, or its path where two files have the same name."""
    kind, _, pattern = (serial_from or "").partition(":")
    if kind == FROM_FIELD and not pattern:
        return dict.fromkeys(paths, "")
    if kind == FROM_NAME:
        return {path: _within(pattern, path) if pattern else stem(path) for path in paths}
    if kind:
        raise UserError(f"--serial-from takes name, name:PATTERN or field, not '{short(serial_from or '')}'")
    counted = Counter(map(stem, paths))
    return {path: stem(path) if counted[stem(path)] == 1 else path for path in paths}


def _within(pattern: str, path: str) -> str:
    try:
        match = re.search(pattern, path)
    except re.error as error:
        raise UserError(f"--serial-from name:{short(pattern)}: is no regular expression ({error})") from error
    if match is None:
        return stem(path)
    return match[1] if match.re.groups and match[1] else match[0]


def _table(table: Path, paths: Sequence[str]) -> dict[str, dict[str, str]]:
    """Device, station, lot and date by path. A file is named as the pattern names it, from the table's folder on, or by
    its bare name."""
    try:
        # 10 000 lines of 100 letters are 1 MB.
        text = read_text(table, 1 << 26, "not a table of units")
    except FileNotFoundError as error:
        raise UserError(f"{table}: there is no such file") from error
    try:
        rows = list(csv.reader(io.StringIO(text.removeprefix("\ufeff")), strict=True))
    except csv.Error as error:
        raise UserError(f"{table}: not a table of units: {error}") from error
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    if not set(TABLE_COLUMNS[:2]) <= set(header) or len(set(header)) < len(header):
        raise UserError(
            f"{table}: its first line must name each of {', '.join(TABLE_COLUMNS)} once; the last three may be left out"
        )
    unknown = [cell.strip() for cell, name in zip(rows[0], header, strict=True) if name not in TABLE_COLUMNS]
    if unknown:
        named = few(list(map(short, unknown)), more="more columns")
        note(f"{table}: does not read {named} (known: {', '.join(TABLE_COLUMNS)})")
    by_place: dict[Path, list[str]] = {}
    by_name: dict[str, list[str]] = {}
    for path in paths:
        by_place.setdefault(Path(path).resolve(), []).append(path)
        by_name.setdefault(Path(path).name, []).append(path)
    units: dict[str, dict[str, str]] = {}
    without: list[str] = []
    for number, cells in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise UserError(f"{table}: line {number}: {len(cells)} fields where the first line has {len(header)}")
        row = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
        if not row["file"] or not row["device"]:
            raise UserError(f"{table}: line {number}: file or device is empty")
        file = Path(row["file"])
        meant = [path for name in (file, table.parent / file) for path in by_place.get(name.resolve(), [])]
        if not meant and file.name == row["file"]:
            meant = by_name.get(file.name, [])
            if len(meant) > 1:
                raise UserError(
                    f"{table}: line {number}: '{short(file.name)}' is {short(meant[0])} and {short(meant[1])}: "
                    "give its folder"
                )
        date = row.get("date", "")
        if date and moment(date) is None:
            raise UserError(f"{table}: line {number}: date '{short(date)}': write it as {DATE_FORM}")
        without += [] if meant else [f"'{row['file']}' (line {number})"]
        entry = {"device": row["device"], "station": row.get("station", ""), "lot": row.get("lot", "")}
        entry["recorded_at"] = date
        for path in dict.fromkeys(meant):
            if units.setdefault(path, entry) != entry:
                raise UserError(
                    f"{table}: line {number}: '{short(row['file'])}' is there twice, with different entries"
                )
    if without:
        note(f"{table}: no recording of the batch is {few(list(map(short, without)), more='more rows')}")
    return units
