"""Errors and consistency of a GPS/INS filter, by the noise that it assumes."""

from __future__ import annotations

from typing import Annotated, Any

from selfcal.base.options import option
from selfcal.verbs._shared import PARTS, Json, Results, Scheduler, shown_by


def navigate(
    *,
    records: Annotated[int, option("Simulated parts of each law", metavar="N")] = PARTS,
    seed: Annotated[int, option("Same seed, same parts", metavar="N", min=0)] = 1,
    json: Json = None,
    scheduler: Scheduler = None,
    results: Results = None,
) -> dict[str, Any]:
    """Fly `records` simulated parts of each law after a rest, each with the four filters of `TITLES`, which differ in
    the noise that they assume (navigation.py).

    Returns the document `selfcal.navigate/1`: rms errors and the mean NEES by law, filter and time, and the 95 % band
    of the NEES of filters that are consistent. A bias has the rms of its three axes.
    """
    from scipy import stats

    from selfcal.base.output import check_writable, write_json
    from selfcal.batch.spread import record_seeds, spread
    from selfcal.model.simulated_parts import LAWS
    from selfcal.studies.navigate import SCHEMA, TOGETHER, Job, rows_of, summary
    from selfcal.studies.navigation import JUDGED

    check_writable(json)
    seeds = record_seeds(records, seed)
    jobs = [Job(law, tuple(seeds[k : k + TOGETHER])) for law in LAWS for k in range(0, records, TOGETHER)]
    rows = spread(rows_of, jobs, settings={"schema": SCHEMA}, scheduler=scheduler, results=results)
    band = stats.chi2.ppf([0.025, 0.975], JUDGED * records) / records
    document = {
        "schema": SCHEMA,
        "parts": records,
        "nees_expected": JUDGED,
        "nees_band_95": band.tolist(),
        "laws": {law: summary([row for row in rows if row["law"] == law]) for law in LAWS},
    }
    write_json(document, json)
    return document


show = shown_by("studies.navigate")
