"""Run what `make test` leaves out, and write down when, on which commit and with what outcome it last ran.

`long_run.py NAME COMMAND...` runs the command and puts a line into tests/long_runs.txt, which is committed. The line
ends with the last line that the command printed. A run of a part alone (`--part`) leaves no line. `make test` shows the
lines at its end.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RECORD = ROOT / "tests" / "long_runs.txt"
HEAD = "# The last whole runs of what `make test` leaves out, by tests/long_run.py: name, UTC, commit, outcome.\n"
#: Rooms of `make cases`.
ROOMS = ("agree", "cases", "hidden", "lib", "tools")
#: Targets of the Makefile that run through here.
NAMES = ("campaigns", *(f"cases-{room}" for room in ROOMS), "tolerances", "soak", "emulate", "calibration")


@dataclass(frozen=True)
class Run:
    """`commit` ends with -dirty where files had changes that no commit has."""

    when: str
    commit: str
    outcome: str


def git(*arguments: str) -> str | None:
    """What it says, None where it fails or is not there."""
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def machine() -> str:
    """Its cores and their kind. The seeds of a run are in its tests."""
    return f"{os.cpu_count()} cores, {platform.machine()}"


def commit() -> str:
    """The one that is checked out. The record itself counts as no change."""
    name = git("rev-parse", "--short=10", "HEAD")
    changes = git("status", "--porcelain", "--untracked-files=no", "--", ".", f":!{RECORD.relative_to(ROOT)}")
    return "unknown" if name is None else f"{name}-dirty" if changes else name


def read() -> dict[str, Run]:
    """The record, by name."""
    lines = RECORD.read_text(encoding="utf-8").splitlines() if RECORD.exists() else []
    fields = (line.split(maxsplit=3) for line in lines if not line.startswith("#"))
    return {name: Run(when, at, outcome) for name, when, at, outcome in fields}


def write(runs: dict[str, Run]) -> None:
    """The whole record."""
    rows = (f"{name:12} {run.when} {run.commit} {run.outcome}\n" for name, run in sorted(runs.items()))
    RECORD.write_text(HEAD + "".join(rows), encoding="utf-8")


def say() -> str:
    """A line for each name: when it last ran, and how many commits ago."""
    runs, lines = read(), []
    for name in NAMES:
        if name not in runs:
            lines.append(f"make {name:12} no run is recorded")
            continue
        run = runs[name]
        since = git("rev-list", "--count", f"{run.commit.removesuffix('-dirty')}..HEAD")
        ago = "" if since is None else f", {since} commits ago"
        lines.append(f"make {name:12} {run.outcome}; {run.when}, commit {run.commit}{ago}")
    return "not part of `make test`:\n" + "\n".join(f"  {line}" for line in lines)


def passed_on(command: list[str]) -> tuple[int, str]:
    """Run it and show what it prints as it comes. Its exit code, and its last line."""
    tail = b""
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        while piece := os.read(process.stdout.fileno(), 65536):
            sys.stdout.buffer.write(piece)
            sys.stdout.buffer.flush()
            tail = (tail + piece)[-4096:]
    lines = tail.decode(errors="replace").split("\n")
    return process.returncode, next((line.strip("= ") for line in reversed(lines) if line.strip("= ")), "")


def main() -> int:
    """Exit code of the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("name", choices=NAMES)
    parser.add_argument("--part", action="store_true", help="of the whole: nothing is written down")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    arguments = parser.parse_args()
    at, start = commit(), time.monotonic()
    code, last = passed_on(arguments.command)
    if not arguments.part:
        minutes = (time.monotonic() - start) / 60.0
        outcome = "passed" if code == 0 else f"FAILED with exit code {code}"
        when = datetime.now(UTC).strftime("%Y-%m-%dT%H:%MZ")
        outcome = f"{outcome} after {minutes:.0f} min on {machine()}{': ' if last else ''}{last}"
        write(read() | {arguments.name: Run(when, at, outcome)})
        print(f"written to tests/{RECORD.name}: commit it")
    return code


if __name__ == "__main__":
    sys.exit(main())
