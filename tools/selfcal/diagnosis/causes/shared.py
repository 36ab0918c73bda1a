"""Noise that two axes share: a common source reaches both, at every frequency or in a band.

The innovations of the two final models go together. Neither axis predicts the other, so no column enters a model, and
a module does not know of it. The gain is the joint log score of the pair less the sum of the single scores.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft

from selfcal.base.grid import Array, Rows
from selfcal.diagnosis.cause import Cause, Grouping, Scored, shown
from selfcal.diagnosis.causes.cross_axis import leaks, without_axis
from selfcal.diagnosis.finding import Diagnosed, Finding
from selfcal.diagnosis.record import Record
from selfcal.likelihood.columns import LN_EITHER
from selfcal.likelihood.state import ALIKE, NET_LEAST, Look, State, gain_for, net, normal_entry

#: Bands of an octave, and least bins of the spectrum in a band.
OCTAVE_PARTS, BINS_LEAST = 3, 16
#: Most standard deviations that an innovation counts as: an event on both axes is no noise.
CLIP = 4.0
#: Power of a line above the largest bin of noise, in units of the band's power; neighbours that are left out with it.
LINE_LEAST, LINE_HALF = 4.0, 2
#: Pieces of the record at most, over which the correlation must be steady.
STEADY_PIECES_MOST = 64
#: Least half width of a band of noise, as a share of its frequency, and in bins of the spectrum. A narrower band is a
#: disturbance of that frequency.
BROAD, BROAD_BINS = 0.02, 4.0
#: Share of a common source's gain that the innovations of two drifts may not show.
LOST = 0.1

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True)
class Pair:
    """Whitened innovations `u`, `v` [n] of two axes, `dt` s apart; 0 where either is missing. `present`: number of the
    others."""

    u: Array
    v: Array
    dt: float
    present: int

    @cached_property
    def raw(self) -> tuple[Spectrum, Spectrum]:
        """Spectra of both, 0 where a bin is left out. White noise has a mean power of 1 a bin."""
        both = [rfft(x) / math.sqrt(max(self.present, 1)) for x in (self.u, self.v)]
        kept = np.ones(both[0].size, bool)
        kept[0] = False
        if self.u.size % 2 == 0:
            kept[-1] = False
        line = math.log(kept.size) + LINE_LEAST
        for spectrum in both:
            power = np.abs(spectrum) ** 2
            for low, high in pairwise(self.edges):
                level = float(np.median(power[low:high])) / math.log(2.0)
                for at in low + np.flatnonzero(power[low:high] > line * level):
                    kept[max(0, at - LINE_HALF) : at + LINE_HALF + 1] = False
        return np.where(kept, both[0], 0.0), np.where(kept, both[1], 0.0)

    @cached_property
    def spectra(self) -> tuple[Spectrum, Spectrum]:
        """`raw` with a mean power of 1 in each band: a slope that a model leaves counts for nothing."""
        U, V = (
            spectrum / np.append(1.0, np.repeat(self._level(spectrum), np.diff(self.edges))) for spectrum in self.raw
        )
        return U, V

    def _level(self, spectrum: Spectrum) -> Array:
        """Root mean square of each band's bins that are not left out."""
        power = np.abs(spectrum) ** 2
        total, count = (np.add.reduceat(row, self.edges[:-1]) for row in (power, (power > 0.0).astype(float)))
        return np.sqrt(np.maximum(total, 1e-300) / np.maximum(count, 1.0))

    @cached_property
    def edges(self) -> Rows:
        """First bins of the bands, from the slowest to the fastest, and the end of the last."""
        edges = [self.u.size // 2 + 1]
        while edges[-1] > BINS_LEAST:
            low = min(int(edges[-1] / 2.0 ** (1.0 / OCTAVE_PARTS)), edges[-1] - BINS_LEAST)
            edges.append(low if low > BINS_LEAST else 1)
        return np.array(edges[::-1], np.int64)

    @cached_property
    def sums(self) -> tuple[Spectrum, Array, Array]:
        """Sums over the bins of each band: cross spectrum, product of both powers, bins."""
        U, V = self.spectra
        product = np.abs(U * V) ** 2
        rows = (U * np.conj(V), product, (product > 0.0).astype(float))
        cross, product, bins = (np.add.reduceat(row, self.edges[:-1]) for row in rows)
        return cross, product.real, bins.real


@dataclass(frozen=True)
class Common:
    """What a pair has in common: `coherence` (its sign and phase), `bins` it rests on, `gain` and `net` in nats:
    `searched` net of the search, `net` also with what its scatter over bins and pieces allows.
    `band`: bins of the spectrum, first and end; None: white noise."""

    coherence: complex
    bins: float
    gain: float
    net: float
    searched: float
    band: tuple[int, int] | None = None

    @property
    def correlation(self) -> float:
        """Size and sign."""
        return math.copysign(abs(self.coherence), self.coherence.real)


def pair_of(u: Array, v: Array, dt: float) -> Pair:
    """`Pair` of residual innovations with standard deviation 1 [n], NaN where they are missing."""
    both = np.isfinite(u) & np.isfinite(v)
    first, second = (np.where(both, np.clip(x, -CLIP, CLIP), 0.0) for x in (u, v))
    return Pair(first, second, dt, int(both.sum()))


def common(pair: Pair, ln_pairs: float = 0.0) -> Common | None:
    """White noise, or a band, whichever is the less likely by chance; None where neither could be judged."""
    edges = pair.edges
    if edges.size < 2 or pair.present < 4 * BINS_LEAST:
        return None
    cross, product, bins = (np.append(0.0, np.cumsum(row)) for row in pair.sums)
    low, high = np.triu_indices(edges.size, 1)
    many = bins[high] - bins[low]
    # Bins of a record with gaps depend on each other.
    free = many * pair.present / pair.u.size
    wide = free >= BINS_LEAST
    low, high, many, free = low[wide], high[wide], many[wide], free[wide]
    if not low.size:
        return None
    gamma = (cross[high] - cross[low]) / many
    scatter = np.maximum(product[high] - product[low], 1e-300)
    every = int(np.flatnonzero((low == 0) & (high == edges.size - 1))[0])

    def found(at: int, coherence: complex, freedom: int, ln_looks: float) -> Common:
        gain = float(_gain(free[at], coherence))
        # Few loud bins are no evidence for many: the scatter of the products decides.
        sure = min(gain * (1.0 - 1.0 / float(free[at])), float(loud[at]) * abs(coherence / gamma[at]) ** 2)
        band = None if freedom == 1 else (int(edges[low[at]]), int(edges[high[at]]))
        price = ln_pairs + LN_EITHER + ln_looks
        return Common(coherence, float(free[at]), gain, net(sure, freedom, price), net(gain, freedom, price), band)

    loud = np.abs(gamma) ** 2 * many * free / scatter
    white = found(every, complex(gamma[every].real), 1, 0.0)
    sure = np.minimum(_gain(free, gamma), loud)
    sure[every] = 0.0
    at = int(np.argmax(sure))
    narrow = found(at, complex(gamma[at]), 2, math.log(many.size))
    best = white if white.net >= narrow.net else narrow
    return replace(best, net=min(best.net, _steadiness(pair, best)))


def _gain(bins: Array, coherence: Spectrum | complex) -> Array:
    """Gain of ln likelihood by a coherence over `bins` independent bins."""
    found: Array = -bins * np.log1p(-np.minimum(np.abs(coherence) ** 2, 1.0 - 1e-12))
    return found


def _steadiness(pair: Pair, found: Common) -> float:
    """Nats by the scatter of the correlation over pieces of the record: few loud times are no evidence for all."""
    U, V = pair.spectra
    first, end = found.band or (0, U.size)
    inside = np.zeros(U.size, bool)
    inside[first:end] = True
    turn = found.coherence / max(abs(found.coherence), 1e-300)
    u, v = (irfft(np.where(inside, spectrum, 0.0), pair.u.size) for spectrum in (U, V * turn))
    count = min(STEADY_PIECES_MOST, int(found.bins))
    parts = np.array([float(part.sum()) for part in np.array_split(u * v, count)])
    scatter = max(float(parts.std(ddof=1)) * math.sqrt(count), 1e-300)
    return 0.5 * (float(parts.sum()) / scatter) ** 2


def look(pair: Pair, found: Common, other: str) -> Look:
    """The finding of an axis whose noise goes together with that of `other`."""
    size = found.correlation
    sd = (1.0 - size**2) / math.sqrt(max(2.0 * found.bins, 1.0))
    share, share_sd = abs(size), sd
    estimate: dict[str, Any] = {"other": other, "correlation": normal_entry(size, sd, "1")}
    if found.band is not None:
        U, V = (np.abs(spectrum) ** 2 for spectrum in pair.raw)
        first, end = found.band
        inside = math.sqrt(float(U[first:end].sum() / U.sum()) * float(V[first:end].sum() / V.sum()))
        share, share_sd = share * inside, share_sd * inside
    estimate["share"] = normal_entry(share, share_sd, "1")
    if found.band is not None:
        hz = 1.0 / (pair.u.size * pair.dt)
        low = 0.0 if found.band[0] == 1 else found.band[0] * hz
        estimate["band_hz"] = [low, min(found.band[1] * hz, 0.5 / pair.dt)]
    return Look("shared", found.gain, found.net, estimate, {})


def carried_over(u: Array, v: Array, dt: float, split: int, estimate: Mapping[str, Any]) -> tuple[float, float]:
    """Joint log score a sample of the whitened innovations from `split` on, with the correlation before it, less the
    sum of the single scores; and its standard deviation."""
    before, after = pair_of(u[:split], v[:split], dt), pair_of(u[split:], v[split:], dt)
    band = estimate.get("band_hz")

    def bins(pair: Pair) -> slice:
        if band is None:
            return slice(1, None)
        hz = 1.0 / (pair.u.size * dt)
        return slice(max(1, round(band[0] / hz)), max(2, round(band[1] / hz)))

    U, V = (spectrum[bins(before)] for spectrum in before.spectra)
    gamma = complex(np.vdot(V, U)) / max(float(np.linalg.norm(U) * np.linalg.norm(V)), 1e-300)
    gamma = gamma if band is not None else complex(gamma.real)
    square = float(min(abs(gamma) ** 2, 1.0 - 1e-12))
    U, V = (spectrum[bins(after)] for spectrum in after.spectra)
    power = np.abs(U) ** 2 + np.abs(V) ** 2
    scores = -math.log1p(-square) - (square * power - 2.0 * (np.conj(gamma) * np.conj(V) * U).real) / (1.0 - square)
    scores = scores[power > 0.0] / after.u.size
    return float(scores.sum()), float(scores.std()) * math.sqrt(scores.size)


def by_frequency(pair: Pair) -> tuple[Array, Array, Array]:
    """Frequency, Hz, of each band; correlation in phase; and the standard deviation of chance."""
    cross, _, bins = pair.sums
    hz = np.sqrt(pair.edges[:-1] * pair.edges[1:].astype(float)) / (pair.u.size * pair.dt)
    free = np.maximum(bins * pair.present / pair.u.size, 0.5)
    return hz, cross.real / np.maximum(bins, 1.0), np.sqrt(0.5 / free)


def _settle(record: Record, found: Mapping[str, Diagnosed]) -> None:
    """Noise that two axes share, on both, with the evidence of the pair.

    An axis that is not in `found` has the model that it was fitted with at first."""
    states = {**record.axes, **{name: axis.state for name, axis in found.items()}}
    states = {name: state for name, state in states.items() if state.whitened.size and not state.below_lattice}
    pairs = [pair for pair in combinations(states, 2) if any(name in found for name in pair)]
    ln_pairs = math.log(max(1, len(pairs)))
    sources = Counter(other for _, other, _ in leaks(found))
    judged = {name: each for name, each in found.items() if name in states}
    for each in judged.values():
        _leaks(each, record, states, sources, ln_pairs)
    states |= {name: each.state for name, each in judged.items()}
    for names in pairs:
        one = states[names[0]]
        u, v = (record.calm(name, states[name].whitened) for name in names)
        pair = pair_of(u, v, one.dt)
        both = common(pair, ln_pairs)
        if both is None or both.net < NET_LEAST:
            continue
        hidden = next((found[name].hidden for name in names if name in found), None)
        upto = 0.5 / one.dt if both.band is None else both.band[1] / (pair.u.size * one.dt)
        if hidden is not None and hidden.explains(names[0], names[1:], upto):
            continue
        for name, other in (names, names[::-1]):
            if name in found:
                findings = found[name].findings
                last = max((finding.round for finding in findings if finding.look.changes), default=0)
                state, partner = states[name], states[other]
                seen = look(pair, both, other)
                own = [finding for finding in findings if _of_band(finding.look, seen, pair)]
                seen = replace(seen, gain=seen.gain + sum(finding.look.gain for finding in own))
                seen = replace(seen, net=seen.net + sum(finding.look.net for finding in own))
                findings.append(Finding(seen, last, state, state, partner=partner))
    for name, each in found.items():
        _accounted(name, each, found)


def _of_band(band: Look, shared: Look, pair: Pair) -> bool:
    """Whether the noise that two axes share is that of a band of either axis. The evidence for the band is then
    evidence for the source as well: over a model that has neither."""
    if band.cause != "periodic" or "width_hz" not in band.estimate or "band_hz" not in shared.estimate:
        return False
    centre, half = (float(band.estimate[key]["median"]) for key in ("frequency_hz", "width_hz"))
    low, high = shared.estimate["band_hz"]
    bins = half * pair.u.size * pair.dt
    return bool(low < centre < high and half > BROAD * centre and bins > BROAD_BINS)


def _accounted(name: str, axis: Diagnosed, found: Mapping[str, Diagnosed]) -> None:
    """Drop a dependence on another axis that no form explains where that axis leaks or shares a source. Seen from the
    axis that leaks, its coefficient differs from frequency to frequency."""
    known = {str(finding.look.estimate["other"]) for finding in axis.findings if "other" in finding.look.estimate}
    for other, two in found.items():
        if any(finding.look.estimate.get("other") == name for finding in two.findings):
            known.add(other)
    axis.findings[:] = [each for each in axis.findings if each.look.changes or each.look.shown_by not in known]


def _leaks(
    axis: Diagnosed, record: Record, states: Mapping[str, State], sources: Mapping[str, int], ln_pairs: float
) -> None:
    """Judge whether an axis that follows another shares a source with it instead.

    A leak has the same coefficient at all frequencies, the drift's included. A common source is in the noise alone.
    Whichever explains more stays, net of the searches: the best of many bands gains more than a coefficient does. A
    source that leaks into another axis as well is no longer looked for."""
    for finding in [finding for finding in axis.findings if finding.look.cause == "cross_axis"]:
        other = str(finding.look.estimate["other"])
        if other not in states:
            continue
        free = without_axis(axis.state, other)
        source = record.calm(other, states[other].whitened)
        both = common(pair_of(free.whitened, source, free.dt), ln_pairs)
        if both is None or both.net < NET_LEAST:
            continue
        search = max(0.0, finding.look.gain - finding.look.net)
        search -= math.log(len(states) - 1) if sources[other] > 1 else 0.0
        ahead = both.searched - (axis.state.best.ln_likelihood - free.best.ln_likelihood - search)
        if ahead > ALIKE:
            axis.findings.remove(finding)
            axis.state = free
        elif ahead > -max(ALIKE, LOST * both.gain):
            possible = tuple(dict.fromkeys((*finding.also_possible, "shared")))
            axis.findings[axis.findings.index(finding)] = replace(finding, also_possible=possible)


def _least(state: State, record: Record) -> dict[str, tuple[float, str]] | None:
    """The correlation of white noise with another axis."""
    pairs = len(record.axes) * (len(record.axes) - 1) // 2
    if not pairs:
        return None
    gain = NET_LEAST * gain_for(lambda gain: net(gain, 1, LN_EITHER + math.log(pairs)))
    return {"correlation": (math.sqrt(-math.expm1(-2.0 * gain / state.best.n)), "1")}


CAUSE = Cause(
    "shared",
    "Two axes share noise of a common source.",
    "Change the supply, then the mount: the noise that follows one of them comes from there.",
    source="surroundings",
    pictures=shown("together"),
    least=_least,
    grouping=Grouping(
        pairs=True,
        piece=lambda look, axes, jumps: (
            look.estimate["other"] in axes and look.estimate.get("band_hz", (1.0,))[0] == 0.0
        ),
        settle=_settle,
    ),
    score=Scored(together=carried_over),
)
