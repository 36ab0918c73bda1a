"""Gyros: w = T K (y - b - c (temp - reference) - G f), T [3, 3] with a unit diagonal in the accelerometers' frame.

A rest shows y = b + c (temp - reference) + G f + the Earth's rate. A turn carries gravity's direction u from the rest
before to the rest behind it: with the rotation Q of the integrated rate, Q^T u is the direction there. A small rotation
d of Q in the frame of its end moves Q^T u by (Q^T u) x d, and d is the sum over the samples of the rotation from each
to the end, times the error of its rate. So a single pass of the integral has every derivative.

Parameters: the accelerometers' own, b x y z [rad/s], G by rows [rad/s/g], K x y z, T xy xz yx yz zx zy [rad],
the vertical rate of the Earth that no latitude states [rad/s], c x y z [rad/s/degC], and for each chain of turns the
two level parts of the Earth's rate in its first rest. Residuals: three of each rest, then two of each turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from selfcal.base.errors import UserError
from selfcal.base.grid import Array, Mask, slices
from selfcal.base.units import STANDARD_GRAVITY
from selfcal.calibration import accelerometer
from selfcal.calibration.accelerometer import ANGLE_SD, NONE, SCALE_SD, Accelerometer, forces, means_covariance, shaped
from selfcal.calibration.noise import drift
from selfcal.calibration.tumble_fit import Problem, TumbleFit
from selfcal.calibration.tumble_rests import GYRO, Tumble, Turn

#: Stated priors, sd: bias, rad/s (10 deg/s); g-sensitivity, rad/s/g (0.1 deg/s/g); temperature coefficient,
#: rad/s/degC (0.05 deg/s/degC). Scale and angles have the accelerometers'.
BIAS_SD, G_SD, THERMAL_SD = math.radians(10.0), math.radians(0.1), math.radians(0.05)
#: Number of the accelerometers' parameters.
OF_ACCEL = accelerometer.THERMAL.stop
#: Windows of a turn that show signs and units, s; largest error of a gyro's factor; least share of the most turned
#: axis, or of a turn, that is judged; information that is added to every entry of the factors.
TURN_WINDOW_S, FACTOR_ERROR_MOST, TURNED_SHARE_LEAST, ADDED_INFORMATION = 0.2, 0.3, 0.3, 1e-3
#: Numbers of the parameters, and their places behind the accelerometers'; the Earth's vertical rate has an index, its
#: level parts follow for each chain of turns.
SIZES = (3, 9, 3, 6, 1, 3)
BIAS, G, SCALE, ANGLE, _, THERMAL = slices(SIZES)
VERTICAL, LEVEL = ANGLE.stop, THERMAL.stop
#: Row and column of each angle.
PLACES = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))


@dataclass(frozen=True)
class Gyroscope:
    """The answer: its fit, of which the first `of_accel` parameters are the accelerometers', and the turns."""

    fit: TumbleFit
    of_accel: int
    turns: tuple[Turn, ...]

    @property
    def theta(self) -> Array:
        """The gyros' own parameters."""
        return self.fit.theta[self.of_accel :]


def gyro_matrix(theta: Array) -> Array:
    """T K [3, 3] of the gyros' own parameters."""
    return shaped(theta[SCALE], theta[ANGLE], PLACES)


def cross(v: Array) -> Array:
    """The matrices [..., 3, 3] of v x of vectors [..., 3]."""
    return np.asarray(np.cross(np.eye(3), v[..., None, :]))


def products_to_end(R: Array) -> Array:
    """R[k] R[k + 1] ... R[n - 1] of each k [n, 3, 3], by doubling."""
    products, step = R.copy(), 1
    while step < len(products):
        products[:-step] = products[:-step] @ products[step:]
        step *= 2
    return products


def turned(rate: Array, dt: float) -> tuple[Array, Array]:
    """The rotation Q [3, 3] of rates [n, 3] from the first sample to the last, by the trapezoid rule and the
    first term of coning (Miller 1983); and the rotation from the end back to each sample [n, 3, 3]."""
    step = 0.5 * dt * (rate[:-1] + rate[1:]) + dt**2 / 12.0 * np.cross(rate[:-1], rate[1:])
    to_end = np.concatenate([products_to_end(Rotation.from_rotvec(step).as_matrix()), np.eye(3)[None]])
    return to_end[0], np.swapaxes(to_end, 1, 2)


def fault_of(accel: Accelerometer) -> str:
    """Faults of signs, axes or units of the gyros by the turns; "" without a fault. Gravity's direction u moves
    by u x w, which is linear in the rates: M [3, 3] of w = M y needs no start. An axis of few turns is not judged."""
    rests, moves, angles, middles = accel.tumble.rests, [], [], []
    for turn in (turn for turn in accel.tumble.turns if not turn.reason):
        size = max(2, round(TURN_WINDOW_S / turn.dt))
        first = np.arange(0, len(turn.accel) - size, size)
        f = accel.force(turn.accel, np.zeros(len(turn.accel)))
        u = f / np.linalg.norm(f, axis=1)[:, None]
        rate = turn.gyro - 0.5 * (rests[turn.first].gyro + rests[turn.first + 1].gyro)
        way = np.cumsum(rate, axis=0) * turn.dt
        moves.append(u[first + size] - u[first])
        angles.append(way[first + size] - way[first])
        middles.append(u[first + size // 2])
    if not moves:
        return ""
    moved, angle, u = (np.concatenate(part) for part in (moves, angles, middles))
    turned, measured = np.linalg.norm(np.cross(u, moved), axis=0), np.linalg.norm(angle, axis=0)
    columns = (cross(u)[:, :, :, None] * (angle / np.maximum(measured, 1e-12))[:, None, None, :]).reshape(-1, 9)
    inverse = np.linalg.inv(columns.T @ columns + ADDED_INFORMATION * np.eye(9))
    factors = inverse @ columns.T @ moved.ravel()
    sd = np.sqrt(np.mean((moved.ravel() - columns @ factors) ** 2) * np.diag(inverse)).reshape(3, 3)
    said = dict[str, list[str]]()
    for k in np.flatnonzero(turned > TURNED_SHARE_LEAST * turned.max()).tolist():
        axis = int(np.abs(factors.reshape(3, 3)[k]).argmax())
        share, value = (float(factors[3 * k + axis] / max(length, 1e-12)) for length in (turned[k], measured[axis]))
        if axis == k and abs(value - 1.0) < FACTOR_ERROR_MOST + 4.0 * float(sd[k, axis] / max(measured[axis], 1e-12)):
            continue
        words = [f"has the turns about {'xyz'[k]}"] * (axis != k) + ["is of the other sign"] * (value < 0.0)
        if not 1.0 - FACTOR_ERROR_MOST < abs(value) < 1.0 + FACTOR_ERROR_MOST:
            # Units that are taken for each other.
            units = [
                unit
                for unit, size in (("deg/s", math.radians(1.0)), ("rad/s", math.degrees(1.0)))
                if abs(math.log(abs(value) / size)) < FACTOR_ERROR_MOST
            ]
            words.append(
                f"reads as if its unit were {units[0]}" if units else f"reads {1 / abs(value):.2g} times the rate"
            )
        if abs(share) < TURNED_SHARE_LEAST:
            axis, words = k, ["does not show its turns"]
        said.setdefault(" and ".join(words), []).append(GYRO[axis])
    return "; ".join(f"{'each of ' * (len(who) > 1)}{', '.join(who)} {words}" for words, who in said.items())


def calibrate(accel: Accelerometer, held: Mask | None = None) -> Gyroscope:
    """The gyros by the rests, and by the turns that are not left out. `held`: own parameters that stay at 0 error.
    Raises UserError where the turns are not of these gyros."""
    if fault := fault_of(accel):
        raise UserError(f"no numbers: by the turns, {fault}; mend it by --unit or --column, or in the log")
    problem, place = _Problem(accel), accel.place
    thermal = THERMAL_SD if accel.tumble.has_temp else 0.0
    sd = np.repeat(
        [BIAS_SD, G_SD, SCALE_SD, ANGLE_SD, place.vertical_sd, thermal, place.level_sd],
        [*SIZES, 2 * (int(problem.chain[-1]) + 1)],
    )
    prior = block_diag(accel.fit.covariance, np.diag(np.maximum(sd, NONE) ** 2))
    mean = np.concatenate([accel.fit.theta, np.zeros(sd.size)])
    mean[OF_ACCEL:][SCALE] = 1.0
    start = mean.copy()
    start[OF_ACCEL:][BIAS] = problem.y.mean(axis=0)
    keep = None if held is None else np.concatenate([np.zeros(OF_ACCEL, bool), held])
    fit, _ = accel.tumble.fitted(GYRO, problem.under, start, mean, prior, keep)
    return Gyroscope(fit, OF_ACCEL, problem.turns)


@dataclass(frozen=True)
class _Directions:
    """Rests: directions `u` [n, 3], forces `f` [n, 3] in g, and the derivatives of `u` to the accelerometers'
    parameters [n, 3, k] and to their readings [n, 3, 3]. `matrix`: T K of the accelerometers."""

    u: Array
    f: Array
    to_accel: Array
    to_reading: Array
    matrix: Array

    @staticmethod
    def of(theta: Array, tumble: Tumble) -> _Directions:
        """The directions at parameters `theta`."""
        force, to, M = forces(theta, tumble.accel, tumble.warmth)
        size = np.linalg.norm(force, axis=1)[:, None]
        u = force / size
        flat = (np.eye(3) - u[:, :, None] * u[:, None, :]) / size[:, None]
        return _Directions(u, force / STANDARD_GRAVITY, flat @ to, flat @ M, M)


class _Problem:
    """Residuals of rests and turns, their derivatives and their covariance, at parameters."""

    def __init__(self, accel: Accelerometer) -> None:
        self.accel, self.tumble = accel, accel.tumble
        rests = self.tumble.rests
        self.count, self.temp = len(rests), float(self.tumble.temp.mean())
        self.turns = tuple(turn for turn in self.tumble.turns if not turn.reason)
        self.behind = {turn.first + 1: k for k, turn in enumerate(self.turns)}  # turn that leads to a rest
        self.chain = np.cumsum([k not in self.behind for k in range(self.count)]) - 1
        self.y = np.nan_to_num([rest.gyro for rest in rests])  # an axis that is not recorded weighs nothing
        self.white = np.array([self.tumble.noise[name].white for name in GYRO])
        self.of_rests = [self.white / rest.seconds + rest.rounded[3:] for rest in rests]
        self.of_accel_means = [means_covariance(self.tumble, k, float(accel.fit.theta[k])) for k in range(3)]
        self.begin_s = np.concatenate([self.tumble.begin_s, [rests[turn.first].end_s for turn in self.turns]])
        self.end_s = np.concatenate([self.tumble.end_s, [rests[turn.first + 1].begin_s for turn in self.turns]])
        self.last: tuple[Array, tuple[Array, ...]] | None = None

    def under(self, tumble: Tumble) -> Problem:
        """The problem under the noise of a tumble. The integrals of the last parameters are kept."""
        slow = [drift(tumble.noise[name], self.begin_s, self.end_s, tumble.reference_s) for name in GYRO]

        def problem(theta: Array) -> tuple[Array, Array, Array]:
            if self.last is None or not np.array_equal(theta, self.last[0]):
                self.last = theta.copy(), self._laid(theta)
            r, J, R, by_gyro = self.last[1]
            return r, J, R + sum(by_gyro[:, :, j] @ slow[j] @ by_gyro[:, :, j].T for j in range(3))

        return problem

    def _laid(self, theta: Array) -> tuple[Array, Array, Array, Array]:
        """Residuals, their derivatives, their covariance without the gyros' drift, and how that drift enters them."""
        count, own, warm = self.count, theta[OF_ACCEL:], self.tumble.warmth
        directions = _Directions.of(theta, self.tumble)
        size = 3 * count + 2 * len(self.turns)
        r, J = np.zeros(size), np.zeros((size, theta.size))
        # Noise enters by the means of the gyros over rests and turns, by those of the accelerometers, and within turns.
        by_gyro, by_accel = np.zeros((size, count + len(self.turns), 3)), np.zeros((size, count, 3))
        R = np.zeros((size, size))
        level = np.zeros((3, 2))  # the level directions of the chain's first rest, in the frame of this rest
        earth = (self.accel.place.vertical or 0.0) + own[VERTICAL]
        for k in range(count):
            of_level = OF_ACCEL + LEVEL + 2 * int(self.chain[k]) + np.arange(2)
            if k in self.behind:
                n = self.behind[k]
                rows = slice(3 * count + 2 * n, 3 * count + 2 * n + 2)
                way = _Way(self.turns[n], own, theta, directions, self.temp)
                level = way.Q.T @ level
                r[rows] = way.residual - way.slope @ level @ theta[of_level] * way.seconds
                J[rows, :OF_ACCEL] = way.basis @ (way.Q.T @ directions.to_accel[k - 1] - directions.to_accel[k])
                J[rows, OF_ACCEL : OF_ACCEL + LEVEL] = way.derivatives
                J[rows, of_level] = -way.slope @ level * way.seconds
                by_gyro[rows, count + n] = way.to_bias
                by_accel[rows, k - 1] = way.basis @ way.Q.T @ directions.to_reading[k - 1]
                by_accel[rows, k] = -way.basis @ directions.to_reading[k]
                R[rows, rows] = way.white(self.white)
            else:
                level = _across(directions.u[k]).T
            rows = slice(3 * k, 3 * k + 3)
            drawn = own[BIAS] + own[THERMAL] * warm[k] + own[G].reshape(3, 3) @ directions.f[k]
            r[rows] = self.y[k] - drawn - earth * directions.u[k] - level @ theta[of_level]
            of = J[rows, OF_ACCEL:]
            of[:, BIAS], of[:, THERMAL] = -np.eye(3), -np.eye(3) * warm[k]
            of[:, G], of[:, VERTICAL] = -np.kron(np.eye(3), directions.f[k]), -directions.u[k]
            J[rows, of_level] = -level
            by_gyro[rows, k] = np.eye(3)
            R[rows, rows] = np.diag(self.of_rests[k])
        for j in range(3):
            R += by_accel[:, :, j] @ self.of_accel_means[j] @ by_accel[:, :, j].T
        return r, J, R, by_gyro


class _Way:
    """A turn: its rotation `Q`, the residual [2] of the direction behind it in a `basis` [2, 3] across that direction,
    the `slope` [2, 3] of the residual to a rotation of the end, and its derivatives to the gyros' own parameters."""

    def __init__(self, turn: Turn, own: Array, theta: Array, directions: _Directions, temp: float) -> None:
        warm = float(np.nan_to_num(turn.temp - temp))
        offset = theta[accelerometer.BIAS] + warm * theta[accelerometer.THERMAL]
        force = (turn.accel - offset) @ directions.matrix.T / STANDARD_GRAVITY
        clean = turn.gyro - own[BIAS] - own[THERMAL] * warm - force @ own[G].reshape(3, 3).T
        self.matrix, self.dt, self.unsure = gyro_matrix(own), turn.dt, turn.unsure
        self.Q, back = turned(clean @ self.matrix.T, turn.dt)
        weight = np.full(len(clean), turn.dt)
        weight[[0, -1]] *= 0.5
        self.seconds = float(weight.sum())
        predicted = self.Q.T @ directions.u[turn.first]
        self.basis = _across(directions.u[turn.first + 1])
        self.residual = self.basis @ (predicted - directions.u[turn.first + 1])
        self.slope = self.basis @ cross(predicted)
        self.P = weight[:, None, None] * back  # rotation of the end by the rate at each sample
        self.to_bias = self.slope @ self.P.sum(axis=0) @ self.matrix
        derivatives = np.zeros((2, LEVEL))
        derivatives[:, BIAS], derivatives[:, THERMAL] = -self.to_bias, -self.to_bias * warm
        derivatives[:, G] = -self.slope @ np.einsum("kij,jl,km->ilm", self.P, self.matrix, force).reshape(3, 9)
        by_matrix = np.einsum("kij,kl->ijl", self.P, clean)  # to each entry of T K
        T = self.matrix / own[SCALE]
        for j in range(3):
            derivatives[:, SCALE.start + j] = self.slope @ by_matrix[:, :, j] @ T[:, j]
        for j, (row, column) in enumerate(PLACES):
            derivatives[:, ANGLE.start + j] = self.slope @ by_matrix[:, row, column] * own[SCALE][column]
        self.derivatives = derivatives

    def white(self, density: Array) -> Array:
        """Covariance [2, 2] of the residual by white noise within the turn, N^2 of each gyro [3]."""
        noisy = self.slope @ self.P @ self.matrix
        return np.asarray(np.einsum("kij,kj,klj->il", noisy, density / self.dt + self.unsure, noisy))


def _across(u: Array) -> Array:
    """Two directions [2, 3] across a direction [3]."""
    return np.asarray(np.linalg.svd(u[None, :])[2][1:])


def causes(gyro: Gyroscope, tumble: Tumble) -> list[tuple[str, float]]:
    """Causes of residuals beyond their sd, as `Fit.surest` has them: each rest and each turn by itself."""
    identity, rests = np.eye(gyro.fit.white.size), tumble.rests
    tried = [
        (f"the gyros turned in the rest at {rest.at_s[0]:.6g} to {rest.at_s[1]:.6g} s", identity[:, 3 * k : 3 * k + 3])
        for k, rest in enumerate(rests)
    ]
    for k, turn in enumerate(gyro.turns):
        first = 3 * len(rests) + 2 * k
        said = f"the turn at {rests[turn.first].at_s[1]:.6g} s does not end where its rates lead"
        tried.append((said, identity[:, first : first + 2]))
    return gyro.fit.surest(tried)
