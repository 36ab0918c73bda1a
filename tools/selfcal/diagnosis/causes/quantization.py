"""A coarse lattice that the model file does not state. readings.py finds it, integrity.py judges it."""

from __future__ import annotations

from selfcal.diagnosis.cause import Cause, Extension, positive, shown
from selfcal.diagnosis.model_tree import digits


def _extend(at: Extension) -> None:
    at.group["lsb"] = digits(at.finding.look.estimate["lsb"]["median"])


CAUSE = Cause(
    "quantization",
    "The readings lie on a coarse lattice that the model file does not state.",
    "State the lsb in the model file, or record with a finer range.",
    pictures=shown("lattice"),
    no_gain="the lattice is in the reading and not in the prediction",
    extend=_extend,
    keys={"lsb": positive(lambda s: 2.0 * s.sd, "lsb")},
)
