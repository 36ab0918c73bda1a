"""Figures 1 to 4: simulated records of the two laws with parameters drawn from the paper's uniform priors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from statistics import NormalDist

import numpy as np
from scipy import signal

from selfcal.adequacy.allan import allan_terms
from selfcal.adequacy.drawn import draw_parameters, simulate_bank_samples
from selfcal.bank.axis_result import AxisResult
from selfcal.base.grid import Array
from selfcal.batch.spread import Row, spread
from selfcal.model.file import DEFAULT, Model, settings_of
from selfcal.model.laws import NAMED
from selfcal.model.tables import make_tables
from selfcal.readings.budget import FALSE_ALARM
from selfcal.show.chart import Band, Curve, Figure, Panel
from selfcal.studies.methods.allan_fits import curve, fit_weighted
from selfcal.studies.methods.problem import Problem
from selfcal.studies.methods.whittle import whittle
from selfcal.studies.paper_figures.reproduction import Reproduction

#: Times of the bank's reports, s: the ticks of the paper's axes (Fig. 1 to 600 s, Fig. 2 to 400 s), the T of its text,
#: and times between. At 0 the prior holds.
MARKS = (10, 20, 50, 100, 150, 200, 250, 300, 350, 400, 450, 500, 550, 600, 1000)
#: False identification that the paper falls below, and its T.
BELOW, TEXT_S = 0.10, 1000
#: The law that Fig. 2 is of, and the end of its axis.
SECOND, FIGURE_2_S = "gauss_markov", 400
NAMES = {"sigma_m": "σm, deg/s", "alpha": "α, 1/s", "N": "σv, deg/s"}
#: Figs 3, 4: the record of each law, whose drifts have the same steps at short times (K^2 = 2 alpha sigma_m^2).
ALIKE = {
    "random_walk": {"N": 1.0, "K": 0.15, "bias": 0.0},
    SECOND: {"N": 1.0, "sigma_m": 1.0, "alpha": 0.15**2 / 2.0, "bias": 0.0},
}
#: Samples of each, and of a piece of Welch's method; records by which the tools choose a law; a tool that errs in this
#: share of them hardly separates the laws (chance: 0.5).
ALIKE_SAMPLES, PIECE, CHOICES, HARD = 600, 128, 100, 0.2
SHOWN = {SECOND: "Gauss–Markov", "random_walk": "random walk"}
PAPER = DEFAULT.with_name("paper.yaml")


def over_time(model: Model, axis: str, dt_s: float, y: Array, marks: Sequence[int]) -> list[AxisResult]:
    """The bank's reports after `marks` samples of `y`."""
    from selfcal.bank.library import Bank

    rate = 1.0 / dt_s
    bank = Bank(make_tables(model, rate, (axis,), bank_rate_hz=rate))
    reports, begin = [], 0
    for mark in marks:
        bank.push(y[begin:mark, None])
        reports.append(bank.report(0))
        begin = mark
    return reports


def by_chance(comparisons: int) -> float:
    """Standard errors that the worst of `comparisons` exceeds by chance with the probability FALSE_ALARM."""
    return NormalDist().inv_cdf(1.0 - 0.5 * FALSE_ALARM / comparisons)


def own_seed(law: str, seed: int) -> int:
    """A seed for each law: records of two laws with the same seed share their noise."""
    return int(np.random.SeedSequence([seed, list(NAMED).index(law)]).generate_state(1)[0])


def rows_of(model: Model, job: tuple[str, int]) -> list[Row]:
    """A row for each mark of a record, and a row of the prior, at 0."""
    law, seed = job
    group = model.group_of("gx")
    truth = draw_parameters(group, law, np.random.default_rng([seed, list(NAMED).index(law)]))
    y, _ = simulate_bank_samples(law, truth, 1.0, MARKS[-1], own_seed(law, seed))
    count = len(model.hypotheses)
    start: Row = {"law": law, "t": 0, "p": 1.0 / count, "wrong": law != next(iter(model.hypotheses))}
    for name in group.laws[law].parameters:
        prior = group.priors[name]  # uniform
        mean, sd = (prior.min + prior.max) / 2.0, (prior.max - prior.min) / math.sqrt(12.0)
        start |= {f"truth.{name}": truth[name], f"mean.{name}": mean, f"sd.{name}": sd}
    rows = [start]
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
    jobs = [(law, record_seed) for record_seed in seeds for law in model.hypotheses]
    settings = {"schema": "selfcal.paper/2", "model": settings_of(model), "seed": seed, "marks": MARKS}
    return spread(partial(rows_of, model), jobs, settings=settings, scheduler=scheduler, results=results)


def figure_1(rows: Sequence[Row]) -> Reproduction:
    """False identification, calculated (19) and actual (20)."""
    times = (0, *MARKS)
    t = np.array(times, dtype=float)
    p, wrong = (
        np.array([[row[key] for row in rows if row["t"] == mark] for mark in times], float) for key in ("p", "wrong")
    )
    calculated, actual = (1.0 - p).mean(axis=1), wrong.mean(axis=1)
    sd = np.maximum((wrong - (1.0 - p)).std(axis=1) / math.sqrt(p.shape[1]), 1e-12)
    panel = Panel(
        "False identification",
        "time, s",
        "probability",
        [Curve("calculated (19)", t, calculated), Curve("actual (20)", t, actual, "fitted")],
        [Band("calculated ± 2 sd of the difference", t, calculated - 2.0 * sd, calculated + 2.0 * sd, "spread")],
    )
    worst = float(np.max(np.abs(actual - calculated) / sd))
    below = (calculated < BELOW) & (actual < BELOW)
    below_s = t[np.logical_and.accumulate(below[::-1])[::-1]]  # and stay there
    here = f"both below 10 % from {below_s[0]:g} s on" if below_s.size else "not below 10 %"
    some = [times.index(mark) for mark in (0, 100, 200, 300, 400, 600, TEXT_S)]
    return Reproduction(
        "Fig. 1",
        Figure(
            "Fig. 1",
            f"{p.shape[1] // 2} records of each law. Calculated: the mean of 1 - P of the law that is chosen.",
            [panel],
        ),
        f"From 50 % at the start to below 10 % after T = {TEXT_S} s (text; the axis of the figure ends at 600 s); the "
        "calculated and the actual curve coincide.",
        f"{here}; calculated / actual "
        + ", ".join(f"{calculated[k]:.3f} / {actual[k]:.3f} at {t[k]:g} s" for k in some)
        + f"; the two differ by {worst:.1f} standard errors at most, of {len(MARKS)} times.",
        "agrees" if worst <= by_chance(len(MARKS)) and below[-1] else "differs",
        "The paper does not give the prior of the bias, on which the first 100 s depend; here its sd is 1 deg/s.",
    )


def figure_2(rows: Sequence[Row]) -> Reproduction:
    """Real (16) and calculated (17) rms errors under the second hypothesis."""
    times = (0, *(mark for mark in MARKS if mark <= FIGURE_2_S))
    t = np.array(times, dtype=float)
    mine = [[row for row in rows if row["t"] == mark and row["law"] == SECOND] for mark in times]
    panels, worst = [], 0.0
    for name, label in NAMES.items():
        error = np.array([[row[f"mean.{name}"] - row[f"truth.{name}"] for row in rows_of] for rows_of in mine])
        stated = np.array([[row[f"sd.{name}"] for row in rows_of] for rows_of in mine])
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
    return Reproduction(
        "Fig. 2",
        figures,
        "Real and calculated rms of σm, α and σv coincide over 400 s, from the priors' 0.43, 0.026 and 0.43 on.",
        f"{count} records; the mean squares differ by {worst:.1f} standard errors at most, of "
        f"{len(NAMES) * len(times)} comparisons. Calculated at 0 s and at {FIGURE_2_S} s: "
        + "; ".join(
            f"{label.partition(',')[0]} {panel.curves[1].y[0]:.3g}, {panel.curves[1].y[-1]:.3g}"
            for label, panel in panels
        )
        + ".",
        "agrees" if worst <= by_chance(len(NAMES) * len(times)) else "differs",
    )


def choices(seed: int) -> dict[str, float]:
    """Share of CHOICES records of each law in ALIKE for which a tool prefers the other law. The spectrum and the Allan
    deviation choose by AIC of a fit of either law; the bank by its probabilities."""
    model = Model.load(PAPER)
    wrong = {"spectrum": 0, "Allan deviation": 0, "bank": 0}
    for law, truth in ALIKE.items():
        for k in range(CHOICES):
            y, _ = simulate_bank_samples(law, truth, 1.0, ALIKE_SAMPLES, own_seed(law, seed + 1 + k))
            problem = Problem(y, 1.0, model.group_of("gx"), tuple(ALIKE))
            for tool, answer in (("spectrum", whittle(problem)), ("Allan deviation", fit_weighted(problem))):
                weight = answer.weights["AIC"]
                wrong[tool] += max(weight, key=lambda name: weight[name]) != law
            wrong["bank"] += over_time(model, "gx", 1.0, y, [ALIKE_SAMPLES])[0].best != law
    return {tool: number / (CHOICES * len(ALIKE)) for tool, number in wrong.items()}


def figures_3_and_4(seed: int) -> list[Reproduction]:
    """Spectrum and Allan deviation of a record of each law with the true curves, and how well they choose a law."""
    group = Model.load(PAPER).group_of("gx")
    spectra: list[Panel] = []
    deviations: list[Panel] = []
    for letter, (law, name) in zip("ab", SHOWN.items(), strict=True):
        y, _ = simulate_bank_samples(law, ALIKE[law], 1.0, ALIKE_SAMPLES, own_seed(law, seed))
        terms = allan_terms(NAMED[law], ALIKE[law], 1.0)
        f, power = (values[1:-1] for values in signal.welch(y, nperseg=PIECE, detrend="constant"))
        m, deviation, _ = curve(Problem(y, 1.0, group, tuple(ALIKE)))
        for panels, x, estimated, true, x_label, y_label in (
            (spectra, f, power, 2.0 * terms.spectrum(2.0 * math.pi * f), "frequency, Hz", "(deg/s)²/Hz"),
            (deviations, m, deviation, np.sqrt(terms.allan_variance(m)), "averaging time, s", "deviation, deg/s"),
        ):
            curves = [Curve("estimated", x, estimated), Curve("true", x, true, "fitted")]
            panels.append(Panel(f"({letter}) {name}", x_label, y_label, curves, log_x=True, log_y=True))
    made = (
        f"One record of {ALIKE_SAMPLES} s of each law, with seeds of their own: N 1 deg/s/√Hz; K "
        f"{ALIKE['random_walk']['K']:g} deg/s²/√Hz; σm {ALIKE[SECOND]['sigma_m']:g} deg/s and α "
        f"{ALIKE[SECOND]['alpha']:.3g} 1/s. The steps of both drifts are alike."
    )
    wrong = choices(seed)
    return [
        Reproduction(
            name,
            Figure(name, made, panels),
            f"The {many} of the two laws hardly differ, and give neither the law nor its parameters by themselves.",
            f"A fit of both laws to the {tool} and AIC name the wrong law for {100.0 * wrong[tool]:.0f} % of "
            f"{2 * CHOICES} records, the bank for {100.0 * wrong['bank']:.0f} %.",
            "agrees" if wrong[tool] >= HARD else "differs",
            "" if wrong[tool] >= HARD else f"A likelihood fit of the {tool} tells these two laws apart at this length.",
        )
        for name, many, tool, panels in (
            ("Fig. 3", "spectra", "spectrum", spectra),
            ("Fig. 4", "Allan deviations", "Allan deviation", deviations),
        )
    ]
