"""`selfcal montecarlo`: an ensemble of simulated records with parameters drawn from the prior; are the answers honest?

Calculated against actual, after Stepanov & Motorin (2017): covariance (17) against (16), probability of false
identification (19) against (20); and how often the stated 90 % intervals hold the truth. (19) is read as 1 - P of
the law that is chosen: with the P of the true law the two would not have the same mean.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from selfcal.adequacy.allan import terms_of
from selfcal.adequacy.document import check_writable, write_json
from selfcal.base.errors import UserError
from selfcal.batch.spread import Row, record_seeds, spread
from selfcal.model.file import Group, Model
from selfcal.model.laws import Law, named
from selfcal.model.tables import Tables, bank_block, make_tables
from selfcal.show.table import TABLE_WIDTH

SCHEMA = "selfcal.montecarlo/1"
#: Bank samples; fewer say nothing.
MIN_SAMPLES = 10
#: Of a record: 80 MB.
MOST_SAMPLES = 10_000_000


#: Samples drawn of a bank interval and averaged as the intake does, where the sensor gives as many: their drift's mean
#: is that of infinitely many to a hundredth of the averaging's effect.
BLOCK = 10


#: What of each estimate of the true law a row has.
ESTIMATE = ("mean", "sd", "q05", "median", "q95")


def montecarlo(
    model: Path | str | None = None,
    *,
    records: int = 400,
    duration_s: float = 3600.0,
    axis: str = "gx",
    seed: int = 1,
    json: Path | str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    results: Path | str | None = None,
) -> dict[str, Any]:
    """Simulate `records` records per law, at most BLOCK samples a bank interval, identify each with the library, and
    compare with the truth.

    Parameters that no node of the grid has are drawn again: `without_nodes` is their share by law.

    `workers`: processes here, one for each processor by default; `scheduler`: address of a Dask scheduler instead. The
    numbers are the same. `results`: a folder that keeps finished records: a run that was stopped continues from them,
    and one of more records adds to them.
    Returns per law and parameter the share of 90 % intervals that hold the truth, actual and stated rms error; over all
    records the calculated and actual probability of false identification, with the sd of their difference.
    """
    check_writable(json)
    loaded = Model.load(model)
    seeds = record_seeds(records, seed)
    if not duration_s * loaded.bank_rate_hz >= MIN_SAMPLES:
        raise UserError(f"--duration must be at least {MIN_SAMPLES / loaded.bank_rate_hz:g} s")
    if not duration_s * loaded.bank_rate_hz <= MOST_SAMPLES:
        raise UserError(f"--duration must be at most {MOST_SAMPLES / loaded.bank_rate_hz:g} s")
    if loaded.regressors:
        raise UserError(f"{loaded.path}: the ensemble has no regressors: leave them out of the model")
    loaded.group_of(axis)
    jobs = [(law, one) for one in seeds for law in loaded.hypotheses]
    found = spread(
        partial(rows_of, loaded, axis, duration_s),
        jobs,
        settings={"schema": SCHEMA, "model": settings_of(loaded), "axis": axis, "duration_s": duration_s, "seed": seed},
        scheduler=scheduler,
        results=results,
        count=workers,
    )
    document = _summary(found, records, duration_s, axis)
    if json is not None:
        write_json(document, json)
    return document


def settings_of(model: Model) -> str:
    """The model without the place of its file."""
    return repr(replace(model, path=Path(), name=""))


def draw(group: Group, law: str, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of a law and the bias, drawn from the group's priors."""
    truth = {name: group.priors[name].at(float(rng.random())) for name in group.laws[law].parameters}
    return {**truth, "bias": group.priors["bias"].sd * float(rng.standard_normal())}


def has_nodes(law: Law, truth: Mapping[str, float], tables: Tables) -> bool:
    """Whether the grid can have a node for the law. Averages of a faster drift have less white noise than none."""
    terms = terms_of(law, truth, tables.dt_s, tables.block)
    return terms.lacking < terms.variance * (1.0 - 2.0 * abs(terms.lag1))


def simulate_bank_samples(
    law: str | Law, truth: Mapping[str, float], rate_hz: float, samples: int, seed: int, bank_block: int = 1
) -> tuple[NDArray[np.float64], float]:
    """One simulated axis y [samples] at `rate_hz`, without lattice or range; and x0 + drift at the last sample.

    Of `bank_block` samples a bank interval coloured noise is a moving average.

    A law by its name takes a stated correlation time from the truth's `correlation_time_s`.
    """
    from selfcal import _reference

    scene = _reference.Scene()
    scene.seed, scene.rate_hz, scene.samples, scene.block, scene.filter_taps = seed, rate_hz, samples, 1, 1
    scene.bank_block = bank_block
    axis = _reference.Axis()
    of = named(law, truth.get("correlation_time_s", math.nan)) if isinstance(law, str) else law
    axis.law, axis.N, axis.bias = of.as_tuple, truth["N"], truth.get("bias", 0.0)
    axis.drift, axis.second = of.node(truth)
    values, _, _, _, bias_now = _reference.simulate(scene, [axis])
    return values[0], float(bias_now[0])


def rows_of(model: Model, axis: str, duration_s: float, job: tuple[str, int]) -> list[Row]:
    """One row: the law, the truth, the probabilities, and the estimates of the true law."""
    from selfcal.bank.library import Bank

    law, seed = job
    block = min(BLOCK, bank_block(model.sensor_rate_hz, model.bank_rate_hz))
    rate_hz = block * model.bank_rate_hz
    tables = make_tables(model, rate_hz, (axis,))
    place = list(model.hypotheses).index(law)
    rng = np.random.default_rng([seed, place])
    truth = draw(model.group_of(axis), law, rng)
    drawn = 1
    while not has_nodes(model.laws[law], truth, tables):
        truth = draw(model.group_of(axis), law, rng)
        drawn += 1
    y, bias_now = simulate_bank_samples(
        model.laws[law], truth, rate_hz, block * round(duration_s * model.bank_rate_hz), seed, block
    )
    bank = Bank(tables)
    bank.push(y[:, None])
    result = bank.report(0)
    row: Row = {
        "law": law,
        "seed": seed,
        "drawn": drawn,
        "bias_error_sd": (result.bias_mean - bias_now) / result.bias_sd,
    }
    row |= {f"truth.{name}": value for name, value in truth.items()}
    row |= {f"probability.{name}": value for name, value in result.probability.items()}
    for name, estimate in result.parameters[law].items():
        row |= {f"{key}.{name}": getattr(estimate, key) for key in ESTIMATE}
    return [row]


def _summary(rows: Sequence[Row], records: int, duration_s: float, axis: str) -> dict[str, Any]:
    laws: dict[str, Any] = {}
    for law in dict.fromkeys(str(row["law"]) for row in rows):
        mine = [row for row in rows if row["law"] == law]
        parameters = {}
        for name in (key.removeprefix("mean.") for key in mine[0] if key.startswith("mean.")):
            truth, mean, sd, q05, _, q95 = (
                np.array([row[f"{key}.{name}"] for row in mine]) for key in ("truth", *ESTIMATE)
            )
            parameters[name] = {
                "coverage_90": float(((truth >= q05) & (truth <= q95)).mean()),
                "rms_actual": float(np.sqrt(((mean - truth) ** 2).mean())),
                "rms_calculated": float(np.sqrt((sd**2).mean())),
            }
        errors = np.array([row["bias_error_sd"] for row in mine])
        laws[law] = {
            "parameters": parameters,
            "false_identification": float(np.mean([_chosen(row) != law for row in mine])),
            "bias_coverage_90": float((np.abs(errors) < 1.6449).mean()),
            "without_nodes": float(1.0 - len(mine) / sum(row["drawn"] for row in mine)),
        }
    top = np.array([max(_probability(row).values()) for row in rows])
    wrong = np.array([_chosen(row) != row["law"] for row in rows])
    return {
        "schema": SCHEMA,
        "records_per_law": records,
        "duration_s": duration_s,
        "axis": axis,
        "laws": laws,
        "false_identification": {
            "calculated": float(1.0 - top.mean()),
            "actual": float(wrong.mean()),
            "sd_of_difference": float(np.std(wrong - (1.0 - top)) / math.sqrt(len(rows))),
        },
    }


def _probability(row: Row) -> dict[str, float]:
    start = "probability."
    return {name.removeprefix(start): value for name, value in row.items() if name.startswith(start)}


def _chosen(row: Row) -> str:
    """The most probable law."""
    probability = _probability(row)
    return max(probability, key=lambda name: probability[name])


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """The table of calculated against actual."""
    table = Table(
        box=box.SIMPLE_HEAD,
        title=f"{document['records_per_law']} records per law, {document['duration_s']:g} s, axis {document['axis']}",
        title_justify="left",
    )
    for heading in ("law", "parameter", "truth in 90 %", "rms actual (16)", "rms calculated (17)", "ratio"):
        table.add_column(heading, no_wrap=True)
    for law, entry in document["laws"].items():
        for name, p in entry["parameters"].items():
            table.add_row(
                law,
                name,
                f"{100 * p['coverage_90']:.1f} %",
                f"{p['rms_actual']:.3g}",
                f"{p['rms_calculated']:.3g}",
                f"{p['rms_actual'] / p['rms_calculated']:.3f}",
            )
        table.add_row(law, "bias now", f"{100 * entry['bias_coverage_90']:.1f} %", end_section=True)
    console = Console(stderr=to_stderr)
    console.width = max(console.width, TABLE_WIDTH)
    console.print(table)
    f = document["false_identification"]
    console.print(
        f"false identification: calculated {f['calculated']:.4f}, actual {f['actual']:.4f}, "
        f"difference {f['actual'] - f['calculated']:+.4f} ± {f['sd_of_difference']:.4f} (1 sd)",
        highlight=False,
    )
