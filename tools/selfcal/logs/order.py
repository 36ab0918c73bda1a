"""The order of rows by their stamps: clocks that begin anew, rows newest first or out of order, damaged stamps.

A clock goes back by its span: 2^k of its ticks, or an hour, half a day, a day, a week. Of a counter the span is a power
of two of what all steps are multiples of, steps back included. Rows that are out of order are mended on demand alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from selfcal.base.grid import Array, Rows
from selfcal.logs.sampling import ONE_INSTANT, batches_overlap, common_step, in_rhythm

#: Rows from which on stamps may repeat for being coarser than the sampling interval.
_REPEATS_FROM = 100
#: Bits by which a counter is named, and counts, s, that are not in the column's own unit.
_BITS, _TICKS = (32, 24, 16), (1e-6, 1e-3)
#: Spans of a clock's own, s. It may be set back by the first of them.
_CLOCKS = {3600.0: "an hour", 43200.0: "half a day", 86400.0: "a day", 604800.0: "a week"}
#: Chance that stamps that fall come so near a span.
_BY_CHANCE = 0.01
#: Fewest rows for each damaged row, and rows to either side that show which row is damaged.
_DAMAGED_APART, _NEAR = 20, 16


@dataclass(frozen=True)
class Order:
    """`rows` int64[m] of the file in their order, their stamps `time` float64[m], s, and what was done.

    `damaged`: rows with a damaged or repeated stamp that are left out."""

    rows: Rows
    time: Array
    notes: tuple[str, ...] = ()
    damaged: int = 0


def in_order(time: Array, tick_s: float, mend: bool) -> Order:
    """The order of rows with the stamps `time` [n], s. `tick_s`: a count of their column, s. `mend`: rows are sorted
    within their neighbourhood, those of damaged and repeated stamps left out. Stamps may fall in what comes back."""
    rows = np.arange(time.size)
    notes: list[str] = []
    if time.size > 2 and np.median(np.diff(time)) < 0.0 and time[-1] < time[0]:
        rows, time = rows[::-1], time[::-1]
        notes.append("the rows are newest first: read from the last one on")
    time, remark = unwrapped(time, tick_s)
    order = Order(rows, time, (*notes, *remark))
    return _mended(order) if mend else order


def unwrapped(time: Array, tick_s: float) -> tuple[Array, list[str]]:
    """Stamps [n], s, of a clock that went on, and a line for each span by which it begins anew."""
    steps = np.diff(time)
    if not (steps < 0.0).any():
        return time, []
    for span in _spans(time, steps, tick_s):
        on = steps + span
        begins = (steps < 0.0) & (on > 0.0) & (on <= 0.5 * span)
        count = int(np.count_nonzero(begins))
        set_back = span in _CLOCKS and count == 1
        sure = count and float(np.log(on[begins] / span).sum()) < math.log(_BY_CHANCE)
        if not sure or not few_rows(count, time.size) or not (set_back or np.ptp(time) < span):
            continue
        again = time + np.concatenate(([0.0], np.cumsum(np.where(begins, span, 0.0))))
        times = f"{count} time{'s' if count > 1 else ''}"
        bits = [bits for bits in _BITS for tick in (tick_s, *_TICKS) if math.isclose(span / tick, 2.0**bits)]
        if bits:
            return again, [f"column 't' wraps {times} like a {bits[0]}-bit counter: undone"]
        return again, [f"column 't' goes back {times} by {_CLOCKS.get(span, f'{span:.10g} s')}: undone"]
    return time, []


def _spans(time: Array, steps: Array, tick_s: float) -> list[float]:
    """Spans, s, that a clock may have."""
    spans = [2.0**32 * tick for tick in dict.fromkeys((max(tick_s, _TICKS[0]), *_TICKS))] + [*_CLOCKS]
    usual = float(np.median(np.abs(steps)))
    counts = [common_step(np.abs(steps), 1e-9 * usual), *(10.0**-digits for digits in range(10))]
    fits = (
        count for count in counts if count > 0.0 and np.abs(time / count - np.rint(time / count)).max() < ONE_INSTANT
    )
    step = next(fits, None)
    return spans if step is None else [*spans, step * 2.0 ** math.ceil(math.log2(np.ptp(time) / step + 0.5))]


def broken(time: Array) -> tuple[int, str] | None:
    """The first row whose stamp is not later than the stamp before, and the words; None where the stamps will do.

    Stamps may repeat for being coarse. They may fall where batches of equal length overlap."""
    steps = np.diff(time)
    back, repeats = steps < 0.0, steps == 0.0
    if back.any() and not batches_overlap(time):
        far = _far(time)
        row = int(far[0] if far.size > 0 and few_rows(far.size, time.size) else np.argmax(back) + 1)
        early = row > 0 and time[row] <= time[row - 1]
        return row, "time runs backwards" if early else "the time stamp is later than the next one"
    if repeats.any() and (not _coarse(steps) or repeats.all()):
        return int(np.argmax(repeats)) + 1, "the time stamp repeats"
    return None


def mends(time: Array) -> bool:
    """Whether stamps that are not in order can be mended."""
    order = _mended(Order(np.arange(time.size), time))
    return bool(order.notes) and broken(order.time) is None


def few_rows(rows: int, of: int) -> bool:
    """Whether `rows` of `of` rows are few enough to be damaged."""
    return rows * _DAMAGED_APART <= of


def _mended(order: Order) -> Order:
    """Without damaged stamps, sorted where rows are near their place, without stamps that repeat; the order as it was
    where that takes too many rows."""
    time, n, notes = order.time, order.time.size, list(order.notes)
    if broken(time) is None:
        return order
    far = _far(time)
    kept = np.delete(np.arange(n), far)
    sort = np.argsort(time[kept], kind="stable")
    moved = int(np.count_nonzero(np.diff(time[kept]) < 0.0))
    if not few_rows(int(np.abs(sort - np.arange(sort.size)).max(initial=0)), n):
        return order
    kept = kept[sort]
    repeats = np.diff(time[kept], prepend=-np.inf) == 0.0
    if repeats.any() and not _coarse(np.diff(time[kept])):
        kept = kept[~repeats]
    left_out = n - kept.size
    if not few_rows(left_out, n):
        return order
    if left_out:
        were = "s were" if left_out > 1 else " was"
        what = "damaged" if far.size == left_out else "damaged or repeated"
        notes.append(f"{left_out} line{were} skipped for a {what} time stamp")
    if moved:
        notes.append(f"rows were put in the order of their stamps, which fell {moved} time{'s' if moved > 1 else ''}")
    return Order(order.rows[kept], time[kept], tuple(notes), left_out)


def _far(time: Array) -> Rows:
    """Rows with a damaged stamp: farther from their neighbours' than rows that are out of their order."""
    middle = median_filter(time, 2 * _NEAR + 1, mode="nearest")
    return np.flatnonzero(np.abs(time - middle) > (_NEAR + 0.5) * float(np.median(np.abs(np.diff(time)))))


def _coarse(steps: Array) -> bool:
    """Whether stamps repeat for being coarse: often, or in a rhythm all the time."""
    rows = np.flatnonzero(steps == 0.0)
    often = steps.size >= _REPEATS_FROM and not few_rows(rows.size, steps.size)
    return often or (in_rhythm(rows) and 2 * int(np.ptp(rows)) > steps.size)
