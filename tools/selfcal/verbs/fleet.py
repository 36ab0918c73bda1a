"""Identify many recordings, and write one table of the units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from selfcal.base.errors import UserError, note, short
from selfcal.base.options import argument, option
from selfcal.logs.loaders import Reading
from selfcal.verbs import _shared as shared

if TYPE_CHECKING:
    from selfcal.batch.batch_files import Named
    from selfcal.batch.unit_table import BatchUnit


def fleet(
    patterns: Annotated[
        Sequence[Path | str],
        argument("Recordings: files, or patterns as 'logs/**/*.ulg'", "PATTERN...", kind=list[str]),
    ],
    output: Annotated[
        Path | str, option("Table to write: .csv or .parquet", "-o", "--output", metavar="FILE", show_default=False)
    ],
    *,
    serial_from: Annotated[
        str | None,
        option(
            "Device by the file's name (name:REGEX: by what it finds in the path), or by the metadata",
            metavar="name|field",
        ),
    ] = None,
    units_table: Annotated[
        Path | str | None, option("Columns file, device, and station, lot, date", metavar="UNITS.csv")
    ] = None,
    diagnose: Annotated[bool, option("Look for causes too; slower", "--diagnose")] = False,
    fail_on: shared.FailOn = None,
    limits: shared.LimitsFile = None,
    junit: shared.Junit = None,
    verdicts: shared.Verdicts = None,
    json: shared.Json = None,
    report: Annotated[Path | str | None, option("Write a page of the batch", metavar="FILE.html")] = None,
    write_model: Annotated[
        Path | str | None, option("Write the model with the batch as a new unit's priors", metavar="FILE.yaml")
    ] = None,
    workers: shared.Workers = None,
    scheduler: shared.Scheduler = None,
    results: Annotated[
        Path | str | None, option("Folder of finished recordings; default: FILE.parts", metavar="DIR")
    ] = None,
    axes: shared.Axes = (),
    model: shared.ModelFile = None,
    since_power_on_s: shared.SincePowerOn = 0.0,
    gate: shared.Gate = False,
    **reading: Unpack[Reading],
) -> dict[str, Any]:
    """Identify every recording of the batch and write the table `output`.

    A cause as `fail_on` needs `diagnose`. By `results` a run that was stopped goes on, and a changed file is done anew.
    Returns the document `selfcal.fleet/1`, and writes it to `json`: by device what failed, what could not be judged,
    and the exit `code`; the `population`, each unit's estimates by it, and the units `unlike` it.
    With `diagnose`, devices that need a look have an own page in `report`.units.
    Raises UserError for what the user can put right; a broken recording is a row of the table.
    """
    from functools import partial
    from operator import itemgetter

    import selfcal
    from selfcal.base.output import check_writable, write_json, write_text
    from selfcal.batch.batch_summary import batch_keys, lines_of, summed_up
    from selfcal.batch.fail_on import check_cause
    from selfcal.batch.fleet import document_with, judged_units
    from selfcal.batch.prior_file import prior_lines
    from selfcal.batch.prior_file import write_model as write_priors
    from selfcal.batch.spread import Kept, spread
    from selfcal.batch.unit_record import KILLED, Options, Verbs, examined, own_pages, record_settings
    from selfcal.batch.unit_table import BatchUnit, check_table, unit_rows, write_table
    from selfcal.batch.verdicts import Limits, check_options, write_verdicts
    from selfcal.model.file import Model
    from selfcal.model.file import settings_of as model_settings_of
    from selfcal.verbs.diagnose import diagnose as run_diagnose
    from selfcal.verbs.identify import identify

    check_table(output)
    dbc = reading.get("dbc")
    check_options(limits, junit, verdicts)
    check_writable(output, junit, verdicts, json, report, write_model, inputs=(model, units_table, dbc, limits))
    check_cause(fail_on)
    if fail_on is not None and fail_on != "inadequate" and not diagnose:
        raise UserError(f"--fail-on {fail_on}: give --diagnose too, which looks for causes")
    loaded = Model.load(model)
    for name in axes:
        loaded.group_of(name)
    bounds = None if limits is None else Limits.load(limits, loaded)
    folder = Path(f"{output}.parts") if results is None else Path(results)
    outputs = (output, junit, verdicts, json, report, write_model)
    others = (model, limits, units_table, folder, f"{report}.units")
    named = _named(patterns, units_table, serial_from, outputs, others)
    verbs = Verbs(identify, run_diagnose)
    options = Options(
        None if model is None else str(Path(model).absolute()),
        tuple(axes),
        diagnose,
        {**reading, "since_power_on_s": since_power_on_s, "gate": gate}
        | ({} if dbc is None else {"dbc": str(Path(dbc).absolute())}),
    )
    version = str(selfcal.__version__)
    kept = Kept(folder, record_settings(options, model_settings_of(loaded), version), key=itemgetter(1))  # its content
    sources = [source for source in named.sources if not source.copy_of]
    records = spread(
        partial(examined, verbs, options),
        [(str(Path(source.path).absolute()), source.content) for source in sources],
        scheduler=scheduler,
        results=kept,
        count=workers,
        lost=lambda _: [{"error": KILLED}],
        weights=[source.size + 1.0 for source in sources],
        verb="fleet",
    )
    record_of = dict(zip((source.path for source in sources), records, strict=True))
    batch = [
        BatchUnit(source, record_of.get(source.path, {"error": f"is the same recording as {source.copy_of}"}))
        for source in named.sources
    ]
    _note(batch)
    batch.sort(key=lambda unit: unit.place)
    write_table(output, (row for unit in batch for row in unit_rows(unit, version)))
    judged = [] if bounds is None else judged_units(batch, bounds)
    write_verdicts(judged, junit, verdicts)
    summary = summed_up(batch, loaded)
    document = {**document_with(batch, fail_on, judged), **batch_keys(summary), "words": list(lines_of(summary))}
    if write_model is not None:
        document["words"] += prior_lines(write_priors(write_model, loaded, summary), loaded)
    write_json(document, json)
    if report is not None:
        from selfcal.batch.fleet_page import fleet_html

        flagged = [*document["failed"], *document["unlike"], *document["drifting"]]
        pages: dict[str, str] = {}
        if diagnose:
            pages = own_pages(f"{report}.units", flagged, summary.devices, verbs, options, kept, workers)
        write_text(report, fleet_html(document, summary, pages))
    return document


def _note(batch: Sequence[BatchUnit]) -> None:
    """Name dates that are left out, and damaged files."""
    from selfcal.batch.batch_files import DATE_FORM

    for unit in batch:
        if unit.undated:
            note(f"{unit.source.path}: leaves out the date '{short(unit.undated)}': write it as {DATE_FORM}")
        if "damaged" in (known := unit.record.get("recording", {})):
            note(f"{unit.source.path}: {known['damaged']['words']}")


def _named(
    patterns: Sequence[Path | str],
    units_table: Path | str | None,
    serial_from: str | None,
    outputs: Sequence[Path | str | None],
    others: Sequence[Path | str | None],
) -> Named:
    """The recordings with their devices. `outputs`, `others`: the run's own files, which are no recordings."""
    from selfcal.batch.batch_files import batch_sources

    given = {Path(str(pattern)).resolve() for pattern in patterns}
    own = [[Path(file) for file in files if file is not None] for files in (outputs, others)]
    for file in own[0]:
        if file.resolve() in given:
            raise UserError(f"{file}: is one of the recordings: give it a name of its own")
    named = batch_sources([str(pattern) for pattern in patterns], units_table, serial_from, own[0] + own[1])
    for copy, other in named.copies.items():
        note(f"{copy}: the same recording as {other}: counted once")
    return named


def show(document: dict[str, Any], given: Mapping[str, Any]) -> int:
    """Print the devices that need a look; the exit code of the batch."""
    from selfcal.batch.fleet import show as table

    table(document, to_stderr=shared.to_stderr(given))
    return int(document["code"])
