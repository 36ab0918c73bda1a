"""The textbook bank of Stepanov & Motorin (2017) and the recording simulator: host_sim/ compiled
(bindings/reference.cpp).

Nodes are arrays of one length m: `law` int32 (0 constant, 1 random walk, 2 Gauss-Markov: the order of model.LAWS;
beyond the paper's 3 flicker, 4 moving average, 5 random walk and Gauss-Markov: host_sim/textbook_bank.hpp), `drift`
(K in unit/s/sqrt(Hz), sigma_m or the flicker coefficient B in unit; not used by law 0), `alpha` (1/s, laws 2, 3 and
5; law 4: the spectral ratio), `sigma_v` (unit, per sample: N / sqrt(dt_s)), and `walk` (K of law 5, default 0). A
record is `y` float64[n] in its unit, NaN where a sample is missing, every `dt_s`; `r` float64[n] multiplies sigma_v^2,
None is 1. The bias x0 is normal with `bias_mean` and `bias_sd`. Regressors are `z` float64[n, p], p <= 6, finite where
y is, with coefficients c normal about 0 with `coefficient_sd` float64[p], in the unit of y per unit of each column.
Arguments that do not fit raise ValueError. All cores are used, the interpreter's lock is released.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]

TEMPERATURE_LSB: float
SUPPLY_LSB: float

def run_filters(
    y: _Floats,
    dt_s: float,
    bias_mean: float,
    bias_sd: float,
    law: NDArray[np.int32],
    drift: _Floats,
    alpha: _Floats,
    sigma_v: _Floats,
    r: _Floats | None = None,
    z: _Floats | None = None,
    coefficient_sd: _Floats | None = None,
    walk: _Floats | None = None,
) -> tuple[_Floats, _Floats, _Floats]:
    """One Kalman filter per node: ln p(Y | node) [m]; then, after the last sample, the mean [m, d + 1 + p] and
    covariance [m, d + 1 + p, d + 1 + p] of the state (drift, x0, c), where a drift has d = 1 state, under laws 3 to 5
    three, three and two. The laws of one call must agree in d."""

def run_bank(
    y: _Floats,
    dt_s: float,
    bias_mean: float,
    bias_sd: float,
    law: NDArray[np.int32],
    drift: _Floats,
    alpha: _Floats,
    sigma_v: _Floats,
    ln_prior: Sequence[float],
    after: Sequence[int],
    r: _Floats | None = None,
    z: _Floats | None = None,
    coefficient_sd: _Floats | None = None,
    walk: _Floats | None = None,
) -> tuple[_Floats, _Floats, _Floats, _Floats, _Floats, _Floats]:
    """The bank at t instants, `after` so many samples (ascending). `ln_prior`: ln of each node's prior probability, up
    to a constant.

    Returns weight [t, m] (equations 11 and 13: they sum to 1 over all nodes), probability [t, 6] of the laws (13), mean
    [t, 6, 3] and covariance [t, 6, 3, 3] of (drift, alpha, sigma_v) under each law (12, 14), and mean and variance [t,
    6] of x0 + drift + c z now under each law. A law of probability 0 has NaN moments.
    """

def innovations(
    y: _Floats,
    dt_s: float,
    bias_mean: float,
    bias_sd: float,
    law: int,
    drift: float,
    alpha: float,
    sigma_v: float,
    r: _Floats | None = None,
    z: _Floats | None = None,
    coefficient_sd: _Floats | None = None,
    walk: float = 0.0,
) -> _Floats:
    """Standardised innovations nu / sqrt(s) [n] of one node's filter, NaN where a sample is missing."""

class Scene:
    """See host_sim/simulator.hpp, as Axis."""

    seed: int
    rate_hz: float
    samples: int
    block: int
    filter_taps: int
    bank_block: int
    missing: int
    motion_intervals: int
    def __init__(self) -> None: ...

class Axis:
    law: int
    bias: float
    N: float
    K: float
    sigma_m: float
    alpha: float
    B: float
    spectral_ratio: float
    markov_ratio: float
    correlation_time_s: float
    range: float
    lsb: float
    temperature_coefficient: float
    supply_coefficient: float
    ramp_slope: float
    step_time_s: float
    step_amplitude: float
    periodic_frequency_hz: float
    periodic_amplitude: float
    flicker_B: float
    noise_lag1: float
    variance_time_s: float
    variance_ratio: float
    outlier_fraction: float
    motion_amplitude: float
    cross_axis: int
    cross_coefficient: float
    def __init__(self) -> None: ...

def simulate(scene: Scene, axes: Sequence[Axis]) -> tuple[_Floats, _Floats, _Floats, NDArray[np.bool_], list[float]]:
    """A recording: values [axes, samples] in each axis's unit, temperature [samples] in degC, supply [samples] in V,
    which samples are present [samples], and the true x0 + drift of each axis [axes] at the last sample."""

class Random:
    """SplitMix64 with Box-Muller normals: the same numbers on every machine."""

    def __init__(self, seed: int, stream: int) -> None: ...
    def uniform(self) -> float: ...
    def normal(self) -> float: ...
