"""What a finding says in words: the cause as an engineer says it, and what to record next to make sure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.finding import ROUNDS


def verdict(axis: Mapping[str, Any]) -> str:
    """The verdict on an axis of the document; one that is not finished is none."""
    if not axis.get("unfinished"):
        return str(axis["verdict"])
    return f"{'nothing found so far' if axis['verdict'] == 'adequate' else axis['verdict']}, not finished"


#: Stretches of time that a sentence names.
INTERVALS_SHOWN = 3
#: How an estimate's key is read out.
LABELS = {
    "other": "other axis",
    "share": "share of the noise",
    "time_s": "at",
    "rate_hz": "at",
    "before_hz": "from",
    "after_hz": "to",
    "frequency_hz": "frequency",
    "width_hz": "half width",
    "tau_s": "time constant",
    "amplitude_2": "second amplitude",
    "tau_2_s": "time constant",
    "lag_s": "time constant of the lag",
    "width": "width of the play",
    "misread": "share read as a neighbour",
    "value": "a dead band about",
}
#: What a form adds to the sentence; the static one is what the sentence says by itself.
FORMS = {
    "lag": "late by a first-order lag",
    "rate": "by its rate",
    "square": "by its square as well",
    "first_order": "by its value and its rate behind one first-order lag",
    "cube": "by its cube as well",
    "play": "through a play (hysteresis)",
}
#: The largest sensitivity of a gyroscope to acceleration in data sheets, deg/s per m/s^2 (0.2 deg/s per g). A
#: coefficient so many times larger is no leak of that kind.
G_SENSITIVITY, IMPLAUSIBLE = 0.02, 50.0


def _rounded(value: float, half: float) -> str:
    """A value to the second digit of its uncertainty; 6 digits without one."""
    if not (half > 0.0 and math.isfinite(half) and value != 0.0):
        return f"{value:.6g}"
    first = math.floor(math.log10(abs(value)))
    digits = max(2, first + 1, first - math.floor(math.log10(half)) + 2)
    return f"{value:#.{digits}g}".removesuffix(".")


def _intervals(stretches: Sequence[Sequence[float]]) -> str:
    """The first few stretches of time, and how many more there are."""
    shown = ", ".join(f"{start:.6g} s to {end:.6g} s" for start, end in stretches[:INTERVALS_SHOWN])
    more = len(stretches) - INTERVALS_SHOWN
    return f"from {shown}" + (f" and {more} more" if more > 0 else "")


def sentence(cause: str, estimate: Mapping[str, Any]) -> str:
    """The cause with its size."""
    parts = []
    for key, value in estimate.items():
        label = LABELS.get(key, key)
        if isinstance(value, Mapping):
            half = 0.5 * (value["q95"] - value["q05"])
            unit = "" if value["unit"] == "1" else f" {value['unit']}"
            spread = f" ± {half:.2g}" if half > 0.0 and math.isfinite(half) else ""
            parts.append(f"{label} {_rounded(value['median'], half)}{spread}{unit}")
        elif key == "intervals":
            parts.append(_intervals(value))
        elif key == "band_hz":
            parts.append(f"between {value[0]:.3g} Hz and {value[1]:.3g} Hz")
        elif key == "form":
            parts += [FORMS[value]] if value in FORMS else []
        elif key == "form_also_possible":
            parts.append(f"not to be told from {', '.join(value)}")
        elif key in ("input", "source"):
            continue
        else:
            parts.append(f"{label} {value:.4g}" if isinstance(value, float) else f"{label} {value}")
    text = ", ".join(parts)
    begin = CAUSES[cause].unsure if "source" in estimate else CAUSES[cause].words
    return f"{begin} {text[:1].upper()}{text[1:]}."


def evidence(finding: Mapping[str, Any], number: Callable[[float], str] = "{:.1f}".format) -> str:
    """What a finding gained when it was found, over the model with the findings of earlier rounds."""
    found = finding.get("found_in_round", 0)
    gain = finding["evidence_gain_nats"]
    text = f"{number(math.inf if gain is None else gain)} nats" + (f" in round {found}" if 1 <= found <= ROUNDS else "")
    net = finding.get("net_nats")
    return text if net is None or not math.isfinite(net) else f"{text}, {number(net)} net of the search"


def carried(finding: Mapping[str, Any]) -> list[str]:
    """What a finding gains on a second recording, in a line; none without one."""
    if finding.get("gain_on"):
        score = finding["gain_on"]["log_score_per_sample"]
        more = score["after"] - score["before"]
        nats = f"{more * score['samples']:+.1f} nats on the second recording ({more:+.2g} ± {score['sd']:.1g} a sample)"
        return [nats if more > 0.0 else f"its gain does not carry over: {nats}"]
    if finding.get("gain_on_reason"):
        return [f"no gain on the second recording: {finding['gain_on_reason']}"]
    return []


def inflation_sentence(inflation: Mapping[str, float]) -> str:
    """The answer to "why must I multiply by ten?"."""
    told = [
        f"{name} {f'{factor:.2f} times' if math.isfinite(factor) else 'many times'} the value with it"
        for name, factor in inflation.items()
        if not 0.95 < factor < 1.05
    ]
    return f"Without it, plain white noise and random walk come out wrong: {', '.join(told)}." if told else ""


def plausibility(coefficient: float) -> str:
    """How a gyroscope's coefficient on an accelerometer, deg/s per m/s^2, compares with parts; empty if plausible."""
    times = abs(coefficient) / G_SENSITIVITY
    if times < IMPLAUSIBLE:
        return ""
    return (
        f"That is {times:.2g} times the largest sensitivity to acceleration of any part ({G_SENSITIVITY:g} deg/s per "
        "m/s^2): rather one cause moves both axes, such as vibration, temperature or the supply."
    )
