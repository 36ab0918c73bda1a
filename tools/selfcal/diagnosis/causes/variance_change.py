"""The noise level changes once, for a while, or follows a channel.

The logarithm of the level has a column: a change from a time on, or between two times, bends the cumulative sum of
squared innovations. A level that follows a channel is in proportion to the temperature, the supply, or the logarithm of
another axis' short-term variance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from selfcal.base.grid import Array, Rows
from selfcal.diagnosis.cause import (
    Cause,
    Extension,
    Grouping,
    Key,
    Scored,
    Simulated,
    Written,
    medians,
    positive,
    shown,
)
from selfcal.diagnosis.causes import vibration
from selfcal.diagnosis.causes.step import ONE_EVENT_S
from selfcal.diagnosis.channel_looks import SMOOTHING_S
from selfcal.diagnosis.model_tree import add_handling
from selfcal.diagnosis.record import Record, smoothed
from selfcal.likelihood.columns import LN_EITHER, LN_SLOW, NEARLY
from selfcal.likelihood.edges import WEIGHT_LEAST, raised
from selfcal.likelihood.fit import run
from selfcal.likelihood.state import NET_LEAST, Look, State, gain_for, ln_looks, mixture, net, normal_entry
from selfcal.logs.recording import SIDE_CHANNELS
from selfcal.readings.moves import LEVEL

#: A change of the noise keeps this many samples, and this share of the record, from either end.
EDGE_SAMPLES, EDGE_SHARE = 20, 1.0 / 200.0
#: Largest ln of the variance over that of the rest: readings that are this much quieter have no noise, they repeat.
LOUDEST = math.log(1e3)
#: Places among which the two ends of a stretch are looked for first.
END_PLACES = 120
#: Most variances that a squared innovation counts as: a wild sample is no change of the noise.
CLIP_AT = 12.0
#: Steps of the search for a slope, and the largest step in standard deviations of the channel.
SLOPE_STEPS, SLOPE_MOST = 30, 1.0
#: Samples that the level of another axis leaves out: the judged sample, and two on either side. If axes leak, at once
#: or a sample late, or share noise, a square of the judged axis is in the variance of the other.
OWN_SAMPLES = 5
#: Shares of the record that the channel lies below at the quiet and at the loud end of `ratio`.
ENDS = (0.05, 0.95)


@dataclass(frozen=True)
class Power:
    """Squared innovations of axes on a common grid: sums before each sample, `total` [m, n + 1], and the samples in
    them, `count` [m, n + 1]. `present`: samples that an axis has. A level may begin or end at each but the first."""

    total: Array
    count: Array
    present: Rows

    @classmethod
    def of(cls, whitened: Array) -> Power:
        """`Power` of residual innovations [m, n] of standard deviation 1, NaN where they are missing. The trace of a
        jump is no noise: they are taken about their mean nearby, less which white noise has a little less power."""
        there = np.isfinite(whitened)
        known, near = (uniform_filter1d(rows, LEVEL, axis=1) for rows in (there.astype(float), np.nan_to_num(whitened)))
        apart = (whitened - near / np.maximum(known, 1e-9)) / np.sqrt(1.0 - 1.0 / LEVEL)
        square = np.where(there, np.minimum(apart**2, CLIP_AT) + 1e-12, 0.0)
        total, count = (np.cumsum(np.pad(rows, ((0, 0), (1, 0))), axis=1) for rows in (square, there.astype(float)))
        return cls(total, count, np.flatnonzero(there.any(axis=0)))

    @property
    def n(self) -> int:
        """Samples of the grid."""
        return len(self.total.T) - 1

    def levels(self, begin: Rows | int, end: Rows | int) -> tuple[Array, Array]:
        """Variances, and the samples that they rest on, in stretches and outside them: [2, m, k] each."""
        first, last = np.broadcast_arrays(np.atleast_1d(begin), np.atleast_1d(end))
        inside = [rows[:, last] - rows[:, first] for rows in (self.total, self.count)]
        square, n = (
            np.array([own, rows[:, -1:] - own]) for own, rows in zip(inside, (self.total, self.count), strict=True)
        )
        return np.maximum(square, 1e-12) / np.maximum(n, 1.0), n

    def gain(self, begin: Rows | int, end: Rows | int) -> Array:
        """Gain of ln likelihood [m, k] by a level of their own of stretches; 0 of few samples in them or at an end."""
        (level, n), every = self.levels(begin, end), self.count[:, -1:]
        mean = self.total[:, -1:] / np.maximum(every, 1.0)
        found = 0.5 * (every * np.log(np.maximum(mean, 1e-12)) - (n * np.log(level)).sum(axis=0))
        before, after = (self.count[:, np.atleast_1d(at)] for at in (begin, end))
        after = np.where(np.atleast_1d(end) < self.n, every - after, math.inf)  # it may last
        least = np.maximum(EDGE_SAMPLES, np.round(every * EDGE_SHARE))
        return np.where(np.minimum(np.minimum(before, after), n[0]) >= least, found, 0.0)

    def wide(self, states: Sequence[State], begin: int, end: int) -> Array:
        """Times [m] that the null is wider than of normal noise, by the kurtosis of the squares over the levels of a
        stretch."""
        level, inside = self.levels(begin, end)[0], raised(self.n, begin, end) > 0.0
        squares = np.diff(self.total) / np.where(inside, level[0], level[1])
        known = np.diff(self.count) > 0.0
        pairs = zip(states, squares, known, strict=True)
        return np.array([max(1.0, 0.5 * float(np.var(x[there]))) if own.lsb == 0.0 else 1.0 for own, x, there in pairs])

    def best(self) -> list[tuple[int, int]]:
        """The likeliest change that lasts, and the likeliest stretch, by all axes together: from and before which
        sample."""
        places = self.present[1:]
        coarse = places[np.unique(np.linspace(0, places.size - 1, END_PLACES).astype(int))]
        first, last = coarse[np.transpose(np.triu_indices(coarse.size, 1))].T
        at = int(np.argmax(self.gain(first, last).sum(axis=0)))
        return [self.moved(int(places[0]), self.n), self.moved(int(first[at]), int(last[at]))]

    def moved(self, begin: int, end: int) -> tuple[int, int]:
        """The stretch with each end in turn at its likeliest place."""
        places = self.present[1:]
        for _ in range(1 if end == self.n else 2):
            before = places[places < end]
            begin = int(before[np.argmax(self.gain(before, end).sum(axis=0))])
            if end < self.n:
                after = places[places > begin]
                end = int(after[np.argmax(self.gain(begin, after).sum(axis=0))])
        return begin, end


def ln_changes(n: int, gain: float, ends: int = 1) -> float:
    """ln of the number of independent changes among `n` samples, or of stretches with two `ends`.

    Scores at neighbouring places k of n differ by n / (2 k (n - k))."""
    k = np.arange(max(EDGE_SAMPLES, round(n * EDGE_SHARE)), n // 2)
    return ends * ln_looks(np.repeat(0.5 * n / (k * (n - k)), 2), gain) + (LN_SLOW if ends > 1 else 0.0)


@dataclass(frozen=True)
class Level:
    """What the noise level may follow: ln of the variance is in proportion to `values` [n]. `price` of its search by
    the gain. `told`: the estimate by the slope, its standard deviation, and the excess of the squares' variance."""

    column: str
    values: Array
    price: Callable[[float], float]
    told: Callable[[float, float, float], dict[str, Any]]
    when: tuple[float, float] | None = None


def looks(state: State, record: Record) -> list[Look]:
    """The likeliest time, and for each channel the width of its means that shows most."""
    present = np.isfinite(state.whitened)
    if present.sum() < 4 * EDGE_SAMPLES:
        return []
    square = np.minimum(state.whitened[present] ** 2, CLIP_AT) + 1e-12
    times = [_of_time(state, record, *ends) for _, ends in noisy_stretches([state])]
    best: dict[str, tuple[float, Level]] = {}
    for level in (*times, *levels(state, record)):
        gain = slope_of(square, level.values[present])[1]
        worth = net(gain, 1, level.price(gain))
        if worth > best.get(level.column, (NEARLY, level))[0]:
            best[level.column] = worth, level
    found = (_look(state, level) for _, level in best.values())
    return [look for look in found if look.net >= 1.0]


def at(state: State, record: Record, theta: Sequence[float]) -> Look:
    """The look at a stretch that several axes show, from and before which time, s."""
    begin, end = (min(round(time / state.dt), state.y.size) for time in theta)
    return _look(state, _of_time(state, record, begin, end))


def filtered(states: Sequence[State], power: Power, begin: int, end: int) -> Power:
    """The power of axes behind filters that know the level of a stretch, by what filters that do not have: those follow
    loud noise, and are off for a while after it."""
    level, shown = power.levels(begin, end)[0][:, :, 0], power.gain(begin, end)[:, 0] > 0.0
    rows = []
    for state, ratio in zip(states, np.where(shown, level[0] / level[1], 1.0), strict=True):
        raise_by = np.where(raised(state.y.size, begin, end) > 0.0, ratio, 1.0)
        series, best = replace(state, r=state.r * raise_by).series, state.best
        white = run(series, best.terms, best.theta, innovations=True)[1]
        rows.append((white[:, 0] - white[:, 1:] @ best.c) / best.sigma * np.sqrt(raise_by))
    return Power.of(np.array(rows))


def noisy_stretches(states: Sequence[State]) -> Iterator[tuple[Power, tuple[int, int]]]:
    """The likeliest change that lasts, and the likeliest stretch: the power of the axes with it, and its ends."""
    first = Power.of(np.array([state.whitened for state in states]))
    for ends in first.best():
        power = filtered(states, first, *ends)
        yield power, power.moved(*ends)


def _look(state: State, level: Level) -> Look:
    """The look at a level, refitted: limited squares show less of the louder part at first."""
    present = np.isfinite(state.whitened)
    changed, slope, sd = state, 0.0, math.inf
    for _ in range(2):
        square = np.minimum(changed.whitened[present] ** 2, CLIP_AT) + 1e-12
        more, _, sd = slope_of(square, level.values[present])
        slope += more
        changed = state.refit(r=state.r * np.exp(slope * level.values))
    wide = float(Power.of(changed.whitened[None]).wide([state], 0, state.y.size)[0])
    gain = changed.best.ln_likelihood - state.best.ln_likelihood
    worth = net(gain / wide, 1, level.price(gain))
    if abs(slope) * float(np.ptp(level.values)) > LOUDEST:
        worth = 0.0
    return Look("variance_change", gain, worth, level.told(slope, sd, wide), {"r": changed.r}, when=level.when)


def _of_time(state: State, record: Record, begin: int, end: int) -> Level:
    """A level from sample `begin` on and before sample `end`."""
    n = state.y.size

    def likely(gain: Array, at: Rows, wide: float) -> tuple[Array, Rows]:
        """Weights of the likeliest places `at` of an end by their gains, and these."""
        weight = np.exp((gain - gain.max()) / wide) * (gain > 0.0)
        held = weight > WEIGHT_LEAST
        return weight[held], at[held]

    def time(present: Rows, weight: Array, at: Rows) -> dict[str, Any]:
        """Time of an end: between the last reading before a place and the first after it."""
        last = record.time_s[present[np.searchsorted(present, at) - 1]]
        apart = record.time_s[at] - last
        return mixture(weight * apart, last + 0.5 * apart, apart / math.sqrt(12.0), "s")

    def told(slope: float, sd: float, wide: float) -> dict[str, Any]:
        """The estimate over every place of each end, the other end held."""
        power = filtered([state], Power.of(state.whitened[None]), begin, end)
        present = power.present
        before, after = present[1:][present[1:] < end], present[present > begin]
        weight, first = likely(power.gain(before, end)[0], before, wide)
        (level, many), (now, _) = power.levels(first, end), power.levels(begin, end)
        ratios = np.sqrt(level[0] / level[1] * now[1] / now[0])[0] * math.exp(0.5 * slope)
        found = {"time_s": time(present, weight, first)}
        if end < n:
            until = time(present, *likely(power.gain(begin, after)[0], after, wide))
            lasts, sds = until["median"] - found["time_s"]["median"], (until["sd"], found["time_s"]["sd"])
            found["duration_s"] = normal_entry(lasts, math.hypot(*sds), "s")
        sds = ratios * np.sqrt(0.5 * wide * (1.0 / np.maximum(many, 1.0)).sum(axis=0)[0])
        return {**found, "ratio": mixture(weight, ratios, sds, "1")}

    when = (float(record.time_s[begin]), float(record.time_s[min(end, n - 1)]))
    price = partial(ln_changes, round(state.best.n), ends=1 + (end < n))
    return Level("", raised(n, begin, end), price, told, when)


def levels(state: State, record: Record) -> Iterator[Level]:
    """Every channel over the widths of its means that the record is long enough for, s."""
    n, dt = state.y.size, state.dt
    sides = {record.channel_names[name]: (SIDE_CHANNELS[name][1], values) for name, values in record.channels.items()}
    others = record.variances(state.axis)
    price = LN_EITHER + math.log(max(1, len(sides) + len(others)))

    def level(name: str, unit: str, values: Array, by: str) -> Level:
        span = float(np.diff(np.quantile(values[np.isfinite(state.whitened)], ENDS))[0])

        def told(slope: float, sd: float, wide: float) -> dict[str, Any]:
            """The level is the root of the variance."""
            size, sd = 0.5 * slope, 0.5 * sd * math.sqrt(wide)
            ratio = math.exp(abs(size) * span)
            return {
                "channel": name,
                "input": by,
                "form": "static",
                "coefficient": normal_entry(size, sd, "1" if unit == "1" else f"1/{unit}"),
                "ratio": normal_entry(ratio, ratio * span * sd, "1"),
            }

        return Level(name, values - values.mean(), lambda gain: price, told)

    for name, (unit, values) in sides.items():
        for width in SMOOTHING_S:
            if width == SMOOTHING_S[0] or width <= 0.1 * n * dt:
                yield level(name, unit, smoothed(values, round(width / dt)), "value")
    for name, values in others.items():
        for width in vibration.WIDTHS_S:
            if width * record.recorded_hz >= vibration.ENOUGH and width <= 0.1 * n * dt:
                cells = round(width / dt)
                power = smoothed(values, cells)
                if cells > OWN_SAMPLES:
                    power = (cells * power - OWN_SAMPLES * smoothed(values, OWN_SAMPLES)) / (cells - OWN_SAMPLES)
                yield level(name, "1", np.log(np.maximum(power / power.max(), 1e-12)), "variance")


def slope_of(square: Array, values: Array) -> tuple[float, float, float]:
    """Slope of ln variance by `values` [n], its gain of ln likelihood, and its standard deviation, by Newton's steps.

    `square` [n]: squared innovations; their mean variance is free."""
    spread = float(values.std())
    if not spread > 0.0:
        return 0.0, 0.0, math.inf
    x = (values - values.mean()) / spread
    b, n = 0.0, square.size

    def value(b: float) -> float:
        return -0.5 * n * math.log(float((square * np.exp(-b * x)).mean()))

    none = now = value(0.0)
    bend = 1.0
    for _ in range(SLOPE_STEPS):
        share = square * np.exp(-b * x)
        share /= share.sum()
        mean = float(share @ x)
        bend = 0.5 * n * max(float(share @ x**2) - mean**2, 1e-9)
        step = float(np.clip(0.5 * n * mean / bend, -SLOPE_MOST, SLOPE_MOST))
        while (there := value(b + step)) < now and abs(step) > 1e-6:
            step *= 0.5
        b, now = b + step, max(there, now)
        if abs(step) < 1e-4:
            break
    return b / spread, now - none, 1.0 / (math.sqrt(bend) * spread)


def _trained(look: Look, before: State, after: State, record: Record, split: int) -> State:
    """The change of the noise as the training samples have it."""
    square = np.minimum(before.whitened[:split] ** 2, CLIP_AT)
    shape, there = np.log(after.r / before.r), np.isfinite(square)
    return replace(after, r=before.r * np.exp(slope_of(square[there], shape[:split][there])[0] * shape))


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    n = round(state.best.n)
    change = NET_LEAST * gain_for(lambda gain: net(gain, 1, ln_changes(n, gain)))
    return {"ratio": (1.0 + math.sqrt(4.0 * change / n), "1")}


def _extend(at: Extension) -> None:
    if at.finding.look.when and not at.tree.get("regressors"):  # a module with columns handles no changes
        add_handling(at.tree, "variance_changes", True)


def _alike(a: Look, b: Look) -> bool:
    if a.when is None or b.when is None:
        return a.when is b.when and a.estimate["channel"] == b.estimate["channel"]
    return all(abs(one - two) < ONE_EVENT_S for one, two in zip(a.when, b.when, strict=True))


CAUSE = Cause(
    "variance_change",
    "The noise level changes.",
    "Look for what was switched on at that time, or for what the channel drives.",
    source="surroundings",
    looks=looks,
    at=at,
    pictures=shown("marked_level"),
    least=_least,
    grouping=Grouping(alike=_alike, most=3),
    score=Scored(
        once="a change of the noise is an event of its recording",
        no_carry=lambda look: "" if look.when else "the bank's noise level follows no channel",
        trained=_trained,
    ),
    written=Written(extend=_extend),
    simulated=Simulated(
        keys={
            "time_s": Key(lambda s: s.duration_s / 2.0, "variance_time_s"),
            "duration_s": positive(None, "variance_duration_s"),
            "ratio": positive(lambda s: 2.0, "noise_ratio"),
        },
        of_estimate=lambda look: medians(look) if look.when else None,
    ),
)
