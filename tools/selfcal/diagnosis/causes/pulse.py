"""A pulse of the bias: a step, and after a while a step back of the same size. Each step alone may be weak.

Pairs of places on a coarse grid of block means are ranked, and the best single step is tried as a pulse's start and as
its end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from selfcal.base.grid import Array
from selfcal.diagnosis.cause import Cause, Channels, Grouping, Key, Scored, Simulated, Written, positive, shown
from selfcal.diagnosis.causes import step
from selfcal.diagnosis.record import Record
from selfcal.likelihood import columns, edges
from selfcal.likelihood.columns import SMALLER
from selfcal.likelihood.edges import EDGE, EDGES_APART, Scan, edge, raised, scan
from selfcal.likelihood.fit import Fit, moved, run
from selfcal.likelihood.state import Look, State

#: Places of a step among which pairs are looked for, of blocks.
PAIR_PLACES = 96
#: Most pairs that are tried, and how far they are apart, places.
TRIED, PAIRS_APART = 2, 3
#: Gain of two steps by sizes of their own, nats and share of the gain, above which they are no pulse. Of pulses 2 in
#: 1000 gain as much by chance; the share is that of sizes a third apart.
UNEQUAL, UNEQUAL_SHARE = 5.0, 0.03


def looks(state: State, record: Record) -> list[Look]:
    """The best pair of places, where its steps are of the same size."""
    n = state.y.size
    if n < 10 * EDGES_APART:
        return []
    steps = scan(state.series, state.best)
    pairs = [edges.sharper(state, fit, two) for fit, two in (*_coarse(state), *_of_step(state, steps))]
    inside = [two for two in pairs if two[0] >= EDGE and two[1] <= n - EDGE and two[1] - two[0] >= EDGES_APART]
    found = columns.looks(state, "pulse", [edges.shape(state, "pulse", two, steps) for two in inside])
    for look in found:
        column = look.changes["regressors"][-1].values
        ends = raised(n, int(np.flatnonzero(column)[-1]) + 1)
        # At the same drift: a drift that forgets and a step are as good as a walk, for any record.
        alike, apart = state.scores([column, np.array([column, ends])], state.with_columns(column)[1])
        if apart - alike > max(UNEQUAL, UNEQUAL_SHARE * look.gain):
            return []
    return found


def _coarse(state: State) -> list[tuple[Fit, tuple[int, int]]]:
    """The best pairs of places, some way apart, of block means, and the drift that shows each. A pulse is slower than
    wandering lines and the colour of the noise: the means are taken without."""
    series, block = state.means()
    m = series.y.size
    places = np.unique(np.linspace(0, m, PAIR_PLACES + 2).astype(int)[1:-1])
    more = series.beside((np.arange(m)[None, :] >= places[:, None]).astype(np.float64))
    drifts = [(fit, less) for fit in state.fits if fit.terms in state.near() for less in (0.0, *SMALLER)]
    values = []
    for fit, less in drifts:
        terms = replace(fit.terms, color="", bands=())
        slow = replace(fit, terms=terms, theta=moved(fit, terms))
        sums = run(more, terms, slow.of_means(block, -less))[0][0].less(len(series.columns))
        G, size = sums.G, np.diag(sums.G)[1:]
        information = size[:, None] + size[None, :] - 2.0 * G[1:, 1:]
        usable = np.triu(information > 1e-6 * size.max(), 1)
        explained = (G[0, 1:, None] - G[0, None, 1:]) ** 2 / np.where(usable, information, 1.0)
        rss = np.maximum(G[0, 0] - explained, 1e-12 * G[0, 0])
        likelihood = -0.5 * (sums.n * (np.log(2.0 * math.pi * rss / sums.n) + 1.0) + sums.D)
        values.append(np.where(usable, likelihood, -math.inf))
    value = np.max(values, axis=0)
    found: list[tuple[Fit, tuple[int, int]]] = []
    while len(found) < TRIED and np.isfinite(value.max()):
        i, j = divmod(int(value.argmax()), places.size)
        fit, less = drifts[int(np.argmax([table[i, j] for table in values]))]
        found.append((fit.shrunk(less), (int(places[i]) * block, int(places[j]) * block)))
        value[max(0, i - PAIRS_APART) : i + PAIRS_APART + 1, max(0, j - PAIRS_APART) : j + PAIRS_APART + 1] = -math.inf
    return found


def _of_step(state: State, steps: Scan) -> list[tuple[Fit, tuple[int, int]]]:
    """The best single step as the start of a pulse and as its end."""
    place = int(np.argmax(steps.gain))
    fit = state.with_columns(raised(state.y.size, place))[1]
    ahead, behind = (int(np.argmax(edge(state, fit, (place, place), k).gain)) for k in (1, 0))
    return [(fit, (place, ahead)), (fit, (behind, place))]


def _least(state: State, record: Record) -> dict[str, tuple[float, str]]:
    """A pulse of a tenth of the record in its middle."""
    n = record.present.size
    places = (round(0.45 * n), round(0.55 * n))
    return columns.least(state, edges.shape(state, "pulse", places, scan(state.series, state.best)), "amplitude")


def _add(keys: Mapping[str, Any], channels: Channels) -> Array:
    t = channels.time_s - keys["time_s"]
    return np.where((t >= 0.0) & (t < keys["duration_s"]), keys["amplitude"], 0.0)


CAUSE = Cause(
    "pulse",
    "The bias jumps, and after a while it jumps back.",
    "Look for what was switched on and off at these times.",
    source="surroundings",
    looks=looks,
    at=step.at,
    slow=True,
    of_means=True,
    pictures=shown("means", "evidence"),
    least=_least,
    grouping=Grouping(alike=step.alike, piece=step.at_jump, most=3),
    score=Scored(once="a pulse is an event of its recording"),
    written=Written(entry=step.entry, of_column=step.of_column),
    simulated=Simulated(
        keys={
            "time_s": Key(lambda s: 0.45 * s.duration_s),
            "duration_s": positive(lambda s: 0.1 * s.duration_s),
            "amplitude": Key(lambda s: 2.0 * s.n),
        },
        add=_add,
    ),
)
