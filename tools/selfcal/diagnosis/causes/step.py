"""A step of the bias: the innovations' transient after a jump, at every time of the record."""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import fftconvolve

from selfcal.diagnosis.fit import Series, run
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import SCREEN, Look, Regressor, State, interval, net
from selfcal.diagnosis.statemodel import Array


def ln_places(n: int, response: Array, gain: float) -> float:
    """ln of the independent places among `n`.

    Scores of neighbouring places are as alike as the whitened responses are: a step's decays by the filter's gain a
    sample. The largest of such a process (Leadbetter, Lindgren & Rootzen 1983, theorem 12.2.9) is that of
    n (1 - r) 2 gain independent ones, r the correlation of neighbours.
    """
    r = float(response[1:] @ response[:-1]) / float(response @ response)
    return math.log(max(1.0, n * (1.0 - r))) + math.log(max(1.0, 2.0 * gain))


def scan(state: State, w: Array, response: Array) -> tuple[Array, Array]:
    """Score B [n] and information A [n] of a disturbance that begins at each sample, `response` [m] its whitened form.

    The whitened columns of the model are projected out of both."""
    n = w.size
    m = min(response.size, n)
    g = response[:m]

    def against(x: Array) -> Array:
        found: Array = fftconvolve(x, g[::-1], mode="full")[m - 1 : m - 1 + n]
        return found

    B = against(w)
    power = np.cumsum(g * g)
    A = power[np.minimum(np.arange(n, 0, -1), m) - 1]
    return B, A


def looks(state: State, record: Record) -> list[Look]:
    """The best place, refitted exactly."""
    fit = state.best
    n = state.y.size
    if n < 50:
        return []
    w = np.nan_to_num(state.whitened)
    _, white, _ = run(state.series, fit.terms, fit.theta, innovations=True)
    response = response_of(state)
    B, A = scan(state, w, response)
    Z = np.nan_to_num(white[:, 1:]) / fit.sigma
    q = np.linalg.qr(Z)[0]
    for k in range(q.shape[1]):
        cross, _ = scan(state, np.ascontiguousarray(q[:, k]), response)
        A = A - cross**2
    first, last = np.flatnonzero(np.isfinite(state.y))[[0, -1]]
    gain = np.where(0.05 * float((response**2).sum()) < A, 0.5 * B**2 / np.maximum(A, 1e-12), 0.0)
    gain[: first + 4] = gain[last - 2 :] = 0.0
    if gain.max() < SCREEN + 2.0:
        return []
    best: tuple[float, int] | None = None
    for place in _peaks(gain, 3, max(3, int(2.0 / state.dt))):
        exact, _ = state.with_columns(_column(n, place))
        if best is None or exact > best[0]:
            best = (exact, place)
    assert best is not None
    place = _refined(best[1], gain)
    gain_exact, fit_with = state.with_columns(_column(n, place))
    gain_exact = min(gain_exact, state.rich_gain(_column(n, place)))
    worth = net(gain_exact, 1, ln_places(n, response, gain_exact))
    if worth < 1.0:
        return []
    time = float(record.time_s[place])
    spread = _place_spread(gain, place, state.dt)
    column = Regressor(f"step_{time:.6g}s", "step", _column(n, place), "1", {"kind": "step", "time_s": time})
    return [
        Look(
            "step",
            gain_exact,
            worth,
            {
                # between the last reading before it and the first one with it
                "time_s": interval(time - 0.5 * state.dt, spread, "s"),
                "amplitude": interval(float(fit_with.c[-1]), float(fit_with.sd[-1]), state.unit),
            },
            {"regressors": (*state.regressors, column)},
            when=(time, time),
        )
    ]


def _column(n: int, place: int) -> Array:
    values = np.zeros(n)
    values[place:] = 1.0
    return values


def response_of(state: State) -> Array:
    """Whitened innovations of a unit step once the filter has settled, over sigma."""
    n = state.y.size
    clean = Series(np.zeros(2 * n), state.dt, np.ones(2 * n), np.vstack([_column(2 * n, n)]))
    fit = state.best
    _, white, _ = run(clean, fit.terms, fit.theta, innovations=True)
    return white[n:, 1] / fit.sigma


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


def _refined(place: int, gain: Array) -> int:
    """The likeliest of the nearby places of the scan."""
    low = max(0, place - 3)
    return low + int(np.argmax(gain[low : place + 4]))


def _place_spread(gain: Array, place: int, dt: float) -> float:
    """Standard deviation of the place under exp(gain), s."""
    reach = max(10, int(60.0 / dt))
    low, high = max(0, place - reach), min(gain.size, place + reach)
    part = gain[low:high]
    weight = np.exp(part - part.max())
    where = np.arange(low, high)
    mean = float((weight @ where) / weight.sum())
    return math.sqrt(float(weight @ (where - mean) ** 2 / weight.sum()) + 1.0 / 12.0) * dt
