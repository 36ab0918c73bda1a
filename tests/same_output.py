"""What the verbs print and write, into a folder. Two trees behave alike where `diff -r` of their folders shows nothing
but seconds, memory and paths (rivals, fleet.csv.parts).

    .venv/bin/python tests/same_output.py before        on one tree; `after` on the other, then: diff -r before after

The recordings are the one that ships here, the small logs of `../shared/cases` and, where they are, the real ones. Each
command runs in the folder of its log, so no path of the tree is in an output. What a case's script draws is drawn anew,
from its own seed. A quarter of an hour; `--quick` takes the shipped recording alone.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SHIPPED = ROOT / "tests" / "data" / "simulated_adis16405.npz"
CASES = Path(os.environ.get("SELFCAL_CASES_DIR", ROOT.parent / "shared" / "cases"))
DATA = Path(os.environ.get("SELFCAL_DATA", ROOT.parent / "shared" / "data"))
#: Suffixes of what a case's script may write and `identify` reads.
LOGS = (".csv", ".gz", ".npz", ".txt", ".h5", ".mcap", ".log", ".slcan", ".tlog", ".mat")
#: Longest run of one command, s.
PATIENCE_S = 900.0


def run(folder: Path, name: str, *arguments: str) -> None:
    """Run `selfcal ARGUMENTS` in `folder`; its exit code, stdout and stderr go to `name`.txt there."""
    command = [sys.executable, "-m", "selfcal.cli", *arguments]
    env = {**os.environ, "COLUMNS": "120", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    text = f"$ selfcal {' '.join(arguments)}\nexit {done.returncode}\n{done.stdout}\n--- stderr\n{done.stderr}"
    (folder / f"{name}.txt").write_text(text, encoding="utf-8")


def shipped(folder: Path) -> None:
    """Every verb that reads a log, on the recording that ships here."""
    folder.mkdir()
    shutil.copy(SHIPPED, folder / "log.npz")
    log = "log.npz"
    run(folder, "identify", "identify", log, "--json", "identify.json", "--units", "datasheet")
    run(folder, "fixed", "identify", log, "--engine", "fixed", "--axis", "gx", "--json", "fixed.json", "--gate")
    run(folder, "reference", "identify", log, "--engine", "reference", "--axis", "az", "--json", "reference.json")
    run(folder, "diagnose", "diagnose", log, "--decimate", "1", "--json", "diagnose.json", "--report", "page.html")
    run(folder, "compare", "compare", log, log, "--axis", "gx", "--decimate", "1", "--json", "compare.json")
    run(folder, "replay", "replay", log, "--json", "replay.json")
    run(folder, "response", "response", log, "--input", "gx", "--output", "gy", "--json", "response.json")
    run(folder, "convert", "convert", log, "-o", "converted.csv")
    run(folder, "part", "part", log, "-o", "part.yaml")
    run(folder, "fleet", "fleet", log, "-o", "fleet.csv", "--json", "fleet.json", "--report", "fleet.html")
    run(folder, "rivals", "rivals", log, "--axis", "gx", "--json", "rivals.json")
    run(folder, "simulate", "simulate", "bmi088", "-o", "simulated.csv", "--seed", "3", "--effect", "step")
    run(folder, "codegen", "codegen", "bmi088", "-o", "tables")
    run(folder, "dbc", "dbc", "bmi088", "--node", "2")
    run(folder, "effects", "simulate", "--list-effects")
    run(folder, "montecarlo", "montecarlo", "--records", "20", "--json", "montecarlo.json")
    for verb in sorted(path.stem for path in (ROOT / "tools" / "selfcal" / "verbs").glob("[a-z]*.py")):
        run(folder, f"help-{verb}", verb, "--help")
    run(folder, "help", "--help")


def cases(folder: Path) -> None:
    """`identify` of every small log, and `diagnose` of the means of 1 s."""
    for source in sorted(CASES.iterdir()) if CASES.is_dir() else ():
        own = folder / source.stem
        if source.suffix == ".py" and not source.stem.startswith("S05"):
            own.mkdir()
            shutil.copy(source, own / "case.py")
            subprocess.run([sys.executable, "case.py"], cwd=own, capture_output=True, check=False)
        elif source.suffix in LOGS:
            own.mkdir()
            shutil.copy(source, own)
        else:
            continue
        for log in sorted(path for path in own.iterdir() if path.suffix in LOGS):
            run(own, f"{log.name}.identify", "identify", log.name, "--json", f"{log.name}.identify.json")
            run(
                own,
                f"{log.name}.diagnose",
                "diagnose",
                log.name,
                "--decimate",
                "1",
                "--json",
                f"{log.name}.diagnose.json",
            )


def real(folder: Path) -> None:
    """The real recordings: `identify` of all axes, `diagnose` of gx at 1 Hz with its page."""
    for source in sorted(DATA.glob("*.npz")) if DATA.is_dir() else ():
        own = folder / source.stem
        own.mkdir()
        (own / "log.npz").symlink_to(source)
        run(own, "identify", "identify", "log.npz", "--json", "identify.json")
        more = ("--axis", "gx", "--decimate", "1", "--json", "diagnose.json", "--report", "page.html")
        run(own, "diagnose", "diagnose", "log.npz", *more, "--write-model", "model.yaml")


def main() -> None:
    """Write the folder."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--quick", action="store_true", help="the shipped recording alone")
    given = parser.parse_args()
    given.folder.mkdir(parents=True)
    shipped(given.folder.resolve() / "shipped")
    for other in () if given.quick else (cases, real):
        other(given.folder.resolve())


if __name__ == "__main__":
    main()
