"""`selfcal identify`: hypothesis probabilities, parameters with intervals and the bias of a recording at rest."""

from __future__ import annotations

import json as json_module
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from selfcal import _library32
from selfcal import units as unit_module
from selfcal.errors import UserError, printable
from selfcal.export import FORMS, write_export
from selfcal.model import LAWS, RATIOS, SUMS, Group, Model
from selfcal.output import write_text
from selfcal.recording import Recording, Scale, as_float, load
from selfcal.regressors import Scored, choices_of, columns_of, combine, mask_of, offered
from selfcal.result import AxisResult
from selfcal.tables import Tables, make_tables

SCHEMA = "selfcal.identify/1"
#: The table never folds its numbers: a narrower terminal wraps its lines.
TABLE_WIDTH = 140
#: Bank samples a report needs (SELFCAL_REPORT_MIN).
REPORT_MIN = 3
#: Bank intervals, gaps included, that are worked out one by one for the checks and the reference.
MOST_DENSE = 10_000_000
#: Laws of smaller probability are not spoken of where the grid does not bear them.
TOLD_OF = 0.01
#: A check fails beyond this many standard deviations of its statistic: a false alarm in 16 000 checks.
CHECK_LIMIT = 4.0


@dataclass(frozen=True)
class Identified:
    """One axis: the engine's `result` in `unit`, `checks` of its adequacy, the samples `kept_out`, and what is known of
    the regressors, if the model has any for it (coefficients in `unit` too)."""

    unit: str
    result: AxisResult
    checks: Mapping[str, Mapping[str, Any]]
    kept_out: Mapping[str, int]
    scored: Scored | None = None

    @property
    def adequate(self) -> bool:
        """All checks passed: nothing in the record speaks against the best model."""
        return all(bool(check["passed"]) for check in self.checks.values())


def identify(
    log: Path | str,
    *,
    axes: Sequence[str] = (),
    model: Path | str | None = None,
    engine: str = "library",
    decimate: float | None = None,
    json: Path | str | None = None,
    export: tuple[str, Path | str] | None = None,
    rate: float | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    scale: Mapping[str, Scale] | None = None,
) -> dict[str, Any]:
    """Identify the axes of a recording; returns the document `selfcal.identify/1` and writes it to `json`.

    `engine`: 'library' (the firmware's C code in float, one bank an axis), 'fixed' (its form for parts without an FPU,
    by 16-bit products) or 'reference' (the textbook bank in double, its grid refined until the probabilities settle).
    `decimate`: rate of the block means in Hz, else the model's.
    `export`: a format of `selfcal.export` and the file to write.
    Numbers are in the recording's units. Raises UserError for what the user can put right.
    """
    if export is not None and export[0] not in FORMS:
        raise UserError(f"--export: there is no format '{export[0]}' ({', '.join(FORMS)})")
    if engine not in ("library", "reference", "fixed"):
        raise UserError(f"there is no engine '{engine}' (library, reference, fixed)")
    if decimate is not None and not (math.isfinite(decimate) and decimate > 0.0):
        raise UserError("--decimate must be a rate above 0 Hz")
    loaded_model = Model.load(model)
    recording = load(log, rate=rate, columns=columns or {}, units=units or {}, scale=scale)
    names = chosen_axes(recording, loaded_model, [axes] if isinstance(axes, str) else axes)
    found: dict[str, Identified] = {}
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        subsets = sum(len(choices_of(offered(loaded_model, name))) for name in names)
        task = progress.add_task("identify", total=subsets)
        for name in names:
            progress.update(task, description=f"{name} ({engine})")
            try:
                found[name] = identify_axis(
                    recording, name, loaded_model, engine, decimate, lambda: progress.advance(task)
                )
            except UserError as error:
                raise UserError(f"{recording.path}: column {name}: {error}") from error
    document = to_document(recording, found)
    if json is not None:
        write_json(document, json)
    if export is not None:
        write_export(document, *export)
    return document


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
) -> Identified:
    """One axis by one engine. The record is fed as float32, as the firmware gets it. With regressors every subset of
    them is scored; `advance` is called after each."""
    group = model.group_of(name)
    regressors = offered(model, name)
    tables = make_tables(replace(model, regressors=regressors), recording.rate_hz, (name,), bank_rate_hz=decimate)
    samples = as_float(recording.in_unit(name, group.unit))
    columns = as_float(columns_of(regressors, recording))
    for name_of, column in zip([column.name for column in tables.regressors], columns.T, strict=True):
        beyond = np.abs(column) >= _library32.SAMPLE_MAX
        if beyond.any():
            raise UserError(f"the regressor {name_of} is {column[beyond][0]:g} at {int(beyond.sum())} samples")
    blocks = usable_blocks(samples, recording.missing_before, tables, group, columns)
    if engine == "reference" and model.half_life_s:
        raise UserError("the reference bank forgets nothing: take --engine library, or a model without half_life_s")
    choices = choices_of(regressors)
    results: list[AxisResult] = []
    z = blocks.z - np.array([column.reference for column in tables.regressors])
    sd = np.array([column.coefficient_sd[0] for column in tables.regressors])
    if engine in ("library", "fixed"):
        from selfcal.engines.library import Bank

        bank = Bank(tables, fixed=16 if engine == "fixed" else None)
        bank.push(samples[:, None], recording.missing_before, columns if regressors else None)
        for choice in choices:
            results.append(bank.report(0, mask_of(regressors, choice)))
            advance()
    else:
        from selfcal.engines import reference

        if blocks.mean.size > MOST_DENSE:
            raise UserError(f"{blocks.mean.size} bank intervals, gaps included, are too many for the reference")
        for choice in choices:
            used = _used(mask_of(regressors, choice))
            with_columns = (z[:, used], sd[used].tolist()) if used else ()
            results.append(
                reference.identify_axis(blocks.mean, tables.dt_s, group, model.hypotheses, blocks.r, *with_columns)
            )
            advance()
    unit = recording.columns[name].unit
    if not regressors:
        checks = innovation_checks(blocks, tables, group, results[0], [])
        return Identified(unit, in_unit(results[0], group.unit, unit), checks, blocks.kept_out)
    if not any(math.isfinite(value) for result in results for value in result.log_evidence.values()):
        from selfcal.engines.library import outside_priors

        raise UserError(outside_priors(tables.axes[0]))
    inside = combine(choices, results, model.hypotheses, group.unit)
    used = _used(mask_of(regressors, choices[inside.best]))
    checks = innovation_checks(blocks, tables, group, results[inside.best], used)
    scored = combine(choices, [in_unit(result, group.unit, unit) for result in results], model.hypotheses, unit)
    return Identified(unit, scored.result, checks, blocks.kept_out, scored)


def usable_blocks(
    samples: NDArray[np.float32],
    missing_before: NDArray[np.int64],
    tables: Tables,
    group: Group,
    columns: NDArray[np.float32] | None = None,
) -> Blocks:
    """block_means() of float32 samples [n] and columns [n, p]. Raises UserError if no report can come of them."""
    z = None if columns is None else columns.astype(np.float64)
    blocks = block_means(samples.astype(np.float64), missing_before, tables.block, group, z)
    present = blocks.mean[np.isfinite(blocks.mean)]
    needed = REPORT_MIN + len(tables.regressors)
    kept = ", ".join(f"{count} {what}" for what, count in blocks.kept_out.items() if count) or "none"
    if present.size < needed:
        found = f"{present.size} averages of {tables.dt_s:g} s"
        raise UserError(f"too short: {found}, {needed} are needed (samples kept out: {kept})")
    if not present.std() > 0.0:
        equal = f"all {present.size} averages are equal ({present[0]:g} {group.unit})"
        raise UserError(f"{equal}: a stuck or too coarse reading (samples kept out: {kept})")
    return blocks


def _used(mask: int) -> list[int]:
    return [k for k in range(mask.bit_length()) if mask >> k & 1]


@dataclass(frozen=True)
class Blocks:
    """What the library's averager makes of a record, worked out on its own in double for the reference and the checks.

    `mean` [m] of each bank interval, NaN where fewer than half of its samples are usable; `r` [m] samples a block over
    those used; `within_sd` of the samples about their block's mean, NaN with one sample a block; `kept_out` counts the
    samples that were not used, by reason; `z` [m, p] are the means of the regressors' columns. Blocks beyond MOST_DENSE
    intervals are not worked out.
    """

    mean: NDArray[np.float64]
    r: NDArray[np.float64]
    within_sd: float
    kept_out: Mapping[str, int]
    z: NDArray[np.float64]


def block_means(
    samples: NDArray[np.float64],
    missing_before: NDArray[np.int64],
    block: int,
    group: Group,
    columns: NDArray[np.float64] | None = None,
) -> Blocks:
    """Average `samples` [n] in blocks on the even grid of sample instants; saturated and stuck samples are kept out.
    `columns` [n, p] of the regressors are averaged over the same samples."""
    finite = np.isfinite(samples)
    limit = np.float32(group.range) if group.range > 0.0 else np.inf
    saturated = finite & (np.abs(samples) >= limit)
    stuck = np.zeros(samples.size, bool)
    if group.stuck_limit > 0:
        change = np.flatnonzero(np.diff(samples, prepend=np.nan) != 0.0)
        run = np.arange(samples.size) - np.repeat(change, np.diff(np.append(change, samples.size))) + 1
        stuck = finite & (run >= group.stuck_limit)
    usable = finite & ~saturated & ~stuck
    kept_out = {
        "missing": int(missing_before.sum()),
        "not_finite": int((~finite).sum()),
        "saturated": int(saturated.sum()),
        "stuck": int(stuck.sum()),
    }
    at = np.arange(samples.size) + np.cumsum(missing_before)
    if not usable.any():
        raise UserError(f"no usable sample: all are saturated (range {group.range:g} {group.unit}) or stuck")
    at -= at[np.argmax(usable)]
    columns = np.empty((samples.size, 0)) if columns is None else columns
    values, index, rows = samples[usable], at[usable] // block, columns[usable]
    count = min(int(at[-1] + 1) // block, MOST_DENSE + 1)
    keep = index < count
    values, index, rows = values[keep], index[keep], rows[keep]
    used = np.bincount(index, minlength=count)
    total = np.bincount(index, values, minlength=count)
    with np.errstate(invalid="ignore", divide="ignore"):
        raw = total / used
        sums = [np.bincount(index, column, minlength=count) for column in rows.T]
        z = np.column_stack([np.empty((count, 0)), *sums]) / used[:, None]
        mean = np.where(used * 2 >= block, raw, np.nan)
        r = np.where(used * 2 >= block, block / used, 1.0)
    good = np.isfinite(mean)[index]
    freedom = int(good.sum()) - int(np.isfinite(mean).sum())
    squares = float(((values - raw[index])[good] ** 2).sum())
    within = math.sqrt(squares / freedom) if freedom > 0 else math.nan
    first = int(np.argmax(np.isfinite(mean))) if np.isfinite(mean).any() else 0
    return Blocks(mean[first:], r[first:], within, kept_out, z[first:])


def innovation_checks(
    blocks: Blocks, tables: Tables, group: Group, result: AxisResult, used: list[int]
) -> dict[str, dict[str, Any]]:
    """Are the innovations of the most probable law, at its posterior medians and with the columns `used`, of mean 0 (a
    ramp that a random walk follows leaves one), white, normal and of one variance?"""
    from selfcal import _reference
    from selfcal.engines.reference import textbook_node

    if blocks.mean.size > MOST_DENSE:
        return {}
    law = max(result.probability, key=lambda name: result.probability[name])
    at = {name: np.array([estimate.median]) for name, estimate in result.parameters[law].items()}
    drift, alpha, walk = (float(value[0]) for value in textbook_node(law, at, group.correlation_time_s))
    offset = float(np.nanmean(blocks.mean))
    z = blocks.z - np.array([column.reference for column in tables.regressors])
    sd = np.array([column.coefficient_sd[0] for column in tables.regressors])
    nu = _reference.innovations(
        np.ascontiguousarray(blocks.mean - offset),
        tables.dt_s,
        -offset,
        group.priors["bias"].sd,
        list(LAWS).index(law),
        drift,
        alpha,
        float(at["N"][0]) / math.sqrt(tables.dt_s),
        blocks.r,
        np.ascontiguousarray(z[:, used]) if used else None,
        sd[used] if used else None,
        walk,
    )[1 + len(used) :]  # the first ones are the bias and the coefficients
    pairs = np.isfinite(nu[1:]) & np.isfinite(nu[:-1])
    whole = nu[np.isfinite(nu)]
    n = whole.size
    if n < 20:
        return {}
    half = n // 2
    lag1 = float((nu[1:] * nu[:-1])[pairs].sum() / (whole**2).sum())
    kurtosis = float(((whole - whole.mean()) ** 4).mean() / whole.var() ** 2 - 3.0)
    ratio = math.log(float(whole[half:].var() / whole[:half].var()))
    # Standard deviations under white normal innovations.
    checks = {
        "innovation_mean": (float(whole.mean() / whole.std()), 1.0 / math.sqrt(n)),
        "innovation_lag1": (lag1, 1.0 / math.sqrt(n)),
        "innovation_excess_kurtosis": (kurtosis, math.sqrt(24.0 / n)),
        "innovation_ln_variance_ratio_of_halves": (ratio, math.sqrt(8.0 / n)),
    }
    return {
        name: {"value": value, "limit": CHECK_LIMIT * sd, "passed": abs(value) <= CHECK_LIMIT * sd}
        for name, (value, sd) in checks.items()
    }


def in_unit(result: AxisResult, unit: str, to: str) -> AxisResult:
    """The result in `to` instead of `unit`: every number but alpha and the ratios, and the evidence, as a density per
    unit."""
    factor = unit_module.factor(unit, to)
    return AxisResult(
        result.n,
        {name: value - result.n * math.log(factor) for name, value in result.log_evidence.items()},
        result.probability,
        {
            law: {name: e if name in ("alpha", *RATIOS) else e.scaled(factor) for name, e in estimates.items()}
            for law, estimates in result.parameters.items()
        },
        result.bias_mean * factor,
        result.bias_sd * factor,
        {law: tuple((mean * factor, sd * factor) for mean, sd in pairs) for law, pairs in result.coefficients.items()},
    )


def to_document(recording: Recording, found: Mapping[str, Identified]) -> dict[str, Any]:
    """The JSON of the contract."""
    return {
        "schema": SCHEMA,
        "recording": {
            "path": str(recording.path),
            "rate_hz": recording.rate_hz,
            "samples": recording.samples,
            "duration_s": recording.duration_s,
        },
        "axes": {
            name: {
                "hypotheses": dict(axis.result.probability),
                "log_evidence": dict(axis.result.log_evidence),
                "parameters": {
                    law: {
                        parameter: {
                            "mean": e.mean,
                            "median": e.median,
                            "sd": e.sd,
                            "q05": e.q05,
                            "q95": e.q95,
                            "unit": unit_module.parameter_unit(parameter, axis.unit),
                            "identified": e.identified,
                            "off_grid": e.off_grid,
                        }
                        for parameter, e in estimates.items()
                    }
                    for law, estimates in axis.result.parameters.items()
                },
                "bias_now": {"mean": axis.result.bias_mean, "sd": axis.result.bias_sd, "unit": axis.unit},
                "samples_kept_out": dict(axis.kept_out),
                "adequate": axis.adequate,
                "checks": {key: dict(check) for key, check in axis.checks.items()},
                **_regressors(axis.scored),
            }
            for name, axis in found.items()
        },
    }


def _regressors(scored: Scored | None) -> dict[str, Any]:
    """The keys an axis has beyond the contract's if its model has regressors."""
    if scored is None:
        return {}
    return {
        "regressors": {
            name: {
                "probability": inclusion.probability,
                "coefficients": {
                    c.column: {key: getattr(c, key) for key in ("mean", "median", "sd", "q05", "q95", "unit")}
                    for c in inclusion.coefficients
                },
            }
            for name, inclusion in scored.inclusion.items()
        },
        "regressors_in_use": [one.name for one in scored.choices[scored.best]],
        "subsets": [
            {"regressors": [one.name for one in choice], "probability": probability}
            for choice, probability in zip(scored.choices, scored.probability, strict=True)
        ],
    }


def write_json(document: Mapping[str, Any], path: Path | str) -> None:
    """Write a document to a file, or to stdout for '-'. What JSON cannot say (infinity, not a number) becomes null."""
    text = json_module.dumps(_finite(document), indent=2, allow_nan=False) + "\n"
    if str(path) == "-":
        sys.stdout.write(text)
        return
    write_text(path, text)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def show(document: Mapping[str, Any]) -> None:
    """The table a person reads: per axis the laws, their probabilities and parameters, and the bias."""
    recording = document["recording"]
    table = Table(
        box=box.SIMPLE_HEAD,
        title=f"{escape(printable(recording['path']))}: {recording['samples']} samples, {recording['rate_hz']:g} Hz, "
        f"{recording['duration_s']:g} s",
        title_justify="left",
        caption="medians [5 %, 95 %] in the units of the recording; ~: this record does not identify it",
        caption_justify="left",
    )
    laws = {law for axis in document["axes"].values() for law in axis["hypotheses"]}
    drift = "K or sigma_m" if "flicker" not in laws else "K, sigma_m or B"
    second = "1/alpha, s" + (", or ratio" if laws & {law for law in SUMS if LAWS[law][2] in RATIOS} else "")
    for heading in ("law", "P", "N", drift, second):
        table.add_column(heading, no_wrap=True)
    failed: list[str] = []
    kept: list[str] = []
    for name, axis in document["axes"].items():
        best = max(axis["hypotheses"], key=lambda law: axis["hypotheses"][law])
        bias = axis["bias_now"]
        level = f"bias {bias['mean']:.6g} ± {bias['sd']:.2g}"
        table.add_row(f"{name} \\[{bias['unit']}]", "", level, "", "", style="cyan")
        for law, probability in axis["hypotheses"].items():
            parameters = axis["parameters"][law]
            table.add_row(
                law,
                f"{probability:.4f}",
                _interval(parameters["N"]),
                _interval(_first(parameters, ("K", "sigma_m", "B"))),
                _interval(parameters.get("alpha"), inverse=True) or _interval(_first(parameters, RATIOS)),
                style="bold" if law == best else None,
                end_section=law == list(axis["hypotheses"])[-1],
            )
        coarse = [
            law
            for law, parameters in axis["parameters"].items()
            if axis["hypotheses"][law] >= TOLD_OF and any(e["off_grid"] for e in parameters.values())
        ]
        if coarse:
            failed.append(f"not borne by the grid of nodes: {name}: {', '.join(coarse)}")
        counts = [f"{count} {what}" for what, count in axis.get("samples_kept_out", {}).items() if count]
        if counts:
            kept.append(f"kept out: {name}: {', '.join(counts)}")
        for check, outcome in axis["checks"].items():
            if not outcome["passed"]:
                failed.append(f"not adequate: {name}: {check} {outcome['value']:+.3f}, beyond ±{outcome['limit']:.3f}")
    console = Console()
    console.width = max(console.width, TABLE_WIDTH)
    console.print(table)
    if any("regressors" in axis for axis in document["axes"].values()):
        console.print(_regressor_table(document))
    for line in (*kept, *failed):
        console.print(line, highlight=False)


def _regressor_table(document: Mapping[str, Any]) -> Table:
    table = Table(
        box=box.SIMPLE_HEAD,
        caption="coefficients if in use: medians [5 %, 95 %]; the laws' parameters are those of each law's best subset",
        caption_justify="left",
    )
    for heading in ("axis", "regressor", "P(in use)", "coefficient", "unit"):
        table.add_column(heading, no_wrap=True)
    for name, axis in document["axes"].items():
        entries = list(axis.get("regressors", {}).items())
        for regressor, entry in entries:
            for column, c in entry["coefficients"].items():
                table.add_row(
                    name,
                    column,
                    f"{entry['probability']:.4f}",
                    "-" if not math.isfinite(c["median"]) else f"{c['median']:.4g} \\[{c['q05']:.4g}, {c['q95']:.4g}]",
                    c["unit"],
                    style="bold" if regressor in axis["regressors_in_use"] else None,
                    end_section=(regressor, entry) == entries[-1],
                )
    return table


def _first(parameters: Mapping[str, Any], names: Sequence[str]) -> Mapping[str, Any] | None:
    return next((parameters[name] for name in names if name in parameters), None)


def _interval(estimate: Mapping[str, Any] | None, *, inverse: bool = False) -> str:
    if estimate is None:
        return ""
    low, middle, high = estimate["q05"], estimate["median"], estimate["q95"]
    if not math.isfinite(middle):
        return "-"
    if inverse:
        low, middle, high = 1.0 / high, 1.0 / middle, 1.0 / low
    mark = "" if estimate["identified"] else "~"
    return f"{mark}{middle:.3g} \\[{low:.3g}, {high:.3g}]"
