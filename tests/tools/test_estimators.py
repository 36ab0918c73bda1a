"""The methods beside `response` on systems of known gain, delay and order, and beside right and wrong answers."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from influences import Drawn, other_axis
from numpy.typing import NDArray
from scipy.signal import lfilter

from selfcal.diagnosis.estimators import (
    METHODS,
    armax,
    arx,
    box_jenkins,
    correlation,
    instruments,
    methods_beside,
    subspace,
)
from selfcal.diagnosis.record import record_from
from selfcal.diagnosis.transfer import late
from selfcal.logs.recording import load
from selfcal.model.file import Model

from conftest import case_records

Array = NDArray[np.float64]
N = 1500


def delay_of(b: list[float], a: list[float]) -> float:
    """Mean delay of B(q) / A(q), steps."""
    return float(np.arange(len(b)) @ b / sum(b) - np.arange(len(a)) @ a / sum(a))


def test_arx_finds_an_arx_system() -> None:
    """Its own kind: the noise passes the poles too. The gain's sd is 0.043, over 60 records; 0.18 is four."""
    b, a = [0.2, 0.5], [1.0, -1.1, 0.3]
    for seed in range(case_records(5, 100)):
        random = np.random.default_rng([7, seed])
        u = random.standard_normal(N)
        found = arx(u, lfilter(b, a, u) + lfilter([1.0], a, 0.1 * random.standard_normal(N)))
        assert found.order >= 2
        assert found.gain == pytest.approx(sum(b) / sum(a), abs=0.18)
        assert found.delay == pytest.approx(delay_of(b, a), abs=0.3)
        assert found.evidence[found.order] == 0.0 and max(found.evidence.values()) == 0.0
        assert found.evidence[1] < -10.0


def test_armax_has_the_noise_that_pulls_arx() -> None:
    """White noise at the output of one pole: the noise of the equation is C = A. ARX is pulled to shorter lags, by far
    more than the sd of the gain, 0.02, and of the delay, 0.4, over 40 records."""
    b, a = [0.0, 0.2], [1.0, -0.9]
    for seed in range(case_records(4, 60)):
        random = np.random.default_rng([10, seed])
        u = lfilter([1.0], [1.0, -0.8], random.standard_normal(N))
        y = lfilter(b, a, u) + 0.8 * random.standard_normal(N)
        for method in (armax, box_jenkins):
            found = method(u, y)
            assert found.values[1][0] == pytest.approx(2.0, abs=0.15)
            assert found.values[1][1] == pytest.approx(delay_of(b, a), abs=1.6)
        assert arx(u, y).values[1][1] < delay_of(b, a) - 2.5


def test_box_jenkins_agrees_with_statsmodels() -> None:
    """One pole beside noise of another pole and a zero: statsmodels' exact likelihood of a regression whose errors are
    ARMA(1, 1), on the input behind the true pole. Half BIC's model has that pole to find: over 12 records the two gains
    differ with an sd of 0.017."""
    from statsmodels.tsa.statespace.sarimax import SARIMAX

    for seed in range(case_records(2, 20)):
        random = np.random.default_rng([11, seed])
        u = lfilter([1.0], [1.0, -0.5], random.standard_normal(N))
        behind = lfilter([0.0, 0.2], [1.0, -0.8], u)
        y = behind + lfilter([1.0, 0.4], [1.0, -0.6], 0.1 * random.standard_normal(N))
        exact = SARIMAX(y, exog=behind, order=(1, 0, 1)).fit(disp=False)
        assert box_jenkins(u, y).values[1][0] == pytest.approx(float(exact.params[0]), abs=0.06)


def _lagged(u: Array, count: int) -> Array:
    return np.array([np.concatenate([np.zeros(k), u[: u.size - k]]) for k in range(count)]).T


def test_instruments_undo_the_noise_of_the_readings() -> None:
    """A noise of half the input's deviation takes a fifth of a gain of 1 in least squares: 1 / (1 + 0.25). The gain by
    instruments has an sd of 0.03. Own arithmetic: the same estimator by the inverse of its normal equations."""
    for seed in range(case_records(4, 60)):
        random = np.random.default_rng([12, seed])
        true = lfilter([math.sqrt(1.0 - 0.9**2)], [1.0, -0.9], random.standard_normal(N))
        read = true + 0.5 * random.standard_normal(N)
        y = true + 0.3 * random.standard_normal(N)
        assert float(read @ y / (read @ read)) == pytest.approx(0.8, abs=0.06)
        found = instruments(read, y).values[0][0]
        assert found == pytest.approx(1.0, abs=0.12)
        ahead = np.array([np.append(read[k:], np.zeros(k)) for k in range(1, 7)]).T
        Z = np.hstack([ahead, _lagged(read, 7)[:, 1:]])[12:-6]
        X = read[12:-6, None]
        first = np.linalg.inv(Z.T @ Z) @ Z.T @ X
        own = float((first.T @ Z.T @ y[12:-6])[0] / (first.T @ Z.T @ Z @ first)[0, 0])
        assert found == pytest.approx(own, rel=1e-9)


def test_correlation_finds_a_weighting_function() -> None:
    h = np.array([0.4, 0.3, 0.0, -0.1, 0.2])
    for seed in range(case_records(5, 100)):
        random = np.random.default_rng([8, seed])
        u = lfilter([1.0], [1.0, -0.6], random.standard_normal(N))
        found = correlation(u, lfilter(h, [1.0], u) + 0.2 * random.standard_normal(N))
        assert found.order == 8  # the least of its numbers that has five taps
        assert found.gain == pytest.approx(h.sum(), abs=0.04)
        assert found.delay == pytest.approx(float(np.arange(5) @ h / h.sum()), abs=0.3)


@pytest.mark.parametrize(
    ("b", "a"),
    [([0.8], [1.0]), ([0.1, 0.1], [1.0, -0.75]), ([0.0, 0.3, 0.1], [1.0, -1.4, 0.65])],
    ids=["static", "lag", "oscillation"],
)
def test_subspace_finds_the_order_of_a_system(b: list[float], a: list[float]) -> None:
    """White noise at the output. Half BIC takes a higher order than the true one in about one of 20 records."""
    count = case_records(6, 100)
    orders = []
    for seed in range(count):
        random = np.random.default_rng([9, seed])
        u = random.standard_normal(N)
        found = subspace(u, lfilter(b, a, u) + 0.2 * random.standard_normal(N))
        orders.append(found.order)
        assert found.gain == pytest.approx(sum(b) / sum(a), abs=0.1)
        assert found.delay == pytest.approx(delay_of(b, a), abs=0.5)
    assert min(orders) >= len(a) - 1
    assert orders.count(len(a) - 1) >= 0.8 * count


def test_an_answer_is_explained_or_not(tmp_path: Path) -> None:
    """A right answer explains 19 of 20 methods. Of one with twice the lag or 0.8 of the gain five of six say no."""
    agreed = {"right": 0, "lag": 0, "gain": 0}
    count = case_records(1, 50)
    for seed in range(count):
        drawn = Drawn(seed)
        other_axis(drawn)
        model = Model.load(None)
        record = record_from(load(drawn.write(tmp_path / "log.npz")), model, None, ("gx", "gy"))
        u = record.axes["gy"].y
        state = record.axes["gx"]
        _, fit = state.refit().with_columns(late(u, 8.0, 1.0)[None])
        for key, gain, lag in (("right", 0.3, 8.0), ("lag", 0.3, 16.0), ("gain", 0.24, 8.0)):
            found = methods_beside(state, fit, u, u, np.tile(gain * late(u, lag, 1.0), (20, 1)), np.zeros(u.size), 3)
            agrees = sum(all(one.within) for one in found.values())
            agreed[key] += agrees
            assert key == "right" or agrees <= 1
    assert agreed["right"] >= 0.95 * count * len(METHODS) - 2.0 * math.sqrt(0.05 * count * len(METHODS))
