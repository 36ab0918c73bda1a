"""Does `selfcal diagnose` name, once and on the right axes, what acts on several axes (several.py)?
(`make hidden-several`)

The answer is a list of events. An entry of the document's `findings` is one. Findings of axes are one if they have one
cause, `shared_with` names the other axis, and their shapes agree. Shapes agree within 10 s in time, 1/T in frequency,
and a factor of 2 in a duration, a lag or a time constant. A cause of the truth is `named` if an event has its word, its
shape and its axes. Axes are right with a Jaccard index of 0.7 and more; axes of less than 6 expected nats count neither
way. Else a cause is `wrong axes`, `wrong shape` (the word alone is right), `wrong cause` (another word on one of its
axes), or `missed`. A record is as good as its worst cause.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from judge import Answer, Line, Suite, Task, diagnosed, ended, markdown, save_columns, share, where
from several import ALL, CALM, CLEAN, KINDS, SECONDS, draw

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


def tasks(kinds: Sequence[str], records: int, seed: int) -> list[Task]:
    """`records` a kind, and `TIMES` as many of the kinds there unless kinds are asked for."""
    counts = {kind: records * (1 if kind in kinds else TIMES.get(kind, 1)) for kind in kinds or ALL}
    return [Task(kind, seed + i, size="") for kind, count in counts.items() for i in range(count)]


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


def close(key: str, value: Any, other: Any, seconds: float) -> bool:
    """Whether two values of a shape's key agree."""
    if key == "jumps":
        return all(any(abs(a - b) <= TIME for b in other) for a in value)
    if not isinstance(value, float | int) or not isinstance(other, float | int):
        return bool(value == other)
    if key == "time_s":
        return abs(value - other) <= TIME
    if key == "frequency_hz":
        return abs(value - other) <= 1.0 / seconds
    return value > 0.0 < other and max(value / other, other / value) <= FACTOR


def agree(shape: dict[str, Any], other: dict[str, Any], seconds: float) -> bool:
    """Whether two shapes agree in every key that both have."""
    return all(close(key, shape[key], other[key], seconds) for key in shape.keys() & other.keys())


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
            for axis, other in list(left):
                named = axis in shared or event.axes & _with(other)
                if other["cause"] == event.cause and named and agree(event.shape, shape_of(other, axis), seconds):
                    event.axes.add(axis)
                    event.nats += _nats(other)
                    shared |= _with(other)
                    left.remove((axis, other))
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
    right, strong = set(piece["nats"]) - weak, axes - weak
    if not right | strong:
        return float(bool(axes & weak))
    return len(right & strong) / len(right | strong)


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


def verdict(pieces: Sequence[dict[str, Any]], listed: Sequence[Event], seconds: float) -> Answer:
    """Outcome of each cause of the truth, and how much longer the list is than the truth."""
    left, results, words = list(listed), [], []
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
        "longer": len(listed) - len(wanted) - allowed,
        "beside": [str(event) for event in left],
        "said": [str(event) for event in listed],
    }


def ask(task: Task, folder: Path) -> Answer:
    """Draws a record and has it diagnosed."""
    record = draw(task.kind, task.seed)
    path = folder / f"{task.name}.npz"
    save_columns(path, record.t, record.columns)
    return diagnosed(path, record.truth)


def judged(made: Answer) -> Answer:
    """The verdict on a record, or the fault of the detector."""
    document = made["document"]
    result = verdict(made["truth"]["pieces"], events(document, SECONDS), SECONDS)
    errors = [entry["error"] for entry in document["axes"].values() if "error" in entry]
    return result | ({"outcome": "refused", "error": errors[0]} if errors else {})


# ------------------------------------------------------------------------------------------------------------- summary


def goals(answers: Sequence[Answer]) -> list[Line]:
    """The goals, for the kinds that were run."""
    of = {kind: where(answers, kind=kind) for kind in ALL}
    further = ("leak", "leak_beside_f", "two")
    by_kind = [ended(of[kind], "named", kind, EVERY) for kind in KINDS if of[kind]]
    words = ("tilt" in each["words"] for each in of["tilt"] if each["outcome"] == "named")
    longer = [each["longer"] for kind in (*KINDS, *further) for each in of[kind]]
    beside = sum(len(each["beside"]) for each in of[CALM])
    return [
        ended([each for kind in KINDS for each in of[kind]], "named", "twelve kinds: named", NAMED),
        share("  kinds named in six of ten", (line.met for line in by_kind), 1.0),
        share("  tilt by the word tilt, of those named", words),
        share("lists at most one longer than the truth", (count <= 1 for count in longer), SHORT),
        share("  lists no longer", (count <= 0 for count in longer)),
        *(ended(of[kind], "named", f"{kind}: named") for kind in further),
        ended(of[CALM], "named", "f without jumps: named"),
        Line("f without jumps: further events a module", beside, len(of[CALM]), 0.0, BESIDE_F),
        share("clean modules with an event", (bool(each["said"]) for each in of[CLEAN]), 0.0, CLEAN_MOST),
    ]


def table(answers: Sequence[Answer]) -> str:
    """By kind: outcomes, how much longer the list is than the truth, expected nats and CPU."""
    rows = []
    for kind in ALL:
        own = where(answers, kind=kind)
        if not own:
            continue
        counts = Counter(each["outcome"] for each in own)
        lengths = Counter(min(max(each["longer"], 0), 2) for each in own)
        nats = [sum(p["together"] for p in each["truth"]["pieces"] if not p["optional"]) for each in own]
        cpu = np.median([each["seconds"] for each in own])
        outcomes = [counts[name] for name in OUTCOMES]
        rows.append(
            [kind, len(own), *outcomes, *(lengths[k] for k in range(3)), f"{np.median(nats):.0f}", f"{cpu:.1f}"]
        )
    head = ["kind", "records", *OUTCOMES, "list: as long", "+1", "more", "nats", "CPU, s"]
    return markdown(head, rows)


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


SEVERAL = Suite(
    about="One cause on several axes: does `selfcal diagnose` name it once?",
    kinds=tuple(ALL),
    records=10,
    seed=1,
    tasks=tasks,
    ask=ask,
    verdict=judged,
    goals=goals,
    table=table,
    details=failures,
)
