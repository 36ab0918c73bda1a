"""Does `selfcal diagnose` name what the second generator (physics.py) hides?

    make hidden-physics                                        every kind, 10 records, plain and near, and clean ones
    make hidden-physics KINDS="turn_on tilt" RECORDS=3         some of it
    make hidden-physics SIZES=plain RATE=1 SECONDS=1500        one size, rate and length

Each record's answer is a JSON file in build/hidden/physics/COMMIT (`OUT=DIR`: there). A run that was interrupted goes
on where it ended; `summary.json` there has the table. Records of even seeds have a random walk, of odd ones
Gauss-Markov. Exit code 1: a goal is missed, or not all was run.

A record's answer is by its finding of the most evidence: `right` is the truth's cause, `accepted` another name of
physics.KINDS that describes it as well (with the right other axis), `unexplained` no name but not adequate either,
`wrong` any other name, `adequate` nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # one core a record
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parent))

import numpy as np

from judge import Line, print_cost, run, summed_up
from physics import AXES, CLEAN, KINDS, LAWS, Record, pair

ROOT = Path(__file__).resolve().parents[2]
OUTCOMES = ("right", "accepted", "unexplained", "wrong", "adequate", "refused")
#: Share of plain and of near records that may end so.
MOST = {"adequate": (0.03, 0.40), "wrong": (0.05, 0.10)}
#: Clean axes that may be inadequate.
MOST_CLEAN = 0.01
#: A second record with less than this is no ground for what carries over, nats.
LEAST_CARRIED = 15.0

Answer = dict[str, Any]


@dataclass(frozen=True)
class Task:
    """One truth to draw."""

    kind: str
    size: str
    rate: float
    seed: int
    seconds: float | None

    @property
    def law(self) -> str:
        return LAWS[self.seed % 2]

    @property
    def name(self) -> str:
        """Of its answer."""
        length = "" if self.seconds is None else f"_{self.seconds:g}s"
        return f"{self.kind}_{self.size}_{self.rate:g}Hz{length}_{self.seed}.json"


# --------------------------------------------------------------------------------------------------------- one record


def outcome(entry: dict[str, Any], truth: dict[str, Any]) -> Answer:
    """What an axis's entry of `selfcal.diagnose/1` is worth, by the truth and the table of names."""
    if "error" in entry:
        return {"outcome": "refused", "error": entry["error"], "named": []}
    kind = KINDS[truth["kind"]]
    findings = told(entry, truth["lattice"][truth["axis"]] is not None and "quantization" not in kind.names)
    names = [finding["cause"] for finding in findings if finding["cause"] != "unexplained"]
    result: Answer = {
        "named": [_words(finding) for finding in findings],
        "extra": [cause for cause in names[1:] if cause not in kind.names],
    }
    if not findings:
        seen = entry["verdict"] != "adequate" and not entry["findings"]
        return result | {"outcome": "unexplained" if seen else "adequate"}
    first = findings[0]
    if first["cause"] == "unexplained":
        return result | {"outcome": "unexplained"}
    other = first["estimate"].get("other")
    right_place = other is None or not truth["others"] or other in truth["others"]
    if first["cause"] not in kind.names or not right_place:
        return result | {"outcome": "wrong"}
    form = first.get("form") or first["estimate"].get("form") or "static"
    return result | {
        "outcome": "right" if first["cause"] == kind.cause else "accepted",
        "form_right": None if kind.form is None or first["cause"] != kind.cause else form == kind.form,
    }


def told(entry: dict[str, Any], on_lattice: bool) -> list[dict[str, Any]]:
    """Findings, the most evidence first. `quantization` of a reading on a lattice is true, and no effect's name."""
    findings = sorted(entry["findings"], key=lambda finding: -float(finding["evidence_gain_nats"] or 0.0))
    return [finding for finding in findings if not (on_lattice and finding["cause"] == "quantization")]


def _kept(entry: dict[str, Any]) -> dict[str, Any]:
    """What of an entry is judged."""
    if "error" in entry:
        return {"error": entry["error"]}
    keys = ("cause", "evidence_gain_nats", "estimate", "form", "found_in_round")
    findings = [{key: finding[key] for key in keys if key in finding} for finding in entry["findings"]]
    return {"verdict": entry["verdict"], "findings": findings}


def _words(finding: dict[str, Any]) -> str:
    form = finding.get("form") or finding["estimate"].get("form")
    other = finding["estimate"].get("other") or finding["estimate"].get("statistic")
    marks = "".join(f":{mark}" for mark in (form, other) if mark)
    return f"{finding['cause']}{marks}({float(finding['evidence_gain_nats'] or 0.0):.0f})"


def _write(path: Path, record: Record) -> None:
    np.savez(path, allow_pickle=False, **{"t[s]": record.t, **record.columns})


def answer(task: Task, out: Path) -> Answer:
    """Draws a truth's two records, has the first diagnosed, and scores the written model on the second."""
    path = out / task.name
    if not path.exists():
        partial = path.with_suffix(f".{os.getpid()}")
        partial.write_text(json.dumps(_run(task), default=float) + "\n")
        partial.replace(path)
    made: Answer = json.loads(path.read_text())
    if task.kind != CLEAN:
        return made | outcome(made["entries"][made["truth"]["axis"]], made["truth"])
    lattice = made["truth"]["lattice"]
    named = {
        name: entry.get("error") or " ".join(map(_words, told(entry, lattice[name] is not None)))
        for name, entry in made["entries"].items()
        if "error" in entry or entry["findings"]
    }
    return made | {"inadequate": {name: words or "nothing named" for name, words in named.items()}}


def _run(task: Task) -> Answer:
    """What `diagnose` and `identify` say of a truth's records."""
    from selfcal.verbs.diagnose import diagnose
    from selfcal.verbs.identify import identify

    first, second = pair(task.kind, task.seed, task.size, task.rate, task.law, task.seconds)
    start = time.process_time()
    made: Answer = {"task": vars(task), "truth": first.truth}
    with tempfile.TemporaryDirectory() as folder:
        one, two, model = (Path(folder) / name for name in ("one.npz", "two.npz", "model.yaml"))
        _write(one, first)
        axes = [first.axis] if task.kind != CLEAN else list(AXES)
        try:
            entries = diagnose(one, axes=axes, write_model=model)["axes"]
        except Exception as error:  # a fault of the detector is an answer too
            entries = {name: {"error": f"{type(error).__name__}: {error}"} for name in axes}
        made |= {"seconds": time.process_time() - start, "entries": {n: _kept(e) for n, e in entries.items()}}
        if task.kind == CLEAN:
            return made
        try:
            made["identify_adequate"] = identify(one, axes=axes)["axes"][first.axis].get("adequate")
            if second is not None and KINDS[task.kind].slow:
                made["carried"] = {"there": second.truth["nats_here"], "gained": 0.0}
                if entries[first.axis].get("findings"):
                    _write(two, second)
                    base, own = (_evidence(identify(two, axes=axes, model=m), first.axis) for m in (None, model))
                    made["carried"]["gained"] = own - base
        except Exception as error:  # a model that `identify` refuses gains nothing
            made["identify_error"] = f"{type(error).__name__}: {error}"
    return made


def _evidence(document: dict[str, Any], axis: str) -> float:
    """Of an axis over all laws alike."""
    return float(np.logaddexp.reduce(list(document["axes"][axis]["log_evidence"].values())))


# ------------------------------------------------------------------------------------------------------------ summary


def goals(answers: Sequence[Answer]) -> list[Line]:
    """The issue's, for what was run."""
    lines = []
    for place, size in enumerate(("plain", "near")):
        own = [each for each in answers if each["task"]["size"] == size and each["task"]["kind"] != CLEAN]
        if not own:
            continue
        named = [each["outcome"] in ("right", "accepted") for each in own]
        lines.append(Line(f"{size}: right or accepted", sum(named), len(own)))
        half = sum(2 if ok else each["outcome"] == "unexplained" for ok, each in zip(named, own, strict=True))
        lines.append(
            Line(f"{size}: the same in halves, unexplained one", half, 2 * len(own), 0.90 if place == 0 else None)
        )
        for name, most in MOST.items():
            lines.append(Line(f"{size}: {name}", _count(own, name), len(own), 0.0, most[place]))
        lines.append(Line(f"{size}: a further wrong name", sum(bool(each.get("extra")) for each in own), len(own)))
        forms = [each["form_right"] for each in own if each.get("form_right") is not None]
        lines.append(Line(f"{size}: form of the channel", sum(forms), len(forms)))
        if place == 0:
            shares = [_share([e for e in own if e["task"]["kind"] == kind]) for kind in KINDS]
            known = [share for share in shares if share is not None]
            lines.append(Line("plain: kinds named in at least half", sum(s >= 0.5 for s in known), len(known), 1.0))
        missed = [each for each in own if each.get("identify_adequate") is False]
        found = sum(bool(each["entries"][each["truth"]["axis"]].get("findings")) for each in missed)
        lines.append(Line(f"{size}: not adequate for identify, then for diagnose", found, len(missed), 1.0))
    lines += _carried([each for each in answers if each["task"]["size"] == "plain"])
    clean = [each for each in answers if each["task"]["kind"] == CLEAN]
    if clean:
        inadequate = sum(len(each["inadequate"]) for each in clean)
        lines.append(Line("clean: inadequate axes", inadequate, len(AXES) * len(clean), 0.0, MOST_CLEAN))
    return lines


def _carried(plain: Sequence[Answer]) -> list[Line]:
    """Evidence of the written model on a second record. A slow record without a name gains nothing."""
    there = [each for each in plain if "carried" in each and each["carried"]["there"] >= LEAST_CARRIED]
    half = [_gained(each) >= 0.5 * each["carried"]["there"] for each in there]
    right = [_gained(each) > 0.0 for each in there if each["outcome"] == "right"]
    return [
        Line("plain, slow: half of what is there carries over", sum(half), len(there), 0.70),
        Line("plain, slow, right: gains on a second record", sum(right), len(right), 0.90),
    ]


def _gained(each: Answer) -> float:
    return float(each["carried"]["gained"])


def _count(answers: Sequence[Answer], name: str) -> int:
    return sum(each["outcome"] == name for each in answers)


def _share(answers: Sequence[Answer]) -> float | None:
    """Right or accepted, unexplained counting half."""
    if not answers:
        return None
    counts = Counter(each["outcome"] for each in answers)
    return (counts["right"] + counts["accepted"] + 0.5 * counts["unexplained"]) / len(answers)


def table(answers: Sequence[Answer]) -> str:
    """By kind and size: outcomes, forms, the median share of evidence that carries over, what was named first."""
    head = ["kind", "size", *OUTCOMES, "form", "carried", "instead"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for kind in KINDS:
        for size in ("plain", "near"):
            own = [each for each in answers if each["task"]["kind"] == kind and each["task"]["size"] == size]
            if not own:
                continue
            counts = Counter(each["outcome"] for each in own)
            forms = [each["form_right"] for each in own if each.get("form_right") is not None]
            shares = [
                _gained(each) / each["carried"]["there"]
                for each in own
                if "carried" in each and each["carried"]["there"] >= LEAST_CARRIED
            ]
            instead = Counter(each["named"][0].split("(")[0] for each in own if each["outcome"] == "wrong")
            cells = [kind, size, *(str(counts[name] or "") for name in OUTCOMES)]
            cells.append(f"{sum(forms)}/{len(forms)}" if forms else "")
            cells.append(f"{np.median(shares):.2f}" if shares else "")
            cells.append(", ".join(f"{name} {count}" for name, count in instead.most_common()))
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


# --------------------------------------------------------------------------------------------------------------- main


def _commit() -> str:
    """Checked out now; `-dirty` with changes."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() or "unknown"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Effects from physics: does `selfcal diagnose` name them?")
    parser.add_argument("--kinds", nargs="*", default=[], help=f"of {', '.join([*KINDS, CLEAN])}; all if none")
    parser.add_argument("--sizes", nargs="*", default=["plain", "near"], choices=["plain", "near"])
    parser.add_argument("--records", type=int, default=10, help="records a kind, size and rate")
    parser.add_argument("--clean", type=int, help="clean records a rate, six axes each; default: ten times --records")
    parser.add_argument("--rate", type=float, nargs="*", default=[1.0, 10.0], help="Hz")
    parser.add_argument("--seconds", type=float, help="of each record; default: 20 to 60 min, drawn")
    parser.add_argument("--seed", type=int, default=42, help="of the first record")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, help="folder of the answers")
    options = parser.parse_args(arguments)
    if unknown := [kind for kind in options.kinds if kind not in KINDS and kind != CLEAN]:
        parser.error(f"unknown kind {unknown[0]}; there are {', '.join([*KINDS, CLEAN])}")
    out = options.out or ROOT / "build" / "hidden" / "physics" / _commit()
    out.mkdir(parents=True, exist_ok=True)
    wanted = options.kinds or [*KINDS, CLEAN]
    seeds = range(options.seed, options.seed + options.records)
    clean = range(options.seed, options.seed + (10 * options.records if options.clean is None else options.clean))
    work = [
        Task(kind, size, rate, seed, options.seconds)
        for rate in options.rate
        for kind in wanted
        if kind == CLEAN or rate >= KINDS[kind].least_rate
        for size in (options.sizes if kind != CLEAN else ["plain"])
        if kind == CLEAN or size in KINDS[kind].sizes
        for seed in (seeds if kind != CLEAN else clean)
    ]
    print(f"{len(work)} truths, answers in {out}", flush=True)
    answers = run(work, answer, out, processes=options.processes)
    lines = goals(answers)
    print(table(answers), "", *lines, sep="\n")
    for each in answers:
        for name, words in each.get("inadequate", {}).items():
            print(f"clean, {each['task']['rate']:g} Hz, seed {each['task']['seed']}, {name}: {words}")
    print_cost(answers)
    for error, count in Counter(each["error"] for each in answers if each.get("error")).most_common(5):
        print(f"{count} times refused: {error}")
    return summed_up(answers, work, lines, out, "truths")


if __name__ == "__main__":
    sys.exit(main())
