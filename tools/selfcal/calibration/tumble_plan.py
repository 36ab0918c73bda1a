"""How many rests of which length a calibration takes: the intervals of a part that is as its model file says.

Positions are drawn, as a hand places them. Intervals follow from them, the covariance of the means and the priors: the
fit of readings without noise has them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from selfcal.bank.axis_result import HALF_90
from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.base.output import console_of, print_line
from selfcal.base.units import STANDARD_GRAVITY
from selfcal.calibration import accelerometer, gyroscope
from selfcal.calibration.earth import Place
from selfcal.calibration.noise import Noise, of_model
from selfcal.calibration.tumble_rests import ACCEL, CUT_S, GYRO, REST_LEAST_S, REST_PIECES, UNITS, Rest, Tumble
from selfcal.model.file import Model

SCHEMA = "selfcal.plan_tumble/1"
#: Sides that are up, by rests: six flats; an edge pair in each plane as well; and the edges opposite and six corners.
FLATS = ((0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -1), (0, -1, 0), (-1, 0, 0))
#: Each pair of edges shows the square of the scale of the axis that both have up alike: x, z, y.
EDGES = ((1, 1, 0), (1, -1, 0), (1, 0, 1), (-1, 0, 1), (0, 1, 1), (0, 1, -1))
OPPOSITE = tuple((-x, -y, -z) for x, y, z in EDGES)
CORNERS = ((1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1), (-1, 1, 1), (-1, 1, -1))
POSITIONS = {len(up): up for up in (FLATS, FLATS + EDGES, FLATS + EDGES + OPPOSITE + CORNERS)}
#: Lengths of a rest that are tried, s, and the time of a turn between two rests, s.
LENGTHS_S, TURN_S = (REST_LEAST_S, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0), 5.0
#: sd of each of two angles by which a hand places the part off, rad; number of placements that are drawn; share of
#: them that have what is planned.
PLACED, PLACINGS, PLAN_SHARE = math.radians(3.0), 10, 0.9
#: Quantities of a wish: the sensor, the unit here, and the places of the sensor's parameters.
WISHES = {
    "accelerometer bias": ("accelerometer", "m/s^2", accelerometer.BIAS),
    "scale": ("accelerometer", "ppm", accelerometer.SCALE),
    "angle": ("accelerometer", "rad", accelerometer.ANGLE),
    "gyro bias": ("gyroscope", "rad/s", gyroscope.BIAS),
    "g-sensitivity": ("gyroscope", "rad/s/g", gyroscope.G),
}
_WISH = re.compile(r"\s*(\S.*?)\s+within\s+([0-9.]+(?:e-?\d+)?)\s*(\S+)\s*", re.ASCII)


@dataclass(frozen=True)
class TumbleWish:
    """Half of the 90 % interval of every parameter of a group `name` is at most `most`, in SI units."""

    text: str
    name: str
    most: float

    @staticmethod
    def of(text: str) -> TumbleWish:
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
            size = units.converted(float(match[2]), unit, own)
        else:
            raise UserError(f"--want '{text}': {match[1]} is in {own}, which {unit} cannot be converted to")
        if not size > 0.0:
            raise UserError(f"--want '{text}': the size must be above 0")
        return TumbleWish(text, match[1], size)


def reached(model: Model, count: int, length_s: float) -> dict[str, float]:
    """Half of the widest 90 % interval of each group in WISHES, SI units, that PLAN_SHARE of the placements have at
    most; infinite where any parameter is not identified."""
    noise = {}
    for name in ACCEL + GYRO:
        group = model.group_of(name)
        N = group.priors["N"].median * units.factor(group.unit, UNITS[name])
        own = of_model(model, name, UNITS[name], N)
        # A drift that is not known: from the top of three decades to their middle.
        noise[name] = replace(own.scaled(np.full(len(own.terms), 0.014)), wide=False)
    random = np.random.default_rng(count)
    placements = [_of_placement(noise, _placed(random, POSITIONS[count]), length_s) for _ in range(PLACINGS)]
    rank = math.ceil(PLAN_SHARE * PLACINGS) - 1
    return {name: sorted(placement[name] for placement in placements)[rank] for name in WISHES}


def _placed(random: np.random.Generator, positions: Sequence[tuple[int, int, int]]) -> Array:
    """Readings [n, 3], m/s^2, of a part in positions, as a hand places it; its scales and angles are of the priors."""
    up = np.array(positions, float)
    up /= np.linalg.norm(up, axis=1)[:, None]
    up += PLACED * random.standard_normal(up.shape)
    scale = 1.0 + accelerometer.SCALE_SD * random.standard_normal(3)
    part = accelerometer.shaped(scale, accelerometer.ANGLE_SD * random.standard_normal(3), accelerometer.PLACES)
    return np.asarray(STANDARD_GRAVITY * up / np.linalg.norm(up, axis=1)[:, None] @ np.linalg.inv(part).T)


def _of_placement(noise: dict[str, Noise], readings: Array, length_s: float) -> dict[str, float]:
    """Half of the widest interval of each group for a placement with readings [n, 3]."""
    begin = (length_s + TURN_S) * np.arange(len(readings)) + 0.5 * CUT_S
    none, seconds = np.zeros(6), length_s - CUT_S
    rests = tuple(
        Rest(0, (a, a + seconds), a, a + seconds, seconds, f, none[:3], math.nan, none, np.zeros((REST_PIECES, 6)))
        for a, f in zip(begin, readings, strict=True)
    )
    accel = accelerometer.calibrate(Tumble(rests, (), noise), Place(STANDARD_GRAVITY, 0.0, 0.0, 0.0, 0.0, ""))
    gyro = gyroscope.calibrate(accel)
    widest = {}
    for name, (sensor, _, where) in WISHES.items():
        fit, start = (accel.fit, 0) if sensor == "accelerometer" else (gyro.fit, gyro.of_accel)
        own = slice(start + where.start, start + where.stop)
        sd = float(np.sqrt(np.diag(fit.covariance)[own]).max())
        widest[name] = HALF_90 * sd if fit.identified[own].all() else math.inf
    return widest


def plan_of(model: Model, texts: Sequence[str]) -> dict[str, Any]:
    """The document: by count of rests the shortest of LENGTHS_S that meets all wishes, None for none of them."""
    wishes = [TumbleWish.of(text) for text in texts]
    rows = []
    for count in POSITIONS:
        for length_s in LENGTHS_S:
            widest = reached(model, count, length_s)
            missed = [wish.text for wish in wishes if widest[wish.name] > wish.most]
            if not missed:
                break
        total = count * length_s + (count - 1) * TURN_S
        rows.append(
            {
                "rests": count,
                "rest_s": None if missed else length_s,
                "total_s": None if missed else total,
                "reached": {name: value if math.isfinite(value) else None for name, value in widest.items()},
                "missed": missed,
                "not_identified": [name for name, value in widest.items() if not math.isfinite(value)],
            }
        )
    return {
        "schema": SCHEMA,
        "model": str(model.path),
        "placed_deg": math.degrees(PLACED),
        "wishes": [wish.text for wish in wishes],
        "rows": rows,
    }


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """A line for each count of rests, and the shortest."""
    console = console_of(to_stderr=to_stderr)
    line = partial(print_line, console)
    line("; ".join(document["wishes"]))
    line(f"{PLAN_SHARE:.0%} of placements by hand, off by {document['placed_deg']:g} deg (sd), reach it with:")
    met = [row for row in document["rows"] if row["rest_s"] is not None]
    for row in document["rows"]:
        lost = f"; not identified: {', '.join(row['not_identified'])}" if row["not_identified"] else ""
        if row["rest_s"] is None:
            line(f"  {row['rests']} rests: no length up to {LENGTHS_S[-1]:g} s has {', '.join(row['missed'])}{lost}")
            continue
        line(f"  {row['rests']} rests of {row['rest_s']:g} s: {row['total_s'] / 60.0:.1f} minutes{lost}")
    if met:
        best = min(met, key=lambda row: float(row["total_s"]))
        line(f"rest it {best['rest_s']:g} s in each of {best['rests']} positions")
    line("scale and angles of the gyros come from the turns, and are not planned")
