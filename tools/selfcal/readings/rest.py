"""When a recording rested, and a line on a record that lies outside the model's priors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from selfcal.base.errors import few
from selfcal.base.grid import MEDIAN_SD, runs
from selfcal.base.units import factor
from selfcal.logs.recording import Recording
from selfcal.model.file import Model
from selfcal.model.tables import bank_block
from selfcal.readings.budget import CHECK_LIMIT
from selfcal.readings.lattice import step_of
from selfcal.readings.moves import PUSH

#: Length of a piece, s, and its samples at least.
LEVEL_PIECE_S, PIECE_LEAST = 1.0, 4
#: Fewest pieces, or differences of neighbouring means, that show a deviation.
PIECES_LEAST = 8
#: Share of the quietest pieces that rest is known from: a recording may move for most of its time.
QUIET_SHARE = 0.2
#: Probability that a piece of normal noise is called motion, and a factor for noise that is not normal.
LOUD_P, LOUD_MARGIN = 1e-7, 1.5


@dataclass(frozen=True)
class RestStretches:
    """Stretches of motion and of rest, s of the recording; none where the recording is too short."""

    moved: tuple[tuple[float, float], ...]
    still: tuple[tuple[float, float], ...]

    @property
    def longest(self) -> tuple[float, float] | None:
        """The longest stretch of rest."""
        return max(self.still, key=lambda run: run[1] - run[0], default=None)


def rest_of(recording: Recording, axes: Sequence[str]) -> RestStretches:
    """When the sensor moved, by the scatter within pieces of 1 s and the jumps between their means, each against those
    of the recording's quietest fifth. An axis alone counts. A change by one step of its lattice is no motion."""
    piece = max(PIECE_LEAST, round(LEVEL_PIECE_S * recording.rate_hz))
    place = recording.clock.place - recording.clock.place[0]
    index, count = place // piece, int(place[-1] + 1) // piece  # of whole pieces
    if not PIECES_LEAST <= count <= recording.samples:
        return RestStretches((), ())
    kept = index < count
    used = np.bincount(index[kept], minlength=count)
    whole = used == piece
    moving = np.zeros(count, bool)
    quiet, loud = gammaincinv(0.5 * (piece - 1), (QUIET_SHARE, 1.0 - LOUD_P))  # of squares about the mean of a piece
    for name in axes:
        values = recording.columns[name].values[kept]
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.bincount(index[kept], values, minlength=count) / used
            square = np.bincount(index[kept], (values - mean[index[kept]]) ** 2, minlength=count)
        lattice = step_of(values[np.isfinite(values)])[0]
        shown = square[whole & (square > 0.0)]
        most = math.sqrt(float(np.quantile(shown, QUIET_SHARE) * loud / quiet)) if shown.size else math.inf
        moving |= whole & (square > (LOUD_MARGIN * max(most, 0.5 * lattice * math.sqrt(piece))) ** 2)
        step = np.abs(np.diff(mean))
        known = np.isfinite(step)
        usual = float(np.quantile(step[known], 0.5)) if known.any() else 0.0
        jumps = np.flatnonzero(known & (step > max(PUSH * usual / MEDIAN_SD, lattice)))
        moving[jumps] = moving[jumps + 1] = True
    length_s = piece / recording.rate_hz
    start = recording.start_s

    moved, still = (
        tuple((start + a * length_s, start + b * length_s) for a, b in runs(mask)) for mask in (moving, ~moving)
    )
    return RestStretches(moved, still)


def outside_priors(recording: Recording, model: Model, axes: Sequence[str]) -> str:
    """A line on all `axes` whose evidence every law denies. It states the side of the priors, their own Allan deviation
    at the bank interval, when the sensor moved, and the stretch of rest to type; or to widen the
    priors, if it rested."""
    sides: dict[str, list[str]] = {}
    for name in axes:
        side, numbers = _side(recording, model, name)
        sides.setdefault(side, []).append(numbers)
    said = "; ".join(f"{side}: {', '.join(numbers)}" for side, numbers in sides.items())
    rest = rest_of(recording, [name for name in model.axes if name in recording.columns])
    text = f"outside the model's priors, {said}"
    if not rest.moved or rest.longest is None:
        where = "no part of it is quieter" if rest.longest is not None else "it is too short to see motion in it"
        return f"{text}; {where}: take another stretch if it is shaken, check the unit, or widen these priors"
    listed = few([f"{a:.10g} to {b:.10g} s" for a, b in rest.moved], more="times more")
    first, last = rest.longest
    return f"{text}; it moved at {listed}; its longest rest: --start {first:.10g} --end {last:.10g}"


def _side(recording: Recording, model: Model, name: str) -> tuple[str, str]:
    """Which prior an axis leaves, and its Allan deviation with that prior's limit."""
    group, unit = model.group_of(name), recording.columns[name].unit
    block = bank_block(recording.rate_hz, model.bank_rate_hz)
    tau_s = block / recording.rate_hz
    values = recording.columns[name].values
    interval, first = np.unique(recording.clock.place // block, return_index=True)
    mean = np.add.reduceat(values, first) / np.diff(np.append(first, values.size))
    present = np.diff(interval) == 1
    deviation = math.sqrt(0.5 * float(np.mean(np.diff(mean)[present] ** 2))) if present.any() else math.nan
    prior, scale = group.priors["N"], factor(group.unit, unit)
    bias_sd, level = group.priors["bias"].sd * scale, float(values.mean())
    if abs(level) > CHECK_LIMIT * bias_sd:
        return "its level above the bias", f"{name} {level:.6g} {unit} (sd {bias_sd:.3g})"
    N = deviation * math.sqrt(tau_s) / scale
    number = f"{name} {deviation:.3g} {unit}"
    at_tau = f"Allan deviation at {tau_s:.3g} s"
    if prior.max < N:
        return f"above: {at_tau}", f"{number} (N to {prior.max * scale:.3g})"
    if prior.min > N:
        return f"below: {at_tau}", f"{number} (N from {prior.min * scale:.3g})"
    return f"its drift above K or sigma_m: {at_tau}", f"{number} (N {prior.min * scale:.3g} to {prior.max * scale:.3g})"
