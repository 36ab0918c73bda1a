"""Scale, misalignment, bias and g-sensitivity of a part that rests in several positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Unpack

from selfcal.base.errors import UserError
from selfcal.base.options import argument, option
from selfcal.logs.loaders import READ, Reading
from selfcal.verbs._shared import Json, ModelFile, to_stderr

if TYPE_CHECKING:
    from selfcal.logs.recording import Data


def tumble(
    logs: Annotated[Data, argument(f"One log with turns, or a log a position: {READ}", "LOG...", kind=list[Path])],
    *,
    model: ModelFile = None,
    latitude: Annotated[
        float | None, option("Where it rested, degrees north: gravity, Earth's rate", metavar="DEG")
    ] = None,
    height: Annotated[float | None, option("Height above the sea, m", metavar="M")] = None,
    gravity: Annotated[float | None, option("Gravity there, m/s^2, instead of the latitude's", metavar="G")] = None,
    output: Annotated[
        Path | str | None, option("Write the calibration as YAML", "-o", "--output", metavar="CALIBRATION.yaml")
    ] = None,
    export: Annotated[
        tuple[str, Path | str] | None,
        option("Write it for yaml, c, kalibr, px4 or ardupilot", metavar="FORMAT FILE", kind=tuple[str, Path]),
    ] = None,
    plot: Annotated[Path | str | None, option("Save the residuals (.png .pdf .svg)", metavar="FILE")] = None,
    fail_on: Annotated[
        str | None,
        option("Exit code 1 when a sensor is not adequate, 2 when one cannot be judged", metavar="inadequate"),
    ] = None,
    json: Json = None,
    **reading: Unpack[Reading],
) -> dict[str, Any]:
    """Calibrate the accelerometers and gyros of a part by its rests in several positions and the turns between them.

    Several `logs` are in order of time. `model`: the part's own law, noise and range; without one the law is of a rest
    of 20 min in the log, else the default model's prior. `fail_on` is only checked here.
    Returns the document `selfcal.tumble/1` and writes it to `json`; gyros without an answer have an `error` there.
    Raises UserError for what the user can put right: fewer than three rests, an invalid place, logs that are not of
    accelerometers.
    """
    from selfcal.base.output import check_picture, check_writable, write_json
    from selfcal.batch.fail_on import INADEQUATE
    from selfcal.calibration import accelerometer, gyroscope
    from selfcal.calibration.earth import place
    from selfcal.calibration.tumble_document import tumble_document
    from selfcal.calibration.tumble_export import FORMS, write_calibration
    from selfcal.calibration.tumble_rests import RESTS_MOST, tumble_of
    from selfcal.logs.recording import list_of, load
    from selfcal.model.file import Model

    each = list(logs) if isinstance(logs, Sequence) and not isinstance(logs, str) else [logs]
    if not 1 <= len(each) <= RESTS_MOST:
        raise UserError(f"{len(each)} logs: give one with turns, or a log a position, {RESTS_MOST} at most")
    files = [path for log in each for path in list_of(log)]
    check_writable(json, plot, output, None if export is None else export[1], inputs=(*files, model))
    check_picture(plot)
    if export is not None and export[0] not in FORMS:
        raise UserError(f"--export: there is no format '{export[0]}' ({', '.join(FORMS)})")
    if fail_on not in (None, INADEQUATE):
        raise UserError(f"--fail-on: takes {INADEQUATE}")
    where = place(latitude, height, gravity)
    loaded = Model.load(model)
    recordings = [load(log, sensors=loaded.sensors, **reading) for log in each]
    tumbled = tumble_of(recordings, loaded, part_stated=model is not None)
    accel = accelerometer.calibrate(tumbled, where)
    gyro, failed = None, None
    if tumbled.has_gyro:
        try:
            gyro = gyroscope.calibrate(accel)
        except UserError as error:
            failed = str(error)
    document = tumble_document(recordings, accel, gyro or failed)
    for form, file in ((("yaml", output),) if output is not None else ()) + ((export,) if export is not None else ()):
        write_calibration(form, file, accel, gyro, document)
    if plot is not None:
        from selfcal.show.plots import plot_tumble

        plot_tumble(document, plot)
    write_json(document, json)
    return document


def show(document: dict[str, Any], given: Mapping[str, Any]) -> int:
    """Print the calibration."""
    from selfcal.batch.fail_on import exit_code
    from selfcal.calibration.tumble_show import show as tables

    tables(document, to_stderr=to_stderr(given))
    sensors = {name: document[name] for name in ("accelerometer", "gyroscope") if document[name] is not None}
    return exit_code({"axes": sensors}, given.get("fail_on"))
