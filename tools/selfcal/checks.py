"""Checks of adequacy: what in a record speaks against its most probable law."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from selfcal.blocks import MOST_DENSE, Blocks
from selfcal.model import LAWS, Group
from selfcal.result import AxisResult
from selfcal.tables import Tables

#: A check fails beyond this many standard deviations of its statistic: a false alarm in 16 000 checks.
CHECK_LIMIT = 4.0


def innovation_checks(
    blocks: Blocks, tables: Tables, group: Group, result: AxisResult, used: list[int]
) -> dict[str, dict[str, Any]]:
    """Are the innovations of the most probable law, at its posterior medians and with the columns `used`, of mean 0 (a
    ramp that a random walk follows leaves one), white, normal and of one variance?"""
    from selfcal import _reference
    from selfcal.engines.reference import textbook_node

    if blocks.mean.size > MOST_DENSE:
        return {}
    law = max(result.probability, key=lambda name: result.probability[name])
    at = {name: np.array([estimate.median]) for name, estimate in result.parameters[law].items()}
    drift, alpha, walk = (float(value[0]) for value in textbook_node(law, at, group.correlation_time_s))
    offset = float(np.nanmean(blocks.mean))
    z = blocks.z - np.array([column.reference for column in tables.regressors])
    sd = np.array([column.coefficient_sd[0] for column in tables.regressors])
    nu = _reference.innovations(
        np.ascontiguousarray(blocks.mean - offset),
        tables.dt_s,
        -offset,
        group.priors["bias"].sd,
        list(LAWS).index(law),
        drift,
        alpha,
        float(at["N"][0]) / math.sqrt(tables.dt_s),
        blocks.r,
        np.ascontiguousarray(z[:, used]) if used else None,
        sd[used] if used else None,
        walk,
    )[1 + len(used) :]  # the first ones are the bias and the coefficients
    pairs = np.isfinite(nu[1:]) & np.isfinite(nu[:-1])
    whole = nu[np.isfinite(nu)]
    n = whole.size
    if n < 20:
        return {}
    half = n // 2
    lag1 = float((nu[1:] * nu[:-1])[pairs].sum() / (whole**2).sum())
    kurtosis = float(((whole - whole.mean()) ** 4).mean() / whole.var() ** 2 - 3.0)
    ratio = math.log(float(whole[half:].var() / whole[:half].var()))
    # Standard deviations under white normal innovations.
    checks = {
        "innovation_mean": (float(whole.mean() / whole.std()), 1.0 / math.sqrt(n)),
        "innovation_lag1": (lag1, 1.0 / math.sqrt(n)),
        "innovation_excess_kurtosis": (kurtosis, math.sqrt(24.0 / n)),
        "innovation_ln_variance_ratio_of_halves": (ratio, math.sqrt(8.0 / n)),
    }
    return {
        name: {"value": value, "limit": CHECK_LIMIT * sd, "passed": abs(value) <= CHECK_LIMIT * sd}
        for name, (value, sd) in checks.items()
    }
