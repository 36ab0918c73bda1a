"""Records of two gyros and a temperature with an influence among them, by code that shares none with the library.

Each function puts its influence into a record and returns the numbers that it was drawn with.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]

#: White noise, deg/s/sqrt(Hz), and random walk, deg/s^2/sqrt(Hz), of a gyro.
N, K = 0.05, 2.5e-4


#: Steps of what happens in a sample: a discretization that a record and its answer share would hide an error.
FINE = 10


def late(values: Array, lag_s: float, step_s: float) -> Array:
    """Behind a first-order lag, from the first value on: the mean of its state before and after each step."""
    a = math.exp(-step_s / lag_s)
    both = np.full(2, 0.5 * (1.0 - a))
    return np.asarray(lfilter(both, [1.0, -a], values, zi=[(both[1] + a) * values[0]])[0])


def wander(random: np.random.Generator, n: int, step_s: float, sd: float, time_s: float) -> Array:
    """A Gauss-Markov process from its stationary state on."""
    a = math.exp(-step_s / time_s)
    steps = sd * math.sqrt(1.0 - a * a) * random.standard_normal(n)
    steps[0] = sd * random.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -a], steps))


class Drawn:
    """Two gyros and a temperature, `FINE` steps a sample. Before the record, the temperature has moved for 2000 s."""

    def __init__(self, seed: int, n: int = 3000, dt: float = 1.0) -> None:
        self.random = random = np.random.default_rng([45, seed])
        self.n, self.dt, self.step = n, dt, dt / FINE
        self.steps, before = n * FINE, round(2000.0 / self.step)
        t = np.arange(self.steps + before) * self.step
        self.source = wander(random, t.size, self.step, 4.0, 600.0)
        self.source += 2.0 * np.sin(2.0 * math.pi * t / random.uniform(900.0, 1500.0))
        self.whole = 30.0 + late(self.source, 60.0, self.step)
        self.gx, self.gy = (
            N / math.sqrt(self.step) * random.standard_normal(self.steps)
            + K * math.sqrt(self.step) * random.standard_normal(self.steps).cumsum()
            for _ in range(2)
        )

    def now(self, whole: Array) -> Array:
        """The part of values that is in the record."""
        return whole[-self.steps :]

    def wandering(self, sd: float, time_s: float) -> Array:
        return wander(self.random, self.steps, self.step, sd, time_s)

    def temperature(self) -> Array:
        """As a part reads it in the middle of each interval: with a noise of its own, on a lattice of 0.14 degC."""
        there = self.now(self.whole)[FINE // 2 :: FINE]
        return np.asarray(0.14 * np.rint((there + 0.05 * self.random.standard_normal(self.n)) / 0.14))

    def write(self, path: Path, temperature: Array | None = None) -> Path:
        """A gyro reads means over each interval."""
        gx, gy = (one.reshape(self.n, FINE).mean(axis=1) for one in (self.gx, self.gy))
        read = self.temperature() if temperature is None else temperature
        np.savez(path, **{"t[s]": np.arange(self.n) * self.dt, "gx[deg/s]": gx, "gy[deg/s]": gy, "temp[degC]": read})
        return path


def other_axis(d: Drawn) -> dict[str, float]:
    d.gy += d.wandering(0.2, 60.0)
    d.gx += 0.3 * late(d.gy, 8.0, d.step)
    return {"gain": 0.3, "lag_s": 8.0}


def thermal(d: Drawn) -> dict[str, float]:
    d.gx += d.now(0.05 * late(d.whole, 250.0, d.step))
    return {"gain": 0.05, "lag_s": 250.0}


def change(d: Drawn) -> dict[str, float]:
    d.gx += d.now(4.0 * np.gradient(d.whole, d.step))
    return {"rate": 4.0}


def square(d: Drawn) -> dict[str, float]:
    d.gx += d.now(0.006 * (d.whole - 27.0) ** 2)
    return {"square": 0.006}


def cube(d: Drawn) -> dict[str, float]:
    d.gx += d.now(0.0007 * (d.whole - 29.0) ** 3)
    return {"cube": 0.0007}


def late_square(d: Drawn) -> dict[str, float]:
    d.gx += d.now(0.008 * (late(d.whole, 150.0, d.step) - 28.0) ** 2)
    return {"square": 0.008, "lag_s": 150.0}


def common(d: Drawn) -> None:
    source = d.wandering(0.2, 60.0)
    d.gx += 0.5 * source
    d.gy += source


def common_late(d: Drawn) -> None:
    source = d.wandering(0.3, 60.0)
    d.gx += 0.5 * late(source, 8.0, d.step)
    d.gy += late(source, 30.0, d.step)


def common_later(d: Drawn) -> None:
    source = d.wandering(0.3, 60.0)
    d.gx += 0.5 * late(source, 40.0, d.step)
    d.gy += late(source, 10.0, d.step)


def feedback(d: Drawn) -> None:
    d.gx += d.wandering(0.2, 60.0)
    d.gy += 0.5 * late(d.gx, 8.0, d.step)
