"""Formats of recordings: a row each. The library that reads a format is imported only for a file of it.

A format is a module of this folder with `read(path, hints)`, which gives the tables of a file. It runs in a child
process (`child.py`). Text is read by `text_table.py`. `headings.py` knows what other
programs call their columns, `sources.py` chooses among several sensors of a log.
"""

from __future__ import annotations

import importlib.util
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, TypedDict

from selfcal.base.errors import UserError, install_line
from selfcal.base.options import Option, Scale, option, parse_pairs

#: Text, each with .gz too.
TEXT = (".csv", ".tsv", ".txt", ".log", ".dat", ".lvm")
#: Texts of a phone's app together.
ZIP = ".zip"


@dataclass(frozen=True)
class Format:
    """A format: how a message calls its files, suffixes, and bytes at places by which a file is known.

    `module` reads it. `library` is the import name of what it takes but numpy and scipy, and `extra` the group of
    `pip install` that brings the library, "" where every installation has it. `here`: sizes are checked before anything
    is read, and columns are read when they are wanted, so it needs no process of its own.
    """

    name: str
    suffixes: tuple[str, ...]
    module: str
    magic: tuple[tuple[int, bytes], ...] = ()
    library: str = ""
    extra: str = ""
    here: bool = False


_HDF5 = b"\x89HDF\r\n\x1a\n"
FORMATS = (
    Format("an npz file", (".npz",), "npz", here=True),
    Format("a MATLAB file", (".mat",), "matlab"),
    Format("an R file", (".rda", ".rdata", ".rds"), "r_data", library="rdata", extra="r"),
    Format("a ROS bag", (".bag", ".db3"), "ros", ((0, b"#ROSBAG V2.0"), (0, b"SQLite format 3")), "rosbags", "ros"),
    Format("an MCAP file", (".mcap",), "mcap", ((0, b"\x89MCAP0\r\n"),), "mcap", "mcap"),
    Format("a ULog file", (".ulg",), "ulog", ((0, b"ULog\x01\x12\x35"),), "pyulog", "px4"),
    Format("a DataFlash log", (".bin", ".tlog"), "dataflash", ((0, b"\xa3\x95\x80"),), "pymavlink", "ardupilot"),
    Format("a Betaflight log", (".bbl", ".bfl"), "blackbox", ((0, b"H Product:Blackbox"),)),
    Format("an HDF5 file", (".h5", ".hdf5"), "hdf5", ((0, _HDF5), (512, _HDF5)), "h5py", "hdf5"),
    Format("a Parquet file", (".parquet",), "parquet", ((0, b"PAR1"),), "pyarrow", "lab"),
    Format("a TDMS file", (".tdms",), "tdms", ((0, b"TDSm"),), "nptdms", "labview"),
    Format("an MDF file", (".mf4", ".mdf"), "mf4", ((0, b"MDF     "), (0, b"UnFinMF ")), "asammdf", "automotive"),
    Format("a log of CAN frames", (".blf", ".asc", ".trc"), "can_log", ((0, b"LOGG"),), "can"),
)

#: How a message lists what is read, and what is written.
READ = (
    f"{', '.join((*TEXT, ZIP, *(suffix for form in FORMATS for suffix in form.suffixes)))}; .gz of text; a ROS 2 folder"
)
WRITTEN = ".csv, .csv.gz or .npz"


def _scales(texts: Sequence[str]) -> dict[str, Scale]:
    from selfcal.logs.loaders.headings import parse_scales

    return parse_scales(texts)


def _pairs(help: str, name: str, metavar: str) -> Option:
    return option(help, name, metavar=metavar, kind=list[str], made=partial(parse_pairs, name))


class Reading(TypedDict, total=False):
    """How a log is read: the options that every verb shares; `recording.load()` has their meaning."""

    start_s: Annotated[
        float | None, option("Begin here, seconds of the recording; default: its start", "--start", metavar="S")
    ]
    end_s: Annotated[
        float | None, option("End before this, seconds of the recording; default: its end", "--end", metavar="S")
    ]
    rate: Annotated[float | None, option("Sampling rate, for recordings without a t column", metavar="HZ")]
    rate_hz: float | None
    columns: Annotated[
        Mapping[str, str] | None, _pairs("Column of a foreign header (repeat for more)", "--column", "gx=NAME")
    ]
    units: Annotated[
        Mapping[str, str] | str | None,
        _pairs("Unit of a column whose header states none (repeat for more)", "--unit", "gx=rad/s"),
    ]
    scale: Annotated[
        Mapping[str, Scale] | float | None,
        option(
            "Size of one LSB, or of a unit that is not known (repeat for more)",
            metavar="[gx=]SIZE[unit]",
            kind=list[str],
            made=_scales,
        ),
    ]
    no_time: Annotated[bool, option("Leave the time column out; takes --rate", "--no-time")]
    skip_bad: Annotated[bool, option("Skip lines of a text that are no rows, and count them", "--skip-bad")]
    sources: Annotated[
        Sequence[str], option("Sensor to read of a log that has several (repeat for more)", "--source", metavar="NAME")
    ]
    dbc: Annotated[Path | str | None, option("Signals of a log of CAN frames", metavar="FILE.dbc")]


#: Bytes at the beginning of a file that identify its format.
_HEAD = max(at + len(sign) for form in FORMATS for at, sign in form.magic)
#: Content of a ROS 2 folder.
_ROS_FOLDER = ("metadata.yaml", "*.db3", "*.mcap")


def is_text(path: Path) -> bool:
    """Whether a file's name is a text recording's."""
    return path.name.lower().removesuffix(".gz").endswith(TEXT)


def is_recording(path: Path | str) -> bool:
    """Whether a name is a recording's: by its suffix, or a folder."""
    path = Path(path)
    return (
        path.is_dir() or is_text(path) or path.suffix.lower() in (ZIP, *(s for form in FORMATS for s in form.suffixes))
    )


def format_of(path: Path, *, frames: bool = False) -> Format | None:
    """The format of a file that is no text, by its first bytes, else by its suffix; None for a text. `frames`: it is a
    log of CAN frames, which may be a text. Raises UserError, and OSError."""
    if not path.is_dir():
        _check_file(path)
    if frames:
        return next(form for form in FORMATS if form.module == "can_log")
    if path.is_dir():
        if any(True for pattern in _ROS_FOLDER for _ in path.glob(pattern)):
            for part in path.iterdir():
                _check_file(part)
            return next(form for form in FORMATS if form.module == "ros")
        raise UserError(f"{path}: is a folder: name a recording in it ({READ})")
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    suffix = path.suffix.lower()
    for form in FORMATS:
        if any(head[offset : offset + len(sign)] == sign for offset, sign in form.magic):
            return form
    for form in FORMATS:
        if suffix in form.suffixes:
            if not head:
                raise UserError(f"{path}: the file is empty")
            return form
    if is_text(path) or suffix == ZIP:
        if not head:
            raise UserError(f"{path}: the file is empty")
        return None
    raise UserError(f"{path}: not a recording: its name ends in none of {READ}")


def _check_file(path: Path) -> None:
    """Raise UserError for a pipe or a device, which could hold the reader for ever. Raises OSError."""
    if not (stat.S_ISREG(mode := path.stat().st_mode) or stat.S_ISDIR(mode)):
        raise UserError(f"{path}: is a pipe or a device: write it into a file first")


def check_library(path: Path, form: Format) -> None:
    """Raise UserError, with the line to type, where the library of a format is not installed."""
    if form.library and importlib.util.find_spec(form.library) is None:
        typed = install_line(f"selfcal[{form.extra}]" if form.extra else "selfcal")
        raise UserError(f"{path}: is {form.name}, and {form.library} is not installed: {typed}")
