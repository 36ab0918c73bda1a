"""Single samples that are far off: a mixture of the innovations with a share of wider innovations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from selfcal.base.grid import Array
from selfcal.diagnosis.cause import Cause, Extension, Grouping, Key, Scored, Simulated, Written, shown
from selfcal.diagnosis.model_tree import add_handling
from selfcal.diagnosis.record import Record
from selfcal.likelihood.fit import run
from selfcal.likelihood.state import NET_LEAST, Look, State, net, normal_entry

#: ln of the number of looks, by 1350 clean records at 1 and 10 Hz. The two numbers of a mixture are at their limits in
#: most of them: 5 instead of 1350 / e gained 2.5 nats.
LN_LOOKS = -1.5
#: Largest share of outliers among the samples: a look with more has another cause.
OUTLIERS_MOST = 0.05
#: Share of readings on no lattice that repeat the reading before, above which they are no noise with exceptions.
REPEATS_MOST = 0.5
#: Standard deviations of a sample beyond which a module keeps it out: of normal noise 1 in 5e8.
KEPT_OUT_SD = 6.0


def looks(state: State, record: Record) -> list[Look]:
    """Isolated wild samples. They are exceptions: a mixture with many of them has another cause."""
    return [look for look in mixed(state, record) if look.estimate["fraction"]["median"] <= OUTLIERS_MOST]


def mixed(state: State, record: Record) -> list[Look]:
    """A mixture of the innovations with a share of wider innovations."""
    w = state.whitened
    present = np.isfinite(w)
    x = w[present]
    n = x.size
    far = int(np.count_nonzero(np.abs(x) > 3.5))
    if n < 50 or not far:
        return []
    if state.lsb <= 0.0 and float(np.mean(np.diff(state.y) == 0.0)) > REPEATS_MOST:
        return []  # a dead band: without the readings beyond it no noise is left
    share, wide, core = far / n, max(3.0, float(np.abs(x).max()) / 2.0), 1.0
    plain = -0.5 * (x**2).sum() / np.mean(x**2) - n * 0.5 * math.log(float(np.mean(x**2)))
    weight = np.zeros(n)
    before = -math.inf
    value = before
    for _ in range(200):
        a = math.log(max(1e-12, 1.0 - share)) - 0.5 * (x / core) ** 2 - math.log(core)
        b = math.log(share) - 0.5 * (x / wide) ** 2 - math.log(wide)
        both = np.logaddexp(a, b)
        value = float(both.sum())
        weight = np.exp(b - both)
        share = min(0.3, max(0.3 / n, float(weight.mean())))
        wide = max(2.5 * core, math.sqrt(float(weight @ x**2 / max(weight.sum(), 1e-12))))
        core = max(1e-6, math.sqrt(float((1.0 - weight) @ x**2 / max(1e-12, (1.0 - weight).sum()))))
        if value - before < 1e-4:
            break
        before = value
    gain = value - float(plain)
    worth = net(gain, 2, LN_LOOKS)
    picked = np.flatnonzero(present)[weight > 0.5]
    if worth < 1.0 or not picked.size:
        return []
    # Several in a row are no outliers: motion, or a change of the noise.
    alone = np.ones(picked.size, bool)
    if picked.size > 1:
        close = np.diff(picked) <= 3
        alone[1:] &= ~close
        alone[:-1] &= ~close
    if alone.mean() < 0.6 and share < 0.1:
        worth *= float(alone.mean())
    y = state.y.copy()
    y[picked] = np.nan
    if not np.nanmax(y) > np.nanmin(y):
        return []  # the others are all equal: a dead band
    later = _aftermath(state, y)
    gain, worth = gain + later, worth + later
    if worth < 1.0:
        return []
    largest = int(picked[np.argmax(np.abs(w[picked]))])
    fraction = picked.size / n
    return [
        Look(
            "outliers",
            gain,
            worth,
            {
                "fraction": normal_entry(fraction, math.sqrt(picked.size) / n, "1"),
                "time_s": normal_entry(float(record.time_s[largest]), 0.0, "s"),
            },
            {"y": y},
            when=(float(record.time_s[picked[0]]), float(record.time_s[picked[-1]])),
        )
    ]


def _aftermath(state: State, kept: Array) -> float:
    """ln likelihood that the other readings gain where the wild readings are left out of `kept` [n].

    A reading that is off by itself spoils the predictions that follow. A jump of the drift foretells them: without it
    they are worse, and it is no outlier."""
    fit = state.best
    _, white, s = run(replace(state.series, y=kept), fit.terms, fit.theta, innovations=True)
    residual = (white[:, 0] - white[:, 1:] @ fit.c) / fit.sigma
    there = np.isfinite(kept)
    before, after = state.whitened[there] ** 2 + np.log(state.variance[there] / fit.sigma**2), residual[there] ** 2
    return 0.5 * float((before - after - np.log(s[there])).sum())


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    """A sample so far off that its evidence pays for the choice among n."""
    return {"deviation": (math.sqrt(2.0 * (NET_LEAST + math.log(state.best.n))) * state.best.sigma, state.unit)}


def _extend(at: Extension) -> None:
    add_handling(at.tree, "outlier_sd", KEPT_OUT_SD)


CAUSE = Cause(
    "outliers",
    "Single samples are far off.",
    "Check the bus: log the raw words of those samples.",
    source="read-out",
    looks=looks,
    pictures=shown("largest", "histogram"),
    least=_least,
    grouping=Grouping(alike=lambda a, b: True),
    score=Scored(once="outliers are events of their recording"),
    written=Written(extend=_extend),
    simulated=Simulated(
        keys={"fraction": Key(lambda s: 0.005, "outlier_fraction", lambda v: 0.0 <= v <= 1.0, "from 0 to 1")}
    ),
)
