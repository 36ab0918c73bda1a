"""`diagnose A --on B`: what a finding of one recording gains on another.

Truth: the simulator's. On a second record of the same truth the right model gains about what it gained on the first:
the two sums of squares of a column differ by its course, so a half to twice is asked for. On a record without the
effect the coefficient of the first one harms.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from selfcal.base.errors import UserError
from selfcal.model.file import DEFAULT
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.simulate import simulate

N = 0.03
LEAK = "cross_axis:axis=gx,coefficient=0.18,other=gy"
LINE = "periodic:axis=gx,frequency_hz=0.031,amplitude=0.009"
STEP = "step:axis=gx,time_s=1300,amplitude=0.05"


def model(tmp_path: Path) -> Path:
    tree: dict[str, Any] = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["simulate"] = {
        "rate_hz": 1.0,
        "duration_s": 3000.0,
        "axes": {axis: {"hypothesis": "random_walk", "bias": 0.1, "N": N, "K": 2e-4} for axis in ("gx", "gy")},
    }
    path = tmp_path / "model.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


def findings(tmp_path: Path, first: list[str], second: list[str], axes: str = "gx") -> list[dict[str, Any]]:
    own = model(tmp_path)
    simulate(own, tmp_path / "a.npz", 3, first)
    simulate(own, tmp_path / "b.npz", 4, second)
    document = diagnose(tmp_path / "a.npz", axes=axes, on=tmp_path / "b.npz")
    assert document["on"]["samples"] == 3000
    found: list[dict[str, Any]] = document["axes"][axes]["findings"]
    return found


def nats(finding: dict[str, Any]) -> float:
    score = finding["gain_on"]["log_score_per_sample"]
    return float((score["after"] - score["before"]) * score["samples"])


@pytest.mark.parametrize(("effect", "cause"), [(LEAK, "cross_axis"), (LINE, "periodic")])
def test_a_right_model_gains_on_a_second_record_as_well(tmp_path: Path, effect: str, cause: str) -> None:
    (found,) = findings(tmp_path, [effect], [effect])
    assert found["cause"] == cause
    assert 0.5 < nats(found) / found["evidence_gain_nats"] < 2.0
    assert found["gain_on"]["log_score_per_sample"]["sd"] > 0.0


def test_a_model_of_what_the_second_record_has_not_harms(tmp_path: Path) -> None:
    (found,) = findings(tmp_path, [LEAK], [])
    assert nats(found) < -10.0


def test_a_jump_does_not_carry_over_and_both_causes_are_listed(tmp_path: Path) -> None:
    found = {one["cause"]: one for one in findings(tmp_path, [LEAK, STEP], [LEAK])}
    assert found["step"]["gain_on"] is None
    assert "event" in found["step"]["gain_on_reason"]
    assert nats(found["cross_axis"]) > 10.0


def test_all_causes_together_have_a_gain_of_their_own(tmp_path: Path) -> None:
    """A leak and a line hardly know each other: together they gain the sum of both, within the scatter of each."""
    own = model(tmp_path)
    for name, seed in (("a", 3), ("b", 4)):
        simulate(own, tmp_path / f"{name}.npz", seed, [LEAK, LINE])
    axis = diagnose(tmp_path / "a.npz", axes="gx", on=tmp_path / "b.npz")["axes"]["gx"]
    single = [nats(finding) for finding in axis["findings"]]
    assert len(single) == 2
    assert min(single) > 10.0
    assert nats(axis) == pytest.approx(sum(single), rel=0.2)


def test_a_short_second_recording_is_named(tmp_path: Path) -> None:
    own = model(tmp_path)
    simulate(own, tmp_path / "a.npz", 3, [LEAK])
    rows = "".join(f"{k},{0.1 * (k % 7)},{0.1 * (k % 5)}\n" for k in range(30))
    (tmp_path / "b.csv").write_text("t[s],gx[deg/s],gy[deg/s]\n" + rows, "utf-8")
    axis = diagnose(tmp_path / "a.npz", axes="gx", on=tmp_path / "b.csv")["axes"]["gx"]
    for one in (axis, *axis["findings"]):
        assert one["gain_on"] is None
        assert one["gain_on_reason"] == "the second recording is too short: 30 bank samples, and 60 are needed"


def test_a_second_recording_without_the_axis_is_named(tmp_path: Path) -> None:
    own = model(tmp_path)
    simulate(own, tmp_path / "a.npz", 3, [LEAK])
    (tmp_path / "b.csv").write_text("t[s],gy[deg/s]\n" + "".join(f"{k},{0.1 * (k % 7)}\n" for k in range(400)), "utf-8")
    (found,) = diagnose(tmp_path / "a.npz", axes="gx", on=tmp_path / "b.csv")["axes"]["gx"]["findings"]
    assert found["gain_on"] is None
    assert "gx" in found["gain_on_reason"]
    with pytest.raises(UserError, match="cannot be read"):
        diagnose(tmp_path / "a.npz", axes="gx", on=tmp_path / "none.csv")
