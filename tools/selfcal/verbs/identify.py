"""Probability of each drift law, noise parameters with intervals, and the bias of a recording at rest."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Unpack

from selfcal.base.errors import UserError, say_once
from selfcal.base.options import option
from selfcal.logs.loaders import Reading
from selfcal.verbs import _shared as shared

if TYPE_CHECKING:
    from selfcal.likelihood.state import Look
    from selfcal.logs.recording import Recording
    from selfcal.model.file import Model
    from selfcal.show.results import Identification

#: Checks whose readings are left out already: what is left is judged, and suspected.
LEFT_OUT = {"motion"}


@shared.on_a_line
def identify(
    log: shared.Logs,
    *,
    axes: shared.Axes = (),
    model: shared.ModelFile = None,
    engine: Annotated[Literal["library", "reference", "fixed"], option("What computes")] = "library",
    decimate: shared.Decimate = None,
    json: shared.Json = None,
    plot: Annotated[
        Path | str | None, option("Save the Allan deviations beside the model's (.png .pdf .svg)", metavar="FILE")
    ] = None,
    datasheet: Annotated[
        bool,
        option(
            "Of table and plot: the recording's, or deg/sqrt(h), deg/h, ug as data sheets",
            "--units",
            kind=Literal["recording", "datasheet"],
            made="datasheet".__eq__,
            default="recording",
        ),
    ] = False,
    export: Annotated[
        tuple[str, Path | str] | None,
        option(
            "Write noise parameters for kalibr, rotors, px4, orbslam3, vins, openvins or allan_variance_ros",
            metavar="FORMAT FILE",
            kind=tuple[str, Path],
        ),
    ] = None,
    overbound: Annotated[
        float | None,
        option("Export white noise and walk above the recording's Allan deviation, at P (0.95)", metavar="P"),
    ] = None,
    suspicion: Annotated[
        bool,
        option("No second look at the axes that are not adequate", "--no-suspicion", kind=bool, made=operator.not_),
    ] = True,
    fail_on: shared.FailOn = None,
    limits: shared.LimitsFile = None,
    junit: shared.Junit = None,
    verdicts: shared.Verdicts = None,
    since_power_on_s: shared.SincePowerOn = 0.0,
    gate: shared.Gate = False,
    **reading: Unpack[Reading],
) -> Identification:
    """Identify the axes of a recording; returns the document `selfcal.identify/1` and writes it to `json`.

    `engine`: 'library' (the firmware's C code in float, one bank an axis), 'fixed' (its form for parts without an FPU)
    or 'reference' (the textbook bank in double, its grid refined until the probabilities settle).
    `fail_on` is only checked here. Numbers are in the recording's units. An axis without a result has its reason in its
    place: {"error": ...}. Raises UserError for what the user can put right, and if no axis has a result.
    """
    from selfcal.adequacy.checks import against
    from selfcal.adequacy.identify import chosen_axes, identify_axis, with_reasons
    from selfcal.adequacy.identify_document import Identified, identify_document
    from selfcal.bank.priors import add_sources, for_record
    from selfcal.base.output import check_picture, check_writable, print_line, write_json
    from selfcal.base.progress import bar
    from selfcal.batch.fail_on import check_cause
    from selfcal.batch.verdicts import Limits, add_verdicts, check_options
    from selfcal.logs.recording import list_of
    from selfcal.model.file import Model
    from selfcal.model.regressors import choices_of, offered
    from selfcal.show.export import FORMS, write_export
    from selfcal.show.results import Identification

    check_cause(fail_on)
    check_options(limits, junit, verdicts)
    exported = None if export is None else export[1]
    check_writable(json, plot, exported, junit, verdicts, inputs=(*list_of(log), model, limits))
    check_picture(plot)
    if export is not None and export[0] not in FORMS:
        raise UserError(f"--export: there is no format '{export[0]}' ({', '.join(FORMS)})")
    if overbound is not None and export is None:
        raise UserError("--overbound is for --export FORMAT FILE: give that too")
    if overbound is not None and not 0.5 <= overbound < 1.0:
        raise UserError(f"--overbound must be 0.5 or more, and below 1, not {overbound:g}")
    if engine not in ("library", "reference", "fixed"):
        raise UserError(f"there is no engine '{engine}' (library, reference, fixed)")
    if decimate is not None and not (math.isfinite(decimate) and decimate > 0.0):
        raise UserError("--decimate must be a rate above 0 Hz")
    loaded_model = Model.load(model)
    for text in loaded_model.left_out:
        say_once(text)
    bounds = None if limits is None else Limits.load(limits, loaded_model)
    recording = shared.looked_at(log, loaded_model, since_power_on_s, gate, reading)
    names = chosen_axes(recording, loaded_model, [axes] if isinstance(axes, str) else axes)
    of_file, loaded_model = loaded_model, for_record(loaded_model, recording, names)
    identified: dict[str, Identified | UserError] = {}
    with bar() as progress:
        subsets = sum(len(choices_of(offered(loaded_model, name))) for name in names)
        task = progress.add_task("identify", total=subsets)
        for name in names:
            progress.update(task, description=f"{name} ({engine})")
            try:
                step, drawn = partial(progress.advance, task), plot is not None
                identified[name] = identify_axis(recording, name, loaded_model, engine, decimate, step, draw=drawn)
            except UserError as error:
                identified[name] = error
        with_reasons(identified, recording, loaded_model)
        document = identify_document(recording, identified, all_failed=json if fail_on is not None else None)
        add_sources(document, of_file, loaded_model)
        doubtful = [
            name
            for name, axis in identified.items()
            if isinstance(axis, Identified) and against(axis.judged.checks).keys() - LEFT_OUT
        ]
        if doubtful and suspicion:
            progress.update(task, description="strongest suspicion")
            suspected = _suspect(document, recording, loaded_model, doubtful)
            if model is None:
                from selfcal.diagnosis.suspicion import weigh_more_laws, with_added_laws

                progress.update(task, description="more laws")
                again = with_added_laws(document, recording, suspected, engine, decimate, draw=plot is not None)
                weigh_more_laws(document, recording, [name for name in doubtful if name not in again])
        if of_file.hidden_input is not None and len(names) > 1:
            from selfcal.diagnosis.biases import add_biases

            progress.update(task, description="all axes together")
            add_biases(document, recording, loaded_model, of_file.hidden_input)
    add_verdicts(document, bounds, junit, verdicts)
    write_json(document, json)
    if export is not None:
        write_export(document, *export, overbound)
    if plot is not None:
        from selfcal.show.allan_plot import plot_allan

        plot_allan(document, plot, datasheet=datasheet)
        print_line(progress.console, f"plot: {plot}")
    return Identification(document)


def _suspect(document: dict[str, Any], recording: Recording, model: Model, names: Sequence[str]) -> dict[str, Look]:
    """Name the strongest suspicion of each axis in the document: a fault of the readings that are not left out, else
    the look that explains most. The looks by axis."""
    from selfcal.diagnosis.suspicion import suspicions
    from selfcal.readings.faults import FAULTS

    suspected = suspicions(recording, model, names)
    for name in names:
        axis = document["axes"][name]
        causes = [suspected[name].cause] if name in suspected else []
        causes += [fault.name for fault in FAULTS if fault.name in axis["checks"].keys() - LEFT_OUT]
        axis |= {"suspicion": causes[-1]} if causes else {}
    return suspected


show = shared.shown_by("show.identification", "datasheet", judged=True)
