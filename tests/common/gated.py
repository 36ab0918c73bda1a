"""The library on the host behind the model's stationary gate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from selfcal.bank.library import Bank
from selfcal.model.file import Model
from selfcal.model.tables import Tables, gate_table, make_tables
from selfcal.readings.gate import Learning


def learning_gate(model: Model, tables: Tables) -> Learning:
    """As the model file configures it."""
    table = gate_table(model, tables)
    assert table is not None
    return Learning(table)


class Gated:
    """The library on the host behind the model's gate, by the rule at selfcal_push_moving(), as the application is."""

    def __init__(self, model: Model, rate_hz: float, axes: tuple[str, ...], target: str = "host") -> None:
        tables = make_tables(model, rate_hz, axes, target)
        self.learning = learning_gate(model, tables)
        self.gate = self.learning.gate
        self.bank = Bank(tables, build="_library32" if target == "host" else "_coarse")
        self.resting = False
        self.used: list[bool] = []

    def feed(self, missing: int, sample: NDArray[np.float32]) -> None:
        """One sample [axes], and how many are missing before it."""
        if missing:
            self.resting = bool(self.gate.skip(missing))
            if not self.resting:
                self.bank.raw.moving()
            self.bank.raw.skip(missing)
        in_step = self.gate.last()["position"] == 0 or self.bank.raw.counters()["samples"] > 0
        now = bool(self.learning.push(sample[None, :])[0])
        self.used.append(self.resting and now and in_step)
        if self.used[-1]:
            self.bank.push(sample[None, :])
        else:
            self.bank.raw.push_moving(sample[None, :])
        self.resting = now
