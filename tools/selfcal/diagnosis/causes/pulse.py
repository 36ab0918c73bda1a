"""A pulse of the bias: a step, and after a while one back of the same size. Each alone may be weak.

Pairs of places on a coarse grid of block means come first. Then each place of the best pairs moves to its best sample,
the other held.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from selfcal.base.grid import half_means
from selfcal.diagnosis.cause import Cause, Channels, Grouping, Key, Scored, Simulated, Written, medians, positive, shown
from selfcal.diagnosis.causes.step import ONE_EVENT_S, WEIGHT_LEAST, Scan, at_jump, raised, scan
from selfcal.diagnosis.model_tree import digits
from selfcal.diagnosis.record import Record
from selfcal.likelihood.columns import LN_SLOW
from selfcal.likelihood.fit import Fit, Series, ln_det, shifts
from selfcal.likelihood.state import Look, Regressor, State, gain_for, interval, ln_looks, mixture, net, sizes
from selfcal.likelihood.statemodel import DRIFT_SIZES, SIZE_LIMITS, Array, Terms

#: Blocks that the pairs are looked for in, and places of a step among them.
BLOCKS, PLACES = 3000, 96
#: Columns beside the model's in one pass of the filter.
CHUNK = 24
#: Drifts that the pairs are ranked at: the fitted one's size times e to these.
SIZES = (0.0, -1.5, -3.0)
#: Pairs that are moved, and how far they are apart, places.
TRIED, APART = 2, 3
#: Two steps that gain so much more with sizes of their own, nats and share of the gain, are no pulse. Of pulses 2 in
#: 1000 do by chance; the share is that of sizes a third apart.
UNEQUAL, UNEQUAL_SHARE = 5.0, 0.03
#: Samples of a pulse at least: a shorter one is outliers'. Samples at the ends where no step is looked for.
SHORTEST, EDGE = 10, 4
#: Times of the posterior's start and end that are taken together, the likeliest of each.
MOST_TIMES = 40


@dataclass(frozen=True)
class Pulses:
    """Pulses between a held place and each sample [n]: score `B`, information `A`, 0 where none is looked for; `none`:
    ln likelihood without, the columns' coefficients integrated out, less a constant."""

    B: Array
    A: Array
    none: float

    @property
    def gain(self) -> Array:
        """[n]: gain of ln likelihood at this drift and sigma."""
        return np.where(self.A > 0.0, 0.5 * self.B**2 / np.where(self.A > 0.0, self.A, 1.0), 0.0)


def looks(state: State, record: Record) -> list[Look]:
    """The best pair of places, refitted exactly, where its steps are of one size."""
    n = state.y.size
    if n < 10 * SHORTEST or state.extras.color or state.extras.bands:
        return []
    steps = scan(state.series, state.best)
    pairs = [(begin, end) for begin, end in (*_coarse(state), *_of_step(state, steps)) if end - begin >= SHORTEST]
    moved = [_moved(state, begin, end) for begin, end in pairs]
    tried = [one for one in moved if one[1] >= EDGE and one[2] <= n - EDGE and one[2] - one[1] >= SHORTEST]
    if not tried:
        return []
    gain, begin, end, _ = max(tried, key=lambda one: one[0])
    found = raised(n, begin, end)
    worth = _worth(steps, gain)
    if worth < 1.0:
        return []
    if state.with_columns(np.array([found, raised(n, end)]))[0] > gain + max(UNEQUAL, UNEQUAL_SHARE * gain):
        return []
    gain = min(gain, state.rich_gain(found))
    worth = _worth(steps, gain)
    if worth < 1.0:
        return []
    return [_look(state, record, begin, end, gain, worth, posterior(record.time_s, begin, end, state, brief=True))]


def at(state: State, record: Record, theta: Sequence[float]) -> Look:
    """The look at a pulse of known times."""
    begin, end = (round(time / state.dt) for time in theta)
    column = raised(state.y.size, begin, end)
    gain, fit = state.with_columns(column)
    edge = state.dt / math.sqrt(12.0)
    estimate = {
        "time_s": interval(begin * state.dt - 0.5 * state.dt / state.block, edge, "s"),
        "duration_s": interval((end - begin) * state.dt, math.sqrt(2.0) * edge, "s"),
        "amplitude": interval(float(fit.c[-1]), float(fit.sd[-1]), state.unit),
    }
    found = _look(state, record, begin, end, gain, net(gain), estimate)
    return replace(found, measure=partial(sizes, column, "amplitude", state.unit))


def _look(
    state: State, record: Record, begin: int, end: int, gain: float, worth: float, estimate: Mapping[str, Any]
) -> Look:
    found = raised(state.y.size, begin, end)
    times = [float(record.time_s[place]) for place in (begin, end)]
    entry = {"kind": "pulse", "start_s": times[0], "end_s": times[1]}
    column = Regressor(_name(*times), "pulse", found, "1", entry)
    changes = {"regressors": (*state.regressors, column)}
    measure = partial(posterior, record.time_s, begin, end)
    return Look("pulse", gain, worth, estimate, changes, when=(times[0], times[1]), measure=measure)


def _worth(steps: Scan, gain: float) -> float:
    """Net of the search for two places: each costs as much as one of a step's."""
    return net(gain, 1, 2.0 * ln_looks(steps.bend, gain) + LN_SLOW)


def _name(start_s: float, end_s: float) -> str:
    return f"pulse_{start_s:.6g}_{end_s:.6g}s"


def _coarse(state: State) -> list[tuple[int, int]]:
    """The best pairs of places, some way apart, of block means."""
    series, block = blocks(state)
    m = series.y.size
    places = np.unique(np.linspace(0, m, PLACES + 2).astype(int)[1:-1])
    value = np.full((places.size, places.size), -math.inf)
    near = state.near()
    for fit in (one for one in state.fits if one.terms in near):
        for less in SIZES:
            value = np.maximum(value, _pairs(series, fit.terms, of_blocks(fit, block, less), places))
    found: list[tuple[int, int]] = []
    while len(found) < TRIED and np.isfinite(value.max()):
        i, j = divmod(int(value.argmax()), places.size)
        found.append((int(places[i]) * block, int(places[j]) * block))
        value[max(0, i - APART) : i + APART + 1, max(0, j - APART) : j + APART + 1] = -math.inf
    return found


def _of_step(state: State, steps: Scan) -> list[tuple[int, int]]:
    """The best single step as the start of a pulse and as its end."""
    n = state.y.size
    place = int(np.argmax(steps.gain))
    _, fit = state.with_columns(raised(n, place))
    ahead, behind = (_other(state, fit, place, after).gain for after in (True, False))
    return [(place, int(np.argmax(ahead))), (int(np.argmax(behind)), place)]


def blocks(state: State, longest_s: float = math.inf) -> tuple[Series, int]:
    """Means of blocks of `longest_s` at most, NaN where half of one is missing, and the samples of a block."""
    n = state.y.size
    block = max(1, int(min(n // BLOCKS, longest_s / state.dt)))
    m = n // block

    def cut(values: Array) -> Array:
        return values[..., : m * block].reshape(*values.shape[:-1], m, block)

    mean, used = half_means(state.y, block)
    r = cut(state.r).mean(axis=1) * block / np.maximum(used, 1)
    columns = np.ascontiguousarray(cut(state.series.columns).mean(axis=2))
    return Series(mean, state.dt * block, r, columns), block


def of_blocks(fit: Fit, block: int, less: float) -> Array:
    """The parameters of a fit for means of so many samples; sizes of the drift are relative to the white noise's."""
    by = {name: 0.5 * math.log(block) for name in DRIFT_SIZES} | {"ln_rho": math.log(block)}
    least = math.log(SIZE_LIMITS[0])
    return np.array(
        [
            max(value + by[name] + less, least) if name in by else value
            for name, value in zip(fit.terms.names, fit.theta, strict=True)
        ]
    )


def _pairs(series: Series, terms: Terms, theta: Array, places: Array) -> Array:
    """[k, k]: ln likelihood with a pulse from one place until a later one."""
    known, k = len(series.columns), places.size
    steps = (np.arange(series.y.size)[None, :] >= places[:, None]).astype(np.float64)
    both = np.empty((k, k))
    for at in range(0, k, CHUNK):
        found = shifts(series.beside(steps[at : at + CHUNK]), terms, theta)
        both[:, at : at + CHUNK] = found.B[places, known + 1 :]
    G, cross = found.sums.G[: known + 1, : known + 1], found.B[places, 1 : known + 1]
    inverse = np.linalg.pinv(G[1:, 1:], rcond=1e-12, hermitian=True)
    b = found.B[places, 0] - cross @ inverse @ G[1:, 0]
    size = found.A[places] - ((cross @ inverse) * cross).sum(axis=1)
    both -= cross @ inverse @ cross.T
    information = size[:, None] + size[None, :] - both - both.T
    usable = np.triu(information > 1e-6 * size.max(), 1)
    explained = (b[:, None] - b[None, :]) ** 2 / np.where(usable, information, 1.0)
    n, left = found.sums.n, G[0, 0] - G[0, 1:] @ inverse @ G[1:, 0]
    rss = np.maximum(left - explained, 1e-12 * left)
    return np.where(usable, -0.5 * (n * (np.log(2.0 * math.pi * rss / n) + 1.0) + found.sums.D), -math.inf)


def _moved(state: State, begin: int, end: int) -> tuple[float, int, int, Fit]:
    """Exact gain, places and fit of a pair, each place in turn at its best sample. The null's drift has swallowed a
    part of the pulse: the places are sharper with the drift that is left beside it."""
    n = state.y.size
    gain, fit = state.with_columns(raised(n, begin, end))
    for _ in range(2):
        there = begin, end
        for _ in range(2):
            end = int(np.argmax(_other(state, fit, begin, after=True).gain))
            begin = int(np.argmax(_other(state, fit, end, after=False).gain))
        if not begin < end:
            return gain, *there, fit
        now, refitted = state.with_columns(raised(n, begin, end))
        if now <= gain:
            return gain, *there, fit
        gain, fit = now, refitted
    return gain, begin, end, fit


def _other(state: State, fit: Fit, place: int, after: bool) -> Pulses:
    """The other place of a pulse with one at `place`, before it or after."""
    n = state.y.size
    found = shifts(state.series.beside(raised(n, place)), fit.terms, fit.theta)
    G, B, p = found.sums.G, found.B, len(found.sums.G) - 1
    inverse = np.linalg.pinv(G[1:p, 1:p], rcond=1e-12, hermitian=True)
    own, cross, y = inverse @ G[1:p, p], B[:, 1:p], G[1:p, 0]
    score = (G[p, 0] - own @ y) - (B[:, 0] - cross @ inverse @ y)
    held = G[p, p] - own @ G[1:p, p]
    A = held + found.A - ((cross @ inverse) * cross).sum(axis=1) - 2.0 * (B[:, p] - cross @ own)
    where = np.arange(n)
    out = (where < place + SHORTEST) | (where > n - EDGE) if after else (where > place - SHORTEST) | (where < EDGE)
    A = np.where(out | (1e-6 * held > A), 0.0, A)
    none = -0.5 * ((G[0, 0] - y @ inverse @ y) / fit.sigma**2 + found.sums.D - ln_det(inverse))
    return Pulses(score / fit.sigma**2 * (1.0 if after else -1.0), A / fit.sigma**2, none)


def posterior(time_s: Array, begin: int, end: int, state: State, brief: bool = False) -> dict[str, Any]:
    """Time, duration and amplitude over every near drift and its parameters' spread; of a `brief` one at the best.

    The two times hardly know each other: each is taken with the other held. The amplitude's shift by both is summed."""
    ln_weight, amplitude, sd, starts, ends = [], [], [], [], []
    found = raised(state.y.size, begin, end)
    fit = state.with_columns(found)[1]
    drifts = [(fit, fit.theta, 0.0)] if brief else state.possible(found, rich=False)
    for one, theta, ln_share in drifts:
        at = replace(one, theta=theta, sigma=fit.sigma)
        first, last = _other(state, at, end, after=False), _other(state, at, begin, after=True)
        if not (first.A[begin] > 0.0 and last.A[end] > 0.0):  # this drift forgets too fast to know
            continue
        i, j = _likely(first, begin), _likely(last, end)
        middle = float(last.B[end] / last.A[end])
        gain = first.gain[i][:, None] + last.gain[j][None, :] - last.gain[end]
        size = (first.B[i] / first.A[i])[:, None] + (last.B[j] / last.A[j])[None, :] - middle
        information = np.sqrt(first.A[i][:, None] * last.A[j][None, :])
        ln_weight.append((ln_share + last.none + gain - 0.5 * np.log(information)).ravel())
        amplitude.append(size.ravel())
        sd.append((1.0 / np.sqrt(information)).ravel())
        starts.append(np.repeat(i, j.size))
        ends.append(np.tile(j, i.size))
    if not ln_weight:
        ln_weight, amplitude, sd = [np.zeros(1)], [fit.c[-1:]], [fit.sd[-1:]]
        starts, ends = [np.array([begin])], [np.array([end])]
    ln_all = np.concatenate(ln_weight)
    weight = np.exp(ln_all - ln_all.max())
    begun, ended = (time_s[np.concatenate(places)] for places in (starts, ends))
    # An edge lies between the last reading before it and the first one after it.
    edge = state.dt / math.sqrt(12.0)
    return {
        "time_s": mixture(weight, begun - 0.5 * state.dt / state.block, edge, "s"),
        "duration_s": mixture(weight, ended - begun, math.sqrt(2.0) * edge, "s"),
        "amplitude": mixture(weight, np.concatenate(amplitude), np.concatenate(sd), state.unit),
    }


def _likely(pulses: Pulses, place: int) -> Array:
    """The likeliest places about `place`, itself among them."""
    gain = np.where(pulses.A > 0.0, pulses.gain, -math.inf)
    held = np.flatnonzero(gain > gain.max() + math.log(WEIGHT_LEAST))
    best = held[np.argsort(-gain[held])[:MOST_TIMES]]
    return np.union1d(best, [place])


def _alike(a: Look, b: Look) -> bool:
    return (
        a.when is not None
        and b.when is not None
        and all(abs(one - two) < ONE_EVENT_S for one, two in zip(a.when, b.when, strict=True))
    )


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    """One of a tenth of the record in its middle."""
    n = record.present.size
    shape = raised(n, round(0.45 * n), round(0.55 * n))
    steps = scan(state.series, state.best)
    return {"amplitude": (state.least(shape) * math.sqrt(gain_for(lambda gain: _worth(steps, gain))), state.unit)}


def _entry(entry: Mapping[str, Any], look: Look | None, record: Record) -> dict[str, Any]:
    """Its times are those of the whole recording."""
    times = [float(entry[key]) for key in ("start_s", "end_s")]
    if look is not None:
        known = medians(look)
        times = [known["time_s"], known["time_s"] + known["duration_s"]]
    start_s, end_s = (digits(time + record.start_s) for time in times)
    return {**entry, "name": _name(start_s, end_s), "start_s": start_s, "end_s": end_s}


def _of_column(column: Regressor, c: Sequence[float]) -> dict[str, Any]:
    start_s, end_s = (float(column.entry[key]) for key in ("start_s", "end_s"))
    return {"time_s": start_s, "duration_s": end_s - start_s, "amplitude": c[0]}


def _add(keys: Mapping[str, Any], channels: Channels) -> Array:
    t = channels.time_s - keys["time_s"]
    return np.where((t >= 0.0) & (t < keys["duration_s"]), keys["amplitude"], 0.0)


CAUSE = Cause(
    "pulse",
    "The bias jumps, and after a while it jumps back.",
    "Look for what was switched on and off at these times.",
    source="surroundings",
    looks=looks,
    at=at,
    slow=True,
    of_means=True,
    pictures=shown("means", "evidence"),
    least=_least,
    grouping=Grouping(alike=_alike, piece=at_jump, most=3),
    score=Scored(once="a pulse is an event of its recording"),
    written=Written(entry=_entry, of_column=_of_column),
    simulated=Simulated(
        keys={
            "time_s": Key(lambda s: 0.45 * s.duration_s),
            "duration_s": positive(lambda s: 0.1 * s.duration_s),
            "amplitude": Key(lambda s: 2.0 * s.n),
        },
        add=_add,
    ),
)
