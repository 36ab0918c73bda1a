"""`selfcal response` on drawn records: how often gain and dynamics are in their 90 %, and how often it is silent.

    PYTHONPATH=tests/common python tests/response_cells.py --records 25
    PYTHONPATH=tests/common python tests/response_cells.py --records 100 --structures delay lag --inputs steps

A record has 3000 samples of 1 s. A day has 4320 of 20 s, and time constants 40 times as long. All is drawn ten times
finer, by code that shares none with the library. The temperature follows its source within 60 s, on a day 2400 s. The
part reads it with a noise of 0.05 degC on a lattice of 0.14 degC. Four influences are outside of every structure.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from effects import play
from influences import FINE, Array, K, N, late, wander
from scipy.signal import bilinear, lfilter

from selfcal.verbs.response import response

GAIN = 0.05
#: Samples and their interval, s, and a day's; its time constants are so many times as long.
SHORT, DAY, SLOWER = (3000, 1.0), (4320, 20.0), 40.0
INPUTS = ("prbs", "steps", "day", "wandering")


class Record:
    """A temperature of one kind and a gyro's own drift, `FINE` steps a sample, after as long a time before."""

    def __init__(self, kind: str, seed: int) -> None:
        self.random = random = np.random.default_rng([61, seed, *map(ord, kind)])
        self.n, self.dt = DAY if kind == "day" else SHORT
        self.scale = SLOWER if kind == "day" else 1.0
        self.step, self.steps = self.dt / FINE, self.n * FINE
        t = np.arange(2 * self.steps) * self.step
        unit = self.scale * random.uniform(0.8, 1.25)
        if kind == "prbs":
            bits = random.choice([-4.0, 4.0], 2 + int(t[-1] / (60.0 * unit)))
            source = bits[(t / (60.0 * unit)).astype(int)]
        elif kind == "steps":
            levels = random.uniform(-6.0, 6.0, 2 + int(t[-1] / (500.0 * unit)))
            source = levels[(t / (500.0 * unit)).astype(int)]
        elif kind == "day":
            source = 8.0 * np.maximum(np.sin(2.0 * math.pi * (t / 86400.0 + random.uniform())), -0.3)
            source += wander(random, t.size, self.step, 1.5, 7200.0)
        else:
            source = wander(random, t.size, self.step, 4.0, 600.0)
        self.u = 30.0 + late(source, 60.0 * self.scale, self.step)
        self.gx = N / math.sqrt(self.step) * random.standard_normal(self.steps)
        self.gx += K / math.sqrt(self.scale) * math.sqrt(self.step) * random.standard_normal(self.steps).cumsum()

    def write(self, path: Path, acts: Array) -> Path:
        gx = (self.gx + acts[-self.steps :]).reshape(self.n, FINE).mean(axis=1)
        read = self.u[-self.steps :][FINE // 2 :: FINE] + 0.05 * self.random.standard_normal(self.n)
        columns = {"t[s]": np.arange(self.n) * self.dt, "gx[deg/s]": gx, "temp[degC]": 0.14 * np.rint(read / 0.14)}
        np.savez(path, **columns)
        return path


def after(u: Array, delay_s: float, step_s: float) -> Array:
    k = round(delay_s / step_s)
    return np.concatenate([np.full(k, u[0]), u[: u.size - k]])


def swinging(u: Array, period_s: float, damping: float, step_s: float) -> Array:
    w = 2.0 * math.pi / period_s
    b, a = bilinear([w * w], [1.0, 2.0 * damping * w, w * w], 1.0 / step_s)
    return np.asarray(u[0] + lfilter(b, a, u - u[0]))


Truth = tuple[Array, dict[str, float]]


def delay(r: Record) -> Truth:
    late_s = r.scale * r.random.uniform(20.0, 60.0)
    late_s = round(late_s / r.step) * r.step
    return GAIN * after(r.u, late_s, r.step), {"gain": GAIN, "delay_s": late_s}


def resonance(r: Record) -> Truth:
    period, damping = r.scale * r.random.uniform(110.0, 220.0), r.random.uniform(0.2, 0.45)
    truth = {"gain": GAIN, "period_s": period, "damping": damping}
    return GAIN * swinging(r.u, period, damping, r.step), truth


def lag(r: Record) -> Truth:
    lag_s = r.scale * r.random.uniform(60.0, 250.0)
    return GAIN * late(r.u, lag_s, r.step), {"gain": GAIN, "lag_s": lag_s}


def rate(r: Record) -> Truth:
    size = 4.0 * r.scale
    return size * np.gradient(r.u, r.step), {"rate": size}


def late_square(r: Record) -> Truth:
    lag_s = r.scale * r.random.uniform(80.0, 200.0)
    return 0.008 * (late(r.u, lag_s, r.step) - 28.0) ** 2, {"square": 0.008, "lag_s": lag_s}


def hysteresis(r: Record) -> Truth:
    width = r.random.uniform(1.5, 3.0)
    return GAIN * play(r.u, width), {"gain": GAIN, "width": width}


def two_lags(r: Record) -> Truth:
    r.lags = lags = sorted(r.scale * r.random.uniform((40.0, 120.0), (80.0, 250.0)))
    return GAIN * late(late(r.u, lags[0], r.step), lags[1], r.step), {"gain": GAIN, "delay_s": float(sum(lags))}


def late_delay(r: Record) -> Truth:
    """A resonance after a delay."""
    u = after(r.u, 50.0 * r.scale, r.step)
    return GAIN * swinging(u, 150.0 * r.scale, 0.2, r.step), {"gain": GAIN}


def two_ways(r: Record) -> Truth:
    """At once, and back again late: its static gain is a fifth of the fast one."""
    return GAIN * (5.0 * r.u - 4.0 * late(after(r.u, 100.0 * r.scale, r.step), 60.0 * r.scale, r.step)), {"gain": GAIN}


def one_sided(r: Record) -> Truth:
    """Two lags: warming is quick, cooling slow."""
    out, at = np.empty(r.u.size), float(r.u[0])
    up, down = r.step / (30.0 * r.scale), r.step / (300.0 * r.scale)
    for i, one in enumerate(r.u.tolist()):
        at += (one - at) * (up if one > at else down)
        out[i] = at
    return GAIN * out, {"gain": GAIN}


def changing(r: Record) -> Truth:
    """A gain that grows to its double over the record: there is none to state."""
    u = late(r.u, 100.0 * r.scale, r.step) - 30.0
    grown = 1.0 + np.clip(np.arange(u.size) / r.steps - 1.0, 0.0, 1.0)
    return GAIN * u * grown, {"gain": math.nan}


INSIDE: dict[str, Callable[[Record], Truth]] = {
    "lag": lag,
    "delay": delay,
    "resonance": resonance,
    "two lags": two_lags,
    "rate": rate,
    "lag and square": late_square,
    "hysteresis": hysteresis,
}
OUTSIDE: dict[str, Callable[[Record], Truth]] = {
    "resonance after a delay": late_delay,
    "two ways": two_ways,
    "one-sided lag": one_sided,
    "changing gain": changing,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=25)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--structures", nargs="+", default=[*INSIDE, *OUTSIDE])
    parser.add_argument("--inputs", nargs="+", default=INPUTS)
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    start = time.process_time()
    print("structure, input: named; each truth in its 90 %, of the records that state it; silent")
    with tempfile.TemporaryDirectory() as folder:
        for name in given.structures:
            for kind in given.inputs:
                named = silent = 0
                held: dict[str, list[bool]] = {}
                others: dict[str, int] = {}
                for seed in range(given.seed, given.seed + given.records):
                    record = Record(kind, seed)
                    acts, truth = (INSIDE | OUTSIDE)[name](record)
                    log = record.write(Path(folder) / "log.npz", acts)
                    found = response(log, input="temp", output="gx")
                    structure = found.get("structure", "no influence")
                    named += structure == name
                    others[structure] = others.get(structure, 0) + (structure != name)
                    if "estimate" not in found:
                        silent += 1
                        if given.verbose:
                            print("   ", seed, structure, found["source"]["reason"])
                        continue
                    for key, value in truth.items():
                        one = found["estimate"].get(key)
                        if one is None and key != "gain":
                            continue  # of another structure, which has no such number
                        inside = one is not None and one["q05"] <= value <= one["q95"]
                        held.setdefault(key, []).append(inside)
                        if given.verbose and not inside:
                            print("   ", seed, structure, key, value, one and [one[at] for at in ("q05", "q95")])
                shown = ", ".join(f"{key} {sum(one)}/{len(one)}" for key, one in held.items())
                called = ", ".join(f"{key} {count}" for key, count in others.items() if count)
                print(f"{name}, {kind}: {named} of {given.records}; {shown}; silent {silent}; called {called or '-'}",
                      flush=True)  # fmt: skip
    print(f"{time.process_time() - start:.0f} s of a processor")


if __name__ == "__main__":
    main()
