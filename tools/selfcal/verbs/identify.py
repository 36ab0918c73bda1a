"""`selfcal identify`: hypothesis probabilities, parameters with intervals and the bias of a recording at rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import yaml
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from selfcal import _library32
from selfcal.adequacy.allan import Sampled, sample_lengths, sampled
from selfcal.adequacy.checks import FEWEST, against, coefficients_of, judge, with_drift, with_rate, with_readings
from selfcal.adequacy.counted import weigh_counted
from selfcal.adequacy.document import Identified, check_writable, to_document, write_json
from selfcal.adequacy.one_over_f import weigh, with_white
from selfcal.adequacy.summary import halved_after, summarize
from selfcal.bank.blocks import MOST_DENSE, Blocks, kept_out, usable_blocks
from selfcal.bank.result import AxisResult, in_unit
from selfcal.base.errors import OutsidePriors, UserError, say_once
from selfcal.base.results import Identification
from selfcal.batch.fail_on import check
from selfcal.batch.verdicts import Limits, add_verdicts, check_options, on_a_line
from selfcal.logs.loaders import Reading
from selfcal.logs.recording import SIDE_CHANNELS, Recording, as_float, list_of, load
from selfcal.model.file import DEFAULT, Model
from selfcal.model.regressors import choices_of, columns_of, combine, mask_of, offered
from selfcal.model.tables import bank_block, make_tables
from selfcal.readings.gate import gated
from selfcal.readings.priors import add_sources, for_record
from selfcal.readings.readings import Readings, look
from selfcal.readings.rest import outside_priors
from selfcal.show.export import FORMS, write_export
from selfcal.show.plot import check_picture

if TYPE_CHECKING:
    from selfcal.likelihood.state import Look

#: Probability of an overbound at most: at four degrees of freedom that is already 27 times the deviation.
LARGEST_OVERBOUND = 0.99999
#: Spacing of float32 in the noise of a reading from which on a nominal offset is taken off before.
SPACING_LEAST = 0.01
#: Intervals at most that the laws of `models/sums.yaml` are weighed on: their filters cost twenty times the others'.
#: Half as many as runs 1 and 2 have at 1 Hz move no probability there by more than 0.08.
MORE_LAWS_MOST = 5000


@on_a_line
def identify(
    log: Path | str | Sequence[Path | str],
    *,
    axes: Sequence[str] = (),
    model: Path | str | None = None,
    engine: str = "library",
    decimate: float | None = None,
    json: Path | str | None = None,
    plot: Path | str | None = None,
    datasheet: bool = False,
    export: tuple[str, Path | str] | None = None,
    overbound: float | None = None,
    suspicion: bool = True,
    fail_on: str | None = None,
    limits: Path | str | None = None,
    junit: Path | str | None = None,
    verdicts: Path | str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    since_power_on_s: float = 0.0,
    gate: bool = False,
    **reading: Unpack[Reading],
) -> Identification:
    """Identify the axes of a recording; returns the document `selfcal.identify/1` and writes it to `json`.

    `engine`: 'library' (the firmware's C code in float, one bank an axis), 'fixed' (its form for parts without an FPU)
    or 'reference' (the textbook bank in double, its grid refined until the probabilities settle).
    `decimate`: rate of the block means in Hz, else the model's.
    `plot`: file for the picture of the Allan deviations; `datasheet`: in the units of data sheets.
    `export`: a format of `selfcal.show.export` and the file to write. `suspicion`: look at the axes that are not adequate
    once more, for the cause that explains most. `fail_on`: see fail_on.py; it is only checked here.
    `limits`: a file of limits (verdicts.py), `junit` and `verdicts`: the files of their verdicts.
    `start_s`, `end_s`: the stretch of the recording to look at, s. `since_power_on_s`: from power-on to the recording's
    beginning, s. `gate`: without the bank intervals in which the
    model's stationary gate sees motion.
    Numbers are in the recording's units. An axis without a result has its reason in its place: {"error": ...}. Raises
    UserError for what the user can put right, and if no axis has a result.
    """
    check(fail_on)
    check_options(limits, junit, verdicts)
    check_writable(
        json, plot, None if export is None else export[1], junit, verdicts, inputs=(*list_of(log), model, limits)
    )
    if plot is not None:
        check_picture(plot)
    if export is not None and export[0] not in FORMS:
        raise UserError(f"--export: there is no format '{export[0]}' ({', '.join(FORMS)})")
    if overbound is not None and export is None:
        raise UserError("--overbound is for --export FORMAT FILE: give that too")
    if overbound is not None and not 0.5 <= overbound <= LARGEST_OVERBOUND:
        raise UserError(f"--overbound must be 0.5 to {LARGEST_OVERBOUND:g}, not {overbound:g}")
    if engine not in ("library", "reference", "fixed"):
        raise UserError(f"there is no engine '{engine}' (library, reference, fixed)")
    if decimate is not None and not (math.isfinite(decimate) and decimate > 0.0):
        raise UserError("--decimate must be a rate above 0 Hz")
    loaded_model = Model.load(model)
    say_once(loaded_model.left_out)
    bounds = None if limits is None else Limits.load(limits, loaded_model)
    recording = load(log, sensors=loaded_model.sensors, **reading)
    recording = stretch_of(recording.later(since_power_on_s), loaded_model, start_s, end_s, gate)
    names = chosen_axes(recording, loaded_model, [axes] if isinstance(axes, str) else axes)
    of_file, loaded_model = loaded_model, for_record(loaded_model, recording, names)
    found: dict[str, Identified | UserError] = {}
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        subsets = sum(len(choices_of(offered(loaded_model, name))) for name in names)
        task = progress.add_task("identify", total=subsets)
        for name in names:
            progress.update(task, description=f"{name} ({engine})")
            try:
                found[name] = identify_axis(
                    recording,
                    name,
                    loaded_model,
                    engine,
                    decimate,
                    lambda: progress.advance(task),
                    draw=plot is not None,
                )
            except UserError as error:
                found[name] = error
        _left_out_together(found, recording, loaded_model, engine, decimate, draw=plot is not None)
        with_reasons(found, recording, loaded_model)
        document = to_document(recording, found, all_failed=json if fail_on is not None else None)
        add_sources(document, of_file, loaded_model)
        doubtful = [name for name, axis in found.items() if isinstance(axis, Identified) and not axis.adequate]
        if doubtful and suspicion:
            from selfcal.diagnosis.suspicion import suspicions

            progress.update(task, description="strongest suspicion")
            suspected = suspicions(recording, loaded_model, doubtful)
            for name, shown in suspected.items():
                document["axes"][name]["suspicion"] = shown.cause
            for name in doubtful:
                for cause in ("held_samples", "outliers", "saturation", "motion"):  # shown by the readings themselves
                    if cause in document["axes"][name]["checks"]:
                        document["axes"][name]["suspicion"] = cause
            if model is None:
                progress.update(task, description="more laws")
                again = _with_added_laws(document, recording, suspected, engine, decimate, draw=plot is not None)
                _weigh_more_laws(document, recording, [name for name in doubtful if name not in again])
    if bounds is not None:
        add_verdicts(document, bounds, junit, verdicts)
    if json is not None:
        write_json(document, json)
    if export is not None:
        write_export(document, *export, overbound)
    if plot is not None:
        from selfcal.show.allan_plot import plot_allan

        plot_allan(document, plot, datasheet=datasheet)
        console.print(f"plot: {plot}", highlight=False, markup=False, soft_wrap=True)
    return Identification(document)


def stretch_of(recording: Recording, model: Model, start_s: float | None, end_s: float | None, gate: bool) -> Recording:
    """The part of a recording that a verb looks at: `--start`, `--end`, `--gate`."""
    stretch = recording.between(start_s, end_s)
    return gated(stretch, model) if gate else stretch


def _left_out_together(
    found: dict[str, Identified | UserError],
    recording: Recording,
    model: Model,
    engine: str,
    decimate: float | None,
    *,
    draw: bool,
) -> None:
    """Identify axes anew that hardly show a movement of which two others or more show that it is one."""
    checks = {name: one.judged.checks for name, one in found.items() if isinstance(one, Identified)}
    moved = {name: each["motion"]["intervals"] for name, each in checks.items() if "motion" in each}
    times = [one for each in moved.values() for one in each]
    for name in found if len(moved) > 1 else ():
        if name not in moved:
            with suppress(UserError):
                found[name] = identify_axis(recording, name, model, engine, decimate, draw=draw, moved=times)


def with_reasons(found: dict[str, Identified | UserError], recording: Recording, model: Model) -> None:
    """Give the axes outside the priors their reason: one for all of them."""
    outside = [name for name, axis in found.items() if isinstance(axis, OutsidePriors)]
    if outside:
        reason = UserError(outside_priors(recording, model, outside))
        found.update(dict.fromkeys(outside, reason))


def _with_added_laws(
    document: dict[str, Any],
    recording: Recording,
    suspected: Mapping[str, Look],
    engine: str,
    decimate: float | None,
    *,
    draw: bool,
) -> list[str]:
    """Identify axes anew whose suspicion is noise of another kind than white: N of the default laws is wrong there.

    The law of that noise joins the default ones. Where it is the likeliest, its answer takes the place of the first
    one, with `added_law` and the suspicion. Returns those axes."""
    from selfcal.diagnosis.causes import CAUSES

    again = []
    for name, shown in suspected.items():
        add_law = CAUSES[shown.cause].law
        if add_law is None or document["axes"][name]["suspicion"] != shown.cause:
            continue
        tree: dict[str, Any] = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
        before = set(tree["hypotheses"])
        add_law(tree, shown)
        with suppress(UserError):  # too long for the law's filters
            of_file = Model.of_tree(tree, DEFAULT)
            whole = _whole_means(recording.along(name), decimate or of_file.bank_rate_hz)
            model = for_record(of_file, whole, (name,))
            axis = identify_axis(whole, name, model, engine, decimate, draw=draw)
            if axis.result.best not in before:
                own = to_document(recording, {name: axis})
                add_sources(own, of_file, model)
                document["axes"][name] = own["axes"][name] | {"suspicion": shown.cause, "added_law": axis.result.best}
                again.append(name)
    return again


def _whole_means(recording: Recording, bank_rate_hz: float) -> Recording:
    """The recording without the bank intervals that lost readings: what a counter gained there is in no other reading.
    Raises UserError where none is left."""
    if not recording.missing_before.any():
        return recording
    block = bank_block(recording.rate_hz, bank_rate_hz)
    place = np.arange(recording.samples) + np.cumsum(recording.missing_before).astype(np.int64)
    cell = (place - place[0]) // block
    whole = np.bincount(cell) == block
    if np.count_nonzero(whole) < FEWEST:
        raise UserError("too few bank intervals have all of their readings")
    return recording.with_rows(whole[cell])


def _weigh_more_laws(document: dict[str, Any], recording: Recording, names: Sequence[str]) -> None:
    """What the laws of `models/sums.yaml` say of the axes whose drift the default ones do not describe, beside them.

    At the model's own bank rate; of a longer record than MORE_LAWS_MOST such intervals at a lower one."""
    from selfcal.bank.library import Bank
    from selfcal.diagnosis.causes import CAUSES

    more = Model.load(DEFAULT.parent / "sums.yaml")
    rate_hz = min(more.bank_rate_hz, MORE_LAWS_MOST / recording.duration_s)
    for name in names:
        axis = document["axes"][name]
        if "suspicion" not in axis or CAUSES[axis["suspicion"]].slow:
            with suppress(UserError):  # a record too long for these laws
                more = for_record(more, recording, (name,))
                tables = make_tables(more, recording.rate_hz, (name,), bank_rate_hz=rate_hz)
                bank = Bank(tables)
                samples = as_float(recording.in_unit(name, more.group_of(name).unit))
                bank.push(samples[:, None], recording.missing_before)
                axis["more_laws"] = bank.report(0).probability


def chosen_axes(recording: Recording, model: Model, wanted: Sequence[str]) -> tuple[str, ...]:
    """The axes to work on, in the model's order: those asked for, else all that the recording has."""
    for name in wanted:
        model.group_of(name)
        if name not in recording.columns:
            raise UserError(f"{recording.path}: there is no column '{name}' (there are {', '.join(recording.columns)})")
    names = tuple(name for name in model.axes if name in (wanted or recording.columns))
    if not names:
        raise UserError(
            f"{recording.path}: none of its columns ({', '.join(recording.columns)}) is an axis of the model "
            f"({', '.join(model.axes)}); map one with --column gx=NAME"
        )
    return names


def identify_axis(
    recording: Recording,
    name: str,
    model: Model,
    engine: str,
    decimate: float | None,
    advance: Callable[[], object] = lambda: None,
    *,
    draw: bool = False,
    moved: Sequence[Sequence[float]] = (),
) -> Identified:
    """One axis by one engine. The record is fed as float32, as the firmware gets it; less a nominal offset where that
    is too coarse. Readings that are none are left out (`readings.py`). With regressors every subset of them is scored;
    `advance` is called after each. `draw`: with the Allan deviation of the samples. `moved`: stretches in which other
    axes moved, seconds of the recording."""
    recording = recording.along(name)
    group, unit = model.group_of(name), recording.columns[name].unit
    regressors = offered(model, name)
    readings = look(recording, name, group)
    readings = readings.without([*moved, *moved_beside(recording, model, name, readings)])
    recording = readings.recording
    tables = make_tables(replace(model, regressors=regressors), recording.rate_hz, (name,), bank_rate_hz=decimate)
    values, offset = readings.working, 0.0
    if readings.clipped is not None or readings.coarse > SPACING_LEAST:
        # What takes the place of clipped readings may lie beyond the range, and so may readings less an offset.
        beyond = np.abs(values) >= (group.range if readings.clipped is None and group.range > 0.0 else np.inf)
        if beyond.all():
            raise UserError(f"every reading is beyond the range of {group.range:g} {group.unit}: is the unit right?")
        values = np.where(beyond, np.nan, values)
        group = replace(group, range=0.0)
        tables = replace(tables, axes=(replace(tables.axes[0], range=0.0),))
    if readings.coarse > SPACING_LEAST:
        offset = float(np.float32(np.nanmedian(values)))
    samples = as_float(values - offset)
    columns = as_float(columns_of(regressors, recording))
    for name_of, column in zip([column.name for column in tables.regressors], columns.T, strict=True):
        beyond = np.abs(column) >= _library32.SAMPLE_MAX
        if beyond.any():
            raise UserError(f"the regressor {name_of} is {column[beyond][0]:g} at {int(beyond.sum())} samples")
    blocks = usable_blocks(samples, recording.missing_before, tables, group, columns, readings.counted)
    blocks = replace(blocks, mean=blocks.mean + offset)
    ahead_s = blocks.after / recording.rate_hz
    if engine == "reference" and model.half_life_s:
        raise UserError("the reference bank forgets nothing: take --engine library, or a model without half_life_s")
    if engine == "reference" and model.handling.outlier_sd:
        raise UserError("the reference bank takes outliers: take --engine library, or leave handle.outlier_sd out")

    def curve_of_samples(values: NDArray[np.floating[Any]]) -> Sampled:
        unused = np.logical_or.reduce(list(kept_out(samples, group).values()))
        at = sample_lengths(int((~unused).sum()), tables.block)
        return sampled(np.where(unused, np.nan, values), recording.missing_before, recording.rate_hz, at)

    choices = choices_of(regressors)
    results: list[AxisResult] = []
    z = blocks.z - np.array([column.reference for column in tables.regressors])
    sd = np.array([column.coefficient_sd[0] for column in tables.regressors])
    if engine in ("library", "fixed"):
        from selfcal.bank.library import Bank

        bank = Bank(tables, fixed=engine == "fixed", offset=offset)
        bank.push(samples[:, None], recording.missing_before, columns if regressors else None)
        for choice in choices:
            results.append(bank.report(0, mask_of(regressors, choice), ahead_s))
            advance()
    else:
        from selfcal.bank import reference

        if blocks.mean.size > MOST_DENSE:
            raise UserError(f"{blocks.mean.size} bank intervals, gaps included, are too many for the reference")
        for choice in choices:
            used = _used(mask_of(regressors, choice))
            beside, coefficient_sd = (z[:, used] if used else None), sd[used].tolist()
            results.append(
                reference.identify_axis(
                    blocks.mean,
                    tables.dt_s,
                    group,
                    model.hypotheses,
                    blocks.r,
                    beside,
                    coefficient_sd,
                    tables.block,
                    ahead_s,
                )
            )
            advance()
    kept = kept_out_of(blocks, recording, int(readings.moving.sum()))
    at = tables.dt_s, blocks.mean.size, tables.block
    told = [in_unit(with_white(result, group, *at), group.unit, unit) for result in results]
    if not regressors:
        best, inside, scored, known = 0, results[0], None, told[0]
    else:
        if not any(math.isfinite(value) for result in results for value in result.log_evidence.values()):
            raise OutsidePriors
        combined = combine(choices, results, model.hypotheses, group.unit)
        best, inside = combined.best, combined.result
        scored = combine(choices, told, model.hypotheses, unit)
        known = scored.result
    mask = mask_of(regressors, choices[best])
    used = _used(mask)
    judged = judge(blocks, tables, group, results[best], used)
    judged = with_drift(judged, blocks, tables, results[best], recording, may_act(model, recording, name), used)
    if "drift_in_average" in against(judged.checks):
        used_readings = np.where(np.logical_or.reduce(list(kept_out(samples, group).values())), np.nan, values)
        step = 0.0 if readings.lattice is None else readings.lattice.step
        judged = with_rate(judged, used_readings, recording.missing_before, step, tables, results[best])
    judged = with_readings(judged, readings, group, unit, tables.dt_s)
    explained = columns[:, used].astype(np.float64) @ coefficients_of(results[best]) if used else 0.0
    curve = curve_of_samples(samples - explained) if draw else None
    fed = tables, group, samples, recording.missing_before, columns if regressors else None, mask, offset
    beside, counted = weigh(*fed), weigh_counted(readings.lattice, results[best], *fed)
    more_laws = [one.laws(known.probability) for one in (beside, counted) if one is not None]
    return Identified(
        unit,
        group.unit,
        known,
        judged,
        kept,
        scored,
        curve,
        summarize(inside, group, *at, beside, counted),
        halved_after(inside, group, *at),
        next(filter(None, more_laws), {}),
    )


def moved_beside(recording: Recording, model: Model, name: str, own: Readings) -> list[list[float]]:
    """When the axes moved that moved together with an axis: stretches, seconds of the recording. Each axis shows a part
    of a movement of the sensor. `own`: the readings of the axis."""
    found: list[list[float]] = []
    for other in model.axes if own.moved is not None else ():
        if other == name or other not in recording.columns:
            continue
        if other not in recording.motion_seen:
            look(recording, other, model.group_of(other))
        times = recording.motion_seen[other]
        if any(a < end and begin < b for a, b in times for begin, end in recording.motion_seen[name]):
            found += times
    return found


def may_act(model: Model, recording: Recording, name: str) -> list[str]:
    """The columns that may act on an axis: the side channels and the other axes."""
    known = {*model.axes, *(column for column, _ in SIDE_CHANNELS.values())} - {name}
    return [column for column in recording.columns if column in known]


def kept_out_of(blocks: Blocks, recording: Recording, moved: int) -> dict[str, int]:
    """Samples that were not used, by reason; `moved` of them for motion that the readings show."""
    moving = {"moving": recording.moving + moved} if recording.moving + moved else {}
    return {**blocks.kept_out, "missing": recording.lost, **moving}


def _used(mask: int) -> list[int]:
    return [k for k in range(mask.bit_length()) if mask >> k & 1]
