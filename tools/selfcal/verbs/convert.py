"""`selfcal convert`: a log of any form as a table with one clock, for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError
from selfcal.base.output import check_place
from selfcal.logs.loaders import Reading
from selfcal.logs.recording import Recording, list_of, load, save

#: Stamps closer than this, as a share of the fastest axes' interval, are one row.
_ONE_ROW = 0.01


def convert(
    log: Path | str | Sequence[Path | str],
    output: Path | str,
    **reading: Unpack[Reading],
) -> Recording:
    """Write a recording as .csv, .csv.gz or .npz, and return it. The options are `load`'s.

    Stamps are seconds from the first row. Axes of several rates share the rows: a cell without a sample is empty.
    Raises UserError as `load` does, and for a file that cannot be written.
    """
    if Path(output).resolve() in {path.resolve() for path in list_of(log)}:
        raise UserError(f"{output}: is the log itself: give another file with -o")
    check_place(output)
    recording = load(log, **reading)
    times = {id(one.clock): _stamps(recording, name) for name, one in recording.columns.items()}
    rows = _rows(list(times.values()), _ONE_ROW / recording.rate_hz)
    table = {}
    for name, one in recording.columns.items():
        values = np.full(rows.size, np.nan)
        at = np.searchsorted(rows, times[id(one.clock)] + 0.5 * _ONE_ROW / recording.rate_hz, side="right") - 1
        values[at] = one.values
        table[name] = (one.unit, values)
    save(output, table, recording.rate_hz, t=rows)
    return recording


def _stamps(recording: Recording, name: str) -> NDArray[np.float64]:
    """float64[n]: when the samples of a column were taken, s."""
    clock = recording.clock_of(name)
    return clock.time_s if clock.off_grid_s is None else clock.time_s + clock.off_grid_s


def _rows(times: Sequence[NDArray[np.float64]], near_s: float) -> NDArray[np.float64]:
    """float64[n]: all stamps in order, those that are nearer than `near_s` as one."""
    if len(times) == 1:
        return times[0]
    every = np.sort(np.concatenate(times))
    return every[np.diff(every, prepend=-np.inf) >= near_s]


def show(recording: Recording, output: Path | str) -> None:
    """One line on stdout."""
    axes = ", ".join(f"{name}[{one.unit}]" for name, one in recording.columns.items())
    print(f"{output}: {recording.samples:,} rows, {recording.rate_hz:.6g} Hz, {recording.duration_s:.6g} s: {axes}")
