"""The results of `identify`, `replay`, `diagnose` and `compare`: their JSON objects, with the keys as attributes.

Each is a dict with the keys that tools/pages list under "JSON". `found["axes"]["gx"]["bias_now"]` and
`found.axes["gx"].bias_now` are the same. An attribute whose annotation has None is None where the key is absent; any
other absent key raises AttributeError, with the reason of an axis that has no result.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

from selfcal.base.errors import UserError, install_line
from selfcal.base.output import TABLE_WIDTH


class Object(dict[str, Any]):
    """A JSON object. A value becomes what its annotation in the class says, however deep."""

    def __init__(self, entries: Mapping[str, Any]) -> None:
        hints = _hints(type(self))
        super().__init__({key: _typed(value, hints.get(key, Any)) for key, value in entries.items()})

    def __getattr__(self, name: str) -> Any:
        if name in self:
            return self[name]
        hint = _hints(type(self)).get(name)
        if NoneType in get_args(hint):
            return None
        said = f": {self['error']}" if hint is not None and "error" in self else ""
        raise AttributeError(f"'{type(self).__name__}' has no '{name}'{said}")

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *_hints(type(self)), *self]


@lru_cache(maxsize=64)
def _hints(of: type[Object]) -> dict[str, Any]:
    return get_type_hints(of)


def _typed(value: Any, hint: Any) -> Any:
    """`value` with the classes of `hint`; as it is where that does not fit it."""
    if isinstance(hint, UnionType):
        hint = next((choice for choice in get_args(hint) if isinstance(value, _shape(choice))), Any)
    arguments = get_args(hint)
    if get_origin(hint) is dict and isinstance(value, Mapping):
        return {key: _typed(entry, arguments[1]) for key, entry in value.items()}
    if get_origin(hint) is list and isinstance(value, list):
        return [_typed(entry, arguments[0]) for entry in value]
    if isinstance(hint, type) and issubclass(hint, Object) and isinstance(value, Mapping):
        return hint(value)
    return value


def _shape(hint: Any) -> type:
    """What a value must be to be taken for `hint`."""
    hint = get_origin(hint) or hint
    if not isinstance(hint, type):
        return object
    return Mapping if issubclass(hint, Object) else hint


class Damaged(Object):
    """What of the files could not be read: bytes, and the messages, frames or lines that they were, at least; and a
    line that says it."""

    bytes: int
    messages: int
    words: str


class Recording(Object):
    """What was read. `start_s`: where in the recording its first sample is; `notes`: what was found in the file."""

    path: str
    rate_hz: float
    samples: int | None
    duration_s: float
    start_s: float
    since_power_on_s: float | None
    paths: list[str] | None
    options: list[Any] | None
    notes: list[str] | None
    damaged: Damaged | None


class Posterior(Object):
    """A parameter under a law, in `unit`; q05 and q95 bound the 90 % interval. `identified`: the record says
    more than the prior. `off_grid`: the truth may lie beyond what the model's grid of nodes can show."""

    mean: float
    median: float
    sd: float
    q05: float
    q95: float
    unit: str
    identified: bool
    off_grid: bool | None


class OfAll(Object):
    """A bias by the readings of all axes."""

    mean: float
    sd: float


class Bias(Object):
    """x0 + drift at the last sample, in `unit`. `together`: by the readings of all axes, where the model file states a
    quantity that moves them."""

    mean: float
    sd: float
    unit: str
    together: OfAll | None


class Check(Object):
    """A check of the likeliest law."""

    value: float | None
    limit: float | None
    passed: bool


class IdentifiedAxis(Object):
    """An axis of `identify` or `replay`, or `error` alone. Probabilities and ln evidence (nats) by law; posteriors by
    law and parameter. `adequate`: every check passed; None without checks. `module_says`, `module_reason` and `ahead`:
    of `replay`."""

    error: str | None
    hypotheses: dict[str, float]
    log_evidence: dict[str, float]
    parameters: dict[str, dict[str, Posterior]]
    bias_now: Bias
    samples_kept_out: dict[str, int]
    rate_hz: float | None
    adequate: bool | None
    checks: dict[str, Check]
    suspicion: str | None
    more_laws: dict[str, float] | None
    added_law: str | None
    own_priors: dict[str, Any] | None
    halved_after_s: dict[str, float | None] | None
    allan: dict[str, Any] | None
    regressors: dict[str, Any] | None
    regressors_in_use: list[str] | None
    subsets: list[Any] | None
    module_says: dict[str, Any] | None
    module_reason: str | None
    ahead: dict[str, Any] | None

    @property
    def law(self) -> str:
        """The most probable law."""
        return max(self.hypotheses, key=lambda name: self.hypotheses[name])


class Picture:
    """A picture, which a notebook shows: its PNG."""

    def __init__(self, png: bytes) -> None:
        self.png = png

    def _repr_png_(self) -> bytes:
        return self.png


class Document(Object):
    """What a verb answers. Its repr is what the command prints: `show` of the module `_shown_by` in this folder."""

    _shown_by = ""

    def _rows(self) -> Iterator[dict[str, Any]]:
        """The rows of `to_frame`."""
        raise NotImplementedError

    def to_frame(self) -> Any:
        """A pandas data frame of its numbers, a row each. Raises UserError where pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise UserError(f"to_frame() takes pandas: {install_line('pandas')}") from None
        return pandas.DataFrame(list(self._rows()))

    def _console(self, **more: Any) -> Any:
        from rich.console import Console

        console = Console(file=io.StringIO(), width=TABLE_WIDTH, **more)
        if not self._shown_by:
            raise NotImplementedError
        import_module(f"selfcal.show.{self._shown_by}").show(self, console=console)
        return console

    def __repr__(self) -> str:
        try:
            return str(self._console().file.getvalue()).rstrip("\n")
        except (KeyError, NotImplementedError):  # a part of a document, or a document without a table
            return super().__repr__()

    def _repr_html_(self) -> str:
        form = '<pre style="white-space:pre;overflow-x:auto;line-height:normal">{code}</pre>'
        return str(self._console(record=True, force_terminal=True).export_html(inline_styles=True, code_format=form))


class Identification(Document):
    """`selfcal.identify/1`."""

    schema: str
    recording: Recording
    axes: dict[str, IdentifiedAxis]
    _shown_by = "identification"

    def _rows(self) -> Iterator[dict[str, Any]]:
        """Axis, law and parameter with the posterior; of an axis without a result the reason."""
        for name, axis in self["axes"].items():
            if "error" in axis:
                yield {"axis": name, "error": axis["error"]}
            for law, parameters in axis.get("parameters", {}).items():
                for parameter, estimate in parameters.items():
                    yield {
                        "axis": name,
                        "law": law,
                        "probability": axis["hypotheses"][law],
                        "parameter": parameter,
                        **estimate,
                    }

    def plot(self, path: Path | str | None = None, *, datasheet: bool = False) -> Picture | None:
        """The Allan deviation of each axis with the model's, as `identify --plot` has it: a picture, which a notebook
        shows, or the file `path`. `datasheet`: in the units of data sheets. Raises UserError."""
        from selfcal.base.output import check_picture
        from selfcal.show.allan_plot import figure_of, plot_allan
        from selfcal.show.plots import png_of

        if path is None:
            return Picture(png_of(figure_of(self, datasheet=datasheet), dpi=90))
        check_picture(path)
        plot_allan(self, path, datasheet=datasheet)
        return None


class Change(Object):
    """What an event changes on an axis: N, K and B without it over with it (None: with it, the record shows none), how
    far it moves the bias, in `unit`, and the error of the bias ahead by horizon, s. `material`: those that matter."""

    N: float | None
    K: float | None
    B: float | None
    bias: float
    unit: str
    bias_error: dict[str, dict[str, float]] | None
    material: list[str]


class Event(Object):
    """An event or source of all axes that it acts on: what these have in common (`estimate`), its sizes and probability
    by axis, what it changes, and where it comes from. `confirmed`: held-out time shows it, and
    `confirmed_on` a second recording; None: none can."""

    id: str
    cause: str
    words: str
    source: str
    estimate: dict[str, Any]
    axes: dict[str, dict[str, Any]]
    evidence_nats: float
    net_nats: float
    material: bool
    confirmed: bool | None
    confirmed_on: bool | None
    changes: dict[str, Change]
    also_possible: list[str]
    record_next: str
    next_record: dict[str, Any] | None
    gain_on: dict[str, Any] | None
    navigation: dict[str, Any] | None
    navigation_reason: str | None


class Finding(Object):
    """A cause that explains something of the record: its evidence gain in nats, its size with interval and unit, the
    time [begin, end] in s if any, what it gains on held-out data, and the causes that would explain as much."""

    cause: str
    words: str
    evidence_gain_nats: float
    net_nats: float
    estimate: dict[str, Any]
    when: list[float] | None
    found_in_round: int
    also_possible: list[str]
    of: str
    shared_with: list[str]
    record_next: str | None
    next_record: dict[str, Any] | None
    gain: dict[str, Any] | None
    gain_reason: str | None
    gain_on: dict[str, Any] | None
    gain_on_reason: str | None
    left_out_of_model: str | None
    inflation: dict[str, float]
    inflation_words: str


class DiagnosedAxis(Object):
    """An axis of `diagnose`, or `error` alone. `verdict`: "inadequate" with a finding that matters, or without a name.
    `causes`: all of its own, `material`: those that matter. `numbers`: N, K and B before and after. `stated`: causes
    that it shows and the model file has already."""

    error: str | None
    unit: str
    judged_at_hz: float
    verdict: str
    causes: list[str]
    material: list[str]
    small_findings: int
    numbers: dict[str, Any]
    stated: list[str] | None
    findings: list[Finding]
    only_in_means: list[Finding] | None
    not_found: list[dict[str, Any]]
    not_judged: list[dict[str, Any]]
    discrepancies: list[dict[str, Any]]
    posterior: dict[str, Any] | None
    gain_on: dict[str, Any] | None
    gain_on_reason: str | None
    unfinished: str | None


class Diagnosis(Document):
    """`selfcal.diagnose/1`. `model`: the extended model, as a model file has it. Pictures: `diagnose(report=)`."""

    schema: str
    recording: Recording
    findings: list[Event]
    axes: dict[str, DiagnosedAxis]
    model: dict[str, Any]
    navigation: dict[str, Any] | None
    _shown_by = "diagnosis_lines"

    def _rows(self) -> Iterator[dict[str, Any]]:
        """Axis, cause, evidence and each number of its estimate, of what acts on all axes too; `value`: no number. Of
        an axis without a finding the verdict, or the reason."""
        events = {event["id"]: event for event in self.get("findings", ())}
        for name, axis in self["axes"].items():
            head = {"axis": name, **{key: axis[key] for key in ("verdict", "error") if key in axis}}
            rows = list(axis.get("findings", ()))
            own = {finding.get("of") for finding in rows}
            for event in events.values():
                if name in event["axes"] and event["id"] not in own:  # an event of all axes together
                    estimate = {**event["estimate"], **event["axes"][name]["estimate"]}
                    gain = {"evidence_gain_nats": event["evidence_nats"], "net_nats": event["net_nats"]}
                    rows.append({"cause": event["cause"], "of": event["id"], "estimate": estimate, **gain})
            if not rows:
                yield head
            for finding in rows:
                event = events.get(finding.get("of"), {})
                of = {**head, "cause": finding["cause"], "of": finding.get("of"), "material": event.get("material")}
                of |= {key: finding.get(key) for key in ("evidence_gain_nats", "net_nats")}
                for key, value in finding["estimate"].items() or [("", "")]:
                    field = "value" if isinstance(value, str | list | tuple) else "median"
                    yield {**of, "key": key, **(value if isinstance(value, Mapping) else {field: value})}


class Comparison(Document):
    """`selfcal.compare/1`. By axis the list of its changes, or {"error": ..., "changes": [...]}; `verdicts` by
    recording and axis; `findings` of all recordings, each with its `recording`."""

    schema: str
    recordings: list[str]
    findings: list[Event]
    axes: dict[str, Any]
    verdicts: dict[str, dict[str, Any]]

    def _rows(self) -> Iterator[dict[str, Any]]:
        """Axis and each of its changes; of an axis that cannot be compared the reason."""
        for name, axis in self["axes"].items():
            if isinstance(axis, Mapping):
                yield {"axis": name, "error": axis["error"]}
            yield from ({"axis": name, **change} for change in (axis["changes"] if isinstance(axis, Mapping) else axis))
