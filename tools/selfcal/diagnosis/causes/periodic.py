"""A spectral line: the periodogram of the innovations; harmonics of one fundamental are one finding."""

from __future__ import annotations

import math

import numpy as np
from scipy.fft import next_fast_len, rfft
from scipy.optimize import minimize_scalar

from selfcal.diagnosis.record import Record
from selfcal.diagnosis.state import Look, Regressor, State, interval, net
from selfcal.diagnosis.statemodel import Array

#: Fewer turns in a record than this are drift.
TURNS_LEAST = 3.0


def looks(state: State, record: Record) -> list[Look]:
    """The strongest line, refitted exactly at its best frequency."""
    n = state.y.size
    w = np.nan_to_num(state.whitened)
    padded = next_fast_len(4 * n, real=True)
    power = np.abs(rfft(w, padded)) ** 2 / np.isfinite(state.y).sum()
    frequency = np.arange(power.size) / (padded * state.dt)
    low = TURNS_LEAST / (n * state.dt)
    power[(frequency < low) | (frequency > 0.5 / state.dt - low)] = 0.0
    at = int(np.argmax(power))
    ln_places = math.log(max(1.0, 0.5 * n)) + 0.7
    if power[at] < ln_places:
        return []
    t = record.time_s

    def columns(f: float) -> Array:
        turns = 2.0 * math.pi * np.mod(f * t, 1.0)
        return np.array([np.sin(turns), np.cos(turns)])

    width = 1.0 / (n * state.dt)

    def cost(f: float) -> float:
        turns = np.exp(-2j * math.pi * np.mod(f * t, 1.0))
        return -float(np.abs(turns @ w) ** 2)

    f = float(
        minimize_scalar(
            cost,
            bounds=(frequency[at] - 0.5 * width, frequency[at] + 0.5 * width),
            method="bounded",
            options={"xatol": 1e-4 * width},
        ).x
    )
    pair = columns(f)
    gain, fit = state.with_columns(pair)
    if f < 30.0 / (n * state.dt):
        gain = min(gain, state.rich_gain(pair))
    worth = net(gain, 2, ln_places)
    if worth < 1.0:
        return []
    a, b = fit.c[-2:]
    amplitude = math.hypot(a, b)
    sd = float(np.mean(fit.sd[-2:]))
    # Information of the frequency: pi^2 n T^2 A^2 / (3 s^2) per unit of 1/T.
    spread = sd / max(amplitude, 1e-300) * math.sqrt(6.0) / (2.0 * math.pi * n * state.dt) * math.sqrt(2.0)
    name = f"line_{f:.6g}Hz"
    entry = {"kind": "periodic", "frequency_hz": f}
    added = (
        Regressor(f"{name}.sin", "periodic", pair[0], "1", entry),
        Regressor(f"{name}.cos", "periodic", pair[1], "1", entry),
    )
    return [
        Look(
            "periodic",
            gain,
            worth,
            {"frequency_hz": interval(f, spread, "Hz"), "amplitude": interval(amplitude, sd, state.unit)},
            {"regressors": (*state.regressors, *added)},
        )
    ]
