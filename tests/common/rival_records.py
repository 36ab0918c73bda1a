"""Records of a gyro with one of two rival influences, and the evidence for each, by code that shares none with the
library: a first record of an hour, and the next one as a plan of `diagnose` says.

The records are drawn ten times finer. A chamber follows the cycle within 60 s, what is held wanders, and the sensor was
left on. The evidence is of a filter of a random walk over a grid of its size, and over a grid of the rival's number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from effects import play
from influences import FINE, Array, K, N, late, wander
from scipy.special import logsumexp

#: Length of the first record and of a mean that is scored, s; a sensor's noise and what it holds, by channel.
FIRST_S, MEAN_S = 3600, 5
CHANNELS = {"temp": ("temperature", "degC", 0.01, 0.05), "supply": ("supply", "V", 0.001, 0.002)}


@dataclass
class Part:
    """A gyro with one influence of the pair, and the record's circumstances, all of one seed."""

    pair: str
    true: str
    seed: int
    since_on_s: float = 0.0
    random: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.random = np.random.default_rng([61, 5, self.seed, *map(ord, self.pair + self.true)])
        self.tau_s = self.random.uniform(400.0, 900.0)
        self.size = self.random.uniform(0.8, 1.25) * self.random.choice([-1.0, 1.0])
        self.width = self.random.uniform(0.2, 0.6)
        if self.pair == "static, rate":
            self.since_on_s = 20.0 * self.tau_s

    def acts(self, t: Array, values: Mapping[str, Array], step: float) -> Array:
        """Of the true rival, `t` s from power-on."""
        if self.true == "turn_on":
            if self.pair == "turn_on, ramp":
                return self.size * 0.3 * np.exp(-t / (1700.0 + 2.0 * self.tau_s))
            return self.size * 0.18 * np.exp(-t / self.tau_s)
        if self.true == "ramp":
            return self.size * (4e-5 if self.pair == "turn_on, ramp" else 5e-5) * t
        if self.true == "supply":
            return self.size * (0.4 if self.pair == "supply, ramp" else 0.6) * values["supply"]
        if self.true == "rate":
            return self.size * 0.03 * self.tau_s * np.gradient(values["temp"], step)
        if self.true == "play":
            return self.size * 0.08 * play(values["temp"], self.width)
        coefficient = {"temperature, ramp": 0.06, "static, play": 0.08}.get(self.pair, 0.03)
        return self.size * coefficient * values["temp"]

    def first(self) -> dict[str, Array]:
        """Temperature and supply of the first record."""
        t = (np.arange(FIRST_S * FINE) + 0.5) / FINE
        rises = 25.0 + 6.0 * -np.expm1(-t / self.tau_s)
        if self.pair in ("temperature, turn_on", "static, rate"):
            return {"temp": rises}
        if self.pair == "temperature, ramp":
            return {"temp": 25.0 + 3.0 * t / FIRST_S}
        if self.pair == "static, play":
            return {"temp": 25.0 + 5.0 * np.exp((t - FIRST_S) / 900.0)}
        if self.pair == "supply, ramp":
            return {"supply": 5.0 - 0.45 * t / FIRST_S}
        if self.pair == "temperature, supply":
            temp = 25.0 + 2.0 * np.sin(2.0 * math.pi * t / self.random.uniform(1500.0, 2500.0))
            return {"temp": temp, "supply": 5.0 - 0.05 * (temp - 25.0)}
        return {}

    def next(self, plan: Mapping[str, Any]) -> dict[str, Array]:
        """The same of the next record: one follows the plan's cycle late, another one is held as well as it can be."""
        n = round(plan["duration_s"] * FINE)
        found = {}
        for name, (cause, _, _, held) in CHANNELS.items():
            if name not in self.first():
                continue
            found[name] = (25.0 if name == "temp" else 5.0) + wander(self.random, n, 1.0 / FINE, held, 600.0)
            if plan["drive"] == cause:
                t = np.arange(n) / FINE
                cycle = -0.5 * plan["amplitude"] * np.cos(2.0 * math.pi * t / plan["period_s"])
                found[name] += late(cycle, 60.0, 1.0 / FINE)
        return found

    def record(self, values: Mapping[str, Array], begin_s: float, n: int) -> dict[str, Array]:
        """The readings at 1 Hz; `begin_s`: s from power-on to the first one."""
        step = 1.0 / FINE
        t = begin_s + (np.arange(n * FINE) + 0.5) * step
        drift = K * math.sqrt(step) * self.random.standard_normal(t.size).cumsum()
        gx = N / math.sqrt(step) * self.random.standard_normal(t.size) + drift + self.acts(t, values, step)
        readings = {"t[s]": np.arange(n, dtype=float), "gx[deg/s]": gx.reshape(n, FINE).mean(axis=1)}
        for name, row in values.items():
            _, unit, noise, _ = CHANNELS[name]
            readings[f"{name}[{unit}]"] = row[FINE // 2 :: FINE] + noise * self.random.standard_normal(n)
        return readings


def means(values: Array) -> Array:
    n = values.size // MEAN_S
    return values[: n * MEAN_S].reshape(n, MEAN_S).mean(axis=1)


def columns(rival: str, readings: Mapping[str, Array], begin_s: float) -> Array:
    """[places, n]: what a rival may look like in a record."""
    t = begin_s + means(readings["t[s]"] + 0.5)
    if rival == "turn_on":
        return np.exp(-t / np.geomspace(100.0, FIRST_S, 20)[:, None])
    if rival == "ramp":
        return t[None] / 1000.0
    if rival == "supply":
        return means(readings["supply[V]"])[None]
    temp = readings["temp[degC]"]
    if rival == "rate":  # between the means of a minute before and after
        sums = np.cumsum(np.concatenate([np.full(60, temp[:30].mean()), temp, np.full(60, temp[-30:].mean())]))
        return means((sums[120:] - 2.0 * sums[60:-60] + sums[:-120]) / 3600.0)[None]
    if rival == "play":
        return np.array([play(means(temp), width) for width in np.geomspace(0.1, 6.0, 15)])
    return means(temp)[None]


def whitened(rows: Array, ratio: Array) -> tuple[Array, Array]:
    """Products [r, m, m] of rows [m, n] behind the filter of white noise and a walk, whose step over the white noise
    has the variance `ratio` [r], and the sum of ln of the innovations' variances [r]."""
    P, x, D = np.zeros(ratio.size), np.zeros((ratio.size, len(rows))), np.zeros(ratio.size)
    kept = np.empty((rows.shape[1], ratio.size, len(rows)))
    for i, row in enumerate(rows.T):
        S = 1.0 + P
        error = row - x
        kept[i] = error / np.sqrt(S)[:, None]
        x += (P / S)[:, None] * error
        D += np.log(S)
        P = P / S + ratio
    each = kept.transpose(1, 2, 0)
    return each @ each.transpose(0, 2, 1), D


def evidence(rival: str, records: Sequence[tuple[Mapping[str, Array], float]]) -> float:
    """ln evidence of records with one coefficient, each with a bias and a walk of its own."""
    ratio = np.geomspace(1e-3, 10.0, 17) ** 2 * (K / N) ** 2 * MEAN_S**2
    G, D, n = 0.0, 0.0, 0
    for readings, begin_s in records:
        y = means(readings["gx[deg/s]"])
        shapes = columns(rival, readings, begin_s)
        Gi, Di = whitened(np.vstack([np.ones(y.size), y, shapes - shapes.mean(axis=1, keepdims=True)]), ratio)
        G = G + Gi[:, 1:, 1:] - Gi[:, 1:, :1] * Gi[:, :1, 1:] / Gi[:, :1, :1]  # less the bias
        D, n = D + Di + np.log(Gi[:, 0, 0]), n + y.size - 1
    A, b, yy = np.diagonal(G, axis1=1, axis2=2)[:, 1:], G[:, 0, 1:], G[:, :1, 0]
    ln = -0.5 * (n - 1) * np.log(yy - b**2 / A) - 0.5 * np.log(A) - 0.5 * D[:, None]
    return float(logsumexp(ln) - math.log(ln.size))
