"""The model's stationary gate over a recording on the host: which of its samples the firmware would take."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
from numpy.typing import NDArray

from selfcal import _library32
from selfcal.base.errors import UserError
from selfcal.base.grid import Mask, Rows
from selfcal.base.limits import FEWEST_ROWS
from selfcal.logs.recording import Recording, as_float, bridged
from selfcal.model.file import Model
from selfcal.model.tables import GateTable, gate_table, make_tables


def gate_of_recording(recording: Recording, model: Model, axes: tuple[str, ...]) -> GateTable:
    """The gate's configuration for the recording's rate. Raises UserError where the model has none for it."""
    table = gate_table(model, make_tables(model, recording.rate_hz, axes))
    if table is None:
        raise UserError(
            f"{model.path}: no gate for samples at {recording.rate_hz:g} Hz: it wants an entry `gate`, and two "
            f"samples or more a bank interval ({model.bank_rate_hz:g} Hz)"
        )
    return table


class Learning:
    """A gate that takes the noise it has measured, as the application has it do: after the least number of windows of
    rest that it can be measured on, and whenever there are twice as many."""

    def __init__(self, table: GateTable) -> None:
        self.window, self.axes = table.window, len(table.sigma)
        self.gate = _library32.Gate(*astuple(table))
        self.learn_at = _library32.GATE_MEASURED_MIN

    def push(self, samples: NDArray[np.float32]) -> Mask:
        """Samples [n, axes], not beyond the end of a window; whether each is at rest."""
        rest: Mask = np.frombuffer(self.gate.push(samples), np.uint8) == 1
        if self.gate.last()["measured"] == 0:
            self.learn_at = _library32.GATE_MEASURED_MIN
        if self.gate.last()["measured"] >= self.learn_at:
            self.learn_at *= 2
            for axis in range(self.axes):
                noise = self.gate.measured(axis)
                if all(value > 0.0 for value in noise):  # else a record without noise, as of a dead axis
                    self.gate.noise(axis, *noise)
        return rest


def gated(recording: Recording, model: Model) -> Recording:
    """The recording without the bank intervals in which the sensor moved, as the gate over its axes of one clock
    sees it.

    The rule is that of selfcal_push_moving(): a sample counts if the gate said resting before it and with it, bank
    intervals begin with a window of the gate, and an interval with motion in it is dropped whole. Time passes as a gap;
    `moving` counts those samples. Raises UserError if too little rest is left, or the model has no gate.
    """
    axes = tuple(name for name in model.axes if name in recording.columns and recording.columns[name].clock is None)
    tables = make_tables(model, recording.rate_hz, axes)
    table = gate_of_recording(recording, model, axes)
    samples = np.column_stack([as_float(bridged(recording.in_unit(name, model.group_of(name).unit))) for name in axes])
    samples = np.ascontiguousarray(samples, np.float32)
    used, ended = _resting(samples, recording.missing_before, table)
    if used.any():
        places = recording.clock.place
        places -= places[np.argmax(used)]
        interval = places // tables.block
        moved = np.concatenate([interval[~used], (places[ended] + 1) // tables.block])
        used &= ~np.isin(interval, np.unique(moved))
    if int(used.sum()) < FEWEST_ROWS:
        raise UserError(
            f"{recording.path}: --gate leaves no interval of rest: the sensor moves, or its noise is above N of `gate` "
            f"in {model.path.name}; choose a stretch with --start and --end"
        )
    return recording.with_rows(used, moving=True)


def _resting(samples: NDArray[np.float32], missing_before: Rows, table: GateTable) -> tuple[Mask, list[int]]:
    """Whether the bank takes each of samples [n, axes]; and rows behind which a gap ended the rest: the interval in
    progress there is dropped."""
    learning = Learning(table)
    gate, n = learning.gate, len(samples)
    used = np.zeros(n, bool)
    edges = np.append(np.flatnonzero(missing_before), n)
    ended: list[int] = []
    resting = in_step = False
    k = 0
    while k < n:
        if missing_before[k]:
            resting = bool(gate.skip(int(missing_before[k])))
            if not resting and k:
                ended.append(k - 1)
        position = int(gate.last()["position"])
        end = min(k + table.window - position, int(edges[np.searchsorted(edges, k, side="right")]))
        rest = learning.push(samples[k:end])
        taken = rest & np.append(resting, rest[:-1])
        in_step = in_step or (position == 0 and bool(taken[0]))
        used[k:end] = taken & in_step
        resting, k = bool(rest[-1]), end
    return used, ended
