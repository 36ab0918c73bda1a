"""The textbook bank (host_sim/textbook_bank.hpp) over a grid refined until the answer is that of the continuous prior.

Under each hypothesis the posterior is integrated in the logarithms of its parameters over an even lattice. Only the
connected part of the lattice within `_DEPTH` nats of the highest node is filtered, so a narrow ridge costs what it
covers. Interior directions converge exponentially in the step (trapezoid rule on a smooth peak), directions cut off by
a prior limit as its sixth power (Gregory's end weights). The step of a direction is halved until leaving out every
second node changes nothing that matters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import generate_binary_structure, maximum_filter

from selfcal import _reference
from selfcal.bank.axis_result import AxisResult, Estimate
from selfcal.base.errors import UserError
from selfcal.base.grid import Array, Rows
from selfcal.model.file import Group, Prior
from selfcal.model.laws import KINDS, Law

#: Nats below the highest node at which the lattice ends: of a three-dimensional normal posterior 5e-7 lies beyond.
_DEPTH = 16.0
#: First step in each direction, in conditional standard deviations.
_STEP = 0.75
#: Fewest steps of a direction between its limits.
_FEWEST = 24
#: Most nodes of a hypothesis, and of a direction: a larger posterior is out of this engine's reach.
_NODES_MOST = 2**20
#: Gregory's weights of the nodes nearest an end, from differences up to the fourth: error of order h^6.
_GREGORY = np.array([95 / 288, 317 / 240, 23 / 30, 793 / 720, 157 / 160])


@dataclass(frozen=True)
class _Filtered:
    """m nodes: `value` [m] ln of likelihood times prior density in ln parameters; moments [m, 1 + p] of x0 + drift +
    c z now and of the coefficients c."""

    value: Array
    mean: Array
    var: Array


@dataclass(frozen=True)
class _Posterior:
    ln_evidence: float
    parameters: dict[str, Estimate]
    mean: Array
    var: Array


def reference_axis(
    y: Array,
    dt: float,
    group: Group,
    hypotheses: Mapping[str, float],
    r: Array | None = None,
    z: Array | None = None,
    coefficient_sd: Sequence[float] = (),
    block: int = 1,
    ahead_s: float = 0.0,
) -> AxisResult:
    """Posterior of an axis under the continuous priors of its group.

    `y` float64[n] in the group's unit every `dt` s, NaN where a sample is missing; `r` float64[n] is the factor on the
    white noise variance of each (None: 1). `hypotheses`: prior probability by name. `z` float64[n, p] are the columns
    of the regressors in use, less their references, with the prior `coefficient_sd` of each. `y` are means of `block`
    samples. The bias is at `ahead_s` after the last of them. Raises UserError without a sample, and when a
    posterior would take more than `_NODES_MOST` nodes.
    Source: Stepanov & Motorin (2017), equations (11) to (14).
    """
    n = int(np.isfinite(y).sum())
    if n == 0:
        raise UserError("there is no sample to identify from")
    offset = float(np.nanmean(y))
    centred = np.ascontiguousarray(y - offset, np.float64)
    factors = None if r is None else np.ascontiguousarray(r, np.float64)
    columns = None if z is None else np.ascontiguousarray(z, np.float64)
    sd = None if z is None else np.array(coefficient_sd, np.float64)
    posteriors = {
        name: _posterior(centred, dt, offset, group, name, factors, columns, sd, block, ahead_s) for name in hypotheses
    }
    ln_weight = np.array([math.log(hypotheses[name]) + p.ln_evidence for name, p in posteriors.items()])
    weight = np.exp(ln_weight - ln_weight.max())
    probability = dict(zip(posteriors, (weight / weight.sum()).tolist(), strict=True))
    bias_mean = sum(probability[name] * p.mean[0] for name, p in posteriors.items())
    spread = sum(probability[name] * (p.var[0] + (p.mean[0] - bias_mean) ** 2) for name, p in posteriors.items())
    return AxisResult(
        n,
        {name: p.ln_evidence for name, p in posteriors.items()},
        probability,
        {name: p.parameters for name, p in posteriors.items()},
        float(bias_mean + offset),
        math.sqrt(spread),
        {
            name: tuple(zip(p.mean[1:].tolist(), np.sqrt(p.var[1:]).tolist(), strict=True))
            for name, p in posteriors.items()
        },
    )


def _posterior(
    y: Array,
    dt: float,
    offset: float,
    group: Group,
    law: str,
    r: Array | None,
    z: Array | None,
    sd: Array | None,
    block: int,
    ahead_s: float,
) -> _Posterior:
    of = group.laws[law]
    means = len(of.read) if block > 1 else 0  # of the terms, over the block; e_i and e_(i-1) are noise
    beside = means + 2 * of.coloured_noise
    columns_now = np.empty(0) if z is None else z[np.flatnonzero(np.isfinite(y))[-1]]
    constant = np.concatenate([np.zeros(beside), [1.0], columns_now])
    own_from = max(len(of.read), 1) + beside + 1
    names = of.parameters
    priors = [group.priors[name] for name in names]
    low = np.log([prior.min for prior in priors])
    high = np.log([prior.max for prior in priors])

    def filtered(x: Array) -> _Filtered:
        """x [m, parameters]: ln of each parameter."""
        theta = {name: np.ascontiguousarray(column) for name, column in zip(names, np.exp(x).T, strict=True)}
        none = np.ones(len(x))
        drift_of, second = (*(theta[name] for name in names[1:]), none, none)[:2]
        ln_p, mean, covariance = _reference.run_filters(
            y,
            dt,
            -offset,
            group.priors["bias"].sd,
            [of.as_tuple],
            np.zeros(len(x), np.int32),
            drift_of,
            second,
            theta["N"] / math.sqrt(dt),
            r,
            z,
            sd,
            block,
        )
        ln_prior = sum(prior.ln_density(x[:, d]) for d, prior in enumerate(priors))
        own = np.diagonal(covariance, axis1=1, axis2=2)[:, own_from:]
        drift, gained = _later(of, drift_of, second, ahead_s)
        now = np.hstack([drift, np.broadcast_to(constant, (len(x), constant.size))])
        return _Filtered(
            ln_p + ln_prior,
            np.column_stack([(mean * now).sum(axis=1), mean[:, own_from:]]),
            np.column_stack([np.einsum("mi,mij,mj->m", now, covariance, now) + gained, own]),
        )

    seeds = _modes(lambda x: filtered(x).value, low, high)
    widths = _widths(lambda x: filtered(x).value, seeds[0], low, high)
    lattice = _Lattice(filtered, low, high, widths, 1 + len(columns_now))
    lattice.start(seeds)
    lattice.refine()
    mass = lattice.mass(None)
    total = float(mass.sum())
    mean = mass @ lattice.mean / total
    var = mass @ (lattice.var + (lattice.mean - mean) ** 2) / total
    return _Posterior(
        math.log(total) + lattice.top,
        {name: _estimate(lattice, d, priors[d]) for d, name in enumerate(names)},
        mean,
        var,
    )


def _later(of: Law, drift: Array, second: Array, time_s: float) -> tuple[Array, Array]:
    """Weight of each state now in the drift some time on [m, states], and the variance that it gains until then [m],
    at the drift and second parameters [m]."""
    terms = [KINDS[term.kind].later(term, time_s) for term in of.sized(drift, second)]
    taken = [weight for weights, _ in terms for weight in weights]
    gained = sum((variance for _, variance in terms), np.zeros(drift.size))
    return np.column_stack(taken or [np.ones(drift.size)]), gained


# ------------------------------------------------------------------------------------------------- finding the modes


def _modes(value: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Maxima of `value` in the box, [modes, parameters], highest first.

    ln N, in which every posterior is narrow, is searched by zooming at each point of a coarse grid of the other
    parameters; the local maxima of that profile are polished.
    """
    from scipy.optimize import minimize  # half a second to import, and every engine needs textbook_node()

    # Points of the scan in each drift parameter, by the number of those.
    points = {0: (), 1: (25,), 2: (11, 9)}[len(low) - 1]
    axes = [np.linspace(low[d + 1], high[d + 1], count) for d, count in enumerate(points)]
    rest = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(points)) if axes else np.empty((1, 0))
    left, right = np.full(len(rest), low[0]), np.full(len(rest), high[0])
    best, profile = left, left
    for count in (13, 7, 7, 7, 7):
        ln_n = np.linspace(left, right, count, axis=1)
        x = np.concatenate([ln_n[:, :, None], np.repeat(rest[:, None, :], count, axis=1)], axis=2)
        values = value(x.reshape(-1, len(low))).reshape(len(rest), count)
        top = values.argmax(axis=1)
        rows = np.arange(len(rest))
        best, profile = ln_n[rows, top], values[rows, top]
        left, right = ln_n[rows, np.maximum(top - 1, 0)], ln_n[rows, np.minimum(top + 1, count - 1)]
    grid = profile.reshape(points or 1)
    peak = (grid == maximum_filter(grid, footprint=generate_binary_structure(grid.ndim, 1), mode="nearest")).ravel()
    starts = np.column_stack([best, rest])[peak]
    starts = starts[np.argsort(-profile[peak])][:4]
    step = (high - low) / (2.0 * np.array([500, *points]))
    polished: list[tuple[float, Array]] = []
    for start in starts:
        simplex = np.clip(np.vstack([start, start + np.diag(step)]), low, high)
        simplex[1:] -= 2.0 * np.diag(step) * (np.diag(simplex[1:]) == start)  # at the upper limit: inwards
        optimum = minimize(
            lambda x: -float(value(x[None, :])[0]),
            start,
            method="Nelder-Mead",
            bounds=list(zip(low, high, strict=True)),
            options={"initial_simplex": simplex, "xatol": math.inf, "fatol": 0.05},
        )
        polished.append((-float(optimum.fun), np.asarray(optimum.x, np.float64)))
    polished.sort(key=lambda mode: -mode[0])
    return np.array([x for height, x in polished if height > polished[0][0] - _DEPTH])


def _widths(value: Callable[[Array], Array], mode: Array, low: Array, high: Array) -> Array:
    """Distance in each direction at which `value` has fallen by half a nat: a conditional sd of a normal posterior."""
    reach = 2.0 ** np.arange(-40, 1)
    widths = high - low
    for d in range(len(mode)):
        for sign in (-1.0, 1.0):
            x = np.repeat(mode[None, :], len(reach) + 1, axis=0)
            x[1:, d] += sign * reach * (high[d] - low[d])
            inside = (x[:, d] >= low[d]) & (x[:, d] <= high[d])
            values = value(x[inside])
            fallen = np.flatnonzero(values[1:] < values[0] - 0.5)
            if fallen.size:
                first = int(fallen[0])
                drop = values[0] - values[1 + first]
                widths[d] = min(widths[d], reach[first] * (high[d] - low[d]) * math.sqrt(0.5 / drop))
    return widths


# ------------------------------------------------------------------------------------------------------- the lattice


class _Lattice:
    """Nodes low + index * step with indices 0 to `count` in each of D directions; those filtered so far.

    `index` int64[m, D]; `value`, `mean`, `var` as in _Filtered; `top` is the highest value.
    """

    def __init__(
        self, filtered: Callable[[Array], _Filtered], low: Array, high: Array, widths: Array, moments: int
    ) -> None:
        self.filtered, self.low, self.high = filtered, low, high
        steps = np.maximum(np.ceil((high - low) / (_STEP * widths)), _FEWEST)
        self.count: Rows = (2 * np.ceil(np.minimum(steps, _NODES_MOST) / 2)).astype(np.int64)
        self.index: Rows = np.empty((0, len(low)), np.int64)
        self.value = np.empty(0)
        self.mean, self.var = np.empty((0, moments)), np.empty((0, moments))
        self.top = -math.inf

    def x(self, index: Rows) -> Array:
        """ln parameters [m, D] of nodes."""
        return self.low + (self.high - self.low) * (index / self.count)

    def start(self, seeds: Array) -> None:
        """Filter the nodes nearest to `seeds` [modes, D] and all that connects to them."""
        self._add(np.unique(np.rint((seeds - self.low) / (self.high - self.low) * self.count).astype(np.int64), axis=0))
        self._spread()

    def _spread(self) -> None:
        """Filter every node next to a node above the depth. A turn looks next to the nodes that the last turn added:
        all nodes next to older nodes are there."""
        directions = np.eye(len(self.low), dtype=np.int64)
        known = set(self._key(self.index).tolist())
        first = 0
        while True:
            inside = self.index[first:][self.value[first:] > self.top - _DEPTH]
            near = np.concatenate([inside + sign * direction for direction in directions for sign in (-1, 1)])
            near = near[((near >= 0) & (near <= self.count)).all(axis=1)]
            keys = np.array(sorted(set(self._key(near).tolist()) - known), np.int64)
            if keys.size == 0:
                return
            known.update(keys.tolist())
            first = len(self.index)
            self._add(self._index(keys))

    def refine(self) -> None:
        """Halve steps until every second node could be left out in any direction."""
        while True:
            full = self._summary(None)
            excess = []
            for d in range(len(self.low)):
                half = self._summary(d)
                sd = full[1 + len(self.low) :]
                moments = np.abs(half - full)[1:] / np.concatenate([sd, sd])
                # ln evidence may change by 4e-4, which moves a probability by 1e-4, and a moment by 5e-3 posterior sd.
                excess.append(max(abs(half[0] - full[0]) / 4e-4, float(moments.max()) / 5e-3))
            worst = int(np.argmax(excess))
            if excess[worst] <= 1.0 or self.count[worst] >= _NODES_MOST:
                return
            self.index[:, worst] *= 2
            self.count[worst] *= 2
            self._spread()

    def mass(self, halved: int | None) -> Array:
        """Share of each node [m] in the integral over e^top; `halved`: a direction in which odd nodes are left out."""
        weight = np.exp(self.value - self.top)
        for d in range(len(self.low)):
            weight = weight * self._weight(d, 2 if d == halved else 1)
        return weight

    def marginal(self, d: int) -> tuple[Array, Array]:
        """Nodes of direction d and the posterior density (not normalised) at each."""
        weight = np.exp(self.value - self.top)
        for other in range(len(self.low)):
            if other != d:
                weight = weight * self._weight(other, 1)
        start, stop = int(self.index[:, d].min()), int(self.index[:, d].max())
        rows = np.bincount(self.index[:, d] - start, weights=weight, minlength=stop - start + 1)
        share = np.arange(start, stop + 1) / float(self.count[d])
        return np.asarray(self.low[d] + (self.high[d] - self.low[d]) * share, np.float64), np.asarray(rows, np.float64)

    def _weight(self, d: int, stride: int) -> Array:
        index, rest = self.index[:, d] // stride, self.index[:, d] % stride
        count = self.count[d] // stride
        from_end = np.minimum(np.minimum(index, count - index), len(_GREGORY))
        step = (self.high[d] - self.low[d]) / count
        weight = np.append(_GREGORY, 1.0)[from_end] * step
        return np.asarray(np.where(rest == 0, weight, 0.0), np.float64)

    def _summary(self, halved: int | None) -> Array:
        """ln integral over e^top, then means [D], then standard deviations [D] of the ln parameters."""
        mass = self.mass(halved)
        total = float(mass.sum())
        if total == 0.0:
            return np.full(1 + 2 * len(self.low), math.inf)
        x = self.x(self.index)
        mean = mass @ x / total
        return np.concatenate([[math.log(total)], mean, np.sqrt(mass @ (x - mean) ** 2 / total)])

    def _add(self, index: Rows) -> None:
        if len(self.index) + len(index) > _NODES_MOST:
            raise UserError(
                f"the reference engine needs more than {_NODES_MOST} nodes for this record; take --engine library"
            )
        new = self.filtered(self.x(index))
        self.index = np.concatenate([self.index, index])
        self.value = np.concatenate([self.value, new.value])
        self.mean = np.concatenate([self.mean, new.mean])
        self.var = np.concatenate([self.var, new.var])
        self.top = float(self.value.max())

    def _key(self, index: Rows) -> Rows:
        shifts = 21 * np.arange(index.shape[1])
        return np.asarray((index << shifts).sum(axis=1), np.int64)

    def _index(self, key: Rows) -> Rows:
        shifts = 21 * np.arange(len(self.low))
        return np.asarray((key[:, None] >> shifts) & (2**21 - 1), np.int64)


def _estimate(lattice: _Lattice, d: int, prior: Prior) -> Estimate:
    from scipy.interpolate import CubicSpline

    mass = lattice.mass(None)
    mass = mass / mass.sum()
    ln_theta = lattice.x(lattice.index)[:, d]
    theta = np.exp(ln_theta)
    mean = float(mass @ theta)
    sd = math.sqrt(float(mass @ (theta - mean) ** 2))
    sd_ln = math.sqrt(float(mass @ (ln_theta - mass @ ln_theta) ** 2))
    # Between nodes ln of the density is a cubic spline: exact for a normal posterior.
    nodes, density = lattice.marginal(d)
    fine = np.linspace(nodes[0], nodes[-1], 64 * (len(nodes) - 1) + 1)
    curve = np.exp(CubicSpline(nodes, np.log(np.maximum(density, density.max() * 1e-12)))(fine))
    cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (curve[1:] + curve[:-1]))])
    cumulative /= cumulative[-1]
    q05, median, q95 = np.exp(np.interp([0.05, 0.5, 0.95], cumulative, fine))
    edge = 0.02 * (math.log(prior.max) - math.log(prior.min))
    at_min = float(np.interp(math.log(prior.min) + edge, fine, cumulative, left=0.0, right=1.0))
    at_max = 1.0 - float(np.interp(math.log(prior.max) - edge, fine, cumulative, left=0.0, right=1.0))
    identified = sd_ln < 0.5 * prior.ln_sd and max(at_min, at_max) < 0.05
    return Estimate(mean, float(median), sd, float(q05), float(q95), identified)
