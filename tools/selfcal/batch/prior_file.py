"""`fleet --write-model`: the batch as the priors of a module's model file.

A new unit's parameter is drawn from the population: log-normal about its mean. Its sd has the spread between units, how
well the batch determines this spread and the mean, and what sets lots apart. The part of a station or a day is left
out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import yaml

from selfcal.bank.priors import prior_tree
from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.base.output import write_text
from selfcal.batch.batch_summary import Batch, axes_of, sound_of
from selfcal.batch.population import TWO_GROUPS, Population
from selfcal.model.file import LOG_NORMAL_SD, Model, Prior, read_yaml


def write_model(path: Path | str, model: Model, batch: Batch) -> dict[str, dict[str, Prior]]:
    """Write the file of `model` with the batch's priors to `path`; return these, by axis and parameter.

    Each axis has own priors of the parameters that the batch identifies. The odds of the laws are the batch's, of the
    axes that it has. All else is the model's.
    Raises UserError where the batch has no population.
    """
    tree = read_yaml(model.path, "model file")
    priors: dict[str, dict[str, Prior]] = {}
    for population in batch.populations:
        axis, _, parameter = population.measured.name.rpartition(".")
        if population.measured.logarithm:
            priors.setdefault(axis, {})[parameter] = _prior(population)
    if not priors:
        raise UserError("--write-model: no parameter has a population: it takes five units that identify it")
    for group in model.groups:
        own = tree["groups"][group.name].get("own_priors") or {}
        for axis in (axis for axis in group.axes if axis in priors):
            trees = {name: prior_tree(prior) for name, prior in priors[axis].items()}
            own[axis] = own.get(axis, {}) | {
                name: {key: value if isinstance(value, str) else _rounded(value) for key, value in stated.items()}
                for name, stated in trees.items()
            }
        if own:
            tree["groups"][group.name]["own_priors"] = own
    for law, odds in _odds(model, batch).items():
        stated = tree["hypotheses"][law]
        tree["hypotheses"][law] = {**stated, "probability": odds} if isinstance(stated, dict) else odds
    Model.of_tree(tree, Path(path))
    head = f"# Priors of {len(batch.devices)} units, by `selfcal fleet`.\n"
    write_text(path, head + yaml.safe_dump(tree, sort_keys=False, width=120))
    return priors


def prior_lines(priors: Mapping[str, Mapping[str, Prior]], model: Model) -> Iterator[str]:
    """A line for each prior."""
    for axis, own in priors.items():
        for name, prior in own.items():
            unit = units.parameter_unit(name, model.group_of(axis).unit)
            yield f"prior of a new unit: {axis}.{name}: {prior.median:.4g} {unit}, sd of ln {prior.sd:.2g}"


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


def _prior(population: Population) -> Prior:
    """The log-normal prior of a new unit's parameter, in the unit of the axis's group."""
    fit = population.fit
    mean = float(fit.weight @ fit.mean)
    variance = float(fit.weight @ (fit.t**2 + fit.variance + (fit.mean - mean) ** 2))
    shift = _of_lots(population)
    sd = math.sqrt(variance + float(np.var(shift)))
    return Prior.log_normal(math.exp(mean + float(np.mean(shift))), min(max(sd, LOG_NORMAL_SD[0]), LOG_NORMAL_SD[1]))


def _of_lots(population: Population) -> np.ndarray:
    """Offset of each unit [n] by its lot, or by its side of two groups: its own, unlike a station's part."""
    shift = np.zeros(population.measured.at.size)
    for apart in population.apart:
        if apart.kind in ("lot", TWO_GROUPS) or any(name.startswith("lot ") for name in apart.also):
            shift += apart.shift(population.measured.at)
    return shift


def _odds(model: Model, batch: Batch) -> dict[str, float]:
    """Prior odds of each law, the mean over the model's axes. An axis in the batch has the share of the units, and a
    unit more of each law. Any other axis has the model's odds."""
    there = set(axes_of(batch.devices))
    total = dict.fromkeys(model.hypotheses, 0.0)
    for axis in model.axes:
        share = dict(model.hypotheses)
        if axis in there:
            units = [results[-1]["hypotheses"] for results in sound_of(batch.devices, axis).values()]
            share = {law: (1.0 + sum(unit[law] for unit in units)) / (len(units) + len(share)) for law in share}
        total = {law: total[law] + share[law] for law in total}
    return {law: _rounded(odds / len(model.axes)) for law, odds in total.items()}
