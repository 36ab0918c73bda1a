"""Units: the only place where they are known, and the only conversions in the package.

A unit is written as a product of powers: `deg/s`, `m/s^2`, `deg/s/sqrt(Hz)`, `m/s/h^1.5`. Conventions of the noise
parameters, continuous time and two-sided: N is the white noise density (the Allan deviation at 1 s), K the random-walk
density, sigma_m and alpha the Gauss-Markov deviation and bandwidth. At interval dt the white noise has the deviation
N / sqrt(dt) and a random walk takes steps of K sqrt(dt).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, partial
from typing import TypeVar

from selfcal.base.errors import UserError, short
from selfcal.base.grid import Array

#: m/s^2 per g (3rd CGPM, 1901: exact by definition).
STANDARD_GRAVITY = 9.80665
#: Two-sided density over the one-sided density.
ONE_SIDED_TO_TWO_SIDED = 1.0 / math.sqrt(2.0)
#: Allan deviation of flicker noise over its coefficient, the bias instability: sqrt(2 ln 2 / pi).
FLICKER_FLOOR = math.sqrt(2.0 * math.log(2.0) / math.pi)
#: Counts of the sensor's least significant bit; a scale turns them into a unit.
LSB = "LSB"

_Value = TypeVar("_Value", float, Array)
# Dimensions: exponents of (angle, length, time, temperature, voltage, current, magnetic flux density, pressure).
_Dimension = tuple[Fraction, ...]


def _dimension(**exponent: int) -> _Dimension:
    kinds = ("angle", "length", "time", "temperature", "voltage", "current", "field", "pressure")
    return tuple(Fraction(exponent.get(kind, 0)) for kind in kinds)


_NONE = _dimension()
_TIME = _dimension(time=1)
_ACCELERATION = _dimension(length=1, time=-2)

#: name: (dimension, size in rad, m, s, K, V, A, T, Pa)
_ATOMS: dict[str, tuple[_Dimension, float]] = {
    "1": (_NONE, 1.0),
    "rad": (_dimension(angle=1), 1.0),
    "deg": (_dimension(angle=1), math.pi / 180.0),
    "arcsec": (_dimension(angle=1), math.pi / 648_000.0),
    "arcmin": (_dimension(angle=1), math.pi / 10_800.0),
    "rev": (_dimension(angle=1), 2.0 * math.pi),
    "dps": (_dimension(angle=1, time=-1), math.pi / 180.0),
    "dph": (_dimension(angle=1, time=-1), math.pi / 648_000.0),
    "rpm": (_dimension(angle=1, time=-1), math.pi / 30.0),
    "m": (_dimension(length=1), 1.0),
    "ft": (_dimension(length=1), 0.3048),
    "in": (_dimension(length=1), 0.0254),
    "s": (_TIME, 1.0),
    "min": (_TIME, 60.0),
    "h": (_TIME, 3600.0),
    "day": (_TIME, 86400.0),
    "Hz": (_dimension(time=-1), 1.0),
    "g": (_ACCELERATION, STANDARD_GRAVITY),
    "Gal": (_ACCELERATION, 1e-2),
    "K": (_dimension(temperature=1), 1.0),
    "degC": (_dimension(temperature=1), 1.0),
    "degF": (_dimension(temperature=1), 5.0 / 9.0),
    "V": (_dimension(voltage=1), 1.0),
    "A": (_dimension(current=1), 1.0),
    "T": (_dimension(field=1), 1.0),
    "gauss": (_dimension(field=1), 1e-4),
    "Pa": (_dimension(pressure=1), 1.0),
    "bar": (_dimension(pressure=1), 1e5),
}
#: Prefixes, the atoms that take no prefix, and a mass.
_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "h": 1e2, "k": 1e3}
_WHOLE, _MASS = ("1", "dph", "ft", "in", "min", "h", "day"), "kg"
#: Zero of a temperature scale in K; counts only where the temperature itself is meant, not in `deg/s/degC`.
_ZERO = {"degC": 273.15, "mdegC": 273.15, "degF": 273.15 - 160.0 / 9.0}

#: Units that a recording's header may have, for error messages.
RECORDING_UNITS = (
    "deg/s", "dps", "mdps", "rad/s", "mrad/s", "deg/h", "rad/h", "rpm", "m/s^2", "mm/s^2", "ft/s^2", "g", "mg", "ug",
    LSB, "degC", "degF", "K", "V", "mV", "h", "min", "s", "ms", "us", "ns",
)  # fmt: skip


@dataclass(frozen=True)
class Unit:
    """A parsed unit: `size` in the SI unit of its dimension, `zero` the offset of its scale in that unit."""

    name: str
    dimension: _Dimension
    size: float
    zero: float


_FACTOR = re.compile(r"(?:sqrt\((?P<root>\w+)\)|(?P<atom>\w+)(?:\^(?P<power>-?\d(?:\.\d{1,2})?))?)\Z", re.ASCII)
#: Longest name of a unit, and its sizes in SI: all that means something, and no power of it overflows.
_NAME_MOST, _SIZE_LEAST, _SIZE_MOST = 60, 1e-30, 1e30
#: Signs of data sheets, and their spelling here.
_SIGNS = str.maketrans(
    {"°": "deg", "º": "deg", "℃": "degC", "℉": "degF", "²": "^2", "³": "^3", "µ": "u", "μ": "u", "⁻": "-", "¹": "1",
     "·": " ", "⋅": " "}
)  # fmt: skip
#: A power without its sign, `s-1`, `s2`, and factors with blanks or stars between them.
_POWER, _FACTORS = re.compile(r"(?<=[a-zA-Z])(-?\d)(?![\w.])", re.ASCII), re.compile(r"\s*[\s*]\s*")
#: A prefix that is written out: its first letter, but for `micro`.
_SPELLED = re.compile(r"(?<![a-z])(nano|micro|milli|centi|deci|hecto|kilo)[- ]?(?=[a-z])", re.IGNORECASE)
_PER, _SQUARED = re.compile(r"\s+per\s+", re.IGNORECASE), re.compile(r"\s+squared|\*\*2", re.IGNORECASE)

#: Other spellings of an atom, in small letters: whole words of a unit. And brackets around a power, `m/(s^2)`.
_WORDS = {
    **{name: name for name in _ATOMS if name.islower()},
    **dict.fromkeys(("degs", "degree", "degrees"), "deg"),
    **dict.fromkeys(("rads", "radian", "radians"), "rad"),
    **dict.fromkeys(("revs", "revolution", "revolutions", "turn", "turns"), "rev"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("foot", "feet"), "ft"),
    **dict.fromkeys(("inch", "inches"), "in"),
    **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("mins", "minute", "minutes"), "min"),
    **dict.fromkeys(("hr", "hrs", "hour", "hours"), "h"),
    **dict.fromkeys(("d", "days"), "day"),
    **dict.fromkeys(("gs", "gee", "gees", "gn"), "g"),
    **dict.fromkeys(("c", "celsius", "degc"), "degC"),
    **dict.fromkeys(("f", "fahrenheit", "degf"), "degF"),
    **dict.fromkeys(("k", "kelvin"), "K"),
    **dict.fromkeys(("counts", "count", "lsb", "lsbs", "raw", "digit", "digits"), LSB),
}
_WORD, _BRACKETS = re.compile(r"(?<!\w)(?:sqrt(?=\()|[a-zA-Z]+(?=-?\d*(?!\w)))"), re.compile(r"/\s*\(([\w^]+)\)")

#: A root as print has it, and a number with its unit, with or without a blank between them.
_ROOT = re.compile(r"√\(?([a-zA-Z]+)\)?")
_QUANTITY = re.compile(r"\s*([-+]?[0-9.]+(?:[eE][-+]?\d+)?)\s*(\S.*)?", re.ASCII)


def quantity(text: str) -> tuple[float, str]:
    """Number and unit, "" for none, of a text as `0.014 deg/s/sqrt(Hz)` or `1.2°/√h`. Raises ValueError."""
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise ValueError("neither a number nor one with its unit")
    return float(match[1]), plain(match[2] or "")


def plain(name: str) -> str:
    """`name` in this module's spelling: `°/s` -> `deg/s`, `m/s²`, `m s^-2`, `m/s2` -> `m/s^2`;
    `√Hz` -> `sqrt(Hz)`; other texts stay."""
    spelled = _ROOT.sub(r"sqrt(\1)", name.strip().replace("°s", "deg s").translate(_SIGNS))
    if spelled == LSB or len(spelled) > _NAME_MOST or known(spelled):
        return spelled
    usual = _SPELLED.sub(lambda prefix: "u" if prefix[1].lower() == "micro" else prefix[1][0].lower(), spelled)
    usual = _SQUARED.sub("^2", _PER.sub("/", usual))
    usual = _WORD.sub(lambda word: _word(word[0]), _BRACKETS.sub(r"/\1", usual))
    if usual == LSB:
        return usual
    product = _FACTORS.sub("*", _POWER.sub(r"^\1", usual.replace("^", "").replace(".", " ")))
    try:
        meant = parse(product)
    except UserError:
        return spelled
    alike = ((unit, parse(unit)) for unit in RECORDING_UNITS if unit != LSB)
    return next((name for name, unit in alike if (unit.dimension, unit.size) == (meant.dimension, meant.size)), product)


def _word(word: str) -> str:
    """A word of a unit in this module's spelling, with its prefix; any other word unchanged."""
    small = word.lower()
    if small in _WORDS:
        return _WORDS[small]
    base = _WORDS.get(small[1:], LSB)
    return small[0] + base if small[1:] not in ("c", "d", "f", "k") and _atom(small[0] + base) is not None else word


def _atom(name: str) -> tuple[_Dimension, float] | None:
    """Dimension and size of an atom with or without a prefix; None for other names."""
    base = name[1:]
    if name in _ATOMS or name[:1] not in _PREFIXES or base not in _ATOMS or base in _WHOLE or name == _MASS:
        return _ATOMS.get(name)
    kind, size = _ATOMS[base]
    return kind, size * _PREFIXES[name[0]]


@cache
def parse(name: str) -> Unit:
    """The unit called `name`. Raises UserError for an unknown unit."""
    dimension, size = _NONE, 1.0
    unknown = UserError(f"unknown unit '{short(name)}' (known: {', '.join(RECORDING_UNITS)})")
    if len(name) > _NAME_MOST:
        raise unknown
    for sign, part in re.findall(r"(\A|[*/])([^*/]*)", name):
        match = _FACTOR.match(part)
        atom = None if match is None else _atom(match["root"] or match["atom"])
        if match is None or atom is None:
            raise unknown
        power = Fraction(1, 2) if match["root"] else Fraction(match["power"] or 1)
        if sign == "/":
            power = -power
        kind, scale = atom
        dimension = tuple(have + power * more for have, more in zip(dimension, kind, strict=True))
        size *= scale ** float(power)
        if not _SIZE_LEAST < size < _SIZE_MOST:
            raise unknown
    return Unit(name, dimension, size, _ZERO.get(name, 0.0))


def known(name: str) -> bool:
    """Whether `name` is a unit (LSB counts)."""
    try:
        return name == LSB or parse(name) is not None
    except UserError:
        return False


def same_kind(unit: str, other: str) -> bool:
    """Whether the two units convert into each other."""
    return parse(unit).dimension == parse(other).dimension


def factor(unit: str, to: str) -> float:
    """Factor of a difference in `unit` to be in `to`. Raises UserError if they are of different kinds."""
    source, target = parse(unit), parse(to)
    if source.dimension != target.dimension:
        raise UserError(f"'{unit}' cannot be converted to '{to}'")
    return source.size / target.size


def converted(value: _Value, unit: str, to: str) -> _Value:
    """`value` (any shape) of `unit` in `to`, unchanged if alike; temperatures as points on their scales. Raises
    UserError as `factor`."""
    scale = factor(unit, to)
    shift = parse(unit).zero - parse(to).zero
    if scale == 1.0 and shift == 0.0:
        return value  # an array itself, not a copy
    return value * scale if shift == 0.0 else value * scale + shift / parse(to).size


def by_seconds(unit: str, more: int) -> str:
    """`unit` per second (1): `deg/s` -> `deg/s^2`, `deg/h` -> `deg/h/s`; times a second (-1): `deg`, `deg/h*s`."""
    match = re.search(r"/s(?:\^(\d+))?\Z", unit)
    if match is None:
        return f"{unit}/s" if more > 0 else f"{unit}*s"
    exponent = int(match[1] or 1) + more
    return unit[: match.start()] + ("" if exponent == 0 else "/s" if exponent == 1 else f"/s^{exponent}")


def power(unit: str, exponent: int) -> str:
    """`unit` to a power: `m/s^2` squared is `m^2/s^4`."""
    factors = []
    for sign, part in re.findall(r"(\A|[*/])([^*/]*)", unit):
        match = _FACTOR.match(part)
        if match is None or exponent == 1 or part == "1":
            factors.append(sign + part)
            continue
        raised = exponent * (Fraction(1, 2) if match["root"] else Fraction(match["power"] or 1))
        factors.append(sign + str(match["root"] or match["atom"]) + ("" if raised == 1 else f"^{raised}"))
    return "".join(factors)


times_second = partial(by_seconds, more=-1)
#: Unit of each parameter by the reading's: itself, per second, and times a second.
_PARAMETERS = {
    **dict.fromkeys(("bias", "sigma_m", "B", "bias_instability"), "{0}"),
    **dict.fromkeys(("N", "arw"), "{0}/sqrt(Hz)"),
    **dict.fromkeys(("K", "rrw"), "{1}/sqrt(Hz)"),
    **dict.fromkeys(("Q", "quantization_noise"), "{2}"),
    **{"alpha": "1/s", "spectral_ratio": "1", "markov_ratio": "1"},
    **{"p1": "", "p2": ""},  # places of the wire that no model names
}


def parameter_unit(parameter: str, unit: str) -> str:
    """Unit of a model parameter (bias, N, K, sigma_m, B, alpha, and the ratios), of Q, or of a number of summary.py, of
    an axis that reads in `unit`."""
    return _PARAMETERS[parameter].format(unit, by_seconds(unit, 1), times_second(unit))


#: Units of data sheets, of a parameter of an angular rate and of an acceleration; below, of the numbers of summary.py.
_DATASHEET = {
    **dict.fromkeys(("bias", "sigma_m", "B"), ("deg/h", "ug")),
    "N": ("deg/sqrt(h)", "ug/sqrt(Hz)"),
    "K": ("deg/h/sqrt(h)", "ug/sqrt(h)"),
    "arw": ("deg/sqrt(h)", "m/s/sqrt(h)"),
    "rrw": ("deg/h/sqrt(h)", "mg/sqrt(h)"),
    "bias_instability": ("deg/h", "mg"),
    "quantization_noise": ("arcsec", "m/s"),
}


def datasheet_unit(parameter: str, unit: str) -> str:
    """The unit that data sheets state a model parameter in, of an axis that reads in `unit`; that of `parameter_unit`
    for what they do not state."""
    if parameter in _DATASHEET:
        for reading, of_kind in zip(("rad/s", "m/s^2"), _DATASHEET[parameter], strict=True):
            if same_kind(unit, reading):
                return of_kind
    return parameter_unit(parameter, unit)


def typeset(unit: str) -> str:
    """A unit as print has it: `deg/s/sqrt(Hz)` -> `°/s/√Hz`."""
    text = re.sub(r"sqrt\((\w+)\)", r"√\1", unit)
    for plain, print_ in (("deg", "°"), ("ug", "µg"), ("^2", "²"), ("^3", "³")):
        text = text.replace(plain, print_)
    return text


def duration_words(seconds: float) -> str:
    """About: `40 s`, `12 minutes`, `5 hours`, `3 days`."""
    for size, name, most in ((1.0, "s", 120.0), (60.0, "minutes", 120.0), (3600.0, "hours", 48.0)):
        if seconds < most * size:
            return f"{math.ceil(seconds / size)} {name}"
    return f"{math.ceil(seconds / 86400.0)} days"


#: Usual unit of each axis of an inertial unit: of its counts, on the wire, and of a simulated part.
SENSOR_UNITS = {name: {"g": "deg/s", "a": "m/s^2"}[name[0]] for name in ("gx", "gy", "gz", "ax", "ay", "az")}
#: Axes of an inertial unit: sensor columns unless a model names others.
SENSORS = tuple(SENSOR_UNITS)
