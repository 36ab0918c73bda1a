"""Figures 5 to 8: accelerometers at rest, the same by Allan variance, and areas with the errors of gravity maps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from selfcal.adequacy.drawn import simulate_bank_samples
from selfcal.adequacy.summary import NOISIER
from selfcal.bank.axis_result import HALF_90, AxisResult, Estimate
from selfcal.base.grid import Array
from selfcal.logs.recording import as_float, load
from selfcal.model.file import Model, Prior
from selfcal.model.laws import NAMED
from selfcal.model.tables import Tables, make_tables
from selfcal.show.chart import Band, Curve, Figure, Panel
from selfcal.studies.methods.allan_fits import fit_weighted
from selfcal.studies.methods.problem import Problem, Value
from selfcal.studies.paper_figures.reproduction import Reproduction
from selfcal.studies.paper_figures.section3 import PAPER, by_chance, over_time

AXIS = "ax"
#: The paper's result, of which the simulated records are made: m/s^2/sqrt(Hz), m/s^3/sqrt(Hz).
PAPER_N, PAPER_K = 0.025, 2e-4
#: Units of the pictures, their sizes, and the paper's values.
SHOWN = {"N": ("mm/s²/√Hz", 1e-3, PAPER_N), "K": ("m/s³/√Hz", 1.0, PAPER_K)}
#: Four stretches of 3000 s that do not overlap: file, s of its beginning.
STRETCHES = (
    ("adis16405_run1.npz", 0),
    ("adis16405_run1.npz", 5000),
    ("adis16405_run2.npz", 0),
    ("adis16405_run4.npz", 0),
)
DURATION = 3000
MARKS = (30, 60, *range(100, DURATION + 1, 100))
#: Times at which the Allan fit is made, and the simulated records of an ensemble, from which real errors come.
ALLAN_MARKS, SCATTER = (100, 200, 400, 700, 1000, 1500, 2000, 3000), 60
#: The computed rms of N that the paper states after 3000 s.
PAPER_N_SD = 5e-6
#: Fig. 7 both ways: a Gauss-Markov truth with the walk's steps, K^2 = 2 alpha sigma_m^2.
SLOW_S = 200.0
TRUTHS = {
    "random_walk": {"N": PAPER_N, "K": PAPER_K},
    "gauss_markov": {"N": PAPER_N, "sigma_m": PAPER_K * math.sqrt(SLOW_S / 2.0), "alpha": 1.0 / SLOW_S},
}
#: Largest ratio of a consistent computed rms to the real rms, which SCATTER records know no better.
NEAR = 1.0 + by_chance(1) / math.sqrt(2.0 * SCATTER)
#: Section 4.2, four areas: rms in mGal, correlation interval in min, white noise in mGal. The paper's Fig. 8 has 1 to
#: 2, 50 to 200 and below 0.012. It does not give the interval between samples.
AREAS = {
    "area 1": (1.0, 50.0, 0.004),
    "area 2": (1.5, 100.0, 0.008),
    "area 3": (2.0, 200.0, 0.01),
    "area 4": (1.2, 70.0, 0.006),
}
PAPER_SHARES = {"area 1": 100, "area 2": 91, "area 3": 78, "area 4": 96}
AREA_RECORDS, AREA_SAMPLES, AREA_STEP_S, MGAL = 200, 100, 600.0, 1e-5


def two_laws(model: Model) -> Model:
    """The model with the paper's two hypotheses."""
    return replace(model, hypotheses={"random_walk": 0.5, "gauss_markov": 0.5}, regressors=(), half_life_s=0.0)


def short_memory(model: Model) -> Model:
    """The model with the limits of alpha that the paper has in Section 3."""
    group = model.group_of(AXIS)
    priors = {**group.priors, "alpha": Model.load(PAPER).group_of("gx").priors["alpha"]}
    return replace(model, groups=(replace(group, priors=priors),))


def simulated(seed: int, count: int = len(STRETCHES)) -> dict[str, Array]:
    """Random walks with the paper's values."""
    return {f"simulated {k + 1}": y for k, y in enumerate(_drawn("random_walk", TRUTHS["random_walk"], seed, count))}


def _drawn(law: str, truth: Mapping[str, float], seed: int, count: int) -> list[Array]:
    """`count` records of DURATION s, each with a seed of its own."""
    return [simulate_bank_samples(law, truth, 1.0, DURATION, seed + 1_000_003 * k)[0] for k in range(count)]


@dataclass(frozen=True)
class Rms:
    """rms of the logarithm of a parameter over an ensemble, at ALLAN_MARKS: real, and as the method computes it."""

    real: Array
    computed: Array

    @property
    def ratio(self) -> Array:
        return self.computed / self.real


def _rms(values: Sequence[Sequence[float]], stated: Sequence[Sequence[float]], truth: float) -> Rms:
    """Real rms and median stated sd of ln `values`, by mark, of [records][marks]. A few Allan fits state no sd."""
    real = np.sqrt(((np.log(values) - math.log(truth)) ** 2).mean(axis=0))
    columns = [column[np.isfinite(column)] for column in np.array(stated).T]
    return Rms(real, np.array([np.median(column) if column.size else math.nan for column in columns]))


def by_bank(model: Model, law: str, seed: int) -> dict[tuple[str, str], Rms]:
    """Errors of the bank by (law that it filters for, parameter that the truth has), on an ensemble of `law`."""
    seen = [over_time(model, AXIS, 1.0, y, ALLAN_MARKS) for y in _drawn(law, TRUTHS[law], seed, SCATTER)]
    by_law = {}
    for filtered in model.hypotheses:
        for name, true in _compared(law, TRUTHS[law], filtered).items():
            estimates = [[report.parameters[filtered][name] for report in reports] for reports in seen]
            medians, stated = ([[getattr(e, key) for e in row] for row in estimates] for key in ("median", "ln_sd"))
            by_law[filtered, name] = _rms(medians, stated, true)
    return by_law


def linear(model: Model, truth: Mapping[str, float], seed: int) -> dict[str, Rms]:
    """Real (16) and computed (17) rms errors of the walk's parameters, in their units, on an ensemble of `truth`."""
    drawn = _drawn("random_walk", truth, seed, SCATTER)
    seen = [[r.parameters["random_walk"] for r in over_time(model, AXIS, 1.0, y, ALLAN_MARKS)] for y in drawn]
    shares = {}
    for name, true in truth.items():
        mean, sd = (
            np.array([[getattr(report[name], key) for report in row] for row in seen]) for key in ("mean", "sd")
        )
        shares[name] = Rms(np.sqrt(((mean - true) ** 2).mean(axis=0)), np.sqrt((sd**2).mean(axis=0)))
    return shares


def by_allan(model: Model, law: str, seed: int) -> dict[tuple[str, str], Rms]:
    """Errors of the Allan fit as `by_bank` has them, its estimates kept within the bank's prior."""
    group = replace(model.group_of(AXIS), axes=(AXIS,))
    laws = tuple(model.hypotheses)
    drawn = _drawn(law, TRUTHS[law], seed, SCATTER)
    fits = [[fit_weighted(Problem(y[:mark], 1.0, group, laws)).estimates for mark in ALLAN_MARKS] for y in drawn]
    spreads = {}
    for filtered in laws:
        for name, true in _compared(law, TRUTHS[law], filtered).items():
            values = [[_within(report[filtered][name].value, group.priors[name]) for report in row] for row in fits]
            spreads[filtered, name] = _rms(
                values, [[_stated(report[filtered][name]) for report in row] for row in fits], true
            )
    return spreads


def _compared(law: str, truth: Mapping[str, float], filtered: str) -> dict[str, float]:
    """True values of the parameters that the filtered law has. A walk fitted to Gauss-Markov: the K of its steps."""
    step = {"K": truth["sigma_m"] * math.sqrt(2.0 * truth["alpha"])} if law == "gauss_markov" else {}
    return {name: value for name, value in {**truth, **step}.items() if name in NAMED[filtered].parameters}


def _within(value: float, prior: Prior) -> float:
    return float(np.clip(value, prior.min, prior.max))


def real(folder: Path) -> dict[str, Array]:
    """1 s means of the stretches; those whose file is absent are left out."""
    records, loaded = {}, {}
    for name, start in STRETCHES:
        path = folder / name
        if not path.exists():
            continue
        if name not in loaded:
            loaded = {name: load(path)}
        recording = loaded[name]
        samples = as_float(recording.in_unit(AXIS, "m/s^2")).astype(np.float64)
        block = round(recording.rate_hz)
        whole = samples[: samples.size // block * block].reshape(-1, block).mean(axis=1)
        run = name.removeprefix("adis16405_").removesuffix(".npz")
        records[f"{run}, {start} s"] = whole[start : start + DURATION]
    return records


def _far_off(titles: Iterable[str], last_of: Mapping[str, Sequence[Estimate]]) -> str:
    """The record whose estimate lies farthest from the others, in words: four that agree within their intervals may
    still have medians far apart."""
    said = []
    for name, estimates in last_of.items():
        times = np.array([estimate.median for estimate in estimates]) / np.median(
            [estimate.median for estimate in estimates]
        )
        k = int(np.argmax(np.abs(np.log(times))))
        if max(times[k], 1.0 / times[k]) > NOISIER:
            factor = f"{times[k]:.2g} times" if times[k] > 1.0 else f"1/{1.0 / times[k]:.2g} of"
            said.append(
                f"{name} of {list(titles)[k]} is {factor} the middle one: its interval, "
                f"{estimates[k].q05:.1e} to {estimates[k].q95:.1e}, is that wide. "
                "What agrees is that the four medians differ by less than 4.5 of the largest sd."
            )
    return " ".join(said)


def _figure_5(
    model: Model, records: Mapping[str, Array], reports: Mapping[str, Sequence[AxisResult]], kind: str, where: str
) -> Reproduction:
    """Probability of the random walk over time. `reports` at MARKS; `kind`, `where`: words for the records."""
    t = np.array(MARKS, dtype=float)
    panels = [
        Panel(
            name,
            "time, s",
            "probability",
            [
                Curve("random walk", t, np.array([report.probability["random_walk"] for report in seen])),
                Curve("Gauss–Markov", t, np.array([report.probability["gauss_markov"] for report in seen]), "fitted"),
            ],
        )
        for name, seen in reports.items()
    ]
    last = {name: seen[-1].probability["random_walk"] for name, seen in reports.items()}
    short = {name: over_time(short_memory(model), AXIS, 1.0, y, [DURATION])[0] for name, y in records.items()}
    limited = ", ".join(f"{report.probability['random_walk']:.3f}" for report in short.values())
    ok = all(value > 0.9 for value in last.values())
    return Reproduction(
        f"Fig. 5, {where}",
        Figure(f"Fig. 5, {kind}", f"P(random walk) against Gauss–Markov, {AXIS}, {kind}.", panels),
        "The probability of the random walk goes to 1 on all four accelerometer records.",
        "After 3000 s: "
        + ", ".join(f"{name} {value:.3f}" for name, value in last.items())
        + f"; with α from 0.01 to 0.1 1/s, as in Section 3: {limited}.",
        "agrees" if ok else "differs",
        "The default prior lets a Gauss–Markov drift last 5000 s, longer than the record: nearly a random walk.",
    )


def figures_5_and_6(model: Model, records: Mapping[str, Array], real_ones: bool, seed: int) -> list[Reproduction]:
    """Probability of the random walk, its parameters, and their rms, over time."""
    reports = {name: over_time(model, AXIS, 1.0, y, MARKS) for name, y in records.items()}
    t = np.array(MARKS, dtype=float)
    kind = "real" if real_ones else "simulated with the paper's values"
    figures = []
    for letter, (name, (_, scale, paper_value)) in zip("ab", SHOWN.items(), strict=True):
        line = [] if real_ones else [Curve("the paper", t[[0, -1]], np.full(2, paper_value / scale), "fitted")]
        figures.append(
            Figure(
                f"Fig. 6 ({letter}), {name}, {kind}",
                f"({letter}) {name}: posterior median with its 5 to 95 % band.",
                [_parameter(title, seen, name, t, line) for title, seen in reports.items()],
            )
        )
    last_of = {name: [seen[-1].parameters["random_walk"][name] for seen in reports.values()] for name in SHOWN}
    ends = {name: np.array([e.median for e in estimates]) for name, estimates in last_of.items()}
    sd = {name: np.array([e.sd for e in estimates]) for name, estimates in last_of.items()}
    # The range of four normal values is below 4.5 standard deviations in 99 of 100 cases.
    consistent = all(float(np.ptp(ends[name])) < 4.5 * float(sd[name].max()) for name in ends)
    truth = {name: float(np.median(ends[name])) if real_ones else TRUTHS["random_walk"][name] for name in SHOWN}
    errors = linear(model, truth, seed + 17)
    rms_figures, said = [], []
    for letter, (name, (unit, scale, _)) in zip("cd", SHOWN.items(), strict=True):
        rms, marks = errors[name], np.array(ALLAN_MARKS, dtype=float)
        real_rms = Curve(f"real (16), {SCATTER} records", marks, rms.real / scale, "dots")
        their_rms = Curve("computed (17), the same records", marks, rms.computed / scale, "fitted")
        panels = [
            Panel(
                title,
                "time, s",
                f"rms, {unit}",
                [Curve("computed (14)", t, _numbers(seen, name, "sd") / scale), their_rms, real_rms],
                log_y=True,
            )
            for title, seen in reports.items()
        ]
        about = "the medians of the four records" if real_ones else "the paper's values"
        caption = f"({letter}) {name}: the bank's own sd, beside the real rms error of simulated records with {about}."
        rms_figures.append(Figure(f"Fig. 6 ({letter}), rms of {name}, {kind}", caption, panels))
        ratio = rms.ratio
        said.append(
            f"{name}: computed {_span(sd[name])} at {DURATION} s; computed over real rms {_span(ratio)} at "
            f"{len(ALLAN_MARKS)} times"
        )
    where = "real" if real_ones else "simulated"
    own = [float(errors[name].ratio[-1]) for name in SHOWN]
    return [
        _figure_5(model, records, reports, kind, where),
        Reproduction(
            f"Fig. 6 (a, b), {where}",
            figures,
            "N 0.025 (m/s²)/√Hz and K 2e-4 (m/s³)/√Hz, nearly the same in the four records.",
            f"N {_span(ends['N'])}, K {_span(ends['K'])}.",
            "agrees" if consistent else "differs",
            _far_off(reports, last_of)
            if consistent
            else "The stretches are parts of three runs, whose drift is not one walk (see Fig. 5).",
        ),
        Reproduction(
            f"Fig. 6 (c, d), {where}",
            rms_figures,
            f"The computed rms falls over time, to {PAPER_N_SD:g} (m/s²)/√Hz of N and 6e-5 (m/s³)/√Hz of K.",
            "; ".join(said)
            + f". At the end the rms is {'consistent' if max(*own, *(1 / ratio for ratio in own)) < NEAR else 'off'}.",
            "agrees" if float(sd["N"].max()) < 2.0 * PAPER_N_SD else "differs",
            f"N of n readings has an sd of N/√(2n), {PAPER_N / math.sqrt(2.0 * DURATION):.1e} of {DURATION} means of "
            f"1 s: the paper's {PAPER_N_SD:g} needs {0.5 * (PAPER_N / PAPER_N_SD) ** 2:.2g} readings.",
        ),
    ]


def _numbers(seen: Sequence[AxisResult], name: str, key: str) -> Array:
    return np.array([getattr(result.parameters["random_walk"][name], key) for result in seen])


def _span(values: Array) -> str:
    return f"{values.min():.3g} to {values.max():.3g}"


def _parameter(title: str, seen: Sequence[AxisResult], name: str, t: Array, line: Sequence[Curve]) -> Panel:
    unit, scale, _ = SHOWN[name]
    low, middle, high = (_numbers(seen, name, key) / scale for key in ("q05", "median", "q95"))
    curves = [Curve("median", t, middle), *line]
    return Panel(title, "time, s", unit, curves, [Band("5 to 95 %", t, low, high, "spread")], log_y=name == "K")


def figures_7(model: Model, records: Mapping[str, Array], seed: int) -> list[Reproduction]:
    """N and K by the Allan variance; the rms that it computes against the real rms; and both on the other law."""
    group = replace(model.group_of(AXIS), axes=(AXIS,))
    t = np.array(ALLAN_MARKS, dtype=float)
    fits = {
        title: [
            fit_weighted(Problem(y[:mark], 1.0, group, ("random_walk",))).estimates["random_walk"]
            for mark in ALLAN_MARKS
        ]
        for title, y in records.items()
    }
    allan = {law: by_allan(model, law, seed + 17) for law in TRUTHS}
    bank = {law: by_bank(model, law, seed + 17) for law in TRUTHS}
    estimates, rms, said = [], [], []
    for name, (unit, scale, _) in SHOWN.items():
        for kind in ("simulated", "run"):
            panels = []
            for title, values in fits.items():
                if title.startswith(kind):
                    y = np.array([_within(value[name].value, group.priors[name]) for value in values])
                    panels.append(Panel(title, "time, s", unit, [Curve("Allan fit", t, y / scale)], log_y=name == "K"))
            if panels:
                caption = f"{name} by a weighted fit of the Allan deviation, kept within the bank's prior."
                figure = f"Fig. 7 ({'a' if name == 'N' else 'b'}), {name}, {'real' if kind == 'run' else kind}"
                estimates.append(Figure(figure, caption, panels))
        panels = []
        for method, errors in (("Allan fit", allan), ("bank", bank)):
            errors_of = errors["random_walk"]["random_walk", name]
            curves = [Curve("real", t, errors_of.real), Curve("computed", t, errors_of.computed, "fitted")]
            panels.append(Panel(method, "time, s", f"rms of ln {name}", curves, log_y=True))
        letter = "c" if name == "N" else "d"
        caption = f"({letter}) rms of ln {name} over {SCATTER} simulated records with the paper's values."
        rms.append(Figure(f"Fig. 7 ({letter}), rms of {name}", caption, panels))
        ours, theirs = (errors["random_walk"]["random_walk", name] for errors in (bank, allan))
        said.append(
            f"{name}: the Allan fit's real error is {_span(theirs.real / ours.real)} times the bank's; computed over "
            f"real rms {_span(theirs.ratio)} (bank: {_span(ours.ratio)})"
        )
    K = allan["random_walk"]["random_walk", "K"]
    small = float(np.median(K.ratio)) < 1.0 / NEAR
    slower = float(np.median(K.real / bank["random_walk"]["random_walk", "K"].real)) > 1.0
    seventh = Reproduction(
        "Fig. 7",
        [*estimates, *rms],
        "The same values at the end, slower to settle, rougher; the computed rms is too small for the real scatter.",
        "; ".join(said) + ".",
        "agrees" if small and slower else "differs",
        ""
        if small and slower
        else "The fit weighs each point by its degrees of freedom, which the paper's Allan algorithm may not do.",
    )
    return [seventh, _both_ways(allan, bank, t)]


def _both_ways(
    allan: Mapping[str, Mapping[tuple[str, str], Rms]], bank: Mapping[str, Mapping[tuple[str, str], Rms]], t: Array
) -> Reproduction:
    """The claim of Fig. 7 on both truths, for the right law and the wrong law."""
    panels: dict[str, list[Panel]] = {"N": [], "drift": []}
    said: list[str] = []
    right: list[tuple[float, float]] = []
    words = {"random_walk": "walk", "gauss_markov": "GM"}
    for law in TRUTHS:
        for filtered, name in bank[law]:
            theirs, ours = allan[law][filtered, name].ratio, bank[law][filtered, name].ratio
            curves = [Curve("Allan fit", t, theirs, "fitted"), Curve("bank", t, ours)]
            title = f"{words[law]} as {words[filtered]}"
            panels["N" if name == "N" else "drift"].append(
                Panel(title, "time, s", f"computed / real, {name}", curves, log_y=True)
            )
            middle = float(np.median(theirs)), float(np.median(ours))
            if law == filtered:
                right.append(middle)
            said.append(f"{title}, {name}: {middle[0]:.2f} and {middle[1]:.2f}")
    figures = [
        Figure(
            f"Fig. 7 both ways, {key}",
            f"The truth as the fitted law; GM: Gauss–Markov. 1 is consistent. {SCATTER} records.",
            shown,
        )
        for key, shown in panels.items()
    ]
    agrees = all(theirs < ours and 1.0 / NEAR < ours < NEAR for theirs, ours in right)
    return Reproduction(
        "Fig. 7, both ways",
        figures,
        "The Allan variance's computed rms is smaller than its real error, the bank's is consistent.",
        "Computed over real rms of the logarithm, median over time, Allan fit and bank, truth as fitted law: "
        + "; ".join(said)
        + ".",
        "agrees" if agrees else "differs",
        "A filter for the wrong law computes an rms of its own law's parameters: neither method's is consistent there."
        if agrees
        else "The bank states the spread over its prior, which is wider than the error at one true value.",
    )


def _stated(value: Value) -> float:
    return math.log(value.q95 / value.q05) / (2.0 * HALF_90) if value.q05 > 0.0 else math.nan


def map_tables(model: Model) -> Tables:
    """Tables of the axis `gravity` of paper.yaml, at the interval of Section 4.2."""
    return make_tables(model, 1.0 / AREA_STEP_S, ("gravity",), bank_rate_hz=1.0 / AREA_STEP_S)


def of_map_error(tables: Tables, y: Array) -> tuple[float, tuple[float, float, float]]:
    """P(Gauss-Markov) of a record [samples] in m/s^2; its rms in mGal, correlation interval in min, noise in mGal."""
    from selfcal.bank.library import Bank

    bank = Bank(tables)
    bank.push(y[:, None])
    report = bank.report(0)
    rms, alpha, noise = (report.parameters["gauss_markov"][name].median for name in ("sigma_m", "alpha", "N"))
    return report.probability["gauss_markov"], (rms / MGAL, 1.0 / alpha / 60.0, noise / MGAL / math.sqrt(AREA_STEP_S))


def identified(fits: Mapping[str, Sequence[tuple[float, tuple[float, ...]]]]) -> tuple[dict[str, float], float]:
    """Share of an area's records for which Gauss-Markov is the more probable, %, and the mean calculated probability
    of all records, %. `fits`: of_map_error() of each record."""
    shares = {area: 100.0 * float(np.mean([p > 0.5 for p, _ in each])) for area, each in fits.items()}
    return shares, 100.0 * float(np.mean([max(p, 1.0 - p) for each in fits.values() for p, _ in each]))


def figure_8(model: Model, seed: int) -> Reproduction:
    """Shares of the records for which Gauss-Markov is the more probable, and the parameters found."""
    drawn: dict[str, list[tuple[float, tuple[float, float, float]]]] = {}
    rate = 1.0 / AREA_STEP_S
    tables = map_tables(model)
    for number, (area, (rms, minutes, noise)) in enumerate(AREAS.items()):
        truth = {
            "N": noise * MGAL * math.sqrt(AREA_STEP_S),
            "sigma_m": rms * MGAL,
            "alpha": 1.0 / (60.0 * minutes),
            "bias": 0.0,
        }
        seeds = (seed + 1_000_003 * k + 101 * number for k in range(AREA_RECORDS))
        records = (simulate_bank_samples("gauss_markov", truth, rate, AREA_SAMPLES, own)[0] for own in seeds)
        drawn[area] = [of_map_error(tables, y) for y in records]
    (shares, sure), fits = identified(drawn), {area: np.array([e for _, e in each]) for area, each in drawn.items()}
    figures = []
    for column, (what, limit) in enumerate((("process rms", "σm"), ("white noise", "N"))):
        panels = []
        for area, values in fits.items():
            rms, minutes, noise = AREAS[area]
            interval = np.sort(values[:, 1])[[0, -1]]
            panels.append(
                Panel(
                    area,
                    "correlation interval, min",
                    f"{limit}, mGal",
                    [
                        Curve("a record", values[:, 1], values[:, 2 * column], "dots"),
                        Curve("truth", interval, np.full(2, (rms, noise)[column]), "fitted"),
                    ],
                    log_x=True,
                    log_y=column == 0,
                    marks=[minutes],
                    marked="true interval",
                )
            )
        figures.append(
            Figure(f"Fig. 8, {what}", f"{limit} over the correlation interval, {AREA_RECORDS} records an area.", panels)
        )
    medians = {area: np.median(values, axis=0) for area, values in fits.items()}
    negligible = all(noise < 0.1 * rms for rms, _, noise in medians.values())
    paper_shares = ", ".join(f"{share}" for share in PAPER_SHARES.values())
    agrees = sure >= 95.0 and negligible
    return Reproduction(
        "Fig. 8 and the shares",
        figures,
        f"Gauss–Markov is the more probable in {paper_shares} % of the records, the mean calculated probability of "
        "correct identification is about 99 %; σm 1 to 2 mGal over intervals of 50 to 200 min, N negligible beside it.",
        ", ".join(f"{area} {share:.0f} %" for area, share in shares.items())
        + f"; mean calculated probability {sure:.0f} %; medians of σm, interval, N: "
        + "; ".join(f"{rms:.2g} mGal, {minutes:.0f} min, {noise:.2g} mGal" for rms, minutes, noise in medians.values())
        + ".",
        "agrees" if agrees else "differs",
        "The paper gives neither the interval between samples nor the priors: 100 samples of 10 min hold 5 to 20 "
        "correlation intervals, too few for 99 %.",
    )
