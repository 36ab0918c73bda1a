"""Clean axes of which selfcal says that something is wrong, against its two budgets, in the forms of people's logs.

    make false-alarms [RECORDS=n] [SEED=n] [RATE=hz]    default: 112 records of six axes at each of 1, 10 and 100 Hz

Truth: white noise and one drift law an axis, nothing else. Each form has a quarter of the records: float64; readings on
a lattice of a quarter of the noise; text with eight significant digits; the same with means of ten readings.

- Readings: `readings/faults.py` names 2 in 1000 sound axes at most. Each fault is looked for with 20 times its share as
  well, and named on no more axes than a binomial count exceeds in 1 of 1000 runs.
- Causes and verdict: 2 in 100 modules have a finding. `identify` looks at all records, `diagnose` at every fifth one,
  both at 20 times their shares as well; then each check of `identify` keeps to its own.

Exit code 1: a count is beyond what its share exceeds in 1 of 1000 runs.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # one core a record
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import binom

from generator import AXES, UNITS

#: White noise density N by kind of axis.
N = {"g": 0.04, "a": 0.005}
FORMS = ("float", "lattice", "digits", "means")
LAWS = ("constant", "random_walk", "gauss_markov", "flicker")
#: Readings that the form `means` averages.
MEANT = 10
#: Length of a record, s, by its rate, Hz.
SECONDS = {1.0: 1200.0, 10.0: 1200.0, 100.0: 300.0}
#: Share of axes in which readings are called wrong, and of modules that have a finding.
OF_READINGS, MOST = 2e-3, 2e-2
#: Factor on the share of each test of the readings, so that a count shows what the share itself hides.
TIMES = 20.0
#: Checks of `identify` that chance may fail; `allan` is all its averaging times together.
OF_IDENTIFY = {"channel", "turn_on", "jump", "allan"} | {
    f"innovation_{name}" for name in ("mean", "lag1", "excess_kurtosis", "ln_variance_ratio_of_halves")
}
#: Every so many records are diagnosed.
DIAGNOSED = 5


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
    law = random.choice(LAWS)
    drift = np.zeros(count)
    if law == "random_walk":
        drift = np.cumsum(random.normal(size=count)) * density * np.exp(random.uniform(-6.0, -3.5)) * np.sqrt(step)
    elif law == "gauss_markov":
        sigma, tau = density * np.exp(random.uniform(-2.5, -0.5)), np.exp(random.uniform(np.log(30.0), np.log(600.0)))
        phi = np.exp(-step / tau)
        kick = sigma * np.sqrt(1.0 - phi**2) * random.normal(size=count)
        kick[0] = sigma * random.normal()
        drift = lfilter([1.0], [1.0, -phi], kick)
    elif law == "flicker":  # 1/f by walks that forget, a decade apart
        for tau in (10.0, 100.0, 1000.0):
            phi = np.exp(-step / tau)
            kick = density * np.exp(random.uniform(-3.0, -1.0)) * np.sqrt(1.0 - phi**2) * random.normal(size=count)
            drift += lfilter([1.0], [1.0, -phi], kick)
    values = offset + drift + white
    if form in ("lattice", "means"):
        q = 0.25 * density / np.sqrt(step)
        values = q * np.rint(values / q)
    means: NDArray[np.float64] = values.reshape(n, fine).mean(axis=1)
    return means


def write(path: Path, seed: int, rate: float, form: str) -> None:
    """One record of six clean axes."""
    random = np.random.default_rng([seed, round(rate * 1000)])
    n = round(SECONDS.get(rate, 1200.0) * rate)
    columns = {f"{name}[{UNITS[name[0]]}]": axis(random, name, n, 1.0 / rate, form) for name in AXES}
    t = np.arange(n) / rate
    if path.suffix == ".npz":
        np.savez(path, allow_pickle=False, **{"t[s]": t, **columns})
        return
    heading = ",".join(["t[s]", *columns])
    np.savetxt(path, np.column_stack([t, *columns.values()]), "%.8g", ",", header=heading, comments="")


Wrong = dict[str, list[str]]


def _of_log(look: Callable[[Path], Wrong], seed: int, rate: float) -> Wrong:
    """What a look at a clean log says of each axis of which it says something; an error is of all axes."""
    form = FORMS[seed % len(FORMS)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("clean.csv" if form in ("digits", "means") else "clean.npz")
        write(path, seed, rate, form)
        try:
            return look(path)
        except Exception as error:  # whatever it raises on a clean record is a fault
            return {name: [f"{type(error).__name__}: {error}"] for name in AXES}


def with_larger_shares(table: str) -> None:
    """Multiply the shares of a table by TIMES, before the modules that take their limits from it are imported."""
    from selfcal.readings import budget

    setattr(budget, table, {test: min(0.5, TIMES * share) for test, share in getattr(budget, table).items()})
    budget.P_LOOK *= TIMES if table == "OF_MODULES" else 1.0


def of_tests(seed: int, rate: float) -> Wrong:
    """The tests of the readings that name each axis."""

    def look_at(path: Path) -> Wrong:
        from selfcal.logs.recording import load
        from selfcal.model.file import Model
        from selfcal.readings.faults import FAULTS
        from selfcal.readings.readings import look

        recording, model = load(path), Model.load(None)
        named = {}
        for name in AXES:
            readings = look(recording, name, model.group_of(name))
            named[name] = [fault.name for fault in FAULTS if fault.statistic(readings) > 0.0]
        return {name: tests for name, tests in named.items() if tests}

    return _of_log(look_at, seed, rate)


def of_identify(seed: int, rate: float) -> Wrong:
    """The checks of `identify` that fail on each axis."""

    def look_at(path: Path) -> Wrong:
        from selfcal.verbs.identify import identify

        axes = identify(path)["axes"]
        return {
            name: [entry["error"]] if "error" in entry else [k for k, c in entry["checks"].items() if not c["passed"]]
            for name, entry in axes.items()
            if not entry.get("adequate")
        }

    return _of_log(look_at, seed, rate)


def of_diagnose(seed: int, rate: float) -> Wrong:
    """The causes that `diagnose` finds on each axis."""

    def look_at(path: Path) -> Wrong:
        from selfcal.verbs.diagnose import diagnose

        document = diagnose(path)
        named: Wrong = {name: [entry["error"]] for name, entry in document["axes"].items() if "error" in entry}
        for finding in document["findings"]:
            for name in finding["axes"]:
                named.setdefault(name, []).append(f"{finding['cause']} ({finding['net_nats']:.1f} nats)")
        return named

    return _of_log(look_at, seed, rate)


def each(
    look: Callable[[int, float], Wrong], work: list[tuple[int, float]], workers: int, larger: str = ""
) -> Iterator[tuple[int, float, Wrong]]:
    """What a look says of every record, in processes of its own, printed as it comes. `larger`: a table of shares."""
    first = partial(with_larger_shares, larger) if larger else None
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=first) as pool:
        for (seed, rate), wrong in zip(work, pool.map(look, *zip(*work, strict=True)), strict=True):
            for name, why in wrong.items():
                form = FORMS[seed % len(FORMS)]
                print(f"  {look.__name__} {rate:g} Hz, seed {seed}, {form}, {name}: {', '.join(why)}", flush=True)
            yield seed, rate, wrong


def held(what: str, count: int, of: int, share: float) -> bool:
    """Whether a count keeps to its share; prints both."""
    most = int(binom.ppf(0.999, of, share))
    print(
        f"{what}: {count} of {of}, {share:.2g} is due, {most} at most{'' if count <= most else ': TOO MANY'}",
        flush=True,
    )
    return count <= most


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=112)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rate", type=float, action="append")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.records)
    work = [(seed, rate) for seed in seeds for rate in options.rate or SECONDS]
    axes, start, right = len(work) * len(AXES), time.perf_counter(), True
    from selfcal.readings.budget import P_LOOK, SHARES

    named: Counter[str] = Counter()
    for _, _, wrong in each(of_tests, work, options.workers, "SHARES"):
        named.update(test for tests in wrong.values() for test in tests)
    right &= not named.keys() - SHARES.keys()
    for test, share in SHARES.items():
        right &= held(f"{test}, {TIMES:g} times its share", named[test], axes, min(0.5, TIMES * share))
    count = sum(len(wrong) for *_, wrong in each(of_tests, work, options.workers))
    right &= held("readings called wrong, of axes", count, axes, OF_READINGS)
    failed: Counter[str] = Counter()
    for *_, wrong in each(of_identify, work, options.workers, "OF_MODULES"):
        for checks in wrong.values():
            failed.update({"allan" if check.startswith("allan") else check for check in checks})
    for check in sorted(OF_IDENTIFY | failed.keys() - SHARES.keys()):
        share = TIMES * P_LOOK if check in OF_IDENTIFY else 0.0
        right &= held(f"{check}, {TIMES:g} times its share", failed[check], axes, share)
    count = sum(bool(wrong) for *_, wrong in each(of_identify, work, options.workers))
    right &= held("identify, modules that are not adequate", count, len(work), MOST)
    part = work[::DIAGNOSED]
    for times, larger in ((TIMES, "OF_MODULES"), (1.0, "")):
        count = sum(bool(wrong) for *_, wrong in each(of_diagnose, part, options.workers, larger))
        right &= held(f"diagnose, modules with a finding, {times:g} times its share", count, len(part), times * MOST)
    print(f"{time.perf_counter() - start:.0f} s")
    return int(not right)


if __name__ == "__main__":
    sys.exit(main())
