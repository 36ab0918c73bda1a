"""`selfcal demo`: a module without hardware, for `selfcal monitor` to watch."""

from __future__ import annotations

import subprocess
import tempfile
import time
from pathlib import Path

from rich.console import Console

from selfcal.base.errors import UserError, called
from selfcal.logs.recording import load
from selfcal.model.file import Model
from selfcal.verbs.identify import chosen_axes
from selfcal.verbs.replay import build, running, write_rows
from selfcal.wire.dbc_file import NODES
from selfcal.wire.frames import ROOT

SHIPPED = ROOT / "tests" / "data" / "simulated_adis16405.npz"
#: s of module time between reports, at least. A host takes one a second.
REPORT_S = 10.0
FASTEST = 1000.0
#: python-can's own group and port, so that its tools listen there without more.
GROUP, PORT = "239.74.163.2", 43113
#: s that the firmware waits for a host: longer than anybody does.
FOREVER_S = 999_999.0


def demo(
    log: Path | str | None = None,
    *,
    speed: float = 10.0,
    transport: str = "slcan",
    channel: str = "",
    node: int = 0,
) -> None:
    """Play a recording through the firmware, `speed` times as fast as it was taken, until its end or Ctrl-C; prints
    how to watch.

    On a pseudo-terminal the module's time stands still while nobody has its channel open, and hosts may come and go.
    `node`: its number on its bus.
    With `transport` can it goes on by itself, on the CAN device `channel` or over UDP within this machine.
    """
    if not 0.0 < speed <= FASTEST:
        raise UserError(f"--speed must be above 0 and at most {FASTEST:g}, not {speed:g}")
    if channel and transport != "can":
        raise UserError(f"--channel {channel}: goes with --transport can")
    if not 0 <= node < NODES:
        raise UserError(f"--node {node}: a bus has nodes 0 to {NODES - 1}")
    path = Path(log or SHIPPED)
    model = Model.load()
    recording = load(path)
    names = chosen_axes(recording, model, ())
    recording = recording.along(*names)
    with Console(stderr=True).status("building the firmware"):
        firmware = build(model, recording.rate_hz, names)
    more = ["--realtime", f"{speed:g}", "--timeout", f"{FOREVER_S:g}", "--node", str(node)]
    if transport == "can":
        more += ["--can", channel or f"{GROUP}:{PORT}"]
        watch = (
            f"--interface socketcan --channel {channel}" if channel else f"--interface udp_multicast --channel {GROUP}"
        )
    else:
        more += ["--stay"]
        watch = "--channel {}"
    with tempfile.TemporaryDirectory(prefix="selfcal-") as folder:
        rows = Path(folder) / "rows.bin"
        write_rows(recording, model, names, rows)
        with running(firmware, rows, max(REPORT_S, speed), "host", more=more) as (module, wire, said):
            if wire:
                print(
                    f"{recording.path}: {recording.duration_s:g} s, {speed:g} times real time\n"
                    f"watch it by:  {called()} monitor {watch.format(wire)}\nCtrl-C ends it",
                    flush=True,
                )
            try:
                complaint = (said + _wait(module)).strip()
            except KeyboardInterrupt:
                return
            if module.returncode != 0:
                raise UserError(complaint or f"the firmware stopped (exit code {module.returncode})")


def _wait(module: subprocess.Popen[str]) -> str:
    """What the firmware says until it ends."""
    while module.poll() is None:
        time.sleep(0.2)
    return module.communicate()[0]
