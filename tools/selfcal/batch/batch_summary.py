"""A batch as a whole: its population, the units unlike it or drifting, and the causes of a station, a day or a lot."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from selfcal.adequacy.summary import MOST_TIMES
from selfcal.bank.axis_result import HALF_90, bias_of, likeliest, sd_of
from selfcal.base import units as unit_module
from selfcal.base.errors import MOST_NAMED, UserError, few
from selfcal.batch.drift import Drift, DriftSeries, drifts_of
from selfcal.batch.population import (
    GROUP_UNITS_LEAST,
    MOST_ODD,
    TWO_GROUPS,
    UNITS_LEAST,
    Apart,
    Grouping,
    Interval,
    Measured,
    Population,
    populations,
    sd_off,
)
from selfcal.batch.unit_table import BatchUnit
from selfcal.model.file import Group, Model, Prior, Regressor
from selfcal.model.laws import RATIOS
from selfcal.model.regressors import coefficient_unit, offered
from selfcal.readings.budget import FALSE_ALARM

#: Least evidence of an odd unit's law over the batch's law, nats: chance reaches it in FALSE_ALARM at most.
OTHER_LAW = -math.log(FALSE_ALARM)
#: Kinds of groups: attributes of a source.
KINDS = ("station", "day", "lot")


@dataclass(frozen=True)
class Shared:
    """A cause that a group's units have and others have not: devices with it inside and outside, of how many."""

    kind: str
    name: str
    cause: str
    inside: tuple[int, int]
    outside: tuple[int, int]
    log_p: float


@dataclass(frozen=True)
class Batch:
    """The devices, each with its recordings in the order of their dates, and what they come to.

    `unidentified`: quantities without a population, as too few units identify them: how many do, of how many."""

    devices: Mapping[str, Sequence[BatchUnit]]
    populations: Sequence[Population]
    unlike: Mapping[str, Sequence[str]]
    drifts: Sequence[Drift]
    shared: Sequence[Shared]
    left_out: Mapping[tuple[str, str], Sequence[str]]
    unidentified: Mapping[str, tuple[int, int]]


def summed_up(units: Sequence[BatchUnit], model: Model) -> Batch:
    """The batch of recordings `units`. Its axes are in the units of the model's groups.

    `left_out`: the devices whose axis reads in a unit of another kind, by axis and reason."""
    devices: dict[str, list[BatchUnit]] = {}
    left_out: dict[tuple[str, str], dict[str, None]] = {}
    for unit in units:
        if unit.error is None:
            axes = {
                name: _converted(axis, model.group_of(name).unit, offered(model, name))
                for name, axis in unit.axes.items()
            }
            own = BatchUnit(unit.source, {**unit.record, "axes": axes})
            devices.setdefault(unit.device, []).append(own)
            for axis, reason in own.errors.items():
                if axis not in unit.errors:
                    left_out.setdefault((axis, reason), {})[unit.device] = None
    names = list(devices)
    groupings = [(kind, [group_of(kind, devices[name][-1]) for name in names]) for kind in KINDS]
    laws = _laws(devices)
    known = _known(devices, laws, model)
    unidentified: dict[str, tuple[int, int]] = {}
    shared = _shared(devices, groupings)
    marked = list(_marked(devices, laws, shared))
    odd: dict[str, set[int]] = {}
    for axis, name, _ in marked:
        odd.setdefault(axis, set()).add(names.index(name))
    fitted = populations(list(_measured(known, names, laws, unidentified)), groupings, odd)
    unlike: dict[str, list[str]] = {}
    for population in fitted:
        for odd_unit in population.unlike:
            unlike.setdefault(names[odd_unit.at], []).append(_off(population, odd_unit.off, odd_unit.log_p))
    for _, name, words in marked:
        unlike.setdefault(name, []).append(words)
    others = {key: list(left) for key, left in left_out.items()}
    drifts = drifts_of(_series(known, names))
    return Batch(devices, fitted, dict(sorted(unlike.items())), drifts, shared, others, unidentified)


def _converted(axis: Mapping[str, Any], to: str, regressors: Sequence[Regressor]) -> Mapping[str, Any]:
    """A result in the unit `to`. An axis of another kind has an `error` instead."""
    if "error" in axis or axis["bias_now"]["unit"] == to:
        return axis
    bias = axis["bias_now"]
    try:
        factor = unit_module.factor(bias["unit"], to)
    except UserError:
        return {**axis, "error": f"reads in {bias['unit']}, the model in {to}"}
    mean = unit_module.converted(bias["mean"], bias["unit"], to)
    parameters = {
        law: {name: _estimate_in(estimate, name, to) for name, estimate in of.items()}
        for law, of in axis["parameters"].items()
    }
    converted = {**axis, "bias_now": {"mean": mean, "sd": bias["sd"] * factor, "unit": to}, "parameters": parameters}
    unit_of = {regressor.name: coefficient_unit(to, regressor.unit) for regressor in regressors}
    converted["regressors"] = {
        name: {"coefficients": {of: _scaled(e, factor, unit_of[name]) for of, e in entry["coefficients"].items()}}
        for name, entry in axis.get("regressors", {}).items()
    }
    return converted | ({"lattice": axis["lattice"] * factor} if "lattice" in axis else {})


def _estimate_in(estimate: Mapping[str, Any], name: str, to: str) -> Mapping[str, Any]:
    """An estimate of the parameter `name` of an axis that is to read in `to`."""
    if name in RATIOS:
        return estimate
    unit = unit_module.parameter_unit(name, to)
    return _scaled(estimate, unit_module.factor(estimate["unit"], unit), unit)


def _scaled(estimate: Mapping[str, Any], factor: float, unit: str) -> Mapping[str, Any]:
    numbers = {key: estimate[key] for key in ("mean", "median", "sd", "q05", "q95") if estimate.get(key) is not None}
    return {**estimate, **{key: factor * value for key, value in numbers.items()}, "unit": unit}


def group_of(kind: str, unit: BatchUnit) -> str:
    """The name of the unit's station, day or lot; "" for none."""
    return unit.recorded_at[:10] if kind == "day" else str(getattr(unit.source, kind))


def sound_of(devices: Mapping[str, Sequence[BatchUnit]], axis: str) -> dict[str, list[Mapping[str, Any]]]:
    """The results of an axis, by device."""
    results = {
        name: [unit.axes[axis] for unit in units if axis in unit.axes and "error" not in unit.axes[axis]]
        for name, units in devices.items()
    }
    return {name: axes for name, axes in results.items() if axes}


def axes_of(devices: Mapping[str, Sequence[BatchUnit]]) -> list[str]:
    """All axes of the devices."""
    return list(dict.fromkeys(axis for units in devices.values() for unit in units for axis in unit.axes))


def _behind(axis: Mapping[str, Any]) -> dict[str, float]:
    """Evidence of each law below the best law, nats."""
    evidence = {law: value for law, value in axis["log_evidence"].items() if value is not None}
    best = max(evidence.values())
    return {law: best - value if math.isfinite(value) else math.inf for law, value in evidence.items()}


def _laws(devices: Mapping[str, Sequence[BatchUnit]]) -> dict[str, str]:
    """The law that the batch has, by axis: the law of most units, by the greatest likelihood of their shares.

    An odd unit weighs no more than another, however many nats it has. Expectation and maximization find the shares."""
    laws_of: dict[str, str] = {}
    for axis in axes_of(devices):
        behind = [_behind(result) for axes in sound_of(devices, axis).values() for result in axes]
        laws = list(dict.fromkeys(law for nats in behind for law in nats))
        likelihood = np.exp([[-nats.get(law, math.inf) for law in laws] for nats in behind])
        share = np.ones(len(laws))
        for _ in range(100 if behind else 0):
            share = likelihood.T @ (1.0 / (likelihood @ share)) * share / len(behind)
        laws_of |= {axis: laws[int(np.argmax(share))]} if behind else {}
    return laws_of


@dataclass(frozen=True)
class KnownAlone:
    """A quantity, or its logarithm, by a single recording: `y` with the error `s`."""

    y: float
    s: float
    identified: bool
    unit: str
    logarithm: bool


#: The recordings of a batch: by axis, device and recording, with its date in days, what it says of each quantity.
OfAxis = dict[str, list[tuple[float | None, dict[str, KnownAlone]]]]


def _known(devices: Mapping[str, Sequence[BatchUnit]], laws: Mapping[str, str], model: Model) -> dict[str, OfAxis]:
    known_of: dict[str, OfAxis] = {}
    for axis, law in laws.items():
        group, regressors = model.group_of(axis), offered(model, axis)
        for device, units in devices.items():
            for unit in units:
                if "error" not in unit.axes.get(axis, {"error": ""}):
                    day = None if unit.moment is None else unit.moment.timestamp() * unit_module.factor("s", "day")
                    known = _of_recording(unit.axes[axis], law, group, regressors)
                    known_of.setdefault(axis, {}).setdefault(device, []).append((day, known))
    return known_of


def _of_recording(
    axis: Mapping[str, Any], law: str, group: Group, regressors: Sequence[Regressor]
) -> dict[str, KnownAlone]:
    """Parameters of a law, coefficients of regressors, and the bias, by a recording.

    A unit whose own law has N where the batch's has no number is compared by its own."""
    parameters: Mapping[str, Mapping[str, Any]] = axis["parameters"][law]
    quantities = {name: _parameter(estimate, group.priors.get(name)) for name, estimate in parameters.items()}
    if quantities.get("N") is None:
        quantities["N"] = _parameter(axis["parameters"][likeliest(axis["hypotheses"])]["N"], group.priors.get("N"))
    for regressor in regressors:
        for column, estimate in (
            axis.get("regressors", {}).get(regressor.name, {"coefficients": {}})["coefficients"].items()
        ):
            quantities[column] = _coefficient(estimate, regressor.sd[group.name])
    bias = bias_of(axis)
    quantities["bias"] = KnownAlone(bias["median"], sd_of(bias), identified=True, unit=group.unit, logarithm=False)
    return {name: known for name, known in quantities.items() if known is not None}


def _parameter(estimate: Mapping[str, Any], prior: Prior | None) -> KnownAlone | None:
    """ln of a parameter. A uniform `prior` leans upwards by s^2 in the logarithm. None: the recording says nothing.

    An estimate off the grid counts: it is rough, and far from the batch's if it is odd."""
    median, q05, q95 = (estimate[key] for key in ("median", "q05", "q95"))
    if None in (median, q05, q95) or not 0.0 < q05 < q95 < math.inf:
        return None
    s = math.log(q95 / q05) / (2.0 * HALF_90)
    y = math.log(median)
    if prior is not None and prior.law == "uniform":
        y -= s**2
    known = KnownAlone(y, s, estimate["identified"], estimate["unit"], logarithm=True)
    return (
        _without(known, math.log(prior.median), prior.sd) if prior is not None and prior.law == "log_normal" else known
    )


def _coefficient(estimate: Mapping[str, Any], sd: float) -> KnownAlone | None:
    """A coefficient, whose prior is about 0. It is identified where the recording halves that prior's sd."""
    mean, s = estimate["mean"], estimate["sd"]
    if mean is None or s is None or not 0.0 < s < math.inf:
        return None
    return _without(KnownAlone(mean, s, s <= 0.5 * sd, estimate["unit"], logarithm=False), 0.0, sd)


def _without(known: KnownAlone, mean: float, sd: float) -> KnownAlone | None:
    """A quantity without its normal prior. None: hardly anything is left."""
    own = known.s**-2 - sd**-2
    if own < 0.1 * sd**-2:
        return None
    return replace(known, y=(known.y * known.s**-2 - mean * sd**-2) / own, s=own**-0.5)


def _measured(
    known: Mapping[str, OfAxis], names: Sequence[str], laws: Mapping[str, str], unidentified: dict[str, tuple[int, int]]
) -> Iterator[Measured]:
    """Each quantity over the devices. Recordings of a device count together; of the bias the last counts.

    A quantity that too few units identify goes to `unidentified`."""
    index = {name: k for k, name in enumerate(names)}
    for axis, of_axis in known.items():
        there = dict.fromkeys(
            name for of in of_axis.values() for _, quantities in of for name in quantities if name != "bias"
        )
        for name in (*there, "bias"):
            own = {
                device: [quantities[name] for _, quantities in of if name in quantities]
                for device, of in of_axis.items()
            }
            own = {device: of if name != "bias" else of[-1:] for device, of in own.items() if of}
            identified = sum(any(record.identified for record in of) for of in own.values())
            if identified < max(UNITS_LEAST, 0.5 * len(of_axis)):
                unidentified |= {f"{axis}.{name}": (identified, len(of_axis))} if len(of_axis) >= UNITS_LEAST else {}
                continue
            y, s = np.array([_joined(of) for of in own.values()], np.float64).T
            devices = np.array([index[device] for device in own], np.intp)
            first = next(iter(own.values()))[0]
            yield Measured(f"{axis}.{name}", first.unit, laws[axis], y, s, devices, first.logarithm)


def _joined(known: Sequence[KnownAlone]) -> tuple[float, float]:
    weight = np.array([record.s**-2 for record in known])
    return float(weight @ np.array([record.y for record in known]) / weight.sum()), float(weight.sum() ** -0.5)


def _series(known: Mapping[str, OfAxis], names: Sequence[str]) -> Iterator[DriftSeries]:
    """Each quantity of each device that has recordings of two dates or more."""
    for axis, of_axis in known.items():
        for index, device in enumerate(names):
            dated = [(day, quantities) for day, quantities in of_axis.get(device, ()) if day is not None]
            for name in dict.fromkeys(name for _, quantities in dated for name in quantities):
                own = [(day, quantities[name]) for day, quantities in dated if name in quantities]
                days = np.array([day for day, _ in own])
                if np.unique(days).size > 1:
                    y, s = np.array([(quantity.y, quantity.s) for _, quantity in own], np.float64).T
                    yield DriftSeries(index, f"{axis}.{name}", own[0][1].unit, own[0][1].logarithm, days, y, s)


def _off(population: Population, off: float, log_p: float) -> str:
    measured = population.measured
    far = f"{sd_off(log_p):.1f} sd off"
    if measured.logarithm:
        return f"{measured.name} {math.exp(off):.3g} times the batch's median, {far}"
    return f"{measured.name} {off:+.3g} {measured.unit} from the batch's mean, {far}"


def _marked(
    devices: Mapping[str, Sequence[BatchUnit]], laws: Mapping[str, str], shared: Sequence[Shared]
) -> Iterator[tuple[str, str, str]]:
    """Axes of devices with what few others have, and its words: another lattice or law than most, a mark, a cause.

    A mark or a cause that more than MOST_ODD of the units have is the batch's own."""
    known = {(cause.kind, cause.name, cause.cause) for cause in shared}
    for axis in axes_of(devices):
        sound = sound_of(devices, axis)
        if len(sound) < UNITS_LEAST:
            continue
        lattice = [axes[-1]["lattice"] for axes in sound.values() if "lattice" in axes[-1]]
        step = float(np.median(lattice)) if len(lattice) >= 0.5 * len(sound) else math.nan
        marked: dict[str, list[tuple[str, str]]] = {}
        for name, axes in sound.items():
            for mark in dict.fromkeys(mark for result in axes for mark in result.get("marks", [])):
                marked.setdefault(mark, []).append((name, f"{axis} {mark}"))
            own = axes[-1].get("lattice", math.nan)
            if abs(own / step - 1.0) > 0.05:
                unit = axes[-1]["bias_now"]["unit"]
                yield axis, name, f"{axis} steps of {own:.3g} {unit}, the batch's are {step:.3g}"
            behind = _behind(axes[-1])
            if axis in laws and behind.get(laws[axis], math.inf) > OTHER_LAW + math.log(len(sound)):
                law = min(behind, key=lambda law: behind[law])
                yield axis, name, f"{axis} {law} by {behind[laws[axis]]:.0f} nats, the batch's law is {laws[axis]}"
            for unit_ in devices[name]:
                for cause in unit_.causes(axis):
                    if not any((kind, group_of(kind, unit_), cause) in known for kind in KINDS):
                        marked.setdefault(f"cause {cause}", []).append((name, f"{axis} {cause}"))
        for having in marked.values():
            words_of = dict(having)
            if len(words_of) <= MOST_ODD * len(sound):
                yield from ((axis, name, words) for name, words in words_of.items())


def _shared(devices: Mapping[str, Sequence[BatchUnit]], groupings: Sequence[Grouping]) -> list[Shared]:
    """Causes that a group's units have more often than chance gives it: Fisher's exact test, one-sided.

    FALSE_ALARM is shared among all groups and causes."""
    from scipy.stats import hypergeom  # half a second to import

    causes = [{c for unit in units for axis in unit.axes for c in unit.causes(axis)} for units in devices.values()]
    named = sorted(set().union(*causes)) if causes else []
    tests = [
        (kind, group, names, cause)
        for kind, names in groupings
        for group in dict.fromkeys(names)
        for cause in named
        if group and GROUP_UNITS_LEAST <= names.count(group) < len(names)
    ]
    shared = []
    for kind, group, names, cause in tests:
        inside = [cause in of for of, name in zip(causes, names, strict=True) if name == group]
        outside = [cause in of for of, name in zip(causes, names, strict=True) if name != group]
        having = sum(inside) + sum(outside)
        log_p = min(0.0, float(hypergeom.logsf(sum(inside) - 1, len(names), having, len(inside))))
        if log_p <= math.log(FALSE_ALARM / len(tests)) and sum(inside) > 0.5 * len(inside):
            shared.append(Shared(kind, group, cause, (sum(inside), len(inside)), (sum(outside), len(outside)), log_p))
    return sorted(shared, key=lambda cause: cause.log_p)


# ---------------------------------------------------------------------------------------------------------- in words


def batch_keys(batch: Batch) -> dict[str, Any]:
    """The keys of `selfcal.fleet/1` that a batch has: `population`, `unlike`, `shared_causes` and `units`."""
    names = list(batch.devices)
    units: dict[str, dict[str, Any]] = {}
    for population in batch.populations:
        measured = population.measured
        for k, device in enumerate(measured.at.tolist()):
            own = population.shrunken(k)
            units.setdefault(names[device], {})[measured.name] = vars(plain_interval(measured, own)) | {
                "unit": measured.unit
            }
    drift: dict[str, dict[str, Any]] = {}
    drifting: dict[str, list[str]] = {}
    for slope in batch.drifts:
        drift.setdefault(names[slope.of.at], {})[slope.of.quantity] = slope.entry()
        if slope.significant:
            of, per_day = slope.of, slope.per_day
            rate = f"{100.0 * math.expm1(per_day):+.3g} %" if of.logarithm else f"{per_day:+.3g} {of.unit}"
            basis = f"{of.y.size} recordings in {slope.days:.3g} days, {sd_off(slope.log_p):.1f} sd"
            drifting.setdefault(names[of.at], []).append(f"{of.quantity} {rate} a day, {basis}")
    return {
        "population": {population.measured.name: _entry(population, names) for population in batch.populations},
        "unlike": batch.unlike,
        "drifting": drifting,
        "drift": drift,
        "unidentified": {name: {"identified": n, "units": of} for name, (n, of) in batch.unidentified.items()},
        "shared_causes": [vars(cause) for cause in batch.shared],
        "units": units,
    }


def plain_interval(measured: Measured, of: Interval) -> Interval:
    """An interval of the quantity itself where the fit is of its logarithm."""
    return of.through(math.exp) if measured.logarithm else of


def _seen_from(population: Population) -> float | None:
    """How far off a unit must be to be unlike, a factor or in the unit; None: no part is as far off."""
    if not population.measured.logarithm:
        return population.seen_from
    return math.exp(population.seen_from) if population.seen_from <= math.log(MOST_TIMES) else None


def _entry(population: Population, names: Sequence[str]) -> dict[str, Any]:
    measured = population.measured
    return {
        "law": measured.law,
        "unit": measured.unit,
        "units": int(measured.y.size),
        "of": "ln" if measured.logarithm else "value",
        "middle": vars(plain_interval(measured, population.fit.middle)),
        "spread": vars(population.fit.spread),
        "unlike_from": _seen_from(population),
        "left_out": [names[device] for device in measured.at[~population.kept].tolist()],
        "apart": [
            {**vars(group), "members": [names[device] for device in group.members]} for group in population.apart
        ],
    }


def lines_of(batch: Batch) -> Iterator[str]:
    """A line for each population, quantity without population, axis left out, group apart, and shared cause."""
    for population in batch.populations:
        measured = population.measured
        middle, spread = plain_interval(measured, population.fit.middle), population.fit.spread
        kind = "spread of ln" if measured.logarithm else "spread"
        yield (
            f"population: {measured.name} ({measured.y.size} units): {middle.median:.4g} [{middle.q05:.4g}, "
            f"{middle.q95:.4g}] {measured.unit}, {kind} {spread.median:.2g} [{spread.q05:.2g}, {spread.q95:.2g}], "
            f"unlike from {seen_from_words(population)}"
        )
    yield from unidentified_lines(batch)
    for (axis, reason), names in batch.left_out.items():
        yield f"left out of the population: {axis} of {few(names, MOST_NAMED)}: {reason}"
    yield from group_lines(batch)


def group_lines(batch: Batch) -> Iterator[str]:
    """A line for each group that is apart, and for each cause that a group shares."""
    names = list(batch.devices)
    for population in batch.populations:
        for apart in population.apart:
            yield f"{f'{apart.kind} {apart.name}'.strip()}: {apart_words(population.measured, apart, names)}"
    for shared in batch.shared:
        inside, outside = shared.inside, shared.outside
        there = f"{inside[0]} of {inside[1]} units, {outside[0]} of {outside[1]} elsewhere"
        yield f"{shared.kind} {shared.name}: {shared.cause} in {there}: {_whose(shared.kind)}"


def unidentified_lines(batch: Batch) -> Iterator[str]:
    """A line for each quantity by which no unit is judged."""
    for name, (identified, units) in batch.unidentified.items():
        yield (
            f"no population of {name}: {identified} of {units} units identify it: "
            "record longer, or give --model a file with wider priors"
        )


def seen_from_words(population: Population) -> str:
    """How far off a unit must be to be unlike."""
    measured, off = population.measured, _seen_from(population)
    if off is None:
        return f"more than {MOST_TIMES:.0f} times: too few units, or too short recordings"
    return f"{off:.3g} times" if measured.logarithm else f"{off:.3g} {measured.unit}"


def apart_words(measured: Measured, apart: Apart, names: Sequence[str] = ()) -> str:
    """How a group differs, and whose that is. `names`: the devices, for a group without a label."""
    also = f"; the same units are {', '.join(apart.also)}" if apart.also else ""
    how = f"{math.exp(apart.offset):.3g} times" if measured.logarithm else f"{apart.offset:+.3g} {measured.unit} from"
    if apart.against is None:
        return f"{measured.name} is {how} the other units', {sd_off(apart.log_p):.1f} sd: {_whose(apart.kind)}{also}"
    if apart.kind == TWO_GROUPS:
        of = few([names[device] for device in apart.members], MOST_NAMED)
        return f"{measured.name} of {of} is {how} the others': no column of the batch explains it"
    other = f"{apart.kind} {apart.against}'s" if apart.against else f"the units' without a {apart.kind}"
    said = f"the two differ, {sd_off(apart.log_p):.1f} sd: which one is off, two alone do not show"
    return f"{measured.name} is {how} {other}, {said}{also}"


def _whose(kind: str) -> str:
    return "the lot's own" if kind == "lot" else f"the {kind}'s, not the parts'"
