"""The numbers of a data sheet, of the posterior of all laws: white noise, random walk, bias instability, quantization.

The white noise (angle random walk, of an accelerometer velocity random walk) is N. The rate random walk is K; a
Gauss-Markov drift counts as the walk that it is over times short against 1 / alpha, K = sigma_m sqrt(2 alpha); no drift
has K = 0. The bias instability is the first minimum of the law's Allan deviation over 0.664 (IEEE Std 952, annex C).
Of 1/f noise it is B, and the white noise is the rest (one_over_f.py). Its law is weighed with the model's own; the
walk is theirs alone.
Coloured noise of a spectral ratio below 1 is white noise with quantization noise; at the bank's interval dt
Q = N sqrt(dt) sqrt(1 / ratio^2 - 1) / 2. The number is there where such noise is sure. Each law counts by its
probability.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from selfcal.adequacy.allan import AVERAGES_LEAST, CURVE_DRAWS, PER_OCTAVE, AllanTerms, fit_of, posterior_draws
from selfcal.adequacy.one_over_f import FLICKER, SURE_PROBABILITY, AddedLaw, white_beside
from selfcal.bank.axis_result import HALF_90, AxisResult, Estimate
from selfcal.bank.subsets import LIKELY
from selfcal.base import units
from selfcal.base.grid import Array, bisected, weighted_quantiles
from selfcal.model.file import Group

#: The parameter of coloured noise.
COLOURED = "spectral_ratio"
#: Largest factor that is stated: of a rest to the record, of a unit's quantity to the batch's median.
MOST_TIMES = 1000.0
#: Least probability of a law that counts.
_LAW_LEAST = 1e-3
#: Least ratio of an axis' N to its siblings' or its data sheet's that a line names.
NOISIER = 2.0
#: Least share of the posterior with a walk, or a minimum, that identifies the number.
_SURE = 1.0 - LIKELY
#: Why a number is not identified: words of the table and the JSON.
NO_WALK = "no walk is sure"
NOT_DECIDED = "the law is not decided"
WIDE = "the record leaves it open"
NO_MINIMUM = "the Allan deviation has no minimum up to half the record"
BELOW = "the Allan deviation rises from the shortest averaging time on"
ONE_OVER_F = "the drift is 1/f noise"


@dataclass(frozen=True)
class SheetNumber:
    """A number. `reason`: why it is not identified, else ""; its 95 % quantile is then an upper limit."""

    estimate: Estimate
    reason: str = ""


def summarize(
    result: AxisResult,
    group: Group,
    dt_s: float,
    n: int,
    block: int,
    beside: AddedLaw | None = None,
    counted: AddedLaw | None = None,
) -> dict[str, SheetNumber]:
    """The numbers of an axis by their keys (arw, rrw, bias_instability, and quantization_noise where there is any), in
    the group's unit: of `n` readings every `dt_s`, gaps among them, each the mean of `block` samples. Empty where the
    record is too short for an Allan deviation. `beside`: 1/f noise, added to the laws of the result. `counted`:
    likewise white noise with quantization noise (counted.py)."""
    if n < 2 * AVERAGES_LEAST:
        return {}
    more = 0.0 if beside is None else beside.probability
    left = 1.0 if counted is None else 1.0 - counted.probability
    laws = [
        AddedLaw(probability * (1.0 - more) * left, result.parameters[law], group, dt_s, n, block, law)
        for law, probability in result.probability.items()
        if probability >= _LAW_LEAST  # of the model's, whatever is added to them
    ]
    of_model = len(laws)
    others = ((beside, more * left), (counted, 1.0 - left))
    laws += [replace(law, probability=share) for law, share in others if law is not None and share >= _LAW_LEAST]
    sound = [
        (law, k < of_model)
        for k, law in enumerate(laws)
        if all(math.isfinite(e.median) for e in law.estimates.values())
    ]
    if not sound:
        return {}
    white, walk, q, floor, side = (
        np.concatenate(rows) for rows in zip(*(_draws(law) for law, _ in sound), strict=True)
    )
    w, own = np.repeat([[law.probability, float(mine)] for law, mine in sound], CURVE_DRAWS, axis=0).T
    w = w / w.sum()
    w_walk = w * own / max(float(w @ own), 1e-300) if (w * own).any() else w
    numbers = {
        "arw": _number(white, w),
        "rrw": _number(walk, w_walk),
        "bias_instability": _number(floor / units.FLICKER_FLOOR, w),
    }
    if float(w[q > 0.0].sum()) >= _SURE:
        of_Q = sum(law.probability for law in laws if COLOURED in _identified(law))
        Q = _number(q, w)
        numbers["quantization_noise"] = Q if of_Q > 0.5 * sum(law.probability for law in laws) else _without(Q, WIDE)
    known = [(law.probability, law.estimates.keys(), {*_identified(law)}) for law, _ in sound]

    def left_open(*sizes: set[str]) -> bool:
        """Whether most laws with a drift leave it open: no set of these is identified whole."""
        own = [
            (share, any(each <= sure for each in sizes)) for share, keys, sure in known if keys & set().union(*sizes)
        ]
        return sum(share for share, sure in own if not sure) > 0.5 * sum(share for share, _ in own)

    rrw, why = numbers["rrw"].estimate, ""
    if more >= SURE_PROBABILITY:
        why = ONE_OVER_F
    elif float(w_walk[walk > 0.0].sum()) < _SURE:
        why = NO_WALK if max(result.probability.values()) >= _SURE else NOT_DECIDED
    elif (
        left_open({"K"}, {"sigma_m", "alpha"})
        or math.log(rrw.q95 / rrw.q05) > HALF_90 * group.priors["K"].ln_sd  # half the prior's sd
        or rrw.q95 - rrw.q05 > 2.0 * rrw.median  # it reaches as far as to nothing
    ):
        why = WIDE
    if why:
        # Its limit holds if there is a walk, however little a law with a walk counts.
        ends = [estimates["K"].q95 for estimates in result.parameters.values() if "K" in estimates]
        most = [end for end in ends if math.isfinite(end)]
        if (w_walk * walk > 0.0).any():
            most.append(_number(walk, np.where(walk > 0.0, w_walk, 0.0) / w_walk[walk > 0.0].sum()).estimate.q95)
        numbers["rrw"] = _without(SheetNumber(replace(rrw, q95=max(most, default=group.priors["K"].min))), why)
    if float(w[side == 0].sum()) < _SURE:
        reason = BELOW if float(w[side < 0].sum()) > float(w[side > 0].sum()) else NO_MINIMUM
        numbers["bias_instability"] = _without(numbers["bias_instability"], reason)
    elif left_open({"K"}, {"sigma_m"}, {"B"}):  # then the prior of the drift makes the minimum
        numbers["bias_instability"] = _without(numbers["bias_instability"], WIDE)
    return numbers


def _identified(law: AddedLaw) -> list[str]:
    return [name for name, estimate in law.estimates.items() if estimate.identified]


def _draws(beside: AddedLaw) -> tuple[Array, Array, Array, Array, Array]:
    """Draws of a law's posterior [k] each: white noise, walk (0: none), Q, the first minimum of the Allan deviation,
    and where it is."""
    law, group, dt_s, n, block = beside.law, beside.group, beside.dt_s, beside.n, beside.block
    medians = {name: estimate.median for name, estimate in beside.estimates.items()}
    m = np.geomspace(1.0, n / 2.0, 1 + math.ceil(PER_OCTAVE * math.log2(n / 2.0)))
    fit = fit_of(law, medians, group, dt_s, n, m, block=block)
    draws = posterior_draws(beside.estimates, fit.covariance)
    if law == FLICKER:
        white, floor = white_beside(draws, dt_s, block), draws["B"] * units.FLICKER_FLOOR
        side = (white**2 / (0.5 * n * dt_s) > floor**2).astype(float)  # below the white noise everywhere
    else:
        lowest = [_minimum(terms, m) for terms in fit.drawn(draws)]
        white, (floor, side) = draws["N"], np.array(lowest, dtype=float).T
    # A Gauss-Markov drift is like a walk. Noise without a memory, or with a memory of the other sign, has no Q.
    none = np.zeros(white.size)
    walk = draws.get("K", draws.get("sigma_m", none) * np.sqrt(2.0 * draws.get("alpha", none)))
    over = np.maximum(draws.get(COLOURED, none + 1.0) ** -2.0 - 1.0, 0.0)
    return white, np.nan_to_num(walk), 0.5 * draws["N"] * np.sqrt(dt_s * over), floor, side


def noisier(white: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A line an axis whose white noise is another than that of its siblings, by names that differ in the last letter:
    NOISIER times their median or more, the 90 % intervals apart. Siblings that differ as much themselves are no batch.
    `white`: median, q05, q95 and unit."""
    lines = []
    for name, own in white.items():
        alike = [axis for axis in white if axis[:-1] == name[:-1] and white[axis]["unit"] == own["unit"]]
        others = [axis for axis in alike if axis != name]
        if len(others) < 2:
            continue
        known = [white[other]["median"] for other in others]
        times = own["median"] / float(np.median(known))
        batch = max(known) < NOISIER * min(known)
        if batch and times >= NOISIER and own["q05"] > max(white[other]["q95"] for other in others):
            lines.append(f"{name} is {times:.2g} times as noisy as {' and '.join(others)}")
    return lines


def halved_after(result: AxisResult, group: Group, dt_s: float, n: int, block: int) -> dict[str, float | None]:
    """Further rest that halves the interval of each parameter that the record leaves open under the likeliest law, s.

    By the Fisher information at the medians, with the priors. An open interval is wider than this information says,
    and falls faster with the rest: the geometric mean of both variances is taken for that of now. The median over
    records of a kind is then 0.2 to 0.76 times as wide (tests/tools/test_summary.py). None: not even MOST_TIMES
    times the record does.
    """
    law = result.best
    estimates = result.parameters[law]
    open_ = [name for name, estimate in estimates.items() if not estimate.identified]
    medians = {name: estimate.median for name, estimate in estimates.items()}
    if not open_ or n < 2 * AVERAGES_LEAST or not all(math.isfinite(value) for value in medians.values()):
        return {}

    def variance(times: float) -> dict[str, float]:
        fit = fit_of(law, medians, group, dt_s, times * n, np.ones(1), block=block)
        return dict(zip(estimates, np.diag(fit.covariance).tolist(), strict=True))

    def rest_s(name: str) -> float | None:
        wanted = 0.25 * math.sqrt(now[name]) * estimates[name].ln_sd
        if not variance(MOST_TIMES)[name] <= wanted:
            return None
        return n * dt_s * (bisected(lambda times: variance(times)[name] <= wanted, 1.0, MOST_TIMES)[1] - 1.0)

    now = variance(1.0)
    return {name: rest_s(name) for name in open_}


def _minimum(terms: AllanTerms, m: Array) -> tuple[float, int]:
    """The first minimum of the Allan deviation at `m` readings, and 0; where none lies inside, the lowest value
    with -1 (it rises from the first on) or 1 (it falls to the last)."""
    variance = terms.allan_variance(m)
    inside = np.flatnonzero((variance[1:-1] < variance[:-2]) & (variance[1:-1] <= variance[2:]))
    lowest = int(inside[0]) + 1 if inside.size else int(np.argmin(variance))
    return math.sqrt(max(0.0, float(variance[lowest]))), 0 if inside.size else (-1 if lowest == 0 else 1)


def _number(values: Array, weight: Array) -> SheetNumber:
    """Mean, sd and quantiles of weighted draws."""
    order = np.argsort(values, kind="stable")
    values, weight = values[order], weight[order]
    mean = float(weight @ values)
    sd = math.sqrt(max(0.0, float(weight @ (values - mean) ** 2)))
    low, middle, high = weighted_quantiles(values, weight, (0.05, 0.5, 0.95)).tolist()
    return SheetNumber(Estimate(mean, middle, sd, low, high, identified=True))


def _without(number: SheetNumber, reason: str) -> SheetNumber:
    return SheetNumber(replace(number.estimate, identified=False), reason)
