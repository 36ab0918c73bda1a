"""Flicker (1/f) noise, beside either drift or alone."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from selfcal.diagnosis.cause import Cause, Extension, Grouping, Key, Simulated, Written, shown
from selfcal.diagnosis.model_tree import add_law
from selfcal.diagnosis.record import Record
from selfcal.likelihood.fit import Fit, best, fit, ln_likelihood, moved, run
from selfcal.likelihood.state import Look, State, net

#: ln of the number of looks, by 1350 clean records at 1 and 10 Hz. The size of 1/f noise is at its limit of nothing in
#: most of them: 11 instead of 68 showed 3 nats at the price of one look.
LN_LOOKS = -1.5


def looks(state: State, record: Record) -> list[Look]:
    """1/f noise: beside either drift, or alone."""
    if state.extras.flicker:
        return []
    extras = replace(state.extras, flicker=True)
    series = state.series
    fits = [fit(series, extras, moved(state.best, extras))]
    for drift in (replace(extras, walk=True), replace(extras, markov=True)):
        fits.append(fit(series, drift, moved(state.best, drift)))
    chosen = best(fits)
    gain = chosen.ln_likelihood - state.best.ln_likelihood
    worth = net(gain, 1, LN_LOOKS)
    if worth < 1.0:
        return []
    sizes = _sizes(state, chosen)
    return [Look("flicker", gain, worth, sizes, {"extras": extras}, measure=lambda final: _sizes(final, final.best))]


def _sizes(state: State, chosen: Fit) -> dict[str, Any]:
    B = chosen.sigma * math.exp(chosen.value("ln_flicker"))
    return {"B": _log_interval(B, _curvature(state, chosen, "ln_flicker"), state.unit)}


def _log_interval(value: float, sd_ln: float, unit: str) -> dict[str, object]:
    return {
        "mean": value * math.exp(0.5 * sd_ln**2),
        "median": value,
        "sd": value * sd_ln,
        "q05": value * math.exp(-1.6449 * sd_ln),
        "q95": value * math.exp(1.6449 * sd_ln),
        "unit": unit,
    }


def _curvature(state: State, chosen: Fit, name: str) -> float:
    """Standard deviation of one parameter by the second difference of ln likelihood, the others refitted by none."""
    k = chosen.terms.names.index(name)
    h = 0.1
    values = []
    for move in (-h, 0.0, h):
        theta = chosen.theta.copy()
        theta[k] += move
        values.append(ln_likelihood(run(state.series, chosen.terms, theta)[0][0]))
    bend = (2.0 * values[1] - values[0] - values[2]) / h**2
    return 1.0 / math.sqrt(bend) if bend > 1e-3 else 3.0


def _extend(at: Extension) -> None:
    add_law(at.tree, "flicker", "B", dict(at.group["priors"]["sigma_m"]))


CAUSE = Cause(
    "flicker",
    "The bias has flicker (1/f) noise, or drifts on two time scales at once.",
    "Use B, not K: --write-model states its law. A record three times as long makes sure.",
    source="sensor",
    of_means=True,
    looks=looks,
    slow=True,
    pictures=shown("allan"),
    grouping=Grouping(alike=lambda a, b: True),
    written=Written(
        extend=_extend, stated=lambda finding, model: any(law.drift_name == "B" for law in model.laws.values())
    ),
    simulated=Simulated(keys={"B": Key(lambda s: 0.5 * s.n, "flicker_B")}),
)
