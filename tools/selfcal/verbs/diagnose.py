"""`selfcal diagnose`: what the simulation gets wrong in a recording, why, and what mending it gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from selfcal.diagnosis.document import to_document
from selfcal.diagnosis.extend import as_text, extended
from selfcal.diagnosis.loop import diagnose_record
from selfcal.diagnosis.record import of_recording, why_left_out
from selfcal.diagnosis.words import WORDS
from selfcal.document import check_writable, parameters_entry, regressors_entry, write_json
from selfcal.ending import Stopped, held
from selfcal.errors import UserError, printable
from selfcal.model import Model
from selfcal.output import write_text
from selfcal.recording import Recording, Scale, list_of, load
from selfcal.verbs.identify import chosen_axes, identify_axis

#: Why an axis has no result.
BELOW_LATTICE = "its noise is below the lattice of its readings: record with a finer range"
INTERRUPTED = "interrupted before it was done"


def diagnose(
    log: Path | str | Sequence[Path | str],
    *,
    axes: Sequence[str] = (),
    model: Path | str | None = None,
    decimate: float | None = None,
    json: Path | str | None = None,
    report: Path | str | None = None,
    write_model: Path | str | None = None,
    fail_on: str | None = None,
    rate: float | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    scale: Mapping[str, Scale] | None = None,
    no_time: bool = False,
    skip_bad: bool = False,
) -> dict[str, Any]:
    """Diagnose the axes of a recording; returns the document `selfcal.diagnose/1` and writes it to `json`.

    `axes`: those reported on; every other column may explain them. `decimate`: look at block means at this rate, Hz.
    `report`: the page to write. `write_model`: where the extended model file goes. `fail_on` is only checked here.
    Numbers are in the recording's units. Raises UserError for what the user can put right.

    Under the command a signal ends it early: axes that are done are reported and written, the others have an error.
    The caller then ends by `Held().check()`; a second signal ends at once.
    """
    if fail_on is not None and fail_on not in ("inadequate", *WORDS):
        raise UserError(f"--fail-on: there is no cause '{fail_on}' (inadequate, {', '.join(WORDS)})")
    check_writable(json, report, write_model, inputs=(*list_of(log), model))
    loaded = Model.load(model)
    recording = load(log, rate, columns or {}, units or {}, scale, no_time=no_time, skip_bad=skip_bad)
    axes = [axes] if isinstance(axes, str) else axes
    names = chosen_axes(recording, loaded, axes)
    record = of_recording(recording, loaded, decimate, names)
    judged = [name for name in names if name in record.axes]
    errors = {name: why_left_out(recording, loaded, name) for name in names if name not in judged}
    console = Console(stderr=True)
    with held() as ending, Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("diagnose", total=None)

        def advance(text: str) -> None:
            if ending.asked:
                raise Stopped
            progress.update(task, description=text)

        try:
            found = diagnose_record(record, judged, advance)
        except Stopped:
            ending.check()
            raise
        for name in judged:
            if name not in found:
                errors[name] = BELOW_LATTICE if record.axes[name].below_lattice else INTERRUPTED
        if not found:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in errors.items())
            raise UserError(f"{recording.path}: no axis can be judged ({reasons})")
        progress.update(task, description="held-out gain")
        tree = extended(loaded, record, found)
        document = to_document(recording, record, found, errors, tree)
        progress.update(task, description="posterior")
        _add_posteriors(document, recording, Model.of_tree(tree, loaded.path))
    if write_model is not None:
        write_text(write_model, as_text(tree, recording.path))
    if report is not None:
        from selfcal.diagnosis.page import write_page

        write_page(
            report,
            document,
            record,
            found,
            _given(axes, model, decimate, recording),
        )
    if json is not None:
        write_json(document, json)
    return document


def _add_posteriors(document: dict[str, Any], recording: Recording, model: Model) -> None:
    """What the extended model knows of each axis, as `identify` tells it; null where the sensor moved, or where the
    record bears no report."""
    for name, axis in document["axes"].items():
        if "error" not in axis:
            moved = any(finding["cause"] == "motion" for finding in axis["findings"])
            axis["posterior"] = None if moved else _posterior(recording, name, model)


def _posterior(recording: Recording, name: str, model: Model) -> dict[str, Any] | None:
    try:
        known = identify_axis(recording, name, model, "library", None)
    except UserError:
        return None
    return {
        "hypotheses": dict(known.result.probability),
        "parameters": parameters_entry(known),
        "regressors": regressors_entry(known.scored).get("regressors", {}),
    }


def _given(
    axes: Sequence[str], model: Path | str | None, decimate: float | None, recording: Recording
) -> list[tuple[str, str]]:
    """The command line's options that decide what is found, as they were given."""
    given = [("--axis", name) for name in axes]
    given += [] if model is None else [("--model", str(model))]
    given += [] if decimate is None else [("--decimate", f"{decimate:.15g}")]
    return [*given, *recording.options]


def failing(document: Mapping[str, Any], wanted: str) -> bool:
    """Whether `--fail-on` applies: `inadequate`, or the id of a cause that some axis shows."""
    for axis in document["axes"].values():
        if wanted == "inadequate" and axis.get("verdict") != "adequate":
            return True
        if any(finding["cause"] == wanted for finding in axis.get("findings", [])):
            return True
    return False


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """What a person reads: per axis the verdict, each finding in words with its evidence and gain, what to do next."""
    recording = document["recording"]
    console = Console(stderr=to_stderr)
    console.print(
        f"{printable(recording['path'])}: {recording['samples']} samples, {recording['rate_hz']:g} Hz, "
        f"{recording['duration_s']:g} s\n",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    for name, axis in document["axes"].items():
        if "error" in axis:
            console.print(f"{name}: no result: {axis['error']}", highlight=False, markup=False, soft_wrap=True)
            continue
        colour = "green" if axis["verdict"] == "adequate" else "bold red"
        heading = f"{name} [{axis['unit']}]: {axis['verdict']}"
        console.print(heading, style=colour, highlight=False, markup=False, soft_wrap=True)
        for finding in axis["findings"]:
            for line in _lines(finding):
                console.print(f"  {line}", highlight=False, markup=False, soft_wrap=True)


def _lines(finding: Mapping[str, Any]) -> list[str]:
    """One finding in a few lines."""
    gain = finding["gain"]
    lines = [f"{finding['cause']}: {finding['words']}"]
    evidence = f"  evidence {finding['evidence_gain_nats']:.1f} nats, {finding['net_nats']:.1f} net of the search"
    if finding["when"]:
        evidence += f"; at {finding['when'][0]:.6g} s"
        evidence += "" if finding["when"][0] == finding["when"][1] else f" to {finding['when'][1]:.6g} s"
    lines.append(evidence)
    if gain is not None:
        score = gain["log_score_per_sample"]
        errors = ", ".join(
            f"{horizon} s {row['before']:.3g} -> {row['after']:.3g}"
            for horizon, row in gain["bias_rmse"]["horizon_s"].items()
        )
        lines.append(
            f"  held-out gain {score['after'] - score['before']:+.4f} ± {score['sd']:.2g} nats a sample; "
            f"bias error ahead, {gain['bias_rmse']['unit']}: {errors}"
        )
    elif finding.get("gain_reason"):
        lines.append(f"  no held-out gain: {finding['gain_reason']}")
    if finding["inflation_words"]:
        lines.append(f"  {finding['inflation_words']}")
    if finding["shared_with"]:
        lines.append(f"  also on {', '.join(finding['shared_with'])}")
    if finding["also_possible"]:
        lines.append(f"  this record cannot tell it from: {', '.join(finding['also_possible'])}")
    lines.append(f"  next: {finding['record_next']}")
    return lines
