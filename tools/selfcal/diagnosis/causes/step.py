"""A step of the bias: the innovations' transient after a jump, at every time of the record."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from selfcal.diagnosis.cause import Cause, Grouping, Key, Scored, Simulated, Written, medians, shown
from selfcal.diagnosis.model_tree import digits
from selfcal.diagnosis.record import Record
from selfcal.likelihood import columns, edges
from selfcal.likelihood.edges import KEYS, scan
from selfcal.likelihood.state import SCREEN, FittedColumn, Look, State

#: Time between jumps of two axes, s, below which they are the same event.
ONE_EVENT_S = 30.0


def looks(state: State, record: Record) -> list[Look]:
    """The best place."""
    if state.y.size < 50:
        return []
    steps = scan(state.series, state.best)
    if steps.gain.max() < SCREEN + 2.0:
        return []
    places = steps.peaks(3, max(3, int(2.0 / state.dt)))
    return columns.looks(state, "step", [edges.shape(state, "step", (place,), steps) for place in places])


def at(state: State, record: Record, theta: Sequence[float]) -> Look:
    """The look at a step of a known time, or at a pulse of two."""
    cause = "step" if len(theta) == 1 else "pulse"
    places = tuple(min(max(1, round(time / state.dt)), state.y.size - 1) for time in theta)
    shape = edges.shape(state, cause, places, scan(state.series, state.best))
    return columns.located(state, cause, replace(shape, sharper=None))


def alike(a: Look, b: Look) -> bool:
    """Whether each edge of a look lies near the other look's."""
    return (
        a.when is not None
        and b.when is not None
        and all(abs(one - two) < ONE_EVENT_S for one, two in zip(a.when, b.when, strict=True))
    )


def at_jump(look: Look, axes: Collection[str], jumps: Sequence[float]) -> bool:
    """Whether each end of a look lies at a jump of the hidden quantity."""
    times = () if look.when is None else look.when
    return bool(times) and all(any(abs(time - jump) < ONE_EVENT_S for jump in jumps) for time in times)


def least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    """A step in the middle of the record."""
    places = (record.present.size // 2,)
    return columns.least(state, edges.shape(state, "step", places, scan(state.series, state.best)), "amplitude")


def entry(entry: Mapping[str, Any], look: Look | None, record: Record) -> dict[str, Any]:
    """The entry with times of the whole recording."""
    keys = [key for of in KEYS.values() for key in of if key in entry]
    times = [float(entry[key]) for key in keys]
    if look is not None:
        known = medians(look)
        times = [known["time_s"], known["time_s"] + known.get("duration_s", 0.0)][: len(keys)]
    times = [digits(time + record.start_s) for time in times]
    return {**entry, "name": edges.name(entry["kind"], times), **dict(zip(keys, times, strict=True))}


def of_column(column: FittedColumn, c: Sequence[float]) -> dict[str, Any]:
    """Keys of `simulate --effect`."""
    times = [float(column.entry[key]) for of in KEYS.values() for key in of if key in column.entry]
    duration = {"duration_s": times[1] - times[0]} if len(times) > 1 else {}
    return {"time_s": times[0], **duration, "amplitude": c[0]}


CAUSE = Cause(
    "step",
    "The bias jumps once.",
    "Record again without touching the mount or the cable.",
    source="handling",
    looks=looks,
    at=at,
    slow=True,
    of_means=True,
    pictures=shown("means", "evidence"),
    least=least,
    grouping=Grouping(alike=alike, piece=at_jump, most=3),
    score=Scored(once="a jump is an event of its recording"),
    written=Written(entry=entry, of_column=of_column),
    simulated=Simulated(
        keys={
            "time_s": Key(lambda s: s.duration_s / 2.0, "step_time_s"),
            "amplitude": Key(lambda s: 2.0 * s.n, "step_amplitude"),
        }
    ),
)
