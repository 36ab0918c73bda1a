"""Write the DBC file of one module, with its model's names and units."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from selfcal.base.errors import UserError
from selfcal.base.options import option
from selfcal.verbs._shared import ModelArgument


def dbc(
    model: ModelArgument,
    *,
    node: Annotated[int, option("The module's number on its bus, 0 to 11", metavar="N")] = 0,
    output: Annotated[
        Path | str | None, option("File to write; default: stdout", "-o", "--output", metavar="FILE")
    ] = None,
) -> str:
    """The DBC file of node `node` that runs the model file `model`, written to `output` or stdout.

    Its messages and signals have the model's names of hypotheses, parameters and regressor columns, with their units.
    Raises UserError for a node that there is not, or a model that telemetry has no messages for.
    """
    from selfcal.base.output import check_writable, write_text
    from selfcal.model.file import Model
    from selfcal.wire.dbc_file import check_node
    from selfcal.wire.dbc_file import dbc_text as text_of
    from selfcal.wire.frames import AXES, axis_unit, carries, wire_names

    check_node(node)
    check_writable(output)
    loaded = Model.load(model)
    axes = [axis for axis in loaded.axes if carries(axis, loaded.group_of(axis).unit)]
    if not axes:
        known = ", ".join(f"{axis} [{axis_unit(axis)}]" for axis in AXES)
        raise UserError(f"{loaded.path}: telemetry carries none of its axes in the unit they have (it carries {known})")
    text = text_of(node, wire_names(loaded), axes)
    if output is None or str(output) == "-":
        sys.stdout.write(text)
    else:
        write_text(output, text)
    return text
