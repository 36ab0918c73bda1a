"""A cause: one file in `causes/` states everything about it, and nobody else branches on its name."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from selfcal.base.grid import Array
from selfcal.diagnosis.model_tree import digits

if TYPE_CHECKING:
    from selfcal._reference import Random
    from selfcal.diagnosis.finding import Diagnosed, Finding
    from selfcal.diagnosis.record import Record
    from selfcal.likelihood.state import FittedColumn, Look, State
    from selfcal.model.file import Model

#: Looks at an axis: the candidates of a cause or of several.
Looks = Callable[["State", "Record"], "list[Look]"]


@dataclass(frozen=True)
class Setting:
    """What an effect's default is made from: white noise density, white noise sd per sample, length, and the bias."""

    n: float
    sd: float
    duration_s: float
    samples: int
    bias: float


def is_count(value: float) -> bool:
    """Whether a key's value counts something."""
    return value >= 1.0 and value == int(value)


@dataclass(frozen=True)
class Key:
    """A key of `simulate --effect`: its value if it is not given (None: then it is not there), and which values it
    may have (`fits`, `limits` in words). `field`: the member of the simulator's axis, or scene, that takes it; "" where
    `Cause.add` or the read-out does."""

    default: Callable[[Setting], float] | None
    field: str = ""
    fits: Callable[[float], bool] = lambda value: True
    limits: str = "finite"


def count_key(default: Callable[[Setting], float] | None, field: str = "") -> Key:
    """A key whose value counts something."""
    return Key(default, field, is_count, "a whole number of at least 1")


def positive(default: Callable[[Setting], float] | None, field: str = "") -> Key:
    """A key whose value lies above 0."""
    return Key(default, field, lambda value: value > 0.0, "above 0")


@dataclass(frozen=True)
class Channels:
    """Before the read-out, each [n]: time, s, temperature, degC, supply, V, and the other axes. `random`: numbers of
    this effect on this axis alone."""

    time_s: Array
    temperature: Array
    supply: Array
    axes: Mapping[str, Array]
    random: np.random.Generator


@dataclass(frozen=True)
class Extension:
    """The model file's `tree` that a finding extends, and where it was found."""

    tree: dict[str, Any]
    model: Model
    record: Record
    axis: str
    found: Mapping[str, Diagnosed]
    finding: Finding

    @property
    def group(self) -> dict[str, Any]:
        """The tree of the axis' group."""
        group: dict[str, Any] = self.tree["groups"][self.model.group_of(self.axis).name]
        return group


def sized(entry: Mapping[str, Any], look: Look | None, record: Record) -> dict[str, Any]:
    """The entry of a column, of which a look knows numbers better than the search that chose it."""
    known = {} if look is None else medians(look)
    return {**entry, **{key: digits(value, 9) for key, value in known.items() if key in entry}}


@dataclass(frozen=True)
class Grouping:
    """What merges findings (events.py).

    alike   whether two looks are the same event or source: the same time, line, channel or law.
    pairs   its looks name the other axis of a pair (`other`): pairs that meet form a group of axes.
    piece   whether a look is a piece of a hidden quantity, of which it gets the axes and the times of jumps, s.
    settle  after the rounds of all axes: joins, moves or adds findings.
    most    times at most that the loop names it on an axis; 0: as often as it is found.
    """

    alike: Callable[[Look, Look], bool] = lambda a, b: False
    pairs: bool = False
    piece: Callable[[Look, Collection[str], Sequence[float]], bool] = field(default=lambda look, axes, jumps: False)
    settle: Callable[[Record, Mapping[str, Diagnosed]], None] | None = None
    most: int = 0


@dataclass(frozen=True)
class Scored:
    """How it is scored on held-out time (score.py), and on another recording (carried.py).

    no_gain   why a gain on held-out time is not defined.
    once      why another recording cannot have it: an event of its time, or of its read-out. "": it may have it.
    no_carry  why the bank cannot weigh a look on another recording that has it; "": it can.
    anew      its size belongs to a recording: another recording weighs it anew under its prior.
    trained   look, states before and after, record and split: the state after as the first `split` samples show it. An
              event is scored from its on-line detection, `Look.when[0]`.
    together  nats a sample that two axes gain, and their sd: residuals of both, spacing, s, split and the estimate.
    """

    no_gain: str = ""
    once: str = ""
    no_carry: Callable[[Look], str] = field(default=lambda look: "")
    anew: bool = False
    trained: Callable[[Look, State, State, Record, int], State] | None = None
    together: Callable[[Array, Array, float, int, Mapping[str, Any]], tuple[float, float]] | None = None


@dataclass(frozen=True)
class Written:
    """What the written model file has of it (extend.py).

    entry      its column's entry for the whole recording, by the look that found it.
    smoothed   its column is the mean of a channel: the file states the trailing window that suits it.
    from_zero  the simulator's effect begins at 0, its column is about the middle.
    law        adds a law to a tree without which N is wrong: `identify` reports by it.
    extend     writes what is no column.
    stated     whether a model file has it already: then it is no finding. A column is in the model from the start.
    of_column  keys of `--effect` for columns of the file: the first column and the coefficients of all.
    """

    entry: Callable[[Mapping[str, Any], Look | None, Record], dict[str, Any]] = sized
    smoothed: bool = False
    from_zero: bool = False
    law: Callable[[dict[str, Any], Look], None] | None = None
    extend: Callable[[Extension], None] | None = None
    stated: Callable[[Finding, Model], bool] = field(default=lambda finding, model: False)
    of_column: Callable[[FittedColumn, Sequence[float]], dict[str, Any]] | None = None


@dataclass(frozen=True)
class Simulated:
    """How `simulate --effect` makes it (simulate.py).

    keys         its keys; empty: it cannot be simulated.
    follows      the effect follows another axis: the key `other`.
    common       the effect is of the whole recording and has no axis.
    of_estimate  keys for a finding where they are not the medians of its estimate; None, or no keys: the simulator
                 cannot make it.
    add          what the effect adds to a reading before the read-out, [n]: keys, channels.
    spoil        changes the finished readings of an axis in place: those, keys, rate, Hz, lattice, random numbers.
    """

    keys: Mapping[str, Key] = field(default_factory=dict)
    follows: bool = False
    common: bool = False
    of_estimate: Callable[[Look], dict[str, Any] | None] | None = None
    add: Callable[[Mapping[str, Any], Channels], Array] | None = None
    spoil: Callable[[Array, Mapping[str, Any], float, float, Random], None] | None = None


@dataclass(frozen=True)
class Cause:
    """Everything about a cause.

    id, words, record_next  of the JSON; words is one sentence, record_next the advice that makes sure of any look, or
              by the look.
    unsure    words instead where the estimate has `source`: which axis is the source is not shown.
    source    where it comes from: surroundings, handling, sensor, read-out or model.
    looks     candidates that a round of the loop tries on an axis; None: found before the rounds or after all axes.
    at        the look at it with a known shape, on an axis that it is known to act on.
    of_means  slow: means show all of it, and the look at every sample takes it from them.
    slow      a drift of another law may show it: `identify` weighs more laws.
    least     the size that this record would have shown, by key of the estimate: value and unit; None: no size.
    pictures  names of pictures.py for a look.
    """

    id: str
    words: str
    record_next: str | Callable[[Look, Record], str]
    unsure: str = ""
    source: str = "model"
    looks: Looks | None = None
    at: Callable[[State, Record, Sequence[float]], Look] | None = None
    of_means: bool = False
    slow: bool = False
    least: Callable[[State, Record], Mapping[str, tuple[float, str]] | None] | None = None
    pictures: Callable[[Look], Sequence[str]] = field(default=lambda look: ("unexplained",))
    grouping: Grouping = Grouping()
    score: Scored = Scored()
    written: Written = Written()
    simulated: Simulated = Simulated()

    def located(self, state: State, record: Record, theta: Sequence[float]) -> Look:
        """The look at it with the shape `theta`."""
        assert self.at is not None, self.id
        return self.at(state, record, theta)

    def advice(self, look: Look, record: Record) -> str:
        """What makes sure of a look."""
        return self.record_next if isinstance(self.record_next, str) else self.record_next(look, record)

    def effect(self, look: Look) -> dict[str, Any] | None:
        """Keys of `--effect` for a finding; None: the simulator cannot make it."""
        if self.simulated.of_estimate is not None:
            return self.simulated.of_estimate(look)
        return {key: value for key, value in medians(look).items() if key in self.simulated.keys} or None

    @property
    def several(self) -> bool:
        """Whether the simulator makes several of its effects on an axis: no member, or `intervals`, holds them."""
        keys = self.simulated.keys
        return "intervals" in keys or (self.simulated.add is not None and not any(key.field for key in keys.values()))


def shown(*names: str) -> Callable[[Look], Sequence[str]]:
    """Pictures that every look has alike."""
    return lambda look: names


def medians(look: Look, *keys: str) -> dict[str, Any]:
    """The medians of an estimate's intervals, of `keys` or all."""
    intervals = {key: value["median"] for key, value in look.estimate.items() if isinstance(value, Mapping)}
    return {key: intervals[key] for key in keys or intervals}
