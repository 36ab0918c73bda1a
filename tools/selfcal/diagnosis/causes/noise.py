"""Coloured noise, flicker, a change of the noise, and outliers: causes that change the noise model itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from selfcal.diagnosis.fit import best, fit, moved
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import Look, State, interval, ln_looks, mixture, net
from selfcal.diagnosis.statemodel import Array

#: A change of the noise keeps this many samples, and this share of the record, from either end.
EDGE_SAMPLES, EDGE_SHARE = 20, 1.0 / 200.0
#: ln of the number of looks, by 1350 clean records at 1 and 10 Hz. The size of 1/f noise is at its limit of nothing in
#: most of them: 11 instead of 68 showed 3 nats at the price of one look. The two numbers of a mixture are as bound: 5
#: instead of 1350 / e gained 2.5 nats.
LN_FLICKER = -1.5
LN_OUTLIERS = -1.5
#: Outliers are exceptions: a look that takes more of the samples for them has another cause.
OUTLIERS_MOST = 0.05


def ln_changes(n: int, gain: float) -> float:
    """ln of the number of independent places of a change among `n` samples.

    Scores at neighbouring places k of n differ by n / (2 k (n - k))."""
    k = np.arange(max(EDGE_SAMPLES, round(n * EDGE_SHARE)), n // 2)
    return ln_looks(np.repeat(0.5 * n / (k * (n - k)), 2), gain)


def colored(state: State, record: Record) -> list[Look]:
    """White noise with memory: a moving average, whose correlation cuts off, or a first-order process."""
    if state.extras.color:
        return []
    w = np.nan_to_num(state.whitened)
    n = max(1, int(np.isfinite(state.y).sum()))
    lags: Array = np.array([float(w[k:] @ w[:-k]) / n for k in (1, 2)])
    if 0.5 * n * float(lags @ lags) < 2.0:
        return []
    found: list[Look] = []
    for color in ("ma", "ar"):
        fits = []
        for drift in state.near():
            terms = replace(drift, color=color)
            start = moved(next(one for one in state.fits if one.terms == drift), terms)
            start[terms.names.index("color")] = math.atanh(min(0.9, max(-0.9, float(lags[0]))))
            fits.append(fit(state.series, terms, start, step=0.25))
        chosen = best(fits)
        gain = chosen.ln_likelihood - state.best.ln_likelihood
        m = math.tanh(chosen.value("color"))
        lag1 = m / (1.0 + m * m) if color == "ma" else m
        sd = (1.0 - lag1 * lag1) / math.sqrt(n)
        found.append(
            Look(
                "colored_noise",
                gain,
                net(gain),
                {"lag1": interval(lag1, sd, "1")},
                {"extras": replace(state.extras, color=color)},
            )
        )
    return [max(found, key=lambda one: one.gain)]


def flicker(state: State, record: Record) -> list[Look]:
    """1/f noise: beside either drift, or alone."""
    if state.extras.flicker:
        return []
    extras = replace(state.extras, flicker=True)
    series = state.series
    fits = [fit(series, extras, moved(state.best, extras))]
    for drift in (replace(extras, walk=True), replace(extras, markov=True)):
        fits.append(fit(series, drift, moved(state.best, drift)))
    chosen = best(fits)
    gain = chosen.ln_likelihood - state.best.ln_likelihood
    worth = net(gain, 1, LN_FLICKER)
    if worth < 1.0:
        return []
    B = chosen.sigma * math.exp(chosen.value("ln_flicker"))
    sd_ln = _curvature(state, chosen, "ln_flicker")
    return [
        Look(
            "flicker",
            gain,
            worth,
            {"B": _log_interval(B, sd_ln, state.unit)},
            {"extras": extras},
        )
    ]


def _log_interval(value: float, sd_ln: float, unit: str) -> dict[str, object]:
    return {
        "mean": value * math.exp(0.5 * sd_ln**2),
        "median": value,
        "sd": value * sd_ln,
        "q05": value * math.exp(-1.6449 * sd_ln),
        "q95": value * math.exp(1.6449 * sd_ln),
        "unit": unit,
    }


def _curvature(state: State, chosen: object, name: str) -> float:
    """Standard deviation of one parameter by the second difference of ln likelihood, the others refitted by none."""
    from selfcal.diagnosis.fit import Fit, ln_likelihood, run

    assert isinstance(chosen, Fit)
    k = chosen.terms.names.index(name)
    h = 0.1
    values = []
    for move in (-h, 0.0, h):
        theta = chosen.theta.copy()
        theta[k] += move
        values.append(ln_likelihood(run(state.series, chosen.terms, theta)[0][0]))
    bend = (2.0 * values[1] - values[0] - values[2]) / h**2
    return 1.0 / math.sqrt(bend) if bend > 1e-3 else 3.0


def variance_change(state: State, record: Record) -> list[Look]:
    """One change of the white noise: the cumulative sum of squared innovations bends."""
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


def outliers(state: State, record: Record) -> list[Look]:
    """Isolated wild samples. They are exceptions: a mixture with many of them has another cause."""
    return [look for look in mixed(state, record) if look.estimate["fraction"]["median"] <= OUTLIERS_MOST]


def mixed(state: State, record: Record) -> list[Look]:
    """A mixture of the innovations with a share of wider ones."""
    w = state.whitened
    present = np.isfinite(w)
    x = w[present]
    n = x.size
    if n < 50 or np.abs(x).max() < 3.5:
        return []
    share, wide, core = max(1.0, float((np.abs(x) > 4.0).sum())) / n, max(3.0, float(np.abs(x).max()) / 2.0), 1.0
    plain = -0.5 * (x**2).sum() / np.mean(x**2) - n * 0.5 * math.log(float(np.mean(x**2)))
    weight = np.zeros(n)
    before = -math.inf
    value = before
    for _ in range(200):
        a = math.log(max(1e-12, 1.0 - share)) - 0.5 * (x / core) ** 2 - math.log(core)
        b = math.log(share) - 0.5 * (x / wide) ** 2 - math.log(wide)
        both = np.logaddexp(a, b)
        value = float(both.sum())
        weight = np.exp(b - both)
        share = min(0.3, max(0.3 / n, float(weight.mean())))
        wide = max(2.5 * core, math.sqrt(float(weight @ x**2 / max(weight.sum(), 1e-12))))
        core = max(1e-6, math.sqrt(float((1.0 - weight) @ x**2 / max(1e-12, (1.0 - weight).sum()))))
        if value - before < 1e-4:
            break
        before = value
    gain = value - float(plain)
    worth = net(gain, 2, LN_OUTLIERS)
    picked = np.flatnonzero(present)[weight > 0.5]
    if worth < 1.0 or not picked.size:
        return []
    # Several in a row are no outliers: motion, or a change of the noise.
    alone = np.ones(picked.size, bool)
    if picked.size > 1:
        close = np.diff(picked) <= 3
        alone[1:] &= ~close
        alone[:-1] &= ~close
    if alone.mean() < 0.6 and share < 0.1:
        worth *= float(alone.mean())
    y = state.y.copy()
    y[picked] = np.nan
    if not np.nanmax(y) > np.nanmin(y):
        return []  # the others are all equal: a dead band
    largest = int(picked[np.argmax(np.abs(w[picked]))])
    fraction = picked.size / n
    return [
        Look(
            "outliers",
            gain,
            worth,
            {
                "fraction": interval(fraction, math.sqrt(picked.size) / n, "1"),
                "time_s": interval(float(record.time_s[largest]), 0.0, "s"),
            },
            {"y": y},
            when=(float(record.time_s[picked[0]]), float(record.time_s[picked[-1]])),
        )
    ]
