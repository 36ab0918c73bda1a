"""What acts on several axes at once: events, lines and channels that no single axis shows well enough.

Every candidate is a column x(t; theta), with an unknown size on each axis that has it. Its score and information come
from the joint filter of all axes (likelihood/joint.py), and its evidence is a sum over the sets of axes. The search
over theta is paid for once, whatever the set. What acts on a single axis is left to the axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.special import logsumexp, softmax

from selfcal.base.grid import Array, Mask, half_means
from selfcal.diagnosis.alias import WANDERS
from selfcal.diagnosis.causes.periodic import SLOW_TURNS, TURNS_LEAST, ln_lines
from selfcal.diagnosis.causes.turn_on import FASTEST, LN_LOOKS
from selfcal.diagnosis.causes.variance_change import ln_changes, noisy_stretches
from selfcal.diagnosis.channel_looks import FORMS, LN_FORMS, shape_of, side_of, variants_of
from selfcal.diagnosis.hidden import Hidden, weighed
from selfcal.likelihood import work
from selfcal.likelihood.columns import FITTED, LN_EITHER, LN_SLOW
from selfcal.likelihood.edges import EDGE, peaks, scan, white_of
from selfcal.likelihood.joint import (
    CLEAR_LINE,
    SIZE_WIDTHS,
    Act,
    Course,
    Joint,
    act,
    act_apart,
    bins_of,
    bridged_rows,
    course,
    fit_joint,
    information,
    refitted,
    without_lines,
)
from selfcal.likelihood.state import ALIKE, EVIDENT, NET_LEAST, SLOW_S, State

#: False-alarm rate of the joint search at T nats, over e^-T: modules on which nothing acts (`make module-null`).
NULL = 0.05
#: Least evidence of a candidate that is named, nats.
NAMED_NATS = math.log(NULL) + EVIDENT
#: Means that the joint model takes at least, and the share of them that an axis may lack.
JOINT_MEANS_LEAST, GAPS = 600, 0.3
#: Evidence of an event that is beyond doubt, nats: before the quantity is weighed its wandering looks like events.
CERTAIN = 25.0
#: Deviations of the noise beyond which a mean is off the median of its neighbours, and left out; means of that median.
SPIKE, SPIKE_OF = 7.0, 5
#: Means on either side of a jump that may be on neither level; the levels are those of twice as many farther off.
PASSING = 6
#: Most events of a module, with events of a single axis.
EVENTS_MOST = 16
#: Places on either side of the best that share its evidence.
PLACES_NEAR = 30
#: Best places of all axes together that are weighed over the sets of axes, besides the best place of each axis.
WEIGHED = 4
#: Most lines above the means' band that are looked at.
FAST_LINES = 6
#: Most fits of a line with the drifts, and its move, turns in the record, below which they end.
LOCKED, HELD = 6, 0.02
#: Multiples of a line that are looked at with it, unless it is slow.
MULTIPLES = 5
#: Number of the largest jumps of all levels, of which each two may be the ends of a pulse.
PAIRED = 30
#: Least samples of a pulse.
PULSE_LEAST = 4
#: Share of the information of a step far from the ends, from which on two steps are taken as there.
WHOLE_INFORMATION = 0.95
#: Durations of a pulse, a factor apart, and its places in one duration.
DURATION_RATIO, PLACES_IN = 1.15, 16
#: Bins on either side of a frequency that give its noise.
BINS_OF_NOISE = 50
#: Share of a jump that a single size of the quantity explains, above which the jump is the quantity's own.
OWN_SHARE_LEAST = 0.7
#: Causes of those jumps.
JUMPS = ("step", "pulse")
#: Causes that the quantity may be, with that pattern: its course has any shape.
OF_TIME = (*JUMPS, "ramp", "turn_on")
#: Slow curves that a quantity may go along, cosines of this many half turns and fewer.
CURVES = 4
#: Logarithm of a factor about a time constant within which others are as possible as their likelihood says.
NEAR_TAU = 1.5
#: Forms of a channel that are looked for on all axes together: a single column of each.
CHANNEL_FORMS = ("static", "lag", "rate", "square")


#: Cause, its shape, the column [n] and the price of its search.
Shape = tuple[str, tuple[float, ...], Array, float]


@dataclass(frozen=True)
class JointEvent:
    """What the axes `names` have in common, of the shape `theta`, and what it is worth, nats. `passing`: from and
    before which means it passes between the levels."""

    names: tuple[str, ...]
    cause: str
    theta: tuple[float, ...]
    evidence: float
    passing: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True)
class Candidate:
    """A column of a `cause` with its shape `theta`; what it is worth on the axes, `price` the ln of the number of
    independent looks of its search. `columns` [p, n]: of means. `passing`: from and before which means a jump passes
    between the levels."""

    cause: str
    theta: tuple[float, ...]
    act: Act
    price: float
    columns: Array
    more: float = 0.0
    passing: tuple[tuple[int, int], ...] = ()

    @property
    def evidence(self) -> float:
        """Nats over no candidate, net of the search. `more`: what the drift fitted with it changes."""
        return self.act.evidence + self.more - self.price

    @property
    def effect(self) -> Array:
        """[m, n]: what it adds to each axis."""
        return np.asarray(self.act.size.T @ self.columns)

    def of(self, names: Sequence[str]) -> JointEvent:
        """The candidate as an event of the axes `names` that have it."""
        held = tuple(names[k] for k in self.act.axes)
        return JointEvent(held, self.cause, self.theta, self.evidence, self.passing)

    def share_of(self, loading: Array) -> float:
        """Share of its information that a single size of a quantity with these loadings explains."""
        held = self.act.axes
        if len(held) < 2 or len(self.columns) > 1:
            return 0.0
        a, b, weight = self.act.size[0, held], loading[held], self.act.sd[held] ** -2.0
        both = (weight * a**2).sum() * (weight * b**2).sum()
        return float((weight * a * b).sum() ** 2 / max(both, 1e-300))


@dataclass(frozen=True)
class SeenAxes:
    """The axes together: records `y` [m, n] of means `dt` s long in units of their noise, their joint `model`, and side
    `channels` [n]. `kept_out` [n // 2 + 1]: frequencies that are left to the axes."""

    y: Array
    dt: float
    model: Joint
    channels: Mapping[str, Array]
    kept_out: Mask
    since_s: float = 0.0

    @cached_property
    def passed(self) -> Mask:
        """[n]: where nothing jumps any more."""
        return np.zeros(self.n, bool)

    @property
    def n(self) -> int:
        return int(self.y.shape[1])

    @cached_property
    def course(self) -> Course:
        return course(self.model, self.y, smooth=True)

    @cached_property
    def wandering(self) -> float:
        """Evidence of the best of some slow curves, nats: what wanders goes like a curve, and a channel may too."""
        t = (np.arange(self.n) + 0.5) / self.n
        shapes: list[Shape] = [("", (), np.cos(math.pi * half * t), math.log(CURVES)) for half in range(1, CURVES + 1)]
        return max((candidate.evidence for candidate in _weighed(self, shapes, _scored(self, shapes))), default=0.0)

    @property
    def edge(self) -> int:
        """Samples at each end in which nothing jumps: there a line that was taken out rings."""
        return max(EDGE, self.n // 100)

    @cached_property
    def cross(self) -> Array:
        """[n // 2, m, m]: information of two steps by the samples between them, far from the ends."""
        turn = 2.0 * math.pi * np.maximum(np.arange(self.n // 2 + 1), 1) / self.n
        found: Array = np.asarray(irfft(self.model.precision(turn), self.n, axis=0))[: self.n // 2]
        return found


def full(score: Array, known: Array) -> Array:
    """Gain [...] of ln likelihood by scores [..., m] on all axes."""
    found: Array = 0.5 * (score * sizes(score, known)).sum(axis=-1)
    return found


def sizes(score: Array, known: Array) -> Array:
    """Best sizes [..., m] of a column on all axes."""
    least = 1e-9 * np.trace(known, axis1=-2, axis2=-1) + 1e-300  # of nothing known, nothing
    firm = known + least[..., None, None] * np.eye(score.shape[-1])
    return np.asarray(np.linalg.solve(firm, score[..., None])[..., 0])


def _best(gain: Array, score: Array, known: Array, apart: int) -> list[int]:
    """The best places of scores [n, m]: of all axes together, by their `gain` [n], and of each alone."""
    alone = 0.5 * score**2 / np.maximum(np.diagonal(known, axis1=-2, axis2=-1), 1e-300)
    found = [peaks(gain, WEIGHED, apart), *(peaks(row, 1, apart) for row in alone.T)]
    return list(dict.fromkeys(at for each in found for at in each))


def _shared(gain: Array, at: int) -> float:
    """ln of the number of places about the best, `at`, that share its evidence, by their gains [n]."""
    near = gain[max(0, at - PLACES_NEAR) : at + PLACES_NEAR + 1] - gain[at]
    return float(logsumexp(np.minimum(near, 0.0)))


def steps(seen: SeenAxes) -> Iterator[Candidate]:
    """A jump of the levels at each sample."""
    score = np.where(seen.passed[:, None], 0.0, seen.course.shock)
    score[: seen.edge] = score[-seen.edge :] = 0.0
    gain = full(score, seen.course.known)
    for at in _best(gain, score, seen.course.known, EDGE):
        column = (np.arange(seen.n) >= at).astype(float)
        found = act(score[at][None], seen.course.known[at])
        yield Candidate("step", (at * seen.dt,), found, math.log(seen.n) - _shared(gain, at), column[None])


def pulses(seen: SeenAxes) -> Iterator[Candidate]:
    """Two jumps of the same size, there and back. A first search takes their information as it is far from the ends."""
    count = max(1, int(math.log(seen.n / 3.0 / PULSE_LEAST) / math.log(DURATION_RATIO)))
    lengths = np.unique((PULSE_LEAST * DURATION_RATIO ** np.arange(count)).astype(int))
    shock = seen.course.shock
    octaves = math.log(seen.n / 3.0 / PULSE_LEAST)
    every = np.diagonal(seen.course.known, axis1=1, axis2=2)
    near_end = np.any(every < WHOLE_INFORMATION * np.diag(seen.cross[0]), axis=1)
    best: list[tuple[float, int, int]] = []
    for length in map(int, lengths):
        score = shock[:-length] - shock[length:]
        cross = seen.cross[0] - seen.cross[length]
        score[: seen.edge] = score[-seen.edge :] = 0.0
        score[near_end[:-length] | near_end[length:] | (seen.passed[:-length] & seen.passed[length:])] = 0.0
        apart = max(1, length // PLACES_IN)  # its ends are moved to their best places
        some = score[::apart]
        gain = 0.5 * (some @ np.linalg.inv(cross + cross.T) * some).sum(axis=1)
        at = int(np.argmax(gain)) * apart
        best.append((float(gain.max()), at, at + length))
    # A jump of each level is known more sharply than a long pulse is shifted.
    ends = np.sort(peaks(np.where(near_end, 0.0, full(shock, seen.course.known)), PAIRED, EDGE))
    pairs = ends[np.transpose(np.triu_indices(ends.size, 1))]
    first, last = pairs[(np.diff(pairs)[:, 0] <= lengths[-1]) & ~seen.passed[pairs].all(axis=1)].T
    cross = seen.cross[0] - seen.cross[last - first]
    gain = full(shock[first] - shock[last], cross + np.swapaxes(cross, 1, 2))
    paired = [*zip(gain.tolist(), first.tolist(), last.tolist(), strict=True)]
    places = [_moved(seen, *pair[1:]) for each in (best, paired) for pair in sorted(each, reverse=True)[:WEIGHED]]
    places = [place for place in dict.fromkeys(places) if place[1] - place[0] >= PULSE_LEAST]
    t = np.arange(seen.n)
    columns = np.array([(t >= begin) & (t < end) for begin, end, _ in places], dtype=np.float64).reshape(-1, seen.n)
    for (begin, end, alike), column, known in zip(
        places, columns, information(seen.model, seen.y, columns), strict=True
    ):
        price = math.log(seen.n) + math.log((end - begin) * octaves) - alike
        found = act((shock[begin] - shock[end])[None], known)
        yield Candidate("pulse", (begin * seen.dt, end * seen.dt), found, price, column[None])


def _moved(seen: SeenAxes, begin: int, end: int) -> tuple[int, int, float]:
    """Best places of a pulse, each in turn within a fifth of its length; ln of the pairs of places that share its
    evidence."""
    shock, alike = seen.course.shock, [0.0, 0.0]
    reach = max(2, (end - begin) // 5)
    for _ in range(2):
        for first in (False, True):
            at = begin if first else end
            low, high = max(seen.edge, at - reach), min(seen.n - seen.edge, at + reach + 1)
            places = np.arange(low, high)
            places = places[places < end - PULSE_LEAST] if first else places[places > begin + PULSE_LEAST]
            if not places.size:
                continue
            other = end if first else begin
            cross = seen.cross[np.minimum(np.abs(places - other), seen.cross.shape[0] - 1)]
            known = seen.course.known[places] + seen.course.known[other] - cross - np.swapaxes(cross, 1, 2)
            gain = full(shock[places] - shock[other], known)
            best = int(np.argmax(gain))
            at, alike[first] = int(places[best]), _shared(gain, best)
            begin, end = (at, end) if first else (begin, at)
    return begin, end, sum(alike)


def lines(seen: SeenAxes) -> Iterator[Candidate]:
    """A sine of each frequency. Its noise is the weights' own about it: no model of drift knows the colour there."""
    n, weights = seen.n, seen.course.weights
    U = rfft(weights, axis=0)
    turn = 2.0 * math.pi * np.maximum(np.arange(U.shape[0]), 1) / n
    level = seen.model.precision(turn) * (2.0 - 2.0 * np.cos(turn))[:, None, None]
    ratio = np.abs(U) ** 2 / n / np.maximum(np.diagonal(level, axis1=1, axis2=2), 1e-300)
    own = np.sqrt(_level(ratio, max(4, min(BINS_OF_NOISE, U.shape[0] // 8)), 0))
    known = 0.5 * n * level * own[:, :, None] * own[:, None, :]
    low = max(1, math.ceil(TURNS_LEAST))
    hz = np.arange(U.shape[0])
    usable = np.ones(U.shape[0], bool)
    for line in np.flatnonzero(seen.kept_out):
        usable[np.abs(hz - line) <= WANDERS * line] = False
    usable[:low] = usable[-low:] = False
    padded = 2 * next_fast_len(n, real=True)
    V = rfft(weights, padded, axis=0)
    turns = np.arange(V.shape[0]) * n / padded
    place = np.minimum(np.rint(turns).astype(int), U.shape[0] - 1)
    price = np.where(usable[place], ln_lines(turns, n, np.ones(1)), math.inf)[:, None]
    alone = 0.5 * np.abs(V) ** 2 / np.diagonal(known, axis1=1, axis2=2)[place]
    gains = np.where(usable[place][:, None], np.column_stack([alone, _combs(V, known[place], usable[place])]), 0.0)
    gains[turns < SLOW_TURNS, len(seen.y) + 2 :] = 0.0
    for at in dict.fromkeys(np.argmax(gains - price, axis=0).tolist()) if usable.any() else ():
        most = 1 if turns[at] < SLOW_TURNS else min(MULTIPLES, (len(gains) - 1) // at)
        multiples = [k for k in range(1, most + 1) if usable[place[k * at]]]
        there = known[place[at * np.array(multiples)]]
        f = _sharpest(_of_multiples(weights, there[:1], multiples), at / padded, 0.5 / padded)
        waves = _waves(f, n, multiples[:1])
        if most == 1:  # the record ends, and a spectrum does not
            scale = own[place[at]]
            there[0] = information(seen.model, seen.y, waves).mean(axis=0) * np.outer(scale, scale)
        tried = [(LN_EITHER, f, waves)]
        if len(multiples) > 1:
            f = _sharpest(_of_multiples(weights, there, multiples), at / padded, 0.5 / padded)
            waves, kinds = _waves(f, n, multiples), LN_EITHER + math.log(len(multiples) - 1)
            tried += [(kinds, f, waves[: 2 * count]) for count in range(2, len(multiples) + 1)]
        found = []
        for kinds, f, parts in tried:
            theta = (f / seen.dt, *map(float, multiples[1 : len(parts) // 2]))
            for acts, phases, columns in _phased(parts, parts @ weights, there[: len(parts) // 2]):
                cost = kinds + phases + float(ln_lines(np.array(f * n), n, np.array(acts.evidence)))
                found.append(Candidate("periodic", theta, acts, cost, columns))
        best, every = _ranked(found)[0], float(logsumexp([candidate.evidence for candidate in found]))
        yield replace(best, price=best.act.evidence - every)  # the kinds share the evidence for a line


def _combs(V: NDArray[np.complex128], known: Array, usable: Mask) -> Array:
    """Gains of lines by their spectrum V [places, m] with information `known` [places, m, m]: with a phase on each
    axis, and with 1, 2, ... multiples [places, 1 + multiples] of a waveform that all axes share. A multiple may lie a
    bin or two off its place."""
    white = np.linalg.solve(np.linalg.cholesky(known), V[:, :, None])
    power = np.where(usable[:, None, None], (white * np.swapaxes(white, 1, 2).conj()).real, 0.0)
    loud = np.trace(power, axis1=1, axis2=2)
    total, gains = power, np.zeros((len(V), 1 + MULTIPLES))
    gains[:, 0] = 0.5 * loud
    for k in range(1, MULTIPLES + 1):
        at = k * np.arange(1 + (len(V) - 1 - k // 2) // k)
        near = np.abs(at + np.arange(-(k // 2), k // 2 + 1)[:, None])
        best = np.take_along_axis(near, np.argmax(loud[near], axis=0)[None], axis=0)[0]
        total = power if k == 1 else total[: len(at)] + power[best]
        gains[: len(at), k] = 0.5 * np.linalg.eigvalsh(total)[:, -1]
    return gains


def _phased(waves: Array, score: Array, known: Array) -> Iterator[tuple[Act, float, Array]]:
    """Cosines and sines `waves` [2 k, n] by their scores [2 k, m] and information [k, m, m]: each with a phase on each
    axis, and of a waveform that all share, as from a single source. Of each its `Act`, its price and its columns."""
    yield act(score, np.repeat(known, 2, axis=0)), LN_EITHER, waves
    loud = np.sqrt(np.repeat(np.trace(np.linalg.solve(known[0], known), axis1=1, axis2=2), 2) / score.shape[1])
    of_first = score / loud[:, None]
    sizes, ways = np.linalg.eigh(of_first @ np.linalg.solve(known[0], of_first.T))
    form, falling = ways[:, -1] / loud, np.repeat(np.arange(1, 1 + len(known)), 2)
    # Waveforms that differ: half a sphere over the width of a waveform's likelihood, 1 / sqrt(the fall of the square).
    half = 0.5 * sizes.size
    fall = np.maximum(sizes[-1] - sizes[:-1], 2.0 / math.pi)  # no width is beyond half a turn
    price = half * math.log(math.pi) - math.lgamma(half) + 0.5 * float(np.log(fall / (2.0 * math.pi)).sum())
    # Before the record amplitudes fall like a square wave's: directions of normal numbers (Tyler 1987, Biometrika 74).
    price += float(np.log(loud / falling).sum() + half * np.log(((form * falling) ** 2).sum()))
    there = np.tensordot((form**2).reshape(-1, 2).sum(axis=1), known, 1)
    yield act((form @ score)[None], there), LN_EITHER + max(0.0, price), (form @ waves)[None]


def _waves(f: float, n: int, multiples: Sequence[int]) -> Array:
    """Cosine and sine of multiples of a frequency, turns a sample: [2 k, n]. Of a turn about the middle of the record
    both have nothing in common, however slow."""
    turns = 2.0 * math.pi * f * np.outer(multiples, np.arange(n) - 0.5 * (n - 1))
    return np.stack([np.cos(turns), np.sin(turns)], axis=1).reshape(-1, n)


def _level(ratio: Array, beside: int, axis: int) -> Array:
    """How much louder or quieter than expected the bins of spectra are, by the bins `beside` them along an axis. A line
    among them counts as little."""
    found: Array = uniform_filter1d(np.minimum(ratio, 4.0), 2 * beside + 1, axis=axis, mode="reflect")
    return np.maximum(found, 0.5)


def fast_lines(states: Mapping[str, State]) -> list[JointEvent]:
    """Lines of several axes above the band of means. They are looked for in the innovations of every sample, over the
    level of their neighbours. A line that an axis shows beyond doubt is left to it."""
    names = [name for name, state in states.items() if not state.below_lattice]
    grids = {(states[name].y.size, states[name].dt) for name in names}
    if len(names) < 2 or len(grids) > 1:
        return []
    ((n, dt),) = grids
    if dt >= SLOW_S:
        return []
    w = np.array([np.nan_to_num(states[name].whitened) for name in names])
    work.count(n, 2 * len(names))
    inverse = np.linalg.inv(np.corrcoef(w))
    padded = 2 * next_fast_len(n, real=True)
    power = rfft(w, padded, axis=1).astype(np.complex64)
    own = _level(np.abs(power) ** 2 / n, 2 * BINS_OF_NOISE, 1)
    power /= np.sqrt(own)
    gain = (power.conj() * (inverse.astype(np.float32) @ power)).sum(axis=0).real / n
    gain[(np.abs(power) ** 2).max(axis=0) > CLEAR_LINE * n] = 0.0
    gain -= ln_lines(np.arange(gain.size) * n / padded, n, np.ones(1))
    gain[: 1 + int(0.5 / SLOW_S * padded * dt)] = gain[-4:] = 0.0
    found = []
    for _ in range(FAST_LINES):
        at = int(np.argmax(gain))
        if gain[at] <= 0.0 or not 0 < at < gain.size - 1:
            break
        left, top, right = (float(value) for value in gain[at - 1 : at + 2])
        turn = (at + 0.5 * (left - right) / min(left + right - 2.0 * top, -1e-9)) / padded
        wave = np.exp(2j * math.pi * np.mod(turn * np.arange(n), 1.0))
        score = (w @ wave / np.sqrt(own[:, at])) @ inverse
        tried = _phased(np.empty((2, 0)), np.array([score.real, score.imag]), 0.5 * n * inverse[None])
        joint, price = max(((acts, price) for acts, price, _ in tried), key=lambda each: each[0].evidence - each[1])
        evidence = joint.evidence - price - float(ln_lines(np.array(turn * n), n, np.array(joint.evidence)))
        if evidence >= EVIDENT and len(joint.axes) > 1:
            found.append(JointEvent(tuple(names[k] for k in joint.axes), "periodic", (turn / dt,), evidence))
        gain[max(0, at - 8) : at + 9] = 0.0
    return found


def louder(states: Mapping[str, State]) -> JointEvent | None:
    """The stretch in which the noise of several axes has another level; None: no stretch is evident. Beside it each
    axis has its own noise, so that its evidence is that of the axes apart."""
    names = [name for name, state in states.items() if not state.below_lattice]
    if len({(states[name].y.size, states[name].dt) for name in names}) != 1 or len(names) < 2:
        return None
    of, dt = [states[name] for name in names], states[names[0]].dt
    found = list[JointEvent]()
    for power, (begin, end) in noisy_stretches(of):
        level, n = (rows[:, :, 0] for rows in power.levels(begin, end))
        wide = power.wide(of, begin, end)
        gain, widths = power.gain(begin, end) / wide[:, None], np.array(SIZE_WIDTHS)
        sd = np.sqrt(2.0 * wide * (1.0 / np.maximum(n, 1.0)).sum(axis=0))
        ln_bf = gain - gain / (1.0 + widths**2) - 0.5 * np.log1p(widths**2)
        acts = act_apart(ln_bf, np.log(level[0] / level[1]), sd)
        price = ln_changes(power.n, float(gain[acts.axes].sum()), 1 + (end < power.n))
        held = tuple(names[k] for k in acts.axes)
        found.append(JointEvent(held, "variance_change", (begin * dt, end * dt), acts.evidence - price))
    best = max(found, key=lambda event: event.evidence)
    return best if best.evidence >= EVIDENT and len(best.names) > 1 else None


def _sharpest(gain: Callable[[Array], Array], f: float, reach: float) -> float:
    """The frequency about f, turns a sample, of the highest of gains [tried]."""
    for _ in range(3):
        tried = f + reach * np.linspace(-1.0, 1.0, 7)
        f = float(tried[np.argmax(gain(tried))])
        reach /= 3.0
    return f


def _of_multiples(weights: Array, known: Array, multiples: Sequence[int]) -> Callable[[Array], Array]:
    """Gain of lines by their multiples, whose information [k, m, m] is much the same at all frequencies tried."""

    def gain(tried: Array) -> Array:
        total = np.zeros(tried.size)
        for k, there in zip(multiples, known, strict=False):
            z = _turned(k * tried, weights)
            total += full(z.real, there) + full(z.imag, there)
        return total

    return gain


def _turned(turns: Array, rows: Array) -> NDArray[np.complex128]:
    """Sums [tried, m] of rows [n, m], each turned by `turns` a sample: of blocks first, which all turn alike."""
    n, m = rows.shape
    block = math.isqrt(n) + 1
    blocks = np.concatenate([rows, np.zeros((-n % block, m))]).reshape(-1, block, m)
    turn = 2j * math.pi * turns[:, None]
    within = np.tensordot(np.exp(turn * np.arange(block)), blocks, (1, 1))
    return np.asarray((np.exp(turn * block * np.arange(len(blocks)))[:, :, None] * within).sum(axis=1))


def _of_columns(y: Array, model: Joint, weights: Array, multiples: Sequence[int]) -> Callable[[Array], Array]:
    """Gain of slow lines by their multiples, whose information differs between frequencies."""

    def gain(tried: Array) -> Array:
        waves = np.vstack([_waves(float(f), y.shape[1], multiples) for f in tried])
        gains = full(waves @ weights, information(model, y, waves))
        return np.asarray(gains.reshape(tried.size, -1).sum(axis=1))

    return gain


def transients(seen: SeenAxes) -> Iterator[Candidate]:
    """A constant rate, and a bias that settles: theta is its time constant, s, and how far off that may be, in its
    logarithm."""
    t = (np.arange(seen.n) + 0.5) * seen.dt
    ln_tau = math.log(FASTEST * seen.dt) + 0.5 * math.log(2.0) * np.arange(2 * int(math.log2(seen.n / FASTEST)) + 1)
    tau = np.exp(ln_tau)
    shapes: list[Shape] = [("ramp", (), t - t.mean(), LN_SLOW)]
    shapes += [
        ("turn_on", (float(constant),), np.exp(-(t + seen.since_s) / constant), LN_LOOKS + LN_SLOW) for constant in tau
    ]
    scored = _scored(seen, shapes)
    for candidate in _simplest(_weighed(seen, shapes, scored)):
        yield replace(candidate, theta=(*candidate.theta, NEAR_TAU)) if candidate.theta else candidate


def _simplest(found: Iterable[Candidate]) -> list[Candidate]:
    """The constant rate, and only those other candidates that are clearly likelier."""
    found = list(found)
    ramp = max((candidate.evidence for candidate in found if candidate.cause == "ramp"), default=-math.inf)
    return [candidate for candidate in found if candidate.cause == "ramp" or candidate.evidence > ramp + ALIKE]


def channels(seen: SeenAxes) -> Iterator[Candidate]:
    """Temperature and supply in their forms."""
    for cause, values in seen.channels.items():
        side = replace(side_of(cause, "", values), forms=CHANNEL_FORMS)
        shapes: list[Shape] = []
        plain = State("", "", seen.y[0], seen.dt, 0.0, np.ones(seen.n))
        for variant in variants_of(side, plain):
            shape = shape_of(side, plain, *variant)
            column = shape.columns[-1] - shape.columns[-1].mean()
            if np.ptp(column) > 0.0:
                price = side.ln_looks + LN_FORMS[shape.form]
                shapes.append((cause, (FORMS.index(shape.form), *variant[1:]), column, price))
        yield from _weighed(seen, shapes, _scored(seen, shapes))


def _scored(seen: SeenAxes, shapes: Sequence[Shape]) -> tuple[Array, Array, Array]:
    """The columns [k, n], their scores [k, m], and the information of each [k, m, m]."""
    columns = np.array([shape[2] / max(float(np.std(shape[2])), 1e-300) for shape in shapes])
    return columns, columns @ seen.course.weights, information(seen.model, seen.y, columns)


def _weighed(seen: SeenAxes, shapes: Sequence[Shape], scored: tuple[Array, Array, Array]) -> Iterator[Candidate]:
    """Slow columns. The best columns are weighed over the drifts of each axis that its record leaves possible: a law
    alone is too sure of what a drift does over the whole record. Beside a quantity, which the axes have in common, the
    drifts are fitted anew."""
    columns, score, known = scored
    gain = full(score, known)
    for k in np.argsort(-gain)[:FITTED]:
        if gain[k] < NET_LEAST:
            return
        cause, theta, _, price = shapes[k]
        plain = Candidate(cause, theta, act(score[k][None], known[k]), price, columns[k][None])
        yield (
            max(plain, beside(seen, plain), key=lambda candidate: candidate.evidence)
            if seen.model.has_f
            else apart(seen, plain)
        )


@lru_cache(maxsize=8)
def _alone(row: bytes, dt: float) -> State:
    """A record by itself. A finding of some axes leaves those of the others as they were."""
    y = np.frombuffer(row)
    return State("", "", y, dt, 0.0, np.ones(y.size)).refit()


def apart(seen: SeenAxes, candidate: Candidate) -> Candidate:
    """A slow candidate over the drifts of each axis that its record leaves possible."""
    states = [_alone(row.tobytes(), seen.dt) for row in seen.y]
    each = [state.bayes(candidate.columns[0], np.array(SIZE_WIDTHS)) for state in states]
    return replace(candidate, act=act_apart(*map(np.array, zip(*each, strict=True))), more=0.0)


def beside(seen: SeenAxes, candidate: Candidate) -> Candidate:
    """The candidate with the drifts fitted anew together with its column, which it may have on any axis."""
    known = information(seen.model, seen.y, candidate.columns[:1])[0]
    effect = sizes(candidate.columns @ seen.course.weights, known).T @ candidate.columns
    model = refitted(seen.model, seen.y - effect, seen.dt)
    found = course(model, seen.y, smooth=True)
    score, known = candidate.columns @ found.weights, information(model, seen.y, candidate.columns[:1])[0]
    return _gained(seen, replace(candidate, act=act(score, known)), score, model, found)


def _gained(seen: SeenAxes, candidate: Candidate, score: Array, model: Joint, found: Course) -> Candidate:
    """The candidate, of scores [p, m] at a new `model`, with what the records less its effect gain there. `found`: the
    records at that model, which may suit them better without it too."""
    gain = course(model, seen.y - candidate.effect).ln_likelihood - max(seen.course.ln_likelihood, found.ln_likelihood)
    return replace(candidate, more=gain - 0.5 * float((candidate.act.size * score).sum()))


def locked(seen: SeenAxes, candidate: Candidate) -> Candidate:
    """A line with the drifts fitted anew, at the frequency that it has there: drifts that were fitted without it have
    swallowed the most of a slow line, and what they left lies elsewhere."""
    n, multiples = seen.n, (1, *map(round, candidate.theta[1:]))
    for k in range(LOCKED):
        model = refitted(seen.model, seen.y - candidate.effect, seen.dt)
        found, f = course(model, seen.y, smooth=True), candidate.theta[0] * seen.dt
        sharp = _sharpest(_of_columns(seen.y, model, found.weights, multiples), f, 0.5 ** min(k, 2) / n)
        waves = _waves(sharp, n, multiples)
        known = information(model, seen.y, waves).reshape(len(multiples), 2, *model.correlation.shape).mean(axis=1)
        phased = _phased(waves, waves @ found.weights, known)
        acts, columns = next((acts, columns) for acts, _, columns in phased if len(columns) == len(candidate.columns))
        candidate = replace(candidate, theta=(sharp / seen.dt, *candidate.theta[1:]), act=acts, columns=columns)
        candidate = _gained(seen, candidate, columns @ found.weights, model, found)
        if abs(sharp - f) * n < HELD:
            break
    return candidate


def settled(seen: SeenAxes, candidate: Candidate) -> Candidate:
    """A bias that settles, with the drifts fitted anew, by the time constants that it may have there: ever closer,
    until the record no longer distinguishes them."""
    t, (tau, step) = (np.arange(seen.n) + 0.5) * seen.dt + seen.since_s, candidate.theta
    for _ in range(LOCKED):
        model = refitted(seen.model, seen.y - candidate.effect, seen.dt)
        found, ln_tau = course(model, seen.y, smooth=True), math.log(tau) + step * np.linspace(-1.0, 1.0, 7)
        columns = np.exp(-t / np.exp(ln_tau)[:, None])
        columns /= columns.std(axis=1)[:, None]
        score, known = columns @ found.weights, information(model, seen.y, columns)
        weight = softmax(full(score, known))
        middle, between = float(weight @ ln_tau), step / 3.0
        sd = math.sqrt(float(weight @ (ln_tau - middle) ** 2) + between**2 / 12.0)
        k = int(np.argmax(weight))
        candidate = replace(
            candidate, theta=(math.exp(middle), sd), act=act(score[k][None], known[k]), columns=columns[k][None]
        )
        candidate = _gained(seen, candidate, score[k][None], model, found)
        moved, tau = abs(middle - math.log(tau)), math.exp(middle)
        if sd > between and moved < 0.5 * sd:
            break
        step = between if sd < between and 0 < k < ln_tau.size - 1 else step
    return candidate if seen.model.has_f else apart(seen, candidate)


def between_levels(seen: SeenAxes, candidate: Candidate) -> Candidate:
    """A jump less the means in which it passes between the levels, with the drifts fitted anew: a drift that the jump
    widens takes a half for the whole."""
    passing = []
    for time in candidate.theta:
        at = round(time / seen.dt)
        before, after, about = (
            seen.y[:, max(0, at - high) : max(0, at - low)]
            for low, high in ((PASSING, 3 * PASSING), (-3 * PASSING, -PASSING), (-PASSING, PASSING))
        )
        if min(before.shape[1], after.shape[1]) < PASSING:
            continue
        with np.errstate(invalid="ignore"):
            off = [np.abs(about - np.nanmedian(level, axis=1)[:, None]) > SPIKE / 2.0 for level in (before, after)]
        places = np.flatnonzero((off[0] & off[1])[candidate.act.axes].any(axis=0)) + max(0, at - PASSING)
        if places.size:
            slow = int(places.size > 1)  # where it begins and ends it is near a level
            passing.append((int(places[0]) - slow, int(places[-1]) + 1 + slow))
    if not passing:
        return beside(seen, candidate)
    y = seen.y.copy()
    for begin, end in passing:
        y[:, begin:end] = np.nan
    return replace(beside(replace(seen, y=y), candidate), passing=tuple(passing))


#: Causes whose shape is looked for once more with the drifts fitted anew: their family, and that look.
FIRMED = {"periodic": ("line", locked), "turn_on": ("transient", settled)}
#: The searches; a jump's has the name of its cause.
FAMILIES: dict[str, Callable[[SeenAxes], Iterator[Candidate]]] = {
    "step": steps,
    "pulse": pulses,
    "line": lines,
    "transient": transients,
    "channel": channels,
}


def _ranked(found: Iterable[Candidate]) -> list[Candidate]:
    """The most evident first."""
    return sorted(found, key=lambda candidate: -candidate.evidence)


def _best_of(found: Iterable[Candidate]) -> Candidate | None:
    return next(iter(_ranked(found)), None)


@dataclass
class Search:
    """What was found so far: candidates of `several` axes, and of a `single` axis, which are left to it; the records
    less all of them, `rest` [m, n], and the `model` of that."""

    dt: float
    channels: Mapping[str, Array]
    kept_out: Mask
    since_s: float
    model: Joint
    rest: Array
    several: list[Candidate] = field(default_factory=list)
    single: list[Candidate] = field(default_factory=list)

    @cached_property
    def seen(self) -> SeenAxes:
        return SeenAxes(self.rest, self.dt, self.model, self.channels, self.kept_out, self.since_s)

    @cached_property
    def known(self) -> dict[str, list[Candidate]]:
        """What each search finds."""
        return {name: list(family(self.seen)) for name, family in FAMILIES.items()}

    def _changed(self) -> None:
        """The records or the model are others: look again."""
        self.__dict__.pop("seen", None)
        self.__dict__.pop("known", None)

    def go(self, least: float) -> None:
        """Look until nothing is worth `least`, nats. A candidate with the pattern of the quantity in the model is the
        quantity's own."""
        vain: list[Candidate] = []
        firm: list[Candidate] = []
        turns = EVENTS_MOST - len(self.several) - len(self.single)
        while turns > 0:
            left = {
                name: [candidate for candidate in each if not any(candidate is other for other in vain)]
                for name, each in self.known.items()
            }
            found = _best_of(candidate for each in left.values() for candidate in each)
            last = found is None or found.evidence < least
            if last:
                jumps = [_ranked(left[name])[:FITTED] for name in JUMPS]
                found = _best_of(
                    beside(self.seen, candidate) for each in jumps for candidate in each if candidate.evidence > 0.0
                )
            if found is None or found.evidence < least:
                return
            if found.cause in FIRMED and not any(found is candidate for candidate in firm):
                family, firmed = FIRMED[found.cause]
                firm.append(firmed(self.seen, found))
                self.known[family] = _simplest(
                    firm[-1] if candidate is found else candidate for candidate in self.known[family]
                )
                continue
            turns -= 1
            own = self._is_own(found)
            if own and found.cause in JUMPS:
                for time in found.theta:
                    at = round(time / self.dt)
                    self.seen.passed[max(0, at - 3) : at + 4] = True
                self.known.update({name: list(FAMILIES[name](self.seen)) for name in JUMPS})
                continue
            named = between_levels(self.seen, found) if found.cause in JUMPS else found
            if own or named.evidence < least:
                if last:
                    return
                vain.append(found)
                continue
            (self.several if len(named.act.axes) > 1 else self.single).append(named)
            self.rest = self.rest - named.effect
            for begin, end in named.passing:
                self.rest[:, begin:end] = np.nan
            self.model = refitted(self.model, self.rest, self.dt)
            self._changed()

    def _is_own(self, candidate: Candidate) -> bool:
        """Whether it has the pattern of the quantity in the model, in time and over the axes."""
        if candidate.share_of(self.model.loading) <= OWN_SHARE_LEAST:
            return False
        if candidate.cause not in self.channels:
            return candidate.cause in OF_TIME
        slow = max([self.seen.wandering, *(each.evidence for each in self.known["transient"])])
        return candidate.evidence < slow + ALIKE

    def weigh(self, model: Joint) -> None:
        """Take a model with the quantity. What goes like it over the axes is its own, or a channel that is looked for
        again with it: its wandering may go like a channel for a while."""
        alike = [candidate for candidate in self.several if candidate.share_of(model.loading) > OWN_SHARE_LEAST]
        self.rest = self.rest + sum(candidate.effect for candidate in alike)
        self.several = [candidate for candidate in self.several if not any(candidate is each for each in alike)]
        self.model = refitted(model, self.rest, self.dt) if alike else model
        self._changed()


def together(
    states: Mapping[str, State],
    channels: Mapping[str, Array],
    since_s: float = 0.0,
    apart: Mapping[str, Mask] = MappingProxyType({}),
) -> JointModule | None:
    """What acts on several axes of a common grid; None: there are too few axes or means.

    `channels` [n]: temperature and supply. `apart` [n]: as a record has it. Before the quantity is
    weighed its wandering looks like events: those need be beyond doubt. With it in the model, or where it is not there,
    the usual limit holds."""
    dt = max((state.dt for state in states.values()), default=1.0)
    block = max(1, round(SLOW_S / dt))
    rest = calmed({name: state for name, state in states.items() if not state.below_lattice}, apart)
    found = {name: half_means(values, block)[0] for name, values in rest.items()}
    found = {name: y for name, y in found.items() if np.isfinite(y).mean() > 1.0 - GAPS}
    if len(found) < 2 or min(y.size for y in found.values()) < JOINT_MEANS_LEAST:
        return None
    y, kept_out, scale = in_means(np.array(list(found.values())))
    span = block * dt
    side = {cause: half_means(values, block)[0] for cause, values in channels.items()}
    null = fit_joint(bins_of(y), span, False)
    search = Search(span, side, kept_out, since_s, null, y)
    search.go(CERTAIN)
    model = weighed(search.model, search.rest, span)
    if model is not None:
        search.weigh(model)
    search.go(NAMED_NATS)
    of = None
    if model is not None:  # what an axis does alone is its drift's: without it the quantity would be too sure
        y = np.where(np.isfinite(search.rest), y, np.nan) - sum(candidate.effect for candidate in search.several)
        model = refitted(search.model, y, span)
        of = Hidden(tuple(found), model, y, scale, span).calm()
    return JointModule(tuple(found), span, tuple(search.several), of, scale)


def in_means(y: Array) -> tuple[Array, Mask, Array]:
    """Means [m, n] in units of their noise less spikes of a single mean and lines beyond doubt, where the lines are in
    the spectrum, and the units [m]."""
    scale = np.array([np.nanstd(np.diff(row)) for row in y]) / math.sqrt(2.0)
    y = (y - np.nanmean(y, axis=1)[:, None]) / scale[:, None]
    whole = bridged_rows(y)
    y = np.where(np.abs(whole - median_filter(whole, (1, SPIKE_OF))) < SPIKE, y, np.nan)
    return *without_lines(y), scale


@dataclass(frozen=True)
class JointModule:
    """What acts on several of the axes `names`: `events`, of means `dt` s long, and the quantity that nobody recorded
    or None. `scale` [m]: units of the search."""

    names: tuple[str, ...]
    dt: float
    events: tuple[Candidate, ...]
    hidden: Hidden | None
    scale: Array

    def effect(self, name: str) -> Array:
        """What the events add to the means of an axis, in its unit."""
        at = self.names.index(name)
        return np.asarray(self.scale[at] * sum(event.effect[at] for event in self.events))


def sharpened(times: Sequence[float], states: Sequence[State], span: float) -> tuple[float, ...]:
    """Times of jumps on the axes' own grid, s: means of `span` s know them to a mean alone."""
    dt = states[0].dt
    if dt > 0.5 * span:
        return tuple(times)
    gain = np.sum([scan(state.series, state.best).gain for state in states], axis=0)
    reach = round(3.0 * span / dt)  # two means may hold a jump
    found = []
    for time in times:
        low = max(0, round(time / dt) - reach)
        found.append((low + int(np.argmax(gain[low : low + 2 * reach + 1]))) * dt)
    return tuple(found)


def calmed(states: Mapping[str, State], apart: Mapping[str, Mask]) -> dict[str, Array]:
    """Readings [n] of axes less the columns of their models. Where some are `apart` their white noise has the
    covariance that it has elsewhere, as `steady` has its variance: no search knows noise of two kinds."""
    rest = {name: state.rest for name, state in states.items()}
    names = [name for name in states if name in apart]
    if not names:
        return rest
    masks = np.array([apart[name] for name in names])
    white = [np.nan_to_num(white_of(states[name])) for name in names]
    for kind in np.unique(masks[:, masks.any(axis=0)], axis=1).T:
        own = np.array(white)[kind]
        inside = (masks == kind[:, None]).all(axis=0)
        roots = [_root(own[:, where]) for where in (inside, ~masks.any(axis=0))]
        less = own[:, inside] - roots[1] @ np.linalg.solve(roots[0], own[:, inside])
        for k, row in zip(np.flatnonzero(kind), less, strict=True):
            rest[names[k]][inside] -= row
    return rest


def _root(rows: Array) -> Array:
    """Root [m, m] of the covariance of noise [m, n]."""
    products = rows @ rows.T / max(1, rows.shape[1])
    return np.linalg.cholesky(products + 1e-6 * (np.trace(products) + 1e-300) * np.eye(len(rows)))
