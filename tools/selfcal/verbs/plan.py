"""How long a part must be recorded, and at what rate, until what is wanted is known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from selfcal.base.errors import UserError
from selfcal.base.options import argument, option
from selfcal.logs.loaders import Reading
from selfcal.verbs._shared import PARTS, RECORD_S, Json, Scheduler, to_stderr

if TYPE_CHECKING:
    from selfcal.logs.recording import Data
    from selfcal.model.file import Model


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
    records: Annotated[int, option("Simulated parts", metavar="N")] = PARTS,
    seed: Annotated[int, option("Same seed, same parts", metavar="N", min=0)] = 1,
    plot: Annotated[Path | str | None, option("Save what is reached over the length", metavar="FILE")] = None,
    response: Annotated[
        str | None,
        option(
            "Plan an input for `response`: the gain and lag that are expected, as 0.05:150 (axis' unit per degC or V; "
            "s). Wishes: 'gain within 5 %', 'lag within 20 %'",
            metavar="GAIN:LAG",
        ),
    ] = None,
    levels: Annotated[
        str | None, option("With --response: least and most that the input can be, as 20:45", metavar="LOW:HIGH")
    ] = None,
    input_lag_s: Annotated[
        float, option("With --response: how late the input follows its set point, s", "--input-lag", metavar="S")
    ] = 60.0,
    input: Annotated[str, option("With --response: what is switched", metavar="CH")] = "temp",
    drive: Annotated[
        Path | str | None,
        option("With --response: set points over time, to drive a chamber by", "--drive", metavar="FILE.csv"),
    ] = None,
    json: Json = None,
    scheduler: Scheduler = None,
    **reading: Unpack[Reading],
) -> dict[str, Any]:
    """How long to record the part of a model file, so that SHARE of the records have each of the wishes `want`.

    Of a recording the part is made as `part` makes it; the options of a log are of that. A wish of a parameter is of
    the records whose law has it.
    `tumble`: how many rests of which length `selfcal tumble` takes: document `selfcal.plan_tumble/1`; wishes are those
    of `calibration/tumble_plan.py`.
    A wish of a coefficient, whose column is in proportion to its channel, has `cycling`: the swing of the channel that
    it takes over the longest of the other lengths, RECORD_S without any. A coefficient to 10 % is to a tenth of its
    prior's sd.
    With `response`: the shortest record in which SHARE of the parts have a gain and a lag as wanted, its input switched
    between the `levels`. The document has `bit_s`, `duration_s` and `set_points` then.
    Returns the document `selfcal.plan/1`: by wish the `duration_s`, null beyond LENGTH_MOST, and the `curve`; the
    longest `duration_s`, and `rates` with the lengths that other rates would take.
    """
    from selfcal.base.output import check_picture, check_writable, write_json
    from selfcal.batch.plan import SCHEMA, PlannedRecords, Wish, cycling, rates, refusal
    from selfcal.batch.spread import record_seeds
    from selfcal.diagnosis.separate import SHARE
    from selfcal.logs.recording import list_of
    from selfcal.model.regressors import coefficient_unit

    check_writable(json, plot, inputs=list_of(model))
    check_picture(plot)
    loaded = _model_of(model, axis, reading)
    if isinstance(want, str) or not want:
        raise UserError("--want: say what is wanted, as --want 'K within 20 %'")
    if tumble:
        from selfcal.calibration.tumble_plan import plan_of

        if plot is not None or axis is not None:
            raise UserError("--tumble plans all axes together, and has no picture: leave --axis and --plot out")
        answer = plan_of(loaded, want)
        write_json(answer, json)
        return answer
    name = axis or next(iter(loaded.simulate["axes"]), loaded.axes[0])
    group = loaded.group_of(name)
    columns = {regressor.name: regressor for regressor in loaded.regressors}
    sizes = {
        key: (coefficient_unit(group.unit, known.unit), known.sd.get(group.name, 1.0)) for key, known in columns.items()
    }
    if response is not None:
        return _response(
            loaded, name, want, response, levels, input_lag_s, input, drive, records, seed, json, scheduler
        )
    if levels is not None or drive is not None:
        raise UserError("--levels and --drive are for --response GAIN:LAG")
    wishes = [Wish.of(text, group.unit, sizes) for text in want]
    there = {parameter for law in loaded.laws.values() for parameter in law.parameters} | {"", "bias", *columns}
    for wish in wishes:
        if wish.parameter not in there:
            raise UserError(f"--want '{wish.text}': no law of {loaded.path} has {wish.parameter}")
        if wish.parameter in columns and (reason := refusal(loaded, name, columns[wish.parameter])):
            raise UserError(f"--want '{wish.text}': {reason}")
    seeds = record_seeds(records, seed)
    plain = replace(loaded, regressors=())
    ensemble = PlannedRecords(plain, name, wishes, seeds, scheduler)
    lengths = [None if wish.parameter in columns else ensemble.length(k) for k, wish in enumerate(wishes)]
    samples = max((known for known in lengths if known is not None), default=round(RECORD_S * loaded.bank_rate_hz))
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
    all_known = all(known["duration_s"] is not None for known in entries)
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
    write_json(document, json)
    if plot is not None:
        from selfcal.show.plots import plot_plan

        plot_plan(document, plot)
    return document


def _model_of(given: Data, axis: str | None, reading: Reading) -> Model:
    """The model file, or the part of a recording. Raises UserError."""
    from selfcal.logs.loaders import is_recording
    from selfcal.logs.recording import load
    from selfcal.model.file import Model

    if not isinstance(given, Path | str) or is_recording(given):
        from selfcal.adequacy.part import tree_of
        from selfcal.base.units import SENSORS

        sensors = SENSORS if axis is None else (*SENSORS, axis)
        recording = load(given, sensors=sensors, **reading)
        model = Model.of_tree(tree_of(recording, () if axis is None else (axis,))[0], recording.path)
    elif reading:
        raise UserError(f"{given}: the options of a recording (--rate, --column, --start ...) are for plan LOG")
    else:
        model = Model.load(given)
    if model.half_life_s:
        raise UserError(f"{model.path}: plan takes no half_life_s: leave it out of the model")
    return model


def _pair(option: str, text: str | None, said: str) -> tuple[float, float]:
    """Two numbers of an option. Raises UserError."""
    try:
        first, second = (float(part) for part in str(text).split(":"))
    except ValueError:
        raise UserError(f"{option}: takes {said}") from None
    if not (math.isfinite(first) and math.isfinite(second)):
        raise UserError(f"{option}: takes {said}")
    return first, second


def _response(
    model: Model, axis: str, want: Sequence[str], response: str, levels: str | None, input_lag_s: float, input: str,
    drive: Path | str | None, records: int, seed: int, json: Path | str | None, scheduler: str | None,
) -> dict[str, Any]:  # fmt: skip
    """The document of an input for `response`."""
    from selfcal.base.output import check_writable, write_json, write_text
    from selfcal.batch.design import TRIED_RECORDS, Experiment, designed
    from selfcal.batch.plan import SCHEMA, Wish
    from selfcal.batch.spread import record_seeds
    from selfcal.diagnosis.separate import SHARE
    from selfcal.logs.recording import SIDE_CHANNELS
    from selfcal.model.regressors import coefficient_unit

    check_writable(drive, json)
    units_of = dict(SIDE_CHANNELS.values())
    if input not in units_of:
        raise UserError(f"--input {input}: takes {' or '.join(units_of)}")
    gain, lag_s = _pair("--response", response, "the gain and the lag that are expected, as 0.05:150")
    low, high = _pair("--levels", levels, "least and most that the input can be, as 20:45")
    if gain == 0.0 or lag_s <= 0.0 or low >= high or not 0.0 <= input_lag_s < math.inf:
        raise UserError("--response takes a gain that is not 0, and a lag above 0; --levels LOW below HIGH")
    experiment = Experiment(gain, lag_s, (low, high), input_lag_s)
    sizes = {"gain": (coefficient_unit(model.group_of(axis).unit, units_of[input]), 1.0), "lag": ("s", 1.0)}
    wishes = [Wish.of(text, model.group_of(axis).unit, sizes) for text in want]
    for wish in wishes:
        if wish.parameter not in sizes or not wish.text.endswith("%"):
            raise UserError(f"--want '{wish.text}': with --response takes 'gain within 5 %' and 'lag within 20 %'")
    design = designed(model, axis, experiment, wishes, record_seeds(min(records, TRIED_RECORDS), seed), scheduler)
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "model": str(model.path),
        "axis": axis,
        "input": input,
        "share": SHARE,
        "rate_hz": model.bank_rate_hz,
        "levels": [low, high],
        "wishes": [wish.text for wish in wishes],
        **design,
    }
    if design["duration_s"] is not None:
        begins, points = experiment.set_points(design["bit_s"], design["duration_s"])
        rows = [*zip(begins.tolist(), points.tolist(), strict=True), (design["duration_s"], float(points[-1]))]
        document["set_points"] = [{"time_s": time_s, "value": value} for time_s, value in rows]
        if drive is not None:
            text = "".join(f"{time_s:.10g},{value:.10g}\n" for time_s, value in rows)
            write_text(drive, f"t[s],{input}[{units_of[input]}]\n{text}")
    elif drive is not None:
        raise UserError("no record that can be simulated suffices: wider --levels, or a wider --want")
    write_json(document, json)
    return document


def show(document: dict[str, Any], given: Mapping[str, Any]) -> None:
    """Print how long for each wish."""
    if "levels" in document:
        from selfcal.batch.design import show as table
    elif given.get("tumble"):
        from selfcal.calibration.tumble_plan import show as table
    else:
        from selfcal.batch.plan import show as table
    table(document, to_stderr=to_stderr(given))
