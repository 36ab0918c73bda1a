"""The loop: fit, show what does not fit, name the cause, put it into the model, look again until nothing stands out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

from selfcal.base.ending import Stopped
from selfcal.diagnosis import integrity, score
from selfcal.diagnosis.cause import Looks
from selfcal.diagnosis.causes import CAUSES, motion
from selfcal.diagnosis.finding import ROUNDS, Diagnosed, Finding
from selfcal.diagnosis.record import Record, carried
from selfcal.diagnosis.statistics import judged
from selfcal.diagnosis.verdict import unexplained
from selfcal.likelihood import work
from selfcal.likelihood.state import ALIKE, NET_LEAST, Look, State
from selfcal.readings.motion import Moved

#: Looks that one round tries on an axis.
LOOKS: tuple[Looks, ...] = tuple(cause.looks for cause in CAUSES.values() if cause.looks)
#: What the readings of an axis show by themselves.
READ = (integrity.misread, integrity.held_samples, integrity.stuck, integrity.recurring)
#: Why an axis is not done.
INTERRUPTED = "interrupted before it was done"
SPENT = "its work was bounded (tools/README.md): there may be more causes"
#: A look that predicts held-out time worse is no cause. From this worth on it is no chance either.
UNLASTING = 2.0 * NET_LEAST
#: From this finding on, a cause that is not worth telling waits until none of the others is.
BUSY = 3


def diagnose_record(
    record: Record,
    axes: Sequence[str],
    advance: Callable[[str], None] = lambda text: None,
    found: dict[str, Diagnosed] | None = None,
) -> dict[str, Diagnosed]:
    """Walk the loop on every axis of `axes`; the others of the record serve as side channels.

    `found` is filled as the rounds go, for who stops it: Stopped then goes on to the caller, and axes that are not done
    are `unfinished`. So is an axis whose work is spent (work.py), with what was found until then."""
    found = {} if found is None else found
    advance("fit")
    handled = {name: one.moved for name, one in record.readings.items() if one.moved is not None}
    quiet = dict(record.axes)
    if handled:
        quiet = {name: integrity.masked(state, record.moving) for name, state in quiet.items()}
    states = dict(zip(quiet, work.each(lambda state: state.refit(), quiet.values()), strict=True))
    shown = [name for name in handled if name in axes]
    spoilt = dict(zip(shown, work.each(lambda name: record.axes[name].refit(), shown), strict=True))
    # An axis below its stated lattice is judged by nobody, and explains nobody. Nor is a counter's, but in means.
    left_out = {
        name
        for name, state in states.items()
        if state.below_lattice and (state.redrawn or _stated(state) or carried(record, name))
    }
    states = {name: state for name, state in states.items() if name not in left_out}
    record = replace(record, axes=states)
    works = {name: work.of_axis(state.y.size) for name, state in states.items()}
    for name in axes:
        if name not in left_out:
            found[name] = Diagnosed(spoilt.get(name, states[name]), states[name], record, unfinished=INTERRUPTED)
    record = _integrity(record, found, handled)

    def walk(name: str) -> None:
        one, spent = found[name], ""
        one.record = record
        with suppress(Stopped):
            try:
                with work.within(works[name]):
                    _rounds(record, one, advance)
            except work.Spent:
                spent = SPENT
            _end(one, advance)
            one.unfinished = spent

    work.each(walk, found)
    settled = [cause.settle(record, found) for cause in CAUSES.values() if cause.settle is not None]
    changed = list(dict.fromkeys(name for names in settled for name in names))
    _share(found)
    work.each(lambda name: _end(found[name], advance), changed)
    if any(one.unfinished == INTERRUPTED for one in found.values()):
        raise Stopped
    return found


def _stated(state: State) -> bool:
    """Whether the model file states the lattice."""
    return state.stated_lsb > 0.0 and abs(state.lsb / state.stated_lsb - 1.0) < 0.02


def _end(one: Diagnosed, advance: Callable[[str], None]) -> None:
    """Sizes in the final model, what is left over, and the statistics of the model that the loop began with."""
    advance(f"{one.state.axis}: statistics")
    one.findings = [_measured(finding, one.state) for finding in one.findings if finding.round <= ROUNDS]
    _unexplained(one)
    one.before = judged(one.first, seed=1).statistics if one.findings and not one.first.below_lattice else one.after


def _measured(finding: Finding, final: State) -> Finding:
    """The finding with its sizes beside all others: a later column may have taken a part of an earlier one."""
    beside = final.without({column.name for column in finding.columns})
    return replace(finding, look=finding.look.measured(beside))


def _integrity(record: Record, found: Mapping[str, Diagnosed], handled: Mapping[str, Moved]) -> Record:
    """What needs no model beyond the first. `handled`: motion that is left out of the record already."""
    gone, held = integrity.missing(record)
    if held.any():
        masked = {name: integrity.masked(state, held).refit() for name, state in record.axes.items()}
        record = replace(record, axes=masked)
    states = dict(record.axes)
    changed = integrity.rate_changes(record)
    for name, one in found.items():
        others = tuple(other for other in found if other != name)
        one.findings.extend(Finding(look, 0, one.state, one.state, shared_with=others) for look in changed)
        for found_at in (look(record, name) for look in READ):
            if found_at is not None:
                one.findings.append(Finding(found_at, 0, one.state, one.state))
        if name in handled:  # the motion that is left out already spoilt the first state
            shared = tuple(other for other in handled if other != name)
            one.findings.append(Finding(motion.look_of(handled[name]), 0, one.first, states[name], shared_with=shared))
        if name in gone:
            one.findings.append(Finding(gone[name], 0, one.state, states[name]))
    for name in states:
        clipped = None if states[name].below_lattice else integrity.saturation(replace(record, axes=states), name)
        if clipped is not None:
            if name in found:
                found[name].findings.append(Finding(clipped[0], 0, states[name], clipped[1]))
            states[name] = clipped[1]
        spoilt_codes = clipped is None and not states[name].below_lattice
        uneven = integrity.uneven(replace(record, axes=states), name) if spoilt_codes else None
        if uneven is not None:
            if name in found:
                found[name].findings.append(Finding(uneven[0], 0, states[name], uneven[1]))
            states[name] = uneven[1]
        lattice = integrity.quantization(states[name])
        if lattice is not None and uneven is None:
            before = states[name]
            states[name] = replace(before, stated_lsb=before.lsb)
            if name in found:
                found[name].findings.append(Finding(lattice, 0, before, states[name]))
        if name in found:
            found[name].state = states[name]
    return replace(record, axes=states)


def _rounds(record: Record, one: Diagnosed, advance: Callable[[str], None]) -> None:
    number = 1 + max((finding.round for finding in one.findings), default=0)
    idle: set[Looks] = set()
    while number <= ROUNDS and not one.state.below_lattice:
        advance(f"{one.state.axis}: round {number}")
        waiting = [cause for cause in LOOKS if cause in idle]
        looks, idle = _looked(one, record, [cause for cause in LOOKS if cause not in idle])
        harms = True
        while harms:  # the state stays, and so do the other looks at it
            if waiting and (not looks or looks[0].net < NET_LEAST):
                more, unworthy = _looked(one, record, waiting)
                looks, idle, waiting = _by_worth([*looks, *more]), idle | unworthy, []
            if not looks or looks[0].net < NET_LEAST:
                return
            best, after = looks[0], one.state.refit(**looks[0].changes)
            before = best.before or one.state
            known = score.gain(best, before, after, record)
            harms = known is not None and known.harms
            if harms:
                one.harmful.append(best)
                looks = [look for look in looks if not look.repeats(best)]
        idle = idle | set(waiting) if len(one.findings) >= BUSY else set()
        rivals = tuple(
            dict.fromkeys(look.cause for look in looks[1:] if look.net > best.net - ALIKE and look.cause != best.cause)
        )
        one.state = after
        replaced = [finding for finding in one.findings if _gone(finding, after)]
        best = replace(best, gain=best.gain + sum(finding.look.gain for finding in replaced))
        best = replace(best, net=best.net + sum(finding.look.net for finding in replaced))
        one.findings = [finding for finding in one.findings if not _gone(finding, after)]
        one.findings.append(Finding(best, number, before, after, rivals, held_out=known))
        number += 1


def _gone(finding: Finding, state: State) -> bool:
    """Whether a later finding took the place of this one's columns."""
    kept = {id(column) for column in state.regressors}
    return bool(finding.columns) and not any(id(column) in kept for column in finding.columns)


def _looked(one: Diagnosed, record: Record, causes: Sequence[Looks]) -> tuple[list[Look], set[Looks]]:
    """The looks of `causes`, the most worth first, and the causes of which none is worth naming."""
    named = Counter(finding.look.cause for finding in one.findings)
    found: list[Look] = []
    idle: set[Looks] = set()
    for cause in causes:
        looks = [
            look
            for look in cause(one.state, record)
            if named[look.cause] < (CAUSES[look.cause].most or ROUNDS) and not any(map(look.repeats, one.harmful))
        ]
        found += looks
        if all(look.net < NET_LEAST for look in looks):
            idle.add(cause)
    return _by_worth(found), idle


def _by_worth(looks: Sequence[Look]) -> list[Look]:
    """The most worth first; what has no name comes after every cause that has one."""
    return sorted(looks, key=lambda look: (look.cause == "unexplained" or look.net < NET_LEAST, -look.net))


def _share(found: Mapping[str, Diagnosed]) -> None:
    """The same cause on several axes is one finding with its size on each."""
    for name, one in found.items():
        for k, finding in enumerate(one.findings):
            others = tuple(
                other
                for other, two in found.items()
                if other != name and any(_same(finding.look, more.look) for more in two.findings)
            )
            one.findings[k] = replace(finding, shared_with=tuple(dict.fromkeys((*finding.shared_with, *others))))


def _same(a: Look, b: Look) -> bool:
    return a.cause == b.cause and CAUSES[a.cause].alike(a, b)


def _unexplained(one: Diagnosed) -> None:
    if one.state.below_lattice:
        return
    one.after, look = unexplained(one.state, one.record)
    if look is None and not one.findings:
        look = _unlasting(one.harmful)
    if look is not None and all(finding.look.cause != "unexplained" for finding in one.findings):
        one.findings.append(Finding(look, ROUNDS + 1, one.state, one.state))


def _unlasting(harmful: Sequence[Look]) -> Look | None:
    """The most evident of the looks that predict held-out time worse, as what has no name."""
    most = max(harmful, key=lambda look: look.net, default=None)
    if most is None or most.net < UNLASTING:
        return None
    estimate = {"statistic": f"{most.cause} that does not last", "measured": most.gain}
    return Look("unexplained", most.gain, most.net, estimate, {}, shown_by=str(most.estimate.get("other", most.cause)))
