"""What a finding gains on held-out time: the evidence of the second half, each sample predicted from the past only.

The prediction is over the posterior that the earlier samples leave. Coefficients have the prior of an extended model
file, the white noise has none. The drift's parameters are a sum over nodes that the whole record leaves possible.
What no posterior covers is looked for anew in the first half (`Cause.trained`), if a single axis shows it. A column
that is nothing in the first half was chosen by what is scored, so the price of its search is charged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln, logsumexp, softmax

from selfcal.base.grid import Array, Mask, Rows
from selfcal.base.units import FLICKER_FLOOR
from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.extend import WIDE_PRIOR
from selfcal.diagnosis.record import Record
from selfcal.likelihood.fit import passed, run
from selfcal.likelihood.heldout import HORIZONS_S, SCORE_PIECES, HeldOut, error_entry, score_entry, sd_of_mean
from selfcal.likelihood.state import Look, Sequential, State
from selfcal.likelihood.statemodel import matrices

#: Samples to score, and between the first and the last prediction, at least.
SCORED_LEAST = 30
#: Length of the mean that is the bias, s.
BIAS_S = 60.0


@dataclass(frozen=True)
class Cut:
    """The scored time: `edges` [pieces + 1], samples that count of each piece `sizes`, and places `marks` among which
    the pieces lie, where the samples that are left `out` [n] of either model begin and end too: neither scores them."""

    edges: Rows
    marks: Rows
    sizes: Rows
    out: Mask

    def scores(self, ln_evidence: Array) -> Array:
        """Log score a sample [pieces] from ln evidence at the marks."""
        steps = np.where(self.out[self.marks[:-1]], 0.0, np.diff(ln_evidence))
        return np.asarray(np.add.reduceat(steps, np.searchsorted(self.marks, self.edges[:-1])) / self.sizes)


def gain(
    look: Look, before: State, after: State, record: Record, partner: State | None = None, *, located: bool = False
) -> HeldOut:
    """What a finding gains. `partner`: the axis that shares the cause. `located`: several axes show its shape, which
    the first half of an axis alone hardly does."""
    cause = CAUSES[look.cause]
    if cause.score.no_gain:
        return HeldOut(None, cause.score.no_gain)
    n = before.y.size
    split = n // 2
    joint = cause.score.together is not None and partner is not None
    if before is after and not joint:
        return HeldOut(None, "the readings are left out before and after: the model of the noise is the same")
    if cause.score.trained is not None and look.when is not None:
        place = round(look.when[0] * record.rate_hz)
        if place > split - max(20, n // 20):
            split = place + max(20, (n - place) // 4)
        if n - split < max(60, n // 20):
            return HeldOut(None, "too little of the record is left after its detection")
    if cause.score.trained is not None and not located:
        after = cause.score.trained(look, before, after, record, split)
    cut = _cut(before, partner if joint and partner is not None else after, split)
    if cut is None:
        return HeldOut(None, "too few samples are left to score")
    if cause.score.together is not None and partner is not None:
        # The joint log score of two axes less the other axis' own is the first axis' score given the other.
        old = _sequential(before, cut.marks, {})
        more, sd = cause.score.together(before.whitened, partner.whitened, before.dt, split, look.estimate)
        scores = cut.scores(old[0])
        return _held_out(cut, scores, scores + more, sd, before.unit, {})
    horizons = _horizons(before.dt, n, split)
    cut = replace(cut, marks=np.union1d(cut.marks, np.concatenate([*horizons.values(), cut.edges])))
    old, new = (_sequential(state, cut.marks, horizons) for state in (before, after))
    scores, later = cut.scores(old[0]), cut.scores(new[0])
    added = _added(before, after)
    if added and not any(column[:split].any() for column in added):
        # Columns that are nothing before the scored samples pay for the search where they begin.
        first = split + min(int(np.argmax(column[split:] != 0.0)) for column in added)
        piece = int(np.searchsorted(cut.edges, first, "right")) - 1
        later[piece] -= max(0.0, look.gain - look.net) / cut.sizes[piece]
    return _held_out(cut, scores, later, sd_of_mean(later - scores), before.unit, _errors(after, old, new, horizons))


def _held_out(
    cut: Cut, before: Array, after: Array, sd: float, unit: str, ahead: Mapping[str, Mapping[str, float]]
) -> HeldOut:
    """The contract's `gain` from the scores of the pieces."""
    share = cut.sizes / cut.sizes.sum()
    entry = score_entry(float(before @ share), float(after @ share), sd, cut.sizes.sum())
    return HeldOut({**entry, "bias_rmse": {"unit": unit, "horizon_s": ahead}})


def _cut(before: State, after: State, split: int) -> Cut | None:
    """The scored time in pieces of equal size; None: too few samples are left."""
    n = before.y.size
    there = [np.isfinite(state.y) for state in (before, after)]
    kept = split + np.flatnonzero((there[0] & there[1])[split:])
    if kept.size < SCORED_LEAST:
        return None
    pieces = np.array_split(kept, SCORE_PIECES)
    edges = np.array([split, *(piece[0] for piece in pieces[1:]), n])
    out = there[0] != there[1]
    changes = split + 1 + np.flatnonzero(np.diff(out[split:]))
    return Cut(edges, np.union1d(edges, changes), np.array([piece.size for piece in pieces]), out)


def _horizons(dt: float, n: int, split: int) -> dict[float, Rows]:
    """Samples from which the bias is predicted, for each horizon that has enough."""
    places = np.unique(np.linspace(split, n - 1, 300).astype(np.int64))
    found = {horizon: places[places <= n - _ahead(horizon, dt) - _window(dt)] for horizon in HORIZONS_S}
    return {horizon: each for horizon, each in found.items() if each.size and each[-1] - split >= SCORED_LEAST}


def _ahead(horizon: float, dt: float) -> int:
    return max(1, round(horizon / dt))


def _window(dt: float) -> int:
    """Samples of the mean that is the reading of a bias: 1 s."""
    return max(1, round(1.0 / dt))


def _added(before: State, after: State) -> list[Array]:
    """The columns that a finding has added."""
    known = {regressor.name for regressor in before.regressors}
    return [column.values for column in after.regressors if column.name not in known]


def _prior(state: State) -> Array:
    """Prior sd of each column's coefficient over the white noise; infinite for the bias."""
    c, sd = np.abs(state.best.c[1:]), state.best.sd[1:]
    return np.array([math.inf, *np.maximum(WIDE_PRIOR * (c + 2.0 * sd) / state.best.sigma, 1e-12)])


def _posterior(G: Array, D: Array, n: Array, prior: Array) -> tuple[Array, Array]:
    """ln evidence [m] and mean of the coefficients [m, p] from the sums up to each mark.

    The priors of the coefficients are normal, that of the bias is flat, and that of the white noise 1/sigma."""
    good = np.isfinite(G).all(axis=(1, 2))
    G[~good] = np.eye(prior.size + 1)
    A, b = G[:, 1:, 1:] + np.diag(prior**-2.0), G[:, 1:, 0]
    size = np.sqrt(np.diagonal(A, axis1=1, axis2=2))
    scaled = A / (size[:, :, None] * size[:, None, :])
    c = np.linalg.solve(scaled, (b / size)[:, :, None])[:, :, 0] / size
    rss = np.maximum(G[:, 0, 0] - (b * c).sum(axis=1), 1e-300)
    volume = 2.0 * (np.log(size).sum(axis=1) + np.log(prior[1:]).sum()) + np.linalg.slogdet(scaled)[1]
    half = 0.5 * (n - 1.0)
    return np.where(good, gammaln(half) - half * np.log(math.pi * rss) - 0.5 * (D + volume), -math.inf), c


def _sequential(state: State, marks: Rows, horizons: Mapping[float, Rows]) -> Sequential:
    """The model of a state: a sum over nodes of the drift, with the weights that the samples before a mark leave them.

    The nodes are what the whole record leaves possible. The state keeps its sums: the next finding is scored against
    them."""
    key = marks.tobytes()
    if key in state.sequential:
        return state.sequential[key]
    series, prior, window = state.series, _prior(state), _window(state.dt)
    nodes = list(state.possible(state.none, rich=False))
    ln_evidence = np.empty((len(nodes), marks.size))
    bias = {horizon: np.empty((len(nodes), places.size)) for horizon, places in horizons.items()}
    total = np.cumsum(np.pad(series.columns, ((0, 0), (1, 0))), axis=1)
    for k, (fit, theta, ln_share) in enumerate(nodes):
        G, D, n, x, _, _ = passed(series, fit.terms, theta, marks.tolist())
        value, c = _posterior(G, D, n, prior)
        ln_evidence[k] = value + ln_share
        m = matrices(fit.terms, theta, series.dt, series.duration_s, series.block)
        drift = x[:, 0] - np.einsum("mp,mps->ms", c, x[:, 1:])
        for horizon, places in horizons.items():
            ahead, at = _ahead(horizon, state.dt) - 1, np.searchsorted(marks, places)
            column = (total[:, places + ahead + window] - total[:, places + ahead]) / window
            forward = m.h @ np.linalg.matrix_power(m.F, ahead)
            bias[horizon][k] = drift[at] @ forward + (c[at] * column.T).sum(axis=1)
    weight = softmax(ln_evidence, axis=0)
    predicted = {
        horizon: (weight[:, np.searchsorted(marks, places)] * bias[horizon]).sum(axis=0)
        for horizon, places in horizons.items()
    }
    state.sequential[key] = logsumexp(ln_evidence, axis=0), predicted
    return state.sequential[key]


def _errors(
    state: State, old: Sequential, new: Sequential, horizons: Mapping[float, Rows]
) -> dict[str, dict[str, float]]:
    """Root mean square of predicted minus read bias at each horizon; the reading is a mean of 1 s from there on."""
    window = _window(state.dt)
    found: dict[str, dict[str, float]] = {}
    for horizon, places in horizons.items():
        first = places + _ahead(horizon, state.dt) - 1
        read = np.array([_mean(state.y[at : at + window]) for at in first])
        row = error_entry(old[1][horizon] - read, new[1][horizon] - read)
        if row is not None:
            found[f"{horizon:g}"] = row
    return found


def _mean(values: Array) -> float:
    good = values[np.isfinite(values)]
    return float(good.mean()) if good.size else math.nan


def numbers(state: State) -> dict[str, float]:
    """N, K and B of plain white noise and random walk fitted with the model of a state, in the axis' unit; 0 where
    the record shows none, of N where the walk takes all. B is that of the model's flicker noise, else by the minimum of
    the Allan deviation."""
    plain, best = next(fit for fit in state.fits if fit.terms.walk), state.best
    N, K = 0.0 if plain.drowned else plain.N_of_color, plain.K
    # Drop a walk that moves less over the record than three times the mean's white noise.
    if not K * plain.duration_s > 3.0 * N:
        K = 0.0
    if best.terms.flicker:
        B = best.sigma * math.exp(best.value("ln_flicker"))
        # Drop flicker noise that is below the white noise of half the record.
        return {"N": N, "K": K, "B": B * (B * FLICKER_FLOOR * math.sqrt(0.5 * plain.duration_s) > N)}
    return {"N": N, "K": K, "B": math.sqrt(2.0 * N * K / math.sqrt(3.0)) / FLICKER_FLOOR}


def bias_ahead(state: State) -> float:
    """Mean of the predicted bias over the next BIAS_S, without the level, in the axis' unit: lines and bands have
    averaged out, the drift has not. Of the columns events stay as they ended, and channels are at their reference."""
    fit = state.best
    m = matrices(fit.terms, fit.theta, state.dt, state.series.duration_s, state.block)
    x = run(state.series, fit.terms, fit.theta)[0][-1].x
    total, step, count = np.eye(len(m.F)), m.F, 1
    while count * state.dt < BIAS_S:
        total, step, count = total + step @ total, step @ step, 2 * count
    events = [
        c * column.values[-1]
        for c, column in zip(fit.c[1:], state.regressors, strict=True)
        if column.cause in CAUSES and CAUSES[column.cause].score.once
    ]
    return float(fit.c[0] + sum(events) + (x[0] - fit.c @ x[1:]) @ (m.h @ total) / count)


def inflation(before: State, after: State) -> Mapping[str, float]:
    """Factors by which `numbers` are off for want of a cause: fitted without it over with. Infinite: with it the record
    shows none."""
    if before is after:
        return dict.fromkeys(("N", "K", "B"), 1.0)
    old, new = numbers(before), numbers(after)
    return {name: old[name] / new[name] if new[name] else math.inf if old[name] else 1.0 for name in new}
