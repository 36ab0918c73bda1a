"""Records of two gyros with one effect on gx, sample by sample in numpy: every cause, in every form that it has.

Each function puts its effect into a record and returns the truth, by key of the estimate. It leaves a key out where the
truth has no number: a short-term variance is known from some samples only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]
Truth = Mapping[str, float]

#: White noise, deg/s/sqrt(Hz), random walk, deg/s^2/sqrt(Hz), or Gauss-Markov drift, deg/s and s, and bias, deg/s.
N, K, SIGMA_M, TIME_S, BIAS = 0.04, 1e-4, 0.004, 300.0, 0.1


def wander(random: np.random.Generator, n: int, dt: float, sd: float, time_s: float) -> Array:
    """A Gauss-Markov process [n] from its stationary state on."""
    keep = math.exp(-dt / time_s)
    kick = sd * math.sqrt(1.0 - keep**2) * random.standard_normal(n)
    kick[0] = sd * random.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -keep], kick))


def late(values: Array, time_s: float, dt: float) -> Array:
    """Behind a first-order lag, from rest at the first value."""
    keep = math.exp(-dt / time_s)
    return np.asarray(values[0] + lfilter([1.0 - keep], [1.0, -keep], values - values[0]))


def play(values: Array, width: float) -> Array:
    """What follows only where a play of `width` makes it."""
    out, x = np.empty(values.size), values[0]
    for i, value in enumerate(values.tolist()):
        x = min(max(x, value - 0.5 * width), value + 0.5 * width)
        out[i] = x
    return out


class Drawn:
    """A record at `rate`, Hz, of `seconds`: gx and gy, a temperature that is cycled, and a supply."""

    def __init__(self, seed: int, rate: float = 1.0, seconds: float = 1200.0) -> None:
        self.random = random = np.random.default_rng(seed)
        self.law = ("walk", "markov")[seed % 2]
        self.rate, self.dt, self.n = rate, 1.0 / rate, round(seconds * rate)
        self.t = np.arange(self.n) * self.dt
        self.y = {name: self._noise() for name in ("gx", "gy")}
        slow, quick = random.uniform(500.0, 700.0), random.uniform(190.0, 260.0)
        phase = random.uniform(0.0, 2.0 * math.pi, 2)
        self.temperature = 31.0 + 5.0 * np.sin(2.0 * math.pi * self.t / slow + phase[0])
        self.temperature += 1.2 * np.sin(2.0 * math.pi * self.t / quick + phase[1])
        self.supply = 5.0 + wander(random, self.n, self.dt, 0.012, 60.0)
        self.sign = float(random.choice([-1.0, 1.0]))
        self.stamps = self.t

    def _noise(self) -> Array:
        return self.sd * self.random.standard_normal(self.n) + self.drift()

    def drift(self) -> Array:
        """The bias: a walk, or a Gauss-Markov drift in every other record."""
        if self.law == "walk":
            return np.asarray(BIAS + K * math.sqrt(self.dt) * self.random.standard_normal(self.n).cumsum())
        return np.asarray(BIAS + wander(self.random, self.n, self.dt, SIGMA_M, TIME_S))

    @property
    def sd(self) -> float:
        """Of the white noise of a sample."""
        return N * math.sqrt(self.rate)

    def keep(self, rows: NDArray[np.intp]) -> None:
        """Of the record some rows alone."""
        self.stamps = self.stamps[rows]
        self.y = {name: y[rows] for name, y in self.y.items()}
        self.temperature, self.supply = self.temperature[rows], self.supply[rows]

    def write(self, path: Path) -> Path:
        """Temperature and supply as a part reads them: with noise of their own."""
        noise = self.random.standard_normal((2, self.stamps.size))
        sides = {"temp[degC]": self.temperature + 0.02 * noise[0], "supply[V]": self.supply + 5e-4 * noise[1]}
        np.savez(path, **{"t[s]": self.stamps, **{f"{name}[deg/s]": y for name, y in self.y.items()}, **sides})
        return path


Effect = Callable[[Drawn], Truth]


# ------------------------------------------------------------------------------------------------------------ channels


def _of(channel: str, form: str, **numbers: float) -> Effect:
    """A channel that acts by a form, each coefficient of the record's sign. `about`: the value of no effect."""

    def effect(d: Drawn) -> Truth:
        values = {"temperature": d.temperature, "supply": d.supply, "gy": d.y["gy"]}[channel]
        if channel == "gy":
            d.y["gy"] += wander(d.random, d.n, d.dt, 0.25, 25.0)
        size = {key: d.sign * value for key, value in numbers.items() if key not in ("lag_s", "width", "about")}
        about = numbers.get("about", 0.0)
        filtered = late(values, numbers["lag_s"], d.dt) if "lag_s" in numbers else values
        made: Mapping[str, Callable[[], Array]] = {
            "static": lambda: size["coefficient"] * values,
            "lag": lambda: size["coefficient"] * filtered,
            "rate": lambda: size["rate"] * np.gradient(values, d.dt),
            "square": lambda: size["square"] * (values - about) ** 2,
            "cube": lambda: size["cube"] * (values - about) ** 3,
            "play": lambda: size["coefficient"] * play(values, numbers["width"]),
            "free": lambda: size["height"] * np.exp(-0.5 * ((values - about) / 0.8) ** 2),
            "first_order": lambda: (
                size["coefficient"] * filtered + size["rate"] * (values - filtered) / numbers["lag_s"]
            ),
        }
        d.y["gx"] += made[form]()
        truth = {key: numbers[key] for key in ("lag_s", "width") if key in numbers}
        # A power about another value than the record's middle has another static part.
        return {**truth, **({} if form in ("square", "cube", "free") else size)}

    return effect


def _fan(lag_s: float) -> Effect:
    """A fan that runs by turns shakes gy, and the shaking rectifies into gx."""

    def effect(d: Drawn) -> Truth:
        edges = np.cumsum(d.random.uniform(50.0, 130.0, 60))
        runs = (np.searchsorted(edges, d.t) % 2).astype(np.float64)
        swing = 2.0 * d.sd * runs
        d.y["gy"] += swing * d.random.standard_normal(d.n)
        d.y["gx"] += d.sign * 0.12 * (late(runs, lag_s, d.dt) if lag_s else runs)
        return {}

    return effect


def shared(d: Drawn) -> Truth:
    """Each axis drifts alone: a leak would bring its drift along."""
    for name in d.y:
        d.y[name] += wander(d.random, d.n, d.dt, 0.2, 150.0)
    common = 0.8 * d.sd * d.random.standard_normal(d.n)
    d.y["gx"] += common
    d.y["gy"] += d.sign * common
    return {"correlation": d.sign * 0.64 / 1.64}


# ----------------------------------------------------------------------------------------------------- shapes and lines


def ramp(d: Drawn) -> Truth:
    d.y["gx"] += d.sign * 3.5e-4 * d.t
    return {"slope": d.sign * 3.5e-4}


def step(d: Drawn) -> Truth:
    time_s = float(d.random.uniform(0.35, 0.65)) * d.t[-1]
    d.y["gx"] += d.sign * 0.14 * (d.t >= time_s)
    return {"time_s": time_s, "amplitude": d.sign * 0.14}


def pulse(d: Drawn) -> Truth:
    time_s, duration_s = float(d.random.uniform(0.25, 0.45)) * d.t[-1], float(d.random.uniform(90.0, 260.0))
    d.y["gx"] += d.sign * 0.13 * ((d.t >= time_s) & (d.t < time_s + duration_s))
    return {"time_s": time_s, "duration_s": duration_s, "amplitude": d.sign * 0.13}


def two_level(d: Drawn) -> Truth:
    """Popcorn noise: each level holds for an exponential time."""
    low_s, high_s = 45.0, 75.0
    lengths = np.column_stack([d.random.exponential(one, 200) for one in (low_s, high_s)]).ravel()
    upper = np.searchsorted(lengths.cumsum(), d.t) % 2
    d.y["gx"] += 0.16 * upper
    return {"amplitude": 0.16, "dwell_low_s": low_s, "dwell_high_s": high_s}


def _settles(*parts: float) -> Effect:
    """Amplitudes and time constants in turn."""

    def effect(d: Drawn) -> Truth:
        for amplitude, tau_s in zip(parts[::2], parts[1::2], strict=True):
            d.y["gx"] += d.sign * amplitude * np.exp(-d.t / tau_s)
        keys = ("amplitude", "tau_s", "amplitude_2", "tau_2_s")
        return {
            key: d.sign * part if k % 2 == 0 else part for k, (key, part) in enumerate(zip(keys, parts, strict=False))
        }

    return effect


def _lines(hz: float, *sizes: float) -> Effect:
    """A line and its harmonics."""

    def effect(d: Drawn) -> Truth:
        for k, size in enumerate(sizes, 1):
            d.y["gx"] += size * np.sin(2.0 * math.pi * k * hz * d.t + d.random.uniform(0.0, 6.0))
        return {"frequency_hz": hz, "amplitude": sizes[0]}

    return effect


def alternating(d: Drawn) -> Truth:
    """A line at half the rate: every other reading is higher."""
    d.y["gx"] += 0.04 * d.sign * np.cos(math.pi * np.arange(d.n))
    return {"frequency_hz": 0.5 / d.dt, "amplitude": 0.04}


def band(d: Drawn) -> Truth:
    """A line whose phase wanders."""
    phase = (0.13 * d.random.standard_normal(d.n)).cumsum()
    d.y["gx"] += 0.075 * np.sin(2.0 * math.pi * 0.21 * d.t + phase)
    return {"frequency_hz": 0.21}


def oscillation(d: Drawn) -> Truth:
    """x'' + 2 damping w x' + w^2 x = noise, of stationary deviation `sd`, by small steps."""
    period_s, damping, sd, steps = 110.0, 0.12, 0.05, 20
    w, h = 2.0 * math.pi / period_s, d.dt / steps
    settle = round(8.0 * period_s / d.dt) * steps
    kick = sd * math.sqrt(4.0 * damping * w**3 * h) * d.random.standard_normal(settle + d.n * steps)
    loss = 2.0 * damping * w * h
    d.y["gx"] += lfilter([h], [1.0, -(2.0 - (w * h) ** 2 - loss), 1.0 - loss], kick)[settle::steps]
    return {"period_s": period_s, "damping": damping, "sd": sd}


# --------------------------------------------------------------------------------------------------------------- noise


def flicker(d: Drawn) -> Truth:
    """By its spectrum, two-sided B^2 / (2 pi f), of a record eight times as long."""
    B, n = 0.2, 8 * d.n
    f = np.fft.rfftfreq(n, d.dt)
    size = np.sqrt(B**2 / (2.0 * math.pi * f[1:]) * n / d.dt / 2.0)
    wave = np.concatenate([[0.0], size * (d.random.standard_normal(n // 2) + 1j * d.random.standard_normal(n // 2))])
    d.y["gx"] += np.fft.irfft(wave, n)[: d.n]
    return {"B": B}


def _coloured(taps: tuple[float, ...], poles: tuple[float, ...], lag1: float) -> Effect:
    """The white noise of gx, filtered."""

    def effect(d: Drawn) -> Truth:
        d.y["gx"] = d.drift() + lfilter(taps, poles, d.sd * d.random.standard_normal(d.n + 50))[50:]
        return {"lag1": lag1}

    return effect


def quantization_noise(d: Drawn) -> Truth:
    """Differences of the remainders of a counter, each uniform in its increment."""
    Q = 0.05
    d.y["gx"] += np.diff(math.sqrt(12.0) * Q * d.random.random(d.n + 1)) / d.dt
    return {"Q": Q}


def outliers(d: Drawn) -> Truth:
    rows = d.random.choice(d.n, round(0.012 * d.n), replace=False)
    d.y["gx"][rows] += d.random.choice([-1.0, 1.0], rows.size) * d.random.uniform(10.0, 25.0, rows.size) * d.sd
    return {"fraction": rows.size / d.n}


def lost_words(d: Drawn) -> Truth:
    """Readings that come as the same word."""
    rows = d.random.choice(d.n, round(0.03 * d.n), replace=False)
    d.y["gx"][rows] = -7.0
    return {"fraction": rows.size / d.n}


def louder(d: Drawn) -> Truth:
    time_s = float(d.random.uniform(0.4, 0.6)) * d.t[-1]
    d.y["gx"] += math.sqrt(3.0) * d.sd * d.random.standard_normal(d.n) * (d.t >= time_s)
    return {"time_s": time_s, "ratio": 2.0}


def louder_in_the_heat(d: Drawn) -> Truth:
    level = np.exp(0.16 * (d.temperature - 31.0))
    d.y["gx"] = d.drift() + level * d.sd * d.random.standard_normal(d.n)
    return {"coefficient": 0.16}


# ------------------------------------------------------------------------------------------------------------ read-out


def coarse(d: Drawn) -> Truth:
    d.y["gx"] = 0.05 * np.rint(d.y["gx"] / 0.05)
    return {"lsb": 0.05}


def dead_band(d: Drawn) -> Truth:
    """Readings near a value become it."""
    inside = np.abs(d.y["gx"] - BIAS) < 0.6 * d.sd
    d.y["gx"][inside] = BIAS
    return {"misread": float(inside.mean())}


def clipped(d: Drawn) -> Truth:
    d.y["gx"] = np.minimum(d.y["gx"], BIAS + 0.9 * d.sd)
    return {"limit": BIAS + 0.9 * d.sd}


def lost(d: Drawn) -> Truth:
    gone = np.sort(d.random.choice(np.arange(1, d.n - 1), round(0.05 * d.n), replace=False))
    d.keep(np.setdiff1d(np.arange(d.n), gone))
    return {"missing": gone.size}


def stuck(d: Drawn) -> Truth:
    for begin in (0.3, 0.7):
        first = round(begin * d.n)
        d.y["gx"][first : first + d.n // 25] = d.y["gx"][first]
    return {}


def held(d: Drawn) -> Truth:
    """Each reading for four rows of the log, on both axes."""
    for name, y in d.y.items():
        d.y[name] = np.repeat(y[::4], 4)[: d.n]
    return {"rate_hz": d.rate / 4.0}


def held_in_part(d: Drawn) -> Truth:
    """For a while each reading comes three times."""
    first, count = d.n // 3, d.n // 20
    d.y["gx"][first : first + 3 * count] = np.repeat(d.y["gx"][first : first + 3 * count : 3], 3)
    return {"rate_hz": d.rate / 3.0}


def other_rate(d: Drawn) -> Truth:
    """From the middle on the log has means of two readings."""
    half = d.n // 2
    for name, y in d.y.items():
        d.y[name] = np.concatenate([y[:half], y[half:].reshape(-1, 2).mean(axis=1)])
    rows = np.concatenate([np.arange(half), np.arange(half + 1, d.n, 2)])
    d.stamps, d.temperature, d.supply = d.stamps[rows], d.temperature[rows], d.supply[rows]
    return {"after_hz": d.rate / 2.0}


def hands(d: Drawn) -> Truth:
    """The sensor is shaken three times."""
    for begin in (0.2, 0.5, 0.8):
        first = round(begin * d.n)
        for y in d.y.values():
            y[first : first + 12] += 30.0 * d.sd * d.random.standard_normal(12)
    return {}


def flat(d: Drawn) -> Truth:
    """Uniform noise: no cause of the table has it."""
    d.y["gx"] = d.drift() + math.sqrt(12.0) * d.sd * (d.random.random(d.n) - 0.5)
    return {}


#: Rates of the records of some causes, Hz, where others have 1: their shape lies between a few samples.
RATES = {"vibration": 2.0, "flicker": 2.0}
#: By cause, by form. A cause without an entry is drawn by `simulate --effect` with the defaults of its keys.
FORMS: Mapping[str, Mapping[str, Effect]] = {
    "temperature": {
        "static": _of("temperature", "static", coefficient=0.02),
        "lag": _of("temperature", "lag", coefficient=0.04, lag_s=90.0),
        "rate": _of("temperature", "rate", rate=2.5),
        "square": _of("temperature", "square", square=0.006, about=29.0),
        "cube": _of("temperature", "cube", cube=0.0015, about=31.0),
        "play": _of("temperature", "play", coefficient=0.04, width=3.5),
        "free": _of("temperature", "free", height=0.25, about=31.0),
        "first_order": _of("temperature", "first_order", coefficient=0.02, rate=4.0, lag_s=50.0),
    },
    "supply": {
        "static": _of("supply", "static", coefficient=5.0),
        "lag": _of("supply", "lag", coefficient=9.0, lag_s=40.0),
    },
    "cross_axis": {
        "static": _of("gy", "static", coefficient=0.3),
        "lag": _of("gy", "lag", coefficient=0.6, lag_s=15.0),
        "square": _of("gy", "square", square=0.5, about=0.1),
    },
    "shared": {"white": shared},
    "vibration": {"static": _fan(0.0), "lag": _fan(25.0)},
    "ramp": {"ramp": ramp},
    "step": {"step": step},
    "pulse": {"pulse": pulse},
    "two_level": {"popcorn": two_level},
    "turn_on": {"one": _settles(0.3, 70.0), "two": _settles(0.5, 12.0, -0.25, 150.0)},
    "periodic": {
        "line": _lines(0.043, 0.03),
        "harmonics": _lines(0.071, 0.05, 0.045, 0.04, 0.035),
        "half the rate": alternating,
        "band": band,
    },
    "oscillation": {"damped": oscillation},
    "flicker": {"flicker": flicker},
    "colored_noise": {
        "first order": _coloured((math.sqrt(0.75),), (1.0, -0.5), 0.5),
        "average": _coloured((math.sqrt(0.5), math.sqrt(0.5)), (1.0,), 0.5),
    },
    "quantization_noise": {"counter": quantization_noise},
    "quantization": {"lattice": coarse, "dead band": dead_band},
    "outliers": {"single": outliers, "lost words": lost_words},
    "variance_change": {"once": louder, "by temperature": louder_in_the_heat},
    "saturation": {"one side": clipped},
    "missing_samples": {"scattered": lost},
    "stuck": {"twice": stuck},
    "held_samples": {"throughout": held, "in part": held_in_part},
    "rate_change": {"half": other_rate},
    "motion": {"hands": hands},
    "unexplained": {"flat": flat},
}
