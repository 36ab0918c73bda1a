"""`selfcal compare`: what changed between recordings of a part, beyond what each leaves open."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

from rich.markup import escape

from selfcal.bank.axis_result import bias_of, likeliest, sd_of
from selfcal.base.errors import printable
from selfcal.base.output import console_of, print_line, table_of
from selfcal.batch.population import sd_off
from selfcal.diagnosis import words
from selfcal.diagnosis.events import parted
from selfcal.readings.budget import FALSE_ALARM

SCHEMA = "selfcal.compare/1"
#: Least difference that counts, in standard deviations: chance exceeds it in FALSE_ALARM of the quantities.
LIMIT = sd_off(math.log(FALSE_ALARM))
#: Estimates that are sizes of a cause, its main size first; places in time belong to a single recording.
SIZES = ("coefficient", "slope", "amplitude", "frequency_hz", "B", "lag1", "ratio", "lsb", "limit")


@dataclass
class Compared:
    """An axis: the `pairs` of recordings that could be compared, their `changes`, and why others could not."""

    pairs: int = 0
    changes: list[dict[str, Any]] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def entry(self) -> list[dict[str, Any]] | dict[str, Any]:
        """As the document has it."""
        return {"error": ", ".join(self.errors), "changes": self.changes} if self.errors else self.changes


def incomparable(verdicts: Mapping[str, Mapping[str, Any] | None]) -> str | None:
    """Why an axis cannot be compared between two recordings; None where it can be, or neither has it."""
    there = {log: verdict for log, verdict in verdicts.items() if verdict is not None}
    absent = [log for log in verdicts if log not in there]
    if absent and there:
        return f"{absent[0]} does not have it"
    for log, axis in there.items():
        if "error" in axis:
            return f"{log}: {axis['error']}"
    used = list(dict.fromkeys(str(axis["unit"]) for axis in there.values()))
    return f"the recordings have it in {' and '.join(used)}" if len(used) > 1 else None


def verdict_of(identified: Mapping[str, Any], diagnosed: Mapping[str, Any]) -> dict[str, Any]:
    """Verdict and causes of an axis of a recording, or why either has no result."""
    error = diagnosed.get("error", identified.get("error"))
    if error is not None:
        return {"error": error}
    kept = ("unit", "verdict", "causes", "material", "not_judged", "unfinished")
    return {key: diagnosed[key] for key in kept if key in diagnosed}


def quantities(identified: Mapping[str, Any], diagnosed: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Quantities that can change: N, K and B with all findings in the model, the other parameters of the likeliest law,
    the bias, the coefficients of the model file's regressors, and each cause found with its sizes. A cause is `small`
    where it changes no number by as much as matters. Without a model of the findings, parameters are of `identify`."""
    sizes: dict[str, Mapping[str, Any]] = {}
    known = diagnosed.get("posterior") or identified
    if "hypotheses" in known:
        law = likeliest(known["hypotheses"])
        numbers = {
            name: {**number["after"], "unit": number["unit"]}
            for name, number in diagnosed.get("numbers", {}).items()
            if "q05" in number["after"]
        }
        for name, estimate in known["parameters"][law].items():
            if name not in numbers and estimate["identified"]:
                sizes[f"{name} ({law})" if name != "N" else "N"] = estimate
        sizes |= numbers
        stated = identified.get("regressors", {})  # a column of a finding has its size with that
        for regressor in ({**stated, **known.get("regressors", {})}[name] for name in stated):
            for column, estimate in regressor["coefficients"].items():
                if math.isfinite(estimate["median"]):
                    sizes[f"{column}.coefficient"] = estimate
    if "bias_now" in identified:
        sizes["bias"] = bias_of(identified)
    counted: dict[str, int] = {}
    matter = (*diagnosed.get("material", ()), "unexplained")
    own = [finding["cause"] for finding in diagnosed.get("findings", [])]
    for cause in diagnosed.get("causes", ()):
        if cause not in own:  # of several axes
            sizes[cause] = {"present": True, "small": cause not in matter}
    for finding in diagnosed.get("findings", []):
        cause = str(finding["cause"])
        counted[cause] = counted.get(cause, 0) + 1
        label = cause if counted[cause] == 1 else f"{cause} {counted[cause]}"
        own_sizes = {key: size for key in SIZES if isinstance(size := finding["estimate"].get(key), Mapping)}
        first: Mapping[str, Any] = next(iter(own_sizes.values()), {})
        size = {part: first[part] for part in ("median", "unit") if part in first}
        sizes[label] = {"present": True, "small": cause not in matter, **size}
        sizes |= {f"{label}.{key}": estimate for key, estimate in own_sizes.items()}
    return sizes


def changes(before: Mapping[str, Mapping[str, Any]], after: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Findings of a single recording that matter there, and changes beyond the limit, a row each. A number that either
    recording does not identify counts by its interval, and the row has its upper limit."""
    rows: list[dict[str, Any]] = []
    for key in sorted(before.keys() | after.keys()):
        a, b = before.get(key), after.get(key)
        if a is None or b is None:
            only = a or b
            if only is not None and "present" in only and not only["small"]:
                side = "after" if a is None else "before"
                size = {side: only["median"], "unit": only["unit"]} if "median" in only else {}
                rows.append({"quantity": key, "what": "appeared" if a is None else "gone", **size})
            continue
        known = all("present" not in size and "q95" in size for size in (a, b))  # some sizes have no interval
        if not (known and (a.get("identified", True) or b.get("identified", True))):
            continue
        sd = math.hypot(sd_of(a), sd_of(b))
        distance = (b["median"] - a["median"]) / sd if sd > 0.0 else 0.0
        if abs(distance) >= LIMIT:
            row = {"before": a["median"], "after": b["median"], "unit": a["unit"], "distance_sd": distance}
            below = {
                f"{side}_below": estimate["q95"]
                for side, estimate in (("before", a), ("after", b))
                if not estimate.get("identified", True)
            }
            rows.append({"quantity": key, "what": "changed", **row, **below})
    return rows


def compared_of(
    seen: Sequence[tuple[str, Mapping[str, Mapping[str, Any]]]], verdicts: Mapping[str, Mapping[str, Any]]
) -> dict[str, Compared]:
    """Each recording compared with the recording before, by axis. `seen`: the recordings with the quantities of each
    axis; `verdicts`: by recording and axis."""
    compared = {name: Compared() for axes in verdicts.values() for name in axes}
    for (first, before), (second, after) in pairwise(seen):
        for name, axis in compared.items():
            error = incomparable({log: verdicts[log].get(name) for log in (first, second)})
            if error is not None:
                axis.errors += [error] if error not in axis.errors else []
            elif name in before and name in after:
                axis.pairs += 1
                rows = changes(before[name], after[name])
                axis.changes += [{"from": first, "to": second, **row} for row in rows]
    return compared


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """Print for each pair of recordings a line a change, the largest first, then the findings of each recording that
    matter, as `diagnose` words them."""
    from selfcal.show.comparison_page import short_names, told_of

    console, names = console_of(to_stderr=to_stderr), short_names(document)
    say = partial(print_line, console)
    errors = {name: axis["error"] for name, axis in document["axes"].items() if isinstance(axis, Mapping)}
    which = ", ".join(name for name in document["axes"] if name not in errors) + ": " if errors else ""
    for (first, second), rows in told_of(document).items():
        pair = f"{names[first]} -> {names[second]}"
        if not rows:
            say(f"{pair}: {which}nothing changed beyond what the recordings leave open")
            continue
        headings = ("axes", "quantity", "before", "after", "unit", "sd apart")
        table = table_of(headings, escape(printable(f"{pair}: changes")))
        for row in rows:
            distance = f"{row.change['distance_sd']:+.1f}" if "distance_sd" in row.change else ""
            sides = (row.side(name, "-") for name in ("before", "after"))
            table.add_row(row.axes, words.quantity(row.change["quantity"]), *sides, row.unit, distance)
        console.print(table)
    for log, name in names.items():
        shown, _ = parted([finding for finding in document["findings"] if finding["recording"] == log])
        say(f"{name}: {'; '.join(map(words.what, shown)) or 'no finding that matters'}")
    for name, error in errors.items():
        say(f"{name}: not compared: {error}")
