"""Other methods on the same recording, or on simulated records: estimates, choice of a law, time and memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Unpack

from selfcal.base.errors import UserError, called
from selfcal.base.options import argument, option
from selfcal.logs.loaders import READ, Reading
from selfcal.verbs._shared import Axes, Decimate, Json, ModelFile, Results, Scheduler, Workers, to_stderr


def rivals(
    log: Annotated[Path | str | None, argument(f"Recording: {READ}; or give --records", "[LOG]")] = None,
    *,
    records: Annotated[int | None, option("Instead of a recording: simulated records of each law", metavar="N")] = None,
    samples: Annotated[
        Sequence[int], option("Samples of each record (repeat for more); default: 150, 600", metavar="N")
    ] = (),
    truth: Annotated[
        str, option("Parameters of the records: the priors' middle, or drawn", metavar="middle|prior")
    ] = "middle",
    seed: Annotated[int, option("Same seed, same records", metavar="N", min=0)] = 1,
    axes: Axes = (),
    model: ModelFile = None,
    decimate: Decimate = None,
    only: Annotated[Sequence[str], option("Method to run (repeat for more); default: all", metavar="NAME")] = (),
    workers: Workers = None,
    scheduler: Scheduler = None,
    results: Results = None,
    json: Json = None,
    **reading: Unpack[Reading],
) -> dict[str, Any]:
    """Run the library and every other method on the same block means of each axis of `log`: the document
    `selfcal.rivals/1`. Or give all the same simulated records, `records` of each law and number of `samples`, of the
    first of the `axes`: the document `selfcal.rivals_ensemble/1`.
    """
    from selfcal.base.output import check_writable, write_json
    from selfcal.logs.recording import load
    from selfcal.model.file import Model
    from selfcal.studies import rivals as study

    if (log is None) == (records is None):
        raise UserError(f"rivals takes a recording, or --records N for simulated ones: {called()} rivals LOG")
    check_writable(json)
    chosen = study.chosen_rivals(only)
    if log is not None:
        loaded = Model.load(model)
        document = study.of_recording(load(log, sensors=loaded.sensors, **reading), loaded, axes, decimate, chosen)
    else:
        assert records is not None
        loaded = Model.load(study.ENSEMBLE if model is None else model)
        ensemble = study.Ensemble(loaded, axes[0] if axes else "gx", truth, samples or study.SAMPLES, records, seed)
        document = ensemble.document(chosen, workers, scheduler, results)
    write_json(document, json)
    return document


def show(document: dict[str, Any], given: Mapping[str, Any]) -> None:
    """Print a table an axis, or a table for each number of samples and law."""
    from selfcal.studies import rivals as study

    shown = study.show if "axes" in document else study.show_ensemble
    shown(document, to_stderr=to_stderr(given))
