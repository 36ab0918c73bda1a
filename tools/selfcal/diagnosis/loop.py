"""The loop: fit, show what does not fit, name the cause, put it into the model, look again until nothing stands out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from selfcal.diagnosis import integrity, score, work
from selfcal.diagnosis.causes import motion, noise, periodic, regressors, step
from selfcal.diagnosis.causes.motion import Moved
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import NET_LEAST, Look, State
from selfcal.diagnosis.statistics import Statistic, combined, judged
from selfcal.ending import Stopped

#: Causes that one round tries on an axis.
LOOKS: tuple[Callable[[State, Record], list[Look]], ...] = (
    regressors.looks,
    step.looks,
    periodic.looks,
    noise.colored,
    noise.flicker,
    noise.variance_change,
    noise.outliers,
)
#: Those that motion must not be taken for, and what they must show to be taken first.
STATIONARY = (periodic.looks, noise.colored, noise.variance_change)
CERTAIN = 25.0
#: Motion whose held-out gain lies so many standard deviations below 0 is none.
HARM_SD = 2.0
#: Rounds at most: a recording that holds more is told as it is then.
ROUNDS = 12
#: Why an axis is not done.
INTERRUPTED = "interrupted before it was done"
SPENT = "its work was bounded (tools/README.md): there may be more causes"
#: From this finding on, a cause that is not worth telling waits until none of the others is.
BUSY = 3
#: Times that one cause is named on an axis: more jumps or changes of the noise are none of single ones.
MOST = {"step": 3, "variance_change": 3}
#: A band wider than this share of a line's frequency lies at one of its multiples by chance.
HARMONIC_MOST = 0.1
#: Two causes whose worth differs by less than this, nats, cannot be told apart.
ALIKE = 3.0
#: Probability that the statistics together call an axis of a fitting record inadequate.
P_UNEXPLAINED = 1e-3
#: What is not so improbable is judged once more, by an ensemble that shows how long the tails are. With the first alone
#: 4 of 1351 clean axes were called inadequate.
P_CERTAIN, AGAIN = 1e-12, 240


@dataclass(frozen=True)
class Finding:
    """One named cause on one axis."""

    look: Look
    round: int
    before: State
    after: State
    also_possible: tuple[str, ...] = ()
    shared_with: tuple[str, ...] = ()


@dataclass
class Diagnosed:
    """One axis after the loop: what it began as, what it is, and what was found in which record. `unfinished`: why it
    is not done, "" if it is."""

    first: State
    state: State
    record: Record
    findings: list[Finding] = field(default_factory=list)
    before: list[Statistic] = field(default_factory=list)
    after: list[Statistic] = field(default_factory=list)
    refused: list[Look] = field(default_factory=list)
    unfinished: str = ""

    @property
    def adequate(self) -> bool:
        return not self.findings


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
    handled, mask = motion.handled(record.axes, record.rate_hz)
    quiet = {name: integrity.masked(state, mask) if handled else state for name, state in record.axes.items()}
    states = dict(zip(quiet, work.each(lambda state: state.refit(), quiet.values()), strict=True))
    shown = [name for name in handled if name in axes]
    spoilt = dict(zip(shown, work.each(lambda name: record.axes[name].refit(), shown), strict=True))
    # An axis below its stated lattice is judged by nobody, and explains nobody.
    left_out = {name for name, state in states.items() if state.below_lattice and (state.redrawn or _stated(state))}
    states = {name: state for name, state in states.items() if name not in left_out}
    record = replace(record, axes=states)
    works = {name: work.of_axis(state.y.size) for name, state in states.items()}
    for name in axes:
        if name not in left_out:
            found[name] = Diagnosed(spoilt.get(name, states[name]), states[name], record, unfinished=INTERRUPTED)
    record = _integrity(record, found, handled, advance, works)

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
    changed = _directions(record, found)
    for one in found.values():
        _harmonics(one)
    _share(found)
    work.each(lambda name: _end(found[name], advance), changed)
    if any(one.unfinished == INTERRUPTED for one in found.values()):
        raise Stopped
    return found


def _stated(state: State) -> bool:
    """Whether the model file states the lattice."""
    return state.stated_lsb > 0.0 and abs(state.lsb / state.stated_lsb - 1.0) < 0.02


def _end(one: Diagnosed, advance: Callable[[str], None]) -> None:
    """What is left over, and the statistics of the model that the loop began with."""
    advance(f"{one.state.axis}: statistics")
    one.findings = [finding for finding in one.findings if finding.round <= ROUNDS]
    _unexplained(one)
    one.before = judged(one.first, seed=1) if one.findings and not one.first.below_lattice else one.after


def _provisional(
    state: State,
    record: Record,
    advance: Callable[[str], None],
    causes: tuple[Callable[[State, Record], list[Look]], ...] = STATIONARY,
) -> State:
    """The state with the lines, the colour and the changes of noise beyond doubt: motion stands out of those."""
    one = Diagnosed(state, state, record)
    with suppress(work.Spent):
        _rounds(record, one, advance, causes, CERTAIN)
    return one.state


def _wild(state: State, record: Record) -> float:
    """Share of the samples that are outliers beyond doubt: they make an axis loud by itself."""
    looks = noise.mixed(state, record)
    return float(looks[0].estimate["fraction"]["median"]) if looks and looks[0].net >= CERTAIN else 0.0


def _integrity(
    record: Record,
    found: Mapping[str, Diagnosed],
    handled: Mapping[str, Moved],
    advance: Callable[[str], None],
    works: Mapping[str, work.Work],
) -> Record:
    """What needs no model beyond the first. `handled`: motion that is left out of the record already."""
    gone, held = integrity.missing(record)
    if held.any():
        masked = {name: integrity.masked(state, held).refit() for name, state in record.axes.items()}
        record = replace(record, axes=masked)
    states = dict(record.axes)

    def quieted(name: str) -> State:
        with work.within(works[name]):
            return _provisional(states[name], record, advance)

    quiet = dict(zip(states, work.each(quieted, states), strict=True))
    wild = {name: _wild(state, record) for name, state in quiet.items()}
    moved, mask = integrity.motion(replace(record, axes=quiet), wild)
    if moved:
        # A jump of several axes is loud on them as well. Motion is loud beside the jump that fits it best.
        quiet |= {name: _provisional(quiet[name], record, advance, (step.looks,)) for name in moved}
        moved, mask = integrity.motion(replace(record, axes=quiet), wild)
    for name in states if moved else ():
        states[name] = integrity.masked(states[name], mask).refit()
    changed = integrity.rate_change(record)
    for name, one in found.items():
        if changed is not None:
            others = tuple(other for other in found if other != name)
            one.findings.append(Finding(changed, 0, one.state, one.state, shared_with=others))
        for found_at in (integrity.held_samples(record, name), integrity.stuck(record, name)):
            if found_at is not None:
                one.findings.append(Finding(found_at, 0, one.state, one.state))
        parts = [each[name] for each in (handled, moved) if name in each]
        look = motion.look_of(parts, record.rate_hz) if parts else None
        if look is not None and (name in handled or not _harms(look, one.state, states[name], record)):
            shared = tuple(other for other in {**handled, **moved} if other != name)
            one.findings.append(Finding(look, 0, one.first, states[name], shared_with=shared))
        if name in gone:
            one.findings.append(Finding(gone[name], 0, one.state, states[name]))
    for name in states:
        clipped = None if states[name].below_lattice else integrity.saturation(replace(record, axes=states), name)
        if clipped is not None:
            if name in found:
                found[name].findings.append(Finding(clipped[0], 0, states[name], clipped[1]))
            states[name] = clipped[1]
        lattice = integrity.quantization(states[name])
        if lattice is not None:
            before = states[name]
            states[name] = replace(before, stated_lsb=before.lsb)
            if name in found:
                found[name].findings.append(Finding(lattice, 0, before, states[name]))
        if name in found:
            found[name].state = states[name]
    return replace(record, axes=states)


def _harms(look: Look, before: State, after: State, record: Record) -> bool:
    """Whether the rest of the record is predicted clearly worse without the samples that a finding leaves out."""
    held_out, _ = score.gain(look, before, after, record)
    if held_out is None:
        return False
    found = held_out["log_score_per_sample"]
    return bool(found["after"] - found["before"] < -HARM_SD * found["sd"])


def _rounds(
    record: Record,
    one: Diagnosed,
    advance: Callable[[str], None],
    causes: tuple[Callable[[State, Record], list[Look]], ...] = LOOKS,
    least: float = NET_LEAST,
) -> None:
    first = 1 + max((finding.round for finding in one.findings), default=0)
    idle: set[Callable[[State, Record], list[Look]]] = set()
    for number in range(first, ROUNDS + 1):
        if one.state.below_lattice:
            return
        advance(f"{one.state.axis}: round {number}")
        waiting = [cause for cause in causes if cause in idle]
        looks, idle = _looked(one, record, [cause for cause in causes if cause not in idle], least)
        if waiting and (not looks or looks[0].net < least):
            more, unworthy = _looked(one, record, waiting, least)
            looks, idle = sorted([*looks, *more], key=lambda look: -look.net), idle | unworthy
        else:
            idle |= set(waiting)
        one.refused = looks
        if not looks or looks[0].net < least:
            return
        if len(one.findings) < BUSY:
            idle = set()
        best = looks[0]
        rivals = tuple(
            dict.fromkeys(look.cause for look in looks[1:] if look.net > best.net - ALIKE and look.cause != best.cause)
        )
        before, one.state = one.state, one.state.refit(**best.changes)
        one.findings.append(Finding(best, number, before, one.state, also_possible=rivals))


def _looked(
    one: Diagnosed,
    record: Record,
    causes: Sequence[Callable[[State, Record], list[Look]]],
    least: float,
) -> tuple[list[Look], set[Callable[[State, Record], list[Look]]]]:
    """The looks of `causes`, the most worth first, and the causes of which none is worth `least`."""
    named = Counter(finding.look.cause for finding in one.findings)
    found: list[Look] = []
    idle: set[Callable[[State, Record], list[Look]]] = set()
    for cause in causes:
        looks = [look for look in cause(one.state, record) if named[look.cause] < MOST.get(look.cause, ROUNDS)]
        found += looks
        if all(look.net < least for look in looks):
            idle.add(cause)
    return sorted(found, key=lambda look: -look.net), idle


def _harmonics(one: Diagnosed) -> None:
    """Lines at multiples of a stronger one's frequency are one finding with it: their gains are added."""
    lines = sorted((f for f in one.findings if f.look.cause == "periodic"), key=lambda f: -f.look.gain)
    for base in lines:
        if base not in one.findings:
            continue
        f = base.look.estimate["frequency_hz"]
        harmonics: list[int] = []
        gain, worth = base.look.gain, base.look.net
        for other in lines:
            g = other.look.estimate["frequency_hz"]
            k = round(g["median"] / f["median"])
            if other is base or other not in one.findings or k < 2:
                continue
            apart = k * _breadth(base.look) + _breadth(other.look)
            if apart < HARMONIC_MOST * f["median"] and abs(g["median"] - k * f["median"]) < apart:
                harmonics.append(k)
                gain, worth = gain + other.look.gain, worth + other.look.net
                one.findings.remove(other)
        if harmonics:
            estimate = {**base.look.estimate, "harmonics": sorted(harmonics)}
            one.findings[one.findings.index(base)] = replace(
                base, look=replace(base.look, gain=gain, net=worth, estimate=estimate)
            )


def _breadth(line: Look) -> float:
    """How far off the frequency may be, Hz: half the width of a band, three standard deviations of a line."""
    if "width_hz" in line.estimate:
        return float(line.estimate["width_hz"]["median"])
    return 3.0 * float(line.estimate["frequency_hz"]["sd"])


def _directions(record: Record, found: Mapping[str, Diagnosed]) -> list[str]:
    """Two axes that each blame the other: the reading that follows is the one that gains more by it.

    White noise correlates both ways alike, and only the drifts tell the two apart. Where they do not, the weaker
    coupling is kept: a mechanical one is below 1. Returns the axes that are blamed less."""
    changed: list[str] = []
    pairs = {
        (name, str(finding.look.estimate["other"])): finding
        for name, one in found.items()
        for finding in one.findings
        if finding.look.cause == "cross_axis"
    }
    for (name, other), finding in pairs.items():
        back = pairs.get((other, name))
        if back is None:
            continue
        ahead = back.look.gain - finding.look.gain
        if abs(ahead) < ALIKE:
            sizes = [abs(float(one.look.estimate["coefficient"]["median"])) for one in (finding, back)]
            ahead = sizes[0] - sizes[1]
        if ahead > 0.0:
            one = found[name]
            one.findings.remove(finding)
            kept = tuple(column for column in one.state.regressors if column.name != f"axis_{other}")
            one.state = one.state.refit(regressors=kept)
            changed.append(name)
    return changed


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
    if a.cause != b.cause:
        return False
    if a.cause == "step":
        return a.when is not None and b.when is not None and abs(a.when[0] - b.when[0]) < 30.0
    if a.cause == "periodic":
        f, g = a.estimate["frequency_hz"]["median"], b.estimate["frequency_hz"]["median"]
        return bool(abs(f / g - 1.0) < 0.01)
    if a.cause == "stuck":
        return bool(a.estimate["intervals"][0][0] == b.estimate["intervals"][0][0])
    return a.cause in ("temperature", "supply", "motion", "missing_samples", "held_samples")


def _unexplained(one: Diagnosed) -> None:
    if one.state.below_lattice:
        return
    one.after = judged(one.state, seed=1)
    p = combined(one.after)
    if P_CERTAIN < p < P_UNEXPLAINED:
        one.after = judged(one.state, seed=2, count=AGAIN)
        p = combined(one.after)
    if p < P_UNEXPLAINED:
        worst = one.after[0]
        nats = min(1e6, -math.log(max(p, 1e-300)))
        look = Look(
            "unexplained", nats, nats, {"statistic": worst.name, "measured": worst.measured}, {}, shown_by=worst.name
        )
        one.findings.append(Finding(look, ROUNDS + 1, one.state, one.state))
