"""What `selfcal tumble` prints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from selfcal.base.output import console_of, print_line, table_of
from selfcal.base.units import STANDARD_GRAVITY
from selfcal.calibration.tumble_document import side_up

#: Data sheets' terms by group of parameters: word, unit, factor, and the number that is subtracted before.
SHEET = {
    ("accelerometer", "bias"): ("bias", "ug", 1e6 / STANDARD_GRAVITY, 0.0),
    ("accelerometer", "scale"): ("scale - 1", "ppm", 1e6, 1.0),
    ("accelerometer", "misalignment"): ("angle", "mrad", 1e3, 0.0),
    ("accelerometer", "temperature"): ("bias over temperature", "ug/degC", 1e6 / STANDARD_GRAVITY, 0.0),
    ("gyroscope", "bias"): ("bias", "deg/s", 1.0, 0.0),
    ("gyroscope", "g_sensitivity"): ("g-sensitivity", "deg/s/g", 1.0, 0.0),
    ("gyroscope", "scale"): ("scale - 1", "ppm", 1e6, 1.0),
    ("gyroscope", "misalignment"): ("angle", "mrad", 1e3, 0.0),
    ("gyroscope", "temperature"): ("bias over temperature", "deg/s/degC", 1.0, 0.0),
}


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """The tables of both sensors, what is not identified, and what the residuals say."""
    console = console_of(to_stderr=to_stderr)
    line = partial(print_line, console)
    turns = [turn for turn in document["turns"] if turn["left_out"] is None]
    line(f"{len(document['rests'])} rests, {len(turns)} turns")
    line(f"up, rest by rest: {', '.join(side_up(np.array(rest['up'])) for rest in document['rests'])}")
    gravity = document["gravity"]
    line(f"gravity {gravity['value']:.6g} m/s^2 ({gravity['source']}); scales take its error, which no rest shows")
    for sensor in ("accelerometer", "gyroscope"):
        answer = document[sensor]
        if answer is None:
            line("gyroscope: the logs have no gx, gy, gz")
            continue
        if "error" in answer:
            line(f"gyroscope: {answer['error']}")
            continue
        drift = dict.fromkeys(entry["drift"] for name, entry in document["noise"].items() if name[0] == sensor[0])
        line("")
        line(f"{sensor}; drift of the bias: {'; '.join(drift)}")
        if sensor == "gyroscope" and not document["earth_rate_known"]:
            line("the Earth's rate is in the intervals of bias and g-sensitivity: --latitude would take it off")
        if "bias_at_degC" in answer:
            line(f"bias at {answer['bias_at_degC']:.4g} degC")
        table = table_of(("", "", "median", "5 %", "95 %", "unit"))
        for column in table.columns[2:5]:
            column.justify = "right"
        for group in (key for of, key in SHEET if of == sensor and key in answer):
            word, unit, size, zero = SHEET[sensor, group]
            for name, entry in answer[group].items():
                if entry["identified"]:
                    digits = max(0, 1 - math.floor(math.log10(max(size * entry["sd"], 1e-12))))
                    cells = [f"{size * (entry[key] - zero):.{digits}f}" for key in ("median", "q05", "q95")]
                    table.add_row(word, name, *cells, unit)
                else:
                    table.add_row(word, name, "not identified", "", "", unit)
        console.print(table)
        if answer["would_mend"]:
            line(f"what is not identified takes: {'; '.join(answer['would_mend'])}")
        if answer["adequate"] is None:
            line("residuals: no rest is left over to check the model with")
        else:
            said = "as the noise has it" if answer["adequate"] else "NOT adequate"
            size = answer["residual_ratio"]
            line("residuals: " + (f"{size:.2f} of their sd, " if size is not None else "") + said)
        if answer["adequate"] is False and not answer["findings"]:
            line("  no single rest or turn, no square and no hysteresis explains it")
        for entry in answer["findings"][:3]:
            line(f"  {entry['cause']} (by chance {entry['p']:.1g})")
    for text in document["notes"]:
        line(f"note: {text}")
