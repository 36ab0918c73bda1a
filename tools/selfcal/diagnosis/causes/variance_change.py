"""One change of the white noise: the cumulative sum of squared innovations bends."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from selfcal.diagnosis.cause import Cause, Extension, Key, medians, positive, shown
from selfcal.diagnosis.model_tree import add_handling
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import NET_LEAST, Look, State, gain_for, ln_looks, mixture, net

#: A change of the noise keeps this many samples, and this share of the record, from either end.
EDGE_SAMPLES, EDGE_SHARE = 20, 1.0 / 200.0


def ln_changes(n: int, gain: float) -> float:
    """ln of the number of independent places of a change among `n` samples.

    Scores at neighbouring places k of n differ by n / (2 k (n - k))."""
    k = np.arange(max(EDGE_SAMPLES, round(n * EDGE_SHARE)), n // 2)
    return ln_looks(np.repeat(0.5 * n / (k * (n - k)), 2), gain)


def looks(state: State, record: Record) -> list[Look]:
    """The likeliest place."""
    present = np.isfinite(state.y)
    w = state.whitened[present]
    n = w.size
    edge = max(EDGE_SAMPLES, round(n * EDGE_SHARE))
    if n < 4 * edge:
        return []
    square = np.minimum(w * w, 12.0) + 1e-12  # one wild sample is no change of the noise
    total = np.cumsum(square)
    k = np.arange(1, n)
    first, second = total[:-1] / k, (total[-1] - total[:-1]) / (n - k)
    gain = 0.5 * (n * math.log(total[-1] / n) - k * np.log(first) - (n - k) * np.log(second))
    gain[: edge - 1] = gain[n - edge :] = 0.0
    at = int(np.argmax(gain))
    # A kurtosis of the squares other than the normal's 2 widens the null in proportion.
    wide = max(1.0, float(np.var(square / first[at] if at else square)) / 2.0) if state.lsb == 0.0 else 1.0
    scan = float(gain[at]) / wide
    if net(scan, 1, ln_changes(n, scan)) < 1.0:
        return []
    place = int(np.flatnonzero(present)[at + 1])
    ratio = math.sqrt(float(second[at] / first[at]))
    r = state.r.copy()
    r[place:] *= ratio**2
    changed = state.refit(r=r)
    # Limited squares show less of the louder part. With the change in the model both parts are limited alike.
    left = np.minimum(changed.whitened[present] ** 2, 12.0)
    more = math.sqrt(float(left[at + 1 :].mean() / left[: at + 1].mean()))
    ratio *= more
    r[place:] *= more**2
    changed = changed.refit(r=r)
    exact = changed.best.ln_likelihood - state.best.ln_likelihood
    worth = net(min(exact, scan * 1.2 + 2.0), 1, ln_changes(n, exact))
    if worth < 1.0:
        return []
    time = float(record.time_s[place])
    # Over every place: the change lies between the last reading before it and the first one with it.
    weight = np.exp((gain - gain.max()) / wide) * (gain > 0.0)
    held = weight > 1e-7
    read = record.time_s[present]
    apart = np.diff(read)[held]
    times = read[1:][held] - 0.5 * apart
    ratios = np.sqrt(second[held] / first[held]) * more
    sds = ratios * np.sqrt(0.5 * wide / k[held] + 0.5 * wide / (n - k[held]))
    return [
        Look(
            "variance_change",
            exact,
            worth,
            {
                "time_s": mixture(weight[held] * apart, times, apart / math.sqrt(12.0), "s"),
                "ratio": mixture(weight[held], ratios, sds, "1"),
            },
            {"r": r},
            when=(time, float(record.time_s[-1])),
        )
    ]


def _trained(look: Look, before: State, after: State, record: Record, split: int) -> State:
    """The change of the noise as the training samples have it."""
    place = round((look.when or (0.0, 0.0))[0] * record.rate_hz)
    w2 = np.minimum(before.whitened**2, 12.0)
    ratio = float(np.nanmean(w2[place:split]) / np.nanmean(w2[:place]))
    r = before.r.copy()
    r[place:] *= ratio
    return replace(after, r=r)


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    n = round(state.best.n)
    change = NET_LEAST * gain_for(lambda gain: net(gain, 1, ln_changes(n, gain)))
    return {"ratio": (1.0 + math.sqrt(4.0 * change / n), "1")}


def _extend(at: Extension) -> None:
    if not at.tree.get("regressors"):  # a module handles changes beside no column
        add_handling(at.tree, "variance_changes", True)


CAUSE = Cause(
    "variance_change",
    "The noise level changes once.",
    "Look for what was switched on at that time.",
    looks=looks,
    most=3,
    stationary=True,
    pictures=shown("marked_level"),
    once="a change of the noise is an event of its recording",
    onset=True,
    trained=_trained,
    least=_least,
    extend=_extend,
    of_estimate=lambda look: medians(look, "time_s", "ratio"),
    keys={
        "time_s": Key(lambda s: s.duration_s / 2.0, "variance_time_s"),
        "ratio": positive(lambda s: 2.0, "noise_ratio"),
    },
)
