"""Findings that need little or no fit: of the readings and of the clock, missing samples, motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import ndtr, pdtrc

from selfcal.diagnosis.causes.missing_samples import MISSING_LEAST
from selfcal.diagnosis.record import Record
from selfcal.likelihood.state import NET_LEAST, Look, State, interval
from selfcal.likelihood.statemodel import Array, Mask
from selfcal.readings.motion import Moved
from selfcal.readings.readings import Readings

#: An unstated lattice is told of from this many white noise sd on.
LATTICE_LEAST = 0.5
#: Readings at most of which a log's means show by their lattice.
AVERAGED_MOST = 20
#: Motion: the piece of time that rests or moves, s; variances over the resting one's; mean lengths, s, and the shares
#: of pieces in which a motion begins.
PIECE_S = 0.5
MOTION_RATIOS = (1.25, 1.6, 2.2, 3.5, 6.0, 12.0)
MOTION_S = (1.0, 4.0, 16.0)
MOTION_BEGINS = (2e-4, 1e-3, 5e-3)
#: Samples of which the level of an axis takes means at least: the median of single squares is off by 10 % at 1 Hz, and
#: two axes that are both taken for too quiet look moved.
LEVEL_BLOCK = 20
#: How much of the others' energy an axis may show where it moves.
SENSITIVITIES = (1.0, 0.5, 0.25)
#: Nats that speak for motion of the gyroscopes, or of the accelerometers, where the others move. The bursts are those
#: in which all together are loudest.
KIND_LEAST = 2.0
#: Axes whose innovations correlate by more than this, beyond chance, share a source.
SHARED_LEAST = 0.05
#: Pieces at most: they take 3 KB each.
PIECES_MOST = 40_000
#: ln of the evidence for motion that is told. Of 264 clean records at 1 Hz one shows more than 2: 4.4.
MOTION_LEAST = 4.5


def missing(record: Record) -> tuple[dict[str, Look], Mask]:
    """By axis gaps in the stamps, and rows that repeat the one before: the logger held the last reading. The mask is
    those, where an axis is found to miss samples."""
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
            {"missing": interval(float(gone), 0.0, "samples")},
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
        if state.axis in record.unclipped:
            same &= record.unclipped[state.axis] == state.y  # a clipped reading repeats for being clipped
        repeats.append(same)
    if not repeats or any(state.redrawn for state in record.axes.values()):
        return none  # means of blocks repeat by chance: a held reading shows at the recording's own rate
    held = np.all(repeats, axis=0)
    shares = [
        max((float(same.sum()) - float(held.sum())) / same.size, _repeats_by_chance(state), _repeats_of_earlier(state))
        for same, state in zip(repeats, record.axes.values(), strict=True)
    ]
    expected = held.size * float(np.prod(np.maximum(shares, 1.0 / held.size)))
    # Chance repeats of coarse axes are not quite independent: three times the expectation.
    return held if pdtrc(int(held.sum()) - 1, 3.0 * expected + 0.05) < math.exp(-NET_LEAST) else none


def _repeats_by_chance(state: State) -> float:
    """Share of white noise's readings on the axis' lattice that repeat the one before."""
    return 2.0 * float(ndtr(state.lsb / (2.0 * math.sqrt(2.0) * state.best.sigma))) - 1.0 if state.fits else 0.0


def _repeats_of_earlier(state: State) -> float:
    """Share of readings that repeat one two to four before: chance alone, on a lattice of several steps as well."""
    return sum(float((state.y[k:] == state.y[:-k]).mean()) for k in (2, 3, 4)) / 3.0


def rate_changes(record: Record) -> list[Look]:
    """Changes of the sampling rate. The record has means over an interval that all rates share."""
    return [
        Look(
            "rate_change",
            change.nats,
            change.nats,
            {
                "time_s": interval(change.time_s, 0.5 / min(change.before_hz, change.after_hz), "s"),
                "before_hz": interval(change.before_hz, 0.0, "Hz"),
                "after_hz": interval(change.after_hz, 0.0, "Hz"),
            },
            {},
            when=(change.time_s, change.time_s),
        )
        for change in record.changes
    ]


def held_samples(record: Record, axis: str) -> Look | None:
    """The logger asks oftener than the part measures, always or in stretches."""
    readings = record.readings.get(axis)
    if readings is None:
        return None
    if readings.held_hz is None:
        return _slower(readings) if readings.slower else None
    # Each reading that is asked for again repeats; by chance one in 100 would at most.
    nats = min(1e6, readings.values.size * math.log(100.0))
    return Look("held_samples", nats, nats, {"rate_hz": interval(readings.held_hz, 0.0, "Hz")}, {})


def _slower(readings: Readings) -> Look:
    """Stretches in which each reading is held; the rate is that of the surest."""
    surest = max(readings.slower, key=lambda one: one.nats)
    nats = min(1e6, sum(one.nats for one in readings.slower))
    intervals = readings.slower_intervals
    rate_hz = readings.recording.rate_hz / surest.ratio
    estimate = {"rate_hz": interval(rate_hz, 0.0, "Hz"), "intervals": intervals}
    return Look("held_samples", nats, nats, estimate, {}, when=(intervals[0][0], intervals[-1][1]))


def recurring(record: Record, axis: str) -> Look | None:
    """Readings that are one value too often."""
    readings = record.readings.get(axis)
    if readings is None or readings.recurring is None:
        return None
    mask, nats, share = readings.recurring.mask, readings.recurring.nats, readings.recurring.share
    times = readings.recording.time_s[mask if mask.any() else readings.values == readings.recurring.value]
    estimate = {
        "fraction": interval(share, math.sqrt(share / mask.size), "1"),
        "time_s": interval(float(times[0]), 0.0, "s"),
    }
    return Look("outliers", nats, nats, estimate, {}, when=(float(times[0]), float(times[-1])))


def stuck(record: Record, axis: str) -> Look | None:
    """Stretches of equal readings that are no chance."""
    readings = record.readings.get(axis)
    if readings is None or not readings.intervals:
        return None
    intervals = readings.intervals
    nats = readings.stuck_nats
    return Look("stuck", nats, nats, {"intervals": intervals}, {}, when=(intervals[0][0], intervals[-1][1]))


def _averaged(steps: float) -> bool:
    """Whether the stated lattice has a whole number of these `steps`: the log has means of so many readings."""
    return 1.5 < steps < AVERAGED_MOST + 0.5 and abs(steps - round(steps)) < 0.002 * steps


def quantization(state: State) -> Look | None:
    """A lattice that the model file does not state and that is coarse against the white noise."""
    q = state.lsb
    stated = state.stated_lsb
    if q <= 0.0 or (stated > 0.0 and abs(q / stated - 1.0) < 0.02) or _averaged(stated / q):
        return None
    sigma = state.best.sigma
    white = math.sqrt(max(sigma**2 - q * q / 12.0, 1e-12 * sigma**2))
    if q / white < LATTICE_LEAST:
        return None
    n = state.best.n
    # Continuous readings would fall within 1/1000 of a lattice by chance: ln 1000 nats each.
    gain = n * math.log(max(q / white, 1.0) * 10.0)
    return Look(
        "quantization",
        gain,
        gain,
        {"lsb": interval(q, q * 1e-3, state.unit)},
        {"stated_lsb": q},
    )


def saturation(record: Record, axis: str) -> tuple[Look, State] | None:
    """Readings are clipped at a limit. In a record at the recording's own rate they are drawn anew beyond the limit, so
    that the rest is judged as if it had not been clipped. Means are of those from the start."""
    state, readings = record.axes[axis], record.readings.get(axis)
    if readings is None or readings.clipped is None:
        return None
    clipped = readings.clipped
    sd = readings.lattice.step / 4.0 if readings.lattice is not None else 1e-6 * abs(clipped.limit)
    estimate = {"limit": interval(clipped.limit, sd, state.unit), "clipped": int(clipped.mask.sum())}
    look = Look("saturation", clipped.nats, clipped.nats, estimate, {})
    if axis not in record.unclipped:
        return look, state
    y = np.where(np.isfinite(state.y), record.unclipped[axis], np.nan)
    return look, state.refit(y=y, redrawn=True)


def uneven(record: Record, axis: str) -> tuple[Look, State] | None:
    """Codes that are not alike. In a record at the recording's own rate each reading is drawn anew among the codes that
    it may come from."""
    state, readings = record.axes[axis], record.readings.get(axis)
    found = None if readings is None else readings.uneven
    if readings is None or found is None:
        return None
    step = 0.0 if readings.lattice is None else readings.lattice.step
    lsb = {"lsb": interval(step, step * 1e-3, state.unit)} if step > 0.0 else {}
    estimate: dict[str, Any] = {**lsb, "misread": interval(found.share, found.sd, "1")}
    if found.value is not None and found.width is not None:
        estimate["value"] = interval(found.value, 0.0, state.unit)
        estimate["width"] = interval(found.width, 0.0, state.unit)
    look = Look("quantization", found.nats, found.nats, estimate, {"stated_lsb": step} if lsb else {})
    if axis not in record.alike:
        return look, state
    y = np.where(np.isfinite(state.y), record.alike[axis], np.nan)
    return look, state.refit(y=y, redrawn=True, **look.changes)


def motion(record: Record, wild: Mapping[str, float]) -> tuple[dict[str, Moved], Mask]:
    """Bursts of energy on two axes or more at once, 0.5 to 16 s long, against each axis' own level about it, and the
    samples [n] in which any moves.

    `wild`: share of the samples that are outliers beyond doubt, by axis."""
    # On a lattice coarser than the noise a rare change of code looks like a burst.
    names = [name for name, state in record.axes.items() if state.lsb < 1.5 * state.best.sigma]
    n = record.present.size
    mask = np.zeros(n, bool)
    if len(names) < 2:
        return {}, mask
    rate = record.rate_hz
    power = _power([record.axes[name].whitened for name in names], rate)
    share = np.array([wild.get(name, 0.0) for name in names])
    whole, bursts = _moving(power, rate, share)
    if bursts and whole >= MOTION_LEAST:
        whole, bursts = _of_several_sources(record, names, bursts, rate, share) or (whole, bursts)
    if not bursts or whole < MOTION_LEAST or sum(b - a for a, b in bursts) > 0.25 * n:
        return {}, mask
    joined = _joined_bursts(bursts, round(2.0 * rate))
    pad = max(1, round(0.5 * rate))
    found: dict[str, Moved] = {}
    for k, name in enumerate(names):
        kind = np.array([record.axes[other].unit == record.axes[name].unit for other in names])
        if _louder(power, joined, kind) < KIND_LEAST or _louder(power, joined, np.arange(len(names)) == k) < 0.0:
            continue
        shown = [(a, b) for a, b in joined if _shares(power[:, a:b], k)] or joined
        times = tuple((a / rate, b / rate) for a, b in shown)
        found[name] = Moved(times, sum(_burst(power[k, a:b]) for a, b in joined), whole)
    if len(found) < 2:
        return {}, mask
    for a, b in joined:
        mask[max(0, a - pad) : b + pad] = True
    return found, mask


def _power(whitened: Sequence[Array], rate: float) -> Array:
    """Squared innovations over the level of their axis about them [axes, n]; 1 where there is none."""
    squares = []
    for w in whitened:
        filled = np.where(np.isfinite(w), w * w, 1.0)
        around = max(3, min(w.size // 3, round(600.0 * rate)))
        level = _robust_level(filled, max(LEVEL_BLOCK, round(rate)), around)
        squares.append(np.minimum(filled / level, 25.0))
    return np.array(squares)


def _of_several_sources(
    record: Record, names: Sequence[str], bursts: list[tuple[int, int]], rate: float, wild: Array
) -> tuple[float, list[tuple[int, int]]] | None:
    """`_moving` of the sources that axes of one kind share in place of these axes; None where none share any.

    A source that several axes show is loud on all of them by itself: its bursts are its own, and no motion. The first
    source is the direction in which the bursts are loudest, in units of the axes' joint noise at rest."""
    inside = np.zeros(record.present.size, bool)
    for a, b in bursts:
        inside[a:b] = True
    whitened = np.array([record.axes[name].whitened for name in names])
    known = np.isfinite(whitened).all(axis=0)
    shared = False
    for unit in {record.axes[name].unit for name in names}:
        own = np.array([k for k, name in enumerate(names) if record.axes[name].unit == unit])
        rest = np.clip(whitened[own][:, known & ~inside], -3.0, 3.0)
        together = np.atleast_2d(np.corrcoef(rest))
        if np.abs(together - np.eye(own.size)).max() < SHARED_LEAST + 4.0 / math.sqrt(rest.shape[1]):
            continue
        values, vectors = np.linalg.eigh(together)
        apart = vectors / np.sqrt(np.maximum(values, 1e-6)) @ vectors.T @ whitened[own]
        burst = apart[:, known & inside]
        whitened[own] = np.linalg.eigh(burst @ burst.T)[1].T @ apart
        wild = np.where(np.isin(np.arange(len(names)), own), wild[own].max(), wild)
        shared = True
    return _moving(_power(list(whitened), rate), rate, wild) if shared else None


def _moving(power: Array, rate: float, wild: Array) -> tuple[float, list[tuple[int, int]]]:
    """ln of the evidence that the sensor moves now and then, and when (samples). `power` [axes, n]: squared innovations
    over the level of their axis, at `rate`, Hz. `wild` [axes]: share of the samples that are outliers beyond doubt.

    In every piece all rests, one axis alone is loud (a jump, an outlier, its own noise), or the
    sensor moves: all axes are louder by one ratio, for as long as it lasts. Beside that an axis of many outliers is
    loud by itself in their share of the pieces. The evidence is the likelihood of this hidden Markov model over that of
    the one without motion, each the mean over lengths and shares: without motion it exceeds e^x with a probability
    below e^-x.
    """
    axes, n = power.shape
    piece = max(1, round(PIECE_S * rate), n // PIECES_MOST)
    count = n // piece
    energy = power[:, : count * piece].reshape(axes, count, piece).sum(axis=2)
    ratio = np.array(MOTION_RATIOS)
    louder = energy.T[:, :, None] * 0.5 * (1.0 - 1.0 / ratio) - 0.5 * piece * np.log(ratio)
    share_wild = np.minimum(0.5, wild * piece)[:, None]
    with np.errstate(divide="ignore"):
        outlier = np.log(share_wild) + np.logaddexp.reduce(louder, axis=2, keepdims=True) - math.log(ratio.size)
    # Over rest's likelihood, which holds the axis' outliers as well.
    alone = np.logaddexp(np.log1p(-share_wild) + louder, outlier)
    alone -= np.logaddexp(np.log1p(-share_wild), outlier)
    together = alone.sum(axis=1)
    like = np.exp(np.minimum(np.hstack([together, alone.reshape(count, -1)]), 600.0))
    share = 0.5 / np.repeat([ratio.size, axes * ratio.size], [ratio.size, axes * ratio.size])
    ln_with, moving = _forward_backward(like, share, ratio.size, piece / rate)
    ln_without, _ = _forward_backward(like[:, ratio.size :], share[ratio.size :], 0, piece / rate)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (moving > 0.5).astype(int), [0]])))
    return ln_with - ln_without, [(int(a) * piece, int(b) * piece) for a, b in edges.reshape(-1, 2)]


def _forward_backward(like: Array, share: Array, moved: int, piece_s: float) -> tuple[float, Array]:
    """ln of the mean likelihood over lengths and shares, and the probability [pieces] of the first `moved` states.

    `like` [pieces, states]: likelihood of each state over rest's; `share` [states] of what begins; `piece_s`, s."""
    begins, lasts = (grid.ravel()[:, None] for grid in np.meshgrid(MOTION_BEGINS, MOTION_S))
    ends = np.minimum(1.0, piece_s / lasts)
    count = len(like)
    rest, loud = np.ones((begins.size, 1)), np.zeros((begins.size, share.size))
    ln_evidence = np.zeros(begins.size)
    ahead = np.empty((count if moved else 0, begins.size, share.size + 1))
    for k in range(count):
        rest, loud = (
            rest * (1.0 - begins * share.sum()) + ends * loud.sum(axis=1, keepdims=True),
            (loud * (1.0 - ends) + rest * begins * share) * like[k],
        )
        total = rest + loud.sum(axis=1, keepdims=True)
        rest, loud = rest / total, loud / total
        ln_evidence += np.log(total[:, 0])
        if moved:
            ahead[k, :, :1], ahead[k, :, 1:] = rest, loud
    weight = np.exp(ln_evidence - ln_evidence.max())
    probability = np.zeros(count)
    rest, loud = np.ones((begins.size, 1)), np.ones((begins.size, share.size))
    for k in range(count - 1, -1, -1) if moved else ():
        both = ahead[k] * np.hstack([rest, loud])
        here = both[:, 1 : 1 + moved].sum(axis=1) / both.sum(axis=1)
        probability[k] = float(weight @ here) / float(weight.sum())
        after = loud * like[k]
        rest, loud = (
            rest * (1.0 - begins * share.sum()) + begins * (after @ share)[:, None],
            after * (1.0 - ends) + rest * ends,
        )
        largest = np.maximum(rest, loud.max(axis=1, keepdims=True))
        rest, loud = rest / largest, loud / largest
    return float(np.logaddexp.reduce(ln_evidence)) - math.log(begins.size), probability


def _joined_bursts(bursts: list[tuple[int, int]], apart: int) -> list[tuple[int, int]]:
    """In order of time; those closer than `apart` are one."""
    ordered = sorted(bursts)
    found = [ordered[0]]
    for a, b in ordered[1:]:
        if a - found[-1][1] < apart:
            found[-1] = (found[-1][0], max(b, found[-1][1]))
        else:
            found.append((a, b))
    return found


def _excess(mean: Array) -> Array:
    """Twice the gain, a sample, of a variance `mean` above the stated one."""
    return np.where(mean > 1.0, mean - 1.0 - np.log(np.maximum(mean, 1e-12)), 0.0)


def _burst(power: Array) -> float:
    return 0.5 * power.size * float(_excess(power.mean()))


def _louder(power: Array, bursts: list[tuple[int, int]], own: Mask) -> float:
    """ln of the likelihood that the axes `own` are louder in the bursts, in proportion to the others [axes, n], over
    that of rest; infinite without others."""
    if own.all():
        return math.inf
    mean = np.array([power[own, a:b].mean() for a, b in bursts])
    others = np.array([max(1.0, float(power[~own, a:b].mean())) for a, b in bursts])
    size = np.array([b - a for a, b in bursts])
    ratio = 1.0 + np.outer(SENSITIVITIES, others - 1.0)
    return 0.5 * float(own.sum()) * float(((mean * (1.0 - 1.0 / ratio) - np.log(ratio)) @ size).max())


def _shares(power: Array, k: int) -> bool:
    """Whether axis `k` is rather as loud as all [axes, n] are together than at rest."""
    ratio = max(1.0, float(power.mean()))
    return bool(power[k].mean() * (1.0 - 1.0 / ratio) > math.log(ratio)) and ratio > 1.0


def _robust_level(square: Array, block: int, around: int) -> Array:
    """Local level of squared innovations: the running median of block means, over its own median's ratio."""
    count = square.size // block
    if count < 8:
        return np.full(square.size, max(1e-9, float(np.median(square)) / 0.4549))
    means = square[: count * block].reshape(count, block).mean(axis=1)
    size = max(3, min(count, around // block) | 1)
    middle = median_filter(means, size, mode="reflect")
    # The median of a mean of `block` squares of normals, against its mean of 1 (Wilson and Hilferty).
    ratio = (1.0 - 2.0 / (9.0 * block)) ** 3
    level: Array = np.interp(np.arange(square.size), (np.arange(count) + 0.5) * block, middle / ratio)
    return np.maximum(level, 1e-9)


def masked(state: State, mask: Mask) -> State:
    """The state without the samples of `mask`."""
    y = state.y.copy()
    y[mask] = np.nan
    return replace(state, y=y)
