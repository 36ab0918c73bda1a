"""`selfcal plan --response`: the input that makes a gain and a lag known, and the file to drive a chamber by.

The input switches between two levels by a shift register's bits, and follows its set point behind a lag of its own.
What a record says of gain and lag is the Fisher information of their columns behind the filter of the drift. Parts are
drawn as the model file states them. SHARE of them must have what is wanted, and so must drawn records: the length grows
until they have it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.signal import max_len_seq

from selfcal.adequacy.drawn import simulate_bank_samples
from selfcal.bank.axis_result import HALF_90
from selfcal.base.errors import UserError
from selfcal.base.grid import Array
from selfcal.base.output import print_lines
from selfcal.base.units import duration_words
from selfcal.batch.plan import LENGTH_LEAST, LENGTH_MOST, Wish, bracket, part_of
from selfcal.batch.spread import Row, spread
from selfcal.diagnosis.response import answer_of
from selfcal.diagnosis.separate import SHARE
from selfcal.diagnosis.transfer import Drive, Input, Structure, late
from selfcal.likelihood.fit import Series, run
from selfcal.likelihood.state import State
from selfcal.likelihood.statemodel import Terms
from selfcal.model.file import Model

#: Number of stages of the register that makes the bits.
STAGES = 9
#: Records that a length is tried with, and ratio of the next length to a length that was too short.
TRIED_RECORDS, LENGTH_RATIO = 20, 1.2
LAG = Structure("lag", ("gain",), ("lag_s",))


@dataclass(frozen=True)
class Experiment:
    """An influence of `gain` and `lag_s` as far as it is known, and an input between two `levels` that follows its set
    point behind `input_lag_s`. All times in s."""

    gain: float
    lag_s: float
    levels: tuple[float, float]
    input_lag_s: float

    def set_points(self, bit_s: float, duration_s: float) -> tuple[Array, Array]:
        """Times [k] at which the set point changes, s, and the set points [k] from there on."""
        count = math.ceil(duration_s / bit_s)
        # The register begins with its longest run.
        bits = np.resize(np.roll(max_len_seq(STAGES)[0], -STAGES), count).astype(np.int64)
        kept = np.flatnonzero(np.append(True, np.diff(bits) != 0))
        return np.asarray(kept * bit_s, np.float64), np.array(self.levels)[bits[kept]]

    def input(self, bit_s: float, samples: int, dt: float) -> Array:
        """[samples]: the input about its middle."""
        starts, levels = self.set_points(bit_s, samples * dt)
        wanted = levels[np.searchsorted(starts, np.arange(samples) * dt, side="right") - 1] - 0.5 * sum(self.levels)
        return np.asarray(late(np.append(0.0, wanted), max(self.input_lag_s, 1e-3 * dt), dt)[1:])


def terms_of(truth: Mapping[str, float], dt: float) -> tuple[Terms, Array, float]:
    """The drift of a part, its parameters and its white noise a sample. Raises UserError."""
    if set(truth) - {"N", "K", "sigma_m", "alpha"}:
        raise UserError("--response takes parts of white noise and a walk or a Gauss-Markov drift: state one of these")
    sigma = truth["N"] / math.sqrt(dt)
    if "sigma_m" in truth:
        theta = [math.log(truth["sigma_m"] / sigma), math.log(truth["alpha"])]
        return Terms(markov=True), np.array(theta), sigma
    return Terms(walk=True), np.array([math.log(max(truth.get("K", 0.0) * math.sqrt(dt) / sigma, 1e-5))]), sigma


def halves(experiment: Experiment, truth: Mapping[str, float], u: Array, dt: float) -> dict[str, float]:
    """Half the 90 % intervals of gain and lag that a part's record of the input [n] would have, each over its size."""
    terms, theta, sigma = terms_of(truth, dt)
    drive, lag, near = Drive(u, dt), experiment.lag_s, 1e-3 * experiment.lag_s
    here = drive.columns(LAG, (lag,))
    change = drive.columns(LAG, (lag + near,))[0] - drive.columns(LAG, (lag - near,))[0]
    by_lag = experiment.gain * change / (2 * near)
    columns = np.vstack([np.ones(u.size), here[1:], here[:1], by_lag])
    sums = run(Series(np.zeros(u.size), dt, np.ones(u.size), columns), terms, theta)[0][0]
    sd = sigma * np.sqrt(np.diag(sums.coefficients()[1])[-2:])
    return {"gain": HALF_90 * float(sd[0]) / abs(experiment.gain), "lag": HALF_90 * float(sd[1]) / lag}


def designed(
    model: Model, axis: str, experiment: Experiment, wishes: Sequence[Wish], seeds: Sequence[int], scheduler: str | None
) -> dict[str, Any]:
    """The shortest record of all bits: `bit_s`, `duration_s` (None beyond LENGTH_MOST), and what is predicted."""
    dt = 1.0 / model.bank_rate_hz
    parts = [
        {key: value for key, value in truth.items() if key in model.laws[law].parameters}
        for law, truth in (part_of(model, axis, seed) for seed in seeds)
    ]
    most = {wish.parameter: wish.most for wish in wishes}

    def lacks(bit_s: float, samples: int) -> bool:
        """Whether fewer than SHARE of the parts have it."""
        u = experiment.input(bit_s, samples, dt)
        each = [halves(experiment, truth, u, dt) for truth in parts]
        return any(float(np.quantile([part[key] for part in each], SHARE)) > wish for key, wish in most.items())

    def length(bit_s: float) -> int | None:
        """Samples of the record."""
        return bracket(partial(lacks, bit_s), max(LENGTH_LEAST, math.ceil(8.0 * bit_s / dt)))[1]

    bits = [max(times * experiment.lag_s, 2.0 * dt) for times in (0.5, 1.0, 2.0, 4.0)]
    reached = {bit_s: samples for bit_s in bits if (samples := length(bit_s)) is not None}
    if not reached:
        return {"bit_s": None, "duration_s": None}
    bit_s = min(reached, key=lambda bit: reached[bit])
    samples = reached[bit_s]
    while samples <= LENGTH_MOST:
        # A record whose drift must be fitted, and its structure found, knows less than was predicted.
        of_record = partial(drawn_rows, model, axis, experiment, bit_s, samples)
        rows = spread(of_record, seeds, scheduler=scheduler)
        if np.mean([all(row[key] <= wish for key, wish in most.items()) for row in rows]) >= SHARE:
            return {"bit_s": bit_s, "duration_s": samples * dt}
        samples = math.ceil(LENGTH_RATIO * samples)
    return {"bit_s": bit_s, "duration_s": None}


def drawn_rows(model: Model, axis: str, experiment: Experiment, bit_s: float, samples: int, seed: int) -> list[Row]:
    """Half the 90 % intervals of gain and lag of a drawn record, each over its size; infinite without an interval."""
    dt = 1.0 / model.bank_rate_hz
    law, truth = part_of(model, axis, seed)
    y, _ = simulate_bank_samples(model.laws[law], truth, model.bank_rate_hz, samples, seed)
    u = experiment.input(bit_s, samples, dt)
    acts = experiment.gain * late(np.append(0.0, u), experiment.lag_s, dt)[1:]
    state = State(axis, model.group_of(axis).unit, y + acts, dt, 0.0, np.ones(samples)).refit()
    estimate = answer_of(state, [Input(u, u, "degC")])[0].get("estimate", {})
    return [
        {
            name: 0.5 * (estimate[key]["q95"] - estimate[key]["q05"]) / abs(size) if key in estimate else math.inf
            for name, key, size in (("gain", "gain", experiment.gain), ("lag", "lag_s", experiment.lag_s))
        }
    ]


def show(document: Mapping[str, Any], *, to_stderr: bool = False) -> None:
    """The record to take, in words."""
    print_lines(_lines(document), to_stderr=to_stderr)


def _lines(document: Mapping[str, Any]) -> list[str]:
    if document["duration_s"] is None:
        return ["no record that can be simulated suffices: wider levels, or a wider wish"]
    low, high = document["levels"]
    return [
        f"{document['axis']}: switch {document['input']} at random between {low:g} and {high:g}, "
        f"every {document['bit_s']:.3g} s or a multiple, for {duration_words(document['duration_s'])}",
        *(f"{wish}: {100.0 * document['share']:g} % of such parts have it then" for wish in document["wishes"]),
    ]
