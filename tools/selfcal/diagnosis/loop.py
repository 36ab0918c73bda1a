"""The loop: fit, show what does not fit, name the cause, put it into the model, look again until nothing stands out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from types import MappingProxyType

import numpy as np

from selfcal.base.ending import Stopped
from selfcal.base.grid import regridded, runs
from selfcal.diagnosis import hidden, integrity, module, score
from selfcal.diagnosis.axis_verdict import unexplained
from selfcal.diagnosis.cause import Looks
from selfcal.diagnosis.causes import CAUSES, motion, tilt, variance_change
from selfcal.diagnosis.channel_looks import side_looks
from selfcal.diagnosis.curve import FREE
from selfcal.diagnosis.finding import ROUNDS, Diagnosed, Finding, rarer
from selfcal.diagnosis.record import TIMES, Record, is_counter
from selfcal.diagnosis.statistics import judged
from selfcal.likelihood import edges, work
from selfcal.likelihood.heldout import HeldOut, harmful, in_sd
from selfcal.likelihood.state import ALIKE, NET_LEAST, SLOW_S, FittedColumn, Look, State
from selfcal.readings.moves import Moved

#: Looks that a round tries on an axis.
LOOKS: tuple[Looks, ...] = tuple(cause.looks for cause in CAUSES.values() if cause.looks)
#: Looks of a round at every sample, after a round at means.
QUICK: tuple[Looks, ...] = tuple(cause.looks for cause in CAUSES.values() if cause.looks and not cause.of_means)
#: Looks of causes that act on a single axis: all axes together do not judge them.
OWN = {cause.looks for cause in CAUSES.values() if cause.looks and cause.grouping.settle is None}
#: Why an axis is not done.
INTERRUPTED = "interrupted before it was done"
SPENT = "its work was bounded (tools/pages/diagnose.md): there may be more causes"
#: Worth, nats, from which a look that predicts held-out time worse, and so is no cause, is no chance either.
UNLASTING = 2.0 * NET_LEAST
#: Means that may hold a jump: the mean in which it lies, and a neighbour.
HOLDS = 2
#: Noise of a fit over that of the first fit, below which no noise is left: such a fit explains readings that are equal.
NO_NOISE = 1e-6
#: Number of the first loud stretch of several axes, beyond those of events and lines.
FIRST_LOUD = 1 + module.EVENTS_MOST + module.FAST_LINES
#: Findings of an axis from which on a cause waits, if it was worth less than another cause when it was last looked at.
BUSY = 3


def diagnose_record(
    record: Record,
    axes: Sequence[str],
    advance: Callable[[str], None] = lambda text: None,
    found: dict[str, Diagnosed] | None = None,
    means: Mapping[str, Diagnosed] = MappingProxyType({}),
) -> dict[str, Diagnosed]:
    """Walk the loop on every axis of `axes`; the others of the record serve as side channels. `means`: what a look at
    means has found, of which the slow causes stay.

    `found` is filled as the rounds go, for who stops it: Stopped then goes on to the caller, and axes that are not done
    are `unfinished`. So is an axis whose work is spent (work.py), with what was found until then."""
    found = {} if found is None else found
    advance("fit")
    handled = {name: readings.moved for name, readings in record.readings.items() if readings.moved is not None}
    quiet = dict(record.axes)
    if handled:
        quiet = {name: state.masked(record.moving) for name, state in quiet.items()}
    states = dict(zip(quiet, work.each(lambda state: state.refit(), quiet.values()), strict=True))
    shown = [name for name in handled if name in axes]
    spoilt = dict(zip(shown, work.each(lambda name: record.axes[name].refit(), shown), strict=True))
    # An axis below its stated lattice is judged by nobody, and explains nobody. Nor is a counter's, but in means.
    left_out = {
        name
        for name, state in states.items()
        if state.below_lattice and (state.redrawn or state.lattice_is_stated or is_counter(record, name))
    }
    states = {name: state for name, state in states.items() if name not in left_out}
    record = replace(record, axes=states)
    works = {name: work.of_axis(state.y.size) for name, state in states.items()}
    for name in axes:
        if name not in left_out:
            found[name] = Diagnosed(spoilt.get(name, states[name]), states[name], record, unfinished=INTERRUPTED)
    record = _integrity(record, found, handled)
    record = _louder(record, found, advance)
    record = _of_means(record, found, means) if means else _together(record, found, advance)
    record = _fast(record, found)

    walked: dict[str, str] = {}  # and whether the work was spent

    def walk(name: str, causes: Sequence[Looks] = ()) -> None:
        axis, spent = found[name], ""
        axis.record = record
        with suppress(Stopped):
            try:
                with work.within(works[name]):
                    _rounds(record, axis, advance, causes or (QUICK if name in means else LOOKS))
            except work.Spent:
                spent = SPENT
            walked[name] = spent

    def end(name: str) -> None:
        with suppress(Stopped):
            _end(found[name], advance)
            found[name].unfinished = walked[name]

    work.each(walk, found)
    if len(walked) < len(found):
        raise Stopped
    named = {name: [finding.look for finding in axis.findings] for name, axis in found.items()}
    _weed(found)
    for cause in CAUSES.values():
        if cause.grouping.settle is not None:
            cause.grouping.settle(record, found)

    def again(name: str) -> None:
        """Look again after findings were dropped: they may have hidden others."""
        axis = found[name]
        gone = [look for look in named[name] if not any(look.repeats(kept.look) for kept in axis.findings)]
        axis.dropped += gone
        causes = tuple(looks for looks in (QUICK if name in means else LOOKS) if looks in OWN)
        if gone:
            walk(name, causes)
        with suppress(Stopped):
            _measure(axis)

    work.each(again, found)
    tilt.settle(record, found)
    work.each(end, found)
    return found


def _end(axis: Diagnosed, advance: Callable[[str], None]) -> None:
    """What is left over, each finding with all others, and the statistics of the model that the loop began with."""
    advance(f"{axis.state.axis}: statistics")
    _unexplained(axis)
    axis.findings = [each if each.record is not None else each.ended(axis.state) for each in axis.findings]
    axis.before = (
        judged(axis.first, seed=1).statistics if axis.findings and not axis.first.below_lattice else axis.after
    )


def _weed(found: Mapping[str, Diagnosed]) -> None:
    """Drop events of several axes that later findings explain as well, and axes of an event that they mostly explain.
    Noise with a memory, or a law that the first model lacked, looks like events to it. A leak shows an event of another
    axis again."""
    events: dict[int, list[tuple[Diagnosed, Finding]]] = {}
    for axis in found.values():
        for finding in axis.findings:
            if finding.event and finding.record is None:
                events.setdefault(finding.event, []).append((axis, finding))
    for parts in sorted(events.values(), key=lambda parts: sum(finding.look.gain for _, finding in parts)):
        price = sum(finding.look.gain for _, finding in parts) - max(finding.look.net for _, finding in parts)
        less = [finding.ended(axis.state).without_and_with[0] for axis, finding in parts]
        gains = [
            axis.state.best.ln_likelihood - state.best.ln_likelihood
            for (axis, _), state in zip(parts, less, strict=True)
        ]
        most = [gain > 0.5 * finding.look.gain for gain, (_, finding) in zip(gains, parts, strict=True)]
        kept = [gain for gain, own in zip(gains, most, strict=True) if own]
        least = NET_LEAST if len(kept) == 1 < len(parts) else module.NAMED_NATS
        stays = sum(kept) - price >= least
        for (axis, finding), state, own in zip(parts, less, most, strict=True):
            if stays and own:
                continue
            axis.findings = [each for each in axis.findings if each is not finding]
            axis.state = state


def _measure(axis: Diagnosed) -> None:
    """Give each finding its sizes with all others: a later column may have taken a part of an earlier column."""
    for k, finding in enumerate(axis.findings):
        if finding.record is None:
            beside = axis.state.without({column.name for column in finding.columns})
            axis.findings[k] = replace(finding, look=finding.look.measured(beside))


def _integrity(record: Record, found: Mapping[str, Diagnosed], handled: Mapping[str, Moved]) -> Record:
    """What needs no model beyond the first. `handled`: motion that is left out of the record already."""
    gone, held = integrity.missing(record)
    if held.any():
        masked = {name: state.masked(held).refit() for name, state in record.axes.items()}
        record = replace(record, axes=masked)
    states = dict(record.axes)
    changed = integrity.rate_changes(record)
    for name, axis in found.items():
        read = (*changed, *integrity.of_readings(record, name))
        axis.findings.extend(Finding(look, 0, axis.state, axis.state) for look in read)
        for moved in handled[name].events if name in handled else ():  # left out already, and in the first state
            spoilt = (
                _with_motion(record, axis.first, states[name], moved) if len(handled[name].events) > 1 else axis.first
            )
            axis.findings.append(Finding(motion.look_of(moved), 0, spoilt, states[name]))
        if name in gone:
            axis.findings.append(Finding(gone[name], 0, axis.state, states[name]))
    for name in states:
        for test in (integrity.saturation, integrity.quantization):
            told = test(replace(record, axes=states), name)
            if told is not None and name in found:
                found[name].findings.append(Finding(told[0], 0, states[name], told[1]))
            states[name] = states[name] if told is None else told[1]
        if name in found:
            found[name].state = states[name]
    return replace(record, axes=states)


def _with_motion(record: Record, first: State, rest: State, moved: Moved) -> State:
    """The state at `rest` with the readings of an event of its motion, as the `first` state has them."""
    y, time = rest.y.copy(), record.time_s
    for begin, end in moved.intervals:
        inside = (time > begin - rest.dt) & (time < end + rest.dt)
        y[inside] = first.y[inside]
    return replace(first, y=y).refit()


def _louder(record: Record, found: Mapping[str, Diagnosed], advance: Callable[[str], None]) -> Record:
    """Stretches in which the noise of several axes is louder go into the models of these, before a look at what axes
    have in common: a common source shakes them there. Those looks leave that time out."""
    advance("noise of all axes")
    states = dict(record.axes)
    for number in range(FIRST_LOUD, FIRST_LOUD + (variance_change.CAUSE.grouping.most or ROUNDS)):
        event = module.louder(states)
        if event is None or not _give(record, found, states, event, number, SLOW_S):
            break
    changed = {name: state.r / record.axes[name].r for name, state in states.items() if state is not record.axes[name]}
    return replace(_with(record, found, states), apart={name: rarer(ratio) for name, ratio in changed.items()})


def _together(record: Record, found: Mapping[str, Diagnosed], advance: Callable[[str], None]) -> Record:
    """What acts on several axes goes into the model of each. A cause that predicts held-out time worse on every axis is
    dropped."""
    advance("all axes together")
    record = _curves(record, found)
    states = dict(record.axes)
    seen = module.together(states, record.channels, record.since_power_on_s + record.start_s, record.apart)
    if seen is None:
        return record
    if seen.hidden is not None:
        for name in seen.hidden.names:
            states[name] = seen.hidden.put(states[name])
            if name in found:
                found[name].hidden = seen.hidden
    for number, candidate in enumerate(seen.events, 1):
        event = candidate.of(seen.names)
        if event.cause in module.JUMPS:
            times = module.sharpened(event.theta, [states[name] for name in event.names], seen.dt)
            event = replace(event, theta=times)
        _give(record, found, states, event, number, seen.dt)
    return _with(record, found, states)


def _curves(record: Record, found: Mapping[str, Diagnosed]) -> Record:
    """Curves of a channel that an axis shows beyond doubt go into its model: all axes together have no such shape, and
    take it for lines and for a quantity that nobody recorded."""
    states = dict(record.axes)
    for name, state in record.axes.items():
        looks = [look for cause in record.channels for look in side_looks(state, record, cause)]
        look = max(looks, key=lambda look: look.net, default=None)
        if look is None or look.net < module.CERTAIN or not _free(look):
            continue
        jumps = [jump for cause in module.JUMPS if (own := CAUSES[cause].looks) for jump in own(state, record)]
        if any(jump.net > look.net - ALIKE for jump in jumps):  # a curve of a channel that only rises has any jump
            continue
        after = state.refit(**look.changes)
        held_out = score.gain(look, state, after, record)
        if _refuted(look, held_out):
            if name in found:
                found[name].dropped.append(look)
            continue
        states[name] = after
        if name in found:
            found[name].findings.append(Finding(look, 0, state, after, held_out=held_out))
    return _with(record, found, states)


def _with(record: Record, found: Mapping[str, Diagnosed], states: Mapping[str, State]) -> Record:
    """The record with new states of its axes, which those in `found` take."""
    for name, axis in found.items():
        axis.state = states[name]
    return replace(record, axes=states)


def _give(
    record: Record,
    found: Mapping[str, Diagnosed],
    states: dict[str, State],
    event: module.JointEvent,
    number: int,
    span: float,
) -> bool:
    """Put an event into the models of the axes that have it, unless it predicts held-out time worse on all; whether
    that was done. `number`: of the event in the module; `span`: of the means that show it, s."""
    own = {name: _between(states[name], event.passing, span) for name in event.names}
    looks = {name: CAUSES[event.cause].located(state, record, event.theta) for name, state in own.items()}
    # An axis whose model has the column already has no look.
    looks = {name: look for name, look in looks.items() if look.shape is None or look.shape.regressors}
    if sum(look.gain for look in looks.values()) < module.NAMED_NATS:  # what the axes know by now explains it
        return False
    findings = {}
    for name, look in looks.items():
        after = own[name].refit(**look.changes)
        known = replace(look, net=max(look.net, event.evidence))
        held_out = score.gain(known, own[name], after, record, located=True)
        findings[name] = Finding(known, 0, own[name], after, held_out=held_out, event=number)
    if harmful([finding.held_out for finding in findings.values() if finding.held_out is not None]):
        return False
    for name, finding in findings.items():
        states[name] = finding.after
        if name in found:
            found[name].findings.append(finding)
    return True


def _between(state: State, passing: Sequence[tuple[int, int]], span: float) -> State:
    """The state less the samples in which a jump passes between levels, known to means of `span` s. A sample that is
    shorter than half a mean lies on either level, unless the jump takes several means."""
    gone = np.zeros(state.y.size, bool)
    for begin, end in passing:
        if state.dt > 0.5 * span or end - begin > HOLDS:
            gone[round(begin * span / state.dt) : round(end * span / state.dt)] = True
    return state.masked(gone).refit() if gone.any() else state


def _fast(record: Record, found: Mapping[str, Diagnosed]) -> Record:
    """What acts on several axes faster than means show."""
    states = dict(record.axes)
    for number, line in enumerate(module.fast_lines(states), 1 + module.EVENTS_MOST):
        _give(record, found, states, line, number, SLOW_S)
    return _with(record, found, states)


def _of_means(record: Record, found: Mapping[str, Diagnosed], means: Mapping[str, Diagnosed]) -> Record:
    """Put what means have found of slow causes into the models of every sample."""

    def taken_over(name: str) -> State:
        state, in_means = record.axes[name], means.get(name)
        if in_means is None:
            return state
        kept = [finding for finding in in_means.findings if CAUSES[finding.look.cause].of_means]
        known = in_means.state.extras
        extras = replace(state.extras, **known.slow)
        left_out = np.isfinite(in_means.first.y) & ~np.isfinite(in_means.state.y)
        state = _between(state, runs(left_out), 1.0 / in_means.record.rate_hz)
        columns = [
            _stretched(column, in_means.record, state)
            for column in in_means.state.regressors
            if column.cause == hidden.ID or any(column.name == own.name for finding in kept for own in finding.columns)
        ]
        if name in found:
            found[name].hidden = in_means.hidden
            found[name].findings += [_sharper(finding, in_means.record, columns, state) for finding in kept]
        if not columns and extras == state.extras:
            return state
        return state.refit(regressors=(*state.regressors, *columns), extras=extras)

    return _with(record, found, dict(zip(record.axes, work.each(taken_over, record.axes), strict=True)))


def _stretched(column: FittedColumn, means: Record, state: State) -> FittedColumn:
    """A column of means on the grid of a state. The edges of an event are moved to where the samples have them."""
    n, span = state.y.size, 1.0 / means.rate_hz
    times = {key: float(column.entry[key]) for key in TIMES if key in column.entry}
    if not times:
        return replace(column, values=regridded(column.values, span, n, state.dt))
    places = [round(time / state.dt) for time in module.sharpened([*times.values()], [state], span)]
    entry = {**column.entry, **{key: place * state.dt for key, place in zip(times, places, strict=True)}}
    return replace(column, values=edges.raised(n, *places), entry=entry)


def _sharper(finding: Finding, means: Record, columns: Sequence[FittedColumn], state: State) -> Finding:
    """A finding of means with the times of its jumps that the samples show, where none is left out about them."""
    finding = replace(finding, record=means, round=0)
    of_name = {column.name: column.entry for column in columns}
    entry = next((of_name[own.name] for own in finding.columns if own.name in of_name), {})
    places = np.array([round(float(entry[key]) / state.dt) for key in TIMES if key in entry], int)
    about = np.concatenate([places - 1, np.minimum(places, state.y.size - 1)])
    if not places.size or not np.isfinite(state.y[about]).all():
        return finding
    estimate = {**finding.look.estimate, **edges.known(state, places, np.ones(places.size))}
    return replace(finding, look=replace(finding.look, estimate=estimate))


def _rounds(record: Record, axis: Diagnosed, advance: Callable[[str], None], causes: Sequence[Looks]) -> None:
    """Name the best look of some causes, round by round, until no look is worth it."""
    number = 1 + max((finding.round for finding in axis.findings), default=0)
    worth: dict[Looks, float] = {}
    seen: dict[Looks, list[Look]] = {}  # at this state
    while number <= ROUNDS and not axis.state.below_lattice:
        advance(f"{axis.state.axis}: round {number}")
        looks = _looked(axis, record, causes, worth, seen)
        if not looks or looks[0].net < NET_LEAST:
            return
        # Among looks that are as likely, a channel that was recorded comes first.
        best = next((look for look in looks if look.cause in record.channels), looks[0])
        best = best if best.net > looks[0].net - ALIKE else looks[0]
        after = axis.state.refit(**best.changes) if best.changes else axis.state
        known = score.gain(best, axis.state, after, record)
        emptied = after.best.sigma < NO_NOISE * axis.first.best.sigma
        if emptied or _refuted(best, known):
            (axis.dropped if emptied or _free(best) else axis.harmful).append(best)
            continue
        rivals = tuple(look for look in looks if look.net > best.net - ALIKE and look.cause != best.cause)
        possible = tuple(dict.fromkeys(look.cause for look in rivals))
        axis.findings.append(Finding(best, number, axis.state, after, possible, rivals, held_out=known))
        if best.changes:
            axis.state = after
            seen.clear()
        causes_of = {(finding.round, finding.event, finding.look.cause) for finding in axis.findings}  # motion once
        if len(causes_of) < BUSY:
            worth.clear()
        number += 1


def _free(look: Look) -> bool:
    """Whether a look is a curve of a channel. If the channel only rises, the curve follows any drift."""
    return bool(look.estimate.get("form") == FREE)


def _refuted(look: Look, held_out: HeldOut | None) -> bool:
    """Whether held-out time speaks against a look: it predicts that clearly worse or, of a curve, no better.

    Of 60 clean axes with a strong drift and a temperature that rises 8 showed a curve, each 2 sd and more worse."""
    if _free(look):
        return held_out is None or held_out.gain is None or in_sd([held_out.gain]) <= 0.0
    return held_out is not None and held_out.harms


def _looked(
    axis: Diagnosed, record: Record, causes: Sequence[Looks], worth: dict[Looks, float], seen: dict[Looks, list[Look]]
) -> list[Look]:
    """The looks of `causes`, the most worth first; looks without a name come after every named cause. `seen`: looks at
    this state. A cause waits while its `worth`, when it was last looked at, is less than the best has now."""
    named = Counter(finding.look.cause for finding in axis.findings)
    waiting = sorted((cause for cause in causes if cause not in seen), key=lambda cause: -worth.get(cause, math.inf))
    while True:
        looks = [
            look
            for look in chain(*seen.values())
            if named[look.cause] < (CAUSES[look.cause].grouping.most or ROUNDS)
            and not any(map(look.repeats, (*axis.harmful, *axis.dropped)))
        ]
        best = max(map(_worth, looks), default=-math.inf)
        if not waiting or worth.get(waiting[0], math.inf) < best - ALIKE:
            return sorted(looks, key=lambda look: (_worth(look), look.net), reverse=True)
        cause = waiting.pop(0)
        seen[cause] = cause(axis.state, record)
        worth[cause] = max(map(_worth, seen[cause]), default=-math.inf)


def _worth(look: Look) -> float:
    """Nats of a look that may be named."""
    return -math.inf if look.cause == "unexplained" or look.net < NET_LEAST else look.net


def _unexplained(axis: Diagnosed) -> None:
    if axis.state.below_lattice:
        return
    axis.after, look = unexplained(axis.state, axis.record)
    if look is None and not axis.findings:
        look = _unlasting(axis.harmful)
    if look is not None and all(finding.look.cause != "unexplained" for finding in axis.findings):
        axis.findings.append(Finding(look, ROUNDS + 1, axis.state, axis.state))


def _unlasting(harmful: Sequence[Look]) -> Look | None:
    """The most evident of the looks that predict held-out time worse, as unexplained."""
    most = max(harmful, key=lambda look: look.net, default=None)
    if most is None or most.net < UNLASTING:
        return None
    estimate = {"statistic": f"{most.cause} that does not last", "measured": most.gain}
    return Look("unexplained", most.gain, most.net, estimate, {}, shown_by=str(most.estimate.get("other", most.cause)))
