"""Gyros: w = T K (y - b - c (temp - reference) - G f), T [3, 3] with a unit diagonal in the accelerometers' frame.

A rest shows y = b + c (temp - reference) + G f + the Earth's rate. A turn carries gravity's direction u from the rest
before to the rest behind it: with the rotation Q of the integrated rate, Q^T u is the direction there. A small rotation
d of Q in the frame of its end moves Q^T u by (Q^T u) x d, and d is the sum over the samples of the rotation from each
to the end, times the error of its rate. So one pass of the integral has every derivative.

Parameters: the accelerometers' own, b x y z [rad/s], G by rows [rad/s/g], K x y z, T xy xz yx yz zx zy [rad],
the vertical rate of the Earth that no latitude states [rad/s], c x y z [rad/s/degC], and for each chain of turns the two
level parts of the Earth's rate in its first rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from selfcal.base.units import STANDARD_GRAVITY
from selfcal.tumble import accelerometer
from selfcal.tumble.accelerometer import PLACES as ANGLES
from selfcal.tumble.accelerometer import Accelerometer, matrix_of
from selfcal.tumble.fit import FALSE_ALARM, Fit, fit
from selfcal.tumble.noise import drift
from selfcal.tumble.rests import ACCEL, GYRO, Turn

Array = NDArray[np.float64]

#: Stated priors, sd: bias, rad/s (10 deg/s); g-sensitivity, rad/s/g (0.1 deg/s/g); scale; angle, rad; temperature
#: coefficient, rad/s/degC (0.05 deg/s/degC).
BIAS_SD, G_SD, SCALE_SD, ANGLE_SD, THERMAL_SD = (
    math.radians(10.0),
    math.radians(0.1),
    0.02,
    0.02,
    math.radians(0.05),
)
#: Where the parameters are, behind the accelerometers'.
BIAS, G, SCALE, ANGLE, VERTICAL, THERMAL, LEVEL = (
    slice(0, 3),
    slice(3, 12),
    slice(12, 15),
    slice(15, 21),
    21,
    slice(22, 25),
    25,
)
#: Row and column of each angle.
PLACES = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))


@dataclass(frozen=True)
class Gyroscope:
    """The answer: its fit, of which the first `of_accel` parameters are the accelerometers', the turns that it is of,
    and the causes of residuals beyond their sd."""

    fit: Fit
    of_accel: int
    turns: tuple[Turn, ...]
    causes: tuple[tuple[str, float], ...]

    @property
    def theta(self) -> Array:
        """The gyros' own parameters."""
        return self.fit.theta[self.of_accel :]


def gyro_matrix(theta: Array) -> Array:
    """T K [3, 3] of the gyros' own parameters."""
    T = np.eye(3)
    for (row, column), value in zip(PLACES, theta[ANGLE], strict=True):
        T[row, column] = value
    return T * theta[SCALE]


def cross(v: Array) -> Array:
    """The matrices [..., 3, 3] of v x of vectors [..., 3]."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    o = np.zeros_like(x)
    return np.stack([np.stack(r, axis=-1) for r in ((o, -z, y), (z, o, -x), (-y, x, o))], axis=-2)


def rotations(v: Array) -> Array:
    """The rotations [n, 3, 3] by vectors [n, 3], rad (Rodrigues)."""
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    S = cross(v)
    small = np.maximum(angle, 1e-12)
    half = np.sin(0.5 * small) / small
    found: Array = np.eye(3) + np.sin(small) / small * S + 2.0 * half**2 * (S @ S)
    return found


def products_to_end(R: Array) -> Array:
    """R[k] R[k + 1] ... R[n - 1] of each k [n, 3, 3], by doubling."""
    found, step = R.copy(), 1
    while step < len(found):
        found[:-step] = found[:-step] @ found[step:]
        step *= 2
    return found


def turned(rate: Array, dt: float) -> tuple[Array, Array]:
    """The rotation Q [3, 3] of rates [n, 3] from the first sample to the last, by the trapezoid rule and the
    first term of coning (Miller 1983); and the rotation from the end back to each sample [n, 3, 3]."""
    step = 0.5 * dt * (rate[:-1] + rate[1:]) + dt**2 / 12.0 * np.cross(rate[:-1], rate[1:])
    to_end = np.concatenate([products_to_end(rotations(step)), np.eye(3)[None]])
    return to_end[0], np.swapaxes(to_end, 1, 2)


def calibrate(accel: Accelerometer) -> Gyroscope:
    """The gyros by the rests, and by the turns that are not left out."""
    tumble, place = accel.tumble, accel.place
    rests, turns = tumble.rests, tuple(one for one in tumble.turns if not one.reason)
    count, of_accel = len(rests), accel.fit.theta.size
    a, y = (np.array([getattr(one, name) for one in rests]) for name in ("accel", "gyro"))
    warm = accel.warmth if accel.warmth.size else np.zeros(count)
    mean_temp = np.mean([one.temp for one in rests]) if accel.warmth.size else 0.0
    linked = {one.first: k for k, one in enumerate(turns)}
    chain = np.cumsum([k == 0 or k - 1 not in linked for k in range(count)]) - 1
    chains = int(chain[-1]) + 1

    sd = [np.full(3, BIAS_SD), np.full(9, G_SD), np.full(3, SCALE_SD), np.full(6, ANGLE_SD)]
    sd += [np.full(1, max(place.vertical_sd, 1e-12)), np.full(3, THERMAL_SD if accel.warmth.size else 1e-12)]
    own_sd = np.concatenate([*sd, np.full(2 * chains, max(place.level_sd, 1e-12))])
    prior = np.diag(np.concatenate([np.zeros(of_accel), own_sd**2]))
    prior[:of_accel, :of_accel] = accel.fit.covariance
    mean = np.concatenate([accel.fit.theta, np.zeros(own_sd.size)])
    mean[of_accel:][SCALE] = 1.0

    begin = np.concatenate([tumble.begin_s, [rests[one.first].end_s for one in turns]])
    end = np.concatenate([tumble.end_s, [rests[one.first + 1].begin_s for one in turns]])
    slow = [drift(tumble.noise[name], begin, end, accel.reference_s) for name in GYRO]
    white = np.array([tumble.noise[name].white for name in GYRO])
    of_rests = np.array([white / one.seconds + one.rounded[3:] for one in rests])
    of_accel_rests = [
        accelerometer.means_covariance(tumble, k, name, accel.reference_s) for k, name in enumerate(ACCEL)
    ]

    def problem(theta: Array) -> tuple[Array, Array, Array]:
        own = theta[of_accel:]
        A, M = matrix_of(theta), gyro_matrix(own)
        T = M / own[SCALE]
        b, S = own[BIAS], own[G].reshape(3, 3)
        x = a - theta[accelerometer.BIAS] - warm[:, None] * accelerometer.thermal_of(theta)
        force = x @ A.T
        size = np.linalg.norm(force, axis=1)
        u = force / size[:, None]
        f = force / STANDARD_GRAVITY
        # Derivatives of the directions u to the accelerometers' parameters [n, 3, of_accel] and to their readings.
        flat = (np.eye(3) - u[:, :, None] * u[:, None, :]) / size[:, None, None]
        to_reading = flat @ A
        to_accel = np.zeros((count, 3, of_accel))
        to_accel[:, :, accelerometer.BIAS] = -to_reading
        to_accel[:, :, accelerometer.SCALE] = flat @ (A / theta[accelerometer.SCALE] * x[:, None, :])
        for k, (row, column) in enumerate(ANGLES):
            to_accel[:, :, accelerometer.ANGLE.start + k] = (
                flat[:, :, row] * (x * theta[accelerometer.SCALE])[:, [column]]
            )
        if accel.warmth.size:
            to_accel[:, :, accelerometer.THERMAL] = -to_reading * warm[:, None, None]

        m, n = 3 * count + 2 * len(turns), theta.size
        r, J = np.zeros(m), np.zeros((m, n))
        # Noise enters by the means of the gyros over rests and turns, by those of the accelerometers, and within turns.
        by_gyro, by_accel = np.zeros((m, count + len(turns), 3)), np.zeros((m, count, 3))
        within = np.zeros((m, m))
        level = np.zeros((3, 2))
        start = 0
        for k in range(count):
            if k - 1 in linked:
                turn = turns[linked[k - 1]]
                at = slice(3 * count + 2 * linked[k - 1], 3 * count + 2 * linked[k - 1] + 2)
                warmth = turn.temp - mean_temp if accel.warmth.size else 0.0
                specific = (
                    turn.accel - theta[accelerometer.BIAS] - warmth * accelerometer.thermal_of(theta)
                ) @ A.T / STANDARD_GRAVITY
                clean = turn.gyro - b - own[THERMAL] * warmth - specific @ S.T
                Q, back = turned(clean @ M.T, turn.dt)
                weight = np.full(len(clean), turn.dt)
                weight[[0, -1]] *= 0.5
                predicted = Q.T @ u[k - 1]
                basis = np.linalg.svd(u[k][None, :])[2][1:]  # two directions across u
                slope = basis @ cross(predicted)  # of the residual to a rotation of the end
                P = np.einsum("k,kij->kij", weight, back)
                total = P.sum(axis=0)
                r[at] = basis @ (predicted - u[k])
                J[at, :of_accel] = basis @ (Q.T @ to_accel[k - 1] - to_accel[k])
                o = of_accel
                J[at, o + BIAS.start : o + BIAS.stop] = -slope @ total @ M
                J[at, o + THERMAL.start : o + THERMAL.stop] = -slope @ total @ M * warmth
                J[at, o + G.start : o + G.stop] = (
                    -slope @ np.einsum("kij,jl,km->ilm", P, M, specific).reshape(3, 9)
                )
                by_matrix = np.einsum("kij,kl->ijl", P, clean)  # to each entry of M
                for j in range(3):
                    J[at, o + SCALE.start + j] = slope @ (by_matrix[:, :, j] @ T[:, j])
                for j, (row, column) in enumerate(PLACES):
                    J[at, o + ANGLE.start + j] = slope @ by_matrix[:, row, column] * own[SCALE][column]
                level = Q.T @ level
                duration = float(weight.sum())
                c = o + LEVEL + 2 * chain[k]
                J[at, c : c + 2] = -slope @ level * duration
                r[at] += -slope @ level @ theta[c : c + 2] * duration
                by_gyro[at, count + linked[k - 1]] = slope @ total @ M
                by_accel[at, k - 1], by_accel[at, k] = basis @ Q.T @ to_reading[k - 1], -basis @ to_reading[k]
                noisy = slope @ P @ M
                within[at, at] = np.einsum("kij,j,klj->il", noisy, white / turn.dt, noisy)
            else:
                start = k
                level = np.linalg.svd(u[start][None, :])[2][1:].T
            at = slice(3 * k, 3 * k + 3)
            c = of_accel + LEVEL + 2 * chain[k]
            earth = (place.vertical or 0.0) + own[VERTICAL]
            r[at] = y[k] - b - own[THERMAL] * warm[k] - S @ f[k] - earth * u[k] - level @ theta[c : c + 2]
            o = of_accel
            J[at, o + BIAS.start : o + BIAS.stop] = -np.eye(3)
            J[at, o + THERMAL.start : o + THERMAL.stop] = -np.eye(3) * warm[k]
            J[at, o + G.start : o + G.stop] = -np.kron(np.eye(3), f[k])
            J[at, o + VERTICAL] = -u[k]
            J[at, c : c + 2] = -level
            by_gyro[at, k] = np.eye(3)
            within[at, at] = np.diag(of_rests[k])
        R = within
        for j in range(3):
            R = R + by_gyro[:, :, j] @ slow[j] @ by_gyro[:, :, j].T
            R = R + by_accel[:, :, j] @ of_accel_rests[j] @ by_accel[:, :, j].T
        return r, J, R

    start = mean.copy()
    start[of_accel:][BIAS] = y.mean(axis=0)
    found = fit(problem, start, mean, prior)
    return Gyroscope(found, of_accel, turns, tuple(_causes(found, accel, turns)))


def _causes(found: Fit, accel: Accelerometer, turns: tuple[Turn, ...]) -> list[tuple[str, float]]:
    """Rests and turns whose residuals are beyond their sd, as `accelerometer.causes` has them."""
    rests = accel.tumble.rests
    size = found.white.size
    tried = []
    for k, rest in enumerate(rests):
        p, _ = found.gain(np.eye(size)[:, 3 * k : 3 * k + 3])
        tried.append((f"the gyros turned in the rest at {rest.at_s[0]:.6g} to {rest.at_s[1]:.6g} s", p))
    for k, turn in enumerate(turns):
        first = 3 * len(rests) + 2 * k
        p, _ = found.gain(np.eye(size)[:, first : first + 2])
        tried.append((f"the turn at {rests[turn.first].at_s[1]:.6g} s does not end where its rates lead", p))
    certain = [(said, min(1.0, p * len(tried))) for said, p in tried]
    return sorted((one for one in certain if one[1] < FALSE_ALARM), key=lambda one: one[1])
