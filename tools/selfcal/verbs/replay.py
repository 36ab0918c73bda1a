"""Run the firmware itself over a recording and watch its telemetry."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Literal, Unpack

from selfcal.base.errors import UserError, note, say_once
from selfcal.base.options import option
from selfcal.logs.loaders import Reading
from selfcal.verbs import _shared as shared

if TYPE_CHECKING:
    from selfcal.show.results import Identification


def replay(
    log: shared.Logs,
    *,
    axes: shared.Axes = (),
    model: shared.ModelFile = None,
    start: shared.From = None,
    target: Annotated[
        Literal["host", "cortex-m4f", "cortex-m0"], option("Where the firmware runs: here, or in QEMU")
    ] = "host",
    transport: Annotated[
        Literal["slcan", "can"] | None, option("Compile a program for this machine, whose frames travel so")
    ] = None,
    channel: Annotated[
        str, option("With --transport can: a CAN device; default: UDP on this machine", metavar="NAME")
    ] = "",
    report_every: Annotated[
        float | None, option("Seconds between reports; default: 100 in all, fewer in QEMU", metavar="S")
    ] = None,
    gate: shared.Gate = False,
    since_power_on_s: shared.SincePowerOn = 0.0,
    json: shared.Json = None,
    plot: shared.RunPlot = None,
    **reading: Unpack[Reading],
) -> Identification:
    """Run the firmware over a recording; returns the document of contract `selfcal.identify/1`, written to `json`.

    A firmware is compiled if it is not there yet. The frames of a program for this machine leave by `slcan` over a
    pseudo-terminal, or by `can`: UDP within this machine at the pace of a bus of 500 kbit/s, or the CAN device
    `channel`. `report_every` is one bank interval at least. With `gate`, time passes as a gap while the sensor moves.
    The firmware's clock begins at `start_s`. Numbers are in the recording's units. Raises UserError for what the user
    can put right.
    """
    from selfcal.adequacy.identify import chosen_axes
    from selfcal.bank.priors import add_sources, for_record
    from selfcal.base.output import check_picture, check_writable, write_json
    from selfcal.diagnosis.warm import load_start
    from selfcal.logs.recording import list_of, load
    from selfcal.model.file import Model
    from selfcal.model.regressors import from_time
    from selfcal.readings.gate import gate_of_recording as gate_of
    from selfcal.show.results import Identification
    from selfcal.show.run_plot import plot_run
    from selfcal.wire.frames import wire_names
    from selfcal.wire.on_wire import places, sent
    from selfcal.wire.replay import LONGEST_PERIOD_S, TARGETS, build, run_firmware, wire_document

    if target not in TARGETS:
        raise UserError(f"--target {target}: no such target (there are {', '.join(TARGETS)})")
    if transport not in (None, "slcan", "can"):
        raise UserError(f"--transport {transport}: no such transport (there are slcan, can)")
    if transport == "can" and TARGETS[target].board:
        raise UserError("--transport can: an emulated board has a serial line alone; take --target host")
    if channel and transport != "can":
        raise UserError(f"--channel {channel}: goes with --transport can")
    if report_every is not None and not 0.0 < report_every <= LONGEST_PERIOD_S:
        raise UserError(f"--report-every must be above 0 s, {LONGEST_PERIOD_S:g} s at most, not {report_every:g}")
    check_picture(plot)
    check_writable(json, plot, inputs=(*list_of(log), model, start))
    loaded_model = Model.load(model)
    for text in loaded_model.left_out:
        say_once(text)
    known = None if start is None else load_start(start, loaded_model)
    recording = load(log, sensors=loaded_model.sensors, **reading)
    recording = recording.later(since_power_on_s)
    known_s = recording.start_s
    loaded_model = replace(loaded_model, regressors=from_time(loaded_model.regressors, known_s))
    recording = replace(recording, start_s=0.0).later(since_power_on_s + known_s)  # as the firmware has it
    names = chosen_axes(recording, loaded_model, axes)
    recording = recording.along(*names)
    taken = places(loaded_model, names)
    foreign = [name for name in names if taken[name] != name]
    if foreign and target != "host":
        raise UserError(f"--target {target}: its images have no axis {', '.join(foreign)}; take --target host")
    of_file = loaded_model
    if known is None:
        loaded_model = for_record(loaded_model, recording, names)
    if gate:
        gate_of(recording, loaded_model, tuple(names))
    sent_model, rows = sent(loaded_model, recording, taken) if foreign else (loaded_model, recording)
    on_wire = list(taken.values())
    here = target == "host" and transport is None
    firmware = None if here else build(sent_model, recording.rate_hz, on_wire, target, start=known)
    how = transport or "slcan"
    reports, said = run_firmware(firmware, rows, sent_model, on_wire, report_every, target, gate, how, channel, known)
    history = {
        name: [replace(report, axis=name) for report in reports[sent_as]]
        for name, sent_as in taken.items()
        if sent_as in reports
    }
    why = {name: said[sent_as] for name, sent_as in taken.items() if sent_as in said}
    document = wire_document(recording, loaded_model, history, why, gate)
    add_sources(document, of_file, loaded_model)
    document["recording"] |= {"start_s": known_s, "since_power_on_s": since_power_on_s}
    write_json(document, json)
    if plot is not None:
        simulated = bool(recording.meta.get("simulated"))
        title = f"{recording.path.name}{' (SIMULATED)' if simulated else ''}: the firmware's telemetry"
        truth = recording.meta.get("truth") if simulated else None
        units = {name: recording.columns[name].unit for name in history}
        own = {name: loaded_model.group_of(name).unit for name in history}
        known_truth = truth if isinstance(truth, dict) else None
        plot_run(history, plot, title, known_truth, units, wire_names(loaded_model), sent_in=own)
        note(f"plot: {plot}")
    return Identification(document)


show = shared.shown_by("show.identification")
