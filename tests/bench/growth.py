"""Growth of the host's work: exponents in the record's length, in the number of axes and in the filter's states.

    .venv/bin/python tests/bench/growth.py [--longest SAMPLES]

CPU seconds of one process each; the exponent is the slope of their logarithms. Records: white noise and a walk, at
10 Hz, drawn by numpy.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from selfcal.likelihood.fit import Series, run
from selfcal.likelihood.statemodel import Terms
from selfcal.logs.recording import save
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
RATE_HZ = 10.0
LENGTHS = (10_000, 100_000, 1_000_000, 10_000_000)
#: `diagnose` to this length only; longer ones take minutes.
DIAGNOSED = (10_000, 30_000, 100_000)
#: Narrow bands beside a walk: two states each.
BANDS = (0, 1, 3, 5, 8)


def record(axes: int, n: int, folder: Path) -> Path:
    """A recording of `n` samples."""
    random = np.random.default_rng([n, axes])
    columns = {}
    for axis in AXES[:axes]:
        white, walk = random.standard_normal(n), random.standard_normal(n)
        y = 0.04 * np.sqrt(RATE_HZ) * white + np.cumsum(3e-4 / np.sqrt(RATE_HZ) * walk)
        columns[axis] = ("deg/s", y) if axis[0] == "g" else ("m/s^2", 0.1 * y)
    path = folder / f"{axes}_{n}.npz"
    save(path, columns, RATE_HZ)
    return path


def cpu(work: Callable[[], object]) -> float:
    """CPU seconds of `work`."""
    begin = time.process_time()
    work()
    return time.process_time() - begin


def table(title: str, places: Sequence[float], seconds: Sequence[float]) -> None:
    """Prints the figures, and the exponent between each and the one before."""
    print(f"\n{title}")
    for k, (place, value) in enumerate(zip(places, seconds, strict=True)):
        exponent = ""
        if k:
            exponent = f"{np.log(value / seconds[k - 1]) / np.log(place / places[k - 1]):6.2f}"
        print(f"  {place:>10,.0f}  {value:12.6f} s {exponent}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--longest", type=int, default=LENGTHS[-1], help="samples")
    longest = parser.parse_args().longest
    with tempfile.TemporaryDirectory() as made, contextlib.redirect_stderr(io.StringIO()):  # progress is no figure
        folder = Path(made)
        identify(record(1, 10_000, folder))  # imports are not counted
        lengths = [n for n in LENGTHS if n <= longest]
        paths = [record(1, n, folder) for n in lengths]
        table("identify, samples of one axis", lengths, [cpu(lambda p=p: identify(p)) for p in paths])
        counts = range(1, 7)
        paths = [record(axes, 1_000_000, folder) for axes in counts]
        table("identify, axes of 10^6 samples", counts, [cpu(lambda p=p: identify(p)) for p in paths])
        paths = [record(1, n, folder) for n in DIAGNOSED if n <= longest]
        spent = [cpu(lambda p=p: diagnose(p, full_rate=True)) for p in paths]
        table("diagnose --full-rate, samples of one axis", DIAGNOSED[: len(paths)], spent)
        paths = [record(axes, 30_000, folder) for axes in (1, 2, 4, 6)]
        spent = [cpu(lambda p=p: diagnose(p, full_rate=True)) for p in paths]
        table("diagnose --full-rate, axes of 30 000 samples", (1, 2, 4, 6), spent)
    n = 1_000_000
    y = np.random.default_rng(1).standard_normal(n)
    series = Series(y, 1.0 / RATE_HZ, np.ones(n), np.ones((1, n)))
    spent, states = [], []
    for bands in BANDS:
        terms = Terms(walk=True, bands=tuple((0.5 + 0.3 * k, 0.01, -2.0) for k in range(bands)))
        run(series, terms, np.array([-5.0]))
        spent.append(cpu(lambda terms=terms: run(series, terms, np.array([-5.0]))))
        states.append(1 + 2 * bands)
    table("a pass of 10^6 samples, states", states, spent)


if __name__ == "__main__":
    main()
