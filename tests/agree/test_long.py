"""Records of any length: float and fixed point against double, and double against the textbook bank.

n = 10^6 against the textbook bank node for node, n = 3 10^6 float against double by the report (a constant bias 10^6).
`make soak` sets SELFCAL_SOAK to 10^8, 28 h at 1 kHz, for both.
"""

from __future__ import annotations

import dataclasses
import math
import os

import numpy as np
import pytest

from selfcal import _reference
from selfcal.bank.library import Bank
from selfcal.model.file import Model
from selfcal.model.tables import make_tables
from selfcal.wire.c_tables import coarsest_exponent

from conftest import worst_difference

MODEL = Model.load()
SOAK = os.environ.get("SELFCAL_SOAK")
LENGTH = {law: int(float(SOAK or length)) for law, length in {"constant": "1e6", "gauss_markov": "3e6"}.items()}
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


@pytest.mark.parametrize("law", LENGTH)
def test_float_holds_at_any_length(law: str) -> None:
    """|dP| <= 1e-3 and means within 0.02 sd of the double build: the design's tolerances, at 3 10^6; `make soak`:
    10^8."""
    tables = make_tables(MODEL, 1.0, ("gx",), "cortex-m4f")
    banks = [Bank(tables), Bank(tables, build="_library64")]
    state = 0.0
    for seed, length in chunks(LENGTH[law]):
        y, state = piece(seed, length, law, state)
        for bank in banks:
            bank.push(y[:, None])
    _, change, worst, _ = worst_difference(*(bank.report(0) for bank in banks))
    print(f"\n{law} n={LENGTH[law]:.0e}: dP {change:.2g}, d mean {worst:.2g} sd")
    assert change <= 1e-3
    assert worst <= 0.02


@pytest.mark.parametrize("law", ["constant", "gauss_markov"])
def test_fixed_point_holds_at_its_stated_length(law: str) -> None:
    """|dP| <= 5e-3 and means within 0.05 sd of the double build, and nothing had to be rescaled."""
    tables = make_tables(MODEL, 1.0, ("gx",), "cortex-m0")
    banks = [Bank(tables, build="_fixed"), Bank(tables, build="_library64")]
    y, _ = piece(0, 1_000_000, law, 0.0)
    for bank in banks:
        bank.push(y[:, None])
    _, change, worst, _ = worst_difference(*(bank.report(0) for bank in banks))
    print(f"\nfixed point, {law} n=1e6: dP {change:.2g}, d mean {worst:.2g} sd")
    assert change <= 5e-3
    assert worst <= 0.05
    assert banks[0].raw.scale(0)["coarser"] == 0


@pytest.mark.parametrize("half_period", [1, 16, 500, 20_000])
def test_fixed_point_holds_at_the_bound(half_period: int) -> None:
    """Readings that swing from end to end of the number format, so that |nu| comes to its bound at every node with
    1/g above the half period: a sum that wrapped would be off by its whole format, not by its resolution.

    B and C of every node against the double build: a step is 2^-27 of the swing, rounded gains 4e-6 of themselves.
    """
    tables = make_tables(MODEL, 1.0, ("gx",), "cortex-m0")
    rng = np.random.default_rng(5)
    noise = (0.04 * rng.standard_normal(16)).astype(np.float32)
    banks = [Bank(tables, build="_fixed"), Bank(tables, build="_library64")]
    for bank in banks:
        bank.push(noise[:, None])
    banks[0].raw.node(0, 0)  # runs the batch
    scale = banks[0].raw.scale(0)
    bound = 3 * 2**25 * 2.0 ** scale["exponent"]
    assert bound > 20 * 0.04
    swing = noise[0] + bound * np.where(np.arange(1_000_000 - 16) // half_period % 2 == 0, 1.0, -1.0) * (1.0 - 1e-6)
    for bank in banks:
        bank.push(swing.astype(np.float32)[:, None])
    worst_b, worst_c = 0.0, 0.0
    for j in range(banks[0].raw.nodes):
        ours, exact = (bank.raw.node(0, j) for bank in banks)
        worst_c = max(worst_c, abs(ours["c"] / exact["c"] - 1.0))
        worst_b = max(worst_b, abs(ours["b"] - exact["b"]) / math.sqrt(exact["a"] * exact["c"]))
    after = banks[0].raw.scale(0)
    print(f"\nfixed point, half period {half_period}: C to {worst_c:.1g}, B to {worst_b:.1g}, {after}")
    assert worst_c <= 1e-4
    assert worst_b <= 1e-4
    assert (after["exponent"], after["coarser"]) == (scale["exponent"], 0)
    assert after["most_y"] > 0.999 * 3 * 2**25


def test_double_against_the_textbook_at_a_million() -> None:
    """|d ln p| <= 1e-3 at equal nodes: every 20th of the M4F's."""
    n = 1_000_000
    y, _ = piece(0, n, "gauss_markov", 0.0)
    bank = Bank(make_tables(MODEL, 1.0, ("gx",), "cortex-m4f"), build="_library64")
    bank.push(y[:, None])
    worst = 0.0
    offset = float(y.mean())
    for j in range(0, bank.raw.nodes, 20):
        node = bank.raw.node(0, j)
        sigma = math.sqrt((node["c"] - node["b"] ** 2 / node["a"]) / n)
        law = bank.tables.hypotheses[int(node["hypothesis"])].law
        drift = math.exp(node["ln_rho"]) * sigma if law.terms else 0.0
        theirs, _, _ = _reference.run_filters(
            y.astype(np.float64) - offset,
            1.0,
            -offset,
            MODEL.group_of("gx").priors["bias"].sd,
            [law.as_tuple],
            np.zeros(1, np.int32),
            np.array([drift]),
            np.array([math.exp(node["ln_alpha"]) if law.has_alpha else 1.0]),
            np.array([sigma]),
        )
        worst = max(worst, abs(bank.raw.log_likelihood(0, j, sigma) - float(theirs[0])))
    print(f"\nn={n:.0e}: d ln p {worst:.2g}")
    assert worst <= 1e-3


@pytest.mark.parametrize("most", [1e-3, 0.5, 1e3, 1e9])
@pytest.mark.parametrize("period", [1, 2, 8])
def test_no_reading_makes_a_step_coarser_than_codegen_says(most: float, period: int) -> None:
    """First batches from end to end of the range, N up to `most`: the step is within 2 of the bound, or finer."""
    tables = make_tables(MODEL, 1.0, ("gx",), "cortex-m0")
    axis = tables.axes[0]
    limits = {"ln_min": (math.log(1e-6), *axis.ln_min[1:]), "ln_max": (math.log(most), *axis.ln_max[1:])}
    axis = dataclasses.replace(axis, **limits)
    tables = dataclasses.replace(tables, axes=(axis,))
    bound = coarsest_exponent(axis, tables.dt_s)
    swing = axis.range * np.where(np.arange(64) // period % 2 == 0, 1.0, -1.0) * (1.0 - 1e-6)
    bank = Bank(tables, build="_fixed")
    bank.push(swing.astype(np.float32)[:, None])
    bank.raw.node(0, 0)  # runs the batches
    found = bank.raw.scale(0)["exponent"]
    assert found <= bound
    assert period > 1 or found >= bound - 1  # every difference is 2 range only there
