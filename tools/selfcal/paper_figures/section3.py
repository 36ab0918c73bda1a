"""Figures 1 to 4: simulated records of the two laws with parameters drawn from the paper's uniform priors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from selfcal.diagnosis.chart import Band, Curve, Figure, Kind, Panel
from selfcal.laws import NAMED
from selfcal.methods.allan import curve
from selfcal.methods.problem import Problem
from selfcal.model import DEFAULT, Model
from selfcal.paper_figures.told import Told
from selfcal.result import AxisResult
from selfcal.spread import Row, spread
from selfcal.studies.montecarlo import draw, settings_of, simulate_bank_samples
from selfcal.tables import make_tables

Floats = NDArray[np.float64]

#: s, at which the bank reports.
MARKS = (10, 20, 40, 70, 100, 150, 200, 250, 300, 350, 400, 500, 600)
#: False identification that the paper falls below, and the time from which on it does.
BELOW, FROM_S = 0.10, 300
#: The law that Fig. 2 is of.
SECOND = "gauss_markov"
NAMES = {"sigma_m": "σm, deg/s", "alpha": "α, 1/s", "N": "σv, deg/s"}
#: Figs 3, 4: the record of each law, whose drifts have the same steps at short times (K^2 = 2 alpha sigma_m^2).
ALIKE = {"random_walk": {"N": 1.0, "K": 0.1, "bias": 0.0}}
ALIKE[SECOND] = {"N": 1.0, "sigma_m": 0.1 / math.sqrt(2.0 * 0.01), "alpha": 0.01, "bias": 0.0}
ALIKE_SAMPLES, PIECE = 400, 128
PAPER = DEFAULT.with_name("paper.yaml")


def over_time(model: Model, axis: str, dt_s: float, y: Floats, marks: Sequence[int]) -> list[AxisResult]:
    """The bank's reports after `marks` samples of `y`."""
    from selfcal.engines.library import Bank

    rate = 1.0 / dt_s
    bank = Bank(make_tables(model, rate, (axis,), bank_rate_hz=rate))
    found, at = [], 0
    for mark in marks:
        bank.push(y[at:mark, None])
        found.append(bank.report(0))
        at = mark
    return found


def rows_of(model: Model, job: tuple[str, int]) -> list[Row]:
    """A row for each mark of one record."""
    law, seed = job
    truth = draw(model.group_of("gx"), law, np.random.default_rng([seed, list(NAMED).index(law)]))
    y, _ = simulate_bank_samples(law, truth, 1.0, MARKS[-1], seed)
    rows: list[Row] = []
    for mark, report in zip(MARKS, over_time(model, "gx", 1.0, y, MARKS), strict=True):
        row: Row = {"law": law, "t": mark, "p": report.probability[report.best], "wrong": report.best != law}
        for name, estimate in report.parameters[law].items():
            row |= {f"truth.{name}": truth[name], f"mean.{name}": estimate.mean, f"sd.{name}": estimate.sd}
        rows.append(row)
    return rows


def ensemble(
    model: Model, seeds: Sequence[int], seed: int, scheduler: str | None, results: Path | str | None
) -> list[Row]:
    """The rows of a record of each law and seed; `seed`: they follow from it."""
    jobs = [(law, one) for one in seeds for law in model.hypotheses]
    settings = {"schema": "selfcal.paper/1", "model": settings_of(model), "seed": seed, "marks": MARKS}
    return spread(partial(rows_of, model), jobs, settings=settings, scheduler=scheduler, results=results)


def figure_1(rows: Sequence[Row]) -> Told:
    """False identification, calculated (19) and actual (20)."""
    t = np.array(MARKS, dtype=float)
    p, wrong = (
        np.array([[row[key] for row in rows if row["t"] == mark] for mark in MARKS], float) for key in ("p", "wrong")
    )
    calculated, actual = (1.0 - p).mean(axis=1), wrong.mean(axis=1)
    sd = (wrong - (1.0 - p)).std(axis=1) / math.sqrt(p.shape[1])
    panel = Panel(
        "False identification",
        "time, s",
        "probability",
        [Curve("calculated (19)", t, calculated), Curve("actual (20)", t, actual, "fitted")],
        [Band("calculated ± 2 sd of the difference", t, calculated - 2.0 * sd, calculated + 2.0 * sd, "spread")],
    )
    worst = float(np.max(np.abs(actual - calculated) / sd))
    at = t[(calculated < BELOW) & (actual < BELOW)]
    here = "never below 10 %" if not at.size else f"both below 10 % from {at[0]:g} s"
    far, at_400 = MARKS.index(FROM_S), MARKS.index(400)
    return Told(
        "Fig. 1",
        Figure(
            "Fig. 1",
            f"{p.shape[1] // 2} records of each law. Calculated: the mean of 1 - P of the law that is chosen.",
            [panel],
        ),
        "From 50 % at the start to below 10 %; the two curves coincide.",
        f"{here}; at 300 s {calculated[far]:.3f} calculated, {actual[far]:.3f} actual; the two differ by {worst:.1f} "
        "standard errors at most, of 13 times.",
        "agrees" if worst <= 3.0 and at.size and at[0] <= 400 else "differs",
        "The paper does not give the prior of the bias; here its sd is 1 deg/s. After 400 s the share is "
        f"{calculated[at_400]:.3f} calculated, {actual[at_400]:.3f} ± {sd[at_400]:.3f} actual.",
    )


def figure_2(rows: Sequence[Row]) -> Told:
    """Real (16) and calculated (17) rms errors under the second hypothesis."""
    t = np.array(MARKS, dtype=float)
    mine = [[row for row in rows if row["t"] == mark and row["law"] == SECOND] for mark in MARKS]
    panels, worst = [], 0.0
    for name, label in NAMES.items():
        error = np.array([[row[f"mean.{name}"] - row[f"truth.{name}"] for row in at] for at in mine])
        stated = np.array([[row[f"sd.{name}"] for row in at] for at in mine])
        real, calculated = np.sqrt((error**2).mean(axis=1)), np.sqrt((stated**2).mean(axis=1))
        sd = (error**2).std(axis=1) / math.sqrt(error.shape[1])  # of the mean square
        worst = max(worst, float(np.max(np.abs(real**2 - calculated**2) / sd)))
        low, high = (np.sqrt(np.maximum(real**2 + side * 2.0 * sd, 0.0)) for side in (-1.0, 1.0))
        panels.append(
            (
                label,
                Panel(
                    label.partition(",")[0],
                    "time, s",
                    f"rms error, {label.partition(', ')[2]}",
                    [Curve("real (16)", t, real), Curve("calculated (17)", t, calculated, "fitted")],
                    [Band("real ± 2 standard errors", t, low, high, "spread")],
                ),
            )
        )
    figures = [Figure(f"Fig. 2, {label.partition(',')[0]}", "", [panel]) for label, panel in panels]
    count = len(mine[0])
    return Told(
        "Fig. 2",
        figures,
        "Real and calculated rms of σm, α and σv coincide, from the priors' 0.43, 0.026 and 0.43 on.",
        f"{count} records; the mean squares differ by {worst:.1f} standard errors at most, of 39 comparisons. At 10 s: "
        + ", ".join(f"{label.partition(',')[0]} {panel.curves[1].y[0]:.3g}" for label, panel in panels)
        + "; at 400 s: "
        + ", ".join(f"{label.partition(',')[0]} {panel.curves[1].y[MARKS.index(400)]:.3g}" for label, panel in panels)
        + ".",
        "agrees" if worst <= 3.5 else "differs",
    )


def figures_3_and_4(seed: int) -> list[Told]:
    """Spectrum and Allan deviation of one record of each law."""
    group = Model.load(PAPER).group_of("gx")
    spectra, deviations = [], []
    names = {"random_walk": "random walk", SECOND: "Gauss–Markov"}
    freedom = np.ones(1)
    kinds: tuple[Kind, ...] = ("measured", "fitted")
    for kind, (law, truth) in zip(kinds, ALIKE.items(), strict=True):
        y, _ = simulate_bank_samples(law, truth, 1.0, ALIKE_SAMPLES, seed)
        frequency, power = signal.welch(y, nperseg=PIECE, detrend="constant")
        spectra.append(Curve(names[law], frequency[1:-1], power[1:-1], kind))
        m, deviation, freedom = curve(Problem(y, 1.0, group, tuple(NAMED)))
        deviations.append(Curve(names[law], m, deviation, kind))
    # Of ln power: pieces that overlap by half count as 0.75 each. Of ln deviation: 1 / (2 degrees of freedom).
    pieces = 0.75 * (2 * ALIKE_SAMPLES / PIECE - 1)
    sd = (np.full(spectra[0].x.size, math.sqrt(2.0 / pieces)), np.sqrt(1.0 / freedom))
    made = (
        f"{ALIKE_SAMPLES} s of each law: N 1 deg/s/√Hz; K 0.1 deg/s²/√Hz; σm 0.707 deg/s and α 0.01 1/s. The steps of "
        "both drifts are alike."
    )
    shown = (
        ("Fig. 3", "Spectrum", "frequency, Hz", "power, (deg/s)²/Hz", "spectra", spectra),
        ("Fig. 4", "Allan deviation", "averaging time, s", "deviation, deg/s", "Allan deviations", deviations),
    )
    told = []
    for (name, title, x, y_label, what, curves), by_chance in zip(shown, sd, strict=True):
        apart = np.abs(np.log(curves[0].y / curves[1].y))
        worst = float(np.max(apart / by_chance))
        told.append(
            Told(
                name,
                Figure(name, made, [Panel(title, x, y_label, curves, log_x=True, log_y=True)]),
                f"The {what} of the two laws hardly differ.",
                f"They differ by a factor of {math.exp(float(apart.max())):.1f} at most, and by {worst:.1f} standard "
                f"deviations of chance, of {apart.size} points.",
                "agrees" if worst < 3.5 else "differs",
            )
        )
    return told
