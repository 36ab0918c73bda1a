"""Interval and missing samples from time stamps, by a likelihood.

Sample n was taken at n dt and stamped a little later; some samples have no stamp. Stamps may be rounded to a lattice. A
law says which n each stamp has; it costs the nats that write the stamps by it: the errors to a cell by the best
histogram, the missing samples, its numbers. The cheapest law is taken. The laws:

- an even grid, whose phase is followed where stamps jitter (`_phased`), or kept within the lattice (`_within`,
  `_exactly`);
- steps of whole intervals that stray from each other, as those of a timer that is set anew (`_stepped`);
- steps of any length, none of which is missing: random times, bursts of a bus, batches stamped by a nominal step. Their
  count alone is steady (`_counted`).

Grids are proposed by lines in the spectrum of the stamps. dt is the slope of the stamps against their n, always.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.ndimage import grey_closing, uniform_filter1d
from scipy.special import betaln, rel_entr

from selfcal.base.grid import Array, Mask, Rows

#: Rows of the head of a record, which decide on the law.
_HEAD_ROWS = 4000
#: Rows that show the phase of the first one.
_PHASE_ROWS = 512
#: Rows of a histogram in one of its cells.
_CELL_PLACES = 5
#: Lattice from which on stamps are coarse, in mean steps.
_COARSE_FROM = 0.25
#: Smallest cell of errors, in mean steps.
_CELL_LEAST = 1e-3
#: Evidence against a lattice that is no tick of a clock, nats. Ticks are 10^-k s, 2^-k s and _JIFFY_S.
_NO_TICK_NATS = 400.0
#: Tick of a clock of 250 Hz, s.
_JIFFY_S = 0.004
#: Largest evidence against the stated interval, nats.
_STATED_NATS_MOST = 20.0
#: Relative sd of the stated interval.
_STATED_SD = 0.005
#: Evidence of a line, a rhythm or a change of rate that is beyond chance, nats.
_SURE_NATS = 25.0
#: Evidence of the head below which the whole record decides between laws, nats.
_HEAD_NATS = 25.0
#: Largest evidence of a line, nats a row: rows of batches make lines as well.
_LINE_NATS_MOST = 0.1
#: Evidence below which another dt is as good, nats.
_AS_GOOD = 10.0
#: Change of rate within a record that the decoder follows, a share.
_WANDER = 3e-5
#: Rows of a piece over which a grid's phase is followed.
_PHASE_PIECE_ROWS = 100
#: Rows between late ones up to which they are early.
_EARLY_ROWS = 3
#: Number of grids proposed.
_GRIDS = 8
#: Number of harmonics of a grid's line.
_HARMONICS = 6
#: Band of a grid's line, in rates of the stamps.
_LINE_BAND = (0.9, 4.0)
#: Least ln of the power of a line over the power around it.
_LINE_LN_LEAST = 3.0
#: Least share of the steps on a grid that are one interval.
_ONES_LEAST = 0.05
#: Largest share of steps below half an interval, where each step strays.
_SHORT_MOST = 0.01
#: Rows of a record whose stamps make no line: all grids in _FEW_BAND are tried.
_FEW_ROWS = 64
#: Band of the grids of few rows, in rates of the stamps.
_FEW_BAND = (0.95, 1.4)
#: Steps of which one interval is taken, so that bursts of stamps and single gaps do not matter.
_RATE_STEPS = 20
#: Pieces of a record, at most, between which a change of rate is looked for.
_RATE_PIECES = 500
#: Share of an interval or a rate below which two count as one.
SAME_INTERVAL = 1e-6
#: Largest share of an interval, or of a tick of a clock, between the samples of one instant.
ONE_INSTANT = 0.01
#: Largest number of intervals of a record: beyond, it has no digits for one more.
_INTERVALS_MOST = 2.0 / float(np.finfo(np.float64).eps)
#: Share from which on the intervals show a change of rate; a crystal keeps 1e-4.
RATE_CHANGE_LEAST = 1e-3
#: Shortest pause between bursts, in usual steps.
_PAUSE_STEPS = 30.0
#: Shortest pause between bursts, in the longest step of a burst.
_PAUSE_RATIO = 3.0
#: Fewest samples of a burst.
_BURST_LEAST = 20
#: Least share of the time that short bursts take.
_AWAKE_LEAST = 0.05
#: Least share of the steps near the usual one, where bursts are short.
_EVEN_LEAST = 0.6
#: Shortest gap between steps of any length, in their time-weighted median.
_GAP_STEPS = 12.0
#: Errors about a line that are far off, in the median error.
_FAR_ERRORS = 6.0
#: Largest distance of overlapping batches from a steady count, in their length.
_STRAY_MOST = 5.0
#: Least share of the gaps that keep to a pattern.
_PATTERN_LEAST = 0.9
#: Gaps in a period of losses, at most.
_PATTERN_GAPS_MOST = 4


class Ambiguous(ValueError):
    """The stamps do not show the rate; the text says why."""


@dataclass(frozen=True)
class _Fit:
    """The interval of a law, s, the samples missing before each stamp, int64[n], and the nats that write the stamps.
    `rival`: another interval that is as good, 0 for none."""

    dt: float
    missing: Rows
    nats: float
    rival: float = 0.0


@dataclass(frozen=True)
class _Stamps:
    """Stamps float64[n], s, and which steps [n - 1] are sleeps. `lattice`: what the stamps are rounded to, s, or 0;
    `typical`: the mean step, s; `noise`: of the lattice, s."""

    time: Array
    asleep: Mask
    lattice: float
    typical: float
    noise: float

    @property
    def cell(self) -> float:
        """What errors are written to, s."""
        return max(self.lattice, _CELL_LEAST * self.typical)

    @property
    def coarse(self) -> bool:
        """Whether the lattice hides single steps."""
        return self.lattice > _COARSE_FROM * self.typical

    @cached_property
    def slept(self) -> Array:
        """Time of pauses so far, beyond a usual step each, [n], s."""
        steps = np.diff(self.time)
        extra = np.where(self.asleep, steps - _usual(steps), 0.0)
        return np.concatenate(([0.0], np.cumsum(extra)))

    @cached_property
    def awake(self) -> Array:
        """The stamps without sleeps, [n], s."""
        return self.time - self.slept

    def multiple(self, dt: float) -> bool:
        """Whether an interval is a multiple of the lattice."""
        return self.lattice > 0.0 and _is_multiple(dt, self.lattice)

    def whole(self, dt: float) -> bool:
        """Whether an interval is a multiple of the lattice, or the lattice a multiple of the interval."""
        return self.multiple(dt) or _is_multiple(self.lattice, dt)

    def fit(self, dt: float, missing: Rows, errors: Array, patterned: bool = True) -> _Fit:
        """A law of the interval about `dt` with its errors, s, [n] or [n - 1], and the samples missing while awake."""
        n = self.time.size
        nats = _ln_losses((missing[1:] + 1)[~self.asleep], patterned) + self.ln_values(errors)
        if not self.whole(dt):
            nats += 3.0 * math.log(n) - 2.0 * math.log(math.pi)  # the lines of n pixels: about n^3 / pi^2
        return self.put_back(_Fit(dt, missing, nats))

    def ln_values(self, values: Array) -> float:
        """Nats that write values [n] to a cell by the best histogram, of cells 2^k wide at any of some places."""
        # The noise does not part values of a lattice.
        part = np.floor((np.sort(values - values.min()) + 4.0 * self.noise) * (_CELL_PLACES / self.cell) + 1e-6)
        first = np.flatnonzero(np.diff(part, prepend=-1.0))
        part, times, n = part[first], np.diff(first, append=part.size), part.size
        best, width, top = math.inf, float(_CELL_PLACES), float(part[-1])
        while True:
            for shift in (*(np.arange(_CELL_PLACES) * width / _CELL_PLACES), -(top + 1.0) % width):
                filled = np.floor((part + shift) / width)
                begin = np.flatnonzero(np.diff(filled, prepend=-1.0))
                counts = np.add.reduceat(times, begin)
                far = np.count_nonzero(np.diff(filled) > 1.0) * math.log(1.0 + top / width)
                best = min(
                    best,
                    n * math.log(width / _CELL_PLACES)
                    + float(counts @ np.log(n / counts))
                    + far
                    + 0.5 * counts.size * math.log(n),
                )
            if width > top:
                return best
            width *= 2.0

    def put_back(self, fit: _Fit) -> _Fit:
        """With the samples that are missing in the sleeps: no sleep moves the grid by more than half an interval."""
        if not self.asleep.any():
            return fit
        slept = np.rint(self.slept / fit.dt).astype(np.int64)
        missing: Rows = fit.missing + np.concatenate((slept[:1], np.diff(slept)))
        return _Fit(_slope(np.arange(missing.size) + np.cumsum(missing), self.time), missing, fit.nats)


def _is_whole(value: float) -> bool:
    """Whether a value is a whole number."""
    return abs(value - round(value)) < SAME_INTERVAL


def _is_multiple(length: float, unit: float) -> bool:
    """Whether a length is a whole multiple of another, 1 or more."""
    return round(length / unit) > 0 and _is_whole(length / unit)


def sampling(time: Array, noise_s: float, rate: float | None) -> tuple[float, Rows]:
    """Interval (s) and missing_before[n] of time stamps float64[n] (s, from 0, not decreasing but where batches of
    equal length overlap).

    `noise_s`: their rounding noise. `rate`: the stated rate (Hz) if there is one, which is a prior. Raises Ambiguous.
    A second at most but for coarse stamps: 10^6 rows take another second.
    """
    steps = np.diff(time)
    changes = rate_changes(time) if rate is None else []
    if changes:
        dt = 1.0 / max(max(change.before_hz, change.after_hz) for change in changes)
        return dt, np.concatenate(([0], np.maximum(0, np.rint(steps / dt).astype(np.int64) - 1)))
    stamps = _stamps(time, noise_s)
    if (steps < 0.0).any():
        law = _counted(stamps, stamps.typical)
        stray = time - np.arange(time.size) * law.dt
        if np.ptp(stray) > _STRAY_MOST * law.dt * time.size / np.count_nonzero(steps < 0.0):
            raise Ambiguous("the stamps fall, and their count is not steady")
    else:
        law = _likeliest(stamps, rate)
        if law.rival and rate is None:
            what = f"{1.0 / law.dt:.4g} from {1.0 / law.rival:.4g} Hz"
            raise Ambiguous(f"stamps of {stamps.lattice:.3g} s are too coarse to tell {what}")
    return law.dt, law.missing


def _stamps(time: Array, noise_s: float) -> _Stamps:
    """Stamps with their pauses, lattice and typical step. Raises Ambiguous."""
    time, steps = time - time[0], np.diff(time)
    usual = _usual(steps)
    if not time[-1] < _INTERVALS_MOST * usual:
        raise Ambiguous(f"a step of {float(steps.max()):.3g} s among others of {usual:.3g} s")
    asleep = _asleep(time, steps)
    pieces = np.linspace(0, steps.size, max(1, min(_BURST_LEAST, steps.size // _BURST_LEAST)) + 1).astype(int)
    awake = np.concatenate(([0.0], np.cumsum(np.where(asleep, usual, steps))))
    typical = float(np.median(np.diff(awake[pieces]) / np.diff(pieces))) or float(awake[-1]) / steps.size
    return _Stamps(time, asleep, common_step(steps, max(4.0 * noise_s, 1e-9 * typical)), typical, noise_s)


def _likeliest(stamps: _Stamps, rate: float | None) -> _Fit:
    """The law of the fewest nats: of the head of the stamps, and of close calls by all of them."""
    laws: list[tuple[_Law, float]] = [(_counted, stamps.typical)]
    head = replace(stamps, time=stamps.time[:_HEAD_ROWS], asleep=stamps.asleep[: _HEAD_ROWS - 1])
    for dt in _proposed(head, rate):
        laws += [(_stepped, dt), (_phased, dt)]
        laws += [(_within, dt), (_exactly, dt)] if stamps.coarse else []
    if stamps.coarse:
        laws.append((_within, _slope(np.arange(head.time.size), head.time)))
        if head.time.size < _FEW_ROWS:
            low, high = (edge / stamps.typical for edge in _FEW_BAND)
            laws += [(_within, 1.0 / hertz) for hertz in np.arange(low, high, 0.5 / stamps.time[-1]).tolist()]
    fits = [(nats, law, fit) for law, dt in laws for nats, fit in _tried(law, head, dt, rate)]
    least, _, best = min(fits, key=lambda fit: fit[0])
    if stamps.coarse and best.missing.any() and not stamps.whole(best.dt):
        same = 1e-3 + 4.0 * stamps.lattice / (head.time.size * best.dt)  # dt so far apart are the same to these rows
        others = (fit.dt for nats, _, fit in fits if nats < least + _AS_GOOD and abs(fit.dt / best.dt - 1.0) > same)
        best = replace(best, rival=next(others, 0.0))
    if stamps.time.size <= _HEAD_ROWS or best.rival:
        return best
    near = [(law, fit.dt) for nats, law, fit in fits if nats < least + _HEAD_NATS]
    # On a coarse lattice a clock that wanders over the record is written best by its count.
    near += [(_within, best.dt)] if stamps.coarse else [(_phased, best.dt), (_counted, stamps.typical)]
    of_all = [fit for law, dt in dict.fromkeys(near) for fit in _tried(law, stamps, dt, rate)]
    return min(of_all, key=lambda fit: fit[0], default=(0.0, _counted(stamps, stamps.typical)))[1]


def _tried(law: _Law, stamps: _Stamps, dt: float, rate: float | None) -> list[tuple[float, _Fit]]:
    """What stamps cost by a law, in nats with its price beforehand, and the fit; or nothing."""
    fit, q = law(stamps, dt), stamps.lattice
    if fit is None:
        return []
    nats = fit.nats
    if rate is not None:
        nats += min(_STATED_NATS_MOST, 0.5 * (math.log(fit.dt * rate) / _STATED_SD) ** 2)
    elif stamps.coarse and law is not _counted and not stamps.whole(fit.dt):
        # A lattice that is no tick of a clock is the interval.
        tick = abs(q / _JIFFY_S - 1.0) < SAME_INTERVAL or any(map(_is_whole, (math.log10(q), math.log2(q))))
        nats += 0.0 if tick else _NO_TICK_NATS
    return [(nats, fit)]


def _asleep(time: Array, steps: Array) -> Mask:
    """bool[n - 1]: the steps between stretches of samples, whatever they last. Bursts of a bus are as short, and less
    even."""
    usual = _usual(steps)
    # Samples that come at once after a step make up for it.
    long = (steps > _PAUSE_STEPS * usual) & (np.append(steps[1:], usual) > 0.5 * usual)
    count = int(np.count_nonzero(long))
    if not 0 < count * _BURST_LEAST < steps.size or np.median(steps[long]) < _PAUSE_RATIO * steps[~long].max():
        return np.zeros_like(long)
    even = np.mean(np.abs(steps - usual) < 0.5 * usual) > _EVEN_LEAST and usual * steps.size > _AWAKE_LEAST * time[-1]
    return long if even or 10 * count * _BURST_LEAST < steps.size else np.zeros_like(long)


def _ln_losses(steps: Rows, patterned: bool) -> float:
    """Nats that write steps of whole intervals [m]: samples lost singly, in runs, in runs of any length, or if
    `patterned` in a pattern of a few gaps."""
    n, lost = steps.size, int(steps.sum()) - steps.size
    if lost <= 0:
        return 0.0
    if np.count_nonzero(steps == 1) < _ONES_LEAST * n:
        return math.inf  # a grid of longer intervals
    gaps = np.flatnonzero(steps > 1)
    runs = steps[gaps] - 1
    begin = -float(betaln(gaps.size, n - gaps.size + 1))
    codes = [-float(betaln(lost, n)) - math.log(3.0), begin - float(betaln(gaps.size, lost - gaps.size + 1))]
    codes.append(begin + float(np.log(runs * (runs + 1.0)).sum()))
    for k, same in _periods(steps) if patterned and _PATTERN_GAPS_MOST * np.count_nonzero(steps == 1) > n else []:
        odd = np.count_nonzero(~same)
        codes.append((1.5 * (2 * k + odd)) * math.log(n) - (float(betaln(odd, same.size)) if odd else 0.0))
    return min(codes) + math.log(6.0)


# --------------------------------------------------------------------------------------------------------------- laws

#: A law of stamps, from about an interval, s; None where it has none.
_Law = Callable[[_Stamps, float], _Fit | None]


def _counted(stamps: _Stamps, _: float) -> _Fit:
    """Steps of any length, of which very long steps alone are gaps, unless samples that come at once make up for
    them."""
    time, index = stamps.awake, np.arange(stamps.time.size)
    steps, missing = np.diff(time), np.zeros(index.size, np.int64)
    ordered = np.sort(steps)
    half = float(ordered[np.searchsorted(np.cumsum(ordered), 0.5 * time[-1])])  # longer steps make half of the time
    gap = steps > _GAP_STEPS * half
    cuts: list[int] = (np.flatnonzero(gap) + 1).tolist()
    parts = np.split(time - index * _slope(index, time, cuts), cuts)
    # Arrival is late by a varying time, never early: the earliest of a few bursts are nearest to the clock.
    reach = max(1, round(10.0 * index.size / (np.count_nonzero(steps > stamps.typical) + 1)))
    lost = [
        float(after[:reach].min() - before[-reach:].min())
        if after[: 10 * reach].min() > before[-reach:].min() + stamps.typical
        else 0.0
        for before, after in pairwise(parts)
    ]
    dt = _slope(index, time, [cut for cut, seconds in zip(cuts, lost, strict=True) if seconds], trimmed=True)
    missing[cuts] = np.maximum(0, np.rint(np.array(lost) / dt)).astype(np.int64)
    kept = steps[~stamps.asleep]
    nats = stamps.ln_values(kept) + 3.0 * math.log(index.size) if kept.size else 0.0
    return stamps.put_back(_Fit(dt, missing, nats))


def _stepped(stamps: _Stamps, dt: float) -> _Fit | None:
    """Whole intervals that stray from each other."""
    steps, kept = np.diff(stamps.awake), ~stamps.asleep
    whole = np.maximum(1.0, np.rint(steps / dt))
    if np.mean(steps[kept] < 0.5 * dt) > _SHORT_MOST:
        return None
    dt = float(steps[kept].sum() / whole[kept].sum())
    missing = np.concatenate(([0], whole.astype(np.int64) - 1))
    # Holes between batches come in a pattern, and are no whole intervals: steps and errors depend on each other.
    return stamps.fit(dt, missing, (steps - whole * dt)[kept], patterned=False)


def _phased(stamps: _Stamps, dt: float) -> _Fit | None:
    """The nearest places of a grid whose phase and rate are followed over pieces of the record.

    A sample may be late, and none after it is then. Those in a row that are early, and late, share their place."""
    from scipy.optimize import isotonic_regression  # a quarter of a second to import: for grids that are followed alone

    index = np.arange(stamps.time.size)
    turns = followed_phase(np.ones(index.size), stamps.awake, 1.0 / dt, _PHASE_PIECE_ROWS)[0] - index
    ahead = np.rint(turns)
    ahead[1:] = grey_closing(ahead, _EARLY_ROWS)[1:]
    ahead = np.minimum.accumulate(ahead[::-1])[::-1]
    ahead = np.rint(isotonic_regression(np.clip(turns, ahead - 1.0, ahead + 1.0)).x).astype(np.int64)
    cuts = (np.flatnonzero(stamps.asleep) + 1).tolist()
    dt = _slope(index + ahead, stamps.awake, cuts, trimmed=True)
    fit = stamps.fit(dt, np.diff(ahead, prepend=ahead[0]), (turns - ahead) * dt)
    pieces = 0.5 * math.log(_PHASE_PIECE_ROWS) * (index.size // _PHASE_PIECE_ROWS)
    return replace(fit, nats=fit.nats + pieces - _ln_line(stamps, dt))


def _ln_line(stamps: _Stamps, dt: float) -> float:
    """Nats by which the stamps have a line at an interval that independent steps like theirs do not make: of those the
    power is exponential, about the spectrum of a renewal process."""
    if stamps.coarse:
        return 0.0
    power = abs(np.exp(2j * math.pi / dt * stamps.awake).mean()) ** 2 * stamps.time.size
    turn = complex(np.exp(2j * math.pi / dt * np.diff(stamps.awake)).mean())
    beyond = power / max(1.0, (1.0 - abs(turn) ** 2) / max(abs(1.0 - turn) ** 2, 1e-12)) - _SURE_NATS
    return float(min(max(0.0, beyond), _LINE_NATS_MOST * stamps.time.size))


def _within(stamps: _Stamps, dt: float) -> _Fit | None:
    """Samples that are stamped within a lattice step, of which the interval is no multiple."""
    fit = _decoded(stamps, dt, 1.0001)
    return None if fit is None or stamps.multiple(fit.dt) else fit


def _exactly(stamps: _Stamps, dt: float) -> _Fit | None:
    """Samples in whole lattice steps."""
    return _decoded(stamps, dt, 0.02) if stamps.multiple(dt) else None


def _decoded(stamps: _Stamps, dt: float, share: float) -> _Fit | None:
    """The law of samples that are stamped within a `share` of a lattice step, else None."""
    best, index, asleep = None, np.arange(stamps.time.size), np.append(False, stamps.asleep)
    slack, first = share * stamps.lattice, (0.0, share * stamps.lattice)
    for again in range(5):
        missing, odd = _decode(stamps.time, dt, slack, first)
        if odd > 0.05 * index.size + 3:
            break
        sample = index + np.cumsum(missing)
        # A sample lost at once leaves the first sample open; later samples show the phase.
        phase = float(np.median((stamps.time - sample * dt)[:_PHASE_ROWS])) + 0.5 * slack
        first = (phase - 0.1 * slack, phase + 0.1 * slack)
        fitted = _slope(sample, stamps.time)
        slopes = (fitted, _straightest(sample, stamps.time, fitted, stamps.lattice))
        awake = np.where(asleep, 0, missing)
        nats = min(stamps.fit(fitted, awake, stamps.time - sample * slope).nats for slope in slopes)
        if best is None or nats < best.nats:
            best = _Fit(fitted, missing, nats)
        elif again > 1:
            break
        dt = fitted if again else dt
    return best


def _decode(time: Array, dt: float, slack: float, first: tuple[float, float]) -> tuple[Rows, int]:
    """missing_before[n], and the number of stamps that fit nowhere. [lo, hi]: where the sample's true time can be;
    `first`: of the first sample."""
    missing = np.zeros(time.size, np.int64)
    stamps = time.tolist()
    lo, hi, odd = *first, 0
    down, up = dt * (1.0 - _WANDER), dt * (1.0 + _WANDER)
    for row in range(1, len(stamps)):
        stamp = stamps[row]
        end = stamp + slack
        lo += down
        hi += up
        if stamp > hi:
            gap = math.ceil((stamp - hi) / dt)
            missing[row] = gap
            lo += gap * dt
            hi += gap * dt
        if lo >= end:
            odd += 1
            lo, hi = stamp, end
        lo = max(lo, stamp)
        hi = min(hi, end)
    return missing, odd


def _proposed(stamps: _Stamps, rate: float | None) -> list[float]:
    """Intervals, s, of which the stamps may have a grid: of short steps, of the lattice, and of lines in the spectrum
    of the stamps. Lattice and jitter leave a line's harmonics, the lattice folds them."""
    intervals: list[float] = [] if rate is None else [1.0 / rate]
    steps, typical, q = np.diff(stamps.time)[~stamps.asleep], stamps.typical, stamps.lattice
    for short in np.quantile(steps[steps > 0.0], [0.02, 0.25]).tolist():
        dt = short
        for _ in range(4):
            dt = float(steps.sum() / np.maximum(1.0, np.rint(steps / dt)).sum())
        intervals.append(dt)
    low, high = _LINE_BAND[0] / typical, _LINE_BAND[1] / typical
    if stamps.coarse:
        high *= 0.5
        simple = q * np.concatenate([np.arange(1.0, 5.0), 1.0 / np.arange(2.0, 9.0)])
        intervals += simple[(simple * low < 1.0) & (simple * high > 1.0) | (simple == q)].tolist()
    cell = q if stamps.coarse else typical / 64.0
    time = stamps.time if stamps.coarse else stamps.awake
    ticks = np.rint(time[time < cell * 2.0**18] / cell).astype(np.int64)
    taken = np.bincount(ticks) - ticks.size / (int(ticks[-1]) + 1.0)
    size = 1 << (4 * taken.size).bit_length()
    power = np.log(np.abs(rfft(taken, size)) ** 2 + 1e-9 * ticks.size**2)
    power -= uniform_filter1d(power, min(257, 1 + size // 8))
    power[:8] = 0.0
    grid = np.arange(low, high, 0.25 / (size * cell))
    score = np.zeros(grid.size)
    for harmonic in range(1, _HARMONICS + 1):
        line = np.rint(harmonic * grid * cell * size).astype(np.int64) % size
        score += np.maximum(power[np.minimum(line, size - line)] - _LINE_LN_LEAST, 0.0)
    for _ in range(_GRIDS):
        top = int(score.argmax())
        if score[top] > 0.0:
            intervals.append(1.0 / float(grid[top]))
        score[max(0, top - 16) : top + 17] = 0.0
    return intervals


def rhythm(gaps: Rows) -> tuple[float, float]:
    """Evidence, nats net, that most gaps [k] are whole multiples of a period, and the period: near the median, or a
    part of the short ones. Chance spreads the gaps evenly over it."""
    if gaps.size < 2:
        return 0.0, 1.0
    gap, count = np.unique(gaps, return_counts=True)
    best = (0.0, 1.0)
    short, middle = np.quantile(gaps, [0.05, 0.5], method="lower")
    for start, part in ((middle, 1), (short, 1), (short, 2), (short, 3)):
        few, near = gap <= 3.5 * start, gap <= 1.5 * start
        period = float(np.average(gap[near], weights=count[near])) / part
        for some in [few] * 20 + [slice(None)]:
            times = np.maximum(1.0, np.rint(gap[some] / period))
            period = float(gap[some] @ count[some]) / float(times @ count[some])
        off = np.abs(gap - np.rint(gap / period) * period)
        order = np.argsort(off)
        share = np.minimum(1.0, np.cumsum(count[order]) / gaps.size)
        chance = np.minimum(1.0, (1.0 + 2.0 * off[order]) / period)
        each = np.where(
            share > np.maximum(chance, 0.5), rel_entr(share, chance) + rel_entr(1.0 - share, 1.0 - chance), 0.0
        )
        best = max(best, (float(each.max()) * gaps.size - math.log(4.0 * gaps.size), period))
    return best


def in_rhythm(rows: Rows) -> bool:
    """Whether rows are whole multiples of a period apart."""
    return rhythm(np.diff(rows))[0] > _SURE_NATS


def in_pattern(steps: NDArray[np.floating[Any]] | Rows) -> bool:
    """Whether the steps [n - 1] that are longer than an interval recur in periods of a few."""
    return any(np.mean(same) >= _PATTERN_LEAST for _, same in _periods(steps))


def _periods(steps: NDArray[np.floating[Any]] | Rows) -> list[tuple[int, Mask]]:
    """By the number of gaps in a period, which steps longer than an interval are as a period before."""
    rows = np.flatnonzero(steps > 1.0)
    each = np.stack([np.diff(rows), steps[rows[1:]]]) if rows.size > _BURST_LEAST else np.zeros((2, 0))
    periods = range(1, 1 + min(_PATTERN_GAPS_MOST, each.shape[1] - 1))
    return [(k, (each[:, k:] == each[:, :-k]).all(axis=0)) for k in periods]


def batches_overlap(time: Array) -> bool:
    """Whether stamps fall in a rhythm of some rows, and go on from there: batches overlap. Where rows are swapped they
    catch up."""
    steps = np.diff(time)
    rows = np.flatnonzero(steps < 0.0)
    around = time[np.minimum(rows + 4, time.size - 1)] - time[np.maximum(rows - 3, 0)]
    batches = 4 * rows.size < time.size and in_rhythm(rows)
    return batches and float(np.median(around)) < 6.0 * float(np.median(steps))


def _slope(index: Rows, time: Array, cuts: Sequence[int] = (), trimmed: bool = False) -> float:
    """The slope of `time` against `index` by least squares, with a level of its own after each of the rows `cuts`;
    `trimmed`: without the rows that are far off, such as those of a stall."""
    parts = len(cuts) + 1
    part = np.repeat(np.arange(parts), np.diff([0, *cuts, time.size]))
    kept = np.ones(time.size, bool)
    while True:
        count = np.maximum(np.bincount(part[kept], minlength=parts), 1)
        x, y = (each - (np.bincount(part[kept], each[kept], parts) / count)[part] for each in (index, time))
        slope = float(x[kept] @ y[kept] / (x[kept] @ x[kept]))
        if not trimmed:
            return slope
        off = np.abs(y - slope * x)
        near = kept & (off <= _FAR_ERRORS * float(np.median(off[kept])) + 1e-9)
        if (near == kept).all():
            return slope
        kept = near


def _straightest(sample: Rows, time: Array, dt: float, lattice: float) -> float:
    """The slope near `dt` about which the errors reach least far: of rounded stamps it is closer than least squares."""
    from scipy.optimize import minimize_scalar  # a quarter of a second to import: for coarse stamps alone

    around = lattice / max(1, int(sample[-1]))
    bounds, exact = (dt - around, dt + around), {"xatol": 1e-3 * around}
    reach = minimize_scalar(lambda slope: float(np.ptp(time - slope * sample)), bounds=bounds, options=exact)
    return float(reach.x)


def _usual(steps: Array) -> float:
    """The median of the steps that are no repeats."""
    return float(np.median(steps[steps > 0.0], overwrite_input=True))


@dataclass(frozen=True)
class RateChange:
    """The first `row` at another rate, its time since the first row, s, the rates before and after it, and the evidence
    in nats."""

    row: int
    time_s: float
    before_hz: float
    after_hz: float
    nats: float


def rate_changes(time: Array) -> list[RateChange]:
    """Every change of rate in stamps float64[n], s, in order of time: where the laws of the stamps on its two sides
    have another interval.

    A rate must last two pieces of n / _RATE_PIECES rows, of 3 * _RATE_STEPS. A rate that differs much: of
    _RATE_STEPS."""
    return _changes(time, 3 * _RATE_STEPS) or _changes(time, _RATE_STEPS)


def _changes(time: Array, least: int) -> list[RateChange]:
    """The changes between parts of some pieces, which have `least` rows or more."""
    size = max(least, time.size // _RATE_PIECES)
    if time.size < 6 * size:
        return []
    means = (time[_RATE_STEPS:] - time[:-_RATE_STEPS]) / _RATE_STEPS
    pieces = means[: means.size // size * size].reshape(-1, size)
    interval = np.quantile(pieces, 0.25, axis=1)  # a lost row makes windows longer, and few shorter
    if not interval.min() > 0.0:
        return []
    steps = np.diff(time)
    lattice = common_step(steps, 1e-6 * interval.min())
    value = np.log(interval)
    # The quantile of coarse stamps jumps by a step of their lattice.
    parts = _constant(value, max(RATE_CHANGE_LEAST, 1.5 * lattice / (_RATE_STEPS * interval.min())))
    if len(parts) < 2:
        return []
    level = [math.exp(float(np.median(value[a:b]))) for a, b in parts]
    # The longest step without a loss: stamps are rounded up at most to the next place of their lattice.
    longest = [
        max(1.5 * step, lattice * math.ceil(step / lattice - 1e-3) * 1.001 if lattice else 0.0) for step in level
    ]
    pairs = zip(pairwise(parts), pairwise(level), pairwise(longest), strict=True)
    rows = [0, *(_bend(time, *pair, size) for pair in pairs), time.size]
    if min(np.diff(rows)) < 2 * _RATE_STEPS:
        return []
    intervals = [_interval(time[a:b][:_HEAD_ROWS], lattice) for a, b in pairwise(rows)]
    unsure = 4.0 * lattice / min(intervals) / min(np.diff(rows)) ** 1.5  # four sd of a slope of rounded stamps
    scatter, changes = max(RATE_CHANGE_LEAST, _scatter(value, parts)), list[RateChange]()
    for row, (before, after) in zip(rows[1:-1], pairwise(intervals), strict=True):
        ratio = math.log(after / before)
        # A burst after a stall makes up for it: samples of the same rate, stamped late.
        late = steps[max(0, row - 3) : row + 2].max() > _RATE_STEPS * max(before, after)
        if late or abs(ratio) < max(0.5 * RATE_CHANGE_LEAST, unsure):
            return []
        nats = min(1e6, 0.5 * time.size * (ratio / scatter) ** 2)
        changes.append(RateChange(row, float(time[row] - time[0]), 1.0 / before, 1.0 / after, nats))
    return changes


def _interval(time: Array, lattice: float) -> float:
    """Interval of the samples of a part, s. On a coarse lattice a slower rate looks like losses in a pattern."""
    law = _likeliest(_stamps(time, 0.0), None)
    patterned = lattice > _COARSE_FROM * law.dt and in_pattern(law.missing + 1)
    return float(law.dt * (1.0 + law.missing[1:].mean())) if patterned else law.dt


def _constant(value: Array, least: float) -> list[tuple[int, int]]:
    """First piece and the piece after the last of every part of constant rate. `value` [pieces]: ln of the interval,
    whose changes are `least` or more. A piece with a change in it belongs to no part.

    The sum of squares about the levels of the parts, and a price for each part, is the least (optimal partition).
    """
    count = value.size
    total, square = (np.concatenate([[0.0], np.cumsum(each)]) for each in (value - value[0], (value - value[0]) ** 2))
    noise = max(float(np.median(np.abs(np.diff(value)))), 0.05 * RATE_CHANGE_LEAST)
    best, start = np.zeros(count + 1), np.zeros(count + 1, np.int64)
    for end in range(1, count + 1):
        begin = np.arange(end)
        cost = square[end] - square[:end] - (total[end] - total[:end]) ** 2 / (end - begin)
        each = best[:end] + cost / noise**2 + 2.0 * _SURE_NATS
        start[end] = int(each.argmin())
        best[end] = each[start[end]]
    ends = [count]
    while ends[-1] > 0:
        ends.append(int(start[ends[-1]]))
    parts = [(a, b) for a, b in pairwise(ends[::-1]) if b - a > 1]
    while len(parts) > 1:
        apart = np.abs(np.diff([float(np.median(value[a:b])) for a, b in parts]))
        join = int(apart.argmin())
        if apart[join] >= max(least, 6.0 * _scatter(value, parts)):
            break
        parts[join : join + 2] = [(parts[join][0], parts[join + 1][1])]
    return parts


def _scatter(value: Array, parts: list[tuple[int, int]]) -> float:
    """Distance from the level of its part that a tenth of the pieces exceeds, the largest of all parts of ten pieces
    and of all together."""
    off = [np.abs(value[a:b] - np.median(value[a:b])) for a, b in parts]
    return max(
        float(np.quantile(each, 0.9)) for each in [np.concatenate(off), *(each for each in off if each.size >= 10)]
    )


def _bend(
    time: Array, parts: Sequence[tuple[int, int]], level: Sequence[float], longest: Sequence[float], size: int
) -> int:
    """First row of the second of two parts [first piece, piece after], with intervals `level`, s, of the `longest`: the
    row farthest from the line of the mean interval, gaps left out."""
    (begin, a), (b, end) = parts
    first = max(0, (max(begin + 1, a - 1)) * size)
    last = min(time.size - 1, min(end, b + 2) * size + (_RATE_STEPS if end - b > 2 else 0))
    each = np.diff(time[first : last + 1])
    line = np.cumsum(np.where(each < max(longest), each - 0.5 * sum(level), 0.0))
    return first + 1 + int(np.argmax(line) if level[0] > level[1] else np.argmin(line))


def common_step(steps: Array, tolerance: float) -> float:
    """Step, s, of the lattice that all time stamps lie on: the steps are multiples of it. Else 0."""
    ordered = steps[steps > tolerance]
    ordered.sort()
    if ordered.size == 0:
        return 0.0
    starts = np.concatenate([[0], np.flatnonzero(np.diff(ordered) > tolerance) + 1])
    if starts.size > 1000:
        return 0.0
    distinct = np.add.reduceat(ordered, starts) / np.diff(starts, append=ordered.size)
    lattice = 0.0
    for step in distinct.tolist():
        rest = step
        while rest > 10.0 * tolerance:  # Euclid's algorithm
            lattice, rest = rest, abs(lattice - rest * round(lattice / rest))
    times = np.rint(distinct / lattice)
    if (np.abs(distinct - times * lattice) > np.maximum(10.0 * tolerance, ONE_INSTANT * lattice)).any():
        return 0.0
    return float(distinct @ times / (times @ times))


def followed_phase(x: Array, time: Array, frequency: float, block: int) -> tuple[Array, float]:
    """Phase [n], turns, of the line near a frequency in x [n] at these times, followed over blocks of `block` rows; and
    the size of the line. It is whole where x is largest."""
    edges = np.arange(0, max(1, x.size // block)) * block
    middle = np.add.reduceat(time, edges) / np.diff(edges, append=x.size)
    phase = frequency * time
    for _ in range(3):
        line = np.add.reduceat(x * np.exp(-2j * math.pi * phase), edges)
        turns = np.unwrap(np.angle(line)) / (2.0 * math.pi)
        slope = np.diff(turns) / np.diff(middle) if edges.size > 1 else np.zeros(1)
        phase = phase + np.interp(time, middle, turns)
        phase += slope[0] * np.minimum(time - middle[0], 0.0) + slope[-1] * np.maximum(time - middle[-1], 0.0)
    return phase, float(np.abs(np.add.reduceat(x * np.exp(-2j * math.pi * phase), edges)).sum())
