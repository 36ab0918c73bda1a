"""Clean axes that `selfcal diagnose` calls inadequate, in the forms in which people keep their logs.

    make false-alarms [RECORDS=n] [SEED=n] [RATE=hz]        default: 168 records of six axes, at 1 Hz and at 10 Hz

Imports nothing of selfcal but the verb under test. Truth: white noise and one drift law an axis, nothing else.
Each form has a quarter of the records: float64; readings on a lattice of a quarter of the noise; text with eight
significant digits; the same with means of ten readings on a lattice.
Exit code 1: more than 8 in 1000 axes are inadequate. 5 in 1000 are so by design.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # one core a record
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
UNITS = {"g": "deg/s", "a": "m/s^2"}
#: White noise density N by kind of axis.
N = {"g": 0.04, "a": 0.005}
FORMS = ("float", "lattice", "digits", "means")
#: Readings that the form `means` averages.
MEANT = 10
SECONDS = 1800.0
#: Share of clean axes that may be inadequate; half a per cent are by design, and 8 of 1000 leave that room for chance.
MOST = 0.008


def axis(random: np.random.Generator, name: str, n: int, dt: float, form: str) -> NDArray[np.float64]:
    """[n]: readings of one clean axis every `dt` s. az is upright; gyros have levels on both sides of 1."""
    kind = name[0]
    upright = random.choice([-9.80665, 9.80665]) if name == "az" else random.uniform(-0.3, 0.3)
    offset = upright if kind == "a" else random.choice([0.0, random.uniform(-0.5, 0.5), random.uniform(0.9, 1.1)])
    fine = MEANT if form == "means" else 1
    step = dt / fine
    count = n * fine
    density = N[kind] * np.exp(random.uniform(-0.7, 0.7))
    white = density / np.sqrt(step) * random.normal(size=count)
    law = random.choice(["constant", "random_walk", "gauss_markov"])
    drift = np.zeros(count)
    if law == "random_walk":
        drift = np.cumsum(random.normal(size=count)) * density * np.exp(random.uniform(-6.0, -3.5)) * np.sqrt(step)
    elif law == "gauss_markov":
        sigma, tau = density * np.exp(random.uniform(-2.5, -0.5)), np.exp(random.uniform(np.log(30.0), np.log(600.0)))
        phi = np.exp(-step / tau)
        kick = sigma * np.sqrt(1.0 - phi**2) * random.normal(size=count)
        kick[0] = sigma * random.normal()
        drift = lfilter([1.0], [1.0, -phi], kick)
    values = offset + drift + white
    if form in ("lattice", "means"):
        q = 0.25 * density / np.sqrt(step)
        values = q * np.rint(values / q)
    means: NDArray[np.float64] = values.reshape(n, fine).mean(axis=1)
    return means


def write(path: Path, seed: int, rate: float, form: str) -> None:
    """One record of six clean axes."""
    random = np.random.default_rng([seed, round(rate * 1000)])
    n = round(SECONDS * rate)
    columns = {f"{name}[{UNITS[name[0]]}]": axis(random, name, n, 1.0 / rate, form) for name in AXES}
    t = np.arange(n) / rate
    if path.suffix == ".npz":
        np.savez(path, allow_pickle=False, **{"t[s]": t, **columns})
        return
    heading = ",".join(["t[s]", *columns])
    np.savetxt(path, np.column_stack([t, *columns.values()]), "%.8g", ",", header=heading, comments="")


def judged(seed: int, rate: float) -> tuple[str, dict[str, str]]:
    """The form of a record, and the causes of each axis that is not adequate; an error counts as one."""
    from selfcal.verbs.diagnose import diagnose

    form = FORMS[seed % len(FORMS)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("clean.csv" if form in ("digits", "means") else "clean.npz")
        write(path, seed, rate, form)
        try:
            found = diagnose(path)["axes"]
        except Exception as error:  # whatever it raises on a clean record is a fault
            return form, {name: f"{type(error).__name__}: {error}" for name in AXES}
    wrong = {}
    for name, entry in found.items():
        if "error" in entry:
            wrong[name] = str(entry["error"])
        elif entry["findings"]:
            wrong[name] = " ".join(_words(finding) for finding in entry["findings"])
    return form, wrong


def _words(finding: dict[str, object]) -> str:
    estimate = finding["estimate"]
    shown = f":{estimate['statistic']}" if isinstance(estimate, dict) and "statistic" in estimate else ""
    return f"{finding['cause']}{shown}({finding['evidence_gain_nats']:.1f})"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=168)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rate", type=float, action="append")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    failed = False
    for rate in options.rate or (1.0, 10.0):
        start = time.perf_counter()
        wrong: Counter[str] = Counter()
        with ProcessPoolExecutor(options.workers) as pool:
            seeds = range(options.seed, options.seed + options.records)
            for seed, (form, found) in zip(seeds, pool.map(judged, seeds, [rate] * options.records), strict=True):
                wrong[form] += len(found)
                for name, why in found.items():
                    print(f"{rate:g} Hz, seed {seed}, {form}, {name}: {why}", flush=True)
        axes = options.records * len(AXES)
        count = sum(wrong.values())
        forms = ", ".join(f"{form} {wrong[form]}" for form in FORMS)
        print(f"{rate:g} Hz: {count} of {axes} clean axes inadequate ({forms}), {time.perf_counter() - start:.0f} s")
        failed |= count > MOST * axes
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
