"""The bias oscillates: a slow damped oscillator that white noise drives (swing.py), of the deviation `sd`.

A line of constant phase has a damping of 0. Its column needs no evidence for each turn, so `periodic` gains more there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from selfcal.base.grid import Array
from selfcal.diagnosis import swing
from selfcal.diagnosis.cause import Cause, Channels, Extension, Grouping, Key, Simulated, Written, positive, shown
from selfcal.diagnosis.causes import periodic
from selfcal.diagnosis.finding import Finding
from selfcal.diagnosis.model_tree import add_law, digits
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.statistics import states_of
from selfcal.diagnosis.swing import Swing
from selfcal.likelihood.fit import Fit
from selfcal.likelihood.state import ALIKE, Look, State, net, of_parameter
from selfcal.likelihood.statemodel import PERIOD_LIMITS, Matrices
from selfcal.model.file import Model
from selfcal.model.laws import DAMPING_LIMITS, RATIO_LIMITS
from selfcal.model.laws import swing as turned

#: The prior of the size in the model file, over the size found.
SIZE_RATIOS = (0.1, 10.0)


def looks(state: State, record: Record) -> list[Look]:
    """The oscillator that gains most, the drift fitted with it."""
    found = None if state.extras.oscillation else swing.found(state, slow=True)
    if found is None:
        return []
    line = _line(state, record, found) if found.keeps_phase else []
    if line:
        return line
    changes, unit = {"extras": replace(state.extras, oscillation=True), "fits": found.fits}, state.unit
    sizes = _sizes(found.fit, unit)
    look = Look("oscillation", found.gain, found.net, sizes, changes)
    return [replace(look, measure=lambda final: _sizes(final.best, unit))]


def _line(state: State, record: Record, found: Swing) -> list[Look]:
    """The line of this period where it explains as much: swings that keep their phase over the whole record have no
    damping. Its price is for the band in which oscillations are looked for."""
    period, _, _ = found.numbers
    width = 1.0 / (state.y.size * state.dt)
    tried = (1.0 / period + width * np.linspace(-1.0, 1.0, 17)).tolist()
    gains = state.scores([np.array([*periodic.pair(f, record).values()]) for f in tried])
    line = periodic.at(state, record, (tried[int(np.argmax(gains))],))
    if line.gain < found.gain - ALIKE:
        return []
    n = round(2.0 * state.y.size * state.dt / PERIOD_LIMITS[0])
    price = float(periodic.ln_lines(np.array(1.0 / (period * width)), n, np.array(line.gain)))
    return [replace(line, net=net(line.gain, 2, price), others=("oscillation",))]


def _sizes(chosen: Fit, unit: str) -> dict[str, Any]:
    return {
        "period_s": of_parameter(chosen, "ln_period", 1.0, "s"),
        "damping": of_parameter(chosen, "ln_damping", 1.0, "1"),
        "sd": of_parameter(chosen, "ln_swing", chosen.sigma, unit),
    }


def _alike(a: Look, b: Look) -> bool:
    """Whether each period lies in the other's interval."""
    one, two = a.estimate["period_s"], b.estimate["period_s"]
    return bool(one["q05"] <= two["median"] <= one["q95"] and two["q05"] <= one["median"] <= two["q95"])


def _add(keys: Mapping[str, Any], channels: Channels) -> Array:
    """The oscillation [n], by the exact transition from sample to sample."""
    t = channels.time_s
    F = turned(keys["period_s"], keys["damping"], float(t[1] - t[0]))
    law = Matrices(F, np.eye(2) - F @ F.T, np.array([float(keys["sd"]), 0.0]), np.eye(2), 0.0)
    return states_of(law, np.ones(t.size), channels.random)


def _extend(at: Extension) -> None:
    """A law of a walk and the oscillation, whose size is free. A law that states the same period already serves."""
    estimate, final = at.finding.look.estimate, at.found[at.axis].state
    period = estimate["period_s"]
    if any(period["q05"] <= other <= period["q95"] for other in _periods(at.tree)):
        return
    w = 2.0 * math.pi / period["median"]
    walk = next(fit for fit in final.fits if fit.terms.walk)
    K = max(walk.K, 2.0 * float(at.group["priors"]["K"]["min"]))
    ratio = estimate["sd"]["median"] * math.sqrt(w) / K
    low, high = (min(max(by * ratio, RATIO_LIMITS[0]), RATIO_LIMITS[1]) for by in SIZE_RATIOS)
    term = {
        "kind": "oscillation",
        "period_s": digits(period["median"]),
        "damping": digits(min(max(estimate["damping"]["median"], DAMPING_LIMITS[0]), DAMPING_LIMITS[1])),
        "deviation": "ratio",
    }
    add_law(
        at.tree,
        f"oscillation_{period['median']:.0f}s",
        "markov_ratio",
        {"law": "log_uniform", "min": digits(min(low, 0.1 * high)), "max": digits(high)},
        {"probability": 1, "terms": ["walk", term]},
    )


def _periods(tree: Mapping[str, Any]) -> list[float]:
    """Periods of the oscillations that a model states, s."""
    laws = [law["terms"] for law in tree["hypotheses"].values() if isinstance(law, Mapping)]
    terms = [term for terms in laws for term in terms if isinstance(term, Mapping)]
    return [float(term["period_s"]) for term in terms if term["kind"] == "oscillation"]


def _stated(finding: Finding, model: Model) -> bool:
    """Whether a law has an oscillation of this period."""
    period = finding.look.estimate["period_s"]
    terms = [term for law in model.laws.values() for term in law.terms if term.kind == "oscillation"]
    return any(period["q05"] <= 2.0 * math.pi / term.bandwidth <= period["q95"] for term in terms)


CAUSE = Cause(
    "oscillation",
    "The bias oscillates: a damped swing of one period that noise drives.",
    "Look for a control loop or a table of this period. Record 20 periods.",
    source="sensor",
    looks=looks,
    slow=True,
    of_means=True,
    pictures=shown("allan", "spectrum"),
    grouping=Grouping(alike=_alike, most=1),
    written=Written(extend=_extend, stated=_stated),
    simulated=Simulated(
        keys={
            "period_s": positive(lambda s: s.duration_s / 20.0),
            "damping": Key(
                lambda s: 0.1,
                fits=lambda value: DAMPING_LIMITS[0] <= value <= DAMPING_LIMITS[1],
                limits=f"{DAMPING_LIMITS[0]:g} to {DAMPING_LIMITS[1]:g}",
            ),
            "sd": positive(lambda s: 0.5 * s.n),
        },
        add=_add,
    ),
)
