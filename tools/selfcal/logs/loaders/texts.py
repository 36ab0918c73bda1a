"""The texts of a recording: a file, or the tables in a zip that a phone's app writes."""

from __future__ import annotations

import zipfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO, cast

from selfcal.base.errors import UserError, printable
from selfcal.base.limits import MOST_COLUMNS, reading
from selfcal.logs.loaders import TEXT, ZIP
from selfcal.logs.loaders.text_table import Opened

#: Where an app writes a sensor twice, the one to read comes first: what the part measured, before an estimate of it.
_BETTER = (
    ("gyroscopeuncalibrated", "gyroscope"),
    ("accelerometeruncalibrated", "totalacceleration", "accelerometer"),
)


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


def texts_in(path: Path) -> list[Text]:
    """The texts of a file. Raises UserError."""
    if path.suffix.lower() != ZIP:
        return [Text(path, path.name)]
    found = []
    with reading(path, "not a whole zip file"), zipfile.ZipFile(path) as archive:
        listed = archive.infolist()
        if sum(info.compress_size for info in listed) > path.stat().st_size:
            raise ValueError("its members overlap")
        for info in listed:
            name = PurePosixPath(info.filename)
            if name.suffix.lower() in TEXT and "meta" not in (part.lower() for part in name.parts[:-1]):
                label = path / printable(info.filename)
                found.append(Text(label, name.name, name.stem, optional=True, open=_opener(path, info)))
    if len(found) > MOST_COLUMNS:
        raise UserError(f"{path}: more than {MOST_COLUMNS} tables")
    for names in _BETTER:
        there = [name for name in names if any(one.source.lower() == name for one in found)]
        found = [one for one in found if one.source.lower() not in there[1:]]
    if not found:
        raise UserError(f"{path}: no table ({', '.join(TEXT)}) is in the zip")
    return found


def _opener(path: Path, info: zipfile.ZipInfo) -> Opened:
    def opened(files: ExitStack) -> tuple[BinaryIO, int]:
        with reading(path, "not a whole zip file"):
            archive = files.enter_context(zipfile.ZipFile(path))
            return cast(BinaryIO, files.enter_context(archive.open(info))), info.compress_size

    return opened
