"""The calibration in the forms that other programs read: matrices, Kalibr's inverse, and diagonals.

A parameter that is not identified stays at 0 error, and the others are fitted again. A format that holds less than the
model has the numbers that come nearest: the file says what is lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.linalg import rq

from selfcal.base.code_template import of_code
from selfcal.base.errors import UserError, remark
from selfcal.base.grid import Array
from selfcal.base.output import write_text
from selfcal.base.units import STANDARD_GRAVITY
from selfcal.calibration import accelerometer, gyroscope
from selfcal.calibration.accelerometer import Accelerometer, matrix_of
from selfcal.calibration.gyroscope import Gyroscope, gyro_matrix


@dataclass(frozen=True)
class Whole:
    """f = `matrix` (a - `bias`), m/s^2. `gyro`: bias, rad/s, matrix and G, rad/s/g, of w = matrix (y - bias - G f / g);
    None without gyros. `lines`: the file's head."""

    bias: Array
    matrix: Array
    gyro: tuple[Array, Array, Array] | None
    lines: tuple[str, ...]


def write_calibration(
    form: str, path: Path | str, accel: Accelerometer, gyro: Gyroscope | None, document: Mapping[str, Any]
) -> None:
    """Write a file in a form of FORMS. Raises UserError where the bias or scale of an axis is not identified."""
    unknown = _unknown(document, "accelerometer", ("bias", "scale"))
    if unknown:
        mend = "; ".join(document["accelerometer"]["would_mend"])
        raise UserError(f"--export {form}: {', '.join(unknown)} not identified: rest the part with {mend} as well")
    write_text(path, FORMS[form](accel, gyro, document))


def _unknown(document: Mapping[str, Any], sensor: str, groups: tuple[str, ...]) -> list[str]:
    """Parameters that are not identified."""
    return [
        f"{group} {name}"
        for group in groups
        for name, entry in document[sensor].get(group, {}).items()
        if not entry["identified"]
    ]


def _whole(
    accel: Accelerometer, gyro: Gyroscope | None, document: Mapping[str, Any], *, diagonal: bool = False
) -> Whole:
    """The numbers of a file; `diagonal`: without angles and g-sensitivity."""
    held = ~accel.fit.identified
    held[accelerometer.GRAVITY] = False
    lines = [f"selfcal tumble of {remark(document['recordings'][0]['path'])}, {len(accel.tumble.rests)} rests"]
    lost = _unknown(document, "accelerometer", ("misalignment",))
    if lost and not diagonal:
        lines.append(f"accelerometers, not identified and left at 0: {', '.join(lost)}")
    theta = accel.refitted(held).theta
    # A common error of gravity is not theirs to correct: gravity is as stated.
    bias, matrix = theta[accelerometer.BIAS], matrix_of(theta)
    if diagonal:
        # The diagonal that comes nearest to f over all directions: readings are b + inverse f.
        inverse = np.linalg.inv(matrix)
        matrix = np.diag(np.diag(inverse) / (inverse**2).sum(axis=1))
        up = np.random.default_rng(1).standard_normal((2000, 3))
        up /= np.linalg.norm(up, axis=1)[:, None]
        off = up @ np.linalg.inv(accel.matrix).T @ matrix.T - up
        length = np.abs(np.linalg.norm(up + off, axis=1) - 1.0).max()
        lines.append(f"angles are left out: |f| is off by up to {1e6 * length:.0f} ppm, by direction,")
        lines.append(f"and f by up to {1e3 * np.linalg.norm(off, axis=1).max():.3g} mg")
    if gyro is None:
        return Whole(bias, matrix, None, tuple(lines))
    identified = gyro.fit.identified[gyro.of_accel :]
    lost = _unknown(document, "gyroscope", ("bias", "scale", "misalignment", "g_sensitivity"))
    if diagonal:
        largest = math.degrees(np.abs(gyro.theta[gyroscope.G]).max()) if identified[gyroscope.G].all() else math.nan
        lines.append(f"gyros: their bias alone; the largest g-sensitivity left out is {largest:.2g} deg/s/g")
    elif lost:
        lines.append(f"gyros, not identified and left at 0: {', '.join(lost)}")
    own_held = ~identified
    own_held[gyroscope.VERTICAL] = own_held[gyroscope.THERMAL] = own_held[gyroscope.LEVEL :] = False
    own = gyroscope.calibrate(accel, own_held).theta if own_held.any() else gyro.theta
    return Whole(bias, matrix, (own[gyroscope.BIAS], gyro_matrix(own), own[gyroscope.G].reshape(3, 3)), tuple(lines))


def _yaml(accel: Accelerometer, gyro: Gyroscope | None, document: Mapping[str, Any]) -> str:
    """Matrices and vectors, and the intervals of every parameter."""
    whole = _whole(accel, gyro, document)
    tree: dict[str, Any] = {
        "schema": "selfcal.calibration/1",
        "accelerometer": {
            "use": "f = matrix (a - bias)",
            "unit": "m/s^2",
            "bias": whole.bias.tolist(),
            "matrix": whole.matrix.tolist(),
            "parameters": {key: document["accelerometer"][key] for key in ("bias", "scale", "misalignment")},
        },
    }
    if whole.gyro is not None:
        gyro_bias, turned, G = whole.gyro
        tree["gyroscope"] = {
            "use": "w = matrix (y - bias - g_sensitivity f)",
            "unit": "rad/s",
            "bias": gyro_bias.tolist(),
            "matrix": turned.tolist(),
            "g_sensitivity": (G / STANDARD_GRAVITY).tolist(),
            "parameters": {
                key: document["gyroscope"][key] for key in ("bias", "g_sensitivity", "scale", "misalignment")
            },
        }
    return _head("#", whole) + str(yaml.safe_dump(tree, sort_keys=False, width=110))


def _head(mark: str, whole: Whole) -> str:
    return "".join(f"{mark} {line}\n" for line in whole.lines)


def _c(accel: Accelerometer, gyro: Gyroscope | None, document: Mapping[str, Any]) -> str:
    """A header of constants."""
    whole = _whole(accel, gyro, document)
    numbers = {"accel_bias": whole.bias, "accel_matrix": whole.matrix}
    if whole.gyro is not None:
        gyro_bias, turned, G = whole.gyro
        numbers |= {"gyro_bias": gyro_bias, "gyro_matrix": turned, "gyro_g": G / STANDARD_GRAVITY}
    template = of_code(Path(__file__).parent / "templates").get_template("calibration.h.jinja")
    return template.render(lines=whole.lines, numbers={name: values.tolist() for name, values in numbers.items()})


def _lower(matrix: Array) -> tuple[Array, Array]:
    """`matrix` [3, 3] = L Q: L lower triangular with a positive diagonal, Q a rotation."""
    flip = np.eye(3)[::-1]
    upper, turn = rq(flip @ matrix)
    # flip matrix = upper turn, so matrix = (flip upper flip) (flip turn): lower triangular.
    L, Q = flip @ upper @ flip, flip @ turn
    sign = np.sign(np.diag(L))
    return L * sign, sign[:, None] * Q


def _kalibr(accel: Accelerometer, gyro: Gyroscope | None, document: Mapping[str, Any]) -> str:
    """Kalibr's scale-misalignment model (IccScaledMisalignedImu in IccSensors.py): a = M C f + b and
    y = M C_gyro_i w + A C_gyro_i f + b, M lower triangular. Its frame i is the accelerometers' with x kept: ours keeps
    z, so the two are a rotation apart."""
    whole = _whole(accel, gyro, document)
    M, Q = _lower(np.asarray(np.linalg.inv(whole.matrix)))

    def rows(values: Array) -> list[list[float]]:
        return [[float(f"{value:.10g}") for value in row] for row in values]

    tree: dict[str, Any] = {"model": "scale-misalignment", "accelerometers": {"M": rows(np.tril(M))}}
    biases = {"accelerometer_bias": [float(value) for value in whole.bias]}
    if whole.gyro is not None:
        gyro_bias, turned, G = whole.gyro
        Mg, C = _lower(np.linalg.inv(turned) @ Q.T)
        A = G / STANDARD_GRAVITY @ Q.T @ C.T
        tree["gyroscopes"] = {"M": rows(np.tril(Mg)), "A": rows(A), "C_gyro_i": rows(C)}
        biases["gyroscope_bias"] = [float(value) for value in gyro_bias]
    note = "# Kalibr's frame i is this one turned by T_i_selfcal; biases are not in Kalibr's file: m/s^2, rad/s\n"
    beside = yaml.safe_dump({"T_i_selfcal": rows(Q), **biases}, default_flow_style=None, width=110)
    text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=110)
    return _head("#", whole) + note + "".join(f"#   {line}\n" for line in beside.splitlines()) + str(text)


def _diagonal(
    off: str, scale: str, gyro_off: str, accel: Accelerometer, gyro: Gyroscope | None, document: Mapping[str, Any]
) -> str:
    """By the names of a parameter of an axis: corrected = (raw - off) scale, gyros raw - off, in the sensor's frame."""
    whole = _whole(accel, gyro, document, diagonal=True)
    lines = [f"# {line}" for line in whole.lines]
    lines.append("# for the first sensor, in the frame and of the uncorrected readings that the log is of")
    for k, axis in enumerate("XYZ"):
        lines.append(f"{off.format(axis)} {whole.bias[k]:.7f}")
        lines.append(f"{scale.format(axis)} {whole.matrix[k, k]:.7f}")
    if whole.gyro is not None:
        lines += [f"{gyro_off.format(axis)} {whole.gyro[0][k]:.8f}" for k, axis in enumerate("XYZ")]
    return "\n".join(lines) + "\n"


#: Name on the command line to writer.
FORMS: dict[str, Callable[[Accelerometer, Gyroscope | None, Mapping[str, Any]], str]] = {
    "yaml": _yaml,
    "c": _c,
    "kalibr": _kalibr,
    # Accelerometer::Correct and Gyroscope::Correct.
    "px4": partial(_diagonal, "param set CAL_ACC0_{}OFF", "param set CAL_ACC0_{}SCALE", "param set CAL_GYRO0_{}OFF"),
    # AP_InertialSensor_Backend::_rotate_and_correct_accel.
    "ardupilot": partial(_diagonal, "INS_ACCOFFS_{}", "INS_ACCSCAL_{}", "INS_GYROFFS_{}"),
}
