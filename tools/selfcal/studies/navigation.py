"""A loosely coupled GPS/INS filter on simulated parts: an error-state Kalman filter in flight after a rest.

Flat Earth that does not turn; no lever arm, no vibration. x east, y north, z up; the body's axes forward, left, up.
A reading is the truth, the bias and white noise. The bias is a constant and a drift that is Gauss-Markov or a walk.
The strapdown equations over dt, of the attitude R (body to Earth), the corrected rate w and the specific force f:

    p += v dt + a dt^2 / 2        v += a dt        R := R exp(w dt)        a = R f - (0, 0, g)

The truth of the flight obeys them exactly. Errors are truth less estimate; the attitude's is a small rotation in the
body: R_true = R exp(theta). The error of w and f is the bias's, with the noise: theta' = theta x w - db, dv' = R (theta
x f - db).

GPS shows each second where the vehicle was LATENCY_S ago. The latency has an error that is constant and unknown, as in
the UAV example of the course on estimation by Mechbal, Guskov and Rebillat. The filter runs LATENCY_S late, so that it
has the readings of that moment, and estimates the error of the latency. The present is dead reckoning from there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from selfcal.base.grid import Array, slices
from selfcal.base.units import STANDARD_GRAVITY, converted
from selfcal.calibration.gyroscope import cross
from selfcal.model.simulated_parts import AXES, TRUTHS, TURN_ON, generator, simulate_axis

#: Lengths of the rest, and of the flight with GPS and after its outage, s; the longest outage that is flown.
REST_S, GPS_S, OUTAGE_S, LONGEST_OUTAGE_S = 1800, 300, 60, 300
#: Readings per s in flight.
RATE_HZ = 10
#: Latency of a position, and the sd of its error by part, s; a position's own sd by axis, m.
LATENCY_S, LATENCY_SD_S, GPS_SD_M = 1, 0.1, 3.0
#: Sd of the start's errors: the tilt of the floor and the heading, deg; the position by axis, m.
TILT_SD, HEADING_SD, START_SD_M = 0.1, 2.0, 3.0
#: Largest turn, deg/s; take-off and period of the turns, s.
TURN, TAKE_OFF_S, TURN_PERIOD_S = 10.0, 20.0, 60.0
#: Units of the filter, by AXES, and the size of each axis' unit in them.
SI = {"deg/s": "rad/s", "m/s^2": "m/s^2"}
SCALE = np.array([converted(np.ones(1), unit, SI[unit])[0] for unit in AXES.values()])
_UP = np.array([0.0, 0.0, STANDARD_GRAVITY])
#: Sizes of the error state: position, velocity, attitude, the biases' constants and drifts (gyros, accelerometers),
#: latency. What is judged has the sums of the constants and the drifts.
_SIZES = (3, 3, 3, 6, 6, 1)
_P, _V, _A, _CONSTANT, _DRIFT, _LATENCY = slices(_SIZES)
_STATES = _LATENCY.stop
_JUDGED = np.delete(np.eye(_STATES), _DRIFT, axis=0)
_JUDGED[_CONSTANT, _DRIFT] = np.eye(len(AXES))
#: Errors that are judged: three of position, velocity and attitude, six biases, the latency.
JUDGED = len(_JUDGED)


@dataclass(frozen=True)
class FilterNoise:
    """What filters hold of the readings, [filters, 6], by AXES in SI units: white noise N, random walk K, and the drift
    of a Gauss-Markov law; 0 where it is not in the law."""

    N: Array
    K: Array
    sigma_m: Array
    alpha: Array

    @classmethod
    def of(cls, filters: Sequence[Sequence[Mapping[str, float]]]) -> FilterNoise:
        """The parameters of each axis of each filter, in the units of AXES."""
        values = {
            name: np.array([[axis.get(name, 0.0) for axis in axes] for axes in filters])
            for name in ("N", "K", "sigma_m", "alpha")
        }
        return cls(values["N"] * SCALE, values["K"] * SCALE, values["sigma_m"] * SCALE, values["alpha"])

    def step(self, dt_s: float) -> tuple[Array, Array]:
        """Over `dt_s`: what is left of a drift, and the variance that comes to it."""
        kept = np.exp(-self.alpha * dt_s)
        return kept, self.K**2 * dt_s + self.sigma_m**2 * (1.0 - kept**2)


@dataclass(frozen=True)
class Flight:
    """The truth at 0, dt, 2 dt, ...; the rate and the force between them."""

    position: Array
    velocity: Array
    attitude: Array
    rate: Array
    force: Array


@cache
def flight() -> Flight:
    """Take-off, then figures of eight at a changing speed in coordinated turns, which let the biases be seen."""
    dt = 1.0 / RATE_HZ
    t = np.arange((GPS_S + LONGEST_OUTAGE_S) * RATE_HZ + 1) * dt
    after = np.maximum(t - TAKE_OFF_S, 0.0)
    start = 0.5 * (1.0 - np.cos(np.pi * np.minimum(t / TAKE_OFF_S, 1.0)))
    speed = 20.0 * start + 4.0 * np.sin(2.0 * np.pi * after / 47.0)
    phase = 2.0 * np.pi * after / TURN_PERIOD_S
    turn = math.radians(TURN) * np.sin(phase)
    heading = math.radians(TURN) * TURN_PERIOD_S / (2.0 * np.pi) * (1.0 - np.cos(phase))
    bank = np.arctan(speed * turn / STANDARD_GRAVITY)
    attitude = Rotation.from_euler("ZX", np.stack([heading, -bank], axis=1))
    velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading), np.zeros_like(t)], axis=1)
    acceleration = np.diff(velocity, axis=0) / dt
    moved = velocity[:-1] * dt + acceleration * dt**2 / 2.0
    return Flight(
        position=np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)]),
        velocity=velocity,
        attitude=attitude.as_matrix(),
        rate=(attitude[:-1].inv() * attitude[1:]).as_rotvec() / dt,
        force=attitude[:-1].inv().apply(acceleration + _UP),
    )


@dataclass(frozen=True)
class Part:
    """Parts [parts, ...] in SI units: readings of the rest (means of 1 s) and the flight, and the biases in the latter;
    positions by GPS, late by LATENCY_S, at each s; the error of the latency, s, and those of the start."""

    rest: Array
    readings: Array
    bias: Array
    gps: Array
    latency: Array
    start_position: Array
    start_attitude: Array

    @classmethod
    def of(cls, law: str, seeds: Sequence[int], *, noise: float = 1.0) -> Part:
        """Parts of a law; `noise` scales every error there is."""
        return cls._of([_part(law, seed, noise) for seed in seeds])

    @classmethod
    def of_errors(cls, rest: Array, errors: Array) -> Part:
        """Flights with these errors of the readings in SI units: `rest` [flights, s, 6] means of 1 s, `errors`
        [flights, readings, 6]. How much of an error is bias is not known: none, so that no error of it is judged."""
        pairs = enumerate(zip(rest, errors, strict=True))
        return cls._of([_flown(np.random.default_rng(k), *pair, np.zeros((1, 6))) for k, pair in pairs])

    @classmethod
    def _of(cls, parts: Sequence[Mapping[str, Any]]) -> Part:
        return cls(**{name: np.stack([part[name] for part in parts]) for name in parts[0]})


def _part(law: str, seed: int, noise: float) -> dict[str, Any]:
    samples = (REST_S + GPS_S + OUTAGE_S) * RATE_HZ
    simulated = [simulate_axis(law, samples, seed, axis=axis, rate_hz=RATE_HZ) for axis in AXES]
    errors, bias = (noise * SCALE * np.array(both).T for both in zip(*simulated, strict=True))
    rest = REST_S * RATE_HZ
    means = errors[:rest].reshape(REST_S, RATE_HZ, -1).mean(axis=1)
    return _flown(generator(law, seed, len(AXES)), means, errors[rest:], bias[rest:], noise)


def _flown(rng: np.random.Generator, rest: Array, errors: Array, bias: Array, noise: float = 1.0) -> dict[str, Any]:
    """A part by the errors of its readings: the flight, its GPS and its start are simulated."""
    truth = flight()
    still = np.concatenate([np.zeros(3), truth.attitude[0].T @ _UP])
    true = np.concatenate([truth.rate, truth.force], axis=1)[: len(errors)]
    latency = noise * LATENCY_SD_S * rng.standard_normal()
    fixes, t = np.arange(GPS_S) - latency, np.arange(len(truth.position)) / RATE_HZ
    heard = np.stack([np.interp(fixes, t, axis) for axis in truth.position.T], axis=1)
    return {
        "rest": rest + still,
        "readings": errors + true,
        "bias": bias,
        "gps": heard + noise * GPS_SD_M * rng.standard_normal(heard.shape),
        "latency": np.array([latency]),
        "start_position": noise * START_SD_M * rng.standard_normal(3),
        "start_attitude": noise * np.radians([TILT_SD, TILT_SD, HEADING_SD]) * rng.standard_normal(3),
    }


class Filters:
    """Filters side by side, each with its own noise, of one part or of as many parts as there are filters."""

    def __init__(self, noise: FilterNoise, part: Part) -> None:
        count = len(noise.N)
        self.noise, self.part = noise, part
        turn = Rotation.from_rotvec(part.start_attitude).inv().as_matrix()
        self.attitude = np.broadcast_to(flight().attitude[0] @ turn, (count, 3, 3))
        self.position = flight().position[0] - np.broadcast_to(part.start_position, (count, 3))
        self.velocity = np.zeros((count, 3))
        self.constant, self.drift = np.zeros((count, 6)), np.zeros((count, 6))
        self.latency = np.zeros((count, 1))
        variance = np.zeros((count, _STATES))
        variance[:, _P] = START_SD_M**2
        variance[:, _A] = np.radians([TILT_SD, TILT_SD, HEADING_SD]) ** 2
        variance[:, _CONSTANT] = (np.array([TURN_ON[unit] for unit in AXES.values()]) * SCALE) ** 2
        variance[:, _DRIFT] = noise.sigma_m**2
        variance[:, _LATENCY] = LATENCY_SD_S**2
        self.covariance = variance[:, :, None] * np.eye(_STATES)

    def rest(self) -> None:
        """Each second's readings at rest measure the biases, and with the force of gravity the tilt."""
        count = len(self.position)
        measure = np.zeros((count, 6, _STATES))
        measure[:, :, _CONSTANT] = measure[:, :, _DRIFT] = np.eye(6)
        kept, variance = self.noise.step(1.0)
        move = np.broadcast_to(np.eye(_STATES), (count, _STATES, _STATES)).copy()
        np.einsum("...ii->...i", move)[:, _DRIFT] = kept
        for k in range(self.part.rest.shape[1]):
            force = _UP @ self.attitude
            measure[:, 3:, _A] = cross(force)
            expected = self.constant + self.drift
            expected[:, 3:] += force
            self.update(measure, self.part.rest[:, k] - expected, self.noise.N**2)
            self.predict(move, kept, variance)

    def fly(self, outages_s: Sequence[int] = (0, OUTAGE_S)) -> list[tuple[Array, Array]]:
        """The errors that are judged and their covariance, [filters, JUDGED] and [filters, JUDGED, JUDGED]: so long
        after GPS_S, when the last position, of LATENCY_S earlier, has come; `outages_s` ascend."""
        judged = []
        for k in range((GPS_S + outages_s[-1]) * RATE_HZ):
            second, between = divmod(k, RATE_HZ)
            if not between and second - GPS_S in outages_s:
                judged.append(self.judged(k))
            if not between and 0 < second <= GPS_S - LATENCY_S:
                self.locate(self.part.gps[:, second])
            self.move(self.part.readings[:, k])
        return [*judged, self.judged((GPS_S + outages_s[-1]) * RATE_HZ)]

    def locate(self, gps: Array) -> None:
        """A position by GPS: where the vehicle was `latency` ago, over which its velocity counts as constant."""
        measure = np.zeros((len(self.position), 3, _STATES))
        measure[:, :, _P] = np.eye(3)
        measure[:, :, _V] = -self.latency[:, :, None] * np.eye(3)
        measure[:, :, _LATENCY] = -self.velocity[:, :, None]
        expected = self.position - self.latency * self.velocity
        self.update(measure, gps - expected, np.full((1, 3), GPS_SD_M**2))

    def move(self, readings: Array) -> None:
        """Strapdown by the readings [filters or 1, 6] of an interval."""
        dt = 1.0 / RATE_HZ
        corrected = readings - self.constant - self.drift
        rate, force = corrected[:, :3], corrected[:, 3:]
        turn = Rotation.from_rotvec(rate * dt).as_matrix()
        move = np.zeros((len(rate), _STATES, _STATES))
        np.einsum("...ii->...i", move)[:] = 1.0
        move[:, _A, _A] = turn.transpose(0, 2, 1)
        move[:, _A, _DRIFT][:, :, :3] = -dt * np.eye(3)
        move[:, _V, _A] = -dt * self.attitude @ cross(force)
        move[:, _V, _DRIFT][:, :, 3:] = -dt * self.attitude
        move[:, _P] += dt / 2.0 * move[:, _V]
        move[:, _P, _V] = dt * np.eye(3)
        move[:, :9, _CONSTANT] = by_reading = move[:, :9, _DRIFT]
        kept, variance = self.noise.step(dt)
        noise = np.zeros_like(move)
        noise[:, :9, :9] = by_reading * (self.noise.N**2 * RATE_HZ)[:, None, :] @ by_reading.transpose(0, 2, 1)
        np.einsum("...ii->...i", move)[:, _DRIFT] = kept
        acceleration = np.einsum("bij,bj->bi", self.attitude, force) - _UP
        self.position = self.position + self.velocity * dt + acceleration * dt**2 / 2.0
        self.velocity = self.velocity + acceleration * dt
        self.attitude = self.attitude @ turn
        self.predict(move, kept, variance, noise)

    def predict(self, move: Array, kept: Array, variance: Array, noise: Array | float = 0.0) -> None:
        """The drift and the covariance over an interval."""
        self.drift = self.drift * kept
        self.covariance = move @ self.covariance @ move.transpose(0, 2, 1) + noise
        np.einsum("...ii->...i", self.covariance)[:, _DRIFT] += variance

    def update(self, measure: Array, innovation: Array, variance: Array) -> None:
        """Kalman's update; the error's estimate goes into the state at once."""
        seen = measure @ self.covariance
        of_innovation = seen @ measure.transpose(0, 2, 1) + variance[:, :, None] * np.eye(variance.shape[1])
        gain = np.linalg.solve(of_innovation, seen).transpose(0, 2, 1)
        error = np.einsum("bij,bj->bi", gain, innovation)
        covariance = self.covariance - gain @ seen
        self.covariance = (covariance + covariance.transpose(0, 2, 1)) / 2.0
        self.position = self.position + error[:, _P]
        self.velocity = self.velocity + error[:, _V]
        self.attitude = self.attitude @ Rotation.from_rotvec(error[:, _A]).as_matrix()
        self.constant = self.constant + error[:, _CONSTANT]
        self.drift = self.drift + error[:, _DRIFT]
        self.latency = self.latency + error[:, _LATENCY]

    def judged(self, k: int) -> tuple[Array, Array]:
        """Errors at reading `k` and their covariance."""
        truth = flight()
        turned = Rotation.from_matrix(self.attitude.transpose(0, 2, 1) @ truth.attitude[k]).as_rotvec()
        bias = self.part.bias[:, min(k, self.part.bias.shape[1] - 1)] - self.constant - self.drift
        moved = (truth.position[k] - self.position, truth.velocity[k] - self.velocity)
        return (
            np.concatenate([*moved, turned, bias, self.part.latency - self.latency], axis=1),
            _JUDGED @ self.covariance @ _JUDGED.T,
        )


def nees(errors: Array, covariance: Array) -> Array:
    """Normalised estimation error squared, [filters]: of a filter that is consistent, chi-squared of JUDGED degrees."""
    squares: Array = np.einsum("bi,bi->b", errors, np.linalg.solve(covariance, errors[:, :, None])[:, :, 0])
    return squares


def true_noise(law: str) -> list[Mapping[str, float]]:
    """By AXES: the parameters of the simulated parts."""
    return [TRUTHS[unit][law] for unit in AXES.values()]
