"""Simulate records with parameters drawn from the prior and compare stated with actual errors."""

from __future__ import annotations

from typing import Annotated, Any

from selfcal.base.errors import UserError
from selfcal.base.options import option
from selfcal.verbs._shared import PARTS, RECORD_S, Json, ModelFile, Results, Scheduler, Workers, shown_by


def montecarlo(
    model: ModelFile = None,
    *,
    records: Annotated[int, option("Records per law", metavar="N")] = PARTS,
    duration_s: Annotated[float, option("Length of each, s", "--duration", metavar="S")] = RECORD_S,
    axis: Annotated[str, option("Axis whose priors are drawn from", metavar="NAME")] = "gx",
    seed: Annotated[int, option("Same seed, same records", metavar="N", min=0)] = 1,
    json: Json = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    results: Results = None,
) -> dict[str, Any]:
    """Simulate `records` records per law, at most BLOCK samples a bank interval, identify each with the library, and
    compare with the truth.

    Parameters that no node of the grid has are drawn again: `without_nodes` is their share by law. The numbers are the
    same for any workers. A run of more records adds to those in `results`.
    Returns per law and parameter the share of 90 % intervals that hold the truth, actual and stated rms error; over all
    records the calculated and actual probability of false identification, with the sd of their difference.
    """
    from functools import partial

    from selfcal.bank.blocks import BLOCKS_LEAST, MOST_DENSE
    from selfcal.base.output import check_writable, write_json
    from selfcal.batch.spread import record_seeds, spread
    from selfcal.model.file import Model, settings_of
    from selfcal.studies.montecarlo import SCHEMA, rows_of, summary

    check_writable(json)
    loaded = Model.load(model)
    seeds = record_seeds(records, seed)
    least_s, most_s = BLOCKS_LEAST / loaded.bank_rate_hz, MOST_DENSE / loaded.bank_rate_hz
    if not least_s <= duration_s <= most_s:
        raise UserError(f"--duration must be {least_s:g} to {most_s:g} s")
    if loaded.regressors:
        raise UserError(f"{loaded.path}: the ensemble has no regressors: leave them out of the model")
    loaded.group_of(axis)
    jobs = [(law, record_seed) for record_seed in seeds for law in loaded.hypotheses]
    rows = spread(
        partial(rows_of, loaded, axis, duration_s),
        jobs,
        settings={"schema": SCHEMA, "model": settings_of(loaded), "axis": axis, "duration_s": duration_s, "seed": seed},
        scheduler=scheduler,
        results=results,
        count=workers,
    )
    document = summary(rows, records, duration_s, axis)
    write_json(document, json)
    return document


show = shown_by("studies.montecarlo")
