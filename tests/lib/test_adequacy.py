"""The module's adequacy (lib/adequacy.c): its statistics against a filter in numpy, what it flags and what it does not.

Truth: the textbook Kalman filter of the model stated, and records whose effect is known. The rate of false flags over
5000 h and the shares found are campaigns: tests/adequacy_rates.py, figures in tests/ACCURACY.md.
"""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from selfcal.adequacy.drawn import simulate_bank_samples
from selfcal.bank.library import Bank
from selfcal.model.file import Model
from selfcal.model.tables import Tables, make_tables
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.replay import replay
from selfcal.verbs.simulate import simulate
from selfcal.wire.frames import choices

MODEL = Model.load(None)
SUSPECTS = choices("GX_ADEQUACY", "suspicion")
#: SELFCAL_ADEQUACY_LIMIT_*, RISE_LIMIT; of the others 5. Those of drift are for epochs below 1024 bank samples.
LIMITS = {
    "periodic": 4.5,
    "variance_change": 6.0,
    "outliers": 13.0,
    "ramp": 8.0,
    "colored_noise": 8.0,
    "flicker": 8.0,
    "step": 6.0,
}
#: Bank samples of the first epoch; of a window that a step is looked for in.
EPOCH, RISE = 256, 32


def tables_of(*names: str, laws: tuple[str, ...] = ("constant", "random_walk", "gauss_markov")) -> Tables:
    return make_tables(replace(MODEL, hypotheses=dict.fromkeys(laws, 1.0 / len(laws))), 1.0, names)


def watch(
    y: NDArray[np.float64],
    channels: NDArray[np.float64] | None = None,
    tables: Tables | None = None,
    missing: bool = False,
) -> list[tuple[int, int, int, str, float, int]]:
    """Axis, sample, state, suspect, score and length of each judgement of y [n, axes]."""
    before = np.zeros(len(y), np.uint64)
    before[::97] = 5 if missing else 0
    tables = tables or tables_of(*("gx", "gy", "gz")[: y.shape[1]])
    beside = None if channels is None else channels.astype(np.float32)
    told, _ = Bank(tables).raw.watch(np.ascontiguousarray(y, np.float32), before, beside)
    return [(axis, at, state, SUSPECTS[suspect], score, n) for axis, at, state, suspect, score, n in told]


def walk(n: int, seed: int, K: float = 2e-4) -> NDArray[np.float64]:
    return simulate_bank_samples("random_walk", {"N": 0.04, "K": K, "bias": 0.1}, 1.0, n, seed)[0]


def flags(told: list[tuple[int, int, int, str, float, int]], axis: int = 0) -> list[str]:
    return [suspect for at, _, state, suspect, _, _ in told if at == axis and state == 2]


@pytest.mark.parametrize("law", ["constant", "random_walk", "gauss_markov"])
def test_the_scores_are_those_of_the_textbook_filter(law: str) -> None:
    """The first epoch of a record of one law, with a temperature and gaps. The parameters are those of the report after
    256 samples: the median of N and alpha, the 95 % quantile of the drift. Float32 against double: 1e-3 of a score."""
    n = 2 * EPOCH
    truth = {"N": 0.04, "K": 4e-3, "sigma_m": 0.05, "alpha": 0.03, "bias": 0.1}
    y = simulate_bank_samples(law, truth, 1.0, n, 3)[0].astype(np.float32).astype(float)
    rng = np.random.default_rng(1)
    channels = np.column_stack([25.0 + 0.05 * np.arange(n) ** 0.5 + 0.02 * rng.standard_normal(n), np.full(n, 5.0)])
    channels = channels.astype(np.float32).astype(float)
    tables = tables_of("gx", laws=(law,))
    (_, _, state, suspect, score, length), *_ = watch(y[:, None], channels, tables)
    assert (state, length) == (1, EPOCH)

    bank = Bank(tables)
    bank.push(y[:EPOCH, None])
    estimates = bank.report(0).parameters[law]
    found = {name: one.q95 if name in ("K", "sigma_m") else one.median for name, one in estimates.items()}
    z, (w_time, w_temp) = innovations(y[EPOCH:], found, [np.arange(EPOCH, dtype=float), channels[EPOCH:, 0]])
    known = 1.0 / math.sqrt(1.0 + (EPOCH - 1) / EPOCH)
    root = 1.0 / math.sqrt(EPOCH - 1)
    slow = np.zeros(EPOCH)
    for i in range(1, EPOCH):
        slow[i] = slow[i - 1] + (z[i] - slow[i - 1]) / 16.0
    half = EPOCH // 2
    lag, mean = z[1:] @ z[:-1], z[1:] @ slow[:-1] / math.sqrt((1 / 16) / (2 - 1 / 16))
    held, beside = (one.reshape(-1, RISE).sum(axis=1) for one in (np.clip(z, -4.0, 4.0), w_temp))
    rises, with_it = held[2:] - held[:-2], beside[2:] - beside[:-2]
    at = np.argmax(np.abs(rises))
    brought = (z @ w_temp) / (w_temp @ w_temp) * with_it[at] / rises[at]
    scores = [
        ("step", known * rises[at] / math.sqrt(2.0 * RISE) if brought <= 0.5 else 0.0),
        ("ramp", z @ w_time / math.sqrt(w_time @ w_time)),
        ("temperature", z @ w_temp / math.sqrt(w_temp @ w_temp)),
        ("colored_noise", max(known * root * lag, 0.0)),
        ("colored_noise", max(math.sqrt(0.5) * root * lag, 0.0)),
        ("flicker", max(known * root * mean, 0.0)),
        ("flicker", max(math.sqrt(0.5) * root * mean, 0.0)),
        ("variance_change", max(known * root * (z[1:] @ z[1:] - (EPOCH - 1)) / math.sqrt(2.0), 0.0)),
        ("variance_change", root * (np.sum(z[half:] ** 2 - 1) - np.sum(z[1:half] ** 2 - 1)) / math.sqrt(2.0)),
        ("outliers", np.sum(z[1:] ** 4 - 6.0 * z[1:] ** 2 + 3.0) * root / math.sqrt(24.0)),
    ]
    scores += coarse(y[:, None], channels[:, 0])
    scores += [("periodic", tones(z[1:])), ("two_level", levels(y, 511))]
    expected = max(scores, key=lambda one: abs(one[1]) / LIMITS.get(one[0], 5.0))
    assert suspect == expected[0]
    assert score == pytest.approx(expected[1], abs=1e-3)


def coarse(y: NDArray[np.float64], temperature: NDArray[np.float64]) -> list[tuple[str, float]]:
    """Scores of the coarse bank's columns (lib/coarse.c) for y [n, 1] at 1 s: the likelihood of each walk, with sigma_v
    at its likeliest, by the textbook filter over the readings and the column."""
    n = len(y)
    t, base = np.arange(n), temperature - temperature[0]
    lagged = np.zeros(n)
    for k in range(1, n):
        lagged[k] = lagged[k - 1] - math.expm1(-1.0 / 120.0) * (base[k] - lagged[k - 1])
    columns = {"ramp": t, "temperature": base, "late": lagged, "turn_on": np.exp(-t / 300.0)}
    without, gains = math.inf, dict.fromkeys(columns, (math.inf, 0.0))
    for rho in [4.0 * 0.5**k for k in range(15)] + [0.0]:
        P, states, sums, ln_s = 1.0, [one[0] for one in (y[:, 0], *columns.values())], np.zeros((3, 5)), 0.0
        for k in range(1, n):
            s = P + rho * rho + 1.0
            nu = np.array([one[k] for one in (y[:, 0], *columns.values())]) - states
            states = states + (s - 1.0) / s * nu
            P = (s - 1.0) / s
            sums += np.outer((1.0, 0.0, 0.0), nu * nu / s) + np.outer((0.0, 1.0, 0.0), nu[0] * nu / s)
            ln_s += math.log(s)
        square, along = sums[0], sums[1]
        without = min(without, (n - 1) * math.log(square[0]) + ln_s)
        for at, name in enumerate(columns, 1):
            cost = (n - 1) * math.log(square[0] - along[at] ** 2 / square[at]) + ln_s
            gains[name] = min(gains[name], (cost, math.copysign(1.0, along[at])))
    return [
        ("temperature" if name == "late" else name, sign * math.sqrt(max(without - cost, 0.0)))
        for name, (cost, sign) in gains.items()
    ]


def tones(z: NDArray[np.float64]) -> float:
    """Score of the strongest tone (lib/tones.c) of z [n]: by the autocorrelation at each lag, octave by octave."""
    scores, degrees = [], []
    for octave in range(5):
        whole = z.size >> octave
        x = z[: whole << octave].reshape(whole, -1).sum(axis=1) / 2.0 ** (octave / 2)
        by_lag = np.array([x[lag:] @ x[:-lag] for lag in range(1, whole)])
        for k in range(6):
            w = math.pi / 4 * 2 ** (-(k + 0.5) / 6)
            lag = np.arange(1, 1000)
            weight = (1.0 - w / 10.0) ** lag * np.cos(w * lag)
            scores.append(weight[: whole - 1] @ by_lag / math.sqrt(whole * np.sum(weight**2)))
            degrees.append((whole + 1) * w / 20.0)
    found = 0.0
    for i in range(2, 28):
        excess = max(scores[i] - max((scores[i - 2] + scores[i + 2]) / 2, 0.0), 0.0)
        root = math.sqrt(degrees[i])  # excess = x + x^2 / (2 root)
        found = max(found, root * (math.sqrt(1.0 + 2.0 * excess / root) - 1.0))
    return found


def levels(y: NDArray[np.float64], until: int) -> float:
    """Score of two levels (lib/levels.c) after `until` samples of y at 1 s: mixtures by their moments against Kalman
    filters by matrices, from the 257th sample on."""
    best, sigma = math.inf, 0.0
    for tried in [4.0 * 0.5**k for k in range(15)] + [0.0]:
        x, P, square, ln_s = y[0], 1.0, 0.0, 0.0
        for value in y[1:EPOCH]:
            s = P + tried**2 + 1.0
            square, ln_s = square + (value - x) ** 2 / s, ln_s + math.log(s)
            x, P = x + (s - 1.0) / s * (value - x), (s - 1.0) / s
        if (cost := (EPOCH - 1) * math.log(square) + ln_s) < best:
            best, sigma = cost, math.sqrt(square / (EPOCH - 1))
    start, y = y[:EPOCH].mean() / sigma, y[EPOCH : until + 1] / sigma
    walk, stays = 1.44e-4, math.exp(-2.0 / 90.0)
    linear, switching = [], []
    for A, q in (
        [(1.0, walk), (1.6, walk), (2.6, walk)] + [(0.0, (4.0 * 0.25**k) ** 2) for k in range(6)] + [(0.0, 0.0)]
    ):
        first = max(A * A / 16.0, 1.0 / EPOCH)
        F, Q = np.diag([1.0, stays]), np.diag([q, (1.0 - stays**2) * A * A / 4.0])
        state, P, total = np.array([start, 0.0]), np.diag([first, A * A / 4.0]), 0.0
        for value in y:
            state, P = F @ state, F @ P @ F.T + Q
            s = P.sum() + 1.0
            nu = float(np.clip(value - state.sum(), -4.0, 4.0))
            total -= 0.5 * (math.log(s) + nu * nu / s)
            gain = P.sum(axis=1) / s
            state, P = state + gain * nu, P - np.outer(gain, gain) * s
        linear.append(total)
        if A == 0.0:
            continue
        x, p, upper, total, sides = start, first, 0.5, 0.0, []
        for value in y:
            s = p + q + 1.0
            gain = (s - 1.0) / s
            weights = 0.5 + (upper - 0.5) * stays * np.array([-1.0, 1.0])
            nu = float(np.clip(value - x, -4.0 - A / 2, 4.0 + A / 2)) + np.array([A / 2, -A / 2])
            joint = weights * np.exp(-0.5 * nu * nu / s) / math.sqrt(s)
            total += math.log(joint.sum())
            weights = joint / joint.sum()
            upper = min(max(weights[1], 1e-6), 1.0 - 1e-6)
            means = x + gain * nu
            x = (1.0 - upper) * means[0] + upper * means[1]
            p = gain + (1.0 - upper) * (means[0] - x) ** 2 + upper * (means[1] - x) ** 2
            if abs(upper - 0.5) > 0.3:
                sides.append(upper > 0.5)
        jumps = sum(one != other for one, other in pairwise(sides))
        switching.append(total if jumps >= 4 else -math.inf)
    return math.sqrt(2.0 * max(max(switching) - max(linear), 0.0))


def innovations(
    y: NDArray[np.float64], parameters: dict[str, float], columns: list[NDArray[np.float64]]
) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
    """z of y and w of each column, at an interval of 1 s. The first is 0: it tells the level, which has no prior."""
    variance = parameters["N"] ** 2
    F, Q, P = np.eye(1), np.zeros((1, 1)), np.array([[1e8]])
    if "K" in parameters:
        Q[0, 0] = parameters["K"] ** 2 / variance
    if "sigma_m" in parameters:
        pole, stationary = math.exp(-parameters["alpha"]), parameters["sigma_m"] ** 2 / variance
        F, Q = np.diag([1.0, pole]), np.diag([0.0, stationary * (1.0 - pole**2)])
        P = np.diag([1e8, stationary])
    series = [y / math.sqrt(variance), *(column - column[0] for column in columns)]
    states = [np.zeros(len(F)) for _ in series]
    H = np.ones(len(F))
    out: list[list[float]] = [[] for _ in series]
    for t in range(y.size):
        if t:
            P = F @ P @ F.T + Q
        S = H @ P @ H + 1.0
        gain = P @ H / S
        P = P - np.outer(gain, P @ H)
        for k, one in enumerate(series):
            states[k] = F @ states[k] if t else states[k]
            nu = one[t] - H @ states[k]
            states[k] = states[k] + gain * nu
            out[k].append(float(nu / math.sqrt(S)) if t else 0.0)
    z, *w = (np.array(one) for one in out)
    return z, w


@pytest.mark.parametrize("missing", [False, True])
def test_a_clean_record_is_adequate(missing: bool) -> None:
    """Six hours of three axes with a warm-up and a supply step that move nothing. At one false flag in 1000 h of six
    axes the chance of one here is 0.3 %."""
    n = 6 * 3600
    t = np.arange(n)
    channels = np.column_stack([25.0 + 10.0 * (1.0 - np.exp(-t / 900.0)), 5.0 + 0.1 * (t > n // 2)])
    told = watch(np.column_stack([walk(n, seed) for seed in (1, 2, 3)]), channels, missing=missing)
    assert {state for _, _, state, *_ in told} == {1}
    assert [length for axis, *_, length in told if axis == 0][:4] == [256, 256, 384, 576]


def test_a_channel_that_drops_out_still_names_the_cause() -> None:
    """Every fifth temperature is not a number. The one before stands for it, 1 s old: the scores stay within 5 %."""
    n = 4 * 3600
    t = np.arange(n)
    whole = np.column_stack([25.0 + 4.0 * np.sin(t / 400.0), np.full(n, 5.0)])
    y = walk(n, 11) + 0.01 * (whole[:, 0] - 25.0)
    holes = whole.copy()
    holes[4::5, 0] = np.nan
    for (*_, suspect, score, _), (*_, other, without, _) in zip(
        watch(y[:, None], whole), watch(y[:, None], holes), strict=True
    ):
        assert other == suspect
        assert without == pytest.approx(score, rel=0.05)
    assert "temperature" in flags(watch(y[:, None], holes))


def test_the_cause_is_named() -> None:
    """One effect at a time on the first of two axes, from the start; sizes well above the noise."""
    n = 4 * 3600
    t = np.arange(n)
    rng = np.random.default_rng(5)
    temp = 25.0 + 4.0 * np.sin(t / 400.0)
    channels = np.column_stack([temp, 5.0 + 0.05 * np.sign(np.sin(t / 500.0))])
    clean, other = walk(n, 11), walk(n, 12)
    memory = np.convolve(rng.standard_normal(n + 1), [0.6, 0.6], "valid") * 0.04
    effects = {
        "temperature": clean + 0.01 * (temp - 25.0),
        "supply": clean + 0.5 * (channels[:, 1] - 5.0),
        "cross_axis": clean + 0.4 * other,
        "outliers": clean + 0.4 * (rng.uniform(size=n) < 0.003) * rng.choice([-1.0, 1.0], n),
        "variance_change": np.where(t > n // 2, clean + 0.04 * rng.standard_normal(n), clean),
        "colored_noise": clean + memory,
    }
    for cause, y in effects.items():
        found = flags(watch(np.column_stack([y, other]), channels))
        assert cause in found, f"{cause}: {found}"
        assert found.count(cause) > len(found) / 2, f"{cause}: {found}"
        if cause != "cross_axis":  # correlation has no direction
            assert not flags(watch(np.column_stack([y, other]), channels), axis=1)


def stepped(seed: int, sizes: tuple[float, ...], n: int = 2400, at: int = 1100) -> NDArray[np.float64]:
    """[n, 3]: walks of which each steps by so many deviations of its white noise."""
    late = (np.arange(n) >= at)[:, None]
    return np.column_stack([walk(n, 10 * seed + k) for k in range(3)]) + 0.04 * np.array(sizes) * late


def test_a_step_of_one_axis_accuses_that_one() -> None:
    """20 deviations. By the product of innovations, of variance 1 each, 7 of 40 clean axes looked coupled to the one
    that stepped: 24 without a flag then had a chance of 1 %. Afterwards the step is one among ever more samples."""
    for seed in range(1, 13):
        told = watch(stepped(seed, (0.0, -20.0, 0.0)))
        assert not flags(told, 0) and not flags(told, 2)
        mine = [(at + 1 - n, state, suspect, score) for axis, at, state, suspect, score, n in told if axis == 1]
        first = next(k for k, one in enumerate(mine) if one[1] == 2)
        before, _, suspect, score = mine[first]
        assert suspect == "step" and score < -LIMITS["step"]
        for later, _, suspect, faded in mine[first + 1 :]:
            assert suspect == "step"
            assert faded == pytest.approx(score * math.sqrt(before / later), rel=1e-4)  # float32


def test_axes_that_step_at_once_have_moved() -> None:
    told = watch(stepped(3, (12.0, 0.0, -15.0)))
    assert set(flags(told, 0)) == set(flags(told, 2)) == {"motion"}
    assert not flags(told, 1)


def test_a_channel_that_steps_with_the_bias_is_the_cause() -> None:
    """10 deviations by a supply that steps, beside a temperature that wanders and does nothing."""
    n = 2400
    t = np.arange(n)
    channels = np.column_stack([25.0 + 3.0 * np.sin(t / 300.0), 5.0 + 0.1 * (t >= 1100)])
    assert set(flags(watch(stepped(5, (10.0, 0.0, 0.0)), channels))) == {"supply"}


@pytest.mark.parametrize(("cause", "size"), [("turn_on", 12.0), ("temperature", 0.2), ("ramp", 20.0), ("late", 0.33)])
def test_what_the_host_refuses_the_module_refuses(cause: str, size: float) -> None:
    """An hour of walks of K 0 to 5e-4 with a warm-up of 150 to 450 s, a temperature (behind a low pass of 80 to 200 s),
    or a ramp. Each is worth some 60 nats: so much likelier the default laws find the record without it, less 8 for what
    it takes to state it. Of 40 records drawn so all were flagged."""
    n = 3600
    t = np.arange(n)
    for seed in range(6):
        rng = np.random.default_rng(500 + seed)
        temp = 25.0 + 6.0 * np.sin(2.0 * np.pi * t / rng.uniform(600, 1500) + 6.0 * rng.uniform()) + 0.002 * t
        late, lag_s = np.zeros(n), rng.uniform(80, 200)
        for k in range(1, n):
            late[k] = late[k - 1] + (temp[k] - temp[0] - late[k - 1]) / lag_s
        tau_s = rng.uniform(150, 450)
        shape = {"turn_on": np.exp(-t / tau_s), "temperature": temp, "ramp": t / 3600.0, "late": late}[cause]
        y = walk(n, 40 + seed, (1e-6, 2e-4, 5e-4)[seed % 3]) + 0.04 * size * shape
        channels = np.column_stack([temp + 0.02 * rng.standard_normal(n), np.full(n, 5.0)])
        assert ("temperature" if cause == "late" else cause) in flags(watch(y[:, None], channels)), seed


def line_or_levels(kind: str, seed: int, n: int = 3600) -> NDArray[np.float64]:
    """A walk of K 0 to 5e-4 with a line of 18 to 105 s and 0.285 white-noise deviations, or with two levels 1.35 apart
    that last 60 to 250 s each."""
    rng = np.random.default_rng(3000 + seed)
    t = np.arange(n)
    y = walk(n, 3100 + seed, (1e-6, 2e-4, 5e-4)[seed % 3])
    if kind == "periodic":
        return y + 0.04 * 0.285 * np.sin(2.0 * np.pi * (t / rng.uniform(18, 105) + rng.uniform()))
    ends = np.cumsum(rng.exponential(math.exp(rng.uniform(math.log(60), math.log(250))), n))
    return y + 0.04 * 1.35 * (np.searchsorted(ends, t) % 2)


@pytest.mark.parametrize(("kind", "size"), [("periodic", 1.1), ("two_level", 3.0)])
def test_the_scores_of_a_line_and_of_two_levels(kind: str, size: float) -> None:
    """After the first epoch, where they are the strongest, against the sums as their files state them. A float of the
    sums has 1e-3 of a score; the likelihoods lose 2e-3."""
    t = np.arange(2 * EPOCH)
    shape = np.sin(t / 3.4) if kind == "periodic" else (t % 90 < 40) - 0.5
    y = (walk(t.size, 21, 1e-6) + 0.04 * size * shape).astype(np.float32).astype(float)
    tables = tables_of("gx")
    (_, _, _, suspect, score, _), *_ = watch(y[:, None], None, tables)
    bank = Bank(tables)
    bank.push(y[:EPOCH, None])
    report = bank.report(0)
    probability = {name: float(value) for name, value in report.probability.items()}
    law = "random_walk" if probability["random_walk"] > 0.01 else max(probability, key=lambda name: probability[name])
    found = {name: one.q95 if name in ("K", "sigma_m") else one.median for name, one in report.parameters[law].items()}
    expected = levels(y, t.size - 1) if kind == "two_level" else tones(innovations(y[EPOCH:], found, [])[0][1:])
    assert suspect == kind
    assert score == pytest.approx(expected, abs=3e-3)


@pytest.mark.parametrize("kind", ["periodic", "two_level"])
def test_a_line_and_two_levels_are_named(kind: str) -> None:
    """Forty hours. In the median a line is worth 60 nats (as above), and two levels 48: so much likelier a switching
    filter of about the true parameters finds the record than the likeliest law, less 8. At least 28 of 40, as issue 60
    asks; 34 and 35 were found."""
    found = [flags(watch(line_or_levels(kind, seed)[:, None])) for seed in range(40)]
    assert sum(kind in one for one in found) >= 28
    assert sum(kind == one for told in found for one in told) > 0.9 * sum(map(len, found))


@pytest.mark.parametrize("what", ["step", "outliers", "fast"])
def test_what_is_neither_a_line_nor_two_levels(what: str) -> None:
    """A step, outliers of 7 deviations, and a drift that forgets in 3 s, in records of 2 h: other names, or none."""
    n = 7200
    for seed in range(4):
        rng = np.random.default_rng(seed)
        y = walk(n, 3300 + seed)
        if what == "step":
            y += 0.04 * (2.0 + seed) * (np.arange(n) > 3000)
        elif what == "outliers":
            y += 0.04 * 7.0 * (rng.uniform(size=n) < 0.004)
        else:
            truth = {"N": 0.04, "sigma_m": 0.04, "alpha": 0.3, "bias": 0.1}
            y = simulate_bank_samples("gauss_markov", truth, 1.0, n, 3400 + seed)[0]
        assert not {"periodic", "two_level"} & set(flags(watch(y[:, None])))


@pytest.mark.parametrize("target", ["host", "cortex-m4f"])
def test_the_module_says_it_and_the_better_model_ends_it(target: str, tmp_path: Path) -> None:
    """Another axis in the readings: the firmware names it under the default laws. Under the model file that `diagnose`
    writes the same record is adequate."""
    if target != "host" and shutil.which("qemu-system-arm") is None:
        pytest.skip("qemu-system-arm is missing: make setup")
    base, log, better = tmp_path / "base.yaml", tmp_path / "log.npz", tmp_path / "better.yaml"
    tree: dict[str, Any] = yaml.safe_load(MODEL.path.read_text(encoding="utf-8"))
    tree["groups"]["gyro"]["lsb"] = 0.001
    axis = {"hypothesis": "random_walk", "bias": 0.1, "N": 0.04, "K": 2.0e-4}
    tree["simulate"] = {"rate_hz": 1.0, "duration_s": 4800.0, "axes": {"gx": axis, "gy": axis}}
    base.write_text(yaml.safe_dump(tree), encoding="utf-8")
    simulate(base, log, seed=4, effects=["cross_axis:other=gy,coefficient=0.4,axis=gx"])
    told = {}
    diagnose(log, axes=["gx"], model=base, write_model=better)
    for name, model in (("before", base), ("after", better)):
        said = replay(log, axes=["gx", "gy"], model=model, target=target, report_every=60.0)["axes"]["gx"][
            "module_says"
        ]
        told[name] = said["state"], said["suspicion"]
    assert told["before"] == ("inadequate", "cross_axis")
    assert told["after"][0] == "adequate"
