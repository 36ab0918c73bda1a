"""What an extended model gains on the module: the error of the bias predicted 10, 60 and 300 s ahead.

    python tests/held_out_bias.py --records 5 --seed 1 [--target cortex-m4f | --second] [--cause temperature]

Each record has one effect on gx (random walk, N 0.04, K 1e-3 deg/s, 1 Hz). Its first 2400 s are diagnosed; the base
model and the extended one then run over them in the firmware (`replay`). The truth is the same record without white
noise. The prediction is the bias at the end, and with regressors what their coefficients make of the values to come.

--second: the extended model runs, in the host's library, over a second record of the same truth, whose noise, walk and
channels are new. Reports every 120 s predict the mean of a minute 300 s later (ahead.py).

--real FOLDER: the stated interval of the bias on real recordings at rest, by 1 s means. Rests of 10 min begin every
10 min; each is identified by itself. The mean of BLOCK_S that begins 60 s or 300 s after it has the variance of the
predicted bias and N^2 / BLOCK_S.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from selfcal.bank.axis_result import HALF_90
from selfcal.bank.library import Bank
from selfcal.logs.recording import as_float, load
from selfcal.model.file import DEFAULT, Model
from selfcal.model.regressors import columns_of, mask_of, offered
from selfcal.model.tables import make_tables
from selfcal.verbs.diagnose import diagnose
from selfcal.verbs.replay import replay
from selfcal.verbs.simulate import simulate
from selfcal.wire.ahead import KnownBias, error_ahead

LENGTH_S, HORIZONS_S = 2400, (10, 60, 300)
#: Of real recordings: their names, the rest, the horizons, and the block that shows the bias, s.
RUNS, REST_S, AHEAD_S, BLOCK_S = (1, 2, 4), 600, (60, 300), 30
#: Samples, of 1 Hz, between reports on a second record.
EVERY = 120
EFFECTS = {
    "temperature": ["temperature:coefficient=0.1,axis=gx"],
    "supply": ["supply:coefficient=4,axis=gx"],
    "cross_axis": ["cross_axis:other=gy,coefficient=0.5,axis=gx"],
    "periodic": ["periodic:frequency_hz=0.003,amplitude=0.1,axis=gx"],
    "step": ["step:time_s=900,amplitude=0.3,axis=gx"],
    "flicker": ["flicker:B=0.05,axis=gx"],
    "turn_on": ["turn_on:amplitude=0.6,tau_s=250,axis=gx"],
    "pulse": ["pulse:time_s=900,duration_s=300,amplitude=0.3,axis=gx"],
    "lag": ["temperature:coefficient=0.2,lag_s=250,axis=gx"],
    "rate": ["temperature:coefficient=0,rate=30,window_s=60,axis=gx"],
    "square": ["temperature:coefficient=0.1,square=0.1,axis=gx"],
    "two": ["temperature:coefficient=0.1,axis=gx", "supply:coefficient=4,axis=gx"],
}


def model_file(path: Path, N: float, lsb: float) -> Path:
    tree: dict[str, Any] = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    tree["groups"]["gyro"]["lsb"] = lsb
    axes = {name: {"hypothesis": "random_walk", "bias": 0.1, "N": N, "K": 1.0e-3} for name in ("gx", "gy")}
    duration_s = float(LENGTH_S + HORIZONS_S[-1] + 10)
    tree["simulate"] = {"rate_hz": 1.0, "duration_s": duration_s, "axes": axes}
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    return path


def predicted(axis: dict[str, Any], model: Model, log: Path, truth: Path) -> NDArray[np.float64]:
    """The bias, regressors and all, at each horizon: their values at the end as recorded, later ones without noise."""
    regressors = tuple(one for one in model.regressors if one.name in axis.get("regressors", {}))
    ahead = np.full(len(HORIZONS_S), axis["bias_now"]["mean"])
    if regressors:
        values, to_come = (as_float(columns_of(regressors, load(path))) for path in (log, truth))
        names = [column for one in regressors for column in one.columns]
        for one in regressors:
            told = axis["regressors"][one.name]
            for column, coefficient in told["coefficients"].items():
                place = names.index(column)
                change = np.array([to_come[LENGTH_S - 1 + h, place] for h in HORIZONS_S]) - values[LENGTH_S - 1, place]
                ahead += told["probability"] * coefficient["mean"] * change
    return ahead


def errors(effects: Sequence[str], target: str, seed: int, folder: Path) -> NDArray[np.float64]:
    """[base and extended model, horizon]: error of the predicted bias, deg/s."""
    base, clean = model_file(folder / "base.yaml", 0.04, 0.01), model_file(folder / "clean.yaml", 1e-6, 1e-5)
    whole, log, truth = folder / "whole.npz", folder / "log.npz", folder / "truth.npz"
    simulate(base, whole, seed=seed, effects=list(effects))
    simulate(clean, truth, seed=seed, effects=list(effects))
    with np.load(whole) as stored:
        np.savez(log, **{name: stored[name][:LENGTH_S] if stored[name].ndim else stored[name] for name in stored.files})
    recording = load(truth)
    bias = as_float(recording.in_unit("gx", "deg/s"))[[LENGTH_S - 1 + h for h in HORIZONS_S]]
    extended = folder / "extended.yaml"
    diagnose(log, axes=["gx"], model=base, write_model=extended)
    found = []
    for path in (base, extended):
        axis = replay(log, axes=["gx"], model=path, target=target)["axes"]["gx"]
        found.append(predicted(axis, Model.load(path), whole, truth) - bias)
    return np.array(found)


def known_by(bank: Bank, model: Model, time_s: float) -> KnownBias:
    """What a module would report: without regressors or with all, whichever is the likelier."""
    regressors = offered(model, "gx")
    places = sum(len(one.columns) for one in regressors)
    best, coefficients = bank.report(0, 0), np.zeros(places)
    if regressors:
        whole = bank.report(0, mask_of(regressors, regressors))
        evidence = [np.logaddexp.reduce(list(one.log_evidence.values())) for one in (best, whole)]
        if evidence[1] > evidence[0]:
            best = whole
            means = np.array([[mean for mean, _ in whole.coefficients[law]] for law in whole.probability])
            coefficients = np.array(list(whole.probability.values())) @ means
    return KnownBias(time_s, best.bias_mean, coefficients)


def second_errors(effects: Sequence[str], seed: int, folder: Path) -> NDArray[np.float64]:
    """[base and extended model]: rms error of the corrected output 300 s ahead on the second record, deg/s."""
    base, first, second = model_file(folder / "base.yaml", 0.04, 0.01), folder / "first.npz", folder / "second.npz"
    for log, its in ((first, seed), (second, seed + 1000)):
        simulate(base, log, seed=its, effects=list(effects))
    extended = folder / "extended.yaml"
    diagnose(first, axes=["gx"], model=base, write_model=extended)
    recording, found = load(second), []
    for path in (base, extended):
        model = Model.load(path)
        bank = Bank(make_tables(model, recording.rate_hz, ("gx",)))
        rows = as_float(recording.in_unit("gx", "deg/s"))[:, None]
        columns = as_float(columns_of(offered(model, "gx"), recording))
        known = []
        for end in range(EVERY, recording.samples, EVERY):
            piece = slice(end - EVERY, end)
            missing = recording.missing_before[piece]
            bank.push(rows[piece], missing, columns[piece] if columns.shape[1] else None)
            known.append(known_by(bank, model, float(recording.time_s[end - 1])))
        told = error_ahead(recording, model, "gx", known)
        assert told is not None
        found.append(float(told["rmse"]))
    return np.array(found)


def held_out(log: Path) -> dict[str, NDArray[np.float64]]:
    """By axis, [rests, len(AHEAD_S)]: the block's mean less the predicted bias, over its stated sd."""
    recording, model = load(log), Model.load()
    axes = tuple(name for name in model.axes if name in recording.columns)
    per_s = round(recording.rate_hz)
    units = {name: model.group_of(name).unit for name in axes}
    values = np.stack([as_float(recording.in_unit(name, units[name])) for name in axes], axis=1).astype(np.float64)
    means = values[: len(values) // per_s * per_s].reshape(-1, per_s, len(axes)).mean(axis=1)
    tables = make_tables(model, 1.0, axes, bank_rate_hz=1.0)
    found: dict[str, list[list[float]]] = {name: [] for name in axes}
    for start in range(0, len(means) - REST_S - max(AHEAD_S) - BLOCK_S + 1, REST_S):
        bank = Bank(tables)
        end = start + REST_S
        bank.push(means[start:end])
        for k, name in enumerate(axes):
            row = []
            for ahead in AHEAD_S:
                report = bank.report(k, ahead_s=ahead + 0.5 * BLOCK_S)
                noise = report.parameters[report.best]["N"].median ** 2 / BLOCK_S
                shown = means[end + ahead : end + ahead + BLOCK_S, k].mean()
                row.append((shown - report.bias_mean) / math.hypot(report.bias_sd, math.sqrt(noise)))
            found[name].append(row)
    return {name: np.array(rows) for name, rows in found.items()}


def show_held_out(folder: Path) -> None:
    """A line an axis: rests, and the share of blocks in the stated 90 % interval at each horizon."""
    runs = [held_out(folder / f"adis16405_run{run}.npz") for run in RUNS]
    print(f"blocks of {BLOCK_S} s in the stated 90 %, {' and '.join(f'{ahead} s' for ahead in AHEAD_S)} after a rest")
    for name in (*runs[0], "all"):
        z = np.concatenate([one for run in runs for key, one in run.items() if name in (key, "all")])
        shares = ", ".join(f"{100.0 * share:.1f} %" for share in (np.abs(z) < HALF_90).mean(axis=0))
        rms = ", ".join(f"{value:.2f}" for value in np.sqrt((z**2).mean(axis=0)))
        print(f"{name:4s} {len(z):4d} rests: {shares}; rms of error / sd {rms}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--target", default="host")
    parser.add_argument("--cause", action="append", choices=list(EFFECTS))
    parser.add_argument("--second", action="store_true")
    parser.add_argument("--real", type=Path)
    given = parser.parse_args()
    if given.real:
        show_held_out(given.real)
        return
    if given.second:
        print(f"rms error 300 s ahead on a second record, {given.records} records, deg/s: base model -> extended one")
        for cause in given.cause or EFFECTS:
            found = []
            for k in range(given.records):
                with tempfile.TemporaryDirectory() as folder:
                    found.append(second_errors(EFFECTS[cause], given.seed + k, Path(folder)))
            before, after = np.sqrt(np.mean(np.square(found), axis=0))
            print(f"{cause:12s} {before:.4f} -> {after:.4f}", flush=True)
        return
    print(f"rms error of the bias on {given.target}, {given.records} records, deg/s: base model -> extended one")
    for cause in given.cause or EFFECTS:
        all_errors = []
        for k in range(given.records):
            with tempfile.TemporaryDirectory() as folder:
                all_errors.append(errors(EFFECTS[cause], given.target, given.seed + k, Path(folder)))
        rms = np.sqrt(np.mean(np.square(all_errors), axis=0))
        cells = (f"{h} s: {b:.4f} -> {e:.4f}" for h, b, e in zip(HORIZONS_S, *rms, strict=True))
        print(f"{cause:12s} {', '.join(cells)}", flush=True)
        assert all(math.isfinite(value) for value in rms.ravel())


if __name__ == "__main__":
    main()
