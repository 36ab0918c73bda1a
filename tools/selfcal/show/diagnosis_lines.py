"""What `diagnose` prints: a line an event or source, then N, K and B before and after, then the details on demand."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from selfcal.adequacy.summary import noisier
from selfcal.base import units
from selfcal.base.output import console_of, print_line, table_of
from selfcal.diagnosis import words
from selfcal.diagnosis.events import parted
from selfcal.show.identification import recording_heading

#: Width of a line without a terminal, characters.
LINE_CHARACTERS = 114


def show(
    document: Mapping[str, Any], *, to_stderr: bool = False, details: bool = False, console: Console | None = None
) -> None:
    """Print the events and the numbers. `details`: each finding of each axis, with its evidence and gain, below."""
    if console is None:
        console = console_of(to_stderr=to_stderr)
        if not console.is_terminal:  # its cells wrap and lose nothing
            console.width = LINE_CHARACTERS

    say = partial(print_line, console)
    say(recording_heading(document["recording"]))
    shown, less = parted(document["findings"])
    axes = {name: axis for name, axis in document["axes"].items() if "error" not in axis}
    if shown:
        console.print(_events(shown))
    if axes:
        console.print(_numbers(axes))
        say("without any finding -> with all: medians ± half of the 90 % interval; –: looked for, not identified")
    for line in notes(axes):
        say(line)
    if less:
        say(words.small(less) + ("" if details else " (--details)"))
    elif not shown and axes:
        say("nothing found")
    for line in words.navigation(document):
        say(line)
    for name, axis in document["axes"].items():
        if "error" in axis:
            say(f"{name}: no result: {axis['error']}")
    for name, axis in axes.items() if details else ():
        say("")
        say(f"{name} [{axis['unit']}]: {verdict(axis)}", "bold red" if axis["verdict"] != "adequate" else "green")
        for finding in axis["findings"]:
            for line in _lines(finding):
                say(f"  {line}")
        for line in words.carried(axis) if len(axis["findings"]) > 1 else ():
            say(f"  all causes together: {line}")


def verdict(axis: Mapping[str, Any]) -> str:
    """The verdict on an axis, why it is not finished, and what the model file states already."""
    text = words.verdict(axis) + (f": {axis['unfinished']}" if axis.get("unfinished") else "")
    return text + (f"; the model states {', '.join(axis['stated'])}" if axis.get("stated") else "")


def notes(axes: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Lines on the table of numbers: the axes that are noisier than their siblings."""
    noise = {name: axis["numbers"]["N"] for name, axis in axes.items() if "numbers" in axis}
    return noisier({name: {**N["after"], "unit": N["unit"]} for name, N in noise.items() if "q05" in N["after"]})


def _events(findings: Sequence[Mapping[str, Any]]) -> Table:
    table = table_of(("", "from", "what", "without it", "do"), wraps=True, pad_edge=False)
    for number, finding in enumerate(findings, 1):
        what = "; ".join(filter(None, (words.what(finding), words.how_much(finding))))
        row = (what, words.effects(finding), words.action(finding))
        style = "bold" if finding["material"] else None
        table.add_row(str(number), finding["source"], *map(escape, map(units.typeset, row)), style=style)
    return table


def _numbers(axes: Mapping[str, Mapping[str, Any]]) -> Table:
    """N, K and B of each axis without its findings and with them."""
    headings = ("axis", "verdict", "N, per √Hz", "K, per s and √Hz", "B")
    table = table_of(headings, wraps=True, pad_edge=False)
    for name, axis in axes.items():
        cells = [escape(before_after(axis["numbers"][key])) for key in ("N", "K", "B")]
        table.add_row(f"{name}, {units.typeset(axis['unit'])}", escape(verdict(axis)), *cells)
    return table


def before_after(number: Mapping[str, Any]) -> str:
    """A number of an axis."""
    after = number["after"]
    text = "–" if not after["identified"] else f"{after['median']:.3g}"
    if "q05" in after:
        half = 0.5 * (after["q95"] - after["q05"])
        value = f"{words.rounded(after['median'], 10.0 * half)} ± {half:.1g}"
        text = value if after["identified"] else f"< {after['q95']:.2g}"
    before = f"{number['before']:.3g}" if number["before"] > 0.0 and math.isfinite(number["before"]) else "–"
    return f"{before} -> {text}"


def _lines(finding: Mapping[str, Any]) -> list[str]:
    """A finding in a few lines."""
    gain = finding["gain"]
    lines = [f"{finding['cause']}: {finding['words']}"]
    evidence = f"  evidence {words.evidence(finding)}"
    if finding["when"]:
        evidence += f"; at {finding['when'][0]:.6g} s"
        evidence += "" if finding["when"][0] == finding["when"][1] else f" to {finding['when'][1]:.6g} s"
    lines.append(evidence)
    if gain is not None:
        score = gain["log_score_per_sample"]
        errors = ", ".join(
            f"{horizon} s {row['before']:.3g} -> {row['after']:.3g}"
            for horizon, row in gain["bias_rmse"]["horizon_s"].items()
        )
        lines.append(f"  held-out gain {score['after'] - score['before']:+.4f} ± {score['sd']:.2g} nats a sample")
        lines[-1] += f"; bias error ahead, {gain['bias_rmse']['unit']}: {errors}" if errors else ""
    elif finding.get("gain_reason"):
        lines.append(f"  no held-out gain: {finding['gain_reason']}")
    lines += [f"  {line}" for line in words.carried(finding)]
    if finding["inflation_words"]:
        lines.append(f"  {finding['inflation_words']}")
    if finding["shared_with"]:
        lines.append(f"  one with {finding['of'].replace('_', ' ')} on {', '.join(finding['shared_with'])}")
    if finding["also_possible"]:
        lines.append(f"  this record cannot tell it from: {', '.join(finding['also_possible'])}")
    lines.append(f"  next: {finding['record_next']}")
    return lines
