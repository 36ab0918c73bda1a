"""What a diagnosis would most likely name first: one round of looks, without the search for integrity and the rest."""

from __future__ import annotations

from collections.abc import Sequence

from selfcal.base.errors import UserError
from selfcal.diagnosis.integrity import masked
from selfcal.diagnosis.loop import LOOKS
from selfcal.diagnosis.record import of_recording
from selfcal.likelihood.fit import ROUGH_FTOL
from selfcal.likelihood.state import NET_LEAST, Look
from selfcal.logs.recording import Recording
from selfcal.model.file import Model

#: Rate of the means that are looked at, Hz, and how many of them at most: a longer record has longer ones.
RATE_HZ, MOST = 1.0, 20_000


def suspicions(recording: Recording, model: Model, axes: Sequence[str]) -> dict[str, Look]:
    """By axis the look that gains most on means of 1 s. Axes that show none, or are too short, are left out.

    The fits are rough: they rank causes, and their sizes lay a prior at most."""
    try:
        record = of_recording(recording, model, min(RATE_HZ, recording.rate_hz, MOST / recording.duration_s))
    except UserError:
        return {}
    found: dict[str, Look] = {}
    for name in axes:
        if name not in record.axes or record.axes[name].below_lattice:
            continue
        state = record.axes[name]
        state = (masked(state, record.moving) if record.moving.any() else state).refit(ftol=ROUGH_FTOL)
        best = max((look for cause in LOOKS for look in cause(state, record)), key=lambda look: look.net, default=None)
        if best is not None and best.net >= NET_LEAST:
            found[name] = best
    return found
