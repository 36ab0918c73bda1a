"""`selfcal diagnose`: what the simulation gets wrong in a recording, why, and what mending it gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from selfcal.diagnosis.document import to_document
from selfcal.diagnosis.loop import diagnose_record
from selfcal.diagnosis.record import of_recording
from selfcal.model import Model
from selfcal.recording import Scale, load
from selfcal.verbs.identify import chosen_axes, write_json


def diagnose(
    log: Path | str,
    *,
    axes: Sequence[str] = (),
    model: Path | str | None = None,
    json: Path | str | None = None,
    rate: float | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    scale: Mapping[str, Scale] | None = None,
) -> dict[str, Any]:
    """Diagnose the axes of a recording; returns the document `selfcal.diagnose/1` and writes it to `json`.

    `axes`: those reported on; every other column may explain them. Numbers are in the recording's units. Raises
    UserError for what the user can put right.
    """
    loaded = Model.load(model)
    recording = load(log, rate=rate, columns=columns or {}, units=units or {}, scale=scale)
    names = chosen_axes(recording, loaded, [axes] if isinstance(axes, str) else axes)
    record = of_recording(recording, loaded, names)
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("diagnose", total=None)
        found = diagnose_record(record, names, lambda text: progress.update(task, description=text))
    document = to_document(recording, record, found)
    if json is not None:
        write_json(document, json)
    return document
