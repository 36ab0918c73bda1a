"""The bias oscillates: a damped oscillator that white noise drives, as a term of the drift.

x'' + 2 damping w x' + w^2 x = white noise, w = 2 pi / period_s, of the stationary standard deviation `sd`. The drift
swallows the swings: at the drift fitted without them, the innovations hardly show one. Periods are ranked at drifts of
several sizes on means, then the drift is fitted with the best. A line of constant phase has a damping of 0: its column
needs no evidence for each turn, so `periodic` gains more there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from selfcal.diagnosis.cause import Cause, Channels, Extension, Grouping, Key, Simulated, Written, positive, shown
from selfcal.diagnosis.causes import periodic
from selfcal.diagnosis.finding import Finding
from selfcal.diagnosis.model_tree import add_law, digits
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.statistics import swinging
from selfcal.likelihood.fit import Fit, best, ln_likelihood, moved, run
from selfcal.likelihood.state import ALIKE, Look, State, net, of_parameter
from selfcal.likelihood.statemodel import DAMPING_LIMITS, PERIOD_LIMITS, SAMPLES_LEAST, Array
from selfcal.model.file import Model
from selfcal.model.laws import RATIO_LIMITS, swing

#: Periods in a record at least.
TURNS_LEAST = 3.0
#: Tried first: periods per octave at one damping, sizes over the white noise of a mean, drifts smaller by exp(-these).
PER_OCTAVE, DAMPING, SWINGS, SIZES = 3.0, 0.15, (0.12, 0.35, 1.0), (0.0, 1.5, 4.0)
#: ... then dampings, and factors of the period, about the best.
DAMPINGS, NEAR = (0.02, 0.05, 0.15, 0.4), tuple(float(2.0 ** (k / 12.0)) for k in range(-3, 4))
#: The prior of the size in the model file, over the size found.
RATIOS = (0.1, 10.0)
#: Price of the search over periods beside three degrees of freedom. At 1.8 more, 3 of 800 clean hours at 1 Hz showed
#: 3 nats, where 40 were due.
LN_LOOKS = 1.0


def looks(state: State, record: Record) -> list[Look]:
    """The oscillator that gains most, the drift fitted with it."""
    if state.extras.oscillation:
        return []
    found = _search(state)
    if found is None:
        return []
    fits = state.with_terms(found, found.pop("less"), oscillation=True)[1]
    chosen = best(fits)
    # A poor drift model makes some nats of any slow term.
    none = max(state.best.ln_likelihood, 0.0 if state.extras.flicker else state.rich.ln_likelihood)
    gain = chosen.ln_likelihood - none
    worth = net(gain, 3, LN_LOOKS)
    period = math.exp(chosen.value("ln_period"))
    if worth < 1.0 or period * TURNS_LEAST > state.y.size * state.dt:
        return []
    turns = state.y.size * state.dt / period
    coherent = 2.0 * math.pi * math.exp(chosen.value("ln_damping")) * turns < 1.0
    line = _line(state, record, period, gain) if coherent else []
    if line:
        return line
    changes, unit = {"extras": replace(state.extras, oscillation=True), "fits": fits}, state.unit
    sizes = _sizes(chosen, unit)
    return [Look("oscillation", gain, worth, sizes, changes, measure=lambda final: _sizes(final.best, unit))]


def _line(state: State, record: Record, period: float, gain: float) -> list[Look]:
    """The line of this period where it explains as much: swings that keep their phase over the whole record have no
    damping. Of the band in which oscillations are looked for."""
    width = 1.0 / (state.y.size * state.dt)
    tried = [1.0 / period + move * width for move in np.linspace(-1.0, 1.0, 17)]
    gains = state.scores([np.array([*periodic.pair(f, record).values()]) for f in tried])
    found = periodic.at(state, record, (tried[int(np.argmax(gains))],))
    if found.gain < gain - ALIKE:
        return []
    n = round(2.0 * state.y.size * state.dt / PERIOD_LIMITS[0])
    price = float(periodic.ln_lines(np.array(1.0 / (period * width)), n, np.array(found.gain)))
    return [replace(found, net=net(found.gain, 2, price), others=("oscillation",))]


def _sizes(chosen: Fit, unit: str) -> dict[str, Any]:
    return {
        "period_s": of_parameter(chosen, "ln_period", 1.0, "s"),
        "damping": of_parameter(chosen, "ln_damping", 1.0, "1"),
        "sd": of_parameter(chosen, "ln_swing", chosen.sigma, unit),
    }


def _search(state: State) -> dict[str, float] | None:
    """ln of period, damping, and size over the white noise of a sample; `less`: of the drift beside it."""
    series, block = state.means(PERIOD_LIMITS[0] / SAMPLES_LEAST)
    low = max(PERIOD_LIMITS[0], SAMPLES_LEAST * series.dt)
    high = min(PERIOD_LIMITS[1], series.duration_s / TURNS_LEAST)
    if high < low:
        return None
    terms = replace(state.best.terms, oscillation=True)

    def value(numbers: tuple[float, ...]) -> float:
        """ln likelihood of a period, a damping, a size over the white noise of a mean, and a drift smaller by exp."""
        period, damping, size = map(math.log, numbers[:3])
        drift = replace(state.best, theta=state.best.of_means(block, -numbers[3]))
        theta = moved(drift, terms, {"ln_swing": size, "ln_period": period, "ln_damping": damping})
        return ln_likelihood(run(series, terms, theta)[0][0])

    periods = np.geomspace(low, high, 1 + math.ceil(PER_OCTAVE * math.log2(high / low))).tolist()
    period, damping, size, less = max(product(periods, (DAMPING,), SWINGS, SIZES), key=value)
    near = [period * by for by in NEAR if low <= period * by <= high]
    period, damping, size, less = best_of = max(product(near, DAMPINGS, (size,), (less,)), key=value)
    none = ln_likelihood(run(series, state.best.terms, state.best.of_means(block, 0.0))[0][0])
    if value(best_of) - none < 1.0:  # not worth a fit
        return None
    return {
        "ln_period": math.log(period),
        "ln_damping": math.log(damping),
        "ln_swing": math.log(size) - 0.5 * math.log(block),
        "less": less,
    }


def _alike(a: Look, b: Look) -> bool:
    """Whether each period lies in the other's interval."""
    one, two = a.estimate["period_s"], b.estimate["period_s"]
    return bool(one["q05"] <= two["median"] <= one["q95"] and two["q05"] <= one["median"] <= two["q95"])


def _add(keys: Mapping[str, Any], channels: Channels) -> Array:
    """From sample to sample by the exact transition."""
    t = channels.time_s
    F = swing(keys["period_s"], keys["damping"], float(t[1] - t[0]))
    return float(keys["sd"]) * swinging(F, np.eye(2) - F @ F.T, np.eye(2), t.size, channels.random)


def _extend(at: Extension) -> None:
    """A law of a walk beside the oscillation, whose size is free. One that states the same period already serves."""
    estimate, final = at.finding.look.estimate, at.found[at.axis].state
    period = estimate["period_s"]
    if any(period["q05"] <= other <= period["q95"] for other in _periods(at.tree)):
        return
    w = 2.0 * math.pi / period["median"]
    walk = next(fit for fit in final.fits if fit.terms.walk)
    K = max(walk.K, 2.0 * float(at.group["priors"]["K"]["min"]))
    ratio = estimate["sd"]["median"] * math.sqrt(w) / K
    low, high = (min(max(by * ratio, RATIO_LIMITS[0]), RATIO_LIMITS[1]) for by in RATIOS)
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
    """Of the oscillations that a model states."""
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
