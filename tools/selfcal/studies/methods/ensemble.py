"""The same simulated records for every method: how near the truth, how honest the interval, how good the choice."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from selfcal.adequacy.drawn import draw_parameters, simulate_bank_samples
from selfcal.base.grid import Array, Mask
from selfcal.batch.spread import Row
from selfcal.model.file import Group, Model, Prior
from selfcal.model.laws import NAMED
from selfcal.studies.methods import Rival
from selfcal.studies.methods.problem import Answer, Problem

#: The method that errors are compared with.
REFERENCE = "ml"
#: A law's weight counts as this at least: the log score of a sure and wrong choice stays finite.
LEAST_WEIGHT = 1e-6


@dataclass(frozen=True)
class Cell:
    """A record of the ensemble: which law, how many samples, the seed."""

    law: str
    samples: int
    seed: int


def rows_of(model: Model, axis: str, truth_from: str, chosen: Sequence[Rival], cell: Cell) -> list[Row]:
    """A row for each method. The estimates are those of the true law, the weights those of all laws."""
    group = model.group_of(axis)
    truth = draw_parameters(group, cell.law, np.random.default_rng([cell.seed, list(NAMED).index(cell.law)]))
    if truth_from == "middle":
        truth |= {name: group.priors[name].median for name in NAMED[cell.law].parameters}
    y, _ = simulate_bank_samples(cell.law, truth, model.bank_rate_hz, cell.samples, cell.seed)
    problem = Problem(y, 1.0 / model.bank_rate_hz, replace(group, axes=(axis,)), tuple(model.hypotheses))
    rows: list[Row] = []
    for rival in chosen:
        function = rival.load()
        start = time.process_time()
        try:
            answer = function(problem)
        except Exception:  # whatever another's library raises counts as no answer
            answer = Answer({})
        row: Row = {"law": cell.law, "samples": cell.samples, "seed": cell.seed, "rival": rival.name}
        row["seconds"] = time.process_time() - start
        estimates = answer.estimates.get(cell.law, {})
        for name in NAMED[cell.law].parameters:
            row[f"truth.{name}"] = truth[name]
            for key in ("value", "q05", "q95"):
                row[f"{key}.{name}"] = getattr(estimates[name], key) if name in estimates else math.nan
        for criterion, weights in answer.weights.items():
            for law, weight in weights.items():
                row[f"weight.{criterion}.{law}"] = weight
        rows.append(row)
    return rows


def ensemble_summary(rows: Sequence[Row], group: Group) -> list[dict[str, Any]]:
    """An entry for each number of samples, law and method.

    Of each parameter: the rms error of its logarithm, over the reference's with a 95 % interval; the share of the 90 %
    intervals that hold the truth; the share of records without an answer. An estimate beyond the prior counts as the
    prior's limit for every method alike, because a user who sees a white noise of 1e-10 knows better. `unclipped` is
    the ratio without that.
    """
    entries = []
    for samples in dict.fromkeys(row["samples"] for row in rows):
        for law in dict.fromkeys(row["law"] for row in rows):
            cell = [row for row in rows if row["samples"] == samples and row["law"] == law]
            by_rival: dict[str, list[Row]] = {}
            for row in cell:
                by_rival.setdefault(str(row["rival"]), []).append(row)
            for name, mine in by_rival.items():
                entry: dict[str, Any] = {"samples": samples, "law": law, "rival": name, "records": len(mine)}
                entry["seconds"] = float(np.median([row["seconds"] for row in mine]))
                entry["parameters"] = {
                    parameter: _errors(mine, by_rival.get(REFERENCE), parameter, group.priors[parameter])
                    for parameter in NAMED[law].parameters
                }
                entry["choice"] = {criterion: _choice(mine, criterion, law) for criterion in _criteria(mine)}
                entries.append(entry)
    return entries


def _criteria(rows: Sequence[Row]) -> list[str]:
    """Criteria by which a method weighs the laws."""
    stated = (key for row in rows for key, value in row.items() if value is not None)
    return sorted({key.split(".")[1] for key in stated if key.startswith("weight.")})


def _column(rows: Sequence[Row], key: str) -> Array:
    return np.array([math.nan if row.get(key) is None else row[key] for row in rows], dtype=float)


def _errors(mine: Sequence[Row], reference: Sequence[Row] | None, name: str, prior: Prior) -> dict[str, Any]:
    truth, value = np.log(_column(mine, f"truth.{name}")), _column(mine, f"value.{name}")
    low, high = _column(mine, f"q05.{name}"), _column(mine, f"q95.{name}")
    error = _ln_clipped(value, prior) - truth
    answered = np.isfinite(error)
    stated = np.isfinite(low) & np.isfinite(high)
    inside = (np.log(np.maximum(low, 1e-300)) <= truth) & (truth <= np.log(np.maximum(high, 1e-300)))
    entry: dict[str, Any] = {
        "no_answer": float(1.0 - answered.mean()),
        "at_a_limit": float(((value < prior.min) | (value > prior.max)).mean()),
        "rmse_ln": _rms(error[answered]),
        "coverage_90": float(inside[stated].mean()) if stated.any() else math.nan,
        "interval_stated": float(stated.mean()),
    }
    if reference is not None:
        theirs = _column(reference, f"value.{name}")
        both = answered & np.isfinite(theirs)
        pair = (error[both], (_ln_clipped(theirs, prior) - truth)[both])
        entry["ratio"], entry["ratio_q025"], entry["ratio_q975"] = _ratio(*pair)
        with np.errstate(divide="ignore", invalid="ignore"):
            raw = np.log(value) - truth, np.log(theirs) - truth
        finite = np.isfinite(raw[0]) & np.isfinite(raw[1])
        entry["unclipped"], entry["unclipped_q025"], entry["unclipped_q975"] = _ratio(raw[0][finite], raw[1][finite])
    return entry


def _ln_clipped(value: Array, prior: Prior) -> Array:
    return np.log(np.clip(value, prior.min, prior.max))


def _rms(error: Array) -> float:
    return math.sqrt(float((error**2).mean())) if error.size else math.nan


def _ratio(ours: Array, theirs: Array) -> tuple[float, float, float]:
    """Ratio of two rms errors of the same records, with 2.5 % and 97.5 % of a bootstrap that resamples the records."""
    if not ours.size or not theirs.any():
        return math.nan, math.nan, math.nan
    counts = np.random.default_rng(1).multinomial(ours.size, np.full(ours.size, 1.0 / ours.size), 2000)
    drawn = np.sqrt((counts @ ours**2) / (counts @ theirs**2))
    low, high = np.quantile(drawn, [0.025, 0.975])
    return _rms(ours) / _rms(theirs), float(low), float(high)


def _choice(rows: Sequence[Row], criterion: str, law: str) -> dict[str, float]:
    """How often the true law has the greatest weight; mean of the ln of its weight, with the standard error."""
    laws = sorted({key.split(".")[2] for row in rows for key in row if key.startswith(f"weight.{criterion}.")})
    weight = np.array([_column(rows, f"weight.{criterion}.{weighed}") for weighed in laws])
    true = weight[laws.index(law)]
    score = np.log(np.maximum(np.nan_to_num(true), LEAST_WEIGHT))
    hit: Mask = true >= np.nan_to_num(weight).max(axis=0)
    return {
        "hit_rate": float(hit.mean()),
        "log_score": float(score.mean()),
        "log_score_sd": float(score.std() / math.sqrt(score.size)),
    }


def over_laws(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """By number of samples, method and criterion: the means over the laws of hit rate and log score."""
    groups: dict[tuple[int, str, str], list[Mapping[str, float]]] = {}
    for entry in entries:
        for criterion, choice in entry["choice"].items():
            groups.setdefault((entry["samples"], entry["rival"], criterion), []).append(choice)
    return [
        {
            "samples": samples,
            "rival": rival,
            "criterion": criterion,
            "hit_rate": float(np.mean([choice["hit_rate"] for choice in choices])),
            "log_score": float(np.mean([choice["log_score"] for choice in choices])),
            "log_score_sd": math.hypot(*(choice["log_score_sd"] for choice in choices)) / len(choices),
        }
        for (samples, rival, criterion), choices in groups.items()
    ]
