"""What several verbs share: options, and files of verdicts that are written in each case.

A verb has its own options with its function. A verb imports at its top only `base` and this file, so that the
command starts at once; what a verb runs is imported when it runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec, TypeVar

from selfcal.base.errors import UserError
from selfcal.base.options import argument, option
from selfcal.logs.loaders import READ, Reading

if TYPE_CHECKING:
    from selfcal.logs.recording import Data, Recording
    from selfcal.model.file import Model

Logs = Annotated[
    "Data", argument(f"Recording: {READ}; several files are joined by their time stamps", "LOG...", kind=list[Path])
]
ModelFile = Annotated[
    Path | str | None,
    option("Model file, or a part's name (bmi088), instead of the default", "--model", metavar="MODEL"),
]
ModelArgument = Annotated[Path | str | None, argument("Model file, or a part's name", "MODEL")]
From = Annotated[
    Path | str | None, option("Priors as `diagnose --json` measured them", "--from", metavar="DIAGNOSIS.json")
]
Axes = Annotated[Sequence[str], option("Axis to report (repeat for more); default: all", "--axis", metavar="NAME")]
Decimate = Annotated[float | None, option("Rate of the block means instead of the model file's", metavar="HZ")]
RunPlot = Annotated[Path | str | None, option("Save the plot of the run", metavar="FILE")]
Json = Annotated[Path | str | None, option("Write the result as JSON (- for stdout)", metavar="FILE")]
Report = Annotated[Path | str | None, option("Write a page with pictures and tables", metavar="FILE.html")]
SincePowerOn = Annotated[
    float, option("From power-on to the recording's beginning, s", "--since-power-on", metavar="S")
]
Gate = Annotated[bool, option("Keep motion out, by the model's stationary gate", "--gate")]
FailOn = Annotated[
    str | None,
    option(
        "Exit code 1 when an axis shows it, 2 when one cannot be judged",
        "--fail-on",
        metavar="inadequate|material|CAUSE",
    ),
]
LimitsFile = Annotated[
    Path | str | None,
    option(
        "Limits of a data sheet; exit code 1 when one fails, 2 when one cannot be told",
        "--limits",
        metavar="LIMITS.yaml",
    ),
]
Junit = Annotated[Path | str | None, option("Write the limits' verdicts as JUnit's XML", metavar="FILE.xml")]
Verdicts = Annotated[Path | str | None, option("Write the limits' verdicts as CSV", metavar="FILE.csv")]
Scheduler = Annotated[
    str | None, option("Dask scheduler to send the work to (tcp://HOST:PORT); default: this machine", metavar="ADDRESS")
]
Workers = Annotated[
    int | None, option("Processes on this machine; default: one for each processor", metavar="N", min=1)
]
#: Default number of simulated parts, or records of each law.
PARTS = 200
#: Length of a record that nobody states, s.
RECORD_S = 3600.0
Results = Annotated[
    Path | str | None, option("Folder that keeps finished records: a later run continues from them", metavar="DIR")
]


def looked_at(log: Data, model: Model, since_power_on_s: float, gate: bool, reading: Reading) -> Recording:
    """The recording that a verb looks at, with its distance from power-on; with `gate` its rests alone."""
    from selfcal.logs.recording import load
    from selfcal.readings.gate import gated

    recording = load(log, sensors=model.sensors, **reading).later(since_power_on_s)
    return gated(recording, model) if gate else recording


P = ParamSpec("P")
T = TypeVar("T")


def to_stderr(given: Mapping[str, Any]) -> bool:
    """Whether tables go to stderr, because stdout has the JSON."""
    return str(given.get("json")) == "-"


def shown_by(module: str, *options: str, judged: bool = False) -> Callable[[Any, Mapping[str, Any]], int]:
    """The `show` of a verb whose answer another module's `show` prints, which is imported then. `options`: switches
    that it takes too. `judged`: the exit code is that of `--fail-on` and the limits."""

    def show(answer: Any, given: Mapping[str, Any]) -> int:
        switches = {name: bool(given.get(name)) for name in options}
        import_module(f"selfcal.{module}").show(answer, to_stderr=to_stderr(given), **switches)
        if not judged:
            return 0
        from selfcal.batch.fail_on import exit_code

        return exit_code(answer, given.get("fail_on"))

    return show


def on_a_line(verb: Callable[P, T]) -> Callable[P, T]:
    """A verb whose JUnit and CSV are written even where it raises UserError.

    A file of the unit before must not stay in its place."""

    @wraps(verb)
    def run(*arguments: P.args, **options: P.kwargs) -> T:
        try:
            return verb(*arguments, **options)
        except UserError as error:
            given: dict[str, Any] = {**options, **({"log": arguments[0]} if arguments else {})}
            if given.get("limits") is not None:
                from selfcal.batch.verdicts import write_unjudged

                with suppress(UserError):  # of the limits file itself
                    write_unjudged(given, str(error))
            raise

    return run
