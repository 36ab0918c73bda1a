"""A lamp that is switched on and off: one pulse, named as one, and no clean record shows one.

Truth: the numbers that each record was drawn with (drifts.py).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from drifts import noise, recorded
from scipy.signal import lfilter

from selfcal.base.grid import Array
from selfcal.diagnosis.loop import diagnose_record
from selfcal.likelihood import edges

from conftest import case_records

SECONDS = 2400.0


def drawn(random: np.random.Generator, rate: float) -> tuple[Array, float, float, float]:
    """A pulse [n] of some 40 to 100 nats net of its search, its start, length and amplitude."""
    t = np.arange(round(SECONDS * rate)) / rate
    length = math.exp(random.uniform(math.log(40.0), math.log(400.0)))
    start = random.uniform(150.0, SECONDS - length - 150.0)
    amplitude = float(random.choice([-1.0, 1.0])) * 0.12 * (100.0 / length) ** 0.3 * random.uniform(1.0, 1.4)
    return np.where((t >= start) & (t < start + length), amplitude, 0.0), start, length, amplitude


def test_two_steps_of_unlike_sizes_are_no_pulse() -> None:
    random = np.random.default_rng(433)
    t = np.arange(SECONDS)
    for _ in range(case_records(1, 40)):
        y = noise(random, "walk", t.size, 1.0) + 0.3 * (t >= 800.0) - 0.12 * (t >= 1500.0)
        one = diagnose_record(recorded(y, 1.0)[1], ["gx"])["gx"]
        assert "pulse" not in [finding.look.cause for finding in one.findings]
        assert [finding.look.cause for finding in one.findings][:1] == ["step"]


def test_a_pulse_that_no_drift_can_judge_has_the_fit_as_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each drift forgets too fast to know either place: the estimate is the fit's."""
    random = np.random.default_rng(435)
    shape, start, length, _ = drawn(random, 1.0)
    state, _ = recorded(noise(random, "walk", shape.size, 1.0) + shape, 1.0)
    begin, end = math.ceil(start), math.ceil(start + length)
    _, fit = state.with_columns((np.arange(shape.size) >= begin) * 1.0 - (np.arange(shape.size) >= end))
    none = edges.Scan(*np.zeros((3, shape.size)), 0.0, 0.0)
    monkeypatch.setattr(edges, "edge", lambda *_: none)
    found = edges.posterior((begin, end), state)
    assert found["amplitude"]["mean"] == pytest.approx(fit.c[-1])
    assert found["duration_s"]["mean"] == pytest.approx(end - begin)


def test_a_pulse_is_no_curve_of_a_temperature_that_rises() -> None:
    """Whatever happens once is a curve of that too."""
    t = np.arange(SECONDS)
    for seed in range(2, 2 + case_records(1, 20)):
        random = np.random.default_rng(seed)
        length = math.exp(random.uniform(math.log(40.0), math.log(400.0)))
        start = random.uniform(150.0, SECONDS - length - 150.0)
        shape = 0.3 * random.uniform(0.7, 1.6) * ((t >= start) & (t < start + length))
        _, record = recorded(noise(random, "walk", t.size, 1.0) + shape, 1.0)
        warm = 20.0 + 8.0 * t / SECONDS + 0.3 * np.sin(t / 700.0) + 0.005 * random.standard_normal(t.size)
        record = replace(record, channels={"temperature": warm}, channel_names={"temperature": "temp"})
        first = diagnose_record(record, ["gx"])["gx"].by_gain[0].look
        assert first.cause == "pulse"
        assert abs(first.estimate["time_s"]["median"] - start) < 3.0  # seconds: the readings are a second apart


def test_a_pulse_beside_a_line_that_wanders_and_coloured_noise() -> None:
    """Two noises high, over a minute to five: 20 nats net of its search and more, where 9.7 are asked for."""
    n, decay = 5000, math.exp(-1.0 / 80.0)
    t = np.arange(n)
    for seed in range(case_records(1, 20)):
        random = np.random.default_rng([436, seed])
        white, turn = random.standard_normal(n + 1), 2.0 * math.pi * random.uniform(0.05, 0.3)
        line = lfilter([1.0], [1.0, -2.0 * decay * math.cos(turn), decay**2], random.standard_normal(n))
        length, start = random.uniform(60.0, 300.0), random.uniform(500.0, 4000.0)
        y = white[1:] + 0.3 * white[:-1] + 0.6 * line / line.std() + 2.0 * ((t >= start) & (t < start + length))
        _, record = recorded(0.04 * (y + 0.005 * np.cumsum(random.standard_normal(n))), 1.0)
        found = {finding.look.cause: finding.look for finding in diagnose_record(record, ["gx"])["gx"].findings}
        assert {"pulse", "periodic"} <= found.keys() and "step" not in found
        assert abs(found["pulse"].estimate["time_s"]["median"] - start) < 8.0  # readings: the noise hides the edge
