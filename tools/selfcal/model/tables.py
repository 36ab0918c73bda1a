"""The numbers behind a model: nodes, splines and priors as the C library wants them (`selfcal_model_t`)."""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum, auto

import numpy as np

from selfcal import _library32
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.base.limits import LEAST_RATE_HZ, MOST_RATE_HZ
from selfcal.base.units import same_kind
from selfcal.model.file import NOT_HANDLED, Group, Handling, Model, Prior
from selfcal.model.laws import KINDS, NAMED, PARAMETERS, PLACES, Law
from selfcal.model.regressors import channels_of, column_sources

#: Most samples a bank interval: the float sums of a block lose digits with more.
MOST_BLOCK = 1_000_000


class PriorLaw(IntEnum):
    """`selfcal_prior_law_t`."""

    LOG_UNIFORM = 0
    UNIFORM = auto()
    LOG_NORMAL = auto()

    def __repr__(self) -> str:
        """The text of the first checksums, which knew two laws: a model's checksum stays."""
        return ("False", "True", "log_normal")[self]


#: ln limits, law, whether measured: `selfcal_prior_t`.
PriorRow = tuple[float, float, PriorLaw, bool]


@dataclass(frozen=True)
class Grid:
    """A grid dimension: `nodes` even steps; `fit` [nodes, nodes] turns node values into B-spline coefficients."""

    nodes: int
    fit: Array


@functools.cache
def make_grid(nodes: int) -> Grid:
    """The not-a-knot spline through `nodes` points 1 apart (knots: `knot()` in lib/report_spline.c)."""
    z = np.arange(nodes, dtype=float)
    knots = np.concatenate([np.zeros(6), np.arange(3.0, nodes - 3.0), np.full(6, nodes - 1.0)])
    return Grid(nodes, np.asarray(np.linalg.inv(_basis(z, knots, 5)), np.float64))


def _basis(z: Array, knots: Array, degree: int) -> Array:
    """B-splines [points, splines] at `z` by the recursion of Cox and de Boor. The same as scipy's design matrix, whose
    import takes longer than `identify` of an hour."""
    interval = np.searchsorted(knots, z, side="right") - 1
    interval = np.minimum(interval, len(knots) - degree - 2)  # the last point belongs to the last interval
    basis = np.eye(len(knots) - 1)[interval]
    for d in range(1, degree + 1):
        span = knots[d:] - knots[:-d]
        rise = np.where(span > 0.0, (z[:, None] - knots[:-d]) / np.where(span > 0.0, span, 1.0), 0.0)
        basis = rise[:, :-1] * basis[:, :-1] + (1.0 - rise[:, 1:]) * basis[:, 1:]
    return basis


@dataclass(frozen=True)
class AxisTable:
    """An axis: ln limits and law of each parameter's prior (order of PARAMETERS), and the read-out."""

    name: str
    unit: str
    ln_min: tuple[float, ...]
    ln_max: tuple[float, ...]
    law: tuple[PriorLaw, ...]
    bias_sd: float
    range: float
    stuck_limit: int


@dataclass(frozen=True)
class RegressorTable:
    """A column of the regressors; `coefficient_sd` [axes] in the axis's unit per `unit`, 0 where it has it not.

    `source`: kind, number and second number (`selfcal_source_t`), and the channel's name and unit, "" without a
    channel. `ln_odds` [axes]: prior odds that the regressor is in use; 0 for a second column of it. `coefficient_mean`
    [axes]: empty for 0."""

    name: str
    unit: str
    reference: float
    coefficient_sd: tuple[float, ...]
    source: tuple[int, float, float, str, str] = (0, 0.0, 0.0, "", "")
    ln_odds: tuple[float, ...] = ()
    coefficient_mean: tuple[float, ...] = ()


@dataclass(frozen=True)
class HypothesisTable:
    """A hypothesis: its law, prior probability and grids; of a sum or a warm start also each axis's priors in the order
    of PARAMETERS."""

    name: str
    law: Law
    ln_probability: float
    rho: Grid | None
    alpha: Grid | None
    priors: tuple[tuple[PriorRow, ...], ...] = ()

    @property
    def nodes(self) -> int:
        """Filters of this hypothesis."""
        return (self.rho.nodes if self.rho else 1) * (self.alpha.nodes if self.alpha else 1)


@dataclass(frozen=True)
class GateTable:
    """The gate for a sampling rate, its fields as the bindings take them: `window` in samples; of each axis `sigma`
    (infinite: left out), and if it is a gyro."""

    window: int
    false_alarm: float
    hold: int
    settle: int
    memory: int
    sigma: tuple[float, ...]
    is_rate: tuple[bool, ...]


@dataclass(frozen=True)
class Tables:
    """A model for a bank interval `dt_s` = `block` samples, for some axes and a target's node counts."""

    dt_s: float
    block: int
    axes: tuple[AxisTable, ...]
    hypotheses: tuple[HypothesisTable, ...]
    regressors: tuple[RegressorTable, ...] = ()
    half_life_s: float = 0.0
    handling: Handling = NOT_HANDLED

    @property
    def rate_hz(self) -> float:
        """Rate of the samples."""
        return self.block / self.dt_s

    @property
    def nodes(self) -> int:
        """Filters of all hypotheses."""
        return sum(h.nodes for h in self.hypotheses)

    @property
    def channels(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of what the regressors take apart from the readings of these axes."""
        axes = {(axis.name, axis.unit) for axis in self.axes}
        taken = dict.fromkeys(column.source[3:] for column in self.regressors if column.source[3])
        return tuple(channel for channel in taken if channel not in axes)

    def source_of(self, column: RegressorTable) -> tuple[int, int, float, float]:
        """`selfcal_source_t` of a column: kind, place of its channel (the axes' readings, then `channels`), numbers."""
        kind, number, second, name, unit = column.source
        places = [*((axis.name, axis.unit) for axis in self.axes), *self.channels]
        return kind, places.index((name, unit)) if name else 0, number, second

    @property
    def term_nodes(self) -> int:
        """Filters of the laws that are sums."""
        return sum(h.nodes for h in self.hypotheses if h.law.is_sum)

    @property
    def id(self) -> int:
        """32-bit checksum of everything that decides what the sums mean."""
        hypotheses = [
            (
                h.name,
                h.ln_probability,
                h.rho.nodes if h.rho else 0,
                h.alpha.nodes if h.alpha else 0,
                *h.priors,
                *([h.law.as_tuple] if h.law.is_sum else []),
            )
            for h in self.hypotheses
        ]
        extras = (
            *self.regressors,
            *([self.half_life_s] if self.half_life_s else []),
            *([self.handling] if self.handling != NOT_HANDLED else []),
        )
        text = repr((self.dt_s, self.block, self.axes, hypotheses, *extras))
        return zlib.crc32(text.replace(" law=(", " uniform=(").encode())  # its name when the first checksums were made


def bank_block(rate_hz: float, bank_rate_hz: float) -> int:
    """Samples averaged into one bank sample; a recording slower than the bank rate is taken as it is."""
    return max(1, round(rate_hz / bank_rate_hz))


def gate_table(model: Model, tables: Tables) -> GateTable | None:
    """The model's gate for the axes and the rate of `tables`; None without a gate, or if `block` is 1."""
    if model.gate is None or tables.block == 1:
        return None
    gate, rate_hz = model.gate, tables.rate_hz
    wanted = gate.window_s * rate_hz
    divisors = [n for n in range(2, tables.block + 1) if tables.block % n == 0]
    groups = [model.group_of(axis.name) for axis in tables.axes]
    return GateTable(
        window=min(divisors, key=lambda n: abs(math.log(n / wanted))),
        false_alarm=gate.false_alarm,
        hold=gate.hold,
        settle=gate.settle,
        memory=gate.memory,
        sigma=tuple(gate.N[g.name] * math.sqrt(rate_hz) if g.name in gate.N else math.inf for g in groups),
        is_rate=tuple(same_kind(group.unit, "rad/s") for group in groups),
    )


def make_tables(
    model: Model,
    rate_hz: float,
    axes: tuple[str, ...] | None = None,
    target: str = "host",
    bank_rate_hz: float | None = None,
) -> Tables:
    """The tables for samples at `rate_hz` on `axes` (default: all of the model).

    Raises UserError for an unknown target or axis, or a bank interval that the priors do not fit.
    """
    if target not in model.nodes:
        raise UserError(f"{model.path}: nodes has no target '{target}' (it has {', '.join(model.nodes)})")
    nodes = model.nodes[target]
    bank_rate = bank_rate_hz or model.bank_rate_hz
    for rate, what in ((rate_hz, "the sampling rate"), (bank_rate, "the bank rate")):
        if not LEAST_RATE_HZ <= rate <= MOST_RATE_HZ:
            raise UserError(f"{what}, {rate:g} Hz, is outside {LEAST_RATE_HZ:g} to {MOST_RATE_HZ:g} Hz")
    names = model.axes if axes is None else axes
    block = bank_block(rate_hz, bank_rate)
    if block > MOST_BLOCK:
        raise UserError(f"{block} samples a bank interval ({rate_hz:g} to {bank_rate:g} Hz) are more than {MOST_BLOCK}")
    axis_tables = tuple(_axis_table(name, model.group_of(name)) for name in names)
    _check_times(model, block / rate_hz)

    def grids(name: str) -> tuple[Grid | None, Grid | None]:
        counts = nodes.get(name, ())
        rho, alpha = (*(make_grid(count) for count in counts), None, None)[:2]
        return rho, alpha

    return Tables(
        dt_s=float(np.float32(block / rate_hz)),
        block=block,
        axes=axis_tables,
        hypotheses=tuple(
            HypothesisTable(
                name,
                model.laws[name],
                math.log(probability),
                *grids(name),
                priors=tuple(priors_of(model.group_of(axis), name) for axis in names)
                if model.laws[name].is_sum
                else (),
            )
            for name, probability in model.hypotheses.items()
        ),
        regressors=tuple(_regressor_tables(model, names)),
        half_life_s=model.half_life_s,
        handling=model.handling,
    )


def _axis_table(name: str, group: Group) -> AxisTable:
    priors = [group.priors[key] for key in PARAMETERS]
    return AxisTable(
        name=name,
        unit=group.unit,
        ln_min=tuple(math.log(p.min) for p in priors),
        ln_max=tuple(math.log(p.max) for p in priors),
        law=tuple(_law(p) for p in priors),
        bias_sd=group.priors["bias"].sd,
        range=group.range,
        stuck_limit=group.stuck_limit,
    )


def _regressor_tables(model: Model, names: Sequence[str]) -> Iterator[RegressorTable]:
    for regressor in model.regressors:
        sd = tuple(
            0.0 if regressor.column == name else regressor.sd.get(model.group_of(name).name, 0.0) for name in names
        )
        ln_odds = math.log(regressor.probability / (1.0 - regressor.probability))
        channels = channels_of((regressor,))
        for place, column in enumerate(regressor.columns):
            odds = len(names) * (ln_odds if place == 0 else 0.0,)
            kind, _, number, second = column_sources(regressor, channels)[place]
            source = (kind, number, second, *(channels[0][:2] if channels else ("", "")))
            yield RegressorTable(column, regressor.unit, regressor.offset, sd, source, odds)


def _check_times(model: Model, dt: float) -> None:
    """Raise UserError for a time of the model that bank intervals of `dt` s are too long or too short for."""

    def check(where: str, time_s: float, least: float, most: float) -> None:
        if not least <= time_s <= most:
            limits = f"{least:.3g} to {most:.3g} s at bank intervals of {dt:g} s"
            raise UserError(f"{model.path}: {where}: must be from {limits}, not {time_s:g}")

    least_s = _library32.BATCH * dt
    if 0.0 < model.half_life_s < least_s:
        what = f"{model.half_life_s:g} s are less than {_library32.BATCH} bank intervals ({least_s:g} s)"
        raise UserError(f"{model.path}: half_life_s: {what}")
    for name, law in model.laws.items():
        for term in law.terms:
            if term.stated:
                kind = KINDS[term.kind]
                where = kind.time if name in NAMED else f"hypotheses.{name}: {kind.time}"
                check(where, kind.turn / term.bandwidth, *(intervals * dt for intervals in kind.times))


def priors_of(group: Group, law: str) -> tuple[PriorRow, ...]:
    """In each place the prior of the parameter that the law has there, else that of the axis."""
    of_place = dict(enumerate(PARAMETERS)) | {PLACES[name]: name for name in group.laws[law].parameters}
    chosen = (group.priors[of_place[place]] for place in range(len(PARAMETERS)))
    return tuple((math.log(p.min), math.log(p.max), _law(p), False) for p in chosen)


def _law(prior: Prior) -> PriorLaw:
    return PriorLaw[prior.law.upper()]
