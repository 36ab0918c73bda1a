"""The C library from Python: the very code of the firmware, in its float, in fixed point, or in double."""

from __future__ import annotations

import math
from dataclasses import astuple
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal import _library32
from selfcal.bank.axis_result import AxisResult, Estimate
from selfcal.base.errors import OutsidePriors, UserError
from selfcal.model.laws import PLACES
from selfcal.model.tables import Grid, Tables


def _grid(grid: Grid | None) -> tuple[int, list[float]] | None:
    return None if grid is None else (grid.nodes, grid.fit.ravel().tolist())


def _regressors(tables: Tables) -> tuple[list[float], list[float], list[float]] | None:
    """Reference [p], prior sd and prior mean [axes * p] of the columns."""
    columns = tables.regressors
    if not columns:
        return None
    places = [(axis, column) for axis in range(len(tables.axes)) for column in columns]
    sd = [column.coefficient_sd[axis] for axis, column in places]
    mean = [column.coefficient_mean[axis] if column.coefficient_mean else 0.0 for axis, column in places]
    return [column.reference for column in columns], sd, mean


def arguments(tables: Tables) -> tuple[Any, ...]:
    """The model as the bindings take it (bindings/tables.hpp)."""
    return (
        tables.dt_s,
        tables.block,
        [(axis.ln_min, axis.ln_max, axis.law, axis.bias_sd, axis.range, axis.stuck_limit) for axis in tables.axes],
        [(h.law.as_tuple, h.ln_probability, _grid(h.rho), _grid(h.alpha), h.priors) for h in tables.hypotheses],
        tables.id,
        _regressors(tables),
        tables.half_life_s,
        astuple(tables.handling),
    )


class Bank:
    """A bank over the axes of `tables`.

    `build`: the compiled module, `_fixed` that of the integer kernels (SELFCAL_FIXED). `make setup-dev` compiles others
    for tests alone. `offset`: what the samples of the first axis are less than the readings; its reports have it again.
    """

    def __init__(self, tables: Tables, *, build: str = "_library32", offset: float = 0.0) -> None:
        self.tables = tables
        self.offset = offset
        library: Any = _library32 if build == "_library32" else import_module(f"selfcal.{build}")
        self.raw: Any = library.Bank(*arguments(tables))
        if offset:
            self.raw.shift(0, -offset)

    def push(
        self,
        samples: NDArray[np.floating[Any]],
        missing_before: NDArray[np.integer[Any]] | None = None,
        regressors: NDArray[np.floating[Any]] | None = None,
    ) -> None:
        """Feed `samples` [n, axes] in the model's units, after `missing_before` [n] missing samples each, with the
        values of the `regressors` [n, p] if the tables have any."""
        rows = np.ascontiguousarray(samples, dtype=np.float32)
        missing = np.zeros(len(rows)) if missing_before is None else missing_before
        values = None if regressors is None else np.ascontiguousarray(regressors, dtype=np.float32)
        self.raw.push(rows, np.ascontiguousarray(missing, dtype=np.uint64), values)

    def report(self, axis: int, mask: int = 0, ahead_s: float = 0.0) -> AxisResult:
        """Posterior of an axis, with the columns of `mask` in use, a bit each. The bias is at `ahead_s` after the
        last bank interval, with the columns' values of that interval. Raises UserError of an axis that failed, with too
        few bank samples, and where the priors leave nothing (with regressors an evidence of -inf)."""
        if self.raw.retired(axis):
            raise UserError(
                f"{self.tables.axes[axis].name} was out of range or stuck for too long and is left out: choose the "
                "others with --axis"
            )
        try:
            report = self.raw.report(axis, mask, ahead_s)
        except ValueError as error:  # std::length_error
            tables, count, least = self.tables, self.raw.count, _library32.REPORT_MIN
            said = f"too short: {count} bank samples of {tables.dt_s:g} s, a report needs {least} "
            said += "(record longer, or give --decimate HZ)"
            if count > least > self.raw.weight:
                said = f"all is forgotten: after {tables.half_life_s:g} s a bank sample counts half, "
                said += "and the last are too old"
            raise UserError(said) from error
        log_evidence, probability, parameters, coefficients = {}, {}, {}, {}
        used = [k for k in range(len(self.tables.regressors)) if mask >> k & 1]
        for table, entry in zip(self.tables.hypotheses, report["hypotheses"], strict=True):
            log_evidence[table.name] = entry["ln_evidence"]
            probability[table.name] = entry["probability"]
            coefficients[table.name] = tuple(entry["coefficients"][k] for k in used)
            parameters[table.name] = {
                name: _estimate(entry["parameters"][PLACES[name]]) for name in table.law.parameters
            }
        if not self.tables.regressors and not any(math.isfinite(p) for p in probability.values()):
            raise OutsidePriors
        return AxisResult(
            report["n"],
            log_evidence,
            probability,
            parameters,
            report["bias_mean"] + (self.offset if axis == 0 else 0.0),
            report["bias_sd"],
            coefficients,
        )


def _estimate(entry: tuple[float, float, float, float, float, int]) -> Estimate:
    mean, median, sd, q05, q95, flags = entry
    return Estimate(mean, median, sd, q05, q95, bool(flags & _library32.IDENTIFIED), bool(flags & _library32.OFF_GRID))
