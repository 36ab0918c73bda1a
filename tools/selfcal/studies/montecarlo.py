"""`selfcal montecarlo`: an ensemble of simulated records with parameters drawn from the prior; are the answers honest?

Calculated against actual, after Stepanov & Motorin (2017): covariance (17) against (16), probability of false
identification (19) against (20); and how often the stated 90 % intervals hold the truth. (19) is read as 1 - P of
the law that is chosen: with the P of the true law the two would not have the same mean.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from selfcal.adequacy.drawn import draw_parameters, has_nodes, simulate_bank_samples
from selfcal.bank.axis_result import HALF_90, likeliest
from selfcal.base.output import console_of, print_line, table_of
from selfcal.batch.spread import Row
from selfcal.model.file import Model
from selfcal.model.tables import bank_block, make_tables

SCHEMA = "selfcal.montecarlo/1"
#: Samples drawn of a bank interval and averaged as the intake does, where the sensor gives as many: their drift's mean
#: is that of infinitely many to a hundredth of the averaging's effect.
BLOCK = 10
#: Keys of each estimate of the true law in a row.
ESTIMATE = ("mean", "sd", "q05", "median", "q95")


def rows_of(model: Model, axis: str, duration_s: float, job: tuple[str, int]) -> list[Row]:
    """A row: the law, the truth, the probabilities, and the estimates of the true law."""
    from selfcal.bank.library import Bank

    law, seed = job
    block = min(BLOCK, bank_block(model.sensor_rate_hz, model.bank_rate_hz))
    rate_hz = block * model.bank_rate_hz
    tables = make_tables(model, rate_hz, (axis,))
    index = list(model.hypotheses).index(law)
    rng = np.random.default_rng([seed, index])
    truth = draw_parameters(model.group_of(axis), law, rng)
    drawn = 1
    while not has_nodes(model.laws[law], truth, tables):
        truth = draw_parameters(model.group_of(axis), law, rng)
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


def summary(rows: Sequence[Row], records: int, duration_s: float, axis: str) -> dict[str, Any]:
    """The document: calculated against actual errors, by law and parameter."""
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
            "bias_coverage_90": float((np.abs(errors) < HALF_90).mean()),
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
    return likeliest(_probability(row))


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """The table of calculated against actual."""
    title = f"{document['records_per_law']} records per law, {document['duration_s']:g} s, axis {document['axis']}"
    headings = ("law", "parameter", "truth in 90 %", "rms actual (16)", "rms calculated (17)", "ratio")
    table = table_of(headings, title)
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
    console = console_of(to_stderr=to_stderr)
    console.print(table)
    f = document["false_identification"]
    print_line(
        console,
        f"false identification: calculated {f['calculated']:.4f}, actual {f['actual']:.4f}, "
        f"difference {f['actual'] - f['calculated']:+.4f} ± {f['sd_of_difference']:.4f} (1 sd)",
    )
