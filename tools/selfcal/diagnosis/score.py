"""What a finding gains on held-out time: the first half trains, the second is predicted from earlier samples only.

Parameters and coefficients are those of the first half; nothing that is scored was seen by them. A line's frequency is
looked for anew in the first half. The place of a step or of a change is the whole record's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.fit import Fit, Series, best, fit, moved
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import Look, State
from selfcal.diagnosis.statemodel import Array, matrices

#: How far ahead the bias is predicted, s.
HORIZONS_S = (1.0, 10.0, 60.0, 300.0)
#: Pieces of the held-out time whose scatter gives the uncertainty.
PIECES = 24
#: Predictions of the bias at most.
PREDICTIONS = 300


@dataclass(frozen=True)
class Trained:
    """A state whose model was fitted on its first samples alone: innovations' ln density of every later one, [n], and
    residual innovations [n]."""

    ln_density: Array
    residual: Array
    fit: Fit
    series: Series


def gain(
    look: Look, before: State, after: State, record: Record, partner: State | None = None
) -> tuple[dict[str, Any] | None, str | None]:
    """The contract's `gain` of one finding, or None with the reason. `partner`: the axis that shares the cause."""
    cause = CAUSES[look.cause]
    if cause.no_gain:
        return None, cause.no_gain
    n = before.y.size
    split = n // 2
    if cause.together is not None and partner is not None:
        return _joint(cause.together, look, (before, partner), split)
    if before is after:
        return None, "the readings are left out before and after: the model of the noise is the same"
    if cause.onset and look.when is not None:
        place = round(look.when[0] * record.rate_hz)
        if place > split - max(20, n // 20):
            split = place + max(20, (n - place) // 4)
        if n - split < max(60, n // 20):
            return None, "too little of the record is left after its detection"
    if cause.trained is not None:
        after = cause.trained(look, before, after, record, split)
    old, new = _trained(before, split), _trained(after, split)
    both = np.isfinite(old.ln_density) & np.isfinite(new.ln_density)
    both[:split] = False
    if both.sum() < 30:
        return None, "too few samples are left to score"
    parts = [np.array([part.mean() for part in np.array_split(one.ln_density[both], PIECES)]) for one in (old, new)]
    difference = parts[1] - parts[0]
    sd = float(difference.std(ddof=1)) / math.sqrt(PIECES)
    return {
        "log_score_per_sample": {
            "before": float(old.ln_density[both].mean()),
            "after": float(new.ln_density[both].mean()),
            "sd": sd,
            "samples": int(both.sum()),
        },
        "bias_rmse": {"unit": before.unit, "horizon_s": _errors(old, new, split)},
    }, None


def _joint(
    together: Callable[[Array, Array, float, int, Mapping[str, Any]], tuple[float, float]],
    look: Look,
    pair: tuple[State, State],
    split: int,
) -> tuple[dict[str, Any] | None, str | None]:
    """After: the joint log score of two axes less the other one's own, which is the first one's given the other. The
    bias is predicted alike."""
    one, two = (_trained(state, split) for state in pair)
    both = np.isfinite(one.ln_density) & np.isfinite(two.ln_density)
    both[:split] = False
    if both.sum() < 30:
        return None, "too few samples are left to score"
    more, sd = together(one.residual, two.residual, one.series.dt, split, look.estimate)
    before = float(one.ln_density[both].mean())
    return {
        "log_score_per_sample": {"before": before, "after": before + more, "sd": sd, "samples": int(both.sum())},
        "bias_rmse": {"unit": pair[0].unit, "horizon_s": {}},
    }, None


def _trained(state: State, split: int) -> Trained:
    series = state.series
    first = Series(series.y[:split], series.dt, series.r[:split], np.ascontiguousarray(series.columns[:, :split]))
    chosen = best([fit(first, terms, _start(state, terms)) for terms in state.bases()])
    # The transitions of 1/f noise depend on the length: keep those of the half.
    _, white, s = _pass(series, chosen)
    residual = (white[:, 0] - white[:, 1:] @ chosen.c) / chosen.sigma
    ln_density = -0.5 * (residual**2 + np.log(2.0 * math.pi * chosen.sigma**2 * s))
    return Trained(np.where(np.isfinite(series.y), ln_density, np.nan), residual, chosen, series)


def _start(state: State, terms: Any) -> Array:
    return moved(next((one for one in state.fits if one.terms == terms), state.best), terms)


def _pass(series: Series, chosen: Fit, marks: list[int] | None = None) -> tuple[list[Any], Array, Array]:
    from selfcal import _likelihood
    from selfcal.diagnosis.fit import Sums

    m = matrices(chosen.terms, chosen.theta, chosen.dt, chosen.duration_s)
    at = marks or [series.y.size]
    G, D, n, x, white, s = _likelihood.run(
        series.y, series.columns, series.r, m.F, m.Q, m.h, m.P0, m.R, m.driver, at, marks is None
    )
    return [Sums(G[k], float(D[k]), float(n[k]), x[k]) for k in range(len(at))], white, s


def _errors(old: Trained, new: Trained, split: int) -> dict[str, dict[str, float]]:
    """Root mean square of predicted minus read bias at each horizon; the reading is a mean of one second about it."""
    series = old.series
    rate = 1.0 / series.dt
    window = max(1, round(rate))
    n = series.y.size
    found: dict[str, dict[str, float]] = {}
    for horizon in HORIZONS_S:
        ahead = max(1, round(horizon * rate))
        last = n - ahead - window
        if last - split < 30:
            continue
        marks = np.unique(np.linspace(split, last, PREDICTIONS).astype(int))
        read = np.array([_mean(new.series.y[at + ahead - 1 : at + ahead - 1 + window]) for at in marks])
        errors = [_predicted(one, marks, ahead, window) - read for one in (old, new)]
        good = np.isfinite(errors[0]) & np.isfinite(errors[1])
        if good.sum() < 10:
            continue
        square = [error[good] ** 2 for error in errors]
        rms = [math.sqrt(float(one.mean())) for one in square]
        pieces = np.array([[part.mean() for part in np.array_split(one, 8)] for one in square])
        spread = float(np.std(pieces[1] - pieces[0], ddof=1)) / math.sqrt(8) / max(rms[0] + rms[1], 1e-300)
        found[f"{horizon:g}"] = {"before": rms[0], "after": rms[1], "sd": spread}
    return found


def _mean(values: Array) -> float:
    good = values[np.isfinite(values)]
    return float(good.mean()) if good.size else math.nan


def _predicted(one: Trained, marks: Array, ahead: int, window: int) -> Array:
    sums, _, _ = _pass(one.series, one.fit, [int(at) for at in marks])
    m = matrices(one.fit.terms, one.fit.theta, one.fit.dt, one.fit.duration_s)
    forward = m.h @ np.linalg.matrix_power(m.F, ahead - 1)
    found = []
    for at, part in zip(marks, sums, strict=True):
        state = part.x[0] - one.fit.c @ part.x[1:]
        column = one.series.columns[:, at + ahead - 1 : at + ahead - 1 + window].mean(axis=1)
        found.append(float(forward @ state + one.fit.c @ column))
    return np.array(found)


def inflation(before: State, after: State) -> Mapping[str, float]:
    """Factors by which plain white noise and random walk are off for want of a cause: fitted without it over with."""
    if before is after:
        return {"N": 1.0, "K": 1.0}
    plain = [next(one for one in state.fits if one.terms.walk) for state in (before, after)]
    N = [one.sigma * _low_gain(one) for one in plain]
    K = [one.K * math.sqrt(one.dt) for one in plain]
    return {"N": N[0] / N[1], "K": K[0] / K[1] if K[1] > 1e-4 * N[1] else math.inf}


def _low_gain(one: Fit) -> float:
    """Amplitude of the white noise at 0 Hz over its own standard deviation."""
    if not one.terms.color:
        return 1.0
    m = math.tanh(one.value("color"))
    return (1.0 + m) / math.sqrt(1.0 + m * m) if one.terms.color == "ma" else math.sqrt((1.0 + m) / (1.0 - m))
