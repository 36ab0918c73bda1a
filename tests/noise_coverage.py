"""Shares of truths in the 90 % intervals, on noise that no part of the library draws.

    python tests/noise_coverage.py flicker --hours 1 --records 400 --seed 7
    python tests/noise_coverage.py counted --hours 1 --records 100 --seed 7

constant, walk, markov: the paper's laws at readings of 4 Hz, each judged by its own law of the default model. N 0.04; K
from 1e-4 to 1e-3; sigma_m from 0.005 to 0.05 with correlation times from 30 to 600 s.

known: a ramp, a line of 300 s and a turn-on of 250 s beside a walk of K 3e-4, three regressors of `identify`. Each
coefficient has half to one and a half times the sd of its prior.

flicker: two-sided density B^2 / (2 pi f) at readings of 10 Hz, by Fourier synthesis over 16 times the record, beside
white noise of N 0.04. B from 0.005 to 0.05. The law is `flicker` of sums.yaml alone, at its nodes of the host.

sheet: the same noise by the default model, the numbers of the data sheet. `walk` and `markov` have them too: their bias
instability is the first minimum of the true Allan deviation over 0.664, where it is within half the record.

counted: differences of white remainders of sd Q beside white noise and a random walk, readings of 4 Hz. N from 0.0074
to 0.054, Q / N from 0.4 to 3 sqrt(s), K / N of 0.0037 to 0.027 /s. What `identify` states by itself is counted.
`counted_law` is its law `moving_average` alone.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.signal import lfilter

from selfcal.adequacy.one_over_f import SURE_PROBABILITY, Rerun, weigh, with_white
from selfcal.adequacy.summary import summarize
from selfcal.bank.axis_result import AxisResult
from selfcal.bank.library import Bank
from selfcal.base.units import FLICKER_FLOOR
from selfcal.logs.recording import as_float
from selfcal.model.file import DEFAULT, Group, Model, Prior
from selfcal.model.tables import Tables, make_tables
from selfcal.verbs.identify import identify

Floats = NDArray[np.float64]
#: By parameter: truth, 5 %, median and 95 %; and a flag: the grid of nodes is too coarse, or of `sheet` and the default
#: laws, the drift is 1/f noise.
Found = tuple[dict[str, tuple[float, float, float, float]], bool]

FLICKER_HZ, LONGER, COUNTED_HZ = 10.0, 16, 4.0


def one_over_f(random: np.random.Generator, n: int, rate: float, B: float) -> Floats:
    """[n] readings."""
    whole = n * LONGER
    frequency = np.fft.rfftfreq(whole, 1.0 / rate)
    density = np.zeros(frequency.size)
    density[1:] = B**2 / (2.0 * math.pi * frequency[1:])
    size = np.sqrt(0.5 * density * whole * rate)
    parts = random.standard_normal(frequency.size) + 1j * random.standard_normal(frequency.size)
    return np.asarray(np.fft.irfft(parts * size, whole)[:n])


def flicker(random: np.random.Generator, seconds: float) -> Iterator[Found]:
    model = replace(Model.load(DEFAULT.parent / "sums.yaml"), hypotheses={"flicker": 1.0})
    tables, group = make_tables(model, FLICKER_HZ, ("gx",)), model.group_of("gx")
    while True:
        y, truth = with_one_over_f(random, seconds)
        bank = Bank(tables)
        bank.push(as_float(y)[:, None])
        result = with_white(bank.report(0), group, tables.dt_s, round(seconds / tables.dt_s), tables.block)
        found = result.parameters["flicker"]
        yield {name: (value, *quantiles(found[name])) for name, value in truth.items()}, found["B"].off_grid


def sheet(random: np.random.Generator, seconds: float) -> Iterator[Found]:
    model = Model.load(DEFAULT)
    tables = make_tables(model, FLICKER_HZ, ("gx",))
    while True:
        y, truth = with_one_over_f(random, seconds)
        _, found, sure = numbers_of(tables, model.group_of("gx"), y)
        told = {"ARW": (truth["N"], *found["arw"])} if "arw" in found else {}
        if "bias_instability" in found:
            told["bias instability"] = (truth["B"], *found["bias_instability"])
        yield told, sure


def with_one_over_f(random: np.random.Generator, seconds: float) -> tuple[Floats, dict[str, float]]:
    """Readings and truth."""
    N, B = 0.04, math.exp(random.uniform(math.log(0.005), math.log(0.05)))
    n = round(seconds * FLICKER_HZ)
    y = 0.1 + one_over_f(random, n, FLICKER_HZ, B) + N * math.sqrt(FLICKER_HZ) * random.standard_normal(n)
    return y, {"N": N, "B": B}


def numbers_of(
    tables: Tables, group: Group, y: Floats
) -> tuple[AxisResult, dict[str, tuple[float, float, float]], bool]:
    """What a bank reports of readings, the identified numbers of the data sheet, and whether the drift is 1/f noise."""
    samples = as_float(y)
    bank = Bank(tables)
    bank.push(samples[:, None])
    result = bank.report(0)
    beside = weigh(Rerun(tables, group, samples, np.zeros(samples.size, np.int64)))
    found = summarize(result, group, tables.dt_s, samples.size // tables.block, tables.block, beside)
    known = {key: quantiles(number.estimate) for key, number in found.items() if number.estimate.identified}
    return result, known, beside is not None and beside.probability >= SURE_PROBABILITY


def of_default(random: np.random.Generator, seconds: float, law: str) -> Iterator[Found]:
    model = Model.load(DEFAULT)
    tables = make_tables(model, COUNTED_HZ, ("gx",))
    n, dt = round(seconds * COUNTED_HZ), 1.0 / COUNTED_HZ
    tau = np.geomspace(1.0, 0.5 * seconds, 4000)
    while True:
        truth = {"N": 0.04}
        drift: Floats = np.zeros(n)
        allan = truth["N"] ** 2 / tau
        if law == "random_walk":
            truth["K"] = math.exp(random.uniform(math.log(1e-4), math.log(1e-3)))
            drift = truth["K"] * math.sqrt(dt) * random.standard_normal(n).cumsum()
            allan += truth["K"] ** 2 * tau / 3.0
        elif law == "gauss_markov":
            truth["sigma_m"] = math.exp(random.uniform(math.log(0.005), math.log(0.05)))
            truth["alpha"] = 1.0 / math.exp(random.uniform(math.log(30.0), math.log(600.0)))
            phi = math.exp(-truth["alpha"] * dt)
            steps = truth["sigma_m"] * math.sqrt(1.0 - phi**2) * random.standard_normal(n)
            steps[0] = truth["sigma_m"] * random.standard_normal()
            drift = np.asarray(lfilter([1.0], [1.0, -phi], steps))
            x = truth["alpha"] * tau
            allan += 2.0 * truth["sigma_m"] ** 2 / x * (1.0 - (3.0 - 4.0 * np.exp(-x) + np.exp(-2.0 * x)) / (2.0 * x))
        y = 0.1 + drift + truth["N"] / math.sqrt(dt) * random.standard_normal(n)
        result, found, sure = numbers_of(tables, model.group_of("gx"), y)
        told = {name: (value, *quantiles(result.parameters[law][name])) for name, value in truth.items()}
        walk = {"random_walk": truth.get("K", 0.0), "gauss_markov": _walk(truth)}.get(law, 0.0)
        least = np.flatnonzero((allan[1:-1] < allan[:-2]) & (allan[1:-1] <= allan[2:]))
        lowest = math.sqrt(allan[least[0] + 1]) / FLICKER_FLOOR if least.size else math.nan
        for key, value in (("arw", truth["N"]), ("rrw", walk), ("bias_instability", lowest)):
            if key in found and value > 0.0:
                told[key] = (value, *found[key])
        yield told, sure


def _walk(truth: Mapping[str, float]) -> float:
    """K of the walk that a Gauss-Markov drift is over short times."""
    return truth.get("sigma_m", 0.0) * math.sqrt(2.0 * truth.get("alpha", 0.0))


def known(random: np.random.Generator, seconds: float) -> Iterator[Found]:
    sizes = {"ramp": 1e-5, "line": 0.05, "settling": 0.2}
    tree = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["regressors"] = [
        {"name": "ramp", "kind": "time", "sd": {"gyro": sizes["ramp"]}},
        {"name": "line", "kind": "periodic", "frequency_hz": 1.0 / 300.0, "sd": {"gyro": sizes["line"]}},
        {"name": "settling", "kind": "turn_on", "tau_s": 250.0, "sd": {"gyro": sizes["settling"]}},
    ]
    n = round(seconds)
    t = np.arange(n) + 0.0
    columns = {"ramp": t, "line": np.sin(2.0 * math.pi * t / 300.0), "settling": np.exp(-t / 250.0)}
    with tempfile.TemporaryDirectory() as folder:
        log, model = Path(folder) / "log.npz", Path(folder) / "model.yaml"
        model.write_text(yaml.safe_dump(tree), encoding="utf-8")
        while True:
            truth = {name: size * random.choice([-1.0, 1.0]) * random.uniform(0.5, 1.5) for name, size in sizes.items()}
            y = 0.1 + 3e-4 * random.standard_normal(n).cumsum() + 0.04 * random.standard_normal(n)
            y += sum(truth[name] * column for name, column in columns.items())
            np.savez(log, **{"t[s]": t, "gx[deg/s]": y})
            axis = identify(log, model=model).axes["gx"]
            found = {name: next(iter(axis["regressors"][name]["coefficients"].values())) for name in truth}
            told = {name: (truth[name], *(one[key] for key in ("q05", "median", "q95"))) for name, one in found.items()}
            yield told, bool(axis.parameters[axis.law]["N"].off_grid)


def quantiles(one: object) -> tuple[float, float, float]:
    low, middle, high = (float(getattr(one, key)) for key in ("q05", "median", "q95"))
    return low, middle, high


def counted_readings(random: np.random.Generator, seconds: float) -> tuple[Floats, dict[str, float]]:
    """Readings and truth."""
    n = round(seconds * COUNTED_HZ)
    N = 0.02 * math.exp(random.uniform(-1.0, 1.0))
    K = 0.01 * N * math.exp(random.uniform(-1.0, 1.0))
    Q = N * math.exp(random.uniform(math.log(0.4), math.log(3.0)))
    y = 0.1 + K / math.sqrt(COUNTED_HZ) * random.standard_normal(n).cumsum()
    y += N * math.sqrt(COUNTED_HZ) * random.standard_normal(n)
    y += np.diff(Q * random.standard_normal(n + 1)) * COUNTED_HZ
    return y, {"N": N, "K": K, "Q": Q}


def counted(random: np.random.Generator, seconds: float) -> Iterator[Found]:
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.npz"
        while True:
            y, truth = counted_readings(random, seconds)
            np.savez(log, **{"t[s]": np.arange(y.size) / COUNTED_HZ, "gx[deg/s]": y})
            axis = identify(log).axes["gx"]
            found, numbers = axis.parameters[axis.law], axis["summary"]
            told = {name: (truth[name], *quantiles(found[name])) for name in ("N", "K") if name in found}
            if "quantization_noise" in numbers:
                one = numbers["quantization_noise"]
                told["Q"] = (truth["Q"], one["q05"], one["median"], one["q95"])
            yield told, bool(found["N"].off_grid)


def counted_law(random: np.random.Generator, seconds: float) -> Iterator[Found]:
    """By the law that `identify` adds, alone, within the ratios that it lays."""
    model = replace(Model.load(DEFAULT.parent / "sums.yaml"), hypotheses={"moving_average": 1.0})
    wide = Prior("log_uniform", 0.05, 5.0)
    model = replace(
        model, groups=tuple(replace(one, priors={**one.priors, "spectral_ratio": wide}) for one in model.groups)
    )
    tables, group = make_tables(model, COUNTED_HZ, ("gx",)), model.group_of("gx")
    while True:
        y, truth = counted_readings(random, seconds)
        bank = Bank(tables)
        bank.push(as_float(y)[:, None])
        result = bank.report(0)
        found = result.parameters["moving_average"]
        told = {name: (truth[name], *quantiles(found[name])) for name in ("N", "K")}
        numbers = summarize(result, group, tables.dt_s, y.size // tables.block, tables.block)
        if "quantization_noise" in numbers:
            told["Q"] = (truth["Q"], *quantiles(numbers["quantization_noise"].estimate))
        yield told, found["N"].off_grid


DRAWN: Mapping[str, Callable[[np.random.Generator, float], Iterator[Found]]] = {
    "flicker": flicker,
    "sheet": sheet,
    "constant": lambda random, seconds: of_default(random, seconds, "constant"),
    "counted": counted,
    "counted_law": counted_law,
    "walk": lambda random, seconds: of_default(random, seconds, "random_walk"),
    "markov": lambda random, seconds: of_default(random, seconds, "gauss_markov"),
    "known": known,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("noise", choices=tuple(DRAWN))
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--records", type=int, default=100)
    parser.add_argument("--seed", type=int, default=7)
    given = parser.parse_args()
    random = np.random.default_rng([given.seed, round(3600.0 * given.hours)])
    each = list(islice(DRAWN[given.noise](random, 3600.0 * given.hours), given.records))
    for name in dict.fromkeys(name for told, _ in each for name in told):
        rows = np.array([told[name] for told, _ in each if name in told])
        inside = (rows[:, 1] <= rows[:, 0]) & (rows[:, 0] <= rows[:, 3])
        print(
            f"{given.noise}, {given.hours:g} h: {name}: {inside.sum()} of {len(rows)} in the 90 % interval "
            f"({100.0 * inside.mean():.1f} %)",
            end="",
        )
        if (rows[:, 0] > 0.0).all():
            off = np.log(rows[:, 2] / rows[:, 0])
            print(f", mean error of the ln {off.mean():+.3f} +- {off.std() / math.sqrt(len(rows)):.3f}", end="")
        print()
    print(f"flagged: {sum(flagged for _, flagged in each)} of {len(each)}")


if __name__ == "__main__":
    main()
