"""Logs of CAN frames by framelog.py, decoded by cantools with the database of `--dbc`: a table a message.

Signals are columns by their names and units. Stamps are the adapter's. A multiplexed message gives a table for each
set of signals.
"""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.base.errors import UserError
from selfcal.logs.framelog import FrameLog
from selfcal.logs.loaders.table import Hints, Table, heading, of_arrays


def read(path: Path, hints: Hints) -> list[Table]:
    """The tables of a log. Raises UserError and what the libraries raise."""
    if "dbc" not in hints:
        raise UserError(f"{path}: is a log of CAN frames: name the database of its signals with --dbc FILE.dbc")
    if not Path(hints["dbc"]).is_file():
        raise UserError(f"{hints['dbc']}: there is no such file, or it is a pipe or a device")
    import cantools

    database = cantools.database.load_file(hints["dbc"], strict=False)
    if not isinstance(database, cantools.database.can.Database):
        raise UserError(f"{hints['dbc']}: not a database of CAN messages")
    messages = {known.frame_id: known for known in database.messages}
    values: dict[tuple[int, tuple[str, ...]], Any] = {}
    undecoded: set[str] = set()
    with FrameLog(path) as log:
        while (frame := log.recv(0.0)) is not None:
            message = messages.get(frame.arbitration_id)
            if message is None or frame.is_remote_frame or frame.is_error_frame:
                continue
            try:
                decoded = message.decode(bytes(frame.data), decode_choices=False, scaling=True)
            except cantools.database.DecodeError:  # too short, or of no value that the database has
                undecoded.add(message.name)
                continue
            if isinstance(decoded, dict) and all(isinstance(value, int | float) for value in decoded.values()):
                signals = frame.arbitration_id, tuple(decoded)  # those that a multiplexer chose
                values.setdefault(signals, array("d")).extend((frame.timestamp, *decoded.values()))
    if not values:
        raise UserError(f"{path}: no frame in it is a message of {hints['dbc']}")
    short = f"left out: frames of {', '.join(sorted(undecoded))}, which are shorter than the database states"
    notes = (short,) if undecoded else ()
    tables = []
    for (number, names), rows_of in values.items():
        message, rows = messages[number], np.array(rows_of).reshape(-1, 1 + len(names))
        unit = {signal.name: signal.unit for signal in message.signals}
        columns = {heading(name, unit[name]): rows[:, k] for k, name in enumerate(names, 1)}
        alone = sum(other == number for other, _ in values) == 1
        source = message.name if alone else f"{message.name}/{_chosen(message, names)}"
        tables.append(of_arrays(source, {"t[s]": rows[:, 0], **columns}, notes=notes, damaged=log.damaged))
    return tables


def _chosen(message: Any, names: tuple[str, ...]) -> str:
    """The signals of a multiplexed message that are not in all of its frames."""
    return " ".join(signal.name for signal in message.signals if signal.name in names and signal.multiplexer_ids)
