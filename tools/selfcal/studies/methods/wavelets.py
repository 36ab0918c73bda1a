"""The generalised method of wavelet moments (Guerrier et al., JASA 108, 2013), own and short.

The Haar wavelet variance at scale 2m is half the Allan variance at m readings. The fit weighs the differences between
the record's variances and the law's. First the weights are the record's own, scale by scale, then the inverse of the
covariance that the first fit implies. The interval is that of the second step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from selfcal.adequacy.allan import AllanTerms
from selfcal.base.grid import SLOPE_STEP, Array
from selfcal.model.laws import NAMED
from selfcal.studies.methods.problem import Answer, Problem, Value, inverse, logarithmic, maximum

#: Weights of a second difference of sums over m readings.
_SECOND = ((0, 1.0), (1, -2.0), (2, 1.0))


def covariance(terms: AllanTerms, m: Array, n: int) -> Array:
    """Covariance of the overlapping Allan variances [t, t] at `m` readings of a normal record of `n`: twice the sum of
    the squared covariances of the differences behind them."""
    covariance = np.empty((m.size, m.size))
    for i, a in enumerate(m.tolist()):
        for k, b in enumerate(m.tolist()[: i + 1]):
            first, second = n - 2 * int(a) + 1, n - 2 * int(b) + 1
            lag = np.arange(-(first - 1), second, dtype=float)
            cross = sum(p * q * terms.sums(lag + (v * b - u * a)) for u, p in _SECOND for v, q in _SECOND) / (a * b)
            pairs = np.minimum(np.minimum(lag + first, second - lag), min(first, second))
            covariance[i, k] = covariance[k, i] = 0.5 * float((pairs * cross**2).sum()) / (first * second)
    return covariance


def gmwm(problem: Problem) -> Answer:
    """Estimates by law. The method gives no weights of laws without a bootstrap, so none are stated."""
    (m, variance), n = problem.octaves(), problem.y.size
    own = np.diag(n / (2.0 * m * variance**2))
    by_law: dict[str, dict[str, Value]] = {}
    for law in problem.determined(m.size):

        def model(ln_theta: Array, law: str = law) -> Array:
            return problem.terms(law, ln_theta).allan_variance(m)

        def objective(weight: Array, ln_theta: Array, model: Callable[[Array], Array] = model) -> float:
            off = variance - model(ln_theta)
            return -0.5 * float(off @ weight @ off)

        first = maximum(partial(objective, own), problem.starts(law))
        weight = inverse(covariance(problem.terms(law, first.at), m, n))
        if not np.isfinite(weight).all():
            by_law[law] = {name: Value(value.value) for name, value in first.values(law).items()}
            continue
        theta = maximum(partial(objective, weight), [first.at]).at
        sides = [(model(theta + step), model(theta - step)) for step in np.eye(theta.size) * SLOPE_STEP]
        jacobian = np.array([up - down for up, down in sides]) / (2.0 * SLOPE_STEP)
        by_law[law] = logarithmic(NAMED[law].parameters, theta, inverse(jacobian @ weight @ jacobian.T))
    return Answer(by_law)
