"""How an axis answers to a channel: the transfer function between two recorded columns.

Parametric: output = bias + G(s) input + drift + white noise, by prediction error. The drift is a walk or Gauss-Markov
noise, refitted with each structure of G; so the model is Box and Jenkins's with a first or second order. Empirical:
the ratio of multitaper spectra, with no model at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import detrend, lfilter, windows
from scipy.stats import t

from selfcal.diagnosis.forms import LN_SLOW, LONGEST_LAG, inconstancy
from selfcal.diagnosis.record import smoothed
from selfcal.likelihood.fit import Fit, Sums, ln_det, ln_likelihood, refit, run
from selfcal.likelihood.state import ALIKE, NET_LEAST, State, net
from selfcal.likelihood.statemodel import DRIFT_SIZES, Array
from selfcal.model.forms import slope

Complex = NDArray[np.complex128]
#: Probability of an interval.
PROBABILITY = 0.9
#: Windows of a rate, s; the numbers of a lag are a factor 2 apart, then finer in so many passes.
RATE_WINDOWS_S = (0.0, 5.0, 20.0, 60.0, 150.0)
ZOOMS, FINER = 3, 8
#: Time constants that stand for the posterior, over those within so many nats of the best one; draws of it.
FINE, POSSIBLE, DRAWS = 21, 6.0, 4000
#: Steps of the drift's parameters at least and at most, and nodes of one drift at most.
NODE_STEPS, NODES_MOST = (0.05, 0.7), 150
#: ln of the number of independent looks: ten structures and their numbers.
LN_STRUCTURES = math.log(28.0)
#: Structures within so many nats of the best are scored beside a drift of two terms.
NEAR = 10.0
#: Tapers of the empirical spectra, their half bandwidth in bins, and the bands of a decade.
TAPERS, HALF_WIDTH, BANDS_OF_A_DECADE = 3, 2.5, 8
#: Both columns lose their slow power below this bin first: a spectrum as steep as a temperature's would fill the bands
#: beside its own. The ratio stays.
CORNER = 20.0


@dataclass(frozen=True)
class Input:
    """An input: `values` [n] about its `reference` in `unit`. `noises` [k, n]: drawn noise of its readings, empty where
    the readings act themselves. `widths_s`: means that may smooth that noise; centred, so that they have no lag.
    `held_s`: from one reading of a held input to the next, `taken` in words as which its readings were taken."""

    values: Array
    unit: str
    reference: float = 0.0
    noises: Array = field(default_factory=lambda: np.empty((0, 0)))
    widths_s: tuple[float, ...] = (0.0,)
    held_s: float = 0.0
    taken: str = ""


@dataclass(frozen=True)
class Structure:
    """A form of the influence. `columns(number)` [k, n] are what its k coefficients multiply, `keys` their names;
    `numbers` the smoothings, windows or time constants to try, s. `transfer(c, number, s)` is G(s), of a curve its
    slope at the reference. `poles`: its order."""

    name: str
    poles: int
    keys: tuple[str, ...]
    numbers: tuple[float, ...]
    columns: Callable[[float], Array]
    transfer: Callable[[Array, Array, Complex], Complex]

    @property
    def own(self) -> int:
        """Coefficients of the input; the others are of its state at the start of the record."""
        return sum(not key.startswith("start") for key in self.keys)


@dataclass(frozen=True)
class Tried:
    """A structure at its best number: gain of ln likelihood, its score (half BIC, nats), and the fit. `seen`: every
    number tried, with its score at the fit's drift."""

    structure: Structure
    number: float
    gain: float
    score: float
    fit: Fit
    seen: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Posterior:
    """Draws of a structure's numbers: coefficients `c` [draws, k] and time constant `lag` [draws], s."""

    structure: Structure
    c: Array
    lag: Array

    def at(self, frequency_hz: Array) -> Complex:
        """G [draws, f]."""
        s = np.asarray(2j * np.pi * frequency_hz, np.complex128)
        return self.structure.transfer(self.c[:, :, None], self.lag[:, None], s[None, :])

    @property
    def delay_s(self) -> Array:
        """[draws]: how late slow changes arrive, s: the slope of the phase at frequency 0."""
        slowest = np.array([1e-6 / (2.0 * math.pi * max(1.0, float(self.lag.max(initial=0.0))))])
        return np.asarray(-np.angle(self.at(slowest) / self.at(np.zeros(1)))[:, 0] / (2.0 * math.pi * slowest[0]))


def structures(u: Array, dt: float, widths_s: Sequence[float]) -> list[Structure]:
    """Every structure for an input [n] with its samples dt s apart, smoothed by means of `widths_s`."""
    span = u.size * dt
    lags = _lags(u.size, dt)
    windows_s = tuple(dict.fromkeys(max(one, dt) for one in RATE_WINDOWS_S if one <= span / 6.0))
    widths = tuple(one for one in widths_s if one <= span / 10.0)

    def level(width: float) -> Array:
        return smoothed(u, max(1, round(width / dt)))

    def behind(lag: float) -> Array:
        return late(u, lag, dt)

    def decay(lag: float) -> Array:
        # A lag begins at rest; before the record the input may have moved.
        gone: Array = np.exp(-np.arange(u.size) * dt / lag)
        return gone

    middle = widths[len(widths) // 2]
    return [
        Structure("static", 0, ("gain",), widths, lambda w: level(w)[None], lambda c, _, s: c[:, 0] + 0.0 * s),
        Structure("rate", 0, ("rate",), windows_s, lambda w: slope(u, w, dt)[None], lambda c, _, s: c[:, 0] * s),
        Structure(
            "static and rate", 0, ("gain", "rate"), windows_s,
            lambda w: np.array([level(middle if w > dt else 0.0), slope(u, w, dt)]),
            lambda c, _, s: c[:, 0] + c[:, 1] * s,
        ),
        Structure(
            "square", 0, ("gain", "square"), widths,
            lambda w: np.array([(value := level(w)), value**2]), lambda c, _, s: c[:, 0] + 0.0 * s,
        ),
        Structure(
            "cube", 0, ("gain", "square", "cube"), widths,
            lambda w: np.array([(value := level(w)), value**2, value**3]), lambda c, _, s: c[:, 0] + 0.0 * s,
        ),
        Structure(
            "late rate", 1, ("rate", "start"), lags,
            lambda lag: np.array([(u - behind(lag)) / lag, decay(lag)]),
            lambda c, lag, s: c[:, 0] * s / (1.0 + lag * s),
        ),
        Structure(
            "lag", 1, ("gain", "start"), lags,
            lambda lag: np.array([behind(lag), decay(lag)]), lambda c, lag, s: c[:, 0] / (1.0 + lag * s),
        ),
        Structure(
            "lag and direct", 1, ("gain", "direct", "start"), lags,
            lambda lag: np.array([(slow := behind(lag)), u - slow, decay(lag)]),
            lambda c, lag, s: (c[:, 0] + c[:, 1] * lag * s) / (1.0 + lag * s),
        ),
        Structure(
            "lag and square", 1, ("gain", "square", "start", "start_square"), lags,
            lambda lag: np.array([(slow := behind(lag)), slow**2, (gone := decay(lag)), gone * slow]),
            lambda c, lag, s: c[:, 0] / (1.0 + lag * s),
        ),
        Structure(
            "second order", 2, ("gain", "start", "start_rate"), lags,
            lambda lag: np.array([
                late(behind(lag), lag, dt), (gone := decay(lag)), gone * np.arange(u.size) * dt / lag
            ]),
            lambda c, lag, s: c[:, 0] / (1.0 + lag * s) ** 2,
        ),
    ]  # fmt: skip


def late(values: Array, lag_s: float, dt: float) -> Array:
    """[n]: `values` [n] behind a first-order lag, at rest at the first one.

    Exact for samples between which the input moves on straight lines, and for means over each interval of an input that
    is constant there. A module's lag takes each sample for the whole interval before it: half an interval less."""
    kept = math.exp(-dt / lag_s)
    mean = -lag_s / dt * math.expm1(-dt / lag_s)
    about = values - values[0]
    return np.asarray(values[0] + lfilter([1.0 - mean, mean - kept], [1.0, -kept], about))


def tried(state: State, structure: Structure) -> Tried:
    """The best number of a structure; those of a pole are then looked for between the grid's."""
    drifts = [state.best, *state.stiffer(1.5)]
    blocks = [structure.columns(one) for one in structure.numbers]
    scores = np.max([state.scores(blocks, at) for at in drifts], axis=0)
    number = structure.numbers[int(np.argmax(scores))]
    _, fit = state.with_columns(structure.columns(number))
    seen = dict(zip(structure.numbers, state.scores(blocks, fit), strict=True))
    factor = 2.0
    for _ in range(ZOOMS if structure.poles else 0):
        middle = max(seen, key=lambda one: seen[one])
        more = [float(x) for x in middle * factor ** np.linspace(-1.0, 1.0, FINER)]
        seen |= dict(zip(more, state.scores([structure.columns(one) for one in more], fit), strict=True))
        factor **= 2.0 / (FINER - 1)
    number = max(seen, key=lambda one: seen[one])
    gain, fit = state.with_columns(structure.columns(number))
    free = len(structure.keys) + (structure.poles > 0)
    score = gain - 0.5 * free * math.log(fit.n)
    return Tried(structure, number, gain, score, fit, tuple(sorted(seen.items())))


def beside_two_terms(state: State, found: Sequence[Tried]) -> list[Tried]:
    """The structures with scores beside a drift of two terms, and the fit with that drift where it is clearly better.

    A drift of one term that follows quick errors of a structure leaves slow columns some nats of their own."""
    if state.extras.flicker:
        return list(found)
    best = max(found, key=lambda one: one.score)
    base = max(state.rich.ln_likelihood, state.best.ln_likelihood)

    def refitted(one: Tried) -> tuple[Fit, float]:
        fit = refit(state.series.beside(one.structure.columns(one.number)), state.rich)
        clearly = fit.ln_likelihood > one.fit.ln_likelihood + ALIKE
        return fit if clearly else one.fit, fit.ln_likelihood - base - one.gain

    of_best = refitted(best)[1]
    near = [refitted(one) if one.score > best.score - NEAR else (one.fit, of_best) for one in found]
    return [replace(one, score=one.score + more, fit=fit) for one, (fit, more) in zip(found, near, strict=True)]


def worth(state: State, one: Tried) -> float:
    """Evidence of an influence, -ln p: net of the search, and of an input's decay that any drift might have."""
    columns = one.structure.columns(one.number)
    own = one.structure.own
    start = max(0.0, state.with_columns(columns[own:])[0]) if own < len(columns) else 0.0
    gain = min(one.gain, state.rich_gain(columns)) - start
    return net(gain, own + (one.structure.poles > 0), LN_STRUCTURES + own * LN_SLOW)


def posterior(state: State, one: Tried, undistorted: Array, seed: int = 1) -> Posterior:
    """Draws over coefficients, the time constant, and the drift: every near one, and its parameters."""
    structure = one.structure
    drifts = list(_drifts(state, structure.columns(one.number), one.fit))
    grid = np.array([one.number])
    if structure.poles:
        # The largest drift that is possible leaves most time constants possible.
        fit, theta, _ = max(drifts, key=lambda node: node[2])
        numbers, scores = np.array(one.seen).T
        largest = state.scores([structure.columns(float(x)) for x in numbers], replace(fit, theta=theta))
        near = (scores > scores.max() - POSSIBLE) | (largest > largest.max() - POSSIBLE)
        inside = np.flatnonzero(near)
        low, high = numbers[max(inside[0] - 1, 0)], numbers[min(inside[-1] + 1, numbers.size - 1)]
        grid = np.geomspace(low, high, FINE)
    blocks = [structure.columns(float(number)) for number in grid]
    k = len(blocks[0])
    ln_weight, means, roots, places = [], [], [], []
    for fit, theta, ln_share in drifts:
        for place, sums in enumerate(state.sums(fit.terms, theta, blocks)):
            c, inverse, rss = sums.coefficients()
            values, vectors = np.linalg.eigh(rss / sums.n * inverse[-k:, -k:])
            ln_weight.append(ln_share + _ln_weight(sums))
            means.append(c[-k:])
            roots.append(vectors * np.sqrt(np.maximum(values, 0.0)))
            places.append(place)
    random = np.random.default_rng(seed)
    weight = np.exp(np.array(ln_weight) - max(ln_weight))
    drawn = random.choice(weight.size, DRAWS, p=weight / weight.sum())
    z = random.standard_normal((DRAWS, k))
    c = np.array(means)[drawn] + np.einsum("dij,dj->di", np.array(roots)[drawn], z)
    # Within a cell of the grid any number is as likely.
    cell = math.log(grid[1] / grid[0]) if grid.size > 1 else 0.0
    lag = grid[np.array(places)[drawn]] * np.exp(cell * random.uniform(-0.5, 0.5, DRAWS))
    return Posterior(structure, c[:, : structure.own] @ undistorted.T, lag)


def _ln_weight(sums: Sums) -> float:
    """ln likelihood with every coefficient integrated out. At its maximum, columns like a drift would leave too little
    of the drift."""
    _, inverse, rss = sums.coefficients()
    return ln_likelihood(sums) + 0.5 * ln_det(rss / sums.n * inverse)


def _drifts(state: State, block: Array, known: Fit) -> Iterator[tuple[Fit, Array, float]]:
    """Parameters of every drift that the record leaves possible beside columns [k, n], on a lattice about each
    fit, and ln of the prior share of each. `known`: the structure's; of two terms it is taken alone.

    A size is as likely as any other up to the largest. Uniform in its logarithm, most weight would be on no drift at
    all wherever the record hardly shows one, and intervals of slow coefficients would be too narrow."""
    fits = [state.fitted_with(terms, block) for terms in state.bases()]
    fits = fits if known.terms in state.bases() else [known]
    walk = max(one.ln_likelihood for one in fits if one.terms.walk)
    for fit in fits:
        terms = fit.terms
        if not terms.walk and fit.ln_likelihood < walk + ALIKE:
            continue  # it would forget: of two that fit alike the walk leaves slow coefficients the wider interval
        low, high = np.array(terms.limits(state.dt)).reshape(-1, 2).T
        steps = np.clip(np.linalg.norm(fit.spread, axis=1), *NODE_STEPS)
        is_size = np.array([name in DRIFT_SIZES for name in terms.names])
        volume = float(np.log(steps / np.where(is_size, 1.0, high - low)).sum()) + 0.5 * math.log(fit.n) * terms.walk
        found: dict[tuple[int, ...], float] = {}
        waiting = [(0,) * steps.size]
        while waiting and len(found) < NODES_MOST:
            place = waiting.pop(0)
            theta = fit.theta + steps * place
            if place in found or np.any((theta < low - 1e-9) | (theta > high + 1e-9)):
                continue
            sums = next(iter(state.sums(terms, theta, [block])))
            found[place] = _ln_weight(sums) + float(theta[is_size].sum())
            if found[place] > max(found.values()) - POSSIBLE:
                moves = [(j, way) for j in range(steps.size) for way in (1, -1)]
                waiting += [tuple(x + way * (i == j) for i, x in enumerate(place)) for j, way in moves]
        most = max(found.values())
        for place, value in found.items():
            if value > most - POSSIBLE:
                theta = fit.theta + steps * place
                yield fit, theta, volume + float(theta[is_size].sum())


def undistorted(state: State, given: Input, one: Tried) -> Array:
    """[k, k]: what the coefficients of an input that was smoothed become for the input itself.

    The smoothed columns z are instruments for the plain ones x: c = (z x)^-1 (z z) c_z. Readings of what acts have a
    noise of their own, which is in z x as well: it is drawn anew and taken out. In powers it is neglected."""
    number, own = one.number, one.structure.own
    plain = one.structure.numbers[0] if one.structure.poles == 0 else number
    inputs = [given.values, *given.noises]
    pairs = []
    for values in inputs:
        same = next(each for each in structures(values, state.dt, given.widths_s) if each.name == one.structure.name)
        pairs += [same.columns(number)[:own], same.columns(plain)[:own]]
    rest = one.structure.columns(number)[own:]
    series = state.series.beside(np.vstack([*([rest] if len(rest) else []), *pairs]))
    G = run(series, one.fit.terms, one.fit.theta)[0][0].G[1:, 1:]
    known = len(G) - 2 * own * len(inputs)
    left = G[known:, :known] @ np.linalg.pinv(G[:known, :known], rcond=1e-12, hermitian=True) @ G[:known, known:]
    cross = G[known:, known:] - left

    def of(k: int, i: int, j: int) -> Array:
        at = 2 * own * k
        return cross[at + i * own : at + (i + 1) * own, at + j * own : at + (j + 1) * own]

    noise = sum(of(k, 0, 1) for k in range(1, len(inputs))) / max(1, len(inputs) - 1)
    found: Array = np.linalg.pinv(of(0, 0, 1) - noise) @ of(0, 0, 0)
    return found


def source(state: State, u: Array, one: Tried, drawn: Posterior, *, acts_back: bool) -> tuple[str, str]:
    """Whether the record tells that the input acts: "input first" or "cannot tell", and the reason in words.
    `acts_back`: the output may act on the input. No axis acts on a temperature or a supply.

    A common cause that reaches the input first, and all of it, always looks as the input does."""
    feedback = "feedback, or a common cause" if acts_back else "a common cause"
    columns = one.structure.columns(one.number)
    ahead = [late(u[::-1], lag, state.dt)[::-1] for lag in _lags(u.size, state.dt)]
    both = state.scores([np.vstack([columns, column]) for column in ahead], one.fit)
    if net(float(both.max()) - one.gain, 1, LN_STRUCTURES) >= NET_LEAST:
        return "cannot tell", f"the input's later values explain the output as well: {feedback}"
    fitted = replace(state, fits=(one.fit,))
    if max(inconstancy(fitted, columns[j], np.delete(columns, j, 0)) for j in range(len(drawn.c[0]))) >= NET_LEAST:
        return "cannot tell", f"the gain depends on the frequency as in no structure: {feedback}"
    if not one.structure.poles:
        either = "either may act on the other" if acts_back else "the input may act"
        return "cannot tell", f"both move at once: {either}, or a common cause on both"
    own = dict(zip(one.structure.keys, np.abs(drawn.c.T), strict=False))
    slower = np.mean(own.get("direct", 0.0) < own["gain"]) if "gain" in own else 0.0
    if slower < 0.5 + PROBABILITY / 2.0:
        return "cannot tell", f"the output moves before the input: {feedback}"
    if "direct" in own:
        return "cannot tell", "a part comes at once, the rest late: two ways, or a common cause that both answer late"
    if one.gain - state.with_columns(ahead[int(np.argmax(state.scores(ahead, one.fit)))])[0] < ALIKE:
        other = "the input the output" if acts_back else "both a common cause"
        return "cannot tell", f"the output may follow the input, or {other}"
    return "input first", "the output follows the input; a common cause that reaches the input first looks the same"


def _lags(n: int, dt: float) -> tuple[float, ...]:
    """Time constants from dt to a third of the record, a factor 2 apart."""
    return tuple(float(x) for x in dt * 2.0 ** np.arange(1 + int(math.log2(max(LONGEST_LAG * n, 1.0)))))


@dataclass(frozen=True)
class Empirical:
    """Ratio of spectra [bands] with the deviations that 90 % of it keep within: of the gain, and of the phase, rad.
    `coherence`: squared; `chance`: unrelated columns stay below it in 95 % of the bands."""

    frequency_hz: Array
    ratio: Complex
    within: Array
    coherence: Array
    chance: Array


def empirical(u: Array, y: Array, dt: float) -> Empirical:
    """The empirical transfer function of an input u [n] and an output y [n] without missing samples."""
    tapers = windows.dpss(u.size, HALF_WIDTH, TAPERS)
    pole = math.exp(-2.0 * math.pi * CORNER / u.size)
    U, Y = (np.fft.rfft(tapers * lfilter([1.0, -1.0], [1.0, -pole], detrend(one))) for one in (u, y))
    low, high = math.ceil(HALF_WIDTH), U.shape[1] - 1
    edges = np.unique(np.geomspace(low, high, max(2, round(BANDS_OF_A_DECADE * math.log10(high / low)))).astype(int))
    Suu, Syy = (np.add.reduceat((np.abs(one) ** 2).sum(axis=0), edges[:-1]) for one in (U, Y))
    Suy = np.add.reduceat((np.conj(U) * Y).sum(axis=0), edges[:-1])
    # reduceat's last band runs on to the end.
    width = np.diff(np.append(edges[:-1], U.shape[1]))
    # Neighbouring bins share their tapers' band.
    freedom = np.maximum(TAPERS, TAPERS * width / (2.0 * HALF_WIDTH) + (TAPERS - 1) / 2.0)
    ratio: Complex = np.asarray(Suy / Suu, np.complex128)
    coherence = np.clip(np.abs(Suy) ** 2 / (Suu * Syy), 0.0, 1.0)
    sd = np.sqrt((1.0 - coherence) * Syy / Suu / (2.0 * (freedom - 1.0)))
    within = sd * t.ppf(0.5 + PROBABILITY / 2.0, 2.0 * freedom - 2.0)
    chance = 1.0 - 0.05 ** (1.0 / (freedom - 1.0))
    middle = (edges[:-1] + (width - 1) / 2.0) / (u.size * dt)
    return Empirical(middle, ratio, within, coherence, chance)
