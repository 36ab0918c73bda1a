"""White noise with memory: a moving average, whose correlation cuts off, or a first-order process.

A moving average of neighbours that pull apart is white noise with quantization noise: quantization_noise.py."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from selfcal.base.grid import Array
from selfcal.diagnosis.cause import Cause, Extension, Grouping, Key, Simulated, Written, shown
from selfcal.diagnosis.causes import quantization_noise
from selfcal.diagnosis.finding import Finding
from selfcal.diagnosis.model_tree import add_law, digits
from selfcal.diagnosis.record import Record
from selfcal.likelihood.fit import Fit, best
from selfcal.likelihood.state import ALIKE, NET_LEAST, Look, State, net, normal_entry
from selfcal.model.file import Model
from selfcal.model.laws import RATIO_LIMITS


def looks(state: State, record: Record) -> list[Look]:
    """The better of the two, the drift fitted with it. Of two as good, neighbours that pull apart are a counter's."""
    if state.extras.color:
        return []
    w = np.nan_to_num(state.whitened)
    n = max(1, int(np.isfinite(state.y).sum()))
    lags: Array = np.array([float(w[k:] @ w[:-k]) / n for k in (1, 2)])
    if 0.5 * n * float(lags @ lags) < 2.0:
        return []
    found: list[Look] = []
    start = math.atanh(min(0.9, max(-0.9, float(lags[0]))))
    for color in ("ma", "ar"):
        extras = replace(state.extras, color=color)
        gain, fits = state.with_terms({"color": start}, color=color)
        chosen = best(fits)
        if chosen.quantized:
            found.append(quantization_noise.look_of(chosen, gain, state, extras))
            continue
        sizes, changes = _sizes(chosen), {"extras": extras}
        found.append(Look("colored_noise", gain, net(gain), sizes, changes, measure=lambda final: _sizes(final.best)))
    average, process = found
    counter = average.cause == "quantization_noise"
    return [average if average.gain > process.gain - ALIKE * counter else process]


def _sizes(chosen: Fit) -> dict[str, Any]:
    m = math.tanh(chosen.value("color"))
    lag1 = m / (1.0 + m * m) if chosen.terms.color == "ma" else m
    return {"lag1": normal_entry(lag1, (1.0 - lag1 * lag1) / math.sqrt(chosen.n), "1")}


def _extend(at: Extension) -> None:
    """A law for white noise with memory.

    A first-order process at the bank's own rate is a Gauss-Markov drift of its correlation time, next to a walk. Block
    means of a faster process, and a moving average, are correlated with their neighbours alone."""
    tree, fit = at.tree, at.found[at.axis].state.best
    correlation = math.tanh(fit.value("color"))
    at_bank_rate = abs(fit.dt * float(tree["bank_rate_hz"]) - 1.0) < 0.01
    if fit.terms.color == "ar" and correlation > 0.0 and at_bank_rate and "correlation_time_s" not in tree:
        time_s = -fit.dt / math.log(correlation)
        most = min(10.0 * fit.sigma / max(fit.K * math.sqrt(time_s), 1e-300), RATIO_LIMITS[1])
        tree["correlation_time_s"] = digits(time_s)
        prior = {"law": "log_uniform", "min": digits(0.01 * most), "max": digits(most)}
        add_law(tree, "walk_and_markov", "markov_ratio", prior)
        return
    add_law(tree, "moving_average", "spectral_ratio", {"law": "log_uniform", "min": 0.2, "max": 5.0})


def _stated(finding: Finding, model: Model) -> bool:
    """Whether a law has coloured noise, or a drift of its correlation time."""
    dt, lag1 = finding.after.dt, finding.look.estimate["lag1"]
    terms = [term for law in model.laws.values() for term in law.terms if term.kind == "markov" and term.stated]
    short = any(lag1["q05"] <= math.exp(-dt * term.bandwidth) <= lag1["q95"] for term in terms)
    return short or any(law.coloured_noise for law in model.laws.values())


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    return {"lag1": (math.sqrt(2.0 * NET_LEAST / state.best.n), "1")}


CAUSE = Cause(
    "colored_noise",
    "The white noise has memory: neighbouring samples are correlated.",
    "Record at the sensor's full rate with its filter off.",
    source="read-out",
    looks=looks,
    slow=True,
    pictures=shown("correlation"),
    least=_least,
    grouping=Grouping(alike=lambda a, b: True),
    written=Written(extend=_extend, stated=_stated),
    simulated=Simulated(keys={"lag1": Key(lambda s: 0.5, "noise_lag1", lambda v: -1.0 < v < 1.0, "between -1 and 1")}),
)
