"""`selfcal dbc`: the DBC file of one module, with its model's names."""

from __future__ import annotations

import sys
from pathlib import Path

from selfcal.adequacy.document import check_writable
from selfcal.base.errors import UserError
from selfcal.base.output import write_text
from selfcal.model.file import Model
from selfcal.wire.dbc_file import COLUMNS, HYPOTHESES, NODES
from selfcal.wire.dbc_file import dbc as text_of
from selfcal.wire.frames import AXES, axis_unit, carries, names_of


def dbc(model: Path | str, *, node: int = 0, output: Path | str | None = None) -> str:
    """The DBC file of node `node` that runs the model file `model`, written to `output` or stdout.

    Its messages and signals have the model's names of hypotheses, parameters and regressor columns, with their units.
    Raises UserError for a node that there is not, or a model that telemetry has no room or no messages for.
    """
    if not 0 <= node < NODES:
        raise UserError(f"--node {node}: a bus has nodes 0 to {NODES - 1}")
    check_writable(output)
    loaded = Model.load(model)
    names = names_of(loaded)
    if len(names.hypotheses) > HYPOTHESES or len(names.columns) > COLUMNS:
        raise UserError(f"{loaded.path}: telemetry carries {HYPOTHESES} hypotheses and {COLUMNS} columns at most")
    axes = [axis for axis in loaded.axes if carries(axis, loaded.group_of(axis).unit)]
    if not axes:
        known = ", ".join(f"{axis} [{axis_unit(axis)}]" for axis in AXES)
        raise UserError(f"{loaded.path}: telemetry carries none of its axes in the unit they have (it carries {known})")
    text = text_of(node, names, axes)
    if output is None or str(output) == "-":
        sys.stdout.write(text)
    else:
        write_text(output, text)
    return text
