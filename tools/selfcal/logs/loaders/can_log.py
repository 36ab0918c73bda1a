"""Logs of CAN frames by framelog.py, decoded by cantools with the database of `--dbc`: a table a message.

Signals are columns by their names and units. Stamps are the adapter's.
"""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.base.errors import UserError
from selfcal.logs.framelog import FrameLog
from selfcal.logs.loaders.table import Hints, Table, of_arrays


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
    messages = {one.frame_id: one for one in database.messages if not one.is_multiplexed()}
    stamps: dict[int, Any] = {}
    values: dict[int, Any] = {}
    with FrameLog(path) as log:
        while (frame := log.recv(0.0)) is not None:
            message = messages.get(frame.arbitration_id)
            if message is None or frame.is_remote_frame or frame.is_error_frame or len(frame.data) < message.length:
                continue
            decoded = message.decode(bytes(frame.data), decode_choices=False, scaling=True)
            assert isinstance(decoded, dict)
            row = [decoded[signal.name] for signal in message.signals]
            if all(isinstance(value, int | float) for value in row):
                stamps.setdefault(frame.arbitration_id, array("d")).append(frame.timestamp)
                values.setdefault(frame.arbitration_id, array("d")).extend(row)
    if not stamps:
        raise UserError(f"{path}: no frame in it is a message of {hints['dbc']}")
    tables = []
    for number, times in stamps.items():
        message = messages[number]
        rows = np.array(values[number]).reshape(len(times), -1)
        columns = {"t[s]": np.array(times)}
        for place, signal in enumerate(message.signals):
            columns[f"{signal.name}[{signal.unit}]" if signal.unit else signal.name] = rows[:, place]
        tables.append(of_arrays(message.name, columns, damaged=log.damaged))
    return tables
