"""Findings that need little or no fit: of the readings and of the clock, missing samples."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import pdtrc

from selfcal.base.grid import Mask
from selfcal.diagnosis.causes.missing_samples import MISSING_LEAST
from selfcal.diagnosis.record import Record
from selfcal.likelihood.state import Look, State, normal_entry
from selfcal.readings.budget import SHARES
from selfcal.readings.held import equal_by_chance

#: Report an unstated lattice from this many white noise sd.
LATTICE_LEAST = 0.5
#: Readings at most of which a log's means show by their lattice.
AVERAGED_MOST = 20


def missing(record: Record) -> tuple[dict[str, Look], Mask]:
    """Looks by axis: gaps in the stamps, and rows that repeat the row before: the logger held the last reading. The
    mask is those rows, where an axis is found to miss samples."""
    held = _held(record)
    rows = np.flatnonzero(held) / record.rate_hz
    found: dict[str, Look] = {}
    for name in record.axes:
        gaps = record.missing.get(name)
        gone = rows.size + (0 if gaps is None else gaps.samples)
        if gone <= MISSING_LEAST * (record.present.size if gaps is None else gaps.of):
            continue
        times = [*rows[:1], *rows[-1:], *([] if gaps is None else gaps.when)]
        found[name] = Look(
            "missing_samples",
            float(gone),
            float(gone),
            {"missing": normal_entry(float(gone), 0.0, "samples")},
            {},
            when=(float(min(times)), float(max(times))),
        )
    return found, held if found else np.zeros_like(held)


def _held(record: Record) -> Mask:
    """Rows all of whose axes repeat, where their lattices make fewer such rows by chance."""
    none = np.zeros(record.present.size, bool)
    repeats = []
    for state in record.axes.values():
        same = np.zeros(record.present.size, bool)
        same[1:] = np.diff(state.y) == 0.0
        if state.axis in record.redrawn:
            same &= record.redrawn[state.axis] == state.y  # a clipped reading repeats for being clipped
        repeats.append(same)
    if not repeats or any(state.redrawn for state in record.axes.values()):
        return none  # means of blocks repeat by chance: a held reading shows at the recording's own rate
    held = np.all(repeats, axis=0)
    shares = [
        max((float(same.sum()) - float(held.sum())) / same.size, equal_by_chance(state.y))
        for same, state in zip(repeats, record.axes.values(), strict=True)
    ]
    expected = held.size * float(np.prod(np.maximum(shares, 1.0 / held.size)))
    # Chance repeats of coarse axes are not quite independent: three times the expectation.
    return held if pdtrc(int(held.sum()) - 1, 3.0 * expected + 0.05) < SHARES["held_samples"] else none


def rate_changes(record: Record) -> list[Look]:
    """Changes of the sampling rate. The record has means over an interval that all rates share."""
    return [
        Look(
            "rate_change",
            change.nats,
            change.nats,
            {
                "time_s": normal_entry(change.time_s, 0.5 / min(change.before_hz, change.after_hz), "s"),
                "before_hz": normal_entry(change.before_hz, 0.0, "Hz"),
                "after_hz": normal_entry(change.after_hz, 0.0, "Hz"),
            },
            {},
            when=(change.time_s, change.time_s),
        )
        for change in record.changes
    ]


def of_readings(record: Record, axis: str) -> Iterator[Look]:
    """What the readings of an axis show by themselves."""
    readings = record.readings.get(axis)
    if readings is None:
        return
    n, time_s = readings.values.size, readings.recording.time_s
    if (changed := readings.misread) is not None:  # by a map of the firmware or the logger
        fraction = normal_entry(changed.share, math.sqrt(changed.share / n), "1")
        estimate = {"kind": changed.kind, "fraction": fraction, "undone": changed.undone is not None}
        yield Look("misread", changed.nats, changed.nats, estimate, {})
    if readings.held is not None:  # the logger asks oftener than the part measures, always or in stretches
        nats, rate_hz = min(1e6, readings.held.nats), normal_entry(readings.recording.rate_hz, 0.0, "Hz")
        yield Look("held_samples", nats, nats, {"rate_hz": rate_hz}, {})
    elif readings.slower:
        surest = max(readings.slower, key=lambda stretch: stretch.nats)
        rate_hz = normal_entry(readings.recording.rate_hz / surest.ratio, 0.0, "Hz")
        nats = min(1e6, sum(stretch.nats for stretch in readings.slower))
        yield _of_stretches("held_samples", nats, readings.slower_intervals, rate_hz=rate_hz)
    if readings.intervals:
        yield _of_stretches("stuck", readings.stuck_nats, readings.intervals)
    if (common := readings.recurring) is not None:  # a value that comes too often
        mask, share = common.mask, common.share
        times = time_s[mask if mask.any() else readings.values == common.value]
        when = (float(times[0]), float(times[-1]))
        lost: dict[str, Any] = {
            "fraction": normal_entry(share, math.sqrt(share / mask.size), "1"),
            "time_s": normal_entry(when[0], 0.0, "s"),
            "undone": bool(mask.any()),
        }
        yield Look("outliers", common.nats, common.nats, lost, {}, when=when)


def _of_stretches(cause: str, nats: float, intervals: Sequence[Sequence[float]], **more: Any) -> Look:
    estimate = {**more, "intervals": intervals}
    return Look(cause, nats, nats, estimate, {}, when=(intervals[0][0], intervals[-1][1]))


def _averaged(steps: float) -> bool:
    """Whether the stated lattice has a whole number of these `steps`: the log has means of that many readings."""
    return 1.5 < steps < AVERAGED_MOST + 0.5 and abs(steps - round(steps)) < 0.002 * steps


def saturation(record: Record, axis: str) -> tuple[Look, State] | None:
    """Readings are clipped at a limit."""
    state, readings = record.axes[axis], record.readings.get(axis)
    if readings is None or readings.clipped is None or state.below_lattice:
        return None
    clipped = readings.clipped
    sd = readings.lattice.step / 4.0 if readings.lattice is not None else 1e-6 * abs(clipped.limit)
    estimate = {"limit": normal_entry(clipped.limit, sd, state.unit), "clipped": int(clipped.mask.sum())}
    return _anew(record, axis, Look("saturation", clipped.nats, clipped.nats, estimate, {}))


def quantization(record: Record, axis: str) -> tuple[Look, State] | None:
    """Codes that are not alike; or a lattice that the model file does not state and that is coarse against the white
    noise."""
    state, readings = record.axes[axis], record.readings.get(axis)
    found = None if readings is None or readings.clipped is not None else readings.uneven
    if readings is not None and found is not None and not state.below_lattice:
        step = 0.0 if readings.lattice is None else readings.lattice.step
        lsb = {"lsb": normal_entry(step, step * 1e-3, state.unit)} if step > 0.0 else {}
        estimate: dict[str, Any] = {**lsb, "misread": normal_entry(found.share, found.sd, "1")}
        if found.value is not None and found.width is not None:
            estimate["value"] = normal_entry(found.value, 0.0, state.unit)
            estimate["width"] = normal_entry(found.width, 0.0, state.unit)
        changes = {"stated_lsb": step} if lsb else {}
        return _anew(record, axis, Look("quantization", found.nats, found.nats, estimate, changes))
    q, stated = state.lsb, state.stated_lsb
    if q <= 0.0 or state.lattice_is_stated or _averaged(stated / q):
        return None
    sigma = state.best.sigma
    white = math.sqrt(max(sigma**2 - q * q / 12.0, 1e-12 * sigma**2))
    if q / white < LATTICE_LEAST:
        return None
    # Continuous readings would fall within 1/1000 of a lattice by chance: ln 1000 nats each.
    gain = state.best.n * math.log(max(q / white, 1.0) * 10.0)
    look = Look("quantization", gain, gain, {"lsb": normal_entry(q, q * 1e-3, state.unit)}, {"stated_lsb": q})
    return look, replace(state, stated_lsb=q)


def _anew(record: Record, axis: str, look: Look) -> tuple[Look, State]:
    """Draw the readings concerned anew in a record at the recording's own rate, so that the rest is judged as if they
    were sound. Means are made of redrawn readings from the start."""
    state = record.axes[axis]
    if axis not in record.redrawn:
        return look, state
    y = np.where(np.isfinite(state.y), record.redrawn[axis], np.nan)
    return look, state.refit(y=y, redrawn=True, **look.changes)
