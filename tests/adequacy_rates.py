"""How often the module's adequacy (lib/adequacy.c) flags records, and what changes (lib/changes.c) it finds in them:
clean ones and ones with an effect.

    python tests/adequacy_rates.py --records 50 --hours 10 --seed 1 [--effect NAME --size S] [--handle] [--out FILE]
    python tests/adequacy_rates.py --records 60 --hours 2 --effect temperature --size 1.25 --shape warm_600 [--law LAW]

Each record has six axes at 1 Hz, each with a law drawn from those of the default model and parameters from its priors.
An effect is on gx alone, whose drift is small. Clean ones have a temperature that warms up and wanders, a supply that
steps, and gaps: none of them moves the bias. With `--shape` the temperature changes by 12 degC in a known way, and gx
is alone, of the law `--law`. The library in float runs as on a module, with a report before each epoch.
`--handle`: the model handles steps and changes of the variance. Prints the flags by suspicion, and the changes.
`--out` takes every judgement.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from selfcal.adequacy.drawn import draw_parameters, simulate_bank_samples
from selfcal.bank.library import Bank
from selfcal.model.file import Handling, Model
from selfcal.model.tables import Tables, make_tables
from selfcal.wire.frames import choices

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
LAWS = ("constant", "random_walk", "gauss_markov")
SUSPECTS = choices("GX_ADEQUACY", "suspicion")
#: Temperatures of `--shape`, degC, at t [n] in s: two warm-ups with their time constants, an hour's cycle, a rise.
SHAPES: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "warm_600": lambda t: 12.0 * -np.expm1(-t / 600.0),
    "warm_1800": lambda t: 12.0 * -np.expm1(-t / 1800.0),
    "cycle": lambda t: 6.0 * np.sin(2.0 * np.pi * t / 3600.0),
    "rise": lambda t: 12.0 * t / t.size,
}
#: Of the axis with an effect: drifts that hide little.
QUIET = {
    "constant": {"N": 0.04, "bias": 0.1},
    "random_walk": {"N": 0.04, "K": 2e-4, "bias": 0.1},
    "gauss_markov": {"N": 0.04, "sigma_m": 0.01, "alpha": 2e-3, "bias": 0.1},
}


def channels_of(rng: np.random.Generator, n: int, shape: str = "") -> NDArray[np.float64]:
    """[n, 2]: temperature in degC, drawn or of one of SHAPES, and supply in V."""
    t = np.arange(float(n))
    warm = 25.0 + rng.uniform(0, 15) * (1.0 - np.exp(-t / rng.uniform(300, 3000)))
    day = rng.uniform(0, 5) * np.sin(2 * np.pi * (t / rng.uniform(5000, 90000) + rng.uniform()))
    true = 25.0 + SHAPES[shape](t) if shape else warm + day
    temp = np.round((true + 0.02 * rng.standard_normal(n)) / 0.005) * 0.005
    supply = 5.0 + 0.002 * rng.standard_normal(n) + 0.1 * (t > rng.uniform(0, n))
    return np.column_stack([temp, supply])


def with_effect(
    y: NDArray[np.float64],
    name: str,
    size: float,
    sigma: float,
    channels: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """One axis with an effect of `size` times the white noise of a bank sample, from the middle on where it begins."""
    n, t = y.size, np.arange(y.size)
    late = t >= n // 2
    if name == "temperature":
        return y + size * sigma * (channels[:, 0] - 25.0)
    if name == "supply":
        return y + size * sigma * (channels[:, 1] - 5.0) / 0.1
    if name == "ramp":
        return y + size * sigma * t / 3600.0
    if name == "step":
        return y + size * sigma * late
    if name == "periodic":
        return y + size * sigma * np.sin(2 * np.pi * t / 37.0)
    if name == "variance_change":
        extra = math.sqrt(max(size, 1.0 / size) ** 2 - 1.0) * sigma * rng.standard_normal(n)  # quieter: louder before
        return y + np.where(late == (size > 1.0), extra, 0.0)
    if name == "outliers":
        return y + size * sigma * (rng.uniform(size=n) < 0.002) * rng.choice([-1.0, 1.0], n)
    if name == "flicker":
        parts = [(1.0 / 20.0, 1.0), (1.0 / 200.0, 1.0), (1.0 / 2000.0, 1.0)]
        for rate, deviation in parts:
            z, drift = rng.standard_normal(n), np.zeros(n)
            phi = math.exp(-rate)
            for i in range(1, n):
                drift[i] = phi * drift[i - 1] + deviation * math.sqrt(1.0 - phi * phi) * z[i]
            y = y + size * sigma * drift
        return y
    if name == "cross_axis":
        return y
    if name == "colored_noise":
        noise = sigma * rng.standard_normal(n)
        memory = np.zeros(n)
        for i in range(1, n):
            memory[i] = 0.5 * memory[i - 1] + noise[i]
        return y + size * memory
    raise SystemExit(f"there is no effect {name}")


def record(
    tables: Tables, model: Model, hours: float, seed: int, effect: str, size: float, shape: str = "", own: str = ""
) -> tuple[list[tuple[int, ...]], list[tuple[int, ...]]]:
    """Judgements and changes of one record; an effect is on gx alone, whose drift has the law `own`."""
    rng = np.random.default_rng(seed)
    n = round(hours * 3600)
    channels = channels_of(rng, n, shape)
    columns = []
    for axis in (table.name for table in tables.axes):
        law = LAWS[rng.integers(3)]
        truth = draw_parameters(model.group_of(axis), law, rng)
        if effect and axis == "gx":
            law, truth = own, QUIET[own]
        y = simulate_bank_samples(law, truth, 1.0, n, int(rng.integers(2**31)))[0]
        if effect and axis == "gx":
            y = with_effect(y, effect, size, truth["N"], channels, rng)
        columns.append(y)
    if effect == "cross_axis":
        columns[0] = columns[0] + size * np.std(np.diff(columns[0])) / np.std(np.diff(columns[1])) * columns[1]
    missing = np.where(rng.uniform(size=n) < 1e-3, rng.integers(1, 30, n), 0).astype(np.uint64)
    told, found = Bank(tables).raw.watch(
        np.column_stack(columns).astype(np.float32), missing, channels.astype(np.float32)
    )
    return list(told), list(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=20)
    parser.add_argument("--hours", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--effect", default="")
    parser.add_argument("--size", type=float, default=1.0)
    parser.add_argument("--shape", default="", choices=["", *SHAPES])
    parser.add_argument("--law", default="random_walk", choices=list(QUIET))
    parser.add_argument("--handle", action="store_true")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    model = replace(Model.load(None), handling=Handling(steps=given.handle, variance_changes=given.handle))
    tables = make_tables(model, 1.0, AXES[:1] if given.shape else AXES)
    flags: Counter[str] = Counter()
    changes: Counter[str] = Counter()
    delays: list[float] = []
    judged = 0
    rows = []
    first: list[float] = []
    for k in range(given.records):
        told, found = record(
            tables, model, given.hours, given.seed + k, given.effect, given.size, given.shape, given.law
        )
        for axis, at, cause, size, _ in found:
            late = at - round(given.hours * 1800)
            where = "" if not given.effect else "right" if axis == 0 and 0 <= late < 600 else "other"
            changes[f"{SUSPECTS[cause]} {where}".strip()] += 1
            delays += [late] if where == "right" else []
            print(f"  record {k}, {AXES[axis]}, {at} s: {SUSPECTS[cause]} {size:.3g}", flush=True)
        for axis, at, state, suspect, score, samples in told:
            if state:
                judged += 1
                rows.append((k, axis, at, state, suspect, score, samples))
                if state == 2 and not (given.effect and axis != 0):
                    flags[SUSPECTS[suspect]] += 1
        if given.effect:
            hit = [at for axis, at, state, suspect, *_ in told if axis == 0 and state == 2]
            first.append(hit[0] / 3600 if hit else math.nan)
    hours = given.records * given.hours
    print(
        f"{hours:g} h of {given.effect or 'clean'} records, {judged} judgements: {sum(flags.values())} flags",
        dict(flags),
    )
    if given.handle:
        print(f"changes: {dict(changes)}", f"delay {np.median(delays):.0f} s in the median" if delays else "")
    if given.effect:
        hours_to = np.array(first)
        after = f", after {np.nanmedian(hours_to):.2f} h in the median" if np.isfinite(hours_to).any() else ""
        print(f"flagged {np.isfinite(hours_to).mean():.0%} of records{after}")
    if given.out:
        given.out.write_text(json.dumps(rows))


if __name__ == "__main__":
    main()
