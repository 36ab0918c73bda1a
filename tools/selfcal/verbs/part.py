"""Write the model file of another part, from a recording at rest or its data sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from selfcal.base.errors import UserError
from selfcal.base.options import REQUIRED, argument, option
from selfcal.logs.loaders import READ, Reading
from selfcal.verbs._shared import End, Start

if TYPE_CHECKING:
    from selfcal.model.file import Model


def part(
    log: Annotated[
        Sequence[Path | str], argument(f"Recording at rest: {READ}; or --datasheet alone", "[LOG...]", kind=list[Path])
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
        Sequence[str],
        option("Column that is an axis, beside gx to az (repeat for more)", "--axis", metavar="NAME"),
    ] = (),
    start_s: Start = None,
    end_s: End = None,
    **reading: Unpack[Reading],
) -> Model:
    """Write the model file of a part into `output`, and return the model.

    `log`: a recording at rest; none: by the data sheet alone. `datasheet`: texts `N=0.012deg/sqrt(h)`, `accel.N=...`,
    `gx.range=250deg/s`, of the keys in STATED and OF_PART. They go before the recording's numbers. `axes`: columns that
    are axes, where they are not gx to az. The other options are `load`'s.
    Raises UserError for a recording that moved, a text that is none of these, and a file that cannot be written.
    """
    import yaml

    from selfcal.bank.part import as_text, finish, groups, of_recording, of_sheet, parse
    from selfcal.base.output import check_writable, write_text
    from selfcal.base.units import SENSORS
    from selfcal.logs.recording import list_of, load
    from selfcal.model.file import DEFAULT, Model

    if not log and not datasheet:
        raise UserError("give a recording at rest, or numbers of a data sheet: --datasheet 'N=0.012deg/sqrt(h)'")
    check_writable(output, inputs=tuple(list_of(log)) if log else ())
    stated = [parse(text) for text in datasheet]
    recording = None
    if log:
        recording = load(log, sensors=(*SENSORS, *axes), **reading).between(start_s, end_s)
        for axis in axes:
            if axis not in recording.columns:
                there = ", ".join(recording.columns)
                raise UserError(f"{recording.path}: there is no column '{axis}' (there are {there})")
    tree = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    base = Model.load()
    said: list[str] = []
    if recording is not None:
        tree["groups"] = groups(tree["groups"], recording, axes)
        tree["gate"]["N"] = dict.fromkeys(tree["groups"], 1.0)  # until N is known
        said += of_recording(tree, recording)
    else:
        rate = reading.get("rate")
        if rate is None and not any(one.key == "rate" for one in stated):
            raise UserError("without a recording the part's rate is needed: --datasheet rate=200Hz")
        tree["sensor"] = {"name": "", "rate_hz": rate, "filter_taps": 1}
        for group in tree["groups"].values():
            group |= {"range": 0.0, "lsb": 0.0}
    said += of_sheet(tree, stated, recording is not None)
    finish(tree, name or (recording.path.name.partition(".")[0] if recording is not None else "part"), base)
    model = Model.of_tree(tree, Path(output))
    write_text(output, as_text(tree, recording, said))
    return model


def show(model: Model, given: Mapping[str, Any]) -> int:
    """Print what was written."""
    from selfcal.bank.part import show as lines

    lines(model)
    return 0
