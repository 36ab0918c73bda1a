"""The model file (YAML): hypotheses, priors, nodes and units; what every tool and the firmware assume."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import yaml

from selfcal import _library32
from selfcal.base import units
from selfcal.base.errors import UserError, short, short_value
from selfcal.base.grid import Array
from selfcal.base.limits import LEAST_RATE_HZ, MOST_MODEL_BYTES, MOST_MODEL_VALUES, MOST_RATE_HZ, read_text, reading
from selfcal.base.units import SENSORS
from selfcal.model.forms import FORMS, HOST_FORMS, INPUTS, NUMBER, POWER, Knots
from selfcal.model.laws import (
    DAMPING_LIMITS,
    FACTORS,
    KINDS,
    MOST_TERMS,
    NAMED,
    PARAMETERS,
    PLACES,
    RATIO_LIMITS,
    RATIOS,
    Law,
    Term,
)

SCHEMA = "selfcal.model/1"
DEFAULT = Path(__file__).parent / "models" / "default.yaml"
#: Model files of common parts, a file each; the default model is for the ADIS16405.
PARTS_FOLDER = DEFAULT.parent / "parts"
DEFAULT_PART = "adis16405"

#: Prior limits of parameters that no law of the file has: as in the default model at 1 Hz; and whether they multiply
#: the limits of N.
ABOUT_N = {"K": (0.02, 0.04, True), "sigma_m": (0.5, 1.0, True), "alpha": (2e-4, 0.2, False)}
#: Limits of the nodes of a grid dimension.
NODES: tuple[int, int] = (_library32.GRID_MIN, _library32.GRID_MAX)
#: Largest sd of a bias prior over the least N: a scatter below 1e-9 of its sd counts as none (lib/report_node.c).
WIDEST_BIAS = 1e8
#: Most characters of a name or another text.
LONGEST_TEXT = 200
#: Most axes of a model, and most taps of the sensor's filter: more than any part has.
MOST_AXES, MOST_TAPS = 64, 1024
#: Largest number of any kind: its square is still a float.
LARGEST = 1e18
#: Largest ln of a parameter that a prior may reach, as a float.
LN_LIMIT: float = _library32.LN_LIMIT
#: Smallest number but 0: what a prior may reach, to one digit.
SMALLEST = float(f"{math.exp(-LN_LIMIT):.0e}")
#: sd from the middle of a log-normal prior to its limits.
LOG_NORMAL_REACH: float = _library32.LOG_NORMAL_REACH
#: Limits of the sd of a log-normal prior: below, the limits of large logarithms are equal floats.
LOG_NORMAL_SD = (1e-4, 5.0)
#: Kinds of regressors, and the keys of an entry of each apart from name, kind, sd and probability.
REGRESSORS: dict[str, tuple[str, ...]] = {
    "time": ("reference",),
    "column": ("column", "unit", "reference", "window_s", "input", "form", "lag_s", "width", "delay_s", "knots"),
    "rate": ("column", "unit", "reference", "window_s"),
    "periodic": ("frequency_hz",),
    "step": ("time_s",),
    "turn_on": ("tau_s",),
    "pulse": ("start_s", "end_s"),
}
#: Most hypotheses of a model, in the host's library and on the wire.
MOST_HYPOTHESES: int = _library32.HYPOTHESES_MAX
#: Most columns of a bank's regressors together, and most that a model file may state.
MOST_BANK_COLUMNS, MOST_STATED = _library32.REGRESSORS_MAX, 36


@dataclass(frozen=True)
class Prior:
    """Prior of a parameter: `normal` (mean 0, `sd`), or `log_uniform` / `uniform` from `min` to `max`.

    `log_normal`: the logarithm is normal about the middle of its limits, which lie LOG_NORMAL_REACH `sd` away."""

    law: str
    min: float = math.nan
    max: float = math.nan
    sd: float = math.nan

    @staticmethod
    def log_normal(median: float, sd: float) -> Prior:
        """About a median; `sd` of the logarithm."""
        reach = math.exp(LOG_NORMAL_REACH * sd)
        return Prior("log_normal", median / reach, median * reach, sd)

    @property
    def median(self) -> float:
        """The middle of the limits in the logarithm."""
        return math.sqrt(self.min * self.max)

    @property
    def ln_sd(self) -> float:
        """sd of the logarithm; of a uniform prior as if it were log-uniform, as the library has it."""
        return self.sd if self.law == "log_normal" else math.log(self.max / self.min) / math.sqrt(12.0)

    def ln_density(self, ln_value: Array) -> Array:
        """ln of the density in ln(parameter) [m] between the limits."""
        if self.law == "log_normal":
            within = math.log(math.erf(LOG_NORMAL_REACH / math.sqrt(2.0)) * math.sqrt(2.0 * math.pi) * self.sd)
            return -0.5 * ((ln_value - math.log(self.median)) / self.sd) ** 2 - within
        if self.law == "log_uniform":
            return np.full(np.shape(ln_value), -math.log(math.log(self.max / self.min)))
        return ln_value - math.log(self.max - self.min)

    def at(self, u: float) -> float:
        """The value below which the prior has the probability `u`."""
        if self.law == "log_normal":
            below = NormalDist().cdf(-LOG_NORMAL_REACH)
            return self.median * math.exp(self.sd * NormalDist().inv_cdf(below + (1.0 - 2.0 * below) * u))
        if self.law == "log_uniform":
            return self.min * math.pow(self.max / self.min, u)
        return self.min + (self.max - self.min) * u


@dataclass(frozen=True)
class Group:
    """Axes of a kind: their unit, read-out and priors (keys bias, N, K, sigma_m, alpha, and B and the ratios if a
    hypothesis has them; units of `units.py`). `laws`: the model's, by the names of its hypotheses. `own_priors`: by
    axis, those that take the place of the group's."""

    name: str
    axes: tuple[str, ...]
    unit: str
    range: float
    lsb: float
    stuck_limit: int
    priors: Mapping[str, Prior]
    laws: Mapping[str, Law] = field(default_factory=lambda: NAMED)
    own_priors: Mapping[str, Mapping[str, Prior]] = field(default_factory=dict)


@dataclass(frozen=True)
class Regressor:
    """A known disturbance: its value times a constant coefficient is in every reading (values: `regressors.py`).

    `sd`: by group, the standard deviation of the coefficient's normal prior about 0, in the group's unit per `unit`; a
    group that is not there does not have this regressor. `reference`: the value at which x0 alone is the bias.
    `probability`: prior probability that the regressor is in use. `form` and its numbers: forms.py. `unit` is the
    column's, `channel_unit` that of the channel it is formed from.
    """

    name: str
    kind: str
    unit: str
    sd: Mapping[str, float]
    probability: float = 0.5
    reference: float = 0.0
    column: str = ""
    window_s: float = math.nan  # of a rate; of a column that is smoothed
    frequency_hz: float = math.nan
    time_s: float = math.nan
    tau_s: float = math.nan
    start_s: float = math.nan
    end_s: float = math.nan
    channel_unit: str = ""
    input: str = "value"
    form: str = "static"
    lag_s: float = math.nan
    width: float = math.nan
    delay_s: float = math.nan
    knots: Knots = ()

    @property
    def number(self) -> float:
        """The number of its form."""
        return float(getattr(self, NUMBER[self.form])) if self.form in NUMBER else math.nan

    @property
    def on_module(self) -> bool:
        """Whether `selfcal_form()` makes its columns."""
        return self.form not in HOST_FORMS and self.input == "value"

    @property
    def offset(self) -> float:
        """Value of the column at which x0 alone is the bias: powers are taken about the reference already, and a rate
        has none."""
        return 0.0 if self.form in POWER or self.form in ("rate", "free") else self.reference

    @property
    def mean_s(self) -> float:
        """Window of the channel's mean, s; 0 for none. A rate has its window for itself."""
        return 0.0 if math.isnan(self.window_s) or self.form == "rate" else self.window_s

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of its columns: a periodic regressor has a sine and a cosine."""
        return (f"{self.name}.sin", f"{self.name}.cos") if self.kind == "periodic" else (self.name,)


#: Least distance of an outlier, sd: below, too much of the noise itself would be kept out.
LEAST_OUTLIER_SD = 4.0


@dataclass(frozen=True)
class Gate:
    """The stationary gate's configuration (`selfcal_gate_config_t`); `N` by group, white noise density to start from,
    in the group's unit/sqrt(Hz). A group that is not there is left out of the gate."""

    window_s: float
    false_alarm: float
    hold: int
    settle: int
    memory: int
    N: Mapping[str, float]


@dataclass(frozen=True)
class Handling:
    """What the module handles by itself (`selfcal_handling_t`): samples `outlier_sd` standard deviations off are kept
    out (0: none), steps of the bias reopen it, changes of the noise are learned anew."""

    outlier_sd: float = 0.0
    steps: bool = False
    variance_changes: bool = False


#: Handling of a model that states none.
NOT_HANDLED = Handling()


#: Filter nodes of a target, by hypothesis: of rho, and of alpha or the ratio if the law has one.
GridNodes = Mapping[str, tuple[int, ...]]


@dataclass(frozen=True)
class HiddenInput:
    """A quantity that nobody recorded and that moves several axes, a Gauss-Markov process. Its standard deviation, its
    bandwidth `alpha`, 1/s, what a unit of it does to each axis, in the axis' unit, and the correlation of the white
    noise of pairs of axes (`gx-gy`). The bank of an axis knows nothing of it: its law is the axis' total."""

    deviation: float
    alpha: float
    loadings: Mapping[str, float]
    noise_correlation: Mapping[str, float]


@dataclass(frozen=True)
class Model:
    """A checked model file. `hypotheses` holds prior probabilities that sum to 1, `laws` the law of each; `simulate`
    the entry of that name, its `axes` and `effects` always. `beyond`: regressors that a bank has no column left for:
    `diagnose` alone takes them."""

    name: str
    path: Path
    bank_rate_hz: float
    sensor_name: str
    sensor_rate_hz: float
    filter_taps: int
    groups: tuple[Group, ...]
    hypotheses: Mapping[str, float]
    laws: Mapping[str, Law]
    nodes: Mapping[str, GridNodes]
    simulate: Mapping[str, Any]
    regressors: tuple[Regressor, ...] = ()
    beyond: tuple[Regressor, ...] = ()
    half_life_s: float = 0.0  # of what the bank remembers; 0: it forgets nothing
    gate: Gate | None = None
    handling: Handling = NOT_HANDLED
    hidden_input: HiddenInput | None = None

    @property
    def axes(self) -> tuple[str, ...]:
        """All axes, group by group: the order the library and the telemetry use."""
        return tuple(axis for group in self.groups for axis in group.axes)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Columns of a recording that may be axes: the usual axes, and the model's own."""
        return tuple(dict.fromkeys((*SENSORS, *self.axes)))

    @property
    def left_out(self) -> list[str]:
        """What a bank leaves out, in words."""
        names = ", ".join(regressor.name for regressor in self.beyond)
        said = f"a bank has {MOST_BANK_COLUMNS} columns, and leaves out {names}: `diagnose` alone takes them"
        beyond = [f"{self.path}: {said}"] if names else []
        if self.hidden_input is None:
            return beyond
        of_one = f"{self.path}: `hidden_input` is left out: a bank is of one axis, whose law has the whole drift"
        return [*beyond, of_one]

    def group_of(self, axis: str) -> Group:
        """The group of an axis, with its own priors. Raises UserError for an axis the model does not have."""
        for group in self.groups:
            if axis in group.axes:
                own = group.own_priors.get(axis)
                return replace(group, priors={**group.priors, **own}, own_priors={}) if own else group
        raise UserError(f"{self.path}: the model has no axis '{axis}' (it has {', '.join(self.axes)})")

    @staticmethod
    def load(path: Path | str | None = None) -> Model:
        """Read and check a model file, or that of a part by its name; None is the default model. Raises UserError
        naming the file and the entry."""
        file = file_of(path)
        return Model.of_tree(read_yaml(file, f"model file (a YAML mapping with schema: {SCHEMA})"), file)

    @staticmethod
    def of_tree(tree: Mapping[str, Any], path: Path) -> Model:
        """Check a tree that is read already, from the file `path`."""
        return _Reader(path).model(tree)


def with_room(regressors: Sequence[Regressor]) -> tuple[Regressor, ...]:
    """Regressors that a bank has columns for: in their order, each whole or not at all."""
    kept: list[Regressor] = []
    for regressor in regressors:
        if sum(len(other.columns) for other in (*kept, regressor)) <= MOST_BANK_COLUMNS:
            kept.append(regressor)
    return tuple(kept)


def parts() -> dict[str, Path]:
    """Model files of the parts that the package has, by name."""
    return dict(sorted({DEFAULT_PART: DEFAULT, **{path.stem: path for path in PARTS_FOLDER.glob("*.yaml")}}.items()))


def file_of(model: Path | str | None) -> Path:
    """The file of a model: a path, or the name of a part (without a folder or suffix) unless a file has that name."""
    if model is None:
        return DEFAULT
    path = Path(model)
    if path.suffix or path.name != str(model) or path.exists():
        return path
    known = parts()
    named = {re.sub(r"[^a-z0-9]", "", name): path for name, path in known.items()}
    file = named.get(re.sub(r"[^a-z0-9]", "", path.name.lower()))
    if file is None:
        raise UserError(f"there is no part '{short(path.name)}' (there are {', '.join(known)}), and no such model file")
    return file


class _Loader(yaml.SafeLoader):
    """Safe loading of plain values: a date is text, a key given twice or an unknown tag is refused.

    An alias counts as what it stands for, so that a few of them do not grow into millions of values.
    """

    yaml_implicit_resolvers = {  # noqa: RUF012 (PyYAML's own attribute)
        first: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        alias = self.check_event(yaml.AliasEvent)
        node = super().compose_node(parent, index)
        if node is None or id(node) in self._values:
            return node
        if alias:  # of a node that is not complete yet
            raise yaml.constructor.ConstructorError(None, None, "an alias stands for itself", node.start_mark)
        below = [node.value] if isinstance(node, yaml.ScalarNode) else node.value
        parts = [part for entry in below for part in (entry if isinstance(entry, tuple) else (entry,))]
        size = 1 + sum(1 if isinstance(part, str) else self._values[id(part)] for part in parts)
        if size > MOST_MODEL_VALUES:
            what = f"more than {MOST_MODEL_VALUES} values, aliases counted as often as they stand"
            raise yaml.constructor.ConstructorError(None, None, what, node.start_mark)
        self._values[id(node)] = size
        return node

    @cached_property
    def _values(self) -> dict[int, int]:
        """Values in each node, by its identity: the tree keeps all nodes alive."""
        return {}

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (ValueError, TypeError, KeyError) as error:  # of a number or a tag
            raise yaml.constructor.ConstructorError(None, None, "not valid YAML", node.start_mark) from error

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a name must be text", key_node.start_mark)
            key = key_node.value
            if key in seen:
                what = f"'{short(key)}' appears twice"
                raise yaml.constructor.ConstructorError(None, None, what, key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path, kind: str) -> dict[str, Any]:
    """The mapping of a YAML file of at most MOST_MODEL_BYTES. `kind`: a name for messages, remarks in brackets after
    it. Raises UserError, with the line if known."""
    plain = kind.split(" (")[0]
    try:
        text = read_text(path, MOST_MODEL_BYTES, "not a text file")
    except OSError as error:
        raise UserError(f"{path}: cannot read the {plain}: {error.strerror}") from error
    with reading(path, f"not a {plain}"):
        try:
            tree = yaml.load(text, Loader=_Loader)  # a safe loader
        except yaml.YAMLError as error:
            mark, what = None, "not valid YAML"
            if isinstance(error, yaml.MarkedYAMLError):
                mark = error.problem_mark
                if isinstance(error, yaml.constructor.ConstructorError) and error.context is None:
                    what = str(error.problem)  # of _Loader, or an unknown tag
            line = f"line {mark.line + 1}: " if mark is not None else ""
            tab = "; indent by spaces: YAML takes no tabs" if "'\\t'" in str(error) else ""
            raise UserError(f"{path}: {line}{what}{tab}") from error
    if not isinstance(tree, dict):
        raise UserError(f"{path}: not a {kind}")
    return tree


class _Reader:
    """Walks the YAML tree; every complaint carries the file and the dotted name of the entry."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def fail(self, where: str, what: str) -> UserError:
        return UserError(f"{self.path}: {where}: {what}" if where else f"{self.path}: {what}")

    def entry(self, tree: Mapping[str, Any], key: str, where: str) -> Any:
        if key not in tree:
            raise self.fail(where, f"'{key}' is missing")
        return tree[key]

    def only(self, tree: Any, allowed: tuple[str, ...], where: str) -> dict[str, Any]:
        if not isinstance(tree, dict):
            raise self.fail(where, "must be a mapping")
        for key in tree:
            if key not in allowed:
                raise self.fail(where, f"unknown entry '{short(str(key))}' (known: {', '.join(allowed)})")
        return tree

    def flag(self, tree: Mapping[str, Any], key: str, where: str) -> bool:
        value = tree.get(key, False)
        if not isinstance(value, bool):
            raise self.fail(f"{where}.{key}", f"must be true or false, not {short_value(value)}")
        return value

    def number(self, value: Any, where: str, *, low: float = 0.0, strict: bool = True) -> float:
        try:
            number = float(value)  # YAML reads 1e-3 without a dot as text
        except (TypeError, ValueError, OverflowError):
            raise self.fail(where, f"must be a number, not {short_value(value)}") from None
        if LARGEST < abs(number) < math.inf:
            raise self.fail(where, f"must be within +-{LARGEST:g}: the firmware computes in float")
        if 0.0 < abs(number) < SMALLEST:
            raise self.fail(where, f"must be 0, or {SMALLEST:.0e} and more: the firmware computes in float")
        if isinstance(value, bool) or not math.isfinite(number) or number < low or (strict and number == low):
            bound = "" if low == -math.inf else f" above {low:g}" if strict else f" of at least {low:g}"
            raise self.fail(where, f"must be a finite number{bound}, not {short_value(value)}")
        return number

    def within(self, value: Any, where: str, limits: tuple[float, float], unit: str = "") -> float:
        number, (low, high) = self.number(value, where), limits
        if not low <= number <= high:
            raise self.fail(where, f"must be {low:g} to {high:g}{unit}, not {number:g}")
        return number

    def rate(self, value: Any, where: str) -> float:
        return self.within(value, where, (LEAST_RATE_HZ, MOST_RATE_HZ), " Hz")

    def count(self, value: Any, where: str, low: int, high: int = np.iinfo(np.int32).max) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.fail(where, f"must be a whole number from {low} to {high}, not {short_value(value)}")
        return value

    def choice(self, value: Any, where: str, known: tuple[str, ...]) -> str:
        if value not in known:
            raise self.fail(where, f"unknown {short_value(value)} ({', '.join(known)})")
        return str(value)

    def text(self, tree: Mapping[str, Any], key: str, where: str) -> str:
        value = self.entry(tree, key, where)
        text = str(value)  # `unit: 1` is a number to YAML
        plain = isinstance(value, str | int | float) and not isinstance(value, bool)
        if not plain or not text.isprintable() or len(text) > LONGEST_TEXT or "*/" in text:
            what = f"one line of text, {LONGEST_TEXT} characters at most, without '*/': the tables have it as a comment"
            raise self.fail(f"{where}.{key}" if where else key, f"must be {what}, not {short_value(value)}")
        return text

    def unit(self, tree: Mapping[str, Any], where: str) -> str:
        unit = self.text(tree, "unit", where)
        try:
            return units.parse(units.plain(unit)).name
        except UserError as error:
            raise self.fail(f"{where}.unit", str(error)) from None

    def once(self, names: list[str], where: str, what: str) -> None:
        for name in names:
            if names.count(name) > 1:
                raise self.fail(where, f"{what}'{name}' appears twice")

    def by_group(self, tree: Any, where: str, groups: tuple[Group, ...]) -> dict[str, float]:
        numbers = self.only(tree, tuple(group.name for group in groups), where)
        if not numbers:
            raise self.fail(where, "must name at least one group")
        return {name: self.number(value, f"{where}.{name}") for name, value in numbers.items()}

    def prior(self, tree: Any, where: str, *, bias: bool) -> Prior:
        fields = self.only(tree, ("law", "min", "max", "median", "sd"), where)
        law = self.entry(fields, "law", where)
        if bias:
            if law != "normal":
                raise self.fail(where, "the bias prior must have law: normal")
            return Prior("normal", sd=self.number(self.entry(fields, "sd", where), f"{where}.sd"))
        if law == "log_normal":
            self.only(tree, ("law", "median", "sd"), where)
            median = self.number(self.entry(fields, "median", where), f"{where}.median")
            sd = self.within(self.entry(fields, "sd", where), f"{where}.sd", LOG_NORMAL_SD)
            prior = Prior.log_normal(median, sd)
        elif law in ("log_uniform", "uniform"):
            self.only(tree, ("law", "min", "max"), where)
            low = self.number(self.entry(fields, "min", where), f"{where}.min")
            prior = Prior(law, low, self.number(self.entry(fields, "max", where), f"{where}.max", low=low))
        else:
            raise self.fail(where, f"unknown law {short_value(law)} (log_uniform, uniform or log_normal)")
        low, high = prior.min, prior.max
        least, most = RATIO_LIMITS
        if where.rpartition(".")[2] in RATIOS and not (least <= low and high <= most):
            raise self.fail(where, f"must lie within {least:g} to {most:g}")
        if not -LN_LIMIT <= np.float32(math.log(low)) < np.float32(math.log(high)) <= LN_LIMIT:
            reach = f"{SMALLEST:.0e} to {math.exp(LN_LIMIT):.0e}"
            raise self.fail(where, f"min and max must differ, within {reach}, not {low!r} to {high!r}")
        return prior

    def group(self, name: str, tree: Any, laws: Mapping[str, Law]) -> Group:
        where = f"groups.{name}"
        fields = self.only(tree, ("axes", "unit", "range", "lsb", "stuck_limit", "priors", "own_priors"), where)
        axes = self.entry(fields, "axes", where)
        if not isinstance(axes, list) or not axes or not all(isinstance(axis, str) for axis in axes):
            raise self.fail(f"{where}.axes", "must be a list of axis names")
        if len(axes) > MOST_AXES:
            raise self.fail(f"{where}.axes", f"has {len(axes)} axes, {MOST_AXES} are the most")
        if not all(re.fullmatch(r"\w[\w.-]*", axis) and len(axis) <= LONGEST_TEXT for axis in axes):
            raise self.fail(f"{where}.axes", "a name is of letters, digits, '_', '.' and '-': the tables have it")
        of_laws = dict.fromkeys(("bias", "N", *(key for law in laws.values() for key in law.parameters)))
        names = dict.fromkeys(("bias", *PARAMETERS, *of_laws))
        priors = self.priors(self.entry(fields, "priors", where), f"{where}.priors", names, of_laws=of_laws)
        owns = fields.get("own_priors") or {}
        self.only(owns, tuple(axes), f"{where}.own_priors")
        return Group(
            name=name,
            axes=tuple(axes),
            unit=self.unit(fields, where),
            range=self.number(fields.get("range", 0.0), f"{where}.range", strict=False),
            lsb=self.number(fields.get("lsb", 0.0), f"{where}.lsb", strict=False),
            stuck_limit=self.count(fields.get("stuck_limit", 0), f"{where}.stuck_limit", 0),
            priors=priors,
            laws=laws,
            own_priors={
                axis: self.priors(own, f"{where}.own_priors.{axis}", names, priors) for axis, own in owns.items()
            },
        )

    def priors(
        self,
        tree: Any,
        where: str,
        names: Collection[str],
        group: Mapping[str, Prior] | None = None,
        of_laws: Collection[str] = (),
    ) -> dict[str, Prior]:
        """Priors of the parameters `names`; missing priors are the `group`'s, if given. Else those `of_laws` must be
        there, and another prior lies about N as in the default model."""
        trees = self.only(tree, ("bias", *PLACES), where)
        priors = dict(group or {})
        for key in names:
            if group is None and key not in trees and key not in of_laws:
                low, high, per_n = ABOUT_N[key]
                n = priors["N"]
                priors[key] = Prior("log_uniform", low * (n.min if per_n else 1.0), high * (n.max if per_n else 1.0))
            elif group is None or key in trees:
                priors[key] = self.prior(self.entry(trees, key, where), f"{where}.{key}", bias=key == "bias")
        if not priors["bias"].sd <= WIDEST_BIAS * priors["N"].min:
            most = f"{WIDEST_BIAS:.0e} times the least N"
            raise self.fail(f"{where}.bias.sd", f"must be at most {most}, not {priors['bias'].sd:g}")
        return priors

    def regressor(self, tree: Any, where: str, groups: tuple[Group, ...]) -> Regressor:
        if not isinstance(tree, dict):
            raise self.fail(where, "must be a mapping")
        kind = self.entry(tree, "kind", where)
        if not isinstance(kind, str) or kind not in REGRESSORS:
            raise self.fail(where, f"unknown kind {short_value(kind)} ({', '.join(REGRESSORS)})")
        fields = self.only(tree, ("name", "kind", "sd", "probability", *REGRESSORS[kind]), where)
        shapes = dict.fromkeys(("periodic", "step", "turn_on", "pulse"), "1")
        unit = {"time": "s", **shapes}.get(kind) or self.unit(fields, where)
        chosen: dict[str, Any] = {
            key: self.choice(fields.get(key, known[0]), f"{where}.{key}", known)
            for key, known in (("input", INPUTS), ("form", FORMS))
        }
        for form, key in NUMBER.items():
            if key != "window_s" and key in fields and chosen["form"] != form:
                raise self.fail(f"{where}.{key}", f"goes with form: {form} alone")
        if ("knots" in fields) != (chosen["form"] == "free"):
            raise self.fail(f"{where}.knots", "goes with form: free, and form: free with knots")
        probability = self.number(fields.get("probability", 0.5), f"{where}.probability")
        if probability >= 1.0:
            raise self.fail(f"{where}.probability", f"must be below 1, not {probability:g}")
        needed: dict[str, Any] = {
            key: self.number(self.entry(fields, key, where), f"{where}.{key}")
            for key in ("window_s", "frequency_hz", "time_s", "tau_s", "start_s", "end_s", "lag_s", "width", "delay_s")
            if key in REGRESSORS[kind] and (kind != "column" or key in fields or key == NUMBER.get(chosen["form"]))
        }
        if kind == "pulse" and not needed["end_s"] > needed["start_s"]:
            raise self.fail(f"{where}.end_s", "must be later than start_s")
        power = POWER.get(chosen["form"], 1) * (2 if chosen["input"] == "variance" else 1)
        return Regressor(
            name=self.text(fields, "name", where),
            kind=kind,
            unit="1"
            if chosen["form"] == "free"
            else units.power(unit, power) + ("/s" if "rate" in (kind, chosen["form"]) else ""),
            channel_unit=unit,
            sd=self.by_group(self.entry(fields, "sd", where), f"{where}.sd", groups),
            probability=probability,
            reference=self.number(fields.get("reference", 0.0), f"{where}.reference", low=-math.inf, strict=False),
            column=self.text(fields, "column", where) if "column" in REGRESSORS[kind] else "",
            knots=self.knots(fields["knots"], f"{where}.knots") if "knots" in fields else (),
            **chosen,
            **needed,
        )

    def knots(self, tree: Any, where: str) -> Knots:
        """The curve of a form: free."""
        if not isinstance(tree, list) or len(tree) < 2:
            raise self.fail(where, "must be a list of two pairs [channel, height] or more")
        knots: list[tuple[float, float]] = []
        for i, pair in enumerate(tree):
            if not isinstance(pair, list) or len(pair) != 2:
                raise self.fail(f"{where}[{i}]", f"must be a pair [channel, height], not {short_value(pair)}")
            channel, height = (self.number(x, f"{where}[{i}]", low=-math.inf, strict=False) for x in pair)
            if knots and not channel > knots[-1][0]:
                raise self.fail(f"{where}[{i}]", "the channel's values must rise")
            knots.append((channel, height))
        return tuple(knots)

    def regressors(self, tree: Any, groups: tuple[Group, ...]) -> tuple[Regressor, ...]:
        if not isinstance(tree, list):
            raise self.fail("regressors", "must be a list")
        if len(tree) > MOST_STATED:
            raise self.fail("regressors", f"{len(tree)} are more than {MOST_STATED}")
        regressors = tuple(self.regressor(entry, f"regressors[{i}]", groups) for i, entry in enumerate(tree))
        self.once([regressor.name for regressor in regressors], "regressors", "")
        columns = sum(len(regressor.columns) for regressor in regressors)
        if columns > MOST_STATED:
            raise self.fail("regressors", f"{columns} columns are more than {MOST_STATED} (periodic: two each)")
        return regressors

    def gate(self, tree: Any, groups: tuple[Group, ...]) -> Gate:
        names = ("window_s", "false_alarm", "hold", "settle", "memory", "N")
        fields = {name: self.entry(self.only(tree, names, "gate"), name, "gate") for name in names}
        false_alarm = self.number(fields["false_alarm"], "gate.false_alarm", strict=False)
        if false_alarm > 0.1:
            raise self.fail("gate.false_alarm", f"must be 0.1 at most, not {false_alarm:g}")
        return Gate(
            window_s=self.number(fields["window_s"], "gate.window_s"),
            false_alarm=false_alarm,
            hold=self.count(fields["hold"], "gate.hold", 1),
            settle=self.count(fields["settle"], "gate.settle", 0),
            memory=self.count(fields["memory"], "gate.memory", 1),
            N=self.by_group(fields["N"], "gate.N", groups),
        )

    def handling(self, tree: Any, regressors: bool) -> Handling:
        fields = self.only(tree, ("outlier_sd", "steps", "variance_changes"), "handle")
        outlier_sd = self.number(fields.get("outlier_sd", 0.0), "handle.outlier_sd", strict=False)
        if 0.0 < outlier_sd < LEAST_OUTLIER_SD:
            raise self.fail("handle.outlier_sd", f"must be 0 or at least {LEAST_OUTLIER_SD:g}, not {outlier_sd:g}")
        chosen = {name: self.flag(fields, name, "handle") for name in ("steps", "variance_changes")}
        for name in chosen:
            if chosen[name] and regressors:
                raise self.fail(f"handle.{name}", "does not go with regressors: leave one of them out")
        return Handling(outlier_sd, **chosen)

    def nodes(self, tree: Any, where: str, laws: Mapping[str, Law]) -> GridNodes:
        fields = self.only(tree, tuple(dict.fromkeys((*NAMED, *laws))), where)
        of_laws: dict[str, tuple[int, ...]] = {}
        for name, law in laws.items():
            what = [f"{key} nodes" for key in ("rho", *law.parameters[2:])] if law.terms else []
            if not what:
                continue
            given = self.entry(fields, name, where)
            counts = given if isinstance(given, list) else [given]
            if len(counts) != len(what) or isinstance(given, list) != (len(what) > 1):
                shape = f"[{', '.join(what)}]" if len(what) > 1 else f"a number of {what[0]}"
                raise self.fail(f"{where}.{name}", f"must be {shape}")
            of_laws[name] = tuple(self.count(count, f"{where}.{name}", *NODES) for count in counts)
        return of_laws

    def term(self, tree: Any, where: str) -> Term:
        fields = {"kind": tree} if isinstance(tree, str) else tree
        name = fields.get("kind") if isinstance(fields, dict) else None
        if name not in KINDS:
            plain, more = ([key for key, kind in KINDS.items() if kind.needs_time == needs] for needs in (False, True))
            kinds = f"{', '.join(plain)}, or a mapping with one of these or {', '.join(more)} as kind"
            raise self.fail(where, f"must be {kinds}, not {short_value(tree)}")
        kind = KINDS[name]
        self.only(fields, ("kind", "deviation", *kind.keys), where)
        stated = kind.needs_time or kind.time in fields
        if stated and "bandwidth" in fields:
            raise self.fail(where, f"states bandwidth (times alpha) or {kind.time}, not both")
        by_ratio = fields.get("deviation") == "ratio"
        if by_ratio and not kind.time:
            raise self.fail(f"{where}.deviation", f"of a {name} must be a number")
        damping = 0.0
        if "damping" in kind.keys:
            damping = self.within(self.entry(fields, "damping", where), f"{where}.damping", DAMPING_LIMITS)
        time_s = self.number(self.entry(fields, kind.time, where), f"{where}.{kind.time}") if stated else kind.turn
        numbers = {
            key: self.within(fields.get(key, 1.0), f"{where}.{key}", FACTORS)
            for key in ("deviation", "bandwidth")
            if not (key == "deviation" and by_ratio)
        }
        bandwidth = kind.turn / time_s if stated else numbers["bandwidth"]
        return Term(name, numbers.get("deviation", 1.0), bandwidth, stated, by_ratio, damping)

    def law(self, tree: Any, where: str) -> Law:
        terms = self.entry(tree, "terms", where)
        coloured = self.flag(tree, "coloured_noise", where)
        if not isinstance(terms, list):
            raise self.fail(f"{where}.terms", f"must be a list of terms, not {short_value(terms)}")
        most = MOST_TERMS - (1 if coloured else 0)
        law = Law(tuple(self.term(entry, f"{where}.terms[{i}]") for i, entry in enumerate(terms)), coloured)
        if len(law.read) > most:
            counts = dict.fromkeys(f", {remark}" for term in law.terms if (remark := KINDS[term.kind].counts))
            beside = " beside coloured noise" * coloured + "".join(counts)
            raise self.fail(f"{where}.terms", f"has {len(law.read)}, {most} are the most{beside}")
        by_ratio = sum(term.by_ratio for term in law.terms)
        if coloured and not terms:
            raise self.fail(where, "coloured noise needs a drift: give at least one term")
        if by_ratio and by_ratio == len(terms):
            raise self.fail(where, "a ratio needs a term without one: the drift parameter is that term's")
        if (coloured + (by_ratio > 0) + law.has_alpha) > 1:
            what = "alpha (a bandwidth that is not stated), a ratio, and coloured noise"
            raise self.fail(where, f"has more than one of {what}: a law has one second parameter")
        return law

    def hypotheses(self, tree: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, Law]]:
        """Prior odds and law of each, named laws in their own order first."""
        odds = self.entry(tree, "hypotheses", "")
        if not isinstance(odds, dict) or not odds:
            raise self.fail("hypotheses", f"must name at least one of {', '.join(NAMED)}, or state a law by its terms")
        if len(odds) > MOST_HYPOTHESES:
            raise self.fail("hypotheses", f"{len(odds)} are more than {MOST_HYPOTHESES}")
        weights: dict[str, float] = {}
        laws: dict[str, Law] = {}
        for name in (*(name for name in NAMED if name in odds), *(name for name in odds if name not in NAMED)):
            where, entry = f"hypotheses.{name}", odds[name]
            if name in NAMED:
                weights[name], laws[name] = self.number(entry, where), NAMED[name]
                continue
            if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w{0,31}", name, re.ASCII):
                raise self.fail("hypotheses", f"{short_value(name)}: a name is of letters, digits and '_', 32 at most")
            if not isinstance(entry, dict):
                known = ", ".join(NAMED)
                raise self.fail(where, f"is no named law ({known}): state its probability and its terms")
            self.only(entry, ("probability", "terms", "coloured_noise"), where)
            weights[name] = self.number(entry.get("probability", 1.0), f"{where}.probability")
            laws[name] = self.law(entry, where)
        if "walk_and_markov" in laws:
            time_s = self.number(self.entry(tree, "correlation_time_s", ""), "correlation_time_s")
            laws["walk_and_markov"] = laws["walk_and_markov"].with_time(time_s)
        return weights, laws

    def simulate(self, tree: Any, axes: Collection[str], laws: Mapping[str, Law]) -> dict[str, Any]:
        fields = dict(self.only(tree, ("rate_hz", "duration_s", "axes", "effects"), "simulate"))
        if "rate_hz" in fields:
            fields["rate_hz"] = self.rate(fields["rate_hz"], "simulate.rate_hz")
        if "duration_s" in fields:
            fields["duration_s"] = self.number(fields["duration_s"], "simulate.duration_s")
        texts = fields.get("effects") or []
        if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
            raise self.fail("simulate.effects", "must be a list of texts ID[:key=value,...]")
        stated = fields.get("axes") or {}
        if not isinstance(stated, dict):
            raise self.fail("simulate.axes", "must be a mapping of axes")
        for name in stated:
            if name not in axes:
                raise self.fail(
                    "simulate.axes", f"the model has no axis {short_value(name)} (it has {', '.join(axes)})"
                )
        known = ("hypothesis", "bias", *PLACES)
        known_laws = dict.fromkeys((*NAMED, *laws))
        truths = {name: dict(self.only(truth or {}, known, f"simulate.axes.{name}")) for name, truth in stated.items()}
        for name, truth in truths.items():
            where = f"simulate.axes.{name}"
            law = truth.get("hypothesis", "constant")
            if not isinstance(law, str) or law not in known_laws:
                raise self.fail(f"{where}.hypothesis", f"unknown {short_value(law)} (known: {', '.join(known_laws)})")
            for key in truth.keys() - {"hypothesis"}:
                truth[key] = self.number(truth[key], f"{where}.{key}", low=-math.inf if key == "bias" else 0.0)
        return {**fields, "axes": truths, "effects": texts}

    def hidden_input(self, tree: Any, axes: Collection[str]) -> HiddenInput:
        fields = self.only(tree, ("law", "loadings", "noise_correlation"), "hidden_input")
        law = self.entry(fields, "law", "hidden_input")
        if not isinstance(law, list) or len(law) != 1:
            raise self.fail("hidden_input.law", "must be a list of one term: kind: markov, deviation, alpha")
        term = self.only(law[0], ("kind", "deviation", "alpha"), "hidden_input.law")
        if term.get("kind") != "markov":
            raise self.fail("hidden_input.law", f"the kind must be markov, not {short_value(term.get('kind'))}")
        deviation, alpha = (
            self.number(self.entry(term, key, "hidden_input.law"), f"hidden_input.law.{key}")
            for key in ("deviation", "alpha")
        )
        numbers = []
        for key, low in (("loadings", -math.inf), ("noise_correlation", -1.0)):
            entries = fields.get(key) or {}
            if not isinstance(entries, dict):
                raise self.fail(f"hidden_input.{key}", "must be a mapping")
            for name in entries:
                if not all(axis in axes for axis in str(name).split("-")):
                    raise self.fail(f"hidden_input.{key}", f"the model has no axis {short_value(name)}")
            numbers.append(
                {name: self.number(value, f"hidden_input.{key}.{name}", low=low) for name, value in entries.items()}
            )
        return HiddenInput(deviation, alpha, *numbers)

    def model(self, raw: Mapping[str, Any]) -> Model:
        needed = ("schema", "name", "bank_rate_hz", "sensor", "groups", "hypotheses", "nodes", "simulate")
        if raw.get("schema") != SCHEMA:
            raise self.fail("schema", f"must be {SCHEMA}, not {short_value(raw.get('schema'))}")
        more = ("regressors", "half_life_s", "gate", "handle", "correlation_time_s", "hidden_input")
        tree = self.only(raw, (*needed, *more), "")
        name = self.text(tree, "name", "")
        sensor = self.only(self.entry(tree, "sensor", ""), ("name", "rate_hz", "filter_taps"), "sensor")
        weights, laws = self.hypotheses(tree)
        groups_tree = self.entry(tree, "groups", "")
        if not isinstance(groups_tree, dict) or not groups_tree:
            raise self.fail("groups", "must be a mapping of at least one group")
        for key in groups_tree:
            if not isinstance(key, str) or not key.isprintable() or len(key) > LONGEST_TEXT:
                raise self.fail("groups", f"a group's name must be text, not {short_value(key)}")
        groups = tuple(self.group(name, fields, laws) for name, fields in groups_tree.items())
        regressors = self.regressors(tree.get("regressors") or [], groups)
        kept = with_room(regressors)
        axes = [axis for group in groups for axis in group.axes]
        if len(axes) > MOST_AXES:
            raise self.fail("groups", f"have {len(axes)} axes, {MOST_AXES} are the most")
        self.once(axes, "groups", "axis ")
        targets = self.entry(tree, "nodes", "")
        if not isinstance(targets, dict) or "host" not in targets:
            raise self.fail("nodes", "must be a mapping of targets, 'host' among them")
        return Model(
            name=name,
            path=self.path,
            bank_rate_hz=self.rate(self.entry(tree, "bank_rate_hz", ""), "bank_rate_hz"),
            sensor_name=self.text({"name": "", **sensor}, "name", "sensor"),
            sensor_rate_hz=self.rate(self.entry(sensor, "rate_hz", "sensor"), "sensor.rate_hz"),
            filter_taps=self.count(sensor.get("filter_taps", 1), "sensor.filter_taps", 1, MOST_TAPS),
            groups=groups,
            hypotheses={law: weight / sum(weights.values()) for law, weight in weights.items()},
            laws=laws,
            nodes={name: self.nodes(fields, f"nodes.{name}", laws) for name, fields in targets.items()},
            simulate=self.simulate(tree.get("simulate") or {}, axes, laws),
            regressors=kept,
            beyond=tuple(regressor for regressor in regressors if regressor not in kept),
            half_life_s=self.number(tree.get("half_life_s", 0.0), "half_life_s", strict=False),
            gate=self.gate(tree["gate"], groups) if tree.get("gate") else None,
            hidden_input=self.hidden_input(tree["hidden_input"], axes) if tree.get("hidden_input") else None,
            handling=self.handling({} if tree.get("handle") is None else tree["handle"], bool(tree.get("regressors"))),
        )


def settings_of(model: Model) -> str:
    """The model without the place of its file."""
    return repr(replace(model, path=Path(), name=""))
