"""`selfcal response` beside other methods on the same records: errors of the gain and of the lag.

    PYTHONPATH=tests/common python tests/response_rivals.py other_axis --records 50
    PYTHONPATH=tests/common python tests/response_rivals.py thermal --records 50
    PYTHONPATH=tests/common python tests/response_rivals.py lattice --records 50

The records are those of tests/common/influences.py: 50 min at 1 Hz, a lag of 8 s behind another gyro, or of 250 s
behind the temperature. `lattice` is a lag of 30 s behind a temperature that is read on a lattice of 1 degC: noise of
the input. `spectra` fits g / (1 + T s) to the ratio of scipy's cross spectrum and spectrum by coherence. `output error`
is scipy's least squares over gain, lag, bias and ramp. statsmodels has the gain of the answer's lag beside an ARIMA(0,
1, 1), which is a walk and white noise, by its exact likelihood. `arx`, `instruments` and `subspace` take the readings
less a ramp, in means of a third of the lag. Behind the filter of the drift they are those of the JSON. A lag is the
delay of slow changes. An error of more than 100 % counts as 100 %.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from influences import Drawn, late, other_axis, thermal
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, csd, detrend, lfilter, welch
from statsmodels.tsa.statespace.sarimax import SARIMAX

from selfcal.diagnosis.estimators import arx, instruments, subspace
from selfcal.verbs.response import response

Floats = NDArray[np.float64]


def quick(d: Drawn) -> dict[str, float]:
    d.gx += d.now(0.05 * late(d.whole, 30.0, d.step))
    return {"gain": 0.05, "lag_s": 30.0}


INFLUENCES: dict[str, tuple[Callable[[Drawn], dict[str, float]], str]] = {
    "other_axis": (other_axis, "gy"),
    "thermal": (thermal, "temp"),
    "lattice": (quick, "temp"),
}
#: Lattice of the temperature of `lattice`, degC.
LATTICE = 1.0


def spectra(u: Floats, y: Floats, dt: float) -> tuple[float, float]:
    size = u.size // 3
    frequency, cross = csd(u, y, 1.0 / dt, nperseg=size, detrend="linear")
    own, theirs = (welch(one, 1.0 / dt, nperseg=size, detrend="linear")[1] for one in (u, y))
    ratio = (cross / own)[1:-1]
    coherence = np.clip(np.abs(cross) ** 2 / (own * theirs), 0.0, 1.0 - 1e-9)[1:-1]
    weight = np.sqrt(coherence / (1.0 - coherence)) / np.abs(ratio)
    turn = 2j * math.pi * frequency[1:-1]

    def off(x: Floats) -> Floats:
        left = weight * (x[0] / (1.0 + math.exp(x[1]) * turn) - ratio)
        return np.concatenate([left.real, left.imag])

    bounds = ([-np.inf, math.log(dt)], [np.inf, math.log(u.size * dt)])
    gain, ln_lag = least_squares(off, [float(np.abs(ratio[0])), 3.0], bounds=bounds).x
    return float(gain), math.exp(ln_lag)


def output_error(u: Floats, y: Floats, dt: float) -> tuple[float, float]:
    ramp = np.linspace(-1.0, 1.0, u.size)

    def off(x: Floats) -> Floats:
        b, a, _ = cont2discrete(([1.0], [math.exp(x[1]), 1.0]), dt, method="foh")
        return np.asarray(y - x[0] * lfilter(b.ravel(), a, u - u[0]) - x[2] - x[3] * ramp)

    found = min((least_squares(off, [0.1, start, 0.0, 0.0], x_scale=[0.1, 1, 1, 1]) for start in (2.0, 5.0)),
                key=lambda one: float(one.cost))  # fmt: skip
    return float(found.x[0]), math.exp(float(found.x[1]))


def gain_beside_arima(u: Floats, y: Floats, lag_s: float) -> float:
    b, a, _ = cont2discrete(([1.0], [lag_s, 1.0]), 1.0, method="foh")
    behind = np.asarray(lfilter(b.ravel(), a, u - u[0]))
    decay = np.exp(-np.arange(u.size) / lag_s)
    return float(SARIMAX(y, exog=np.column_stack([behind, decay]), order=(0, 1, 1)).fit(disp=False).params[0])


def estimates(log: Path, column: str, lag_s: float) -> Iterator[tuple[str, float, float]]:
    """Name, gain and lag of every method."""
    found = response(log, input=column, output="gx")
    middle = {key: one["median"] for key, one in found.get("estimate", {}).items()}
    yield "response", middle.get("gain", math.nan), middle.get("delay_s", middle.get("lag_s", math.nan))
    for name, one in found.get("methods", {}).items():
        yield f"{name}, behind the filter", one["gain"], one["delay_s"]
    with np.load(log) as columns:
        u, y = (
            detrend(next(columns[name] for name in columns if name.startswith(f"{one}["))) for one in (column, "gx")
        )
    yield "spectra, scipy", *spectra(u, y, 1.0)
    yield "output error, scipy", *output_error(u, y, 1.0)
    if "lag_s" in middle:
        yield "ARIMA, statsmodels", gain_beside_arima(u, y, middle["lag_s"]), middle["lag_s"]
    step = max(1, min(round(lag_s / 3.0), y.size // 150))
    count = y.size // step
    means = [one[: count * step].reshape(count, step).mean(axis=1) for one in (u, y)]
    for name, method in (("arx", arx), ("instruments", instruments), ("subspace", subspace)):
        one = method(*means)
        yield f"{name}, the readings", one.gain, one.delay * step


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("influence", choices=tuple(INFLUENCES))
    parser.add_argument("--records", type=int, default=50)
    parser.add_argument("--seed", type=int, default=5000)
    given = parser.parse_args()
    draw, column = INFLUENCES[given.influence]
    each: dict[str, list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(given.seed, given.seed + given.records):
            drawn = Drawn(seed)
            truth = draw(drawn)
            coarse = LATTICE * np.rint(drawn.temperature() / LATTICE) if given.influence == "lattice" else None
            log = drawn.write(Path(folder) / "log.npz", coarse)
            for name, gain, lag in estimates(log, column, truth["lag_s"]):
                each.setdefault(name, []).append((gain / truth["gain"] - 1.0, lag / truth["lag_s"] - 1.0))
    print(f"{given.influence}, {given.records} records: mean and rms error, % of the gain; of the lag")
    for name, rows in each.items():
        off = np.clip(100.0 * np.array([row for row in rows if math.isfinite(row[0])] or [(math.nan,) * 2]), -100, 100)
        mean, rms = off.mean(axis=0), np.sqrt((off**2).mean(axis=0))
        print(f"{name:28s} {len(off)} records {mean[0]:+8.1f} {rms[0]:8.1f}   {mean[1]:+8.1f} {rms[1]:8.1f}")


if __name__ == "__main__":
    main()
