"""Logs of a part that a hand turns between rests, drawn in numpy alone: a rigid body, finer than the read-out.

The truth of every test of `selfcal tumble`. Orientation is R [3, 3], body to level frame. A turn is
R_a exp(phi s(t)) exp(w(t)): s is a smooth step, w a tremor that vanishes at both ends. Rates are the logarithms of the
fine steps, forces the level's gravity and a hand's push. Readings are means over the read-out's interval.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from selfcal.logs.recording import Recording
from selfcal.model.file import DEFAULT, Model

Array = NDArray[np.float64]
G0 = 9.80665
EARTH = 7.292115e-5

_EDGE = math.sqrt(0.5)
FLATS = [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -1), (0, -1, 0), (-1, 0, 0)]
EDGES = [(_EDGE, _EDGE, 0), (_EDGE, -_EDGE, 0), (_EDGE, 0, _EDGE), (-_EDGE, 0, _EDGE), (0, _EDGE, _EDGE)]
EDGES += [(0, _EDGE, -_EDGE)]
#: Edges without the y-z plane.
FOUR_EDGES = EDGES[:4]
_CORNER = math.sqrt(1.0 / 3.0)
CORNERS = [(x * _CORNER, y * _CORNER, z * _CORNER) for x in (1, -1) for y in (1, -1) for z in (1, -1)]
TWELVE = FLATS + EDGES
TWENTY_FOUR = TWELVE + [(-a, -b, -c) for a, b, c in EDGES] + CORNERS[:6]
POSITIONS = {6: FLATS, 12: TWELVE, 24: TWENTY_FOUR}


@dataclass
class Part:
    """The truth: numbers of the model in tools/selfcal/calibration, in SI units; laws by kind, `lsb` 0 for none."""

    bias: Array
    scale: Array
    angles: Array  # xy, xz, yz
    gyro_bias: Array
    G: Array
    gyro_scale: Array
    gyro_angles: Array  # xy, xz, yx, yz, zx, zy
    N: tuple[float, float] = (6e-4, 1e-4)  # m/s^2/sqrt(Hz), rad/s/sqrt(Hz)
    law: str = "random_walk"
    K: tuple[float, float] = (3e-5, 3e-6)
    sigma_m: tuple[float, float] = (4e-4, 4e-5)
    alpha: float = 1.0 / 150.0
    lsb: tuple[float, float] = (0.0, 0.0)
    thermal: tuple[float, float] = (0.0, 0.0)  # m/s^2/degC, rad/s/degC, of every axis
    square: tuple[float, ...] = (0.0, 0.0, 0.0)  # s^2/m, of a reading without its bias
    hysteresis: float = 0.0  # of the force of the rest before
    limit: float = math.inf  # m/s^2
    gyro_limit: float = math.inf  # rad/s


def draw_part(random: np.random.Generator, **more: Any) -> Part:
    """Scales to 2 %, angles to 30 mrad, biases of some 30 mg and 1 deg/s, g-sensitivities of 0.02 deg/s/g."""
    return Part(
        0.3 * random.standard_normal(3),
        1.0 + random.uniform(-0.02, 0.02, 3),
        random.uniform(-0.03, 0.03, 3),
        math.radians(1.0) * random.standard_normal(3),
        math.radians(0.02) * random.standard_normal((3, 3)),
        1.0 + random.uniform(-0.02, 0.02, 3),
        random.uniform(-0.03, 0.03, 6),
        **more,
    )


@dataclass
class Truth:
    """The part, its biases at the end of the last rest and its mean temperature."""

    part: Part
    bias: Array
    gyro_bias: Array
    rests: list[tuple[float, float]] = field(default_factory=list)


def matrices(part: Part) -> tuple[Array, Array]:
    """T K of the accelerometers and of the gyros."""
    T, U = np.eye(3), np.eye(3)
    T[0, 1], T[0, 2], T[1, 2] = part.angles
    for (row, column), value in zip(((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)), part.gyro_angles, strict=True):
        U[row, column] = value
    return T * part.scale, U * part.gyro_scale


def _to(direction: Array, R: Array) -> Array:
    """Rotation vector, body frame, of the shortest turn that makes `direction` of the body point up."""
    up = R[2]
    axis = np.cross(up, direction)
    angle = math.atan2(float(np.linalg.norm(axis)), float(up @ direction))
    if np.linalg.norm(axis) < 1e-9:
        axis = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    return -angle * axis / np.linalg.norm(axis)


def tumbled(
    part: Part,
    random: np.random.Generator,
    positions: Sequence[Sequence[float]] = TWELVE,
    *,
    rest_s: float = 15.0,
    turn_s: float = 2.0,
    rate_hz: float = 100.0,
    tilt: float = 5e-3,
    gravity: float = G0,
    latitude_deg: float | None = None,
    finer: int = 10,
    warming: float = 0.0,
    first_rest_s: float | None = None,
    name: str = "tumble",
) -> tuple[Recording, Truth]:
    """A log of rests in `positions` (directions of the body that point up) and the truth. `tilt`: sd of the tilt of a
    position, rad. `finer`: simulated steps a sample. `warming`: degC from the first sample to the last."""
    A, M = matrices(part)
    A_inv, M_inv = np.linalg.inv(A), np.linalg.inv(M)
    # By chance the heading, and the first position without a turn.
    R = Rotation.from_euler("z", random.uniform(0, 2 * math.pi)).as_matrix()
    R = R @ Rotation.from_rotvec(_to(_tilted(positions[0], tilt, random), R)).as_matrix()
    angle = math.radians(latitude_deg or 0.0)
    earth = EARTH * np.array([0.0, math.cos(angle), math.sin(angle)]) * (latitude_deg is not None)
    dt = 1.0 / rate_hz
    forces, rates, rests, now, past = [], [], [], 0.0, np.zeros(3)
    shift: list[Array] = []
    for k, _ in enumerate(positions):
        n = round((first_rest_s if k == 0 and first_rest_s is not None else rest_s) * rate_hz)
        force = R.T @ np.array([0.0, 0.0, gravity])
        forces.append(np.tile(force, (n, 1)))
        rates.append(np.tile(R.T @ earth, (n, 1)))
        shift.append(np.tile(part.hysteresis * past, (n, 1)))
        past = force
        rests.append((now, now + n * dt))
        now += n * dt
        if k + 1 == len(positions):
            break
        n = round(turn_s * random.uniform(0.8, 1.3) * rate_hz)
        fine = np.arange(n * finer + 1) / (n * finer)
        s = fine**3 * (10.0 - 15.0 * fine + 6.0 * fine**2)
        window = np.sin(math.pi * fine) ** 3
        tremor = np.zeros((fine.size, 3))
        for hz, size in ((1.3, 1.5), (4.1, 0.3), (8.7, 0.05)):
            swing = np.sin(2.0 * math.pi * (hz * fine * n * dt + random.random()))
            tremor += math.radians(size) * random.standard_normal(3) * swing[:, None]
        # The target lies in the body frame of the start.
        phi = _to(_tilted(positions[k + 1], tilt, random), R)
        way = (
            Rotation.from_matrix(R)
            * Rotation.from_rotvec(s[:, None] * phi)
            * Rotation.from_rotvec(window[:, None] * tremor)
        )
        matrices_of = way.as_matrix()
        rate = (way[:-1].inv() * way[1:]).as_rotvec() * rate_hz * finer
        middle = matrices_of[:-1]
        rate = rate + np.einsum("kji,j->ki", middle, earth)
        push = 0.6 * random.standard_normal(3) * window[:-1, None] * np.cos(3.0 * math.pi * fine[:-1, None])
        force = np.einsum("kji,kj->ki", middle, push + np.array([0.0, 0.0, gravity]))
        rates.append(rate.reshape(n, finer, 3).mean(axis=1))
        forces.append(force.reshape(n, finer, 3).mean(axis=1))
        shift.append(np.zeros((n, 3)))
        now += n * dt
        R = matrices_of[-1]
    f, w = np.concatenate(forces), np.concatenate(rates)
    n = len(f)
    temp = 25.0 + warming * np.arange(n) / n
    drift_a, drift_g = (_drift(part, k, n, dt, random) for k in (0, 1))
    noise = [random.standard_normal((n, 3)) * part.N[k] * math.sqrt(rate_hz) for k in (0, 1)]
    mean_temp = float(np.mean([temp[int(a * rate_hz + 0.5) : int(b * rate_hz + 0.5)].mean() for a, b in rests]))
    warm = (temp - mean_temp)[:, None]
    a = f @ A_inv.T + part.bias + drift_a + part.thermal[0] * warm + noise[0] + np.concatenate(shift)
    a += part.square * (a - part.bias) ** 2
    y = w @ M_inv.T + part.gyro_bias + f / G0 @ part.G.T + drift_g + part.thermal[1] * warm + noise[1]
    a, y = np.clip(a, -part.limit, part.limit), np.clip(y, -part.gyro_limit, part.gyro_limit)
    for values, lsb in ((a, part.lsb[0]), (y, part.lsb[1])):
        if lsb > 0.0:
            values[:] = np.round(values / lsb) * lsb
    columns = {f"{axis}[m/s^2]": a[:, k] for k, axis in enumerate(("ax", "ay", "az"))}
    columns |= {f"{axis}[rad/s]": y[:, k] for k, axis in enumerate(("gx", "gy", "gz"))}
    if warming:
        columns["temp[degC]"] = temp
    recording = Recording.from_arrays(columns, rate_hz=rate_hz, name=name)
    end = round(rests[-1][1] * rate_hz) - 1
    return recording, Truth(part, part.bias + drift_a[end], part.gyro_bias + drift_g[end], rests)


def _tilted(direction: Sequence[float], tilt: float, random: np.random.Generator) -> Array:
    """A direction off by `tilt`, rad, sd in each of three axes."""
    found = np.asarray(direction, float) + tilt * random.standard_normal(3)
    return np.asarray(found / np.linalg.norm(found))


def _drift(part: Part, kind: int, n: int, dt: float, random: np.random.Generator) -> Array:
    """Drift [n, 3] of the law."""
    if part.law == "constant":
        return np.zeros((n, 3))
    steps = random.standard_normal((n, 3))
    if part.law == "random_walk":
        return np.asarray(part.K[kind] * math.sqrt(dt) * np.cumsum(steps, axis=0))
    from scipy.signal import lfilter

    phi = math.exp(-part.alpha * dt)
    steps[1:] *= math.sqrt(1.0 - phi**2)
    return np.asarray(part.sigma_m[kind] * lfilter([1.0], [1.0, -phi], steps, axis=0))


def model_of(part: Part) -> Model:
    """The model file of a part whose law and numbers are known, as a long record identifies them."""
    tree = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["name"] = "simulated"
    tree["hypotheses"] = {part.law: 1}
    tree["simulate"]["axes"] = {}
    for kind, (group, unit) in enumerate((("accel", "m/s^2"), ("gyro", "rad/s"))):

        def about(value: float) -> dict[str, Any]:
            return {"law": "log_normal", "median": value, "sd": 0.02}

        tree["groups"][group] |= {"unit": unit, "range": 0.0, "lsb": 0.0}
        tree["groups"][group]["priors"] = {
            "bias": {"law": "normal", "sd": 1.0},
            "N": about(part.N[kind]),
            "K": about(part.K[kind]),
            "sigma_m": about(part.sigma_m[kind]),
            "alpha": about(part.alpha),
        }
    return Model.of_tree(tree, Path("simulated.yaml"))
