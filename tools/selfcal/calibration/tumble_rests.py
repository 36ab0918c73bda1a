"""Rests and turns of recordings: means in m/s^2 and rad/s with their times, and the samples between two rests."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from selfcal.base.errors import UserError
from selfcal.base.grid import Array, Mask, block_means, runs
from selfcal.base.units import factor
from selfcal.calibration.noise import LONG_S, Noise, drift, measured_noise, of_model, of_rest, rounding_variance
from selfcal.calibration.tumble_fit import Problem, TumbleFit, fit_tumble, linearized
from selfcal.logs.recording import Recording, bridged, check_column
from selfcal.model.file import Model
from selfcal.readings.lattice import step_of
from selfcal.readings.rest import LEVEL_PIECE_S, PIECES_LEAST, rest_of

ACCEL, GYRO = ("ax", "ay", "az"), ("gx", "gy", "gz")
UNITS = {**dict.fromkeys(ACCEL, "m/s^2"), **dict.fromkeys(GYRO, "rad/s")}
#: Time that is cut off a rest next to a motion, s: its first and last movement is below the noise of a piece.
SETTLE_S = LEVEL_PIECE_S
#: Shortest rest that is advised, s, and the most that the search for motion takes off both its ends, s.
REST_LEAST_S, CUT_S = 10.0, 6.0 * LEVEL_PIECE_S
#: Most rests: the fit is dense.
RESTS_MOST = 200
#: Number of pieces of a rest: the fewest whose differences show its drift.
REST_PIECES = PIECES_LEAST
#: Shares of a drift's mean square under a wide prior that are weighed: nearly four decades of its deviation, up to its
#: limit. Largest loss of ln of the likelihood, by a rest, against the share that suits it best.
PRIOR_SHARES, RESTLESS = 10.0 ** (1.5 - np.arange(0.0, 8.0, 0.75)), 10.0
#: Assumed time between two logs without stamps of a common clock, s.
BETWEEN_S = 60.0


@dataclass(frozen=True)
class Rest:
    """A rest: `log` and its time in it, s, its `begin_s` and `end_s` on the clock of all logs, `seconds` of readings
    in it; means `accel` [3], m/s^2, and `gyro` [3], rad/s, NaN without gyros; `temp`, degC, or NaN; `rounded` [6]:
    variance of the means by a lattice that the noise does not dither; `pieces` [REST_PIECES, 6]: means of parts."""

    log: int
    at_s: tuple[float, float]
    begin_s: float
    end_s: float
    seconds: float
    accel: Array
    gyro: Array
    temp: float
    rounded: Array
    pieces: Array


@dataclass(frozen=True)
class Turn:
    """Samples between the rest `first` and the rest behind it: `accel` [n, 3], m/s^2, and `gyro` [n, 3], rad/s, each
    `dt` s; lost samples are bridged. `unsure` [n, 3]: variance of `gyro` by that. `reason`: why the turn is left out,
    or ""."""

    first: int
    dt: float
    accel: Array
    gyro: Array
    unsure: Array
    temp: float
    reason: str = ""


@dataclass(frozen=True)
class Tumble:
    """All that the logs hold: `noise` by axis; `left_out`: rests that do not count, a line each."""

    rests: tuple[Rest, ...]
    turns: tuple[Turn, ...]
    noise: dict[str, Noise]
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def has_gyro(self) -> bool:
        """The logs have gyros; an axis that is not recorded weighs nothing."""
        return GYRO[0] in self.noise

    def wide(self, names: Sequence[str]) -> int:
        """Terms of the drift of axes whose prior spans decades; 0 without such an axis."""
        return max((len(self.noise[name].terms) for name in names if self.noise[name].wide), default=0)

    def with_drift(self, names: Sequence[str], shares: Array) -> Tumble:
        """With these shares [terms] of the wide drift of axes."""
        return replace(self, noise={**self.noise, **{name: self.noise[name].scaled(shares) for name in names}})

    def fitted(
        self, names: Sequence[str], problem_of: Callable[[Tumble], Problem], start: Array, mean: Array, prior: Array,
        held: Mask | None = None,
    ) -> tuple[TumbleFit, Tumble]:  # fmt: skip
        """The fit, and the tumble with the wide drift of axes as this log has it: posterior means of the variances of
        its terms. Before, each term by itself is as likely, and its deviation uniform. A prior of its logarithm would
        be decided by the least of PRIOR_SHARES, which no log contradicts (Gelman 2006). A rest in which the mount moved
        is no drift's: none counts for more than RESTLESS."""
        weighed, count = self, self.wide(names)
        if count:
            middle = self.with_drift(names, np.full(count, PRIOR_SHARES[PRIOR_SHARES.size // 2]))
            start = fit_tumble(problem_of(middle), start, mean, prior, held).theta
            tried = [[self.with_drift(names, share * term) for share in PRIOR_SHARES] for term in np.eye(count)]
            within = np.array([[tumble.within(names) for tumble in row] for row in tried])
            likely = np.maximum(within - within.max(axis=(0, 1)), -RESTLESS).sum(axis=2)
            problems = [[problem_of(tumble) for tumble in row] for row in tried]
            likely += [[linearized(p, start, mean, prior, held).evidence for p in row] for row in problems]
            weight = np.sqrt(PRIOR_SHARES) * np.exp(likely - likely.max())
            weighed = self.with_drift(names, weight @ PRIOR_SHARES / weight.sum())
        return fit_tumble(problem_of(weighed), start, mean, prior, held), weighed

    def _pieces(self, names: Sequence[str]) -> Iterator[tuple[int, Array, Array]]:
        """Number, pieces [REST_PIECES] and their covariance, less their common part, of each rest and axis."""
        for k, name in enumerate(ACCEL + GYRO):
            for n, rest in enumerate(self.rests if name in names else ()):
                edges = np.linspace(rest.begin_s, rest.end_s, REST_PIECES + 1)
                C = drift(self.noise[name], edges[:-1], edges[1:], rest.end_s)
                white = self.noise[name].white * REST_PIECES / rest.seconds + rest.rounded[k]
                if np.isfinite(rest.pieces[:, k]).all():
                    yield n, rest.pieces[:, k], C + white * np.eye(REST_PIECES)

    def within(self, names: Sequence[str]) -> Array:
        """ln of the likelihood of the differences between neighbouring pieces of each rest [n], but for a constant."""
        ln_likelihood, step = np.zeros(len(self.rests)), np.diff(np.eye(REST_PIECES), axis=0)
        for n, x, C in self._pieces(names):
            d, R = step @ x, step @ C @ step.T
            ln_likelihood[n] -= 0.5 * float(d @ np.linalg.solve(R, d) + np.linalg.slogdet(R)[1])
        return ln_likelihood

    def moved(self, names: Sequence[str]) -> Array:
        """Probability [n] that the halves of each rest are so far apart by chance, times the number of rests."""
        square, halves = np.zeros(len(self.rests)), np.repeat([-1.0, 1.0], REST_PIECES // 2)
        for n, x, C in self._pieces(names):
            square[n] += float((halves @ x) ** 2 / (halves @ C @ halves))
        return np.asarray(len(self.rests) * chi2.sf(square, len(names)))

    @property
    def accel(self) -> Array:
        """Means [n, 3] of the accelerometers, m/s^2."""
        return np.array([rest.accel for rest in self.rests])

    @property
    def temp(self) -> Array:
        """[n], degC; 0 where not all rests have a temperature."""
        temp = np.array([rest.temp for rest in self.rests])
        return temp if np.isfinite(temp).all() else np.zeros(temp.size)

    @property
    def has_temp(self) -> bool:
        """All rests have a temperature."""
        return all(math.isfinite(rest.temp) for rest in self.rests)

    @property
    def warmth(self) -> Array:
        """Temperatures [n] about their mean, degC."""
        return np.asarray(self.temp - self.temp.mean())

    @property
    def reference_s(self) -> float:
        """When the bias is to be known: the end of the last rest, s."""
        return float(self.end_s.max())

    @property
    def begin_s(self) -> Array:
        """[n], s."""
        return np.array([rest.begin_s for rest in self.rests])

    @property
    def end_s(self) -> Array:
        """[n], s."""
        return np.array([rest.end_s for rest in self.rests])


@dataclass(frozen=True)
class _Log:
    """A log on the clock of its fastest axes: its columns in the units used here, the same with straight lines over
    lost readings, the step of the lattice of each (0: none), its temperature, degC, NaN if unknown, and the rows of its
    rests."""

    recording: Recording
    begin_s: float
    own: dict[str, Array]
    whole: dict[str, Array]
    steps: dict[str, float]
    temp: Array
    rests: tuple[slice, ...]

    def seconds(self, rows: slice) -> float:
        """Seconds of readings in rows, of the axis that lost most."""
        return min(int(np.isfinite(values[rows]).sum()) for values in self.own.values()) / self.recording.rate_hz


def tumble_of(recordings: Sequence[Recording], model: Model, *, part_stated: bool) -> Tumble:
    """Rests and turns of logs in order of time. `part_stated`: the model is the part's own, and so is its range.
    Raises UserError where accelerometers are missing, or too many rests are there."""
    gyros = tuple(name for name in GYRO if all(name in recording.columns for recording in recordings))
    axes = ACCEL + gyros
    begins, notes = _begins(recordings)
    logs = [_log(recording, begin_s, axes) for recording, begin_s in zip(recordings, begins, strict=True)]
    if sum(len(log.rests) for log in logs) > RESTS_MOST:
        raise UserError(f"more than {RESTS_MOST} rests: choose a stretch with --start and --end")
    ranges = {name: _range(model, name) if part_stated else math.inf for name in axes}
    rows_of = [(log, rows) for log in logs for rows in log.rests]
    typical = {
        name: float(np.median([np.std(log.whole[name][rows]) for log, rows in rows_of])) if rows_of else 0.0
        for name in axes
    }
    rests: list[Rest] = []
    turns: list[Turn] = []
    left_out: list[str] = []
    for k, log in enumerate(logs):
        end = -1  # the row behind the rest before, if that rest counts
        for rows in log.rests:
            rest = _rest(k, log, rows)
            if reason := _unfit(log, rows, ranges, typical):
                where = f"{recordings[k].path}, " if len(logs) > 1 else ""
                left_out.append(f"rest of {where}{rest.at_s[0]:.6g} to {rest.at_s[1]:.6g} s: {reason}")
                end = -1
                continue
            if gyros and end >= 0:
                turns.append(_turn(log, end, rows.start, (rests[-1], rest), len(rests) - 1, ranges))
            rests.append(rest)
            end = rows.stop
    long_rest = None if part_stated else _long_rest(logs)
    noise = {name: _noise(logs, name, model, long_rest) for name in axes}
    for name in (gyro for gyro in GYRO if gyros and gyro not in axes):
        notes.append(f"{name} is not recorded: it has no number, and turns take three gyros")
        noise[name] = Noise(1e6, (), "")  # it weighs nothing
    return Tumble(tuple(rests), tuple(turns), noise, tuple(left_out), tuple(notes))


def _log(logged: Recording, begin_s: float, axes: tuple[str, ...]) -> _Log:
    """A log and its rests."""
    for name in ACCEL:
        check_column(logged, name, needed=": tumble takes ax, ay, az")
    clock = logged.columns[max(axes, key=lambda name: logged.clock_of(name).rate_hz)].clock
    recording = logged.along(*(name for name in axes if logged.columns[name].clock is clock))
    own = {name: recording.in_unit(name, UNITS[name]) for name in axes}
    steps = {name: step_of(values[np.isfinite(values)])[0] for name, values in own.items()}
    has_temp = "temp" in recording.columns
    temp = recording.in_unit("temp", "degC") if has_temp else np.full(recording.samples, math.nan)
    time = recording.time_s + recording.start_s
    whole = {name: bridged(values, time) for name, values in own.items()}
    columns = {name: replace(recording.columns[name], values=values) for name, values in whole.items()}
    motion = rest_of(replace(recording, columns=columns), axes)
    still = motion.still or ((float(time[0]), float(time[-1])),)
    rests = []
    for begin_rest, end_rest in still:
        begin = begin_rest + SETTLE_S * (begin_rest > time[0])
        end = end_rest - SETTLE_S * any(abs(a - end_rest) < 0.5 / recording.rate_hz for a, _ in motion.moved)
        first, behind = (int(k) for k in np.searchsorted(time, [begin, end]))
        if end - begin >= 2.0 * LEVEL_PIECE_S and behind - first >= REST_PIECES:
            rests.append(slice(first, behind))
    return _Log(recording, begin_s, own, whole, steps, temp, tuple(rests))


def _long_rest(logs: Sequence[_Log]) -> Recording | None:
    """The longest rest, if it identifies the law of the part."""
    long = [(log, rows) for log in logs for rows in log.rests if log.seconds(rows) >= LONG_S]
    if not long:
        return None
    log, rows = max(long, key=lambda stretch: stretch[0].seconds(stretch[1]))
    kept = np.zeros(log.recording.samples, bool)
    kept[rows] = True
    return log.recording.with_rows(kept)


def _noise(logs: Sequence[_Log], name: str, model: Model, long_rest: Recording | None) -> Noise:
    """White noise and drift of an axis: of a long rest, or of the model about the noise that the rests show. A model of
    the part itself needs no long rest."""
    if long_rest is not None and (noise := of_rest(long_rest, name, model, UNITS[name])) is not None:
        return noise
    pieces = []
    for log in logs:
        size = max(1, round(LEVEL_PIECE_S * log.recording.rate_hz))
        pieces += [block_means(log.whole[name][rows], size) for rows in log.rests]
    white = measured_noise(pieces, LEVEL_PIECE_S)
    return of_model(model, name, UNITS[name], None if white is None else math.sqrt(white))


def _begins(recordings: Sequence[Recording]) -> tuple[list[float], list[str]]:
    """When each log begins on a common clock, s, and what is assumed of it."""
    if len(recordings) == 1:
        return [0.0], []
    stamps = [recording.started_s for recording in recordings]
    if all(stamp is not None for stamp in stamps):
        begins = [float(stamp) for stamp in stamps if stamp is not None]
        ends = [begin + recording.duration_s for begin, recording in zip(begins, recordings, strict=True)]
        if all(end <= begin for end, begin in zip(ends, begins[1:], strict=False)):
            return [begin - begins[0] for begin in begins], []
    lengths = [recording.duration_s + BETWEEN_S for recording in recordings]
    note = f"the logs have no stamps of one clock: taken in the order given, {BETWEEN_S:g} s apart"
    return [float(begin) for begin in np.cumsum([0.0, *lengths[:-1]])], [note]


def _range(model: Model, name: str) -> float:
    """Range of an axis, in the unit used here."""
    group = model.group_of(name)
    return group.range * factor(group.unit, UNITS[name]) if group.range > 0.0 else math.inf


def _rest(number: int, log: _Log, rows: slice) -> Rest:
    """The means of rows of a log."""
    recording, own = log.recording, log.own
    time = recording.time_s
    cut = np.linspace(rows.start, rows.stop, REST_PIECES + 1).astype(int).tolist()

    def means(names: tuple[str, ...], part: slice) -> Array:
        present = [own[name][part][np.isfinite(own[name][part])] if name in own else np.zeros(0) for name in names]
        return np.array([values.mean() if values.size else math.nan for values in present])

    rounded = []
    for name in ACCEL + GYRO:
        step = log.steps.get(name, 0.0)
        scatter = float(np.var(log.whole[name][rows])) if name in own else 0.0
        rounded.append(rounding_variance(step, math.sqrt(max(scatter - step**2 / 12.0, 0.0))))
    begin, end = float(time[rows.start]), float(time[rows.stop - 1]) + 1.0 / recording.rate_hz
    return Rest(
        number,
        (begin + recording.start_s, end + recording.start_s),
        log.begin_s + begin,
        log.begin_s + end,
        log.seconds(rows),
        means(ACCEL, rows),
        means(GYRO, rows),
        float(np.mean(log.temp[rows])),
        np.array(rounded),
        np.array([means(ACCEL + GYRO, slice(a, b)) for a, b in itertools.pairwise(cut)]),
    )


def _unfit(log: _Log, rows: slice, ranges: dict[str, float], typical: dict[str, float]) -> str:
    """Why a rest does not count: an axis that is lost, at its range, or without its scatter of the other rests."""
    for name, values in log.own.items():
        if 2 * np.isfinite(values[rows]).sum() < rows.stop - rows.start:
            return f"more than half of its samples of {name} are missing"
    for name in ACCEL:
        part = log.own[name][rows]
        stuck = typical[name] > 0.5 * log.steps[name] and not np.nanstd(part) > 0.0
        if stuck or abs(float(np.nanmean(part))) >= ranges[name]:
            return f"{name} is clipped at {part[0]:.6g} m/s^2"
    return ""


def _turn(log: _Log, begin: int, end: int, ends: tuple[Rest, Rest], first: int, ranges: dict[str, float]) -> Turn:
    """Samples from the last of a rest to the first of the next rest; `ends`: the two rests."""
    rows = slice(begin - 1, end + 1)
    place = log.recording.clock.place[rows]
    place = place - place[0]
    values, unsure = np.zeros((2, place[-1] + 1, len(UNITS)))
    reasons = [f"{name} is not recorded" for name in GYRO if name not in log.own]
    for k, name in enumerate(UNITS):
        if name not in log.own:
            continue
        part = log.own[name][rows]
        if np.nanmax(np.abs(part), initial=0.0) >= ranges[name] or _flat(part, log.own[name], log.steps[name]):
            reasons.append(f"{name} clips in it")
        whole = np.full(place[-1] + 1, math.nan)
        whole[place] = part
        if 2 * np.isfinite(whole).sum() < whole.size:
            reasons.append(f"more than half of its samples of {name} are missing")
        for edge, rest in zip((0, -1), ends, strict=True):
            if math.isnan(whole[edge]):
                whole[edge] = (*rest.accel, *rest.gyro)[k]
        values[:, k], unsure[:, k] = _bridged(whole)
    dt, temp, reason = 1.0 / log.recording.rate_hz, float(np.mean(log.temp[rows])), next(iter(reasons), "")
    return Turn(first, dt, values[:, :3], values[:, 3:], unsure[:, 3:], temp, reason)


def _bridged(values: Array) -> tuple[Array, Array]:
    """Readings of an axis [n] with straight lines over the lost ones, and the variance of the rate that this leaves
    [n], put on a single sample of each gap. A line over a span misses a parabola by 2/3 of its sagitta; the mean square
    of the sagittas is that of all such spans of the turn, its noise included."""
    lost, variance = ~np.isfinite(values), np.zeros(values.size)
    values = bridged(values)
    for first, behind in runs(lost):
        span = behind - first + 1
        half = min((span + 1) // 2, (values.size - 1) // 2)
        sagitta = values[half:-half] - 0.5 * (values[: -2 * half] + values[2 * half :])
        variance[(first + behind) // 2] = (2.0 / 3.0 * span) ** 2 * float(np.mean(sagitta**2))
    return values, variance


def _flat(part: Array, values: Array, step: float) -> bool:
    """Whether readings of a turn [n] stop at the record's extreme: equal there, and their neighbours far off."""
    for extreme in (float(np.nanmax(values)), float(np.nanmin(values))):
        for first, behind in runs(part == extreme):
            beside = part[[max(first - 1, 0), min(behind, part.size - 1)]]
            # A turn clips at three readings in a row, three steps of the lattice from their neighbours.
            if behind - first >= 3 and np.abs(beside - extreme).min() > 3.0 * step:
                return True
    return False
