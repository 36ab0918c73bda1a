"""The bias of each axis by the readings of all axes, where the model file states a quantity that moves several."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.diagnosis.suspicion import rough
from selfcal.likelihood.joint import Joint, bins_of, fit_joint, last
from selfcal.logs.recording import Recording
from selfcal.model.file import HiddenInput, Model


def add_biases(document: dict[str, Any], recording: Recording, model: Model, stated: HiddenInput) -> None:
    """Put `together` into `bias_now` of the axes of `identify` that the quantity moves."""
    judged = [name for name, axis in document["axes"].items() if "error" not in axis and name in stated.loadings]
    try:
        record, states = rough(recording, model, judged)
    except UserError:
        return
    if not states:
        return
    y = np.array([state.rest for state in states.values()])
    scale = np.nanstd(np.diff(y, axis=1), axis=1) / np.sqrt(2.0)
    dt, loadings = 1.0 / record.rate_hz, np.array([stated.loadings[name] for name in states])
    y /= scale[:, None]
    known = beside(y, dt, stated.deviation * loadings / scale, stated.alpha * dt)
    for (name, state), mean, sd in zip(states.items(), *(scale * each for each in last(known, y)), strict=True):
        now = document["axes"][name]["bias_now"]
        factor = units.factor(state.unit, now["unit"])
        columns = state.level + float(state.best.c @ state.series.columns[:, -1])
        now["together"] = {"mean": float((columns + mean) * factor), "sd": float(sd * factor)}


def beside(y: Array, dt: float, loading: Array, rate: float) -> Joint:
    """The model of records y [m, n] of means `dt` s long, with a quantity of that `loading` [m] and `rate` a mean: the
    axes' own drifts and white noise are fitted with it."""
    bins = bins_of(y)
    alone = fit_joint(bins, dt, f=False)
    return fit_joint(bins, dt, f=True, start=replace(alone, loading=loading, rate=rate), held=True)
