"""A module without hardware: the firmware over a recording, for `selfcal monitor` to watch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from selfcal.base.errors import UserError, called
from selfcal.base.options import argument, option
from selfcal.logs.loaders import READ
from selfcal.verbs._shared import ModelFile

#: Least interval of reports, s of module time, and largest speed. A host takes a report a second.
REPORT_S, SPEED_MOST = 10.0, 1000.0
#: python-can's own group and port, so that its tools listen there without more.
GROUP, PORT = "239.74.163.2", 43113
#: Time that the firmware waits for a host, s: longer than anybody does.
FOREVER_S = 999_999.0


def demo(
    log: Annotated[Path | str | None, argument(f"Recording: {READ}; default: the shipped one", "[LOG]")] = None,
    *,
    speed: Annotated[float, option("Times real time", metavar="X")] = 10.0,
    transport: Annotated[Literal["slcan", "can"], option("How its frames travel")] = "slcan",
    channel: Annotated[str, option("With --transport can: a CAN device; default: UDP", metavar="NAME")] = "",
    node: Annotated[int, option("The module's number on its bus, 0 to 11", metavar="N")] = 0,
    model: ModelFile = None,
) -> None:
    """Play a recording through the firmware, `speed` times as fast as it was taken, until its end or Ctrl-C; prints
    how to watch.

    On a pseudo-terminal the module's time stands still while nobody has its channel open, and hosts may come and go.
    With `transport` can it goes on by itself, on the CAN device `channel` or over UDP within this machine.
    """
    import shlex
    import tempfile

    from rich.console import Console

    from selfcal.adequacy.identify import chosen_axes
    from selfcal.logs.recording import load
    from selfcal.model.file import Model
    from selfcal.wire.dbc_file import check_node
    from selfcal.wire.frames import SHIPPED
    from selfcal.wire.replay import build, running, write_rows

    if not 0.0 < speed <= SPEED_MOST:
        raise UserError(f"--speed must be above 0 and at most {SPEED_MOST:g}, not {speed:g}")
    if channel and transport != "can":
        raise UserError(f"--channel {channel}: goes with --transport can")
    check_node(node)
    path = Path(log or SHIPPED)
    loaded = Model.load(model)
    recording = load(path)
    names = chosen_axes(recording, loaded, ())
    recording = recording.along(*names)
    with Console(stderr=True).status("building the firmware"):
        firmware = build(loaded, recording.rate_hz, names)
    more = ["--realtime", f"{speed:g}", "--timeout", f"{FOREVER_S:g}", "--node", str(node)]
    if transport == "can":
        more += ["--can", channel or f"{GROUP}:{PORT}"]
        watch = (
            f"--interface socketcan --channel {channel}" if channel else f"--interface udp_multicast --channel {GROUP}"
        )
    else:
        more += ["--stay"]
        watch = "--channel {}"
    names_by = "" if model is None else f" --model {shlex.quote(str(model))}"
    with tempfile.TemporaryDirectory(prefix="selfcal-") as folder:
        rows = Path(folder) / "rows.bin"
        write_rows(recording, loaded, names, rows)
        with running(firmware, rows, max(REPORT_S, speed), "host", more=more) as (module, wire, said):
            if wire:
                print(
                    f"{recording.path}: {recording.duration_s:g} s, {speed:g} times real time\n"
                    f"watch it by:  {called()} monitor {watch.format(wire)}{names_by}\nCtrl-C ends it",
                    flush=True,
                )
            try:
                complaint = (said + module.communicate()[0]).strip()
            except KeyboardInterrupt:
                return
            if module.returncode != 0:
                raise UserError(complaint or f"the firmware stopped (exit code {module.returncode})")
