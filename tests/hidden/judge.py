"""The judge of the hidden suites: draws records, has `selfcal diagnose` find what they hide, compares with the truth.

    make hidden                                          effects in recordings; an hour and more
    make hidden CLASSES="step clean" RECORDS=5 RATE=1    some of them
    make hidden SAVE=build/hidden/records                leaves recordings, truths and answers for a closer look
    make hidden RIVALS=1                                 other methods on the same records (rivals.py)
    make hidden-physics KINDS="turn_on tilt" SIZES=plain RATE=1 SECONDS=1500
    make hidden-several KINDS="step f_jumps" RECORDS=3 SEED=1

A `Suite` has its generator, its questions, its verdicts and its goals in a file of its own. The frame is here.
Each record's answer is a JSON file in build/hidden/SUITE/COMMIT (`OUT=DIR`: there). A run that was interrupted goes on
where it ended. `summary.json` there has goals and verdicts. Exit code 1: a goal is missed, or not all was run.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol

os.environ.setdefault("OMP_NUM_THREADS", "1")  # one core a record
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from rich.progress import track

ROOT = Path(__file__).resolve().parents[2]
#: Name of a suite: its file. The constant there has the name in capitals.
SUITES = {
    "recordings": "recordings_suite",
    "physics": "physics_suite",
    "several": "several_suite",
    "rivals": "rivals",
    "tsoutliers": "rivals",
}

Answer = dict[str, Any]
Document = dict[str, Any]


class Goal(Protocol):
    """A number of `of` records with its limits; `str` is its line in the output."""

    @property
    def of(self) -> int:
        """Records or cases; 0: the goal is not shown."""

    @property
    def met(self) -> bool:
        """The number is within its limits."""


@dataclass(frozen=True)
class Task:
    """One record to draw. None: the generator draws the value."""

    kind: str
    seed: int
    size: str = "plain"
    rate: float | None = None
    law: str | None = None
    seconds: float | None = None
    pair: tuple[str, str] | None = None

    @property
    def name(self) -> str:
        """Of its files."""
        given = (self.kind, *(self.pair or ()), self.size, self.rate, self.law, self.seconds, str(self.seed))
        return "_".join(str(part) for part in given if part).replace(":", "_")


@dataclass(frozen=True)
class Suite:
    """A generator, questions about its records, and which answers are right. Workers import its functions by name."""

    about: str
    kinds: tuple[str, ...]  # that `--kinds` accepts; all if none is given
    records: int  # of a kind, if not given
    tasks: Callable[..., list[Task]]  # of (kinds, records, seed of the first record, **options)
    ask: Callable[[Task, Path], Answer]  # draws a record into a folder; JSON of its truth and answers
    table: Callable[[Sequence[Answer]], str]
    goals: Callable[[Sequence[Answer]], Sequence[Goal]] = lambda answers: []
    verdict: Callable[[Answer], Answer] = lambda made: {}  # additions to an answer: its worth by the truth
    details: Callable[[Sequence[Answer]], Sequence[str]] = lambda answers: []  # lines below the goals
    seed: int | None = None  # of the first record, if not given; None: today's date
    options: Mapping[str, dict[str, Any]] = field(default_factory=dict)  # its own: name, keywords of argparse


# --------------------------------------------------------------------------------------------------------- one record


def save_columns(path: Path, t: Any, columns: Mapping[str, Any]) -> None:
    """A recording: columns by `name[unit]`, at the times `t`, s."""
    np.savez(path, allow_pickle=False, **{"t[s]": t, **columns})


def diagnosed(
    path: Path, truth: Answer, axes: Sequence[str] = (), detector: Callable[..., Any] | None = None, **options: Any
) -> Answer:
    """Truth, the document of `diagnose` (or another `detector`) on a recording, CPU seconds.

    A fault of the detector is the answer of every axis. Truth and document are left beside the recording.
    """
    from selfcal.verbs.diagnose import diagnose

    _write(path.with_suffix(".truth.json"), truth)
    start = time.process_time()
    try:
        document: Document = dict((detector or diagnose)(path, axes=axes, **options))
        document["axes"] = {name: document["axes"][name] for name in axes or document["axes"]}
    except Exception as error:
        document = {"axes": {name: {"error": f"{type(error).__name__}: {error}"} for name in axes or ["all"]}}
    seconds = time.process_time() - start
    _write(path.with_suffix(".answer.json"), document)
    return {"truth": truth, "document": document, "seconds": seconds}


def by_evidence(entry: Answer) -> list[Answer]:
    """Findings of an axis, the most evidence first; none after a fault."""
    return sorted(entry.get("findings", []), key=lambda finding: -float(finding["evidence_gain_nats"] or 0.0))


def answer(task: Task, ask: Callable[[Task, Path], Answer], out: Path, save: Path | None = None) -> Answer:
    """The answer on a record from its file in `out`, asked first if it is not there.

    `save`: ask anyway, and leave the recording in this folder.
    """
    path = out / f"{task.name}.json"
    if save is not None or not path.exists():
        with tempfile.TemporaryDirectory() as folder:
            made = {"task": vars(task), **ask(task, save or Path(folder))}
        partial = path.with_suffix(f".{os.getpid()}")
        _write(partial, made)
        partial.replace(path)
    read: Answer = json.loads(path.read_text())
    return read


def _write(path: Path, values: Answer) -> None:
    path.write_text(json.dumps(values, indent=1, default=lambda numbers: numbers.tolist()) + "\n")


def run(work: Sequence[Task], job: Callable[..., Answer], *given: Any, processes: int) -> list[Answer]:
    """The answers in the order of the tasks, with a progress bar. Ctrl-C keeps the answers that are there.

    A record that cannot be drawn (plain flicker of 20 min at 1 Hz) is left out with a warning.
    """
    done: dict[int, Answer] = {}
    # The terminal interrupts the workers too: they finish their record.
    with ProcessPoolExecutor(processes, initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN)) as pool:
        futures = {pool.submit(job, task, *given): i for i, task in enumerate(work)}
        try:
            for future in track(as_completed(futures), "hidden effects", total=len(work)):
                try:
                    done[futures[future]] = future.result()
                except RuntimeError as error:
                    print(f"left out: {error}", file=sys.stderr)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
    return [done[i] for i in sorted(done)]


# ------------------------------------------------------------------------------------------------------------ summary


@dataclass(frozen=True)
class Line:
    """A measured share, and its limits (`least` None: for information)."""

    what: str
    hits: int
    of: int
    least: float | None = None
    most: float = 1.0

    @property
    def met(self) -> bool:
        """The share is within its limits, or there is no record."""
        return self.least is None or self.of == 0 or self.least * self.of <= self.hits <= self.most * self.of

    def __str__(self) -> str:
        percent = f"{100.0 * self.hits / self.of:5.1f} %" if self.of else "    - "
        most = "" if self.most == 1.0 else f", <= {100.0 * self.most:g} %"
        met = "ok" if self.met else "MISSED"
        wanted = "" if self.least is None else f"   (>= {100.0 * self.least:g} %{most})  {met}"
        return f"{self.what:<62} {self.hits:>4} of {self.of:<4} {percent}{wanted}"


def share(what: str, results: Iterable[bool | None], least: float | None = None, most: float = 1.0) -> Line:
    """How many of the results are true. None is no result."""
    known = [bool(result) for result in results if result is not None]
    return Line(what, sum(known), len(known), least, most)


def where(answers: Sequence[Answer], **task: Any) -> list[Answer]:
    """Answers whose task has these values."""
    return [each for each in answers if all(each["task"][key] == value for key, value in task.items())]


def ended(answers: Sequence[Answer], outcome: str, what: str, least: float | None = None, most: float = 1.0) -> Line:
    """How many of the answers have this outcome."""
    return share(what, (each["outcome"] == outcome for each in answers), least, most)


def markdown(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table; a count of 0 is an empty cell."""
    lines = [f"| {' | '.join(str(cell or '') for cell in row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


# --------------------------------------------------------------------------------------------------------------- main


def _state() -> str:
    """The commit that is checked out; with changes, `-dirty` and a sum of them."""
    commands = ["git", "describe", "--always", "--dirty"], ["git", "diff", "HEAD"]
    commit, changes = (subprocess.run(each, cwd=ROOT, capture_output=True, check=False).stdout for each in commands)
    return (commit.decode().strip() or "unknown") + (f"-{zlib.crc32(changes):08x}" if changes else "")


def command_line(arguments: Sequence[str] | None) -> tuple[Suite, argparse.Namespace, list[Task]]:
    """The suite, the options with its defaults, and the records that they choose. An unknown kind ends the program."""
    chooser = argparse.ArgumentParser(add_help=False)
    chooser.add_argument("--suite", choices=SUITES, default="recordings")
    name = chooser.parse_known_args(arguments)[0].suite
    suite: Suite = getattr(importlib.import_module(SUITES[name]), name.upper())
    parser = argparse.ArgumentParser(description=suite.about, parents=[chooser])
    seed = int(datetime.now().strftime("%Y%m%d")) if suite.seed is None else suite.seed
    parser.add_argument("--kinds", nargs="*", default=[], help=f"of {', '.join(suite.kinds)}; all if none")
    parser.add_argument("--records", type=int, default=suite.records, help="a kind, size and rate")
    parser.add_argument("--seed", type=int, default=seed, help="of the first record")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="records at a time")
    parser.add_argument("--out", type=Path, help="folder of the answers")
    parser.add_argument("--save", type=Path, metavar="DIR", help="leave recordings, truths and answers here")
    for option, keywords in suite.options.items():
        parser.add_argument(f"--{option}", **keywords)
    options = parser.parse_args(arguments)
    if unknown := [kind for kind in options.kinds if kind not in suite.kinds]:
        parser.error(f"unknown kind {unknown[0]}; there are {', '.join(suite.kinds)}")
    own = {option: getattr(options, option) for option in suite.options}
    return suite, options, suite.tasks(options.kinds, options.records, options.seed, **own)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; exit code 1 where a goal is not met or the run is not whole."""
    suite, options, work = command_line(arguments)
    out = options.out or ROOT / "build" / "hidden" / options.suite / _state()
    for folder in filter(None, (out, options.save)):
        folder.mkdir(parents=True, exist_ok=True)
    print(f"{len(work)} records, seed {options.seed}, answers in {out}", flush=True)
    made = run(work, answer, suite.ask, out, options.save, processes=options.processes)
    answers = [each | suite.verdict(each) for each in made]
    goals = [goal for goal in suite.goals(answers) if goal.of]
    parts: list[Sequence[Any]] = [[suite.table(answers)], goals, suite.details(answers)]
    for part in filter(None, parts):
        print("".join(f"{line}\n" for line in part))
    if seconds := [each["seconds"] for each in answers if "seconds" in each]:
        print(f"CPU of a diagnosis: median {np.median(seconds):.1f} s, longest {max(seconds):.0f} s")
    for error, count in Counter(each["error"] for each in answers if "error" in each).most_common(5):
        print(f"{count} times refused: {error}")
    judged = [{key: value for key, value in each.items() if key != "document"} for each in answers]
    _write(out / "summary.json", {"goals": [{**vars(goal), "met": goal.met} for goal in goals], "answers": judged})
    if len(answers) < len(work):
        print(f"NOT WHOLE: {len(answers)} of {len(work)} records")
        return 1
    return int(not all(goal.met for goal in goals))


if __name__ == "__main__":
    sys.modules["judge"] = sys.modules["__main__"]  # for the suites, which import it
    sys.exit(main())
