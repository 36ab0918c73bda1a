"""Which pictures show a finding: measured against simulated, before the cause is in the model and after."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import detrend

from selfcal.base.grid import Array, Rows, runs
from selfcal.diagnosis.causes import CAUSES, shared
from selfcal.diagnosis.finding import Diagnosed, Finding
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.response import RECORDS
from selfcal.diagnosis.statistics import allan_deviation, simulated, whitened_of
from selfcal.likelihood.fit import run
from selfcal.likelihood.state import State
from selfcal.logs.recording import bridged
from selfcal.show.chart import POINTS_MOST, Band, Curve, Figure, Panel, envelope, means_of

#: Lags of the correlation, pieces of the noise level, bins of a histogram, frequencies on each side of a line.
LAGS_SHOWN, PIECES_SHOWN, HISTOGRAM_BINS, BINS_SHOWN = 30, 60, 61, 60

Summary = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class BeforeAfter:
    """A curve of a record and the band of the same curve in simulated records, before and after.

    `summary(y, w)` makes the curve [x.size] of readings y [n] and their residual innovations w [n]. It may differ
    between the two states. `whitened`: the summary reads w."""

    name: str
    caption: str
    x_label: str
    y_label: str
    x: Array
    states: tuple[State, State]
    summaries: tuple[Summary, Summary]
    whitened: bool = True
    log_x: bool = False
    log_y: bool = False
    marks: Sequence[float] = ()
    dots: bool = False
    stairs: bool = False


#: Curve of a state, and its band's lower and upper edge, by the picture's identity and the state's place.
_Pairs = dict[tuple[int, int], tuple[Array, Array, Array]]


def figures(diagnosed: Diagnosed, record: Record, factor: float, unit: str) -> tuple[list[Figure], list[list[Figure]]]:
    """Overview figures of an axis, and those of each of its findings in the order of its findings.

    `factor` turns the axis' inner unit into `unit`."""
    overview = [
        _allan(diagnosed.first, diagnosed.state, factor, unit),
        _spectrum(diagnosed.first, diagnosed.state, factor, unit),
    ]
    plans = [
        [
            picture
            for name in CAUSES[finding.look.cause].pictures(finding.look)
            for picture in _PICTURES[name](finding, finding.record or record, factor, unit)
        ]
        for finding in diagnosed.findings
    ]
    compared = [*overview, *(item for plan in plans for item in plan if isinstance(item, BeforeAfter))]
    pairs = _ensembles(compared)

    def figure(item: BeforeAfter | Figure) -> Figure:
        return item if isinstance(item, Figure) else _figure(item, pairs)

    sides = _sides(diagnosed, record, factor, unit)
    return [sides, *(figure(item) for item in overview)], [[figure(item) for item in plan] for plan in plans]


def _ensembles(items: Sequence[BeforeAfter]) -> _Pairs:
    """Every band. Each state is simulated once for all the pictures that need it: with a record in memory at a time."""
    jobs: dict[int, tuple[State, list[tuple[int, BeforeAfter]]]] = {}
    for item in items:
        for side, state in enumerate(item.states):
            jobs.setdefault(id(state), (state, []))[1].append((side, item))
    pairs: _Pairs = {}
    for state, wanted in jobs.values():
        random = np.random.default_rng(20)
        drawn: list[list[Array]] = [[] for _ in wanted]
        needs = any(item.whitened for _, item in wanted)
        for _ in range(RECORDS):
            y = simulated(state, random)
            w = whitened_of(state, y) if needs else y
            for curves, (side, item) in zip(drawn, wanted, strict=True):
                curves.append(item.summaries[side](y, w))
        for curves, (side, item) in zip(drawn, wanted, strict=True):
            measured = item.summaries[side](state.y, state.whitened)
            pairs[id(item), side] = measured, np.min(curves, axis=0), np.max(curves, axis=0)
    return pairs


def _figure(item: BeforeAfter, pairs: _Pairs) -> Figure:
    panels = []
    same = item.states[0] is item.states[1]
    for side, title in enumerate(("Model as it is",) if same else ("Before", "After")):
        measured, low, high = pairs[id(item), side]
        panels.append(
            Panel(
                title,
                item.x_label,
                item.y_label,
                [Curve("measured", item.x, measured, "dots" if item.dots else "measured")],
                [Band(f"range of {RECORDS} simulated records", item.x, low, high)],
                item.log_x,
                item.log_y,
                item.marks,
                item.stairs,
            )
        )
    return Figure(item.name, item.caption, panels)


def _unexplained(finding: Finding, record: Record, factor: float, unit: str) -> BeforeAfter | Figure:
    """The picture of the statistic that shows the finding."""
    name, state = finding.look.shown_by, finding.before
    if "allan" in name:
        return _allan(state, state, factor, unit)
    if "lag" in name:
        return _correlation(state, state, magnitude="magnitude" in name or "squared" in name)
    if "kurtosis" in name or "skewness" in name:
        return _histogram(state, state)
    if "largest" in name:
        return _largest(finding, record)
    if "noise_level" in name:
        return _level(finding, record)
    if "means" in name:
        return _level(finding, record, means=True)
    if "spectrum" in name:
        return _spectrum(state, state, factor, unit)
    return _histogram_of_readings((finding.before, finding.after), "How often each reading comes.", factor, unit)


def _allan(before: State, after: State, factor: float, unit: str) -> BeforeAfter:
    n = before.y.size
    most = max(2, n // 6)
    count = max(2, round(8 * math.log10(most)) + 1)
    sizes = np.unique(np.rint(np.logspace(0.0, math.log10(most), count)).astype(int))

    def summary(y: Array, w: Array) -> Array:
        return factor * allan_deviation(y, sizes)

    return BeforeAfter(
        "Allan deviation",
        "A slope of −1/2 is white noise, +1/2 a random walk, level ground flicker.",
        "averaging time, s",
        f"Allan deviation, {unit}",
        sizes * before.dt,
        (before, after),
        (summary, summary),
        whitened=False,
        log_x=True,
        log_y=True,
    )


def _power(y: Array, dt: float) -> tuple[Array, Array]:
    """Frequencies, Hz, and two-sided power density by a Hann window; gaps are bridged."""
    x = detrend(bridged(y))
    window = np.hanning(x.size)
    power = np.abs(rfft(x * window)) ** 2 * dt / float((window**2).sum())
    return rfftfreq(x.size, dt), power


def _spectrum(before: State, after: State, factor: float, unit: str) -> BeforeAfter:
    n, dt = before.y.size, before.dt
    frequency = rfftfreq(n, dt)
    first = min(3, frequency.size - 2)
    decades = math.log10(frequency[-1] / frequency[first])
    wanted = np.logspace(0.0, decades, max(4, round(24 * decades))) * frequency[first]
    edges = np.unique(np.searchsorted(frequency, wanted))
    edges = edges[edges < frequency.size - 1]
    size = np.diff(np.append(edges, frequency.size))

    def summary(y: Array, w: Array) -> Array:
        return factor * np.sqrt(np.add.reduceat(_power(y, dt)[1], edges) / size)

    return BeforeAfter(
        "Spectrum",
        "Level ground is the white noise density N.",
        "frequency, Hz",
        f"{unit}/sqrt(Hz)",
        np.add.reduceat(frequency, edges) / size,
        (before, after),
        (summary, summary),
        whitened=False,
        log_x=True,
        log_y=True,
    )


def _line(finding: Finding, factor: float, unit: str) -> BeforeAfter:
    """The spectrum close to a line."""
    state = finding.before
    f = float(finding.look.estimate["frequency_hz"]["median"])
    frequency = rfftfreq(state.y.size, state.dt)
    nearest = int(np.argmin(np.abs(frequency - f)))
    low, high = max(1, nearest - BINS_SHOWN), min(frequency.size, nearest + BINS_SHOWN + 1)

    def removed(state: State) -> Summary:
        effect = _effect(finding) if state is finding.after else np.zeros(state.y.size)
        return lambda y, w: factor * np.sqrt(_power(y - effect, state.dt)[1][low:high])

    return BeforeAfter(
        "Spectrum about the line",
        "After: the fitted line is subtracted from measured and simulated readings.",
        "frequency, Hz",
        f"{unit}/sqrt(Hz)",
        frequency[low:high],
        (finding.before, finding.after),
        (removed(finding.before), removed(finding.after)),
        whitened=False,
        marks=(f,),
    )


def _correlation(before: State, after: State, magnitude: bool = False) -> BeforeAfter:
    lags = min(LAGS_SHOWN, before.y.size // 4)

    def summary(y: Array, w: Array) -> Array:
        x = np.minimum(np.abs(w), 3.5) if magnitude else w
        x = np.nan_to_num(x - np.nanmean(x))
        size = next_fast_len(x.size + lags + 1, real=True)
        product = irfft(np.abs(rfft(x, size)) ** 2, size)[: lags + 1]
        return np.asarray(product[1:] / product[0])

    what = "magnitudes of the residual innovations" if magnitude else "residual innovations"
    return BeforeAfter(
        f"Correlation of the {what}",
        "A model that fits leaves no correlation between prediction errors.",
        "lag, samples",
        "correlation",
        np.arange(1.0, lags + 1.0),
        (before, after),
        (summary, summary),
        dots=True,
    )


def _pieces(record: Record, count: int) -> tuple[Rows, Array]:
    n = record.present.size
    edges = np.unique(np.linspace(0, n, min(count, max(1, n // 10)) + 1).astype(int))
    return edges, 0.5 * (edges[:-1] + edges[1:]) / record.rate_hz


def _level(
    finding: Finding, record: Record, means: bool = False, marked: bool = False, pieces: int = PIECES_SHOWN
) -> BeforeAfter:
    edges, middle = _pieces(record, pieces)
    size = np.sqrt(np.diff(edges))

    def summary(y: Array, w: Array) -> Array:
        return means_of(edges, w) * size if means else np.sqrt(means_of(edges, w * w))

    what = "Mean" if means else "Noise level"
    return BeforeAfter(
        f"{what} of the residual innovations",
        f"{what} of the prediction errors in {edges.size - 1} pieces of the record, in units of the expected one.",
        "time, s",
        "mean over its expected sd" if means else "rms over the expected sd",
        middle,
        (finding.before, finding.after),
        (summary, summary),
        marks=finding.look.when[: 1 + ("duration_s" in finding.look.estimate)] if marked and finding.look.when else (),
    )


def _largest(finding: Finding, record: Record) -> BeforeAfter:
    edges, middle = _pieces(record, POINTS_MOST // 2)

    def summary(y: Array, w: Array) -> Array:
        largest = np.maximum.reduceat(np.where(np.isfinite(w), np.abs(w), -1.0), edges[:-1])
        return np.asarray(np.where(largest < 0.0, np.nan, largest))

    return BeforeAfter(
        "Largest residual innovations",
        f"The largest prediction error in each of {edges.size - 1} pieces of the record. Gaps: samples kept out.",
        "time, s",
        "size over the expected sd",
        middle,
        (finding.before, finding.after),
        (summary, summary),
    )


def _histogram(before: State, after: State) -> BeforeAfter:
    edges = np.linspace(-8.0, 8.0, HISTOGRAM_BINS + 1)

    def summary(y: Array, w: Array) -> Array:
        counts = np.histogram(np.clip(w[np.isfinite(w)], -7.999, 7.999), edges)[0]
        return np.asarray(np.log10(np.maximum(counts, 0.3)))

    return BeforeAfter(
        "Histogram of the residual innovations",
        "Prediction errors over their expected sd; those beyond 8 are counted at 8. The lowest line is an empty bin.",
        "size over the expected sd",
        "log10 of the count",
        0.5 * (edges[1:] + edges[:-1]),
        (before, after),
        (summary, summary),
        stairs=True,
    )


def _lattice(finding: Finding, factor: float, unit: str) -> BeforeAfter:
    """Histogram of the readings; before, the model reads out on no lattice."""
    free = replace(finding.before, lsb=0.0)
    return _histogram_of_readings((free, finding.after), "Before: without a lattice.", factor, unit, finding.before.lsb)


def _limit(finding: Finding, factor: float, unit: str) -> BeforeAfter:
    """Histogram of the readings; before, the model reads out without a limit."""
    before = finding.before
    # The state after saturation holds clipped readings drawn anew: the readings are the record's own.
    states = (before, replace(finding.after, y=before.y))
    edge = float(finding.look.estimate["limit"]["median"]) - before.level
    return _histogram_of_readings(states, "How often each reading comes.", factor, unit, edge=edge)


def _histogram_of_readings(
    states: tuple[State, State], caption: str, factor: float, unit: str, lattice: float = 0.0, edge: float = math.inf
) -> BeforeAfter:
    """`lattice`: of the readings where it is to be seen; `edge`: the limit, less the level, that clips them after."""
    before, after = states
    y = before.y[np.isfinite(before.y)]
    sigma, lsb = before.best.sigma, max(before.lsb, lattice)
    low, high = float(y.min()), float(y.max())
    if high - low > 0.5 * HISTOGRAM_BINS * max(lsb, 0.2 * sigma):
        low, high = (float(value) for value in np.quantile(y, [0.001, 0.999]))
    if math.isfinite(edge):
        low, high = min(low, edge), max(high, edge)
    low, high = low - 0.5 * sigma - lsb, high + 0.5 * sigma + lsb
    if lsb > 0.0:
        # Whole codes a bin, about each code; four bins a code show that the readings lie on the codes alone.
        codes = max(1, math.ceil((high - low) / lsb / (2 * HISTOGRAM_BINS)))
        width = codes * lsb / (4 if lattice > 0.0 and codes == 1 else 1)
        first = math.floor((low + before.level) / lsb) * lsb - before.level
        edges = first + (np.arange(math.ceil((high - first) / width) + 1) - 0.5) * width
    else:
        edges = np.linspace(low, high, HISTOGRAM_BINS + 1)

    def counted(limit: float) -> Summary:
        def summary(y: Array, w: Array) -> Array:
            return np.histogram(np.clip(y[np.isfinite(y)], -limit, limit), edges)[0].astype(float)

        return summary

    return BeforeAfter(
        "Histogram of the readings",
        caption,
        f"reading less {factor * before.level:.6g}, {unit}" if before.level else f"reading, {unit}",
        "count",
        factor * 0.5 * (edges[1:] + edges[:-1]),
        (before, after),
        (counted(math.inf), counted(abs(edge))),
        whitened=False,
        stairs=True,
    )


def _together(finding: Finding) -> Iterator[Figure]:
    """How the noise of two axes goes together, by frequency."""
    state, two = finding.before, finding.partner
    if two is None:
        return
    hz, r, sd = shared.by_frequency(shared.pair_of(state.whitened, two.whitened, state.dt))
    yield Figure(
        "Correlation of two axes",
        f"Correlation in phase of the residual innovations of {state.axis} and {two.axis}, by third of an octave.",
        [
            Panel(
                "Measured",
                "frequency, Hz",
                "correlation",
                [Curve("measured", hz, r, "dots")],
                [Band("99 % of axes that share nothing", hz, -2.576 * sd, 2.576 * sd)],
                log_x=True,
            )
        ],
    )


def _missing(finding: Finding, record: Record) -> Figure:
    """Gaps in the stamps, and rows that the logger held."""
    edges, middle = _pieces(record, POINTS_MOST // 2)
    before, after = finding.before.y, finding.after.y
    held = np.append(False, np.diff(before) == 0.0) & ~np.isfinite(after)
    gone = held | ~record.present.astype(bool)
    gaps = runs(gone)
    longest = max((end - begin for begin, end in gaps), default=0)
    return Figure(
        "Missing samples",
        f"{np.count_nonzero(gone)} samples in {len(gaps)} gaps; the longest is of {longest} samples.",
        [Panel("Measured", "time, s", "missing, %", [Curve("missing", middle, 100.0 * means_of(edges, gone))])],
    )


def _effect(finding: Finding) -> Array:
    """Sum of the finding's columns in a reading [n], in the inner unit."""
    before = {column.name for column in finding.before.regressors}
    effect = np.zeros(finding.after.y.size)
    for k, column in enumerate(finding.after.regressors):
        if column.name not in before:
            effect = effect + float(finding.after.best.c[1 + k]) * column.values
    return effect


def _sides(diagnosed: Diagnosed, record: Record, factor: float, unit: str) -> Figure:
    """The record and a simulated record of the final model."""
    y = simulated(diagnosed.state, np.random.default_rng(20))
    panels = []
    for title, values in (("Measured", diagnosed.first.y), ("Simulated", y)):
        x, mean, low, high = envelope(record.time_s, values, POINTS_MOST)
        panels.append(
            Panel(
                title,
                "time, s",
                unit,
                [Curve("mean", x, factor * mean)],
                [Band("lowest to highest reading", x, factor * low, factor * high, "spread")],
            )
        )
    return Figure(
        "Readings",
        f"{_about(diagnosed.first, factor, unit)} Simulated: one record of the model with all findings.",
        panels,
    )


def _about(state: State, factor: float, unit: str) -> str:
    return f"Readings less {factor * state.level:.6g} {unit}." if state.level else "Readings."


def _series(finding: Finding, record: Record, factor: float, unit: str) -> Figure:
    """Means of the readings with the effect and without; single readings would hide it."""
    effect = _effect(finding)
    y = finding.before.y
    middle = float(np.nanmean(effect))
    panels = []
    for title, values, line in (
        ("Readings and fitted effect", y, effect),
        ("Readings less the effect", y - effect + middle, np.full(y.size, middle)),
    ):
        x, mean, _, _ = envelope(record.time_s, values, POINTS_MOST)
        _, fitted, _, _ = envelope(record.time_s, line, POINTS_MOST)
        shift = float(np.nanmean(mean)) - float(np.nanmean(fitted))
        panels.append(
            Panel(
                title,
                "time, s",
                unit,
                [
                    Curve("mean of the readings", x, factor * mean),
                    Curve("fitted effect", x, factor * (fitted + shift), "fitted"),
                ],
            )
        )
    length = y.size / record.rate_hz / panels[0].curves[0].x.size
    low, high = factor * float(np.nanmin(y)), factor * float(np.nanmax(y))
    caption = f"{_about(finding.before, factor, unit)} Means over {length:.3g} s; single ones: {low:.4g} to {high:.4g}."
    return Figure("Means of the readings", caption, panels)


def _evidence(finding: Finding, record: Record) -> Iterator[BeforeAfter]:
    """How the evidence for a column grows along the record: the score of its whitened form, in standard deviations."""
    effect = _effect(finding)
    if not np.ptp(effect) > 0.0:
        return
    count = 1 + len(finding.before.regressors)
    marks = np.unique(np.linspace(0, effect.size - 1, min(effect.size, POINTS_MOST // 2)).astype(int))

    def path(state: State) -> Summary:
        series = replace(state.series, columns=state.series.columns[:count]).beside(effect)
        white = np.nan_to_num(run(series, state.best.terms, state.best.theta, innovations=True)[1])
        z, others = white[:, -1], white[:, 1:-1]
        z = z - others @ np.linalg.lstsq(others, z, rcond=None)[0]
        z = z / max(float(np.linalg.norm(z)), 1e-300)
        return lambda y, w: np.cumsum(np.nan_to_num(w) * z)[marks]

    yield BeforeAfter(
        "Evidence along the record",
        "Sum of prediction errors times the effect's expected trace in them, in standard deviations of chance. "
        "A steady climb is an effect that acts all the time; one jump is a single event.",
        "time, s",
        "standard deviations",
        record.time_s[marks],
        (finding.before, finding.after),
        (path(finding.before), path(finding.after)),
        marks=finding.look.when[:1] if finding.look.when else (),
    )


#: The pictures by the names that causes give: of a finding, in a record, with the factor to a unit.
_PICTURES: Mapping[str, Callable[[Finding, Record, float, str], Iterable[BeforeAfter | Figure]]] = {
    "means": lambda finding, record, factor, unit: [_series(finding, record, factor, unit)],
    "evidence": lambda finding, record, factor, unit: _evidence(finding, record),
    "spectrum": lambda finding, record, factor, unit: [_spectrum(finding.before, finding.after, factor, unit)],
    "correlation": lambda finding, record, factor, unit: [_correlation(finding.before, finding.after)],
    "line": lambda finding, record, factor, unit: [_line(finding, factor, unit)],
    "allan": lambda finding, record, factor, unit: [_allan(finding.before, finding.after, factor, unit)],
    "marked_level": lambda finding, record, factor, unit: [_level(finding, record, marked=True)],
    "fine_level": lambda finding, record, factor, unit: [_level(finding, record, marked=True, pieces=POINTS_MOST // 2)],
    "largest": lambda finding, record, factor, unit: [_largest(finding, record)],
    "histogram": lambda finding, record, factor, unit: [_histogram(finding.before, finding.after)],
    "lattice": lambda finding, record, factor, unit: [_lattice(finding, factor, unit)],
    "limit": lambda finding, record, factor, unit: [_limit(finding, factor, unit)],
    "together": lambda finding, record, factor, unit: _together(finding),
    "missing": lambda finding, record, factor, unit: [_missing(finding, record)],
    "unexplained": lambda finding, record, factor, unit: [_unexplained(finding, record, factor, unit)],
}
