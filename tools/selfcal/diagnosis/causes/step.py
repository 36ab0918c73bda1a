"""A step of the bias: the innovations' transient after a jump, at every time of the record."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from selfcal.diagnosis.cause import Cause, Grouping, Key, Scored, Simulated, Written, shown, sized
from selfcal.diagnosis.model_tree import digits
from selfcal.diagnosis.record import Record
from selfcal.likelihood.fit import Fit, Series, ln_det, shifts
from selfcal.likelihood.state import SCREEN, Look, Regressor, State, gain_for, ln_looks, mixture, net, sizes
from selfcal.likelihood.statemodel import Array, Mask

#: A place is looked at where the level before it leaves this share of a step's information, at least; and until what is
#: left of the record knows a step by this share of the information of one in its middle.
INFORMATION_LEAST = 0.05
#: A drift that forgets more often than this in the record gives way to a step: its size is fitted anew beside it, and
#: noise alone gains as two coefficients do. Of 683 clean records at 1 Hz 17 instead of 4.6 showed 5 nats with one.
FORGETS = 5.0
#: Places with less than e^-8 of the best one's likelihood between them are two steps'.
VALLEY = 8.0
#: Places of the posterior that hold less than this are left out.
WEIGHT_LEAST = 1e-7
#: Jumps of two axes so close to each other, s, are one event.
ONE_EVENT_S = 30.0


@dataclass(frozen=True)
class Scan:
    """A step at each sample: its score `B` [n] and information `A` [n], 0 where no step is looked for. `bend` [n]:
    1 - correlation of the score at each place with the next one's. `turns`: times that the drift forgets. `none`: ln
    likelihood without a step, the columns' coefficients integrated out, less a constant."""

    B: Array
    A: Array
    bend: Array
    turns: float
    none: float

    @property
    def gain(self) -> Array:
        """Gain of ln likelihood [n] at the drift of the scan."""
        return np.where(self.A > 0.0, 0.5 * self.B**2 / np.where(self.A > 0.0, self.A, 1.0), 0.0)

    def worth(self, gain: float) -> float:
        """`gain` of the best place net of the search."""
        return net(gain, 2 if self.turns > FORGETS else 1, ln_looks(self.bend[self.A > 0.0], gain))


def scan(series: Series, fit: Fit) -> Scan:
    """A step that begins at each sample, the columns of the model fitted beside it."""
    found = shifts(series, fit.terms, fit.theta)
    c, inverse, rss = found.sums.coefficients()
    cross = found.B[:, 1:]
    B = found.B[:, 0] - cross @ c
    A = found.A - ((cross @ inverse) * cross).sum(axis=1)
    present = np.flatnonzero(np.isfinite(series.y))
    known = found.A / float(np.median(found.A[present]))
    enough = np.flatnonzero(known >= INFORMATION_LEAST)
    A[: present[0] + 4] = A[min(present[-1] - 2, enough[-1] + 1) :] = 0.0
    A = np.where(A < INFORMATION_LEAST * found.A, 0.0, A)
    turns = 0.5 * present.size * float(np.median(found.impulse[present] / found.A[present]))
    none = -0.5 * (rss / fit.sigma**2 + found.sums.D - ln_det(inverse))
    return Scan(B / fit.sigma**2, A / fit.sigma**2, _bend(A, found.impulse), turns, none)


def _bend(A: Array, impulse: Array) -> Array:
    """`Scan.bend`. Two steps one sample apart differ by an impulse. Near the ends of a record, where the level is known
    from few samples, each place is a look of its own."""
    safe = np.where(A > 0.0, A, 1.0)
    both = (A[1:] > 0.0) & (A[:-1] > 0.0)
    turn = np.append(np.where(both, np.diff(A), 0.0), 0.0) / safe
    return np.where(A > 0.0, np.clip(0.5 * impulse / safe - 0.125 * turn**2, 0.0, 1.0), 0.0)


def looks(state: State, record: Record) -> list[Look]:
    """The best place, refitted exactly."""
    n = state.y.size
    if n < 50:
        return []
    first = scan(state.series, state.best)
    gain = first.gain
    if gain.max() < SCREEN + 2.0:
        return []
    tried = {place: state.with_columns(raised(n, place)) for place in _peaks(gain, 3, max(3, int(2.0 / state.dt)))}
    place = max(tried, key=lambda one: tried[one][0])
    # The null's drift has swallowed a part of the step: the place is sharper with the drift that is left beside it.
    beside = tried[place][1]
    again = int(np.argmax(scan(state.series, beside).gain))
    if again not in tried:
        tried[again] = state.with_columns(raised(n, again))
    place = max(tried, key=lambda one: tried[one][0])
    exact, chosen = tried[place]
    exact = min(exact, state.rich_gain(raised(n, place)))
    value = first.worth(exact)
    return [_look(state, record, place, exact, value, chosen)] if value >= 1.0 else []


def at(state: State, record: Record, theta: Sequence[float]) -> Look:
    """The look at a step of a known time."""
    place = min(max(1, round(theta[0] / state.dt)), state.y.size - 1)
    column = raised(state.y.size, place)
    gain, chosen = state.with_columns(column)
    found = _look(state, record, place, gain, net(gain), chosen)
    return replace(found, measure=partial(sizes, column, "amplitude", state.unit))


def _look(state: State, record: Record, place: int, gain: float, worth: float, chosen: Fit) -> Look:
    n = state.y.size
    there = np.flatnonzero(np.isfinite(state.y))
    k = int(np.searchsorted(there, place))
    first, last = int(there[k - 1]) + 1 if k else place, int(there[k]) if k < there.size else place
    place, width = (first + last) // 2, (last - first + 1) * state.dt  # in a gap any place may be the one
    time = float(record.time_s[place])
    column = Regressor(f"step_{time:.6g}s", "step", raised(n, place), "1", {"kind": "step", "time_s": time})
    estimate = {
        "time_s": mixture(np.ones(1), np.array([time - 0.5 * state.dt / state.block]), width / math.sqrt(12.0), "s"),
        "amplitude": mixture(np.ones(1), chosen.c[-1:], chosen.sd[-1:], state.unit),
    }
    changes = {"regressors": (*state.regressors, column)}
    measure = partial(posterior, record.time_s, place)
    return Look("step", gain, worth, estimate, changes, when=(time, time), measure=measure)


def posterior(time_s: Array, place: int, state: State) -> dict[str, Any]:
    """Time and amplitude of a step over the places about `place`, every near drift and the spread of its parameters.

    At each node of the drift's parameters the scan gives likelihood, amplitude and its sd of a step at each place.
    Places behind a valley are another step's."""
    series = state.series
    ln_weight, amplitude, sd, where = [], [], [], []
    beside = state.with_columns(raised(series.y.size, place))[1]
    sigma = beside.sigma
    elsewhere = _elsewhere(scan(series, beside).gain, place)
    for one, theta, ln_share in state.possible(raised(series.y.size, place), rich=False):
        found = scan(series, replace(one, theta=theta, sigma=sigma))
        B, A = found.B, found.A
        A[elsewhere] = 0.0
        good = np.flatnonzero(A > 0.0)
        if not good.size:
            continue
        value = ln_share + found.none + found.gain[good] - 0.5 * np.log(A[good])
        held = value > value.max() + math.log(WEIGHT_LEAST)
        good = good[held]
        ln_weight.append(value[held])
        amplitude.append(B[good] / A[good])
        sd.append(1.0 / np.sqrt(A[good]))
        where.append(good)
    ln_all = np.concatenate(ln_weight)
    weight = np.exp(ln_all - ln_all.max())
    # A step lies between the last reading before it and the first one with it: means begin with their first reading.
    times = time_s[np.concatenate(where)] - 0.5 * state.dt / state.block
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


def raised(n: int, begin: int, end: int | None = None) -> Array:
    """[n]: 1 from a place on, or until another."""
    values = np.zeros(n)
    values[begin:end] = 1.0
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


def _alike(a: Look, b: Look) -> bool:
    return a.when is not None and b.when is not None and abs(a.when[0] - b.when[0]) < ONE_EVENT_S


def at_jump(look: Look, axes: Collection[str], jumps: Sequence[float]) -> bool:
    """Whether each end of it lies at a jump of the hidden quantity."""
    times = () if look.when is None else look.when
    return bool(times) and all(any(abs(time - jump) < ONE_EVENT_S for jump in jumps) for time in times)


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    """One in the middle of the record."""
    n = record.present.size
    worth = scan(state.series, state.best).worth
    return {"amplitude": (state.least(raised(n, n // 2)) * math.sqrt(gain_for(worth)), state.unit)}


def _entry(entry: Mapping[str, Any], look: Look | None, record: Record) -> dict[str, Any]:
    """Its time is one of the whole recording's."""
    time_s = digits(float(sized(entry, look, record)["time_s"]) + record.start_s)
    return {**entry, "name": f"step_{time_s:.6g}s", "time_s": time_s}


def _of_column(column: Regressor, c: Sequence[float]) -> dict[str, Any]:
    return {"time_s": float(column.entry["time_s"]), "amplitude": c[0]}


CAUSE = Cause(
    "step",
    "The bias jumps once.",
    "Record again without touching the mount or the cable.",
    source="handling",
    looks=looks,
    at=at,
    slow=True,
    of_means=True,
    pictures=shown("means", "evidence"),
    least=_least,
    grouping=Grouping(alike=_alike, piece=at_jump, most=3),
    score=Scored(once="a jump is an event of its recording"),
    written=Written(entry=_entry, of_column=_of_column),
    simulated=Simulated(
        keys={
            "time_s": Key(lambda s: s.duration_s / 2.0, "step_time_s"),
            "amplitude": Key(lambda s: 2.0 * s.n, "step_amplitude"),
        }
    ),
)
