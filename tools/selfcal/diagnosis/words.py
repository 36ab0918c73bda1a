"""What a finding says in words: the cause as an engineer says it, and what to record next to make sure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from selfcal.base.errors import few
from selfcal.base.units import duration_words
from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.finding import ROUNDS
from selfcal.diagnosis.separate import NATS
from selfcal.likelihood.heldout import MATTERS
from selfcal.logs.recording import SIDE_CHANNELS


def verdict(axis: Mapping[str, Any]) -> str:
    """The verdict on an axis of the document, or that its diagnosis is not finished."""
    if not axis.get("unfinished"):
        return str(axis["verdict"])
    return f"{'nothing found so far' if axis['verdict'] == 'adequate' else axis['verdict']}, not finished"


#: How an estimate's key is read out, or a cause.
LABELS = {
    "other": "other axis",
    "share": "share of the noise",
    "time_s": "at",
    "rate_hz": "at",
    "before_hz": "from",
    "after_hz": "to",
    "frequency_hz": "frequency",
    "readings_hz": "an alias of",
    "readings_amplitude": "amplitude in the readings",
    "width_hz": "half width",
    "tau_s": "time constant",
    "amplitude_2": "second amplitude",
    "tau_2_s": "time constant",
    "lag_s": "time constant of the lag",
    "width": "width of the play",
    "delay_s": "delay",
    "misread": "share read as a neighbour",
    "value": "a dead band about",
    "lag1": "correlation of neighbours",
    "ratio": "times the noise",
    "turn_on": "turn-on transient",
}
#: Words that a form adds to the sentence, which by itself describes the static form.
FORMS = {
    "lag": "late by a first-order lag",
    "rate": "by its rate",
    "square": "by its square as well",
    "first_order": "by its value and its rate behind one first-order lag",
    "cube": "by its cube as well",
    "play": "through a play (hysteresis)",
    "delay": "late by a fixed time",
    "free": "by a curve of its own",
}
#: Forms, as an alternative.
FORM_NAMES = {
    "rate": "its rate",
    "square": "its square",
    "cube": "its cube",
    "lag": "a lag",
    "play": "a play",
    "delay": "a delay",
    "free": "a curve",
}
#: What stands out, by the beginning of a statistic's name.
STATISTICS = (
    ("jump", "the bias jumps more than its drift does"),
    ("channel", "a recorded channel explains a part of the drift"),
    ("turn_on", "the bias settles after power-on"),
    ("drift_in_average", "the drift moves more than the noise of a mean"),
    ("batch", "the part is unlike the batch of the model's priors"),
    ("coherence_with_", "the readings go together with a recorded channel"),
    ("innovation_largest_correlation", "the noise repeats itself after a while"),
    ("innovation_largest", "single readings are far off"),
    ("innovation_excess_kurtosis", "large and small readings are commoner than in normal noise"),
    ("innovation_skewness", "the noise is not symmetric"),
    ("innovation_ln_variance", "the noise level differs between the halves of the record"),
    ("innovation_spread", "the readings scatter as no model does"),
    ("innovation_mean", "the level differs from what the model predicts"),
    ("innovation_lag", "neighbouring readings are correlated as no model has them"),
    ("innovation_correlation", "neighbouring readings are correlated as no model has them"),
    ("allan_", "the Allan deviation leaves the model's"),
    ("spectrogram_of_", "the power comes and goes"),
    ("spectrum_worst", "a third of an octave has more or less power than the model"),
    ("repeated_readings", "readings repeat the one before too often"),
    ("commonest_reading", "one reading is too common"),
    ("longest_repeat", "one reading stays too long"),
    ("equal_readings", "some codes never come"),
    ("odd_even_codes", "odd and even codes are not alike"),
)
#: Keys that stand with the details.
LATER = (
    *("harmonics", "width_hz", "form", "form_also_possible", "lag_s", "width", "time_constant_s", "tau_2_s"),
    *("band_hz", "clipped"),
)
#: The largest sensitivity of a gyroscope to acceleration in data sheets, deg/s per m/s^2 (0.2 deg/s per g).
G_SENSITIVITY = 0.02


def rounded(value: float, half: float) -> str:
    """A value to the second digit of its uncertainty; 6 digits without an uncertainty."""
    if not (half > 0.0 and math.isfinite(half) and value != 0.0):
        return f"{value:.6g}"
    first = math.floor(math.log10(abs(value)))
    digits = max(2, first + 1, first - math.floor(math.log10(half)) + 2)
    return f"{value:#.{digits}g}".removesuffix(".")


def intervals(stretches: Sequence[Sequence[float]]) -> str:
    """The first few stretches of time, how many more there are, and how long all are."""
    told = f"from {few([f'{start:.6g} s to {end:.6g} s' for start, end in stretches], 3)}"
    return f"{told}, {sum(end - start for start, end in stretches):.3g} s in all" if len(stretches) > 1 else told


def sizes(estimate: Mapping[str, Any]) -> str:
    """An estimate read out: each size to the second digit of its uncertainty."""
    return ", ".join(filter(None, (_size(str(key), value) for key, value in estimate.items())))


def _size(key: str, value: Any) -> str:
    unit = str(value.get("unit") or "1") if isinstance(value, Mapping) else "1"
    label = LABELS.get(key, key.removesuffix(f"_{unit.lower()}").replace("_", " "))
    if isinstance(value, Mapping) and "median" in value:
        low, high = value.get("q05"), value.get("q95")
        half = math.nan if low is None or high is None else 0.5 * (high - low)
        unit = "" if unit == "1" else f" {unit}"
        spread = f" ± {ratio(half)}" if half > 0.0 and math.isfinite(half) else ""
        size = rounded(value["median"], half) if "q05" in value else f"{value['median']:.3g}"
        return f"{size}{spread} {label}" if key == "ratio" else f"{label} {size}{spread}{unit}"
    match key:
        case "intervals":
            return intervals(value)
        case "band_hz":
            return f"between {value[0]:.3g} Hz and {value[1]:.3g} Hz"
        case "form":
            return FORMS.get(value, "")
        case "form_also_possible":
            return f"not to be told from {', '.join(FORM_NAMES.get(item, str(item)) for item in value)}"
        case "jumps" if not isinstance(value, int):
            times = ", ".join(f"{item['time_s']:.0f}" for item in value)
            return f"jumps at {times} s" if times else ""
        case "statistic":
            return statistic(str(value))
        case "share":
            return f"share of the drift {value:.2g}"
        case "undone":
            return "" if value else "still in the readings"
        case "source":
            return f"the source is {value}"
        case "input" | "measured" | "law" | "knots":
            return ""
    if isinstance(value, list | tuple):
        return f"{label} {', '.join(str(item) for item in value)}"
    return f"{label} {value:.3g}" if isinstance(value, float) else f"{label} {value}"


def statistic(name: str) -> str:
    """The meaning of a statistic or a check, by its name."""
    return next((told for begin, told in STATISTICS if name.startswith(begin)), name.replace("_", " "))


def sentence(cause: str, estimate: Mapping[str, Any]) -> str:
    """The cause with its size."""
    text = sizes(estimate)
    return f"{_begin(cause, estimate)} {text[:1].upper()}{text[1:]}."


def _begin(cause: str, estimate: Mapping[str, Any]) -> str:
    return CAUSES[cause].unsure if "source" in estimate else CAUSES[cause].words


def event(finding: Mapping[str, Any]) -> str:
    """A finding of all axes in a sentence: the cause, what the axes have in common, and its size on each."""
    each = "; ".join(
        f"{axis}: {sizes(on_axis['estimate'])}" for axis, on_axis in finding["axes"].items() if on_axis["estimate"]
    )
    told = ". ".join(part[:1].upper() + part[1:] for part in (sizes(finding["estimate"]), each) if part)
    return f"{_begin(finding['cause'], finding['estimate'])} {told or 'On ' + ', '.join(finding['axes'])}."


def named(cause: str) -> str:
    """A cause by its name, or by the id of an event, such as `periodic_2`."""
    of_several, _, number = cause.replace(" ", "_").rpartition("_")
    label = LABELS.get(cause, cause.replace("_", " ")) if cause != "misread" else cause  # the label is of a size
    return f"{named(of_several)} {number}" if number.isdecimal() else label


def quantity(key: str) -> str:
    """What two recordings are compared by: a number, or a size of a cause."""
    return ", ".join(map(named, key.split(".")))


def what(finding: Mapping[str, Any]) -> str:
    """The first words of the list: what acts, on which axes, and when or at which frequency."""
    shape = {key: value for key, value in finding["estimate"].items() if key not in LATER}
    told = f"{named(finding['cause'])} on {' '.join(finding['axes'])}"
    return f"{told}: {told_of}" if (told_of := sizes(shape)) else told


def how_much(finding: Mapping[str, Any]) -> str:
    """Leading size of a finding on each axis; a size without a unit by its name."""
    found = []
    for axis, on_axis in finding["axes"].items():
        key, value = next(((k, v) for k, v in on_axis["estimate"].items() if isinstance(v, Mapping)), ("", None))
        if "share" in on_axis["estimate"] and not isinstance(on_axis["estimate"]["share"], Mapping):
            found.append((axis, on_axis["estimate"]["share"], "of the drift"))
        elif value is not None and value["median"] is not None:
            label = named(key) if key == "ratio" else f"({named(key)})"
            found.append((axis, value["median"], value["unit"] if value["unit"] != "1" else label))
    return _by_unit(found)


def _by_unit(values: Sequence[tuple[str, float, str]]) -> str:
    """Sizes of axes; of more than two in one unit the least and the largest."""
    told = []
    for unit in dict.fromkeys(unit for _, _, unit in values):
        own = [(axis, value) for axis, value, of in values if of == unit]
        if len(own) > 2:
            text = _range([value for _, value in own])
        else:
            text = ", ".join(f"{axis} {ratio(value)}" for axis, value in own)
        told.append(f"{text} {unit}")
    return "; ".join(told)


def _range(values: Sequence[float]) -> str:
    """The least and the largest of some values."""
    return " to ".join(dict.fromkeys(ratio(end(values)) for end in (min, max)))


def _off(factors: Sequence[float]) -> str:
    """How far a number is off, by its values without a cause over those with it: in percent up to twice or half. It is
    not identified without the cause where a factor is infinite, and hidden where a factor is 0."""
    told = []
    above, below = [f for f in factors if 1.0 < f < math.inf], [1.0 / f for f in factors if 0.0 < f < 1.0]
    for word, own in (("large", above), ("small", below)):
        if own:
            percent = [100.0 * (f - 1.0) if word == "large" else 100.0 * (1.0 - 1.0 / f) for f in own]
            told.append(f"{_range(percent)} % too {word}" if max(own) < 2.0 else f"{_range(own)} times too {word}")
    told += [] if all(f < math.inf for f in factors) else ["not identified"]
    return " or ".join(told + (["hidden"] if 0.0 in factors else []))


def effects(finding: Mapping[str, Any]) -> str:
    """How far numbers are off without it alone, where by as much as matters, and whether time that the fit did not see
    confirms it."""
    told = []
    changes = finding["changes"]
    for name in ("N", "K", "B"):
        # B follows from N and K: where these move it says no more.
        own = [change for change in changes.values() if name in change["material"]]
        own = [change for change in own if name != "B" or "K" not in change["material"]]
        factors = [math.inf if change[name] is None else change[name] for change in own]
        told += [f"{name} {off}"] if (off := _off(factors)) else []
    moved = [
        (axis, abs(change["bias"]), change["unit"]) for axis, change in changes.items() if "bias" in change["material"]
    ]
    if moved:
        told.append(f"bias off by {_by_unit(moved)}")
    rows = [change["bias_error"] for change in changes.values() if "bias_error" in change["material"]]
    more = [(row["before"] / row["after"], horizon) for one in rows for horizon, row in one.items()]
    if more:
        most, horizon = max(more)
        told.append(f"bias error {horizon} s ahead {_off([most])}")
    seen = []
    if finding["confirmed"] is False:
        cause = CAUSES.get(finding["cause"])
        event = cause is not None and cause.score.once and {"time_s", "intervals"} & finding["estimate"].keys()
        seen = ["an event: no other time can confirm it" if event else "not confirmed on held-out time"]
    if finding.get("confirmed_on") is not None:
        seen.append("holds on the second recording" if finding["confirmed_on"] else "not seen on the second recording")
    return "; ".join([*([", ".join(told)] if told else []), *seen])


def action(finding: Mapping[str, Any]) -> str:
    """The next step. A coefficient that is known well enough is applied, and not measured again."""
    if "readings_hz" in finding["estimate"]:
        return f"Look for what turns or switches at {finding['estimate']['readings_hz']['median']:.3g} Hz."
    if finding.get("next_record") and finding.get("confirmed_on") is not None:
        seen = "Apply it: the second recording shows it too. --write-model states it."
        return seen if finding["confirmed_on"] else "Leave it out of the model: the second recording does not show it."
    sure = [axis for axis, on_axis in finding["axes"].items() if _sure(on_axis["estimate"].get("coefficient"))]
    if finding.get("next_record") or "source" in finding["estimate"] or not sure:
        return str(finding["record_next"])
    applied = f"known to {100.0 * MATTERS:.0f} %. --write-model states it."
    if len(sure) == len(finding["axes"]):
        return f"Apply it: it is {applied}"
    rest = " ".join(axis for axis in finding["axes"] if axis not in sure)
    return f"Apply it on {' '.join(sure)}: {applied} For {rest}: {finding['record_next']}"


def planned(record: Mapping[str, Any] | None, else_: str) -> str:
    """The next record in words; without a plan the advice of the cause."""
    if record is None:
        return else_
    rivals = " and ".join(map(named, record["between"]))
    if record["duration_s"] is None:
        return f"{else_} No record that was tried tells {rivals} apart."
    length = duration_words(record["duration_s"])
    if record["drive"] is None:
        begin = f"Leave it on, with all else still, and record {length}."
    else:
        swing, period = f"{record['amplitude']:g} {record['unit']}", duration_words(record["period_s"])
        begin = f"Leave it on and cycle the {record['drive']} by {swing} with a period of {period} for {length}."
    held = [name for name in record["between"] if name in SIDE_CHANNELS and record["drive"] not in (None, name)]
    still = "".join(f" Hold the {name} still." for name in held)
    return f"{begin}{still} Then {rivals} differ by {NATS:g} nats."


def _sure(coefficient: Mapping[str, Any] | None) -> bool:
    """Whether half of its 90 % interval is less than what matters: it is applied, and not recorded again."""
    if coefficient is None:
        return False
    return bool(coefficient["q95"] - coefficient["q05"] < 2.0 * MATTERS * abs(coefficient["median"]))


def small(findings: Sequence[Mapping[str, Any]]) -> str:
    """A line on the findings that matter little: they move no number by more than it is known."""
    several = len(findings) > 1
    count = f"{len(findings)} small findings" if several else "1 small finding"
    causes: dict[str, list[str]] = {}
    for finding in findings:
        causes.setdefault(named(finding["cause"]), []).extend(finding["axes"])
    each = "; ".join(f"{cause} on {' '.join(dict.fromkeys(axes))}" for cause, axes in causes.items())
    none = "none moves" if several else "it moves none of"
    return f"{count} ({each}): {none} N, K, B or the bias by more than half of its interval"


def ratio(value: float) -> str:
    """Two digits."""
    return f"{float(f'{value:.2g}'):g}"


def evidence(finding: Mapping[str, Any], number: Callable[[float], str] = "{:.1f}".format) -> str:
    """What a finding gained when it was found, over the model with the findings of earlier rounds."""
    found = finding.get("found_in_round", 0)
    gain = finding["evidence_gain_nats"]
    text = f"{number(math.inf if gain is None else gain)} nats" + (f" in round {found}" if 1 <= found <= ROUNDS else "")
    net = finding.get("net_nats")
    return text if net is None or not math.isfinite(net) else f"{text}, {number(net)} net of the search"


def carried(finding: Mapping[str, Any]) -> list[str]:
    """The gain of a finding on a second recording, in a line; no line without a second recording."""
    if finding.get("gain_on"):
        score = finding["gain_on"]["log_score_per_sample"]
        more = score["after"] - score["before"]
        nats = f"{more * score['samples']:+.1f} nats on the second recording ({more:+.2g} ± {score['sd']:.1g} a sample)"
        return [nats if more > 0.0 else f"its gain does not carry over: {nats}"]
    if finding.get("gain_on_reason"):
        return [f"no gain on the second recording: {finding['gain_on_reason']}"]
    return []


def navigation(document: Mapping[str, Any]) -> list[str]:
    """What the findings mean for a GPS/INS filter, a line each, and what that rests on; no line unless asked."""
    if "navigation" not in document:
        return []
    lines = [
        f"{what(finding)}: "
        + (flight["words"] if (flight := finding["navigation"]) else f"no flight: {finding['navigation_reason']}")
        for finding in document["findings"]
        if "navigation" in finding
    ]
    told = document["navigation"]
    return [*lines, told["words"]] if told else [*lines, *([] if lines else ["no flight: no finding matters"])]


def inflation_sentence(inflation: Mapping[str, float]) -> str:
    """The answer to "why must I multiply by ten?"."""
    told = [f"{name} {_off([factor])}" for name, factor in inflation.items() if abs(factor - 1.0) > MATTERS]
    return f"Without it, the numbers of plain white noise and random walk are wrong: {', '.join(told)}." if told else ""


def plausibility(coefficient: float) -> str:
    """How a gyroscope's coefficient on an accelerometer, deg/s per m/s^2, compares with parts; empty if plausible."""
    times = abs(coefficient) / G_SENSITIVITY
    if times < 50.0:
        return ""
    return (
        f"That is {times:.2g} times the largest sensitivity to acceleration of any part ({G_SENSITIVITY:g} deg/s per "
        "m/s^2): rather one cause moves both axes, such as vibration, temperature or the supply."
    )
