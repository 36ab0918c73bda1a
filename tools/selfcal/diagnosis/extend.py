"""The extended model file: the model that was diagnosed, with every cause that a model file can state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from selfcal.diagnosis.loop import Diagnosed
from selfcal.diagnosis.record import Record
from selfcal.model import MOST_COLUMNS, Model

#: Prior sd of a coefficient over its size: wide, since the size is known from this record alone.
WIDE = 5.0
#: Laws that a named cause asks for, and what their priors need beside the file's own.
LAWS = {"flicker": "flicker", "colored_noise": "moving_average"}


def extended(model: Model, record: Record, found: Mapping[str, Diagnosed]) -> dict[str, Any]:
    """The model file's tree. `simulate` in it reproduces each axis: its law, parameters, bias and effects."""
    tree: dict[str, Any] = yaml.safe_load(model.path.read_text(encoding="utf-8"))
    tree["name"] = f"{model.name}, extended"
    entries: dict[str, dict[str, Any]] = {}
    for name, one in found.items():
        group = model.group_of(name).name
        for k, regressor in enumerate(one.state.regressors):
            key = regressor.name.removesuffix(".sin").removesuffix(".cos")
            entry = entries.setdefault(key, {"name": key, **regressor.entry, "sd": {}, "probability": 0.5})
            if regressor.cause == "cross_axis":
                entry["reference"] = float(f"{record.axes[str(regressor.entry['column'])].level:.6g}")
            size = abs(float(one.state.best.c[1 + k])) + 2.0 * float(one.state.best.sd[1 + k])
            entry["sd"][group] = max(float(entry["sd"].get(group, 0.0)), float(f"{WIDE * size:.3g}"))
    kept: list[dict[str, Any]] = []
    used = 0
    for entry in entries.values():
        columns = 2 if entry["kind"] == "periodic" else 1
        if used + columns <= MOST_COLUMNS:
            kept.append(entry)
            used += columns
    if kept:
        tree["regressors"] = [*(tree.get("regressors") or []), *kept]
    for name, one in found.items():
        group = tree["groups"][model.group_of(name).name]
        for finding in one.findings:
            estimate = finding.look.estimate
            law = LAWS.get(finding.look.cause)
            if law is not None:
                tree["hypotheses"].setdefault(law, 1)
                tree["nodes"]["host"].setdefault(law, [24, 20])
                if law == "flicker":
                    group["priors"].setdefault("B", dict(group["priors"]["sigma_m"]))
                else:
                    group["priors"].setdefault("spectral_ratio", {"law": "log_uniform", "min": 0.2, "max": 5.0})
            elif finding.look.cause == "quantization":
                group["lsb"] = float(f"{estimate['lsb']['median']:.8g}")
            elif finding.look.cause == "saturation":
                group["range"] = float(f"{abs(estimate['limit']['median']):.8g}")
    # Every group needs the priors of every law.
    for group in tree["groups"].values():
        if "flicker" in tree["hypotheses"]:
            group["priors"].setdefault("B", dict(group["priors"]["sigma_m"]))
        if "moving_average" in tree["hypotheses"]:
            group["priors"].setdefault("spectral_ratio", {"law": "log_uniform", "min": 0.2, "max": 5.0})
    tree["simulate"] = {
        "rate_hz": record.rate_hz,
        "duration_s": float(record.present.size / record.rate_hz),
        "axes": {name: _truth(one) for name, one in found.items()},
        "effects": [text for name, one in found.items() for text in _effects(name, one, record)],
    }
    return tree


def _truth(one: Diagnosed) -> dict[str, Any]:
    """The fitted law in the words of `simulate`: the base drift, white noise at low frequency, the bias."""
    fit = one.state.best
    N = fit.sigma * math.sqrt(fit.dt)
    # The read-out adds lsb^2 / 12 by itself.
    N = math.sqrt(max(N * N - one.state.lsb**2 / 12.0 * fit.dt, 1e-4 * N * N))
    truth: dict[str, Any] = {
        "hypothesis": "constant",
        "bias": _digits(one.state.level + float(fit.c[0])),
        "N": _digits(N),
    }
    if fit.terms.walk:
        truth |= {
            "hypothesis": "random_walk",
            "K": _digits(fit.sigma * math.exp(fit.value("ln_rho")) / math.sqrt(fit.dt)),
        }
    elif fit.terms.markov:
        truth |= {
            "hypothesis": "gauss_markov",
            "sigma_m": _digits(fit.sigma * math.exp(fit.value("ln_markov"))),
            "alpha": _digits(math.exp(fit.value("ln_alpha"))),
        }
    return truth


def _digits(value: float) -> float:
    return float(f"{value:.6g}")


def _effects(name: str, one: Diagnosed, record: Record) -> list[str]:
    """`--effect` texts that put each finding back into a simulated record."""
    texts: list[str] = []
    for finding in one.findings:
        estimate = finding.look.estimate
        pairs = {
            key: value["median"] for key, value in estimate.items() if isinstance(value, Mapping) and key != "limit"
        }
        if finding.look.cause == "outliers":
            pairs.pop("time_s", None)
        if finding.look.cause in ("unexplained", "quantization", "saturation"):
            continue  # the lattice and the range are in the groups
        if finding.look.cause in ("missing_samples", "motion"):
            pairs = {key: int(max(1, round(value))) for key, value in pairs.items()}
        where = "" if finding.look.cause == "missing_samples" else f",axis={name}"
        if finding.look.cause == "cross_axis":
            where += f",other={estimate['other']}"
        text = f"{finding.look.cause}:" + ",".join(f"{key}={value:.8g}" for key, value in pairs.items()) + where
        if finding.look.cause != "missing_samples" or not any(old.startswith("missing") for old in texts):
            texts.append(text)
    return texts


def as_text(tree: Mapping[str, Any], source: Path | str) -> str:
    """The file's text."""
    head = f"# Written by `selfcal diagnose` from {Path(source).name}: the model with what was found in it.\n"
    return head + str(yaml.safe_dump(dict(tree), sort_keys=False, allow_unicode=True, width=110))
