"""One model of all axes: y_i(t) = c_i + l_i f(t) + d_i(t) + e_i(t).

f is one quantity that nobody recorded: a Gauss-Markov process of variance 1. d_i is the drift of axis i, a random walk
and a Gauss-Markov process. e is white, with a correlation between the axes. Everything is relative to the white noise
of one sample of its axis.

The parameters are fitted by Whittle's likelihood of the first differences, which have a spectrum although a walk has
none. Neighbouring frequencies are taken together where the spectra are flat. The likelihood of the record itself, the
course of f, and shocks of any state come from the Kalman filter of the model and its smoother.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from selfcal.likelihood import work
from selfcal.likelihood.statemodel import ALPHA_LIMITS, SIZE_LIMITS, Array, Mask

#: Axes that a common quantity takes at least: two that go together are noise that they share.
LEAST_AXES = 3
#: Sine tapers (Riedel & Sidorenko, IEEE Trans. Signal Process. 43, 1995): together they weigh the whole record alike.
TAPERS = 8
#: Frequencies that stand for themselves, and groups an octave above them.
SINGLE, AN_OCTAVE = 64, 24
#: A bin so far above the level of its neighbours, in units of their mean, holds a line, and so many bins beside it.
LINE, LINE_BESIDE, NEIGHBOURS = 14.0, 2, 200
#: Correlation times of f that a fit begins at, s.
STARTS_S = (30.0, 300.0)
#: Prior standard deviations of ln sizes and ln rates about the middle of their limits: they keep what the record does
#: not know from running away, and change ln likelihood by a few tenths elsewhere.
PRIOR_SD = 3.0
#: Probability that an axis has a jump that is somewhere; widths of its size, in its own standard deviations.
P_AXIS, WIDTHS = 0.3, (1.0, 2.0, 4.0, 8.0, 16.0, 30.0)
#: A filter has settled when its covariance changes by less than this share a step.
SETTLED = 1e-9
#: Numbers of an axis' own drift: ln of white noise, walk a step, Gauss-Markov deviation, rate a sample.
OWN = 4

Spectra = NDArray[np.complex128]


@dataclass(frozen=True)
class Bins:
    """Periodogram matrices [k, m, m] of tapered first differences, at angles `turn` [k], each the mean of `count` [k]
    frequencies."""

    power: Spectra | Array
    turn: Array
    count: Array

    @cached_property
    def white(self) -> Array:
        """Spectrum [k] of the difference of white noise of variance 1."""
        return 2.0 - 2.0 * np.cos(self.turn)

    def markov(self, rate: float) -> tuple[Array, Array]:
        """The same of a Gauss-Markov process of this rate a sample, and its slope over ln of the rate."""
        a = math.exp(-rate)
        below = 1.0 - 2.0 * a * np.cos(self.turn) + a * a
        value = -math.expm1(-2.0 * rate) / below * self.white
        slope = value * rate * (2.0 * a * a / -math.expm1(-2.0 * rate) - 2.0 * a * (np.cos(self.turn) - a) / below)
        return value, slope


def _lines(power: Array) -> tuple[Mask, Array]:
    """Bins [n] of a spectrum that hold a line, or lie beside one, and the level [n] about each."""
    half = min(NEIGHBOURS, max(8, power.size // 8))
    groups = np.arange(power.size) // half
    level = np.array([np.median(power[groups == one]) for one in range(groups[-1] + 1)])[groups] / math.log(2.0)
    found = np.zeros(power.size, bool)
    for at in np.flatnonzero(power > LINE * level):
        if at >= SINGLE // 4:
            found[max(0, at - LINE_BESIDE) : at + LINE_BESIDE + 1] = True
    return found, level


def without_lines(y: Array) -> Array:
    """Records [m, n] without gaps, whose lines are brought down to the level of the noise about them."""
    spectra = np.fft.rfft(np.diff(y, axis=1), axis=1)
    for row in spectra:
        power = np.abs(row) ** 2
        lines, level = _lines(power)
        row[lines] *= np.sqrt(np.minimum(1.0, level / np.maximum(power, 1e-300)))[lines]
    steps = np.fft.irfft(spectra, y.shape[1] - 1, axis=1)
    found: Array = y[:, :1] + np.concatenate([np.zeros((y.shape[0], 1)), np.cumsum(steps, axis=1)], axis=1)
    return found


def bins_of(y: Array) -> Bins:
    """Of records y [m, n] without gaps, in units of their white noise. Bins with a line on any axis are left out."""
    difference = np.diff(y, axis=1)
    n = difference.shape[1]
    where = math.pi * (np.arange(n) + 0.5) / n
    z = np.stack([np.fft.rfft(difference * np.sin(k * where), axis=1) for k in range(1, TAPERS + 1)])
    z = (z * math.sqrt(2.0 / n))[:, :, 2:-1]
    turn = 2.0 * math.pi * np.arange(2, 2 + z.shape[2]) / n
    power = (np.abs(z) ** 2).mean(axis=0)
    kept = ~np.any([_lines(row)[0] for row in power], axis=0)
    z, turn = z[:, :, kept], turn[kept]
    place = np.arange(turn.size)
    octave = np.log2(np.maximum(place, SINGLE) / SINGLE)
    group = np.where(place < SINGLE, place, SINGLE + (octave * AN_OCTAVE).astype(int))
    start = np.flatnonzero(np.diff(group, prepend=-1))
    count = np.diff(np.append(start, turn.size)).astype(np.float64)
    outer = np.einsum("tif,tjf->fij", z, z.conj()) / TAPERS
    return Bins(np.add.reduceat(outer, start) / count[:, None, None], np.add.reduceat(turn, start) / count, count)


@dataclass(frozen=True)
class Joint:
    """Parameters of the model: `own` [m, OWN], `correlation` [m, m] of the white noise, `loading` [m] of f in units of
    each axis' record, `rate` of f a sample. `value`: ln likelihood by Whittle, with the priors."""

    own: Array
    correlation: Array
    loading: Array
    rate: float
    value: float = -math.inf

    @property
    def white(self) -> Array:
        """Standard deviations [m] of the white noise."""
        return np.exp(self.own[:, 0])

    def without_f(self) -> Joint:
        """The same model less f."""
        return replace(self, loading=np.zeros_like(self.loading))

    def of(self, axes: Sequence[int]) -> Joint:
        """The model of some of the axes."""
        at = list(axes)
        return replace(self, own=self.own[at], correlation=self.correlation[np.ix_(at, at)], loading=self.loading[at])

    def share(self, lag: float) -> Array:
        """Share [m] of f in the variance that the drift of each axis gains over `lag` samples."""
        common = 2.0 * self.loading**2 * -math.expm1(-self.rate * lag)
        scale = np.exp(2.0 * self.own[:, 0])
        own = scale * (
            np.exp(2.0 * self.own[:, 1]) * lag
            - 2.0 * np.exp(2.0 * self.own[:, 2]) * np.expm1(-np.exp(self.own[:, 3]) * lag)
        )
        found: Array = common / np.maximum(common + own, 1e-300)
        return found


def _lower(m: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    found: tuple[NDArray[np.intp], NDArray[np.intp]] = np.tril_indices(m, -1)
    return found


class _Cost:
    """-ln likelihood and its slope over a vector of parameters: own drifts, the rows of a root of the correlation, and
    the loadings and ln rate of f if it has one."""

    def __init__(self, bins: Bins, f: bool) -> None:
        self.bins, self.f, self.m = bins, f, bins.power.shape[1]
        self.centre = np.array([0.0, -4.0, -2.0, -4.0])
        self.weight = np.array([0.0, 1.0, 1.0, 1.0]) / PRIOR_SD**2

    def parts(self, x: Array) -> tuple[Array, Array, Array, Array, float]:
        """Own drifts, root and correlation, loadings relative to the white noise, ln rate."""
        m = self.m
        own, at = x[: OWN * m].reshape(m, OWN), OWN * m
        root = np.eye(m)
        lower = _lower(m)
        root[lower] = x[at : at + lower[0].size]
        at += lower[0].size
        root /= np.linalg.norm(root, axis=1)[:, None]
        loading, ln_rate = (x[at : at + m], float(x[at + m])) if self.f else (np.zeros(m), 0.0)
        return own, root, root @ root.T, loading, ln_rate

    def __call__(self, x: Array) -> tuple[float, Array]:
        bins, m = self.bins, self.m
        work.count(bins.turn.size, m)
        own, root, correlation, loading, ln_rate = self.parts(x)
        white = np.exp(own[:, 0])
        S = bins.white[:, None, None] * (correlation * np.outer(white, white))
        walk, size = np.exp(2.0 * (own[:, 0] + own[:, 1])), np.exp(2.0 * (own[:, 0] + own[:, 2]))
        drifts = [bins.markov(math.exp(rate)) for rate in own[:, 3]]
        diagonal = np.arange(m)
        S[:, diagonal, diagonal] += walk + np.stack([v for v, _ in drifts], axis=1) * size
        u = loading * white
        common, bend = bins.markov(math.exp(ln_rate)) if self.f else (np.zeros_like(bins.turn),) * 2
        S += common[:, None, None] * np.outer(u, u)
        inverse = np.linalg.inv(S)
        sign, ln_det = np.linalg.slogdet(S)
        if not (sign > 0.0).all():
            return 1e30, np.zeros_like(x)
        M = inverse @ bins.power
        value = float(bins.count @ (ln_det + np.trace(M, axis1=1, axis2=2).real))
        A = bins.count[:, None, None] * (inverse - (M @ inverse).real)
        slope = np.zeros_like(x)
        of_own = np.zeros((m, OWN))
        G = np.einsum("k,kij->ij", bins.white, A)
        of_own[:, 0] = 2.0 * (G * correlation * np.outer(white, white)).sum(axis=1)
        D = A[:, diagonal, diagonal]
        of_walk = 2.0 * walk * D.sum(axis=0)
        of_size = 2.0 * size * np.array([D[:, i] @ v for i, (v, _) in enumerate(drifts)])
        of_own[:, 0] += of_walk + of_size
        of_own[:, 1], of_own[:, 2] = of_walk, of_size
        of_own[:, 3] = size * np.array([D[:, i] @ s for i, (_, s) in enumerate(drifts)])
        at = OWN * m
        of_root = 2.0 * (G * np.outer(white, white)) @ root
        of_root -= (of_root * root).sum(axis=1)[:, None] * root
        lower = _lower(m)
        lengths = np.linalg.norm(np.eye(m) + _strictly(x[at : at + lower[0].size], m), axis=1)
        slope[at : at + lower[0].size] = (of_root / lengths[:, None])[lower]
        at += lower[0].size
        if self.f:
            of_u = 2.0 * np.einsum("k,kij->ij", common, A) @ u
            slope[at : at + m] = of_u * white
            of_own[:, 0] += of_u * u
            far = (ln_rate - self.centre[3]) / PRIOR_SD**2
            slope[at + m] = float(u @ np.einsum("k,kij->ij", bend, A) @ u) + far
            value += 0.5 * far * (ln_rate - self.centre[3])
        away = own - self.centre
        value += 0.5 * float((self.weight * away**2).sum())
        slope[: OWN * m] = (of_own + self.weight * away).ravel()
        return value, slope


def _strictly(values: Array, m: int) -> Array:
    found = np.zeros((m, m))
    found[_lower(m)] = values
    return found


def fitted(bins: Bins, dt: float, f: bool, start: Joint | None = None) -> Joint:
    """The model of most likelihood, with f or without. `start`: the one without f, for f to be added to."""
    from scipy.optimize import minimize  # a quarter of a second to import: for records of several axes alone

    cost, m = _Cost(bins, f), bins.power.shape[1]
    size, rate = np.log(SIZE_LIMITS), np.log(np.array(ALPHA_LIMITS) * dt)
    rate[1] = min(rate[1], math.log(2.0))
    bounds = [(-4.0, 4.0), tuple(size), tuple(size), tuple(rate)] * m + [(-9.0, 9.0)] * (m * (m - 1) // 2)
    bounds += [(-50.0, 50.0)] * m + [tuple(rate)] if f else []
    own = np.tile([0.0, -4.0, -1.5, math.log(0.01 * dt)], (m, 1)) if start is None else start.own
    root = np.linalg.cholesky(np.eye(m) if start is None else start.correlation)
    root = root / np.diag(root)[:, None]
    own = np.clip(own, *np.array(bounds[:OWN]).T)
    head = np.concatenate([own.ravel(), root[_lower(m)]])
    tries = [head]
    if f:
        vector = _together(bins, own)
        tries = [np.concatenate([head, vector, [np.clip(math.log(dt / tau), *bounds[-1])]]) for tau in STARTS_S]
    best = min(
        (minimize(cost, one, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 400}) for one in tries),
        key=lambda one: float(one.fun),
    )
    own, _, correlation, loading, ln_rate = cost.parts(best.x)
    return Joint(own, correlation, loading * np.exp(own[:, 0]), math.exp(ln_rate), -float(best.fun))


def _together(bins: Bins, own: Array) -> Array:
    """Loadings [m] to begin with: what the slow parts of the axes share, relative to the white noise of each."""
    slow = max(8, int(np.searchsorted(np.cumsum(bins.count), 0.1 * bins.count.sum())))
    power = np.einsum("k,kij->ij", bins.count[:slow], bins.power[:slow].real)
    deviation = np.sqrt(np.diag(power))
    values, vectors = np.linalg.eigh(power / np.outer(deviation, deviation))
    relative = deviation / math.sqrt(float(bins.count[:slow] @ bins.white[:slow])) / np.exp(own[:, 0])
    found: Array = vectors[:, -1] * math.sqrt(max(float(values[-1]) - 1.0, 0.1)) * np.minimum(relative, 5.0)
    return found


@dataclass(frozen=True)
class Course:
    """What filter and smoother make of a record. `ln_likelihood`; `innovations` [n, m] of each axis (NaN: missing) and
    their variances `spread` [n, m]; `predicted` [n, s]: the states before each sample. Of the smoother: the states
    [n, s]; `shock` [n, s] and `known` [n, 1 + m, 1 + m]: score of a jump of each state just before each sample, and the
    information of jumps of f and of the levels."""

    ln_likelihood: float
    innovations: Array
    spread: Array
    predicted: Array
    states: Array = field(default_factory=lambda: np.empty((0, 0)))
    shock: Array = field(default_factory=lambda: np.empty((0, 0)))
    known: Array = field(default_factory=lambda: np.empty((0, 0, 0)))

    def scores(self) -> Array:
        """ln likelihood [n, m] of each reading given the past of all axes; NaN where it is missing."""
        found: Array = -0.5 * (np.log(2.0 * math.pi * self.spread) + self.innovations**2 / self.spread)
        return found

    @cached_property
    def of_f(self) -> Array:
        """Gain of ln likelihood [n] by a jump of f."""
        return 0.5 * self.shock[:, 0] ** 2 / np.maximum(self.known[:, 0, 0], 1e-300)

    @cached_property
    def of_levels(self) -> Array:
        """The same [n] by a jump of every level, each of its own size."""
        r, m = self.shock[:, 1 : self.known.shape[1]], self.known.shape[1] - 1
        firm = self.known[:, 1:, 1:] + 1e-12 * np.trace(self.known[:, 1:, 1:], axis1=1, axis2=2)[
            :, None, None
        ] * np.eye(m)
        found: Array = 0.5 * np.einsum("ni,ni->n", r, np.linalg.solve(firm, r[:, :, None])[:, :, 0])
        return found


def ahead(model: Joint, found: Course, steps: int) -> Array:
    """Prediction [n, m] of each axis `steps` samples after the last one that it knows, which is the one before."""
    m = model.loading.size
    decay = np.concatenate([[math.exp(-model.rate)], np.ones(m), np.exp(-np.exp(model.own[:, 3]))]) ** (steps - 1)
    x = found.predicted * decay
    predicted: Array = x[:, :1] * model.loading + x[:, 1 : 1 + m] + x[:, 1 + m :]
    return predicted


def course(model: Joint, y: Array, smooth: bool = False) -> Course:
    """Filter records y [m, n] (NaN: missing). States: f, then walk and Gauss-Markov drift of each axis. The levels are
    unknown: the walks begin with a wide prior.

    Backwards runs r' = H' S^-1 v + L' r (de Jong, Biometrika 75, 1988): the score of a jump of each state; its
    information runs likewise (Harvey & Koopman, J. Bus. Econ. Stat. 10, 1992)."""
    m, n = y.shape
    size = 1 + 2 * m
    work.count(n, size)
    own, scale = model.own, np.exp(2.0 * model.own[:, 0])
    decay = np.concatenate([[math.exp(-model.rate)], np.ones(m), np.exp(-np.exp(own[:, 3]))])
    variance = scale * np.exp(2.0 * own[:, 2])
    noise = np.concatenate([[1.0], scale * np.exp(2.0 * own[:, 1]), variance])
    noise *= np.concatenate([[-math.expm1(-2.0 * model.rate)], np.ones(m), -np.expm1(-2.0 * np.exp(own[:, 3]))])
    H = np.hstack([model.loading[:, None], np.eye(m), np.eye(m)])
    R = model.correlation * np.outer(model.white, model.white)
    wide = 1e6 * max(1.0, float(scale.max()))
    P = np.diag(np.concatenate([[1.0], np.full(m, wide), variance]))
    x = np.zeros(size)
    present: Mask = np.isfinite(y)
    whole: Mask = np.all(present, axis=0)
    innovations, spread = np.full((n, m), np.nan), np.full((n, m), np.nan)
    kept: list[tuple[Array, Array, Array, Array]] = []
    predicted = np.empty((n, size))
    total, first = 0.0, np.ones(m, bool)
    gain: tuple[Array, Array, Array, Array, float, Array] | None = None
    for t in range(n):
        at = slice(None) if whole[t] else np.flatnonzero(present[:, t])
        if gain is None or not whole[t]:
            h = H[at]
            S = h @ P @ h.T + R[np.ix_(present[:, t], present[:, t])]
            if h.shape[0]:
                root = np.linalg.cholesky(S)
                inverse = np.linalg.inv(root)
                K = P @ h.T @ inverse.T @ inverse
                ln_det = 2.0 * float(np.log(np.diag(root)).sum())
            else:
                inverse, K, ln_det = np.empty((0, 0)), np.empty((size, 0)), 0.0
            after = P - K @ h @ P
            P_next = after * np.outer(decay, decay) + np.diag(noise)
            P_next = 0.5 * (P_next + P_next.T)
            settled = whole[t] and float(np.abs(P_next - P).max()) < SETTLED * float(np.abs(np.diag(P_next)).max())
            now = (P, K, inverse, h, ln_det, np.diag(S))
            gain = now if settled else None
            P = P_next
        else:
            now = gain
        at_P, K, inverse, h, ln_det, variances = now
        v = y[at, t] - h @ x
        u = inverse @ v
        predicted[t] = x
        if smooth:
            kept.append((at_P, K, inverse, v))
        if first.any():  # the first reading of an axis sets its level
            first &= ~present[:, t]
        else:
            total -= 0.5 * (float(u @ u) + ln_det)
        innovations[t, at], spread[t, at] = v, variances
        x = decay * (x + K @ v)
    if not smooth:
        return Course(total, innovations, spread, predicted)
    r, N = np.zeros(size), np.zeros((size, size))
    states, shock, known = np.empty((n, size)), np.empty((n, size)), np.empty((n, 1 + m, 1 + m))
    steady: Array | None = None
    for t in range(n - 1, -1, -1):
        at_P, K, inverse, v = kept[t]
        h = H if whole[t] else H[present[:, t]]
        weight = inverse.T @ inverse
        L = np.diag(decay) @ (np.eye(size) - K @ h)
        r = h.T @ (weight @ v) + L.T @ r
        same = t + 1 < n and kept[t + 1][0] is at_P
        if steady is None or not same:
            N_next = h.T @ weight @ h + L.T @ N @ L
            steady = N_next if same and float(np.abs(N_next - N).max()) < 1e-9 * float(np.abs(N_next).max()) else None
            N = N_next
        states[t] = predicted[t] + at_P @ r
        shock[t], known[t] = r, N[: 1 + m, : 1 + m]
    return Course(total, innovations, spread, predicted, states, shock, known)


@dataclass(frozen=True)
class Jump:
    """A jump of the levels of some axes at sample `at`: its evidence in nats over no jump anywhere, the probability
    [m] that each axis has it, and sizes [m] with their standard deviations."""

    at: int
    evidence: float
    probability: Array
    size: Array
    sd: Array


def jump(found: Course, at: int, n: int) -> Jump:
    """What a jump at a sample is worth: a sum over the sets of axes that may have it.

    Its sizes are normal about 0 with one width for all axes of a set, in standard deviations of each axis' own size.
    The search over n samples is paid for once, whatever the set."""
    r, N = found.shock[at, 1 : found.known.shape[1]], found.known[at, 1:, 1:]
    m = r.size
    scale = 1.0 / np.sqrt(np.maximum(np.diag(N), 1e-300))
    z, R = r * scale, N * np.outer(scale, scale)
    ln_weight, sets = [], []
    for bits in range(1, 1 << m):
        chosen = [k for k in range(m) if bits >> k & 1]
        rho, x = R[np.ix_(chosen, chosen)], z[chosen]
        ln_bf = [
            0.5 * float(x @ np.linalg.solve(rho + np.eye(len(chosen)) / w**2, x))
            - 0.5 * float(np.linalg.slogdet(np.eye(len(chosen)) + w**2 * rho)[1])
            for w in WIDTHS
        ]
        ln_prior = len(chosen) * math.log(P_AXIS) + (m - len(chosen)) * math.log1p(-P_AXIS)
        ln_weight.append(ln_prior + float(np.logaddexp.reduce(ln_bf)) - math.log(len(WIDTHS)))
        sets.append([bits >> k & 1 for k in range(m)])
    ln_any = math.log1p(-((1.0 - P_AXIS) ** m))
    total = float(np.logaddexp.reduce(ln_weight))
    share = np.exp(np.array(ln_weight) - total)
    probability = share @ np.array(sets, np.float64)
    held = np.flatnonzero(probability >= 0.5)
    size, sd = np.zeros(m), np.full(m, math.inf)
    if held.size:
        inverse = np.linalg.inv(N[np.ix_(held, held)])
        size[held], sd[held] = inverse @ r[held], np.sqrt(np.diag(inverse))
    return Jump(at, total - ln_any - math.log(n), probability, size, sd)
