"""A hand that turns the part: true readings of an IMU that rests in one attitude after the other.

Readings follow the model of lib/tumble.h: a = (T K)^-1 f + b with f = gravity upwards in the body's frame, and
y = b + w + G f. A turn takes the shortest way about a level axis, its angle a smooth step of time, with a tremor. The
source of a sensor of this folder; its samples come in order.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Sample = tuple[float, float, float, float, float, float]


@dataclass
class Turned:
    """`matrix`: T K. `gyro_bias` in deg/s, `G` in deg/s per m/s^2; `noise`: sd of a sample, deg/s and m/s^2."""

    rate_hz: float
    matrix: Vector
    bias: Vector
    gyro_bias: Vector
    G: Vector
    noise: tuple[float, float]
    seed: int = 0
    gravity: float = 9.80665
    turn_s: float = 2.0

    def __post_init__(self) -> None:
        self.up = np.array([0.0, 0.0, 1.0])  # of the body; at rest the force is gravity times it
        self._axis = np.array([1.0, 0.0, 0.0])
        self._begun, self._angle, self._from = -(10**9), 0.0, self.up
        self._index = 0
        self._random = random.Random(self.seed)

    def to(self, up: Sequence[float]) -> None:
        """Begin to turn it until this direction of the body is up."""
        target = np.asarray(up, float) / np.linalg.norm(up)
        across = np.cross(self.up, target)
        size = float(np.linalg.norm(across))
        if size < 1e-9:  # not at all, or upside down by a level axis
            across = np.cross(self.up, np.eye(3)[int(np.argmin(np.abs(self.up)))])
        self._axis = across / np.linalg.norm(across)
        self._angle = math.atan2(size, float(self.up @ target))
        self._begun, self._from = self._index, self.up

    def __call__(self, index: int) -> Sample:
        self._index = index
        t = (index - self._begun) / self.rate_hz / self.turn_s
        rate = np.zeros(3)
        if 0.0 <= t < 1.0:
            angle = self._angle * (t - math.sin(2.0 * math.pi * t) / (2.0 * math.pi))
            self.up = self._rotated(angle)
            # `up` turns by +angle in the body's frame, so the body turns by -angle
            speed = -self._angle * (1.0 - math.cos(2.0 * math.pi * t)) / self.turn_s
            tremor = [self._random.gauss(0.0, 5.0 * math.sin(math.pi * t)) for _ in range(3)]
            rate = np.degrees(speed) * self._axis + tremor
        elif t >= 1.0:
            self.up = self._rotated(self._angle)
        force = self.gravity * self.up
        accel = np.linalg.solve(self.matrix, force) + self.bias
        gyro = self.gyro_bias + rate + self.G @ force
        drawn = [self._random.gauss(0.0, sd) for sd in (self.noise[0],) * 3 + (self.noise[1],) * 3]
        gx, gy, gz, ax, ay, az = (np.concatenate([gyro, accel]) + drawn).tolist()
        return gx, gy, gz, ax, ay, az

    def _rotated(self, angle: float) -> Vector:
        """`_from` turned about the axis, which lies across it (Rodrigues)."""
        turned = math.cos(angle) * self._from + math.sin(angle) * np.cross(self._axis, self._from)
        return turned / float(np.linalg.norm(turned))
