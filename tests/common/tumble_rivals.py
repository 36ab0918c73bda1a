"""Calibrations of three other projects, written from their papers and sources for the tests alone.

Each takes means of rests [n, 3], m/s^2, and returns a matrix and an offset: f = matrix (a - offset). None has
intervals. Sources: Tedaldi, Pretto and Menegatti, "A robust and easy to implement method for IMU calibration without
external equipments", ICRA 2014 (IMU-TK); PX4, accelerometer_calibration.cpp; ArduPilot, AccelCalibrator.cpp.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Array = NDArray[np.float64]


def imu_tk(a: Array, gravity: float) -> tuple[Array, Array]:
    """Levenberg-Marquardt on |T K (a - b)|^2 - g^2, every rest alike: nine numbers."""

    def matrix(p: Array) -> Array:
        T = np.array([[1.0, -p[0], p[1]], [0.0, 1.0, -p[2]], [0.0, 0.0, 1.0]])
        return np.asarray(T * p[3:6])

    def residuals(p: Array) -> Array:
        return gravity**2 - (((a - p[6:]) @ matrix(p).T) ** 2).sum(axis=1)

    start = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    p = least_squares(residuals, start, method="lm" if len(a) >= start.size else "trf", xtol=1e-14, ftol=1e-14).x
    return matrix(p), p[6:]


def px4(a: Array, up: Array, gravity: float) -> tuple[Array, Array]:
    """The closed form of six flats: the offset is between two sides, the diagonal that of the inverse of three."""
    side = [int(np.argmax(up @ (sign * np.eye(3)[k]))) for k in range(3) for sign in (1.0, -1.0)]
    reference = a[side]
    offset = np.array([0.5 * (reference[2 * k, k] + reference[2 * k + 1, k]) for k in range(3)])
    inverse = np.linalg.inv(reference[::2] - offset) * gravity
    return np.diag(np.diag(inverse)), offset


def ardupilot(a: Array, gravity: float) -> tuple[Array, Array]:
    """Gauss-Newton on |M (a + o)| - g: M diagonal of six rests, symmetric of nine and more."""
    symmetric = len(a) >= 9

    def matrix(p: Array) -> Array:
        M = np.diag(p[3:6])
        if symmetric:
            M[np.triu_indices(3, 1)] = p[6:]
            M = M + np.triu(M, 1).T
        return M

    def residuals(p: Array) -> Array:
        return gravity - np.linalg.norm((a + p[:3]) @ matrix(p).T, axis=1)

    p = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, *([0.0] * 3 if symmetric else [])])
    for _ in range(20):
        r = residuals(p)
        J = np.column_stack([(residuals(p + step) - r) / 1e-6 for step in 1e-6 * np.eye(p.size)])
        p = p - np.linalg.lstsq(J, r, rcond=None)[0]
    return matrix(p), -p[:3]


def imu_tk_gyro(turns: Sequence[tuple[Array, Array, Array]], dt: float, bias: Array) -> Array:
    """T K [3, 3] of the gyros: Runge-Kutta over turns (rates [n, 3], directions before and behind), and the squares of
    the differences of directions, each turn alike. The bias is that of the first rest; their model has no G."""
    length = max(len(rates) for rates, _, _ in turns)
    w = np.zeros((length, len(turns), 3))
    for k, (rates, _, _) in enumerate(turns):  # all turns at once: those that are over stand still
        w[: len(rates), k] = rates - bias
    before, behind = (np.array([one[k] for one in turns]) for k in (1, 2))

    def matrix(p: Array) -> Array:
        T = np.array([[1.0, p[0], p[1]], [p[2], 1.0, p[3]], [p[4], p[5], 1.0]])
        return np.asarray(T * p[6:])

    def residuals(p: Array) -> Array:
        rate, u = w @ matrix(p).T, before
        for w0, w1 in pairwise(rate):
            middle = 0.5 * (w0 + w1)
            k1 = np.cross(u, w0)
            k2 = np.cross(u + 0.5 * dt * k1, middle)
            k3 = np.cross(u + 0.5 * dt * k2, middle)
            k4 = np.cross(u + dt * k3, w1)
            u = u + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return np.asarray((behind - u).ravel())

    return matrix(least_squares(residuals, np.array([0.0] * 6 + [1.0] * 3), xtol=1e-9, ftol=1e-9).x)
