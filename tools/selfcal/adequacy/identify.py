"""One axis of a recording by one engine: the posterior of every law, and what speaks against the likeliest."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal import _library32
from selfcal.adequacy.allan import Sampled, sample_lengths, sampled
from selfcal.adequacy.checks import against, coefficients_of, judge, with_drift, with_rate, with_readings
from selfcal.adequacy.counted import weigh_counted
from selfcal.adequacy.document import Identified
from selfcal.adequacy.one_over_f import weigh, with_white
from selfcal.adequacy.summary import halved_after, summarize
from selfcal.bank.blocks import MOST_DENSE, Blocks, kept_out, usable_blocks
from selfcal.bank.result import AxisResult, in_unit
from selfcal.bank.subsets import combine
from selfcal.base.errors import OutsidePriors, UserError
from selfcal.logs.recording import SIDE_CHANNELS, Recording, as_float
from selfcal.model.file import Model
from selfcal.model.regressors import choices_of, columns_of, mask_of, offered
from selfcal.model.tables import make_tables
from selfcal.readings.gate import gated
from selfcal.readings.readings import copied, look, mostly_beyond
from selfcal.readings.rest import outside_priors

#: Spacing of float32 in the noise of a reading from which on a nominal offset is taken off before.
SPACING_LEAST = 0.01


def stretch_of(recording: Recording, model: Model, start_s: float | None, end_s: float | None, gate: bool) -> Recording:
    """The part of a recording that a verb looks at: `--start`, `--end`, `--gate`."""
    stretch = recording.between(start_s, end_s)
    return gated(stretch, model) if gate else stretch


def with_reasons(found: dict[str, Identified | UserError], recording: Recording, model: Model) -> None:
    """Give the axes outside the priors their reason: one for all of them."""
    outside = [name for name, axis in found.items() if isinstance(axis, OutsidePriors)]
    if outside:
        reason = UserError(outside_priors(recording, model, outside))
        found.update(dict.fromkeys(outside, reason))


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
) -> Identified:
    """One axis by one engine. The record is fed as float32, as the firmware gets it; less a nominal offset where that
    is too coarse. Readings that are none are left out (`readings.py`). With regressors every subset of them is scored;
    `advance` is called after each. `draw`: with the Allan deviation of the samples."""
    recording = recording.along(name)
    group, unit = model.group_of(name), recording.columns[name].unit
    regressors = offered(model, name)
    if most := mostly_beyond(recording.in_unit(name, group.unit), group):
        raise UserError(most)
    before = [one for one in model.axes[: model.axes.index(name)] if one in recording.columns]
    if reason := copied(recording, name, before):
        raise UserError(reason)
    readings = look(recording, name, group)
    recording = readings.recording
    tables = make_tables(replace(model, regressors=regressors), recording.rate_hz, (name,), bank_rate_hz=decimate)
    values, offset = readings.working, 0.0
    if readings.clipped is not None or readings.coarse > SPACING_LEAST:
        # What takes the place of clipped readings may lie beyond the range, and so may readings less an offset.
        beyond = np.abs(values) >= (group.range if readings.clipped is None and group.range > 0.0 else np.inf)
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


def may_act(model: Model, recording: Recording, name: str) -> list[str]:
    """The columns that may act on an axis: the side channels and the other axes, but for those that the model file has
    move together with it."""
    known = {*model.axes, *(column for column, _ in SIDE_CHANNELS.values())} - {name}
    if model.hidden_input is not None and name in model.hidden_input.loadings:
        known -= model.hidden_input.loadings.keys()
    return [column for column in recording.columns if column in known]


def kept_out_of(blocks: Blocks, recording: Recording, moved: int) -> dict[str, int]:
    """Samples that were not used, by reason; `moved` of them for motion that the readings show."""
    moving = {"moving": recording.moving + moved} if recording.moving + moved else {}
    return {**blocks.kept_out, "missing": recording.lost, **moving}


def _used(mask: int) -> list[int]:
    return [k for k in range(mask.bit_length()) if mask >> k & 1]
