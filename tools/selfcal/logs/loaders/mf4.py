"""ASAM MDF by asammdf: a table a channel group, on the group's own master channel. Units are the channels'."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from selfcal.base.limits import MOST_COLUMNS
from selfcal.logs.loaders.table import Hints, Table, of_arrays


def read(path: Path, _: Hints) -> list[Table]:
    """The tables of a file. Raises what asammdf raises."""
    from asammdf import MDF

    tables = []
    with MDF(path) as file:
        groups: list[Any] = file.groups
        for number, group in enumerate(groups):
            columns: dict[str, Any] = {}
            for index, channel in enumerate(group.channels[:MOST_COLUMNS]):
                if channel.channel_type in (2, 3):  # the group's clock
                    continue
                signal = file.get(group=number, index=index)
                if signal.samples.dtype.kind in "iuf" and signal.samples.ndim == 1:
                    columns[f"{signal.name}[{signal.unit}]" if signal.unit else signal.name] = signal.samples
                    columns["t[s]"] = signal.timestamps
            name = getattr(group.channel_group, "acq_name", "") or f"group {number}"
            if columns:
                tables.append(of_arrays(f"{name}", columns))
    names = [table.source for table in tables]
    if len(set(names)) < len(names):
        tables = [
            of_arrays(f"{one.source} {k}", {n: m.read() for n, m in one.members.items()})
            for k, one in enumerate(tables)
        ]
    return tables
