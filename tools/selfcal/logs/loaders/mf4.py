"""ASAM MDF by asammdf: a table a channel group, on the group's own master channel. Units are the channels'.

A sample that the file calls invalid is missing.
A conversion by a formula is code to asammdf, and never run: its channel is left out with a note.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.base.errors import UserError, short
from selfcal.base.limits import MOST_COLUMNS
from selfcal.logs.loaders.table import Hints, Table, heading, left_out, of_arrays


def read(path: Path, _: Hints) -> list[Table]:
    """The tables of a file. Raises UserError and what asammdf raises."""
    from asammdf import MDF

    tables: list[Table] = []
    without: list[str] = []
    with MDF(path) as file:
        groups: list[Any] = file.groups
        for number, group in enumerate(groups):
            columns: dict[str, Any] = {}
            formulas = {k: text for k, channel in enumerate(group.channels) if (text := _formula(channel.conversion))}
            why = f"a formula, '{short(next(iter(formulas.values()), ''))}', which is not run"
            notes = left_out([group.channels[index].name for index in formulas], why)
            without += notes
            for channel in group.channels:
                if hasattr(channel, "attachment"):
                    channel.attachment = None  # which may be another file
            clock = file.masters_db.get(number)
            if clock in formulas:
                continue
            for index in formulas:
                group.channels[index].conversion = None
            for index in range(len(group.channels[:MOST_COLUMNS])):
                if index == clock or index in formulas:
                    continue
                signal = file.get(group=number, index=index, ignore_invalidation_bits=True)  # they would be dropped
                samples, invalid = signal.samples, signal.invalidation_bits
                if samples.dtype.kind in "iuf" and samples.ndim == 1:
                    if invalid is not None and invalid.any():
                        samples = np.where(invalid, np.nan, samples)
                    columns[heading(signal.name, signal.unit)] = samples
                    columns["t[s]"] = signal.timestamps
            name = getattr(group.channel_group, "acq_name", "") or f"group {number}"
            if columns:
                tables.append(of_arrays(f"{name}", columns, notes=notes))
    if without and not tables:
        raise UserError(f"{path}: {without[0]}")
    names = [table.source for table in tables]
    if len(set(names)) < len(names):
        tables = [replace(table, source=f"{table.source} {k}") for k, table in enumerate(tables)]
    return tables


def _formula(conversion: Any) -> str:
    """The formula of a conversion, or of a conversion within it; else empty."""
    from asammdf.blocks import v2_v3_constants, v4_blocks, v4_constants

    if conversion is None:
        return ""
    new = isinstance(conversion, v4_blocks.ChannelConversion)
    kind = v4_constants.CONVERSION_TYPE_ALG if new else v2_v3_constants.CONVERSION_TYPE_FORMULA
    if conversion.conversion_type == kind:
        return str(conversion.formula) or "''"
    inner = (_formula(block) for block in conversion.referenced_blocks.values() if not isinstance(block, bytes | str))
    return next(filter(None, inner), "")
