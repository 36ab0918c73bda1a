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

    Stamps are seconds from the first row. Axes of several rates share the rows: a cell without a sample is empty.
    Raises UserError as `load` does, and for a file that cannot be written.
    """
    import numpy as np

    from selfcal.base.output import check_place
    from selfcal.logs.convert import ONE_ROW, rows_of, stamps_of
    from selfcal.logs.recording import list_of, load, save

    if Path(output).resolve() in {path.resolve() for path in list_of(log)}:
        raise UserError(f"{output}: is the log itself: give another file with -o")
    check_place(output)
    recording = load(log, **reading)
    times = {id(one.clock): stamps_of(recording, name) for name, one in recording.columns.items()}
    rows = rows_of(list(times.values()), ONE_ROW / recording.rate_hz)
    table = {}
    for name, one in recording.columns.items():
        values = np.full(rows.size, np.nan)
        at = np.searchsorted(rows, times[id(one.clock)] + 0.5 * ONE_ROW / recording.rate_hz, side="right") - 1
        values[at] = one.values
        table[name] = (one.unit, values)
    save(output, table, recording.rate_hz, t=rows)
    return recording


def show(recording: Recording, given: Mapping[str, Any]) -> int:
    """Print what was written."""
    from selfcal.logs.convert import show as line

    line(recording, given["output"])
    return 0
