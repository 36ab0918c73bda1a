"""1/f noise as a law next to the laws of a model: how likely it is, its B, and the white noise next to it.

The law `flicker` has three terms, so 1/f noise above the fastest term looks white to it: its N is too large. White
noise next to 1/f noise is what the law's spectrum has more than B^2 / (2 pi f) at a third of the bank's rate. There the
two agree best on records of 10 minutes to 4 hours (tests/noise_coverage.py).

The paper's laws put the Allan deviation's minimum of true 1/f noise 10 to 40 % too high. So the data sheet's numbers
weigh the law `flicker` with the model's laws.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.adequacy.allan import AVERAGES_LEAST, allan_terms, fit_of, posterior_draws
from selfcal.bank.axis_result import AxisResult, Estimate
from selfcal.bank.priors import MOST_INTERVALS, NARROW
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.model.file import ABOUT_N, MOST_HYPOTHESES, Group, Prior
from selfcal.model.laws import NAMED
from selfcal.model.tables import HypothesisTable, Tables, make_grid, priors_of

FLICKER = "flicker"
#: Least probability of 1/f noise that is called sure. Of 40 records of an hour of a Gauss-Markov drift of 60 s, 0.3 N a
#: root of a second, 5 reach 0.9 and none 0.97.
SURE_PROBABILITY = 0.98
#: Frequency at which the white noise is the rest of the spectrum, radians a bank interval.
_OMEGA = 2.0 * math.pi / 3.0
#: Least share of the law's own white noise that is left.
_WHITE_LEAST = 1e-3
#: Nodes of rho and of alpha.
_NODES = (24, 20)


def density_above(alpha: Array, dt_s: float, block: int) -> Array:
    """[k], s: what 1/f noise of B = 1 has more than the law `flicker` of B = 1 and `alpha` [k] at a third of the bank's
    rate, in means of `block` readings every `dt_s`. The readings have nothing above half their own rate."""
    image = np.abs(_OMEGA + 2.0 * math.pi * np.arange(-block, block + 1))
    image = image[image < math.pi * block]
    passed = (np.sin(0.5 * image) / (block * np.sin(0.5 * image / block))) ** 2
    whole = float((passed / image).sum())  # 1 / (2 pi f), f per interval
    law = NAMED[FLICKER]
    own = [
        float(allan_terms(law, {"N": 0.0, "B": 1.0, "alpha": bandwidth}, dt_s, block).spectrum(np.array(_OMEGA)))
        for bandwidth in alpha.tolist()
    ]
    return np.asarray(dt_s * (whole - np.array(own)))


def white_beside(draws: Mapping[str, Array], dt_s: float, block: int) -> Array:
    """N [k] next to 1/f noise, of draws [k] of the parameters of the law `flicker`."""
    square = draws["N"] ** 2
    left = square - density_above(draws["alpha"], dt_s, block) * draws["B"] ** 2
    return np.asarray(np.sqrt(np.maximum(left, _WHITE_LEAST**2 * square)))


def beside_its_law(parameters: Mapping[str, float], dt_s: float, block: int) -> float:
    """The law's N whose white noise is `parameters["N"]` next to 1/f noise: the inverse of white_of()."""
    above = float(density_above(np.array([parameters["alpha"]]), dt_s, block)[0])
    return math.sqrt(max(parameters["N"] ** 2 + above * parameters["B"] ** 2, 0.0))


def with_white(result: AxisResult, group: Group, dt_s: float, n: int, block: int) -> AxisResult:
    """The `result` with N of the law `flicker` next to 1/f noise. The result is unchanged without that law, or where
    the record is too short for it."""
    estimates = result.parameters.get(FLICKER, {})
    medians = {name: estimate.median for name, estimate in estimates.items()}
    if not estimates or n < 2 * AVERAGES_LEAST or not all(math.isfinite(value) for value in medians.values()):
        return result
    fit = fit_of(FLICKER, medians, group, dt_s, n, np.ones(1), block=block)
    draws = posterior_draws(estimates, fit.covariance)
    white = white_beside(draws, dt_s, block)
    low, middle, high = np.quantile(white, (0.05, 0.5, 0.95)).tolist()
    identified = estimates["N"].identified and low > 2.0 * _WHITE_LEAST * medians["N"]
    own = Estimate(float(white.mean()), middle, float(white.std()), low, high, identified, estimates["N"].off_grid)
    return replace(result, parameters={**result.parameters, FLICKER: {**estimates, "N": own}})


@dataclass(frozen=True)
class AddedLaw:
    """A `law` added to a model's laws: its probability among them, and its posterior of `n` means over `block` samples,
    every `dt_s`, under the priors of `group`."""

    probability: float
    estimates: Mapping[str, Estimate]
    group: Group
    dt_s: float
    n: int
    block: int
    law: str = FLICKER

    def laws(self, probability: Mapping[str, float]) -> dict[str, float]:
        """The probabilities of all laws where this law is sure; else empty."""
        if self.probability < SURE_PROBABILITY:
            return {}
        return {**{law: (1.0 - self.probability) * p for law, p in probability.items()}, self.law: self.probability}


@dataclass(frozen=True)
class Rerun:
    """Input of an engine for the only axis of `tables`, for another law. `samples` [n] less `offset` (see Bank) after
    `missing_before` [n], and `columns` [n, p] of which those of `mask` are in use."""

    tables: Tables
    group: Group
    samples: NDArray[np.floating[Any]]
    missing_before: NDArray[np.integer[Any]]
    columns: NDArray[np.floating[Any]] | None = None
    mask: int = 0
    offset: float = 0.0


def weigh(rerun: Rerun) -> AddedLaw | None:
    """The law `flicker` with the prior odds of an average law of the tables. None where the tables have the law, no
    room for it, or no result."""
    tables, group, samples = rerun.tables, rerun.group, rerun.samples
    times = max(1, math.ceil((samples.size + int(rerun.missing_before.sum())) / (tables.block * MOST_INTERVALS)))
    tables = replace(tables, dt_s=times * tables.dt_s, block=times * tables.block)
    drift = group.priors["sigma_m"]
    wider = NARROW if drift.law == "log_normal" else 1.0  # those of a known batch are narrow
    own = {
        "B": Prior("log_uniform", drift.min / wider, drift.max * wider),
        "alpha": Prior("log_uniform", *(limit / tables.dt_s for limit in ABOUT_N["alpha"][:2])),
    }
    return weigh_law(FLICKER, own, 1.0, replace(rerun, tables=tables))


def weigh_law(name: str, priors: Mapping[str, Prior], odds: float, rerun: Rerun) -> AddedLaw | None:
    """A named law of two drift parameters as weigh() has it, with `priors` of its own. `odds`: over an average law."""
    from selfcal.bank.library import Bank

    tables, group = rerun.tables, rerun.group
    count = len(tables.hypotheses)
    if count >= MOST_HYPOTHESES or any(hypothesis.name == name for hypothesis in tables.hypotheses):
        return None
    law = NAMED[name]
    own = replace(group, priors={**group.priors, **priors}, laws={**group.laws, name: law})
    rho, alpha = map(make_grid, _NODES)
    one_more = HypothesisTable(name, law, math.log(odds / (count + odds)), rho, alpha, (priors_of(own, name),))
    share = math.log(count / (count + odds))
    others = (replace(hypothesis, ln_probability=hypothesis.ln_probability + share) for hypothesis in tables.hypotheses)
    bank = Bank(replace(tables, hypotheses=(*others, one_more)), offset=rerun.offset)
    bank.push(rerun.samples[:, None], rerun.missing_before, rerun.columns)
    try:
        result = bank.report(0, rerun.mask)
    except UserError:
        return None
    if not math.isfinite(result.probability[name]):
        return None
    return AddedLaw(result.probability[name], result.parameters[name], own, tables.dt_s, result.n, tables.block, name)
