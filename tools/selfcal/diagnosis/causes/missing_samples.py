"""Samples are missing. integrity.py finds them."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause, Grouping, Scored, Simulated, count_key, medians, shown

#: Share of missing samples above which they are reported.
MISSING_LEAST = 1e-3

CAUSE = Cause(
    "missing_samples",
    "Samples are missing.",
    "Check the logger's buffer and the data-ready line.",
    source="read-out",
    pictures=shown("missing"),
    least=lambda state, record: {"missing": (MISSING_LEAST * record.present.size, "samples")},
    grouping=Grouping(alike=lambda a, b: True),
    score=Scored(no_gain="gaps are bridged before and after: the model of the noise is the same"),
    simulated=Simulated(
        keys={"missing": count_key(lambda s: max(1, round(0.02 * s.samples)), "missing")},
        common=True,
        of_estimate=lambda look: {key: max(1, round(value)) for key, value in medians(look).items()},
    ),
)
