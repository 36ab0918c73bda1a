"""White noise beside the quantization noise of a counter: does the interval of the white noise have N?

A counter of an angle is read every 1 / rate s, and the readings are its increments: each lies on a lattice of an
increment q over that interval. Q = q / sqrt(12) beside N = 0.02 deg/s/sqrt(Hz) and K = 2e-4 deg/s^2/sqrt(Hz), an hour.
`--rounded`: the same readings, each rounded by itself. These have no such noise: N includes the rounding's white noise.

A line a Q / N: records whose 90 % interval of ARW has N, its median over N, records that identify Q and those of whose
interval has it, records that are adequate, and the failed checks of the readings by name.

    .venv/bin/python tests/counted_noise.py --records 40
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from selfcal.verbs.identify import identify

N, K, SECONDS = 0.02, 2e-4, 3600
#: Q over N, sqrt(s).
SIZES = (0.03, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0)


def drawn(random: np.random.Generator, rate: float, Q: float, *, rounded: bool) -> NDArray[np.float64]:
    """[rate * SECONDS]: readings in deg/s."""
    n, step = round(rate * SECONDS), math.sqrt(12.0) * Q * rate
    walk = K / math.sqrt(rate) * random.standard_normal(n + 1).cumsum()
    values = random.uniform(-0.5, 0.5) + walk + N * math.sqrt(rate) * random.standard_normal(n + 1)
    if rounded:
        return np.asarray(np.rint(values[1:] / step) * step)
    return np.asarray(np.diff(np.floor(values.cumsum() / step + random.random())) * step)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=40)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rounded", action="store_true")
    parser.add_argument("--size", type=float, action="append")
    given = parser.parse_args()
    print(f"{given.records} records, {given.rate:g} Hz, {'rounded' if given.rounded else 'counted'}")
    print("Q/N    N held, median  of law  Q known, held  adequate  checks that failed")
    for size in given.size or SIZES:
        held = told = right = adequate = of_law = 0
        truth = N * math.sqrt(1.0 + given.rounded * size**2 * given.rate)
        ratio, why = [], Counter[str]()
        with tempfile.TemporaryDirectory() as folder:
            for k in range(given.records):
                random = np.random.default_rng([given.seed, round(1000 * size), k])
                y = drawn(random, given.rate, size * N, rounded=given.rounded)
                log = Path(folder) / "log.npz"
                np.savez(log, **{"t[s]": np.arange(y.size) / given.rate, "gx[deg/s]": y})
                axis = identify(log).axes["gx"]
                arw, Q = axis["summary"]["arw"], axis["summary"].get("quantization_noise")
                held += arw["q05"] <= truth <= arw["q95"]
                ratio.append(arw["median"] / truth)
                own = axis.parameters[axis.law]["N"]
                of_law += own.q05 <= truth <= own.q95
                known = Q is not None and Q["identified"]
                told += known
                right += known and Q["q05"] <= size * N <= Q["q95"]
                adequate += bool(axis.adequate)
                why.update({name.split("_")[0] for name, one in axis.checks.items() if not one["passed"]})
        checks = ", ".join(f"{name} {count}" for name, count in why.most_common())
        print(
            f"{size:<6g} {held:3d}     {np.median(ratio):.3f}   {of_law:3d}     {told:3d}, {right:3d}      "
            f"{adequate:3d}      {checks}",
            flush=True,
        )


if __name__ == "__main__":
    main()
