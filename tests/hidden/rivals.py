"""What others find in the same records: textbook tests of statsmodels, and `tsoutliers` of R where it is installed.

    make hidden RIVALS=1 CLASSES="clean plain" RECORDS=20 SEED=1
    make hidden RIVALS=1 TSOUTLIERS=1 CLASSES="clean:nothing step outliers" RECORDS=10 SEED=1

The textbook tests get the innovations of the null, refitted to block means at 10 Hz or less. `tsoutliers` gets the
first 3000 block means at 1 Hz or less. None of them names a cause: alarms are counted.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from statsmodels.stats.diagnostic import acorr_ljungbox, het_arch
from statsmodels.stats.stattools import jarque_bera

from generator import Array, Record, draw, innovations
from judge import Answer, Suite, Task, markdown
from recordings_suite import RECORDINGS

#: Exit code of tsoutliers.R where the package is absent.
ABSENT = 77


def block_means(record: Record, rate: float) -> tuple[Array, float]:
    """float64[m] of the asked axis at `rate` Hz or the record's own, and the interval in s. Gaps are not seen."""
    block = max(1, round(record.rate_hz / rate))
    y = record.columns[record.axis][1]
    return y[: y.size // block * block].reshape(-1, block).mean(axis=1), block / record.rate_hz


def drawn(task: Task) -> Record:
    """The record of a task of the suite `recordings`."""
    return draw(task.kind, task.seed, task.size, task.rate, task.law, task.pair)


def textbook(task: Task, _folder: Path | None = None) -> Answer:
    """p values of the tests for one record."""
    record = drawn(task)
    seen = innovations(*block_means(record, 10.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # het_arch of statsmodels 0.15 warns of its own inner call
        arch = het_arch(seen, nlags=10)
    p = {
        "Ljung-Box": float(acorr_ljungbox(seen, lags=[20])["lb_pvalue"].iloc[0]),
        "Jarque-Bera": float(jarque_bera(seen)[1]),
        "ARCH": float(arch[1]),
    }
    return {"truth": record.truth(), "p": p}


def means(task: Task, _folder: Path) -> Answer:
    """The block means that `tsoutliers` gets of one record."""
    return {"y": block_means(drawn(task), 1.0)[0][:3000]}


def alarms(answers: Sequence[Answer], level: float = 0.01) -> str:
    """Share of alarms by kind; any: at a third of the level each."""
    tests = ("Ljung-Box", "Jarque-Bera", "ARCH")
    of: dict[str, list[dict[str, float]]] = {}
    for each in answers:
        task = each["task"]
        of.setdefault(f"{task['kind']}, {task['size']}", []).append(each["p"])
        if task["kind"].startswith("clean:"):
            of.setdefault("clean, all", []).append(each["p"])
    rows = []
    for name, p in of.items():
        shares = [100.0 * sum(each[test] < level for each in p) / len(p) for test in tests]
        shares.append(100.0 * sum(min(each.values()) < level / 3.0 for each in p) / len(p))
        rows.append([name, len(p), *(f"{share:.0f}" for share in shares)])
    title = f"alarms at {100 * level:g} %, in % of the records\n"
    return title + markdown(["drawn", "records", *tests, "any"], rows)


def tsoutliers(answers: Sequence[Answer]) -> str:
    """Records by kind in which tsoutliers finds an additive outlier, a level shift, a temporary change."""
    if shutil.which("Rscript") is None:
        return "SKIPPED: tsoutliers: there is no Rscript (Debian: r-base-core, then install.packages('tsoutliers'))"
    script = Path(__file__).with_name("tsoutliers.R")
    with tempfile.TemporaryDirectory() as folder:
        for i, each in enumerate(answers):
            np.savetxt(Path(folder) / f"{i:05d}.csv", each["y"], fmt="%.9g", header="y", comments="")
        done = subprocess.run(["Rscript", str(script), folder], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode == ABSENT:
        return "SKIPPED: tsoutliers: R has no package tsoutliers (install.packages('tsoutliers'))"
    if done.returncode != 0:
        return f"FAILED: {script.name} ended with {done.returncode}"
    of: dict[str, list[list[int]]] = {}
    for line in done.stdout.splitlines():
        name, *counts = line.split(",")
        task = answers[int(name.removesuffix(".csv"))]["task"]
        of.setdefault(f"{task['kind']}, {task['size']}", []).append([int(count) for count in counts])
    rows = []
    for name, outliers in of.items():
        hits = (np.array(outliers) > 0).sum(axis=0)
        any_hit = (np.array(outliers).sum(axis=1) > 0).sum()
        rows.append([name, len(outliers), *map(str, hits), str(any_hit)])
    return "records in which tsoutliers finds a\n" + markdown(["drawn", "records", "AO", "LS", "TC", "any"], rows)


RIVALS = Suite(
    about=__doc__.partition("\n")[0],
    kinds=RECORDINGS.kinds,
    records=RECORDINGS.records,
    tasks=RECORDINGS.tasks,
    ask=textbook,
    table=alarms,
    options=RECORDINGS.options,
)
TSOUTLIERS = replace(RIVALS, ask=means, table=tsoutliers)
