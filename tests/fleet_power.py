"""How often `selfcal fleet` names odd units of a batch, and sound ones.

    python tests/fleet_power.py --batches 200 --seed 1 [--size 12]

Batches of 12, 24 and 100 units, 15 min to 2 h, of a random walk or a Gauss-Markov drift, with 0 to 6 odd units: N x
1.5, K x 2.5, sigma_m x 2.5, the bias 6 spreads off, another law (20 nats), a step, no temperature coefficient. Middles
and spreads are drawn for each batch. The records are simulated and identified at 1 Hz by the library. The coefficient
of the temperature is drawn with its error: its posterior is exactly normal. Nothing looks at the readings, so a step
shows by the drift alone.

An oracle knows the population and tests at the same level. The table counts the odd units that it names in 99 % of
draws. `odd known`: named where the population is fitted to the units that are sound in the quantity, so that nothing
but its own uncertainty hides a unit. `names`: by `fleet`, the smaller of two groups among them. `false`: batches with a
sound unit named.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from selfcal.bank.library import Bank
from selfcal.base import units
from selfcal.batch.batch_files import BatchSource
from selfcal.batch.batch_summary import OTHER_LAW, Batch, summed_up
from selfcal.batch.population import FALSE_NAME, fit_population
from selfcal.batch.unit_table import BatchUnit
from selfcal.model.file import DEFAULT, Model, read_yaml
from selfcal.model.tables import make_tables
from selfcal.studies.montecarlo import simulate_bank_samples

Counts = NDArray[np.int64]
SIZES = (12, 24, 100)
SECONDS = (900, 1800, 3600, 7200)
KINDS = {
    "random_walk": ("N", "K", "bias", "law", "step", "temperature"),
    "gauss_markov": ("N", "sigma_m", "bias", "step", "temperature"),
}
#: Natural logarithm of the factor of an odd unit, spreads of its bias, nats of another law, deg/s of a step.
FACTOR = {"N": math.log(1.5), "K": math.log(2.5), "sigma_m": math.log(2.5), "group": math.log(1.6)}
SPREADS, NATS, STEP = 6.0, 20.0, 0.2
#: Standard deviations beyond its limit from which on the oracle names a unit in 99 % of draws.
SURE = float(ndtri(0.99))


@dataclass
class Drawn:
    """A batch: its units, the odd ones' kinds, and the population: middle and spread of each quantity."""

    law: str
    seconds: int
    units: list[BatchUnit] = field(default_factory=list)
    odd: dict[int, str] = field(default_factory=dict)
    truth: dict[str, tuple[float, float]] = field(default_factory=dict)


def model_of() -> Model:
    """The default model with a coefficient of the temperature."""
    tree = read_yaml(DEFAULT, "model file")
    column = {"name": "temperature", "kind": "column", "column": "temp", "unit": "degC", "reference": 25}
    tree["regressors"] = [{**column, "sd": {"gyro": 0.1}}]
    return Model.of_tree(tree, Path(DEFAULT))


TABLES = make_tables(Model.load(), 1.0, ("gx",))


def axis_of(y: NDArray[np.float64], coefficient: tuple[float, float]) -> dict[str, Any]:
    """The results of an axis as `fleet` keeps them; `y` [n] at 1 Hz in deg/s, `coefficient`: mean and error."""
    bank = Bank(TABLES)
    bank.push(y[:, None])
    found = bank.report(0)
    parameters = {
        law: {name: {**vars(e), "unit": units.parameter_unit(name, "deg/s")} for name, e in of.items()}
        for law, of in found.parameters.items()
    }
    mean, sd = coefficient
    normal = {"mean": mean, "sd": sd, "median": mean, "unit": "deg/s/degC"}
    return {
        "hypotheses": dict(found.probability),
        "log_evidence": dict(found.log_evidence),
        "parameters": parameters,
        "regressors": {"temperature": {"coefficients": {"temperature": normal}}},
        "bias_now": {"mean": found.bias_mean, "sd": found.bias_sd, "unit": "deg/s"},
        "adequate": True,
        "marks": [],
    }


def unit_of(random: np.random.Generator, batch: Drawn, k: int, kind: str) -> BatchUnit:
    """The k-th unit, with its fault."""
    own = {name: middle + spread * random.standard_normal() for name, (middle, spread) in batch.truth.items()}
    if kind in FACTOR:
        own["N" if kind == "group" else kind] += FACTOR[kind]
    if kind == "bias":
        own[kind] += SPREADS * batch.truth["bias"][1] * random.choice((-1.0, 1.0))
    if kind == "temperature":
        own[kind] = 0.0
    at = {name: own[name] if name == "bias" else math.exp(own[name]) for name in own if name != "temperature"}
    error = 0.05 * batch.truth["temperature"][0]
    coefficient = own["temperature"] + error * random.standard_normal(), error
    law, size = batch.law, 0.02
    while True:
        if kind == "law":  # a drift that comes back within 20 s, as strong as it must be
            law, at = "gauss_markov", {"N": at["N"], "bias": at["bias"], "sigma_m": size, "alpha": 0.05}
        y, _ = simulate_bank_samples(law, at, 1.0, batch.seconds, int(random.integers(2**31)))
        if kind == "step":
            y[int(batch.seconds * random.uniform(0.2, 0.8)) :] += STEP * random.choice((-1.0, 1.0))
        axis = axis_of(y, coefficient)
        if kind != "law" or behind(axis, batch.law) >= NATS:
            return BatchUnit(BatchSource(f"u{k}", device=f"u{k}"), {"recording": {}, "axes": {"gx": axis}})
        size *= 1.1


def behind(axis: dict[str, Any], law: str) -> float:
    """How many nats a law is behind the best one."""
    return float(max(axis["log_evidence"].values()) - axis["log_evidence"][law])


def drawn(random: np.random.Generator, size: int, *, two_groups: bool = False) -> Drawn:
    """A batch; with `two_groups` a third to a half of its units has N times 1.6, and no other is odd."""
    law = str(random.choice(list(KINDS)))
    batch = Drawn(law, int(random.choice(SECONDS)))
    batch.truth = {
        "N": (math.log(0.03), random.uniform(0.03, 0.08)),
        "bias": (0.1 * random.standard_normal(), random.uniform(0.05, 0.5)),
        "temperature": (0.01, 0.01 * random.uniform(0.05, 0.15)),
    }
    if law == "random_walk":
        batch.truth["K"] = math.log(random.uniform(6e-4, 2e-3)), random.uniform(0.08, 0.2)
    else:
        batch.truth["sigma_m"] = math.log(random.uniform(0.02, 0.04)), random.uniform(0.05, 0.15)
        batch.truth["alpha"] = math.log(0.02), random.uniform(0.05, 0.15)
    places = random.permutation(size)[: random.integers(7)]
    batch.odd = {int(k): str(random.choice(KINDS[law])) for k in places}
    if two_groups:
        share = random.uniform(1.0 / 3.0, 0.5)
        batch.odd = {int(k): "group" for k in random.permutation(size)[: round(share * size)]}
    batch.units = [unit_of(random, batch, k, batch.odd.get(k, "")) for k in range(size)]
    return batch


def judged(batch: Drawn, found: Batch) -> tuple[dict[int, bool], dict[int, bool]]:
    """Whether an oracle names each odd unit in 99 % of draws, and whether the population of the sound units does."""
    measured = {one.measured.name[3:]: one.measured for one in found.populations}
    limit = FALSE_NAME / sum(one.y.size for one in measured.values())
    least = -float(ndtri(limit / 2.0))
    oracle, known = dict.fromkeys(batch.odd, False), dict.fromkeys(batch.odd, False)
    for name, one in measured.items():
        if name not in batch.truth:
            continue
        middle, spread = batch.truth[name]
        drift = ("law", "step") if name in ("K", "sigma_m", "alpha") else ("step",) if name == "bias" else ()
        clean = np.array([batch.odd.get(place) not in (name, *drift) for place in one.at.tolist()])
        others = fit_population(one.y[clean], one.s[clean])
        for place, y, s in zip(one.at.tolist(), one.y, one.s, strict=True):
            kind = batch.odd.get(place)
            if kind != name and not (kind == "step" and name in ("K", "sigma_m")):
                continue
            shift = {**FACTOR, "bias": SPREADS * spread, "temperature": middle, "step": abs(y - middle)}[kind]
            oracle[place] |= bool(shift / math.hypot(spread, s) >= least + SURE)
            known[place] |= bool(others.log_p(np.array([y]), np.array([s]))[0] <= math.log(limit))
    for place in batch.odd:
        other = behind(batch.units[place].axes["gx"], batch.law) > OTHER_LAW + math.log(len(batch.units))
        oracle[place] |= other and batch.odd[place] == "law"
        known[place] |= other
    return oracle, known


def study(model: Model, size: int, batches: int, seed: int, *, verbose: bool = False) -> tuple[dict[str, Counts], int]:
    """Counts of the odd units by kind: all, those named, the oracle's, of these `odd known` and `names`. And how many
    batches have a false name. `verbose`: prints a line for each false or missed name."""
    random = np.random.default_rng([seed, size])
    counts: dict[str, Counts] = defaultdict(lambda: np.zeros(5, np.int64))
    false = 0
    for number in range(batches):
        batch = drawn(random, size)
        found = summed_up(batch.units, model)
        oracle, known = judged(batch, found)
        names: dict[int, Any] = {int(name[1:]): words for name, words in found.unlike.items()}
        names |= {k: one.quantity for of in found.populations for one in of.apart for k in one.members}
        for k, kind in batch.odd.items():
            counts[kind] += [1, k in names, oracle[k], oracle[k] and known[k], oracle[k] and k in names]
            if verbose and oracle[k] and k not in names:
                print("missed", number, batch.law, batch.seconds, k, kind, sorted(batch.odd.values()), known[k])
        wrong = {k: words for k, words in names.items() if k not in batch.odd}
        false += bool(wrong)
        if verbose and wrong:
            print("false", number, batch.law, batch.seconds, wrong)
    return counts, false


def groups_named(model: Model, size: int, batches: int, seed: int) -> tuple[int, int]:
    """Batches of two groups that are said to be, each member right or listed as odd by itself; and those where at least
    one unit of the smaller group is named."""
    random = np.random.default_rng([seed, size, 2])
    whole = some = 0
    for _ in range(batches):
        batch = drawn(random, size, two_groups=True)
        found = summed_up(batch.units, model)
        (split,) = [one.members for of in found.populations for one in of.apart if one.quantity == "gx.N"] or [()]
        named = {int(name[1:]) for name in found.unlike} | set(split)
        others = set(range(size)) - set(batch.odd)
        whole += named in (set(batch.odd), others)
        some += bool(named)
    return whole, some


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batches", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", type=int, choices=SIZES)
    parser.add_argument("--verbose", action="store_true", help="a line for each false or missed name")
    options = parser.parse_args()
    for size in SIZES if options.size is None else (options.size,):
        counts, false = study(model_of(), size, options.batches, options.seed, verbose=options.verbose)
        print(f"{size} units: false in {false} of {options.batches} batches")
        print("kind         odd named oracle odd-known names")
        for kind, (odd, named, sure, ideal, hit) in [*counts.items(), ("all", np.sum(list(counts.values()), axis=0))]:
            share = f"{100.0 * hit / sure:.1f} %" if sure else ""
            print(f"{kind:12} {odd:3} {named:5} {sure:6} {ideal:9} {hit:5}  {share}", flush=True)
        whole, some = groups_named(model_of(), size, few := max(1, options.batches // 4), options.seed)
        print(f"two groups: of {few} batches {whole} with each member, {some} with a name")


if __name__ == "__main__":
    main()
