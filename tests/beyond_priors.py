"""Parts beyond the priors' ends: N and K of ten parts from 1e-7 to 1 deg/s/sqrt(Hz), K/N from 1e-4 to 0.1 per s.

Each record is white noise beside a random walk, drawn here by numpy, 20 crossings (sqrt(3) N / K) long and 8 days at
most. A record of more than MOST readings is drawn as the means that it would have at a lower rate.

A line a part: records whose 90 % interval has N; of those with an identified K, its interval; of the others, the upper
limit; the median probability of the walk and the least one; records with priors of their own. The last line pools.

    .venv/bin/python tests/beyond_priors.py --records 20
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from selfcal.verbs.identify import identify

#: N of the parts, deg/s/sqrt(Hz), and the order of their K/N: neither grows with the other.
N_OF = np.geomspace(1e-7, 1.0, 10)
RATIO_OF = np.geomspace(1e-4, 0.1, 10)[[4, 0, 7, 2, 9, 5, 1, 8, 3, 6]]
CROSSINGS, LONGEST_S, MOST = 20.0, 8 * 86400.0, 20_000


def drawn(random: np.random.Generator, N: float, K: float, n: int, dt_s: float) -> NDArray[np.float64]:
    """[n]: means over `dt_s` of white noise and a random walk. The walk's mean is that of its ends, beside a part of
    variance K^2 dt / 12 that does not correlate with them."""
    step = K * math.sqrt(dt_s) * random.standard_normal(n)
    ends = np.cumsum(step)
    within = K * math.sqrt(dt_s / 12.0) * random.standard_normal(n)
    return np.asarray(ends - 0.5 * step + within + N / math.sqrt(dt_s) * random.standard_normal(n))


def log_of(path: Path, N: float, K: float, seed: tuple[int, ...], crossings: float = CROSSINGS) -> Path:
    """The log of one record."""
    duration_s = min(crossings * math.sqrt(3.0) * N / K, LONGEST_S)
    n = min(round(duration_s), MOST)
    dt_s = duration_s / n
    random = np.random.default_rng(seed)
    columns = {"t[s]": np.arange(n) * dt_s, "gx[deg/s]": 10.0 * N + drawn(random, N, K, n, dt_s)}
    np.savez(path, **columns)  # type: ignore[arg-type]
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=20)
    parser.add_argument("--crossings", type=float, default=CROSSINGS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", type=int, action="append", choices=range(N_OF.size))
    given = parser.parse_args()
    print(f"{given.records} records a part, {given.crossings:g} crossings")
    print("N         K/N      N held   K known, held   K open, limit holds   P(walk) median, least   own priors  < 0")
    pooled = np.zeros(6, int)
    with tempfile.TemporaryDirectory() as folder:
        for part in given.part or range(N_OF.size):
            N, K = float(N_OF[part]), float(N_OF[part] * RATIO_OF[part])
            count = np.zeros(6, int)  # N held, K known, held, open, limit holds, own priors
            walks, zero = [], 0
            for k in range(given.records):
                axis = identify(
                    log_of(Path(folder) / "log.npz", N, K, (given.seed, part, k), given.crossings), suspicion=False
                ).axes["gx"]
                if axis.error:
                    print(f"  {axis.error}", file=sys.stderr)
                    walks.append(0.0)
                    continue
                arw, rrw = axis["summary"]["arw"], axis["summary"]["rrw"]
                known = rrw["identified"]
                inside = rrw["q05"] <= K <= rrw["q95"] if known else rrw["q95"] >= K
                count += [
                    arw["q05"] <= N <= arw["q95"], known, known and inside, not known, not known and inside,
                    axis["priors"] != "model",
                ]  # fmt: skip
                walks.append(axis.hypotheses["random_walk"])
                zero += float(f"{rrw['q95']:.3g}") <= 0.0
            held, known, right, is_open, bound, own = count.tolist()
            pooled += count
            print(
                f"{N:.2g}".ljust(10) + f"{K / N:.2g}".ljust(9) + f"{held:3d}      {right:3d} of {known:3d}      "
                f"{bound:3d} of {is_open:3d}            {np.median(walks):.3f}, {min(walks):.4f}           {own:3d}"
                f"         {zero:d}",
                flush=True,
            )
    held, known, right, is_open, bound, own = pooled.tolist()
    print(f"all                {held:3d}      {right:3d} of {known:3d}      {bound:3d} of {is_open:3d}      own {own}")


if __name__ == "__main__":
    main()
