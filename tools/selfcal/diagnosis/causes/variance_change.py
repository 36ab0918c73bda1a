"""The noise level changes once, or follows a channel.

One change bends the cumulative sum of squared innovations. A level that follows a channel has a logarithm in proportion
to the temperature, the supply, or the logarithm of another axis' short-term variance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

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
from selfcal.diagnosis.forms import SMOOTHING_S
from selfcal.diagnosis.model_tree import add_handling
from selfcal.diagnosis.record import Record, smoothed
from selfcal.likelihood.columns import LN_EITHER, NEARLY
from selfcal.likelihood.edges import raised
from selfcal.likelihood.state import NET_LEAST, Look, State, gain_for, interval, ln_looks, mixture, net
from selfcal.likelihood.statemodel import Array
from selfcal.logs.recording import SIDE_CHANNELS

#: A change of the noise keeps this many samples, and this share of the record, from either end.
EDGE_SAMPLES, EDGE_SHARE = 20, 1.0 / 200.0
#: A squared innovation counts as so many variances at most: one wild sample is no change of the noise.
MOST = 12.0
#: Steps of the search for a slope, and the largest one in standard deviations of the channel.
STEPS, FARTHEST = 30, 1.0
#: Samples that the level of another axis leaves out: the one that is judged, and two on either side. Where one axis is
#: in the other, at once or a sample late, or both share noise, a square of one is in the variance of the other.
OWN = 5
#: Shares of the record that the channel lies below at the quiet and at the loud end of `ratio`.
ENDS = (0.05, 0.95)


def ln_changes(n: int, gain: float) -> float:
    """ln of the number of independent places of a change among `n` samples.

    Scores at neighbouring places k of n differ by n / (2 k (n - k))."""
    k = np.arange(max(EDGE_SAMPLES, round(n * EDGE_SHARE)), n // 2)
    return ln_looks(np.repeat(0.5 * n / (k * (n - k)), 2), gain)


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
    """The likeliest place, and for each channel the width of its means that shows most."""
    present = np.isfinite(state.whitened)
    if present.sum() < 4 * EDGE_SAMPLES:
        return []
    square = np.minimum(state.whitened[present] ** 2, MOST) + 1e-12
    best: dict[str, tuple[float, Level]] = {}
    for level in (*_places(state, record, square), *levels(state, record)):
        gain = slope_of(square, level.values[present])[1]
        if gain > best.get(level.column, (0.0, level))[0]:
            best[level.column] = gain, level
    found = (_look(state, level) for gain, level in best.values() if net(gain, 1, level.price(gain)) > NEARLY)
    return [look for look in found if look is not None]


def _look(state: State, level: Level) -> Look | None:
    """The look at a level, refitted: limited squares show less of the louder part at first."""
    present = np.isfinite(state.whitened)
    changed, slope, sd = state, 0.0, math.inf
    for _ in range(2):
        square = np.minimum(changed.whitened[present] ** 2, MOST) + 1e-12
        more, _, sd = slope_of(square, level.values[present])
        slope += more
        changed = state.refit(r=state.r * np.exp(slope * level.values))
    # A kurtosis of the squares other than the normal's 2 widens the null in proportion.
    square = np.minimum(changed.whitened[present] ** 2, MOST)
    wide = max(1.0, float(np.var(square / square.mean())) / 2.0) if state.lsb == 0.0 else 1.0
    gain = changed.best.ln_likelihood - state.best.ln_likelihood
    worth = net(gain / wide, 1, level.price(gain))
    if worth < 1.0:
        return None
    return Look("variance_change", gain, worth, level.told(slope, sd, wide), {"r": changed.r}, when=level.when)


def _places(state: State, record: Record, square: Array) -> Iterator[Level]:
    """The likeliest place of a change, by the squares [m] of the samples that are there."""
    n, read = square.size, np.flatnonzero(np.isfinite(state.whitened))
    edge = max(EDGE_SAMPLES, round(n * EDGE_SHARE))
    total, k = np.cumsum(square), np.arange(1, n)
    first, second = total[:-1] / k, np.maximum((total[-1] - total[:-1]) / (n - k), 1e-12)
    gain = 0.5 * (n * math.log(total[-1] / n) - k * np.log(first) - (n - k) * np.log(second))
    gain[: edge - 1] = gain[n - edge :] = 0.0
    at = int(np.argmax(gain))
    place = int(read[at + 1])

    def told(slope: float, sd: float, wide: float) -> dict[str, Any]:
        """Over every place: the change lies between the last reading before it and the first one with it."""
        weight = np.exp((gain - gain.max()) / wide) * (gain > 0.0)
        held = weight > 1e-7
        time = record.time_s[read]
        apart = np.diff(time)[held]
        ratios = np.sqrt(second[held] / first[held] * first[at] / second[at]) * math.exp(0.5 * slope)
        sds = ratios * np.sqrt(0.5 * wide / k[held] + 0.5 * wide / (n - k[held]))
        return {
            "time_s": mixture(weight[held] * apart, time[1:][held] - 0.5 * apart, apart / math.sqrt(12.0), "s"),
            "ratio": mixture(weight[held], ratios, sds, "1"),
        }

    when = (float(record.time_s[place]), float(record.time_s[-1]))
    yield Level("", raised(state.y.size, place), lambda gain: ln_changes(n, gain), told, when)


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
                "coefficient": interval(size, sd, "1" if unit == "1" else f"1/{unit}"),
                "ratio": interval(ratio, ratio * span * sd, "1"),
            }

        return Level(name, values - values.mean(), lambda gain: price, told)

    for name, (unit, values) in sides.items():
        for width in SMOOTHING_S:
            if width == SMOOTHING_S[0] or width <= 0.1 * n * dt:
                yield level(name, unit, smoothed(values, round(width / dt)), "value")
    for name, values in others.items():
        for width in vibration.WIDTHS_S:
            if width * record.recorded_hz >= vibration.LEAST and width <= 0.1 * n * dt:
                cells = round(width / dt)
                power = smoothed(values, cells)
                if cells > OWN:
                    power = (cells * power - OWN * smoothed(values, OWN)) / (cells - OWN)
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
    for _ in range(STEPS):
        share = square * np.exp(-b * x)
        share /= share.sum()
        mean = float(share @ x)
        bend = 0.5 * n * max(float(share @ x**2) - mean**2, 1e-9)
        step = float(np.clip(0.5 * n * mean / bend, -FARTHEST, FARTHEST))
        while (there := value(b + step)) < now and abs(step) > 1e-6:
            step *= 0.5
        b, now = b + step, max(there, now)
        if abs(step) < 1e-4:
            break
    return b / spread, now - none, 1.0 / (math.sqrt(bend) * spread)


def _trained(look: Look, before: State, after: State, record: Record, split: int) -> State:
    """The change of the noise as the training samples have it."""
    square = np.minimum(before.whitened[:split] ** 2, MOST)
    shape, there = np.log(after.r / before.r), np.isfinite(square)
    return replace(after, r=before.r * np.exp(slope_of(square[there], shape[:split][there])[0] * shape))


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    n = round(state.best.n)
    change = NET_LEAST * gain_for(lambda gain: net(gain, 1, ln_changes(n, gain)))
    return {"ratio": (1.0 + math.sqrt(4.0 * change / n), "1")}


def _extend(at: Extension) -> None:
    if at.finding.look.when and not at.tree.get("regressors"):  # a module handles changes beside no column
        add_handling(at.tree, "variance_changes", True)


def _alike(a: Look, b: Look) -> bool:
    if a.when is None or b.when is None:
        return a.when is b.when and a.estimate["channel"] == b.estimate["channel"]
    return abs(a.when[0] - b.when[0]) < ONE_EVENT_S


CAUSE = Cause(
    "variance_change",
    "The noise level changes.",
    "Look for what was switched on at that time, or for what the channel drives.",
    source="surroundings",
    looks=looks,
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
            "ratio": positive(lambda s: 2.0, "noise_ratio"),
        },
        of_estimate=lambda look: medians(look, "time_s", "ratio") if look.when else None,
    ),
)
