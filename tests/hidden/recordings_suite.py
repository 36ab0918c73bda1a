"""Hidden effects in recordings of `generator.py`: is the right cause named first, is its size right? (`make hidden`)

Kinds are a group (plain, near, pair, outside, clean) or a kind of it (`step`, `outside:echo`, `clean:ms_stamps`).
Seeds come from the date unless stated.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from selfcal.logs.recording import save

from generator import CAUSES, CLEAN, OUTSIDE, PAIRS, SIZES, draw
from judge import Answer, Line, Suite, Task, by_evidence, diagnosed, markdown, share, where

GROUPS = ("plain", "near", "pair", "outside", "clean")
#: Estimates that are right or wrong, and the relative difference that is still right.
EXACT = {"lsb": 1e-3, "limit": 1e-3, "missing": 0.01}
#: Outcomes of an axis that names no cause.
ADEQUATE, UNEXPLAINED, REFUSED = "adequate", "unexplained", "refused"


def group(kind: str, size: str) -> str:
    """Of `GROUPS`."""
    family = kind.partition(":")[0]
    return family if family in GROUPS else size


def tasks(kinds: Sequence[str], records: int, seed: int, rate: float | None = None) -> list[Task]:
    """The records of these kinds and groups; all without any.

    `records` a cause and size, half as many a kind outside the table, four times as many of different pairs, twenty
    times as many clean ones of each drift law.
    """
    made = [Task(kind, seed + i, size, rate) for size in SIZES for kind in CAUSES for i in range(records)]
    pairs = [PAIRS[i] for i in np.random.default_rng(seed).permutation(len(PAIRS))]
    made += [Task("pair", seed + i, rate=rate, pair=pairs[i % len(pairs)]) for i in range(4 * records)]
    made += [Task(f"outside:{kind}", seed + i, rate=rate) for kind in OUTSIDE for i in range((records + 1) // 2)]
    clean = [f"clean:{kind}" for kind in CLEAN if kind != "constant"]
    for law in ("random_walk", "gauss_markov"):
        made += [Task(clean[i % len(clean)], seed + i, rate=rate, law=law) for i in range(20 * records)]
    made += [Task("clean:constant", seed + i, rate=rate) for i in range(4 * records)]
    return [task for task in made if not kinds or task.kind in kinds or group(task.kind, task.size) in kinds]


# --------------------------------------------------------------------------------------------------------- one record


def ask(task: Task, folder: Path, detector: Callable[..., Any] | None = None) -> Answer:
    """Draws the record and runs the detector on the axis in question."""
    record = draw(task.kind, task.seed, task.size, task.rate, task.law, task.pair)
    path = folder / f"{task.name}.npz"
    save(path, record.columns, record.rate_hz, t=record.t)
    return diagnosed(path, record.truth(), [record.axis], detector)


def verdict(made: Answer) -> Answer:
    """The worth of the axis's entry of the contract's JSON, by the truth."""
    truth = made["truth"]
    entry = made["document"]["axes"][truth["axis"]]
    result: Answer = {"group": group(truth["kind"], truth["size"]), "sizes": {}, "gain": {}, "cleared": None}
    findings = by_evidence(entry)
    named = [finding["cause"] for finding in findings]
    effects = [effect for effect in truth["effects"] if effect["axis"] == truth["axis"]]
    true = {effect["cause"] for effect in effects}
    first = REFUSED if "error" in entry else named[0] if named else ADEQUATE
    result |= {"first": first, "right": first == truth["kind"]}
    result |= {"all_named": true <= set(named), "no_other": set(named) <= true}
    result |= {"adequate": first == ADEQUATE, "inadequate": first != ADEQUATE}  # a small finding is one, too
    if "error" in entry:
        return result | {"error": entry["error"]}
    for effect in effects:
        cause = effect["cause"]
        finding = next((each for each in findings if each["cause"] == cause), None)
        if finding is not None:
            result["sizes"] |= {f"{cause}.{key}": right for key, right in sizes(finding, cause, effect["size"]).items()}
            score = (finding.get("gain") or {}).get("log_score_per_sample")
            if score:
                result["gain"][cause] = score["after"] - score["before"]
    outside = [each for each in entry.get("discrepancies", []) if not _inside(each)]
    if outside:
        result["cleared"] = all(_inside(each["after"]) for each in outside if each.get("after"))
    return result


def _inside(statistic: dict[str, Any]) -> bool:
    return bool(statistic["simulated_q005"] <= statistic["measured"] <= statistic["simulated_q995"])


def sizes(finding: dict[str, Any], cause: str, size: dict[str, Any]) -> dict[str, bool]:
    """Whether each judged estimate has the truth: in its 90 % interval, or within `EXACT`."""
    estimate, right = finding["estimate"], {}
    if "other" in size and estimate.get("other") != size["other"]:
        return {"other": False}
    judged = CAUSES[cause].judged if cause in CAUSES else ()
    for key, truth in size.items():
        value = estimate.get(key)
        if key in EXACT:
            middle = value.get("median", value.get("value")) if isinstance(value, dict) else value
            right[key] = middle is not None and abs(middle - truth) <= EXACT[key] * abs(truth)
        elif key in judged:
            right[key] = isinstance(value, dict) and value["q05"] <= truth <= value["q95"]
    return right


# ------------------------------------------------------------------------------------------------------------ summary


def _line(what: str, key: str, answers: Iterable[Answer], least: float | None = None) -> Line:
    """How many of the answers have a true `key`."""
    return share(what, (each[key] for each in answers), least)


def requirements(answers: Sequence[Answer]) -> list[Line]:
    """The goals for shares of answers."""
    of = {name: [each for each in answers if each["group"] == name] for name in GROUPS}
    lines = []
    for name, least, least_of_kind in (("plain", 0.98, 0.90), ("near", 0.88, None)):
        low, high = SIZES[name]
        lines.append(_line(f"{name} ({low:g} to {high:g} nats): right cause first", "right", of[name], least))
        lines += [_line(f"  {kind}", "right", where(of[name], kind=kind), least_of_kind) for kind in CAUSES]
    lines.append(_line("two causes: both named", "all_named", of["pair"], 0.95))
    lines.append(_line("two causes: no third", "no_other", of["pair"], 0.90))
    lines.append(_line("outside the table: not adequate", "inadequate", of["outside"], 0.97))
    lines += [_line(f"  {kind}", "inadequate", where(answers, kind=f"outside:{kind}")) for kind in OUTSIDE]
    for law, least_clean in (("random_walk", 0.99), ("gauss_markov", 0.99), ("constant", None)):
        own = [each for each in of["clean"] if each["truth"]["laws"][each["truth"]["axis"]]["law"] == law]
        lines.append(_line(f"clean, {law}: adequate", "adequate", own, least_clean))
    lines += [_line(f"  {kind}", "adequate", where(answers, kind=f"clean:{kind}")) for kind in CLEAN]
    lines += _size_lines("plain", of["plain"]) + _size_lines("near", of["near"])
    return [*lines, _line("plain: statistics outside their band before, all inside after", "cleared", of["plain"])]


def _size_lines(name: str, answers: Sequence[Answer]) -> list[Line]:
    """Coverage of the intervals: plain ones 85 to 95 %, judged from 100 on. Selection biases those near the limit."""
    of: dict[str, list[bool]] = {}
    for each in answers:
        for key, right in each["sizes"].items():
            of.setdefault(key, []).append(right)
    intervals = [right for key, results in of.items() if key.split(".")[1] not in EXACT for right in results]
    least = 0.85 if name == "plain" and len(intervals) >= 100 else None
    line = share(f"{name}: size inside its 90 % interval", intervals, least, 0.95)
    return [line, *(share(f"  {key}", results) for key, results in sorted(of.items()))]


def confusion(answers: Sequence[Answer]) -> str:
    """Rows: the drawn kinds; columns: the cause that is named first."""
    rows: dict[str, Counter[str]] = {}
    for each in answers:
        family = each["truth"]["kind"].partition(":")[0]
        row = family if family in GROUPS else f"{family}, {each['truth']['size']}"
        rows.setdefault(row, Counter())[each["first"]] += 1
    columns = [name for name in (*CAUSES, UNEXPLAINED, ADEQUATE, REFUSED) if any(row[name] for row in rows.values())]
    columns += sorted({name for row in rows.values() for name in row} - set(columns))
    return markdown(["drawn", *columns], ([name, *(row[column] for column in columns)] for name, row in rows.items()))


@dataclass(frozen=True)
class Gain:
    """Gain on held-out time of one cause, nats a sample. It must be positive by more than two sd of its mean."""

    cause: str
    values: tuple[float, ...]

    @property
    def of(self) -> int:
        """Records."""
        return len(self.values)

    @property
    def met(self) -> bool:
        """One record alone is not judged."""
        return self.of < 2 or float(np.mean(self.values)) > 2.0 * self.error

    @property
    def error(self) -> float:
        """Sd of the mean."""
        return float(np.std(self.values, ddof=1)) / float(np.sqrt(self.of))

    def __str__(self) -> str:
        mean = float(np.mean(self.values))
        sd = f"sd of the mean {self.error:.3g}   {'ok' if self.met else 'MISSED'}" if self.of > 1 else ""
        what = f"plain, gain on held-out time: {self.cause}"
        return f"{what:<62} {self.of:>4} records   mean {mean:.3g} nats a sample   {sd}"


def held_out(answers: Sequence[Answer]) -> list[Gain]:
    """By cause, plain ones that have a gain."""
    of = {cause: where(answers, kind=cause, size="plain") for cause in CAUSES}
    return [
        Gain(cause, tuple(each["gain"][cause] for each in own if cause in each["gain"])) for cause, own in of.items()
    ]


RECORDINGS = Suite(
    about="Hidden effects: does `selfcal diagnose` name them?",
    kinds=(*GROUPS, *CAUSES, *(f"outside:{kind}" for kind in OUTSIDE), *(f"clean:{kind}" for kind in CLEAN)),
    records=20,
    tasks=tasks,
    ask=ask,
    verdict=verdict,
    goals=lambda answers: [*requirements(answers), *held_out(answers)],
    table=confusion,
    options={"rate": {"type": float, "help": "Hz: this rate alone"}},
)
