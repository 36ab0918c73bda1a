"""How many rests of which length a calibration takes: the intervals of a part that is as its model file says.

Nothing is drawn. Intervals follow from the positions, the covariance of the means and the priors: the fit of readings
without noise has them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from selfcal.bank.result import HALF_90
from selfcal.base import units
from selfcal.base.errors import UserError, printable
from selfcal.base.output import console_of
from selfcal.base.units import STANDARD_GRAVITY
from selfcal.calibration import accelerometer, gyroscope
from selfcal.calibration.earth import Place
from selfcal.calibration.noise import of_model
from selfcal.calibration.rests import ACCEL, GYRO, UNITS, Rest, Tumble
from selfcal.model.file import Model

Array = NDArray[np.float64]

SCHEMA = "selfcal.plan_tumble/1"
#: Sides that are up, by rests: six flats; an edge pair in each plane as well; and the edges opposite and six corners.
FLATS = ((0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -1), (0, -1, 0), (-1, 0, 0))
EDGES = ((1, 1, 0), (1, -1, 0), (1, 0, 1), (-1, 0, 1), (0, 1, 1), (0, -1, 1))
OPPOSITE = tuple((-x, -y, -z) for x, y, z in EDGES)
CORNERS = ((1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1), (-1, 1, 1), (-1, 1, -1))
POSITIONS = {6: FLATS, 12: FLATS + EDGES, 24: FLATS + EDGES + OPPOSITE + CORNERS}
#: Lengths of a rest that are looked at, s, and the time of a turn between two, s.
LENGTHS_S, TURN_S = (5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0), 5.0
#: Share of the mean square of a drift that is not known: from the top of three decades to their middle.
MIDDLE = 0.014
#: What may be wished: the sensor, the unit here, and where the sensor's parameters are.
WISHES = {
    "accelerometer bias": ("accelerometer", "m/s^2", accelerometer.BIAS),
    "scale": ("accelerometer", "ppm", accelerometer.SCALE),
    "angle": ("accelerometer", "rad", accelerometer.ANGLE),
    "gyro bias": ("gyroscope", "rad/s", gyroscope.BIAS),
    "g-sensitivity": ("gyroscope", "rad/s/g", gyroscope.G),
}
_WISH = re.compile(r"\s*(\S.*?)\s+within\s+([0-9.]+(?:e-?\d+)?)\s*(\S+)\s*", re.ASCII)


@dataclass(frozen=True)
class Wish:
    """Half of the 90 % interval of every parameter of a group `name` is at most `most`, in SI units."""

    text: str
    name: str
    most: float

    @staticmethod
    def of(text: str) -> Wish:
        """A wish as `scale within 100 ppm`. Raises UserError."""
        match = _WISH.fullmatch(text)
        known = ", ".join(WISHES)
        if match is None or match[1] not in WISHES:
            raise UserError(f"--want '{text}': takes one of {known} with a size, as 'scale within 100 ppm'")
        unit = units.plain(match[3])
        own = WISHES[match[1]][1]
        if own == "ppm":
            sizes = {"ppm": 1e-6, "%": 1e-2}
            if unit not in sizes:
                raise UserError(f"--want '{text}': a scale is in ppm or %")
            size = float(match[2]) * sizes[unit]
        elif units.known(unit) and units.same_kind(unit, own):
            size = units.convert(float(match[2]), unit, own)
        else:
            raise UserError(f"--want '{text}': {match[1]} is in {own}, which {unit} cannot be converted to")
        if not size > 0.0:
            raise UserError(f"--want '{text}': the size must be above 0")
        return Wish(text, match[1], size)


def reached(model: Model, count: int, length_s: float) -> dict[str, float]:
    """Half of the widest 90 % interval of each group in WISHES, SI units; infinite where one is not identified."""
    noise = {}
    for name in ACCEL + GYRO:
        group = model.group_of(name)
        N = group.priors["N"].median * units.factor(group.unit, UNITS[name])
        noise[name] = replace(of_model(model, name, UNITS[name], N).scaled(MIDDLE), wide=False)
    up = np.array(POSITIONS[count], float)
    up *= STANDARD_GRAVITY / np.linalg.norm(up, axis=1)[:, None]
    begin = (length_s + TURN_S) * np.arange(count)
    none = np.zeros(6)
    rests = tuple(
        Rest(0, (a, a + length_s), a, a + length_s, length_s, f, none[:3], math.nan, none, none[:3])
        for a, f in zip(begin, up, strict=True)
    )
    tumble = Tumble(rests, (), noise)
    accel = accelerometer.calibrate(tumble, Place(STANDARD_GRAVITY, 0.0, 0.0, 0.0, 0.0, ""))
    gyro = gyroscope.calibrate(accel)
    found = {}
    for name, (sensor, _, where) in WISHES.items():
        fit, start = (accel.fit, 0) if sensor == "accelerometer" else (gyro.fit, gyro.of_accel)
        own = slice(start + where.start, start + where.stop)
        sd = float(np.sqrt(np.diag(fit.covariance)[own]).max())
        found[name] = HALF_90 * sd if fit.identified[own].all() else math.inf
    return found


def plan_of(model: Model, texts: Sequence[str]) -> dict[str, Any]:
    """The document: by count of rests the shortest of LENGTHS_S that meets all wishes, None for none of them."""
    wishes = [Wish.of(text) for text in texts]
    rows = []
    for count in POSITIONS:
        entry: dict[str, Any] = {"rests": count, "rest_s": None, "total_s": None, "reached": None}
        for length_s in LENGTHS_S:
            found = reached(model, count, length_s)
            if all(found[one.name] <= one.most for one in wishes):
                total = count * length_s + (count - 1) * TURN_S
                entry = {"rests": count, "rest_s": length_s, "total_s": total, "reached": found}
                break
        rows.append(entry)
    return {"schema": SCHEMA, "model": str(model.path), "wishes": [one.text for one in wishes], "rows": rows}


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """A line for each count of rests, and the shortest."""
    console = console_of(to_stderr=to_stderr)

    def line(text: str) -> None:
        console.print(printable(text), highlight=False, markup=False, soft_wrap=True)

    line("; ".join(document["wishes"]))
    met = [one for one in document["rows"] if one["rest_s"] is not None]
    for one in document["rows"]:
        if one["rest_s"] is None:
            line(f"  {one['rests']} rests: no length up to {LENGTHS_S[-1]:g} s suffices")
            continue
        line(f"  {one['rests']} rests of {one['rest_s']:g} s: {one['total_s'] / 60.0:.1f} minutes")
    if met:
        best = min(met, key=lambda one: float(one["total_s"]))
        line(f"rest it {best['rest_s']:g} s in each of {best['rests']} positions")
    line("scale and angles of the gyros come from the turns, and are not planned")
