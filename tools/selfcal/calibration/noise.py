"""White noise and drift of an axis, and the covariance of its means over intervals.

A mean over [a, e] has the white variance N^2 / (e - a), and the drift's since the reference time T, at which the bias
is to be known. T lies behind every interval. A walk moves by K^2 |t - T| from there; of a stationary Gauss-Markov drift
it is what m(t) - m(T) moves by.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import hyp1f1

from selfcal.adequacy.identify import identify_axis
from selfcal.bank.blocks import BLOCKS_LEAST
from selfcal.bank.priors import laid, noise_is_known
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.base.units import factor
from selfcal.logs.recording import Recording
from selfcal.model.file import Model, Prior
from selfcal.model.laws import Law

#: Shortest rest that identifies the law of the part, s.
LONG_S = 1200.0


@dataclass(frozen=True)
class DriftTerm:
    """A term of the drift with its probability in it: `square` is K^2 of a walk (`alpha` 0), or sigma_m^2."""

    square: float
    alpha: float = 0.0


@dataclass(frozen=True)
class Noise:
    """An axis: mean square of N, and the terms of its drift; unit^2 s and unit^2/s or unit^2. `words`: the source.
    `wide`: the terms are those of a prior that spans decades: residuals may show that they are less."""

    white: float
    terms: tuple[DriftTerm, ...]
    words: str
    wide: bool = False

    def scaled(self, shares: Array) -> Noise:
        """With these shares [terms] of the terms' variances, if their prior is wide."""
        if not self.wide:
            return self
        terms = zip(shares.tolist(), self.terms, strict=True)
        return replace(self, terms=tuple(DriftTerm(share * term.square, term.alpha) for share, term in terms))


def drift(noise: Noise, begin_s: Array, end_s: Array, reference_s: float) -> Array:
    """Covariance [n, n] of the drift's means over n intervals apart from each other, all before the reference time."""
    length, middle = end_s - begin_s, 0.5 * (begin_s + end_s)
    back, apart = reference_s - middle, np.abs(middle[:, None] - middle[None, :])
    same = np.eye(length.size, dtype=bool)
    covariance = np.zeros((length.size, length.size))
    for term in noise.terms:
        if term.alpha == 0.0:
            walk = np.minimum(back[:, None], back[None, :])
            walk[same] = reference_s - end_s + length / 3.0
            covariance += term.square * walk
            continue
        x = term.alpha * length
        mean = -np.expm1(-x) / x
        half = 0.5 * length
        gap = np.maximum(apart - half[:, None] - half[None, :], 0.0)
        between = np.exp(-term.alpha * gap) * mean[:, None] * mean[None, :]
        between[same] = hyp1f1(1.0, 3.0, -x)  # 2 (x - 1 + e^-x) / x^2
        to_end = np.exp(-term.alpha * (back - half)) * mean
        covariance += term.square * (between - to_end[:, None] - to_end[None, :] + 1.0)
    return covariance


def mean_square(prior: Prior) -> float:
    """Mean square of a parameter under its prior."""
    if prior.law == "log_normal":
        return prior.median**2 * math.exp(2.0 * prior.sd**2)
    low, high = prior.min, prior.max
    if prior.law == "log_uniform":
        return (high**2 - low**2) / (2.0 * math.log(high / low))
    return (high**3 - low**3) / (3.0 * (high - low))


def of_laws(
    laws: Mapping[str, Law], probability: Mapping[str, float], values: Mapping[str, Mapping[str, tuple[float, float]]]
) -> tuple[DriftTerm, ...]:
    """Terms of a mixture of laws. `values`: by law and parameter the mean square and the median. An oscillation counts
    as a Gauss-Markov drift of its period."""
    total, terms = sum(probability.values()), list[DriftTerm]()
    for name, share in probability.items():
        law, own = laws[name], values[name]
        if not law.terms or not share > 0.0:
            continue
        square = share / total * own[law.parameters[1]][0]
        sized = law.sized(math.sqrt(square), own[law.second][1] if law.second else 1.0)
        terms += [DriftTerm(term.variance, term.rate) for term in sized]
    return tuple(terms)


def of_model(model: Model, axis: str, unit: str, N: float | None) -> Noise:
    """The noise of an axis in `unit` by a model file. Where the file does not know the part's N, and `N`, in `unit`, is
    measured, the drift's priors are laid about it."""
    group = model.group_of(axis)
    size = factor(group.unit, unit)
    priors, words = group.priors, f"{model.name}"
    if not noise_is_known(group):
        words = f"not known: the prior of {model.name}, weighed by this log"
        priors = laid(priors, N / size) if N is not None else priors
    middle = {key: (mean_square(prior), prior.median) for key, prior in priors.items() if key != "bias"}
    terms = of_laws(model.laws, model.hypotheses, dict.fromkeys(model.laws, middle))
    white = size**2 * middle["N"][0] if N is None else N**2
    return Noise(
        white, tuple(DriftTerm(size**2 * term.square, term.alpha) for term in terms), words, not noise_is_known(group)
    )


def of_rest(recording: Recording, axis: str, model: Model, unit: str) -> Noise | None:
    """The noise of an axis by `identify` of a long rest, in `unit`; None where it has no answer."""
    try:
        identified = identify_axis(recording, axis, model, "library", None)
    except UserError:
        return None
    size = factor(identified.unit, unit) ** 2
    result = identified.result
    values = {
        law: {key: (estimate.mean**2 + estimate.sd**2, estimate.median) for key, estimate in own.items()}
        for law, own in result.parameters.items()
    }
    terms = of_laws(model.laws, result.probability, values)
    white = sum(share * values[law]["N"][0] for law, share in result.probability.items())
    return Noise(
        size * white,
        tuple(DriftTerm(size * term.square, term.alpha) for term in terms),
        f"{recording.duration_s:.0f} s at rest",
    )


def measured_noise(pieces: Sequence[Array], piece_s: float) -> float | None:
    """N^2 by the differences of neighbouring means of `piece_s` s within rests [k] each; None of too few."""
    steps = np.concatenate([np.diff(piece) for piece in pieces]) if pieces else np.zeros(0)
    steps = steps[np.isfinite(steps)]
    return float(np.mean(steps**2)) * 0.5 * piece_s if steps.size >= BLOCKS_LEAST else None


def rounding_variance(step: float, noise: float) -> float:
    """Variance of the mean of readings rounded to a lattice with noise of a sd too small to dither it: harmonics of
    the sawtooth (Widrow and Kollar, "Quantization Noise", 2008, chapter 4)."""
    if step <= 0.0:
        return 0.0
    k = np.arange(1, 20)
    return float((step**2 / (2.0 * math.pi**2 * k**2) * np.exp(-((2.0 * math.pi * k * noise / step) ** 2))).sum())
