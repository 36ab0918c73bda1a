"""Findings that need little or no fit: missing samples, an unstated lattice, readings at a limit, motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import ndtr
from scipy.stats import poisson, truncnorm

from selfcal.diagnosis.causes.motion import Moved
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import NET_LEAST, Look, State, interval
from selfcal.diagnosis.statemodel import Array, Mask

#: Missing samples are told of from this share on.
MISSING_LEAST = 1e-3
#: A change of the sampling clock is told of from this share on; a crystal keeps 1e-4.
CLOCK_LEAST = 1e-3
#: An unstated lattice is told of from this many white noise sd on.
LATTICE_LEAST = 0.5
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


def missing(record: Record) -> tuple[Look, Mask] | None:
    """Gaps in the stamps, and rows that repeat the one before: the logger held the last reading. The mask is those."""
    held = _held(record)
    gone = record.missing + int(held.sum())
    span = max(record.present.size, record.missing)
    where = np.flatnonzero(~record.present | held) / record.rate_hz
    if gone <= MISSING_LEAST * span or not where.size:
        return None
    look = Look(
        "missing_samples",
        float(gone),
        float(gone),
        {"missing": interval(float(gone), 0.0, "samples")},
        {},
        when=(float(where[0]), float(where[-1])),
    )
    return look, held


def _held(record: Record) -> Mask:
    """Rows all of whose axes repeat, where their lattices make fewer such rows by chance."""
    none = np.zeros(record.present.size, bool)
    repeats = []
    for state in record.axes.values():
        same = np.zeros(record.present.size, bool)
        same[1:] = np.diff(state.y) == 0.0
        repeats.append(same)
    if not repeats or any(state.redrawn for state in record.axes.values()):
        return none  # means of blocks repeat by chance: a held reading shows at the recording's own rate
    held = np.all(repeats, axis=0)
    shares = [
        max((float(same.sum()) - float(held.sum())) / same.size, _repeats_by_chance(state))
        for same, state in zip(repeats, record.axes.values(), strict=True)
    ]
    expected = held.size * float(np.prod(np.maximum(shares, 1.0 / held.size)))
    # Chance repeats of coarse axes are not quite independent: three times the expectation.
    return held if poisson.logsf(int(held.sum()) - 1, 3.0 * expected + 0.05) < -NET_LEAST else none


def _repeats_by_chance(state: State) -> float:
    """Share of white noise's readings on the axis' lattice that repeat the one before."""
    return 2.0 * float(ndtr(state.lsb / (2.0 * math.sqrt(2.0) * state.best.sigma))) - 1.0 if state.fits else 0.0


def clock(record: Record) -> Look | None:
    """The sampling interval changes once: the time stamps, laid on one even grid, have a bend."""
    off = record.off_grid_s
    if off is None or off.size < 60:
        return None
    k = np.arange(off.size)
    off = off - np.interp(k, [0, k[-1]], [off[0], off[-1]])  # a bend is farthest from the chord
    edge = max(10, off.size // 50)
    at = edge + int(np.argmax(np.abs(off[edge:-edge])))
    halves = (slice(None, at), slice(at, None))
    lines = [np.polyfit(k[half], off[half], 1) for half in halves]
    bent = np.concatenate([np.polyval(line, k[half]) for line, half in zip(lines, halves, strict=True)])
    scatter = float((off - bent).std())
    interval_s = 1.0 / record.recorded_hz
    change = float(lines[1][0] - lines[0][0]) / interval_s
    bend = float(np.abs(off).max())
    if abs(change) < CLOCK_LEAST or bend < 3.0 * interval_s or bend < 5.0 * scatter:
        return None
    time = float(at * interval_s)
    nats = min(1e6, 0.5 * (bend / max(scatter, 1e-3 * interval_s)) ** 2)
    return Look(
        "unexplained",
        nats,
        nats,
        {"statistic": "sampling_interval", "measured": 1.0 + change},
        {},
        when=(time, time),
        shown_by="sampling_interval",
    )


def quantization(state: State) -> Look | None:
    """A lattice that the model file does not state and that is coarse against the white noise."""
    q = state.lsb
    stated = state.stated_lsb
    if q <= 0.0 or (stated > 0.0 and abs(q / stated - 1.0) < 0.02):
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


def saturation(state: State) -> tuple[Look, State] | None:
    """Readings pile up at the largest or the smallest value: the model expects some beyond it and none is.

    The expected number beyond is the evidence, in nats (Poisson). Clipped readings are then drawn anew from what the
    filter predicts beyond the limit, so that the rest is judged as if it had not been clipped."""
    y = state.y
    finite = np.isfinite(y)
    found = state
    sides: list[tuple[float, int]] = []
    gain = 0.0
    for sign in (1, -1):
        edge = float(np.nanmax(sign * y))
        at_edge = finite & (sign * y >= edge - 1e-9 * max(1.0, abs(edge)))
        if at_edge.sum() < 3:
            continue
        half = 0.5 * state.lsb
        predicted = sign * (y - state.whitened * np.sqrt(state.variance))
        deviation = np.sqrt(state.variance)
        beyond = ndtr((predicted - edge - half) / deviation)
        expected = float(np.nansum(beyond))
        # Unclipped, the expectation beyond the largest reading is itself distributed as exp(-x): either side is a look.
        worth = expected - math.log(2.0)
        if half > 0.0:
            # Clipped, a reading of the last code was of that code or beyond it. Some ten codes might be the last.
            cell = ndtr((predicted - edge + half) / deviation) - beyond
            pile = float(np.log1p(beyond[at_edge] / np.maximum(cell[at_edge], 1e-300)).sum())
            worth = max(worth, pile - math.log(20.0))
        elif not state.redrawn:
            # Without a lattice no two readings are alike by chance; each repeat counts for no more than 1 in 100.
            worth = max(worth, (int(at_edge.sum()) - 1) * math.log(100.0))
        if worth < NET_LEAST or at_edge.sum() < 0.5 * expected:
            continue
        sides.append((sign * edge, int(at_edge.sum())))
        gain += worth + math.log(2.0)
        found = _unclipped(found, at_edge, edge, sign)
    if not sides:
        return None
    limit = max(sides, key=lambda side: side[1])[0]
    count = sum(side[1] for side in sides)
    look = Look(
        "saturation",
        gain,
        gain,
        {
            "limit": interval(limit + state.level, state.lsb / 4.0 or 1e-6 * abs(limit + state.level), state.unit),
            "clipped": count,
        },
        {},
    )
    return look, found


def _unclipped(state: State, at_edge: Mask, edge: float, sign: int) -> State:
    random = np.random.default_rng(1)
    for _ in range(4):
        s = np.sqrt(state.variance[at_edge])
        predicted = sign * state.y[at_edge] - sign * state.whitened[at_edge] * s
        low = (edge - 0.5 * state.lsb - predicted) / s
        drawn = predicted + s * truncnorm.rvs(low, np.inf, random_state=random)
        y = state.y.copy()
        y[at_edge] = sign * drawn
        state = state.refit(y=y, redrawn=True)
    return state


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
        found[name] = Moved(tuple(shown), sum(_burst(power[k, a:b]) for a, b in joined), whole)
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
