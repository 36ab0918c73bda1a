"""The bias settles after power-on: A exp(-t / tau), of one time constant or of two.

The drift swallows a transient: at the drift fitted without it, the innovations hardly show it. Time constants are
ranked at drifts of several sizes, then the drift is fitted beside the best.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from selfcal.diagnosis.cause import Cause, Channels, Key, medians, positive, shown
from selfcal.diagnosis.forms import LN_SLOW
from selfcal.diagnosis.model_tree import digits
from selfcal.diagnosis.record import Record
from selfcal.likelihood.fit import Fit, Series, ln_det, run
from selfcal.likelihood.state import (
    NET_LEAST,
    SCREEN,
    Look,
    Regressor,
    State,
    gain_for,
    interval,
    log_normal,
    mixture,
    net,
    sizes,
)
from selfcal.likelihood.statemodel import Array, Terms

#: The fastest time constant looked for, samples.
FASTEST = 5.0
#: Time constants of the grid, per octave; neighbours a factor 2 apart correlate by 0.94.
PER_OCTAVE = 1.0
#: Drifts at which they are ranked: the fitted one's size over e to these.
SIZES = (0.0, 1.0, 2.0, 3.0)
#: Two time constants of one transient lie this factor apart at least.
APART = 4.0
#: Price of the search over time constants beside the second degree of freedom.
LN_LOOKS = 0.4 + LN_SLOW
#: Places of the posterior of a time constant, standard deviations of its logarithm from the best.
PLACES = np.linspace(-4.0, 4.0, 17)


@dataclass(frozen=True)
class Left:
    """What the columns of the model leave of the record and of candidate columns at one drift: their Gram matrix
    [1 + k, 1 + k], `n` samples, sum `D` of ln s; `freedom` samples less the columns, ln determinant of these."""

    G: Array
    n: float
    D: float
    freedom: float
    ln_det: float

    def ln_likelihood(self, explained: Array) -> Array:
        """At the best sigma, for candidates that explain so much of the residual sum of squares."""
        rss = np.maximum(self.G[0, 0] - explained, 1e-12 * self.G[0, 0])
        return np.asarray(-0.5 * (self.n * (np.log(2.0 * math.pi * rss / self.n) + 1.0) + self.D))

    def singly(self) -> Array:
        """[k]: what each candidate explains."""
        size = np.diag(self.G)[1:]
        return self.G[1:, 0] ** 2 / np.where(size > 0.0, size, math.inf)

    def by_two(self) -> Array:
        """[k, k]: what each two explain together."""
        size = np.diag(self.G)[1:]
        scale = 1.0 / np.sqrt(np.where(size > 0.0, size, math.inf))
        r, z = self.G[1:, 1:] * np.outer(scale, scale), self.G[1:, 0] * scale
        both = z[:, None] ** 2 + z[None, :] ** 2 - 2.0 * r * z[:, None] * z[None, :]
        return np.asarray(both / np.maximum(1.0 - r**2, 1e-9))

    def amplitudes(self, choices: Array) -> tuple[Array, Array, Array]:
        """ln likelihood [m] with all coefficients and sigma integrated out, coefficients [m, c] and their sd [m, c],
        of each choice [m, c] of candidates."""
        at = choices + 1
        A, b = self.G[at[:, :, None], at[:, None, :]], self.G[at, 0]
        covariance = np.linalg.pinv(A, rcond=1e-12, hermitian=True)
        c = np.einsum("mij,mj->mi", covariance, b)
        rss = np.maximum(self.G[0, 0] - np.einsum("mi,mi->m", c, b), 1e-12 * self.G[0, 0])
        freedom = self.freedom - choices.shape[1]
        sign, ln_det = np.linalg.slogdet(A)
        value = np.where(sign > 0.0, -0.5 * (freedom * np.log(rss) + self.D + self.ln_det + ln_det), -math.inf)
        variance = np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 1e-300)
        return value, c, np.sqrt(rss[:, None] / freedom * variance)


def left(series: Series, terms: Terms, theta: Array, k: int) -> Left:
    """The last `k` columns of the series are the candidates, the others the model's."""
    sums = run(series, terms, theta)[0][0]
    known = len(sums.G) - k
    model, place = sums.G[1:known, 1:known], [0, *range(known, len(sums.G))]
    cross = sums.G[1:known][:, place]
    inverse = np.linalg.pinv(model, rcond=1e-12, hermitian=True)
    G = sums.G[np.ix_(place, place)] - cross.T @ inverse @ cross
    spent = np.diag(G) < 1e-9 * np.diag(sums.G)[place]  # a candidate that the model has
    spent[0] = False
    G[spent], G[:, spent] = 0.0, 0.0
    return Left(G, sums.n, sums.D, sums.n - known + 1, -ln_det(inverse))


def looks(state: State, record: Record) -> list[Look]:
    """The best time constant, and the best two where the second gains as much as a finding needs."""
    t = _time(record)
    gain, times = _search(state, t, record, SCREEN)
    worth = net(gain, 2 * times.size, LN_LOOKS)
    if worth < 1.0:
        return []
    found = _decays(t, times)
    gain = min(gain, state.rich_gain(found))
    worth = net(gain, 2 * times.size, LN_LOOKS)
    if worth < 1.0:
        return []
    return [_look(state, record, times, gain, worth, posterior(t, times, record, state, brief=True))]


def at(state: State, record: Record, theta: Sequence[float]) -> Look:
    """The look at a settling whose time constant, s, is known, and the sd of the logarithm of that."""
    tau_s, sd = theta
    column = _decays(_time(record), np.array([tau_s]))
    gain, fit = state.with_columns(column)
    estimate = {
        "amplitude": interval(float(fit.c[-1]), float(fit.sd[-1]), state.unit),
        "tau_s": log_normal(math.log(tau_s), sd, "s"),
    }
    found = _look(state, record, np.array([tau_s]), gain, net(gain), estimate)
    return replace(found, measure=partial(sizes, column, "amplitude", state.unit))


def _look(state: State, record: Record, times: Array, gain: float, worth: float, estimate: Mapping[str, Any]) -> Look:
    t = _time(record)
    found = _decays(t, times)
    added = tuple(
        Regressor(f"turn_on_{one:.4g}s", "turn_on", row, "1", {"kind": "turn_on", "tau_s": digits(float(one))})
        for one, row in zip(times, found, strict=True)
    )
    changes = {"regressors": (*state.regressors, *added)}
    return Look("turn_on", gain, worth, estimate, changes, measure=partial(posterior, t, times, record))


def _search(state: State, t: Array, record: Record, least: float) -> tuple[float, Array]:
    """Gain and the time constants; 0 where no single one gains `least`."""
    tau = _grid(record)
    single, pair = _ranked(state, _decays(t, tau), tau)
    if single[0] < least:
        return 0.0, tau[[single[1]]]
    gain, times = _refined(state, t, tau[[single[1]]], record)
    if pair[0] - max(gain, single[0]) > SCREEN:
        both, two = _refined(state, t, tau[list(pair[1])], record)
        if net(both - gain, 2, LN_LOOKS) >= NET_LEAST:
            return both, two
    return gain, times


def _grid(record: Record) -> Array:
    """Time constants looked for, s: from some samples to the record's length."""
    low, high = _range(record)
    octaves = math.log2(high / low)
    return low * np.exp2(np.linspace(0.0, octaves, max(2, 1 + math.ceil(PER_OCTAVE * octaves))))


def _range(record: Record) -> tuple[float, float]:
    return FASTEST / record.rate_hz, record.present.size / record.rate_hz


def _time(record: Record) -> Array:
    """[n]: the middle of each sample's readings, s from power-on."""
    begins = record.since_power_on_s + record.start_s + 0.5 * (1.0 / record.rate_hz - 1.0 / record.recorded_hz)
    return record.time_s + begins


def _decays(t: Array, tau: Array) -> Array:
    """[k, n]: exp(-t / tau) of each."""
    return np.exp(-t[None, :] / np.atleast_1d(tau)[:, None])


def _ranked(state: State, columns: Array, tau: Array) -> tuple[tuple[float, int], tuple[float, tuple[int, int]]]:
    """Gain and place of the best column, gain and places of the best two, each at the best of several drifts."""
    near = np.abs(np.log(tau[:, None] / tau[None, :])) < math.log(APART) - 1e-9
    series = state.series.beside(columns)
    none = state.best.ln_likelihood
    single, pair = (-math.inf, 0), (-math.inf, (0, 0))
    for terms, theta in _drifts(state):
        found = left(series, terms, theta, len(columns))
        one = found.ln_likelihood(found.singly()) - none
        two = np.where(near, -math.inf, found.ln_likelihood(found.by_two()) - none)
        if one.max() > single[0]:
            single = (float(one.max()), int(one.argmax()))
        if two.max() > pair[0]:
            i, j = divmod(int(two.argmax()), tau.size)
            pair = (float(two.max()), (i, j))
    return single, pair


def _drifts(state: State) -> Iterator[tuple[Terms, Array]]:
    """Every near drift, as it was fitted and smaller."""
    near = state.near()
    for fit in state.fits:
        if fit.terms in near:
            for less in SIZES:
                yield fit.terms, fit.shrunk(less).theta


def _refined(state: State, t: Array, tau: Array, record: Record) -> tuple[float, Array]:
    """Exact gain at the best time constants about `tau`, and these."""
    low, high = _range(record)
    gain, fit = state.with_columns(_decays(t, tau))
    best_tau = tau
    for reach in (1.0, 0.25):  # octaves
        places = [np.clip(one * np.exp2(reach * np.linspace(-1.0, 1.0, 9)), low, high) for one in best_tau]
        series = state.series.beside(_decays(t, np.concatenate(places)))
        rest = left(series, fit.terms, fit.theta, 9 * tau.size)
        if tau.size == 1:
            moved = places[0][[int(rest.singly().argmax())]]
        else:
            i, j = divmod(int(rest.by_two()[:9, 9:].argmax()), 9)
            moved = np.array([places[0][i], places[1][j]])
        now, refitted = state.with_columns(_decays(t, moved))
        if now > gain:
            gain, fit, best_tau = now, refitted, moved
    return gain, np.sort(best_tau)


def posterior(t: Array, tau: Array, record: Record, state: State, brief: bool = False) -> dict[str, Any]:
    """Amplitudes at power-on and time constants, over the drifts, the spread of their parameters, and
    the time constants. Of a `brief` one the drift is the best alone. A time constant's prior is flat in its logarithm,
    an amplitude's is flat."""
    low, high = _range(record)
    found = _decays(t, tau)
    series = state.series.beside(found)
    _, beside = state.with_columns(found)
    grids = _places(series, beside, t, tau, low, high)
    columns = _decays(t, np.concatenate(grids))
    places = np.array(np.meshgrid(*(np.arange(grid.size) for grid in grids), indexing="ij")).reshape(tau.size, -1)
    ln_weight, mean, sd = [], [], []
    base = state.series.beside(columns)
    offset = np.cumsum([0, *(grid.size for grid in grids[:-1])])
    drifts = [(beside, beside.theta, 0.0)] if brief else state.possible(found, rich=True)
    for one, theta, ln_share in drifts:
        value, amplitude, spread = left(base, one.terms, theta, len(columns)).amplitudes(places.T + offset)
        ln_weight.append(ln_share + value)
        mean.append(amplitude)
        sd.append(spread)
    ln_all = np.concatenate(ln_weight)
    weight = np.exp(ln_all - ln_all.max())
    means, sds = np.concatenate(mean), np.concatenate(sd)
    estimate: dict[str, Any] = {}
    for k in range(tau.size):
        end = f"_{k + 1}" if k else ""
        grid = grids[k]
        times = np.tile(grid[places[k]], len(ln_weight))
        width = np.tile(np.gradient(grid)[places[k]], len(ln_weight)) / math.sqrt(12.0)
        estimate[f"amplitude{end}"] = mixture(weight, means[:, k], sds[:, k], state.unit)
        estimate[f"tau{end}_s"] = mixture(weight, times, width, "s")
    return estimate


def _places(series: Series, fit: Fit, t: Array, tau: Array, low: float, high: float) -> list[Array]:
    """Time constants about each of `tau` that hold the posterior, an even step of the logarithm apart."""
    grids = []
    for k, one in enumerate(tau):
        # The derivative by ln tau as a column: the inverse of the joint information has the variance.
        slope = fit.c[-tau.size + k] * (t / one) * np.exp(-t / one)
        wide = series.beside(slope)
        inverse = run(wide, fit.terms, fit.theta)[0][0].coefficients()[1]
        sd = fit.sigma * math.sqrt(max(float(inverse[-1, -1]), 1e-12))
        # Without information the posterior reaches the limits.
        least, most = (math.log(limit / one) for limit in (low, high))
        places = np.linspace(max(least, PLACES[0] * sd), min(most, PLACES[-1] * sd), PLACES.size)
        grids.append(one * np.exp(places if places[-1] > places[0] else 1e-6 * PLACES))
    return grids


def _alike(a: Look, b: Look) -> bool:
    """Whether the time constants may be one."""
    one, two = (look.estimate["tau_s"] for look in (a, b))
    return bool(one["q05"] <= two["q95"] and two["q05"] <= one["q95"])


def _trained(look: Look, before: State, after: State, record: Record, split: int) -> State:
    """With the time constants that the first samples alone show. What their scored successors gain is the noise model
    that is left of the first ones: the transient itself is mostly over."""
    known = {one.name for one in before.regressors}
    t = _time(record)
    cut = tuple(replace(one, values=one.values[:split]) for one in before.regressors)
    half = replace(before, y=before.y[:split], r=before.r[:split], regressors=cut, fits=()).refit()
    _, times = _search(half, t[:split], replace(record, present=record.present[:split]), -math.inf)
    kept = tuple(one for one in after.regressors if one.name in known)
    own = next(one for one in after.regressors if one.name not in known)
    added = tuple(replace(own, name=f"turn_on_{k}", values=row) for k, row in enumerate(_decays(t, times)))
    columns = (*kept, *added)
    # The first samples may show one time constant where the whole record shows two.
    same = len(columns) == len(after.regressors)
    return replace(after, regressors=columns) if same else after.refit(regressors=columns, fits=())


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    """One of a tenth of the record."""
    tau = 0.1 * record.present.size / record.rate_hz
    shape = _decays(_time(record), np.array([tau]))[0]
    size = state.least(shape) * math.sqrt(gain_for(lambda gain: net(gain, 2, LN_LOOKS)))
    return {"amplitude": (size, state.unit), "tau_s": (tau, "s")}


def _entry(entry: Mapping[str, Any], look: Look | None, record: Record) -> dict[str, Any]:
    """Of the two time constants of a look the nearer one."""
    known = {} if look is None else medians(look)
    times = [known[key] for key in ("tau_s", "tau_2_s") if key in known] or [float(entry["tau_s"])]
    return {**entry, "tau_s": digits(min(times, key=lambda one: abs(math.log(one / float(entry["tau_s"])))))}


def _add(keys: Mapping[str, Any], channels: Channels) -> Array:
    t = channels.time_s
    first, second = (keys[f"amplitude{end}"] * np.exp(-t / keys[f"tau{end}_s"]) for end in ("", "_2"))
    return np.asarray(first + second)


CAUSE = Cause(
    "turn_on",
    "The bias settles after power-on.",
    "Start the record four time constants after power-on, or keep the regressor in the model file.",
    source="sensor",
    looks=looks,
    at=at,
    most=1,
    slow=True,
    of_means=True,
    alike=_alike,
    pictures=shown("means", "evidence"),
    trained=_trained,
    anew=True,
    least=_least,
    entry=_entry,
    of_column=lambda column, c: {"amplitude": c[0], "tau_s": float(column.entry["tau_s"])},
    add=_add,
    keys={
        "amplitude": Key(lambda s: 5.0 * s.n),
        "tau_s": positive(lambda s: s.duration_s / 10.0),
        "amplitude_2": Key(lambda s: 0.0),
        "tau_2_s": positive(lambda s: s.duration_s / 10.0),
    },
)
