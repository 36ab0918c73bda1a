"""Does `selfcal diagnose` name what the second generator (physics.py) hides? (`make hidden-physics`)

Records of even seeds have a random walk, of odd ones Gauss-Markov.

A record's answer is by its finding of the most evidence: `right` is the truth's cause, `accepted` another name of
physics.KINDS that describes it as well (with the right other axis), `unexplained` no name but not adequate either,
`wrong` any other name, `adequate` nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from judge import Answer, Line, Suite, Task, by_evidence, diagnosed, ended, markdown, save_columns, share, where
from physics import AXES, CLEAN, KINDS, LAWS, SIZES, pair

OUTCOMES = ("right", "accepted", "unexplained", "wrong", "adequate", "refused")
NAMED = OUTCOMES[:2]
#: Share of plain and of near records that may end so.
MOST = {"adequate": (0.03, 0.40), "wrong": (0.05, 0.10)}
#: Clean axes that may be inadequate.
MOST_CLEAN = 0.01
#: A second record with less than this is no ground for what carries over, nats.
LEAST_CARRIED = 15.0


def tasks(
    kinds: Sequence[str],
    records: int,
    seed: int,
    sizes: Sequence[str],
    rate: Sequence[float],
    seconds: float | None,
    clean: int | None,
) -> list[Task]:
    """The truths to draw: `records` a kind, size and rate; `clean` ones a rate."""
    made = []
    for hertz in rate:
        for kind in kinds or [*KINDS, CLEAN]:
            if kind == CLEAN:
                own, count = ["plain"], 10 * records if clean is None else clean
            else:
                possible = hertz >= KINDS[kind].least_rate
                own, count = [size for size in sizes if possible and size in KINDS[kind].sizes], records
            seeds = range(seed, seed + count)
            made += [Task(kind, i, size, hertz, LAWS[i % 2], seconds) for size in own for i in seeds]
    return made


# --------------------------------------------------------------------------------------------------------- one record


def outcome(entry: dict[str, Any], truth: dict[str, Any]) -> Answer:
    """What an axis's entry of `selfcal.diagnose/1` is worth, by the truth and the table of names."""
    if "error" in entry:
        return {"outcome": "refused", "error": entry["error"], "named": []}
    kind = KINDS[truth["kind"]]
    findings = effects(entry, truth["lattice"][truth["axis"]] is not None and "quantization" not in kind.names)
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


def effects(entry: dict[str, Any], on_lattice: bool) -> list[dict[str, Any]]:
    """Findings, the most evidence first. `quantization` of a reading on a lattice is true, and no effect's name."""
    return [finding for finding in by_evidence(entry) if not (on_lattice and finding["cause"] == "quantization")]


def _words(finding: dict[str, Any]) -> str:
    form = finding.get("form") or finding["estimate"].get("form")
    other = finding["estimate"].get("other") or finding["estimate"].get("statistic")
    marks = "".join(f":{mark}" for mark in (form, other) if mark)
    return f"{finding['cause']}{marks}({float(finding['evidence_gain_nats'] or 0.0):.0f})"


def verdict(made: Answer) -> Answer:
    """The outcome of a record with an effect; the inadequate axes of a clean one."""
    truth, entries = made["truth"], made["document"]["axes"]
    if truth["kind"] != CLEAN:
        return outcome(entries[truth["axis"]], truth)
    words = {
        name: entry.get("error") or " ".join(map(_words, effects(entry, truth["lattice"][name] is not None)))
        for name, entry in entries.items()
        if "error" in entry or entry["findings"]
    }
    return {"inadequate": {name: word or "nothing named" for name, word in words.items()}}


def ask(task: Task, folder: Path) -> Answer:
    """Draws a truth's two records, has the first diagnosed, and scores the written model on the second."""
    from selfcal.verbs.identify import identify

    first, second = pair(task.kind, task.seed, task.size, task.rate, task.law, task.seconds)
    path = folder / f"{task.name}.npz"
    save_columns(path, first.t, first.columns)
    axis, model = first.axis, path.with_suffix(".yaml")
    axes = list(AXES) if task.kind == CLEAN else [axis]
    made = diagnosed(path, first.truth, axes, write_model=model)
    if task.kind == CLEAN:
        return made
    try:
        made["identify_adequate"] = identify(path, axes=axes)["axes"][axis].get("adequate")
        if second is not None and KINDS[task.kind].slow:
            made["carried"] = {"there": second.truth["nats_here"], "gained": 0.0}
            if made["document"]["axes"][axis].get("findings"):
                path = folder / f"{task.name}_second.npz"
                save_columns(path, second.t, second.columns)
                base, own = (_evidence(identify(path, axes=axes, model=each), axis) for each in (None, model))
                made["carried"]["gained"] = own - base
    except Exception as error:  # a model that `identify` refuses gains nothing
        made["identify_error"] = f"{type(error).__name__}: {error}"
    return made


def _evidence(document: dict[str, Any], axis: str) -> float:
    """Of an axis over all laws alike."""
    return float(np.logaddexp.reduce(list(document["axes"][axis]["log_evidence"].values())))


# ------------------------------------------------------------------------------------------------------------ summary


def goals(answers: Sequence[Answer]) -> list[Line]:
    """The goals, for the records that were run."""
    lines = []
    for place, size in enumerate(SIZES):
        own = [each for each in where(answers, size=size) if each["task"]["kind"] != CLEAN]
        points = _points(own)
        lines.append(share(f"{size}: right or accepted", (each["outcome"] in NAMED for each in own)))
        half = f"{size}: the same in halves, unexplained one"
        lines.append(Line(half, sum(points), 2 * len(own), 0.90 if place == 0 else None))
        for name, most in MOST.items():
            lines.append(ended(own, name, f"{size}: {name}", 0.0, most[place]))
        lines.append(share(f"{size}: a further wrong name", (bool(each.get("extra")) for each in own)))
        lines.append(share(f"{size}: form of the channel", (each.get("form_right") for each in own)))
        if place == 0:
            of = [_points(where(own, kind=kind)) for kind in KINDS]
            halves = (sum(points) >= len(points) for points in of if points)
            lines.append(share("plain: kinds named in at least half", halves, 1.0))
        missed = [each for each in own if each.get("identify_adequate") is False]
        seen = (bool(each["document"]["axes"][each["truth"]["axis"]].get("findings")) for each in missed)
        lines.append(share(f"{size}: not adequate for identify, then for diagnose", seen, 1.0))
    # A slow record without a name gains nothing.
    there = _with_carried(where(answers, size="plain"))
    half_carried = (each["carried"]["gained"] >= 0.5 * each["carried"]["there"] for each in there)
    lines.append(share("plain, slow: half of what is there carries over", half_carried, 0.70))
    gains = (each["carried"]["gained"] > 0.0 for each in there if each["outcome"] == "right")
    lines.append(share("plain, slow, right: gains on a second record", gains, 0.90))
    clean = where(answers, kind=CLEAN)
    inadequate = sum(len(each["inadequate"]) for each in clean)
    return [*lines, Line("clean: inadequate axes", inadequate, len(AXES) * len(clean), 0.0, MOST_CLEAN)]


def _points(answers: Sequence[Answer]) -> list[int]:
    """Two for a right or accepted name, one for `unexplained`."""
    return [2 if each["outcome"] in NAMED else int(each["outcome"] == "unexplained") for each in answers]


def _with_carried(answers: Sequence[Answer]) -> list[Answer]:
    """Answers whose second record has enough evidence to judge the written model by."""
    return [each for each in answers if "carried" in each and each["carried"]["there"] >= LEAST_CARRIED]


def table(answers: Sequence[Answer]) -> str:
    """By kind and size: outcomes, forms, the median share of evidence that carries over, what was named first."""
    rows = []
    for kind in KINDS:
        for size in SIZES:
            own = where(answers, kind=kind, size=size)
            if not own:
                continue
            counts = Counter(each["outcome"] for each in own)
            forms = [each["form_right"] for each in own if each.get("form_right") is not None]
            shares = [each["carried"]["gained"] / each["carried"]["there"] for each in _with_carried(own)]
            instead = Counter(each["named"][0].split("(")[0] for each in own if each["outcome"] == "wrong")
            row = [kind, size, *(counts[name] for name in OUTCOMES)]
            row.append(f"{sum(forms)}/{len(forms)}" if forms else "")
            row.append(f"{np.median(shares):.2f}" if shares else "")
            row.append(", ".join(f"{name} {count}" for name, count in instead.most_common()))
            rows.append(row)
    return markdown(["kind", "size", *OUTCOMES, "form", "carried", "instead"], rows)


def details(answers: Sequence[Answer]) -> list[str]:
    """Each inadequate axis of a clean record."""
    return [
        f"clean, {each['task']['rate']:g} Hz, seed {each['task']['seed']}, {name}: {words}"
        for each in answers
        for name, words in each.get("inadequate", {}).items()
    ]


PHYSICS = Suite(
    about="Effects from physics: does `selfcal diagnose` name them?",
    kinds=(*KINDS, CLEAN),
    records=10,
    seed=42,
    tasks=tasks,
    ask=ask,
    verdict=verdict,
    goals=goals,
    table=table,
    details=details,
    options={
        "sizes": {"nargs": "*", "default": list(SIZES), "choices": list(SIZES)},
        "rate": {"nargs": "*", "type": float, "default": [1.0, 10.0], "help": "Hz"},
        "seconds": {"type": float, "help": "of each record; default: 20 to 60 min, drawn"},
        "clean": {"type": int, "help": "clean records a rate, six axes each; default: ten times --records"},
    },
)
