"""What was looked for and not found: the size from which this record would have shown it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import brentq

from selfcal.diagnosis.causes import noise, periodic, step
from selfcal.diagnosis.fit import run
from selfcal.diagnosis.record import Record, smoothed
from selfcal.diagnosis.state import NET_LEAST, State, net
from selfcal.diagnosis.statemodel import Array
from selfcal.recording import SIDE_CHANNELS
from selfcal.regressors import coefficient_unit


def not_found(state: State, record: Record, found: set[str]) -> list[dict[str, Any]]:
    """One entry for every cause that has a size: half of the records with it would have been named."""
    n = int(np.isfinite(state.y).sum())
    t = record.time_s
    rows: list[dict[str, Any]] = []

    def add(cause: str, **sizes: tuple[float, str]) -> None:
        if cause not in found:
            size = {key: {"value": value, "unit": unit} for key, (value, unit) in sizes.items()}
            rows.append({"cause": cause, "would_have_been_found": size})

    middle = np.zeros(t.size)
    middle[t.size // 2 :] = 1.0
    # Half way between the slowest line looked for and the fastest, in octaves.
    frequency = math.sqrt(3.0 / t[-1] * 0.5 * record.rate_hz)
    columns: dict[str, Array] = {
        "ramp": t - 0.5 * t[-1],
        "step": middle,
        "periodic": np.sin(2.0 * math.pi * frequency * t),
    }
    for cause, values in record.channels.items():
        columns[cause] = smoothed(values, round(10.0 * record.rate_hz)) - float(values.mean())
    for name, values in record.other_axes(state.axis).items():
        columns[f"axis_{name}"] = values
    least = {cause: _least(state, values, NET_LEAST) for cause, values in columns.items()}
    add("ramp", slope=(least["ramp"], f"{state.unit}/s"))
    steps = step.scan(state.series, state.best)
    add("step", amplitude=(least["step"] * math.sqrt(_gain_for(steps.worth)), state.unit))
    add(
        "periodic",
        amplitude=(
            least["periodic"] * math.sqrt(_gain_for(lambda gain: net(gain, 2, periodic.ln_lines(n, gain)))),
            state.unit,
        ),
        frequency_hz=(frequency, "Hz"),
    )
    for cause, (_, unit) in SIDE_CHANNELS.items():
        if cause in least and math.isfinite(least[cause]):
            add(cause, coefficient=(least[cause], coefficient_unit(state.unit, unit)))
    others = {key: value for key, value in least.items() if key.startswith("axis_") and math.isfinite(value)}
    if others:
        worst = max(others, key=lambda key: others[key])
        unit = record.axes[worst.removeprefix("axis_")].unit
        add("cross_axis", coefficient=(others[worst], coefficient_unit(state.unit, unit)))
    add("colored_noise", lag1=(math.sqrt(2.0 * NET_LEAST / n), "1"))
    change = NET_LEAST * _gain_for(lambda gain: net(gain, 1, noise.ln_changes(n, gain)))
    add("variance_change", ratio=(1.0 + math.sqrt(4.0 * change / n), "1"))
    # One sample so far off that its evidence pays for the choice among n.
    add("outliers", deviation=(math.sqrt(2.0 * (NET_LEAST + math.log(n))) * state.best.sigma, state.unit))
    add("missing_samples", missing=(1e-3 * record.present.size, "samples"))
    return rows


def _least(state: State, column: Array, nats: float) -> float:
    """The coefficient of a column that gains so many nats at the fitted noise."""
    series = state.series.beside(column)
    G = run(series, state.best.terms, state.best.theta)[0][0].G / state.best.sigma**2
    k = len(G) - 1
    cross = G[1:k, k]
    A = G[k, k] - cross @ np.linalg.pinv(G[1:k, 1:k], rcond=1e-12, hermitian=True) @ cross
    return math.sqrt(2.0 * nats / A) if 1e-9 * G[k, k] < A else math.inf


def _gain_for(worth: Callable[[float], float]) -> float:
    """The gain that is worth NET_LEAST after its search, over NET_LEAST."""
    gain = brentq(lambda gain: worth(gain) - NET_LEAST, NET_LEAST / 2.0, 10.0 * NET_LEAST)
    return float(gain) / NET_LEAST
