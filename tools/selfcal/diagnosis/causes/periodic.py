"""A spectral line: the periodogram of the innovations; harmonics of a fundamental make a single finding."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.fft import next_fast_len, rfft

from selfcal.base.grid import Array, Mask
from selfcal.diagnosis import swing
from selfcal.diagnosis.cause import Cause, Grouping, Key, Scored, Simulated, Written
from selfcal.diagnosis.finding import Diagnosed
from selfcal.diagnosis.record import Record
from selfcal.likelihood import columns
from selfcal.likelihood.columns import LN_SLOW, Shape
from selfcal.likelihood.fit import Fit
from selfcal.likelihood.state import ALIKE, FittedColumn, Look, State, net, normal_entry

#: Least turns of a line in a record: fewer are drift.
TURNS_LEAST = 1.5
#: Turns below which a line is as slow as a drift: its gain must hold over all possible drifts, its search costs more.
SLOW_TURNS = 30.0
#: Turns in the record to which two axes know the frequency of a line: nearer lines share a column.
SAME_TURNS = 0.25
#: Share of a line's frequency: a wider band lies at a multiple of the line by chance.
HARMONIC_MOST = 0.1
#: Distance of two lines' frequency ratio from a whole number, below which they are the same event.
ONE_LINE = 0.01
#: Share of its frequency within which another line is a side band.
SIDE_BAND = 0.1


def looks(state: State, record: Record) -> list[Look]:
    """The strongest line, or a narrow band about a frequency that wanders, if that explains more."""
    line, band = _line(state, record), _band(state)
    return line if line and not (band and band[0].gain > line[0].gain + ALIKE) else band


def _band(state: State) -> list[Look]:
    """A fast swing that noise drives (swing.py). Slow swings are the bias's own (oscillation.py)."""
    found = swing.found(state, slow=False) if len(state.extras.bands) < swing.SWINGS_MOST else None
    if found is None or found.keeps_phase:
        return []
    (period, damping, ln_size), fit = found.numbers, found.fit
    width, share = damping / period, math.exp(ln_size)
    sd = 1.0 / math.sqrt(max(1.0, width * fit.duration_s))

    def amplitude(sigma: float) -> dict[str, Any]:
        return {"amplitude": normal_entry(math.sqrt(2.0) * sigma * share, sigma * share * sd, state.unit)}

    estimate = {
        "frequency_hz": normal_entry(1.0 / period, width * sd, "Hz"),
        **amplitude(fit.sigma),
        "width_hz": normal_entry(width, width * sd, "Hz"),
    }
    changes = {"extras": replace(state.extras, bands=(*state.extras.bands, found.numbers))}
    look = Look("periodic", found.gain, found.net, estimate, changes, shown_by="band")
    return [replace(look, measure=lambda final: amplitude(final.best.sigma))]


def pair(f: float, record: Record) -> dict[str, Array]:
    """Sine and cosine of a frequency, each [n], by the ends of their names. At half the rate the sine has no value."""
    turns = 2.0 * math.pi * np.mod(f * record.time_s, 1.0)
    return {**({".sin": np.sin(turns)} if f < 0.5 * record.rate_hz else {}), ".cos": np.cos(turns)}


def _power(f: float, t: Array, w: Array, there: Mask) -> float:
    """Gain of a line in white noise `w` [n], 0 where it is not `there`: least squares, as sine and cosine are not
    orthogonal near half the rate, and a single column at half the rate."""
    turn = np.exp(-2j * math.pi * np.mod(f * t, 1.0))
    z, twice, n = complex(turn @ w), complex((turn[there] ** 2).sum()), float(there.sum())
    room = n**2 - abs(twice) ** 2
    if room < 1e-9 * n**2:
        return 0.5 * abs(z) ** 2 / n
    return (n * abs(z) ** 2 - (twice.conjugate() * z**2).real) / room


def ln_lines(turns: Array, n: int, gain: Array) -> Array:
    """ln of the number of independent lines of which a line is the best, by its `turns` among `n` samples and its
    `gain`. The prior of a frequency is flat in its logarithm: slow lines are few.

    The frequency is continuous: between two bins of the periodogram lies a larger maximum (Baluev 2008, MNRAS 385,
    1279, equation 6, for even sampling)."""
    octaves = math.log(max(math.e, 0.5 * n / TURNS_LEAST))
    places = np.log(np.maximum(1.0, octaves * math.sqrt(math.pi / 3.0) * turns))
    slow = LN_SLOW * (turns < SLOW_TURNS)
    return np.asarray(places + slow + 0.5 * np.log(np.maximum(1.0, gain)))


def shape(state: State, record: Record, f: float, sd: float = 0.0, multiples: Sequence[int] = ()) -> Shape:
    """A line, with multiples of it. The frequency is known to `sd`, else to what the line's amplitude leaves: pi^2 n
    T^2 A^2 / (3 s^2) of information, T the record's length."""
    n, half = state.y.size, 0.5 * record.rate_hz

    def waves(f: float) -> Array:
        return np.array([wave for k in (1, *multiples) for wave in pair(k * f, record).values()])

    def spread(fit: Fit) -> float:
        c, of = (values[len(values) - len(known) :][:2] for values in (fit.c, fit.sd))
        share = float(np.mean(of)) / max(math.hypot(*c), 1e-300)
        return sd or share * math.sqrt(12.0) / (2.0 * math.pi * n * state.dt)

    def sharper(fit: Fit) -> Shape:
        """The likeliest line at the drift fitted with it: the null's drift has swallowed a part of a line."""
        move = min(0.5 * spread(fit), 0.25 * (half - f))
        three = state.scores([waves(f + k * move) for k in (-1, 0, 1)], fit)
        bend = 2.0 * three[1] - three[0] - three[2]
        if not bend > 0.0:
            return shape(state, record, f, 0.0, multiples)
        far = float(np.clip(0.5 * (three[2] - three[0]) / bend, -4.0, 4.0))
        return shape(state, record, f + move * far, move / math.sqrt(bend), multiples)

    known = waves(f)
    added = tuple(
        FittedColumn(f"line_{k * f:.6g}Hz{end}", "periodic", wave, "1", {"kind": "periodic", "frequency_hz": k * f})
        for k in (1, *multiples)
        for end, wave in pair(k * f, record).items()
    )
    return Shape(
        f"{len(known)}",
        known,
        added,
        (("amplitude", state.unit),),
        lambda gain: float(ln_lines(np.array(f * n * state.dt), n, np.array(gain))),
        len(known),
        stated={"harmonics": list(multiples)} if multiples else {},
        sharper=sharper if f < half else None,
        where=lambda fit: {"frequency_hz": normal_entry(f, spread(fit), "Hz")},
        waves=len(pair(f, record)),
    )


def _line(state: State, record: Record) -> list[Look]:
    """The strongest line of the periodogram, at its best frequency."""
    n, half = state.y.size, 0.5 * record.rate_hz
    w, there, t = np.nan_to_num(state.whitened), np.isfinite(state.y), record.time_s
    padded = 2 * next_fast_len(2 * n, real=True)
    power = np.abs(rfft(w, padded)) ** 2 / there.sum()
    width = 1.0 / (n * state.dt)
    frequency = np.arange(power.size) / (padded * state.dt)
    power[frequency < TURNS_LEAST * width] = 0.0
    beside = frequency > half - TURNS_LEAST * width
    power[beside] = [_power(float(f), t, w, there) for f in frequency[beside]]
    at = int(np.argmax(power - ln_lines(frequency * n * state.dt, n, power)))
    f = float(frequency[at])
    if net(float(power[at]), 2, float(ln_lines(np.array(f / width), n, power[at]))) <= 0.0:
        return []
    for move in 0.25 ** np.arange(1.0, 5.0):
        near = np.minimum(f + move * width * np.linspace(-1.0, 1.0, 9), half)
        f = float(near[int(np.argmax([_power(frequency, t, w, there) for frequency in near]))])
    # A line at half the rate also fits next to it, with a column and a frequency more than it needs.
    tried = [*([shape(state, record, half)] if f > half - TURNS_LEAST * width else []), shape(state, record, f)]
    return columns.looks(state, "periodic", tried, slow=f < SLOW_TURNS * width)


def at(state: State, record: Record, theta: Sequence[float]) -> Look:
    """The look at a line of a known frequency, and multiples of it."""
    multiples = [round(k) for k in theta[1:] if k * theta[0] < 0.5 * record.rate_hz]
    known = shape(state, record, theta[0], multiples=multiples)
    return columns.located(state, "periodic", replace(known, sharper=None))


def in_common(state: State, record: Record, theta: Sequence[float]) -> Look:
    """The look at a line that several axes have in common. Without columns where the axis has a swing within an octave
    that forgets its phase: two such swings share lines by chance."""
    look = at(state, record, theta)
    slow = theta[0] * state.y.size * state.dt < SLOW_TURNS and not state.extras.oscillation
    wanders = swing.found(state, slow=True) if slow else None
    if wanders is None or wanders.keeps_phase or wanders.gain < look.gain + ALIKE:
        return look
    near = abs(math.log2(theta[0] * wanders.numbers[0])) < 1.0
    return replace(look, shape=replace(look.shape, regressors=())) if near and look.shape else look


def _settle(record: Record, found: Mapping[str, Diagnosed]) -> None:
    """Give lines that axes have in common the same frequency: the axis that shows the line best decides."""
    lines = [
        (name, finding)
        for name, axis in found.items()
        for finding in axis.findings
        if finding.look.cause == "periodic" and finding.columns and finding.record is None
    ]
    first: list[tuple[str, float]] = []
    for name, finding in sorted(lines, key=lambda line: -line[1].look.gain):
        diagnosed, hz = found[name], _hz(finding.look)
        common = next((f for axis, f in first if axis != name and abs(hz - f) * record.time_s[-1] < SAME_TURNS), hz)
        if common == hz:
            first.append((name, hz))
            continue
        theta = (common, *finding.look.estimate.get("harmonics", []))
        free = diagnosed.state.without({column.name for column in finding.columns})
        look = at(free, record, theta)
        after = free.refit(**look.changes)
        if after.best.ln_likelihood < diagnosed.state.best.ln_likelihood - ALIKE:
            first.append((name, hz))
            continue
        look = replace(look, gain=finding.look.gain, net=finding.look.net)
        own = finding.before.refit(**at(finding.before, record, theta).changes)
        diagnosed.findings[diagnosed.findings.index(finding)] = replace(finding, look=look, after=own)
        diagnosed.state = after
    for diagnosed in found.values():
        _harmonics(diagnosed)


def _hz(look: Look) -> float:
    return float(look.estimate["frequency_hz"]["median"])


def _harmonics(axis: Diagnosed) -> None:
    """Merge lines at multiples of a slower line's frequency into its finding: their gains are added."""
    found = (f for f in axis.findings if f.look.cause == "periodic")
    lines = sorted(found, key=lambda f: _hz(f.look))
    for base in lines:
        if base not in axis.findings:
            continue
        f = base.look.estimate["frequency_hz"]
        harmonics: list[int] = []
        gain, worth = base.look.gain, base.look.net
        for other in lines:
            g = other.look.estimate["frequency_hz"]
            k = round(g["median"] / f["median"])
            if other is base or other not in axis.findings or k < 2:
                continue
            apart = k * _breadth(base.look) + _breadth(other.look)
            if apart < HARMONIC_MOST * f["median"] and abs(g["median"] - k * f["median"]) < apart:
                harmonics.append(k)
                gain, worth = gain + other.look.gain, worth + other.look.net
                axis.findings.remove(other)
        if harmonics:
            harmonics += base.look.estimate.get("harmonics", [])
            estimate = {**base.look.estimate, "harmonics": sorted(set(harmonics))}
            axis.findings[axis.findings.index(base)] = replace(
                base, look=replace(base.look, gain=gain, net=worth, estimate=estimate)
            )


def _breadth(line: Look) -> float:
    """How far off the frequency may be, Hz: half the width of a band, three standard deviations of a line."""
    if "width_hz" in line.estimate:
        return float(line.estimate["width_hz"]["median"])
    return 3.0 * float(line.estimate["frequency_hz"]["sd"])


def _trained(look: Look, before: State, after: State, record: Record, split: int) -> State:
    """The line that the first half alone shows. A band has no column that it could show."""
    if look.shape is None:
        return after
    part = replace(record, present=record.present[:split])
    found = _line(before.first(split), part)
    if not found:
        return after
    f, own = _hz(found[0]), _hz(look)
    known = {regressor.name for regressor in before.regressors}

    def at_f(regressor: FittedColumn) -> FittedColumn:
        multiple = max(1, round(float(regressor.entry["frequency_hz"]) / own))
        return replace(regressor, values=pair(multiple * f, record).get(regressor.name[-4:], np.zeros(before.y.size)))

    return replace(
        after,
        regressors=tuple(regressor if regressor.name in known else at_f(regressor) for regressor in after.regressors),
    )


def _alike(a: Look, b: Look) -> bool:
    """Whether two lines are the same line, harmonics, or side bands."""
    f, g = sorted(map(_hz, (a, b)))
    times = g / f
    return abs(times - round(times)) < ONE_LINE or times < 1.0 + SIDE_BAND


def _pictures(look: Look) -> Sequence[str]:
    """A band about a frequency that wanders is a term of the noise, and no column."""
    return ("spectrum", "correlation") if "width_hz" in look.estimate else ("line", "evidence")


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    """A line half way between the slowest line looked for and the fastest, in octaves."""
    frequency = math.sqrt(TURNS_LEAST / record.time_s[-1] * 0.5 * record.rate_hz)
    found = columns.least(state, shape(state, record, frequency), "amplitude")
    return {**found, "frequency_hz": (frequency, "Hz")}


def _of_column(column: FittedColumn, c: Sequence[float]) -> dict[str, Any]:
    return {"frequency_hz": float(column.entry["frequency_hz"]), "amplitude": math.hypot(*c)}


def _advice(look: Look, record: Record) -> str:
    """A line of few turns may be a drift. A line of fewer than four readings a turn is near half of the rate: it may be
    an alias of a faster line, and moves with the rate."""
    turns = _hz(look) * float(record.time_s[-1])
    if turns < SLOW_TURNS:
        beside = "" if "temperature" in record.channels else ", with the temperature at the sensor"
        return f"Record longer{beside}: {turns:.1f} turns hardly tell a line from a drift."
    few = record.recorded_hz < 4.0 * _hz(look)
    if few:
        return "Record at another rate: a line that moves is an alias."
    return "Look for what turns or switches at this frequency."


CAUSE = Cause(
    "periodic",
    "A periodic disturbance of one frequency is in the readings.",
    _advice,
    source="surroundings",
    looks=looks,
    at=in_common,
    pictures=_pictures,
    least=_least,
    grouping=Grouping(alike=_alike, settle=_settle),
    score=Scored(anew=True, trained=_trained),
    written=Written(of_column=_of_column),
    simulated=Simulated(
        keys={
            "frequency_hz": Key(lambda s: 0.05, "periodic_frequency_hz"),
            "amplitude": Key(lambda s: 0.5 * s.n, "periodic_amplitude"),
        }
    ),
)
