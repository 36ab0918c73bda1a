"""What changed between recordings of one part, beyond what each leaves open."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from selfcal.base.errors import UserError, called
from selfcal.base.options import argument, option
from selfcal.logs.loaders import READ, Reading
from selfcal.verbs import _shared as shared

if TYPE_CHECKING:
    from selfcal.logs.recording import Recording
    from selfcal.show.results import Comparison


def compare(
    logs: Annotated[
        Sequence[Path | str | Recording], argument(f"Recordings of one part: {READ}", "LOG LOG...", kind=list[Path])
    ],
    *,
    axes: shared.Axes = (),
    model: shared.ModelFile = None,
    decimate: Annotated[
        float | None, option("Diagnose block means at this rate; default: every sample", metavar="HZ")
    ] = None,
    fail_on: Annotated[
        str | None,
        option(
            "Exit code 1 when an axis shows it, 2 when one cannot be judged",
            metavar="changed|inadequate|material|CAUSE",
        ),
    ] = None,
    limits: shared.LimitsFile = None,
    junit: shared.Junit = None,
    verdicts: shared.Verdicts = None,
    gate: shared.Gate = False,
    json: shared.Json = None,
    report: shared.Report = None,
    **reading: Unpack[Reading],
) -> Comparison:
    """Identify and diagnose each of `logs`, and compare each with the one before it.

    Returns the document `selfcal.compare/1`: by axis a list of changes, each with the quantity, its values and the
    distance in standard deviations; the `findings` of each recording as `diagnose` has them, with its `recording`; the
    `verdicts` by recording and axis; and the `quantities` that were compared, by recording, axis and name.
    An axis that two successive recordings do not both have, judged and in the same unit, is {"error": ..., "changes":
    [...]}. `fail_on` is only checked here.
    Raises UserError for fewer than two recordings, where no axis can be compared, and as `identify` and `diagnose` do.
    """
    from selfcal.base.ending import HeldSignals
    from selfcal.base.output import check_writable, write_json, write_text
    from selfcal.batch.compare import LIMIT, SCHEMA, compared_of, quantities, verdict_of
    from selfcal.batch.fail_on import CHANGED, check_cause
    from selfcal.batch.verdicts import Judged, Limits, Verdict, add_verdicts, check_options, write_verdicts
    from selfcal.logs.recording import list_of
    from selfcal.model.file import Model
    from selfcal.show.results import Comparison
    from selfcal.verbs.diagnose import diagnose
    from selfcal.verbs.identify import identify

    if len(logs) < 2:
        raise UserError(f"compare takes two recordings or more of one part: {called()} compare A B")
    check_cause(fail_on, more=(CHANGED,))
    check_options(limits, junit, verdicts)
    files = [file for log in logs for file in list_of(log)]
    check_writable(json, report, junit, verdicts, inputs=(*files, model, limits))
    bounds = None if limits is None else Limits.load(limits, Model.load(model))
    seen = []
    findings: list[dict[str, Any]] = []
    judged: list[Judged] = []
    by_log: dict[str, dict[str, Any]] = {}
    curves: dict[str, dict[str, Any]] = {}
    part: dict[str, Any] = {"axes": axes, "model": model, "gate": gate, **reading}
    names = [
        str(log if isinstance(log, Path | str) else getattr(log, "path", f"arrays {number}"))
        for number, log in enumerate(logs, 1)
    ]
    for log, path in zip(logs, names, strict=True):
        known = identify(log, suspicion=False, **part)
        identified = known["axes"]
        if bounds is not None:
            add_verdicts(known, bounds, None, None)
            judged.append(("", path, [Verdict.of(entry) for entry in known["limits"]]))
        diagnosis = diagnose(log, decimate=decimate, full_rate=decimate is None, **part)
        diagnosed = diagnosis["axes"]
        findings += [{**finding, "recording": path} for finding in diagnosis.get("findings", ())]
        HeldSignals().check()
        by_log[path] = {
            name: verdict_of(identified.get(name, {}), diagnosed.get(name, {})) for name in identified | diagnosed
        }
        for name, axis in identified.items():
            if axis.get("allan"):
                curves.setdefault(name, {})[path] = axis["allan"]
        seen.append({name: quantities(identified.get(name, {}), diagnosed.get(name, {})) for name in diagnosed})
    compared = compared_of(list(zip(names, seen, strict=True)), by_log)
    document = {
        "schema": SCHEMA,
        "recordings": names,
        "findings": findings,
        "axes": {name: axis.entry() for name, axis in compared.items()},
        "verdicts": by_log,
        "quantities": dict(zip(names, seen, strict=True)),
        "limit_sd": LIMIT,
    }
    if bounds is not None:
        document["limits"] = [
            {**judgement.entry(), "recording": log} for _, log, of_log in judged for judgement in of_log
        ]
        write_verdicts(judged, junit, verdicts)
    none = not any(axis.pairs for axis in compared.values())
    if json is not None and not (none and fail_on is None):
        write_json(document, json)
    if report is not None and not none:
        from selfcal.show.comparison_page import comparison_html

        write_text(report, comparison_html(document, curves))
    if none:
        reasons = "; ".join(f"{name}: {', '.join(axis.errors)}" for name, axis in compared.items())
        raise UserError(f"no axis can be compared ({reasons})")
    return Comparison(document)


show = shared.shown_by("batch.compare", judged=True)
