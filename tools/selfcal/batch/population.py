"""The population behind a batch: mean and spread of each quantity, each unit's shrunken estimate, units unlike it.

Empirical Bayes on the posteriors. A unit's quantity x (ln N, ln K, ... or the bias itself) is drawn from a normal of
mean m and spread t. Its recording measures x with the error that its own posterior has, s:

    y | x ~ N(x, s^2)      x ~ N(m + group, t^2)

m has a flat prior and is integrated out in closed form. t has Jeffreys' prior, t sqrt(sum (t^2 + s^2)^-2), on a grid.
So a few units give tails as Student's: "far off" means the same in a batch of 5 as in a batch of 500. Odd units are
found by the generalized test of extremes (Rosner, Technometrics 25, 1983): the k that are farthest from the median are
odd if the nearest of them is unlike the population of all others. So several odd units do not hide each other. A unit
that is odd in one quantity of an axis counts in another quantity of the axis only where it is ordinary. A group is a
station, a day or a lot whose units all differ by one amount: the group's own, not the parts'. Of two groups alone
nobody can say which is off: each is then half the difference away from the mean. Two groups need no label where two
normals fit the units better than one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, log_ndtr, logsumexp, ndtri

from selfcal.bank.axis_result import HALF_90, of_mixture
from selfcal.base.grid import Array, Mask, weighted_quantiles
from selfcal.readings.budget import FALSE_ALARM

#: Fewest units of a population and of a group.
UNITS_LEAST, GROUP_UNITS_LEAST = 5, 3
#: Points of the grid of spreads, and its reach from the spread of the estimates: of five units the tail weighs.
_POINTS, _SPREAD_LEAST, _SPREAD_MOST = 160, 1e-3, 100.0
#: Probability that a quantity calls any unit of a sound batch unlike.
FALSE_NAME = 0.03
#: Largest share of odd units, and the most numbers of odd units that are tried.
MOST_ODD, _TRIED = 1.0 / 3.0, 40
#: Evidence of two groups over a single group, nats. Normal batches of 8 to 24 units exceed it as if the second mean,
#: the share and the cut were three numbers more.
_SPLIT = 0.5 * float(chdtri(3, FALSE_ALARM))


@dataclass(frozen=True)
class Measured:
    """A quantity over the units that have it: `y` and `s` [n], the places of the units among all, and whether y is a
    logarithm."""

    name: str
    unit: str
    law: str
    y: Array
    s: Array
    at: NDArray[np.intp]
    logarithm: bool = True


@dataclass(frozen=True)
class Interval:
    """Median and the ends of the 90 % interval."""

    median: float
    q05: float
    q95: float

    def through(self, function: Callable[[float], float]) -> Interval:
        """The interval of a rising function of the quantity."""
        return Interval(function(self.median), function(self.q05), function(self.q95))


@dataclass(frozen=True)
class PopulationFit:
    """A population: spreads `t` [p] with weights, mean and its variance at each."""

    t: Array
    weight: Array
    mean: Array
    variance: Array

    @property
    def middle(self) -> Interval:
        """The population's mean."""
        _, _, q05, median, q95 = of_mixture(self.weight, self.mean, np.sqrt(self.variance))
        return Interval(median, q05, q95)

    @property
    def spread(self) -> Interval:
        """The population's standard deviation."""
        return Interval(*weighted_quantiles(self.t, self.weight, (0.5, 0.05, 0.95)).tolist())

    def shrunken(self, y: float, s: float, offset: float = 0.0) -> Interval:
        """A unit's quantity, by its recording and the population."""
        share = self.t**2 / (self.t**2 + s**2)
        mean = self.mean + share * (y - offset - self.mean)
        variance = share * s**2 + (1.0 - share) ** 2 * self.variance
        _, _, q05, median, q95 = of_mixture(self.weight, mean, np.sqrt(variance))
        return Interval(median + offset, q05 + offset, q95 + offset)

    def log_p(self, y: Array, s: Array) -> Array:
        """ln of the probability that a unit of the population lies as far off as `y` [n], on either side."""
        sd = np.sqrt(self.t**2 + s[:, None] ** 2 + self.variance)
        return _tail(self.weight, (y[:, None] - self.mean) / sd)


def fit_population(y: Array, s: Array) -> PopulationFit:
    """The population of measured `y` [n] with errors `s` [n]."""
    t, weight, mean, variance = _on_grid(y, s, np.ones((1, y.size), np.bool_))
    return PopulationFit(t, weight, mean[0], variance[0])


def _on_grid(y: Array, s: Array, sides: Mask) -> tuple[Array, Array, Array, Array]:
    """Spreads [p] and their weights [p], with the mean of each side and its variance [sides, p]. Each unit is on one of
    the `sides` [sides, n], which share a spread."""
    errors = s**2
    residual = y - sum(side * y[side].mean() for side in sides)
    scale = math.sqrt(float(residual @ residual) / (y.size - len(sides)) + float(np.median(errors)))
    t = scale * np.geomspace(_SPREAD_LEAST, _SPREAD_MOST, _POINTS)
    w = 1.0 / (t[:, None] ** 2 + errors)
    total = w @ sides.T
    mean = (w @ (sides * y).T) / total
    square = (w * (y - mean @ sides) ** 2).sum(axis=1)
    prior = np.log(t) + 0.5 * np.log((w**2).sum(axis=1))
    ln = prior + 0.5 * np.log(w).sum(axis=1) - 0.5 * np.log(total).sum(axis=1) - 0.5 * square + np.log(t)  # d ln t
    weight = np.exp(ln - ln.max())
    return t, weight / weight.sum(), mean.T, 1.0 / total.T


def _tail(weight: Array, off: Array) -> Array:
    """ln of the two-sided probability [...] of being `off` [..., p] standard deviations away, over weighted spreads."""
    return np.asarray(np.minimum(math.log(2.0) + logsumexp(log_ndtr(-np.abs(off)), axis=-1, b=weight), 0.0))


@dataclass(frozen=True)
class Apart:
    """A group whose units all differ: `kind` (station, day, lot) and its `name`; by `offset` (of ln y, or of y).

    `against`: the name of the only other group, "" for units without a label; None: the others are of several groups.
    `also`: groups of other kinds that have the same units. `members`: the places of its units among all."""

    kind: str
    name: str
    quantity: str
    offset: float
    log_p: float
    members: tuple[int, ...]
    also: tuple[str, ...] = ()
    against: str | None = None

    def shift(self, devices: NDArray[np.intp]) -> Array:
        """Offset of the units at the places `devices` [n] by this group."""
        inside = np.isin(devices, self.members)
        return self.offset * (inside.astype(np.float64) - (0.0 if self.against is None else 0.5))


@dataclass(frozen=True)
class Unlike:
    """A unit's quantity far off: its distance from the population's mean, of ln y or of y, and in its own sd."""

    at: int
    quantity: str
    off: float
    log_p: float


@dataclass(frozen=True)
class Population:
    """A quantity of the batch. `apart`: groups that differ. `unlike`: units that are not of it. `kept` [n]: whether a
    unit counts in it; a unit that is unlike, in this quantity or another of the axis, does not. `offset` [n] of each
    unit by its groups. `seen_from`: how far off a unit with the usual error is unlike."""

    measured: Measured
    fit: PopulationFit
    offset: Array
    kept: Mask
    seen_from: float
    apart: tuple[Apart, ...] = ()
    unlike: tuple[Unlike, ...] = field(default=())

    def shrunken(self, k: int) -> Interval:
        """The estimate of the quantity's k-th unit by the whole batch. A unit that is left out keeps its own."""
        y, s = float(self.measured.y[k]), float(self.measured.s[k])
        if not self.kept[k]:
            return Interval(y, y - HALF_90 * s, y + HALF_90 * s)
        return self.fit.shrunken(y, s, float(self.offset[k]))


def robust(y: Array, s: Array) -> tuple[float, float]:
    """Median and spread beyond the errors, which a few odd units do not move."""
    middle = float(np.median(y))
    scale = 1.4826 * float(np.median(np.abs(y - middle)))
    return middle, math.sqrt(max(scale**2 - float(np.median(s**2)), (0.1 * scale) ** 2))


#: The kind of a group that has no label.
TWO_GROUPS = "two groups"
#: A grouping: its kind, and for each unit the name of its group, "" for none.
Grouping = tuple[str, Sequence[str]]


def populations(
    measured: Sequence[Measured], groupings: Sequence[Grouping], odd: Mapping[str, Set[int]] | None = None
) -> list[Population]:
    """The population of each quantity, with the groups and units that are unlike the rest.

    `odd`: by axis, places of units that are unlike by anything else. FALSE_NAME is shared among all units and
    quantities, FALSE_ALARM among all groups and quantities."""
    tested = [quantity for quantity in measured if quantity.y.size >= UNITS_LEAST]
    limit = math.log(FALSE_NAME / max(1, sum(quantity.y.size for quantity in tested)))
    groups = _groups(groupings)
    group_limit = math.log(FALSE_ALARM / max(1, len(groups) * len(tested)))
    groups_of = {quantity.name: _apart(quantity, groups, limit, group_limit) for quantity in tested}
    by_name: dict[str, Population] = {}
    before: dict[str, frozenset[int]] = {}
    known: list[dict[str, frozenset[int]]] = []
    while before not in known:  # until nothing changes, or a choice comes again
        known.append(before)
        for quantity in tested:
            axis = quantity.name.split(".")[0]
            others = set((odd or {}).get(axis, ()))
            others |= set().union(
                *(of for name, of in before.items() if name != quantity.name and name.split(".")[0] == axis)
            )
            by_name[quantity.name] = _population(quantity, groups_of[quantity.name], others, limit)
        before = {name: frozenset(unit.at for unit in of.unlike) for name, of in by_name.items()}
    return list(by_name.values())


def _is_group(inside: int, units: int) -> bool:
    """Whether `inside` of the units are a group among the others: at most half, and neither side too small."""
    return GROUP_UNITS_LEAST <= inside <= 0.5 * units and units - inside >= GROUP_UNITS_LEAST


#: Groups that a test can separate, by the places of their units: kind, name and the only other name of each.
Groups = Mapping[tuple[int, ...], Sequence[tuple[str, str, str | None]]]


def _groups(groupings: Sequence[Grouping]) -> Groups:
    groups: dict[tuple[int, ...], list[tuple[str, str, str | None]]] = {}
    for kind, names in groupings:
        members: dict[str, list[int]] = {}
        for device, name in enumerate(names):
            members.setdefault(name, []).append(device)
        for name, inside in members.items():
            if name and _is_group(len(inside), len(names)):
                others = [other for other in members if other != name]
                against = others[0] if len(others) == 1 else None
                groups.setdefault(tuple(inside), []).append((kind, name, against))
    return groups


def _apart(measured: Measured, groups: Groups, limit: float, group_limit: float) -> list[Apart]:
    """The groups of a quantity that differ, the largest difference first."""
    apart: list[Apart] = []
    y, left = measured.y.copy(), dict(groups)
    while group := _most_apart(measured, y, left, limit, group_limit):
        apart.append(group)
        del left[group.members]
        y -= group.shift(measured.at)
    return apart


def _population(measured: Measured, apart: Sequence[Apart], others: Set[int], limit: float) -> Population:
    """The population of the units but `others`, the units that are odd elsewhere and not ordinary here."""
    apart = list(apart)
    while True:
        offset = np.sum([np.zeros(measured.y.size), *(group.shift(measured.at) for group in apart)], axis=0)
        centred = measured.y - offset
        own = ~np.isin(measured.at, list(others))
        if own.sum() < UNITS_LEAST:
            own[:] = True
        own |= fit_population(centred[own], measured.s[own]).log_p(centred, measured.s) > math.log(0.01)
        kept = own.copy()
        kept[own] = _kept(centred[own], measured.s[own], limit)
        split = None if apart and apart[-1].kind == TWO_GROUPS else _split(measured, centred, kept)
        if split is None:
            break
        apart.append(split)
    population = fit_population(centred[kept], measured.s[kept])
    log_p = population.log_p(centred, measured.s)
    off = centred - population.middle.median
    unlike = [
        Unlike(int(measured.at[k]), measured.name, float(off[k]), float(log_p[k]))
        for k in np.flatnonzero(~kept & (log_p <= limit)).tolist()
    ]
    seen_from = _seen_from(centred[kept], measured.s[kept], limit)
    return Population(measured, population, offset, kept, seen_from, tuple(apart), tuple(unlike))


def _seen_from(y: Array, s: Array, limit: float) -> float:
    """How far off a unit is unlike, at ln probability `limit`, by all others of the population `y` [n]: the unit that
    is odd makes them one fewer, so the unit nearest to their mean leaves."""
    fewer = np.arange(y.size) != int(np.argmin(np.abs(y - np.median(y))))
    others = fit_population(y[fewer], s[fewer])
    error = float(np.median(s))
    off = math.hypot(others.spread.median, error) * np.geomspace(0.5, 500.0, 400)
    log_p = others.log_p(others.middle.median + off, np.full(off.size, error))
    return float(np.exp(np.interp(-limit, -log_p, np.log(off))))


def _kept(y: Array, s: Array, limit: float) -> Mask:
    """The units [n] that are not odd: `limit` is the ln probability of an odd unit."""
    middle, spread = robust(y, s)
    order = np.argsort(-np.abs(y - middle) / np.hypot(spread, s))
    most = min(math.ceil(MOST_ODD * y.size), y.size - UNITS_LEAST)
    for k in sorted({round(count) for count in np.geomspace(1.0, max(most, 1), _TRIED)} if most > 0 else [])[::-1]:
        rest = order[k:]
        others = fit_population(y[rest], s[rest])
        if others.log_p(y[order[k - 1 : k]], s[order[k - 1 : k]])[0] <= limit:
            kept: Mask = others.log_p(y, s) > limit
            kept[rest] = True
            return kept
    return np.ones(y.size, np.bool_)


def _split(measured: Measured, y: Array, kept: Mask) -> Apart | None:
    """The smaller of two groups in which the units lie, if two are better than a single group by _SPLIT.

    Each cut of the sorted units gives two normals, equally wide. Their likelihood counts each unit's group as drawn."""
    order = np.flatnonzero(kept)[np.argsort(y[kept])]
    x, s, n = y[order] - y[kept].mean(), measured.s[order], order.size
    if n < 2 * GROUP_UNITS_LEAST:
        return None
    spread = float(np.std(x)) * np.geomspace(0.03, 3.0, _POINTS)
    w = 1.0 / (spread[:, None] ** 2 + s**2)
    sums = np.stack([np.cumsum(w * x**power, axis=1) for power in range(3)])
    low, whole = sums[..., GROUP_UNITS_LEAST - 1 : n - GROUP_UNITS_LEAST], sums[..., -1:]
    squares = [part[2] - part[1] ** 2 / part[0] for part in (low, whole - low, whole)]
    ln = 0.5 * np.log(w).sum(axis=1)
    two = ln[:, None] - 0.5 * (squares[0] + squares[1])
    below = np.arange(GROUP_UNITS_LEAST, n - GROUP_UNITS_LEAST + 1)
    gain = two.max(axis=0) - (ln - 0.5 * squares[2][:, 0]).max()
    gain += below * np.log(below / n) + (n - below) * np.log1p(-below / n)
    cut = int(np.argmax(gain))
    low_ones = int(below[cut])
    apart = float(np.mean(x[low_ones:]) - np.mean(x[:low_ones]))
    unit = math.hypot(spread[np.argmax(two[:, cut])], float(np.median(s)))
    # Nearer groups, as of a uniform population, share units.
    if gain[cut] < _SPLIT or apart < 4.5 * unit:
        return None
    smaller, off = (order[low_ones:], apart) if 2 * low_ones > n else (order[:low_ones], -apart)
    members = tuple(sorted(measured.at[smaller].tolist()))
    return Apart(TWO_GROUPS, "", measured.name, off, -float(gain[cut]), members, against="")


def _most_apart(measured: Measured, y: Array, groups: Groups, limit: float, group_limit: float) -> Apart | None:
    """The group that differs most from the others, None if no group is beyond ln probability `group_limit`. `y` [n]:
    the units without the groups that are known.

    Medians, which a few odd units move little, choose; the exact test of the units without odd ones decides. Medians
    see less: half the logarithm of the probability makes a candidate."""
    inside_of = {members: np.isin(measured.at, members) for members in groups}
    log_p = {
        members: _by_medians(y, measured.s, inside)
        for members, inside in inside_of.items()
        if _is_group(int(inside.sum()), inside.size)
    }
    for members in sorted(log_p, key=lambda members: log_p[members]):
        if log_p[members] > 0.5 * group_limit:
            break
        difference, exact = _difference(y, measured.s, inside_of[members], limit)
        if exact <= group_limit:
            (kind, name, against), *others = groups[members]
            also = tuple(f"{kind} {name}" for kind, name, _ in others)
            return Apart(kind, name, measured.name, difference, exact, members, also, against)
    return None


def _by_medians(y: Array, s: Array, inside: Mask) -> float:
    """ln of the probability that the medians of two sides differ as they do, by robust spreads of many units."""
    spread = max(robust(y[side], s[side])[1] for side in (inside, ~inside))
    difference = float(np.median(y[inside]) - np.median(y[~inside]))
    # The sd of a median is 1.2533 of that of a mean, of a normal.
    variance = [1.2533**2 * float(np.mean(spread**2 + s[side] ** 2)) / int(side.sum()) for side in (inside, ~inside)]
    return math.log(2.0) + float(log_ndtr(-abs(difference) / math.sqrt(sum(variance))))


def _difference(y: Array, s: Array, inside: Mask, limit: float) -> tuple[float, float]:
    """Difference of the units `inside` [n] from the others, and ln of its probability by chance.

    Units that are odd on their own side count on neither."""
    side_of = np.where(inside, np.median(y[inside]), np.median(y[~inside]))
    kept = _kept(y - side_of, s, limit)
    if min((kept & inside).sum(), (kept & ~inside).sum()) < GROUP_UNITS_LEAST:
        return 0.0, 0.0
    _, weight, mean, variance = _on_grid(y[kept], s[kept], np.array([inside[kept], ~inside[kept]]))
    difference, sd = mean[0] - mean[1], np.sqrt(variance.sum(axis=0))
    return float(weight @ difference), float(_tail(weight, difference / sd))


def sd_off(log_p: float) -> float:
    """How many standard deviations off a two-sided probability is; at most 38."""
    return float(-ndtri(max(math.exp(max(log_p, -700.0)) / 2.0, 1e-300)))
