"""What a finding says in words: the cause as an engineer says it, and what to record next to make sure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

WORDS: Mapping[str, str] = {
    "temperature": "The bias follows the temperature.",
    "supply": "The bias follows the supply voltage.",
    "cross_axis": "Another axis leaks into this one.",
    "ramp": "The bias drifts at a constant rate.",
    "step": "The bias jumps once.",
    "periodic": "A periodic disturbance of one frequency is in the readings.",
    "flicker": "The bias has flicker (1/f) noise, or drifts on two time scales at once.",
    "colored_noise": "The white noise has memory: neighbouring samples are correlated.",
    "quantization": "The readings lie on a coarse lattice that the model file does not state.",
    "outliers": "Single samples are far off.",
    "variance_change": "The noise level changes once.",
    "saturation": "Readings are clipped at a limit.",
    "missing_samples": "Samples are missing.",
    "stuck": "The readings stop at one value for a while.",
    "held_samples": "The logger asks oftener than the sensor measures: each reading repeats.",
    "rate_change": "The sampling rate changes once.",
    "motion": "The sensor was moved or shaken while it should have rested.",
    "unexplained": "The readings differ from every model tried, and no known cause explains it.",
}



def verdict(axis: Mapping[str, Any]) -> str:
    """The verdict on an axis of the document; one that is not finished is none."""
    if not axis.get("unfinished"):
        return str(axis["verdict"])
    return f"{'nothing found so far' if axis['verdict'] == 'adequate' else axis['verdict']}, not finished"


NEXT: Mapping[str, str] = {
    "temperature": "Cycle the temperature up and down, so that it does not only rise with time.",
    "supply": "Change the supply by 0.1 V and back, twice, at a constant temperature.",
    "cross_axis": "Turn the sensor so that the other axis reads something else.",
    "ramp": "Record three times as long, with the temperature beside it.",
    "step": "Record again without touching the mount or the cable.",
    "periodic": "Record at another rate: a line that moves is an alias.",
    "flicker": "Record three times as long, and at 10 Hz or more.",
    "colored_noise": "Record at the sensor's full rate with its filter off.",
    "quantization": "State the lsb in the model file, or record with a finer range.",
    "outliers": "Check the bus: log the raw words of those samples.",
    "variance_change": "Look for what was switched on at that time.",
    "saturation": "Choose a wider range.",
    "missing_samples": "Check the logger's buffer and the data-ready line.",
    "stuck": "Check the bus and the sensor's data-ready line at that time.",
    "held_samples": "Log at the sensor's own rate, on its data-ready line.",
    "rate_change": "Look for what set the rate at that time; record at one rate.",
    "motion": "Record on a heavy table, away from traffic.",
    "unexplained": "Record again: if the statistic stands out a second time, it is the sensor's own.",
}


#: Stretches of time that a sentence names.
INTERVALS_SHOWN = 3
#: How an estimate's key is read out.
LABELS = {
    "time_s": "at",
    "rate_hz": "at",
    "before_hz": "from",
    "after_hz": "to",
    "frequency_hz": "frequency",
    "width_hz": "half width",
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
        else:
            parts.append(f"{label} {value:.4g}" if isinstance(value, float) else f"{label} {value}")
    text = ", ".join(parts)
    return f"{WORDS[cause]} {text[:1].upper()}{text[1:]}."


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
