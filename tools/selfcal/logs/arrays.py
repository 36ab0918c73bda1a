"""Readings that are in memory: an array, a mapping of arrays, or a data frame becomes a table, as a file does."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.base.errors import UserError, short
from selfcal.base.units import SENSORS
from selfcal.logs.loaders.headings import split
from selfcal.logs.loaders.table import Table, of_arrays
from selfcal.logs.loaders.text_table import LOOKED_AT, in_turn
from selfcal.logs.recorded import SIDE_UNITS

#: Axes of an array by the shape of its rows.
_COLUMNS = {(count,): SENSORS[:count] for count in (1, 3, 6)}
#: Names of the three axes of a sensor.
_THREE = {"gyro": SENSORS[:3], "accel": SENSORS[3:]}
#: Whole numbers of the time stamps of a data frame are so long.
_STAMP = "datetime64[ns]"


def in_memory(data: object) -> bool:
    """Whether `data` is readings, and not the name of a file or a list of names."""
    if isinstance(data, Sequence):
        return len(data) > 0 and isinstance(data[0], Real | Sequence | np.ndarray) and not isinstance(data[0], str)
    return isinstance(data, Mapping) or hasattr(data, "__array__") or _is_frame(data)


def _is_frame(data: object) -> bool:
    return hasattr(data, "columns") and hasattr(data, "__getitem__")


def tables_of(
    data: Any, units: Mapping[str, str] | str, known: Collection[str], rate_hz: float | None, sensors: Collection[str]
) -> tuple[list[Table], dict[str, str]]:
    """The tables of readings in memory, a table for each sensor whose rows take turns, and the units that `units`
    states.

    `data`: an array or a list [n], [n, 3] or [n, 6] of gx, gy, gz, ax, ay, az; a mapping of arrays [n] by heading, with
    `gyro` and `accel` [n, 3]; a data frame or a series, whose index of dates is the time. `units`: of all axes, or by
    name, where `gyro` and `accel` are their axes. `known`: names that an option maps to a column. Raises UserError.
    """
    arrays: dict[str, NDArray[Any]] = {}
    for heading, array in _columns(data):
        if heading in arrays:
            raise UserError(f"arrays: column '{short(heading)}' appears twice")
        arrays[heading] = array
    plain = [heading for heading in arrays if split(heading) == (heading, None)]
    stated: dict[str, str] = {}
    for name, unit in ({"": units} if isinstance(units, str) else units).items():
        meant = sensors if name == "" else _THREE.get(name, ())
        stated |= dict.fromkeys([axis for axis in meant if axis in plain] or [name], unit)
    lacking = [heading for heading in plain if heading in sensors and heading not in {*stated, *known}]
    if lacking:
        raise UserError(
            f"arrays: no unit of {', '.join(lacking)}: give units={{'{lacking[0]}': 'deg/s'}}, or its own unit; or "
            f"name it '{lacking[0]}[deg/s]'"
        )
    if rate_hz is None and {split(heading)[0] for heading in arrays} <= {*sensors, *SIDE_UNITS} and "t" not in known:
        raise UserError("arrays: no time column: give rate_hz=100.0, or a column 't[s]'")
    words = {
        key: cells[:LOOKED_AT].astype(str).tolist() for key, cells in arrays.items() if cells.dtype.kind in "OUSiu"
    }
    turns = in_turn([*words], [*words.values()])
    rows = {f"{key}:{word}": arrays[key].astype(str) == word for key, word in turns} or {"": slice(None)}
    parts = [of_arrays(source, {name: cells[own] for name, cells in arrays.items()}) for source, own in rows.items()]
    return parts, stated


def _columns(data: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Headings and arrays [n]."""
    if hasattr(data, "to_frame") and not _is_frame(data):  # a series
        data = data.to_frame(SENSORS[0] if data.name is None else data.name)
    if not isinstance(data, Mapping) and not _is_frame(data):
        yield from _axes("", _numbers("an array", data))
        return
    index = np.asarray(getattr(data, "index", ()))
    names = [*data] if isinstance(data, Mapping) else list(data.columns)
    if not isinstance(data, Mapping) and (index.dtype.kind == "M" or type(data.index).__name__ == "DatetimeIndex"):
        yield "t[ns]", np.asarray(data.index, _STAMP).astype(np.int64)
    for name in names:
        values = data[name]
        array = _numbers(f"'{short(str(name))}'", values)
        if array.dtype.kind in "mM":  # dates, or times since a begin
            yield (
                ("t[ns]" if str(name) == "t" else f"{name}[ns]"),
                array.astype(array.dtype.kind + "8[ns]").view(np.int64),
            )
        elif array.ndim == 1:
            yield str(name), array
        else:
            yield from _axes(str(name), array)


def _numbers(what: str, values: Any) -> NDArray[Any]:
    """Values as an array, NaN where a mask hides them. Raises UserError."""
    if isinstance(values, np.ma.MaskedArray):
        return np.asarray(values.filled(np.nan))
    dated = getattr(getattr(values, "dtype", None), "kind", "") == "M"  # with a zone too
    try:
        return np.asarray(values, _STAMP if dated else None)
    except (ValueError, TypeError) as error:
        raise UserError(f"arrays: {what}: rows of different lengths, or no numbers") from error


def _axes(name: str, array: NDArray[Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """The columns of a matrix with a row for each sample."""
    own, unit = split(name) if name else ("", None)
    columns = array[:, None] if array.ndim == 1 else array
    axes = _THREE.get(own) if own else _COLUMNS.get(columns.shape[1:])
    if axes is None or columns.shape[1:] != (len(axes),):
        wanted = "takes 'gyro' or 'accel' of three columns" if name else "takes 1, 3 or 6 columns (gx gy gz ax ay az)"
        what = f"'{short(name)}'" if name else "an array"
        raise UserError(f"arrays: {what} of shape {array.shape}: {wanted}, a row a sample; name others one by one")
    for axis, column in zip(axes, columns.T, strict=True):
        yield (axis if unit is None else f"{axis}[{unit}]"), np.ascontiguousarray(column)
