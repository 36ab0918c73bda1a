"""Priors of an axis whose recording lies outside the model's: limits that are laid about the recording itself.

A record within the limits keeps the model's priors. So does a record that moved: its readings show motion, not the
sensor. The limits depend on the recording and the model alone, so that every verb and every target has the same.

First N, the drift and the level are compared with the limits by Allan deviations. Then a bank shows on which ends the
posteriors of the laws lean (`leaning`): a walk below the least K has no other sign. Those limits move along.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from selfcal.bank.axis_result import LAW_LEAST, AxisResult
from selfcal.base.errors import UserError
from selfcal.base.grid import MEDIAN_SD, Array, Rows
from selfcal.logs.recording import Recording, as_float
from selfcal.model.file import LN_LIMIT, WIDEST_BIAS, Group, Model, Prior
from selfcal.model.laws import RATIOS
from selfcal.model.tables import bank_block, make_tables
from selfcal.readings.budget import CHECK_LIMIT, CLEARLY
from selfcal.readings.lattice import SAME_VALUE_SHARE
from selfcal.readings.rest import PIECES_LEAST, rest_of

#: Factor of the own prior of N to each side of the record's N.
DECADES = 100.0
#: Narrowest range of N, a factor, that is replaced: a narrower range is knowledge of the part (warm start, own model).
#: An axis with this many times the N of its group has priors of its own.
NARROW = math.sqrt(DECADES)
#: Level over the sd of the own bias prior.
LEVEL_SD = 2.0
#: Most bank intervals of a search beyond the bank's own: a longer record is averaged further.
MOST_INTERVALS = 20_000
#: Smallest visible drift over a record of T: K in N / T, sigma_m in N / sqrt(T); of alpha 1 / T.
UNSEEN = 0.5
#: Noise of the gate over the record's noise: default.yaml has two to six.
GATE_NOISE = 3.0
#: Words of the JSON for an axis's priors.
OF_MODEL, OF_RECORD = "model", "from this record"


@dataclass(frozen=True)
class Seen:
    """An axis at rest, in its group's unit: its `level`, its Allan deviations at `tau_s` [k], the shortest the bank's
    interval, each from the median of `differences` [k] (all of them, where the median is of no noise)."""

    level: float
    tau_s: Array
    deviation: Array
    differences: Rows

    @property
    def N(self) -> float:
        """White noise density of the shortest interval."""
        return float(self.deviation[0] * math.sqrt(self.tau_s[0]))


def for_record(model: Model, recording: Recording, axes: Sequence[str]) -> Model:
    """The model with own priors for those of `axes` that rested outside its own; else unchanged."""
    own: dict[str, dict[str, Prior]] = {}
    noise: dict[str, float] = {}
    for name in axes:
        with suppress(UserError):  # of another kind, or without a sample: said where the axis is read
            group, seen = model.group_of(name), at_rest(recording, name, model)
            if seen is None or noise_is_known(group):
                continue
            laid_out = about(group, seen) if outside(group, seen) else dict(group.priors)
            moved = moved_along(model, recording, name, laid_out, seen)
            if moved != group.priors:
                own[name] = moved
                noise[group.name] = max(noise.get(group.name, 0.0), GATE_NOISE * seen.N)
    if not own:
        return model
    gate = model.gate
    if gate is not None:  # its noise is a bound: a noisier axis raises it
        gate = replace(gate, N={name: max(N, rounded(noise.get(name, 0.0))) for name, N in gate.N.items()})
    return replace(_with_own(model, own), gate=gate)


def _with_own(model: Model, own: Mapping[str, Mapping[str, Prior]]) -> Model:
    """The model with own priors of axes, by name."""
    groups = tuple(
        replace(group, own_priors={**group.own_priors, **{name: own[name] for name in group.axes if name in own}})
        for group in model.groups
    )
    return replace(model, groups=groups)


def add_sources(document: Mapping[str, Any], model: Model, changed: Model) -> None:
    """State in each axis of a document where its priors are from, and its own; `changed`: the model by `for_record`."""
    for name, axis in document["axes"].items():
        if "error" not in axis:
            before, after = (of.group_of(name).priors for of in (model, changed))
            own = {key: prior_tree(prior) for key, prior in after.items() if prior != before.get(key)}
            axis.update({"priors": OF_RECORD, "own_priors": own} if own else {"priors": OF_MODEL})


def state_own(tree: dict[str, Any], model: Model) -> None:
    """Put the own priors of the model's axes into its file's `tree`; those that are the group's are left out."""
    for group in model.groups:
        if group.own_priors:
            tree["groups"][group.name]["own_priors"] = {
                axis: {key: prior_tree(prior) for key, prior in own.items() if prior != group.priors.get(key)}
                for axis, own in group.own_priors.items()
            }


def prior_tree(prior: Prior) -> dict[str, Any]:
    """A prior as a model file has it."""
    if prior.law == "normal":
        return {"law": prior.law, "sd": prior.sd}
    if prior.law == "log_normal":
        return {"law": prior.law, "median": prior.median, "sd": prior.sd}
    return {"law": prior.law, "min": prior.min, "max": prior.max}


def at_rest(recording: Recording, name: str, model: Model) -> Seen | None:
    """An axis as it rested: motion counts where it takes the axis out of the priors. None if that leaves too little, or
    nothing outside them."""
    group, own = model.group_of(name), recording.along(name)
    seen = seen_of(own, name, model)
    if seen is None or not outside(group, seen):
        return seen
    rest = rest_of(own, [axis for axis in model.axes if axis in own.columns])
    if not rest.moved:
        return seen
    if rest.longest is None:
        return None
    seen = seen_of(own.without(rest.moved), name, model)
    return seen if seen is not None and outside(group, seen) else None


def seen_of(recording: Recording, name: str, model: Model) -> Seen | None:
    """The level and the Allan deviations of an axis by its own clock; None where too little of it is there.

    Outliers, steps and short motion leave a median alone."""
    group = model.group_of(name)
    values = recording.in_unit(name, group.unit)
    sound = np.isfinite(values) & (np.abs(values) < (group.range if group.range > 0.0 else math.inf))
    if not sound.any():
        return None
    block = bank_block(recording.rate_hz, model.bank_rate_hz)
    tau_s = block / recording.rate_hz
    interval = (recording.clock.place // block)[sound]
    size = np.ones(interval.size)
    rows: list[tuple[float, float, int]] = []
    level = math.nan
    with np.errstate(over="ignore", invalid="ignore"):
        total = values[sound]
        while True:
            first = np.flatnonzero(np.diff(interval, prepend=interval[0] - 1))
            interval, total, size = interval[first], np.add.reduceat(total, first), np.add.reduceat(size, first)
            whole = size > 0.5 * size.max()
            mean = total[whole] / size[whole]
            level = level if rows else float(np.median(mean))
            step = np.diff(mean)[np.diff(interval[whole]) == 1]
            step[np.abs(step) < SAME_VALUE_SHARE * np.abs(mean).max()] = 0.0
            if step.size < (24 if rows else PIECES_LEAST):  # of a drift, more
                break
            square = step * step
            typical, all_of_them = float(np.median(square)) / MEDIAN_SD**2, float(square.mean())
            # On a coarse lattice the median is of its steps: never more than the mean square.
            rows.append((tau_s, math.sqrt(0.5 * (min(typical, all_of_them) or all_of_them)), step.size))
            tau_s *= 2.0
            interval = interval // 2
    if not rows or not 0.0 < rows[0][1] < math.inf:
        return None
    return Seen(level, *(np.array(column) for column in zip(*rows, strict=True)))


def noise_is_known(group: Group) -> bool:
    """Whether the limits of N are knowledge of the part."""
    return group.priors["N"].max < NARROW * group.priors["N"].min


def outside(group: Group, seen: Seen) -> bool:
    """Whether a resting axis lies outside the priors of its group: its noise, its drift or its level. Never of a group
    whose N is known."""
    N = group.priors["N"]
    if noise_is_known(group):
        return False
    # Two sd of ln N beyond a limit: 1.2 over sqrt(n) each.
    margin = math.exp(2.0 * 1.2 / math.sqrt(float(seen.differences[0])))
    beyond = not N.min / margin <= seen.N <= N.max * margin
    # The greatest Allan deviation of a Gauss-Markov drift is 0.62 of its sigma_m.
    K, sigma_m = group.priors["K"].max, group.priors["sigma_m"].max
    most = np.sqrt(N.max**2 / seen.tau_s + K**2 * seen.tau_s / 3.0 + (0.62 * sigma_m) ** 2)
    drifts = bool((seen.deviation > 1.5 * most).any())
    return beyond or drifts or abs(seen.level) > CHECK_LIMIT * group.priors["bias"].sd


def about(group: Group, seen: Seen) -> dict[str, Prior]:
    """Priors about a resting axis: N two decades either way, the drift's in the group's ratio to the middle of N. Where
    the axis drifts faster, these reach as far as it does. The bias' is as wide as its level needs."""
    peak = float(seen.deviation.max())
    reach = {"K": float(seen.deviation[-1] * math.sqrt(3.0 / seen.tau_s[-1])), "sigma_m": peak, "B": peak}
    return laid(group.priors, seen.N, seen.level, reach)


def laid(
    priors: Mapping[str, Prior], N: float, level: float = 0.0, reach: Mapping[str, float] | None = None
) -> dict[str, Prior]:
    """Priors about a white noise `N`, as `about` has them. `level` and `reach`, the sizes of the drift by parameter, in
    the unit of the priors."""
    N = rounded(N)
    scale = N / math.sqrt(priors["N"].min * priors["N"].max)
    sd = priors["bias"].sd
    if abs(level) > CHECK_LIMIT * sd:
        sd = rounded(LEVEL_SD * abs(level))
    # A bias prior may be WIDEST_BIAS times the least N: first it gives way, then N.
    sd = max(min(sd, WIDEST_BIAS * N / DECADES), rounded(abs(level) / LEVEL_SD))
    least = max(N / DECADES, rounded(1.01 * sd / WIDEST_BIAS))
    own = {"bias": Prior("normal", sd=sd), "N": _limits(priors["N"].law, least, DECADES * N)}
    for key, prior in priors.items():
        if key not in ("bias", "N", "alpha", *RATIOS):
            most = max(scale * prior.max, NARROW * (reach or {}).get(key, 0.0))
            own[key] = _limits(prior.law, scale * prior.min, most)
    return {**priors, **own}


def moved_along(
    model: Model, recording: Recording, name: str, priors: dict[str, Prior], seen: Seen
) -> dict[str, Prior]:
    """The `priors` of an axis with the limits moved that a posterior leans on. As they are where none does, or where no
    law gains by it.

    The laws are those of a single drift term, without regressors, on the means of MOST_INTERVALS intervals at most."""
    recording = recording.along(name)
    length_s = recording.duration_s
    size = UNSEEN * seen.N / math.sqrt(length_s)
    least = {"K": UNSEEN * seen.N / length_s, "sigma_m": size, "B": size, "alpha": 1.0 / length_s}
    # It may show no more than the priors hold: what it cannot show lies well below no least, nor the drift near a most.
    below = any(math.e * least[key] < prior.min for key, prior in priors.items() if key in least)
    if not below and float(seen.deviation[-1]) * math.sqrt(3.0 / float(seen.tau_s[-1])) <= 0.5 * priors["K"].max:
        return priors
    from selfcal.bank.library import Bank
    from selfcal.readings.readings import look

    plain = {law: weight for law, weight in model.hypotheses.items() if not model.laws[law].is_sum}
    readings = look(recording, name, replace(model.group_of(name), priors=priors))
    own, rate_hz = readings.recording, min(model.bank_rate_hz, MOST_INTERVALS / length_s)
    offset = float(np.nanmedian(readings.working))
    samples = as_float(readings.working - offset)[:, None]

    def report(chosen: Mapping[str, Prior]) -> AxisResult:
        changed = replace(_with_own(model, {name: chosen}), hypotheses=plain, regressors=())
        bank = Bank(make_tables(changed, own.rate_hz, (name,), bank_rate_hz=rate_hz), offset=offset)
        bank.push(samples, own.missing_before)
        return bank.report(0)

    first = result = report(priors)
    moved, gaining = priors, priors != model.group_of(name).priors  # only the model's own have to be outdone
    for _ in range(4):
        further = {key: _moved(key, moved[key], end, least) for key, end in leaning(result, moved).items()}
        further = {key: prior for key, prior in further.items() if prior != moved[key]}
        if not further:
            break
        moved = {**moved, **further}
        result = report(moved)
        gaining = gaining or _gains(first, result, [key for key, prior in moved.items() if prior != priors[key]])
    return moved if gaining else priors


def leaning(result: AxisResult, priors: Mapping[str, Prior]) -> dict[str, int]:
    """The parameters whose posterior under a law leans on an end of its prior: -1 the lower, 1 the upper."""
    ends: dict[str, int] = {}
    for estimates in result.parameters.values():
        for key, estimate in estimates.items():
            prior = priors[key]
            if key in RATIOS or not prior.law.endswith("uniform") or not estimate.q05 > 0.0:
                continue
            for end, near, far in (
                (-1, estimate.q05 / prior.min, estimate.q95 / prior.min),
                (1, prior.max / estimate.q95, prior.max / estimate.q05),
            ):
                middle = estimate.median / prior.min if end < 0 else prior.max / estimate.median
                left = math.log(max(near, 1.0))
                # A fifth of the way to the nearer quantile is left to the end. Beyond a factor of e the record leaves
                # the parameter open.
                if left < 0.2 * (math.log(middle) - left) and math.log(far) < 1.0:
                    ends[key] = end
    return ends


def _gains(first: AxisResult, second: AxisResult, moved: Collection[str]) -> bool:
    """Whether limits `moved` are the record's own: a law that counts gains by them. Of a law whose alpha moved the sum
    of all laws must gain: as alpha falls it becomes a walk, which may be among them."""
    gain = {law: second.log_evidence[law] - before for law, before in first.log_evidence.items()}
    whole = [float(np.logaddexp.reduce(list(result.log_evidence.values()))) for result in (first, second)]
    return whole[1] > whole[0] + CLEARLY or any(
        gain[law] > CLEARLY and second.probability[law] > LAW_LEAST
        for law, estimates in second.parameters.items()
        if not estimates.keys().isdisjoint(moved) and not {"alpha"} & estimates.keys() & set(moved)
    )


def _moved(key: str, prior: Prior, end: int, least: Mapping[str, float]) -> Prior:
    """A prior of the same width, moved towards an end, but to no invisible size, and to no drift the bank takes for
    white noise."""
    if key == "alpha" and end > 0:
        return prior
    width = prior.max / prior.min
    low = prior.min * width ** (end * (2.0 / 3.0))
    if end < 0:
        low = min(prior.min, max(low, least.get(key, 0.0)))
    return _limits(prior.law, low, low * width) if low != prior.min else prior


def _limits(law: str, low: float, high: float) -> Prior:
    """Rounded limits, within those of any prior."""
    law = "uniform" if law == "uniform" else "log_uniform"
    least, most = math.exp(0.99 * -LN_LIMIT), math.exp(0.99 * LN_LIMIT)
    return Prior(law, min=min(max(rounded(low), least), most / 2.0), max=max(min(rounded(high), most), least * 2.0))


def rounded(value: float) -> float:
    """Two digits: all that is meant."""
    return float(f"{value:.2g}")
