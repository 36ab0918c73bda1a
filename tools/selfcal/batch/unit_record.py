"""A recording of a batch: what `identify` and `diagnose` find, kept by the recording's content."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from selfcal.base.errors import MOST_NAMED, UserError, first_line
from selfcal.batch.spread import Job, Kept, Row, spread
from selfcal.batch.unit_table import BatchUnit
from selfcal.readings.faults import FAULTS

#: Keys kept of an axis of `identify`, and of an axis of `diagnose`.
IDENTIFIED = ("hypotheses", "log_evidence", "parameters", "regressors", "bias_now", "adequate", "error")
DIAGNOSED = ("verdict", "causes", "material", "not_judged", "unfinished", "error")
#: Checks of the readings, and of the innovations.
READINGS = tuple(fault.name for fault in FAULTS)
INNOVATIONS = ("innovation_lag1", "innovation_excess_kurtosis", "innovation_ln_variance_ratio_of_halves")
#: Characters that the name of a device's page lacks.
_UNSAFE = re.compile(r"[^A-Za-z0-9._-]")
#: Error of a recording whose workers die.
KILLED = "its worker process was killed each time, maybe for want of memory"


class Verbs(NamedTuple):
    """The functions `identify` and `diagnose`: verbs know the batch, which knows no verb."""

    identify: Callable[..., Mapping[str, Any]]
    diagnose: Callable[..., Mapping[str, Any]]


@dataclass(frozen=True)
class Options:
    """How each recording is looked at. `reading`: keywords of `identify` and `diagnose` alike."""

    model: str | None = None
    axes: tuple[str, ...] = ()
    diagnose: bool = False
    reading: Mapping[str, Any] = field(default_factory=dict)

    @property
    def given(self) -> dict[str, Any]:
        """Keywords of both."""
        return {"axes": self.axes, "model": self.model, **self.reading}


def examined(verbs: Verbs, options: Options, job: Job) -> list[Row]:
    """A row: the record, or {"error": reason}. `job`: absolute path, content. A broken file never raises."""
    path = str(job[0])
    with contextlib.redirect_stderr(io.StringIO()):
        try:
            return [_record(verbs, options, path)]
        except UserError as error:
            return [{"error": str(error).removeprefix(f"{path}: ")}]
        except MemoryError:
            return [{"error": "too large for this machine's memory"}]
        except Exception as error:  # a file that finds a fault of ours is a row like any other
            return [{"error": f"{type(error).__name__}: {first_line(error)}"}]


def _record(verbs: Verbs, options: Options, path: str) -> Row:
    document = verbs.identify(path, suspicion=False, **options.given)
    row: Row = {
        "recording": document["recording"],
        "axes": {name: _of(axis, IDENTIFIED) | _looks(axis) for name, axis in document["axes"].items()},
    }
    if options.diagnose:
        try:
            axes = verbs.diagnose(path, **options.given)["axes"]
        except UserError as error:
            axes = {name: {"error": str(error).removeprefix(f"{path}: ")} for name in document["axes"]}
        row["diagnosis"] = {name: _of(axis, DIAGNOSED) for name, axis in axes.items()}
    return row


def own_pages(
    folder: Path | str,
    names: Sequence[str],
    devices: Mapping[str, Sequence[BatchUnit]],
    verbs: Verbs,
    options: Options,
    kept: Kept,
    count: int | None,
) -> dict[str, str]:
    """Write the page of `diagnose` of the last recording of each device, MOST_NAMED at most, into `folder`.

    A page that is there of the same recording and options is not made anew. Returns where each is from the folder
    above."""
    pages = Path(folder)
    pages.mkdir(exist_ok=True)
    jobs = {}
    for name in [name for name in dict.fromkeys(names) if name in devices][:MOST_NAMED]:
        source = devices[name][-1].source
        digest = kept.place((source.path, source.content)).stem[:12]
        jobs[name] = (str(Path(source.path).absolute()), str(pages / f"{_UNSAFE.sub('_', name)[:60]}-{digest}.html"))
    missing = [job for job in jobs.values() if not Path(job[1]).exists()]
    spread(partial(_paged, verbs, options), missing, count=count, lost=lambda _: [{}], verb="pages")
    return {name: f"{pages.name}/{Path(job[1]).name}" for name, job in jobs.items() if Path(job[1]).exists()}


def _paged(verbs: Verbs, options: Options, job: Job) -> list[Row]:
    """Write the page of a recording. `job`: its absolute path, the page's place."""
    with contextlib.redirect_stderr(io.StringIO()), contextlib.suppress(UserError, MemoryError):
        verbs.diagnose(job[0], report=job[1], **options.given)
    return [{}]


def _of(axis: Mapping[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    return {key: axis[key] for key in keys if key in axis}


def _looks(axis: Mapping[str, Any]) -> dict[str, Any]:
    """What the readings and the innovations show at once: `marks`, and the `lattice` of the readings, if any. Chance
    gives a sound axis no mark."""
    if "error" in axis:
        return {}
    checks = axis["checks"]
    failed = {name: check for name, check in checks.items() if not check["passed"]}
    marks = [name for name in failed if name in READINGS]
    marks += [
        name
        for name, check in failed.items()
        if name in INNOVATIONS and abs(float(check["value"])) > 2.0 * float(check["limit"])
    ]
    lattice = checks.get("lattice", {})
    stated = {"lattice": lattice["step"]} if lattice.get("distinct", 0) >= 8 else {}
    return {"marks": list(dict.fromkeys(marks)), **stated}


def record_settings(options: Options, model: str, version: str) -> dict[str, Any]:
    """All that decides a record apart from its recording; `model`: its content."""
    kept = [*IDENTIFIED, *DIAGNOSED]
    return {"schema": "selfcal.fleet/1", "kept": kept, **asdict(options), "model": model, "version": version}
