"""An inertial sensor at rest identifies its own error model. Every verb of the command is a function here.

    import numpy as np
    import selfcal

    random = np.random.default_rng(1)
    gyro = 0.02 * random.standard_normal((6000, 3))  # 10 minutes at 10 Hz; a file's name or a data frame will do
    found = selfcal.identify(gyro, rate_hz=10.0, units="deg/s")
    print(found)  # the command's table
    print(found.axes["gx"].law, found.axes["gx"].bias_now.mean)
    found.plot("allan.png")  # in a notebook: found.plot()
    print(selfcal.diagnose(gyro, axes=["gx"], rate_hz=10.0, units="deg/s"))

`help(selfcal.identify)` has its keywords. Errors that you can put right are `selfcal.UserError`.
"""

from __future__ import annotations

import builtins
from collections.abc import Callable, Iterator
from difflib import get_close_matches
from functools import wraps
from importlib import import_module
from importlib.util import find_spec
from itertools import takewhile
from pathlib import Path
from typing import Any

#: File of each verb; it has a function of its name.
VERBS = {path.stem: path for path in sorted((Path(__file__).parent / "verbs").glob("[a-z]*.py"))}

#: Names that scripts take apart from the verbs, and their modules.
_OTHERS = {
    "load": "logs.recording",
    "save": "logs.recording",
    "Recording": "logs.recording",
    "UserError": "base.errors",
}
#: Instructions of newer processors that a compiled module has a build for.
_BUILDS = {"_library32": "fma", "_likelihood": "avx2", "_joint": "avx2"}


def __getattr__(name: str) -> Any:
    """The verb called `name`, imported when it is first asked for so that the command starts at once."""
    if name in VERBS:
        globals()[name] = _plain(import_module(f"selfcal.verbs.{name}"), name)
        return globals()[name]
    if name in _OTHERS:
        other = getattr(import_module(f"selfcal.{_OTHERS[name]}"), name)
        return other if isinstance(other, type) else _in_python(other)
    if name in _BUILDS:
        globals()[name] = import_module(f"selfcal.{name}{_newer(name)}")
        return globals()[name]
    if name == "__version__":
        from importlib.metadata import version

        return version("selfcal")
    raise AttributeError(f"module 'selfcal' has no attribute '{name}'")


class Names(dict[str, Any]):
    """The names of a verb's file. One that it imports for type checkers alone is any type."""

    def __missing__(self, name: str) -> Any:
        return getattr(builtins, name, Any)


def keywords(module: Any, name: str) -> Iterator[tuple[Any, Any]]:
    """Each keyword of a verb, annotated with its type alone, and its option of the command line or None."""
    from inspect import Parameter, signature
    from typing import Annotated, get_args, get_origin, get_type_hints

    for parameter in signature(getattr(module, name)).parameters.values():
        hint = eval(parameter.annotation, {}, Names(vars(module)))  # our own source, not a user's
        hints = {parameter: hint}
        if parameter.kind is Parameter.VAR_KEYWORD:  # Unpack[TypedDict]: each of its keys is a keyword
            each = get_type_hints(get_args(hint)[0], include_extras=True)
            hints = {Parameter(key, Parameter.KEYWORD_ONLY, default=None): of for key, of in each.items()}
        for own, of in hints.items():
            kind, *options = get_args(of) if get_origin(of) is Annotated else (of,)
            yield own.replace(annotation=kind), options[0] if options else None


def _plain(module: Any, name: str) -> Callable[..., Any]:
    """A verb whose signature has the types alone, without the options of the command line, and each keyword. Its
    docstring ends with what the command's help says of each."""
    from inspect import cleandoc, signature
    from textwrap import fill

    from selfcal.base.errors import in_python

    verb = getattr(module, name)
    known = list(keywords(module, name))
    call = _in_python(verb)
    shown = [parameter for parameter, _ in known]
    call.__signature__ = signature(verb).replace(parameters=shown)  # type: ignore[attr-defined]
    call.__module__ = __name__
    words = [cleandoc(str(verb.__doc__)), ""]
    for parameter, option in known:
        if option is not None:
            typed = f" ({option.names[-1]})" if option.names else ""
            said = f"{parameter.name}{typed}: {in_python(option.help)}"
            words.append(fill(said, 120, subsequent_indent="    "))
    call.__doc__ = "\n".join(words)
    return call


def _in_python(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function whose errors name keywords, and no options of the command line."""

    @wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        from selfcal.base.errors import UserError, in_python

        known: Any = getattr(call, "__signature__", None)
        for name in options if known is not None else ():
            if name not in known.parameters:
                near = get_close_matches(name, list(known.parameters), 1)
                raise UserError(f"{function.__name__}() has no keyword {name}" + "".join(f": {word}?" for word in near))
        try:
            return function(*arguments, **options)
        except UserError as error:
            error.args = (in_python(str(error)),)
            raise

    return call


def _newer(name: str) -> str:
    """The end of the name of the build for newer processors, if this one and the package have it. Each rounds alike."""
    flag = _BUILDS[name]
    if find_spec(f"selfcal.{name}_{flag}") is None:
        return ""
    try:
        with Path("/proc/cpuinfo").open(encoding="ascii", errors="replace") as file:
            first_core = takewhile(str.strip, file)
            has = any(line.startswith("flags") and flag in line.split() for line in first_core)
    except OSError:
        return ""
    return f"_{flag}" if has else ""


def __dir__() -> list[str]:
    return [*globals(), *VERBS, *_OTHERS, "__version__"]


__all__ = [*VERBS, *_OTHERS]  # noqa: PLE0604 (their names)
