"""`selfcal compare`: what changed between recordings of one part, beyond what each leaves open."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Unpack

from rich import box
from rich.console import Console
from rich.table import Table

from selfcal.adequacy.document import check_writable, write_json
from selfcal.bank.result import HALF_90
from selfcal.base.ending import Held
from selfcal.base.errors import UserError, called, printable
from selfcal.base.results import Comparison
from selfcal.batch.fail_on import CHANGED, check
from selfcal.batch.verdicts import Judged, Limits, Verdict, add_verdicts, check_options, write
from selfcal.logs.loaders import Reading
from selfcal.model.file import Model
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify

SCHEMA = "selfcal.compare/1"
#: A difference counts from so many standard deviations on: once in 1600 quantities by chance.
LIMIT = 3.4
#: Estimates that are sizes of a cause; places in time belong to one recording alone.
SIZES = ("coefficient", "slope", "amplitude", "frequency_hz", "B", "lag1", "ratio", "lsb", "limit")


def compare(
    logs: Sequence[Path | str],
    *,
    axes: Sequence[str] = (),
    model: Path | str | None = None,
    decimate: float | None = None,
    fail_on: str | None = None,
    limits: Path | str | None = None,
    junit: Path | str | None = None,
    verdicts: Path | str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    gate: bool = False,
    json: Path | str | None = None,
    report: Path | str | None = None,
    **reading: Unpack[Reading],
) -> Comparison:
    """Identify and diagnose each of `logs`, and set every one beside the one before it.

    Returns the document `selfcal.compare/1`: by axis a list of changes, each with the quantity, its values and the
    distance in standard deviations; the `verdicts` by recording and axis; and the `quantities` that were set beside
    each other, by recording, axis and name. An axis that two successive recordings do
    not both have, judged and in one unit, is {"error": ..., "changes": [...]}.
    `decimate`, `start_s`, `end_s`, `gate`, `reading`: as `diagnose` has them, of each recording. `fail_on`: see
    fail_on.py; it is only checked here. `report`: file for a page with tables and pictures.
    `limits`, `junit`, `verdicts`: as `identify` has them, of each recording.
    Raises UserError for fewer than two recordings, where no axis can be compared, and as `identify` and `diagnose` do.
    """
    if len(logs) < 2:
        raise UserError(f"compare takes two recordings or more of one part: {called()} compare A B")
    check(fail_on, more=(CHANGED,))
    check_options(limits, junit, verdicts)
    check_writable(json, report, junit, verdicts, inputs=(*logs, model, limits))
    bounds = None if limits is None else Limits.load(limits, Model.load(model))
    seen = []
    judged: list[Judged] = []
    by_log: dict[str, dict[str, Any]] = {}
    curves: dict[str, dict[str, Any]] = {}
    part: dict[str, Any] = {"axes": axes, "model": model, "start_s": start_s, "end_s": end_s, "gate": gate}
    part |= reading
    for log in logs:
        document = identify(log, suspicion=False, **part)
        identified = document["axes"]
        if bounds is not None:
            add_verdicts(document, bounds, None, None)
            judged.append(("", str(log), [Verdict.of(one) for one in document["limits"]]))
        diagnosed = diagnose(log, decimate=decimate, full_rate=decimate is None, **part)["axes"]
        Held().check()
        by_log[str(log)] = {
            name: _verdict(identified.get(name, {}), diagnosed.get(name, {})) for name in identified | diagnosed
        }
        for name, axis in identified.items():
            if axis.get("allan"):
                curves.setdefault(name, {})[str(log)] = axis["allan"]
        seen.append({name: _quantities(identified.get(name, {}), diagnosed.get(name, {})) for name in diagnosed})
    compared = {name: _Compared() for name in sorted({name for one in by_log.values() for name in one})}
    for (first, before), (second, after) in pairwise(zip(map(str, logs), seen, strict=True)):
        for name, one in compared.items():
            error = _incomparable({log: by_log[log].get(name) for log in (first, second)})
            if error is not None:
                one.errors += [error] if error not in one.errors else []
            elif name in before and name in after:
                one.pairs += 1
                rows = _changes(before[name], after[name])
                one.changes += [{"from": first, "to": second, **row} for row in rows]
    document = {
        "schema": SCHEMA,
        "recordings": [str(log) for log in logs],
        "axes": {name: one.entry() for name, one in compared.items()},
        "verdicts": by_log,
        "quantities": dict(zip(map(str, logs), seen, strict=True)),
        "limit_sd": LIMIT,
    }
    if bounds is not None:
        document["limits"] = [{**one.entry(), "recording": log} for _, log, found in judged for one in found]
        write(judged, junit, verdicts)
    none = not any(one.pairs for one in compared.values())
    if json is not None and not (none and fail_on is None):
        write_json(document, json)
    if report is not None and not none:
        from selfcal.show.compare_page import write_page

        write_page(report, document, curves)
    if none:
        told = "; ".join(f"{name}: {', '.join(one.errors)}" for name, one in compared.items())
        raise UserError(f"no axis can be compared ({told})")
    return Comparison(document)


@dataclass
class _Compared:
    """One axis: the `pairs` of recordings that could be compared, their `changes`, and why others could not."""

    pairs: int = 0
    changes: list[dict[str, Any]] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def entry(self) -> list[dict[str, Any]] | dict[str, Any]:
        """As the document has it."""
        return {"error": ", ".join(self.errors), "changes": self.changes} if self.errors else self.changes


def changes_of(axis: Sequence[dict[str, Any]] | Mapping[str, Any]) -> Sequence[dict[str, Any]]:
    """The changes of an axis of the document, whether all recordings could be compared or not."""
    return axis["changes"] if isinstance(axis, Mapping) else axis


def _incomparable(verdicts: Mapping[str, Mapping[str, Any] | None]) -> str | None:
    """Why an axis cannot be compared between two recordings; None where it can be, or neither has it."""
    there = {log: one for log, one in verdicts.items() if one is not None}
    absent = [log for log in verdicts if log not in there]
    if absent and there:
        return f"{absent[0]} does not have it"
    for log, one in there.items():
        if "error" in one:
            return f"{log}: {one['error']}"
    used = list(dict.fromkeys(str(one["unit"]) for one in there.values()))
    return f"the recordings have it in {' and '.join(used)}" if len(used) > 1 else None


def _verdict(identified: Mapping[str, Any], diagnosed: Mapping[str, Any]) -> dict[str, Any]:
    """Verdict and causes of an axis of one recording, or why one of the two has no result."""
    error = diagnosed.get("error", identified.get("error"))
    if error is not None:
        return {"error": error}
    kept = {key: diagnosed[key] for key in ("unit", "verdict", "not_judged", "unfinished") if key in diagnosed}
    return {**kept, "causes": sorted({finding["cause"] for finding in diagnosed["findings"]})}


def _quantities(identified: Mapping[str, Any], diagnosed: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """What can change: parameters of the likeliest law, the bias, the coefficients of the model file's regressors, and
    the size of each cause found."""
    found: dict[str, Mapping[str, Any]] = {}
    if "hypotheses" in identified:
        law = max(identified["hypotheses"], key=lambda name: identified["hypotheses"][name])
        for name, estimate in identified["parameters"][law].items():
            if estimate["identified"]:
                found[f"{name} ({law})" if name != "N" else "N"] = estimate
        bias = identified["bias_now"]
        half = HALF_90 * bias["sd"]
        found["bias"] = {
            "median": bias["mean"],
            "q05": bias["mean"] - half,
            "q95": bias["mean"] + half,
            "unit": bias["unit"],
        }
        for regressor in identified.get("regressors", {}).values():
            for column, estimate in regressor["coefficients"].items():
                if math.isfinite(estimate["median"]):
                    found[f"{column}.coefficient"] = estimate
    counted: dict[str, int] = {}
    for finding in diagnosed.get("findings", []):
        cause = str(finding["cause"])
        counted[cause] = counted.get(cause, 0) + 1
        label = cause if counted[cause] == 1 else f"{cause} {counted[cause]}"
        for key, estimate in finding["estimate"].items():
            if key in SIZES and isinstance(estimate, Mapping):
                found[f"{label}.{key}"] = estimate
        found.setdefault(f"{label}", {"present": True})
    return found


def _changes(before: Mapping[str, Mapping[str, Any]], after: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for key in sorted(before.keys() | after.keys()):
        a, b = before.get(key), after.get(key)
        if a is None or b is None:
            one = a or b
            if one is not None and "present" in one:
                rows.append({"quantity": key, "what": "appeared" if a is None else "gone"})
            continue
        if "present" in a:
            continue
        sd = math.hypot(*((one["q95"] - one["q05"]) / (2.0 * HALF_90) for one in (a, b)))
        distance = (b["median"] - a["median"]) / sd if sd > 0.0 else 0.0
        if abs(distance) >= LIMIT:
            rows.append(
                {
                    "quantity": key,
                    "what": "changed",
                    "before": a["median"],
                    "after": b["median"],
                    "unit": a["unit"],
                    "distance_sd": distance,
                }
            )
    return rows


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """One line a change."""
    console = Console(stderr=to_stderr)
    table = Table(box=box.SIMPLE_HEAD, title="changes beyond what the recordings leave open", title_justify="left")
    for heading in ("axis", "quantity", "before", "after", "unit", "sd apart", "recordings"):
        table.add_column(heading, no_wrap=True)
    for name, axis in document["axes"].items():
        for row in changes_of(axis):
            changed = row["what"] == "changed"
            table.add_row(
                name,
                row["quantity"],
                f"{row['before']:.5g}" if changed else "-" if row["what"] == "appeared" else "found",
                f"{row['after']:.5g}" if changed else "found" if row["what"] == "appeared" else "-",
                row["unit"] if changed else "",
                f"{row['distance_sd']:+.1f}" if changed else "",
                printable(f"{Path(row['from']).name} -> {Path(row['to']).name}"),
            )
    if not console.is_terminal:
        console.width = max(console.width, 140)
    if table.row_count:
        console.print(table)
    errors = {name: axis["error"] for name, axis in document["axes"].items() if isinstance(axis, Mapping)}
    if not any(changes_of(axis) for axis in document["axes"].values()):
        which = [name for name in document["axes"] if name not in errors] if errors else []
        console.print(f"{', '.join(which)}{': ' if which else ''}nothing changed beyond what the recordings leave open")
    for name, error in errors.items():
        console.print(f"{name}: not compared: {printable(error)}", highlight=False, markup=False, soft_wrap=True)
