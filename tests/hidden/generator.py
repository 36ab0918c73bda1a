"""Recordings with a hidden effect, each with its truth. The diagnosis must not know this module, nor it the diagnosis.

Nothing of selfcal is imported. `draw(kind, seed)` gives one recording of six axes with a temperature and a supply
channel. One axis is asked about. `kind` is a cause of `CAUSES`, `pair`, `outside:NAME` or `clean:NAME`.

The size of an effect is the evidence that it offers, in nats: the expected gain of the truth over the null model.
The null is white noise beside a constant, a random walk or a Gauss-Markov drift. The null is refitted to the record
with the effect. The price of the search for the effect is taken off.
  - An effect that adds a known shape: the exact likelihood of block means, the drawn noise with both signs.
  - An effect that changes the spectrum: the Kullback-Leibler distance of the spectra.
  - An effect on single samples: the gain of the true mixture over a Gaussian.
  - Lattice, clipping and missing samples have natural sizes instead. See their functions.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize
from scipy.signal import lfilter

Array = NDArray[np.float64]

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
UNITS = {"g": "deg/s", "a": "m/s^2"}
RATES_HZ = (1.0, 10.0, 100.0)
#: How often each rate is drawn: a record at 100 Hz costs ten times as much as one at 10 Hz.
RATE_SHARES = (0.4, 0.4, 0.2)
#: Least and most, nats net of the search.
SIZES = {"plain": (40.0, 150.0), "near": (10.0, 15.0)}
#: Effects outside the table and in the background of a clean axis are certain.
CERTAIN = (120.0, 300.0)
TEMPERATURE_LSB, SUPPLY_LSB = 0.14, 2.418e-3
#: White noise N in unit/sqrt(Hz) of gyros (deg/s) and accelerometers (m/s^2).
N_RANGE = {"g": (0.01, 0.1), "a": (1e-3, 1.5e-2)}
#: K / N in 1/s, sigma_m / N in sqrt(Hz), alpha in 1/s.
K_RANGE, SIGMA_M_RANGE, ALPHA_RANGE = (2e-3, 0.08), (0.15, 2.0), (1e-3, 0.05)
#: Limits of the null's parameters, of the same kind; the limits of alpha are the default model's.
NULL_K, NULL_SIGMA_M, NULL_ALPHA = (1e-5, 1.0), (1e-2, 30.0), (2e-4, 0.2)


class Unattainable(Exception):
    """An effect of this kind cannot be so large in this record."""


# ----------------------------------------------------------------------------------------------------------- the noise


@dataclass(frozen=True)
class Law:
    """Noise of one axis, continuous-time: N unit/sqrt(Hz), K unit/s/sqrt(Hz), sigma_m unit, alpha 1/s."""

    law: str
    N: float
    K: float = 0.0
    sigma_m: float = 0.0
    alpha: float = 1.0

    def white_sd(self, dt: float) -> float:
        """Sd of the white noise of one sample."""
        return self.N / float(np.sqrt(dt))

    def drift(self, n: int, dt: float, rng: np.random.Generator) -> Array:
        """float64[n]: the drift without its white noise."""
        if self.law == "random_walk":
            return np.concatenate(([0.0], np.cumsum(rng.normal(0.0, self.K * np.sqrt(dt), n - 1))))
        if self.law == "gauss_markov":
            return gauss_markov(n, dt, self.sigma_m, self.alpha, rng)
        return np.zeros(n)

    def drift_spectrum(self, omega: Array, dt: float) -> Array:
        """Spectrum of the drift per sample (variance of a white sequence: its spectrum), omega in rad a sample."""
        if self.law == "random_walk":
            return np.asarray(self.K**2 * dt / np.abs(1.0 - np.exp(-1j * omega)) ** 2)
        if self.law == "gauss_markov":
            return gauss_markov_spectrum(omega, dt, self.sigma_m, self.alpha)
        return np.zeros(omega.size)

    def innovation_sd(self, dt: float) -> float:
        """Sd of the one-step prediction error in the steady state."""
        q, phi = (self.K * dt / self.N) ** 2, 1.0
        if self.law == "gauss_markov":
            phi = float(np.exp(-self.alpha * dt))
            q = (self.sigma_m / self.white_sd(dt)) ** 2 * (1.0 - phi**2)
        return self.white_sd(dt) * float(np.sqrt(1.0 + steady(phi, q)))


def gauss_markov(n: int, dt: float, sigma: float, alpha: float, rng: np.random.Generator) -> Array:
    """float64[n]: stationary first-order Gauss-Markov."""
    phi = np.exp(-alpha * dt)
    driven = rng.normal(0.0, sigma * np.sqrt(1.0 - phi**2), n)
    driven[0] = rng.normal(0.0, sigma)
    return np.asarray(lfilter([1.0], [1.0, -phi], driven))


def gauss_markov_spectrum(omega: Array, dt: float, sigma: float, alpha: float) -> Array:
    """Its spectrum per sample."""
    phi = np.exp(-alpha * dt)
    return np.asarray(sigma**2 * (1.0 - phi**2) / np.abs(1.0 - phi * np.exp(-1j * omega)) ** 2)


def steady(phi: float, q: float) -> float:
    """Steady-state variance of the predicted drift; q: variance of its step; both relative to the white noise's."""
    b = 1.0 - phi * phi - q
    return float(0.5 * (np.sqrt(b * b + 4.0 * q) - b))


# --------------------------------------------------------------------------------------------------- exact likelihood


@dataclass(frozen=True)
class Fit:
    """Sums of an exact filter for white noise of sd 1: `rss` [k, k] of the signals, `log_det`, n less what is free."""

    rss: Array
    log_det: float
    freedom: int

    def cost(self, weights: Array) -> float:
        """-ln likelihood of the signals with these squared weights, the white noise's size fitted, less a constant."""
        return 0.5 * (self.freedom * float(np.log(weights @ np.diag(self.rss))) + self.log_det)


@dataclass(frozen=True)
class Filtered:
    """Signals [k, n] and what is free [p, n] behind the steady filter. White noise of sd 1 comes out with variance s.

    `prior`: variance of the last row of what is free; infinite for a walk, whose first state is the bias.
    """

    y: Array
    x: Array
    s: float
    prior: float

    @property
    def information(self) -> Array:
        """[p, p] of what is free."""
        found = self.x @ self.x.T / self.s
        found[-1, -1] += 1.0 / self.prior
        return np.asarray(found)


def filtered(signals: Array, dt: float, law: str, theta: Sequence[float], regressors: Array | None = None) -> Filtered:
    """One filter over signals [k, n], a free bias and free regressors [p, n].

    `theta`: ln(K/N) or ln(sigma_m/N), ln(alpha). The filter is in its steady state from the first sample on. A
    regressor makes that exact: the response to the part of the first state's variance above the steady one.
    """
    n = signals.shape[1]
    phi, q, first = 1.0, 0.0, np.inf
    if law == "random_walk":
        q = (np.exp(theta[0]) * dt) ** 2
    elif law == "gauss_markov":
        phi, first = float(np.exp(-np.exp(theta[1]) * dt)), np.exp(2.0 * theta[0]) * dt
        q = first * (1.0 - phi * phi)
    p = steady(phi, q)
    decay = phi / (1.0 + p)
    rows = [] if regressors is None else list(regressors)
    if law == "gauss_markov":
        rows.append(np.ones(n))
    stacked = np.vstack([signals, *rows])
    seen = stacked if q == 0.0 else lfilter([1.0, -phi], [1.0, -decay], stacked)
    power = np.exp(np.maximum(np.arange(n) * np.log(decay), -300.0)) if decay < 1.0 else np.ones(n)
    return Filtered(seen[: len(signals)], np.vstack([seen[len(signals) :], power]), 1.0 + p, float(first - p))


def exact(signals: Array, dt: float, law: str, theta: Sequence[float], regressors: Array | None = None) -> Fit:
    """Exact likelihood of signals [k, n]; arguments as of `filtered`."""
    seen = filtered(signals, dt, law, theta, regressors)
    n, proper = signals.shape[1], bool(np.isfinite(seen.prior))
    b = seen.x @ seen.y.T / seen.s
    rss = seen.y @ seen.y.T / seen.s - b.T @ np.linalg.solve(seen.information, b)
    log_det = n * np.log(seen.s) + float(np.linalg.slogdet(seen.information)[1])
    if proper:
        log_det += np.log(seen.prior)
    return Fit(rss, float(log_det), n - len(seen.x) + proper)


def _grid(*limits: tuple[int, tuple[float, float]]) -> list[tuple[float, ...]]:
    """Every combination of so many values between each pair of limits, in logarithms."""
    return list(product(*(np.log(np.geomspace(low, high, count)).tolist() for count, (low, high) in limits)))


GRID: dict[str, list[tuple[float, ...]]] = {
    "constant": [()],
    "random_walk": _grid((24, NULL_K)),
    "gauss_markov": _grid((12, NULL_SIGMA_M), (9, NULL_ALPHA)),
}
LIMITS = {"constant": [], "random_walk": [NULL_K], "gauss_markov": [NULL_SIGMA_M, NULL_ALPHA]}


#: Cost, law and parameters.
Best = tuple[float, str, tuple[float, ...]]


def least(cost: Callable[[str, Sequence[float]], float], coarse: Mapping[str, Sequence[float]]) -> Best:
    """Least cost over the laws of the null; `coarse`: the costs on `GRID`. Laws far above the best are left."""
    starts = {law: int(np.argmin(values)) for law, values in coarse.items()}
    best: Best = min((coarse[law][at], law, GRID[law][at]) for law, at in starts.items())
    limit = best[0] + 10.0
    for law, at in starts.items():
        if law == "constant" or coarse[law][at] > limit:
            continue
        start = np.array(GRID[law][at])
        found = minimize(
            lambda theta, law=law: cost(law, theta),
            start,
            method="Nelder-Mead",
            bounds=[tuple(np.log(each)) for each in LIMITS[law]],
            options={
                "initial_simplex": np.vstack([start, start + 0.3 * np.eye(start.size)]),
                "xatol": 0.02,
                "fatol": 0.01,
            },
        )
        best = min(best, (float(found.fun), law, tuple(found.x)))
    return best


def innovations(y: Array, dt: float) -> Array:
    """float64[n]: prediction errors of the null refitted to y, over their sd; bias and first state by least squares."""
    signals = (y - y[0])[None]

    def cost(law: str, theta: Sequence[float]) -> float:
        return exact(signals, dt, law, theta).cost(np.ones(1))

    _, law, theta = least(cost, {law: [cost(law, theta) for theta in points] for law, points in GRID.items()})
    seen = filtered(signals, dt, law, theta)
    errors = seen.y[0] - np.linalg.solve(seen.information, seen.x @ seen.y[0] / seen.s) @ seen.x
    return np.asarray(errors / errors.std())


class Additive:
    """Evidence that a shape [n] offers beside noise [n], as a function of the shape's factor.

    The noise counts with both signs, so no chance product with the shape is left. The likelihood is that of block
    means at 1 Hz; what the shape does within the blocks meets the noise's variance there, as if that were white.
    """

    def __init__(self, noise: Array, shape: Array, dt: float, beside: Sequence[Array] = ()) -> None:
        block = max(1, round(1.0 / dt))
        n = noise.size // block * block
        means = [signal[:n].reshape(-1, block).mean(axis=1) for signal in (noise, shape, *beside)]
        self.signals = np.array(means[:2]) - np.array([[means[0][0]], [0.0]])
        self.beside = np.array([m / max(float(np.sqrt(m @ m)), 1e-300) for m in means[2:]]) if beside else None
        self.dt = dt * block
        self.within = n - n // block
        left, inner, *others = [
            (signal[:n].reshape(-1, block) - mean[:, None]).ravel()
            for signal, mean in zip((noise, shape, *beside), means, strict=True)
        ]
        for other in others:  # what a known shape beside takes away
            inner = inner - other * float(inner @ other) / max(float(other @ other), 1e-300)
        self.inner = float(inner @ inner) / max(float(left @ left), 1e-300) if block > 1 else 0.0
        self.coarse = {law: [self._fit(law, theta) for theta in points] for law, points in GRID.items()}
        self.nothing = self._least(0.0)

    def _fit(self, law: str, theta: Sequence[float]) -> Fit:
        return exact(self.signals, self.dt, law, theta, self.beside)

    def _least(self, factor: float) -> float:
        weights = np.array([1.0, factor**2])
        coarse = {law: [fit.cost(weights) for fit in fits] for law, fits in self.coarse.items()}
        return least(lambda law, theta: self._fit(law, theta).cost(weights), coarse)[0]

    def gain(self, factor: float) -> float:
        """Expected nats of the truth over the refitted null."""
        return self._least(factor) - self.nothing + 0.5 * self.within * float(np.log1p(factor**2 * self.inner))

    def factor(self, target: float) -> float:
        """Factor above 0 whose gain is `target`. Raises Unattainable."""
        return solve(self.gain, target, 1.0 / float(np.sqrt(self.signals[1] @ self.signals[1] + 1e-300)))


def solve(gain: Callable[[float], float], target: float, start: float, most: float = np.inf) -> float:
    """Argument, up to `most`, of a growing function; the search runs by factors of three from `start`."""
    low = high = min(start, most)
    for _ in range(60):
        if gain(high) >= target:
            break
        if high >= most:
            raise Unattainable
        low, high = high, min(3.0 * high, most)
    else:
        raise Unattainable
    while gain(low) > target:
        low, high = low / 3.0, low
    return float(np.exp(brentq(lambda x: gain(np.exp(x)) - target, np.log(low), np.log(high), xtol=1e-3)))


class Spectral:
    """Evidence that a spectrum offers against the null's: their Kullback-Leibler distance over n samples."""

    def __init__(self, n: int, dt: float) -> None:
        k = np.arange(1, n // 2 + 1)
        edges = np.unique(np.concatenate([k[:60], np.geomspace(60, k[-1] + 1, 500).astype(int), [k[-1] + 1]]))
        self.count = np.diff(edges).astype(float) * 2.0
        self.omega = 2.0 * np.pi * 0.5 * (edges[:-1] + edges[1:] - 1) / n
        self.n, self.dt = float(self.count.sum()), dt
        self.coarse = {law: [self._shape(law, theta) for theta in points] for law, points in GRID.items()}

    def _shape(self, law: str, theta: Sequence[float]) -> Array:
        """Spectrum over the white noise's."""
        values = np.exp(theta)
        given = {"constant": {}, "random_walk": dict(zip(["K"], values, strict=False))}.get(
            law, dict(zip(["sigma_m", "alpha"], values, strict=False))
        )
        return 1.0 + Law(law, 1.0, **given).drift_spectrum(self.omega, self.dt) * self.dt

    def gain(self, parts: Sequence[tuple[float, Array]]) -> float:
        """Expected nats; `parts`: share of the time and the spectrum then, on `omega`."""
        mean = sum(share * spectrum for share, spectrum in parts)
        truth = sum(share * float(self.count @ np.log(spectrum)) for share, spectrum in parts)

        def cost(shape: Array) -> float:
            white = float(self.count @ (mean / shape)) / self.n
            return 0.5 * (self.n * float(np.log(white)) + float(self.count @ np.log(shape)))

        coarse = {law: [cost(shape) for shape in shapes] for law, shapes in self.coarse.items()}
        return least(lambda law, theta: cost(self._shape(law, theta)), coarse)[0] - 0.5 * truth


# ----------------------------------------------------------------------------------------------------------- the scene


@dataclass
class Effect:
    """One hidden effect: `size` holds the keys of the contract's `estimate`, `nats` the gain net of the search's price
    (NaN where the size is a natural one)."""

    axis: str
    cause: str
    size: dict[str, Any]
    nats: float = float("nan")


@dataclass
class Record:
    """One recording. `columns`: name -> (unit, float64[n]). `t`: stamps float64[n] in s, None for an even grid."""

    kind: str
    seed: int
    rate_hz: float
    axis: str
    columns: dict[str, tuple[str, Array]]
    t: Array | None
    effects: list[Effect]
    laws: dict[str, Law]
    size: str

    @property
    def samples(self) -> int:
        """Rows."""
        return int(self.columns[self.axis][1].size)

    def causes(self, axis: str) -> list[str]:
        """Causes that this axis holds."""
        return [effect.cause for effect in self.effects if effect.axis == axis]

    def truth(self) -> dict[str, Any]:
        """JSON values of all that was drawn."""
        return {
            "kind": self.kind,
            "seed": self.seed,
            "size": self.size,
            "axis": self.axis,
            "rate_hz": self.rate_hz,
            "samples": self.samples,
            "effects": [vars(effect) for effect in self.effects],
            "laws": {axis: vars(law) for axis, law in self.laws.items()},
        }


@dataclass
class Scene:
    """A recording while it is drawn. `noise` is what the null should explain, `values` what is read."""

    rng: np.random.Generator
    rate: float
    n: int
    axis: str
    size: str
    laws: dict[str, Law] = field(default_factory=dict)
    noise: dict[str, Array] = field(default_factory=dict)
    white: dict[str, Array] = field(default_factory=dict)
    values: dict[str, Array] = field(default_factory=dict)
    lattice: dict[str, float] = field(default_factory=dict)
    effects: list[Effect] = field(default_factory=list)
    temperature: Array = field(default_factory=lambda: np.zeros(0))
    supply: Array = field(default_factory=lambda: np.zeros(0))
    keep: NDArray[np.int64] | None = None
    stamps: Array | None = None
    has_temperature: bool = True

    @property
    def dt(self) -> float:
        """Sampling interval, s."""
        return 1.0 / self.rate

    @property
    def t(self) -> Array:
        """float64[n], s."""
        return np.arange(self.n) / self.rate

    @property
    def length(self) -> float:
        """Duration, s."""
        return self.n / self.rate

    def log_uniform(self, low: float, high: float) -> float:
        """A number drawn uniformly in its logarithm."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def sign(self) -> float:
        """+1 or -1."""
        return float(self.rng.choice([-1.0, 1.0]))

    def sd(self, axis: str) -> float:
        """Sd of the white noise of one sample."""
        return self.laws[axis].white_sd(self.dt)

    def wander(self, time_s: float, smooth: bool = True) -> Array:
        """float64[n]: a random curve of sd 1 that forgets in about `time_s`; `smooth`: with a continuous slope."""
        step = max(1, int(time_s * self.rate / 50.0))
        m = self.n // step + 2
        settle = int(5.0 * time_s / (step * self.dt)) + 1
        curve = gauss_markov(m + settle, step * self.dt, 1.0, 1.0 / time_s, self.rng)
        if smooth:
            phi = np.exp(-step * self.dt / time_s)
            curve = np.asarray(lfilter([1.0 - phi], [1.0, -phi], curve))
        curve = np.interp(np.arange(self.n) / step, np.arange(m), curve[settle:])
        return np.asarray((curve - curve.mean()) / max(float(curve.std()), 1e-12))


def _law(scene: Scene, axis: str, law: str) -> Law:
    n = scene.log_uniform(*N_RANGE[axis[0]])
    if law == "random_walk":
        return Law(law, n, K=n * scene.log_uniform(*K_RANGE))
    if law == "gauss_markov":
        return Law(law, n, sigma_m=n * scene.log_uniform(*SIGMA_M_RANGE), alpha=scene.log_uniform(*ALPHA_RANGE))
    return Law(law, n)


def _temperature(scene: Scene, shape: str) -> Array:
    """degC: `rise` grows all but all the time; `cycle`, `wander` and `mixed` turn back. None is a pure line."""
    curve = scene.rng.uniform(15.0, 35.0) + scene.rng.uniform(0.2, 0.6) * scene.wander(scene.log_uniform(100.0, 400.0))
    if shape in ("rise", "mixed"):
        curve += scene.rng.uniform(3.0, 12.0) * (1.0 - np.exp(-scene.t / scene.log_uniform(200.0, 1200.0)))
    if shape in ("cycle", "mixed"):
        phase = scene.rng.uniform(0.0, 2.0 * np.pi)
        period = min(scene.log_uniform(400.0, 1500.0), scene.length / 2.0)
        curve += scene.rng.uniform(1.5, 4.0) * np.sin(2.0 * np.pi * scene.t / period + phase)
    if shape == "wander":
        curve += scene.rng.uniform(1.0, 3.0) * scene.wander(scene.log_uniform(150.0, 500.0))
    return curve


def _supply(scene: Scene) -> Array:
    """V: a regulator that wanders, with a step in half of the records."""
    curve = 5.0 + scene.rng.uniform(0.005, 0.02) * scene.wander(scene.log_uniform(60.0, 400.0), smooth=False)
    if scene.rng.random() < 0.5:
        curve += scene.sign() * scene.rng.uniform(0.02, 0.06) * (scene.t > scene.rng.uniform(0.1, 0.9) * scene.length)
    return curve


# ------------------------------------------------------------------------------------------- causes that add a shape


@dataclass
class Shape:
    """What a cause adds for a factor of one; `estimate(factor)`: the contract's keys."""

    values: Array
    estimate: Callable[[float], dict[str, Any]]


def temperature(scene: Scene, axis: str) -> Shape:
    """A coefficient of the temperature."""
    curve = scene.temperature - scene.temperature.mean()
    time = scene.t - scene.t.mean()
    left = curve - time * float(time @ curve) / float(time @ time)
    if left.std() < 0.5 * curve.std():
        raise Unattainable  # a temperature that all but rises cannot be told from a ramp
    return Shape(curve, lambda factor: {"coefficient": factor})


def supply(scene: Scene, axis: str) -> Shape:
    """A coefficient of the supply."""
    return Shape(scene.supply - scene.supply.mean(), lambda factor: {"coefficient": factor})


def cross_axis(scene: Scene, axis: str) -> Shape:
    """A coefficient of another axis's reading."""
    other = str(scene.rng.choice([name for name in AXES if name != axis and not _sick(scene, name)]))
    curve = scene.values[other] - scene.values[other].mean()
    return Shape(curve, lambda factor: {"other": other, "coefficient": factor})


def ramp(scene: Scene, axis: str) -> Shape:
    """A constant slope."""
    return Shape(scene.t - scene.t.mean(), lambda factor: {"slope": factor})


def step(scene: Scene, axis: str) -> Shape:
    """One jump."""
    time = float(scene.rng.uniform(0.1, 0.9) * scene.length)
    return Shape((scene.t >= time).astype(float), lambda factor: {"time_s": time, "amplitude": factor})


def periodic(scene: Scene, axis: str) -> Shape:
    """A sine; in one record of five a square wave, whose size is not judged."""
    frequency = scene.log_uniform(10.0 / scene.length, 0.45 * scene.rate)
    wave = np.sin(2.0 * np.pi * frequency * scene.t + scene.rng.uniform(0.0, 2.0 * np.pi))
    if scene.rng.random() < 0.2 and frequency < 0.1 * scene.rate:
        return Shape(np.sign(wave), lambda factor: {"frequency_hz": frequency})
    return Shape(wave, lambda factor: {"frequency_hz": frequency, "amplitude": abs(factor)})


def _sick(scene: Scene, axis: str) -> bool:
    return any(effect.axis == axis for effect in scene.effects)


def _target(scene: Scene, size: str) -> float:
    return float(scene.rng.uniform(*(CERTAIN if size == "certain" else SIZES[size])))


def _add(scene: Scene, axis: str, cause: str, shape: Shape, price: float, beside: Sequence[Shape] = ()) -> None:
    """The shape at a size drawn for the scene; `beside`: shapes that the null knows already."""
    nats = _target(scene, scene.size)
    known = [other.values for other in beside]
    sized = Additive(scene.noise[axis], shape.values, scene.dt, known)
    factor = scene.sign() * sized.factor(nats + price)
    scene.values[axis] = scene.values[axis] + factor * shape.values
    scene.effects.append(Effect(axis, cause, shape.estimate(factor), nats))


# ------------------------------------------------------------------------------------ causes that change the spectrum


def flicker(scene: Scene, axis: str, price: float) -> None:
    """1/f noise in place of the drift: Gauss-Markov terms, half a decade apart; two-sided density B^2/(2 pi f).

    B is 5 N at most. At 1 Hz some 50 nats are the most that an hour can offer, so plain ones come at 10 and 100 Hz.
    """
    law = scene.laws[axis] = Law("flicker", scene.laws[axis].N)
    step = 0.5 * np.log(10.0)
    rates = np.exp(np.arange(np.log(0.1 / scene.length), np.log(2.0 * scene.rate), step))
    spectral = Spectral(scene.n, scene.dt)
    terms = sum(gauss_markov_spectrum(spectral.omega, scene.dt, 1.0, alpha) for alpha in rates)
    nats = _target(scene, scene.size)

    def gain(b: float) -> float:
        return spectral.gain([(1.0, scene.sd(axis) ** 2 + b**2 * step / np.pi * terms)])

    b = solve(gain, nats + price, 0.05 * law.N, 5.0 * law.N)
    sigma = b * np.sqrt(step / np.pi)
    scene.noise[axis] = scene.white[axis] + sum(gauss_markov(scene.n, scene.dt, sigma, a, scene.rng) for a in rates)
    scene.effects.append(Effect(axis, "flicker", {"B": b}, nats))


def colored_noise(scene: Scene, axis: str, price: float) -> None:
    """Neighbouring samples of the white noise share a part; N stays."""
    spectral = Spectral(scene.n, scene.dt)
    drift = scene.laws[axis].drift_spectrum(spectral.omega, scene.dt)
    nats = _target(scene, scene.size)

    def gain(theta: float) -> float:
        taps = np.abs(1.0 + theta * np.exp(-1j * spectral.omega)) ** 2 / (1.0 + theta) ** 2
        return spectral.gain([(1.0, drift + scene.sd(axis) ** 2 * taps)])

    theta = solve(gain, nats + price, 0.01, 0.95)
    white = scene.rng.normal(0.0, scene.sd(axis), scene.n + 1)
    scene.noise[axis] += (white[1:] + theta * white[:-1]) / (1.0 + theta) - scene.white[axis]
    scene.effects.append(Effect(axis, "colored_noise", {"lag1": theta / (1.0 + theta**2)}, nats))


def variance_change(scene: Scene, axis: str, price: float) -> None:
    """The white noise's sd changes by a factor at one time."""
    spectral = Spectral(scene.n, scene.dt)
    drift = scene.laws[axis].drift_spectrum(spectral.omega, scene.dt)
    share = float(scene.rng.uniform(0.15, 0.85))
    sign = scene.sign()
    nats = _target(scene, scene.size)

    def gain(log_ratio: float) -> float:
        after = scene.sd(axis) ** 2 * np.exp(2.0 * sign * log_ratio)
        return spectral.gain([(share, drift + scene.sd(axis) ** 2), (1.0 - share, drift + after)])

    ratio = float(np.exp(sign * solve(gain, nats + price, 0.02, np.log(5.0))))
    later = scene.t >= share * scene.length
    scene.noise[axis] += scene.white[axis] * (ratio - 1.0) * later
    scene.effects.append(Effect(axis, "variance_change", {"time_s": share * scene.length, "ratio": ratio}, nats))


# -------------------------------------------------------------------------------------------- causes on single samples


def outlier_gain(amplitudes: Array, n: int) -> float:
    """Expected nats of the true mixture over one Gaussian; `amplitudes`: of the outliers among n samples, over the sd.

    The mixture's wide part has their mean square. The ordinary noise is averaged by Gauss-Hermite nodes.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(21)
    weights = weights / weights.sum()
    share, wide = amplitudes.size / n, 1.0 + float((amplitudes**2).mean())
    null = 1.0 + share * (wide - 1.0)

    def advantage(z: Array) -> Array:
        mixed = (1.0 - share) * np.exp(-0.5 * z**2) + share / np.sqrt(wide) * np.exp(-0.5 * z**2 / wide)
        return np.asarray(np.log(mixed) + 0.5 * z**2 / null + 0.5 * np.log(null))

    hit = float((advantage(amplitudes[:, None] + nodes) @ weights).sum())
    return hit + (n - amplitudes.size) * float(advantage(nodes) @ weights)


def _outlier_gain(form: Array, n: int, size: float) -> float:
    return outlier_gain(size * form, n)


def outliers(scene: Scene, axis: str, price: float) -> None:
    """Single samples far off, at random times and of both signs."""
    nats = _target(scene, scene.size)
    for count in scene.rng.permutation(np.arange(2, 25)):
        form = 1.0 + 0.15 * scene.rng.uniform(-1.0, 1.0, count)
        size = solve(partial(_outlier_gain, form, scene.n), nats + price, 1.0)
        if 4.5 <= size <= 15.0:
            break
    else:
        raise Unattainable
    places = scene.rng.choice(np.arange(5, scene.n - 5), count, replace=False)
    signs = scene.rng.choice([-1.0, 1.0], count)
    scene.values[axis][places] += signs * size * form * scene.laws[axis].innovation_sd(scene.dt)
    largest = float(places[int(np.argmax(form))]) / scene.rate
    scene.effects.append(Effect(axis, "outliers", {"fraction": count / scene.n, "time_s": largest}, nats))


def motion(scene: Scene, axis: str, price: float) -> None:
    """One to four bursts of 5 to 30 s, on all axes alike, of a band below 5 Hz. `price` is that of one burst.

    The gain is a change of variance: 0.5 m (r - 1 - ln r) for m blocks (0.1 s or one sample) whose variance is r-fold,
    summed over axes and bursts.
    """
    bursts = int(scene.rng.integers(1, 5))
    nats = _target(scene, scene.size)
    block = max(1, round(0.1 * scene.rate))
    intervals: list[tuple[float, float]] = []
    while len(intervals) < bursts:
        start, long = float(scene.rng.uniform(0.05, 0.9) * scene.length), float(scene.rng.uniform(5.0, 30.0))
        if all(start > b + 60.0 or start + long < a - 60.0 for a, b in intervals):
            intervals.append((start, start + long))
    inside = np.zeros(scene.n, bool)
    for start, end in intervals:
        inside |= (scene.t >= start) & (scene.t < end)
    blocks = len(AXES) * float(inside.sum()) / block
    excess = solve(lambda x: 0.5 * blocks * (x - float(np.log1p(x))), nats + price * bursts, 0.1)
    for name in AXES:
        wave = scene.rng.normal(0.0, 1.0, scene.n // block + 2)
        shaken = np.interp(np.arange(scene.n) / block, np.arange(wave.size), wave)
        size = scene.sd(name) * np.sqrt(excess / block)
        scene.values[name] = scene.values[name] + inside * shaken * size / shaken[inside].std()
        scene.effects.append(Effect(name, "motion", {"intervals": sorted(intervals)}, nats))


def saturation(scene: Scene, axis: str, price: float) -> None:
    """The reading stops at a limit. Plain: 1 to 5 % of the samples, 40 at least; near: 10 to 15 samples."""
    many = scene.rng.uniform(0.01, 0.05) * scene.n
    count = int(max(many, 40.0) if scene.size != "near" else scene.rng.integers(10, 16))
    sign = scene.sign()
    limit = float(np.sort(sign * scene.values[axis])[-count])
    if q := scene.lattice.get(axis):
        limit = q * round(limit / q)
    scene.values[axis] = sign * np.minimum(sign * scene.values[axis], limit)
    scene.effects.append(Effect(axis, "saturation", {"limit": sign * limit}))


def quantization(scene: Scene, axis: str, price: float) -> None:
    """A coarse lattice that no model file states. Plain: 0.8 to 2 sd of the white noise; near: 0.6 to 0.8.

    Beside another cause 1.2 at most, so that its noise takes no more than a tenth of the other's evidence.
    """
    low, high = (0.6, 0.8) if scene.size == "near" else (0.8, 1.2 if _sick(scene, axis) else 2.0)
    q = scene.lattice[axis] = float(f"{scene.log_uniform(low, high) * scene.sd(axis):.4g}")
    scene.effects.append(Effect(axis, "quantization", {"lsb": q}))


def missing_samples(scene: Scene, axis: str, price: float) -> None:
    """Rows without a sample, or (one record of three) rows that repeat the one before on every channel.

    Plain: 0.5 to 5 % of the samples, near: 0.15 to 0.4 %. Singly, or in bursts of up to 30.
    """
    low, high = (0.0015, 0.004) if scene.size == "near" else (0.005, 0.05)
    held = scene.rng.random() < 0.33
    lost = _losses(scene, scene.log_uniform(low, high), 1 if held else int(scene.rng.choice([1, 5, 30])))
    if held:
        scene.keep = np.maximum.accumulate(np.where(lost, 0, np.arange(scene.n)))
    else:
        scene.keep = np.flatnonzero(~lost)
    for name in AXES:
        scene.effects.append(Effect(name, "missing_samples", {"missing": int(lost.sum()), "held": bool(held)}))


def _losses(scene: Scene, share: float, burst: int) -> NDArray[np.bool_]:
    """bool[n]: about this share of the samples, in bursts of at most so many; never the first or last."""
    lost = np.zeros(scene.n, bool)
    count = max(1, round(share * scene.n))
    while lost.sum() < count:
        long = min(int(scene.rng.integers(1, burst + 1)), count - int(lost.sum()))
        start = int(scene.rng.integers(1, scene.n - long - 1))
        lost[start : start + long] = True
    return lost


# ----------------------------------------------------------------------------------------------------------- the table


@dataclass(frozen=True)
class Cause:
    """How a cause is drawn. Exactly one of `shape` and `make` is given; `stage` orders the causes of one record.

    `price`: nats that noise alone gives to the best of the places looked at, of n samples. The figures for line, step,
    change of variance, other axis and motion are the design's; "below 1" and outliers count as 1.
    """

    stage: int
    shape: Callable[[Scene, str], Shape] | None = None
    make: Callable[[Scene, str, float], None] | None = None
    price: Callable[[int], float] = lambda n: 1.0
    #: Estimates whose interval is judged.
    judged: tuple[str, ...] = ()


CAUSES: dict[str, Cause] = {
    "temperature": Cause(1, shape=temperature, judged=("coefficient",)),
    "supply": Cause(1, shape=supply, judged=("coefficient",)),
    "cross_axis": Cause(1, shape=cross_axis, price=lambda n: 1.4, judged=("coefficient",)),
    "ramp": Cause(1, shape=ramp, judged=("slope",)),
    "step": Cause(1, shape=step, price=lambda n: 4.5, judged=("amplitude", "time_s")),
    "periodic": Cause(1, shape=periodic, price=lambda n: np.log(n / 2) + 1.5, judged=("amplitude", "frequency_hz")),
    "flicker": Cause(0, make=flicker, judged=("B",)),
    "colored_noise": Cause(0, make=colored_noise, judged=("lag1",)),
    "quantization": Cause(4, make=quantization),
    "outliers": Cause(2, make=outliers, judged=("fraction",)),
    "variance_change": Cause(0, make=variance_change, price=lambda n: 2.6, judged=("ratio", "time_s")),
    "saturation": Cause(3, make=saturation),
    "missing_samples": Cause(5, make=missing_samples),
    "motion": Cause(2, make=motion, price=lambda n: 6.0),
}

#: Pairs that one record cannot show: both change the spectrum, both want the same samples or the same extremes.
IMPOSSIBLE = {
    frozenset(pair)
    for pair in (
        ("flicker", "colored_noise"),
        ("flicker", "variance_change"),
        ("colored_noise", "variance_change"),
        ("saturation", "outliers"),
        ("saturation", "motion"),
        ("saturation", "ramp"),
        ("outliers", "motion"),
    )
}
PAIRS = [(a, b) for i, a in enumerate(CAUSES) for b in list(CAUSES)[i + 1 :] if frozenset((a, b)) not in IMPOSSIBLE]


# --------------------------------------------------------------------------------------------------- outside the table


def _certain(scene: Scene) -> float:
    return float(scene.rng.uniform(*CERTAIN))


def _shaped(values: Callable[[Scene], Array]) -> Callable[[Scene], None]:
    """An effect that adds a shape, of a size that is certain."""

    def apply(scene: Scene) -> None:
        curve = values(scene)
        sized = Additive(scene.noise[scene.axis], curve, scene.dt)
        factor = scene.sign() * sized.factor(_certain(scene))
        scene.values[scene.axis] = scene.values[scene.axis] + factor * curve

    return apply


def _scaled(level: Callable[[Scene], Array]) -> Callable[[Scene], None]:
    """White noise whose ln sd follows a curve c of variance 1: n c^2 nats, at most a factor e^0.6 for one sd."""

    def apply(scene: Scene) -> None:
        curve = level(scene)
        curve = (curve - curve.mean()) / curve.std()
        depth = min(0.6, float(np.sqrt(_certain(scene) / scene.n)))
        scene.values[scene.axis] = scene.values[scene.axis] + scene.white[scene.axis] * np.expm1(depth * curve)

    return apply


def _telegraph(scene: Scene, dwell_s: float) -> Array:
    """0 or 1, changing at random."""
    change = scene.rng.random(scene.n) < scene.dt / dwell_s
    change[scene.n // 3] = change[2 * scene.n // 3] = True
    return np.asarray(np.cumsum(change) % 2, float)


def _wandering_line(scene: Scene) -> Array:
    """A line whose frequency wanders by some per cent."""
    frequency = scene.log_uniform(20.0 / scene.length, 0.3 * scene.rate) * (1.0 + 0.03 * scene.wander(60.0))
    return np.asarray(np.sin(2.0 * np.pi * np.cumsum(frequency) / scene.rate))


def _hysteresis(scene: Scene) -> Array:
    """The temperature through a play of half its sd: what lags behind when it turns."""
    width = 0.5 * float(scene.temperature.std())
    curve, state = np.empty(scene.n), float(scene.temperature[0])
    for i, value in enumerate(scene.temperature.tolist()):
        state = min(max(state, value - width), value + width)
        curve[i] = state
    return np.asarray(curve - curve.mean())


def _turn_on(scene: Scene) -> Array:
    """An exponential settling; there is no temperature channel."""
    scene.has_temperature = False
    return np.asarray(np.exp(-scene.t / scene.log_uniform(20.0, 200.0)))


def _sawtooth(scene: Scene) -> Array:
    """A charge that builds up and is reset, at irregular times."""
    curve, phase = np.empty(scene.n), 0.0
    slope = scene.dt / scene.log_uniform(60.0, 300.0)
    for i, threshold in enumerate(scene.rng.uniform(0.7, 1.3, scene.n).tolist()):
        phase = 0.0 if phase > threshold else phase + slope
        curve[i] = phase
    return curve


def _ping_pong(scene: Scene) -> Array:
    """Two converters in turn, whose difference wanders through zero."""
    return np.asarray((-1.0) ** np.arange(scene.n) * scene.wander(scene.log_uniform(100.0, 300.0)))


def _charge_hits(scene: Scene) -> Array:
    """Jumps to one side at random times; each decays in 5 to 30 s."""
    hits = (scene.rng.random(scene.n) < 15.0 / scene.n) * scene.rng.exponential(1.0, scene.n)
    hits[scene.n // 2] += 1.0
    return np.asarray(lfilter([1.0], [1.0, -np.exp(-scene.dt / scene.log_uniform(5.0, 30.0))], hits))


def _chirp(scene: Scene) -> Array:
    """A fan that slows down: a line that sweeps over a factor of three."""
    top = scene.log_uniform(0.05 * scene.rate, 0.4 * scene.rate)
    frequency = top * np.exp(-np.log(3.0) * scene.t / scene.length)
    return np.asarray(np.sin(2.0 * np.pi * np.cumsum(frequency) / scene.rate))


def _skewed(scene: Scene) -> None:
    """White noise of a skewed law (gamma): n skewness^2 / 12 nats."""
    skewness = min(1.8, float(np.sqrt(12.0 * _certain(scene) / scene.n)))
    shape = 4.0 / skewness**2
    drawn = (scene.rng.gamma(shape, 1.0, scene.n) - shape) / np.sqrt(shape)
    scene.values[scene.axis] = scene.values[scene.axis] - scene.white[scene.axis] + drawn * scene.sd(scene.axis)


def _dead_band(scene: Scene) -> None:
    """Readings within 0.3 sd of a level near the median read as that level."""
    y = scene.values[scene.axis]
    level = float(np.quantile(y, scene.rng.uniform(0.4, 0.6)))
    scene.values[scene.axis] = np.asarray(np.where(np.abs(y - level) < 0.3 * scene.sd(scene.axis), level, y))


def _sticky_code(scene: Scene) -> None:
    """On a harmless lattice one code takes 60 % of its two neighbours' readings on either side."""
    q = scene.lattice[scene.axis] = 0.2 * scene.sd(scene.axis)
    y = q * np.rint(scene.values[scene.axis] / q)
    code = q * np.rint(np.quantile(y, scene.rng.uniform(0.35, 0.65)) / q)
    near = (np.abs(y - code) < 2.5 * q) & (scene.rng.random(scene.n) < 0.6)
    scene.values[scene.axis] = np.asarray(np.where(near, code, y))


def _stuck_bit(scene: Scene) -> None:
    """On a harmless lattice the bit of four LSB always reads 0."""
    q = scene.lattice[scene.axis] = 0.2 * scene.sd(scene.axis)
    codes = np.rint(scene.values[scene.axis] / q).astype(np.int64)
    scene.values[scene.axis] = q * (codes & ~np.int64(4)).astype(np.float64)


def _dropouts(scene: Scene) -> None:
    """Every so many samples this axis repeats its last reading."""
    every = int(scene.rng.integers(7, 60))
    places = np.arange(every, scene.n, every)
    scene.values[scene.axis][places] = scene.values[scene.axis][places - 1]


def _clock_jump(scene: Scene) -> None:
    """From some time on the clock runs 2 to 6 % slower; the stamps say so."""
    later = scene.t > scene.rng.uniform(0.3, 0.7) * scene.length
    scene.stamps = np.concatenate(([0.0], np.cumsum(scene.dt * (1.0 + scene.rng.uniform(0.02, 0.06) * later[1:]))))


def _echo(scene: Scene) -> None:
    """A buffer that is read again: a part of the white noise comes back 11 to 60 samples later; n a^2 / 2 nats."""
    part = min(0.8, float(np.sqrt(2.0 * _certain(scene) / scene.n)))
    scene.values[scene.axis] += part * np.roll(scene.white[scene.axis], int(scene.rng.integers(11, 61)))


def _half_bandwidth(scene: Scene) -> None:
    """In part of the record neighbouring samples share half of their white noise, at the same variance."""
    white = scene.white[scene.axis]
    start = scene.rng.uniform(0.1, 0.5)
    inside = (scene.t > start * scene.length) & (scene.t < (start + 0.4) * scene.length)
    shared = (white + np.roll(white, 1)) / np.sqrt(2.0)
    scene.values[scene.axis] = scene.values[scene.axis] + inside * (shared - white)


#: The first eleven are the design's list; the others were drawn by somebody who had not read the diagnosis.
OUTSIDE: dict[str, Callable[[Scene], None]] = {
    "bistable": _shaped(lambda scene: _telegraph(scene, scene.log_uniform(40.0, 200.0))),
    "breathing": _scaled(lambda scene: np.sin(2.0 * np.pi * scene.t / scene.log_uniform(60.0, 500.0))),
    "intermittent_scale": _scaled(lambda scene: _telegraph(scene, scene.log_uniform(30.0, 120.0))),
    "wandering_line": _shaped(_wandering_line),
    "skewed": _skewed,
    "hysteresis": _shaped(_hysteresis),
    "dead_band": _dead_band,
    "sticky_code": _sticky_code,
    "dropouts": _dropouts,
    "turn_on": _shaped(_turn_on),
    "clock_jump": _clock_jump,
    "sawtooth": _shaped(_sawtooth),
    "ping_pong": _shaped(_ping_pong),
    "charge_hits": _shaped(_charge_hits),
    "chirp": _shaped(_chirp),
    "noise_follows_temperature": _scaled(lambda scene: scene.temperature),
    "echo": _echo,
    "stuck_bit": _stuck_bit,
    "half_bandwidth": _half_bandwidth,
}


# --------------------------------------------------------------------------------------------------------------- clean

#: What complicates a record whose asked axis is clean.
CLEAN = ("nothing", "temperature_rises", "supply_steps", "others_sick", "ms_stamps", "few_missing", "constant")


def _others_sick(scene: Scene, count: int) -> None:
    """So many other axes get a cause each that stays on its axis."""
    alone = ("ramp", "step", "periodic", "outliers", "variance_change", "colored_noise", "temperature", "supply")
    names = [name for name in AXES if name != scene.axis]
    size, scene.size = scene.size, "plain"
    for name in scene.rng.choice(names, count, replace=False):
        try:
            _apply(scene, str(name), [str(scene.rng.choice(alone))])
        except Unattainable:
            continue
    scene.size = size


def _supply_steps(scene: Scene) -> None:
    scene.supply = scene.supply + scene.sign() * 0.06 * (scene.t > scene.rng.uniform(0.2, 0.8) * scene.length)


def _ms_stamps(scene: Scene) -> None:
    """Stamps of 1 ms with 0.3 ms of jitter, of a clock up to 0.3 % off its nominal rate."""
    late = scene.t * (1.0 + scene.rng.uniform(-0.003, 0.003)) + scene.rng.uniform(0.0, 3e-4, scene.n)
    scene.stamps = np.round(late - late[0], 3)


# ---------------------------------------------------------------------------------------------------------------- draw


def _apply(scene: Scene, axis: str, causes: Sequence[str]) -> None:
    """The causes on one axis: spectra first, then shapes, each sized with the others known, then single samples."""
    ordered = sorted(causes, key=lambda cause: CAUSES[cause].stage)
    shapes: dict[str, Shape] = {}
    pending = list(ordered)
    for cause in ordered:
        entry = CAUSES[cause]
        if entry.stage == 0 and entry.make is not None:
            before = scene.noise[axis]
            scene.noise[axis] = before.copy()
            entry.make(scene, axis, entry.price(scene.n))
            scene.values[axis] = scene.values[axis] + scene.noise[axis] - before
            pending.remove(cause)
    for cause in pending:
        shape = CAUSES[cause].shape
        if shape is not None:
            shapes[cause] = shape(scene, axis)
    for cause in pending:
        entry = CAUSES[cause]
        if entry.make is not None:
            scene.values[axis] = scene.values[axis].copy()
            entry.make(scene, axis, entry.price(scene.n))
        else:
            beside = [shape for other, shape in shapes.items() if other != cause]
            _add(scene, axis, cause, shapes[cause], entry.price(scene.n), beside)


def _scene(rng: np.random.Generator, kind: str, size: str, rate: float | None, law: str | None) -> Scene:
    """Six axes of noise, a temperature and a supply, without any effect."""
    rate = float(rng.choice(RATES_HZ, p=RATE_SHARES)) if rate is None else rate
    scene = Scene(rng, rate, round(rng.uniform(1200.0, 3600.0) * rate), str(rng.choice(AXES)), size)
    turns = kind in ("temperature", "ramp", "pair", "outside:hysteresis")
    curves = ["cycle", "wander", "mixed"] if turns else ["rise", "cycle", "wander", "mixed"]
    scene.temperature = _temperature(scene, "rise" if kind == "clean:temperature_rises" else str(rng.choice(curves)))
    scene.supply = _supply(scene)
    fine = rng.random() < 0.5
    for axis in AXES:
        drawn = str(rng.choice(["random_walk", "gauss_markov", "constant"], p=[0.45, 0.45, 0.1]))
        chosen = scene.laws[axis] = _law(scene, axis, drawn if law is None or axis != scene.axis else law)
        scene.white[axis] = rng.normal(0.0, scene.sd(axis), scene.n)
        scene.noise[axis] = scene.white[axis] + chosen.drift(scene.n, scene.dt, rng)
        bias = rng.normal(0.0, 0.5) if axis[0] == "g" else rng.normal(9.81 if axis == "az" else 0.0, 0.2)
        scene.values[axis] = bias + scene.noise[axis]
        if fine:  # a lattice that does no harm
            scene.lattice[axis] = float(f"{rng.uniform(0.03, 0.25) * scene.sd(axis):.4g}")
    return scene


def draw(
    kind: str,
    seed: int,
    size: str = "plain",
    rate: float | None = None,
    law: str | None = None,
    pair: tuple[str, str] | None = None,
) -> Record:
    """One recording. `kind`: see the module. `size`: plain or near. `rate`: Hz. `law`: the asked axis's drift.

    `pair`: the two causes of a `pair`, drawn if not given. The same arguments give the same recording.
    """
    for attempt in range(100):
        rng = np.random.default_rng([seed, zlib.crc32(f"{kind} {size} {law}".encode()), attempt])
        try:
            return _draw(rng, kind, seed, size, rate, law, pair)
        except Unattainable:
            continue
    raise RuntimeError(f"no record of {kind}, {size} in 100 attempts")


def _draw(
    rng: np.random.Generator,
    kind: str,
    seed: int,
    size: str,
    rate: float | None,
    law: str | None,
    pair: tuple[str, str] | None,
) -> Record:
    family, _, name = kind.partition(":")
    scene = _scene(rng, kind, size, rate, "constant" if name == "constant" else law)
    if family == "clean":
        _clean(scene, name)
    elif family == "outside":
        OUTSIDE[name](scene)
        scene.effects.append(Effect(scene.axis, kind, {}))
    else:
        causes = [kind] if kind != "pair" else list(pair or PAIRS[int(rng.integers(len(PAIRS)))])
        if rng.random() < 0.25:
            _others_sick(scene, 1)
        _apply(scene, scene.axis, causes)
        if kind in ("temperature", "supply", "step") and rng.random() < 0.3:
            _share(scene, kind)
    return _read_out(scene, kind, seed)


def _clean(scene: Scene, name: str) -> None:
    if name == "supply_steps":
        _supply_steps(scene)
    elif name == "others_sick":
        _others_sick(scene, int(scene.rng.integers(1, 4)))
    elif name == "ms_stamps":
        _ms_stamps(scene)
    elif name == "few_missing":
        scene.keep = np.flatnonzero(~_losses(scene, float(scene.rng.uniform(2e-4, 8e-4)), 1))


def _share(scene: Scene, cause: str) -> None:
    """The asked axis's cause on another axis too, of a size of its own; a step at the same time."""
    other = str(scene.rng.choice([name for name in AXES if name != scene.axis and not _sick(scene, name)]))
    mine = next(effect for effect in scene.effects if effect.axis == scene.axis)
    shape = CAUSES[cause].shape
    assert shape is not None
    made = shape(scene, other)
    if cause == "step":
        time = mine.size["time_s"]
        made = Shape((scene.t >= time).astype(float), lambda factor: {"time_s": time, "amplitude": factor})
    _add(scene, other, cause, made, CAUSES[cause].price(scene.n))


def _read_out(scene: Scene, kind: str, seed: int) -> Record:
    """The sensor's lattice, the slow channels' noise and lattice, missing rows, stamps."""
    rng = scene.rng
    columns: dict[str, tuple[str, Array]] = {}
    for axis in AXES:
        q = scene.lattice.get(axis)
        y = scene.values[axis]
        columns[axis] = (UNITS[axis[0]], y if q is None else q * np.rint(y / q))
    slow = rng.normal(0.0, 1.0, (2, scene.n))
    if scene.has_temperature:
        read = scene.temperature + 0.1 * slow[0]
        columns["temp"] = ("degC", TEMPERATURE_LSB * np.rint(read / TEMPERATURE_LSB))
    columns["supply"] = ("V", SUPPLY_LSB * np.rint((scene.supply + 1e-3 * slow[1]) / SUPPLY_LSB))
    stamps = scene.stamps
    if scene.keep is not None:
        rows = scene.keep
        columns = {name: (unit, values[rows]) for name, (unit, values) in columns.items()}
        if rows.size < scene.n:
            stamps = (scene.t if stamps is None else stamps)[rows]
    if stamps is None and rng.random() < 0.5:
        stamps = scene.t
    laws = scene.laws
    return Record(kind, seed, scene.rate, scene.axis, columns, stamps, scene.effects, laws, scene.size)
