"""Hidden effects: draws recordings, has `selfcal diagnose` name what is in them, and compares with the truth.

    make hidden                                       everything; an hour and more
    make hidden CLASSES="step clean" RECORDS=5        some of it
    make hidden SAVE=build/hidden/records             leaves recordings, truths and answers for a closer look
    make hidden RIVALS=1                              rivals.py on the same records instead

Classes: plain, near, pair, outside, clean, or a kind (`step`, `outside:echo`, `clean:ms_stamps`). Seeds come from the
date unless stated. The answers are left in build/hidden/answers.json. Exit code 1: a requirement is not met,
or not all was run.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # one core a record
sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from rich.progress import track

from selfcal.logs.recording import save

from generator import CAUSES, CLEAN, OUTSIDE, PAIRS, SIZES, Effect, Record, draw

OUT = Path(__file__).resolve().parents[2] / "build" / "hidden"
DIAGNOSE = "selfcal.verbs.diagnose:diagnose"
GROUPS = ("plain", "near", "pair", "outside", "clean")
#: Estimates that are right or wrong, and the relative difference that is still right.
EXACT = {"lsb": 1e-3, "limit": 1e-3, "missing": 0.01}
#: What an axis may end as beside a cause.
ADEQUATE, UNEXPLAINED, REFUSED = "adequate", "unexplained", "refused"

Answer = dict[str, Any]
Detector = Callable[..., dict[str, Any]]


@dataclass(frozen=True)
class Task:
    """One record to draw and to judge."""

    group: str
    kind: str
    seed: int
    size: str = "plain"
    rate: float | None = None
    law: str | None = None
    pair: tuple[str, str] | None = None

    @property
    def name(self) -> str:
        """For a file."""
        return f"{self.kind.replace(':', '_')}_{self.size}_{self.law or 'any'}_{self.seed}"


def tasks(classes: Sequence[str], records: int, seed: int, rate: float | None) -> list[Task]:
    """The records of these classes; all without any.

    `records` a cause and size, half as many a kind outside the table, four times as many of different pairs, twenty
    times as many clean ones of each drift law.
    """
    made: list[Task] = []
    for group in ("plain", "near"):
        made += [Task(group, kind, seed + i, group, rate) for kind in CAUSES for i in range(records)]
    pairs = [PAIRS[i] for i in np.random.default_rng(seed).permutation(len(PAIRS))]
    made += [Task("pair", "pair", seed + i, rate=rate, pair=pairs[i % len(pairs)]) for i in range(4 * records)]
    for kind in OUTSIDE:
        made += [Task("outside", f"outside:{kind}", seed + i, rate=rate) for i in range((records + 1) // 2)]
    kinds = [kind for kind in CLEAN if kind != "constant"]
    for law in ("random_walk", "gauss_markov"):
        made += [
            Task("clean", f"clean:{kinds[i % len(kinds)]}", seed + i, rate=rate, law=law) for i in range(20 * records)
        ]
    made += [Task("clean", "clean:constant", seed + i, rate=rate) for i in range(4 * records)]
    return [task for task in made if not classes or task.group in classes or task.kind in classes]


# --------------------------------------------------------------------------------------------------------- one record


def load(detector: str) -> Detector:
    """The function that `module:function` names."""
    module, _, name = detector.partition(":")
    found: Detector = getattr(importlib.import_module(module), name)
    return found


def answer(task: Task, detector: str, keep: Path | None) -> Answer:
    """Draws the record, runs the detector on its file, and judges its answer. Nothing it raises gets out."""
    record = draw(task.kind, task.seed, task.size, task.rate, task.law, task.pair)
    truth = {**record.truth(), "group": task.group}
    with tempfile.TemporaryDirectory() as folder:
        path = (keep or Path(folder)) / f"{task.name}.npz"
        save(path, record.columns, record.rate_hz, t=record.t)
        if keep is not None:
            path.with_suffix(".truth.json").write_text(json.dumps(truth, indent=1) + "\n")
        start = time.perf_counter()
        try:
            document = load(detector)(path, axes=[record.axis])
            entry = document["axes"][record.axis]
        except Exception as error:  # a fault of the detector is an answer too
            entry = {"error": f"{type(error).__name__}: {error}"}
        seconds = time.perf_counter() - start
    if keep is not None:
        path.with_suffix(".answer.json").write_text(json.dumps(entry, indent=1, default=str) + "\n")
    return {"truth": truth, "seconds": seconds, **judge(entry, record)}


def judge(entry: dict[str, Any], record: Record) -> Answer:
    """What an axis's entry of the contract's JSON is worth, by the truth."""
    if "error" in entry:
        return {"first": REFUSED, "named": [], "adequate": False, "error": entry["error"]}
    findings = sorted(entry["findings"], key=lambda finding: -float(finding["evidence_gain_nats"] or 0.0))
    named = [finding["cause"] for finding in findings]
    adequate = not entry["findings"]  # a small finding is one, too
    own = [effect for effect in record.effects if effect.axis == record.axis]
    result: Answer = {"first": named[0] if named else ADEQUATE if adequate else UNEXPLAINED}
    result |= {"named": named, "adequate": adequate, "sizes": {}, "gain": {}, "cleared": None}
    for effect in own:
        finding = next((each for each in findings if each["cause"] == effect.cause), None)
        if finding is not None:
            result["sizes"] |= {f"{effect.cause}.{key}": ok for key, ok in sizes(finding, effect).items()}
            score = (finding.get("gain") or {}).get("log_score_per_sample")
            if score:
                result["gain"][effect.cause] = score["after"] - score["before"]
    outside = [each for each in entry.get("discrepancies", []) if not _inside(each)]
    if outside:
        result["cleared"] = all(_inside(each["after"]) for each in outside if each.get("after"))
    return result


def _inside(statistic: dict[str, Any]) -> bool:
    return bool(statistic["simulated_q005"] <= statistic["measured"] <= statistic["simulated_q995"])


def sizes(finding: dict[str, Any], effect: Effect) -> dict[str, bool]:
    """Whether each judged estimate holds the truth: within its 90 % interval, or within `EXACT` of it."""
    estimate, found = finding["estimate"], {}
    if "other" in effect.size and estimate.get("other") != effect.size["other"]:
        return {"other": False}
    judged = CAUSES[effect.cause].judged if effect.cause in CAUSES else ()
    for key, truth in effect.size.items():
        value = estimate.get(key)
        if key in EXACT:
            middle = value.get("median", value.get("value")) if isinstance(value, dict) else value
            found[key] = middle is not None and abs(middle - truth) <= EXACT[key] * abs(truth)
        elif key in judged:
            found[key] = isinstance(value, dict) and value["q05"] <= truth <= value["q95"]
    return found


# ------------------------------------------------------------------------------------------------------------ summary


@dataclass(frozen=True)
class Line:
    """A share that was measured, and the shares that it must lie between (`least` None: for information)."""

    what: str
    hits: int
    of: int
    least: float | None = None
    most: float = 1.0

    @property
    def met(self) -> bool:
        """The share lies there, or there is nothing to judge."""
        return self.least is None or self.of == 0 or self.least * self.of <= self.hits <= self.most * self.of

    def __str__(self) -> str:
        share = f"{100.0 * self.hits / self.of:5.1f} %" if self.of else "    - "
        most = "" if self.most == 1.0 else f", <= {100.0 * self.most:g} %"
        met = "ok" if self.met else "MISSED"
        wanted = "" if self.least is None else f"   (>= {100.0 * self.least:g} %{most})  {met}"
        return f"{self.what:<62} {self.hits:>4} of {self.of:<4} {share}{wanted}"


def _count(what: str, answers: Iterable[Answer], test: Callable[[Answer], bool], least: float | None = None) -> Line:
    results = [test(each) for each in answers]
    return Line(what, sum(results), len(results), least)


def _right(each: Answer) -> bool:
    return bool(each["first"] == each["truth"]["kind"])


def _causes(each: Answer) -> set[str]:
    return {effect["cause"] for effect in each["truth"]["effects"] if effect["axis"] == each["truth"]["axis"]}


def requirements(answers: Sequence[Answer]) -> list[Line]:
    """The issue's acceptance, for the groups that were run."""
    group = {name: [each for each in answers if each["truth"]["group"] == name] for name in GROUPS}
    lines = []
    for name, least in (("plain", 0.98), ("near", 0.88)):
        if group[name]:
            low, high = SIZES[name]
            what = f"{name} ({low:g} to {high:g} nats): right cause first"
            lines.append(_count(what, group[name], _right, least))
        for kind in CAUSES:
            if own := [each for each in group[name] if each["truth"]["kind"] == kind]:
                lines.append(_count(f"  {kind}", own, _right, 0.90 if name == "plain" else None))
    if both := group["pair"]:
        lines.append(_count("two causes: both named", both, lambda each: _causes(each) <= set(each["named"]), 0.95))
        lines.append(_count("two causes: no third", both, lambda each: set(each["named"]) <= _causes(each), 0.90))
    if group["outside"]:
        lines.append(_count("outside the table: not adequate", group["outside"], lambda e: not e["adequate"], 0.97))
        for kind in OUTSIDE:
            own = [each for each in group["outside"] if each["truth"]["kind"] == f"outside:{kind}"]
            if own:
                lines.append(_count(f"  {kind}", own, lambda e: not e["adequate"]))
    for law in ("random_walk", "gauss_markov", "constant"):
        if own := [each for each in group["clean"] if _law(each) == law]:
            least_clean = None if law == "constant" else 0.99
            lines.append(_count(f"clean, {law}: adequate", own, lambda e: e["adequate"], least_clean))
    for kind in CLEAN:
        if own := [each for each in group["clean"] if each["truth"]["kind"] == f"clean:{kind}"]:
            lines.append(_count(f"  {kind}", own, lambda e: e["adequate"]))
    for name in ("plain", "near"):
        lines += _size_lines(name, group[name])
    named = [each for each in group["plain"] if each.get("cleared") is not None]
    lines.append(_count("plain: statistics outside their band before, all inside after", named, lambda e: e["cleared"]))
    return lines


def _law(each: Answer) -> str:
    return str(each["truth"]["laws"][each["truth"]["axis"]]["law"])


def _size_lines(name: str, answers: Sequence[Answer]) -> list[Line]:
    """Coverage of the intervals: plain ones 85 to 95 %, judged from 100 on. Selection biases those near the limit."""
    held: dict[str, list[bool]] = {}
    for each in answers:
        for key, ok in each.get("sizes", {}).items():
            held.setdefault(key, []).append(ok)
    intervals = [ok for key, all_ok in held.items() if key.split(".")[1] not in EXACT for ok in all_ok]
    least = 0.85 if name == "plain" and len(intervals) >= 100 else None
    lines = [Line(f"{name}: size inside its 90 % interval", sum(intervals), len(intervals), least, 0.95)]
    return lines + [Line(f"  {key}", sum(ok), len(ok)) for key, ok in sorted(held.items())]


def confusion(answers: Sequence[Answer]) -> str:
    """Rows: what was drawn; columns: what was named first."""
    rows: dict[str, Counter[str]] = {}
    for each in answers:
        truth = each["truth"]
        family = truth["kind"].partition(":")[0]
        row = family if truth["group"] in ("outside", "clean", "pair") else f"{family}, {truth['size']}"
        rows.setdefault(row, Counter())[each["first"]] += 1
    columns = [name for name in (*CAUSES, UNEXPLAINED, ADEQUATE, REFUSED) if any(row[name] for row in rows.values())]
    columns += sorted({name for row in rows.values() for name in row} - set(columns))
    lines = ["| drawn | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    lines += [
        f"| {name} | " + " | ".join(str(row[each] or "") for each in columns) + " |" for name, row in rows.items()
    ]
    return "\n".join(lines)


@dataclass(frozen=True)
class Gain:
    """Gain on held-out time of one cause, nats a sample. It must be positive by more than two sd of its mean."""

    cause: str
    values: tuple[float, ...]

    @property
    def met(self) -> bool:
        """One record alone says nothing."""
        return len(self.values) < 2 or float(np.mean(self.values)) > 2.0 * self.error

    @property
    def error(self) -> float:
        """Sd of the mean."""
        return float(np.std(self.values, ddof=1)) / float(np.sqrt(len(self.values)))

    def __str__(self) -> str:
        mean = float(np.mean(self.values))
        sd = f"sd of the mean {self.error:.3g}   {'ok' if self.met else 'MISSED'}" if len(self.values) > 1 else ""
        return f"  {self.cause:<16} {len(self.values):>3} records   mean {mean:.3g} nats a sample   {sd}"


def held_out(answers: Sequence[Answer]) -> list[Gain]:
    """By cause, plain ones that have a gain."""
    gains = []
    for cause in CAUSES:
        own = [each for each in answers if each["truth"]["group"] == "plain" and each["truth"]["kind"] == cause]
        if values := tuple(each["gain"][cause] for each in own if cause in each.get("gain", {})):
            gains.append(Gain(cause, values))
    return gains


# --------------------------------------------------------------------------------------------------------------- main


def run(work: Sequence[Any], job: Callable[..., Answer], *given: Any, processes: int = 2) -> list[Answer]:
    """The answers in the order of the tasks, with a progress bar. Ctrl-C keeps what is there.

    What cannot be drawn (plain flicker of 20 min at 1 Hz) is left out and said.
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


def print_cost(answers: Sequence[Answer]) -> None:
    """CPU seconds of a diagnosis."""
    seconds = [each["seconds"] for each in answers]
    if seconds:
        print(f"\nCPU of a diagnosis: median {np.median(seconds):.1f} s, longest {max(seconds):.0f} s")


def summed_up(answers: Sequence[Answer], work: Sequence[Any], lines: Sequence[Line], out: Path, what: str) -> int:
    """Write `summary.json`; the exit code: 1 where a goal is not met or the run is not whole. `what`: of the work."""
    goals = [{"goal": line.what, "hits": line.hits, "of": line.of, "met": line.met} for line in lines]
    (out / "summary.json").write_text(json.dumps({"goals": goals, "answers": answers}, default=float) + "\n")
    if len(answers) < len(work):
        print(f"NOT WHOLE: {len(answers)} of {len(work)} {what}")
        return 1
    return int(not all(line.met for line in lines))


def command_line(description: str) -> argparse.ArgumentParser:
    """The options that choose the records."""
    today = int(datetime.now().strftime("%Y%m%d"))
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--classes", nargs="*", default=[], help="groups or kinds; all if none")
    parser.add_argument("--records", type=int, default=20, help="records a cause and size")
    parser.add_argument("--seed", type=int, default=today, help="today's date if not given")
    parser.add_argument("--rate", type=float, help="Hz: this rate alone")
    parser.add_argument("--processes", type=int, default=2, help="records at a time")
    return parser


def chosen(parser: argparse.ArgumentParser, options: argparse.Namespace) -> list[Task]:
    """The records of these options, announced; an unknown class ends the program."""
    known = {*GROUPS, *(task.kind for task in tasks([], 2, 0, None))}
    if unknown := [name for name in options.classes if name not in known]:
        parser.error(f"unknown class {unknown[0]}; there are {', '.join(sorted(known))}")
    work = tasks(options.classes, options.records, options.seed, options.rate)
    print(f"{len(work)} records, seed {options.seed}", flush=True)
    return work


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; exit code 1 where a requirement is not met."""
    parser = command_line("Hidden effects: does `selfcal diagnose` name them?")
    parser.add_argument("--save", type=Path, metavar="DIR", help="leave recordings, truths and answers here")
    parser.add_argument("--detector", default=DIAGNOSE, help="module:function(path, axes=[...]) -> document")
    parser.add_argument("--out", type=Path, default=OUT / "answers.json", help="JSON of all answers")
    options = parser.parse_args(arguments)
    work = chosen(parser, options)
    if options.save:
        options.save.mkdir(parents=True, exist_ok=True)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    answers = run(work, answer, options.detector, options.save, processes=options.processes)
    options.out.write_text(json.dumps(answers, default=float) + "\n")
    lines, gains = requirements(answers), held_out(answers)
    faults = Counter(each["error"] for each in answers if "error" in each)
    print(confusion(answers), "", *lines, "", "gain on held-out time, plain ones:", *gains, sep="\n")
    seconds = [each["seconds"] for each in answers]
    print(f"an axis: median {np.median(seconds):.1f} s, longest {max(seconds):.1f} s" if seconds else "")
    for error, count in faults.most_common(5):
        print(f"{count} times refused: {error}")
    if len(answers) < len(work):
        print(f"NOT WHOLE: {len(answers)} of {len(work)} records")
        return 1
    return int(not (all(line.met for line in lines) and all(gain.met for gain in gains)))


if __name__ == "__main__":
    sys.exit(main())
