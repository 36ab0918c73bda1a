"""White noise and random walk whose Allan deviation lies above a record's: what a filter that has no other law needs.

In x = N^2 and y = K^2 the Allan variance of the pair, x / tau + y tau / 3, is linear. That it lies above the record's
upper limit at every averaging time is a polygon, open upwards. The area between the curves in log-log is an integral of
the logarithm of a linear function, which is concave: its least value over the polygon is at a corner. So the corners
are all that has to be looked at.

The question is that of Lethander & Taylor, NAVIGATION 70(3), 2023.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from selfcal.base.grid import Array


def upper_limit(deviation: Array, freedom: Array, level: float) -> Array:
    """Upper limits [t] of the true Allan deviations with the probability `level`, each: measured `deviation` [t] with
    `freedom` [t] degrees of freedom, its square distributed as chi-square over them."""
    return np.asarray(deviation * np.sqrt(freedom / chdtri(freedom, level)))


def overbound(tau_s: Sequence[Array], limit: Sequence[Array]) -> tuple[float, float]:
    """N and K of the least area above the curves of all axes: `limit` [t] at `tau_s` [t]. NaN without a point."""
    tau, square = np.concatenate([*tau_s, []]), np.concatenate([*limit, []]) ** 2
    if tau.size == 0:
        return math.nan, math.nan
    white, walk = 1.0 / tau, tau / 3.0
    i, j = np.triu_indices(tau.size, 1)
    i, j = i[tau[i] != tau[j]], j[tau[i] != tau[j]]
    determinant = white[i] * walk[j] - white[j] * walk[i]
    x = np.concatenate(
        [(square[i] * walk[j] - square[j] * walk[i]) / determinant, [float((square / white).max()), 0.0]]
    )
    y = np.concatenate(
        [(white[i] * square[j] - white[j] * square[i]) / determinant, [0.0, float((square / walk).max())]]
    )
    inside = (x >= 0.0) & (y >= 0.0)
    x, y = x[inside], y[inside]
    # A corner is on its own two lines, but for rounding.
    above = np.all(np.outer(x, white) + np.outer(y, walk) >= square * (1.0 - 1e-9), axis=1)
    x, y = x[above], y[above]
    ln_tau = np.unique(np.log(tau))
    curve = np.log(np.outer(x, np.exp(-ln_tau)) + np.outer(y, np.exp(ln_tau) / 3.0))
    best = int(np.argmin(np.trapezoid(curve, ln_tau, axis=1))) if ln_tau.size > 1 else int(np.argmin(curve[:, 0]))
    return math.sqrt(float(x[best])), math.sqrt(float(y[best]))
