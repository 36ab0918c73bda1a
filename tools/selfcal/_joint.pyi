"""The compiled filter of several axes of tools/bindings/joint.cpp: x(t + 1) = decay x(t) + noise, of those variances,
and y_i = loading_i x_0 + x_(1 + i) + x_(1 + m + i) + white noise of covariance R. `first`: variances of x(0). Most: 16
axes."""

import numpy as np
from numpy.typing import NDArray

def course(
    y: NDArray[np.float64],
    decay: NDArray[np.float64],
    noise: NDArray[np.float64],
    loading: NDArray[np.float64],
    R: NDArray[np.float64],
    first: NDArray[np.float64],
    smoothed: bool,
) -> tuple[
    float,
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
]:
    """The members of `Course` in their order, of records y [m, n] (NaN: missing); the smoother's are empty without
    `smoothed`. Raises ValueError where shapes do not fit or a covariance is not positive definite."""

def information(
    y: NDArray[np.float64],
    columns: NDArray[np.float64],
    decay: NDArray[np.float64],
    noise: NDArray[np.float64],
    loading: NDArray[np.float64],
    R: NDArray[np.float64],
    first: NDArray[np.float64],
) -> NDArray[np.float64]:
    """[k, m, m]: of each column [k, n] on every axis, beside the levels, where y has readings."""
