"""A quantity that nobody recorded and that moves several axes: found, drawn over time, and weighed on held-out time.

The axes are taken together by `likelihood/joint.py`, as means of a second or more, with the models that the loop has
found. Jumps of several axes at the same time come before the quantity: it would follow them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import expit

from selfcal.base import units as unit_module
from selfcal.base.grid import Array, half_means, regridded
from selfcal.diagnosis.model_tree import digits
from selfcal.likelihood.columns import LN_EITHER
from selfcal.likelihood.edges import steady
from selfcal.likelihood.fit import best
from selfcal.likelihood.heldout import HARM_SD, HORIZONS_S, SCORE_PIECES, error_entry, in_sd, score_entry, sd_of_mean
from selfcal.likelihood.joint import (
    LEAST_AXES,
    LINE,
    Bins,
    Course,
    Joint,
    ahead,
    bins_of,
    course,
    fit_joint,
    refitted,
    without_each,
    without_lines,
    without_pairs,
)
from selfcal.likelihood.state import EVIDENT, NET_LEAST, FittedColumn, State, net, normal_entry

#: Name of the quantity in the document.
ID = "hidden_input"


@dataclass(frozen=True)
class On:
    """What the quantity does to an axis: a unit of it does `size` +- `sd`, in the axis' unit; the `probability` that it
    acts, and its `column`, which no model file can state."""

    size: float
    sd: float
    probability: float
    column: FittedColumn


@dataclass(frozen=True)
class Hidden:
    """What the axes share: `names` in the order of the `model` with the quantity, of records `y` [m, k] of means `dt` s
    long in units of `scale` [m], less what was found in them."""

    names: tuple[str, ...]
    model: Joint
    y: Array
    scale: Array
    dt: float

    @cached_property
    def null(self) -> Joint:
        """The model without the quantity."""
        return fit_joint(self.bins, self.dt, False, self.model)

    def worth(self, *, stated: bool) -> tuple[float, float]:
        """Nats by the quantity with its jumps, and net of the search; by its jumps alone if it is `stated`."""
        count = len(self.jumps)
        known, choice = (0, 0.0) if stated else (len(self.names) + 1, LN_EITHER)
        before = course(self.model if stated else self.null, self.y)
        gain = course(self.model, self.rest).ln_likelihood - before.ln_likelihood
        return gain, net(gain, known + count, choice + count * math.log(self.y.shape[1]))

    @cached_property
    def halves(self) -> tuple[tuple[Joint, Course], tuple[Joint, Course]]:
        """Models of the first half, without the quantity and with it, and their filters over all."""
        bins = bins_of(self.y[:, : self.y.shape[1] // 2])
        null = fit_joint(bins, self.dt, False, self.null)
        models = (null, fit_joint(bins, self.dt, True, null))
        return (models[0], course(models[0], self.y)), (models[1], course(models[1], self.y))

    @property
    def step(self) -> float:
        """Standard deviation of the quantity's step in a second: its unit."""
        return math.sqrt(-2.0 * math.expm1(-self.model.rate / self.dt))

    def loading(self, name: str) -> float:
        """What a unit of the quantity does to an axis, in the axis' unit."""
        at = self.names.index(name)
        return float(self.model.loading[at] * self.scale[at]) * self.step

    def share(self, name: str) -> float:
        """Share of the quantity in the drift of an axis over its correlation time."""
        return float(self.model.share(1.0 / self.model.rate)[self.names.index(name)])

    @cached_property
    def jumped(self) -> tuple[list[dict[str, float]], Array]:
        """Jumps beyond the quantity's own wandering: `time_s`, `size` in its unit, `evidence_nats`; and what they make
        of it [k]."""
        found, course_of = list[dict[str, float]](), np.zeros(self.y.shape[1])
        t = np.arange(course_of.size)
        free = t >= max(3, t.size // 200)
        while True:  # a place jumps once
            score, known = course(self.model, self.y - np.outer(self.model.loading, course_of), smooth=True).of_f.T
            gains = np.where(free, 0.5 * score**2 / np.maximum(known, 1e-300), 0.0)
            at = int(np.argmax(gains))
            if net(float(gains[at]), 1, math.log(gains.size)) < EVIDENT:
                break
            size = float(score[at] / known[at])
            found.append({"time_s": at * self.dt, "size": size / self.step, "evidence_nats": float(gains[at])})
            course_of += np.where(t >= at, size * np.exp(-self.model.rate * (t - at)), 0.0)
            free[at] = False
        return sorted(found, key=lambda jump: jump["time_s"]), course_of

    @property
    def jumps(self) -> list[dict[str, float]]:
        return self.jumped[0]

    @cached_property
    def rest(self) -> Array:
        """The records [m, k] less the jumps."""
        return np.asarray(self.y - np.outer(self.model.loading, self.jumped[1]))

    def calm(self) -> Hidden:
        """The quantity by its law without its jumps, which would count as steps of its wandering."""
        return replace(self, model=refitted(self.model, self.rest, self.dt)) if self.jumps else self

    def on(self, state: State) -> On:
        """What it does to an axis, by the quantity as the other axes show it."""
        state = state.without({ID})
        column = regridded(self.of_others[state.axis] / self.step, self.dt, state.y.size, state.dt)
        fits = [state.fitted_with(terms, column) for terms in state.near()]
        free = [state.fitted_with(terms, np.empty((0, column.size))) for terms in state.near()]
        fit = best(fits)
        size, sd = float(fit.c[-1]), float(fit.sd[-1])
        gain = fit.ln_likelihood - best(free).ln_likelihood
        # Before the record it acts on an axis as likely as not.
        return On(size, sd, float(expit(gain - math.log1p(abs(size) / sd))), FittedColumn(ID, ID, column, "1", {}))

    def put(self, state: State) -> State:
        """The state with it, if it acts on that axis."""
        on = self.on(state)
        return state.refit(regressors=(*state.regressors, on.column)) if on.probability >= 0.5 else state

    def in_drift(self, state: State) -> tuple[State, State]:
        """An axis as a bank has it, with the quantity's wandering in its drift: with the jumps there too, and with them
        as a column."""
        if ID not in (regressor.name for regressor in state.regressors):
            return state, state
        whole = state.without({ID}).refit()
        if not self.jumps:
            return whole, whole
        column = regridded(self.jumped[1] / self.step, self.dt, state.y.size, state.dt)
        return whole, whole.refit(regressors=(*whole.regressors, FittedColumn(ID, ID, column, "1", {})))

    def beside(self, states: Mapping[str, State]) -> Hidden | None:
        """The quantity given the current models of its axes, or None."""
        y = np.array([half_means(steady(state), max(1, round(self.dt / state.dt)))[0] for state in states.values()])
        n = min(y.shape[1], self.y.shape[1])
        y = np.where(np.isfinite(self.y[:, :n]), y[:, :n] / self.scale[:, None], np.nan)
        model = weighed(fit_joint(bins_of(y), self.dt, False), y, self.dt)
        return None if model is None else replace(self, model=model, y=y)

    def explains(self, source: str, others: Collection[str], upto_hz: float = 0.0) -> bool:
        """Whether noise that an axis shares with some others below a frequency is the quantity's: with it in the model
        their white noise does not go together."""
        if not {source, *others} <= set(self.names) or upto_hz > 0.501 / self.dt:
            return False
        at, *places = [self.names.index(name) for name in (source, *others)]
        return without_pairs(self.bins, self.model, at, places) < NET_LEAST

    @cached_property
    def of_others(self) -> dict[str, Array]:
        """The quantity [k] for each axis, as the other axes show it."""
        found = {}
        for name in self.names:
            others = [k for k, other in enumerate(self.names) if other != name]
            found[name] = course(self.model.of(others), self.rest[others], smooth=True).f + self.jumped[1]
        return found

    @cached_property
    def bins(self) -> Bins:
        """Spectra of the records."""
        return bins_of(self.y)

    def correlation(self, first: str, second: str) -> float:
        """Correlation of the white noise of two axes."""
        at = [self.names.index(name) for name in (first, second)]
        return float(self.model.correlation[at[0], at[1]])


def weighed(null: Joint, y: Array, dt: float) -> Joint | None:
    """The model of records y [m, n] with the quantity; None: it is not worth its numbers. `null`: without it."""
    m = len(y)
    if m < LEAST_AXES:
        return None
    bins = bins_of(y)
    model = fit_joint(bins, dt, True, null)
    if net(model.value - null.value, m + 1, LN_EITHER) < NET_LEAST:
        return None
    # A drift of a single axis, besides a walk and a Gauss-Markov process, would be taken for the quantity.
    # An axis that the quantity moves shows 3 nats.
    if (without_each(bins, model) > 3.0).sum() < LEAST_AXES:
        return None
    gain = course(model, y).ln_likelihood - course(null, y).ln_likelihood
    return model if net(gain, m + 1, LN_EITHER) >= NET_LEAST else None


def held_out(hidden: Hidden, name: str, unit: str, factor: float) -> dict[str, Any]:
    """What the quantity gains an axis in the second half, by models of the first half: the score of each mean, and the
    bias at each horizon, predicted from the past of all axes."""
    before, after = hidden.halves
    axis, half = hidden.names.index(name), hidden.y.shape[1] // 2
    scores = np.array([course.scores()[half:, axis] for _, course in (before, after)])
    scores = scores[:, np.isfinite(scores).all(axis=0)]
    sd = sd_of_mean(np.array([part.mean() for part in np.array_split(scores[1] - scores[0], SCORE_PIECES)]))
    factor *= float(hidden.scale[axis])
    rmse: dict[str, dict[str, float]] = {}
    for horizon in HORIZONS_S:
        steps = max(1, round(horizon / hidden.dt))
        read = hidden.y[axis, half + steps - 1 :]
        errors = [
            ahead(model, course, steps)[half : half + read.size, axis] - read for model, course in (before, after)
        ]
        row = error_entry(factor * errors[0], factor * errors[1])
        if row is not None:
            rmse[f"{horizon:g}"] = row
    level = float(scores[0].mean()) - math.log(factor)
    more = float((scores[1] - scores[0]).mean())
    return score_entry(level, level + more, sd, scores.shape[1]) | {"bias_rmse": {"unit": unit, "horizon_s": rmse}}


def entry(
    hidden: Hidden, states: Mapping[str, State], units: Mapping[str, str], start_s: float, *, stated: bool
) -> dict[str, Any]:
    """The finding of the document, in the `units` of the recording's columns. `start_s`: where the record begins.
    `stated`: the model file has the quantity, and its jumps alone are news."""
    axes: dict[str, Any] = {}
    gains = []
    for name in hidden.names:
        on = hidden.on(states[name])
        factor = unit_module.factor(states[name].unit, units[name])
        known = held_out(hidden, name, units[name], factor)
        gains.append(known)
        loading = normal_entry(on.size * factor, on.sd * factor, units[name])
        axes[name] = {
            "estimate": {"loading": loading, "share": hidden.share(name)},
            "probability": on.probability,
            "gain": known,
        }
    acting = {name: axis for name, axis in axes.items() if axis["probability"] >= 0.5}
    jumps = [{**jump, "time_s": jump["time_s"] + start_s} for jump in hidden.jumps]
    tau_s = hidden.dt / hidden.model.rate
    evidence, net_evidence = hidden.worth(stated=stated)
    estimate = {"law": "gauss_markov", "time_constant_s": tau_s, "jumps": jumps}
    return {
        "id": ID,
        "cause": ID,
        "words": _sentence(acting, jumps, tau_s, stated=stated),
        "estimate": estimate,
        "axes": acting,
        "evidence_nats": evidence,
        "net_nats": net_evidence,
        "confirmed": in_sd(gains) > HARM_SD,
        "also_possible": ["temperature", "supply"],
        "record_next": "Record the temperature at the sensor and its supply voltage.",
    }


def _sentence(
    axes: Mapping[str, Any], jumps: Sequence[Mapping[str, float]], time_constant_s: float, *, stated: bool
) -> str:
    shares = ", ".join(f"{name} {100.0 * axis['estimate']['share']:.0f} %" for name, axis in axes.items())
    times = ", ".join(f"{jump['time_s']:.0f}" for jump in jumps)
    if stated:
        return f"The hidden quantity of the model file jumps at {times} s."
    jumped = f" It jumps at {times} s." if jumps else ""
    return (
        f"One quantity that nobody recorded moves {len(axes)} axes together, over some {time_constant_s:.2g} s. "
        f"Its share of each axis' drift: {shares}.{jumped}"
    )


def carried(hidden: Hidden, states: Mapping[str, State], events: Mapping[str, Array]) -> dict[str, Any] | None:
    """What the quantity gains on a second recording by the models of the first, all axes together; None: an axis is
    missing. `states`: of the second recording; `events`: by axis what its own events add to its means."""
    if not set(hidden.names) <= states.keys():
        return None
    block = max(1, round(hidden.dt / states[hidden.names[0]].dt))
    y = np.array([half_means(states[name].y, block)[0] - events.get(name, 0.0) for name in hidden.names])
    y /= hidden.scale[:, None]
    y, _ = without_lines(y, LINE)
    before_after = [course(model, y) for model in (hidden.null, hidden.model)]
    scores = [np.nansum(side.scores(), axis=1) for side in before_after]
    more = before_after[1].ln_likelihood - before_after[0].ln_likelihood
    n = float(np.isfinite(y).any(axis=0).sum())
    sd = sd_of_mean(np.array([part.mean() for part in np.array_split(scores[1] - scores[0], SCORE_PIECES)]))
    before = float(scores[0].mean())
    return score_entry(before, before + more / n, sd, n)


def extend(tree: dict[str, Any], hidden: Hidden) -> None:
    """Put the quantity into a model file's tree, and the axes' own drifts into the axes of its `simulate`. A quantity
    that the file states stays."""
    if tree.get("hidden_input"):
        return
    tree["hidden_input"] = _stated(hidden)
    axes = tree["simulate"]["axes"]
    for name, law in _own_laws(hidden).items():
        if name in axes:
            axes[name] = {**law, **{key: axes[name][key] for key in ("bias", "N")}}


def _own_laws(hidden: Hidden) -> dict[str, dict[str, Any]]:
    """Each axis' own drift, as `simulate` in a model file has it: the larger of a walk and a Gauss-Markov process over
    half the record."""
    found = {}
    half = 0.5 * hidden.y.shape[1]
    for name, (ln_n, ln_rho, ln_markov, ln_rate), scale in zip(
        hidden.names, hidden.model.own, hidden.scale, strict=True
    ):
        white = math.exp(ln_n) * float(scale)
        walk, markov = (
            math.exp(2.0 * ln_rho) * half,
            2.0 * math.exp(2.0 * ln_markov) * -math.expm1(-math.exp(ln_rate) * half),
        )
        if walk > markov:
            found[name] = {"hypothesis": "random_walk", "K": digits(white * math.exp(ln_rho) / math.sqrt(hidden.dt))}
        else:
            sigma_m, alpha = digits(white * math.exp(ln_markov)), digits(math.exp(ln_rate) / hidden.dt)
            found[name] = {"hypothesis": "gauss_markov", "sigma_m": sigma_m, "alpha": alpha}
    return found


def _stated(hidden: Hidden) -> dict[str, Any]:
    """The model file's entry, in the units of its groups: law, loadings and the correlation of the white noise."""
    pairs = [(first, second) for k, first in enumerate(hidden.names) for second in hidden.names[k + 1 :]]
    alpha = hidden.model.rate / hidden.dt
    return {
        "law": [{"kind": "markov", "deviation": digits(1.0 / hidden.step), "alpha": digits(alpha)}],
        "loadings": {name: digits(hidden.loading(name)) for name in hidden.names},
        "noise_correlation": {f"{a}-{b}": digits(hidden.correlation(a, b), 3) for a, b in pairs},
    }
