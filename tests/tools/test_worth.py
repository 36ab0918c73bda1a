"""What self-calibration is worth: the other ways by hand, the bank against what it states."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from selfcal.base.errors import UserError
from selfcal.base.units import STANDARD_GRAVITY
from selfcal.model.file import Model
from selfcal.model.simulated_parts import SHEET_N, TURN_ON, simulate_axis
from selfcal.studies.worth import (
    CORNER_HZ,
    LAST_S,
    RECKONED_S,
    SECONDS,
    heading_error,
    position_error,
    predictions,
    show,
)
from selfcal.verbs.worth import worth

from conftest import ROOT, run

SHIPPED = ROOT / "tests" / "data" / "simulated_adis16405.npz"


def test_the_other_ways_by_hand() -> None:
    """Each filter as a loop over the readings."""
    y, _ = simulate_axis("random_walk", 60, 3)
    found, sd = predictions(Model.load(), "gx", y)
    assert {name: set(bias) for name, bias in found.items() if name in ("none", "rest", "last")} == {
        "none": {0.0},
        "rest": {y.mean()},
        "last": {y[-LAST_S:].mean()},
    }
    gain = 1.0 - math.exp(-2.0 * math.pi * CORNER_HZ)
    level = y[0]
    for value in y:
        level += gain * (value - level)
    assert found["exponential"] == pytest.approx([level] * len(SECONDS))
    # The gain of the filter's own recursion, once it has settled.
    p, r, q = 1.0, SHEET_N["deg/s"] ** 2, 0.007**2 / 100.0
    for _ in range(1000):
        p = p - p * p / (p + r) + q
    level = y[0]
    for value in y:
        level += p / (p + r) * (value - level)
    assert found["kalman"] == pytest.approx([level] * len(SECONDS))
    assert all(a < b for a, b in pairwise(sd))


def test_simulated_readings_have_their_law() -> None:
    """Over 400 parts: the turn-on bias, and the white noise about the bias; a share of 400 has an sd of 3.5 %."""
    pairs = [simulate_axis("gauss_markov", 50, seed) for seed in range(400)]
    assert np.std([bias[0] for _, bias in pairs]) == pytest.approx(TURN_ON["deg/s"], rel=0.15)
    assert np.std([y - bias for y, bias in pairs]) == pytest.approx(0.04, rel=0.03)
    drift = np.array([bias - bias.mean() for _, bias in pairs])
    correlated = np.mean(np.diff(drift, axis=1) ** 2)
    assert correlated == pytest.approx(2.0 * 0.02**2 * -math.expm1(-1.0 / 200.0), rel=0.05)


def test_dead_reckoning_in_closed_form() -> None:
    """Of errors that stand still: psi = w T, p = g w T^3 / 6 + a T^2 / 2. Of white noise, in continuous time: sd of psi
    N sqrt(T), of p sqrt(g^2 N^2 T^5 / 20 + Na^2 T^3 / 3). Steps of a second change that by a few 1 / T^2. An rms of
    4000 has an sd of 1.1 %, and 4 % are nearly four."""
    still, t = np.ones(RECKONED_S), float(RECKONED_S)
    assert heading_error(0.02 * still) == pytest.approx(0.02 * t)
    expected = STANDARD_GRAVITY * math.radians(0.02) * t**3 / 6.0 + 0.3 * t**2 / 2.0
    assert position_error(0.02 * still, 0.3 * still) == pytest.approx(expected)
    rng = np.random.default_rng(5)
    n, na = 0.01, 0.1
    noise = [(n * rng.standard_normal(RECKONED_S), na * rng.standard_normal(RECKONED_S)) for _ in range(4000)]
    assert np.std([heading_error(rate) for rate, _ in noise]) == pytest.approx(n * math.sqrt(t), rel=0.04)
    sd = math.sqrt((STANDARD_GRAVITY * math.radians(n)) ** 2 * t**5 / 20.0 + na**2 * t**3 / 3.0)
    assert np.std([position_error(*one) for one in noise]) == pytest.approx(sd, rel=0.04)


def test_of_simulated_parts(tmp_path: Path) -> None:
    """30 rests of each law and length. The mean of a constant bias has the error N / sqrt(T): 4 sd of an rms of 30 are
    half of it. Over the minute this error turns the heading by its 60 s, beside the white noise, which alone is there
    where the bias is known. Nothing is worse than no correction. The bank is never worse than the last seconds after a
    second."""
    out = tmp_path / "out.json"
    document = worth(records=30, json=out)
    assert json.loads(out.read_text()) == document
    show(document)
    for regret in document["regret"].values():
        for ratio in (regret, regret["heading_deg"], regret["position_m"]):
            assert 1.0 <= ratio["median"] <= ratio["worst"]
    for entry in document["cases"]:
        errors = entry["rms_error"]
        assert entry["rests"] == 30
        assert all(errors["none"]["1"] > 10.0 * errors[name]["1"] for name in errors if name != "none")
        assert errors["bank"]["1"] < errors["last"]["1"]
        if entry["case"] == "constant":
            assert errors["rest"]["1"] == pytest.approx(0.04 / math.sqrt(entry["rest_s"]), rel=0.5)
            heading = entry["dead_reckoning"]["heading_deg"]
            expected = 0.04 * math.sqrt(RECKONED_S + RECKONED_S**2 / entry["rest_s"])
            assert heading["rest"] == pytest.approx(expected, rel=0.5)
            assert heading["known"] == pytest.approx(0.04 * math.sqrt(RECKONED_S), rel=0.5)
        for errors in entry["dead_reckoning"].values():
            assert errors["none"] > 10.0 * errors["bank"] > errors["known"]


def test_of_a_recording() -> None:
    """An hour holds three rests of a minute, two of five and one of thirty with what follows, on each axis. A gyro has
    a heading, an accelerometer a position if the gyro across is there: gx is across ay."""
    document = worth([SHIPPED], axes=["gx", "ax"])
    counts = {(entry["case"], entry["rest_s"]): entry["rests"] for entry in document["cases"]}
    gyro, accel = "recorded gyros", "recorded accelerometers"
    assert counts == {(case, rest): n for case in (gyro, accel) for rest, n in ((60, 3), (300, 2), (1800, 1))}
    reckoned = {entry["case"]: list(entry["dead_reckoning"]) for entry in document["cases"]}
    assert reckoned == {gyro: ["heading_deg"], accel: []}
    across = worth([SHIPPED], axes=["gx", "ay"])
    for entry in across["cases"]:
        assert list(entry["dead_reckoning"]) == (["heading_deg"] if entry["case"] == gyro else ["position_m"])


def test_what_it_refuses(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("t[s],gx[deg/s]\n" + "".join(f"{k},{0.1 * (k * 7 % 5)}\n" for k in range(300)))
    with pytest.raises(UserError, match="the recordings are too short: 1090 s without a gap are needed; record longer"):
        worth([log])
    done = run("worth", "--records", "1")
    assert (done.returncode, done.stderr) == (2, "selfcal: error: --records must be at least 2\n")
