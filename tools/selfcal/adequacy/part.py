"""`selfcal part`: the model file of another part, from a recording at rest, its data sheet, or both.

`put_read_out` puts what a recording shows of its own read-out into a model file's tree. `diagnose --write-model` takes
it as well.
"""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import yaml

from selfcal.adequacy.identify import identify_axis
from selfcal.adequacy.summary import NOISIER
from selfcal.bank.axis_result import in_unit
from selfcal.bank.priors import DECADES, GATE_NOISE, LEVEL_SD, NARROW, Seen, about, laid, prior_tree, rounded, seen_of
from selfcal.base import units as unit_module
from selfcal.base.errors import UserError, note, remark, short
from selfcal.base.grid import Array
from selfcal.base.units import SENSORS, factor, parameter_unit
from selfcal.logs.recording import Recording, check_column
from selfcal.model.file import DEFAULT, LONGEST_TEXT, Model, Prior
from selfcal.readings.lattice import step_of
from selfcal.readings.readings import RANGE_ROUNDED, Readings, look
from selfcal.readings.rest import rest_of

#: Keys of a data sheet for a group or an axis, and for the part. `density` is one-sided, as data sheets have
#: it; an angle or velocity random walk is N.
STATED, OF_PART = ("N", "density", "K", "B", "bias", "range", "lsb"), ("rate",)
#: Kinds of axes by a unit of each: their group's name, and its unit where the recording does not decide it.
KINDS = {"rad/s": "gyro", "m/s^2": "accel", "T": "field", "Pa": "pressure", "degC": "temperature", "V": "voltage"}
#: Largest ratio of a recording's rate to its sensor's.
FASTER_MOST = 1.01
#: Least sd of the bias prior over N, of an axis of another kind, 1/sqrt(s).
LEAST_BIAS = 1000.0


@dataclass(frozen=True)
class Stated:
    """A number of a data sheet: `of` a group or an axis, "" for all that it fits, with its `unit`."""

    of: str
    key: str
    value: float
    unit: str
    text: str


def parse_stated(text: str) -> Stated:
    """`gx.N=0.012deg/sqrt(h)`: an axis or a group and a dot, if it is of these alone; the key; the number; its unit."""
    match = re.fullmatch(r"\s*(?:(?P<of>[\w-]+)\.)?(?P<key>\w+)\s*=(?P<quantity>.*)", text)
    wanted = "write KEY=NUMBER and its unit, as N=0.012deg/sqrt(h), accel.N=70ug/sqrt(Hz) or rate=200Hz"
    if match is None:
        raise UserError(f"--datasheet {short(text)}: {wanted}")
    key = match["key"]
    if key not in (*STATED, *OF_PART):
        known = ", ".join((*STATED, *OF_PART))
        raise UserError(f"--datasheet {short(text)}: there is no key '{short(key)}' (there are {known})")
    try:
        value, unit = unit_module.quantity(match["quantity"])
    except ValueError:
        raise UserError(f"--datasheet {short(text)}: {wanted}") from None
    if key == "density":
        key, value = "N", value * unit_module.ONE_SIDED_TO_TWO_SIDED
    if not math.isfinite(value) or not value > 0.0 or not unit_module.known(unit):
        raise UserError(f"--datasheet {short(text)}: {wanted}")
    return Stated(match["of"] or "", key, value, unit, text.strip())


def groups(default: Mapping[str, Any], recording: Recording, axes: Sequence[str]) -> dict[str, Any]:
    """The trees of the groups that the recording's axes make: those of the default model where it has them, else a tree
    for each kind and unit, whose priors are laid later."""
    trees: dict[str, Any] = {}
    for axis in (column for column in recording.columns if column in SENSORS or column in axes):
        unit = recording.columns[axis].unit
        home = next((name for name, group in default.items() if axis in group["axes"]), None)
        if home is not None:
            unit, name = default[home]["unit"], home
        else:
            kind = next((kind for example, kind in KINDS.items() if unit_module.same_kind(unit, example)), axis)
            name = kind if kind not in default else axis
            unit = trees.get(name, {"unit": unit})["unit"]
        group = trees.setdefault(name, copy.deepcopy(default[home or "gyro"]) | {"unit": unit, "axes": []})
        group["axes"].append(axis)
    if not trees:
        raise UserError(
            f"{recording.path}: no column is an axis ({', '.join(SENSORS)}); name yours with --axis "
            f"{next(iter(recording.columns))}"
        )
    for group in trees.values():
        group |= {"range": 0.0, "lsb": 0.0}
    return trees


def of_recording(tree: dict[str, Any], recording: Recording) -> list[str]:
    """Put the rate, the read-out and the priors that a recording shows into `tree`; a line for each."""
    model = Model.of_tree(tree, recording.path)
    own = {axis: recording.along(axis) for axis in model.axes}
    for axis, record in own.items():
        rest = rest_of(record, [axis])
        if rest.moved:
            longest = f": --start {rest.longest[0]:.10g} --end {rest.longest[1]:.10g}" if rest.longest else ""
            raise UserError(f"{recording.path}: {axis} moved; take a stretch at rest{longest}")
    readings = {axis: look(record, axis, model.group_of(axis)) for axis, record in own.items()}
    said = [put_read_out(tree, model, readings)]
    for group in model.groups:
        by_axis = {axis: _seen(own[axis], axis, model) for axis in group.axes}
        fields = tree["groups"][group.name]
        typical = math.exp(float(np.mean([math.log(seen.N) for seen in by_axis.values()])))
        level = max(by_axis.values(), key=lambda seen: abs(seen.level)).level
        about_it = group
        if not any(axis in SENSORS for axis in group.axes):
            wide = rounded(max(LEVEL_SD * abs(level), LEAST_BIAS * typical))
            about_it = replace(group, priors={**group.priors, "bias": Prior("normal", sd=wide)})
        widest = replace(max(by_axis.values(), key=lambda seen: float(seen.deviation.max())), level=level)
        # The N of all of them, whose deviation is the largest.
        deviation = np.concatenate([[typical / math.sqrt(widest.tau_s[0])], widest.deviation[1:]])
        priors = about(about_it, replace(widest, deviation=deviation))
        fields["priors"] = {key: prior_tree(prior) for key, prior in priors.items()}
        listed = ", ".join(f"{axis} {seen.N:.3g}" for axis, seen in by_axis.items())
        said.append(f"{group.name}: N about {listed} {parameter_unit('N', group.unit)} (Allan deviation)")
        far = {axis: seen for axis, seen in by_axis.items() if not 1.0 / NARROW < seen.N / typical < NARROW}
        if far:
            fields["own_priors"] = {
                axis: {key: prior_tree(prior) for key, prior in about(about_it, seen).items() if prior != priors[key]}
                for axis, seen in far.items()
            }
    return said


def _seen(recording: Recording, axis: str, model: Model) -> Seen:
    seen = seen_of(recording, axis, model)
    if seen is None:
        raise UserError(
            f"{recording.path}: {axis} is too short for a part's noise, or all its readings are alike: record a minute "
            "and more at rest"
        )
    return seen


def put_read_out(tree: dict[str, Any], model: Model, readings: Mapping[str, Readings], *, stated: bool = False) -> str:
    """Put rate, lattice, range and stuck limit that a recording shows into the `tree` of a model; a line on them.

    `readings`: of the axes that are looked at. `stated`: a user states the model's read-out. Then an entry stays that
    the readings do not contradict: those of a log that averages its sensor do not show the sensor's.
    """
    sensor, rate_hz = tree["sensor"], max(axis.recording.rate_hz for axis in readings.values())
    averaged = stated and sensor["rate_hz"] > FASTER_MOST * rate_hz
    if not stated or rate_hz > FASTER_MOST * sensor["rate_hz"]:
        sensor |= {"rate_hz": float(f"{rate_hz:.6g}"), "filter_taps": 1}
    said = [f"{sensor['rate_hz']:g} Hz"]
    for group in model.groups:
        fields = tree["groups"][group.name]
        own = [readings[axis] for axis in group.axes if axis in readings]
        if not stated:
            fields |= {"range": 0.0, "lsb": 0.0}
        if not own:
            continue
        steps = [step for axis in own if (step := _step(axis)) > 0.0]
        # Means of a lattice lie on a finer lattice, which may show or not.
        if not averaged or (steps and not _divides(min(steps), group.lsb)):
            fields["lsb"] = float(f"{min(steps, default=0.0):.6g}")
        if not stated and any(axis.lattice is not None and axis.lattice.too_coarse for axis in own):
            fields["stuck_limit"] = 0
        limits = [abs(axis.clipped.limit) for axis in own if axis.clipped is not None]
        if limits and all(_inside(axis, min(limits)) for axis in own):
            fields["range"] = float(f"{min(limits):.6g}")
        lattice = f"lattice {fields['lsb']:.6g} {group.unit}" if fields.get("lsb") else "no lattice"
        reach = f"range {fields['range']:.6g} {group.unit}" if fields.get("range") else "no end of its range seen"
        said.append(f"{group.name} {lattice}, {reach}")
    return "read-out: " + "; ".join(said)


def _step(readings: Readings) -> float:
    """The step of an axis' lattice, however fine; 0 without a lattice."""
    return readings.lattice.step if readings.lattice is not None else step_of(_known(readings))[0]


def _divides(step: float, lsb: float) -> bool:
    """Whether a lattice is of means of readings on a coarser lattice."""
    return abs(lsb / step - round(lsb / step)) < 0.002 * lsb / step


def _inside(readings: Readings, limit: float) -> bool:
    """Whether a range of both signs keeps no reading of an axis out; where it clips, its level alone counts."""
    values = _known(readings)
    largest = np.abs(values).max() if readings.clipped is None else abs(np.median(values))
    return bool(largest <= limit * (1.0 + RANGE_ROUNDED))


def _known(readings: Readings) -> Array:
    return readings.values[np.isfinite(readings.values)]


def of_sheet(tree: dict[str, Any], stated: Sequence[Stated], measured: bool) -> list[str]:
    """Put the numbers of a data sheet into `tree`; a line for each. N goes first: the others are laid about it."""
    for number in sorted(stated, key=lambda number: (number.key != "N", bool(number.of))):
        if number.key == "rate":
            if number.of or not unit_module.same_kind(number.unit, "Hz"):
                raise UserError(f"--datasheet {number.text}: the rate is one of the part, in Hz: rate=200Hz")
            tree["sensor"]["rate_hz"] = number.value * factor(number.unit, "Hz")
            continue
        fits = {
            name: group
            for name, group in tree["groups"].items()
            if unit_module.same_kind(number.unit, _unit_of(number.key, group["unit"]))
        }
        meant = [name for name, group in fits.items() if number.of in ("", name) or number.of in group["axes"]]
        if not meant:
            raise UserError(f"--datasheet {number.text}: {_not_meant(number, tree['groups'])}")
        for name in meant:
            _put(tree["groups"][name], number, number.of if number.of != name else "", measured)
    return [f"data sheet: {number.text}" for number in stated]


def _not_meant(number: Stated, groups: Mapping[str, Any]) -> str:
    """Why a number goes nowhere."""
    names = [*groups, *(axis for group in groups.values() for axis in group["axes"])]
    if number.of and number.of not in names:
        return f"there is no group or axis '{short(number.of)}' (there are {', '.join(names)})"
    wanted = ", ".join(dict.fromkeys(_unit_of(number.key, group["unit"]) for group in groups.values()))
    return f"'{short(number.unit)}' is no unit of {number.key} here (as {wanted})"


def _unit_of(key: str, unit: str) -> str:
    """Unit of a number of a data sheet, of a group in `unit`."""
    return unit if key in ("range", "lsb") else parameter_unit(key, unit)


def _put(group: dict[str, Any], number: Stated, axis: str, measured: bool) -> None:
    """Put a number into a group's tree, for its `axis` alone where that is not "". `measured`: a recording laid N."""
    value = number.value * factor(number.unit, _unit_of(number.key, group["unit"]))
    if number.key in ("range", "lsb"):
        if axis:
            raise UserError(f"--datasheet {number.text}: range and lsb are of a group: leave '{axis}.' out")
        group[number.key] = float(f"{value:.6g}")
        return
    held = group["priors"] if not axis else group.setdefault("own_priors", {}).setdefault(axis, {})
    before = {key: Prior(**prior) for key, prior in {**group["priors"], **held}.items()}
    if number.key == "N":
        N = _noise(group)
        if measured and not 1.0 / NOISIER < value / N < NOISIER:
            note(f"{number.text}: the recording has {N:.3g} {parameter_unit('N', group['unit'])}")
        of_group = group["priors"] if axis else {}
        about_it = {key: prior_tree(prior) for key, prior in laid(before, value).items()}
        held |= {key: prior for key, prior in about_it.items() if prior != of_group.get(key)}
    elif number.key == "bias":
        held["bias"] = {"law": "normal", "sd": rounded(value)}
    else:
        # A data sheet's bias instability is the size of the slow drift: the deviation of a Gauss-Markov drift.
        name = "sigma_m" if number.key == "B" else number.key
        half = math.sqrt(before[name].max / before[name].min)
        held[name] = prior_tree(Prior("log_uniform", min=rounded(value / half), max=rounded(value * half)))


def _noise(group: Mapping[str, Any]) -> float:
    """The N that a group's priors are laid about: its least may have given way to the bias."""
    prior = group["priors"]["N"]
    return float(min(max(prior["max"] / DECADES, prior["min"]), math.sqrt(prior["min"] * prior["max"])))


def finish(tree: dict[str, Any], name: str, recording: Recording | None) -> list[str]:
    """The name, the gate's bounds, and `simulate`: about each N, and as a recording has it; a line for each axis."""
    plain = remark(name)[:LONGEST_TEXT]
    tree["name"] = plain
    tree["sensor"]["name"] = plain
    middle = {key: _noise(group) for key, group in tree["groups"].items()}
    tree["gate"]["N"] = {key: rounded(GATE_NOISE * N) for key, N in middle.items()}
    # Without a recording the drift is drawn from its priors; the noise is known.
    noise = {axis: {"N": rounded(middle[key])} for key, group in tree["groups"].items() for axis in group["axes"]}
    rate_hz = tree["sensor"]["rate_hz"]
    tree["simulate"] |= {"rate_hz": min(tree["simulate"]["rate_hz"], rate_hz), "axes": noise}
    said = []
    if recording is not None:
        tree["simulate"] |= {"rate_hz": rate_hz, "duration_s": recording.duration_s}
        model = Model.of_tree(tree, recording.path)
        for axis in model.axes:
            try:
                noise[axis] = _measured(recording, axis, model)
            except UserError as error:
                note(f"{recording.path}: {axis}: {error}; `simulate` draws its drift from the priors")
                continue
            numbers = ", ".join(f"{key} {value:.3g}" for key, value in noise[axis].items() if key != "hypothesis")
            said.append(f"{axis}: {noise[axis]['hypothesis']}, {numbers} (medians)")
    return said


def _measured(recording: Recording, axis: str, model: Model) -> dict[str, Any]:
    """The `simulate` entry of an axis: its likeliest law and medians. Raises UserError where it has no result."""
    identified, group = identify_axis(recording, axis, model, "library", None), model.group_of(axis)
    result, law = in_unit(identified.result, identified.unit, group.unit), identified.result.best
    numbers = {"bias": float(np.nanmedian(recording.in_unit(axis, group.unit)))}
    numbers |= {key: estimate.median for key, estimate in result.parameters[law].items()}
    numbers["N"] = density_without(numbers["N"], lattice_density({"lsb": group.lsb}, model.sensor_rate_hz))
    return {"hypothesis": law, **{key: float(f"{value:.6g}") for key, value in numbers.items()}}


def lattice_density(group: Mapping[str, Any], rate_hz: float) -> float:
    """White noise density that a sensor's read-out at this rate adds: lsb^2 / 12 to each reading."""
    return float(group.get("lsb") or 0.0) / math.sqrt(12.0 * rate_hz)


def density_without(N: float, added: float) -> float:
    """The density that makes N together with `added`."""
    return math.sqrt(max(N * N - added * added, 1e-4 * N * N))


def tree_of(
    recording: Recording | None,
    axes: Sequence[str] = (),
    stated: Sequence[Stated] = (),
    name: str | None = None,
    rate: float | None = None,
) -> tuple[dict[str, Any], list[str]]:
    """The tree of a part's model file, and a line for each of its numbers. `axes`: columns that are axes apart from gx
    to az; `stated`: numbers of its data sheet; `rate`, Hz: without a recording. Raises UserError."""
    tree: dict[str, Any] = yaml.safe_load(DEFAULT.read_text(encoding="utf-8"))
    said: list[str] = []
    if recording is not None:
        for axis in axes:
            check_column(recording, axis)
        tree["groups"] = groups(tree["groups"], recording, axes)
        tree["gate"]["N"] = dict.fromkeys(tree["groups"], 1.0)  # until N is known
        said += of_recording(tree, recording)
    else:
        if rate is None and not any(number.key == "rate" for number in stated):
            raise UserError("without a recording the part's rate is needed: --datasheet rate=200Hz")
        tree["sensor"] = {"name": "", "rate_hz": rate, "filter_taps": 1}
        for group in tree["groups"].values():
            group |= {"range": 0.0, "lsb": 0.0}
    said += of_sheet(tree, stated, recording is not None)
    default = "part" if recording is None else recording.path.name.partition(".")[0]
    return tree, said + finish(tree, name or default, recording)


def part_text(tree: Mapping[str, Any], recording: Recording | None, said: Sequence[str]) -> str:
    """The file: where its numbers are from, then the tree."""
    source = f" from {remark(recording.path.name)}, {recording.duration_s:.6g} s at rest" if recording else ""
    head = [f"# Written by `selfcal part`{source}.", *(f"# {remark(line)}" for line in said)]
    return "\n".join(head) + "\n" + str(yaml.safe_dump(dict(tree), sort_keys=False, allow_unicode=True, width=110))


def show(model: Model) -> None:
    """Print the groups of the file that was written."""
    print(f"{model.path}: model '{model.name}', {model.sensor_rate_hz:g} Hz")
    for group in model.groups:
        N = group.priors["N"]
        lattice = f", lattice {group.lsb:.6g}" if group.lsb else ""
        reach = f", range {group.range:.6g}" if group.range else ""
        print(
            f"  {group.name} [{group.unit}]: {', '.join(group.axes)}; N {N.min:.3g} to {N.max:.3g} "
            f"{parameter_unit('N', group.unit)}{lattice}{reach}"
        )
