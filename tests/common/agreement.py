"""How far the library is from the textbook bank of host_sim, node for node, and its report from one on dense nodes.

What the tests assert on a few records, tolerances.py prints for all: both take it from here. The textbook bank is
Eigen, double, with the bias (and the regressors' coefficients) as states and sigma_v a grid dimension; it shares no
code with lib/. Tolerances are the design's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from selfcal import _library32, _reference
from selfcal.adequacy.drawn import draw_parameters, simulate_bank_samples
from selfcal.bank.axis_result import AxisResult
from selfcal.bank.library import Bank
from selfcal.model.file import DEFAULT, Model, Regressor
from selfcal.model.laws import NAMED, PLACES, SUMS
from selfcal.model.tables import Tables, make_grid, make_tables

from conftest import worst_difference

Floats = NDArray[np.float64]

#: Six columns as a recording has them; priors so that every one moves the reading by some ten times its white noise.
REGRESSORS = (
    Regressor("temperature", "column", "degC", {"gyro": 0.05}, column="temp", reference=25.0),
    Regressor("time", "time", "s", {"gyro": 3e-4}),
    Regressor("step", "step", "1", {"gyro": 0.5}, time_s=0.0),
    Regressor("period", "periodic", "1", {"gyro": 0.3}, frequency_hz=0.01),
    Regressor("supply", "column", "V", {"gyro": 1.0}, column="supply", reference=5.0),
)
#: The model file that offers a law.
MODEL, MODEL_OF_SUMS = Model.load(), Model.load(DEFAULT.parent / "sums.yaml")
#: Nodes this far below the best carry e^-30 of the weight: their ln p is not compared.
DEPTH = 30.0
#: Nodes of rho alone, and of [rho, alpha], where more change a report by 1e-4: tried with 64 and 56 x 56 for the plain.
DENSE, DENSE_PAIR = 48, (40, 40)


@dataclass(frozen=True)
class Agreement:
    """Largest differences: |d ln p| of a node, |dP| of a law, |d mean| over the posterior sd of a parameter."""

    ln_p: float
    probability: float
    mean: float

    def within(self, limit: Agreement) -> bool:
        """False also where one is NaN."""
        return self.ln_p <= limit.ln_p and self.probability <= limit.probability and self.mean <= limit.mean

    @staticmethod
    def worst(found: Iterable[Agreement]) -> Agreement:
        each = np.array([(one.ln_p, one.probability, one.mean) for one in found])
        return Agreement(*(float(value) for value in each.max(axis=0)))  # NaN where one is


#: Of each build against the textbook bank, and the bank samples up to which they are to hold.
LIMITS = {
    "double": Agreement(1e-3, 1e-6, math.inf),
    "float": Agreement(math.inf, 1e-3, 0.02),
    "fixed": Agreement(math.inf, 5e-3, 0.05),
}
LENGTHS = {"double": 10**6, "float": 10**6, "fixed": 10**6}
#: Of a report against one on dense nodes: |d ln evidence|, |d mean| / sd, |sd ratio - 1|.
REPORT_LIMIT = np.array([0.05, 0.05, 0.03])


# --------------------------------------------------------------------------------------------------------------- banks


def model_of(law: str) -> Model:
    """The model file with this law in it."""
    return MODEL_OF_SUMS if law in SUMS else MODEL


def tables_of(
    model: Model,
    target: str = "host",
    columns: int = 0,
    only: str | None = None,
    bias_sd: float | None = None,
    axis: str = "gx",
) -> Tables:
    """An axis at 1 Hz, without a range, with the first `columns` of REGRESSORS; `only` one law."""
    made = make_tables(replace(model, regressors=REGRESSORS if columns else ()), 1.0, (axis,), target)
    one = replace(made.axes[0], range=0.0, bias_sd=made.axes[0].bias_sd if bias_sd is None else bias_sd)
    hypotheses = made.hypotheses
    if only is not None:
        hypotheses = tuple(replace(h, ln_probability=0.0) for h in hypotheses if h.name == only)
    return replace(made, axes=(one,), hypotheses=hypotheses, regressors=made.regressors[:columns])


def on_nodes(tables: Tables, alone: int, pair: tuple[int, int]) -> Tables:
    """The same on other nodes: of rho alone, and of [rho, alpha]."""
    hypotheses = []
    for h in tables.hypotheses:
        rho = None if h.rho is None else make_grid(alone if h.alpha is None else pair[0])
        hypotheses.append(replace(h, rho=rho, alpha=None if h.alpha is None else make_grid(pair[1])))
    return replace(tables, hypotheses=tuple(hypotheses))


def dense(tables: Tables) -> Tables:
    """The same on so many nodes that theirs no longer counts; for Bank(build="_dense")."""
    return on_nodes(tables, DENSE, DENSE_PAIR)


#: Compiled modules, by the names of LIMITS's builds.
BUILDS = {"float": "_library32", "double": "_library64", "fixed": "_fixed"}


def a_bank(tables: Tables, build: str) -> Bank:
    """A bank of one of LIMITS's builds."""
    return Bank(tables, build=BUILDS[build])


def push(bank: Bank, y: Floats, z: Floats | None = None) -> None:
    """One axis y [n], NaN where it is missing, with the values z [n, p] of the regressors."""
    have = np.isfinite(y)
    missing = np.diff(np.flatnonzero(have), prepend=-1) - 1
    bank.push(y[have, None], missing, None if z is None else z[have])


# ------------------------------------------------------------------------------------------------------------- records


def assert_prediction_is_that_of_a_gap(tables: Tables, y: Floats, z: Floats | None, horizons: Sequence[int]) -> None:
    """selfcal_predict() so many bank samples ahead against the filters through a gap: 1e-3 of the sd, on both."""
    before = Bank(tables)
    push(before, y, z)
    for horizon, (mean, sd) in zip(horizons, before.raw.predict(0, [float(h) for h in horizons]), strict=True):
        bank = Bank(tables)
        push(bank, y, z)
        bank.raw.skip(horizon)
        after = bank.report(0)
        assert mean == pytest.approx(after.bias_mean, abs=1e-3 * after.bias_sd)
        assert sd == pytest.approx(after.bias_sd, rel=1e-3)


def columns_of(n: int, seed: int) -> Floats:
    """[n, 6] in the order of REGRESSORS, as float32 holds them: a warm-up off its reference, a wandering supply."""
    rng = np.random.default_rng(seed)
    t = np.arange(float(n))
    supply = 5.0 + 0.02 * np.cumsum(rng.normal(size=n)) / math.sqrt(n) + 0.01 * rng.normal(size=n)
    warm = 40.0 - 8.0 * np.exp(-t / (0.3 * n)) + 0.02 * rng.normal(size=n)
    turn = 2.0 * math.pi * 0.01 * t
    z = np.column_stack([warm, t, t >= 0.6 * n, np.sin(turn), np.cos(turn), supply])
    return z.astype(np.float32).astype(np.float64)


def a_record(
    law: str, n: int, seed: int, *, gaps: bool = False, columns: int = 0, offset: float = 0.0, rho: float | None = None
) -> tuple[Floats, Floats | None]:
    """y [n] in float32's values, parameters and the coefficients of z [n, columns] from the priors.

    With `gaps`, three stretches are missing (NaN). `offset` over the white noise is added. `rho` is that of the drift's
    deviation (a walk: of a step) over the white noise instead of the prior's, the other parameters in its middle.
    """
    group = model_of(law).group_of("gx")
    rng = np.random.default_rng([n, seed, list(NAMED).index(law), columns])
    if rho is None:
        truth = draw_parameters(group, law, rng)
    else:
        truth = {name: math.sqrt(group.priors[name].min * group.priors[name].max) for name in NAMED[law].parameters}
        truth |= {"N": 1e-3 if rho > 0.1 else 0.1, "bias": 0.0}
        truth[NAMED[law].parameters[1]] = rho * truth["N"]
    y, _ = simulate_bank_samples(group.laws[law], truth, 1.0, n, seed=seed)
    z = None
    if columns:
        z = columns_of(n, seed)[:, :columns]
        sd = np.array([column.coefficient_sd[0] for column in tables_of(MODEL, columns=columns).regressors])
        y = y + z @ (sd * rng.normal(size=columns))
    y = (y + offset * truth["N"]).astype(np.float32).astype(np.float64)
    if gaps:
        for start, length in zip(rng.integers(1, n - 1, 3), (1, max(n // 20, 1), max(n // 5, 1)), strict=True):
            y[start : min(start + length, n - 1)] = np.nan
    return y, z


# ------------------------------------------------------------------------------------------------ against the textbook


@dataclass(frozen=True)
class Nodes:
    """Some of a bank's, [m]: index in it, hypothesis (index into the tables'), and parameters over sigma_v."""

    index: NDArray[np.int64]
    hypothesis: NDArray[np.int64]
    rho: Floats
    alpha: Floats

    @staticmethod
    def of(bank: Bank, every: int = 1) -> Nodes:
        """Every so many, and those of the constant."""
        views = [bank.raw.node(0, j) for j in range(bank.raw.nodes)]
        index = np.array([j for j, view in enumerate(views) if j % every == 0 or math.isnan(view["ln_rho"])])
        keys = ("hypothesis", "ln_rho", "ln_alpha")
        hypothesis, ln_rho, ln_alpha = (np.array([views[j][key] for j in index]) for key in keys)
        return Nodes(index, hypothesis.astype(np.int64), np.exp(np.nan_to_num(ln_rho)), np.exp(np.nan_to_num(ln_alpha)))

    def values(self, sigma: Floats, tables: Tables) -> tuple[Floats, Floats, Floats]:
        """sigma_v, drift (a walk's as its density) and alpha or ratio of all nodes over all sigma [m, s]."""
        walks = [k for k, h in enumerate(tables.hypotheses) if h.law.has_walk]
        scale = np.where(np.isin(self.hypothesis, walks), 1.0 / math.sqrt(tables.dt_s), 1.0)
        shape = (self.index.size, sigma.size)
        drift = np.outer(self.rho * scale, sigma)
        return np.broadcast_to(sigma, shape), drift, np.broadcast_to(self.alpha[:, None], shape)


def best_sigma(bank: Bank, nodes: Nodes, mask: int, n: int) -> float:
    """sigma_v within its prior where the likelihood of the best node is greatest, to a tenth of its posterior sd."""
    best, prior, half_ln_dt = (math.inf, math.nan), bank.tables.axes[0], 0.5 * math.log(bank.tables.dt_s)
    for j in nodes.index:
        found = minimize_scalar(
            lambda ln_sigma, j=int(j): -bank.raw.log_likelihood_subset(0, j, mask, math.exp(ln_sigma)),
            bounds=(prior.ln_min[PLACES["N"]] - half_ln_dt, prior.ln_max[PLACES["N"]] - half_ln_dt),
            method="bounded",
            options={"xatol": 0.1 / math.sqrt(2.0 * n)},
        )
        best = min(best, (float(found.fun), math.exp(found.x)))
    return best[1]


def textbook(y: Floats, tables: Tables, nodes: Nodes, sigma: Floats, z: Floats | None, mask: int) -> Floats:
    """ln p [m, s] of the same nodes by the textbook bank, with the regressors of `mask` as states."""
    used = [k for k in range(len(tables.regressors)) if mask >> k & 1]
    reference = np.array([column.reference for column in tables.regressors])
    centred = np.ascontiguousarray((z - reference)[:, used]) if z is not None and used else None
    coefficient_sd = np.array([tables.regressors[k].coefficient_sd[0] for k in used]) if used else None
    offset = float(np.nanmean(y))
    values = nodes.values(sigma, tables)
    found = np.empty(values[0].shape)
    for k in np.unique(nodes.hypothesis):
        mine = nodes.hypothesis == k
        sigma_v, drift, second = (np.ascontiguousarray(value[mine].ravel()) for value in values)
        ln_p, _, _ = _reference.run_filters(
            y - offset,
            tables.dt_s,
            -offset,
            tables.axes[0].bias_sd,
            [tables.hypotheses[k].law.as_tuple],
            np.zeros(sigma_v.size, np.int32),
            drift,
            second,
            sigma_v,
            z=centred,
            coefficient_sd=coefficient_sd,
        )
        found[mine] = ln_p.reshape(-1, sigma.size)
    return found


def differences(ours: Floats, theirs: Floats, law: NDArray[np.int64], values: Sequence[Floats]) -> Agreement:
    """Between ln p [m, s], under flat weights; `values` [m, s] of each parameter."""
    near = theirs > theirs.max() - DEPTH
    weights = [np.exp(ln_p - ln_p.max()) for ln_p in (ours, theirs)]
    weights = [w / w.sum() for w in weights]
    probability = mean = 0.0
    for k in np.unique(law):
        a, b = (w[law == k] for w in weights)
        probability = max(probability, abs(float(a.sum() - b.sum())))
        if b.sum() < 1e-3:
            continue
        for value in values:
            x = value[law == k]
            exact = float((b * x).sum() / b.sum())
            sd = math.sqrt(max(float((b * (x - exact) ** 2).sum() / b.sum()), 0.0))
            if sd > 1e-9 * abs(exact):
                mean = max(mean, abs(float((a * x).sum() / a.sum()) - exact) / sd)
    return Agreement(float(np.abs(ours - theirs)[near].max()), probability, mean)


def compare(
    y: Floats,
    tables: Tables,
    z: Floats | None = None,
    *,
    builds: Iterable[str] = LIMITS,
    sigmas: int = 9,
    every: int = 1,
    masks: Iterable[int] | None = None,
) -> dict[str, Agreement]:
    """Feed `y` (NaN: missing) to builds of the library and to the textbook bank, at `every` so many of the nodes and
    `sigmas` values of sigma_v about the best, 4 posterior sd either way. `masks`: subsets of the regressors; all."""
    banks = {build: a_bank(tables, build) for build in dict.fromkeys(["double", *builds])}
    for bank in banks.values():
        push(bank, y, z)
    nodes = Nodes.of(banks["double"], every)
    n = int(np.isfinite(y).sum())
    found: dict[str, list[Agreement]] = {build: [] for build in builds}
    for mask in [2 ** len(tables.regressors) - 1] if masks is None else masks:
        middle = best_sigma(banks["double"], nodes, mask, n)
        sigma = middle * np.exp(np.linspace(-4.0, 4.0, sigmas) / math.sqrt(2.0 * n))
        theirs = textbook(y, tables, nodes, sigma, z, mask)
        for build, each in found.items():
            of_node = banks[build].raw.log_likelihood_subset
            ours = np.array([[of_node(0, int(j), mask, s) for s in sigma] for j in nodes.index])
            each.append(differences(ours, theirs, nodes.hypothesis, nodes.values(sigma, tables)))
    return {build: Agreement.worst(each) for build, each in found.items()}


def hold(what: str, found: Sequence[dict[str, Agreement]]) -> None:
    """Prints the worst of some records, and asserts that each build keeps its tolerances."""
    worst = {build: Agreement.worst(each[build] for each in found) for build in found[0]}
    print(f"\n{what}: ", end="")
    print(", ".join(f"{b} d ln p {w.ln_p:.1e} dP {w.probability:.1e} mean {w.mean:.1e}" for b, w in worst.items()))
    for build, one in worst.items():
        assert one.within(LIMITS[build]), (build, one)


# -------------------------------------------------------------------------------------------------------------- reports


def exact_report(y: Floats, tables: Tables) -> AxisResult:
    """The report on dense nodes in double."""
    bank = Bank(dense(tables), build="_dense")
    push(bank, y)
    return bank.report(0)


def report_differences(y: Floats, tables: Tables, exact: AxisResult | None = None) -> tuple[Floats, bool]:
    """|d ln evidence|, |d mean| / sd and |sd ratio - 1| of a report against the exact one, the worst over the laws that
    are not ruled out; and whether it says itself that its grid does not bear one of them."""
    bank = Bank(tables)
    push(bank, y)
    exact = exact or exact_report(y, tables)
    evidence, _, mean, sd = worst_difference(bank.report(0), exact)
    return np.array([evidence, mean, sd]), off_grid(bank, 0, exact)


def off_grid(bank: Bank, axis: int, exact: AxisResult) -> bool:
    """Whether a report says itself that its grid does not bear the record, of a law that is not ruled out."""
    entries = zip(bank.tables.hypotheses, bank.raw.report(axis)["hypotheses"], strict=True)
    flags = [entry["parameters"][PLACES["N"]][-1] for h, entry in entries if exact.probability[h.name] >= 0.01]
    return any(flag & _library32.OFF_GRID for flag in flags)


# ----------------------------------------------------------------------------------------------------------- forgetting


def fading(missing: NDArray[np.integer], half_life: float) -> Floats:
    """What every sample [n] counts for, as selfcal.h has it: by the intervals of the later batches."""
    n, batch = len(missing), _library32.BATCH
    ends = np.cumsum(missing + 1)[[min(at + batch, n) - 1 for at in range(0, n, batch)]]  # of each batch
    return np.repeat(2.0 ** (-(ends[-1] - ends) / half_life), batch)[:n]


@dataclass(frozen=True)
class Filter:
    """Relative to sigma_v^2, of a drift that is the sum of its states [k]: pole of each, variance added per interval,
    predicted variance at the first sample."""

    phi: Floats
    q: Floats
    first: Floats

    @staticmethod
    def of(law: str, rho: float, alpha: float) -> Filter:
        """At an interval of 1 s. No moving average, whose white noise is another."""
        one = np.ones(1)
        if law == "constant":
            return Filter(one, 0.0 * one, 0.0 * one)
        if law == "random_walk":
            return Filter(one, rho**2 * one, rho**2 * one)
        assert law in ("gauss_markov", "flicker")
        rates = alpha * (np.array([0.0625, 1.0, 16.0]) if law == "flicker" else one)
        variance = rho**2 * (0.96**2 if law == "flicker" else 1.0)
        return Filter(np.exp(-rates), -variance * np.expm1(-2.0 * rates), variance * np.ones(rates.size))


def faded(
    node: Filter, y: Floats, columns: Floats, missing: NDArray[np.integer], half_life: float, sd: Floats, sigma: float
) -> float:
    """ln-likelihood of `y` [n] under weights, by the printed recursions with a filter each for y and every column
    [n, c] ("1" among them), and the coefficients ~ N(0, sd^2) out of the weighted normal equations."""
    series, p, q = np.column_stack([y, columns]), np.diag(node.first), np.diag(node.q)
    x, sums, ln_s = np.zeros((node.phi.size, series.shape[1])), np.zeros((series.shape[1],) * 2), 0.0
    w = fading(missing, half_life)
    step = np.outer(node.phi, node.phi)
    for i in range(len(y)):
        for _ in range(int(missing[i])):
            x, p = node.phi[:, None] * x, step * p + q
        nu, s = series[i] - x.sum(axis=0), 1.0 + p.sum()
        sums += w[i] * np.outer(nu, nu) / s
        ln_s += w[i] * math.log(s)
        gain = p.sum(axis=1) / s
        x, p = node.phi[:, None] * (x + np.outer(gain, nu)), step * (p - s * np.outer(gain, gain)) + q
    a, b, c = sums[1:, 1:] / sigma**2, sums[1:, 0] / sigma**2, sums[0, 0] / sigma**2
    precision = a + np.diag(1.0 / sd**2)
    _, ln_det = np.linalg.slogdet(precision * np.outer(sd, sd))
    fitted, shrunk = np.linalg.solve(a, b), np.linalg.solve(precision, b)
    of_prior = b @ fitted - b @ shrunk + ln_det  # their priors' cost counts as the first sample does
    return float(-0.5 * (w.sum() * math.log(2 * math.pi * sigma**2) + ln_s + c - b @ fitted + w[0] * of_prior))
