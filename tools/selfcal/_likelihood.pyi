"""The compiled likelihood of tools/bindings/likelihood.cpp."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

COLUMNS_MAX: int
SLOPES_MAX: int

def run(
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    r: NDArray[np.float64],
    F: NDArray[np.float64],
    Q: NDArray[np.float64],
    h: NDArray[np.float64],
    P0: NDArray[np.float64],
    R: float,
    lost: float,
    driver: int,
    marks: Sequence[int],
    innovations: bool,
) -> tuple[
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
]: ...
def shifts(
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    r: NDArray[np.float64],
    F: NDArray[np.float64],
    Q: NDArray[np.float64],
    h: NDArray[np.float64],
    P0: NDArray[np.float64],
    R: float,
    lost: float,
    driver: int,
) -> tuple[NDArray[np.float64], float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]: ...
def slopes(
    y: NDArray[np.float64],
    r: NDArray[np.float64],
    F: NDArray[np.float64],
    Q: NDArray[np.float64],
    h: NDArray[np.float64],
    P0: NDArray[np.float64],
    R: float,
    lost: float,
    F_by: NDArray[np.float64],
    Q_by: NDArray[np.float64],
    h_by: NDArray[np.float64],
    P0_by: NDArray[np.float64],
    R_by: NDArray[np.float64],
    lost_by: NDArray[np.float64],
    driver: int,
) -> tuple[
    float,
    float,
    float,
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
]: ...
