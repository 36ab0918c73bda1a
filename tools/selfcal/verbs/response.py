"""How an axis answers to a channel: gain, lag, order, frequency response, and which of the two acts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Unpack

from selfcal.base.errors import UserError
from selfcal.base.options import option
from selfcal.logs.loaders import Reading
from selfcal.verbs._shared import Gate, Json, Logs, ModelFile, to_stderr


def response(
    log: Logs,
    *,
    input: Annotated[
        Sequence[str],
        option("What acts: temp, supply or an axis; repeat for several that go together", "--input", metavar="CH"),
    ],
    output: Annotated[str, option("The axis that answers", metavar="AXIS", show_default=False)],
    model: ModelFile = None,
    decimate: Annotated[
        float | None, option("Rate of the block means; default: every sample, up to 20 000", metavar="HZ")
    ] = None,
    json: Json = None,
    plot: Annotated[
        Path | str | None, option("Save gain, phase and coherence (.png .pdf .svg)", metavar="FILE")
    ] = None,
    gate: Gate = False,
    **reading: Unpack[Reading],
) -> dict[str, Any]:
    """The answer of the axis `output` to the column `input`: temperature, supply or another axis. Of several, each
    answer is fitted together with those to the others.

    Returns the document `selfcal.response/1` and writes it to `json`; `plot` is of one input. Raises UserError for what
    the user can put right.
    """
    from selfcal.adequacy.identify_document import recording_entry
    from selfcal.base.output import check_picture, check_writable, write_json
    from selfcal.diagnosis.diagnose import BELOW_LATTICE
    from selfcal.diagnosis.record import record_from
    from selfcal.diagnosis.response import LINES, REFUSED_FROM, SAMPLES_MOST, SCHEMA, answers_of, inputs_of
    from selfcal.logs.recording import check_column, list_of, load
    from selfcal.model.file import Model
    from selfcal.readings.gate import gated

    check_writable(json, plot, inputs=(*list_of(log), model))
    check_picture(plot)
    loaded = Model.load(model)
    recording = load(log, **reading)
    recording = gated(recording, loaded) if gate else recording
    names = [input] if isinstance(input, str) else list(dict.fromkeys(input))
    if plot is not None and len(names) > 1:
        raise UserError("--plot is of one input: leave it out, or give one --input")
    for asked, name in (*(("--input", name) for name in names), ("--output", output)):
        check_column(recording, name, f"{asked}: ")
    if output in names:
        raise UserError(f"--input and --output are both {output}: give two columns")
    loaded.group_of(output)
    axes = [name for name in (output, *names) if name in loaded.axes]
    rate_hz = min(recording.clock_of(name).rate_hz for name in axes)
    if decimate is None and recording.duration_s * rate_hz > SAMPLES_MOST:
        decimate = SAMPLES_MOST / recording.duration_s
    record = record_from(recording, loaded, decimate, axes)
    for name in axes:
        if name not in record.axes:
            raise UserError(f"{recording.path}: {name}: {record.left_out[name]}")
    if record.present.size > REFUSED_FROM:
        raise UserError(f"{recording.path}: more than {REFUSED_FROM:,} samples at this rate: take a lower --decimate")
    if record.axes[output].below_lattice:
        raise UserError(f"{recording.path}: {output}: {BELOW_LATTICE}")
    inputs = {name: inputs_of(recording, record, name) for name in names}
    state = record.axes[output]
    # The model file may state an input's influence: it is the question here.
    state = state.refit(regressors=tuple(known for known in state.regressors if known.entry.get("column") not in names))
    parts = [
        {
            "input": {
                "column": name,
                "unit": given.unit,
                "reference": given.reference,
                **({"held_s": given.held_s, "taken": given.taken} if given.taken else {}),
            },
            "delay_resolution_s": max(state.dt, given.held_s if given.taken == LINES else 0.0),
            **answer,
        }
        for name, (answer, given) in answers_of(state, inputs).items()
    ]
    document = {
        "schema": SCHEMA,
        "recording": recording_entry(recording),
        "output": {"axis": output, "unit": state.unit},
        "judged_at_hz": record.rate_hz,
        **(parts[0] if len(parts) == 1 else {"inputs": parts}),
    }
    if plot is not None:
        from selfcal.show.plots import plot_response

        plot_response(document, plot)
    write_json(document, json)
    return document


def show(document: dict[str, Any], given: Mapping[str, Any]) -> None:
    """Print the answer in a few lines. A signal that came ends the command here."""
    from selfcal.base.ending import HeldSignals
    from selfcal.diagnosis.response import show as table

    for part in document.get("inputs", [document]):
        table({**document, **part}, to_stderr=to_stderr(given))
    HeldSignals().check()
