"""Write the model file of another part, from a recording at rest or its data sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from selfcal.base.errors import UserError
from selfcal.base.options import REQUIRED, argument, option
from selfcal.logs.loaders import READ, Reading

if TYPE_CHECKING:
    from selfcal.logs.recording import Data
    from selfcal.model.file import Model


def part(
    log: Annotated[
        Data, argument(f"Recording at rest: {READ}; or --datasheet alone", "[LOG...]", kind=list[Path])
    ] = (),
    output: Annotated[
        Path | str,
        option("Model file to write", "-o", "--output", metavar="MODEL.yaml", default=REQUIRED, show_default=False),
    ] = "part.yaml",
    *,
    name: Annotated[str | None, option("Of the part; default: the recording's", metavar="NAME")] = None,
    datasheet: Annotated[
        Sequence[str], option("Number of its data sheet, or gx.N=... (repeat for more)", metavar="N=0.012deg/sqrt(h)")
    ] = (),
    axes: Annotated[
        Sequence[str], option("Column that is an axis, beside gx to az (repeat for more)", "--axis", metavar="NAME")
    ] = (),
    **reading: Unpack[Reading],
) -> Model:
    """Write the model file of a part into `output`, and return the model.

    `datasheet`: texts `N=0.012deg/sqrt(h)`, `accel.N=...`, `gx.range=250deg/s`, of the keys in STATED and OF_PART. They
    go before the recording's numbers.
    Raises UserError for a recording that moved, a text that is none of these, and a file that cannot be written.
    """
    from selfcal.adequacy.part import parse_stated, part_text, tree_of
    from selfcal.base.output import check_writable, write_text
    from selfcal.base.units import SENSORS
    from selfcal.logs.recording import list_of, load
    from selfcal.model.file import Model

    given = not isinstance(log, Sequence) or len(log) > 0
    if not given and not datasheet:
        raise UserError("give a recording at rest, or numbers of a data sheet: --datasheet 'N=0.012deg/sqrt(h)'")
    check_writable(output, inputs=tuple(list_of(log)))
    stated = [parse_stated(text) for text in datasheet]
    recording = load(log, sensors=(*SENSORS, *axes), **reading) if given else None
    tree, said = tree_of(recording, axes, stated, name, reading.get("rate"))
    model = Model.of_tree(tree, Path(output))
    write_text(output, part_text(tree, recording, said))
    return model


def show(model: Model, given: Mapping[str, Any]) -> None:
    """Print what was written."""
    from selfcal.adequacy.part import show as lines

    lines(model)
