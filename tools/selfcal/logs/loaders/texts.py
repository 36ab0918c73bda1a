"""The texts of a recording: a file, or the tables in a zip that a phone's app writes. A text is a table like others."""

from __future__ import annotations

import shlex
import zipfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO, NoReturn, cast

from selfcal.base.errors import UserError, printable, short_value
from selfcal.base.limits import MOST_COLUMNS, MOST_META_BYTES, read_text, reading
from selfcal.logs.loaders import TEXT, ZIP
from selfcal.logs.loaders.table import Field, Table, TableRows, meta_place, parse_meta
from selfcal.logs.loaders.text_table import Opened, TextReader

#: Names of a sensor that an app writes twice, the name to read first: what the part measured, then an estimate of it.
_BETTER = (("gyroscopeuncalibrated", "gyroscope"), ("accelerometeruncalibrated", "totalacceleration", "accelerometer"))


@dataclass(frozen=True)
class Text:
    """A text: its path in messages, the name that explains its headings, and its source among others.

    `optional`: nothing is wrong if it holds no sensor.
    """

    path: Path
    name: str
    source: str = ""
    optional: bool = False
    open: Opened | None = None


#: Whether a line of headings has a known heading.
Knows = Callable[[Sequence[str]], bool]


@dataclass(frozen=True, kw_only=True)
class TextTable(Table):
    """A text, or its rows that have a cell `only` in a column. Its columns are read when they are wanted."""

    text: Text
    knows: Callable[[Text], Knows]
    skip_bad: bool
    only: tuple[str, str] | None

    def rows(self, path: Path, fields: Sequence[Field]) -> TableRows:
        path = self.text.path
        meta = dict(self.meta)
        with ExitStack() as files:
            reader = TextReader(path, files, self.knows(self.text), skip_bad=self.skip_bad, opened=self.text.open)
            if self.only is not None:
                reader.only(*self.only)
            dated = next((k for k, wanted in enumerate(fields) if wanted.dates), None)
            pairs = [(field.key, field.name) for field in fields]
            read = reader.columns(pairs, [wanted.optional for wanted in fields], dated)
        fields = [wanted for wanted, column in zip(fields, read, strict=True) if column is not None]
        columns = [column for column in read if column is not None]
        rows = columns[0].size
        if meta.get("rows", rows + reader.skipped) != rows + reader.skipped:
            what = f"{rows} rows where {meta_place(path).name} says {short_value(meta['rows'])}"
            raise UserError(f"{path}: {what}: it was cut or changed; without that file it is read as it is")
        skipped = "1 line is no row and was skipped"
        if reader.skipped > 1:
            skipped = f"{reader.skipped} lines are no rows and were skipped"
        if "rate_hz" not in meta and (stated := reader.stated_rate()) is not None:
            meta["rate_hz"] = stated

        def fail(row: int, number: int | None, what: str) -> NoReturn:
            if row in reader.restarts:
                what = (
                    f"{what.split(':')[0]}, where the header is repeated: the logger began anew; cut the log there, "
                    f"head -n {reader.line_of(row) - 2} {shlex.quote(path.name)} > first.csv"
                )
            reader.fail(row, None if number is None else fields[number].name, what)

        notes = (skipped,) if reader.skipped else ()
        return TableRows(path, fields, columns, fail, meta, reader.origin_s, reader.places, notes, reader.damaged)


def read(path: Path, knows: Callable[[Text], Knows], skip_bad: bool) -> list[Table]:
    """The tables of a text or of a zip's texts: a table for each sensor whose rows take turns. Raises UserError."""
    tables: list[Table] = []
    for text in texts_in(path):
        try:
            with ExitStack() as files:
                reader = TextReader(text.path, files, knows(text), skip_bad=skip_bad, opened=text.open)
                turns = reader.in_turn()
        except UserError:
            if text.optional:
                continue
            raise
        beside = meta_place(text.path)
        meta = parse_meta(beside, read_text(beside, MOST_META_BYTES, "not a JSON text")) if beside.is_file() else {}
        for only in turns or (None,):
            source = "/".join(wanted for wanted in (text.source, ":".join(only or ())) if wanted)
            tables.append(
                TextTable(
                    source, {}, meta, name=text.name, headings=reader.keys, before=reader.before, line=reader.where,
                    first=reader.first, text=text, knows=knows, skip_bad=skip_bad, only=only,
                )
            )  # fmt: skip
    return tables


def texts_in(path: Path) -> list[Text]:
    """The texts of a file. Raises UserError."""
    if path.suffix.lower() != ZIP:
        return [Text(path, path.name)]
    texts = []
    with reading(path, "not a whole zip file"), zipfile.ZipFile(path) as archive:
        listed = archive.infolist()
        if sum(info.compress_size for info in listed) > path.stat().st_size:
            raise ValueError("its members overlap")
        for info in listed:
            name = PurePosixPath(info.filename)
            if name.suffix.lower() in TEXT and "meta" not in (part.lower() for part in name.parts[:-1]):
                label = path / printable(info.filename)
                texts.append(Text(label, name.name, name.stem, optional=True, open=_opener(path, info)))
    if len(texts) > MOST_COLUMNS:
        raise UserError(f"{path}: more than {MOST_COLUMNS} tables")
    for names in _BETTER:
        there = [name for name in names if any(wanted.source.lower() == name for wanted in texts)]
        texts = [wanted for wanted in texts if wanted.source.lower() not in there[1:]]
    if not texts:
        raise UserError(f"{path}: no table ({', '.join(TEXT)}) is in the zip")
    return texts


def _opener(path: Path, info: zipfile.ZipInfo) -> Opened:
    def opened(files: ExitStack) -> tuple[BinaryIO, int]:
        with reading(path, "not a whole zip file"):
            archive = files.enter_context(zipfile.ZipFile(path))
            return cast(BinaryIO, files.enter_context(archive.open(info))), info.compress_size

    return opened
