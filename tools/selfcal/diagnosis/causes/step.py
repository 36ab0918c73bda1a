"""A step of the bias: the innovations' transient after a jump, at every time of the record."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.signal import fftconvolve

from selfcal.diagnosis.fit import Fit, Series, nodes, run
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import NET_LEAST, SCREEN, Look, Regressor, State, ln_looks, mixture, net
from selfcal.diagnosis.statemodel import Array, Mask

#: A place is looked at where the record knows a step by this share of the information of one in its middle, at least.
INFORMATION_LEAST = 0.05
#: A drift that forgets more often than this in the record gives way to a step: its size is fitted anew beside it, and
#: noise alone gains as two coefficients do. Of 683 clean records at 1 Hz 17 instead of 4.6 showed 5 nats with one.
FORGETS = 5.0
#: Places with less than e^-8 of the best one's likelihood between them are two steps'.
VALLEY = 8.0
#: Places of the posterior that hold less than this are left out.
WEIGHT_LEAST = 1e-7


def scan(series: Series, fit: Fit) -> tuple[Array, Array, Array]:
    """Score B [n] and information A [n] of a step that begins at each sample, and its whitened `response` [n].

    The whitened columns of the model are projected out of both. A is 0 where no step is looked for."""
    _, white, _ = run(series, fit.terms, fit.theta, innovations=True)
    white = np.nan_to_num(white) / fit.sigma
    response = response_of(series, fit)
    n = response.size

    def against(x: Array) -> Array:
        found: Array = fftconvolve(x, response[::-1], mode="full")[n - 1 :]
        return found

    q = np.linalg.qr(white[:, 1:])[0]
    A = np.cumsum(response**2)[::-1].copy()
    least = INFORMATION_LEAST * float(A[0])
    for column in q.T:
        A -= against(np.ascontiguousarray(column)) ** 2
    # In a gap every place is that of the first reading behind it.
    present = np.flatnonzero(np.isfinite(series.y))
    behind = present[np.minimum(np.searchsorted(present, np.arange(n)), present.size - 1)]
    B, A = against(white[:, 0] - q @ (q.T @ white[:, 0]))[behind], A[behind]
    first, last = present[[0, -1]]
    A[: first + 4] = A[last - 2 :] = 0.0
    A[least > A] = 0.0
    return B, A, response


def response_of(series: Series, fit: Fit) -> Array:
    """Whitened innovations of a unit step once the filter has settled, over sigma."""
    n = series.y.size
    clean = Series(np.zeros(2 * n), series.dt, np.ones(2 * n), np.vstack([_column(2 * n, n)]))
    _, white, _ = run(clean, fit.terms, fit.theta, innovations=True)
    return white[n:, 1] / fit.sigma


def worth(gain: float, response: Array, A: Array) -> float:
    """`gain` of the best place net of the search."""
    bend = _bend(response, A)
    inner = float(response[1:] @ response[:-1]) / float(response @ response)
    return net(gain, 2 if response.size * (1.0 - inner) > FORGETS else 1, ln_looks(bend[A > 0.0], gain))


def _bend(response: Array, A: Array) -> Array:
    """1 - correlation of the score at each place with the next one's, 0 where no step is looked for.

    Two steps one sample apart differ by an impulse. Near the ends of a record, where the level is known from few
    samples, each place says something new."""
    change = np.diff(response)
    impulse = float(response[0] ** 2 + change @ change)
    safe = np.where(A > 0.0, A, 1.0)
    both = (A[1:] > 0.0) & (A[:-1] > 0.0)
    turn = np.append(np.where(both, np.diff(A), 0.0), 0.0) / safe
    return np.where(A > 0.0, np.clip(0.5 * impulse / safe - 0.125 * turn**2, 0.0, 1.0), 0.0)


def looks(state: State, record: Record) -> list[Look]:
    """The best place, refitted exactly."""
    n = state.y.size
    if n < 50:
        return []
    B, A, response = scan(state.series, state.best)
    gain = _gain(B, A)
    if gain.max() < SCREEN + 2.0:
        return []
    tried = {place: state.with_columns(_column(n, place)) for place in _peaks(gain, 3, max(3, int(2.0 / state.dt)))}
    place = max(tried, key=lambda one: tried[one][0])
    # The null's drift has swallowed a part of the step: the place is sharper with the drift that is left beside it.
    beside = tried[place][1]
    again = int(np.argmax(_gain(*scan(state.series, replace(beside, c=beside.c[:-1]))[:2])))
    if again not in tried:
        tried[again] = state.with_columns(_column(n, again))
    place = max(tried, key=lambda one: tried[one][0])
    exact, chosen = tried[place]
    exact = min(exact, state.rich_gain(_column(n, place)))
    value = worth(exact, response, A)
    if value < 1.0:
        return []
    time = float(record.time_s[place])
    column = Regressor(f"step_{time:.6g}s", "step", _column(n, place), "1", {"kind": "step", "time_s": time})
    if value < NET_LEAST:
        estimate: dict[str, Any] = {
            "time_s": mixture(np.ones(1), np.array([time - 0.5 * state.dt]), state.dt / math.sqrt(12.0), "s"),
            "amplitude": mixture(np.ones(1), chosen.c[-1:], chosen.sd[-1:], state.unit),
        }
    else:
        estimate = posterior(state, record.time_s, place)
    return [
        Look("step", exact, value, estimate, {"regressors": (*state.regressors, column)}, when=(time, time)),
    ]


def posterior(state: State, time_s: Array, place: int) -> dict[str, Any]:
    """Time and amplitude of a step over the places about `place`, every near drift and the spread of its parameters.

    At each node of the drift's parameters the scan gives likelihood, amplitude and its sd of a step at each place.
    Places behind a valley are another step's."""
    series = state.series
    ln_weight, amplitude, sd, where = [], [], [], []
    beside = state.with_columns(_column(series.y.size, place))[1]
    sigma = beside.sigma
    elsewhere = _elsewhere(_gain(*scan(series, replace(beside, c=beside.c[:-1]))[:2]), place)
    for drift in state.near():
        started = state.fitted_with(drift, _column(series.y.size, place))
        for theta, ln_volume in nodes(series.beside(_column(series.y.size, place)), started):
            at = replace(started, theta=theta, sigma=sigma)
            B, A, _ = scan(series, at)
            A[elsewhere] = 0.0
            sums = run(series, drift, theta)[0][0]
            ln_none = -0.5 * (sums.coefficients()[2] / sigma**2 + sums.D)
            good = np.flatnonzero(A > 0.0)
            if not good.size:
                continue
            value = ln_volume + ln_none + _gain(B, A)[good] - 0.5 * np.log(A[good])
            held = value > value.max() + math.log(WEIGHT_LEAST)
            good = good[held]
            ln_weight.append(value[held])
            amplitude.append(B[good] / A[good])
            sd.append(1.0 / np.sqrt(A[good]))
            where.append(good)
    ln_all = np.concatenate(ln_weight)
    weight = np.exp(ln_all - ln_all.max())
    # A step lies between the last reading before it and the first one with it.
    times = time_s[np.concatenate(where)] - 0.5 * state.dt
    return {
        "time_s": mixture(weight, times, state.dt / math.sqrt(12.0), "s"),
        "amplitude": mixture(weight, np.concatenate(amplitude), np.concatenate(sd), state.unit),
    }


def _elsewhere(gain: Array, place: int) -> Mask:
    """Places [n] that a valley of `VALLEY` nats parts from `place`."""
    deep = np.flatnonzero(gain < gain[place] - VALLEY)
    ahead, behind = deep[deep > place], deep[deep < place]
    where = np.arange(gain.size)
    return (where >= (ahead[0] if ahead.size else gain.size)) | (where <= (behind[-1] if behind.size else -1))


def _gain(B: Array, A: Array) -> Array:
    return np.where(A > 0.0, 0.5 * B**2 / np.where(A > 0.0, A, 1.0), 0.0)


def _column(n: int, place: int) -> Array:
    values = np.zeros(n)
    values[place:] = 1.0
    return values


def _peaks(gain: Array, count: int, apart: int) -> list[int]:
    left = gain.copy()
    found: list[int] = []
    for _ in range(count):
        at = int(np.argmax(left))
        if left[at] <= 0.0:
            break
        found.append(at)
        left[max(0, at - apart) : at + apart + 1] = 0.0
    return found
