"""Write a log of any form as a recording that every other program reads."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from selfcal.base.errors import UserError
from selfcal.base.options import option
from selfcal.logs.loaders import WRITTEN, Reading
from selfcal.verbs._shared import Logs

if TYPE_CHECKING:
    from selfcal.logs.recording import Recording


def convert(
    log: Logs,
    output: Annotated[
        Path | str, option(f"Recording to write: {WRITTEN}", "-o", "--output", metavar="FILE", show_default=False)
    ],
    **reading: Unpack[Reading],
) -> Recording:
    """Write a recording as .csv, .csv.gz or .npz, and return it. The options are `load`'s.

    It reads back as the same recording, to the bit. Stamps are seconds from the first row. Axes of several rates share
    the rows: a cell without a sample is empty. Raises UserError as `load` does, and for a file that cannot be written.
    """
    from selfcal.base.output import check_place
    from selfcal.logs.recording import list_of, load, save
    from selfcal.logs.written import laid_out

    if Path(output).resolve() in {path.resolve() for path in list_of(log)}:
        raise UserError(f"{output}: is the log itself: give another file with -o")
    check_place(output)
    recording = load(log, **reading)
    laid = laid_out(recording)
    save(output, laid.columns, recording.rate_hz, laid.meta, t=laid.t, exact=True)
    return recording


def show(recording: Recording, given: Mapping[str, Any]) -> None:
    """Print what was written."""
    axes = ", ".join(f"{name}[{column.unit}]" for name, column in recording.columns.items())
    rows = f"{recording.samples:,} rows, {recording.rate_hz:.6g} Hz, {recording.duration_s:.6g} s"
    print(f"{given['output']}: {rows}: {axes}")
