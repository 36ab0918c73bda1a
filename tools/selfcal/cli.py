"""The command `selfcal`: the options of one verb in, that verb called, errors as one line.

A verb's options are annotated on its function (`base/options.py`). A verb is imported only when it is asked for.
"""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from inspect import Parameter, Signature
from itertools import takewhile
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, NoReturn, get_args, get_origin

import typer
from typer.core import TyperGroup
from typer.exceptions import TyperException

import selfcal
from selfcal.base.ending import install_signals, last_signal, leave
from selfcal.base.errors import UserError, called, printable
from selfcal.base.options import Option

#: Exit code of everything the user can put right: typer's of a wrong use.
USER_ERROR = typer.BadParameter.exit_code
#: ... after Ctrl-C.
INTERRUPTED = 128 + signal.SIGINT
#: Folder of what compares the method with others; the verb of a file there stands apart in the help.
_STUDIES = Path(__file__).parent / "studies"


class _Verbs(TyperGroup):
    """The verbs, each imported when it runs or its help is asked for. The first line of its file is its help."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(selfcal.VERBS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        return _command(cmd_name) if cmd_name in selfcal.VERBS else None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        rows = {name: _first_line(path) for name, path in selfcal.VERBS.items()}
        studies = [name for name in rows if (_STUDIES / f"{name}.py").exists()]
        for heading, names in (("Commands", rows.keys() - studies), ("Studies of the method", studies)):
            with formatter.section(heading):
                formatter.write_dl([(name, rows[name]) for name in sorted(names)])


def _first_line(path: Path) -> str:
    with path.open(encoding="utf-8") as file:
        return file.readline().strip().strip('"').removesuffix(".")


def _command(name: str) -> Any:
    """The command of a verb, by the annotations of its function."""
    module = import_module(f"selfcal.verbs.{name}")
    options: dict[str, tuple[Option, Any]] = {}
    parameters = []
    for own, meant in selfcal.keywords(module, name):
        if meant is not None:
            parameters.append(_parameter(own, meant))
            options[own.name] = meant, parameters[-1].default

    def run(**parsed: Any) -> None:
        given = {}
        for key, value in parsed.items():
            meant, unset = options[key]
            if value not in (unset, []):  # what is not typed keeps the function's default
                given[key] = meant.made(value) if meant.made is not None else value
        answer = getattr(module, name)(**given)
        sys.exit(module.show(answer, given) or 0 if hasattr(module, "show") else 0)

    run.__doc__ = f"{_first_line(selfcal.VERBS[name])}."
    run.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    alone = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None, add_completion=False)
    alone.command(name)(run)
    return typer.main.get_command(alone)


def _parameter(own: Parameter, meant: Option) -> Parameter:
    """A parameter as typer takes it: the type that is parsed, and the default that the help shows."""
    kind, default = meant.kind or _parsed(own.annotation), own.default
    if default == () or (meant.made is not None and default is not Parameter.empty):
        default = False if kind is bool else None
    more = dict(meant.more)
    default = more.pop("default", default)
    names = meant.names if meant.names or meant.argument else (f"--{own.name.replace('_', '-')}",)
    info = typer.Argument if meant.argument else typer.Option
    shown = info(*names, metavar=meant.metavar, help=meant.help, **more)
    optional = kind if default is not None else kind | None
    return Parameter(own.name, Parameter.KEYWORD_ONLY, annotation=Annotated[optional, shown], default=default)


def _parsed(hint: Any) -> Any:
    """What a parameter's hint is on a command line: a path of a path or a text, a list of a sequence."""
    kinds = [kind for kind in get_args(hint) if kind is not NoneType] if isinstance(hint, UnionType) else [hint]
    kind = Path if Path in kinds else kinds[0]
    return list[get_args(kind)[0]] if get_origin(kind) is Sequence else kind  # type: ignore[misc]


app = typer.Typer(
    cls=_Verbs,
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
    path = "selfcal" if context is None else context.command_path
    return f"{said}{f' ({wanted})' if wanted else ''}; see `{called()}{path.removeprefix('selfcal')} --help`"


def _fail(message: str) -> NoReturn:
    print(f"selfcal: error: {printable(' '.join(message.split()))}", file=sys.stderr)
    sys.exit(USER_ERROR)


def _check_once(options: Sequence[Any], arguments: Sequence[str]) -> None:
    """Refuse an option that is given twice and takes one value: typer would drop the first without a word."""
    given = [word.split("=", 1)[0] for word in takewhile(lambda word: word != "--", arguments)]
    for option in options:
        times = sum(given.count(name) for name in option.opts if name.startswith("-"))
        if times > 1 and not getattr(option, "multiple", True) and not getattr(option, "is_flag", True):
            name = max(option.opts, key=len)
            raise UserError(f"{name} is given {times} times; it takes one value: run once for each")


def main() -> NoReturn:
    """Entry point. Exit codes: 0, USER_ERROR with one line on stderr, 128 + its number after a signal (Ctrl-C: 130); a
    traceback is our bug."""
    install_signals()
    # The matrices are small, and axes run side by side: threads of one product wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if not sys.warnoptions:  # a library's warnings are not for the user
        warnings.simplefilter("ignore")
    try:
        name, *rest = sys.argv[1:] or ["--help"]
        if name in selfcal.VERBS:  # without what the options of the command itself take at their start
            command, arguments, path = _command(name), rest, f"selfcal {name}"
            _check_once(command.params, rest)
        else:
            command, arguments, path = typer.main.get_command(app), [name, *rest], "selfcal"
        code = command(args=arguments, prog_name=path, standalone_mode=False)
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
