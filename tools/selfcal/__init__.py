"""selfcal: an inertial sensor at rest identifies its own error model. Every verb of the command is a function here."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

#: A verb is a file of `verbs` with a function of its name.
VERBS = tuple(sorted(path.stem for path in Path(__file__).with_name("verbs").glob("[a-z]*.py")))


def __getattr__(name: str) -> Any:
    """The verb called `name`, imported when it is first asked for so that the command starts at once."""
    if name in VERBS:
        return getattr(import_module(f"selfcal.verbs.{name}"), name)
    if name == "__version__":
        from importlib.metadata import version

        return version("selfcal")
    raise AttributeError(f"module 'selfcal' has no attribute '{name}'")


def __dir__() -> list[str]:
    return [*globals(), *VERBS, "__version__"]
