"""The extended model file: the model that was diagnosed, with every cause that a model file can state."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from selfcal.diagnosis.fit import finish
from selfcal.diagnosis.loop import Diagnosed
from selfcal.diagnosis.record import Record
from selfcal.ending import Stopped
from selfcal.errors import UserError, remark
from selfcal.laws import RATIO_LIMITS, averaged
from selfcal.model import MOST_COLUMNS, Model
from selfcal.regressors import trailing_mean

#: Prior sd of a coefficient over its size: wide, since the size is known from this record alone.
WIDE = 5.0
#: Standard deviations of a sample beyond which a module keeps it out: of normal noise one in 5e8.
OUTLIER_SD = 6.0
#: Nodes on the host of a law that is a sum: `sums.yaml` says what they bear.
NODES = [24, 20]
#: ... on the Cortex-M0, whose RAM holds one such law beside the random walk.
SMALL_NODES = [12, 8]
#: Begins each file that is written here.
HEAD = "# Written by `selfcal diagnose`"
#: Windows of a channel's trailing mean, s.
WINDOWS_S = (1.0, 3.0, 10.0, 30.0, 90.0)


def extended(model: Model, record: Record, found: Mapping[str, Diagnosed]) -> dict[str, Any]:
    """The model file's tree; `record` is the finest of those that `found` was found in. `simulate` in
    it reproduces each axis: its law, parameters, bias and effects."""
    tree: dict[str, Any] = yaml.safe_load(model.path.read_text(encoding="utf-8"))
    tree["name"] = f"{model.name}, extended"
    kept = _regressors(model, record, found)
    if kept:
        tree["regressors"] = [*(tree.get("regressors") or []), *kept]
    for name, one in found.items():
        group = tree["groups"][model.group_of(name).name]
        for finding in one.findings:
            estimate = finding.look.estimate
            if finding.look.cause == "flicker":
                _law(tree, "flicker", "B", dict(group["priors"]["sigma_m"]))
            elif finding.look.cause == "colored_noise":
                _color(tree, one)
            elif finding.look.cause == "quantization":
                group["lsb"] = _digits(estimate["lsb"]["median"])
            elif finding.look.cause == "saturation":
                limit = abs(estimate["limit"]["median"])
                # A model file states one range for a group: not one that keeps another axis out that was looked at.
                if all(_within(record, other, limit) for other in group["axes"] if other != name and other in found):
                    group["range"] = _digits(limit)
            elif finding.look.cause == "outliers":
                _handle(tree, "outlier_sd", OUTLIER_SD)
            elif finding.look.cause == "variance_change" and not tree.get("regressors"):
                _handle(tree, "variance_changes", True)
    _fit_small(tree, kept)
    # Block means have no lattice, so the recording's own rate; noise with memory is known at the rate looked at alone.
    colored = any(one.state.extras.color for one in found.values())
    block = 1 if colored else max(1, round(record.recorded_hz / record.rate_hz))
    tree["simulate"] = {
        "rate_hz": record.rate_hz if colored else record.recorded_hz,
        "duration_s": float(record.present.size / record.rate_hz),
        "axes": {name: fitted_law(one, block) for name, one in found.items()},
        "effects": list(dict.fromkeys(text for name, one in found.items() for text in _effects(name, one))),
    }
    return tree


def _handle(tree: dict[str, Any], what: str, value: float | bool) -> None:
    """Have the module handle something by itself, unless the model says already how."""
    tree["handle"] = {what: value, **(tree.get("handle") or {})}


def _within(record: Record, axis: str, limit: float) -> bool:
    """Whether all readings of an axis are within the limit; one that was not recorded is."""
    state = record.axes.get(axis)
    return state is None or bool(np.nanmax(np.abs(state.y + state.level)) < limit)


def _columns_of(entry: Mapping[str, Any]) -> int:
    """How many a regressor has: a sine and a cosine of a line."""
    return 2 if entry["kind"] == "periodic" else 1


def _fit_small(tree: dict[str, Any], regressors: list[dict[str, Any]]) -> None:
    """Fewer nodes on the Cortex-M0 where its RAM needs them: beside a second column, or a law that is a sum."""
    columns = sum(map(_columns_of, regressors))
    nodes = tree["nodes"]
    if "cortex-m0" in nodes and "cortex-m0-small" in nodes:
        plain = ("random_walk", "gauss_markov")
        if columns > 1 or any(law not in plain for law in nodes["cortex-m0"]):
            nodes["cortex-m0"].update({law: nodes["cortex-m0-small"][law] for law in plain})


def _regressors(model: Model, record: Record, found: Mapping[str, Diagnosed]) -> list[dict[str, Any]]:
    """Entries for the columns that were found, the strongest first, as many as a model may have."""
    stated = {column for one in model.regressors for column in one.columns}
    entries: dict[str, dict[str, Any]] = {}
    strength: dict[str, float] = {}
    for name, one in found.items():
        group = model.group_of(name).name
        for k, regressor in enumerate(one.state.regressors):
            if regressor.name in stated:
                continue
            key = _key(regressor.name)
            entry = entries.setdefault(key, {"name": key, **regressor.entry, "sd": {}, "probability": 0.5})
            if regressor.cause == "step":  # its time is one of the whole recording's
                time_s = float(regressor.entry["time_s"]) + record.start_s
                entry |= {"name": f"step_{time_s:.6g}s", "time_s": time_s}
            if regressor.cause == "cross_axis":
                entry["reference"] = _digits(record.axes[str(regressor.entry["column"])].level)
            c, sd = float(one.state.best.c[1 + k]), float(one.state.best.sd[1 + k])
            entry["sd"][group] = max(float(entry["sd"].get(group, 0.0)), float(f"{WIDE * (abs(c) + 2.0 * sd):.3g}"))
            strength[key] = max(strength.get(key, 0.0), abs(c) / max(sd, 1e-300))
    kept: list[dict[str, Any]] = []
    used = len(stated)
    for key in sorted(entries, key=lambda key: -strength[key]):
        entry = entries[key]
        columns = _columns_of(entry)
        if used + columns <= MOST_COLUMNS:
            if key in record.channels:
                _smooth(entry, key, found)
            kept.append(entry)
            used += columns
    return kept


def _smooth(entry: dict[str, Any], channel: str, found: Mapping[str, Diagnosed]) -> None:
    """The window whose trailing mean explains the axes best. A centred mean, which the diagnosis takes, needs values
    that a module does not have yet; a trailing one lags, so a shorter window suits it."""
    explained = [one for one in found.values() if any(column.name == channel for column in one.state.regressors)]
    record = max((one.record for one in explained), key=lambda record: record.rate_hz)
    gains: dict[float, float] = {}
    for width in WINDOWS_S:
        window = max(1, round(width * record.rate_hz))
        if window > record.present.size // 10:
            break
        try:
            gains[width if window > 1 else 0.0] = sum(
                _with_values(one, channel, width, float(entry["reference"])) for one in explained
            )
        except Stopped:  # the shortest, which suits any
            break
    best = max(gains, key=lambda width: gains[width], default=0.0)
    entry.pop("window_s", None)
    if best:
        entry["window_s"] = best


def _with_values(one: Diagnosed, channel: str, width: float, reference: float) -> float:
    """ln likelihood of the axis with trailing means of `width` s as the values of a channel, at the drift found."""
    record = one.record
    values = trailing_mean(record.channels[channel], max(1, round(width * record.rate_hz))) - reference
    columns = tuple(
        replace(column, values=values) if column.name == channel else column for column in one.state.regressors
    )
    fit = one.state.best
    return finish(replace(one.state, regressors=columns).series, fit.terms, fit.theta).ln_likelihood


def _law(tree: dict[str, Any], law: str, parameter: str, prior: Mapping[str, Any]) -> None:
    """Have the model one law more, with a prior of its parameter in every group and nodes on every target."""
    tree["hypotheses"].setdefault(law, 1)
    for target, nodes in tree["nodes"].items():
        own = {"host": NODES, "cortex-m0": SMALL_NODES}.get(target, nodes["gauss_markov"])
        nodes.setdefault(law, list(own))
    for group in tree["groups"].values():
        own = dict(group["priors"]["sigma_m"]) if parameter == "B" else dict(prior)
        group["priors"].setdefault(parameter, own)


def _color(tree: dict[str, Any], one: Diagnosed) -> None:
    """A law for white noise with memory.

    A first-order process at the bank's own rate is a Gauss-Markov drift of its correlation time, beside a walk. Block
    means of a faster one, and a moving average, are correlated with their neighbours alone."""
    fit = one.state.best
    correlation = math.tanh(fit.value("color"))
    at_bank_rate = abs(fit.dt * float(tree["bank_rate_hz"]) - 1.0) < 0.01
    if fit.terms.color == "ar" and correlation > 0.0 and at_bank_rate and "correlation_time_s" not in tree:
        time_s = -fit.dt / math.log(correlation)
        K = fit.sigma * math.exp(fit.value("ln_rho")) / math.sqrt(fit.dt) if fit.terms.walk else 0.0
        most = min(10.0 * fit.sigma / max(K * math.sqrt(time_s), 1e-300), RATIO_LIMITS[1])
        tree["correlation_time_s"] = _digits(time_s)
        prior = {"law": "log_uniform", "min": _digits(0.01 * most), "max": _digits(most)}
        _law(tree, "walk_and_markov", "markov_ratio", prior)
        return
    _law(tree, "moving_average", "spectral_ratio", {"law": "log_uniform", "min": 0.2, "max": 5.0})


def fitted_law(one: Diagnosed, block: int | None = None) -> dict[str, Any]:
    """The fitted law in the words of `simulate`: the base drift, white noise at low frequency, the bias.

    The fit takes the drift for a point at each of its samples, which are means of `block` others (laws.averaged), by
    default of the recording's.
    """
    block = max(1, round(one.record.recorded_hz / one.record.rate_hz)) if block is None else block
    fit = one.state.best
    N = fit.sigma * math.sqrt(fit.dt)
    if fit.terms.color:
        # The simulator's noise with memory has this level at low frequency, and (1 - lag1) / (1 + lag1) of it in all.
        m = math.tanh(fit.value("color"))
        lag1 = m if fit.terms.color == "ar" else m / (1.0 + m * m)
        N *= math.sqrt((1.0 + lag1) / (1.0 - lag1))
    # The read-out adds lsb^2 / 12 by itself.
    N = math.sqrt(max(N * N - one.state.lsb**2 / 12.0 * fit.dt, 1e-4 * N * N))
    drift: dict[str, Any] = {"hypothesis": "constant"}
    lacking = 0.0
    if fit.terms.walk:
        K = fit.sigma * math.exp(fit.value("ln_rho")) / math.sqrt(fit.dt)
        drift = {"hypothesis": "random_walk", "K": _digits(K)}
        lacking = (1.0 - 1.0 / block**2) / 6.0 * K**2 * fit.dt
    elif fit.terms.markov:
        alpha = math.exp(fit.value("ln_alpha"))
        gain, rest = averaged(alpha * fit.dt, block)
        sigma_m = fit.sigma * math.exp(fit.value("ln_markov")) / math.sqrt(gain)
        drift = {"hypothesis": "gauss_markov", "sigma_m": _digits(sigma_m), "alpha": _digits(alpha)}
        lacking = rest * sigma_m**2
    # The simulator's ramp and temperature begin at 0.
    at_first = sum(
        float(c * column.values[0])
        for c, column in zip(fit.c[1:], one.state.regressors, strict=True)
        if column.cause in ("ramp", "temperature")
    )
    return {
        "hypothesis": drift.pop("hypothesis"),
        "bias": _digits(one.state.level + float(fit.c[0]) + at_first),
        "N": _digits(math.sqrt(N**2 + lacking * fit.dt)),
        **drift,
    }


def _seconds(value: float) -> str:
    return f"{value:.4f}".rstrip("0").rstrip(".")


def _digits(value: float) -> float:
    return float(f"{value:.6g}")


def _key(column: str) -> str:
    """Name of the regressor that a column belongs to."""
    return column.removesuffix(".sin").removesuffix(".cos")


def _effects(name: str, one: Diagnosed) -> list[str]:
    """`--effect` texts that put what an axis has into a simulated record. The simulator has one effect of a kind on an
    axis: the strongest."""
    found = [*_of_columns(one), *_of_findings(one)]
    strongest: dict[str, tuple[float, dict[str, Any]]] = {}
    for cause, strength, pairs in found:
        if cause not in strongest or strongest[cause][0] < strength:
            strongest[cause] = (strength, pairs)
    texts = []
    for cause, (_, pairs) in strongest.items():
        where = {} if cause == "missing_samples" else {"axis": name}
        values = {key: f"{value:.8g}" if isinstance(value, float) else value for key, value in pairs.items()}
        texts.append(f"{cause}:" + ",".join(f"{key}={value}" for key, value in {**values, **where}.items()))
    return texts


def _of_columns(one: Diagnosed) -> Iterator[tuple[str, float, dict[str, Any]]]:
    """Cause, strength in nats, and the effect's keys, of the columns in an axis' model."""
    fit = one.state.best
    sizes: dict[str, list[int]] = {}
    for k, column in enumerate(one.state.regressors):
        sizes.setdefault(_key(column.name), []).append(k)
    for places in sizes.values():
        column = one.state.regressors[places[0]]
        c = [float(fit.c[1 + k]) for k in places]
        strength = sum(
            0.5 * (value / max(float(fit.sd[1 + k]), 1e-300)) ** 2 for value, k in zip(c, places, strict=True)
        )
        entry = column.entry
        if column.cause in ("temperature", "supply"):
            yield column.cause, strength, {"coefficient": c[0]}
        elif column.cause == "cross_axis":
            yield column.cause, strength, {"coefficient": c[0], "other": str(entry["column"])}
        elif column.cause == "ramp":
            yield column.cause, strength, {"slope": c[0]}
        elif column.cause == "step":
            yield column.cause, strength, {"time_s": float(entry["time_s"]), "amplitude": c[0]}
        elif column.cause == "periodic":
            yield column.cause, strength, {"frequency_hz": float(entry["frequency_hz"]), "amplitude": math.hypot(*c)}


def _of_findings(one: Diagnosed) -> Iterator[tuple[str, float, dict[str, Any]]]:
    """The same of what is no column. The lattice and the range are in the groups."""
    for finding in one.findings:
        look = finding.look
        median = {key: value["median"] for key, value in look.estimate.items() if isinstance(value, Mapping)}
        if look.cause in ("flicker", "colored_noise"):
            yield look.cause, look.gain, median
        elif look.cause == "periodic" and "width_hz" in median:
            yield look.cause, look.gain, {key: median[key] for key in ("frequency_hz", "amplitude")}
        elif look.cause == "outliers":
            yield look.cause, look.gain, {"fraction": median["fraction"]}
        elif look.cause == "variance_change":
            yield look.cause, look.gain, {key: median[key] for key in ("time_s", "ratio")}
        elif look.cause == "motion":
            times = "+".join(f"{_seconds(a)}-{_seconds(b)}" for a, b in look.estimate["intervals"])
            yield look.cause, look.gain, {"intervals": times}
        elif look.cause == "stuck":
            yield look.cause, look.gain, {"intervals": len(look.estimate["intervals"])}
        elif look.cause == "missing_samples":
            yield look.cause, look.gain, {key: max(1, round(value)) for key, value in median.items()}


def check_not_by_hand(path: Path | str) -> None:
    """Raise UserError for an older file that `as_text` has not made: its author wants to keep it."""
    path = Path(path)
    if not path.is_file() or path.stat().st_size == 0:
        return
    with path.open("rb") as file:
        if not file.read(len(HEAD)) == HEAD.encode():
            raise UserError(
                f"{path}: `selfcal diagnose` did not write this file and does not write over it: give --write-model "
                "another name, or delete the file"
            )


def as_text(tree: Mapping[str, Any], source: Path | str) -> str:
    """The file's text."""
    head = f"{HEAD} from {remark(Path(source).name)}: the model with what was found in it.\n"
    return head + str(yaml.safe_dump(dict(tree), sort_keys=False, allow_unicode=True, width=110))
