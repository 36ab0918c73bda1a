"""`selfcal worth`: how wrong the bias is some time after a rest, by the bank and by what people flash today."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table
from scipy import signal

from selfcal.document import check_writable, write_json
from selfcal.errors import UserError, printable
from selfcal.model import Group, Model
from selfcal.recording import as_float, load
from selfcal.spread import Row, spread
from selfcal.tables import make_tables
from selfcal.units import same_kind

Floats = NDArray[np.float64]

SCHEMA = "selfcal.worth/1"
#: s of rest, and s after its end at which the bias is wanted.
RESTS_S, HORIZONS_S = (60, 300, 1800), (1, 10, 60, 300, 1000)
#: The truths of simulated records: what `identify` finds on an ADIS16405's gyros (README), deg/s and s.
TRUTHS: dict[str, dict[str, float]] = {
    "constant": {"N": 0.04},
    "random_walk": {"N": 0.04, "K": 1.4e-3},
    "gauss_markov": {"N": 0.04, "sigma_m": 0.02, "alpha": 1.0 / 200.0},
}
#: sd of a simulated part's turn-on bias: the data sheet's initial bias error, deg/s.
TURN_ON = 3.0
#: s of "the last seconds".
LAST_S = 10
#: Corner of x-io Fusion's bias filter, Hz.
CORNER_HZ = 0.02
#: The ADIS16405's data sheet: random walk 2 deg/sqrt(h) and 0.2 m/s/sqrt(h), in-run bias stability 0.007 deg/s and 0.2
#: mg. In the units of the default model.
SHEET_N = {"rad/s": 2.0 / 60.0, "m/s^2": 0.2 / 60.0}
SHEET_STABILITY = {"rad/s": 0.007, "m/s^2": 0.2e-3 * 9.80665}
#: s over which a filter designer lets the bias walk by its stability.
SHEET_TIME_S = 100.0
#: s of real readings whose mean stands for the bias then.
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


@dataclass(frozen=True)
class Job:
    """A simulated part: its law, s of rest, the seed."""

    law: str
    rest_s: int
    seed: int


def worth(
    logs: Sequence[Path | str] = (),
    *,
    axes: Sequence[str] = (),
    model: Path | str | None = None,
    records: int = 200,
    seed: int = 1,
    json: Path | str | None = None,
    scheduler: str | None = None,
    results: Path | str | None = None,
) -> dict[str, Any]:
    """Predict the bias 1 to 1000 s after rests of 1, 5 and 30 min.

    With `logs`: rests that do not overlap, from each recording's axes; the mean of the 30 s that follow stands for the
    truth. Without: `records` simulated parts of each law and rest, whose bias is known. The samples are means of 1 s.
    Returns the document `selfcal.worth/1`: rms errors by case, rest, method and horizon.
    """
    check_writable(json)
    loaded = replace(Model.load(model), regressors=(), half_life_s=0.0)
    if records < 2:
        raise UserError("--records must be at least 2")
    if logs:
        rows = [row for log in logs for row in _recorded(log, loaded, axes)]
        if not rows:
            span = RESTS_S[0] + HORIZONS_S[-1] + REFERENCE_S
            raise UserError(f"the recordings are too short: {span} s without a gap are needed; record longer")
    else:
        jobs = [Job(law, rest, seed + 1_000_003 * k) for law in TRUTHS for rest in RESTS_S for k in range(records)]
        settings = {"schema": SCHEMA, "model": repr(replace(loaded, path=Path(), name="")), "seed": seed}
        settings["records"] = str(records)  # the jobs' order has it
        rows = spread(
            partial(_simulated, loaded), jobs, settings=settings, piece=32, scheduler=scheduler, results=results
        )
    cases = _summary(rows)
    document = {"schema": SCHEMA, "recordings": [str(log) for log in logs], "cases": cases, "regret": regret(cases)}
    if json is not None:
        write_json(document, json)
    return document


def simulate(law: str, samples: int, seed: int) -> tuple[Floats, Floats]:
    """Readings of 1 s and the bias in them, both [samples]."""
    rng, truth = np.random.default_rng([seed, list(TRUTHS).index(law)]), TRUTHS[law]
    steps = rng.standard_normal(samples)
    drift = np.zeros(samples)
    if law == "random_walk":
        drift = truth["K"] * np.cumsum(steps)
    elif law == "gauss_markov":
        phi = math.exp(-truth["alpha"])
        steps[1:] *= math.sqrt(1.0 - phi**2)
        drift = truth["sigma_m"] * signal.lfilter([1.0], [1.0, -phi], steps)
    bias = TURN_ON * rng.standard_normal() + drift
    return bias + truth["N"] * rng.standard_normal(samples), bias


def predictions(model: Model, axis: str, y: Floats) -> tuple[dict[str, list[float]], list[float]]:
    """The bias at each horizon by each method, and the bank's own sd."""
    from selfcal.engines.library import Bank

    bank = Bank(make_tables(model, 1.0, (axis,), bank_rate_hz=1.0))
    bank.push(y[:, None])
    told = bank.raw.predict(0, [float(h) for h in HORIZONS_S])
    level: dict[str, Callable[[Group, Floats], float]] = {
        "last": lambda _, seen: float(seen[-LAST_S:].mean()),
        "rest": lambda _, seen: float(seen.mean()),
        "exponential": lambda _, seen: _average(seen, -math.expm1(-2.0 * math.pi * CORNER_HZ)),
        "kalman": lambda group, seen: _average(seen, _gain(group)),
        "none": lambda _, __: 0.0,
    }
    group = model.group_of(axis)
    found = {name: [method(group, y)] * len(HORIZONS_S) for name, method in level.items()}
    return {"bank": [bias for bias, _ in told], **found}, [sd for _, sd in told]


def _average(y: Floats, gain: float) -> float:
    """A first-order filter that begins at the first reading."""
    state, _ = signal.lfilter([gain], [1.0, gain - 1.0], y, zi=[(1.0 - gain) * y[0]])
    return float(state[-1])


def _gain(group: Group) -> float:
    """Steady gain of the Kalman filter of a random walk under white noise, by the data sheet."""
    kind = "rad/s" if same_kind(group.unit, "rad/s") else "m/s^2"
    r, q = SHEET_N[kind] ** 2, SHEET_STABILITY[kind] ** 2 / SHEET_TIME_S
    p = 0.5 * (q + math.sqrt(q * q + 4.0 * q * r))
    return p / (p + r)


def _rows(
    case: str, unit: str, rest: int, found: Mapping[str, Sequence[float]], sd: Sequence[float], truth: Floats
) -> Row:
    row: Row = {"case": case, "unit": unit, "rest_s": rest}
    for k, horizon in enumerate(HORIZONS_S):
        for name, values in found.items():
            row[f"error.{name}.{horizon}"] = float(values[k] - truth[k])
        row[f"sd.{horizon}"] = float(sd[k])
    return row


def _simulated(model: Model, job: Job) -> list[Row]:
    y, bias = simulate(job.law, job.rest_s + HORIZONS_S[-1], job.seed)
    axis = next(name for name in model.axes if model.group_of(name).unit == "deg/s")
    found, sd = predictions(model, axis, y[: job.rest_s])
    truth = bias[[job.rest_s - 1 + h for h in HORIZONS_S]]
    return [_rows(job.law, "deg/s", job.rest_s, found, sd, truth)]


def _recorded(log: Path | str, model: Model, wanted: Sequence[str]) -> list[Row]:
    from selfcal.blocks import usable_blocks
    from selfcal.verbs.identify import chosen_axes
    from selfcal.verbs.rivals import longest_stretch

    recording = load(log)
    rows = []
    for name in chosen_axes(recording, model, wanted):
        group = model.group_of(name)
        if not (same_kind(group.unit, "rad/s") or same_kind(group.unit, "m/s^2")):
            raise UserError(f"{recording.path}: {name}: worth takes gyros and accelerometers; choose with --axis")
        tables = make_tables(model, recording.rate_hz, (name,), bank_rate_hz=1.0)
        samples = as_float(recording.in_unit(name, group.unit))
        y = longest_stretch(usable_blocks(samples, recording.missing_before, tables, group).mean)
        kind = "gyros" if same_kind(group.unit, "rad/s") else "accelerometers"
        for rest in RESTS_S:
            span = rest + HORIZONS_S[-1] + REFERENCE_S
            for start in range(0, y.size - span + 1, span):
                piece = y[start : start + span]
                found, sd = predictions(model, name, piece[:rest])
                truth = np.array([piece[rest + h - 1 : rest + h - 1 + REFERENCE_S].mean() for h in HORIZONS_S])
                rows.append(_rows(f"recorded {kind}", group.unit, rest, found, sd, truth))
    return rows


def _summary(rows: Sequence[Row]) -> list[dict[str, Any]]:
    found = []
    for case, rest in dict.fromkeys((row["case"], row["rest_s"]) for row in rows):
        mine = [row for row in rows if (row["case"], row["rest_s"]) == (case, rest)]
        entry: dict[str, Any] = {"case": case, "unit": mine[0]["unit"], "rest_s": rest, "rests": len(mine)}
        entry["rms_error"] = {name: {str(h): _rms(mine, f"error.{name}.{h}") for h in HORIZONS_S} for name in TITLES}
        entry["bank_stated_sd"] = {str(h): _rms(mine, f"sd.{h}") for h in HORIZONS_S}
        found.append(entry)
    return found


def regret(cases: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """By method, its error over the least of all methods in the same case, rest and horizon: `worst` and `median`."""
    found: dict[str, list[float]] = {name: [] for name in TITLES}
    for entry in cases:
        for horizon in map(str, HORIZONS_S):
            errors = {name: entry["rms_error"][name][horizon] for name in TITLES}
            for name, error in errors.items():
                found[name].append(error / min(errors.values()))
    return {name: {"worst": max(ratios), "median": float(np.median(ratios))} for name, ratios in found.items()}


def _rms(rows: Sequence[Row], key: str) -> float:
    return math.sqrt(sum(row[key] ** 2 for row in rows) / len(rows))


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """A table a case; the least error of each column is bold."""
    console = Console(stderr=to_stderr)
    console.width = max(console.width, 140)
    cases: dict[str, list[Mapping[str, Any]]] = {}
    for entry in document["cases"]:
        cases.setdefault(entry["case"], []).append(entry)
    for case, entries in cases.items():
        unit = printable(entries[0]["unit"])
        table = Table(box=box.SIMPLE_HEAD, title=f"{case}: rms error of the bias, {unit}", title_justify="left")
        for heading in ("rest", "method", *(f"after {h} s" for h in HORIZONS_S)):
            table.add_column(heading, no_wrap=True)
        for entry in entries:
            errors = entry["rms_error"]
            least = {h: min(one[h] for one in errors.values()) for h in map(str, HORIZONS_S)}
            first = f"{entry['rest_s'] // 60} min, {entry['rests']} rests"
            for name, title in TITLES.items():
                cells = [
                    f"[bold]{errors[name][h]:.3g}[/]" if errors[name][h] == least[h] else f"{errors[name][h]:.3g}"
                    for h in map(str, HORIZONS_S)
                ]
                table.add_row(first, title, *cells)
                first = ""
            table.add_row(
                "",
                "  sd that the bank states",
                *(f"{sd:.3g}" for sd in entry["bank_stated_sd"].values()),
                end_section=True,
            )
        console.print(table)
    table = Table(box=box.SIMPLE_HEAD, title="error over the least of all methods", title_justify="left")
    for heading in ("method", "median", "worst"):
        table.add_column(heading, no_wrap=True)
    for name, ratio in document["regret"].items():
        table.add_row(TITLES[name], f"{ratio['median']:.3g}", f"{ratio['worst']:.3g}")
    console.print(table)
    if document["recordings"]:
        console.print(
            f"the mean of the {REFERENCE_S} s that follow stands for the truth; its own noise is in every error, and "
            "gravity in an accelerometer's bias",
            highlight=False,
        )
