"""Does `selfcal diagnose` name, once and on the right axes, what acts on several axes (several.py)?

    make hidden-several                                        12 kinds, 10 records each, and those beside them
    make hidden-several KINDS="step f_jumps" RECORDS=3 SEED=1  some of it

Each record's answer is a JSON file in build/hidden/several/COMMIT (`OUT=DIR`: there). A run that was interrupted goes
on where it ended; `summary.json` there has the table. Exit code 1: a goal is missed, or not all was run.

The answer is a list of events. An entry of the document's `findings` is one. Findings of axes are one if they have one
cause, `shared_with` names the other axis, and their shapes agree. Shapes agree within 10 s in time, 1/T in frequency,
and a factor of 2 in a duration, a lag or a time constant. A cause of the truth is `named` if an event has its word, its
shape and its axes. Axes are right with a Jaccard index of 0.7 and more; axes of less than 6 expected nats count neither
way. Else a cause is `wrong axes`, `wrong shape` (the word alone is right), `wrong cause` (another word on one of its
axes), or `missed`. A record is as good as its worst cause.
"""

from __future__ import annotations

import argparse
import json
import os
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
from physics_judge import ROOT, _commit
from several import ALL, BESIDE, CALM, CLEAN, KINDS, SECONDS, draw

OUTCOMES = ("named", "wrong axes", "wrong shape", "wrong cause", "missed", "refused")
JACCARD = 0.7
#: An axis of less expected nats need not be named, and may be.
WEAK = 6.0
#: s; ratio.
TIME, FACTOR = 10.0, 2.0
#: Share of the kinds' records that are named, and the least of any kind.
NAMED, EVERY = 98.0 / 120.0, 0.6
#: Share of lists at most one longer than the truth; of clean modules with an event; events beside f, of modules.
SHORT, CLEAN_MOST, BESIDE_F = 0.9, 0.04, 1.0 / 50.0
#: Records of a kind: those that are judged by a small share are more.
TIMES = {CLEAN: 10, CALM: 5}

Answer = dict[str, Any]


@dataclass(frozen=True)
class Task:
    """One record to draw."""

    kind: str
    seed: int


@dataclass
class Event:
    """One line of the answer's list: a cause, its shape and the axes that it acts on."""

    cause: str
    shape: dict[str, Any]
    axes: set[str]
    nats: float

    def __str__(self) -> str:
        shape = " ".join(f"{key}={value:.4g}" if isinstance(value, float) else f"{key}={value}"
                         for key, value in self.shape.items())  # fmt: skip
        return f"{self.cause}[{' '.join(sorted(self.axes))}] {shape} ({self.nats:.0f})"


# ---------------------------------------------------------------------------------------------------------- the answer


def number(value: Any) -> Any:
    """The value of an estimate, whatever its form."""
    if isinstance(value, dict):
        return value.get("median", value.get("value", value.get("mean")))
    return value


def shape_of(finding: dict[str, Any], axis: str = "") -> dict[str, Any]:
    """The parts of a finding's estimate that all its axes have in common. `shared` noise is of the pair."""
    estimate = finding.get("estimate") or {}
    keys = ("time_s", "duration_s", "frequency_hz", "tau_s", "lag_s", "form", "other", "channel", "jumps")
    shape = {key: number(estimate[key]) for key in keys if estimate.get(key) is not None}
    for key in ("form", "other", "channel"):
        if finding.get(key) is not None:
            shape[key] = finding[key]
    if "jumps" in shape:
        shape["jumps"] = [float(number(jump["time_s"])) for jump in shape["jumps"]]
    if finding["cause"] == "shared" and "other" in shape:
        shape["other"] = " ".join(sorted((axis, shape["other"])))
    return shape


def close(key: str, one: Any, other: Any, seconds: float) -> bool:
    """Whether two values of a shape's key agree."""
    if key == "jumps":
        return all(any(abs(a - b) <= TIME for b in other) for a in one)
    if not isinstance(one, float | int) or not isinstance(other, float | int):
        return bool(one == other)
    if key == "time_s":
        return abs(one - other) <= TIME
    if key == "frequency_hz":
        return abs(one - other) <= 1.0 / seconds
    return one > 0.0 < other and max(one / other, other / one) <= FACTOR


def agree(one: dict[str, Any], other: dict[str, Any], seconds: float) -> bool:
    """Whether two shapes agree in every key that both have."""
    return all(close(key, one[key], other[key], seconds) for key in one.keys() & other.keys())


def events(document: dict[str, Any], seconds: float) -> list[Event]:
    """The list that a user reads, the most evidence first."""
    top = [finding for finding in document.get("findings") or [] if isinstance(finding, dict)]
    made = [Event(f["cause"], shape_of(f), _acts_on(f["axes"]), _nats(f)) for f in top]
    ids = {finding.get("id") for finding in top} - {None}
    left = [
        (name, finding)
        for name, entry in document["axes"].items()
        for finding in entry.get("findings", [])
        if finding.get("of") not in ids
    ]
    while left:
        name, finding = left.pop(0)
        event = Event(finding["cause"], shape_of(finding, name), {name}, _nats(finding))
        shared, grown = _with(finding), True
        while grown:
            grown = False
            for other in list(left):
                at, also = other
                named = at in shared or event.axes & _with(also)
                if also["cause"] == event.cause and named and agree(event.shape, shape_of(also, at), seconds):
                    event.axes.add(at)
                    event.nats += _nats(also)
                    shared |= _with(also)
                    left.remove(other)
                    grown = True
        made.append(event)
    return sorted(made, key=lambda event: -event.nats)


def _with(finding: dict[str, Any]) -> set[str]:
    """Axes that a finding of an axis names as having it as well."""
    pair = {(finding.get("estimate") or {}).get("other")} if finding["cause"] == "shared" else set()
    return {*(finding.get("shared_with") or []), *pair} - {None}


def _acts_on(axes: Any) -> set[str]:
    """Axes of a finding of the module: those of a probability of one half and more."""
    if not isinstance(axes, dict):
        return set(axes)
    return {name for name, entry in axes.items() if float((entry or {}).get("probability", 1.0) or 0.0) >= 0.5}


def _nats(finding: dict[str, Any]) -> float:
    for key in ("evidence_nats", "evidence_gain_nats"):
        if finding.get(key) is not None:
            return float(finding[key])
    return 0.0


# --------------------------------------------------------------------------------------------------------- the verdict


def jaccard(piece: dict[str, Any], axes: set[str]) -> float:
    """Of the axes of an event and of the truth, without weak ones. With weak ones alone one of them is enough."""
    weak = {name for name, nats in piece["nats"].items() if nats < WEAK}
    right, found = set(piece["nats"]) - weak, axes - weak
    if not right | found:
        return float(bool(axes & weak))
    return len(right & found) / len(right | found)


def shape_right(piece: dict[str, Any], event: Event, beside: Sequence[Event], seconds: float) -> bool:
    """Whether an event has the truth's shape. A jump of f may be an event of its own on half of its axes."""
    theta, shape = dict(piece["theta"]), dict(event.shape)
    if piece["names"] == ["supply"]:
        shape.setdefault("form", "static")
    if "jumps" in theta:
        own = set(piece["nats"])
        steps = [e.shape["time_s"] for e in beside if e.cause == "step" and 2 * len(e.axes & own) >= len(own)]
        shape["jumps"] = [*shape.get("jumps", []), *steps]
    return all(key in shape and close(key, value, shape[key], seconds) for key, value in theta.items())


def verdict(pieces: Sequence[dict[str, Any]], found: Sequence[Event], seconds: float) -> Answer:
    """Outcome of each cause of the truth, and how much longer the list is than the truth."""
    left, results, words = list(found), [], []
    wanted = [piece for piece in pieces if not piece["optional"]]
    for piece in wanted:
        graded = []
        for event in left:
            right = shape_right(piece, event, left, seconds)
            there = jaccard(piece, event.axes)
            if event.cause in piece["names"]:
                graded.append((0 if right and there >= JACCARD else 1 if right else 2, -there, event))
        if graded:
            rank, _, event = min(graded, key=lambda each: each[:2])
            results.append(OUTCOMES[rank])
            words.append(event.cause)
            left.remove(event)
        else:
            results.append("")
    for k, piece in enumerate(wanted):
        if not results[k]:
            touched = any(event.axes & set(piece["nats"]) for event in left)
            results[k] = "wrong cause" if touched else "missed"
    allowed = 0
    for piece in pieces:
        own = set(piece["nats"])
        for event in list(left):
            same = piece["optional"] and event.cause in piece["names"] and 2 * len(event.axes & own) >= len(own)
            if same and shape_right(piece, event, [], seconds):
                left.remove(event)
                allowed += 1
                break
    return {
        "outcome": max(results, key=OUTCOMES.index) if results else "",
        "outcomes": results,
        "words": words,
        "longer": len(found) - len(wanted) - allowed,
        "beside": [str(event) for event in left],
        "said": [str(event) for event in found],
    }


def answer(task: Task, out: Path) -> Answer:
    """Draws a record, has it diagnosed, and judges the answer."""
    path = out / f"{task.kind}_{task.seed}.json"
    if not path.exists():
        partial = path.with_suffix(f".{os.getpid()}")
        partial.write_text(json.dumps(_run(task), default=float) + "\n")
        partial.replace(path)
    made: Answer = json.loads(path.read_text())
    document = made["document"]
    errors = [entry["error"] for entry in document["axes"].values() if "error" in entry]
    found = events(document, SECONDS)
    made |= verdict(made["truth"]["pieces"], found, SECONDS)
    made["inadequate"] = [name for name, e in document["axes"].items() if e.get("verdict", "adequate") != "adequate"]
    if errors:
        made |= {"outcome": "refused", "error": errors[0]}
    return made


def _run(task: Task) -> Answer:
    """What `diagnose` says of a record, and its CPU seconds without imports of the first record."""
    import selfcal

    record = draw(task.kind, task.seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{task.kind}.npz"
        np.savez(path, allow_pickle=False, **{"t[s]": record.t, **record.columns})
        start = time.process_time()
        try:
            document: Answer = selfcal.diagnose(path)
        except Exception as error:  # a fault of the detector is an answer too
            document = {"axes": {"all": {"error": f"{type(error).__name__}: {error}"}}}
        seconds = time.process_time() - start
    axes = {
        name: {key: entry[key] for key in ("error", "verdict", "findings") if key in entry}
        for name, entry in document["axes"].items()
    }
    kept = {"findings": document.get("findings") or [], "axes": axes}
    return {"task": vars(task), "truth": record.truth, "document": kept, "seconds": seconds}


# ------------------------------------------------------------------------------------------------------------- summary


def goals(answers: Sequence[Answer]) -> list[Line]:
    """The issue's, for what was run."""
    of = {kind: [each for each in answers if each["task"]["kind"] == kind] for kind in ALL}
    lines = []
    main = [each for kind in KINDS for each in of[kind]]
    if main:
        lines.append(Line("twelve kinds: named", _count(main, "named"), len(main), NAMED))
        shares = [_count(of[kind], "named") / len(of[kind]) for kind in KINDS if of[kind]]
        lines.append(Line("  kinds named in six of ten", sum(share >= EVERY for share in shares), len(shares), 1.0))
        word = [each["words"] for each in of["tilt"] if each["outcome"] == "named"]
        lines.append(Line("  tilt by the word tilt, of those named", sum("tilt" in each for each in word), len(word)))
    truths = [each for kind in (*KINDS, "leak", "leak_beside_f", "two") for each in of[kind]]
    if truths:
        short = [each["longer"] <= 1 for each in truths]
        lines.append(Line("lists at most one longer than the truth", sum(short), len(short), SHORT))
        same = [each["longer"] <= 0 for each in truths]
        lines.append(Line("  lists no longer", sum(same), len(same)))
    for kind in ("leak", "leak_beside_f", "two"):
        if of[kind]:
            lines.append(Line(f"{kind}: named", _count(of[kind], "named"), len(of[kind])))
    if of[CALM]:
        lines.append(Line("f without jumps: named", _count(of[CALM], "named"), len(of[CALM])))
        further = sum(len(each["beside"]) for each in of[CALM])
        lines.append(Line("f without jumps: further events a module", further, len(of[CALM]), 0.0, BESIDE_F))
    if of[CLEAN]:
        any_event = sum(bool(each["said"]) for each in of[CLEAN])
        lines.append(Line("clean modules with an event", any_event, len(of[CLEAN]), 0.0, CLEAN_MOST))
    return lines


def _count(answers: Sequence[Answer], name: str) -> int:
    return sum(each["outcome"] == name for each in answers)


def table(answers: Sequence[Answer]) -> str:
    """By kind: outcomes, how much longer the list is than the truth, expected nats and CPU."""
    head = ["kind", "records", *OUTCOMES, "list: as long", "+1", "more", "nats", "CPU, s"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for kind in ALL:
        own = [each for each in answers if each["task"]["kind"] == kind]
        if not own:
            continue
        counts = Counter(each["outcome"] for each in own)
        lengths = Counter(min(max(each["longer"], 0), 2) for each in own)
        nats = [sum(p["together"] for p in each["truth"]["pieces"] if not p["optional"]) for each in own]
        cells = [kind, str(len(own)), *(str(counts[name] or "") for name in OUTCOMES)]
        cells += [str(lengths[k] or "") for k in range(3)]
        cells += [f"{np.median(nats):.0f}", f"{np.median([each['seconds'] for each in own]):.1f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def failures(answers: Sequence[Answer]) -> list[str]:
    """Each record that is not as it should be: truth, expected nats an axis, and the answer."""
    lines = []
    for each in answers:
        if each["outcome"] in ("named", "") and each["longer"] <= 0:
            continue
        task, pieces = each["task"], each["truth"]["pieces"]
        lines.append(f"{task['kind']} {task['seed']}: {each['outcome']}, list {each['longer']:+d}")
        for piece, outcome in zip([p for p in pieces if not p["optional"]], each["outcomes"], strict=True):
            nats = " ".join(f"{name} {value:.0f}" for name, value in piece["nats"].items())
            shape = " ".join(f"{key}={value}" for key, value in piece["theta"].items())
            lines.append(f"    {outcome}: {piece['names'][0]} {shape}: {piece['together']:.0f} nats, {nats}")
        lines.append(f"    said: {each.get('error') or '; '.join(each['said']) or 'nothing'}")
    return lines


# ---------------------------------------------------------------------------------------------------------------- main


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="One cause on several axes: does `selfcal diagnose` name it once?")
    parser.add_argument("--kinds", nargs="*", default=[], help=f"of {', '.join(ALL)}; all if none")
    parser.add_argument("--records", type=int, default=10, help=f"a kind; {CLEAN} ten times, {CALM} five times as many")
    parser.add_argument("--seed", type=int, default=1, help="of the first record")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, help="folder of the answers")
    options = parser.parse_args(arguments)
    if unknown := [kind for kind in options.kinds if kind not in ALL]:
        parser.error(f"unknown kind {unknown[0]}; there are {', '.join([*KINDS, *BESIDE])}")
    out = options.out or ROOT / "build" / "hidden" / "several" / _commit()
    out.mkdir(parents=True, exist_ok=True)
    work = [
        Task(kind, options.seed + i)
        for kind in (options.kinds or ALL)
        for i in range(options.records * (1 if kind in options.kinds else TIMES.get(kind, 1)))
    ]
    print(f"{len(work)} records, answers in {out}", flush=True)
    answers = run(work, answer, out, processes=options.processes)
    lines = goals(answers)
    print(table(answers), "", *lines, "", *failures(answers), sep="\n")
    print_cost(answers)
    kept = [{key: each[key] for key in each if key != "document"} for each in answers]
    return summed_up(kept, work, lines, out, "records")


if __name__ == "__main__":
    sys.exit(main())
