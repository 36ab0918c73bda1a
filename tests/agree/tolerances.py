"""What must agree with what, as one table: `make tolerances`. Exit code 1 if a tolerance is not kept.

    textbook   each build of the library against the textbook bank, node for node
    reports    float and fixed-point reports against those of the double build, at equal nodes
    dense      reports on the model's nodes against dense nodes, over the whole prior
    refined    ... and against the textbook bank refined until it settles
    targets    reports of six axes on each target's nodes, which they share, against dense ones
    ensemble   actual against calculated errors, false identification and intervals, 500 records a law

`--quick` takes the shorter records, `--seeds N` so many times the records. Every row is the worst of its records. Where
only measured, no tolerance is stated for such lengths.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from selfcal.adequacy.drawn import draw_parameters, simulate_bank_samples
from selfcal.bank import reference
from selfcal.bank.axis_result import AxisResult
from selfcal.bank.library import Bank
from selfcal.logs.recording import load
from selfcal.model.laws import NAMED, PLAIN, SUMS
from selfcal.model.tables import make_tables
from selfcal.verbs.montecarlo import montecarlo

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / folder) for folder in ("common", ".")]
from agreement import (  # noqa: E402
    LENGTHS,
    LIMITS,
    MODEL,
    REPORT_LIMIT,
    Agreement,
    Floats,
    a_bank,
    a_record,
    compare,
    model_of,
    off_grid,
    on_nodes,
    push,
    report_differences,
    tables_of,
)
from agreement import dense as dense_nodes  # noqa: E402
from conftest import SHARED_DATA, worst_difference  # noqa: E402

#: Of the host's report against the refined reference: the sd to 5 %, see test_identify.py.
REFINED_LIMIT = np.array([0.05, 0.05, 0.05])
RHO = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
#: Records a cell by length; beyond, one.
RECORDS = {10: 12, 100: 12, 1000: 8, 10_000: 3}
DENSE_RECORDS = {10: 6, 100: 6, 1000: 6, 10_000: 6, 100_000: 3, 300_000: 3}
#: Bank samples up to which a report on the model's nodes is to hold: of the plain laws, of a sum (tests/ACCURACY.md).
DENSE_LENGTH, DENSE_LENGTH_SUM = 300_000, 1000
ENSEMBLE = 500
#: Columns of text at most; the table takes what it needs.
WIDTH = 250


@dataclass(frozen=True)
class Row:
    """Worst of some records. `kept`: None where it is only measured."""

    pair: str
    build: str
    law: str
    n: int
    what: str
    records: int
    ln_p: float
    probability: float
    mean: float
    sd: float
    tolerance: str
    kept: bool | None


@dataclass(frozen=True)
class Job:
    """One cell: what it costs about, for the order, and what makes its rows."""

    cost: float
    work: Callable[..., list[Row]] = field(compare=False)
    arguments: tuple[object, ...] = ()

    def run(self) -> list[Row]:
        return self.work(*self.arguments)


def size(n: int) -> str:
    """1000 as 10^3, 3600 as it is."""
    power = round(math.log10(n))
    return f"10^{power}" if n == 10**power else str(n)


# ----------------------------------------------------------------------------------------------------------- textbook


def stated(build: str) -> str:
    limit = LIMITS[build]
    if math.isfinite(limit.ln_p):
        return f"d ln p {limit.ln_p:g}, dP {limit.probability:g}"
    return f"dP {limit.probability:g}, mean {limit.mean:g} sd"


def textbook(law: str, n: int, what: str, seeds: int) -> list[Row]:
    """`what`: whole, gaps, `p N` regressors, or `offset X`, which takes all of RHO."""
    model, kind, _, number = model_of(law), *what.partition(" ")
    columns = int(number) if kind == "p" else 0
    offset = float(number) if kind == "offset" else 0.0
    records = seeds * max(RECORDS.get(n, 1) // (3 if columns else 1), 1)
    # A step of a filter takes the textbook 30 ns, of one with regressors or of a sum some 0.5 us, and the library up to
    # 0.4: fewer nodes there, and from 10^5 on those of the record's own law and of the constant alone.
    dear = bool(columns) or law in SUMS
    target = "cortex-m0" if dear or n > 100_000 else "cortex-m4f"
    alone = dear and n >= 100_000
    every = (3 if n <= 100_000 else 8) if alone else 1
    sigmas = 3 if alone and n > 100_000 else 5
    all_in_use = 2**columns - 1
    masks = sorted({all_in_use, 0, 0b101101 & all_in_use}) if law in PLAIN and n <= 1000 else [all_in_use]
    cells = (
        [{"seed": 7, "rho": rho, "offset": offset} for rho in RHO]
        if kind == "offset"
        else [{"seed": seed, "gaps": kind != "whole", "columns": columns} for seed in range(records)]
    )
    builds = [build for build in LIMITS if n <= LENGTHS[build]]
    found = []
    for cell in cells:
        y, z = a_record(law, n, **cell)  # type: ignore[arg-type]
        tables = tables_of(model, target, columns, bias_sd=max(10.0, float(np.nanmax(np.abs(y)))))
        if alone:
            tables = replace(tables, hypotheses=tuple(h for h in tables.hypotheses if h.name in (law, "constant")))
        found.append(compare(y, tables, z, builds=builds, sigmas=sigmas, every=every, masks=masks))
    label = what
    if columns:
        label = f"gaps, {columns} regressors"
    elif kind == "offset":
        label = f"rho 1e-3 to 10, offset {offset:g}"
    rows = []
    for build in builds:
        worst = Agreement.worst(each[build] for each in found)
        numbers = (worst.ln_p, worst.probability, worst.mean, math.nan)
        kept = worst.within(LIMITS[build])
        rows.append(Row("textbook", build, law, n, label, len(cells), *numbers, stated(build), kept))
    return rows


def reports(law: str, n: int, seeds: int) -> list[Row]:
    """The posterior itself, of every build against that of the double one, on the M4F's nodes."""
    found: dict[str, list[list[float]]] = {build: [] for build in LIMITS if build != "double" and n <= LENGTHS[build]}
    for seed in range(seeds):
        y, _ = a_record(law, n, seed)
        tables = tables_of(model_of(law), "cortex-m4f")
        banks = {build: a_bank(tables, build) for build in ("double", *found)}
        for bank in banks.values():
            push(bank, y)
        exact = banks["double"].report(0)
        for build, each in found.items():
            each.append(list(worst_difference(banks[build].report(0), exact)))
    rows = []
    for build, each in found.items():
        ln_p, probability, mean, sd = np.max(each, axis=0).tolist()
        kept = Agreement(0.0, probability, mean).within(LIMITS[build])
        rows.append(Row("reports", build, law, n, "whole", seeds, ln_p, probability, mean, sd, stated(build), kept))
    return rows


# ------------------------------------------------------------------------------------------------------ posterior


def dense(law: str, n: int, seeds: int, nodes: int = 0) -> list[Row]:
    """All hypotheses of the paper together; of a sum that alone, its dense grid being as large as theirs. With `nodes`
    on so many a dimension instead of the model's."""
    tables = tables_of(model_of(law), only=law if law in SUMS else None)
    if nodes:
        tables = on_nodes(tables, nodes, (nodes, nodes))
    records = seeds * DENSE_RECORDS.get(n, 1)
    each = [report_differences(a_record(law, n, seed)[0], tables) for seed in range(records)]
    values = np.array([value for value, _ in each])
    good = (values <= REPORT_LIMIT).all(axis=1)
    silent = sum(not (kept or flagged) for kept, (_, flagged) in zip(good, each, strict=True))
    evidence, mean, sd = values.max(axis=0).tolist()
    judged = not nodes and n <= (DENSE_LENGTH_SUM if law in SUMS else DENSE_LENGTH)
    what = f"{100 * good.mean():.0f} % within" + (f", {silent} others not flagged" if not good.all() else "")
    what += f" on {nodes} x {nodes} nodes" if nodes else ""
    limit = "ln evidence {:g}, mean {:g} sd, sd {:.0%}".format(*REPORT_LIMIT)
    kept = bool(good.all()) if judged else None
    return [Row("dense", "float", law, n, what, records, evidence, math.nan, mean, sd, limit, kept)]


def refined(law: str, n: int, seeds: int) -> list[Row]:
    """Of a sum, whose report has nothing to go by beyond its nodes, one that says so itself is told, not judged."""
    model = model_of(law)
    group, hypotheses = model.group_of("gx"), {law: 1.0} if law in SUMS else model.hypotheses
    found, excused = [], []
    for seed in range(2 * seeds):
        y, _ = a_record(law, n, seed)
        bank = Bank(tables_of(model, only=law if law in SUMS else None))
        push(bank, y)
        exact = reference.reference_axis(y, 1.0, group, hypotheses)
        found.append(worst_difference(bank.report(0), exact))
        excused.append(law in SUMS and off_grid(bank, 0, exact))
    evidence, probability, mean, sd = np.max(found, axis=0).tolist()
    good = (np.array(found)[:, [0, 2, 3]] <= REFINED_LIMIT).all(axis=1) | np.array(excused)
    what = f"{sum(excused)} off the grid, flagged" if any(excused) else "whole"
    limit = "ln evidence {:g}, mean {:g} sd, sd {:.0%}".format(*REFINED_LIMIT)
    return [Row("refined", "float", law, n, what, len(found), evidence, probability, mean, sd, limit, bool(good.all()))]


def six_axes(n: int, seed: int) -> tuple[str, Floats]:
    """All axes at 1 Hz [n, 6]: parameters from the priors, the laws by turns."""
    y = []
    for index, axis in enumerate(MODEL.axes):
        law = PLAIN[(index + seed) % len(PLAIN)]
        truth = draw_parameters(MODEL.group_of(axis), law, np.random.default_rng([n, seed, index]))
        y.append(simulate_bank_samples(law, truth, 1.0, n, seed=100 * seed + index)[0])
    return "drawn", np.column_stack(y)


def recorded(n: int) -> Iterator[tuple[str, Floats]]:
    """Means over a second of the beginnings of the real recordings, where they are."""
    for path in sorted(SHARED_DATA.glob("adis16405_run*.npz")):
        recording = load(path)
        block = round(recording.rate_hz)
        y = [recording.in_unit(axis, MODEL.group_of(axis).unit)[: n * block] for axis in MODEL.axes]
        yield "recorded", np.column_stack([one.reshape(n, block).mean(axis=1) for one in y])


def likeliest(report: AxisResult) -> str:
    return max(report.probability, key=lambda law: report.probability[law])


def targets(n: int, seeds: int) -> list[Row]:
    """Added error of the nodes alone: the report's cells are the host's. Median, nine in ten and worst of the axes."""
    fixed = {target: "m0" in target for target in MODEL.nodes}
    tables = {target: make_tables(MODEL, 1.0, None, target) for target in MODEL.nodes}
    found: dict[tuple[str, str], list[list[float]]] = {}
    bytes_of = {}
    for source, y in (*(six_axes(n, seed) for seed in range(14 * seeds)), *recorded(n)):
        banks = {target: Bank(tables[target], build="_fixed" if fixed[target] else "_library32") for target in tables}
        for target, bank in banks.items():
            bank.push(y)
            bytes_of[target] = bank.raw.size
        for index, axis in enumerate(MODEL.axes):
            judge = Bank(dense_nodes(tables_of(MODEL, axis=axis)), build="_dense")
            push(judge, y[:, index].astype(np.float32).astype(np.float64))
            exact = judge.report(0)
            for target, bank in banks.items():
                report = bank.report(index)
                constant = abs(report.probability["constant"] - exact.probability["constant"])
                other = likeliest(report) != likeliest(exact)
                row = [*worst_difference(report, exact), constant, float(other), float(off_grid(bank, index, exact))]
                found.setdefault((source, target), []).append(row)
    rows = []
    for (source, target), each in found.items():
        values = np.array(each)
        bad = values[:, 1] > LIMITS["fixed"].probability
        build = "fixed" if fixed[target] else "float"
        head = f"{target}, {tables[target].nodes} nodes, {bytes_of[target]} B"
        for name, quantile in (("median", 0.5), ("9 in 10", 0.9), ("worst", 1.0)):
            *numbers, constant = np.quantile(values[:, :5], quantile, axis=0).tolist()
            said = f"dP(constant) {constant:.1e}"
            if quantile == 1.0:
                said += f"; dP > 5e-3: {bad.sum()}, flagged {values[bad, 6].sum():.0f}"
                said += f"; another law: {values[:, 5].sum():.0f}"
            rows.append(Row("targets", build, f"{source}, {name}", n, head, len(each), *numbers, said, None))
    return rows


def ensemble() -> list[Row]:
    """`mean` is how far off in standard deviations of the Monte Carlo error, the worst of a law's; 3.5 are let pass."""
    document = montecarlo(records=ENSEMBLE, seed=1)
    rows = []
    one_sd = math.sqrt(0.9 * 0.1 / ENSEMBLE)
    for law, entry in document["laws"].items():
        off = max(abs(p["coverage_90"] - 0.9) / one_sd for p in entry["parameters"].values())
        rms = max(abs(p["rms_actual"] / p["rms_calculated"] - 1.0) for p in entry["parameters"].values())
        label = "90 % intervals; d sd: rms (16) over (17)"
        limit = "3.5 sd of the Monte Carlo error"
        numbers = (math.nan, math.nan, off, rms)
        rows.append(Row("ensemble", "float", law, 3600, label, ENSEMBLE, *numbers, limit, off <= 3.5))
    f = document["false_identification"]
    p = abs(f["actual"] - f["calculated"])
    off = p / f["sd_of_difference"]
    label, limit = "false identification, (20) against (19)", "3.5 sd of the Monte Carlo error"
    records = ENSEMBLE * len(document["laws"])
    rows.append(Row("ensemble", "float", "all", 3600, label, records, math.nan, p, off, math.nan, limit, off <= 3.5))
    return rows


# --------------------------------------------------------------------------------------------------------------- table


def jobs(longest: int, seeds: int) -> Iterator[Job]:
    """Every cell of the table."""
    lengths = [n for n in (10, 100, 1000, 10_000, 100_000, 1_000_000) if n <= longest]
    for law in NAMED:
        steps = 20.0 if law in SUMS else 1.0
        for n in lengths:
            for what in ("whole", "gaps"):
                yield Job(n * steps * RECORDS.get(n, 1), textbook, (law, n, what, seeds))
            for columns in (1, 3, 6) if n <= 10_000 else (6,) if n <= 100_000 or law in PLAIN else ():
                yield Job(30.0 * n * RECORDS.get(n, 1), textbook, (law, n, f"p {columns}", seeds))
            if n in (10_000, 100_000) and law != "constant":
                for offset in (0.0, 1e3, 1e6):
                    yield Job(5.0 * n * steps, textbook, (law, n, f"offset {offset:g}", 1))
            if n >= 10_000:
                yield Job(3.0 * n, reports, (law, n, seeds))
        for n in (*lengths, 300_000):
            if n <= longest:
                yield Job(10.0 * n + 1e5, dense, (law, n, seeds))
                if law in PLAIN and n >= 10_000:
                    yield Job(10.0 * n + 1e5, dense, (law, n, seeds, 16))
        for n in (10, 100, 1000, 3600):
            if law in PLAIN or n <= 100:
                yield Job(1e6, refined, (law, n, seeds))
    for n in (1200, 3600):
        yield Job(3e6, targets, (n, seeds))


def show(rows: list[Row]) -> None:
    """The table, and a line for each pair and build."""
    console = Console(width=WIDTH)
    table = Table(box=box.SIMPLE_HEAD, title="What must agree with what", title_justify="left")
    for heading in ("pair", "build", "records of", "n", "what", "records"):
        table.add_column(heading, no_wrap=True, justify="right" if heading == "records" else "left")
    for heading in ("d ln p", "dP", "d mean/sd", "d sd"):
        table.add_column(heading, no_wrap=True, justify="right")
    table.add_column("tolerance", no_wrap=True)
    table.add_column("kept", no_wrap=True)
    said = {True: "yes", False: "NO", None: "measured"}
    order = list(dict.fromkeys(row.pair for row in sorted(rows, key=lambda row: PAIRS.index(row.pair))))
    for pair in order:
        mine = [row for row in rows if row.pair == pair]
        laws = {law: index for index, law in enumerate(NAMED)}
        mine.sort(
            key=lambda row: (list(LIMITS).index(row.build), laws.get(row.law, len(laws)), row.n, row.what, row.law)
        )
        for row in mine:
            numbers = ("" if math.isnan(x) else f"{x:.1e}" for x in (row.ln_p, row.probability, row.mean, row.sd))
            cells = (row.pair, row.build, row.law, size(row.n), row.what, str(row.records), *numbers)
            table.add_row(*cells, row.tolerance, said[row.kept])
        table.add_section()
    for pair in order:
        for build in LIMITS:
            mine = [row for row in rows if (row.pair, row.build) == (pair, build) and row.kept is not None]
            if not mine:
                continue
            values = np.array([(row.ln_p, row.probability, row.mean, row.sd) for row in mine])
            worst = np.where(np.isnan(values).all(axis=0), math.nan, np.max(np.nan_to_num(values), axis=0))
            numbers = ("" if math.isnan(x) else f"{x:.1e}" for x in worst)
            lost = sum(not row.kept for row in mine)
            cells = (pair, build, "all", "", f"worst of {len(mine)} rows", str(sum(r.records for r in mine)), *numbers)
            table.add_row(*cells, mine[0].tolerance, "yes" if lost == 0 else f"NO: {lost} rows", style="bold")
    console.print(table, highlight=False)


PAIRS = ("textbook", "reports", "dense", "refined", "targets", "ensemble")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="records of up to 10^4 bank samples")
    parser.add_argument("--seeds", type=int, default=1, help="times the records")
    parser.add_argument("--only", choices=PAIRS, action="append", help="these pairs alone")
    arguments = parser.parse_args()
    pairs = arguments.only or PAIRS
    cells = jobs(10_000 if arguments.quick else 1_000_000, arguments.seeds)
    todo = [job for job in cells if job.work.__name__ in pairs]
    todo.sort(key=lambda job: job.cost)  # an interrupted table has most rows
    start, whole = time.monotonic(), True
    rows: list[Row] = []
    try:
        with multiprocessing.get_context("spawn").Pool() as pool:
            for done, found in enumerate(pool.imap_unordered(Job.run, todo), 1):
                rows += found
                print(f"{done} of {len(todo)} cells, {time.monotonic() - start:.0f} s", file=sys.stderr)
                for row in found:
                    if row.kept is False:
                        print(f"not kept: {row}", file=sys.stderr)
        if "ensemble" in pairs:
            rows += ensemble()
    except KeyboardInterrupt:
        print("interrupted: what was done so far", file=sys.stderr)
        whole = False
    show(rows)
    lost = sum(row.kept is False for row in rows)
    print(f"{len(rows)} rows, {lost} of them not kept; {time.monotonic() - start:.0f} s")
    return 1 if lost or not whole else 0


if __name__ == "__main__":
    sys.exit(main())
