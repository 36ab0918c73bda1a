"""selfcal: an inertial sensor at rest identifies its own error model. Every verb of the command is a function here."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

#: File of each verb; it has a function of its name.
VERBS = {path.stem: path for path in sorted((Path(__file__).parent / "verbs").glob("[a-z]*.py"))}

#: What scripts take beside the verbs, and where it is.
_OTHERS = {"load": "logs.recording", "save": "logs.recording", "UserError": "base.errors"}
#: Lines of /proc/cpuinfo that tell of the first core.
MOST_LINES = 100


def __getattr__(name: str) -> Any:
    """The verb called `name`, imported when it is first asked for so that the command starts at once."""
    if name in VERBS:
        return getattr(import_module(f"selfcal.verbs.{name}"), name)
    if name in _OTHERS:
        return getattr(import_module(f"selfcal.{_OTHERS[name]}"), name)
    if name == "_library32":
        globals()[name] = import_module(f"selfcal._library32{'_fma' if _fma() else ''}")
        return globals()[name]
    if name == "__version__":
        from importlib.metadata import version

        return version("selfcal")
    raise AttributeError(f"module 'selfcal' has no attribute '{name}'")


def _fma() -> bool:
    """Whether this processor has the instruction, and the package the build with it. Either build rounds alike."""
    if find_spec("selfcal._library32_fma") is None:
        return False
    try:
        with Path("/proc/cpuinfo").open(encoding="ascii", errors="replace") as file:
            return any(line.startswith("flags") and "fma" in line.split() for line in islice(file, MOST_LINES))
    except OSError:
        return False


def __dir__() -> list[str]:
    return [*globals(), *VERBS, *_OTHERS, "__version__"]
