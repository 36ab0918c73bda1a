"""The tail of the best evidence of several axes on modules on which nothing acts: `NULL` of diagnosis/module.py.

    make module-null [RECORDS=n] [SEED=n]       default: 300 modules, some ten minutes of a processor

A module is six axes of white noise, each with a drift of its own: a walk, a Gauss-Markov process, or 1/f noise, over
half an hour to three hours at 1 Hz, with a temperature and a supply that wander. Chance makes a Bayes factor of e^T in
a share of c e^-T of the modules: c is printed at several T. Exit code 1: at 1 nat c is above 2 `NULL`.
"""

from __future__ import annotations

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one core a module

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from selfcal.diagnosis.module import NULL, Search, in_means
from selfcal.likelihood.joint import bins_of, fit_joint

Array = NDArray[np.float64]
#: Drift over white noise at 1 s, of a walk a step and of a Gauss-Markov process; of each octave of 1/f noise.
WALK, MARKOV, OCTAVE = (0.003, 0.1), (0.03, 1.0), (0.01, 0.3)


def markov(random: np.random.Generator, n: int, tau: float) -> Array:
    """[n]: a Gauss-Markov process of variance 1 at 1 Hz."""
    a = np.exp(-1.0 / tau)
    kick = np.sqrt(1.0 - a * a) * random.normal(size=n)
    kick[0] /= np.sqrt(1.0 - a * a)
    return np.asarray(lfilter([1.0], [1.0, -a], kick))


def axis(random: np.random.Generator, n: int) -> Array:
    """[n]: white noise of 1 and a drift."""
    law = random.choice(["walk", "markov", "flicker"])
    size = np.exp(random.uniform(*np.log({"walk": WALK, "markov": MARKOV, "flicker": OCTAVE}[law])))
    if law == "walk":
        drift = np.cumsum(random.normal(size=n))
    elif law == "markov":
        drift = markov(random, n, np.exp(random.uniform(np.log(10.0), np.log(2000.0))))
    else:
        drift = np.asarray(sum(markov(random, n, tau) for tau in 2.0 ** np.arange(1, 15)))
    return np.asarray(random.normal(size=n) + size * drift)


def best(seed: int) -> dict[str, float]:
    """The best evidence of each search on a module, nats."""
    random = np.random.default_rng([seed, 57])
    n = int(random.uniform(1800, 10800))
    y, kept_out, _ = in_means(np.array([axis(random, n) for _ in range(6)]))
    side = {name: markov(random, n, 600.0) for name in ("temperature", "supply")}
    known = Search(1.0, side, kept_out, 0.0, fit_joint(bins_of(y), 1.0, False), y).known
    return {name: max((column.evidence for column in columns), default=-np.inf) for name, columns in known.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description="The best evidence of several axes on clean modules.")
    parser.add_argument("--records", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.processes) as pool:
        answers = list(pool.map(best, range(options.seed, options.seed + options.records)))
    every = np.array([list(each.values()) for each in answers])
    print("search      median   0.9    0.99   most   of")
    for name, values in [*zip(answers[0], every.T, strict=True), ("any", every.max(axis=1))]:
        cells = [f"{value:7.2f}" for value in (*np.quantile(np.maximum(values, -99.0), (0.5, 0.9, 0.99)), values.max())]
        print(f"{name:10}", *cells, f"  seed {options.seed + int(np.argmax(values))}")
    tail = [float(np.mean(every.max(axis=1) > t) * np.exp(t)) for t in (-3.0, -2.0, -1.0, 0.0, 1.0)]
    print("c at -3, -2, -1, 0, 1 nats:", *(f"{c:.4f}" for c in tail), f"  stated {NULL}")
    return int(tail[-1] > 2.0 * NULL)


if __name__ == "__main__":
    sys.exit(main())
