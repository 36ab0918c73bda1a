"""Units against the factors of the project's units table (three to seven digits there, so compared to that many)."""

import math

import numpy as np
import pytest

from selfcal.base import units
from selfcal.base.errors import UserError


@pytest.mark.parametrize(
    ("unit", "to", "factor", "digits"),
    [
        ("deg/sqrt(h)", "rad/sqrt(s)", 2.908882e-4, 7),
        ("deg/h", "rad/s", 4.848137e-6, 7),
        ("deg/h/sqrt(h)", "rad/s/sqrt(s)", 8.0802e-8, 5),
        ("m/s/sqrt(h)", "m/s^2/sqrt(Hz)", 1 / 60, 15),
        ("m/s/h^1.5", "m/s^3/sqrt(Hz)", 1 / 216000, 15),
        ("mg", "m/s^2", 9.80665e-3, 15),
        ("ug/sqrt(Hz)", "m/s^2/sqrt(Hz)", 9.80665e-6, 15),
        ("deg/s/sqrt(Hz)", "deg/sqrt(h)", 60.0, 15),
    ],
)
def test_factors_of_the_table(unit: str, to: str, factor: float, digits: int) -> None:
    assert units.factor(unit, to) == pytest.approx(factor, rel=0.5 * 10.0 ** (1 - digits))
    assert units.factor(to, unit) == pytest.approx(1.0 / factor, rel=0.5 * 10.0 ** (1 - digits))


def test_one_sided_density() -> None:
    assert pytest.approx(0.5, rel=1e-15) == units.ONE_SIDED_TO_TWO_SIDED**2


@pytest.mark.parametrize(
    ("value", "unit", "to", "expected"),
    [
        (180.0, "deg/s", "rad/s", math.pi),
        (2.0, "rad/h", "rad/s", 2.0 / 3600.0),
        (1.0, "g", "m/s^2", 9.80665),
        (250.0, "us", "ms", 0.25),
        (5.0, "ns", "s", 5e-9),
        (3300.0, "mV", "V", 3.3),
        (25.0, "degC", "K", 298.15),  # points on two scales: the zero counts
        (0.0, "K", "degC", -273.15),
        (0.5, "deg/s/degC", "deg/s/K", 0.5),  # a difference: it does not
    ],
)
def test_values(value: float, unit: str, to: str, expected: float) -> None:
    assert units.converted(value, unit, to) == pytest.approx(expected, rel=1e-14)


def test_same_unit_is_exact() -> None:
    values = np.array([0.1, -7.3, 1e300])
    assert np.array_equal(units.converted(values, "deg/s", "deg/s"), values)


@pytest.mark.parametrize(
    ("unit", "density", "walk"),
    [
        ("deg/s", "deg/s/sqrt(Hz)", "deg/s^2/sqrt(Hz)"),
        ("rad/s", "rad/s/sqrt(Hz)", "rad/s^2/sqrt(Hz)"),
        ("deg/h", "deg/h/sqrt(Hz)", "deg/h/s/sqrt(Hz)"),
        ("m/s^2", "m/s^2/sqrt(Hz)", "m/s^3/sqrt(Hz)"),
        ("mg", "mg/sqrt(Hz)", "mg/s/sqrt(Hz)"),
    ],
)
def test_parameter_units(unit: str, density: str, walk: str) -> None:
    assert units.parameter_unit("N", unit) == density
    assert units.parameter_unit("K", unit) == walk
    assert units.parameter_unit("sigma_m", unit) == units.parameter_unit("bias", unit) == unit
    assert units.parameter_unit("alpha", unit) == "1/s"
    # A random walk grows by K per square root of a second; white noise averages down as N per square root of a hertz.
    assert units.same_kind(f"{unit}/sqrt(s)", walk)
    assert units.same_kind(f"{unit}*sqrt(s)", density)


@pytest.mark.parametrize("name", ["", "furlong", "deg//s", "/s", "m/", "m/s^", "LSB", "h^1000", "h^9*h^9*h^9"])
def test_unknown(name: str) -> None:
    with pytest.raises(UserError, match="unknown unit"):
        units.parse(name)


def test_kinds_do_not_mix() -> None:
    with pytest.raises(UserError, match=r"'g' cannot be converted to 'deg/s'"):
        units.factor("g", "deg/s")


#: Spellings of other tools, and sizes in rad/s, m/s^2, s, K, T, Pa, V by the units' definitions (SI brochure; NIST SP
#: 811: the foot is 0.3048 m, the inch 0.0254 m, the degree Fahrenheit 5/9 K).
SPELLED = {
    "rpm": math.pi / 30.0,
    "RPM": math.pi / 30.0,
    "rev/min": math.pi / 30.0,
    "revolutions/s": 2.0 * math.pi,
    "krpm": 1000.0 * math.pi / 30.0,
    "cdps": math.pi / 18_000.0,
    "ddeg/s": math.pi / 1800.0,
    "udps": math.pi / 180e6,
    "µrad/s": 1e-6,
    "nrad/s": 1e-9,
    "millidegrees per second": math.pi / 180e3,
    "milli-deg/s": math.pi / 180e3,
    "deg/min": math.pi / 10_800.0,
    "arcmin/s": math.pi / 10_800.0,
    "°s⁻¹": math.pi / 180.0,
    "°/sec": math.pi / 180.0,
    "cm/s²": 1e-2,
    "cm/s2": 1e-2,
    "km/s^2": 1e3,
    "m/s**2": 1.0,
    "meters per second squared": 1.0,
    "ft/s^2": 0.3048,
    "inch/s^2": 0.0254,
    "milli-g": 9.80665e-3,
    "micro g": 9.80665e-6,
    "gn": 9.80665,
    "cGal": 1e-4,
    "min": 60.0,
    "Minutes": 60.0,
    "d": 86_400.0,
    "msec": 1e-3,
    "microseconds": 1e-6,
    "micros": 1e-6,
    "millis": 1e-3,
    "°F": 5.0 / 9.0,
    "Fahrenheit": 5.0 / 9.0,
    "mdegC": 1e-3,
    "milliGauss": 1e-7,
    "mbar": 100.0,
    "kPa": 1000.0,
    "millivolts": 1e-3,
}


@pytest.mark.parametrize("spelled", SPELLED)
def test_spellings(spelled: str) -> None:
    assert units.parse(units.plain(spelled)).size == pytest.approx(SPELLED[spelled], rel=1e-14)


@pytest.mark.parametrize("spelled", ["knots", "kg", "r/s", "mol", "dB", "%", "mph", "ppm", "bits", "x17", "per s"])
def test_no_unit_is_guessed(spelled: str) -> None:
    """Words that an atom and a prefix might be read into."""
    assert not units.known(units.plain(spelled))


@pytest.mark.parametrize(("fahrenheit", "celsius"), [(32.0, 0.0), (212.0, 100.0), (-40.0, -40.0)])
def test_fahrenheit(fahrenheit: float, celsius: float) -> None:
    assert units.converted(fahrenheit, "degF", "degC") == pytest.approx(celsius, abs=1e-12)
    assert units.converted(1000.0 * celsius, "mdegC", "degC") == pytest.approx(celsius, abs=1e-12)
