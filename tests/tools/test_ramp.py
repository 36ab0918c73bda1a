"""A known disturbance that a drift may take for its own: the interval of its coefficient, law by law of the drift."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import yaml
from drifts import assert_held
from numpy.typing import NDArray
from scipy.signal import lfilter

from selfcal.bank.library import Bank
from selfcal.bank.subsets import combine
from selfcal.logs.recording import as_float
from selfcal.model.file import DEFAULT, Model
from selfcal.model.regressors import choices_of, mask_of
from selfcal.model.tables import make_tables

from conftest import case_records

Floats = NDArray[np.float64]
#: Prior sd of the slope, deg/s per s.
SD = 1e-5


def walk(random: np.random.Generator, n: int) -> Floats:
    return math.exp(random.uniform(math.log(1e-4), math.log(1e-3))) * random.standard_normal(n).cumsum()


def markov(random: np.random.Generator, n: int) -> Floats:
    """Times of a sixth of the record and more: a ramp's coefficient is as open as beside a walk."""
    sigma = math.exp(random.uniform(math.log(0.005), math.log(0.05)))
    phi = math.exp(-1.0 / math.exp(random.uniform(math.log(600.0), math.log(5000.0))))
    steps = sigma * math.sqrt(1.0 - phi**2) * random.standard_normal(n)
    steps[0] = sigma * random.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -phi], steps))


@pytest.mark.parametrize("drift", [walk, markov])
def test_a_ramp_is_held_beside_each_drift(drift: Callable[[np.random.Generator, int], Floats]) -> None:
    """An hour at 1 Hz, slopes drawn from their prior. An average over the laws holds 77 % beside a walk."""
    tree = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["regressors"] = [{"name": "ramp", "kind": "time", "sd": {"gyro": SD}}]
    model = Model.of_tree(tree, DEFAULT)
    tables, choices = make_tables(model, 1.0, ("gx",)), choices_of(model.regressors)
    random, n = np.random.default_rng([45, len(drift.__name__)]), 3600
    time_s, held = np.arange(n, dtype=float), []
    for _ in range(case_records(30, 300)):
        slope = SD * random.standard_normal()
        y = 0.1 + drift(random, n) + 0.04 * random.standard_normal(n) + slope * time_s
        bank = Bank(tables)
        bank.push(as_float(y)[:, None], None, as_float(time_s)[:, None])
        results = [bank.report(0, mask_of(model.regressors, choice)) for choice in choices]
        (found,) = combine(choices, results, model.hypotheses, "deg/s").inclusion["ramp"].coefficients
        held.append(found.q05 <= slope <= found.q95)
    assert_held({"ramp": held}, drift.__name__)
