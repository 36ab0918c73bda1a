"""`selfcal rivals`: what other methods make of the same record: estimates, choice of a law, time and memory.

With a recording, a table for each axis. With a number of records, the same for simulated records of known truth.
"""

from __future__ import annotations

import math
import resource
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from selfcal.adequacy.identify import chosen_axes
from selfcal.adequacy.identify_document import recording_entry
from selfcal.bank.blocks import MOST_DENSE
from selfcal.bank.priors import for_record
from selfcal.base import units
from selfcal.base.errors import UserError, first_line, note, printable
from selfcal.base.grid import Array, runs
from selfcal.base.output import console_of, print_line, table_of
from selfcal.base.progress import bar
from selfcal.batch.spread import record_seeds, spread, workers
from selfcal.logs.recording import Recording
from selfcal.model.file import DEFAULT, Model, settings_of
from selfcal.model.laws import NAMED, PLAIN
from selfcal.show.identification import fitting
from selfcal.studies.methods import RIVALS, Rival
from selfcal.studies.methods.ensemble import Cell, ensemble_summary, over_laws, rows_of
from selfcal.studies.methods.problem import Answer, Problem

SCHEMA = "selfcal.rivals/1"
ENSEMBLE_SCHEMA = "selfcal.rivals_ensemble/1"
#: The model of the ensemble, and its default numbers of samples.
ENSEMBLE = DEFAULT.with_name("ensemble.yaml")
SAMPLES = (150, 600)
#: Bank samples that every method can work with: five points of an Allan curve.
RIVAL_SAMPLES_LEAST = 50


def of_recording(
    recording: Recording, model: Model, axes: Sequence[str], decimate: float | None, chosen: Sequence[Rival]
) -> dict[str, Any]:
    """The document `selfcal.rivals/1`: the `chosen` methods on the same block means of each axis.

    Each runs in a process of its own, in turn, so that its time and its memory are its own. Numbers are in the
    recording's units. A method that fails, or whose package is absent, has its reason in its place: {"error": ...}.
    """
    if decimate is not None and not (math.isfinite(decimate) and decimate > 0.0):
        raise UserError("--decimate must be a rate above 0 Hz")
    names = chosen_axes(recording, model, axes)
    model = for_record(model, recording, names)
    answers: dict[str, Any] = {}
    with bar() as progress:
        task = progress.add_task("rivals", total=len(names) * len(chosen))
        for name in names:
            problem, left_out = problem_of(recording, name, model, decimate)
            entries = {}
            for rival in chosen:
                progress.update(task, description=f"{name}: {rival.title}")
                entries[rival.name] = measured(rival, problem, recording.columns[name].unit)
                progress.advance(task)
            answers[name] = {
                "samples": int(problem.y.size),
                "samples_left_out": left_out,
                "interval_s": problem.dt_s,
                "rivals": entries,
            }
    return {"schema": SCHEMA, "recording": recording_entry(recording), "axes": answers}


@dataclass(frozen=True)
class Ensemble:
    """Simulated records for every method, `records` of each law and number of `samples`.

    `truth`: 'middle' has every record made with the middle of the priors' logarithms, 'prior' draws it for each."""

    model: Model
    axis: str
    truth: str
    samples: Sequence[int]
    records: int
    seed: int

    def document(
        self, chosen: Sequence[Rival], workers: int | None, scheduler: str | None, results: Path | str | None
    ) -> dict[str, Any]:
        """The document `selfcal.rivals_ensemble/1`. Raises UserError for what no method takes."""
        for rival in chosen:
            if rival.missing:
                note(f"left out: {rival.title}: {rival.missing}")
        chosen = [rival for rival in chosen if not rival.missing]
        seeds = record_seeds(self.records, self.seed)
        if self.truth not in ("middle", "prior"):
            raise UserError(f"--truth is middle or prior, not '{self.truth}'")
        if not all(RIVAL_SAMPLES_LEAST <= n <= MOST_DENSE for n in self.samples):
            raise UserError(f"--samples must be {RIVAL_SAMPLES_LEAST} to {MOST_DENSE}")
        if not set(self.model.hypotheses) <= set(PLAIN):
            raise UserError(f"{self.model.path}: rivals knows the laws {', '.join(PLAIN)} alone: leave the others out")
        given = {"axis": self.axis, "truth": self.truth, "seed": self.seed}
        more = {
            "schema": ENSEMBLE_SCHEMA,
            "model": settings_of(self.model),
            "samples": list(self.samples),
            "rivals": [rival.name for rival in chosen],
        }
        rows = spread(
            partial(rows_of, self.model, self.axis, self.truth, chosen),
            [Cell(law, n, seed) for n in self.samples for seed in seeds for law in self.model.hypotheses],
            settings=given | more,
            scheduler=scheduler,
            results=results,
            count=workers,
        )
        entries = ensemble_summary(rows, self.model.group_of(self.axis))
        document = {"schema": ENSEMBLE_SCHEMA, "model": str(self.model.path), **given, "records_per_law": self.records}
        return document | {"cells": entries, "choice": over_laws(entries)}


def chosen_rivals(only: Sequence[str]) -> list[Rival]:
    """The rivals in `only`, or all, in the order of the table. Raises UserError for an unknown name."""
    for name in only:
        if name not in RIVALS:
            raise UserError(f"--only: there is no rival '{name}' ({', '.join(RIVALS)})")
    return [rival for rival in RIVALS.values() if not only or rival.name in only]


def problem_of(recording: Recording, name: str, model: Model, decimate: float | None) -> tuple[Problem, int]:
    """The longest stretch of the axis' block means without a gap, and how many means lie outside it. Most methods take
    no gaps, and all must see the same samples."""
    from selfcal.bank.blocks import bank_means

    laws = tuple(law for law in model.hypotheses if law in PLAIN)
    if not laws:
        raise UserError(f"{model.path}: rivals knows the laws {', '.join(PLAIN)}: the model has none of them")
    mean, dt_s = bank_means(recording, model, name, decimate)
    y = longest_stretch(mean)
    if y.size < RIVAL_SAMPLES_LEAST:
        raise UserError(
            f"{recording.path}: {name}: {y.size} averages of {dt_s:g} s without a gap are too few, "
            f"{RIVAL_SAMPLES_LEAST} are needed: record longer, or give --decimate HZ"
        )
    alone = replace(model.group_of(name), axes=(name,))
    return Problem(y, dt_s, alone, laws), int(np.isfinite(mean).sum()) - y.size


def longest_stretch(mean: Array) -> Array:
    """The longest run of finite values."""
    start, end = max(runs(np.isfinite(mean)), key=lambda run: run[1] - run[0])
    return mean[start:end]


def measured(rival: Rival, problem: Problem, unit: str) -> dict[str, Any]:
    """A method in a process of its own: its answer, its seconds of CPU, and its memory beyond the program's."""
    if rival.missing:
        return {"title": rival.title, "error": rival.missing}
    try:
        with workers(1) as pool:
            answer = pool.submit(_alone, rival, problem, unit).result()
    except BrokenProcessPool:
        answer = {"error": "it ended without an answer"}
    return {"title": rival.title, **answer}


def _alone(rival: Rival, problem: Problem, unit: str) -> dict[str, Any]:
    try:
        function = rival.load()
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        start = time.process_time()
        answer = function(problem)
        seconds = time.process_time() - start
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        if not isinstance(answer, Answer):
            return {"error": f"it returned {type(answer).__name__}: a rival returns a selfcal.studies.methods.Answer"}
        entry = entry_of(answer, problem.group.unit, unit)
    except Exception as error:  # whatever another's library raises is the answer for this record
        return {"error": first_line(error)}
    unit_bytes = 1 if sys.platform == "darwin" else 1024
    return {**entry, "seconds": seconds, "peak_memory_bytes": grown * unit_bytes}


def entry_of(answer: Answer, unit: str, to: str) -> dict[str, Any]:
    """The document's entry of an answer, in the unit `to`."""
    factor = units.factor(unit, to)
    return {
        "parameters": {
            law: {
                name: {key: number * (1.0 if name == "alpha" else factor) for key, number in asdict(value).items()}
                | {"unit": units.parameter_unit(name, to)}
                for name, value in estimates.items()
            }
            for law, estimates in answer.estimates.items()
        },
        "weights": {criterion: dict(weights) for criterion, weights in answer.weights.items()},
    }


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """A table an axis: a row for each method and law."""
    console = console_of(to_stderr=to_stderr)
    for name, axis in document["axes"].items():
        console.print(fitting(console, [_table(name, axis, brief=brief) for brief in (False, True)]))
        if axis["samples_left_out"]:
            print_line(
                console, f"left out: {axis['samples_left_out']} averages outside the longest stretch without a gap"
            )
        for entry in axis["rivals"].values():
            if "error" in entry:
                print_line(console, f"no answer: {entry['title']}: {entry['error']}")
    print_line(console, "estimates [5 %, 95 %] in the units of the recording, an interval where the method states one")
    print_line(
        console,
        "weight of the law: by Bayes' rule, A by AIC, B by BIC; time: of the CPU; memory: beyond the program's own",
    )


def _table(name: str, axis: Mapping[str, Any], *, brief: bool) -> Table:
    title = f"{printable(name)}: {axis['samples']} averages of {axis['interval_s']:g} s"
    table = table_of(("method", "law", "weight", "N", "K or sigma_m", "1/alpha, s", "time", "memory"), title)
    for entry in axis["rivals"].values():
        if "error" in entry:
            continue
        cost = (_seconds(entry["seconds"]), f"{entry['peak_memory_bytes'] / 1e6:.1f} MB")
        title = entry["title"]
        laws = list(entry["parameters"])
        for law in laws:
            p = entry["parameters"][law]
            weight = " ".join(
                f"{weights[law]:.3f}" + {"Bayes": "", "AIC": " A", "BIC": " B"}[criterion]
                for criterion, weights in entry["weights"].items()
                if law in weights
            )
            table.add_row(
                title,
                law,
                weight,
                _shown(p.get("N"), brief=brief),
                _shown(p.get("K", p.get("sigma_m")), brief=brief),
                _shown(p.get("alpha"), inverse=True, brief=brief),
                *cost,
                end_section=law == laws[-1],
            )
            title, cost = "", ("", "")
    return table


def show_ensemble(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """A table for each number of samples and law, then the choice of a law over all laws."""
    console = console_of(to_stderr=to_stderr)
    cells: dict[tuple[int, str], list[Mapping[str, Any]]] = {}
    for entry in document["cells"]:
        cells.setdefault((entry["samples"], entry["law"]), []).append(entry)
    for (samples, law), entries in cells.items():
        names = NAMED[law].parameters
        title = f"{law}, {samples} samples, {entries[0]['records']} records, truth: {document['truth']}"
        errors = (f"error of ln {name} over ML's" for name in names)
        table = table_of(("method", *errors, "90 % intervals hold", "none", "time"), title)
        for entry in entries:
            p = entry["parameters"]
            shares = [p[name]["coverage_90"] for name in names]
            covered = ["none" if math.isnan(share) else f"{100 * share:.1f}" for share in shares]
            table.add_row(
                entry["rival"],
                *(_ratio(p[name]) for name in names),
                "" if all(map(math.isnan, shares)) else " ".join(covered),
                f"{100 * max(p[name]['no_answer'] for name in names):.0f} %",
                _seconds(entry["seconds"]),
            )
        console.print(table)
    laws = list(dict.fromkeys(law for _, law in cells))
    choice_of = {(entry["samples"], entry["rival"], entry["law"]): entry["choice"] for entry in document["cells"]}
    headings = ("samples", "method", "by", "right", *laws, "log score")
    table = table_of(headings, "choice of the law, mean over the laws")
    for entry in document["choice"]:
        samples, rival, criterion = entry["samples"], entry["rival"], entry["criterion"]
        table.add_row(
            str(samples),
            rival,
            criterion,
            f"{entry['hit_rate']:.3f}",
            *(f"{choice_of[samples, rival, law][criterion]['hit_rate']:.3f}" for law in laws),
            f"{entry['log_score']:.4f} ± {entry['log_score_sd']:.4f}",
        )
    console.print(table)
    for line in (
        "error: rms of the logarithm over that of ML [95 % of a bootstrap], each estimate kept within the prior",
        "none: records without an answer, in the worst parameter; time: median CPU time of a record, all laws",
        "ekf, ukf: begin at the priors' middle and leave N, K and sigma_m there: their errors are the start's",
    ):
        print_line(console, line)


def _ratio(parameter: Mapping[str, Any]) -> str:
    if not math.isfinite(parameter.get("ratio", math.nan)):
        return "" if math.isnan(parameter["rmse_ln"]) else f"rms {parameter['rmse_ln']:.3f}"
    return f"{parameter['ratio']:.3f} \\[{parameter['ratio_q025']:.3f}, {parameter['ratio_q975']:.3f}]"


def _seconds(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms" if seconds < 1.0 else f"{seconds:.3g} s"


def _shown(value: Mapping[str, Any] | None, *, inverse: bool = False, brief: bool = False) -> str:
    if value is None:
        return ""
    middle, low, high = value["value"], value["q05"], value["q95"]
    if not math.isfinite(middle) or (inverse and not (low > 0.0 and middle > 0.0)):
        return "none"
    if inverse:
        middle, low, high = 1.0 / middle, 1.0 / high, 1.0 / low
    if brief or not (math.isfinite(low) and math.isfinite(high)):
        return f"{middle:.3g}"
    if not (low > 0.0 and high < 1e4 * low):
        return f"{middle:.3g} (undetermined)"
    return f"{middle:.3g} \\[{low:.3g}, {high:.3g}]"
