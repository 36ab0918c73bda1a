"""`--fail-on`: an exit code for a production line. An axis that could not be judged has not passed."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from selfcal.base.ending import HeldSignals
from selfcal.base.errors import UserError, note
from selfcal.batch.verdicts import PASS, Verdict, code_of, worst

#: Words: any unexplained or material finding, a material finding, and a change between two recordings.
INADEQUATE, MATERIAL, CHANGED = "inadequate", "material", "changed"


@dataclass(frozen=True)
class BatchOutcome:
    """Exit code: 0 every axis was judged and passed, 1 it applies to an axis, 2 an axis could not be judged. `lines`:
    the reasons, by axis."""

    code: int
    lines: list[str] = field(default_factory=list)


def check_cause(wanted: str | None, more: Collection[str] = ()) -> None:
    """Raise UserError for an unknown cause. `more`: further words of the verb."""
    if wanted is None:
        return
    from selfcal.diagnosis import hidden  # a second of imports
    from selfcal.diagnosis.causes import CAUSES

    known = (INADEQUATE, MATERIAL, *more, *CAUSES, hidden.ID)
    if wanted not in known:
        raise UserError(f"--fail-on: there is no cause '{wanted}' ({', '.join(known)})")


def outcome(document: Mapping[str, Any], wanted: str) -> BatchOutcome:
    """Exit code for a document of `identify`, `diagnose` or `compare`."""
    judged = list(_judged(document, wanted))
    lines = [line for applies, line in judged if not applies and line]
    return BatchOutcome(1 if any(applies for applies, _ in judged) else 2 if lines else 0, lines)


def _judged(document: Mapping[str, Any], wanted: str) -> Iterator[tuple[bool, str]]:
    """For each axis, whether `wanted` applies, and why that is not known ("": it is)."""
    if "verdicts" in document:
        for name, axis in document["axes"].items():
            apart = isinstance(axis, Mapping)  # not all recordings could be compared
            changed = wanted == CHANGED and bool(axis["changes"] if apart else axis)
            yield changed, f"{name}: {wanted} cannot be judged: {axis['error']}" if apart else ""
        for path, axes in document["verdicts"].items():
            for name, axis in axes.items():
                if "error" not in axis:  # the axis has it in `axes`
                    applies, line = _axis(axis, wanted)
                    yield applies, line and f"{path}: {name}: {line}"
        return
    for name, axis in document["axes"].items():
        applies, line = _axis(axis, wanted)
        yield applies, line and f"{name}: {line}"


def _axis(axis: Mapping[str, Any], wanted: str) -> tuple[bool, str]:
    if "error" in axis:
        return False, f"{wanted} cannot be judged: {axis['error']}"
    if "verdict" not in axis:
        return _of_identify(axis, wanted)
    shown = {INADEQUATE: axis["verdict"] != "adequate", MATERIAL: bool(axis["material"])}
    if shown[wanted] if wanted in shown else wanted in axis["causes"]:
        return True, ""
    for reason in axis["not_judged"]:
        if reason["cause"] == wanted:
            return False, f"{wanted} cannot be judged: {reason['reason']}"
    if axis.get("unfinished"):
        return False, f"{wanted} cannot be judged: {axis['unfinished']}"
    return False, ""


def _of_identify(axis: Mapping[str, Any], wanted: str) -> tuple[bool, str]:
    if wanted == INADEQUATE:
        return axis["adequate"] is False, "no check was made" if axis["adequate"] is None else ""
    if wanted == axis.get("suspicion") or not axis["checks"].get(wanted, {"passed": True})["passed"]:
        return True, ""
    return False, f"{wanted} cannot be judged: identify looks for no single cause, diagnose --fail-on {wanted} does"


def exit_code(document: Mapping[str, Any], wanted: str | None) -> int:
    """Exit code of what `--fail-on` and the limits make of a verb's answer, each reason on stderr. A signal that came
    ends the command here."""
    HeldSignals().check()
    codes = [0]
    if wanted is not None:
        asked = outcome(document, wanted)
        for line in asked.lines:
            note(line)
        codes.append(asked.code)
    if "limits" in document:
        head = ("recording", "device")
        verdicts = [Verdict.of({k: v for k, v in entry.items() if k not in head}) for entry in document["limits"]]
        for verdict, entry in zip(verdicts, document["limits"], strict=True):
            if verdict.verdict != PASS:
                note(f"{entry['recording']}: {verdict.words}" if "recording" in entry else verdict.words)
        codes.append(code_of(verdicts))
    return worst(codes)
