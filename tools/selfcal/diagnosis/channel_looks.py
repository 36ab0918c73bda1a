"""How a channel acts on an axis: its forms scored side by side with the drift refitted, and the look at the best.

A channel is the temperature, the supply, another axis, or another axis' short-term variance. Its influence may be
static, late by a first-order lag, its rate, its square or cube, or come through a play or after a fixed delay. Each
form is one or more columns. The simplest form is taken unless another gains clearly more.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import chdtrc

from selfcal.base.grid import Array
from selfcal.base.units import power
from selfcal.diagnosis import curve
from selfcal.diagnosis.cause import Cause, Channels, Grouping, Key, Scored, Simulated, Written, medians, positive, shown
from selfcal.diagnosis.curve import FREE
from selfcal.diagnosis.record import Record, smoothed
from selfcal.likelihood import columns
from selfcal.likelihood.columns import LN_EITHER, LN_SLOW, Number, Shape, Tried
from selfcal.likelihood.fit import left
from selfcal.likelihood.state import ALIKE, NET_LEAST, FittedColumn, Look, State, ln_looks
from selfcal.logs.recording import SIDE_CHANNELS
from selfcal.model.forms import NUMBER, POWER, curved, formed, slope
from selfcal.model.regressors import coefficient_unit

#: Forms, the simplest first. `first_order` is (coefficient + rate s) / (1 + lag_s s): static, a lag, and a filtered
#: rate are cases of it.
FORMS = ("static", "lag", "rate", "square", "first_order", "cube", "play", "delay", "free")
#: The columns of each form: a power comes with all that are simpler.
PARTS = {"square": ("static", "square"), "cube": ("static", "square", "cube"), "first_order": ("static", "lag")}
#: Forms with a time constant of a lag.
LATE = ("lag", "first_order")
#: Estimate key of a column's coefficient; of all others `coefficient`.
KEYS = {"rate": "rate", "square": "square", "cube": "cube"}
#: Widths of the means that a channel is smoothed by, s: its own noise and lattice would hide what it does. The model
#: file's window is as wide and trails: a module has no later values.
SMOOTHING_S = (1.0, 10.0, 30.0, 90.0)
#: Windows of a rate, s. A lattice of 0.14 degC needs a long window, a quick change of the channel a short window.
RATE_WINDOWS_S = (20.0, 40.0, 60.0, 90.0, 150.0, 400.0)
#: Widths of a play over the channel's own range.
PLAYS = (0.05, 0.1, 0.2, 0.35, 0.55, 0.8)
#: Longest lag, as a share of the record: a longer lag is a ramp as well.
LONGEST_LAG = 1.0 / 3.0
#: Share of a column below which the change by a lag or a play is ignored.
ALIKE_COLUMN = 0.1
#: ln of the number of independent looks that each form costs beyond the static form, over all channels' forms.
LN_FORMS = {
    "static": 0.0,
    "lag": 3.0,
    "rate": 2.5,
    "square": 2.0,
    "first_order": 3.0,
    "cube": 2.0,
    "play": 3.0,
    "delay": 0.0,
    "free": 2.0,
}
#: Bands of equal information that must agree on another axis' coefficient.
BANDS = 16
#: Drawn records of a channel's own noise, and the share of a coefficient that it leaves at least.
NOISES = 4
KEPT_LEAST = 0.3


@dataclass(frozen=True)
class Channel:
    """What may act: `values` [n] of the channel `column` in `unit`, about `reference` of it. `name` is that of its
    regressors, `widths_s` of its smoothing means. `slow`: its gain must hold over all possible drifts. `extra`: its
    further entries in the estimate. `ln_looks`: price of its search."""

    cause: str
    name: str
    column: str
    unit: str
    values: Array
    input: str = "value"
    reference: float = 0.0
    widths_s: tuple[float, ...] = (0.0,)
    rate_windows_s: tuple[float, ...] = RATE_WINDOWS_S
    forms: tuple[str, ...] = FORMS
    slow: bool = True
    noisy: bool = False
    ln_looks: float = 0.0
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def of(self) -> str:
        """Unit of what acts."""
        return power(self.unit, 2) if self.input == "variance" else self.unit


def side_looks(state: State, record: Record, cause: str) -> list[Look]:
    """The look at a side channel, if it was recorded."""
    return look(state, [_side(record, cause)]) if cause in record.channels else []


def side_at(state: State, record: Record, cause: str, theta: Sequence[float]) -> Look:
    """The look at a side channel that is known to act, in the form `theta`: its place in FORMS, its number, and the
    width of its means, s."""
    shape = shape_of(_side(record, cause), state, FORMS[int(theta[0])], *theta[1:])
    found = columns.located(state, cause, shape)
    return replace(found, measure=partial(_noiseless, _side(record, cause), shape))


def _side(record: Record, cause: str) -> Channel:
    return side_of(cause, record.channel_names[cause], record.channels[cause])


def side_of(cause: str, column: str, values: Array) -> Channel:
    """The temperature or the supply `values` [n] of a column."""
    return Channel(
        cause,
        cause,
        column,
        SIDE_CHANNELS[cause][1],
        values,
        reference=float(np.round(values.mean(), 3)),
        widths_s=SMOOTHING_S,
        noisy=True,
        ln_looks=LN_EITHER + LN_SLOW,
    )


def look(state: State, channels: Sequence[Channel]) -> list[Look]:
    """The look of each channel that is worth 1 nat."""
    return [look for channel in channels for look in _look(state, channel)]


def shape_of(channel: Channel, state: State, form: str, number: float, width_s: float) -> Shape:
    """A form of a channel as the diagnosis takes it: of centred means and slopes, which have no lag of their own."""
    window = max(1, round(width_s / state.dt))
    about = smoothed(channel.values, window) - channel.reference
    entry: dict[str, Any] = {"kind": "column", "column": channel.column, "unit": channel.unit}
    entry |= {"input": channel.input} if channel.input != "value" else {}
    entry |= {"reference": channel.reference}
    smooth = {"window_s": width_s} if window > 1 else {}

    def regressor(form: str, values: Array, **more: Any) -> FittedColumn:
        name = channel.name if form == "static" else f"{channel.name}_{form}"
        unit = "1" if form == FREE else power(channel.of, POWER.get(form, 1)) + ("/s" if form == "rate" else "")
        stated = {"form": form} if form != "static" else {}
        own = {key: value for key, value in entry.items() if form not in ("rate", FREE) or key != "reference"}
        return FittedColumn(name, channel.cause, values, unit, {**own, **smooth, **stated, **more})

    if form == FREE:
        means = smoothed(channel.values, window)
        column = regressor(FREE, means, knots=curve.knots_of(means, round(number)))
        stated = {"form": FREE, "input": channel.input, **channel.extra}
        return curve.shape(column, means, channel.ln_looks + LN_FORMS[FREE], state.unit, stated)
    known = _known(state)
    parts = [part for part in PARTS.get(form, (form,)) if (channel.column, channel.input, part) not in known]

    def values(part: str) -> Array:
        return slope(about, number, state.dt) if part == "rate" else formed(about, part, number, 0.0, state.dt)

    numbers = {part: {NUMBER[part]: number} if part in NUMBER else {} for part in parts}
    found = tuple(regressor(part, values(part), **numbers[part]) for part in parts)
    keys = tuple(
        (KEYS.get(form_of(regressor)[2], "coefficient"), coefficient_unit(state.unit, regressor.unit))
        for regressor in found
    )
    rows = np.array([one.values for one in found]).reshape(-1, channel.values.size)
    if form == "first_order":
        value, late = rows
        rows = np.array([late, (value - late) / number])
        keys = (keys[0], ("rate", coefficient_unit(state.unit, f"{found[0].unit}/s")))
    own = {NUMBER["rate"]: number} if form == "rate" else {}
    shape = Shape(
        form,
        rows,
        found,
        keys,
        channel.ln_looks + LN_FORMS[form],
        len(found),
        stated={"form": form, **own, "input": channel.input, **channel.extra},
    )
    if form not in (*LATE, "play", "delay"):
        return shape
    if form == "play":
        theta = Number(NUMBER["play"], number, channel.of, 0.02 * _span(channel), _span(channel))
    else:
        theta = Number(
            NUMBER.get(form, NUMBER["lag"]), number, "s", state.dt, LONGEST_LAG * channel.values.size * state.dt
        )
    return replace(shape, numbers=(theta,), moved=lambda other: shape_of(channel, state, form, other[0], width_s))


def _span(channel: Channel) -> float:
    return float(np.ptp(channel.values))


def form_of(column: FittedColumn) -> tuple[str, str, str]:
    """Channel, input and form of a column in a model; no channel for a column of time alone."""
    entry = column.entry
    form = "rate" if entry.get("kind") == "rate" else str(entry.get("form", "static"))
    return str(entry.get("column", "")), str(entry.get("input", "value")), form


def _known(state: State) -> set[tuple[str, str, str]]:
    """The forms that the model has."""
    return {form_of(regressor) for regressor in state.regressors}


def _widths(channel: Channel, state: State) -> list[float]:
    """Widths of the means that the record is long enough for, s."""
    most = channel.values.size // 10
    return [width for k, width in enumerate(channel.widths_s) if k == 0 or round(width / state.dt) <= most]


def _windows(channel: Channel, state: State) -> list[int]:
    """`_widths` in samples."""
    return [max(1, round(width / state.dt)) for width in _widths(channel, state)]


def shapes_of(channel: Channel, state: State) -> Iterator[Shape]:
    """Every form over its grid of numbers and smoothing means."""
    for form, number, width in variants_of(channel, state):
        yield _delayed(channel, state, width) if form == "delay" else shape_of(channel, state, form, number, width)


def variants_of(channel: Channel, state: State) -> Iterator[tuple[str, float, float]]:
    """Every form that the model lacks, with its number, NaN if it has no number, and the width of its means, s."""
    n, dt = channel.values.size, state.dt
    widths = _widths(channel, state)
    middle = widths[len(widths) // 2]
    known = _known(state)
    for form in channel.forms:
        parts = PARTS[form] if form == "first_order" else (form,)
        if any((channel.column, channel.input, part) in known for part in parts):
            continue
        if form in LATE:
            yield from ((form, lag, 0.0) for lag in _lags(channel, state))
        elif form == "delay":
            yield from ((form, math.nan, width) for width in dict.fromkeys((widths[0], middle)))
        elif form == "rate":
            windows = [max(window, dt) for window in channel.rate_windows_s if window <= n * dt / 6.0]
            yield from ((form, window, 0.0) for window in dict.fromkeys(windows))
        elif form == "play":
            span = float(np.ptp(smoothed(channel.values, max(1, round(middle / dt)))))
            yield from ((form, share * span, middle) for share in PLAYS)
        elif form == FREE:
            yield from ((form, float(k), width) for k in curve.counts(n) for width in widths[:2])
        else:
            yield from ((form, math.nan, width) for width in widths)


def _delayed(channel: Channel, state: State, width_s: float) -> Shape:
    """The likeliest delay of a channel's means: all of them by one pass of the filter."""
    about = smoothed(channel.values, max(1, round(width_s / state.dt))) - channel.values.mean()
    rest, column = left(state.series, state.best, about).T
    size = next_fast_len(2 * column.size)
    score = irfft(rfft(rest, size) * np.conj(rfft(column, size)), size)
    most = max(2, int(LONGEST_LAG * column.size))
    bend = np.full(most, 1.0 - float(column[1:] @ column[:-1]) / max(float(column @ column), 1e-300))

    def at(delay_s: float) -> Shape:
        return replace(
            shape_of(channel, state, "delay", delay_s, width_s),
            price=lambda gain: channel.ln_looks + ln_looks(bend, gain),
            moved=lambda other: at(other[0]),
        )

    return at((1 + int(np.argmax(score[1:most] ** 2))) * state.dt)


def _lags(channel: Channel, state: State) -> list[float]:
    """Time constants a factor 2 apart from dt to a third of the record, less those that the channel is too slow for."""
    dt = state.dt
    about = channel.values - channel.values.mean()
    longest = LONGEST_LAG * about.size * dt
    found = dt * 2.0 ** np.arange(max(1, math.floor(math.log2(max(longest / dt, 1.0))) + 1))
    if not channel.noisy:
        return [float(lag) for lag in found]
    smooth = smoothed(about, max(1, round(channel.widths_s[-1] / 3.0 / dt)))
    spread = float(smooth.std())
    return [float(lag) for lag in found if _differs(formed(smooth, "lag", lag, 0.0, dt), smooth, spread)]


def _differs(column: Array, plain: Array, spread: float) -> bool:
    """Whether a column differs from the plain column times a constant."""
    a, b = column - column.mean(), plain - plain.mean()
    left = a - b * (float(a @ b) / max(float(b @ b), 1e-300))
    return float(left.std()) > ALIKE_COLUMN * spread


def _look(state: State, channel: Channel) -> list[Look]:
    """The look at the best form, its size that of the channel without noise of its own."""
    found = columns.tried(state, list(shapes_of(channel, state)), slow=channel.slow)
    if not found or max(trial.net for trial in found.values()) < 1.0:
        return []
    alike = columns.alike(found)
    chosen = alike[0]
    if not channel.slow:
        constant = [trial for trial in alike if _constant(state, trial)]
        if not constant:
            # The coefficient depends on the frequency, and no form explains it: no cause, and not nothing either.
            if max(trial.net for trial in found.values()) < NET_LEAST:
                return []
            estimate = {"statistic": f"dependence on {channel.column}", "measured": _inconstant(state, chosen)}
            return [Look("unexplained", chosen.gain, chosen.net, estimate, {}, shown_by=channel.column)]
        chosen = constant[0]
    if channel.noisy and chosen.net >= NET_LEAST and (channel.column, channel.input, "static") in _known(state):
        # What other means of the channel explain as well is its own noise in the column that the model has.
        plain = max(state.with_columns(smoothed(channel.values, window))[0] for window in _windows(channel, state))
        chosen = replace(chosen, gain=chosen.gain - plain)
        if chosen.net < 1.0:
            return []
    rivals = tuple(trial.shape for trial in alike if trial.shape.form != chosen.shape.form)
    chosen = curve.best(state, chosen, chosen.shape.regressors[0].values) if chosen.shape.form == FREE else chosen
    more = {"form_also_possible": [rival.form for rival in rivals]} if rivals else {}
    shape = replace(chosen.shape, stated={**chosen.shape.stated, **more})
    look = replace(columns.look(state, channel.cause, replace(chosen, shape=shape)), rivals=rivals)
    return [replace(look, measure=partial(_noiseless, channel, shape)) if channel.noisy else look]


def _noiseless(channel: Channel, shape: Shape, state: State) -> dict[str, Any]:
    """The posterior of the sizes, a static size over the share that the channel's own noise leaves of it."""
    sizes = columns.measured(shape, state)
    if shape.form != "static":
        return sizes
    (key, _), window = shape.keys[0], max(1, round(float(shape.regressors[0].entry.get("window_s", 0.0)) / state.dt))
    kept = _kept(state, shape.columns[0], channel, window)
    return {key: {part: value / kept if part != "unit" else value for part, value in sizes[key].items()}}


def _constant(state: State, trial: Tried) -> bool:
    """Whether each column of a form has the same coefficient at all frequencies, as far as the record shows."""
    return trial.net < ALIKE or _inconstant(state, trial) < NET_LEAST


def _inconstant(state: State, trial: Tried) -> float:
    """`inconstancy` of the column with the most: next to a square the plain column may still be a common source's."""
    rows = trial.shape.columns
    return max(inconstancy(state, rows[k], np.delete(rows, k, axis=0)) for k in range(len(rows)))


def inconstancy(state: State, column: Array, beside: Array | None = None) -> float:
    """-ln p of a coefficient that is the same at every frequency.

    A reading that follows another axis does so at all frequencies alike. Two axes that share a line, a temperature or a
    shock agree at some frequencies only, and the axis that is followed has no constant coefficient either.
    `beside`: columns [k, n] that are in the model as well.
    """
    series = state.series if beside is None or not len(beside) else state.series.beside(beside)
    w, u = left(series, state.best, column[None]).T
    chi, bands = agreement(u, w - float(u @ w) / float(u @ u) * u)
    return -math.log(max(float(chdtrc(bands - 1, chi)), 1e-300)) if bands > 1 else 0.0


def agreement(u: Array, w: Array, *, any_phase: bool = False) -> tuple[float, int]:
    """How a record w [n] goes with a column u [n], both white: chi squared, a coefficient in each band, and the number
    of bands. Bands hold equal information. `any_phase`: any shift in time counts, by a second coefficient a band."""
    U, W = rfft(u), rfft(w)
    A, B = np.abs(U) ** 2, np.conj(U) * W
    edges = np.searchsorted(np.cumsum(A) / A.sum(), np.linspace(0.0, 1.0, BANDS + 1)[1:-1])
    edges = np.unique(np.concatenate([[0], edges + 1, [A.size]]))
    edges = edges[edges < A.size]
    information = np.add.reduceat(A, edges)
    score = np.add.reduceat(B, edges)
    power_of = np.abs(score) ** 2 if any_phase else score.real**2
    # The transform doubles every bin but the first: half of the bins' power is in the real part.
    noise = float(np.var(w)) * u.size / 2.0
    return float((power_of / np.maximum(information, 1e-300)).sum()) / noise, edges.size


def _kept(state: State, column: Array, channel: Channel, window: int) -> float:
    """Share of a coefficient that the own noise of a channel leaves: the share of the information without that noise.

    `column` is the channel smoothed over `window` samples. Neighbouring readings differ by their noise alone. It is
    drawn anew, smoothed and whitened as the channel is. The column enters whole, so its noise lowers the coefficient.
    """
    random = np.random.default_rng(1)
    noise = math.sqrt(0.5 * float(np.var(np.diff(channel.values)))) * random.standard_normal((NOISES, column.size))
    rows = [column[None], *(smoothed(row, window)[None] for row in noise)]
    own, *of_noise = (sums.G[1, 1] for sums in state.beside(state.best.terms, state.best.theta, rows))
    return float(np.clip(1.0 - np.mean(of_noise) / max(own, 1e-300), KEPT_LEAST, 1.0))


def least(state: State, record: Record, channel: str) -> dict[str, tuple[float, str]] | None:
    """The coefficient of a channel that this record would have shown; None if the channel is missing or constant."""
    if channel not in record.channels:
        return None
    shape = shape_of(_side(record, channel), state, "static", math.nan, SMOOTHING_S[1])
    found = columns.least(state, shape, "coefficient") if shape.keys else {}  # else the model has it
    return found if found and math.isfinite(found["coefficient"][0]) else None


#: Keys of `simulate --effect` besides the coefficient: the numbers of a form, and its other coefficients.
EFFECT_KEYS = {
    **{key: positive(None) for key in ("lag_s", "width", "delay_s", "window_s")},
    **{key: Key(None) for key in ("rate", "square", "cube", "knots")},
}


def added(keys: Mapping[str, Any], channels: Channels, values: Array) -> Array:
    """What the forms of a channel add to a reading besides its static coefficient, [n]; but for a rate 0 at the first
    sample."""
    interval_s = float(channels.time_s[1] - channels.time_s[0])
    total = np.zeros(values.size)
    for form in ("lag", "play", "delay"):
        if NUMBER[form] in keys:
            late = formed(values, form, float(keys[NUMBER[form]]), 0.0, interval_s)
            total += float(keys["coefficient"]) * (late - values)
    if "rate" in keys and "lag_s" in keys and "window_s" not in keys:
        late = formed(values, "lag", float(keys["lag_s"]), 0.0, interval_s)
        total += float(keys["rate"]) * (values - late) / float(keys["lag_s"])
    elif "rate" in keys:
        window_s = float(keys.get("window_s", RATE_WINDOWS_S[2]))
        total += float(keys["rate"]) * slope(values, window_s, interval_s)
    if "knots" in keys:
        bent = curved(values, keys["knots"])
        total += float(keys["coefficient"]) * (bent - bent[0] - (values - values[0]))
    for form in POWER:
        if form in keys:
            column = formed(values, form, about=float(values.mean()))
            total += float(keys[form]) * (column - column[0])
    return total


def of_column(column: FittedColumn, c: Sequence[float]) -> dict[str, Any]:
    """Keys of `simulate --effect` for a column of a form."""
    form = form_of(column)[2]
    if form in ("rate", "square", "cube"):
        window = {"window_s": float(column.entry["window_s"])} if form == "rate" else {}
        return {"coefficient": 0.0, form: c[0], **window}
    if form == FREE:
        return {"coefficient": c[0], "knots": as_text(column.entry["knots"])}
    return {"coefficient": c[0], **({NUMBER[form]: float(column.entry[NUMBER[form]])} if form in NUMBER else {})}


def of_other(column: FittedColumn, c: Sequence[float]) -> dict[str, Any]:
    """Keys of `simulate --effect` for a column of another axis."""
    return {**of_column(column, c), "other": str(column.entry["column"])}


def of_look(look: Look) -> dict[str, Any]:
    """Keys of `simulate --effect` for a finding. A slope needs its window, and every form a coefficient."""
    window = {key: look.estimate[key] for key in (NUMBER["rate"], "other") if key in look.estimate}
    knots = {"knots": as_text(look.estimate["knots"])} if "knots" in look.estimate else {}
    return {"coefficient": 0.0, **medians(look), **window, **knots}


def as_text(knots: Sequence[Sequence[float]]) -> str:
    """A curve as a value of `--effect`: CHANNEL/HEIGHT+CHANNEL/HEIGHT..."""
    return "+".join(f"{place:.7f}/{height:.6f}" for place, height in knots)


def side_cause(cause: str, name: str, record_next: str, coefficient: Key, *, from_zero: bool) -> Cause:
    """The cause that a side channel is."""
    return Cause(
        cause,
        f"The bias follows the {name}.",
        record_next,
        source="surroundings",
        looks=lambda state, record: side_looks(state, record, cause),
        at=lambda state, record, theta: side_at(state, record, cause, theta),
        of_means=True,
        pictures=shown("means", "evidence"),
        least=lambda state, record: least(state, record, cause),
        grouping=Grouping(alike=lambda a, b: True),
        score=Scored(trained=curve.trained),
        written=Written(smoothed=True, from_zero=from_zero, of_column=of_column),
        simulated=Simulated(
            keys={"coefficient": coefficient, **EFFECT_KEYS},
            of_estimate=of_look,
            add=lambda keys, channels: added(keys, channels, getattr(channels, cause)),
        ),
    )
