"""Error of the bias some time after a rest, by the bank and by what people flash today."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from selfcal.base.errors import UserError
from selfcal.base.options import argument, option
from selfcal.logs.loaders import READ
from selfcal.verbs._shared import PARTS, Axes, Json, ModelFile, Results, Scheduler, shown_by


def worth(
    logs: Annotated[
        Sequence[Path | str],
        argument(f"Recordings at rest: {READ}; default: simulated parts", "[LOG...]", kind=list[Path]),
    ] = (),
    *,
    axes: Axes = (),
    model: ModelFile = None,
    records: Annotated[int, option("Simulated rests of each law and length", metavar="N")] = PARTS,
    seed: Annotated[int, option("Same seed, same rests", metavar="N", min=0)] = 1,
    json: Json = None,
    scheduler: Scheduler = None,
    results: Results = None,
) -> dict[str, Any]:
    """Predict the bias 1 to 1000 s after rests of 1, 5 and 30 min.

    With `logs`: rests that do not overlap, from each recording's axes; the mean of the 30 s that follow stands for the
    truth. Without: `records` simulated parts of each law and rest, whose bias is known. The samples are means of 1 s.
    Returns the document `selfcal.worth/1`: rms errors by case, rest, method and horizon, and of the minute of dead
    reckoning that follows (heading_error(), position_error()).
    """
    from functools import partial

    from selfcal.base.output import check_writable, write_json
    from selfcal.batch.spread import record_seeds, spread
    from selfcal.model.file import Model
    from selfcal.model.simulated_parts import LAWS
    from selfcal.studies import worth as study

    check_writable(json)
    loaded = replace(Model.load(model), regressors=(), half_life_s=0.0)
    seeds = record_seeds(records, seed)
    if logs:
        rows = [row for log in logs for row in study.recorded(log, loaded, axes)]
        if not rows:
            span = study.RESTS_S[0] + study.HORIZONS_S[-1] + study.REFERENCE_S
            raise UserError(f"the recordings are too short: {span} s without a gap are needed; record longer")
    else:
        jobs = [study.Job(law, rest, record_seed) for law in LAWS for rest in study.RESTS_S for record_seed in seeds]
        settings = {"schema": study.SCHEMA, "model": repr(replace(loaded, path=Path(), name="")), "seed": seed}
        rows = spread(partial(study.simulated, loaded), jobs, settings=settings, scheduler=scheduler, results=results)
    cases = study.summary(rows)
    document = {
        "schema": study.SCHEMA,
        "recordings": [str(log) for log in logs],
        "cases": cases,
        "regret": study.regret(cases),
    }
    write_json(document, json)
    return document


show = shown_by("studies.worth")
