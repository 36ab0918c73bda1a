"""Bank samples drawn of a law, and parameters drawn of its priors."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from selfcal.adequacy.allan import allan_terms
from selfcal.base.grid import Array
from selfcal.model.file import Group
from selfcal.model.laws import Law, named_law
from selfcal.model.tables import Tables


def draw_parameters(group: Group, law: str, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of a law and the bias, drawn from the group's priors."""
    truth = {name: group.priors[name].at(float(rng.random())) for name in group.laws[law].parameters}
    return {**truth, "bias": group.priors["bias"].sd * float(rng.standard_normal())}


def has_nodes(law: Law, truth: Mapping[str, float], tables: Tables) -> bool:
    """Whether the grid can have a node for the law. Averages of a faster drift have less white noise than none."""
    terms = allan_terms(law, truth, tables.dt_s, tables.block)
    return terms.lacking < terms.variance * (1.0 - 2.0 * abs(terms.lag1))


def simulate_bank_samples(
    law: str | Law, truth: Mapping[str, float], rate_hz: float, samples: int, seed: int, bank_block: int = 1
) -> tuple[Array, float]:
    """A simulated axis y [samples] at `rate_hz`, without lattice or range; and x0 + drift at the last sample.

    Of `bank_block` samples a bank interval coloured noise is a moving average.

    A law by its name takes a stated correlation time from the truth's `correlation_time_s`.
    """
    from selfcal import _reference

    scene = _reference.Scene()
    scene.seed, scene.rate_hz, scene.samples, scene.block, scene.filter_taps = seed, rate_hz, samples, 1, 1
    scene.bank_block = bank_block
    axis = _reference.Axis()
    of = named_law(law, truth.get("correlation_time_s", math.nan)) if isinstance(law, str) else law
    axis.law, axis.N, axis.bias = of.as_tuple, truth["N"], truth.get("bias", 0.0)
    axis.drift, axis.second = of.node(truth)
    values, _, _, _, bias_now = _reference.simulate(scene, [axis])
    return values[0], float(bias_now[0])
