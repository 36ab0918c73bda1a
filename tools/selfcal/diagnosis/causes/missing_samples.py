"""Samples are missing. integrity.py finds them."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause, counted, medians, shown

#: Missing samples are told of from this share on.
MISSING_LEAST = 1e-3

CAUSE = Cause(
    "missing_samples",
    "Samples are missing.",
    "Check the logger's buffer and the data-ready line.",
    source="read-out",
    alike=lambda a, b: True,
    pictures=shown("missing"),
    no_gain="gaps are bridged before and after: the model of the noise is the same",
    least=lambda state, record: {"missing": (MISSING_LEAST * record.present.size, "samples")},
    of_estimate=lambda look: {key: max(1, round(value)) for key, value in medians(look).items()},
    keys={"missing": counted(lambda s: max(1, round(0.02 * s.samples)), "missing")},
    common=True,
)
