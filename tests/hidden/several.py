"""A third generator of hidden effects: one cause acts on several axes. Written without a look at the detector.

Imports nothing of selfcal. A record is 3 h of six axes at 1 Hz with a temperature and a supply. Each axis has white
noise N and a drift with kicks of K. K/N is 0.01 to 0.1 per s. A cause of `KINDS` acts on two to six axes. The right
model of an axis expects 4 to 15 nats of it, all axes together expect 30 to 80.

Expected nats of a column x of size b on an axis are the mean, over noise and drift, of the gain in ln likelihood by
b x. The likelihood is the exact Gaussian one of the true drift law with an open constant. The mean is b² x'Px / 2, with
P the precision less its part along the constant. Nothing is taken off for sizes, places or shapes searched.

A hidden quantity f moves three to six axes. It makes 0.3 to 0.7 of the power of each axis' kicks. Its expected gain is
the mean ln likelihood of all axes jointly, less the mean of single axes with the same total drift. By the determinant
of the axes' spectra S it is the sum over frequencies of sum ln S_ii - ln det S. It is 30 nats or more. The nats of one
axis are the part of the gain that is lost without this axis.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from evidence import Array, markov_node, walk_node
from physics import (
    AXES,
    DENSITY,
    FINE,
    SAG,
    SUPPLY_LSB,
    SWING,
    TEMPERATE,
    TEMPERATURE_LSB,
    UNITS,
    VOLTS,
    Axis,
    Random,
    around,
    edge,
    lagged,
    loads,
    on_lattice,
    room,
    smooth_noise,
    swings,
)

#: s at 1 Hz.
SECONDS = 10_800
#: K/N, 1/s, of the kicks; time constants, s, of a drift that is pulled back, and how many axes have one.
KICKS, TAUS, PULLED = (0.01, 0.1), (200.0, 2000.0), 0.3
#: Expected nats of an axis, and of all axes together.
EACH, TOGETHER = (4.0, 15.0), (30.0, 80.0)
#: Part of f in the power of an axis' kicks; least expected gain, nats.
SHARE, LEAST = (0.3, 0.7), 30.0
#: A column that is told from its rival by less has no shape that a right answer must state, nats.
TOLD = 6.0
GRAVITY = 9.8
TRIES = 200


@dataclass
class Scene:
    """One record before its effects. Times and channels are `FINE` times finer than the readings."""

    random: Random
    seconds: int
    axes: dict[str, Axis]
    #: Added to the readings of an axis, [n].
    added: dict[str, Array] = field(default_factory=dict)
    noise: dict[str, Array] = field(default_factory=dict)
    temperature: Array = field(default_factory=lambda: np.zeros(0))
    supply: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def t(self) -> Array:
        """[n * FINE], s."""
        return (np.arange(self.seconds * FINE) + 0.5) / FINE

    def read(self, fine: Array) -> Array:
        """[n]: means of a second."""
        return np.asarray(fine.reshape(-1, FINE).mean(axis=1))

    def add(self, axis: str, column: Array) -> None:
        """`column` [n] on the readings of an axis."""
        self.added[axis] = self.added.get(axis, np.zeros(self.seconds)) + column

    def log(self, low: float, high: float) -> float:
        """A number drawn uniformly in its logarithm."""
        return float(np.exp(self.random.uniform(np.log(low), np.log(high))))

    def place(self, low: float = 0.1, high: float = 0.9) -> float:
        """A time, s."""
        return float(self.random.uniform(low, high) * self.seconds)


@dataclass(frozen=True)
class Piece:
    """One cause of a record, as a right answer states it.

    `nats`: expected ones of each axis. `theta`: what must agree. `optional`: neither wanted nor wrong.
    `names`: causes that are the right word.
    """

    names: tuple[str, ...]
    nats: dict[str, float]
    together: float
    theta: dict[str, Any] = field(default_factory=dict)
    optional: bool = False
    more: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Record:
    """Columns by `name[unit]` at 1 Hz, and the truth. `added`: what the causes put on the readings of an axis, [n]."""

    kind: str
    seed: int
    columns: dict[str, Array]
    pieces: list[Piece]
    axes: dict[str, Axis]
    added: dict[str, Array]

    @property
    def t(self) -> Array:
        """[n], s."""
        return np.arange(len(next(iter(self.columns.values()))), dtype=float)

    @property
    def truth(self) -> dict[str, Any]:
        """JSON."""
        return {
            "kind": self.kind,
            "seed": self.seed,
            "pieces": [vars(piece) for piece in self.pieces],
            "axes": {name: vars(axis) for name, axis in self.axes.items()},
        }


# ------------------------------------------------------------------------------------------------------ expected nats


def information(axis: Axis, columns: Array) -> Array:
    """[p, p]: C'PC of `columns` [n, p] under the drift and the white noise of an axis, its constant open."""
    centred = columns - columns.mean(axis=0)
    ratio = axis.size / axis.n
    node = walk_node(centred, 1.0, ratio) if axis.law == "random_walk" else markov_node(centred, 1.0, ratio, axis.tau)
    return np.asarray(node.quadratic / axis.n**2)


def kick_power(count: int) -> Array:
    """[count // 2]: |1 - exp(-i w)|² at the middles of count // 2 bands up to half of the rate."""
    return np.asarray(2.0 - 2.0 * np.cos(2.0 * np.pi * (np.arange(count // 2) + 0.5) / count))


def hidden_gain(own: Sequence[Axis], loadings: Array, count: int) -> float:
    """Expected gain of the joint law over single laws of the same total drift, `count` readings of each axis.

    `own`: axes with what is left to their own walk. f is a walk of unit kicks. By the increments' spectra.
    """
    kick = kick_power(count)
    ratio = np.array([x**2 / (axis.n**2 * kick + axis.size**2) for axis, x in zip(own, loadings, strict=True)])
    return float((np.log1p(ratio).sum(axis=0) - np.log1p(ratio.sum(axis=0))).sum())


def jump_information(own: Sequence[Axis], loadings: Array, count: int) -> float:
    """Of a jump of f by one, far from the ends, to who knows the joint law."""
    kick = kick_power(count)
    q = sum(x**2 / (axis.n**2 * kick + axis.size**2) for axis, x in zip(own, loadings, strict=True))
    return float(np.mean(q / (1.0 + q)))


def wanted(random: Random, count: int) -> Array:
    """[count]: expected nats of axes, each within `EACH`, their sum within `TOGETHER`."""
    low, high = EACH
    total = random.uniform(max(TOGETHER[0], low * count), min(TOGETHER[1], high * count))
    nats = random.uniform(low, high, count)
    if nats.sum() < total:
        return np.asarray(nats + (high - nats) * (total - nats.sum()) / (high - nats).sum())
    return np.asarray(nats - (nats - low) * (nats.sum() - total) / (nats - low).sum())


# ------------------------------------------------------------------------------------------------ shapes that are seen


@dataclass(frozen=True)
class Shape:
    """A column at the fine times, what a right answer states of it, and a rival that a right answer excludes."""

    fine: Array
    theta: dict[str, Any] = field(default_factory=dict)
    rival: Array | None = None


def line(scene: Scene) -> Shape:
    frequency = scene.log(0.02, 0.45)
    return Shape(np.sin(2.0 * np.pi * (frequency * scene.t + scene.random.random())), {"frequency_hz": frequency})


def harmonics(scene: Scene) -> Shape:
    """A fundamental, which is the strongest, and its second and third."""
    frequency = scene.log(0.01, 0.1)
    sizes = (1.0, scene.random.uniform(0.3, 0.7), scene.random.uniform(0.2, 0.5))
    turns = [k * frequency * scene.t + scene.random.random() for k in (1, 2, 3)]
    shape = sum(size * np.sin(2.0 * np.pi * turn) for size, turn in zip(sizes, turns, strict=True))
    return Shape(np.asarray(shape), {"frequency_hz": frequency})


def step(scene: Scene) -> Shape:
    at = scene.place()
    return Shape((scene.t > at).astype(float), {"time_s": at})


def pulse(scene: Scene) -> Shape:
    at, duration = scene.place(0.1, 0.75), scene.log(60.0, 0.15 * scene.seconds)
    shape = ((scene.t > at) & (scene.t < at + duration)).astype(float)
    return Shape(shape, {"time_s": at, "duration_s": duration})


def turn_on(scene: Scene) -> Shape:
    tau = scene.log(0.02, 0.15) * scene.seconds
    return Shape(np.exp(-scene.t / tau), {"tau_s": tau})


def ramp(scene: Scene) -> Shape:
    return Shape(scene.t / scene.seconds)


def temperature_lag(scene: Scene) -> Shape:
    """The part is behind the thermometer."""
    scene.temperature = around(swings(scene.random, scene.t), TEMPERATE)
    lag = scene.log(60.0, 300.0)
    return Shape(lagged(scene.temperature / SWING, 1.0 / FINE, lag), {"lag_s": lag}, scene.temperature)


def supply(scene: Scene) -> Shape:
    slow = SAG * smooth_noise(scene.random, scene.t, scene.log(40.0, 200.0))
    scene.supply = around(scene.supply + slow, VOLTS)
    return Shape((scene.supply - VOLTS) / SAG, {"form": "static"})


#: Kinds of a column: the right word and the shape.
COLUMNS: dict[str, tuple[str, Callable[[Scene], Shape]]] = {
    "line": ("periodic", line),
    "harmonics": ("periodic", harmonics),
    "step": ("step", step),
    "pulse": ("pulse", pulse),
    "turn_on": ("turn_on", turn_on),
    "ramp": ("ramp", ramp),
    "temperature_lag": ("temperature", temperature_lag),
    "supply": ("supply", supply),
}


def chosen(random: Random, fewest: int, of: Sequence[str] = AXES) -> list[str]:
    """`fewest` axes or more of a list, in its order."""
    count = int(random.integers(fewest, len(of) + 1))
    picked = set(random.choice(len(of), count, replace=False).tolist())
    return [name for k, name in enumerate(of) if k in picked]


def put(scene: Scene, column: Array, names: Sequence[str]) -> dict[str, float]:
    """`column` [n] on these axes in drawn sizes; expected nats of each."""
    nats = dict(zip(names, wanted(scene.random, len(names)).tolist(), strict=True))
    for name, value in nats.items():
        there = float(information(scene.axes[name], column[:, None])[0, 0])
        scene.add(name, scene.random.choice([-1.0, 1.0]) * np.sqrt(2.0 * value / there) * column)
    return nats


def column_kind(kind: str) -> Callable[[Scene], list[Piece]]:
    """Draws a column of `COLUMNS` on two to six axes."""
    cause, make = COLUMNS[kind]

    def pieces(scene: Scene) -> list[Piece]:
        shape = make(scene)
        column = scene.read(shape.fine)
        nats = put(scene, column, chosen(scene.random, 2))
        theta, more = dict(shape.theta), {}
        if shape.rival is not None:
            both = np.column_stack([column, scene.read(shape.rival)])
            told = 0.0
            for name, value in nats.items():
                inner = information(scene.axes[name], both)
                told += value * (1.0 - inner[0, 1] ** 2 / (inner[0, 0] * inner[1, 1]))
            more = {"over_rival": told, **theta}
            if told < TOLD:
                theta = {}
        return [Piece((cause,), nats, sum(nats.values()), theta, more=more)]

    return pieces


# ----------------------------------------------------------------------------------------------- tilt, leaks, hidden f


def tilt(scene: Scene) -> list[Piece]:
    """The bench tilts within seconds: gravity turns on two or three accelerometers, and the gyros turn along."""
    random = scene.random
    names = ["ax", "ay"] if random.random() < 0.5 else ["ax", "ay", "az"]
    at = scene.place()
    shape = edge(scene.t, at, random.uniform(0.3, 1.5))
    column = scene.read(shape)
    nats = dict(zip(names, wanted(random, len(names)).tolist(), strict=True))
    change = np.zeros(3)
    for name, value in nats.items():
        there = float(information(scene.axes[name], column[:, None])[0, 0])
        change["xyz".index(name[1])] = random.choice([-1.0, 1.0]) * np.sqrt(2.0 * value / there)
    # A turn leaves the size of gravity as it is: the change is across it.
    gravity = np.array([0.0, 0.0, 1.0]) if len(names) == 2 else random.normal(size=3)
    gravity -= change * float(gravity @ change) / float(change @ change)
    gravity *= GRAVITY / np.linalg.norm(gravity)
    angle = np.cross(change, gravity) / GRAVITY**2
    rate = np.degrees(angle)[:, None] * scene.read(np.gradient(shape, 1.0 / FINE))
    for k, axis in enumerate("xyz"):
        name = f"a{axis}"
        scene.axes[name] = Axis(**{**vars(scene.axes[name]), "offset": float(gravity[k])})
        scene.add(name, change[k] * column)
        scene.add(f"g{axis}", rate[k])
        gyro = scene.axes[f"g{axis}"]
        nats[f"g{axis}"] = 0.5 * float(information(gyro, rate[k][:, None])[0, 0])
    nats = {name: nats.get(name, 0.0) for name in AXES if nats.get(name, 0.0) > 0.0}
    together = sum(nats[name] for name in names)
    return [Piece(("tilt", "step"), nats, together, {"time_s": at}, more={"angle_deg": np.degrees(angle).tolist()})]


def leak(scene: Scene) -> list[Piece]:
    """A share of one axis' readings, noise and all, in two to five others."""
    source = str(scene.random.choice(AXES))
    column = scene.noise[source] + scene.added.get(source, 0.0)
    nats = put(scene, column, chosen(scene.random, 2, [name for name in AXES if name != source]))
    return [Piece(("cross_axis",), nats, sum(nats.values()), {"other": source})]


def hidden(jumps: bool = False, day: bool = False) -> Callable[[Scene], list[Piece]]:
    """f as a walk on three to six axes, with jumps, or about the course of a day."""

    def pieces(scene: Scene) -> list[Piece]:
        random, n = scene.random, scene.seconds
        for _ in range(TRIES):
            names = chosen(random, 3)
            kicks = {name: scene.axes[name].n * scene.log(*KICKS) for name in names}
            shares = dict(zip(names, random.uniform(*SHARE, len(names)).tolist(), strict=True))
            loadings = np.array([kicks[name] * np.sqrt(shares[name]) for name in names])
            own = [
                Axis(axis.n, "random_walk", float(kicks[name] * np.sqrt(1.0 - shares[name])), axis.tau, axis.offset)
                for name, axis in ((name, scene.axes[name]) for name in names)
            ]
            gain = hidden_gain(own, loadings, n)
            if gain >= LEAST:
                break
        else:
            raise RuntimeError(f"{gain:.0f} nats at most, {LEAST:.0f} wanted")
        if random.random() < 0.3:
            loadings *= random.choice([-1.0, 1.0], len(names))
        course = np.cumsum(random.normal(size=n))
        optional, theta, more = [], {}, {}
        if jumps:
            count = int(random.integers(2, 5))
            times = np.sort((np.arange(count) + random.uniform(0.2, 0.8, count)) / count) * n
            nats = random.uniform(*TOGETHER, count)
            unit = jump_information(own, loadings, n)
            for at, value in zip(times, nats, strict=True):
                course += random.choice([-1.0, 1.0]) * np.sqrt(2.0 * value / unit) * scene.read(scene.t > at)
                optional.append(Piece(("step",), dict.fromkeys(names, 0.0), value, {"time_s": float(at)}, True))
            theta, more = {"jumps": times.tolist()}, {"jump_nats": nats.tolist()}
        if day:
            wave = scene.read(np.sin(2.0 * np.pi * (scene.t / 86_400.0 + random.random())))
            course += random.uniform(5.0, 10.0) * np.sqrt(n) * wave / np.ptp(wave)
            slow = ("ramp", "turn_on", "periodic")
            optional.append(Piece(slow, dict.fromkeys(names, 0.0), 0.0, {}, True))
        lost = {}
        for k, (name, axis, loading) in enumerate(zip(names, own, loadings, strict=True)):
            rest = [j for j in range(len(names)) if j != k]
            lost[name] = gain - hidden_gain([own[j] for j in rest], loadings[rest], n)
            scene.axes[name] = axis
            scene.noise[name] = axis.drift(random, n, 1.0) + axis.n * random.normal(size=n)
            scene.add(name, loading * course)
        more |= {"shares": shares, "loadings": dict(zip(names, loadings.tolist(), strict=True)), "kicks": kicks}
        return [Piece(("hidden_input",), lost, gain, theta, more=more), *optional]

    return pieces


def leak_beside_f(scene: Scene) -> list[Piece]:
    found = hidden()(scene)
    return [*found, *leak(scene)]


def two(scene: Scene) -> list[Piece]:
    """Two kinds of `COLUMNS`, each with axes of its own. A ramp and a turn-on are too alike."""
    while True:
        kinds = scene.random.choice(list(COLUMNS), 2, replace=False).tolist()
        if set(kinds) not in ({"ramp", "turn_on"}, {"line", "harmonics"}):
            return [piece for kind in kinds for piece in column_kind(kind)(scene)]


CLEAN, CALM = "clean", "f_calm"
#: The twelve kinds that count.
KINDS: dict[str, Callable[[Scene], list[Piece]]] = {
    **{kind: column_kind(kind) for kind in COLUMNS},
    "f_walk": hidden(),
    "f_jumps": hidden(jumps=True),
    "f_day": hidden(day=True),
    "tilt": tilt,
}
#: Kinds beside them. `CALM`: f as a walk without jumps, for what is found beside it.
BESIDE: dict[str, Callable[[Scene], list[Piece]]] = {
    "leak": leak,
    "leak_beside_f": leak_beside_f,
    "two": two,
    CALM: hidden(),
    CLEAN: lambda scene: [],
}
ALL: Mapping[str, Callable[[Scene], list[Piece]]] = {**KINDS, **BESIDE}


# ------------------------------------------------------------------------------------------------------------ records


def draw_axis(scene: Scene, name: str) -> Axis:
    """Truth of an axis. A drift that is pulled back has the kicks of the walk."""
    random = scene.random
    n = DENSITY[name[0]] * float(np.exp(random.uniform(-1.0, 1.0)))
    kick, tau = n * scene.log(*KICKS), scene.log(*TAUS)
    offset = GRAVITY if name == "az" else float(random.uniform(-0.4, 0.4))
    if random.random() < PULLED:
        return Axis(n, "gauss_markov", float(kick * np.sqrt(0.5 * tau)), tau, offset)
    return Axis(n, "random_walk", kick, tau, offset)


def draw(kind: str, seed: int, seconds: int = SECONDS) -> Record:
    """The record of a kind of `ALL`. RuntimeError: no draw reaches its size at this length."""
    scene = Scene(np.random.default_rng([seed, zlib.crc32(kind.encode()), 3]), seconds, {})
    random = scene.random
    scene.axes = {name: draw_axis(scene, name) for name in AXES}
    scene.temperature = room(random, scene.t, warm=bool(random.random() < 0.6))
    scene.supply = loads(random, scene.t)
    for name, axis in scene.axes.items():
        scene.noise[name] = axis.drift(random, seconds, 1.0) + axis.n * random.normal(size=seconds)
    pieces = ALL[kind](scene)
    columns = {
        f"{name}[{UNITS[name[0]]}]": axis.offset + scene.noise[name] + scene.added.get(name, 0.0)
        for name, axis in scene.axes.items()
    }
    thermometer = scene.read(scene.temperature) + 0.06 * random.normal(size=seconds)
    voltmeter = scene.read(scene.supply) + 0.002 * random.normal(size=seconds)
    columns["temp[degC]"] = on_lattice(thermometer, TEMPERATURE_LSB)
    columns["supply[V]"] = on_lattice(voltmeter, SUPPLY_LSB)
    return Record(kind, seed, columns, pieces, scene.axes, scene.added)
