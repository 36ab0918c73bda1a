"""Vibration that rectifies: the bias follows the short-term variance of another axis."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from selfcal.base.grid import Array
from selfcal.diagnosis import channel_looks
from selfcal.diagnosis.cause import Cause, Channels, Grouping, Key, Simulated, Written, shown
from selfcal.diagnosis.channel_looks import Channel
from selfcal.diagnosis.record import Record, smoothed
from selfcal.likelihood.columns import LN_SLOW
from selfcal.likelihood.state import Look, State
from selfcal.logs.recording import bridged
from selfcal.model.forms import variance_of

#: Widths of the means of a variance, s.
WIDTHS_S = (1.0, 3.0, 10.0, 30.0, 90.0)
#: Least differences that a variance is taken from: a single difference scatters by 1.7 times itself.
ENOUGH = 8


def looks(state: State, record: Record) -> list[Look]:
    """A look for every other axis whose variance is known."""
    others = {name: values for name, values in record.variances(state.axis).items() if np.ptp(values) > 0.0}
    widths = tuple(width for width in WIDTHS_S if width * record.recorded_hz >= ENOUGH) or WIDTHS_S[-1:]
    return channel_looks.look(
        state,
        [
            Channel(
                "vibration",
                f"vibration_{name}",
                name,
                record.axes[name].unit,
                values,
                input="variance",
                reference=float(f"{values.mean():.6g}"),
                widths_s=widths,
                forms=("static", "lag"),
                ln_looks=LN_SLOW + math.log(len(others)),
                extra={"other": name},
            )
            for name, values in others.items()
        ],
    )


def _add(keys: Mapping[str, Any], channels: Channels) -> Array:
    """The variance of 1 s of the other axis, about its mean."""
    interval_s = float(channels.time_s[1] - channels.time_s[0])
    variance = smoothed(bridged(variance_of(channels.axes[str(keys["other"])])), max(ENOUGH, round(1.0 / interval_s)))
    about: Array = variance - variance.mean()
    return float(keys["coefficient"]) * about + channel_looks.added(keys, channels, about)


CAUSE = Cause(
    "vibration",
    "The bias follows the vibration of another axis.",
    "Switch the source of the vibration off and on, twice.",
    source="surroundings",
    looks=looks,
    pictures=shown("means", "evidence"),
    grouping=Grouping(pairs=True),
    written=Written(smoothed=True, of_column=channel_looks.of_other),
    simulated=Simulated(
        keys={"coefficient": Key(lambda s: 0.3 * s.n / s.sd**2), "lag_s": channel_looks.EFFECT_KEYS["lag_s"]},
        follows=True,
        of_estimate=channel_looks.of_look,
        add=_add,
    ),
)
