"""`selfcal worth`: how wrong the bias is some time after a rest, by the bank and by what people flash today."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

from selfcal.base.errors import UserError, printable
from selfcal.base.grid import Array
from selfcal.base.output import console_of, print_line, table_of
from selfcal.base.units import STANDARD_GRAVITY, converted, same_kind
from selfcal.batch.spread import Row
from selfcal.logs.recording import Recording, load
from selfcal.model.file import Group, Model
from selfcal.model.simulated_parts import AXES, SHEET_N, SHEET_STABILITY, SHEET_TIME_S, simulate_axis
from selfcal.model.tables import make_tables

SCHEMA = "selfcal.worth/1"
#: Lengths of rest, and times after it for the bias, s.
RESTS_S, HORIZONS_S = (60, 300, 1800), (1, 10, 60, 300, 1000)
#: Length of "the last seconds", s.
LAST_S = 10
#: Corner of x-io Fusion's bias filter, Hz.
CORNER_HZ = 0.02
#: Length of dead reckoning, s, and its seconds after a rest.
RECKONED_S = 60
SECONDS = (*range(1, RECKONED_S + 1), *(h for h in HORIZONS_S if h > RECKONED_S))
#: Errors of dead reckoning in the document, and in the table.
RECKONED = {"heading_deg": "heading, deg", "position_m": "position, m"}
#: The gyro that turns each horizontal accelerometer out of the level.
ACROSS = {"ax": "gy", "ay": "gx"}
#: Length of the real readings whose mean is the bias then, s.
REFERENCE_S = 30
#: The methods, in the order of the table.
TITLES = {
    "bank": "selfcal, the bank",
    "last": f"mean of the last {LAST_S} s",
    "rest": "mean of the whole rest",
    "exponential": f"exponential average, corner {CORNER_HZ:g} Hz",
    "kalman": "fixed-gain Kalman, data-sheet numbers",
    "none": "no correction",
}
#: Further method for simulated parts: dead reckoning with a known bias has the white noise alone.
KNOWN = "known"


@dataclass(frozen=True)
class Job:
    """A simulated part: its law, s of rest, the seed."""

    law: str
    rest_s: int
    seed: int


def predictions(model: Model, axis: str, y: Array) -> tuple[dict[str, Array], Array]:
    """The bias at each of SECONDS by each method, and the bank's own sd."""
    from selfcal.bank.library import Bank

    bank = Bank(make_tables(model, 1.0, (axis,), bank_rate_hz=1.0))
    bank.push(y[:, None])
    predicted = np.array(bank.raw.predict(0, [float(s) for s in SECONDS]))
    level: dict[str, Callable[[Group, Array], float]] = {
        "last": lambda _, seen: float(seen[-LAST_S:].mean()),
        "rest": lambda _, seen: float(seen.mean()),
        "exponential": lambda _, seen: _average(seen, -math.expm1(-2.0 * math.pi * CORNER_HZ)),
        "kalman": lambda group, seen: _average(seen, _gain(group)),
        "none": lambda _, __: 0.0,
    }
    group = model.group_of(axis)
    levels = {name: np.full(len(SECONDS), method(group, y)) for name, method in level.items()}
    return {"bank": predicted[:, 0], **levels}, predicted[:, 1]


def heading_error(rate: Array) -> float:
    """deg after the seconds of `rate` [seconds], the error of an upright gyro in deg/s: psi' = rate."""
    return float(rate.sum())


def position_error(rate: Array, acceleration: Array) -> float:
    """m along one level axis after the seconds of `rate` and `acceleration` [seconds], the errors of the gyro across in
    deg/s and of the accelerometer along in m/s^2.

    tilt' = rate, v' = acceleration + g tilt, p' = v, from 0: a vehicle at rest or at constant velocity, small angles,
    errors that stand still for a second each. At rest the accelerometer's bias has the share of gravity of the tilt, so
    taking it off levels the vehicle too.
    """
    left = np.arange(rate.size)[::-1]
    by_tilt = ((left + 1) ** 3 - left**3) @ np.radians(rate) / 6.0
    return float(STANDARD_GRAVITY * by_tilt + ((left + 1) ** 2 - left**2) @ acceleration / 2.0)


def _average(y: Array, gain: float) -> float:
    """A first-order filter that begins at the first reading."""
    state, _ = signal.lfilter([gain], [1.0, gain - 1.0], y, zi=[(1.0 - gain) * y[0]])
    return float(state[-1])


def _gain(group: Group) -> float:
    """Steady gain of the Kalman filter of a random walk under white noise, by the data sheet."""
    unit = "deg/s" if same_kind(group.unit, "deg/s") else "m/s^2"
    r, q = SHEET_N[unit] ** 2, SHEET_STABILITY[unit] ** 2 / SHEET_TIME_S
    p = 0.5 * (q + math.sqrt(q * q + 4.0 * q * r))
    return p / (p + r)


@dataclass(frozen=True)
class After:
    """An axis after a rest, in its unit: what each method predicts of the bias at SECONDS, the bank's sd, and the
    readings of the minute."""

    unit: str
    predicted: Mapping[str, Array]
    sd: Array
    minute: Array

    @classmethod
    def of(cls, model: Model, axis: str, y: Array, rest: int) -> After:
        """`y`: the rest and what follows."""
        return cls(model.group_of(axis).unit, *predictions(model, axis, y[:rest]), y[rest : rest + RECKONED_S])

    def errors(self, unit: str) -> dict[str, Array]:
        """Errors of the minute's corrected readings, by method."""
        errors = {name: self.minute - bias[:RECKONED_S] for name, bias in self.predicted.items()}
        return {name: converted(error, self.unit, unit) for name, error in errors.items()}

    def row(self, case: str, rest: int, truth: Array) -> Row:
        """Errors of the bias, `truth` at HORIZONS_S."""
        row: Row = {"case": case, "unit": self.unit, "rest_s": rest}
        for horizon, true in zip(HORIZONS_S, truth, strict=True):
            k = SECONDS.index(horizon)
            row |= {f"error.{name}.{horizon}": float(bias[k] - true) for name, bias in self.predicted.items()}
            row[f"sd.{horizon}"] = float(self.sd[k])
        return row


def _heading(gyro: After) -> Row:
    return {f"heading_deg.{name}": heading_error(rate) for name, rate in gyro.errors("deg/s").items()}


def _position(gyro: After, accelerometer: After) -> Row:
    rate = gyro.errors("deg/s")
    return {
        f"position_m.{name}": position_error(rate[name], acceleration)
        for name, acceleration in accelerometer.errors("m/s^2").items()
    }


def simulated(model: Model, job: Job) -> list[Row]:
    """A single gyro stands for the upright gyro and the gyro across: no figure has both."""
    after, truth, noise = {}, {}, {}
    for axis in ("gx", "ax"):
        y, truth[axis] = simulate_axis(job.law, job.rest_s + HORIZONS_S[-1], job.seed, axis=axis)
        noise[axis] = (y - truth[axis])[job.rest_s :][:RECKONED_S]
        after[axis] = After.of(model, axis, converted(y, AXES[axis], model.group_of(axis).unit), job.rest_s)
    samples = [job.rest_s - 1 + h for h in HORIZONS_S]
    row = after["gx"].row(job.law, job.rest_s, converted(truth["gx"][samples], AXES["gx"], after["gx"].unit))
    row |= _heading(after["gx"]) | _position(after["gx"], after["ax"])
    row[f"heading_deg.{KNOWN}"] = heading_error(noise["gx"])
    row[f"position_m.{KNOWN}"] = position_error(noise["gx"], noise["ax"])
    return [row]


def _means(recording: Recording, model: Model, name: str) -> Array:
    """Means of 1 s of a recorded axis, NaN in gaps."""
    from selfcal.bank.blocks import bank_means

    unit = model.group_of(name).unit
    if not (same_kind(unit, "rad/s") or same_kind(unit, "m/s^2")):
        raise UserError(f"{recording.path}: {name}: worth takes gyros and accelerometers; choose with --axis")
    return bank_means(recording, model, name, 1.0)[0]


def recorded(log: Path | str, model: Model, wanted: Sequence[str]) -> list[Row]:
    """The errors of every method after the rests of a recording. Raises UserError as `load` does."""
    from selfcal.adequacy.identify import chosen_axes
    from selfcal.studies.rivals import longest_stretch

    recording = load(log)
    means = {name: _means(recording, model, name) for name in chosen_axes(recording, model, wanted)}
    rows = []
    for name, mean in means.items():
        across = means.get(ACROSS.get(name, ""))
        both = mean if across is None else mean + across
        stretch = longest_stretch(np.where(np.isfinite(both), np.arange(both.size), np.nan)).astype(int)
        gyro = same_kind(model.group_of(name).unit, "rad/s")
        for rest in RESTS_S:
            span = rest + HORIZONS_S[-1] + REFERENCE_S
            for start in range(0, stretch.size - span + 1, span):
                piece = mean[stretch[start : start + span]]
                after = After.of(model, name, piece, rest)
                truth = np.array([piece[rest + h - 1 : rest + h - 1 + REFERENCE_S].mean() for h in HORIZONS_S])
                row = after.row(f"recorded {'gyros' if gyro else 'accelerometers'}", rest, truth)
                if gyro:
                    row |= _heading(after)
                elif across is not None:
                    turning = After.of(model, ACROSS[name], across[stretch[start : start + span]], rest)
                    row |= _position(turning, after)
                rows.append(row)
    return rows


def summary(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The document: rms errors by case and length of the rest."""
    entries = []
    for case, rest in dict.fromkeys((row["case"], row["rest_s"]) for row in rows):
        mine = [row for row in rows if (row["case"], row["rest_s"]) == (case, rest)]
        entry: dict[str, Any] = {"case": case, "unit": mine[0]["unit"], "rest_s": rest, "rests": len(mine)}
        entry["rms_error"] = {name: {str(h): _rms(mine, f"error.{name}.{h}") for h in HORIZONS_S} for name in TITLES}
        entry["bank_stated_sd"] = {str(h): _rms(mine, f"sd.{h}") for h in HORIZONS_S}
        entry["dead_reckoning"] = {
            key: {name: _rms(having, f"{key}.{name}") for name in (*TITLES, KNOWN) if f"{key}.{name}" in having[0]}
            for key in RECKONED
            if (having := [row for row in mine if f"{key}.bank" in row])
        }
        entries.append(entry)
    return entries


def regret(cases: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """By method, its error over the least of all methods in the same case and rest: `worst` and `median` of the bias,
    over all horizons, and of each of RECKONED."""
    groups: dict[str, list[Mapping[str, float]]] = {"bias": [], **{key: [] for key in RECKONED}}
    for entry in cases:
        for horizon in map(str, HORIZONS_S):
            groups["bias"].append({name: entry["rms_error"][name][horizon] for name in TITLES})
        for key, errors in entry["dead_reckoning"].items():
            groups[key].append({name: errors[name] for name in TITLES})
    worst: dict[str, dict[str, Any]] = {}
    for name in TITLES:
        ratios = {
            key: [errors_of[name] / min(errors_of.values()) for errors_of in group]
            for key, group in groups.items()
            if group
        }
        spread = {key: {"worst": max(all_), "median": float(np.median(all_))} for key, all_ in ratios.items()}
        worst[name] = {**spread.pop("bias"), **spread}
    return worst


def _rms(rows: Sequence[Row], key: str) -> float:
    return math.sqrt(sum(row[key] ** 2 for row in rows) / len(rows))


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """A table a case; the least error of each column is bold."""
    console = console_of(to_stderr=to_stderr)
    console.width = max(console.width, 160)
    cases: dict[str, list[Mapping[str, Any]]] = {}
    for entry in document["cases"]:
        cases.setdefault(entry["case"], []).append(entry)
    for case, entries in cases.items():
        title = f"{case}: rms error of the bias after a rest, {printable(entries[0]['unit'])}"
        reckoned = entries[0]["dead_reckoning"]
        if reckoned:
            title += f"; of {RECKONED_S} s of dead reckoning"
        after = (f"after {h} s" for h in HORIZONS_S)
        table = table_of(("rest", "method", *after, *(RECKONED[key] for key in reckoned)), title)
        for entry in entries:
            columns = [{name: errors[str(h)] for name, errors in entry["rms_error"].items()} for h in HORIZONS_S]
            columns += entry["dead_reckoning"].values()
            least = [min(column[name] for name in TITLES) for column in columns]
            first = f"{entry['rest_s'] // 60} min, {entry['rests']} rests"
            for name, method in TITLES.items():
                cells = [
                    f"[bold]{column[name]:.3g}[/]" if column[name] == best else f"{column[name]:.3g}"
                    for column, best in zip(columns, least, strict=True)
                ]
                table.add_row(first, method, *cells)
                first = ""
            sds = [f"{sd:.3g}" for sd in entry["bank_stated_sd"].values()]
            known = [f"{column[KNOWN]:.3g}" if KNOWN in column else "" for column in columns]
            table.add_row("", "  sd that the bank states", *sds, end_section=not any(known))
            if any(known):
                table.add_row("", "  the white noise alone", *known, end_section=True)
        console.print(table)
    regrets = document["regret"]
    reckoned = [key for key in RECKONED if key in regrets["bank"]]
    headings = ("method", "bias", *(RECKONED[key].partition(",")[0] for key in reckoned))
    table = table_of(headings, "error over the least of all methods: median, worst")
    for name, ratio in regrets.items():
        shown = (
            f"{spread['median']:.3g}, {spread['worst']:.3g}" for spread in (ratio, *(ratio[key] for key in reckoned))
        )
        table.add_row(TITLES[name], *shown)
    console.print(table)
    if document["recordings"]:
        print_line(
            console,
            f"the mean of the {REFERENCE_S} s that follow stands for the truth; its own noise is in every error, and "
            "gravity in an accelerometer's bias",
        )
