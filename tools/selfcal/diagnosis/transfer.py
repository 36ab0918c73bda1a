"""How an axis answers to a channel: the transfer function between two recorded columns.

Parametric: output = bias + G(s) input + drift + white noise, by prediction error. The drift is a walk or Gauss-Markov
noise, refitted with each structure of G; so the model is Box and Jenkins's with a first or second order. Empirical:
the ratio of multitaper spectra, with no model at all.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import brentq, minimize_scalar
from scipy.signal import detrend, lfilter, windows
from scipy.stats import t

from selfcal.base.grid import Array
from selfcal.diagnosis.channel_looks import LONGEST_LAG, agreement
from selfcal.likelihood.columns import LN_SLOW, number_nodes, top
from selfcal.likelihood.fit import Fit, Sums, left, ln_det, ln_likelihood, refit, run
from selfcal.likelihood.state import ALIKE, NET_LEAST, State, net
from selfcal.model.forms import POWER, played, slope

Complex = NDArray[np.complex128]
#: Numbers of a structure.
Point = tuple[float, ...]
#: Probability of an interval.
PROBABILITY = 0.9
#: ln of the stiffness of a curve through an input's readings, least and most; fewer readings are taken as they are.
STIFF, ROUGH = (-10.0, 25.0), 30
#: Factors between a filter's numbers that are tried first; 2 for the others.
COARSE = {"pure_delay_s": 1.6, "damping": 3.0}
#: Draws of a posterior.
DRAWS = 4000
#: Price of a number of a structure besides half BIC, nats: several add a number to a lag, each a different number.
LN_CHOICE = 1.0
#: ln of the number of independent looks: the structures and their numbers.
LN_STRUCTURES = math.log(42.0)
#: Nats from the best within which structures are scored with a drift of two terms.
NEAR_NATS = 10.0
#: Tapers of the empirical spectra, their half bandwidth in bins, and the bands of a decade.
SPECTRUM_TAPERS, HALF_WIDTH, BANDS_OF_A_DECADE = 3, 2.5, 8
#: Both columns lose their slow power below this bin first: a spectrum as steep as a temperature's would fill the bands
#: beside its own. The ratio stays.
CORNER = 20.0


@dataclass(frozen=True)
class Input:
    """An input: `values` [n] about its `reference` in `unit`, of the readings `read` [n]. `held_s`: time between the
    readings of a held input, s; `taken`: in words as which its readings were taken."""

    values: Array
    read: Array
    unit: str
    reference: float = 0.0
    held_s: float = 0.0
    taken: str = ""


@dataclass(frozen=True)
class Structure:
    """A form of the influence: coefficients by name, `keys`, of what a filter makes of the input. `shape`: the filter's
    numbers."""

    name: str
    keys: tuple[str, ...]
    shape: tuple[str, ...] = ()

    @property
    def poles(self) -> int:
        """Order of the structure."""
        return len(set(self.shape) - {"pure_delay_s", "width", "window_s"})

    @property
    def late(self) -> bool:
        """Whether it follows the input."""
        return bool(set(self.shape) - {"window_s"})

    @property
    def linear(self) -> bool:
        return not set(self.keys) & set(POWER) and "width" not in self.shape

    def named(self, point: Point) -> dict[str, float]:
        """The filter's numbers by name."""
        return dict(zip(self.shape, point, strict=True))

    def at(self, c: Array, shape: Array, s: Complex) -> Complex:
        """G [draws, f] of coefficients `c` [draws, k] and numbers `shape` [draws, m]; of a curve its slope at the
        reference."""
        number = {name: shape[:, k, None] for k, name in enumerate(self.shape)}
        H: Complex = np.exp(-number["pure_delay_s"] * s) if "pure_delay_s" in number else np.ones_like(s)
        for T in lags_of(number):
            H = H / (1.0 + T * s)
        of = {"gain": H, "rate": H * s, "direct": 1.0 - H}
        return np.asarray(sum(c[:, k, None] * of[key] for k, key in enumerate(self.keys) if key in of) + 0.0 * H)


#: Every structure. A hysteresis is a play: it follows at half of its width. A rate is a slope over a window.
STRUCTURES = (
    Structure("static", ("gain",)),
    Structure("rate", ("rate",), ("window_s",)),
    Structure("static and rate", ("gain", "rate"), ("window_s",)),
    Structure("square", ("gain", "square")),
    Structure("cube", ("gain", "square", "cube")),
    Structure("hysteresis", ("gain",), ("width",)),
    Structure("delay", ("gain",), ("pure_delay_s",)),
    Structure("late rate", ("rate",), ("lag_s",)),
    Structure("lag", ("gain",), ("lag_s",)),
    Structure("lag and direct", ("gain", "direct"), ("lag_s",)),
    Structure("lag and square", ("gain", "square"), ("lag_s",)),
    Structure("lag and cube", ("gain", "square", "cube"), ("lag_s",)),
    Structure("delay and lag", ("gain",), ("pure_delay_s", "lag_s")),
    Structure("two lags", ("gain",), ("lag_s", "lag_2_s")),
    Structure("resonance", ("gain",), ("period_s", "damping")),
)


def lags_of(number: Mapping[str, Any]) -> list[Any]:
    """Time constants, s, of the poles of a filter; those of a resonance are complex."""
    found = [number[key] for key in ("lag_s", "lag_2_s") if key in number]
    if "period_s" in number:
        damping = number["damping"]
        turn = 1j * np.sqrt(1.0 - damping**2)
        found += [number["period_s"] / (2.0 * math.pi) * (damping + sign * turn) for sign in (1.0, -1.0)]
    return found


def behind(u: Array, dt: float, number: Mapping[str, float]) -> tuple[Array, list[Array]]:
    """The input [n] behind a filter, at rest at its first value, and what the time before the record may add: each pole
    its decay, a delay what moved on a straight line, a play where it stood."""
    time = np.arange(u.size) * dt
    before: list[Array] = []
    if "width" in number:
        half = 0.5 * number["width"]
        u, high = (played(np.append(u[0] + at, u), number["width"])[1:] for at in (-half, half))
        before = [high - u]
    if "pure_delay_s" in number:
        ago = time - number["pure_delay_s"]
        u = np.interp(ago, time, u)
        before = [np.minimum(ago, 0.0)]
    # Equal time constants have no partial fractions.
    T = np.array(lags_of(number)) * np.linspace(1.0, 1.001, len(lags_of(number)))
    if not T.size:
        return u, before
    share = [constant ** (T.size - 1) / np.prod(constant - np.delete(T, k)) for k, constant in enumerate(T)]

    def through(x: Array) -> Array:
        return np.asarray(sum((w * late(x, constant, dt)).real for w, constant in zip(share, T, strict=True)))

    decays = [np.exp(-time / constant) for constant in T]
    if np.iscomplexobj(T):
        decays = [decays[0].real, decays[0].imag]
    return through(u), [through(values) for values in before] + decays


@dataclass(frozen=True)
class Drive:
    """An input `u` [n], its samples `dt` s apart: the columns of each structure at each point, which are its
    numbers."""

    u: Array
    dt: float

    def limits(self, structure: Structure) -> Array:
        """Least and most [m, 2] of each number of the filter: what the samples and the record show."""
        span = self.u.size * self.dt
        swing = float(np.ptp(self.u))
        known = {
            "pure_delay_s": (0.25 * self.dt, LONGEST_LAG * span),
            "period_s": (4.0 * self.dt, 0.5 * span),
            "damping": (0.02, 0.99),
            "width": (0.02 * swing, 0.9 * swing),
            "window_s": (self.dt, span / 6.0),
        }
        lag = (0.25 * self.dt, LONGEST_LAG * span)
        return np.array([known.get(name, lag) for name in structure.shape]).reshape(-1, 2)

    def points(self, structure: Structure) -> list[Point]:
        """Points that are tried first."""
        grids = []
        for name, (low, high) in zip(structure.shape, self.limits(structure), strict=True):
            count = 2 + int(math.log(high / low) / math.log(COARSE.get(name, 2.0)))
            grids.append(np.geomspace(low, high, count)[1:-1].tolist())
        return [point for point in product(*grids) if "lag_2_s" not in structure.shape or point[1] <= point[0]]

    def columns(self, structure: Structure, point: Point) -> Array:
        """[k, n]: what each key multiplies, and then what the time before the record may add."""
        number = structure.named(point)
        v, before = behind(self.u, self.dt, number)

        def of(key: str) -> Array:
            if key == "rate":
                late = "lag_s" in number
                return (self.u - v) / number["lag_s"] if late else slope(self.u, number["window_s"], self.dt)
            return self.u - v if key == "direct" else v ** {"gain": 1, **POWER}[key]

        more = [values * v for values in before] if "square" in structure.keys else []
        return np.array([*map(of, structure.keys), *before, *more])

    def each(self, structure: Structure, points: Iterable[Sequence[float] | Array]) -> list[Array]:
        """The columns at several points."""
        return [self.columns(structure, tuple(map(float, point))) for point in points]


def quiet(values: Array, lattice: float = 0.0) -> Array:
    """[n]: the curve that readings [n] with a noise of their own are of: a walk or an integrated walk, whichever the
    readings show, with its size (the splines of Wahba, 1978). What it leaves of the noise does not go with it, and so
    it biases no gain. On a `lattice` the noise is that of rounding at least: between its steps readings look exact."""
    n = values.size
    about = values - values.mean()
    if n < ROUGH or not np.any(np.diff(values, 2)):
        return values

    def bands_of(order: int) -> Array:
        """Diagonals [order + 1, n] of D'D, D the differences of this order."""
        parts, ends = np.diff(np.eye(order + 1), order)[:, 0], np.ones(n - order)
        bands = np.zeros((order + 1, n))
        for apart in range(order + 1):
            bands[order - apart, apart:] = np.convolve(parts[apart:] * parts[: parts.size - apart], ends)
        return bands

    def smoothed(bands: Array, ln_stiff: float) -> tuple[float, Array]:
        """Restricted likelihood, less, and the curve, whose differences of the order of `bands` are white."""
        order = len(bands) - 1
        stiff = math.exp(ln_stiff) * bands
        stiff[order] += 1.0
        root = cholesky_banded(stiff)
        curve = cho_solve_banded((root, False), about)
        left = max(float(about @ (about - curve)), 1e-300)
        # Twice the second term is ln det D D': of a walk n, of an integrated walk n^2 (n^2 - 1) / 12.
        scale = 0.5 * math.log(n if order == 1 else n**2 * (n**2 - 1.0) / 12.0)
        return 0.5 * (n - order) * (math.log(left) - ln_stiff) - scale + float(np.log(root[order]).sum()), curve

    def likeliest(bands: Array) -> tuple[float, float, Array]:
        """Restricted likelihood, less, at the likeliest ln of the stiffness, that, and the bands."""
        options = {"xatol": 0.1}
        found = minimize_scalar(lambda x: smoothed(bands, x)[0], bounds=STIFF, method="bounded", options=options)
        return float(found.fun), float(found.x), bands

    _, stiff, bands = min(map(likeliest, map(bands_of, (1, 2))), key=lambda tried: tried[0])

    def fine(ln_stiff: float) -> float:
        """How far what the curve leaves is above the noise of rounding."""
        return float(np.var(about - smoothed(bands, ln_stiff)[1])) - lattice**2 / 12.0

    if fine(stiff) < 0.0 < fine(STIFF[1]):
        stiff = brentq(fine, stiff, STIFF[1], xtol=0.05)
    return np.asarray(values.mean() + smoothed(bands, stiff)[1])


def late(values: Array, lag_s: complex, dt: float) -> NDArray[Any]:
    """[n]: `values` [n] behind a first-order lag, at rest at the first value; complex for a complex time constant.

    Exact for samples between which the input moves on straight lines, and for means over each interval of an input that
    is constant there. A module's lag takes each sample for the whole interval before it: half an interval less."""
    kept = np.exp(-dt / lag_s)
    mean = -lag_s / dt * np.expm1(-dt / lag_s)
    about = values - values[0]
    return np.asarray(values[0] + lfilter([1.0 - mean, mean - kept], [1.0, -kept], about))


@dataclass(frozen=True)
class Trial:
    """A structure at its best point: its columns [k, n], the gain of ln likelihood, its score (half BIC and the choice,
    nats), and the fit."""

    structure: Structure
    point: Point
    columns: Array
    gain: float
    score: float
    fit: Fit


@dataclass(frozen=True)
class Draws:
    """Draws of a structure's numbers: coefficients `c` [draws, k] and the filter's `shape` [draws, m]."""

    structure: Structure
    c: Array
    shape: Array

    def at(self, frequency_hz: Array) -> Complex:
        """G [draws, f]."""
        return self.structure.at(self.c, self.shape, np.asarray(2j * np.pi * frequency_hz, np.complex128)[None, :])

    @property
    def delay_s(self) -> Array:
        """[draws]: how late slow changes arrive, s: the slope of the phase at frequency 0."""
        slowest = np.array([1e-6 / (2.0 * math.pi * max(1.0, float(self.shape.max(initial=0.0))))])
        return np.asarray(-np.angle(self.at(slowest) / self.at(np.zeros(1)))[:, 0] / (2.0 * math.pi * slowest[0]))


def tried(state: State, drive: Drive, structure: Structure) -> Trial:
    """A structure at its best point: of those tried first, and the numbers of a filter then looked for between them."""
    points = drive.points(structure)
    blocks = drive.each(structure, points)
    drifts = [state.best, *state.stiffer(1.5)]
    fit = state.with_columns(blocks[int(np.argmax(np.max([state.scores(blocks, at) for at in drifts], axis=0)))])[1]
    point = points[int(np.argmax(state.scores(blocks, fit)))]
    if structure.shape:
        known = fit
        found = top(lambda some: state.scores(drive.each(structure, some), known), point, drive.limits(structure))
        point = tuple(found.tolist())
    columns = drive.columns(structure, point)
    gain, fit = state.with_columns(columns)
    free = len(columns) + len(structure.shape)
    return Trial(structure, point, columns, gain, gain - free * (0.5 * math.log(fit.n) + LN_CHOICE), fit)


def beside_two_terms(state: State, found: Sequence[Trial]) -> list[Trial]:
    """The structures with scores for a drift of two terms, and the fit with that drift where it is clearly better.

    A drift of one term that follows quick errors of a structure leaves slow columns some nats of their own."""
    if state.extras.all_scales:
        return list(found)
    best = max(found, key=lambda trial: trial.score)
    base = max(state.rich.ln_likelihood, state.best.ln_likelihood)

    def refitted(trial: Trial) -> tuple[Fit, float]:
        fit = refit(state.series.beside(trial.columns), state.rich)
        clearly = fit.ln_likelihood > trial.fit.ln_likelihood + ALIKE
        return fit if clearly else trial.fit, fit.ln_likelihood - base - trial.gain

    of_best = refitted(best)[1]
    near = [refitted(trial) if trial.score > best.score - NEAR_NATS else (trial.fit, of_best) for trial in found]
    return [replace(trial, score=trial.score + more, fit=fit) for trial, (fit, more) in zip(found, near, strict=True)]


def worth(state: State, trial: Trial) -> float:
    """Evidence of an influence, -ln p: net of the search, and of an input's decay that any drift might have."""
    own = len(trial.structure.keys)
    start = max(0.0, state.with_columns(trial.columns[own:])[0]) if own < len(trial.columns) else 0.0
    gain = min(trial.gain, state.average_gain(trial.columns)) - start
    return net(gain, own + len(trial.structure.shape), LN_STRUCTURES + own * LN_SLOW)


def posterior(state: State, drive: Drive, trial: Trial) -> Draws:
    """Draws over coefficients, the filter's numbers, and the drift: every near drift, and its parameters."""
    structure = trial.structure
    drifts = [
        (fit, theta, ln_share + _flat(fit, theta)) for fit, theta, ln_share in state.possible(trial.columns, rich=True)
    ]
    likely = [
        ln_share + _ln_weight(next(state.sums(fit.terms, theta, [trial.columns]))) for fit, theta, ln_share in drifts
    ]
    far = [drifts[int(np.argmax(likely))], max(drifts, key=lambda node: node[2])]

    def scores(some: Array) -> Array:
        each = drive.each(structure, some)
        return np.array([state.scores(each, replace(fit, theta=theta)) for fit, theta, _ in far])

    # At the likeliest drift, and at the largest, which leaves most possible.
    points, steps = number_nodes(scores, trial.point, drive.limits(structure))
    blocks = drive.each(structure, np.exp(points))
    k = len(trial.columns)
    ln_weight, means, roots, places = [], [], [], []
    for fit, theta, ln_share in drifts:
        for place, sums in enumerate(state.sums(fit.terms, theta, blocks)):
            c, inverse, rss = sums.coefficients()
            values, vectors = np.linalg.eigh(rss / sums.n * inverse[-k:, -k:])
            ln_weight.append(ln_share + _ln_weight(sums))
            means.append(c[-k:])
            roots.append(vectors * np.sqrt(np.maximum(values, 0.0)))
            places.append(place)
    random = np.random.default_rng(1)
    weight = np.exp(np.array(ln_weight) - max(ln_weight))
    drawn = random.choice(weight.size, DRAWS, p=weight / weight.sum())
    z = random.standard_normal((DRAWS, k))
    c = np.array(means)[drawn] + np.einsum("dij,dj->di", np.array(roots)[drawn], z)
    # Within a cell of the lattice any point is as likely.
    inside = random.uniform(-0.5, 0.5, (DRAWS, len(steps))) @ steps.T
    shape = np.exp(np.clip(points[np.array(places)[drawn]] + inside, *np.log(drive.limits(structure)).T))
    return Draws(structure, c[:, : len(structure.keys)], shape)


def _flat(fit: Fit, theta: Array) -> float:
    """ln of a prior flat in the sizes of the drift over Jeffreys' for a weak walk, about a fit: a drift that quick
    errors of a structure make smaller would leave slow coefficients too narrow an interval."""
    return 0.5 * float((theta - fit.theta)[fit.terms.sizes].sum())


def _ln_weight(sums: Sums) -> float:
    """ln likelihood with every coefficient integrated out. At its maximum, columns like a drift would leave too little
    of the drift."""
    _, inverse, rss = sums.coefficients()
    return ln_likelihood(sums) + 0.5 * ln_det(rss / sums.n * inverse)


def held_out(state: State, trial: Trial) -> float:
    """What the influence gains on the last third, nats a sample. The drift and the size of the noise are of the part
    before; so are the coefficients, with what that part leaves open of them."""
    n = state.y.size
    mark = n - n // 3
    before = replace(state, y=np.where(np.arange(n) < mark, state.y, np.nan))

    def rest(columns: Array) -> float:
        learnt = refit(before.series.beside(columns), trial.fit)
        values = []
        for sums in run(state.series.beside(columns), learnt.terms, learnt.theta, (mark, n))[0]:
            _, inverse, rss = sums.coefficients()
            fit = sums.n * 2.0 * math.log(learnt.sigma) + sums.D + rss / learnt.sigma**2
            values.append(0.5 * (ln_det(learnt.sigma**2 * inverse) - fit))
        return values[1] - values[0]

    return (rest(trial.columns) - rest(np.empty((0, n)))) / max(1, int(np.isfinite(state.y[mark:]).sum()))


def left_over(state: State, drive: Drive, trial: Trial) -> float:
    """-ln p of residuals that still go with the input, net of the number of looks.

    At any frequency in any phase, so whatever the lag, and with a single coefficient: with each column of the
    structure, the input itself, powers of what the filter makes of it, a coefficient that changes with time, and a
    filter that is quicker up than down."""
    number = trial.structure.named(trial.point)
    v = behind(drive.u, drive.dt, number)[0]
    uneven = behind(np.abs(drive.u - v), drive.dt, number)[0]
    own = trial.columns[: len(trial.structure.keys)]
    foreign = np.array([drive.u, v**2, v**3, own[0] * np.linspace(-1.0, 1.0, v.size), uneven])
    w, *others = left(state.series.beside(trial.columns), trial.fit, foreign).T
    found = []
    for u in (*left(state.series, trial.fit, own).T[1:], *others):
        if float(u @ u) > 0.0:
            chi, bands = agreement(u, w, any_phase=True)
            found += [net(0.5 * chi, 2 * bands), net(0.5 * float(u @ w) ** 2 / float(u @ u) / float(np.var(w)))]
    return max(found) - math.log(len(found))


def source(
    state: State, drive: Drive, trial: Trial, drawn: Draws, misfits: Sequence[str], *, acts_back: bool
) -> tuple[str, str]:
    """Whether the record shows that the input acts: "input first", "cannot tell" or "no structure", and the reason in
    words. `misfits`: what contradicts the structure. `acts_back`: the output may act on the input. No axis acts on a
    temperature or a supply.

    A common cause that reaches the input first, and all of it, always looks as the input does."""
    feedback = "feedback, or a common cause" if acts_back else "a common cause"
    lags = state.dt * 2.0 ** np.arange(1 + int(math.log2(max(LONGEST_LAG * drive.u.size, 1.0))))
    ahead = [late(drive.u[::-1], float(lag), state.dt)[::-1] for lag in lags]
    both = state.scores([np.vstack([trial.columns, column]) for column in ahead], trial.fit)
    back = net(float(both.max()) - trial.gain, 1, LN_STRUCTURES) >= NET_LEAST
    if misfits and not (back and acts_back):
        return "no structure", "; ".join(misfits)
    if back:
        return "cannot tell", f"the input's later values explain the output as well: {feedback}"
    if not trial.structure.late:
        either = "either may act on the other" if acts_back else "the input may act"
        return "cannot tell", f"both move at once: {either}, or a common cause on both"
    own = dict(zip(trial.structure.keys, np.abs(drawn.c.T), strict=False))
    slower = np.mean(own.get("direct", 0.0) < own["gain"]) if "gain" in own else 0.0
    if slower < 0.5 + PROBABILITY / 2.0:
        return "cannot tell", f"the output moves before the input: {feedback}"
    if "direct" in own:
        return "cannot tell", "a part comes at once, the rest late: two ways, or a common cause that both answer late"
    if trial.gain - state.with_columns(ahead[int(np.argmax(state.scores(ahead, trial.fit)))])[0] < ALIKE:
        other = "the input the output" if acts_back else "both a common cause"
        return "cannot tell", f"the output may follow the input, or {other}"
    return "input first", "the output follows the input; a common cause that reaches the input first looks the same"


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
    tapers = windows.dpss(u.size, HALF_WIDTH, SPECTRUM_TAPERS)
    pole = math.exp(-2.0 * math.pi * CORNER / u.size)
    U, Y = (np.fft.rfft(tapers * lfilter([1.0, -1.0], [1.0, -pole], detrend(signal))) for signal in (u, y))
    low, high = math.ceil(HALF_WIDTH), U.shape[1] - 1
    edges = np.unique(np.geomspace(low, high, max(2, round(BANDS_OF_A_DECADE * math.log10(high / low)))).astype(int))
    Suu, Syy = (np.add.reduceat((np.abs(spectrum) ** 2).sum(axis=0), edges[:-1]) for spectrum in (U, Y))
    Suy = np.add.reduceat((np.conj(U) * Y).sum(axis=0), edges[:-1])
    # reduceat's last band runs on to the end.
    width = np.diff(np.append(edges[:-1], U.shape[1]))
    # Neighbouring bins share their tapers' band.
    freedom = np.maximum(SPECTRUM_TAPERS, SPECTRUM_TAPERS * width / (2.0 * HALF_WIDTH) + (SPECTRUM_TAPERS - 1) / 2.0)
    ratio: Complex = np.asarray(Suy / Suu, np.complex128)
    coherence = np.clip(np.abs(Suy) ** 2 / (Suu * Syy), 0.0, 1.0)
    sd = np.sqrt((1.0 - coherence) * Syy / Suu / (2.0 * (freedom - 1.0)))
    within = sd * t.ppf(0.5 + PROBABILITY / 2.0, 2.0 * freedom - 2.0)
    chance = 1.0 - 0.05 ** (1.0 / (freedom - 1.0))
    middle = (edges[:-1] + (width - 1) / 2.0) / (u.size * dt)
    return Empirical(middle, ratio, within, coherence, chance)
