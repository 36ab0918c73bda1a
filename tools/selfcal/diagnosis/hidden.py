"""One quantity that nobody recorded and that moves several axes: found, drawn over time, and weighed on held-out time.

The axes are taken together by `likelihood/joint.py`, as means of a second or more, with the models that the loop has
found. Jumps of several axes at one time come before the quantity: it would follow them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import ndtri

from selfcal.base import units as unit_module
from selfcal.diagnosis.model_tree import digits
from selfcal.likelihood.heldout import HARM_SD, HORIZONS_S, PIECES
from selfcal.likelihood.joint import (
    LEAST_AXES,
    Bins,
    Course,
    Joint,
    Jump,
    ahead,
    bins_of,
    course,
    fitted,
    jump,
    without_lines,
)
from selfcal.likelihood.state import NET_LEAST, State, interval, net
from selfcal.likelihood.statemodel import Array

#: Its name in the document.
ID = "hidden_input"
#: Probability, before the record, that the quantity moves an axis.
P_ACTS = 0.5
#: Means of this length at least, s: whatever the rate, a quantity that wanders slowly is in them.
MEANS_S = 1.0
#: Means that the joint model takes at least, and the share of them that an axis may lack.
LEAST, GAPS = 600, 0.3
#: Correlation times that the search begins at.
LN_LOOKS = math.log(2.0)
#: Jumps that are named at most.
JUMPS = 8
#: Evidence of a jump that is beyond doubt, nats: before the quantity is weighed its wandering looks like jumps.
CERTAIN = 25.0
#: Causes of columns that the quantity may be behind.
MAY_BE_ITS_OWN = ("cross_axis", "vibration", "step")
#: A jump that one size of the quantity explains to this share is the quantity's own.
PATTERN = 0.7


@dataclass(frozen=True)
class Hidden:
    """What the axes share: `names` in the order of the models, with and without the quantity, of records `y` [m, k] of
    means `dt` s long in units of `scale` [m]. `gain` in nats; `columns` [m, k]: the quantity as the others show it."""

    names: tuple[str, ...]
    model: Joint
    null: Joint
    y: Array
    scale: Array
    dt: float
    gain: float
    columns: Array

    @property
    def net(self) -> float:
        """`gain` net of the search."""
        return net(self.gain, len(self.names) + 1, LN_LOOKS)

    @cached_property
    def course(self) -> Course:
        """Filter and smoother of the model with the quantity."""
        return course(self.model, self.y, smooth=True)

    @cached_property
    def halves(self) -> tuple[tuple[Joint, Course], tuple[Joint, Course]]:
        """Models of the first half, without the quantity and with it, and their filters over all."""
        models = _both(self.y[:, : self.y.shape[1] // 2], self.dt)
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
    def jumps(self) -> list[dict[str, float]]:
        """Jumps beyond the quantity's own wandering, in time: `time_s`, `size` in its unit, `evidence_nats`."""
        gains = self.course.of_f.copy()
        gains[: max(3, gains.size // 200)] = 0.0
        least = float(ndtri(math.exp(-NET_LEAST) / gains.size) ** 2) / 2.0
        found = []
        for _ in range(JUMPS):
            at = int(np.argmax(gains))
            if gains[at] < least:
                break
            size = float(self.course.shock[at, 0] / self.course.known[at, 0, 0]) / self.step
            found.append({"time_s": at * self.dt, "size": size, "evidence_nats": float(gains[at])})
            beside = max(1, round(30.0 / self.dt))
            gains[max(0, at - beside) : at + beside + 1] = 0.0
        return sorted(found, key=lambda one: one["time_s"])

    def column(self, name: str, n: int, dt: float) -> Array:
        """The quantity as the other axes show it, in its unit, on a grid of n samples `dt` s apart."""
        values = self.columns[self.names.index(name)] / self.step
        middle = (np.arange(values.size) + 0.5) * self.dt
        found: Array = np.interp((np.arange(n) + 0.5) * dt, middle, values)
        return found

    def correlation(self, one: str, two: str) -> float:
        """Of the white noise of two axes."""
        at = [self.names.index(name) for name in (one, two)]
        return float(self.model.correlation[at[0], at[1]])


def _means(state: State, block: int) -> Array:
    """Means [k] of the readings less the columns of the model; NaN where half are missing. Columns of another axis, and
    jumps, may be the quantity's own and stay in."""
    size = [
        0.0 if column.cause in MAY_BE_ITS_OWN else c
        for column, c in zip(state.regressors, state.best.c[1:], strict=True)
    ]
    return _blocks(state.y - np.array([state.best.c[0], *size]) @ state.series.columns, block)


def _blocks(residual: Array, block: int) -> Array:
    """Means [k] of blocks; NaN where half are missing."""
    k = residual.size // block
    cells = residual[: k * block].reshape(k, block)
    there = np.isfinite(cells)
    total = np.where(there, cells, 0.0).sum(axis=1)
    count = there.sum(axis=1)
    return np.where(2 * count >= block, total / np.maximum(count, 1), np.nan)


def together(states: Mapping[str, State]) -> Hidden | None:
    """What moves several axes beyond their own drifts; None: nothing, or too few axes or means to tell.

    `states`: of one grid, with what was found in their models. Jumps beyond doubt come first. Those that have the
    quantity's pattern are its own."""
    dt = max((state.dt for state in states.values()), default=1.0)
    block = max(1, round(MEANS_S / dt))
    found = {name: _means(state, block) for name, state in states.items() if not state.below_lattice}
    found = {name: y for name, y in found.items() if np.isfinite(y).mean() > 1.0 - GAPS}
    if len(found) < LEAST_AXES or min(y.size for y in found.values()) < LEAST:
        return None
    y = np.array(list(found.values()))
    scale = np.array([np.nanstd(np.diff(row)) for row in y]) / math.sqrt(2.0)
    y = (y - np.nanmean(y, axis=1)[:, None]) / scale[:, None]
    span = block * dt
    y = np.where(np.isfinite(y), without_lines(np.array([_bridged(row) for row in y])), np.nan)
    if not _worth(*_both(y, span), len(found)):
        return None
    sure, calm = _jumps(fitted(_bins(y), span, False), y, CERTAIN)
    null, model = _both(calm, span)
    gain = course(model, calm).ln_likelihood - course(null, calm).ln_likelihood
    if not _worth(null, model, len(found)) or net(gain, len(found) + 1, LN_LOOKS) < NET_LEAST:
        return None
    kept = [one for one in sure if _alike(one, model.loading) < PATTERN]
    for one in kept:
        y[:, one.at :] -= one.size[:, None]
    at = range(len(found))
    columns = np.array([_of_others(model, y, [k for k in at if k != one]) for one in at])
    return Hidden(tuple(found), model, null, y, scale, span, gain, columns)


def _both(y: Array, dt: float) -> tuple[Joint, Joint]:
    """The models without the quantity and with it."""
    bins = _bins(y)
    null = fitted(bins, dt, False)
    return null, fitted(bins, dt, True, null)


def _worth(null: Joint, model: Joint, axes: int) -> bool:
    return net(model.value - null.value, axes + 1, LN_LOOKS) >= NET_LEAST


def _bins(y: Array) -> Bins:
    return bins_of(np.array([_bridged(row) for row in y]))


def _alike(jump: Jump, loading: Array) -> float:
    """Share of a jump's information that one size of the quantity explains: 1 where it has the loadings' pattern."""
    held = np.isfinite(jump.sd)
    if held.sum() < 2:
        return 0.0
    a, b, weight = jump.size[held], loading[held], jump.sd[held] ** -2.0
    return float((weight * a * b).sum() ** 2 / ((weight * a**2).sum() * max((weight * b**2).sum(), 1e-300)))


def _jumps(model: Joint, y: Array, least: float) -> tuple[list[Jump], Array]:
    """Jumps of two axes or more with this much evidence, and the records less them. One of a single axis is left to
    the axis. One that is the quantity's own (`Course.of_f`) is passed over."""
    found: list[Jump] = []
    y = y.copy()
    passed = np.zeros(y.shape[1], bool)
    edge = max(4, y.shape[1] // 200)
    passed[:edge] = passed[-edge:] = True
    for _ in range(JUMPS):
        seen = course(model, y, smooth=True)
        gains = np.where(passed, 0.0, seen.of_levels)
        at = int(np.argmax(gains))
        one = jump(seen, at, y.shape[1])
        if one.evidence < least:
            break
        held = np.isfinite(one.sd)
        passed[max(0, at - 3) : at + 4] = True
        if held.sum() < 2 or seen.of_f[max(0, at - 2) : at + 3].max() > PATTERN * gains[at]:
            continue
        found.append(one)
        y[:, at:] -= one.size[:, None]
    return found, y


def _bridged(row: Array) -> Array:
    there = np.flatnonzero(np.isfinite(row))
    return np.interp(np.arange(row.size), there, row[there])


def _of_others(model: Joint, y: Array, others: Sequence[int]) -> Array:
    return course(model.of(others), y[list(others)], smooth=True).states[:, 0]


def held_out(hidden: Hidden, name: str, unit: str, factor: float) -> dict[str, Any]:
    """What the quantity gains an axis in the second half, by models of the first half: the score of each mean, and the
    bias at each horizon, predicted from the past of all axes."""
    before, after = hidden.halves
    axis, half = hidden.names.index(name), hidden.y.shape[1] // 2
    scores = np.array([one.scores()[half:, axis] for _, one in (before, after)])
    scores = scores[:, np.isfinite(scores).all(axis=0)]
    pieces = [part.mean() for part in np.array_split(scores[1] - scores[0], PIECES)]
    factor *= float(hidden.scale[axis])
    rmse: dict[str, dict[str, float]] = {}
    for horizon in HORIZONS_S:
        steps = max(1, round(horizon / hidden.dt))
        read = hidden.y[axis, half + steps - 1 :]
        errors = [ahead(model, one, steps)[half : half + read.size, axis] - read for model, one in (before, after)]
        good = np.isfinite(errors[0]) & np.isfinite(errors[1])
        if good.sum() < LEAST // 10:
            continue
        rms = [factor * math.sqrt(float((error[good] ** 2).mean())) for error in errors]
        parts = np.array([[part.mean() for part in np.array_split(error[good] ** 2, 8)] for error in errors])
        sd = factor**2 * float(np.std(parts[1] - parts[0], ddof=1)) / math.sqrt(8.0) / max(sum(rms), 1e-300)
        rmse[f"{horizon:g}"] = {"before": rms[0], "after": rms[1], "sd": sd}
    level = float(scores[0].mean()) - math.log(factor)
    more = float((scores[1] - scores[0]).mean())
    return {
        "log_score_per_sample": {
            "before": level,
            "after": level + more,
            "sd": float(np.std(pieces, ddof=1)) / math.sqrt(PIECES),
            "samples": scores.shape[1],
        },
        "bias_rmse": {"unit": unit, "horizon_s": rmse},
    }


def entry(hidden: Hidden, states: Mapping[str, State], units: Mapping[str, str], start_s: float) -> dict[str, Any]:
    """The finding of the document, in the `units` of the recording's columns. `start_s`: where the record begins."""
    axes: dict[str, Any] = {}
    scores = []
    for name in hidden.names:
        state = states[name]
        gain, fit = state.with_columns(hidden.column(name, state.y.size, state.dt))
        size, sd = float(fit.c[-1]), float(fit.sd[-1])
        factor = unit_module.factor(state.unit, units[name])
        known = held_out(hidden, name, units[name], factor)
        score = known["log_score_per_sample"]
        scores.append((score["samples"] * (score["after"] - score["before"]), score["samples"] * score["sd"]))
        ln_odds = math.log(P_ACTS / (1.0 - P_ACTS)) + gain - math.log1p(abs(size) / sd)
        axes[name] = {
            "estimate": {"loading": interval(size * factor, sd * factor, units[name]), "share": hidden.share(name)},
            "probability": 1.0 / (1.0 + math.exp(-max(-700.0, min(700.0, ln_odds)))),
            "gain": known,
        }
    more, sd = sum(one for one, _ in scores), math.sqrt(sum(each**2 for _, each in scores))
    acting = {name: one for name, one in axes.items() if one["probability"] >= 0.5}
    jumps = [{**one, "time_s": one["time_s"] + start_s} for one in hidden.jumps]
    tau_s = hidden.dt / hidden.model.rate
    estimate = {"law": "gauss_markov", "time_constant_s": tau_s, "jumps": jumps}
    return {
        "id": ID,
        "cause": ID,
        "words": _sentence(acting, jumps, tau_s),
        "estimate": estimate,
        "axes": acting,
        "evidence_nats": hidden.gain,
        "net_nats": hidden.net,
        "confirmed": bool(more > HARM_SD * sd),
        "also_possible": ["temperature", "supply"],
        "record_next": "Record the temperature at the sensor and its supply voltage.",
    }


def _sentence(axes: Mapping[str, Any], jumps: Sequence[Mapping[str, float]], time_constant_s: float) -> str:
    shares = ", ".join(f"{name} {100.0 * one['estimate']['share']:.0f} %" for name, one in axes.items())
    times = ", ".join(f"{one['time_s']:.0f}" for one in jumps)
    jumped = f" It jumps at {times} s." if jumps else ""
    return (
        f"One quantity that nobody recorded moves {len(axes)} axes together, over some {time_constant_s:.2g} s. "
        f"Its share of each axis' drift: {shares}.{jumped}"
    )


def carried(hidden: Hidden, states: Mapping[str, State]) -> dict[str, Any] | None:
    """What the quantity gains on a second recording by the models of the first, all axes together; None: it has not the
    axes. `states`: of the second recording."""
    if not set(hidden.names) <= states.keys():
        return None
    block = max(1, round(hidden.dt / states[hidden.names[0]].dt))
    y = np.array([_blocks(states[name].y, block) for name in hidden.names]) / hidden.scale[:, None]
    y = np.where(np.isfinite(y), without_lines(np.array([_bridged(row) for row in y])), np.nan)
    scores = [np.nansum(course(model, y).scores(), axis=1) for model in (hidden.null, hidden.model)]
    more = course(hidden.model, y).ln_likelihood - course(hidden.null, y).ln_likelihood
    n = float(np.isfinite(y).any(axis=0).sum())
    pieces = [part.mean() for part in np.array_split(scores[1] - scores[0], PIECES)]
    sd = float(np.std(pieces, ddof=1)) / math.sqrt(PIECES)
    before = float(scores[0].mean())
    score = {"before": before, "after": before + more / n, "sd": sd, "samples": int(n)}
    return {"log_score_per_sample": score}


def own_laws(hidden: Hidden) -> dict[str, dict[str, Any]]:
    """By axis the drift that it has beside the quantity, as `simulate` in a model file has it: the larger of a walk and
    a Gauss-Markov process over half the record."""
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


def stated(hidden: Hidden) -> dict[str, Any]:
    """The model file's entry, in the units of its groups: law, loadings and the correlation of the white noise."""
    pairs = [(one, two) for k, one in enumerate(hidden.names) for two in hidden.names[k + 1 :]]
    alpha = hidden.model.rate / hidden.dt
    return {
        "law": [{"kind": "markov", "deviation": digits(1.0 / hidden.step), "alpha": digits(alpha)}],
        "loadings": {name: digits(hidden.loading(name)) for name in hidden.names},
        "noise_correlation": {f"{one}-{two}": digits(hidden.correlation(one, two), 3) for one, two in pairs},
    }
