"""Limits of a data sheet: does a unit keep them, by the bounds of its intervals? And the files of a production line.

A limits file has an entry for each quantity, `AXIS.PARAMETER` or `GROUP.PARAMETER`:

    gx.N: {max: 0.014 deg/s/sqrt(Hz)}
    accel.bias: {min: -50 mg, max: 50 mg}

A unit passes a maximum if the upper 95 % bound of the quantity is within it. It fails if the lower 95 % bound is
beyond. Between the two the record is too short for a verdict. A unit that could not be judged has not passed.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Any

from selfcal.adequacy.summary import MOST_TIMES
from selfcal.bank.axis_result import HALF_90, bias_of, likeliest
from selfcal.bank.subsets import LIKELY
from selfcal.base import units
from selfcal.base.errors import UserError, printable, short_value
from selfcal.base.grid import bisected
from selfcal.base.output import check_writable, whole
from selfcal.base.units import duration_words
from selfcal.logs.recording import list_of
from selfcal.model.file import Model, read_yaml
from selfcal.model.laws import PLACES, RATIOS

SCHEMA = "selfcal.limits/1"
PASS, FAIL, OPEN, UNJUDGED = "pass", "fail", "cannot tell yet", "cannot be judged"
#: Probability of a verdict after the rest that is asked for.
CHANCE = 0.8


@dataclass(frozen=True)
class Limit:
    """A bound of a quantity of an axis: `side` is 'max' or 'min', `value` in `unit`."""

    axis: str
    parameter: str
    side: str
    value: float
    unit: str

    @property
    def key(self) -> tuple[str, str, str]:
        """What it bounds, and the side."""
        return self.axis, self.parameter, self.side

    @property
    def name(self) -> str:
        """As a report has it."""
        return f"{self.axis}.{self.parameter} {'<=' if self.side == 'max' else '>='} {self.value:g} {self.unit}"


@dataclass(frozen=True)
class Verdict:
    """How an axis keeps a limit: estimate in the limit's unit, and the rest that an open verdict takes, s."""

    limit: Limit
    verdict: str
    reason: str = ""
    median: float = math.nan
    q05: float = math.nan
    q95: float = math.nan
    more_s: float | None = None

    @property
    def words(self) -> str:
        """Verdict with its reason."""
        reason = self.reason and f"{', ' if self.verdict == OPEN else ': '}{self.reason}"
        return f"{self.limit.name}: {self.verdict}{reason}"

    def entry(self) -> dict[str, Any]:
        """As JSON has it."""
        entry = asdict(self)
        return {**entry.pop("limit"), **entry}

    @staticmethod
    def of(entry: Mapping[str, Any]) -> Verdict:
        """The verdict of a document's entry; null is not a number."""
        fields: dict[str, Any] = {
            key: math.nan if value is None and key != "more_s" else value for key, value in entry.items()
        }
        limit = Limit(*[fields.pop(key) for key in ("axis", "parameter", "side", "value", "unit")])
        return Verdict(limit, **fields)


@dataclass(frozen=True)
class Limits:
    """The limits of a file. `of_group`: those stated for a group, which only hold for axes that are there."""

    stated: tuple[Limit, ...]
    of_group: tuple[Limit, ...]

    def of(self, axes: Collection[str]) -> list[Limit]:
        """The limits of a batch whose recordings have these axes. An axis' own limit replaces its group's."""
        group = [limit for limit in self.of_group if limit.axis in axes]
        by_key = {limit.key: limit for limit in (*group, *self.stated)}
        return [by_key[key] for key in sorted(by_key)]

    @staticmethod
    def load(path: Path | str, model: Model) -> Limits:
        """Read and check a limits file. Raises UserError naming the file and the entry."""
        file = Path(path)
        tree = read_yaml(file, "limits file (a YAML mapping of gx.N: {max: 0.01 deg/s/sqrt(Hz)})")
        if tree.pop("schema", SCHEMA) != SCHEMA:
            raise UserError(f"{file}: schema: must be {SCHEMA}")
        stated: list[Limit] = []
        of_group: list[Limit] = []
        groups = {group.name: group for group in model.groups}
        for key, entry in tree.items():
            name, _, parameter = str(key).partition(".")
            if name not in groups and name not in model.axes:
                known = ", ".join((*groups, *model.axes))
                raise UserError(f"{file}: {short_value(key)}: begins with no group or axis of the model ({known})")
            group = groups[name] if name in groups else model.group_of(name)
            if parameter not in ("bias", *PLACES):
                raise UserError(f"{file}: {short_value(key)}: ends with none of bias, {', '.join(PLACES)}")
            if not isinstance(entry, dict) or not entry or not set(entry) <= {"min", "max"}:
                raise UserError(f"{file}: {short_value(key)}: takes {{max: VALUE UNIT}}, {{min: VALUE UNIT}} or both")
            unit = units.parameter_unit(parameter, group.unit)
            for side, text in entry.items():
                value, of = _quantity(f"{file}: {key}.{side}", text, unit)
                for axis in group.axes if name in groups else (name,):
                    (of_group if name in groups else stated).append(Limit(axis, parameter, side, value, of))
        if not stated and not of_group:
            raise UserError(f"{file}: no limit is in it: write one as gx.N: {{max: 0.01 deg/s/sqrt(Hz)}}")
        limits = Limits(tuple(stated), tuple(of_group))
        by_side = {limit.key: limit for limit in limits.of(model.axes)}
        for (axis, parameter, side), low in by_side.items():
            high = by_side.get((axis, parameter, "max"))
            if side == "min" and high is not None and low.value * units.factor(low.unit, high.unit) > high.value:
                raise UserError(
                    f"{file}: {axis}.{parameter}: min {low.value:g} {low.unit} is above max {high.value:g} {high.unit}"
                )
        return limits


def _quantity(where: str, text: Any, like: str) -> tuple[float, str]:
    """Value and unit of a text such as `0.014 deg/s/sqrt(Hz)`, of the kind of `like`."""
    wanted = f"takes a number and a unit as {like}, not {short_value(text)}"
    try:
        value, unit = units.quantity(str(text))
        unit = unit or ("1" if like == "1" else "")
        alike = units.known(unit) and unit != units.LSB and units.same_kind(unit, like)
    except ValueError as error:
        raise UserError(f"{where}: {wanted}") from error
    if not math.isfinite(value) or not alike:
        raise UserError(f"{where}: {wanted}")
    return value, unit


def judge_limits(limits: Iterable[Limit], axes: Mapping[str, Any], duration_s: float) -> list[Verdict]:
    """The verdicts of a recording of `duration_s`; `axes`: those of the document of `identify`, or with a `posterior`
    those of `diagnose`."""
    return [_judged(limit, axes.get(limit.axis), duration_s) for limit in limits]


def unjudged(limits: Iterable[Limit], reason: str) -> list[Verdict]:
    """The verdicts of a recording without a result."""
    return [Verdict(limit, UNJUDGED, reason) for limit in limits]


def _judged(limit: Limit, axis: Mapping[str, Any] | None, duration_s: float) -> Verdict:
    if axis is None:
        return Verdict(limit, UNJUDGED, "the recording does not have the axis")
    if "error" in axis:
        return Verdict(limit, UNJUDGED, axis["error"])
    posterior = axis if "hypotheses" in axis else axis.get("posterior")
    if posterior is None:
        return Verdict(limit, UNJUDGED, "there is no posterior")
    estimate = _estimate(limit.parameter, posterior)
    if isinstance(estimate, str):
        return Verdict(limit, UNJUDGED, estimate)
    factor = 1.0 if limit.parameter in RATIOS else units.factor(estimate["unit"], limit.unit)
    median, q05, q95 = (estimate[key] * factor for key in ("median", "q05", "q95"))
    if estimate["off_grid"] or not all(map(math.isfinite, (median, q05, q95))):
        return Verdict(limit, UNJUDGED, "the model's grid does not support the estimate: more nodes", median, q05, q95)
    above = limit.side == "max"
    if q95 <= limit.value if above else q05 >= limit.value:
        return Verdict(limit, PASS, "", median, q05, q95)
    if estimate["identified"] and (q05 > limit.value if above else q95 < limit.value):
        reason = f"the {'lower' if above else 'upper'} 95 % bound is {q05 if above else q95:.3g}"
        return Verdict(limit, FAIL, reason, median, q05, q95)
    more_s = _rest_s(limit, estimate, (median, q05, q95), duration_s)
    reason = "a longer rest does not tell" if more_s is None else f"rest {duration_words(more_s)} more"
    return Verdict(limit, OPEN, reason, median, q05, q95, more_s)


def _estimate(parameter: str, axis: Mapping[str, Any]) -> dict[str, Any] | str:
    """The posterior of a quantity, or why the axis has none. A constant drift bounds what it lacks from above."""
    probability = axis["hypotheses"]
    best = likeliest(probability)
    constant = set(axis["parameters"][best]) <= {"N"}
    if parameter == "bias":
        if "bias_now" not in axis:
            return "diagnose states no bias: identify --limits does"
        return {**bias_of(axis), "identified": True, "off_grid": False, "sharpens": constant}
    having = [law for law in probability if parameter in axis["parameters"][law]]
    if not having:
        return f"no law of the model has {parameter}"
    law = best if best in having else max(having, key=lambda law: probability[law])
    if law != best and not constant and probability[law] < LIKELY:
        there = ", ".join(name for name in axis["parameters"][best] if name != "N")
        return f"its drift is {best}, which has no {parameter}: limit {there}"
    return {**axis["parameters"][law][parameter], "sharpens": True}


def _rest_s(
    limit: Limit, estimate: Mapping[str, Any], interval: tuple[float, float, float], duration_s: float
) -> float | None:
    """Rest beyond `duration_s` after which the verdict is there with the probability CHANCE, s; None: none does that.

    The posterior's variance falls as the inverse of the length, in the logarithm of all but a bias. Its median then
    moves by what the variance loses.
    """
    median, q05, q95 = interval
    if not estimate["sharpens"]:
        return None
    if not estimate["identified"]:
        # Power of the length by which the upper bound of an unidentified quantity falls.
        power = {"K": 1.0, "sigma_m": 0.5, "B": 0.5}.get(limit.parameter)
        if power is None or limit.side == "min":
            return None
        return duration_s * (max(q95 / limit.value, 1.0) ** (1.0 / power) - 1.0) if limit.value > 0.0 else None
    if limit.parameter != "bias":
        if not limit.value > 0.0 or not q05 > 0.0:
            return None
        middle, sd = math.log(limit.value / median), math.log(q95 / q05) / (2.0 * HALF_90)
    else:
        middle, sd = limit.value - median, (q95 - q05) / (2.0 * HALF_90)
    if not sd > 0.0:
        return None

    def chance(times: float) -> float:
        """Probability of a verdict at `times` the length."""
        left, moves = sd / math.sqrt(times), sd * math.sqrt(1.0 - 1.0 / times)
        return sum(NormalDist().cdf((side * abs(middle) - HALF_90 * left) / moves) for side in (1.0, -1.0))

    if chance(MOST_TIMES) < CHANCE:
        return None
    return duration_s * math.expm1(bisected(lambda ln: chance(math.exp(ln)) >= CHANCE, 0.0, math.log(MOST_TIMES))[1])


def worst(codes: Iterable[int]) -> int:
    """The exit code of several: 1 goes before 2, and 2 before 0."""
    return min(filter(None, codes), default=0)


def code_of(verdicts: Iterable[Verdict]) -> int:
    """Exit code: 0 all pass, 1 a limit fails, 2 a limit is open or not judged."""
    there = {verdict.verdict for verdict in verdicts}
    return 1 if FAIL in there else 2 if there & {OPEN, UNJUDGED} else 0


#: A recording's verdicts: the device, the recording, and they.
Judged = tuple[str, str, Sequence[Verdict]]
_COLUMNS = (
    *("device", "recording", "axis", "parameter", "side", "value", "unit", "verdict", "reason", "median", "q05", "q95"),
    "more_s",
)


def write_junit(path: Path | str, judged: Sequence[Judged]) -> None:
    """Write JUnit's XML: a suite for each recording, a case for each limit.

    A case without a verdict is an error, not skipped: a line must not take it for passed.
    """
    whole_batch = _counts([verdict for _, _, verdicts in judged for verdict in verdicts])
    del whole_batch["skipped"]  # the schema has it of a suite alone
    suites = ElementTree.Element("testsuites", {"name": "selfcal limits", **whole_batch})
    for device, recording, verdicts in judged:
        suite = ElementTree.SubElement(
            suites, "testsuite", {"name": printable(device), **_counts(verdicts), "time": "0"}
        )
        properties = ElementTree.SubElement(suite, "properties")
        ElementTree.SubElement(properties, "property", {"name": "recording", "value": printable(recording)})
        for verdict in verdicts:
            head = {"classname": printable(device), "name": printable(verdict.limit.name), "time": "0"}
            case = ElementTree.SubElement(suite, "testcase", head)
            if verdict.verdict != PASS:
                kind = {"message": printable(verdict.words), "type": verdict.verdict}
                ElementTree.SubElement(case, "failure" if verdict.verdict == FAIL else "error", kind)
    ElementTree.indent(suites)
    with whole(path) as temporary:
        ElementTree.ElementTree(suites).write(temporary, encoding="utf-8", xml_declaration=True)


def _counts(verdicts: Sequence[Verdict]) -> dict[str, str]:
    failures = sum(verdict.verdict == FAIL for verdict in verdicts)
    errors = sum(verdict.verdict in (OPEN, UNJUDGED) for verdict in verdicts)
    return {"tests": str(len(verdicts)), "failures": str(failures), "errors": str(errors), "skipped": "0"}


def write_unjudged(given: Mapping[str, Any], reason: str) -> None:
    """Write the JUnit and CSV of a verb that was `given` these options and has no result. Raises UserError for a limits
    file that cannot be read."""
    logs = list_of(given["log"])
    files = given.get("junit"), given.get("verdicts")
    check_writable(*files, inputs=(*logs, given["limits"], given.get("model")))
    model = Model.load(given.get("model"))
    limits = Limits.load(given["limits"], model).of(given.get("axes") or model.axes)
    write_verdicts([("", " ".join(map(str, logs)), unjudged(limits, reason))], *files)


def check_options(limits: Path | str | None, junit: Path | str | None, verdicts: Path | str | None) -> None:
    """Raise UserError for output files without limits."""
    if limits is None and not (junit is None and verdicts is None):
        raise UserError("--junit and --verdicts are of the limits' verdicts: give --limits LIMITS.yaml too")


def write_verdicts(judged: Sequence[Judged], junit: Path | str | None, verdicts: Path | str | None) -> None:
    """Write the files that are asked for: JUnit, and a CSV of a row for each limit of each recording. A recording
    without a device has its file's name."""
    from selfcal.batch.batch_files import stem
    from selfcal.batch.unit_table import write_csv

    named = [(device or stem(recording), recording, of_unit) for device, recording, of_unit in judged]
    if junit is not None:
        write_junit(junit, named)
    if verdicts is not None:
        rows = (
            {"device": device, "recording": recording, **verdict.entry()}
            for device, recording, of_unit in named
            for verdict in of_unit
        )
        write_csv(verdicts, _COLUMNS, rows)


def add_verdicts(
    document: dict[str, Any], limits: Limits | None, junit: Path | str | None, verdicts: Path | str | None
) -> None:
    """Judge a document of `identify` or `diagnose` by limits, if there are any: its key `limits`, and the files."""
    if limits is None:
        return
    axes, recording = document["axes"], document["recording"]
    judged = judge_limits(limits.of(axes), axes, recording["duration_s"])
    document["limits"] = [verdict.entry() for verdict in judged]
    write_verdicts([(recording.get("serial", ""), recording["path"], judged)], junit, verdicts)
