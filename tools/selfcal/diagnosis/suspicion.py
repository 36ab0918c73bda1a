"""What a diagnosis would most likely name first: one round of looks, without the search for integrity and the rest."""

from __future__ import annotations

from collections.abc import Sequence

from selfcal.diagnosis.loop import LOOKS
from selfcal.diagnosis.record import of_recording
from selfcal.diagnosis.state import NET_LEAST
from selfcal.errors import UserError
from selfcal.model import Model
from selfcal.recording import Recording


def suspicions(recording: Recording, model: Model, axes: Sequence[str], rate_hz: float) -> dict[str, str]:
    """By axis the cause that gains most on block means at `rate_hz`. Axes that show none, or are too short, are left
    out."""
    try:
        record = of_recording(recording, model, min(rate_hz, recording.rate_hz))
    except UserError:
        return {}
    found: dict[str, str] = {}
    for name in axes:
        if name not in record.axes or record.axes[name].below_lattice:
            continue
        state = record.axes[name].refit()
        best = max((look for cause in LOOKS for look in cause(state, record)), key=lambda look: look.net, default=None)
        if best is not None and best.net >= NET_LEAST:
            found[name] = best.cause
    return found
