"""Statistics of the innovations that show a misfit whatever its cause, and their bands by simulation.

Each is about normal under the model after its stated transformation. Its mean and spread there come from records that
are simulated from the fitted model with the recording's own length, gaps, lattice and limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import gammainc, gammaincc, log_ndtr, ndtr, ndtri, stdtr, stdtrit

from selfcal.base.grid import Array, Mask, Rows
from selfcal.likelihood.fit import Fit, Series, run
from selfcal.likelihood.state import State
from selfcal.likelihood.statemodel import Matrices, matrices
from selfcal.readings.lattice import WHITE_REMAINDERS

#: Simulated records a band rests on.
BAND_RECORDS = 48
#: Fewest simulated records that have a statistic.
RECORDS_LEAST = 8
#: Least spread of a statistic with few possible values: an ensemble may show a single value.
LEAST_SPREAD = {"longest_repeat": 0.25, "repeated_readings": 1.0, "commonest_reading": 1.0}
#: Times at least that the drift forgets in a record in which jumps are looked for.
FORGETS_LEAST = 50.0
#: Name of the statistic of a model that does not describe the readings at all.
SPREAD = "innovation_spread"
#: Samples of the blocks whose sums show slow correlation.
BLOCK_SIZES = (4, 16, 64, 256)
#: The longest averaging time of an Allan deviation is this part of a record.
ALLAN_PART = 8
#: Share of simulated records beyond which the tail of the most striking statistic is fitted.
TAIL = 1.0 / 3.0
#: Lags of the correlation, roughly a factor 1.6 apart.
LAGS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233, 377, 610, 987)


@dataclass(frozen=True)
class Statistic:
    """A statistic: `measured`, the simulated 0.5 and 99.5 % points, and the probability `p` of a value as extreme."""

    name: str
    measured: float
    q005: float
    q995: float
    p: float


@dataclass(frozen=True)
class JudgedStatistics:
    """Every statistic of a state against its band, the most striking first; `p`: probability that the most striking of
    a fitting record is as striking."""

    statistics: list[Statistic]
    p: float


def all_statistics(w: Array, y: Array | None, lsb: float, jumps: Callable[[Array], float] | None) -> dict[str, float]:
    """Every statistic of whitened residuals `w` [n] (NaN: missing) of readings `y` [n]; None: those are not as read."""
    present = np.isfinite(w)
    x = w[present]
    n = x.size
    if n < 50:
        return {}
    with np.errstate(over="ignore"):
        sd = float(x.std())
    if not 0.0 < sd < math.inf:
        return {SPREAD: math.inf}
    x = (x - x.mean()) / sd
    filled = np.where(present, (w - np.nanmean(w)) / sd, 0.0)
    # A longer echo is looked for in blocks.
    reach = max(min(1 + max(LAGS), n // 8), min(20_000, n // 4))
    power = _power(filled, reach)
    found = dict(_of_memory(filled, present, n, _lagged(power, reach) / math.sqrt(n)))
    clipped = np.clip(filled, -5.0, 5.0)
    for size in (32, 128, 512):
        if filled.size >= 4 * size:
            found[f"spectrogram_of_{size}_samples"] = _uneven(clipped, size)
    if jumps is not None:
        found["jumps_of_the_bias"] = jumps(clipped)
    found |= _of_sizes(x)
    found |= _over_the_record(x, filled, present)
    found |= _worst_band(power, n, w.size)
    return found if y is None else found | _of_readings(y, lsb)


def _of_memory(filled: Array, present: Mask, n: int, lagged: Array) -> Iterator[tuple[str, float]]:
    """Correlation of `n` residuals (missing: 0): `lagged` [lags] of each alone, of sums, and of Allan deviations."""
    for lag in LAGS:
        if lag < min(lagged.size, n // 8):
            yield f"innovation_lag{lag}", float(lagged[lag])
    yield "innovation_correlation_to_lag_20", _root(float((lagged[1:21] ** 2).sum()), min(20, lagged.size - 1))
    for size in BLOCK_SIZES:
        if n >= 60 * size:
            sums = np.add.reduceat(filled, np.arange(0, filled.size - size + 1, size))
            scale = math.sqrt(sums.size) * float(sums.var())
            for lag in (1, 2, 3, 5):
                yield f"innovation_lag{lag}_of_{size}_samples", float(sums[lag:] @ sums[:-lag]) / scale
    sizes = 2 ** np.arange(max(1, int(math.log2(n / ALLAN_PART)) + 1))
    for m, deviation in zip(sizes, allan_deviation(np.where(present, filled, np.nan), sizes), strict=True):
        if math.isfinite(deviation):
            yield f"allan_of_{m}_samples", _root(n * float(deviation) ** 2, n / float(m))
    # A reading that repeats what was before, however long before.
    yield "innovation_largest_correlation", _largest(lagged[4:] * np.sqrt(n / (n - np.arange(4, lagged.size))))


def _of_sizes(x: Array) -> dict[str, float]:
    """The distribution of residuals [n], and the spread of the noise level over the record."""
    n = x.size
    clipped = np.clip(x, -12.0, 12.0)
    squared = clipped * clipped
    found = {
        "innovation_excess_kurtosis": (float(squared @ squared) / n - 3.0) * math.sqrt(n / 24.0),
        "innovation_skewness": float(squared @ clipped) / n * math.sqrt(n / 6.0),
        "innovation_largest": _largest(x),
    }
    energies = np.minimum(squared, 16.0)
    variance = float(energies.var())
    for pieces in (8, 40, 200):
        size = n // pieces
        if size >= 10:
            energy = energies[: size * pieces].reshape(pieces, size).mean(axis=1)
            # In units of the pieces' own expected spread, from the fourth moment.
            spread = float(((energy - energy.mean()) ** 2).sum() / (variance / size))
            found[f"noise_level_of_{pieces}_pieces"] = _root(spread, pieces - 1)
    return found


def _over_the_record(x: Array, filled: Array, present: Mask) -> dict[str, float]:
    """Correlation of the magnitudes of residuals `x` [n], and their level: means of pieces against white noise."""
    n = x.size
    # Magnitudes, not squares: their products have no heavy tail.
    magnitude = np.minimum(np.abs(filled), 3.5)
    magnitude = np.where(present, magnitude - magnitude[present].mean(), 0.0)
    scale = math.sqrt(n) * float(magnitude[present].var())
    count = min(101, n // 8)
    lagged = _lagged(_power(magnitude, count), count) / scale
    found = {f"innovation_magnitude_lag{lag}": float(lagged[lag]) for lag in (1, 3, 10, 30, 100) if lag < lagged.size}
    for pieces in (8, 40):
        size = n // pieces
        if size >= 10:
            means = x[: size * pieces].reshape(pieces, size).mean(axis=1) * math.sqrt(size)
            found[f"innovation_means_of_{pieces}_pieces"] = _root(float((means**2).sum()), pieces)
    return found


def _worst_band(power: Array, n: int, padded: int) -> dict[str, float]:
    """The spectrum in thirds of an octave. `padded`: samples with the missing samples, `n` of them are there."""
    worst: list[float] = []
    high = power.size - 1
    while high > 8:
        low = max(1, int(high / 2 ** (1.0 / 3.0)))
        if high - low < 4:
            break
        # The padding makes a few more points of as much information.
        points = (high - low) * padded / (2 * (power.size - 1))
        worst.append(_root(2.0 * float(power[low:high].mean()) / n * points, 2.0 * points))
        high = low
    return {"spectrum_worst_third_octave": max(worst, key=abs)} if worst else {}


def _of_readings(y: Array, lsb: float) -> dict[str, float]:
    """Readings `y` [n] that repeat, and how their codes on a lattice `lsb` are used."""
    # The codes of the lattice: sums in floating point differ in the last digit.
    codes = y if lsb <= 0.0 else np.rint((y - y[np.argmax(np.isfinite(y))]) / lsb)
    # Readings that repeat the reading before, beyond those that repeat an earlier reading: these do by chance.
    equal = [int((codes[k:] == codes[:-k]).sum()) for k in (1, 2, 3, 4)]
    usual = sum(equal[1:]) / 3.0
    found = {"repeated_readings": (equal[0] - usual) / math.sqrt(max(1.0, (sum(equal) / 3.0)))}
    if lsb <= 0.0:
        # Without a lattice, or on a lattice of several steps, no reading is much commoner than the next.
        _, counts = np.unique(y[np.isfinite(y)], return_counts=True)
        first, second = np.sort(counts)[:-3:-1] if counts.size > 1 else (counts[0], 0)
        found["commonest_reading"] = float(first - second) / math.sqrt(float(first + second)) if sum(equal) else 0.0
        return found
    changes = np.flatnonzero(np.diff(codes, prepend=np.nan) != 0.0)
    found["longest_repeat"] = math.log(int(np.diff(np.append(changes, codes.size)).max()))
    read = codes[np.isfinite(codes)].astype(np.int64)
    odd = int((read & 1).sum())
    # Beyond two steps of the lattice in the noise of a reading its level does not decide.
    if 0.5 * float(np.diff(read).std()) > math.sqrt(2.0):
        # A code that never comes leaves its readings to others: more pairs are equal than differ by little.
        apart = np.concatenate([np.abs(codes[k:] - codes[:-k]) for k in (1, 2, 3, 4)])
        same, near, next_ = (float((apart == k).sum()) for k in (0.0, 1.0, 2.0))
        found["equal_readings"] = (same - (4.0 * near - next_) / 6.0) / math.sqrt(max(1.0, 2.0 * same))
        found["odd_even_codes"] = (read.size - 2 * odd) / math.sqrt(read.size) if 0 < odd < read.size else 9.0
    return found


def allan_deviation(y: Array, sizes: Rows) -> Array:
    """Allan deviation of y [n] (NaN: missing) for means of `sizes` samples. A pair of means counts if each has half of
    its samples. Pairs begin an eighth of a mean apart, in long records further."""
    good = np.isfinite(y)
    total = np.concatenate([[0.0], np.cumsum(np.where(good, y, 0.0))])
    count = np.concatenate([[0.0], np.cumsum(good)])
    found = np.full(len(sizes), np.nan)
    for k, m in enumerate(int(size) for size in sizes):
        every = max(1, m // 8, y.size // 100_000)
        last = y.size - 2 * m + 1
        first, middle, end = (slice(j * m, last + j * m, every) for j in range(3))
        before, after = count[middle] - count[first], count[end] - count[middle]
        both = (2 * before >= m) & (2 * after >= m)
        if np.count_nonzero(both) < 3:
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            step = (total[end] - total[middle]) / after - (total[middle] - total[first]) / before
        found[k] = math.sqrt(0.5 * float(np.mean(step[both] ** 2)))
    return found


def _uneven(x: Array, size: int) -> float:
    """How unevenly the power lies over time and frequency: the mean square of the spectrogram's cells.

    It is 2 for white noise. A line that wanders, or comes and goes, fills few cells. Pieces overlap by half."""
    pieces = np.lib.stride_tricks.sliding_window_view(x, size)[:: size // 2]
    cells = np.abs(rfft(pieces * np.hanning(size), axis=1)[:, 1:-1]) ** 2
    cells /= cells.mean()
    return (float((cells**2).mean()) - 2.0) * math.sqrt(cells.size / 20.0)


def jumps_of(answer: Array) -> Callable[[Array], float] | None:
    """Excess kurtosis of the scores of a step at every sample: a bias that jumps has some that are much larger.
    `answer` [n]: residuals to a unit step of the bias at the first sample. None where the drift forgets too seldom for
    a kurtosis. A long record is looked at in blocks."""
    block = max(1, answer.size // 20_000)
    count = answer.size // block
    g = answer[: count * block].reshape(count, block).sum(axis=1)
    forgets = count * (1.0 - float(g[1:] @ g[:-1]) / max(float(g @ g), 1e-300))
    if forgets < FORGETS_LEAST:
        return None
    padded = 2 * next_fast_len(count)
    spectrum, size = np.conj(rfft(g, padded)), np.sqrt(np.cumsum(g**2)[::-1])
    known = max(50, count - count // 20)  # a step near the end is known by few samples

    def jumps(x: Array) -> float:
        x = x[: count * block].reshape(count, block).sum(axis=1)
        scores = (irfft(rfft(x, padded) * spectrum, padded)[:count] / size)[:known]
        scores -= scores.mean()
        squared = scores**2
        return (float((squared**2).mean()) / float(squared.mean()) ** 2 - 3.0) * math.sqrt(forgets / 24.0)

    return jumps


def _power(x: Array, count: int) -> Array:
    """Power spectrum of `x`, padded for `count` lags of the correlation."""
    z = rfft(x, 2 * next_fast_len((x.size + count + 1) // 2))
    found: Array = z.real**2 + z.imag**2
    return found


def _lagged(power: Array, count: int) -> Array:
    """sum x_i x_(i+k) for k below `count`, from the padded power spectrum."""
    found: Array = irfft(power, 2 * (power.size - 1))[:count]
    return found


def _root(value: float, freedom: float) -> float:
    """A chi-square as a normal deviate (Wilson and Hilferty)."""
    a = 2.0 / (9.0 * freedom)
    return (math.cbrt(max(value, 1e-12) / freedom) - 1.0 + a) / math.sqrt(a)


def _largest(x: Array) -> float:
    """The largest of n as a normal deviate."""
    ln_p = math.log(2.0) + float(log_ndtr(-np.abs(x).max())) + math.log(x.size)
    p = -math.expm1(-math.exp(min(ln_p, 5.0)))
    return -float(ndtri(min(max(p, 1e-300), 1.0 - 1e-16)))


def simulated(state: State, random: np.random.Generator) -> Array:
    """A record of the fitted model, read out as the recording: gaps, lattice, limits, a counter's increments."""
    fit = state.best
    n = state.y.size
    if fit.quantized:  # the counter makes what remembers
        keep = np.array([name != "color" for name in fit.terms.names])
        m = matrices(replace(fit.terms, color=""), fit.theta[keep], fit.dt, fit.duration_s, state.block)
        white = fit.N_of_color**2 / fit.dt
    else:
        m = matrices(fit.terms, fit.theta, fit.dt, fit.duration_s, state.block)
        # Reading out on the lattice adds lsb^2 / 12, which the fitted white noise holds already.
        white = max(fit.sigma**2 * m.R - state.lsb**2 / 12.0, (0.05 * fit.sigma) ** 2 * m.R)
    lost = fit.sigma**2 * m.lost * (state.r - 1.0)
    y = np.sqrt(np.maximum(white * state.r + lost, 0.1 * white * state.r)) * random.standard_normal(n)
    y += states_of(m, np.sqrt(state.r), random) * fit.sigma
    y += fit.c @ state.series.columns
    if fit.quantized:
        y = _counted(y, fit, random, means=state.redrawn)
    y = np.where(np.isfinite(state.y), y, np.nan)
    if state.lsb > 0.0:
        y = np.rint((y + state.level) / state.lsb) * state.lsb - state.level
    return y


def _counted(y: Array, fit: Fit, random: np.random.Generator, *, means: bool) -> Array:
    """Readings of a counter that gains `y`. `means`: the increments show in no reading, but in what two remainders have
    in common. How far the counter gets within an increment decides that, and no fit knows it: it is drawn. Remainders
    are white where something else than the noise stirs the counter."""
    step = fit.increment / fit.dt
    if not means or fit.N_of_color**2 / fit.dt < WHITE_REMAINDERS * step**2:
        return np.asarray(y + np.diff(step * random.random(y.size + 1)))
    start, gain = random.random(2)
    total = np.floor(np.cumsum(y / step + gain) + start)
    return np.asarray((np.diff(total, prepend=0.0) - gain) * step)


def states_of(m: Matrices, level: Array, random: np.random.Generator) -> Array:
    """h x over n steps; `level` [n] scales white noise with memory. In the coordinates of F the states are processes of
    the first order, each filtered by itself. A moving average has no such process: e_i and e_(i-1)."""
    from scipy.signal import lfilter

    e = _half(m.Q) @ random.standard_normal((len(m.F), level.size))
    e[:, 0] = _half(m.P0) @ random.standard_normal(len(m.F))
    rest, out = np.ones(len(m.F), bool), np.zeros(level.size)
    if m.driver >= 0:
        e[m.driver] *= level
        if m.F[m.driver, m.driver] == 0.0:
            now, before = m.driver, m.driver + 1
            rest[[now, before]] = False
            out += m.h[now] * e[now] + m.h[before] * np.append(e[before, 0], e[now, :-1])
    poles, vectors = np.linalg.eig(m.F[np.ix_(rest, rest)])
    e = e[rest]
    for pole, weight, mixed in zip(poles, m.h[rest] @ vectors, np.linalg.inv(vectors), strict=True):
        held = np.flatnonzero(mixed)
        if pole.imag == 0.0:
            out += weight.real * lfilter([1.0], [1.0, -pole.real], mixed[held].real @ e[held])
        elif pole.imag > 0.0:  # the conjugate makes as much
            out += 2.0 * (weight * lfilter([1.0], [1.0, -pole], mixed[held] @ e[held])).real
    return out


def _half(covariance: Array) -> Array:
    """[d, d]: a root of a covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def whitened_of(state: State, y: Array) -> Array:
    """Residual innovations of a record under the fitted noise model, the coefficients refitted."""
    fit = state.best
    sums, white, _ = run(replace(state.series, y=y), fit.terms, fit.theta, innovations=True)
    c, _, rss = sums[0].coefficients()
    return (white[:, 0] - white[:, 1:] @ c) / math.sqrt(rss / sums[0].n)


def _step_response(series: Series, fit: Fit) -> Array:
    """Whitened innovations of a unit step once the filter has settled, over sigma."""
    n = series.y.size
    clean = Series(np.zeros(2 * n), series.dt, np.ones(2 * n), np.vstack([np.repeat([0.0, 1.0], n)]))
    _, white, _ = run(clean, fit.terms, fit.theta, innovations=True)
    return white[n:, 1] / fit.sigma


def _drawn(state: State, random: np.random.Generator, count: int) -> Iterator[tuple[Array, Array]]:
    """Residual innovations, and readings, of `count` records of the fitted model, read out as the recording.

    Without a lattice the innovations are white, and fitting the coefficients takes the columns' part out of them. That
    is drawn as it is. The readings then matter as far as no two are equal. A counter's noise is
    not normal."""
    if state.lsb > 0.0 or state.best.quantized:
        for _ in range(count):
            y = simulated(state, random)
            yield whitened_of(state, y), y
        return
    sums, white, _ = run(state.series, state.best.terms, state.best.theta, innovations=True)
    columns, inverse = np.nan_to_num(white[:, 1:]), sums[0].coefficients()[1]
    there = np.isfinite(state.y)
    for _ in range(count):
        w = np.where(there, random.standard_normal(there.size), 0.0)
        w -= columns @ (inverse @ (w @ columns))
        w = np.where(there, w / math.sqrt(float(w @ w) / sums[0].n), np.nan)
        yield w, w


def judged(state: State, seed: int = 0, count: int = BAND_RECORDS) -> JudgedStatistics:
    """Every statistic of the state against `count` records of its model."""
    jumps = jumps_of(_step_response(state.series, state.best))
    measured = all_statistics(state.whitened, None if state.redrawn else state.y, state.lsb, jumps)
    if SPREAD in measured:
        return JudgedStatistics([Statistic(SPREAD, measured[SPREAD], 0.9, 1.1, 0.0)], 0.0)
    rows = []
    for w, y in _drawn(state, np.random.default_rng(seed), count):
        found = all_statistics(w, None if state.redrawn else y, state.lsb, jumps)
        rows.append([found.get(name, math.nan) for name in measured])
    sample = np.array(rows).reshape(count, len(measured))
    usual = np.isfinite(sample).sum(axis=0) >= RECORDS_LEAST
    names = [name for name, kept in zip(measured, usual, strict=True) if kept]
    if not names:
        return JudgedStatistics([], 1.0)
    sample, value = sample[:, usual], np.array([measured[name] for name in names])
    # A statistic that some records do not have is usual in those.
    sample = np.where(np.isfinite(sample), sample, np.nanmean(sample, axis=0))
    least = np.array([LEAST_SPREAD.get(name, 0.05) for name in names])
    ln_p = _ln_tails(value[None], sample, least)[0]
    mean, sd = sample.mean(axis=0), np.maximum(sample.std(axis=0, ddof=1), least)
    half = -float(stdtrit(count - 1, 0.005)) * sd
    found_all = [
        Statistic(name, float(value[k]), float(mean[k] - half[k]), float(mean[k] + half[k]), math.exp(ln_p[k]))
        for k, name in enumerate(names)
    ]
    return JudgedStatistics(sorted(found_all, key=lambda statistic: statistic.p), _family(ln_p, sample, least))


def _ln_tails(values: Array, sample: Array, least: Array, *, own: bool = False) -> Array:
    """ln of the probability [r, k] of a statistic as extreme as `values` [r, k] in the ensemble `sample` [count, k].
    `own`: the values are the sample, and each is judged by the others."""
    n = len(sample) - own
    centre = sample.mean(axis=0)
    values, sample = values - centre, sample - centre
    sums = [(sample**power).sum(axis=0) - own * values**power for power in (1, 2, 3)]
    mean = sums[0] / n
    second = np.maximum(sums[1] / n - mean**2, 1e-300)
    third = sums[2] / n - 3.0 * mean * sums[1] / n + 2.0 * mean**3
    sd = np.maximum(np.sqrt(second * n / (n - 1.0)), least)
    # Student's t of a new value against the ensemble: its spread is known to 1 / sqrt(2 n).
    z = (values - mean) / (sd * math.sqrt(1.0 + 1.0 / n))
    size = np.abs(z)
    if n >= 200:
        # Type III of Pearson: the largest, the kurtosis and sums of squares have a long tail on one side.
        p = _pearson3_above(size, np.sign(z) * third / sd**3)
    else:
        p = np.where(size < 8.0, stdtr(n - 1, -size), ndtr(-np.minimum(0.8 * size, 37.0)))
    found: Array = np.minimum(0.0, math.log(2.0) + np.log(np.maximum(p, 1e-300)))
    return found


def _family(ln_p: Array, sample: Array, least: Array) -> float:
    """Probability that the most striking of all is as striking by chance: by each simulated record's own most striking
    statistic, judged by the other records, and an exponential tail beyond those."""
    chance = np.sort(-_ln_tails(sample, sample, least, own=True).min(axis=1))
    top = chance[round((1.0 - TAIL) * chance.size) :]
    beyond = -float(ln_p.min()) - float(top[0])
    if beyond <= 0.0:
        return float(np.mean(chance >= -float(ln_p.min())))
    return TAIL * math.exp(-beyond / max(1.0, float((top - top[0]).mean())))


def _pearson3_above(x: Array, skew: Array) -> Array:
    """P(X > x) of Pearson's type III, mean 0, variance 1: a gamma distribution of shape 4 / skew^2, shifted. The import
    of scipy.stats takes as long as all others of `diagnose`."""
    flat = np.abs(skew) < 1.6e-5
    safe = np.where(flat, 1.0, skew)
    beta = 2.0 / safe
    shape = beta**2
    gamma = np.maximum(beta * (x + shape / beta), 0.0)
    tail = np.where(safe > 0.0, gammaincc(shape, gamma), gammainc(shape, gamma))
    above: Array = np.where(flat, ndtr(-x), tail)
    return above
