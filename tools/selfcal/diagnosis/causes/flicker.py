"""Flicker (1/f) noise, with either drift or alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from selfcal.diagnosis.cause import Cause, Extension, Grouping, Key, Simulated, Written, shown
from selfcal.diagnosis.model_tree import add_law
from selfcal.diagnosis.record import Record
from selfcal.likelihood.fit import Fit, best
from selfcal.likelihood.state import Look, State, net, of_parameter

#: ln of the number of looks, by 1350 clean records at 1 and 10 Hz. The size of 1/f noise is at its limit of nothing in
#: most of them: 11 instead of 68 showed 3 nats at the price of a single look.
LN_LOOKS = -1.5


def looks(state: State, record: Record) -> list[Look]:
    """1/f noise with either drift, which may be nothing there."""
    if state.extras.flicker:
        return []
    gain, fits = state.with_terms({}, flicker=True)
    worth = net(gain, 1, LN_LOOKS)
    if worth < 1.0:
        return []
    changes = {"extras": replace(state.extras, flicker=True)}
    look = Look("flicker", gain, worth, _sizes(state, best(fits)), changes)
    return [replace(look, measure=lambda final: _sizes(final, final.best))]


def _sizes(state: State, chosen: Fit) -> dict[str, Any]:
    return {"B": of_parameter(chosen, "ln_flicker", chosen.sigma, state.unit)}


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
