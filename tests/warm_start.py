"""What a warm start gains in the first minutes, and whether its intervals hold (tools/selfcal/diagnosis/warm.py).

    python tests/warm_start.py --records 400 --seed 1

A part with a temperature coefficient is recorded for two hours and diagnosed once. Then each record is another rest of
it, at 1 Hz by the host's library. The temperature rises by 5 to 10 degC with a time constant of 600 to 1800 s. There
are two kinds of records:

    same    N, K and the coefficient of the part, changed by RUN_TO_RUN from run to run: the gain, cold against warm
    prior   N, K and the coefficient drawn from the warm prior, and its law known: its 90 % intervals hold 90 %

Prints, for cold and warm: the median sd of N and K (of ln) and of the coefficient, the share of 90 % intervals that
hold the truth, how often the regressor is in use, and the rms error of the corrected output 300 s after the report. Of
the two reports, with the regressor in use and without, the likelier one counts, as in lib/imu_columns.c.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.special import logsumexp

from selfcal.bank.axis_result import HALF_90
from selfcal.bank.library import Bank
from selfcal.diagnosis.warm import RUN_TO_RUN, RUN_TO_RUN_COEFFICIENT, load_start, warmed
from selfcal.model.file import DEFAULT, Model
from selfcal.model.tables import Tables, make_tables
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.simulate import simulate

#: The part, gx: deg/s/sqrt(Hz), deg/s^2/sqrt(Hz), deg/s/degC.
PART = {"N": 0.04, "K": 1.0e-3, "coefficient": 0.1}
#: Bank samples from a record's end to the corrected reading.
AHEAD = 300
LAW = "random_walk"


def diagnosed(folder: Path, seed: int) -> tuple[Path, Path]:
    """The part's extended model and its diagnosis, of a simulated record of two hours."""
    tree: dict[str, Any] = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["groups"]["gyro"]["lsb"] = 0.0
    axis = {"hypothesis": LAW, "bias": 0.1, "N": PART["N"], "K": PART["K"]}
    tree["simulate"] = {"rate_hz": 1.0, "duration_s": 7200.0, "axes": {"gx": axis}}
    model, log = folder / "part.yaml", folder / "rest.npz"
    model.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")
    simulate(model, log, seed=seed, effects=[f"temperature:coefficient={PART['coefficient']},axis=gx"])
    files = folder / "extended.yaml", folder / "diagnosis.json"
    diagnose(log, axes=["gx"], model=model, write_model=files[0], json=files[1])
    return files


def both(model: Path, diagnosis: Path) -> dict[str, Tables]:
    """The tables of gx, cold and warm."""
    loaded = Model.load(model)
    cold = make_tables(loaded, 1.0, ("gx",))
    return {"cold": cold, "warm": warmed(cold, load_start(diagnosis, loaded))}


def law_known(tables: Tables) -> Tables:
    """With the law alone that the part has."""
    (one,) = (h for h in tables.hypotheses if h.name == LAW)
    return replace(tables, hypotheses=(replace(one, ln_probability=0.0),))


def of_part(rng: np.random.Generator) -> dict[str, float]:
    """The part in another run."""
    run = RUN_TO_RUN | {"coefficient": RUN_TO_RUN_COEFFICIENT}
    return {name: value * math.exp(run[name] * rng.standard_normal()) for name, value in PART.items()}


def of_prior(tables: Tables, rng: np.random.Generator) -> dict[str, float]:
    """N, K and the coefficient from the tables' priors."""
    (row,), (column,) = law_known(tables).hypotheses[0].priors, tables.regressors
    n, k = (math.exp(rng.uniform(low, high)) for low, high, *_ in row[:2])
    return {"N": n, "K": k, "coefficient": rng.normal(column.coefficient_mean[0], column.coefficient_sd[0])}


def record(
    truth: dict[str, float], samples: int, reference: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Readings, temperature and bias [samples + AHEAD]; at the reference the bias is drawn from the model's prior."""
    n = samples + AHEAD
    rise = rng.uniform(5.0, 10.0) * (1.0 - np.exp(-np.arange(n) / rng.uniform(600.0, 1800.0)))
    temperature = reference + rng.normal(0.0, 5.0) + rise
    walk = np.concatenate([[0.0], np.cumsum(truth["K"] * rng.standard_normal(n - 1))])
    bias = rng.normal(0.0, 10.0) + walk + truth["coefficient"] * (temperature - reference)
    return bias + truth["N"] * rng.standard_normal(n), temperature, bias


@dataclass(frozen=True)
class Told:
    """Of a report: median, sd of ln, q05 and q95 of N and K; mean, sd, q05 and q95 of the coefficient in use; whether
    it is in use in the likelier report; and the bias AHEAD by that one."""

    of: dict[str, tuple[float, float, float, float]]
    used: bool
    bias: float


def report(tables: Tables, y: NDArray[np.float64], temperature: NDArray[np.float64]) -> Told:
    """After all samples but the last AHEAD."""
    bank = Bank(tables)
    bank.push(y[:-AHEAD, None], None, temperature[:-AHEAD, None])
    without, found = bank.report(0, 0), bank.report(0, 1)
    ln = [
        logsumexp([h.ln_probability + one.log_evidence[h.name] for h in tables.hypotheses]) for one in (without, found)
    ]
    used = tables.regressors[0].ln_odds[0] + ln[1] - ln[0] > 0.0
    told: dict[str, tuple[float, float, float, float]] = {}
    for name in ("N", "K"):
        one = found.parameters[LAW][name]
        told[name] = one.median, math.log(one.q95 / one.q05) / (2.0 * HALF_90), one.q05, one.q95
    mean, variance = 0.0, 0.0
    for law, probability in found.probability.items():
        of_law = found.coefficients[law][0]
        mean, variance = mean + probability * of_law[0], variance + probability * (of_law[1] ** 2 + of_law[0] ** 2)
    sd = math.sqrt(variance - mean * mean)
    told["coefficient"] = mean, sd, mean - HALF_90 * sd, mean + HALF_90 * sd
    change = float(temperature[-1] - temperature[-AHEAD - 1])
    return Told(told, used, found.bias_mean + mean * change if used else without.bias_mean)


def campaign(tables: dict[str, Tables], samples: int, records: int, seed: int, kind: str) -> dict[str, dict[str, Any]]:
    """Of each table what the head of this file says."""
    names = ("N", "K", "coefficient")
    held = {name: dict.fromkeys(names, 0) for name in tables}
    told: dict[str, list[Told]] = {name: [] for name in tables}
    errors: dict[str, list[float]] = {name: [] for name in tables}
    for at in range(records):
        rng = np.random.default_rng([seed, at, samples, kind == "prior"])
        truth = of_prior(tables["warm"], rng) if kind == "prior" else of_part(rng)
        y, temperature, bias = record(truth, samples, tables["warm"].regressors[0].reference, rng)
        for name, one in tables.items():
            last = report(one, y, temperature)
            told[name].append(last)
            errors[name].append(last.bias - bias[-1])
            for parameter in names:
                held[name][parameter] += last.of[parameter][2] <= truth[parameter] <= last.of[parameter][3]
    return {
        name: {
            "sd": {one: float(np.median([last.of[one][1] for last in told[name]])) for one in names},
            "held": {one: held[name][one] / records for one in names},
            "used": float(np.mean([last.used for last in told[name]])),
            "error": float(np.sqrt(np.mean(np.square(errors[name])))),
        }
        for name in tables
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        tables = both(*diagnosed(Path(folder), options.seed))
    known = {"warm": law_known(tables["warm"])}
    print("records  samples  prior  sd ln N  sd ln K  sd coefficient  held N, K, coefficient  used  error, deg/s")
    for kind, of_kind in (("same", tables), ("prior", known)):
        for samples in (60, 300):
            for name, one in campaign(of_kind, samples, options.records, options.seed, kind).items():
                sd = "  ".join(f"{value:.3g}" for value in one["sd"].values())
                held = " ".join(f"{value:.3f}" for value in one["held"].values())
                print(f"{kind:7}  {samples:7}  {name:5}  {sd}  {held}  {one['used']:.2f}  {one['error']:.4f}")


if __name__ == "__main__":
    main()
