"""Findings of all axes as events and sources: an entry each, what it changes, and those that matter first.

A finding is material where it moves a number that the user takes away: N, K or B of an axis by more than half of the
stated 90 % interval and by 5 %; or the bias by half of its interval; or the error of the bias ahead by 5 %, on held-out
time and beyond 2 sd. N, K and B without a finding are those of the final model less it, refitted; with it those of the
final model. The stated intervals are those of the extended model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import chdtrc, expit

from selfcal.adequacy.identify_document import Identified
from selfcal.bank.axis_result import HALF_90
from selfcal.base import units
from selfcal.base.grid import Array
from selfcal.diagnosis import hidden, words
from selfcal.diagnosis.alias import alias_of
from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.causes.variance_change import ENDS
from selfcal.diagnosis.finding import UNEXPLAINED, Diagnosed, Finding
from selfcal.diagnosis.score import bias_ahead, numbers
from selfcal.likelihood import work
from selfcal.likelihood.heldout import HARM_SD, MATTERS, in_sd
from selfcal.likelihood.state import State, log_normal, mixture, normal_entry
from selfcal.logs.recording import Recording
from selfcal.readings.moves import joined_intervals

#: The numbers, and their names in a summary.
SUMMARY = {"N": "arw", "K": "rrw", "B": "bias_instability"}
#: Key of the response to a slow change of a channel.
COEFFICIENT = "coefficient"
#: Units of what several axes have in common; all else is a size on an axis. Probability of axes that differ as much by
#: chance, below which they disagree.
OF_ALL, DISAGREE = ("s", "Hz", "deg"), 1e-3


@dataclass(frozen=True)
class EventMember:
    """A finding of an axis, and its entry in the document. `factor` turns the axis' inner unit into the recording's.
    `plain`: the noise of the readings with what the finding left out, over that without."""

    axis: str
    finding: Finding
    entry: dict[str, Any]
    factor: float
    plain: float = 1.0

    @cached_property
    def sides(self) -> tuple[dict[str, float], dict[str, float]]:
        """N, K and B without the finding and with it, in the recording's unit."""
        return _sides(*self.finding.without_and_with, self.factor, self.plain)

    @cached_property
    def bias(self) -> float:
        """How far the finding moves the bias, in the recording's unit."""
        before, after = self.finding.without_and_with
        with work.within(work.Work(lambda: False)):  # two passes: an end that was asked for keeps the result
            return 0.0 if before is after else (bias_ahead(after) - bias_ahead(before)) * self.factor

    def joins(self, other: EventMember) -> bool:
        """Whether both are the same event or source."""
        a, b = self.finding.look, other.finding.look
        events = (self.finding.event, other.finding.event)
        if a.cause != b.cause or all(events):
            return a.cause == b.cause and events[0] == events[1]
        cause = CAUSES[a.cause]
        if cause.grouping.pairs:
            return bool({self.axis, a.estimate["other"]} & {other.axis, b.estimate["other"]})
        return (self.axis != other.axis or a.when is None) and cause.grouping.alike(a, b)


@dataclass
class Event:
    """An event or source: its `members`, the strongest first. `entry`: of a hidden quantity, which its pieces join.
    `axes`: that it acts on, in the document's order."""

    members: list[EventMember]
    entry: dict[str, Any] | None = None
    id: str = ""
    axes: list[str] = field(default_factory=list)
    changes: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def cause(self) -> str:
        return hidden.ID if self.entry is not None else self.members[0].finding.look.cause

    @property
    def material(self) -> bool:
        return any(change["material"] for change in self.changes.values())

    @property
    def order(self) -> tuple[float, ...]:
        """What moves N, K or B first, then the bias, then its error ahead; by how much."""
        changes = [change for change in self.changes.values() if change["material"]]
        most = max((change["most"] for change in changes), default=0.0)
        nats = sum(member.finding.look.net for member in self.members)
        return (-most, -float(any("bias" in change["material"] for change in changes)), -float(bool(changes)), -nats)


def add_findings(
    document: dict[str, Any],
    recording: Recording,
    found: Mapping[str, Diagnosed],
    known: Mapping[str, Identified | None],
    quantity: dict[str, Any] | None,
) -> None:
    """Put the list of all axes into the document, the id of its event into each finding of an axis, the verdicts, and
    N, K and B before and after. `known`: by the extended model, of each axis; `quantity`: a hidden quantity's entry."""
    members = []
    for name, diagnosed in found.items():
        factor = units.factor(diagnosed.state.unit, document["axes"][name]["unit"])
        for finding, entry in zip(diagnosed.by_gain, document["axes"][name]["findings"], strict=True):
            members.append(EventMember(name, finding, entry, factor, _plain(diagnosed, finding, recording, factor)))
    events = grouped(members, quantity)
    drifts = {name: axis.drift for name, axis in found.items()}
    for event in events:
        acted = {*(event.entry or {"axes": ()})["axes"], *(member.axis for member in event.members)}
        event.axes = [axis for axis in document["axes"] if axis in acted]
        event.changes = {
            axis: _changes(event, axis, document["axes"][axis]["unit"], known.get(axis), drifts[axis])
            for axis in event.axes
        }
    events.sort(key=lambda event: event.order)
    counts: dict[str, int] = {}
    for event in events:
        counts[event.cause] = counts.get(event.cause, 0) + 1
        event.id = event.cause if counts[event.cause] == 1 else f"{event.cause}_{counts[event.cause]}"
        for member in event.members:
            member.entry["of"] = event.id
            member.entry["shared_with"] = [axis for axis in event.axes if axis != member.axis]
    document["findings"] = [_entry(event) for event in events]
    for entry, event in zip(document["findings"], events, strict=True):
        if "frequency_hz" in entry["estimate"] and _add_readings(entry, recording, found):
            for row in (entry, *(member.entry for member in event.members)):
                row["record_next"] = words.action(entry)
    for name, diagnosed in found.items():
        axis = document["axes"][name]
        own = [event for event in events if name in event.changes]
        material = [event for event in own if event.changes[name]["material"]]
        axis["causes"], axis["material"] = (sorted({event.cause for event in some}) for some in (own, material))
        axis["verdict"] = "inadequate" if material or UNEXPLAINED in axis["causes"] else "adequate"
        axis["small_findings"] = len(own) - len(material) - axis["causes"].count(UNEXPLAINED)
        of_axis = [member for member in members if member.axis == name]
        axis["numbers"] = _before_and_after(diagnosed, drifts[name], of_axis, axis["unit"], known.get(name))


def grouped(members: Sequence[EventMember], quantity: dict[str, Any] | None = None) -> list[Event]:
    """Events and sources: a finding joins the event that it matches, the nearest in time; else it begins an event."""
    events = [] if quantity is None else [Event([], quantity)]
    jumps = [] if quantity is None else [jump["time_s"] for jump in quantity["estimate"]["jumps"]]
    for member in sorted(members, key=lambda member: -member.finding.look.net):
        look = member.finding.look
        if quantity is not None and member.axis in quantity["axes"]:
            start_s = member.entry["when"][0] - look.when[0] if look.when else 0.0
            if CAUSES[look.cause].grouping.piece(look, quantity["axes"], [jump - start_s for jump in jumps]):
                events[0].members.append(member)
                continue
        fitting = [event for event in events if event.entry is None and any(map(member.joins, event.members))]
        if look.when is not None:  # an axis shows an event once
            fitting = [event for event in fitting if all(each.axis != member.axis for each in event.members)]
        if not fitting:
            events.append(Event([member]))
            continue
        nearest = min(fitting, key=lambda event: _apart(event, member))
        nearest.members.append(member)
        for other in (
            fitting if CAUSES[look.cause].grouping.pairs else ()
        ):  # a pair that joins two groups of axes merges them
            if other is not nearest:
                nearest.members += other.members
                events.remove(other)
    return events


def _apart(event: Event, member: EventMember) -> float:
    """Time between an event and a finding, s; 0 if either has no time."""
    one, two = event.members[0].finding.look.when, member.finding.look.when
    return 0.0 if one is None or two is None else abs(one[0] - two[0])


def _plain(axis: Diagnosed, finding: Finding, recording: Recording, factor: float) -> float:
    """White noise of the readings as they were read over that of the kept readings, by their differences: what was
    left out before any fit cannot be fitted without. 1 where the loop has a model without the finding."""
    read = axis.record.readings.get(axis.state.axis)
    if finding.before is not finding.after or finding.round or read is None:
        return 1.0
    raw = recording.columns[axis.state.axis].values
    if raw.size == read.moving.size:
        raw = np.where(read.moving, np.nan, raw)
    kept = _differences(read.working) * factor / math.sqrt(read.recording.rate_hz)
    return _differences(raw) / math.sqrt(recording.rate_hz) / kept if kept > 0.0 else 1.0


def _differences(values: Array) -> float:
    """Root mean square of the differences of neighbours; 0 without any."""
    steps = np.diff(values)
    steps = steps[np.isfinite(steps)]
    return float(np.sqrt(np.mean(steps**2))) if steps.size else 0.0


def _sides(before: State, after: State, factor: float, plain: float) -> tuple[dict[str, float], dict[str, float]]:
    """N, K and B by two models of an axis, times `factor`. `plain`: of N, by readings that no model has."""
    old, new = ({name: value * factor for name, value in numbers(state).items()} for state in (before, after))
    new["N"] *= math.sqrt(_calm(before, after))
    return {**old, "N": old["N"] * plain}, new


def _calm(before: State, after: State) -> float:
    """The variance where the noise is at its lowest level, over the model's nominal variance: a finding may have made
    several levels."""
    return float(np.quantile(after.r / before.r, ENDS[0]))


def _changes(
    event: Event, axis: str, unit: str, known: Identified | None, drift: tuple[State, State]
) -> dict[str, Any]:
    """What an event does to an axis: N, K and B without it over with it (infinite: with it the record shows none), the
    bias, its error ahead where that is known; and which of them it moves by as much as matters. `drift`: the axis with
    the jumps of a hidden quantity in its drift, and without them."""
    own = [member for member in event.members if member.axis == axis]
    entry = {} if event.entry is None else event.entry["axes"].get(axis, {})
    pairs = [member.sides for member in own]
    if event.entry is not None and drift[0] is not drift[1]:
        factor = units.factor(drift[0].unit, unit)
        pairs.append(_sides(*drift, factor, 1.0))
    found: dict[str, Any] = {}
    material, most = [], 0.0
    for name in SUMMARY:
        factor, moved = 1.0, 0.0
        for old, new in ((before[name], after[name]) for before, after in pairs):
            factor *= old / new if new else math.inf if old else 1.0
            moved += old - new
        found[name] = factor
        times = _times(name, factor, moved, known) if abs(factor - 1.0) > MATTERS else None
        if times is not None:
            material.append(name)
            most = max(most, abs(math.log(times)))
    found["bias"] = sum(member.bias for member in own)
    if known is not None and abs(found["bias"]) > HALF_90 * known.result.bias_sd:
        material.append("bias")
    ahead = _ahead([*(member.entry["gain"] for member in own), entry.get("gain")])
    if ahead:
        found["bias_error"] = ahead
    if any(_better(row) for row in ahead.values()):
        material.append("bias_error")
    if any(member.finding.look.estimate.get("undone") is False for member in own):
        material.append("readings")
    return {**found, "unit": unit, "material": material, "most": most}


def _times(name: str, factor: float, moved: float, known: Identified | None) -> float | None:
    """The factor by which a number is off without an event, if that is more than half of its stated interval. A number
    that is not identified has an upper limit, over which it is counted."""
    number = None if known is None else known.summary.get(SUMMARY[name])
    if known is None or number is None:
        return factor if 0.0 < factor < math.inf else 1.0
    stated = number.estimate.scaled(units.factor(known.group_unit, known.unit))
    if not stated.identified:
        return max(1.0, abs(moved) / stated.q95) if abs(moved) > 0.5 * stated.q95 else None
    if not 0.0 < factor < math.inf:
        factor = 1.0 + abs(moved) / stated.median
    return factor if abs(factor - 1.0) * stated.median > 0.5 * (stated.q95 - stated.q05) else None


def _ahead(gains: Sequence[Mapping[str, Any] | None]) -> dict[str, dict[str, float]]:
    """Errors of the bias by horizon, before the first finding and after the last, with the sd of the difference."""
    found: dict[str, dict[str, float]] = {}
    for gain in gains:
        for horizon, row in (gain["bias_rmse"]["horizon_s"] if gain else {}).items():
            best = found.get(horizon)
            if best is None or row["before"] - row["after"] > best["before"] - best["after"]:
                found[horizon] = row
    return found


def _better(row: Mapping[str, float]) -> bool:
    """Whether the error ahead falls by as much as matters."""
    less = row["before"] - row["after"]
    return less > MATTERS * row["before"] and less > HARM_SD * row["sd"]


def _entry(event: Event) -> dict[str, Any]:
    """The event's entry in the document."""
    looks = [member.finding.look for member in event.members]
    rows = [member.entry for member in event.members]
    if event.entry is not None:
        entry = {key: value for key, value in event.entry.items() if key != "id"}
    else:
        pairs = {
            frozenset((member.axis, str(member.finding.look.estimate.get("other")))): member for member in event.members
        }
        counted = list(pairs.values()) if CAUSES[event.cause].grouping.pairs else event.members
        gain = sum(member.finding.look.gain for member in counted)
        plans = [row["next_record"] for row in rows]
        lengths = [0.0 if plan is None else plan["duration_s"] or math.inf for plan in plans]
        longest = rows[int(np.argmax(lengths))]
        entry = {
            "cause": event.cause,
            "estimate": _common([row["estimate"] for row in rows]),
            "axes": {axis: _on(event, axis) for axis in event.axes},
            "evidence_nats": gain,
            "net_nats": min(gain, _worth(counted)),
            "confirmed": _confirmed([row["gain"] for row in rows]),
            "also_possible": list(dict.fromkeys(cause for row in rows for cause in row["also_possible"])),
            **{key: longest[key] for key in ("record_next", "next_record")},
        }
    on_second = [row.get("gain_on") for row in rows] + [entry.get("gain_on")]
    if any(on_second):
        entry["confirmed_on"] = _confirmed(on_second)
    changes = {axis: {key: change[key] for key in change if key != "most"} for axis, change in event.changes.items()}
    source = CAUSES[looks[0].cause].source if event.entry is None else "surroundings"
    found = {"id": event.id, **entry, "source": source, "material": event.material, "changes": changes}
    return {**found, "words": entry.get("words") or words.event(found)}


def _worth(members: Sequence[EventMember]) -> float:
    """Nats net of the searches: of an event that was found on several axes together it is paid for once."""
    together = {member.finding.event: member.finding.look.net for member in members if member.finding.event}
    return sum(together.values()) + sum(member.finding.look.net for member in members if not member.finding.event)


def _add_readings(entry: dict[str, Any], recording: Recording, found: Mapping[str, Diagnosed]) -> bool:
    """Add a line of means as it is in the readings: its frequency there, and its amplitude on each axis. Whether its
    frequency is another there."""
    told = []
    for axis, on_axis in entry["axes"].items():
        line, rate_hz = entry["estimate"]["frequency_hz"], found[axis].record.rate_hz
        if rate_hz > 0.5 * recording.rate_hz:
            continue
        seen = alias_of(recording, axis, line["median"], line["q95"] - line["median"], rate_hz)
        if seen is not None and abs(seen[0] / line["median"] - 1.0) > MATTERS:
            told.append(seen[0])
            unit = recording.columns[axis].unit
            on_axis["estimate"] = {"readings_amplitude": {"median": seen[1], "unit": unit}, **on_axis["estimate"]}
    if told:
        sd = 1.0 / recording.duration_s
        entry["estimate"]["readings_hz"] = normal_entry(float(np.median(told)), sd, "Hz")
        entry["words"] = words.event(entry)
    return bool(told)


def _common(estimates: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What all axes have in common: times and frequencies, by all of them, and whatever has no interval."""
    found: dict[str, Any] = {}
    for key in dict.fromkeys(key for estimate in estimates for key in estimate):
        values = [estimate[key] for estimate in estimates if key in estimate]
        if all(isinstance(value, Mapping) for value in values):
            if values[0]["unit"] in OF_ALL:
                found[key] = _of_all(values)
        elif key == "intervals":
            found[key] = [list(each) for each in joined_intervals([tuple(each) for value in values for each in value])]
        elif all(value == values[0] for value in values):
            found[key] = values[0]
    return found


def _of_all(values: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """A number that each axis shows by its own readings: the product of normal posteriors of its logarithm. Of the
    strongest finding alone where the axes disagree by more than chance, or a value may be 0."""
    ln = np.log([[max(value[key], 0.0) or math.nan for key in ("q05", "median", "q95")] for value in values])
    if not (np.isfinite(ln).all() and np.ptp(ln[:, 1]) > 0.0):  # a number of all axes already
        return values[0]
    weight = np.maximum((ln[:, 2] - ln[:, 0]) / (2.0 * HALF_90), 1e-12) ** -2.0
    middle = float(weight @ ln[:, 1] / weight.sum())
    if float(chdtrc(len(values) - 1, weight @ (ln[:, 1] - middle) ** 2)) < DISAGREE:
        return values[0]
    return log_normal(middle, float(weight.sum() ** -0.5), values[0]["unit"])


def _on(event: Event, axis: str) -> dict[str, Any]:
    """Sizes of an event on an axis, and the probability that it acts there."""
    own = [member for member in event.members if member.axis == axis]
    sizes = {
        key: value
        for member in reversed(own)
        for key, value in member.entry["estimate"].items()
        if isinstance(value, Mapping) and value["unit"] not in OF_ALL
    }
    sizes |= _sum_of_forms(own)
    return {"estimate": sizes, "probability": float(expit(max(member.finding.look.net for member in own)))}


def _sum_of_forms(own: Sequence[EventMember]) -> dict[str, Any]:
    """The coefficient of a channel on an axis that several findings share, each in a form of its own: a slow change of
    the channel acts by their sum, in the model with all of them. Empty where a single form has it all."""
    last = max(own, key=lambda member: member.finding.round)
    shapes = [member.finding.look.shape for member in own]
    keyed = [shape for shape in shapes if shape is not None and [key for key, _ in shape.keys].count(COEFFICIENT) == 1]
    units_of = {unit for shape in keyed for key, unit in shape.keys if key == COEFFICIENT}
    there = {regressor.name for regressor in last.finding.after.regressors}
    names = {column.name for shape in keyed for column in shape.regressors}
    if len(keyed) < 2 or len(units_of) > 1 or not names <= there:
        return {}
    # The sum is the coefficient of the first column where the others are differences from it.
    keys = [key for shape in keyed for key, _ in shape.keys]
    rows = np.vstack([shape.columns for shape in keyed])
    first, *others = [k for k, key in enumerate(keys) if key == COEFFICIENT]
    rows[others] -= rows[first]
    weight, means, sds = (each[0] for each in last.finding.after.without(names).posterior(rows))
    found = mixture(weight, means[:, first], sds[:, first], units_of.pop())
    return {COEFFICIENT: {key: value if key == "unit" else value * last.factor for key, value in found.items()}}


def _confirmed(gains: Sequence[Mapping[str, Any] | None]) -> bool | None:
    """Whether held-out time of all axes confirms it beyond 2 sd; None: no gain is defined."""
    known = [gain for gain in gains if gain]
    return in_sd(known) > HARM_SD if known else None


def _before_and_after(
    axis: Diagnosed, drift: tuple[State, State], members: Sequence[EventMember], unit: str, known: Identified | None
) -> dict[str, dict[str, Any]]:
    """N, K and B of an axis: without any finding, and with all, as the extended model has them where that is `known`.
    Both are then in its measure: an axis without findings has the same number twice. `drift`: as `_changes` has it."""
    factor = units.factor(axis.state.unit, unit)
    if any("y" in finding.look.changes for finding in axis.findings):  # the bank has the readings as they were read
        known = None
    old, whole = _sides(axis.first, drift[0], factor, math.prod(member.plain for member in members))
    _, new = _sides(axis.first, drift[1], factor, 1.0)
    mean = float((axis.state.r / axis.first.r)[~axis.loud].mean())  # the bank has a single level
    found: dict[str, dict[str, Any]] = {}
    for name, key in SUMMARY.items():
        after: dict[str, Any] = {"median": new[name], "identified": new[name] > 0.0}
        if known is not None and key in known.summary and bool(new[name]) == bool(whole[name]):
            level = math.sqrt(_calm(axis.first, drift[0]) / mean) if name == "N" else 1.0
            level *= new[name] / whole[name] if whole[name] else 1.0  # it has the jumps of a quantity in its drift
            number = known.summary[key].estimate.scaled(units.factor(known.group_unit, unit) * level)
            after = {part: getattr(number, part) for part in ("median", "q05", "q95", "identified")}
        measure = after["median"] / new[name] if after["identified"] and new[name] else 1.0
        found[name] = {"before": old[name] * measure, "unit": units.parameter_unit(key, unit), "after": after}
    return found


def parted(findings: Sequence[Mapping[str, Any]]) -> tuple[list[Mapping[str, Any]], list[Mapping[str, Any]]]:
    """The findings of a document to print in full, and the small findings, which change no number by as much as
    matters. A hidden quantity and time that is left out are printed in any case."""
    told: list[Mapping[str, Any]] = []
    small: list[Mapping[str, Any]] = []
    for finding in findings:
        in_any_case = finding["cause"] in (UNEXPLAINED, hidden.ID) or "intervals" in finding["estimate"]
        (told if finding["material"] or in_any_case else small).append(finding)
    return told, small


def times_of(finding: Mapping[str, Any]) -> list[tuple[float, float]]:
    """Begin and end of an event, s of the recording; empty where it acts all the time."""
    estimate = finding["estimate"]
    times = [estimate["time_s"]["median"]] if "time_s" in estimate else []
    length_s = estimate["duration_s"]["median"] if "duration_s" in estimate else 0.0
    found = [(time, time + length_s) for time in times]
    found += [(jump["time_s"], jump["time_s"]) for jump in estimate.get("jumps", ())]
    return [*found, *((begin, end) for begin, end in estimate.get("intervals", ()))]
