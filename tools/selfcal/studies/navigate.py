"""`selfcal navigate`: a GPS/INS filter with the noise of the data sheet, ten times that, or the bank's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import optimize
from scipy.special import exprel

from selfcal.base.grid import Array
from selfcal.base.output import console_of, print_line, table_of
from selfcal.batch.spread import Row
from selfcal.model.file import Model
from selfcal.model.simulated_parts import AXES, SHEET_N, SHEET_STABILITY, SHEET_TIME_S
from selfcal.model.tables import make_tables
from selfcal.studies.navigation import GPS_S, OUTAGE_S, REST_S, SCALE, FilterNoise, Filters, Part, nees, true_noise

if TYPE_CHECKING:
    from selfcal.bank.axis_result import AxisResult
    from selfcal.bank.library import Bank

SCHEMA = "selfcal.navigate/1"
#: Factor by which filter designers inflate a data sheet's noise.
INFLATION = 10.0
#: The filters, in the order of the table.
TITLES = {
    "sheet": "the data sheet's",
    "inflated": f"{INFLATION:g} times the data sheet's",
    "identified": f"identified in {REST_S // 60} min of rest",
    "true": "the true one",
}
#: Times at which the filters are judged.
TIMES = {"with_gps": "with GPS", "after_outage": f"{OUTAGE_S} s without"}
#: Errors that are judged: columns of the table.
FIGURES = {
    "position_m": "position, m",
    "gyro_bias_deg_s": "gyro bias, deg/s",
    "accelerometer_bias_m_s2": "acc. bias, m/s^2",
    "nees": "NEES",
}
#: s over which the identified drift is as uncertain as the bank states: the outage, and the flight.
HORIZONS_S = (float(OUTAGE_S), float(GPS_S + OUTAGE_S))
#: Parts whose filters run side by side.
TOGETHER = 25


@dataclass(frozen=True)
class Job:
    """Parts of a law, by their seeds."""

    law: str
    seeds: tuple[int, ...]


def sheet_noise(factor: float = 1.0) -> list[Mapping[str, float]]:
    """By AXES: the data sheet's white noise and a bias that walks by its stability, times `factor`."""
    return [
        {"N": factor * SHEET_N[unit], "K": factor * SHEET_STABILITY[unit] / math.sqrt(SHEET_TIME_S)}
        for unit in AXES.values()
    ]


def identified_noise(rest: Array) -> list[Mapping[str, float]]:
    """By AXES: the noise of a rest [REST_S, axes] in their units, with the spread of its posterior.

    N has the mean square of all laws. Where the constant is the most probable law, there is no drift. Else the drift
    has the variance that the bank predicts HORIZONS_S ahead, of all laws and nodes (`matched`). The variance of a
    single law at its median is too small where another law or a larger drift is possible.
    """
    from selfcal.bank.library import Bank

    bank = Bank(make_tables(Model.load(), 1.0, tuple(AXES), bank_rate_hz=1.0))
    bank.push(rest)
    return [bank_noise(bank, k)[0] for k in range(len(AXES))]


def bank_noise(bank: Bank, axis: int, mask: int = 0) -> tuple[dict[str, float], AxisResult]:
    """The noise of an axis by a bank, as `identified_noise` has it, in the bank's units, and the bank's report."""
    now, *later = (bank.report(axis, mask, ahead) for ahead in (0.0, *HORIZONS_S))
    white = [(now.probability[law], estimates["N"]) for law, estimates in now.parameters.items()]
    noise = {"N": math.sqrt(sum(p * (e.mean**2 + e.sd**2) for p, e in white))}
    if now.best != "constant":
        noise |= matched(now.bias_sd**2, *(report.bias_sd**2 for report in later))
    return noise, now


def matched(now: float, near: float, far: float) -> dict[str, float]:
    """The drift whose variance grows from `now` to `near` and `far` over HORIZONS_S: Gauss-Markov, or a walk where the
    growth does not slow down."""
    first, last = HORIZONS_S
    least = float(np.finfo(np.float32).eps) * now  # the bank reports floats
    grown, whole = max(near - now, least), max(far - now, least)

    def slower(alpha: float) -> float:
        return float(last / first * exprel(-2.0 * alpha * last) / exprel(-2.0 * alpha * first)) - whole / grown

    if slower(0.0) <= 0.0:
        return {"K": math.sqrt(whole / last)}
    fastest = 1.0 / first
    alpha = optimize.brentq(slower, 0.0, fastest) if slower(fastest) < 0.0 else fastest
    return {"sigma_m": math.sqrt(now - grown / math.expm1(-2.0 * alpha * first)), "alpha": alpha}


def rows_of(job: Job) -> list[Row]:
    """A row a part: squared errors and the NEES by filter and time."""
    part = Part.of(job.law, job.seeds)
    noises = {
        "sheet": [sheet_noise()] * len(job.seeds),
        "inflated": [sheet_noise(INFLATION)] * len(job.seeds),
        "identified": [identified_noise(rest / SCALE) for rest in part.rest],
        "true": [true_noise(job.law)] * len(job.seeds),
    }
    rows: list[Row] = [{"law": job.law, "seed": seed} for seed in job.seeds]
    for name, noise in noises.items():
        filters = Filters(FilterNoise.of(noise), part)
        filters.rest()
        for time, (errors, covariance) in zip(TIMES, filters.fly(), strict=True):
            figures = {
                "position_m": (errors[:, :3] ** 2).sum(axis=1),
                "gyro_bias_deg_s": (np.degrees(errors[:, 9:12]) ** 2).mean(axis=1),
                "accelerometer_bias_m_s2": (errors[:, 12:15] ** 2).mean(axis=1),
                "nees": nees(errors, covariance),
            }
            for figure, values in figures.items():
                for row, value in zip(rows, values, strict=True):
                    row[f"{name}.{time}.{figure}"] = float(value)
    return rows


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """By filter and time: the rms of each error, the mean of the NEES."""
    figures: dict[str, Any] = {}
    for name in TITLES:
        figures[name] = {}
        for time in TIMES:
            means = {figure: float(np.mean([row[f"{name}.{time}.{figure}"] for row in rows])) for figure in FIGURES}
            figures[name][time] = {
                figure: mean if figure == "nees" else math.sqrt(mean) for figure, mean in means.items()
            }
    return figures


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """A table a time; a word on each NEES."""
    console = console_of(to_stderr=to_stderr)
    low, high = document["nees_band_95"]
    for time, when in TIMES.items():
        title = f"{when}: rms errors, {document['parts']} parts of each law"
        headings = ("law of the parts", "noise that the filter is told", *FIGURES.values(), "it is")
        table = table_of(headings, title)
        for law, filters in document["laws"].items():
            for name, times in filters.items():
                figures = times[time]
                cells = [f"{figures[figure]:.3g}" for figure in FIGURES]
                sure, careful = figures["nees"] > high, figures["nees"] < low
                word = "too sure" if sure else "too cautious" if careful else "consistent"
                last = name == list(filters)[-1]
                table.add_row(law if name == "sheet" else "", TITLES[name], *cells, word, end_section=last)
        console.print(table)
    print_line(
        console,
        f"NEES: squared error over what the filter states, {document['nees_expected']} of one that is consistent; its "
        f"mean over {document['parts']} parts then lies between {low:.1f} and {high:.1f} in 95 % of cases",
    )
