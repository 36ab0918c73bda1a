"""What self-calibration is worth: the other ways by hand, the bank against what it states."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from selfcal.errors import UserError
from selfcal.model import Model
from selfcal.verbs.worth import CORNER_HZ, LAST_S, SHEET_N, TURN_ON, predictions, show, simulate, worth

from conftest import ROOT, run

SHIPPED = ROOT / "tests" / "data" / "simulated_adis16405.npz"


def test_the_other_ways_by_hand() -> None:
    """Each filter as a loop over the readings."""
    y, _ = simulate("random_walk", 60, 3)
    found, sd = predictions(Model.load(), "gx", y)
    assert found["none"] == [0.0] * 5
    assert found["rest"] == pytest.approx([y.mean()] * 5)
    assert found["last"] == pytest.approx([y[-LAST_S:].mean()] * 5)
    gain = 1.0 - math.exp(-2.0 * math.pi * CORNER_HZ)
    level = y[0]
    for value in y:
        level += gain * (value - level)
    assert found["exponential"] == pytest.approx([level] * 5)
    # The gain of the filter's own recursion, once it has settled.
    p, r, q = 1.0, SHEET_N["rad/s"] ** 2, 0.007**2 / 100.0
    for _ in range(1000):
        p = p - p * p / (p + r) + q
    level = y[0]
    for value in y:
        level += p / (p + r) * (value - level)
    assert found["kalman"] == pytest.approx([level] * 5)
    assert all(a < b for a, b in pairwise(sd))


def test_simulated_readings_have_their_law() -> None:
    """Over 400 parts: the turn-on bias, and the white noise about the bias; a share of 400 has an sd of 3.5 %."""
    pairs = [simulate("gauss_markov", 50, seed) for seed in range(400)]
    assert np.std([bias[0] for _, bias in pairs]) == pytest.approx(TURN_ON, rel=0.15)
    assert np.std([y - bias for y, bias in pairs]) == pytest.approx(0.04, rel=0.03)
    drift = np.array([bias - bias.mean() for _, bias in pairs])
    correlated = np.mean(np.diff(drift, axis=1) ** 2)
    assert correlated == pytest.approx(2.0 * 0.02**2 * -math.expm1(-1.0 / 200.0), rel=0.05)


def test_of_simulated_parts(tmp_path: Path) -> None:
    """30 rests of each law and length. The mean of a constant bias has the error N / sqrt(T): 4 sd of an rms of 30 are
    half of it. Nothing is worse than no correction. The bank is never worse than the last seconds after a second."""
    out = tmp_path / "out.json"
    document = worth(records=30, json=out)
    assert json.loads(out.read_text()) == document
    show(document)
    assert all(1.0 <= ratio["median"] <= ratio["worst"] for ratio in document["regret"].values())
    for entry in document["cases"]:
        errors = entry["rms_error"]
        assert entry["rests"] == 30
        assert all(errors["none"]["1"] > 10.0 * errors[name]["1"] for name in errors if name != "none")
        assert errors["bank"]["1"] < errors["last"]["1"]
        if entry["case"] == "constant":
            assert errors["rest"]["1"] == pytest.approx(0.04 / math.sqrt(entry["rest_s"]), rel=0.5)


def test_of_a_recording() -> None:
    """An hour holds three rests of a minute, two of five and one of thirty with what follows, on each axis."""
    document = worth([SHIPPED], axes=["gx", "ax"])
    counts = {(entry["case"], entry["rest_s"]): entry["rests"] for entry in document["cases"]}
    gyro, accel = "recorded gyros", "recorded accelerometers"
    assert counts == {(case, rest): n for case in (gyro, accel) for rest, n in ((60, 3), (300, 2), (1800, 1))}


def test_what_it_refuses(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("t[s],gx[deg/s]\n" + "".join(f"{k},{0.1 * (k * 7 % 5)}\n" for k in range(300)))
    with pytest.raises(UserError, match="the recordings are too short: 1090 s without a gap are needed; record longer"):
        worth([log])
    done = run("worth", "--records", "1")
    assert (done.returncode, done.stderr) == (2, "selfcal: error: --records must be at least 2\n")
