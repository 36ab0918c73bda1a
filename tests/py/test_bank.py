"""The library's bank against the textbook bank of host_sim, node for node.

That one is Eigen, double, with the bias as a state and sigma_v a grid dimension.
The two share no code. Tolerances are those of the design, on equal nodes: for the double build |d ln p| <= 1e-3 and
|dP| <= 1e-6, for the float build |dP| <= 1e-3 and parameter means within 0.02 posterior sd, for the fixed-point builds
|dP| <= 5e-3 and 0.05 sd.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from selfcal import _reference
from selfcal.engines.library import Bank
from selfcal.model import LAWS, PLAIN, Model
from selfcal.tables import make_tables
from selfcal.verbs.montecarlo import draw, simulate_bank_samples

from conftest import shared_recording

LN_P_DOUBLE = 1e-3
PROBABILITY_DOUBLE = 1e-6
PROBABILITY_FLOAT = 1e-3
MEAN_FLOAT = 0.02
PROBABILITY_FIXED = 5e-3
MEAN_FIXED = 0.05
#: Nodes this far below the best carry e^-30 of the weight: their ln p is compared relative to its size instead.
DEPTH = 30.0
#: Records a law and length; the lengths of the issue.
RECORDS = 20
LENGTHS = (10, 100, 1000, 10_000)

MODEL = Model.load()


@dataclass(frozen=True)
class Agreement:
    """Largest differences over the nodes of one record."""

    ln_p: float
    probability: float
    mean: float


def compare(y: NDArray[np.float64], dt_s: float, axis: str, bias_sd: float = 10.0) -> dict[str, Agreement]:
    """Feed `y` (NaN: missing) to the builds of the library and to the textbook bank at the same nodes.

    Flat weights over the nodes, which are the M4F's: 16 + 12 x 12 + 1.
    """
    tables = make_tables(MODEL, 1.0 / dt_s, (axis,), "cortex-m4f")
    tables = replace(tables, axes=(replace(tables.axes[0], range=0.0, bias_sd=bias_sd),))
    banks = {
        "double": Bank(tables, double=True),
        "float": Bank(tables),
        "fixed16": Bank(tables, fixed=16),
        "fixed32": Bank(tables, fixed=32),
    }
    present = np.isfinite(y)
    gaps = np.diff(np.flatnonzero(present), prepend=-1) - 1
    for bank in banks.values():
        bank.push(y[present, None], gaps)
    bank = banks["double"]
    nodes = [bank.raw.node(0, j) for j in range(bank.raw.nodes)]
    law = np.array([node["law"] for node in nodes])
    n = int(present.sum())
    # sigma_v nodes about the conditional mode of the best node, 4 posterior sd either way.
    modes = np.array([math.sqrt(max(node["c"] - node["b"] ** 2 / node["a"], 1e-30) / max(n - 1, 1)) for node in nodes])
    profile = [bank.raw.log_likelihood(0, j, mode) for j, mode in enumerate(modes)]
    best = modes[int(np.argmax(profile))]
    sigma = best * np.exp(np.linspace(-4.0, 4.0, 9) / math.sqrt(2.0 * n))

    rho = np.exp(np.nan_to_num([node["ln_rho"] for node in nodes]))
    alpha = np.exp(np.nan_to_num([node["ln_alpha"] for node in nodes]))
    drift = np.outer(rho, sigma) / np.where(law == 1, math.sqrt(dt_s), 1.0)[:, None]
    offset = float(np.nanmean(y))
    theirs, _, _ = _reference.run_filters(
        y - offset,
        dt_s,
        -offset,
        bias_sd,
        np.repeat(law, sigma.size).astype(np.int32),
        drift.ravel(),
        np.repeat(alpha, sigma.size),
        np.tile(sigma, len(nodes)),
    )
    theirs = theirs.reshape(len(nodes), sigma.size)
    values = (np.broadcast_to(sigma, theirs.shape), drift, np.repeat(alpha, sigma.size).reshape(theirs.shape))
    return {name: _agreement(bank, law, sigma, theirs, values) for name, bank in banks.items()}


def _agreement(
    bank: Bank,
    law: NDArray[np.int64],
    sigma: NDArray[np.float64],
    theirs: NDArray[np.float64],
    values: tuple[NDArray[np.float64], ...],
) -> Agreement:
    ours = np.array([[bank.raw.log_likelihood(0, j, s) for s in sigma] for j in range(len(law))])
    near = theirs > theirs.max() - DEPTH
    weights = [np.exp(ln_p - ln_p.max()) for ln_p in (ours, theirs)]
    weights = [w / w.sum() for w in weights]
    probability = max(abs(float((weights[0] - weights[1])[law == k].sum())) for k in range(len(PLAIN)))
    mean = 0.0
    for k in range(len(PLAIN)):
        if weights[1][law == k].sum() < 1e-3:
            continue
        for value in values:
            a, b = ((value * w)[law == k].sum() / w[law == k].sum() for w in weights)
            sd = math.sqrt(max((weights[1] * (value - b) ** 2)[law == k].sum() / weights[1][law == k].sum(), 0.0))
            if sd > 1e-9 * abs(b):
                mean = max(mean, abs(float(a - b)) / sd)
    return Agreement(float(np.abs(ours - theirs)[near].max()), probability, mean)


def records(law: str, n: int, *, gaps: bool) -> list[NDArray[np.float64]]:
    """Simulated records as the firmware gets them, in float32; with `gaps`, three stretches are missing."""
    group = MODEL.group_of("gx")
    found = []
    for index in range(RECORDS):
        rng = np.random.default_rng([n, index, list(LAWS).index(law)])
        y, _ = simulate_bank_samples(law, draw(group, law, rng), 1.0, n, seed=index)
        y = y.astype(np.float32).astype(np.float64)
        if gaps:
            for start, length in zip(rng.integers(1, n - 1, 3), (1, max(n // 20, 1), max(n // 5, 1)), strict=True):
                y[start : min(start + length, n - 1)] = np.nan
        found.append(y)
    return found


@pytest.mark.parametrize("gaps", [False, True], ids=["whole", "gaps"])
@pytest.mark.parametrize("n", LENGTHS)
@pytest.mark.parametrize("law", PLAIN)
def test_parity_with_the_textbook_bank(law: str, n: int, gaps: bool) -> None:
    found = [compare(y, 1.0, "gx") for y in records(law, n, gaps=gaps)]
    _hold(f"{law} n={n} gaps={gaps}", found)


@pytest.mark.parametrize("law", PLAIN)
def test_parity_at_a_hundred_thousand(law: str) -> None:
    """The stated record length of the 16-bit products, with gaps."""
    _hold(f"{law} n=1e5", [compare(y, 1.0, "gx") for y in records(law, 100_000, gaps=True)[:1]])


@pytest.mark.parametrize("rho", [1e-3, 1e-2, 1e-1, 1.0, 10.0])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_parity_over_rho_and_offsets(rho: float, offset: float) -> None:
    """A random walk of rho = K / N; a bias of a million times the noise, which float32 carries to 0.06 of it."""
    noise = 1e-3 if rho > 0.1 else 0.1
    y, _ = simulate_bank_samples("random_walk", {"N": noise, "K": rho * noise}, 1.0, 10_000, seed=7)
    y = (y + offset * noise).astype(np.float32).astype(float)
    _hold(f"rho {rho:g} offset {offset:g}", [compare(y, 1.0, "gx", max(10.0, offset * noise))])


@pytest.mark.parametrize("axis", ["gx", "gy", "gz", "ax", "ay", "az"])
def test_parity_on_a_real_recording(axis: str) -> None:
    """adis16405_run1, 1 Hz means, 10 000 s."""
    recording = shared_recording("adis16405_run1.npz")
    y = recording.in_unit(axis, MODEL.group_of(axis).unit).reshape(-1, 100).mean(axis=1)
    _hold(f"run1 {axis}", [compare(y.astype(np.float32).astype(np.float64), 1.0, axis)])


def _hold(what: str, found: list[dict[str, Agreement]]) -> None:
    worst = {
        "double d ln p": (max(f["double"].ln_p for f in found), LN_P_DOUBLE),
        "double dP": (max(f["double"].probability for f in found), PROBABILITY_DOUBLE),
        "float dP": (max(f["float"].probability for f in found), PROBABILITY_FLOAT),
        "float d mean / sd": (max(f["float"].mean for f in found), MEAN_FLOAT),
    }
    for build in ("fixed16", "fixed32"):
        worst[f"{build} dP"] = (max(f[build].probability for f in found), PROBABILITY_FIXED)
        worst[f"{build} d mean / sd"] = (max(f[build].mean for f in found), MEAN_FIXED)
    print(f"\n{what}: " + ", ".join(f"{key} {value:.2g} (<= {limit:g})" for key, (value, limit) in worst.items()))
    for key, (value, limit) in worst.items():
        assert value <= limit, key
