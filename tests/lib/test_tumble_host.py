"""The library's calibration from rests against the host's, on the same means: 1e-4 of a standard deviation.

The truth is tools/selfcal/calibration in double, whose own truth is tests/tools/test_tumble.py. lib/tumble.c is
compiled here by itself, as a shared library: a program that names nothing else links nothing else.
"""

from __future__ import annotations

import ctypes
import math
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tumbled import G0, POSITIONS, draw_part, matrices

from selfcal.calibration import accelerometer
from selfcal.calibration.earth import Place
from selfcal.calibration.noise import DriftTerm, Noise, drift
from selfcal.calibration.tumble_rests import ACCEL, GYRO, REST_PIECES, Rest, Tumble

from conftest import ROOT

Array = NDArray[np.float64]
MOST = 24
VERTICAL, LEVEL = np.float32(5.6e-5), np.float32(3.2e-5)


class CNoise(ctypes.Structure):
    _fields_ = [(name, ctypes.c_float) for name in ("N", "K", "sigma_m", "alpha")]


class CPart(ctypes.Structure):
    _fields_ = [("noise", CNoise * 6), *((name, ctypes.c_float) for name in ("gravity", "vertical", "level"))]


class CRest(ctypes.Structure):
    _fields_ = [("mean", ctypes.c_float * 6), ("begin_s", ctypes.c_float), ("end_s", ctypes.c_float)]


class CFound(ctypes.Structure):
    _fields_ = [
        ("accel", ctypes.c_double * 9),
        ("gyro", (ctypes.c_double * 4) * 3),
        ("accel_covariance", ctypes.c_float * 45),
        ("gyro_covariance", (ctypes.c_float * 10) * 3),
        ("bias", ctypes.c_float * 3),
        ("matrix", (ctypes.c_float * 3) * 3),
        ("gyro_bias", ctypes.c_float * 3),
        ("G", (ctypes.c_float * 3) * 3),
        ("ratio", ctypes.c_float),
        ("accel_identified", ctypes.c_uint16),
        ("gyro_identified", ctypes.c_uint16),
    ]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("tumble") / "tumble.so"
    options = ["-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC", f"-I{ROOT}/lib", f"-I{ROOT}/lib/default"]
    subprocess.run(["cc", *options, str(ROOT / "lib" / "tumble.c"), "-lm", "-o", str(path)], check=True)
    found = ctypes.CDLL(str(path))
    found.selfcal_tumble_accel_sd.restype = found.selfcal_tumble_gyro_sd.restype = ctypes.c_float
    return found


@dataclass(frozen=True)
class Drawn:
    """Means of rests in float, as a module has them."""

    mean: NDArray[np.float32]
    begin_s: NDArray[np.float32]
    end_s: NDArray[np.float32]
    noise: list[tuple[np.float32, ...]]

    def noise_of(self, axis: int) -> Noise:
        N, K, sigma_m, alpha = (float(one) for one in self.noise[axis])
        return Noise(N**2, (DriftTerm(K**2), DriftTerm(sigma_m**2, alpha)), "")


def drawn(positions: int, seed: int) -> Drawn:
    """A part of a law, walk and Gauss-Markov together in every third, and means with noise under it."""
    random = np.random.default_rng([seed, positions])
    part = draw_part(random)
    kinds = [((1.0, 0.0), (1.0, 1.0), (0.0, 1.0))[seed % 3] for _ in range(2)]
    noise = []
    for kind in range(2):
        walk, markov = kinds[kind]
        size = 10.0 ** random.uniform(-0.5, 1.5)
        values = (part.N[kind], walk * size * part.K[kind], markov * size * part.sigma_m[kind], part.alpha)
        noise += 3 * [tuple(np.float32(one) for one in values)]
    length = random.uniform(10.0, 30.0, positions)
    begin = np.cumsum(np.concatenate([[0.0], length[:-1] + random.uniform(2.0, 6.0, positions - 1)]))
    up = np.array(POSITIONS[positions]) + 5e-3 * random.standard_normal((positions, 3))
    f = G0 * up / np.linalg.norm(up, axis=1)[:, None]
    A, _ = matrices(part)
    mean = np.hstack([f @ np.linalg.inv(A).T + part.bias, part.gyro_bias + f / G0 @ part.G.T])
    found = Drawn(np.zeros((0, 6), np.float32), begin.astype(np.float32), (begin + length).astype(np.float32), noise)
    ends = found.begin_s.astype(float), found.end_s.astype(float)
    for axis in range(6):
        own = found.noise_of(axis)
        C = drift(own, *ends, float(ends[1].max())) + np.diag(own.white / (ends[1] - ends[0]))
        mean[:, axis] += np.linalg.cholesky(C) @ random.standard_normal(positions)
    return Drawn(mean.astype(np.float32), found.begin_s, found.end_s, noise)


def in_c(library: Any, one: Drawn) -> CFound:
    part = CPart((CNoise * 6)(*(CNoise(*map(float, own)) for own in one.noise)), G0, float(VERTICAL), float(LEVEL))
    rests = (CRest * MOST)(
        *(
            CRest((ctypes.c_float * 6)(*map(float, mean)), float(begin), float(end))
            for mean, begin, end in zip(one.mean, one.begin_s, one.end_s, strict=True)
        )
    )
    found, work = CFound(), ctypes.create_string_buffer(8192)
    status = library.selfcal_tumble(
        ctypes.byref(found), ctypes.byref(part), rests, ctypes.c_uint8(len(one.mean)), ctypes.byref(work)
    )
    assert status == 0
    return found


def on_the_host(one: Drawn) -> accelerometer.Accelerometer:
    """The same means by the host's fit, without temperature, rounding or an error of gravity."""
    none = np.zeros(6)
    rests = tuple(
        Rest(0, (begin, end), begin, end, end - begin, mean[:3], mean[3:], math.nan, none, np.zeros((REST_PIECES, 6)))
        for mean, begin, end in zip(
            one.mean.astype(float), one.begin_s.astype(float), one.end_s.astype(float), strict=True
        )
    )
    noise = {name: one.noise_of(k) for k, name in enumerate(ACCEL + GYRO)}
    gravity = float(np.float32(G0))
    return accelerometer.calibrate(Tumble(rests, (), noise), Place(gravity, 0.0, 0.0, 0.0, 0.0, ""))


def gyro_by_hand(one: Drawn, f: Array, axis: int) -> tuple[Array, Array]:
    """Bias and row of G by generalised least squares with the priors of the header."""
    own = one.noise_of(3 + axis)
    begin, end = one.begin_s.astype(float), one.end_s.astype(float)
    u = f[:, axis] / np.linalg.norm(f, axis=1)
    C = drift(own, begin, end, float(end.max())) + np.diag(own.white / (end - begin))
    C += np.diag(float(LEVEL) ** 2 * (1.0 - u**2))
    J = np.column_stack([np.ones(len(f)), f])
    sd = np.array([math.radians(10.0), *[math.radians(0.1) / G0] * 3])
    W = np.linalg.inv(C)
    covariance = np.linalg.inv(J.T @ W @ J + np.diag(1.0 / sd**2))
    y = one.mean[:, 3 + axis].astype(float) - float(VERTICAL) * u
    return covariance @ (J.T @ W @ y), np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("positions", [6, 12, 24])
def test_the_library_is_the_host(library: Any, positions: int) -> None:
    for seed in range(6):
        one = drawn(positions, seed)
        found, host = in_c(library, one), on_the_host(one)
        sd = np.sqrt(np.diag(host.fit.covariance)[:9])
        known = host.fit.identified[:9]
        assert [found.accel_identified >> k & 1 for k in range(9)] == known.tolist()
        mean = np.repeat([0.0, 1.0, 0.0], 3)
        off = (np.array(found.accel[:]) - (host.fit.theta[:9] - mean)) / sd
        assert np.abs(off[known]).max() < 1e-4
        assert np.isnan(off[~known]).all()
        own_sd = np.array([library.selfcal_tumble_accel_sd(ctypes.byref(found), k) for k in range(9)])
        assert own_sd[known] == pytest.approx(sd[known], rel=1e-5)
        below = [(i, j) for i in range(9) for j in range(i + 1)]
        covariance = np.array([host.fit.covariance[i, j] / (sd[i] * sd[j]) for i, j in below])
        assert np.array(found.accel_covariance[:]) / [sd[i] * sd[j] for i, j in below] == pytest.approx(
            covariance, abs=1e-5
        )
        if positions > 9:
            assert found.ratio == pytest.approx(host.fit.ratio, rel=1e-3)
        else:
            assert math.isnan(found.ratio)
        f = host.force(one.mean[:, :3].astype(float), np.zeros(positions))
        for axis in range(3):
            theta, gyro_sd = gyro_by_hand(one, f, axis)
            assert np.abs((np.array(found.gyro[axis][:]) - theta) / gyro_sd).max() < 1e-4
            told = [library.selfcal_tumble_gyro_sd(ctypes.byref(found), axis, k) for k in range(4)]
            assert told == pytest.approx(gyro_sd.tolist(), rel=1e-5)


def test_it_links_nothing_else(library: Any) -> None:
    """The shared library has no symbol of ours that it does not define: a program links it only if it names it."""
    listed = subprocess.run(["nm", "-D", "--undefined-only", library._name], capture_output=True, text=True, check=True)
    assert "selfcal" not in listed.stdout and "alloc" not in listed.stdout
    others = [path for path in Path(ROOT / "lib").glob("*.[ch]") if path.stem != "tumble"]
    named = [path.name for path in others if '"tumble.h"' in path.read_text(encoding="utf-8")]
    assert named == ["imu_tumble.c"]  # which a pipe names, or not
