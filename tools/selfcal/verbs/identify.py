"""`selfcal identify`: hypothesis probabilities, parameters with intervals and the bias of a recording at rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from selfcal import _library32
from selfcal.blocks import MOST_DENSE, usable_blocks
from selfcal.checks import innovation_checks
from selfcal.document import Identified, to_document, write_json
from selfcal.errors import UserError
from selfcal.export import FORMS, write_export
from selfcal.model import Model
from selfcal.recording import Recording, Scale, as_float, load
from selfcal.regressors import choices_of, columns_of, combine, mask_of, offered
from selfcal.result import AxisResult, in_unit
from selfcal.tables import make_tables


def identify(
    log: Path | str,
    *,
    axes: Sequence[str] = (),
    model: Path | str | None = None,
    engine: str = "library",
    decimate: float | None = None,
    json: Path | str | None = None,
    export: tuple[str, Path | str] | None = None,
    rate: float | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    scale: Mapping[str, Scale] | None = None,
) -> dict[str, Any]:
    """Identify the axes of a recording; returns the document `selfcal.identify/1` and writes it to `json`.

    `engine`: 'library' (the firmware's C code in float, one bank an axis), 'fixed' (its form for parts without an FPU,
    by 16-bit products) or 'reference' (the textbook bank in double, its grid refined until the probabilities settle).
    `decimate`: rate of the block means in Hz, else the model's.
    `export`: a format of `selfcal.export` and the file to write.
    Numbers are in the recording's units. Raises UserError for what the user can put right.
    """
    if export is not None and export[0] not in FORMS:
        raise UserError(f"--export: there is no format '{export[0]}' ({', '.join(FORMS)})")
    if engine not in ("library", "reference", "fixed"):
        raise UserError(f"there is no engine '{engine}' (library, reference, fixed)")
    if decimate is not None and not (math.isfinite(decimate) and decimate > 0.0):
        raise UserError("--decimate must be a rate above 0 Hz")
    loaded_model = Model.load(model)
    recording = load(log, rate=rate, columns=columns or {}, units=units or {}, scale=scale)
    names = chosen_axes(recording, loaded_model, [axes] if isinstance(axes, str) else axes)
    found: dict[str, Identified] = {}
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        subsets = sum(len(choices_of(offered(loaded_model, name))) for name in names)
        task = progress.add_task("identify", total=subsets)
        for name in names:
            progress.update(task, description=f"{name} ({engine})")
            try:
                found[name] = identify_axis(
                    recording, name, loaded_model, engine, decimate, lambda: progress.advance(task)
                )
            except UserError as error:
                raise UserError(f"{recording.path}: column {name}: {error}") from error
    document = to_document(recording, found)
    if json is not None:
        write_json(document, json)
    if export is not None:
        write_export(document, *export)
    return document


def chosen_axes(recording: Recording, model: Model, wanted: Sequence[str]) -> tuple[str, ...]:
    """The axes to work on, in the model's order: those asked for, else all that the recording has."""
    for name in wanted:
        model.group_of(name)
        if name not in recording.columns:
            raise UserError(f"{recording.path}: there is no column '{name}' (there are {', '.join(recording.columns)})")
    names = tuple(name for name in model.axes if name in (wanted or recording.columns))
    if not names:
        raise UserError(
            f"{recording.path}: none of its columns ({', '.join(recording.columns)}) is an axis of the model "
            f"({', '.join(model.axes)}); map one with --column gx=NAME"
        )
    return names


def identify_axis(
    recording: Recording,
    name: str,
    model: Model,
    engine: str,
    decimate: float | None,
    advance: Callable[[], object] = lambda: None,
) -> Identified:
    """One axis by one engine. The record is fed as float32, as the firmware gets it. With regressors every subset of
    them is scored; `advance` is called after each."""
    group = model.group_of(name)
    regressors = offered(model, name)
    tables = make_tables(replace(model, regressors=regressors), recording.rate_hz, (name,), bank_rate_hz=decimate)
    samples = as_float(recording.in_unit(name, group.unit))
    columns = as_float(columns_of(regressors, recording))
    for name_of, column in zip([column.name for column in tables.regressors], columns.T, strict=True):
        beyond = np.abs(column) >= _library32.SAMPLE_MAX
        if beyond.any():
            raise UserError(f"the regressor {name_of} is {column[beyond][0]:g} at {int(beyond.sum())} samples")
    blocks = usable_blocks(samples, recording.missing_before, tables, group, columns)
    if engine == "reference" and model.half_life_s:
        raise UserError("the reference bank forgets nothing: take --engine library, or a model without half_life_s")
    choices = choices_of(regressors)
    results: list[AxisResult] = []
    z = blocks.z - np.array([column.reference for column in tables.regressors])
    sd = np.array([column.coefficient_sd[0] for column in tables.regressors])
    if engine in ("library", "fixed"):
        from selfcal.engines.library import Bank

        bank = Bank(tables, fixed=16 if engine == "fixed" else None)
        bank.push(samples[:, None], recording.missing_before, columns if regressors else None)
        for choice in choices:
            results.append(bank.report(0, mask_of(regressors, choice)))
            advance()
    else:
        from selfcal.engines import reference

        if blocks.mean.size > MOST_DENSE:
            raise UserError(f"{blocks.mean.size} bank intervals, gaps included, are too many for the reference")
        for choice in choices:
            used = _used(mask_of(regressors, choice))
            with_columns = (z[:, used], sd[used].tolist()) if used else ()
            results.append(
                reference.identify_axis(blocks.mean, tables.dt_s, group, model.hypotheses, blocks.r, *with_columns)
            )
            advance()
    unit = recording.columns[name].unit
    if not regressors:
        checks = innovation_checks(blocks, tables, group, results[0], [])
        return Identified(unit, in_unit(results[0], group.unit, unit), checks, blocks.kept_out)
    if not any(math.isfinite(value) for result in results for value in result.log_evidence.values()):
        from selfcal.engines.library import outside_priors

        raise UserError(outside_priors(tables.axes[0]))
    inside = combine(choices, results, model.hypotheses, group.unit)
    used = _used(mask_of(regressors, choices[inside.best]))
    checks = innovation_checks(blocks, tables, group, results[inside.best], used)
    scored = combine(choices, [in_unit(result, group.unit, unit) for result in results], model.hypotheses, unit)
    return Identified(unit, scored.result, checks, blocks.kept_out, scored)


def _used(mask: int) -> list[int]:
    return [k for k in range(mask.bit_length()) if mask >> k & 1]
