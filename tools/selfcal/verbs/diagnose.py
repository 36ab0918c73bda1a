"""What the model gets wrong in a recording at rest, why, and what mending it gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Unpack

from selfcal.base.errors import UserError
from selfcal.base.options import option
from selfcal.logs.loaders import Reading
from selfcal.verbs import _shared as shared

if TYPE_CHECKING:
    from selfcal.base.ending import HeldSignals
    from selfcal.base.progress import Doing
    from selfcal.diagnosis.finding import Diagnosed
    from selfcal.diagnosis.record import Record
    from selfcal.logs.recording import Recording
    from selfcal.model.file import Model
    from selfcal.show.results import Diagnosis


@shared.on_a_line
def diagnose(
    log: shared.Logs,
    *,
    axes: shared.Axes = (),
    model: shared.ModelFile = None,
    decimate: Annotated[
        float | None, option("Look at means at this rate alone; default: means of 1 s, then every sample", metavar="HZ")
    ] = None,
    full_rate: Annotated[
        bool, option("Look at every sample at once, not at means of 1 s first", "--full-rate")
    ] = False,
    json: shared.Json = None,
    report: shared.Report = None,
    write_model: Annotated[
        Path | str | None, option("Write the model file with what was found in it", metavar="MODEL.yaml")
    ] = None,
    on: Annotated[
        Path | str | None, option("Measure each finding's gain on a second recording of the part", metavar="LOG")
    ] = None,
    navigate: Annotated[
        bool, option("Fly a GPS/INS filter with and without each finding that matters", "--navigate")
    ] = False,
    fail_on: shared.FailOn = None,
    limits: shared.LimitsFile = None,
    junit: shared.Junit = None,
    verdicts: shared.Verdicts = None,
    since_power_on_s: shared.SincePowerOn = 0.0,
    gate: shared.Gate = False,
    details: Annotated[bool, option("Print every finding of each axis too", "--details")] = False,
    **reading: Unpack[Reading],
) -> Diagnosis:
    """Diagnose the axes of a recording; returns the document `selfcal.diagnose/1` and writes it to `json`.

    `axes`: those reported on; every other column may explain them. A long recording is looked at twice: first its means
    of 1 s, whose findings go to stderr at once, then every sample. The second result is the final one, unless it shows
    nothing where the first one does. A further finding of the means stays in the axis' `only_in_means`. An axis that
    the second look did not finish without a result of its own has the first look's. `full_rate`: no first look.
    `on` is read as the first recording is, and whole. A file that `diagnose` did not write is no place for
    `write_model`.
    `fail_on` is only checked here. Times are those of the whole recording, numbers in its units. Raises UserError for
    what the user can put right.

    Under the command a signal ends it within 2 s: what was found so far is reported and written, axes that show nothing
    yet have an error. The caller then ends by `HeldSignals().check()`; a second signal ends at once.
    """
    from selfcal.adequacy.identify import chosen_axes
    from selfcal.adequacy.identify_document import of_errors, recording_entry
    from selfcal.bank.priors import add_sources, for_record
    from selfcal.base.ending import hold_signals
    from selfcal.base.output import check_writable, write_json, write_text
    from selfcal.base.progress import Doing
    from selfcal.batch.fail_on import check_cause
    from selfcal.batch.verdicts import Limits, add_verdicts, check_options
    from selfcal.diagnosis import hidden
    from selfcal.diagnosis.diagnose import add_carried, add_posteriors, entry_of, events_of, options_given, shared_by
    from selfcal.diagnosis.diagnose_document import SCHEMA, diagnose_document
    from selfcal.diagnosis.events import add_findings
    from selfcal.diagnosis.extend import check_not_by_hand, extended, no_room, write_extended
    from selfcal.diagnosis.record import record_from
    from selfcal.likelihood import work
    from selfcal.logs.recording import list_of, load
    from selfcal.model.file import Model
    from selfcal.show.results import Diagnosis

    if report is not None:
        from selfcal.show.diagnosis_page import diagnosis_html

    check_cause(fail_on)
    check_options(limits, junit, verdicts)
    if full_rate and decimate is not None:
        raise UserError("--full-rate looks at every sample, --decimate at means: take one of them")
    check_writable(json, report, write_model, junit, verdicts, inputs=(*list_of(log), model, limits))
    check_not_by_hand(write_model)
    loaded = Model.load(model)
    bounds = None if limits is None else Limits.load(limits, loaded)
    recording = shared.looked_at(log, loaded, since_power_on_s, gate, reading)
    axes = [axes] if isinstance(axes, str) else axes
    names = chosen_axes(recording, loaded, axes)
    of_file, loaded = loaded, for_record(loaded, recording, names)
    whole: Reading = {**reading, "start_s": None, "end_s": None}
    second = None if on is None else load(on, sensors=loaded.sensors, **whole)
    with hold_signals() as ending, Doing("diagnose") as doing:
        record, first, diagnosed, errors = _looked(recording, loaded, names, decimate, full_rate, ending, doing)
        with work.within(work.Work(lambda: ending.overdue)):
            if not diagnosed:
                if fail_on is not None:  # a production line gets its files in each case
                    document = of_errors(SCHEMA, recording_entry(recording), errors) | {"model": {}}
                    if report is not None:
                        write_text(report, diagnosis_html(document, record, {}))
                    write_json(document, json)
                raise _unjudged(recording, errors, ending)
            doing.now("held-out gain")
            sensor = recording.path.name.partition(".")[0] if model is None else None
            tree, read_out = extended(loaded, record, diagnosed, sensor)
            out = no_room(loaded, diagnosed)
            doing.now("what the axes share")
            common = shared_by(diagnosed, loaded) if not ending.asked else None
            quantity = None if common is None else entry_of(common, diagnosed, recording, loaded)
            if common is not None and quantity is not None:
                hidden.extend(tree, common)
                if second is not None:
                    on_second = record_from(second, loaded, 1.0 / common.dt)
                    quantity["gain_on"] = hidden.carried(common, on_second.axes, events_of(on_second))
            document = diagnose_document(recording, diagnosed, errors, tree, first, [finding for _, finding in out])
            add_sources(document, of_file, loaded)
            if second is not None:
                doing.now(f"gain on {second.path}")
                add_carried(document, loaded, tree, record, diagnosed, second)
            doing.now("posterior")
            known = add_posteriors(document, recording, diagnosed, Model.of_tree(tree, loaded.path), ending)
            add_findings(document, recording, diagnosed, known, quantity)
            if navigate and not ending.asked:
                from selfcal.studies.outage import add_outages

                doing.now("flights")
                add_outages(document, loaded, tree, record, diagnosed, recording, second)
            if write_model is not None:
                write_extended(write_model, tree, recording.path, read_out, out)
            if report is not None:
                doing.now("pictures")
                given = options_given(axes, model, decimate, recording)
                write_text(report, diagnosis_html(document, record, diagnosed, given))
    add_verdicts(document, bounds, junit, verdicts)
    write_json(document, json)
    return Diagnosis(document)


def _unjudged(recording: Recording, errors: Mapping[str, str], ending: HeldSignals) -> UserError:
    """Why no axis has a result. A signal that came ends the command here."""
    ending.check()
    reasons = "; ".join(f"{name}: {reason}" for name, reason in errors.items())
    return UserError(f"{recording.path}: no axis can be judged ({reasons})")


def _looked(
    recording: Recording,
    model: Model,
    names: Sequence[str],
    decimate: float | None,
    full_rate: bool,
    ending: HeldSignals,
    doing: Doing,
) -> tuple[Record, dict[str, Diagnosed], dict[str, Diagnosed], dict[str, str]]:
    """The look at means, whose findings go to stderr, then at every sample: the record, what the first look found, what
    both found together, and why the other axes have no result."""
    from selfcal.diagnosis import diagnose as looks
    from selfcal.diagnosis.axis_verdict import joined_looks
    from selfcal.diagnosis.loop import INTERRUPTED
    from selfcal.diagnosis.record import record_from

    first: dict[str, Diagnosed] = {}
    record = record_from(recording, model, decimate, names)
    long = recording.samples >= looks.FIRST_FROM and recording.rate_hz >= looks.LEAST_HZ
    if decimate is None and not full_rate and long:
        means = None
        with suppress(UserError):  # a recording that is too short for means is looked at once
            means = record_from(recording, model, looks.FIRST_HZ, names)
        if means is not None and record.axes:
            first = looks.looked_at(means, names, ending, doing)
            looks.show_first(recording, first, [name for name in names if name in record.axes], ending)
    seen = looks.looked_at(record, names, ending, doing, first) if not ending.asked else {}
    diagnosed: dict[str, Diagnosed] = {}
    for name in names:
        only_means = name not in seen and looks.below_lattice(record, name)
        axis = first.get(name) if only_means else joined_looks(seen.get(name), first.get(name), INTERRUPTED)
        if axis is not None:
            diagnosed[name] = looks.less_stated(axis, model)
    if not ending.asked:
        doing.now("checks")
        looks.by_identify(diagnosed, recording, model)
    errors = {
        name: seen[name].unfinished if name in seen else looks.why_not(record, name)
        for name in names
        if name not in diagnosed
    }
    return record, first, diagnosed, errors


show = shared.shown_by("show.diagnosis_lines", "details", judged=True)
