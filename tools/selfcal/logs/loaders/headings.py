"""Headings of other programs: which columns of a table are a gyro's, an accelerometer's, the time and the temperature.

A form is a row of FORMS. The first whose axes are among the headings counts. Where a heading has a unit itself, this
unit counts, else the program's.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from selfcal.base import units
from selfcal.base.errors import UserError
from selfcal.base.limits import LONGEST_HEADING
from selfcal.base.options import Scale, parse_pairs

#: Headings of a time column that states its unit, or holds dates.
TIMES = ("time", "timestamp")
#: Name here of a second column of the time, which is added to the first.
PART = "t+"
#: Heading of the stamps that a serial monitor puts before a line.
RECEIVED = "received"


@dataclass(frozen=True)
class Meaning:
    """A column: its name here, its unit where the heading or the program states one, and the units of a count."""

    name: str
    unit: str | None = None
    size: float = 1.0
    optional: bool = False
    """Counts of a size that the log does not state: left out unless the user states it."""


@dataclass(frozen=True)
class Sensor:
    """The columns of a sensor in a table, by heading. `source` names it among others, empty where it is alone."""

    source: str
    meant: Mapping[str, Meaning]


@dataclass(frozen=True)
class _Form:
    """A program's columns: patterns of whole headings, for an axis with a group `axis` and perhaps a `source`.

    `times`: patterns and units of the time, the best first. `file`: what the file's name must have. `needs`: a heading
    that must be there.
    """

    gyro: str | tuple[str, ...] = ""
    accel: str | tuple[str, ...] = ""
    times: tuple[tuple[str, str | None], ...] = ()
    temperature: str = ""
    gyro_unit: str | None = "rad/s"
    accel_unit: str | None = "m/s^2"
    file: str = ""
    needs: str = ""
    before: str = ""
    """How a line before the headings begins."""
    count: float = 1.0
    """Units of one count of the time."""


_AXIS = r"(?P<axis>[xyz])"
_PLACE = r"\[(?P<axis>[012])\]"
_ROS = r"(?:(?P<source>.*)[./])?"
#: A word of a name before the sensor's own: `imu0_gyro_x`, `left/acc.y`.
_BEFORE = r"(?:(?P<source>.+?)(?:[ ._/-]|(?-i:(?<=[a-z0-9])(?=[A-Z]))))?"
_DATA = r"(?:[ _]?(?:data|raw|adc|calib|uncalibrated|ln))?"
_ENDS = r"(?:_(?:out|cal))?(?:_(?P<unit>\w+))?"
_AFTER = rf"{_DATA}[ ._/:\[(-]*(?P<axis>[xyz]|[123](?<=[:_].))\]?{_ENDS}"
_GYRO = (
    r"(?:gyr|gyros?|gyroscope|ang(?:ular)?[_ ]?vel(?:ocity)?|ang(?:ular)?[_ ]?rate|rate[_ ]of[_ ]turn"
    r"|rot(?:ation)?[_ ]?rate|omega|w|g)"
)
_ACCEL = r"(?:acc|accl|accel|accelerometer|acceleration|lin(?:ear)?[_ ]?acc(?:eleration)?|specific[_ ]?force|a)"
#: The axis before the sensor: `X Accel`, `Z_GYRO_OUT`.
_FIRST = rf"{_BEFORE}(?P<axis>[xyz])(?:[ _-]axis)?[ _-]?"
#: A rate of turn by the axis of a vehicle.
_VEHICLE = {"roll": "x", "pitch": "y", "yaw": "z"}
#: Any heading with an axis: its unit decides which sensor.
_ANY = (
    r"(?P<source>.*?)[ ._/-]*(?P<axis>[xyz])(?:[ _-]?axis)?",
    r"(?P<axis>[xyz])(?:[ _-]axis)?[ ._/-]+(?P<source>[^[(]*)",
)
#: A time by its name, where it states a unit of time.
_TIME = (
    r"(?:.*[^a-z])?(?:.*time(?:[ _]?stamp)?|.*stamp|elapsed|epochs?|epoc|.*tow|.*clock|zeit)"
    r"(?:[ _](?:since|unix|utc|cal|sync)[ _a-z]*)?"
)
#: Headings of the number of a sensor, where the rows of several take turns.
_NUMBERS = ("i", "instance", "imu", "imu_id", "sensor", "sensor_id", "device", "device_id", "devicename", "id")

FORMS = (
    # EuRoC and Kalibr
    _Form(rf"w_RS_S_{_AXIS}", rf"a_RS_S_{_AXIS}", (("#?timestamp", "ns"), ("time", "ns"))),
    _Form(rf"omega_{_AXIS}", rf"alpha_{_AXIS}", (("timestamp", "ns"),), needs="alpha_x"),
    # PX4, as ulog2csv writes it: topic sensor_combined; then sensor_gyro and sensor_accel, by the file's name
    _Form(rf"gyro_rad{_PLACE}", rf"accelerometer_m_s2{_PLACE}", (("timestamp_sample", "us"), ("timestamp", "us"))),
    _Form(
        _AXIS, "", (("timestamp_sample", "us"), ("timestamp", "us")), "temperature", file="gyro", needs="device_id"
    ),
    _Form(
        "", _AXIS, (("timestamp_sample", "us"), ("timestamp", "us")), "temperature", file="accel", needs="device_id"
    ),
    # rostopic echo -p: %time is when the message came
    _Form(
        rf"field\.angular_velocity\.{_AXIS}",
        rf"field\.linear_acceleration\.{_AXIS}",
        ((r"field\.header\.stamp", "ns"),),
    ),
    # PlotJuggler, and messages of ROS written out
    _Form(
        rf"{_ROS}angular_velocity[./]{_AXIS}",
        rf"{_ROS}linear_acceleration[./]{_AXIS}",
        ((rf"{_ROS}header[./]stamp", "s"), ("__time", "s")),
        rf"{_ROS}temperature",
    ),
    # Betaflight's blackbox_decode: rates are in deg/s unless the heading has another unit, accelerations are counts
    _Form(
        rf"(?P<source>gyroADC|gyroUnfilt){_PLACE}", rf"accSmooth{_PLACE}", (("time", "us"),),
        gyro_unit="deg/s", accel_unit=None,
    ),
    # Xsens MT Manager, a tick of whose clock is 100 us; Movella DOT: the same headings, another clock and unit
    _Form(
        rf"Gyr_{_AXIS}", rf"Acc_{_AXIS}", (("SampleTimeFine", "us"),), "Temp(?:erature)?", count=100.0,
        needs="PacketCounter", before="//",
    ),
    _Form(
        rf"Gyr_{_AXIS}", rf"Acc_{_AXIS}", (("SampleTimeFine", "us"),), gyro_unit="deg/s", needs="PacketCounter",
        before="DeviceTag",
    ),
    # ArduPilot's mavlogdump
    _Form(rf"Gyr{_AXIS}", rf"Acc{_AXIS}", (("TimeUS", "us"),), needs="TimeUS"),
    # Physics Toolbox
    _Form(rf"w{_AXIS}", rf"gF{_AXIS}", (("time", "s"),), accel_unit="g", needs="gFx"),
    # Sensor Logger; the values without gravity, `Accelerometer`, are an estimate
    _Form(_AXIS, "", (("time", "ns"),), file="gyroscope", needs="seconds_elapsed"),
    _Form("", _AXIS, (("time", "ns"),), file="accel", needs="seconds_elapsed"),
    # phyphox: a table, or a table for each sensor
    _Form(rf"Gyroscope {_AXIS}", rf"(?:Acceleration|Accelerometer) {_AXIS}", (("Time", "s"),)),
    _Form(_AXIS, "", (("Time", "s"),), file="gyroscope"),
    _Form("", _AXIS, (("Time", "s"),), file="accel"),
    # Everyone else's
    _Form(
        (f"{_BEFORE}{_GYRO}{_AFTER}", f"{_FIRST}(?!g(?:_|$)|w){_GYRO}{_DATA}{_ENDS}",
         f"{_BEFORE}(?P<axis>roll|pitch|yaw)[ _-]?(?:ang(?:ular)?[ _-]?)?rate{_ENDS}"),
        (f"{_BEFORE}{_ACCEL}{_AFTER}", f"{_FIRST}(?!a(?:_|$)){_ACCEL}{_DATA}{_ENDS}"),
        (
            (r"#?time(?:[_ ]?stamp)?(?:_(?P<unit>\w+))?", None), (r"t(?:_(?P<unit>\w+))?", None),
            ("timeus", "us"), ("micros", "us"), ("millis", "ms"), ("timestartup", "ns"), ("(?:gps[ _]?)?tow", "s"),
            (r"x[_ ]value", "s"), (_TIME, ""), (RECEIVED, None),
        ),
        rf"{_BEFORE}temp(?:erature)?(?:_(?P<unit>\w+))?",
        gyro_unit=None,
        accel_unit=None,
    ),
)  # fmt: skip

#: Kinds of unit that a name may end with, `gyro_x_dps`, `time_us`, `temp_c`; and units that only names write so.
_KINDS = ("rad/s", "m/s^2", "s", "K")
_ENDINGS = {
    "dps": "deg/s", "degs": "deg/s", "deg_s": "deg/s", "rads": "rad/s", "rad_s": "rad/s", "radps": "rad/s",
    "rps": "rad/s", "ms2": "m/s^2", "mps2": "m/s^2", "m_s2": "m/s^2", "m_s_2": "m/s^2",
}  # fmt: skip


@lru_cache(4096)
def split(text: str) -> tuple[str, str | None]:
    """`name[unit]` or `name(unit)` in its parts; unit None without brackets."""
    text = text.strip()
    match = re.fullmatch(r"([^[]*)\[(.*)\]", text) or re.fullmatch(r"(.*?)\(((?:[^()]|\([^()]*\))*)\)", text)
    return (match[1].strip(), match[2].strip()) if match else (text, None)


def sensors_of(
    file: str, keys: Sequence[str], own: Collection[str], taken: Mapping[str, str], before: Sequence[str] | None = None
) -> list[Sensor]:
    """The sensors of a table with the headings `keys`, in a file of this name; none where no form has them.

    `own`: names of axes here, whose headings need no form. `taken`: name by heading that the user states. `before`: the
    lines before the headings; None where they are not known yet.
    """
    native = [key for key in keys if key not in taken and split(key)[0] in own]
    if native or any(name in own for name in taken.values()):
        warm = {} if "temp" in taken.values() else _temperature(FORMS[-1], _free(keys, taken), "")
        return [Sensor("", warm | _native_time(keys, taken))]
    for form in FORMS:
        if form.before and before is not None and not any(line.startswith(form.before) for line in before):
            continue
        sensors = _by(form, file, keys, taken)
        if sensors:
            return sensors
    return []


def number_of(keys: Sequence[str]) -> str | None:
    """The heading of the column that numbers the sensors, if any."""
    return next((key for key in keys if split(key)[0].lower() in _NUMBERS), None)


def sides_of(keys: Iterable[str]) -> Sensor | None:
    """The temperature, with its time, of a table without axes; None without a temperature."""
    form = FORMS[-1]
    listed = list(keys)
    meant = _temperature(form, listed, "")
    return Sensor("", {**meant, **_time(form, listed, {}, "")}) if meant else None


def _native_time(keys: Sequence[str], taken: Mapping[str, str]) -> dict[str, Meaning]:
    """The time column of a table whose axes need no form."""
    names = [taken.get(key, split(key)[0]) for key in keys]
    times = [key for key, name in zip(keys, names, strict=True) if name.lower() in TIMES and key not in taken]
    if "t" not in names and len(times) == 1:
        return {times[0]: Meaning("t", split(times[0])[1])}
    return {} if "t" in names else _time(FORMS[-1], _free(keys, taken), taken, "")


def _free(keys: Sequence[str], taken: Mapping[str, str]) -> list[str]:
    """The headings that a form may look at: not those that the user maps, nor long ones, which take long."""
    return [key for key in keys if key not in taken and len(key) <= LONGEST_HEADING]


def _by(form: _Form, file: str, keys: Sequence[str], taken: Mapping[str, str]) -> list[Sensor]:
    """The sensors that a form finds."""
    if form.needs and form.needs not in keys:
        return []
    if form.file and form.file not in file.lower():
        return []
    free = _free(keys, taken)
    axes: dict[str, dict[str, Meaning]] = {}
    for letter, key, match, stated in _axes(form, free):
        axis = _VEHICLE.get(match["axis"].lower(), match["axis"].lower())
        name = letter + (axis if axis in "xyz" else "xyz"[int(axis) - (match[0][match.start("axis") - 1] in ":_")])
        source = (match.groupdict().get("source") or "").strip("/. ")
        axes.setdefault(source, {})[key] = Meaning(
            name,
            unit := stated or (form.gyro_unit if letter == "g" else form.accel_unit),
            1.0,
            unit is None and form is not FORMS[-1],
        )
    sensors = []
    for source, meant in axes.items():
        named = [meaning.name for meaning in meant.values()]
        if len(set(named)) < len(named):
            return []  # not this form's
        sensors.append(
            Sensor(source, {**meant, **_time(form, free, taken, source), **_temperature(form, free, source)})
        )
    return sensors


def _axes(form: _Form, keys: Sequence[str]) -> Iterator[tuple[str, str, re.Match[str], str | None]]:
    """Letter, heading, match and stated unit of a form's axes. In the last form a stated unit decides the sensor, and
    where no name is a gyro's or an accelerometer's, the unit alone does."""
    matches = [
        (letter, *own) for pattern, letter in ((form.gyro, "g"), (form.accel, "a")) for own in _matching(pattern, keys)
    ]
    if form is not FORMS[-1]:
        yield from matches
        return
    axes = [(_kind(stated) or letter, key, match, stated) for letter, key, match, stated in matches if _fits(stated)]
    named = {letter for letter, *_ in axes}
    known = {key for _, key, *_ in axes}
    for key, match, stated in _matching(_ANY, keys):
        if key not in known and (kind := _kind(stated)) and kind not in named:
            axes.append((kind, key, match, stated))
    yield from axes


def _kind(unit: str | None, kinds: Sequence[tuple[str, str]] = (("g", "rad/s"), ("a", "m/s^2"))) -> str | None:
    """`g` for a unit of a rate of turn, `a` for a unit of an acceleration, None for others. `kinds`: names of units."""
    name = units.plain(unit) if unit is not None else units.LSB
    if name == units.LSB or not units.known(name):
        return None
    return next((letter for letter, kind in kinds if units.same_kind(name, kind)), None)


def _fits(unit: str | None) -> bool:
    """Whether an axis may state this unit: a rate's, an acceleration's, counts, or an unknown unit."""
    return (
        _kind(unit) is not None or unit is None or units.plain(unit) == units.LSB or not units.known(units.plain(unit))
    )


def _time(form: _Form, keys: Sequence[str], taken: Mapping[str, str], source: str) -> dict[str, Meaning]:
    """The best time column for a source."""
    if "t" in taken.values():
        return {}
    for pattern, unit in form.times:
        for key, match, stated in _matching(pattern, keys):
            if (stated or unit == "") and _kind(stated or "", (("t", "s"),)) is None:
                continue
            if (match.groupdict().get("source") or source).strip("/. ") == source:
                return {key: Meaning("t", stated or unit, form.count)}
    return _in_two(keys, source)


def _in_two(keys: Sequence[str], source: str) -> dict[str, Meaning]:
    """The whole seconds of a source's time, and the column of their nanoseconds; nothing without both."""
    whole = {match[1]: key for key in keys if (match := re.fullmatch(r"(.*?)(?:secs?|seconds?)", key, re.IGNORECASE))}
    for key in keys:
        match = re.fullmatch(r"(.*?)(?:n|nano)(?:secs?|seconds?)", key, re.IGNORECASE)
        if match is not None and match[1] in whole and source in match[1]:
            return {whole[match[1]]: Meaning("t", "s"), key: Meaning(PART, "ns")}
    return {}


def _temperature(form: _Form, keys: Sequence[str], source: str) -> dict[str, Meaning]:
    """The temperature of a source, else the only temperature: by its name, else by its unit."""
    matches = [
        ((match.groupdict().get("source") or "").strip("/. "), key, stated)
        for key, match, stated in _matching(form.temperature, keys)
    ]
    of = [entry for entry in matches if entry[0] == source]
    others = matches or [("", key, unit) for key in keys if (unit := split(key)[1]) and _kind(unit, (("K", "K"),))]
    of = of or (others if len(others) == 1 else [])
    return {key: Meaning("temp", stated or (None if form is FORMS[-1] else "degC")) for _, key, stated in of[:1]}


def _matching(pattern: str | tuple[str, ...], keys: Sequence[str]) -> Iterator[tuple[str, re.Match[str], str | None]]:
    """Heading, match and the unit that it states, of the headings that any pattern fits."""
    patterns = [choice for choice in ([pattern] if isinstance(pattern, str) else pattern) if choice]
    for key in keys if patterns else ():
        match, unit = _first(patterns, key), None
        if match is None:
            name, unit = split(key)
            match = _first(patterns, name) if unit is not None else None
            if match is not None and unit is not None and not units.known(units.plain(unit)) and unit != units.LSB:
                unit = _ENDINGS.get(unit.lower().replace("/", ""), unit)
        if match is None:
            continue
        ending = match.groupdict().get("unit")
        if ending is not None:
            named = _ENDINGS.get(ending.lower(), units.plain(ending))
            if named == units.LSB or not units.known(named) or not any(units.same_kind(named, kind) for kind in _KINDS):
                continue
            unit = unit or named
        yield key, match, unit


def _first(patterns: Sequence[str], text: str) -> re.Match[str] | None:
    return next(filter(None, (re.fullmatch(pattern, text, re.IGNORECASE) for pattern in patterns)), None)


def parse_scales(texts: Sequence[str]) -> dict[str, Scale]:
    """`--scale` texts, `0.05`, `gx=0.05` or `gx=0.05[deg/s]`, as `load` takes them; the empty name is every column."""
    scales: dict[str, Scale] = {}
    for name, text in parse_pairs("--scale", [item if "=" in item else f"*={item}" for item in texts]).items():
        number, unit = split(text)
        try:
            scales["" if name == "*" else name] = (float(number), unit)
        except ValueError:
            wanted = "[NAME=]SIZE, a unit in brackets after it (gx=0.05[deg/s])"
            raise UserError(f"--scale takes {wanted}, not '{text}'") from None
    return scales
