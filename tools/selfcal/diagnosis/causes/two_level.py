"""Two levels (popcorn): the bias stays at one level for a while, then jumps to the other.

A switching filter on block means: a random walk with two hypotheses of the level, merged into a Gaussian after each
sample (a generalized pseudo-Bayesian filter of order 1). It runs for many parameters at once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from selfcal.base.grid import Array, Mask
from selfcal.diagnosis.cause import Cause, Channels, Grouping, Key, Scored, Simulated, positive, shown
from selfcal.diagnosis.causes import flicker, variance_change, vibration
from selfcal.diagnosis.record import Record
from selfcal.likelihood.columns import LN_SLOW, SMALLER, top
from selfcal.likelihood.edges import scan, steady
from selfcal.likelihood.state import NET_LEAST, NONE, SCREEN, Look, State, mixture, net

#: Amplitudes over the white noise of a block, and dwell times in blocks, that are tried first.
AMPLITUDES = (0.5, 0.75, 1.1, 1.6, 2.4, 3.6)
DWELLS = (15.0, 50.0, 150.0, 450.0)
#: ln of walk and white noise over the fitted values, for the drift without levels: the same filter judges both.
WALKS, WHITES = np.linspace(-2.0, 0.5, 11), np.linspace(-0.03, 0.03, 4)
#: Places of a dwell time's posterior.
QUANTILES = 64
#: Least jumps between two levels: fewer are steps, or a pulse.
JUMPS_LEAST = 4
#: Price of the search, besides three degrees of freedom.
LN_LOOKS = 2.0 + LN_SLOW
#: Limits of a probability, and the largest exponent, of a double.
PROBABILITY_LEAST, LN_MOST = float(np.finfo(float).eps), math.log(np.finfo(float).max)


def switching(y: Array, theta: Array) -> tuple[Array, Array]:
    """The filter over y [n], NaN where missing: ln likelihood [g] of each set of parameters, and the probability of the
    upper level [n, g] after each block. theta [g, 5]: ln of amplitude, lower and upper dwell time in blocks, walk of a
    block over the white noise, white noise."""
    A, low, high, rho, sigma = np.exp(theta).T
    R, Q, half = sigma**2, (rho * sigma) ** 2, 0.5 * A
    up, down = -np.expm1(-1.0 / low), -np.expm1(-1.0 / high)
    stay, there = 1.0 - up - down, np.isfinite(y)
    x, P = np.full(A.size, y[there][:30].mean()), 1e4 * R
    w = up / (up + down)
    kept, spread, apart, odds = np.empty((4, y.size, A.size))
    for k, value in enumerate(y.tolist()):
        P = P + Q
        w = up + stay * w
        if value == value:  # not missing
            S = spread[k] = P + R
            gain = P / S
            e = apart[k] = value - x
            # The likelihood of the upper level over that of the lower level.
            ratio = np.exp(np.minimum(A * e / S, LN_MOST))
            upper = w * ratio
            both = odds[k] = upper - w + 1.0
            w = np.minimum(np.maximum(upper / both, PROBABILITY_LEAST), 1.0 - PROBABILITY_LEAST)
            e = e + half
            x = x + gain * (e - A * w)
            P = P - gain * P + (gain * A) ** 2 * (w - w * w)
        kept[k] = w
    odds, spread, apart = odds[there], spread[there], apart[there]
    terms = np.log(odds) + np.maximum(A * apart / spread - LN_MOST, 0.0)
    terms -= 0.5 * (np.log(spread) + (apart + half) ** 2 / spread)
    return terms.sum(axis=0), kept


def looks(state: State, record: Record) -> list[Look]:
    """The likeliest levels and dwell times, where they jump often enough."""
    if state.y.size < 200 or state.extras != NONE:
        return []
    # Two levels that jump often have the correlation of a Gauss-Markov drift, which leaves no jump to see.
    if scan(state.series, state.best).gain.max() < SCREEN + 2.0 and _law(state) < SCREEN:
        return []
    series, block = replace(state, y=steady(state)).means()  # the filter knows a walk and white noise of a fixed size
    y = series.y
    walk = next(fit for fit in state.fits if fit.terms.walk)
    ln_rho = walk.of_means(block, 0.0)[walk.terms.names.index("ln_rho")]
    ln_sigma = math.log(walk.sigma * math.sqrt(float(state.r.min()) / block))
    tried = np.array(
        [
            (math.log(a) + ln_sigma, math.log(d), math.log(d), ln_rho - less, ln_sigma)
            for a in AMPLITUDES
            for d in DWELLS
            for less in (0.0, *SMALLER)
        ]
    )
    one_level = _without(ln_rho, ln_sigma)
    value, walks = np.split(switching(y, np.vstack([tried, one_level]))[0], [len(tried)])
    none = float(walks.max()) + _law(state)
    if net(float(value.max()) - none, 3, LN_LOOKS) < 1.0:
        return []
    theta = tried[int(value.argmax())]
    if _jumps(_smoothed(y, theta) > 0.5) < JUMPS_LEAST:
        return []
    theta, gain = _best(y, theta)
    upper = _smoothed(y, theta) > 0.5
    jumps = _jumps(upper)
    if jumps < JUMPS_LEAST:
        return []
    stays = _stays(upper)
    own = theta.copy()
    own[1:3] = [math.log(time / count) for time, count in stays]
    now = float(switching(y, own[None, :])[0][0])
    theta, gain = (own, now) if now > gain else (theta, gain)
    worth = net(gain - none, 3, LN_LOOKS)
    if worth < 1.0:
        return []
    # Jumps between two levels make some nats of any drift on several time scales, and of noise that comes and goes.
    others = [look.gain for cause in (flicker, variance_change) for look in cause.looks(state, record)]
    none += max(others, default=0.0)
    worth = net(gain - none, 3, LN_LOOKS)
    if worth < 1.0:
        return []
    levels = np.where(upper, 0.5, -0.5)[np.minimum(np.arange(state.y.size) // block, upper.size - 1)]
    if _shaken(state, record, levels):
        return []
    dt = state.dt * block
    measure = partial(_amplitude, levels, math.exp(theta[0]))
    estimate = {
        "amplitude": mixture(np.ones(1), np.exp(theta[:1]), 0.05 * math.exp(theta[0]), state.unit),
        "dwell_s": _dwell(sum(time for time, _ in stays), sum(count for _, count in stays), dt),
        **{key: _dwell(*stay, dt) for key, stay in zip(("dwell_low_s", "dwell_high_s"), stays, strict=True)},
        "jumps": jumps,
    }
    changes = {"y": state.y - math.exp(theta[0]) * levels, "redrawn": True}
    return [Look("two_level", gain - none, worth, estimate, changes, measure=measure)]


def _shaken(state: State, record: Record, levels: Array) -> bool:
    """Whether another axis vibrates differently at the two `levels` [n], and the bias follows that axis' variance: the
    levels are then those of a machine that is switched. They fit better than a measured variance, which scatters."""
    variances = record.variances(state.axis)
    louder = set()
    for name, variance in variances.items():
        level = float(np.median(variance))
        if not level > 0.0:
            continue
        # Neighbouring differences have a sample in common: their squares count half.
        gain = 0.5 * variance_change.slope_of(np.minimum(variance / level, variance_change.CLIP_AT) + 1e-12, levels)[1]
        if net(gain, 1, math.log(len(variances))) >= NET_LEAST:
            louder.add(name)
    if not louder:
        return False
    known = {str(regressor.entry["column"]) for regressor in state.regressors if regressor.cause == "vibration"}
    known |= {str(look.estimate["other"]) for look in vibration.looks(state, record) if look.net >= NET_LEAST}
    return bool(louder & known)


def _without(ln_rho: float, ln_sigma: float) -> Array:
    """Walks with a single level [g, 5], for the same filter."""
    walks, whites = (axis.ravel() for axis in np.meshgrid(WALKS, WHITES))
    none, dwell = np.full(walks.size, math.log(PROBABILITY_LEAST) + ln_sigma), np.full(walks.size, math.log(100.0))
    return np.column_stack([none, dwell, dwell, ln_rho + walks, ln_sigma + whites])


def _law(state: State) -> float:
    """How far the walk is behind the best drift, nats: two levels come with a walk."""
    walk = next(fit for fit in state.fits if fit.terms.walk)
    return max(0.0, state.best.ln_likelihood - walk.ln_likelihood)


def _best(y: Array, middle: Array) -> tuple[Array, float]:
    """The likeliest parameters from `middle` on, and their ln likelihood."""
    unbounded = np.tile([PROBABILITY_LEAST, 1.0 / PROBABILITY_LEAST], (middle.size, 1))
    theta = np.log(top(lambda some: switching(y, np.log(some))[0], np.exp(middle).tolist(), unbounded))
    return theta, float(switching(y, theta[None])[0][0])


def _amplitude(levels: Array, removed: float, state: State) -> dict[str, Any]:
    """The coefficient of the decoded `levels` [n], -0.5 and 0.5, over every near drift; `removed` of them is gone."""
    state = replace(state, y=state.y + removed * levels)
    weight, means, sds = (of[0] for of in state.posterior(levels))
    return {"amplitude": mixture(weight, means[:, 0], sds[:, 0], state.unit)}


def _jumps(upper: Mask) -> int:
    return int(np.count_nonzero(np.diff(upper)))


def _stays(upper: Mask) -> list[tuple[float, float]]:
    """Blocks at the lower and at the upper level, and jumps away from each."""
    change = np.diff(upper.astype(int))
    return [(float((~upper).sum()), float((change > 0).sum())), (float(upper.sum()), float((change < 0).sum()))]


def _dwell(time: float, count: float, dt: float) -> dict[str, Any]:
    """Mean of exponential times of which `count` ended in `time` blocks: an inverse gamma, in equal parts."""
    share = (np.arange(QUANTILES) + 0.5) / QUANTILES
    values = dt * time / gammaincinv(count, share)
    return mixture(np.ones(QUANTILES), values, values / QUANTILES, "s")


def _smoothed(y: Array, theta: Array) -> Array:
    """[n]: probability of the upper level given the whole record, by a pass backwards over the filter's."""
    up, down = (-math.expm1(-math.exp(-float(rate))) for rate in theta[1:3])
    filtered = switching(y, theta[None, :])[1][:, 0]
    smooth = filtered.copy()
    for k in range(y.size - 2, -1, -1):
        w, after = filtered[k], smooth[k + 1]
        ahead = w * (1.0 - down) + (1.0 - w) * up
        smooth[k] = w * ((1.0 - down) * after / ahead + down * (1.0 - after) / (1.0 - ahead))
    return np.asarray(smooth)


def _add(keys: Mapping[str, Any], channels: Channels) -> Array:
    """Levels that alternate after dwell times drawn from exponentials."""
    t = channels.time_s
    upper, end = bool(channels.random.integers(2)), 0.0
    values = np.empty(t.size)
    while end <= t[-1]:
        values[t >= end] = keys["amplitude"] * (0.5 if upper else -0.5)
        end += channels.random.exponential(keys["dwell_high_s"] if upper else keys["dwell_low_s"])
        upper = not upper
    return values


CAUSE = Cause(
    "two_level",
    "The bias jumps between two levels (popcorn noise).",
    "Record longer: dwell times are known by the jumps. Try another part: single ones have it.",
    source="sensor",
    looks=looks,
    slow=True,
    pictures=shown("means", "evidence"),
    grouping=Grouping(most=1),
    score=Scored(
        no_gain="the levels are found in the readings themselves, and no model file predicts them",
        once="its jumps are events of their recording",
    ),
    simulated=Simulated(
        keys={
            "amplitude": Key(lambda s: 3.0 * s.n),
            "dwell_low_s": positive(lambda s: s.duration_s / 20.0),
            "dwell_high_s": positive(lambda s: s.duration_s / 20.0),
        },
        add=_add,
    ),
)
