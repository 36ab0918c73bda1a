"""The sensor turns: accelerometers step as the direction of gravity does, while the gyroscopes turn with them.

A small turn theta of the sensor changes the specific force f by f x theta. Two angles are seen, those across f.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.diagnosis.cause import Cause, Channels, Grouping, Key, Scored, Simulated, Written, shown
from selfcal.diagnosis.causes import step
from selfcal.diagnosis.finding import Diagnosed
from selfcal.diagnosis.record import Record
from selfcal.likelihood.state import NET_LEAST, Look, State, normal_entry

#: Share by which the specific force at rest may differ from standard gravity.
GRAVITY_SHARE_MOST = 0.1
#: Share of the step's information that two angles explain, at least.
EXPLAINED_LEAST = 0.9
#: Time about the event over which the gyroscopes' rates are summed up, s, and standard deviations beyond which their
#: angle shows the sense of the turn.
ABOUT_S, SENSE_SDS = 3.0, 3.0


def settle(record: Record, found: Mapping[str, Diagnosed]) -> None:
    """Name the steps of an event a turn of the sensor, where their sizes fit a turn, all other findings in the model. A
    step of a single accelerometer may be a turn about an axis: gravity moves on the others by its square alone."""
    states = {**record.axes, **{name: axis.state for name, axis in found.items()}}
    events: dict[int | str, dict[str, int]] = {}
    for name, axis in found.items():
        for k, finding in enumerate(axis.findings):
            if finding.look.cause == step.CAUSE.id and finding.record is None:
                events.setdefault(finding.event or f"{name} {k}", {})[name] = k
    for event in events.values():
        looks = {name: found[name].findings[k].look for name, k in event.items()}
        seen = _turn_of(looks, states)
        if seen is None:
            continue
        angles, sure = seen
        others = () if sure else (step.CAUSE.id,)
        for name, look in looks.items():
            own: dict[str, Any] = {"others": (CAUSE.id,)}
            if len(event) > 1:
                own = {"cause": CAUSE.id, "estimate": {**look.estimate, **angles}, "others": (*look.others, *others)}
            k = event[name]
            found[name].findings[k] = replace(found[name].findings[k], look=replace(look, **own))


def _turn_of(looks: Mapping[str, Look], states: Mapping[str, State]) -> tuple[dict[str, Any], bool] | None:
    """The angles of the turn that explains the steps of an event, and whether the gyroscopes show it; None: no turn."""
    force = _specific_force(states)
    if force is None or not looks.keys() <= force.keys():
        return None
    axes = list(force)
    f = np.array([force[name][0] for name in axes])
    size, information = np.zeros(3), np.zeros(3)
    for k, name in enumerate(axes):
        if name in looks:
            amplitude, scale = looks[name].estimate["amplitude"], force[name][1]
            size[k], information[k] = amplitude["median"] * scale, (amplitude["sd"] * scale) ** -2.0
    # A turn keeps the length of f. A step along f beyond that is no turn.
    across = size - f * float(f @ size + 0.5 * size @ size) / float(f @ f)
    along = (size - across) ** 2
    if float(information @ along) > (1.0 - EXPLAINED_LEAST) * float(information @ size**2):
        return None
    if float(information.max() * along[information == 0.0].sum()) > 2.0 * NET_LEAST:  # another axis would show it
        return None
    turn = -np.cross(f, size) / float(f @ f)
    time_s = next(iter(looks.values())).estimate["time_s"]["median"]
    turned = _turned(states, [f"g{name[-1]}" for name in axes], time_s)
    sure = turned is not None and bool(np.abs(turned[0] / turned[1]).max() > SENSE_SDS)
    if turned is not None and sure and float(turned[0] @ turn) < 0.0:
        return None
    weight = np.where(information > 0.0, 1.0 / np.maximum(information, 1e-300), 0.0)
    angles = {}
    for k in np.argsort(np.abs(f))[:2]:
        row = -np.cross(f, np.eye(3))[:, k] / float(f @ f)
        sd = math.sqrt(float(row**2 @ weight))
        angles[f"angle_{axes[k][-1]}_deg"] = normal_entry(math.degrees(turn[k]), math.degrees(sd), "deg")
    return angles, sure


def _specific_force(states: Mapping[str, State]) -> dict[str, tuple[float, float]] | None:
    """Level of each accelerometer and the factor of its unit, m/s^2; None: not three that feel gravity alone."""
    found = {}
    for name, state in sorted(states.items()):
        try:
            factor = units.factor(state.unit, "m/s^2")
        except UserError:
            continue
        found[name] = ((state.level + float(state.best.c[0])) * factor, factor)
    size = math.sqrt(sum(level**2 for level, _ in found.values()))
    return found if len(found) == 3 and abs(size / units.STANDARD_GRAVITY - 1.0) < GRAVITY_SHARE_MOST else None


def _turned(states: Mapping[str, State], names: list[str], time_s: float) -> tuple[Array, Array] | None:
    """Angles [3], rad, by which the gyroscopes turn about a time, with their standard deviations; None: unknown."""
    angle, sd = np.zeros(3), np.zeros(3)
    for k, name in enumerate(names):
        state = states.get(name)
        if state is None:
            return None
        try:
            factor = units.factor(state.unit, "rad/s")
        except UserError:
            return None
        at, reach = round(time_s / state.dt), max(1, round(ABOUT_S / state.dt))
        during, beside = state.y[max(0, at - reach) : at + reach], state.y[max(0, at - 10 * reach) : at + 10 * reach]
        if not np.isfinite(during).all() or np.isfinite(beside).sum() < 4 * reach:
            return None
        angle[k] = float(np.sum(during - np.nanmedian(beside))) * state.dt * factor
        sd[k] = state.best.sigma * math.sqrt(during.size) * state.dt * factor
    return angle, sd


def _add(keys: Mapping[str, Any], channels: Channels) -> Array:
    return np.where(channels.time_s >= keys["time_s"], keys["amplitude"], 0.0)


CAUSE = Cause(
    "tilt",
    "The sensor turns once: gravity has another direction in it.",
    "Fasten the mount, and record again without touching it.",
    source="handling",
    at=step.at,
    of_means=True,
    pictures=shown("means", "evidence"),
    grouping=Grouping(alike=step.alike),
    score=Scored(once="a turn is an event of its recording"),
    written=Written(entry=step.entry, of_column=step.of_column),
    simulated=Simulated(
        keys={"time_s": Key(lambda s: s.duration_s / 2.0), "amplitude": Key(lambda s: 2.0 * s.n)}, add=_add
    ),
)
