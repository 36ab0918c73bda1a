"""Checks of adequacy: what in a record speaks against its most probable law."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from selfcal.adequacy.allan import LEFT_LEAST, AllanCurve, allan_terms, curve_of, ratio_at
from selfcal.bank.axis_result import AxisResult, Estimate
from selfcal.bank.blocks import BLOCKS_LEAST, MOST_DENSE, Blocks
from selfcal.bank.priors import rounded
from selfcal.bank.subsets import LIKELY
from selfcal.base import units
from selfcal.base.grid import Array, Rows
from selfcal.logs.recording import Recording
from selfcal.logs.sampling import RATE_CHANGE_LEAST
from selfcal.model.file import Group, Prior
from selfcal.model.tables import Tables
from selfcal.readings.budget import CHECK_LIMIT, FALSE_ALARM
from selfcal.readings.faults import FAULTS
from selfcal.readings.readings import Readings

#: Largest distance of a part from its batch that passes, sd: the two parameters of a law share FALSE_ALARM.
BATCH_LIMIT = -float(ndtri(0.25 * FALSE_ALARM))
#: Largest share of the white noise that a drift may hide within an average: a walk of K dt = 2.25 N. The nodes end at
#: 0.9, where a faster drift heaps up: of 32 records each 32 of 3 N fail, 26 of 2.5 N, 6 of 2.2 N and none of 1.9 N.
HIDDEN_MOST = 0.84
#: Length of an average over a filter's time constant: it shows N before a first-order filter to 5 %.
CORNER_LENGTH = 10.0
#: Largest spacing of float32 in the noise of a reading: beyond it N is 0.4 % too large.
SPACING_MOST = 0.3


@dataclass(frozen=True)
class Judged:
    """A record against its most probable law, at its posterior medians: the `checks` of adequacy, and the `curve` of
    its Allan deviation, None where the record is too short, or too long."""

    checks: Mapping[str, Mapping[str, Any]]
    curve: AllanCurve | None


def judge_record(
    blocks: Blocks,
    tables: Tables,
    group: Group,
    result: AxisResult,
    recording: Recording | None = None,
    others: Sequence[str] = (),
    used: Sequence[int] = (),
) -> Judged:
    """Evidence in the record against the most probable law, with the columns `used`. `others`: the recording's
    columns that may act on the axis. Without a recording nothing is held against the drift."""
    from selfcal.adequacy.drift_checks import drift_checks

    sound = all(math.isfinite(estimate.median) for estimate in result.parameters[result.best].values())
    if blocks.mean.size > MOST_DENSE or not sound:
        return Judged({}, None)
    if int(np.isfinite(blocks.mean).sum()) < BLOCKS_LEAST + len(used):
        return Judged({}, None)
    left = blocks
    if used:
        z = blocks.z[:, used] - np.array([tables.regressors[k].reference for k in used])
        left = replace(blocks, mean=blocks.mean - z @ coefficients_of(result))
    curve = curve_of(left, tables, group, result)
    checks = drift_check(tables, group, result)
    if all(check["passed"] for check in checks.values()):  # else the others would show the same
        checks |= batch_check(tables, group, result) | innovation_checks(blocks, tables, group, result, list(used))
        checks |= allan_checks(curve) if curve else {}
    checks |= {} if recording is None else drift_checks(left, tables, result, recording, others)
    return Judged(checks, curve)


def drift_check(tables: Tables, group: Group, result: AxisResult) -> dict[str, dict[str, Any]]:
    """Does the drift of the most probable law, at its posterior medians, move little enough within an average? The
    `value` is the share of the white noise at high frequency that it hides. Nothing where no readings are averaged."""
    if tables.block == 1:
        return {}
    medians = {name: estimate.median for name, estimate in result.parameters[result.best].items()}
    terms = allan_terms(group.laws[result.best], medians, tables.dt_s, tables.block)
    share = terms.lacking / (terms.variance * (1.0 - 2.0 * terms.lag1))
    return {"drift_in_average": {"value": share, "limit": HIDDEN_MOST, "passed": share <= HIDDEN_MOST}}


def with_rate(
    judged: Judged, values: Array, missing_before: Rows, step: float, tables: Tables, result: AxisResult
) -> Judged:
    """The same with the rates of a `drift_in_average` that failed: `bank_hz`, and `decimate_hz` of averages that show
    the white noise.

    `values` [n]: the readings, NaN where there is none; `step` of their lattice. Differences over one and two readings
    part their white noise from a walk. If the noise is larger, averages over the time in which both are alike show
    it. Else the part filters its noise, which is white in averages over many times the filter's. Without such a corner
    in the record there is no rate.
    """  # fmt: skip
    near = missing_before[1:] == 0

    def square(differences: Array) -> float:
        pairs = int(np.isfinite(differences).sum())
        return float(np.nansum(differences**2)) / max(1, pairs) - step**2 / 6.0

    over_one, over_two = square(np.diff(values)[near]), square((values[2:] - values[:-2])[near[1:] & near[:-1]])
    white, walk = over_one - 0.5 * over_two, over_two - over_one
    rate_hz = tables.block / tables.dt_s
    rates = {"bank_hz": 1.0 / tables.dt_s}
    alpha = result.parameters[result.best].get("alpha")
    if white > walk:
        alike_hz = rate_hz * math.sqrt(max(walk, 0.0) / white)
        rates["decimate_hz"] = rounded(min(rate_hz, max(2.0 / tables.dt_s, alike_hz)))
    elif alpha is not None and values.size * alpha.median > BLOCKS_LEAST * CORNER_LENGTH * rate_hz:
        rates["decimate_hz"] = rounded(alpha.median / CORNER_LENGTH)
    return replace(judged, checks={**judged.checks, "drift_in_average": {**judged.checks["drift_in_average"], **rates}})


def batch_check(tables: Tables, group: Group, result: AxisResult) -> dict[str, dict[str, Any]]:
    """Is the part like the batch that log-normal priors describe? Else another law with wide priors takes its drift.

    The `value` is the distance of a parameter from its prior's median: (m1 - m0)/sqrt(s0^2 - s1^2) of the posterior's
    m1, s1 in the logarithm is normal (0, 1) if the part is from the batch. Of a law its largest distance counts, of the
    laws of the batch the least. Nothing where no law that is likely a priori has a log-normal prior of its drift.
    """
    distances = []
    for hypothesis in tables.hypotheses:
        own = {name: group.priors[name] for name in hypothesis.law.parameters}
        priors = {name: prior for name, prior in own.items() if prior.law == "log_normal"}
        if priors.keys() - {"N"} and hypothesis.ln_probability >= math.log(LIKELY):
            estimates = result.parameters[hypothesis.name]
            distances.append(max(_distance(estimates[name], prior) for name, prior in priors.items()))
    if not distances:
        return {}
    value = min(distances)
    return {"batch": {"value": value, "limit": BATCH_LIMIT, "passed": value <= BATCH_LIMIT}}


def _distance(estimate: Estimate, prior: Prior) -> float:
    """Standard deviations between the record and the prior. A posterior of nearly the prior's width states none."""
    if not (estimate.q05 > 0.0 and math.isfinite(estimate.q95)):
        return math.inf
    left = max(prior.ln_sd**2 - estimate.ln_sd**2, LEFT_LEAST * prior.ln_sd**2)
    return abs(math.log(estimate.median / prior.median)) / math.sqrt(left)


def with_readings(
    judged: Judged, readings: Readings, group: Group, unit: str, dt_s: float, *, as_fed: bool = False
) -> Judged:
    """`judged` with the checks of the readings. `unit`: the recording's. `dt_s`: the bank's interval.

    `lattice`, if they have a lattice: is their noise above it, or carried on to the next reading? `value`: steps in the
    noise of a reading; `step` in the recording's unit; `distinct` readings; of a counter that fails `counter_hz`: the
    rate of means whose remainders are white.
    Faults of the readings (readings/faults.py), if there are any: the share of readings that each is about.
    `misread` has its `kind`, whether it is `undone`, and kinds that are `also_possible`, `saturation` the `at` of the
    limit, `outliers` the value `at` which they recur, `stuck` and `motion` their `intervals` in s. `motion` passes
    where the noise of averages is the same with it, within its own scatter.
    `as_fed`: the engine took every reading as it was, in float32. Then the largest change of the sampling rate, and the
    `float_spacing`, steps of float32 in the noise of a reading, count too.
    """
    factor = units.factor(group.unit, unit)
    checks: dict[str, dict[str, Any]] = {}
    lattice = readings.lattice
    if lattice is not None:
        outcome = {"value": lattice.coarseness, "limit": lattice.most, "passed": not lattice.too_coarse_over(dt_s)}
        white = {"counter_hz": lattice.white_hz} if lattice.carried and not outcome["passed"] else {}
        checks["lattice"] = {**outcome, "step": lattice.step * factor, "distinct": lattice.distinct, **white}
    start_s = readings.recording.start_s
    more: dict[str, Callable[[], dict[str, Any]]] = {
        "misread": lambda: readings.misread.entry if readings.misread is not None else {},
        "saturation": lambda: {"at": readings.clipped and readings.clipped.limit * factor},
        "outliers": lambda: {"at": readings.recurring and readings.recurring.value * factor},
        "stuck": lambda: {"intervals": [[a + start_s, b + start_s] for a, b in readings.intervals]},
        "motion": lambda: {
            "passed": not readings.matters(max(1, round(dt_s * readings.recording.rate_hz))),
            "intervals": [[a + start_s, b + start_s] for a, b in readings.moved.intervals] if readings.moved else [],
        },
    }
    for fault in FAULTS:
        if fault.statistic(readings) > 0.0:
            outcome = {"value": float(np.mean(fault.mask(readings))), "limit": 0.0, "passed": False}
            checks[fault.name] = {**outcome, **more.get(fault.name, dict)()}
    if as_fed:
        if readings.changes:
            ratio = max((change.after_hz / change.before_hz - 1.0 for change in readings.changes), key=abs)
            checks["rate_change"] = {"value": ratio, "limit": RATE_CHANGE_LEAST, "passed": False}
        if readings.coarse > SPACING_MOST:
            checks["float_spacing"] = {"value": readings.coarse, "limit": SPACING_MOST, "passed": False}
    return replace(judged, checks={**judged.checks, **checks})


def against(checks: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """The checks that speak against the model, the surest first: each with its distance in standard deviations.
    Infinite where a check has none."""
    sure = {}
    for name, check in checks.items():
        if not check["passed"]:
            alone = CHECK_LIMIT * check["value"] / check["limit"] if check["limit"] > 0.0 else math.inf
            sure[name] = abs(check.get("deviations", alone))
    return dict(sorted(sure.items(), key=lambda item: -item[1]))


def coefficients_of(result: AxisResult) -> Array:
    """Posterior means [p] of the coefficients of the columns in use, under the most probable law."""
    return np.array([mean for mean, _ in result.coefficients[result.best]])


def allan_checks(curve: AllanCurve) -> dict[str, dict[str, Any]]:
    """Is the record's Allan deviation the model's, at averaging times of 2, 4, 8 ... bank intervals to a fifth of the
    record? `value` is the model's deviation over the record's less 1, `limit` how far on this side it may be, and
    `deviations` by how many standard deviations the record's variance is above the model's.
    """
    limit = allan_limit(curve)
    checks = {}
    for k in np.flatnonzero(curve.octave):
        deviations = float(curve.deviations[k])
        edge = ratio_at(math.copysign(limit, deviations), float(curve.left[k]))
        checks[f"allan_{curve.tau_s[k]:g}s"] = {
            "value": float(curve.model[k]) / float(curve.recording[k]) - 1.0 if curve.recording[k] > 0.0 else math.inf,
            "limit": abs(edge**-0.5 - 1.0) if edge > 0.0 else math.inf,
            "passed": abs(deviations) <= limit,
            "deviations": deviations,
        }
    return checks


def allan_limit(curve: AllanCurve) -> float:
    """Largest deviation of an averaging time that passes, sd. All times together fail as often as another check
    (CHECK_LIMIT): Bonferroni's limit for each time. If any time exceeds that limit, every time beyond CHECK_LIMIT is
    named."""
    off = np.abs(curve.deviations[curve.octave])
    alone = float(-ndtri(ndtr(-CHECK_LIMIT) / max(off.size, 1)))
    return CHECK_LIMIT if bool((off > alone).any()) else alone


def innovation_checks(
    blocks: Blocks, tables: Tables, group: Group, result: AxisResult, used: list[int]
) -> dict[str, dict[str, Any]]:
    """Are the innovations of the most probable law, at its posterior medians and with the columns `used`, of mean 0 (a
    ramp that a random walk follows leaves a mean), white, normal and of equal variance?"""
    from selfcal import _reference

    law = group.laws[result.best]
    medians = {name: estimate.median for name, estimate in result.parameters[result.best].items()}
    offset = float(np.nanmean(blocks.mean))
    z = blocks.z - np.array([column.reference for column in tables.regressors])
    sd = np.array([column.coefficient_sd[0] for column in tables.regressors])
    nu = _reference.innovations(
        np.ascontiguousarray(blocks.mean - offset),
        tables.dt_s,
        -offset,
        group.priors["bias"].sd,
        law.as_tuple,
        *law.node(medians),
        medians["N"] / math.sqrt(tables.dt_s),
        blocks.r,
        np.ascontiguousarray(z[:, used]) if used else None,
        sd[used] if used else None,
        tables.block,
    )[1 + len(used) :]  # the first are the bias and the coefficients
    pairs = np.isfinite(nu[1:]) & np.isfinite(nu[:-1])
    whole = nu[np.isfinite(nu)]
    n = whole.size
    half = n // 2
    lag1 = float((nu[1:] * nu[:-1])[pairs].sum() / (whole**2).sum())
    kurtosis = float(((whole - whole.mean()) ** 4).mean() / whole.var() ** 2 - 3.0)
    nothing = 1e-30 * float(whole.var())  # of a dead band, a half may have no variance
    ratio = math.log(max(float(whole[half:].var()), nothing) / max(float(whole[:half].var()), nothing))
    alone = 1.0 / math.sqrt(n)  # standard deviation of the first two for white normal innovations
    checks: dict[str, tuple[float, float]] = {
        "innovation_mean": (float(whole.mean() / whole.std()), CHECK_LIMIT * alone),
        "innovation_lag1": (lag1, CHECK_LIMIT * alone),
        "innovation_excess_kurtosis": (kurtosis, abs(kurtosis_at(math.copysign(CHECK_LIMIT, kurtosis), n))),
        "innovation_ln_variance_ratio_of_halves": (ratio, CHECK_LIMIT * math.sqrt(8.0) * alone),
    }
    return {
        name: {"value": value, "limit": limit, "passed": abs(value) <= limit} for name, (value, limit) in checks.items()
    }


def kurtosis_at(z: float, n: int) -> float:
    """Excess kurtosis of `n` normal numbers, 20 at least, that is as rare as a deviation of `z` standard deviations: it
    is skewed even at n of thousands. Anscombe and Glynn, Biometrika 70 (1983), 227-234, equation 3, solved for it."""
    mean, variance = 3.0 * (n - 1) / (n + 1), 24.0 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    skewness = 6.0 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9))
    skewness *= math.sqrt(6.0 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    a = 6.0 + 8.0 / skewness * (2.0 / skewness + math.sqrt(1.0 + 4.0 / skewness**2))
    root = 1.0 - 2.0 / (9.0 * a) - z * math.sqrt(2.0 / (9.0 * a))
    x = ((1.0 - 2.0 / a) / root**3 - 1.0) * math.sqrt(0.5 * (a - 4.0))
    return mean + math.sqrt(variance) * x - 3.0
