"""The table of `identify` and `replay`: what a person reads of the document `selfcal.identify/1`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from selfcal.adequacy.identify_document import as_typed
from selfcal.adequacy.summary import MOST_TIMES, noisier
from selfcal.bank.axis_result import LAW_LEAST, likeliest
from selfcal.bank.priors import OF_RECORD
from selfcal.base import units
from selfcal.base.errors import called, few, printable
from selfcal.base.output import TABLE_WIDTH, console_of, print_line, table_of
from selfcal.base.units import duration_words
from selfcal.model.laws import RATIOS
from selfcal.readings.changed_words import MISREAD
from selfcal.readings.moves import motion_events

Reason = TypeVar("Reason", str, tuple[str, str])
#: A check, its axes, and their outcomes.
_Event = tuple[str, list[str], list[Mapping[str, Any]]]

#: Prefixes of checks that state no cause.
STATISTICS = ("innovation_", "allan_")


def show(
    document: Mapping[str, Any], *, to_stderr: bool = False, datasheet: bool = False, console: Console | None = None
) -> None:
    """The tables a person reads: per axis the numbers of a data sheet; then the laws, their probabilities and
    parameters, and the bias.

    They go to stderr where stdout is the JSON's, or to a `console`. `datasheet`: the laws' numbers in the units of data
    sheets. In a terminal that is too narrow columns lose their intervals: those of the data sheets' units, then the
    recording's; of the laws that of 1/alpha, then N's, then K's.
    """
    console = console or console_of(to_stderr=to_stderr, fits=True)
    axes = {name: axis for name, axis in document["axes"].items() if "error" not in axis}
    numbered = {name: axis for name, axis in axes.items() if axis.get("summary")}
    summary = fitting(console, [_summary_table(numbered, left_out) for left_out in range(3)])
    laws = fitting(console, [_law_table(axes, left_out, datasheet) for left_out in range(4)])
    first = summary if numbered else laws
    first.title = escape(recording_heading(document["recording"]))
    if numbered:
        console.print(summary)
    console.print(laws)
    if any("regressors" in axis for axis in axes.values()):
        console.print(_regressor_table(axes))
    for line in _notes(document, axes):
        print_line(console, line)


def recording_heading(recording: Mapping[str, Any]) -> str:
    """A recording's name and extent, and where a stretch of it begins."""
    start = f" from {recording['start_s']:g} s on" if recording.get("start_s") else ""
    extent = f"{recording['samples']} samples, {recording['rate_hz']:g} Hz, {recording['duration_s']:g} s"
    return f"{printable(recording['path'])}: {extent}{start}"


def fitting(console: Console, tables: Sequence[Table]) -> Table:
    """The first of `tables` that the terminal is wide enough for, else the last; without a terminal the first."""
    if not console.is_terminal:
        return tables[0]
    wide = console.options.update(width=10 * TABLE_WIDTH)
    fitting = (table for table in tables if console.measure(table, options=wide).maximum <= console.width)
    return next(fitting, tables[-1])


#: Units of axes that have data sheets.
_SHEETS = ("rad/s", "m/s^2")
#: Names of the numbers of summary.py, of the axes with data sheets, and of anything else.
_NUMBERS = {
    "arw": ("ARW", "VRW", "white noise"),
    "rrw": ("RRW", "RRW", "random walk"),
    "bias_instability": ("bias instability",) * 3,
    "quantization_noise": ("quantization noise",) * 3,
}


def _summary_table(axes: Mapping[str, Any], left_out: int) -> Table:
    """The numbers of a data sheet; without the intervals of the last `left_out` columns."""
    headings = ("axis", "", "in the recording's units", "as in data sheets")
    table = table_of(headings, pad_edge=left_out == 0, collapse_padding=left_out > 0)
    for name, axis in axes.items():
        unit = axis["bias_now"]["unit"]
        kind = next((k for k, of in enumerate(_SHEETS) if units.same_kind(unit, of)), len(_SHEETS))
        for key, number in axis["summary"].items():
            table.add_row(
                name if key == "arw" else "",
                _NUMBERS[key][kind],
                _number(number, number, brief=left_out > 1),
                _number(number["datasheet"], number, brief=left_out > 0) if kind < len(_SHEETS) else "-",
                end_section=key == list(axis["summary"])[-1],
            )
    return table


def _number(spread: Mapping[str, Any], number: Mapping[str, Any], *, brief: bool) -> str:
    """Median and interval, or the upper limit of a number that is not identified."""
    unit = units.typeset(spread["unit"])
    if not number["identified"]:
        return f"< {spread['q95']:.3g} {unit}, not identified"
    interval = "" if brief else f" \\[{spread['q05']:.3g}, {spread['q95']:.3g}]"
    return f"{spread['median']:.3g}{interval} {unit}"


def _by_reason(axes: Iterable[tuple[Reason, str]]) -> dict[Reason, str]:
    """Names of the axes of each reason. `axes`: each reason with the name of its axis."""
    names_of: dict[Reason, list[str]] = {}
    for reason, name in axes:
        names_of.setdefault(reason, []).append(name)
    return {reason: ", ".join(names) for reason, names in names_of.items()}


def _unidentified(axes: Mapping[str, Any]) -> list[str]:
    """Why numbers of the summary are not identified, a line a reason."""
    by_reason = _by_reason(
        ((_NUMBERS[key][0], number["reason"]), name)
        for name, axis in axes.items()
        for key, number in (axis.get("summary") or {}).items()
        if not number["identified"]
    )
    lines = [f"{what} not identified: {names}: {reason}" for (what, reason), names in by_reason.items()]
    for name, axis in axes.items():
        for parameter, rest_s in axis.get("halved_after_s", {}).items():
            times = f"not even {MOST_TIMES:g} times this rest halves"
            how = times if rest_s is None else f"another {duration_words(rest_s)} would about halve"
            lines.append(f"{name}: {how} the interval of {parameter}")
    return lines


def _why(check: str, outcome: Mapping[str, Any], unit: str, nats: str) -> str:
    """What a failed check of an axis in `unit` shows, and what helps. `nats`: the evidence for a cause."""
    value = outcome["value"]
    match check:
        case "lattice":
            step = f"{outcome['distinct']} distinct readings {outcome['step']:.3g} {unit} apart"
            if "counter_hz" in outcome:
                rate = f"{outcome['counter_hz']:.1g}"
                return f"lattice: {step}: increments of a counter, N includes their rounding: give --decimate {rate}"
            return f"lattice: {step}: noise is below that, N includes the rounding, the bias may stick"
        case "drift_in_average":
            share = f"the drift hides {100.0 * value:.0f} % of the white noise"
            rate_hz = outcome.get("decimate_hz")
            if rate_hz is None:
                return f"drift_in_average: {share}, and no rate of this record shows it: record longer"
            less = rate_hz > outcome["bank_hz"]
            how = "average less" if less else "the part filters it out of its readings: average more"
            return f"drift_in_average: {share}: {how}, with --decimate {rate_hz:g}"
        case "batch":
            return f"{value:.1f} sd from the batch of the model's priors: identify it with the model without that batch"
        case "outliers":
            share = f"{100.0 * value:.2g} % of the readings are {outcome['at']:.6g} {unit}"
            return f"outliers: {share}, too many for noise: lost words of the bus?"
        case "held_samples":
            share = f"{100.0 * value:.2g} % of the rows repeat the one before at no fixed rate"
            return f"held_samples: {share}: log at the sensor's own rate"
        case "misread":
            kinds = " or ".join([outcome["kind"], *outcome.get("also_possible", ())])
            undone = "; undone here" if outcome.get("undone") else ""
            return f"misread ({kinds}): {100.0 * value:.2g} % of the readings: {MISREAD[outcome['kind']]}{undone}"
        case "quantization":
            return f"quantization: {100.0 * value:.2g} % of the readings are read as another code: a dead band?"
        case "motion" | "stuck":
            return f"{check}, left out: {_times(outcome['intervals'])}"
        case "channel":
            text = f"{outcome['column']} ({outcome['form']}) explains {nats} nats of it"
            return f"channel: {text}: N, K and the bias include that"
        case "turn_on":
            text = f"a bias that settles within {outcome['tau_s']:.3g} s or so, by {nats} nats"
            return f"turn_on: {text}: K includes that"
        case "jump":
            return f"jump: the bias jumps at {outcome['time_s']:.6g} s, by {nats} nats: K includes that"
    return _range_of(check, [outcome])


def _times(intervals: Sequence[Sequence[float]]) -> str:
    return few([f"{a:.6g} to {b:.6g} s" for a, b in intervals])


def _law_table(axes: Mapping[str, Any], left_out: int, datasheet: bool) -> Table:
    """The table without the intervals of its last `left_out` columns."""
    brief = {name: rank < left_out for rank, name in enumerate(("alpha", "N", "K"))}
    names = {name for axis in axes.values() for parameters in axis["parameters"].values() for name in parameters}
    drift = "K or sigma_m" if "B" not in names else "K, sigma_m or B"
    second = "1/alpha, s" + (", or ratio" if names & set(RATIOS) else "")
    caption = f"medians [5 %, 95 %]{'' if datasheet else ' in the units of the recording'}; "
    caption += "~: this record does not identify it" + ("; a wider window shows all intervals" if left_out else "")
    headings = ("law", "P", "N", drift, second)
    table = table_of(headings, caption=caption, collapse_padding=left_out > 0, pad_edge=left_out == 0)
    for name, axis in axes.items():
        best = likeliest(axis["hypotheses"])
        bias = axis["bias_now"]
        level = f"bias {bias['mean']:.6g} ± {bias['sd']:.2g}"
        heading = f"{name} \\[{bias['unit']}]"
        if datasheet:
            unit = units.datasheet_unit("bias", bias["unit"])
            factor = units.factor(bias["unit"], unit)
            level = f"bias {bias['mean'] * factor:.6g} ± {bias['sd'] * factor:.2g} {units.typeset(unit)}"
            heading = name
        level, _, spread = level.partition(" ±") if brief["N"] else (level, "", "")
        table.add_row(heading, "", level, f"±{spread}" if spread else "", "", style="cyan")
        for law, probability in axis["hypotheses"].items():
            parameters = axis["parameters"][law]
            table.add_row(
                law,
                f"{probability:.4f}",
                _interval(parameters, ("N",), datasheet=bias["unit"] if datasheet else "", brief=brief["N"]),
                _interval(
                    parameters, ("K", "sigma_m", "B"), datasheet=bias["unit"] if datasheet else "", brief=brief["K"]
                ),
                _interval(parameters, ("alpha",), inverse=True, brief=brief["alpha"])
                or _interval(parameters, RATIOS, brief=brief["alpha"]),
                style="bold" if law == best else None,
                end_section=law == list(axis["hypotheses"])[-1],
            )
    return table


def _notes(document: Mapping[str, Any], axes: Mapping[str, Any]) -> list[str]:
    """The lines below the tables. `axes`: those that have a result."""
    recording = document["recording"]
    own_priors = _by_reason(
        (", ".join(axis["own_priors"]), name) for name, axis in axes.items() if axis.get("priors") == OF_RECORD
    )
    line = "priors: {}: from this record, which lies outside the model's: {}"
    kept = [line.format(names, own) for own, names in own_priors.items()]
    lost: dict[str, dict[str, int]] = {}
    for name, axis in axes.items():
        for what, count in axis.get("samples_kept_out", {}).items():
            if count:
                lost.setdefault(what, {})[name] = count
    for what, counts in lost.items():
        ends = " to ".join(dict.fromkeys(str(end(counts.values())) for end in (min, max)))
        kept.append(f"kept out: {', '.join(counts)}: {ends} {what}")
    for check, names, outcomes in _events(axes, passed=True):
        kept.append(f"{check}, left out, N is the same with it: {', '.join(names)}: {_times(outcomes[0]['intervals'])}")
    without = _by_reason((axis["error"], name) for name, axis in document["axes"].items() if name not in axes)
    failed = [f"no result: {names}: {error}; choose axes with --axis" for error, names in without.items()]
    for name, axis in axes.items():
        coarse = [
            law
            for law, parameters in axis["parameters"].items()
            if axis["hypotheses"][law] >= LAW_LEAST and any(e["off_grid"] for e in parameters.values())
        ]
        if coarse:
            failed.append(f"grid of nodes too coarse: {name}: {', '.join(coarse)}")
    failed += _not_adequate(axes)
    suspicions = {name: axis["suspicion"] for name, axis in axes.items() if "suspicion" in axis}
    for said, chosen in (("identified with", True), ("strongest suspicion", False)) if suspicions else ():
        from selfcal.diagnosis.words import named  # it takes a second

        of = _by_reason((named(why), name) for name, why in suspicions.items() if ("added_law" in axes[name]) is chosen)
        failed += [f"{said}: {'; '.join(f'{names}: {cause}' for cause, names in of.items())}"] if of else []
    more = _by_reason(
        (", ".join(f"{law} {P:.2g}" for law, P in sorted(more.items(), key=lambda law: -law[1]) if P > LAW_LEAST), name)
        for name, more in ((name, axis["more_laws"]) for name, axis in axes.items() if "more_laws" in axis)
    )
    failed += [f"with the laws of sums.yaml: {names}: {laws}" for laws, names in more.items()]
    if any(line.startswith("not adequate") for line in failed):
        there = Path(recording["path"]).exists() or recording.get("paths")
        typed = f"{called()} diagnose {as_typed(recording)}" if there else "selfcal.diagnose() of the same readings"
        failed.append(f"why, and what mends it: {typed}")
    by_all = {name: axis["bias_now"]["together"] for name, axis in axes.items() if "together" in axis["bias_now"]}
    if by_all:
        biases = ", ".join(f"{name} {bias['mean']:.6g} ± {bias['sd']:.2g}" for name, bias in by_all.items())
        kept.append(f"bias by all axes together, with the model's hidden_input: {biases}")
    N = {name: axis["summary"]["arw"] for name, axis in axes.items() if axis.get("summary")}
    return [*kept, *_unidentified(axes), *noisier(N), *_ahead(axes), *failed]


def _events(axes: Mapping[str, Any], *, passed: bool) -> list[_Event]:
    """Checks that name an event or source, with the axes and their outcomes: those that speak against the laws, or the
    stretches of time that are left out and `passed`."""
    events: list[_Event] = []
    lasting: dict[str, dict[str, Mapping[str, Any]]] = {}
    for name, axis in axes.items():
        for check, outcome in axis["checks"].items():
            if outcome["passed"] is not passed or check.startswith(STATISTICS) or passed > ("intervals" in outcome):
                continue
            if "intervals" in outcome:
                lasting.setdefault(check, {})[name] = outcome
                continue
            same = next((event for event in events if event[0] == check and _same(check, event[2][0], outcome)), None)
            if same is None:
                events.append(same := (check, [], []))
            same[1].append(name)
            same[2].append(outcome)
    for check, outcomes in lasting.items():
        for names, intervals in motion_events(
            {name: outcome["intervals"] for name, outcome in outcomes.items()}
        ).items():
            events.append((check, [*names], [{**outcomes[names[0]], "intervals": intervals}]))
    return events


def _not_adequate(axes: Mapping[str, Any]) -> list[str]:
    """Evidence against the laws: a line an event or source, which covers the statistics of its axes."""
    events = _events(axes, passed=False)
    named = {name for _, names, _ in events for name in names}
    once = [{*names} for check, names, _ in events if check in ("turn_on", "jump")]
    # An axis goes like another axis by an event of both.
    events = [
        event
        for event in events
        if event[0] != "channel" or not any({event[2][0]["column"], *event[1]} <= both for both in once)
    ]
    lines = []
    for check, names, outcomes in events:
        values = [
            f"{outcome['value']:.0f}" for outcome in sorted(outcomes, key=lambda outcome: float(outcome["value"]))
        ]
        nats = values[0] if values[0] == values[-1] else f"{values[0]} to {values[-1]}"
        text = _why(check, outcomes[0], axes[names[0]]["bias_now"]["unit"], nats)
        lines.append(f"not adequate: {', '.join(names)}: {text}")
    beside: list[str] = []
    alike: dict[tuple[str, ...], list[str]] = {}  # axes by the statistics that they fail
    for name, axis in axes.items():
        off = _off(axis)
        failed = [check for check in _failed(axis) if not check.startswith("allan_")] + ["allan"] * bool(off)
        if name in named and failed:
            most, tau = max(off, key=lambda share: abs(share[0]), default=(0.0, ""))
            beside.append(name + f" (allan_{tau} model {most:+.0f} %)" * bool(off))
        elif failed:
            alike.setdefault(tuple(failed), []).append(name)
    for checks, names in alike.items():
        said = [_range_of(test, [axes[name]["checks"][test] for name in names]) for test in checks if test != "allan"]
        off = [each for name in names for each in _off(axes[name])]
        each = [min(off), max(off)] if off and len(names) > 1 else off  # allan_16s model -9 %, 128s +22 %
        said += (
            [f"allan_{', '.join(f'{tau} {most:+.0f} %' for most, tau in each).replace(' ', ' model ', 1)}"]
            if off
            else []
        )
        lines.append(f"not adequate: {', '.join(names)}: {'; '.join(said)}")
    return [*lines, *([f"not adequate: statistics of {', '.join(beside)} as well"] if beside else [])]


def _failed(axis: Mapping[str, Any]) -> list[str]:
    """Statistics of an axis that speak against its law."""
    return [check for check, own in axis["checks"].items() if check.startswith(STATISTICS) and not own["passed"]]


def _off(axis: Mapping[str, Any]) -> list[tuple[float, str]]:
    """The model's Allan deviation over the recording's less 1, percent, and its averaging time, where that fails."""
    failed = [check for check in _failed(axis) if check.startswith("allan_")]
    return [(100.0 * axis["checks"][check]["value"], check.removeprefix("allan_")) for check in failed]


def _range_of(check: str, outcomes: Sequence[Mapping[str, Any]]) -> str:
    values = [outcome["value"] for outcome in outcomes]
    ends = " to ".join(dict.fromkeys(f"{end(values):+.3f}" for end in (min, max)))
    return f"{check} {ends}, beyond ±{outcomes[0]['limit']:.3f}"


def _same(check: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether two axes fail a check by the same event or source."""
    match check:
        case "jump":
            from selfcal.diagnosis.causes.step import ONE_EVENT_S  # it takes a second

            return bool(abs(a["time_s"] - b["time_s"]) < ONE_EVENT_S)
        case "turn_on":
            return True
        case "channel":
            return bool(a["column"] == b["column"])
    return False


def _ahead(axes: Mapping[str, Any]) -> list[str]:
    """What the module's calibration is worth some time after a report, of `replay`."""
    ahead_of = {name: axis["ahead"] for name, axis in axes.items() if axis.get("ahead")}
    return [
        f"corrected output {ahead['horizon_s']:g} s after a report: {name}: rms error {ahead['rmse']:.3g} "
        f"{ahead['unit']} ({ahead['reports']} reports, means of {ahead['mean_s']:g} s)"
        for name, ahead in ahead_of.items()
    ]


def _regressor_table(axes: Mapping[str, Any]) -> Table:
    caption = "coefficients if in use: medians [5 %, 95 %]; the laws' parameters are those of each law's best subset"
    table = table_of(("axis", "regressor", "P(in use)", "coefficient", "unit"), caption=caption)
    for name, axis in axes.items():
        entries = list(axis.get("regressors", {}).items())
        for regressor, entry in entries:
            for column, c in entry["coefficients"].items():
                table.add_row(
                    name,
                    column,
                    f"{entry['probability']:.4f}",
                    "-" if not math.isfinite(c["median"]) else f"{c['median']:.4g} \\[{c['q05']:.4g}, {c['q95']:.4g}]",
                    c["unit"],
                    style="bold" if regressor in axis["regressors_in_use"] else None,
                    end_section=regressor == entries[-1][0] and column == list(entry["coefficients"])[-1],
                )
    return table


def _interval(
    parameters: Mapping[str, Any],
    names: Sequence[str],
    *,
    inverse: bool = False,
    datasheet: str = "",
    brief: bool = False,
) -> str:
    """Median and interval of the law's parameter among `names`, `brief` without the interval; `datasheet`: unit of the
    axis, to be turned into that of data sheets."""
    name = next((name for name in names if name in parameters), None)
    if name is None:
        return ""
    estimate = parameters[name]
    low, middle, high = estimate["q05"], estimate["median"], estimate["q95"]
    if not math.isfinite(middle):
        return "-"
    if inverse:
        low, middle, high = 1.0 / high, 1.0 / middle, 1.0 / low
    unit = ""
    if datasheet:
        to = units.datasheet_unit(name, datasheet)
        factor = units.factor(estimate["unit"], to)
        low, middle, high, unit = low * factor, middle * factor, high * factor, f" {units.typeset(to)}"
    mark = "" if estimate["identified"] else "~"
    if brief:
        return f"{mark}{middle:.3g}{unit}"
    return f"{mark}{middle:.3g} \\[{low:.3g}, {high:.3g}]{unit}"
