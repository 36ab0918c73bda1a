"""Write a simulated recording, read out as the sensor would, with its truth in its metadata."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from selfcal.base.errors import UserError
from selfcal.base.options import argument, option
from selfcal.logs.loaders import WRITTEN


def _list(wanted: bool) -> None:
    """Print every effect, and end there."""
    if wanted:
        from selfcal.diagnosis.simulate import show_effects

        show_effects()
        sys.exit(0)


def simulate(
    model_path: Annotated[Path | str | None, argument("Model file, or a part's name", "MODEL")],
    output: Annotated[
        Path | str, option(f"Recording to write: {WRITTEN}", "-o", "--output", metavar="LOG", show_default=False)
    ],
    seed: Annotated[int, option("Same seed, same recording", metavar="N", min=0)] = 0,
    effects: Annotated[
        Sequence[str],
        option("Effect to put in, axis=NAME for one axis (repeat for more)", "--effect", metavar="ID[:key=value,...]"),
    ] = (),
    list_effects: Annotated[
        bool, option("List effects and their keys, and exit", "--list-effects", is_eager=True, callback=_list)
    ] = False,
) -> dict[str, Any]:
    """Write the recording that a model file's `simulate` entry describes and return its metadata, the truth included.

    `model_path` None is the default model. What the entry leaves open is drawn from the priors, the hypothesis by its
    prior probability. `effects`, after those of the entry itself: texts ID[:key=value,...]; without `axis=` an effect
    is on every axis. The same arguments give the same recording. Raises UserError for whatever is wrong with the
    arguments or the model file, or if `output` cannot be written.
    """
    import numpy as np
    from rich.console import Console

    from selfcal import _reference
    from selfcal.base import units
    from selfcal.base.output import check_place
    from selfcal.batch.spread import checked_seed
    from selfcal.diagnosis.causes import CAUSES
    from selfcal.diagnosis.simulate import SEEDS, added_by, applied_to, axis_of, put_faults, scene_of, slowed, truth_of
    from selfcal.logs import recording
    from selfcal.model.file import Model
    from selfcal.model.tables import bank_block

    model = Model.load(model_path)
    check_place(output)
    checked_seed(seed)
    scene = scene_of(model, seed)
    scene.bank_block = bank_block(scene.rate_hz, model.bank_rate_hz)
    truth = truth_of(model, seed)
    dt_s = scene.bank_block / scene.rate_hz
    axes = [axis_of(truth[name], model.group_of(name), dt_s, scene.bank_block) for name in model.axes]
    applied = [applied_to(text, model, scene, axes) for text in (*model.simulate["effects"], *effects)]
    asked = [(effect["id"], axis) for effect in applied[len(model.simulate["effects"]) :] for axis in effect["axes"]]
    for name, axis in asked:
        if asked.count((name, axis)) > 1 and not CAUSES[name].several:
            raise UserError(f"--effect {name}: twice on {axis}, which has room for one effect of a kind")
    if scene.missing > scene.samples - 2:
        raise UserError(f"--effect missing_samples: {scene.missing} of {scene.samples} samples cannot be missing")
    with Console(stderr=True).status(f"simulating {scene.samples:,} samples of {len(axes)} axes"):
        added = added_by(applied, model, scene.rate_hz, seed)
        values, temperature, supply, present, bias_now = _reference.simulate(scene, axes, added)
        changed = put_faults(applied, model, axes, values, scene.rate_hz, _reference.Random(seed, SEEDS + len(axes)))
    for name, axis, now in zip(model.axes, axes, bias_now, strict=True):
        truth[name] |= {
            "bias_now": now,
            # Rounding to the lattice adds lsb^2 / 12 to each sample's variance: the white noise that a record shows.
            "N_with_lattice": math.sqrt(truth[name]["N"] ** 2 + axis.lsb**2 / 12.0 / scene.rate_hz),
            "units": {key: units.parameter_unit(key, truth[name]["unit"]) for key in model.group_of(name).priors},
        }
    meta = {
        "simulated": True,
        "sensor": model.sensor_name,
        "model": model.name,
        "seed": seed,
        "effects": applied,
        "truth": truth,
    }
    columns = {name: (model.group_of(name).unit, row[present]) for name, row in zip(model.axes, values, strict=True)}
    columns |= {"temp": ("degC", temperature[present]), "supply": ("V", supply[present])}
    stamps = None if present.all() else np.flatnonzero(present) / scene.rate_hz
    if changed is not None:
        stamps, columns = slowed(np.flatnonzero(present) / scene.rate_hz, columns, *changed)
    lattice = {name: axis.lsb for name, axis in zip(model.axes, axes, strict=True) if axis.lsb > 0.0}
    with Console(stderr=True).status(f"writing {scene.samples:,} samples"):
        recording.save(output, columns, scene.rate_hz, meta, t=stamps, lsb={**lattice, "supply": _reference.SUPPLY_LSB})
    rows = int(present.sum()) if stamps is None else stamps.size
    return {**meta, "samples": rows, "rate_hz": scene.rate_hz}


def show(meta: dict[str, Any], given: Mapping[str, Any]) -> None:
    """Print what was written, and the truth."""
    from selfcal.diagnosis.simulate import show as lines

    lines(meta, given["output"])
