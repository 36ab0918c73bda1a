"""Accelerometers: f = T K (a - b - c (temp - reference)), |f| = g, T unit upper triangular, K diagonal.

Parameters [10, 13 with a temperature]: b x y z [m/s^2], K x y z, T xy xz yz [rad], the relative error of g, c x y z
[m/s^2/degC]. A residual is |f| - g; the noise of its mean acts through (T K)^T f / |f|.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from selfcal.base.errors import UserError
from selfcal.calibration.earth import Place
from selfcal.calibration.fit import FALSE_ALARM, Fit, Problem, drift_share, fit
from selfcal.calibration.noise import drift
from selfcal.calibration.rests import ACCEL, Rest, Tumble

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Stated priors, sd: bias, m/s^2 (100 mg); scale; angle, rad; temperature coefficient, m/s^2/degC (1 mg/degC).
BIAS_SD, SCALE_SD, ANGLE_SD, THERMAL_SD = 0.98, 0.02, 0.02, 0.01
#: Where the parameters are.
BIAS, SCALE, ANGLE, GRAVITY, THERMAL = slice(0, 3), slice(3, 6), slice(6, 9), 9, slice(10, 13)
#: Row and column of each angle.
PLACES = ((0, 1), (0, 2), (1, 2))
#: A parameter beyond so many sd of its prior is none of an accelerometer.
REACH = 10.0
#: Rests without which there is no answer.
FEWEST = 3


@dataclass(frozen=True)
class Accelerometer:
    """The answer: its fit, the rests that it is of, gravity, and the temperatures [n] about their mean, degC."""

    fit: Fit
    tumble: Tumble
    place: Place
    warmth: Array
    reference_s: float

    @property
    def matrix(self) -> Array:
        """T K [3, 3]."""
        return matrix_of(self.fit.theta)

    def force(self, a: Array, warmth: Array) -> Array:
        """Specific force [n, 3], m/s^2, of readings [n, 3] at temperatures [n] about the mean."""
        found: Array = (a - self.fit.theta[BIAS] - warmth[:, None] * thermal_of(self.fit.theta)) @ self.matrix.T
        return found

    def refitted(self, held: Mask) -> Fit:
        """The fit with some parameters [n] held at 0 error: what a format cannot state."""
        problem, mean, prior = _problem(self.tumble, self.place, self.warmth, self.reference_s)
        return fit(problem, mean, mean, prior, held)


def matrix_of(theta: Array) -> Array:
    """T K [3, 3] of parameters."""
    T = np.eye(3)
    for (row, column), value in zip(PLACES, theta[ANGLE], strict=True):
        T[row, column] = value
    return T * theta[SCALE]


def thermal_of(theta: Array) -> Array:
    """c [3] of parameters; 0 where they have none."""
    return theta[THERMAL] if theta.size > THERMAL.start else np.zeros(3)


def warmth_of(tumble: Tumble) -> Array:
    """Temperatures of the rests [n] about their mean, degC; empty where not all of them have one."""
    temp = np.array([one.temp for one in tumble.rests])
    return temp - temp.mean() if np.isfinite(temp).all() else np.zeros(0)


def means_covariance(tumble: Tumble, axis: int, name: str, reference_s: float) -> Array:
    """Covariance [n, n] of an axis' means of the rests: drift, white noise, rounding."""
    noise = tumble.noise[name]
    own = np.array([noise.white / one.seconds + one.rounded[axis] for one in tumble.rests])
    return drift(noise, tumble.begin_s, tumble.end_s, reference_s) + np.diag(own)


def _problem(tumble: Tumble, place: Place, warmth: Array, reference_s: float) -> tuple[Problem, Array, Array]:
    """The fit's problem, the prior's mean and its covariance."""
    a = np.array([one.accel for one in tumble.rests])
    cov = [means_covariance(tumble, k, name, reference_s) for k, name in enumerate(ACCEL)]
    thermal = warmth.size > 0
    sd = np.repeat([BIAS_SD, SCALE_SD, ANGLE_SD], 3)
    sd = np.concatenate([sd, [max(place.sd / place.gravity, 1e-9)], np.full(3 * thermal, THERMAL_SD)])
    mean = np.zeros(sd.size)
    mean[SCALE] = 1.0
    warm = warmth if thermal else np.zeros(len(a))

    def problem(theta: Array) -> tuple[Array, Array, Array]:
        M = matrix_of(theta)
        x = a - theta[BIAS] - warm[:, None] * thermal_of(theta)
        f = x @ M.T
        size = np.linalg.norm(f, axis=1)
        u = f / size[:, None]
        w = u @ M
        v = x * theta[SCALE]
        angles = [u[:, row] * v[:, column] for row, column in PLACES]
        scale = u @ (M / theta[SCALE]) * x
        J = np.column_stack([-w, scale, *angles, np.full(len(a), -place.gravity), *(-w.T * warm if thermal else [])])
        R = sum(np.outer(w[:, k], w[:, k]) * cov[k] for k in range(3))
        return size - place.gravity * (1.0 + theta[GRAVITY]), J, np.asarray(R)

    return problem, mean, np.diag(sd**2)


def calibrate(tumble: Tumble, place: Place) -> Accelerometer:
    """The accelerometers by all rests. Raises UserError for fewer than FEWEST rests."""
    if len(tumble.rests) < FEWEST:
        raise UserError(
            f"{len(tumble.rests)} rests found, {FEWEST} are needed: rest the part 10 s or longer in each of six "
            "positions or more"
        )
    warmth = warmth_of(tumble)
    reference_s = float(tumble.end_s.max())

    def fit_of(known: Tumble) -> Fit:
        problem, mean, prior = _problem(known, place, warmth, reference_s)
        return fit(problem, mean, mean, prior)

    if any(tumble.noise[name].wide for name in ACCEL):
        tumble = tumble.with_drift(ACCEL, drift_share(lambda share: fit_of(tumble.with_drift(ACCEL, share))))
    found = Accelerometer(fit_of(tumble), tumble, place, warmth, reference_s)
    apart = found.fit.theta[: THERMAL.start] - np.repeat([0.0, 1.0, 0.0], [3, 3, 4])
    if np.abs(apart[:9] / np.sqrt(np.diag(found.fit.prior)[:9])).max() > REACH:
        bias, scale = (", ".join(f"{one:.3g}" for one in found.fit.theta[part]) for part in (BIAS, SCALE))
        raise UserError(
            f"the accelerometers would have biases of {bias} m/s^2 and scales of {scale}: are the readings in the unit "
            "of their headings, and did the part rest?"
        )
    return found


def causes(found: Accelerometer) -> list[tuple[str, float]]:
    """Causes of residuals beyond their sd, as `Fit.surest` has them: a square, hysteresis, each rest by itself."""
    tumble, one = found.tumble, found.fit
    a = np.array([rest.accel for rest in tumble.rests])
    count = len(a)
    u = found.force(a, found.warmth if found.warmth.size else np.zeros(count)) / found.place.gravity
    w = u @ found.matrix / found.place.gravity
    before = np.vstack([np.zeros(3), a[:-1]])
    tried = [
        ("a square of the scale: the axes are not linear", w * a**2),
        ("hysteresis: the bias depends on the position before", w * before),
    ]
    for k, rest in enumerate(tumble.rests):
        where = f"the rest at {rest.at_s[0]:.6g} to {rest.at_s[1]:.6g} s"
        moved = chi2.sf(_halves(found, rest), 3) * count < FALSE_ALARM
        said = f"the mount moved within {where}" if moved else f"{where} was none, or its mount was not still"
        tried.append((said, np.eye(count)[:, [k]]))
    return one.surest(tried)


def _halves(found: Accelerometer, rest: Rest) -> float:
    """Square of the difference between the halves of a rest over its variance, of all axes."""
    middle = 0.5 * (rest.begin_s + rest.end_s)
    begin, end = np.array([rest.begin_s, middle]), np.array([middle, rest.end_s])
    total = 0.0
    for k, name in enumerate(ACCEL):
        noise = found.tumble.noise[name]
        C = drift(noise, begin, end, found.reference_s) + np.eye(2) * (2.0 * noise.white / rest.seconds)
        total += rest.moved[k] ** 2 / (C[0, 0] + C[1, 1] - 2.0 * C[0, 1] + 2.0 * rest.rounded[k])
    return float(total)
