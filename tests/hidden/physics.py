"""A second generator of hidden effects: a sensor's physics, sample by sample, from a table of effects alone.

Imports nothing of selfcal. Six axes, a temperature and a supply are made `FINE` times finer than the read-out, then
averaged over the sensor's aperture, decimated and put on a lattice. Truth: a drift law and white noise an axis, and
one effect of `KINDS` on one axis. The effect's amount is the one at which the right model gains a drawn number of
nats (evidence.py). `pair()` also gives a second record of the same truth: new noise, temperature and other axes.

`KINDS` states for each kind the names that are right before any run. `accepts` names that describe the same record
as well. `unexplained` counts half and is never a name.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.signal import butter, lfilter, sosfilt
from scipy.special import ndtr

from evidence import (
    Array,
    band_gain,
    base_log_likelihood,
    column_gain,
    correlation_gain,
    dense_log_likelihood,
    drift_covariance,
    scale_gain,
    solve,
)

Random = np.random.Generator
Truth = dict[str, Any]

FINE = 10
AXES = ("gx", "gy", "gz", "ax", "ay", "az")
UNITS = {"g": "deg/s", "a": "m/s^2"}
#: White noise density by kind of axis.
DENSITY = {"g": 0.04, "a": 0.004}
#: K/N, 1/s; sigma/N, 1/sqrt(s); s. Those of 3e-4 deg/s/sqrt(s) and of 0.012 deg/s at 250 s beside N = 0.04.
WALK, SIGMA, TAU = 0.0075, 0.3, 250.0
LAWS = ("random_walk", "gauss_markov")
TEMPERATURE_LSB, SUPPLY_LSB = 0.14, 0.002418
#: Nats that the right model gains.
SIZES = {"plain": (40.0, 200.0), "near": (15.0, 30.0)}
#: Nats between the reached and the wanted gain, beside 5 % of it.
TOLERANCE = 1.0
RATES = (1.0, 10.0, 100.0)


# -------------------------------------------------------------------------------------------------------- the sensor


@dataclass(frozen=True)
class Axis:
    """Truth of one axis: density of the white noise, drift law, its size and time constant, offset."""

    n: float
    law: str
    size: float
    tau: float
    offset: float

    def drift(self, random: Random, count: int, dt: float) -> Array:
        """[count] every `dt` s."""
        kicks = random.normal(size=count)
        if self.law == "random_walk":
            return np.asarray(np.cumsum(kicks) * self.size * np.sqrt(dt))
        phi = np.exp(-dt / self.tau)
        kicks *= self.size * np.sqrt(1.0 - phi**2)
        kicks[0] = self.size * random.normal()
        return np.asarray(lfilter([1.0], [1.0, -phi], kicks))


def draw_axis(random: Random, name: str, law: str) -> Axis:
    n = DENSITY[name[0]] * float(np.exp(random.uniform(-1.0, 1.0)))
    tau = TAU * float(np.exp(random.uniform(-0.5, 0.5)))
    size = n * (WALK if law == "random_walk" else SIGMA) * float(np.exp(random.uniform(-0.7, 0.7)))
    offset = 9.8 * float(random.choice([-1.0, 1.0])) if name == "az" else float(random.uniform(-0.4, 0.4))
    return Axis(n, law, size, tau, offset)


@dataclass
class Scene:
    """One record before its effect, at the fine rate. `target` is the axis that has the effect."""

    random: Random
    rate: float
    seconds: float
    target: str
    axes: dict[str, Axis]
    aperture: int
    lattice: dict[str, float | None]
    drift: dict[str, Array] = field(default_factory=dict)
    white: dict[str, Array] = field(default_factory=dict)
    temperature: Array = field(default_factory=lambda: np.zeros(0))
    supply: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def n(self) -> int:
        """Readings."""
        return round(self.seconds * self.rate)

    @property
    def dt(self) -> float:
        """Of the fine samples, s."""
        return 1.0 / (self.rate * FINE)

    @property
    def t(self) -> Array:
        """[n * FINE], s."""
        return (np.arange(self.n * FINE) + 0.5) * self.dt

    @property
    def truth(self) -> Axis:
        """Of the target."""
        return self.axes[self.target]

    def make(self) -> None:
        """Noise, drifts and side channels."""
        count = self.n * FINE
        for name, axis in self.axes.items():
            self.drift[name] = axis.drift(self.random, count, self.dt)
            # An aperture of part of the time lets more noise in: N is that of the readings.
            sd = axis.n / np.sqrt(self.dt) * np.sqrt(self.aperture / FINE)
            self.white[name] = sd * self.random.normal(size=count)
        self.temperature = room(self.random, self.t, warm=bool(self.random.random() < 0.6))
        self.supply = loads(self.random, self.t)

    def read(self, fine: Array) -> Array:
        """[n]: averaged over the aperture."""
        return np.asarray(fine.reshape(-1, FINE)[:, : self.aperture].mean(axis=1))

    def values(self, name: str) -> Array:
        """[n]: readings of an axis without an effect and without its lattice."""
        return self.axes[name].offset + self.read(self.drift[name] + self.white[name])

    def noise(self, name: str) -> Array:
        """[n]: the white part of the readings."""
        return self.read(self.white[name])

    def sd(self, name: str) -> float:
        """Of the white part of one reading."""
        return self.axes[name].n * float(np.sqrt(self.rate))

    def others(self) -> list[str]:
        """The other axes of the target's kind."""
        return [name for name in self.axes if name[0] == self.target[0] and name != self.target]


def smooth_noise(random: Random, t: Array, tau: float) -> Array:
    """[n]: of unit variance, with a bandwidth of 1/tau, twice differentiable nearly everywhere."""
    every = max(tau / 5.0, t[1] - t[0])
    coarse = np.arange(t[0] - 40.0 * tau, t[-1] + every, every)
    phi = np.exp(-every / tau)
    rough = random.normal(size=len(coarse))
    for _ in range(2):
        rough = lfilter([1.0 - phi], [1.0, -phi], rough)
    return np.asarray(np.interp(t, coarse, rough / rough[len(rough) // 3 :].std()))


def room(random: Random, t: Array, warm: bool) -> Array:
    """[n]: degC of a board in a room: warm-up, the heating's cycle, slow weather."""
    cycle = random.uniform(0.2, 0.8) * np.sin(2.0 * np.pi * (t / random.uniform(900.0, 2400.0) + random.random()))
    rise = random.uniform(3.0, 9.0) * (1.0 - np.exp(-t / random.uniform(400.0, 1500.0))) if warm else 0.0
    return np.asarray(random.uniform(18.0, 32.0) + rise + cycle + 0.4 * smooth_noise(random, t, 500.0))


def swings(random: Random, t: Array) -> Array:
    """[n]: degC in a box that is opened and heated: several degrees up and down within the record."""
    turns = random.uniform(2.0, 3.5)
    phase = turns * t / t[-1] + random.random()
    wave = random.uniform(2.0, 4.0) * np.sin(2.0 * np.pi * (phase + 0.08 * np.sin(2.0 * np.pi * t / t[-1])))
    return np.asarray(
        random.uniform(20.0, 30.0) + wave + random.uniform(-3.0, 3.0) * t / t[-1] + 0.7 * smooth_noise(random, t, 120.0)
    )


def loads(random: Random, t: Array) -> Array:
    """[n]: V of a supply whose other loads come and go, over a slow discharge."""
    level = np.full(len(t), 5.0 + random.uniform(-0.05, 0.05)) - random.uniform(0.0, 0.02) * t / t[-1]
    for _ in range(random.integers(2, 6)):
        begin = random.uniform(0.0, 0.9) * t[-1]
        held = (t > begin) & (t < begin + random.uniform(30.0, 300.0))
        level -= random.uniform(0.005, 0.03) * held
    return np.asarray(level)


def lagged(signal: Array, dt: float, tau: float) -> Array:
    """First-order lag, settled at the start."""
    keep = np.exp(-dt / tau)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], signal, zi=[keep * signal[0]])[0])


def play(signal: Array, width: float) -> Array:
    """Backlash: the output moves only when the input pushes it, half of `width` on either side."""
    out = np.empty_like(signal)
    at, half = float(signal[0]), 0.5 * width
    for i, value in enumerate(signal.tolist()):
        at = min(max(at, value - half), value + half)
        out[i] = at
    return out


def switching(random: Random, t: Array, dwell: float, other_dwell: float | None = None) -> tuple[Array, int]:
    """[n] of 0 and 1 with exponential dwell times, and the number of switches."""
    level, at, edges = int(random.integers(2)), 0.0, []
    first = level
    while at < t[-1]:
        at += float(random.exponential(dwell if level == 0 or other_dwell is None else other_dwell))
        edges.append(at)
        level = 1 - level
    passed = np.searchsorted(np.asarray(edges), t)
    return ((passed + first) % 2).astype(float), int(passed[-1])


def means(values: Array, rate: float, seconds: float = 1.0) -> Array:
    """[m]: of blocks of `seconds`."""
    size = max(round(rate * seconds), 1)
    return np.asarray(values[: len(values) // size * size].reshape(-1, size).mean(axis=1))


# ------------------------------------------------------------------------------------------------- what a kind makes


@dataclass
class Made:
    """An effect on a scene: what `amount` of it does to the readings, and what the right model gains of it."""

    gain: Callable[[float], float]
    low: float
    high: float
    #: Added to the fine samples of these axes, times the amount.
    add: dict[str, Array] = field(default_factory=dict)
    #: Readings of the target, on their lattice's scale but before it, and the amount -> readings.
    after: Callable[[Array, float], Array] | None = None
    #: The same, behind the lattice.
    last: Callable[[Array, float], Array] | None = None
    #: Lattice of the target; default: the scene's.
    lattice: Callable[[float], float] | None = None
    #: Other axes that a right answer may name.
    others: tuple[str, ...] = ()


def column(
    scene: Scene,
    shape: Array,
    *,
    columns: Array | None = None,
    price: float = 0.0,
    fast: bool = False,
    others: tuple[str, ...] = (),
    more: dict[str, Array] | None = None,
) -> Made:
    """An effect of a known shape [n * FINE]. `columns` of the right model: at the readings, or at means of 1 s.

    `fast`: judged at every reading; else at means of 1 s. `more`: shapes on other axes.
    """
    seconds = 1.0 / scene.rate if fast else 1.0
    quiet = means(scene.values(scene.target), scene.rate, seconds)
    seen = means(scene.read(shape), scene.rate, seconds)
    gain = column_gain(quiet, seen, max(seconds, 1.0 / scene.rate), columns, price)
    unit = scene.truth.n / float(seen.std())
    return Made(gain, 1e-3 * unit, 1e3 * unit, {scene.target: shape, **(more or {})}, others=others)


def ln_n(scene: Scene) -> float:
    """Price of one place in time, s."""
    return float(np.log(scene.seconds))


# ---- in time


def turn_on(scene: Scene, p: Truth) -> Made:
    return column(scene, p["sign"] * np.exp(-scene.t / p["tau"]), price=2.0)


def turn_on_two(scene: Scene, p: Truth) -> Made:
    shape = np.exp(-scene.t / p["tau"]) + p["share"] * np.exp(-scene.t / p["tau_2"])
    return column(scene, p["sign"] * shape, price=6.0)


def warm_up_innocent(scene: Scene, p: Truth) -> Made:
    """The chip settles by itself; the thermometer beside it follows the board, which takes its own time."""
    scene.temperature = (
        24.0 + p["rise"] * (1.0 - np.exp(-scene.t / p["tau_board"])) + 0.25 * smooth_noise(scene.random, scene.t, 300.0)
    )
    return turn_on(scene, p)


def relaxation(scene: Scene, p: Truth) -> Made:
    """Stress of the package relaxes with the logarithm of time."""
    return column(scene, p["sign"] * np.log1p(scene.t / p["t_0"]), price=2.0)


def ramp(scene: Scene, p: Truth) -> Made:
    return column(scene, p["sign"] * scene.t / scene.seconds)


def edge(t: Array, at: float, tau: float) -> Array:
    """0 before, to 1 after, with a time constant."""
    return np.asarray(np.where(t > at, 1.0 - np.exp(-np.maximum(t - at, 0.0) / tau), 0.0))


def pulse(scene: Scene, p: Truth) -> Made:
    """A lamp warms one side of the case, or a load is switched on and off."""
    shape = edge(scene.t, p["at"], p["rise"]) - edge(scene.t, p["at"] + p["duration"], p["rise"])
    return column(scene, p["sign"] * shape, price=2.0 * ln_n(scene))


def jump(scene: Scene, p: Truth) -> Made:
    return column(scene, p["sign"] * (scene.t > p["at"]), price=ln_n(scene))


def many_jumps(scene: Scene, p: Truth) -> Made:
    shape = np.zeros(len(scene.t))
    for at, height in zip(p["times"], p["heights"], strict=True):
        shape += height * (scene.t > at)
    return column(scene, shape, price=len(p["times"]) * ln_n(scene))


def shock(scene: Scene, p: Truth) -> Made:
    """A blow shifts the bias, and it creeps back."""
    after = scene.t > p["at"]
    shape = after * (p["left"] + (1.0 - p["left"]) * np.exp(-np.maximum(scene.t - p["at"], 0.0) / p["tau"]))
    return column(scene, p["sign"] * shape, price=ln_n(scene) + 4.0)


def recovery(scene: Scene, p: Truth) -> Made:
    """Out of range for a moment; the amplifier then recovers exponentially."""
    past = np.maximum(scene.t - p["at"] - p["held"], 0.0)
    shape = (scene.t > p["at"] + p["held"]) * np.exp(-past / p["tau"])
    made = column(scene, p["sign"] * shape, price=2.0)
    t = np.arange(scene.n) / scene.rate
    pinned = (t >= p["at"]) & (t < p["at"] + p["held"])
    limit = p["sign"] * (25.0 if scene.target[0] == "g" else 30.0) * scene.sd(scene.target) + scene.truth.offset
    made.after = lambda values, amount: np.where(pinned, limit, values)
    return made


def scale_change(scene: Scene, p: Truth) -> Made:
    """The front end's gain changes: level and noise scale together."""
    made = column(scene, p["sign"] * (scene.t > p["at"]), price=ln_n(scene))
    t = np.arange(scene.n) / scene.rate
    offset = scene.truth.offset

    def after(values: Array, amount: float) -> Array:
        level = offset + p["sign"] * amount
        return np.where(t > p["at"], level + (values - level) * abs(level / offset), values)

    made.after = after
    return made


def two_level(scene: Scene, p: Truth) -> Made:
    path, switches = switching(scene.random, scene.t, p["dwell"], p["dwell_2"])
    if switches < 3:
        raise RuntimeError("fewer than three switches")
    return column(scene, path, price=switches * (1.0 + np.log(0.5 * (p["dwell"] + p["dwell_2"]))) + 2.0)


# ---- periodic


def wave(scene: Scene, phase: Array, *, fast: bool, price: float, gate: Array | None = None) -> Made:
    """A line of this phase [n * FINE], rad, fitted by its sine and cosine."""
    window = np.ones(len(phase)) if gate is None else gate
    parts = [scene.read(window * part) for part in (np.sin(phase), np.cos(phase))]
    if not fast:
        parts = [means(part, scene.rate) for part in parts]
    return column(scene, window * np.sin(phase), columns=np.column_stack(parts), price=price, fast=fast)


def line(scene: Scene, p: Truth) -> Made:
    return wave(scene, 2.0 * np.pi * p["frequency"] * scene.t + p["phase"], fast=True, price=np.log(scene.n))


def ripple(scene: Scene, p: Truth) -> Made:
    """A converter's ripple beyond the read-out's rate, whose frequency wanders a little; what is seen is its alias."""
    wander = np.cumsum(smooth_noise(scene.random, scene.t, 200.0)) * scene.dt * p["wander"]
    phase = 2.0 * np.pi * (p["frequency"] * scene.t + wander)
    return wave(scene, phase, fast=True, price=np.log(scene.n) + 6.0)


def sweep(scene: Scene, p: Truth) -> Made:
    """A fan runs up or down slowly."""
    phase = 2.0 * np.pi * (p["frequency"] * scene.t + 0.5 * p["change"] * scene.t**2 / scene.seconds)
    return wave(scene, phase, fast=True, price=2.0 * np.log(scene.n))


def intermittent(scene: Scene, p: Truth) -> Made:
    """A fan that comes and goes."""
    gate, switches = switching(scene.random, scene.t, p["off"], p["on"])
    if switches < 2 or not 0.2 < gate.mean() < 0.8:
        raise RuntimeError("the fan hardly ever switches")
    phase = 2.0 * np.pi * p["frequency"] * scene.t + p["phase"]
    return wave(scene, phase, fast=True, price=np.log(scene.n) + 4.0 * switches, gate=gate)


def tide(scene: Scene, p: Truth) -> Made:
    phase = 2.0 * np.pi * scene.t / (p["share"] * scene.seconds) + p["phase"]
    return wave(scene, phase, fast=False, price=3.0)


def heater(scene: Scene, p: Truth) -> Made:
    """A thermostat's two-point control: heat and cool with different time constants, periods a little uneven."""
    dt = max(scene.dt, 0.1)
    t = np.arange(0.0, scene.seconds + dt, dt)
    shape, level, heating = np.empty(len(t)), p["start"], True
    low, high = 0.3, 0.7
    random = scene.random
    keep = [np.exp(-dt / p["heat_tau"]), np.exp(-dt / p["cool_tau"])]
    top, bottom = high, low
    for i in range(len(shape)):
        goal = 1.0 if heating else 0.0
        level = goal + (level - goal) * keep[0 if heating else 1]
        if heating and level > top:
            heating, top = False, high + 0.01 * random.normal()
        elif not heating and level < bottom:
            heating, bottom = True, low + 0.01 * random.normal()
        shape[i] = level
    return column(scene, p["sign"] * np.interp(scene.t, t, shape), price=np.log(scene.n) + 6.0)


def blink(scene: Scene, p: Truth) -> Made:
    """A lamp blinks: a square wave leaks in."""
    shape = ((scene.t / p["period"] + p["phase"]) % 1.0 < p["duty"]).astype(float)
    return column(scene, p["sign"] * shape, price=np.log(scene.n) + 2.0)


# ---- channels


#: degC and V: middle of a record's channel and its usual spread. A form's bends stand there in every record.
TEMPERATE, SWING = 25.0, 3.0
VOLTS, SAG = 5.0, 0.02


def around(channel: Array, middle: float) -> Array:
    """The channel with its mean at `middle`."""
    return np.asarray(channel + (middle - channel.mean()))


def warm(form: Callable[[Scene, Truth, Array], Array], price: float = 0.0) -> Callable[[Scene, Truth], Made]:
    """A bias that follows the temperature by `form`, in a box whose temperature swings."""

    def make(scene: Scene, p: Truth) -> Made:
        scene.temperature = around(swings(scene.random, scene.t), TEMPERATE)
        return column(scene, p["sign"] * form(scene, p, (scene.temperature - TEMPERATE) / SWING), price=price)

    return make


def _static(scene: Scene, p: Truth, channel: Array) -> Array:
    return channel


def _rate(scene: Scene, p: Truth, channel: Array) -> Array:
    """Heat flows through the package: the gradient is a little late as well."""
    return np.gradient(lagged(channel, scene.dt, p["smooth"]), scene.dt)


def _square(scene: Scene, p: Truth, channel: Array) -> Array:
    return np.asarray((channel - p["middle"]) ** 2)


def _cube(scene: Scene, p: Truth, channel: Array) -> Array:
    return np.asarray(channel**3)


def _lag(scene: Scene, p: Truth, channel: Array) -> Array:
    return lagged(channel, scene.dt, p["lag"])


def _play(scene: Scene, p: Truth, channel: Array) -> Array:
    every = max(round(0.1 / scene.dt), 1)
    slow = play(channel[::every], p["width"])
    return np.interp(scene.t, scene.t[::every], slow)


def powered(form: Callable[[Scene, Truth, Array], Array], price: float = 0.0) -> Callable[[Scene, Truth], Made]:
    """A bias that follows the supply, whose loads switch and whose level sags."""

    def make(scene: Scene, p: Truth) -> Made:
        slow = SAG * smooth_noise(scene.random, scene.t, p["sag"])
        scene.supply = around(scene.supply + slow, VOLTS)
        return column(scene, p["sign"] * form(scene, p, (scene.supply - VOLTS) / SAG), price=price)

    return make


def leak(scene: Scene, p: Truth) -> Made:
    """A share of another axis, noise and all."""
    other = scene.others()[p["which"] % 2]
    shape = scene.drift[other] + scene.white[other]
    return column(scene, p["sign"] * shape, fast=True, others=(other,))


def late_leak(scene: Scene, p: Truth) -> Made:
    """Another axis, which moves slowly, through a filter."""
    other = scene.others()[p["which"] % 2]
    scene.drift[other] = scene.drift[other] + 1.5 * scene.axes[other].n * smooth_noise(scene.random, scene.t, p["move"])
    return column(
        scene,
        p["sign"] * lagged(scene.drift[other] + scene.white[other], scene.dt, p["lag"]),
        price=2.0,
        others=(other,),
    )


def tilt(scene: Scene, p: Truth) -> Made:
    """The bench creeps; a gyro is sensitive to acceleration."""
    other = ("ax", "ay")[p["which"] % 2]
    slow = 0.06 * smooth_noise(scene.random, scene.t, p["creep"]) + 0.03 * scene.t / scene.seconds
    scene.drift[other] = scene.drift[other] + slow
    seen = means(scene.values(other), scene.rate)
    return column(scene, p["sign"] * slow, columns=seen[:, None], others=(other,))


# ---- noise


def envelope(scene: Scene, p: Truth) -> Array:
    """[n * FINE]: level of vibration, between 0 and 1: a compressor that comes and goes, or a smooth one."""
    if p["switched"]:
        gate, switches = switching(scene.random, scene.t, p["quiet"], p["loud"])
        if switches < 2 or not 0.15 < gate.mean() < 0.85:
            raise RuntimeError("the machine hardly ever switches")
        return lagged(gate, scene.dt, 3.0)
    return np.asarray(1.0 / (1.0 + np.exp(-2.0 * smooth_noise(scene.random, scene.t, p["quiet"]))))


def shake(scene: Scene, p: Truth) -> tuple[str, Array]:
    """Another axis vibrates: its name, and the envelope of the vibration's power."""
    other = "az" if scene.target[0] == "g" else scene.others()[p["which"] % 2]
    level = envelope(scene, p)
    sd = p["strength"] * float(scene.white[other].std())
    vibration = sd * level * scene.random.normal(size=len(scene.t))
    scene.white[other] = scene.white[other] + vibration
    return other, level**2


#: Hz: vibration has this many independent samples a second at least, whose squares a fine sample averages.
VIBRATION = 200.0


def rectified(scene: Scene, p: Truth) -> Made:
    """Vibration of another axis rectifies into a bias. The right model has its variance, smoothed, from differences."""
    other, envelope_power = shake(scene, p)
    half = 0.5 * max(VIBRATION * scene.dt, 1.0)
    rectifies = envelope_power * scene.random.gamma(half, 1.0 / half, len(scene.t))
    power = means(np.append(0.5 * np.diff(scene.values(other)) ** 2, 0.0), scene.rate)
    made = []
    for seconds in (9, 29, 89):
        window = np.hanning(seconds + 2)
        local = np.convolve(power, window, "same") / np.convolve(np.ones(len(power)), window, "same")
        made.append(column(scene, p["sign"] * rectifies, columns=local[:, None], price=2.0, others=(other,)))
    return replace(made[0], gain=lambda amount: max(each.gain(amount) for each in made))


def noise_scaled(scene: Scene, level: Array, others: tuple[str, ...] = ()) -> Made:
    """White noise whose sd is 1 + amount * level [n * FINE]."""
    fine = scene.white[scene.target].copy()
    quiet, at = scene.noise(scene.target), scene.read(level)

    def gain(amount: float) -> float:
        sd = 1.0 + amount * at
        return float(scale_gain(quiet * sd, sd) - 0.5 * np.log(scene.n) - 2.0)

    return Made(gain, 1e-3, 30.0, {scene.target: fine * level}, others=others)


def breathing(scene: Scene, p: Truth) -> Made:
    return noise_scaled(scene, np.asarray(0.5 + 0.5 * np.tanh(smooth_noise(scene.random, scene.t, p["tau"]))))


def noise_of_temperature(scene: Scene, p: Truth) -> Made:
    scene.temperature = around(swings(scene.random, scene.t), TEMPERATE)
    return noise_scaled(scene, np.clip(0.5 + 0.3 * (scene.temperature - TEMPERATE) / SWING, 0.0, 1.0))


def noise_of_vibration(scene: Scene, p: Truth) -> Made:
    other, power = shake(scene, p)
    return noise_scaled(scene, np.sqrt(power), (other,))


def noise_step(scene: Scene, p: Truth) -> Made:
    made = noise_scaled(scene, (scene.t > p["at"]).astype(float))
    return Made(lambda amount: made.gain(amount) - ln_n(scene), made.low, made.high, made.add)


def steps_of_feet(scene: Scene, p: Truth) -> Made:
    """Somebody walks by: each step rings on every axis."""
    level = np.zeros(len(scene.t))
    decay = np.exp(-np.arange(round(1.5 / scene.dt)) * scene.dt / 0.4)
    for start in p["passes"]:
        for step in range(p["steps"]):
            at = round((start + 0.6 * step) / scene.dt)
            level[at : at + len(decay)] += decay[: max(len(level) - at, 0)]
    made = noise_scaled(scene, level)
    price = len(p["passes"]) * 2.0 * ln_n(scene)
    others = [name for name in scene.axes if name != scene.target]
    more = {name: scene.random.normal(size=len(level)) * level * scene.white[name].std() for name in others}
    return Made(lambda amount: made.gain(amount) - price, made.low, 1e3, {**made.add, **more}, others=tuple(others))


def radio(scene: Scene, p: Truth) -> Made:
    """A transmitter keys: bursts of a few wrong readings."""
    hit = np.zeros(scene.n, bool)
    for at, length in zip(p["times"], p["lengths"], strict=True):
        first = int(at * scene.n)
        hit[first : first + length] = True
    fine = np.repeat(scene.random.normal(size=scene.n) * hit, FINE) * scene.sd(scene.target)
    quiet = scene.noise(scene.target)
    spikes = scene.read(fine)

    def gain(amount: float) -> float:
        return scale_gain(quiet + amount * spikes, np.sqrt(1.0 + (amount * hit) ** 2)) - len(p["times"]) * ln_n(scene)

    return Made(gain, 0.1, 300.0, {scene.target: fine})


def shared_white(scene: Scene, p: Truth) -> Made:
    """Noise of a common reference voltage on two axes."""
    other = scene.others()[p["which"] % 2]
    common = scene.random.normal(size=len(scene.t))
    add = {name: common * scene.white[name].std() for name in (scene.target, other)}
    add[other] = p["sign"] * p["ratio"] * add[other]
    one, two = scene.noise(scene.target), scene.noise(other)
    more = scene.read(add[scene.target]), scene.read(add[other])
    return Made(
        lambda amount: correlation_gain(one + amount * more[0], two + amount * more[1]),
        1e-3,
        10.0,
        add,
        others=(other,),
    )


def shared_band(scene: Scene, p: Truth) -> Made:
    """Acoustic or electrical noise in a band on two axes."""
    other = scene.others()[p["which"] % 2]
    centre, width = p["centre"] * scene.rate, p["centre"] * scene.rate / p["quality"]
    edges = (centre - 0.5 * width, centre + 0.5 * width)
    band = butter(2, edges, "bandpass", fs=1.0 / scene.dt, output="sos")
    common = sosfilt(band, scene.random.normal(size=len(scene.t)))
    common /= common.std()
    seen = scene.read(common)
    # The band's own spectrum at the readings, by its ensemble.
    frequency = np.fft.rfftfreq(scene.n, 1.0 / scene.rate)[1:]
    b = butter(2, edges, "bandpass", fs=1.0 / scene.dt)
    z = np.exp(-2j * np.pi * frequency * scene.dt)
    power = np.abs(np.polyval(b[0][::-1], z) / np.polyval(b[1][::-1], z)) ** 2
    aperture = np.abs(np.sinc(frequency * scene.aperture * scene.dt)) ** 2
    power *= aperture
    power *= float(np.var(seen)) / float(power.mean())
    unit = {name: scene.sd(name) for name in (scene.target, other)}
    one, two = (scene.values(name) for name in (scene.target, other))
    slow = frequency > 0.02 * scene.rate

    def gain(amount: float) -> float:
        a, b = one + amount * unit[scene.target] * seen, two + p["sign"] * amount * unit[other] * seen
        own = [unit[name] ** 2 * (1.0 + amount**2 * power) for name in (scene.target, other)]
        cross = unit[scene.target] * unit[other] * amount**2 * power
        # Below, the drift: left out by a coherence of nothing.
        return band_gain(a, b, (own[0], own[1]), np.where(slow, cross, 0.0), p["sign"]) - 4.0

    add = {scene.target: unit[scene.target] * common, other: p["sign"] * unit[other] * common}
    return Made(gain, 0.02, 10.0, add, others=(other,))


def filtered_noise(scene: Scene, p: Truth) -> Made:
    """The sensor's analogue filter is slower than the read-out: neighbours correlate. Amount: its RC, readings."""
    white = scene.white[scene.target].copy()

    def changed(amount: float) -> Array:
        keep = np.exp(-1.0 / (amount * FINE))
        return np.asarray(lfilter([1.0 - keep], [1.0, -keep], white))

    def gain(amount: float) -> float:
        noise = scene.read(changed(amount))
        rho = float(np.corrcoef(noise[1:], noise[:-1])[0, 1])
        return float(-0.5 * scene.n * np.log1p(-(rho**2)) - 0.5 * np.log(scene.n))

    quiet = scene.noise(scene.target)
    return Made(gain, 0.02, 3.0, after=lambda values, amount: values - quiet + scene.read(changed(amount)))


# ---- slow processes


def slow_process(
    scene: Scene,
    fine: dict[str, Array],
    covariance: Callable[[Array], Array],
    sides: tuple[float, ...] = (1.0,),
    block: float = 4.0,
) -> Made:
    """A stationary process added to one axis or to several, beside each one's drift.

    `fine`: [n * FINE] of unit amount by axis, the target first. `covariance`: of the unit process at times [m].
    `sides`: factor of the process on each axis. `block`: s, means that are judged.
    The gain is over single axes with the best drift law each. Of several axes it is over single ones that have the
    process each for itself, or have not, whichever is better.
    """
    names = list(fine)
    dt = max(block, 1.0 / scene.rate)
    quiet = {name: means(scene.values(name) - scene.axes[name].offset, scene.rate, dt) for name in names}
    shape = {name: means(scene.read(fine[name]), scene.rate, dt) for name in names}
    m = len(quiet[names[0]])
    t = (np.arange(m) + 0.5) * dt
    base = {}
    for name in names:
        axis = scene.axes[name]
        base[name] = drift_covariance(t, axis.law, axis.size, axis.tau) + np.eye(m) * axis.n**2 / dt
    process, ones = covariance(t), np.ones((m, 1))

    def gain(amount: float) -> float:
        y = {name: quiet[name] + amount * shape[name] for name in names}
        scaled = [amount * side for side in sides]
        alone = []
        for name, side in zip(names, scaled, strict=True):
            without = base_log_likelihood(y[name], dt)
            if len(names) > 1:
                own = dense_log_likelihood(y[name], base[name] + side**2 * process, ones)
                without = max(without, own)
            alone.append(without)
        whole = np.kron(np.outer(scaled, scaled), process)
        for i, name in enumerate(names):
            whole[i * m : (i + 1) * m, i * m : (i + 1) * m] += base[name]
        constants = np.kron(np.eye(len(names)), ones)
        joint = dense_log_likelihood(np.concatenate([y[name] for name in names]), whole, constants)
        return float(joint - sum(alone) - 0.5 * np.log(m))

    low, high = 3e-2 * scene.truth.n, 100.0 * scene.truth.n
    return Made(gain, low, high, fine, others=tuple(names[1:]))


def oscillating(scene: Scene, p: Truth) -> Made:
    """A damped oscillator that noise drives: the temperature control's loop, or a table on its springs."""
    omega = 2.0 * np.pi / p["period"]
    decay = p["damping"] * omega
    turn = omega * np.sqrt(1.0 - p["damping"] ** 2)
    step = np.exp((-decay + 1j * turn) * scene.dt)
    noise = scene.random.normal(size=len(scene.t)) + 1j * scene.random.normal(size=len(scene.t))
    noise *= np.sqrt(1.0 - abs(step) ** 2)
    noise[0] = scene.random.normal() + 1j * scene.random.normal()
    state = lfilter([1.0], [1.0, -step], noise)

    def covariance(t: Array) -> Array:
        lag = np.abs(np.subtract.outer(t, t))
        return np.asarray(np.exp(-decay * lag) * np.cos(turn * lag))

    return slow_process(scene, {scene.target: np.ascontiguousarray(state.real)}, covariance)


#: Time constants of the traps whose sum is 1/f, s.
TRAPS = np.geomspace(2.0, 5000.0, 7)


def traps(scene: Scene, p: Truth) -> Made:
    """1/f: many traps, each a Gauss-Markov process of the same variance."""
    fine = np.zeros(len(scene.t))
    for tau in TRAPS:
        fine += Axis(0.0, "gauss_markov", 1.0, float(tau), 0.0).drift(scene.random, len(fine), scene.dt)

    def covariance(t: Array) -> Array:
        return np.asarray(np.sum([drift_covariance(t, "gauss_markov", 1.0, float(tau)) for tau in TRAPS], axis=0))

    return slow_process(scene, {scene.target: fine}, covariance, block=2.0)


def unseen_source(scene: Scene, p: Truth) -> Made:
    """A source that nobody records disturbs two axes: a lift's field, a draught."""
    names = (scene.target, scene.others()[p["which"] % 2])
    tau = p["tau"]
    unit = Axis(0.0, "gauss_markov", 1.0, tau, 0.0).drift(scene.random, len(scene.t), scene.dt)
    sides = (1.0, p["sign"] * p["ratio"] * scene.axes[names[1]].n / scene.truth.n)
    return slow_process(
        scene,
        {name: side * unit for name, side in zip(names, sides, strict=True)},
        lambda t: drift_covariance(t, "gauss_markov", 1.0, tau),
        sides,
    )


# ---- codes


def on_lattice(values: Array, lsb: float) -> Array:
    return np.asarray(lsb * np.rint(values / lsb))


def code_gain(
    scene: Scene,
    change: Callable[[float], Array],
    lsb: Callable[[float], float],
    chance: Callable[[Array, Array, float], Array],
) -> Callable[[float], float]:
    """Gain of a right model of the codes over Gaussian noise of the same variance around the true level.

    `change`: readings for an amount; `chance`: probabilities of the codes, given those and the level.
    """
    level = scene.truth.offset + scene.read(scene.drift[scene.target])

    def gain(amount: float) -> float:
        values, q = change(amount), lsb(amount)
        gap = values - level
        gap = gap - gap.mean()
        sd = max(float(gap.std()), 0.4 * q)
        plain = np.log(q) - 0.5 * np.log(2.0 * np.pi * sd**2) - 0.5 * (gap / sd) ** 2
        return float((np.log(np.maximum(chance(values, level, amount), 1e-30)) - plain).sum() - 4.0)

    return gain


def _cell(values: Array, level: Array, q: float, sd: float) -> Array:
    return np.asarray(ndtr((values + 0.5 * q - level) / sd) - ndtr((values - 0.5 * q - level) / sd))


def coarse(scene: Scene, p: Truth) -> Made:
    """The converter's codes are wide. The amount is the LSB in sd of a reading."""
    values, sd = scene.values(scene.target), scene.sd(scene.target)

    def lsb(amount: float) -> float:
        return amount * sd

    gain = code_gain(scene, lambda a: on_lattice(values, lsb(a)), lsb, lambda v, level, a: _cell(v, level, lsb(a), sd))
    return Made(gain, 0.6, 3.0, lattice=lsb)


def sticky(scene: Scene, p: Truth) -> Made:
    """Odd codes of the converter are narrow: a share of their readings falls to a neighbour. Amount: the share."""
    values, sd, random = scene.values(scene.target), scene.sd(scene.target), np.random.default_rng(p["dice"])
    q = p["lsb"] * sd
    falls, up = random.random(scene.n), random.choice([-1.0, 1.0], scene.n)

    def last(read: Array, amount: float) -> Array:
        code = np.rint(read / q)
        odd = code % 2 != 0
        return np.asarray(np.where(odd & (falls < amount), q * (code + up), q * code))

    def chance(read: Array, level: Array, amount: float) -> Array:
        here = _cell(read, level, q, sd)
        sides = _cell(read - q, level, q, sd) + _cell(read + q, level, q, sd)
        odd = np.rint(read / q) % 2 != 0
        return np.where(odd, (1.0 - amount) * here, here + 0.5 * amount * sides)

    gain = code_gain(scene, lambda a: last(on_lattice(values, q), a), lambda a: q, chance)
    return Made(gain, 1e-3, 0.999, last=last, lattice=lambda a: q)


def dead_band(scene: Scene, p: Truth) -> Made:
    """Firmware shows small rates as nothing: readings nearer than the amount (in LSB) to a level become that level."""
    values, sd = scene.values(scene.target), scene.sd(scene.target)
    q = p["lsb"] * sd
    centre = q * np.rint((scene.truth.offset + p["beside"] * sd) / q)

    def last(read: Array, amount: float) -> Array:
        return np.where(np.abs(read - centre) < (amount + 0.5) * q, centre, read)

    # Whole codes fall in: where a fraction of a code is wanted, that share of the next one's readings does.
    share = np.random.default_rng(p["dice"]).random(scene.n)

    def soft(read: Array, amount: float) -> Array:
        inner, rest = int(amount), amount - int(amount)
        done = last(read, float(inner))
        border = np.abs(np.rint((read - centre) / q)) == inner + 1
        return np.where(border & (share < rest), centre, done)

    def chance(read: Array, level: Array, amount: float) -> Array:
        inner, rest = int(amount), amount - int(amount)
        place = np.rint((read - centre) / q)
        here = _cell(read, level, q, sd)
        swallowed = _cell(np.full(scene.n, centre), level, (2 * inner + 1) * q, sd)
        border = sum(_cell(np.full(scene.n, centre + side * (inner + 1) * q), level, q, sd) for side in (-1, 1))
        return np.where(
            place == 0, swallowed + rest * border, np.where(np.abs(place) == inner + 1, (1.0 - rest) * here, here)
        )

    gain = code_gain(scene, lambda a: soft(on_lattice(values, q), a), lambda a: q, chance)
    return Made(gain, 1e-2, 40.0, last=soft, lattice=lambda a: q)


def repeats(scene: Scene, p: Truth, pick: Callable[[int], Array]) -> Made:
    """Readings repeated. `pick`: for a number of repeats, the index [n] of the reading that each place shows."""
    sd = scene.sd(scene.target)
    q = p["lsb"] * sd
    each = -np.log(0.5 * p["lsb"] / np.sqrt(np.pi))

    def gain(amount: float) -> float:
        return float(each * round(amount)) - 2.0 * ln_n(scene)

    return Made(gain, 1.0, 0.2 * scene.n, last=lambda read, a: read[pick(round(a))], lattice=lambda a: q)


def hiccup(scene: Scene, p: Truth) -> Made:
    """The logger falls to half its rate for a while and writes each reading twice."""

    def pick(number: int) -> Array:
        index = np.arange(scene.n)
        first = int(p["at"] * (scene.n - 2 * number))
        index[first : first + 2 * number] -= np.tile([0, 1], number)
        return index

    return repeats(scene, p, pick)


def stuck(scene: Scene, p: Truth) -> Made:
    """The last reading stays for a while."""

    def pick(number: int) -> Array:
        index = np.arange(scene.n)
        first = int(p["at"] * (scene.n - number))
        index[first : first + number + 1] = first
        return index

    return repeats(scene, p, pick)


# --------------------------------------------------------------------------------------------------------- the table


@dataclass(frozen=True)
class Kind:
    """`right`: cause, with `:form` where it has a channel. `accepts`: other names that describe the same record.

    `draw` gives the parameters for a record of so many seconds at a rate. `by_effect`: `simulate --effect` can make it.
    `slow`: its model is seen at 1 s means; the share of evidence that carries over is asked of these.
    """

    right: str
    accepts: tuple[str, ...]
    make: Callable[[Scene, Truth], Made]
    draw: Callable[[Random, float, float], Truth]
    by_effect: bool = False
    slow: bool = True
    axes: tuple[str, ...] = AXES
    #: What it takes to reach its sizes.
    least_seconds: float = 0.0
    least_rate: float = 0.0
    sizes: tuple[str, ...] = tuple(SIZES)

    @property
    def cause(self) -> str:
        return self.right.partition(":")[0]

    @property
    def form(self) -> str | None:
        return self.right.partition(":")[2] or None

    @property
    def names(self) -> tuple[str, ...]:
        """Right or accepted."""
        return (self.cause, *self.accepts)


def _sign(r: Random) -> float:
    return float(r.choice([-1.0, 1.0]))


def _uniform(r: Random, low: float, high: float) -> float:
    return float(r.uniform(low, high))


def _log(r: Random, low: float, high: float) -> float:
    return float(np.exp(r.uniform(np.log(low), np.log(high))))


def _place(r: Random, s: float, low: float = 0.2, high: float = 0.8) -> float:
    return float(r.uniform(low, high) * s)


def _motor(r: Random, s: float, f: float) -> Truth:
    return {
        "sign": _sign(r),
        "which": int(r.integers(2)),
        "switched": bool(r.random() < 0.6),
        "quiet": _uniform(r, 0.06, 0.15) * s,
        "loud": _uniform(r, 0.06, 0.15) * s,
        "strength": _uniform(r, 2.0, 4.0),
    }


def _warmth(**more: Callable[[Random], float]) -> Callable[[Random, float, float], Truth]:
    return lambda r, s, f: {"sign": _sign(r), **{name: draw(r) for name, draw in more.items()}}


def _pass(r: Random, s: float, f: float) -> Truth:
    count = int(r.integers(1, 4))
    return {"passes": [_place(r, s, 0.05, 0.9) for _ in range(count)], "steps": int(r.integers(12, 30))}


def _radio(r: Random, s: float, f: float) -> Truth:
    count = int(r.integers(2, 6))
    times = [_uniform(r, 0.02, 0.95) for _ in range(count)]
    return {"times": times, "lengths": [int(r.integers(1, 5)) for _ in range(count)]}


def _jumps(r: Random, s: float, f: float) -> Truth:
    count = int(r.integers(4, 8))
    times = sorted(_place(r, s, 0.05, 0.95) for _ in range(count))
    return {"times": times, "heights": [_sign(r) * _uniform(r, 0.6, 1.4) for _ in range(count)]}


GYROS, LEVEL = ("gx", "gy", "gz"), ("gx", "gy", "gz", "ax", "ay")

#: The names that are right were written here before the first run.
KINDS: dict[str, Kind] = {
    # In time
    "turn_on": Kind("turn_on", (), turn_on, lambda r, s, f: {"sign": _sign(r), "tau": _log(r, 0.03 * s, 0.2 * s)}),
    "turn_on_two": Kind(
        "turn_on",
        (),
        turn_on_two,
        lambda r, s, f: {
            "sign": _sign(r),
            "tau": _log(r, 0.01 * s, 0.03 * s),
            "tau_2": _log(r, 0.12 * s, 0.3 * s),
            "share": _uniform(r, 0.4, 1.5),
        },
    ),
    "warm_up_innocent": Kind(
        "turn_on",
        (),
        warm_up_innocent,
        lambda r, s, f: {
            "sign": _sign(r),
            "tau": _log(r, 0.03 * s, 0.1 * s),
            "rise": _uniform(r, 4.0, 10.0),
            "tau_board": _uniform(r, 0.35, 0.8) * s,
        },
    ),
    "relaxation": Kind(
        "turn_on", ("ramp",), relaxation, lambda r, s, f: {"sign": _sign(r), "t_0": _log(r, 10.0, 60.0)}
    ),
    "ramp": Kind("ramp", ("turn_on",), ramp, lambda r, s, f: {"sign": _sign(r)}, by_effect=True),
    "pulse": Kind(
        "pulse",
        ("step",),
        pulse,
        lambda r, s, f: {
            "sign": _sign(r),
            "at": _place(r, s, 0.15, 0.7),
            "duration": _log(r, 60.0, 0.2 * s),
            "rise": _log(r, 0.5, 8.0),
        },
    ),
    "jump": Kind("step", (), jump, lambda r, s, f: {"sign": _sign(r), "at": _place(r, s)}, by_effect=True),
    "many_jumps": Kind("step", ("two_level", "pulse"), many_jumps, _jumps),
    "shock": Kind(
        "pulse",
        ("step", "turn_on"),
        shock,
        lambda r, s, f: {
            "sign": _sign(r),
            "at": _place(r, s, 0.2, 0.7),
            "tau": _log(r, 20.0, 150.0),
            "left": _uniform(r, 0.0, 0.3),
        },
    ),
    "recovery": Kind(
        "saturation",
        ("pulse", "step", "turn_on", "outliers", "motion", "stuck"),
        recovery,
        lambda r, s, f: {
            "sign": _sign(r),
            "at": _place(r, s, 0.2, 0.7),
            "tau": _log(r, 20.0, 120.0),
            "held": max(4.0 / f, _uniform(r, 0.5, 4.0)),
        },
        axes=LEVEL,
    ),
    "scale_change": Kind(
        "step", ("variance_change",), scale_change, lambda r, s, f: {"sign": _sign(r), "at": _place(r, s)}, axes=LEVEL
    ),
    "two_level": Kind(
        "two_level",
        (),
        two_level,
        lambda r, s, f: {"dwell": _log(r, 60.0, 0.12 * s), "dwell_2": _log(r, 60.0, 0.12 * s)},
    ),
    # Periodic
    "line": Kind(
        "periodic",
        (),
        line,
        lambda r, s, f: {"frequency": _uniform(r, 0.05, 0.45) * f, "phase": _uniform(r, 0.0, 6.28)},
        by_effect=True,
        slow=False,
    ),
    "ripple": Kind(
        "periodic",
        ("oscillation", "colored_noise"),
        ripple,
        lambda r, s, f: {
            "frequency": (float(r.integers(1, 4)) + _sign(r) * _uniform(r, 0.05, 0.4)) * f,
            "wander": 0.3 / s,
        },
        slow=False,
    ),
    "sweep": Kind(
        "periodic",
        ("oscillation", "colored_noise", "variance_change"),
        sweep,
        lambda r, s, f: {"frequency": _uniform(r, 0.1, 0.25) * f, "change": _log(r, 20.0, 60.0) / s},
        slow=False,
    ),
    "intermittent": Kind(
        "periodic",
        ("variance_change", "oscillation", "colored_noise"),
        intermittent,
        lambda r, s, f: {
            "frequency": _uniform(r, 0.05, 0.45) * f,
            "phase": _uniform(r, 0.0, 6.28),
            "off": _uniform(r, 0.08, 0.2) * s,
            "on": _uniform(r, 0.08, 0.2) * s,
        },
        slow=False,
    ),
    "tide": Kind(
        "periodic",
        ("ramp", "oscillation"),
        tide,
        lambda r, s, f: {"share": _uniform(r, 0.25, 0.6), "phase": _uniform(r, 0.0, 6.28)},
        by_effect=True,
    ),
    "heater": Kind(
        "periodic",
        ("oscillation", "two_level"),
        heater,
        lambda r, s, f: {
            "sign": _sign(r),
            "start": _uniform(r, 0.3, 0.7),
            "heat_tau": _log(r, 20.0, 60.0),
            "cool_tau": _log(r, 50.0, 120.0),
        },
    ),
    "blink": Kind(
        "periodic",
        ("two_level",),
        blink,
        lambda r, s, f: {
            "sign": _sign(r),
            "period": _log(r, 12.0, 60.0),
            "phase": _uniform(r, 0.0, 1.0),
            "duty": _uniform(r, 0.3, 0.7),
        },
    ),
    # Channels
    "temperature": Kind("temperature:static", (), warm(_static), _warmth(), by_effect=True),
    "temperature_rate": Kind("temperature:rate", (), warm(_rate, 2.0), _warmth(smooth=lambda r: _log(r, 2.0, 20.0))),
    "temperature_square": Kind(
        "temperature:square", (), warm(_square), _warmth(middle=lambda r: _uniform(r, -0.6, 0.6))
    ),
    "temperature_cube": Kind("temperature:cube", (), warm(_cube), _warmth()),
    "temperature_lag": Kind("temperature:lag", (), warm(_lag, 2.0), _warmth(lag=lambda r: _log(r, 60.0, 300.0))),
    "temperature_play": Kind("temperature:play", (), warm(_play, 2.0), _warmth(width=lambda r: _uniform(r, 0.6, 1.2))),
    "supply": Kind("supply:static", (), powered(_static), _warmth(sag=lambda r: _log(r, 40.0, 200.0)), by_effect=True),
    "supply_square": Kind(
        "supply:square",
        (),
        powered(_square),
        _warmth(sag=lambda r: _log(r, 40.0, 200.0), middle=lambda r: _uniform(r, -0.6, 0.6)),
    ),
    "supply_lag": Kind(
        "supply:lag",
        (),
        powered(_lag, 2.0),
        _warmth(sag=lambda r: _log(r, 40.0, 200.0), lag=lambda r: _log(r, 10.0, 60.0)),
    ),
    "leak": Kind(
        "cross_axis:static",
        ("shared",),
        leak,
        lambda r, s, f: {"sign": _sign(r), "which": int(r.integers(2))},
        by_effect=True,
        slow=False,
    ),
    "late_leak": Kind(
        "cross_axis:lag",
        (),
        late_leak,
        lambda r, s, f: {
            "sign": _sign(r),
            "which": int(r.integers(2)),
            "lag": _log(r, 4.0, 20.0),
            "move": _log(r, 8.0, 40.0),
        },
    ),
    "tilt": Kind(
        "cross_axis:static",
        (),
        tilt,
        lambda r, s, f: {"sign": _sign(r), "which": int(r.integers(2)), "creep": _uniform(r, 30.0, 120.0)},
        axes=GYROS,
    ),
    "rectified": Kind("vibration:static", (), rectified, _motor, least_rate=10.0),
    # Noise
    "breathing": Kind(
        "variance_change", (), breathing, lambda r, s, f: {"tau": _uniform(r, 0.04, 0.12) * s}, slow=False
    ),
    "noise_of_temperature": Kind("variance_change", (), noise_of_temperature, lambda r, s, f: {}, slow=False),
    "noise_of_vibration": Kind("variance_change", ("vibration",), noise_of_vibration, _motor, slow=False),
    "noise_step": Kind(
        "variance_change", (), noise_step, lambda r, s, f: {"at": _place(r, s)}, by_effect=True, slow=False
    ),
    "feet": Kind("motion", ("outliers", "variance_change", "vibration"), steps_of_feet, _pass, slow=False),
    "radio": Kind("outliers", (), radio, _radio, by_effect=True, slow=False),
    "shared_white": Kind(
        "shared",
        ("cross_axis",),
        shared_white,
        lambda r, s, f: {"sign": _sign(r), "which": int(r.integers(2)), "ratio": _uniform(r, 0.6, 1.6)},
        slow=False,
    ),
    "shared_band": Kind(
        "shared",
        ("cross_axis", "colored_noise"),
        shared_band,
        lambda r, s, f: {
            "sign": _sign(r),
            "which": int(r.integers(2)),
            "centre": _uniform(r, 0.1, 0.38),
            "quality": _log(r, 2.0, 8.0),
        },
        slow=False,
    ),
    "filtered_noise": Kind("colored_noise", (), filtered_noise, lambda r, s, f: {}, by_effect=True, slow=False),
    # Slow processes
    "oscillating": Kind(
        "oscillation",
        (),
        oscillating,
        lambda r, s, f: {"period": _log(r, 50.0, 0.12 * s), "damping": _uniform(r, 0.05, 0.25)},
    ),
    "traps": Kind("flicker", (), traps, lambda r, s, f: {}, by_effect=True, least_seconds=3600.0, sizes=("near",)),
    "unseen_source": Kind(
        "shared",
        ("cross_axis",),
        unseen_source,
        lambda r, s, f: {
            "sign": _sign(r),
            "which": int(r.integers(2)),
            "ratio": _uniform(r, 0.7, 1.4),
            "tau": _log(r, 10.0, 60.0),
        },
    ),
    # Codes and readings
    "coarse": Kind(
        "quantization", (), coarse, lambda r, s, f: {}, by_effect=True, slow=False, axes=LEVEL, least_rate=10.0
    ),
    "sticky": Kind(
        "quantization",
        (),
        sticky,
        lambda r, s, f: {"lsb": _uniform(r, 0.3, 0.6), "dice": int(r.integers(2**31))},
        slow=False,
        axes=LEVEL,
    ),
    "dead_band": Kind(
        "quantization",
        ("stuck", "held_samples"),
        dead_band,
        lambda r, s, f: {
            "lsb": _uniform(r, 0.2, 0.5),
            "beside": _uniform(r, -1.0, 1.0),
            "dice": int(r.integers(2**31)),
        },
        slow=False,
        axes=LEVEL,
    ),
    "hiccup": Kind(
        "held_samples",
        ("stuck", "missing_samples", "rate_change", "colored_noise"),
        hiccup,
        lambda r, s, f: {"lsb": _uniform(r, 0.2, 0.5), "at": _uniform(r, 0.1, 0.9)},
        slow=False,
        axes=LEVEL,
    ),
    "stuck": Kind(
        "stuck",
        ("held_samples", "missing_samples"),
        stuck,
        lambda r, s, f: {"lsb": _uniform(r, 0.2, 0.5), "at": _uniform(r, 0.1, 0.9)},
        slow=False,
        axes=LEVEL,
    ),
}
CLEAN = "clean"


# ------------------------------------------------------------------------------------------------------------ records


@dataclass(frozen=True)
class Record:
    """Columns by `name[unit]`, their rate, the axis in question, and the truth (JSON)."""

    columns: dict[str, Array]
    rate: float
    axis: str
    truth: Truth

    @property
    def t(self) -> Array:
        return np.arange(len(next(iter(self.columns.values())))) / self.rate


def _scene(truth: Truth, number: int) -> Scene:
    random = np.random.default_rng([truth["seed"], zlib.crc32(truth["kind"].encode()), 100 + number, truth["try"]])
    axes = {name: Axis(**values) for name, values in truth["axes"].items()}
    scene = Scene(
        random, truth["rate"], truth["seconds"], truth["axis"], axes, truth["aperture"], dict(truth["lattice"])
    )
    scene.make()
    return scene


def _truth(
    kind: str, seed: int, size: str, attempt: int, rate: float | None, law: str | None, seconds: float | None
) -> Truth:
    """Everything that both records share but for the amount."""
    random = np.random.default_rng([seed, zlib.crc32(kind.encode()), 0, attempt])
    rate = float(random.choice(RATES[:2])) if rate is None else rate
    longest = 1800.0 if rate > 20.0 else 3600.0
    seconds = float(60 * random.integers(20, round(longest / 60.0) + 1)) if seconds is None else seconds
    if kind in KINDS:
        seconds = max(seconds, KINDS[kind].least_seconds)
    law = str(random.choice(LAWS)) if law is None else law
    target = str(random.choice(KINDS[kind].axes if kind in KINDS else AXES))
    axes = {name: draw_axis(random, name, law if name == target else str(random.choice(LAWS))) for name in AXES}
    if kind == "scale_change":
        axes[target] = Axis(**{**vars(axes[target]), "offset": _sign(random) * 40.0 * axes[target].n})
    steps = {name: (_uniform(random, 0.2, 0.5) if random.random() < 0.5 else None) for name in AXES}
    truth: Truth = {
        "kind": kind,
        "seed": seed,
        "size": size,
        "try": attempt,
        "rate": rate,
        "seconds": seconds,
        "law": law,
        "axis": target,
        "axes": {name: vars(axis) for name, axis in axes.items()},
        "aperture": FINE if random.random() < 0.7 else FINE // 2,
        "lattice": steps,
    }
    truth["parameters"] = KINDS[kind].draw(random, seconds, rate) if kind in KINDS else {}
    if kind in KINDS:
        truth["wanted_nats"] = _log(random, *SIZES[size])
    return truth


def _finish(scene: Scene, truth: Truth, made: Made | None) -> Record:
    """Readings with the effect, on their lattices."""
    amount, columns = truth.get("amount", 0.0), {}
    for name in AXES:
        fine = scene.drift[name] + scene.white[name]
        if made is not None and name in made.add:
            fine = fine + amount * made.add[name]
        values = scene.axes[name].offset + scene.read(fine)
        own = made is not None and name == scene.target
        if own and made is not None and made.after is not None:
            values = made.after(values, amount)
        step = scene.lattice[name]
        lsb = None if step is None else step * scene.sd(name)
        if own and made is not None and made.lattice is not None:
            lsb = made.lattice(amount)
        if lsb is not None:
            values = on_lattice(values, lsb)
        if own and made is not None and made.last is not None:
            values = made.last(values, amount)
        columns[f"{name}[{UNITS[name[0]]}]"] = values
    thermometer = scene.read(scene.temperature) + 0.06 * scene.random.normal(size=scene.n)
    voltmeter = scene.read(scene.supply) + 0.002 * scene.random.normal(size=scene.n)
    columns["temp[degC]"] = on_lattice(thermometer, TEMPERATURE_LSB)
    columns["supply[V]"] = on_lattice(voltmeter, SUPPLY_LSB)
    return Record(columns, scene.rate, scene.target, truth)


#: Draws of parameters before a kind is given up.
TRIES = 8


def pair(
    kind: str,
    seed: int,
    size: str = "plain",
    rate: float | None = None,
    law: str | None = None,
    seconds: float | None = None,
    second: bool = True,
) -> tuple[Record, Record | None]:
    """Two records of one truth. `truth["nats"]`: gain of the right model on the first; `nats_here`: on this one.

    `kind`: of `KINDS`, or `clean`. RuntimeError: no draw reaches the size at this rate and length.
    """
    reason = "no draw"
    for attempt in range(TRIES):
        truth = _truth(kind, seed, size, attempt, rate, law, seconds)
        try:
            first = _scene(truth, 1)
            if kind == CLEAN:
                return _finish(first, truth, None), _finish(_scene(truth, 2), truth, None) if second else None
            made = KINDS[kind].make(first, truth["parameters"])
            wanted = truth["wanted_nats"]
            truth["amount"] = solve(made.gain, wanted, made.low, made.high)
            truth["nats"] = truth["nats_here"] = made.gain(truth["amount"])
            if abs(truth["nats"] - wanted) > TOLERANCE + 0.05 * wanted:
                raise RuntimeError(f"{truth['nats']:.0f} nats, {wanted:.0f} wanted")
            truth["others"] = list(made.others)
            record = _finish(first, truth, made)
            if not second:
                return record, None
            again = _scene(truth, 2)
            remade = KINDS[kind].make(again, truth["parameters"])
            here = {**truth, "nats_here": remade.gain(truth["amount"])}
            return record, _finish(again, here, remade)
        except RuntimeError as error:
            reason = str(error)
    raise RuntimeError(f"{kind}, {size}, seed {seed}: {reason}")
