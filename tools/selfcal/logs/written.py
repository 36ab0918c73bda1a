"""Recordings as files that `load` reads back, and a recording as a table that reads back as it was, for `convert`.

A row is an instant at which a clock has a sample. `meta` has `clocks`: of each the rate, the start and the columns.
Where samples are missing, or a clock has not every row, a column `sample` has the place of each on the even grid. Where
the row's stamp does not give it to the bit, a column `late` has each sample's stamp less the grid's, s. Of the second
clock they are `sample_1` and `late_1`.
"""

from __future__ import annotations

import gzip
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError, cell
from selfcal.base.grid import Array, Rows
from selfcal.base.limits import LEAST_RATE_HZ, LONGEST_S, LONGEST_SAMPLES, MOST_COLUMNS, MOST_RATE_HZ
from selfcal.base.output import together, whole
from selfcal.logs.loaders import WRITTEN
from selfcal.logs.loaders.table import heading, meta_place
from selfcal.logs.recorded import Recording
from selfcal.logs.sampling import ONE_INSTANT
from selfcal.logs.timebase import Clock

#: Headings, without a unit, of the columns that are not the recording's.
SAMPLE, LATE = "sample", "late"
#: Lines that are written at once; signs that separate columns, so no heading has them.
_LINES, _SIGNS = 10_000, re.compile(r'[,;\t"]')
#: What `meta` of the log says of the log's own table.
_OF_TABLE = ("columns", "rows", "rate_hz")


@dataclass(frozen=True)
class Laid:
    """A recording for `save`: columns by name, the unit and float64[n], NaN without a sample; stamps float64[n], s."""

    columns: Mapping[str, tuple[str, Array]]
    t: Array
    meta: Mapping[str, Any]


def laid_out(recording: Recording) -> Laid:
    """The table of a recording."""
    of: dict[int, list[str]] = {id(None): []}
    for name, column in recording.columns.items():
        of.setdefault(id(column.clock), []).append(name)
    clocks = [recording.clock_of(names[0]) for names in of.values()]
    stamps = [clock.time_s if clock.off_grid_s is None else clock.time_s + clock.off_grid_s for clock in clocks]
    t, rows = _rows(stamps, ONE_INSTANT / recording.rate_hz)

    def cells(values: NDArray[Any], at: Rows) -> Array:
        full = np.full(t.size, np.nan)
        full[at] = values
        return full

    at = {name: place for names, place in zip(of.values(), rows, strict=True) for name in names}
    table = {name: (column.unit, cells(column.values, at[name])) for name, column in recording.columns.items()}
    for ending, clock, own in zip(_endings(len(clocks)), clocks, rows, strict=True):
        if len(clocks) > 1 or clock.missing_before.any():
            table[SAMPLE + ending] = ("", cells(clock.place, own))
        if clock.off_grid_s is not None and not np.array_equal(t[own] - clock.time_s, clock.off_grid_s):
            table[LATE + ending] = ("", cells(clock.off_grid_s, own))
    entries = [
        {"columns": names, "rate_hz": clock.rate_hz, "start_s": clock.start_s, "stamped": clock.off_grid_s is not None}
        for names, clock in zip(of.values(), clocks, strict=True)
    ]
    kept = {key: value for key, value in recording.meta.items() if key not in _OF_TABLE}
    notes = [note for note in recording.notes if note != recording.damaged.words]  # this file is sound
    return Laid(table, t, {**kept, "clocks": entries, "started_s": recording.started_s, "notes": notes})


def _endings(clocks: int) -> list[str]:
    return ["", *(f"_{number}" for number in range(1, clocks))]


def marks_of(meta: Mapping[str, Any]) -> set[str]:
    """Headings of the columns that are not the recording's in a table whose `meta` states its clocks."""
    return {name + ending for ending in _endings(len(meta["clocks"])) for name in (SAMPLE, LATE)}


def stated(meta: Mapping[str, Any]) -> bool:
    """Whether `meta` states the clocks of its table. No table has more of them than columns."""
    return isinstance(meta.get("clocks"), list) and 0 < len(meta["clocks"]) <= MOST_COLUMNS


def _rows(stamps: Sequence[Array], near_s: float) -> tuple[Array, list[Rows]]:
    """Stamps of the rows, float64[n], s, and the rows of each clock's samples. Stamps of several clocks that are nearer
    than `near_s` share a row; each sample of the same clock has a row of its own."""
    if len(stamps) == 1:
        return stamps[0], [np.arange(stamps[0].size)]
    time, clock = np.concatenate(stamps), np.repeat(np.arange(len(stamps)), [own.size for own in stamps])
    order = np.argsort(time, kind="stable")
    time, clock = time[order], clock[order]
    group = np.cumsum(np.diff(time, prepend=-np.inf) >= near_s)
    by = np.lexsort((clock, group))
    begins = (np.diff(group[by], prepend=-1) != 0) | (np.diff(clock[by], prepend=-1) != 0)
    turn = np.empty(time.size, np.int64)  # of each sample among those of its clock in a group
    turn[by] = np.arange(time.size) - np.maximum.accumulate(np.where(begins, np.arange(time.size), 0))
    _, first, row = np.unique(group * (turn.max() + 1) + turn, return_index=True, return_inverse=True)
    t = time[first]
    alone = np.bincount(group)[group] == np.bincount(group, turn == 0)[group]
    ours = alone & (clock == 0)  # a row that holds no second sample of a clock has the first clock's stamp
    t[row[ours]] = time[ours]
    return t, [row[clock == number] for number in range(len(stamps))]


def clocks_of(
    path: object, meta: Mapping[str, Any], t: Array, marks: Mapping[str, Array], places: Rows | None
) -> list[tuple[list[str], Clock, Rows]]:
    """For each clock that `meta` states: the columns' names, the clock and the rows of its samples in a table with the
    stamps `t` [n], s, and the further columns `marks`. `places` [n]: lines of the rows, some of which were skipped.
    Raises UserError."""
    clocks = []
    for number, (entry, ending) in enumerate(zip(meta["clocks"], _endings(len(meta["clocks"])), strict=True)):
        mark = marks.get(SAMPLE + ending)
        rows = np.arange(t.size) if mark is None else np.flatnonzero(np.isfinite(mark))
        lines = rows if places is None else places - places[:1]
        on_grid = lines if mark is None else mark[rows]
        late = marks.get(LATE + ending)
        stamps = t[rows] if late is None else late[rows]
        try:
            names, rate, start = (
                [str(name) for name in entry["columns"]],
                float(entry["rate_hz"]),
                float(entry["start_s"]),
            )
            sound = LEAST_RATE_HZ <= rate <= MOST_RATE_HZ and abs(start) < LONGEST_S and rows.size > 1
            sound &= bool(on_grid[0] >= 0 and on_grid[-1] < min(LONGEST_SAMPLES, LONGEST_S * rate))
            sound &= bool((on_grid == np.rint(on_grid)).all())
            sound &= bool((np.diff(on_grid) > 0).all() and np.isfinite(stamps).all())
            stamped = bool(entry["stamped"])
        except (TypeError, KeyError, ValueError, OverflowError, IndexError):
            sound = False
        if not sound:
            raise UserError(
                f"{path}: meta: clock {number + 1} does not fit the table, which was changed: convert the log again, "
                "or give --rate HZ"
            )
        places_of: Rows = np.asarray(on_grid, np.int64)
        clock = Clock(rate, np.diff(places_of, prepend=np.int64(-1)) - 1, start_s=start)
        if stamped:
            clock = replace(clock, off_grid_s=stamps - clock.time_s if late is None else stamps)
        clocks.append((names, clock, rows))
    return clocks


def save(
    path: Path | str,
    columns: Mapping[str, tuple[str, Array]],
    rate_hz: float,
    meta: Mapping[str, Any] | None = None,
    t: Array | None = None,
    lsb: Mapping[str, float] | None = None,
    *,
    exact: bool = False,
) -> None:
    """Write a recording that `load` reads back; the suffix (.csv, .csv.gz, .npz) chooses the form.

    `columns`: name -> (unit, float[n]); "" is no unit. `t` float[n], s: time stamps; None is an even grid from 0.
    `meta`: JSON values, kept in the npz or next to the CSV file as LOG.meta.json. `lsb`: name -> size of one LSB in the
    column's unit: npz stores such a column as whole numbers of it. CSV values carry 9 digits, with `exact` as many as a
    float64 takes; an empty cell is NaN then. Raises UserError for an unwritable file.
    """
    path = Path(path)
    described: dict[str, Any] = {**(meta or {}), "rate_hz": float(rate_hz)}
    if path.suffix.lower() == ".npz":
        _save_npz(path, columns, described, t, lsb or {})
        return
    if not path.name.lower().endswith((".csv", ".csv.gz")):
        raise UserError(f"{path}: a written recording's name ends in {WRITTEN}")
    n = len(next(iter(columns.values()))[1])
    stamps = np.arange(n) / rate_hz if t is None else t
    values = np.column_stack([stamps, *(values for _, values in columns.values())])
    names = ",".join(["t[s]", *(_SIGNS.sub("_", cell(heading(name, unit))) for name, (unit, _) in columns.items())])
    with together(path, meta_place(path)) as (table, beside):
        if exact:
            _save_exact(table, names, values)
        else:
            np.savetxt(table, values, fmt=["%.12g"] + ["%.9g"] * len(columns), delimiter=",", header=names, comments="")
        if meta is None:
            beside.unlink()
        else:
            beside.write_text(json.dumps({**described, "rows": len(values)}, indent=1) + "\n", encoding="utf-8")


def _save_exact(path: Path, header: str, values: Array) -> None:
    """Write values [rows, columns] as CSV by their shortest texts that are read back to the bit."""
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "wt", encoding="utf-8") as file:
        file.write(f"{header}\n")
        for begin in range(0, len(values), _LINES):
            lines = values[begin : begin + _LINES].tolist()
            file.writelines(
                ",".join("" if math.isnan(cell) else repr(cell).removesuffix(".0") for cell in line) + "\n"
                for line in lines
            )


def _save_npz(
    path: Path,
    columns: Mapping[str, tuple[str, Array]],
    described: dict[str, Any],
    t: Array | None,
    lsb: Mapping[str, float],
) -> None:
    """Write the columns, whole numbers of an LSB where `lsb` has its size, and `described` as the member `meta`."""
    arrays: dict[str, NDArray[Any]] = {} if t is None else {"t[s]": np.asarray(t, np.float64)}
    described["columns"] = {}
    for name, (unit, values) in columns.items():
        if name in lsb:
            counts = np.rint(np.asarray(values, np.float64) / lsb[name])
            arrays[name] = counts.astype(
                np.int16 if np.abs(counts).max(initial=0) <= np.iinfo(np.int16).max else np.int32
            )
            described["columns"][name] = {"unit": unit, "lsb": float(lsb[name])}
        else:
            arrays[heading(name, unit)] = np.asarray(values, np.float64)
    with whole(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, meta=np.array(json.dumps(described)), **arrays)
