"""Engine for columns x(t; theta) with a drift: search, choice of a form, sizes, and the smallest size shown.

A family states its shapes: forms of a column, the simplest first, each over a grid of its numbers theta. A drift
swallows a slow column, so that its score is too small at the drift fitted without it. Shapes are ranked at smaller
drifts as well; the best of each form is fitted together with the drift, and all are ranked again at that drift.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from selfcal.base.grid import Array, block_means
from selfcal.likelihood.fit import Fit
from selfcal.likelihood.state import (
    ALIKE,
    NET_LEAST,
    SCREEN,
    FittedColumn,
    Look,
    State,
    gain_for,
    mixture,
    net,
    normal_entry,
)

#: Price added to slow columns, nats: a drift known from few of its own turns leaves them a longer tail. At 0.8, of 2267
#: clean axes at 1 and 10 Hz 7 showed 7 nats of a supply or a temperature and 2 of a ramp, where 4 and 2 were due; the
#: tail ran on to 10.2. At 1.8, two axes show 7.6 nats of any slow column.
LN_SLOW = 1.8
#: ln of the number of looks of a choice of two.
LN_EITHER = math.log(2.0)
#: ln factors by which the fitted drift is made smaller to rank shapes again. The last is for slow shapes alone.
SMALLER = (1.5, 3.0)
#: Most forms of a family, or events of a search, that are fitted: those that rank best. After the first, a form's score
#: may lack these nats, plus this share of the best, of the worth that names a form, or makes it as likely.
FITTED, FIT_ADDS, FIT_SHARE = 3, 3.0, 0.05
#: First and last step of the logarithms of numbers, in the search between nodes of the grid.
STEP_FIRST, STEP_LAST = 0.35, 0.005
#: Least worth, nats, of a shape that may be named, or be as likely as the named shape.
NEARLY = NET_LEAST - ALIKE
#: Lattice of a number's posterior: step in standard deviations, largest fall of ln likelihood, and most nodes. First
#: offset at which the standard deviation is sought, and most tries.
NODE, POSSIBLE_NATS, NUMBER_NODES_MOST, REACH_FIRST, REACHES = 0.5, 7.0, 500, 0.01, 10


@dataclass(frozen=True)
class Number:
    """A number of a shape, above 0: its key in the estimate, its unit, and the limits of its search. If the number is a
    share `of` another number, value and limits are the share, and the estimate is their product."""

    key: str
    value: float
    unit: str
    low: float
    high: float
    of: str = ""


@dataclass(frozen=True)
class Shape:
    """The columns of a family at a theta.

    columns     [k, n]: those whose coefficients are the estimate's, `keys` with their units.
    regressors  the same space as columns of the model file.
    price       ln of the number of independent looks of its search, or that by the gain.
    free        degrees of freedom of its gain.
    numbers     theta, and `moved`, the shape at other numbers.
    sharper     the best shape at a fit, in the place of a search among other numbers.
    where       when or at which frequency it is, by its fit; `when` of a Look.
    stated      further entries of the estimate.
    measure     its posterior, of a family that knows more of it than `measured` does.
    whole       of a shape in means: the same at every sample.
    waves       coefficients whose norm is the last key, sine and cosine of a line; 0: each key is a coefficient.
    """

    form: str
    columns: Array
    regressors: tuple[FittedColumn, ...]
    keys: tuple[tuple[str, str], ...]
    price: float | Callable[[float], float] = 0.0
    free: int = 1
    numbers: tuple[Number, ...] = ()
    moved: Callable[[Sequence[float]], Shape] | None = None
    sharper: Callable[[Fit], Shape] | None = None
    where: Callable[[Fit], Mapping[str, Any]] = field(default=lambda fit: {})
    when: tuple[float, float] | None = None
    measure: Callable[[State], Mapping[str, Any]] | None = None
    stated: Mapping[str, Any] = field(default_factory=dict)
    whole: Shape | None = None
    waves: int = 0

    def in_means(self, block: int) -> Shape:
        """The shape in means of `block` samples."""
        moved, sharper = self.moved, self.sharper
        return replace(
            self,
            columns=block_means(self.columns, block),
            moved=moved and (lambda numbers: moved(numbers).in_means(block)),
            sharper=sharper and (lambda fit: sharper(fit).in_means(block)),
            whole=self,
        )

    @property
    def theta(self) -> tuple[float, ...]:
        return tuple(number.value for number in self.numbers)

    def worth(self, gain: float) -> float:
        """A gain net of the search."""
        return net(gain, self.free, self.price(gain) if callable(self.price) else self.price)

    def told(self, thetas: Array) -> dict[str, Array]:
        """Values of the numbers [..., m] in the estimate, by key."""
        values = {number.key: thetas[..., k] for k, number in enumerate(self.numbers)}
        return {number.key: values[number.key] * values.get(number.of, 1.0) for number in self.numbers}

    @property
    def limits(self) -> Array:
        """Least and most [m, 2] of the numbers."""
        return np.array([(number.low, number.high) for number in self.numbers])

    def near(self, thetas: Iterable[Array]) -> list[Shape]:
        """The shapes at other numbers [g, m], within their limits."""
        assert self.moved is not None, self.form
        return [self.moved(np.clip(theta, *self.limits.T).tolist()) for theta in thetas]


@dataclass(frozen=True)
class Tried:
    """A shape, its gain, and the fit with it."""

    shape: Shape
    gain: float
    fit: Fit

    @property
    def net(self) -> float:
        return self.shape.worth(self.gain)


def fitted(state: State, shape: Shape) -> Tried:
    """A shape, with the drift refitted."""
    return Tried(shape, *state.with_columns(shape.columns))


def tried(state: State, shapes: Sequence[Shape], *, slow: bool, least: float = NET_LEAST) -> dict[str, Tried]:
    """The best shape of each form that ranks high enough, in the order of the forms. `slow`: it is looked for in means,
    and its gain must hold over the drifts that the record leaves possible, if it is worth `least` or nearly."""
    means, block = state.slow if slow else (state, 1)
    if block > 1:
        found = tried(means, [shape.in_means(block) for shape in shapes], slow=slow, least=least)
        return {form: replace(trial, shape=trial.shape.whole or trial.shape) for form, trial in found.items()}
    shapes = [shape for shape in shapes if all(np.ptp(column) > 0.0 for column in shape.columns)]
    if not shapes:
        return {}
    blocks = [shape.columns for shape in shapes]
    drifts = [state.best, *(drift for by in SMALLER[: 1 + slow] for drift in state.stiffer(by))]
    gains = np.max([state.scores(blocks, drift) for drift in drifts], axis=0)
    if gains.max() < min(SCREEN, least):
        return {}
    done: dict[str, Tried] = {}
    for _ in range(FITTED):
        left = [k for k, shape in enumerate(shapes) if shape.form not in done]
        if not left:
            break
        k = max(left, key=lambda k: shapes[k].worth(gains[k]))
        most = max((trial.net for trial in done.values()), default=-math.inf)
        if done and shapes[k].worth(gains[k]) < max(most - ALIKE, NET_LEAST) - FIT_ADDS - FIT_SHARE * most:
            break
        best = fitted(state, shapes[k])
        gains = np.maximum(gains, state.scores(blocks, best.fit))
        better = max((j for j, shape in enumerate(shapes) if shape.form == best.shape.form), key=lambda j: gains[j])
        if better != k and gains[better] > best.gain:
            best = fitted(state, shapes[better])
        best = between(state, best)
        if slow and best.net >= max(1.0, least - ALIKE):
            best = replace(best, gain=min(best.gain, state.average_gain(best.shape.columns)))
        done[best.shape.form] = best
    # A form whose score alone is known is fitted by who takes it: only a finding needs that.
    return {form: done[form] for form in dict.fromkeys(shape.form for shape in shapes) if form in done}


def between(state: State, best: Tried) -> Tried:
    """The best numbers between those of the grid. Where the price is that of the grid alone, they gain nothing."""
    if best.net <= NEARLY:
        return best
    if best.shape.sharper is not None:
        moved = fitted(state, best.shape.sharper(best.fit))
        return moved if moved.gain > best.gain else best
    if not best.shape.numbers:
        return best

    def score(thetas: Array) -> Array:
        return state.scores([other.columns for other in best.shape.near(thetas)], best.fit)

    moved = fitted(state, *best.shape.near([top(score, best.shape.theta, best.shape.limits)]))
    if best.shape.free == len(best.shape.columns):
        moved = replace(moved, gain=best.gain)
    return moved if moved.gain >= best.gain else best


def top(score: Callable[[Array], Array], start: Sequence[float], limits: Array) -> Array:
    """The numbers [m] of the highest score [g] of [g, m] from `start` on, by ever shorter steps of their logarithms."""
    moves = np.array([move for move in product((-1.0, 0.0, 1.0), repeat=len(limits)) if any(move)])
    here, step = np.log(start), STEP_FIRST
    best = float(score(np.exp(here)[None])[0])
    while step > STEP_LAST:
        near = np.clip(here + step * moves, *np.log(limits).T)
        values = score(np.exp(near))
        place = int(np.argmax(values))
        if values[place] > best + 1e-3:
            here, best = near[place], float(values[place])
        else:
            step /= 2.0
    return np.asarray(np.exp(here))


def alike(found: Mapping[str, Tried]) -> list[Tried]:
    """The forms that are as likely as the best, the simplest first. Those come last whose numbers are near their upper
    limit: any slower change looks like the longest lag, or settling."""
    best = max(trial.net for trial in found.values())
    near = [trial for trial in found.values() if trial.net > best - ALIKE]
    return sorted(near, key=lambda trial: any(n.value > 0.5 * n.high and not n.of for n in trial.shape.numbers))


def looks(
    state: State, cause: str, shapes: Sequence[Shape], dearer: Iterable[Shape] = (), *, slow: bool = True
) -> list[Look]:
    """The look at a family, if worth 1 nat. `dearer`: forms that are tried only if a cheaper form may be named."""
    found = tried(state, shapes, slow=slow)
    if any(trial.net > NEARLY for trial in found.values()):
        found |= tried(state, list(dearer), slow=slow)
    chosen = alike(found)[0] if found else None
    return [look(state, cause, chosen)] if chosen is not None and chosen.net >= 1.0 else []


def located(state: State, cause: str, shape: Shape, known: Mapping[str, Any] | None = None) -> Look:
    """The look at a shape that is known to act: no search is paid for. `known`: posteriors of its numbers."""
    shape = replace(shape, price=0.0, free=len(shape.columns), measure=None)
    if known is not None:
        shape = replace(shape, numbers=(), moved=None, stated={**shape.stated, **known})
    found = fitted(state, shape)
    return look(state, cause, between(state, found) if shape.sharper else found)


def look(state: State, cause: str, chosen: Tried) -> Look:
    """The look at the shape that was chosen."""
    changes = {"regressors": (*state.regressors, *chosen.shape.regressors)}
    measure = chosen.shape.measure or partial(measured, chosen.shape)
    when, estimate = chosen.shape.when, _estimate(chosen)
    return Look(cause, chosen.gain, chosen.net, estimate, changes, when=when, measure=measure, shape=chosen.shape)


def _estimate(chosen: Tried) -> dict[str, Any]:
    """Estimate of the fit: its coefficients, and the best numbers alone."""
    shape, fit = chosen.shape, chosen.fit
    k = len(shape.columns)
    c, sd = _sizes(shape, fit.c[-k:], fit.sd[-k:])
    found = {key: normal_entry(float(c[j]), float(sd[j]), unit) for j, (key, unit) in enumerate(shape.keys)}
    values = shape.told(np.array(shape.theta))
    numbers = {number.key: normal_entry(float(values[number.key]), 0.0, number.unit) for number in shape.numbers}
    return {**shape.where(fit), **found, **numbers, **shape.stated}


def _sizes(shape: Shape, c: Array, sd: Array) -> tuple[Array, Array]:
    """Coefficients [..., columns] and their deviations as the keys have them."""
    if not shape.waves:
        return c, sd
    last = len(shape.keys) - 1
    own = slice(last, last + shape.waves)
    norm, mean = np.linalg.norm(c[..., own], axis=-1, keepdims=True), sd[..., own].mean(axis=-1, keepdims=True)
    return np.concatenate([c[..., :last], norm], axis=-1), np.concatenate([sd[..., :last], mean], axis=-1)


def measured(shape: Shape, state: State) -> dict[str, Any]:
    """Posteriors of the coefficients and the numbers, over the drifts, the spread of their parameters, and each other.
    The prior of a number is flat in its logarithm, that of a coefficient is flat."""
    points, steps = possible(state, shape)
    shapes = [shape, *(shape.near(np.exp(points)) if shape.numbers else [])]
    weight, means, sds = state.posterior(*(shape.columns for shape in shapes))
    if shape.numbers:  # the lattice has the first shape as well
        weight, means, sds = weight[1:], means[1:], sds[1:]
    means, sds = _sizes(shape, means, sds)
    found = {
        key: mixture(weight.ravel(), means[..., j].ravel(), sds[..., j].ravel(), unit)
        for j, (key, unit) in enumerate(shape.keys)
    }
    for k, (number, values) in enumerate(zip(shape.numbers, shape.told(np.exp(points)).values(), strict=True)):
        # The deviation within a cell of the lattice: its width over the root of 12.
        width = float(np.linalg.norm(steps[k])) / math.sqrt(12.0)
        found[number.key] = mixture(weight.sum(axis=1), values, values * width, number.unit)
    return found


def possible(state: State, shape: Shape) -> tuple[Array, Array]:
    """`number_nodes` of a shape's numbers, at the drift that is fitted with it."""
    if not shape.numbers:
        return np.empty((1, 0)), np.empty((0, 0))
    fit = fitted(state, shape).fit

    def scores(thetas: Array) -> Array:
        return state.scores([other.columns for other in shape.near(thetas)], fit)[None]

    return number_nodes(scores, shape.theta, shape.limits)


def number_nodes(scores: Callable[[Array], Array], start: Sequence[float], limits: Array) -> tuple[Array, Array]:
    """Logarithms of numbers that the record leaves possible [points, m], on a lattice about the best with the steps
    [m, m], its columns. `scores` [d, points] of [points, m] at some drifts, the likeliest first."""
    limits, m = np.log(limits), len(limits)
    if not m:
        return np.empty((1, 0)), np.empty((0, 0))
    middle = np.clip(np.log(start), *limits.T)  # the limits of a number may follow another
    best = scores(np.exp(middle)[None])[:, 0]
    reach, steps = np.full(m, REACH_FIRST), np.eye(m)
    for _ in range(REACHES):
        moved = np.clip(middle + np.vstack([np.diag(reach), -np.diag(reach)]), *limits.T)
        falls = best[0] - scores(np.exp(moved))[0].reshape(2, m)
        steps = np.diag(NODE * reach / np.sqrt(np.maximum(2.0 * falls.mean(axis=0), 0.1)))
        flat = falls.min(axis=0) <= 0.3
        if not flat.any():
            break
        reach = np.where(flat, 1.6 * reach, reach)
    found: dict[tuple[int, ...], Array] = {}
    seen = waiting = {(0,) * m}
    while waiting and len(found) < NUMBER_NODES_MOST:
        inside = [at for at in waiting if np.all(np.abs(np.clip(x := middle + steps @ at, *limits.T) - x) < 1e-9)]
        if not inside:
            break
        values = scores(np.exp([middle + steps @ at for at in inside])).T
        best = np.maximum(best, values.max(axis=0))
        near = {at: value for at, value in zip(inside, values, strict=True) if np.any(value > best - POSSIBLE_NATS)}
        found |= near
        moves = [(j, way) for j in range(m) for way in (1, -1)]
        waiting = {tuple(x + way * (i == j) for i, x in enumerate(at)) for at in near for j, way in moves} - seen
        seen = seen | waiting
    return np.array([middle + steps @ at for at in found]), steps


def least(state: State, shape: Shape, key: str) -> dict[str, tuple[float, str]]:
    """The size of a shape of one column that the record would have shown, its search paid for, with its numbers."""
    (_, unit), size = shape.keys[0], state.least(shape.columns[0])
    found = {key: (size * math.sqrt(gain_for(shape.worth)), unit)}
    values = shape.told(np.array(shape.theta))
    return {**found, **{number.key: (float(values[number.key]), number.unit) for number in shape.numbers}}
