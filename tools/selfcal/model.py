"""The model file (YAML): hypotheses, priors, nodes and units; what every tool and the firmware assume."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from selfcal import units
from selfcal.errors import UserError, short, shown
from selfcal.limits import LEAST_RATE_HZ, MOST_MODEL_BYTES, MOST_MODEL_VALUES, MOST_RATE_HZ, read_text, reading

SCHEMA = "selfcal.model/1"
DEFAULT = Path(__file__).parent / "models" / "default.yaml"

#: Hypothesis names in the order of `selfcal_law_t` (lib/selfcal.h), with the parameters of each.
LAWS: dict[str, tuple[str, ...]] = {
    "constant": ("N",),
    "random_walk": ("N", "K"),
    "gauss_markov": ("N", "sigma_m", "alpha"),
    "flicker": ("N", "B", "alpha"),
    "moving_average": ("N", "K", "spectral_ratio"),
    "walk_and_markov": ("N", "K", "markov_ratio"),
}
#: Those that are sums of several terms: SELFCAL_TERMS_MAX of 3.
SUMS = ("flicker", "moving_average", "walk_and_markov")
#: The others: the paper's.
PLAIN = tuple(law for law in LAWS if law not in SUMS)
#: Nodes a grid dimension may have: a quintic spline needs six; SELFCAL_GRID_MAX.
NODES = (6, 24)
#: Parameter names in the order of `selfcal_parameter_t`.
PARAMETERS = ("N", "K", "sigma_m", "alpha")
#: Parameters without a unit, and their limits: beyond, 1 + theta or 1 - theta is no longer a float.
RATIOS = ("spectral_ratio", "markov_ratio")
RATIO_LIMITS = (1e-3, 1e3)
#: Times the least N that a bias prior may be wide: a scatter below 1e-9 of its sd counts as none (lib/posterior.c).
WIDEST_BIAS = 1e8
#: Characters of a name or another text.
LONGEST_TEXT = 200
#: Axes of a model, and taps of the sensor's filter: more than any part has.
MOST_AXES, MOST_TAPS = 64, 1024
#: The largest number of any kind: its square is still a float.
LARGEST = 1e18
#: The smallest but 0: below what any prior may reach.
SMALLEST = 1e-20
#: ln of what a prior may reach, as a float: LN_LIMIT in lib/bank.c.
LN_LIMIT = 46.0
#: Place of each parameter there; two share one where no law has both.
PLACES = {"N": 0, "K": 1, "sigma_m": 2, "B": 2, "alpha": 3, "spectral_ratio": 3, "markov_ratio": 3}
#: Kinds of regressors, and what an entry of each has beside name, kind, sd and probability.
REGRESSORS: dict[str, tuple[str, ...]] = {
    "time": ("reference",),
    "column": ("column", "unit", "reference", "window_s"),
    "rate": ("column", "unit", "reference", "window_s"),
    "periodic": ("frequency_hz",),
    "step": ("time_s",),
}
#: Columns of all regressors together: SELFCAL_REGRESSORS_MAX.
MOST_COLUMNS = 6


@dataclass(frozen=True)
class Prior:
    """Prior of one parameter: `normal` (mean 0, `sd`), or `log_uniform` / `uniform` from `min` to `max`."""

    law: str
    min: float = math.nan
    max: float = math.nan
    sd: float = math.nan


@dataclass(frozen=True)
class Group:
    """Axes of one kind: their unit, read-out and priors (keys bias, N, K, sigma_m, alpha, and B and the ratios if a
    hypothesis has them; units of `units.py`). `correlation_time_s`: the model's, of walk_and_markov."""

    name: str
    axes: tuple[str, ...]
    unit: str
    range: float
    lsb: float
    stuck_limit: int
    priors: Mapping[str, Prior]
    correlation_time_s: float = math.nan


@dataclass(frozen=True)
class Regressor:
    """A known disturbance: its value times a constant coefficient is in every reading (values: `regressors.py`).

    `sd`: by group, the standard deviation of the coefficient's normal prior about 0, in the group's unit per `unit`; a
    group that is not there does not have this regressor. `reference`: the value at which x0 alone is the bias.
    `probability`: prior one that the regressor is in use.
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

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of its columns: a periodic one has a sine and a cosine."""
        return (f"{self.name}.sin", f"{self.name}.cos") if self.kind == "periodic" else (self.name,)


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
class GridNodes:
    """Filter nodes of one target: random walk (rho) and by law (rho, alpha or a ratio)."""

    random_walk: int
    pairs: Mapping[str, tuple[int, int]]


@dataclass(frozen=True)
class Model:
    """A checked model file. `hypotheses` holds prior probabilities that sum to 1."""

    name: str
    path: Path
    bank_rate_hz: float
    sensor_name: str
    sensor_rate_hz: float
    filter_taps: int
    groups: tuple[Group, ...]
    hypotheses: Mapping[str, float]
    nodes: Mapping[str, GridNodes]
    simulate: Mapping[str, Any]
    regressors: tuple[Regressor, ...] = ()
    half_life_s: float = 0.0  # of what the bank remembers; 0: it forgets nothing
    gate: Gate | None = None

    @property
    def axes(self) -> tuple[str, ...]:
        """All axes, group by group: the order the library and the telemetry use."""
        return tuple(axis for group in self.groups for axis in group.axes)

    def group_of(self, axis: str) -> Group:
        """The group an axis belongs to. Raises UserError for an axis the model does not have."""
        for group in self.groups:
            if axis in group.axes:
                return group
        raise UserError(f"{self.path}: the model has no axis '{axis}' (it has {', '.join(self.axes)})")

    @staticmethod
    def load(path: Path | str | None = None) -> Model:
        """Read and check a model file; None is the default model. Raises UserError naming the file and the entry."""
        return _Reader(DEFAULT if path is None else Path(path)).model()


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


class _Reader:
    """Walks the YAML tree; every complaint carries the file and the dotted name of the entry."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def fail(self, where: str, what: str) -> UserError:
        return UserError(f"{self.path}: {where}: {what}" if where else f"{self.path}: {what}")

    def tree(self) -> dict[str, Any]:
        try:
            text = read_text(self.path, MOST_MODEL_BYTES, "not a text file")
        except OSError as error:
            raise UserError(f"{self.path}: cannot read the model file: {error.strerror}") from error
        with reading(self.path, "not a model file"):
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
                raise UserError(f"{self.path}: {line}{what}{tab}") from error
        if not isinstance(tree, dict):
            raise UserError(f"{self.path}: not a model file (a YAML mapping with schema: {SCHEMA})")
        return tree

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

    def number(self, value: Any, where: str, *, low: float = 0.0, strict: bool = True) -> float:
        try:
            number = float(value)  # YAML reads 1e-3 without a dot as text
        except (TypeError, ValueError, OverflowError):
            raise self.fail(where, f"must be a number, not {shown(value)}") from None
        if LARGEST < abs(number) < math.inf:
            raise self.fail(where, f"must be within +-{LARGEST:g}: the firmware computes in float")
        if 0.0 < abs(number) < SMALLEST:
            raise self.fail(where, f"must be 0, or {SMALLEST:g} and more: the firmware computes in float")
        if isinstance(value, bool) or not math.isfinite(number) or number < low or (strict and number == low):
            bound = "" if low == -math.inf else f" above {low:g}" if strict else f" of at least {low:g}"
            raise self.fail(where, f"must be a finite number{bound}, not {shown(value)}")
        return number

    def rate(self, value: Any, where: str) -> float:
        rate = self.number(value, where)
        if not LEAST_RATE_HZ <= rate <= MOST_RATE_HZ:
            raise self.fail(where, f"must be {LEAST_RATE_HZ:g} to {MOST_RATE_HZ:g} Hz, not {rate:g}")
        return rate

    def count(self, value: Any, where: str, low: int, high: int = 2**31 - 1) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.fail(where, f"must be a whole number from {low} to {high}, not {shown(value)}")
        return value

    def text(self, tree: Mapping[str, Any], key: str, where: str) -> str:
        value = self.entry(tree, key, where)
        text = str(value)  # `unit: 1` is a number to YAML
        known = isinstance(value, str | int | float) and not isinstance(value, bool)
        if not known or not text.isprintable() or len(text) > LONGEST_TEXT or "*/" in text:
            what = f"one line of text, {LONGEST_TEXT} characters at most, without '*/': the tables have it as a comment"
            raise self.fail(f"{where}.{key}" if where else key, f"must be {what}, not {shown(value)}")
        return text

    def unit(self, tree: Mapping[str, Any], where: str) -> str:
        unit = self.text(tree, "unit", where)
        try:
            return units.parse(units.plain(unit)).name
        except UserError as error:
            raise self.fail(f"{where}.unit", str(error)) from None

    def prior(self, tree: Any, where: str, *, bias: bool) -> Prior:
        fields = self.only(tree, ("law", "min", "max", "sd"), where)
        law = self.entry(fields, "law", where)
        if bias:
            if law != "normal":
                raise self.fail(where, "the bias prior must have law: normal")
            return Prior("normal", sd=self.number(self.entry(fields, "sd", where), f"{where}.sd"))
        if law not in ("log_uniform", "uniform"):
            raise self.fail(where, f"unknown law {shown(law)} (log_uniform or uniform)")
        low = self.number(self.entry(fields, "min", where), f"{where}.min")
        high = self.number(self.entry(fields, "max", where), f"{where}.max", low=low)
        least, most = RATIO_LIMITS
        if where.rpartition(".")[2] in RATIOS and not (least <= low and high <= most):
            raise self.fail(where, f"must lie within {least:g} to {most:g}")
        if not -LN_LIMIT <= np.float32(math.log(low)) < np.float32(math.log(high)) <= LN_LIMIT:
            reach = f"{math.exp(-LN_LIMIT):.0e} to {math.exp(LN_LIMIT):.0e}"
            raise self.fail(where, f"min and max must differ, within {reach}, not {low!r} to {high!r}")
        return Prior(law, min=low, max=high)

    def group(self, name: str, tree: Any, laws: Collection[str], correlation_time_s: float) -> Group:
        where = f"groups.{name}"
        fields = self.only(tree, ("axes", "unit", "range", "lsb", "stuck_limit", "priors"), where)
        axes = self.entry(fields, "axes", where)
        if not isinstance(axes, list) or not axes or not all(isinstance(axis, str) for axis in axes):
            raise self.fail(f"{where}.axes", "must be a list of axis names")
        if len(axes) > MOST_AXES:
            raise self.fail(f"{where}.axes", f"has {len(axes)} axes, {MOST_AXES} are the most")
        if not all(re.fullmatch(r"\w[\w.-]*", axis) and len(axis) <= LONGEST_TEXT for axis in axes):
            raise self.fail(f"{where}.axes", "a name is of letters, digits, '_', '.' and '-': the tables have it")
        names = ("bias", *PARAMETERS, *(name for law in laws for name in LAWS[law] if name not in PARAMETERS))
        known = ("bias", *PLACES)
        trees = self.only(self.entry(fields, "priors", where), known, f"{where}.priors")
        priors = {
            key: self.prior(self.entry(trees, key, f"{where}.priors"), f"{where}.priors.{key}", bias=key == "bias")
            for key in names
        }
        if not priors["bias"].sd <= WIDEST_BIAS * priors["N"].min:
            most = f"{WIDEST_BIAS:.0e} times the least N"
            raise self.fail(f"{where}.priors.bias.sd", f"must be at most {most}, not {priors['bias'].sd:g}")
        return Group(
            name=name,
            axes=tuple(axes),
            unit=self.unit(fields, where),
            range=self.number(fields.get("range", 0.0), f"{where}.range", strict=False),
            lsb=self.number(fields.get("lsb", 0.0), f"{where}.lsb", strict=False),
            stuck_limit=self.count(fields.get("stuck_limit", 0), f"{where}.stuck_limit", 0),
            priors=priors,
            correlation_time_s=correlation_time_s,
        )

    def regressor(self, tree: Any, where: str, groups: tuple[Group, ...]) -> Regressor:
        if not isinstance(tree, dict):
            raise self.fail(where, "must be a mapping")
        kind = self.entry(tree, "kind", where)
        if not isinstance(kind, str) or kind not in REGRESSORS:
            raise self.fail(where, f"unknown kind {shown(kind)} ({', '.join(REGRESSORS)})")
        fields = self.only(tree, ("name", "kind", "sd", "probability", *REGRESSORS[kind]), where)
        unit = {"time": "s", "periodic": "1", "step": "1"}.get(kind) or self.unit(fields, where)
        priors = self.only(self.entry(fields, "sd", where), tuple(group.name for group in groups), f"{where}.sd")
        if not priors:
            raise self.fail(f"{where}.sd", "must name at least one group")
        probability = self.number(fields.get("probability", 0.5), f"{where}.probability")
        if probability >= 1.0:
            raise self.fail(f"{where}.probability", f"must be below 1, not {probability:g}")
        needed = {
            key: self.number(self.entry(fields, key, where), f"{where}.{key}")
            for key in ("window_s", "frequency_hz", "time_s")
            if key in REGRESSORS[kind] and (kind != "column" or key in fields)
        }
        return Regressor(
            name=self.text(fields, "name", where),
            kind=kind,
            unit=f"{unit}/s" if kind == "rate" else unit,
            sd={name: self.number(value, f"{where}.sd.{name}") for name, value in priors.items()},
            probability=probability,
            reference=self.number(fields.get("reference", 0.0), f"{where}.reference", low=-math.inf, strict=False),
            column=self.text(fields, "column", where) if "column" in REGRESSORS[kind] else "",
            **needed,
        )

    def regressors(self, tree: Any, groups: tuple[Group, ...]) -> tuple[Regressor, ...]:
        if not isinstance(tree, list):
            raise self.fail("regressors", "must be a list")
        if len(tree) > MOST_COLUMNS:
            raise self.fail("regressors", f"{len(tree)} are more than {MOST_COLUMNS}")
        found = tuple(self.regressor(one, f"regressors[{i}]", groups) for i, one in enumerate(tree))
        names = [regressor.name for regressor in found]
        for name in names:
            if names.count(name) > 1:
                raise self.fail("regressors", f"'{name}' appears twice")
        columns = sum(len(regressor.columns) for regressor in found)
        if columns > MOST_COLUMNS:
            raise self.fail("regressors", f"{columns} columns are more than {MOST_COLUMNS} (periodic: two each)")
        return found

    def gate(self, tree: Any, groups: tuple[Group, ...]) -> Gate:
        names = ("window_s", "false_alarm", "hold", "settle", "memory", "N")
        fields = self.only(tree, names, "gate")
        for name in names:
            self.entry(fields, name, "gate")
        false_alarm = self.number(fields["false_alarm"], "gate.false_alarm", strict=False)
        if false_alarm > 0.1:
            raise self.fail("gate.false_alarm", f"must be 0.1 at most, not {false_alarm:g}")
        noise = self.only(fields["N"], tuple(group.name for group in groups), "gate.N")
        if not noise:
            raise self.fail("gate.N", "must name at least one group")
        return Gate(
            window_s=self.number(fields["window_s"], "gate.window_s"),
            false_alarm=false_alarm,
            hold=self.count(fields["hold"], "gate.hold", 1),
            settle=self.count(fields["settle"], "gate.settle", 0),
            memory=self.count(fields["memory"], "gate.memory", 1),
            N={name: self.number(value, f"gate.N.{name}") for name, value in noise.items()},
        )

    def nodes(self, tree: Any, where: str, laws: Collection[str]) -> GridNodes:
        known = ("gauss_markov", *SUMS)
        fields = self.only(tree, ("random_walk", *known), where)
        pairs = {}
        for law in known:
            if law != "gauss_markov" and law not in laws:
                continue
            pair = self.entry(fields, law, where)
            if not isinstance(pair, list) or len(pair) != 2:
                raise self.fail(f"{where}.{law}", f"must be [rho nodes, {LAWS[law][2]} nodes]")
            pairs[law] = (
                self.count(pair[0], f"{where}.{law}", *NODES),
                self.count(pair[1], f"{where}.{law}", *NODES),
            )
        return GridNodes(self.count(self.entry(fields, "random_walk", where), f"{where}.random_walk", *NODES), pairs)

    def model(self) -> Model:
        needed = ("schema", "name", "bank_rate_hz", "sensor", "groups", "hypotheses", "nodes", "simulate")
        raw = self.tree()
        if raw.get("schema") != SCHEMA:
            raise self.fail("schema", f"must be {SCHEMA}, not {shown(raw.get('schema'))}")
        tree = self.only(raw, (*needed, "regressors", "half_life_s", "gate", "correlation_time_s"), "")
        name = self.text(tree, "name", "")
        sensor = self.only(self.entry(tree, "sensor", ""), ("name", "rate_hz", "filter_taps"), "sensor")
        odds = self.only(self.entry(tree, "hypotheses", ""), tuple(LAWS), "hypotheses")
        weights = {law: self.number(odds[law], f"hypotheses.{law}") for law in LAWS if law in odds}
        if not weights:
            raise self.fail("hypotheses", f"must name at least one of {', '.join(LAWS)}")
        time = math.nan
        if "walk_and_markov" in weights:
            time = self.number(self.entry(tree, "correlation_time_s", ""), "correlation_time_s")
        groups_tree = self.entry(tree, "groups", "")
        if not isinstance(groups_tree, dict) or not groups_tree:
            raise self.fail("groups", "must be a mapping of at least one group")
        for key in groups_tree:
            if not isinstance(key, str) or not key.isprintable() or len(key) > LONGEST_TEXT:
                raise self.fail("groups", f"a group's name must be text, not {shown(key)}")
        groups = tuple(self.group(name, fields, weights, time) for name, fields in groups_tree.items())
        axes = [axis for group in groups for axis in group.axes]
        if len(axes) > MOST_AXES:
            raise self.fail("groups", f"have {len(axes)} axes, {MOST_AXES} are the most")
        for axis in axes:
            if axes.count(axis) > 1:
                raise self.fail("groups", f"axis '{axis}' appears twice")
        targets = self.entry(tree, "nodes", "")
        if not isinstance(targets, dict) or "host" not in targets:
            raise self.fail("nodes", "must be a mapping of targets, 'host' among them")
        simulate = tree.get("simulate") or {}
        return Model(
            name=name,
            path=self.path,
            bank_rate_hz=self.rate(self.entry(tree, "bank_rate_hz", ""), "bank_rate_hz"),
            sensor_name=self.text({"name": "", **sensor}, "name", "sensor"),
            sensor_rate_hz=self.rate(self.entry(sensor, "rate_hz", "sensor"), "sensor.rate_hz"),
            filter_taps=self.count(sensor.get("filter_taps", 1), "sensor.filter_taps", 1, MOST_TAPS),
            groups=groups,
            hypotheses={law: weight / sum(weights.values()) for law, weight in weights.items()},
            nodes={name: self.nodes(fields, f"nodes.{name}", weights) for name, fields in targets.items()},
            simulate=self.only(simulate, ("rate_hz", "duration_s", "axes", "effects"), "simulate"),
            regressors=self.regressors(tree.get("regressors") or [], groups),
            half_life_s=self.number(tree.get("half_life_s", 0.0), "half_life_s", strict=False),
            gate=self.gate(tree["gate"], groups) if tree.get("gate") else None,
        )
