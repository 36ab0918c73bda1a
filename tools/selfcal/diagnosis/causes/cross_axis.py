"""Another axis leaks into this axis: at once, through a filter, by its rate or its square."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from selfcal.base.grid import Array
from selfcal.diagnosis import channel_looks, hidden
from selfcal.diagnosis.cause import Cause, Grouping, Key, Simulated, Written, shown, sized
from selfcal.diagnosis.channel_looks import Channel, form_of
from selfcal.diagnosis.finding import Diagnosed, Finding
from selfcal.diagnosis.model_tree import digits
from selfcal.diagnosis.record import Record
from selfcal.likelihood.joint import SIZE_WIDTHS, act_apart
from selfcal.likelihood.state import ALIKE, EVIDENT, NET_LEAST, Look, State
from selfcal.logs.recording import bridged
from selfcal.model.forms import formed
from selfcal.model.regressors import coefficient_unit

#: Windows of a rate, s: another axis moves faster than a temperature.
RATE_WINDOWS_S = (0.0, 5.0, 20.0, 60.0, 150.0)


def looks(state: State, record: Record) -> list[Look]:
    """A look for every other axis."""
    others = {name: values for name, values in record.other_axes(state.axis).items() if np.ptp(values) > 0.0}
    return channel_looks.look(state, [_channel(record, name, values) for name, values in others.items()])


def _channel(record: Record, name: str, values: Array) -> Channel:
    """Another axis as a channel of `values` [n]."""
    return Channel(
        "cross_axis",
        f"axis_{name}",
        name,
        record.axes[name].unit,
        values,
        rate_windows_s=RATE_WINDOWS_S,
        forms=("static", "lag", "rate", "square"),  # first_order would follow noise that both share
        slow=False,
        ln_looks=math.log(max(1, len(record.axes) - 1)),
        extra={"other": name},
    )


def _settle(record: Record, found: Mapping[str, Diagnosed]) -> None:
    """Keep the axis that gains more as the follower, where two axes each blame the other.

    White noise correlates both ways alike, and only the drifts distinguish the two. Where they do not, a common source
    of several axes is likelier than several sources of an axis. Of a lone pair the weaker coupling is kept: a
    mechanical coupling is below 1."""
    _arms(record, found)
    _own_ramps(record, found)
    _star(record, found)
    static = [leak for leak in leaks(found) if leak[2].look.estimate["form"] == "static"]
    pairs = {(name, other): finding for name, other, finding in static}
    partners = _partners(found)
    for (name, other), finding in pairs.items():
        back = pairs.get((other, name))
        if back is None:  # the other axis may follow by a lag or a rate alone
            source = found[other].state if other in found else record.axes[other]
            known = source.best.ln_likelihood - without_axis(source, name).best.ln_likelihood
            if known > finding.look.gain - ALIKE:
                _drop(found[name], other, without_axis(found[name].state, other))
            continue
        ahead: float = back.look.gain - finding.look.gain
        if abs(ahead) < ALIKE:
            ahead = partners[name] - partners[other]
        if ahead == 0.0:
            sizes = [abs(float(side.look.estimate["coefficient"]["median"])) for side in (finding, back)]
            ahead = sizes[0] - sizes[1]
        if ahead > 0.0:
            _drop(found[name], other, without_axis(found[name].state, other))
    arms: dict[str, set[str]] = {}
    for name, other, _ in leaks(found):
        arms.setdefault(other, set()).add(name)
    for name, axis in found.items():
        of_other: dict[str, list[int]] = {}
        for k, finding in enumerate(axis.findings):
            if finding.look.cause == "cross_axis":
                of_other.setdefault(str(finding.look.estimate["other"]), []).append(k)
        for other, places in of_other.items():
            unsure = ""
            if axis.hidden is not None and axis.hidden.explains(other, arms[other]):
                unsure = hidden.ID
            elif not _source_shown(record, found, name, other, [axis.findings[k] for k in places]):
                unsure = "not shown"
            for k in places if unsure else ():
                look = axis.findings[k].look
                look = replace(look, estimate={**look.estimate, "source": unsure})
                axis.findings[k] = replace(axis.findings[k], look=look)
    _weigh_anew(found)


def leaks(found: Mapping[str, Diagnosed]) -> list[tuple[str, str, Finding]]:
    """Leaks: the axis that follows, the other axis, and the finding of each."""
    return [
        (name, str(finding.look.estimate["other"]), finding)
        for name, axis in found.items()
        for finding in axis.findings
        if finding.look.cause == "cross_axis"
    ]


def _partners(found: Mapping[str, Diagnosed]) -> Counter[str]:
    """Axes that each goes together with, whichever follows."""
    pairs = {frozenset((name, other)) for name, other, _ in leaks(found)}
    return Counter(name for pair in pairs for name in pair)


def _drop(axis: Diagnosed, other: str, free: State) -> None:
    """Take every form of another axis out."""
    axis.findings = [
        finding
        for finding in axis.findings
        if finding.look.cause != "cross_axis" or finding.look.estimate["other"] != other
    ]
    axis.state = free


def _arms(record: Record, found: Mapping[str, Diagnosed]) -> None:
    """Give the source that all axes together show best to each axis that it leaks into: no axis need show it alone.
    With a quantity the white noise of the axes must show it too."""
    gains = dict.fromkeys(found, 0.0)
    for name, axis in found.items():
        others = {other: values for other, values in record.other_axes(name).items() if other in found}
        for other, gain in zip(others, axis.state.scores([*others.values()]) if others else (), strict=True):
            gains[other] += float(gain)
    for _, other, finding in leaks(found):
        gains[other] = gains.get(other, 0.0) + finding.look.gain
    source = max(gains, key=lambda name: gains[name], default="")
    free = {name: without_axis(axis.state, source) for name, axis in found.items() if name != source}
    if len(free) < 2 or gains[source] < NET_LEAST:
        return
    columns = {name: record.other_axes(name)[source] for name in free}
    each = [free[name].bayes(columns[name], np.array(SIZE_WIDTHS)) for name in free]
    star = act_apart(*map(np.array, zip(*each, strict=True)))
    names = [[*free][k] for k in star.axes]
    if len(names) < 2 or star.evidence - math.log(len(gains)) < EVIDENT:
        return
    quantity = found[names[0]].hidden
    if quantity is not None and quantity.explains(source, names):
        return
    for name in {*names} - {name for name, other, _ in leaks(found) if other == source}:
        for look in channel_looks.look(free[name], [_channel(record, source, columns[name])])[:1]:
            after = free[name].refit(**look.changes)
            found[name].findings.append(Finding(look, 0, free[name], after))
            found[name].state = after


def _own_ramps(record: Record, found: Mapping[str, Diagnosed]) -> None:
    """Drop an axis that shows in another by nothing but what its own model explains: a step or a ramp, of which both
    may have their own."""
    for name, other, _ in leaks(found):
        source = found[other].state if other in found else record.axes[other]
        if all(column.cause == "cross_axis" for column in source.regressors):
            continue
        source, free = without_axis(source, name), without_axis(found[name].state, other)
        rest = channel_looks.look(free, [_channel(record, other, bridged(source.rest))])
        if not any(look.net >= NET_LEAST for look in rest):
            _drop(found[name], other, free)


def _weigh_anew(found: Mapping[str, Diagnosed]) -> None:
    """Weigh a quantity together with the leaks: without them it takes the drift of a source for itself."""
    quantity = next((axis.hidden for axis in found.values() if axis.hidden is not None), None)
    own = any(finding.look.estimate.get("source") != hidden.ID for _, _, finding in leaks(found))
    if quantity is None or not own or not {*quantity.names} <= found.keys():
        return
    states = {name: found[name].state.without({hidden.ID}).refit() for name in quantity.names}
    again = quantity.beside(states)
    for name, state in states.items():
        found[name].hidden, found[name].state = again, state if again is None else again.put(state)


def _star(record: Record, found: Mapping[str, Diagnosed]) -> None:
    """Turn a leak about, if its follower goes together with more axes than its source does, and the reverse explains
    it nearly as well."""
    partners = _partners(found)
    for name, other, finding in leaks(found):
        if partners[name] <= partners[other] or other not in found:
            continue
        axis, source = found[name], found[other]
        free = without_axis(axis.state, other)
        back = channel_looks.look(source.state, [_channel(record, name, record.other_axes(other)[name])])
        lost = axis.state.best.ln_likelihood - free.best.ln_likelihood
        if back and back[0].gain > lost - ALIKE:  # of the pair that is shown already, the likelier source
            _drop(axis, other, free)
            after = source.state.refit(**back[0].changes)
            source.findings.append(replace(finding, look=back[0], before=source.state, after=after, held_out=None))
            source.state = after


def _source_shown(
    record: Record, found: Mapping[str, Diagnosed], name: str, other: str, findings: Sequence[Finding]
) -> bool:
    """Whether the record shows that the other axis is the source: not this axis, and no third axis of both. `findings`:
    all of the pair, which share the verdict.

    The joint likelihood of both axes must be clearly larger with this axis following than with the other following. A
    lag has a direction in time as well: where the other axis' future explains as much as its past, or adds to it, both
    follow a third.
    """
    final = found[name].state
    free = without_axis(final, other)
    ahead = final.best.ln_likelihood - free.best.ln_likelihood
    source = without_axis(found[other].state if other in found else record.axes[other], name)
    back = source.with_columns(record.other_axes(other)[name])[0]
    lagged = [finding for finding in findings if "lag_s" in finding.look.estimate]
    return ahead - back > ALIKE and all(_is_late(final, finding, record.other_axes(name)[other]) for finding in lagged)


def _is_late(final: State, finding: Finding, values: Array) -> bool:
    """Whether the past of the other axis `values` [n] explains a lag, and its future neither instead nor as well."""
    lag_s = float(finding.look.estimate["lag_s"]["median"])
    early = formed(values[::-1], "lag", lag_s, 0.0, final.dt)[::-1]
    beside = final.without({regressor.name for regressor in finding.columns if form_of(regressor)[2] == "lag"})
    instead = beside.fitted_with(final.best.terms, early).ln_likelihood
    both = final.fitted_with(final.best.terms, early).ln_likelihood
    return final.best.ln_likelihood - instead > ALIKE and both - final.best.ln_likelihood < ALIKE


def without_axis(state: State, other: str) -> State:
    """The state without the columns of another axis."""
    kept = tuple(
        regressor
        for regressor in state.regressors
        if regressor.cause != "cross_axis" or regressor.entry["column"] != other
    )
    return state if len(kept) == len(state.regressors) else state.refit(regressors=kept)


def _least(state: State, record: Record) -> dict[str, tuple[float, str]] | None:
    """Least coefficient of the axis that would have to leak most."""
    sizes = {name: state.least(values) for name, values in record.other_axes(state.axis).items()}
    sizes = {name: value for name, value in sizes.items() if math.isfinite(value)}
    if not sizes:
        return None
    worst = max(sizes, key=lambda name: sizes[name])
    return {"coefficient": (sizes[worst], coefficient_unit(state.unit, record.axes[worst].unit))}


def _entry(entry: Mapping[str, Any], look: Look | None, record: Record) -> dict[str, Any]:
    """A module knows the reading and not its level."""
    own = sized(entry, look, record)
    if entry.get("form") == "rate":
        return own
    return {**own, "reference": digits(record.axes[str(entry["column"])].level)}


CAUSE = Cause(
    "cross_axis",
    words="Another axis leaks into this one.",
    unsure="This axis and another one move together. The record does not show which of them is the source: it may be a "
    "third one that was not recorded, such as the temperature.",
    record_next="Turn the sensor so that the other axis reads something else. Record temperature and supply beside it.",
    source="sensor",
    looks=looks,
    pictures=shown("means", "evidence"),
    least=_least,
    grouping=Grouping(
        alike=lambda a, b: bool(a.estimate["other"] == b.estimate["other"]),
        piece=lambda look, axes, jumps: look.estimate["other"] in axes and look.estimate.get("source") == hidden.ID,
        settle=_settle,
    ),
    written=Written(entry=_entry, of_column=channel_looks.of_other),
    simulated=Simulated(
        keys={"coefficient": Key(lambda s: 0.5, "cross_coefficient"), **channel_looks.EFFECT_KEYS},
        follows=True,
        of_estimate=channel_looks.of_look,
        add=lambda keys, channels: channel_looks.added(keys, channels, channels.axes[str(keys["other"])]),
    ),
)
