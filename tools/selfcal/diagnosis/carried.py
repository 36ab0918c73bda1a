"""What a finding gains on a second recording: the bank's own evidence there, with the finding in the model and without.

The evidence is sequential: each bank sample is predicted from the samples before, over the posterior of the noise's
parameters. Coefficients are those of the first recording. A size that belongs to a recording, such as a line's phase,
is weighed anew under its prior. Each finding is left out of the model with all of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import yaml
from scipy.special import logsumexp

from selfcal.bank.library import Bank
from selfcal.bank.priors import state_own
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.diagnosis.cause import Extension
from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.extend import regressor_key
from selfcal.diagnosis.finding import Diagnosed, Finding
from selfcal.diagnosis.record import Record
from selfcal.likelihood.heldout import HeldOut, score_entry, sd_of_mean
from selfcal.logs.recording import Recording, as_float
from selfcal.model.file import Model, Regressor
from selfcal.model.regressors import columns_of, mask_of, offered
from selfcal.model.tables import make_tables
from selfcal.readings.readings import Readings, look

#: Pieces of the second recording whose scatter gives the uncertainty.
SECOND_PIECES = 12
#: Bank samples of the second recording at least: the bank reports on five and more, and each piece has as many.
SECOND_LEAST = 5 * SECOND_PIECES


@dataclass(frozen=True)
class BankTerm:
    """A finding as a part of the bank's model: columns with their coefficients, or a change of the model file's tree.
    `anew`: the sizes of its columns are weighed anew."""

    finding: Finding
    columns: tuple[Regressor, ...]
    coefficients: tuple[float, ...]
    anew: bool


def gains(
    model: Model, tree: Mapping[str, Any], record: Record, found: Mapping[str, Diagnosed], second: Recording
) -> dict[str, tuple[list[HeldOut], HeldOut]]:
    """Entries by axis: each finding of `found`, by gain, and all together. `tree`: the extended model file's."""
    return {name: _of_axis(model, tree, record, found, name, second) for name in found}


def _of_axis(
    model: Model, tree: Mapping[str, Any], record: Record, found: Mapping[str, Diagnosed], name: str, second: Recording
) -> tuple[list[HeldOut], HeldOut]:
    findings = found[name].by_gain
    if name not in second.columns:
        none = HeldOut(None, f"{second.path} has no axis {name}")
        return [none] * len(findings), none
    extended: dict[str, Regressor] = {
        regressor.name: regressor for regressor in Model.of_tree(tree, model.path).regressors
    }
    terms = [why_stays(finding) or term_of(found[name], finding, extended) for finding in findings]
    carried = [term for term in terms if isinstance(term, BankTerm)]
    if not carried:
        return [HeldOut(None, str(term)) for term in terms], HeldOut(None, "no finding is in the bank's model")
    try:
        readings = look(second.along(name), name, model.group_of(name))
        whole = _evidence(model, record, found, name, readings, carried)
    except UserError as error:
        none = HeldOut(None, str(error))
        return [HeldOut(None, term) if isinstance(term, str) else none for term in terms], none

    def gained(others: Sequence[BankTerm]) -> HeldOut:
        """Gain of all terms over the `others`."""
        try:
            return HeldOut(_compared(_evidence(model, record, found, name, readings, others), whole))
        except UserError as error:
            return HeldOut(None, str(error))

    each = [
        HeldOut(None, term)
        if isinstance(term, str)
        else gained([term_kept for term_kept in carried if term_kept is not term])
        for term in terms
    ]
    return each, gained([])


def why_stays(finding: Finding) -> str:
    """Why no other recording can have a finding; "": another can."""
    cause = CAUSES[finding.look.cause]
    return cause.score.no_carry(finding.look) or cause.score.once


def term_of(axis: Diagnosed, finding: Finding, extended: Mapping[str, Regressor]) -> BankTerm | str:
    """The finding as a part of the bank's model, or why it cannot be. `extended`: the model file's regressors."""
    cause = CAUSES[finding.look.cause]
    added = finding.columns
    if added:
        entries = [CAUSES[column.cause].written.entry(column.entry, finding.look, axis.record) for column in added]
        pairs = zip(entries, added, strict=True)
        keys = dict.fromkeys(entry.get("name", regressor_key(column.name)) for entry, column in pairs)
        if not all(key in extended for key in keys):
            return "the extended model has no room for its column"
        at = {column.name: k for k, column in enumerate(axis.state.regressors)}
        if not all(column.name in at for column in added):
            return "the final model does not have it"
        c = tuple(float(axis.state.best.c[1 + at[column.name]]) for column in added)
        return BankTerm(finding, tuple(extended[key] for key in keys), c, cause.score.anew)
    if cause.written.extend is not None and not cause.score.no_gain:
        return BankTerm(finding, (), (), False)
    return cause.score.no_gain or "the bank's model does not change by it"


def _evidence(
    model: Model,
    record: Record,
    found: Mapping[str, Diagnosed],
    name: str,
    readings: Readings,
    terms: Sequence[BankTerm],
) -> Array:
    """Bank samples and ln evidence [2, SECOND_PIECES] after each piece of the second recording, with `terms`."""
    own = with_terms(model, record, found, name, terms, [column for t in terms if t.anew for column in t.columns])
    regressors = offered(own, name)
    recording = readings.recording
    values = readings.working.copy()
    for term in terms:
        if term.columns and not term.anew:
            about = np.array([column.reference for column in term.columns])
            values -= (columns_of(term.columns, recording) - about) @ np.array(term.coefficients)
    tables = make_tables(replace(own, regressors=regressors), recording.rate_hz, (name,))
    bank = Bank(tables)
    prior = {hypothesis.name: hypothesis.ln_probability for hypothesis in tables.hypotheses}
    rows, columns = as_float(values)[:, None], as_float(columns_of(regressors, recording))
    if values.size < SECOND_LEAST:
        raise UserError(f"the second recording is too short: {values.size} bank samples, and {SECOND_LEAST} are needed")
    cuts = np.linspace(0, values.size, SECOND_PIECES + 1).astype(int)
    after = []
    for first, last in pairwise(cuts):
        piece = slice(first, last)
        bank.push(rows[piece], recording.missing_before[piece], columns[piece] if regressors else None)
        known = bank.report(0, mask_of(regressors, regressors))
        after.append((known.n, float(logsumexp([prior[law] + ln for law, ln in known.log_evidence.items()]))))
    evidence = np.array(after, np.float64).T
    if not np.isfinite(evidence).all():
        raise UserError("the priors of the model leave nothing of the second recording")
    return evidence


def with_terms(
    model: Model,
    record: Record,
    found: Mapping[str, Diagnosed],
    name: str,
    terms: Sequence[BankTerm],
    columns: Iterable[Regressor],
) -> Model:
    """The model with the laws of the terms of an axis, and these columns."""
    tree: dict[str, Any] = yaml.safe_load(model.path.read_text(encoding="utf-8"))
    state_own(tree, model)
    for term in terms:
        extend = CAUSES[term.finding.look.cause].written.extend
        if extend is not None and not term.columns:
            extend(Extension(tree, model, record, name, found, term.finding))
    own = Model.of_tree(tree, model.path)
    own = replace(own, regressors=(*own.regressors, *columns))
    if own.regressors:  # a module with columns handles no changes
        own = replace(own, handling=replace(own.handling, steps=False, variance_changes=False))
    return own


def _compared(without: Array, whole: Array) -> dict[str, Any]:
    """The contract's `gain_on`. The priors decide the first piece, so the scatter is taken over the others."""
    if (without[0] != whole[0]).any():
        raise UserError("the bank takes other samples with the finding than without")
    n = whole[0]
    steps = np.diff(whole[1] - without[1]) / np.maximum(np.diff(n), 1.0)
    return score_entry(float(without[1, -1] / n[-1]), float(whole[1, -1] / n[-1]), sd_of_mean(steps), n[-1])
