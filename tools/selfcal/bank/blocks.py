"""Block means of a record, as the library's averager makes them, worked out on their own in double."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal import _library32
from selfcal.base.errors import UserError
from selfcal.base.grid import Array, Mask, Rows, equal_runs
from selfcal.logs.recording import Recording, as_float
from selfcal.model.file import Group, Model
from selfcal.model.tables import Tables, make_tables
from selfcal.readings.readings import mostly_beyond

#: Intervals of an even grid, gaps included, that are computed singly.
MOST_DENSE = 10_000_000
#: Fewest bank samples that are checked.
BLOCKS_LEAST = 20


@dataclass(frozen=True)
class Blocks:
    """Block means of a record for the reference and the checks.

    `mean` [m] of each bank interval, NaN where fewer than half of its samples are usable; `r` [m] samples a block over
    those used; `kept_out` counts the samples that were not used, by reason; `z` [m, p] are the means of the regressors'
    columns. `after`: samples from the last whole block to the last usable sample, missing ones included. `begin`:
    sample instants from the record's first to the first block. Blocks beyond MOST_DENSE intervals are not worked out.
    """

    mean: Array
    r: Array
    kept_out: Mapping[str, int]
    z: Array
    after: int = 0
    begin: int = 0


def usable_blocks(
    samples: NDArray[np.float32],
    missing_before: Rows,
    tables: Tables,
    group: Group,
    columns: NDArray[np.float32] | None = None,
    counted: Callable[[Mapping[str, int]], Mapping[str, int]] = dict,
) -> Blocks:
    """block_means() of float32 samples [n] and columns [n, p]. Raises UserError if no report can come of them.
    `counted`: the samples kept out by reason, from those that the averaging knows."""
    z = None if columns is None else columns.astype(np.float64)
    blocks = blocks_of(samples, missing_before, tables.block, group, z)
    blocks = replace(blocks, kept_out=counted(blocks.kept_out))
    present = blocks.mean[np.isfinite(blocks.mean)]
    needed = _library32.REPORT_MIN + len(tables.regressors)
    kept = ", ".join(f"{count} {what}" for what, count in blocks.kept_out.items() if count) or "none"
    averages = f"{present.size} averages of {tables.dt_s:g} s"
    whole = float((tables.block / blocks.r[np.isfinite(blocks.mean)]).sum())
    each = int(np.isfinite(samples).sum())
    if most := mostly_beyond(samples, group):
        raise UserError(most)
    alone = f": --decimate {tables.block / tables.dt_s:.6g} takes each reading alone"
    if present.size < needed:
        more = alone if tables.block > 1 and each >= needed else ""
        raise UserError(f"too short: {averages}, {needed} are needed (samples kept out: {kept}){more}")
    # Other averages have lost most of their samples.
    if present.size < BLOCKS_LEAST and whole < 0.25 * each:
        raise UserError(f"too few whole averages: {averages} hold {whole:.0f} of the {each} readings{alone}")
    if not present.std() > 0.0:
        equal = f"all {present.size} averages are equal ({present[0]:g} {group.unit})"
        raise UserError(f"{equal}: a stuck or too coarse reading (samples kept out: {kept})")
    return blocks


def bank_means(recording: Recording, model: Model, name: str, rate_hz: float | None) -> tuple[Array, float]:
    """The bank's means [m] of an axis at a rate (None: the model's), NaN in gaps, and their interval, s."""
    recording, group = recording.along(name), model.group_of(name)
    tables = make_tables(replace(model, regressors=()), recording.rate_hz, (name,), bank_rate_hz=rate_hz)
    samples = as_float(recording.in_unit(name, group.unit))
    return usable_blocks(samples, recording.missing_before, tables, group).mean, tables.dt_s


def kept_out(samples: NDArray[np.floating[Any]], group: Group) -> dict[str, Mask]:
    """Which of `samples` [n] are not used, by reason."""
    finite = np.isfinite(samples)
    limit = np.float32(group.range) if group.range > 0.0 else np.inf
    saturated = finite & (np.abs(samples) >= limit)
    stuck = np.zeros(samples.size, bool)
    if group.stuck_limit > 0:
        change, length = equal_runs(samples)
        for first, count in zip(change[length >= group.stuck_limit], length[length >= group.stuck_limit], strict=True):
            stuck[first + group.stuck_limit - 1 : first + count] = True
        stuck &= finite
    return {"not_finite": ~finite, "saturated": saturated, "stuck": stuck}


def blocks_of(
    samples: NDArray[np.floating[Any]], missing_before: Rows, block: int, group: Group, columns: Array | None = None
) -> Blocks:
    """Average `samples` [n] in blocks on the even grid of sample instants; saturated and stuck samples are kept out.
    `columns` [n, p] of the regressors are averaged over the same samples."""
    reasons = kept_out(samples, group)
    usable = ~np.logical_or.reduce(list(reasons.values()))
    counts = {"missing": int(missing_before.sum()), **{what: int(mask.sum()) for what, mask in reasons.items()}}
    position = np.cumsum(missing_before)
    position += np.arange(samples.size)
    if not usable.any():
        raise UserError(f"no usable sample: all are saturated (range {group.range:g} {group.unit}) or stuck")
    begin = int(position[np.argmax(usable)] - position[0])
    position -= position[np.argmax(usable)]
    columns = np.empty((samples.size, 0)) if columns is None else columns
    count = min(int(position[-1] + 1) // block, MOST_DENSE + 1)
    if not usable.all():
        samples, position, columns = samples[usable], position[usable], columns[usable]
    after = int(position[-1] + 1) % block
    index = np.floor_divide(position, block, out=position)
    end = int(np.searchsorted(index, count))
    values, index, rows = samples[:end], index[:end], columns[:end]
    used = np.bincount(index, minlength=count)
    total = np.bincount(index, values, minlength=count)
    with np.errstate(invalid="ignore", divide="ignore"):
        sums = [np.bincount(index, column, minlength=count) for column in rows.T]
        z = np.column_stack([np.empty((count, 0)), *sums]) / used[:, None]
        mean = np.where(used * 2 >= block, total / used, np.nan)
        r = np.where(used * 2 >= block, block / used, 1.0)
    first = int(np.argmax(np.isfinite(mean))) if np.isfinite(mean).any() else 0
    return Blocks(mean[first:], r[first:], counts, z[first:], after, begin + first * block)
