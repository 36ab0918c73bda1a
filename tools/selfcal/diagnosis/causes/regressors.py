"""Temperature, supply, another axis and a ramp: known columns that enter a reading times a constant."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.fft import rfft
from scipy.stats import chi2

from selfcal.diagnosis.fit import Fit, run
from selfcal.diagnosis.record import Record, smoothed
from selfcal.diagnosis.state import NET_LEAST, SCREEN, Look, Regressor, State, interval, mixture, net
from selfcal.diagnosis.statemodel import Array
from selfcal.recording import SIDE_CHANNELS
from selfcal.regressors import coefficient_unit

#: Widths of the means that a channel is smoothed by, s: its own noise and lattice would hide what it does. The model
#: file's window is as wide and trails: a module has no later values.
SMOOTHING_S = (1.0, 10.0, 30.0, 90.0)
#: Bands of equal information that must agree on another axis' coefficient.
BANDS = 16
#: Prices of the searches, ln of the number of independent looks: smoothings are nearly the same look.
LN_SMOOTHINGS = math.log(2.0)
#: Drawn records of a channel's own noise, and the share of a coefficient that it leaves at least.
NOISES = 4
KEPT_LEAST = 0.3
#: A drift that is known from few of its own turns leaves slow columns a longer tail. Of 2267 clean axes at 1 and 10 Hz
#: 7 showed 7 nats of a supply or a temperature and 2 of a ramp at a price of 0.8, where 4 and 2 were due; the tail ran
#: on to 10.2. With 1.8 two show 7.6 of any.
LN_SLOW = 1.8


def looks(state: State, record: Record) -> list[Look]:
    """One look for every column that the model does not have yet."""
    found: list[Look] = []
    known = {one.name for one in state.regressors}
    t = record.time_s
    middle = float(0.5 * t[-1])
    if "time" not in known:
        column = Regressor("time", "ramp", t - middle, "s", {"kind": "time", "reference": middle})
        found += _linear(state, "ramp", [column], "slope", LN_SLOW)
    for cause, values in record.channels.items():
        if cause in known:
            continue
        _, unit = SIDE_CHANNELS[cause]
        heading = record.channel_names[cause]
        options = []
        for width in SMOOTHING_S:
            window = max(1, round(width * record.rate_hz))
            smooth = smoothed(values, window)
            reference = float(np.round(smooth.mean(), 3))
            entry = {"kind": "column", "column": heading, "unit": unit, "reference": reference}
            entry |= {"window_s": width} if window > 1 else {}
            options.append(Regressor(cause, cause, smooth - reference, unit, entry))
            if window >= values.size // 10:
                break
        found += _linear(state, cause, options, "coefficient", LN_SMOOTHINGS + LN_SLOW, values)
    others = record.other_axes(state.axis)
    options = [
        Regressor(
            f"axis_{name}",
            "cross_axis",
            values,
            record.axes[name].unit,
            {"kind": "column", "column": name, "unit": record.axes[name].unit, "reference": 0.0},
        )
        for name, values in others.items()
        if f"axis_{name}" not in known and np.ptp(values) > 0.0
    ]
    if options:
        found += _linear(state, "cross_axis", options, "coefficient", math.log(len(options)))
    return found


def _inconstancy(state: State, column: Array) -> float:
    """-ln p of a coefficient that is the same at every frequency.

    A reading that follows another axis does so at all frequencies alike. Two axes that share a line, a temperature or a
    shock agree at some frequencies only, and the axis that is followed does not follow with one coefficient either.
    Bands hold equal information; in each the coefficient is estimated by itself.
    """
    fit = state.best
    _, white, _ = run(state.series.beside(column), fit.terms, fit.theta, innovations=True)
    white = np.nan_to_num(white)
    q, _ = np.linalg.qr(white[:, 1:-1])
    u = white[:, -1] - q @ (q.T @ white[:, -1])
    w = white[:, 0] - q @ (q.T @ white[:, 0])
    c = float(u @ w) / float(u @ u)
    U, W = rfft(u), rfft(w - c * u)
    A, B = np.abs(U) ** 2, (np.conj(U) * W).real
    edges = np.searchsorted(np.cumsum(A) / A.sum(), np.linspace(0.0, 1.0, BANDS + 1)[1:-1])
    edges = np.unique(np.concatenate([[0], edges + 1, [A.size]]))
    information = np.add.reduceat(A, edges[:-1])
    score = np.add.reduceat(B, edges[:-1])
    # The transform doubles every bin but the first: half of the bins' power is in the real part.
    noise = float(np.var(w - c * u)) * u.size / 2.0
    chi = float((score**2 / np.maximum(information, 1e-300)).sum()) / noise
    freedom = information.size - 1
    return float(-chi2.logsf(chi, freedom)) if freedom > 0 else 0.0


def _kept(state: State, fit: Fit, column: Array, channel: Array, window: int) -> float:
    """Share of a coefficient that the own noise of a channel leaves: the share of the information that is none of it.

    `column` is `channel` smoothed over `window` samples. Neighbouring readings differ by their noise alone. It is drawn
    anew, smoothed and whitened as the channel is. The column enters whole, so its noise lowers the coefficient."""
    random = np.random.default_rng(1)
    noise = math.sqrt(0.5 * float(np.var(np.diff(channel)))) * random.standard_normal((NOISES, column.size))
    columns = np.vstack([column, *(smoothed(row, window) for row in noise)])
    known = 1 + len(state.regressors) + 1
    G = run(state.series.beside(columns), fit.terms, fit.theta)[0][0].G
    cross = G[1:known, known]
    information = G[known, known] - cross @ np.linalg.pinv(G[1:known, 1:known], rcond=1e-12, hermitian=True) @ cross
    return float(np.clip(1.0 - np.diag(G)[known + 1 :].mean() / max(information, 1e-300), KEPT_LEAST, 1.0))


def _linear(
    state: State,
    cause: str,
    options: list[Regressor],
    key: str,
    ln_looks: float = 0.0,
    channel: Array | None = None,
) -> list[Look]:
    """The best of the columns. `channel`: what they are smoothed from."""
    usable = [one for one in options if np.ptp(one.values) > 0.0]
    if not usable:
        return []
    screen = state.scores(np.array([one.values for one in usable]))
    if screen.max() < SCREEN:
        return []
    # At the null's own drift, which the cause inflates, the scores of two smoothings hardly differ: the refits do.
    tried = [usable[k] for k in np.argsort(screen)[::-1][:3]]
    refitted = [(*state.with_columns(one.values), one) for one in tried]
    gain, fit, chosen = max(refitted, key=lambda one: one[0])
    worth = net(gain, 1, ln_looks)
    if worth < 1.0:
        return []
    if cause == "cross_axis":
        if net(gain, 1, ln_looks) > 3.0 and _inconstancy(state, chosen.values) > NET_LEAST:
            return []
    else:
        gain = min(gain, state.rich_gain(chosen.values))
        worth = net(gain, 1, ln_looks)
    unit = coefficient_unit(state.unit, chosen.unit)
    estimate: dict[str, Any] = {key: interval(float(fit.c[-1]), float(fit.sd[-1]), unit)}
    if cause == "cross_axis":
        estimate["other"] = chosen.name.removeprefix("axis_")

    def measure() -> dict[str, Any]:
        weight, means, sds = state.posterior(chosen.values)
        kept = 1.0
        if channel is not None:
            window = max(1, round(float(chosen.entry.get("window_s", 0.0)) / state.dt))
            kept = _kept(state, fit, chosen.values, channel, window)
        return {key: mixture(weight, means[:, 0] / kept, sds[:, 0] / kept, unit)}

    return [Look(cause, gain, worth, estimate, {"regressors": (*state.regressors, chosen)}, measure=measure)]


def least(state: State, record: Record, channel: str) -> dict[str, tuple[float, str]] | None:
    """The coefficient of a channel that this record would have shown; None where it has none that changes."""
    if channel not in record.channels:
        return None
    values = record.channels[channel]
    size = state.least(smoothed(values, round(10.0 * record.rate_hz)) - float(values.mean()))
    unit = coefficient_unit(state.unit, SIDE_CHANNELS[channel][1])
    return {"coefficient": (size, unit)} if math.isfinite(size) else None
