"""Axes of any name and unit on the wire of the host's module: each takes the message of an axis that it does not have.

Telemetry has messages for six axes in fixed units. A number in it has no unit of its own, so any axis fits. Axes of a
group take messages of the same unit, the accelerometer's first: the gate watches a gyro in its own way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from selfcal.base.errors import UserError
from selfcal.base.units import SENSOR_UNITS
from selfcal.logs.recording import Recording
from selfcal.model.file import Group, Model


def places(model: Model, axes: Sequence[str]) -> dict[str, str]:
    """Message of each axis, by the axis it is named after; a standard axis has its own. Raises UserError for a standard
    axis in another unit, and without room."""
    for name in axes:
        unit = model.group_of(name).unit
        if name in SENSOR_UNITS and SENSOR_UNITS[name] != unit:
            raise UserError(
                f"{model.path}: axis {name} is in {unit}; telemetry carries it in {SENSOR_UNITS[name]}, so the model "
                "must be in that unit"
            )
    names = {name: name for name in axes if name in SENSOR_UNITS}
    for group in model.groups:
        foreign = [name for name in group.axes if name in axes and name not in SENSOR_UNITS]
        free = [name for name in SENSOR_UNITS if name not in names.values()]
        rooms = [[name for name in free if SENSOR_UNITS[name] == unit] for unit in ("m/s^2", "deg/s")]
        room = next((room for room in rooms if len(room) >= len(foreign)), None)
        if room is None:
            raise UserError(
                f"telemetry has no room for {', '.join(foreign)}: it carries six axes, three of one unit; choose fewer "
                "with --axis"
            )
        names |= zip(foreign, room, strict=False)
    return {name: names[name] for name in axes}


def sent(model: Model, recording: Recording, taken: Mapping[str, str]) -> tuple[Model, Recording]:
    """The model and the recording with each axis under the name and unit of its message."""
    groups = []
    for group in model.groups:
        names = [name for name in group.axes if name in taken]
        if names:
            groups.append(_renamed(group, {name: taken[name] for name in names}))
    columns = dict(recording.columns)
    for name, sent_as in taken.items():
        values = recording.in_unit(name, model.group_of(name).unit)
        columns[sent_as] = replace(recording.columns[name], name=sent_as, unit=SENSOR_UNITS[sent_as], values=values)
    regressors = tuple(
        replace(regressor, column=taken.get(regressor.column, regressor.column)) for regressor in model.regressors
    )
    return replace(model, groups=tuple(groups), regressors=regressors), replace(recording, columns=columns)


def _renamed(group: Group, taken: Mapping[str, str]) -> Group:
    own = {taken[name]: priors for name, priors in group.own_priors.items() if name in taken}
    return replace(group, axes=tuple(taken.values()), unit=SENSOR_UNITS[next(iter(taken.values()))], own_priors=own)
