"""`selfcal demo`: a module without hardware, for `selfcal monitor` to watch."""

from __future__ import annotations

import subprocess
import time

from selfcal.wire.frames import ROOT

SHIPPED = ROOT / "tests" / "data" / "simulated_adis16405.npz"
#: Least interval of reports, s of module time. A host takes one a second.
REPORT_S = 10.0
FASTEST = 1000.0
#: python-can's own group and port, so that its tools listen there without more.
GROUP, PORT = "239.74.163.2", 43113
#: Time that the firmware waits for a host, s: longer than anybody does.
FOREVER_S = 999_999.0


def wait(module: subprocess.Popen[str]) -> str:
    """Output of the firmware until it ends."""
    while module.poll() is None:
        time.sleep(0.2)
    return module.communicate()[0]
