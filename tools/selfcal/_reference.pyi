"""The textbook bank of Stepanov & Motorin (2017) and the recording simulator: host_sim/ compiled
(bindings/reference.cpp).

A law is a tuple (`laws.Law.as_tuple`). Nodes are arrays of one length m: `hypothesis` int32 (index into the laws),
`drift` (K in unit/s/sqrt(Hz) if the law has a walk, else sigma_m or B in unit; not used without terms), `second` (alpha
in 1/s, or the law's ratio), and `sigma_v` (unit, per sample: N / sqrt(dt_s)). The states of a drift are its terms in
order (one that stays 0 without any), with a `block` of several samples the mean of each over the block, and e_i,
e_(i-1) of coloured noise. A
record is `y` float64[n] in its unit, NaN where a sample is missing, every `dt_s`; `r` float64[n] multiplies sigma_v^2,
None is 1. `y` is the mean of `block` samples of drift and white noise, at whose instants the drift is a point. The
bias x0 is normal with `bias_mean` and `bias_sd`. Regressors are `z` float64[n, p], p <= 6, finite where
y is, with coefficients c normal about 0 with `coefficient_sd` float64[p], in the unit of y per unit of each column.
Arguments that do not fit raise ValueError. All cores are used, the interpreter's lock is released.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from selfcal.model.laws import LawTuple

_Floats = NDArray[np.float64]

TEMPERATURE_LSB: float
SUPPLY_LSB: float

def run_filters(
    y: _Floats,
    dt_s: float,
    bias_mean: float,
    bias_sd: float,
    laws: Sequence[LawTuple],
    hypothesis: NDArray[np.int32],
    drift: _Floats,
    second: _Floats,
    sigma_v: _Floats,
    r: _Floats | None = None,
    z: _Floats | None = None,
    coefficient_sd: _Floats | None = None,
    block: int = 1,
) -> tuple[_Floats, _Floats, _Floats]:
    """One Kalman filter per node: ln p(Y | node) [m]; then, after the last sample, the mean [m, d + 1 + p] and
    covariance [m, d + 1 + p, d + 1 + p] of the state (drift, x0, c), where a drift has d states. The laws of
    one call must agree in d."""

def run_bank(
    y: _Floats,
    dt_s: float,
    bias_mean: float,
    bias_sd: float,
    laws: Sequence[LawTuple],
    hypothesis: NDArray[np.int32],
    drift: _Floats,
    second: _Floats,
    sigma_v: _Floats,
    ln_prior: Sequence[float],
    after: Sequence[int],
    r: _Floats | None = None,
    z: _Floats | None = None,
    coefficient_sd: _Floats | None = None,
    block: int = 1,
) -> tuple[_Floats, _Floats, _Floats, _Floats, _Floats, _Floats]:
    """The bank at t instants, `after` so many samples (ascending). `ln_prior`: ln of each node's prior probability, up
    to a constant.

    Returns weight [t, m] (equations 11 and 13: they sum to 1 over all nodes), probability [t, h] of the laws (13), mean
    [t, h, 3] and covariance [t, h, 3, 3] of (drift, second, sigma_v) under each law (12, 14), and mean and variance
    [t, h] of x0 + drift + c z now under each law. A law of probability 0 has NaN moments.
    """

def innovations(
    y: _Floats,
    dt_s: float,
    bias_mean: float,
    bias_sd: float,
    law: LawTuple,
    drift: float,
    second: float,
    sigma_v: float,
    r: _Floats | None = None,
    z: _Floats | None = None,
    coefficient_sd: _Floats | None = None,
    block: int = 1,
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
    motion_times: list[float]
    def __init__(self) -> None: ...

class Axis:
    law: LawTuple
    bias: float
    N: float
    drift: float
    second: float
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
    variance_duration_s: float
    noise_ratio: float
    outlier_fraction: float
    motion_amplitude: float
    cross_axis: int
    cross_coefficient: float
    def __init__(self) -> None: ...

def simulate(
    scene: Scene, axes: Sequence[Axis], added: Callable[[_Floats, _Floats, _Floats], None] | None = None
) -> tuple[_Floats, _Floats, _Floats, NDArray[np.bool_], list[float]]:
    """A recording: values [axes, samples] in each axis's unit, temperature [samples] in degC, supply [samples] in V,
    which samples are present [samples], and the true x0 + drift of each axis [axes] at the last sample. `added` gets
    values, temperature and supply before the read-out, and may change the values in place."""

class Random:
    """SplitMix64 with Box-Muller normals: the same numbers on every machine."""

    def __init__(self, seed: int, stream: int) -> None: ...
    def uniform(self) -> float: ...
    def normal(self) -> float: ...
