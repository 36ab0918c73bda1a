"""`selfcal simulate`: a recording of a resting sensor with known truth, read out as the sensor would."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from selfcal import _reference
from selfcal.adequacy.one_over_f import FLICKER, beside_its_law
from selfcal.base.errors import UserError, printable
from selfcal.base.grid import Array
from selfcal.diagnosis.cause import Cause, Channels, Key, Setting, is_count
from selfcal.diagnosis.causes import CAUSES
from selfcal.logs import recording
from selfcal.model.file import Group, Model
from selfcal.model.laws import NAMED, PARAMETERS, PLACES, Law

#: Streams of random numbers from here on draw what the model file leaves open; those below are the simulator's.
SEEDS = 2**32


def added_by(
    applied: Sequence[Mapping[str, Any]], model: Model, rate_hz: float, seed: int
) -> Callable[[Array, Array, Array], None] | None:
    """Adds the effects that a cause forms by itself, and the quantity that moves several axes, to `values` [axes, n]
    before the read-out; None without any."""
    own = [(form, effect["axes"]) for effect in applied if (form := CAUSES[effect["id"]].simulated.add) is not None]
    hidden = model.hidden_input
    if not own and hidden is None:
        return None

    def add(values: Array, temperature: Array, supply: Array) -> None:
        time_s = np.arange(temperature.size) / rate_hz
        axes = dict(zip(model.axes, values.copy(), strict=True))
        for number, (form, chosen) in enumerate(own):
            for name, keys in chosen.items():
                place = model.axes.index(name)
                random = np.random.default_rng([seed, number, place])
                values[place] += form(keys, Channels(time_s, temperature, supply, axes, random))
        if hidden is not None:
            random = np.random.default_rng([seed, len(own), len(model.axes)])
            course = _markov(hidden.deviation, hidden.alpha / rate_hz, temperature.size, random)
            for name, loading in hidden.loadings.items():
                values[model.axes.index(name)] += loading * course

    return add


def _markov(deviation: float, rate: float, n: int, random: np.random.Generator) -> Array:
    """A Gauss-Markov process [n] of this rate a sample."""
    from scipy.signal import lfilter

    steps = random.standard_normal(n) * math.sqrt(-math.expm1(-2.0 * rate))
    steps[0] = random.standard_normal()
    found: Array = deviation * lfilter([1.0], [1.0, -math.exp(-rate)], steps)
    return found


def put_faults(
    applied: Sequence[Mapping[str, Any]],
    model: Model,
    axes: Sequence[_reference.Axis],
    values: Array,
    rate_hz: float,
    random: _reference.Random,
) -> tuple[float, int] | None:
    """Put the faults of the bus and the logger into `values` [axes, n]. Returns the time of a change of the rate,
    s, and how many values make a reading from there on; None without a change."""
    changed = None
    for effect in applied:
        spoil = CAUSES[effect["id"]].simulated.spoil
        for name, keys in effect["axes"].items():
            place = model.axes.index(name)
            if spoil is not None:
                spoil(values[place], keys, rate_hz, axes[place].lsb, random)
            elif "after_hz" in keys:
                changed = (keys["time_s"], max(1, round(rate_hz / keys["after_hz"])))
    return changed


def slowed(
    stamps: Array, columns: Mapping[str, tuple[str, Array]], time_s: float, block: int
) -> tuple[Array, dict[str, tuple[str, Array]]]:
    """Means of `block` rows from `time_s` on, at the time of the last."""
    first = int(np.searchsorted(stamps, time_s))
    end = first + (stamps.size - first) // block * block

    def taken(row: Array) -> Array:
        return np.concatenate([row[:first], row[first:end].reshape(-1, block).mean(axis=1)])

    slower = np.concatenate([stamps[:first], stamps[first:end].reshape(-1, block)[:, -1]])
    return slower, {name: (unit, taken(row)) for name, (unit, row) in columns.items()}


def show_effects() -> None:
    """Print every effect of `--effect` with its keys, and the limits of a key where it has any."""
    print("--effect ID:key=value,... with these keys. Those that are not given have defaults, or are left out:")
    for cause in CAUSES.values():
        keys = [
            key if of.limits == Key(None).limits else f"{key} ({of.limits})" for key, of in cause.simulated.keys.items()
        ]
        if keys:
            print(f"  {cause.id:20}{', '.join([*keys, *_other_keys(cause)])}")


def _other_keys(cause: Cause) -> list[str]:
    """Keys whose values are names of axes."""
    return [*(["other"] if cause.simulated.follows else []), *([] if cause.simulated.common else ["axis"])]


def show(meta: Mapping[str, Any], output: Path | str) -> None:
    """Print what `simulate` has written, the truth's file too, and the truth."""
    output = Path(output)
    print(printable(f"{output}: {meta['samples']:,} samples at {meta['rate_hz']:g} Hz, seed {meta['seed']}"))
    within = output.suffix.lower() == ".npz"
    print("the truth, in its member `meta`:" if within else printable(f"{recording.meta_place(output)}: the truth:"))
    for axis, truth in meta["truth"].items():
        values = (f"{key} {truth[key]:.4g} {truth['units'][key]}" for key in ("bias", *PLACES) if key in truth)
        print(f"  {axis}: {truth['hypothesis']}, {', '.join(values)}")


def scene_of(model: Model, seed: int) -> _reference.Scene:
    """The part and its surroundings as a model's `simulate` entry states them. Raises UserError."""
    scene = _reference.Scene()
    scene.seed = seed
    scene.rate_hz = model.simulate.get("rate_hz", model.bank_rate_hz)
    if scene.rate_hz > 1.01 * model.sensor_rate_hz:
        raise UserError(f"{model.path}: simulate.rate_hz: the sensor gives {model.sensor_rate_hz:g} Hz at most")
    duration_s = model.simulate.get("duration_s", 3600.0)
    scene.samples = round(min(duration_s * scene.rate_hz, 1e18))
    if scene.samples < 2:
        raise UserError(f"{model.path}: simulate.duration_s: {duration_s:g} s hold fewer than two samples")
    readings, block = scene.samples * len(model.axes), max(1, round(model.sensor_rate_hz / scene.rate_hz))
    # 4 GB in memory, and a quarter of an hour.
    for much, most, what in ((readings, 100_000_000, "readings"), (readings * block, 10_000_000_000, "sensor samples")):
        if much > most:
            most_s = most / much * duration_s
            said = f"{duration_s:g} s are more than {most:,} {what}: take {most_s:.3g} s or a lower rate"
            raise UserError(f"{model.path}: simulate.duration_s: {said}")
    scene.block = block
    scene.filter_taps = model.filter_taps
    return scene


def truth_of(model: Model, seed: int) -> dict[str, dict[str, Any]]:
    """Per axis: hypothesis, unit, bias, and the parameters of its law; drawn where the model file leaves them open."""
    truth: dict[str, dict[str, Any]] = {}
    for number, name in enumerate(model.axes):
        where = f"axes.{name}"
        fields = model.simulate["axes"].get(name, {})
        # All are drawn, in a fixed order, so that stating a parameter leaves the others as they were.
        random = _reference.Random(seed, SEEDS + number)
        priors = model.group_of(name).priors
        law = _pick(model.hypotheses, random.uniform())
        drawn = {"bias": priors["bias"].sd * random.normal()}
        more = [parameter for parameter in priors if parameter not in ("bias", *PARAMETERS)]
        drawn |= {parameter: priors[parameter].at(random.uniform()) for parameter in (*PARAMETERS, *more)}
        law = fields.get("hypothesis", law)
        drawn |= {key: value for key, value in fields.items() if key != "hypothesis"}
        truth[name] = {"hypothesis": law, "unit": model.group_of(name).unit, "bias": drawn["bias"]}
        of = _laws(model).get(law)
        if of is None or any(math.isnan(term.bandwidth) for term in of.terms):
            raise UserError(f"{model.path}: simulate.{where}.hypothesis: the model has no hypothesis '{law}'")
        for parameter in of.parameters:
            if parameter not in drawn:
                raise UserError(f"{model.path}: simulate.{where}: '{parameter}' is missing and has no prior")
            truth[name][parameter] = drawn[parameter]
        times = [1.0 / term.bandwidth for term in of.terms if term.stated and term.kind == "markov"]
        if times:
            truth[name]["correlation_time_s"] = times[0] if len(times) == 1 else times
    return truth


def _laws(of: Model | Group) -> dict[str, Law]:
    """The laws that can be simulated: the model's, and those that have a name without it."""
    return {**NAMED, **of.laws}


def _pick(probability: Mapping[str, float], u: float) -> str:
    for name, share in probability.items():
        u -= share
        if u < 0.0:
            return name
    return next(reversed(list(probability)))


def axis_of(truth: Mapping[str, Any], group: Group, dt_s: float, block: int) -> _reference.Axis:
    """`dt_s`: the bank's interval, of `block` readings. 1/f noise above the law's fastest term is white there."""
    axis = _reference.Axis()
    law = _laws(group)[truth["hypothesis"]]
    white = beside_its_law(truth, dt_s, block) if truth["hypothesis"] == FLICKER else truth["N"]
    axis.law, axis.bias, axis.N = law.as_tuple, truth["bias"], white
    axis.drift, axis.second = law.node(truth)
    axis.range, axis.lsb = group.range, group.lsb
    return axis


def applied_to(text: str, model: Model, scene: _reference.Scene, axes: Sequence[_reference.Axis]) -> dict[str, Any]:
    """Put an effect, ID[:key=value,...], into the scene. Returns what was applied, default values filled in."""
    name, *pairs = re.split("[:,]", text)
    known = [cause.id for cause in CAUSES.values() if cause.simulated.keys]
    if name not in known:
        raise UserError(f"--effect: unknown effect '{name}' (known: {', '.join(known)})")
    cause = CAUSES[name]
    keys = cause.simulated.keys
    names = [*keys, *_other_keys(cause)]
    given: dict[str, str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if key not in names:
            raise UserError(f"--effect {name}: unknown key '{key}' (known: {', '.join(names)})")
        if not equals or not value or key in given:
            raise UserError(f"--effect {name}: write {key}=VALUE, once")
        given[key] = value
    chosen = [given["axis"]] if "axis" in given else list(model.axes)
    applied: dict[str, Any] = {"id": name, "axes": {}}
    for axis_name in chosen:
        group = model.group_of(axis_name)
        axis = axes[model.axes.index(axis_name)]
        sd = axis.N * math.sqrt(scene.rate_hz)
        setting = Setting(axis.N, sd, scene.samples / scene.rate_hz, scene.samples, axis.bias)
        record: dict[str, Any] = {}
        for key, entry in keys.items():
            if key == "intervals" and "-" in given.get(key, ""):
                record[key] = _intervals(given[key])
                scene.motion_times = [*scene.motion_times, *(time for pair in record[key] for time in pair)]
                continue
            if key == "knots" and key in given:
                record[key] = _knots(name, given[key])
                continue
            if key in given:
                value = _number(name, key, entry, given[key])
            elif entry.default is not None:
                value = entry.default(setting)
            else:
                continue
            whole = entry.fits is is_count
            record[key] = int(value) if whole else value
            if entry.field:
                setattr(scene if whole else axis, entry.field, record[key])
        if cause.simulated.follows:
            following = group.axes[(group.axes.index(axis_name) + 1) % len(group.axes)]
            record["other"] = given.get("other", following)
            model.group_of(record["other"])
            if record["other"] == axis_name:
                raise UserError(f"--effect {name}: axis {axis_name} cannot be its own other")
            if not cause.several:
                axis.cross_axis = model.axes.index(record["other"])
        applied["axes"][axis_name] = record
    return applied


def _intervals(text: str) -> list[list[float]]:
    """Times of motion, s: BEGIN-END+BEGIN-END..."""
    found = []
    for pair in text.split("+"):
        try:
            begin, end = map(float, pair.split("-"))
        except ValueError:
            begin = end = math.nan
        if not 0.0 <= begin < end < math.inf:
            raise UserError(f"--effect motion: write intervals=BEGIN-END+BEGIN-END in seconds, not '{text}'")
        found.append([begin, end])
    return found


def _knots(effect: str, text: str) -> list[list[float]]:
    """A curve of a channel: CHANNEL/HEIGHT+CHANNEL/HEIGHT..., the channel rising."""
    try:
        found = [[float(x) for x in pair.split("/")] for pair in text.split("+")]
    except ValueError:
        found = []
    places = [pair[0] for pair in found]
    if (
        len(found) < 2
        or any(len(pair) != 2 or not np.isfinite(pair).all() for pair in found)
        or sorted(set(places)) != places
    ):
        raise UserError(
            f"--effect {effect}: write knots=CHANNEL/HEIGHT+CHANNEL/HEIGHT..., the channel rising, not '{text}'"
        )
    return found


def _number(effect: str, key: str, of: Key, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or not of.fits(value):
        raise UserError(f"--effect {effect}: {key} must be a number, {of.limits}, not '{text}'")
    return value
