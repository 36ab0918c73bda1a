"""Accelerometers: f = T K (a - b - c (temp - reference)), |f| = g, T unit upper triangular, K diagonal.

Parameters [13]: b x y z [m/s^2], K x y z, T xy xz yz [rad], the relative error of g, c x y z [m/s^2/degC]. A residual
is |f| - g; the noise of its mean acts through (T K)^T f / |f|.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from selfcal import _library32
from selfcal.base.errors import UserError
from selfcal.base.grid import Array, Mask, slices
from selfcal.calibration.earth import Place
from selfcal.calibration.noise import drift
from selfcal.calibration.tumble_fit import Problem, TumbleFit, fit_tumble
from selfcal.calibration.tumble_rests import ACCEL, REST_LEAST_S, Tumble
from selfcal.readings.budget import FALSE_ALARM

#: Stated priors, sd, of lib/tumble.h: bias, m/s^2 (100 mg); scale; angle, rad; square of the scale, s^2/m.
BIAS_SD: float = _library32.TUMBLE_BIAS_SD
SCALE_SD: float = _library32.TUMBLE_SCALE_SD
ANGLE_SD: float = _library32.TUMBLE_ANGLE_SD
SQUARE_SD: float = _library32.TUMBLE_SQUARE_SD
#: sd of the temperature coefficient, m/s^2/degC (1 mg/degC).
THERMAL_SD = 0.01
#: Numbers of the parameters, and their places; gravity's place is an index.
SIZES = (3, 3, 3, 1, 3)
BIAS, SCALE, ANGLE, _, THERMAL = slices(SIZES)
GRAVITY = ANGLE.stop
#: Row and column of each angle.
PLACES = ((0, 1), (0, 2), (1, 2))
#: sd of a parameter that the logs do not have: not 0, so that the prior has an inverse.
NONE = float(np.finfo(float).eps)
#: Largest distance of a parameter from its prior's mean, sd: larger in no accelerometer.
REACH: float = _library32.TUMBLE_REACH


@dataclass(frozen=True)
class Accelerometer:
    """The answer: its fit, the rests that it is of, and gravity."""

    fit: TumbleFit
    tumble: Tumble
    place: Place

    @property
    def matrix(self) -> Array:
        """T K [3, 3]."""
        return matrix_of(self.fit.theta)

    def force(self, a: Array, warmth: Array) -> Array:
        """Specific force [n, 3], m/s^2, of readings [n, 3] at temperatures [n] about the mean."""
        return forces(self.fit.theta, a, warmth)[0]

    def refitted(self, held: Mask) -> TumbleFit:
        """The fit with some parameters [n], and squares of the scale, held at 0 error: what a format cannot state. So
        it comes nearest at 1 g."""
        mean, prior = _prior(self.tumble, self.place)
        return fit_tumble(_problem(self.tumble, self.place, 0.0), mean, mean, prior, held)


def shaped(scale: Array, angles: Array, places: Sequence[tuple[int, int]]) -> Array:
    """T K [3, 3] of scales [3] and the angles [n] at places of T."""
    T = np.eye(3)
    T[tuple(np.transpose(places))] = angles
    return T * scale


def matrix_of(theta: Array) -> Array:
    """T K [3, 3] of parameters."""
    return shaped(theta[SCALE], theta[ANGLE], PLACES)


def means_covariance(tumble: Tumble, axis: int, bias: float, square_sd: float = SQUARE_SD) -> Array:
    """Covariance [n, n] of an axis' means of the rests: drift, white noise, rounding, a square beyond the `bias`."""
    noise = tumble.noise[ACCEL[axis]]
    own = np.array([noise.white / rest.seconds + rest.rounded[axis] for rest in tumble.rests])
    square = square_sd * (tumble.accel[:, axis] - bias) ** 2
    return drift(noise, tumble.begin_s, tumble.end_s, tumble.reference_s) + np.diag(own) + np.outer(square, square)


def forces(theta: Array, a: Array, warm: Array) -> tuple[Array, Array, Array]:
    """Specific force [n, 3], m/s^2, of readings [n, 3] at temperatures [n] about the mean, and its derivatives to the
    parameters [n, 3, 13] and to the readings [3, 3]."""
    M = matrix_of(theta)
    x = a - theta[BIAS] - warm[:, None] * theta[THERMAL]
    to = np.zeros((len(a), 3, THERMAL.stop))
    to[:, :, BIAS], to[:, :, SCALE], to[:, :, THERMAL] = -M, M / theta[SCALE] * x[:, None, :], -M * warm[:, None, None]
    for k, (row, column) in enumerate(PLACES):
        to[:, row, ANGLE.start + k] = x[:, column] * theta[SCALE][column]
    return x @ M.T, to, M


def _prior(tumble: Tumble, place: Place) -> tuple[Array, Array]:
    """The prior's mean and covariance."""
    thermal = THERMAL_SD if tumble.has_temp else 0.0
    sd = np.repeat([BIAS_SD, SCALE_SD, ANGLE_SD, place.sd / place.gravity, thermal], SIZES)
    return np.repeat([0.0, 1.0, 0.0, 0.0, 0.0], SIZES), np.diag(np.maximum(sd, NONE) ** 2)


def _problem(tumble: Tumble, place: Place, square_sd: float = SQUARE_SD) -> Problem:
    """The fit's problem."""
    a, warm = tumble.accel, tumble.warmth

    def problem(theta: Array) -> tuple[Array, Array, Array]:
        f, to, M = forces(theta, a, warm)
        size = np.linalg.norm(f, axis=1)
        u = f / size[:, None]
        w, J = u @ M, np.einsum("ni,nik->nk", u, to)
        J[:, GRAVITY] = -place.gravity
        cov = [means_covariance(tumble, k, float(theta[k]), square_sd) for k in range(3)]
        R = np.einsum("ik,jk,kij->ij", w, w, np.array(cov))
        return size - place.gravity * (1.0 + theta[GRAVITY]), J, R

    return problem


def calibrate(tumble: Tumble, place: Place) -> Accelerometer:
    """The accelerometers by all rests. Raises UserError for fewer rests than biases."""
    if len(tumble.rests) < len(ACCEL):
        raise UserError(
            f"{len(tumble.rests)} rests found, {len(ACCEL)} are needed: rest the part {REST_LEAST_S:g} s or longer in "
            "each of six positions or more"
        )
    mean, prior = _prior(tumble, place)
    own, weighed = tumble.fitted(ACCEL, lambda weighed: _problem(weighed, place), mean, mean, prior)
    accel = Accelerometer(replace(own, outside=(GRAVITY,)), weighed, place)
    theta = accel.fit.theta
    if (np.abs(theta - mean) > REACH * np.sqrt(np.diag(prior)))[:GRAVITY].any():
        bias, scale = (", ".join(f"{value:.3g}" for value in theta[part]) for part in (BIAS, SCALE))
        raise UserError(
            f"the accelerometers would have biases of {bias} m/s^2 and scales of {scale}: are the readings in the unit "
            "of their headings, and did the part rest?"
        )
    return accel


def causes(accel: Accelerometer) -> list[tuple[str, float]]:
    """Causes of residuals beyond their sd, as `Fit.surest` has them: a square, hysteresis, each rest by itself; before
    them rests in which the mount moved."""
    tumble = accel.tumble
    a, count = tumble.accel, len(tumble.rests)
    w = accel.force(a, tumble.warmth) @ accel.matrix / accel.place.gravity**2
    before = np.vstack([np.zeros(3), a[:-1]])
    tried = [
        ("a square of the scale: the axes are not linear", w * a**2),
        *((f"a square of the scale of {ACCEL[k]}: it is not linear", (w * a**2)[:, [k]]) for k in range(3)),
        ("hysteresis: the bias depends on the position before", w * before),
    ]
    moved = tumble.moved(ACCEL)
    where = [f"the rest at {rest.at_s[0]:.6g} to {rest.at_s[1]:.6g} s" for rest in tumble.rests]
    for k in np.flatnonzero(moved >= FALSE_ALARM).tolist():
        tried.append((f"{where[k]} was none, or its mount was not still", np.eye(count)[:, [k]]))
    sure = np.flatnonzero(moved < FALSE_ALARM).tolist()
    return [(f"the mount moved within {where[k]}", float(moved[k])) for k in sure] + accel.fit.surest(tried)
