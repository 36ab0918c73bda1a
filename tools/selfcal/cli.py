"""The command `selfcal`: options in, one verb called, errors as one line. Verbs are imported only when they run."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from inspect import Parameter, Signature, signature
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup
from typer.exceptions import TyperException

import selfcal
from selfcal.base.ending import Held, install, last_signal, leave
from selfcal.base.errors import UserError, called, note, printable
from selfcal.logs.loaders import READ, WRITTEN, Reading

#: Folders of the verbs, and their headings in the help.
_HEADINGS = {"verbs": "Commands", "studies": "Studies of the method"}


class _Headed(TyperGroup):
    """The commands under a heading for each folder of verbs."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        limit = formatter.width - 6 - max(map(len, self.commands))
        for folder, heading in _HEADINGS.items():
            with formatter.section(heading):
                formatter.write_dl(
                    [
                        (name, command.get_short_help_str(limit))
                        for name, command in self.commands.items()
                        if selfcal.VERBS[name] == folder
                    ]
                )


app = typer.Typer(
    cls=_Headed,
    help="An inertial sensor at rest identifies its own error model.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"selfcal {selfcal.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", is_eager=True, callback=_version)
    ] = False,
) -> None:
    """Options of the command itself; the help text is the app's."""


#: Exit code of everything the user can put right.
USER_ERROR = 2
#: ... after Ctrl-C.
INTERRUPTED = 130


class Engine(StrEnum):
    """What computes."""

    library = "library"
    reference = "reference"
    fixed = "fixed"


class Units(StrEnum):
    """What a table is in."""

    recording = "recording"
    datasheet = "datasheet"


class Target(StrEnum):
    """Where the firmware runs."""

    host = "host"
    cortex_m4f = "cortex-m4f"
    cortex_m0 = "cortex-m0"


class Transport(StrEnum):
    """How its frames travel."""

    slcan = "slcan"
    can = "can"


Log = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG...", help=f"Recording: {READ}; several files are joined by their time stamps", show_default=False
    ),
]
ModelFile = Annotated[
    Path | None,
    typer.Option("--model", metavar="MODEL", help="Model file, or a part's name (bmi088), instead of the default"),
]
From = Annotated[
    Path | None, typer.Option("--from", metavar="DIAGNOSIS.json", help="Priors as `diagnose --json` measured them")
]
Axis = Annotated[
    list[str] | None, typer.Option("--axis", metavar="NAME", help="Axis to report (repeat for more); default: all")
]
Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON (- for stdout)")]
Report = Annotated[Path | None, typer.Option(metavar="FILE.html", help="Write a page with pictures and tables")]
Rate = Annotated[
    float | None, typer.Option("--rate", metavar="HZ", help="Sampling rate, for recordings without a t column")
]
Column = Annotated[
    list[str] | None, typer.Option("--column", metavar="gx=NAME", help="Column of a foreign header (repeat for more)")
]
Unit = Annotated[
    list[str] | None,
    typer.Option("--unit", metavar="gx=rad/s", help="Unit of a column whose header states none (repeat for more)"),
]
Scale = Annotated[
    list[str] | None,
    typer.Option(
        "--scale", metavar="[gx=]SIZE[unit]", help="Size of one LSB, or of a unit that is not known (repeat for more)"
    ),
]
Start = Annotated[
    float | None, typer.Option("--start", metavar="S", help="Begin here, seconds of the recording; default: its start")
]
End = Annotated[
    float | None, typer.Option("--end", metavar="S", help="End before this, seconds of the recording; default: its end")
]
SincePowerOn = Annotated[
    float, typer.Option("--since-power-on", metavar="S", help="From power-on to the recording's beginning, s")
]
Gate = Annotated[bool, typer.Option("--gate", help="Keep motion out, by the model's stationary gate")]
FailOn = Annotated[
    str | None,
    typer.Option(
        "--fail-on", metavar="inadequate|CAUSE", help="Exit code 1 when an axis shows it, 2 when one cannot be judged"
    ),
]
Limits = Annotated[
    Path | None,
    typer.Option(
        metavar="LIMITS.yaml", help="Limits of a data sheet; exit code 1 when one fails, 2 when one cannot be told"
    ),
]
Junit = Annotated[Path | None, typer.Option(metavar="FILE.xml", help="Write the limits' verdicts as JUnit's XML")]
Verdicts = Annotated[Path | None, typer.Option(metavar="FILE.csv", help="Write the limits' verdicts as CSV")]
NoTime = Annotated[bool, typer.Option("--no-time", help="Leave the time column out; takes --rate")]
SkipBad = Annotated[bool, typer.Option("--skip-bad", help="Skip lines of a text that are no rows, and count them")]
Source = Annotated[
    list[str] | None,
    typer.Option("--source", metavar="NAME", help="Sensor to read of a log that has several (repeat for more)"),
]
Dbc = Annotated[Path | None, typer.Option("--dbc", metavar="FILE.dbc", help="Signals of a log of CAN frames")]
#: What `Reading` is made of on the command line, with its default.
_READING: Mapping[str, tuple[Any, Any]] = {
    "rate": (Rate, None),
    "column": (Column, None),
    "unit": (Unit, None),
    "scale": (Scale, None),
    "no_time": (NoTime, False),
    "skip_bad": (SkipBad, False),
    "source": (Source, None),
    "dbc": (Dbc, None),
}
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Dask scheduler to send the work to (tcp://HOST:PORT); default: this machine"),
]
Workers = Annotated[
    int | None, typer.Option(metavar="N", help="Processes on this machine; default: one for each processor", min=1)
]
Results = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder that keeps finished records: a later run continues from them")
]


def _reading_logs(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of `recording.Reading`; they reach it together, as its argument `reading`."""

    def run(**given: Any) -> None:
        from selfcal.logs.recording import parse_pairs, parse_scales

        option = {name: given.pop(name) for name in _READING}
        command(
            **given,
            reading={
                "rate": option["rate"],
                "columns": parse_pairs("--column", option["column"] or ()),
                "units": parse_pairs("--unit", option["unit"] or ()),
                "scale": parse_scales(option["scale"] or ()),
                "no_time": option["no_time"],
                "skip_bad": option["skip_bad"],
                "sources": option["source"] or (),
                "dbc": option["dbc"],
            },
        )

    own = [one for one in signature(command, eval_str=True).parameters.values() if one.name != "reading"]
    added = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default) in _READING.items()
    ]
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    run.__annotations__ = {one.name: one.annotation for one in (*own, *added)}
    shown = Signature([one.replace(kind=Parameter.KEYWORD_ONLY) for one in own] + added)
    run.__signature__ = shown  # type: ignore[attr-defined]
    return run


def _judge(result: Mapping[str, Any], fail_on: str | None) -> None:
    """End by the signal that came, else by what `--fail-on` and the limits make of the result."""
    Held().check()
    codes = [0]
    if fail_on is not None:
        from selfcal.batch.fail_on import outcome

        found = outcome(result, fail_on)
        for line in found.lines:
            note(line)
        codes.append(found.code)
    if "limits" in result:
        from selfcal.batch.verdicts import PASS, Verdict, code_of

        known = ("recording", "device")
        verdicts = [Verdict.of({k: v for k, v in one.items() if k not in known}) for one in result["limits"]]
        for one, entry in zip(verdicts, result["limits"], strict=True):
            if one.verdict != PASS:
                note(f"{entry['recording']}: {one.words}" if "recording" in entry else one.words)
        codes.append(code_of(verdicts))
    if any(codes):
        sys.exit(1 if 1 in codes else 2)


@app.command()
@_reading_logs
def identify(
    reading: Reading,
    log: Log,
    axis: Axis = None,
    model: ModelFile = None,
    engine: Annotated[Engine, typer.Option(help="What computes")] = Engine.library,
    decimate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Rate of the block means instead of the model file's")
    ] = None,
    json: Json = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Save the Allan deviations beside the model's (.png .pdf .svg)")
    ] = None,
    table_units: Annotated[
        Units,
        typer.Option("--units", help="Of table and plot: the recording's, or deg/sqrt(h), deg/h, ug as data sheets"),
    ] = Units.recording,
    export: Annotated[
        tuple[str, Path] | None,
        typer.Option(
            metavar="FORMAT FILE",
            help="Write noise parameters for kalibr, rotors, px4, orbslam3, vins, openvins or allan_variance_ros",
        ),
    ] = None,
    overbound: Annotated[
        float | None,
        typer.Option(
            metavar="P", help="Export white noise and walk above the recording's Allan deviation, at P (0.95)"
        ),
    ] = None,
    no_suspicion: Annotated[
        bool, typer.Option("--no-suspicion", help="No second look at the axes that are not adequate")
    ] = False,
    fail_on: FailOn = None,
    limits: Limits = None,
    junit: Junit = None,
    verdicts: Verdicts = None,
    start: Start = None,
    end: End = None,
    since_power_on: SincePowerOn = 0.0,
    gate: Gate = False,
) -> None:
    """Probability of each drift law, noise parameters with intervals, and the bias of a recording at rest."""
    from selfcal.show.table import show
    from selfcal.verbs import identify as verb

    result = verb.identify(
        log,
        axes=axis or (),
        model=model,
        engine=engine.value,
        decimate=decimate,
        json=json,
        plot=plot,
        datasheet=table_units is Units.datasheet,
        export=export,
        overbound=overbound,
        suspicion=not no_suspicion,
        fail_on=fail_on,
        limits=limits,
        junit=junit,
        verdicts=verdicts,
        start_s=start,
        end_s=end,
        since_power_on_s=since_power_on,
        gate=gate,
        **reading,
    )
    show(result, to_stderr=str(json) == "-", datasheet=table_units is Units.datasheet)
    _judge(result, fail_on)


@app.command()
@_reading_logs
def diagnose(
    reading: Reading,
    log: Log,
    axis: Axis = None,
    model: ModelFile = None,
    decimate: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Look at means at this rate alone; default: means of 1 s, then every sample"),
    ] = None,
    full_rate: Annotated[
        bool, typer.Option("--full-rate", help="Look at every sample at once, not at means of 1 s first")
    ] = False,
    json: Json = None,
    report: Report = None,
    write_model: Annotated[
        Path | None, typer.Option(metavar="MODEL.yaml", help="Write the model file with what was found in it")
    ] = None,
    on: Annotated[
        Path | None, typer.Option(metavar="LOG", help="Measure each finding's gain on a second recording of the part")
    ] = None,
    fail_on: FailOn = None,
    limits: Limits = None,
    junit: Junit = None,
    verdicts: Verdicts = None,
    start: Start = None,
    end: End = None,
    since_power_on: SincePowerOn = 0.0,
    gate: Gate = False,
) -> None:
    """What the model gets wrong in a recording at rest, why, and what mending it gains."""
    from selfcal.verbs import diagnose as verb

    result = verb.diagnose(
        log,
        axes=axis or (),
        model=model,
        decimate=decimate,
        full_rate=full_rate,
        json=json,
        report=report,
        write_model=write_model,
        on=on,
        fail_on=fail_on,
        limits=limits,
        junit=junit,
        verdicts=verdicts,
        start_s=start,
        end_s=end,
        since_power_on_s=since_power_on,
        gate=gate,
        **reading,
    )
    verb.show(result, to_stderr=str(json) == "-")
    _judge(result, fail_on)


@app.command()
@_reading_logs
def compare(
    reading: Reading,
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG LOG...", help=f"Recordings of one part: {READ}", show_default=False)
    ],
    axis: Axis = None,
    model: ModelFile = None,
    decimate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Diagnose block means at this rate; default: every sample")
    ] = None,
    fail_on: Annotated[
        str | None,
        typer.Option(
            metavar="changed|inadequate|CAUSE", help="Exit code 1 when an axis shows it, 2 when one cannot be judged"
        ),
    ] = None,
    limits: Limits = None,
    junit: Junit = None,
    verdicts: Verdicts = None,
    start: Start = None,
    end: End = None,
    gate: Gate = False,
    json: Json = None,
    report: Report = None,
) -> None:
    """What changed between recordings of one part, beyond what each leaves open."""
    from selfcal.verbs import compare as verb

    result = verb.compare(
        logs,
        axes=axis or (),
        model=model,
        decimate=decimate,
        fail_on=fail_on,
        limits=limits,
        junit=junit,
        verdicts=verdicts,
        start_s=start,
        end_s=end,
        gate=gate,
        json=json,
        report=report,
        **reading,
    )
    verb.show(result, to_stderr=str(json) == "-")
    _judge(result, fail_on)


@app.command()
@_reading_logs
def fleet(
    reading: Reading,
    patterns: Annotated[
        list[str],
        typer.Argument(
            metavar="PATTERN...", help="Recordings: files, or patterns as 'logs/**/*.ulg'", show_default=False
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="FILE", help="Table to write: .csv or .parquet", show_default=False),
    ],
    serial_from: Annotated[
        str | None,
        typer.Option(
            metavar="name|field",
            help="Device by the file's name (name:REGEX: by what it finds in the path), or by the metadata",
        ),
    ] = None,
    units_table: Annotated[
        Path | None, typer.Option(metavar="UNITS.csv", help="Columns file, device, and station, lot, date")
    ] = None,
    with_diagnose: Annotated[bool, typer.Option("--diagnose", help="Look for causes too; slower")] = False,
    fail_on: FailOn = None,
    limits: Limits = None,
    junit: Junit = None,
    verdicts: Verdicts = None,
    json: Json = None,
    report: Annotated[Path | None, typer.Option(metavar="FILE.html", help="Write a page of the batch")] = None,
    write_model: Annotated[
        Path | None, typer.Option(metavar="FILE.yaml", help="Write the model with the batch as a new unit's priors")
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    results: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of finished recordings; default: FILE.parts")
    ] = None,
    axis: Axis = None,
    model: ModelFile = None,
    start: Start = None,
    end: End = None,
    since_power_on: SincePowerOn = 0.0,
    gate: Gate = False,
) -> None:
    """Identify many recordings, and write one table of the units."""
    from selfcal.verbs import fleet as verb

    result = verb.fleet(
        patterns,
        output,
        serial_from=serial_from,
        units_table=units_table,
        diagnose=with_diagnose,
        fail_on=fail_on,
        limits=limits,
        junit=junit,
        verdicts=verdicts,
        json=json,
        report=report,
        write_model=write_model,
        workers=workers,
        scheduler=scheduler,
        results=results,
        axes=axis or (),
        model=model,
        start_s=start,
        end_s=end,
        since_power_on_s=since_power_on,
        gate=gate,
        **reading,
    )
    verb.show(result, to_stderr=str(json) == "-")
    sys.exit(result["code"])


@app.command()
def plan(
    model: Annotated[Path, typer.Argument(metavar="MODEL.yaml", help="Model file of the part", show_default=False)],
    want: Annotated[
        list[str],
        typer.Option(
            metavar="WISH",
            help="'K within 20 %', 'bias within 0.001 deg/s', 'law decided 95 %', 'temperature within 10 %' (repeat)",
        ),
    ],
    axis: Annotated[
        str | None, typer.Option(metavar="NAME", help="Axis of the part; default: the first that `simulate` states")
    ] = None,
    records: Annotated[int, typer.Option(metavar="N", help="Simulated parts")] = 200,
    seed: Annotated[int, typer.Option(metavar="N", help="Same seed, same parts", min=0)] = 1,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Save what is reached over the length")] = None,
    scheduler: Scheduler = None,
    json: Json = None,
) -> None:
    """How long a part must be recorded, and at what rate, until what is wanted is known."""
    from selfcal.verbs import plan as verb

    result = verb.plan(
        model, want=want, axis=axis, records=records, seed=seed, plot=plot, json=json, scheduler=scheduler
    )
    verb.show(result, to_stderr=str(json) == "-")


@app.command()
@_reading_logs
def response(
    reading: Reading,
    log: Log,
    input_: Annotated[
        str, typer.Option("--input", metavar="CH", help="What acts: temp, supply or an axis", show_default=False)
    ],
    output: Annotated[str, typer.Option(metavar="AXIS", help="The axis that answers", show_default=False)],
    model: ModelFile = None,
    decimate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Rate of the block means; default: every sample, up to 20 000")
    ] = None,
    json: Json = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Save gain, phase and coherence (.png .pdf .svg)")
    ] = None,
    start: Start = None,
    end: End = None,
    gate: Gate = False,
) -> None:
    """How an axis answers to a channel: gain, lag, order, frequency response, and which of the two acts."""
    from selfcal.verbs import response as verb

    result = verb.response(
        log,
        input=input_,
        output=output,
        model=model,
        decimate=decimate,
        json=json,
        plot=plot,
        start_s=start,
        end_s=end,
        gate=gate,
        **reading,
    )
    verb.show(result, to_stderr=str(json) == "-")
    Held().check()


@app.command()
@_reading_logs
def convert(
    reading: Reading,
    log: Log,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE", help=f"Recording to write: {WRITTEN}", show_default=False)
    ],
) -> None:
    """Write a log of any form as a recording that every other program reads."""
    from selfcal.verbs import convert as verb

    result = verb.convert(
        log,
        output,
        **reading,
    )
    verb.show(result, output)


@app.command()
@_reading_logs
def part(
    reading: Reading,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="MODEL.yaml", help="Model file to write", show_default=False)
    ],
    log: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[LOG...]", help=f"Recording at rest: {READ}; or --datasheet alone", show_default=False),
    ] = None,
    name: Annotated[str | None, typer.Option(metavar="NAME", help="Of the part; default: the recording's")] = None,
    datasheet: Annotated[
        list[str] | None,
        typer.Option(metavar="N=0.012deg/sqrt(h)", help="Number of its data sheet, or gx.N=... (repeat for more)"),
    ] = None,
    axis: Annotated[
        list[str] | None,
        typer.Option("--axis", metavar="NAME", help="Column that is an axis, beside gx to az (repeat for more)"),
    ] = None,
    start: Start = None,
    end: End = None,
) -> None:
    """Write the model file of another part, from a recording at rest or its data sheet."""
    from selfcal.verbs import part as verb

    model = verb.part(
        log or (),
        output,
        name=name,
        datasheet=datasheet or (),
        axes=axis or (),
        start_s=start,
        end_s=end,
        **reading,
    )
    verb.show(model)


@app.command()
@_reading_logs
def rivals(
    reading: Reading,
    log: Annotated[
        Path | None,
        typer.Argument(metavar="[LOG]", help=f"Recording: {READ}; or give --records", show_default=False),
    ] = None,
    records: Annotated[
        int | None, typer.Option(metavar="N", help="Instead of a recording: simulated records of each law")
    ] = None,
    samples: Annotated[
        list[int] | None, typer.Option(metavar="N", help="Samples of each record (repeat for more); default: 150, 600")
    ] = None,
    truth: Annotated[
        str, typer.Option(metavar="middle|prior", help="Parameters of the records: the priors' middle, or drawn")
    ] = "middle",
    seed: Annotated[int, typer.Option(metavar="N", help="Same seed, same records", min=0)] = 1,
    axis: Axis = None,
    model: ModelFile = None,
    decimate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Rate of the block means instead of the model file's")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Method to run (repeat for more); default: all")
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    results: Results = None,
    json: Json = None,
) -> None:
    """Other methods on the same recording, or on simulated records: estimates, choice of a law, time and memory."""
    from selfcal.studies import rivals as verb

    if (log is None) == (records is None):
        raise UserError(f"rivals takes a recording, or --records N for simulated ones: {called()} rivals LOG")
    if records is not None:
        result = verb.ensemble(
            records,
            samples=samples or verb.SAMPLES,
            truth=truth,
            model=model,
            axis=axis[0] if axis else "gx",
            only=only or (),
            seed=seed,
            json=json,
            workers=workers,
            scheduler=scheduler,
            results=results,
        )
        verb.show_ensemble(result, to_stderr=str(json) == "-")
        return
    assert log is not None
    result = verb.rivals(
        log,
        axes=axis or (),
        model=model,
        decimate=decimate,
        only=only or (),
        json=json,
        **reading,
    )
    verb.show(result, to_stderr=str(json) == "-")


def _effects(wanted: bool) -> None:
    if wanted:
        from selfcal.verbs import simulate as verb

        verb.show_effects()
        raise typer.Exit


@app.command()
def simulate(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file, or a part's name", show_default=False)],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="LOG", help=f"Recording to write: {WRITTEN}", show_default=False)
    ],
    seed: Annotated[int, typer.Option(metavar="N", help="Same seed, same recording", min=0)] = 0,
    effect: Annotated[
        list[str] | None,
        typer.Option(metavar="ID[:key=value,...]", help="Effect to put in, axis=NAME for one axis (repeat for more)"),
    ] = None,
    list_effects: Annotated[
        bool,
        typer.Option("--list-effects", help="List effects and their keys, and exit", is_eager=True, callback=_effects),
    ] = False,
) -> None:
    """Write a simulated recording, read out as the sensor would, with its truth in its metadata."""
    from selfcal.verbs import simulate as verb

    verb.show(verb.simulate(model, output, seed=seed, effects=effect or ()), output)


@app.command()
@_reading_logs
def replay(
    reading: Reading,
    log: Log,
    axis: Axis = None,
    model: ModelFile = None,
    start: From = None,
    target: Annotated[Target, typer.Option(help="Where the firmware runs: here, or in QEMU")] = Target.host,
    transport: Annotated[
        Transport | None, typer.Option(help="Compile a program for this machine, whose frames travel so")
    ] = None,
    channel: Annotated[
        str, typer.Option(metavar="NAME", help="With --transport can: a CAN device; default: UDP on this machine")
    ] = "",
    report_every: Annotated[
        float | None, typer.Option(metavar="S", help="Seconds between reports; default: 100 in all, fewer in QEMU")
    ] = None,
    gate: Gate = False,
    begin: Start = None,
    end: End = None,
    since_power_on: SincePowerOn = 0.0,
    json: Json = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Save the plot of the run")] = None,
) -> None:
    """Run the firmware itself over a recording and watch its telemetry."""
    from selfcal.show.table import show
    from selfcal.verbs import replay as verb

    result = verb.replay(
        log,
        axes=axis or (),
        model=model,
        start=start,
        target=target.value,
        transport=transport.value if transport else None,
        channel=channel,
        report_every=report_every,
        gate=gate,
        start_s=begin,
        end_s=end,
        since_power_on_s=since_power_on,
        json=json,
        plot=plot,
        **reading,
    )
    show(result, to_stderr=str(json) == "-")


@app.command()
def monitor(
    channel: Annotated[str | None, typer.Option(metavar="NAME", help="Channel: a serial port for slcan")] = None,
    interface: Annotated[str, typer.Option(metavar="NAME", help="python-can interface")] = "slcan",
    read: Annotated[Path | None, typer.Option(metavar="FILE", help="Read a log of frames instead of a channel")] = None,
    speed: Annotated[float | None, typer.Option(metavar="X", help="Of --read, 1 as it came; default: at once")] = None,
    axis: Axis = None,
    node: Annotated[int | None, typer.Option(metavar="N", help="Show this module alone, 0 to 11")] = None,
    model: Annotated[
        Path | None, typer.Option(metavar="MODEL.yaml", help="Model of a module, for names; default: the default one")
    ] = None,
    start: From = None,
    log: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Keep the raw frames (.asc .blf .csv .log .trc), with the reports (.mcap)"),
    ] = None,
    stream: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND[:HOST:PORT]", help="Reports for other programs: udp-json, jsonl, foxglove (repeat for more)"
        ),
    ] = None,
    duration: Annotated[float | None, typer.Option(metavar="S", help="Stop after this long; default: Ctrl-C")] = None,
    bitrate: Annotated[int | None, typer.Option(metavar="BIT/S", help="Of the CAN bus, if it needs one")] = None,
    once: Annotated[bool, typer.Option("--once", help="End when the port vanishes instead of waiting for it")] = False,
    json: Json = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Save the plot of the run")] = None,
) -> None:
    """Live view of modules' telemetry; exit code 1 if a module was out of reach when the time was up."""
    from selfcal.verbs import monitor as verb

    outcome = verb.monitor(
        interface=interface,
        channel=channel,
        read=read,
        speed=speed,
        axes=axis or (),
        node=node,
        model=model,
        start=start,
        log=log,
        stream=stream or (),
        duration=duration,
        bitrate=bitrate,
        once=once,
        json=json,
        plot=plot,
    )
    sys.exit(1 if outcome.contact_lost else 0)


@app.command()
def demo(
    log: Annotated[
        Path | None,
        typer.Argument(metavar="[LOG]", help=f"Recording: {READ}; default: the shipped one", show_default=False),
    ] = None,
    speed: Annotated[float, typer.Option(metavar="X", help="Times real time")] = 10.0,
    transport: Annotated[Transport, typer.Option(help="How its frames travel")] = Transport.slcan,
    channel: Annotated[str, typer.Option(metavar="NAME", help="With --transport can: a CAN device; default: UDP")] = "",
    node: Annotated[int, typer.Option(metavar="N", help="The module's number on its bus, 0 to 11")] = 0,
) -> None:
    """A module without hardware: the firmware over a recording, for `selfcal monitor` to watch."""
    from selfcal.verbs import demo as verb

    verb.demo(log, speed=speed, transport=transport.value, channel=channel, node=node)


@app.command()
def command(
    order: Annotated[
        str,
        typer.Argument(
            metavar="ORDER",
            help="To a module: reset [forget], save, telemetry_period MS, write_offsets AXES|none. "
            "Of a key: new-key makes one, build-flag prints what an image is built with",
        ),
    ],
    value: Annotated[
        str | None, typer.Argument(metavar="VALUE", help="As the order wants it", show_default=False)
    ] = None,
    key: Annotated[Path, typer.Option("--key", metavar="FILE", help="The module's key")] = Path("selfcal.key"),
    channel: Annotated[str, typer.Option(metavar="NAME", help="Channel: a serial port for slcan")] = "",
    interface: Annotated[str, typer.Option(metavar="NAME", help="python-can interface")] = "slcan",
    bitrate: Annotated[int | None, typer.Option(metavar="BIT/S", help="Of the CAN bus, if it needs one")] = None,
    node: Annotated[int, typer.Option(metavar="N", help="The module's number on its bus, 0 to 11")] = 0,
) -> None:
    """Have a module do something, if its image was built with a command key."""
    from selfcal.verbs import command as verb

    if order == "new-key":
        verb.new_key(key)
    elif order == "build-flag":
        print(verb.build_flag(verb.read_key(key)))
    else:
        answer = verb.command(
            order, value, key_file=key, interface=interface, channel=channel, bitrate=bitrate, node=node
        )
        print(f"{order}: {answer} ({verb.UNVERIFIED})")
        sys.exit(0 if answer == "done" else USER_ERROR)


@app.command()
def montecarlo(
    model: ModelFile = None,
    records: Annotated[int, typer.Option(metavar="N", help="Records per law")] = 400,
    duration: Annotated[float, typer.Option(metavar="S", help="Length of each, s")] = 3600.0,
    axis: Annotated[str, typer.Option(metavar="NAME", help="Axis whose priors are drawn from")] = "gx",
    seed: Annotated[int, typer.Option(metavar="N", help="Same seed, same records", min=0)] = 1,
    workers: Workers = None,
    scheduler: Scheduler = None,
    results: Results = None,
    json: Json = None,
) -> None:
    """Simulate records with parameters drawn from the prior and compare stated with actual errors."""
    from selfcal.studies import montecarlo as verb

    result = verb.montecarlo(
        model,
        records=records,
        duration_s=duration,
        axis=axis,
        seed=seed,
        json=json,
        workers=workers,
        scheduler=scheduler,
        results=results,
    )
    verb.show(result, to_stderr=str(json) == "-")


@app.command()
def paper(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FILE.html", help="Page to write", show_default=False)
    ],
    data: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the real recordings; default: beside the repository")
    ] = None,
    records: Annotated[int, typer.Option(metavar="N", help="Records per law in Figs 1 and 2")] = 500,
    seed: Annotated[int, typer.Option(metavar="N", help="Same seed, same page", min=0)] = 1,
    tracks: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the map errors of Section 4.2, a recording a track"),
    ] = None,
    scheduler: Scheduler = None,
    results: Results = None,
) -> None:
    """Make the figures of Stepanov & Motorin (2017) anew, on one page beside what the paper says."""
    from selfcal.studies import paper as verb

    told = verb.paper(
        output, data=data, records=records, seed=seed, scheduler=scheduler, results=results, tracks=tracks
    )
    verb.show(told, output)


@app.command()
def worth(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[LOG...]", help=f"Recordings at rest: {READ}; default: simulated parts", show_default=False
        ),
    ] = None,
    axis: Axis = None,
    model: ModelFile = None,
    records: Annotated[int, typer.Option(metavar="N", help="Simulated rests of each law and length")] = 200,
    seed: Annotated[int, typer.Option(metavar="N", help="Same seed, same rests", min=0)] = 1,
    scheduler: Scheduler = None,
    results: Results = None,
    json: Json = None,
) -> None:
    """Error of the bias some time after a rest, by the bank and by what people flash today."""
    from selfcal.studies import worth as verb

    result = verb.worth(
        logs or (),
        axes=axis or (),
        model=model,
        records=records,
        seed=seed,
        json=json,
        scheduler=scheduler,
        results=results,
    )
    verb.show(result, to_stderr=str(json) == "-")


@app.command()
def navigate(
    records: Annotated[int, typer.Option(metavar="N", help="Simulated parts of each law")] = 200,
    seed: Annotated[int, typer.Option(metavar="N", help="Same seed, same parts", min=0)] = 1,
    scheduler: Scheduler = None,
    results: Results = None,
    json: Json = None,
) -> None:
    """Errors and consistency of a GPS/INS filter, by the noise that it is told."""
    from selfcal.studies import navigate as verb

    result = verb.navigate(records=records, seed=seed, json=json, scheduler=scheduler, results=results)
    verb.show(result, to_stderr=str(json) == "-")


@app.command()
def codegen(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file, or a part's name", show_default=False)],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for them", show_default=False)],
    target: Annotated[str, typer.Option(help="Whose node counts of the model file")] = "host",
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Rate of the samples that are fed; default: the sensor's")
    ] = None,
    start: From = None,
) -> None:
    """Write the C model tables for the firmware."""
    from selfcal.verbs import codegen as verb

    print(f"{output}: {verb.assumption(verb.codegen(model, output, target=target, rate=rate, start=start))}")


@app.command()
def dbc(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file, or a part's name", show_default=False)],
    node: Annotated[int, typer.Option(metavar="N", help="The module's number on its bus, 0 to 11")] = 0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="File to write; default: stdout")
    ] = None,
) -> None:
    """Write the DBC file of one module, with its model's names and units."""
    from selfcal.verbs import dbc as verb

    verb.dbc(model, node=node, output=output)


#: What typer says of a wrong value, and what a person reads.
_PLAINER = {
    "Value error, ": "",
    "Input should be a valid integer, unable to parse string as an integer": "must be a whole number",
    "Input should be a valid number, unable to parse string as a number": "must be a number",
    "Input should be": "must be",
}


def _usage(error: TyperException) -> str:
    """One line of a wrong use: what is wrong, what is wanted there, and where to read on."""
    said = error.format_message().rstrip(".")
    for theirs, ours in _PLAINER.items():
        said = said.replace(theirs, ours)
    wanted = getattr(getattr(error, "param", None), "help", None) if said.startswith("Missing") else None
    context = getattr(error, "ctx", None)
    verb = f" {context.info_name}" if context is not None and context.parent is not None else ""
    return f"{said}{f' ({wanted})' if wanted else ''}; see `{called()}{verb} --help`"


def _fail(message: str) -> NoReturn:
    print(f"selfcal: error: {printable(' '.join(message.split()))}", file=sys.stderr)
    sys.exit(USER_ERROR)


def _check_once(verbs: Mapping[str, Any], arguments: Sequence[str]) -> None:
    """Refuse an option that is given twice and takes one value: typer would drop the first without a word."""
    verb = verbs.get(arguments[0]) if arguments else None
    given = [one.split("=", 1)[0] for one in takewhile(lambda one: one != "--", arguments)]
    for option in verb.params if verb is not None else ():
        times = sum(given.count(name) for name in option.opts if name.startswith("-"))
        if times > 1 and not getattr(option, "multiple", True) and not getattr(option, "is_flag", True):
            name = max(option.opts, key=len)
            raise UserError(f"{name} is given {times} times; it takes one value: run once for each")


def main() -> NoReturn:
    """Entry point. Exit codes: 0, USER_ERROR with one line on stderr, 128 + its number after a signal (Ctrl-C: 130); a
    traceback is our bug."""
    install()
    if not sys.warnoptions:  # a library's warning is none for the user
        warnings.simplefilter("ignore")
    try:
        whole = typer.main.get_command(app)
        _check_once(getattr(whole, "commands", {}), sys.argv[1:])
        code = whole(args=sys.argv[1:] or ["--help"], standalone_mode=False)
        if code == INTERRUPTED:  # typer's code for every signal
            leave(last_signal() or code)
        sys.exit(code)
    except UserError as error:
        _fail(str(error))
    except TyperException as error:
        _fail(_usage(error))
    except (typer.Abort, KeyboardInterrupt):
        leave(last_signal() or INTERRUPTED)
    except (BrokenPipeError, SystemExit) as error:  # the reader of our output has gone, as in `| head`
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise  # typer turns the others into one
        for stream in (sys.stdout, sys.stderr):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        sys.exit(0)
    except OSError as error:
        _fail(f"{error.filename}: {error.strerror}" if error.filename is not None else str(error))


if __name__ == "__main__":
    main()
