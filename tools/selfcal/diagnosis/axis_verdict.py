"""The verdict: what of a record stands out that no named cause explains.

The statistics of a look are judged as a family. How often the most striking of them stands out by chance comes from
the same simulated records as their bands. The looks at means of 1 s and at every sample, and the checks of `identify`,
are joined: an axis is adequate where none of them objects.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from scipy.special import ndtr

from selfcal.adequacy.checks import HIDDEN_MOST, against
from selfcal.diagnosis.causes import shared
from selfcal.diagnosis.finding import Diagnosed
from selfcal.diagnosis.record import Record
from selfcal.diagnosis.statistics import Statistic, judged
from selfcal.likelihood.fit import left
from selfcal.likelihood.state import NET_LEAST, Look, State
from selfcal.readings.budget import AXES_COUNT, OF_MODULES

#: Pictures of the checks of `identify`, by the beginning of their names.
SHOWN = (("innovation_mean", "innovation_means"), ("innovation_ln_variance", "noise_level"))
#: Probability that the statistics call an axis of a fitting record inadequate, and that a channel's coherence does.
P_FAMILY, P_COHERENCE = (OF_MODULES[name] / AXES_COUNT for name in ("statistics", "coherence"))
#: A first ensemble screens: axes below this have a second ensemble, which knows its tail, unless there is no doubt.
P_SCREEN, P_CERTAIN, AGAIN = 2e-2, 1e-12, 240


def unexplained(state: State, record: Record) -> tuple[list[Statistic], Look | None]:
    """Every statistic of an axis, the most striking first, and what stands out; None: nothing does."""
    found = judged(state, seed=1)
    if P_CERTAIN < found.p < P_SCREEN:
        found = judged(state, seed=2, count=AGAIN)
    coherences = coherence(state, record)
    statistics = sorted([*found.statistics, *coherences], key=lambda statistic: statistic.p)
    if found.p < P_FAMILY:
        return statistics, look_of(found.statistics[0], found.p)
    worst = min(coherences, key=lambda statistic: statistic.p, default=None)
    if worst is not None and worst.p * len(coherences) < P_COHERENCE:
        return statistics, look_of(worst, worst.p * len(coherences))
    return statistics, None


def look_of(statistic: Statistic, p: float) -> Look:
    """The finding that a statistic of this probability shows."""
    nats = min(1e6, -math.log(max(p, 1e-300)))
    estimate = {"statistic": statistic.name, "measured": statistic.measured}
    return Look("unexplained", nats, nats, estimate, {}, shown_by=statistic.name)


def of_checks(checks: Mapping[str, Mapping[str, Any]]) -> Look | None:
    """What the checks of `identify` hold against an axis in which no cause was found."""
    for name, deviations in against(checks).items():
        told = float(checks[name]["value"])
        found = look_of(Statistic(name, told, 0.0, 0.0, 0.0), 2.0 * float(ndtr(-deviations)))
        return replace(found, shown_by=next((shown for start, shown in SHOWN if name.startswith(start)), name))
    return None


def joined_looks(every_sample: Diagnosed | None, means: Diagnosed | None, interrupted: str) -> Diagnosed | None:
    """The result of an axis by two looks, of which each may be missing: neither overrules the other.

    Every sample has the causes, if that look ended or has any. Where it shows none, the means of 1 s have them, at the
    price of two looks. None: neither look has a result."""
    looks = [look for look in (every_sample, means) if look and (look.findings or not look.unfinished)]
    looks.sort(key=lambda look: look.unfinished == interrupted)
    if not looks:
        return None
    if looks[0] is not every_sample:
        reason = interrupted if every_sample is None else every_sample.unfinished
        return replace(looks[0], unfinished=f"every sample: {reason}")
    if means is None or looks[0].findings or not means.findings:
        return looks[0]
    strongest = max(means.findings, key=lambda finding: finding.look.net)
    if not strongest.look.changes and moves_within(looks[0].state, means.state.dt):
        return looks[0]
    least = NET_LEAST if strongest.look.changes else -math.log(P_FAMILY)
    return means if strongest.look.net >= least + math.log(len(looks)) else looks[0]


def moves_within(state: State, block_s: float) -> bool:
    """Whether the drift moves so far within a block, s, that no model of point drift and white noise has its means.

    Means of a walk are a walk at points and white noise less a sixth of its step, which takes HIDDEN_MOST of N^2."""
    fit = state.best
    markov = fit.sigma_m * math.sqrt(2.0 * fit.alpha) if fit.terms.markov else 0.0
    return (math.hypot(fit.K, markov) * block_s) ** 2 / 6.0 > HIDDEN_MOST * fit.N**2


def coherence(state: State, record: Record) -> list[Statistic]:
    """How the innovations go together with each recorded channel, whatever filter is between: the largest coherence.
    Other axes are looked at in pairs (causes/shared.py)."""
    found = []
    for name, values in record.channels.items():
        column = left(state.series, state.best, values - values.mean())[:, 1]
        both = shared.common(shared.pair_of(state.whitened, column / max(float(column.std()), 1e-300), state.dt))
        if both is not None:
            edge = math.sqrt(-math.log(0.005) / both.bins)
            found.append(Statistic(f"coherence_with_{name}", abs(both.coherence), 0.0, edge, math.exp(-both.net)))
    return found
