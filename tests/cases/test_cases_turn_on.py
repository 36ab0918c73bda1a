"""A bias that settles after power-on: named, its size and time constants held, and no clean record shows one.

Truth: the numbers that each record was drawn with (drifts.py).
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from drifts import noise, recorded

from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.diagnosis.causes import turn_on
from selfcal.likelihood.state import Look
from selfcal.model.file import DEFAULT
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.identify import identify
from selfcal.verbs.replay import replay

from conftest import shared_case


def looked(y: Array, rate: float) -> Look | None:
    state, record = recorded(y, rate)
    return next((look.measured(state) for look in turn_on.looks(state, record)), None)


def drawn(random: np.random.Generator, rate: float, seconds: float) -> tuple[Array, float, float]:
    """A transient [n], its amplitude and time constant: plain ones, 40 nats and more in nearly all records."""
    t = np.arange(round(seconds * rate)) / rate
    tau = math.exp(random.uniform(math.log(20.0), math.log(300.0)))
    amplitude = float(random.choice([-1.0, 1.0])) * random.uniform(0.35, 0.6)
    return amplitude * np.exp(-t / tau), amplitude, tau


def test_the_amplitude_is_the_one_at_the_start_of_the_recording() -> None:
    """A stretch that begins later, and means of several readings, show the same amplitude."""
    random = np.random.default_rng(425)
    t = np.arange(36000) / 10.0
    y = 0.8 * np.exp(-t / 100.0) + noise(random, "walk", t.size, 10.0)
    later, record = recorded(y[300:], 10.0)
    means, of_means = recorded(y.reshape(-1, 50).mean(axis=1), 0.2)
    for state, its in ((later, replace(record, start_s=30.0)), (means, replace(of_means, recorded_hz=10.0))):
        (look,) = (one.measured(state) for one in turn_on.looks(state, its))
        assert abs(look.estimate["amplitude"]["mean"] - 0.8) < 3.0 * look.estimate["amplitude"]["sd"]
        assert look.estimate["amplitude"]["sd"] < 0.03


def test_two_time_constants_are_never_two_huge_ones_that_cancel() -> None:
    """A bump t/tau exp(1 - t/tau) of 0.5 deg/s is the limit of two equal time constants with endless amplitudes. With
    time constants a factor 4 apart the curve of least error has 2.2 times the bump's height on either."""
    for seed, tau in enumerate((40.0, 70.0, 110.0, 180.0)):
        t = np.arange(3600.0)
        y = 0.5 * t / tau * np.exp(1.0 - t / tau) + noise(np.random.default_rng(700 + seed), "walk", t.size, 1.0)
        look = looked(y, 1.0)
        assert look is not None and "tau_2_s" in look.estimate
        assert look.estimate["tau_2_s"]["median"] > 3.9 * look.estimate["tau_s"]["median"]
        assert all(abs(look.estimate[key]["median"]) < 3.0 * 0.5 for key in ("amplitude", "amplitude_2"))


def test_no_time_constant_is_over_before_the_record_begins() -> None:
    """A record from 30 s after power-on on, with a settling of 60 s and a first reading that is off. A time constant of
    2 s would give that reading a million times its size at power-on."""
    t = np.arange(3600.0) + 30.0
    for seed in range(4):
        y = 1.2 * np.exp(-t / 60.0) + noise(np.random.default_rng([427, seed]), "walk", t.size, 1.0)
        y[:2] += (0.4, 0.15)
        state, record = recorded(y, 1.0)
        (look,) = turn_on.looks(state, replace(record, start_s=30.0))
        estimate = look.measured(state).estimate
        assert estimate["tau_s"]["median"] > 0.5 * turn_on.FASTEST  # samples of 1 s; the slower one moves by 2 at most
        assert abs(estimate["amplitude"]["median"]) < 400.0  # exp(30 s / 5 s) readings of 0.4


def test_both_time_constants_lie_in_their_intervals() -> None:
    """Of 6 records 4 and more have each number in its 90 % interval; 1 in 60 would fail by chance."""
    inside = {"tau_s": 0, "tau_2_s": 0, "amplitude": 0, "amplitude_2": 0}
    truth = {"tau_s": 25.0, "tau_2_s": 280.0, "amplitude": 0.9, "amplitude_2": 0.6}
    t = np.arange(3600.0)
    curve = sum(truth[f"amplitude{end}"] * np.exp(-t / truth[f"tau{end}_s"]) for end in ("", "_2"))
    for seed in range(6):
        look = looked(curve + noise(np.random.default_rng(800 + seed), "walk", t.size, 1.0), 1.0)
        assert look is not None
        for key, value in truth.items():
            inside[key] += bool(look.estimate[key]["q05"] <= value <= look.estimate[key]["q95"])
    assert min(inside.values()) >= 4, inside


def coefficient(document: dict[str, Any]) -> dict[str, float]:
    entry = document["axes"]["gx"]["regressors"]["settling"]
    return {key: float(value) for key, value in entry["coefficients"]["settling"].items() if key != "unit"}


def test_a_recording_may_begin_later_than_the_part(tmp_path: Path) -> None:
    """--since-power-on with a file that begins 75.5 s late, or with one that is looked at from there on: the
    coefficient is the amplitude at power-on, on host and module. Without it, what is left of it at the first row."""
    random = np.random.default_rng(426)
    rate, amplitude, tau, late_s = 2.0, 0.8, 120.0, 75.5
    t = np.arange(round(1500 * rate)) / rate
    y = amplitude * np.exp(-t / tau) + 0.04 * math.sqrt(rate) * random.standard_normal(t.size)
    tree = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["regressors"] = [{"name": "settling", "kind": "turn_on", "tau_s": tau, "sd": {"gyro": 2.0}}]
    model = tmp_path / "model.yaml"
    model.write_text(yaml.safe_dump(tree), encoding="utf-8")
    for name, rows in (("whole", y), ("late", y[round(late_s * rate) :])):
        lines = [f"{k / rate!r},{value!r}" for k, value in enumerate(rows.tolist())]
        (tmp_path / f"{name}.csv").write_text("\n".join(["t[s],gx[deg/s]", *lines]) + "\n", encoding="utf-8")
    whole, late = tmp_path / "whole.csv", tmp_path / "late.csv"
    cut, stated = identify(whole, model=model, start_s=late_s), identify(late, model=model, since_power_on_s=late_s)
    assert coefficient(stated) == pytest.approx(coefficient(cut), rel=1e-4)
    assert abs(coefficient(stated)["mean"] - amplitude) < 4.0 * coefficient(stated)["sd"]
    # The prior of the coefficient weighs more where the amplitude is the larger.
    assert coefficient(identify(late, model=model))["mean"] == pytest.approx(
        coefficient(stated)["mean"] * math.exp(-late_s / tau), rel=1e-2
    )
    module = replay(late, model=model, since_power_on_s=late_s)
    assert module["recording"]["since_power_on_s"] == late_s
    close = 0.02 * coefficient(stated)["sd"]
    assert coefficient(module)["mean"] == pytest.approx(coefficient(stated)["mean"], abs=close)
    (finding,) = diagnose(late, since_power_on_s=late_s)["axes"]["gx"]["findings"]
    assert finding["cause"] == "turn_on"
    assert abs(finding["estimate"]["amplitude"]["mean"] - amplitude) < 4.0 * finding["estimate"]["amplitude"]["sd"]


@pytest.mark.parametrize("seconds", [-1.0, math.nan, math.inf])
def test_no_time_since_power_on_is_an_error(seconds: float, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("t[s],gx[deg/s]\n" + "".join(f"{k},{k % 3}\n" for k in range(50)), encoding="utf-8")
    with pytest.raises(UserError, match=r"--since-power-on .*: takes the seconds from power-on"):
        identify(log, since_power_on_s=seconds)


@pytest.mark.parametrize(
    ("case", "amplitude", "tau_s"), [("P31_warmup.py", 0.4, 600.0), ("P31c_warmup_short.py", 0.2, 300.0)]
)
def test_self_heating_without_a_channel_is_a_turn_on(case: str, amplitude: float, tau_s: float, tmp_path: Path) -> None:
    """Amplitude and time constant within 4 sd of 0.4 or 0.2 deg/s, 600 or 300 s."""
    (axis,) = diagnose(shared_case(case, tmp_path), decimate=1.0)["axes"].values()
    found = {finding["cause"]: finding["estimate"] for finding in axis["findings"]}
    assert "turn_on" in found
    for key, truth in (("amplitude", amplitude), ("tau_s", tau_s)):
        assert abs(abs(found["turn_on"][key]["median"]) - truth) < 4.0 * found["turn_on"][key]["sd"]
