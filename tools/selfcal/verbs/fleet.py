"""`selfcal fleet`: many recordings at once, and the table of the units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Unpack

from rich.console import Console

from selfcal.adequacy.document import check_writable, write_json
from selfcal.base.errors import UserError, note, printable, short
from selfcal.batch.fail_on import check, outcome
from selfcal.batch.files import DATE_FORM, sources_of
from selfcal.batch.prior_file import lines_of as lines_of_priors
from selfcal.batch.prior_file import write_model as write_priors
from selfcal.batch.record import ByContent, Options, examined, killed, own_pages, settings_of
from selfcal.batch.spread import spread
from selfcal.batch.summary import document_of, lines_of, summed_up
from selfcal.batch.table import Unit, check_table, rows_of, write_table
from selfcal.batch.verdicts import FAIL, PASS, Judged, Limits, check_options, judge, unjudged, write
from selfcal.logs.loaders import Reading
from selfcal.model.file import Model
from selfcal.studies import montecarlo

SCHEMA = "selfcal.fleet/1"
#: Names that are printed of a kind at most.
MOST_NAMES = 40


def fleet(
    patterns: Sequence[Path | str],
    output: Path | str,
    *,
    serial_from: str | None = None,
    units_table: Path | str | None = None,
    diagnose: bool = False,
    fail_on: str | None = None,
    limits: Path | str | None = None,
    junit: Path | str | None = None,
    verdicts: Path | str | None = None,
    json: Path | str | None = None,
    report: Path | str | None = None,
    write_model: Path | str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    results: Path | str | None = None,
    axes: Sequence[str] = (),
    model: Path | str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    since_power_on_s: float = 0.0,
    gate: bool = False,
    **reading: Unpack[Reading],
) -> dict[str, Any]:
    """Identify every recording of the batch and write the table `output`, .csv or .parquet.

    `patterns`: files, or patterns as 'logs/**/*.ulg'. `serial_from`: 'name', the file's; 'name:PATTERN', what a regular
    expression finds in the path; 'field', the recording's metadata. `units_table`: a CSV of file, device, station, lot
    and date. `diagnose`: the causes too. `fail_on`: see fail_on.py; a cause needs `diagnose`.
    `limits`: a file of limits (verdicts.py), `junit` and `verdicts`: the files of their verdicts.
    `workers`: processes here, one for each processor by default; `scheduler`: a Dask scheduler's address instead.
    `results`: the folder that keeps finished recordings, OUTPUT.parts by default: a run that was stopped goes on, and a
    changed file is done anew. The other options are those of `identify`, for each recording.
    Returns the document `selfcal.fleet/1`, and writes it to `json`: by device what failed, what could not be judged,
    and the exit `code`; the `population`, each unit's estimates by it, and the units `unlike` it.
    `report`: the page to write. With `diagnose`, devices that need a look have an own page in `report`.units.
    `write_model`: the model file with the batch's priors (batch/prior_file.py).
    Raises UserError for what the user can put right; a broken recording is a row of the table.
    """
    check_table(output)
    dbc = reading.get("dbc")
    check_options(limits, junit, verdicts)
    check_writable(output, junit, verdicts, json, report, write_model, inputs=(model, units_table, dbc, limits))
    check(fail_on)
    if fail_on is not None and fail_on != "inadequate" and not diagnose:
        raise UserError(f"--fail-on {fail_on}: give --diagnose too, which looks for causes")
    loaded = Model.load(model)
    for name in axes:
        loaded.group_of(name)
    bounds = None if limits is None else Limits.load(limits, loaded)
    folder = Path(f"{output}.parts") if results is None else Path(results)
    given = {Path(str(one)).resolve() for one in patterns}
    outputs = [Path(one) for one in (output, junit, verdicts, json, report, write_model) if one is not None]
    for one in outputs:
        if one.resolve() in given:
            raise UserError(f"{one}: is one of the recordings: give it a name of its own")
    own_files = [
        *outputs,
        folder,
        Path(f"{report}.units"),
        *(Path(one) for one in (model, limits, units_table) if one is not None),
    ]
    named = sources_of([str(one) for one in patterns], units_table, serial_from, own_files)
    for copy, other in named.copies.items():
        note(f"{copy}: the same recording as {other}: counted once")
    options = Options(
        None if model is None else str(Path(model).absolute()),
        tuple(axes),
        diagnose,
        {**reading, **({} if dbc is None else {"dbc": str(Path(dbc).absolute())})},
        {"start_s": start_s, "end_s": end_s, "since_power_on_s": since_power_on_s, "gate": gate},
    )
    version = _version()
    keeper = ByContent(folder, settings_of(options, montecarlo.settings_of(loaded), version))
    own = [one for one in named.sources if not one.copy_of]
    found = spread(
        partial(examined, options),
        [(str(Path(one.path).absolute()), one.content) for one in own],
        settings={},
        piece=1,
        scheduler=scheduler,
        results=keeper,
        count=workers,
        lost=killed,
        weights=[one.size + 1.0 for one in own],
        verb="fleet",
    )
    record_of = dict(zip((one.path for one in own), found, strict=True))
    batch = [
        Unit(one, record_of.get(one.path, {"error": f"is the same recording as {one.copy_of}"}))
        for one in named.sources
    ]
    for unit in batch:
        if unit.undated:
            note(f"{unit.source.path}: leaves out the date '{short(unit.undated)}': write it as {DATE_FORM}")
        if "damaged" in (known := unit.record.get("recording", {})):
            note(f"{unit.source.path}: {known['damaged']['words']}")
    batch.sort(key=lambda unit: unit.place)
    write_table(output, (row for unit in batch for row in rows_of(unit, version)))
    judged = [] if bounds is None else _judged(batch, bounds)
    if bounds is not None:
        write(judged, junit, verdicts)
    summary = summed_up(batch, loaded)
    document = {**_document(batch, fail_on, judged), **document_of(summary), "words": list(lines_of(summary))}
    if write_model is not None:
        document["words"] += lines_of_priors(write_priors(write_model, loaded, summary), loaded)
    if json is not None:
        write_json(document, json)
    if report is not None:
        from selfcal.batch.page import write_page

        flagged = [*document["failed"], *document["unlike"], *document["drifting"]]
        pages = own_pages(f"{report}.units", flagged, summary.devices, options, keeper, workers) if diagnose else {}
        write_page(report, document, summary, pages)
    return document


def _version() -> str:
    import selfcal

    return str(selfcal.__version__)


def _judged(batch: Sequence[Unit], limits: Limits) -> list[Judged]:
    """The verdicts of each recording. A group's limit holds for the axes that any recording of the batch has."""
    stated = limits.of({name for unit in batch for name in unit.axes})
    return [
        (
            unit.device,
            unit.source.path,
            judge(stated, unit.axes, unit.record["recording"]["duration_s"])
            if unit.error is None
            else unjudged(stated, unit.error),
        )
        for unit in batch
    ]


def _document(batch: Sequence[Unit], fail_on: str | None, judged: Sequence[Judged]) -> dict[str, Any]:
    """What the batch comes to, by device."""
    failed: dict[str, list[str]] = {}
    open_: dict[str, list[str]] = {}
    for unit in batch:
        for axis, reason in unit.errors.items():
            open_.setdefault(unit.device, []).append(f"{axis}: {reason}" if axis else reason)
        if fail_on is not None and unit.error is None:
            shown, lines = _by_cause(unit, fail_on)
            if shown:
                failed.setdefault(unit.device, []).append(f"{fail_on}: {', '.join(shown)}")
            elif lines:
                open_.setdefault(unit.device, []).extend(lines)
    broken = {unit.source.path for unit in batch if unit.error is not None}  # listed with their errors
    for device, path, verdicts in judged:
        for one in verdicts:
            if one.verdict != PASS and path not in broken:
                (failed if one.verdict == FAIL else open_).setdefault(device, []).append(one.words)
    devices = dict.fromkeys(unit.device for unit in batch)
    return {
        "schema": SCHEMA,
        "devices": len(devices),
        "recordings": len(batch),
        "failed": failed,
        "not_judged": {device: list(dict.fromkeys(lines)) for device, lines in open_.items()},
        "limits": [
            {"device": device, "recording": path, **one.entry()}
            for device, path, verdicts in judged
            for one in verdicts
        ],
        "code": 1 if failed else 2 if open_ else 0,
    }


def _by_cause(unit: Unit, fail_on: str) -> tuple[list[str], list[str]]:
    """The axes that show it, and why others cannot be judged."""
    shown, lines = [], []
    diagnosis = unit.record.get("diagnosis", {})
    for name, axis in unit.axes.items():
        if "error" not in axis:
            found = outcome({"axes": {name: diagnosis.get(name, axis)}}, fail_on)
            shown += [name] if found.code == 1 else []
            lines += found.lines
    return shown, lines


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """What a person reads: how many, and by name the devices that need a look."""
    console = Console(stderr=to_stderr)
    for line in _lines(document):
        console.print(printable(line), highlight=False, markup=False, soft_wrap=True)


def _lines(document: Mapping[str, Any]) -> Iterator[str]:
    yield f"{document['recordings']} recordings of {document['devices']} devices"
    yield from document["words"]
    yield from _listed("unlike the batch", document["unlike"])
    yield from _listed("drifting", document["drifting"])
    yield from _listed("failed", document["failed"])
    yield from _listed("not judged", document["not_judged"])


def _listed(what: str, devices: Mapping[str, Sequence[str]]) -> Iterator[str]:
    for device, reasons in list(devices.items())[:MOST_NAMES]:
        yield f"{what}: {device}: {'; '.join(reasons)}"
    if len(devices) > MOST_NAMES:
        yield f"{what}: {len(devices) - MOST_NAMES} more: the table names them"
