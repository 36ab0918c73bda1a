"""A level that changes at one place or at two: every place of an edge in a pass of the filter, the other edge held."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from selfcal.base.grid import Array, Mask, Rows
from selfcal.likelihood.columns import LN_SLOW, Shape
from selfcal.likelihood.fit import Fit, Series, ln_det, shifts
from selfcal.likelihood.state import FittedColumn, State, ln_looks, mixture, net, normal_entry

#: Least share of its information that a step keeps with the level before it; and the least share of a mid-record
#: step's information at the last place that is looked at.
STEP_SHARE_LEAST = 0.05
#: Turns of a drift in the record above which it gives way to a step: its size is fitted anew with the step, and noise
#: alone gains as two coefficients do. Counted as one, 17 of 683 clean records at 1 Hz showed 5 nats instead of 4.6.
FORGETS = 5.0
#: Least samples between two edges: a shorter pulse is outliers'. Samples at the ends where no edge of a pulse lies.
EDGES_APART, EDGE = 10, 4
#: Fall of ln likelihood between two places that makes them two steps. Least likelihood of a place of the posterior,
#: over the best place, and most places: beyond, the least likely are left out.
VALLEY, WEIGHT_LEAST, MOST_PLACES = 8.0, 1e-7, 1600
#: Keys of the model file's entry, by the number of edges.
KEYS = {1: ("time_s",), 2: ("start_s", "end_s")}


@dataclass(frozen=True)
class Scan:
    """An edge at each sample: its score `B` [n] and information `A` [n], 0 where no edge is sought. `bend` [n]:
    1 - correlation of the score at each place with the next place's. `turns`: times that the drift forgets. `none`: ln
    likelihood without a change, the columns' coefficients integrated out, less a constant."""

    B: Array
    A: Array
    bend: Array
    turns: float
    none: float

    @property
    def gain(self) -> Array:
        """Gain of ln likelihood [n] at the drift of the scan."""
        return np.where(self.A > 0.0, 0.5 * self.B**2 / np.where(self.A > 0.0, self.A, 1.0), 0.0)

    def free(self, edges: int = 1) -> int:
        """Number of coefficients whose gain noise alone has."""
        return 2 if edges == 1 and self.turns > FORGETS else 1

    def price(self, gain: float, edges: int = 1) -> float:
        """ln of the number of independent looks: each edge costs as much as a step's."""
        return edges * ln_looks(self.bend, gain) + (LN_SLOW if edges > 1 else 0.0)

    def worth(self, gain: float) -> float:
        """`gain` of the best step net of the search."""
        return net(gain, self.free(), self.price(gain))

    def peaks(self, count: int, apart: int) -> list[int]:
        """The best places, some way apart."""
        return peaks(self.gain, count, apart)


def peaks(gain: Array, count: int, apart: int) -> list[int]:
    """Places of the largest gains [n] above 0, each more than `apart` samples from a larger gain."""
    left, places = gain.copy(), list[int]()
    while len(places) < count and left.max() > 0.0:
        places.append(int(np.argmax(left)))
        left[max(0, places[-1] - apart) : places[-1] + apart + 1] = 0.0
    return places


def scan(series: Series, fit: Fit, held: Array | None = None) -> Scan:
    """A step that begins at each sample, with the columns of the model refitted; less a step `held` [n]."""
    found = shifts(series if held is None else series.beside(held), fit.terms, fit.theta)
    G, p = found.sums.G, 1 + len(series.columns)
    c, inverse, rss = found.sums.of(range(p)).coefficients()
    cross = found.B[:, 1:p]
    B = found.B[:, 0] - cross @ c
    A = found.A - ((cross @ inverse) * cross).sum(axis=1)
    present = np.flatnonzero(np.isfinite(series.y))
    if held is None:
        known = found.A / float(np.median(found.A[present]))
        enough = np.flatnonzero(known >= STEP_SHARE_LEAST)
        A[: present[0] + 4] = A[min(present[-1] - 2, enough[-1] + 1) :] = 0.0
        A = np.where(A < STEP_SHARE_LEAST * found.A, 0.0, A)
    else:
        own, size = inverse @ G[1:p, p], G[p, p] - G[1:p, p] @ inverse @ G[1:p, p]
        B -= G[p, 0] - G[1:p, p] @ c
        A += size - 2.0 * (found.B[:, p] - cross @ own)
        A = np.where(1e-6 * size > A, 0.0, A)
    turns = 0.5 * present.size * float(np.median(found.impulse[present] / found.A[present]))
    none = -0.5 * (rss / fit.sigma**2 + found.sums.D - ln_det(inverse))
    return Scan(B / fit.sigma**2, A / fit.sigma**2, _bend(A, found.impulse), turns, none)


def white_of(state: State) -> Array:
    """White noise [n] of a record as all of it shows it; 0 where it is missing.

    The score of a step sums the record over its covariance from a place on: its steps are that times the noise's."""
    score = scan(state.series, state.best).B
    return np.asarray(state.best.sigma**2 * state.r * (score - np.append(score[1:], 0.0)))


def steady(state: State) -> Array:
    """A record [n] less its level and columns, with as little white noise throughout as where that is least.

    What is left of a drift has less power than the drift: with the noise no more than such a record, at any
    frequency."""
    quieter = np.sqrt(state.r.min() / state.r)
    return state.rest if (quieter == 1.0).all() else state.rest - (1.0 - quieter) * white_of(state)


def _bend(A: Array, impulse: Array) -> Array:
    """`Scan.bend`. Two steps one sample apart differ by an impulse. Near the ends of a record, where the level is known
    from few samples, each place is a look of its own."""
    safe = np.where(A > 0.0, A, 1.0)
    both = (A[1:] > 0.0) & (A[:-1] > 0.0)
    turn = np.append(np.where(both, np.diff(A), 0.0), 0.0) / safe
    return np.where(A > 0.0, np.clip(0.5 * impulse / safe - 0.125 * turn**2, 0.0, 1.0), 0.0)


def raised(n: int, begin: int, end: int | None = None) -> Array:
    """[n]: 1 from a place on, or until another."""
    values = np.zeros(n)
    values[begin:end] = 1.0
    return values


def edge(state: State, fit: Fit, places: tuple[int, ...], k: int) -> Scan:
    """The edge `k` of a change at each sample, the other edge at its place."""
    if len(places) == 1:
        return scan(state.series, fit)
    n, other = state.y.size, places[1 - k]
    found, where = scan(state.series, fit, raised(n, other)), np.arange(n)
    out = (where < other + EDGES_APART) | (where > n - EDGE) if k else (where > other - EDGES_APART) | (where < EDGE)
    return replace(found, B=-found.B if k else found.B, A=np.where(out, 0.0, found.A))


def shape(state: State, cause: str, places: tuple[int, ...], steps: Scan) -> Shape:
    """A change of the level at some places, in a gap in its middle. `steps`: the scan that has a search's price."""
    first, last = between_readings(state.y, np.array(places))
    at = (first + last) // 2  # the edge may be at any place of a gap
    times = (at * state.dt).tolist()
    stated = known(state, at, last - first + 1)
    values = raised(state.y.size, *at)
    entry = {"kind": cause, **dict(zip(KEYS[len(times)], times, strict=True))}
    return Shape(
        cause,
        values[None],
        (FittedColumn(name(cause, times), cause, values, "1", entry),),
        (("amplitude", state.unit),),
        partial(steps.price, edges=len(places)),
        steps.free(len(places)),
        sharper=lambda fit: shape(state, cause, sharper(state, fit, places), steps),
        where=lambda fit: stated,
        when=(times[0], times[-1]),
        measure=partial(posterior, tuple(int(k) for k in at)),
    )


def between_readings(y: Array, places: Rows) -> tuple[Rows, Rows]:
    """First and last place of an edge between the same two readings of y [n] as each place."""
    there = np.flatnonzero(np.isfinite(y))
    after = np.searchsorted(there, places)
    first = np.where(after > 0, there[np.maximum(after - 1, 0)] + 1, places)
    return first, np.where(after < there.size, there[np.minimum(after, there.size - 1)], places)


def known(state: State, places: Sequence[int] | Rows, samples: Sequence[int] | Rows | Array) -> dict[str, Any]:
    """Time of a change: each edge lies between the last reading before it and the first after it, `samples` apart.
    Means begin with their first reading."""
    width = np.asarray(samples) * state.dt / math.sqrt(12.0)
    found = {"time_s": normal_entry(float(places[0] - 0.5 / state.block) * state.dt, float(width[0]), "s")}
    if len(places) > 1:
        found["duration_s"] = normal_entry(float(places[1] - places[0]) * state.dt, math.hypot(*width), "s")
    return found


def name(cause: str, times: list[float]) -> str:
    """Name of the column in a model file."""
    return f"{cause}_{'_'.join(f'{time:.6g}' for time in times)}s"


def sharper(state: State, fit: Fit, places: tuple[int, ...]) -> tuple[int, ...]:
    """The best places at a fit, each in turn at its best sample: the drift fitted with a change is smaller than the
    null's, which has swallowed a part of the change."""
    now = list(places)
    for k in (1, 0, 1, 0) if len(places) > 1 else (0,):
        now[k] = int(np.argmax(edge(state, fit, (*now,), k).gain))
    return (*now,) if now == sorted(now) else places


def posterior(places: tuple[int, ...], state: State) -> dict[str, Any]:
    """Times and amplitude of a change over the places about its own, every near drift and the spread of its parameters.

    Two edges hardly know each other: each is taken with the other held. The amplitude's shift by both is summed."""
    column = raised(state.y.size, *places)
    fit = state.with_columns(column)[1]
    # A gap is a single place, the first reading after it, and as likely as it is long.
    first, last = between_readings(state.y, np.arange(state.y.size))
    wide, there = last - first + 1.0, np.isfinite(state.y)
    places = (*last[[*places]].tolist(),)
    m, rows = len(places), []
    for drift, theta, ln_share in state.possible(column, rich=False):
        at = replace(drift, theta=theta, sigma=fit.sigma)
        scans = [edge(state, at, places, k) for k in range(m)]
        if not all(found.A[place] > 0.0 for found, place in zip(scans, places, strict=True)):
            continue  # this drift forgets too fast to know
        likely = [_likely(found, place, there, m) for found, place in zip(scans, places, strict=True)]
        each = [axis.ravel() for axis in np.meshgrid(*likely, indexing="ij")]
        gain, size, ln_information = np.zeros((3, each[0].size))
        for found, where in zip(scans, each, strict=True):
            gain += found.gain[where] + np.log(wide[where])
            size += found.B[where] / found.A[where]
            ln_information += np.log(found.A[where]) / m
        middle, place = scans[-1], places[-1]
        gain -= (m - 1) * middle.gain[place]
        size -= (m - 1) * middle.B[place] / middle.A[place]
        ln_weight = ln_share + middle.none + gain - 0.5 * ln_information
        rows.append(np.vstack([ln_weight, size, -0.5 * ln_information, *each]))
    all_of = np.hstack(rows) if rows else np.array([[0.0, fit.c[-1], math.log(fit.sd[-1]), *places]]).T
    weight, at_place = np.exp(all_of[0] - all_of[0].max()), all_of[3:].astype(np.int64)
    width = wide[at_place]
    times = (at_place - 0.5 * (width - 1.0 + 1.0 / state.block)) * state.dt
    sds = width * state.dt / math.sqrt(12.0)
    estimate = {"time_s": mixture(weight, times[0], sds[0], "s")}
    if m > 1:
        estimate["duration_s"] = mixture(weight, times[1] - times[0], np.hypot(*sds), "s")
    return {**estimate, "amplitude": mixture(weight, all_of[1], np.exp(all_of[2]), state.unit)}


def _likely(found: Scan, place: int, there: Mask, edges: int) -> Array:
    """The likeliest places about `place`, itself among them, of those that are `there` [n]. Those behind a valley are
    another step's."""
    gain = np.where(found.A > 0.0, found.gain, -math.inf)
    deep = np.flatnonzero(gain < gain[place] - (VALLEY if edges == 1 else math.inf))
    low, high = (deep[deep < place][-1:] + 1).max(initial=0), deep[deep > place][:1].min(initial=gain.size)
    held = low + np.flatnonzero((gain[low:high] > gain[low:high].max() + math.log(WEIGHT_LEAST)) & there[low:high])
    best = held[np.argsort(-gain[held])[: round(MOST_PLACES ** (1.0 / edges))]]
    return np.union1d(best, [place])
