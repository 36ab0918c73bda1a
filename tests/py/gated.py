"""The library on the host behind the model's stationary gate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from selfcal import _library32
from selfcal.engines.library import Bank
from selfcal.model import Model
from selfcal.tables import Tables, gate_table, make_tables


def make_gate(model: Model, tables: Tables) -> _library32.Gate:
    """As the model file configures it."""
    table = gate_table(model, tables)
    assert table is not None
    return _library32.Gate(
        table.window,
        table.false_alarm,
        table.hold,
        table.settle,
        table.memory,
        list(table.sigma),
        list(table.is_rate),
    )


class Learning:
    """A gate that takes the noise it has measured, as the application has it do: after the least number of windows of
    rest that it can be measured on, and whenever there are twice as many."""

    def __init__(self, model: Model, tables: Tables) -> None:
        table = gate_table(model, tables)
        assert table is not None
        self.window, self.axes = table.window, len(table.sigma)
        self.gate = make_gate(model, tables)
        self.learn_at = _library32.GATE_MEASURED_MIN

    def push(self, samples: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Samples [n, axes], not beyond the end of a window; whether each is at rest."""
        rest = np.frombuffer(self.gate.push(samples), np.uint8) == 1
        if self.gate.last()["measured"] == 0:
            self.learn_at = _library32.GATE_MEASURED_MIN
        if self.gate.last()["measured"] >= self.learn_at:
            self.learn_at *= 2
            for axis in range(self.axes):
                self.gate.noise(axis, *self.gate.measured(axis))
        return rest


class Gated:
    """The library on the host behind the model's gate, by the rule at selfcal_push_moving(), as the application is."""

    def __init__(self, model: Model, rate_hz: float, axes: tuple[str, ...], target: str = "host") -> None:
        tables = make_tables(model, rate_hz, axes, target)
        self.learning = Learning(model, tables)
        self.gate = self.learning.gate
        self.bank = Bank(tables, coarse=target != "host")
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
