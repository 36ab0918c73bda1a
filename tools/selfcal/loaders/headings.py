"""Headings of other programs: which columns of a table are a gyro's, an accelerometer's, the time and the temperature.

A form is a row of FORMS. The first whose axes are among the headings counts. Where a heading has a unit itself, this
unit counts, else the program's.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from selfcal import units
from selfcal.limits import LONGEST_HEADING

#: Headings of a time column that states its unit, or holds dates.
TIMES = ("time", "timestamp")


@dataclass(frozen=True)
class Meaning:
    """A column: its name here, its unit where the heading or the program states one, and the units of one count."""

    name: str
    unit: str | None = None
    size: float = 1.0


@dataclass(frozen=True)
class Sensor:
    """The columns of one sensor in a table, by heading. `source` names it among others, empty where it is alone."""

    source: str
    meant: Mapping[str, Meaning]


@dataclass(frozen=True)
class _Form:
    """A program's columns: patterns of whole headings, for an axis with a group `axis` and perhaps a `source`.

    `times`: patterns and units of the time, the best first. `file`: what the file's name must have. `needs`: a heading
    that must be there.
    """

    gyro: str = ""
    accel: str = ""
    times: tuple[tuple[str, str | None], ...] = ()
    temperature: str = ""
    gyro_unit: str | None = "rad/s"
    accel_unit: str | None = "m/s^2"
    file: str = ""
    needs: str = ""
    count: float = 1.0
    """Of the time: units of one count."""


_AXIS = r"(?P<axis>[xyz])"
_PLACE = r"\[(?P<axis>[012])\]"
_ROS = r"(?:(?P<source>.*)[./])?"
#: A word of a name before the sensor's own: `imu0_gyro_x`, `left/acc.y`.
_BEFORE = r"(?:(?P<source>.+?)[ ._/-])?"
_AFTER = r"(?:[ _]?(?:data|raw|adc|calib|uncalibrated))?[ ._/:\[(-]*(?P<axis>[xyz]|[123](?<=:.))\]?(?:_(?P<unit>\w+))?"
_GYRO = r"(?:gyr|gyros?|gyroscope|ang(?:ular)?[_ ]?vel(?:ocity)?|ang(?:ular)?[_ ]?rate|rate[_ ]of[_ ]turn|omega|w)"
_ACCEL = r"(?:acc|accel|accelerometer|acceleration|lin(?:ear)?[_ ]?acc(?:eleration)?|specific[_ ]?force)"

FORMS = (
    # EuRoC and Kalibr
    _Form(rf"w_RS_S_{_AXIS}", rf"a_RS_S_{_AXIS}", (("#?timestamp", "ns"), ("time", "ns"))),
    # PX4, as ulog2csv writes it: topic sensor_combined; then sensor_gyro and sensor_accel, which the file's name tells
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
    # Xsens MT Manager; a tick of its clock is 100 us
    _Form(
        rf"Gyr_{_AXIS}", rf"Acc_{_AXIS}", (("SampleTimeFine", "us"),), "Temp(?:erature)?", count=100.0,
        needs="PacketCounter",
    ),
    # Sensor Logger; the values without gravity, `Accelerometer`, are an estimate
    _Form(_AXIS, "", (("time", "ns"),), file="gyroscope", needs="seconds_elapsed"),
    _Form("", _AXIS, (("time", "ns"),), file="accel", needs="seconds_elapsed"),
    # phyphox: one table, or one a sensor
    _Form(rf"Gyroscope {_AXIS}", rf"(?:Acceleration|Accelerometer) {_AXIS}", (("Time", "s"),)),
    _Form(_AXIS, "", (("Time", "s"),), file="gyroscope"),
    _Form("", _AXIS, (("Time", "s"),), file="accel"),
    # Everyone else's
    _Form(
        f"{_BEFORE}{_GYRO}{_AFTER}",
        f"{_BEFORE}{_ACCEL}{_AFTER}",
        ((r"#?time(?:[_ ]?stamp)?(?:_(?P<unit>\w+))?", None), (r"t(?:_(?P<unit>\w+))?", None)),
        rf"{_BEFORE}temp(?:erature)?(?:_(?P<unit>\w+))?",
        gyro_unit=None,
        accel_unit=None,
    ),
)  # fmt: skip

#: Units at the end of a name: `gyro_x_dps`, `time_us`, `temp_c`.
_ENDINGS = {
    "dps": "deg/s", "degs": "deg/s", "deg_s": "deg/s", "rads": "rad/s", "rad_s": "rad/s", "radps": "rad/s",
    "rps": "rad/s", "ms2": "m/s^2", "mps2": "m/s^2", "m_s2": "m/s^2", "m_s_2": "m/s^2", "g": "g", "mg": "mg",
    "s": "s", "sec": "s", "ms": "ms", "us": "us", "ns": "ns", "c": "degC", "degc": "degC", "k": "K",
}  # fmt: skip


@lru_cache(4096)
def split(text: str) -> tuple[str, str | None]:
    """`name[unit]` or `name(unit)` in its parts; unit None without brackets."""
    text = text.strip()
    match = re.fullmatch(r"([^[]*)\[(.*)\]", text) or re.fullmatch(r"(.*?)\(((?:[^()]|\([^()]*\))*)\)", text)
    return (match[1].strip(), match[2].strip()) if match else (text, None)


def sensors_of(file: str, keys: Sequence[str], own: Collection[str], taken: Mapping[str, str]) -> list[Sensor]:
    """The sensors of a table with the headings `keys`, in a file of this name; none where no form has them.

    `own`: names of axes here, whose headings need no form. `taken`: name by heading that the user states.
    """
    native = [key for key in keys if key not in taken and split(key)[0] in own]
    if native or any(name in own for name in taken.values()):
        return [Sensor("", _native(keys, taken))]
    for form in FORMS:
        found = _by(form, file, keys, taken)
        if found:
            return found
    return []


def sides_of(keys: Iterable[str]) -> Sensor | None:
    """The temperature, with its time, of a table without axes; None where there is none."""
    form = FORMS[-1]
    listed = list(keys)
    meant = _temperature(form, listed, "")
    return Sensor("", {**meant, **_time(form, listed, {}, "")}) if meant else None


def _native(keys: Sequence[str], taken: Mapping[str, str]) -> dict[str, Meaning]:
    """The time column of a table whose axes need no form."""
    names = [taken.get(key, split(key)[0]) for key in keys]
    times = [key for key, name in zip(keys, names, strict=True) if name.lower() in TIMES and key not in taken]
    return {times[0]: Meaning("t", split(times[0])[1])} if "t" not in names and len(times) == 1 else {}


def _by(form: _Form, file: str, keys: Sequence[str], taken: Mapping[str, str]) -> list[Sensor]:
    """The sensors that a form finds."""
    if form.needs and form.needs not in keys:
        return []
    if form.file and form.file not in file.lower():
        return []
    free = [key for key in keys if key not in taken and len(key) <= LONGEST_HEADING]
    axes: dict[str, dict[str, Meaning]] = {}
    for pattern, letter, unit in ((form.gyro, "g", form.gyro_unit), (form.accel, "a", form.accel_unit)):
        for key, match, stated in _matching(pattern, free):
            axis = match["axis"].lower()
            name = letter + (axis if axis in "xyz" else "xyz"[int(axis) - (":" in key)])
            source = (match.groupdict().get("source") or "").strip("/. ")
            axes.setdefault(source, {})[key] = Meaning(name, stated or unit)
    found = []
    for source, meant in axes.items():
        named = [one.name for one in meant.values()]
        if len(set(named)) < len(named):
            return []  # not this form's
        found.append(Sensor(source, {**meant, **_time(form, free, taken, source), **_temperature(form, free, source)}))
    return found


def _time(form: _Form, keys: Sequence[str], taken: Mapping[str, str], source: str) -> dict[str, Meaning]:
    """The best time column for a source."""
    if "t" in taken.values():
        return {}
    for pattern, unit in form.times:
        for key, match, stated in _matching(pattern, keys):
            if (match.groupdict().get("source") or source).strip("/. ") == source:
                return {key: Meaning("t", stated or unit, form.count)}
    return {}


def _temperature(form: _Form, keys: Sequence[str], source: str) -> dict[str, Meaning]:
    """The temperature of a source, else the only one that there is."""
    found = [
        ((match.groupdict().get("source") or "").strip("/. "), key, stated)
        for key, match, stated in _matching(form.temperature, keys)
    ]
    of = [one for one in found if one[0] == source] or (found if len(found) == 1 else [])
    return {key: Meaning("temp", stated or (None if form is FORMS[-1] else "degC")) for _, key, stated in of[:1]}


def _matching(pattern: str, keys: Sequence[str]) -> Iterator[tuple[str, re.Match[str], str | None]]:
    """Heading, match and the unit that it states, of the headings that a pattern fits."""
    if not pattern:
        return
    for key in keys:
        match = re.fullmatch(pattern, key, re.IGNORECASE)
        unit = None
        if match is None:
            name, unit = split(key)
            match = re.fullmatch(pattern, name, re.IGNORECASE) if unit is not None else None
            if match is not None and unit is not None and not units.known(units.plain(unit)) and unit != units.LSB:
                unit = _ENDINGS.get(unit.lower().replace("/", ""), unit)
        if match is None:
            continue
        ending = match.groupdict().get("unit")
        if ending is not None:
            if ending.lower() not in _ENDINGS:
                continue
            unit = unit or _ENDINGS[ending.lower()]
        yield key, match, unit
