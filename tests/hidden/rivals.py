"""What others find in the same records: textbook tests of statsmodels, and `tsoutliers` of R where it is installed.

    make hidden RIVALS=1 CLASSES="clean plain" RECORDS=20 SEED=1
    make hidden RIVALS=1 TSOUTLIERS=1 CLASSES="clean:nothing step outliers" RECORDS=10 SEED=1

The textbook tests get the innovations of the null, refitted to block means at 10 Hz or less. `tsoutliers` gets the
first 3000 block means at 1 Hz or less. None of them names a cause: alarms are counted.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from statsmodels.stats.diagnostic import acorr_ljungbox, het_arch
from statsmodels.stats.stattools import jarque_bera

from generator import Array, Record, draw, innovations
from judge import OUT, Answer, Task, chosen, command_line, run

#: Exit code of tsoutliers.R where the package is absent.
ABSENT = 77


def block_means(record: Record, rate: float) -> tuple[Array, float]:
    """float64[m] of the asked axis at `rate` Hz or the record's own, and the interval in s. Gaps are not seen."""
    block = max(1, round(record.rate_hz / rate))
    y = record.columns[record.axis][1]
    return y[: y.size // block * block].reshape(-1, block).mean(axis=1), block / record.rate_hz


def textbook(task: Task) -> Answer:
    """p values of the tests for one record."""
    record = draw(task.kind, task.seed, task.size, task.rate, task.law, task.pair)
    seen = innovations(*block_means(record, 10.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # het_arch of statsmodels 0.15 warns of its own inner call
        arch = het_arch(seen, nlags=10)
    p = {
        "Ljung-Box": float(acorr_ljungbox(seen, lags=[20])["lb_pvalue"].iloc[0]),
        "Jarque-Bera": float(jarque_bera(seen)[1]),
        "ARCH": float(arch[1]),
    }
    return {"truth": {**record.truth(), "group": task.group}, "p": p}


def table(answers: Sequence[Answer], level: float = 0.01) -> str:
    """Share of alarms by kind; any: at a third of the level each."""
    tests = ("Ljung-Box", "Jarque-Bera", "ARCH")
    lines = [
        f"alarms at {100 * level:g} %, in % of the records",
        "| drawn | records | " + " | ".join(tests) + " | any |",
    ]
    lines.append("|---" * 6 + "|")
    rows: dict[str, list[dict[str, float]]] = {}
    for each in answers:
        truth = each["truth"]
        rows.setdefault(f"{truth['kind']}, {truth['size']}", []).append(each["p"])
        if truth["group"] == "clean":
            rows.setdefault("clean, all", []).append(each["p"])
    for name, p in rows.items():
        shares = [100.0 * sum(each[test] < level for each in p) / len(p) for test in tests]
        shares.append(100.0 * sum(min(each.values()) < level / 3.0 for each in p) / len(p))
        lines.append(f"| {name} | {len(p)} | " + " | ".join(f"{share:.0f}" for share in shares) + " |")
    return "\n".join(lines)


def tsoutliers(work: Sequence[Task]) -> str:
    """What tsoutliers finds by kind: records with an additive outlier, a level shift, a temporary change."""
    if shutil.which("Rscript") is None:
        return "SKIPPED: tsoutliers: there is no Rscript (Debian: r-base-core, then install.packages('tsoutliers'))"
    folder = OUT / "tsoutliers"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for i, task in enumerate(work):
        y, _ = block_means(draw(task.kind, task.seed, task.size, task.rate, task.law, task.pair), 1.0)
        np.savetxt(folder / f"{i:05d}.csv", y[:3000], fmt="%.9g", header="y", comments="")
    script = Path(__file__).with_name("tsoutliers.R")
    done = subprocess.run(["Rscript", str(script), str(folder)], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode == ABSENT:
        return "SKIPPED: tsoutliers: R has no package tsoutliers (install.packages('tsoutliers'))"
    if done.returncode != 0:
        return f"FAILED: {script.name} ended with {done.returncode}"
    rows: dict[str, list[list[int]]] = {}
    for line in done.stdout.splitlines():
        name, *counts = line.split(",")
        task = work[int(name.removesuffix(".csv"))]
        rows.setdefault(f"{task.kind}, {task.size}", []).append([int(count) for count in counts])
    lines = ["records in which tsoutliers finds a", "| drawn | records | AO | LS | TC | any |", "|---" * 6 + "|"]
    for name, found in rows.items():
        hits = (np.array(found) > 0).sum(axis=0)
        any_hit = (np.array(found).sum(axis=1) > 0).sum()
        lines.append(f"| {name} | {len(found)} | " + " | ".join(str(hit) for hit in (*hits, any_hit)) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = command_line(__doc__.partition("\n")[0])
    parser.add_argument("--tsoutliers", action="store_true", help="R's tsoutliers instead; up to 2 s a record")
    options = parser.parse_args(arguments)
    work = chosen(parser, options)
    if options.tsoutliers:
        print(tsoutliers(work))
        return 0
    answers = run(work, textbook, processes=options.processes)
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "rivals.json").write_text(json.dumps(answers, default=float) + "\n")
    print(table(answers))
    return 0


if __name__ == "__main__":
    sys.exit(main())
