"""Results of the verbs: dicts as before, their keys attributes that the package's types know."""

from __future__ import annotations

import copy
import json
import pickle

import pytest

from selfcal.show.results import Comparison, Diagnosis, Finding, Identification, IdentifiedAxis, Posterior

POSTERIOR = {"mean": 1.0, "median": 1.0, "sd": 0.1, "q05": 0.8, "q95": 1.2, "unit": "deg/s", "identified": True}
DOCUMENT = {
    "schema": "selfcal.identify/1",
    "recording": {"path": "a.csv", "rate_hz": 10.0, "samples": 3, "duration_s": 0.3},
    "axes": {
        "gx": {
            "hypotheses": {"constant": 0.2, "random_walk": 0.8},
            "parameters": {"random_walk": {"N": POSTERIOR}},
            "bias_now": {"mean": 0.5, "sd": 0.1, "unit": "deg/s"},
            "checks": {"lag": {"value": 1.0, "limit": 2.0, "passed": True}},
        },
        "gy": {"error": "too short"},
    },
}


def test_a_result_is_its_document() -> None:
    """Equal to it, written as it is, copied and pickled; and the same values by attribute."""
    found = Identification(DOCUMENT)
    assert found == DOCUMENT
    assert json.loads(json.dumps(found)) == DOCUMENT
    assert "'random_walk': 0.8" in repr(found)  # a part of a document is no table
    for again in (copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        assert again == found and isinstance(again.axes["gx"], IdentifiedAxis)
    gx = found.axes["gx"]
    assert isinstance(gx.parameters["random_walk"]["N"], Posterior)
    assert gx.parameters["random_walk"]["N"].q95 == found["axes"]["gx"]["parameters"]["random_walk"]["N"]["q95"] == 1.2
    assert (gx.law, gx.bias_now.mean, gx.checks["lag"].passed, found.recording.samples) == ("random_walk", 0.5, True, 3)


def test_an_absent_key() -> None:
    """None where it may be absent; else an error, with the reason of an axis without a result."""
    found = Identification(DOCUMENT)
    assert found.axes["gx"].suspicion is None and found.axes["gx"].error is None
    assert found.axes["gy"].error == "too short"
    with pytest.raises(AttributeError, match=r"no 'hypotheses': too short"):
        _ = found.axes["gy"].hypotheses
    with pytest.raises(AttributeError, match=r"'IdentifiedAxis' has no 'hypothesis'$"):
        _ = found.axes["gx"].hypothesis
    assert "hypothesis" not in dir(found.axes["gx"]) and "parameters" in dir(found.axes["gx"])


def test_findings_and_changes() -> None:
    axis = {"unit": "deg/s", "verdict": "adequate", "findings": [{"cause": "step", "when": [1.0, 2.0], "gain": None}]}
    diagnosis = Diagnosis({"schema": "selfcal.diagnose/1", "recording": {}, "axes": {"gx": axis}, "model": {}})
    (finding,) = diagnosis.axes["gx"].findings
    assert isinstance(finding, Finding) and finding.cause == "step" and finding.gain is None
    changes = [{"from": "a", "to": "b", "quantity": "N"}]
    comparison = Comparison({"schema": "selfcal.compare/1", "axes": {"gx": changes}, "verdicts": {}})
    assert comparison.axes["gx"] == changes
    pytest.importorskip("pandas")
    part = Comparison({"axes": {"gx": changes, "gy": {"error": "too short", "changes": changes}}})
    assert part.to_frame().fillna("").to_dict("list") == {
        "axis": ["gx", "gy", "gy"],
        "from": ["a", "", "a"],
        "to": ["b", "", "b"],
        "quantity": ["N", "", "N"],
        "error": ["", "too short", ""],
    }


def test_a_frame_has_each_number_of_each_finding() -> None:
    """Value, deviation, unit and evidence; what acts on all axes together has no finding of an axis."""
    pytest.importorskip("pandas")
    size = {"median": -0.4, "sd": 0.02, "unit": "deg/s"}
    own = {"cause": "step", "of": "step", "evidence_gain_nats": 31.0, "net_nats": 22.5}
    axis = {"verdict": "inadequate", "findings": [{**own, "estimate": {"amplitude": size, "form": "static"}}]}
    events = [
        {"id": "step", "material": True, "axes": {"gx": {}}},
        {
            **{"id": "hidden_input", "cause": "hidden_input", "material": False, "evidence_nats": 70.0},
            **{"net_nats": 60.0, "estimate": {"time_constant_s": 44.0}},
            "axes": {"gx": {"estimate": {"loading": size}}},
        },
    ]
    frame = Diagnosis({"axes": {"gx": axis, "gy": {"error": "too short"}}, "findings": events}).to_frame()
    columns = ["axis", "of", "material", "evidence_gain_nats", "net_nats", "key", "median", "sd", "unit", "value"]
    step, hidden = ("gx", "step", True, 31.0, 22.5), ("gx", "hidden_input", False, 70.0, 60.0)
    assert frame[columns].astype(object).where(frame[columns].notna(), None).to_numpy().tolist() == [
        [*step, "amplitude", -0.4, 0.02, "deg/s", None],
        [*step, "form", None, None, None, "static"],
        [*hidden, "time_constant_s", 44.0, None, None, None],
        [*hidden, "loading", -0.4, 0.02, "deg/s", None],
        ["gy", *[None] * 9],
    ]
