"""What was looked for and not found: the size from which this record would have shown it."""

from __future__ import annotations

from typing import Any

from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.record import Record
from selfcal.likelihood.state import State


def not_found(state: State, record: Record, found: set[str]) -> list[dict[str, Any]]:
    """One entry for every cause that has a size: half of the records with it would have been named."""
    rows: list[dict[str, Any]] = []
    for cause in CAUSES.values():
        sizes = cause.least(state, record) if cause.least is not None and cause.id not in found else None
        if sizes:
            size = {key: {"value": value, "unit": unit} for key, (value, unit) in sizes.items()}
            rows.append({"cause": cause.id, "would_have_been_found": size})
    return rows
