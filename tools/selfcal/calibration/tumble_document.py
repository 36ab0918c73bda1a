"""The document `selfcal.tumble/1`: parameters with their intervals, what is not identified, and what would mend it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from selfcal.adequacy.identify_document import recording_entry
from selfcal.bank.axis_result import HALF_90
from selfcal.base.grid import Array
from selfcal.calibration import accelerometer, gyroscope
from selfcal.calibration.accelerometer import Accelerometer
from selfcal.calibration.gyroscope import Gyroscope
from selfcal.calibration.tumble_fit import VARIANCE_LEFT_MOST, TumbleFit
from selfcal.calibration.tumble_plan import EDGES, FLATS, OPPOSITE
from selfcal.calibration.tumble_rests import ACCEL, GYRO, Tumble
from selfcal.logs.recording import Recording
from selfcal.readings.budget import FALSE_ALARM

SCHEMA = "selfcal.tumble/1"
AXES = ("x", "y", "z")
#: Names of parameters in the order of the fit: group (empty: of the surroundings), name, unit.
OF_ACCEL = (
    *(("bias", name, "m/s^2") for name in ACCEL),
    *(("scale", name, "1") for name in ACCEL),
    *(("misalignment", AXES[row] + AXES[column], "rad") for row, column in accelerometer.PLACES),
    ("", "gravity", ""),
    *(("temperature", name, "m/s^2/degC") for name in ACCEL),
)
OF_GYRO = (
    *(("bias", name, "deg/s") for name in GYRO),
    *(("g_sensitivity", row + column, "deg/s/g") for row in AXES for column in AXES),
    *(("scale", name, "1") for name in GYRO),
    *(("misalignment", AXES[row] + AXES[column], "rad") for row, column in gyroscope.PLACES),
    ("", "vertical rate of the Earth", ""),
    *(("temperature", name, "deg/s/degC") for name in GYRO),
)


def tumble_document(
    recordings: Sequence[Recording], accel: Accelerometer, gyro: Gyroscope | str | None
) -> dict[str, Any]:
    """The whole answer, in SI units and degrees. `gyro`: None without gyros, a line where they have no answer."""
    place, tumble = accel.place, accel.tumble
    notes = [*tumble.notes, *(f"{text}: left out" for text in tumble.left_out), *_notes_of_turns(accel)]
    return {
        "schema": SCHEMA,
        "recordings": [recording_entry(recording) for recording in recordings],
        "gravity": {"value": place.gravity, "sd": place.sd, "unit": "m/s^2", "source": place.words},
        "earth_rate_known": place.vertical is not None,
        "bias_at_s": accel.tumble.reference_s,
        "noise": {
            name: {
                "N": math.sqrt(noise.white),
                "unit": "m/s^2/sqrt(Hz)" if name in ACCEL else "rad/s/sqrt(Hz)",
                "drift": noise.words,
            }
            for name, noise in tumble.noise.items()
            if noise.words
        },
        "rests": _rests(accel),
        "turns": [
            {
                "start_s": tumble.rests[turn.first].at_s[1],
                "end_s": tumble.rests[turn.first + 1].at_s[0],
                "log": tumble.rests[turn.first].log,
                "left_out": turn.reason or None,
            }
            for turn in tumble.turns
        ],
        "accelerometer": {
            **_entries(tumble, accel.fit, 0, OF_ACCEL),
            **_adequacy(accel.fit, accelerometer.causes(accel)),
            "would_mend": _positions(accel),
        },
        "gyroscope": None
        if gyro is None
        else {"error": gyro}
        if isinstance(gyro, str)
        else {
            **_entries(tumble, gyro.fit, gyro.of_accel, OF_GYRO),
            **_adequacy(gyro.fit, gyroscope.causes(gyro, tumble)),
            "would_mend": _turns(gyro, tumble),
        },
        "notes": notes,
    }


def _entry(fit: TumbleFit, k: int, unit: str, size: float) -> dict[str, Any]:
    """A parameter; without its numbers if it is not identified."""
    identified = bool(fit.identified[k])
    value, sd = size * float(fit.theta[k]), size * math.sqrt(float(fit.covariance[k, k]))
    ends = (value - HALF_90 * sd, value + HALF_90 * sd)
    numbers = {"median": value, "sd": sd, "q05": ends[0], "q95": ends[1]}
    return {**(numbers if identified else dict.fromkeys(numbers)), "unit": unit, "identified": identified}


def _entries(tumble: Tumble, fit: TumbleFit, start: int, names: Sequence[tuple[str, str, str]]) -> dict[str, Any]:
    """Parameters from `start` on by group and name; temperature coefficients where the logs have a temperature."""
    entries: dict[str, Any] = {}
    for k, (group, name, unit) in enumerate(names, start):
        if group and (group != "temperature" or tumble.has_temp):
            size = math.degrees(1.0) if unit.startswith("deg/s") else 1.0
            entries.setdefault(group, {})[name] = _entry(fit, k, unit, size)
    return entries | ({"bias_at_degC": float(tumble.temp.mean())} if tumble.has_temp else {})


def _adequacy(fit: TumbleFit, causes: Sequence[tuple[str, float]]) -> dict[str, Any]:
    """Whether the residuals are as large as their sd says; None where too few are left to say."""
    checked = math.isfinite(fit.excess)
    fits = False if causes else fit.excess >= FALSE_ALARM if checked else None
    return {
        "adequate": fits,
        "residual_ratio": fit.ratio if checked else None,
        "findings": [{"cause": said, "p": p} for said, p in causes],
    }


def _rests(accel: Accelerometer) -> list[dict[str, Any]]:
    """Rests with the side that is up, and the residual of |f| with its sd."""
    tumble, fit = accel.tumble, accel.fit
    f = accel.force(tumble.accel, tumble.warmth)
    size = np.linalg.norm(f, axis=1)
    residual = size - accel.place.gravity * (1.0 + fit.theta[accelerometer.GRAVITY])
    sd = np.sqrt(np.diag(fit.root @ fit.root.T))
    return [
        {
            "log": rest.log,
            "start_s": rest.at_s[0],
            "end_s": rest.at_s[1],
            "up": (f[k] / size[k]).tolist(),
            "residual": float(residual[k]),
            "sd": float(sd[k]),
            "unit": "m/s^2",
        }
        for k, rest in enumerate(tumble.rests)
    ]


def side_up(up: Array) -> str:
    """The side that is up in words: `+x`, `-y -z`."""
    return " ".join(f"{'+' if up[k] > 0 else '-'}{AXES[k]}" for k in range(3) if abs(up[k]) > 0.4 * np.abs(up).max())


def _positions(accel: Accelerometer) -> list[str]:
    """Further rests by which every parameter would be identified, the most informative rest first."""
    fit, place, own = accel.fit, accel.place, slice(0, accelerometer.GRAVITY)
    if fit.identified[own].all():
        return []
    rests = accel.tumble.rests
    seconds = float(np.median([rest.seconds for rest in rests]))
    white = max(accel.tumble.noise[name].white for name in ACCEL) / seconds
    noise = white + max(np.diag(accel.fit.root @ accel.fit.root.T).mean(), 0.0)
    covariance, named = fit.widened(), []
    inverse = np.linalg.inv(accel.matrix)
    sides = [np.array(up) / np.linalg.norm(up) for up in FLATS + EDGES + OPPOSITE]
    for _ in range(4):
        best, gained = None, 0.0
        weak = np.diag(covariance)[own] > VARIANCE_LEFT_MOST * np.diag(fit.prior)[own]
        for up in sides:
            reading = inverse @ (up * place.gravity) + fit.theta[accelerometer.BIAS]
            row = up @ accelerometer.forces(fit.theta, reading[None], np.zeros(1))[1][0]
            row[accelerometer.GRAVITY] = -place.gravity
            moved = covariance @ row
            less = moved**2 / (float(row @ moved) + noise)
            share = float((less[own] / np.diag(fit.prior)[own])[weak].sum())
            if share > gained * 1.001:
                best, gained, update = up, share, (row, moved)
        if best is None:
            break
        named.append(f"{side_up(best)} up")
        row, moved = update
        covariance -= np.outer(moved, moved) / (float(row @ moved) + noise)
        if (np.diag(covariance)[own] <= VARIANCE_LEFT_MOST * np.diag(fit.prior)[own]).all():
            break
    return named


def _turns(gyro: Gyroscope, tumble: Tumble) -> list[str]:
    """Further rests and turns by which every parameter would be identified."""
    identified = gyro.fit.identified[gyro.of_accel :]
    if absent := [name for name, noise in tumble.noise.items() if not noise.words]:
        return [f"a log with {', '.join(absent)} as well"]
    named = []
    if not identified[gyroscope.G].all():
        named.append("rests with other sides up: four or more, not all in one plane")
    for k, axis in enumerate(AXES):
        own = [identified[gyroscope.ANGLE][n] for n, (_, column) in enumerate(gyroscope.PLACES) if column == k]
        if not (identified[gyroscope.SCALE][k] and all(own)):
            named.append(f"turns of 60 to 120 deg about {axis}, with {axis} level, from two sides")
    return named


def _notes_of_turns(accel: Accelerometer) -> list[str]:
    """Turns that are left out, and turns that show little."""
    tumble, lines = accel.tumble, []
    f = accel.force(tumble.accel, tumble.warmth)
    u = f / np.linalg.norm(f, axis=1)[:, None]
    for turn in tumble.turns:
        where = f"turn of {tumble.rests[turn.first].at_s[1]:.6g} to {tumble.rests[turn.first + 1].at_s[0]:.6g} s"
        if turn.reason:
            lines.append(f"{where}: {turn.reason}: left out")
            continue
        way = float(np.linalg.norm(turn.gyro - tumble.rests[turn.first].gyro, axis=1).sum()) * turn.dt
        apart = math.acos(float(np.clip(u[turn.first] @ u[turn.first + 1], -1.0, 1.0)))
        # A turn of more than 30 deg that ends within 15 deg of where it began shows little.
        if way > math.radians(30.0) and apart < math.radians(15.0):
            lines.append(f"{where}: {math.degrees(way):.0f} deg, and the same side is up: it tells little")
    return lines
