"""The firmware's application (port/app) in this process, over a recording. No compiler is needed: its sources are in
the package's build, and the model's tables are handed over at run time."""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Any

from selfcal import _firmware
from selfcal.bank.library import arguments
from selfcal.model.file import Model
from selfcal.model.tables import Tables, gate_table

if TYPE_CHECKING:
    import can

#: Rows between two reads of the frames.
ROWS = 4096


class Played:
    """A module that plays the rows of a file (verbs/replay.py), and the frames that it sends: `recv` as of a Link."""

    malformed = 0

    def __init__(self, model: Model, tables: Tables, rows: Path, period_ms: int, gate: bool) -> None:
        table = gate_table(model, tables)
        self._module: Any = _firmware.Module(
            *arguments(tables),
            _columns(tables),
            None if table is None else astuple(table),
            [axis.name for axis in tables.axes],
            tables.rate_hz,
            len(tables.channels),
            str(rows),
            period_ms,
            gate,
        )
        self._frames: deque[tuple[int, bytes]] = deque()

    @property
    def closed(self) -> bool:
        """The recording has ended, and every frame was given."""
        return bool(self._module.ended) and not self._frames

    def recv(self, timeout: float) -> can.Message | None:
        """The next frame; None once closed, or if ROWS rows gave no frame."""
        import can

        if not self._frames and not self._module.ended:
            self._frames.extend(struct.iter_unpack("<I8s", self._module.play(ROWS)))
        if not self._frames:
            return None
        identifier, data = self._frames.popleft()
        return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def _columns(tables: Tables) -> tuple[list[tuple[int, int, float, float]], list[float]] | None:
    """Sources of the regressors' columns, and [axes * columns] ln prior odds; None without regressors."""
    if not tables.regressors:
        return None
    odds = [column.ln_odds[axis] for axis in range(len(tables.axes)) for column in tables.regressors]
    return [tables.source_of(column) for column in tables.regressors], odds
