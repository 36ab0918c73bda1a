"""Write the C model tables for the firmware."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from selfcal.base.options import option
from selfcal.verbs._shared import From, ModelArgument

if TYPE_CHECKING:
    from selfcal.model.tables import Tables


def codegen(
    model: ModelArgument,
    output: Annotated[Path | str, option("Folder for them", "-o", "--output", metavar="DIR", show_default=False)],
    *,
    target: Annotated[str, option("Whose node counts of the model file")] = "host",
    rate: Annotated[
        float | None, option("Rate of the samples that are fed; default: the sensor's", metavar="HZ")
    ] = None,
    axes: Sequence[str] | None = None,
    start: From = None,
    hold: Annotated[
        bool, option("No sample overtakes a report: it rests on a copy, which takes RAM", "--hold")
    ] = False,
) -> Tables:
    """Write `selfcal_model.h`, `selfcal_model.c` and `selfcal_config.h` into the folder `output`; return the tables.

    `axes` is a subset of the model's. Says on stderr what of the model is left out.
    Raises UserError for a bad model file, one that the target has no RAM for, or a folder that cannot be written.
    """
    from selfcal.base.output import print_lines
    from selfcal.diagnosis.warm import load_start, warmed
    from selfcal.model.file import Model
    from selfcal.model.tables import make_tables
    from selfcal.wire.c_tables import check_room, unused, write_tables

    loaded = Model.load(model)
    known = None if start is None else load_start(start, loaded)
    tables = make_tables(loaded, loaded.sensor_rate_hz if rate is None else rate, tuple(axes) if axes else None, target)
    tables = warmed(tables, known)
    check_room(loaded, tables, target, hold)
    write_tables(loaded, tables, Path(output), target, known.of if known is not None else "", hold)
    print_lines(unused(loaded, tables, target), to_stderr=True)
    return tables


def show(tables: Tables, given: Mapping[str, Any]) -> None:
    """Print what the tables take for granted."""
    from selfcal.wire.c_tables import assumption

    print(f"{given['output']}: {assumption(tables)}")
