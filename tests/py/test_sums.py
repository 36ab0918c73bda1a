"""Laws that are sums (flicker; random walk beside moving-average white noise): model models/sums.yaml.

Judges: the textbook bank of host_sim, which shares no code with lib/ and has the terms as states of its filter, and the
same report on dense nodes. Tolerances are those of the design (test_bank.py, test_report.py).
"""

from __future__ import annotations

import math
import os
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from selfcal import _reference
from selfcal.engines.library import Bank
from selfcal.model import DEFAULT, LAWS, SUMS, Model
from selfcal.tables import RegressorTable, Tables, make_grid, make_tables
from selfcal.verbs.montecarlo import draw, simulate_bank_samples

from conftest import worst_difference

LN_P_DOUBLE, PROBABILITY_DOUBLE = 1e-3, 1e-6
#: |dP| and |d mean| / sd of each build.
BUILDS = {"float": (1e-3, 0.02), "fixed16": (5e-3, 0.05)}
#: Nodes this far below the best carry e^-30 of the weight.
DEPTH = 30.0

MODEL = Model.load(DEFAULT.parent / "sums.yaml")
GROUP = MODEL.group_of("gx")
#: Records a law.
DRAWS = int(os.environ.get("SELFCAL_DRAWS", "1"))


def tables(target: str = "host", columns: int = 0, only: str | None = None, pair: tuple[int, int] | None = None) -> Tables:
    """gx at 1 Hz, without a range, with regressors of standard deviation 10 a unit. `only` one law, on `pair` nodes."""
    made = make_tables(MODEL, 1.0, ("gx",), target)
    hypotheses = made.hypotheses
    if only is not None:
        hypotheses = tuple(replace(h, ln_probability=0.0) for h in hypotheses if h.name == only)
    if pair is not None:
        hypotheses = tuple(replace(h, rho=make_grid(pair[0]), alpha=make_grid(pair[1])) for h in hypotheses)
    return replace(
        made,
        axes=(replace(made.axes[0], range=0.0),),
        hypotheses=hypotheses,
        regressors=tuple(RegressorTable(f"z{k}", "1", 0.0, (10.0,)) for k in range(columns)),
    )


def a_record(law: str, n: int, seed: int, *, gaps: bool = False) -> NDArray[np.float64]:
    """float64[n] in float32's values, parameters from the priors; with `gaps`, three stretches are missing."""
    rng = np.random.default_rng([n, seed, list(LAWS).index(law)])
    y, _ = simulate_bank_samples(law, draw(GROUP, law, rng), 1.0, n, seed=seed)
    y = y.astype(np.float32).astype(np.float64)
    if gaps:
        for start, length in zip(rng.integers(1, n - 1, 3), (1, max(n // 20, 1), max(n // 5, 1)), strict=True):
            y[start : min(start + length, n - 1)] = np.nan
    return y


def push(bank: Bank, y: NDArray[np.float64], z: NDArray[np.float64] | None = None) -> None:
    have = np.isfinite(y)
    missing = np.diff(np.flatnonzero(have), prepend=-1) - 1
    bank.push(y[have, None], missing, None if z is None else z[have])


# ------------------------------------------------------------------------------------------------- against the textbook


def textbook(
    y: NDArray[np.float64],
    nodes: list[dict[str, float]],
    sigma: NDArray[np.float64],
    z: NDArray[np.float64] | None,
) -> NDArray[np.float64]:
    """ln p [nodes, sigma] by the textbook, law by law."""
    offset = float(np.nanmean(y))
    found = np.empty((len(nodes), sigma.size))
    laws = np.array([node["law"] for node in nodes])
    for law in np.unique(laws):
        mine = [node for node in nodes if node["law"] == law]
        rho = np.exp(np.nan_to_num([node["ln_rho"] for node in mine]))
        alpha = np.exp(np.nan_to_num([node["ln_alpha"] for node in mine]))
        ln_p, _, _ = _reference.run_filters(
            y - offset,
            1.0,
            -offset,
            GROUP.priors["bias"].sd,
            np.full(rho.size * sigma.size, law, np.int32),
            np.outer(rho, sigma).ravel(),
            np.repeat(alpha, sigma.size),
            np.tile(sigma, rho.size),
            z=z,
            coefficient_sd=None if z is None else np.full(z.shape[1], 10.0),
        )
        found[laws == law] = ln_p.reshape(-1, sigma.size)
    return found


def differences(
    ours: NDArray[np.float64], theirs: NDArray[np.float64], nodes: list[dict[str, float]], sigma: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Largest |d ln p| near the best node, |dP| of a law, |d mean| / sd of a parameter, under flat weights."""
    near = theirs > theirs.max() - DEPTH
    weights = [np.exp(ln_p - ln_p.max()) for ln_p in (ours, theirs)]
    weights = [w / w.sum() for w in weights]
    laws = np.array([node["law"] for node in nodes])
    rho, alpha = (np.exp(np.nan_to_num([node[key] for node in nodes])) for key in ("ln_rho", "ln_alpha"))
    values = (np.broadcast_to(sigma, theirs.shape), np.outer(rho, sigma), np.repeat(alpha[:, None], sigma.size, 1))
    probability = mean = 0.0
    for law in range(len(LAWS)):
        a, b = (w[laws == law] for w in weights)
        probability = max(probability, abs(float(a.sum() - b.sum())))
        if b.sum() < 1e-3:
            continue
        for value in values:
            x = value[laws == law]
            exact = float((b * x).sum() / b.sum())
            sd = math.sqrt(max(float((b * (x - exact) ** 2).sum() / b.sum()), 0.0))
            if sd > 1e-9 * abs(exact):
                mean = max(mean, abs(float((a * x).sum() / a.sum()) - exact) / sd)
    return float(np.abs(ours - theirs)[near].max()), probability, mean


@pytest.mark.parametrize("columns", [0, 2])
@pytest.mark.parametrize("gaps", [False, True], ids=["whole", "gaps"])
@pytest.mark.parametrize("n", [10, 100, 1000, 10_000])
def test_parity_with_the_textbook_bank(n: int, gaps: bool, columns: int) -> None:
    """All five laws in one bank, on records of the sums and of a random walk; with regressors, all of them in use."""
    worst: dict[str, float] = {}
    made = tables("cortex-m0", columns)
    for law in (*SUMS, "random_walk") if n < 10_000 else SUMS:
        for seed in range(DRAWS):
            y = a_record(law, n, seed, gaps=gaps)
            t = np.arange(float(n))
            z = np.column_stack([t / n, np.sin(0.01 * t)])[:, :columns].astype(np.float32).astype(np.float64)
            y += z.sum(axis=1)
            y = y.astype(np.float32).astype(np.float64)
            used = np.ascontiguousarray(z) if columns else None
            banks = {"double": Bank(made, double=True), "float": Bank(made)}
            if not columns:
                banks["fixed16"] = Bank(made, fixed=16)
            for bank in banks.values():
                push(bank, y, used)
            nodes = [banks["double"].raw.node(0, j) for j in range(made.nodes)]
            residual = [(node["c"] - node["b"] ** 2 / node["a"]) / max(n - 1, 1) for node in nodes]
            level = math.sqrt(max(min(residual), 1e-30))
            if columns:  # the residual has the regressors in it
                level = float(np.nanstd(np.diff(y)) / math.sqrt(2.0))
            sigma = level * np.exp(np.linspace(-4.0, 4.0, 5) / math.sqrt(2.0 * n))
            theirs = textbook(y, nodes, sigma, used)
            for name, bank in banks.items():
                ours = np.array(
                    [[bank.raw.log_likelihood_subset(0, j, 2**columns - 1, s) for s in sigma] for j in range(len(nodes))]
                )
                ln_p, p, mean = differences(ours, theirs, nodes, sigma)
                for key, value in ((f"{name} d ln p", ln_p), (f"{name} dP", p), (f"{name} d mean/sd", mean)):
                    worst[key] = max(worst.get(key, 0.0), value)
    print(f"\nn={n} gaps={gaps} regressors={columns}: " + ", ".join(f"{key} {value:.2g}" for key, value in worst.items()))
    assert worst["double d ln p"] <= LN_P_DOUBLE
    assert worst["double dP"] <= PROBABILITY_DOUBLE
    for name, (p_limit, mean_limit) in BUILDS.items():
        assert worst.get(f"{name} dP", 0.0) <= p_limit
        assert worst.get(f"{name} d mean/sd", 0.0) <= mean_limit
