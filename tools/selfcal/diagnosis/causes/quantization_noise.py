"""Quantization noise: an angle or a velocity counted in increments, whose differences are read.

A reading is the bias, white noise of density N, and (e_k - e_(k-1)) / dt with e white of standard deviation Q. The
Allan deviation of that is sqrt(3) Q / tau. White and quantization noise together are a moving average of neighbours
that pull apart. The mean of a block telescopes: it is the same law, with the same Q, at the block's interval.
colored_noise.py fits the moving average, and gives it this name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from selfcal.base import units
from selfcal.base.grid import Array
from selfcal.diagnosis.cause import Cause, Channels, Extension, Grouping, Simulated, Written, positive, shown
from selfcal.diagnosis.model_tree import add_law, digits
from selfcal.diagnosis.record import Record
from selfcal.likelihood.fit import Fit
from selfcal.likelihood.state import NET_LEAST, Look, State, net, normal_entry
from selfcal.likelihood.statemodel import Terms
from selfcal.model.laws import RATIO_LIMITS

#: Factor by which the prior of the spectral ratio reaches either way about the recording's, and never above 1.
WITHIN = 5.0


def look_of(fit: Fit, gain: float, state: State, extras: Terms) -> Look:
    """The look whose moving average, of a negative coefficient, is `fit`.

    The record knows the size s of the innovations and the coefficient m independently: N = s (1 + m) sqrt(dt) and
    Q = s sqrt(-m) dt."""
    changes = {"extras": extras}
    measure = partial(_measured, state.unit)
    return Look("quantization_noise", gain, net(gain), _sizes(state.unit, fit), changes, measure=measure)


def _measured(unit: str, final: State) -> dict[str, Any]:
    """Sizes of the final fit; empty if the coefficient has changed its sign there."""
    return _sizes(unit, final.best) if final.best.quantized else {}


def _sizes(unit: str, fit: Fit) -> dict[str, Any]:
    m, n = math.tanh(fit.value("color")), max(fit.n, 1.0)
    size = fit.sigma / math.sqrt(1.0 + m * m)
    N, of_N = size * (1.0 + m) * math.sqrt(fit.dt), math.sqrt((0.5 + (1.0 - m) / (1.0 + m)) / n)
    Q, of_Q = size * math.sqrt(-m) * fit.dt, math.sqrt((0.5 + (1.0 - m * m) / max(4.0 * m * m, 1e-12)) / n)
    return {
        "Q": normal_entry(Q, Q * of_Q, units.times_second(unit)),
        "N": normal_entry(N, N * of_N, f"{unit}/sqrt(Hz)"),
    }


def _law(tree: dict[str, Any], look: Look) -> None:
    """White noise of the spectral ratio that the look has at the bank's rate, within a factor, with a walk."""
    Q, N = (float(look.estimate[key]["median"]) for key in ("Q", "N"))
    ratio = 1.0 / math.sqrt(1.0 + 4.0 * (Q / N) ** 2 * float(tree["bank_rate_hz"]))
    limits = digits(max(ratio / WITHIN, RATIO_LIMITS[0]), 2), digits(min(ratio * WITHIN, 1.0), 2)
    prior = {"law": "log_uniform", "min": limits[0], "max": limits[1]}
    add_law(tree, "moving_average", "spectral_ratio", prior)


def _extend(at: Extension) -> None:
    _law(at.tree, at.finding.look)


def _add(keys: Mapping[str, Any], channels: Channels) -> Array:
    """Differences of a counter's remainders, over the interval of the readings: each is uniform in an increment."""
    interval_s = float(channels.time_s[1] - channels.time_s[0])
    increment = math.sqrt(12.0) * float(keys["Q"])
    return np.asarray(np.diff(increment * channels.random.random(channels.time_s.size + 1)) / interval_s)


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    """The Q whose correlation of neighbours, -Q^2 / (N^2 dt + 2 Q^2), would have been found."""
    lag1 = min(math.sqrt(2.0 * NET_LEAST / state.best.n), 0.4)
    size = state.best.sigma * state.dt * math.sqrt(lag1 / (1.0 - 2.0 * lag1))
    return {"Q": (size, units.times_second(state.unit))}


CAUSE = Cause(
    "quantization_noise",
    "The readings are differences of a counted angle or velocity: quantization noise stands beside the white noise.",
    "State the increment of the counter, or record the counter itself.",
    source="read-out",
    pictures=shown("correlation"),
    least=_least,
    grouping=Grouping(alike=lambda a, b: True),
    written=Written(
        law=_law, extend=_extend, stated=lambda finding, model: any(law.coloured_noise for law in model.laws.values())
    ),
    simulated=Simulated(keys={"Q": positive(lambda s: s.n * math.sqrt(s.duration_s / s.samples))}, add=_add),
)
