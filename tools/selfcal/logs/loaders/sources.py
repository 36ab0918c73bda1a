"""Several sensors in a log: which of them is meant.

Sensors without a common axis make an IMU. Of sensors with a common axis, a sensor counts that reads five times oftener
than each of the others: loggers thin out the rest. Otherwise the user chooses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from selfcal.base.errors import MOST_NAMED, UserError, few, printable, short


@dataclass(frozen=True)
class Share:
    """A table's share in a source.

    `axes`: empty for a table of temperatures. `warm`: a temperature can be had alone. `span` finds the number of
    readings, and their seconds. `read` reads it as `recording.py` has it: with others or alone, the temperature only or
    all.
    """

    source: str
    axes: frozenset[str]
    warm: bool
    span: Callable[[], tuple[int, float]]
    read: Callable[[bool, bool], Any]

    @property
    def rate_hz(self) -> float:
        """Mean rate, 0 for fewer than two readings."""
        count, seconds = self.span()
        return (count - 1) / seconds if count > 1 and seconds > 0.0 else 0.0


def chosen(path: object, parts: Sequence[Share], wanted: Sequence[str]) -> tuple[list[Share], list[Share], list[str]]:
    """The parts to read, those of them of which the temperature alone is read, and notes of the others. `wanted`: names
    that the user gives. Raises UserError, which lists the sources, where the user has to choose."""
    sources: dict[str, list[Share]] = {}
    for part in parts:
        sources.setdefault(part.source, []).append(part)
    axes = {source: frozenset().union(*(part.axes for part in of)) for source, of in sources.items()}
    sensors = [source for source in sources if axes[source]]
    for name in wanted:
        if name not in sources:
            raise UserError(f"{path}: there is no source '{short(name)}'; {_listed(sources, axes, list(sources))}")
    if wanted and not any(axes[name] for name in wanted):
        raise UserError(f"{path}: no axis is in '{short(wanted[0])}'; {_listed(sources, axes, list(sources))}")
    kept, dropped = (list(wanted), []) if wanted else _by_rate(path, sources, axes, sensors)
    repeated = [a for k, name in enumerate(kept) for a in axes[name] for other in kept[:k] if a in axes[other]]
    if repeated:
        raise UserError(f"{path}: axis '{repeated[0]}' is in more than one of the sources: give one --source")
    chosen_parts = [part for source in kept for part in sources[source]]
    notes = []
    if dropped:
        notes.append(
            f"{', '.join(kept)} is read; left out, for their lower rates: {', '.join(map(printable, dropped))}"
        )
    warm = [part for source in dropped for part in sources[source] if part.warm]
    of_dropped = (
        warm[:1] if len({part.source for part in warm}) == 1 and not any(part.warm for part in chosen_parts) else []
    )
    chosen_parts += of_dropped
    sides = [source for source in sources if not axes[source] and source not in kept]
    if sides and not wanted:
        near = _nearest(kept, sides)
        chosen_parts += [part for source in near for part in sources[source]]
        if len(near) < len(sides):
            notes.append(f"left out, add it by --source: {', '.join(side for side in sides if side not in near)}")
    return chosen_parts, of_dropped, notes


def _by_rate(
    path: object, sources: dict[str, list[Share]], axes: dict[str, frozenset[str]], sensors: Sequence[str]
) -> tuple[list[str], list[str]]:
    """The sources to read, and those left out for their lower rates. Raises UserError."""
    if all(not axes[sensor] & axes[other] for k, sensor in enumerate(sensors) for other in sensors[:k]):
        return list(sensors), []
    rate = {source: max(part.rate_hz for part in sources[source] if part.axes) for source in sensors}
    kept: list[str] = []
    dropped: list[str] = []
    for source in sorted(sensors, key=lambda sensor: -rate[sensor]):
        others = [other for other in kept if axes[other] & axes[source]]
        if not others:
            kept.append(source)
        elif all(rate[other] >= 5.0 * rate[source] for other in others):
            dropped.append(source)
        else:
            raise UserError(f"{path}: several sensors: {_listed(sources, axes, sensors)}")
    return kept, dropped


def _nearest(kept: Sequence[str], sides: Sequence[str]) -> list[str]:
    """The temperatures of the sensors: the only name, else the name with the longest beginning in common."""
    if len(sides) == 1:
        return list(sides)

    def common(side: str) -> int:
        return max(next((k for k, (a, b) in enumerate(zip(side, of, strict=False)) if a != b), 0) for of in kept)

    best = sorted(sides, key=common, reverse=True)
    return best[:1] if common(best[0]) > max(1, common(best[1])) else []


def _listed(sources: dict[str, list[Share]], axes: dict[str, frozenset[str]], names: Sequence[str]) -> str:
    """The option to type for each source, with its axes, rate and length."""
    lines = []
    for name in names:
        part = max(sources[name], key=lambda own: (bool(own.axes), own.rate_hz))
        of = " ".join(sorted(axes[name], key=lambda axis: (axis[0] != "g", axis))) or "no axis"
        lines.append(f"--source '{printable(name)}' ({of}; {part.rate_hz:.4g} Hz, {part.span()[1]:.4g} s)")
    return f"give {few(lines, MOST_NAMED)}"
