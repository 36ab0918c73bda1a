"""How long a part must be recorded, and at what rate, until what is wanted is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from selfcal.base.errors import UserError
from selfcal.base.options import argument, option
from selfcal.logs.loaders import Reading
from selfcal.verbs._shared import End, Json, Scheduler, Start, to_stderr

if TYPE_CHECKING:
    from selfcal.logs.recording import Data


def plan(
    model: Annotated[
        Data, argument("Model file of the part, or a recording of it at rest", "MODEL.yaml|LOG", kind=Path)
    ],
    *,
    want: Annotated[
        Sequence[str],
        option(
            "'K within 20 %', 'bias within 0.001 deg/s', 'law decided 95 %', 'temperature within 10 %' (repeat)",
            metavar="WISH",
        ),
    ],
    tumble: Annotated[
        bool, option("Plan `selfcal tumble`: wishes as 'scale within 100 ppm', 'angle within 0.2 mrad'")
    ] = False,
    axis: Annotated[
        str | None, option("Axis of the part; default: the first that `simulate` states", metavar="NAME")
    ] = None,
    records: Annotated[int, option("Simulated parts", metavar="N")] = 200,
    seed: Annotated[int, option("Same seed, same parts", metavar="N", min=0)] = 1,
    plot: Annotated[Path | str | None, option("Save what is reached over the length", metavar="FILE")] = None,
    json: Json = None,
    scheduler: Scheduler = None,
    start_s: Start = None,
    end_s: End = None,
    **reading: Unpack[Reading],
) -> dict[str, Any]:
    """How long to record the part of a model file, so that SHARE of the records have each of the wishes `want`.

    `model`: a model file, or a recording, of which the part is made as `part` makes it; `start_s`, `end_s` and the
    other options are the recording's. `axis`: the first that the `simulate` entry states, else the first of all. A wish
    of a parameter is of the records whose law has it. `plot`: a picture of what is reached over the length.
    `tumble`: how many rests of which length `selfcal tumble` takes: document `selfcal.plan_tumble/1`; wishes are those
    of `calibration/plan.py`.
    A wish of a coefficient, whose column is in proportion to its channel, has `cycling`: the swing of the channel that
    it takes over the longest of the other lengths, SWEEP_S without any. A coefficient to 10 % is to a tenth of its
    prior's sd.
    Returns the document `selfcal.plan/1`: by wish the `duration_s`, null beyond MOST bank samples, and the `curve`; the
    longest `duration_s`, and `rates` with the lengths that other rates would take.
    """
    from selfcal.base.output import check_picture, check_writable, write_json
    from selfcal.batch.plan import SCHEMA, SHARE, SWEEP_S, Ensemble, Wish, cycling, picture, rates, refusal
    from selfcal.batch.spread import record_seeds
    from selfcal.logs.loaders import is_recording
    from selfcal.logs.recording import list_of, load
    from selfcal.model.file import Model
    from selfcal.model.regressors import coefficient_unit

    check_writable(json, plot, inputs=list_of(model))
    if plot is not None:
        check_picture(plot)
    if not isinstance(model, Path | str) or is_recording(model):
        from selfcal.adequacy.part import tree_of
        from selfcal.base.units import SENSORS

        sensors = SENSORS if axis is None else (*SENSORS, axis)
        recording = load(model, sensors=sensors, **reading).between(start_s, end_s)
        loaded = Model.of_tree(tree_of(recording, () if axis is None else (axis,))[0], recording.path)
    elif reading or start_s is not None or end_s is not None:
        raise UserError(f"{model}: the options of a recording (--rate, --column, --start ...) are for plan LOG")
    else:
        loaded = Model.load(model)
    if loaded.half_life_s:
        raise UserError(f"{loaded.path}: plan takes no half_life_s: leave it out of the model")
    if isinstance(want, str) or not want:
        raise UserError("--want: say what is wanted, as --want 'K within 20 %'")
    if tumble:
        from selfcal.calibration.plan import plan_of

        if plot is not None or axis is not None:
            raise UserError("--tumble plans all axes together, and has no picture: leave --axis and --plot out")
        answer = plan_of(loaded, want)
        if json is not None:
            write_json(answer, json)
        return answer
    name = axis or next(iter(loaded.simulate["axes"]), loaded.axes[0])
    group = loaded.group_of(name)
    columns = {one.name: one for one in loaded.regressors}
    sizes = {key: (coefficient_unit(group.unit, one.unit), one.sd.get(group.name, 1.0)) for key, one in columns.items()}
    wishes = [Wish.of(text, group.unit, sizes) for text in want]
    there = {parameter for law in loaded.laws.values() for parameter in law.parameters} | {"", "bias", *columns}
    for wish in wishes:
        if wish.parameter not in there:
            raise UserError(f"--want '{wish.text}': no law of {loaded.path} has {wish.parameter}")
        if wish.parameter in columns and (reason := refusal(loaded, name, columns[wish.parameter])):
            raise UserError(f"--want '{wish.text}': {reason}")
    seeds = record_seeds(records, seed)
    plain = replace(loaded, regressors=())
    ensemble = Ensemble(plain, name, wishes, seeds, scheduler)
    lengths = [None if wish.parameter in columns else ensemble.length(k) for k, wish in enumerate(wishes)]
    samples = max((one for one in lengths if one is not None), default=round(SWEEP_S * loaded.bank_rate_hz))
    entries = []
    for k, wish in enumerate(wishes):
        column = columns.get(wish.parameter)
        length = lengths[k] if column is None else samples
        entry = {
            "wish": wish.text,
            "duration_s": None if length is None else length / loaded.bank_rate_hz,
            "most": wish.most,
            "curve": ensemble.curve(k) if column is None else [],
        }
        if column is not None:
            swings = cycling(loaded, name, wish, column, samples, seeds, scheduler)
            entry |= {"channel": column.column, "unit": column.channel_unit, "cycling": swings}
        entries.append(entry)
    all_known = all(one["duration_s"] is not None for one in entries)
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "model": str(loaded.path),
        "axis": name,
        "records": records,
        "share": SHARE,
        "rate_hz": loaded.bank_rate_hz,
        "duration_s": samples / loaded.bank_rate_hz if all_known else None,
        "wishes": entries,
        "rates": rates(loaded, wishes, lengths, ensemble.typical),
    }
    if json is not None:
        write_json(document, json)
    if plot is not None:
        picture(document, plot)
    return document


def show(document: dict[str, Any], given: Mapping[str, Any]) -> int:
    """Print how long for each wish."""
    if given.get("tumble"):
        from selfcal.calibration.plan import show as table
    else:
        from selfcal.batch.plan import show as table
    table(document, to_stderr=to_stderr(given))
    return 0
