"""The equivalent ARMA form of the laws.

A random walk under white noise is ARIMA(0,1,1), Gauss-Markov under white noise ARMA(1,1). The parameters follow from
the coefficients; where the coefficients belong to no such sum there is no answer.
"""

from __future__ import annotations

import math

from selfcal.studies.methods.problem import Value, root


def of_coefficients(law: str, phi: float, theta: float, variance: float, dt_s: float) -> dict[str, Value]:
    """The parameters of y[k] - phi y[k-1] = e[k] + theta e[k-1], e of `variance`: the covariances of both sides at lags
    1 and 0. A random walk has phi = 1."""
    white = -theta * variance / phi if phi else math.nan
    step = (1.0 + theta**2) * variance - (1.0 + phi**2) * white
    parameters = {"N": root(white * dt_s)}
    if law == "random_walk":
        return parameters | {"K": root(step / dt_s)}
    stable = 0.0 < phi < 1.0
    parameters["sigma_m"] = root(step / (1.0 - phi**2)) if stable else Value(math.nan)
    return parameters | {"alpha": Value(-math.log(phi) / dt_s if stable else math.nan)}
