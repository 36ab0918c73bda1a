"""Gravity and the Earth's rate at a place, by WGS-84 (NIMA TR8350.2, third edition, chapter 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from selfcal.base.errors import UserError
from selfcal.base.units import STANDARD_GRAVITY

#: Earth's rate, rad/s; semi-major axis, m; flattening.
RATE, MAJOR, FLATTENING = 7.292115e-5, 6378137.0, 1.0 / 298.257223563
#: sd of a height that is not stated, m.
HEIGHT_SD = 500.0
#: Limits of a height, m, and of gravity, m/s^2.
HEIGHTS, GRAVITIES = (-500.0, 10_000.0), (9.7, 9.9)


@dataclass(frozen=True)
class Place:
    """`gravity`, m/s^2, with its `sd`. The Earth's rate, rad/s: `vertical` part (None: unknown) and the sd of each of
    its other parts, `level_sd` of the two in the level plane, `vertical_sd` of the unknown vertical part. `words`:
    where gravity is from."""

    gravity: float
    sd: float
    vertical: float | None
    vertical_sd: float
    level_sd: float
    words: str


def gravity_at(latitude_deg: float, height_m: float) -> float:
    """Normal gravity, m/s^2: Somigliana's formula and its expansion in the height (NIMA TR8350.2, 4-1 and 4-3)."""
    sine2 = math.sin(math.radians(latitude_deg)) ** 2
    e2 = FLATTENING * (2.0 - FLATTENING)
    # Gravity at the equator, m/s^2, and Somigliana's constant.
    ground = 9.7803253359 * (1.0 + 0.00193185265241 * sine2) / math.sqrt(1.0 - e2 * sine2)
    first = 2.0 / MAJOR * (1.0 + FLATTENING + 0.00344978650684 - 2.0 * FLATTENING * sine2)
    return ground * (1.0 - first * height_m + 3.0 * (height_m / MAJOR) ** 2)


def place(latitude_deg: float | None, height_m: float | None, gravity: float | None) -> Place:
    """Gravity and the Earth's rate at a place. Raises UserError for numbers that no place on Earth has."""
    if latitude_deg is not None and not abs(latitude_deg) <= 90.0:
        raise UserError(f"--latitude {latitude_deg:g}: takes degrees from -90 to 90, north is positive")
    if height_m is not None and latitude_deg is None:
        raise UserError("--height changes the gravity of a latitude: give --latitude too")
    if height_m is not None and not HEIGHTS[0] <= height_m <= HEIGHTS[1]:
        raise UserError(f"--height {height_m:g}: takes metres above the sea, {HEIGHTS[0]:g} to {HEIGHTS[1]:g}")
    if gravity is not None and not GRAVITIES[0] <= gravity <= GRAVITIES[1]:
        raise UserError(f"--gravity {gravity:g}: takes m/s^2, {GRAVITIES[0]:g} to {GRAVITIES[1]:g}")
    if latitude_deg is None:
        each = RATE / math.sqrt(3.0)
        of_earth: tuple[float | None, float, float] = None, each, each
    else:
        angle = math.radians(latitude_deg)
        of_earth = RATE * math.sin(angle), 0.0, RATE * math.cos(angle) / math.sqrt(2.0)
    if gravity is not None:
        return Place(gravity, 0.0, *of_earth, "stated")
    if latitude_deg is None:
        # sd of gravity over the inhabited Earth about the standard gravity, m/s^2.
        return Place(STANDARD_GRAVITY, 0.015, *of_earth, "standard: neither --latitude nor --gravity is given")
    height_sd = 0.0 if height_m is not None else HEIGHT_SD
    value = gravity_at(latitude_deg, height_m or 0.0)
    near = f"{height_m:g} m" if height_m is not None else f"the sea's level, {HEIGHT_SD:g} m more or less: no --height"
    # Anomalies of some 30 mGal, and the free-air gradient, 1/s^2.
    return Place(value, math.hypot(3e-4, 3.086e-6 * height_sd), *of_earth, f"WGS-84 at {latitude_deg:g} deg, {near}")
