"""Records of a bias that oscillates, drawn by a difference equation of steps far finer than the read-out."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from drifts import LAWS, noise, recorded
from scipy.signal import lfilter

from selfcal.base.grid import Array
from selfcal.diagnosis.record import Record
from selfcal.likelihood.fit import fit_at
from selfcal.likelihood.state import State

#: Steps of the difference equation: in a period, and between two readings.
IN_PERIOD, IN_READING = 400, 4


@dataclass(frozen=True)
class Swing:
    """A damped oscillator that white noise drives; `sd` of its stationary reading."""

    period_s: float
    damping: float
    sd: float

    @property
    def forgets_s(self) -> float:
        """Time in which its phase is forgotten."""
        return self.period_s / (2.0 * math.pi * self.damping)

    def drawn(self, random: np.random.Generator, n: int, rate: float) -> Array:
        """[n]: velocity and position in turn by small steps (semi-implicit Euler), after five times of settling."""
        w = 2.0 * math.pi / self.period_s
        steps = max(IN_READING, math.ceil(IN_PERIOD / (rate * self.period_s)))
        h = 1.0 / (rate * steps)
        settle = steps * math.ceil(5.0 * self.forgets_s * rate)
        kick = self.sd * math.sqrt(4.0 * self.damping * w**3 * h) * random.standard_normal(settle + n * steps)
        loss = 2.0 * self.damping * w * h
        x = lfilter([h], [1.0, -(2.0 - (w * h) ** 2 - loss), 1.0 - loss], kick)
        return np.asarray(x[settle::steps])

    def evidence(self, state: State) -> float:
        """Nats that the truth gains over the best drift without it, the drift as fitted beside nothing or smaller."""
        own = {"ln_period": math.log(self.period_s), "ln_damping": math.log(self.damping)}
        values = []
        for one in state.fits:
            terms = replace(one.terms, oscillation=True)
            for less in (0.0, 1.0, 2.0, 4.0):
                small = one.shrunk(less)
                theta = [
                    math.log(self.sd / one.sigma) if name == "ln_swing" else own.get(name, 0.0) or small.value(name)
                    for name in terms.names
                ]
                values.append(fit_at(state.series, terms, np.array(theta)).ln_likelihood)
        return max(values) - state.best.ln_likelihood


def plain_ones(
    random: np.random.Generator, law: str, rate: float, seconds: float, count: int
) -> Iterator[tuple[Swing, Array, State, Record]]:
    """Records whose oscillation is worth 30 to 150 nats: the truth, the readings, their state and record."""
    assert law in LAWS
    while count:
        swing = Swing(
            math.exp(random.uniform(math.log(40.0), math.log(600.0))),
            math.exp(random.uniform(math.log(0.02), math.log(0.3))),
            math.exp(random.uniform(math.log(0.008), math.log(0.08))),
        )
        n = round(seconds * rate)
        y = noise(random, law, n, rate) + swing.drawn(random, n, rate)
        state, record = recorded(y, rate)
        if 30.0 <= swing.evidence(state) <= 150.0:
            count -= 1
            yield swing, y, state, record
