"""Whittle's likelihood on the cosine spectrum.

The cosine transform (DCT-II) of white noise and of a random walk has independent coefficients, so for these laws the
likelihood without the bias is exact. For Gauss-Markov it is Whittle's approximation. Coefficient k stands for the
frequency pi k / n a reading. Coefficient 0 holds the bias and is left out.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import fft

from selfcal.base.grid import Array
from selfcal.studies.methods.problem import Answer, Problem, information_criteria


def whittle(problem: Problem) -> Answer:
    """Maximum of Whittle's likelihood, intervals from its curvature, laws by AIC and BIC."""
    n = problem.y.size
    power = fft.dct(problem.y - problem.y.mean(), norm="ortho")[1:] ** 2
    omega = math.pi * np.arange(1, n) / n

    def objective(law: str, ln_theta: Array) -> float:
        spectrum = problem.terms(law, ln_theta).spectrum(omega)
        return -0.5 * float((np.log(spectrum) + power / spectrum).sum())

    peaks = problem.peaks(objective)
    criteria = information_criteria({law: peak.value for law, peak in peaks.items()}, n - 1)
    return Answer.of(peaks, criteria)
