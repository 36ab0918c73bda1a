"""`selfcal convert`: a log of any form as a table with one clock, for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from selfcal.logs.recording import Recording

#: Stamps closer than this, as a share of the fastest axes' interval, are one row.
ONE_ROW = 0.01


def stamps_of(recording: Recording, name: str) -> NDArray[np.float64]:
    """float64[n]: when the samples of a column were taken, s."""
    clock = recording.clock_of(name)
    return clock.time_s if clock.off_grid_s is None else clock.time_s + clock.off_grid_s


def rows_of(times: Sequence[NDArray[np.float64]], near_s: float) -> NDArray[np.float64]:
    """float64[n]: all stamps in order, those that are nearer than `near_s` as one."""
    if len(times) == 1:
        return times[0]
    every = np.sort(np.concatenate(times))
    return every[np.diff(every, prepend=-np.inf) >= near_s]


def show(recording: Recording, output: Path | str) -> None:
    """One line on stdout."""
    axes = ", ".join(f"{name}[{one.unit}]" for name, one in recording.columns.items())
    print(f"{output}: {recording.samples:,} rows, {recording.rate_hz:.6g} Hz, {recording.duration_s:.6g} s: {axes}")
