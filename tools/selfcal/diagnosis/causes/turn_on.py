"""The bias settles after power-on: A exp(-t / tau), of one time constant or of two."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from selfcal.base.grid import Array
from selfcal.diagnosis.cause import Cause, Channels, Grouping, Key, Scored, Simulated, Written, medians, positive, shown
from selfcal.diagnosis.model_tree import digits
from selfcal.diagnosis.record import Record
from selfcal.likelihood import columns
from selfcal.likelihood.columns import LN_SLOW, Number, Shape
from selfcal.likelihood.state import NET_LEAST, FittedColumn, Look, State, log_normal

#: The fastest time constant looked for, samples.
FASTEST = 5.0
#: Least factor between two time constants of a transient.
TAUS_APART = 4.0
#: Price of the search over a time constant, besides its degree of freedom.
LN_LOOKS = 0.4


def looks(state: State, record: Record) -> list[Look]:
    """The best time constant, or the best two, if a single constant shows settling and both are clearly likelier."""
    tau = _grid(record)
    pairs = (_shape(state, record, two) for two in combinations(tau, 2) if two[1] > 0.999 * TAUS_APART * two[0])
    return columns.looks(state, "turn_on", [_shape(state, record, [constant]) for constant in tau], pairs)


def at(state: State, record: Record, theta: Sequence[float]) -> Look:
    """The look at a settling with a known time constant, s, and the sd of its logarithm. Where the axis alone knows
    better, as it does two time constants, its own look."""
    tau_s, sd = theta
    known = {"tau_s": log_normal(math.log(tau_s), sd, "s")}
    found = columns.located(state, "turn_on", _shape(state, record, [tau_s]), known)
    own = looks(state, record)
    return own[0] if own and own[0].gain > found.gain + NET_LEAST else found


def _shape(state: State, record: Record, tau: Sequence[float]) -> Shape:
    """Shape of one time constant, or of two, the faster first: the faster is a share of the slower."""
    rows = _decays(_time(record), np.asarray(tau))
    ends = ["", "_2"][: len(tau)]
    low, high = _range(record)
    numbers = [Number(f"tau{ends[-1]}_s", float(tau[-1]), "s", low, high)]
    if len(tau) == 2:
        fastest = min(low / float(tau[1]), 1.0 / TAUS_APART)
        numbers.append(Number("tau_s", float(tau[0] / tau[1]), "s", fastest, 1.0 / TAUS_APART, of="tau_2_s"))
    return Shape(
        f"{len(tau)}",
        rows,
        tuple(
            FittedColumn(
                f"turn_on_{constant:.4g}s", "turn_on", row, "1", {"kind": "turn_on", "tau_s": digits(float(constant))}
            )
            for constant, row in zip(tau, rows, strict=True)
        ),
        tuple((f"amplitude{end}", state.unit) for end in ends),
        price=len(tau) * LN_LOOKS + LN_SLOW,
        free=2 * len(tau),
        numbers=tuple(numbers),
        moved=lambda theta: _shape(state, record, [theta[1] * theta[0], theta[0]] if len(theta) == 2 else theta),
    )


def _grid(record: Record) -> Array:
    """Time constants looked for, s, up to the record's length. Two a factor 2 apart correlate by 0.94."""
    low, high = _range(record)
    return np.geomspace(low, high, 1 + math.ceil(math.log2(high / low)))


def _range(record: Record) -> tuple[float, float]:
    """Least and most time constant, s: a faster settling is over before the record begins."""
    fastest = max(FASTEST / record.rate_hz, float(_time(record)[0]) / FASTEST)
    return fastest, max(2.0 * fastest, record.present.size / record.rate_hz)


def _time(record: Record) -> Array:
    """[n]: the middle of each sample's readings, s from power-on."""
    begins = record.since_power_on_s + record.start_s + 0.5 * (1.0 / record.rate_hz - 1.0 / record.recorded_hz)
    return record.time_s + begins


def _decays(t: Array, tau: Array) -> Array:
    """[k, n]: exp(-t / tau) of each."""
    return np.exp(-t[None, :] / np.atleast_1d(tau)[:, None])


def _alike(a: Look, b: Look) -> bool:
    """Whether the time constants may be equal."""
    one, two = (look.estimate["tau_s"] for look in (a, b))
    return bool(one["q05"] <= two["q95"] and two["q05"] <= one["q95"])


def _trained(look: Look, before: State, after: State, record: Record, split: int) -> State:
    """The state with the time constants that the first samples alone show. The scored samples gain by the noise model
    that the first samples then leave: the transient itself is mostly over."""
    known = {regressor.name for regressor in before.regressors}
    half = before.first(split)
    own_record = replace(record, present=record.present[:split])
    single = [_shape(half, own_record, [constant]) for constant in _grid(own_record)]
    found = columns.alike(columns.tried(half, single, slow=False, least=-math.inf))[0]
    times = np.array(found.shape.theta)
    kept = tuple(regressor for regressor in after.regressors if regressor.name in known)
    own = next(regressor for regressor in after.regressors if regressor.name not in known)
    added = tuple(replace(own, name=f"turn_on_{k}", values=row) for k, row in enumerate(_decays(_time(record), times)))
    whole = (*kept, *added)
    # The first samples may show one time constant where the whole record shows two.
    same = len(whole) == len(after.regressors)
    return replace(after, regressors=whole) if same else after.refit(regressors=whole, fits=())


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    """A time constant of a tenth of the record."""
    return columns.least(state, _shape(state, record, [0.1 * record.present.size / record.rate_hz]), "amplitude")


def _entry(entry: Mapping[str, Any], look: Look | None, record: Record) -> dict[str, Any]:
    """The entry with the nearer of a look's two time constants."""
    known = {} if look is None else medians(look)
    times = [known[key] for key in ("tau_s", "tau_2_s") if key in known] or [float(entry["tau_s"])]
    return {**entry, "tau_s": digits(min(times, key=lambda time: abs(math.log(time / float(entry["tau_s"])))))}


def _add(keys: Mapping[str, Any], channels: Channels) -> Array:
    t = channels.time_s
    first, second = (keys[f"amplitude{end}"] * np.exp(-t / keys[f"tau{end}_s"]) for end in ("", "_2"))
    return np.asarray(first + second)


CAUSE = Cause(
    "turn_on",
    "The bias settles after power-on.",
    "Start the record four time constants after power-on, or keep the regressor in the model file.",
    source="sensor",
    looks=looks,
    at=at,
    slow=True,
    of_means=True,
    pictures=shown("means", "evidence"),
    least=_least,
    grouping=Grouping(alike=_alike, most=1),
    score=Scored(anew=True, trained=_trained),
    written=Written(
        entry=_entry, of_column=lambda column, c: {"amplitude": c[0], "tau_s": float(column.entry["tau_s"])}
    ),
    simulated=Simulated(
        keys={
            "amplitude": Key(lambda s: 5.0 * s.n),
            "tau_s": positive(lambda s: s.duration_s / 10.0),
            "amplitude_2": Key(lambda s: 0.0),
            "tau_2_s": positive(lambda s: s.duration_s / 10.0),
        },
        add=_add,
    ),
)
