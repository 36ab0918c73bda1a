"""The extended model file: the model that was diagnosed, with every cause that a model file can state."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from selfcal.adequacy.part import density_without, lattice_density, put_read_out
from selfcal.bank.priors import state_own
from selfcal.base.ending import Stopped
from selfcal.base.errors import UserError, note, remark
from selfcal.base.output import write_text
from selfcal.diagnosis.cause import Cause, Extension
from selfcal.diagnosis.causes import CAUSES
from selfcal.diagnosis.causes.vibration import WIDTHS_S
from selfcal.diagnosis.channel_looks import form_of
from selfcal.diagnosis.finding import Diagnosed, Finding
from selfcal.diagnosis.model_tree import digits
from selfcal.diagnosis.record import Record
from selfcal.likelihood.fit import fit_at
from selfcal.likelihood.state import FittedColumn as Column
from selfcal.model.file import LONGEST_TEXT, MOST_BANK_COLUMNS, MOST_STATED, SMALLEST, Model
from selfcal.model.forms import NUMBER, curved, formed
from selfcal.model.laws import averaged
from selfcal.model.regressors import trailing_mean

#: Prior sd of a coefficient over its size: wide, since the size is known from this record alone.
WIDE_PRIOR = 5.0
#: Why a module leaves a finding out.
NO_ROOM = f"a bank has {MOST_BANK_COLUMNS} columns, and more evidence fills them: `diagnose` alone takes the others"
#: Begins each file that is written here.
HEAD = "# Written by `selfcal diagnose`"


def extended(
    model: Model, record: Record, found: Mapping[str, Diagnosed], sensor: str | None = None
) -> tuple[dict[str, Any], str]:
    """The model file's tree, and a line on its read-out; `record` is the finest of those that `found` was found in.
    `simulate` in it reproduces each axis: its law, parameters, bias and effects. `sensor`: a name for it where nobody
    stated a model, so that its read-out is the recording's alone."""
    tree: dict[str, Any] = yaml.safe_load(model.path.read_text(encoding="utf-8"))
    tree["name"] = f"{model.name}, extended"
    state_own(tree, model)
    if sensor is not None:
        tree["sensor"]["name"] = remark(sensor)[:LONGEST_TEXT]
    readings = {name: record.readings[name] for name in found if name in record.readings}
    said = put_read_out(tree, model, readings, stated=sensor is None) if readings else ""
    kept = _regressors(model, record, found)
    if kept:
        tree["regressors"] = [*(tree.get("regressors") or []), *kept]
    for name, axis in found.items():
        for finding in axis.findings:
            extend = CAUSES[finding.look.cause].written.extend
            if extend is not None:
                extend(Extension(tree, model, record, name, found, finding))
    _fit_small(tree, kept)
    # Block means have no lattice, so the recording's own rate; noise with memory is known at the rate looked at alone.
    colored = any(axis.state.extras.color for axis in found.values())
    block = 1 if colored else max(1, round(record.recorded_hz / record.rate_hz))
    tree["simulate"] = {
        "rate_hz": record.rate_hz if colored else record.recorded_hz,
        "duration_s": float(record.present.size / record.rate_hz),
        "axes": {
            name: fitted_law(
                axis, block, lattice_density(tree["groups"][model.group_of(name).name], tree["sensor"]["rate_hz"])
            )
            for name, axis in found.items()
        },
        "effects": list(dict.fromkeys(text for name, axis in found.items() for text in _effects(name, axis))),
    }
    return tree, said


def _fit_small(tree: dict[str, Any], regressors: list[dict[str, Any]]) -> None:
    """Fewer nodes on the Cortex-M0 where its RAM needs them: with a second column, or a law that is a sum."""
    columns = sum(2 if entry["kind"] == "periodic" else 1 for entry in regressors)  # a sine and a cosine of a line
    nodes = tree["nodes"]
    if "cortex-m0" in nodes and "cortex-m0-small" in nodes:
        plain = ("random_walk", "gauss_markov")
        if columns > 1 or any(law not in plain for law in nodes["cortex-m0"]):
            nodes["cortex-m0"].update({law: nodes["cortex-m0-small"][law] for law in plain})


def _fitting(model: Model, found: Mapping[str, Diagnosed]) -> tuple[list[str], list[tuple[str, Finding]]]:
    """Regressors that the model file has room for: those that a bank has columns for first, and the most evidence
    first. Findings that a bank has no columns for, with their axes: a finding fits whole or not at all."""
    stated = {column for regressor in model.regressors for column in regressor.columns}
    beyond = {column for axis in model.beyond for column in axis.columns}
    offered: list[tuple[float, str, Finding | None, dict[str, int]]] = []
    for name, axis in found.items():
        places = {
            column.name: k
            for k, column in enumerate(axis.state.regressors, 1)
            if column.name not in stated | beyond and column.entry
        }
        owner = {column.name: finding for finding in axis.findings for column in finding.columns}
        groups: dict[object, list[str]] = {}
        for column in places:
            of = owner.get(column)
            groups.setdefault(regressor_key(column) if of is None else id(of), []).append(column)
        for columns in groups.values():
            finding = owner.get(columns[0])
            c, sd = (getattr(axis.state.best, of)[[places[column] for column in columns]] for of in ("c", "sd"))
            gain = finding.look.gain if finding else 0.5 * float(np.sum((c / np.maximum(sd, 1e-300)) ** 2))
            offered.append(
                (gain, name, finding or _fundamental(axis, columns[0]), dict(Counter(map(regressor_key, columns))))
            )
    kept: dict[str, bool] = {}
    out: list[tuple[str, Finding]] = []
    of_bank, of_file = len(stated), len(stated | beyond)
    for _, name, finding, keys in sorted(offered, key=lambda axis: -axis[0]):
        more = {key: count for key, count in keys.items() if key not in kept}
        fits = of_bank + sum(more.values()) <= MOST_BANK_COLUMNS
        of_bank += fits * sum(more.values())
        if finding is not None and not fits and all(finding is not each for _, each in out):
            out.append((name, finding))
        if of_file + sum(more.values()) <= MOST_STATED:
            of_file += sum(more.values())
            kept |= dict.fromkeys(more, fits)
    return sorted(kept, key=lambda key: not kept[key]), out


def _fundamental(axis: Diagnosed, harmonic: str) -> Finding | None:
    """The finding that a harmonic's column belongs to."""
    hz = next(float(column.entry["frequency_hz"]) for column in axis.state.regressors if column.name == harmonic)

    def off(finding: Finding) -> float:
        turns = hz / float(finding.look.estimate["frequency_hz"]["median"])
        return abs(turns - round(turns))

    return min((each for each in axis.findings if "harmonics" in each.look.estimate), key=off, default=None)


def no_room(model: Model, found: Mapping[str, Diagnosed]) -> list[tuple[str, Finding]]:
    """Findings whose columns a bank has no room for, each with its axis. Those of most evidence have it."""
    return _fitting(model, found)[1]


def _regressors(model: Model, record: Record, found: Mapping[str, Diagnosed]) -> list[dict[str, Any]]:
    """Entries for the columns that were found, the most evidence first, as many as a model may have."""
    kept = _fitting(model, found)[0]
    entries: dict[str, dict[str, Any]] = {}
    smoothed: set[str] = set()
    for name, axis in found.items():
        group = model.group_of(name).name
        for k, regressor in enumerate(axis.state.regressors):
            key = regressor_key(regressor.name)
            if key not in kept:
                continue
            finding = finding_of(axis, regressor)
            look = None if finding is None else finding.look
            own = CAUSES[regressor.cause].written.entry(regressor.entry, look, record)
            entry = entries.setdefault(key, {"name": key, **own, "sd": {}, "probability": 0.5})
            form = entry.get("form")
            if entry["kind"] == "column" and (
                form == "rate" or (CAUSES[regressor.cause].written.smoothed and form != "lag")
            ):
                smoothed.add(key)
            c, sd = float(axis.state.best.c[1 + k]), float(axis.state.best.sd[1 + k])
            entry["sd"][group] = max(float(entry["sd"].get(group, 0.0)), digits(WIDE_PRIOR * (abs(c) + 2.0 * sd), 3))
    for key in smoothed:
        _smooth(entries[key], key, found)
    return [entries[key] for key in kept]


def finding_of(axis: Diagnosed, column: Column) -> Finding | None:
    """The finding that added a column to the model; None: the model file had it, or its line is a harmonic."""
    return next((each for each in axis.findings if column.name in {added.name for added in each.columns}), None)


def _smooth(entry: dict[str, Any], name: str, found: Mapping[str, Diagnosed]) -> None:
    """The window whose trailing mean, or slope, explains the axes best. A centred window, as in the diagnosis, needs
    values that a module does not have yet; a trailing window lags, so a shorter window suits it."""
    explained = [axis for axis in found.values() if any(column.name == name for column in axis.state.regressors)]
    record = max((axis.record for axis in explained), key=lambda record: record.rate_hz)
    gains: dict[float, float] = {}
    for width in WIDTHS_S:
        window = max(1, round(width * record.rate_hz))
        if window > record.present.size // 10:
            break
        if window == 1 and entry.get("form") == "rate":  # a slope has two readings at least
            continue
        try:
            gains[width if window > 1 else 0.0] = sum(_with_values(axis, name, width, entry) for axis in explained)
        except Stopped:  # the shortest, which suits any
            break
    best = max(gains, key=lambda width: gains[width], default=None)
    if best is not None:
        entry.pop("window_s", None)
    if best:
        entry["window_s"] = best


def _with_values(axis: Diagnosed, name: str, width: float, entry: Mapping[str, Any]) -> float:
    """ln likelihood of the axis with a column of trailing means, or slopes, of `width` s, at the drift found."""
    record = axis.record
    channel = record.channel_of(str(entry["column"]), str(entry.get("input", "value")))
    form, about = str(entry.get("form", "static")), float(entry.get("reference", 0.0))
    if form == "rate":
        values = formed(channel - about, form, width, 0.0, 1.0 / record.rate_hz)
    else:
        means = trailing_mean(channel, max(1, round(width * record.rate_hz)))
        number = float(entry.get(NUMBER.get(form, ""), math.nan))
        values = curved(means, entry["knots"]) if form == "free" else formed(means - about, form, number)
    columns = tuple(
        replace(column, values=values) if column.name == name else column for column in axis.state.regressors
    )
    fit = axis.state.best
    return fit_at(replace(axis.state, regressors=columns).series, fit.terms, fit.theta).ln_likelihood


def fitted_law(axis: Diagnosed, block: int | None = None, rounded: float = 0.0) -> dict[str, Any]:
    """The fitted law in the words of `simulate`: the base drift, white noise at low frequency, the bias.

    The fit takes the drift for a point at each of its samples, which are means of `block` others (laws.averaged), by
    default of the recording's. `rounded`: density that the read-out adds by itself (part.lattice_density).
    """
    block = max(1, round(axis.record.recorded_hz / axis.record.rate_hz)) if block is None else block
    fit = axis.state.best
    N = fit.N
    if fit.quantized:
        N = fit.N_of_color
    elif fit.terms.color:
        # The simulator's noise with memory has this level at low frequency, and (1 - lag1) / (1 + lag1) of it in all.
        m = math.tanh(fit.value("color"))
        lag1 = m if fit.terms.color == "ar" else m / (1.0 + m * m)
        N *= math.sqrt((1.0 + lag1) / (1.0 - lag1))
    N = density_without(N, rounded)
    drift: dict[str, Any] = {"hypothesis": "constant"}
    lacking = 0.0
    if fit.terms.walk:
        drift = {"hypothesis": "random_walk", "K": digits(fit.K)}
        lacking = (1.0 - 1.0 / block**2) / 6.0 * fit.K**2 * fit.dt
    elif fit.terms.markov:
        gain, rest = averaged(fit.alpha * fit.dt, block)
        sigma_m = fit.sigma_m / math.sqrt(gain)
        drift = {"hypothesis": "gauss_markov", "sigma_m": digits(sigma_m), "alpha": digits(fit.alpha)}
        lacking = rest * sigma_m**2
    # The simulator's ramp and temperature begin at 0, but for a rate.
    at_first = sum(
        float(c * column.values[0])
        for c, column in zip(fit.c[1:], axis.state.regressors, strict=True)
        if column.cause in CAUSES and CAUSES[column.cause].written.from_zero and form_of(column)[2] != "rate"
    )
    return {
        "hypothesis": drift.pop("hypothesis"),
        "bias": digits(axis.state.level + float(fit.c[0]) + at_first),
        "N": digits(max(math.hypot(N, math.sqrt(lacking * fit.dt)), SMALLEST)),
        **drift,
    }


def regressor_key(column: str) -> str:
    """Name of the regressor that a column belongs to."""
    return column.removesuffix(".sin").removesuffix(".cos")


def _effects(name: str, axis: Diagnosed) -> list[str]:
    """`--effect` texts that put what an axis has into a simulated record. The simulator itself has a single effect of a
    kind on an axis: the strongest. Effects that a cause adds are all there. The forms of a channel are one effect."""
    joined: dict[object, _Effect] = {}
    for k, effect in enumerate([*_of_columns(axis), *_of_findings(axis)]):
        place: object = (effect.cause.id, *effect.channel) if effect.channel else k
        known = joined.get(place, replace(effect, strength=0.0))
        sizes = {key: value for key, value in effect.keys.items() if value}
        keys = {**effect.keys, **known.keys, **sizes}
        joined[place] = replace(effect, strength=known.strength + effect.strength, keys=keys)
    strongest: dict[object, _Effect] = {}
    for k, effect in enumerate(joined.values()):
        kind: object = k if effect.cause.several else effect.cause.id
        if kind not in strongest or strongest[kind].strength < effect.strength:
            strongest[kind] = effect
    texts = []
    for effect in strongest.values():
        where = {} if effect.cause.simulated.common else {"axis": name}
        values = {key: f"{value:.8g}" if isinstance(value, float) else value for key, value in effect.keys.items()}
        texts.append(f"{effect.cause.id}:" + ",".join(f"{key}={value}" for key, value in {**values, **where}.items()))
    return texts


@dataclass(frozen=True)
class _Effect:
    """An effect of the simulator: `strength` in nats, its `keys`, and the channel and input that it follows."""

    cause: Cause
    strength: float
    keys: dict[str, Any]
    channel: tuple[str, ...] = ()


def _channel_of(column: Column) -> tuple[str, ...]:
    """Channel and input of a column."""
    return form_of(column)[:2] if column.entry.get("column") else ()


def _of_findings(axis: Diagnosed) -> Iterator[_Effect]:
    """Effects of findings, also of those that the model file states. Groups have the lattice and the range."""
    for finding in (*axis.findings, *axis.stated):
        cause = CAUSES[finding.look.cause]
        keys = cause.effect(finding.look)
        if keys is not None:
            channel = _channel_of(finding.columns[0]) if finding.columns else ()
            yield _Effect(cause, finding.look.gain, keys, channel)


def _of_columns(axis: Diagnosed) -> Iterator[_Effect]:
    """Effects of the columns that the model file had."""
    fit = axis.state.best
    sizes: dict[str, list[int]] = {}
    for k, column in enumerate(axis.state.regressors):
        if finding_of(axis, column) is None:
            sizes.setdefault(regressor_key(column.name), []).append(k)
    for places in sizes.values():
        column = axis.state.regressors[places[0]]
        c = [float(fit.c[1 + k]) for k in places]
        strength = sum(
            0.5 * (value / max(float(fit.sd[1 + k]), 1e-300)) ** 2 for value, k in zip(c, places, strict=True)
        )
        cause = CAUSES.get(column.cause)
        if cause is not None and cause.written.of_column is not None:
            yield _Effect(cause, strength, cause.written.of_column(column, c), _channel_of(column))


def check_not_by_hand(path: Path | str | None) -> None:
    """Raise UserError for an older file that `model_text` has not made: its author wants to keep it."""
    if path is None or not Path(path).is_file() or Path(path).stat().st_size == 0:
        return
    with Path(path).open("rb") as file:
        if not file.read(len(HEAD)) == HEAD.encode():
            raise UserError(
                f"{path}: `selfcal diagnose` did not write this file and does not write over it: give --write-model "
                "another name, or delete the file"
            )


def write_extended(
    path: Path | str, tree: Mapping[str, Any], source: Path | str, said: str, out: Sequence[tuple[str, Finding]]
) -> None:
    """Write the file. `said`: of its read-out; `out`: findings that a module leaves out. Notes name both."""
    write_text(path, model_text(tree, source, said))
    note(f"{path}: {said}")
    if out:
        causes = ", ".join(f"{name} {finding.look.cause} ({finding.look.gain:.1f} nats)" for name, finding in out)
        note(f"{path}: a module leaves out {causes}: {NO_ROOM}")


def model_text(tree: Mapping[str, Any], source: Path | str, said: str) -> str:
    """The file's text. `said`: of its read-out."""
    head = f"{HEAD} from {remark(Path(source).name)}: the model with what was found in it.\n# {remark(said)}\n"
    return head + str(yaml.safe_dump(dict(tree), sort_keys=False, allow_unicode=True, width=110))
