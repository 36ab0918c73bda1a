"""Warm start: what `diagnose` measured of a part becomes the prior of this part's module.

The next rest of the part differs: at another temperature, after another start. Its parameter differs from this record's
by RUN_TO_RUN, sd of the logarithm, besides what the record leaves open. The prior is log-uniform within
PRIOR_REACH times both together, and so WIDENED times as wide as both. A coefficient's prior is normal and as wide.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.bank.axis_result import HALF_90, LAW_LEAST
from selfcal.base import units
from selfcal.base.errors import UserError, short, short_value
from selfcal.base.limits import read_text, reading
from selfcal.model.file import LONGEST_TEXT, MOST_HYPOTHESES, Model
from selfcal.model.laws import PARAMETERS, PLACES, RATIOS
from selfcal.model.tables import HypothesisTable, PriorLaw, PriorRow, RegressorTable, Tables

#: Half the width of a measured prior, in sd of what is expected of ln(parameter); sd of that prior over this sd.
PRIOR_REACH = 4.0
WIDENED = PRIOR_REACH / math.sqrt(3.0)
#: sd of ln(parameter) from one rest of a part to its next, by place: N; the drift parameter; alpha or the ratio.
#: From three runs of one ADIS16405 (tests/ACCURACY.md, "Warm start"). Of a coefficient, assumed: the runs have no
#: temperature.
RUN_TO_RUN = {"N": 0.05, "K": 0.2, "sigma_m": 0.2, "B": 0.2}
RUN_TO_RUN_COEFFICIENT = 0.1
#: Most ln odds of a regressor: a faint regressor may be in use in the next record, and a sure regressor may not.
MOST_LN_ODDS = math.log1p(-LAW_LEAST) - math.log(LAW_LEAST)
#: How far rounding takes a sum of probabilities beyond 1: the bank reports floats.
SUM_ROUNDING = MOST_HYPOTHESES * float(np.finfo(np.float32).eps)


@dataclass(frozen=True)
class AxisStart:
    """An axis, in the model's unit. `limits`: ln limits by law and parameter. `coefficients`: mean and sd by column.
    `ln_odds` that a regressor is in use, by its name."""

    limits: Mapping[str, Mapping[str, tuple[float, float]]]
    coefficients: Mapping[str, tuple[float, float]]
    ln_odds: Mapping[str, float]


@dataclass(frozen=True)
class Start:
    """What a diagnosis knows of each axis, and the recording that it comes `of`, in words."""

    of: str
    axes: Mapping[str, AxisStart]

    def applied(self, tables: Tables) -> Tables:
        """The tables with these priors. An axis that the diagnosis lacks keeps the model's."""
        known = [self.axes.get(axis.name) for axis in tables.axes]
        return replace(
            tables,
            hypotheses=tuple(_hypothesis(h, tables, known) for h in tables.hypotheses),
            regressors=tuple(_regressor(column, known) for column in tables.regressors),
        )


def warmed(tables: Tables, start: Start | None) -> Tables:
    """The tables with the priors of a start, if any."""
    return tables if start is None else start.applied(tables)


def _hypothesis(h: HypothesisTable, tables: Tables, known: list[AxisStart | None]) -> HypothesisTable:
    rows = []
    for at, (axis, start) in enumerate(zip(tables.axes, known, strict=True)):
        plain = zip(axis.ln_min, axis.ln_max, axis.law, len(PARAMETERS) * (False,), strict=True)
        row: list[PriorRow] = list(h.priors[at] if h.priors else plain)
        for parameter, (low, high) in (start.limits.get(h.name, {}) if start is not None else {}).items():
            least, most, law, _ = row[PLACES[parameter]]
            if law == PriorLaw.LOG_NORMAL:
                law = PriorLaw.LOG_UNIFORM  # the posterior has the normal in it
            row[PLACES[parameter]] = (max(least, low), min(most, high), law, True)
        rows.append(tuple(row))
    return replace(h, priors=tuple(rows))


def _regressor(column: RegressorTable, known: list[AxisStart | None]) -> RegressorTable:
    sd, odds = list(column.coefficient_sd), list(column.ln_odds)
    mean = [0.0] * len(sd)
    for at, start in enumerate(known):
        if start is None or sd[at] == 0.0:
            continue
        odds[at] = start.ln_odds.get(column.name, odds[at])
        measured, width = start.coefficients.get(column.name, (0.0, math.inf))
        if width < sd[at]:  # else the record says less than the model file
            mean[at], sd[at] = measured, width
    return replace(column, coefficient_sd=tuple(sd), coefficient_mean=tuple(mean), ln_odds=tuple(odds))


def load_start(path: Path | str, model: Model) -> Start:
    """Read the file that `diagnose --json` writes. Raises UserError for any other file, and for another model's."""
    return _Reader(Path(path), model).start()


class _Reader:
    """Every complaint names the file and the entry."""

    def __init__(self, path: Path, model: Model) -> None:
        self.path = path
        self.model = model

    def fail(self, where: str, what: str) -> UserError:
        return UserError(f"{self.path}: {where}: {what}" if where else f"{self.path}: {what}")

    def tree(self) -> dict[str, Any]:
        from selfcal.diagnosis.diagnose_document import SCHEMA  # takes long to import

        try:
            text = read_text(self.path, 1 << 25, "not a diagnosis")
        except OSError as error:
            raise UserError(f"{self.path}: cannot read the diagnosis: {error.strerror}") from error
        with reading(self.path, "not a diagnosis (the JSON that `selfcal diagnose --json` writes)"):
            tree = json.loads(text)
        told = tree.get("schema") if isinstance(tree, dict) else None
        if told != SCHEMA:
            said = f"schema {short_value(told)}" if told is not None else "no schema"
            raise self.fail("", f"not a diagnosis: {said}, not {SCHEMA} (the JSON that `selfcal diagnose` writes)")
        assert isinstance(tree, dict)
        return tree

    def mapping(self, tree: Any, key: str, where: str) -> dict[str, Any]:
        found = tree.get(key)
        if not isinstance(found, dict):
            raise self.fail(f"{where}{key}", f"must be a mapping, not {short_value(found)}")
        return found

    def number(self, tree: Mapping[str, Any], key: str, where: str, low: float = -math.inf) -> float:
        value = tree.get(key)
        try:
            number = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
        except OverflowError:  # an integer of hundreds of digits
            number = math.inf
        if not math.isfinite(number) or number <= low:
            above = "" if low == -math.inf else f" above {low:g}"
            raise self.fail(f"{where}.{key}", f"must be a finite number{above}, not {short_value(value)}")
        return number

    def probability(self, tree: Mapping[str, Any], key: str, where: str) -> float:
        """0 to 1, and the rounding of a sum."""
        value = self.number(tree, key, where)
        if not -SUM_ROUNDING <= value <= 1.0 + SUM_ROUNDING:
            raise self.fail(f"{where}.{key}", f"must be 0 to 1, not {value:g}")
        return value

    def start(self) -> Start:
        tree = self.tree()
        recording = self.mapping(tree, "recording", "")
        name = Path(str(recording.get("path"))).name
        if not name.isprintable() or not 0 < len(name) <= LONGEST_TEXT:
            raise self.fail("recording.path", f"must be the name of a file, not {short_value(name)}")
        duration_s = self.number(recording, "duration_s", "recording", 0.0)
        if _meaning(Model.of_tree(self.mapping(tree, "model", ""), self.path)) != _meaning(self.model):
            raise self.fail(
                "",
                f"is of another model than {self.model.path}: take the one that `diagnose "
                "--write-model` wrote in the same run",
            )
        axes = self.mapping(tree, "axes", "")
        for axis in axes:
            if axis not in self.model.axes:
                known = ", ".join(self.model.axes)
                raise self.fail("axes", f"the model has no axis '{short(axis)}' (it has {known})")
        found = {
            axis: self.axis(axis, entry)
            for axis, entry in axes.items()
            if not (isinstance(entry, dict) and entry.get("posterior") is None)
        }
        if not found:
            raise self.fail("", "has no posterior of any axis: diagnose a recording at rest, with this release")
        return Start(f"{', '.join(found)} from {name}, {duration_s:.0f} s", found)

    def axis(self, axis: str, entry: Any) -> AxisStart:
        where, group = f"axes.{axis}", self.model.group_of(axis)
        if not isinstance(entry, dict):
            raise self.fail(where, f"must be a mapping, not {short_value(entry)}")
        try:
            factor = units.factor(str(entry.get("unit")), group.unit)
        except UserError as error:
            raise self.fail(f"{where}.unit", str(error)) from None
        posterior = self.mapping(entry, "posterior", f"{where}.")
        where += ".posterior"
        laws = self.mapping(posterior, "parameters", f"{where}.")
        if set(laws) != set(self.model.hypotheses):
            raise self.fail(f"{where}.parameters", f"must have the laws {', '.join(self.model.hypotheses)}")
        hypotheses = self.mapping(posterior, "hypotheses", f"{where}.")
        limits: dict[str, dict[str, tuple[float, float]]] = {}
        share = {law: self.probability(hypotheses, law, f"{where}.hypotheses") for law in laws}
        for law in sorted(laws, key=lambda law: -share[law]):
            if share[law] < LAW_LEAST:
                # What such a law says of N is wrong, and a wider prior would have it win where N has changed.
                likeliest = next(iter(limits.values()), {})
                limits[law] = {"N": likeliest["N"]} if "N" in likeliest else {}
                continue
            inside = f"{where}.parameters.{law}"
            of_law = self.mapping(laws, law, f"{where}.parameters.")
            if set(of_law) != set(self.model.laws[law].parameters):
                raise self.fail(inside, f"must have {', '.join(self.model.laws[law].parameters)}")
            entries = {name: self.mapping(of_law, name, f"{inside}.") for name in of_law if of_law[name] is not None}
            limits[law] = {
                name: self.limits(estimate, f"{inside}.{name}", name, axis, factor)
                for name, estimate in entries.items()
                if estimate.get("identified") is True
            }
        coefficients, odds = self.regressors(posterior.get("regressors") or {}, f"{where}.regressors", factor)
        return AxisStart(limits, coefficients, odds)

    def limits(
        self, entry: Mapping[str, Any], where: str, parameter: str, axis: str, factor: float
    ) -> tuple[float, float]:
        scale = 1.0 if parameter in ("alpha", *RATIOS) else factor
        q05, middle, q95 = (math.log(scale * self.number(entry, key, where, 0.0)) for key in ("q05", "median", "q95"))
        if not q05 < middle < q95:
            raise self.fail(where, "q05, median and q95 must ascend")
        prior = self.model.group_of(axis).priors[parameter]
        if not math.log(prior.min) <= middle <= math.log(prior.max):
            raise self.fail(f"{where}.median", f"lies outside the model's prior, {prior.min:g} to {prior.max:g}")
        half = PRIOR_REACH * math.hypot((q95 - q05) / (2.0 * HALF_90), RUN_TO_RUN.get(parameter, 0.4))
        return middle - half, middle + half

    def regressors(
        self, tree: Any, where: str, factor: float
    ) -> tuple[dict[str, tuple[float, float]], dict[str, float]]:
        coefficients: dict[str, tuple[float, float]] = {}
        odds: dict[str, float] = {}
        columns_of = {regressor.name: regressor.columns for regressor in self.model.regressors}
        if not isinstance(tree, dict) or not set(tree) <= set(columns_of):
            raise self.fail(where, f"must be a mapping of the model's regressors ({', '.join(columns_of) or 'none'})")
        for name in tree:
            one = self.mapping(tree, name, f"{where}.")
            probability = self.probability(one, "probability", f"{where}.{name}")
            against = max(1.0 - probability, 1e-300)
            odds[columns_of[name][0]] = min(
                max(math.log(max(probability, 1e-300) / against), -MOST_LN_ODDS), MOST_LN_ODDS
            )
            told = self.mapping(one, "coefficients", f"{where}.{name}.")
            if set(told) != set(columns_of[name]):
                raise self.fail(f"{where}.{name}.coefficients", f"must have {', '.join(columns_of[name])}")
            for column in told if probability > 0.5 else ():
                entry, inside = self.mapping(told, column, f"{where}.{name}.coefficients."), f"{where}.{name}.{column}"
                mean = factor * self.number(entry, "mean", inside)
                sd = factor * self.number(entry, "sd", inside, 0.0)
                coefficients[column] = mean, WIDENED * math.hypot(sd, RUN_TO_RUN_COEFFICIENT * mean)
        return coefficients, odds


def _meaning(model: Model) -> str:
    """All of a model that its priors are of: a text, since a window that is not stated is no number."""
    of = (model.bank_rate_hz, model.groups, model.hypotheses, model.laws, model.regressors, model.half_life_s)
    return repr(of)
