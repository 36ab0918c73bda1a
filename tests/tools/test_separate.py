"""The next record that a finding plans: does it tell the finding from its rival?

The records and their evidence are of `rival_records.py`, which shares no code with the library. `tests/separated.py`
counts over many pairs and records.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rival_records import FIRST_S, Part, evidence

from selfcal.diagnosis.words import planned
from selfcal.verbs.diagnose import diagnose

#: Nats that a plan promises, in nine of ten records.
NATS = 10.0


def test_the_planned_record_decides(tmp_path: Path) -> None:
    """A temperature and a warm-up that rise alike. Of 4 records as planned a right product has 3 or more with 10 nats
    in 95 of 100 runs, at a share of 0.9."""
    part = Part("temperature, turn_on", "turn_on", 7)
    first = part.record(part.first(), 0.0, FIRST_S)
    np.savez(tmp_path / "first.npz", **first)
    found = diagnose(tmp_path / "first.npz")
    (finding,) = found["axes"]["gx"]["findings"]
    plan = finding["next_record"]
    assert set(plan["between"]) == {"temperature", "turn_on"} == {finding["cause"], *finding["also_possible"]}
    assert plan["drive"] == "temperature" and plan["unit"] == "degC"
    assert plan["period_s"] <= plan["duration_s"] <= FIRST_S
    assert found["findings"][0]["next_record"] == plan
    assert f"cycle the temperature by {plan['amplitude']:g} degC" in finding["record_next"]

    def nats(records: list[tuple[dict[str, np.ndarray], float]]) -> float:
        return evidence("turn_on", records) - evidence("temperature", records)

    before = nats([(first, 0.0)])
    assert abs(before) < 5.0  # the first record does not decide
    seconds = [part.record(part.next(plan), FIRST_S + 600.0, round(plan["duration_s"])) for _ in range(4)]
    more = [nats([(first, 0.0), (second, FIRST_S + 600.0)]) - before for second in seconds]
    assert sum(one >= NATS for one in more) >= 3


def test_the_sentence_of_a_plan() -> None:
    """Without a channel to cycle, without a record that suffices, and without a rival."""
    plan = {"drive": None, "between": ["ramp", "turn_on"], "duration_s": 5000.0}
    told = "Leave it on, with all else still, and record 84 minutes. Then ramp and turn-on transient differ by 10 nats."
    assert planned(plan, "Advice.") == told
    cycle = {"drive": "temperature", "amplitude": 3.0, "unit": "degC", "period_s": 900.0, "duration_s": 900.0}
    assert "for 15 minutes. Hold the supply still. Then" in planned({**cycle, "between": ["temperature", "supply"]}, "")
    assert "Hold" not in planned({**cycle, "between": ["temperature", "turn_on"]}, "")
    none = "Advice. No record that was tried tells ramp and turn-on transient apart."
    assert planned({**plan, "duration_s": None}, "Advice.") == none
    assert planned(None, "Advice.") == "Advice."
