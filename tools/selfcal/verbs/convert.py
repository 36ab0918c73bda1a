"""`selfcal convert`: a log of any form as a table with one clock, for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

from selfcal.base.errors import UserError
from selfcal.base.output import check_place
from selfcal.logs.loaders import Reading
from selfcal.logs.recording import Recording, list_of, load, save
from selfcal.logs.written import laid_out


def convert(
    log: Path | str | Sequence[Path | str],
    output: Path | str,
    **reading: Unpack[Reading],
) -> Recording:
    """Write a recording as .csv, .csv.gz or .npz, and return it. The options are `load`'s.

    It reads back as the same recording, to the bit. Stamps are seconds from the first row. Axes of several rates share
    the rows: a cell without a sample is empty. Raises UserError as `load` does, and for a file that cannot be written.
    """
    if Path(output).resolve() in {path.resolve() for path in list_of(log)}:
        raise UserError(f"{output}: is the log itself: give another file with -o")
    check_place(output)
    recording = load(log, **reading)
    laid = laid_out(recording)
    save(output, laid.columns, recording.rate_hz, laid.meta, t=laid.t, exact=True)
    return recording


def show(recording: Recording, output: Path | str) -> None:
    """One line on stdout."""
    axes = ", ".join(f"{name}[{one.unit}]" for name, one in recording.columns.items())
    print(f"{output}: {recording.samples:,} rows, {recording.rate_hz:.6g} Hz, {recording.duration_s:.6g} s: {axes}")
