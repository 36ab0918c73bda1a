"""`selfcal fleet`: many recordings at once, and the table of the units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from selfcal.base.errors import MOST_NAMED
from selfcal.base.output import print_lines
from selfcal.batch.fail_on import outcome
from selfcal.batch.unit_table import BatchUnit
from selfcal.batch.verdicts import FAIL, PASS, Judged, Limits, judge_limits, unjudged

SCHEMA = "selfcal.fleet/1"


def judged_units(batch: Sequence[BatchUnit], limits: Limits) -> list[Judged]:
    """The verdicts of each recording. A group's limit holds for the axes that any recording of the batch has."""
    stated = limits.of({name for unit in batch for name in unit.axes})
    return [
        (
            unit.device,
            unit.source.path,
            judge_limits(stated, unit.axes, unit.record["recording"]["duration_s"])
            if unit.error is None
            else unjudged(stated, unit.error),
        )
        for unit in batch
    ]


def document_with(batch: Sequence[BatchUnit], fail_on: str | None, judged: Sequence[Judged]) -> dict[str, Any]:
    """The outcome of the batch, by device."""
    failed: dict[str, list[str]] = {}
    open_: dict[str, list[str]] = {}
    for unit in batch:
        for axis, reason in unit.errors.items():
            open_.setdefault(unit.device, []).append(f"{axis}: {reason}" if axis else reason)
        if fail_on is not None and unit.error is None:
            shown, lines = _by_cause(unit, fail_on)
            if shown:
                failed.setdefault(unit.device, []).append(f"{fail_on}: {', '.join(shown)}")
            elif lines:
                open_.setdefault(unit.device, []).extend(lines)
    broken = {unit.source.path for unit in batch if unit.error is not None}  # listed with their errors
    for device, path, verdicts in judged:
        for verdict in verdicts:
            if verdict.verdict != PASS and path not in broken:
                (failed if verdict.verdict == FAIL else open_).setdefault(device, []).append(verdict.words)
    devices = dict.fromkeys(unit.device for unit in batch)
    return {
        "schema": SCHEMA,
        "devices": len(devices),
        "recordings": len(batch),
        "failed": failed,
        "not_judged": {device: list(dict.fromkeys(lines)) for device, lines in open_.items()},
        "limits": [
            {"device": device, "recording": path, **verdict.entry()}
            for device, path, verdicts in judged
            for verdict in verdicts
        ],
        "code": 1 if failed else 2 if open_ else 0,
    }


def _by_cause(unit: BatchUnit, fail_on: str) -> tuple[list[str], list[str]]:
    """The axes that show it, and why others cannot be judged."""
    shown, lines = [], []
    diagnosis = unit.record.get("diagnosis", {})
    for name, axis in unit.axes.items():
        if "error" not in axis:
            judged = outcome({"axes": {name: diagnosis.get(name, axis)}}, fail_on)
            shown += [name] if judged.code == 1 else []
            lines += judged.lines
    return shown, lines


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """What a person reads: how many, and by name the devices that need a look."""
    print_lines(_lines(document), to_stderr=to_stderr)


def _lines(document: Mapping[str, Any]) -> Iterator[str]:
    yield f"{document['recordings']} recordings of {document['devices']} devices"
    yield from document["words"]
    yield from _listed("unlike the batch", document["unlike"])
    yield from _listed("drifting", document["drifting"])
    yield from _listed("failed", document["failed"])
    yield from _listed("not judged", document["not_judged"])


def _listed(what: str, devices: Mapping[str, Sequence[str]]) -> Iterator[str]:
    for device, reasons in list(devices.items())[:MOST_NAMED]:
        yield f"{what}: {device}: {'; '.join(reasons)}"
    if len(devices) > MOST_NAMED:
        yield f"{what}: {len(devices) - MOST_NAMED} more: the table names them"
