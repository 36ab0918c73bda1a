"""A table's raw columns become a recording: units, the order of the rows, clocks."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.base import units
from selfcal.base.errors import UserError, short, short_value
from selfcal.base.grid import Array, Mask, Rows, runs
from selfcal.base.limits import FEWEST_ROWS, LONGEST_S, MOST_CLOCKS
from selfcal.logs import written
from selfcal.logs.chosen_columns import Header, number_in
from selfcal.logs.loaders.damage import Damaged
from selfcal.logs.loaders.headings import PART, split
from selfcal.logs.loaders.table import TableRows
from selfcal.logs.order import few_rows, in_order
from selfcal.logs.recorded import SIDE_UNITS, Column, Recording, bridged, bridged_at
from selfcal.logs.timebase import Clock, clock_of, clock_of_rows, has_own_clock, remarks

#: Fewest readings of a side channel for each reading of a wild run.
READINGS_PER_WILD = 1000


@dataclass(frozen=True)
class _Stamps:
    """Stamps float64[n], s from the first; their rounding; the first stamp, s. `fail` raises UserError for a row."""

    time: Array
    noise_s: float
    started_s: float
    fail: Callable[[int, str], Any]


def assembled(rows: TableRows, header: Header) -> Recording:
    """The recording of the rows of a table; it empties `rows.columns`: no second copy stays. Raises UserError."""
    columns: dict[str, Column] = {}
    count = rows.columns[0].size
    for number, field in enumerate(rows.fields):
        raw = rows.columns.pop(0)
        if np.isinf(raw).any():
            rows.fail(int(np.argmax(np.isinf(raw))), number, "infinite")
        with np.errstate(over="ignore"):
            values = raw * field.lsb if field.lsb != 1.0 else raw
        if np.isinf(values).any():
            rows.fail(int(np.argmax(np.isinf(values))), number, f"infinite at {field.lsb:g} {field.unit} an LSB")
        columns[field.name] = Column(field.name, field.unit, values)
    for name in SIDE_UNITS.keys() & columns.keys():
        columns[name] = _tame(columns[name], header)
    _check_truth(rows.path, rows.meta)
    stamps, part = columns.pop("t", None), columns.pop(PART, None)
    if stamps is None:
        rate = header.rate if header.rate is not None else _meta_rate(rows.path, rows.meta)
        if rate is None:
            mapped = f", map yours with --column t={shlex.quote(header.dated)}" if header.dated else ""
            raise UserError(f"{rows.path}: there is no time column: add t[s]{mapped} or give --rate HZ")
        return _on_clocks(rows, rate, columns, count, None, header)
    if header.written and np.isfinite(stamps.values).all():
        return _as_written(rows, columns, units.converted(stamps.values, stamps.unit, "s"), header)
    ordered, kept = _ordered(rows, stamps, part, columns, header)
    if kept.size < count or (np.diff(kept) < 0).any():
        columns = {name: replace(column, values=column.values[kept]) for name, column in columns.items()}
    return _on_clocks(rows, header.rate, columns, kept.size, ordered, header)


def _tame(column: Column, header: Header) -> Column:
    """The channel without its wild readings, as a thermometer's error values are: farther from all others than these
    are from each other, and never for long."""
    known = np.flatnonzero(np.isfinite(column.values))
    values = column.values[known]
    off = np.abs(values - np.median(values)) if known.size else values
    near = np.sort(off)[known.size // 2 :]
    gaps = np.flatnonzero((near[:-1] > 0.0) & (near[1:] > 3.0 * near[:-1]))
    if not gaps.size:
        return column
    wild = [known[a:b] for a, b in runs(off > near[gaps[0]]) if b - a <= max(1, known.size // READINGS_PER_WILD)]
    if not wild:
        return column
    rows = np.concatenate(wild)
    said = f"{rows.size} of {known.size} readings are far from all others, the first {column.values[rows[0]]:.6g}"
    header.notes.append(f"{column.name}: {said}: left out")
    left = column.values.copy()
    left[rows] = np.nan
    return replace(column, values=left)


def _ordered(
    rows: TableRows, stamps: Column, part: Column | None, columns: Mapping[str, Column], header: Header
) -> tuple[_Stamps, Rows]:
    """The stamps in their order, and the rows of the table that they are of. `part`: what is added to the stamps. With
    `skip_bad` rows with a damaged stamp are left out, rows out of order are sorted."""
    mend = header.asked.skip_bad
    number = [field.name for field in rows.fields].index("t")
    known = np.flatnonzero(np.isfinite(stamps.values))
    unknown = stamps.values.size - known.size
    if unknown and not (mend and few_rows(unknown, stamps.values.size)):
        rows.fail(int(np.argmax(np.isnan(stamps.values))), number, "no time stamp (an empty cell or NaN)")
    twice = _twice(_at(stamps.values, known), (_at(column.values, known) for column in columns.values()))
    if twice.size and not mend:
        what = "time runs backwards: rows are written again, which --skip-bad leaves out, and --no-time --rate HZ keeps"
        rows.fail(int(known[twice[0]]), number, what)
    known = np.delete(known, twice)
    values = _at(stamps.values, known)
    tick_s = units.factor(stamps.unit, "s") * rows.fields[number].lsb
    since = units.converted(values - values[0], stamps.unit, "s")
    if part is not None:
        since += units.converted(np.nan_to_num(part.values[known]), part.unit, "s")
    order = in_order(since, tick_s, mend)
    kept = known[order.rows]
    if unknown:
        header.notes.append(f"{unknown} line{'s were' if unknown > 1 else ' was'} skipped, without a time stamp")
    if twice.size:
        header.notes.append(f"{twice.size} rows that were written again are left out")
    header.damaged += Damaged(0, order.damaged + unknown + twice.size)
    header.notes += order.notes
    return (
        _Stamps(
            order.time - order.time[0],
            units.converted(float(np.spacing(np.abs(values).max())), stamps.unit, "s"),
            units.converted(rows.started + float(values[0]), stamps.unit, "s") + float(order.time[0]),
            lambda row, what: rows.fail(int(kept[row]), number, what),
        ),
        kept,
    )


def _twice(time: Array, columns: Iterable[Array]) -> Rows:
    """Rows of stamps and columns [n] that repeat an earlier row to the bit, where stamps fall; columns are formed there
    alone. Empty where most late rows are others: a counter that wraps repeats some by chance."""
    none = np.empty(0, np.int64)
    if not (np.diff(time) < 0.0).any():
        return none
    table = np.ascontiguousarray(np.column_stack([time, *columns]))
    _, first = np.unique(table.view(np.dtype((np.void, table.strides[0]))), return_index=True)
    again = np.setdiff1d(np.arange(len(table)), first)
    late = np.count_nonzero(time[1:] <= np.maximum.accumulate(time)[:-1])
    return again if 2 * again.size > late else none


def _as_written(rows: TableRows, columns: Mapping[str, Column], t: Array, header: Header) -> Recording:
    """The recording of columns with NaN, and stamps `t`, s, by the clocks that `meta` states."""
    path, meta, fields = rows.path, rows.meta, rows.fields
    marks = {field.key: columns[field.name].values for field in fields if field.name.endswith(" ")}
    named = {split(field.key)[0]: field.name for field in fields if field.name in columns and field.key not in marks}
    clocks = [
        (names, clock, own)
        for names, clock, own in written.clocks_of(path, meta, t, marks, rows.places)
        if any(name in named for name in names)
    ]
    if not clocks:
        raise UserError(
            f"{path}: meta: its clocks are of no column of the table: convert the log again, or give --rate HZ"
        )
    _, main, main_rows = clocks[0]
    of: dict[str, tuple[Clock | None, Rows]] = dict.fromkeys(named.values(), (None, main_rows))
    for names, clock, sampled in clocks[1:]:
        other = replace(clock, start_s=clock.start_s - main.start_s)
        of.update({named[name]: (other, sampled) for name in names if name in named})
    made: dict[str, Column] = {}
    for name in named.values():
        own, sampled = of[name]
        values = _at(columns[name].values, sampled)
        if not np.isfinite(values).any():
            header.notes.append(f"column '{name}' holds no number and is left out")
            continue
        if name not in header.sensors:
            values = bridged(values) if own is None else bridged_at(own, values, main.time_s - main.start_s)
            own = None
        made[name] = replace(columns[name], values=values, clock=own)
    if not any(name in header.sensors for name in made):
        raise UserError(f"{path}: no sensor column holds a number")
    started, notes = number_in(meta.get("started_s")), meta.get("notes")
    of_log = [text for text in notes if isinstance(text, str) and text.isprintable()] if isinstance(notes, list) else []
    return Recording(
        path,
        main.rate_hz,
        made,
        main.missing_before,
        meta,
        main.off_grid_s,
        started_s=started if math.isfinite(started) else None,
        notes=(*of_log, *header.notes, *remarks(main)),
    )


def _on_clocks(
    rows: TableRows, rate: float | None, columns: dict[str, Column], count: int, stamps: _Stamps | None, header: Header
) -> Recording:
    """The recording of columns with NaN in `count` rows at their stamps, or at `rate` without any.

    Axes whose samples are spaced regularly, in two rows or more, get a clock of their own; the rows of the others are
    those in which any of them has a sample.
    """
    known = {name: np.isfinite(column.values) for name, column in columns.items()}
    header.notes += [f"column '{name}' holds no number and is left out" for name, has in known.items() if not has.any()]
    axes = {name: has for name, has in known.items() if name in header.sensors and has.any()}
    if not axes:
        raise UserError(f"{rows.path}: no sensor column holds a number")
    sampled, own = _sampled(rows.path, axes)
    main = _clock_at(rows, rate, sampled, stamps, count)
    clocks: dict[int, Clock] = {}
    made: dict[str, Column] = {}
    missing: dict[str, int] = {}
    for name, column in columns.items():
        has = known[name]
        if name in own:
            if (key := id(own[name])) not in clocks:
                clock = _clock_at(rows, None if stamps is not None else rate, np.flatnonzero(has), stamps, count)
                clocks[key] = replace(clock, start_s=clock.start_s - main.start_s)
            made[name] = replace(column, values=column.values[has], clock=clocks[key])
        elif name in axes:
            made[name] = replace(column, values=_at(column.values, sampled))
            missing[name] = count - int(has.sum())
        elif has.any():
            abscissa = np.arange(count, dtype=np.float64) if stamps is None else stamps.time
            values = column.values if has.all() else np.interp(abscissa, abscissa[has], column.values[has])
            made[name] = replace(column, values=_at(values, sampled))
    listed = ", ".join(f"{name} {cells}" for name, cells in missing.items() if cells)
    if listed:
        header.notes.append(f"of {count} rows cells without a number, taken as missing samples: {listed}")
    return Recording(
        rows.path,
        main.rate_hz,
        made,
        main.missing_before,
        rows.meta,
        main.off_grid_s,
        started_s=None if stamps is None else stamps.started_s + main.start_s,
        notes=(*header.notes, *(remarks(main) if rate is None else [])),
        damaged=header.damaged,
    )


def _sampled(path: Path, axes: Mapping[str, Mask]) -> tuple[Rows, dict[str, list[str]]]:
    """The rows of the recording's clock, and for each axis with a clock of its own those that share it. `axes`: where
    each has a sample, bool[rows]."""
    patterns: dict[bytes, list[str]] = {}
    for name, has in axes.items():
        if not has.all() and has_own_clock(np.flatnonzero(has)):
            patterns.setdefault(np.packbits(has).tobytes(), []).append(name)
    if len(patterns) > MOST_CLOCKS:
        raise UserError(f"{path}: more than {MOST_CLOCKS} patterns of empty cells: no recording has so many rates")
    own = {name: names for names in patterns.values() for name in names}
    common = [has for name, has in axes.items() if name not in own]
    if common:
        sampled = np.flatnonzero(np.logical_or.reduce(common))
    else:  # the fastest of them is the recording's
        fastest = max(patterns.values(), key=lambda names: int(axes[names[0]].sum()))
        sampled = np.flatnonzero(axes[fastest[0]])
        own = {name: names for name, names in own.items() if names is not fastest}
    if sampled.size < FEWEST_ROWS:
        what = f"{sampled.size} row{'s' if sampled.size > 1 else ''} with a sample"
        raise UserError(f"{path}: {what}, a recording needs two or more")
    return sampled, own


def _clock_at(rows: TableRows, rate: float | None, sampled: Rows, stamps: _Stamps | None, count: int) -> Clock:
    """The clock of the samples in the rows `sampled` of `count`."""
    if stamps is None:
        assert rate is not None
        lines = sampled if rows.places is None else rows.places[sampled]
        if lines[-1] / rate > LONGEST_S:
            what = f"{lines[-1] + 1} rows at {rate:g} Hz: a recording spans at most {LONGEST_S:g} s"
            raise UserError(f"{rows.path}: {what}")
        return clock_of_rows(lines, rate)
    time = stamps.time
    if count - sampled.size > 0 and few_rows(count - sampled.size, count):
        empty = np.setdiff1d(np.arange(1, count - 1), sampled)
        steps = np.diff(time)
        if empty.size and np.median(np.minimum(steps[empty - 1], steps[empty])) > 0.75 * np.median(steps):
            # Rows without a sample are of the same clock: their stamps show that a sample is missing.
            return clock_of(rows.path, time, stamps.noise_s, rate, stamps.fail).of_rows(sampled, 0.0)
    return clock_of(
        rows.path, _at(time, sampled), stamps.noise_s, rate, lambda row, what: stamps.fail(int(sampled[row]), what)
    )


def _at(values: Array, rows: Rows) -> Array:
    """Values in these rows, in order and each once; no copy where they are all."""
    return values if rows.size == values.size else values[rows]


def _meta_rate(path: Path, meta: Mapping[str, Any]) -> float | None:
    if "rate_hz" not in meta:
        return None
    rate = number_in(meta["rate_hz"])
    if not (np.isfinite(rate) and rate > 0.0):
        raise UserError(f"{path}: meta: 'rate_hz' must be a number above 0")
    return rate


def _check_truth(path: Path, meta: Mapping[str, Any]) -> None:
    """What a simulated recording says of itself: by axis, texts and finite numbers."""
    truth = meta.get("truth", {})
    if not isinstance(truth, dict) or not all(isinstance(entry, dict) for entry in truth.values()):
        raise UserError(f"{path}: meta: 'truth' must be a mapping of axes")
    for axis, entry in truth.items():
        for key, value in entry.items():
            if key == "units" or (isinstance(value, str) and value == short(value)):
                continue
            if not math.isfinite(number_in(value)):
                raise UserError(f"{path}: meta: truth of '{short(axis)}': '{short(key)}' is {short_value(value)}")
