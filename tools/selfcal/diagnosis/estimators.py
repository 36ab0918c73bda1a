"""Other ways to identify an influence, besides the answer by prediction error: least squares, ARMAX, Box and Jenkins's
model, instruments, correlation, subspace.

Input u and output y pass the whitening filter of the fitted drift first, so that G(s) stays between them and the noise
of y is white. All work on means over a step, a third of the delay that they look for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy.linalg import lstsq, qr, svd
from scipy.optimize import least_squares
from scipy.signal import fftconvolve, lfilter

from selfcal.base.grid import Array
from selfcal.diagnosis.channel_looks import LONGEST_LAG
from selfcal.likelihood.fit import Fit, left
from selfcal.likelihood.state import State

#: Orders of ARX and of a state model at most, and taps of the weighting function.
ORDERS, TAPS = 4, (1, 2, 4, 8, 16, 32)
#: Orders of a model whose noise has poles or zeros of its own at most, and instruments on each side.
NOISE_ORDERS, INSTRUMENTS = 2, 6
#: Residual sum of squares, free numbers, and gain and delay, of an order.
Tried = tuple[float, int, tuple[float, float]]


@dataclass(frozen=True)
class OrderEstimate:
    """The `order` that a method chose with the `evidence` of each, nats below the best (half BIC). `values`: by order
    the static gain, and the delay of slow changes, steps."""

    order: int
    evidence: Mapping[int, float]
    values: Mapping[int, tuple[float, float]]

    @property
    def gain(self) -> float:
        return self.values[self.order][0]

    @property
    def delay(self) -> float:
        return self.values[self.order][1]


@dataclass(frozen=True)
class OtherMethod:
    """A method besides the answer: its `estimate`, and least and most [2] of gain and delay over records that the
    answer makes."""

    estimate: OrderEstimate
    least: Array
    most: Array

    @property
    def within(self) -> tuple[bool, bool]:
        """Whether the answer explains gain and delay: within twice the range, and half a step of the delay."""
        own = np.array([self.estimate.gain, self.estimate.delay])
        more = 0.5 * (self.most - self.least) + np.array([0.0, 0.5])
        gain, delay = (own >= self.least - more) & (own <= self.most + more)
        return bool(gain), bool(delay)


def arx(u: Array, y: Array) -> OrderEstimate:
    """A(q) y = B(q) u + e by least squares. White noise that enters at the output pulls the poles towards 0."""

    def tried(order: int) -> Tried:
        past = _delayed(y, range(1, order + 1))
        c, rss = _solved(np.hstack([-past, _delayed(u, range(order + 1))])[ORDERS:], y[ORDERS:])
        a, b = np.concatenate([[1.0], c[:order]]), c[order:]
        return rss, c.size, (_ratio(b.sum(), a.sum()), _delay(b) - _delay(a))

    return _likeliest({order: tried(order) for order in range(1, ORDERS + 1)}, y.size - ORDERS)


def armax(u: Array, y: Array) -> OrderEstimate:
    """A(q) y = B(q) u + C(q) e by prediction error."""
    return _prediction_error(u, y, noise_of_its_own=False)


def box_jenkins(u: Array, y: Array) -> OrderEstimate:
    """y = B(q) / F(q) u + C(q) / D(q) e by prediction error."""
    return _prediction_error(u, y, noise_of_its_own=True)


def _prediction_error(u: Array, y: Array, *, noise_of_its_own: bool) -> OrderEstimate:
    """The best coefficients of each order by the steps of Levenberg and Marquardt, from those of ARX on."""

    def tried(order: int) -> Tried:
        past = _delayed(y, range(1, order + 1))
        start, _ = _solved(np.hstack([-past, _delayed(u, range(order + 1))])[ORDERS:], y[ORDERS:])
        if not _stable(np.append(1.0, start[:order])):
            start[:order] = 0.0
        noise = np.zeros(2 * order) if noise_of_its_own else start[:order]

        def parts(x: Array) -> tuple[Array, Array, Array, Array]:
            """Polynomials B, F, C and D."""
            f, b, c, d = np.split(x, (order, 2 * order + 1, 3 * order + 1))
            one = np.ones(1)
            return b, np.append(one, f), np.append(one, c), np.append(one, d if noise_of_its_own else f)

        def errors(x: Array) -> Array:
            B, F, C, D = parts(x)
            if not (_stable(F) and _stable(C)):
                return np.full(y.size, 10.0 * float(np.abs(y).max()))
            return np.asarray(lfilter(D, C, y - lfilter(B, F, u)))

        def slopes(x: Array) -> Array:
            B, F, C, D = parts(x)
            known = lfilter(B, F, u)
            e = lfilter(D, C, y - known)
            by_f = lfilter(D, np.convolve(C, F), known)
            by_d = lfilter([1.0], C, y - known)
            columns = [by_f if noise_of_its_own else by_f + by_d, -lfilter(D, np.convolve(C, F), u)]
            columns += [-lfilter([1.0], C, e)] + ([by_d] if noise_of_its_own else [])
            firsts = (1, 0, 1, 1)
            each = [_delayed(column, range(first, order + 1)) for first, column in zip(firsts, columns, strict=False)]
            return np.hstack(each)

        found = least_squares(errors, np.concatenate([start, noise]), slopes, method="lm", max_nfev=20)
        B, F, _, _ = parts(found.x)
        return 2.0 * float(found.cost), found.x.size, (_ratio(B.sum(), F.sum()), _delay(B) - _delay(F))

    return _likeliest({order: tried(order) for order in range(1, NOISE_ORDERS + 1)}, y.size)


def instruments(u: Array, y: Array) -> OrderEstimate:
    """A(q) y = B(q) u by two-stage least squares. Readings of the input before and after those of the equation are the
    instruments: the noise of a reading is in none of them, and it biases nothing. Nor does noise at the output."""

    def tried(order: int) -> Tried:
        own = np.hstack([-_delayed(y, range(1, order + 1)), _delayed(u, range(order + 1))])
        ahead = _delayed(u[::-1], range(1, INSTRUMENTS + 1))[::-1]
        others = np.hstack([ahead, _delayed(u, range(order + 1, order + 1 + INSTRUMENTS))])
        inside = slice(2 * INSTRUMENTS, -INSTRUMENTS)
        told = others[inside] @ lstsq(others[inside], own[inside], check_finite=False)[0]
        c, rss = _solved(told, y[inside])
        a, b = np.append(1.0, c[:order]), c[order:]
        return rss, c.size, (_ratio(b.sum(), a.sum()), _delay(b) - _delay(a))

    return _likeliest({order: tried(order) for order in range(NOISE_ORDERS + 1)}, y.size)


def correlation(u: Array, y: Array) -> OrderEstimate:
    """The weighting function by the equations of Wiener and Hopf. Its order is the number of taps."""
    most = max(taps for taps in TAPS if 4 * taps <= y.size)

    def tried(taps: int) -> Tried:
        h, rss = _solved(_delayed(u, range(taps))[most:], y[most:])
        return rss, taps, (float(h.sum()), _delay(h))

    return _likeliest({taps: tried(taps) for taps in TAPS if taps <= most}, y.size - most)


def subspace(u: Array, y: Array) -> OrderEstimate:
    """A state model by PO-MOESP (Verhaegen, Automatica 30, 1994): past input and output are the instruments. Of several
    heights of the block matrices each order keeps the likeliest. No pole may be slower than a third of the record."""
    before = np.concatenate([[0.0], u[:-1]])
    slowest = math.exp(-1.0 / (LONGEST_LAG * y.size))

    def tried(seen: Array) -> Tried:
        """`seen` [rows, order]: the observability matrix."""
        order = seen.shape[1]
        free = 1 + 2 * order
        F = lstsq(seen[:-1], seen[1:], check_finite=False)[0]
        if order and np.abs(np.linalg.eigvals(F)).max() >= slowest:
            return math.inf, free, (0.0, 0.0)
        modes = np.empty((y.size, order))
        modes[0] = seen[0]
        for k in range(1, y.size):
            modes[k] = modes[k - 1] @ F
        driven = fftconvolve(before[:, None], modes, axes=0)[: y.size] if order else modes
        c, rss = _solved(np.hstack([u[:, None], driven, modes]), y)
        once = np.linalg.solve((np.eye(order) - F).T, seen[0])
        twice = np.linalg.solve((np.eye(order) - F).T, once)
        gain = float(c[0] + once @ c[1 : 1 + order])
        return rss, free, (gain, _ratio(float(twice @ c[1 : 1 + order]), gain))

    found: dict[int, Tried] = {}
    for rows in (5, 8, 12):
        count = y.size - 2 * rows + 1
        U, Y = (np.array([signal[k : k + count] for k in range(2 * rows)]) for signal in (u, y))
        (upper,) = qr(np.vstack([U[rows:], U[:rows], Y[:rows], Y[rows:]]).T, mode="r", check_finite=False)
        left, _, _ = svd(upper[rows : 3 * rows, 3 * rows :].T, check_finite=False)
        for order in range(ORDERS + 1):
            found[order] = min(found.get(order, (math.inf, 0, (0.0, 0.0))), tried(left[:, :order]))
    return _likeliest(found, y.size)


#: Methods by name.
METHODS: Mapping[str, Callable[[Array, Array], OrderEstimate]] = MappingProxyType(
    {
        "arx": arx,
        "armax": armax,
        "box-jenkins": box_jenkins,
        "instruments": instruments,
        "correlation": correlation,
        "subspace": subspace,
    }
)
#: Methods that take the input as it was read.
AS_READ = ("instruments",)


def methods_beside(
    state: State, fit: Fit, u: Array, read: Array, answers: Array, before: Array, steps: int
) -> dict[str, OtherMethod]:
    """What each method makes of an input [n], or of its readings `read` [n], and the record in means of `steps`
    samples, and what it would make of records that `answers` [draws, n] to that input, the likeliest first, and the
    fitted noise make. `before` [n]: what the input left from before the record; it is taken out."""
    rest = replace(state, y=state.y - before)
    white = left(rest.series, fit, np.vstack([u, read, answers]))
    count = white.shape[0] // steps
    y, quiet, raw, *due = white[: count * steps].reshape(count, steps, white.shape[1]).mean(axis=1).T
    noise = float(np.std(y - due[0]))
    random = np.random.default_rng(1)
    drawn = [output + noise * random.standard_normal(count) for output in due]
    found = {}
    for name, method in METHODS.items():
        given = raw if name in AS_READ else quiet
        own = method(given, y)
        # Of the order that the record took: another order is another estimate.
        each = [method(given, output).values for output in drawn]
        spread = np.array(
            [by_order[own.order] for by_order in each if own.order in by_order] or [(own.gain, own.delay)]
        )
        found[name] = OtherMethod(own, spread.min(axis=0), spread.max(axis=0))
    return found


def _likeliest(tried: Mapping[int, Tried], n: int) -> OrderEstimate:
    """The order of the least half BIC."""
    score = {
        order: -0.5 * n * math.log(max(rss, 1e-300)) - 0.5 * free * math.log(n)
        for order, (rss, free, _) in tried.items()
        if math.isfinite(rss)
    }
    best = max(score, key=lambda order: score[order])
    evidence = {order: value - score[best] for order, value in score.items()}
    return OrderEstimate(best, evidence, {order: tried[order][2] for order in score})


def _delayed(values: Array, steps: Iterable[int]) -> Array:
    """Values [n] late by each of `steps` [k]: [n, k], 0 before their begin."""
    late = [np.concatenate([np.zeros(k), values[: values.size - k]]) for k in steps]
    return np.array(late).reshape(len(late), values.size).T


def _solved(columns: Array, y: Array) -> tuple[Array, float]:
    """Least squares: coefficients [k] and the residual sum of squares."""
    c = np.asarray(lstsq(columns, y, check_finite=False)[0])
    return c, float(np.sum((y - columns @ c) ** 2))


def _stable(polynomial: Array) -> bool:
    return bool(np.abs(np.roots(polynomial)).max(initial=0.0) < 1.0)


def _delay(h: Array) -> float:
    """Mean delay of a weighting function [k], steps."""
    return _ratio(float(np.arange(h.size) @ h), float(h.sum()))


def _ratio(a: float, b: float) -> float:
    return a / b if b else 0.0
