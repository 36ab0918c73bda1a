"""An axis of a recording by an engine: the posterior of every law, and the evidence against the likeliest."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from selfcal import _library32
from selfcal.adequacy.allan import Sampled, sample_lengths, sampled
from selfcal.adequacy.checks import against, coefficients_of, judge_record, with_rate, with_readings
from selfcal.adequacy.counted import weigh_counted
from selfcal.adequacy.identify_document import Identified
from selfcal.adequacy.one_over_f import Rerun, weigh, with_white
from selfcal.adequacy.summary import halved_after, summarize
from selfcal.bank.axis_result import AxisResult, in_unit
from selfcal.bank.blocks import MOST_DENSE, Blocks, kept_out, usable_blocks
from selfcal.bank.subsets import ScoredSubsets, combine
from selfcal.base.errors import OutsidePriors, UserError
from selfcal.base.grid import Array
from selfcal.logs.recording import SIDE_CHANNELS, Recording, as_float, check_column
from selfcal.model.file import Group, Model, Regressor
from selfcal.model.regressors import choices_of, columns_of, mask_of, offered
from selfcal.model.tables import Tables, make_tables
from selfcal.readings.lattice import FINE
from selfcal.readings.readings import Readings, copied, look, mostly_beyond
from selfcal.readings.rest import outside_priors


def with_reasons(axes: dict[str, Identified | UserError], recording: Recording, model: Model) -> None:
    """Give the axes outside the priors a common reason."""
    outside = [name for name, axis in axes.items() if isinstance(axis, OutsidePriors)]
    if outside:
        reason = UserError(outside_priors(recording, model, outside))
        axes.update(dict.fromkeys(outside, reason))


def chosen_axes(recording: Recording, model: Model, wanted: Sequence[str]) -> tuple[str, ...]:
    """The axes to work on, in the model's order: those asked for, else all that the recording has."""
    for name in wanted:
        model.group_of(name)
        check_column(recording, name)
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
    """An axis by an engine. The record is fed as float32, as the firmware gets it; less a nominal offset where that is
    too coarse. Wrong readings are left out (`readings.py`). With regressors every subset of them is scored; `advance`
    is called after each. `draw`: with the Allan deviation of the samples."""
    recording = recording.along(name)
    fed = _fed(recording, name, model, decimate)
    if engine == "reference":
        results = _by_reference(fed, model, advance)
    else:
        results = _by_library(fed, engine == "fixed", advance)
    group, unit = fed.group, recording.columns[name].unit
    means = fed.tables.dt_s, fed.blocks.mean.size, fed.tables.block
    converted = [in_unit(with_white(result, group, *means), group.unit, unit) for result in results]
    best, inside, scored, answer = 0, results[0], None, converted[0]
    if fed.regressors:
        if not any(math.isfinite(value) for result in results for value in result.log_evidence.values()):
            raise OutsidePriors
        combined = combine(fed.choices, results, model.hypotheses, group.unit)
        best, inside = combined.best, combined.result
        scored = combine(fed.choices, converted, model.hypotheses, unit)
        answer = scored.result
    others, mask = may_act(model, fed.recording, name), mask_of(fed.regressors, fed.choices[best])
    identified = concluded(fed, unit, others, results[best], mask, inside, answer, scored, draw=draw)
    moved = fed.recording.moving + int(fed.readings.moving.sum())
    moving = {"moving": moved} if moved else {}
    return replace(identified, kept_out={**fed.blocks.kept_out, "missing": fed.recording.lost, **moving})


def concluded(
    fed: Fed,
    unit: str,
    others: Sequence[str],
    result: AxisResult,
    mask: int,
    inside: AxisResult,
    answer: AxisResult,
    scored: ScoredSubsets | None,
    *,
    draw: bool = False,
    as_fed: bool = False,
) -> Identified:
    """What the input of an engine and its results say of an axis in `unit`. `result`: of the regressors of `mask`, by
    which the record is judged; `inside` of all choices; `answer` the same in `unit`. `others`: `may_act`. `as_fed`: the
    engine took every reading."""
    group, tables, readings = fed.group, fed.tables, fed.readings
    means, used = (tables.dt_s, fed.blocks.mean.size, tables.block), _used(mask)
    judged = judge_record(fed.blocks, tables, group, result, fed.recording, others, used)
    if "drift_in_average" in against(judged.checks):
        step = 0.0 if readings.lattice is None else readings.lattice.step
        judged = with_rate(judged, fed.used, fed.recording.missing_before, step, tables, result)
    judged = with_readings(judged, readings, group, unit, tables.dt_s, as_fed=as_fed)
    explained = fed.columns[:, used].astype(np.float64) @ coefficients_of(result) if used else 0.0
    missing, columns = fed.recording.missing_before, fed.columns if fed.regressors else None
    rerun = Rerun(tables, group, fed.samples, missing, columns, mask, fed.offset)
    beside, counted = weigh(rerun), weigh_counted(readings.lattice, result, rerun)
    more_laws = [law.laws(answer.probability) for law in (beside, counted) if law is not None]
    return Identified(
        unit,
        group.unit,
        answer,
        judged,
        fed.blocks.kept_out,
        scored,
        fed.curve(explained) if draw else None,
        summarize(inside, group, *means, beside, counted),
        halved_after(inside, group, *means),
        next(filter(None, more_laws), {}),
    )


@dataclass(frozen=True)
class Fed:
    """Input of an engine for an axis: its `samples` [n] less `offset` and `columns` [n, p] of the `regressors`, both as
    float32; and the `blocks` of the bank. `recording`: of the rows that `readings` have."""

    recording: Recording
    readings: Readings
    group: Group
    tables: Tables
    regressors: tuple[Regressor, ...]
    samples: NDArray[np.float32]
    offset: float
    columns: NDArray[np.float32]
    blocks: Blocks

    @property
    def choices(self) -> list[tuple[Regressor, ...]]:
        """Every subset of the regressors that is scored."""
        return choices_of(self.regressors)

    @property
    def used(self) -> Array:
        """The samples [n], NaN where the engine takes none."""
        return np.where(np.logical_or.reduce(list(kept_out(self.samples, self.group).values())), np.nan, self.samples)

    def curve(self, explained: Array | float) -> Sampled:
        """The Allan deviation of the samples less what is `explained` [n] of them."""
        values = self.used
        lengths = sample_lengths(int(np.isfinite(values).sum()), self.tables.block)
        return sampled(values - explained, self.recording.missing_before, self.recording.rate_hz, lengths)


def _fed(recording: Recording, name: str, model: Model, decimate: float | None) -> Fed:
    """The samples of an axis without wrong readings. Raises UserError where it has no result."""
    group, regressors = model.group_of(name), offered(model, name)
    if most := mostly_beyond(recording.in_unit(name, group.unit), group):
        raise UserError(most)
    before = [axis for axis in model.axes[: model.axes.index(name)] if axis in recording.columns]
    if reason := copied(recording, name, before):
        raise UserError(reason)
    readings = look(recording, name, group)
    recording = readings.recording
    tables = make_tables(replace(model, regressors=regressors), recording.rate_hz, (name,), bank_rate_hz=decimate)
    values, offset = readings.working, 0.0
    shown = readings.coarse > FINE  # the lattice of float32 shows in the noise of a reading
    if readings.clipped is not None or shown:
        # Substitutes of clipped readings may lie beyond the range, and so may readings less an offset.
        beyond = np.abs(values) >= (group.range if readings.clipped is None and group.range > 0.0 else np.inf)
        values = np.where(beyond, np.nan, values)
        group = replace(group, range=0.0)
        tables = replace(tables, axes=(replace(tables.axes[0], range=0.0),))
    if shown:
        offset = float(np.float32(np.nanmedian(values)))
    samples, columns = as_float(values - offset), as_float(columns_of(regressors, recording))
    for name_of, column in zip([column.name for column in tables.regressors], columns.T, strict=True):
        beyond = np.abs(column) >= _library32.SAMPLE_MAX
        if beyond.any():
            raise UserError(f"the regressor {name_of} is {column[beyond][0]:g} at {int(beyond.sum())} samples")
    blocks = usable_blocks(samples, recording.missing_before, tables, group, columns, readings.counted)
    blocks = replace(blocks, mean=blocks.mean + offset)
    return Fed(recording, readings, group, tables, regressors, samples, offset, columns, blocks)


def _by_library(fed: Fed, fixed: bool, advance: Callable[[], object]) -> list[AxisResult]:
    """The result of each choice of regressors by the C code."""
    from selfcal.bank.library import Bank

    bank = Bank(fed.tables, build="_fixed" if fixed else "_library32", offset=fed.offset)
    bank.push(fed.samples[:, None], fed.recording.missing_before, fed.columns if fed.regressors else None)
    results = []
    for choice in fed.choices:
        results.append(bank.report(0, mask_of(fed.regressors, choice), fed.blocks.after / fed.recording.rate_hz))
        advance()
    return results


def _by_reference(fed: Fed, model: Model, advance: Callable[[], object]) -> list[AxisResult]:
    """The result of each choice of regressors by the textbook bank in double."""
    from selfcal.bank import reference

    if model.half_life_s:
        raise UserError("the reference bank forgets nothing: take --engine library, or a model without half_life_s")
    if model.handling.outlier_sd:
        raise UserError("the reference bank takes outliers: take --engine library, or leave handle.outlier_sd out")
    blocks, tables = fed.blocks, fed.tables
    if blocks.mean.size > MOST_DENSE:
        raise UserError(f"{blocks.mean.size} bank intervals, gaps included, are too many for the reference")
    z = blocks.z - np.array([column.reference for column in tables.regressors])
    sd = np.array([column.coefficient_sd[0] for column in tables.regressors])
    results = []
    for choice in fed.choices:
        used = _used(mask_of(fed.regressors, choice))
        beside, law_sd = (z[:, used] if used else None), sd[used].tolist()
        ahead_s = blocks.after / fed.recording.rate_hz
        own = blocks.mean, tables.dt_s, fed.group, model.hypotheses, blocks.r
        results.append(reference.reference_axis(*own, beside, law_sd, tables.block, ahead_s))
        advance()
    return results


def may_act(model: Model, recording: Recording, name: str) -> list[str]:
    """The columns that may act on an axis: the side channels and the other axes, but for those that the model file has
    move together with it, or follow it."""
    candidates = {*model.axes, *(column for column, _ in SIDE_CHANNELS.values())} - {name}
    candidates -= {axis for axis in model.axes if any(column.column == name for column in offered(model, axis))}
    if model.hidden_input is not None and name in model.hidden_input.loadings:
        candidates -= model.hidden_input.loadings.keys()
    return [column for column in recording.columns if column in candidates]


def _used(mask: int) -> list[int]:
    return [k for k in range(mask.bit_length()) if mask >> k & 1]
