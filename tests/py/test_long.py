"""Records of any length: float against double, and double against the textbook bank.

n = 10^6 against the textbook bank node for node, n = 10^7 float against double by the report.
`make soak` sets SELFCAL_SOAK to 10^8, 28 h at 1 kHz.
"""

from __future__ import annotations

import math
import os

import numpy as np
import pytest

from selfcal import _reference
from selfcal.engines.library import Bank
from selfcal.model import Model
from selfcal.tables import make_tables

MODEL = Model.load()
LENGTH = int(float(os.environ.get("SELFCAL_SOAK", "1e7")))
CHUNK = 1_000_000


def chunks(n: int) -> list[tuple[int, int]]:
    """(seed, length) of the pieces of a record."""
    return [(seed, min(CHUNK, n - seed * CHUNK)) for seed in range(math.ceil(n / CHUNK))]


def piece(seed: int, length: int, law: str, state: float) -> tuple[np.ndarray, float]:
    """White noise 0.04 with a drift of sigma_m = alpha = 0.02, or none: float32 [length]; and the drift at its end."""
    rng = np.random.default_rng([seed, 77])
    white = 0.04 * rng.standard_normal(length)
    if law == "constant":
        return (0.3 + white).astype(np.float32), 0.0
    from scipy.signal import lfilter

    phi = math.exp(-0.02)
    steps = 0.02 * math.sqrt(1.0 - phi * phi) * rng.standard_normal(length)
    drift, _ = lfilter([1.0], [1.0, -phi], steps, zi=[phi * state])
    return (0.3 + drift + white).astype(np.float32), float(drift[-1])


@pytest.mark.parametrize("law", ["constant", "gauss_markov"])
def test_float_holds_at_any_length(law: str) -> None:
    """|dP| <= 1e-3 and means within 0.02 sd of the double build: the design's tolerances, here at 10^7."""
    tables = make_tables(MODEL, 1.0, ("gx",), "cortex-m4f")
    banks = [Bank(tables), Bank(tables, double=True)]
    state = 0.0
    for seed, length in chunks(LENGTH):
        y, state = piece(seed, length, law, state)
        for bank in banks:
            bank.push(y[:, None])
    single, double = (bank.report(0) for bank in banks)
    worst = 0.0
    for name, p in double.probability.items():
        assert abs(p - single.probability[name]) <= 1e-3
        if p > 0.01:
            for parameter, exact in double.parameters[name].items():
                worst = max(worst, abs(single.parameters[name][parameter].mean - exact.mean) / exact.sd)
    change = max(abs(single.probability[name] - p) for name, p in double.probability.items())
    print(f"\n{law} n={LENGTH:.0e}: dP {change:.2g}, d mean {worst:.2g} sd")
    assert worst <= 0.02


def test_double_against_the_textbook_at_a_million() -> None:
    """|d ln p| <= 1e-3 at equal nodes: every 20th of the M4F's."""
    n = 1_000_000
    y, _ = piece(0, n, "gauss_markov", 0.0)
    bank = Bank(make_tables(MODEL, 1.0, ("gx",), "cortex-m4f"), double=True)
    bank.push(y[:, None])
    worst = 0.0
    offset = float(y.mean())
    for j in range(0, bank.raw.nodes, 20):
        node = bank.raw.node(0, j)
        sigma = math.sqrt((node["c"] - node["b"] ** 2 / node["a"]) / n)
        drift = 0.0 if node["law"] == 0 else math.exp(node["ln_rho"]) * sigma
        theirs, _, _ = _reference.run_filters(
            y.astype(np.float64) - offset,
            1.0,
            -offset,
            MODEL.group_of("gx").priors["bias"].sd,
            np.array([node["law"]], np.int32),
            np.array([drift]),
            np.array([math.exp(node["ln_alpha"]) if node["law"] == 2 else 1.0]),
            np.array([sigma]),
        )
        worst = max(worst, abs(bank.raw.log_likelihood(0, j, sigma) - float(theirs[0])))
    print(f"\nn={n:.0e}: d ln p {worst:.2g}")
    assert worst <= 1e-3
